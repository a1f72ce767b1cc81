"""Near corrections of sums over surface nodes: how sharp the criterion is, and what they add.

Densities are made to fit their grid: modes and Legendre coefficients decay to the tolerance, as
the criterion assumes. References: the same potential with all close panels exact to 1e-13, itself
held against integrals over graded grids; and flows known in closed form.
"""

import numpy as np
import pytest

from stokes.fmm import direct_sum
from stokes.geometry import (
    Body,
    Meridian,
    Resolution,
    SurfaceGrid,
    sphere,
    spherocylinder,
    spheroid,
)
from stokes.modes import from_modes
from stokes.near import Layers, NearField, reach
from stokes.resolution import resolution_for
from stokes.sources import PanelSources, Refinement, Surfaces, UnitShape

from layer_sums import PointForces, on_grid

SHAPES = {
    "sphere": (sphere(), Resolution.uniform(4, 10, 14)),
    "prolate": (spheroid(0.4, 1.0), Resolution.uniform(5, 10, 10)),
    "oblate": (spheroid(1.0, 0.3), Resolution.uniform(6, 8, 12)),
}
SINGLE, DOUBLE = Layers(1.0), Layers(None, 1.0)
QUATERNION = (0.3, -0.7, 0.2, 0.6)


def resolved_density(resolution, tolerance, generator, panel=None):
    """Random nodal values (n, 3), coefficients decaying to the tolerance; largest value 1."""
    modes, q, panels = resolution.modes, resolution.nodes, resolution.panels
    coefficients = generator.normal(size=(modes + 1, 2, 3, panels, q))
    coefficients *= tolerance ** (np.arange(modes + 1) / modes)[:, None, None, None, None]
    coefficients *= tolerance ** (np.arange(q) / (q - 1))
    if panel is not None:
        coefficients[:, :, :, np.arange(panels) != panel] = 0.0
    nodes = np.polynomial.legendre.leggauss(q)[0]
    values = coefficients @ np.polynomial.legendre.legvander(nodes, q - 1).T
    nodal = from_modes(values.reshape(modes + 1, 2, -1), resolution.angles).reshape(-1, 3)
    return nodal / np.abs(nodal).max()


def points_above(curve, gaps, generator):
    """Random points at these distances (k,) from a unit shape, on outward normals."""
    foot = curve.evaluate(generator.uniform(size=len(gaps)))
    theta = generator.uniform(0.0, 2.0 * np.pi, len(gaps))
    r, z = foot.r + gaps * foot.normal_r, foot.z + gaps * foot.normal_z
    return np.column_stack([r * np.cos(theta), r * np.sin(theta), z])


def plain_sum(surfaces, layers, density, points):
    sources = surfaces.sources()
    weights = sources.weights(surfaces.density(density), layers.single, layers.double)
    parts = [
        direct_sum(kernel, sources.points, points, w[:, :, 0])
        for kernel, w in zip(layers.kernels, weights, strict=True)
        if kernel is not None
    ]
    return sum(parts).reshape(len(points), -1)


def corrected_sum(curve, resolution, layers, density, points, tolerance):
    near = NearField([Body(curve)], [resolution], points, layers, tolerance)
    return plain_sum(near.surfaces, layers, density, points) + near.apply(density), near.report


# ---- exactness -------------------------------------------------------------------------------


def graded(begin, end, centre, least, q=24):
    """Gauss nodes and weights on [begin, end], graded by halves towards `centre` down to least."""
    edges = {begin, end}
    for side in (-1.0, 1.0):
        step = max(end - begin, 1.0)
        while step > least:
            edges.add(min(max(centre + side * step, begin), end))
            step *= 0.5
    edges = np.array(sorted(edges))
    x, w = np.polynomial.legendre.leggauss(q)
    length = np.diff(edges)[:, None]
    return (edges[:-1, None] + 0.5 * length * (1 + x)).ravel(), (0.5 * length * w).ravel()


