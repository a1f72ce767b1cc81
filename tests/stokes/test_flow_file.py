"""Flow files: written whole or not at all, on any number of ranks, read back and by VTK."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import replace
from itertools import pairwise

import h5py
import numpy as np
import pytest

from dem_mpi.parallel import Parallel
from stokes.flow_file import (
    BODY_COLUMNS,
    Flow,
    FlowField,
    Grid,
    Surfaces,
    flow_bytes,
    read_flow,
    write_flow,
)

from runs import contents

ATTRIBUTES = {"version": "1.2.3", "viscosity": 1e-3, "converged": 1, "frame": 7, "text": "größe"}
GRIDS = ((4, 5), (6, 7))  # nodes along and about the axis


def ball(grid: tuple[int, int], centre: np.ndarray, radius: float) -> dict[str, np.ndarray]:
    """Nodes of a sphere at the middles of equal angles, the density in the direction of z."""
    rings, azimuths = grid
    theta = np.pi * (np.arange(rings) + 0.5) / rings
    phi = 2.0 * np.pi * np.arange(azimuths) / azimuths
    normal = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.sin(theta), np.sin(phi)),
            np.outer(np.cos(theta), np.ones(azimuths)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    return {
        "position": centre + radius * normal,
        "normal": normal,
        "weight": np.full(len(normal), radius**2),
        "density": np.outer(np.arange(len(normal)), [0.0, 0.0, radius]),
    }


def flow_of(count: int, take=slice(None), field: FlowField | None = None) -> Flow:
    """Some of `count` spheres of random places, with every column of the bodies."""
    rng = np.random.default_rng(1)
    columns = {name: rng.standard_normal((count, *s)) for name, (s, _) in BODY_COLUMNS.items()}
    columns |= {"gid": 5 + 2 * np.arange(count), "shape": np.arange(count) % 3}
    columns = {name: values[take] for name, values in columns.items()}
    grid = np.array(GRIDS)[np.arange(count) % 2][take]
    parts = [
        ball(tuple(g), centre, 0.1 * gid)
        for g, centre, gid in zip(grid, columns["position"], columns["gid"], strict=True)
    ]
    empty = {"position": (0, 3), "normal": (0, 3), "weight": (0,), "density": (0, 3)}
    surfaces = {
        name: np.concatenate([np.zeros(shape), *(part[name] for part in parts)])
        for name, shape in empty.items()
    }
    return Flow(columns, Surfaces(grid.reshape(-1, 2), **surfaces), ATTRIBUTES, field)


def on_grid(grid: Grid, first: int = 0, last: int | None = None) -> FlowField:
    points = grid.points(first, last)
    return FlowField(points @ np.diag([1.0, 2.0, 3.0]), points.sum(axis=1), grid=grid)


GRID = Grid.over([0.0, 1.0, 2.0], [1.0, 2.0, 4.0], (2, 3, 5))


def equal(a: Flow, b: Flow) -> bool:
    """Whether two flows agree to the bit."""
    pairs = [(a.bodies[name], b.bodies[name]) for name in {*a.bodies, *b.bodies}]
    assert set(a.surfaces.columns) == set(b.surfaces.columns)
    pairs += [(a.surfaces.grid, b.surfaces.grid)]
    pairs += [(a.surfaces.columns[n], b.surfaces.columns[n]) for n in a.surfaces.columns]
    if a.field is not None or b.field is not None:
        assert a.field.grid == b.field.grid
        pairs += [(getattr(a.field, n), getattr(b.field, n)) for n in ("velocity", "pressure")]
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.fixture
def alone():
    return Parallel.alone()


@pytest.mark.parametrize("field", [None, on_grid(GRID)], ids=["no field", "grid"])
def test_a_flow_comes_back_as_it_was(alone, tmp_path, field):
    flow = flow_of(4, field=field)
    write_flow(alone, tmp_path / "flow.h5", flow, np.arange(4))
    back = read_flow(tmp_path / "flow.h5")
    assert equal(flow, back)
    assert back.attributes.items() >= ATTRIBUTES.items()
    assert os.listdir(tmp_path) == ["flow.h5"]


def test_a_double_layer_comes_back_too(alone, tmp_path):
    flow = flow_of(3)
    surfaces = replace(flow.surfaces, double_density=2.0 * flow.surfaces.position)
    flow = replace(flow, surfaces=surfaces)
    write_flow(alone, tmp_path / "flow.h5", flow, np.arange(3))
    assert equal(flow, read_flow(tmp_path / "flow.h5"))


def test_a_field_at_points_comes_back_with_its_points(alone, tmp_path):
    points = np.random.default_rng(0).random((6, 3))
    field = FlowField(2.0 * points, points[:, 0], position=points)
    write_flow(alone, tmp_path / "flow.h5", flow_of(1, field=field), np.arange(1))
    back = read_flow(tmp_path / "flow.h5").field
    np.testing.assert_array_equal(back.position, points)
    np.testing.assert_array_equal(back.velocity, 2.0 * points)
    assert back.grid is None


def test_bodies_stand_in_the_rows_that_they_are_given(alone, tmp_path):
    flow, rows = flow_of(5), np.array([3, 0, 4, 1, 2])
    write_flow(alone, tmp_path / "flow.h5", flow, rows)
    back = read_flow(tmp_path / "flow.h5")
    np.testing.assert_array_equal(back.bodies["gid"][rows], flow.bodies["gid"])
    for k in range(5):
        there = slice(*back.surfaces.offset[rows[k] : rows[k] + 2])
        here = slice(*flow.surfaces.offset[k : k + 2])
        np.testing.assert_array_equal(back.surfaces.density[there], flow.surfaces.density[here])


@pytest.mark.mpi(ranks=[2, 3, 8])
def test_every_number_of_ranks_writes_the_same_file(parallel, shared_path):
    count = 5
    mine = np.arange(parallel.rank, count, parallel.size)[::-1]  # one rank in eight has none
    share = [GRID.size * (parallel.rank + k) // parallel.size for k in (0, 1)]
    write_flow(parallel, shared_path / "flow.h5", flow_of(count, mine, on_grid(GRID, *share)), mine)
    if parallel.rank == 0:
        whole = shared_path / "whole.h5"
        write_flow(Parallel.alone(), whole, flow_of(count, field=on_grid(GRID)), np.arange(count))
        # but for the seconds at which HDF5 made the groups
        assert contents(shared_path / "flow.h5") == contents(whole)
    parallel.barrier()


@pytest.mark.mpi(ranks=[1, 3])
def test_what_cannot_be_written_is_an_error_on_every_rank(parallel, shared_path):
    mine = np.arange(parallel.rank, 5, parallel.size)
    (shared_path / "there").mkdir(exist_ok=True)
    for place, words in ((shared_path / "none" / "flow.h5", "none"), (shared_path / "there", "t")):
        with pytest.raises(OSError, match=words):
            write_flow(parallel, place, flow_of(5, mine), mine)
    with pytest.raises(ValueError, match="rows"):
        write_flow(parallel, shared_path / "flow.h5", flow_of(5, mine), 0 * mine)
    flow = flow_of(5, mine)
    wrong = {**flow.bodies, "colour": flow.bodies["gid"]} if parallel.rank == 0 else flow.bodies
    with pytest.raises(ValueError, match="no such column of bodies: colour"):
        write_flow(parallel, shared_path / "flow.h5", replace(flow, bodies=wrong), mine)
    assert sorted(p.name for p in shared_path.iterdir()) == ["there"]


def test_a_file_that_is_not_replaced_stays_as_it_was(alone, tmp_path, monkeypatch):
    path = tmp_path / "flow.h5"
    write_flow(alone, path, flow_of(2), np.arange(2))
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("stokes.flow_file._to_disk", full)
    with pytest.raises(OSError, match=r"flow\.h5: cannot write: No space left on device"):
        write_flow(alone, path, flow_of(3), np.arange(3))
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["flow.h5"]


def test_plain_names_have_units(alone, tmp_path):
    write_flow(alone, tmp_path / "flow.h5", flow_of(3, field=on_grid(GRID)), np.arange(3))
    with h5py.File(tmp_path / "flow.h5") as file:
        units = {
            f"{group}/{name}": item.attrs["unit"].decode()
            for group in ("bodies", "surfaces", "field")
            for name, item in file[group].items()
            if "unit" in item.attrs
        }
        assert file["bodies/force"].shape == (3, 3) and file["field/velocity"].shape == (5, 3, 2, 3)
    assert units["bodies/force"] == "N" and units["bodies/stresslet"] == "N m"
    assert units["surfaces/density"] == "Pa" and units["field/velocity"] == "m/s"
    assert set(BODY_COLUMNS) <= {name.removeprefix("bodies/") for name in units}


def test_estimated_size_is_close_for_large_files(alone, tmp_path):
    grid = Grid.over([0, 0, 0], [1, 1, 1], (40, 40, 40))
    write_flow(alone, tmp_path / "flow.h5", flow_of(400, field=on_grid(grid)), np.arange(400))
    nodes = 200 * sum(a * b for a, b in GRIDS)
    size = (tmp_path / "flow.h5").stat().st_size
    assert size <= flow_bytes(400, nodes, grid.size) <= 2 * size


# ---- damage -------------------------------------------------------------------------------------


@pytest.fixture
def written(alone, tmp_path):
    path = tmp_path / "flow.h5"
    write_flow(alone, path, flow_of(3, field=on_grid(GRID)), np.arange(3))
    return path


def test_a_changed_byte_of_any_data_set_is_found(written):
    with h5py.File(written) as file:
        places = {}

        def add(name, item):
            if isinstance(item, h5py.Dataset) and item.chunks and name.split("/")[0] != "VTKHDF":
                chunk = item.id.get_chunk_info(0)
                places[name] = (chunk.byte_offset, chunk.size)

        for name in ("bodies", "surfaces", "field"):
            file[name].visititems(lambda n, item, g=name: add(f"{g}/{n}", item))
    assert {"bodies/force", "surfaces/density", "field/velocity"} <= set(places)
    whole = written.read_bytes()
    for name, (offset, size) in places.items():
        damaged = bytearray(whole)
        damaged[offset + size // 2] ^= 0x10
        written.write_bytes(damaged)
        with h5py.File(written) as file, pytest.raises(OSError):
            file[name][()]
        with pytest.raises(ValueError, match="no readable flow file"):
            read_flow(written)


def test_other_files_are_refused_in_one_line(written, tmp_path):
    with pytest.raises(FileNotFoundError):
        read_flow(tmp_path / "none.h5")
    other = tmp_path / "other.h5"
    for content in (b"", b"no HDF5", written.read_bytes()[:5000]):
        other.write_bytes(content)
        with pytest.raises(ValueError, match="no readable flow file") as caught:
            read_flow(other)
        assert "\n" not in str(caught.value)
    with h5py.File(other, "w") as file:
        file["bodies/position"] = 1.0
    with pytest.raises(ValueError, match="not a flow file"):
        read_flow(other)


def test_links_by_name_are_not_followed(written, tmp_path):
    with h5py.File(written, "r+") as file:
        del file["bodies/force"]
        file["bodies/force"] = h5py.ExternalLink(tmp_path / "secret.h5", "/x")
    with pytest.raises(ValueError, match="'force' is missing, or a link by name"):
        read_flow(written)


# ---- grids and polygons -------------------------------------------------------------------------


def test_a_grid_runs_from_corner_to_corner_x_fastest():
    points = GRID.points()
    np.testing.assert_array_equal(points[0], [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(points[1], [1.0, 1.0, 2.0])
    np.testing.assert_array_equal(points[-1], [1.0, 2.0, 4.0])
    np.testing.assert_array_equal(points[7:11], GRID.points(7, 11))
    flat = Grid.over([0.0, 1.0, 2.0], [1.0, 2.0, 4.0], (3, 1, 2))
    np.testing.assert_array_equal(flat.points()[:, 1], 1.5)


def test_polygons_close_the_surface_and_face_outwards(written):
    flow = read_flow(written)
    with h5py.File(written) as file:
        ids = file["VTKHDF/surfaces/Polygons/Connectivity"][:]
        ends = file["VTKHDF/surfaces/Polygons/Offsets"][:]
    edges: dict[tuple[int, int], int] = {}
    body = np.repeat(np.arange(3), np.diff(flow.surfaces.offset))
    for first, last in pairwise(ends):
        corners = ids[first:last]
        assert len(set(body[corners])) == 1
        place = flow.surfaces.position[corners]
        area = np.cross(place[1] - place[0], place[2] - place[1])
        middle = place.mean(axis=0) - flow.bodies["position"][body[corners[0]]]
        assert area @ middle > 0.0
        for edge in zip(corners, np.roll(corners, -1), strict=True):
            edges[edge] = edges.get(edge, 0) + 1
    # A closed surface without a seam: each edge once in either direction.
    assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)


@pytest.mark.skipif(
    importlib.util.find_spec("vtk") is None, reason="the extra `render` is not installed"
)
def test_vtk_opens_bodies_surfaces_and_field(written):
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkHDFReader()
    assert reader.CanReadFile(str(written))
    reader.SetFileName(str(written))
    reader.Update()
    collection = reader.GetOutputDataObject(0)
    name = vtk.vtkCompositeDataSet.NAME()
    blocks = {
        collection.GetMetaData(i).Get(name): collection.GetPartition(i, 0)
        for i in range(collection.GetNumberOfPartitionedDataSets())
    }
    assert list(blocks) == ["bodies", "surfaces", "field"]

    def column(block, key):
        return vtk_to_numpy(blocks[block].GetPointData().GetArray(key))

    flow = read_flow(written)
    np.testing.assert_array_equal(column("bodies", "force"), flow.bodies["force"])
    stresslet = flow.bodies["stresslet"].reshape(-1, 9)
    np.testing.assert_array_equal(column("bodies", "stresslet"), stresslet)
    np.testing.assert_array_equal(column("surfaces", "density"), flow.surfaces.density)
    cells = sum((rings - 1) * azimuths + 2 for rings, azimuths in flow.surfaces.grid)
    assert blocks["surfaces"].GetNumberOfPolys() == cells
    np.testing.assert_array_equal(column("field", "velocity"), flow.field.velocity)
    assert blocks["field"].GetDimensions() == GRID.dimensions
    place = [blocks["field"].GetPoint(k) for k in range(GRID.size)]
    np.testing.assert_allclose(place, GRID.points(), rtol=1e-15)
