"""Accelerated projected gradient descent (Nesterov) for the cone complementarity problem.

S. De, thesis 2021, 2.17-2.22; H. Mazhar, T. Heyn, D. Negrut, A. Tasora, ACM Trans. Graph. 34, 2015.
An iteration costs one product with N unless the line search rejects the step, and two reductions.

Symbols: gamma impulse; g = N gamma + b; y = gamma + beta (gamma - gamma_old); d = gamma_new - y;
L the step constant; theta the momentum sequence; S the scaling gamma = S z.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_solver as kernels
from dem_mpi.cone import ConeProblem, Tolerance, evaluate, largest_of_ranks
from dem_mpi.solvers.result import SolveReport

# S N S has a unit diagonal, so the largest eigenvalue is at least 1. Where the iterate no longer
# moves every step is accepted, and L would fall until 1/L is infinite.
_SMALLEST_LIPSCHITZ = 1e-9


@dataclass(frozen=True)
class ApgdOptions:
    """Options of `Apgd`.

    decay   : L is multiplied by this after an accepted step, so that steps can grow again
    refresh : every so many iterations g is recomputed from gamma, against drift
    restart : drop the momentum when it points uphill, grad f(y).(gamma_new - gamma) > 0
    """

    tolerance: Tolerance = field(default_factory=Tolerance)
    max_iterations: int = 5000
    decay: float = 0.9
    refresh: int = 50
    restart: bool = True
    fixed_iterations: bool = False


class Apgd:
    """Solves a `ConeProblem` by projected gradients with momentum, line search and restart."""

    def __init__(self, options: ApgdOptions | None = None) -> None:
        self.options = options or ApgdOptions()

    def solve(
        self,
        problem: ConeProblem,
        guess: NDArray,
        lipschitz: float | None = None,
        tolerance: Tolerance | None = None,
        keep_going: Callable[[int, int, float], bool] | None = None,
    ) -> SolveReport:
        """Collective. Iterate from `guess` (m, columns) [N s] until the tolerance holds.

        `tolerance` takes the place of the one in the options for this problem. `keep_going` is
        asked after every iteration, with the iterations and products so far and the merit, which
        are the same on all ranks; where it says no, on all ranks alike, the solve ends.

        Returns the best iterate seen, with the reason in words when it did not converge. Rows of
        the guess that are not finite start from zero. The guess is taken over, not copied: memory
        for a contact is what bounds the size of a scene.
        """
        started = perf_counter()
        options, parallel = self.options, problem.parallel
        tolerance = tolerance or options.tolerance
        step_kernel = kernels.gradient_step.using(problem.threads)
        bend_kernel = kernels.curvature.using(problem.threads)
        project = kernels.project.using(problem.threads)
        m = problem.contacts
        chunks = max(1, math.ceil(m / kernels.CHUNK))
        partial2, partial4 = np.zeros((chunks, 2)), np.zeros((chunks, 4))

        scaling = squared_scaling(problem)
        gamma = np.ascontiguousarray(guess, dtype=np.float64)
        gamma[~np.isfinite(gamma).all(axis=1)] = 0.0
        project(gamma, problem.mu)
        gamma_old = gamma.copy()
        g = np.empty_like(gamma)
        self._fresh(problem, gamma, g)
        g_old = g.copy()
        gamma_new, g_new, d = np.empty_like(gamma), np.empty_like(g), np.empty_like(gamma)
        products = 1
        theta, beta = 1.0, 0.0
        L = lipschitz if lipschitz and math.isfinite(lipschitz) else 1.0
        L = max(L, _SMALLEST_LIPSCHITZ)

        first = evaluate(problem, gamma, g)
        merit = tolerance.merit(first, problem)
        best, best_merit = gamma.copy(), merit
        history: list[tuple[float, ...]] = [(0, first.dual, first.weighted_work, first.objective)]
        iteration = 0
        reason = "reached the iteration limit"
        fixed = options.fixed_iterations
        while iteration < options.max_iterations and (fixed or not merit <= 1.0):
            iteration += 1
            # (2.22) gamma_new = P_C(y - S^2 grad f(y) / L), L doubled until (2.21) holds: for a
            # quadratic it reads d.N d <= L |d|^2, without differences of f that lose all digits.
            while True:
                sums = np.zeros(4)
                sums[0], sums[1] = step_kernel(
                    gamma, gamma_old, g, g_old, beta, 1.0 / L, scaling, problem.mu,
                    gamma_new, d, partial2,
                )  # fmt: skip
                problem.operator.apply(d, g_new)
                products += 1
                sums[2], sums[3], dual, work = bend_kernel(
                    g, g_old, beta, d, problem.b, gamma_new, g_new, problem.mu, problem.weight,
                    partial4,
                )  # fmt: skip
                parallel.sum_in_place(sums)
                square, uphill, bend, objective = sums
                if bend <= L * square or not math.isfinite(bend):
                    break
                L *= 2.0
            largest = np.array([dual, work])
            largest_of_ranks(largest, parallel)
            if not (math.isfinite(bend) and np.isfinite(largest).all()):
                reason, merit = "not a number in the iteration", math.nan
                break
            if options.restart and uphill > 0.0:
                theta, beta = 1.0, 0.0
            else:
                # (2.18), (2.19)
                theta_new = 0.5 * (theta * math.sqrt(theta * theta + 4.0) - theta * theta)
                beta = theta * (1.0 - theta) / (theta * theta + theta_new)
                theta = theta_new
            gamma_old, gamma, gamma_new = gamma, gamma_new, gamma_old
            g_old, g, g_new = g, g_new, g_old
            L = max(L * options.decay, _SMALLEST_LIPSCHITZ)

            if tolerance.kind == "thesis":
                merit = tolerance.merit(evaluate(problem, gamma, g), problem)
            else:
                merit = tolerance.merit_of(largest[0], largest[1], problem)
            history.append((iteration, largest[0], largest[1], objective))
            if iteration % options.refresh == 0 or (merit <= 1.0 and not fixed):
                # Convergence is only ever believed from a fresh product. Both g are made anew:
                # extrapolation would carry the drift of a stale one on, fifty times as large.
                self._fresh(problem, gamma, g)
                self._fresh(problem, gamma_old, g_old)
                products += 2
                merit = tolerance.merit(evaluate(problem, gamma, g), problem)
            if merit < 0.9 * best_merit or merit <= 1.0:
                best[:] = gamma
                best_merit = merit
            if keep_going is not None and not keep_going(iteration, products, merit):
                reason = "ended by who called for the solve"
                break

        if (best_merit < merit and not fixed) or not math.isfinite(merit):
            gamma = best
        self._fresh(problem, gamma, g)
        final = evaluate(problem, gamma, g)
        converged = final.finite and tolerance.merit(final, problem) <= 1.0
        return SolveReport(
            impulse=gamma,
            velocity=g,
            residuals=final,
            iterations=iteration,
            products=products + 1,
            factorisations=0,
            history=np.array(history),
            seconds={"solve": perf_counter() - started},
            converged=converged,
            reason="converged" if converged else reason,
            lipschitz=L,
        )

    def destroy(self) -> None:
        """Nothing is kept between solves."""

    @staticmethod
    def _fresh(problem: ConeProblem, gamma: NDArray, g: NDArray) -> None:
        problem.operator.apply(gamma, g)
        g += problem.b


def squared_scaling(problem: ConeProblem) -> NDArray:
    """S^2 = 1/diag(N), (m, 1 or 2): of both tangents the smaller, so that a cone stays a cone.

    Tangents differ where bodies are not spheres, and in problems with frames of their own.
    """
    diagonal = problem.operator.diagonal()
    largest = [diagonal[:, 0]]
    if diagonal.shape[1] > 1:
        largest.append(diagonal[:, 1:].max(axis=1))
    return 1.0 / np.stack(largest, axis=1)
