"""Small factors of a large matrix, and the ranks at which they may be cut.

Symbols: M (m, n) an unfolding of a tensor; L (m, p) a factor with L L' = M M' but for what is said
to be missed, p <= min(m, n): whatever is orthonormal on its right does not matter to the left
singular vectors U of M, nor to its singular values s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from compress.unfolding import Unfolding

EPS = float(np.finfo(np.float64).eps)
# The energies (squared norms) that a Gram matrix gives are wrong by up to this fraction of
# ||M||_F^2. Sums in the blocked order of a BLAS err by a few eps of their terms' absolute values;
# m eigenvalues together by less than m eps in the worst case, sqrt(m) eps in the mean.
GRAM_FLOOR = 64.0 * EPS


@dataclass(frozen=True)
class Factor:
    """L (m, p), and the energy ||M||_F^2 - ||L||_F^2 that is missed at most."""

    L: NDArray
    missed: float


class Budget:
    """The squared error still to be had, shared equally by the bonds still to come.

    With `carried`, what a bond leaves over goes to those after it; without, each bond has
    tau^2 ||X||^2 / (d - 1), as in algorithm 4.1 of S. De (PhD thesis, University of Michigan 2021).
    """

    def __init__(self, energy: float, bonds: int, carried: bool = True) -> None:
        self._left, self._bonds = energy, bonds
        self._most = energy if carried else energy / max(bonds, 1)

    def share(self) -> float:
        """What the next bond may lose."""
        return max(min(self._left / max(self._bonds, 1), self._most), 0.0)

    def lose(self, energy: float) -> None:
        """Take off an error that is of no bond in particular."""
        self._left -= energy

    def spend(self, energy: float) -> None:
        """Take off the error of the next bond."""
        self._left -= energy
        self._bonds -= 1


def rank_within(s: NDArray, energy: float) -> tuple[int, float]:
    """Least r >= 1 with sum_{i > r} s_i^2 <= energy, and that sum; s descending."""
    tails = np.cumsum((s * s)[::-1])[::-1]
    r = max(int(np.count_nonzero(tails > energy)), 1)
    return r, float(tails[r]) if r < len(tails) else 0.0


def svd(A: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """U, s, V' of a small matrix; by the slower of LAPACK's algorithms where the faster fails."""
    try:
        return scipy.linalg.svd(A, full_matrices=False, check_finite=False)
    except np.linalg.LinAlgError:
        return scipy.linalg.svd(A, full_matrices=False, check_finite=False, lapack_driver="gesvd")


def basis(A: NDArray, energy: float, most: int) -> tuple[NDArray | None, float]:
    """U (m, r) of A within that squared error but for the cap on r, and the squared error.

    None for the identity: where no column may go, any basis serves, and this one costs nothing.
    """
    m, n = A.shape
    square = np.linalg.qr(A.T, mode="r").T if n > m else A
    U, s, _ = svd(square)
    r, lost = rank_within(s, energy)
    if r > most:
        r, lost = most, float(np.sum(s[most:] ** 2))
    return (None, 0.0) if r == m else (U[:, :r], lost)


def split(
    L: NDArray, rank: int, modes: Sequence[int], caps: Sequence[int], budget: Budget
) -> tuple[list[NDArray], NDArray | None, float]:
    """The first cores of a tensor whose leading dimensions have the factor L.

    L (rank * prod(modes), p). These steps of TT-SVD see only M M' = L L', so that doing them on L
    gives what they would have given on M. Returns the cores, left-orthonormal, (r, n, r') each;
    their product U (m, r'), None for the identity; the squared error of this projection.
    """
    cores: list[NDArray] = []
    whole: NDArray | None = None
    remainder, r, total = L, rank, 0.0
    for n, most in zip(modes, caps, strict=True):
        A = remainder.reshape(r * n, -1)
        share = budget.share()
        U, lost = basis(A, share, most)
        budget.spend(min(lost, share))  # more is the doing of a cap
        total += lost
        core = np.eye(r * n) if U is None else U
        remainder = A if U is None else U.T @ A
        if whole is not None:
            whole = np.tensordot(whole, core.reshape(r, n, -1), axes=1).reshape(-1, core.shape[1])
        elif U is not None:
            whole = U  # all before are identities
        cores.append(core.reshape(r, n, -1))
        r = core.shape[1]
    return cores, whole, total


def qr_flops(m: int, n: int) -> float:
    """Of `qr_factor` (m <= n), or of the singular vectors of M itself, which is its own factor."""
    return 2.0 * m * m * n if m <= n else 6.0 * m * n * n + 20.0 * n**3


def gram_flops(m: int, n: int) -> float:
    """Of `gram_factor`: products of symmetric result have half the flops, eigenvectors 9 k^3."""
    shorter = min(m, n)
    return float(m) * n * shorter + 9.0 * shorter**3 + (2.0 * m * n * n if m > n else 0.0)


def qr_factor(M: Unfolding) -> Factor:
    """L of M = L Q, block by block of columns: each is appended to L and triangularised again."""
    m, n = M.rows, M.columns
    if m >= n:
        return Factor(M.read(), 0.0)
    R = np.empty((0, m))
    for _, block in M.blocks(least=4 * m):
        R = np.linalg.qr(np.concatenate([R, block.T]), mode="r")
    return Factor(R.T, 0.0)


def gram(M: Unfolding) -> NDArray:
    """M M' (m, m) summed over blocks of columns, or M'M (n, n) where M has fewer columns."""
    if M.rows > M.columns:
        turned = Unfolding(M.values, "right" if M.side == "left" else "left", M.scale)
        return gram(turned)
    G = np.zeros((M.rows, M.rows))
    for _, block in M.blocks():
        G += block @ block.T
    return G


def gram_factor(M: Unfolding) -> Factor:
    """L from the eigenvectors of the Gram matrix of the shorter side.

    It misses at most GRAM_FLOOR ||M||_F^2: what is below sqrt(GRAM_FLOOR) ~ 1e-7 of the norm cannot
    be told from nothing.
    """
    m, n = M.rows, M.columns
    G = gram(M)
    floor = GRAM_FLOOR * float(np.trace(G))
    values, V = np.linalg.eigh(G)
    values, V = np.maximum(values[::-1], 0.0), V[:, ::-1]
    if m <= n:
        return Factor(V * np.sqrt(values), floor)
    p = max(int(np.count_nonzero(np.cumsum(values[::-1])[::-1] > floor)), 1)
    return Factor(M.read() @ V[:, :p], 2.0 * floor)
