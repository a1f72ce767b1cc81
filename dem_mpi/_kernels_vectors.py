"""Triples of floats as vectors, and rows of contacts, for compiled loops that must not allocate.

A vector is a tuple (x, y, z); `vec` makes one from a row of an array.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

EPS = 2.220446049250313e-16
MERGE = 0.1  # contacts closer together than this part of the smallest size are one
TIE = 1e-12  # relative to size: two candidates this close are equally good


@jit
def vec(x):
    return (x[0], x[1], x[2])


@jit
def neg(u):
    return (-u[0], -u[1], -u[2])


@jit
def sub(u, v):
    return (u[0] - v[0], u[1] - v[1], u[2] - v[2])


@jit
def scaled(t, u):
    return (t * u[0], t * u[1], t * u[2])


@jit
def along(u, t, v):
    """Return u + t v."""
    return (u[0] + t * v[0], u[1] + t * v[1], u[2] + t * v[2])


@jit
def dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@jit
def cross(u, v):
    return (
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    )


@jit
def norm(u):
    return np.sqrt(dot(u, u))


@jit
def unit(u):
    """Return u / |u|, or e_z for a zero u."""
    length = norm(u)
    if length > 0.0:
        return (u[0] / length, u[1] / length, u[2] / length)
    return (0.0, 0.0, 1.0)


@jit
def clamp(t, low, high):
    return min(max(t, low), high)


@jit
def across(d):
    """Return a unit vector perpendicular to the unit vector d."""
    if abs(d[0]) < 0.6:
        return unit(cross(d, (1.0, 0.0, 0.0)))
    return unit(cross(d, (0.0, 1.0, 0.0)))


@jit
def meridian(X, k):
    """Return (s, rho, radial) of X about the unit axis k through 0.

    Near the axis the part of X across it is round-off that may point anywhere: it is made
    perpendicular once more.
    """
    s = dot(X, k)
    e = along(X, -s, k)
    rho = norm(e)
    if not rho > 1e-8 * abs(s):
        e = unit(e)
        e = along(e, -dot(e, k), k)
        if not norm(e) > 0.5:
            e = across(k)
        return s, rho, unit(e)
    return s, rho, scaled(1.0 / rho, e)


@jit
def put(out, row, n, gap, point):
    out[row, 0], out[row, 1], out[row, 2] = n
    out[row, 3] = gap
    out[row, 4], out[row, 5], out[row, 6] = point


@jit
def sort_along(out, d):
    """Order two contacts along the axis d of body a, so that impulses find theirs again."""
    if dot(vec(out[0, 4:7]), d) > dot(vec(out[1, 4:7]), d):
        for k in range(7):
            out[0, k], out[1, k] = out[1, k], out[0, k]
