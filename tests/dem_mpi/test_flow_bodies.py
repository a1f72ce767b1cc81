"""Bodies on their way from a trajectory to the Stokes step: which, in which frame, how large."""

from __future__ import annotations

import math

import h5py
import numpy as np
import pytest

from dem_mpi.errors import DataError, InputError
from dem_mpi.handoff import (
    LEAST_GAP,
    Selection,
    buoyant_weight,
    load_bodies,
    parse_gids,
    read_bodies,
    shrinkage,
    stokes_bodies,
)

from flow_runs import DENSITIES, columns_of, touching_pile, write_run

ALL = Selection()


def cloud(n: int, seed: int = 0, **columns) -> dict[str, np.ndarray]:
    """Bodies of random places and motions, rows in no order of gid."""
    rng = np.random.default_rng(seed)
    quaternion = rng.standard_normal((n, 4))
    values = {
        "radius": rng.uniform(0.02, 0.05, n),
        "orientation": quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        "velocity": rng.standard_normal((n, 3)),
        "angular_velocity": rng.standard_normal((n, 3)),
        "material": rng.integers(0, 2, n),
        "gid": 10 + 3 * rng.permutation(n),
    }
    return columns_of(rng.random((n, 3)), **{**values, **columns})


# ---- which frame, which bodies ----------------------------------------------------------------


def test_bodies_come_in_order_of_gid_with_all_their_columns(tmp_path):
    columns = cloud(40, shape="spheroid", half_length=0.03)
    path = write_run(tmp_path / "run.h5", columns)
    bodies = read_bodies(path, "last", ALL, moving=True)
    order = np.argsort(columns["gid"])
    assert len(bodies) == bodies.total == 40
    for name in ("gid", "shape", "radius", "half_length", "position", "velocity"):
        np.testing.assert_array_equal(getattr(bodies, name), columns[name][order])
    np.testing.assert_allclose(bodies.orientation, columns["orientation"][order], rtol=1e-15)
    expected = np.array(list(DENSITIES.values()))[columns["material"][order]]
    np.testing.assert_array_equal(bodies.density, expected)


@pytest.mark.parametrize(
    ("frame", "expected"),
    [("last", 3), ("0", 0), ("2", 2), ("0.5", 1), ("0.7s", 1), ("8e-1", 2), ("1s", 2)],
)
def test_a_frame_is_named_by_its_number_or_a_time(tmp_path, frame, expected):
    path = write_run(tmp_path / "run.h5", [cloud(2, seed) for seed in range(4)])
    bodies = read_bodies(path, frame, ALL, moving=False)
    assert (bodies.frame, bodies.frames) == (expected, 4)
    assert (bodies.step, bodies.time) == (100 * expected, 0.5 * expected)


@pytest.mark.parametrize("frame", ["4", "-1", "first", "1.6", "nan", "", "1.0.0"])
def test_a_frame_that_is_not_there_is_refused(tmp_path, frame):
    path = write_run(tmp_path / "run.h5", [cloud(2, seed) for seed in range(4)])
    with pytest.raises(InputError, match=r"^--frame "):
        read_bodies(path, frame, ALL, moving=False)


@pytest.mark.parametrize(
    ("text", "ranges"),
    [
        ("7", ((7, 7),)),
        ("7-9", ((7, 9),)),
        ("40, 3 7-12", ((3, 3), (7, 12), (40, 40))),
        ("5-9 1-6 10", ((1, 10),)),
    ],
)
def test_texts_of_gids(text, ranges):
    assert parse_gids(text) == ranges


@pytest.mark.parametrize("text", ["", " , ", "a", "3-", "-3", "9-7", "1.5", "1-2-3", "9" * 30])
def test_wrong_texts_of_gids(text):
    with pytest.raises(InputError, match=r"^--bodies "):
        parse_gids(text)


def test_ranges_of_gids_take_what_is_there(tmp_path):
    path = write_run(tmp_path / "run.h5", cloud(30))  # gids 10, 13, ... 97
    gids = parse_gids("13 20-30 94-500")
    bodies = read_bodies(path, "last", Selection(gids), moving=False)
    assert bodies.gid.tolist() == [13, 22, 25, 28, 94, 97]
    assert bodies.total == 30


def test_a_region_takes_the_bodies_whose_centres_it_holds(tmp_path):
    columns = cloud(200)
    path = write_run(tmp_path / "run.h5", columns)
    bodies = read_bodies(path, "last", Selection(region=(0, 0.5, 0.2, 1, 0, 1)), moving=False)
    x, y, _ = columns["position"].T
    assert 20 < len(bodies) < 100
    assert set(bodies.gid) == set(columns["gid"][(x <= 0.5) & (y >= 0.2)])
    both = Selection(parse_gids("0-300"), (0, 0.5, 0.2, 1, 0, 1))
    assert len(read_bodies(path, "last", both, moving=False)) < len(bodies)


