"""APGD first, the interior point method where that promises less work.

Accelerated gradients need tens of iterations on one problem and tens of thousands on another; the
interior point method needs some twenty on any, each with a factorisation. Which is cheaper shows
while gradients run: the fall of the merit, extended to the tolerance, foretells what is left of
them, and counts of bodies and contacts foretell what the factorisations would take (`work`).

The rule. Gradients run free until they have taken `free` of the foretold price of the other
method. From then on, at iterations a tenth apart, they go on only if what is left of them costs
less than `patience` (1 - spent/limit) prices: leaving early is a mistake where they are about to
end, so at first they must be far off, and the more is spent the less is believed. Whatever the
forecasts say, no more than `limit` prices are spent before the change. What gradients have done is
not always lost then: from their iterate the interior point method took 4 Newton iterations for 10
in a settled bed of 2,000 spheres, but 10 for 11 in one of 500 and 12 for 13 under a heavy load.

The three numbers were chosen on histories of gradients in beds of 500 and 2,000 spheres, falling
to settled, to 0.1 to 1e-8 m/s and for supposed prices of 500 to 64,000 products. On these, and
counting nothing for the better start, one in 16 of the pairs in which gradients alone would cost
0.1 to 30 prices costs more than 1.5 times the better method, 2.4 times at most. Other scenes may
do worse; an error in the price adds to it.

No clock decides, so a run repeats bit for bit; nothing is kept from one problem to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dem_mpi.cone import ConeProblem, Tolerance
from dem_mpi.machine import memory_share
from dem_mpi.parallel import Parallel
from dem_mpi.solvers import work
from dem_mpi.solvers.apgd import Apgd
from dem_mpi.solvers.result import Solver, SolveReport

_WINDOW = 0.8  # part of the iterations so far whose fall is extended
_SAMPLES = 33
_FIRST_LOOK = 20  # iterations
_NEXT_LOOK = 1.1
_SMALL = 5e8  # B
_PART_OF_MACHINE = 0.7  # that factors may take


@dataclass(frozen=True)
class AutoOptions:
    """When to change from gradients to the interior point method, see the module's text."""

    free: float = 0.5
    patience: float = 1.5
    limit: float = 1.5


class Forecast:
    """Follows the merit of gradients and tells after each iteration whether they should go on.

    price : of solving by the other method, in products with N
    """

    def __init__(self, price: float, options: AutoOptions) -> None:
        self._price, self._options = price, options
        self._lowest: list[float] = []  # logarithm of the least merit by iteration
        self._next_look = _FIRST_LOOK
        self.ended = False  # whether it told them to end

    def __call__(self, iteration: int, products: int, merit: float) -> bool:
        """Take in one iteration; False to end. The same on all ranks, as its arguments are."""
        level = math.log(merit) if merit > 0.0 else -math.inf
        self._lowest.append(min(level, self._lowest[-1]) if self._lowest else level)
        if iteration < self._next_look:
            return True
        self._next_look = int(_NEXT_LOOK * iteration) + 1
        options = self._options
        spent = products / self._price
        if spent < options.free:
            return True
        left = remaining_iterations(self._lowest) * (products / iteration) / self._price
        self.ended = left > options.patience * (1.0 - spent / options.limit)
        return not self.ended


def remaining_iterations(lowest: list[float]) -> float:
    """Iterations until the logarithm of the least merit, one value an iteration, reaches 0.

    The merit of accelerated gradients waves up and down; its least value so far falls in steps,
    at first like a power of the iteration and near the solution exponentially. The geometric mean
    of what a power law and an exponential through the last four fifths of it say is taken.
    """
    k = len(lowest)
    now = lowest[-1]
    if now <= 0.0:
        return 0.0
    where = np.unique(np.linspace(max(1, int((1.0 - _WINDOW) * k)), k, _SAMPLES).astype(int))
    values = np.array([lowest[i - 1] for i in where])
    linear = -_slope(where.astype(float), values)  # per iteration
    power = -_slope(np.log(where), values)
    if not (linear > 0.0 and power > 0.0):
        return math.inf
    exponential = now / linear
    algebraic = k * math.expm1(min(now / power, 300.0))
    return math.sqrt(exponential * algebraic)


def _slope(x: NDArray, y: NDArray) -> float:
    """Of the least-squares line through points; 0 through a single one."""
    x = x - x.mean()
    square = float(x @ x)
    return float(x @ y) / square if square > 0.0 else 0.0


