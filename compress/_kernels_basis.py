"""Compiled discrete orthogonal polynomials: smooth functions of time have few coefficients there.

Plain loops of IEEE additions, products, quotients and square roots: the same bits everywhere.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit


@jit
def polynomials(count):
    """Orthonormal polynomials on `count` equidistant points: (degree, point), square.

    Each is the one before times the abscissa, made orthogonal to all before, twice over.
    """
    p = np.zeros((count, count))
    for i in range(count):
        p[0, i] = 1.0
    for degree in range(count):
        row = p[degree]
        if degree > 0:
            for i in range(count):
                row[i] = (2.0 * i - (count - 1.0)) / count * p[degree - 1, i]
        for _ in range(2):
            for lower in range(degree):
                overlap = 0.0
                for i in range(count):
                    overlap += row[i] * p[lower, i]
                for i in range(count):
                    row[i] -= overlap * p[lower, i]
        square = 0.0
        for i in range(count):
            square += row[i] * row[i]
        length = np.sqrt(square)
        for i in range(count):
            row[i] /= length
    return p


@jit
def normalise_rows(q):
    """The rows of q (r, c) int64 divided by their lengths (zero rows stay): (r, c) float64."""
    rows = np.zeros(q.shape)
    for k in range(q.shape[0]):
        square = 0.0
        for j in range(q.shape[1]):
            square += float(q[k, j]) * float(q[k, j])
        if square > 0.0:
            length = np.sqrt(square)
            for j in range(q.shape[1]):
                rows[k, j] = float(q[k, j]) / length
    return rows


@jit
def apply_polynomials(coefficients, p, width):
    """Sums over degrees d of coefficients[:, d * width + c] p[d, t], at [:, t * width + c]."""
    rows, columns = coefficients.shape
    values = np.zeros((rows, columns))
    for k in range(rows):
        for d in range(p.shape[0]):
            for c in range(width):
                x = coefficients[k, d * width + c]
                if x != 0.0:
                    for t in range(p.shape[1]):
                        values[k, t * width + c] += x * p[d, t]
    return values