def layers_by_graded_grid(curve, density, point, s0, theta0, gap):
    """S f and D f at a point, by a product grid graded towards (s0, theta0); f a function of x."""
    s, ws = graded(0.0, 1.0, s0, 0.2 * gap)
    t, wt = graded(theta0 - np.pi, theta0 + np.pi, theta0, 0.5 * gap)
    p = curve.evaluate(s)
    cos, sin, one = np.cos(t), np.sin(t), np.ones_like(t)
    y = np.stack([np.outer(p.r, cos), np.outer(p.r, sin), np.outer(p.z, one)], axis=-1)
    nu = np.stack(
        [np.outer(p.normal_r, cos), np.outer(p.normal_r, sin), np.outer(p.normal_z, one)], axis=-1
    )
    weight = np.outer(ws * p.r * p.speed, wt)
    x, f = point - y, density(y)
    r = np.linalg.norm(x, axis=-1)
    along = np.sum(x * f, axis=-1)
    S = (f / r[..., None] + x * (along / r**3)[..., None]) / (8 * np.pi)
    D = 3 / (4 * np.pi) * x * (along * np.sum(x * nu, axis=-1) / r**5)[..., None]
    return [np.einsum("st,sti->i", weight, part) for part in (S, D)]


@pytest.mark.parametrize("gap", [0.3, 0.05, 1e-2, 1e-3])
def test_corrected_layers_equal_integrals_over_graded_grids(gap):
    curve, resolution = spheroid(0.5, 1.0), Resolution.uniform(6, 12, 12)

    def density(y):
        return np.stack([1 + y[..., 1], y[..., 0] * y[..., 2], np.exp(0.5 * y[..., 2])], axis=-1)

    s0, theta0 = np.array([0.02, 0.31, 0.5, 0.84]), np.array([0.1, 2.0, 4.0, 6.0])
    foot = curve.evaluate(s0)
    r, z = foot.r + gap * foot.normal_r, foot.z + gap * foot.normal_z
    points = np.column_stack([r * np.cos(theta0), r * np.sin(theta0), z])
    nodal = density(SurfaceGrid(Meridian(curve, resolution)).points).reshape(-1, 3)
    expected = [
        layers_by_graded_grid(curve, density, *of_one, gap)
        for of_one in zip(points, s0, theta0, strict=True)
    ]
    for layers, exact in zip((SINGLE, DOUBLE), np.moveaxis(expected, 1, 0), strict=True):
        found, _ = corrected_sum(curve, resolution, layers, nodal, points, 1e-11)
        # the density itself is interpolated to some 1e-11
        assert np.abs(found - exact).max() < 1e-10


@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
@pytest.mark.parametrize("gap", [1.0, 0.1, 1e-2, 1e-3, 1e-6, 0.0])
def test_greens_representation_holds_at_any_distance(gap, tolerance):
    """u = -S t + D u outside of point forces in a turned, displaced, scaled spheroid."""
    curve, resolution, scale = spheroid(0.5, 1.0), Resolution.uniform(8, 16, 30), 1.7
    body = Body(curve, scale, (3.0, -1.0, 0.5), QUATERNION)
    generator = np.random.default_rng(5)
    flow = PointForces(0.1 * generator.normal(size=(3, 3)), generator.normal(size=(3, 3)))
    velocity, traction = on_grid(SurfaceGrid(Meridian(curve, resolution)), flow)
    velocity, traction = velocity.reshape(-1, 3), traction.reshape(-1, 3)
    local = points_above(curve, np.full(40, gap), generator)
    points = body.to_world(local)
    found = np.zeros((40, 3))
    for layers, density in ((SINGLE, -traction), (DOUBLE, velocity)):
        near = NearField([body], [resolution], points, layers, tolerance)
        found += plain_sum(near.surfaces, layers, density, points) + near.apply(density)
    error = np.abs(body.vectors_to_local(found) - flow.velocity(local)).max()
    assert error < tolerance * (np.abs(traction).max() + np.abs(velocity).max())


def test_limits_on_the_surface_are_approached_linearly():
    curve, resolution = SHAPES["prolate"]
    generator = np.random.default_rng(7)
    density = resolved_density(resolution, 1e-10, generator)
    foot = np.random.default_rng(8)
    state = foot.bit_generator.state

    def at(gap, layers):
        foot.bit_generator.state = state
        points = points_above(curve, np.full(20, gap), foot)
        return corrected_sum(curve, resolution, layers, density, points, 1e-10)[0]

    for layers in (SINGLE, DOUBLE):
        surface = at(0.0, layers)
        ratio = np.abs(at(4e-5, layers) - surface) / np.abs(at(1e-5, layers) - surface)
        assert np.median(ratio) == pytest.approx(4.0, rel=0.02)  # a gap's next order is 1e-3


