"""Signed distances of points from a meridian, and gaps between bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from stokes._kernels_distance import least_distances, nearest_points
from stokes.curves import Curve, Spheroid

if TYPE_CHECKING:
    from stokes.geometry import Body

Array = NDArray[np.float64]

_SAMPLES = 12  # of a panel on which the curve is a polynomial of degree 15


@dataclass(frozen=True)
class Gaps:
    """Least distances of m pairs of bodies, and where they are."""

    distance: Array  # (m,) negative: overlap
    s: Array  # (m, 2) curve parameters of the two nearest points
    points: Array  # (m, 2, 3) the nearest points


def distance(curve: Curve, r: ArrayLike, z: ArrayLike) -> tuple[Array, Array]:
    """Return the signed distance of points (r >= 0, z), negative inside, and their nearest s."""
    r, z = np.broadcast_arrays(np.asarray(r, float), np.asarray(z, float))
    edges, series = curve.polynomials
    delta, s = np.empty(r.size), np.empty(r.size)
    nearest_points(edges, series, _samples(curve), r.ravel(), z.ravel(), delta, s)
    return delta.reshape(r.shape), s.reshape(r.shape)


def gaps(first: Sequence[Body], second: Sequence[Body]) -> Gaps:
    """Return the least distances of first[i] from second[i], two sequences of one length.

    The signed distance to the second body is minimised over the surface of the first: the depth
    of overlapping bodies is that of the deepest point, as a negative distance.
    """
    if len(first) != len(second):
        raise ValueError(f"gaps: {len(first)} bodies against {len(second)}")
    pairs = np.column_stack([np.arange(len(first)), len(first) + np.arange(len(first))])
    return gaps_of_pairs([*first, *second], pairs)


def gaps_of_pairs(bodies: Sequence[Body], pairs: ArrayLike) -> Gaps:
    """Return the least distances of pairs (m, 2) of indices into `bodies`."""
    pairs = np.ascontiguousarray(pairs, np.int64).reshape(-1, 2)
    curves = list(dict.fromkeys(body.curve for body in bodies))
    numbers = {curve: i for i, curve in enumerate(curves)}
    curve_of = np.array([numbers[body.curve] for body in bodies], np.int64)
    if len(pairs) == 0:
        return Gaps(np.empty(0), np.empty((0, 2)), np.empty((0, 2, 3)))
    tables = [curve.polynomials for curve in curves]
    samples = [_samples(curve) for curve in curves]
    arguments = (
        np.array([body.centre for body in bodies]),
        np.array([body.rotation for body in bodies]),
        np.array([body.scale for body in bodies]),
        curve_of,
        np.array([_sphere_radius(curve) for curve in curves]),
        np.cumsum([0, *(len(series) for _, series in tables)]),
        np.concatenate([edges for edges, _ in tables]),
        np.concatenate([series for _, series in tables]),
        np.cumsum([0, *(block.shape[1] for block in samples)]),
        np.concatenate(samples, axis=1),
    )
    found = _least_distances(pairs, arguments)
    # Between dented bodies distances have many minima: they are sought from both surfaces.
    dented = np.array([_is_dented(curve) for curve in curves])
    again = np.flatnonzero(dented[curve_of[pairs]].any(axis=1) & (found.distance > 0))
    back = _least_distances(np.ascontiguousarray(pairs[again, ::-1]), arguments)
    nearer = back.distance < found.distance[again]
    for values, others in (
        (found.distance, back.distance),
        (found.s, back.s[:, ::-1]),
        (found.points, back.points[:, ::-1]),
    ):
        values[again[nearer]] = others[nearer]
    return found


def _least_distances(pairs: NDArray[np.int64], arguments: tuple) -> Gaps:
    m = len(pairs)
    found = Gaps(np.empty(m), np.empty((m, 2)), np.empty((m, 2, 3)))
    least_distances(pairs, *arguments, found.distance, found.s, found.points)
    return found


def close_pairs(bodies: Sequence[Body], reach: float) -> NDArray[np.int64]:
    """Return the pairs (m, 2), i < j, sorted, whose bounding spheres are nearer than `reach`."""
    if len(bodies) < 2:
        return np.empty((0, 2), np.int64)
    centres = np.array([body.centre for body in bodies])
    radii = np.array([body.bounding_radius for body in bodies])
    tree = cKDTree(centres)
    # Each body looks for those no greater than itself: no search is wider than two radii.
    found = tree.query_ball_point(centres, 2 * radii + reach, return_sorted=True)
    i = np.repeat(np.arange(len(bodies)), [len(row) for row in found])
    j = np.concatenate([np.asarray(row, np.int64) for row in found])
    smaller = (radii[j] < radii[i]) | ((radii[j] == radii[i]) & (i < j))
    apart = np.sqrt(np.sum((centres[i] - centres[j]) ** 2, axis=1))
    near = smaller & (apart - radii[i] - radii[j] < reach)
    pairs = np.sort(np.column_stack([i[near], j[near]]), axis=1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _samples(curve: Curve) -> Array:
    """Return parameters, r and z of samples from pole to pole, (3, n)."""
    edges, _ = curve.polynomials
    steps = np.linspace(0, 1, _SAMPLES + 1)[:-1]
    s = np.append((edges[:-1, None] + np.diff(edges)[:, None] * steps).ravel(), 1.0)
    points = curve.evaluate(s)
    return np.stack([s, points.r, points.z])


def _is_dented(curve: Curve) -> bool:
    """Whether the meridian is concave anywhere, but for rounding."""
    bend = curve.evaluate(_samples(curve)[0]).meridional_curvature
    return bool(bend.min() < -1e-9 * bend.max())


def _sphere_radius(curve: Curve) -> float:
    """Radius of a sphere about the origin; 0 for any other curve."""
    if isinstance(curve, Spheroid) and curve.equatorial == curve.polar and curve.cosine[0] == 0:
        return curve.equatorial
    return 0.0
