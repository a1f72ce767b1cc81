"""Contacts of spheres, spherocylinders and spheroids with each other and with walls.

Lengths are of order one. Distances are second order in the place of the nearest points, so that
both the kernels and the twins give them to round-off (1e-13); normals and places are first order
and get what the twins can resolve, or are checked by what they mean: both surfaces lie half a
gap from the common point.
"""

from __future__ import annotations

from itertools import islice, pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from dem_mpi._kernels_shapes import (
    SPHERE,
    SPHEROCYLINDER,
    SPHEROID,
    bounding_radius,
    pair_contacts,
    smallest_size,
    wall_contacts,
)
from dem_mpi._kernels_spheroids import newton_direction, spheroid_foot, spheroid_segment
from dem_mpi._kernels_walls import sphere_wall
from dem_mpi.wall_kinds import FRUSTUM, PLANE, RECTANGLE

import shape_twins as twins

ORIGIN = np.zeros(3)
X, Y, Z = np.eye(3)
FAR = 100.0  # a limit that lets every contact through
EXACT = 1e-12  # round-off of a distance, sizes up to 20
BRUTE = 1e-10  # what was promised against brute force

KINDS = [SPHERE, SPHEROCYLINDER, SPHEROID]
NAMES = {SPHERE: "sphere", SPHEROCYLINDER: "rod", SPHEROID: "spheroid"}
ASPECTS = [0.05, 0.3, 0.999999, 1.0, 1.000001, 3.0, 20.0]


class Body:
    """Kind, centre, axis, radius, half length: the arguments of the kernels."""

    def __init__(self, kind: int, x: NDArray, d: NDArray, r: float, half: float) -> None:
        self.kind, self.r, self.half = kind, float(r), float(half)
        self.x, self.d = np.asarray(x, dtype=np.float64), np.asarray(d, dtype=np.float64)

    @property
    def row(self) -> tuple:
        return self.kind, self.x, self.d, self.r, self.half

    def moved(self, rotation: NDArray, shift: NDArray) -> Body:
        return Body(self.kind, rotation @ self.x + shift, rotation @ self.d, self.r, self.half)

    def distance(self, y: NDArray) -> float:
        """Signed distance of a point of the world from the surface."""
        y = y - self.x
        if self.kind == SPHEROID:
            return float(twins.spheroid_distance(y, self.d, self.r, self.half)[0])
        half = self.half if self.kind == SPHEROCYLINDER else 0.0
        t = np.clip(y @ self.d, -half, half)
        return float(np.linalg.norm(y - t * self.d) - self.r)


def contacts(a: Body, b: Body, limit: float = FAR) -> NDArray:
    out = np.full((2, 7), np.nan)
    count, _ = pair_contacts(*a.row, *b.row, limit, out)
    assert np.isnan(out[count:]).all() or count == 1
    return out[:count]


def at_wall(kind: int, g: NDArray, body: Body, limit: float = FAR) -> NDArray:
    out = np.full((2, 7), np.nan)
    count = wall_contacts(kind, g, *body.row, limit, out)
    return out[:count]


def random_body(rng: np.random.Generator, kind: int, x: NDArray = ORIGIN) -> Body:
    aspect = np.exp(rng.uniform(-np.log(20.0), np.log(20.0)))
    half = {SPHERE: 0.0, SPHEROCYLINDER: rng.uniform(0.1, 2.0), SPHEROID: aspect}[kind]
    return Body(kind, x, twins.random_unit(rng), 1.0, half)


def touching(rng: np.random.Generator, kind_a: int, kind_b: int, gap: float) -> tuple[Body, Body]:
    """Two bodies in random attitude whose gap is within 1e-9 of the one asked for."""
    a, b = random_body(rng, kind_a, rng.normal(size=3)), random_body(rng, kind_b)
    direction = twins.random_unit(rng)
    low, high = 0.0, 50.0
    for _ in range(40):
        b.x = a.x + 0.5 * (low + high) * direction
        if contacts(a, b)[:, 3].min() < gap:
            low = 0.5 * (low + high)
        else:
            high = 0.5 * (low + high)
    return a, b


# ---- every pair ----------------------------------------------------------------------------

PAIRS = [(a, b) for a in KINDS for b in KINDS]


@pytest.mark.parametrize(("kind_a", "kind_b"), PAIRS, ids=lambda k: NAMES[k])
@pytest.mark.parametrize("gap", [0.2, 1e-6, -0.04])
def test_both_surfaces_lie_half_a_gap_from_the_common_point(kind_a, kind_b, gap):
    """The first order of the overlap: |gap| stays below the tightest curvature radius, 0.05."""
    rng = np.random.default_rng([kind_a, kind_b, 1])
    for _ in range(10):
        a, b = touching(rng, kind_a, kind_b, gap)
        for n, phi, p in ((row[:3], row[3], row[4:]) for row in contacts(a, b, gap + 1e-3)):
            assert np.linalg.norm(n) == pytest.approx(1.0, abs=EXACT)
            assert abs(a.distance(a.x + p - 0.5 * phi * n)) < 1e-11
            assert abs(b.distance(a.x + p + 0.5 * phi * n)) < 1e-11


@pytest.mark.parametrize(("kind_a", "kind_b"), PAIRS, ids=lambda k: NAMES[k])
def test_exchange_of_the_bodies_turns_the_normals_and_keeps_the_points(kind_a, kind_b):
    rng = np.random.default_rng([kind_a, kind_b, 2])
    for gap in (0.3, 1e-3, -0.04):
        for _ in range(10):
            a, b = touching(rng, kind_a, kind_b, gap)
            one, two = contacts(a, b), contacts(b, a)
            assert len(one) == len(two)
            one[:, 4:] += a.x
            two[:, 4:] += b.x
            if np.linalg.norm(one[0, 4:] - two[0, 4:]) > 1e-7:
                two = two[::-1]
            np.testing.assert_allclose(one[:, :3], -two[:, :3], atol=1e-9)
            np.testing.assert_allclose(one[:, 3:], two[:, 3:], atol=1e-9)


