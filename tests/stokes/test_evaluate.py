"""Flows at arbitrary points, from densities known in closed form.

Outside of point forces inside a body, Green's representation u = -S t + D u holds, and with it
pressure and stress: both layers and all quantities, exact at any distance. Errors are relative to
the largest density.
"""

import numpy as np
import pytest

from stokes.evaluate import evaluate
from stokes.exact import sphere_pressure, sphere_velocity
from stokes.geometry import Body, Meridian, Resolution, SurfaceGrid, sphere, spheroid

from layer_sums import PointForces, on_grid

RESOLUTION = Resolution.uniform(8, 16, 30)
COARSE = Resolution.uniform(5, 12, 16)
CURVE = spheroid(0.6, 1.0)
VISCOSITY = 2.5
QUANTITIES = ("velocity", "pressure", "stress")
GAPS = (1.0, 0.1, 1e-2, 1e-3, 1e-6, 0.0)


class ForcesInBody:
    """Green's representation of point forces inside a spheroid of some place, size and turn."""

    def __init__(self, seed, scale=1.7, centre=(3.0, -1.0, 0.5), resolution=RESOLUTION):
        generator = np.random.default_rng(seed)
        self.body = Body(CURVE, scale, centre, tuple(generator.normal(size=4)))
        self.flow = PointForces(
            self.body.to_world(0.1 * generator.normal(size=(3, 3))), generator.normal(size=(3, 3))
        )
        grid = SurfaceGrid(Meridian(CURVE, resolution))
        turned = _Turned(self.flow, self.body)
        velocity, traction = on_grid(grid, turned)
        self.single = -traction.reshape(-1, 3)
        self.double = velocity.reshape(-1, 3) / VISCOSITY

    def points(self, gaps, generator):
        """Random points at these distances from the surface, in units of the body's scale."""
        foot = CURVE.evaluate(generator.uniform(size=len(gaps)))
        theta = generator.uniform(0.0, 2.0 * np.pi, len(gaps))
        r, z = foot.r + gaps * foot.normal_r, foot.z + gaps * foot.normal_z
        return self.body.to_world(np.column_stack([r * np.cos(theta), r * np.sin(theta), z]))

    def exact(self, quantity, points):
        if quantity == "velocity":
            return self.flow.velocity(points) / VISCOSITY
        if quantity == "pressure":
            return self.flow.pressure(points)
        return self.flow.stress(points).reshape(-1, 9)[:, [0, 4, 8, 5, 2, 1]]

    def unit(self, quantity):
        """Largest density, in the units of the quantity."""
        rho, mu = np.abs(self.single).max(), np.abs(self.double).max()
        scale = self.body.scale
        if quantity == "velocity":
            return max(rho * scale / VISCOSITY, mu)
        return max(rho, mu * VISCOSITY / scale)


class _Turned:
    """A flow in a body's frame; lengths stay those of the world."""

    def __init__(self, flow, body):
        self.flow, self.body = flow, body

    def velocity(self, points):
        return self.body.vectors_to_local(self.flow.velocity(self.body.to_world(points)))

    def stress(self, points):
        R = self.body.rotation
        stress = self.flow.stress(self.body.to_world(points)).reshape(-1, 3, 3)
        return np.einsum("ji,njk,kl->nil", R, stress, R)


