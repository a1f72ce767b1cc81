import numpy as np
import pytest
from scipy.optimize import minimize

from stokes.geometry import (
    Body,
    close_pairs,
    distance,
    fourier_curve,
    gaps,
    gaps_of_pairs,
    sphere,
    spherocylinder,
    spheroid,
)

SHAPES = (
    sphere(),
    spheroid(0.5, 1.0),
    spheroid(1.0, 0.4),
    spherocylinder(0.3, 1.0),
    spheroid(0.05, 1.0),
    spheroid(1.0, 0.05),
)


def scattered(count, seed, spread):
    rng = np.random.default_rng(seed)
    return [
        Body(
            SHAPES[rng.integers(len(SHAPES))],
            rng.uniform(0.5, 1.5),
            tuple(spread * rng.normal(size=3)),
            tuple(rng.normal(size=4)),
        )
        for _ in range(count)
    ]


def least_distance_twin(first, second, rng):
    """The same by a general minimiser over four surface coordinates, from many starts."""

    def apart(u):
        ends = []
        for body, s, phi in ((first, *u[:2]), (second, *u[2:])):
            p = body.curve.evaluate(s)
            ends.append(body.to_world([p.r * np.cos(phi), p.r * np.sin(phi), p.z]))
        return np.linalg.norm(ends[0] - ends[1])

    bounds = [(0, 1), (None, None)] * 2
    options = {"ftol": 1e-15, "gtol": 1e-10}
    starts = rng.uniform(0, [1, 2 * np.pi, 1, 2 * np.pi], (12, 4))
    return min(
        minimize(apart, u, bounds=bounds, method="L-BFGS-B", options=options).fun for u in starts
    )


@pytest.mark.parametrize("curve", SHAPES, ids=lambda c: type(c).__name__)
def test_points_along_normals_are_as_far_as_they_were_moved(curve):
    rng = np.random.default_rng(1)
    s = rng.uniform(0, 1, 300)
    points = curve.evaluate(s)
    for moved in (1e-9, 1e-3, 0.3, 5.0):
        delta, foot = distance(
            curve, points.r + moved * points.normal_r, points.z + moved * points.normal_z
        )
        np.testing.assert_allclose(delta, moved, rtol=1e-13, atol=1e-14)
        # The foot moves by the rounding of the point over |gamma'|, which is small on thin shapes.
        np.testing.assert_allclose(foot, s, atol=1e-12)


def test_distances_inside_are_negative_down_to_the_medial_axis():
    curve = spheroid(0.5, 1.0)
    # The centre is half an equator away from the equator; along the axis the evolute ends at
    # c - a^2/c: nearer the pole the pole is nearest.
    delta, s = distance(curve, [0.0, 0.0], [0.0, 0.9])
    np.testing.assert_allclose(delta, [-0.5, -0.1], atol=1e-14)
    np.testing.assert_allclose(s, [0.5, 0.0], atol=1e-7)


def test_distance_finds_the_nearer_of_two_bulges():
    curve = fourier_curve([1.0, 0.0, 0.6], [0.0, 1.2])  # waist at the equator
    points = curve.evaluate(np.linspace(0, 1, 20001))
    rng = np.random.default_rng(3)
    r, z = rng.uniform(0, 2, 200), rng.uniform(-2, 2, 200)
    delta, _ = distance(curve, r, z)
    sampled = np.hypot(points.r - r[:, None], points.z - z[:, None]).min(axis=1)
    # Sampled at 20001 points the distance is too long by (step)^2/(8 distance).
    np.testing.assert_allclose(np.abs(delta), sampled, atol=1e-5)
    assert np.all(np.abs(delta) <= sampled + 1e-14)


def test_gap_of_spheres_is_exact_for_any_orientation():
    first = Body(sphere(), 1.5, (0.0, 0.0, 0.0), (0.3, 0.1, -0.5, 0.2))
    second = Body(spheroid(2.0, 2.0), 0.5, (0.0, 3.0, 4.0), (0.9, 0.1, 0.5, 0.2))
    found = gaps([first], [second])
    assert found.distance[0] == pytest.approx(2.5, rel=1e-15)
    np.testing.assert_allclose(found.points[0, 0], [0, 0.9, 1.2], atol=1e-15)
    np.testing.assert_allclose(found.points[0, 1], [0, 2.4, 3.2], atol=1e-15)
    for body, s, point in zip((first, second), found.s[0], found.points[0], strict=True):
        assert body.to_local(point)[2] == pytest.approx(body.curve.evaluate(s).z, abs=1e-14)


