"""What preconditioners.py measures: systems K u = D Q s of an interior point solve, by CG.

K is scaled by the masses on both sides, as `NewtonSystem` has it for conjugate gradients. One rank.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from contact import load
from numpy.typing import NDArray

from dem_mpi.cone import Tolerance
from dem_mpi.newton import LinearSolve, NewtonOptions, NewtonSystem, _ContactVelocityMatrix
from dem_mpi.parallel import Parallel
from dem_mpi.solvers.scip import Scip, ScipOptions

PREFIX = "trial_"
MAX_ITERATIONS = 3000
CPU_LIMIT = 20.0  # s of one solve, in which 16,000 spheres are factorised six times
_NORM_OF_N = 3.0  # over the largest entry of its diagonal, as in dem_mpi.newton
_BLR, _BLR_TOLERANCE = 35, 7  # MUMPS's numbers: ICNTL of low rank, CNTL of what is dropped
_ORDERING_CHOSEN_BY_MUMPS = {"mat_mumps_icntl_7": "7"}
_SHIFT = {"pc_factor_shift_type": "positive_definite"}


@dataclass(frozen=True)
class Candidate:
    """A preconditioner as PETSc options, or a factor by MUMPS.

    factor   : "exact", "low rank" or "earlier" (exact, of the iteration before); None if by options
    dropped  : relative size of what low rank leaves out
    package  : what PETSc must have been built with
    largest  : spheres up to which it is measured
    """

    name: str
    options: dict[str, str] = field(default_factory=dict)
    factor: str | None = None
    dropped: float | None = None
    package: str | None = None
    largest: float = math.inf


EXACT = "exact factor"
CANDIDATES = (
    Candidate(EXACT, factor="exact"),
    Candidate("block Jacobi 6×6", {"pc_type": "pbjacobi"}),
    Candidate("ICC(0)", {"pc_type": "icc", **_SHIFT}),
    Candidate("ICC(1)", {"pc_type": "icc", "pc_factor_levels": "1", **_SHIFT}),
    Candidate(
        "ASM, 16 exact blocks",
        {
            "pc_type": "asm", "pc_asm_blocks": "16", "pc_asm_type": "basic",
            "sub_pc_type": "cholesky", "sub_pc_factor_mat_ordering_type": "nd",
        },
        largest=2000,
    ),
    Candidate(
        "BoomerAMG",
        {
            "pc_type": "hypre", "pc_hypre_type": "boomeramg",
            "pc_hypre_boomeramg_strong_threshold": "0.5",
            "pc_hypre_boomeramg_relax_type_all": "symmetric-SOR/Jacobi",
        },
        package="hypre",
    ),
    Candidate(
        "GAMG, rigid-body modes",
        {"pc_type": "gamg", "pc_gamg_threshold": "0.0", "mg_levels_pc_type": "sor"},
    ),
    Candidate("low rank 10⁻²", factor="low rank", dropped=1e-2),
    Candidate("low rank 10⁻⁴", factor="low rank", dropped=1e-4),
    Candidate("factor of the iteration before", factor="earlier"),
)  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """One candidate on one system; CPU seconds.

    first      : of the first set-up, what depends on the pattern alone included
    set_up     : of another one with the pattern known, as in every later iteration of a solve
    iterations, seconds : of conjugate gradients to each tolerance, None where not reached
    spent      : iterations when it ended
    broken     : it ended because the preconditioner, by rounding or what it drops, is not positive
                 definite
    entries    : of the factor; None where there is none
    """

    name: str
    first: float
    set_up: float
    iterations: list[int | None]
    seconds: list[float | None]
    spent: int
    broken: bool
    entries: int | None


def missing() -> dict[str, str]:
    """The candidates that this PETSc cannot make, and what it lacks."""
    from petsc4py import PETSc

    return {
        c.name: c.package
        for c in CANDIDATES
        if c.package and not PETSc.Sys.hasExternalPackage(c.package)
    }


def measure(
    parallel: Parallel,
    checkpoint: Path,
    chosen: Sequence[int],
    tolerance: float,
    tolerances: Sequence[float],
) -> dict[str, Any]:
    """Solve the problem of a state to `tolerance` [m/s]; trials at the chosen iterations, from 1.

    tolerances : relative residuals of the Newton system that conjugate gradients are timed to
    """
    simulation = load(parallel, checkpoint)
    problem, guess = simulation.pose()
    systems: list[_TriedSystem] = []

    def make_system(
        operator: Any, mu: NDArray, parallel: Parallel, options: NewtonOptions
    ) -> NewtonSystem:
        modes = _rigid_body_modes(simulation.state.bodies.position)
        systems.append(
            _TriedSystem(operator, mu, parallel, options, chosen, tuple(tolerances), modes)
        )
        return systems[-1]

    stop = Tolerance(tolerance, relative_work=tolerance / problem.velocity_scale)
    solver = Scip(ScipOptions(stop, newton=NewtonOptions(form="velocity")), make_system)
    report = solver.solve(problem, np.zeros_like(guess))
    found = {
        "spheres": len(simulation.state.bodies),
        "contacts": problem.contacts,
        "iterations": report.iterations,
        "converged": report.converged,
        "solves": systems[0].solves / max(1, systems[0].iteration),
        "rows": [row for system in systems for row in system.rows],
    }
    solver.destroy()
    simulation.destroy()
    return found


class _TriedSystem(NewtonSystem):
    """A Newton system that shows some of its matrices, with their right-hand sides, to others."""

    def __init__(
        self,
        operator: Any,
        mu: NDArray,
        parallel: Parallel,
        options: NewtonOptions,
        chosen: Sequence[int],
        tolerances: tuple[float, ...],
        modes: NDArray,
    ) -> None:
        """`modes` : (k, n, block) velocities of rigid motions."""
        super().__init__(operator, mu, parallel, options)
        self._operator = operator
        self._chosen, self._tolerances = frozenset(chosen), tolerances
        self._velocity = _ContactVelocityMatrix(operator, parallel)
        self._scale = self._velocity.root_inverse_mass()
        self._modes = modes
        self._earlier: Any = None
        self.rows: list[dict[str, Any]] = []
        self.iteration = self.solves = 0

    def take(self, operator: Any, mu: NDArray) -> bool:
        """Stand for one problem alone."""
        return False

    def factor(self, Q: NDArray, R: NDArray, root: NDArray | None = None) -> None:
        super().factor(Q, R, root)
        self.iteration += 1
        self._fresh: NDArray | None = Q

    def solve(self, s: NDArray, out: NDArray, tolerance: float = 1e-10) -> LinearSolve:
        self.solves += 1
        if self._fresh is not None and {self.iteration, self.iteration + 1} & self._chosen:
            self._try(self._fresh, s)
        self._fresh = None
        return super().solve(s, out, tolerance)

    def _try(self, Q: NDArray, s: NDArray) -> None:
        """Measure all candidates if this iteration is chosen; keep its matrix for the next."""
        matrix = self._matrix_for(Q)
        if self.iteration in self._chosen:
            b = matrix.createVecLeft()
            impulse = self._operator.body_impulse(np.einsum("mij,mj->mi", Q, s))
            b.getArray()[:] = impulse.ravel()
            b.pointwiseMult(b, self._scale)
            diagonal = self._operator.diagonal()
            size = np.linalg.norm(s) / math.sqrt(_NORM_OF_N * diagonal.max())
            goals = [tolerance * float(size) for tolerance in self._tolerances]
            spread = np.linalg.eigvalsh(Q) * diagonal.max(axis=1)[:, None]
            trials = [
                trial(candidate, matrix, self._earlier, b, goals)
                for candidate in CANDIDATES
                if candidate.name not in missing() and len(self._modes[0]) <= candidate.largest
            ]
            self.rows.append(
                {
                    "iteration": self.iteration,
                    "least": float(spread.min()),
                    "most": float(spread.max()),
                    "trials": [vars(one) for one in trials if one],
                }
            )
            b.destroy()
        if self._earlier is not None:
            self._earlier.destroy()
        self._earlier = matrix

    def _matrix_for(self, Q: NDArray) -> Any:
        """A new matrix M^-1/2 K M^-1/2 with the rigid motions as its near-null space."""
        from petsc4py import PETSc

        self._velocity.fill(Q)
        matrix = self._velocity.matrix.copy()
        matrix.diagonalScale(self._scale, self._scale)
        matrix.setBlockSize(self._velocity.block)
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        scale = self._scale.getArray(readonly=True)
        orthonormal = np.linalg.qr((self._modes.reshape(len(self._modes), -1) / scale).T)[0]
        vectors = []
        for column in orthonormal.T:
            vectors.append(matrix.createVecLeft())
            vectors[-1].getArray()[:] = column
        space = PETSc.NullSpace().create(vectors=vectors, comm=matrix.getComm())
        matrix.setNearNullSpace(space)
        for item in (space, *vectors):
            item.destroy()
        return matrix

    def destroy(self) -> None:
        for item in (self._velocity, self._scale, self._earlier):
            if item is not None:
                item.destroy()
        super().destroy()


def _rigid_body_modes(position: NDArray) -> NDArray:
    """Velocities (6, n, 6) of unit translations and rotations about the centre."""
    arm = position - position.mean(axis=0)
    modes = np.zeros((6, len(arm), 6))
    for axis in range(3):
        unit = np.eye(3)[axis]
        modes[axis, :, axis] = 1.0
        modes[3 + axis, :, :3] = np.cross(unit, arm)
        modes[3 + axis, :, 3 + axis] = 1.0
    return modes


# ---- one candidate -------------------------------------------------------------------------


def trial(
    candidate: Candidate, matrix: Any, earlier: Any, b: Any, goals: Sequence[float]
) -> Trial | None:
    """Set a candidate up and run conjugate gradients with it; None if it has no earlier matrix."""
    from petsc4py import PETSc

    if candidate.factor == "earlier" and earlier is None:
        return None
    source = earlier if candidate.factor == "earlier" else matrix
    options = _ORDERING_CHOSEN_BY_MUMPS if candidate.factor else candidate.options
    database = PETSc.Options(PREFIX)
    ksp, x = PETSc.KSP().create(matrix.getComm()), b.duplicate()
    for key, value in options.items():
        database[key] = value
    try:
        ksp.setOptionsPrefix(PREFIX)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setOperators(matrix, source)
        if candidate.factor:
            _choose_mumps(ksp.getPC(), candidate, source.getBlockSize(), PETSc)
        ksp.setFromOptions()
        first = _cpu_seconds(lambda: _set_up(ksp))
        _renew(source)
        ksp.setOperators(matrix, source)
        set_up = _cpu_seconds(lambda: _set_up(ksp))
        if candidate.factor == "earlier":
            set_up = 0.0  # it is there already
        iterations, seconds = _iterate(ksp, b, x, goals, PETSc)
        spent = ksp.getIterationNumber()
        broken = ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC
        entries = _entries(ksp.getPC(), candidate)
    finally:
        for key in options:
            database.delValue(key)
        ksp.destroy()
        x.destroy()
    return Trial(candidate.name, first, set_up, iterations, seconds, spent, broken, entries)


def _choose_mumps(pc: Any, candidate: Candidate, block: int, petsc: Any) -> None:
    """The options of dem_mpi.linear_solvers.Direct and LowRank."""
    pc.setType(petsc.PC.Type.CHOLESKY)
    pc.setFactorSolverType(petsc.Mat.SolverType.MUMPS)
    pc.setFactorSetUpSolverType()
    factor = pc.getFactorMatrix()
    factor.setOptionsPrefix(PREFIX)
    factor.setMumpsIcntl(28, 1)
    factor.setMumpsIcntl(15, -block)
    if candidate.dropped:
        factor.setMumpsIcntl(_BLR, 2)
        factor.setMumpsCntl(_BLR_TOLERANCE, candidate.dropped)


def _renew(matrix: Any) -> None:
    """Have PETSc take the values for new ones, which they are not."""
    matrix.scale(2.0)
    matrix.scale(0.5)
    matrix.setOption(matrix.Option.SPD, True)


def _set_up(ksp: Any) -> None:
    ksp.setUp()
    ksp.setUpOnBlocks()  # else blocks are factorised by the first iteration


def _cpu_seconds(work: Callable[[], None]) -> float:
    began = process_time()
    work()
    return process_time() - began


def _iterate(
    ksp: Any, b: Any, x: Any, goals: Sequence[float], petsc: Any
) -> tuple[list[int | None], list[float | None]]:
    """Iterate from zero until the last of the falling goals |b - K x|, or a limit, is reached.

    Returns iterations and CPU seconds to each goal.
    """
    reason = petsc.KSP.ConvergedReason
    iterations: list[int | None] = [None] * len(goals)
    seconds: list[float | None] = [None] * len(goals)
    began = process_time()

    def watch(_ksp: Any, iteration: int, residual: float) -> Any:
        spent = process_time() - began
        for k, goal in enumerate(goals):
            if residual <= goal and iterations[k] is None:
                iterations[k], seconds[k] = iteration, spent
        if iterations[-1] is not None:
            return reason.CONVERGED_ATOL
        if not math.isfinite(residual):
            return reason.DIVERGED_NANORINF
        over = iteration >= MAX_ITERATIONS or spent > CPU_LIMIT
        return reason.DIVERGED_MAX_IT if over else reason.CONVERGED_ITERATING

    ksp.setTolerances(max_it=MAX_ITERATIONS)
    ksp.setConvergenceTest(watch)
    ksp.solve(b, x)
    return iterations, seconds


def _entries(pc: Any, candidate: Candidate) -> int | None:
    """Non-zeros of the factor or factors: what low rank has left of them."""
    if candidate.factor:
        count = pc.getFactorMatrix().getMumpsInfog(_BLR if candidate.dropped else 29)
        return count if count >= 0 else -1_000_000 * count  # MUMPS: negative are millions
    if pc.getType() == "icc":
        parts = [pc]
    elif pc.getType() == "asm":
        parts = [ksp.getPC() for ksp in pc.getASMSubKSP()]
    else:
        return None
    return int(sum(part.getFactorMatrix().getInfo()["nz_used"] for part in parts))
