"""Adaptive octree over sources and targets: Morton sort, splitting, and the table of boxes.

Level 0 is the root cube; level L has boxes of edge 2^-L of it, down to the lattice of
`dem_mpi.morton`. Only boxes that hold a point are stored, so that a surface costs in proportion
to the boxes it crosses. Points are sorted by Morton key: a box's points are one range of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi import morton
from stokes.fmm import _tree

MAX_LEVEL = morton.LEVELS - 1


@dataclass(frozen=True)
class Splitting:
    """Which boxes are cut into octants. Exactly one of `leaf_size` and `depth` is given.

    leaf_size: a box is split while it has more sources, or more targets, than this. It stays
        whole where all of its points share a lattice cell, or at `max_level`.
    depth: all boxes above this level are split, whatever they hold: a uniform tree.

    Raises ValueError for anything else.
    """

    leaf_size: int | None = None
    depth: int | None = None
    max_level: int = MAX_LEVEL

    def __post_init__(self) -> None:
        if (self.leaf_size is None) == (self.depth is None):
            raise ValueError("Splitting: give either leaf_size or depth")
        if not 0 <= self.max_level <= MAX_LEVEL:
            raise ValueError(f"max_level = {self.max_level}: must be in [0, {MAX_LEVEL}]")
        if self.leaf_size is not None and self.leaf_size < 1:
            raise ValueError(f"leaf_size = {self.leaf_size}: must be at least 1")
        if self.depth is not None and not 0 <= self.depth <= self.max_level:
            raise ValueError(f"depth = {self.depth}: must be in [0, {self.max_level}]")

    def splits(self, level: int, counts: NDArray, bounds: NDArray) -> NDArray[np.bool_]:
        """Mark (k,) the boxes of a level that are to be cut.

        counts (k, 2) are the sources and the targets of each box, bounds (k, 2) the first and the
        last key among both.
        """
        if level >= self.max_level:
            return np.zeros(len(counts), dtype=bool)
        if self.depth is not None:
            return (level < self.depth) & (counts.sum(axis=1) > 0)
        return (counts.max(axis=1) > self.leaf_size) & (bounds[:, 0] < bounds[:, 1])


@dataclass(frozen=True)
class Boxes:
    """A table of nb boxes sorted by (level, key), the root first; every box's parent is in it.

    The table may be part of a larger tree: own boxes and copies of others' boxes. Then a box that
    is not a leaf may lack children, and its counts are larger than its ranges.

    level: (nb,) int32.
    key: (nb,) int64, the Morton key of the first lattice cell.
    parent: (nb,) int32, -1 for the root.
    children: (nb, 8) int32 by octant (bit a of it: the upper half along axis a), -1 if absent.
    leaf: (nb,) bool.
    sources, targets: (nb, 2) int32, the range [start, end) of points held here, in sorted order.
    source_count, target_count: (nb,) int64, the points of the box in the whole tree.
    level_start: (levels + 1,) int64: boxes of level L are [level_start[L], level_start[L + 1]).
    """

    level: NDArray[np.int32]
    key: NDArray[np.int64]
    parent: NDArray[np.int32]
    children: NDArray[np.int32]
    leaf: NDArray[np.bool_]
    sources: NDArray[np.int32]
    targets: NDArray[np.int32]
    source_count: NDArray[np.int64]
    target_count: NDArray[np.int64]
    level_start: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.key)

    @property
    def levels(self) -> int:
        """Number of levels, the root's among them."""
        return len(self.level_start) - 1

    @property
    def depth(self) -> int:
        """The finest level."""
        return self.levels - 1

    def of_level(self, level: int) -> slice:
        """The boxes of a level, a slice of every column."""
        return slice(int(self.level_start[level]), int(self.level_start[level + 1]))

    def cells(self) -> NDArray[np.int32]:
        """Lattice coordinates (nb, 3) of the boxes, each in [0, 2^level)."""
        shift = morton.LEVELS - self.level.astype(np.int64)
        return (morton.decode(self.key) >> shift[:, None]).astype(np.int32)

    def edges(self, root_edge: float = 1.0) -> NDArray[np.float64]:
        """The edge (levels,) of the boxes of each level, in the unit of `root_edge`."""
        return root_edge * 0.5 ** np.arange(self.levels)

    def centres(
        self, origin: ArrayLike = (0.0, 0.0, 0.0), root_edge: float = 1.0
    ) -> NDArray[np.float64]:
        """Centres (nb, 3) of the boxes of a root cube that has its lowest corner at `origin`."""
        edge = self.edges(root_edge)[self.level]
        return np.asarray(origin, dtype=np.float64) + (self.cells() + 0.5) * edge[:, None]


# (level, keys (k,), counts (k, 2), bounds (k, 2)) -> marks (k,) of boxes to split, None to end
Decision = Callable[[int, NDArray, NDArray, NDArray], "NDArray[np.bool_] | None"]


def root_cube(*point_sets: ArrayLike) -> tuple[NDArray[np.float64], float]:
    """The smallest cube, as (origin (3,), edge), about all points of arrays (n, 3).

    Centred on the points' bounding box. The edge is 1 where there are no points or all are equal.
    Raises ValueError for coordinates that are not finite.
    """
    points = [np.asarray(p, dtype=np.float64).reshape(-1, 3) for p in point_sets]
    points = [p for p in points if len(p)]
    if not points:
        return np.zeros(3), 1.0
    low, high = zip(*(corners(p) for p in points), strict=True)
    return cube_about(np.min(low, axis=0), np.max(high, axis=0))


