"""A column of a hundred spheres at rest in a tube one body wide: no creep, no buckling."""

from __future__ import annotations

import pytest

from dem_mpi.simulation import Simulation

from scenes import scene, simulation_of

R = 0.01
H = 1e-3
R_D = 1e-4  # [m/s] dual residual, the default tolerance: h r_d is the overlap a step may add
COUNT = 100


def column_in_tube(mu: float) -> Simulation:
    """Spheres on one another on the axis of a square tube with 1e-3 r of clearance all round."""
    half = R * 1.001
    tube = {"shape": "box", "material": "m", "open": ["z_max"]}
    tube |= {"min": [-half, -half, 0], "max": [half, half, 3 * COUNT * R]}
    scenario = scene(step=H, mu=mu, walls=[tube], contact={"tolerance": R_D})
    return simulation_of(scenario, [[0, 0, R * (1 + 2 * k)] for k in range(COUNT)], R)


def drift(simulation: Simulation, first: int, last: int) -> float:
    """Largest change of the top's height between two steps [m]."""
    top, height, largest = COUNT - 1, 0.0, 0.0
    for step in range(1, last + 1):
        record = simulation.step()
        assert record.converged
        bodies = simulation.state.bodies
        now = float(bodies.position[bodies.gid == top, 2][0])
        if step == first:
            height = now
        elif step > first:
            largest = max(largest, abs(now - height))
        # On the axis nothing pushes sideways: not even by one rounding error.
        assert not bodies.position[:, :2].any()
    return largest


@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_a_column_in_a_tube_does_not_creep(mu: float) -> None:
    """The top stays within 10 h r_d between steps 100 and 500, though 400 solves may each add
    h r_d of overlap at every one of 100 contacts."""
    assert drift(column_in_tube(mu), 100, 500) <= 10 * H * R_D


@pytest.mark.long
@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_a_column_in_a_tube_does_not_creep_in_ten_thousand_steps(mu: float) -> None:
    """Within 10 h r_d in total between steps 10^3 and 10^4."""
    assert drift(column_in_tube(mu), 1000, 10000) <= 10 * H * R_D
