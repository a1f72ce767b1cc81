"""N of a problem that comes as sparse matrices: W itself, or W = H^T M^-1 H by its factors.

Rows of W and H^T are contacts, 3 each (normal, tangent 1, tangent 2); rows of M are velocity
components. A rank holds the rows it owns; all matrices are PETSc objects that `destroy` frees.

Symbols: r impulse; u contact velocity; p = H r momentum and v = M^-1 p velocity of the bodies.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from petsc4py import PETSc

from dem_mpi.errors import DataError, DemError
from dem_mpi.fclib import COLUMNS, FclibProblem, Share
from dem_mpi.parallel import Parallel

# Larger than what rounding leaves in W = H^T M^-1 H, less than what a model's terms put there.
ROUND_OFF = 1e-10
# Implicit gyroscopic terms make M, and so W, unsymmetric by the step times a spin: 3e-3 in the
# files met. The method still finds the solution then; far beyond it has no reason to.
LARGEST_ASYMMETRY = 1e-2
# The blocks of M that are inverted as they are: scalars, plane bodies, points, rigid bodies.
_BLOCKS = (1, 2, 3, 6)
_BATCH = 256  # right-hand sides at a time where the diagonal of W needs solves with M


class MatrixDelassus:
    """N = W, given by its rows."""

    def __init__(self, problem: FclibProblem, parallel: Parallel) -> None:
        """Collective. Raises DataError where W is far from symmetric positive semi-definite."""
        rows = problem.contacts.scaled(COLUMNS)
        W = problem.delassus
        self.asymmetry = checked_asymmetry(W, rows, f"{problem.path}: W", parallel)
        self.entries = parallel.sum(int(W.nnz))
        self.description = f"W with {self.entries} entries"
        self.columns = COLUMNS
        self._diagonal = _diagonal(W, rows).reshape(-1, COLUMNS)
        _check_contacts(self._diagonal, problem, parallel)
        self._W = _matrix(W, rows.count, parallel)
        self._r, self._u = self._W.createVecs()
        self.offset = problem.offset

    def apply(self, impulse: NDArray, out: NDArray) -> None:
        """Collective. out = W impulse."""
        self._r.getArray()[:] = impulse.ravel()
        self._W.mult(self._r, self._u)
        out[:] = self._u.getArray(readonly=True).reshape(out.shape)

    def delassus(self) -> PETSc.Mat:
        """Collective. W as a new PETSc matrix."""
        return self._W.copy()

    @property
    def symmetric(self) -> bool:
        """Whether W is symmetric up to round-off."""
        return self.asymmetry <= ROUND_OFF

    def diagonal(self) -> NDArray:
        """Return the diagonal of W, (m, 3) [1/kg]."""
        return self._diagonal

    def destroy(self) -> None:
        """Collective. Free every PETSc object this operator made."""
        for item in (self._W, self._r, self._u):
            item.destroy()


class FactoredDelassus:
    """N = H^T M^-1 H, given by the rows of H^T and M; offset = H^T M^-1 f + w, (m, 3) [m/s]."""

    def __init__(self, problem: FclibProblem, parallel: Parallel) -> None:
        """Collective. Raises DataError where M is far from symmetric positive definite."""
        bodies = problem.bodies
        label = f"{problem.path}: M"
        M = problem.mass
        self.asymmetry = checked_asymmetry(M, bodies, label, parallel)
        self.columns = COLUMNS
        self._mass_rows, self._bodies, self._parallel = M, bodies, parallel
        H_t = problem.jacobian
        block = _block_size(M, bodies, parallel)
        self._mass: _MassInverse = (
            _BlockInverse(M, block, bodies, label, parallel)
            if block
            else _DirectInverse(M, self.asymmetry, bodies, label, parallel)
        )
        self._H_t = _matrix(H_t, bodies.count, parallel)
        self._p, self._u = self._H_t.createVecs()
        self._v = self._p.duplicate()
        self._r = self._u.duplicate()
        self.entries = parallel.sum(int(H_t.nnz))
        self.description = f"H with {self.entries} entries, {self._mass.description}"
        self._diagonal = self._mass.diagonal(self._H_t, H_t).reshape(-1, COLUMNS)
        try:
            _check_contacts(self._diagonal, problem, parallel)
        except DataError:
            self.destroy()
            raise
        self._force = problem.force
        self.offset = problem.offset + self._free_velocity(problem.offset.shape)

    def _free_velocity(self, shape: tuple[int, ...]) -> NDArray:
        self._p.getArray()[:] = self._force
        self._mass.solve(self._p, self._v)
        self._H_t.mult(self._v, self._u)
        return self._u.getArray().reshape(shape).copy()

    def apply(self, impulse: NDArray, out: NDArray) -> None:
        """Collective. out = H^T M^-1 H impulse."""
        self._r.getArray()[:] = impulse.ravel()
        self._H_t.multTranspose(self._r, self._p)
        self._mass.solve(self._p, self._v)
        self._H_t.mult(self._v, self._u)
        out[:] = self._u.getArray(readonly=True).reshape(out.shape)

    def body_velocity(self, impulse: NDArray) -> NDArray:
        """Collective. v = M^-1 (H impulse + f), the components this rank owns."""
        self._r.getArray()[:] = impulse.ravel()
        self._H_t.multTranspose(self._r, self._p)
        self._p.getArray()[:] += self._force
        self._mass.solve(self._p, self._v)
        return self._v.getArray().copy()

    def body_impulse(self, impulse: NDArray) -> NDArray:
        """Collective. H impulse, the components this rank owns."""
        self._r.getArray()[:] = impulse.ravel()
        self._H_t.multTranspose(self._r, self._p)
        return self._p.getArray(readonly=True)

    def relative_velocity(self, v: NDArray, out: NDArray) -> None:
        """Collective. out = H^T v for the components of v that this rank owns."""
        self._v.getArray()[:] = v.ravel()
        self._H_t.mult(self._v, self._u)
        out[:] = self._u.getArray(readonly=True).reshape(out.shape)

    def delassus(self) -> PETSc.Mat:
        """Collective. W = H^T M^-1 H as a new matrix. DemError if M is known by a factor alone."""
        if self._mass.matrix is None:
            raise DemError(
                "W = H^T M^-1 H cannot be formed: M is not block-diagonal, so M^-1 is dense; "
                "solve for the velocities (contact.scip.form: velocity)"
            )
        H = self._H_t.transpose(PETSc.Mat())
        W = self._mass.matrix.ptap(H)
        H.destroy()
        return W

    @property
    def velocity_rows(self) -> int:
        """Rows of M."""
        return self._bodies.total

    @property
    def contact_rows(self) -> int:
        """Rows of H^T; none may be called few where M^-1 is dense, and W with it."""
        return self._H_t.getSize()[0] if self._mass.matrix is not None else 2**62

    def velocity_factors(self) -> tuple[PETSc.Mat, PETSc.Mat]:
        """Collective. H^T, which stays this object's, and M as a new matrix."""
        return self._H_t, _matrix(self._mass_rows, self._bodies.count, self._parallel)

    @property
    def symmetric(self) -> bool:
        """Whether M is symmetric up to round-off."""
        return self.asymmetry <= ROUND_OFF

    def diagonal(self) -> NDArray:
        """Return the diagonal of N, (m, 3) [1/kg]."""
        return self._diagonal

    def destroy(self) -> None:
        """Collective. Free every PETSc object this operator made."""
        for item in (self._H_t, self._p, self._u, self._v, self._r, self._mass):
            item.destroy()


