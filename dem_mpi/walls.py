"""Walls as arrays: their surfaces, where these are at an instant, and how fast they move.

A wall is a kinematic body: face k has id -(k + 1), no mass, and is known to every rank. A box
gives one face for each of its closed sides.

Motion. A face is turned about the axis of its rotation by the angle that the rate has reached,
then shifted: x(t) = c + R(t) (x(0) - c) + u(t) with u(t) = v t + A (sin(2 pi f t + phase) -
sin(phase)) + the integral of the table's velocity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.scene_base import FACES, Vec3
from dem_mpi.scene_models import Scenario
from dem_mpi.scene_walls import (
    BoxWall,
    ConeWall,
    CylinderWall,
    Motion,
    PlaneWall,
    RectangleWall,
    Wall,
    wall_name,
)

# Kinds of surfaces and what their row of `geometry` holds.
ABSENT = -1
PLANE = 0  # point 0:3, unit normal 3:6 to the side of the bodies
RECTANGLE = 1  # centre 0:3, unit normal 3:6, half edges 6:9 and 9:12
FRUSTUM = 2  # start 0:3, unit axis 3:6, length 6, radii at start and end 7:9, side 9 (+1 inside)
_POINTS, _DIRECTIONS = slice(0, 3), {PLANE: (3,), RECTANGLE: (3, 6, 9), FRUSTUM: (3,)}
_GEOMETRY = 12


@dataclass(frozen=True)
class WallFaces:
    """All wall faces at time 0; face k is the kinematic body with id -(k + 1).

    name: w strings such as "box.z_min"; kind: (w,) int8; geometry: (w, 12) float64, see the
    constants of this module; material: (w,) int32; until: (w,) [s] when the face vanishes;
    motion: w, None where a face stands still.
    """

    name: tuple[str, ...]
    kind: NDArray
    geometry: NDArray
    material: NDArray
    until: NDArray
    motion: tuple[Motion | None, ...]

    @property
    def point(self) -> NDArray:
        """A point of each face, (w, 3) [m]."""
        return self.geometry[:, 0:3]

    @property
    def normal(self) -> NDArray:
        """Unit normal of planes and rectangles, axis of the others, (w, 3)."""
        return self.geometry[:, 3:6]


@dataclass(frozen=True)
class Walls:
    """The faces at one instant, and their mean motion over a step.

    kind, geometry, material as in WallFaces, moved; kind is ABSENT where a face has vanished.
    A point p of face k has the velocity velocity[k] + spin[k] x (p - centre[k]) [m/s].
    """

    kind: NDArray
    geometry: NDArray
    material: NDArray
    velocity: NDArray
    spin: NDArray
    centre: NDArray

    @property
    def moving(self) -> bool:
        """Whether any face moves."""
        return bool(self.velocity.any() or self.spin.any())


def wall_faces(scenario: Scenario) -> WallFaces:
    """The faces of all walls, in the order of the scene; a box gives one per closed face."""
    materials = list(scenario.materials)
    names: list[str] = []
    kinds: list[int] = []
    rows: list[NDArray] = []
    owners: list[Wall] = []
    for index, wall in enumerate(scenario.walls):
        for suffix, kind, row in _surfaces(wall):
            names.append(wall_name(wall, index) + suffix)
            kinds.append(kind)
            rows.append(row)
            owners.append(wall)
    return WallFaces(
        name=tuple(names),
        kind=np.array(kinds, dtype=np.int8),
        geometry=np.array(rows, dtype=np.float64).reshape(-1, _GEOMETRY),
        material=np.array([materials.index(wall.material) for wall in owners], dtype=np.int32),
        until=np.array([np.inf if wall.until is None else wall.until for wall in owners]),
        motion=tuple(wall.motion for wall in owners),
    )


def _surfaces(wall: Wall) -> list[tuple[str, int, NDArray]]:
    """(name suffix, kind, geometry) of each face."""
    if isinstance(wall, PlaneWall):
        return [("", PLANE, _row(wall.point, _unit(wall.normal)))]
    if isinstance(wall, BoxWall):
        return _box_faces(wall)
    if isinstance(wall, RectangleWall):
        first, second = (0.5 * np.array(edge) for edge in wall.edges)
        centre = np.array(wall.corner) + first + second
        return [("", RECTANGLE, _row(centre, _unit(np.cross(first, second)), first, second))]
    if isinstance(wall, (CylinderWall, ConeWall)):
        axis = np.array(wall.end) - np.array(wall.start)
        radii = wall.radii if isinstance(wall, ConeWall) else (wall.radius, wall.radius)
        side = 1.0 if wall.side == "inside" else -1.0
        length = np.linalg.norm(axis)
        return [("", FRUSTUM, _row(wall.start, axis / length, (length, *radii), (side,)))]
    return [("", FRUSTUM, _row(wall.centre, _unit(wall.normal), (0.0, *wall.radii), (1.0,)))]


def _box_faces(wall: BoxWall) -> list[tuple[str, int, NDArray]]:
    faces = []
    for index, face in enumerate(FACES):
        if face in wall.open:
            continue
        axis, upper = divmod(index, 2)
        normal = np.zeros(3)
        normal[axis] = -1.0 if upper else 1.0
        faces.append((f".{face}", PLANE, _row(wall.max if upper else wall.min, normal)))
    return faces


def _row(*parts: ArrayLike) -> NDArray:
    row = np.zeros(_GEOMETRY)
    values = np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])
    row[: len(values)] = values
    return row


def _unit(vector: Vec3 | NDArray) -> NDArray:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)


# ---- motion --------------------------------------------------------------------------------


def walls_at(faces: WallFaces, time: float, step: float) -> Walls:
    """Return the faces as they stand at `time` [s], with their mean velocity over the step.

    The mean velocity, not the instant's, so that contact impulses and positions agree: after the
    step the wall is where its velocity has taken it.
    """
    count = len(faces.name)
    geometry = faces.geometry.copy()
    velocity, spin, centre = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    for k, motion in enumerate(faces.motion):
        if motion is None:
            continue
        now = displacement(motion, time)
        velocity[k] = (displacement(motion, time + step) - now) / step
        if motion.rotation is not None:
            axis, angle = _unit(motion.rotation.axis), turn(motion, time)
            spin[k] = axis * ((turn(motion, time + step) - angle) / step)
            centre[k] = np.array(motion.rotation.centre) + now
            _rotate(geometry[k], faces.kind[k], np.array(motion.rotation.centre), axis, angle)
        geometry[k, _POINTS] += now
    kind = np.where(time >= faces.until, ABSENT, faces.kind).astype(np.int8)
    return Walls(kind, geometry, faces.material, velocity, spin, centre)


def displacement(motion: Motion, time: float) -> NDArray:
    """Return the shift (3,) [m] of a wall since time 0, its rotation left aside."""
    shift = np.array(motion.velocity) * time
    swing = motion.oscillation
    if swing is not None:
        angle = 2.0 * np.pi * swing.frequency * time + swing.phase
        shift += np.array(swing.amplitude) * (np.sin(angle) - np.sin(swing.phase))
    if motion.table is not None:
        velocity = np.array(motion.table.velocity)
        shift += np.array([integral(motion.table.time, velocity[:, i], time) for i in range(3)])
    return shift


def turn(motion: Motion, time: float) -> float:
    """Return the angle [rad] that a wall has turned since time 0."""
    rotation = motion.rotation
    if rotation is None:
        return 0.0
    angle = rotation.rate * time
    if rotation.table is not None:
        angle += integral(rotation.table.time, np.array(rotation.table.rate), time)
    return angle


def integral(times: ArrayLike, values: NDArray, end: float) -> float:
    """Return the integral from 0 to `end` of what is linear between times, constant outside."""
    knots = np.asarray(times, dtype=np.float64)
    inner = knots[(knots > min(0.0, end)) & (knots < max(0.0, end))]
    points = np.concatenate(([min(0.0, end)], inner, [max(0.0, end)]))
    heights = np.interp(points, knots, values)
    area = float(np.sum(0.5 * (heights[1:] + heights[:-1]) * np.diff(points)))
    return area if end >= 0.0 else -area


def _rotate(row: NDArray, kind: int, centre: NDArray, axis: NDArray, angle: float) -> None:
    """Turn a row of geometry about an axis, in place."""
    matrix = rotation_matrix(axis, angle)
    row[_POINTS] = centre + matrix @ (row[_POINTS] - centre)
    for first in _DIRECTIONS[int(kind)]:
        row[first : first + 3] = matrix @ row[first : first + 3]


def rotation_matrix(axis: NDArray, angle: float) -> NDArray:
    """Return the rotation (3, 3) by `angle` [rad] about the unit `axis` (3,) (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


def velocity_at(walls: Walls, wall: NDArray, point: NDArray) -> NDArray:
    """Return the velocity (m, 3) [m/s] of points (m, 3) of the faces `wall` (m,)."""
    arm = point - walls.centre[wall]
    return walls.velocity[wall] + np.cross(walls.spin[wall], arm)
