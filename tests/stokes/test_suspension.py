"""Many bodies in Stokes flow, on one rank: against exact solutions, and laws that all obey.

`Suspension` bounds errors of velocities by its tolerance; loads are integrals of the density and
follow it up to a factor that grows in narrow gaps, which the tests state.
"""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from stokes.background import PoiseuilleFlow, SumOfFlows, extensional_flow, shear_flow
from stokes.body import solve_mobility, solve_resistance
from stokes.exact import (
    squirmer_velocity,
    stimson_jeffery,
    two_spheres_axial,
    two_spheres_spinning,
)
from stokes.fmm import FmmOptions
from stokes.geometry import Body, Resolution, sphere, spheroid
from stokes.suspension import Suspension, SuspensionOptions, distribute

from suspensions import ForcesAtCentres, mixed_cluster, quaternion, turned

LINE = np.array([0.48, 0.6, 0.64])  # of centres: no axis of the coordinates


def pair(gap, radii=(1.0, 1.0), **more):
    """Two spheres at a gap along `LINE`."""
    distance = sum(radii) + gap
    bodies = [Body(sphere(), radii[0]), Body(sphere(), radii[1], tuple(distance * LINE))]
    return Suspension(bodies, **more)


def worst(found, expected):
    """Largest error over the largest value."""
    return np.abs(found - expected).max() / np.abs(expected).max()


# ---- one body ------------------------------------------------------------------------------

RESOLUTION = Resolution.uniform(4, 10, 8)


def swim(points):
    """A slip without net flux, in a body's frame."""
    return np.cross(points, points[:, [1, 2, 0]] + 0.5)


@pytest.mark.parametrize("formulation", ["single", "combined"])
def test_one_body_is_what_the_solver_of_one_body_finds(formulation):
    body = Body(spheroid(0.6, 1.0), 1.7, (0.3, -0.2, 0.9), quaternion(5))
    flow = SumOfFlows((shear_flow(0.7, "xz"), PoiseuilleFlow(0.4, 3.0, "y")))
    options = SuspensionOptions(resolution=RESOLUTION, residual_tolerance=1e-13)
    suspension = Suspension([body], 2.5, flow, 1e-6, formulation=formulation, options=options)
    common = {"slip": swim, "viscosity": 2.5, "background": flow}
    common |= {"formulation": formulation, "resolution": RESOLUTION}

    held = suspension.solve((0.1, 0.2, 0.3), (0.3, -0.1, 0.2), slip=swim)
    expected = solve_resistance(body, (0.1, 0.2, 0.3), (0.3, -0.1, 0.2), **common)
    # both are one solution with the same factors: 1e-12 is round-off
    assert_allclose(held.forces[0], expected.force, rtol=1e-12)
    assert_allclose(held.torques[0], expected.torque, rtol=1e-12)
    assert worst(held.stresslets[0], expected.stresslet) < 1e-12
    rho, mu = expected.layers()
    assert worst(held.single_layer, rho.reshape(-1, 3)) < 1e-12
    assert (mu is None) == (held.double_layer is None)

    free = suspension.solve(force=(1.0, 0.0, 2.0), torque=(0.0, 1.0, 0.0), slip=swim)
    expected = solve_mobility(body, (1.0, 0.0, 2.0), (0.0, 1.0, 0.0), **common)
    assert_allclose(free.velocities[0], expected.velocity, rtol=1e-12)
    assert_allclose(free.angular_velocities[0], expected.angular_velocity, rtol=1e-12)
    assert_allclose(free.forces[0], (-1.0, 0.0, -2.0), atol=1e-12)


def test_drag_and_torque_of_a_sphere_scale_with_viscosity_and_size():
    suspension = Suspension([Body(sphere(), 2.0, (5.0, 0.0, 0.0))], viscosity=3.0)
    found = suspension.solve(velocity=(1.0, 0.0, 0.0), angular_velocity=(0.0, 1.0, 0.0))
    assert_allclose(found.forces, [[-6.0 * math.pi * 3.0 * 2.0, 0.0, 0.0]], atol=1e-12)
    assert_allclose(found.torques, [[0.0, -8.0 * math.pi * 3.0 * 8.0, 0.0]], atol=1e-12)
    assert found.converged


