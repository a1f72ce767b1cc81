"""What a trajectory file holds: fields, frames, where they lie, and how they are checked.

The layout is described in `output`, which writes it.

Symbols: T frames; M rows of all frames; F fields; n rows of one frame; k width of a field.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi.errors import DataError
from dem_mpi.h5files import (
    HDF5_ERRORS,
    attributes_checksum,
    open_checked,
    plain,
    read_attribute,
    read_attributes,
    reason,
    row_checksums,
    write_attributes,
)

FORMAT = "dem-mpi trajectory"
FORMAT_VERSION = 1

# The times [s]. VTK reads all of them into memory for NSteps, so there may be no more than that.
TIMES = "VTKHDF/Steps/Values"

TOPOLOGIES = ("Vertices", "Lines", "Strips", "Polygons")

# What changes without the others, and what is computed from them.
_UNCHECKED_ATTRIBUTES = ("complete", "checksum")


@dataclass(frozen=True)
class Field:
    """A column of the trajectory: (M, width) of a type, (M,) for width 1, in a unit."""

    name: str
    dtype: str = "f8"
    width: int = 1
    unit: str = "1"

    def shape(self, rows: int) -> tuple[int, ...]:
        """The shape of so many rows."""
        return (rows,) if self.width == 1 else (rows, self.width)

    @property
    def row_bytes(self) -> int:
        """Bytes [B] of a row."""
        return self.width * np.dtype(self.dtype).itemsize

    @property
    def place(self) -> str:
        """The data set in the VTK layout."""
        return "VTKHDF/Points" if self.name == "position" else f"VTKHDF/PointData/{self.name}"


@dataclass(frozen=True)
class Series:
    """What a frame has once: a data set (T, *row_shape) of float64 under `name`, in a unit."""

    name: str
    row_shape: tuple[int, ...]
    unit: str = "1"


POSITION = Field("position", "f8", 3, "m")
GID = Field("gid", "i8", 1, "1")


@dataclass(frozen=True)
class Frame:
    """One frame: its step, its time [s] and its columns, (n,) or (n, k) each."""

    step: int
    time: float
    columns: dict[str, NDArray]


@dataclass(frozen=True)
class FrameIndex:
    """Which frames a file holds: step, time [s], rows and first row of each, all (T,)."""

    step: NDArray
    time: NDArray
    count: NDArray
    offset: NDArray

    def __len__(self) -> int:
        return len(self.step)

    @property
    def rows(self) -> int:
        """Rows of all frames."""
        return int(self.offset[-1] + self.count[-1]) if len(self) else 0

    def upto(self, step: int) -> FrameIndex:
        """The frames of steps not after `step`."""
        n = int(np.searchsorted(self.step, step, side="right"))
        return FrameIndex(self.step[:n], self.time[:n], self.count[:n], self.offset[:n])


def frame_bytes(fields: Sequence[Field], bodies: int) -> int:
    """Bytes [B] that a frame of so many bodies takes, uncompressed."""
    return bodies * sum(f.row_bytes for f in with_required(fields))


def with_required(fields: Sequence[Field]) -> tuple[Field, ...]:
    """The fields with position and gid, which are always written, in front."""
    others = tuple(f for f in fields if f.name not in ("position", "gid"))
    return (POSITION, GID, *others)


def frame_checksums(index: FrameIndex) -> NDArray:
    """(T,) uint64, over step, time, count and offset of each frame."""
    bits = np.ascontiguousarray(index.time, dtype=np.float64).view(np.int64)
    return row_checksums(np.stack([index.step, bits, index.count, index.offset], axis=1))


@dataclass(frozen=True)
class Layout:
    """The columns and the series of a trajectory."""

    fields: tuple[Field, ...]
    series: tuple[Series, ...] = ()

    def index_datasets(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Type and row shape of the data sets with one row a frame, all but the times."""
        steps = "VTKHDF/Steps"
        names: dict[str, tuple[str, tuple[int, ...]]] = {
            f"{steps}/PartOffsets": ("i8", ()),
            f"{steps}/NumberOfParts": ("i8", ()),
            f"{steps}/PointOffsets": ("i8", ()),
            f"{steps}/CellOffsets": ("i8", (4,)),
            f"{steps}/ConnectivityIdOffsets": ("i8", (4,)),
            "VTKHDF/NumberOfPoints": ("i8", ()),
            "frames/step": ("i8", ()),
            "frames/checksum/frame": ("u8", ()),
        }
        for topology in TOPOLOGIES:
            names[f"VTKHDF/{topology}/NumberOfCells"] = ("i8", ())
            names[f"VTKHDF/{topology}/NumberOfConnectivityIds"] = ("i8", ())
        for topology in TOPOLOGIES[1:]:
            names[f"VTKHDF/{topology}/Offsets"] = ("i8", ())
        names |= {s.name: ("f8", s.row_shape) for s in self.series}
        return names | {
            f"frames/checksum/{part.name}": ("u8", ()) for part in (*self.fields, *self.series)
        }


def root_attributes(file: h5py.File) -> dict[str, Any]:
    """The root attributes that the attribute `checksum` is of."""
    attributes = read_attributes(file)
    return {k: v for k, v in attributes.items() if k not in _UNCHECKED_ATTRIBUTES}


