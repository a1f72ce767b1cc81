"""The trajectory: one HDF5 file, written by all ranks, that ParaView and h5py open as it is.

`/VTKHDF` follows VTK's temporal PolyData layout: all frames concatenated, each frame one
poly-vertex cell over its bodies, so that all frames share one list 0, 1, 2, … of connectivity.
Beside it the same data stand under plain names (hard links): `f["position"]` and the other fields,
`f["frames/offset"]` and `f["frames/count"]` saying which rows are frame k's, `frames/step` and
`frames/time` [s]. The attribute NSteps of `VTKHDF/Steps` is the number of complete frames; what
stands behind them belongs to a frame that was never finished.

Data sets grow by many frames at a time. A frame then changes no structure: its rows go first, the
number of frames last, with a flush between, so a killed run leaves whole frames. `frames/checksum`
holds a checksum for each frame and field (see `h5files.checksum`).

Symbols: T frames; M rows of all frames; n local rows of one frame; k width of a field.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi import checkpoint
from dem_mpi.errors import DataError, DemError, OutputError
from dem_mpi.h5files import (
    HDF5_ERRORS,
    OutputLock,
    SharedFile,
    agree,
    attributes_checksum,
    checksum,
    dataset_checksum,
    lock_holder,
    open_checked,
    plain,
    read_attribute,
    read_attributes,
    readable_size,
    reason,
    require_space,
    row_blocks,
    row_checksums,
    write_attributes,
)
from dem_mpi.parallel import Parallel

FORMAT = "dem-mpi trajectory"
FORMAT_VERSION = 1

# Object headers with checksums, and chunk indices that every reader since HDF5 1.8 knows.
_LIBVER = ("v108", "v110")
_EXTENT_FRAMES = 16
_EXTENT_BYTES = 1 << 30
_INDEX_CHUNK = 256  # frames
_STRUCTURE_BYTES = 1 << 17  # about what the structures of a new file and of an extension take
_SMALLEST_CHUNK, _LARGEST_CHUNK = 1 << 10, 1 << 16  # rows
_VERIFIED_ON_RESUME = _EXTENT_FRAMES

_TOPOLOGIES = ("Vertices", "Lines", "Strips", "Polygons")


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


# ---- writing -------------------------------------------------------------------------------


class Trajectory:
    """An open trajectory that takes frames. All methods but the properties are collective."""

    def __init__(
        self,
        file: SharedFile,
        lock: OutputLock,
        fields: tuple[Field, ...],
        index: FrameIndex,
        compression: str,
        message: str = "",
    ) -> None:
        """Not for callers: `create` and `open_for_append` make one."""
        self.path = file.path
        self.fields = fields
        self.message = message
        self.frames = len(index)
        self.last_step = int(index.step[-1]) if len(index) else -1
        self._file = file
        self._parallel = file.parallel
        self._lock = lock
        self._compression = compression
        self._rows = index.rows
        self._cells = int(np.count_nonzero(index.count))
        self._largest = int(index.count.max(initial=0))
        self._failed = False
        # Frames, rows and connectivity that have room; how far the connectivity is written.
        self._capacity, self._chunk_rows = _read_capacity(file)
        self._connected = 0

    @classmethod
    def create(
        cls,
        parallel: Parallel,
        path: Path | str,
        fields: Sequence[Field],
        attributes: Mapping[str, Any],
        *,
        bodies: int,
        compression: str = "none",
        through_root: bool | None = None,
    ) -> Trajectory:
        """Collective. Begin a trajectory, replacing a file of that name.

        `bodies` is about how many a frame will have (all ranks together); `compression`, "none"
        or "gzip", is applied when the trajectory is sealed. Raises OutputError if another run
        writes there or the disk cannot hold the first frames.
        """
        lock = OutputLock(parallel, path)
        with _released_on_error(lock):
            return cls._create(
                parallel, path, fields, attributes, lock, bodies, compression, through_root
            )

    @classmethod
    def _create(
        cls,
        parallel: Parallel,
        path: Path | str,
        fields: Sequence[Field],
        attributes: Mapping[str, Any],
        lock: OutputLock,
        bodies: int,
        compression: str,
        through_root: bool | None,
        message: str = "",
    ) -> Trajectory:
        fields = with_required(fields)
        with agree(parallel, path, "write"):
            if parallel.rank == 0:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                require_space(path, _EXTENT_FRAMES * frame_bytes(fields, bodies))
        file = SharedFile(
            parallel,
            path,
            "w",
            libver=_LIBVER,
            through_root=through_root,
            expected_size=_STRUCTURE_BYTES,
        )
        _lay_out(file, fields, parallel.broadcast(dict(attributes)), _chunk_rows(bodies))
        file.sync()
        nothing = np.zeros(0, dtype=np.int64)
        index = FrameIndex(nothing, nothing.astype(np.float64), nothing, nothing)
        return cls(file, lock, fields, index, compression, message)

    @classmethod
    def open_for_append(
        cls,
        parallel: Parallel,
        path: Path | str,
        fields: Sequence[Field],
        attributes: Mapping[str, Any],
        *,
        bodies: int,
        last_step: int,
        compression: str = "none",
        through_root: bool | None = None,
    ) -> Trajectory:
        """Collective. Go on after step `last_step`: later frames are dropped.

        The other arguments are those of `create`, for the case that there is no file, or one that
        cannot be continued (damaged, other fields): that one is kept as `<path>.damaged-<k>` and a
        new one begun. `message` of the result then tells the user; it is "" otherwise.
        """
        path = Path(path)
        lock = OutputLock(parallel, path)
        with _released_on_error(lock):
            try:
                index, filtered = _continuable(parallel, path, with_required(fields), last_step)
            except DemError as error:
                message = _put_aside(parallel, path, error)
                return cls._create(
                    parallel,
                    path,
                    fields,
                    attributes,
                    lock,
                    bodies,
                    compression,
                    through_root,
                    message,
                )
            if filtered:  # compressed rows cannot be appended to safely
                _rewrite(parallel, path, with_required(fields), index, "none", through_root)
            file = SharedFile(parallel, path, "r+", libver=_LIBVER, through_root=through_root)
            with agree(parallel, path, "write"):
                if file.file is not None:
                    _set_in_place(file.file, "complete", 0)
                    _set_in_place(file.file["VTKHDF/Steps"], "NSteps", len(index))
            file.sync()
            return cls(file, lock, with_required(fields), index, compression)

    def write_frame(self, step: int, time: float, columns: Mapping[str, NDArray]) -> None:
        """Collective. Append a frame: {field: this rank's (n,) or (n, k) rows}, n may be 0.

        `step` must be greater than the last frame's. Columns that are no field of this trajectory
        are ignored. Raises OutputError on every rank if the frame cannot be written.
        """
        if step <= self.last_step:
            raise ValueError(f"frame of step {step} after that of step {self.last_step}")
        rows = {
            f.name: np.ascontiguousarray(columns[f.name], dtype=f.dtype).reshape(f.shape(-1))
            for f in self.fields
        }
        n = rows["gid"].shape[0]
        unequal = next((name for name, array in rows.items() if array.shape[0] != n), None)
        self._parallel.raise_together(
            ValueError(f"'{unequal}' has another number of rows than 'gid'") if unequal else None
        )
        try:
            self._write_frame(step, time, rows)
        except OutputError:
            self._failed = True
            raise

    def _write_frame(self, step: int, time: float, rows: Mapping[str, NDArray]) -> None:
        n = rows["gid"].shape[0]
        start, total = self._parallel.exclusive_sum(n), self._parallel.sum(n)
        self._make_room(total)
        self._connect(start, n, total)
        sums = np.array([checksum(rows[f.name], start) for f in self.fields], dtype=np.uint64)
        sums = self._parallel.sum(sums)
        for f in self.fields:
            self._file.write_rows(f.place, self._rows, rows[f.name])
        self._file.write_on_root(self._index_rows(step, time, total, sums))
        self._file.flush()
        with agree(self._parallel, self.path, "write"):
            if self._file.file is not None:
                _set_in_place(self._file.file["VTKHDF/Steps"], "NSteps", self.frames + 1)
        self._file.flush()
        self.frames += 1
        self.last_step = step
        self._rows += total
        self._cells += int(total > 0)
        self._largest = max(self._largest, total)

    def _index_rows(
        self, step: int, time: float, count: int, sums: NDArray
    ) -> dict[str, tuple[int, Any]]:
        """The row of each data set with one row (two for the vertices' offsets) a frame."""
        frame = FrameIndex(*np.array([[step], [0], [count], [self._rows]], dtype=np.int64))
        frame = replace(frame, time=np.array([time], dtype=np.float64))
        cells = int(count > 0)
        vertices, k = "VTKHDF/Vertices", self.frames
        # Every frame adds one offset more than it has cells.
        vertex_offset = self._cells + k
        rows: dict[str, tuple[int, Any]] = {
            "VTKHDF/Steps/Values": (k, [time]),
            "VTKHDF/Steps/PartOffsets": (k, [k]),
            "VTKHDF/Steps/NumberOfParts": (k, [1]),
            "VTKHDF/Steps/PointOffsets": (k, [self._rows]),
            "VTKHDF/Steps/CellOffsets": (k, [[self._cells, 0, 0, 0]]),
            "VTKHDF/Steps/ConnectivityIdOffsets": (k, [[0, 0, 0, 0]]),
            "VTKHDF/NumberOfPoints": (k, [count]),
            f"{vertices}/NumberOfCells": (k, [cells]),
            f"{vertices}/NumberOfConnectivityIds": (k, [count]),
            f"{vertices}/Offsets": (vertex_offset, [0, count][: cells + 1]),
            "frames/step": (k, [step]),
            "frames/checksum/frame": (k, _frame_checksums(frame)),
        }
        for name in _TOPOLOGIES[1:]:
            for part in ("NumberOfCells", "NumberOfConnectivityIds", "Offsets"):
                rows[f"VTKHDF/{name}/{part}"] = (k, [0])
        for f, value in zip(self.fields, sums, strict=True):
            rows[f"frames/checksum/{f.name}"] = (k, np.array([value], dtype=np.uint64))
        return rows

    def _connect(self, start: int, n: int, total: int) -> None:
        """Have the connectivity 0, 1, 2, … reach as far as the largest frame."""
        if total > self._connected:
            ids = np.arange(start, start + n, dtype=np.int64)
            self._file.write_rows("VTKHDF/Vertices/Connectivity", 0, ids)
            self._connected = total

    def _make_room(self, count: int) -> None:
        """Extend the data sets by many frames when the next one, of `count` rows, has no room."""
        old = self._capacity
        frames, rows, connectivity = old
        if self.frames >= frames:
            frames = self.frames + _INDEX_CHUNK
        if self._rows + count > rows:
            size = max(1, frame_bytes(self.fields, count))
            rows = self._rows + count * min(_EXTENT_FRAMES, max(1, _EXTENT_BYTES // size))
        connectivity = max(connectivity, count)
        self._capacity = (frames, rows, connectivity)
        if self._capacity == old:
            return
        self._file.reserve(self._growth(old, self._capacity))
        with agree(self._parallel, self.path, "extend"):
            if self._file.file is not None:
                _set_extents(
                    self._file.file,
                    self.fields,
                    frames=frames,
                    rows=rows,
                    vertex_offsets=2 * frames,
                    connectivity=connectivity,
                )
        self._file.sync()
        self._file.reserve()

    def _growth(self, old: tuple[int, int, int], new: tuple[int, int, int]) -> int:
        """Bytes [B] that extending takes: whole chunks, and the structures that find them."""
        per_frame = sum(8 * width for _, width in _index_datasets(self.fields).values()) + 16
        chunks = [
            -(-b // self._chunk_rows) - a // self._chunk_rows for a, b in zip(old, new, strict=True)
        ]
        size = (new[0] - old[0] + _INDEX_CHUNK) * per_frame
        size += chunks[1] * self._chunk_rows * sum(f.row_bytes for f in self.fields)
        size += chunks[2] * self._chunk_rows * 8
        return size + size // 64 + _STRUCTURE_BYTES

    def sync(self) -> None:
        """Collective. Put all frames on the disk, as before a checkpoint that counts on them."""
        self._file.sync()

    def seal(self, attributes: Mapping[str, Any] | None = None) -> None:
        """Collective. End the trajectory: cut unused room, mark it complete, compress, close."""
        final = self._parallel.broadcast(dict(attributes or {}))
        with agree(self._parallel, self.path, "seal"):
            if self._file.file is not None:
                file = self._file.file
                _set_extents(
                    file,
                    self.fields,
                    frames=self.frames,
                    rows=self._rows,
                    vertex_offsets=self._cells + self.frames,
                    connectivity=self._largest,
                )
                _write_root_attributes(file, final)
                _set_in_place(file, "complete", 1)
        self._file.sync()
        self._file.close()
        if self._compression != "none":
            with (
                agree(self._parallel, self.path, "read", DataError),
                open_checked(self.path) as file,
            ):
                index = _read_index(self.path, file)
            _rewrite(
                self._parallel,
                self.path,
                self.fields,
                index,
                self._compression,
                through_root=not self._file.by_all,
            )
        self.close()

    def close(self) -> None:
        """Collective. Close without sealing; the frames stay, a resumed run goes on after them."""
        try:
            if self._failed:
                self._file.abandon()
            else:
                self._file.close()
        finally:
            self._lock.release()

    def __enter__(self) -> Trajectory:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def _released_on_error(lock: OutputLock) -> Iterator[None]:
    try:
        yield
    except BaseException:
        lock.release()
        raise


def _read_capacity(shared: SharedFile) -> tuple[tuple[int, int, int], int]:
    """Collective. Room for frames, rows and connectivity, and the rows of a chunk."""
    sizes = None
    if shared.file is not None:
        names = ("frames/step", POSITION.place, "VTKHDF/Vertices/Connectivity")
        capacity = tuple(shared.file[name].shape[0] for name in names)
        sizes = (capacity, shared.file[POSITION.place].chunks[0])
    return shared.parallel.broadcast(sizes)


def _set_in_place(item: h5py.Group, name: str, value: int) -> None:
    """Overwrite a number; h5py's own assignment would delete the attribute first."""
    h5py.h5a.open(item.id, name.encode()).write(np.array(value, dtype=np.int64))


def _chunk_rows(bodies: int) -> int:
    return min(_LARGEST_CHUNK, max(_SMALLEST_CHUNK, 1 << (max(1, bodies) - 1).bit_length()))


def _frame_checksums(index: FrameIndex) -> NDArray:
    """(T,) uint64, over step, time, count and offset of each frame."""
    bits = np.ascontiguousarray(index.time, dtype=np.float64).view(np.int64)
    return row_checksums(np.stack([index.step, bits, index.count, index.offset], axis=1))


def _index_datasets(fields: Sequence[Field]) -> dict[str, tuple[str, int]]:
    """Type and width of the data sets with one row a frame."""
    steps = "VTKHDF/Steps"
    names: dict[str, tuple[str, int]] = {
        f"{steps}/Values": ("f8", 1),
        f"{steps}/PartOffsets": ("i8", 1),
        f"{steps}/NumberOfParts": ("i8", 1),
        f"{steps}/PointOffsets": ("i8", 1),
        f"{steps}/CellOffsets": ("i8", 4),
        f"{steps}/ConnectivityIdOffsets": ("i8", 4),
        "VTKHDF/NumberOfPoints": ("i8", 1),
        "frames/step": ("i8", 1),
        "frames/checksum/frame": ("u8", 1),
    }
    for topology in _TOPOLOGIES:
        names[f"VTKHDF/{topology}/NumberOfCells"] = ("i8", 1)
        names[f"VTKHDF/{topology}/NumberOfConnectivityIds"] = ("i8", 1)
    for topology in _TOPOLOGIES[1:]:
        names[f"VTKHDF/{topology}/Offsets"] = ("i8", 1)
    return names | {f"frames/checksum/{f.name}": ("u8", 1) for f in fields}


def _lay_out(
    shared: SharedFile,
    fields: Sequence[Field],
    attributes: Mapping[str, Any],
    chunk_rows: int,
    compression: str = "none",
) -> None:
    """Collective. Create every data set, empty, with links and attributes."""
    with agree(shared.parallel, shared.path, "write"):
        if shared.file is not None:
            _create_datasets(shared, fields, chunk_rows, compression)
            _create_links(shared.file, fields)
            file, own = shared.file, {"format": FORMAT, "format_version": FORMAT_VERSION}
            _write_root_attributes(file, {**attributes, **own})
            file.attrs["complete"] = np.int64(0)
            file["VTKHDF"].attrs["Version"] = np.array([2, 2], dtype=np.int64)
            file["VTKHDF"].attrs["Type"] = np.bytes_(b"PolyData")
            file["VTKHDF/Steps"].attrs["NSteps"] = np.int64(0)
            write_attributes(file["frames"], {"fields": " ".join(f.name for f in fields)})
            for f in fields:
                write_attributes(file[f.place], {"unit": f.unit})
            write_attributes(file["frames/time"], {"unit": "s"})


# What changes without the others, and what is computed from them.
_UNCHECKED_ATTRIBUTES = ("complete", "checksum")


def _root_attributes(file: h5py.File) -> dict[str, Any]:
    """The root attributes that the attribute `checksum` is of."""
    attributes = read_attributes(file)
    return {k: v for k, v in attributes.items() if k not in _UNCHECKED_ATTRIBUTES}


def _write_root_attributes(file: h5py.File, attributes: Mapping[str, Any]) -> None:
    write_attributes(file, attributes)
    file.attrs["checksum"] = np.uint64(attributes_checksum(_root_attributes(file)))


def _create_datasets(
    shared: SharedFile, fields: Sequence[Field], chunk_rows: int, compression: str
) -> None:
    for f in fields:
        shared.create_dataset(
            f.place, f.shape(0), f.dtype, chunk_rows=chunk_rows, compression=compression
        )
    for topology in _TOPOLOGIES:
        shared.create_dataset(f"VTKHDF/{topology}/Connectivity", (0,), "i8", chunk_rows=chunk_rows)
    shared.create_dataset("VTKHDF/Vertices/Offsets", (0,), "i8", chunk_rows=2 * _INDEX_CHUNK)
    for name, (dtype, width) in _index_datasets(fields).items():
        shape = (0,) if width == 1 else (0, width)
        shared.create_dataset(name, shape, dtype, chunk_rows=_INDEX_CHUNK)


def _create_links(file: h5py.File, fields: Sequence[Field]) -> None:
    """Plain names, and the offsets that VTK wants for each field, for data that stand already."""
    steps = file["VTKHDF/Steps"]
    file["frames/time"] = steps["Values"]
    file["frames/count"] = file["VTKHDF/NumberOfPoints"]
    file["frames/offset"] = steps["PointOffsets"]
    offsets = steps.create_group("PointDataOffsets")
    for f in fields:
        file[f.name] = file[f.place]
        if f.name != "position":
            offsets[f.name] = steps["PointOffsets"]


def _set_extents(
    file: h5py.File,
    fields: Sequence[Field],
    *,
    frames: int,
    rows: int,
    vertex_offsets: int,
    connectivity: int,
) -> None:
    sizes = dict.fromkeys(_index_datasets(fields), frames)
    sizes |= {f.place: rows for f in fields}
    sizes["VTKHDF/Vertices/Offsets"] = vertex_offsets
    sizes["VTKHDF/Vertices/Connectivity"] = connectivity
    for name, size in sizes.items():
        dataset = file[name]
        if dataset.shape[0] != size:
            dataset.id.set_extent((size, *dataset.shape[1:]))


# ---- going on after an interruption --------------------------------------------------------


def _continuable(
    parallel: Parallel, path: Path, fields: tuple[Field, ...], last_step: int
) -> tuple[FrameIndex, bool]:
    """Collective. The frames to keep and whether rows are compressed; DemError if unusable."""
    with agree(parallel, path, "read", DataError), open_checked(path) as file:
        found = _read_fields(path, file)
        if found != fields:
            raise DataError(
                f"{path}: holds fields {_names(found)}, this run writes {_names(fields)}"
            )
        index = _read_index(path, file).upto(last_step)
        filtered = any(file[f.place].id.get_create_plist().get_nfilters() for f in fields)
        tail = range(max(0, len(index) - _VERIFIED_ON_RESUME), len(index))
        sums = [
            [dataset_checksum(file[f.place], *_share(parallel, index, k)) for f in fields]
            for k in tail
        ]
        expected = _expected_checksums(file, fields, tail)
    total = parallel.sum(np.array(sums, dtype=np.uint64).reshape(len(tail), len(fields)))
    _raise_on_mismatch(path, fields, index, tail, total, expected)
    return index, filtered


def _names(fields: Sequence[Field]) -> str:
    return ", ".join(f"{f.name} ({f.dtype}, {f.width}, {f.unit})" for f in fields)


def _share(parallel: Parallel, index: FrameIndex, k: int) -> tuple[int, int, int]:
    """The rank's rows [start, stop) of frame k and the place of the first one in the frame."""
    count, offset = int(index.count[k]), int(index.offset[k])
    first = count * parallel.rank // parallel.size
    last = count * (parallel.rank + 1) // parallel.size
    return offset + first, offset + last, first


def _put_aside(parallel: Parallel, path: Path, error: DemError) -> str:
    """Collective. Rename a file that cannot be continued; return what to tell the user."""
    message = ""
    with agree(parallel, path, "rename"):
        if parallel.rank == 0:
            if not path.exists():
                message = f"{path} is missing: the trajectory goes on in a new file of that name"
            else:
                k = 1
                while (kept := path.with_name(f"{path.name}.damaged-{k}")).exists():
                    k += 1
                os.rename(path, kept)
                message = (
                    f"{error}; it is kept as {kept.name} and the trajectory goes on in a new file "
                    f"of the old name"
                )
    return parallel.broadcast(message)


def _rewrite(
    parallel: Parallel,
    path: Path,
    fields: tuple[Field, ...],
    index: FrameIndex,
    compression: str,
    through_root: bool | None,
) -> None:
    """Collective. Copy the frames of `index` to a file with that compression, then replace."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        _copy(parallel, path, temporary, fields, index, compression, through_root)
        with agree(parallel, path, "rename"):
            if parallel.rank == 0:
                temporary.replace(path)
        parallel.barrier()
    except DemError:
        if parallel.rank == 0:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
        raise


def _copy(
    parallel: Parallel,
    path: Path,
    temporary: Path,
    fields: tuple[Field, ...],
    index: FrameIndex,
    compression: str,
    through_root: bool | None,
) -> None:
    with agree(parallel, path, "read", DataError):
        source = open_checked(path)
    with contextlib.closing(source):
        target = SharedFile(parallel, temporary, "w", libver=_LIBVER, through_root=through_root)
        try:
            chunk = source[POSITION.place].chunks[0]
            _lay_out(target, fields, _root_attributes(source), chunk, compression)
            cells = int(np.count_nonzero(index.count))
            sizes = {
                "frames": len(index),
                "rows": index.rows,
                "vertex_offsets": cells + len(index),
                "connectivity": int(index.count.max(initial=0)),
            }
            with agree(parallel, temporary, "extend"):
                if target.file is not None:
                    _set_extents(target.file, fields, **sizes)
                    _set_in_place(target.file, "complete", read_attribute(source, "complete"))
                    _set_in_place(target.file["VTKHDF/Steps"], "NSteps", len(index))
            large = {f.place: index.rows for f in fields}
            large["VTKHDF/Vertices/Connectivity"] = sizes["connectivity"]
            for name, rows in large.items():
                _copy_rows(parallel, source, target, name, rows, chunk)
            small = {name: len(index) for name in _index_datasets(fields)}
            small["VTKHDF/Vertices/Offsets"] = sizes["vertex_offsets"]
            target.write_on_root({k: (0, source[k][:n]) for k, n in small.items() if n})
            target.sync()
        except BaseException:
            target.abandon()
            raise
        target.close()


def _copy_rows(
    parallel: Parallel, source: h5py.File, target: SharedFile, name: str, rows: int, chunk: int
) -> None:
    """Collective. Copy in batches in which every rank has a few chunks."""
    per_rank = chunk * max(1, _LARGEST_CHUNK // chunk)
    for start in range(0, rows, per_rank * parallel.size):
        first = min(rows, start + parallel.rank * per_rank)
        last = min(rows, first + per_rank)
        with agree(parallel, target.path, f"read '{name}'", DataError):
            values = source[name][first:last]
        target.write_rows(name, start, values)


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
    index = _read_index(path, source)
    if not -len(index) <= k < len(index):
        raise IndexError(f"{path}: no frame {k}, there are {len(index)}")
    k %= len(index)
    rows = slice(int(index.offset[k]), int(index.offset[k] + index.count[k]))
    known = {f.name: f for f in _read_fields(path, source)}
    columns = {name: source[known[name].place][rows] for name in fields or known}
    return Frame(int(index.step[k]), float(index.time[k]), columns)


def _read_fields(path: Path, file: h5py.File) -> tuple[Field, ...]:
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


def _read_index(path: Path, file: h5py.File) -> FrameIndex:
    """The complete frames, checked against their checksums and against each other."""
    fields = _read_fields(path, file)
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
    wrong = np.flatnonzero(_frame_checksums(index) != stored)
    if len(wrong):
        raise DataError(f"{path}: checksum of 'frames' does not match in frame {wrong[0]}")
    short = next((name for name, size in rows.items() if size < index.rows), None)
    ends = np.concatenate(([0], np.cumsum(index.count)))
    if (index.count < 0).any() or (index.offset != ends[:-1]).any() or short:
        raise DataError(f"{path}: '{short or 'frames/offset'}' contradicts 'frames/count'")
    if (np.diff(index.step) <= 0).any():
        raise DataError(f"{path}: 'frames/step' does not ascend")
    return index


def _expected_checksums(file: h5py.File, fields: Sequence[Field], frames: range) -> NDArray:
    """(len(frames), F) uint64."""
    if not len(frames):
        return np.zeros((0, len(fields)), dtype=np.uint64)
    rows = slice(frames.start, frames.stop)
    return np.stack([file[f"frames/checksum/{f.name}"][rows] for f in fields], axis=1)


def _raise_on_mismatch(
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


# ---- what is in a file ---------------------------------------------------------------------


@dataclass(frozen=True)
class Description:
    """What a file holds, for people: `exit_code` is 0 if it is valid and 65 if it is not."""

    path: Path
    kind: str  # "trajectory", "checkpoint" or "unknown"
    valid: bool
    reason: str  # why it is not valid, "" if it is
    size: int  # [B]
    complete: bool = False  # a trajectory that was sealed, a checkpoint that is valid
    writer: str = ""  # the process that writes it now
    frames: int = 0
    bodies: tuple[int, int] = (0, 0)  # fewest and most in a frame
    steps: tuple[int, int] = (0, 0)  # first and last
    times: tuple[float, float] = (0.0, 0.0)  # [s]
    fields: tuple[Field, ...] = ()
    ranks: int = 0  # that wrote a checkpoint
    version: str = ""
    scene: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """0 for a valid file, 65 for another."""
        return 0 if self.valid else DataError.exit_code

    def lines(self) -> list[str]:
        """What there is to say, one fact a line."""
        verdict = "valid" if self.valid else f"not valid: {self.reason}"
        lines = [f"{self.path}: {self.kind}, {readable_size(self.size)}, {verdict}"]
        if self.writer:
            lines.append(f"  being written by {self.writer}")
        if self.kind == "unknown" or not (self.frames or self.fields):
            return lines
        if self.scene or self.version:
            lines.append(f"  scene {self.scene or '(no name)'}, by dem-mpi {self.version}")
        fewest, most = self.bodies
        bodies = f"{most:,}" if fewest == most else f"{fewest:,} to {most:,}"
        if self.kind == "checkpoint":
            ranks = f", saved by {self.ranks} ranks" if self.ranks else ""
            lines.append(f"  step {self.steps[0]}, t = {self.times[0]:.6g} s{ranks}")
            return [*lines, f"  {bodies} bodies"]
        state = "complete" if self.complete else "not complete: the run goes on or was ended"
        lines.append(f"  {self.frames:,} frames, {state}")
        if self.frames:
            (first, last), (start, end) = self.steps, self.times
            lines.append(f"  steps {first} to {last}, t = {start:.6g} to {end:.6g} s")
            lines.append(f"  {bodies} bodies")
        return lines + [f"  {f.name} ({f.dtype}, {f.width}) [{f.unit}]" for f in self.fields]


def describe(path: Path | str, *, verify: bool = True) -> Description:
    """What a trajectory or checkpoint holds and whether it is valid; reads all of it to `verify`.

    Raises InputError (64) if there is no such file. A file that is being written can be read.
    """
    path = Path(path)
    size = path.stat().st_size if path.is_file() else 0
    found = Description(path, "unknown", False, "", size, writer=lock_holder(path))
    try:
        with open_checked(path) as file:
            attributes = read_attributes(file)
            if attributes.get("format") == FORMAT:
                return _describe_trajectory(path, file, replace(found, kind="trajectory"), verify)
            if attributes.get("format") != checkpoint.FORMAT:
                raise DataError(f"{path}: neither a trajectory nor a checkpoint of dem-mpi")
        return _describe_checkpoint(path, replace(found, kind="checkpoint"))
    except DataError as error:
        return replace(found, reason=str(error).removeprefix(f"{path}: "))
    except HDF5_ERRORS as error:
        return replace(found, reason=f"damaged: {reason(error)}")


def _describe_trajectory(
    path: Path, file: h5py.File, found: Description, verify: bool
) -> Description:
    attributes = read_attributes(file)
    fields = _read_fields(path, file)
    index = _read_index(path, file)
    found = replace(
        found,
        complete=bool(attributes.get("complete", 0)),
        frames=len(index),
        fields=fields,
        version=str(attributes.get("version", "")),
        scene=_scene_name(attributes),
        attributes=attributes,
    )
    if len(index):
        found = replace(
            found,
            bodies=(int(index.count.min()), int(index.count.max())),
            steps=(int(index.step[0]), int(index.step[-1])),
            times=(float(index.time[0]), float(index.time[-1])),
        )
    try:
        if verify:
            _verify_frames(path, file, fields, index)
            _verify_layout(path, file, index)
            if attributes_checksum(_root_attributes(file)) != attributes.get("checksum"):
                raise DataError(f"{path}: checksum of the attributes does not match")
    except DataError as error:
        return replace(found, reason=str(error).removeprefix(f"{path}: "))
    return replace(found, valid=True)


def _verify_frames(path: Path, file: h5py.File, fields: Sequence[Field], index: FrameIndex) -> None:
    """Compare every checksum; a frame at a time, so that the memory is that of a block."""
    expected = _expected_checksums(file, fields, range(len(index)))
    for k in range(len(index)):
        start, stop = int(index.offset[k]), int(index.offset[k] + index.count[k])
        sums = np.array(
            [[dataset_checksum(file[f.place], start, stop) for f in fields]], dtype=np.uint64
        )
        _raise_on_mismatch(path, fields, index, range(k, k + 1), sums, expected[k : k + 1])


def _verify_layout(path: Path, file: h5py.File, index: FrameIndex) -> None:
    """Compare what only VTK reads with what it must be."""
    n = len(index)
    cells = (index.count > 0).astype(np.int64)
    zeros, first_cell = np.zeros(n, dtype=np.int64), np.cumsum(cells) - cells
    steps, vertices = "VTKHDF/Steps", "VTKHDF/Vertices"
    offsets = np.zeros(int(cells.sum()) + n, dtype=np.int64)
    offsets[(first_cell + np.arange(n) + 1)[cells > 0]] = index.count[cells > 0]
    expected = {
        f"{steps}/PartOffsets": np.arange(n),
        f"{steps}/NumberOfParts": zeros + 1,
        f"{steps}/CellOffsets": np.stack([first_cell, zeros, zeros, zeros], axis=1),
        f"{steps}/ConnectivityIdOffsets": np.zeros((n, 4)),
        f"{vertices}/NumberOfCells": cells,
        f"{vertices}/NumberOfConnectivityIds": index.count,
        f"{vertices}/Offsets": offsets,
    }
    for name in _TOPOLOGIES[1:]:
        for part in ("NumberOfCells", "NumberOfConnectivityIds", "Offsets"):
            expected[f"VTKHDF/{name}/{part}"] = zeros
    for name, values in expected.items():
        if not np.array_equal(file[name][: len(values)], values):
            raise DataError(f"{path}: '{name}' contradicts 'frames/count'")
    connectivity = file[f"{vertices}/Connectivity"]
    for start, stop in row_blocks(0, int(index.count.max(initial=0)), 8):
        if not np.array_equal(connectivity[start:stop], np.arange(start, stop)):
            raise DataError(f"{path}: '{connectivity.name}' is not 0, 1, 2, …")


def _describe_checkpoint(path: Path, found: Description) -> Description:
    problem = checkpoint.find_damage(path)
    if problem:
        return replace(found, reason=problem)
    with open_checked(path) as file:
        attributes = checkpoint.read_attributes_of(file)
        step, ranks = int(read_attribute(file, "step")), int(read_attribute(file, "ranks"))
        time = float(attributes.get("time", 0.0))
        bodies = int(file["rows/bodies"][:].sum()) if "rows/bodies" in file else 0
    return replace(
        found,
        valid=True,
        complete=True,
        frames=1,
        bodies=(bodies, bodies),
        steps=(step, step),
        times=(time, time),
        ranks=ranks,
        version=str(attributes.get("version", "")),
        scene=_scene_name(attributes),
        attributes=attributes,
    )


def _scene_name(attributes: Mapping[str, Any]) -> str:
    """The name in the effective scene, which is stored as JSON."""
    try:
        scene = json.loads(attributes.get("scene", "{}"))
        return str(scene.get("name", ""))
    except (ValueError, TypeError, AttributeError, RecursionError):
        return ""