@pytest.mark.parametrize(("kind_a", "kind_b"), PAIRS, ids=lambda k: NAMES[k])
def test_rotation_of_the_scene_rotates_the_contacts(kind_a, kind_b):
    rng = np.random.default_rng([kind_a, kind_b, 3])
    for gap in (0.3, 1e-3, -0.04):
        for _ in range(10):
            a, b = touching(rng, kind_a, kind_b, gap)
            rotation, shift = twins.random_rotation(rng), rng.normal(size=3)
            one = contacts(a, b)
            two = contacts(a.moved(rotation, shift), b.moved(rotation, shift))
            assert len(one) == len(two)
            np.testing.assert_allclose(one[:, :3] @ rotation.T, two[:, :3], atol=1e-9)
            np.testing.assert_allclose(one[:, 4:] @ rotation.T, two[:, 4:], atol=1e-9)
            np.testing.assert_allclose(one[:, 3], two[:, 3], atol=1e-11)


@pytest.mark.parametrize(("kind_a", "kind_b"), PAIRS, ids=lambda k: NAMES[k])
def test_no_contact_is_wider_than_the_limit(kind_a, kind_b):
    rng = np.random.default_rng([kind_a, kind_b, 4])
    a, b = touching(rng, kind_a, kind_b, 0.1)
    assert len(contacts(a, b, 0.0999)) == 0
    assert contacts(a, b, 0.1001)[0, 3] == pytest.approx(0.1, abs=1e-8)


def test_spheres_touch_as_their_centres_say_to_the_bit():
    rng = np.random.default_rng(5)
    for _ in range(50):
        a, b = random_body(rng, SPHERE, rng.normal(size=3)), random_body(rng, SPHERE)
        a.r, b.r = rng.uniform(0.1, 1.0, 2)
        v = b.x - a.x
        distance = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        phi = distance - (a.r + b.r)
        (row,) = contacts(a, b)
        assert row[3] == phi
        assert np.array_equal(row[:3], v / distance)


@pytest.mark.parametrize("kind_a", KINDS, ids=lambda k: NAMES[k])
def test_coincident_bodies_are_told(kind_a):
    out = np.zeros((2, 7))
    a = Body(kind_a, X, Z, 1.0, 0.7)
    count, coincident = pair_contacts(*a.row, *a.row, FAR, out)
    assert count >= 1
    assert coincident == 1
    assert np.linalg.norm(out[0, :3]) == pytest.approx(1.0)
    assert out[0, 3] == pytest.approx(-1.4 if kind_a == SPHEROID else -2.0)


# ---- rods ----------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [1.0, 1e-1, 1e-3, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10, 1e-13, 0.0])
def test_gap_of_two_rods_agrees_with_brute_force(tilt):
    rng = np.random.default_rng(6)
    for _ in range(6):
        a, b = random_body(rng, SPHEROCYLINDER), random_body(rng, SPHEROCYLINDER)
        b.d = a.d + tilt * twins.random_unit(rng)
        b.d /= np.linalg.norm(b.d)
        b.x = rng.uniform(0.2, 3.0) * twins.random_unit(rng)
        _, distance = twins.segment_pair_distance(b.x, a.d, a.half, b.d, b.half)
        rows = contacts(a, b)
        assert rows[:, 3].min() == pytest.approx(distance - 2.0, abs=EXACT)


def test_parallel_rods_touch_at_both_ends_of_their_overlap():
    a = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
    b = Body(SPHEROCYLINDER, [3.0, 0.0, 1.1], -X, 0.5, 2.0)
    rows = contacts(a, b)
    np.testing.assert_allclose(rows[:, :3], [Z, Z], atol=EXACT)
    np.testing.assert_allclose(rows[:, 3], 0.1, atol=EXACT)
    np.testing.assert_allclose(rows[:, 4:], [[1.0, 0.0, 0.55], [2.0, 0.0, 0.55]], atol=EXACT)


@pytest.mark.parametrize("tilt", [1e-15, 1e-12, 1e-9, 1e-6, 1e-4])
def test_contacts_of_nearly_parallel_rods_stay_at_the_ends(tilt):
    """A crossing point anywhere between the ends would shake the rods from step to step."""
    rng = np.random.default_rng(7)
    for _ in range(20):
        turn = tilt * rng.normal(size=3)
        d = X + turn
        a = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
        b = Body(SPHEROCYLINDER, [3.0, 0.0, 1.1], d / np.linalg.norm(d), 0.5, 2.0)
        rows = contacts(a, b)
        assert len(rows) == 2
        np.testing.assert_allclose(rows[:, 4], [1.0, 2.0], atol=10.0 * tilt + EXACT)


def test_second_contact_obeys_the_limit():
    d = np.array([1.0, 0.0, 0.1]) / np.hypot(1.0, 0.1)
    a = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
    b = Body(SPHEROCYLINDER, [0.0, 0.0, 1.3], d, 0.5, 2.0)
    wide = contacts(a, b)
    assert len(wide) == 2
    assert wide[0, 4] < wide[1, 4] and wide[0, 3] < wide[1, 3]
    assert len(contacts(a, b, 0.5 * wide[:, 3].sum())) == 1


def test_rods_end_to_end_touch_once():
    a = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
    b = Body(SPHEROCYLINDER, [5.05, 0.0, 0.0], X, 0.5, 2.0)
    (row,) = contacts(a, b)
    np.testing.assert_allclose(row, [1.0, 0.0, 0.0, 0.05, 2.525, 0.0, 0.0], atol=EXACT)


