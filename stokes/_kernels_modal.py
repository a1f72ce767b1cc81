"""Azimuthal Fourier modes of axisymmetric Stokes kernels, for one pair of points of the meridian.

Rotated into the frames of target and source (radial, azimuthal, axial), every kernel is a sum of
    (polynomial of degree <= 4 in v, times sin t where the entry is odd) * q^{-m-1/2},
t the angle between the two, and its mode n = int K(t) e^{-int} dt a sum of products of
coefficients, which do not depend on n, and moments, which do not depend on the kernel:
    even[k, m, n] = int v^k cos(nt) q^{-m-1/2} dt,
    odd[k, m, n]  = int v^k sin t sin(nt) q^{-m-1/2} dt.

Two bases serve. Away from the diagonal and up to the axis, v = cos t. Near it (chi < 3), v =
1 - cos t with coefficients made of the differences dr, dz and of the offsets nu.(x - x'): there
each power of v takes off two powers of the distance, as 2 p v = q - d2, and no digits cancel.

Real form: K = C R C^-1, C = diag(1, i, 1); R is real and is what is written. Rows of stresses are
(rr, r theta, rz, theta theta, theta z, zz), with C = i for the two that hold one theta.
"""

from __future__ import annotations

import math

import numpy as np

from dem_mpi._jit import jit
from stokes._toroidal import HIGHEST_ORDER, fill_toroidal

VELOCITY_SINGLE = 0
PRESSURE_SINGLE = 1
TRACTION_SINGLE = 2
VELOCITY_DOUBLE = 3
PRESSURE_DOUBLE = 4
TRACTION_DOUBLE = 5
STRESS_SINGLE = 6
STRESS_DOUBLE = 7

ROWS = np.array([3, 1, 3, 3, 1, 3, 6, 6])
# Degree of the polynomial that multiplies q^{-m-1/2}, m = 0..3; -1: there is none.
_DEGREE = np.array(
    [
        [1, 2, -1, -1],
        [-1, 1, -1, -1],
        [-1, -1, 3, -1],
        [-1, -1, 3, -1],
        [-1, 0, 2, -1],
        [-1, 0, 3, 4],
        [-1, 1, 3, -1],
        [-1, 0, 3, 4],
    ]
)
_HIGHEST_ORDER_OF = np.array([1, 1, 2, 2, 2, 3, 2, 3])
_MAX_DEGREE = 4
_MAX_ENTRIES = 21
_PAD = _MAX_DEGREE  # modes -4 .. n_max + 4 are kept

_PER_8_PI = 1.0 / (8.0 * math.pi)


@jit
def new_workspace(n_max):
    """Arrays one thread needs for `modal_modes` up to this mode; any kernel, any pair."""
    width = n_max + 1 + 2 * _PAD
    return (
        np.zeros((_MAX_DEGREE + 1, HIGHEST_ORDER + 1, width)),
        np.zeros((_MAX_DEGREE, HIGHEST_ORDER + 1, width)),
        np.zeros((HIGHEST_ORDER + 1, _MAX_ENTRIES, _MAX_DEGREE + 1)),
        np.zeros((_MAX_ENTRIES, n_max + 1)),
    )


@jit
def _moments_near(d2, p, m_max, excess, n_max, even, odd):
    """Moments in v = 1 - cos t, of degree up to m + excess in even[:, m], one less in odd[:, m].

    From even[0, m], the toroidal sequences up to n_max + 1.
    """
    half = 0.5 / p
    for k in range(1, m_max + excess + 1):
        for m in range(max(0, k - excess), m_max + 1):
            row = even[k, m]
            same = even[k - 1, m]
            if m == 0:  # only k = 1
                same[_PAD - 1] = same[_PAD + 1]
                for n in range(_PAD, _PAD + n_max + 1):
                    row[n] = same[n] - 0.5 * (same[n + 1] + same[n - 1])
            else:
                lower = even[k - 1, m - 1]
                for n in range(_PAD, _PAD + n_max + 1):
                    row[n] = (lower[n] - d2 * same[n]) * half
    for m in range(1 - excess, m_max + 1):
        row = odd[0, m]
        if m == 0:
            same = even[0, 0]
            for n in range(_PAD, _PAD + n_max + 1):
                row[n] = 0.5 * (same[n - 1] - same[n + 1])
        else:  # by parts
            lower = even[0, m - 1]
            factor = 1.0 / ((2 * m - 1) * p)
            for n in range(_PAD, _PAD + n_max + 1):
                row[n] = (n - _PAD) * factor * lower[n]
    for k in range(1, m_max + excess):
        for m in range(max(1, k + 1 - excess), m_max + 1):
            row = odd[k, m]
            same = odd[k - 1, m]
            lower = odd[k - 1, m - 1]
            for n in range(_PAD, _PAD + n_max + 1):
                row[n] = (lower[n] - d2 * same[n]) * half


