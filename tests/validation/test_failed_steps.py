"""Steps that cannot be trusted: flagged, shrunk or refused, with the state before them kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dem_mpi import checkpoint
from dem_mpi.cone import ConeProblem
from dem_mpi.parallel import Parallel
from dem_mpi.runner import RunOptions, run
from dem_mpi.signals import StopRequest
from dem_mpi.simulation import Simulation, SolverFailureError
from dem_mpi.solvers.apgd import Apgd
from dem_mpi.solvers.result import SolveReport
from dem_mpi.state import restore

from scenes import FLOOR, everybody, load, make_fail, scene, simulation_of

R = 0.1
H = 1e-2


def pair_on_floor(parallel: Parallel | None = None, **contact: object) -> Simulation:
    """Collective. Two spheres on a floor."""
    contact = {"tolerance": 1e-6, **contact}
    scenario = scene(step=H, mu=0.3, walls=[FLOOR], contact=contact)
    return simulation_of(scenario, [[0, 0, R], [0.2, 0, R]], R, parallel=parallel)


def advance(simulation: Simulation, steps: int) -> None:
    for _ in range(steps):
        simulation.step()


def test_a_missed_tolerance_is_flagged_and_counted_and_the_run_goes_on() -> None:
    simulation = pair_on_floor()
    make_fail(simulation, 2, dual=5e-6)
    records = [simulation.step() for _ in range(4)]
    assert [record.converged for record in records] == [False, False, True, True]
    assert records[0].reason == "told to fail"
    assert simulation.state.flagged == 2


def test_a_flagged_step_ends_the_run_beyond_stop_factor_tolerances() -> None:
    """The limit is stop_factor * tolerance: 1e-4 m/s by default here, crossed or not."""
    for dual, stops in ((0.99e-4, False), (1.01e-4, True)):
        simulation = pair_on_floor()
        make_fail(simulation, 1, dual=dual)
        if stops:
            with pytest.raises(SolverFailureError, match="exceeds 100 times the tolerance"):
                simulation.step()
        else:
            simulation.step()
        assert simulation.state.step == int(not stops)


def make_useless(simulation: Simulation) -> None:
    """Let every solve end without an impulse, not converged."""
    solve = simulation._solver.solve

    def failing(*arguments: object) -> SolveReport:
        report = solve(*arguments)
        idle = np.zeros_like(report.impulse)
        return replace(report, impulse=idle, converged=False, reason="told to fail")

    simulation._solver.solve = failing


def make_work(simulation: Simulation, factor: float, reason: str) -> None:
    """Let the next solve end, for `reason`, with a weighted work `factor` times its limit."""
    solve, tolerance = simulation._solver.solve, simulation._tolerance

    def failing(problem: ConeProblem, *arguments: object) -> SolveReport:
        report = solve(problem, *arguments)
        work = factor * tolerance.limits(problem)[1]
        residuals = replace(report.residuals, dual=0.0, weighted_work=work, thesis=factor)
        return replace(report, converged=False, reason=reason, residuals=residuals)

    simulation._solver.solve = failing


def test_stop_factor_heeds_complementarity_where_velocities_are_within_their_cones() -> None:
    """Interior iterates have r_d = 0: only their work tells how far from a solution they are."""
    for factor, stops in ((99.0, False), (101.0, True)):
        simulation = pair_on_floor()
        make_work(simulation, factor, "reached the iteration limit")
        if stops:
            with pytest.raises(SolverFailureError, match="exceeds 100 times the tol") as e:
                simulation.step()
            assert "r_c = " in str(e.value)
            assert "101 times what contact.complementarity allows" in str(e.value)
            assert "worst at the contact of body" in str(e.value)
        else:
            assert not simulation.step().converged


def test_stop_factor_counts_in_the_measure_that_the_scene_chose() -> None:
    """The thesis's residual is compared with the tolerance itself, r_c alone does not count."""
    simulation = pair_on_floor(tolerance_kind="thesis", tolerance=1.0)
    make_work(simulation, 99.0, "too hard")
    assert not simulation.step().converged
    simulation = pair_on_floor(tolerance_kind="thesis", tolerance=0.5)
    make_work(simulation, 51.0, "too hard")
    with pytest.raises(SolverFailureError, match="exceeds 100 times"):
        simulation.step()


