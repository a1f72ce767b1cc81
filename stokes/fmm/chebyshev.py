"""Multipole to local transfers by matrices of kernel values between the nodes of two boxes.

    local_t[i, a] += sum_s sum_{j, b} k_ij(x_a - y_b) multipole_s[j, b]      (thesis eq. 1.19)

P. Blanchard, PhD thesis, Université de Bordeaux 2017, section 1.2-1.3. The matrix K_v of one
transfer vector v is the same for all pairs of boxes so displaced; three ways to keep and apply it:

DenseTransfer       all 316 matrices (343 with neighbours) as they are (alg. 3); the reference
CompressedTransfer  K_v ~ U C_v V^T with one U and one V for all v (alg. 4)
SymmetricTransfer   K_v ~ A_v B_v for the 16 (20) vectors of a cone, the others by symmetry (alg. 5)

Any grid that is the same in each direction and symmetric about the centre of the box will do;
Chebyshev nodes are the use intended, the operators of equispaced ones are cheaper in Fourier
space. Boxes in one relation go through a matrix product together, so all arithmetic is GEMM.

Accuracy. `eps` bounds the error of the operators as a fraction of their Frobenius norm,
|K~_v - K_v|_W <= eps |K_v|_W: for each v in SymmetricTransfer, in the mean square over all v in
CompressedTransfer. The norm weighs the nodes with the quadrature weights of the Chebyshev grid
(W. Fong and E. Darve, J. Comput. Phys. 228, 2009; on equispaced grids all weights are 1), so that
it stands for the root mean square of the kernel's error over all pairs of points in the two boxes.
Interpolation itself errs independently of `eps`; the far field of points filling their boxes errs
by about eps in the relative 2-norm. Where weights cancel the sum is small, and errs by more of it.
Which to take: common bases with compressed cores (M. Messner et al., arXiv:1210.7292) need a half
to a third of the time a pair of the symmetric operators, but five to eight times their memory, and
more time to build, which counts for kernels that are not homogeneous and for large tensors.

Symbols: N = nodes^3, v transfer vector (symmetry.vector_index), a, b nodes, i, j components.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import DTypeLike

from stokes.fmm._kernels_chebyshev import (
    gather_rows,
    gather_turned,
    scatter_rows,
    scatter_turned,
)
from stokes.fmm._transfer_levels import is_smooth, levels_with_tables
from stokes.fmm.interpolation import Grid
from stokes.fmm.kernels import Kernel
from stokes.fmm.low_rank import LowRank, approximate, common_range, recompressed
from stokes.fmm.symmetry import VECTORS, Orbits, orbits, transfer_vectors, vector_offset

# Pairs that go through a matrix product together: enough for GEMM, few enough for the cache.
_PAIRS = 512
# Entries of a kernel matrix evaluated at once while operators are built.
_ENTRIES = 1 << 18


class MatrixTransfer(ABC):
    """What the three transfers share: levels, the ordering of pairs, threads.

    kernel        homogeneous kernels have one table, others one a level
    grid          the same in each direction, symmetric about the centre of the box
    edges         (levels,) edge of a box at each level, root first
    admissibility "standard", or "smooth": boxes of the last level reach their neighbours too
    dtype         of tables, multipoles and locals
    """

    def __init__(
        self,
        kernel: Kernel,
        grid: Grid,
        edges: Sequence[float],
        *,
        admissibility: str = "standard",
        dtype: DTypeLike = np.float64,
        threads: int = 1,
    ) -> None:
        smooth = is_smooth(admissibility)
        self.kernel = kernel
        self.nodes = grid.nodes
        self.dtype = np.dtype(dtype)
        self.threads = threads
        self._edges = np.asarray(edges, dtype=np.float64)
        self._orbits = orbits(
            transfer_vectors(neighbours=True),
            grid.nodes,
            kernel.rotate if self._by_symmetry(kernel) else None,
            kernel.n_in,
            kernel.n_out,
        )
        self._tables = {
            level: self._build(
                _Family(kernel, grid, edge, transfer_vectors(neighbours), self._orbits)
            )
            for level, edge, neighbours in levels_with_tables(kernel, self._edges, smooth)
        }

    @property
    def bytes(self) -> int:
        """Memory of the operators."""
        return sum(table.bytes for table in self._tables.values())

    @property
    def spectra_bytes(self) -> int:
        """0: there are no spectra."""
        return 0

    def add(
        self,
        level: int,
        multipoles: np.ndarray,
        start: np.ndarray,
        source: np.ndarray,
        vector: np.ndarray,
        targets: np.ndarray,
        local: np.ndarray,
        cells: np.ndarray | None = None,
    ) -> None:
        """Add to the locals of target boxes what their source boxes of one level give.

        multipoles : (boxes, n_in, nodes, nodes, nodes); local : (boxes, n_out, ...), added to
        start : (k + 1,) pairs start[t] : start[t + 1] belong to the box targets[t]
        source, vector : (pairs,) box of the source, transfer vector 0..342
        """
        self.apply(self.prepare(level, start, source, vector, targets, cells), multipoles, local)

    def prepare(
        self,
        level: int,
        start: np.ndarray,
        source: np.ndarray,
        vector: np.ndarray,
        targets: np.ndarray,
        cells: np.ndarray | None = None,
    ) -> OrderedPairs:
        """Order the pairs of a level (arguments of `add`) for any number of calls of `apply`.

        `cells` is of no use here: every pair is taken by itself.
        """
        start, targets = np.asarray(start), np.asarray(targets)
        wanted = np.linspace(start[0], start[-1], self.threads + 1)
        cuts = np.searchsorted(start, wanted)
        parts = tuple(
            _sorted(self._operator_of(), start[a : b + 1], source, vector, targets[a:b])
            for a, b in pairwise(cuts)
            if start[a] < start[b]
        )
        return OrderedPairs(level, parts)

    def apply(self, pairs: OrderedPairs, multipoles: np.ndarray, local: np.ndarray) -> None:
        """Add to the locals what the multipoles give them over the prepared pairs of a level."""
        if not pairs.parts:
            return
        table, scale = self._table(pairs.level)
        expansions = multipoles.reshape(len(multipoles), self.kernel.n_in, -1)
        result = local.reshape(len(local), self.kernel.n_out, -1)
        self._apply(table, scale, expansions, pairs.parts, result)

    def _by_symmetry(self, kernel: Kernel) -> bool:
        """Whether operators are obtained from those of the cone."""
        return is_symmetric(kernel)

    def _operator_of(self) -> np.ndarray:
        """(343,) The vector of the operator that each vector's pairs are multiplied with."""
        return np.arange(VECTORS)

    def _table(self, level: int) -> tuple[_Table, float]:
        if self.kernel.degree is None:
            return self._tables[level], 1.0
        return self._tables[0], float(self._edges[level] ** self.kernel.degree)

    @abstractmethod
    def _build(self, family: _Family) -> _Table:
        """Make the operators of one level."""

    @abstractmethod
    def _apply(
        self,
        table: _Table,
        scale: np.floating,
        multipoles: np.ndarray,
        parts: tuple[_Part, ...],
        local: np.ndarray,
    ) -> None:
        """local += scale K multipoles over the parts, which share no target."""

    def _in_threads(self, work: Callable[[_Part], None], parts: tuple[_Part, ...]) -> None:
        if len(parts) == 1:
            work(parts[0])
            return
        with ThreadPoolExecutor(len(parts)) as pool:
            list(pool.map(work, parts))


