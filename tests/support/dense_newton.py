"""(N + R) x = s by dense elimination on one rank: the readable twin of `dem_mpi.newton`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem_mpi.cone import Delassus
from dem_mpi.newton import LinearSolve, NewtonFailureError, NewtonOptions
from dem_mpi.parallel import Parallel


class DenseNewton:
    """All of N as an array, in the contact form; rows without an unknown are left out."""

    form = "contact"

    def __init__(
        self,
        operator: Delassus,
        mu: NDArray,
        parallel: Parallel,
        options: NewtonOptions | None = None,
    ) -> None:
        assert parallel.size == 1
        self.factor_entries = 0
        self.take(operator, mu)

    def take(self, operator: Delassus, mu: NDArray) -> bool:
        """Any N will do."""
        shape = operator.diagonal().shape
        self._N = np.empty((shape[0] * shape[1],) * 2)
        column, unit = np.empty(shape), np.zeros(shape)
        for j in range(unit.size):
            unit.flat[j] = 1.0
            operator.apply(unit, column)
            self._N[:, j] = column.ravel()
            unit.flat[j] = 0.0
        free = np.ones(shape, dtype=bool)
        free[:, 1:] = (mu > 0.0)[:, None]
        self._free = free.ravel()
        return True

    def factor(self, Q: NDArray, R: NDArray, root: NDArray | None = None) -> None:
        """N + R on the free rows, scaled to a unit diagonal."""
        A = self._N.copy()
        c = R.shape[1]
        for i, block in enumerate(R):
            A[c * i : c * i + c, c * i : c * i + c] += block
        A = A[np.ix_(self._free, self._free)]
        if not np.isfinite(A).all():
            raise NewtonFailureError("the Newton matrix is not finite")
        self._scale = 1.0 / np.sqrt(np.diag(A))
        self._A = A * self._scale * self._scale[:, None]
        try:
            self._inverse = np.linalg.inv(self._A)
        except np.linalg.LinAlgError:
            raise NewtonFailureError("the Newton matrix is singular") from None
        self.factor_entries = self._A.size

    def solve(self, s: NDArray, out: NDArray, tolerance: float = 1e-10) -> LinearSolve:
        """Solve with one step of refinement."""
        right = s.ravel()[self._free] * self._scale
        x = self._inverse @ right
        x += self._inverse @ (right - self._A @ x)
        size = float(np.linalg.norm(right))
        residual = float(np.linalg.norm(right - self._A @ x)) / size if size else 0.0
        found = np.zeros(s.size)
        found[self._free] = x * self._scale
        out[:] = found.reshape(s.shape)
        return LinearSolve(residual, 1, 0, 0)

    def destroy(self) -> None:
        """Nothing to free."""
