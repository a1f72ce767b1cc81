"""The linear system of an interior-point step: (N + R) x = s, with R block-diagonal.

N = D^T M^-1 D; R_i is the block of contact i and Q_i = R_i^-1 its inverse. Two forms:

    velocity  K u = D Q s,  K = M + D Q D^T,  x = Q (s - D^T u)     rows: velocities of bodies
    contact   (N + R) x = s                                        rows: impulses of contacts

K has the pattern of the contact graph, N that of contacts with a body in common. Both are symmetric
positive definite. A contact with mu = 0 has no tangential impulse: its Q_i is (1/p, 0, 0), so K
needs nothing special; in N + R its tangential rows and columns are those of the identity.

Solutions are refined with the product N x of the operator: x is corrected by the solution for the
residual until |s - N x - R x| <= 1e-10 |s| or that stops falling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_newton as kernels
from dem_mpi.cone import Delassus
from dem_mpi.linear_solvers import (
    Direct,
    DirectOptions,
    Iterative,
    LinearSolver,
    LowRank,
    NewtonFailureError,
    Ordering,
    Preconditioner,
)
from dem_mpi.operators import Assembled, MatrixFree
from dem_mpi.parallel import Halo, Parallel

__all__ = ["LinearSolve", "NewtonFailureError", "NewtonOptions", "NewtonSystem"]

TOLERANCE = 1e-10  # relative residual at which refinement ends
_REFINEMENTS = 5
# Rows of contacts over rows of bodies up to which the contact form's factor is the smaller one.
_CONTACT_ROWS = 1.2
# The norm of N over its largest diagonal entry, in packings of spheres: an estimate.
_NORM_OF_N = 3.0
_FALLING = 0.5  # a refinement that leaves more than this part of the residual is the last


@dataclass(frozen=True)
class NewtonOptions:
    """How Newton systems are solved; the scene's `contact.scip` names the same keys.

    form      : unknowns; "auto" takes the one whose factor is estimated the smaller
    linear    : a direct factorisation by MUMPS, or conjugate gradients (velocity form)
    ordering  : of the elimination; one that this MUMPS was built without is replaced by its choice
    workspace : extra working space of MUMPS [%]
    memory    : limit of MUMPS's memory on each rank [MB]
    preconditioner : of conjugate gradients: the blocks of the bodies inverted, an incomplete
                Cholesky factor of each rank's rows, or a factor by MUMPS with blocks of low rank
    """

    form: Literal["auto", "velocity", "contact"] = "auto"
    linear: Literal["mumps", "cg"] = "mumps"
    ordering: Ordering = "auto"
    workspace: int = 35
    memory: float | None = None
    preconditioner: Preconditioner = "icc"


@dataclass(frozen=True)
class LinearSolve:
    """How one system was solved.

    residual    : |s - (N + R) x| / |s|, Euclidean norms over all contacts
    refinements : corrections after the first solution
    iterations  : of conjugate gradients, over all corrections
    products    : with N
    """

    residual: float
    refinements: int
    iterations: int
    products: int


class NewtonSystem:
    """(N + R) x = s for one N and changing R.

    form : "velocity" or "contact"; factor_entries : non-zeros of the factor; factor_memory : [B] of
    all ranks; retries : factorisations repeated with more working space. PETSc is loaded with the
    first object of this class.
    """

    def __init__(
        self,
        operator: Delassus,
        mu: NDArray,
        parallel: Parallel,
        options: NewtonOptions,
        symmetric: bool = True,
    ) -> None:
        """Collective. Choose the form and lay out the matrix. DemError on all ranks if too large.

        mu : (m,). The operator is used, not owned, until `take` or `destroy`.
        symmetric : whether the blocks R are; if not the contact form is taken, factorised by LU.
        """
        self._parallel = parallel
        self._contacts = parallel.sum(mu.shape[0])
        self.form = _choose_form(operator, options, parallel) if symmetric else "contact"
        self._form: _Form
        if self.form == "velocity":
            self._form = _VelocityForm(operator, mu, parallel, options)
        else:
            self._form = _ContactForm(operator, mu, parallel, options, symmetric)

    @property
    def factor_entries(self) -> int:
        """Non-zeros of the last factor, 0 if none was made."""
        return self._form.solver.entries

    @property
    def factor_memory(self) -> float:
        """Memory of the last factorisation on all ranks together [B]."""
        return self._form.solver.memory

    @property
    def retries(self) -> int:
        """Factorisations that were repeated with more working space."""
        return self._form.solver.retries

    def take(self, operator: Delassus, mu: NDArray) -> bool:
        """Collective. Take new geometry on the same contact graph; False if the graph differs.

        After True what was found out about the matrix's pattern is kept; after False this system
        still stands for the old operator, and a new one is to be made.
        """
        return self._form.take(operator, mu)

    def factor(self, Q: NDArray, R: NDArray, root: NDArray | None = None) -> None:
        """Collective. Factorise, or set up the preconditioner, for Q and R = Q^-1, (m, c, c).

        root : (m, c, c) with Q = root root^T, found from Q if not given. Multiplied by its factors
        Q keeps, for the small eigenvalues, the digits that its largest takes from its entries.

        NewtonFailureError on all ranks where that cannot be done.
        """
        finite = bool(np.isfinite(Q).all() and np.isfinite(R).all())
        if self._parallel.any(not finite):
            raise NewtonFailureError(
                "the Newton matrix has entries that are not finite: the iterate has left the cones"
            )
        if self._contacts:
            self._form.factor(Q, R, _root(Q) if root is None else root)

    def solve(self, s: NDArray, out: NDArray, tolerance: float = TOLERANCE) -> LinearSolve:
        """Collective. out = (N + R)^-1 s, both (m, c), refined to the relative residual."""
        form = self._form
        s = form.masked(s)
        out[:] = 0.0
        size = self._norm(s)
        if size == 0.0:
            return LinearSolve(0.0, 0, 0, 0)
        form.begin(s)
        goal = tolerance * size
        iterations = form.correct(s, out, goal)
        rest = np.empty_like(s)
        relative = self._residual(out, rest) / size
        refinements, products = 0, 1
        kept = np.empty_like(out)
        while relative > tolerance and refinements < _REFINEMENTS:
            kept[:] = out
            iterations += form.correct(rest, out, goal)
            found = self._residual(out, rest) / size
            refinements += 1
            products += 1
            if not found < relative:
                out[:] = kept
                break
            falling = found <= _FALLING * relative
            relative = found
            if not falling:
                break
        return LinearSolve(relative, refinements, iterations, products)

    def _residual(self, x: NDArray, rest: NDArray) -> float:
        """Collective. rest = s - (N + R) x; return its norm, which is finite."""
        self._form.residual(x, rest)
        norm = self._norm(rest)
        if not math.isfinite(norm):
            raise NewtonFailureError(
                "the solution of the Newton system is not finite, though MUMPS reports no error: "
                "its memory may have run out; lower the number of bodies a rank, or set "
                "contact.scip.linear: cg"
            )
        return norm

    def _norm(self, x: NDArray) -> float:
        # The largest entry first: squares of large numbers would overflow.
        largest = float(self._parallel.max(float(np.abs(x).max(initial=0.0))))
        if largest == 0.0 or not math.isfinite(largest):
            return largest
        scaled = x.ravel() / largest
        return largest * math.sqrt(self._parallel.sum(float(scaled @ scaled)))

    def destroy(self) -> None:
        """Collective. Free every PETSc object."""
        self._form.destroy()


class _Form(Protocol):
    """One of the two forms; a correction solves with the factor, a residual with the operator."""

    solver: LinearSolver

    def take(self, operator: Any, mu: NDArray) -> bool:
        """Collective."""

    def masked(self, s: NDArray) -> NDArray:
        """Return s with zeros in rows that have no unknown."""

    def factor(self, Q: NDArray, R: NDArray, root: NDArray) -> None:
        """Collective."""

    def begin(self, s: NDArray) -> None:
        """Start on a new right-hand side, from x = 0."""

    def correct(self, rest: NDArray, x: NDArray, goal: float) -> int:
        """Collective. x += the solution for the residual `rest`; return iterations.

        goal : |s - (N + R) x| at which an iterative solver may stop [m/s]
        """

    def residual(self, x: NDArray, rest: NDArray) -> None:
        """Collective. rest = s - (N + R) x."""

    def destroy(self) -> None:
        """Collective."""


class _VelocityForm:
    """K u = D Q s.

    R x is never formed from R, whose rounded inverse is not quite Q: `_y` is what Q was multiplied
    by to get x. So s - N x - y is what the rounding of K^-1 left, and can be reduced to round-off.
    """

    def __init__(
        self, operator: Any, mu: NDArray, parallel: Parallel, options: NewtonOptions
    ) -> None:
        self._operator, self._parallel = operator, parallel
        known = isinstance(operator, MatrixFree | Assembled)
        matrix = _ContactVelocityMatrix if known else _ProductVelocityMatrix
        self._matrix = matrix(operator, parallel)
        self._frictionless = _frictionless_rows(mu)
        symmetric = getattr(operator, "symmetric", True)
        self.solver = _linear_solver(
            self._matrix.matrix, self._matrix.block, symmetric, options, parallel
        )
        self._b, self._u = self._matrix.matrix.createVecs()
        # M^-1/2, by which an iterative solver has K scaled: its residual r is then that of
        # velocities, and |s - (N + R) x| <= |D^T M^-1/2| |r| = sqrt(|N|) |r|.
        self._root = self._matrix.root_inverse_mass() if options.linear == "cg" else None
        self._gain = 1.0
        if self._root is not None:
            largest = parallel.max(float(operator.diagonal().max(initial=0.0)))
            self._gain = (_NORM_OF_N * largest) ** -0.5 if largest > 0.0 else 1.0

    def take(self, operator: Any, mu: NDArray) -> bool:
        if not self._matrix.take(operator):
            return False
        self._operator = operator
        self._frictionless = _frictionless_rows(mu)
        return True

    def masked(self, s: NDArray) -> NDArray:
        return _without_tangents(s, self._frictionless)

    def factor(self, Q: NDArray, R: NDArray, root: NDArray) -> None:
        self._root_of_Q = root
        self._matrix.fill(Q)
        if self._root is not None:
            self._matrix.matrix.diagonalScale(self._root, self._root)
            self._matrix.mark()
        self.solver.set_up()

    def begin(self, s: NDArray) -> None:
        self._s, self._y = s, np.zeros_like(s)
        self._work = np.empty_like(s)

    def correct(self, rest: NDArray, x: NDArray, goal: float) -> int:
        operator, work = self._operator, self._work
        # K u = D Q r
        kernels.root_product.serial(self._root_of_Q, rest, work)
        self._b.getArray()[:] = operator.body_impulse(work).ravel()
        if self._root is not None:
            self._b.pointwiseMult(self._b, self._root)
        iterations = self.solver.solve(self._b, self._u, goal * self._gain)
        if self._root is not None:
            self._u.pointwiseMult(self._u, self._root)
        u = self._u.getArray(readonly=True).reshape(-1, self._matrix.block)
        # y += r - D^T u,  x += Q (r - D^T u)
        operator.relative_velocity(u, work)
        np.subtract(rest, work, out=work)
        self._y += work
        change = np.empty_like(work)
        kernels.root_product.serial(self._root_of_Q, work, change)
        x += change
        return iterations

    def residual(self, x: NDArray, rest: NDArray) -> None:
        self._operator.apply(x, rest)
        np.subtract(self._s, rest, out=rest)
        rest -= self._y
        if rest.shape[1] > 1:
            rest[self._frictionless, 1:] = 0.0

    def destroy(self) -> None:
        self.solver.destroy()
        self._matrix.destroy()
        for item in (self._b, self._u, self._root):
            if item is not None:
                item.destroy()


class _ContactForm:
    """N + R as one matrix; N is formed once for each geometry."""

    def __init__(
        self,
        operator: Any,
        mu: NDArray,
        parallel: Parallel,
        options: NewtonOptions,
        symmetric: bool,
    ) -> None:
        from petsc4py import PETSc

        self._petsc, self._parallel = PETSc, parallel
        self._columns = operator.columns
        self._symmetric = symmetric and getattr(operator, "symmetric", True)
        self._graph = _graph_of(operator, parallel)
        self._take_geometry(operator, mu)
        self._matrix = self._N.duplicate(copy=True)
        self._mark()
        self.solver = _linear_solver(
            self._matrix, self._columns, self._symmetric, options, parallel
        )
        self._b, self._x = self._matrix.createVecs()

    def take(self, operator: Any, mu: NDArray) -> bool:
        graph = _graph_of(operator, self._parallel)
        if graph is None:
            same = operator is self._operator
        else:
            same = self._graph is not None and self._graph.same(graph)
        if self._parallel.any(not (same and operator.columns == self._columns)):
            return False
        self._N.destroy()
        self._take_geometry(operator, mu)
        return True

    def _take_geometry(self, operator: Any, mu: NDArray) -> None:
        """Collective. N, with zeros in the rows and columns of tangents without friction."""
        self._operator = operator
        self._frictionless = _frictionless_rows(mu)
        self._N = operator.delassus()
        # The blocks of R must have their place, also where N happens to have none.
        zeros, self._indptr, self._indices = _block_diagonal(
            self._N, self._columns, self._petsc, self._parallel
        )
        self._N.axpy(1.0, zeros, structure=self._petsc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        zeros.destroy()
        mask = self._N.createVecLeft()
        ones = np.ones((mask.getLocalSize() // self._columns, self._columns))
        mask.getArray()[:] = _without_tangents(ones, self._frictionless).ravel()
        self._N.diagonalScale(mask, mask)
        mask.destroy()

    def _mark(self) -> None:
        if self._symmetric:
            self._matrix.setOption(self._petsc.Mat.Option.SPD, True)

    def masked(self, s: NDArray) -> NDArray:
        return _without_tangents(s, self._frictionless)

    def factor(self, Q: NDArray, R: NDArray, root: NDArray) -> None:
        if R.shape[1] > 1 and self._frictionless.size:
            R = R.copy()
            R[self._frictionless, 1:, :] = 0.0
            R[self._frictionless, :, 1:] = 0.0
            R[self._frictionless, 1, 1] = 1.0
            R[self._frictionless, 2, 2] = 1.0
        self._R = R
        self._N.copy(self._matrix, structure=self._petsc.Mat.Structure.SAME_NONZERO_PATTERN)
        add = self._petsc.InsertMode.ADD_VALUES
        self._matrix.setValuesCSR(self._indptr, self._indices, R.ravel(), addv=add)
        self._matrix.assemble()
        self._mark()
        self.solver.set_up()

    def begin(self, s: NDArray) -> None:
        self._s, self._work = s, np.empty_like(s)

    def correct(self, rest: NDArray, x: NDArray, goal: float) -> int:
        self._b.getArray()[:] = rest.ravel()
        iterations = self.solver.solve(self._b, self._x, goal)
        x += self._x.getArray(readonly=True).reshape(x.shape)
        return iterations

    def residual(self, x: NDArray, rest: NDArray) -> None:
        self._operator.apply(x, rest)
        kernels.block_product.serial(self._R, x, self._work)
        rest += self._work
        np.subtract(self._s, rest, out=rest)
        if rest.shape[1] > 1:
            rest[self._frictionless, 1:] = 0.0

    def destroy(self) -> None:
        self.solver.destroy()
        for item in (self._matrix, self._N, self._b, self._x):
            item.destroy()


def _graph_of(operator: Any, parallel: Parallel) -> _Graph | None:
    """Collective. The contact graph, None of a problem that comes as matrices."""
    known = isinstance(operator, MatrixFree | Assembled)
    return _Graph.of(operator, parallel) if known else None


# ---- the matrix of the velocity form -------------------------------------------------------


@dataclass(frozen=True)
class _Graph:
    """The contacts of this rank's bodies: its own, then those that other ranks own.

    first : global number of the first body; body : (m, 2) int64 global numbers of a and b, -1 for
    a wall; halo : moves rows of contacts from the rank that owns them to the rank that owns b
    """

    first: int
    owned: int
    body: NDArray
    halo: Halo

    @classmethod
    def of(cls, operator: MatrixFree | Assembled, parallel: Parallel) -> _Graph:
        """Collective."""
        contacts, bodies = operator.contacts, operator.halo
        first = parallel.exclusive_sum(bodies.owned)
        rows = bodies.owned + bodies.ghosts
        number = np.zeros((rows, 2), dtype=np.int64)
        number[: bodies.owned, 0] = first + np.arange(bodies.owned)
        number[: bodies.owned, 1] = parallel.rank
        bodies.forward(number)
        joined = contacts.b >= 0
        other = np.maximum(contacts.b, 0)  # walls have negative ids, and no row
        owner = np.where(joined, number[other, 1], parallel.rank) if rows else contacts.b
        abroad = np.unique(owner[owner != parallel.rank]).tolist() if rows else []
        halo = Halo.build(parallel, contacts.count, {r: np.flatnonzero(owner == r) for r in abroad})
        body = np.full((halo.owned + halo.ghosts, 2), -1, dtype=np.int64)
        body[: halo.owned, 0] = number[contacts.a, 0]
        body[: halo.owned, 1][joined] = number[contacts.b[joined], 0]
        halo.forward(body)
        return cls(first, bodies.owned, body, halo)

    def same(self, other: _Graph) -> bool:
        """Whether the same bodies touch, as far as this rank knows."""
        return (
            self.first == other.first
            and self.owned == other.owned
            and np.array_equal(self.body, other.body)
        )

    def extend(self, owned: NDArray) -> NDArray:
        """Collective. Rows of own contacts (m, k) with those of other ranks' behind them."""
        rows = np.empty((self.halo.owned + self.halo.ghosts, owned.shape[1]))
        rows[: self.halo.owned] = owned
        self.halo.forward(rows)
        return rows