def test_a_fluid_at_rest_stays_at_rest_without_an_iteration():
    found = Suspension([Body(sphere())]).solve(force=(0.0, 0.0, 0.0))
    assert found.iterations == 0
    assert found.converged
    assert np.all(found.velocities == 0.0)


# ---- two spheres ---------------------------------------------------------------------------

# Force over 6 pi of unit spheres that move along their line with one velocity, or opposite ones.
AXIAL = {
    4.0: (0.74225828506909, 1.596681999496),
    3.0: (0.69830456025004, 2.0386546439229),
    2.5: (0.67291551376517, 2.7724186795591),
}


@pytest.mark.parametrize("distance", AXIAL)
def test_two_spheres_on_their_line_have_the_exact_drag(distance):
    suspension = pair(distance - 2.0, tolerance=1e-7)
    for velocities, factor in zip(([LINE, LINE], [LINE, -LINE]), AXIAL[distance], strict=True):
        found = suspension.solve(velocity=velocities)
        expected = -6.0 * math.pi * factor * np.array(velocities)
        assert worst(found.forces, expected) < 1e-9


@pytest.mark.parametrize(("gap", "factor"), [(1e-1, 10.0), (1e-2, 10.0)])
def test_approaching_spheres_have_the_exact_drag_down_to_narrow_gaps(gap, factor):
    """The drag grows like 1/gap; its error keeps the tolerance up to a factor."""
    tolerance = 1e-5
    suspension = pair(gap, tolerance=tolerance)
    for velocities, exact in zip(([LINE, LINE], [LINE, -LINE]), stimson_jeffery(gap), strict=True):
        found = suspension.solve(velocity=velocities)
        expected = -6.0 * math.pi * exact * np.array(velocities)
        assert found.converged
        assert worst(found.forces, expected) < factor * tolerance


def test_spheres_of_two_sizes_have_the_exact_drag():
    suspension = pair(0.3, (1.0, 0.4), tolerance=1e-6)
    along = np.array([0.7, -0.2])
    found = suspension.solve(velocity=along[:, None] * LINE)
    assert worst(found.forces @ LINE, -two_spheres_axial(1.0, 0.4, 0.3) @ along) < 1e-6


def test_spinning_spheres_have_the_exact_torque():
    suspension = pair(1.0, tolerance=1e-7)
    for sign in (1.0, -1.0):
        spin = np.array([1.0, sign])
        found = suspension.solve(angular_velocity=spin[:, None] * LINE)
        expected = -two_spheres_spinning(1.0, 1.0, 1.0) @ spin
        assert worst(found.torques @ LINE, expected) < 1e-9
        assert np.abs(found.forces).max() < 1e-9


def test_spheres_that_move_side_by_side_push_alike_and_turn_opposite_ways():
    suspension = pair(0.4, tolerance=1e-6)
    across = np.cross(LINE, [0.0, 0.0, 1.0])
    found = suspension.solve(velocity=across)
    assert_allclose(found.forces[0], found.forces[1], atol=1e-5)
    assert_allclose(found.torques[0], -found.torques[1], atol=1e-5)
    # no force along the line, no torque in the plane of motion
    assert np.abs(found.forces @ LINE).max() < 1e-5
    assert np.abs(found.torques @ across).max() < 1e-5
    # each shields the other
    assert -found.forces[0] @ across < 6.0 * math.pi * (across @ across)


# ---- laws of clusters ----------------------------------------------------------------------

TOLERANCE = 1e-5


@pytest.fixture(scope="module")
def trio():
    bodies = mixed_cluster()[:3]
    return Suspension(bodies, viscosity=1.3, tolerance=TOLERANCE)


