"""Flow files: bodies, their surfaces and the flow around them, as ParaView and h5py open them.

`/VTKHDF` is a collection of two or three blocks in VTK's own format (ParaView 5.13 or newer):

    bodies      a point a body: force [N], torque and stresslet [N m], velocity, ...
    surfaces    the nodes on the surfaces, joined to polygons: density [Pa], weight [m^2], normal;
                double_density [m/s] where there is a double layer
    field       velocity [m/s] and pressure [Pa] on a regular grid, or at points

Beside it the same data stand under plain names (hard links): `f["bodies/force"]`,
`f["surfaces/density"]`, `f["field/velocity"]`. Body b owns the nodes `surfaces/offset[b]` to
`surfaces/offset[b + 1]`, `surfaces/grid[b]` = (n_s, n_theta) of them in C order, from the north
pole to the south pole of its axis. What holds for the whole file are attributes of its root.

A file is written under another name, put on the disk, and renamed: where there is one, it is
whole. Every data set carries HDF5's checksums, so that a changed byte is an error and no number.

Symbols: b bodies, n nodes, m points of the field; of one rank, or of all in the file.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel

FORMAT = "stokes flow"
FORMAT_VERSION = 1

# What HDF5's errors come as.
_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError, OverflowError)
_LIBVER = ("v108", "v110")
_CHUNK_ROWS = 1 << 14
_SLACK = 1 << 20  # bytes that a data set may claim without having them
_TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")

# Columns of the bodies: shape of a row and unit. `position` are the centres.
BODY_COLUMNS: Mapping[str, tuple[tuple[int, ...], str]] = {
    "gid": ((), "1"),
    "position": ((3,), "m"),
    "orientation": ((4,), "1"),
    "shape": ((), "1"),
    "radius": ((), "m"),
    "half_length": ((), "m"),
    "velocity": ((3,), "m/s"),
    "angular_velocity": ((3,), "rad/s"),
    "force": ((3,), "N"),
    "torque": ((3,), "N m"),
    "stresslet": ((3, 3), "N m"),
}
_INTEGERS = ("gid", "shape")
_SURFACE_UNITS = {
    "position": "m",
    "normal": "1",
    "weight": "m^2",
    "density": "Pa",
    "double_density": "m/s",
}
_FIELD_UNITS = {"position": "m", "velocity": "m/s", "pressure": "Pa"}


@dataclass(frozen=True)
class Surfaces:
    """Nodes of bodies, one body's behind the other's.

    grid : (b, 2) rings n_s and azimuths n_theta of each; position, normal : (n, 3);
    weight : (n,) of surface integrals; density, double_density : (n, 3) rho and mu of the layers
    that make the disturbance, u = S rho / viscosity + D mu, None without a double layer
    """

    grid: NDArray
    position: NDArray
    normal: NDArray
    weight: NDArray
    density: NDArray
    double_density: NDArray | None = None

    @property
    def columns(self) -> dict[str, NDArray]:
        """What there is of every node, by name."""
        columns = {name: getattr(self, name) for name in _SURFACE_UNITS}
        return {name: values for name, values in columns.items() if values is not None}

    @property
    def offset(self) -> NDArray:
        """(b + 1,) first node of each body, and how many there are."""
        return np.concatenate([[0], np.cumsum(np.prod(self.grid, axis=1, dtype=np.int64))])


@dataclass(frozen=True)
class Grid:
    """A regular grid of dimensions (nx, ny, nz); in flat order x runs fastest, z slowest."""

    dimensions: tuple[int, int, int]
    origin: tuple[float, float, float]
    spacing: tuple[float, float, float]

    @property
    def size(self) -> int:
        """Number of points."""
        return math.prod(self.dimensions)

    @classmethod
    def over(cls, low: NDArray, high: NDArray, dimensions: tuple[int, int, int]) -> Grid:
        """The grid whose first and last point are two corners, (3,) each; one point: the middle."""
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        count = np.array(dimensions)
        spacing = (high - low) / np.maximum(count - 1, 1)
        origin = np.where(count == 1, 0.5 * (low + high), low)
        spacing = np.where(spacing > 0.0, spacing, 1.0)
        return cls(tuple(dimensions), tuple(origin.tolist()), tuple(spacing.tolist()))

    def points(self, first: int = 0, last: int | None = None) -> NDArray:
        """Points [first, last) in flat order, (last - first, 3)."""
        flat = np.arange(first, self.size if last is None else last)
        nx, ny, _ = self.dimensions
        index = np.stack([flat % nx, flat // nx % ny, flat // (nx * ny)], axis=1)
        return np.array(self.origin) + index * np.array(self.spacing)


@dataclass(frozen=True)
class FlowField:
    """Velocity (m, 3) and pressure (m,) on a grid, in flat order, or at points (m, 3)."""

    velocity: NDArray
    pressure: NDArray
    grid: Grid | None = None
    position: NDArray | None = None

    def __post_init__(self) -> None:
        """ValueError unless it has either a grid or points."""
        if (self.grid is None) == (self.position is None):
            raise ValueError("a field stands either on a grid or at points")


@dataclass(frozen=True)
class Flow:
    """What a flow file holds. Columns of the bodies as in `BODY_COLUMNS`, (b, ...) each."""

    bodies: Mapping[str, NDArray]
    surfaces: Surfaces
    attributes: Mapping[str, Any]
    field: FlowField | None = None


def flow_bytes(bodies: int, nodes: int, points: int) -> int:
    """About how large [B] a file of so many bodies, nodes and points of the field is."""
    return 100_000 + 500 * bodies + 8 * nodes * (3 + 3 + 1 + 3 + 1 + 5) + 8 * points * 8


# ---- writing -------------------------------------------------------------------------------


def write_flow(parallel: Parallel, path: Path | str, flow: Flow, rows: NDArray) -> None:
    """Collective. Write a flow file, replacing one of that name when the new one is whole.

    flow : this rank's bodies with their surfaces, and its points of the field, of which the file
    has rank 0's first; rows (b,) : where the bodies stand in the file, each from 0 on once.
    All ranks give the same attributes, numbers and texts, and the same grid. Rank 0 holds every
    array of the file once. Raises OSError on all ranks if it cannot be written: a file of that
    name is then as it was; ValueError for a column that is not in `BODY_COLUMNS`.
    """
    path = Path(path)
    unknown = sorted(set(flow.bodies) - set(BODY_COLUMNS))
    parallel.raise_together(
        ValueError(f"no such column of bodies: {', '.join(unknown)}") if unknown else None
    )
    order = _gathered(parallel, np.asarray(rows, dtype=np.int64))
    whole = _gathered_flow(parallel, flow)
    error: Exception | None = None
    if order is not None and whole is not None:
        if not np.array_equal(np.sort(order), np.arange(len(order))):
            error = ValueError("rows: must count the bodies of all ranks from 0")
        else:
            try:
                _write_in_place(path, _sorted(whole, np.argsort(order)))
            except _ERRORS as caught:
                error = OSError(f"{path}: cannot write: {_first_line(caught)}")
    parallel.raise_together(error)


def _gathered_flow(parallel: Parallel, flow: Flow) -> Flow | None:
    """Collective. The flow of all ranks, bodies and points in rank order, on rank 0."""
    bodies = {name: _gathered(parallel, flow.bodies[name]) for name in sorted(flow.bodies)}
    parts = {"grid": flow.surfaces.grid, **flow.surfaces.columns}
    surfaces = {name: _gathered(parallel, values) for name, values in parts.items()}
    values = None
    if flow.field is not None:
        names = ("velocity", "pressure", *(["position"] if flow.field.grid is None else []))
        values = {name: _gathered(parallel, getattr(flow.field, name)) for name in names}
    if parallel.rank:
        return None
    field = None if values is None else FlowField(grid=flow.field.grid, **values)
    return Flow(bodies, Surfaces(**surfaces), flow.attributes, field)


def _sorted(flow: Flow, place: NDArray) -> Flow:
    """The flow with body place[b] in row b."""
    given = flow.surfaces
    start, size = given.offset[place], np.diff(given.offset)[place]
    # A body's nodes move together: from where they start to where those before them end.
    shift = start - (np.cumsum(size) - size)
    nodes = np.arange(given.offset[-1]) + np.repeat(shift, size)
    columns = {name: values[nodes] for name, values in given.columns.items()}
    surfaces = Surfaces(given.grid[place], **columns)
    bodies = {name: column[place] for name, column in flow.bodies.items()}
    return Flow(bodies, surfaces, flow.attributes, flow.field)


def _gathered(parallel: Parallel, array: NDArray) -> NDArray | None:
    """Collective. The ranks' rows, in rank order, on rank 0."""
    blocks = list(parallel.blocks_on_root(np.ascontiguousarray(array)))
    return np.concatenate(blocks) if parallel.rank == 0 else None


