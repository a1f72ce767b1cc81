"""What a scene's walls are asked before it runs: who starts behind them, how fast they come.

Heights are signed distances from a surface [m], positive where bodies belong, and known only over
the surface itself: beyond an edge or a rim there is no wrong side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dem_mpi.scene_base import Vec3
from dem_mpi.scene_walls import Motion, Rotation
from dem_mpi.wall_kinds import FRUSTUM, PLANE, RECTANGLE
from dem_mpi.walls import WallFaces

_SAMPLES = 17  # points along an edge of a region
_LEVEL = 1e-9  # cosine to gravity below which a surface holds nothing up


class Behind(NamedTuple):
    """A region that reaches `depth` [m] behind a face.

    certain : bodies do, since a whole side of the region is behind it; else perhaps a corner only
    """

    face: str
    depth: float
    certain: bool
    rule: str


def behind(faces: WallFaces, low: NDArray, high: NDArray) -> Iterator[Behind]:
    """The faces that the box from low to high (3,) reaches behind at time 0.

    A box wholly behind a curved or finite wall may well be meant to be there, and is let pass.
    """
    sides = _sides(low, high)
    tolerance = 1e-9 * float(np.max(high - low))
    for k, name in enumerate(faces.name):
        kind = int(faces.kind[k])
        height = _heights(kind, faces.geometry[k], sides)
        wrong, right = height < -tolerance, height > tolerance
        if not wrong.any():
            continue
        depth = -float(np.nanmin(height))
        if kind == PLANE:
            straight = np.count_nonzero(faces.normal[k]) == 1
            rule = f"a corner of it lies {depth:.3g} m behind the oblique wall '{name}'"
            yield Behind(name, depth, straight or not right.any(), rule)
        elif right.any():
            if kind == RECTANGLE:
                depth = min(depth, float(np.nanmax(height)))
                yield Behind(name, depth, False, f"wall '{name}' passes through it")
            else:
                rule = f"part of it lies {depth:.3g} m behind wall '{name}'"
                yield Behind(name, depth, bool(wrong.all(axis=1).any()), rule)


def _sides(low: NDArray, high: NDArray) -> NDArray:
    """Points on the six sides of a box, (6, samples, 3), its corners among them."""
    share = np.linspace(0.0, 1.0, _SAMPLES)
    u, v = (grid.ravel() for grid in np.meshgrid(share, share, indexing="ij"))
    sides = np.empty((6, u.size, 3))
    for axis in range(3):
        for upper in range(2):
            side = sides[2 * axis + upper]
            side[:, axis], side[:, axis - 1], side[:, axis - 2] = upper, u, v
    return low + sides * (high - low)


def _heights(kind: int, row: NDArray, points: NDArray) -> NDArray:
    """Heights over a face of points (..., 3); NaN where no point of the face lies below."""
    arm = points - row[0:3]
    height = arm @ row[3:6]
    if kind == RECTANGLE:
        edges = (row[6:9], row[9:12])
        over = np.all([np.abs(arm @ edge) <= edge @ edge for edge in edges], axis=0)
        return np.where(over, height, np.nan)
    if kind != FRUSTUM:
        return height
    length, base, top, side = row[6:10]
    slant = math.hypot(length, top - base)
    us, ur = length / slant, (top - base) / slant
    rho = np.linalg.norm(arm - height[..., None] * row[3:6], axis=-1)
    foot = us * height + ur * (rho - base)
    over = (foot >= 0.0) & (foot <= slant)
    return np.where(over, side * (us * (base - rho) + ur * height), np.nan)


def holds(faces: WallFaces, gravity: Vec3) -> bool:
    """Whether some face can hold bodies up against gravity [m/s^2]."""
    pull = np.array(gravity)
    strength = float(np.linalg.norm(pull))
    for kind, row in zip(faces.kind, faces.geometry, strict=True):
        along = float(row[3:6] @ pull)
        if kind == PLANE:
            lift = -along
        elif kind == RECTANGLE:
            lift = abs(along)
        else:
            length, base, top, side = row[6:10]
            slant = math.hypot(length, top - base)
            across = math.sqrt(max(0.0, strength**2 - along**2)) if side > 0.0 else 0.0
            lift = (length * across - side * (top - base) * along) / slant
            # From a convex surface bodies roll off.
            lift = lift if side > 0.0 else 0.0
        if lift > _LEVEL * strength:
            return True
    return False


# ---- speed ---------------------------------------------------------------------------------


def top_speed(motion: Motion, faces: WallFaces, low: NDArray, high: NDArray) -> float:
    """Upper bound of the speed [m/s] at which faces with this motion come towards bodies.

    low, high : (3,) [m] the domain, within which a plane is looked at.
    """
    speed = math.hypot(*motion.velocity)
    if motion.oscillation is not None:
        swing = motion.oscillation
        speed += 2.0 * math.pi * swing.frequency * math.hypot(*swing.amplitude)
    if motion.table is not None:
        speed += max(math.hypot(*velocity) for velocity in motion.table.velocity)
    if motion.rotation is not None:
        moved = [k for k, other in enumerate(faces.motion) if other is motion]
        arms = [
            _lever(int(faces.kind[k]), faces.geometry[k], motion.rotation, low, high) for k in moved
        ]
        speed += _top_rate(motion.rotation) * max(arms, default=0.0)
    return speed


def _top_rate(rotation: Rotation) -> float:
    rates = rotation.table.rate if rotation.table is not None else (0.0,)
    return max(abs(rotation.rate + rate) for rate in rates)


def _lever(kind: int, row: NDArray, rotation: Rotation, low: NDArray, high: NDArray) -> float:
    """Largest distance [m] from the axis at which a turning face can push; 0 if it only slides."""
    axis = np.array(rotation.axis) / np.linalg.norm(rotation.axis)
    if kind == FRUSTUM:
        ends = np.array([row[0:3], row[0:3] + row[6] * row[3:6]])
        distance = _distance(ends, axis, rotation) + row[7:9]
        coaxial = np.all(_distance(ends, axis, rotation) <= 1e-9 * row[7:9].max())
        parallel = np.linalg.norm(np.cross(axis, row[3:6])) <= 1e-9
        return 0.0 if coaxial and parallel else float(distance.max())
    if kind == PLANE:
        if np.linalg.norm(np.cross(axis, row[3:6])) <= 1e-9:
            return 0.0
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
        return float(_distance(corners, axis, rotation).max())
    signs = np.array([(i, j) for i in (-1.0, 1.0) for j in (-1.0, 1.0)])
    corners = row[0:3] + signs @ np.array([row[6:9], row[9:12]])
    return float(_distance(corners, axis, rotation).max())


def _distance(points: NDArray, axis: NDArray, rotation: Rotation) -> NDArray:
    """Distances of points (k, 3) from the axis of rotation."""
    return np.linalg.norm(np.cross(points - np.array(rotation.centre), axis), axis=1)