def corners(points: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinates, (3,) each, of points (n, 3); inf and -inf if there are none.

    NaN where a coordinate is. (Along the short axis numpy takes ten times as long.)
    """
    low = np.array([points[:, axis].min(initial=np.inf) for axis in range(3)])
    high = np.array([points[:, axis].max(initial=-np.inf) for axis in range(3)])
    return low, high


def cube_about(low: ArrayLike, high: ArrayLike) -> tuple[NDArray[np.float64], float]:
    """The smallest cube, as (origin (3,), edge), about the box from `low` to `high` (3,) each.

    As `root_cube`, where the bounding box of the points is known.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        edge = float(np.max(high - low))
    if not np.isfinite(edge):
        raise ValueError("coordinates of points must be finite, and their differences too")
    if edge < np.finfo(np.float64).tiny * morton.LATTICE_SIZE:  # 2^21 / edge would overflow
        edge = 1.0
    return low + 0.5 * (high - low) - 0.5 * edge, edge


def sort(
    points: ArrayLike, origin: ArrayLike, edge: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Morton keys (n,) of points (n, 3), rising, and the order (n,) that sorts the points.

    Points of equal key stay in the order given. A point outside the cube counts to the nearest
    lattice cell of it.
    """
    key = morton.encode(np.asarray(points, dtype=np.float64).reshape(-1, 3), origin, edge)
    order = np.argsort(key, kind="stable")
    return key[order], order


def build(
    source_keys: NDArray, target_keys: NDArray, rule: Splitting, decide: Decision | None = None
) -> Boxes:
    """The octree over sources and targets of rising Morton keys (n,), (m,).

    Both may be empty; the root is always there. A tree whose points are spread over ranks passes
    `decide`: called for the local boxes of one level after another, it marks those to split (as
    `rule.splits` does, from counts and bounds summed over ranks), until it returns None.
    """
    source_keys = np.ascontiguousarray(source_keys, dtype=np.int64)
    target_keys = np.ascontiguousarray(target_keys, dtype=np.int64)
    key = np.zeros(1, dtype=np.int64)
    sources = np.array([[0, len(source_keys)]], dtype=np.int32)
    targets = np.array([[0, len(target_keys)]], dtype=np.int32)
    decide = decide or partial(_decide_alone, rule)
    rows = []
    for level in range(rule.max_level + 1):
        counts = np.stack((np.diff(sources)[:, 0], np.diff(targets)[:, 0]), axis=1)
        bounds = _tree.bounds_of_ranges(source_keys, target_keys, sources, targets)
        split = decide(level, key, counts, bounds)
        ended = split is None
        if ended:
            split = np.zeros(len(key), dtype=bool)
        rows.append((np.full(len(key), level), key, ~split, sources, targets))
        if ended:
            break
        key, sources, targets = _tree.split_level(
            level, key, sources, targets, split, source_keys, target_keys
        )
    return table(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _decide_alone(
    rule: Splitting, level: int, key: NDArray, counts: NDArray, bounds: NDArray
) -> NDArray[np.bool_] | None:
    """The decision of a tree that no other rank has a part of."""
    split = rule.splits(level, counts, bounds)
    return split if split.any() else None


def table(
    level: ArrayLike,
    key: ArrayLike,
    leaf: ArrayLike,
    sources: ArrayLike,
    targets: ArrayLike,
    source_count: ArrayLike | None = None,
    target_count: ArrayLike | None = None,
) -> Boxes:
    """Complete a table of boxes (columns as of `Boxes`) sorted by (level, key).

    Counts that are not given are the lengths of the ranges. Raises ValueError where the table
    does not begin with the root, is not sorted, names a box by a key that is not its first, or
    lacks a parent.
    """
    level = np.ascontiguousarray(level, dtype=np.int32)
    key = np.ascontiguousarray(key, dtype=np.int64)
    sources = np.ascontiguousarray(sources, dtype=np.int32)
    targets = np.ascontiguousarray(targets, dtype=np.int32)
    if len(key) == 0 or level[0] != 0 or key[0] != 0:
        raise ValueError("a table of boxes begins with the root: level 0, key 0")
    parent = np.full(len(key), -1, dtype=np.int32)
    children = np.full((len(key), 8), -1, dtype=np.int32)
    fault, box = _tree.link(level, key, parent, children)
    if fault:
        text = {
            _tree.UNSORTED: "is not sorted by (level, key)",
            _tree.UNALIGNED: "has a key that is not the first of a box of its level",
            _tree.ORPHAN: "has no parent in the table",
        }[fault]
        raise ValueError(f"box {box} (level {level[box]}, key {key[box]}) {text}")
    return Boxes(
        level=level,
        key=key,
        parent=parent,
        children=children,
        leaf=np.ascontiguousarray(leaf, dtype=bool),
        sources=sources,
        targets=targets,
        source_count=_counts(source_count, sources),
        target_count=_counts(target_count, targets),
        level_start=np.searchsorted(level, np.arange(level[-1] + 2)).astype(np.int64),
    )


def _counts(given: ArrayLike | None, ranges: NDArray) -> NDArray[np.int64]:
    if given is None:
        return (ranges[:, 1] - ranges[:, 0]).astype(np.int64)
    return np.ascontiguousarray(given, dtype=np.int64)
