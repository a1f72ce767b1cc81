"""Solvers for one symmetric matrix after another of the same pattern: MUMPS, and PETSc's CG.

Both are PETSc KSP objects with the options prefix `scip_`. The matrix is refilled by its owner;
`set_up` takes its new values and keeps what depends on the pattern alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

from dem_mpi.errors import DemError
from dem_mpi.parallel import Parallel

PREFIX = "scip_"
Ordering = Literal["auto", "amd", "metis", "scotch", "pord"]
Preconditioner = Literal["block_jacobi", "icc", "low_rank"]

# MUMPS numbers its orderings (its users' guide, ICNTL(7)).
_ORDERINGS = {"amd": 0, "scotch": 3, "pord": 4, "metis": 5, "auto": 7}
# Errors that more working space cures (INFOG(1)): integer and real space of the factorisation.
_TOO_LITTLE_SPACE = (-8, -9, -14, -15, -17, -20)
# Errors that say that memory is short, and INFOG(2) how much: entries, or -millions of them.
_NO_MEMORY = (-5, -7, -13, -19)
_RETRY_FACTOR = 4  # times as much extra space, once, and at least
_RETRY_WORKSPACE = 100  # [%]
_MEGABYTE = 1e6
_ITERATIONS = 10_000  # of conjugate gradients, at most, for one right-hand side
_DROPPED = 1e-2  # relative size of what a low-rank factor leaves out (CNTL(7))
_SMALLEST_RELATIVE = 1e-16  # below it no residual falls
# Memory of MUMPS's analysis on rank 0: row and column of each entry of one triangle, read from all
# ranks, and about as much again for the graph that is ordered [B per entry of the matrix].
_ANALYSIS_BYTES = 12.0
_FEW_ROWS = 60  # of which any order of elimination is as good
_LARGEST_LIMIT = 2**31 - 1  # [MB] that ICNTL(23) can hold


class NewtonFailureError(DemError):
    """A Newton system could not be solved; the text says what failed and which key may help."""


@dataclass(frozen=True)
class DirectOptions:
    """Options of MUMPS.

    ordering  : of the elimination; "auto" lets MUMPS choose; tiny or nearly full matrices, where
                it is of no consequence, always take AMD
    workspace : extra working space of the factorisation [%] (ICNTL(14))
    memory    : limit of MUMPS's memory on each rank [MB] (ICNTL(23)); None for no limit
    """

    ordering: Ordering = "auto"
    workspace: int = 35
    memory: float | None = None


class LinearSolver(Protocol):
    """Solves K x = b for the present values of K."""

    entries: int  # non-zeros of the factor, 0 if there is none
    memory: float  # [B] of all ranks together
    retries: int  # factorisations that had to be repeated with more working space

    def set_up(self) -> None:
        """Collective. Take the matrix's new values. NewtonFailureError on all ranks."""

    def solve(self, b: Any, x: Any, goal: float) -> int:
        """Collective. x = K^-1 b, PETSc vectors; return the iterations spent, 0 if direct.

        goal : |b - K x| at which an iteration may stop; a direct solver has no use for it
        """

    def destroy(self) -> None:
        """Collective. Free the PETSc objects."""


