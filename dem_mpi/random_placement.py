"""Random sequential placement: bodies one after another at random places where nothing is yet.

The region is divided into cells in which only neighbours can touch. Every body visits a random
cell, tries a number of random places in it, and visits another one if it finds none. Cells of one
of 27 colours have no neighbours in common, so all cells of a colour work at once; within a cell the
visitors come in a fixed order. Random numbers are functions of (seed, body, visit) for the cell and
of (seed, cell, attempt) for the place. So the result depends neither on the number of ranks nor on
their timing.

Large bodies come first: all bodies of one class of size are placed before the next class begins.

Each rank works on a block of cells and knows the spheres in the layer of cells around it; no array
grows with the number of all bodies.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_placement as kernels
from dem_mpi.counter_random import Purpose, key_of, uniform
from dem_mpi.errors import InputError
from dem_mpi.scene_bodies import BodyGroup, RandomPlacement
from dem_mpi.sizes import largest_reach, mean_bounding_volume
from dem_mpi.sphere_cells import CellGrid, LinkedSpheres

if TYPE_CHECKING:  # a scene is checked without starting MPI
    from dem_mpi.parallel import Parallel

# The volume fraction that the attempts below reach reliably far from the faces of a region; random
# sequential addition itself ends at 0.384. A region loses this part of a diameter at two faces.
_LARGEST_FRACTION = 0.32
_LOST_AT_FACES = 0.25

# Attempts of a body in each cell that it visits. One at first: to try again in the same cell would
# crowd bodies together more than random sequential addition does. Then more, for the few bodies
# that are left, since the holes that are left are small.
_ATTEMPTS = tuple(min(2 ** max(0, (visit - 24) // 10), 1024) for visit in range(300))
# The few bodies of a small region may block each other: then all begin anew, unless so large a part
# of the bodies is left over after so many visits that there is no hope.
_RESTARTS = 12
_HOPELESS_PART, _HOPELESS_VISIT = 0.12, 130
_CLASSES_PER_OCTAVE = 2  # of size
_MOST_CELLS = 2.0**21  # along an axis, so that three coordinates fit one 64-bit counter
_COLOURS = tuple(itertools.product(range(3), repeat=3))

_VISITOR = np.dtype([("index", "<i8"), ("reach", "<f8"), ("cell", "<i8", 3)])
_SPHERE = np.dtype([("sphere", "<f8", 4), ("cell", "<i8", 3)])


@dataclass(frozen=True)
class Placed:
    """Bodies that found a place in this rank's block: index in their group, position (n, 3) [m]."""

    index: NDArray[np.int64]
    position: NDArray[np.float64]


def volume_fraction(group: BodyGroup) -> float:
    """The fraction of its region that a group's bounding spheres take.

    Spheres that keep a gap are spheres larger by half of it, in a region larger by as much.
    """
    region = group.placement.random
    assert region is not None
    volume = math.prod(b - a + region.gap for a, b in zip(region.min, region.max, strict=True))
    return (group.count or 0) * mean_bounding_volume(group, region.gap) / volume


def fraction_beside(group: BodyGroup, others: Sequence[BodyGroup]) -> float:
    """The fraction of a group's region that random `others`, placed before, take on average.

    Bodies much larger than the group's own do not count: between them there is room.
    """
    region = group.placement.random
    assert region is not None
    taken = 0.0
    for other in others:
        theirs = other.placement.random
        if theirs is None or largest_reach(other) > 2.0 * largest_reach(group):
            continue
        low, high = np.maximum(region.min, theirs.min), np.minimum(region.max, theirs.max)
        shared = float(np.prod(np.maximum(high - low, 0.0)))
        taken += volume_fraction(other) * shared
    return taken / float(np.prod(np.subtract(region.max, region.min)))


def largest_fraction(group: BodyGroup) -> float:
    """The volume fraction up to which a group's bodies reliably find places.

    In narrow regions it is less: near the faces bodies stand less densely than inside. Sizes that
    differ allow more than this, the large ones coming first.
    """
    region = group.placement.random
    assert region is not None
    diameter = 2.0 * largest_reach(group) + region.gap
    edges = [b - a + region.gap for a, b in zip(region.min, region.max, strict=True)]
    kept = math.prod(1.0 - _LOST_AT_FACES * min(1.0, diameter / edge) for edge in edges)
    return _LARGEST_FRACTION * kept


