"""Suspensions that Stokes solvers are measured on, and flows around them that are known exactly.

Lengths are in units of the largest semi-axis of a spheroid, or of the radius of a sphere; the
viscosity is 1. All is seeded: the same scene on every machine and rank.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stokes.exact import stokeslet_velocity
from stokes.geometry import Body, close_pairs, gaps, gaps_of_pairs, spheroid

SEED = 20210301
FLATTEST = 0.35  # least ratio of semi-axes of a random spheroid
ROUNDEST = 0.8
_TRIES = 400  # places that are tried for a body before the box grows


@dataclass(frozen=True)
class Scene:
    """Spheroids at rest in a box.

    semi_axes   : (n, 2) equatorial, polar
    centres     : (n, 3)
    quaternions : (n, 4) scalar first
    box         : edge of the cube [0, box]^3 that they lie in, 0 where there is none
    gap         : the least distance between two surfaces
    """

    semi_axes: NDArray
    centres: NDArray
    quaternions: NDArray
    box: float
    gap: float

    @property
    def count(self) -> int:
        """Number of bodies."""
        return len(self.centres)

    @property
    def volume_fraction(self) -> float | None:
        """Volume of the bodies over that of the box, None without one."""
        volumes = 4.0 / 3.0 * math.pi * self.semi_axes[:, 0] ** 2 * self.semi_axes[:, 1]
        return float(volumes.sum() / self.box**3) if self.box else None

    def bodies(self) -> list[Body]:
        """The bodies as the package takes them."""
        return _bodies_of(self.semi_axes, self.centres, self.quaternions)

    @property
    def rotations(self) -> NDArray:
        """Rotation matrices (n, 3, 3); the third column is the axis."""
        return _matrices(self.quaternions)

    def inside(self, points: NDArray, margin: float) -> NDArray:
        """Whether points (k, 3) are in a body whose semi-axes are longer by the margin."""
        found = np.zeros(len(points), dtype=bool)
        for (equatorial, polar), centre, R in zip(
            self.semi_axes, self.centres, self.rotations, strict=True
        ):
            semi_axes = np.array([equatorial, equatorial, polar]) + margin
            near = np.abs(points - centre).max(axis=1) < semi_axes.max()
            local = (points[near] - centre) @ R / semi_axes
            found[near] |= (local**2).sum(axis=1) < 1.0
        return found


# ---- placements ----------------------------------------------------------------------------


def random_spheroids(
    count: int, directory: Path, gap: float = 0.1, fraction: float = 0.1, shapes: int = 0
) -> Scene:
    """Prolate and oblate spheroids in turn, of random aspect, axis and place, kept in a file.

    gap      : least distance of two surfaces
    fraction : of the box's volume that they fill, about: the box grows where there is no room
    shapes   : number of different shapes, 0 if all of them differ
    """
    path = directory / f"spheroids-{count}-{gap:g}-{fraction:g}-{shapes}.json"
    if not path.exists():
        scene = _place(count, gap, fraction, shapes)
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(f".{os.getpid()}")
        unfinished.write_text(json.dumps(asdict(scene), default=np.ndarray.tolist))
        unfinished.rename(path)
    stored = json.loads(path.read_text())
    return Scene(**{k: np.array(v) if isinstance(v, list) else v for k, v in stored.items()})


def _place(count: int, gap: float, fraction: float, shapes: int) -> Scene:
    """Random sequential addition."""
    rng = np.random.default_rng([SEED, count])
    different = shapes or count
    short = rng.uniform(FLATTEST, ROUNDEST, different)
    prolate = np.arange(different) % 2 == 0
    axes = np.where(prolate[:, None], np.stack([short, np.ones(different)], axis=1),
                    np.stack([np.ones(different), short], axis=1))  # fmt: skip
    axes = axes[np.arange(count) % different]
    volumes = 4.0 / 3.0 * math.pi * axes[:, 0] ** 2 * axes[:, 1]
    box = max((float(volumes.sum()) / fraction) ** (1.0 / 3.0), 2.5)
    while True:
        placed = _add_all(axes, box, gap, rng)
        if placed is not None:
            return Scene(axes, placed[0], placed[1], box, least_gap(axes, *placed))
        box *= 1.05


def _add_all(
    axes: NDArray, box: float, gap: float, rng: np.random.Generator
) -> tuple[NDArray, NDArray] | None:
    """Centres and quaternions, or None if a body found no place."""
    centres, quaternions = np.empty((len(axes), 3)), np.empty((len(axes), 4))
    reach = axes.max(axis=1)
    for k in range(len(axes)):
        for _ in range(_TRIES):
            centres[k] = rng.uniform(1.0, box - 1.0, 3)
            quaternions[k] = _quaternion(rng)
            distance = np.linalg.norm(centres[:k] - centres[k], axis=1)
            near = np.flatnonzero(distance < reach[:k] + reach[k] + gap)
            chosen = np.append(near, k)
            if not len(near) or _gaps_to_last(axes, centres, quaternions, chosen).min() >= gap:
                break
        else:
            return None
    return centres, quaternions


def _gaps_to_last(
    axes: NDArray, centres: NDArray, quaternions: NDArray, chosen: NDArray
) -> NDArray:
    """Distances of the last of the chosen bodies from the others."""
    bodies = _bodies_of(axes[chosen], centres[chosen], quaternions[chosen])
    return gaps([bodies[-1]] * (len(bodies) - 1), bodies[:-1]).distance


def least_gap(axes: NDArray, centres: NDArray, quaternions: NDArray) -> float:
    """The least distance between surfaces."""
    bodies, reach = _bodies_of(axes, centres, quaternions), 0.2
    while True:
        pairs = close_pairs(bodies, reach)
        found = gaps_of_pairs(bodies, pairs).distance if len(pairs) else np.empty(0)
        if found.min(initial=math.inf) <= reach:
            return float(found.min())
        reach *= 2.0


def _bodies_of(axes: NDArray, centres: NDArray, quaternions: NDArray) -> list[Body]:
    return [
        Body(spheroid(*shape), 1.0, tuple(centre), tuple(quaternion))
        for shape, centre, quaternion in zip(
            axes.tolist(), centres.tolist(), quaternions.tolist(), strict=True
        )
    ]


def grid_of_spheroids(edge: int, spacing: float) -> Scene:
    """Randomly shaped and turned spheroids at the points of a cubic grid."""
    rng = np.random.default_rng([SEED, edge])
    count = edge**3
    short = rng.uniform(FLATTEST, ROUNDEST, count)
    prolate = rng.random(count) < 0.5
    axes = np.where(prolate[:, None], np.stack([short, np.ones(count)], axis=1),
                    np.stack([np.ones(count), short], axis=1))  # fmt: skip
    centres = spacing * (0.5 + np.stack(np.indices((edge,) * 3), axis=-1).reshape(-1, 3))
    quaternions = np.array([_quaternion(rng) for _ in range(count)])
    least = least_gap(axes, centres, quaternions)
    return Scene(axes, centres, quaternions, edge * spacing, least)


def pair(semi_axes: tuple[float, float], gap: float, placed: str) -> Scene:
    """Two equal bodies at a gap: `coaxial`, or `side` by side, axes parallel."""
    equatorial, polar = semi_axes
    step = np.array([0.0, 0.0, 2.0 * polar + gap])
    if placed == "side":
        step = np.array([2.0 * equatorial + gap, 0.0, 0.0])
    return _bodies_at(np.stack([-0.5 * step, 0.5 * step]), semi_axes, gap)


def cluster(gap: float) -> Scene:
    """A unit sphere and its twelve neighbours in a close packing, opened to that gap."""
    signs = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]], dtype=float)
    around = np.concatenate([np.roll(signs, k, axis=1) for k in range(3)]) / math.sqrt(2.0)
    centres = (2.0 + gap) * np.concatenate([np.zeros((1, 3)), around])
    return _bodies_at(centres, (1.0, 1.0), gap)


def chain(count: int, gap: float) -> Scene:
    """Unit spheres in a row."""
    centres = np.zeros((count, 3))
    centres[:, 2] = (2.0 + gap) * np.arange(count)
    return _bodies_at(centres, (1.0, 1.0), gap)


def _bodies_at(centres: NDArray, semi_axes: tuple[float, float], gap: float) -> Scene:
    count = len(centres)
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return Scene(np.tile(semi_axes, (count, 1)), centres, quaternions, 0.0, gap)


def single(seed: int = 0) -> Scene:
    """The spheroid r^2/0.5^2 + z^2 = 1 of S. De's section 3.6.1, turned at random."""
    scene = _bodies_at(np.zeros((1, 3)), (0.5, 1.0), math.inf)
    return replace(scene, quaternions=_quaternion(np.random.default_rng([SEED, seed]))[None])