def _write_in_place(path: Path, flow: Flow) -> None:
    temporary = path.with_name(f"{path.name}.part")
    try:
        with h5py.File(temporary, "w", libver=_LIBVER, locking=False) as file:
            _write(file, flow)
        _to_disk(temporary)
        temporary.replace(path)
        _to_disk(path.absolute().parent)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write(file: h5py.File, flow: Flow) -> None:
    _attributes(file, {**flow.attributes, "format": FORMAT, "format_version": FORMAT_VERSION})
    # VTK takes the blocks in the order in which they were made.
    root = file.create_group("VTKHDF", track_order=True)
    root.attrs["Version"] = np.array([2, 2], dtype=np.int64)
    root.attrs["Type"] = np.bytes_(b"PartitionedDataSetCollection")
    _write_bodies(file, root, flow.bodies)
    _write_surfaces(file, root, flow.surfaces, flow.bodies.get("gid"))
    if flow.field is not None:
        _write_field(file, root, flow.field)
    # VTK asks for this tree; its leaves would be links by name, and the blocks do without.
    root.create_group("Assembly", track_order=True)


def _write_bodies(file: h5py.File, root: h5py.Group, bodies: Mapping[str, NDArray]) -> None:
    count = len(bodies["position"])
    block = _block(root, "bodies", b"PolyData", 0)
    _write_points(block, bodies["position"], np.arange(count), np.arange(count + 1), "Vertices")
    for name in (n for n in BODY_COLUMNS if n in bodies and n != "position"):
        dtype = np.int64 if name in _INTEGERS else np.float64
        # VTK knows vectors and tensors as columns.
        shape = (count, math.prod(BODY_COLUMNS[name][0])) if BODY_COLUMNS[name][0] else (count,)
        _dataset(block, f"PointData/{name}", bodies[name].astype(dtype).reshape(shape))
    _link(file, "bodies", block, {name: BODY_COLUMNS[name][1] for name in bodies})