@pytest.mark.parametrize(
    ("quantity", "tolerance"),
    [(quantity, 1e-6) for quantity in QUANTITIES]
    # next to a surface the kernels 1/r^3 lose eps/distance, and differentiate the interpolation
    + [("velocity", 1e-10), ("pressure", 1e-8), ("stress", 1e-8)],
)
def test_flow_keeps_its_tolerance_up_to_the_surface(quantity, tolerance):
    case, generator = ForcesInBody(1), np.random.default_rng(2)
    points = case.points(np.repeat(GAPS, 15), generator)
    found = evaluate(
        *([case.body], [RESOLUTION], points, case.single, case.double, quantity, VISCOSITY),
        tolerance=tolerance,
    )
    error = np.abs(found - case.exact(quantity, points)) / case.unit(quantity)
    assert error.max() < tolerance


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_points_at_nodes_and_just_above_lose_no_digits(quantity):
    case = ForcesInBody(3)
    grid = SurfaceGrid(Meridian(CURVE, RESOLUTION))
    rows = np.random.default_rng(0).choice(RESOLUTION.surface_nodes, 12, replace=False)
    nodes, normals = grid.points.reshape(-1, 3)[rows], grid.normals.reshape(-1, 3)[rows]
    gaps = np.repeat([0.0, 1e-9, 1e-5], 4)[:, None]
    points = case.body.to_world(nodes + gaps * normals)
    found = evaluate(
        *([case.body], [RESOLUTION], points, case.single, case.double, quantity, VISCOSITY),
        tolerance=1e-8,
    )
    assert np.abs(found - case.exact(quantity, points)).max() < 1e-8 * case.unit(quantity)


def test_stress_has_the_traction_that_drives_the_body():
    """A translating sphere: sigma n = -3 mu U/(2 a) everywhere on its surface."""
    radius, velocity = 1.3, np.array([0.3, -0.5, 0.8])
    body, resolution = Body(sphere(), radius), Resolution.uniform(4, 12, 12)
    density = np.tile(1.5 * VISCOSITY / radius * velocity, (resolution.surface_nodes, 1))
    normals = np.random.default_rng(0).normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    stress = evaluate(
        *([body], [resolution], radius * normals, density, None, "stress", VISCOSITY),
        tolerance=1e-9,
    )
    tensor = stress[:, [[0, 5, 4], [5, 1, 3], [4, 3, 2]]]
    traction = np.einsum("nij,nj->ni", tensor, normals)
    np.testing.assert_allclose(traction, np.tile(-density[0], (20, 1)), rtol=0, atol=1e-8)


def test_translating_sphere_has_the_exact_velocity_and_pressure():
    radius, velocity = 0.7, np.array([0.3, -0.5, 0.8])
    body, resolution = Body(sphere(), radius), Resolution.uniform(4, 12, 12)
    density = np.tile(1.5 * VISCOSITY / radius * velocity, (resolution.surface_nodes, 1))
    generator = np.random.default_rng(0)
    points = generator.normal(size=(30, 3))
    distances = radius * (1.0 + 10.0 ** generator.uniform(-4.0, 0.0, 30))
    points *= (distances / np.linalg.norm(points, axis=1))[:, None]
    u = evaluate([body], [resolution], points, density, viscosity=VISCOSITY, tolerance=1e-9)
    p = evaluate([body], [resolution], points, density, None, "pressure", VISCOSITY, 1e-9)
    exact = sphere_velocity(points, radius, velocity, np.zeros(3))
    np.testing.assert_allclose(u, exact, rtol=0, atol=1e-8)
    # tolerances are relative to densities of 5 and, in velocities, of 2
    exact = sphere_pressure(points, radius, velocity, VISCOSITY)
    np.testing.assert_allclose(p, exact, rtol=0, atol=1e-8)


def test_points_inside_bodies_have_no_values():
    case, generator = ForcesInBody(4), np.random.default_rng(2)
    points = case.points(np.repeat([0.2, 0.0, -1e-3, -0.3], 5), generator)
    for quantity in QUANTITIES:
        found = evaluate([case.body], [RESOLUTION], points, case.single, None, quantity)
        missing = np.isnan(found.reshape(20, -1)).all(axis=1)
        np.testing.assert_array_equal(missing, np.arange(20) >= 10)


