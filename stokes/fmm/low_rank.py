"""Low-rank factors of matrices given by their rows and columns.

Norms are Frobenius norms and tolerances relative to the matrix approximated, always.

m, n rows and columns, r rank: matrix (m, n) ~ left (m, r) @ right (r, n)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# rows(i) -> (len(i), n), columns(j) -> (m, len(j)) for index arrays i, j.
Slices = Callable[[np.ndarray], np.ndarray]

# The residual of a cross approximation is looked at in this many rows before it is believed.
_SAMPLED_ROWS = 24
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class LowRank:
    """The product left (m, r) @ right (r, n)."""

    left: np.ndarray
    right: np.ndarray

    @property
    def rank(self) -> int:
        return self.left.shape[1]

    def dense(self) -> np.ndarray:
        return self.left @ self.right


def tail_rank(sigma: np.ndarray, tolerance: float) -> int:
    """Smallest r with sqrt(sum_{k >= r} sigma_k^2) <= tolerance * sqrt(sum_k sigma_k^2).

    sigma : (k,) singular values, falling. A zero matrix has rank 0.
    """
    if len(sigma) == 0 or sigma[0] == 0.0:
        return 0
    tails = np.sqrt(np.cumsum((sigma[::-1] / sigma[0]) ** 2)[::-1])
    return int(np.count_nonzero(tails > tolerance * tails[0]))


def cross_approximation(
    rows: Slices, columns: Slices, shape: tuple[int, int], tolerance: float
) -> LowRank:
    """Adaptive cross approximation with partial pivoting.

    Each step takes one row and one column of the residual; the next row is where the last column
    was largest. Pivoting that way can miss blocks that do not couple (the components of a tensor
    in a plane of symmetry, say), so when the last cross is small the residual is evaluated in
    rows spread over the matrix, others each time, and the search goes on from the worst of them
    until their residual is below `tolerance` in the mean square as well.

    Cost: (m + n) r entries of the matrix, O((m + n) r^2) operations.
    """
    m, n = shape
    most = min(m, n)
    left = np.empty((m, min(most, 32)))
    right = np.empty((min(most, 32), n))
    rank, squares, probes = 0, 0.0, 0
    unit = 1.0  # the first pivot: what is left and right is so scaled that no square underflows
    free = np.ones(m, dtype=bool)
    pivot_row = 0
    while rank < most:
        if rank == right.shape[0]:
            left, right = _grown(left, right, min(most, 2 * rank))
        row = rows(np.array([pivot_row]))[0] / unit - left[pivot_row, :rank] @ right[:rank]
        free[pivot_row] = False
        pivot_column = int(np.argmax(np.abs(row)))
        cross = 0.0
        if row[pivot_column] != 0.0:
            if rank == 0:
                unit = abs(row[pivot_column])
                row = row / unit
            column = columns(np.array([pivot_column]))[:, 0] / unit
            column = column - left[:, :rank] @ right[:rank, pivot_column]
            row = row / row[pivot_column]
            left[:, rank], right[rank] = column, row
            cross = np.linalg.norm(column) * np.linalg.norm(row)
            # |A + u v|^2 = |A|^2 + 2 <A, u v> + |u|^2 |v|^2
            squares += cross**2 + 2.0 * (column @ left[:, :rank]) @ (right[:rank] @ row)
            rank += 1
            next_row = np.where(free, np.abs(column), -1.0)
            pivot_row = int(np.argmax(next_row))
        if not free.any():
            break
        if cross <= tolerance * np.sqrt(max(squares, 0.0)):
            sample = _spread_rows(m, probes)
            probes += 1
            residual = rows(sample) / unit - left[sample, :rank] @ right[:rank]
            norms = np.linalg.norm(residual, axis=1)
            mean_square = np.mean(norms**2) * m
            if mean_square <= tolerance**2 * max(squares, 0.0):
                break
            worst = int(np.argmax(np.where(free[sample], norms, -1.0)))
            if not free[sample[worst]]:
                break
            pivot_row = int(sample[worst])
    return LowRank(unit * left[:, :rank], right[:rank].copy())


def recompressed(factors: LowRank, tolerance: float) -> LowRank:
    """The best approximation of smallest rank within `tolerance`, by two QR and one small SVD.

    The square roots of the singular values go to both sides.
    """
    if factors.rank == 0:
        return factors
    q_left, r_left = np.linalg.qr(factors.left)
    q_right, r_right = np.linalg.qr(factors.right.T)
    u, sigma, vt = np.linalg.svd(r_left @ r_right.T)
    rank = tail_rank(sigma, tolerance)
    root = np.sqrt(sigma[:rank])
    return LowRank((q_left @ u[:, :rank]) * root, root[:, None] * (vt[:rank] @ q_right.T))


def approximate(rows: Slices, columns: Slices, shape: tuple[int, int], tolerance: float) -> LowRank:
    """Cross approximation to a tenth of the tolerance, then truncated to the rest of it."""
    return recompressed(cross_approximation(rows, columns, shape, 0.1 * tolerance), 0.9 * tolerance)


def common_range(blocks: list[np.ndarray], tolerance: float) -> np.ndarray:
    """Orthonormal basis (m, r) of the range of the blocks (m, k_i) side by side.

    The part of the blocks outside of the basis is at most `tolerance` of their norm. The blocks
    are folded into a triangle a few at a time: nothing larger than (m, 4 m) is ever stored, and
    small singular values keep their digits (those of a Gram matrix would be lost below 1e-8).
    """
    m = blocks[0].shape[0]
    triangle = np.zeros((0, m))
    waiting: list[np.ndarray] = []
    width = 0
    for block in blocks:
        waiting.append(block.T)
        width += block.shape[1]
        if width >= 3 * m:
            triangle = np.linalg.qr(np.concatenate([triangle, *waiting]), mode="r")
            waiting, width = [], 0
    if width:
        triangle = np.linalg.qr(np.concatenate([triangle, *waiting]), mode="r")
    if len(triangle) == 0:
        return np.zeros((m, 0))
    _, sigma, basis = np.linalg.svd(triangle, full_matrices=False)
    return basis[: tail_rank(sigma, tolerance)].T


def _grown(left: np.ndarray, right: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Copies of the factors with room for `rank` crosses."""
    old = right.shape[0]
    wide, tall = np.empty((left.shape[0], rank)), np.empty((rank, right.shape[1]))
    wide[:, :old], tall[:old] = left, right
    return wide, tall


def _spread_rows(m: int, probe: int) -> np.ndarray:
    """Up to _SAMPLED_ROWS rows spread evenly, other ones for each probe, the same in each run."""
    count = min(m, _SAMPLED_ROWS)
    k = np.arange(probe * count, (probe + 1) * count)
    return np.unique((k * _GOLDEN % 1.0 * m).astype(np.int64))
