"""Primal-dual interior point method on symmetric cones for the cone complementarity problem.

Nesterov-Todd scaling, predictor and corrector of Mehrotra, centrality correctors of Gondzio,
infeasible start (S. De, thesis 2021, 2.3.2, with a scaling that keeps the system symmetric). An
iteration costs one factorisation, and a few solves and products with N.

x = T gamma and y = T^-1 g with T = diag(1, 1/mu, 1/mu) are in the cone {x_n >= |x_t|}; the central
path x_i o y_i = target e, on which gamma_i.g_i = target, leads to the solution as target -> 0. x,
and so gamma, is strictly inside its cone at every iterate. y is an unknown of its own: what parts
it from T^-1 (N gamma + b) falls by 1 - alpha with every step alpha. Without friction a cone is the
half-line x_n >= 0, by the same formulas.

Where N is singular the Newton system becomes so too: sticking contacts add R ~ target to it. A
proximal term, |gamma - last gamma|^2, keeps N + R away from that without changing the solution
(M. Friedlander, D. Orban, Math. Program. Comput. 4, 2012). Close to the end, below what tolerances
of a simulation ask for, Newton's method on the natural map takes over if it converges: there the
velocities of an interior point are off by the root of target (see `semismooth`).

Symbols: lambda, W, u, v, c, s as in `_kernels_scip`; mu-hat, here `mean`, is x.y per contact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_scip as kernels
from dem_mpi._kernels_solver import CHUNK, project
from dem_mpi.cone import ConeProblem, Residuals, Tolerance, evaluate, largest_of_ranks
from dem_mpi.newton import LinearSolve, NewtonFailureError, NewtonOptions, NewtonSystem
from dem_mpi.parallel import Parallel
from dem_mpi.solvers.result import SolveReport
from dem_mpi.solvers.semismooth import NaturalMap, Patience

# The start lies on the central path where x.y is this times the mean squared violation over N_nn:
# impulses of force chains are an order larger than those that stop single bodies.
_START = 100.0
# Centrality correctors: what they aim at beyond the step there is, and the products x o y, over
# their target, that they leave as they are.
_LONGER = 0.3
_BAND = (0.1, 10.0)
_WORTHWHILE = 1.01  # a corrector that does not lengthen the step by this factor is the last
# A direction is refined until what it leaves of its equation, in units of the scaled point, is this
# part; later iterations need it, as the condition of W grows with 1/mean.
_MISFIT = 1e-3
_REFINEMENTS = 4
_LINEAR, _CORRECTION = 1e-9, 1e-3  # relative residuals asked of a solve, and of a refinement's
_SOUND = 1e-8  # the relative residual above which a step on the natural map is not taken
_POOR_STEP = 0.05  # below it the direction of plain centring is tried instead
_TINY_STEP = 1e-4
# Short steps, while this part of the first residual is left, tell that impulses are far larger than
# those of the start: begin again, this much higher on the central path.
_SHORT_STEP, _UNTOUCHED, _HIGHER, _RESTARTS = 0.2, 0.1, 1e4, 4
# The proximal term over N_nn. Larger ones keep more digits of the Newton systems in the
# velocities, and make the way longer where impulses are not unique.
_PROXIMAL = 1e-10
# The largest gamma.g over v_ref gamma_ref at which Newton's method is tried, and the part of it at
# which it is tried again; the mismatch over v_ref up to which it is tried when all else has failed.
_CLOSE, _CLOSER, _NEAR = 1e-10, 1e-3, 1e-4
_HALF = 0.5  # that close, x.y falls at least by this from one iteration to the next, or it stalls
# Where gamma.g is round-off, of impulses far above gamma_ref, a point is the better one if its
# mismatch is this part of the other's, though gamma.g be larger by the second factor.
_TENTH, _TENFOLD = 0.1, 10.0
_NO_FURTHER = (
    "rounding lets it go no further, or bodies are jammed so that no finite impulse parts them"
)
_PATIENCE = 5  # tiny steps, or iterations without progress, in a row


class System(Protocol):
    """(N + R) dgamma = s with R block-diagonal: what `NewtonSystem` offers."""

    form: str

    @property
    def factor_entries(self) -> int: ...

    def take(self, operator: Any, mu: NDArray) -> bool: ...

    def factor(self, Q: NDArray, R: NDArray, root: NDArray) -> None: ...

    def solve(self, s: NDArray, out: NDArray, tolerance: float = ...) -> LinearSolve: ...

    def destroy(self) -> None: ...


@dataclass(frozen=True)
class ScipOptions:
    """Options of `Scip`.

    max_iterations : factorisations
    correctors     : largest number of centrality correctors an iteration; each costs a solve, so
                     that conjugate gradients, where solves are what costs, do without
    """

    tolerance: Tolerance = field(default_factory=Tolerance)
    max_iterations: int = 60
    newton: NewtonOptions = field(default_factory=NewtonOptions)
    correctors: int = 3


class Scip:
    """Solves a `ConeProblem` by an interior point method; keeps its Newton system for the next."""

    def __init__(
        self,
        options: ScipOptions | None = None,
        make_system: Callable[[Any, NDArray, Parallel, NewtonOptions], System] = NewtonSystem,
    ) -> None:
        self.options = options or ScipOptions()
        self._make_system = make_system
        self._system: System | None = None

    def solve(
        self,
        problem: ConeProblem,
        guess: NDArray,
        lipschitz: float | None = None,
        tolerance: Tolerance | None = None,
    ) -> SolveReport:
        """Collective. Follow the central path from near `guess` (m, columns) [N s].

        `tolerance` takes the place of the one in the options for this problem. Returns the best
        iterate seen, with the reason in words when it did not converge. Rows of the guess that are
        not finite start from zero. The guess is taken over, not copied. `lipschitz` is passed on.
        """
        started = perf_counter()
        run = _Run(problem, tolerance or self.options.tolerance)
        gamma = np.ascontiguousarray(guess, dtype=np.float64)
        gamma[~np.isfinite(gamma).all(axis=1)] = 0.0
        project.using(problem.threads)(gamma, problem.mu)
        reason = "converged"
        run.judge(gamma)
        if run.contacts and not run.best_merit <= 1.0:
            warm = problem.parallel.any(bool(gamma.any()))
            reason = self._attempt(run, gamma, cautious=warm)
            if warm and not run.best_merit <= 1.0 and run.iterations < self.options.max_iterations:
                # From near a solution whose impulses are not unique the way may be barred, where
                # it is open from nothing.
                gamma[:] = 0.0
                run.judge(gamma)
                reason = self._attempt(run, gamma, cautious=False)
            if not run.best_merit <= 1.0:
                self._polish(run, quick=False)
        return run.report(reason, lipschitz, self._system, perf_counter() - started)

    def destroy(self) -> None:
        """Collective. Free the Newton system."""
        if self._system is not None:
            self._system.destroy()
            self._system = None

    def _system_for(self, problem: ConeProblem) -> System:
        """Collective. The Newton system of this problem: the kept one if its graph stands."""
        if self._system is not None and not self._system.take(problem.operator, problem.mu):
            self.destroy()
        if self._system is None:
            self._system = self._make_system(
                problem.operator, problem.mu, problem.parallel, self.options.newton
            )
        return self._system

    def _attempt(self, run: _Run, gamma: NDArray, cautious: bool) -> str:
        """Collective. Follow the path from near `gamma`; return why it ended."""
        try:
            with run.timed("assemble"):
                system = self._system_for(run.problem)
            path = _CentralPath(run.problem, system, run)
            return self._follow(path, run, gamma, cautious)
        except NewtonFailureError as error:
            return str(error)

    def _polish(self, run: _Run, quick: bool) -> None:
        """Collective. Take Newton steps on the natural map from the best iterate so far.

        quick : end with the first step that shows no convergence
        """
        system = self._system
        if system is None or self.options.newton.linear == "cg":
            return
        newton, patience = NaturalMap(run.problem, run.best), Patience(quick)
        run.products += 1
        run.multiply(newton.impulse)
        mismatch = first = least = newton.mismatch(run.g)
        if not mismatch <= _NEAR:
            return
        while run.iterations < self.options.max_iterations and not patience.ends(
            mismatch, newton.rounding
        ):
            run.iterations += 1
            try:
                run.factor(system, newton.blocks(mismatch))
                residual = run.solve(system, newton.rest, newton.change, _LINEAR)
            except NewtonFailureError:
                return
            if not residual <= _SOUND:
                return
            newton.advance()
            run.linear_residual = max(run.linear_residual, residual)
            run.products += 1
            run.judge(newton.impulse)
            mismatch = newton.mismatch(run.g)
            if mismatch < least and mismatch <= _TENTH * first:
                least = mismatch
                run.prefer(newton.impulse, _TENFOLD)
            if run.best_merit <= 1.0:
                return

    def _follow(self, path: _CentralPath, run: _Run, gamma: NDArray, cautious: bool) -> str:
        """Collective. Iterate to the tolerance; return why it ended. `gamma` becomes the iterate.

        `cautious` : give up on short steps, where it would otherwise begin again from higher up.
        Every decision is taken from numbers that are alike on all ranks.
        """
        direct = self.options.newton.linear != "cg"
        correctors = self.options.correctors if direct else 0
        path.start(gamma, run.g)
        tiny, stalled, restarts = 0, 0, 0
        mean, residual, first = math.inf, math.inf, math.inf
        close = again = _CLOSE * run.problem.velocity_scale * run.problem.impulse_scale
        for iteration in count():
            path.impulse(gamma)
            improved = run.judge(gamma)
            if run.best_merit <= 1.0:
                return "converged"
            if not path.rescale(run.g):
                return "not a number in the iteration, or rounding left the cones"
            falling = improved or path.mean < 0.9 * mean or path.residual < 0.9 * residual
            near = path.mean <= close
            if near:
                falling = path.mean < _HALF * mean
            stalled = 0 if falling else stalled + 1
            mean, residual = min(mean, path.mean), min(residual, path.residual)
            if stalled >= _PATIENCE:
                return f"stalled: residuals and complementarity fall no more; {_NO_FURTHER}"
            work = run.history[-1][2]
            if near and work <= again:
                again = _CLOSER * work
                self._polish(run, quick=True)
                if run.best_merit <= 1.0:
                    return "converged"
                run.multiply(gamma)
            if run.iterations >= self.options.max_iterations:
                break
            run.iterations += 1
            step = path.advance(correctors)
            if not math.isfinite(step):
                return "not a number in the Newton step"
            first = path.residual if iteration == 0 else first
            if step < _SHORT_STEP and path.residual > _UNTOUCHED * first and restarts < _RESTARTS:
                if cautious:
                    return f"the steps became too small; {_NO_FURTHER}"
                restarts += 1
                path.start(gamma, run.g, _HIGHER * path.target)
                mean = math.inf
                continue
            tiny = tiny + 1 if step < _TINY_STEP else 0
            if tiny >= _PATIENCE:
                return f"the steps became too small; {_NO_FURTHER}"
        return "reached the iteration limit"


class _Run:
    """What a solve counts, times and keeps: the best iterate by the merit of fresh products."""

    def __init__(self, problem: ConeProblem, tolerance: Tolerance) -> None:
        """Collective."""
        self.problem, self.tolerance = problem, tolerance
        self.contacts = problem.parallel.sum(problem.contacts)
        self.g = np.empty_like(problem.b)
        self.best, self.best_merit = np.zeros_like(problem.b), math.inf
        self.last_merit = math.inf
        self.history: list[tuple[float, ...]] = []
        self.iterations = self.products = self.factorisations = self.refinements = 0
        self.linear_iterations = 0
        self.linear_residual = 0.0
        self.seconds = {"solve": 0.0, "assemble": 0.0, "factor": 0.0, "substitute": 0.0}

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        started = perf_counter()
        try:
            yield
        finally:
            self.seconds[phase] += perf_counter() - started

    def judge(self, gamma: NDArray) -> bool:
        """Collective. g = N gamma + b; note the residuals; whether gamma is the best so far."""
        residuals = self._evaluate(gamma)
        # The first row is the guess; the point that the path starts from gets none.
        if self.iterations >= len(self.history):
            self.history.append(
                (self.iterations, residuals.dual, residuals.weighted_work, residuals.objective)
            )
        merit = self.tolerance.merit(residuals, self.problem) if residuals.finite else math.inf
        self.last_merit = merit
        better = merit < self.best_merit
        if better:
            self.best[:] = gamma
            self.best_merit = merit
        return better

    def prefer(self, gamma: NDArray, factor: float) -> None:
        """Take gamma, judged last, as the best if its merit is less than `factor` times the best's.

        For those who know by another measure that it is; the merit to beat remains.
        """
        if self.last_merit < factor * self.best_merit:
            self.best[:] = gamma

    def multiply(self, gamma: NDArray) -> None:
        """Collective. g = N gamma + b."""
        self.problem.operator.apply(gamma, self.g)
        self.g += self.problem.b
        self.products += 1

    def _evaluate(self, gamma: NDArray) -> Residuals:
        self.multiply(gamma)
        return evaluate(self.problem, gamma, self.g)

    def factor(self, system: System, blocks: list[NDArray]) -> None:
        """Collective. Factorise for the blocks Q, R and the root of Q."""
        with self.timed("factor"):
            system.factor(*blocks)
            self.factorisations += 1

    def solve(self, system: System, s: NDArray, out: NDArray, tolerance: float) -> float:
        """Collective. out = (N + R)^-1 s; return its relative residual."""
        with self.timed("substitute"):
            done = system.solve(s, out, tolerance)
        self.refinements += done.refinements
        self.linear_iterations += done.iterations
        self.products += done.products
        return done.residual

    def report(
        self, reason: str, lipschitz: float | None, system: System | None, seconds: float
    ) -> SolveReport:
        """Collective. The report of the best iterate."""
        project.using(self.problem.threads)(self.best, self.problem.mu)
        final = self._evaluate(self.best)
        converged = final.finite and self.tolerance.merit(final, self.problem) <= 1.0
        used = system if self.factorisations else None
        return SolveReport(
            impulse=self.best,
            velocity=self.g,
            residuals=final,
            iterations=self.iterations,
            products=self.products,
            factorisations=self.factorisations,
            history=np.array(self.history),
            seconds=self.seconds | {"solve": seconds},
            converged=converged,
            reason="converged" if converged else reason,
            lipschitz=lipschitz or 0.0,
            solver="scip",
            form=used.form if used else "",
            factor_entries=used.factor_entries if used else 0,
            linear_residual=self.linear_residual,
            refinements=self.refinements,
            linear_iterations=self.linear_iterations,
        )


class _Direction:
    """A Newton direction: impulse, N times it, and both parts in the scaled space."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.dgamma, self.dg = np.zeros(shape), np.zeros(shape)
        self.u, self.v = np.zeros(shape), np.zeros(shape)
        self.c = np.zeros(shape)
        self.longest = self.residual = 0.0


