"""Initial bodies: each rank makes its own share, and the result does not depend on the ranks.

Body gid's random numbers are words of the Philox counter generator with key (seed, group),
two counters (eight words) a body, so a rank starts at its first body without drawing the
others'. The raw words are used: their sequence is fixed for all versions of numpy, which
the sequence of its distributions is not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dem_mpi.body_file import BodyFile
from dem_mpi.errors import InputError
from dem_mpi.scene_bodies import BodyGroup, JitteredGrid, UniformRadius
from dem_mpi.scene_models import Scenario

# Eight random words a body: three for the position, one for the radius, three for the velocity.
WORDS_PER_BODY = 8
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


def largest_radius(group: BodyGroup) -> float:
    """The largest radius [m] that the scene states for a group."""
    return max(_stated_radii(group))


def smallest_radius(group: BodyGroup) -> float:
    """The smallest radius [m] that the scene states for a group."""
    return min(_stated_radii(group))


def _stated_radii(group: BodyGroup) -> tuple[float, ...]:
    if isinstance(group.radius, UniformRadius):
        return group.radius.uniform
    if isinstance(group.radius, tuple):
        return group.radius
    assert group.radius is not None, "a group without radii takes them from its file"
    return (group.radius,)


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


def place(scenario: Scenario, rank: int, size: int) -> dict[str, np.ndarray]:
    """The bodies that `rank` of `size` ranks starts with: a contiguous range of gids.

    Returns gid (n,) int64; position (n, 3) [m], velocity (n, 3) [m/s], angular_velocity (n, 3)
    [rad/s], orientation (n, 4) scalar first, radius (n,) [m], all float64; material (n,) int32.
    The bits do not depend on `size`. Raises DataError for a damaged file of bodies.
    """
    files = [_open_file(group) for group in scenario.bodies]
    counts = [
        group.count if group.count is not None else file.rows
        for group, file in zip(scenario.bodies, files, strict=True)
    ]
    first, last = share(sum(counts), rank, size)
    materials = list(scenario.materials)
    parts = []
    offset = 0
    for number, (group, file) in enumerate(zip(scenario.bodies, files, strict=True)):
        start, stop = (min(max(gid - offset, 0), counts[number]) for gid in (first, last))
        part = _place_group(group, file, counts[number], (scenario.seed, number), start, stop)
        part["gid"] = np.arange(offset + start, offset + stop, dtype=np.int64)
        part["material"] = np.full(stop - start, materials.index(group.material), dtype=np.int32)
        parts.append(part)
        offset += counts[number]
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _open_file(group: BodyGroup) -> BodyFile | None:
    if group.placement.file is None:
        return None
    return BodyFile(group.placement.path, group.placement.dataset)


def _place_group(
    group: BodyGroup,
    file: BodyFile | None,
    count: int,
    key: tuple[int, int],
    start: int,
    stop: int,
) -> dict[str, np.ndarray]:
    """Bodies start <= index < stop of one group; `key` is (seed, number of the group)."""
    n = stop - start
    stated = file.read(start, stop) if file is not None and n > 0 else {}
    random = _uniform(key, start, n) if _is_random(group) else np.full((n, WORDS_PER_BODY), 0.5)
    bodies = {
        "position": np.empty((n, 3)),
        "radius": _radii(group, start, stop, random[:, _RADIUS]),
        "velocity": np.tile(np.array(group.velocity), (n, 1)),
        "angular_velocity": np.tile(np.array(group.angular_velocity), (n, 1)),
        "orientation": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
    }
    if group.placement.jittered_grid is not None and n > 0:
        cells = grid(group.placement.jittered_grid, count, largest_radius(group))
        if cells.capacity < count:
            raise InputError(f"bodies[{key[1]}].count = {count}: only {cells.capacity} fit")
        shift = (2 * random[:, _POSITION] - 1) * np.array(cells.shift)
        bodies["position"] = cells.centres(start, stop) + shift
    bodies.update(stated)
    if group.velocity_jitter > 0:
        kick = (2 * random[:, _VELOCITY] - 1) * group.velocity_jitter
        bodies["velocity"] = bodies["velocity"] + kick
    return bodies


def _is_random(group: BodyGroup) -> bool:
    """Whether any property of the group is drawn at random."""
    cells = group.placement.jittered_grid
    jittered = cells is not None and cells.jitter > 0
    return jittered or group.velocity_jitter > 0 or isinstance(group.radius, UniformRadius)


def _radii(group: BodyGroup, start: int, stop: int, random: np.ndarray) -> np.ndarray:
    """Radii (n,) [m] as the scene states them; zeros where they come from the file."""
    if group.radius is None:
        return np.zeros(stop - start)
    if isinstance(group.radius, UniformRadius):
        low, high = group.radius.uniform
        return low + (high - low) * random
    values = np.array(_stated_radii(group))
    return values[np.arange(start, stop, dtype=np.int64) % len(values)]


def _uniform(key: tuple[int, int], start: int, n: int) -> np.ndarray:
    """Uniform numbers (n, 8) in [0, 1) of the bodies from `start` on."""
    generator = np.random.Philox(key=np.array(key, dtype=np.uint64))
    generator.advance(start * WORDS_PER_BODY // 4)
    words = generator.random_raw(n * WORDS_PER_BODY)
    return (words >> np.uint64(11)).reshape(n, WORDS_PER_BODY) * 2.0**-53