def test_rods_that_overlap_by_less_than_a_tenth_of_the_radius_touch_once():
    a = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
    assert len(contacts(a, Body(SPHEROCYLINDER, [3.96, 0.0, 1.0], X, 0.5, 2.0))) == 1
    assert len(contacts(a, Body(SPHEROCYLINDER, [3.94, 0.0, 1.0], X, 0.5, 2.0))) == 2


@pytest.mark.parametrize("height", [1e-3, 1e-14, 0.0, -1e-14, -1e-3])
def test_crossing_cores_part_along_their_common_perpendicular(height):
    a = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
    b = Body(SPHEROCYLINDER, [0.3, 0.0, height], (X + Y) / np.sqrt(2.0), 0.5, 2.0)
    out = np.zeros((2, 7))
    _, coincident = pair_contacts(*a.row, *b.row, 0.0, out)
    assert coincident == 0
    row = out[np.argmin(out[:, 3])]
    assert row[3] == pytest.approx(abs(height) - 1.0, abs=EXACT)
    np.testing.assert_allclose(row[:3], Z if height >= 0.0 else -Z, atol=EXACT)


def test_crossed_equal_rods_keep_their_contacts_under_exchange():
    """All four ends are equally far and equally wide: the tie may not follow the order."""
    a = Body(SPHEROCYLINDER, ORIGIN, [np.cos(0.1), np.sin(0.1), 0.0], 0.5, 2.0)
    b = Body(SPHEROCYLINDER, [0.0, 0.0, 1.0], [np.cos(0.1), -np.sin(0.1), 0.0], 0.5, 2.0)
    one, two = contacts(a, b), contacts(b, a)
    one[:, 4:] += a.x
    two[:, 4:] += b.x
    order = [np.lexsort(rows[:, 4:].T) for rows in (one, two)]
    np.testing.assert_allclose(one[order[0], 3:], two[order[1], 3:], atol=EXACT)


def test_collinear_cores_get_a_normal_and_are_told():
    out = np.zeros((2, 7))
    a = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
    b = Body(SPHEROCYLINDER, X, X, 0.5, 2.0)
    count, coincident = pair_contacts(*a.row, *b.row, 0.0, out)
    assert (count, coincident) == (2, 1)
    np.testing.assert_array_equal(out[:, :3], [Z, Z])
    np.testing.assert_allclose(out[:, 4], [-1.0, 2.0], atol=EXACT)


def test_sphere_on_a_rod_touches_its_side_or_its_cap():
    rod = Body(SPHEROCYLINDER, ORIGIN, X, 0.5, 2.0)
    (row,) = contacts(rod, Body(SPHERE, [1.0, 1.2, 0.0], Z, 0.5, 0.0))
    np.testing.assert_allclose(row, [0.0, 1.0, 0.0, 0.2, 1.0, 0.6, 0.0], atol=EXACT)
    (row,) = contacts(rod, Body(SPHERE, [3.2, 0.0, 0.0], Z, 0.5, 0.0))
    np.testing.assert_allclose(row, [1.0, 0.0, 0.0, 0.2, 2.6, 0.0, 0.0], atol=EXACT)


# ---- spheroid and point, spheroid and rod --------------------------------------------------


def points_about_a_spheroid(rng: np.random.Generator, d: NDArray, aspect: float) -> NDArray:
    """Far, near, inside, on the axis, on the equatorial plane, nearly so, at the centre."""
    f = twins.frame(d)
    size = max(1.0, aspect)
    free = rng.normal(size=(40, 3)) * rng.choice([0.01, 0.3, 1.0, 5.0], size=(40, 1)) * size
    surface = twins.spheroid_point(rng.uniform(0.0, np.pi, (20, 2)), d, 1.0, aspect)
    surface *= 1.0 + rng.choice([-1e-3, -1e-9, 1e-9, 1e-3], size=(20, 1))
    axis = rng.uniform(-1.5, 1.5, (10, 1)) * aspect * f[2]
    equator = rng.uniform(-1.5, 1.5, (10, 1)) * f[0]
    nearly = np.concatenate([axis, equator])
    nearly = nearly + rng.normal(size=nearly.shape) * 10.0 ** rng.uniform(-16, -3, (20, 1))
    return np.concatenate([free, surface, axis, equator, nearly, np.zeros((1, 3))])


@pytest.mark.parametrize("aspect", ASPECTS)
def test_signed_distance_from_a_spheroid_agrees_with_brute_force(aspect):
    rng = np.random.default_rng(8)
    d = twins.random_unit(rng)
    points = points_about_a_spheroid(rng, d, aspect)
    expected = twins.spheroid_distance(points, d, 1.0, aspect)
    size = max(1.0, aspect)
    for y, delta in zip(points, expected, strict=True):
        found, n, foot = spheroid_foot(tuple(y), tuple(d), 1.0, aspect)
        assert found == pytest.approx(delta, abs=EXACT * size, rel=EXACT)
        # the foot is a point of the surface, n its normal, and y stands above it
        s = np.dot(foot, d)
        radial = np.asarray(foot) - s * d
        assert radial @ radial + (s / aspect) ** 2 == pytest.approx(1.0, abs=EXACT)
        normal = radial + s / aspect**2 * d
        np.testing.assert_allclose(n, normal / np.linalg.norm(normal), atol=1e-10)
        np.testing.assert_allclose(np.asarray(foot) + found * np.asarray(n), y, atol=1e-9 * size)


