"""One rigid body: resistance, mobility, slip, traction and pressure against exact solutions.

Unless said otherwise an error is relative to the largest value of what is compared (max norm over
nodes and components); 1e-12 is ten times the rounding that the quadrature accumulates.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stokes.background import LinearFlow, PoiseuilleFlow, UniformFlow, extensional_flow, shear_flow
from stokes.body import resistance_matrix, solve_mobility, solve_resistance
from stokes.exact import (
    ellipsoid_traction,
    jeffery_angular_velocity,
    jeffery_period,
    point_force_near_sphere,
    slip_velocity,
    sphere_pressure,
    sphere_velocity,
    spheroid_resistance,
    stokeslet_velocity,
)
from stokes.formulation import OperatorCache
from stokes.geometry import (
    Body,
    Meridian,
    Resolution,
    SurfaceGrid,
    fourier_curve,
    sphere,
    spherocylinder,
    spheroid,
)
from stokes.resolution import resolution_for

from layer_sums import PointForces, flow_of_layers, on_grid

EXTERIOR = ("single", "combined", "completed")
TURNED = (0.3, -0.7, 0.2, 0.6)  # a quaternion, of any length


@pytest.fixture(scope="module")
def cache():
    return OperatorCache()


def worst(difference, reference):
    return np.abs(difference).max() / np.abs(reference).max()


# ---- resistance ----------------------------------------------------------------------------

# Axial and transverse force, axial and transverse torque for unit velocity and rotation.
RESISTANCES = [
    (1.0, 1.0, 2, (6 * math.pi, 6 * math.pi, 8 * math.pi, 8 * math.pi)),
    (0.5, 1.0, 6, (11.346876506623, 12.995817441783, 5.0684991847975, 9.4557304221856)),
    (1.0, 5.0, 10, (33.642851863764, 44.691666674202, 88.728727726774, 583.14276563858)),
    (1.0, 0.5, 6, (17.064602152727, 14.942182986904, 17.719089290026, 14.220501793939)),
]


@pytest.mark.parametrize("formulation", EXTERIOR)
@pytest.mark.parametrize(("equatorial", "polar", "panels", "expected"), RESISTANCES)
def test_spheroid_has_the_exact_resistances(
    equatorial, polar, panels, expected, formulation, cache
):
    found = resistance_matrix(
        Body(spheroid(equatorial, polar)),
        formulation=formulation,
        resolution=Resolution.uniform(panels, 16, 3),
        cache=cache,
    )
    axial, transverse, spin, tumble = expected
    # each coefficient relative to itself
    assert_allclose(np.diag(found), [transverse] * 2 + [axial] + [tumble] * 2 + [spin], rtol=1e-12)
    assert np.abs(found - np.diag(np.diag(found))).max() < 1e-12 * np.abs(found).max()


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8, 1e-12])
@pytest.mark.parametrize("equatorial", [1.0, 0.05, 20.0], ids=["sphere", "needle", "disc"])
def test_resolution_is_chosen_to_reach_the_tolerance(equatorial, tolerance, cache):
    body = Body(spheroid(equatorial, 1.0))
    found = np.diag(resistance_matrix(body, resolution=_few_modes(body, tolerance), cache=cache))
    exact = spheroid_resistance(equatorial, 1.0)
    expected = (
        [exact.translation_transverse] * 2
        + [exact.translation_axial]
        + [exact.rotation_transverse] * 2
        + [exact.rotation_axial]
    )
    assert_allclose(found, expected, rtol=tolerance)


def _few_modes(body, tolerance):
    """Panels for a tolerance, with no more modes than rigid motions and linear flows have."""
    return replace(resolution_for(body.curve, tolerance), modes=2)


@pytest.mark.parametrize(
    "curve",
    [fourier_curve((1.0, 0.15), (0.0, 1.0, 0.2)), fourier_curve((1.0, 0.0, 0.4), (0.0, 1.5))],
    ids=["egg", "dumbbell"],
)
@pytest.mark.parametrize("formulation", EXTERIOR)
def test_resistance_is_symmetric_positive_and_turns_with_the_body(curve, formulation, cache):
    resolution = Resolution.uniform(10, 16, 3)
    options = {"formulation": formulation, "resolution": resolution, "cache": cache}
    unit = resistance_matrix(Body(curve), **options)
    assert np.abs(unit - unit.T).max() < 1e-12 * np.abs(unit).max()
    assert np.linalg.eigvalsh(0.5 * (unit + unit.T)).min() > 0.1
    body = Body(curve, scale=2.5, centre=(1.0, -2.0, 0.5), quaternion=TURNED)
    turn = np.kron(np.eye(2), body.rotation)
    lever = np.repeat([1.0, body.scale], 3)
    expected = 0.7 * body.scale * turn @ (lever[:, None] * unit * lever) @ turn.T
    found = resistance_matrix(body, viscosity=0.7, **options)
    assert worst(found - expected, expected) < 1e-14


def test_egg_that_is_dragged_along_its_axis_does_not_turn_but_couples_across(cache):
    curve = fourier_curve((1.0, 0.15), (0.0, 1.0, 0.2))
    found = resistance_matrix(Body(curve), resolution=Resolution.uniform(8, 16, 3), cache=cache)
    coupling = found[:3, 3:]
    assert abs(coupling[0, 1]) > 1e-2  # no mirror symmetry: sideways drag turns it
    assert_allclose(coupling[0, 1], -coupling[1, 0], rtol=1e-12)
    coupling[0, 1] = coupling[1, 0] = 0.0
    assert np.abs(coupling).max() < 1e-12 * np.abs(found).max()


def test_resistance_of_a_slender_rod_settles_and_is_symmetric_positive(cache):
    body = Body(spherocylinder(0.05, 0.95))  # aspect 20
    coarse, fine, first_kind = (
        resistance_matrix(
            body, formulation=formulation, resolution=_few_modes(body, tolerance), cache=cache
        )
        for formulation, tolerance in (("combined", 1e-6), ("combined", 1e-9), ("single", 1e-9))
    )
    assert worst(coarse - fine, fine) < 1e-6
    assert worst(first_kind - fine, fine) < 1e-9
    assert np.abs(fine - fine.T).max() < 1e-9 * np.abs(fine).max()
    assert np.linalg.eigvalsh(fine).min() > 0.0
    # more than the spheroid inside it, less than the sphere around it
    inside = spheroid_resistance(0.05, 1.0)
    assert inside.translation_axial < fine[2, 2] < 6.0 * math.pi
    assert inside.translation_transverse < fine[0, 0] < 6.0 * math.pi
    assert inside.rotation_axial < fine[5, 5] < inside.rotation_transverse < fine[3, 3]


# ---- traction and pressure -----------------------------------------------------------------


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_traction_on_a_spheroid_in_translation_and_pressure_are_exact(formulation, cache):
    body = Body(spheroid(0.5, 1.0), scale=1.5, centre=(0.2, 0.0, -1.0), quaternion=TURNED)
    velocity = np.array([0.3, -0.4, 1.1])
    solution = solve_resistance(
        body,
        velocity,
        viscosity=2.0,
        formulation=formulation,
        resolution=Resolution.uniform(8, 16, 4),
        cache=cache,
    )
    exact = body.vectors_to_world(
        ellipsoid_traction(
            body.scale * solution.solver.grid.points,
            solution.solver.grid.normals,
            body.scale * np.array([0.5, 0.5, 1.0]),
            body.vectors_to_local(velocity),
            viscosity=2.0,
        )
    )
    # The single layer behind the traction is of the first kind, its condition about 10^3.
    assert worst(solution.traction() - exact, exact) < 1e-10
    # A rigid motion strains nothing on the surface: p = -n.t there.
    pressure = -np.sum(exact * solution.normals, axis=-1)
    assert worst(solution.pressure() - pressure, pressure) < 1e-10
    assert_allclose(np.einsum("ab,abi->i", solution.weights, exact), solution.force, atol=1e-11)


def test_traction_and_pressure_outside_a_slipping_surface_are_exact(cache):
    # Surface velocity of point forces inside: the flow, its traction and pressure are theirs.
    body = Body(spheroid(0.7, 1.0))
    resolution = Resolution.uniform(10, 16, 24)
    rng = np.random.default_rng(3)
    flow = PointForces(rng.uniform(-0.2, 0.2, (5, 3)), rng.standard_normal((5, 3)))
    solution = solve_resistance(body, slip=flow.velocity, resolution=resolution, cache=cache)
    _, traction = on_grid(solution.solver.grid, flow)
    pressure = flow.pressure(solution.points)
    assert worst(solution.traction() - traction, traction) < 1e-9
    # derivatives along panels of 16 nodes cost two digits more than the traction
    assert worst(solution.pressure() - pressure, pressure) < 1e-9
    assert_allclose(solution.force, -flow.forces.sum(axis=0), atol=1e-11)
    turning = np.cross(flow.positions, flow.forces).sum(axis=0)
    assert_allclose(solution.torque, -turning, atol=1e-11)


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_stresslet_of_point_forces_inside_is_their_first_moment(formulation, cache):
    body = Body(spheroid(0.7, 1.0))
    rng = np.random.default_rng(3)
    flow = PointForces(rng.uniform(-0.2, 0.2, (5, 3)), rng.standard_normal((5, 3)))
    solution = solve_resistance(
        body,
        slip=flow.velocity,
        formulation=formulation,
        resolution=Resolution.uniform(6, 16, 24),
        cache=cache,
    )
    moment = np.einsum("ki,kj->ij", flow.positions, flow.forces)
    moment = 0.5 * (moment + moment.T)
    expected = np.trace(moment) / 3.0 * np.eye(3) - moment
    assert_allclose(solution.stresslet, expected, atol=1e-11)


def test_reciprocal_theorem_holds_between_two_flows(cache):
    body = Body(fourier_curve((1.0, 0.15), (0.0, 1.0, 0.2)))
    resolution = Resolution.uniform(8, 16, 6)

    def first(x):
        return np.stack([x[:, 1], -x[:, 0] * x[:, 2], 0.2 * x[:, 0]], axis=1)

    def second(x):
        return np.stack([x[:, 2] ** 2, 0.5 * x[:, 2], x[:, 0] * x[:, 1]], axis=1)

    flows = [
        solve_resistance(
            body,
            velocity,
            slip=_without_flux(body, resolution, slip),
            resolution=resolution,
            cache=cache,
        )
        for velocity, slip in (((1.0, 0.0, 0.3), first), ((0.0, -1.0, 0.5), second))
    ]
    work = [
        np.einsum("ab,abi,abi->", u.weights, u.surface_velocity, t.traction())
        for u, t in (flows, flows[::-1])
    ]
    assert abs(work[0] - work[1]) < 1e-11 * abs(work[0])


def _without_flux(body, resolution, slip):
    grid = SurfaceGrid(Meridian(body.curve, resolution))
    field = slip(grid.points.reshape(-1, 3)).reshape(grid.points.shape)
    flux = np.sum(grid.weights * np.sum(field * grid.normals, axis=-1))
    return field - flux / grid.area * grid.normals


# ---- flows around a body -------------------------------------------------------------------


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_point_force_near_a_fixed_sphere_acts_as_faxen_says(formulation, cache):
    position = np.array([0.0, 1.8, -2.4])  # distance 3
    axis = position / 3.0
    across = np.array([1.0, 0.0, 0.0])
    for force, drag, torque in ((axis, 13 / 27, 0.0), (across, 7 / 27, 1 / 9)):
        solution = solve_resistance(
            Body(sphere()),
            background=PointForces(position, force),
            formulation=formulation,
            resolution=Resolution.uniform(3, 16, 30),
            cache=cache,
        )
        assert_allclose(solution.force, drag * force, atol=1e-12)
        assert abs(np.linalg.norm(solution.torque) - torque) < 1e-12
        exact = point_force_near_sphere(position, force, 1.0)
        assert_allclose(solution.torque, exact.torque, atol=1e-12)
        assert_allclose(solution.stresslet, exact.stresslet, atol=1e-12)


def test_sphere_in_poiseuille_flow_feels_faxens_correction(cache):
    body = Body(sphere(), scale=0.5, centre=(0.3, 0.4, 0.0))
    flow = PoiseuilleFlow(2.0, 1.0, "x")
    solution = solve_resistance(
        body, background=flow, viscosity=3.0, resolution=Resolution.uniform(3, 12, 4), cache=cache
    )
    # F = 6 pi v a (1 + a^2 Lap / 6) u, T = 4 pi v a^3 curl u at the centre; Lap u = -8, u = 1.68
    drag = 6 * math.pi * 3.0 * 0.5 * (1.68 - 0.25 * 8.0 / 6.0)
    assert_allclose(solution.force, [drag, 0.0, 0.0], atol=1e-12 * drag)
    curl = 4 * math.pi * 3.0 * 0.125 * np.array([0.0, 0.0, 4.0 * 0.4])
    assert_allclose(solution.torque, curl, atol=1e-12 * drag)


def test_wind_acts_as_the_opposite_motion(cache):
    body = Body(spheroid(0.5, 1.0), quaternion=TURNED)
    resolution = Resolution.uniform(6, 16, 4)
    options = {"resolution": resolution, "cache": cache}
    wind = solve_resistance(body, background=UniformFlow((1.0, 2.0, -0.5)), **options)
    moved = solve_resistance(body, velocity=(-1.0, -2.0, 0.5), **options)
    assert_allclose(wind.force, moved.force, rtol=1e-13)
    assert_allclose(wind.traction(), moved.traction(), atol=1e-10)


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_strained_sphere_has_einsteins_stresslet(formulation, cache):
    body = Body(sphere(), scale=2.0, quaternion=TURNED)
    flow = extensional_flow(0.7)
    solution = solve_resistance(
        body,
        background=flow,
        viscosity=1.5,
        formulation=formulation,
        resolution=Resolution.uniform(3, 12, 4),
        cache=cache,
    )
    strain = np.array(flow.gradient)
    assert_allclose(solution.stresslet, 20 / 3 * math.pi * 1.5 * 8.0 * strain, atol=1e-10)
    # The whole traction is 5 viscosity E.n
    assert_allclose(solution.traction(), 5.0 * 1.5 * solution.normals @ strain, atol=1e-10)


# ---- mobility ------------------------------------------------------------------------------

MOBILITY = (*EXTERIOR, "traction")


@pytest.mark.parametrize("formulation", MOBILITY)
def test_mobility_undoes_resistance(formulation, cache):
    body = Body(fourier_curve((1.0, 0.15), (0.0, 1.0, 0.2)), scale=0.4, quaternion=TURNED)
    options = {"resolution": Resolution.uniform(8, 16, 4), "cache": cache, "viscosity": 2.0}
    force, torque = np.array([1.0, -0.5, 0.3]), np.array([0.02, 0.1, -0.05])
    motion = solve_mobility(body, force, torque, formulation=formulation, **options)
    matrix = resistance_matrix(body, **options)
    expected = np.linalg.solve(matrix, np.concatenate([force, torque]))
    # `traction` takes velocities from S of its density: the error of S is not smoothed by a solve
    assert_allclose(motion.velocity, expected[:3], rtol=1e-11)
    assert_allclose(motion.angular_velocity, expected[3:], rtol=1e-11)
    assert_allclose(motion.force, -force, atol=1e-12)
    assert_allclose(motion.torque, -torque, atol=1e-12)


@pytest.mark.parametrize("formulation", MOBILITY)
@pytest.mark.parametrize(("equatorial", "polar"), [(0.5, 1.0), (1.0, 0.5), (0.2, 1.0)])
def test_free_spheroid_turns_in_a_linear_flow_as_jeffery_says(
    equatorial, polar, formulation, cache
):
    body = Body(spheroid(equatorial, polar), 1.7, (1.0, 2.0, 3.0), TURNED)
    gradient = np.array([[0.3, 1.0, -0.2], [0.4, -0.5, 0.8], [0.1, 0.6, 0.2]])
    flow = LinearFlow(tuple(map(tuple, gradient)))
    solution = solve_mobility(
        body,
        background=flow,
        viscosity=2.5,
        formulation=formulation,
        resolution=Resolution.uniform(10, 16, 3),
        cache=cache,
    )
    expected = jeffery_angular_velocity(polar / equatorial, body.axis, gradient)
    assert_allclose(solution.angular_velocity, expected, atol=1e-10)
    assert_allclose(solution.velocity, flow.velocity(np.array([body.centre]))[0], atol=1e-10)
    assert np.abs(solution.force).max() < 1e-10
    assert np.abs(solution.torque).max() < 1e-10


def test_period_of_jefferys_orbit_is_reached_with_the_order_of_the_stepping(cache):
    rate, aspect = 1.3, 2.0
    curve, resolution = spheroid(0.5, 1.0), Resolution.uniform(4, 16, 2)
    flow = shear_flow(rate)  # u_x = rate z: turns about y

    def turning(angle):
        """d(angle)/dt of the axis (sin, 0, cos)."""
        body = Body(curve, quaternion=(math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0))
        free = solve_mobility(body, background=flow, resolution=resolution, cache=cache)
        return free.angular_velocity[1]

    period = jeffery_period(aspect, rate)
    errors = []
    for steps in (24, 48, 96):
        angle, h = 0.0, period / steps
        for _ in range(steps):  # classical Runge-Kutta of order 4
            k1 = turning(angle)
            k2 = turning(angle + 0.5 * h * k1)
            k3 = turning(angle + 0.5 * h * k2)
            k4 = turning(angle + h * k3)
            angle += h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
        # what is missing of a turn, as time at the speed of the end
        errors.append(abs(angle - 2.0 * math.pi) / turning(angle) / period)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(4.0, abs=0.5), errors
    assert errors[-1] < 1e-6


# ---- swimmers ------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_squirmer_swims_with_two_thirds_of_its_first_mode(formulation, cache):
    first, second = 1.5, -2.0

    def slip(points):
        """u_theta = -(B_1 sin(theta) + B_2 sin(theta) cos(theta)): the surface moves south."""
        cosine = points[:, 2]
        sine2 = points[:, 0] ** 2 + points[:, 1] ** 2
        south = np.column_stack([points[:, :2] * cosine[:, None], -sine2])  # sin(theta) e_theta
        return (first + second * cosine)[:, None] * south

    body = Body(sphere(), scale=0.3, quaternion=TURNED)
    solution = solve_mobility(
        body,
        slip=slip,
        formulation=formulation,
        resolution=Resolution.uniform(3, 12, 2),
        cache=cache,
    )
    assert_allclose(solution.velocity, 2.0 / 3.0 * first * body.axis, atol=1e-12)
    assert_allclose(solution.angular_velocity, 0.0, atol=1e-12)
    assert np.abs(solution.force).max() < 1e-12
    # T. Ishikawa, M. Simmonds, T. Pedley, J. Fluid Mech. 568, 2006, eq. 3
    expected = (
        4.0 / 3.0 * math.pi * 0.09 * second * (3 * np.outer(body.axis, body.axis) - np.eye(3))
    )
    assert_allclose(solution.stresslet, expected, atol=1e-12)


def test_swimming_spheroid_moves_as_the_reciprocal_theorem_says(cache):
    body = Body(spheroid(0.4, 1.0), quaternion=TURNED)
    resolution = Resolution.uniform(8, 16, 6)

    def slip(points):
        tangent = np.column_stack([points[:, :2] * points[:, 2:], -(points[:, 0] ** 2)])
        return tangent + np.column_stack([points[:, 1], 0.2 * points[:, 2], 0 * points[:, 2]])

    solution = solve_mobility(body, slip=slip, resolution=resolution, cache=cache)
    grid = solution.solver.grid
    nodal = slip(grid.points.reshape(-1, 3))
    expected = slip_velocity(
        grid.points.reshape(-1, 3), grid.normals.reshape(-1, 3), grid.weights.ravel(), nodal
    )
    assert_allclose(solution.velocity, body.vectors_to_world(expected), atol=1e-12)
    again = solve_mobility(
        body, slip=nodal.reshape(grid.points.shape), resolution=resolution, cache=cache
    )
    np.testing.assert_array_equal(again.velocity, solution.velocity)


# ---- S. De's experiments -------------------------------------------------------------------


class PointForcesInSpheroid:
    """Five random point forces on r^2/0.3^2 + z^2/0.8^2 = 1 inside the prolate spheroid 1 : 0.5.

    The flow is given on the spheroid, turned at random, and compared on r^2/0.7^2 + z^2/1.2^2 = 1.
    (S. De, PhD thesis, University of Michigan 2021, section 3.6.1.)
    """

    def __init__(self, seed=11):
        rng = np.random.default_rng(seed)
        self.body = Body(spheroid(0.5, 1.0), quaternion=rng.standard_normal(4))
        inside = rng.standard_normal((5, 3))
        inside *= np.array([0.3, 0.3, 0.8]) / np.linalg.norm(inside, axis=1)[:, None]
        self.flow = PointForces(self.body.to_world(inside), rng.standard_normal((5, 3)))
        theta, phi = np.meshgrid(np.linspace(0, np.pi, 6), 2 * np.pi * np.arange(5) / 5)
        self.outside = np.column_stack(
            [
                0.7 * (np.sin(theta) * np.cos(phi)).ravel(),
                0.7 * (np.sin(theta) * np.sin(phi)).ravel(),
                1.2 * np.cos(theta).ravel(),
            ]
        )

    def error(self, formulation, resolution, cache):
        """Largest error of a velocity component, relative to the largest one there."""
        solver = cache.solver(self.body.curve, resolution, formulation)
        given = self.flow.velocity(self.body.to_world(solver.grid.points).reshape(-1, 3))
        local = self.body.vectors_to_local(given).reshape(solver.grid.points.shape)
        found = flow_of_layers(solver, solver.solve(local), self.outside)
        exact = self.flow.velocity(self.body.to_world(self.outside))
        return worst(self.body.vectors_to_world(found) - exact, exact)


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_error_outside_falls_spectrally_with_modes_to_1e12(formulation):
    experiment = PointForcesInSpheroid()
    modes = np.array([8, 16, 24, 32, 40])
    errors = np.array(
        [
            experiment.error(formulation, Resolution.uniform(12, 16, int(n)), OperatorCache())
            for n in modes
        ]
    )
    assert errors[-1] < 1e-12, errors
    # The rings of point forces and targets nearest to the surface, 0.3 and 0.7 of 0.5, let modes
    # fall like (3/7)^n on the way out: eight by 1/900.
    steps = errors[1:] / errors[:-1]
    assert np.all(steps[errors[1:] > 1e-12] < 0.01), errors


def test_error_outside_falls_with_high_order_in_panels():
    experiment = PointForcesInSpheroid()
    panels = np.array([2, 4, 8])
    errors = np.array(
        [
            experiment.error("single", Resolution.uniform(int(n), 10, 56), OperatorCache())
            for n in panels
        ]
    )
    orders = np.log2(errors[:-1] / errors[1:])
    # Panels of ten nodes: order ten of the density, more in the velocity away from the surface.
    assert orders[-1] > 9.0, (errors, orders)


def test_flow_inside_is_that_of_point_forces_outside(cache):
    # S. De's problem 3.2: the interior double layer.
    rng = np.random.default_rng(5)
    body = spheroid(0.5, 1.0)
    directions = rng.standard_normal((5, 3))
    directions *= np.array([1.2, 1.2, 1.7]) / np.linalg.norm(directions, axis=1)[:, None]
    flow = PointForces(directions, rng.standard_normal((5, 3)))
    solver = cache.solver(body, Resolution.uniform(8, 16, 40), "interior")
    given, _ = on_grid(solver.grid, flow)
    inside = rng.uniform(-0.15, 0.15, (20, 3)) + [0.0, 0.0, 0.3]
    found = flow_of_layers(solver, solver.solve(given), inside)
    exact = flow.velocity(inside)
    assert worst(found - exact, exact) < 1e-12


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_flow_and_pressure_around_a_sphere_are_exact_up_to_its_surface(formulation, cache):
    body = Body(sphere(), scale=0.5, centre=(1.0, -2.0, 0.3), quaternion=TURNED)
    velocity, spin, wind = np.array([1.0, 0.2, -0.5]), np.array([0.3, -1.0, 2.0]), (0.0, 0.4, 1.0)
    solution = solve_resistance(
        body,
        velocity,
        spin,
        background=UniformFlow(wind),
        viscosity=3.0,
        formulation=formulation,
        resolution=Resolution.uniform(4, 16, 6),
        cache=cache,
    )
    rng = np.random.default_rng(2)
    x = rng.standard_normal((40, 3))
    x *= (0.5 + np.geomspace(1e-6, 10.0, 40))[:, None] / np.linalg.norm(x, axis=1)[:, None]
    relative_motion = velocity - np.array(wind)
    exact = sphere_velocity(x, 0.5, relative_motion, spin) + wind
    found = solution.velocity_at(body.centre + x, 1e-10)
    assert np.abs(found - exact).max() < 1e-9
    pressure = sphere_pressure(x, 0.5, relative_motion, 3.0)
    found = solution.pressure_at(body.centre + x, 1e-10)
    assert np.abs(found - pressure).max() < 1e-9 * pressure.max()
    assert np.isnan(solution.velocity_at([body.centre])).all()


@pytest.mark.parametrize("formulation", EXTERIOR)
def test_flow_around_a_moving_spheroid_decays_like_its_drag(formulation, cache):
    solution = solve_resistance(
        Body(spheroid(0.5, 1.0)),
        velocity=(0.0, 0.0, 1.0),
        formulation=formulation,
        resolution=Resolution.uniform(6, 16, 3),
        cache=cache,
    )
    far = np.array([[300.0, 100.0, 200.0]])
    found = flow_of_layers(solution.solver, solution.density, far, (1, 1))
    drag = stokeslet_velocity(far, np.zeros((1, 3)), -solution.force[None])
    # The next term of a body with mirror symmetry is of relative size (a / r)^2.
    assert worst(found - drag, drag) < 1e-5


# ---- refusals, ranks -----------------------------------------------------------------------


def _blowing(points):
    return points


def test_slip_with_a_net_flux_is_refused_where_the_layers_cannot_make_it(cache):
    options = {"resolution": Resolution.uniform(2, 12, 2), "cache": cache, "slip": _blowing}
    with pytest.raises(ValueError, match="net flux"):
        solve_resistance(Body(sphere()), formulation="single", **options)
    solution = solve_resistance(Body(sphere()), formulation="combined", **options)
    # a source of strength 4 pi at the centre: u = x / r^3
    found = flow_of_layers(solution.solver, solution.density, np.array([[0.0, 2.0, 0.0]]), (12, 2))
    assert_allclose(found, [[0.0, 0.25, 0.0]], atol=1e-12)
    with pytest.raises(ValueError, match="net flux"):
        solution.traction()


@pytest.mark.parametrize("formulation", ["interior", "traction"])
def test_formulations_that_take_no_motion_are_refused(formulation, cache):
    options = {
        "formulation": formulation,
        "resolution": Resolution.uniform(2, 12, 2),
        "cache": cache,
    }
    with pytest.raises(ValueError, match="no motion is given"):
        solve_resistance(Body(sphere()), (1.0, 0.0, 0.0), **options)
    with pytest.raises(ValueError, match="no motion is given"):
        resistance_matrix(Body(sphere()), **options)


def test_interior_formulation_moves_no_body(cache):
    with pytest.raises(ValueError, match="no motion is given"):
        solve_mobility(
            Body(sphere()),
            (1.0, 0.0, 0.0),
            formulation="interior",
            resolution=Resolution.uniform(2, 12, 2),
            cache=cache,
        )


def test_slip_of_the_wrong_shape_and_slip_with_traction_are_refused(cache):
    options = {"resolution": Resolution.uniform(2, 12, 2), "cache": cache}
    with pytest.raises(ValueError, match="the nodes want"):
        solve_mobility(Body(sphere()), slip=np.zeros((4, 3)), **options)
    with pytest.raises(ValueError, match="without slip"):
        solve_mobility(Body(sphere()), slip=_blowing, formulation="traction", **options)


@pytest.mark.mpi(ranks=[1, 2])
def test_every_rank_gets_the_same_bits(parallel):
    body = Body(spheroid(0.5, 1.0), quaternion=TURNED)
    solution = solve_mobility(
        body,
        force=(0.0, 0.0, -1.0),
        background=shear_flow(1.0),
        resolution=Resolution.uniform(3, 12, 3),
    )
    for mine in (solution.velocity, solution.angular_velocity, solution.density):
        np.testing.assert_array_equal(mine, parallel.broadcast(mine))