# ---- M^-1 ----------------------------------------------------------------------------------


class _MassInverse(Protocol):
    description: str
    matrix: PETSc.Mat | None  # M^-1 where it is sparse

    def solve(self, p: PETSc.Vec, v: PETSc.Vec) -> None:
        """Collective. v = M^-1 p."""

    def diagonal(self, H_t: PETSc.Mat, rows: sparse.csr_matrix) -> NDArray:
        """Collective. The diagonal of H^T M^-1 H for this rank's `rows` of H^T."""

    def destroy(self) -> None:
        """Collective."""


class _BlockInverse:
    """M^-1 of a block-diagonal M: the blocks inverted, a sparse matrix of M's own size."""

    def __init__(
        self, M: sparse.csr_matrix, block: int, bodies: Share, label: str, parallel: Parallel
    ) -> None:
        count = bodies.count // block
        blocks = np.zeros((count, block, block))
        entries = M.tocoo()
        body, component = np.divmod(entries.row, block)
        blocks[body, component, (entries.col - bodies.first) % block] = entries.data
        problem = None
        try:
            np.linalg.cholesky(0.5 * (blocks + blocks.transpose(0, 2, 1)))
        except np.linalg.LinAlgError:
            problem = DataError(f"{label} is not positive definite")
        parallel.raise_together(problem)
        inverse = np.linalg.inv(blocks)
        starts = bodies.first + np.arange(count) * block
        columns = np.broadcast_to(
            starts[:, None, None] + np.arange(block), (count, block, block)
        ).ravel()
        indptr = np.arange(bodies.count + 1) * block
        rows = sparse.csr_matrix(
            (inverse.ravel(), columns, indptr), shape=(bodies.count, bodies.total)
        )
        self.matrix = _matrix(rows, bodies.count, parallel)
        self.description = (
            "M diagonal" if block == 1 else f"M block-diagonal ({block} by {block} blocks)"
        )

    def solve(self, p: PETSc.Vec, v: PETSc.Vec) -> None:
        self.matrix.mult(p, v)

    def diagonal(self, H_t: PETSc.Mat, rows: sparse.csr_matrix) -> NDArray:
        product = H_t.matMult(self.matrix)
        local = _local_rows(product, rows.shape[1])
        product.destroy()
        return np.asarray(local.multiply(rows).sum(axis=1)).ravel()

    def destroy(self) -> None:
        self.matrix.destroy()