@pytest.fixture(scope="module")
def resistance(trio):
    """(18, 18): forces and torques to apply, body after body, for unit motions."""
    columns = []
    for k in range(18):
        unit = np.zeros(18)
        unit[k] = 1.0
        velocity, spin = np.split(unit.reshape(3, 6), 2, axis=1)
        found = trio.solve(velocity=velocity, angular_velocity=spin)
        columns.append(-np.concatenate([found.forces, found.torques], axis=1).ravel())
    return np.stack(columns, axis=1)


def test_resistance_matrix_is_symmetric_and_positive(resistance):
    """The reciprocal theorem, body by body."""
    assert worst(resistance, resistance.T) < TOLERANCE
    assert np.linalg.eigvalsh(0.5 * (resistance + resistance.T)).min() > 0.0


def test_mobility_is_the_inverse_of_resistance(trio, resistance):
    load = np.random.default_rng(3).standard_normal((3, 6))
    found = trio.solve(force=load[:, :3], torque=load[:, 3:])
    motion = np.concatenate([found.velocities, found.angular_velocities], axis=1)
    assert worst(motion.ravel(), np.linalg.solve(resistance, load.ravel())) < 5.0 * TOLERANCE
    # loads of the fluid are those applied, reversed, however far the iteration got
    assert_allclose(found.forces, -load[:, :3], atol=1e-5)


def test_loads_turn_with_the_bodies(trio):
    rotation = Rotation.random(random_state=8).as_matrix()
    rng = np.random.default_rng(4)
    velocity, spin = rng.standard_normal((2, 3, 3))
    here = trio.solve(velocity=velocity, angular_velocity=spin)
    moved = turned(trio.bodies, rotation, (10.0, -3.0, 4.0))
    there = Suspension(moved, viscosity=1.3, tolerance=TOLERANCE).solve(
        velocity=velocity @ rotation.T, angular_velocity=spin @ rotation.T
    )
    assert worst(there.forces, here.forces @ rotation.T) < 3.0 * TOLERANCE
    assert worst(there.torques, here.torques @ rotation.T) < 3.0 * TOLERANCE
    expected = rotation @ here.stresslets @ rotation.T
    assert worst(there.stresslets, expected) < 3.0 * TOLERANCE


def test_order_in_which_bodies_are_given_does_not_matter(trio):
    velocity = np.random.default_rng(6).standard_normal((3, 3))
    here = trio.solve(velocity=velocity)
    order = [2, 0, 1]
    bodies = [trio.bodies[k] for k in order]
    there = Suspension(bodies, viscosity=1.3, tolerance=TOLERANCE).solve(velocity=velocity[order])
    assert worst(there.forces, here.forces[order]) < TOLERANCE


def test_bodies_that_move_with_the_flow_feel_no_load():
    """A rigid motion of all of space is a flow: bodies in it rotate and move with it."""
    spin = np.array([0.2, -0.5, 0.3])
    flow = shear_flow(1.0, "xy")
    antisymmetric = type(flow)(np.cross(spin, np.eye(3)).T)
    bodies = mixed_cluster()[:2]
    suspension = Suspension(bodies, background=antisymmetric, tolerance=1e-4)
    found = suspension.solve()
    centres = np.array([body.centre for body in bodies])
    assert_allclose(found.velocities, np.cross(spin, centres), atol=1e-4)
    assert_allclose(found.angular_velocities, np.tile(spin, (2, 1)), atol=1e-4)


# ---- swimmers ------------------------------------------------------------------------------


def squirmer(points):
    """Slip sin(theta) e_theta of the unit sphere, B_1 = 1."""
    return points * points[:, 2:] - np.array([0.0, 0.0, 1.0])


