"""From run.h5 to chunks of frames for `compress`: every body's values over time, by ranges of gid.

In a trajectory the rows of a frame lie in the order of ranks and places; here they come together
by body, of a range of gids: memory holds these bodies over the frames that are asked for, about
twice while rows are sorted, however large the frames are.

Symbols: T frames of a chunk; n bodies of a block.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi.errors import DataError
from dem_mpi.frame_buffer import Track, tracks
from dem_mpi.h5files import HDF5_ERRORS, checksum, open_checked, read_attributes, reason, row_blocks
from dem_mpi.trajectory import (
    Field,
    expected_checksums,
    raise_on_mismatch,
    read_fields,
    read_index,
)

_BINS = 1 << 12  # of gids, to make blocks of about as many bodies
_MOST_GID = np.iinfo(np.int64).max


class TrajectoryChunks:
    """A trajectory open for reading by chunks; every rank opens its own."""

    def __init__(self, path: Path | str) -> None:
        """Open. InputError (64) if there is no such file, DataError (65) if it is no trajectory."""
        self.path = Path(path)
        self._file: h5py.File = open_checked(self.path)
        try:
            self.index = read_index(self.path, self._file)
            fields = read_fields(self.path, self._file)
            self.attributes: dict[str, Any] = read_attributes(self._file)
            if not len(self.index):
                raise DataError(f"{self.path}: holds no complete frame")
        except BaseException:
            self._file.close()
            raise
        self.fields: dict[str, Field] = {f.name: f for f in fields}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def bodies(self) -> int:
        """Most bodies of a frame."""
        return int(self.index.count.max())

    def digest(self) -> str:
        """Tells trajectories apart by their columns and by what they begin with.

        It stays the same while a run appends frames. DataError (65) where the file is damaged.
        """
        fields = list(self.fields.values())
        try:
            sums = expected_checksums(self._file, fields, range(1))
        except HDF5_ERRORS as error:
            raise DataError(f"{self.path}: damaged: {reason(error)}") from None
        start = [int(self.index.step[0]), float(self.index.time[0]), int(self.index.count[0])]
        columns = [(field.name, field.dtype, field.width) for field in fields]
        text = repr((start, columns, sums.tolist()))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def blocks(self, number: int) -> list[tuple[int, int]]:
        """Ranges [low, high) of gids, all there are, that hold about as many bodies each."""
        if number == 1:
            return [(0, _MOST_GID)]
        ends = (0, len(self.index) - 1)
        extremes = [(int(g.min()), int(g.max())) for k in ends for g in self._gids(k)]
        low = min((least for least, _ in extremes), default=0)
        high = max((most for _, most in extremes), default=0)
        width = -(-(high + 1 - low) // _BINS)
        count = np.zeros(_BINS, np.int64)
        for k in ends:
            for gid in self._gids(k):
                count += np.bincount((gid - low) // width, minlength=_BINS)
        below = np.cumsum(count)
        shares = np.arange(1, number) * (below[-1] / number)
        inner = low + width * (np.searchsorted(below, shares) + 1)
        edges = [0, *inner.tolist(), _MOST_GID]
        return list(itertools.pairwise(edges))

    def lasting(self, most: int) -> NDArray:
        """Gids of up to so many bodies that are there from the first frame to the last."""
        ends = [np.concatenate(list(self._gids(k)) or [[]]) for k in (0, len(self.index) - 1)]
        gid = np.intersect1d(*ends).astype(np.int64)
        if not len(gid):
            raise DataError(f"{self.path}: no body is there from the first frame to the last")
        # Neighbours in gid are neighbours in space where bodies were placed in order.
        start = max(0, (len(gid) - most) // 2)
        return gid[start : start + most]

    def _gids(self, k: int) -> Iterator[NDArray]:
        """The gids of frame k, in pieces."""
        start, count = int(self.index.offset[k]), int(self.index.count[k])
        for first, last in row_blocks(start, start + count, 8):
            yield self._file["gid"][first:last]

    def read(
        self,
        frames: range,
        names: Sequence[str],
        gids: tuple[int, int],
        verify: Sequence[int] = (),
    ) -> Track:
        """Bodies of gids [low, high) over these frames.

        Checksums are compared of the frames that are in `verify`. Raises DataError (65) where the
        file is damaged.
        """
        fields = [self.fields[name] for name in dict.fromkeys(("gid", *names))]
        parts: list[dict[str, NDArray]] = []
        for k in frames:
            try:
                parts.append(self._read_frame(k, k - frames.start, fields, gids, k in verify))
            except HDF5_ERRORS as error:
                raise DataError(f"{self.path}: damaged: {reason(error)}") from None
        rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        del parts
        try:
            return tracks(len(frames), rows)
        except ValueError as error:
            raise DataError(
                f"{self.path}: frames {frames.start} to {frames[-1]}: {error}"
            ) from None

    def _read_frame(
        self, k: int, number: int, fields: Sequence[Field], gids: tuple[int, int], verify: bool
    ) -> dict[str, NDArray]:
        start, count = int(self.index.offset[k]), int(self.index.count[k])
        sums = [0] * len(fields)
        parts: list[dict[str, NDArray]] = []
        for first, last in row_blocks(0, count, sum(f.row_bytes for f in fields)):
            block = {f.name: self._file[f.place][start + first : start + last] for f in fields}
            if verify:
                for i, f in enumerate(fields):
                    sums[i] = (sums[i] + checksum(block[f.name], first)) % 2**64
            mine = (block["gid"] >= gids[0]) & (block["gid"] < gids[1])
            parts.append({name: rows[mine] for name, rows in block.items()})
        if verify:
            frame = range(k, k + 1)
            expected = expected_checksums(self._file, fields, frame)
            actual = np.array([sums], dtype=np.uint64)
            raise_on_mismatch(self.path, fields, self.index, frame, actual, expected)
        found = {
            f.name: np.concatenate([np.zeros(f.shape(0), f.dtype), *(p[f.name] for p in parts)])
            for f in fields
        }
        found["frame"] = np.full(len(found["gid"]), number, np.int32)
        return found
