"""Initial bodies: each rank makes its own share, and the result does not depend on the ranks.

Body i of a group has eight random numbers of its own, and more for other purposes, from a
generator that is a function of (seed, group, i): see `counter_random`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dem_mpi import sizes
from dem_mpi.body_file import BodyFile
from dem_mpi.counter_random import WORDS_PER_BLOCK, Purpose, key_of, uniform
from dem_mpi.errors import DemError, InputError
from dem_mpi.random_placement import place_at_random
from dem_mpi.scene_bodies import SHAPES, BodyGroup, JitteredGrid
from dem_mpi.scene_models import Scenario
from dem_mpi.shapes import bounding_radius
from dem_mpi.sizes import largest_reach

if TYPE_CHECKING:  # a scene is checked without starting MPI
    from dem_mpi.parallel import Parallel

# Eight random words a body: three for the position, one for the radius, three for the velocity.
WORDS_PER_BODY = 8
_BLOCKS = WORDS_PER_BODY // WORDS_PER_BLOCK
_POSITION, _RADIUS, _VELOCITY = slice(0, 3), 3, slice(4, 7)

# Room for the rounding of region / spacing; bodies may overlap by this part of a cell at most.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Grid:
    """Cells of a jittered grid, numbered x fastest and z slowest: layers fill from below.

    origin: lower corner of the first cell [m]; cell: edges [m]; shape: cells along x, y, z;
    shift: largest displacement of a body from its cell's centre [m].
    """

    origin: tuple[float, float, float]
    cell: tuple[float, float, float]
    shape: tuple[int, int, int]
    shift: tuple[float, float, float]

    @property
    def capacity(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)

    def centres(self, start: int, stop: int) -> np.ndarray:
        """Centres (n, 3) [m] of the cells start <= index < stop."""
        index = np.arange(start, stop, dtype=np.int64)
        nx, ny, _ = self.shape
        column = np.stack([index % nx, index // nx % ny, index // (nx * ny)], axis=1)
        return np.array(self.origin) + (column + 0.5) * np.array(self.cell)

    def bounds(self, count: int, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the region that the surfaces of `count` bodies may reach [m]."""
        nx, ny, _ = self.shape
        last = count - 1
        column = np.array([min(last, nx - 1), min(last // nx, ny - 1), last // (nx * ny)])
        cell, reach = np.array(self.cell), np.array(self.shift) + radius
        first = np.array(self.origin) + 0.5 * cell
        return first - reach, first + column * cell + reach


def grid_capacity(region: JitteredGrid, spacing: float) -> int:
    """Number of bodies of diameter <= spacing that a region holds; 0 if it is too thin."""
    if min(_extent(region)) * (1 + _ROUNDING) < spacing:
        return 0
    return math.prod(_cells(_extent(region), spacing))


def grid(region: JitteredGrid, count: int, radius: float) -> Grid:
    """The grid for `count` bodies of at most `radius` [m]; it may hold fewer if they do not fit.

    Without a given spacing it is the largest that gives `count` cells, stretched along each axis
    to fill the region. A given spacing is kept; the grid stands on the region's floor and is
    centred on it.
    """
    extent = _extent(region)
    if region.spacing is None:
        shape = _cells(extent, _largest_spacing(extent, count, 2 * radius))
        cell = tuple(length / n for length, n in zip(extent, shape, strict=True))
        origin = region.min
    else:
        shape = _cells(extent, region.spacing)
        cell = tuple(
            min(region.spacing, length / n) for length, n in zip(extent, shape, strict=True)
        )
        slack = [length - n * a for length, n, a in zip(extent, shape, cell, strict=True)]
        x, y, z = region.min
        origin = (x + slack[0] / 2, y + slack[1] / 2, z)
    shift = tuple(region.jitter * max(0.0, a / 2 - radius) for a in cell)
    return Grid(origin, cell, shape, shift)


def _extent(region: JitteredGrid) -> tuple[float, ...]:
    return tuple(high - low for low, high in zip(region.min, region.max, strict=True))


def _cells(extent: tuple[float, ...], spacing: float) -> tuple[int, ...]:
    """Cells along each axis: at least one, since the caller knows that a body fits."""
    return tuple(max(1, math.floor(length / spacing * (1 + _ROUNDING))) for length in extent)


def _largest_spacing(extent: tuple[float, ...], count: int, smallest: float) -> float:
    """The largest spacing >= smallest with at least `count` cells, else `smallest`."""
    low, high = smallest, max(smallest, *extent)
    if math.prod(_cells(extent, high)) >= count:
        return high
    # The number of cells falls with the spacing; 200 halvings reach the last bit.
    for _ in range(200):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        low, high = (middle, high) if math.prod(_cells(extent, middle)) >= count else (low, middle)
    return low


def share(total: int, rank: int, size: int) -> tuple[int, int]:
    """First and one past the last gid that a rank places."""
    return total * rank // size, total * (rank + 1) // size


def place(parallel: Parallel, scenario: Scenario) -> dict[str, np.ndarray]:
    """Collective. The bodies that this rank starts with, those of insertion groups left out.

    Returns gid (n,) int64; position (n, 3) [m], velocity (n, 3) [m/s], angular_velocity (n, 3)
    [rad/s], orientation (n, 4) scalar first, radius (n,), half_length (n,) [m], all float64;
    material (n,) int32; shape (n,) int8, an index into SHAPES. Each body's bits are the same on
    any number of ranks. Raises DataError for a damaged file of bodies, InputError where a random
    placement finds no room.
    """
    parts: list[dict[str, np.ndarray]] = []
    error = None
    try:
        parts.append(place_share(scenario, parallel.rank, parallel.size))
    except DemError as caught:
        error = caught
    parallel.raise_together(error)
    for number, group in enumerate(scenario.bodies):
        if group.placement.random is not None:
            parts.append(_place_at_random(parallel, scenario, number, parts))
    return _joined(parts)


def _place_at_random(
    parallel: Parallel,
    scenario: Scenario,
    number: int,
    standing: Sequence[Mapping[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """Collective. The bodies of a group that find a place among those `standing` on all ranks."""
    group = scenario.bodies[number]
    assert group.count is not None
    index = np.arange(*share(group.count, parallel.rank, parallel.size), dtype=np.int64)
    obstacles = [
        np.column_stack(
            (part["position"], bounding_radius(part["shape"], part["radius"], part["half_length"]))
        )
        for part in standing
    ]
    placed = place_at_random(
        parallel, group, scenario.seed, number, index,
        reaches(group, scenario.seed, number, index), np.concatenate(obstacles),
    )  # fmt: skip
    first_gid = first_gids(group_counts(scenario))[number]
    return bodies_of(scenario, number, first_gid, placed.index, placed.position)


def place_share(scenario: Scenario, rank: int, size: int) -> dict[str, np.ndarray]:
    """The bodies on grids and in files that `rank` of `size` ranks makes: a range of gids."""
    counts = group_counts(scenario)
    offsets = first_gids(counts)
    first, last = share(sum(counts), rank, size)
    parts = []
    for number, group in enumerate(scenario.bodies):
        start, stop = (min(max(gid - offsets[number], 0), counts[number]) for gid in (first, last))
        if not group.placement.stands_at_start:
            stop = start
        parts.append(_place_group(scenario, number, offsets[number], counts[number], start, stop))
    return _joined(parts)


def _joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The rows of all parts."""
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def group_counts(scenario: Scenario) -> list[int]:
    """Number of bodies of each group; reads the length of a file where the scene gives none."""
    return [
        group.count if group.count is not None else _open_file(group).rows
        for group in scenario.bodies
    ]


def first_gids(counts: Sequence[int]) -> list[int]:
    """The gid of each group's first body: groups are numbered through in the scene's order."""
    return [0, *itertools.accumulate(counts)][:-1]


def _open_file(group: BodyGroup) -> BodyFile:
    return BodyFile(group.placement.path, group.placement.dataset)


def _place_group(
    scenario: Scenario, number: int, first_gid: int, count: int, start: int, stop: int
) -> dict[str, np.ndarray]:
    """Bodies start <= index < stop of one group on a grid or in a file."""
    group, n = scenario.bodies[number], stop - start
    index = np.arange(start, stop, dtype=np.int64)
    stated: dict[str, np.ndarray] = {}
    position = np.zeros((n, 3))
    if group.placement.file is not None and n > 0:
        stated = _open_file(group).read(start, stop)
    if group.placement.jittered_grid is not None and n > 0:
        cells = grid(group.placement.jittered_grid, count, largest_reach(group))
        if cells.capacity < count:
            raise InputError(f"bodies[{number}].count = {count}: only {cells.capacity} fit")
        random = _words(scenario, number, index)[:, _POSITION]
        position = cells.centres(start, stop) + (2 * random - 1) * np.array(cells.shift)
    position = stated.pop("position", position)
    return bodies_of(scenario, number, first_gid, index, position, stated)


def bodies_of(
    scenario: Scenario,
    number: int,
    first_gid: int,
    index: np.ndarray,
    position: np.ndarray,
    stated: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """All arrays of the bodies `index` (n,) of group `number` at `position` (n, 3) [m].

    `first_gid` is that of the group's body 0. What `stated` holds replaces what the group says.
    The arrays are those of `place`.
    """
    group, n = scenario.bodies[number], len(index)
    random = _words(scenario, number, index)
    bodies = {
        "gid": first_gid + np.asarray(index, dtype=np.int64),
        "material": np.full(n, list(scenario.materials).index(group.material), dtype=np.int32),
        "shape": np.full(n, SHAPES.index(group.shape), dtype=np.int8),
        "position": position,
        "radius": sizes.radii(group, index, random[:, _RADIUS]),
        "velocity": np.tile(np.array(group.velocity), (n, 1)),
        "angular_velocity": np.tile(np.array(group.angular_velocity), (n, 1)),
        "orientation": _orientations(scenario, number, index),
    }
    bodies.update(stated or {})
    bodies["half_length"] = sizes.half_length_factor(group) * bodies["radius"]
    if group.velocity_jitter > 0:
        kick = (2 * random[:, _VELOCITY] - 1) * group.velocity_jitter
        bodies["velocity"] = bodies["velocity"] + kick
    return bodies


def reaches(group: BodyGroup, seed: int, number: int, index: np.ndarray) -> np.ndarray:
    """Radii (n,) [m] of the bounding spheres of the bodies `index` (n,) of group `number`."""
    random = np.zeros(len(index))
    if sizes.is_drawn(group):
        random = uniform(key_of(seed, number), index, blocks=_BLOCKS)[:, _RADIUS]
    return sizes.reach_factor(group) * sizes.radii(group, index, random)


def _words(scenario: Scenario, number: int, index: np.ndarray) -> np.ndarray:
    """The random numbers (n, 8) of bodies; not drawn, but 1/2, where the group needs none."""
    group = scenario.bodies[number]
    cells = group.placement.jittered_grid
    jittered = cells is not None and cells.jitter > 0
    if not (jittered or group.velocity_jitter > 0 or sizes.is_drawn(group)):
        return np.full((len(index), WORDS_PER_BODY), 0.5)
    return uniform(key_of(scenario.seed, number), index, blocks=_BLOCKS)


def _orientations(scenario: Scenario, number: int, index: np.ndarray) -> np.ndarray:
    """Unit quaternions (n, 4) that turn the body's z axis to the group's direction."""
    group, n = scenario.bodies[number], len(index)
    if group.axis != "random":
        axis = np.array(group.axis)
        return np.tile(_turn_z_to(axis[None] / np.linalg.norm(axis)), (n, 1))
    # Uniform on the sphere: height and azimuth are (Archimedes).
    random = uniform(key_of(scenario.seed, number), index, Purpose.AXIS)
    height, azimuth = 2.0 * random[:, 0] - 1.0, 2.0 * np.pi * random[:, 1]
    width = np.sqrt(1.0 - height**2)
    return _turn_z_to(np.stack([width * np.cos(azimuth), width * np.sin(azimuth), height], axis=1))


def _turn_z_to(axis: np.ndarray) -> np.ndarray:
    """The shortest rotations (n, 4) from e_z to unit vectors (n, 3)."""
    x, y, z = axis.T
    # q ~ (1 + cos, e_z x axis); 1 + cos = sin^2 / (1 - cos) keeps its digits near -e_z.
    sine_squared = x**2 + y**2
    one_plus = np.where(z < 0.0, sine_squared / (1.0 + np.abs(z)), 1.0 + z)
    quaternion = np.stack([one_plus, -y, x, np.zeros_like(x)], axis=1)
    quaternion[(sine_squared == 0.0) & (z < 0.0)] = (0.0, 1.0, 0.0, 0.0)
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