@pytest.mark.parametrize(
    ("solver", "reason", "advice", "unwanted"),
    [
        ("apgd", "reached the iteration limit", "Raise contact.max_iterations", "scip.max"),
        ("scip", "reached the iteration limit", "Raise contact.scip.max_iterations", "Loosen"),
        ("scip", "stalled", "Loosen contact.tolerance and contact.complementarity", "Raise"),
        ("scip", "no memory: set contact.scip.linear: cg", r"body -?\d+|wall '\w+'$", "lower time"),
    ],
)
def test_the_remedy_is_that_of_the_reason_and_told_once(solver, reason, advice, unwanted) -> None:
    simulation = pair_on_floor(on_failure="stop", solver=solver)
    make_work(simulation, 2.0, reason)
    with pytest.raises(SolverFailureError, match=advice) as e:
        simulation.step()
    assert unwanted not in str(e.value)


def test_attempts_that_were_thrown_away_count_as_work() -> None:
    """A step that fails twice and is done in three pieces is five solves."""
    plain = pair_on_floor(warm_start=False).step()
    simulation = pair_on_floor(on_failure="shrink_step", warm_start=False)
    make_fail(simulation, 2)
    record = simulation.step()
    assert (record.substeps, record.rejected, record.outer) == (3, 2, 5)
    assert record.iterations >= plain.iterations + 3 and plain.rejected == 0
    assert simulation.step().rejected == 0


def test_on_failure_stop_refuses_the_step_and_keeps_the_state() -> None:
    """Not one bit of the bodies has changed, so that the checkpoint is of the last good state."""
    simulation = pair_on_floor(on_failure="stop")
    simulation.step()
    before = {name: array.copy() for name, array in simulation.state.bodies.arrays().items()}
    make_fail(simulation, 1, dual=2e-6)
    with pytest.raises(SolverFailureError, match=r"step 2: the solver missed its tolerance") as e:
        simulation.step()
    assert e.value.intact
    assert simulation.state.step == 1
    for name, array in simulation.state.bodies.arrays().items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)
    simulation.step()
    assert simulation.state.step == 2


def test_shrink_step_halves_until_it_succeeds_and_covers_the_whole_step() -> None:
    """Free fall in pieces h_i: v = g sum h_i, z by semi-implicit steps of these lengths.

    Three failures in a row give pieces h/8, h/8, h/4, h/2. Tolerance: round-off.
    """
    scenario = scene(step=H, contact={"on_failure": "shrink_step"})
    simulation = simulation_of(scenario, [0, 0, 10], R)
    make_fail(simulation, 3)
    record = simulation.step()
    assert (record.substeps, record.converged, record.step) == (4, True, 1)
    v, z = 0.0, 10.0
    for part in (H / 8, H / 8, H / 4, H / 2):
        v -= 9.81 * part
        z += part * v
    bodies = simulation.state.bodies
    assert bodies.velocity[0, 2] == pytest.approx(v, abs=1e-15)
    assert bodies.position[0, 2] == pytest.approx(z, abs=1e-14)


def test_shrink_step_scales_remembered_impulses_with_the_step() -> None:
    """At rest the impulse is m g h: after a shrink the guess m g h_i solves at once."""
    simulation = pair_on_floor(on_failure="shrink_step")
    for _ in range(50):
        last = simulation.step()
    assert last.iterations == 0
    make_fail(simulation, 1)
    record = simulation.step()
    assert record.substeps == 2
    assert record.iterations == 0
    assert simulation.step().iterations == 0


def test_shrink_step_gives_up_at_a_sixty_fourth() -> None:
    simulation = pair_on_floor(on_failure="shrink_step")
    make_fail(simulation, 10**6)
    with pytest.raises(SolverFailureError, match="missed its tolerance"):
        simulation.step()
    assert simulation.state.memory_step == 0.0