def place_at_random(
    parallel: Parallel,
    group: BodyGroup,
    seed: int,
    number: int,
    index: NDArray,
    reach: NDArray,
    obstacles: NDArray,
) -> Placed:
    """Collective. Places for the bodies of group `number`, on all ranks together.

    This rank brings the bodies `index` (n,) with bounding spheres of `reach` (n,) [m], and the
    spheres `obstacles` (k, 4) that stand already, x, y, z, reach; it may get other bodies back.
    Raises InputError on all ranks if a body finds no place.
    """
    region = group.placement.random
    assert region is not None
    near = obstacles[_reaches_into(region, obstacles)]
    largest = largest_reach(group)
    widest = largest + max(largest, parallel.max(float(near[:, 3].max(initial=0.0))))
    total = parallel.sum(len(index))
    grid = CellGrid.covering(region.min, region.max, widest + region.gap, most=2.0 * total)
    if grid.shape.max() > _MOST_CELLS:
        raise InputError(f"bodies[{number}]: the region is over {_MOST_CELLS:.0f} bodies long")
    bodies = (np.asarray(index, dtype=np.int64), np.asarray(reach, dtype=np.float64))
    for restart in range(_RESTARTS):
        work = _Work(parallel, grid, region, key_of(seed, number), restart)
        work.add_obstacles(near)
        left = work.place_all(*bodies, largest)
        if not left:
            placed = work.placed()
            if parallel.sum(len(placed.index)) != total:
                raise RuntimeError(f"bodies[{number}]: of {total} bodies some were lost")
            return placed
        if left > 5.0 + _HOPELESS_PART * total:
            break
    raise InputError(
        f"bodies[{number}].placement.random: {left} bodies found no place; enlarge the region, "
        f"lower the count, or use jittered_grid"
    )


def _reaches_into(region: RandomPlacement, spheres: NDArray) -> NDArray[np.bool_]:
    outside = np.maximum(region.min - spheres[:, :3], spheres[:, :3] - region.max)
    return outside.max(axis=1, initial=-np.inf) < spheres[:, 3] + region.gap


