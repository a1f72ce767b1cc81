"""A tree over points of all ranks: what a rank holds of it, and what it needs of the others.

A box is named by its location code, a one followed by the 3 L bits of its octants from the root
(M. S. Warren, J. K. Salmon, Supercomputing 1993): codes rise as (level, key) do.

Symbols: P ranks; nb boxes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi import morton
from dem_mpi.parallel import Halo, Parallel
from stokes.fmm import _distribution as kernels
from stokes.fmm import tree
from stokes.fmm.lists import Lists, interaction_lists
from stokes.fmm.tree import Boxes, Splitting

_LEVELS = tree.MAX_LEVEL + 1
_NOBODY = -1
_FIRST_CODES = np.int64(1) << 3 * np.arange(_LEVELS, dtype=np.int64)  # of the levels


def location_code(level: ArrayLike, key: ArrayLike) -> NDArray[np.int64]:
    """Codes (nb,) of boxes of `level` (nb,) and first key (nb,)."""
    level = np.asarray(level, dtype=np.int64)
    key = np.asarray(key, dtype=np.int64)
    return (np.int64(1) << 3 * level) | (key >> 3 * (morton.LEVELS - level))


def _last_key(level: ArrayLike, key: ArrayLike) -> NDArray[np.int64]:
    """The last Morton key of boxes (nb,); the first one of the next box may exceed 63 bits."""
    return np.asarray(key, np.int64) + (morton.MAX_KEY >> 3 * np.asarray(level, np.int64))


@dataclass(frozen=True)
class Ends:
    """The boxes about the first and the last point of each rank: no others can be shared.

    The points of a rank are an interval of the order along the curve. A box that holds points of
    it and points of a later rank holds its last point, one with points of an earlier rank its
    first. 2 P levels boxes are thus known to all ranks.

    rank: this one.
    occupied: (P,) bool, whether a rank has points.
    code: (P, 2, levels) int64, the boxes about its first and its last point.
    count: (P, 2, levels, 2) int64, sources and targets that it has in them.
    bounds: (P, 2, levels, 2) int64, first and last key among those.
    """

    rank: int
    occupied: NDArray[np.bool_]
    code: NDArray[np.int64]
    count: NDArray[np.int64]
    bounds: NDArray[np.int64]

    @classmethod
    def exchange(cls, parallel: Parallel, source_keys: NDArray, target_keys: NDArray) -> Ends:
        """Collective. From the rising keys of each rank's sources and targets."""
        occupied = bool(len(source_keys) or len(target_keys))
        outermost = [keys[i] for keys in (source_keys, target_keys) if len(keys) for i in (0, -1)]
        ends = np.array([min(outermost, default=0), max(outermost, default=0)], dtype=np.int64)
        level = np.arange(_LEVELS)
        shift = 3 * (morton.LEVELS - level)
        first = ends[:, None] >> shift << shift  # (2, levels)
        last = _last_key(level, first)
        count = np.empty((2, _LEVELS, 2), dtype=np.int64)
        bounds = np.empty((2, _LEVELS, 2), dtype=np.int64)
        bounds[...] = morton.MAX_KEY, -1
        for kind, keys in enumerate((source_keys, target_keys)):
            start, end = np.searchsorted(keys, first), np.searchsorted(keys, last, side="right")
            count[..., kind] = end - start
            some = start < end
            bounds[some, 0] = np.minimum(bounds[some, 0], keys[start[some]])
            bounds[some, 1] = np.maximum(bounds[some, 1], keys[end[some] - 1])
        code = location_code(level, first)
        parts = [np.array([occupied]), code, count, bounds]
        everyone = parallel.allgather(np.concatenate([p.ravel() for p in parts]).astype(np.int64))
        cuts = np.cumsum([p.size for p in parts])[:-1]
        columns = [
            column.reshape(parallel.size, *part.shape)
            for column, part in zip(np.split(everyone, cuts, axis=1), parts, strict=True)
        ]
        return cls(parallel.rank, columns[0][:, 0].astype(bool), *columns[1:])

    def shares(self, level: int, code: int) -> tuple[NDArray, NDArray, NDArray]:
        """Ranks (k,) that begin or end in a box, their counts (k, 2) and bounds (k, 2) there."""
        inside = (self.code[:, :, level] == code) & self.occupied[:, None]
        ranks = np.flatnonzero(inside.any(axis=1))
        end = np.where(inside[ranks, 0], 0, 1)
        return ranks, self.count[ranks, end, level], self.bounds[ranks, end, level]

    def source_holders(self, code: int) -> NDArray[np.int64]:
        """The ranks, rising, that have sources in a box in which ranks begin or end."""
        ranks, count, _ = self.shares((int(code).bit_length() - 1) // 3, code)
        return ranks[count[:, 0] > 0]

    @cached_property
    def shared(self) -> NDArray[np.int64]:
        """Codes, rising, of all boxes that hold points of several ranks."""
        code = np.where(self.occupied[:, None, None], self.code, 0)
        code[:, 1][code[:, 1] == code[:, 0]] = 0  # once for a rank
        code, ranks = np.unique(code, return_counts=True)
        return code[(ranks > 1) & (code > 0)]


def build_part(
    source_keys: NDArray, target_keys: NDArray, rule: Splitting, ends: Ends
) -> tuple[Boxes, NDArray[np.int32]]:
    """The boxes of the global tree that hold points of this rank, and who sums their multipoles.

    That is the first rank with sources in the box, -1 where there are none. Counts are of all
    ranks, and they and the bounds of all ranks decide what is split.
    """
    count_by_level, owner_by_level = [], []

    def decide(level: int, key: NDArray, count: NDArray, bounds: NDArray) -> NDArray | None:
        owner = np.where(count[:, 0] > 0, ends.rank, _NOBODY)
        count = count.astype(np.int64)
        code = location_code(level, key)
        for box in np.flatnonzero(np.isin(code, ends.code[ends.rank, :, level])):
            ranks, shares, limits = ends.shares(level, code[box])
            count[box] = shares.sum(axis=0)
            bounds[box, 0] = limits[:, 0].min(initial=bounds[box, 0])
            bounds[box, 1] = limits[:, 1].max(initial=bounds[box, 1])
            holders = ranks[shares[:, 0] > 0]
            owner[box] = holders[0] if len(holders) else _NOBODY
        count_by_level.append(count)
        owner_by_level.append(owner)
        split = rule.splits(level, count, bounds)
        return split if split.any() else None

    boxes = tree.build(source_keys, target_keys, rule, decide)
    count = np.concatenate(count_by_level)
    boxes = replace(
        boxes,
        source_count=np.ascontiguousarray(count[:, 0]),
        target_count=np.ascontiguousarray(count[:, 1]),
    )
    return boxes, np.concatenate(owner_by_level).astype(np.int32)


def exchange_boxes(
    parallel: Parallel, boxes: Boxes, owner: NDArray[np.int32], direct_below: int
) -> tuple[Boxes, NDArray[np.int32]]:
    """Collective. The table with the boxes of others that lists of this rank may name, and owners.

    A rank says where its targets are by one interval of keys, from the first key of its first
    leaf with targets to the last of its last. See `stokes.fmm.distribution` for what it gets.
    Ranges of boxes of others are empty here.
    """
    mine = boxes.leaf & (boxes.targets[:, 0] < boxes.targets[:, 1])
    low = boxes.key[mine].min(initial=morton.MAX_KEY)
    high = _last_key(boxes.level[mine], boxes.key[mine]).max(initial=-1)
    regions = parallel.allgather(np.array([low, high], dtype=np.int64))
    wanting = np.flatnonzero(regions[:, 0] <= regions[:, 1])
    own_region = np.flatnonzero(wanting == parallel.rank)
    start, region = kernels.needed_children(
        boxes.level,
        boxes.cells(),
        boxes.parent,
        boxes.leaf,
        boxes.source_count,
        direct_below,
        np.ascontiguousarray(regions[wanting, 0]),
        np.ascontiguousarray(regions[wanting, 1]),
        int(own_region[0]) if len(own_region) else -1,
    )
    child = np.flatnonzero((owner == parallel.rank) & (boxes.parent >= 0))
    above = boxes.parent[child]
    count = start[above + 1] - start[above]
    box = np.repeat(child, count)
    destination = wanting[region[rows_of(np.stack((start[above], start[above + 1]), axis=1))]]
    columns = np.stack(
        (location_code(boxes.level, boxes.key), boxes.leaf, boxes.source_count, boxes.target_count),
        axis=1,
    ).astype(np.int64)
    received = parallel.exchange(
        {int(r): columns[box[destination == r]].tobytes() for r in np.unique(destination)}
    )
    return _merged(boxes, owner, columns, received)


def _merged(
    boxes: Boxes, owner: NDArray, columns: NDArray, received: Mapping[int, bytes]
) -> tuple[Boxes, NDArray[np.int32]]:
    """Own boxes and those received from others, without those that are there already."""
    width = columns.shape[1]
    others = [np.frombuffer(m, dtype=np.int64).reshape(-1, width) for m in received.values()]
    senders = [np.full(len(rows), r, np.int32) for r, rows in zip(received, others, strict=True)]
    rows = np.concatenate((columns, *others))
    owner = np.concatenate((owner, *senders))
    code, first = np.unique(rows[:, 0], return_index=True)  # the first: an own box, if there is one
    rows, owner = rows[first], owner[first]
    level = np.searchsorted(_FIRST_CODES, code, side="right") - 1
    key = (code ^ _FIRST_CODES[level]) << 3 * (morton.LEVELS - level)
    sources = np.zeros((len(code), 2), dtype=np.int32)
    targets = np.zeros((len(code), 2), dtype=np.int32)
    own = first < len(boxes)
    sources[own], targets[own] = boxes.sources[first[own]], boxes.targets[first[own]]
    return tree.table(level, key, rows[:, 1], sources, targets, rows[:, 2], rows[:, 3]), owner


def lists_without_points(
    boxes: Boxes, admissibility: Literal["standard", "smooth"], direct_below: int
) -> Lists:
    """Interaction lists of this rank's targets, before the sources of others are here."""
    everything = np.stack((np.zeros_like(boxes.source_count), boxes.source_count), axis=1)
    return interaction_lists(
        replace(boxes, sources=everything),
        admissibility=admissibility,
        wanted=boxes.targets[:, 0] < boxes.targets[:, 1],
        direct_below=direct_below,
    )


def listed(boxes: Boxes, lists: Lists) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Mark (nb,) the boxes whose multipoles the lists name, and those whose sources they name."""
    multipoles, sources = np.zeros((2, len(boxes)), dtype=bool)
    for pairs in (lists.far, lists.multipole_to_target):
        multipoles[pairs.source] = True
    for pairs in (lists.near, lists.source_to_local):
        sources[pairs.source] = True
    return multipoles, sources


def without(boxes: Boxes, dropped: NDArray[np.bool_]) -> tuple[Boxes, NDArray[np.int64]]:
    """The table without those of the `dropped` boxes (nb,) that no kept box lies in; rows kept."""
    kept = ~dropped
    for level in range(boxes.depth, 0, -1):
        here = boxes.of_level(level)
        kept[boxes.parent[here][kept[here]]] = True
    rows = np.flatnonzero(kept)
    columns = (
        boxes.level,
        boxes.key,
        boxes.leaf,
        boxes.sources,
        boxes.targets,
        boxes.source_count,
        boxes.target_count,
    )
    return tree.table(*(column[rows] for column in columns)), rows


def with_ranges(
    boxes: Boxes, source_keys: NDArray[np.int64], target_keys: NDArray[np.int64]
) -> Boxes:
    """The table with ranges in rising `source_keys` (n,), `target_keys` (m,)."""
    last = _last_key(boxes.level, boxes.key)
    sources, targets = (
        np.stack(
            (np.searchsorted(keys, boxes.key), np.searchsorted(keys, last, side="right")), axis=1
        ).astype(np.int32)
        for keys in (source_keys, target_keys)
    )
    return replace(boxes, sources=sources, targets=targets)


class GhostMultipoles:
    """Multipoles of boxes that hold sources of several ranks, or of others only.

    The owner of a box, the first rank with sources in it, adds what the other holders bring, in
    the order of ranks, and sends the sum to every rank that asked for it.
    """

    def __init__(
        self,
        parallel: Parallel,
        code: NDArray[np.int64],
        owner: NDArray[np.int32],
        wanted: NDArray[np.bool_],
        asked: Mapping[int, NDArray[np.int64]],
        ends: Ends,
    ) -> None:
        """Collective. Agree on what is sent.

        code, owner, wanted (nb,): of the local table, the multipoles marked that this rank needs.
        asked: the boxes (rows of the table) that other ranks have asked this one for.
        """
        mine = wanted & (owner == parallel.rank)
        for rows in asked.values():
            mine[rows] = True
        self._sums, send = _numbered(
            _other_holders(np.flatnonzero(mine & np.isin(code, ends.shared)), code, ends)
        )
        self._adding = Halo.build(parallel, len(self._sums), send)
        # Holders learn by the same way which boxes they are to bring.
        names = np.empty((len(self._sums) + self._adding.ghosts, 1), dtype=np.int64)
        names[: len(self._sums), 0] = code[self._sums]
        self._adding.forward(names)
        self._parts = np.searchsorted(code, names[len(self._sums) :, 0])
        self._sent, send = _numbered(asked)
        self._fetching = Halo.build(parallel, len(self._sent), send)
        foreign = np.flatnonzero(wanted & (owner != parallel.rank))
        self.fetched = foreign[np.argsort(owner[foreign], kind="stable")]

    def complete(self, multipoles: NDArray) -> None:
        """Collective among neighbours. Replace parts (nb, ...) by sums, and fill in the others'.

        Rows that no list of this rank names may stay parts.
        """
        sums = len(self._sums)
        values = multipoles[np.concatenate((self._sums, self._parts))]
        self._adding.reverse_add(values)
        multipoles[self._sums] = values[:sums]
        values = np.empty(
            (len(self._sent) + len(self.fetched), *multipoles.shape[1:]), dtype=multipoles.dtype
        )
        values[: len(self._sent)] = multipoles[self._sent]
        self._fetching.forward(values)
        multipoles[self.fetched] = values[len(self._sent) :]


def _other_holders(
    boxes: NDArray[np.int64], code: NDArray[np.int64], ends: Ends
) -> dict[int, NDArray[np.int64]]:
    """For each other rank with sources in some of the boxes (rows, rising), those."""
    rows: dict[int, list[int]] = {}
    for box in boxes:
        for holder in ends.source_holders(code[box]):
            if holder != ends.rank:
                rows.setdefault(int(holder), []).append(box)
    return {holder: np.array(held, dtype=np.int64) for holder, held in rows.items()}


def _numbered(
    rows: Mapping[int, NDArray[np.int64]],
) -> tuple[NDArray[np.int64], dict[int, NDArray[np.int64]]]:
    """All rows once, rising, and where those of each rank stand among them."""
    distinct = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *rows.values()]))
    return distinct, {rank: np.searchsorted(distinct, some) for rank, some in rows.items()}


def ask(
    parallel: Parallel,
    code: NDArray[np.int64],
    owner: NDArray[np.int32],
    multipoles: NDArray[np.bool_],
    sources: NDArray[np.bool_],
    ends: Ends,
) -> tuple[dict[int, NDArray[np.int64]], dict[int, NDArray[np.int64]]]:
    """Collective. Ask others for marked multipoles and leaves' sources: what they ask this for.

    code, owner, multipoles, sources (nb,): of the local table. Returns for each rank that asks
    the boxes (rows of the table) whose multipoles, and those whose sources it wants, rising.
    """
    foreign = np.flatnonzero(multipoles & (owner != parallel.rank))
    wanted_multipoles = {
        int(r): code[foreign[owner[foreign] == r]] for r in np.unique(owner[foreign])
    }
    leaves = np.flatnonzero(sources)
    shared = np.isin(code[leaves], ends.shared)
    single = leaves[~shared & (owner[leaves] != parallel.rank)]
    wanted_sources = {int(r): code[single[owner[single] == r]] for r in np.unique(owner[single])}
    for rank, boxes in _other_holders(leaves[shared], code, ends).items():
        some = wanted_sources.get(rank, np.empty(0, dtype=np.int64))
        wanted_sources[rank] = np.sort(np.concatenate((some, code[boxes])))
    none = np.empty(0, dtype=np.int64)
    messages = {}
    for rank in sorted(wanted_multipoles.keys() | wanted_sources.keys()):
        first, second = wanted_multipoles.get(rank, none), wanted_sources.get(rank, none)
        messages[rank] = np.concatenate(([len(first)], first, second)).astype(np.int64).tobytes()
    asked_multipoles, asked_sources = {}, {}
    for rank, message in parallel.exchange(messages).items():
        numbers = np.frombuffer(message, dtype=np.int64)
        cut = 1 + numbers[0]
        asked_multipoles[rank] = np.searchsorted(code, numbers[1:cut])
        asked_sources[rank] = np.searchsorted(code, numbers[cut:])
    return asked_multipoles, asked_sources


def rows_of(ranges: NDArray) -> NDArray[np.int64]:
    """The numbers in the ranges [start, end) of (k, 2), one range after another."""
    length = ranges[:, 1].astype(np.int64) - ranges[:, 0]
    before = np.cumsum(length) - length
    return np.arange(length.sum()) + np.repeat(ranges[:, 0] - before, length)