class _DirectInverse:
    """M^-1 by a factorisation of M with MUMPS, made once."""

    description = "M factorised"
    matrix = None

    def __init__(
        self,
        M: sparse.csr_matrix,
        asymmetry: float,
        bodies: Share,
        label: str,
        parallel: Parallel,
    ) -> None:
        self._parallel = parallel
        self._M = _matrix(M, bodies.count, parallel)
        symmetric = asymmetry <= ROUND_OFF
        self._M.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        self._ksp = PETSc.KSP().create(parallel.communicator)
        self._ksp.setOptionsPrefix("fclib_mass_")
        self._ksp.setType(PETSc.KSP.Type.PREONLY)
        self._ksp.setOperators(self._M)
        factorisation = self._ksp.getPC()
        factorisation.setType(PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU)
        try:
            factorisation.setFactorSolverType(PETSc.Mat.SolverType.MUMPS)
            factorisation.setFactorSetUpSolverType()
            self._factor = factorisation.getFactorMatrix()
            # For the inertia: no ScaLAPACK at the root of the tree, and zero pivots counted.
            self._factor.setMumpsIcntl(13, 1)
            self._factor.setMumpsIcntl(24, 1)
            self._ksp.setUp()
        except PETSc.Error as error:
            self.destroy()
            raise DemError(f"{label}: cannot be factorised by PETSc with MUMPS: {error}") from None
        if symmetric:
            negative, zero, _ = self._factor.getInertia()
            if negative or zero:
                self.destroy()
                raise DataError(
                    f"{label} is not positive definite: {negative} negative and {zero} zero "
                    "eigenvalues"
                )

    def solve(self, p: PETSc.Vec, v: PETSc.Vec) -> None:
        self._ksp.solve(p, v)

    def diagonal(self, H_t: PETSc.Mat, rows: sparse.csr_matrix) -> NDArray:
        """Columns of H by batches: (M^-1 H)_j . H_j, every rank adding its components."""
        H = H_t.transpose(PETSc.Mat())
        total = H.getSize()[1]
        local = _local_rows(H, total).tocsc()
        H.destroy()
        own = H_t.getOwnershipRange()
        result = np.zeros(rows.shape[0])
        for first in range(0, total, _BATCH):
            last = min(total, first + _BATCH)
            columns = local[:, first:last].toarray(order="F")
            sizes = ((columns.shape[0], None), (None, last - first))
            comm = self._parallel.communicator
            right = PETSc.Mat().createDense(sizes, array=columns, comm=comm)
            solved = right.duplicate()
            self._factor.matSolve(right, solved)
            products = (solved.getDenseArray() * columns).sum(axis=0)
            right.destroy()
            solved.destroy()
            self._parallel.sum_in_place(products)
            low, high = max(first, own[0]), min(last, own[1])
            if low < high:
                result[low - own[0] : high - own[0]] = products[low - first : high - first]
        return result

    def destroy(self) -> None:
        self._ksp.destroy()
        self._M.destroy()