def test_gaps_agree_with_a_general_minimiser():
    first, second = scattered(6, 10, 0.0), scattered(6, 11, 2.5)
    found = gaps(first, second)
    rng = np.random.default_rng(12)
    apart = found.distance > 0
    assert apart.sum() >= 4
    for i in np.flatnonzero(apart):
        # The minimiser stops when its steps gain nothing: never below ours.
        twin = least_distance_twin(first[i], second[i], rng)
        assert found.distance[i] == pytest.approx(twin, rel=1e-9)
        assert found.distance[i] < twin + 1e-14


def test_gap_does_not_depend_on_the_order_of_the_bodies():
    first, second = scattered(40, 20, 0.0), scattered(40, 21, 2.0)
    there, back = gaps(first, second), gaps(second, first)
    apart = there.distance > 0
    assert 20 < apart.sum() < 40
    np.testing.assert_array_equal(apart, back.distance > 0)
    np.testing.assert_allclose(there.distance[apart], back.distance[apart], rtol=1e-12)
    lengths = np.linalg.norm(there.points[:, 0] - there.points[:, 1], axis=1)
    np.testing.assert_allclose(lengths, np.abs(there.distance), atol=1e-13)


def test_gap_of_dented_bodies_is_the_least_of_both_ways():
    curve = fourier_curve([1.0, 0.0, 0.6], [0.0, 1.2])
    rng = np.random.default_rng(5)
    first = [Body(curve, 1.0, (0.0, 0.0, 0.0), tuple(rng.normal(size=4))) for _ in range(30)]
    second = [
        Body(curve, 0.8, tuple(1.5 * rng.normal(size=3)), tuple(rng.normal(size=4)))
        for _ in range(30)
    ]
    there, back = gaps(first, second), gaps(second, first)
    apart = there.distance > 0
    assert apart.sum() > 10
    np.testing.assert_allclose(there.distance[apart], back.distance[apart], rtol=1e-12)
    for i in np.flatnonzero(apart)[:3]:
        twin = least_distance_twin(first[i], second[i], rng)
        assert there.distance[i] < twin * (1 + 1e-9)


@pytest.mark.parametrize("gap", [1e-1, 1e-3, 1e-6])
def test_gap_of_coaxial_and_side_by_side_spheroids(gap):
    curve = spheroid(0.25, 1.0)
    body = Body(curve)
    above = Body(curve, 1.0, (0.0, 0.0, 2.0 + gap))
    beside = Body(curve, 1.0, (0.5 + gap, 0.0, 0.0))
    found = gaps([body, body], [above, beside])
    np.testing.assert_allclose(found.distance, gap, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.s, [[0, 1], [0.5, 0.5]], atol=1e-6)


def test_overlapping_bodies_have_negative_gaps():
    a, b = Body(spheroid(0.5, 1.0)), Body(spheroid(0.5, 1.0), 1.0, (0.9, 0.0, 0.0))
    found = gaps([a], [b])
    # The deepest points of the first in the second lie about its equator.
    assert found.distance[0] == pytest.approx(-0.1, abs=1e-12)


def test_close_pairs_are_those_whose_bounding_spheres_are_near():
    bodies = scattered(60, 30, 4.0)
    reach = 0.7
    centres = np.array([body.centre for body in bodies])
    radii = np.array([body.bounding_radius for body in bodies])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2) - radii[:, None] - radii
    expected = np.argwhere(np.triu(apart < reach, 1))
    np.testing.assert_array_equal(close_pairs(bodies, reach), expected)
    assert len(close_pairs(bodies[:1], reach)) == 0
    assert len(gaps_of_pairs(bodies, np.empty((0, 2), int)).distance) == 0


def test_bounding_spheres_hold_their_bodies():
    for body in scattered(12, 40, 1.0):
        points = body.curve.evaluate(np.linspace(0, 1, 4001))
        assert body.scale * np.hypot(points.r, points.z).max() <= body.bounding_radius
