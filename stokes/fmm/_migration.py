"""Points from the ranks of their caller to ranks in the order of the Morton curve, and back.

All sources and targets, of all ranks, are ordered by (Morton key, global index), the global index
being the place in the caller's arrays of all ranks one after another. P - 1 splitters cut that
order into one interval a rank; the index in a splitter lets points of equal key be divided.

Symbols: n points on this rank, of the caller; m of this rank's interval; P ranks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem_mpi import morton
from dem_mpi.parallel import Halo, Parallel
from stokes.fmm import _distribution as kernels

_DIGIT = 7  # bits found by one reduction; divides 63, so that no candidate overflows


@dataclass(frozen=True)
class Splitters:
    """Rank r owns the pairs (key, index) from splitter r - 1 up to, not including, splitter r.

    key, index: (P - 1,) int64, rising pairs.
    """

    key: NDArray[np.int64]
    index: NDArray[np.int64]

    def owner(self, keys: NDArray[np.int64], first_index: int) -> NDArray[np.int32]:
        """The rank (n,) of points with `keys` (n,) and global indices from `first_index` on."""
        return kernels.owners(self.key, self.index, keys, first_index)


def find_splitters(parallel: Parallel, point_sets: list[tuple[NDArray, int]]) -> Splitters:
    """Collective. Splitters that give every rank as many points as another, to within one index.

    point_sets: (keys (n,), first global index) of each set; a point counts once in every set it
        belongs to. Points of one key and one index stay together.

    The digits of all splitters are found together, the most significant first, by one reduction
    of 127 (P - 1) sums a digit; they do not depend on how the points are spread.
    """
    ordered = []
    for keys, first_index in point_sets:
        order = np.argsort(keys, kind="stable")
        ordered.append((keys[order], first_index + order))
    total = parallel.sum(sum(len(keys) for keys, _ in point_sets))
    indices_end = parallel.max(max(first + len(keys) for keys, first in point_sets))
    quantile = np.array(
        [-(-total * s // parallel.size) for s in range(1, parallel.size)], dtype=np.int64
    )
    key, index = np.zeros_like(quantile), np.zeros_like(quantile)
    digits = np.arange(1, 1 << _DIGIT, dtype=np.int64)
    still = np.zeros_like(digits)

    def digit(key_step: NDArray, index_step: NDArray) -> NDArray[np.int64]:
        """How many of the steps leave fewer points below than the quantile."""
        some_keys, some_indices = key[:, None] + key_step, index[:, None] + index_step
        below = np.zeros(some_keys.size, dtype=np.int64)
        for keys, indices in ordered:
            below += kernels.counts_below(keys, indices, some_keys.ravel(), some_indices.ravel())
        parallel.sum_in_place(below)
        return np.count_nonzero(below.reshape(some_keys.shape) < quantile[:, None], axis=1)

    for shift in _digit_shifts(3 * morton.LEVELS):
        key += digit(digits << shift, still) << shift
    for shift in _digit_shifts(indices_end.bit_length()):
        index += digit(still, digits << shift) << shift
    return Splitters(key, index + 1)


def _digit_shifts(bits: int) -> range:
    """Positions of the digits of a number of so many bits, the highest first."""
    return range(_DIGIT * (max(bits - 1, 0) // _DIGIT), -1, -_DIGIT)


class Route:
    """The way of a caller's rows to the rank and place of their points on the curve, and back."""

    def __init__(self, parallel: Parallel, order: NDArray, halo: Halo | None, count: int) -> None:
        """Take the order (m,) of arrived rows; without a halo, of the caller's rows themselves."""
        self._parallel = parallel
        self._order = order
        self._halo = halo
        self.callers = count

    def __len__(self) -> int:
        """Number m of this rank's points."""
        return len(self._order)

    @classmethod
    def build(
        cls, parallel: Parallel, points: NDArray, keys: NDArray, owner: NDArray | None
    ) -> tuple[Route, NDArray[np.float64], NDArray[np.int64]]:
        """Collective. Route, positions (m, 3) and rising keys (m,) of this rank's points.

        points (n, 3), keys (n,) and owner (n,) are of the caller's points; no owner: one rank.
        """
        if owner is None:
            order = np.argsort(keys, kind="stable")
            return cls(parallel, order, None, len(points)), points[order], keys[order]
        by_owner = np.argsort(owner, kind="stable")  # rising rows for each rank
        ends = np.searchsorted(owner[by_owner], np.arange(parallel.size + 1))
        send = {r: by_owner[ends[r] : ends[r + 1]] for r in range(parallel.size)}
        halo = Halo.build(parallel, len(points), send)
        arrived_keys = _forwarded(halo, keys[:, None])[:, 0]
        # Arrivals are in the order of ranks and rows, so a stable sort leaves equal keys in the
        # order of their global indices.
        order = np.argsort(arrived_keys, kind="stable")
        route = cls(parallel, order, halo, len(points))
        return route, _forwarded(halo, points)[order], arrived_keys[order]

    def arrive(self, rows: NDArray) -> tuple[NDArray, NDArray]:
        """Collective among neighbours. Rows (n, c) where they are needed, and the order (m,).

        Row i of this rank's points is row order[i] of those returned.
        """
        return (rows if self._halo is None else _forwarded(self._halo, rows)), self._order

    def to_caller(self, columns: NDArray) -> NDArray:
        """Collective among neighbours. Columns (c, m) of this rank's points as rows (n, c)."""
        halo = self._halo
        if halo is None:
            rows = np.empty((self.callers, len(columns)), dtype=columns.dtype)
            kernels.put_transposed(columns, self._order, rows)
            return rows
        rows = np.zeros((self.callers + halo.ghosts, len(columns)), dtype=columns.dtype)
        kernels.put_transposed(columns, self._order, rows[self.callers :])
        halo.reverse_add(rows)
        return rows[: self.callers]


def _forwarded(halo: Halo, rows: NDArray) -> NDArray:
    """Collective among neighbours. What a halo brings of everybody's rows."""
    values = np.empty((halo.owned + halo.ghosts, *rows.shape[1:]), dtype=rows.dtype)
    values[: halo.owned] = rows
    halo.forward(values)
    return values[halo.owned :]
