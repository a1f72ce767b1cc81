"""Who owns which body: splitters along the Morton curve, migration, ghost targets.

Bodies are ordered by (Morton key, gid). P - 1 splitters cut that order into one interval a
rank; gid in the splitter lets bodies with equal keys be divided. No array here grows with the
total number of bodies; splitters (P - 1) are the only ones that grow with the ranks.

Symbols: n owned bodies, P ranks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_partition as kernels
from dem_mpi import morton
from dem_mpi.bodies import Bodies, ImpulseMemory, pack_rows, unpack_rows
from dem_mpi.parallel import Parallel
from dem_mpi.periodic import PeriodicBox


@dataclass(frozen=True)
class Partition:
    """The intervals of (Morton key, gid) that ranks own; the same object on every rank.

    Rank r owns the pairs from splitter r - 1 up to, not including, splitter r.

    origin, edge                : lower corner (3,) and edge of the cube of the keys [m]
    splitter_key, splitter_gid  : (P - 1,) int64, ascending pairs
    """

    origin: NDArray[np.float64]
    edge: float
    splitter_key: NDArray[np.int64]
    splitter_gid: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Keep read-only copies in the right types."""
        for name, dtype in _PARTITION_ARRAYS.items():
            array = np.array(getattr(self, name), dtype=dtype)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        object.__setattr__(self, "edge", float(self.edge))

    @property
    def ranks(self) -> int:
        """The number of ranks it divides the bodies among."""
        return len(self.splitter_key) + 1

    def key(self, position: NDArray) -> NDArray[np.int64]:
        """Morton keys (n,) of `position` (n, 3) [m]; outside the cube, of the nearest cell."""
        return morton.encode(position, self.origin, self.edge)

    def owner(self, position: NDArray, gid: NDArray) -> NDArray[np.int32]:
        """The rank (n,) that owns each body of `position` (n, 3) [m] and `gid` (n,)."""
        gids = np.ascontiguousarray(gid, dtype=np.int64)
        return kernels.owners(self.splitter_key, self.splitter_gid, self.key(position), gids)

    def order(self, position: NDArray, gid: NDArray) -> NDArray[np.intp]:
        """The permutation (n,) that brings bodies into the order of (Morton key, gid)."""
        return np.lexsort((gid, self.key(position)))


_PARTITION_ARRAYS = {"origin": np.float64, "splitter_key": np.int64, "splitter_gid": np.int64}


def bounding_cube(
    parallel: Parallel, position: NDArray, pad: float = 0.0
) -> tuple[NDArray[np.float64], float]:
    """Collective. Lower corner (3,) and edge [m] of a cube around all ranks' `position` (n, 3).

    Every side is at least `pad` [m] away from the points. The edge is positive even around one
    point or none. ValueError on all ranks if a position is not finite.
    """
    signed = np.concatenate((-position, position), axis=1)
    extremes = np.max(signed, axis=0, initial=-np.inf)
    extremes[np.isnan(extremes)] = np.inf  # MPI leaves the maximum with a NaN open
    extremes = parallel.max(extremes)
    if np.any(extremes == np.inf):
        raise ValueError("positions must be finite")
    if np.any(extremes == -np.inf):
        return np.zeros(3), 1.0
    low, high = -extremes[:3] - pad, extremes[3:] + pad
    # Lattice cells must stay wider than the spacing of floats around the points.
    finest = np.spacing(np.max(np.abs(extremes))) + np.finfo(np.float64).tiny
    return low, float(max(np.max(high - low), finest * morton.LATTICE_SIZE))


