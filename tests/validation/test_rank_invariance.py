"""One state, any number of ranks: the same contacts, the same velocities within the tolerance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dem_mpi.bodies import Bodies
from dem_mpi.parallel import Parallel
from dem_mpi.runner import RunOptions, run
from dem_mpi.scenario import Scenario
from dem_mpi.signals import StopRequest
from dem_mpi.simulation import Simulation, redistribute
from dem_mpi.solvers.apgd import Apgd, ApgdOptions
from dem_mpi.state import State, restore, save

from scenes import everybody, load, placed, scene, touching

every_rank_count = pytest.mark.mpi(ranks=[1, 2, 3, 8])
TOLERANCE = 1e-4  # [m/s]


def falling_spheres(seed: int = 1) -> Scenario:
    """Sixty unequal spheres thrown into a box, in contact from the first steps on."""
    grid = {"min": [0, 0, 0], "max": [0.1, 0.1, 0.14], "jitter": 0.8}
    group = {
        "material": "m",
        "count": 60,
        "radius": {"uniform": [0.008, 0.012]},
        "placement": {"jittered_grid": grid},
        "velocity": [0, 0, -0.5],
        "velocity_jitter": 0.3,
    }
    walls = [
        {"shape": "box", "material": "m", "open": ["z_max"], "min": [0, 0, 0], "max": [0.1, 0.1, 1]}
    ]
    contact = {"tolerance": TOLERANCE, "complementarity": 1e-3}
    return scene(step=2e-3, mu=0.3, seed=seed, bodies=[group], walls=walls, contact=contact)


def keep(parallel: Parallel, state: State, directory: Path) -> Path:
    """Collective. Store a state."""
    directory.mkdir(exist_ok=True)
    parallel.barrier()
    return save(parallel, state, directory, "state", {}, "test", keep=1, time=0.0)


def stored_after(scenario: Scenario, steps: int, directory: Path, parallel: Parallel) -> Path:
    """Collective. A state that rank 0 alone has computed and stored."""
    path = None
    if parallel.rank == 0:
        alone = Parallel.alone()
        simulation = Simulation(alone, scenario, placed(alone, scenario))
        for _ in range(steps):
            simulation.step()
        path = keep(alone, simulation.state, directory)
    return parallel.broadcast(path)


def resumed(parallel: Parallel, scenario: Scenario, path: Path) -> Simulation:
    """Collective. A stored state on these ranks, listed anew on any of them."""
    state, _ = restore(parallel, path)
    return Simulation(parallel, scenario, redistribute(parallel, state))


def one_step(
    parallel: Parallel, scenario: Scenario, path: Path, solver: Apgd | None = None
) -> tuple[Bodies, np.ndarray, float]:
    """Collective. All bodies and contacts one step after a stored state, and v_ref."""
    simulation = resumed(parallel, scenario, path)
    if solver is not None:
        simulation._solver = solver
    v_ref = simulation.step().v_ref
    return everybody(parallel, simulation.state), touching(parallel, simulation.state), v_ref


def on_one_rank(parallel: Parallel, *arguments) -> tuple[Bodies, np.ndarray, float]:
    """Collective. `one_step` by rank 0 alone, told to all."""
    mine = one_step(Parallel.alone(), *arguments) if parallel.rank == 0 else None
    return parallel.broadcast(mine)


@every_rank_count
def test_one_state_has_the_same_contacts_and_velocities_on_any_ranks(
    parallel: Parallel, shared_path: Path
) -> None:
    """Contact sets are identical; at tolerance eps velocities differ by at most 10 eps."""
    scenario = falling_spheres()
    path = stored_after(scenario, 30, shared_path / "one", parallel)
    bodies, contacts, _ = one_step(parallel, scenario, path)
    expected, expected_contacts, _ = on_one_rank(parallel, scenario, path)
    assert len(expected_contacts) > 80
    np.testing.assert_array_equal(contacts, expected_contacts)
    spread = np.abs(bodies.velocity - expected.velocity).max()
    rim = np.abs(bodies.angular_velocity - expected.angular_velocity).max(axis=1) * bodies.radius
    assert max(spread, rim.max()) <= 10 * TOLERANCE


@every_rank_count
def test_a_fixed_number_of_iterations_differs_by_round_off_only(
    parallel: Parallel, shared_path: Path
) -> None:
    """50 iterations without restart, one state: sums in another order change 1e-12 of v_ref."""
    scenario = falling_spheres()
    path = stored_after(scenario, 30, shared_path / "fixed", parallel)
    options = ApgdOptions(max_iterations=50, fixed_iterations=True, restart=False)
    scenario = scenario.model_copy(
        update={"contact": scenario.contact.model_copy(update={"stop_factor": 1e9})}
    )
    bodies, _, v_ref = one_step(parallel, scenario, path, Apgd(options))
    expected, _, _ = on_one_rank(parallel, scenario, path, Apgd(options))
    assert np.abs(bodies.velocity - expected.velocity).max() <= 1e-12 * v_ref


@every_rank_count
def test_a_state_computed_on_several_ranks_goes_on_alike_on_one(
    parallel: Parallel, shared_path: Path
) -> None:
    """Thirty steps on P ranks, stored by them; the next is taken by P and by one."""
    scenario = falling_spheres(seed=2)
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    for _ in range(30):
        simulation.step()
    path = keep(parallel, simulation.state, shared_path / "many")
    bodies, contacts, _ = one_step(parallel, scenario, path)
    expected, expected_contacts, _ = on_one_rank(parallel, scenario, path)
    assert len(contacts) > 80
    np.testing.assert_array_equal(contacts, expected_contacts)
    assert np.abs(bodies.velocity - expected.velocity).max() <= 10 * TOLERANCE


@every_rank_count
def test_repeating_a_run_gives_the_same_bits(parallel: Parallel) -> None:
    """Ten steps on the same ranks, twice: every array of the bodies is equal bit for bit."""
    scenario = falling_spheres(seed=3)
    ends = []
    for _ in range(2):
        simulation = Simulation(parallel, scenario, placed(parallel, scenario))
        for _ in range(10):
            simulation.step()
        ends.append(everybody(parallel, simulation.state).arrays())
    for name, array in ends[0].items():
        np.testing.assert_array_equal(array, ends[1][name], err_msg=name)


@pytest.mark.mpi(ranks=[8])
def test_more_ranks_than_bodies_with_output_and_checkpoints(
    parallel: Parallel, shared_path: Path
) -> None:
    """Three spheres on eight ranks: every frame and checkpoint is there, and the floor is reached.

    Centre heights lie within r_d a step of the radius.
    """
    grid = {"min": [0, 0, 0], "max": [0.6, 0.2, 0.25]}
    loaded = load(
        step=1e-2,
        end=0.2,
        mu=0.3,
        bodies=[{"material": "m", "count": 3, "radius": 0.1, "placement": {"jittered_grid": grid}}],
        walls=[{"shape": "plane", "material": "m", "point": [0, 0, 0], "normal": [0, 0, 1]}],
        output={"interval": 0.02},
        checkpoint={"interval": 0.05, "keep": 2},
    )
    run(parallel, loaded, RunOptions(shared_path), StopRequest(), lambda line: None)
    import h5py

    if parallel.rank == 0:
        with h5py.File(shared_path / "run.h5", "r") as file:
            points = file["VTKHDF/Points"][:]
            assert file["VTKHDF/Steps"].attrs["NSteps"] == 11
        assert points.shape == (33, 3)
        np.testing.assert_allclose(points[-3:, 2], 0.1, rtol=0, atol=20 * 1e-2 * 1e-4)
    state, _ = restore(parallel, sorted(shared_path.glob("*checkpoint*.h5"))[-1])
    assert parallel.sum(len(state.bodies)) == 3
