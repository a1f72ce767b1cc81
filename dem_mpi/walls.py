"""Walls as arrays: their surfaces, where these are at an instant, and how fast they move.

A wall is a kinematic body: face k has id -(k + 1), no mass, and is known to every rank. A box
gives one face for each of its closed sides.

Motion. A face is turned about the axis of its rotation by the angle that the rate has reached,
then shifted: x(t) = c + R(t) (x(0) - c) + u(t) with u(t) = v t + A (sin(2 pi f t + phase) -
sin(phase)) + the integral of the table's velocity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi import wall_kinds
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
from dem_mpi.wall_kinds import ABSENT, FRUSTUM, PLANE, RECTANGLE

_POINTS, _DIRECTIONS = slice(0, 3), {PLANE: (3,), RECTANGLE: (3, 6, 9), FRUSTUM: (3,)}


@dataclass(frozen=True)
class WallFaces:
    """All wall faces at time 0; face k is the kinematic body with id -(k + 1).

    name: w strings such as "box.z_min"; kind: (w,) int8; geometry: (w, 12) float64, see
    `wall_kinds`; material: (w,) int32; until: (w,) [s] when the face vanishes;
    motion: w, None where a face stands still.
    """

    name: tuple[str, ...]
    kind: NDArray
    geometry: NDArray
    material: NDArray
    until: NDArray
    motion: tuple[Motion | None, ...]

    @cached_property
    def drives(self) -> list[tuple[Drive, list[int]]]:
        """Every motion once, with the faces that it moves."""
        moved: dict[int, tuple[Drive, list[int]]] = {}
        for k, motion in enumerate(self.motion):
            if motion is not None:
                moved.setdefault(id(motion), (Drive(motion), []))[1].append(k)
        return list(moved.values())

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
    A point p of face k has the velocity velocity[k] + spin[k] x (p - centre[k]) [m/s]; centre is
    on the axis of a wall that turns, and else the point of the face.
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

    def rows(self) -> NDArray:
        """All that contact detection asks of a face in one row, (w, 22), see `wall_kinds`."""
        rows = np.empty((len(self.kind), wall_kinds.ROW))
        rows[:, : wall_kinds.GEOMETRY] = self.geometry
        for first, vector in (
            (wall_kinds.VELOCITY, self.velocity),
            (wall_kinds.SPIN, self.spin),
            (wall_kinds.CENTRE, self.centre),
        ):
            rows[:, first : first + 3] = vector
        rows[:, wall_kinds.KIND] = self.kind
        return rows


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
        geometry=np.array(rows, dtype=np.float64).reshape(-1, wall_kinds.GEOMETRY),
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
    row = np.zeros(wall_kinds.GEOMETRY)
    values = np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])
    row[: len(values)] = values
    return row


def _unit(vector: Vec3 | NDArray) -> NDArray:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)


# ---- motion --------------------------------------------------------------------------------


class _Table:
    """What is linear between times and constant outside them, ready to be integrated."""

    def __init__(self, times: ArrayLike, values: ArrayLike) -> None:
        """Take times (k,) and values (k, c)."""
        self._times = np.asarray(times, dtype=np.float64)
        self._values = np.asarray(values, dtype=np.float64)
        areas = np.diff(self._times)[:, None] * 0.5 * (self._values[1:] + self._values[:-1])
        self._areas = np.concatenate((np.zeros((1, areas.shape[1])), np.cumsum(areas, axis=0)))

    def integral(self, start: float, end: float) -> NDArray:
        """Return the integral (c,) from start to end, at a cost that is free of the length."""
        low, high = np.searchsorted(self._times, (start, end), side="right")
        if abs(high - low) <= 1:  # not as a difference of two large areas
            middle = [self._times[min(low, high)]] if low != high else []
            points = np.array([start, *middle, end])
            values = np.array([self._at(point) for point in points])
            return np.diff(points) @ (0.5 * (values[1:] + values[:-1]))
        return self._primitive(end, int(high)) - self._primitive(start, int(low))

    def _at(self, time: float) -> NDArray:
        i = int(np.clip(np.searchsorted(self._times, time, side="right"), 1, len(self._times)))
        before = self._times[i - 1]
        if time <= before or i == len(self._times):
            return self._values[i - 1]
        share = (time - before) / (self._times[i] - before)
        return (1.0 - share) * self._values[i - 1] + share * self._values[i]

    def _primitive(self, time: float, above: int) -> NDArray:
        """The integral from the first of the times; `above` of them are at most `time`."""
        i = max(above - 1, 0)
        mean = 0.5 * (self._values[i] + self._at(time))
        return self._areas[i] + (time - self._times[i]) * mean


class Drive:
    """A motion whose tables are arrays, so that an evaluation costs the same at any time."""

    def __init__(self, motion: Motion) -> None:
        self._velocity = np.array(motion.velocity)
        self._swing = motion.oscillation
        table = motion.table
        self._table = None if table is None else _Table(table.time, table.velocity)
        self.rotation = motion.rotation
        rates = None if motion.rotation is None else motion.rotation.table
        self._rates = None if rates is None else _Table(rates.time, np.array(rates.rate)[:, None])

    def shift(self, start: float, end: float) -> NDArray:
        """Return the displacement (3,) [m] between two times [s], the rotation left aside."""
        shift = self._velocity * (end - start)
        if self._swing is not None:
            # sin b - sin a = 2 cos((a + b)/2) sin((b - a)/2), without a difference of near values
            half = np.pi * self._swing.frequency
            middle = half * (start + end) + self._swing.phase
            change = 2.0 * np.cos(middle) * np.sin(half * (end - start))
            shift = shift + np.array(self._swing.amplitude) * change
        if self._table is not None:
            shift = shift + self._table.integral(start, end)
        return shift

    def turn(self, start: float, end: float) -> float:
        """Return the angle [rad] turned between two times [s]."""
        if self.rotation is None:
            return 0.0
        angle = self.rotation.rate * (end - start)
        if self._rates is not None:
            angle += float(self._rates.integral(start, end)[0])
        return angle


def walls_at(faces: WallFaces, time: float, step: float) -> Walls:
    """Return the faces as they stand at `time` [s], with their mean velocity over the step.

    The mean velocity, not the instant's, so that contact impulses and positions agree: after the
    step a wall that does not turn is where its velocity has taken it.
    """
    count = len(faces.name)
    geometry = faces.geometry.copy()
    velocity, spin = np.zeros((count, 3)), np.zeros((count, 3))
    centre = faces.point.copy()
    for drive, moved in faces.drives:
        now = drive.shift(0.0, time)
        velocity[moved] = drive.shift(time, time + step) / step
        rotation = drive.rotation
        if rotation is not None:
            axis, angle = _unit(rotation.axis), drive.turn(0.0, time)
            spin[moved] = axis * (drive.turn(time, time + step) / step)
            centre[moved] = rotation.centre
            for k in moved:
                _rotate(geometry[k], faces.kind[k], np.array(rotation.centre), axis, angle)
        geometry[moved, _POINTS] += now
        centre[moved] += now
    # A time that is meant to be a step's is missed by rounding.
    gone = time + 1e-9 * step >= faces.until
    kind = np.where(gone, ABSENT, faces.kind).astype(np.int8)
    return Walls(kind, geometry, faces.material, velocity, spin, centre)


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