def _write_surfaces(
    file: h5py.File, root: h5py.Group, surfaces: Surfaces, gid: NDArray | None
) -> None:
    block = _block(root, "surfaces", b"PolyData", 1)
    connectivity, offsets = _polygons(surfaces.grid, surfaces.offset[:-1])
    _write_points(block, surfaces.position, connectivity, offsets, "Polygons")
    columns = surfaces.columns
    for name, values in columns.items():
        if name != "position":
            _dataset(block, f"PointData/{name}", values)
    if gid is not None:
        _dataset(block, "PointData/gid", np.repeat(gid, np.diff(surfaces.offset)))
    group = _link(file, "surfaces", block, {name: _SURFACE_UNITS[name] for name in columns})
    _dataset(group, "grid", surfaces.grid.astype(np.int64))
    _dataset(group, "offset", surfaces.offset)


def _write_field(file: h5py.File, root: h5py.Group, values: FlowField) -> None:
    block = _block(root, "field", b"ImageData" if values.grid else b"PolyData", 2)
    units = dict(_FIELD_UNITS)
    shape: tuple[int, ...] = (-1,)
    if values.grid is not None:
        grid = values.grid
        extent = [end for n in grid.dimensions for end in (0, n - 1)]
        block.attrs["WholeExtent"] = np.array(extent, dtype=np.int64)
        block.attrs["Origin"] = np.array(grid.origin)
        block.attrs["Spacing"] = np.array(grid.spacing)
        block.attrs["Direction"] = np.eye(3).ravel()
        shape = grid.dimensions[::-1]
        del units["position"]
    else:
        count = len(values.position)
        _write_points(block, values.position, np.arange(count), np.arange(count + 1), "Vertices")
    _dataset(block, "PointData/velocity", values.velocity.reshape(*shape, 3))
    _dataset(block, "PointData/pressure", values.pressure.reshape(shape))
    _link(file, "field", block, units)