class Direct:
    """MUMPS: Cholesky where the matrix is marked SPD, LDL^T if symmetric, else LU.

    Analysis on rank 0 alone: MUMPS 5.5's parallel one can end in wrong numbers without an error.
    """

    def __init__(
        self, matrix: Any, block: int, symmetric: bool, options: DirectOptions, parallel: Parallel
    ) -> None:
        """Collective. `block` rows belong together: the graph is analysed by blocks."""
        self._matrix, self._block, self._symmetric = matrix, block, symmetric
        self._options, self._parallel = options, parallel
        self._workspace = options.workspace
        self.entries, self.memory, self.retries, self.analyses = 0, 0.0, 0, 0
        self._ksp: Any = None
        self._check_analysis_memory()

    def _check_analysis_memory(self) -> None:
        limit = self._options.memory
        if limit is None:
            return
        entries = self._matrix.getInfo(self._matrix.InfoType.GLOBAL_SUM)["nz_used"]
        needed = _ANALYSIS_BYTES * entries / _MEGABYTE
        if needed > limit:
            raise NewtonFailureError(
                f"MUMPS cannot analyse the Newton matrix: its {entries:.3g} entries need about "
                f"{_megabytes(needed)} MB on rank 0, and contact.scip.memory allows {limit:g} MB: "
                f"raise it, or set contact.scip.linear: cg"
            )

    def _create(self) -> None:
        from petsc4py import PETSc

        self._ksp = PETSc.KSP().create(self._parallel.communicator)
        self._ksp.setOptionsPrefix(PREFIX)
        self._ksp.setOperators(self._matrix)
        self._choose_method(PETSc)
        pc = self._ksp.getPC()
        pc.setType(PETSc.PC.Type.CHOLESKY if self._symmetric else PETSc.PC.Type.LU)
        pc.setFactorSolverType(PETSc.Mat.SolverType.MUMPS)
        pc.setFactorSetUpSolverType()
        factor = pc.getFactorMatrix()
        factor.setOptionsPrefix(PREFIX)
        factor.setMumpsIcntl(28, 1)
        factor.setMumpsIcntl(14, self._workspace)
        if self._block > 1 and self._symmetric:
            factor.setMumpsIcntl(15, -self._block)
        if self._options.memory is not None:
            limit = min(max(1.0, self._options.memory), _LARGEST_LIMIT)
            factor.setMumpsIcntl(23, int(limit))
        self._adjust(factor)
        self._ksp.setFromOptions()
        self.analyses += 1
        # PETSC_OPTIONS of the user go first. PETSc sets this one anew when it starts MUMPS, by the
        # first set-up, so that it can only be given as an option, and is taken back after that.
        options, key = PETSc.Options(), f"{PREFIX}mat_mumps_icntl_7"
        given = options.hasName(key)
        if not given:
            options[key] = _ORDERINGS[self._ordering()]
        self._ksp.setUp()
        if not given:
            options.delValue(key)

    def _ordering(self) -> Ordering:
        """Collective. The ordering asked for, or AMD where it is of no consequence.

        PORD calls exit() on a graph in which every vertex is joined to every other: with fewer
        than two classes of vertices there is nothing to separate. A single contact or pair makes
        such a graph, and so do all contacts of one large body. MUMPS may take PORD of its own
        accord, in place of an ordering that it was built without, too. From half full on (of an
        unsymmetric matrix one triangle may be the whole graph) all orders fill the factor alike.
        """
        rows = self._matrix.getSize()[0]
        entries = self._matrix.getInfo(self._matrix.InfoType.GLOBAL_SUM)["nz_used"]
        if rows <= _FEW_ROWS or 2.0 * entries >= rows * (rows + 1.0):
            return "amd"
        return self._options.ordering

    def _choose_method(self, petsc: Any) -> None:
        self._ksp.setType(petsc.KSP.Type.PREONLY)

    def _adjust(self, factor: Any) -> None:
        """Change what differs in a derived class."""

    def set_up(self) -> None:
        """Collective. Factorise; a first time, analyse too. Once more if the space ran out."""
        error = self._factorise()
        if error in _TOO_LITTLE_SPACE and self._options.memory is None:
            # PETSc does not factorise again with a factor that failed: begin anew.
            self._workspace = max(_RETRY_WORKSPACE, _RETRY_FACTOR * self._workspace)
            self.retries += 1
            self.destroy()
            error = self._factorise()
        if error < 0:
            message = self._sentence(error)
            self.destroy()
            raise NewtonFailureError(message)
        factor = self._ksp.getPC().getFactorMatrix()
        self.entries = _count(factor.getMumpsInfog(29))
        self.memory = factor.getMumpsInfog(22) * _MEGABYTE

    def _factorise(self) -> int:
        if self._ksp is None:
            self._create()
        else:
            # Tells PETSc that the values are new; it sees itself that the pattern is not.
            self._ksp.setOperators(self._matrix)
            self._ksp.setUp()
        return self._ksp.getPC().getFactorMatrix().getMumpsInfog(1)

    def _sentence(self, error: int) -> str:
        """What MUMPS's error means to who runs the scene."""
        factor = self._ksp.getPC().getFactorMatrix()
        detail, wanted = factor.getMumpsInfog(2), factor.getMumpsInfog(16)
        rows = self._matrix.getSize()[0]
        what = f"MUMPS could not factorise the Newton matrix of {rows} rows"
        code = f"(INFOG(1) = {error}, INFOG(2) = {detail})"
        if error in _TOO_LITTLE_SPACE or error in _NO_MEMORY:
            phase = "analysis" if error in (-5, -7) else "factorisation"
            return f"{what}: too little memory in the {phase}; {self._remedy(error, wanted)} {code}"
        if error in (-10, -40):
            return (
                f"{what}: it is singular to working precision, or not positive definite; "
                f"contact.scip.form: velocity is the form that stays definite {code}"
            )
        if error in (-38, -39):
            return f"{what}: this MUMPS was built without the ordering asked for {code}"
        return f"{what}: error {error} of MUMPS, see INFOG(1) in its users' guide {code}"

    def _remedy(self, error: int, wanted: int) -> str:
        """What was allowed and what to do; MUMPS's estimate `wanted` [MB] is 0 where it has none.

        The estimate is rounded, and of a small matrix it leaves out what MUMPS needs beside it: it
        may lie below the limit that was not enough.
        """
        limit = self._options.memory
        asks = f"it asks for {wanted} MB on the fullest rank, " if wanted > 0 else ""
        if limit is not None:
            least = f" to {wanted} or more" if wanted > limit else ""
            remedy = f"contact.scip.memory = {limit:g} MB a rank is not enough: raise it{least}"
        elif error in _NO_MEMORY:
            remedy = f"{asks}the machine has less: use more ranks on more nodes"
        else:
            remedy = f"{asks}contact.scip.workspace of {self._workspace} % was too little: raise it"
        return f"{remedy}, try another contact.scip.ordering, or set contact.scip.linear: cg"

    def solve(self, b: Any, x: Any, goal: float) -> int:
        """Collective. x = K^-1 b by two triangular solves."""
        self._ksp.solve(b, x)
        return 0

    def destroy(self) -> None:
        """Collective. Free the factor."""
        if self._ksp is not None:
            self._ksp.destroy()
            self._ksp = None


