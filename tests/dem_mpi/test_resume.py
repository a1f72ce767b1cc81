"""A stopped run goes on as if it had never stopped; on other ranks, as close as sums allow."""

from __future__ import annotations

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dem_mpi.bodies import Bodies
from dem_mpi.checkpoint import find
from dem_mpi.errors import InputError
from dem_mpi.parallel import Parallel
from dem_mpi.scenario import restore_scenario
from dem_mpi.simulation import Simulation, redistribute
from dem_mpi.solvers.apgd import Apgd, ApgdOptions
from dem_mpi.state import State, restore

from runs import LEAVING, PILE, checkpoints, contents, differences, metrics, simulate

SCENES = {
    "friction, walls that move, steps that miss": PILE,
    "bodies removed": LEAVING,
    "assembled, gzip": PILE.replace("max_iterations: 25", "max_iterations: 25, operator: assembled")
    .replace("interval: 6e-3", "interval: 6e-3\n  compression: gzip")
    .replace("end: 0.08", "end: 0.03"),
    "half steps": PILE.replace("max_iterations: 25", "max_iterations: 40, on_failure: shrink_step")
    .replace("tolerance: 1e-3", "tolerance: 2e-2")
    .replace("end: 0.08", "end: 0.03"),
}


# ---- the same number of ranks -----------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2, 3])
@pytest.mark.parametrize("scene", SCENES)
def test_a_run_stopped_again_and_again_equals_the_uninterrupted_one(parallel, shared_path, scene):
    """Stopped after every step; on three ranks after every fourth, to save time."""
    stride = 1 if parallel.size < 3 else 4
    lines = _run_whole_and_in_parts(parallel, SCENES[scene], shared_path, stride)
    if scene in list(SCENES)[:2]:
        _assert_all_moments_were_met(lines, scene, parallel.size)


def _run_whole_and_in_parts(
    parallel: Parallel, scene: str, directory: Path, stride: int
) -> list[dict]:
    """Collective. Assert that both end with the same bits; return the lines of metrics."""
    whole, parts = directory / "whole", directory / "parts"
    simulate(parallel, scene, whole)
    said = simulate(parallel, scene, parts, steps=stride)
    while "stopped by SIGUSR1" in said[-1]:
        said = simulate(parallel, scene, parts, resume=True, steps=stride)
    parallel.barrier()
    different = differences(whole, parts) if parallel.rank == 0 else []
    lines = metrics(whole)
    parallel.barrier()
    assert different == []
    return lines


SHORT = PILE.replace("end: 0.08", "end: 0.06")


@pytest.mark.mpi(ranks=[1])
@pytest.mark.parametrize("form", ["velocity", "contact"])
def test_with_the_interior_point_method_too_on_one_rank(parallel, shared_path, form):
    """What it knows of a contact graph that stands makes no difference to the bits; on several
    ranks MUMPS itself adds up in an order that depends on the messages."""
    tight = f"solver: scip, scip: {{form: {form}}}, tolerance: 1e-7, complementarity: 1e-6"
    scene = SHORT.replace("tolerance: 1e-3, complementarity: 1e-2", tight)
    lines = _run_whole_and_in_parts(parallel, scene, shared_path, 1)
    assert {line["solver"] for line in lines if line["factorisations"]} == {"scip"}
    assert any(line["rebuilt"] for line in lines[1:])


@pytest.mark.mpi(ranks=[1])
def test_with_a_solver_chosen_in_every_step_too_on_one_rank(parallel, shared_path):
    scene = SHORT.replace("contact: {", "contact: {solver: auto, ")
    scene = scene.replace("tolerance: 1e-3, complementarity: 1e-2, max_iterations: 25",
                          "tolerance: 1e-6, complementarity: 1e-5, max_iterations: 30")  # fmt: skip
    lines = _run_whole_and_in_parts(parallel, scene, shared_path, 1)
    assert {line["solver"] for line in lines} == {"apgd", "scip"}


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_under_coulombs_law_too_with_gradients(parallel, shared_path):
    scene = SHORT.replace("contact: {", "contact: {law: coulomb, ")
    lines = _run_whole_and_in_parts(parallel, scene, shared_path, 1 if parallel.size < 3 else 4)
    assert max(line["outer"] for line in lines) > 1