class DenseTransfer(MatrixTransfer):
    """All operators as they are: n_in n_out N^2 numbers each, and as many multiplications a pair.

    Exact but for rounding; for comparison and tests, beyond 6 nodes it is too large for use.
    """

    def _build(self, family: _Family) -> _Table:
        tables = {v: _contiguous(family.matrix(v).T, self.dtype) for v in family.vectors}
        return _Table(tables, sum(matrix.nbytes for matrix in tables.values()))

    def _apply(self, table, scale, multipoles, parts, local):
        operators, width = table.data, multipoles.shape[1] * multipoles.shape[2]
        rows, out = multipoles.reshape(-1, width), local.reshape(len(local), -1)

        def work(part: _Part) -> None:
            given = np.empty((_PAIRS, width), self.dtype)
            for v, some in part.groups:
                sources, targets = part.source[some], part.targets[part.row[some]]
                block = given[: len(sources)]
                gather_rows(rows, sources, block)
                scatter_rows(block @ operators[v], targets, scale, out)

        self._in_threads(work, parts)


class CompressedTransfer(MatrixTransfer):
    """K_v ~ U C_v V^T with orthogonal (in the norm W) U, V common to all vectors.

    U and V span the ranges of all operators side by side and one below the other, each scaled to
    norm 1, truncated where the rest is eps / sqrt(3) in the mean square. The expansions change
    basis once a box; each pair costs products with the small C_v only, which are kept as factors
    of low rank where that is smaller (to eps / sqrt(3) again). Works for every kernel.
    """

    def __init__(
        self,
        kernel: Kernel,
        grid: Grid,
        edges: Sequence[float],
        eps: float,
        **options: object,
    ) -> None:
        self.eps = _checked(eps)
        super().__init__(kernel, grid, edges, **options)

    @property
    def ranks(self) -> dict[int, tuple[int, int]]:
        """Columns of U and V by level (level 0 stands for all if the kernel is homogeneous)."""
        return {
            level: (table.data[0].shape[0], table.data[2].shape[1])
            for level, table in self._tables.items()
        }

    def _build(self, family: _Family) -> _Table:
        # The factors are so much more accurate than the bases that their error does not count.
        factors = dict(family.compressed(0.1 * self.eps))
        norms = {v: np.linalg.norm(_range(f)) or 1.0 for v, f in factors.items()}
        truncation = 0.9 * self.eps / np.sqrt(3.0)
        U = common_range([_range(f) / norms[v] for v, f in factors.items()], truncation)
        V = U
        if not _is_reciprocal(self.kernel):
            V = common_range([_corange(f) / norms[v] for v, f in factors.items()], truncation)
        cores = {v: self._core(f, U, V, truncation) for v, f in factors.items()}
        to_local = _contiguous(U.T / family.weight_out, self.dtype)
        from_multipole = _contiguous(V / family.weight_in[:, None], self.dtype)
        size = (
            to_local.nbytes
            + from_multipole.nbytes
            + sum(c.nbytes for core in cores.values() for c in core)
        )
        return _Table((to_local, cores, from_multipole), size)

    def _core(
        self, factors: LowRank, U: np.ndarray, V: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, ...]:
        """Matrices whose product, applied from the right, is C_v^T: two factors or one."""
        core = LowRank(U.T @ factors.left, factors.right @ V)
        low = recompressed(core, tolerance)
        if low.rank * (len(low.left) + low.right.shape[1]) >= len(low.left) * low.right.shape[1]:
            return (_contiguous(core.dense().T, self.dtype),)
        return _contiguous(low.right.T, self.dtype), _contiguous(low.left.T, self.dtype)

    def _apply(self, table, scale, multipoles, parts, local):
        to_local, cores, from_multipole = table.data
        first = min(part.source.min() for part in parts)
        last = max(part.source.max() for part in parts) + 1
        given = multipoles[first:last].reshape(last - first, -1) @ from_multipole
        out = local.reshape(len(local), -1)

        def work(part: _Part) -> None:
            count = len(part.targets)
            sums = np.zeros((count, len(to_local)), self.dtype)
            block = np.empty((_PAIRS, given.shape[1]), self.dtype)
            for v, some in part.groups:
                sources = part.source[some]
                gather_rows(given, sources - first, block[: len(sources)])
                values = block[: len(sources)]
                for factor in cores[v]:
                    values = values @ factor
                scatter_rows(values, part.row[some], self.dtype.type(1), sums)
            for k in range(0, count, _PAIRS):
                some = slice(k, k + _PAIRS)
                scatter_rows(sums[some] @ to_local, part.targets[some], scale, out)

        self._in_threads(work, parts)


