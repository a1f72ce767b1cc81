"""Initial bodies: where they stand, that ranks do not matter, and which files are refused."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from dem_mpi.errors import DataError, InputError
from dem_mpi.output import read_frame
from dem_mpi.parallel import Parallel
from dem_mpi.placement import grid, place_share
from dem_mpi.scenario import Scenario, body_count, load_scenario, parse_scenario
from dem_mpi.scene_bodies import JitteredGrid

from runs import PILE, simulate

HEAD = """\
domain: {min: [-1, -1, -1], max: [2, 2, 2]}
materials: {glass: {density: 2500}, steel: {density: 7800}}
time: {step: 1e-3, end: 1}
seed: 7
bodies:
"""
RANDOM_GROUP = """\
  - {material: glass, count: 700, radius: {uniform: [0.005, 0.01]}, velocity_jitter: 0.1,
     velocity: [1, 0, 0],
     placement: {jittered_grid: {min: [0, 0, 0], max: [0.3, 0.2, 0.4], jitter: 1}}}
"""
REGULAR_GROUP = """\
  - {material: steel, count: 30, radius: [0.02, 0.01, 0.03], angular_velocity: [0, 0, 5],
     placement: {jittered_grid: {min: [0, 0, 0.5], max: [1, 1, 1], spacing: 0.1}}}