def test_point_at_the_centre_of_a_spheroid_is_as_deep_as_its_smallest_semi_axis():
    for aspect in ASPECTS:
        delta, _, _ = spheroid_foot((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, aspect)
        assert delta == pytest.approx(-min(1.0, aspect), abs=EXACT)


@pytest.mark.parametrize("aspect", ASPECTS)
def test_distance_of_a_segment_from_a_spheroid_agrees_with_brute_force(aspect):
    """Random ones, ones along and across the axis (flat faces), outside and cutting through."""
    rng = np.random.default_rng(9)
    size = max(1.0, aspect)
    for k in range(16):
        d, e = twins.random_unit(rng), twins.random_unit(rng)
        if k % 4 == 0:
            e = d if k % 8 == 0 else twins.frame(d)[0]
        y = rng.normal(size=3) * size
        half = rng.uniform(0.1, 3.0) * size
        t, delta, n, _ = spheroid_segment(tuple(y), tuple(e), half, tuple(d), 1.0, aspect)
        _, expected = twins.spheroid_segment_distance(y, e, half, d, 1.0, aspect)
        assert delta == pytest.approx(expected, abs=BRUTE * size)
        if delta > 0.0:
            slope = np.dot(n, e)
            assert abs(slope) < 1e-10 or (t == half and slope < 0) or (t == -half and slope > 0)


# ---- two spheroids -------------------------------------------------------------------------


def spheroid_pair_at(
    rng: np.random.Generator, ca: float, cb: float, gap: float, n: NDArray | None = None
) -> tuple[Body, Body, NDArray]:
    """Two spheroids in random attitude, touching where both normals are n: gap known exactly."""
    n = twins.random_unit(rng) if n is None else n
    a = Body(SPHEROID, rng.normal(size=3), twins.random_unit(rng), 1.0, ca)
    b = Body(SPHEROID, ORIGIN, twins.random_unit(rng), 1.0, cb)
    return a, place(a, b, n, gap), n


def place(a: Body, b: Body, n: NDArray, gap: float) -> Body:
    """Move b so that its support point along -n stands `gap` above that of a along n."""
    b.x = a.x.copy()
    for body in (a, b):
        c, d = body.half, body.d
        q = body.r**2 * n + (c**2 - body.r**2) * (d @ n) * d
        b.x += q / np.sqrt(n @ q)
    b.x += gap * n
    return b


@pytest.mark.parametrize("ca", [0.05, 0.4, 2.0, 20.0])
@pytest.mark.parametrize("cb", [0.05, 0.4, 2.0, 20.0])
def test_constructed_gap_of_two_spheroids_is_found(ca, cb):
    """Gaps 1e-6 to 1, overlaps to a tenth of the smallest semi-axis; the largest n.D - h_a - h_b
    is the constructed one because no overlap reaches the sum of the smallest curvature radii.
    """
    rng = np.random.default_rng(10)
    smallest, size = min(ca, cb, 1.0), max(ca, cb, 1.0)
    tightest = sum(min(1.0, c) ** 2 / max(1.0, c) for c in (ca, cb))
    overlaps = [-f for f in (1e-6 * smallest, 0.01 * smallest, 0.1 * smallest) if f < tightest]
    for gap in [1.0, 1e-2, 1e-6, 0.0, *overlaps]:
        for _ in range(40):
            a, b, n = spheroid_pair_at(rng, ca, cb, gap)
            (row,) = contacts(a, b)
            assert row[3] == pytest.approx(gap, abs=EXACT * size)
            np.testing.assert_allclose(row[:3], n, atol=1e-8)


@pytest.mark.parametrize(
    ("ca", "cb", "axis_a", "axis_b", "n"),
    [
        (20.0, 20.0, X, X, X),  # tip to tip
        (20.0, 20.0, X, Y, Z),  # bellies crossed
        (20.0, 20.0, X, X, Z),  # side by side
        (20.0, 20.0, X, [1.0, 1e-9, 0.0], Z),
        (0.05, 0.05, Z, Z, Z),  # flat face on flat face
        (0.05, 0.05, Z, [0.0, 1e-6, 1.0], Z),
        (0.05, 0.05, Z, Z, X),  # edge to edge
        (0.05, 0.05, Z, X, Z),  # edge on flat face
        (0.05, 20.0, Z, Z, Z),  # tip on flat face
        (1.0, 1.0, Z, X, [0.6, 0.0, 0.8]),
    ],
)
@pytest.mark.parametrize("gap", [1.0, 1e-6, -0.004])
def test_aligned_spheroids_touch_where_symmetry_says(ca, cb, axis_a, axis_b, n, gap):
    a = Body(SPHEROID, ORIGIN, axis_a, 1.0, ca)
    b = Body(SPHEROID, ORIGIN, np.asarray(axis_b) / np.linalg.norm(axis_b), 1.0, cb)
    n = np.asarray(n)
    (row,) = contacts(a, place(a, b, n, gap))
    assert row[3] == pytest.approx(gap, abs=20.0 * EXACT)
    np.testing.assert_allclose(row[:3], n, atol=1e-9)


def test_distance_of_two_spheroids_agrees_with_brute_force():
    """The twin knows surface points and distances only: no support function, no normal."""
    rng = np.random.default_rng(11)
    for _ in range(12):
        a, b = random_body(rng, SPHEROID), random_body(rng, SPHEROID)
        b.x = twins.random_unit(rng) * rng.uniform(1.0, 1.5) * (max(1, a.half) + max(1, b.half))
        expected = twins.spheroid_pair_distance(b.x, a.d, a.r, a.half, b.d, b.r, b.half)
        assert contacts(a, b)[0, 3] == pytest.approx(expected, abs=BRUTE * max(a.half, b.half, 1))


def test_depth_of_two_spheroids_agrees_with_brute_force():
    """Overlaps of up to half the smallest semi-axis: several directions compete."""
    rng = np.random.default_rng(12)
    for _ in range(12):
        ca, cb = np.exp(rng.uniform(-1.5, 1.5, 2))
        a, b, _ = spheroid_pair_at(rng, ca, cb, -rng.uniform(0.0, 0.5) * min(ca, cb, 1.0))
        expected = twins.spheroid_pair_depth(b.x - a.x, a.d, 1.0, ca, b.d, 1.0, cb)
        assert contacts(a, b)[0, 3] == pytest.approx(expected, abs=BRUTE)


def test_spheroids_of_aspect_one_are_spheres():
    rng = np.random.default_rng(13)
    for _ in range(20):
        x = rng.normal(size=3) * 1.5
        rows = [
            contacts(Body(ka, ORIGIN, twins.random_unit(rng), 1.0, la), Body(kb, x, Z, 0.7, lb))
            for ka, la in ((SPHERE, 0.0), (SPHEROID, 1.0))
            for kb, lb in ((SPHERE, 0.0), (SPHEROID, 0.7))
        ]
        np.testing.assert_allclose(rows[1:], rows[:1] * 3, atol=EXACT)


@pytest.mark.parametrize(("ca", "cb"), [(3.0, 0.3), (20.0, 20.0), (0.05, 0.05), (20.0, 0.05)])
def test_newton_on_the_sphere_of_normals_converges_quadratically(ca, cb):
    """Steps from 1e-3 off: each error is at most C times the square of the one before, with C of
    the order of the relative change of curvature, aspect^2, and round-off is reached in four.
    """
    rng = np.random.default_rng(14)
    a, b, n = spheroid_pair_at(rng, ca, cb, 0.1)
    aspect = max(ca, cb, 1.0 / ca, 1.0 / cb)
    v = n + 1e-3 / aspect * twins.random_unit(rng)
    errors = []
    for _ in range(5):
        v /= np.linalg.norm(v)
        errors.append(np.linalg.norm(v - n))
        _, _, step = newton_direction(
            tuple(v), tuple(b.x - a.x), tuple(a.d), 1.0, ca, tuple(b.d), 1.0, cb
        )
        v = v + np.asarray(step)
    assert errors[-1] < 1e-12
    for before, after in pairwise(errors):
        assert after <= 3.0 * aspect**2 * before**2 + 1e-13


# ---- walls ---------------------------------------------------------------------------------


def plane(point: NDArray, normal: NDArray) -> NDArray:
    return np.concatenate([point, normal, np.zeros(6)])


def rectangle(centre: NDArray, rows: NDArray, width: float, depth: float) -> NDArray:
    """Plate with normal rows[2] and half edges width rows[0], depth rows[1]."""
    return np.concatenate([centre, rows[2], width * rows[0], depth * rows[1]])


def frustum(base, axis, length: float, r0: float, r1: float, side: float) -> NDArray:
    return np.array([*base, *axis, length, r0, r1, side, 0.0, 0.0])


def turned_wall(kind: int, g: NDArray, rotation: NDArray, shift: NDArray) -> NDArray:
    g = g.copy()
    g[0:3] = rotation @ g[0:3] + shift
    for at in {PLANE: [3], RECTANGLE: [3, 6, 9], FRUSTUM: [3]}[kind]:
        g[at : at + 3] = rotation @ g[at : at + 3]
    return g


PLATE = rectangle(ORIGIN, np.eye(3), 2.0, 1.0)
TUBE = frustum(ORIGIN, Z, 4.0, 1.0, 1.0, 1.0)
BODIES = {
    "sphere": (SPHERE, 0.3, 0.0),
    "rod": (SPHEROCYLINDER, 0.3, 0.8),
    "prolate": (SPHEROID, 0.2, 1.0),
    "needle": (SPHEROID, 0.05, 1.0),
    "oblate": (SPHEROID, 0.8, 0.2),
    "disc": (SPHEROID, 1.0, 0.05),
}
WALLS = {
    "plane": (PLANE, plane(ORIGIN, Z)),
    "plate": (RECTANGLE, PLATE),
    "tube": (FRUSTUM, TUBE),
    "pillar": (FRUSTUM, frustum(ORIGIN, Z, 4.0, 1.0, 1.0, -1.0)),
    "cone": (FRUSTUM, frustum(ORIGIN, Z, 3.0, 0.5, 2.0, 1.0)),
    "closing cone": (FRUSTUM, frustum(ORIGIN, Z, 3.0, 2.0, 0.5, 1.0)),
    "funnel outside": (FRUSTUM, frustum(ORIGIN, Z, 3.0, 0.5, 2.0, -1.0)),
    "tip": (FRUSTUM, frustum(ORIGIN, Z, 2.0, 1.0, 0.0, -1.0)),
    "ring": (FRUSTUM, frustum(ORIGIN, Z, 0.0, 0.5, 2.0, 1.0)),
    "ring below": (FRUSTUM, frustum(ORIGIN, Z, 0.0, 0.5, 2.0, -1.0)),
    "ring inwards": (FRUSTUM, frustum(ORIGIN, Z, 0.0, 2.0, 0.5, 1.0)),
}


def wall_distance(kind: int, g: NDArray, y: NDArray) -> NDArray:
    y = np.atleast_2d(y)
    if kind == PLANE:
        return (y - g[0:3]) @ g[3:6]
    return twins.rectangle_distance(y, g) if kind == RECTANGLE else twins.frustum_distance(y, g)


def brute_wall_gap(kind: int, g: NDArray, body: Body) -> float:
    if body.kind == SPHEROID:
        args = (body.x, body.d, body.r, body.half)
        return twins.spheroid_wall_gap(lambda y: wall_distance(kind, g, y), *args)
    args = (body.x, body.d, body.r, body.half)
    return twins.rod_wall_gap(lambda y: wall_distance(kind, g, y), *args)


def bodies_about_a_wall(rng: np.random.Generator, shape: str, count: int) -> list[Body]:
    kind, r, half = BODIES[shape]
    return [
        Body(
            kind, rng.uniform([-2.5, -2.5, -1.0], [2.5, 2.5, 4.0]), twins.random_unit(rng), r, half
        )
        for _ in range(count)
    ]


def stands_apart(kind: int, g: NDArray, body: Body) -> bool:
    """Whether no point of a coarse sample of the body lies on the wall or behind it."""
    if body.kind == SPHEROID:
        u = np.stack(np.meshgrid(np.linspace(0, np.pi, 41), np.linspace(0, 6.2, 41)), -1)
        y = body.x + twins.spheroid_point(u.reshape(-1, 2), body.d, body.r, body.half)
        return wall_distance(kind, g, y).min() > 0.02
    return (
        wall_distance(kind, g, body.x + np.linspace(-1, 1, 41)[:, None] * body.half * body.d).min()
        > body.r
    )


@pytest.mark.parametrize("shape", BODIES)
@pytest.mark.parametrize("wall", WALLS)
def test_gap_to_a_wall_agrees_with_brute_force(shape, wall):
    """Bodies strewn about, apart from the wall; the least contact is the least over all points."""
    rng = np.random.default_rng([list(BODIES).index(shape), list(WALLS).index(wall)])
    kind, g = WALLS[wall]
    apart = (b for b in bodies_about_a_wall(rng, shape, 2000) if stands_apart(kind, g, b))
    for body in islice(apart, 4 if body_is_slow(shape) else 10):
        expected = brute_wall_gap(kind, g, body)
        if expected > 0.0:
            rows = at_wall(kind, g, body)
            assert 1 <= len(rows) <= 2
            assert rows[:, 3].min() == pytest.approx(expected, abs=BRUTE)


def body_is_slow(shape: str) -> bool:
    return BODIES[shape][0] == SPHEROID


@pytest.mark.parametrize("shape", BODIES)
@pytest.mark.parametrize("wall", WALLS)
def test_every_wall_contact_means_what_it_says(shape, wall):
    """Half a gap along n lies the wall, half a gap back the body's surface.

    The second contact of a rod is that of a sphere on its core: its point lies on the surface or
    under it.
    """
    rng = np.random.default_rng([3, list(BODIES).index(shape), list(WALLS).index(wall)])
    kind, g = WALLS[wall]
    seen = 0
    for body in bodies_about_a_wall(rng, shape, 200):
        rows = at_wall(kind, g, body, 2.0)
        if not stands_apart(kind, g, body):
            continue
        for row in rows:
            n, phi, p = row[:3], row[3], row[4:] + body.x
            under = body.distance(p - 0.5 * phi * n)
            assert under < 1e-10
            if body.kind == SPHEROID or phi == rows[:, 3].min():
                assert under > -1e-10
            assert abs(wall_distance(kind, g, p + 0.5 * phi * n)[0]) < 1e-10
            seen += 1
    assert seen > 5


@pytest.mark.parametrize("shape", BODIES)
@pytest.mark.parametrize("wall", WALLS)
def test_rotation_of_wall_and_body_rotates_the_contacts(shape, wall):
    rng = np.random.default_rng([4, list(BODIES).index(shape), list(WALLS).index(wall)])
    kind, g = WALLS[wall]
    for body in bodies_about_a_wall(rng, shape, 20):
        rotation, shift = twins.random_rotation(rng), rng.normal(size=3)
        one = at_wall(kind, g, body, 0.5)
        if len(one) and one[:, 3].min() < -1e-3:  # so deep that two ways out may tie
            continue
        two = at_wall(kind, turned_wall(kind, g, rotation, shift), body.moved(rotation, shift), 0.5)
        assert len(one) == len(two)
        np.testing.assert_allclose(one[:, 3], two[:, 3], atol=1e-11)
        np.testing.assert_allclose(one[:, :3] @ rotation.T, two[:, :3], atol=1e-7)
        np.testing.assert_allclose(one[:, 4:] @ rotation.T, two[:, 4:], atol=1e-7)


@pytest.mark.parametrize("wall", WALLS)
def test_rod_without_length_is_a_sphere_at_every_wall(wall):
    rng = np.random.default_rng(15)
    kind, g = WALLS[wall]
    for sphere in bodies_about_a_wall(rng, "sphere", 50):
        rod = Body(SPHEROCYLINDER, sphere.x, sphere.d, sphere.r, 0.0)
        assert np.array_equal(at_wall(kind, g, sphere, 0.5), at_wall(kind, g, rod, 0.5))


@pytest.mark.parametrize("wall", WALLS)
def test_sphere_touches_a_wall_as_in_scenes_of_spheres(wall):
    """The kernels of spheres alone know the same places, those on the far side included."""
    rng = np.random.default_rng(18)
    kind, g = WALLS[wall]
    face = np.zeros((1, 22))
    face[0, :12], face[0, 21] = g, kind
    for sphere in bodies_about_a_wall(rng, "sphere", 100):
        sphere.r = rng.choice([0.3, 1.2])
        places = np.array(sphere_wall(face, 0, *sphere.x, sphere.r))
        rows = at_wall(kind, g, sphere, 0.5)
        if places[0, 0] <= 0.5:
            expected = places[places[:, 0] <= 0.5]
            np.testing.assert_allclose(rows[:, [3, 0, 1, 2]], expected, atol=EXACT)
        else:
            assert len(rows) == 0


@pytest.mark.parametrize("shape", BODIES)
def test_gap_to_a_wall_shrinks_by_the_way_pushed_into_it(shape):
    """Continuity across touching: the contact of a body pushed in by 1 % along its normal."""
    rng = np.random.default_rng(16)
    for kind, g in WALLS.values():
        for body in bodies_about_a_wall(rng, shape, 15):
            rows = at_wall(kind, g, body)
            if not stands_apart(kind, g, body):
                continue
            row = rows[np.argmin(rows[:, 3])]
            depth = 1e-3 * smallest_size(body.kind, body.r, body.half)
            body.x = body.x + (row[3] + depth) * row[:3]
            pushed = at_wall(kind, g, body)
            at = np.argmin(np.abs(pushed[:, 3] + depth))
            assert pushed[at, 3] == pytest.approx(-depth, abs=1e-3 * depth)
            np.testing.assert_allclose(pushed[at, :3], row[:3], atol=0.05)


# ---- walls: faces, edges, rims by hand -----------------------------------------------------


def rod_at(x, d, r: float = 0.3, half: float = 0.8) -> Body:
    d = np.asarray(d, dtype=np.float64)
    return Body(SPHEROCYLINDER, x, d / np.linalg.norm(d), r, half)


def test_rod_lying_on_a_plane_touches_at_both_ends():
    rows = at_wall(PLANE, plane([0.0, 0.0, 1.0], Z), rod_at([5.0, 0.0, 1.25], X), 0.1)
    np.testing.assert_allclose(rows[:, :3], [-Z, -Z])
    np.testing.assert_allclose(rows[:, 3], -0.05, atol=EXACT)
    np.testing.assert_allclose(rows[:, 4:], [[-0.8, 0.0, -0.275], [0.8, 0.0, -0.275]], atol=EXACT)


def test_rod_standing_on_a_plane_touches_at_its_lower_end():
    (row,) = at_wall(PLANE, plane(ORIGIN, Z), rod_at([0.0, 0.0, 1.2], -Z), 0.2)
    np.testing.assert_allclose(row, [0.0, 0.0, -1.0, 0.1, 0.0, 0.0, -1.15], atol=EXACT)


@pytest.mark.parametrize("aspect", ASPECTS)
def test_spheroid_on_a_plane_touches_below_its_support(aspect):
    """Leaning by 30 degrees: h^2 = (a sin 30)^2 + (c cos 30)^2."""
    d = np.array([0.5, 0.0, np.sqrt(0.75)])
    h = np.sqrt(0.25 + 0.75 * aspect**2)
    (row,) = at_wall(PLANE, plane(ORIGIN, Z), Body(SPHEROID, h * Z, d, 1.0, aspect))
    assert row[3] == pytest.approx(0.0, abs=EXACT)
    assert row[6] == pytest.approx(-h, abs=EXACT)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_plate_is_touched_from_both_sides(side):
    for body in (
        rod_at([0.0, 0.0, side * 0.4], X),
        Body(SPHEROID, [0.0, 0.0, side * 0.4], Z, 1, 0.3),
    ):
        rows = at_wall(RECTANGLE, PLATE, body, 0.2)
        np.testing.assert_allclose(rows[:, 3], 0.1, atol=EXACT)
        np.testing.assert_allclose(rows[:, 2], -side, atol=EXACT)


def test_rod_overhanging_a_plate_touches_at_its_inner_end_and_at_the_edge():
    rows = at_wall(RECTANGLE, PLATE, rod_at([1.9, 0.0, 0.35], X), 0.2)
    np.testing.assert_allclose(rows[:, 4], [-0.8, 0.1], atol=EXACT)
    np.testing.assert_allclose(rows[:, 3], 0.05, atol=EXACT)


def test_rod_beside_an_edge_touches_where_their_overlap_ends():
    rows = at_wall(RECTANGLE, PLATE, rod_at([2.4, 0.7, 0.0], Y), 0.2)
    np.testing.assert_allclose(rows[:, 4:], [[-0.35, -0.8, 0.0], [-0.35, 0.3, 0.0]], atol=EXACT)
    np.testing.assert_allclose(rows[:, :3], [-X, -X], atol=EXACT)


def test_body_at_a_corner_is_pushed_along_the_diagonal():
    corner, out = np.array([2.0, 1.0, 0.0]), np.array([0.6, 0.48, 0.64])
    (row,) = at_wall(RECTANGLE, PLATE, Body(SPHEROID, corner + 1.1 * out, X, 1.0, 1.0), 0.2)
    np.testing.assert_allclose(row, [*-out, 0.1, *(-1.05 * out)], atol=EXACT)
    rows = at_wall(RECTANGLE, PLATE, rod_at(corner + 1.3 * out, out, 0.3, 0.8), 0.3)
    np.testing.assert_allclose(rows[:, :4], [[*-out, 0.2]], atol=EXACT)


def test_rod_that_pierced_a_plate_is_pushed_back_to_the_side_of_its_centre():
    rows = at_wall(RECTANGLE, PLATE, rod_at([0.0, 0.0, 0.3], Z), 0.0)
    np.testing.assert_allclose(rows, [[0.0, 0.0, -1.0, -0.8, 0.0, 0.0, -0.7]], atol=EXACT)


@pytest.mark.parametrize("x", [2.2, -2.2])
def test_rod_that_passes_an_edge_is_not_taken_for_one_that_pierced(x):
    """Its lower end is under the plate, its core goes round the edge: the edge is all it meets."""
    rod = rod_at([x + 0.4 * np.sign(x), 0.0, 0.3], [np.sign(x), 0.0, 1.0])
    rows = at_wall(RECTANGLE, PLATE, rod, 0.5)
    assert rows[:, 3].min() == pytest.approx(brute_wall_gap(RECTANGLE, PLATE, rod), abs=BRUTE)


def test_bodies_across_a_tube_touch_it_at_both_ends():
    for body in (
        rod_at([0.0, 0.0, 2.0], X, 0.3, 0.65),
        Body(SPHEROID, [0.0, 0.0, 2.0], X, 0.2, 0.95),
    ):
        rows = at_wall(FRUSTUM, TUBE, body, 0.1)
        np.testing.assert_allclose(rows[:, :3], [-X, X], atol=1e-9)
        np.testing.assert_allclose(rows[:, 3], 0.05, atol=EXACT)


def test_body_wider_than_the_tube_overlaps_it_on_both_sides():
    for body in (
        rod_at([0.0, 0.0, 2.0], X, 0.3, 0.75),
        Body(SPHEROID, [0.0, 0.0, 2.0], X, 0.2, 1.05),
        Body(SPHEROID, [0.0, 0.0, 2.0], Y, 1.05, 0.2),
    ):
        rows = at_wall(FRUSTUM, TUBE, body, 0.0)
        assert len(rows) == 2
        np.testing.assert_allclose(rows[:, 3], -0.05, atol=EXACT)
        np.testing.assert_allclose(rows[0, :3], -rows[1, :3], atol=1e-9)


def test_body_on_the_axis_of_a_tube_touches_somewhere_around():
    for body in (rod_at([0.0, 0.0, 2.0], Z, 0.95), Body(SPHEROID, [0.0, 0.0, 2.0], Z, 0.95, 0.3)):
        rows = at_wall(FRUSTUM, TUBE, body, 0.1)
        np.testing.assert_allclose(rows[:, 3], 0.05, atol=EXACT)
        np.testing.assert_allclose(rows[:, 2], 0.0, atol=EXACT)


def test_rod_lying_along_a_drum_touches_at_both_ends():
    rows = at_wall(FRUSTUM, TUBE, rod_at([0.65, 0.0, 2.0], Z), 0.1)
    np.testing.assert_allclose(rows[:, 4:], [[0.325, 0.0, -0.8], [0.325, 0.0, 0.8]], atol=EXACT)


def test_rod_across_a_pillar_touches_between_its_ends():
    pillar = WALLS["pillar"][1]
    (row,) = at_wall(FRUSTUM, pillar, rod_at([1.4, 0.3, 2.0], Y), 0.15)
    np.testing.assert_allclose(row, [-1.0, 0.0, 0.0, 0.1, -0.35, -0.3, 0.0], atol=EXACT)


def test_rod_leaning_on_the_rim_of_a_tube_touches_it_there():
    """From inside over the rim: the outer end is beyond the wall without having gone through."""
    rod = rod_at([0.8, 0.0, 4.2], [1.0, 0.0, 0.3], 0.1, 2.0)
    rows = at_wall(FRUSTUM, TUBE, rod, 0.5)
    assert len(rows) >= 1
    assert rows[:, 3].min() == pytest.approx(brute_wall_gap(FRUSTUM, TUBE, rod), abs=BRUTE)


@pytest.mark.parametrize("shape", ["rod", "prolate", "needle", "oblate", "disc"])
def test_body_below_the_outlet_of_a_hopper_is_not_pulled_back(shape):
    """Lying flat under a cone's small end, it reaches under the cone from behind: untouched."""
    kind, r, half = BODIES[shape]
    g = frustum(ORIGIN, Z, 3.0, 0.3, 3.0, 1.0)
    for d in (X, Z, np.array([0.6, 0.0, 0.8])):
        rows = at_wall(FRUSTUM, g, Body(kind, [0.0, 0.0, -1.2], d, r, half), 0.0)
        assert len(rows) == 0


@pytest.mark.parametrize("shape", BODIES)
def test_body_far_behind_a_tube_is_not_touched(shape):
    kind, r, half = BODIES[shape]
    for rho in (2.2, 3.0, 10.0):
        assert len(at_wall(FRUSTUM, TUBE, Body(kind, [rho, 0.0, 2.0], X, r, half), 0.1)) == 0


@pytest.mark.parametrize(
    "body",
    [Body(SPHEROID, [0.0, 0.0, 0.2], Z, 0.8, 0.2), Body(SPHEROID, [0.0, 0.0, 0.2], X, 0.2, 1.0)],
    ids=["disc", "needle across"],
)
def test_body_over_the_hole_of_a_ring_rests_on_its_inner_rim(body):
    """Both contacts on the rim of radius 0.5, as far apart as it is wide."""
    rows = at_wall(FRUSTUM, WALLS["ring"][1], body, 0.2)
    assert len(rows) == 2
    tips = rows[:, 4:] + 0.5 * rows[:, 3:4] * rows[:, :3] + body.x
    np.testing.assert_allclose(np.hypot(tips[:, 0], tips[:, 1]), 0.5, atol=EXACT)
    assert np.linalg.norm(tips[1] - tips[0]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("shape", ["prolate", "needle", "oblate", "disc"])
@pytest.mark.parametrize("wall", ["tube", "cone", "closing cone"])
def test_overlap_with_the_inside_of_a_frustum_agrees_with_brute_force(shape, wall):
    """Away from the rims the depth is that of the deepest surface point, shallow or not."""
    rng = np.random.default_rng([17, list(BODIES).index(shape), list(WALLS).index(wall)])
    kind, g = WALLS[wall]
    for _ in range(3):
        body = Body(SPHEROID, ORIGIN, twins.random_unit(rng), *BODIES[shape][1:])
        radius = g[7] + 0.5 * (g[8] - g[7])
        angle = rng.uniform(0.0, 2.0 * np.pi)
        radial = np.array([np.cos(angle), np.sin(angle), 0.0])
        h = twins.support(radial[None], body.d, body.r, body.half)[0]
        body.x = 0.5 * g[6] * Z + max(radius - 0.98 * h, 0.1) * radial
        expected = brute_wall_gap(kind, g, body)
        if expected > 0.0:
            continue
        assert at_wall(kind, g, body)[:, 3].min() == pytest.approx(expected, abs=BRUTE)


# ---- sizes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "r", "half", "largest", "smallest"),
    [
        (SPHERE, 0.5, 0.0, 0.5, 0.5),
        (SPHEROCYLINDER, 0.5, 2.0, 2.5, 0.5),
        (SPHEROID, 0.5, 2.0, 2.0, 0.5),
        (SPHEROID, 2.0, 0.5, 2.0, 0.5),
    ],
)
def test_sizes_of_a_body(kind, r, half, largest, smallest):
    assert bounding_radius(kind, r, half) == largest
    assert smallest_size(kind, r, half) == smallest