class _CentralPath:
    """The iterate (x, y) of one solve, and its steps."""

    def __init__(self, problem: ConeProblem, system: System, run: _Run) -> None:
        self._problem, self._system, self._run = problem, system, run
        m, columns = shape = problem.b.shape
        self._x, self._y = np.empty(shape), np.empty(shape)
        self._eta, self._w, self._lam = np.empty(m), np.empty(shape), np.empty(shape)
        self._blocks = [np.zeros((m, columns, columns)) for _ in range(3)]
        self._now, self._trial = _Direction(shape), _Direction(shape)
        self._s, self._correction = np.empty(shape), np.zeros(shape)
        chunks = max(1, math.ceil(m / CHUNK))
        self._partial = [np.zeros(chunks), np.zeros((chunks, 2)), np.zeros((chunks, 3))]
        self._g = run.g
        self._soft = _PROXIMAL * problem.operator.diagonal()[:, 0]
        self.mean = self.residual = self.target = math.inf

    def start(self, gamma: NDArray, g: NDArray, target: float | None = None) -> None:
        """Collective. The point of the central path nearest to gamma (in its cone) and its g.

        target : x.y of a contact [J]; from how far gamma is from a solution if not given
        """
        mu = self._problem.mu
        stiffness = self._problem.operator.diagonal()[:, 0].copy()
        if target is None:
            total = self._kernel(kernels.distance)(gamma, g, mu, stiffness, self._partial[0])
            target = _START * self._problem.parallel.sum(total) / self._run.contacts
        self.target = target
        self._kernel(kernels.centred_start)(gamma, g, mu, stiffness, target, self._x, self._y)

    def impulse(self, gamma: NDArray) -> None:
        """gamma = T^-1 x."""
        self._kernel(kernels.impulse)(self._x, self._problem.mu, gamma)

    def rescale(self, g: NDArray) -> bool:
        """Collective. Scaling at the iterate, whose N gamma + b is g; False if it is no longer one.

        Sets `mean`, x.y per contact [J], and `residual`, max |T^-1 g - y| [m/s].
        """
        parallel = self._problem.parallel
        self._g = g
        gap, outside, residual = self._kernel(kernels.scaling)(
            self._x, self._y, self._problem.mu, g, self._eta, self._w, self._lam, self._partial[2]
        )
        self.mean = parallel.sum(gap) / self._run.contacts
        largest = np.array([residual, outside])
        largest_of_ranks(largest, parallel)
        self.residual = float(largest[0])
        return largest[1] < math.inf and math.isfinite(self.residual) and 0.0 < self.mean < math.inf

    def advance(self, correctors: int) -> float:
        """Collective. Factorise, find a direction, step; return the step, NaN if there is none."""
        run, now = self._run, self._now
        mu = self._problem.mu
        self._kernel(kernels.blocks)(self._eta, self._w, mu, *self._blocks)
        self._kernel(kernels.soften)(self._soft, mu, *self._blocks)
        run.factor(self._system, self._blocks)
        now.c[:] = 0.0
        self._find(now)
        affine = min(1.0, now.longest)
        target = self._target(now, affine)
        self._kernel(kernels.second_order)(self._lam, now.u, now.v, target, now.c)
        self._find(now)
        for _ in range(correctors):
            if not self._corrected(target):
                break
        if now.longest < _POOR_STEP:
            self._centred()
        now = self._now
        step = min(1.0, now.longest * (0.9 + 0.09 * min(now.longest, 1.0)))
        run.linear_residual = max(run.linear_residual, now.residual)
        if math.isfinite(step):
            self._kernel(kernels.advance)(
                self._x, self._y, now.dgamma, now.dg, self._g, self._problem.mu, step, step
            )
        return step

    def _target(self, now: _Direction, affine: float) -> float:
        """Collective. Where on the central path to aim (S. Mehrotra, 1992)."""
        gap = self._kernel(kernels.gap_at)(
            self._lam, now.u, now.v, affine, affine, self._partial[0]
        )
        ratio = self._problem.parallel.sum(gap) / self._run.contacts / self.mean
        return self.mean * min(1.0, max(0.0, ratio)) ** 3

    def _corrected(self, target: float) -> bool:
        """Collective. Try for a longer step; whether that succeeded."""
        now, trial = self._now, self._trial
        if not now.longest < 1.0:
            return False
        trial.c[:] = now.c
        low, high = _BAND
        self._kernel(kernels.centrality)(
            self._lam, now.u, now.v, min(1.0, now.longest + _LONGER), low * target, high * target,
            trial.c,
        )  # fmt: skip
        self._find(trial)
        if not min(trial.longest, 1.0) >= _WORTHWHILE * now.longest:
            return False
        self._now, self._trial = trial, now
        return True

    def _centred(self) -> None:
        """Collective. Take the direction towards the point of the central path at this `mean`."""
        trial = self._trial
        trial.u[:] = 0.0
        trial.v[:] = 0.0
        self._kernel(kernels.second_order)(self._lam, trial.u, trial.v, self.mean, trial.c)
        self._find(trial)
        if not trial.longest <= self._now.longest:
            self._now, self._trial = trial, self._now

    def _find(self, d: _Direction) -> None:
        """Collective. Solve for d's right-hand side c, refined in the scaled space."""
        kernel, mu, partial = self._kernel, self._problem.mu, self._partial
        kernel(kernels.right_side)(self._g, self._eta, self._w, mu, d.c, self._s)
        d.residual = self._solve(d.dgamma, _LINEAR)
        last = math.inf
        for attempt in range(_REFINEMENTS + 1):
            self._multiply(d)
            primal, dual = kernel(kernels.direction)(
                d.dgamma, d.dg, self._g, self._y, self._eta, self._w, self._lam, mu, d.u, d.v,
                partial[1],
            )  # fmt: skip
            worst = kernel(kernels.misfit)(
                self._lam, d.u, d.v, self._eta, self._w, mu, d.c, self._s, partial[0]
            )
            found = np.array([primal, dual, worst])
            largest_of_ranks(found, self._problem.parallel)
            misfit = found[2] / math.sqrt(self.mean)
            blocking = max(found[0], found[1])
            d.longest = 1.0 / blocking if blocking > 0.0 else math.inf
            if not _MISFIT < misfit < 0.5 * last or attempt == _REFINEMENTS:
                break
            last = misfit
            self._run.refinements += 1
            d.residual *= self._solve(self._correction, _CORRECTION)
            d.dgamma += self._correction

    def _multiply(self, d: _Direction) -> None:
        """Collective. dg = (N + proximal term) dgamma."""
        self._problem.operator.apply(d.dgamma, d.dg)
        self._run.products += 1
        np.multiply(d.dgamma, self._soft[:, None], out=self._s)
        d.dg += self._s

    def _solve(self, out: NDArray, tolerance: float) -> float:
        """Collective. out = (N + R)^-1 s; return its relative residual."""
        return self._run.solve(self._system, self._s, out, tolerance)

    def _kernel(self, kernel: Any) -> Callable:
        return kernel.using(self._problem.threads)