"""


def scenario(bodies: str) -> Scenario:
    return parse_scenario(HEAD + bodies, "scene.yaml").scenario


def file_scene(directory: Path, name: str, extra: str = "radius: 0.1, ", within: str = "") -> Path:
    path = directory / "scene.yaml"
    dataset = f", dataset: {within}" if within else ""
    path.write_text(
        HEAD + f"  - {{material: glass, {extra}placement: {{file: {name}{dataset}}}}}\n"
    )
    return path


@pytest.mark.parametrize("size", [2, 3, 8, 1000])
def test_bodies_do_not_depend_on_the_number_of_ranks(size: int):
    scene = scenario(RANDOM_GROUP + REGULAR_GROUP)
    whole = place_share(scene, 0, 1)
    parts = [place_share(scene, rank, size) for rank in range(size)]
    for key, array in whole.items():
        joined = np.concatenate([part[key] for part in parts])
        assert joined.dtype == array.dtype
        assert joined.shape == array.shape
        assert joined.tobytes() == array.tobytes(), key


def test_shares_differ_by_one_body_at_most():
    scene = scenario(RANDOM_GROUP)
    counts = [len(place_share(scene, rank, 9)["gid"]) for rank in range(9)]
    assert sum(counts) == 700
    assert max(counts) - min(counts) <= 1


def test_arrays_have_the_stated_types_and_values():
    bodies = place_share(scenario(RANDOM_GROUP + REGULAR_GROUP), 0, 1)
    n = 730
    assert {key: (a.shape, a.dtype.name) for key, a in bodies.items()} == {
        "gid": ((n,), "int64"),
        "position": ((n, 3), "float64"),
        "radius": ((n,), "float64"),
        "material": ((n,), "int32"),
        "velocity": ((n, 3), "float64"),
        "angular_velocity": ((n, 3), "float64"),
        "orientation": ((n, 4), "float64"),
        "shape": ((n,), "int8"),
        "half_length": ((n,), "float64"),
    }
    assert bodies["gid"].tolist() == list(range(n))
    assert bodies["material"].tolist() == [0] * 700 + [1] * 30
    assert (bodies["orientation"] == [1, 0, 0, 0]).all()
    assert bodies["radius"][700:].tolist() == [0.02, 0.01, 0.03] * 10
    assert (bodies["angular_velocity"][700:] == [0, 0, 5]).all()


def test_random_radii_and_velocities_fill_their_ranges_evenly():
    bodies = place_share(scenario(RANDOM_GROUP), 0, 1)
    # The mean of n uniform numbers of range w has standard deviation w / sqrt(12 n).
    for values, low, high in (
        (bodies["radius"], 0.005, 0.01),
        (bodies["velocity"][:, 0], 0.9, 1.1),
        (bodies["velocity"][:, 2], -0.1, 0.1),
    ):
        assert values.min() >= low
        assert values.max() < high
        deviation = (high - low) / np.sqrt(12 * len(values))
        assert abs(values.mean() - (low + high) / 2) < 5 * deviation


def test_random_numbers_are_fixed_for_all_time():
    """A stored scene must give the same bodies under every version of the libraries."""
    bodies = place_share(scenario(RANDOM_GROUP), 0, 1)
    counter = np.random.Philox(key=np.array([7, 0], dtype=np.uint64)).random_raw(8)
    expected = 0.005 + 0.005 * (int(counter[3]) >> 11) * 2.0**-53
    assert bodies["radius"][0] == pytest.approx(expected, rel=1e-15)
    assert [f"{word:016x}" for word in counter[:2]] == PHILOX_7_0


PHILOX_7_0 = ["df4034b829e9fba4", "4b9d10cdf8e64087"]


def test_seed_changes_every_random_number():
    first = place_share(scenario(RANDOM_GROUP), 0, 1)
    text = (HEAD + RANDOM_GROUP).replace("seed: 7", "seed: 8")
    second = place_share(parse_scenario(text, "s").scenario, 0, 1)
    assert (first["position"] != second["position"]).all()
    assert (first["radius"] != second["radius"]).all()


def test_full_jitter_cannot_make_bodies_overlap_or_leave_the_region():
    bodies = place_share(scenario(RANDOM_GROUP.replace("700", "3000")), 0, 1)
    position, radius = bodies["position"], bodies["radius"]
    for start in range(0, 3000, 500):
        block = slice(start, start + 500)
        gap = np.linalg.norm(position[block, None] - position[None], axis=2)
        gap -= radius[block, None] + radius[None]
        gap[np.arange(500), start + np.arange(500)] = 1
        assert gap.min() >= 0
    assert (position - radius[:, None] >= 0).all()
    assert (position + radius[:, None] <= [0.3, 0.2, 0.4]).all()


def test_densest_grid_touches_and_does_not_overlap():
    """0.6 m / 0.2 m is 2.9999999999999996 in float64; three bodies fit all the same."""
    region = JitteredGrid(min=(0, 0, 0), max=(0.6, 0.6, 0.6), jitter=1)
    cells = grid(region, 27, 0.1)
    assert cells.shape == (3, 3, 3)
    assert max(cells.shift) < 1e-15
    np.testing.assert_allclose(np.diff(cells.centres(0, 3)[:, 0]), 0.2, rtol=1e-12)


def test_layers_fill_from_the_bottom():
    height = place_share(scenario(REGULAR_GROUP.replace("30", "250")), 0, 1)["position"][:, 2]
    assert (np.diff(height) >= 0).all()
    levels, counts = np.unique(height, return_counts=True)
    np.testing.assert_allclose(levels, [0.55, 0.65, 0.75], rtol=1e-12)
    assert counts.tolist() == [100, 100, 50]


def test_default_spacing_is_the_largest_that_fits():
    """16,384 bodies in 2 m x 2 m x 1 m: 32 x 32 x 16 cells of 1/16 m, and none is empty."""
    region = JitteredGrid(min=(-1, -1, -0.5), max=(1, 1, 0.5))
    cells = grid(region, 16_384, 0.01)
    assert cells.shape == (32, 32, 16)
    assert cells.cell == (0.0625, 0.0625, 0.0625)


def test_column_in_a_tube_stands_in_its_middle():
    region = JitteredGrid(min=(-0.101, -0.101, 0), max=(0.101, 0.101, 2.0))
    centres = grid(region, 10, 0.1).centres(0, 10)
    assert (centres[:, :2] == 0).all()
    np.testing.assert_allclose(centres[:, 2], 0.1 + 0.2 * np.arange(10))


def test_bounds_contain_every_body_and_no_empty_layer():
    region = JitteredGrid(min=(0, 0, 0), max=(1, 1, 1), jitter=1, spacing=0.1)
    low, high = grid(region, 250, 0.01).bounds(250, 0.01)
    np.testing.assert_allclose(low, 0, atol=1e-15)
    np.testing.assert_allclose(high, [1, 1, 0.3])
    _, high = grid(region, 5, 0.01).bounds(5, 0.01)
    np.testing.assert_allclose(high, [0.5, 0.1, 0.1])


def test_placing_more_than_fits_is_refused_even_without_loading_a_file():
    data = parse_scenario(HEAD + REGULAR_GROUP, "s").effective
    data["bodies"][0]["count"] = 10_000
    with pytest.raises(InputError, match="only 500 fit"):
        place_share(Scenario.model_validate(data), 0, 1)


# --- bodies that are not spheres -------------------------------------------------------------

RODS = """\
  - {material: glass, shape: spherocylinder, aspect_ratio: 2.5, count: 4000, axis: AXIS,
     radius: {uniform: [0.005, 0.01]}, placement: {jittered_grid: {min: [0, 0, 0], max: [1, 1, 1]}}}