def test_far_squirmers_swim_alone_and_disturb_each_other_like_a_dipole():
    """A neutral squirmer's flow decays like 1/r^3: so does what it does to the other's speed."""
    change = []
    for distance in (6.0, 12.0):
        bodies = [
            Body(sphere(), 1.0, (0.0, 0.0, 0.0), quaternion(1)),
            Body(sphere(), 1.0, (distance, 0.0, 0.0), quaternion(2)),
        ]
        found = Suspension(bodies, tolerance=1e-8).solve(slip=squirmer)
        alone = np.array([squirmer_velocity(1.0) * body.axis for body in bodies])
        assert np.abs(found.forces).max() < 1e-6
        change.append(np.abs(found.velocities - alone).max())
    assert math.log2(change[0] / change[1]) == pytest.approx(3.0, abs=0.15)


def test_mirrored_squirmers_swim_as_mirror_images():
    facing = [
        Body(sphere(), 1.0, (0.0, 0.0, -1.6), (1.0, 0.0, 0.0, 0.0)),
        Body(sphere(), 1.0, (0.0, 0.0, 1.6), (0.0, 1.0, 0.0, 0.0)),
    ]
    found = Suspension(facing, tolerance=1e-6).solve(slip=[squirmer, squirmer])
    assert_allclose(found.velocities[0], -found.velocities[1], atol=1e-6)
    assert np.abs(found.angular_velocities).max() < 1e-6
    assert abs(found.velocities[0, 2]) > 0.1


# ---- a flow that is known everywhere -------------------------------------------------------


@pytest.mark.parametrize(
    ("tolerance", "formulation"), [(1e-3, "combined"), (1e-4, "single"), (1e-6, "single")]
)
def test_point_forces_inside_bodies_make_the_flow_outside(tolerance, formulation):
    bodies = mixed_cluster()
    exact = ForcesAtCentres(bodies)
    suspension = Suspension(bodies, tolerance=tolerance, formulation=formulation)
    found = suspension.solve(boundary_velocity=exact.velocity)
    assert found.converged
    assert worst(found.forces, -exact.forces) < 5.0 * tolerance
    assert found.velocities is None
    near = (suspension.nodes + 1e-2 * suspension.normals)[::37]
    far = 3.0 * np.random.default_rng(1).standard_normal((100, 3))
    for points in (near, far):
        u = found.velocity(points)
        outside = np.isfinite(u[:, 0])
        assert outside.sum() > 50
        expected = exact.velocity(points[outside])
        assert worst(u[outside], expected) < tolerance


def test_data_at_the_nodes_are_those_of_the_function():
    bodies = mixed_cluster()[1::-1]
    exact = ForcesAtCentres(bodies)
    suspension = Suspension(bodies, tolerance=1e-3)
    by_function = suspension.solve(boundary_velocity=exact.velocity)
    by_values = suspension.solve(boundary_velocity=exact.velocity(suspension.nodes))
    assert_allclose(by_values.forces, by_function.forces, rtol=1e-12)
    assert len(suspension.nodes) == suspension.offsets[-1]
    ends = np.diff(suspension.offsets)
    assert_allclose(suspension.grids.prod(axis=1), ends)


def test_close_bodies_in_three_dimensions_keep_the_tolerance():
    """Contacts at the equators of grids, where the turned axes cannot help."""
    tolerance, radius = 1e-3, 2.05 / math.sqrt(3.0)
    bodies = [
        Body(sphere(), 1.0, (radius * math.cos(t), radius * math.sin(t), 0.0))
        for t in (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)
    ]
    exact = ForcesAtCentres(bodies)
    suspension = Suspension(bodies, tolerance=tolerance)
    assert suspension.report.least_gap == pytest.approx(0.05, rel=1e-9)
    found = suspension.solve(boundary_velocity=exact.velocity)
    assert worst(found.forces, -exact.forces) < 5.0 * tolerance
    middle = 0.5 * (np.array(bodies[0].centre) + np.array(bodies[1].centre))
    assert worst(found.velocity(middle[None]), exact.velocity(middle[None])) < tolerance


