"""The trajectory: one HDF5 file, written by all ranks, that ParaView and h5py open as it is.

`/VTKHDF` follows VTK's temporal PolyData layout: all frames concatenated, each frame one
poly-vertex cell over its bodies, so that all frames share one list 0, 1, 2, … of connectivity.
Beside it the same data stand under plain names (hard links): `f["position"]` and the other fields,
`f["frames/offset"]` and `f["frames/count"]` saying which rows are frame k's, `frames/step` and
`frames/time` [s]. Series, what a frame has once, such as `f["walls/force"]`, have a row a frame.
The attribute NSteps of `VTKHDF/Steps` is the number of complete frames; what stands behind them
belongs to a frame that was never finished.

Data sets grow by many frames at a time. A frame then moves nothing in the file: its rows go first,
the number of frames last, with a flush between, so a killed run leaves whole frames.
`frames/checksum` holds a checksum for each frame and field (see `h5files.checksum`).

Symbols: T frames; M rows of all frames; n local rows of one frame; k width of a field.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi.describe import Description, describe
from dem_mpi.errors import DataError, DemError, OutputError
from dem_mpi.h5files import (
    OutputLock,
    SharedFile,
    agree,
    checksum,
    dataset_checksum,
    open_checked,
    read_attribute,
    require_space,
    row_checksums,
    write_attributes,
)
from dem_mpi.parallel import Parallel
from dem_mpi.trajectory import (
    FORMAT,
    FORMAT_VERSION,
    GID,
    POSITION,
    TIMES,
    TOPOLOGIES,
    Field,
    Frame,
    FrameIndex,
    Layout,
    Series,
    check_series,
    expected_checksums,
    frame_bytes,
    frame_checksums,
    raise_on_mismatch,
    read_fields,
    read_frame,
    read_index,
    read_series,
    root_attributes,
    with_required,
    write_root_attributes,
)

# What users of trajectories need, in one place.
__all__ = [
    "GID",
    "POSITION",
    "Description",
    "Field",
    "Frame",
    "FrameIndex",
    "Series",
    "Trajectory",
    "describe",
    "frame_bytes",
    "read_frame",
    "with_required",
]

# Object headers with checksums, and chunk indices that every reader since HDF5 1.8 knows.
_LIBVER = ("v108", "v110")
_EXTENT_FRAMES = 16
_EXTENT_BYTES = 1 << 30
_INDEX_CHUNK = 256  # frames
_TIMES_CHUNK = 4096  # frames; the times alone grow with each frame, within a chunk if possible
_STRUCTURE_BYTES = 1 << 17  # about what the structures of a new file and of an extension take
_SMALLEST_CHUNK, _LARGEST_CHUNK = 1 << 10, 1 << 16  # rows
_VERIFIED_ON_RESUME = _EXTENT_FRAMES


# ---- writing -------------------------------------------------------------------------------


class Trajectory:
    """An open trajectory that takes frames. All methods but the properties are collective."""

    def __init__(
        self,
        file: SharedFile,
        lock: OutputLock,
        layout: Layout,
        index: FrameIndex,
        compression: str,
        message: str = "",
    ) -> None:
        """Not for callers: `create` and `open_for_append` make one."""
        self.path = file.path
        self.layout = layout
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
        series: Sequence[Series] = (),
        compression: str = "none",
        through_root: bool | None = None,
    ) -> Trajectory:
        """Collective. Begin a trajectory, replacing a file of that name.

        `bodies` is about how many a frame will have (all ranks together); `compression`, "none"
        or "gzip", is applied when the trajectory is sealed. Raises OutputError if another run
        writes there or the disk cannot hold the first frames.
        """
        lock = OutputLock(parallel, path)
        layout = Layout(with_required(fields), tuple(series))
        with _released_on_error(lock):
            return cls._create(
                parallel, path, layout, attributes, lock, bodies, compression, through_root
            )

    @classmethod
    def _create(
        cls,
        parallel: Parallel,
        path: Path | str,
        layout: Layout,
        attributes: Mapping[str, Any],
        lock: OutputLock,
        bodies: int,
        compression: str,
        through_root: bool | None,
        message: str = "",
    ) -> Trajectory:
        with agree(parallel, path, "write"):
            if parallel.rank == 0:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                require_space(path, _EXTENT_FRAMES * frame_bytes(layout.fields, bodies))
        file = SharedFile(
            parallel,
            path,
            "w",
            libver=_LIBVER,
            through_root=through_root,
            expected_size=_STRUCTURE_BYTES,
        )
        _lay_out(file, layout, parallel.broadcast(dict(attributes)), _chunk_rows(bodies))
        file.sync()
        nothing = np.zeros(0, dtype=np.int64)
        index = FrameIndex(nothing, nothing.astype(np.float64), nothing, nothing)
        return cls(file, lock, layout, index, compression, message)

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
        series: Sequence[Series] = (),
        compression: str = "none",
        through_root: bool | None = None,
    ) -> Trajectory:
        """Collective. Go on after step `last_step`: later frames are dropped.

        The other arguments are those of `create`, for the case that there is no file, or one that
        cannot be continued (damaged, other fields): that one is kept as `<path>.damaged-<k>` and a
        new one begun. `message` of the result then tells the user; it is "" otherwise.
        """
        path = Path(path)
        layout = Layout(with_required(fields), tuple(series))
        lock = OutputLock(parallel, path)
        with _released_on_error(lock):
            try:
                index, filtered = _continuable(parallel, path, layout, last_step)
            except DemError as error:
                message = _put_aside(parallel, path, error)
                return cls._create(
                    parallel,
                    path,
                    layout,
                    attributes,
                    lock,
                    bodies,
                    compression,
                    through_root,
                    message,
                )
            if filtered:  # compressed rows cannot be appended to safely
                _rewrite(parallel, path, layout, index, "none", through_root)
            file = SharedFile(parallel, path, "r+", libver=_LIBVER, through_root=through_root)
            with agree(parallel, path, "write"):
                if file.file is not None:
                    _set_in_place(file.file, "complete", 0)
                    _set_in_place(file.file["VTKHDF/Steps"], "NSteps", len(index))
                    _set_extent(file.file, TIMES, len(index))
            file.sync()
            return cls(file, lock, layout, index, compression)

    def write_frame(
        self,
        step: int,
        time: float,
        columns: Mapping[str, NDArray],
        series: Mapping[str, NDArray] | None = None,
    ) -> None:
        """Collective. Append a frame: {field: this rank's (n,) or (n, k) rows}, n may be 0.

        `series` has the row of each series, of which rank 0's is written.

        `step` must be greater than the last frame's. Columns that are no field of this trajectory
        are ignored. Raises OutputError on every rank if the frame cannot be written.
        """
        if step <= self.last_step:
            raise ValueError(f"frame of step {step} after that of step {self.last_step}")
        rows = {
            f.name: np.ascontiguousarray(columns[f.name], dtype=f.dtype).reshape(f.shape(-1))
            for f in self.layout.fields
        }
        once = {
            s.name: np.ascontiguousarray((series or {})[s.name], np.float64).reshape(s.row_shape)
            for s in self.layout.series
        }
        n = rows["gid"].shape[0]
        unequal = next((name for name, array in rows.items() if array.shape[0] != n), None)
        self._parallel.raise_together(
            ValueError(f"'{unequal}' has another number of rows than 'gid'") if unequal else None
        )
        try:
            self._write_frame(step, time, rows, once)
        except OutputError:
            self._failed = True
            raise

    def _write_frame(
        self, step: int, time: float, rows: Mapping[str, NDArray], once: Mapping[str, NDArray]
    ) -> None:
        n = rows["gid"].shape[0]
        start, total = self._parallel.exclusive_sum(n), self._parallel.sum(n)
        self._make_room(total)
        self._connect(start, n, total)
        own = [checksum(rows[f.name], start) for f in self.layout.fields]
        sums = self._parallel.sum(np.array(own, dtype=np.uint64))
        for f in self.layout.fields:
            self._file.write_rows(f.place, self._rows, rows[f.name])
        with agree(self._parallel, self.path, "extend"):
            if self._file.file is not None:
                _set_extent(self._file.file, TIMES, self.frames + 1)
        self._file.write_on_root(
            self._index_rows(step, time, total, sums) | self._series_rows(once)
        )
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
            TIMES: (k, [time]),
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
            "frames/checksum/frame": (k, frame_checksums(frame)),
        }
        for name in TOPOLOGIES[1:]:
            for part in ("NumberOfCells", "NumberOfConnectivityIds", "Offsets"):
                rows[f"VTKHDF/{name}/{part}"] = (k, [0])
        for f, value in zip(self.layout.fields, sums, strict=True):
            rows[f"frames/checksum/{f.name}"] = (k, np.array([value], dtype=np.uint64))
        return rows

    def _series_rows(self, once: Mapping[str, NDArray]) -> dict[str, tuple[int, Any]]:
        """The row of each series, and of its checksum."""
        rows: dict[str, tuple[int, Any]] = {}
        for name, values in once.items():
            rows[name] = (self.frames, values[None])
            sums = row_checksums(values.reshape(1, -1))
            rows[f"frames/checksum/{name}"] = (self.frames, sums)
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
            size = max(1, frame_bytes(self.layout.fields, count))
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
                    self.layout,
                    frames=frames,
                    rows=rows,
                    vertex_offsets=2 * frames,
                    connectivity=connectivity,
                )
        self._file.sync()
        self._file.reserve()

    def _growth(self, old: tuple[int, int, int], new: tuple[int, int, int]) -> int:
        """Bytes [B] that extending takes: whole chunks, and the structures that find them."""
        shapes = [shape for _, shape in self.layout.index_datasets().values()]
        per_frame = sum(8 * math.prod(shape) for shape in shapes) + 16
        chunks = [
            -(-b // self._chunk_rows) - a // self._chunk_rows for a, b in zip(old, new, strict=True)
        ]
        size = (new[0] - old[0] + _INDEX_CHUNK) * per_frame
        size += chunks[1] * self._chunk_rows * sum(f.row_bytes for f in self.layout.fields)
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
                    self.layout,
                    frames=self.frames,
                    rows=self._rows,
                    vertex_offsets=self._cells + self.frames,
                    connectivity=self._largest,
                )
                write_root_attributes(file, final)
                _set_in_place(file, "complete", 1)
        self._file.sync()
        self._file.close()
        if self._compression != "none":
            with (
                agree(self._parallel, self.path, "read", DataError),
                open_checked(self.path) as file,
            ):
                index = read_index(self.path, file)
            _rewrite(
                self._parallel,
                self.path,
                self.layout,
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


def _lay_out(
    shared: SharedFile,
    layout: Layout,
    attributes: Mapping[str, Any],
    chunk_rows: int,
    compression: str = "none",
) -> None:
    """Collective. Create every data set, empty, with links and attributes."""
    with agree(shared.parallel, shared.path, "write"):
        if shared.file is not None:
            _create_datasets(shared, layout, chunk_rows, compression)
            _create_links(shared.file, layout.fields)
            file, own = shared.file, {"format": FORMAT, "format_version": FORMAT_VERSION}
            write_root_attributes(file, {**attributes, **own})
            file.attrs["complete"] = np.int64(0)
            file["VTKHDF"].attrs["Version"] = np.array([2, 2], dtype=np.int64)
            file["VTKHDF"].attrs["Type"] = np.bytes_(b"PolyData")
            file["VTKHDF/Steps"].attrs["NSteps"] = np.int64(0)
            names = {"fields": layout.fields, "series": layout.series}
            write_attributes(
                file["frames"], {k: " ".join(part.name for part in v) for k, v in names.items()}
            )
            for f in layout.fields:
                write_attributes(file[f.place], {"unit": f.unit})
            for series in layout.series:
                write_attributes(file[series.name], {"unit": series.unit})
            write_attributes(file["frames/time"], {"unit": "s"})


def _create_datasets(shared: SharedFile, layout: Layout, chunk_rows: int, compression: str) -> None:
    for f in layout.fields:
        shared.create_dataset(
            f.place, f.shape(0), f.dtype, chunk_rows=chunk_rows, compression=compression
        )
    for topology in TOPOLOGIES:
        shared.create_dataset(f"VTKHDF/{topology}/Connectivity", (0,), "i8", chunk_rows=chunk_rows)
    shared.create_dataset("VTKHDF/Vertices/Offsets", (0,), "i8", chunk_rows=2 * _INDEX_CHUNK)
    shared.create_dataset(TIMES, (0,), "f8", chunk_rows=_TIMES_CHUNK)
    for name, (dtype, row_shape) in layout.index_datasets().items():
        shared.create_dataset(name, (0, *row_shape), dtype, chunk_rows=_INDEX_CHUNK)


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
    layout: Layout,
    *,
    frames: int,
    rows: int,
    vertex_offsets: int,
    connectivity: int,
) -> None:
    sizes = dict.fromkeys(layout.index_datasets(), frames)
    sizes |= {f.place: rows for f in layout.fields}
    sizes["VTKHDF/Vertices/Offsets"] = vertex_offsets
    sizes["VTKHDF/Vertices/Connectivity"] = connectivity
    for name, size in sizes.items():
        _set_extent(file, name, size)


def _set_extent(file: h5py.File, name: str, size: int) -> None:
    dataset = file[name]
    if dataset.shape[0] != size:
        dataset.id.set_extent((size, *dataset.shape[1:]))


# ---- going on after an interruption --------------------------------------------------------


def _continuable(
    parallel: Parallel, path: Path, layout: Layout, last_step: int
) -> tuple[FrameIndex, bool]:
    """Collective. The frames to keep and whether rows are compressed; DemError if unusable."""
    with agree(parallel, path, "read", DataError), open_checked(path) as file:
        fields = layout.fields
        found = Layout(read_fields(path, file), read_series(path, file))
        if found != layout:
            raise DataError(
                f"{path}: holds fields {_names(found)}, this run writes {_names(layout)}"
            )
        index = read_index(path, file).upto(last_step)
        check_series(path, file, layout.series, index)
        filtered = any(file[f.place].id.get_create_plist().get_nfilters() for f in fields)
        tail = range(max(0, len(index) - _VERIFIED_ON_RESUME), len(index))
        sums = [
            [dataset_checksum(file[f.place], *_share(parallel, index, k)) for f in fields]
            for k in tail
        ]
        expected = expected_checksums(file, fields, tail)
    total = parallel.sum(np.array(sums, dtype=np.uint64).reshape(len(tail), len(fields)))
    raise_on_mismatch(path, fields, index, tail, total, expected)
    return index, filtered


def _names(layout: Layout) -> str:
    names = [f"{f.name} ({f.dtype}, {f.width}, {f.unit})" for f in layout.fields]
    return ", ".join(names + [f"{s.name} ({s.row_shape}, {s.unit})" for s in layout.series])


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
    layout: Layout,
    index: FrameIndex,
    compression: str,
    through_root: bool | None,
) -> None:
    """Collective. Copy the frames of `index` to a file with that compression, then replace."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        _copy(parallel, path, temporary, layout, index, compression, through_root)
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
    layout: Layout,
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
            _lay_out(target, layout, root_attributes(source), chunk, compression)
            cells = int(np.count_nonzero(index.count))
            sizes = {
                "frames": len(index),
                "rows": index.rows,
                "vertex_offsets": cells + len(index),
                "connectivity": int(index.count.max(initial=0)),
            }
            with agree(parallel, temporary, "extend"):
                if target.file is not None:
                    _set_extents(target.file, layout, **sizes)
                    _set_extent(target.file, TIMES, len(index))
                    _set_in_place(target.file, "complete", read_attribute(source, "complete"))
                    _set_in_place(target.file["VTKHDF/Steps"], "NSteps", len(index))
            large = {f.place: index.rows for f in layout.fields}
            large["VTKHDF/Vertices/Connectivity"] = sizes["connectivity"]
            for name, rows in large.items():
                _copy_rows(parallel, source, target, name, rows, chunk)
            small = dict.fromkeys([TIMES, *layout.index_datasets()], len(index))
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
