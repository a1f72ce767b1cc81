"""Compiled loops over bodies: energies, speeds, advance of positions and orientations.

Plain arrays in and out. Symbols: x position; q unit quaternion, scalar first; v, w linear and
angular velocity, world frame; h time step. Sums run over chunks of fixed length.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange

CHUNK = 2048


@jit
def kinetic_energy(mass, inertia, v, w):
    """Sum of m |v|^2 / 2 + I |w|^2 / 2 over bodies [J], chunk by chunk."""
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
    """x += h v and, if rotating, q <- exp(h w / 2) q, renormalised."""
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
