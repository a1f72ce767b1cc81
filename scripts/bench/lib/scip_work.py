"""What the ranks of scip.py do: solve the cone problem of one state by one method.

A task is a dictionary: `state` a checkpoint; `solver` with `start`, `law` and `scip` (keys of that
section of a scene), or `rival`; `tolerances`, one cold solve each, `runs` times; `kind` of the
criterion; `reference` a file of body velocities to compare with, `save` one to write.

The criterion "both" asks for r_d <= tau and r_c <= tau gamma_ref: the dual residual alone is met
by impulses that are too large, and by all iterates of some methods.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from contact import load
from numpy.typing import NDArray

from dem_mpi.cone import ConeProblem, Residuals, Tolerance, evaluate
from dem_mpi.errors import DemError
from dem_mpi.metrics import peak_memory, resident_memory
from dem_mpi.parallel import Parallel
from dem_mpi.simulation import Simulation
from dem_mpi.solvers.choice import SolverOptions, make_solver
from dem_mpi.solvers.result import SolveReport

RADIUS = 0.01  # m, of all spheres: turns a spin into the speed of a surface
DECADES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)


def work(parallel: Parallel, task: dict[str, Any]) -> dict[str, Any]:
    """Collective. Do a task; a failure for the user's eyes is part of the result."""
    simulation = load(parallel, Path(task["state"]), task.get("operator", "matrix_free"))
    problem, guess = simulation.pose()
    found: dict[str, Any] = {
        "spheres": parallel.sum(len(simulation.state.bodies)),
        "contacts": parallel.sum(problem.contacts),
        "v_ref": problem.velocity_scale,
        "gamma_ref": problem.impulse_scale,
        "rows": [],
    }
    try:
        for tolerance in task["tolerances"]:
            method = _rival if "rival" in task else _ours
            found["rows"].append(method(simulation, problem, guess, tolerance, task))
    except DemError as error:
        found["failure"] = str(error)
    simulation.destroy()
    return found


@dataclass(frozen=True)
class Velocities:
    """Velocities of all bodies after the impulses, rows in the order of gid; rank 0 has them.

    u : (n, 6 or 3), M^-1 D gamma
    """

    u: NDArray

    @classmethod
    def of(cls, simulation: Simulation, problem: ConeProblem, impulse: NDArray) -> Velocities:
        """Collective. Those that an impulse (m, columns) gives."""
        bodies, parallel = simulation.state.bodies, problem.parallel
        own = problem.operator.body_velocity(impulse)[: len(bodies)]
        parts = parallel.gather((np.array(bodies.gid), np.array(own)))
        if parts is None:
            return cls(np.zeros((0, own.shape[1])))
        gid = np.concatenate([part[0] for part in parts])
        return cls(np.concatenate([part[1] for part in parts])[np.argsort(gid)])

    def error(self, reference: NDArray) -> float:
        """Largest difference of a body's velocity or surface speed [m/s]."""
        difference = self.u - reference
        parts = [np.linalg.norm(difference[:, :3], axis=1)]
        if difference.shape[1] == 6:
            parts.append(RADIUS * np.linalg.norm(difference[:, 3:], axis=1))
        return float(np.max(parts, initial=0.0))


# ---- this program --------------------------------------------------------------------------


def _ours(
    simulation: Simulation,
    problem: ConeProblem,
    guess: NDArray,
    tolerance: float,
    task: dict[str, Any],
) -> dict[str, Any]:
    """Collective. Solve to one tolerance some times with solvers made anew; one row."""
    parallel, seconds, memory = problem.parallel, [], 0
    stop = criterion(problem, tolerance, task.get("kind", "both"))
    options = _options(task, stop)
    for _ in range(task.get("runs", 1)):
        solver, before = make_solver(options), resident_memory()
        stop.seen.clear()
        parallel.barrier()
        began = perf_counter()
        report = solver.solve(problem, guess * (task.get("start", "cold") == "warm"))
        seconds.append(parallel.max(perf_counter() - began))
        memory = max(memory, parallel.sum(max(peak_memory() - before, 0)))
        solver.destroy()
    row = {
        "tolerance": tolerance,
        "seconds": statistics.median(seconds),
        "all_seconds": seconds,
        "phases": {k: parallel.max(v) for k, v in sorted(report.seconds.items())},
        "iterations": report.iterations,
        "products": report.products,
        "factorisations": report.factorisations,
        "outer": report.outer,
        "converged": report.converged,
        "reason": report.reason,
        "form": report.form,
        "factor_entries": report.factor_entries,
        "linear_residual": report.linear_residual,
        "refinements": report.refinements,
        "memory": memory,
        "to": {},
        **_residuals(report.residuals),
    }
    if task.get("law", "ccp") == "ccp":
        row["to"] = iterations_to(report, problem, stop.seen)
    return row | _velocities(simulation, problem, report.impulse, task)


