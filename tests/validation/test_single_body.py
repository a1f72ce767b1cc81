"""One sphere in free fall, on an incline, on moving walls: closed solutions and order in h.

The cone complementarity problem (CCP) is a convex relaxation of Coulomb's law: where a contact
slips with speed s it separates with speed mu s. A sliding sphere of gap phi therefore obeys
v_z+ = mu s+ - phi/h, so that its next gap is h mu s+: it hovers h mu s above the plane. Hence,
while it slides, its impulses add up to v_x + mu v_z = v_x0 + (g_x - mu |g_z|) t *exactly*, with
v_z = mu (s+ - s), of first order in h.
"""

from __future__ import annotations

import numpy as np
import pytest

from dem_mpi.scenario import Scenario
from dem_mpi.simulation import Simulation

from scenes import FLOOR, observed_order, scene, simulation_of

EPS = np.finfo(float).eps
G = 9.81
R = 0.1
STEPS = (4e-3, 2e-3, 1e-3, 5e-4)
SOLVE = 1e-11  # [m/s] dual residual that one contact is solved to
TIGHT = {"tolerance": SOLVE, "complementarity": 1e-12}


def advance(simulation: Simulation, steps: int) -> Simulation:
    for _ in range(steps):
        record = simulation.step()
        assert record.converged
    return simulation


# ---- free fall -----------------------------------------------------------------------------


def fall(step: float, time: float) -> np.ndarray:
    scenario = scene(step=step, end=time, gravity=(0.5, 0.0, -G))
    simulation = simulation_of(scenario, [1.0, 2.0, 3.0], R, velocity=[0.25, -0.5, 2.0])
    return advance(simulation, round(time / step)).state.bodies.position[0]


def test_free_fall_is_the_discrete_parabola_to_round_off() -> None:
    """x0 + v0 t + g t (t + h)/2 is the exact sum of the semi-implicit steps.

    Tolerance: each of n steps rounds v and x once, by at most eps times their largest size.
    """
    h, n = 1e-3, 1000
    t = n * h
    exact = (
        np.array([1.0, 2.0, 3.0])
        + np.array([0.25, -0.5, 2.0]) * t
        + 0.5 * np.array([0.5, 0.0, -G]) * t * (t + h)
    )
    largest = 10.0
    np.testing.assert_allclose(fall(h, t), exact, rtol=0, atol=n * EPS * largest)


def test_free_fall_approaches_the_parabola_at_first_order() -> None:
    """The error is g t h/2: order 1 to the accuracy of the measurement."""
    exact = 3.0 + 2.0 - 0.5 * G
    errors = [fall(h, 1.0)[2] - exact for h in STEPS]
    np.testing.assert_allclose(errors, [-0.5 * G * h for h in STEPS], rtol=1e-9)
    assert observed_order(STEPS, errors) == pytest.approx(1.0, abs=1e-6)


# ---- incline -------------------------------------------------------------------------------


def incline(angle: float, mu: float, step: float, time: float) -> Simulation:
    """A sphere at rest on a plane, gravity tilted: x is down the slope."""
    gravity = (G * np.sin(angle), 0.0, -G * np.cos(angle))
    scenario = scene(step=step, end=time, mu=mu, gravity=gravity, walls=[FLOOR], contact=TIGHT)
    return advance(simulation_of(scenario, [0.0, 0.0, R], R), round(time / step))


@pytest.mark.parametrize("mu", [0.12, 0.3, 2.0])
def test_a_sphere_rolls_down_a_gentle_incline(mu: float) -> None:
    """tan(alpha) < 7/2 mu: a = 5/7 g sin(alpha), slip 0.

    Every step keeps v + 2/5 omega r = g sin(alpha) t; a slip s is an error of 2/7 s in v, and the
    solve leaves mu s <= r_d. Over n steps the residuals add up at most to n r_d / mu.
    """
    angle, h, t = np.radians(20.0), 1e-3, 0.5
    assert np.tan(angle) < 3.5 * mu
    bodies = incline(angle, mu, h, t).state.bodies
    tolerance = (t / h) * SOLVE / mu + (t / h) * EPS * 10.0
    speed = 5 / 7 * G * np.sin(angle) * t
    assert bodies.velocity[0, 0] == pytest.approx(speed, abs=tolerance)
    assert bodies.angular_velocity[0, 1] * R == pytest.approx(speed, abs=2.5 * tolerance)
    assert bodies.position[0, 2] == pytest.approx(R, abs=h * (t / h) * SOLVE)


