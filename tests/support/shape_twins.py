"""Brute force for contacts of axisymmetric bodies: dense samples, then ever finer ones.

Every twin minimises a distance over points, taken from its definition, without derivatives. A
minimum found within a patch of width w is off by O(w^2) in the distance, so that patches of 1e-8
of the size give distances to round-off, and places to 1e-8.

Symbols: a, c equatorial and polar semi-axis of a spheroid; d unit axis; y points (k, 3) relative
to a centre; g row of a wall, as in `dem_mpi._kernels_shapes`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def random_unit(rng: np.random.Generator) -> NDArray:
    """A direction (3,) drawn evenly."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def random_rotation(rng: np.random.Generator) -> NDArray:
    """A proper rotation (3, 3) drawn evenly."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def frame(d: NDArray) -> NDArray:
    """Rows (3, 3): two directions across the unit vector d, then d."""
    first = np.cross(d, np.eye(3)[np.argmin(np.abs(d))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(d, first), d])


def zoom(
    function: Callable[[NDArray], NDArray],
    low: NDArray,
    high: NDArray,
    first: int = 401,
    later: int = 21,
    wrap: NDArray | None = None,
    width: float = 1e-10,
) -> tuple[NDArray, float]:
    """Minimise over a box: the best of a dense grid, then grids about the best, halved when it
    lies well inside them. `wrap` marks coordinates that may leave the box (angles).
    """
    low, high = np.atleast_1d(low).astype(float), np.atleast_1d(high).astype(float)
    free = np.zeros(len(low), bool) if wrap is None else np.asarray(wrap)
    axes = [np.linspace(a, b, first) for a, b in zip(low, high, strict=True)]
    half = 4.0 * (high - low) / (first - 1)
    centre, best_u, best = 0.5 * (low + high), None, np.inf
    for _ in range(400):
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(low))
        values = function(points)
        at = int(np.argmin(values))
        inside = best_u is not None and np.all(np.abs(points[at] - centre) <= 0.6 * half)
        if values[at] < best:
            best_u, best = points[at], float(values[at])
        else:
            inside = True
        if inside:
            half = half * 0.5
        if np.all(half <= width * (high - low)):
            break
        centre = best_u
        axes = []
        for k in range(len(low)):
            a, b = centre[k] - half[k], centre[k] + half[k]
            if not free[k]:
                a, b = max(a, low[k]), min(b, high[k])
            axes.append(np.linspace(a, b, later))
    return best_u, best


# ---- spheroid ------------------------------------------------------------------------------


def spheroid_point(u: NDArray, d: NDArray, a: float, c: float) -> NDArray:
    """Points (k, 3) of the surface at polar angle u[:, 0] and azimuth u[:, 1] about d."""
    f = frame(d)
    sine = np.sin(u[:, 0])
    return (
        a * (sine * np.cos(u[:, 1]))[:, None] * f[0]
        + a * (sine * np.sin(u[:, 1]))[:, None] * f[1]
        + c * np.cos(u[:, 0])[:, None] * f[2]
    )


def spheroid_distance(y: NDArray, d: NDArray, a: float, c: float) -> NDArray:
    """Signed distances (k,) of points from the surface: the least over its meridian ellipse.

    300 angles, then golden sections of the bracket; the distance is written as a sum that does
    not cancel near the surface.
    """
    y = np.atleast_2d(y)
    s = np.abs(y @ d)
    rho = np.linalg.norm(y - (y @ d)[:, None] * d, axis=1)

    def squared(angle: NDArray) -> NDArray:
        return (s[:, None] - c * np.cos(angle)) ** 2 + (rho[:, None] - a * np.sin(angle)) ** 2

    angles = np.linspace(0.0, np.pi / 2, 301)
    at = np.argmin(squared(angles[None, :]), axis=1)
    low, high = angles[np.maximum(at - 1, 0)], angles[np.minimum(at + 1, 300)]

    def slope(angle: NDArray) -> NDArray:
        return (s - c * np.cos(angle)) * c * np.sin(angle) - (rho - a * np.sin(angle)) * (
            a * np.cos(angle)
        )

    for _ in range(60):  # bisection on the slope of the squared distance
        middle = 0.5 * (low + high)
        rising = slope(middle) > 0.0
        low, high = np.where(rising, low, middle), np.where(rising, middle, high)
    distance = np.sqrt(squared((0.5 * (low + high))[:, None])[:, 0])
    inside = (s / c) ** 2 + (rho / a) ** 2 < 1.0
    return np.where(inside, -distance, distance)


def support(n: NDArray, d: NDArray, a: float, c: float) -> NDArray:
    """Support function sqrt(n'Qn) (k,) of directions (k, 3)."""
    s = n @ d
    return np.sqrt(a * a * (np.sum(n * n, axis=-1) - s * s) + c * c * s * s)


# ---- pairs ---------------------------------------------------------------------------------


def segment_pair_distance(
    D: NDArray, da: NDArray, la: float, db: NDArray, lb: float
) -> tuple[float, float]:
    """(s, distance) of two segments: least over s of the distance from the other segment."""

    def distance(u: NDArray) -> NDArray:
        p = u[:, :1] * da - D
        t = np.clip(p @ db, -lb, lb)
        return np.linalg.norm(p - t[:, None] * db, axis=1)

    u, best = zoom(distance, [-la], [la], width=1e-13)
    return float(u[0]), best


def spheroid_segment_distance(
    y: NDArray, e: NDArray, half: float, d: NDArray, a: float, c: float
) -> tuple[float, float]:
    """(t, delta): the least signed distance of points y + t e, |t| <= half, from a spheroid."""
    u, best = zoom(
        lambda u: spheroid_distance(y + u * e, d, a, c), [-half], [half], 201, 9, width=1e-13
    )
    return float(u[0]), best


def spheroid_pair_distance(
    D: NDArray, da: NDArray, aa: float, ca: float, db: NDArray, ab: float, cb: float
) -> float:
    """Distance of two spheroids that do not overlap: least over the surface points of one."""

    def distance(u: NDArray) -> NDArray:
        return spheroid_distance(spheroid_point(u, da, aa, ca) - D, db, ab, cb)

    return zoom(distance, [0.0, -np.pi], [np.pi, np.pi], 61, 9, [True, True], 1e-9)[1]


def spheroid_pair_depth(
    D: NDArray, da: NDArray, aa: float, ca: float, db: NDArray, ab: float, cb: float
) -> float:
    """Signed distance of two spheroids, overlapping or not: largest n.D - h_a(n) - h_b(n)."""
    f = frame(da)

    def minus(u: NDArray) -> NDArray:
        sine = np.sin(u[:, 0])
        n = (
            (sine * np.cos(u[:, 1]))[:, None] * f[0]
            + (sine * np.sin(u[:, 1]))[:, None] * f[1]
            + np.cos(u[:, 0])[:, None] * f[2]
        )
        return support(n, da, aa, ca) + support(n, db, ab, cb) - n @ D

    return -zoom(minus, [0.0, -np.pi], [np.pi, np.pi], 241, 11, [True, True], 1e-9)[1]


# ---- walls ---------------------------------------------------------------------------------


def rectangle_distance(y: NDArray, g: NDArray) -> NDArray:
    """Distances (k,) of points in the world from a plate."""
    total = y - g[0:3]
    for e in (g[6:9], g[9:12]):
        u = np.clip(total @ e / (e @ e), -1.0, 1.0)
        y = y - u[:, None] * e
    return np.linalg.norm(y - g[0:3], axis=1)


def frustum_distance(y: NDArray, g: NDArray) -> NDArray:
    """Distances (k,), negative behind the surface, of points in the world from a frustum."""
    X = y - g[0:3]
    s = X @ g[3:6]
    rho = np.linalg.norm(X - s[:, None] * g[3:6], axis=1)
    along = np.array([g[6], g[8] - g[7]])
    length = np.linalg.norm(along)
    along = along / length
    f = s * along[0] + (rho - g[7]) * along[1]
    to_bodies = g[9] * np.array([along[1], -along[0]])
    height = s * to_bodies[0] + (rho - g[7]) * to_bodies[1]
    rim = np.clip(f, 0.0, length)
    clamped = np.hypot(s - rim * along[0], rho - g[7] - rim * along[1])
    return np.where((f >= 0.0) & (f <= length), height, clamped)


def rod_wall_gap(
    distance: Callable[[NDArray], NDArray], x: NDArray, d: NDArray, r: float, half: float
) -> float:
    """Least distance of the points of a core from a wall, less the radius."""
    return zoom(lambda u: distance(x + u * d), [-half], [half], 2001, width=1e-13)[1] - r


def spheroid_wall_gap(
    distance: Callable[[NDArray], NDArray], x: NDArray, d: NDArray, a: float, c: float
) -> float:
    """Least distance of the points of a spheroid's surface from a wall."""

    def gap(u: NDArray) -> NDArray:
        return distance(x + spheroid_point(u, d, a, c))

    return zoom(gap, [0.0, -np.pi], [np.pi, np.pi], 301, 11, [True, True], 1e-9)[1]
