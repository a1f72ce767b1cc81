"""Fourier modes of inverse odd powers of the distance between two circles about one axis.

    G^m_n = int_{-pi}^{pi} cos(n t) q(t)^{-m-1/2} dt,   q = d2 + 4 p sin^2(t/2),

d2 the squared distance of the two points in the meridian plane, p the product of their radii.
They are toroidal (Legendre) functions Q^m_{n-1/2} of chi = 1 + d2/(2p). Everything is computed
from d2 and p, never from chi: near the diagonal (chi -> 1) all digits are in d2, on the axis
(p = 0) chi is infinite. All G^m_n are positive.
"""

from __future__ import annotations

import math

import numpy as np

from dem_mpi._jit import jit

HIGHEST_ORDER = 3

# The downward recurrence starts from this value and grows by e^(n xi). Neither may that overflow
# nor the ratio of G^m_0 to it, which goes like d^(-2m-1) for lengths d that may be tiny.
_SMALLEST = 1e-200
_LARGEST_GROWTH = 600.0
# An error in the ratio assumed at the start decays by e^(-2 xi) a step: e^-40 is left of it.
_DECAY = 20.0


@jit
def _mean_and_defect(b, c2):
    """(agm(1, b), 1 - E/K) of the modulus k, where b = sqrt(1 - k^2) and c2 = k^2."""
    a = 1.0
    power = 0.5
    defect = power * c2
    while a - b > 1e-9 * a:  # converges quadratically: the last step leaves no error
        c = 0.5 * (a - b)
        a, b = 0.5 * (a + b), math.sqrt(a * b)
        power *= 2.0
        defect += power * c * c
    return 0.5 * (a + b), defect


@jit
def _elliptic(d2, p):
    """Complete elliptic integrals (K, E) of k^2 = 4 p / (d2 + 4 p), to rounding for any d2 > 0."""
    s2 = d2 + 4.0 * p
    k2 = 4.0 * p / s2
    complement2 = d2 / s2
    mean, defect = _mean_and_defect(math.sqrt(complement2), k2)
    K = 0.5 * math.pi / mean
    if complement2 > 0.25:
        return K, K * (1.0 - defect)
    # 1 - defect would cancel; Legendre's relation is a sum of positive terms
    mean, defect = _mean_and_defect(math.sqrt(k2), complement2)
    return K, mean + K * defect


@jit
def _upward(d2, p, K, E, n_max, m_max, first, out):
    """Recurrences upward in n, in differences; sound while n_max xi < 1. `out[m, 0]` is known."""
    delta = d2 / p
    rho = d2 + 2.0 * p
    value = out[0, first]
    step = 0.5 * delta * value - 2.0 * math.sqrt(d2 + 4.0 * p) / p * E
    for n in range(n_max):
        if n > 0:
            step = ((n - 0.5) * step + n * delta * value) / (n + 0.5)
        value += step
        out[0, first + n + 1] = value
    for m in range(1, m_max + 1):
        if n_max > 0:
            out[m, first + 1] = (rho * out[m, first] - out[m - 1, first]) / (2.0 * p)
        factor = 1.0 / ((m - 0.5) * p)
        for n in range(1, n_max):
            out[m, first + n + 1] = out[m, first + n - 1] - n * factor * out[m - 1, first + n]