def _assert_all_moments_were_met(lines: list[dict], scene: str, ranks: int) -> None:
    """The scenes hold what makes resuming hard: otherwise the comparison shows little."""
    assert any(line["rebuilt"] for line in lines[1:])
    assert any(not a["rebuilt"] and not b["rebuilt"] for a, b in pairwise(lines))
    assert ranks == 1 or any(line["moved"] for line in lines[1:])
    if scene == "bodies removed":
        assert 0 < lines[-1]["bodies"] < lines[0]["bodies"]
    else:
        assert any(not line["converged"] for line in lines)


@pytest.mark.mpi(ranks=[2], timeout=30)
def test_resuming_a_finished_run_changes_nothing(parallel, shared_path):
    simulate(parallel, LEAVING, shared_path, "time.end=0.02")
    if parallel.rank == 0:
        shutil.copytree(shared_path, shared_path / "before")
    parallel.barrier()
    simulate(parallel, LEAVING, shared_path, "time.end=0.02", resume=True)
    if parallel.rank == 0:
        assert differences(shared_path / "before", shared_path) == []
    parallel.barrier()


@pytest.mark.mpi(ranks=[2], timeout=30)
def test_resuming_where_nothing_is_starts_from_the_beginning_and_says_so(parallel, shared_path):
    said = simulate(parallel, LEAVING, shared_path, "time.end=0.02", resume=True)
    assert "no checkpoint" in said[0] and "from the beginning" in said[0]
    assert metrics(shared_path)[-1]["step"] == 5


# ---- another number of ranks ------------------------------------------------------------------


@pytest.fixture
def stopped(parallel: Parallel, shared_path: Path) -> Path:
    """A directory with the checkpoint of a pile in full contact, saved on two ranks."""
    two = Parallel(parallel.communicator.Split(int(parallel.rank >= 2), parallel.rank))
    if parallel.rank < 2:
        simulate(two, PILE, shared_path, "output.interval=2e-3", steps=30)
    parallel.barrier()
    return shared_path


def by_gid(parallel: Parallel, bodies: Bodies) -> dict[str, np.ndarray]:
    """All bodies in the order of gid; small scenes only."""
    parts = parallel.gather(bodies.arrays())
    if parts is None:
        return {}
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {name: values[np.argsort(joined["gid"])] for name, values in joined.items()}


def load(parallel: Parallel, directory: Path) -> tuple[State, dict]:
    state, scene = restore(parallel, find(parallel, directory, "run").path)
    if state.partition.ranks != parallel.size:
        state = redistribute(parallel, state)
    return state, scene


def one_step(parallel: Parallel, directory: Path, solver: Apgd | None, **contact) -> tuple:
    """The velocities after one step from the checkpoint, the reference speed, the record."""
    state, scene = load(parallel, directory)
    scene["contact"].update(contact)
    simulation = Simulation(parallel, restore_scenario(scene), state)
    if solver is not None:
        simulation._solver = solver
    record = simulation.step()
    return by_gid(parallel, simulation.state.bodies), record


def on_two_and_here(parallel: Parallel, directory: Path, solver: Apgd | None = None, **contact):
    """One step on the two ranks that saved the state, and one on all ranks; rank 0 gets both."""
    two = Parallel(parallel.communicator.Split(int(parallel.rank >= 2), parallel.rank))
    saved = None
    if parallel.rank < 2 and parallel.size >= 2:
        saved = one_step(two, directory, solver, **contact)
    return saved, one_step(parallel, directory, solver, **contact)


def largest_difference(one: dict, other: dict) -> float:
    """Over all bodies, of velocity [m/s] and of angular velocity times radius [m/s]."""
    linear = np.abs(one["velocity"] - other["velocity"]).max()
    spin = np.abs(one["angular_velocity"] - other["angular_velocity"])
    return max(linear, (spin * one["radius"][:, None]).max())


@pytest.mark.mpi(ranks=[3])
def test_a_step_of_fixed_iterations_hardly_knows_the_number_of_ranks(parallel, stopped):
    """50 iterations without restart take no decisions; sums over ranks differ in their last bits,
    which 50 iterations of a contraction leave below 1e-12 v_ref."""
    fixed = Apgd(ApgdOptions(max_iterations=50, fixed_iterations=True, restart=False))
    saved, here = on_two_and_here(parallel, stopped, fixed)
    if parallel.rank == 0:
        (two, record), (three, of_three) = saved, here
        alone, of_one = one_step(Parallel.alone(), stopped, fixed)
        assert record.contacts == of_three.contacts == of_one.contacts > 80
        assert largest_difference(two, three) <= 1e-12 * record.v_ref
        assert largest_difference(two, alone) <= 1e-12 * record.v_ref
    parallel.barrier()


