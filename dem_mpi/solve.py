"""`dem-mpi solve`: the contact problem of an FCLIB file, solved and reported.

The problem solved is the cone complementarity problem of `cone`, the convex relaxation of what
FCLIB states: gamma in C, g = W gamma + q in C*, gamma.g = 0, without the term mu |u_t| that FCLIB
adds to the normal velocity. Both agree where no contact slides. A W that is not symmetric is taken
as it is: gamma then minimises nothing, but the residuals say how well it solves the problem.

Scales for the stop test, as in a simulation: v_ref = max_i |q_i| [m/s] (1 m/s if q = 0) and
gamma_ref = v_ref / median(diag W) [N s].
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dem_mpi import __version__
from dem_mpi.cone import (
    ConeProblem,
    Delassus,
    Residuals,
    Tolerance,
    evaluate,
    largest_of_ranks,
    median_of_positive,
)
from dem_mpi.errors import DemError, InputError
from dem_mpi.fclib import COLUMNS, FclibProblem, read_problem
from dem_mpi.fclib_output import refuse_existing, write_result
from dem_mpi.parallel import Parallel
from dem_mpi.signals import StopRequest
from dem_mpi.solvers.apgd import Apgd, ApgdOptions
from dem_mpi.solvers.result import SolveReport

if TYPE_CHECKING:
    from dem_mpi.sparse_delassus import FactoredDelassus, MatrixDelassus

ToleranceKind = Literal["scaled", "absolute", "thesis"]
NOT_CONVERGED = DemError.exit_code


@dataclass(frozen=True)
class SolveOptions:
    """What the command line asks for.

    guess : "solution" or the number of a guess of the file to start from; None starts from zero
    out   : file to write; force : replace it if it exists
    """

    tolerance: Tolerance = field(default_factory=lambda: Tolerance(1e-6, "scaled", 1e-6))
    max_iterations: int = 100_000
    guess: str | None = None
    out: Path | None = None
    force: bool = False


def parse_options(
    tolerance: float,
    kind: str,
    complementarity: float,
    max_iterations: int,
    guess: str | None,
    out: Path | None,
    force: bool,
) -> SolveOptions:
    """Return the options of a command line; raises InputError for a value that breaks a rule."""
    for flag, value in (("--tolerance", tolerance), ("--complementarity", complementarity)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{flag} {value:g}: must be > 0 and finite")
    kinds = get_args(ToleranceKind)
    if kind not in kinds:
        raise InputError(f"--tolerance-kind {kind}: must be one of {', '.join(kinds)}")
    if guess is not None and guess != "solution" and not (guess.isdecimal() and int(guess) > 0):
        raise InputError(f"--guess {guess}: must be 'solution' or the number of a guess, from 1")
    rule = Tolerance(tolerance, kind, complementarity)
    return SolveOptions(rule, max_iterations, guess, out, force)


@dataclass(frozen=True)
class ThesisResiduals:
    """S. De's own three residuals (thesis 2021, 2.35-2.37), of contacts with mu > 0 where it says.

    primal max(0, |gamma_t| - mu gamma_n); dual max(0, |g_t| - g_n / mu), mu > 0;
    complementarity |sum gamma.g| / contacts.
    """

    primal: float
    dual: float
    complementarity: float


def solve_file(
    parallel: Parallel, path: Path, options: SolveOptions, say: Callable[[str], None]
) -> int:
    """Collective. Solve the problem of a file and print what came out; returns the exit code.

    0 if the tolerance holds, 70 if not: the result is then printed all the same.
    """
    if options.out is not None:
        refuse_existing(parallel, options.out, options.force)
    compile_kernels(parallel)
    started = perf_counter()
    problem = read_problem(parallel, path, options.guess)
    operator = _operator(problem, parallel)
    cone = cone_problem(operator, operator.offset, problem.mu, parallel)
    prepared = perf_counter() - started
    try:
        for line in _problem_lines(problem, operator.description, cone, options):
            say(line)
        report = Apgd(
            ApgdOptions(tolerance=options.tolerance, max_iterations=options.max_iterations)
        ).solve(cone, _guess(problem, options.guess))
        for line in _report_lines(report, cone, prepared):
            say(line)
        if not operator.symmetric:
            say(_asymmetry_line(problem.form, operator.asymmetry))
        for line in _stored_lines(problem, cone, report):
            say(line)
        if options.out is not None:
            say(_write(parallel, options.out, problem, operator, report))
    finally:
        operator.destroy()
    return 0 if report.converged else NOT_CONVERGED


def cone_problem(operator: Delassus, q: NDArray, mu: NDArray, parallel: Parallel) -> ConeProblem:
    """Collective. The problem with the scales of the stop test; q (m, 3) [m/s], mu (m,)."""
    v_ref = parallel.max(float(np.sqrt(np.max(np.sum(q * q, axis=1), initial=0.0)))) or 1.0
    diagonal = operator.diagonal()
    gamma_ref = v_ref / median_of_positive(diagonal[diagonal > 0.0], parallel)
    return ConeProblem(operator, q, mu, v_ref, gamma_ref, parallel)


def thesis_residuals(report: SolveReport, cone: ConeProblem) -> ThesisResiduals:
    """Collective. The residuals by which S. De's tables were made, of the reported impulse."""
    gamma, g, mu = report.impulse, report.velocity, cone.mu
    rough = mu > 0.0
    slip = np.linalg.norm(g[rough, 1:], axis=1) - g[rough, 0] / mu[rough]
    outside = np.linalg.norm(gamma[:, 1:], axis=1) - mu * gamma[:, 0]
    largest = np.array([outside.max(initial=0.0), slip.max(initial=0.0)])
    largest_of_ranks(largest, cone.parallel)
    total = cone.parallel.sum(np.array([float((gamma * g).sum()), float(cone.contacts)]))
    return ThesisResiduals(
        float(largest[0]), float(largest[1]), float(abs(total[0]) / max(total[1], 1.0))
    )


