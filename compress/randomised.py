"""The range of a large matrix from products with random ones, to a fixed accuracy.

P. Blanchard, PhD thesis, Université de Bordeaux 2017, algorithm 6; N. Halko, P. G. Martinsson,
J. A. Tropp, SIAM Review 53, 2011. The error is that of the matrix, measured, not an expectation:
a random matrix that serves badly costs columns, never accuracy.

Symbols: M (m, n); Omega (n, b) Gaussian; Q (m, l) orthonormal columns; B = Q'M.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from compress.factors import EPS, GRAM_FLOOR, Factor, gram_factor, qr_factor
from compress.unfolding import Unfolding

FIRST = 32  # columns of the first sample
OVERSAMPLING = 10  # columns above the largest rank that is wanted (s in B's algorithm 6)
DRAWING = 300.0  # flops that take as long as to draw a normal number
GIVE_UP = 0.5  # part of the shorter side above which the range is not worth finding


def randomised_flops(m: int, n: int, size: int, coarse: bool = True) -> float:
    """Of a basis of `size` columns: the sample, its projection, where not coarse the residual.

    A normal number costs as much as DRAWING flops.
    """
    return (4.0 if coarse else 6.0) * m * n * size + DRAWING * n * size


def randomised_factor(
    M: Unfolding, allowed: float, energy: float, most: int, seed: int = 0
) -> Factor | None:
    """L = Q L_B of M ~ Q B, where ||M - Q B||_F^2 <= allowed.

    Columns are added to Q, as many as there are already, until that holds (fixed accuracy), or
    until it has more than `most`, a cap on the rank (then with one power iteration: fixed rank).
    energy is ||M||_F^2. None if the range takes up more than GIVE_UP of the shorter side: not a
    low rank.
    """
    shorter = min(M.rows, M.columns)
    generator = np.random.default_rng(seed)
    Q, size = np.empty((M.rows, 0)), FIRST
    coarse = allowed > 4.0 * GRAM_FLOOR * energy
    while True:
        size = min(size, most + OVERSAMPLING)
        if Q.shape[1] + size > GIVE_UP * shorter:
            return None
        Q = np.concatenate([Q, _range(M, Q, size, generator)], axis=1)
        capped = Q.shape[1] >= most + OVERSAMPLING
        if capped:
            Q = _orthonormal(_apply(M, Q))
        B = Unfolding(M.project(Q), M.side)
        if coarse:
            missed = energy - float(np.vdot(B.values, B.values)) + GRAM_FLOOR * energy
        else:
            missed = _residual(M, Q, B)
        if missed <= allowed or capped:
            # Of B, with few rows, a factor without what a Gram matrix would miss.
            small = gram_factor(B) if coarse and B.columns > B.rows else qr_factor(B)
            L_B = small.L
            return Factor(Q @ L_B, max(missed, 0.0) + small.missed)
        size = Q.shape[1]


def _range(M: Unfolding, Q: NDArray, size: int, generator: np.random.Generator) -> NDArray:
    """An orthonormal basis (m, size) of M Omega without the part that Q has."""
    Y = np.zeros((M.rows, size))
    for _, block in M.blocks():
        Y += block @ generator.standard_normal((block.shape[1], size))
    for _ in range(2):  # twice is enough for orthogonality to rounding
        Y -= Q @ (Q.T @ Y)
        Y = _orthonormal(Y)
    return Y


def _orthonormal(Y: NDArray) -> NDArray:
    return np.linalg.qr(Y)[0]


def _apply(M: Unfolding, Q: NDArray) -> NDArray:
    """M M' Q: a power iteration."""
    Y = np.zeros_like(Q)
    for _, block in M.blocks():
        Y += block @ (block.T @ Q)
    return Y


def _residual(M: Unfolding, Q: NDArray, B: Unfolding) -> float:
    """||M - Q B||_F^2, summed over blocks: no cancellation, as there is in ||M||^2 - ||B||^2."""
    total = 0.0
    for columns, block in M.blocks():
        difference = block - Q @ B.matrix[:, columns]
        total += float(np.vdot(difference, difference))
    return total * (1.0 + math.sqrt(M.columns) * EPS)
