"""What every solver takes and returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from numpy.typing import NDArray

from dem_mpi.cone import ConeProblem, Residuals, Tolerance


@dataclass(frozen=True)
class SolveReport:
    """The outcome of one solve; `converged` is never implied by the absence of an error.

    impulse  : (m, columns) [N s], inside the cones
    velocity : (m, columns) [m/s], g = N impulse + b from a fresh product
    history  : (k, 4) iteration, dual residual [m/s], weighted work [J], objective [J]
    lipschitz: last step-size constant of APGD, a starting value for the next problem of its kind
    solver   : the method that made the impulse, "apgd" or "scip"
    outer    : cone problems solved in turn; more than one only under Coulomb's law
    form, factor_entries, linear_residual, refinements, linear_iterations : of the Newton systems,
               where there are any: the unknowns chosen ("velocity" or "contact"), non-zeros of the
               factor, the worst relative residual, the refinement steps spent to reach it, and the
               iterations of conjugate gradients, 0 for a direct solver
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
    solver: str = "apgd"
    outer: int = 1
    form: str = ""
    factor_entries: int = 0
    linear_residual: float = 0.0
    refinements: int = 0
    linear_iterations: int = 0


class Solver(Protocol):
    """A method for the cone complementarity problem."""

    def solve(
        self,
        problem: ConeProblem,
        guess: NDArray,
        lipschitz: float | None = None,
        tolerance: Tolerance | None = None,
    ) -> SolveReport:
        """Collective. Solve from `guess` (m, columns) [N s], which is taken over, not copied.

        `tolerance` takes the place of the one in the solver's options for this problem.
        """

    def destroy(self) -> None:
        """Collective. Free what is kept between solves."""