def end_on_signals(stop: StopRequest) -> None:
    """Let a signal end the process, also one that came while the program started."""
    for number in (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    if stop.requested:
        signal.raise_signal(signal.Signals[stop.name])


def _operator(problem: FclibProblem, parallel: Parallel) -> MatrixDelassus | FactoredDelassus:
    # Loaded here: PETSc starts on all ranks together.
    from dem_mpi.sparse_delassus import FactoredDelassus, MatrixDelassus

    kind = MatrixDelassus if problem.form == "local" else FactoredDelassus
    return kind(problem, parallel)


def _guess(problem: FclibProblem, name: str | None) -> NDArray:
    """The stored impulses of that name; zero where there is none, or they are all zero."""
    if name not in problem.stored:
        return np.zeros((problem.contacts.count, COLUMNS))
    return problem.stored[name].copy()  # the solver works in it; the stored one is compared later


def _write(
    parallel: Parallel,
    out: Path,
    problem: FclibProblem,
    operator: MatrixDelassus | FactoredDelassus,
    report: SolveReport,
) -> str:
    """Collective. Write the result; returns a line that says so."""
    vectors = {"r": report.impulse, "u": report.velocity}
    if problem.form == "global":
        vectors["v"] = operator.body_velocity(report.impulse)
    attributes = {
        "program": f"dem-mpi {__version__}",
        "model": "convex cone complementarity problem",
        "converged": int(report.converged),
        "iterations": report.iterations,
        "dual_residual": report.residuals.dual,
        "complementarity_residual": report.residuals.complementarity,
        "objective": report.residuals.objective,
    }
    group = write_result(parallel, out, problem, vectors, report.converged, attributes)
    return f"wrote {out}: the problem with {', '.join(sorted(vectors))} in '{group}'"


# ---- text ----------------------------------------------------------------------------------


def _problem_lines(
    problem: FclibProblem, matrices: str, cone: ConeProblem, options: SolveOptions
) -> list[str]:
    title = problem.info.get("title", "")
    ranks = cone.parallel.size
    start = "zero" if options.guess is None else f"the stored {_name(options.guess)}"
    if options.guess in problem.empty:
        start += ", which is zero"
    rule = options.tolerance
    if rule.kind == "thesis":
        limits = f"thesis residuals <= {rule.value:g}"
    else:
        value = rule.value * (cone.velocity_scale if rule.kind == "scaled" else 1.0)
        work = rule.relative_work * cone.velocity_scale * cone.impulse_scale
        limits = f"dual <= {value:.3e} m/s ({rule.kind}), complementarity <= {work:.3e} J"
    return [
        f"{problem.path.name}{f' ({title})' if title else ''}: {problem.form} problem, "
        f"{problem.contacts.total} contacts, {problem.rows} rows, {matrices}, "
        f"{ranks} rank{'s' if ranks > 1 else ''}",
        f"scales: v_ref = {cone.velocity_scale:.3e} m/s, gamma_ref = {cone.impulse_scale:.3e} N s",
        f"start: {start}; stop: {limits}, or {options.max_iterations} iterations",
    ]


def _report_lines(report: SolveReport, cone: ConeProblem, prepared: float) -> list[str]:
    r, thesis = report.residuals, thesis_residuals(report, cone)
    v, gamma = cone.velocity_scale, cone.impulse_scale
    outcome = "converged" if report.converged else f"NOT CONVERGED: {report.reason}"
    return [
        f"{outcome}: {report.iterations} iterations, {report.products} products with W, "
        f"{report.seconds['solve']:.3g} s (reading and set-up {prepared:.3g} s)",
        f"  primal           {r.primal:.3e} N s  (/ gamma_ref        {r.primal / gamma:.3e})",
        f"  dual             {r.dual:.3e} m/s  (/ v_ref            {r.dual / v:.3e})",
        f"  complementarity  {r.complementarity:.3e} J    "
        f"(/ v_ref gamma_ref  {r.complementarity / (v * gamma):.3e})",
        f"  thesis           primal {thesis.primal:.3e}, dual {thesis.dual:.3e}, "
        f"complementarity {thesis.complementarity:.3e} (S. De 2.35-2.37)",
        f"  objective        {r.objective:.12e} J",
    ]


def _asymmetry_line(form: str, asymmetry: float) -> str:
    name = "W" if form == "local" else "M"
    return (
        f"  {name} is not symmetric, |{name}_ij - {name}_ji| is up to {asymmetry:.1e} "
        f"sqrt({name}_ii {name}_jj): solved as stored, the residuals are exact, the objective is "
        "that of its symmetric part"
    )


def _stored_lines(problem: FclibProblem, cone: ConeProblem, report: SolveReport) -> list[str]:
    """Collective. How the impulses in the file compare with ours."""
    lines = [f"stored {_name(name)}: r is zero, so there is none" for name in problem.empty]
    for name, impulse in problem.stored.items():
        r = _residuals_of(cone, impulse)
        difference = np.abs(impulse - report.impulse).max(initial=0.0)
        largest = np.array([difference, np.abs(impulse).max(initial=0.0)])
        cone.parallel.max_in_place(largest)
        lines += [
            f"stored {_name(name)}: primal {r.primal:.3e} N s, dual {r.dual:.3e} m/s, "
            f"complementarity {r.complementarity:.3e} J",
            f"  objective        {r.objective:.12e} J, ours is lower by "
            f"{r.objective - report.residuals.objective:.3e}",
            f"  impulses         differ by at most {largest[0]:.3e} N s of {largest[1]:.3e} N s",
        ]
    return lines


def _residuals_of(cone: ConeProblem, impulse: NDArray) -> Residuals:
    velocity = np.empty_like(impulse)
    cone.operator.apply(impulse, velocity)
    velocity += cone.b
    return evaluate(cone, np.ascontiguousarray(impulse), velocity)


def _name(stored: str) -> str:
    return stored if stored == "solution" else f"guess {stored}"


# ---- compilation ---------------------------------------------------------------------------


class _Unit:
    """W = 1 for one contact."""

    def apply(self, impulse: NDArray, out: NDArray) -> None:
        out[:] = impulse

    def diagonal(self) -> NDArray:
        return np.ones((1, COLUMNS))


def compile_kernels(parallel: Parallel) -> None:
    """Collective. Compile the solver's kernels on rank 0, then load them on the others.

    Ranks that compiled at the same time would race for numba's cache on disk.
    """
    error = None
    for turn in (True, False):
        if (parallel.rank == 0) == turn:
            try:
                alone = Parallel.alone()
                falling = cone_problem(_Unit(), np.array([[-1.0, 1.0, 0.0]]), np.ones(1), alone)
                Apgd().solve(falling, np.zeros((1, COLUMNS)))
                alone.free()
            except Exception as caught:
                error = caught
        parallel.raise_together(error)