def test_rolling_distance_is_of_first_order() -> None:
    """x = 5/7 g sin(alpha) t (t + h)/2: the error is linear in h."""
    angle, t = np.radians(20.0), 0.2
    a = 5 / 7 * G * np.sin(angle)
    errors = [incline(angle, 0.3, h, t).state.bodies.position[0, 0] - a * t**2 / 2 for h in STEPS]
    assert observed_order(STEPS, errors) == pytest.approx(1.0, abs=1e-4)


def test_a_sphere_slides_down_a_steep_incline() -> None:
    """tan(alpha) > 7/2 mu: v_x + mu v_z = g (sin(alpha) - mu cos(alpha)) t, hovering at h mu s.

    Tolerance: n solves, each with a slip error of at most r_d / mu.
    """
    angle, mu, h, t = np.radians(45.0), 0.2, 1e-3, 0.2
    assert np.tan(angle) > 3.5 * mu
    simulation = incline(angle, mu, h, t)
    bodies = simulation.state.bodies
    n = round(t / h)
    v, w = bodies.velocity[0], bodies.angular_velocity[0]
    acceleration = G * (np.sin(angle) - mu * np.cos(angle))
    assert v[0] + mu * v[2] == pytest.approx(acceleration * t, abs=n * SOLVE / mu)
    # The last solve saw the gap before its step, and put the contact point half-way across it.
    gap_before = bodies.position[0, 2] - R - h * v[2]
    slip = v[0] - w[1] * (R + 0.5 * gap_before)
    assert slip > 0.1
    assert bodies.position[0, 2] - R == pytest.approx(h * mu * slip, abs=n * h * SOLVE)
    # omega r lags: 5/2 mu g cos(alpha), arm r + phi/2 and impulse m (g h cos + dv_z) allowed for.
    arm_error = 0.5 * h * mu * slip / R
    spin = 2.5 * mu * (G * np.cos(angle) * t + v[2])
    assert w[1] * R == pytest.approx(spin, rel=1.01 * arm_error)


def test_sliding_speed_is_of_first_order_with_the_lift_as_its_error() -> None:
    """v_x - a t = -mu v_z = -mu^2 h (g sin(alpha) - 7/2 mu g cos(alpha)) + O(h^2)."""
    angle, mu, t = np.radians(45.0), 0.2, 0.2
    a = G * (np.sin(angle) - mu * np.cos(angle))
    errors = [incline(angle, mu, h, t).state.bodies.velocity[0, 0] - a * t for h in STEPS]
    lift = mu**2 * G * (np.sin(angle) - 3.5 * mu * np.cos(angle))
    np.testing.assert_allclose(errors, [-lift * h for h in STEPS], rtol=0.05)
    assert observed_order(STEPS, errors) == pytest.approx(1.0, abs=0.02)


# ---- sliding to rolling --------------------------------------------------------------------


def launched(step: float, time: float, v0: float, mu: float) -> tuple[Simulation, np.ndarray]:
    """A sphere launched without spin from the gap at which a sliding contact hovers.

    (From gap 0 the relaxation makes it hop: see the next section.) Returns slip after each step.
    """
    scenario = scene(step=step, end=time, mu=mu, walls=[FLOOR], contact=TIGHT)
    simulation = simulation_of(scenario, [0.0, 0.0, R + step * mu * v0], R, velocity=[v0, 0.0, 0.0])
    slips = []
    for _ in range(round(time / step)):
        simulation.step()
        bodies = simulation.state.bodies
        slips.append(bodies.velocity[0, 0] - bodies.angular_velocity[0, 1] * R)
    return simulation, np.array(slips)


