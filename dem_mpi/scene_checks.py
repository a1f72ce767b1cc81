"""Rules that join sections of a scene, and doubts about scenes that are legal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dem_mpi.body_file import BodyFile
from dem_mpi.placement import grid
from dem_mpi.placement_checks import room_violations, start_region
from dem_mpi.scene_bodies import BodyGroup
from dem_mpi.scene_errors import nearest
from dem_mpi.scene_models import Scenario
from dem_mpi.scene_periodic import periodic_doubts, periodic_violations
from dem_mpi.scene_walls import wall_name
from dem_mpi.sizes import largest_reach, thinnest_half
from dem_mpi.wall_checks import Behind, behind, top_speed
from dem_mpi.wall_kinds import PLANE
from dem_mpi.walls import wall_faces
from dem_mpi.yaml_reader import KeyPath

# Steps are counted in float64 when times are computed from them.
MAX_STEPS = 2**53


class Finding(NamedTuple):
    """What is wrong with, or doubtful about, the value at `path`."""

    path: KeyPath
    rule: str


class Extent(NamedTuple):
    """Corners (3,) [m] of the region that the surfaces of a group's bodies may reach."""

    low: np.ndarray
    high: np.ndarray


def violations(scenario: Scenario) -> Iterator[Finding]:
    """The broken rules, in an order in which later ones may rely on earlier ones."""
    yield from _steps(scenario)
    yield from _names(scenario)
    yield from _archive(scenario)
    yield from itertools.starmap(Finding, periodic_violations(scenario))
    for index, group in enumerate(scenario.bodies):
        if group.placement.file is not None:
            yield from _file_form(index, group)
    yield from itertools.starmap(Finding, room_violations(scenario))
    for index, found in _behind_walls(scenario, _extents(scenario)):
        if found.certain:
            rule = f"its bodies would reach {found.depth:.3g} m behind wall '{found.face}'"
            yield Finding(_placement_path(scenario, index), rule)


def doubts(scenario: Scenario) -> Iterator[Finding]:
    """What is legal but physically doubtful; the scene must have no violations."""
    extents = _extents(scenario)
    yield from _speed_doubts(scenario, extents)
    yield from _place_doubts(scenario, extents)
    yield from itertools.starmap(Finding, periodic_doubts(scenario))
    frictions = [(("friction", "default"), scenario.friction.default)]
    for index, pair in enumerate(scenario.friction.pairs):
        frictions.append((("friction", "pairs", index, "mu"), pair.mu))
    for path, mu in frictions:
        if mu > 2:
            yield Finding(path, "a friction coefficient above 2 is unusual")
    if scenario.contact.recovery_speed is None:
        rule = "without a bound, deep overlaps are pushed out at overlap / step and fly apart"
        yield Finding(("contact", "recovery_speed"), rule)


def _steps(scenario: Scenario) -> Iterator[Finding]:
    step = scenario.time.step
    if scenario.time.end / step > MAX_STEPS:
        yield Finding(("time", "step"), f"makes more than 2^53 steps until {scenario.time.end:g} s")
    for path, interval in (
        (("time", "end"), scenario.time.end),
        (("output", "interval"), scenario.output.interval),
        (("checkpoint", "interval"), scenario.checkpoint.interval),
    ):
        if interval is None:
            continue
        ratio = interval / step
        if ratio > MAX_STEPS:
            yield Finding(path, "more than 2^53 steps")
        if abs(ratio - round(ratio)) > 1e-6 + 1e-12 * ratio or round(ratio) < 1:
            legal = [f"{n * step:.12g}" for n in (math.floor(ratio), math.floor(ratio) + 1) if n]
            rule = f"must be a whole number of steps of {step:g} s; nearest: {' or '.join(legal)}"
            yield Finding(path, rule)


def _archive(scenario: Scenario) -> Iterator[Finding]:
    """The archive is a file of its own."""
    if scenario.compress is not None and scenario.compress.path == scenario.output.path:
        yield Finding(("compress", "path"), "is the trajectory, output.path; name another file")