@pytest.mark.parametrize(
    ("selection", "words"),
    [
        (Selection(((11, 11),)), "--bodies 11: no such body in frame 0"),
        (Selection(((10, 10), (98, 99))), "--bodies 98-99: no such body"),
        (Selection(region=(2, 3, 2, 3, 2, 3)), "--region: no body in frame 0"),
        (Selection(((10, 10),), (2, 3, 2, 3, 2, 3)), "--bodies and --region: no body"),
    ],
)
def test_a_selection_of_nothing_is_refused(tmp_path, selection, words):
    path = write_run(tmp_path / "run.h5", cloud(30))
    with pytest.raises(InputError) as caught:
        read_bodies(path, "last", selection, moving=False)
    assert words in str(caught.value)


def test_an_empty_frame_is_refused(tmp_path):
    path = write_run(tmp_path / "run.h5", [cloud(2), cloud(0)])
    with pytest.raises(InputError, match="no body in frame 1"):
        read_bodies(path, "last", ALL, moving=False)


@pytest.mark.mpi(ranks=[1, 3])
def test_every_rank_gets_the_same_bodies_or_the_same_error(parallel, shared_path):
    path = shared_path / "run.h5"
    if parallel.rank == 0:
        write_run(path, cloud(30))
    parallel.barrier()
    bodies = load_bodies(parallel, path, "last", ALL, True)
    places = parallel.allgather(bodies.position)
    assert (places == places[0]).all() and len(bodies) == 30
    with pytest.raises(InputError, match="--bodies 11"):
        load_bodies(parallel, path, "last", Selection(((11, 11),)), True)


# ---- columns that are missing or wrong --------------------------------------------------------


def test_spheres_need_no_orientation_and_are_taken_not_to_turn(tmp_path):
    left_out = ("shape", "half_length", "orientation", "angular_velocity", "material")
    path = write_run(tmp_path / "run.h5", cloud(5), leave_out=left_out)
    bodies = read_bodies(path, "last", ALL, moving=True)
    assert bodies.counts == {"sphere": 5}
    assert not bodies.angular_velocity.any()
    (assumed,) = bodies.assumed
    assert "no angular_velocity" in assumed and "output.fields" in assumed
    assert bodies.density is None
    assert read_bodies(path, "last", ALL, moving=False).assumed == ()


@pytest.mark.parametrize("missing", ["radius", "velocity", "orientation", "shape", "half_length"])
def test_a_missing_column_is_named_with_the_remedy(tmp_path, missing):
    columns = cloud(5, shape="spherocylinder", half_length=0.1)
    path = write_run(tmp_path / "run.h5", columns, leave_out=[missing])
    with pytest.raises(InputError) as caught:
        read_bodies(path, "last", ALL, moving=True)
    assert f"holds no {missing}" in str(caught.value) and "output.fields" in str(caught.value)


def test_orientations_without_shapes_are_those_of_spheres(tmp_path):
    path = write_run(tmp_path / "run.h5", cloud(5), leave_out=["shape", "half_length"])
    assert read_bodies(path, "last", ALL, moving=True).counts == {"sphere": 5}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("radius", 0.0),
        ("radius", math.nan),
        ("position", math.inf),
        ("orientation", 0.0),
        ("half_length", 0.0),
        ("shape", 7),
        ("velocity", math.nan),
    ],
)
def test_an_impossible_body_is_named(tmp_path, name, value):
    columns = cloud(5, shape="spheroid", half_length=0.1)
    gid = int(columns["gid"][2])
    columns[name][2] = value
    path = write_run(tmp_path / "run.h5", columns)
    with pytest.raises(DataError, match=rf"body {gid}: {name} = .* is not possible"):
        read_bodies(path, "last", ALL, moving=True)


def test_two_bodies_of_one_gid_are_refused(tmp_path):
    columns = cloud(5)
    columns["gid"][1] = columns["gid"][0]
    path = write_run(tmp_path / "run.h5", columns)
    with pytest.raises(DataError, match="gid"):
        read_bodies(path, "last", ALL, moving=True)


def test_a_damaged_column_is_told_by_its_checksum(tmp_path):
    path = write_run(tmp_path / "run.h5", [cloud(5), cloud(5, 1)])
    with h5py.File(path, "r+") as file:
        file["radius"][7] *= 1.0 + 1e-15
    with pytest.raises(DataError, match=r"checksum of 'radius' does not match in frame 1"):
        read_bodies(path, "last", ALL, moving=True)
    assert len(read_bodies(path, "0", ALL, moving=True)) == 5


