"""Modal Stokes kernels in decimal arithmetic of as many digits as their cancellations take.

Upward recurrences and products of trigonometric polynomials, as one writes them on paper: they
lose e^(2 n xi) and powers of the distance, which more digits make good.
"""

import math
from decimal import Decimal, getcontext, localcontext

import numpy as np

# Only a common factor of everything here, so that its digits need not follow the precision.
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899")
HALF = Decimal("0.5")


def toroidal_twin(d2, p, n_max, m_max):
    """G^m_n = int cos(nt) (d2 + 4 p sin^2(t/2))^(-m-1/2) dt as a list of lists [m][n]."""
    d2, p = Decimal(d2), Decimal(p)
    if p == 0:
        return [[2 * PI / (d2.sqrt() * d2**m)] + [Decimal(0)] * n_max for m in range(m_max + 1)]
    xi = 2 * math.asinh(math.sqrt(float(d2 / p)) / 2)
    with localcontext() as context:
        context.prec = 100 + int(2 * (n_max + 1) * xi / math.log(10))
        s2 = d2 + 4 * p
        rho = d2 + 2 * p
        K, E = _elliptic(d2 / s2)
        sequences = [[4 * K / s2.sqrt()], [4 * E / (d2 * s2.sqrt())]]
        for m in range(1, m_max):
            upper = 2 * m * rho * sequences[m][0] - (m - HALF) * sequences[m - 1][0]
            sequences.append([upper / (d2 * s2 * (m + HALF))])
        sequences[0].append((rho * sequences[0][0] - 4 * s2.sqrt() * E) / (2 * p))
        for m in range(1, len(sequences)):
            sequences[m].append((rho * sequences[m][0] - sequences[m - 1][0]) / (2 * p))
        for m, g in enumerate(sequences):
            for n in range(1, n_max):
                g.append((n * rho / p * g[n] - (n - HALF + m) * g[n - 1]) / (n + HALF - m))
        return [g[: n_max + 1] for g in sequences[: m_max + 1]]


def _elliptic(complement):
    """Complete elliptic integrals K and E, given 1 - k^2, by the arithmetic-geometric mean."""
    a, b = Decimal(1), complement.sqrt()
    power = HALF
    defect = power * (1 - complement)
    while a - b > a.scaleb(-getcontext().prec // 2 - 5):
        c = (a - b) / 2
        a, b = (a + b) / 2, (a * b).sqrt()
        power *= 2
        defect += power * c * c
    K = PI / (a + b)
    return K, K * (1 - defect)


class Laurent:
    """A polynomial sum_k c_k e^{ikt}; products and sums with numbers and its like."""

    def __init__(self, terms):
        self.terms = terms

    def __add__(self, other):
        terms = dict(self.terms)
        for k, c in _terms(other).items():
            terms[k] = terms.get(k, 0) + c
        return Laurent(terms)

    def __mul__(self, other):
        terms = {}
        for k, c in self.terms.items():
            for m, d in _terms(other).items():
                terms[k + m] = terms.get(k + m, 0) + c * d
        return Laurent(terms)

    __radd__ = __add__
    __rmul__ = __mul__


def _terms(value):
    return value.terms if isinstance(value, Laurent) else {0: Decimal(value)}


def modal_twin(kind, target, source, n_max):
    """Modes of a kernel for points (r, z, normal r, normal z): floats (n_max + 1, rows, 3).

    Azimuthal components carry the factor i of the real form from the start, so that all
    polynomials are real: i sin t stands where sin t is written elsewhere.
    """
    with localcontext() as context:
        context.prec = 100
        target, source = [[Decimal(v) for v in point] for point in (target, source)]
        rows = _kernel_polynomials(kind, target, source)
        d2 = (target[0] - source[0]) ** 2 + (target[1] - source[1]) ** 2
        g = toroidal_twin(d2, target[0] * source[0], n_max + 4, 3)
        out = np.zeros((n_max + 1, len(rows), 3))
        for n in range(n_max + 1):
            for i, row in enumerate(rows):
                for j, orders in enumerate(row):
                    out[n, i, j] = sum(
                        c * g[m][abs(n - k)]
                        for m, polynomial in orders.items()
                        for k, c in polynomial.terms.items()
                    )
        return out


def _kernel_polynomials(kind, target, source):
    """rows[i][j] = {m: what multiplies q^(-m-1/2)}."""
    r, z, nr, nz = target
    r_, z_, nr_, nz_ = source
    dz = z - z_
    cosine, isine = Laurent({1: HALF, -1: HALF}), Laurent({1: HALF, -1: -HALF})
    # x - x', and the normals, in the frames of target and source
    a = [r + -r_ * cosine, -r_ * isine, dz]
    b = [r * cosine + -r_, r * isine, dz]
    n_target = [nr, 0, nz]
    n_source = [nr * cosine, nr * isine, nz]
    m_target = [nr_ * cosine, nr_ * isine, nz_]
    m_source = [nr_, 0, nz_]
    delta = [[cosine, isine, 0], [isine, cosine, 0], [0, 0, 1]]
    L = nr * r + nz * dz + -nr * r_ * cosine
    M = nz_ * dz - nr_ * r_ + nr_ * r * cosine
    normals = nr * nr_ * cosine + nz * nz_
    per_4pi = 1 / (4 * PI)

    def matrix_entry(i, j):
        if kind == "velocity_single":
            return {0: _times(1 / (8 * PI), delta[i][j]), 1: _times(1 / (8 * PI), a[i], b[j])}
        if kind == "traction_single":
            return {2: _times(-3 * per_4pi, a[i], b[j], L)}
        if kind == "velocity_double":
            return {2: _times(3 * per_4pi, a[i], b[j], M)}
        return {
            1: _times(2 * per_4pi, n_target[i], m_source[j]),
            2: _times(3 * per_4pi, m_target[i], b[j], L)
            + _times(3 * per_4pi, delta[i][j], L, M)
            + _times(3 * per_4pi, a[i], b[j], normals)
            + _times(3 * per_4pi, a[i], n_source[j], M),
            3: _times(-30 * per_4pi, a[i], b[j], L, M),
        }

    def stress_entry(i, k, j):
        sign = -1 if i == k == 1 else 1  # written without its factor i^2
        if kind == "stress_single":
            return {2: _times(-3 * sign * per_4pi, a[i], a[k], b[j])}
        isotropic = 2 if i == k else 0  # i^2 and the sign cancel
        return {
            1: _times(isotropic * per_4pi, m_source[j]),
            2: _times(3 * sign * per_4pi, m_target[i], b[j], a[k])
            + _times(3 * sign * per_4pi, m_target[k], b[j], a[i])
            + _times(3 * sign * per_4pi, delta[i][j], a[k], M)
            + _times(3 * sign * per_4pi, delta[k][j], a[i], M),
            3: _times(-30 * sign * per_4pi, a[i], a[k], b[j], M),
        }

    if kind == "pressure_single":
        return [[{1: _times(per_4pi, b[j])} for j in range(3)]]
    if kind == "pressure_double":
        return [
            [
                {1: _times(-2 * per_4pi, m_source[j]), 2: _times(6 * per_4pi, b[j], M)}
                for j in range(3)
            ]
        ]
    if kind.startswith("stress"):
        pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        return [[stress_entry(i, k, j) for j in range(3)] for i, k in pairs]
    return [[matrix_entry(i, j) for j in range(3)] for i in range(3)]


def _times(*factors):
    product = Laurent({0: Decimal(1)})
    for factor in factors:
        product = product * factor
    return product
