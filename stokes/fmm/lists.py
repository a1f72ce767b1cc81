"""Interaction lists: by which way the sources of each box come to the targets of each other.

Every pair of a target and a source is counted exactly once: directly between leaves that touch
(U), by a transfer between boxes of one level of which only the parents touch (V), from the
multipole of a smaller box to the targets of a leaf (W), or from the sources of a leaf to the
local expansion of a smaller box (X), where the expansion is that of a box the target lies in.
(J. Carrier, L. Greengard, V. Rokhlin, SIAM J. Sci. Stat. Comput. 9, 1988.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stokes.fmm import _lists
from stokes.fmm.tree import Boxes


@dataclass(frozen=True)
class Pairs:
    """Pairs of boxes, sorted by target box: those of box b are [start[b], start[b + 1]).

    start: (nb + 1,) int64. source: (m,) int32, the source boxes.
    """

    start: NDArray[np.int64]
    source: NDArray[np.int32]

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.source)

    def rows(self) -> NDArray[np.int64]:
        """The target boxes that have a source box."""
        return np.flatnonzero(self.start[1:] > self.start[:-1])

    def target(self) -> NDArray[np.int32]:
        """The target box (m,) of each pair."""
        return np.repeat(np.arange(len(self.start) - 1, dtype=np.int32), np.diff(self.start))


@dataclass(frozen=True)
class FarPairs(Pairs):
    """Pairs of boxes of one level, with the number of the transfer vector of each.

    vector: (m,) int16, (dx + 3) 49 + (dy + 3) 7 + dz + 3 in [0, 343), where d is the target box's
    lattice coordinate less the source box's.
    """

    vector: NDArray[np.int16]

    def of_level(
        self, boxes: Boxes, level: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int16]]:
        """(start, source, vector) of the target boxes of one level.

        Row k of the start (k + 1,) is box `boxes.level_start[level] + k`; sources are numbers in
        the whole table.
        """
        own = boxes.of_level(level)
        first, last = self.start[own.start], self.start[own.stop]
        start = self.start[own.start : own.stop + 1] - first
        return start, self.source[first:last], self.vector[first:last]


@dataclass(frozen=True)
class Lists:
    """Interaction lists of the target boxes of a table.

    near: target leaf, source leaf, of any levels (U).
    far: target box, source box of the same level (V).
    multipole_to_target: target leaf, smaller source box (W).
    source_to_local: target box, larger source leaf (X).
    """

    near: Pairs
    far: FarPairs
    multipole_to_target: Pairs
    source_to_local: Pairs


def interaction_lists(
    boxes: Boxes,
    *,
    admissibility: Literal["standard", "smooth"] = "standard",
    wanted: NDArray[np.bool_] | None = None,
    direct_below: int = 0,
    far_counted: bool = False,
) -> Lists:
    """Lists of the `wanted` boxes (nb,), by default those that hold targets, and their ancestors.

    With "smooth", leaves that touch, and each leaf with itself, are far pairs too: all of the
    lists but `far` are empty. That is for kernels smooth at the origin, and accurate where leaves
    are small against the kernel's length (a tree of uniform depth).

    Boxes of fewer points than `direct_below` get neither W (sources) nor X (targets): the pairs
    of leaves under them become near.

    With `far_counted`, `far` has the start of its rows only: enough to know what a tree costs.

    A part of a tree gives the same rows as the whole if it holds every box whose parent, with the
    26 boxes about the parent, meets a wanted leaf, and all boxes under one held that has fewer
    sources than `direct_below`; and the points of each leaf which, with the 26 about it, meets a
    wanted leaf, or which has so few sources. Raises ValueError where boxes or points lack.
    """
    if admissibility not in ("standard", "smooth"):
        raise ValueError(f"admissibility = {admissibility!r}: must be 'standard' or 'smooth'")
    wanted = _wanted(boxes, wanted)
    cell, opened = boxes.cells(), np.zeros(len(boxes), dtype=bool)
    colleague_start, colleague, *far = _lists.same_level(
        *(boxes.parent, boxes.children, boxes.leaf, cell, boxes.source_count, wanted),
        *(admissibility == "smooth", far_counted, opened),
    )
    coarse_start, coarse, *source_to_local = _lists.coarser(
        *(boxes.level, boxes.parent, boxes.leaf, cell, boxes.target_count, wanted),
        *(direct_below, colleague_start, colleague),
    )
    near_start, near, *multipole_to_target = _lists.leaf_rows(
        *(boxes.level, boxes.children, boxes.leaf, cell, boxes.source_count, wanted),
        *(direct_below, colleague_start, colleague, coarse_start, coarse, opened),
    )
    lists = Lists(
        near=Pairs(near_start, near),
        far=FarPairs(*far),
        multipole_to_target=Pairs(*multipole_to_target),
        source_to_local=Pairs(*source_to_local),
    )
    _check_complete(boxes, lists, opened)
    return lists


def point_ranges(
    boxes: Boxes, pairs: Pairs
) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int32]]:
    """Ranges of points that pairs bring together: targets (k, 2), start (k + 1,), sources (m, 2).

    The sources of target range k are the ranges [start[k], start[k + 1]), in rising order; ranges
    that follow upon one another are made one.
    """
    rows = pairs.rows()
    start, sources = _lists.merged_ranges(rows, pairs.start, pairs.source, boxes.sources)
    return boxes.targets[rows], start, sources


def _wanted(boxes: Boxes, wanted: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """The wanted boxes (nb,), or those with targets, and their ancestors: a copy."""
    if wanted is None:
        wanted = boxes.targets[:, 1] > boxes.targets[:, 0]
    marked = np.array(wanted, dtype=bool)
    _lists.mark_ancestors(boxes.parent, marked)
    return marked


def _check_complete(boxes: Boxes, lists: Lists, opened: NDArray[np.bool_]) -> None:
    """Raise ValueError where a part of a tree lacks what its lists need: sums would miss it."""
    box = _lists.missing_children(opened, boxes.children, boxes.source_count)
    if box >= 0:
        raise ValueError(
            f"box {box} (level {boxes.level[box]}, key {boxes.key[box]}) lacks children"
        )
    held = boxes.sources[:, 1] - boxes.sources[:, 0] == boxes.source_count
    for pairs in (lists.near, lists.source_to_local):
        lacking = pairs.source[~held[pairs.source]]
        if len(lacking):
            box = lacking[0]
            raise ValueError(
                f"box {box} (level {boxes.level[box]}, key {boxes.key[box]}) lacks sources"
            )
