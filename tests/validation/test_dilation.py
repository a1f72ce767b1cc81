"""What sliding contacts do under both laws of friction, against the step length h.

The cone complementarity problem ("ccp") lets a sliding contact open at mu |v_t|: by h mu |v_t| in
a step. Under Coulomb's law ("coulomb") it stays closed, at any h.
"""

from __future__ import annotations

import sys
from functools import cache

import numpy as np
import pytest

from dem_mpi.parallel import Parallel
from dem_mpi.simulation import Simulation

from launch import ROOT
from scenes import FLOOR, observed_order, placed, scene, simulation_of

sys.path.insert(0, str(ROOT / "scripts" / "bench" / "lib"))
import dilation

G, R = 9.81, 0.1
STEPS = (4e-3, 2e-3, 1e-3, 5e-4)
TOLERANCE = 1e-10  # [m/s] of every solve of a sphere
LAW = {"law": "coulomb", "tolerance": TOLERANCE, "complementarity": TOLERANCE}


# ---- a sphere on a floor -------------------------------------------------------------------


@cache
def launched(law: dilation.Law, step: float, mu: float = 0.3) -> dilation.SlidingRecord:
    return dilation.sliding_sphere(law, step, mu, tolerance=TOLERANCE)


def test_sliding_sphere_rises_under_ccp_at_first_order_and_not_at_all_under_coulomb() -> None:
    """From gap 0: after a step of ccp the gap is h (mu s + g h)/(1 + 7/2 mu^2) - g h^2, s = 1 m/s
    (one solve in closed form). Under Coulomb's law every step leaves g_n within the tolerance and
    pushes the overlap of the last one out: gaps stay below h times it, with a margin of 10.
    """
    mu = 0.3
    hops = [launched("ccp", h).hop for h in STEPS]
    exact = [h * ((mu + G * h) / (1 + 3.5 * mu**2) - G * h) for h in STEPS]
    np.testing.assert_allclose(hops, exact, rtol=1e-6)
    assert observed_order(STEPS, hops) == pytest.approx(1.0, abs=0.05)
    for h in STEPS:
        record = launched("coulomb", h)
        assert record.converged
        # A complementarity within 1e-10 v_ref gamma_ref at the load m g h leaves g_n / that load.
        closing = TOLERANCE * 1.0 / (G * h)
        assert record.hop <= h * closing
        assert record.gap <= 10 * h * closing


@pytest.mark.parametrize("mu", [0.1, 0.3, 1.0])
def test_sliding_friction_is_mu_times_the_weight(mu: float) -> None:
    """The first step takes mu g h from the speed, to the tolerance over that; under ccp the impact
    that opens the contact takes mu^2 s/(1 + 7/2 mu^2) more, at any h."""
    for h in STEPS[1::2]:
        coulomb, ccp = launched("coulomb", h, mu), launched("ccp", h, mu)
        assert coulomb.slowing == pytest.approx(1.0, abs=10 * TOLERANCE / (mu * (G * h) ** 2))
        more = mu * (mu + G * h) / (1 + 3.5 * mu**2) / (mu * G * h)
        assert ccp.slowing == pytest.approx(more, rel=1e-6)
        assert more > 3


def test_sliding_turns_into_rolling_at_five_sevenths_whatever_the_step() -> None:
    """Under ccp the arm r + gap/2 of the hopping sphere bends that at first order."""
    errors = [launched("ccp", h).speed_error for h in STEPS]
    assert observed_order(STEPS, errors) == pytest.approx(1.0, abs=0.15)
    assert min(map(abs, errors)) > 1e-5
    for h in STEPS:
        assert launched("coulomb", h).speed_error == pytest.approx(0.0, abs=1e-8)


def test_sphere_rolls_below_the_limit_of_friction_and_slips_above_it() -> None:
    """On an incline, tan(a) = 7/2 mu divides them; slip = g (sin a - 7/2 mu cos a) t, no lift."""
    mu, h, n = 0.2, 1e-3, 100
    limit = np.arctan(3.5 * mu)
    for angle in (limit - 0.01, limit + 0.01):
        gravity = (G * np.sin(angle), 0.0, -G * np.cos(angle))
        scenario = scene(step=h, mu=mu, gravity=gravity, walls=[FLOOR], contact=LAW)
        simulation = simulation_of(scenario, [0.0, 0.0, R], R)
        for _ in range(n):
            assert simulation.step().converged
        bodies = simulation.state.bodies
        slip = bodies.velocity[0, 0] - bodies.angular_velocity[0, 1] * R
        expected = max(0.0, G * (np.sin(angle) - 3.5 * mu * np.cos(angle)) * n * h)
        assert slip == pytest.approx(expected, abs=n * 1e-7)
        assert (slip > 1e-3) == (angle > limit)
        assert bodies.position[0, 2] - R == pytest.approx(0.0, abs=1e-9)