def _quaternion(rng: np.random.Generator) -> NDArray:
    q = rng.standard_normal(4)
    return q / np.linalg.norm(q)


def _matrices(quaternions: NDArray) -> NDArray:
    return Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()


# ---- exact flows and points ----------------------------------------------------------------


@dataclass(frozen=True)
class PointForces:
    """A flow of point forces (k, 3) at places (k, 3) inside the bodies: the exact solution."""

    places: NDArray
    forces: NDArray

    def velocity(self, points: NDArray) -> NDArray:
        """u (n, 3) at points (n, 3)."""
        chunks = np.array_split(points, 1 + len(points) * len(self.places) // 10**6)
        found = [stokeslet_velocity(x, self.places, self.forces) for x in chunks]
        return np.concatenate(found)


def forces_at_centres(scene: Scene) -> PointForces:
    """A unit force of random direction at the centre of each body."""
    forces = np.random.default_rng([SEED, 1]).standard_normal((scene.count, 3))
    return PointForces(scene.centres, forces / np.linalg.norm(forces, axis=1)[:, None])


def forces_inside_single(scene: Scene) -> PointForces:
    """Five unit forces at random on r^2/0.3^2 + z^2/0.8^2 = 1 inside the single spheroid."""
    rng = np.random.default_rng([SEED, 2])
    forces = rng.standard_normal((5, 3))
    places = _directions(rng, 5) * np.array([0.3, 0.3, 0.8])
    return PointForces(
        places @ scene.rotations[0].T, forces / np.linalg.norm(forces, axis=1)[:, None]
    )


def points_around_single(scene: Scene, rings: int = 20) -> NDArray:
    """A regular grid on r^2/0.7^2 + z^2/1.2^2 = 1."""
    theta = math.pi * (np.arange(rings) + 0.5) / rings
    phi = 2.0 * math.pi * np.arange(2 * rings) / (2 * rings)
    r, z = 0.7 * np.sin(theta)[:, None], 1.2 * np.cos(theta)[:, None]
    grid = np.broadcast_arrays(r * np.cos(phi), r * np.sin(phi), z)
    return np.stack(grid, axis=-1).reshape(-1, 3) @ scene.rotations[0].T


def points_in_box(scene: Scene, count: int, margin: float = 0.1) -> NDArray:
    """Points (count, 3) in the box, at least a margin from all bodies."""
    rng = np.random.default_rng([SEED, 3])
    found = np.empty((0, 3))
    while len(found) < count:
        tried = rng.uniform(0.0, scene.box, (2 * count, 3))
        found = np.concatenate([found, tried[~scene.inside(tried, margin)]])
    return found[:count]


def points_at_surfaces(scene: Scene, count: int, distances: Sequence[float]) -> NDArray:
    """Points along normals of random bodies, at each of the distances in turn, outside all."""
    rng = np.random.default_rng([SEED, 4])
    body = rng.integers(scene.count, size=2 * count)
    axes = scene.semi_axes[body][:, [0, 0, 1]]
    unit = _directions(rng, 2 * count)
    normals = unit / axes
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    offset = np.resize(np.asarray(distances, dtype=float), 2 * count)
    local = unit * axes + offset[:, None] * normals
    points = scene.centres[body] + np.einsum("nij,nj->ni", scene.rotations[body], local)
    return points[~scene.inside(points, 0.9 * min(distances))][:count]


def _directions(rng: np.random.Generator, count: int) -> NDArray:
    directions = rng.standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1)[:, None]
