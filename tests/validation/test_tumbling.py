"""Spheroids and rods tumbling free of torque, and under given torques: exact motion, order in h.

A body with moments I_t across and I_a along its symmetry axis d has L = I_t w + (I_a - I_t)(w.d) d
constant in the world. The axis precesses about L at the rate |L| / I_t, and the body turns about
its axis at (1 - I_a/I_t)(w.d) relative to the precessing frame. A step makes that motion exactly,
so angular momentum and energy change by round-off alone; what a torque does enters as a kick at
the start of each step, which is of first order in h (symplectic Euler).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from dem_mpi import integrator
from dem_mpi.bodies import Bodies
from dem_mpi.parallel import Parallel
from dem_mpi.shapes import SPHERE, SPHEROCYLINDER, SPHEROID
from dem_mpi.simulation import Simulation

from scenes import observed_order, placed, scene

EPS = np.finfo(float).eps

# (shape, radius, half length) [m]
BODIES = {
    "rod": (SPHEROCYLINDER, 0.01, 0.03),
    "needle": (SPHEROCYLINDER, 1e-3, 0.999),
    "prolate": (SPHEROID, 0.01, 0.03),
    "oblate": (SPHEROID, 0.03, 0.01),
    "disc": (SPHEROID, 1.0, 1e-3),
    "nearly a sphere": (SPHEROID, 0.01, 0.01 * (1 + 1e-12)),
}
each_body = pytest.mark.parametrize("name", BODIES)


def body(name: str, spin: tuple[float, float, float]) -> Bodies:
    """One body, tilted, with an angular velocity in the world [rad/s]."""
    shape, radius, half_length = BODIES[name]
    tilt = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_quat()
    arrays = {
        "gid": [0],
        "material": [0],
        "shape": [shape],
        "radius": [radius],
        "half_length": [half_length],
        "position": [[0.0, 0.0, 0.0]],
        "orientation": [np.roll(tilt, 1)],
        "angular_velocity": [spin],
    }
    return Bodies.from_arrays(arrays, [1000.0])


def turn_freely(bodies: Bodies, h: float, steps: int) -> Bodies:
    for _ in range(steps):
        spin = bodies.angular_velocity.copy()
        integrator.advance(bodies, bodies.velocity.copy(), spin, h, True, 1)
    return bodies


def angular_momentum(bodies: Bodies) -> np.ndarray:
    """L [kg m^2/s] of the only body."""
    w, d = bodies.angular_velocity[0], integrator.symmetry_axes(bodies)[0]
    return bodies.inertia[0] * w + (bodies.axial_inertia - bodies.inertia)[0] * (w @ d) * d


def energy(bodies: Bodies) -> float:
    return integrator.kinetic_energy(bodies, bodies.velocity, bodies.angular_velocity)


def rotation(bodies: Bodies) -> Rotation:
    return Rotation.from_quat(np.roll(bodies.orientation[0], -1))


# ---- free of torque ------------------------------------------------------------------------


@each_body
@pytest.mark.parametrize(
    ("h", "spin"),
    [
        (1e-4, (3.0, 2.0, 10.0)),
        (1e-2, (3.0, 2.0, 10.0)),
        (1e-3, (1e4, 2e3, 3e3)),
        (1.0, (1e4, 1.0, 1e4)),
        (1e-3, (1e-9, 2e-9, 0.0)),
    ],
)
def test_free_tumbling_keeps_angular_momentum_and_energy(name: str, h: float, spin) -> None:
    """Over 10^4 steps, whatever the angle h w of one of them, to 10^4 rad.

    Tolerance: a step rounds by some eps. These add up as a random walk to 100 eps = 2e-14, or at
    worst in proportion to the steps, 1e4 eps = 2e-12.
    """
    bodies = body(name, spin)
    momentum, start = angular_momentum(bodies), energy(bodies)
    turn_freely(bodies, h, 10_000)
    assert np.linalg.norm(bodies.orientation[0]) == pytest.approx(1.0, abs=4 * EPS)
    change = np.linalg.norm(angular_momentum(bodies) - momentum)
    assert change <= 1e-12 * np.linalg.norm(momentum)
    assert energy(bodies) == pytest.approx(start, rel=1e-12)


@pytest.mark.parametrize("name", ["rod", "oblate"])
def test_free_tumbling_does_not_drift_with_the_number_of_steps(name: str) -> None:
    """Round-off walks at random: 1e5 steps stray no more than 1e-12, so 1e6 would by 1e-11."""
    bodies = body(name, (3.0, 2.0, 10.0))
    momentum, start = angular_momentum(bodies), energy(bodies)
    turn_freely(bodies, 1e-3, 100_000)
    change = np.linalg.norm(angular_momentum(bodies) - momentum)
    assert change <= 1e-12 * np.linalg.norm(momentum)
    assert energy(bodies) == pytest.approx(start, rel=1e-12)


@each_body
@pytest.mark.parametrize("h", [1e-4, 1e-2, 0.5])
def test_free_tumbling_follows_the_analytic_precession_at_any_step(name: str, h: float) -> None:
    """R(t) = exp(t L / I_t) R(0) exp(t (1 - I_a/I_t)(w.d) e_z).

    Tolerance: the rounding of one step times their number, and of the angle |w| t itself.
    """
    bodies = body(name, (3.0, 2.0, 10.0))
    steps = 200
    time = h * steps
    first, w = rotation(bodies), bodies.angular_velocity[0].copy()
    d = integrator.symmetry_axes(bodies)[0]
    own = (1.0 - bodies.axial_inertia[0] / bodies.inertia[0]) * (w @ d)
    precession = angular_momentum(bodies) / bodies.inertia[0]
    exact = (
        Rotation.from_rotvec(time * precession)
        * first
        * Rotation.from_rotvec([0.0, 0.0, time * own])
    )
    turn_freely(bodies, h, steps)
    error = (rotation(bodies) * exact.inv()).magnitude()
    # Errors of w, eps a step, act for the rest of the time.
    assert error <= EPS * (10 * steps + steps * np.linalg.norm(w) * time)
    axis = exact.apply([0.0, 0.0, 1.0])
    expected = precession + own * axis
    np.testing.assert_allclose(bodies.angular_velocity[0], expected, atol=1e-10)


def euler_equations(bodies: Bodies, torque=None):
    """dy/dt of y = (quaternion, body-frame angular velocity); torque(t, R) in the world."""
    moments = np.array([bodies.inertia[0], bodies.inertia[0], bodies.axial_inertia[0]])

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        q, w = y[:4], y[4:]
        # dq/dt = q (0, w) / 2, I dw/dt = I w x w + torque, both in the body
        dq = 0.5 * np.concatenate(([-q[1:] @ w], q[0] * w + np.cross(q[1:], w)))
        couple = np.cross(moments * w, w)
        if torque is not None:
            turned = Rotation.from_quat(np.roll(q, -1))
            couple = couple + turned.inv().apply(torque(t, turned))
        return np.concatenate((dq, couple / moments))

    return derivative


def integrate(bodies: Bodies, time: float, torque=None) -> tuple[Rotation, np.ndarray]:
    """Orientation and world angular velocity after `time`, by an independent method."""
    w = rotation(bodies).inv().apply(bodies.angular_velocity[0])
    start = np.concatenate((bodies.orientation[0], w))
    derivative = euler_equations(bodies, torque)
    solution = solve_ivp(derivative, (0.0, time), start, "DOP853", rtol=1e-12, atol=1e-12)
    turned = Rotation.from_quat(np.roll(solution.y[:4, -1], -1))
    return turned, turned.apply(solution.y[4:, -1])


@pytest.mark.parametrize("name", ["rod", "prolate", "oblate"])
def test_free_tumbling_agrees_with_eulers_equations(name: str) -> None:
    """Against a Runge-Kutta method of order 8 with relative tolerance 1e-12 over 3 turns."""
    bodies = body(name, (3.0, 2.0, 10.0))
    turned, spin = integrate(bodies, 2.0)
    turn_freely(bodies, 0.25, 8)
    assert (rotation(bodies) * turned.inv()).magnitude() <= 1e-9
    np.testing.assert_allclose(bodies.angular_velocity[0], spin, atol=1e-8)


def test_spheres_among_other_bodies_move_as_they_do_alone() -> None:
    """To the bit: which rank holds a rod must not change a sphere elsewhere."""
    shape, radius, half_length = BODIES["rod"]
    rng = np.random.default_rng(4)
    arrays = {
        "gid": np.arange(21),
        "material": np.zeros(21, int),
        "radius": np.full(21, radius),
        "shape": np.array([SPHERE] * 20 + [shape]),
        "half_length": np.array([0.0] * 20 + [half_length]),
        "position": rng.normal(size=(21, 3)),
        "velocity": rng.normal(size=(21, 3)),
        "angular_velocity": 10.0 ** rng.uniform(-9, 4, (21, 1)) * rng.normal(size=(21, 3)),
    }
    mixed = Bodies.from_arrays(arrays, [1000.0])
    alone = mixed.take(np.arange(20))
    for bodies in (mixed, alone):
        for _ in range(10):
            spin = bodies.angular_velocity.copy()
            integrator.advance(bodies, bodies.velocity.copy(), spin, 1e-2, True, 1)
    for field, values in alone.arrays().items():
        assert values.tobytes() == getattr(mixed, field)[:20].tobytes(), field


@pytest.mark.parametrize("name", ["spherocylinder", "spheroid"])
@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_a_run_without_contacts_is_free_tumbling(name: str, mu: float) -> None:
    """The whole step, with gravity: bodies turn also in scenes without friction."""
    group = {
        "shape": name,
        "aspect_ratio": 2.5,
        "material": "m",
        "count": 1,
        "radius": 0.01,
        "axis": [1.0, 2.0, 2.0],
        "angular_velocity": [3.0, 2.0, 10.0],
        "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}},
    }
    alone = Parallel.alone()
    scenario = scene(step=1e-3, end=1.0, mu=mu, bodies=[group])
    simulation = Simulation(alone, scenario, placed(alone, scenario))
    bodies = simulation.state.bodies
    np.testing.assert_allclose(integrator.symmetry_axes(bodies)[0], [1 / 3, 2 / 3, 2 / 3])
    momentum, (turned, spin) = angular_momentum(bodies), integrate(bodies, 0.1)
    for _ in range(100):
        simulation.step()
    bodies = simulation.state.bodies
    assert (rotation(bodies) * turned.inv()).magnitude() <= 1e-10
    np.testing.assert_allclose(bodies.angular_velocity[0], spin, atol=1e-9)
    np.testing.assert_allclose(angular_momentum(bodies), momentum, rtol=1e-12)


# ---- under a torque ------------------------------------------------------------------------


def driven(name: str, h: float, time: float, couple: float) -> float:
    """Error [rad] of the orientation under the torque couple (d x e_x) (1 + sin 5t), by kicks."""
    bodies = body(name, (3.0, 2.0, 10.0))
    couple *= bodies.inertia[0]

    def torque(t: float, turned: Rotation) -> np.ndarray:
        d = turned.apply([0.0, 0.0, 1.0])
        return couple * (1.0 + np.sin(5.0 * t)) * np.cross(d, [1.0, 0.0, 0.0])

    turned, _ = integrate(bodies, time, torque)
    for k in range(round(time / h)):
        d = integrator.symmetry_axes(bodies)[0]
        kick = h * torque(k * h, rotation(bodies))
        # w+ = w + I^-1 kick with I^-1 = (1 - dd')/I_t + dd'/I_a at the start of the step
        spin = bodies.angular_velocity[0] + (kick - (kick @ d) * d) / bodies.inertia[0]
        spin = spin + (kick @ d) * d / bodies.axial_inertia[0]
        integrator.advance(bodies, bodies.velocity.copy(), spin[None], h, True, 1)
    return float((rotation(bodies) * turned.inv()).magnitude())


@pytest.mark.parametrize("name", ["rod", "prolate", "oblate"])
def test_torques_act_at_first_order_in_the_step(name: str) -> None:
    """A body pulled towards a direction, with a torque that also depends on time."""
    steps = (4e-3, 2e-3, 1e-3, 5e-4)
    errors = [driven(name, h, 0.6, 40.0) for h in steps]
    assert observed_order(steps, errors) == pytest.approx(1.0, abs=0.05)
