"""Restarted GMRES of PETSc on operators that are Python functions.

Preconditioned from the right, so that the residual that is watched is the one of the unchanged
equations (Y. Saad, M. H. Schultz, SIAM J. Sci. Stat. Comput. 7, 1986; flexible: Y. Saad, SIAM J.
Sci. Comput. 14, 1993). Options of PETSc may be given by the user under the prefix `stokes_`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel

PREFIX = "stokes_"
Map = Callable[[NDArray], NDArray]
# Gram-Schmidt is repeated where cancellation asks for it: without that, residuals stall at 1e-12.
_DEFAULTS = {"ksp_gmres_cgs_refinement_type": "refine_ifneeded"}


@dataclass(frozen=True)
class KrylovResult:
    """What an iteration ended with.

    unknown    : this rank's rows
    iterations : of the operator, one application each
    residuals  : |b - A x|_2 / |b|_2 before the first and after every iteration, over all ranks
    converged  : whether the last of them is at most the tolerance
    reason     : PETSc's word for why the iteration ended
    """

    unknown: NDArray
    iterations: int
    residuals: tuple[float, ...]
    converged: bool
    reason: str


class _Shell:
    """A function as PETSc calls it, as a matrix or as a preconditioner."""

    def __init__(self, function: Map) -> None:
        self._function = function

    def mult(self, _: Any, x: Any, y: Any) -> None:
        y.getArray()[:] = self._function(x.getArray(readonly=True))

    def apply(self, pc: Any, x: Any, y: Any) -> None:
        self.mult(pc, x, y)


def gmres(
    operator: Map,
    preconditioner: Map,
    right_hand_side: NDArray,
    tolerance: float,
    max_iterations: int,
    restart: int,
    flexible: bool,
    parallel: Parallel,
) -> KrylovResult:
    """Collective. Solve A x = b from x = 0 until |b - A x|_2 <= tolerance |b|_2.

    operator, preconditioner : from this rank's rows to this rank's rows, collective; the vectors
                they are given must not be kept or changed
    flexible  : the preconditioner may change from call to call
    No convergence within `max_iterations` is a result, not an error. A right-hand side of zeros
    has the solution of zeros, without an iteration.
    """
    b = np.ascontiguousarray(right_hand_side, dtype=np.float64)
    if parallel.max(float(np.abs(b).max(initial=0.0))) == 0.0:
        return KrylovResult(np.zeros_like(b), 0, (0.0,), True, "right-hand side is zero")
    from petsc4py import PETSc

    size, comm = (len(b), None), parallel.communicator
    matrix = PETSc.Mat().createPython((size, size), _Shell(operator), comm=comm)
    solution, rhs = (PETSc.Vec().createMPI(size, comm=comm) for _ in range(2))
    ksp = PETSc.KSP().create(comm)
    try:
        rhs.getArray()[:] = b
        _configure(ksp, matrix, preconditioner, flexible, restart, PETSc)
        ksp.setTolerances(rtol=tolerance, atol=0.0, max_it=max_iterations)
        ksp.setConvergenceHistory(max_iterations + 1)
        ksp.solve(rhs, solution)
        history = np.array(ksp.getConvergenceHistory(), dtype=np.float64)
        reason = ksp.getConvergedReason()
        return KrylovResult(
            unknown=solution.getArray().copy(),
            iterations=ksp.getIterationNumber(),
            residuals=tuple((history / history[0]).tolist()),
            converged=reason > 0,
            reason=_word(reason, ksp),
        )
    finally:
        for made in (ksp, matrix, solution, rhs):
            made.destroy()


def _configure(
    ksp: Any, matrix: Any, preconditioner: Map, flexible: bool, restart: int, petsc: Any
) -> None:
    ksp.setOptionsPrefix(PREFIX)
    ksp.setOperators(matrix)
    ksp.setType(petsc.KSP.Type.FGMRES if flexible else petsc.KSP.Type.GMRES)
    ksp.setGMRESRestart(restart)
    ksp.setPCSide(petsc.PC.Side.RIGHT)
    ksp.setNormType(petsc.KSP.NormType.UNPRECONDITIONED)
    pc = ksp.getPC()
    pc.setType(petsc.PC.Type.PYTHON)
    pc.setPythonContext(_Shell(preconditioner))
    options = petsc.Options()
    missing = [key for key in _DEFAULTS if not options.hasName(PREFIX + key)]
    for key in missing:
        options[PREFIX + key] = _DEFAULTS[key]
    ksp.setFromOptions()
    for key in missing:
        options.delValue(PREFIX + key)


def _word(reason: int, ksp: Any) -> str:
    """PETSc's name of a reason, such as converged_rtol or diverged_its."""
    names = {value: name for name, value in vars(ksp.ConvergedReason).items() if name.isupper()}
    return names.get(reason, str(reason)).lower()
