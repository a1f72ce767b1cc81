"""The cone complementarity problem and how well an impulse solves it.

Find gamma in C with g = N gamma + b in C*, gamma.g = 0, where C is the product of the friction
cones {|gamma_t| <= mu gamma_n} and C* = {g_n >= mu |g_t|} (S. De, thesis 2021, 2.11; it is the
optimality condition of the convex problem min gamma.N gamma/2 + b.gamma over C, 2.16).

Rows of gamma, g, b are contacts; columns (normal, tangent 1, tangent 2), or (normal,) alone where
no contact has friction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_solver as kernels
from dem_mpi.parallel import Parallel


class Delassus(Protocol):
    """N = D^T M^-1 D on this rank's contacts."""

    def apply(self, impulse: NDArray, out: NDArray) -> None:
        """Collective. out = N impulse; both (m, columns) of this rank's contacts."""

    def diagonal(self) -> NDArray:
        """Return the diagonal of N, (m, columns) [1/kg]."""


@dataclass(frozen=True)
class ConeProblem:
    """One problem, distributed: each rank has the rows of the contacts it owns.

    b : (m, columns) [m/s]; mu : (m,); velocity_scale [m/s] is v_ref of the scaled residuals.
    elongation : longest side over the mean side of the region of the bodies, for those who have to
    guess how a factorisation of N would fill in
    """

    operator: Delassus
    b: NDArray
    mu: NDArray
    velocity_scale: float
    impulse_scale: float
    parallel: Parallel
    threads: int = 1
    elongation: float = 1.0

    @property
    def contacts(self) -> int:
        """Number of contacts on this rank."""
        return self.b.shape[0]

    @cached_property
    def weight(self) -> NDArray:
        """max(1, N_ii gamma_ref/v_ref), (m,): how much lighter than the median a contact is.

        gamma.g counts that many times where a solve may stop. A light body among heavy ones would
        otherwise be thrown off by an error that is small beside their impulses.
        """
        if not self.velocity_scale > 0.0:
            return np.ones(self.contacts)
        stiffness = self.operator.diagonal().max(axis=1, initial=0.0)
        return np.maximum(1.0, stiffness * (self.impulse_scale / self.velocity_scale))


@dataclass(frozen=True)
class Residuals:
    """Largest violations over all ranks, always from a fresh product g = N gamma + b.

    primal          max_i max(0, |gamma_t| - mu gamma_n)        [N s]
    dual            max_i max(0, mu |g_t| - g_n)                [m/s]; h dual is added overlap [m]
    complementarity max_i |gamma_i . g_i|                       [J]
    weighted_work   the same, light contacts weighted as in `ConeProblem.weight`  [J]
    objective       gamma.N gamma/2 + b.gamma                   [J]
    thesis          max of S. De's 2.35-2.37, contacts with mu > 0 only (mixed units)
    """

    primal: float
    dual: float
    complementarity: float
    weighted_work: float
    objective: float
    thesis: float

    @property
    def finite(self) -> bool:
        """Whether no residual is NaN or infinite."""
        return all(map(math.isfinite, (self.primal, self.dual, self.complementarity)))


@dataclass(frozen=True)
class Tolerance:
    """When a solve may stop.

    absolute  dual <= value [m/s] and weighted work <= relative_work v_ref gamma_ref [J]
    scaled    dual <= value v_ref and the same for the work
    thesis    max(r_p, r_d, r_c) <= value with S. De's definitions (2.35-2.37)
    """

    value: float = 1e-4
    kind: Literal["absolute", "scaled", "thesis"] = "absolute"
    relative_work: float = 1e-4

    def merit(self, residuals: Residuals, problem: ConeProblem) -> float:
        """Return the largest residual over its limit: the problem is solved when this is <= 1."""
        if self.kind == "thesis":
            return residuals.thesis / self.value
        return self.merit_of(residuals.dual, residuals.weighted_work, problem)

    def merit_of(self, dual: float, weighted_work: float, problem: ConeProblem) -> float:
        """Return the merit of a cone-feasible impulse from its two residuals."""
        limit, work = self.limits(problem)
        return max(dual / limit, weighted_work / work if work > 0.0 else 0.0)

    def limits(self, problem: ConeProblem) -> tuple[float, float]:
        """Return the limits of dual [m/s] and weighted work [J], of the kinds but thesis."""
        dual = self.value * (problem.velocity_scale if self.kind == "scaled" else 1.0)
        return dual, self.relative_work * problem.velocity_scale * problem.impulse_scale


def evaluate(problem: ConeProblem, impulse: NDArray, velocity: NDArray) -> Residuals:
    """Collective. Residuals of an impulse whose g = N gamma + b is `velocity`.

    Where a value on any rank is not a number the largest violations are infinite, on all ranks.
    """
    primal, dual, work, weighted, objective, thesis_dual, thesis_sum = kernels.residuals(
        impulse, velocity, problem.b, problem.mu, problem.weight
    )
    largest = np.array([primal, dual, work, weighted, thesis_dual])
    total = np.array([objective, thesis_sum, float(problem.contacts)])
    largest_of_ranks(largest, problem.parallel)
    problem.parallel.sum_in_place(total)
    thesis_work = abs(total[1]) / max(total[2], 1.0)
    return Residuals(
        primal=float(largest[0]),
        dual=float(largest[1]),
        complementarity=float(largest[2]),
        weighted_work=float(largest[3]),
        objective=float(total[0]),
        thesis=float(max(largest[0], largest[4], thesis_work)),
    )


def largest_of_ranks(violations: NDArray, parallel: Parallel) -> None:
    """Collective. Replace violations (k,) by the largest of all ranks, NaN by infinity.

    MPI leaves a maximum with NaN open: ranks could come to different answers, and wait for ever.
    """
    violations[np.isnan(violations)] = np.inf
    parallel.max_in_place(violations)


def median_of_positive(values: NDArray, parallel: Parallel) -> float:
    """Collective. The lower median over all ranks of positive numbers; 1 if there are none.

    Exact and independent of the distribution over ranks: a radix selection on the bits of the
    doubles, eight reductions of 256 counts, and no rank holds the others' values.
    """
    total = parallel.sum(int(values.size))
    if total == 0:
        return 1.0
    target = (total - 1) // 2
    prefix = 0
    for shift in range(56, -1, -8):
        counts = np.zeros(256, dtype=np.int64)
        kernels.histogram_of_bits(values, prefix, shift, counts)
        parallel.sum_in_place(counts)
        below = np.cumsum(counts)
        digit = int(np.searchsorted(below, target, side="right"))
        if digit:
            target -= int(below[digit - 1])
        prefix = (prefix << 8) | digit
    return float(np.array([prefix], dtype=np.int64).view(np.float64)[0])