class SymmetricTransfer(MatrixTransfer):
    """K_v ~ A_v B_v, stored for the 16 (20) vectors 0 <= dz <= dy <= dx only.

    Pairs of all vectors that a symmetry of the cube maps on one another share an operator: their
    multipoles are gathered through the permutation of nodes and components, multiplied together
    and scattered back. Each operator has its own rank; where factors would not be smaller than
    the matrix the matrix is kept. ValueError if the kernel has not the symmetry it declares.
    """

    def __init__(
        self,
        kernel: Kernel,
        grid: Grid,
        edges: Sequence[float],
        eps: float,
        **options: object,
    ) -> None:
        self.eps = _checked(eps)
        if not is_symmetric(kernel):
            raise ValueError(f"kernel {kernel.name}: k(Q r) is not R_out k(r) R_in^T")
        super().__init__(kernel, grid, edges, **options)

    @property
    def ranks(self) -> dict[int, dict[int, int]]:
        """Rank of each stored operator by level (0 for all if homogeneous) and vector."""
        return {
            level: {v: factors[0].shape[1] for v, factors in table.data.items()}
            for level, table in self._tables.items()
        }

    def _build(self, family: _Family) -> _Table:
        operators = {v: self._operator(family, v) for v in family.representatives}
        size = sum(matrix.nbytes for factors in operators.values() for matrix in factors)
        return _Table(operators, size)

    def _operator_of(self) -> np.ndarray:
        return self._orbits.representative

    def _operator(self, family: _Family, v: int) -> tuple[np.ndarray, ...]:
        """Matrices whose product, applied from the right, is K_v^T: two factors or one."""
        factors = family.low_rank(v, self.eps)
        if factors.rank * sum(family.shape) >= family.shape[0] * family.shape[1]:
            return (_contiguous(family.matrix(v).T, self.dtype),)
        return (
            _contiguous((factors.right / family.weight_in).T, self.dtype),
            _contiguous(factors.left.T / family.weight_out, self.dtype),
        )

    def _apply(self, table, scale, multipoles, parts, local):
        turn, operators = self._orbits, table.data
        inward = (turn.node, turn.component_in, turn.sign_in.astype(self.dtype))
        outward = (turn.inverse, turn.component_out, turn.sign_out.astype(self.dtype))

        def work(part: _Part) -> None:
            given = np.empty((_PAIRS, *multipoles.shape[1:]), self.dtype)
            shape = (-1, *local.shape[1:])
            for v, some in part.groups:
                sources, targets = part.source[some], part.targets[part.row[some]]
                q = turn.symmetry[part.vector[some]]
                block = given[: len(sources)]
                gather_turned(multipoles, sources, q, *inward, block)
                values = block.reshape(len(block), -1)
                for factor in operators[v]:
                    values = values @ factor
                values = values.reshape(shape)
                scatter_turned(values, targets, q, *outward, scale, local)

        self._in_threads(work, parts)