@pytest.mark.mpi(ranks=[1, 3])
@pytest.mark.parametrize("array", ["position", "velocity", "angular_velocity"])
def test_a_value_that_is_no_number_stops_every_rank_naming_body_and_step(
    parallel: Parallel, array: str
) -> None:
    """The NaN is on one rank; all ranks raise the same message."""
    scenario = scene(step=H, mu=0.3, walls=[FLOOR])
    position = [[0.5 * k, 0, R] for k in range(6)]
    simulation = simulation_of(scenario, position, R, parallel=parallel)
    simulation.step()
    bodies = simulation.state.bodies
    getattr(bodies, array)[bodies.gid == 4, 1] = np.nan
    with pytest.raises(SolverFailureError, match=r"^step 2: .* of body 4 is not finite$"):
        simulation.step()
    assert simulation.state.step == 1


@pytest.mark.mpi(ranks=[2])
def test_the_state_before_a_failed_step_is_in_the_newest_checkpoint(
    parallel: Parallel, shared_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The solve of step 6 gives one contact of the last rank an impulse that is no number.

    All ranks raise; step 5 is saved, finite, and a run can go on from it.
    """
    grid = {"min": [0, 0, 0], "max": [0.6, 0.6, 0.2]}
    loaded = load(
        step=H,
        end=0.1,
        bodies=[{"material": "m", "count": 6, "radius": R, "placement": {"jittered_grid": grid}}],
        walls=[FLOOR],
        checkpoint={"interval": 0.1},
    )
    solve, calls = Apgd.solve, []

    def poisoned(self: Apgd, *arguments) -> SolveReport:
        report = solve(self, *arguments)
        calls.append(1)
        if len(calls) == 6 and parallel.rank == parallel.size - 1:
            report.impulse[0] = np.nan
        return report

    monkeypatch.setattr(Apgd, "solve", poisoned)
    options = RunOptions(shared_path)
    with pytest.raises(
        SolverFailureError, match=r"^step 6: the new velocity of body \d is not fin"
    ):
        run(parallel, loaded, options, StopRequest(), lambda line: None)
    found = checkpoint.find(parallel, shared_path, "run")
    state, _ = restore(parallel, found.path)
    assert state.step == 5
    assert np.isfinite(everybody(parallel, state).velocity).all()
    run(parallel, loaded, replace(options, resume=True), StopRequest(), lambda line: None)
    assert len(calls) == 11


def test_an_overlap_that_runs_away_stops_the_run() -> None:
    """A solver that does nothing lets spheres fall through one another: stopped at half a radius.

    Overlap that the scene started with is no runaway.
    """
    contact = {"tolerance": 1e9, "complementarity": 1e9, "warm_start": False}
    scenario = scene(step=H, walls=[FLOOR], contact=contact)
    simulation = simulation_of(scenario, [[0, 0, R]], R, velocity=[0, 0, -1])
    with pytest.raises(SolverFailureError, match=r"body 0 with wall 'floor'") as e:
        advance(simulation, 20)
    assert not e.value.intact
    depth = R - simulation.state.bodies.position[0, 2]
    assert 0.5 * R < depth < 0.8 * R

    assert "missed their tolerance" not in str(e.value)

    scenario = scene(step=H, walls=[FLOOR], contact={"max_iterations": 1, "stop_factor": 1e9})
    simulation = simulation_of(scenario, [[0, 0, R]], R, velocity=[0, 0, -1])
    make_useless(simulation)
    with pytest.raises(SolverFailureError, match=r"\d+ of \d+ steps before it missed their tol"):
        advance(simulation, 20)

    deep = simulation_of(scene(step=H, gravity=(0, 0, 0)), [[0, 0, 0], [0.05, 0, 0]], R)
    assert deep.step().overlap == pytest.approx(1.5)
    assert deep.step().overlap < 1.5