@dataclass(frozen=True)
class Watching(Tolerance):
    """A tolerance that notes S. De's measure of each iterate that is put before it."""

    seen: list[float] = field(default_factory=list)

    def merit(self, residuals: Residuals, problem: ConeProblem) -> float:
        self.seen.append(residuals.thesis)
        return super().merit(residuals, problem)


def criterion(problem: ConeProblem, value: float, kind: str) -> Watching:
    """When a solve stops: "both" residuals below value, or S. De's measure, "thesis"."""
    if kind == "thesis":
        return Watching(value, kind="thesis")
    return Watching(value, relative_work=value / problem.velocity_scale)


def iterations_to(
    report: SolveReport, problem: ConeProblem, seen: list[float]
) -> dict[str, dict[str, int]]:
    """Iterations after which r_d alone, or both residuals, were first below each decade.

    S. De's measure too, where the solver put every iterate before the tolerance.
    """
    iteration, dual, work = report.history[:, :3].T
    measures = {"dual": dual, "both": np.maximum(dual, work / problem.impulse_scale)}
    if len(iteration) <= len(seen) <= len(iteration) + 1:  # once more for the result
        measures["thesis"] = np.array(seen[: len(iteration)])
    found: dict[str, dict[str, int]] = {name: {} for name in measures}
    for name, residual in measures.items():
        for decade in DECADES:
            reached = np.flatnonzero(residual <= decade)
            if len(reached):
                found[name][f"{decade:.0e}"] = int(iteration[reached[0]])
    return found


def _options(task: dict[str, Any], tolerance: Tolerance) -> SolverOptions:
    plain = SolverOptions()
    return SolverOptions(
        solver=task["solver"],
        law=task.get("law", "ccp"),
        tolerance=tolerance,
        max_iterations=task.get("max_iterations", 50_000),
        scip=type(plain.scip)(**task.get("scip", {})),
    )


def _residuals(residuals: Residuals) -> dict[str, float]:
    return {
        "r_p": residuals.primal,
        "r_d": residuals.dual,
        "r_c": residuals.complementarity,
        "thesis": residuals.thesis,
        "objective": residuals.objective,
    }


def _velocities(
    simulation: Simulation, problem: ConeProblem, impulse: NDArray, task: dict[str, Any]
) -> dict[str, float]:
    """Collective. Save the bodies' velocities, or compare them with saved ones, if asked for."""
    if not (task.get("save") or task.get("reference")):
        return {}
    found = Velocities.of(simulation, problem, impulse)
    if problem.parallel.rank:
        return {}
    if task.get("save"):
        np.save(task["save"], found.u)
        return {}
    return {"velocity_error": found.error(np.load(task["reference"]))}


# ---- rivals --------------------------------------------------------------------------------


def _rival(
    simulation: Simulation,
    problem: ConeProblem,
    guess: NDArray,
    tolerance: float,
    task: dict[str, Any],
) -> dict[str, Any]:
    """Solve by another program, one rank alone; residuals are ours, by a product of ours."""
    from lib import rivals

    operator = problem.operator
    D = matrix_of(operator.d_transposed).T.tocsc()
    M_inv = matrix_of(operator.inverse_mass)
    before, seconds = resident_memory(), []
    for _ in range(task.get("runs", 1)):
        if task["rival"] == "clarabel":
            solved = rivals.clarabel_solve(D, M_inv, problem.b, problem.mu, tolerance)
        else:
            N = (D.T @ M_inv @ D).tocsc()
            solved = rivals.siconos_nsgs(N, problem.b, problem.mu, tolerance)
        seconds.append(solved.seconds)
    g = np.empty_like(solved.impulse)
    impulse = np.ascontiguousarray(solved.impulse)
    operator.apply(impulse, g)
    g += problem.b
    law = law_residuals if task.get("law") == "coulomb" else evaluate
    row = {
        "tolerance": tolerance,
        "seconds": statistics.median(seconds),
        "all_seconds": seconds,
        "phases": {"prepare": solved.prepared},
        "iterations": solved.iterations,
        "converged": solved.converged,
        "reason": solved.status,
        "memory": max(peak_memory() - before, 0),
        **_residuals(law(problem, impulse, g)),
    }
    return row | _velocities(simulation, problem, impulse, task)


def law_residuals(problem: ConeProblem, impulse: NDArray, velocity: NDArray) -> Residuals:
    """Collective. Residuals of Coulomb's law: those of the cone problem for g + mu |g_t| n."""
    bias = problem.mu * np.hypot(velocity[:, 1], velocity[:, 2])
    closed = velocity.copy()
    closed[:, 0] += bias
    return evaluate(problem, impulse, closed)


def matrix_of(petsc_matrix: Any) -> Any:
    """Return a PETSc matrix of one rank as one of scipy."""
    from scipy import sparse

    indptr, indices, values = petsc_matrix.getValuesCSR()
    return sparse.csr_matrix((values, indices, indptr), shape=petsc_matrix.getSize())
