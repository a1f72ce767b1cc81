"""Coulomb's law of friction: cone problems in turn, by any solver of such problems.

The law in De Saxce's form, for every contact:

    gamma in C,  g + (s, 0, 0) in C*,  gamma.(g + (s, 0, 0)) = 0,  g = N gamma + b,  s = mu |g_t|.

Held fixed, the bias s [m/s] leaves the cone problem of N and b + s. The outer iteration looks for
the bias that the solution reproduces, s = F(s) = mu |g_t(s)| (V. Acary, F. Cadoux, C. Lemarechal,
J. Malick, Z. Angew. Math. Mech. 91, 2011): a contact that slides then has g_n = 0, where the cone
problem alone (s = 0) lets it open at mu |g_t|. Contacts that stick or part are the same in both.

For one contact that slides dF/ds = mu^2 N_tt/(N_nn + mu^2 N_tt), so that the plain fixed point is
slow where mu is large, and r = F(s) - s times 1 + mu^2 N_tt/N_nn is Newton's step. These steps, of
all contacts together, are combined by Anderson acceleration (D. Anderson, J. ACM 12, 1965), which
begins anew after an iterate that does badly.

Unlike the cone problem the law may have several solutions, or none (Painleve's paradoxes, large
mu), and F need not contract near one. Which of several is found depends on the guess. Where none
is, the report says so and holds the best impulse seen.

Symbols: gamma impulse; g velocity; s bias; r its residual; theta weights of past differences.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_solver as kernels
from dem_mpi.cone import ConeProblem, Residuals, Tolerance, evaluate
from dem_mpi.parallel import Parallel
from dem_mpi.solvers.result import Solver, SolveReport

if TYPE_CHECKING:
    from dem_mpi.solvers.coulomb_newton import Found, ProximalNewton

# Merits below this are taken for it when the tolerance of a cone problem is set.
_LAST = 10.0
# The iteration ends after cone problems left unsolved in a row, none of which brought the merit
# down to this part of the best.
_PROGRESS, _UNSOLVED = 0.5, 3
# gamma.g that a cone problem may keep, over v_ref gamma_ref, and over what its dual residual may be
# over v_ref. An interior point has g of the right sign long before its impulses are small enough.
_WORK = 10.0
# Past differences are those of cone problems solved to a part of the merit: what they say below
# this part of the largest, in squares, is noise.
_NOISE = 1e-2
# Bold and careful steps take turns when the merit has not halved for so many cone problems. Careful
# ones are a part of the plain fixed point's, with little of what past differences say.
_STALLED, _CAREFUL, _MORE_NOISE = 20, 0.7, 1e-1
# From a best iterate that is so many tolerances off the bias is lowered up to so often by so many
# times what it exceeds mu |g_t| by: contacts that close may do worse than some that open.
_FAR, _LOWERINGS, _BELOW = 30.0, 10, 3.0
# Newton's method on the law itself (see `coulomb_newton`) is tried after so many cone problems from
# a best iterate within so many tolerances, again when that is better by a factor, for a few
# factorisations; for many from the end; up to so many contacts, of all ranks.
_FIRST_NEWTON, _NEAR, _CLOSER, _FEW_STEPS = 5, 10.0, 0.5, 6
_MANY_STEPS, _MOST_CONTACTS = 60, 5000


@dataclass(frozen=True)
class CoulombOptions:
    """Options of `Coulomb`.

    max_outer    : cone problems at most, and up to 10 more to better a poor end
    coarsest     : each is solved to this part of the smallest merit so far, early ones coarsely;
                   a merit below 10 tolerances counts as 10: the bias has its share in the last one
    finest       : the part is halved down to this while the merit does not
    relaxation   : part of the over-relaxation mu^2 N_tt/N_nn that a contact alone would ask for
    memory       : past differences that Anderson acceleration combines; 0 switches it off
    restart      : acceleration begins anew after a merit above this multiple of the smallest
    """

    max_outer: int = 100
    coarsest: float = 0.05
    finest: float = 0.02
    relaxation: float = 0.7
    memory: int = 10
    restart: float = 10.0


class Coulomb:
    """Solves for Coulomb's law, in which sliding contacts do not open, by an inner cone solver."""

    def __init__(
        self,
        inner: Solver,
        tolerance: Tolerance | None = None,
        options: CoulombOptions | None = None,
    ) -> None:
        self.inner = inner
        self.tolerance = tolerance or Tolerance()
        self.options = options or CoulombOptions()
        self._newton: ProximalNewton | None = None

    def solve(
        self,
        problem: ConeProblem,
        guess: NDArray,
        lipschitz: float | None = None,
        tolerance: Tolerance | None = None,
    ) -> SolveReport:
        """Collective. Solve from `guess` (m, columns) [N s], which is taken over, not copied.

        Velocity and residuals of the report are those of the law, with the problem's own b; counts
        are sums over the cone problems solved and the Newton steps on the law. `history` has a row
        for each cone problem, with the iterations up to its end. A problem without friction is
        handed on as it is.
        """
        options, parallel = self.options, problem.parallel
        tolerance = tolerance or self.tolerance
        frictional = problem.b.shape[1] > 1 and bool(np.any(problem.mu > 0.0))
        if not parallel.any(frictional):
            return self.inner.solve(problem, guess, lipschitz, tolerance)

        gamma, g = _start(problem, guess)
        s = slip_bias(problem.mu, g)
        least = _merit(tolerance, law_residuals(problem, gamma, g), problem)
        least = least if math.isfinite(least) else _LAST
        diagonal = problem.operator.diagonal()
        part = options.coarsest
        newton = 1.0 + options.relaxation * _single_contact_gain(problem.mu, diagonal)
        acceleration, careful = _Anderson(options.memory, parallel, _NOISE), False
        mark, stalled = math.inf, 0
        totals = _Totals()
        best: _Iterate | None = None
        reason = f"reached the limit of {options.max_outer} cone problems (max_outer)"
        unsolved, tried = 0, math.inf
        while totals.outer < options.max_outer:
            # A guess that obeys the law already is taken as it is.
            finer = part * max(least, _LAST) if least > 1.0 else 1.0
            found = self._iterate(problem, s, gamma, lipschitz, tolerance, finer, totals)
            gamma, g, lipschitz = found.impulse, found.velocity, found.inner.lipschitz
            merit = found.merit
            progress = best is None or merit < _PROGRESS * best.merit
            unsolved = 0 if found.inner.converged or progress else unsolved + 1
            if best is None or merit < best.merit:
                best = found
            near = best.merit <= _CLOSER * tried if totals.outer >= _FIRST_NEWTON else False
            if 1.0 < best.merit <= _NEAR and near:
                tried = best.merit
                polished = self._newton_steps(problem, best, tolerance, _FEW_STEPS, totals)
                # Otherwise left aside: the fixed point goes on from its own iterates.
                if polished.merit <= 1.0:
                    best = polished
            if best.merit <= 1.0:
                break
            if not math.isfinite(merit) or unsolved == _UNSOLVED:
                reason = f"cone problem {totals.outer}: {found.inner.reason}"
                break
            stalled = 0 if merit < _PROGRESS * mark else stalled + 1
            mark = merit if stalled == 0 else mark
            if stalled == _STALLED:
                careful, stalled = not careful, 0
                noise = _MORE_NOISE if careful else _NOISE
                acceleration = _Anderson(options.memory, parallel, noise)
            elif merit > options.restart * best.merit:
                acceleration.restart()
            if merit > _PROGRESS * least:
                part = max(0.5 * part, min(options.finest, options.coarsest))
            least = best.merit
            r = slip_bias(problem.mu, g) - s
            closed, slides = _standing(problem.mu, diagonal, gamma, g, r)
            if careful:
                r *= _CAREFUL
            else:
                r[slides] *= newton[slides]
            # Where a contact stays open its bias is of no consequence, and no part of the fit.
            s = np.maximum(s + acceleration.step(s, r, closed), 0.0)
        if 1.0 < best.merit < math.inf:
            best = self._newton_steps(problem, best, tolerance, _MANY_STEPS, totals)
        if _FAR < best.merit < math.inf:
            best = self._lowered(problem, best, lipschitz, tolerance, totals)
        return totals.report(best, reason, lipschitz)

    def _newton_steps(
        self,
        problem: ConeProblem,
        best: _Iterate,
        tolerance: Tolerance,
        budget: int,
        totals: _Totals,
    ) -> _Iterate:
        """Collective. What Newton's method makes of the best iterate, if that is better.

        Nothing without a matrix N, or with too many contacts to factorise it in passing.
        """
        contacts = problem.parallel.sum(problem.contacts)
        positive = bool((problem.operator.diagonal() > 0.0).all())
        if (
            contacts > _MOST_CONTACTS
            or not hasattr(problem.operator, "delassus")
            or problem.parallel.any(not positive)
        ):
            return best
        # Not at the top: it needs PETSc, of which a solve that does not come to this needs nothing.
        from dem_mpi.solvers.coulomb_newton import ProximalNewton

        started = perf_counter()
        self._newton = self._newton or ProximalNewton()
        found = self._newton.improve(problem, best.impulse, tolerance, budget)
        totals.seconds["solve"] += perf_counter() - started
        if found is None:
            return best
        totals.add_newton(found)
        if not found.merit < best.merit:
            return best
        return replace(
            best,
            impulse=found.impulse,
            velocity=found.velocity,
            residuals=found.residuals,
            merit=found.merit,
        )

    def _lowered(
        self,
        problem: ConeProblem,
        best: _Iterate,
        lipschitz: float | None,
        tolerance: Tolerance,
        totals: _Totals,
    ) -> _Iterate:
        """Collective. The best of iterates with less and less bias, beginning with this one's.

        A cone problem gives g_n >= mu |g_t| - s: where s is at most mu |g_t| nothing closes.
        """
        now = best
        for _ in range(_LOWERINGS):
            excess = np.maximum(now.bias - slip_bias(problem.mu, now.velocity), 0.0)
            s = np.maximum(now.bias - _BELOW * excess, 0.0)
            now = self._iterate(problem, s, now.impulse, lipschitz, tolerance, 0.5, totals)
            best = now if now.merit < best.merit else best
            if best.merit <= _FAR or not now.residuals.finite:
                break
        return best

    def _iterate(
        self,
        problem: ConeProblem,
        s: NDArray,
        guess: NDArray,
        lipschitz: float | None,
        tolerance: Tolerance,
        finer: float,
        totals: _Totals,
    ) -> _Iterate:
        """Collective. Solve the cone problem of the bias s (m,), to `finer` tolerances."""
        wanted = _inner_tolerance(tolerance, finer, problem)
        report = self.inner.solve(_biased(problem, s), guess.copy(), lipschitz, wanted)
        g = _lifted(report.velocity, -s)
        residuals = law_residuals(problem, report.impulse, g)
        totals.add(report, residuals)
        return _Iterate(
            report.impulse, g, s, residuals, _merit(tolerance, residuals, problem), report
        )

    def destroy(self) -> None:
        """Collective. Free what the inner solver keeps between solves."""
        self.inner.destroy()
        if self._newton is not None:
            self._newton.destroy()
            self._newton = None