@pytest.mark.parametrize("scene", ["{", "[]", '{"materials": 3}', '{"bodies": [1]}'])
def test_a_scene_that_is_none_is_refused(tmp_path, scene):
    path = write_run(tmp_path / "run.h5", cloud(3), attributes={"scene": scene})
    with pytest.raises(DataError, match="attribute 'scene' is no scene"):
        read_bodies(path, "last", ALL, moving=True)


def test_a_file_that_is_no_trajectory_is_refused(tmp_path):
    path = tmp_path / "other.h5"
    with pytest.raises(InputError, match="no such file"):
        read_bodies(path, "last", ALL, moving=True)
    with h5py.File(path, "w") as file:
        file["x"] = 1.0
    with pytest.raises(DataError, match="not a trajectory"):
        read_bodies(path, "last", ALL, moving=True)


# ---- weights ----------------------------------------------------------------------------------


def test_weight_in_a_fluid_is_that_of_what_is_displaced_less(tmp_path):
    columns = cloud(6)
    path = write_run(tmp_path / "run.h5", columns)
    bodies = read_bodies(path, "last", ALL, moving=False)
    weight = buoyant_weight(bodies, (0.0, 0.0, -9.81), 1000.0)
    excess = np.array([1500.0, 200.0])[columns["material"][np.argsort(columns["gid"])]]
    volume = 4.0 / 3.0 * np.pi * bodies.radius**3
    np.testing.assert_allclose(weight[:, 2], -9.81 * excess * volume, rtol=1e-14)
    assert not weight[:, :2].any()


def test_weight_needs_to_know_the_materials_unless_all_are_alike(tmp_path):
    path = write_run(tmp_path / "run.h5", cloud(6), leave_out=["material"])
    with pytest.raises(InputError, match="list material in"):
        buoyant_weight(read_bodies(path, "last", ALL, moving=False), (0, 0, -1), 1000.0)
    alike = {"a": {"density": 1500.0}, "b": {"density": 1500.0}}
    path = write_run(tmp_path / "one.h5", cloud(6), leave_out=["material"], materials=alike)
    assert (read_bodies(path, "last", ALL, moving=False).density == 1500.0).all()


# ---- room between bodies ----------------------------------------------------------------------


def handed(tmp_path, columns):
    return read_bodies(write_run(tmp_path / "run.h5", columns), "last", ALL, moving=False)


def test_spheres_that_overlap_shrink_until_a_hundredth_of_a_radius_is_free(tmp_path):
    bodies = handed(tmp_path, touching_pile(4, 0.1))
    found = shrinkage(bodies)
    # Centres are 1.999 r apart: 1.999 = f (2 + 0.01).
    assert found.factor == pytest.approx(1.999 / 2.01, rel=1e-14)
    assert found.gap == pytest.approx(LEAST_GAP, rel=1e-12)
    shrunk = stokes_bodies(bodies, found.factor)
    gap = shrunk[1].centre[0] - shrunk[0].centre[0] - shrunk[0].scale - shrunk[1].scale
    assert gap == pytest.approx(LEAST_GAP * shrunk[0].scale, rel=1e-12)


def test_the_gap_counts_in_radii_of_the_smaller_sphere(tmp_path):
    bodies = handed(tmp_path, columns_of([[0, 0, 0], [0, 0.44, 0], [9, 9, 9]], [0.4, 0.05, 0.2]))
    found = shrinkage(bodies)
    assert found.factor == pytest.approx(0.44 / (0.4 + 0.05 + 0.01 * 0.05), rel=1e-14)
    assert found.pair == (0, 1)


def test_bodies_with_room_keep_their_size(tmp_path):
    bodies = handed(tmp_path, columns_of([[0, 0, 0], [0, 0.2011, 0]], 0.1))
    found = shrinkage(bodies)
    assert found.factor == 1.0 and found.gap == pytest.approx(0.011, rel=1e-9)
    assert shrinkage(handed(tmp_path, columns_of([[0, 0, 0]], 0.1))).gap == math.inf


def test_the_least_gap_of_a_cloud_of_many_sizes_is_found(tmp_path):
    rng = np.random.default_rng(5)
    place, radius = rng.random((400, 3)), 10.0 ** rng.uniform(-4, -1.5, 400)
    bodies = handed(tmp_path, columns_of(place, radius))
    i, j = np.triu_indices(400, 1)
    distance = np.linalg.norm(place[i] - place[j], axis=1)
    expected = distance / (radius[i] + radius[j] + LEAST_GAP * np.minimum(radius[i], radius[j]))
    assert 0.1 < expected.min() < 0.9
    assert shrinkage(bodies).factor == pytest.approx(expected.min(), rel=1e-14)