def test_sphere_that_lands_sliding_does_not_bounce() -> None:
    """Closing at 2 m/s and sliding at 10: ccp leaves it at mu s+ upwards, Coulomb at rest normally,
    and the impact takes mu times its normal impulse from the slide."""
    mu, h = 0.3, 1e-3
    for law, leaves in (("coulomb", False), ("ccp", True)):
        contact = {**LAW, "law": law}
        scenario = scene(step=h, mu=mu, gravity=[0, 0, 0], walls=[FLOOR], contact=contact)
        simulation = simulation_of(scenario, [0, 0, R], R, velocity=[10.0, 0.0, -2.0])
        simulation.step()
        v = simulation.state.bodies.velocity[0]
        if leaves:
            assert v[2] > 1.0
        else:
            np.testing.assert_allclose(v, [10.0 - mu * 2.0, 0.0, 0.0], rtol=0, atol=1e-7)


# ---- a sheared bed -------------------------------------------------------------------------

BED_STEPS = (2e-3, 1e-3, 5e-4)


@pytest.fixture(scope="module")
def beds() -> dict[tuple[str, float], dilation.ShearRecord]:
    """350 spheres between two plates, the same bed sheared on under both laws."""
    parallel, size = Parallel.alone(), {"count": 350, "length": 0.075}
    pressed = dilation.pressed_bed(parallel, step=2e-3, **size)
    return {
        (law, h): dilation.sheared_bed(parallel, pressed, law, h, time=0.03, skip=0.01, **size)
        for h in BED_STEPS
        for law in dilation.LAWS
    }


def test_sheared_bed_opens_under_ccp_at_first_order_and_not_under_coulomb(beds) -> None:
    """Gap of bearing contacts that slide, weighted by load. The order of ccp is that of a mean over
    a hundred contacts in motion; what the other law leaves is h times the solves' tolerance, 1e-3
    m/s, at most: it has no opening to speak of."""
    opened = [beds["ccp", h].sliding for h in BED_STEPS]
    assert observed_order(BED_STEPS, opened) == pytest.approx(1.0, abs=0.4)
    for h in BED_STEPS:
        assert beds["ccp", h].unconverged == beds["coulomb", h].unconverged == 0
        # mu |v_t| of a plate's order, 0.2 m/s: a twentieth of it at least.
        assert beds["ccp", h].sliding > 0.05 * h * 0.5 * 0.2
        assert abs(beds["coulomb", h].sliding) <= h * 1e-3
        assert abs(beds["coulomb", h].sliding) < 0.1 * beds["ccp", h].sliding


def test_sheared_bed_costs_a_few_cone_problems_a_step(beds) -> None:
    """No bound of theory: early problems are solved coarsely, from the last impulse."""
    for h in BED_STEPS:
        ccp, coulomb = beds["ccp", h], beds["coulomb", h]
        assert ccp.outer == 1
        assert 1 < coulomb.outer < 15
        assert coulomb.products < 10 * ccp.products


def test_energy_is_accounted_for_with_the_true_bias_velocity() -> None:
    """KE(v+) - KE(v_hat) from the bodies and from the contacts, in a sliding and rolling pile."""
    group = {
        "material": "m",
        "count": 40,
        "radius": 0.05,
        "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [0.6, 0.6, 0.4], "jitter": 0.5}},
        "velocity": [2.0, 0.0, -1.0],
    }
    scenario = scene(
        step=1e-3, mu=0.5, bodies=[group], walls=[FLOOR],
        contact={"law": "coulomb", "tolerance": 1e-6, "complementarity": 1e-6},
    )  # fmt: skip
    parallel = Parallel.alone()
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    lost = 0.0
    for _ in range(60):
        record = simulation.step()
        assert record.converged, record.reason
        assert record.energy_change == pytest.approx(
            record.energy_balance, rel=0, abs=1e-12 * record.kinetic_energy
        )
        lost -= record.energy_change
    assert lost > 0.05 * record.kinetic_energy
