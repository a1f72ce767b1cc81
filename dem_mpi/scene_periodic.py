"""Rules of scenes whose domain repeats: periods, and walls that meet a periodic face."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dem_mpi.periodic import AXES, PeriodicBox
from dem_mpi.placement_checks import start_region
from dem_mpi.scene_base import FACES
from dem_mpi.scene_models import Scenario
from dem_mpi.scene_walls import BoxWall, Motion, PlaneWall, RectangleWall
from dem_mpi.sizes import largest_reach, smallest_radius
from dem_mpi.wall_kinds import PLANE, RECTANGLE
from dem_mpi.walls import WallFaces, wall_faces
from dem_mpi.yaml_reader import KeyPath

_STRAIGHT = 1e-12  # component of a unit normal that counts as none


def periodic_violations(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    """(path, rule): too short periods, regions beyond the box, planes across a periodic axis."""
    box = PeriodicBox.of(scenario.domain)
    if box is None:
        return
    shortest, axis = box.shortest
    distance = _interaction(scenario)
    if distance > shortest:
        rule = (
            f"along {axis} the domain repeats every {shortest:.6g} m, but bodies interact over up "
            f"to {distance:.6g} m (their largest size, margin and skin)"
        )
        yield ("domain", "periodic"), rule
    yield from _regions_beyond(scenario, box)
    for index, wall in enumerate(scenario.walls):
        for axis in scenario.domain.periodic:
            if isinstance(wall, BoxWall):
                faces = [f for f in FACES if f.startswith(axis) and f not in wall.open]
                if faces:
                    rule = f"the domain is periodic along {axis}: add {', '.join(faces)}"
                    yield ("walls", index, "open"), rule
            elif isinstance(wall, PlaneWall):
                normal = np.array(wall.normal) / np.linalg.norm(wall.normal)
                if abs(normal[AXES.index(axis)]) > _STRAIGHT:
                    rule = f"an infinite plane must not cut the periodic axis {axis}"
                    yield ("walls", index, "normal"), rule
            if isinstance(wall, (BoxWall, PlaneWall)) and _turns(wall.motion, AXES.index(axis)):
                rule = f"turns an infinite plane about an axis other than the periodic axis {axis}"
                yield ("walls", index, "motion", "rotation"), rule


def _regions_beyond(scenario: Scenario, box: PeriodicBox) -> Iterator[tuple[KeyPath, str]]:
    """Random places and inlets beyond a periodic face: who is there already is not seen there."""
    for index, group in enumerate(scenario.bodies):
        filled = start_region(group)
        if filled is None:
            continue
        key, region = filled
        slack = 1e-9 * box.period
        beyond = (region.min < box.low - slack) | (region.max > box.high + slack)
        for axis in np.flatnonzero(beyond & box.periodic):
            rule = (
                f"must lie within the domain along its periodic axis {AXES[axis]}: from "
                f"{box.low[axis]:g} to {box.high[axis]:g} m"
            )
            yield ("bodies", index, "placement", key), rule


def periodic_doubts(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    """(path, rule): finite walls that end near a periodic face, and so are met on one side only."""
    box = PeriodicBox.of(scenario.domain)
    if box is None:
        return
    near = 0.5 * _interaction(scenario)
    for index, wall in enumerate(scenario.walls):
        if isinstance(wall, (BoxWall, PlaneWall)):
            continue
        faces = wall_faces(scenario.model_copy(update={"walls": (wall,)}))
        low, high = _bounds(faces)
        for axis in np.flatnonzero(box.periodic):
            within = low[axis] >= box.low[axis] + near and high[axis] <= box.high[axis] - near
            through = low[axis] <= box.low[axis] - near and high[axis] >= box.high[axis] + near
            if not (within or through):
                rule = (
                    f"walls do not repeat: bodies near the faces of the domain along {AXES[axis]} "
                    f"may meet it on one side only; let it stay {near:.3g} m within both faces or "
                    f"reach as far beyond both"
                )
                yield (
                    ("walls", index, "corner" if isinstance(wall, RectangleWall) else "shape"),
                    rule,
                )


def _interaction(scenario: Scenario) -> float:
    """The distance [m] over which bodies at rest are listed as near; what files hold left aside."""
    groups = [group for group in scenario.bodies if group.radius is not None]
    if not groups:
        return 0.0
    largest = max(largest_reach(group) for group in groups)
    smallest = min(smallest_radius(group) for group in groups)
    return (2.0 + scenario.contact.margin) * largest + scenario.contact.skin * smallest


def _turns(motion: Motion | None, axis: int) -> bool:
    """Whether a motion rotates about another direction than a coordinate axis.

    Neither the place nor the velocity of what turns about it repeats along the axis.
    """
    if motion is None or motion.rotation is None:
        return False
    direction = np.array(motion.rotation.axis) / np.linalg.norm(motion.rotation.axis)
    return abs(direction[axis]) < 1.0 - _STRAIGHT


def _bounds(faces: WallFaces) -> tuple[NDArray, NDArray]:
    """Corners (3,) [m] of the region that finite faces take up at time 0."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for kind, row in zip(faces.kind, faces.geometry, strict=True):
        assert kind != PLANE
        if kind == RECTANGLE:
            centres, extents = [row[0:3]], [np.abs(row[6:9]) + np.abs(row[9:12])]
        else:
            # A disc of radius r across the unit axis u reaches r sqrt(1 - u_k^2) along axis k.
            disc = np.sqrt(np.maximum(0.0, 1.0 - row[3:6] ** 2))
            centres = [row[0:3], row[0:3] + row[6] * row[3:6]]
            extents = [row[7] * disc, row[8] * disc]
        for centre, extent in zip(centres, extents, strict=True):
            low, high = np.minimum(low, centre - extent), np.maximum(high, centre + extent)
    return low, high
