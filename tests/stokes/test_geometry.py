import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stokes.geometry import (
    Body,
    Meridian,
    Resolution,
    SurfaceGrid,
    fourier_curve,
    resolution_for,
    sphere,
    spherocylinder,
    spheroid,
)


def spheroid_area(a, c):
    if a == c:
        return 4 * np.pi * a**2
    if c > a:
        e = np.sqrt(1 - (a / c) ** 2)
        return 2 * np.pi * a**2 * (1 + c / (a * e) * np.arcsin(e))
    e = np.sqrt(1 - (c / a) ** 2)
    return 2 * np.pi * a**2 * (1 + (1 - e**2) / e * np.arctanh(e))


@pytest.mark.parametrize("axes", [(1, 1), (0.5, 1), (1, 0.5), (0.05, 1), (1, 0.05)])
def test_area_and_volume_of_spheroids_to_round_off(axes):
    a, c = axes
    curve = spheroid(a, c)
    resolution = resolution_for(curve, 1e-14)
    grid = SurfaceGrid(Meridian(curve, resolution))
    # Sums of some hundred terms of one sign.
    assert grid.area == pytest.approx(spheroid_area(a, c), rel=5e-15)
    assert grid.volume == pytest.approx(4 / 3 * np.pi * a * a * c, rel=5e-15)
    assert grid.weights.sum() == pytest.approx(grid.area, rel=5e-15)


def test_area_of_a_spheroid_converges_with_the_order_of_its_gauss_rule():
    curve = spheroid(0.5, 1.0)
    areas = np.array([Meridian(curve, Resolution.uniform(n, 4, 0)).area for n in (4, 8, 16)])
    errors = np.abs(areas - spheroid_area(0.5, 1.0))
    # Four Gauss nodes: order 8.
    assert np.all(np.log2(errors[:-1] / errors[1:]) > 7)


def test_enclosed_volume_is_the_same_from_three_fluxes():
    curve = fourier_curve([1.0, 0.1, 0.3], [0.2, 1.2, 0.05])
    grid = SurfaceGrid(Meridian(curve, resolution_for(curve, 1e-13)))
    fluxes = np.einsum("sk,skd->d", grid.weights, grid.points * grid.normals)
    np.testing.assert_allclose(fluxes, grid.volume, rtol=1e-13)


def test_curvatures_integrate_to_four_pi():
    # Gauss-Bonnet: the integral of the Gaussian curvature.
    for curve in (spherocylinder(0.3, 1.0), fourier_curve([1.0, 0.0, 0.3], [0.0, 1.2])):
        meridian = Meridian(curve, resolution_for(curve, 1e-13))
        k = meridian.curvatures.prod(axis=1)
        total = 2 * np.pi * np.sum(meridian.weights * meridian.r * k)
        assert total == pytest.approx(4 * np.pi, rel=1e-12)


def test_grid_integrates_spherical_harmonics_exactly():
    grid = SurfaceGrid(Meridian(sphere(), Resolution.uniform(3, 12, 4)))
    x, y, z = np.moveaxis(grid.points, -1, 0)
    # int x^2 y^2 = 4 pi/15; int x y z^2 = 0; degrees in angle up to 2 modes.
    assert np.sum(grid.weights * x**2 * y**2) == pytest.approx(4 * np.pi / 15, rel=1e-14)
    assert np.sum(grid.weights * x * y * z**2) == pytest.approx(0, abs=1e-15)
    np.testing.assert_allclose(grid.normals, grid.points, atol=1e-15)
    assert grid.shape == (36, 9)


def test_cylindrical_components_are_radial_azimuthal_axial():
    grid = SurfaceGrid(Meridian(spheroid(0.5, 1.0), Resolution.uniform(2, 6, 3)))
    components = grid.to_cylindrical(grid.normals)
    np.testing.assert_allclose(components[..., 0], grid.meridian.normal_r[:, None] * np.ones(7))
    np.testing.assert_allclose(components[..., 1], 0, atol=1e-15)
    spin = np.cross([0, 0, 1.0], grid.points)
    np.testing.assert_allclose(
        grid.to_cylindrical(spin)[..., 1], grid.meridian.r[:, None] * np.ones(7), atol=1e-15
    )
    field = np.random.default_rng(1).normal(size=(*grid.shape, 3, 2))
    np.testing.assert_allclose(grid.to_cartesian(grid.to_cylindrical(field)), field, atol=1e-14)


def test_body_places_its_points_by_scale_rotation_and_centre():
    rotation = Rotation.random(random_state=3)
    x, y, z, w = rotation.as_quat()
    body = Body(spheroid(0.5, 1.0), 2.0, (1.0, -2.0, 3.0), (w, x, y, z))
    points = np.random.default_rng(2).normal(size=(5, 4, 3))
    expected = rotation.apply(2.0 * points.reshape(-1, 3)).reshape(points.shape) + body.centre
    np.testing.assert_allclose(body.to_world(points), expected, atol=1e-14)
    np.testing.assert_allclose(body.to_local(body.to_world(points)), points, atol=1e-14)
    np.testing.assert_allclose(body.axis, rotation.apply([0, 0, 1]), atol=1e-15)
    vectors = body.vectors_to_world(points)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), np.linalg.norm(points, axis=-1))
    np.testing.assert_allclose(body.vectors_to_local(vectors), points, atol=1e-14)
    assert 2.0 <= body.bounding_radius < 2.01


def test_bodies_compare_by_value_and_scale_their_quaternion():
    body = Body(sphere(), 1.0, np.zeros(3), (2.0, 0.0, 0.0, 0.0))
    assert body == Body(sphere())
    assert hash(body) == hash(Body(sphere()))


@pytest.mark.parametrize(
    "arguments",
    [
        {"scale": 0.0},
        {"scale": np.nan},
        {"centre": (0.0, 0.0)},
        {"centre": (0.0, np.inf, 0.0)},
        {"quaternion": (0.0, 0.0, 0.0, 0.0)},
        {"quaternion": (1.0, 0.0, 0.0)},
    ],
)
def test_bodies_with_impossible_places_are_refused(arguments):
    with pytest.raises(ValueError, match="Body"):
        Body(sphere(), **arguments)
