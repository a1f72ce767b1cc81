"""Arrays of any origin as chunks of steps: data sets of HDF5 files (`file.h5:/path`) and `.npy`.

An array has time along one axis, the first by default. A step of shape (n, w) is n bodies of w
components, of shape (n,) n bodies of one; of more dimensions, the last are the components if there
are no more than 16 of them, else there is one, and all others are bodies.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from compress.bounds import Bound
from compress.coding import Block, Chunk, FieldSpec
from dem_mpi.errors import DataError, InputError
from dem_mpi.h5files import HDF5_ERRORS, open_checked, reason

_MOST_COMPONENTS = 16
HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf", ".he5", ".nc", ".nc4")
_MOST_NAMES = 10  # of data sets, that a message tells


@dataclass(frozen=True)
class ArraySource:
    """An array read in steps.

    name : for a field; array : of h5py or numpy, from which slices are read; axis : of time
    """

    name: str
    place: str
    array: h5py.Dataset | NDArray
    axis: int = 0

    @property
    def steps(self) -> int:
        """T, how many steps there are."""
        return int(self.array.shape[self.axis])

    @property
    def step_shape(self) -> tuple[int, ...]:
        """The shape of one step."""
        shape = self.array.shape
        return tuple(int(n) for n in (*shape[: self.axis], *shape[self.axis + 1 :]))

    @property
    def rows(self) -> tuple[int, int]:
        """Bodies and components of one step."""
        shape = self.step_shape
        width = shape[-1] if len(shape) >= 2 and 1 <= shape[-1] <= _MOST_COMPONENTS else 1
        return math.prod(shape) // width, width

    def field(self, bound: Bound) -> FieldSpec:
        """What an archive has to know of it."""
        dtype = self.array.dtype.newbyteorder("=").str[1:]
        return FieldSpec(bound, dtype, self.rows[1], shape=self.step_shape)

    def read(self, first: int, stop: int) -> NDArray:
        """Steps [first, stop) as (T, n, w). Raises DataError where the file is damaged."""
        where = (slice(None),) * self.axis + (slice(first, stop),)
        try:
            values = np.moveaxis(np.asarray(self.array[where]), self.axis, 0)
        except HDF5_ERRORS as error:
            raise DataError(f"{self.place}: cannot be read: {reason(error)}") from None
        native = values.dtype.newbyteorder("=")
        return np.ascontiguousarray(values, native).reshape(stop - first, *self.rows)

    def chunks(self, length: int, first: int = 0) -> Iterator[Chunk]:
        """Chunks of `length` steps from step `first` on; the number of a step is also its time."""
        gid = np.arange(self.rows[0], dtype=np.int64)
        for start in range(first, self.steps, length):
            stop = min(start + length, self.steps)
            steps = np.arange(start, stop, dtype=np.int64)
            block = Block(gid, {self.name: self.read(start, stop)})
            yield Chunk(steps, steps.astype(np.float64), (block,))

    def close(self) -> None:
        """Close the file."""
        if isinstance(self.array, h5py.Dataset):
            self.array.file.close()


def open_array(source: str, axis: int = 0) -> ArraySource:
    """Open `file.npy`, or `file.h5:/path` with a data set.

    Raises InputError if there is no such file, data set or axis, DataError for a file that is
    damaged or refused.
    """
    if source.endswith(".npy"):
        array, name = _open_npy(Path(source)), Path(source).stem
    else:
        file, separator, inside = source.rpartition(":")
        if not separator or not inside:
            name = source.rstrip(":")
            if name.endswith(HDF5_SUFFIXES):
                raise InputError(f"{name}: name a data set in it, {name}:/path{_names(Path(name))}")
            raise InputError(f"{source}: neither a .npy file nor one of HDF5 with ':/data/set'")
        array, name = _open_dataset(Path(file), inside), inside.rstrip("/").rpartition("/")[2]
    if array.ndim < 1 or not -array.ndim <= axis < array.ndim:
        shape = array.shape
        _close(array)
        raise InputError(f"{source}: shape {shape} has no axis {axis} for time")
    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
        dtype = array.dtype
        _close(array)
        raise InputError(f"{source}: {dtype} is no plain number of at most 8 bytes")
    return ArraySource(name, source, array, axis % array.ndim)


def _open_npy(path: Path) -> NDArray:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, SyntaxError, TypeError, OverflowError) as error:
        raise DataError(f"{path}: cannot be read: {reason(error)}") from None
    if not isinstance(array, np.ndarray):
        raise DataError(f"{path}: not one array")
    return array


def _open_dataset(path: Path, name: str) -> h5py.Dataset:
    file = open_checked(path)
    try:
        dataset = file.get(name)
    except HDF5_ERRORS as error:
        file.close()
        raise DataError(f"{path}: cannot be read: {reason(error)}") from None
    if not isinstance(dataset, h5py.Dataset):
        file.close()
        raise InputError(f"{path}: no data set '{name}'{_names(path)}")
    return dataset


def _names(path: Path) -> str:
    """What data sets there are, as the end of a message."""
    found: list[str] = []

    def note(name: str, item: h5py.Group | h5py.Dataset) -> bool | None:
        if isinstance(item, h5py.Dataset):
            found.append(f"/{name}")
        return len(found) > _MOST_NAMES or None

    with open_checked(path) as file:
        try:
            file.visititems(note)
        except HDF5_ERRORS as error:
            raise DataError(f"{path}: cannot be read: {reason(error)}") from None
    if not found:
        return "; it has none"
    more = ", ..." if len(found) > _MOST_NAMES else ""
    return f"; it has {', '.join(found[:_MOST_NAMES])}{more}"


def _close(array: h5py.Dataset | NDArray) -> None:
    if isinstance(array, h5py.Dataset):
        array.file.close()
