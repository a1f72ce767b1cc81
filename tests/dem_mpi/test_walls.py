"""Walls: where spheres touch them, how they move, what they bear, and the work they do."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from dem_mpi import _kernels_walls as kernels
from dem_mpi.bodies import ImpulseMemory
from dem_mpi.contacts import recall_impulses
from dem_mpi.errors import InputError
from dem_mpi.estimate import estimate
from dem_mpi.parallel import Parallel
from dem_mpi.scenario import Scenario
from dem_mpi.scene_walls import Motion
from dem_mpi.simulation import Simulation
from dem_mpi.state import restore, save
from dem_mpi.wall_kinds import ABSENT, FRUSTUM, PLANE, RECTANGLE
from dem_mpi.walls import (
    Drive,
    Walls,
    rotation_matrix,
    velocity_at,
    wall_faces,
    walls_at,
)

from contact_twins import cloud, detect, detection, gathered, table_of
from scenes import (
    DENSITY,
    FLOOR,
    everybody,
    load,
    observed_order,
    scene,
    simulation_of,
    state_of,
    watch,
)

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])

EPS = np.finfo(float).eps
G = 9.81
R = 0.05
MASS = DENSITY * 4.0 / 3.0 * np.pi * R**3
SOLVE = 1e-10  # [m/s] dual residual of one-body solves
TIGHT = {"tolerance": SOLVE, "complementarity": 1e-10}


# ---- surfaces, and their points by brute force ---------------------------------------------


def rectangle(centre, normal, first, second) -> np.ndarray:
    return np.concatenate((centre, normal, first, second)).astype(float)


def frustum(start, axis, length, base, top, side) -> np.ndarray:
    return np.concatenate((start, axis, [length, base, top, side, 0.0, 0.0])).astype(float)


AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
ACROSS = np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0)
START = np.array([0.3, -0.2, 0.1])
SURFACES = {
    "rectangle": (RECTANGLE, rectangle(START, AXIS, 0.7 * ACROSS, 0.3 * np.cross(AXIS, ACROSS))),
    "cylinder inside": (FRUSTUM, frustum(START, AXIS, 1.2, 0.6, 0.6, 1.0)),
    "cylinder outside": (FRUSTUM, frustum(START, AXIS, 1.2, 0.3, 0.3, -1.0)),
    "cone inside": (FRUSTUM, frustum(START, AXIS, 0.8, 0.2, 0.9, 1.0)),
    "cone outside": (FRUSTUM, frustum(START, AXIS, 0.8, 0.9, 0.2, -1.0)),
    "tip inside": (FRUSTUM, frustum(START, AXIS, 0.8, 0.0, 0.7, 1.0)),
    "tip outside": (FRUSTUM, frustum(START, AXIS, 0.8, 0.7, 0.0, -1.0)),
    "ring": (FRUSTUM, frustum(START, AXIS, 0.0, 0.2, 0.7, 1.0)),
    "disc": (FRUSTUM, frustum(START, AXIS, 0.0, 0.0, 0.7, 1.0)),
}


def surface_point(kind: int, row: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Points of a surface for u, v in [0, 1]; on a frustum v is the azimuth in turns."""
    if kind == RECTANGLE:
        a, b = 2.0 * u[..., None] - 1.0, 2.0 * v[..., None] - 1.0
        return row[0:3] + a * row[6:9] + b * row[9:12]
    e1 = np.cross(row[3:6], [0.0, 0.0, 1.0])
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(row[3:6], e1)
    angle = 2.0 * np.pi * v[..., None]
    radius = (row[7] + u * (row[8] - row[7]))[..., None]
    s = (u * row[6])[..., None]
    return row[0:3] + s * row[3:6] + radius * (np.cos(angle) * e1 + np.sin(angle) * e2)