@jit
def _downward(d2, p, xi, n_max, m_max, first, out):
    """Miller's recurrence downward in n from an arbitrary small start, scaled to `out[m, 0]`.

    It runs in the differences e_n = G_{n-1} - G_n, which are sums of positive terms for
    n > m - 1/2. All orders go in lockstep: their chains of dependent operations overlap.
    """
    # also right where xi is infinite (p = 0)
    start = int(min(n_max + 6 + _DECAY / xi, _LARGEST_GROWTH / xi))
    for m in range(m_max + 1):
        for n in range(start + 1, n_max + 1):
            out[m, first + n] = 0.0
    if start == 0:
        return
    delta = d2 / p
    g0 = g1 = g2 = g3 = _SMALLEST
    e0 = e1 = e2 = e3 = -math.expm1(-xi) * _SMALLEST
    i1, i2, i3 = 1.0 / (start + 0.5), 1.0 / (start + 1.5), 1.0 / (start + 2.5)
    if start <= n_max:
        for m in range(m_max + 1):
            out[m, first + start] = _SMALLEST
    for n in range(start, 0, -1):
        c = n * delta
        i0 = 1.0 / (n - 0.5)
        e0 = (c * i0) * g0 + ((n + 0.5) * i0) * e0
        e1 = (c * i1) * g1 + ((n - 0.5) * i1) * e1
        e2 = (c * i2) * g2 + ((n - 1.5) * i2) * e2
        e3 = (c * i3) * g3 + ((n - 2.5) * i3) * e3
        g0 += e0
        g1 += e1
        g2 += e2
        g3 += e3
        i1, i2, i3 = i0, i1, i2
        if 1 < n <= n_max + 1:
            out[0, first + n - 1] = g0
            if m_max > 0:
                out[1, first + n - 1] = g1
            if m_max > 1:
                out[2, first + n - 1] = g2
            if m_max > 2:
                out[3, first + n - 1] = g3
    for m in range(m_max + 1):
        at_zero = g0
        if m == 1:
            at_zero = g1
        elif m == 2:
            at_zero = g2
        elif m == 3:
            at_zero = g3
        scale = out[m, first] / at_zero
        for n in range(1, min(start, n_max) + 1):
            out[m, first + n] *= scale


@jit
def fill_toroidal(d2, p, n_max, m_max, first, out):
    """Write G^m_n to out[m, first + n] for m = 0..m_max (at most 3) and n = 0..n_max."""
    s2 = d2 + 4.0 * p
    K, E = _elliptic(d2, p)
    out[0, first] = 4.0 * K / math.sqrt(s2)
    if m_max > 0:
        out[1, first] = 4.0 * E / (d2 * math.sqrt(s2))
    for m in range(1, m_max):
        out[m + 1, first] = (
            2.0 * m * (d2 + 2.0 * p) * out[m, first] - (m - 0.5) * out[m - 1, first]
        ) / (d2 * s2 * (m + 0.5))
    if n_max == 0:
        return
    xi = 2.0 * math.asinh(0.5 * math.sqrt(d2 / p))
    if n_max * xi < 1.0:
        _upward(d2, p, K, E, n_max, m_max, first, out)
    else:
        _downward(d2, p, xi, n_max, m_max, first, out)


@jit
def toroidal(d2, p, n_max, m_max, out):
    """Write G^m_n to out[m, n] for m = 0..m_max (at most 3) and n = 0..n_max.

    `d2` > 0 is the squared distance in the meridian plane, `p` >= 0 the product of the radii.
    Relative errors stay at rounding; what is below e^-600 of G^m_0 may be flushed to zero.
    """
    fill_toroidal(d2, p, n_max, m_max, 0, out)


@jit
def _toroidal_table(d2, p, out):
    for i in range(d2.shape[0]):
        fill_toroidal(d2[i], p[i], out.shape[2] - 1, out.shape[1] - 1, 0, out[i])


def toroidal_table(d2: np.ndarray, p: np.ndarray, n_max: int, m_max: int) -> np.ndarray:
    """Return G^m_n, shape (len(d2), m_max + 1, n_max + 1), for pairs of circles.

    `d2` > 0, `p` >= 0: shape (k,), any unit of length. Raises ValueError beyond these bounds, or
    for orders above 3.
    """
    d2 = np.atleast_1d(np.asarray(d2, float))
    p = np.atleast_1d(np.asarray(p, float))
    if d2.ndim != 1 or d2.shape != p.shape:
        raise ValueError(f"d2 and p must be vectors of one length, not {d2.shape} and {p.shape}")
    if not 0 <= m_max <= HIGHEST_ORDER or n_max < 0:
        raise ValueError(f"order {m_max} is not in 0..{HIGHEST_ORDER}, or degree {n_max} < 0")
    if not (np.all(d2 > 0.0) and np.all(p >= 0.0)):
        raise ValueError("distances must be positive and products of radii not negative")
    out = np.empty((d2.size, m_max + 1, n_max + 1))
    _toroidal_table(d2, p, out)
    return out