def slip_bias(mu: NDArray, g: NDArray) -> NDArray:
    """s = mu |g_t| [m/s] of every contact, (m,)."""
    return mu * np.sqrt(g[:, 1] * g[:, 1] + g[:, 2] * g[:, 2])


def law_residuals(problem: ConeProblem, impulse: NDArray, velocity: NDArray) -> Residuals:
    """Collective. Residuals under Coulomb's law of an impulse whose N gamma + b is `velocity`.

    dual is max(0, -g_n) [m/s], complementarity max |gamma_n (g_n + mu |g_t|) + gamma_t.g_t| [J]:
    those of the cone problem with g + s. The objective is that of b, gamma.(N gamma/2 + b).
    """
    if velocity.shape[1] == 1:
        return evaluate(problem, impulse, velocity)
    s = slip_bias(problem.mu, velocity)
    # The objective is (gamma.g + gamma.b)/2, in which b - s undoes the bias of g + s.
    return evaluate(_biased(problem, -s), impulse, _lifted(velocity, s))


def _lifted(rows: NDArray, s: NDArray) -> NDArray:
    """Copy rows (m, 3) with s (m,) added to the normal part."""
    lifted = rows.copy()
    lifted[:, 0] += s
    return lifted


def _biased(problem: ConeProblem, s: NDArray) -> ConeProblem:
    return replace(problem, b=_lifted(problem.b, s))