def test_double_layer_jumps_by_its_density_single_layer_not():
    curve, resolution = SHAPES["sphere"]
    density = resolved_density(resolution, 1e-10, np.random.default_rng(3))
    grid = SurfaceGrid(Meridian(curve, resolution))
    nodes, normals = grid.points.reshape(-1, 3)[40:80], grid.normals.reshape(-1, 3)[40:80]
    gap = 1e-6
    for layers, jump in ((SINGLE, 0.0), (DOUBLE, density[40:80])):
        outside, inside = (
            corrected_sum(curve, resolution, layers, density, nodes + side * gap * normals, 1e-9)[0]
            for side in (1.0, -1.0)
        )
        # derivatives of potentials of the density's highest modes and degrees times two gaps
        assert np.abs(outside - inside - jump).max() < 100 * gap


@pytest.mark.parametrize("quantity", ["pressure", "stress"])
def test_pressure_and_stress_on_the_surface_are_limits_from_outside(quantity):
    curve, resolution = spheroid(0.7, 1.0), Resolution.uniform(6, 14, 20)
    generator = np.random.default_rng(11)
    flow = PointForces(0.1 * generator.normal(size=(2, 3)), generator.normal(size=(2, 3)))
    velocity, traction = on_grid(SurfaceGrid(Meridian(curve, resolution)), flow)
    points = points_above(curve, np.zeros(30), generator)
    found = 0.0
    for layers, density in (
        (Layers(1.0, None, quantity), -traction.reshape(-1, 3)),
        (Layers(None, 1.0, quantity), velocity.reshape(-1, 3)),
    ):
        found = found + corrected_sum(curve, resolution, layers, density, points, 1e-8)[0]
    if quantity == "pressure":
        exact = flow.pressure(points)[:, None]
    else:
        exact = flow.stress(points).reshape(-1, 9)[:, [0, 4, 8, 5, 2, 1]]
    assert np.abs(found - exact).max() < 1e-8 * np.abs(traction).max()


# ---- criterion -------------------------------------------------------------------------------

KERNELS = [
    Layers(1.0),
    Layers(None, 1.0),
    Layers(0.7, 1.0),
    Layers(1.0, None, "pressure"),
    Layers(None, 1.0, "pressure"),
    Layers(1.0, None, "stress"),
    Layers(None, 1.0, "stress"),
]


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-9])
@pytest.mark.parametrize("layers", KERNELS, ids=lambda layers: repr(layers)[6:])
def test_errors_stay_below_the_tolerance_at_random_targets(layers, tolerance):
    for seed, (curve, resolution) in enumerate(SHAPES.values()):
        generator = np.random.default_rng(seed)
        density = resolved_density(resolution, tolerance, generator)
        gaps = 10.0 ** generator.uniform(-3.0, 0.0, 60)
        points = points_above(curve, gaps, generator)
        found, _ = corrected_sum(curve, resolution, layers, density, points, tolerance)
        exact, _ = corrected_sum(curve, resolution, layers, density, points, 1e-13)
        error = np.abs(found - exact).max(axis=1)
        # of the potential where that exceeds the density, as stresses next to a surface do
        assert (error < tolerance * np.maximum(1.0, np.abs(exact).max(axis=1))).all()


@pytest.mark.parametrize(
    "curve",
    [spheroid(0.05, 1.0), spheroid(1.0, 0.05), spherocylinder(0.2, 0.8)],
    ids=["slender", "flat", "rod"],
)
def test_criterion_holds_on_extreme_shapes(curve):
    """Far sides of thin bodies, sharp rims and tips, panels of unlike lengths."""
    resolution = resolution_for(curve, 1e-6)
    generator = np.random.default_rng(1)
    density = resolved_density(resolution, 1e-6, generator)
    points = points_above(curve, 10.0 ** generator.uniform(-4.0, 0.0, 60), generator)
    for layers in (SINGLE, DOUBLE):
        found, _ = corrected_sum(curve, resolution, layers, density, points, 1e-6)
        exact, _ = corrected_sum(curve, resolution, layers, density, points, 1e-12)
        assert np.abs(found - exact).max() < 1e-6