@pytest.mark.mpi(ranks=[3])
def test_a_step_at_tolerance_agrees_to_ten_times_it_on_any_ranks(parallel, stopped):
    contact = {"tolerance": 1e-4, "complementarity": 1e-6, "max_iterations": 20000}
    saved, here = on_two_and_here(parallel, stopped, **contact)
    if parallel.rank == 0:
        (two, record), (three, of_three) = saved, here
        alone, of_one = one_step(Parallel.alone(), stopped, None, **contact)
        assert record.converged and of_three.converged and of_one.converged
        assert largest_difference(two, three) <= 10 * 1e-4
        assert largest_difference(two, alone) <= 10 * 1e-4
    parallel.barrier()


@pytest.mark.mpi(ranks=[3])
def test_no_rank_ever_holds_all_bodies_on_the_way_to_other_ranks(parallel, stopped):
    path = find(parallel, stopped, "run").path
    sent = parallel.bytes_sent
    state, _ = restore(parallel, path)
    assert len(state.bodies) == 20  # of 60, on three ranks
    assert parallel.bytes_sent == sent
    state = redistribute(parallel, state)
    assert parallel.sum(len(state.bodies)) == 60
    # Divided by bodies + contacts, as a running simulation does.
    load = parallel.allgather(np.array([len(state.bodies) + state.memory.offsets[-1]]))
    assert load.max() <= 1.2 * load.mean()


@pytest.mark.mpi(ranks=[3])
def test_a_run_goes_on_to_its_end_on_other_ranks_and_on_more_ranks_than_bodies(
    parallel, shared_path
):
    small = ("bodies.0.count=2", "time.end=0.02", "output.interval=2e-3")
    simulate(Parallel.alone(), PILE, shared_path / f"alone{parallel.rank}", *small, steps=4)
    said = simulate(parallel, PILE, shared_path / "alone0", *small, resume=True)
    assert "resuming from run.checkpoint.000000004.h5, step 4" in said[0]
    if parallel.rank == 0:
        assert [line["step"] for line in metrics(shared_path / "alone0")] == list(range(1, 11))
        found = contents(shared_path / "alone0" / "run.h5")
        assert found["VTKHDF/Steps/Values"][1] == (11,)
        assert found["/@complete"] == 1
    parallel.barrier()


# ---- a changed scene --------------------------------------------------------------------------


def test_a_changed_scene_is_shown_and_refused_unless_forced(parallel, tmp_path):
    simulate(parallel, LEAVING, tmp_path, "time.end=0.04", steps=3)
    kept = contents(tmp_path / "run.h5")
    changes = ("time.end=0.02", "contact.tolerance=2e-3")
    with pytest.raises(InputError) as refused:
        simulate(parallel, LEAVING, tmp_path, *changes, resume=True)
    assert "time.end: 0.04 -> 0.02" in str(refused.value)
    assert "contact.tolerance: 0.001 -> 0.002" in str(refused.value)
    assert refused.value.exit_code == 64
    assert contents(tmp_path / "run.h5") == kept

    said = simulate(parallel, LEAVING, tmp_path, *changes, resume=True, force=True)
    assert "contact.tolerance: 0.001 -> 0.002" in "\n".join(said)
    assert metrics(tmp_path)[-1]["step"] == 5


# ---- what stands in the way of a new run ------------------------------------------------------


def test_a_new_run_replaces_neither_trajectory_nor_checkpoints_unless_forced(parallel, tmp_path):
    end = "time.end=0.02"
    simulate(parallel, LEAVING, tmp_path, end)
    with pytest.raises(InputError, match=r"run\.h5 exists: --resume .* --force"):
        simulate(parallel, LEAVING, tmp_path, end)
    (tmp_path / "run.h5").unlink()
    with pytest.raises(InputError, match=r"checkpoint\.\d+\.h5 exists: --resume"):
        simulate(parallel, LEAVING, tmp_path, end)
    simulate(parallel, LEAVING, tmp_path, end, force=True)
    assert contents(tmp_path / "run.h5")["/@complete"] == 1


def test_a_finished_trajectory_without_checkpoints_is_not_begun_again(parallel, tmp_path):
    end = "time.end=0.02"
    simulate(parallel, LEAVING, tmp_path, end)
    for path in checkpoints(tmp_path):
        path.unlink()
    kept = contents(tmp_path / "run.h5")
    with pytest.raises(InputError, match="is complete and has no checkpoint"):
        simulate(parallel, LEAVING, tmp_path, end, resume=True)
    assert contents(tmp_path / "run.h5") == kept
