"""Impacts, overlaps, piles: momentum, energy, cones, recovery speed.

The impact law is perfectly inelastic along the normal. In the relaxation (CCP) a contact that
slips with speed s after the impact separates with mu s.
"""

from __future__ import annotations

import numpy as np
import pytest

from dem_mpi.parallel import Parallel
from dem_mpi.simulation import Simulation

from scenes import FLOOR, everybody, make_fail, placed, scene, simulation_of, touching, watch

EPS = np.finfo(float).eps
G = 9.81
R = 0.1
SOLVE = 1e-11  # [m/s]
TIGHT = {"tolerance": SOLVE, "complementarity": 1e-12}
LOOSE = {"tolerance": 1e-3, "complementarity": 1e-2}
WEIGHTLESS = (0.0, 0.0, 0.0)


# ---- two bodies ----------------------------------------------------------------------------


@pytest.mark.parametrize(("radius", "mu"), [(R, 0.0), (R, 0.5), (0.001 * R, 0.0), (0.01 * R, 0.5)])
def test_a_head_on_impact_is_perfectly_inelastic(radius: float, mu: float) -> None:
    """Both go on at m1 v/(m1 + m2), 1/2 m1 m2/(m1 + m2) v^2 is lost; mass ratios 1, 10^6, 10^9.

    Tolerance: r_d of each solve in which they touch.
    """
    scenario = scene(step=1e-3, mu=mu, gravity=WEIGHTLESS, contact=TIGHT)
    position = [[0, 0, 0], [R + radius + 0.0123, 0, 0]]
    simulation = simulation_of(scenario, position, [R, radius], velocity=[[1.0, 0, 0], [0, 0, 0]])
    mass = everybody(simulation.parallel, simulation.state).mass
    for _ in range(30):
        last = simulation.step()
    common = mass[0] / mass.sum()
    velocity = everybody(simulation.parallel, simulation.state).velocity
    np.testing.assert_allclose(velocity, [[common, 0, 0]] * 2, rtol=0, atol=30 * SOLVE)
    assert last.kinetic_energy == pytest.approx(0.5 * mass[0] * common, rel=1e-9)