@pytest.mark.parametrize("layers", [SINGLE, DOUBLE])
def test_few_panels_are_corrected_in_vain(layers):
    """Of panels taken to miss 1e-6, the plain rule misses 3e-8 on most: digits go by distance."""
    curve, resolution = SHAPES["prolate"]
    generator = np.random.default_rng(4)
    points = points_above(curve, 10.0 ** generator.uniform(-2.0, 0.0, 80), generator)
    missed = corrected = 0
    for panel in range(resolution.panels):
        density = resolved_density(resolution, 1e-6, generator, panel)
        near = NearField([Body(curve)], [resolution], points, layers, 1e-6)
        exact, _ = corrected_sum(curve, resolution, layers, density, points, 1e-12)
        error = np.abs(plain_sum(near.surfaces, layers, density, points) - exact).max(axis=1)
        touched = np.abs(near.apply(density)).max(axis=1) > 0.0
        assert (error[~touched] < 1e-6).all()
        corrected += touched.sum()
        missed += (error[touched] > 3e-8).sum()
    assert missed > 0.6 * corrected


def test_nothing_is_corrected_beyond_reach():
    curve, resolution = SHAPES["oblate"]
    shape = UnitShape(curve, resolution)
    for layers in (SINGLE, DOUBLE):
        far = reach(shape, layers, 1e-6)
        generator = np.random.default_rng(9)
        points = points_above(curve, np.full(200, far), generator)
        assert NearField([Body(curve)], [resolution], points, layers, 1e-6).report.pairs == 0
        nearer = points_above(curve, np.full(200, 0.5 * far), generator)
        assert NearField([Body(curve)], [resolution], nearer, layers, 1e-6).report.pairs > 0


# ---- the linear map --------------------------------------------------------------------------


def neighbours():
    """Two bodies a gap of 0.005 apart, of unlike shapes and sizes, and their nodes with owners."""
    bodies = [
        Body(sphere(), 1.0),
        Body(spheroid(0.4, 1.0), 0.5, (0.0, 0.0, 1.505)),
    ]
    resolutions = [SHAPES["sphere"][1], SHAPES["prolate"][1]]
    surfaces = Surfaces(bodies, resolutions)
    owner = np.repeat([0, 1], np.diff(surfaces.start))
    return bodies, resolutions, surfaces.sources().points, owner


def test_nodes_are_not_corrected_for_their_own_body():
    bodies, resolutions, nodes, owner = neighbours()
    near = NearField(bodies, resolutions, nodes, SINGLE, 1e-6, owner)
    density = np.random.default_rng(0).normal(size=nodes.shape)
    for body in (0, 1):
        alone = np.where(owner[:, None] == body, density, 0.0)
        corrected = near.apply(alone)
        assert not corrected[owner == body].any()
        assert corrected[owner != body].any()


def test_many_densities_at_once_are_corrected_as_one_by_one():
    bodies, resolutions, nodes, owner = neighbours()
    near = NearField(bodies, resolutions, nodes, Layers(0.3, 1.0), 1e-6, owner)
    assert near.report.exact > 0
    assert near.report.refined > 0
    densities = np.random.default_rng(0).normal(size=(*nodes.shape, 5))
    together = near.apply(densities)
    for k in range(5):
        np.testing.assert_allclose(
            together[:, :, k], near.apply(densities[:, :, k]), rtol=0, atol=1e-13
        )


def test_coefficients_of_each_body_scale_its_part():
    bodies, resolutions, nodes, owner = neighbours()
    density = np.random.default_rng(0).normal(size=nodes.shape)
    unit, scaled = (
        NearField(bodies, resolutions, nodes, Layers(a, b), 1e-8, owner).apply(density)
        for a, b in ((1.0, 1.0), (np.array([2.0, 3.0]), np.array([2.0, 3.0])))
    )
    # targets on one body see the other alone
    factor = np.where(owner == 0, 3.0, 2.0)[:, None]
    np.testing.assert_allclose(scaled, factor * unit, rtol=0, atol=1e-12)


def test_blocks_and_refined_panels_agree():
    """Many applications make more blocks; little memory for blocks makes fewer."""
    bodies, resolutions, nodes, owner = neighbours()
    density = np.concatenate(
        [resolved_density(r, 1e-8, np.random.default_rng(0)) for r in resolutions]
    )
    few, many, least = (
        NearField(
            *(bodies, resolutions, nodes, DOUBLE, 1e-8, owner),
            applications=applications,
            block_memory=memory,
        )
        for applications, memory in ((1, 1e9), (1000, 1e9), (1000, 0.0))
    )
    assert least.report.exact <= few.report.exact < many.report.exact
    assert few.report.pairs == many.report.pairs == least.report.pairs
    for near in (many, least):
        assert np.abs(near.apply(density) - few.apply(density)).max() < 1e-8


