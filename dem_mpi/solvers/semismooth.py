"""Newton's method on the natural map: from near a solution of the cone problem to round-off.

The interior point method stops at gamma.g > 0 in every contact, and its velocities are off by the
root of that. Here contacts stick, slide or open exactly. Any z = gamma - g/d, d = N_nn, is
p - y/d with p in C, y in C* and p.y = 0; gamma solves the problem where p has N p + b = y. A step
linearises y at p, y + dy with dy = -R dp, so that

    (N + R) dp = y - (N p + b),

a system of the same kind as that of the interior point method. R is between 0 (sticking) and
infinity (open). It is kept between bounds: the lower one makes each step that of a proximal point
method, so that impulses that are not unique stay where they are.

L. Qi, J. Sun, Math. Program. 58, 1993; R. T. Rockafellar, SIAM J. Control Optim. 14, 1976.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_scip as kernels
from dem_mpi._kernels_solver import CHUNK
from dem_mpi.cone import ConeProblem, largest_of_ranks

# Bounds of R over d. A smaller lower bound is a longer way through impulses that are not unique;
# it goes with the mismatch over v_ref, so that steps are the shorter the less they can be trusted.
_SOFT = (1e-12, 1e-2)
_SOFTENING = 3e3
# The upper bound is what a step lessens the mismatch by, at most. A higher one, times the round-off
# of a large change along the edge of a cone, would be more than the right-hand side is.
_STIFF = 1e2
_TENTH = 0.1  # what a step leaves of the mismatch where Newton's method converges
_PATIENCE = 25  # steps in a row without a new least mismatch, where contacts still change
_ROUNDING = 4.0 * float(np.finfo(float).eps)


class NaturalMap:
    """The pair (p, y) of an impulse, and Newton steps from it."""

    def __init__(self, problem: ConeProblem, gamma: NDArray) -> None:
        """Collective. gamma : (m, columns), inside the cones; not changed."""
        self._problem = problem
        m, columns = shape = problem.b.shape
        self._unit = problem.operator.diagonal()[:, 0].copy()
        self.change, self._g = gamma.copy(), np.empty(shape)
        self.impulse, self._y, self.rest = np.empty(shape), np.empty(shape), np.empty(shape)
        self._blocks = [np.empty((m, columns, columns)) for _ in range(3)]
        self._partial = np.zeros(max(1, math.ceil(m / CHUNK)))
        problem.operator.apply(self.change, self._g)
        self._g += problem.b
        self._decompose()

    def _decompose(self) -> None:
        self._kernel(kernels.decompose)(
            self.change, self._g, self._problem.mu, self._unit, self.impulse, self._y
        )

    def mismatch(self, velocity: NDArray) -> float:
        """Collective. The largest |y - velocity| over v_ref, velocity being N `impulse` + b."""
        worst = self._kernel(kernels.mismatch)(
            self._y, velocity, self._problem.mu, self.rest, self._partial
        )
        impulse = float((self._unit * np.abs(self.impulse).max(axis=1)).max(initial=0.0))
        largest = np.array([worst, impulse])
        largest_of_ranks(largest, self._problem.parallel)
        self._largest = float(largest[1])
        self._velocity = velocity
        return float(largest[0]) / self._problem.velocity_scale

    @property
    def rounding(self) -> float:
        """The mismatch that rounding makes: that of unit times the largest impulse, over v_ref."""
        return _ROUNDING * self._largest / self._problem.velocity_scale

    def blocks(self, mismatch: float) -> list[NDArray]:
        """Q, R and the root of Q of the Newton system, from the `mismatch` last found."""
        low, high = _SOFT
        soft = min(max(_SOFTENING * mismatch, low), high)
        self._kernel(kernels.slopes)(
            self.impulse, self._y, self._problem.mu, self._unit, soft, _STIFF, *self._blocks
        )
        return self._blocks

    def advance(self) -> None:
        """Collective. Add the solution `change` of the Newton system with right-hand side `rest`.

        N (p + dp) + b is made from the product of the step alone, whose rounding is that of dp.
        """
        self._problem.operator.apply(self.change, self._g)
        self._g += self._velocity
        self.change += self.impulse
        self._decompose()

    def _kernel(self, kernel: Any) -> Callable:
        return kernel.using(self._problem.threads)


class Patience:
    """Whether Newton steps are worth going on with."""

    def __init__(self, quick: bool) -> None:
        """quick : only as long as every step leaves a tenth of the mismatch, as near the end."""
        self._quick = quick
        self._least, self._failed = math.inf, 0

    def ends(self, mismatch: float, rounding: float) -> bool:
        """Take the mismatch at a new point; True if that is enough."""
        if not rounding < mismatch < math.inf:
            return True
        if self._quick:
            enough = mismatch > _TENTH * self._least
            self._least = mismatch
            return enough
        self._failed = 0 if mismatch < self._least else self._failed + 1
        self._least = min(self._least, mismatch)
        return self._failed >= _PATIENCE