"""


def axes(orientation: np.ndarray) -> np.ndarray:
    """The body's z axis (n, 3) in the world."""
    w, x, y, z = orientation.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)


@pytest.mark.parametrize(
    "axis",
    [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -3, 0), (1, 2, 3), (1e-9, 0, -1), (1, 1e-20, -1e-3)],
)
def test_bodies_point_where_their_group_says(axis: tuple[float, float, float]):
    bodies = place_share(scenario(RODS.replace("AXIS", f"{list(axis)}")), 0, 1)
    direction = np.array(axis) / np.linalg.norm(axis)
    np.testing.assert_allclose(axes(bodies["orientation"])[0], direction, rtol=0, atol=4e-16)
    assert np.ptp(bodies["orientation"], axis=0).max() == 0


def test_random_directions_cover_the_sphere_evenly_and_leave_other_numbers_alone():
    bodies = place_share(scenario(RODS.replace("AXIS", "random")), 0, 1)
    upright = place_share(scenario(RODS.replace("AXIS", "[0, 0, 1]")), 0, 1)
    for key in ("radius", "position"):
        assert (bodies[key] == upright[key]).all()
    n = len(bodies["gid"])
    np.testing.assert_allclose(np.linalg.norm(bodies["orientation"], axis=1), 1, atol=1e-15)
    axis = axes(bodies["orientation"])
    # Uniform on the sphere: <a> = 0, <a a> = 1/3, each component uniform on [-1, 1].
    assert np.abs(axis.mean(axis=0)).max() < 5 / np.sqrt(3 * n)
    assert np.abs(axis.T @ axis / n - np.eye(3) / 3).max() < 5 * np.sqrt(4 / 45 / n)
    for column in axis.T:
        counts = np.histogram(column, bins=20, range=(-1, 1))[0]
        assert ((counts - n / 20) ** 2 / (n / 20)).sum() < 44  # chi-square, 19 degrees, p = 1e-3


def test_shape_and_length_follow_from_the_aspect_ratio_and_keep_grid_bodies_apart():
    rods = place_share(scenario(RODS.replace("AXIS", "random")), 0, 1)
    assert (rods["shape"] == 1).all()
    np.testing.assert_allclose(rods["half_length"], 1.5 * rods["radius"], rtol=1e-15)
    spheroids = RODS.replace("spherocylinder", "spheroid").replace("AXIS", "random")
    bodies = place_share(scenario(spheroids), 0, 1)
    assert (bodies["shape"] == 2).all()
    np.testing.assert_allclose(bodies["half_length"], 2.5 * bodies["radius"], rtol=1e-15)
    with pytest.raises(InputError, match="too thin for bodies"):
        scenario(RODS.replace("AXIS", "random").replace("max: [1, 1, 1]", "max: [0.04, 1, 1]"))


# --- files ----------------------------------------------------------------------------------


def test_csv_columns_may_stand_in_any_order_and_replace_the_scene_s_values(tmp_path: Path):
    rows = "z,y,x,radius,vx,vy,vz\n3,2,1,0.5,7,8,9\n\n30,20,10,0.25,-7,-8,-9\n"
    (tmp_path / "bodies.csv").write_text(rows)
    loaded = load_scenario(file_scene(tmp_path, "bodies.csv"))
    assert body_count(loaded.scenario) == loaded.effective["bodies"][0]["count"] == 2
    bodies = place_share(loaded.scenario, 0, 1)
    assert bodies["position"].tolist() == [[1, 2, 3], [10, 20, 30]]
    assert bodies["radius"].tolist() == [0.5, 0.25]
    assert bodies["velocity"].tolist() == [[7, 8, 9], [-7, -8, -9]]
    assert (bodies["angular_velocity"] == 0).all()


@pytest.mark.parametrize("kind", ["csv", "h5"])
def test_a_bed_of_rods_stands_as_it_was_when_it_is_read_again(tmp_path: Path, kind: str):
    """Position, radius and orientation to the last bit but one; the scene gives the shape."""
    rods = place_share(scenario(RODS.replace("AXIS", "random").replace("4000", "200")), 0, 1)
    stretch = np.random.default_rng(1).uniform(0.5, 2, (200, 1))  # lengths are made 1 again
    table = [rods["position"], rods["radius"][:, None], stretch * rods["orientation"]]
    if kind == "csv":
        header = "x,y,z,radius,qw,qx,qy,qz"
        np.savetxt(tmp_path / "b.csv", np.hstack(table), "%.17g", ",", header=header, comments="")
    else:
        with h5py.File(tmp_path / "b.h5", "w") as file:
            file["position"], file["radius"] = rods["position"], rods["radius"]
            file["orientation"] = table[2]
    shape = "shape: spherocylinder, aspect_ratio: 2.5, "
    scene = load_scenario(file_scene(tmp_path, f"b.{kind}", shape)).scenario
    again = place_share(scene, 0, 1)
    for key in ("position", "radius", "half_length", "shape"):
        assert again[key].tobytes() == rods[key].tobytes(), key
    np.testing.assert_allclose(again["orientation"], rods["orientation"], rtol=0, atol=4e-16)