def test_corrections_do_not_depend_on_threads():
    bodies, resolutions, nodes, owner = neighbours()
    density = np.random.default_rng(0).normal(size=nodes.shape)
    one, two = (
        NearField(bodies, resolutions, nodes, DOUBLE, 1e-6, owner, threads=n).apply(density)
        for n in (1, 2)
    )
    np.testing.assert_array_equal(one, two)


def test_no_targets_or_no_bodies_are_no_corrections():
    curve, resolution = SHAPES["sphere"]
    near = NearField([Body(curve)], [resolution], np.empty((0, 3)), SINGLE, 1e-6)
    assert near.apply(np.zeros((resolution.surface_nodes, 3))).shape == (0, 3)
    assert NearField([], [], np.zeros((2, 3)), SINGLE, 1e-6).apply(np.empty((0, 3))).shape == (2, 3)


def test_requests_that_make_no_sense_are_refused():
    curve, resolution = SHAPES["sphere"]
    with pytest.raises(ValueError, match="single or a double"):
        Layers(None, None)
    with pytest.raises(ValueError, match="quantity"):
        Layers(1.0, None, "vorticity")
    with pytest.raises(ValueError, match="targets"):
        NearField([Body(curve)], [resolution], np.zeros(3), SINGLE, 1e-6)
    with pytest.raises(ValueError, match="tolerance"):
        NearField([Body(curve)], [resolution], np.zeros((1, 3)), SINGLE, 0.0)
    near = NearField([Body(curve)], [resolution], np.ones((1, 3)), SINGLE, 1e-6)
    with pytest.raises(ValueError, match="density"):
        near.apply(np.zeros((3, 3)))


# ---- sources ---------------------------------------------------------------------------------


def test_refined_panels_hold_the_same_density():
    """A field with few modes, smooth along the meridian, at refined nodes of two of five panels."""
    curve, resolution = spheroid(0.4, 1.0), Resolution.uniform(5, 12, 10)
    body = Body(curve, 2.0, (1.0, 2.0, 3.0), QUATERNION)
    surfaces = Surfaces([body], [resolution])
    panels = PanelSources(
        surfaces, np.array([0, 0]), np.array([1, 4]), [Refinement(3, 2), Refinement(1, 1)]
    )
    assert panels.end[-1] == 12 * 21 * (6 + 1)

    def field(x):
        return np.stack([x[:, 0] * x[:, 1], x[:, 2] ** 2, np.cos(x[:, 2]) * x[:, 0]], axis=1)

    nodal = field(body.to_local(surfaces.sources().points))
    weights = panels.single_weights(surfaces.density(nodal))[:, :, 0]
    area = panels.single_weights(surfaces.density(np.tile([1.0, 0.0, 0.0], (len(nodal), 1))))
    area = np.linalg.norm(area[:, :, 0], axis=1)
    expected = area[:, None] * body.vectors_to_world(field(body.to_local(panels.points)))
    np.testing.assert_allclose(weights, expected, rtol=0, atol=1e-12 * area.max())


def test_weights_integrate_over_the_surface():
    body = Body(spheroid(0.4, 1.0), 2.0, (1.0, 2.0, 3.0), QUATERNION)
    surfaces = Surfaces([body], [Resolution.uniform(5, 12, 10)])
    axis = np.tile([0.0, 0.0, 1.0], (surfaces.nodes, 1))
    # f = scale/viscosity rho: forces of a unit traction are the area over 8 pi
    total = surfaces.sources().single_weights(surfaces.density(axis)).sum(axis=(0, 2))
    area = SurfaceGrid(Meridian(body.curve, Resolution.uniform(5, 12, 10))).area
    np.testing.assert_allclose(total, body.axis * area * 2.0 / (8 * np.pi), rtol=1e-12, atol=1e-13)


def test_constant_double_layer_is_minus_one_inside_and_nothing_outside():
    body = Body(spheroid(0.4, 1.0), 2.0, (1.0, 2.0, 3.0), QUATERNION)
    surfaces = Surfaces([body], [Resolution.uniform(5, 12, 10)])
    constant = np.tile([0.3, -0.2, 0.9], (surfaces.nodes, 1))
    centre = np.array(body.centre)
    points = np.array([centre, centre + 6.0])
    found = plain_sum(surfaces, DOUBLE, constant, points)
    expected = [-body.vectors_to_world(constant[0]), np.zeros(3)]
    # the plain rule at a distance of 0.4 from the surface: e^{-21 xi}, xi = 1 at the equator
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)
