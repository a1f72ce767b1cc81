"""Where points stand against rectangles and frustums; rows g of walls as in `_kernels_shapes`.

Symbols: P point in the world; k axis and (s, rho) meridian coordinates of a frustum, with
(us, ur) the direction of its meridian segment and (-sin, cos) the normal away from the axis.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi._kernels_vectors import (
    along,
    clamp,
    dot,
    meridian,
    neg,
    norm,
    scaled,
    sub,
    unit,
    vec,
)


@jit
def on_rectangle(P, g):
    """Return (distance, n, clamped) from a point P to a rectangle, n towards the rectangle.

    `clamped`: the foot lies on an edge or a corner. A point in the plate counts as above it.
    """
    m, e1, e2 = vec(g[3:6]), vec(g[6:9]), vec(g[9:12])
    X = sub(P, vec(g[0:3]))
    height = dot(X, m)
    u1, u2 = dot(X, e1) / dot(e1, e1), dot(X, e2) / dot(e2, e2)
    if abs(u1) <= 1.0 and abs(u2) <= 1.0:
        return abs(height), (m if height < 0.0 else neg(m)), False
    u1, u2 = clamp(u1, -1.0, 1.0), clamp(u2, -1.0, 1.0)
    v = along(along(neg(X), u1, e1), u2, e2)
    distance = norm(v)
    return distance, unit(v), True


@jit
def frustum_frame(g):
    """Return (length, slant, us, ur, cos, sin): the meridian segment of a frustum.

    (us, ur) is its unit direction from the base and (-sin, cos) its normal away from the axis
    (on a flat ring that widens: along -axis), both as (s, rho).
    """
    L, rise = g[6], g[8] - g[7]
    slant = np.sqrt(L * L + rise * rise)
    if slant == 0.0:  # a ring without width is its rim
        return L, slant, 0.0, 1.0, 0.0, 1.0
    return L, slant, L / slant, rise / slant, L / slant, rise / slant


@jit
def _on_meridian(s, rho, radial, g):
    """`on_frustum` in the meridian half plane along `radial`; on the opposite one rho < 0."""
    k, side = vec(g[3:6]), g[9]
    _, slant, us, ur, cos, sin = frustum_frame(g)
    away = along(scaled(side * cos, radial), -side * sin, k)
    height = -side * (cos * (rho - g[7]) - sin * s)
    f = us * s + ur * (rho - g[7])
    if 0.0 <= f <= slant and slant > 0.0:
        return height, away, False, height
    f = 0.0 if f < 0.0 else slant
    vs, vr = us * f - s, g[7] + ur * f - rho
    distance = np.sqrt(vs * vs + vr * vr)
    if distance == 0.0:
        return 0.0, away, True, height
    return distance, along(scaled(vr / distance, radial), vs / distance, k), True, height


@jit
def on_frustum(P, g):
    """Return (distance, n, clamped, height) from a point P to a frustum, n towards it.

    Foot within the surface: the distance is signed, positive on the bodies' side, and n is the
    normal of that side even behind the surface. Foot on a rim (`clamped`): unsigned. `height` is
    the signed distance from the surface continued beyond its rims.
    """
    s, rho, radial = meridian(sub(P, vec(g[0:3])), vec(g[3:6]))
    return _on_meridian(s, rho, radial, g)


@jit
def on_far_side(P, g):
    """Return (distance, n) on the meridian opposite to the nearest; inf if P is not held there.

    It is where a sphere in a snug tube, a tapering cone or a hole has its second contact: inside a
    surface, or on the rim of a hole.
    """
    s, rho, radial = meridian(sub(P, vec(g[0:3])), vec(g[3:6]))
    distance, n, clamped, _ = _on_meridian(s, -rho, neg(radial), g)
    _, _, us, ur, _, _ = frustum_frame(g)
    rim = g[7] if us * s - ur * (rho + g[7]) < 0.0 else g[8]
    if (clamped and rim == 0.0) or (not clamped and g[9] < 0.0):
        return np.inf, n
    return distance, n


@jit
def behind(clamped, height, depth):
    """Whether a body whose centre stands so has the surface of a frustum behind it, untouched.

    Beside the surface it is behind when deeper than `depth`, its smallest size: less may be an
    overlap to be undone. Beyond a rim any body may pass to the other side.
    """
    return height < (0.0 if clamped else -depth)


@jit
def crossings(P, Q, g, margin):
    """Return (crosses, pierces): does segment P Q meet a frustum continued beyond its rims, and
    does it meet it between them, give or take `margin`?

    On the segment cos rho(t) = cos r0 + sin s(t), squared: two roots.
    """
    X, V, k = sub(P, vec(g[0:3])), sub(Q, P), vec(g[3:6])
    L, slant, us, ur, cos, sin = frustum_frame(g)
    s0, s1 = dot(X, k), dot(V, k)
    e0, e1 = along(X, -s0, k), along(V, -s1, k)
    level = cos * g[7] + sin * s0
    A = cos * cos * dot(e1, e1) - (sin * s1) ** 2
    B = cos * cos * dot(e0, e1) - sin * s1 * level
    C = cos * cos * dot(e0, e0) - level * level
    if L == 0.0:
        first = second = -s0 / s1
    else:
        q = -(B + np.copysign(np.sqrt(B * B - A * C), B))
        first, second = q / A, C / q
    crosses, pierces = False, False
    for t in (first, second):
        if 0.0 <= t <= 1.0 and (L == 0.0 or level + sin * s1 * t >= 0.0):
            crosses = True
            f = us * (s0 + t * s1) + ur * (norm(along(e0, t, e1)) - g[7])
            pierces = pierces or -margin <= f <= slant + margin
    return crosses, pierces
