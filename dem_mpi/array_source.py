"""Arrays of any origin for `dem-mpi compress`: file.npy, or a data set, file.h5:/group/name."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compress.archive import Block
from compress.bounds import Bound
from compress.sources import HDF5_SUFFIXES, open_array
from dem_mpi.compress_options import CompressOptions, choose
from dem_mpi.errors import InputError
from dem_mpi.h5files import open_checked, readable_size


def is_array(source: str) -> bool:
    """Whether a source is an array rather than a trajectory, by its name alone."""
    file, colon, _ = source.rpartition(":")
    return source.endswith(".npy") or (bool(colon) and file.endswith(HDF5_SUFFIXES))


def require_data_set(source: str) -> None:
    """Raise InputError, with the data sets there are, for a file of arrays without one's name."""
    if source.endswith(HDF5_SUFFIXES):
        with open_checked(source) as file:
            known = "format" in file.attrs
        if not known:
            open_array(source).close()


class ArraySource:
    """An array as blocks of bodies; see `compress.sources` for what a body of it is."""

    def __init__(self, options: CompressOptions) -> None:
        """Open. InputError (64) where there is no such array, DataError (65) if it is no array."""
        self._array = open_array(options.source)
        try:
            self.name = self._array.name
            bounds = options.bounds or {self.name: None}
            choose("--field", bounds, [self.name], options.source)
            kind, value = bounds[self.name] or ("relative", options.tolerance)
            if self._array.array.dtype.kind != "f" and kind != "exact":
                if bounds[self.name] is not None:
                    raise InputError(f"--field {self.name}: is whole numbers, take exact")
                kind, value = "exact", 0.0
            self.specs = {self.name: self._array.field(Bound(kind, value))}
            self._bodies, self._width = self._array.rows
            if not self._array.steps or not self._bodies:
                raise InputError(f"{options.source}: holds no steps, or nothing in them")
        except BaseException:
            self.close()
            raise
        self.path = options.source
        self.steps = np.arange(self._array.steps)
        self.times = np.arange(self._array.steps, dtype=np.float64)

    def __enter__(self) -> ArraySource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._array.close()

    @property
    def frame_bytes(self) -> int:
        """Bytes [B] of a step."""
        return self._bodies * self._width * self._array.array.dtype.itemsize

    def blocks(self, number: int) -> list[tuple[int, int]]:
        """Ranges [low, high) of bodies."""
        edges = [self._bodies * k // number for k in range(number + 1)]
        return list(itertools.pairwise(edges))

    def read(self, frames: range, block: tuple[int, int], verify: Sequence[int]) -> Block:
        """A block of these steps, of which the whole is read."""
        return self.read_blocks(frames, [block], verify)[0]

    def read_blocks(
        self, frames: range, blocks: Sequence[tuple[int, int]], verify: Sequence[int]
    ) -> list[Block]:
        """Blocks of these steps, which are read once, whole; there are no checksums to compare."""
        values = self._array.read(frames.start, frames.stop)
        return [
            Block(
                np.arange(low, high, dtype=np.int64),
                {self.name: np.ascontiguousarray(values[:, low:high])},
            )
            for low, high in blocks
        ]

    def reader(self) -> Callable[[str, int, int], NDArray]:
        """Values (stop - first, n, w) of the array."""
        return lambda name, first, stop: self._array.read(first, stop)

    def provenance(self) -> dict[str, Any]:
        """Where the values come from; `digest` tells arrays apart, by three of their steps."""
        array, last = self._array.array, len(self.steps) - 1
        digest = hashlib.blake2b(repr((array.dtype.str, array.shape)).encode(), digest_size=16)
        for k in (0, last // 2, last):
            digest.update(self._array.read(k, k + 1).tobytes())
        return {"source": self.path, "digest": digest.hexdigest()}

    def lines(self) -> list[str]:
        """What there is, one fact a line."""
        array = self._array.array
        shape = " x ".join(f"{k:,}" for k in array.shape)
        size = readable_size(len(self.steps) * self.frame_bytes)
        return [f"{self.path}: {shape} numbers of {array.dtype}, {size}; the first axis is time"]