def test_a_factor_that_is_given_is_taken_or_refused_with_a_better_one(tmp_path):
    bodies = handed(tmp_path, touching_pile(3, 0.1))
    assert shrinkage(bodies, 0.9).gap == pytest.approx((1.999 - 1.8) / 0.9, rel=1e-12)
    with pytest.raises(InputError) as caught:
        shrinkage(bodies, 1.0)
    for words in ("--hydrodynamic-radius 1", "0 and 1 touch or overlap", "auto takes 0.994527"):
        assert words in str(caught.value)
    with pytest.raises(
        InputError, match=r"bodies 0 and 1 are 0\.0005 radii apart, at least 0\.001"
    ):
        shrinkage(bodies, 1.999 / 2.0005)


def test_bodies_at_one_place_are_refused(tmp_path):
    bodies = handed(tmp_path, columns_of([[0, 0, 0], [0, 1e-9, 0]], 0.1, gid=[4, 9]))
    with pytest.raises(InputError, match=r"bodies 4 and 9 overlap so far"):
        shrinkage(bodies)


# Exact factors of two equal bodies, the second 0.15 m away along x from the first, whose axis is z
# unless it is turned: the gap along x is 0.15 - f w, w the sum of half widths, and shall be
# 0.01 f 0.1, for the radius of both is 0.1.
TURNED = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # the axis along x
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("shape", "half_length", "orientation", "width"),
    [
        ("spheroid", 0.2, (UPRIGHT, UPRIGHT), 0.2),
        ("spheroid", 0.05, (TURNED, TURNED), 0.1),
        ("spheroid", 0.02, (TURNED, UPRIGHT), 0.12),
        ("spherocylinder", 0.3, (UPRIGHT, UPRIGHT), 0.2),
        ("spherocylinder", 0.08, (UPRIGHT, TURNED), 0.28),
    ],
)
def test_other_shapes_shrink_to_the_same_gap(tmp_path, shape, half_length, orientation, width):
    columns = columns_of(
        [[0, 0, 0], [0.15, 0, 0], [5, 5, 5]], 0.1, shape, half_length, (*orientation, UPRIGHT)
    )
    bodies = handed(tmp_path, columns)
    found = shrinkage(bodies)
    expected = min(1.0, 0.15 / (width + LEAST_GAP * 0.1))
    # Gaps are found to about 1e-10 of a size, the factor to 1e-9.
    assert found.factor == pytest.approx(expected, rel=1e-8)
    if expected < 1.0:
        assert found.gap == pytest.approx(LEAST_GAP, rel=1e-5) and found.gap >= LEAST_GAP
        assert found.pair == (0, 1)


def test_bodies_of_one_aspect_ratio_share_their_curve(tmp_path):
    radius = np.array([0.1, 0.3, 0.07, 0.1, 0.2])
    shape = ["spheroid", "spheroid", "spheroid", "sphere", "sphere"]
    columns = columns_of(np.eye(5, 3) * 9, radius, shape, np.where(np.arange(5) < 3, 3 * radius, 0))
    made = stokes_bodies(handed(tmp_path, columns), 0.5)
    assert len({body.curve for body in made[:3]}) == 1
    assert len({body.curve for body in made}) == 2
    assert [body.scale for body in made] == (0.5 * radius).tolist()


def test_surfaces_of_the_bodies_are_where_the_run_has_them(tmp_path):
    columns = cloud(6, shape=["sphere", "spheroid", "spherocylinder"] * 2, half_length=0.08)
    bodies = handed(tmp_path, columns)
    for i, body in enumerate(stokes_bodies(bodies)):
        tip = bodies.half_length[i] + (bodies.radius[i] if bodies.shape[i] == 1 else 0.0)
        tip = tip if bodies.shape[i] else bodies.radius[i]
        w, x, y, z = bodies.orientation[i]
        axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        points = body.curve.evaluate(np.array([0.0, 0.5]))
        north, equator = body.to_world(np.stack([points.r, 0 * points.r, points.z], axis=1))
        np.testing.assert_allclose(north - bodies.position[i], tip * axis, atol=1e-12)
        across = equator - bodies.position[i]
        assert np.linalg.norm(across) == pytest.approx(bodies.radius[i], rel=1e-10)
        assert abs(across @ axis) < 1e-12