def _start(problem: ConeProblem, guess: NDArray) -> tuple[NDArray, NDArray]:
    """Collective. The guess within the cones, zero where it is not finite, and its N gamma + b."""
    gamma = np.ascontiguousarray(guess, dtype=np.float64)
    gamma[~np.isfinite(gamma).all(axis=1)] = 0.0
    kernels.project.using(problem.threads)(gamma, problem.mu)
    g = np.empty_like(gamma)
    problem.operator.apply(gamma, g)
    g += problem.b
    return gamma, g


def _inner_tolerance(tolerance: Tolerance, factor: float, problem: ConeProblem) -> Tolerance:
    """Tolerance of a cone problem: the law's times a factor, the work tied to the velocity."""
    value, work = factor * tolerance.value, factor * tolerance.relative_work
    if tolerance.kind != "thesis" and problem.velocity_scale > 0.0:
        scale = 1.0 if tolerance.kind == "scaled" else problem.velocity_scale
        work = min(work, _WORK * value / scale)
    return replace(tolerance, value=value, relative_work=work)


def _merit(tolerance: Tolerance, residuals: Residuals, problem: ConeProblem) -> float:
    return tolerance.merit(residuals, problem) if residuals.finite else math.inf


def _single_contact_gain(mu: NDArray, diagonal: NDArray) -> NDArray:
    """mu^2 N_tt/N_nn (m,): what 1/(1 - dF/ds) exceeds 1 by for a sliding contact on its own."""
    normal = diagonal[:, 0]
    tangential = mu**2 * diagonal[:, 1:].mean(axis=1)
    return np.divide(tangential, normal, out=np.zeros_like(mu), where=normal > 0.0)