def is_symmetric(kernel: Kernel) -> bool:
    """Whether k(Q r) = R_out k(r) R_in^T holds for Q that generate all symmetries of the cube."""
    r = kernel.length * np.random.default_rng(1).uniform(-2.0, 2.0, (16, 3))
    cycle, swap, flip = np.eye(3)[[1, 2, 0]], np.eye(3)[[1, 0, 2]], np.diag([-1.0, 1.0, 1.0])
    value = kernel.matrix(r)
    for Q in (cycle, swap, flip):
        R_out, R_in = kernel.rotate(Q)
        error = np.abs(kernel.matrix(r @ Q.T) - R_out @ value @ R_in.T).max()
        if error > 1e-9 * np.abs(value).max():
            return False
    return True


def _is_reciprocal(kernel: Kernel) -> bool:
    """Whether k(-r) = +-k(r)^T, so that the transposed operators are those of -v."""
    if kernel.n_in != kernel.n_out:
        return False
    r = kernel.length * np.random.default_rng(2).uniform(-2.0, 2.0, (16, 3))
    value, mirrored = kernel.matrix(r), kernel.matrix(-r).transpose(0, 2, 1)
    return np.array_equal(value, mirrored) or np.array_equal(value, -mirrored)


@dataclass(frozen=True)
class _Table:
    """Operators of one level in the form of their transfer, and their memory."""

    data: object
    bytes: int