@pytest.mark.parametrize("kind", ["csv", "h5"])
def test_ranks_read_their_own_rows(tmp_path: Path, kind: str):
    position = np.random.default_rng(0).random((101, 3))
    if kind == "csv":
        np.savetxt(
            tmp_path / "b.csv", position, fmt="%.17g", delimiter=",", header="x,y,z", comments=""
        )
    else:
        with h5py.File(tmp_path / "b.h5", "w") as file:
            file["start/position"] = position
    within = "start" if kind == "h5" else ""
    scene = load_scenario(file_scene(tmp_path, f"b.{kind}", within=within)).scenario
    parts = [place_share(scene, rank, 7)["position"] for rank in range(7)]
    assert np.concatenate(parts).tobytes() == position.tobytes()
    assert len(place_share(scene, 1, 1000)["gid"]) == 0


def test_count_takes_the_first_rows_of_a_file(tmp_path: Path):
    (tmp_path / "b.csv").write_text("x,y,z\n0,0,0\n1,0,0\n2,0,0\n")
    scene = file_scene(tmp_path, "b.csv", "radius: 0.1, count: 2, ")
    assert len(place_share(load_scenario(scene).scenario, 0, 1)["gid"]) == 2
    with pytest.raises(InputError, match=r"scene.yaml:6: bodies\[0\].count = 4: .* holds 3 bodies"):
        load_scenario(file_scene(tmp_path, "b.csv", "radius: 0.1, count: 4, "))


def test_radius_must_come_from_somewhere(tmp_path: Path):
    (tmp_path / "b.csv").write_text("x,y,z\n0,0,0\n")
    with pytest.raises(InputError, match="radius is required"):
        load_scenario(file_scene(tmp_path, "b.csv", ""))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "empty"),
        ("\n\n", "empty"),
        ("x,y\n1,2\n", "column z is missing"),
        ("x,y,z,vx\n1,2,3,4\n", "column vy is missing"),
        ("x,y,z,colour\n1,2,3,4\n", "column 'colour'"),
        ("x,y,z,x\n1,2,3,4\n", "names each column once"),
        ("x,y,z\n1,2\n", r"body 0 \(from 0\): '1,2' is not 3 numbers"),
        ("x,y,z\n1,2,3\n\n1,2\n", r"body 1 \(from 0\): '1,2' is not 3 numbers"),
        ("x,y,z\n1,2,3\n1,2,three\n", r"body 1 \(from 0\): '1,2,three' is not 3 numbers"),
        ("x,y,z\n1,2,3\n1,nan,3\n", r"body 1 \(from 0\): position must be finite"),
        ("x,y,z,radius\n1,2,3,1\n1,2,3,-1\n", r"body 1 \(from 0\): radius must be finite and > 0"),
        ("x,y,z,qw,qx,qy\n1,2,3,1,0,0\n", "column qz is missing"),
        ("x,y,z,qw,qx,qy,qz\n1,2,3,0,0,0,0\n", r"body 0 \(from 0\): orientation must be a quat"),
        ("x,y,z,qw,qx,qy,qz\n1,2,3,1,0,nan,0\n", r"body 0 \(from 0\): orientation must be a quat"),
        (b"x,y,z\n\xff\xfe,1,2\n", "not UTF-8"),
        (b"\x89HDF\r\n\x1a\n", "not UTF-8"),
    ],
)
def test_damaged_csv_is_refused(tmp_path: Path, content: str | bytes, words: str):
    data = content.encode() if isinstance(content, str) else content
    (tmp_path / "b.csv").write_bytes(data)
    with pytest.raises(DataError, match=words) as caught:
        place_share(load_scenario(file_scene(tmp_path, "b.csv")).scenario, 0, 1)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 65


def _plain(file: h5py.File) -> None:
    file["position"] = np.zeros((4, 3))


def _no_position(file: h5py.File) -> None:
    file["velocity"] = np.zeros((4, 3))


