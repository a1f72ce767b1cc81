"""Proximal Newton steps on Coulomb's law: from near a solution to a tighter tolerance.

With k = gamma_n - g_n/d_n and w = gamma_t - g_t/d_t, d the diagonal of N, the law is F(gamma) = 0,

    F = gamma - (max(0, k), w cut to the length mu max(0, k)),      g = N gamma + b

(P. Alart, A. Curnier, Comput. Methods Appl. Mech. Eng. 92, 1991). F is piecewise smooth, with
F' = A + B N and 3 x 3 blocks A, B of each contact that say whether it opens, sticks or slides. A
Newton step solves (N + B^-1 A) dgamma = -B^-1 F, which is not symmetric where contacts slide.

Where N is singular impulses are not unique and F' is so too: steps go to the solution of the
problem with g + alpha d (gamma - centre) in the place of g, the centre moves there, and alpha falls
as long as that succeeds (R. T. Rockafellar, SIAM J. Control Optim. 14, 1976; with friction
V. Acary, M. Bremond, O. Huber, in Advanced Topics in Nonsmooth Dynamics, 2018).
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_solver as kernels
from dem_mpi.cone import ConeProblem, Residuals, Tolerance
from dem_mpi.newton import NewtonFailureError, NewtonOptions, NewtonSystem
from dem_mpi.solvers.coulomb import law_residuals

_ALPHA, _SMALLEST, _LARGEST = 1e-2, 1e-9, 1e2
_DOWN, _UP = 0.3, 3.0  # factors of alpha after a centre found quickly, and after one not found
_QUICKLY, _STEPS = 3, 10  # Newton steps for one centre
_FOUND = 0.1  # |F| over that of the centre at which the centre moves
_WORTH = 0.9  # the same, where steps came to nothing more
_SHORTEST, _DESCENT = 1.0 / 16.0, 1e-2  # of the line search on |F|
# B is singular where a contact opens, or slides along w: in its place this part of d^-1.
_SOFT = 1e-6


@dataclass(frozen=True)
class Found:
    """An impulse in its cones with its N gamma + b, and what it cost.

    Counts of the linear systems are those of a `SolveReport`; their form is "contact".
    """

    impulse: NDArray
    velocity: NDArray
    residuals: Residuals
    merit: float
    factorisations: int = 0
    products: int = 0
    refinements: int = 0
    linear_residual: float = 0.0
    factor_entries: int = 0


class ProximalNewton:
    """Newton steps for one problem after another; keeps the pattern of the matrix N + B^-1 A."""

    def __init__(self) -> None:
        self._system: NewtonSystem | None = None

    def improve(
        self, problem: ConeProblem, gamma: NDArray, tolerance: Tolerance, budget: int
    ) -> Found | None:
        """Collective. The best point by the law's residuals of up to `budget` factorisations.

        gamma : (m, 3), not changed. None where the matrix cannot be laid out; where a system cannot
        be solved the search ends with what it has.
        """
        try:
            system = self._system_for(problem)
        except NewtonFailureError:
            return None
        return _Search(problem, tolerance, system).run(gamma, budget)

    def _system_for(self, problem: ConeProblem) -> NewtonSystem:
        """Collective. The matrix of this problem: of the kept pattern if its graph stands."""
        if self._system is not None and not self._system.take(problem.operator, problem.mu):
            self.destroy()
        if self._system is None:
            options = NewtonOptions(form="contact")
            self._system = NewtonSystem(
                problem.operator, problem.mu, problem.parallel, options, symmetric=False
            )
        return self._system

    def destroy(self) -> None:
        """Collective. Free the matrix."""
        if self._system is not None:
            self._system.destroy()
            self._system = None


class _Search:
    """The search from one point. Decisions are taken from numbers alike on all ranks."""

    def __init__(self, problem: ConeProblem, tolerance: Tolerance, system: NewtonSystem) -> None:
        self._problem, self._tolerance, self._system = problem, tolerance, system
        diagonal = problem.operator.diagonal()
        self._d = diagonal.copy()
        self._d[:, 1:] = diagonal[:, 1:].mean(axis=1, keepdims=True)
        self._factorisations = self._products = self._refinements = 0
        self._linear_residual = 0.0
        self._best: Found | None = None

    def run(self, gamma: NDArray, budget: int) -> Found:
        """Collective. Follow the centres; the best point, with what all of them cost."""
        self._judge(gamma)
        with suppress(NewtonFailureError):
            self._follow(gamma, budget)
        return replace(
            self._best,
            factorisations=self._factorisations,
            products=self._products,
            refinements=self._refinements,
            linear_residual=self._linear_residual,
            factor_entries=self._system.factor_entries if self._factorisations else 0,
        )

    def _follow(self, gamma: NDArray, budget: int) -> None:
        """Collective. Move the centre from `gamma` until the tolerance or the budget is met."""
        centre, alpha = gamma, _ALPHA
        while self._factorisations < budget and not self._solved():
            start = self._norm(self._map(centre, self._velocity(centre))[0])
            if not 0.0 < start < math.inf:
                break
            x, end, steps = self._approach(centre, alpha, start, budget)
            if end <= _FOUND * start:
                centre = x
                alpha = max(_DOWN * alpha, _SMALLEST) if steps <= _QUICKLY else alpha
            else:
                centre = x if end <= _WORTH * start else centre
                alpha *= _UP
                if alpha > _LARGEST:
                    break

    def _approach(
        self, centre: NDArray, alpha: float, start: float, budget: int
    ) -> tuple[NDArray, float, int]:
        """Collective. Newton steps to the centre's proximal point: where, |F| there, how many."""
        x, g, size = centre, self._velocity(centre), start
        for step in range(_STEPS):
            if size <= _FOUND * start or self._factorisations >= budget:
                return x, size, step
            shifted = g + alpha * self._d * (x - centre)
            change = self._direction(x, shifted, alpha)
            dg = self._velocity(change) - self._problem.b
            length = 1.0
            while True:
                y, gy = x + length * change, g + length * dg
                F, _ = self._map(y, gy + alpha * self._d * (y - centre))
                found = self._norm(F)
                if found <= (1.0 - _DESCENT * length) * size:
                    break
                length *= 0.5
                if not length >= _SHORTEST:
                    return x, size, step
            x, g, size = y, gy, found
            self._judge(x)
            if self._solved():
                return x, size, step + 1
        return x, size, _STEPS

    def _direction(self, x: NDArray, g: NDArray, alpha: float) -> NDArray:
        """Collective. The Newton step at x, with g of the proximal problem."""
        F, (k, w, radius, length) = self._map(x, g)
        inverse, A = self._slopes(k, w, radius, length)
        R = inverse @ A
        for j in range(3):
            R[:, j, j] += alpha * self._d[:, j]
        s = -np.einsum("iab,ib->ia", inverse, F)
        self._system.factor(R, R, R)
        self._factorisations += 1
        change = np.empty_like(x)
        done = self._system.solve(s, change)
        self._products += done.products
        self._refinements += done.refinements
        self._linear_residual = max(self._linear_residual, done.residual)
        return change

    def _map(self, x: NDArray, g: NDArray) -> tuple[NDArray, tuple[NDArray, ...]]:
        """F (m, 3), and k, w, the cut's radius and |w|."""
        z = x - g / self._d
        k, w = z[:, 0], z[:, 1:]
        radius = self._problem.mu * np.maximum(k, 0.0)
        length = np.hypot(w[:, 0], w[:, 1])
        cut = np.divide(radius, length, out=np.ones_like(length), where=length > radius)
        F = np.empty_like(x)
        F[:, 0] = x[:, 0] - np.maximum(k, 0.0)
        F[:, 1:] = x[:, 1:] - cut[:, None] * w
        F[self._problem.mu == 0.0, 1:] = 0.0
        return F, (k, w, radius, length)

    def _slopes(
        self, k: NDArray, w: NDArray, radius: NDArray, length: NDArray
    ) -> tuple[NDArray, NDArray]:
        """B^-1, softened where B is singular, and A: F' = A + B N. Both (m, 3, 3)."""
        m, mu = len(k), self._problem.mu
        closed = k > 0.0
        slides = closed & (length > radius)
        A, B = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
        for j in range(3):
            A[:, j, j] = ~closed
            B[:, j, j] = np.where(closed, 1.0, _SOFT) / self._d[:, j]
        e = w[slides] / length[slides, None]
        along = e[:, :, None] * e[:, None, :]
        turn = (radius[slides] / length[slides])[:, None, None] * (np.eye(2) - along)
        A[slides, 1:, 1:] = np.eye(2) - turn
        A[slides, 1:, 0] = -mu[slides, None] * e
        B[slides, 1:, 1:] = (turn + _SOFT * np.eye(2)) / self._d[slides, 1, None, None]
        B[slides, 1:, 0] = mu[slides, None] * e / self._d[slides, 0, None]
        return np.linalg.inv(B), A

    def _velocity(self, x: NDArray) -> NDArray:
        """Collective. N x + b."""
        g = np.empty_like(x)
        self._problem.operator.apply(x, g)
        g += self._problem.b
        self._products += 1
        return g

    def _norm(self, F: NDArray) -> float:
        """Collective. |F| with the weights d; infinite where it is not a number, on all ranks."""
        size = math.sqrt(self._problem.parallel.sum(float(np.sum(self._d * F * F))))
        return size if math.isfinite(size) else math.inf

    def _judge(self, x: NDArray) -> None:
        """Collective. Keep x, brought into its cones, if its merit is the least."""
        gamma = x.copy()
        kernels.project.using(self._problem.threads)(gamma, self._problem.mu)
        g = self._velocity(gamma)
        residuals = law_residuals(self._problem, gamma, g)
        merit = self._tolerance.merit(residuals, self._problem) if residuals.finite else math.inf
        if self._best is None or merit < self._best.merit:
            self._best = Found(gamma, g, residuals, merit)

    def _solved(self) -> bool:
        return self._best is not None and self._best.merit <= 1.0