def test_sliding_turns_into_rolling() -> None:
    """At t = 2 v0/(7 mu g), with 5/7 v0, for ever after; position, speed and time of order 1.

    exact x(T) = x(t*) + 5/7 v0 (T - t*), x(t*) = v0 t* - mu g t*^2/2.
    """
    v0, mu, end = 1.0, 0.3, 0.16
    change = 2 * v0 / (7 * mu * G)
    assert change < end
    exact = v0 * change - 0.5 * mu * G * change**2 + 5 / 7 * v0 * (end - change)
    speed_errors, position_errors = [], []
    for h in STEPS:
        simulation, slips = launched(h, end, v0, mu)
        # Rolling: slip below what the hovering arm, r + h mu s/2 instead of r, can feign.
        first = int(np.argmax(np.abs(slips) < h * mu * v0 * v0 / R))
        # Resolved to a step; the lift of order h shifts it by v_z/g, less than a step.
        assert (first + 1) * h == pytest.approx(change, abs=2 * h)
        bodies = simulation.state.bodies
        speed_errors.append(bodies.velocity[0, 0] - 5 / 7 * v0)
        position_errors.append(bodies.position[0, 0] - exact)
        rolling = bodies.angular_velocity[0, 1] * R
        assert rolling == pytest.approx(bodies.velocity[0, 0], abs=1e-9)
    assert observed_order(STEPS, speed_errors) == pytest.approx(1.0, abs=0.1)
    assert observed_order(STEPS, position_errors) == pytest.approx(1.0, abs=0.1)
    # 2/7 of the angular impulse's relative error: the arm exceeds r by at most h mu v0/2.
    bound = [2 / 7 * v0 * 0.5 * h * mu * v0 / R for h in STEPS]
    assert (np.abs(speed_errors) <= bound).all()


def test_a_sphere_set_down_while_sliding_hops_at_mu_times_its_slip() -> None:
    """The relaxation's known price, which no step size cures: from gap 0, v_z+ = mu s+.

    One solve: p = mu s0 + g h over 1 + 7/2 mu^2 per unit mass, v_z+ = p - g h, v_x+ = v0 - mu p.
    """
    v0, mu, h = 1.0, 0.3, 1e-3
    scenario = scene(step=h, mu=mu, walls=[FLOOR], contact=TIGHT)
    simulation = simulation_of(scenario, [0.0, 0.0, R], R, velocity=[v0, 0.0, 0.0])
    simulation.step()
    p = (mu * v0 + G * h) / (1 + 3.5 * mu**2)
    np.testing.assert_allclose(
        simulation.state.bodies.velocity[0], [v0 - mu * p, 0.0, p - G * h], rtol=0, atol=1e-9
    )


# ---- rotation ------------------------------------------------------------------------------


def test_a_spin_of_1e4_rad_s_keeps_unit_quaternions() -> None:
    """q is renormalised in each step, to 1e-15 (a few eps), and turns by the exact angle.

    Tolerance of the angle: n products, each rounding by a few eps.
    """
    h, n = 1e-3, 1000
    w = np.array([6e3, 0.0, 8e3])
    scenario = scene(step=h, gravity=(0, 0, 0))
    simulation = advance(simulation_of(scenario, [0, 0, 0], R, angular_velocity=w), n)
    q = simulation.state.bodies.orientation[0]
    assert abs(np.linalg.norm(q) - 1.0) <= 1e-15
    half = 0.5 * 1e4 * h * n
    exact = np.concatenate(([np.cos(half)], np.sin(half) * w / 1e4))
    np.testing.assert_allclose(q, exact, rtol=0, atol=n * 4 * EPS)
    np.testing.assert_array_equal(simulation.state.bodies.angular_velocity[0], w)