def _block(root: h5py.Group, name: str, kind: bytes, index: int) -> h5py.Group:
    block = root.create_group(name, track_order=True)
    block.attrs["Version"] = np.array([2, 2], dtype=np.int64)
    block.attrs["Type"] = np.bytes_(kind)
    block.attrs["Index"] = np.int64(index)
    return block


def _write_points(
    block: h5py.Group, points: NDArray, connectivity: NDArray, offsets: NDArray, kind: str
) -> None:
    """Points with the cells of one kind that join them; VTK wants all four kinds."""
    _dataset(block, "Points", points)
    block["NumberOfPoints"] = np.array([len(points)], dtype=np.int64)
    for name in _TOPOLOGIES:
        ids, ends = (connectivity, offsets) if name == kind else (offsets[:0], offsets[:1])
        block[f"{name}/NumberOfCells"] = np.array([len(ends) - 1], dtype=np.int64)
        block[f"{name}/NumberOfConnectivityIds"] = np.array([len(ids)], dtype=np.int64)
        _dataset(block, f"{name}/Connectivity", ids.astype(np.int64))
        _dataset(block, f"{name}/Offsets", ends.astype(np.int64))


def _polygons(grid: NDArray, start: NDArray) -> tuple[NDArray, NDArray]:
    """Quadrangles between rings and a polygon at each pole, of bodies whose nodes begin at `start`.

    Corners run round against the clock as seen from outside. Returns ids and (cells + 1,) offsets.
    """
    ids, sizes = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for rings, azimuths in np.unique(grid, axis=0):
        if azimuths < 3:
            continue
        node = np.arange(rings * azimuths).reshape(rings, azimuths)
        east = np.roll(node, -1, axis=1)
        quads = np.stack([node[:-1], node[1:], east[1:], east[:-1]], axis=-1)
        pattern = np.concatenate([quads.ravel(), node[0], node[-1, ::-1]])
        of_this_grid = (grid == (rings, azimuths)).all(axis=1)
        ids.append((start[of_this_grid, None] + pattern).ravel())
        corners = np.append(np.full((rings - 1) * azimuths, 4), [azimuths, azimuths])
        sizes.append(np.tile(corners, np.count_nonzero(of_this_grid)))
    return np.concatenate(ids), np.concatenate([[0], np.cumsum(np.concatenate(sizes))])