class _ContactVelocityMatrix:
    """K = M + D Q D^T of spheres or rigid bodies, every rank filling the rows of its bodies."""

    def __init__(self, operator: MatrixFree | Assembled, parallel: Parallel) -> None:
        """Collective."""
        from petsc4py import PETSc

        self._petsc, self._parallel = PETSc, parallel
        self.block = operator.freedoms
        self._graph = graph = _Graph.of(operator, parallel)
        count = kernels.count_incidences(graph.body, graph.first, graph.owned)
        self._start = np.zeros(graph.owned + 1, dtype=np.int64)
        self._incident = np.empty(count, dtype=np.int64)
        kernels.incidences(graph.body, graph.first, graph.owned, self._start, self._incident)
        incidence = (graph.body, graph.first, self._start, self._incident)
        self._row = np.empty(graph.owned + 1, dtype=np.int64)
        column = np.empty(count + graph.owned, dtype=np.int64)
        column = column[: kernels.block_columns(*incidence, self._row, column)]
        self._own = np.empty(graph.owned, dtype=np.int32)
        self._slot = np.empty(count, dtype=np.int32)
        kernels.block_slots(*incidence, self._row, column, self._own, self._slot)
        self._take_geometry(operator)
        self.matrix = self._create(column)

    def _create(self, column: NDArray) -> Any:
        """Collective. The PETSc matrix, with its pattern and zeros."""
        index = self._petsc.IntType
        rows, entries = self._graph.owned * self.block, column.size * self.block**2
        _check_index_width(self._parallel, rows, entries, self._petsc)
        self._indptr = np.empty(rows + 1, dtype=index)
        self._indices = np.empty(entries, dtype=index)
        kernels.scalar_pattern(self._row, column, self.block, self._indptr, self._indices)
        self._values = np.zeros(entries)
        matrix = self._petsc.Mat().create(self._parallel.communicator)
        matrix.setSizes(((rows, None), (rows, None)), bsize=self.block)
        matrix.setType(self._petsc.Mat.Type.AIJ)
        matrix.setPreallocationCSR((self._indptr, self._indices, self._values))
        return matrix

    def take(self, operator: MatrixFree | Assembled) -> bool:
        """Collective. New geometry; False if the graph or the bodies' masses differ."""
        graph = _Graph.of(operator, self._parallel)
        same = (
            operator.freedoms == self.block
            and self._graph.same(graph)
            and np.array_equal(operator.inverse_masses[0][: graph.owned], self._inverse_mass)
        )
        if self._parallel.any(not same):
            return False
        self._graph = graph
        self._take_geometry(operator)
        return True

    def _take_geometry(self, operator: MatrixFree | Assembled) -> None:
        owned = self._graph.owned
        mass, inertia = operator.inverse_masses
        self._inverse_mass = mass[:owned]
        self._inverse_inertia = inertia[:owned].reshape(owned, -1 if owned else 1)
        self._normal = self._graph.extend(operator.contacts.normal)
        self._arm = self._graph.extend(operator.contacts.arm)

    def fill(self, Q: NDArray) -> None:
        """Collective. Give the matrix its values for Q (m, c, c)."""
        blocks = self._graph.extend(Q.reshape(len(Q), Q.shape[1] * Q.shape[2]))
        kernels.velocity_matrix.serial(
            self._normal, self._arm, blocks, self._start, self._incident, self._slot, self._own,
            self._row, self._inverse_mass, self._inverse_inertia, self.block, self._values,
        )  # fmt: skip
        self.matrix.setValuesCSR(self._indptr, self._indices, self._values)
        self.matrix.assemble()
        self.mark()

    def mark(self) -> None:
        """Say that K is symmetric positive definite, which PETSc forgets with every new value."""
        self.matrix.setOption(self._petsc.Mat.Option.SPD, True)

    def root_inverse_mass(self) -> Any:
        """Return a new vector of 1/sqrt(m), and for rotations 1/sqrt of the mean inertia."""
        root = self.matrix.createVecLeft()
        rows = root.getArray().reshape(-1, self.block)
        rows[:, :3] = np.sqrt(self._inverse_mass)[:, None]
        if self.block == 6:
            J = self._inverse_inertia
            mean = J[:, 0] if J.shape[1] == 1 else J[:, [0, 3, 5]].mean(axis=1)
            rows[:, 3:] = np.sqrt(mean)[:, None]
        return root

    def destroy(self) -> None:
        """Collective."""
        self.matrix.destroy()


