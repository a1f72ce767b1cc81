"""Multipole to local transfers on equispaced grids, as products in Fourier space.

Between the grids of two boxes the kernel depends on differences of nodes only: the transfer is a
Toeplitz matrix in each direction, part of a circulant one of 2 l - 1, l nodes per direction, which
Fourier transforms make diagonal (P. Blanchard, PhD thesis, Université de Bordeaux 2017, sec. 5.1):

    L_t = F^-1 sum over s of K_v(s,t) F M_s,    one transform for each multipole and each local.

Three things make it fast. The lengths are small, so that products with small real matrices of
cosines and sines, which skip padding and what is thrown away, take the place of fast transforms.
Of the spectrum ((2 l - 1)^3 + 1) / 2 frequencies say all, and they
are worked through in blocks of one vector register, whose tables stay in the cache. And where most
boxes have all their siblings, 27 products stand for the 64 between two families of children.

K_-v = parity conj(K_v) halves the tables of even and odd kernels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stokes.fmm import _kernels_transfer as kernels
from stokes.fmm._transfer_levels import is_smooth, levels_with_tables
from stokes.fmm.interpolation import Grid
from stokes.fmm.kernels import Kernel
from stokes.fmm.symmetry import VECTORS, vector_index, vector_offset
from stokes.fmm.windows import windows

# Cost of a product in the loop over pairs against one in the loop over families: for scalar
# kernels the former waits for its additions, for others both wait for the cache.
_PAIR_COST, _PAIR_COST_SCALAR = 1.3, 2.2
# Distinct components from which on the tables of all vectors overflow the first-level cache.
_LARGE_TABLES = 3
# Memory for the spectra of a part of the frequencies.
_SPECTRA_BYTES = 1 << 28
# Sweeps over rows of values of the kernel at a time, about, when tables are made.
_SWEEPS = 8
# Nodes from which on each kz fills whole blocks, so that no turn computes one in part.
_WHOLE_TURNS = 8


class FourierTransfer:
    """The transfer of a kernel between the boxes of a level.

    kernel        homogeneous kernels have one table, others one a level
    grid          an equispaced grid, of any extent about the centre of the box
    edges         (levels,) edge of a box at each level, root first
    admissibility "standard", or "smooth": boxes of the last level reach their neighbours too
    dtype         of tables, multipoles and locals
    memory        bytes of spectra held at a time; more frequencies are done in turns
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
        memory: int = _SPECTRA_BYTES,
    ) -> None:
        smooth = is_smooth(admissibility)
        if grid.kind != "equispaced":
            raise ValueError(f"grid {grid.kind!r}: Fourier transfers need an equispaced grid")
        if grid.nodes < 2:
            raise ValueError(f"nodes = {grid.nodes}: must be >= 2")
        self.kernel = kernel
        self.nodes = grid.nodes
        self._grid = grid
        self.dtype = np.dtype(dtype)
        self.threads = threads
        self._memory = memory
        self._lanes = kernels.VECTOR_BYTES // self.dtype.itemsize
        self._edges = np.asarray(edges, dtype=np.float64)
        self._work = np.empty(0, self.dtype)
        self._frequencies = _Frequencies(self.nodes, self._lanes)
        self._stored = _stored_vectors(smooth, kernel.parity != 0)
        self._tables = {
            level: self._build(edge)
            for level, edge, _ in levels_with_tables(kernel, self._edges, smooth)
        }
        number = np.asarray(kernel.entry, dtype=np.int64).reshape(-1)
        self._entry = number * 2 * self._lanes

    @property
    def bytes(self) -> int:
        """Memory of the tables."""
        return sum(table.nbytes for table in self._tables.values())

    @property
    def spectra_bytes(self) -> int:
        """Memory of the spectra of multipoles and locals, kept once used for the next `apply`."""
        return self._work.nbytes

    def add(
        self,
        level: int,
        multipoles: NDArray,
        start: NDArray,
        source: NDArray,
        vector: NDArray,
        targets: NDArray,
        local: NDArray,
        cells: NDArray | None = None,
    ) -> None:
        """Add to the locals of target boxes what their source boxes of one level give.

        multipoles : (boxes, n_in, nodes, nodes, nodes); local : (boxes, n_out, ...), added to
        start : (k + 1,) pairs start[t] : start[t + 1] belong to the box targets[t]
        source, vector : (pairs,) box of the source, transfer vector 0..342
        cells : (boxes, 3) coordinates of the boxes in the lattice of the level; without them
            each pair is taken by itself, which is slower where most boxes have their siblings
        """
        self.apply(self.prepare(level, start, source, vector, targets, cells), multipoles, local)

    def prepare(
        self,
        level: int,
        start: NDArray,
        source: NDArray,
        vector: NDArray,
        targets: NDArray,
        cells: NDArray | None = None,
    ) -> OrderedPairs:
        """Order the pairs of a level (arguments of `add`) for any number of calls of `apply`."""
        start = np.asarray(start, dtype=np.int64)
        busy = np.flatnonzero(np.diff(start) > 0)
        targets = np.asarray(targets)[busy]
        if len(targets) == 0:
            none = np.empty(0, dtype=np.int64)
            return OrderedPairs(level, none, targets, none, none, none, none, None)
        source, vector = (np.asarray(a[start[0] : start[-1]]) for a in (source, vector))
        rank = np.zeros(source.max() + 1, dtype=np.int64)
        rank[source] = 1
        sources = np.flatnonzero(rank)
        families = None
        if cells is not None:
            families = self._families(np.asarray(cells), sources, targets, vector)
        if families is not None:
            none = np.empty(0, dtype=np.int64)
            return OrderedPairs(level, sources, targets, none, none, none, none, families)
        rank[sources] = np.arange(len(sources))
        bounds = np.append(start[busy], start[-1]) - start[0]
        target = np.repeat(np.arange(len(targets)), np.diff(bounds))
        first, order = bounds, slice(None)
        vector = vector.astype(np.int64)
        if self.kernel.n_unique >= _LARGE_TABLES:
            cluster = _CLUSTER[vector]
            order = np.argsort(cluster, kind="stable")
            run = cluster[order].astype(np.int64) * len(targets) + target[order]
            first = np.append(np.flatnonzero(np.diff(run, prepend=-1)), len(run))
        place, vector, target = rank[source[order]], vector[order], target[order][first[:-1]]
        return OrderedPairs(level, sources, targets, first, target, place, vector, None)

    def _families(
        self, cells: NDArray, sources: NDArray, targets: NDArray, vector: NDArray
    ) -> _Families | None:
        """Return the pairs by families of siblings if that is possible and cheaper."""
        group = kernels.GROUP_THREE if self.kernel.n_out % 3 == 0 else kernels.GROUP
        cells_of = (cells[boxes].astype(np.int64) for boxes in (sources, targets))
        families = _families(*cells_of, vector, group)
        scalar = self.kernel.n_in * self.kernel.n_out == 1
        pair_cost = _PAIR_COST_SCALAR if scalar else _PAIR_COST
        if families is None or families.products >= pair_cost * len(vector):
            return None
        return families

    def apply(self, pairs: OrderedPairs, multipoles: NDArray, local: NDArray) -> None:
        """Add to the locals what the prepared pairs of a level give: see `add`."""
        if len(pairs.targets) == 0:
            return
        if multipoles.dtype != self.dtype or local.dtype != self.dtype:
            raise TypeError(f"multipoles and locals must be {self.dtype}")
        if not (multipoles.flags.c_contiguous and local.flags.c_contiguous):
            raise ValueError("multipoles and locals must be contiguous in C order")
        table, scale = self._table(pairs.level)
        spectra = _Rows(pairs.sources, self.kernel.n_in, self.nodes**3, self._lanes)
        result = _Rows(pairs.targets, self.kernel.n_out, self.nodes**3, self._lanes)
        per_block = (spectra.total + result.total) * 2 * kernels.VECTOR_BYTES
        blocks = max(1, min(self._memory // per_block, self._frequencies.blocks))
        M_size, L_size = (blocks * rows.total * 2 * self._lanes for rows in (spectra, result))
        if len(self._work) < M_size + L_size:
            self._work = _aligned(M_size + L_size, self.dtype)
        M, L = self._work[:M_size], self._work[M_size : M_size + L_size]
        for first, last in self._frequencies.turns(blocks):
            some = _Part(self._frequencies, first, last, self.nodes, self._lanes, self.dtype)
            some.forward(multipoles, spectra, M, self.threads)
            self._translate(pairs, table, first, last, M, spectra, L, result)
            some.backward(L, result, scale, local, self.threads)

    def _translate(
        self,
        pairs: OrderedPairs,
        table: NDArray,
        first: int,
        last: int,
        M: NDArray,
        spectra: _Rows,
        L: NDArray,
        result: _Rows,
    ) -> None:
        """Spectra L of the locals from those of the multipoles, M, in the blocks first : last.

        M, L : flat [block][row][re, im][lanes] of the rows of spectra, of result
        """
        lanes, kernel = self._lanes, self.kernel
        size = kernel.n_unique * 2 * lanes
        stride = table.size // self._frequencies.blocks
        workers = max(1, min(self.threads, last - first))
        common = (table[first * stride :], stride, size, lanes, self._stored, self._parity)
        M_stride, L_stride = spectra.total * 2 * lanes, result.total * 2 * lanes
        if pairs.families is not None:
            self._translate_families(
                pairs.families, common, last - first, M, M_stride, spectra, L, L_stride, result
            )
            return
        full = _aligned_rows(workers, VECTORS * size, self.dtype)
        in_size, out_size = kernel.n_in * 2 * lanes, kernel.n_out * 2 * lanes
        steps = np.stack([pairs.vector * size, pairs.place * in_size], 1).reshape(-1)
        kernels.translate_pairs.using(self.threads)(
            *common, full, last - first, M, M_stride, steps, pairs.start,
            pairs.target * out_size, self._entry, kernel.n_in, kernel.n_out, L, L_stride,
        )  # fmt: skip

    def _translate_families(
        self,
        families: _Families,
        common: tuple[Any, ...],
        blocks: int,
        M: NDArray,
        M_stride: int,
        spectra: _Rows,
        L: NDArray,
        L_stride: int,
        result: _Rows,
    ) -> None:
        """As `_translate`, by families.

        common : tables, numbers in a block of them and in a vector's, lanes, stored, parity
        M_stride, L_stride : numbers in a block
        """
        lanes, kernel = self._lanes, self.kernel
        size, group = kernel.n_unique * 2 * lanes, families.group
        in_size, out_size = kernel.n_in * 2 * lanes, kernel.n_out * 2 * lanes
        parents = len(families.source_children)
        sizes = [
            VECTORS * size,
            27 * len(families.directions) * size,
            3 * (parents + 1) * in_size,
            3 * group * out_size,
        ]
        places = np.concatenate([[0], np.cumsum(sizes)])
        work = _aligned_rows(max(1, min(self.threads, blocks)), places[-1], self.dtype)
        rows = vector_index(2 * families.directions[:, None] + _BLOCK) * size
        steps = families.steps * np.array([size] + group * [in_size])
        stored = self._stored if families.neighbours else np.where(_NEAR, -1000, self._stored)
        # Offsets of the children in a block; missing ones are the box of zeros.
        M.reshape(-1, M_stride)[:, spectra.none * 2 * lanes :] = 0.0
        from_ = _offsets(families.source_children, in_size, spectra.none * 2 * lanes)
        to = _offsets(families.target_children, out_size, result.none * 2 * lanes)
        kernels.translate_families.using(self.threads)(
            *common[:4], stored, common[5], rows.reshape(-1), work, blocks, M, M_stride, from_,
            steps.reshape(-1), families.start, group, self._entry, kernel.n_in, kernel.n_out, L,
            L_stride, to, _ORDER, places,
        )  # fmt: skip

    @property
    def _parity(self) -> float:
        return self.dtype.type(self.kernel.parity)

    def _table(self, level: int) -> tuple[NDArray, float]:
        if self.kernel.degree is None:
            return self._tables[level], self.dtype.type(1.0)
        return self._tables[0], self.dtype.type(self._edges[level] ** self.kernel.degree)

    def _build(self, edge: float) -> NDArray:
        """Spectra of the kernel for the stored vectors: [block][vector][component][re, im]."""
        n, lanes, blocks = 2 * self.nodes - 1, self._lanes, self._frequencies.blocks
        vectors, components = np.flatnonzero(self._stored >= 0), self.kernel.n_unique
        total = len(vectors) * components
        total += -total % lanes
        table = _aligned(blocks * total * 2 * lanes, self.dtype)
        part = _Part(self._frequencies, 0, blocks, n, lanes, self.dtype, scale=2.0 / n**3)
        # a few vectors at a time, whole sweeps of rows: their values stay in the cache
        step = lanes * max(1, _SWEEPS // components)
        for first in range(0, len(vectors), step):
            axes = _differences(self._grid, edge, vectors[first : first + step])
            values = windows(self.kernel, axes, self.dtype)
            rows = _Rows(np.arange(len(values)), components, n**3, lanes, exact=True)
            begin = first * components * 2 * lanes
            part.forward(values, rows, table[begin:], self.threads, total)
        shaped = table.reshape(blocks, total, 2, lanes)
        for frequency in np.flatnonzero(self._frequencies.weight != 1.0):
            weight = self.dtype.type(self._frequencies.weight[frequency])
            shaped[frequency // lanes, :, :, frequency % lanes] *= weight
        return table


@dataclass(frozen=True)
class OrderedPairs:
    """Pairs of one level in the order of the loops over them.

    sources, targets : boxes that occur. Then either, by families of siblings, where it pays,
    families
    or runs of pairs of one target (its place in `targets`), their tables a few neighbours:
    start : (runs + 1,), target : (runs,), place of the source in `sources`, vector : (pairs,)
    """

    level: int
    sources: NDArray
    targets: NDArray
    start: NDArray
    target: NDArray
    place: NDArray
    vector: NDArray
    families: _Families | None


@dataclass(frozen=True)
class _Families:
    """Pairs of parents, `group` targets at a time.

    steps (rows, 1 + group): direction, then source parent of each target; the number of parents
    stands for none. products: those of a frequency and an entry, for the choice.
    """

    group: int
    directions: NDArray
    neighbours: bool
    source_children: NDArray
    target_children: NDArray
    steps: NDArray
    start: NDArray
    products: int


_OFFSETS = vector_offset(np.arange(VECTORS))
_BLOCK = np.stack(np.meshgrid(*3 * [np.arange(-1, 2)], indexing="ij"), -1).reshape(-1, 3)
_NEAR = np.abs(_OFFSETS).max(axis=1) <= 1
# Which of the 27 regions before, about and behind the target in each direction a source is in.
_CLUSTER = ((np.sign(_OFFSETS) * (np.abs(_OFFSETS) > 1) + 1) @ np.array([9, 3, 1])).astype(np.int8)


def _octants(first: int, second: int) -> list[list[int]]:
    """Octants (x, y, z bits) in the products (wx, wy): all for digit 0, lower for `first`."""
    halves = [(0, 1), None, None]
    halves[first], halves[second] = (0,), (1,)
    rows = []
    for w in range(9):
        row = [4 * x + 2 * y + z for x in halves[w // 3] for y in halves[w % 3] for z in (0, 1)]
        rows.append(row + (8 - len(row)) * [0])
    return rows


_ORDER = np.array([_octants(1, 2), _octants(2, 1)])


def _families(sources: NDArray, targets: NDArray, vector: NDArray, group: int) -> _Families | None:
    """Group pairs by parents; None if they are not all there are between their families."""
    neighbours = bool(_NEAR[vector].any())
    directions = _BLOCK if neighbours else _BLOCK[np.any(_BLOCK != 0, axis=1)]
    lowest = np.minimum(sources.min(axis=0), targets.min(axis=0)) >> 1
    source_parent, source_children = _parents(sources, lowest)
    target_parent, target_children = _parents(targets, lowest)
    order = np.argsort(source_parent)
    wanted = target_parent[:, None] - _code(directions)
    place = np.searchsorted(source_parent[order], wanted)
    place = order[np.minimum(place, len(order) - 1)]
    none = len(source_parent)
    neighbour = np.where(source_parent[place] == wanted, place, none)
    count = _count(source_children, target_children, neighbour, directions, neighbours)
    if count != len(vector):
        return None
    padding = -len(target_parent) % group
    neighbour = np.pad(neighbour, ((0, padding), (0, 0)), constant_values=none)
    target_children = np.pad(target_children, ((0, padding), (0, 0)), constant_values=-1)
    grouped = neighbour.reshape(-1, group, len(directions))
    number, direction = np.nonzero((grouped != none).any(axis=1))
    steps = np.concatenate([direction[:, None], grouped[number, :, direction]], axis=1)
    start = np.searchsorted(number, np.arange(len(grouped) + 1))
    products = 27 * group * len(steps)
    return _Families(
        group, directions, neighbours, source_children, target_children, steps, start, products
    )


def _offsets(children: NDArray, size: int, none: int) -> NDArray:
    """Offsets (8 parents,) of children from their numbers."""
    return np.where(children < 0, none, children * size).reshape(-1)


def _code(cells: NDArray) -> NDArray:
    """One number for the three coordinates; codes of differences are differences of codes."""
    return (cells[:, 0] * (1 << 42)) + (cells[:, 1] * (1 << 21)) + cells[:, 2]


def _parents(cells: NDArray, lowest: NDArray) -> tuple[NDArray, NDArray]:
    """Codes of the parents in the order of the boxes, and their children (parents, 8) or -1."""
    codes, first, place = np.unique(
        _code((cells >> 1) - lowest + 1), return_index=True, return_inverse=True
    )
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    children = np.full((len(codes), 8), -1, dtype=np.int64)
    octant = (cells & 1) @ np.array([4, 2, 1])
    children[rank[place.reshape(-1)], octant] = np.arange(len(cells))
    return codes[order], children


def _count(
    source_children: NDArray,
    target_children: NDArray,
    neighbour: NDArray,
    directions: NDArray,
    neighbours: bool,
) -> int:
    """Pairs of children far enough apart, or of all of them with `neighbours`.

    source_children, target_children : (parents, 8) of boxes, -1 for none
    neighbour : (target parents, k) source parent, their number for none, by directions (k, 3)
    """
    bits = np.array([[o >> 2 & 1, o >> 1 & 1, o & 1] for o in range(8)])
    d = 2 * directions[:, None, None] + bits[:, None] - bits
    far = np.ones(d.shape[:-1], dtype=bool) if neighbours else np.abs(d).max(axis=-1) > 1
    here = np.pad(source_children >= 0, ((0, 1), (0, 0)))
    total = 0
    for k in range(len(directions)):
        total += int(((target_children >= 0) @ (far[k].astype(int)) * here[neighbour[:, k]]).sum())
    return total


def _stored_vectors(smooth: bool, mirrored: bool) -> NDArray:
    """Number of each vector's table; -1 - number where it is the mirrored one's; -1000 if none."""
    stored = np.full(VECTORS, -1000, dtype=np.int64)
    count = 0
    for v in range(VECTORS):
        if _NEAR[v] and not smooth:
            continue
        opposite = VECTORS - 1 - v
        if mirrored and opposite < v:
            stored[v] = -1 - stored[opposite]
        else:
            stored[v] = count
            count += 1
    return stored


def _differences(grid: Grid, edge: float, vectors: NDArray) -> NDArray[np.float64]:
    """Differences of the nodes of two boxes for each vector: (vectors, 3, 2 nodes - 1)."""
    difference = grid.extent * edge * np.linspace(-1.0, 1.0, 2 * grid.nodes - 1)
    return difference + edge * _OFFSETS[vectors][:, :, None]


class _Frequencies:
    """The half of the frequencies of a real grid that says all, kz by kz, in whole blocks.

    With many nodes each kz begins a block.

    Frequencies are (kx, ky, kz) with |kx|, |ky| < l and 0 <= kz < l; of kz = 0 those with kx > 0,
    or kx = 0 and ky >= 0. weight: 1 for a pair k, -k, half of it for k = 0, 0 where a block is
    filled up.
    """

    def __init__(self, nodes: int, lanes: int) -> None:
        self.nodes = nodes
        number, weight, count = -np.ones((2 * nodes - 1, 2 * nodes - 1, nodes), np.int64), [], 0
        for kz in range(nodes):
            kx, ky = np.meshgrid(*2 * [np.arange(1 - nodes, nodes)], indexing="ij")
            kept = (kz > 0) | (kx > 0) | ((kx == 0) & (ky >= 0))
            number[kept, kz] = count + np.arange(kept.sum())
            zero = (kx[kept] == 0) & (ky[kept] == 0) & (kz == 0)
            spare = -int(kept.sum()) % lanes if nodes >= _WHOLE_TURNS else 0
            weight.append(np.pad(np.where(zero, 0.5, 1.0), (0, spare)))
            count += len(weight[-1])
        self.number = number
        self.blocks = -(-count // lanes)
        self.weight = np.zeros(self.blocks * lanes)
        self.weight[:count] = np.concatenate(weight)
        self._lanes = lanes
        self.first = np.where(number < 0, count, number).min(axis=(0, 1))
        self.last = number.max(axis=(0, 1))

    def turns(self, blocks: int) -> Iterator[tuple[int, int]]:
        """Ranges (first, last) of at most so many blocks, ending with a kz where they can."""
        ends = -(-(self.last + 1) // self._lanes)
        first = 0
        while first < self.blocks:
            last = min(first + blocks, self.blocks)
            whole = ends[(ends > first) & (ends <= last)]
            if len(whole):
                last = int(whole[-1])
            yield first, last
            first = last


class _Part:
    """Transforms between grids of some size and a range of the blocks of frequencies.

    scale : factor of the forward transform
    """

    def __init__(
        self,
        frequencies: _Frequencies,
        first: int,
        last: int,
        size: int,
        lanes: int,
        dtype: np.dtype,
        scale: float = 1.0,
    ) -> None:
        nodes = frequencies.nodes
        n = 2 * nodes - 1
        self._size, self._lanes, self._blocks, self._dtype = size, lanes, last - first, dtype
        low, high = first * lanes, last * lanes
        k0 = int(np.searchsorted(frequencies.last, low))
        k1 = int(np.searchsorted(frequencies.first, high))
        # Grids of n are the kernel's: differences of nodes about zero.
        x = np.arange(size) - (nodes - 1 if size == n else 0)
        angle = 2.0 * np.pi / n * np.outer(np.arange(nodes), x)
        cos, sin = np.cos(angle), np.sin(angle)
        self._matrix_z = (scale * np.concatenate([cos[k0:k1], sin[k0:k1]])).astype(dtype)
        self._matrix = np.concatenate([cos, sin[1:]]).astype(dtype)
        n_z = 2 * (k1 - k0)
        b = size * size * max(size, n_z) * lanes
        c = b + size * n * n_z * lanes
        d = c + n * n * n_z * lanes
        zero = d + max(size * size * n_z, 2 * self._blocks * lanes) * lanes
        trash = zero + 2 * lanes
        self._places = np.array([b, c, d, zero])
        self._work = trash + 2 * lanes
        self._offsets(frequencies, k0, k1, low, high, trash)

    def _offsets(self, frequencies, k0, k1, low, high, trash) -> None:
        nodes, lanes = frequencies.nodes, self._lanes
        n, n_z = 2 * nodes - 1, 2 * (k1 - k0)
        _, c, d, zero = self._places
        shape = (k1 - k0, nodes, nodes)
        kz, ky, kx = (k.reshape(-1) for k in np.indices(shape))
        real = np.empty((len(kz), 8), dtype=np.int64)
        for i in range(8):
            X, Y, Z = i >> 2, i >> 1 & 1, i & 1
            x, y, z = kx + X * (nodes - 1), ky + Y * (nodes - 1), kz + Z * (k1 - k0)
            missing = (X & (kx == 0)) | (Y & (ky == 0))
            real[:, i] = np.where(missing, -1, c + ((x * n + y) * n_z + z) * lanes)
        complex_ = np.empty((len(kz), 4), dtype=np.int64)
        for i, (sx, sy) in enumerate([(1, 1), (1, -1), (-1, 1), (-1, -1)]):
            f = frequencies.number[sx * kx + nodes - 1, sy * ky + nodes - 1, kz + k0]
            twice = ((sx < 0) & (kx == 0)) | ((sy < 0) & (ky == 0))
            missing = twice | (f < low) | (f >= high)
            complex_[:, i] = np.where(missing, -1, d + 2 * (f - low) * lanes)
        self._read_real = np.where(real < 0, zero, real).reshape(-1)
        self._write_real = np.where(real < 0, trash, real).reshape(-1)
        self._read_complex = np.where(complex_ < 0, zero, complex_).reshape(-1)
        self._write_complex = np.where(complex_ < 0, trash, complex_).reshape(-1)

    def forward(
        self, values: NDArray, rows: _Rows, spectra: NDArray, threads: int, total: int = 0
    ) -> None:
        """Spectra of the rows of values, of `total` in a block (default: these only)."""
        work = _aligned_rows(threads, self._work, self._dtype)
        kernels.forward.using(threads)(
            values.reshape(-1), rows.offsets, self._matrix_z, self._matrix, self._size,
            self._read_real, self._write_complex, self._places, work, self._lanes, self._blocks,
            spectra, total or rows.total,
        )  # fmt: skip

    def backward(
        self, spectra: NDArray, rows: _Rows, scale: float, values: NDArray, threads: int
    ) -> None:
        """Add the inverse transform, times scale, to the rows of values."""
        work = _aligned_rows(threads, self._work, self._dtype)
        kernels.backward.using(threads)(
            spectra, rows.total, np.ascontiguousarray(self._matrix_z.T),
            np.ascontiguousarray(self._matrix.T), self._size, self._write_real,
            self._read_complex, self._places, work, self._lanes, self._blocks, scale,
            rows.offsets, rows.used, values.reshape(-1),
        )  # fmt: skip


class _Rows:
    """Rows of components of boxes: a vector's lanes at a time, the last one filled up.

    offsets : of each row in an array (boxes, components, length)
    none : first row, after all others, of a box that stands for missing ones
    """

    def __init__(
        self, boxes: NDArray, components: int, length: int, lanes: int, exact: bool = False
    ) -> None:
        number = np.asarray(boxes, dtype=np.int64)[:, None] * components + np.arange(components)
        offsets = number.reshape(-1) * length
        self.used = len(offsets)
        self.offsets = np.pad(offsets, (0, -len(offsets) % lanes), mode="edge")
        self.none = len(self.offsets)
        self.total = self.none + (0 if exact else components)


def _aligned(count: int, dtype: np.dtype) -> NDArray:
    """Zeros that begin at a cache line, so that no vector lies across two."""
    itemsize = np.dtype(dtype).itemsize
    spare = kernels.VECTOR_BYTES // itemsize
    array = np.zeros(count + spare, dtype)
    shift = -array.ctypes.data % kernels.VECTOR_BYTES // itemsize
    return array[shift : shift + count]


def _aligned_rows(rows: int, count: int, dtype: np.dtype) -> NDArray:
    """Array (rows, count) whose rows begin at cache lines, rounded up to whole ones."""
    spare = kernels.VECTOR_BYTES // np.dtype(dtype).itemsize
    count += -count % spare
    return _aligned(rows * count, dtype).reshape(rows, count)
