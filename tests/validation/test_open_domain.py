"""Bodies that leave: the domain, their rank, or altogether."""

from __future__ import annotations

import numpy as np
import pytest

from dem_mpi.parallel import Parallel
from dem_mpi.simulation import Simulation

from scenes import everybody, scene, simulation_of, touching

some_ranks = pytest.mark.mpi(ranks=[1, 3])
WEIGHTLESS = (0.0, 0.0, 0.0)


def fleeing(parallel: Parallel, on_leave: str) -> Simulation:
    """Collective. Ten spheres on a line, 0.2 apart, at 1 m/s towards the end of the domain."""
    domain = {"min": [-1, -1, -1], "max": [2.05, 1, 1], "on_leave": on_leave}
    scenario = scene(step=0.1, mu=0.3, gravity=WEIGHTLESS, domain=domain)
    position = [[0.2 * k, 0, 0] for k in range(10)]
    return simulation_of(scenario, position, 0.05, velocity=[1.0, 0, 0], parallel=parallel)


@some_ranks
def test_bodies_that_leave_are_counted(parallel: Parallel) -> None:
    """on_leave: keep reports those outside in each step and goes on with all: x = 0.2 k + t."""
    simulation = fleeing(parallel, "keep")
    for step in range(1, 30):
        record = simulation.step()
        beyond = sum(0.2 * k + 0.1 * step > 2.05 for k in range(10))
        assert (record.outside, record.bodies) == (beyond, 10)


@some_ranks
def test_bodies_that_leave_are_removed_if_asked_and_the_run_goes_on_without_any(
    parallel: Parallel,
) -> None:
    """on_leave: remove counts each body once; with none left the steps still count time."""
    simulation = fleeing(parallel, "remove")
    for step in range(1, 30):
        record = simulation.step()
        gone = sum(0.2 * k + 0.1 * step > 2.05 for k in range(10))
        assert record.bodies == 10 - gone
        assert simulation.state.removed == gone
        left = everybody(parallel, simulation.state).gid
        np.testing.assert_array_equal(left, np.arange(10 - gone))
    assert record.bodies == 0
    assert (record.step, record.contacts, record.kinetic_energy) == (29, 0, 0.0)


@some_ranks
def test_removal_takes_a_body_out_of_the_contacts(parallel: Parallel) -> None:
    """A pushes B out of the domain: B's contact and its remembered impulse go with it."""
    domain = {"min": [-1, -1, -1], "max": [0.25, 1, 1], "on_leave": "remove"}
    scenario = scene(step=0.01, gravity=WEIGHTLESS, domain=domain)
    simulation = simulation_of(
        scenario, [[0, 0, 0], [0.1, 0, 0]], 0.05, velocity=[[1, 0, 0], [0, 0, 0]], parallel=parallel
    )
    simulation.step()
    np.testing.assert_array_equal(touching(parallel, simulation.state), [[0, 1]])
    while simulation.state.removed == 0:
        simulation.step()
    assert simulation.step().contacts == 0
    assert everybody(parallel, simulation.state).gid.tolist() == [0]


@pytest.mark.mpi(ranks=[2, 3, 8])
def test_bodies_cross_several_ranks_in_a_step(parallel: Parallel) -> None:
    """A swarm changes places end to end, thousands of radii a step: each body arrives, on the
    rank that owns its place, and still collides there.

    Positions of those that meet nobody are x0 + v t to round-off.
    """
    scenario = scene(step=0.1, mu=0.3, gravity=WEIGHTLESS, contact={"skin": 0.2})
    rng = np.random.default_rng(3)
    count = 40
    position = np.zeros((count, 3))
    position[:, 0] = np.linspace(0.0, 1.0, count)
    position[:, 1] = 0.1 * np.arange(count)
    velocity = np.zeros((count, 3))
    velocity[:, 0] = (1.0 - 2.0 * position[:, 0]) / 0.1
    simulation = simulation_of(
        scenario, position, 1e-3, velocity, rng.uniform(-1, 1, (count, 3)), parallel=parallel
    )
    expected = position.copy()
    moved = 0
    for _ in range(6):
        moved += simulation.step().moved
        expected += 0.1 * velocity
        everyone = everybody(parallel, simulation.state)
        np.testing.assert_array_equal(everyone.gid, np.arange(count))
        np.testing.assert_allclose(everyone.position, expected, rtol=0, atol=1e-13)
        for name in ("position", "velocity"):
            assert np.isfinite(getattr(everyone, name)).all()
    assert moved > 0


@pytest.mark.mpi(ranks=[2, 3])
def test_a_body_that_crosses_all_ranks_meets_the_body_at_the_other_end(parallel: Parallel) -> None:
    """A bullet flies past ten ranks' worth of spheres, a metre a step, into the last: momentum is
    shared as in a head-on impact, 1/2 each, to r_d."""
    scenario = scene(
        step=0.01, gravity=WEIGHTLESS, contact={"tolerance": 1e-9, "complementarity": 1e-12}
    )
    position = [[0, 0, 0]] + [[k, 1.0, 0] for k in range(1, 10)] + [[10, 0, 0]]
    velocity = np.zeros((11, 3))
    velocity[0, 0] = 100.0
    simulation = simulation_of(scenario, position, 0.1, velocity, parallel=parallel)
    for _ in range(15):
        simulation.step()
    bodies = everybody(parallel, simulation.state)
    np.testing.assert_allclose(bodies.velocity[[0, 10], 0], 50.0, rtol=0, atol=1e-7)
    assert not bodies.velocity[1:10].any()