class _ProductVelocityMatrix:
    """K = M + H Q H^T of a problem that comes as sparse matrices H^T and M."""

    block = 1

    def __init__(self, operator: Any, parallel: Parallel) -> None:
        """Collective."""
        from petsc4py import PETSc

        self._petsc, self._operator = PETSc, operator
        self._symmetric = operator.symmetric
        self._H_t, self._M = operator.velocity_factors()
        self._Q, self._indptr, self._indices = _block_diagonal(
            self._H_t, operator.columns, PETSc, parallel
        )
        self._product = self._Q.ptap(self._H_t)
        self.matrix = self._product.duplicate(copy=True)
        self.matrix.axpy(1.0, self._M, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        self.mark()

    def mark(self) -> None:
        """Say that K is symmetric positive definite, if it is."""
        if self._symmetric:
            self.matrix.setOption(self._petsc.Mat.Option.SPD, True)

    def root_inverse_mass(self) -> Any:
        """Return a new vector of M_ii^-1/2."""
        root = self._M.getDiagonal()
        root.getArray()[:] **= -0.5
        return root

    def take(self, operator: Any) -> bool:
        """Return whether this is still the same problem."""
        return operator is self._operator

    def fill(self, Q: NDArray) -> None:
        """Collective. Give the matrix its values for Q (m, c, c)."""
        self._Q.setValuesCSR(self._indptr, self._indices, Q.ravel())
        self._Q.assemble()
        self._Q.ptap(self._H_t, result=self._product)
        within = self._petsc.Mat.Structure.SUBSET_NONZERO_PATTERN
        self.matrix.zeroEntries()
        self.matrix.axpy(1.0, self._product, structure=within)
        self.matrix.axpy(1.0, self._M, structure=within)
        self.mark()

    def destroy(self) -> None:
        """Collective."""
        for item in (self.matrix, self._product, self._Q, self._M):
            item.destroy()


def _block_diagonal(
    like: Any, c: int, petsc: Any, parallel: Parallel
) -> tuple[Any, NDArray, NDArray]:
    """Collective. A matrix of c x c zero blocks over the rows of `like`, and its CSR pattern."""
    rows, first = like.getLocalSize()[0], like.getOwnershipRange()[0]
    index = petsc.IntType
    indptr = np.arange(0, rows * c + 1, c, dtype=index)
    columns = first + np.arange(rows, dtype=index).reshape(-1, 1, c)
    indices = np.broadcast_to(columns, (rows // c, c, c)).astype(index).ravel()
    sizes = ((rows, None), (rows, None))
    csr = (indptr, indices, np.zeros(rows * c))
    return petsc.Mat().createAIJ(sizes, csr=csr, comm=parallel.communicator), indptr, indices


# ---- choices -------------------------------------------------------------------------------


def _root(Q: NDArray) -> NDArray:
    """Return L (m, c, c) with L L^T = Q, of positive semi-definite blocks."""
    values, vectors = np.linalg.eigh(Q)
    return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]


def _choose_form(
    operator: Any, options: NewtonOptions, parallel: Parallel
) -> Literal["velocity", "contact"]:
    """Collective. The form asked for, or the one with the smaller factor. NewtonFailureError.

    Factors of piles of 2,000 and 16,000 spheres, loose to dense, with friction and without, have
    the same size where the rows of contacts between bodies are 1.25 times the rows of bodies that
    touch; the fewer contacts, the smaller that of the contact form. Close to it the velocity form
    is preferred, whose matrix needs no product.
    """
    velocities = hasattr(operator, "body_impulse")
    cg = options.linear == "cg"
    if options.form == "velocity" and not velocities:
        raise NewtonFailureError(
            "contact.scip.form: velocity needs D and M, and this problem has N alone: set auto"
        )
    if cg and (options.form == "contact" or not velocities):
        raise NewtonFailureError(
            "contact.scip.linear: cg solves for velocities of bodies: it goes with form: velocity "
            "and with problems that have D and M; set linear: mumps"
        )
    if options.form != "auto":
        return options.form
    if cg or not velocities:
        return "velocity" if velocities else "contact"
    bodies, contacts = _rows(operator, parallel)
    return "contact" if contacts <= _CONTACT_ROWS * bodies else "velocity"


def _rows(operator: Any, parallel: Parallel) -> tuple[int, int]:
    """Collective. Rows of bodies that touch, and rows of contacts between two of them."""
    if not isinstance(operator, MatrixFree | Assembled):
        return operator.velocity_rows, operator.contact_rows
    contacts, halo = operator.contacts, operator.halo
    touched = np.zeros(halo.owned + halo.ghosts)
    joined = contacts.b >= 0
    touched[contacts.a] = 1.0
    touched[contacts.b[joined]] = 1.0
    halo.reverse_add(touched)
    counts = np.array([np.count_nonzero(touched[: halo.owned]), np.count_nonzero(joined)])
    bodies, pairs = parallel.sum(counts).tolist()
    return bodies * operator.freedoms, pairs * operator.columns


def _linear_solver(
    matrix: Any, block: int, symmetric: bool, options: NewtonOptions, parallel: Parallel
) -> LinearSolver:
    """Collective."""
    direct = DirectOptions(options.ordering, options.workspace, options.memory)
    if options.linear == "cg":
        if not symmetric:
            raise NewtonFailureError(
                "contact.scip.linear: cg needs a symmetric M, and this problem's is not: set mumps"
            )
        if options.preconditioner != "low_rank":
            return Iterative(matrix, options.preconditioner, parallel)
        return LowRank(matrix, block, symmetric, direct, parallel)
    return Direct(matrix, block, symmetric, direct, parallel)


def _frictionless_rows(mu: NDArray) -> NDArray:
    """Return the contacts (k,) whose tangential unknowns are fixed at zero."""
    return np.flatnonzero(mu == 0.0)


def _without_tangents(s: NDArray, frictionless: NDArray) -> NDArray:
    if s.shape[1] == 1 or not frictionless.size:
        return s
    s = s.copy()
    s[frictionless, 1:] = 0.0
    return s


def _check_index_width(parallel: Parallel, rows: int, entries: int, petsc: Any) -> None:
    """Collective. NewtonFailureError if the matrix outgrows PETSc's indices."""
    width = np.iinfo(petsc.IntType)
    largest = max(parallel.sum(rows), parallel.max(entries))
    if largest > width.max:
        raise NewtonFailureError(
            f"the Newton matrix has {largest} rows, or entries on a rank, more than PETSc's "
            f"{width.bits}-bit indices can number: use a PETSc with 64-bit indices or more ranks"
        )