def _names(scenario: Scenario) -> Iterator[Finding]:
    """Materials that are named but not defined; pairs and walls given twice."""
    used: list[tuple[KeyPath, str]] = []
    for i, pair in enumerate(scenario.friction.pairs):
        used += [(("friction", "pairs", i, "between", j), pair.between[j]) for j in range(2)]
    used += [(("bodies", i, "material"), body.material) for i, body in enumerate(scenario.bodies)]
    used += [(("walls", i, "material"), wall.material) for i, wall in enumerate(scenario.walls)]
    for path, name in used:
        if name not in scenario.materials:
            yield Finding(path, "unknown material" + nearest(name, scenario.materials))
    pairs: dict[frozenset[str], int] = {}
    for i, pair in enumerate(scenario.friction.pairs):
        first = pairs.setdefault(frozenset(pair.between), i)
        if first < i:
            rule = f"this pair stands already in friction.pairs[{first}]"
            yield Finding(("friction", "pairs", i, "between"), rule)
    names: dict[str, int] = {}
    for i, wall in enumerate(scenario.walls):
        first = names.setdefault(wall_name(wall, i), i)
        if first < i:
            yield Finding(("walls", i, "name"), f"walls[{first}] has this name already")


def _file_form(index: int, group: BodyGroup) -> Iterator[Finding]:
    """Whether a file of bodies is there and states what the scene does not."""
    path = group.placement.path
    if not path.is_file():
        yield Finding(("bodies", index, "placement", "file"), f"no file {path}")
        return
    file = BodyFile(path, group.placement.dataset)
    if file.rows == 0:
        yield Finding(("bodies", index, "placement", "file"), "the file holds no bodies")
    if group.count is not None and group.count > file.rows:
        yield Finding(("bodies", index, "count"), f"{path} holds {file.rows} bodies only")
    if group.radius is None and "radius" not in file.quantities:
        yield Finding(("bodies", index), f"radius is required, because {path} states none")


def _extents(scenario: Scenario) -> dict[int, Extent]:
    """Where the bodies of each group start; without the groups read from files."""
    extents = {}
    for index, group in enumerate(scenario.bodies):
        region = group.placement.jittered_grid
        if region is not None and group.count is not None:
            radius = largest_reach(group)
            extents[index] = Extent(*grid(region, group.count, radius).bounds(group.count, radius))
        filled = start_region(group)
        if filled is not None:
            extents[index] = Extent(np.array(filled[1].min), np.array(filled[1].max))
    return extents


def _placement_path(scenario: Scenario, index: int) -> KeyPath:
    """The region that the bodies of a group start in."""
    filled = start_region(scenario.bodies[index])
    return ("bodies", index, "placement", filled[0] if filled else "jittered_grid")


def _corners(extent: Extent) -> np.ndarray:
    """The eight corners, (8, 3)."""
    return np.array(list(itertools.product(*zip(*extent, strict=True))))


def _behind_walls(scenario: Scenario, extents: dict[int, Extent]) -> Iterator[tuple[int, Behind]]:
    """The groups whose region reaches behind a wall."""
    faces = wall_faces(scenario)
    for index, extent in extents.items():
        for found in behind(faces, extent.low, extent.high):
            yield index, found


def _place_doubts(scenario: Scenario, extents: dict[int, Extent]) -> Iterator[Finding]:
    for index, found in _behind_walls(scenario, extents):
        if not found.certain:
            yield Finding(_placement_path(scenario, index), found.rule)
    domain = Extent(np.array(scenario.domain.min), np.array(scenario.domain.max))
    for index, extent in extents.items():
        if (extent.low > domain.high).any() or (extent.high < domain.low).any():
            yield Finding(("bodies", index, "placement"), "these bodies start outside the domain")
        for axis in scenario.domain.periodic:
            k = "xyz".index(axis)
            if extent.high[k] - extent.low[k] > (domain.high - domain.low)[k] * (1 + 1e-9):
                rule = f"is longer than the period along {axis}; bodies may overlap across the face"
                yield Finding(("bodies", index, "placement"), rule)
    yield from _shared_space(scenario, extents)