@dataclass(frozen=True)
class OrderedPairs:
    """The pairs of boxes of one level, ordered by operator; a part for each thread."""

    level: int
    parts: tuple[_Part, ...]


@dataclass(frozen=True)
class _Part:
    """Pairs of some target boxes, those that share an operator in a row.

    source, vector : (pairs,); row : (pairs,) of targets : (k,)
    groups : (operator, slice of the pairs), at most _PAIRS of them each
    """

    source: np.ndarray
    vector: np.ndarray
    row: np.ndarray
    targets: np.ndarray
    groups: tuple[tuple[int, slice], ...]


def _sorted(
    operator: np.ndarray,
    start: np.ndarray,
    source: np.ndarray,
    vector: np.ndarray,
    targets: np.ndarray,
) -> _Part:
    """The pairs start[0] : start[-1] by operator; pairs of one operator keep their order.

    So the sums at a target do not depend on how the targets are spread over threads.
    """
    pairs = slice(start[0], start[-1])
    key = operator[vector[pairs]].astype(np.int16)
    order = np.argsort(key, kind="stable")
    ends = np.cumsum(np.bincount(key, minlength=VECTORS))
    groups = tuple(
        (int(v), slice(k, min(k + _PAIRS, ends[v])))
        for v in np.flatnonzero(np.diff(ends, prepend=0))
        for k in range(ends[v - 1] if v else 0, ends[v], _PAIRS)
    )
    row = np.repeat(np.arange(len(targets), dtype=np.int32), np.diff(start))
    return _Part(source[pairs][order], vector[pairs][order], row[order], targets, groups)