def test_sums_without_fast_methods_reach_tolerances_that_these_do_not():
    bodies = mixed_cluster()[:2]
    exact = ForcesAtCentres(bodies)
    options = SuspensionOptions(resolution=Resolution.uniform(4, 14, 14), near_tolerance=1e-11)
    suspension = Suspension(bodies, tolerance=1e-11, options=options)
    found = suspension.solve(boundary_velocity=exact.velocity)
    assert found.report.fmm.method == "direct"
    # the resolution's error: 14 modes of fields that decay like 2^-n and faster
    assert worst(found.forces, -exact.forces) < 1e-7


def test_iterations_do_not_grow_with_the_number_of_bodies():
    counts = []
    for edge in (2, 3):
        places = 3.0 * np.stack(np.meshgrid(*[range(edge)] * 3), axis=-1).reshape(-1, 3)
        bodies = [Body(sphere(), 1.0, tuple(place)) for place in places.tolist()]
        found = Suspension(bodies, tolerance=1e-3).solve(
            velocity=np.random.default_rng(2).standard_normal((len(bodies), 3))
        )
        counts.append(found.iterations)
    assert counts[1] <= counts[0] + 1


# ---- what is refused, and what is said -----------------------------------------------------


def test_overlapping_bodies_are_refused_with_their_numbers_and_gap():
    bodies = [Body(sphere(), 1.0, (x, 0.0, 0.0)) for x in (0.0, 5.0, 6.5)]
    with pytest.raises(ValueError, match=r"bodies 1 and 2.*overlap: their gap is -0\.5"):
        Suspension(bodies)


@pytest.mark.parametrize("far", [0.0, 100.0])
def test_the_least_gap_itself_is_allowed(far):
    # Neither 2.001 nor 102.001 is a number of the machine: the gap is 1e-3 to round-off only.
    bodies = [Body(sphere(), 1.0, (0.0, 0.0, far + z)) for z in (0.0, 2.001)]
    solution = Suspension(bodies, tolerance=1e-4).solve(force=(0.0, 0.0, -1.0))
    assert solution.converged


def test_gaps_below_the_least_are_refused():
    with pytest.raises(ValueError, match=r"bodies 0 and 1.*too close: their gap is 0\.0005"):
        pair(5e-4)
    with pytest.raises(ValueError, match=r"must be >= 0\.2"):
        pair(0.1, options=SuspensionOptions(least_gap=0.2))


def test_an_iteration_that_ends_early_says_so():
    suspension = pair(0.1, tolerance=1e-6, options=SuspensionOptions(max_iterations=2))
    with pytest.warns(RuntimeWarning, match="has not converged: residual .* after 2 iterations"):
        found = suspension.solve(velocity=[LINE, -LINE])
    assert not found.converged
    assert found.iterations == 2
    assert found.reason == "diverged_max_it"
    assert len(found.residuals) == 3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"velocity": (1, 0, 0), "force": (1, 0, 0)}, "not both"),
        ({"boundary_velocity": lambda x: x, "slip": swim}, "nothing beside"),
        ({"velocity": np.zeros((3, 3))}, r"velocity of shape \(3, 3\): must be \(2, 3\)"),
        ({"force": (1.0, np.nan, 0.0)}, "finite"),
        ({"slip": [swim]}, "1 functions for 2 bodies"),
        ({"slip": lambda x: x}, "body 0: the surface velocity has a net flux"),
        ({"boundary_velocity": np.zeros((7, 3))}, "boundary_velocity of shape"),
    ],
)
def test_data_that_do_not_fit_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        pair(1.0, tolerance=1e-3).solve(**given)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": 0.0}, "tolerance = 0.0"),
        ({"viscosity": -1.0}, "viscosity = -1.0: must be > 0"),
        ({"formulation": "double"}, "must be single or combined"),
    ],
)
def test_arguments_outside_their_rules_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Suspension([Body(sphere())], **arguments)


@pytest.mark.parametrize(
    ("name", "value"),
    [("preconditioner", "ilu"), ("restart", 0), ("least_gap", 0.0), ("fmm_tolerance", 2.0)],
)
def test_options_outside_their_rules_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        SuspensionOptions(**{name: value})