@jit
def _moments_far(m_max, degrees, n_max, even, odd):
    """Moments in v = cos t, of degree up to degrees[m]: means over neighbouring modes.

    From even[0, m], the toroidal sequences up to n_max + 4.
    """
    for m in range(m_max + 1):
        degree = degrees[m]
        if degree < 1:
            continue
        values = even[0, m]
        for n in range(1, degree + 1):
            values[_PAD - n] = values[_PAD + n]
        for k in range(1, degree + 1):
            row = even[k, m]
            lower = even[k - 1, m]
            for n in range(_PAD - degree + k, _PAD + n_max + 1 + degree - k):
                row[n] = 0.5 * (lower[n - 1] + lower[n + 1])
        row = odd[0, m]
        for n in range(_PAD - degree + 1, _PAD + n_max + degree):
            row[n] = 0.5 * (values[n - 1] - values[n + 1])
        for k in range(1, degree):
            row = odd[k, m]
            lower = odd[k - 1, m]
            for n in range(_PAD - degree + 1 + k, _PAD + n_max + degree - k):
                row[n] = 0.5 * (lower[n - 1] + lower[n + 1])


@jit
def _product(x, y):
    """Product of two linear polynomials, as the three coefficients of a quadratic."""
    return (x[0] * y[0], x[0] * y[1] + x[1] * y[0], x[1] * y[1])


@jit
def _scaled(factor, x):
    return (factor * x[0], factor * x[1], factor * x[2])


@jit
def _constant(value):
    return (value, 0.0, 0.0)


@jit
def _add(coefficients, m, entry, factor, x, y):
    """Add factor * x * y, two quadratics, to the polynomial of this entry and order."""
    row = coefficients[m, entry]
    row[0] += factor * (x[0] * y[0])
    row[1] += factor * (x[0] * y[1] + x[1] * y[0])
    row[2] += factor * (x[0] * y[2] + x[1] * y[1] + x[2] * y[0])
    row[3] += factor * (x[1] * y[2] + x[2] * y[1])
    row[4] += factor * (x[2] * y[2])


@jit
def _basis(near, target, source, dr, dz, offset, offset_source):
    """Polynomials in v: components of x - x' in both frames, cos t, sin^2 t, and nu.(x - x').

    Radial components: r - r' cos t in the target's frame, r cos t - r' in the source's.
    """
    r, nr, nz = target
    r_source, nr_source, nz_source = source
    if near:
        return (
            (dr, r_source, 0.0),
            (dr, -r, 0.0),
            (1.0, -1.0, 0.0),
            (0.0, 2.0, -1.0),
            (offset, nr * r_source, 0.0),
            (offset_source, -nr_source * r, 0.0),
        )
    return (
        (r, -r_source, 0.0),
        (-r_source, r, 0.0),
        (0.0, 1.0, 0.0),
        (1.0, 0.0, -1.0),
        (nr * r + nz * dz, -nr * r_source, 0.0),
        (nz_source * dz - nr_source * r_source, nr_source * r, 0.0),
    )


@jit
def _dyad(a, b, sine2, r, r_source, dz):
    """x x of the target's and the source's frame, row by row; odd entries without their sin t."""
    return (
        _product(a, b),
        _scaled(r, a),
        _scaled(dz, a),
        _scaled(r_source, b),
        _scaled(r * r_source, sine2),
        _constant(r_source * dz),
        _scaled(dz, b),
        _constant(r * dz),
        _constant(dz * dz),
    )


@jit
def _add_pressure_single(coefficients, first, r, dz, b):
    """x_j / R^3 / (4 pi)."""
    one = _constant(1.0)
    _add(coefficients, 1, first, 2.0 * _PER_8_PI, b, one)
    _add(coefficients, 1, first + 1, 2.0 * _PER_8_PI * r, one, one)
    _add(coefficients, 1, first + 2, 2.0 * _PER_8_PI * dz, one, one)


@jit
def _add_pressure_double(coefficients, first, r, dz, b, source, projection_source):
    """(-nu'_j / R^3 + 3 x_j (x.nu') / R^5) / (2 pi)."""
    one = _constant(1.0)
    factor = 4.0 * _PER_8_PI
    _add(coefficients, 1, first, -factor * source[1], one, one)
    _add(coefficients, 1, first + 2, -factor * source[2], one, one)
    _add(coefficients, 2, first, 3.0 * factor, b, projection_source)
    _add(coefficients, 2, first + 1, 3.0 * factor * r, one, projection_source)
    _add(coefficients, 2, first + 2, 3.0 * factor * dz, one, projection_source)