def _block_size(M: sparse.csr_matrix, bodies: Share, parallel: Parallel) -> int:
    """Collective. The smallest block size for which M is block-diagonal; 0 if there is none."""
    entries = M.tocoo()
    row = entries.row.astype(np.int64) + bodies.first
    for block in _BLOCKS:
        outside = (row // block != entries.col // block).any()
        if bodies.total % block == 0 and not parallel.any(bool(outside)):
            return block
    return 0


# ---- checks --------------------------------------------------------------------------------


def checked_asymmetry(
    rows: sparse.csr_matrix, share: Share, label: str, parallel: Parallel
) -> float:
    """Collective. The largest |A_ij - A_ji| / sqrt(A_ii A_jj) of a matrix, each rank its rows.

    Raises DataError if it is above LARGEST_ASYMMETRY, or if |A_ij + A_ji| / 2 > sqrt(A_ii A_jj)
    for some i, j, which a positive semi-definite matrix never has.
    """
    A = _matrix(rows, share.count, parallel)
    diagonal = A.getDiagonal()
    d = diagonal.getArray()
    positive = d > 0.0
    negative = bool((d < 0.0).any()) or _largest(rows[~positive]) > 0.0
    d[:] = np.where(positive, d, 1.0) ** -0.5
    A.diagonalScale(diagonal, diagonal)
    transposed = A.transpose(PETSc.Mat())
    here, there = _local_rows(A, share.total), _local_rows(transposed, share.total)
    for item in (A, transposed, diagonal):
        item.destroy()
    found = np.array([_largest(here - there), 0.5 * _largest(here + there), float(negative)])
    asymmetry, off_diagonal, indefinite = parallel.max(found).tolist()
    if asymmetry > LARGEST_ASYMMETRY:
        raise DataError(
            f"{label} is not symmetric: |A_ij - A_ji| is up to {asymmetry:.1e} sqrt(A_ii A_jj), "
            f"more than {LARGEST_ASYMMETRY:g}"
        )
    if indefinite or off_diagonal > 1.0 + ROUND_OFF:
        raise DataError(
            f"{label} is not positive semi-definite: some |A_ij| is more than sqrt(A_ii A_jj)"
        )
    return asymmetry


def _check_contacts(diagonal: NDArray, problem: FclibProblem, parallel: Parallel) -> None:
    """Collective. A contact that no impulse can move has no solution, or any."""
    stuck = (diagonal[:, 0] <= 0.0) | (diagonal[:, 1:].max(axis=1) <= 0.0)
    error = None
    if stuck.any():
        contact = problem.contacts.first + int(np.argmax(stuck))
        error = DataError(
            f"{problem.path}: W has no positive diagonal at contact {contact}: no impulse moves it"
        )
    parallel.raise_together(error)


# ---- scipy to PETSc and back ---------------------------------------------------------------


def _matrix(rows: sparse.csr_matrix, columns: int, parallel: Parallel) -> PETSc.Mat:
    """Collective. The distributed matrix of which every rank has `rows` and owns `columns`."""
    csr = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data)
    sizes = ((rows.shape[0], None), (columns, None))
    return PETSc.Mat().createAIJ(sizes, csr=csr, comm=parallel.communicator)


def _local_rows(matrix: PETSc.Mat, columns: int) -> sparse.csr_matrix:
    indptr, indices, values = matrix.getValuesCSR()
    return sparse.csr_matrix((values, indices, indptr), shape=(indptr.size - 1, columns))


def _diagonal(rows: sparse.csr_matrix, share: Share) -> NDArray:
    return np.asarray(rows.diagonal(share.first)[: share.count])


def _largest(matrix: sparse.csr_matrix) -> float:
    return float(np.abs(matrix.data).max(initial=0.0))