def test_flow_in_the_gap_between_two_bodies():
    """Two spheroids 0.02 apart pole to side, each with forces inside: flows add up."""
    cases = [ForcesInBody(5, 1.0, (0.0, 0.0, 0.0)), ForcesInBody(6, 1.4, (0.0, 0.0, 0.0))]
    direction = np.array([0.0, 0.6, 0.8])
    reach = [
        np.linalg.norm(np.array([0.6, 0.6, 1.0]) * case.body.vectors_to_local(direction))
        * case.body.scale
        for case in cases
    ]
    # support planes touch the bodies at points along which the gap is at most 0.02
    centre = tuple((reach[0] + reach[1] + 0.02) * direction)
    cases[1] = ForcesInBody(6, 1.4, centre)
    generator = np.random.default_rng(7)
    points = np.concatenate(
        [case.points(10.0 ** generator.uniform(-4, -1, 40), generator) for case in cases]
    )
    found = evaluate(
        [case.body for case in cases],
        [RESOLUTION, RESOLUTION],
        points,
        np.concatenate([case.single for case in cases]),
        np.concatenate([case.double for case in cases]),
        viscosity=VISCOSITY,
        tolerance=1e-8,
    )
    exact = sum(case.exact("velocity", points) for case in cases)
    assert np.abs(found - exact).max() < 1e-8 * sum(case.unit("velocity") for case in cases)


def test_requests_that_make_no_sense_are_refused():
    case = ForcesInBody(1)
    given = ([case.body], [RESOLUTION])
    with pytest.raises(ValueError, match="points"):
        evaluate(*given, np.zeros(3), case.single)
    with pytest.raises(ValueError, match="finite"):
        evaluate(*given, np.full((1, 3), np.nan), case.single)
    with pytest.raises(ValueError, match="density"):
        evaluate(*given, np.ones((1, 3)), case.single[1:])
    with pytest.raises(ValueError, match="single or a double"):
        evaluate(*given, np.ones((1, 3)))
    with pytest.raises(ValueError, match="viscosity"):
        evaluate(*given, np.ones((1, 3)), case.single, viscosity=0.0)
    with pytest.raises(ValueError, match="resolutions"):
        evaluate([case.body], [], np.ones((1, 3)), case.single)


@pytest.mark.mpi(ranks=[1, 2, 3])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_ranks_share_bodies_and_points(parallel, quantity):
    """Bodies go round the ranks, points are cut evenly: neighbours' densities cross ranks."""
    cases = [ForcesInBody(k, 0.5, (1.1 * k, 0.0, 0.0), COARSE) for k in range(4)]
    mine = cases[parallel.rank :: parallel.size]
    generator = np.random.default_rng(1)
    points = np.concatenate([case.points(np.repeat(GAPS, 3), generator) for case in cases])
    exact = sum(case.exact(quantity, points) for case in cases)
    part = slice(
        len(points) * parallel.rank // parallel.size,
        len(points) * (parallel.rank + 1) // parallel.size,
    )
    nothing = np.empty((0, 3))
    found = evaluate(
        [case.body for case in mine],
        [COARSE] * len(mine),
        points[part],
        np.concatenate([nothing, *(case.single for case in mine)]),
        np.concatenate([nothing, *(case.double for case in mine)]),
        quantity,
        VISCOSITY,
        tolerance=1e-5,
        parallel=parallel,
    )
    unit = sum(case.unit(quantity) for case in cases)
    assert np.abs(found - exact[part]).max(initial=0.0) < 1e-5 * unit


@pytest.mark.mpi(ranks=[2, 3])
def test_one_rank_may_have_all_bodies_and_another_all_points(parallel):
    case = ForcesInBody(1, resolution=COARSE)
    mine = parallel.rank == 0
    points = case.points(np.array([0.0, 1e-3, 0.1, 1.0]), np.random.default_rng(0))
    asked = points if parallel.rank == parallel.size - 1 else np.empty((0, 3))
    found = evaluate(
        [case.body] if mine else [],
        [COARSE] if mine else [],
        asked,
        case.single if mine else np.empty((0, 3)),
        case.double if mine else np.empty((0, 3)),
        viscosity=VISCOSITY,
        tolerance=1e-5,
        parallel=parallel,
    )
    assert found.shape == asked.shape
    exact = case.exact("velocity", asked)
    assert np.abs(found - exact).max(initial=0.0) < 1e-5 * case.unit("velocity")
