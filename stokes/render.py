"""Pictures of a flow: streamlines on a plane through it, coloured by speed, bodies in grey.

Needs matplotlib, which nothing else of this package does (the extra `plot`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from stokes.distance import distance
from stokes.geometry import Body

AXES = "xyz"
_INK, _BODY = "0.15", "0.82"
_FINE = 600  # points along the longer side on which outlines of bodies are found
_INCHES = 8.0


@dataclass(frozen=True)
class Plane:
    """A rectangle across a coordinate axis, with a regular grid of points on it.

    axis : 0, 1, 2; place : coordinate along it [m]; low, high : corners [m] along the other two
    axes, in rising order; counts : points along these
    """

    axis: int
    place: float
    low: tuple[float, float]
    high: tuple[float, float]
    counts: tuple[int, int]

    @classmethod
    def through(
        cls,
        bodies: Sequence[Body],
        axis: int = 1,
        place: float | None = None,
        longest: int = 120,
        margin: float = 1.0,
    ) -> Plane:
        """A plane across `axis` as large as all bodies, by default where it cuts most of them.

        longest : points along the longer side; margin : room around the bodies, in largest radii
        """
        centre = np.array([body.centre for body in bodies])
        radius = np.array([body.bounding_radius for body in bodies])
        low = (centre - radius[:, None]).min(axis=0) - margin * radius.max()
        high = (centre + radius[:, None]).max(axis=0) + margin * radius.max()
        if place is None:
            place = _busiest(centre[:, axis], radius)
        across = [k for k in range(3) if k != axis]
        side = (high - low)[across]
        counts = tuple(max(2, round(longest * part)) for part in side / side.max())
        return cls(axis, place, tuple(low[across]), tuple(high[across]), counts)

    @property
    def across(self) -> tuple[int, int]:
        """Axes that the plane spans: to the right and upwards in a picture."""
        first, second = (k for k in range(3) if k != self.axis)
        return first, second

    def sides(self, counts: tuple[int, int] | None = None) -> tuple[NDArray, NDArray]:
        """Coordinates of the grid's points, or of so many, along either side."""
        a, b = counts or self.counts
        return (
            np.linspace(self.low[0], self.high[0], a),
            np.linspace(self.low[1], self.high[1], b),
        )

    def points(self, counts: tuple[int, int] | None = None) -> NDArray:
        """Points (n, 3), the first side fastest."""
        right, up = np.meshgrid(*self.sides(counts))
        points = np.full((right.size, 3), self.place)
        points[:, self.across[0]], points[:, self.across[1]] = right.ravel(), up.ravel()
        return points


def _busiest(centre: NDArray, radius: NDArray) -> float:
    """The centre (n,) that most bodies reach with half their radius; the middlemost of such."""
    first, last = np.sort(centre - 0.5 * radius), np.sort(centre + 0.5 * radius)
    reached = np.searchsorted(first, centre, "right") - np.searchsorted(last, centre, "left")
    best = centre[reached == reached.max()]
    middle = 0.5 * (centre.min() + centre.max())
    return float(best[np.argmin(np.abs(best - middle))])


def distance_to_bodies(points: NDArray, bodies: Sequence[Body]) -> NDArray:
    """Signed distance (n,) of points (n, 3) to the nearest body, negative inside.

    Exact where it is less than half of a body's bounding radius, and positive beyond.
    """
    nearest = np.full(len(points), np.inf)
    for body in bodies:
        reach = 1.5 * body.bounding_radius
        apart = np.linalg.norm(points - body.centre, axis=1)
        near = np.flatnonzero(apart < reach)
        if not len(near):
            continue
        local = body.to_local(points[near])
        found, _ = distance(body.curve, np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        nearest[near] = np.minimum(nearest[near], body.scale * found)
    return nearest


def draw_slice(
    path: Path | str,
    plane: Plane,
    velocity: NDArray,
    bodies: Sequence[Body],
    title: str = "",
    width: int = 1280,
) -> None:
    """Write a picture of the velocity (n, 3) [m/s] at `plane.points()`, NaN inside bodies.

    Lines follow the components in the plane, colours the whole speed. The format is that of the
    file's name. Raises ImportError without matplotlib, OSError where the file cannot be written,
    ValueError for a format that there is not.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    right, up = plane.sides()
    shape = (len(up), len(right))
    speed = np.linalg.norm(velocity, axis=1).reshape(shape)
    along = [np.ma.masked_invalid(velocity[:, k].reshape(shape)) for k in plane.across]
    size = np.subtract(plane.high, plane.low)
    scale = _INCHES / float(size.max())
    shape_in_inches = (scale * float(size[0]) + 1.5, 0.85 * scale * float(size[1]) + 1.0)
    figure, axes = plt.subplots(figsize=shape_in_inches, dpi=width / _INCHES)
    try:
        top = float(np.nanmax(speed, initial=0.0)) or 1.0
        picture = axes.pcolormesh(
            right, up, _filled(speed), shading="gouraud", cmap="viridis", vmin=0.0, vmax=top
        )
        if any(np.ma.any(part) for part in along):
            axes.streamplot(right, up, *along, color="white", density=1.4, linewidth=0.7)
        _draw_bodies(axes, plane, bodies)
        axes.set_aspect("equal")
        axes.set_xlim(plane.low[0], plane.high[0])
        axes.set_ylim(plane.low[1], plane.high[1])
        axes.set_xlabel(f"{AXES[plane.across[0]]}, m")
        axes.set_ylabel(f"{AXES[plane.across[1]]}, m")
        axes.set_title(title, color=_INK, fontsize=10)
        figure.colorbar(picture, label="speed, m/s", shrink=0.8)
        figure.savefig(path, bbox_inches="tight")
    finally:
        plt.close(figure)


def _filled(values: NDArray) -> NDArray:
    """What is NaN takes the value of the nearest point that is not: bodies are drawn over it."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros_like(values)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def _draw_bodies(axes, plane: Plane, bodies: Sequence[Body]) -> None:
    """Fill where the distance to the bodies is negative."""
    size = np.subtract(plane.high, plane.low)
    counts = tuple(max(2, math.ceil(_FINE * part)) for part in size / size.max())
    inside = distance_to_bodies(plane.points(counts), bodies)
    field = np.clip(inside, -1.0, float(size.max())).reshape(counts[1], counts[0])
    if not (field < 0.0).any():
        return
    sides = plane.sides(counts)
    axes.contourf(*sides, field, levels=[-np.inf, 0.0], colors=_BODY, zorder=3)
    axes.contour(*sides, field, levels=[0.0], colors=_INK, linewidths=0.8, zorder=4)