def test_report_says_what_was_made_and_what_it_took():
    suspension = pair(0.5, tolerance=1e-3)
    assert suspension.report.fmm is None
    found = suspension.solve(velocity=LINE)
    report = found.report
    assert report.bodies == 2
    assert report.nodes == len(suspension.nodes) == suspension.offsets[-1]
    assert sum(level.bodies for level in report.levels) == 2
    assert report.applications == found.iterations
    phases = {"geometry", "kernels", "factorisation", "near plan", "fmm plan", "fmm", "near"}
    assert phases | {"self", "preconditioner", "krylov"} <= set(report.seconds)
    assert set(report.memory) == {"operators", "near", "fmm", "preconditioner"}
    assert report.least_gap == pytest.approx(0.5, rel=1e-9)
    assert found.residuals[0] == 1.0
    assert found.residuals[-1] <= report.tolerances.residual


def test_equal_spheres_share_one_factorisation():
    places = [(3.0 * k, 0.0, 0.0) for k in range(4)]
    suspension = Suspension([Body(sphere(), 1.0, place) for place in places], tolerance=1e-3)
    one = pair(1.0, tolerance=1e-3)
    for each in (suspension, one):
        each.solve(velocity=(1.0, 0.0, 0.0))
    assert len(suspension.report.levels) == 1
    assert suspension.report.memory["operators"] == one.report.memory["operators"]


def test_estimate_tells_the_size_of_a_solution_beforehand():
    suspension = Suspension(mixed_cluster(), tolerance=1e-3)
    estimate = suspension.estimate()
    assert suspension.report.fmm is None  # nothing was made
    suspension.solve(velocity=(1.0, 0.0, 0.0))
    report = suspension.report
    assert (estimate.bodies, estimate.nodes) == (report.bodies, report.nodes)
    assert 0.3 < estimate.matrix_bytes / report.memory["operators"] < 6.0


def test_what_exceeds_the_memory_is_refused_before_any_work():
    suspension = Suspension(mixed_cluster(), tolerance=1e-3, options=SuspensionOptions(memory=1e6))
    with pytest.raises(ValueError, match=r"5 bodies with .* nodes would take .* 0\.001 GB"):
        suspension.solve(velocity=(1.0, 0.0, 0.0))
    assert suspension.report.seconds.keys() == {"geometry"}


def _resident():
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_solutions_one_after_another_take_no_more_memory():
    suspension = pair(0.5, tolerance=1e-3)
    velocity = np.array([LINE, -LINE])

    def many(count):
        for k in range(count):
            suspension.solve(velocity=(1.0 + k) * velocity)
            pair(0.5, tolerance=1e-2).solve(force=velocity)

    many(5)
    before = _resident()
    many(20)
    # a vector of GMRES or a plan that stayed each time would add some 20 MB
    assert _resident() - before < 8e6


def test_distribute_gives_every_body_to_this_rank_alone():
    bodies = mixed_cluster()
    assert sorted(map(id, distribute(bodies))) == sorted(map(id, bodies))
    assert distribute([]) == []


def test_options_of_fast_sums_are_passed_on():
    options = SuspensionOptions(fmm=FmmOptions(backend="direct"))
    suspension = pair(1.0, tolerance=1e-3, options=options)
    assert suspension.solve(velocity=LINE).report.fmm.method == "direct"


def test_bodies_in_an_extension_are_pulled_apart_as_mirror_images():
    flow = extensional_flow(1.0, "x")
    bodies = [Body(sphere(), 1.0, (x, 0.0, 0.0)) for x in (-1.5, 1.5)]
    found = Suspension(bodies, background=flow, tolerance=1e-5).solve()
    assert found.velocities[1, 0] > 0.0
    assert_allclose(found.velocities[0], -found.velocities[1], atol=1e-5)
    far = found.velocity(np.array([[100.0, 0.0, 0.0]]))
    # the disturbance has decayed like 1/r^2
    assert_allclose(far, [[100.0, 0.0, 0.0]], atol=1e-2)