@jit
def _add_stresslet(coefficients, first, factor, dyad, projection):
    """x x (x.nu) / R^5."""
    for entry in range(9):
        _add(coefficients, 2, first + entry, factor, dyad[entry], projection)


@jit
def _add_velocity_single(coefficients, dyad, cosine):
    """(delta / R + x x / R^3) / (8 pi)."""
    one = _constant(1.0)
    _add(coefficients, 0, 0, _PER_8_PI, cosine, one)
    _add(coefficients, 0, 1, _PER_8_PI, one, one)
    _add(coefficients, 0, 3, -_PER_8_PI, one, one)
    _add(coefficients, 0, 4, _PER_8_PI, cosine, one)
    _add(coefficients, 0, 8, _PER_8_PI, one, one)
    for entry in range(9):
        _add(coefficients, 1, entry, _PER_8_PI, dyad[entry], one)


@jit
def _add_traction_double(coefficients, first, target, source, dz, basis, dyad):
    """2 nu nu'/R^3 + 3 [nu'_i x_j L + delta L L' + x x nu.nu' + x_i nu_j L']/R^5 - 30 x x L L'/R^7.

    Over 4 pi, with L = x.nu and L' = x.nu'.
    """
    r, nr, nz = target
    r_source, nr_source, nz_source = source
    a, b, cosine, sine2, projection, projection_source = basis
    one = _constant(1.0)
    factor = 2.0 * _PER_8_PI
    _add(coefficients, 1, first, 2.0 * factor * nr * nr_source, one, one)
    _add(coefficients, 1, first + 2, 2.0 * factor * nr * nz_source, one, one)
    _add(coefficients, 1, first + 6, 2.0 * factor * nz * nr_source, one, one)
    _add(coefficients, 1, first + 8, 2.0 * factor * nz * nz_source, one, one)

    both = _product(projection, projection_source)
    rotation = (
        cosine,
        one,
        _constant(0.0),
        _constant(-1.0),
        cosine,
        _constant(0.0),
        _constant(0.0),
        _constant(0.0),
        one,
    )
    # nu' in the target's frame is (nr' cos t, -nr' sin t, nz'), times x in the source's
    source_normal_x = (
        _scaled(nr_source, _product(cosine, b)),
        _scaled(nr_source * r, cosine),
        _scaled(nr_source * dz, cosine),
        _scaled(-nr_source, b),
        _scaled(-nr_source * r, sine2),
        _constant(-nr_source * dz),
        _scaled(nz_source, b),
        _constant(nz_source * r),
        _constant(nz_source * dz),
    )
    # x in the target's frame, times nu in the source's, (nr cos t, nr sin t, nz)
    x_normal = (
        _scaled(nr, _product(a, cosine)),
        _scaled(nr, a),
        _scaled(nz, a),
        _scaled(r_source * nr, cosine),
        _scaled(r_source * nr, sine2),
        _constant(r_source * nz),
        _scaled(dz * nr, cosine),
        _constant(dz * nr),
        _constant(dz * nz),
    )
    normals = (nr * nr_source * cosine[0] + nz * nz_source, nr * nr_source * cosine[1], 0.0)
    for entry in range(9):
        _add(coefficients, 2, first + entry, 3.0 * factor, source_normal_x[entry], projection)
        _add(coefficients, 2, first + entry, 3.0 * factor, rotation[entry], both)
        _add(coefficients, 2, first + entry, 3.0 * factor, dyad[entry], normals)
        _add(coefficients, 2, first + entry, 3.0 * factor, x_normal[entry], projection_source)
        _add(coefficients, 3, first + entry, -30.0 * factor, dyad[entry], both)


@jit
def _fill_coefficients(kind, near, target, source, dr, dz, offsets, coefficients):
    """Write the polynomials of this kernel; of stresses, both tractions and then the pressure."""
    r, r_source = target[0], source[0]
    stress = kind in (STRESS_SINGLE, STRESS_DOUBLE)
    first_of_pressure = 18 if stress else 0
    for plane in range(2 if stress else 1):
        normal, offset = target, offsets[0]
        if stress:  # planes across r, then across z
            normal = (r, 1.0 - plane, 1.0 * plane)
            offset = dr if plane == 0 else dz
        basis = _basis(near, normal, source, dr, dz, offset, offsets[1])
        a, b, cosine, sine2, projection, projection_source = basis
        first = 9 * plane
        if kind not in (PRESSURE_SINGLE, PRESSURE_DOUBLE):
            dyad = _dyad(a, b, sine2, r, r_source, dz)
            if kind == VELOCITY_SINGLE:
                _add_velocity_single(coefficients, dyad, cosine)
            elif kind == VELOCITY_DOUBLE:
                _add_stresslet(coefficients, first, 6.0 * _PER_8_PI, dyad, projection_source)
            elif kind in (TRACTION_SINGLE, STRESS_SINGLE):
                _add_stresslet(coefficients, first, -6.0 * _PER_8_PI, dyad, projection)
            else:
                _add_traction_double(coefficients, first, normal, source, dz, basis, dyad)
        if plane > 0:
            continue
        if kind in (PRESSURE_SINGLE, STRESS_SINGLE):
            _add_pressure_single(coefficients, first_of_pressure, r, dz, b)
        elif kind in (PRESSURE_DOUBLE, STRESS_DOUBLE):
            _add_pressure_double(
                coefficients, first_of_pressure, r, dz, b, source, projection_source
            )