def _dataset(group: h5py.Group, name: str, values: NDArray) -> None:
    """A data set with a checksum of every chunk; one without elements can have none."""
    options: dict[str, Any] = {}
    if values.size:
        rows = max(1, _CHUNK_ROWS // math.prod(values.shape[1:]))
        options = {"chunks": (min(len(values), rows), *values.shape[1:]), "fletcher32": True}
    group.create_dataset(name, data=np.ascontiguousarray(values), track_times=False, **options)


def _link(file: h5py.File, name: str, block: h5py.Group, units: Mapping[str, str]) -> h5py.Group:
    """Plain names, with units, for data that stand already."""
    group = file.create_group(name)
    for column, unit in units.items():
        item = block["Points" if column == "position" else f"PointData/{column}"]
        _attributes(item, {"unit": unit})
        group[column] = item
    return group


def _attributes(target: h5py.HLObject, attributes: Mapping[str, Any]) -> None:
    """Numbers and texts; these of fixed length, for those of variable length have no checksum."""
    for name, value in attributes.items():
        if isinstance(value, str):
            text = value.encode()
            kind = h5py.string_dtype("utf-8", max(1, len(text)))
            target.attrs.create(name, np.array(text, dtype=kind))
        else:
            target.attrs[name] = value


# ---- reading -------------------------------------------------------------------------------


def read_flow(path: Path | str) -> Flow:
    """A whole flow file. Raises ValueError, one line, if it is damaged or none; OSError if absent.

    Links by name and data in other files are not followed.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with h5py.File(path, "r", locking=False) as file:
            return _read(file)
    except _ERRORS as error:
        raise ValueError(f"{path}: no readable flow file: {_first_line(error)}") from None


def _read(file: h5py.File) -> Flow:
    attributes = {name: _plain(file.attrs[name]) for name in file.attrs}
    if attributes.get("format") != FORMAT:
        raise ValueError("not a flow file")
    if attributes.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"format {attributes.get('format_version')}, this program reads {FORMAT_VERSION}"
        )
    group = _member(file, "bodies", h5py.Group)
    bodies = {name: _values(group, name) for name in BODY_COLUMNS if name in group}
    count = len(bodies["position"])
    bodies = {n: v.reshape(count, *BODY_COLUMNS[n][0]) for n, v in bodies.items()}
    group = _member(file, "surfaces", h5py.Group)
    names = [name for name in _SURFACE_UNITS if name != "double_density" or name in group]
    surfaces = Surfaces(**{name: _values(group, name) for name in ("grid", *names)})
    agree = np.array_equal(_values(group, "offset"), surfaces.offset)
    if not agree or len(surfaces.grid) != count or len(surfaces.position) != surfaces.offset[-1]:
        raise ValueError("'surfaces' contradicts itself or 'bodies'")
    values = _read_field(file) if "field" in file else None
    return Flow(bodies, surfaces, attributes, values)


def _read_field(file: h5py.File) -> FlowField:
    group = _member(file, "field", h5py.Group)
    velocity = _values(group, "velocity").reshape(-1, 3)
    pressure = _values(group, "pressure").ravel()
    if "position" in group:
        return FlowField(velocity, pressure, position=_values(group, "position"))
    image = file["VTKHDF/field"]
    dimensions = tuple(int(n) + 1 for n in image.attrs["WholeExtent"][1::2])
    origin, spacing = (tuple(image.attrs[name].tolist()) for name in ("Origin", "Spacing"))
    grid = Grid(dimensions, origin, spacing)
    if grid.size != len(velocity):
        raise ValueError("'field/velocity' contradicts the extent of its grid")
    return FlowField(velocity, pressure, grid=grid)


def _member(group: h5py.Group, name: str, kind: type) -> Any:
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"'{name}' is missing, or a link by name")
    item = group[name]
    if not isinstance(item, kind):
        raise ValueError(f"'{name}' is no {kind.__name__.lower()}")
    return item


def _values(group: h5py.Group, name: str) -> NDArray:
    data = _member(group, name, h5py.Dataset)
    if data.external or data.is_virtual or data.dtype.kind not in "fiu" or data.shape is None:
        raise ValueError(f"'{data.name}' holds no plain numbers of its own")
    if data.size * data.dtype.itemsize > data.id.get_storage_size() + _SLACK:
        raise ValueError(f"'{data.name}' claims shape {data.shape}, more than the file holds")
    return data[()]


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def _first_line(error: BaseException) -> str:
    text = str(error.strerror if isinstance(error, OSError) and error.strerror else error)
    return next((line.strip() for line in text.splitlines() if line.strip()), type(error).__name__)