def test_an_oblique_impact_that_sticks_takes_the_normal_speed_and_rolls() -> None:
    """v_n = 0, and v_t + 2/5 omega r = v_t0 without slip: v_t = 5/7 v_t0 (arm r, gap 0)."""
    scenario = scene(step=1e-3, mu=1.0, gravity=WEIGHTLESS, walls=[FLOOR], contact=TIGHT)
    simulation = simulation_of(scenario, [0, 0, R], R, velocity=[0.7, 0, -1.0])
    simulation.step()
    bodies = simulation.state.bodies
    np.testing.assert_allclose(bodies.velocity[0], [0.5, 0, 0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(bodies.angular_velocity[0], [0, 0.5 / R, 0], rtol=0, atol=1e-9)


def test_an_oblique_impact_that_slides_leaves_at_mu_times_its_slip() -> None:
    """p = (mu s0 - v_n)/(1 + 7/2 mu^2) per unit mass; v_t = s0 - mu p, v_n+ = v_n + p = mu s+.

    Coulomb's law itself would give v_n+ = 0: this lift is the relaxation's.
    """
    mu, v_n, s0 = 0.2, -1.0, 3.0
    scenario = scene(step=1e-3, mu=mu, gravity=WEIGHTLESS, walls=[FLOOR], contact=TIGHT)
    simulation = simulation_of(scenario, [0, 0, R], R, velocity=[s0, 0, v_n])
    simulation.step()
    bodies = simulation.state.bodies
    p = (mu * s0 - v_n) / (1 + 3.5 * mu**2)
    slip = s0 - 3.5 * mu * p
    assert slip > 0
    np.testing.assert_allclose(bodies.velocity[0], [s0 - mu * p, 0, mu * slip], rtol=0, atol=1e-10)
    assert bodies.angular_velocity[0, 1] * R == pytest.approx(2.5 * mu * p, abs=1e-10)


def test_an_oblique_impact_of_two_spheres_spins_both_alike() -> None:
    """The same p, per reduced mass m/2: half of each change goes to either sphere, and both turn
    at 5/4 mu p / R in one sense (arms +R and -R, impulses - and +)."""
    mu, v_n, s0 = 0.2, -1.0, 3.0
    scenario = scene(step=1e-3, mu=mu, gravity=WEIGHTLESS, contact=TIGHT)
    simulation = simulation_of(
        scenario, [[0, 0, 0], [2 * R, 0, 0]], R, velocity=[[-v_n, s0, 0], [0, 0, 0]]
    )
    simulation.step()
    bodies = everybody(simulation.parallel, simulation.state)
    p = (mu * s0 - v_n) / (1 + 3.5 * mu**2)
    first = [-v_n - p / 2, s0 - mu * p / 2, 0]
    np.testing.assert_allclose(bodies.velocity, [first, [p / 2, mu * p / 2, 0]], rtol=0, atol=1e-10)
    spin = -1.25 * mu * p / R
    np.testing.assert_allclose(bodies.angular_velocity, [[0, 0, spin]] * 2, rtol=0, atol=1e-9)


# ---- conservation --------------------------------------------------------------------------


def momenta(simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Collective. Sums (2, 3) of linear and angular momentum about the origin, and (2,) the sums
    of the sizes of their terms."""
    b = everybody(simulation.parallel, simulation.state)
    linear = b.mass[:, None] * b.velocity
    orbital = np.cross(b.position, linear)
    spin = b.inertia[:, None] * b.angular_velocity
    total = np.stack([linear.sum(axis=0), (orbital + spin).sum(axis=0)])
    sizes = [np.linalg.norm(term, axis=1).sum() for term in (linear, orbital, spin)]
    return total, np.array([sizes[0], sizes[1] + sizes[2]])


def shrinking_cloud(parallel: Parallel) -> Simulation:
    """Collective. 60 unequal spinning spheres that fly at one another; no gravity, no walls."""
    rng = np.random.default_rng(7)
    radius = rng.uniform(0.03, 0.1, 60)
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:60]
    position = 0.21 * (grid - 1.5) + rng.uniform(-0.005, 0.005, (60, 3))
    velocity = -10.0 * position + rng.uniform(-1.0, 1.0, (60, 3)) + [0.3, 0.1, -0.2]
    scenario = scene(step=2e-3, mu=0.5, gravity=WEIGHTLESS, contact=LOOSE)
    spin = rng.uniform(-20.0, 20.0, (60, 3))
    return simulation_of(scenario, position, radius, velocity, spin, parallel=parallel)


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
def test_momentum_is_conserved_between_free_bodies(parallel: Parallel) -> None:
    """Linear and angular momentum to 1e-12 of the sum of their terms, however loose the solve.

    Impulses are equal, opposite and applied at one point, so nothing but round-off is left:
    the impulses of about 100 contacts, each rounded by eps, over 24 steps.
    """
    simulation = shrinking_cloud(parallel)
    before, scale = momenta(simulation)
    energy = simulation.step().kinetic_energy
    records = [simulation.step() for _ in range(23)]
    after, _ = momenta(simulation)
    assert sum(record.contacts for record in records) > 500
    assert records[-1].kinetic_energy < 0.5 * energy
    assert (np.abs(after - before) <= 1e-12 * scale[:, None]).all()


# ---- energy --------------------------------------------------------------------------------


def box(motion: dict | None = None) -> dict:
    walls = {"shape": "box", "material": "m", "min": [0, 0, 0], "max": [0.4, 0.4, 1]}
    return {**walls, "open": ["z_max"], **({"motion": motion} if motion else {})}


def pile(count: int) -> dict:
    """Bodies falling on a floor in a box eight to thirteen radii wide."""
    grid = {"min": [0, 0, 0], "max": [0.4, 0.4, 0.4], "jitter": 0.8}
    return {
        "material": "m",
        "count": count,
        "radius": {"uniform": [0.03, 0.05]},
        "placement": {"jittered_grid": grid},
        "velocity": [0, 0, -1],
        "velocity_jitter": 1.0,
    }


DRIVES = {
    "at rest": None,
    "moving": {"velocity": [0.3, -0.1, 0.2]},
    "shaken": {"oscillation": {"amplitude": [0.01, 0, 0.02], "frequency": 10.0, "phase": 0.4}},
}


def check_energy(parallel: Parallel, mu: float, motion: dict | None, steps: int) -> None:
    scenario = scene(step=2e-3, mu=mu, bodies=[pile(48)], walls=[box(motion)], contact=LOOSE)
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    contacts = 0
    for _ in range(steps):
        record = simulation.step()
        contacts += record.contacts
        scale = max(record.kinetic_energy, record.kinetic_energy - record.energy_change)
        assert abs(record.energy_change - record.energy_balance) <= 1e-12 * scale
    assert contacts > 20 * steps


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("mu", [0.0, 0.4])
def test_energy_changes_as_the_contacts_account_for_it(drive: str, mu: float) -> None:
    """KE(v+) - KE(v_hat) = -gamma.N gamma/2 + gamma.g - sum gamma_n b_phi - gamma.b_wall, always.

    To 1e-12 of the larger kinetic energy: an identity, so round-off alone parts the two sides,
    some 100 terms of the size of the energy, each rounded by a few eps.
    """
    check_energy(Parallel.alone(), mu, DRIVES[drive], steps=100)


@pytest.mark.mpi(ranks=[3])
def test_energy_is_accounted_for_across_ranks(parallel: Parallel) -> None:
    """The same identity summed over three ranks, with a shaken box."""
    check_energy(parallel, 0.4, DRIVES["shaken"], steps=60)


def test_energy_is_accounted_for_over_the_parts_of_a_shrunken_step() -> None:
    """A step taken in pieces reports the sums over its pieces (1e-12 as above)."""
    contact = {**LOOSE, "on_failure": "shrink_step"}
    scenario = scene(step=2e-3, mu=0.4, bodies=[pile(24)], walls=[box()], contact=contact)
    parallel = Parallel.alone()
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    for _ in range(60):
        simulation.step()
    for failures in (1, 2, 3):
        make_fail(simulation, failures)
        record = simulation.step()
        assert record.substeps == failures + 1
        assert record.contacts > 10
        scale = max(record.kinetic_energy, record.kinetic_energy - record.energy_change)
        assert abs(record.energy_change - record.energy_balance) <= 1e-12 * scale


# ---- cones and degrees of freedom ----------------------------------------------------------


@pytest.mark.parametrize("mu", [1e-3, 0.3, 2.0])
def test_impulses_lie_in_their_cones(mu: float) -> None:
    """|gamma_t| <= mu gamma_n and gamma_n >= 0 to 1e-14 of the largest impulse, converged or not:
    every iterate is a projection, rounded by a few eps."""
    scenario = scene(
        step=2e-3,
        mu=mu,
        bodies=[pile(48)],
        walls=[box()],
        contact={**LOOSE, "max_iterations": 30, "stop_factor": 1e9},
    )
    parallel = Parallel.alone()
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    solver = watch(simulation)
    seen = 0
    for _ in range(100):
        simulation.step()
        gamma = solver.report.impulse
        tangential = np.hypot(gamma[:, 1], gamma[:, 2])
        outside = np.maximum(tangential - mu * gamma[:, 0], -gamma[:, 0])
        assert outside.max(initial=0.0) <= 1e-14 * gamma.max(initial=0.0)
        assert solver.report.residuals.primal <= 1e-14 * gamma.max(initial=0.0)
        seen += int(np.count_nonzero(tangential))
    assert seen > 1000


def test_a_frictionless_scene_has_one_row_a_contact_and_three_freedoms_a_body() -> None:
    """mu = 0: impulses have one column, bodies three velocities, and nothing ever rotates."""
    scenario = scene(step=2e-3, bodies=[pile(48)], walls=[box()], contact=LOOSE)
    parallel = Parallel.alone()
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    solver = watch(simulation)
    contacts = sum(simulation.step().contacts for _ in range(100))
    assert contacts > 2500
    gamma = solver.report.impulse
    assert gamma.shape[1] == 1
    assert solver.problem.operator.body_velocity(gamma).shape[1] == 3
    bodies = simulation.state.bodies
    assert not bodies.angular_velocity.any()
    np.testing.assert_array_equal(bodies.orientation, np.tile([1.0, 0, 0, 0], (48, 1)))


def test_one_rough_pair_among_smooth_ones_gives_friction_to_that_pair_only() -> None:
    """mu = 0 contacts in a scene with friction carry no tangential impulse: exactly zero."""
    pair = [{"between": ["m", "rough"], "mu": 0.5}]
    scenario = scene(
        step=2e-3,
        materials={"m": {"density": 1000.0}, "rough": {"density": 1000.0}},
        friction={"default": 0.0, "pairs": pair},
        bodies=[pile(48)],
        walls=[
            box(),
            {**FLOOR, "material": "rough", "normal": [0.3, 0, 1], "point": [0.2, 0.2, 0]},
        ],
        contact=LOOSE,
    )
    parallel = Parallel.alone()
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    solver = watch(simulation)
    rough = 0
    for _ in range(100):
        simulation.step()
        gamma, mu = solver.report.impulse, solver.problem.mu
        assert not gamma[mu == 0.0, 1:].any()
        rough += int(np.count_nonzero(gamma[mu > 0.0, 1:]))
    assert rough > 100


# ---- deep overlap --------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("mass_ratio", [1.0, 1e6])
def test_overlap_is_pushed_out_at_the_recovery_speed_and_no_faster(
    depth: float, mass_ratio: float
) -> None:
    """Separation speed v_rec while they overlap, and never more (+ r_d), also after they part."""
    recovery, h = 0.2, 1e-3
    scenario = scene(step=h, gravity=WEIGHTLESS, contact={**TIGHT, "recovery_speed": recovery})
    small = R * mass_ratio ** (-1 / 3)
    apart = R + small - depth * small
    simulation = simulation_of(scenario, [[0, 0, 0], [apart, 0, 0]], [R, small])
    steps = int(2 * depth * small / (recovery * h)) + 2
    for _ in range(steps):
        simulation.step()
        bodies = everybody(simulation.parallel, simulation.state)
        speed = bodies.velocity[1, 0] - bodies.velocity[0, 0]
        assert speed <= recovery + 10 * SOLVE
    gap = bodies.position[1, 0] - bodies.position[0, 0] - R - small
    assert gap > 0
    assert speed > 0


def test_unbounded_recovery_removes_an_overlap_in_one_step() -> None:
    """recovery_speed: null gives depth/h, the step's whole overlap."""
    h, depth = 1e-3, 0.5 * R
    contact = {**TIGHT, "recovery_speed": None}
    scenario = scene(step=h, gravity=WEIGHTLESS, contact=contact)
    simulation = simulation_of(scenario, [[0, 0, 0], [2 * R - depth, 0, 0]], R)
    simulation.step()
    bodies = everybody(simulation.parallel, simulation.state)
    speed = bodies.velocity[1, 0] - bodies.velocity[0, 0]
    assert speed == pytest.approx(depth / h, rel=1e-9)
    assert bodies.position[1, 0] - bodies.position[0, 0] == pytest.approx(2 * R, abs=1e-12)


def test_coincident_centres_part_along_the_vertical_and_are_counted() -> None:
    """No normal exists: e_z by convention, at v_rec, with nothing undefined."""
    scenario = scene(step=1e-3, mu=0.3, gravity=WEIGHTLESS, contact=TIGHT)
    simulation = simulation_of(scenario, [[0.5, 0.5, 0.5]] * 2, R)
    record = simulation.step()
    assert record.coincident == 1
    bodies = everybody(simulation.parallel, simulation.state)
    np.testing.assert_allclose(bodies.velocity, [[0, 0, -0.1], [0, 0, 0.1]], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(touching(simulation.parallel, simulation.state), [[0, 1]])