@jit
def _parity(entry, first_of_pressure):
    """Whether the entry holds a factor sin t, and the sign it takes in the real form."""
    column = entry % 3
    row = 0 if entry >= first_of_pressure else (entry // 3) % 3
    odd = (row == 1) != (column == 1)
    return odd, (-1.0 if odd and row == 1 else 1.0)


@jit
def _combine(count, first_of_pressure, m_max, n_max, even, odd, coefficients, modes):
    """Write to `modes[entry, n]` the sums of coefficients times moments."""
    for entry in range(count):
        is_odd, sign = _parity(entry, first_of_pressure)
        row = modes[entry]
        row[:] = 0.0
        for m in range(m_max + 1):
            polynomial = coefficients[m, entry]
            for k in range(_MAX_DEGREE + 1 - is_odd):
                c = sign * polynomial[k]
                if c == 0.0:
                    continue
                moments = odd[k, m] if is_odd else even[k, m]
                for n in range(n_max + 1):
                    row[n] += c * moments[_PAD + n]


@jit
def _collect_stress(n_max, modes, out):
    """Stresses from the tractions on planes across r and across z; -3 p is the trace."""
    for n in range(n_max + 1):
        for j in range(3):
            rr, zz = modes[j, n], modes[15 + j, n]
            out[n, 0, j] = rr
            out[n, 1, j] = modes[3 + j, n]
            out[n, 2, j] = modes[6 + j, n]
            out[n, 3, j] = -3.0 * modes[18 + j, n] - rr - zz
            out[n, 4, j] = modes[12 + j, n]
            out[n, 5, j] = zz


@jit
def modal_modes(kind, target, source, dr, dz, offsets, n_max, workspace, out):
    """Write modes 0..n_max of one kernel for one pair, real form, to `out` (n_max+1, rows, 3).

    `target` and `source` are tuples (r, normal r, normal z), `dr` and `dz` target minus source to
    full relative precision, `offsets` = (nu.(x - x'), nu'.(x - x')) in the meridian plane,
    `workspace` from `new_workspace` of the same n_max.
    """
    even, odd, coefficients, modes = workspace
    d2 = dr * dr + dz * dz
    p = target[0] * source[0]
    near = d2 < 4.0 * p
    m_max = _HIGHEST_ORDER_OF[kind]
    fill_toroidal(d2, p, n_max + (1 if near else _PAD), m_max, _PAD, even[0])
    if near:
        _moments_near(d2, p, m_max, _DEGREE[kind, m_max] - m_max, n_max, even, odd)
    else:
        _moments_far(m_max, _DEGREE[kind], n_max, even, odd)
    rows = ROWS[kind]
    # stresses: the tractions on two planes, then the pressure
    count = 21 if rows == 6 else 3 * rows
    first_of_pressure = 0 if rows == 1 else 3 * rows
    coefficients[: m_max + 1, :count] = 0.0
    _fill_coefficients(kind, near, target, source, dr, dz, offsets, coefficients)
    _combine(count, first_of_pressure, m_max, n_max, even, odd, coefficients, modes)
    if rows == 6:
        _collect_stress(n_max, modes, out)
        return
    for n in range(n_max + 1):
        for i in range(rows):
            for j in range(3):
                out[n, i, j] = modes[3 * i + j, n]


@jit
def plane_offsets(target, source, dr, dz):
    """nu.(x - x') and nu'.(x - x') from the differences alone, of points off a common surface."""
    return (target[1] * dr + target[2] * dz, source[1] * dr + source[2] * dz)


@jit
def target_modes(kind, target, sources, n_max, workspace, out):
    """Modes of one kernel from many sources at one target: `out` (sources, n_max+1, rows, 3).

    `target` is (r, z, normal r, normal z), `sources` (n, 4) alike. Differences are taken from
    the coordinates: for targets off the surface.
    """
    here = (target[0], target[2], target[3])
    for k in range(sources.shape[0]):
        there = (sources[k, 0], sources[k, 2], sources[k, 3])
        dr = target[0] - sources[k, 0]
        dz = target[1] - sources[k, 1]
        offsets = plane_offsets(here, there, dr, dz)
        modal_modes(kind, here, there, dr, dz, offsets, n_max, workspace, out[k])
