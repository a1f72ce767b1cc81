"""Compiled loops over bodies: energies, speeds, advance of positions and orientations.

Plain arrays in and out. Symbols: x position; q unit quaternion, scalar first; v, w linear and
angular velocity, world frame; h time step; d symmetry axis, the body's z axis in the world; I_t,
I_a moments of inertia across and along it. Sums run over chunks of fixed length.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange

CHUNK = 2048


@jit
def axis_of(q0, q1, q2, q3):
    """Return the z axis of a body of orientation q, in the world."""
    return (
        2.0 * (q1 * q3 + q0 * q2),
        2.0 * (q2 * q3 - q0 * q1),
        q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3,
    )


@jit_threads
def symmetry_axes(q, d):
    """Write the symmetry axis d (n, 3) of each body."""
    for i in prange(q.shape[0]):
        d[i, 0], d[i, 1], d[i, 2] = axis_of(q[i, 0], q[i, 1], q[i, 2], q[i, 3])


@jit
def kinetic_energy(mass, inertia, v, w):
    """Sum of m |v|^2 / 2 + I |w|^2 / 2 over spheres [J], chunk by chunk."""
    total = 0.0
    for start in range(0, v.shape[0], CHUNK):
        part = 0.0
        for i in range(start, min(v.shape[0], start + CHUNK)):
            vv = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]
            ww = w[i, 0] * w[i, 0] + w[i, 1] * w[i, 1] + w[i, 2] * w[i, 2]
            part += 0.5 * (mass[i] * vv + inertia[i] * ww)
        total += part
    return total


@jit
def axisymmetric_energy(mass, transverse, axial, q, v, w):
    """Sum of (m |v|^2 + I_t |w|^2 + (I_a - I_t) (w.d)^2) / 2 over bodies [J], chunk by chunk."""
    total = 0.0
    for start in range(0, v.shape[0], CHUNK):
        part = 0.0
        for i in range(start, min(v.shape[0], start + CHUNK)):
            vv = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]
            dx, dy, dz = axis_of(q[i, 0], q[i, 1], q[i, 2], q[i, 3])
            spin = w[i, 0] * dx + w[i, 1] * dy + w[i, 2] * dz
            # |w|^2 - spin^2 would lose the tumbling of a body that spins fast about its axis.
            tx = w[i, 1] * dz - w[i, 2] * dy
            ty = w[i, 2] * dx - w[i, 0] * dz
            tz = w[i, 0] * dy - w[i, 1] * dx
            tumble = tx * tx + ty * ty + tz * tz
            part += 0.5 * (mass[i] * vv + transverse[i] * tumble + axial[i] * spin * spin)
        total += part
    return total


@jit
def translational_energy(mass, v):
    """Sum of m |v|^2 / 2 over bodies [J], chunk by chunk."""
    total = 0.0
    for start in range(0, v.shape[0], CHUNK):
        part = 0.0
        for i in range(start, min(v.shape[0], start + CHUNK)):
            vv = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]
            part += 0.5 * mass[i] * vv
        total += part
    return total


@jit
def largest_speed(v):
    """Return the largest |v| [m/s]; NaN if any component is."""
    largest = 0.0
    for i in range(v.shape[0]):
        square = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]
        if not square <= largest:
            largest = square
    return np.sqrt(largest)


@jit
def first_not_finite(x, v, w):
    """Return the first row with a value that is not finite, or -1."""
    for i in range(x.shape[0]):
        for k in range(3):
            if not (np.isfinite(x[i, k]) and np.isfinite(v[i, k]) and np.isfinite(w[i, k])):
                return i
    return -1


@jit_threads
def advance(x, q, v, w, h, rotating):
    """Move spheres: x += h v and, if rotating, q <- exp(h w / 2) q, renormalised."""
    for i in prange(x.shape[0]):
        x[i, 0] += h * v[i, 0]
        x[i, 1] += h * v[i, 1]
        x[i, 2] += h * v[i, 2]
        if rotating:
            ax, ay, az = h * w[i, 0], h * w[i, 1], h * w[i, 2]
            angle = np.sqrt(ax * ax + ay * ay + az * az)
            # sin(angle/2)/angle, by its series where the quotient would lose digits.
            if angle > 1e-4:
                c, s = np.cos(0.5 * angle), np.sin(0.5 * angle) / angle
            else:
                c, s = 1.0 - angle * angle / 8.0, 0.5 - angle * angle / 48.0
            ax, ay, az = s * ax, s * ay, s * az
            q0, q1, q2, q3 = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
            p0 = c * q0 - ax * q1 - ay * q2 - az * q3
            p1 = c * q1 + ax * q0 + ay * q3 - az * q2
            p2 = c * q2 + ay * q0 + az * q1 - ax * q3
            p3 = c * q3 + az * q0 + ax * q2 - ay * q1
            norm = np.sqrt(p0 * p0 + p1 * p1 + p2 * p2 + p3 * p3)
            q[i, 0], q[i, 1], q[i, 2], q[i, 3] = p0 / norm, p1 / norm, p2 / norm, p3 / norm


@jit
def _half_turn(x, y, z):
    """Return the unit quaternion exp(u / 2) of the rotation vector u = (x, y, z)."""
    angle = np.sqrt(x * x + y * y + z * z)
    # sin(angle/2)/angle, by its series where the quotient would lose digits.
    if angle > 1e-4:
        c, s = np.cos(0.5 * angle), np.sin(0.5 * angle) / angle
    else:
        c, s = 1.0 - angle * angle / 8.0, 0.5 - angle * angle / 48.0
    return c, s * x, s * y, s * z


@jit
def _product(p, q):
    """Return the Hamilton product p q, scaled to unit length."""
    a = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    b = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    c = p[0] * q[2] + p[2] * q[0] + p[3] * q[1] - p[1] * q[3]
    d = p[0] * q[3] + p[3] * q[0] + p[1] * q[2] - p[2] * q[1]
    norm = np.sqrt(a * a + b * b + c * c + d * d)
    return a / norm, b / norm, c / norm, d / norm


@jit_threads
def advance_axisymmetric(transverse, axial, x, q, v, w, h):
    """x += h v; q and w move as those of a free body for a time h, exactly.

    L = I_t w + (I_a - I_t) (w.d) d stands in the world. The axis d precesses about it at
    L / I_t = w - (1 - k) (w.d) d, k = I_a / I_t, while the body turns about d, relative to the
    precessing frame, at the constant rate s = (1 - k) (w.d):

        q <- exp(h L / (2 I_t)) q exp(h s e_z / 2),   w <- L / I_t + s d

    No difference of moments or of angles is divided by, so spheres (s = 0) and fast spins
    need no care.
    """
    for i in prange(x.shape[0]):
        x[i, 0] += h * v[i, 0]
        x[i, 1] += h * v[i, 1]
        x[i, 2] += h * v[i, 2]
        turned = (q[i, 0], q[i, 1], q[i, 2], q[i, 3])
        dx, dy, dz = axis_of(turned[0], turned[1], turned[2], turned[3])
        spin = w[i, 0] * dx + w[i, 1] * dy + w[i, 2] * dz
        s = (transverse[i] - axial[i]) / transverse[i] * spin
        px, py, pz = w[i, 0] - s * dx, w[i, 1] - s * dy, w[i, 2] - s * dz
        if s != 0.0:  # spheres thus have the bits that `advance` gives them
            turned = _product(turned, _half_turn(0.0, 0.0, h * s))
        turned = _product(_half_turn(h * px, h * py, h * pz), turned)
        q[i, 0], q[i, 1], q[i, 2], q[i, 3] = turned
        dx, dy, dz = axis_of(turned[0], turned[1], turned[2], turned[3])
        w[i, 0], w[i, 1], w[i, 2] = px + s * dx, py + s * dy, pz + s * dz
