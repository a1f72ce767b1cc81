"""Bodies that come in while the run goes on, at random free places of their group's region.

Body i of a group is due at start + i / rate. Its candidates in a step are random numbers of
(seed, group, i, step, attempt), the same on all ranks. Each rank marks those that overlap its own
bodies, one reduction joins the marks, every rank adds those that reach into a wall where it stands
just then, and picks the same places. A body that finds none waits for the next step, and those
behind it in its group with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_placement as kernels
from dem_mpi.bodies import Bodies
from dem_mpi.counter_random import Purpose, key_of, uniform
from dem_mpi.parallel import Parallel
from dem_mpi.periodic import PeriodicBox
from dem_mpi.placement import bodies_of, first_gids, group_counts, reaches
from dem_mpi.scenario import Scenario
from dem_mpi.scene_bodies import BodyGroup, Insertion
from dem_mpi.sizes import smallest_radius, thinnest_half
from dem_mpi.sphere_cells import CellGrid, LinkedSpheres
from dem_mpi.state import State
from dem_mpi.walls import Walls

_ATTEMPTS = 32  # candidates of a body in a step
_DENSEST = 0.75  # volume fraction that no packing reaches: more bodies need not be tried at once


@dataclass(frozen=True)
class Arrivals:
    """What came in before a step, and what did not.

    bodies : those that this rank owns; inserted : (groups,) per group so far, on all ranks
    waiting : bodies that are due and found no place; spinning : whether any of them rotates
    """

    bodies: Bodies
    inserted: NDArray[np.int64]
    waiting: int
    spinning: bool


@dataclass(frozen=True)
class _Queue:
    """The bodies of one group that are to be tried: number of the group, index (b,), reach (b,)."""

    number: int
    index: NDArray[np.int64]
    reach: NDArray[np.float64]


def is_inlet(group: BodyGroup) -> bool:
    """Whether the bodies of a group come in during the run."""
    return group.placement.insertion is not None


def total_to_come(scenario: Scenario) -> int:
    """Number of bodies that the scene inserts in all."""
    return sum(group.count or 0 for group in scenario.bodies if is_inlet(group))


def thinnest_to_come(scenario: Scenario) -> float:
    """The smallest half width [m] of any body that the scene inserts; infinity if there is none."""
    halves = [thinnest_half(group) for group in scenario.bodies if is_inlet(group)]
    return min(halves, default=math.inf)


def due(group: BodyGroup, time: float) -> int:
    """How many bodies of an inserted group should be in at `time` [s]."""
    inlet = group.placement.insertion
    assert inlet is not None
    assert group.count is not None
    elapsed = time - inlet.start
    # The time of a step is a product: a body due at that very time must not miss it by rounding.
    number = inlet.rate * elapsed * (1.0 + 1e-12) + 1e-9
    return 0 if number < 0.0 else min(group.count, math.floor(number) + 1)


def reserved_gids(scenario: Scenario) -> list[int]:
    """The gid of each group's first body, looked up once: files may change while a run goes on.

    Empty where nothing is inserted.
    """
    if not any(is_inlet(group) for group in scenario.bodies):
        return []
    return first_gids(group_counts(scenario))


def changed_count(scenario: Scenario, stored: Sequence[int]) -> str:
    """Say which group no longer has the count by which gids were reserved, '' for none.

    stored : the counts of the scene that a run began with. Groups added behind them do no harm.
    """
    if not any(is_inlet(group) for group in scenario.bodies):
        return ""
    counts = group_counts(scenario)
    for number, before in enumerate(stored):
        if number >= len(counts):
            return f"bodies[{number}], of {before} bodies, is gone"
        if counts[number] != before:
            placement = scenario.bodies[number].placement
            file = f" of {placement.path}" if placement.file is not None else ""
            return f"bodies[{number}] has {counts[number]} bodies{file}, and had {before}"
    return ""


def arrive(
    parallel: Parallel,
    scenario: Scenario,
    reserved: list[int],
    state: State,
    walls: Walls,
    time: float,
) -> Arrivals:
    """Collective. Find places for the bodies that are due at `time` [s]; `state` stays as it is.

    Without anybody due nothing is sent. `reserved` comes from `reserved_gids`; `walls` are those
    of that time.
    """
    inserted = _counters(state.inserted, len(scenario.bodies))
    pending = [
        due(group, time) - int(inserted[number]) if is_inlet(group) else 0
        for number, group in enumerate(scenario.bodies)
    ]
    queues = [_queue(scenario, n, int(inserted[n]), p) for n, p in enumerate(pending) if p > 0]
    if not queues:
        return Arrivals(Bodies.empty(), inserted, 0, False)
    place = _find_places(parallel, scenario, state, walls, queues)
    parts = []
    for queue, position in zip(queues, place, strict=True):
        found = len(position)
        inserted[queue.number] += found
        first_gid = reserved[queue.number]
        arrays = bodies_of(scenario, queue.number, first_gid, queue.index[:found], position)
        mine = state.partition.owner(position, arrays["gid"]) == parallel.rank
        parts.append({name: array[mine] for name, array in arrays.items()})
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    density = [material.density for material in scenario.materials.values()]
    arrived = sum(len(position) for position in place)
    return Arrivals(
        bodies=Bodies.from_arrays(joined, density),
        inserted=inserted,
        waiting=sum(pending) - arrived,
        spinning=any(any(scenario.bodies[queue.number].angular_velocity) for queue in queues),
    )


def _counters(inserted: NDArray, groups: int) -> NDArray[np.int64]:
    """A copy with one entry a group, also where a changed scene has more or fewer."""
    counters = np.zeros(groups, dtype=np.int64)
    known = min(groups, len(inserted))
    counters[:known] = inserted[:known]
    return counters


def _region(scenario: Scenario, queue: _Queue) -> Insertion:
    region = scenario.bodies[queue.number].placement.insertion
    assert region is not None
    return region


def _queue(scenario: Scenario, number: int, first: int, pending: int) -> _Queue:
    """The next bodies of a group, but not more than its region could ever hold."""
    group = scenario.bodies[number]
    region = group.placement.insertion
    assert region is not None
    volume = math.prod(b - a for a, b in zip(region.min, region.max, strict=True))
    smallest = 4.0 / 3.0 * math.pi * smallest_radius(group) ** 3
    fit = min(float(pending), _DENSEST * volume / smallest)
    index = np.arange(first, first + max(1, int(fit)), dtype=np.int64)
    return _Queue(number, index, reaches(group, scenario.seed, number, index))


def _find_places(
    parallel: Parallel, scenario: Scenario, state: State, walls: Walls, queues: list[_Queue]
) -> list[NDArray]:
    """Collective. Positions (k, 3) [m] of the first k bodies of each queue that found a place."""
    candidate = np.concatenate([_candidates(scenario, queue, state.step) for queue in queues])
    reach = np.concatenate([queue.reach for queue in queues])
    regions = [_region(scenario, queue) for queue in queues]
    low = np.min([region.min for region in regions], axis=0)
    high = np.max([region.max for region in regions], axis=0)

    present = _spheres_near(scenario, state.bodies, low, high)
    largest = float(reach.max())
    edge = largest + max(largest, float(present[:, 3].max(initial=0.0)))
    grid = CellGrid.covering(low, high, edge, most=8.0 * (len(present) + len(reach)))
    coordinate = grid.coordinate(candidate)
    near = LinkedSpheres.of(grid, present)
    blocked = np.zeros(candidate.shape[:2], dtype=np.uint8)
    lists = (near.strides, near.head, near.following, near.spheres)
    kernels.find_blocked(candidate, reach, near.cell(coordinate), *lists, blocked)
    parallel.max_in_place(blocked)
    kernels.block_at_walls(candidate, reach, walls.rows(), blocked)

    # The lists of accepted bodies must be the same on all ranks; answers do not depend on cells.
    grid = CellGrid.covering(low, high, 2.0 * largest, most=8.0 * len(reach))
    accepted = LinkedSpheres(np.zeros(3), grid.shape, len(reach))
    lists = (accepted.strides, accepted.head, accepted.following, accepted.spheres)
    queue_of = np.repeat(np.arange(len(queues)), [len(queue.index) for queue in queues])
    chosen = np.empty(len(reach), dtype=np.int64)
    cell = accepted.cell(grid.coordinate(candidate))
    kernels.accept_in_order(candidate, reach, queue_of, blocked, cell, *lists, chosen)
    return [
        candidate[rows, chosen[rows]]
        for rows in (np.flatnonzero((queue_of == q) & (chosen >= 0)) for q in range(len(queues)))
    ]


def _candidates(scenario: Scenario, queue: _Queue, step: int) -> NDArray[np.float64]:
    """Random places (b, attempts, 3) [m] of the bodies of a queue, wholly inside its region."""
    region, key = _region(scenario, queue), key_of(scenario.seed, queue.number)
    numbers = np.empty((len(queue.index), _ATTEMPTS, 3))
    for attempt in range(_ATTEMPTS):
        draw = uniform(key, queue.index, Purpose.INLET, step * _ATTEMPTS + attempt)
        numbers[:, attempt] = draw[:, :3]
    reach = queue.reach[:, None, None]
    low, high = np.array(region.min) + reach, np.array(region.max) - reach
    return low + numbers * np.maximum(high - low, 0.0)


def _spheres_near(
    scenario: Scenario, bodies: Bodies, low: NDArray, high: NDArray
) -> NDArray[np.float64]:
    """Bounding spheres (n, 4) of this rank's bodies, and their images, that reach into a box."""
    position, reach = bodies.position, bodies.bounding_radius
    box = PeriodicBox.of(scenario.domain)
    if box is not None:
        position = box.wrap(position)
        row, code = box.images(position, reach)
        position = np.concatenate((position, position[row] + box.shift(code)))
        reach = np.concatenate((reach, reach[row]))
    distance = np.maximum(low - position, position - high).max(axis=1, initial=-np.inf)
    near = distance < reach
    return np.column_stack((position[near], reach[near]))