def write_root_attributes(file: h5py.File, attributes: Mapping[str, Any]) -> None:
    """Add attributes and the checksum of all of them.

    The checksum is of what is meant to be there, not of what reads back: through MPI-IO one rank
    writes for all, and the others may read before it has.
    """
    new = {name: plain(value) for name, value in attributes.items()}
    total = attributes_checksum({**root_attributes(file), **new})
    write_attributes(file, {**new, "checksum": np.uint64(total)})


# ---- reading -------------------------------------------------------------------------------


def read_frame(
    source: Path | str | h5py.File, k: int, fields: Sequence[str] | None = None
) -> Frame:
    """Frame k (negative: from the end) of a trajectory file, all fields or those named.

    Raises DataError (65) if the file is damaged or no trajectory, IndexError if there is no such
    frame, KeyError if there is no such field.
    """
    if not isinstance(source, h5py.File):
        with open_checked(source) as file:
            return read_frame(file, k, fields)
    path = Path(source.filename)
    index = read_index(path, source)
    if not -len(index) <= k < len(index):
        raise IndexError(f"{path}: no frame {k}, there are {len(index)}")
    k %= len(index)
    rows = slice(int(index.offset[k]), int(index.offset[k] + index.count[k]))
    known = {f.name: f for f in read_fields(path, source)}
    columns = {name: source[known[name].place][rows] for name in fields or known}
    return Frame(int(index.step[k]), float(index.time[k]), columns)


def read_fields(path: Path, file: h5py.File) -> tuple[Field, ...]:
    try:
        attributes = read_attributes(file)
        if attributes.get("format") != FORMAT:
            raise DataError(f"{path}: not a trajectory of dem-mpi")
        version = attributes.get("format_version")
        if version != FORMAT_VERSION:
            raise DataError(
                f"{path}: trajectory format {version}, this program reads {FORMAT_VERSION}"
            )
        fields = []
        for name in str(read_attribute(file["frames"], "fields")).split():
            dataset = file[name]
            width = dataset.shape[1] if dataset.ndim == 2 else 1
            unit = read_attribute(dataset, "unit")
            fields.append(Field(name, dataset.dtype.str.lstrip("<>=|"), width, unit))
    except HDF5_ERRORS as error:
        raise DataError(f"{path}: damaged: {reason(error)}") from None
    return tuple(fields)


def read_index(path: Path, file: h5py.File) -> FrameIndex:
    """The complete frames, checked against their checksums and against each other."""
    fields = read_fields(path, file)
    try:
        frames = int(read_attribute(file["VTKHDF/Steps"], "NSteps"))
        names = ("step", "time", "count", "offset")
        sizes = {name: file["frames"][name].shape[0] for name in names}
        if not 0 <= frames <= min(sizes.values()):
            raise DataError(f"{path}: {frames} frames claimed, 'frames' holds {sizes}")
        index = FrameIndex(*(file["frames"][name][:frames] for name in names))
        stored = file["frames/checksum/frame"][:frames]
        rows = {f.name: file[f.place].shape[0] for f in fields}
    except HDF5_ERRORS as error:
        raise DataError(f"{path}: damaged: {reason(error)}") from None
    wrong = np.flatnonzero(frame_checksums(index) != stored)
    if len(wrong):
        raise DataError(f"{path}: checksum of 'frames' does not match in frame {wrong[0]}")
    short = next((name for name, size in rows.items() if size < index.rows), None)
    ends = np.concatenate(([0], np.cumsum(index.count)))
    if (index.count < 0).any() or (index.offset != ends[:-1]).any() or short:
        raise DataError(f"{path}: '{short or 'frames/offset'}' contradicts 'frames/count'")
    if (np.diff(index.step) <= 0).any():
        raise DataError(f"{path}: 'frames/step' does not ascend")
    return index


def read_series(path: Path, file: h5py.File) -> tuple[Series, ...]:
    """The series of a trajectory, none in one without. DataError (65) if it is damaged."""
    try:
        names = str(read_attributes(file["frames"]).get("series", "")).split()
        return tuple(
            Series(name, file[name].shape[1:], read_attribute(file[name], "unit")) for name in names
        )
    except HDF5_ERRORS as error:
        raise DataError(f"{path}: damaged: {reason(error)}") from None


def check_series(path: Path, file: h5py.File, series: Sequence[Series], index: FrameIndex) -> None:
    """Compare the checksum of every frame's row. Raises DataError (65) where one differs."""
    n = len(index)
    for one in series:
        values = file[one.name][:n].reshape(n, math.prod(one.row_shape))
        wrong = np.flatnonzero(row_checksums(values) != file[f"frames/checksum/{one.name}"][:n])
        if len(wrong):
            raise DataError(
                f"{path}: checksum of '{one.name}' does not match in frame {wrong[0]} "
                f"(step {index.step[wrong[0]]})"
            )


def expected_checksums(file: h5py.File, fields: Sequence[Field], frames: range) -> NDArray:
    """(len(frames), F) uint64."""
    if not len(frames):
        return np.zeros((0, len(fields)), dtype=np.uint64)
    rows = slice(frames.start, frames.stop)
    return np.stack([file[f"frames/checksum/{f.name}"][rows] for f in fields], axis=1)


def raise_on_mismatch(
    path: Path,
    fields: Sequence[Field],
    index: FrameIndex,
    frames: range,
    actual: NDArray,
    expected: NDArray,
) -> None:
    wrong = np.argwhere(actual != expected)
    if len(wrong):
        k, f = wrong[0]
        raise DataError(
            f"{path}: checksum of '{fields[f].name}' does not match in frame {frames[k]} "
            f"(step {index.step[frames[k]]})"
        )