def closest_point(kind: int, row: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The nearest of a grid of points, refined about the best one again and again.

    The distance is stationary there: parameters to 1e-8 give it to 1e-16.
    """
    best, width = np.array([0.5, 0.5]), np.array([0.5, 0.5])
    for _ in range(60):
        u, v = (np.linspace(best[i] - width[i], best[i] + width[i], 25) for i in range(2))
        u = np.clip(u, 0.0, 1.0)
        if kind == RECTANGLE:
            v = np.clip(v, 0.0, 1.0)
        points = surface_point(kind, row, *np.meshgrid(u, v, indexing="ij"))
        distance = np.linalg.norm(points - centre, axis=-1)
        i, j = np.unravel_index(np.argmin(distance), distance.shape)
        best, width = np.array([u[i], v[j]]), 0.7 * width
    return points[i, j]


def rows_of(kind: int, row: np.ndarray) -> np.ndarray:
    """The row that kernels read, of a wall at rest."""
    still = np.zeros((1, 3))
    return Walls(
        np.array([kind], np.int8), row[None], np.zeros(1, np.int32), still, still, still
    ).rows()


def places(kind: int, row: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """(gap, normal) of the two places where a sphere meets a surface, (2, 4)."""
    return np.array(kernels.sphere_wall(rows_of(kind, row), 0, *centre, radius))


def height(row: np.ndarray, centre: np.ndarray) -> tuple[float, bool]:
    """Signed distance from a frustum continued beyond its rims; whether its foot is within them."""
    arm = centre - row[0:3]
    s = arm @ row[3:6]
    along = np.array([row[6], row[8] - row[7]])
    meridian = np.array([s, np.linalg.norm(arm - s * row[3:6]) - row[7]])
    foot = meridian @ along / (along @ along)
    distance = (along[1] * meridian[0] - along[0] * meridian[1]) / np.linalg.norm(along)
    return row[9] * distance, 0.0 <= foot <= 1.0


# ---- contact with one surface --------------------------------------------------------------


@pytest.mark.parametrize("name", SURFACES)
def test_sphere_touches_a_wall_at_its_closest_point(name):
    """Distances of order 1 in 1e-12; the direction as well as the brute force knows it."""
    kind, row = SURFACES[name]
    rng = np.random.default_rng(20)
    behind = 0
    for centre in START + rng.uniform(-0.9, 0.9, (100, 3)):
        radius = rng.uniform(0.02, 0.5)
        point = closest_point(kind, row, centre)
        distance = np.linalg.norm(point - centre)
        gap, *normal = places(kind, row, centre, radius)[0]
        signed = distance
        if kind == FRUSTUM:
            over, within = height(row, centre)
            if within and over < 0.0:
                behind += 1
                if over < -radius:
                    assert gap == np.inf
                    continue
                signed = -distance
        assert gap == pytest.approx(signed - radius, abs=1e-12)
        np.testing.assert_allclose(normal, (point - centre) / signed, atol=1e-6 / distance)
        # Close to the axis its direction is a quotient of rounded differences.
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-13)
    assert behind > 0 or kind == RECTANGLE


@pytest.mark.parametrize("name", SURFACES)
def test_second_place_is_the_nearest_of_the_opposite_meridian(name):
    kind, row = SURFACES[name]
    rng = np.random.default_rng(21)
    found = 0
    for centre in START + rng.uniform(-1.0, 1.0, (100, 3)):
        gap, *normal = places(kind, row, centre, 0.2)[1]
        if kind == RECTANGLE:
            assert gap == np.inf
            continue
        arm = centre - row[0:3]
        s = arm @ row[3:6]
        away = arm - s * row[3:6]
        away /= -np.linalg.norm(away)
        u = np.linspace(0.0, 1.0, 200001)[:, None]
        meridian = row[0:3] + u * row[6] * row[3:6] + (row[7] + u * (row[8] - row[7])) * away
        distance = np.linalg.norm(meridian - centre, axis=1)
        i = int(np.argmin(distance))
        interior = 0 < i < len(u) - 1
        tip = (row[7] + u[i] * (row[8] - row[7])) == 0.0
        if tip or (interior and row[9] < 0.0):
            assert gap == np.inf
            continue
        found += 1
        # The grid of points misses the foot by 2e-6 at most, its distance by the square of it.
        assert gap == pytest.approx(distance[i] - 0.2, abs=1e-9)
        np.testing.assert_allclose(normal, (meridian[i] - centre) / distance[i], atol=1e-4)
    assert found > 5 or kind == RECTANGLE or name in ("disc", "tip outside")


def test_sphere_in_a_snug_tube_touches_both_sides_and_in_a_wide_one_the_nearer():
    for tube, contacts in ((0.1005, 2), (0.15, 1)):
        cylinder = frustum([0, 0, 0], [0, 0, 1], 1.0, tube, tube, 1.0)
        walls = walls_of([(FRUSTUM, cylinder)])
        offset = tube - 0.1  # the sphere touches the near side
        c = detect(Parallel.alone(), cloud([[offset, 0, 0.5]], 0.1), detection(), 1e-3, walls)
        c = c.contacts
        assert c.other.tolist() == [-1] * contacts
        np.testing.assert_allclose(c.normal[:, 0], [1.0, -1.0][:contacts], atol=EPS)
        np.testing.assert_allclose(c.gap, [0.0, 2.0 * offset][:contacts], atol=1e-16)


def test_sphere_on_the_axis_of_a_cone_touches_two_opposite_points():
    row = frustum([0, 0, 0], [0, 0, 1], 1.0, 0.0, 1.0, 1.0)
    one, other = places(FRUSTUM, row, np.array([0.0, 0.0, 0.5]), 0.3)
    assert one[0] == other[0] == pytest.approx(0.5 * np.sqrt(0.5) - 0.3, abs=EPS)
    np.testing.assert_allclose(one[1:3], -other[1:3])
    np.testing.assert_allclose(one[3], -np.sqrt(0.5))
    assert np.hypot(*one[1:3]) == pytest.approx(np.sqrt(0.5))
    again = places(FRUSTUM, row, np.array([1e-17, -1e-18, 0.5]), 0.3)
    np.testing.assert_array_equal(again[0][1:], one[1:])  # no meridian is nearer than another


def test_vanished_wall_is_not_touched():
    _, row = SURFACES["ring"]
    assert (places(ABSENT, row, START + 0.1, 0.5)[:, 0] == np.inf).all()
    assert not kernels.may_touch(rows_of(ABSENT, row), 0, *START, 0.5, 1.0)


@pytest.mark.parametrize("name", SURFACES)
def test_quick_test_lets_every_contact_through_and_few_others(name):
    kind, row = SURFACES[name]
    rows = rows_of(kind, row)
    rng = np.random.default_rng(22)
    passed = touching = 0
    for centre in START + rng.uniform(-3.0, 3.0, (4000, 3)):
        radius, limit = rng.uniform(0.01, 0.2), rng.uniform(0.0, 0.05)
        near, _ = kernels.sphere_wall(rows, 0, *centre, radius)
        quick = kernels.may_touch(rows, 0, *centre, radius, limit)
        assert quick or near[0] > limit
        passed += quick
        touching += near[0] <= limit
    assert 0 < touching <= passed < 1000


def test_margin_of_a_turning_wall_is_bounded_before_its_point_is_known():
    """`largest_margin` must not be below the margin at any place that is a contact."""
    rng = np.random.default_rng(23)
    kind, row = SURFACES["cone inside"]
    contacts = 0
    for _ in range(3000):
        v, spin, shift, centre = rng.normal(size=(4, 3)) * [[3.0], [30.0], [2.0], [0.5]]
        x, r, h, c, mu = START + rng.normal(size=3), 0.2, 3e-3, 0.02, 0.4
        walls = Walls(
            np.array([kind], np.int8), row[None], np.zeros(1, np.int32),
            shift[None], spin[None], centre[None],
        )  # fmt: skip
        rolling = rng.uniform(0.0, 5.0)
        limit = kernels.largest_margin(walls.rows(), 0, *x, *v, r, rolling, mu, h, c)
        for gap, *n in places(kind, row, x, r):
            if gap == np.inf:
                continue
            point = x + (r + 0.5 * gap) * np.array(n)
            u = velocity_at(walls, np.array([0]), point[None])[0]
            margin = max(c * r, h * (np.linalg.norm(v - u) * (1.0 + mu) + rolling))
            if gap <= margin:
                contacts += 1
                assert gap <= limit
    assert contacts > 300


# ---- contact sets --------------------------------------------------------------------------


def walls_of(surfaces, velocity=0.0, spin=0.0, centre=0.0) -> Walls:
    """Walls of material 0 with one motion."""
    count = len(surfaces)
    motion = [np.broadcast_to(np.asarray(x, float), (count, 3)) for x in (velocity, spin, centre)]
    return Walls(
        np.array([kind for kind, _ in surfaces], np.int8),
        np.array([row for _, row in surfaces]),
        np.zeros(count, np.int32),
        *motion,
    )


def mixed_walls() -> Walls:
    rng = np.random.default_rng(24)
    spin = np.zeros((len(SURFACES), 3))
    spin[::2] = rng.normal(size=spin[::2].shape) * 20.0
    return walls_of(
        list(SURFACES.values()), rng.normal(size=spin.shape), spin, rng.normal(size=spin.shape)
    )


def expected_contacts(bodies, walls: Walls, options, step: float) -> list[tuple]:
    """(gid, wall id, gap) of all wall contacts by their definition."""
    found = []
    for i in range(len(bodies)):
        v, w = bodies.velocity[i], bodies.angular_velocity[i]
        x, r = bodies.position[i], bodies.radius[i]
        for k in range(len(walls.kind)):
            mu = options.friction[bodies.material[i], 0]
            for gap, *n in places(int(walls.kind[k]), walls.geometry[k], x, r):
                if gap == np.inf:
                    continue
                point = x + (r + 0.5 * gap) * np.array(n)
                u = velocity_at(walls, np.array([k]), point[None])[0]
                speed = np.linalg.norm(v - u) * (1.0 + mu) + np.linalg.norm(w) * r
                if gap <= max(options.margin * r, step * speed):
                    found.append((int(bodies.gid[i]), -(k + 1), gap))
    return sorted(found)


@ranks_1_2_3_8
def test_contacts_with_all_kinds_of_walls_are_those_of_the_definition(parallel):
    rng = np.random.default_rng(25)
    count = 150
    bodies = cloud(
        START + rng.uniform(-1.0, 1.0, (count, 3)), 0.02 + 0.1 * rng.random(count),
        rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) * 5.0,
    )  # fmt: skip
    walls, options = mixed_walls(), detection()
    found = detect(parallel, bodies, options, 2e-3, walls)
    table = gathered(parallel, table_of(found.contacts, found.neighbours.gid))
    table = table[table["other"] < 0]
    mine = sorted(table[["a", "other", "gap"]].tolist())
    expected = expected_contacts(bodies, walls, options, 2e-3)
    assert len({other for _, other, _ in expected}) == len(walls.kind)
    assert [row[:2] for row in mine] == [row[:2] for row in expected]
    np.testing.assert_array_equal([row[2] for row in mine], [row[2] for row in expected])
    # On any number of ranks the bits of one.
    alone = detect(Parallel.alone(), bodies, options, 2e-3, walls)
    one = table_of(alone.contacts, alone.neighbours.gid)
    assert sorted(row.tobytes() for row in table) == sorted(
        row.tobytes() for row in one[one["other"] < 0]
    )


def test_both_contacts_with_a_tube_recall_their_own_impulses():
    tube = walls_of([(FRUSTUM, frustum([0, 0, 0], [0, 0, 1], 1.0, 0.1005, 0.1005, 1.0))])
    found = detect(Parallel.alone(), cloud([[5e-4, 0, 0.5]], 0.1), detection(), 1e-3, tube)
    c = found.contacts
    world = np.array([[3.0, 0.0, 0.1], [-2.0, 0.0, 0.2]])
    memory = ImpulseMemory(c.row, c.other, world)
    impulse = recall_impulses(c, memory, 3, 1.0, 1)
    np.testing.assert_allclose(impulse[:, 0], [3.0, 2.0], atol=1e-12)


# ---- motion --------------------------------------------------------------------------------

TABLE = {
    "time": [0.1, 0.25, 0.3, 0.9],
    "velocity": [[1, 0, 0], [0, 2, -1], [0.5, 0, 3], [-1, 1, 0]],
}
RATES = {"time": [0.0, 0.4, 0.5], "rate": [2.0, -3.0, 1.0]}
MOTIONS = {
    "translation": {"velocity": [0.3, -0.2, 0.1]},
    "oscillation": {"oscillation": {"amplitude": [0.1, 0, 0.2], "frequency": 1.7, "phase": 0.6}},
    "table": {"table": TABLE},
    "rotation": {"rotation": {"centre": [0.2, 0.1, 0], "axis": [1, 1, 0], "rate": 3.0}},
    "rotation by table": {
        "rotation": {"centre": [0.2, 0.1, 0], "axis": [0, 0, -2], "rate": 1.0, "table": RATES}
    },
}
MOTIONS["all"] = {key: part for motion in MOTIONS.values() for key, part in motion.items()}
BOX = {"shape": "box", "name": "box", "material": "m", "min": [-1, -1, -1], "max": [1, 1, 1]}


def speed_of(motion: Motion, time: float) -> np.ndarray:
    """The translational velocity at an instant, by the definition of each part."""
    velocity = np.array(motion.velocity)
    if motion.oscillation is not None:
        omega = 2.0 * np.pi * motion.oscillation.frequency
        phase = motion.oscillation.phase
        velocity = velocity + np.array(motion.oscillation.amplitude) * omega * np.cos(
            omega * time + phase
        )
    if motion.table is not None:
        values = np.array(motion.table.velocity)
        velocity = velocity + [np.interp(time, motion.table.time, values[:, i]) for i in range(3)]
    return velocity


def rate_of(motion: Motion, time: float) -> float:
    rotation = motion.rotation
    if rotation is None:
        return 0.0
    table = rotation.table
    return rotation.rate + (np.interp(time, table.time, table.rate) if table is not None else 0.0)


def integrated(function: Callable[[float], float], start: float, end: float) -> float:
    knots = sorted({*TABLE["time"], *RATES["time"]})
    points = [knot for knot in knots if start < knot < end]
    return quad(function, start, end, points=points or None, epsabs=1e-13, limit=200)[0]


@pytest.mark.parametrize("name", MOTIONS)
def test_displacement_is_the_integral_of_the_velocity(name):
    motion = Motion.model_validate(MOTIONS[name])
    drive = Drive(motion)
    for start, end in itertools.pairwise([0.0, 0.05, 0.12, 0.27, 0.28, 0.55, 1.4]):
        expected = [integrated(lambda t, i=i: speed_of(motion, t)[i], start, end) for i in range(3)]
        # Tolerance: that of the quadrature.
        np.testing.assert_allclose(drive.shift(start, end), expected, atol=1e-12)
        np.testing.assert_allclose(drive.shift(end, start), np.negative(expected), atol=1e-12)
        turned = integrated(lambda t: rate_of(motion, t), start, end)
        assert drive.turn(start, end) == pytest.approx(turned, abs=1e-12)
    np.testing.assert_allclose(drive.shift(0.0, 1.4), drive.shift(0.0, 0.3) + drive.shift(0.3, 1.4))


@pytest.mark.parametrize("name", ["translation", "oscillation", "table"])
def test_mean_velocity_takes_a_wall_to_its_next_place(name):
    faces = wall_faces(scene(walls=[{**BOX, "motion": MOTIONS[name]}]))
    h = 0.02
    for step in range(60):
        walls, after = walls_at(faces, step * h, h), walls_at(faces, (step + 1) * h, h)
        moved = walls.geometry[:, 0:3] + h * walls.velocity
        np.testing.assert_allclose(moved, after.geometry[:, 0:3], atol=8 * EPS)


@pytest.mark.parametrize("name", ["rotation", "rotation by table", "all"])
def test_velocity_of_a_point_of_a_turning_wall_is_of_first_order(name):
    """The chord of a step leaves the circle by O(h^2)."""
    plate = {
        "shape": "rectangle", "material": "m", "corner": [0.5, 0, 0.2],
        "edges": [[0, 1, 0], [0, 0, 1]], "motion": MOTIONS[name],
    }  # fmt: skip
    faces = wall_faces(scene(walls=[plate]))
    steps = (4e-3, 2e-3, 1e-3, 5e-4)
    errors = []
    for h in steps:
        now, after = walls_at(faces, 0.6, h), walls_at(faces, 0.6 + h, h)
        start, end = (w.geometry[:, 0:3] + w.geometry[:, 6:9] for w in (now, after))
        chord = (end - start) / h
        errors.append(np.linalg.norm(chord - velocity_at(now, np.array([0]), start)))
    assert observed_order(steps, errors) == pytest.approx(1.0, abs=0.02)


def test_walls_move_as_rigid_bodies():
    """What is fixed to a wall keeps its gap to every face of it, at all times."""
    motion = MOTIONS["all"]
    solids = [
        {**BOX, "motion": motion},
        {"shape": "cone", "name": "cone", "material": "m", "start": [0.1, 0, 0], "end": [0, 0, 1],
         "radii": [0.9, 0.4], "motion": motion},
        {"shape": "rectangle", "name": "plate", "material": "m", "corner": [1, 0, 0],
         "edges": [[0, 2, 0], [0, 0, 1]], "motion": motion},
    ]  # fmt: skip
    faces = wall_faces(scene(walls=solids))
    start = np.array([0.3, 0.4, 0.6])
    drive = Drive(Motion.model_validate(motion))
    axis = np.array([0.0, 0.0, -1.0])
    gaps = []
    for time in (0.0, 0.21, 0.5, 1.3):
        walls = walls_at(faces, time, 1e-3)
        centre = np.array([0.2, 0.1, 0.0])
        turned = rotation_matrix(axis, drive.turn(0.0, time)) @ (start - centre)
        x = centre + turned + drive.shift(0.0, time)
        rows = walls.rows()
        gaps.append([kernels.sphere_wall(rows, k, *x, 0.1)[0][0] for k in range(len(rows))])
    np.testing.assert_allclose(gaps[1:], np.broadcast_to(gaps[0], (3, 8)), atol=20 * EPS)


def test_faces_of_one_wall_share_the_evaluation_of_its_motion():
    faces = wall_faces(scene(walls=[{**BOX, "motion": MOTIONS["all"]}, FLOOR]))
    ((_, moved),) = faces.drives
    assert moved == list(range(6))


def test_wall_vanishes_at_its_time_in_spite_of_rounding():
    faces = wall_faces(scene(walls=[{**FLOOR, "until": 0.57}, {**BOX}]))
    h = 1e-3
    kinds = [walls_at(faces, step * h, h).kind[0] for step in (0, 569, 570, 571)]
    assert kinds == [PLANE, PLANE, ABSENT, ABSENT]
    assert (walls_at(faces, 1.0, h).kind[1:] == PLANE).all()


# ---- bodies on walls -----------------------------------------------------------------------


def advance(simulation: Simulation, steps: int) -> Simulation:
    for _ in range(steps):
        assert simulation.step().converged
    return simulation


def slope(angle: float) -> dict:
    """A rectangle of 1 m x 1 m that falls towards +x, its lower edge at the origin."""
    down = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    return {
        "shape": "rectangle", "name": "slope", "material": "m",
        "corner": (-down - [0.0, 0.5, 0.0]).tolist(), "edges": [down.tolist(), [0, 1, 0]],
    }  # fmt: skip


def rolled(angle: float, mu: float, step: float, time: float) -> tuple[Simulation, np.ndarray]:
    """A sphere that starts half-way up the slope, and its starting point."""
    down = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    start = -0.5 * down + R * normal
    scenario = scene(step=step, mu=mu, walls=[slope(angle)], contact=TIGHT)
    return advance(simulation_of(scenario, start, R), round(time / step)), start


@pytest.mark.parametrize(("mu", "share"), [(0.5, 5 / 7), (0.0, 1.0)], ids=["rolls", "slides"])
def test_sphere_comes_down_an_inclined_rectangle_as_on_a_plane(mu, share):
    """x = a t (t + h)/2 along the slope, exactly; a = g sin(alpha), or 5/7 of it with friction."""
    angle, h, t = np.radians(20.0), 1e-3, 0.3
    simulation, start = rolled(angle, mu, h, t)
    bodies = simulation.state.bodies
    a = share * G * np.sin(angle)
    down = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    expected = start + 0.5 * a * t * (t + h) * down
    np.testing.assert_allclose(bodies.position[0], expected, atol=1e-8)
    np.testing.assert_allclose(bodies.velocity[0], a * t * down, atol=1e-7)


def test_sphere_leaves_the_edge_of_a_rectangle_and_falls_freely():
    """Slow enough it turns about the edge; it never sinks into it, and then nothing holds it."""
    simulation, _ = rolled(np.radians(10.0), 0.5, 1e-3, 0.80)
    turning, left = False, None
    for _ in range(300):
        record = simulation.step()
        x, v = simulation.state.bodies.position[0], simulation.state.bodies.velocity[0].copy()
        assert np.hypot(x[0], x[2]) > R * 0.999 or x[0] < 0.0
        over = x[0] * np.cos(np.radians(10.0)) - x[2] * np.sin(np.radians(10.0)) > 1e-4
        force = np.linalg.norm(record.walls["slope"][:3])
        turning |= bool(over and force > 0.0)
        if left is not None:
            np.testing.assert_allclose(v - left, [0, 0, -G * 1e-3], atol=1e-12)
            assert force == 0.0
        left = v if over and force == 0.0 and record.contacts == 0 else None
    assert turning
    assert left is not None
    assert x[2] < -0.1


def swing(step: float, time: float) -> float:
    """Angle of a sphere that rolls in a lying cylinder, from 0.2 rad at rest."""
    big, angle = 0.5, 0.2
    trough = {
        "shape": "cylinder", "name": "trough", "material": "m", "start": [0, -1, 0],
        "end": [0, 1, 0], "radius": big,
    }  # fmt: skip
    start = (big - R) * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    scenario = scene(step=step, mu=0.8, walls=[trough], contact=TIGHT)
    x = advance(simulation_of(scenario, start, R), round(time / step)).state.bodies.position[0]
    assert np.hypot(x[0], x[2]) == pytest.approx(big - R, abs=2e-4)
    return float(np.arctan2(x[0], -x[2]))


def test_sphere_swings_in_a_cylinder_with_the_period_of_rolling():
    """theta'' = -5 g / (7 (R - r)) sin(theta), approached at first order in h."""
    rate = 5.0 * G / (7.0 * (0.5 - R))
    time = 0.8  # near the second passage through the bottom, where the phase is seen best
    exact = solve_ivp(
        lambda t, y: [y[1], -rate * np.sin(y[0])], (0.0, time), [0.2, 0.0], rtol=1e-11, atol=1e-12
    ).y[0, -1]
    steps = (4e-3, 2e-3, 1e-3, 5e-4)
    errors = [swing(h, time) - exact for h in steps]
    assert abs(errors[-1]) < 2e-3
    assert observed_order(steps, errors) == pytest.approx(1.0, abs=0.15)


def normal_forces(simulation: Simulation) -> np.ndarray:
    """Normal force [N] at each contact of the next step."""
    recorder = watch(simulation)
    simulation.step()
    return recorder.report.impulse[:, 0] / simulation.scenario.time.step


def test_sphere_rests_in_a_cone_on_its_normal_forces():
    """Two opposite contacts bear m g: 2 N sin(alpha) = m g with alpha half the opening angle."""
    alpha = np.radians(35.0)
    cone = {
        "shape": "cone", "name": "cone", "material": "m", "start": [0, 0, 0], "end": [0, 0, 1],
        "radii": [0.01, 0.01 + np.tan(alpha)],
    }  # fmt: skip
    height = R / np.sin(alpha) - 0.01 / np.tan(alpha)
    simulation = simulation_of(scene(walls=[cone], contact=TIGHT), [0, 0, height], R)
    advance(simulation, 20)
    force = normal_forces(simulation)
    np.testing.assert_allclose(force, [MASS * G / (2.0 * np.sin(alpha))] * 2, rtol=1e-5)
    assert simulation.state.bodies.position[0, 2] == pytest.approx(height, abs=1e-9)


@pytest.mark.parametrize("support", ["pipe inside", "pipe outside", "hole"])
def test_sphere_rests_on_a_rim(support):
    """On a circle of radius q its centre is sqrt(r^2 - q^2) above; 2 N cos(beta) = m g."""
    q = 0.6 * R
    pipe = {
        "shape": "cylinder", "name": "rim", "material": "m", "start": [0, 0, -1], "end": [0, 0, 0],
        "radius": q, "side": support.removeprefix("pipe "),
    }  # fmt: skip
    ring = {
        "shape": "ring", "name": "rim", "material": "m", "centre": [0, 0, 0], "normal": [0, 0, 1],
        "radii": [q, 1.0],
    }  # fmt: skip
    height = np.sqrt(R * R - q * q)
    walls = [ring if support == "hole" else pipe]
    simulation = simulation_of(scene(walls=walls, contact=TIGHT), [0, 0, height], R)
    advance(simulation, 20)
    np.testing.assert_allclose(normal_forces(simulation), MASS * G * R / height / 2.0, rtol=1e-5)
    assert simulation.state.bodies.position[0, 2] == pytest.approx(height, abs=1e-9)


# ---- reactions -----------------------------------------------------------------------------

DRUM = {
    "shape": "cylinder", "name": "drum", "material": "m", "start": [0, -1, 0], "end": [0, 1, 0],
    "radius": 0.5,
}  # fmt: skip
SEATS = {
    "plane": ([FLOOR], [0.3, 0.2, R]),
    "rectangle": (
        [{"shape": "rectangle", "name": "floor", "material": "m", "corner": [-1, -1, 0],
          "edges": [[2, 0, 0], [0, 2, 0]]}],
        [0.3, 0.2, R],
    ),
    "disc": (
        [{"shape": "ring", "name": "floor", "material": "m", "centre": [0, 0, 0],
          "normal": [0, 0, 1], "radii": [0, 1]}],
        [0.3, 0.2, R],
    ),
    "trough": ([DRUM], [0.0, 0.2, -0.5 + R]),
}  # fmt: skip


@pytest.mark.parametrize("seat", SEATS)
def test_wall_bears_the_weight_at_its_point_of_contact(seat):
    walls, position = SEATS[seat]
    simulation = simulation_of(scene(mu=0.3, walls=walls, contact=TIGHT), position, R)
    record = advance(simulation, 20).step()
    ((name, reaction),) = record.walls.items()
    weight = np.array([0.0, 0.0, -MASS * G])
    # The solve leaves velocities up to its tolerance, a force of m r_d / h.
    tolerance = 10.0 * MASS * SOLVE / 1e-3
    np.testing.assert_allclose(reaction[:3], weight, atol=tolerance)
    faces = wall_faces(simulation.scenario)
    foot = np.array(position) - [0.0, 0.0, R]
    torque = np.cross(foot - faces.point[0], weight)
    np.testing.assert_allclose(reaction[3:], torque, atol=tolerance)
    assert name == faces.name[0]


def ring_floor(radius: float) -> list[dict]:
    return [
        {"shape": "cylinder", "name": "mantle", "material": "m", "start": [0, 0, 0],
         "end": [0, 0, 2], "radius": radius},
        {"shape": "ring", "name": "floor", "material": "m", "centre": [0, 0, 0],
         "normal": [0, 0, 1], "radii": [0, radius]},
    ]  # fmt: skip


CONTAINERS = {
    "box": [{**BOX, "min": [-0.14, -0.14, 0], "max": [0.14, 0.14, 1]}],
    "cylinder with a floor": ring_floor(0.13),
    "cone": [
        {"shape": "cone", "name": "cone", "material": "m", "start": [0, 0, -0.15], "end": [0, 0, 1],
         "radii": [0.0, 1.0]},
    ],
}  # fmt: skip


def heap(count: int = 16) -> np.ndarray:
    """Layers of four above the floor, none of them touching."""
    corner = np.array([(x, y) for x in (-0.055, 0.055) for y in (-0.055, 0.055)])
    layer = np.arange(count) // 4
    turn = 0.3 * layer
    c, s = np.cos(turn), np.sin(turn)
    x, y = corner[np.arange(count) % 4].T
    return np.stack((c * x - s * y, s * x + c * y, R * 1.1 + layer * 2.2 * R), axis=1)


@pytest.mark.parametrize(
    ("container", "steps"), [("box", 280), ("cylinder with a floor", 330), ("cone", 600)]
)
def test_walls_bear_the_weight_of_a_settled_bed(container, steps):
    """Their forces add up to it, m dv/dt counted, and at rest without it.

    At rest speeds are far below the tolerance of the solve, 1e-6 m/s, and change by that at most.
    """
    contact = {"tolerance": 1e-6, "complementarity": 1e-6, "max_iterations": 20000}
    scenario = scene(step=2e-3, mu=0.5, walls=CONTAINERS[container], contact=contact)
    simulation = simulation_of(scenario, heap(), R)
    for _ in range(steps):
        simulation.step()
    simulation.take_wall_impulse()
    before = simulation.state.bodies.velocity.sum(axis=0)
    advance(simulation, 50)
    change = MASS * (simulation.state.bodies.velocity.sum(axis=0) - before)
    impulse, time = simulation.take_wall_impulse()
    force = impulse[:, :3].sum(axis=0) / time
    assert time == pytest.approx(0.1)
    weight = np.array([0.0, 0.0, -16 * MASS * G])
    np.testing.assert_allclose(force, weight - change / time, atol=1e-9)  # round-off
    np.testing.assert_allclose(force, weight, atol=16 * MASS * 1e-6 / time)


def churning() -> Scenario:
    """Bodies thrown about between walls of every kind, some of them driven."""
    walls = [
        {**DRUM, "motion": {"rotation": {"centre": [0, 0, 0], "axis": [0, 1, 0], "rate": 4.0}}},
        {"shape": "ring", "name": "left", "material": "m", "centre": [0, -0.15, 0],
         "normal": [0, 1, 0], "radii": [0, 0.5]},
        {"shape": "plane", "name": "right", "material": "m", "point": [0, 0.15, 0],
         "normal": [0, -1, 0], "motion": {"oscillation": {"amplitude": [0, 0.01, 0],
                                                          "frequency": 8}}},
        {"shape": "rectangle", "name": "lifter", "material": "m", "corner": [-0.2, -0.15, -0.42],
         "edges": [[0.2, 0, 0], [0, 0.3, 0]],
         "motion": {"rotation": {"centre": [0, 0, 0], "axis": [0, 1, 0], "rate": 4.0}}},
    ]  # fmt: skip
    contact = {"tolerance": 1e-5, "complementarity": 1e-3, "max_iterations": 2000}
    return scene(step=2e-3, mu=0.4, walls=walls, contact=contact)


def churned(parallel: Parallel) -> Simulation:
    rng = np.random.default_rng(26)
    grid = np.array(list(itertools.product((-1, 0, 1), (-1, 1), (-3, -2, -1))))
    position = grid * [0.11, 0.06, 0.11] + rng.uniform(-2e-3, 2e-3, grid.shape)
    scenario = churning()
    velocity = rng.normal(size=position.shape)
    return Simulation(parallel, scenario, state_of(parallel, scenario, position, R, velocity))


@ranks_1_2_3_8
def test_momentum_changes_by_gravity_and_wall_reactions_alone(parallel):
    """To round-off, however well the solver did: impulses on bodies and walls are opposite."""
    simulation = churned(parallel)
    h = simulation.scenario.time.step
    bodies = everybody(parallel, simulation.state)
    momentum = MASS * bodies.velocity.sum(axis=0)
    touched = set()
    for _ in range(80):
        record = simulation.step()
        bodies = everybody(parallel, simulation.state)
        after = MASS * bodies.velocity.sum(axis=0)
        reaction = np.sum([row[:3] for row in record.walls.values()], axis=0)
        expected = momentum + h * (len(bodies) * MASS * np.array([0, 0, -G]) - reaction)
        np.testing.assert_allclose(after, expected, atol=1e3 * EPS)
        momentum = after
        touched |= {name for name, row in record.walls.items() if any(row)}
    assert touched == {"drum", "left", "right", "lifter"}


@ranks_1_2_3_8
def test_wall_work_is_what_reactions_do_at_the_velocity_of_the_walls(parallel):
    """-sum (J.V + T.W) over driven walls, part of an energy balance that closes to round-off."""
    simulation = churned(parallel)
    faces, h = wall_faces(simulation.scenario), simulation.scenario.time.step
    total = 0.0
    for step in range(80):
        walls = walls_at(faces, step * h, h)
        record = simulation.step()
        reaction = h * np.array([record.walls[name] for name in faces.name])
        motion = np.hstack((walls.velocity, walls.spin))
        assert record.wall_work == pytest.approx(-float(np.sum(reaction * motion)), abs=1e-12)
        assert record.energy_change == pytest.approx(record.energy_balance, abs=1e-12)
        total += abs(record.wall_work)
    assert total > 0.01  # J: the walls did do work


PLATES = {
    "oscillating": {"oscillation": {"amplitude": [0, 0, 0.02], "frequency": 2.0,
                                    "phase": -np.pi / 2}},
    "driven by a table": {"table": {"time": [0, 0.1, 0.3], "velocity": [[0, 0, 0], [0, 0, 1],
                                                                        [0, 0, 0.5]]}},
}  # fmt: skip


@pytest.mark.parametrize("name", PLATES)
def test_plate_does_the_work_that_lifts_and_speeds_up_a_sphere(name):
    """W = m g dz + dKE + sum m (dv)^2/2, what the inelastic catch of each step takes: order 1."""
    errors = []
    steps = (2e-3, 1e-3, 5e-4)
    for h in steps:
        plate = {**SEATS["rectangle"][0][0], "motion": PLATES[name]}
        simulation = simulation_of(scene(step=h, walls=[plate], contact=TIGHT), [0, 0, R], R)
        work = 0.0
        for _ in range(round(0.4 / h)):
            record = simulation.step()
            work += record.wall_work
        z = simulation.state.bodies.position[0, 2]
        assert record.contacts == 1
        gained = MASS * G * (z - R) + record.kinetic_energy
        errors.append(work - gained)
        plate_height = walls_at(wall_faces(simulation.scenario), 0.4, h).geometry[0, 2]
        assert z == pytest.approx(plate_height + R, abs=1e-8)
    assert 0.0 < errors[-1] < 0.05 * work
    assert observed_order(steps, errors) == pytest.approx(1.0, abs=0.1)


def test_drum_feeds_a_sphere_that_rolls_on_the_spot():
    """It turns with the mantle, omega r = -Omega R; then nothing rubs and no work is done."""
    drum = {**DRUM, "motion": {"rotation": {"centre": [0, 0, 0], "axis": [0, 1, 0], "rate": 2.0}}}
    scenario = scene(mu=0.5, walls=[drum], contact=TIGHT)
    simulation = simulation_of(scenario, [0, 0, -0.5 + R], R, angular_velocity=[0, 20.0, 0])
    record = advance(simulation, 100).step()
    # The mean gap of mid-way contact points shifts arms by the overlap of a resting body: none.
    assert simulation.state.bodies.angular_velocity[0, 1] == pytest.approx(20.0, rel=1e-6)
    assert abs(record.wall_work) < 1e-9
    assert record.walls["drum"][2] == pytest.approx(-MASS * G, rel=1e-6)


def test_column_falls_when_its_wall_vanishes():
    walls = [*ring_floor(0.13), {**FLOOR, "name": "ground"}]
    walls[0]["until"] = 0.1
    contact = {"tolerance": 1e-5, "complementarity": 1e-3}
    scenario = scene(step=2e-3, mu=0.2, walls=walls, contact=contact)
    simulation = simulation_of(scenario, heap(), R)
    widest = []
    for _ in range(200):
        record = simulation.step()
        x = simulation.state.bodies.position
        widest.append(np.hypot(x[:, 0], x[:, 1]).max())
        if record.time > 0.1 + 1e-9:
            assert not any(record.walls["mantle"])
    assert max(widest[:50]) < 0.13 - R + 1e-3
    assert widest[-1] > 0.2


# ---- the account of impulses ---------------------------------------------------------------


def test_impulses_taken_add_up_and_start_anew():
    simulation = churned(Parallel.alone())
    h = simulation.scenario.time.step
    forces = [list(simulation.step().walls.values()) for _ in range(25)]
    impulse, time = simulation.take_wall_impulse()
    np.testing.assert_allclose(impulse, h * np.sum(forces, axis=0), atol=1e3 * EPS)
    assert impulse.any()
    assert time == pytest.approx(25 * h)
    assert simulation.take_wall_impulse()[1] == 0.0
    assert not simulation.take_wall_impulse()[0].any()


@pytest.mark.mpi(ranks=[1, 2])
def test_impulses_since_the_last_frame_survive_a_checkpoint(parallel, shared_path):
    simulation = churned(parallel)
    for _ in range(25):
        simulation.step()
    path = save(parallel, simulation.state, shared_path, "run", {}, "0", 1, 0.0)
    state, _ = restore(parallel, path)
    resumed = Simulation(parallel, simulation.scenario, state)
    impulse, time = resumed.take_wall_impulse()
    kept, kept_time = simulation.take_wall_impulse()
    assert kept.any()
    np.testing.assert_array_equal(impulse, kept)
    assert time == kept_time


def test_scene_without_walls_has_no_reactions():
    record = simulation_of(scene(), [0, 0, 0], R).step()
    assert record.walls == {}
    assert record.wall_work == 0.0


# ---- scenes --------------------------------------------------------------------------------


def grid_scene(walls, low=(-0.3, -0.3, 0.1), high=(0.3, 0.3, 0.4), count=108):
    group = {
        "material": "m", "count": count, "radius": R,
        "placement": {"jittered_grid": {"min": list(low), "max": list(high)}},
    }  # fmt: skip
    return load(bodies=[group], walls=walls)


def test_region_that_fits_its_walls_passes_without_a_word():
    assert grid_scene(ring_floor(0.43)).warnings == ()
    assert grid_scene([FLOOR]).warnings == ()


def test_corners_of_a_region_beyond_a_cylinder_are_doubted():
    (warning,) = grid_scene(ring_floor(0.4)).warnings
    assert "part of it lies 0.0243 m behind wall 'mantle'" in warning  # 0.3 sqrt(2) - 0.4


def test_side_of_a_region_beyond_a_cylinder_is_refused():
    with pytest.raises(InputError, match=r"bodies would reach .* behind wall 'mantle'"):
        grid_scene(ring_floor(0.29))


def test_region_around_a_cylinder_must_leave_its_inside_free():
    pillar = {**DRUM, "start": [0, 0, 0], "end": [0, 0, 1], "side": "outside", "radius": 0.1}
    (warning,) = grid_scene([{**pillar, "start": [-0.3, 0, 0], "end": [-0.3, 0, 1]}]).warnings
    assert "behind wall 'drum'" in warning


def test_plate_through_a_region_is_doubted():
    plate = {**SEATS["rectangle"][0][0], "name": "plate", "corner": [-1, -1, 0.2]}
    (warning,) = grid_scene([plate]).warnings
    assert "wall 'plate' passes through it" in warning
    assert grid_scene([{**plate, "corner": [-1, -1, 0.1]}]).warnings == ()


@pytest.mark.parametrize(
    ("wall", "words"),
    [
        ({**SEATS["rectangle"][0][0], "motion": {"table": {"time": [0, 1], "velocity": [
            [0, 0, 0], [0, 0, 90]]}}}, "moves up to 90 m/s"),
        ({**SEATS["rectangle"][0][0], "motion": {"rotation": {"centre": [-1, -1, 0],
            "axis": [0, 1, 0], "rate": 50}}}, "moves up to 100 m/s"),
        ({**DRUM, "motion": {"rotation": {"centre": [0, 9, 0], "axis": [0, 2, 0], "rate": 500}}},
         None),
        ({**DRUM, "motion": {"rotation": {"centre": [0.5, 0, 0], "axis": [0, 1, 0], "rate": 100}}},
         "moves up to 100 m/s"),
    ],
    ids=["table", "lever", "drum about its axis", "drum off its axis"],
)  # fmt: skip
def test_walls_that_cross_a_radius_in_a_step_are_doubted(wall, words):
    warnings = grid_scene([wall], low=(-0.3, -0.3, 5.1), high=(0.3, 0.3, 5.4)).warnings
    moving = [warning for warning in warnings if "moves up to" in warning]
    assert len(moving) == (words is not None)
    assert words is None or words in moving[0]


@pytest.mark.parametrize(
    ("walls", "holds"),
    [
        (SEATS["rectangle"][0], True),
        ([{**SEATS["rectangle"][0][0], "edges": [[2, 0, 0], [0, 0, 2]]}], False),
        (ring_floor(0.5), True),
        (ring_floor(0.5)[:1], False),
        ([DRUM], True),
        ([{**DRUM, "side": "outside"}], False),
        (CONTAINERS["cone"], True),
        ([{**CONTAINERS["cone"][0], "radii": [1.0, 0.0]}], False),
    ],
    ids=["floor", "upright plate", "disc", "mantle", "drum", "roll", "funnel", "roof"],
)
def test_estimate_knows_which_walls_hold_bodies_up(walls, holds):
    z = 0.7 if walls[0].get("side") == "outside" else 0.2
    loaded = grid_scene(walls, low=(-0.1, -0.1, z), high=(0.1, 0.1, z + 0.1), count=4)
    assert estimate(loaded.scenario).settled == holds
    assert estimate(loaded.scenario).faces == len(walls)


def test_compiled_kernels_of_walls_need_no_scene():
    """Their modules load without pydantic, and know the kinds of walls all the same."""
    program = (
        "import sys, dem_mpi._kernels_narrow as k; print('pydantic' in sys.modules, k.GEOMETRY)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False", "12"]