def _shared_space(scenario: Scenario, extents: dict[int, Extent]) -> Iterator[Finding]:
    """Grids that reach into one another. (Random places and inlets avoid other bodies.)"""
    groups = [g for g in extents if start_region(scenario.bodies[g]) is None]
    if len(groups) < 2:
        return
    low, high = (np.array([extents[g][side] for g in groups]) for side in range(2))
    for i in range(len(groups) - 1):
        overlap = np.minimum(high[i], high[i + 1 :]) - np.maximum(low[i], low[i + 1 :])
        for j in np.flatnonzero((overlap > 1e-9 * (high[i] - low[i])).all(axis=1)):
            rule = f"shares space with bodies[{groups[i]}]; bodies may overlap at the start"
            yield Finding(("bodies", groups[i + 1 + int(j)], "placement"), rule)
            return


def _speed_doubts(scenario: Scenario, extents: dict[int, Extent]) -> Iterator[Finding]:
    """Bodies or walls that cross a radius within one step, so that contacts come too late."""
    step = scenario.time.step
    radii = [_resolved_travel(group) for group in scenario.bodies if group.radius is not None]
    for index, group in enumerate(scenario.bodies):
        if group.radius is None:
            continue
        travel, radius = _resolved_travel(group), thinnest_half(group)
        speed = _speed_reached(scenario, group, extents.get(index))
        if travel == radius and speed * step > radius:
            rule = (
                f"bodies[{index}] may reach {speed:.3g} m/s and cross its radius of {radius:g} m "
                f"within a step; {radius / speed:.2g} s would resolve it"
            )
            yield Finding(("time", "step"), rule)
        elif travel < radius and speed * step > travel:
            rule = (
                f"bodies[{index}] may hit at {speed:.3g} m/s and turn so far in a step that they "
                f"overlap by half of their half width of {radius:g} m, where runs end; "
                f"{0.5 * travel / speed:.2g} s would resolve it"
            )
            yield Finding(("time", "step"), rule)
    faces = wall_faces(scenario)
    domain = Extent(np.array(scenario.domain.min), np.array(scenario.domain.max))
    for index, wall in enumerate(scenario.walls):
        if wall.motion is None or not radii:
            continue
        speed = top_speed(wall.motion, faces, domain.low, domain.high)
        if speed * step > min(radii):
            rule = f"moves up to {speed:.3g} m/s, more than a radius of {min(radii):g} m in a step"
            yield Finding(("walls", index, "motion"), rule)


def _resolved_travel(group: BodyGroup) -> float:
    """How far [m] a body of a group may move in a step before overlaps run away.

    A sphere's or a rod's radius. A flat or slender spheroid turns when it is hit, about a contact
    that is found once a step, and sinks in by R (angle)^2 / 2 with the radius of curvature
    R = l^2 / s of semi-axes s < l: the largest overlaps of 120 that hit a plane at v with random
    directions were 2.4 (1 - s/l)^4 (v h / s)^2 s, within an eighth, for s/l from 0.1 to 0.5. Runs
    end at overlaps of s / 2.
    """
    half = thinnest_half(group)
    ratio = (group.aspect_ratio or 1.0) if group.shape == "spheroid" else 1.0
    slender = 1.0 - min(ratio, 1.0 / ratio)
    return half / max(1.0, math.sqrt(2.4 / 0.5) * slender**2)


def _speed_reached(scenario: Scenario, group: BodyGroup, extent: Extent | None) -> float:
    """Upper estimate of a group's speed [m/s] after falling to the floor or to the end of time.

    Of a spheroid that turns at w, half the speed of its ends counts: an impact makes it turn as
    fast as twice its speed allows at the ends.
    """
    speed = math.hypot(*group.velocity) + math.sqrt(3) * group.velocity_jitter
    if group.shape == "spheroid":
        speed += 0.5 * math.hypot(*group.angular_velocity) * largest_reach(group)
    gravity = math.hypot(*scenario.gravity)
    if gravity == 0:
        return speed
    down = np.array(scenario.gravity) / gravity
    domain = Extent(np.array(scenario.domain.min), np.array(scenario.domain.max))
    start = _corners(extent if extent is not None else domain)
    heights = [float((_corners(domain) @ down).max() - (start @ down).min())]
    faces = wall_faces(scenario)
    planes = faces.kind == PLANE
    for point, normal in zip(faces.point[planes], faces.normal[planes], strict=True):
        if normal @ down < -0.1:
            heights.append(float(((start - point) @ normal).max() / -(normal @ down)))
    fall = max(0.0, min(heights))
    return min(math.sqrt(speed**2 + 2 * gravity * fall), speed + gravity * scenario.time.end)