@dataclass(frozen=True)
class _Blocks:
    """The blocks of cells of all ranks: a box of ranks, cut along each axis.

    ranks : (3,) ranks along each axis, of which there may be fewer than there are in all
    """

    shape: NDArray[np.int64]
    ranks: tuple[int, int, int]

    @classmethod
    def of(cls, shape: NDArray, size: int) -> _Blocks:
        """Blocks with the fewest cells at most; the more cubic of equals."""
        n = [int(s) for s in shape]
        choices = [
            (a, b, c)
            for a in range(1, min(size, n[0]) + 1)
            for b in range(1, min(size // a, n[1]) + 1)
            for c in (min(size // (a * b), n[2]),)
        ]

        def cost(ranks: tuple[int, int, int]) -> tuple[int, int]:
            edges = [-(-cells // parts) for cells, parts in zip(n, ranks, strict=True)]
            return math.prod(edges), sum(edges)

        return cls(np.array(n), min(choices, key=cost))

    def bounds(self, rank: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First and one past the last cell (3,) of a rank; without cells for ranks left over."""
        a, b, c = self.ranks
        if rank >= a * b * c:
            return np.zeros(3, np.int64), np.zeros(3, np.int64)
        at = np.array([rank // (b * c), rank // c % b, rank % c])
        parts = np.array(self.ranks)
        return self.shape * at // parts, self.shape * (at + 1) // parts

    def rank_of(self, cell: NDArray) -> NDArray[np.int64]:
        """The ranks (n,) that own the cells at `cell` (n, 3)."""
        # Part p begins at floor(n p / parts): the inverse of that rounding.
        parts = np.array(self.ranks)
        at = (parts * (cell + 1) - 1) // self.shape
        return (at[:, 0] * parts[1] + at[:, 1]) * parts[2] + at[:, 2]


class _Work:
    """One rank's block, and what it exchanges with the ranks around it."""

    def __init__(
        self,
        parallel: Parallel,
        grid: CellGrid,
        region: RandomPlacement,
        key: NDArray,
        restart: int,
    ) -> None:
        self._parallel, self._grid, self._region, self._key = parallel, grid, region, key
        self._blocks = _Blocks.of(grid.shape, parallel.size)
        self._first, self._end = self._blocks.bounds(parallel.rank)
        self._linked = LinkedSpheres(self._first, self._end - self._first)
        self._restart = restart
        # Attempts are numbered on from start to start, far enough apart never to meet.
        self._used = np.full(len(self._linked.head), restart << 48, dtype=np.int64)
        self._found: list[tuple[NDArray, NDArray]] = []

    def placed(self) -> Placed:
        """All bodies that found a place here."""
        index, position = zip(*self._found, strict=True) if self._found else ((), ())
        return Placed(
            np.concatenate([np.zeros(0, np.int64), *index]),
            np.concatenate([np.zeros((0, 3)), *position]),
        )

    def add_obstacles(self, spheres: NDArray) -> None:
        """Collective. Put spheres (n, 4) into the blocks and layers that hold their cells."""
        rows = np.zeros(len(spheres), dtype=_SPHERE)
        rows["sphere"] = spheres
        rows["cell"] = self._grid.coordinate(spheres[:, :3])
        self._share(rows, with_owner=True)

    def place_all(self, index: NDArray, reach: NDArray, largest: float) -> int:
        """Collective. Place bodies, the large ones first; how many found no place on all ranks."""
        # A drawn radius may be rounded to a bit above the largest: it is still of the first class.
        octaves = np.maximum(0.0, np.log2(largest / reach))
        classes = np.floor(_CLASSES_PER_OCTAVE * octaves).astype(np.int64)
        for c in range(self._parallel.max(int(classes.max(initial=0))) + 1):
            mine = classes == c
            left = self._place_class(index[mine], reach[mine])
            if left:
                return left
        return 0

    def _place_class(self, index: NDArray, reach: NDArray) -> int:
        """Collective. Place bodies of one class of size; how many found no place on all ranks."""
        waiting_index, waiting_reach = index, reach
        total = self._parallel.sum(len(index))
        for visit, attempts in enumerate(_ATTEMPTS):
            left = self._parallel.sum(len(waiting_index))
            hopeless = visit >= _HOPELESS_VISIT and left > 5.0 + _HOPELESS_PART * total
            if not left or hopeless:
                return left
            visitors = self._send_out(waiting_index, waiting_reach, visit)
            waiting_index, waiting_reach = self._receive_visitors(visitors, attempts)
        return self._parallel.sum(len(waiting_index))

    def _send_out(self, index: NDArray, reach: NDArray, visit: int) -> NDArray:
        """Collective. Draw a cell for each body; return those that come to this rank's cells."""
        region = self._region
        number = self._restart * len(_ATTEMPTS) + visit
        draw = uniform(self._key, index, Purpose.VISIT, number)[:, :3]
        low, high = np.array(region.min) + reach[:, None], np.array(region.max) - reach[:, None]
        rows = np.zeros(len(index), dtype=_VISITOR)
        rows["index"], rows["reach"] = index, reach
        rows["cell"] = self._grid.coordinate(low + draw * np.maximum(high - low, 0.0))
        return self._deliver(rows, self._blocks.rank_of(rows["cell"]))

    def _receive_visitors(self, visitors: NDArray, attempts: int) -> tuple[NDArray, NDArray]:
        """Collective. Let the visitors try, colour by colour; return those without a place."""
        self._linked.reserve(len(visitors))
        reach = np.ascontiguousarray(visitors["reach"])
        cell = np.ascontiguousarray(visitors["cell"])
        # Within a cell the largest comes first.
        order = np.lexsort((visitors["index"], -reach))
        colour = (cell % 3) @ np.array([9, 3, 1])
        position = np.empty((len(visitors), 3))
        placed = np.zeros(len(visitors), dtype=bool)
        # Late visits are few: colours that nobody visits need no exchange.
        visited = np.bincount(colour, minlength=len(_COLOURS))
        for number in np.flatnonzero(self._parallel.max(visited)):
            turn = order[colour[order] == number]
            self._visit(position, reach, cell, turn, attempts, placed)
            new = turn[placed[turn]]
            rows = np.zeros(len(new), dtype=_SPHERE)
            rows["sphere"] = np.column_stack((position[new], reach[new]))
            rows["cell"] = cell[new]
            self._share(rows, with_owner=False)
        self._found.append((visitors["index"][placed], position[placed]))
        return visitors["index"][~placed], reach[~placed]

    def _visit(
        self,
        position: NDArray,
        reach: NDArray,
        cell: NDArray,
        turn: NDArray,
        attempts: int,
        placed: NDArray,
    ) -> None:
        linked, grid, region = self._linked, self._grid, self._region
        linked.reserve(len(turn))
        linked.count = kernels.visit_cells(
            position, reach, cell, turn, self._key, int(Purpose.ATTEMPT), region.gap, attempts,
            grid.low, grid.cell, np.array(region.min), np.array(region.max),
            linked.first, linked.strides, self._used,
            linked.head, linked.following, linked.spheres, linked.count, placed,
        )  # fmt: skip

    # ---- messages --------------------------------------------------------------------------

    def _share(self, rows: NDArray, with_owner: bool) -> None:
        """Collective. Tell the other ranks that know the cells of these spheres."""
        if self._parallel.size == 1 and not with_owner:
            return
        steps = np.array(_COLOURS) - 1
        around = np.clip(rows["cell"][:, None] + steps, 0, self._grid.shape - 1)
        owner = self._blocks.rank_of(around.reshape(-1, 3)).reshape(len(rows), len(steps))
        owner.sort(axis=1)
        fresh = np.ones(owner.shape, dtype=bool)
        fresh[:, 1:] = owner[:, 1:] != owner[:, :-1]
        if not with_owner:
            fresh &= owner != self._parallel.rank
        source, column = np.nonzero(fresh)
        arrived = self._deliver(rows[source], owner[source, column])
        self._linked.add(arrived["cell"], arrived["sphere"])

    def _deliver(self, rows: NDArray, rank: NDArray) -> NDArray:
        """Collective. Send each row to its rank (n,); return the rows that came here."""
        order = np.argsort(rank, kind="stable")
        ranks, starts = np.unique(rank[order], return_index=True)
        parts = np.split(rows[order], starts[1:])
        messages = {int(r): part.tobytes() for r, part in zip(ranks, parts, strict=False)}
        received = self._parallel.exchange(messages).values()
        return np.concatenate(
            [np.zeros(0, rows.dtype), *(np.frombuffer(m, rows.dtype) for m in received)]
        )