def _standing(
    mu: NDArray, diagonal: NDArray, gamma: NDArray, g: NDArray, r: NDArray
) -> tuple[NDArray, NDArray]:
    """Which contacts (m,) are closed, and which of these slide.

    Of two numbers whose product the solution makes zero the larger decides, impulses times diag(N):
    an interior point solver leaves both positive. g_n - r is what a contact opens at beyond the
    border of C*, mu gamma_n - |gamma_t| what its impulse lacks to that of C.
    """
    push = np.sqrt(gamma[:, 1] * gamma[:, 1] + gamma[:, 2] * gamma[:, 2])
    slip = np.sqrt(g[:, 1] * g[:, 1] + g[:, 2] * g[:, 2])
    closed = (diagonal[:, 0] * gamma[:, 0] > g[:, 0] - r) | (g[:, 0] < 0.0)
    lacking = diagonal[:, 1:].mean(axis=1) * (mu * gamma[:, 0] - push)
    return closed, closed & (slip > lacking)


class _Anderson:
    """Steps towards r(s) = 0 that differences of past (s, r) suggest.

    With theta the weights for which |r - sum theta_j dr_j| is least, over the closed contacts,
    the step is r - sum theta_j (ds_j + dr_j). Differences below the part `noise` of the largest, in
    squares, count for little.
    """

    def __init__(self, memory: int, parallel: Parallel, noise: float) -> None:
        self._memory, self._parallel, self._noise = memory, parallel, noise
        self.restart()

    def restart(self) -> None:
        """Forget the past."""
        self._ds: list[NDArray] = []
        self._dr: list[NDArray] = []
        self._last: tuple[NDArray, NDArray] | None = None

    def step(self, s: NDArray, r: NDArray, closed: NDArray) -> NDArray:
        """Collective. The step from s (m,) with residual r (m,), kept as a part of the past.

        It is r itself without a past, and for contacts where `closed` (m,) bool is False.
        """
        if self._memory == 0:
            return r
        if self._last is not None:
            self._ds = [*self._ds, s - self._last[0]][-self._memory :]
            self._dr = [*self._dr, r - self._last[1]][-self._memory :]
        self._last = s, r
        k = len(self._dr)
        if k == 0:
            return r
        ds, dr = np.array(self._ds), np.array(self._dr)
        fitted = dr * closed
        # Not by @: the order of a threaded BLAS's sums may change from one call to the next.
        products = np.empty((k, k + 1))
        products[:, :k] = np.einsum("im,jm->ij", fitted, fitted)
        products[:, k] = np.einsum("im,m->i", fitted, r)
        self._parallel.sum_in_place(products)
        theta = self._parallel.broadcast(_weights(products[:, :k], products[:, k], self._noise))
        return r - np.einsum("i,im->m", theta, ds + dr) * closed


