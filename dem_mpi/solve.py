"""`dem-mpi solve`: the contact problem of an FCLIB file, solved and reported.

Two laws: `coulomb` is what FCLIB states, gamma in C and g + (mu |g_t|, 0, 0) in C* orthogonal to
each other, g = W gamma + q; `ccp` is its convex relaxation without the term mu |g_t|, the cone
complementarity problem of `cone`. Both agree where no contact slides. A W that is not symmetric is
taken as it is: gamma then minimises nothing, but the residuals say how well it solves the problem.

Scales for the stop test, as in a simulation: v_ref = max_i |q_i| [m/s] (1 m/s if q = 0) and
gamma_ref = v_ref / median(diag W) [N s].
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

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
from dem_mpi.fclib import COLUMNS, FclibProblem, Share, read_problem
from dem_mpi.fclib_output import refuse_existing, write_result
from dem_mpi.parallel import Parallel
from dem_mpi.scene_models import Scip as ScipSection
from dem_mpi.signals import StopRequest
from dem_mpi.solvers.choice import SolverOptions, make_solver
from dem_mpi.solvers.coulomb import law_residuals
from dem_mpi.solvers.result import SolveReport

if TYPE_CHECKING:
    from dem_mpi.sparse_delassus import FactoredDelassus, MatrixDelassus

ToleranceKind = Literal["scaled", "absolute", "thesis"]
Method = Literal["apgd", "scip", "auto"]
Law = Literal["ccp", "coulomb"]
Form = Literal["auto", "velocity", "contact"]
Linear = Literal["mumps", "cg"]
LAWS = {"ccp": "convex cone complementarity problem", "coulomb": "Coulomb's law"}
NOT_CONVERGED = DemError.exit_code


@dataclass(frozen=True)
class SolveOptions:
    """What the command line asks for.

    solver, law, form, linear : as in the contact section of a scene
    max_iterations    : of apgd for a cone problem; newton_iterations : of scip
    max_outer : cone problems under Coulomb's law
    guess : "solution" or the number of a guess of the file to start from; None starts from zero
    out   : file to write; force : replace it if it exists
    """

    tolerance: Tolerance = field(default_factory=lambda: Tolerance(1e-6, "scaled", 1e-6))
    max_iterations: int = 100_000
    guess: str | None = None
    out: Path | None = None
    force: bool = False
    solver: Method = "apgd"
    law: Law = "ccp"
    newton_iterations: int = 60
    max_outer: int = 100
    form: Form = "auto"
    linear: Linear = "mumps"

    @property
    def choice(self) -> SolverOptions:
        """What makes the solver."""
        section = ScipSection(
            max_iterations=self.newton_iterations, form=self.form, linear=self.linear
        )
        return SolverOptions(
            self.solver,
            self.law,
            self.tolerance,
            self.max_iterations,
            scip=section,
            max_outer=self.max_outer,
        )


def parse_options(
    tolerance: float, kind: str, complementarity: float, options: SolveOptions
) -> SolveOptions:
    """Return `options` of a command line with its tolerance, all checked.

    Raises InputError for a value that breaks a rule.
    """
    for flag, value in (("--tolerance", tolerance), ("--complementarity", complementarity)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{flag} {value:g}: must be > 0 and finite")
    words = {
        "--tolerance-kind": (kind, ToleranceKind),
        "--solver": (options.solver, Method),
        "--law": (options.law, Law),
        "--form": (options.form, Form),
        "--linear": (options.linear, Linear),
    }
    for flag, (value, known) in words.items():
        if value not in get_args(known):
            raise InputError(f"{flag} {value}: must be one of {', '.join(get_args(known))}")
    if options.linear == "cg" and options.form == "contact":
        raise InputError("--linear cg: solves for velocities of bodies, not with --form contact")
    guess = options.guess
    if guess is not None and guess != "solution" and not (guess.isdecimal() and int(guess) > 0):
        raise InputError(f"--guess {guess}: must be 'solution' or the number of a guess, from 1")
    return replace(options, tolerance=Tolerance(tolerance, kind, complementarity))


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
    compile_kernels(parallel, options.choice)
    started = perf_counter()
    problem = read_problem(parallel, path, options.guess)
    if options.form == "velocity" and problem.form == "local":
        raise InputError("--form velocity: a local problem has no M and H, it needs contact")
    if options.linear == "cg" and problem.form == "local":
        raise InputError("--linear cg: a local problem has no M and H, it needs mumps")
    operator = _operator(problem, parallel)
    if options.linear == "cg" and not operator.symmetric:
        operator.destroy()
        raise InputError("--linear cg: M is not symmetric in this problem, it needs mumps")
    cone = cone_problem(operator, operator.offset, problem.mu, parallel)
    prepared = perf_counter() - started
    solver = make_solver(options.choice)
    try:
        for line in _problem_lines(problem, operator.description, cone, options):
            say(line)
        report = solver.solve(cone, _guess(problem, options.guess))
        for line in _report_lines(report, cone, options.solver, options.law, prepared):
            say(line)
        if not operator.symmetric:
            say(_asymmetry_line(problem.form, operator.asymmetry))
        for line in _stored_lines(problem, cone, options.law, report):
            say(line)
        if options.out is not None:
            say(_write(parallel, options.out, problem, operator, options.law, report))
    finally:
        solver.destroy()
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
    law: Law,
    report: SolveReport,
) -> str:
    """Collective. Write the result; returns a line that says so."""
    vectors = {"r": report.impulse, "u": report.velocity}
    if problem.form == "global":
        vectors["v"] = operator.body_velocity(report.impulse)
    attributes = {
        "program": f"dem-mpi {__version__}",
        "model": LAWS[law],
        "solver": report.solver,
        "converged": int(report.converged),
        "iterations": report.iterations,
        "cone_problems": report.outer,
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
    most = {
        "apgd": f"{options.max_iterations} iterations",
        "scip": f"{options.newton_iterations} Newton iterations",
    }
    if options.solver == "auto":
        limit = f"{most['apgd']} of apgd and {most['scip']} of scip"
    else:
        limit = most[options.solver]
    if options.law == "coulomb":
        limit += f" for each of {options.max_outer} cone problems"
    return [
        f"{problem.path.name}{f' ({title})' if title else ''}: {problem.form} problem, "
        f"{problem.contacts.total} contacts, {problem.rows} rows, {matrices}, "
        f"{ranks} rank{'s' if ranks > 1 else ''}",
        f"law: {LAWS[options.law]}; solver: {options.solver}",
        f"scales: v_ref = {cone.velocity_scale:.3e} m/s, gamma_ref = {cone.impulse_scale:.3e} N s",
        f"start: {start}; stop: {limits}, or {limit}",
    ]


def _report_lines(
    report: SolveReport, cone: ConeProblem, solver: str, law: Law, prepared: float
) -> list[str]:
    """Collective. What the solver asked for did, and the residuals of the law it was made for."""
    r = report.residuals
    v, gamma = cone.velocity_scale, cone.impulse_scale
    outcome = "converged" if report.converged else f"NOT CONVERGED: {report.reason}"
    kind = "Newton iterations" if solver == "scip" else "iterations"
    if solver != "scip" and report.factorisations:
        kind += f" ({report.factorisations} of them Newton's)"
    plural = "s" if report.outer > 1 else ""
    rounds = f" in {report.outer} cone problem{plural}" if law == "coulomb" else ""
    if report.converged and not report.iterations:
        outcome = "converged: the start meets the tolerance"
    lines = [
        f"{outcome}: {report.iterations} {kind}{rounds}, {report.products} products with W, "
        f"{report.seconds['solve']:.3g} s (reading and set-up {prepared:.3g} s)",
        f"  primal           {r.primal:.3e} N s  (/ gamma_ref        {r.primal / gamma:.3e})",
        f"  dual             {r.dual:.3e} m/s  (/ v_ref            {r.dual / v:.3e})",
        f"  complementarity  {r.complementarity:.3e} J    "
        f"(/ v_ref gamma_ref  {r.complementarity / (v * gamma):.3e})",
    ]
    if law == "ccp":
        thesis = thesis_residuals(report, cone)
        lines.append(
            f"  thesis           primal {thesis.primal:.3e}, dual {thesis.dual:.3e}, "
            f"complementarity {thesis.complementarity:.3e} (S. De 2.35-2.37)"
        )
    lines.append(f"  objective        {r.objective:.12e} J")
    if report.factorisations:
        entries = f" of {report.factor_entries} entries" if report.factor_entries else ""
        several = "s" if report.factorisations > 1 else ""
        lines.append(
            f"  linear systems   {report.form} form, {report.factorisations} "
            f"factorisation{several}{entries}, residual <= {report.linear_residual:.1e} after "
            f"{report.refinements} refinements"
        )
        if report.linear_iterations:
            lines.append(f"  conj. gradients  {report.linear_iterations} iterations in all")
    return lines


def _asymmetry_line(form: str, asymmetry: float) -> str:
    name = "W" if form == "local" else "M"
    return (
        f"  {name} is not symmetric, |{name}_ij - {name}_ji| is up to {asymmetry:.1e} "
        f"sqrt({name}_ii {name}_jj): solved as stored, the residuals are exact, the objective is "
        "that of its symmetric part"
    )


def _stored_lines(
    problem: FclibProblem, cone: ConeProblem, law: Law, report: SolveReport
) -> list[str]:
    """Collective. How the impulses in the file compare with ours, under the law that we solved."""
    lines = [f"stored {_name(name)}: r is zero, so there is none" for name in problem.empty]
    for name, impulse in problem.stored.items():
        velocity, r = _judged(cone, law, impulse)
        largest = np.array(
            [
                np.abs(impulse - report.impulse).max(initial=0.0),
                np.abs(impulse).max(initial=0.0),
                np.abs(velocity - report.velocity).max(initial=0.0),
            ]
        )
        cone.parallel.max_in_place(largest)
        lower = r.objective - report.residuals.objective
        # Only the relaxation makes the objective as small as it can be.
        word = "higher" if lower < 0.0 else "lower"
        compared = f", ours is {word} by {abs(lower):.3e}" if law == "ccp" else ""
        lines += [
            f"stored {_name(name)}: primal {r.primal:.3e} N s, dual {r.dual:.3e} m/s, "
            f"complementarity {r.complementarity:.3e} J",
            f"  objective        {r.objective:.12e} J{compared}",
            f"  impulses         differ by at most {largest[0]:.3e} N s of {largest[1]:.3e} N s",
            f"  velocities       differ by at most {largest[2]:.3e} m/s",
        ]
    return lines


def _judged(cone: ConeProblem, law: Law, impulse: NDArray) -> tuple[NDArray, Residuals]:
    """Collective. g = N impulse + b of an impulse that somebody else made, and its residuals."""
    impulse = np.ascontiguousarray(impulse)
    velocity = np.empty_like(impulse)
    cone.operator.apply(impulse, velocity)
    velocity += cone.b
    judge = law_residuals if law == "coulomb" else evaluate
    return velocity, judge(cone, impulse, velocity)


def _name(stored: str) -> str:
    return stored if stored == "solution" else f"guess {stored}"


# ---- compilation ---------------------------------------------------------------------------


def compile_kernels(parallel: Parallel, options: SolverOptions) -> None:
    """Collective. Compile the solver's kernels on rank 0, then load them on the others.

    Ranks that compiled at the same time would race for numba's cache on disk.
    """
    # PETSc starts on all ranks together.
    import petsc4py.PETSc  # noqa: F401

    error = None
    for turn in (True, False):
        if (parallel.rank == 0) == turn:
            try:
                alone = Parallel.alone()
                _solve_one_contact(alone, options)
                alone.free()
            except Exception as caught:
                error = caught
        parallel.raise_together(error)


def _solve_one_contact(alone: Parallel, options: SolverOptions) -> None:
    """Solve for a point of 1 kg that comes down sliding, W = 1."""
    problem = FclibProblem(
        path=Path("one contact"),
        form="local",
        dimension=COLUMNS,
        contacts=Share.of(1, alone),
        mu=np.ones(1),
        offset=np.array([[-1.0, 1.0, 0.0]]),
        delassus=sparse.identity(COLUMNS, format="csr"),
    )
    operator = _operator(problem, alone)
    section = options.scip.model_copy(update={"form": "auto"})  # W alone has no velocity form
    solver = make_solver(replace(options, scip=section))
    solver.solve(cone_problem(operator, operator.offset, problem.mu, alone), np.zeros((1, COLUMNS)))
    solver.destroy()
    operator.destroy()