def test_a_spinning_sphere_on_a_rough_floor_stays_finite() -> None:
    """10^4 rad/s, rim speed 1000 m/s: energy falls in every step, nothing blows up."""
    scenario = scene(step=1e-3, mu=0.3, walls=[FLOOR], contact={"tolerance": 1e-6})
    simulation = simulation_of(scenario, [0, 0, R], R, angular_velocity=[0, 1e4, 0])
    inertia, mass = simulation.state.bodies.inertia[0], simulation.state.bodies.mass[0]
    bodies = simulation.state.bodies
    height = bodies.position[0, 2]
    before = 0.5 * inertia * 1e8 + mass * G * height
    for _ in range(200):
        simulation.step()
        bodies = simulation.state.bodies
        after = (
            0.5 * mass * bodies.velocity[0] @ bodies.velocity[0]
            + 0.5 * inertia * bodies.angular_velocity[0] @ bodies.angular_velocity[0]
            + mass * G * bodies.position[0, 2]
        )
        assert np.isfinite(after)
        assert after <= before * (1 + 1e-12)
        assert abs(np.linalg.norm(bodies.orientation[0]) - 1.0) <= 1e-15
        before = after


# ---- driven walls --------------------------------------------------------------------------


def on_moving_floor(motion: dict, mu: float, step: float) -> Scenario:
    return scene(step=step, mu=mu, walls=[{**FLOOR, "motion": motion}], contact=TIGHT)


def test_a_rising_floor_carries_a_sphere() -> None:
    """The sphere takes the floor's velocity in the first step and rests on it.

    Tolerance: r_d a step.
    """
    h, n = 1e-3, 100
    scenario = on_moving_floor({"velocity": [0, 0, 0.5]}, 0.3, h)
    simulation = simulation_of(scenario, [0, 0, R], R)
    for k in range(1, n + 1):
        simulation.step()
        bodies = simulation.state.bodies
        assert bodies.velocity[0, 2] == pytest.approx(0.5, abs=10 * SOLVE)
        assert bodies.position[0, 2] == pytest.approx(R + 0.5 * k * h, abs=10 * k * h * SOLVE)


def test_a_conveyor_drags_a_sphere_to_two_sevenths_of_its_speed() -> None:
    """v - 2/5 omega' r is conserved, so that without slip v = 2/7 u, for ever.

    Tolerance: the hovering arm r + h mu s/2 bends the angular impulse by h mu u/(2 r).
    """
    h, u, mu = 1e-3, 0.5, 0.3
    scenario = on_moving_floor({"velocity": [u, 0, 0]}, mu, h)
    simulation = simulation_of(scenario, [0, 0, R + h * mu * u], R)
    advance(simulation, 200)
    bodies = simulation.state.bodies
    tolerance = u * h * mu * u / (2 * R)
    assert bodies.velocity[0, 0] == pytest.approx(2 / 7 * u, abs=tolerance)
    rim = bodies.velocity[0, 0] - bodies.angular_velocity[0, 1] * R
    assert rim == pytest.approx(u, abs=1e-8)


def test_an_oscillating_plate_moves_with_its_mean_velocity_over_the_step() -> None:
    """Where the plate accelerates by less than g the sphere follows it, gap 0 after every step.

    With the velocity of an instant the gap would be of order h^2 omega^2 A/2 = 5e-7 m a step.
    """
    h, amplitude, frequency, phase = 1e-3, 0.01, 4.0, 0.3
    swing = {"amplitude": [0, 0, amplitude], "frequency": frequency, "phase": phase}
    assert amplitude * (2 * np.pi * frequency) ** 2 < G
    scenario = on_moving_floor({"oscillation": swing}, 0.0, h)
    simulation = simulation_of(scenario, [0, 0, R], R)
    for k in range(1, 501):
        simulation.step()
        angle = 2 * np.pi * frequency * k * h + phase
        plate = amplitude * (np.sin(angle) - np.sin(phase))
        assert simulation.state.bodies.position[0, 2] - R == pytest.approx(plate, abs=1e-10)