def balance(parallel: Parallel, bodies: Bodies, weights: NDArray, *, pad: float = 0.0) -> Partition:
    """Collective. The partition that gives every rank the same weight, to within one body.

    `weights` (n,) integers > 0, the work of each body: integers, so that their sums are exact
    and the result is the same however the bodies are spread over the ranks. Splitter s follows
    the body in which the running weight, in the order of (key, gid), reaches s/P of the total.
    The cube is `bounding_cube` with `pad` [m]. ValueError where a weight is not positive.
    """
    work = np.asarray(weights)
    if work.shape != (len(bodies),) or work.dtype.kind not in "iu" or np.any(work <= 0):
        raise ValueError("weights must be one positive integer a body")
    origin, edge = bounding_cube(parallel, bodies.position, pad)
    key = morton.encode(bodies.position, origin, edge)
    order = np.lexsort((bodies.gid, key))
    weight_before = np.concatenate(([0], np.cumsum(work[order], dtype=np.int64)))
    total = parallel.sum(int(weight_before[-1]))
    if total == 0:
        return Partition(origin, edge, *_even_splitters(parallel.size))
    # Python integers: total * s may exceed 64 bits.
    target = [-(-total * s // parallel.size) for s in range(1, parallel.size)]
    splitter_key, splitter_gid = _quantiles(
        parallel, key[order], bodies.gid[order], weight_before, np.array(target, dtype=np.int64)
    )
    return Partition(origin, edge, splitter_key, splitter_gid + 1)


def _even_splitters(ranks: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Splitters of equal shares of the cube, for when there are no bodies to go by."""
    key = [(morton.MAX_KEY + 1) * s // ranks for s in range(1, ranks)]
    return np.array(key, dtype=np.int64), np.zeros(ranks - 1, dtype=np.int64)


def _quantiles(
    parallel: Parallel,
    key: NDArray[np.int64],
    gid: NDArray[np.int64],
    weight_before: NDArray[np.int64],
    target: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Collective. The greatest (key, gid) with less than `target` (q,) > 0 weight below it.

    That pair is a body: the one whose weight spans the target. `key`, `gid` (n,) ascend,
    `weight_before` (n + 1,) sums their weights. The digits of all quantiles are found together,
    octal, most significant first, by one reduction of 7 q sums each.
    """
    found_key, found_gid = np.zeros_like(target), np.zeros_like(target)
    if not len(target):
        return found_key, found_gid

    def digit(key_step: NDArray, gid_step: NDArray) -> NDArray:
        """How many of the seven steps keep the weight below under the target."""
        candidate_key = found_key[:, None] + key_step
        candidate_gid = found_gid[:, None] + gid_step
        below = kernels.weights_below(
            key, gid, weight_before, candidate_key.ravel(), candidate_gid.ravel()
        ).reshape(candidate_key.shape)
        parallel.sum_in_place(below)
        return np.count_nonzero(below < target[:, None], axis=1)

    digits, still = np.arange(1, 8, dtype=np.int64), np.zeros(7, dtype=np.int64)
    for shift in _digit_shifts(3 * morton.LEVELS):
        found_key += digit(digits << shift, still) << shift
    for shift in _digit_shifts(parallel.max(int(gid.max(initial=0))).bit_length()):
        found_gid += digit(still, digits << shift) << shift
    return found_key, found_gid


def _digit_shifts(bits: int) -> range:
    """Positions of the octal digits of a number of so many bits, the highest first."""
    return range(3 * ((bits - 1) // 3), -1, -3)


def migrate(
    parallel: Parallel, partition: Partition, bodies: Bodies, memory: ImpulseMemory
) -> tuple[Bodies, ImpulseMemory, int]:
    """Collective. Send every body, with its impulse memory, to the rank that owns it.

    Returns this rank's bodies and memories in the order of (Morton key, gid), and how many
    bodies moved on all ranks together. RuntimeError on all ranks if one was lost or doubled.
    """
    destination = partition.owner(bodies.position, bodies.gid)
    leaving = np.flatnonzero(destination != parallel.rank)
    leaving = leaving[np.argsort(destination[leaving], kind="stable")]
    ranks, starts = np.unique(destination[leaving], return_index=True)
    messages = {
        int(rank): pack_rows(bodies, memory, rows)
        for rank, rows in zip(ranks, np.split(leaving, starts[1:]), strict=False)
    }
    received = [unpack_rows(message) for message in parallel.exchange(messages).values()]
    arrivals = [b for b, _ in received]
    first, last = len(bodies), len(bodies) + sum(map(len, arrivals))
    index = np.flatnonzero(destination == parallel.rank)
    index = np.concatenate((index, np.arange(first, last)))
    # Of a rank's bodies there is room for two copies, not for one of each stage.
    position = np.concatenate([bodies.position, *(b.position for b in arrivals)])[index]
    gid = np.concatenate([bodies.gid, *(b.gid for b in arrivals)])[index]
    _check_conservation(parallel, bodies.gid, gid)
    index = index[partition.order(position, gid)]
    del position, gid, destination
    memories = [memory, *(m for _, m in received)]
    return (
        Bodies.take_from([bodies, *arrivals], index),
        ImpulseMemory.take_from(memories, index),
        parallel.sum(len(leaving)),
    )


def _check_conservation(parallel: Parallel, before: NDArray, after: NDArray) -> None:
    """Collective. RuntimeError on all ranks unless `after` holds the gids of `before`, globally.

    The number, the sum and the sum of squares of the gids (modulo 2^64) are compared: a body
    lost and another doubled at once leave the number unchanged, not the sums.
    """
    sums = [
        np.array([len(gid), np.sum(gid), np.sum(gid * gid)], dtype=np.int64)
        for gid in (before, after)
    ]
    change = parallel.sum(sums[1] - sums[0])
    if np.any(change):
        raise RuntimeError(f"migration changed the number of bodies by {change[0]} or their gids")


def imbalance(parallel: Parallel, weight: float) -> float:
    """Collective. Maximum over mean of the ranks' `weight`; 1 when all are zero."""
    mean = parallel.sum(float(weight)) / parallel.size
    largest = parallel.max(float(weight))
    return largest / mean if mean > 0.0 else 1.0


def ghost_targets(
    parallel: Parallel, partition: Partition, position: NDArray, reach: NDArray
) -> dict[int, NDArray[np.int32]]:
    """Return the rows of owned bodies that each other rank needs as ghosts, ascending.

    A rank is listed when a body anywhere in its region could be within `reach` (n,) [m] of
    the body's `position` (n, 3) in every coordinate. Regions follow from the splitters alone,
    nothing is sent. Every body must be on the rank that owns its key, as after `migrate`: the
    other rank takes that for granted. RuntimeError where one is not.
    """
    targets, strays = _targets(partition, position, reach, parallel.rank)
    if strays:
        raise RuntimeError(f"{strays} bodies are not on the rank that owns them: migrate first")
    return targets


def image_targets(
    partition: Partition, box: PeriodicBox, position: NDArray, reach: NDArray
) -> dict[int, tuple[NDArray[np.int32], NDArray[np.int8]]]:
    """Return (rows, image codes) of the periodic images that each rank needs, this one included.

    As `ghost_targets`, for the images of the owned bodies at `position` (n, 3) [m], which must
    lie in the box. For each rank images are in order of (code, row).
    """
    rows, codes = box.images(position, reach)
    targets, _ = _targets(partition, position[rows] + box.shift(codes), reach[rows], -1)
    return {rank: (rows[index], codes[index]) for rank, index in targets.items()}


def _targets(
    partition: Partition, position: NDArray, reach: NDArray, rank: int
) -> tuple[dict[int, NDArray[np.int32]], int]:
    """Bodies whose reach meets the region of each rank but `rank`, and how many stray from it."""
    position = np.ascontiguousarray(position, dtype=np.float64)
    reach = np.ascontiguousarray(reach, dtype=np.float64)
    pair = np.stack((partition.splitter_key, partition.splitter_gid), axis=1)
    occupied = np.ones(partition.ranks, dtype=bool)
    occupied[1:-1] = np.any(pair[1:] != pair[:-1], axis=1)
    geometry = (position, reach, partition.origin, morton.LATTICE_SIZE / partition.edge)
    regions = (partition.splitter_key, partition.splitter_gid, occupied, rank)
    count = np.zeros(partition.ranks, dtype=np.int64)
    strays = kernels.find_ghost_targets(*geometry, *regions, count, np.empty(0, np.int32))
    end = np.cumsum(count)
    rows = np.empty(end[-1], dtype=np.int32)
    if len(rows):
        kernels.find_ghost_targets(*geometry, *regions, end - count, rows)
    return {int(r): rows[end[r] - count[r] : end[r]] for r in np.flatnonzero(count)}, strays
