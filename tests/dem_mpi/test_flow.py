"""The Stokes step from a trajectory to a flow file: exact drags, ranks, faults, pictures."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from dem_mpi import __version__
from dem_mpi.errors import DataError, InputError, OutputError
from dem_mpi.flow import flow_file
from dem_mpi.flow_options import parse_options
from dem_mpi.parallel import Parallel
from stokes.exact import sphere_pressure, sphere_velocity, spheroid_resistance
from stokes.flow_file import Flow, read_flow

from flow_runs import DENSITIES, columns_of, touching_pile, write_run
from launch import ROOT, run_ranks
from runs import LEAVING, messages, simulate

TOLERANCE = 1e-4
VISCOSITY = 1.3
SPIN = (0.3, -0.2, 0.5)


def flow_of(path: Path, **options) -> tuple[int, list[str], Flow | None]:
    """Exit code, lines and flow file of one rank."""
    said: list[str] = []
    out = options.pop("out", path.with_name("flow.h5"))
    options = {"viscosity": VISCOSITY, "tolerance": TOLERANCE, **options}
    code = flow_file(Parallel.alone(), path, parse_options(out=out, **options), said.append)
    return code, said, read_flow(out) if out.exists() else None


def sphere(tmp_path: Path, **columns) -> Path:
    """A run with one sphere of radius 0.2 m that is not in the origin."""
    return write_run(tmp_path / "run.h5", columns_of([[0.5, -1.0, 2.0]], 0.2, **columns))


@pytest.fixture(scope="module")
def pile(tmp_path_factory) -> Path:
    """Three spheres that overlap by a thousandth of a radius."""
    return write_run(tmp_path_factory.mktemp("pile") / "run.h5", touching_pile(3, 0.1))


# ---- exact answers ----------------------------------------------------------------------------


def test_drag_and_torque_of_a_sphere_are_those_of_stokes(tmp_path):
    velocity = np.array([0.1, 0.2, -0.3])
    path = sphere(tmp_path, velocity=velocity, angular_velocity=SPIN)
    code, _, flow = flow_of(path)
    assert code == 0 and flow.attributes["converged"] == 1
    drag = -6.0 * np.pi * VISCOSITY * 0.2 * velocity
    torque = -8.0 * np.pi * VISCOSITY * 0.2**3 * np.array(SPIN)
    np.testing.assert_allclose(
        flow.bodies["force"][0], drag, rtol=0, atol=1e-4 * np.abs(drag).max()
    )
    np.testing.assert_allclose(
        flow.bodies["torque"][0], torque, rtol=0, atol=1e-4 * np.abs(torque).max()
    )
    # The single layer is the traction: its integral is what the force balances.
    surfaces = flow.surfaces
    np.testing.assert_allclose(surfaces.weight @ surfaces.density, -drag, rtol=0, atol=1e-4)
    assert surfaces.weight.sum() == pytest.approx(4.0 * np.pi * 0.2**2, rel=1e-9)


def test_bodies_that_move_with_the_background_feel_nothing(tmp_path):
    # In a shear u_x = 2 (z - 2) a sphere at z = 2 turns with half the vorticity.
    path = sphere(tmp_path, velocity=(0.3, 0, 0), angular_velocity=(0, 1.0, 0))
    code, _, flow = flow_of(path, background=["uniform:0.3,0,0", "shear:2,xz@0,0,2"])
    assert code == 0
    assert np.abs(flow.bodies["force"]).max() < TOLERANCE * VISCOSITY * 0.2
    assert np.abs(flow.bodies["torque"]).max() < TOLERANCE * VISCOSITY * 0.2**2
    # Stresslet of a sphere in a strain E: 20/3 pi viscosity a^3 E (Batchelor), E_xz = 1.
    stresslet = 20.0 / 3.0 * np.pi * VISCOSITY * 0.2**3
    expected = np.zeros((3, 3))
    expected[0, 2] = expected[2, 0] = stresslet
    np.testing.assert_allclose(
        np.abs(flow.bodies["stresslet"][0]), expected, rtol=0, atol=1e-4 * stresslet
    )


@pytest.mark.parametrize("factor", ["auto", "0.8"])
def test_a_heavy_sphere_sinks_at_the_speed_of_stokes(tmp_path, factor):
    path = sphere(tmp_path)
    code, said, flow = flow_of(
        path, problem="mobility", fluid_density=900.0, hydrodynamic_radius=factor
    )
    assert code == 0
    size = 1.0 if factor == "auto" else 0.8  # its weight is that of the whole sphere
    weight = (DENSITIES["glass"] - 900.0) * 4.0 / 3.0 * np.pi * 0.2**3 * 9.81
    speed = weight / (6.0 * np.pi * VISCOSITY * 0.2 * size)
    np.testing.assert_allclose(
        flow.bodies["velocity"], [[0.0, 0.0, -speed]], rtol=0, atol=1e-4 * speed
    )
    assert flow.bodies["radius"][0] == pytest.approx(0.2 * size)
    assert flow.attributes["fluid_density"] == 900.0
    assert any("warning: Reynolds number" in line for line in said)


def test_gravity_can_be_another_than_the_runs(tmp_path):
    path = sphere(tmp_path)
    _, _, flow = flow_of(path, problem="mobility", gravity=(2.0, 0.0, 0.0))
    assert flow.bodies["velocity"][0, 0] > 0.0
    assert abs(flow.bodies["velocity"][0, 2]) < 1e-4 * flow.bodies["velocity"][0, 0]


def test_a_run_that_knows_no_gravity_must_be_told_it(tmp_path):
    path = write_run(tmp_path / "run.h5", columns_of([[0, 0, 0]], 0.2), gravity=None)
    with pytest.raises(InputError, match="--gravity: "):
        flow_of(path, problem="mobility")


def test_a_turned_spheroid_has_its_two_resistances(tmp_path):
    half = np.sqrt(0.5)
    columns = columns_of(
        [[0, 0, 0]], 0.1, "spheroid", 0.2, (half, 0, half, 0), velocity=(0.3, 0.4, 0.0)
    )
    code, _, flow = flow_of(write_run(tmp_path / "run.h5", columns))
    assert code == 0
    exact = spheroid_resistance(0.1, 0.2, VISCOSITY)
    drag = [0.3 * exact.translation_axial, 0.4 * exact.translation_transverse, 0.0]
    expected = -np.array(drag)
    np.testing.assert_allclose(flow.bodies["force"][0], expected, rtol=0, atol=1e-4)


def test_spheres_spheroids_and_rods_stand_in_one_flow(tmp_path):
    columns = columns_of(
        [[0, 0, 0], [0.5, 0, 0], [0, 0.6, 0.1]],
        0.1,
        ["sphere", "spheroid", "spherocylinder"],
        [0.0, 0.25, 0.2],
        [(1, 0, 0, 0), (0.8, 0.6, 0, 0), (0.6, 0, 0.8, 0)],
        velocity=(0.0, 0.0, -1.0),
        gid=[7, 3, 5],
    )
    code, said, flow = flow_of(write_run(tmp_path / "run.h5", columns), tolerance=1e-3)
    assert code == 0
    assert flow.bodies["gid"].tolist() == [3, 5, 7]
    assert flow.bodies["shape"].tolist() == [2, 1, 0]
    assert "1 sphere, 1 spherocylinder, 1 spheroid" in said[0]
    # All are dragged upwards, less than alone, a sphere of 0.1 m less than the others.
    force = flow.bodies["force"][:, 2]
    assert (force > 0.0).all() and force.argmin() == 2
    assert force[2] < 6.0 * np.pi * VISCOSITY * 0.1


# ---- what the file says -----------------------------------------------------------------------


def test_the_file_says_where_it_came_from_and_how_it_was_made(pile, tmp_path):
    code, said, flow = flow_of(
        pile, out=tmp_path / "flow.h5", bodies="0-1", background=["uniform:0,0,0.5"], tolerance=1e-3
    )
    assert code == 0
    attributes = flow.attributes
    assert attributes["size_factor"] == pytest.approx(1.999 / 2.01, rel=1e-14)
    assert attributes["least_gap"] == pytest.approx(1e-2, rel=1e-9)
    expected = {
        "version": __version__,
        "units": "SI: m, kg, s, N, Pa",
        "source": str(pile),
        "frame": 0,
        "time": 0.0,
        "bodies_of_frame": 3,
        "problem": "resistance",
        "viscosity": VISCOSITY,
        "background": "uniform:0,0,0.5",
        "tolerance": 1e-3,
        "formulation": "single",
        "converged": 1,
    }
    assert attributes.items() >= expected.items()
    assert attributes["residual"] <= 1e-3 and attributes["iterations"] >= 1
    assert f"{1.999 / 2.01:.6g} of the run's" in said[1] and "bodies 0 and 1" in said[1]
    assert any("left out: the other bodies" in line for line in said)
    np.testing.assert_allclose(flow.bodies["radius"], 0.1 * attributes["size_factor"])


def test_walls_and_periodic_copies_that_are_left_out_are_named(tmp_path):
    path = write_run(
        tmp_path / "run.h5",
        columns_of([[0, 0, 0]], 0.2),
        leave_out=["angular_velocity"],
        walls=[{}],
        domain={"periodic": ["x", "y"]},
    )
    _, said, flow = flow_of(path, tolerance=1e-2)
    assert "note: left out: walls, periodic copies along x, y of the run" in said
    assert any("taken not to turn" in line for line in said)
    assert "taken not to turn" in flow.attributes["assumed"]


def test_a_flow_that_has_not_converged_is_written_flagged_and_ends_with_70(pile, tmp_path):
    code, said, flow = flow_of(pile, out=tmp_path / "flow.h5", max_iterations=1)
    assert code == 70
    assert flow.attributes["converged"] == 0 and flow.attributes["residual"] > TOLERANCE
    assert flow.attributes["reason"]
    assert any(line.startswith("NOT CONVERGED") for line in said)


def test_velocity_and_pressure_on_a_grid_are_those_of_stokes(tmp_path):
    path = sphere(tmp_path, velocity=(0.0, 0.0, 1.0))
    _, _, flow = flow_of(path, grid="3,4,5", box=(0.2, 0.8, -1.3, -0.7, 1.6, 2.9))
    grid = flow.field.grid
    assert grid.dimensions == (3, 4, 5)
    d = grid.points() - [0.5, -1.0, 2.0]
    r = np.linalg.norm(d, axis=1)
    inside = r < 0.2
    assert np.isnan(flow.field.velocity[inside]).all() and 0 < inside.sum() < len(r) / 2
    motion = (0.0, 0.0, 1.0)
    u = sphere_velocity(d[~inside], 0.2, motion, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(flow.field.velocity[~inside], u, rtol=0, atol=2e-4)
    p = sphere_pressure(d[~inside], 0.2, motion, VISCOSITY)
    # Pressures count in viscosity speed / radius.
    np.testing.assert_allclose(flow.field.pressure[~inside], p, rtol=0, atol=1e-3 * VISCOSITY / 0.2)


def test_the_field_at_listed_points_is_that_of_the_grid(pile, tmp_path):
    box = (0.0, 0.4, 0.15, 0.3, -0.2, 0.2)
    _, _, gridded = flow_of(pile, out=tmp_path / "grid.h5", grid="3,2,2", box=box, tolerance=1e-3)
    points = gridded.field.grid.points()
    (tmp_path / "points.csv").write_text(
        "x,y,z\n" + "".join(f"{x!r},{y!r},{z!r}\n" for x, y, z in points.tolist())
    )
    _, _, listed = flow_of(
        pile, out=tmp_path / "points.h5", points=tmp_path / "points.csv", tolerance=1e-3
    )
    np.testing.assert_array_equal(listed.field.position, points)
    np.testing.assert_allclose(listed.field.velocity, gridded.field.velocity, rtol=0, atol=1e-14)


def test_a_grid_without_a_box_holds_all_bodies(pile, tmp_path):
    _, _, flow = flow_of(pile, out=tmp_path / "flow.h5", grid="4,2,2", tolerance=1e-2)
    points = flow.field.grid.points()
    assert (points.min(axis=0) < flow.bodies["position"].min(axis=0) - 0.1).all()
    assert (points.max(axis=0) > flow.bodies["position"].max(axis=0) + 0.1).all()


# ---- estimates and refusals -------------------------------------------------------------------


def test_a_dry_run_tells_nodes_memory_and_seconds_and_writes_nothing(pile, tmp_path):
    code, said, flow = flow_of(pile, out=tmp_path / "flow.h5", dry_run=True, tolerance=1e-3)
    assert code == 0 and flow is None and os.listdir(tmp_path) == []
    told = {line.split()[0]: line for line in said}
    assert {"nodes", "memory", "seconds", "file"} <= set(told)
    _, again, flow = flow_of(pile, out=tmp_path / "flow.h5", tolerance=1e-3)
    nodes = int(told["nodes"].split()[1].replace(",", ""))
    assert nodes == len(flow.surfaces.position)
    assert told["seconds"] in again  # no clock has a say


def test_what_exceeds_the_memory_is_refused_before_any_work(pile, tmp_path, monkeypatch):
    monkeypatch.setattr("dem_mpi.flow.memory_share", lambda _: 50 << 20)
    monkeypatch.setattr("stokes.suspension.Suspension.solve", None)
    with pytest.raises(InputError) as caught:
        flow_of(pile, out=tmp_path / "flow.h5")
    for words in ("nodes would take about", "this machine has 50.0 MiB", "--tolerance"):
        assert words in str(caught.value)
    assert os.listdir(tmp_path) == []
    assert flow_of(pile, out=tmp_path / "flow.h5", dry_run=True)[0] == 0


def test_a_file_that_exists_is_replaced_only_by_force(pile, tmp_path):
    out = tmp_path / "flow.h5"
    out.write_text("mine")
    with pytest.raises(InputError, match=r"exists; --force replaces it"):
        flow_of(pile, out=out)
    assert out.read_text() == "mine"
    assert flow_of(pile, out=out, force=True, tolerance=1e-2)[0] == 0
    with pytest.raises(InputError, match=r"is the trajectory itself"):
        flow_of(pile, out=pile, force=True)
    for place, words in (
        (tmp_path, "is a directory"),
        (tmp_path / "no" / "flow.h5", "there is no"),
    ):
        with pytest.raises(InputError, match=words):
            flow_of(pile, out=place)


def test_bodies_that_touch_at_the_size_that_is_given_are_refused(pile, tmp_path):
    with pytest.raises(InputError, match=r"bodies 0 and 1 touch or overlap"):
        flow_of(pile, out=tmp_path / "flow.h5", hydrodynamic_radius="1")


def test_a_gap_that_is_too_small_is_refused_with_both_bodies(tmp_path):
    columns = columns_of([[0, 0, 0], [0.20001, 0, 0]], 0.1, velocity=(1.0, 0, 0))
    with pytest.raises(InputError, match=r"bodies 0 and 1 are 0\.0001 radii apart"):
        flow_of(write_run(tmp_path / "run.h5", columns), hydrodynamic_radius="1")


def test_wrong_points_are_refused(pile, tmp_path):
    points = tmp_path / "points.csv"
    with pytest.raises(DataError, match="no such file"):
        flow_of(pile, out=tmp_path / "flow.h5", points=points)
    points.write_text("x,y,z\n1,2,nan\n")
    with pytest.raises(DataError, match="must be finite"):
        flow_of(pile, out=tmp_path / "flow.h5", points=points)


def test_a_full_disk_is_an_error_before_any_work(pile, tmp_path, monkeypatch):
    monkeypatch.setattr("stokes.suspension.Suspension.solve", None)

    def full(path, needed):
        raise OutputError(f"{path}: not enough disk space")

    monkeypatch.setattr("dem_mpi.flow.require_space", full)
    with pytest.raises(OutputError, match="not enough disk space"):
        flow_of(pile, out=tmp_path / "flow.h5")
    assert os.listdir(tmp_path) == []


# ---- pictures ---------------------------------------------------------------------------------


def test_a_picture_needs_matplotlib_and_says_so_before_any_work(pile, tmp_path, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "dem_mpi.flow.importlib.util.find_spec",
        lambda name: None if name == "matplotlib" else found(name),
    )
    with pytest.raises(InputError, match=r"--render .*needs matplotlib, the extra `plot`"):
        flow_of(pile, out=tmp_path / "flow.h5", picture=tmp_path / "flow.png")
    with pytest.raises(InputError, match=r"--render .*: must end in \.png"):
        flow_of(pile, out=tmp_path / "flow.h5", picture=tmp_path / "flow.xyz")


@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")
def test_the_picture_shows_bodies_in_grey_on_colours(pile, tmp_path):
    import matplotlib.image

    code, said, _ = flow_of(
        pile, out=tmp_path / "flow.h5", picture=tmp_path / "flow.png", tolerance=1e-2
    )
    assert code == 0 and any("flow.png" in line for line in said)
    image = matplotlib.image.imread(tmp_path / "flow.png")[..., :3]
    assert image.shape[1] > 600
    grey = (np.ptp(image, axis=2) < 0.01) & (np.abs(image[..., 0] - 0.82) < 0.01)
    coloured = np.ptp(image, axis=2) > 0.1
    assert 0.05 < grey.mean() < 0.5 and coloured.mean() > 0.2


# ---- the program ------------------------------------------------------------------------------


def test_every_number_of_ranks_answers_alike(tmp_path):
    # Of three ranks one has no body.
    columns = columns_of([[0, 0, 0], [0.3, 0.1, 0]], 0.1, velocity=(0.0, 0.0, -0.01))
    path = write_run(tmp_path / "run.h5", columns)
    flows = []
    for ranks in (1, 2, 3):
        out = tmp_path / f"flow{ranks}.h5"
        done = run_ranks(
            ranks,
            ["-m", "dem_mpi", "flow", path, "--tolerance", "1e-3", "--viscosity", VISCOSITY,
             "--output", out, "--grid", "3,2,2"],
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert messages(done.stderr) == [] and done.stdout.count("converged") == 1
        flows.append(read_flow(out))
    for flow in flows[1:]:
        for name, values in flows[0].bodies.items():
            # Forces are answers of a solve to 1e-3; all else is the input's.
            scale = np.abs(values).max() if name in ("force", "torque", "stresslet") else 0.0
            np.testing.assert_allclose(flow.bodies[name], values, rtol=1e-12, atol=1e-3 * scale)
        np.testing.assert_array_equal(flow.surfaces.grid, flows[0].surfaces.grid)
        position = flows[0].surfaces.position
        np.testing.assert_allclose(flow.surfaces.position, position, rtol=0, atol=1e-14)
        speed = np.abs(flows[0].field.velocity).max()
        np.testing.assert_allclose(
            flow.field.velocity, flows[0].field.velocity, rtol=0, atol=2e-3 * speed
        )


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run.h5", "--frame", "9"], 64, "--frame 9: "),
        (["run.h5", "--bodies", "77"], 64, "--bodies 77: no such body"),
        (["none.h5"], 64, "none.h5: no such file"),
        (["damaged.h5"], 65, "checksum of 'radius' does not match"),
        (["run.h5", "--hydrodynamic-radius", "1"], 64, "touch or overlap"),
        (["run.h5", "--background", "storm:1"], 64, "--background 'storm:1'"),
    ],
)
def test_an_error_is_said_once_by_all_ranks(pile, tmp_path, arguments, code, words):
    for name in ("run.h5", "damaged.h5"):
        (tmp_path / name).write_bytes(pile.read_bytes())
    with h5py.File(tmp_path / "damaged.h5", "r+") as file:
        file["radius"][1] *= 1.001
    done = run_ranks(
        2, ["-m", "dem_mpi", "flow", *arguments], cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == code
    (line,) = messages(done.stderr)
    assert line.startswith("dem-mpi: error: ") and words in line
    assert not (tmp_path / "flow.h5").exists()


def test_a_run_without_fluid_imports_nothing_of_it():
    code = "import dem_mpi.runner, dem_mpi.__main__, sys; print('stokes' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


# ---- the page ---------------------------------------------------------------------------------

PAGE = (ROOT / "docs" / "flow.md").read_text()


def test_every_data_set_and_attribute_is_explained(pile, tmp_path):
    table = PAGE.split("| data set |")[1].split("\n\n")[0]
    explained = {name for row in table.splitlines() for name in re.findall(r"`(\w+/\w+)`", row)}
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,1\n")
    out = tmp_path / "flow.h5"
    flow_of(
        pile, out=out, points=tmp_path / "points.csv", formulation="combined", tolerance=1e-2,
        problem="mobility",
    )  # fmt: skip
    with h5py.File(out) as file:
        written = {f"{g}/{n}" for g in ("bodies", "surfaces", "field") for n in file[g]}
        attributes = set(file.attrs) - {"format", "format_version", "loads"}
    assert written == explained
    text = PAGE.split("Attributes of the file:")[1].split("\n\n")[0]
    assert set(re.findall(r"`(\w+)`", text)) == attributes


def test_example_of_the_page_prints_every_drag(pile, tmp_path):
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    flow_of(pile, out=tmp_path / "flow.h5", tolerance=1e-2)
    done = subprocess.run(
        [sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("resistance 0.9945") and len(lines) == 4


def test_every_flag_is_on_the_page_and_no_other():
    done = subprocess.run(
        [sys.executable, "-m", "dem_mpi", "flow", "--help"],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    flags = set(re.findall(r"--[a-z][a-z-]+", done.stdout.split("Exit codes")[0])) - {"--help"}
    of_run = {"--out", "--set"}
    assert set(re.findall(r"--[a-z][a-z-]+", PAGE)) - of_run == flags


def test_a_run_as_it_is_goes_through(tmp_path):
    simulate(Parallel.alone(), LEAVING, tmp_path, "time.end=0.02")
    path = tmp_path / "run.h5"
    code, said, flow = flow_of(path, bodies="0 7 49", tolerance=1e-2, hydrodynamic_radius="0.5")
    assert code == 0 and "3 of 50 bodies: 3 spheres" in said[0]
    with h5py.File(path) as file:
        last = slice(int(file["frames/offset"][-1]), None)
        rows = np.isin(file["gid"][last], [0, 7, 49])
        order = np.argsort(file["gid"][last][rows])
        np.testing.assert_array_equal(flow.bodies["position"], file["position"][last][rows][order])
        velocity = file["velocity"][last][rows][order]
        radius = file["radius"][last][rows][order]
    np.testing.assert_allclose(flow.bodies["velocity"], velocity, rtol=1e-12)
    # Far apart, for half their size: each has about its own drag.
    alone = -6.0 * np.pi * VISCOSITY * 0.5 * radius[:, None] * velocity
    np.testing.assert_allclose(flow.bodies["force"], alone, atol=0.2 * np.abs(alone).max())


def test_info_says_what_is_in_a_flow_file(pile, tmp_path):
    from dem_mpi.output import describe

    out = tmp_path / "flow.h5"
    flow_of(pile, out=out, grid="2,2,2", tolerance=1e-2)
    found = describe(out)
    assert (found.kind, found.valid, found.exit_code) == ("flow", True, 0)
    words = " ".join(found.lines())
    for expected in ("3 bodies", "8 points of the field", str(pile), "resistance, converged"):
        assert expected in words
    with h5py.File(out, "r+") as file:
        place = file["bodies/force"].id.get_chunk_info(0).byte_offset
    with out.open("r+b") as file:
        file.seek(place + 20)
        file.write(b"\xff\xff")
    assert (describe(out).valid, describe(out).exit_code) == (False, 65)