def _external_link(file: h5py.File) -> None:
    with h5py.File(Path(file.filename).with_name("secret.h5"), "w") as secret:
        secret["position"] = np.zeros((4, 3))
    file["position"] = h5py.ExternalLink("secret.h5", "/position")


def _soft_link(file: h5py.File) -> None:
    file["elsewhere"] = np.zeros((4, 3))
    file["position"] = h5py.SoftLink("/elsewhere")


def _external_storage(file: h5py.File) -> None:
    raw = Path(file.filename).with_name("raw.bin")
    raw.write_bytes(bytes(96))
    file.create_dataset("position", (4, 3), "f8", external=[(str(raw), 0, 96)])


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4, 3), "f8")
    layout[:] = h5py.VirtualSource("secret.h5", "position", (4, 3))
    file.create_virtual_dataset("position", layout)


def _absurd_shape(file: h5py.File) -> None:
    file.create_dataset("position", (10**15, 3), "f8", chunks=(1024, 3))


def _objects(file: h5py.File) -> None:
    file.create_dataset("position", (4, 3), h5py.string_dtype())


def _wrong_width(file: h5py.File) -> None:
    file["position"] = np.zeros((4, 2))


def _orientation_without_scalar(file: h5py.File) -> None:
    _plain(file)
    file["orientation"] = np.ones((4, 3))


def _no_direction(file: h5py.File) -> None:
    _plain(file)
    file["orientation"] = np.array([[1.0, 0, 0, 0], [1e-9, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]])


def _scalar(file: h5py.File) -> None:
    file["position"] = 1.0


def _group_instead(file: h5py.File) -> None:
    file.create_group("position")


def _trajectory_of_elsewhere(file: h5py.File) -> None:
    _plain(file)
    file.attrs["format"] = np.bytes_(b"dem-mpi trajectory")
    file["frames"] = h5py.ExternalLink("secret.h5", "/")


def _lengths_differ(file: h5py.File) -> None:
    _plain(file)
    file["radius"] = np.ones(3)


def _not_finite(file: h5py.File) -> None:
    file["position"] = np.array([[0, 0, 0], [0, np.inf, 0.0]])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (_no_position, "no data set 'position'"),
        (_external_link, "is a link"),
        (_soft_link, "is a link"),
        (_external_storage, "stored in another file"),
        (_virtual, "stored in another file"),
        (_absurd_shape, "does not hold that much data"),
        (_objects, "numbers are expected"),
        (_wrong_width, "has shape"),
        (_orientation_without_scalar, r"has shape \(4, 3\); expected \(n, 4\)"),
        (_no_direction, r"body 1 \(from 0\): orientation must be a quaternion"),
        (_scalar, "has shape"),
        (_group_instead, "is no dataset"),
        (_trajectory_of_elsewhere, "'/frames' is a link by name or to another file"),
        (_lengths_differ, "differ in length"),
        (_not_finite, "position must be finite"),
    ],
    ids=lambda value: value.__name__.strip("_") if callable(value) else "",
)
def test_hostile_or_damaged_hdf5_is_refused(tmp_path: Path, make, words: str):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        make(file)
    with pytest.raises(DataError, match=words):
        place_share(load_scenario(file_scene(tmp_path, "b.h5")).scenario, 0, 1)


@pytest.mark.parametrize("size", [0, 10, 300])
def test_truncated_hdf5_is_refused(tmp_path: Path, size: int):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        _plain(file)
    whole = (tmp_path / "b.h5").read_bytes()
    (tmp_path / "b.h5").write_bytes(whole[:size])
    with pytest.raises(DataError, match="no readable HDF5 file"):
        load_scenario(file_scene(tmp_path, "b.h5"))


def test_a_run_begins_with_the_last_frame_of_another(tmp_path: Path):
    simulate(Parallel.alone(), PILE, tmp_path, "time.end=0.02")
    last = read_frame(tmp_path / "run.h5", -1)
    with h5py.File(tmp_path / "run.h5") as file:
        assert len(file["position"]) > len(last.columns["gid"])
    scene = load_scenario(file_scene(tmp_path, "run.h5", "")).scenario
    assert body_count(scene) == 60
    bodies = place_share(scene, 0, 1)
    for name in ("position", "velocity", "angular_velocity", "radius"):
        assert bodies[name].tobytes() == last.columns[name].tobytes(), name
    np.testing.assert_allclose(bodies["orientation"], last.columns["orientation"], atol=4e-16)


def test_missing_hdf5_group_is_named(tmp_path: Path):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        _plain(file)
    with pytest.raises(DataError, match="has no member 'frames'"):
        load_scenario(file_scene(tmp_path, "b.h5", within="frames/last"))
