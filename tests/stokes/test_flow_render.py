"""Pictures of a flow: the plane, distances to bodies, and drawings that always come out."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from stokes.geometry import Body, sphere, spheroid
from stokes.render import Plane, distance_to_bodies, draw_slice

BODIES = [
    Body(sphere(), 0.1, (0.0, 0.5, 0.0)),
    Body(spheroid(1.0, 2.0), 0.1, (0.4, 0.5, 0.1), (0.8, 0.0, 0.6, 0.0)),
]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_plane_is_as_large_as_all_bodies(axis):
    plane = Plane.through(BODIES, axis)
    points = plane.points()
    assert len(points) == plane.counts[0] * plane.counts[1]
    assert np.ptp(points[:, axis]) == 0.0
    low = np.array([np.array(b.centre) - b.bounding_radius for b in BODIES]).min(axis=0)
    high = np.array([np.array(b.centre) + b.bounding_radius for b in BODIES]).max(axis=0)
    for k in plane.across:
        assert points[:, k].min() < low[k] and points[:, k].max() > high[k]
    # The first side runs fastest.
    right, up = plane.sides()
    np.testing.assert_array_equal(points[: len(right), plane.across[0]], right)
    np.testing.assert_array_equal(points[:: len(right), plane.across[1]], up)


def test_a_plane_cuts_as_many_bodies_as_it_can():
    places = [0.0, 0.3, 0.32, 0.9, 0.34, 0.88]
    bodies = [Body(sphere(), 0.1, (k, place, 0.0)) for k, place in enumerate(places)]
    assert Plane.through(bodies, 1).place in (0.3, 0.32, 0.34)
    assert Plane.through(bodies[:1], 1).place == 0.0


def test_a_plane_can_be_put_anywhere_and_its_points_are_square():
    plane = Plane.through(BODIES, 1, 0.55, longest=50)
    assert (plane.points()[:, 1] == 0.55).all() and max(plane.counts) == 50
    steps = [side[1] - side[0] for side in plane.sides()]
    assert steps[0] == pytest.approx(steps[1], rel=0.05)


def test_distances_are_exact_near_spheres_and_negative_inside():
    points = Plane.through(BODIES[:1], 1).points()
    exact = np.linalg.norm(points - BODIES[0].centre, axis=1) - 0.1
    found = distance_to_bodies(points, BODIES[:1])
    near = exact < 0.04
    np.testing.assert_allclose(found[near], exact[near], rtol=0, atol=1e-9)
    assert (found[~near] > 0.0).all()


def test_a_spheroid_is_outlined_where_it_is():
    body = BODIES[1]
    rng = np.random.default_rng(2)
    n = rng.standard_normal((200, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    surface = body.to_world(n * [1.0, 1.0, 2.0])
    # Distances come from polynomials along the meridian.
    np.testing.assert_allclose(distance_to_bodies(surface, [body]), 0.0, atol=1e-8)
    inward = np.array(body.centre) + 0.9 * (surface - body.centre)
    assert (distance_to_bodies(inward, BODIES) < 0.0).all()


@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")
@pytest.mark.parametrize("kind", ["flow", "at rest", "nothing known"])
@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_any_flow_can_be_drawn(tmp_path, kind, suffix):
    plane = Plane.through(BODIES, longest=30)
    points = plane.points()
    velocity = np.stack([points[:, 2], 0.0 * points[:, 0], -points[:, 0]], axis=1)
    velocity *= kind == "flow"
    velocity[distance_to_bodies(points, BODIES) < 0.0] = np.nan
    if kind == "nothing known":
        velocity[:] = np.nan
    path = tmp_path / f"flow{suffix}"
    draw_slice(path, plane, velocity, BODIES, "two bodies", width=400)
    assert path.stat().st_size > 5_000


@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")
def test_a_plane_without_bodies_can_be_drawn(tmp_path):
    plane = Plane.through(BODIES, 1, 9.0, longest=20)
    draw_slice(tmp_path / "flow.png", plane, np.ones((len(plane.points()), 3)), BODIES, width=300)