class _Family:
    """The operators of one level and what is known of them all.

    Rows are (i, a) and columns (j, b), components outside. The low-rank factors are those of the
    matrices weighted by W: diag(weight_out) K_v diag(weight_in).
    """

    def __init__(
        self, kernel: Kernel, grid: Grid, edge: float, vectors: np.ndarray, turns: Orbits
    ) -> None:
        self.vectors = vectors
        self.shape = (kernel.n_out * grid.nodes**3, kernel.n_in * grid.nodes**3)
        self._kernel = kernel
        self._edge = edge
        x = np.asarray(grid.points, dtype=np.float64)
        self._points = 0.5 * edge * np.stack(np.meshgrid(x, x, x, indexing="ij"), -1).reshape(-1, 3)
        weight = _root_weights(grid)
        self.weight_out = np.tile(weight, kernel.n_out)
        self.weight_in = np.tile(weight, kernel.n_in)
        self._turns = turns
        self.representatives = np.unique(turns.representative[vectors])

    def matrix(self, v: int) -> np.ndarray:
        """K_v without weights, a few rows of nodes at a time."""
        count = len(self._points)
        out = np.empty((self._kernel.n_out, count, self._kernel.n_in, count))
        shift, step = self._shift(v), max(1, _ENTRIES // count)
        for k in range(0, count, step):
            some = slice(k, k + step)
            r = shift + self._points[some, None] - self._points
            values = self._kernel.matrix(r.reshape(-1, 3)).reshape(*r.shape[:2], *out.shape[::2])
            out[:, some] = values.transpose(2, 0, 3, 1)
        return out.reshape(self.shape)

    def low_rank(self, v: int, eps: float) -> LowRank:
        """Factors of the weighted K_v, relative error eps in the Frobenius norm."""
        shift, points, kernel = self._shift(v), self._points, self._kernel
        count = len(points)

        def rows(index: np.ndarray) -> np.ndarray:
            i, a = np.divmod(index, count)
            r = (shift + points[a, None] - points).reshape(-1, 3)
            values = kernel.matrix(r).reshape(len(index), count, kernel.n_out, kernel.n_in)
            values = values[np.arange(len(index)), :, i].transpose(0, 2, 1)
            return self.weight_out[index, None] * values.reshape(len(index), -1) * self.weight_in

        def columns(index: np.ndarray) -> np.ndarray:
            j, b = np.divmod(index, count)
            r = (shift + points[:, None] - points[b]).reshape(-1, 3)
            values = kernel.matrix(r).reshape(count, len(index), kernel.n_out, kernel.n_in)
            values = values[:, np.arange(len(index)), :, j].transpose(2, 1, 0)
            values = values.reshape(-1, len(index))
            return self.weight_out[:, None] * values * self.weight_in[index]

        return approximate(rows, columns, self.shape, eps)

    def compressed(self, eps: float) -> Iterator[tuple[int, LowRank]]:
        """Each vector with the factors of its weighted operator, in the order of the vectors."""
        known = {v: self.low_rank(v, eps) for v in self.representatives}
        for v in self.vectors:
            factors = known[self._turns.representative[v]]
            rows, row_sign, columns, column_sign = self._turn(self._turns.symmetry[v])
            yield (
                v,
                LowRank(
                    row_sign[:, None] * factors.left[rows],
                    factors.right[:, columns] * column_sign,
                ),
            )

    def _turn(self, q: int) -> tuple[np.ndarray, ...]:
        """Rows and columns, with signs, of the representative that make up the operator."""
        turn, count = self._turns, len(self._points)
        rows = (turn.component_out[q][:, None] * count + turn.inverse[q]).ravel()
        row_sign = np.repeat(turn.sign_out[q], count)
        # component_in says which component each one of the representative comes from.
        back = np.argsort(turn.component_in[q])
        columns = (back[:, None] * count + turn.inverse[q]).ravel()
        return rows, row_sign, columns, np.repeat(turn.sign_in[q][back], count)

    def _shift(self, v: int) -> np.ndarray:
        return self._edge * vector_offset(v)


def _root_weights(grid: Grid) -> np.ndarray:
    """Square roots of the quadrature weights of all nodes (N,), of mean square 1."""
    if grid.kind != "chebyshev":
        return np.ones(grid.nodes**3)
    # integral of f over [-1, 1] ~ (pi / nodes) sum_a sin(t_a) f(cos(t_a))
    w = np.sin(np.pi * (np.arange(grid.nodes) + 0.5) / grid.nodes)
    w = np.sqrt(w / w.mean())
    return np.einsum("a,b,c->abc", w, w, w).ravel()


def _range(factors: LowRank) -> np.ndarray:
    """left @ right times an orthogonal matrix: same range and norm, r columns."""
    return factors.left @ np.linalg.qr(factors.right.T, mode="r").T


def _corange(factors: LowRank) -> np.ndarray:
    """(left @ right)^T times an orthogonal matrix."""
    return factors.right.T @ np.linalg.qr(factors.left, mode="r").T


def _contiguous(matrix: np.ndarray, dtype: np.dtype) -> np.ndarray:
    return np.ascontiguousarray(matrix, dtype=dtype)


def _checked(eps: float) -> float:
    if not 0.0 < eps < 1.0:
        raise ValueError(f"eps = {eps}: must be between 0 and 1")
    return float(eps)