class Auto:
    """Solves a `ConeProblem` by APGD, or by APGD and the interior point method after it."""

    def __init__(self, apgd: Apgd, scip: Solver, options: AutoOptions | None = None) -> None:
        """Take both solvers over; they must want the same tolerance."""
        self.apgd, self.scip = apgd, scip
        self.options = options or AutoOptions()

    def solve(
        self,
        problem: ConeProblem,
        guess: NDArray,
        lipschitz: float | None = None,
        tolerance: Tolerance | None = None,
    ) -> SolveReport:
        """Collective. Solve from `guess` (m, columns) [N s], which is taken over.

        The report adds up what both methods did: iterations, products, history, seconds. Its
        `solver` tells whose impulse it holds: the better one's where neither met the tolerance.
        Where the interior point method fails, gradients go on with the iterations they have left.
        """
        tolerance = tolerance or self.apgd.options.tolerance
        price, refusal = self._price(problem, tolerance)
        forecast = Forecast(price, self.options)
        first = self.apgd.solve(problem, guess, lipschitz, tolerance, forecast)
        if first.converged or not first.residuals.finite:
            return first
        if forecast.ended:
            first = replace(first, reason=f"made way for scip after {first.iterations} iterations")
        if refusal:
            return replace(first, reason=f"{first.reason}; {refusal}")
        second = self.scip.solve(problem, first.impulse.copy(), None, tolerance)
        parts = [first, second]
        if not second.converged and first.iterations < self.apgd.options.max_iterations:
            parts.append(self._more_gradients(problem, parts, tolerance))
        return joined(problem, tolerance, parts)

    def destroy(self) -> None:
        """Collective. Free what both solvers keep."""
        self.apgd.destroy()
        self.scip.destroy()

    def _price(self, problem: ConeProblem, tolerance: Tolerance) -> tuple[float, str]:
        """Collective. The interior point method's price in products, and why it may not be used."""
        newton = self.scip.options.newton
        size = work.size_of(problem, newton.form)
        needed = work.factor_memory(size) * (1.0 + newton.workspace / 100.0)
        if newton.linear == "mumps":
            allowed, by = _allowed_memory(needed, newton.memory, problem.parallel)
            if needed > allowed:
                return math.inf, (
                    f"factors of Newton matrices would take about {needed / 1e6:.0f} MB a rank, "
                    f"and {by} allows {allowed / 1e6:.0f} MB"
                )
        limit = tolerance.value * (1.0 if tolerance.kind == "absolute" else problem.velocity_scale)
        decades = math.log10(max(1.0, problem.velocity_scale / limit)) if limit > 0.0 else 16.0
        price = work.interior_point_work(size, decades, newton.linear)
        return price / work.product_work(size), ""

    def _more_gradients(
        self, problem: ConeProblem, parts: list[SolveReport], tolerance: Tolerance
    ) -> SolveReport:
        """Collective. APGD from the better impulse, to the end of its iterations."""
        left = self.apgd.options.max_iterations - parts[0].iterations
        begin = _best(problem, tolerance, parts)
        report = self.apgd.solve(
            problem, begin.impulse.copy(), parts[0].lipschitz, tolerance, lambda k, *_: k < left
        )
        if report.converged or report.iterations < left:
            return report
        return replace(report, reason="reached the iteration limit")


def _allowed_memory(needed: float, limit: float | None, parallel: Parallel) -> tuple[float, str]:
    """Collective. What a rank may use for factors [B], and who says so; limit [MB]."""
    if limit is not None:
        return 1e6 * limit, "contact.scip.memory"
    if needed < _SMALL:  # no need to ask, in every step, what any machine has
        return math.inf, ""
    return _PART_OF_MACHINE * memory_share(parallel), "the machine"


def joined(problem: ConeProblem, tolerance: Tolerance, parts: list[SolveReport]) -> SolveReport:
    """One report of solves in turn: the best impulse, and the work of all of them.

    Rows of the history are numbered on. The step constant is that of the last gradients.
    """
    best = _best(problem, tolerance, parts)
    rows, done = [], 0
    for part in parts:
        history = part.history.copy()
        history[:, 0] += done
        rows.append(history)
        done += part.iterations
    seconds: dict[str, float] = {}
    for part in parts:
        for phase, spent in part.seconds.items():
            seconds[phase] = seconds.get(phase, 0.0) + spent
    gradients = [part for part in parts if part.solver == "apgd"]
    newton = max(parts, key=lambda part: part.solver == "scip")
    reason = "; then ".join(f"{part.solver}: {part.reason}" for part in parts)
    return replace(
        best,
        iterations=done,
        products=sum(part.products for part in parts),
        factorisations=newton.factorisations,
        history=np.concatenate(rows),
        seconds=seconds,
        reason="converged" if best.converged else reason,
        lipschitz=gradients[-1].lipschitz,
        form=newton.form,
        factor_entries=newton.factor_entries,
        linear_residual=newton.linear_residual,
        refinements=newton.refinements,
        linear_iterations=newton.linear_iterations,
    )


def _best(problem: ConeProblem, tolerance: Tolerance, parts: list[SolveReport]) -> SolveReport:
    """The report with the least merit among the finite ones; of equals the first."""

    def merit(part: SolveReport) -> float:
        found = tolerance.merit(part.residuals, problem) if part.residuals.finite else math.inf
        return found if math.isfinite(found) else math.inf

    return min(parts, key=lambda part: (not part.converged, merit(part)))