def _weights(gram: NDArray, rhs: NDArray, noise: float) -> NDArray:
    """Damped least-squares solution (k,) of gram theta = rhs, in rows and columns of diagonal 1."""
    scale = np.sqrt(np.diag(gram))
    scale[scale == 0.0] = 1.0
    scaled = gram / np.outer(scale, scale) + noise * np.eye(len(gram))
    return np.linalg.solve(scaled, rhs / scale) / scale


@dataclass(frozen=True)
class _Iterate:
    """An impulse and how well it obeys the law; velocity is N gamma + b, bias what made it."""

    impulse: NDArray
    velocity: NDArray
    bias: NDArray
    residuals: Residuals
    merit: float
    inner: SolveReport


@dataclass
class _Totals:
    """Sums over a solve: its cone problems, and Newton's method on the law.

    The first product is that of the guess.
    """

    outer: int = 0
    iterations: int = 0
    products: int = 1
    factorisations: int = 0
    refinements: int = 0
    linear_iterations: int = 0
    factor_entries: int = 0
    linear_residual: float = 0.0
    form: str = ""
    seconds: Counter[str] = field(default_factory=Counter)
    history: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, report: SolveReport, residuals: Residuals) -> None:
        """Count one cone problem, after which the law had these residuals."""
        self.outer += 1
        self.iterations += report.iterations
        self.products += report.products
        self.factorisations += report.factorisations
        self.refinements += report.refinements
        self.linear_iterations += report.linear_iterations
        self.factor_entries = max(self.factor_entries, report.factor_entries)
        self.linear_residual = max(self.linear_residual, report.linear_residual)
        self.form = report.form or self.form
        self.seconds.update(report.seconds)
        self.history.append(
            (self.iterations, residuals.dual, residuals.weighted_work, residuals.objective)
        )

    def add_newton(self, found: Found) -> None:
        """Count the iterations of Newton's method on the law; its seconds are counted elsewhere."""
        self.iterations += found.factorisations
        self.products += found.products
        self.factorisations += found.factorisations
        self.refinements += found.refinements
        self.factor_entries = max(self.factor_entries, found.factor_entries)
        self.linear_residual = max(self.linear_residual, found.linear_residual)
        if found.factorisations:
            self.form = self.form or "contact"

    def report(self, best: _Iterate, reason: str, lipschitz: float) -> SolveReport:
        """Return the report of the best iterate; `reason` is why there is none that converged."""
        converged = best.merit <= 1.0
        return replace(
            best.inner,
            impulse=best.impulse,
            velocity=best.velocity,
            residuals=best.residuals,
            iterations=self.iterations,
            products=self.products,
            factorisations=self.factorisations,
            refinements=self.refinements,
            linear_iterations=self.linear_iterations,
            factor_entries=self.factor_entries,
            linear_residual=self.linear_residual,
            form=self.form,
            outer=self.outer,
            seconds=dict(self.seconds),
            history=np.array(self.history),
            lipschitz=lipschitz,
            converged=converged,
            reason="converged" if converged else reason,
        )
