"""What every solver returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from numpy.typing import NDArray

from dem_mpi.cone import Residuals


@dataclass(frozen=True)
class SolveReport:
    """The outcome of one solve; `converged` is never implied by the absence of an error.

    impulse  : (m, columns) [N s], inside the cones
    velocity : (m, columns) [m/s], g = N impulse + b from a fresh product
    history  : (k, 4) iteration, dual residual [m/s], complementarity [J], objective [J]
    lipschitz: last step-size constant, a starting value for the next problem of its kind
    """

    impulse: NDArray
    velocity: NDArray
    residuals: Residuals
    iterations: int
    products: int
    factorisations: int
    history: NDArray
    seconds: Mapping[str, float]
    converged: bool
    reason: str
    lipschitz: float