class LowRank(Direct):
    """Conjugate gradients with an approximate factor: blocks of low rank up to a tolerance.

    Far blocks of the factor are compressed; it has fewer entries and operations than an exact one,
    the more so the larger it is, and a few iterations make up for what was dropped.
    """

    def _choose_method(self, petsc: Any) -> None:
        self._ksp.setType(petsc.KSP.Type.CG)
        self._ksp.setNormType(petsc.KSP.NormType.UNPRECONDITIONED)

    def _adjust(self, factor: Any) -> None:
        factor.setMumpsIcntl(35, 2)
        factor.setMumpsCntl(7, _DROPPED)

    def set_up(self) -> None:
        """Collective. As of an exact factor; `entries` are those left."""
        super().set_up()
        self.entries = _count(self._ksp.getPC().getFactorMatrix().getMumpsInfog(35))

    def solve(self, b: Any, x: Any, goal: float) -> int:
        """Collective. Iterate from zero; what is missing at the end, the caller's residual says."""
        return _iterate(self._ksp, b, x, goal)


class Iterative:
    """Conjugate gradients, of a matrix marked SPD, with a preconditioner of few operations.

    The residual it stops at is the plain one, |b - K x|: give it a matrix whose rows have one unit.
    """

    entries, memory, retries = 0, 0.0, 0

    def __init__(self, matrix: Any, preconditioner: Preconditioner, parallel: Parallel) -> None:
        """Collective."""
        from petsc4py import PETSc

        self._matrix = matrix
        self._ksp = PETSc.KSP().create(parallel.communicator)
        self._ksp.setOptionsPrefix(PREFIX)
        self._ksp.setType(PETSc.KSP.Type.CG)
        self._ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        self._ksp.setOperators(matrix)
        pc = self._ksp.getPC()
        if preconditioner == "block_jacobi":
            pc.setType(PETSc.PC.Type.PBJACOBI)
        else:
            _choose_incomplete_cholesky(pc, PETSc)
        self._ksp.setFromOptions()

    def set_up(self) -> None:
        """Collective. Make the preconditioner for the matrix's present values."""
        self._ksp.setOperators(self._matrix)
        self._ksp.setUp()

    def solve(self, b: Any, x: Any, goal: float) -> int:
        """Collective. Iterate from zero; what is missing at the end, the caller's residual says."""
        return _iterate(self._ksp, b, x, goal)

    def destroy(self) -> None:
        """Collective. Free the PETSc objects."""
        self._ksp.destroy()


def _iterate(ksp: Any, b: Any, x: Any, goal: float) -> int:
    """Collective. Run conjugate gradients to |b - K x| <= goal; return the iterations."""
    ksp.setTolerances(rtol=_SMALLEST_RELATIVE, atol=goal, max_it=_ITERATIONS)
    ksp.solve(b, x)
    reasons = ksp.ConvergedReason
    if ksp.getConvergedReason() in (reasons.DIVERGED_NANORINF, reasons.DIVERGED_PCSETUP_FAILED):
        raise NewtonFailureError(
            "the conjugate gradients of a Newton system broke down: set contact.scip.linear: "
            "mumps, or another contact.scip.preconditioner"
        )
    return ksp.getIterationNumber()


def _choose_incomplete_cholesky(pc: Any, petsc: Any) -> None:
    """Block Jacobi with a block a rank, of each an incomplete Cholesky factor without fill."""
    pc.setType(petsc.PC.Type.BJACOBI)
    options = petsc.Options()
    given = {"sub_pc_type": "icc", "sub_pc_factor_shift_type": "positive_definite"}
    given = {f"{PREFIX}{key}": value for key, value in given.items()}
    missing = [key for key in given if not options.hasName(key)]
    for key in missing:
        options[key] = given[key]
    pc.setFromOptions()
    pc.setUp()
    for key in missing:
        options.delValue(key)


def _count(infog: int) -> int:
    """A count as MUMPS gives it: negative numbers are millions."""
    return infog if infog >= 0 else -infog * 1_000_000


def _megabytes(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"
