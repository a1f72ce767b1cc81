"""Points, boxes and sums of a tree that is spread over ranks: who holds what, and who needs it.

Sources and targets are moved to ranks by Morton key: every rank gets an interval of the order of
(key, index in the caller's arrays), all intervals of equally many points. The tree over them is
the one that a single rank would build: a box is split by what all ranks hold of it. Only a box
that holds the first or the last point of a rank can hold points of several, at most 2 a level and
rank; their counts are known to all ranks, every other box is known to its rank alone.

A rank holds the boxes of its own points, and the local essential tree (M. S. Warren, J. K. Salmon,
Supercomputing 1993): those boxes of other ranks, with sources, that its targets hear of. Let its
region be the leaves (whole cells) that hold targets of it, N(b) the box b and all of the same
level that touch it, p(b) its parent. Let t be a target box of the rank: it holds a leaf of the
region.

- V: s is a child of a box that touches p(t) or is it, so that N(p(s)) holds p(t), a part of the
  region. With "smooth" admissibility touching leaves of one level are such pairs, too.
- W: t is a leaf, s smaller, and p(s) touches t or lies in it, so that a box of N(p(s)) lies in t:
  N(p(s)) meets the region.
- U: leaves t and s touch, or are one. N(s) meets t, whichever is the larger: if t is, a box of
  N(s) lies in t; if not, t lies in a box of N(s). N(s) is a part of N(p(s)).
- X: s is a leaf, larger than t, that touches p(t), so that N(s) holds p(t).
- Pairs near by fiat: W and X of boxes with fewer points than `direct_below` become pairs of
  leaves. The leaves under such a W box are needed, too; those of X are named above.

So the rank needs s only if N(p(s)) meets its region, or if s lies in a box with few sources that
it needs. That set holds the parent of each of its members, as N(p(s)) lies within N(p(p(s))), and
with one child all children that have sources, so that the lists built on it are those of the
whole tree. A rank tells the others of its region by one interval of keys that covers it; the
owners of boxes send all that may be needed in one exchange (32 bytes a box, no points yet). From
its lists the rank then knows what it does need, asks for that, and forgets the rest.

A leaf may be shared: its sources come from all of its holders, its targets stay where they are.
Expansions of shared target boxes are summed by every rank with targets in them.

In an application weights of ghost sources and multipoles travel between neighbours. Boxes of the
coarse levels are needed by far ranks: a rank that owns one of level 2 sends it to all that list
it, so that messages of a few ranks grow with P there, not those of the many.

Symbols: P ranks; n sources and m targets of the caller on this rank; nb boxes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi import morton
from dem_mpi.parallel import Halo, Parallel
from stokes.fmm import _distribution as kernels
from stokes.fmm import _essential as essential
from stokes.fmm import tree
from stokes.fmm._migration import Route, find_splitters
from stokes.fmm.lists import Lists, interaction_lists
from stokes.fmm.tree import Boxes, Splitting


@dataclass(frozen=True)
class DistributionReport:
    """What this rank holds.

    sources, targets : its own points; ghost_sources : those of others that it needs
    boxes, ghost_boxes : in its table, and those among them without points of its own
    shared_boxes     : with points of its own and of others
    ghost_multipoles : boxes whose multipoles come from others
    ghost_bytes      : memory of positions and boxes of others
    """

    sources: int
    targets: int
    ghost_sources: int
    boxes: int
    ghost_boxes: int
    shared_boxes: int
    ghost_multipoles: int
    ghost_bytes: int


class Distribution:
    """One rank's part of a tree over the points of all ranks, and the exchanges of its sums.

    origin (3,), edge: the root cube, the same on all ranks
    x_sources: (3, n_held) float64, rising by (key, index): those of lower ranks, own, of higher
    x_targets: (3, m_own) float64, all own
    boxes: table of own boxes and ghosts; `sources` are ranges of all sources held, `targets` of
        own targets. Complete for the leaves that the lists name
    upward: the same table with `sources` and `source_count` of own sources only: what
        multipoles are formed from, before they are completed
    own_sources: slice of `x_sources`
    report: DistributionReport
    """

    def __init__(
        self,
        parallel: Parallel,
        sources: ArrayLike,
        targets: ArrayLike | None,
        splitting: Splitting,
        *,
        admissibility: Literal["standard", "smooth"] = "standard",
        direct_below: int = 0,
    ) -> None:
        """Collective. Move the points, build the tree, fetch the ghosts.

        sources (n, 3), targets (m, 3): this rank's, in any order; no targets: the sources.
        admissibility, direct_below: as of `interaction_lists`, the same on all ranks.
        Raises ValueError on all ranks for points of another shape or that are not finite.
        """
        self.parallel = parallel
        self.admissibility = admissibility
        self.direct_below = direct_below
        one_set = not parallel.any(targets is not None and targets is not sources)
        point_sets = [sources] if one_set else [sources, sources if targets is None else targets]
        point_sets = _checked(parallel, point_sets)
        self.origin, self.edge = _root_cube(parallel, point_sets)
        routes = self._migrate(point_sets)
        (self._source_route, x_sources, source_keys) = routes[0]
        (self._target_route, x_targets, target_keys) = routes[-1]
        self.x_targets = np.ascontiguousarray(x_targets.T)
        if parallel.size == 1:
            self.x_sources = self.x_targets if one_set else np.ascontiguousarray(x_sources.T)
            self.own_sources = slice(0, len(source_keys))
            self.boxes = self.upward = tree.build(source_keys, target_keys, splitting)
            self._ghost_sources = self._ghost_multipoles = None
            shared = 0
        else:
            shared = self._join(x_sources, source_keys, target_keys, splitting)
        self.report = self._report(shared)

    @cached_property
    def lists(self) -> Lists:
        """Interaction lists of this rank's targets, every pair of theirs exactly once."""
        return interaction_lists(
            self.boxes, admissibility=self.admissibility, direct_below=self.direct_below
        )

    @property
    def has_sources(self) -> NDArray[np.bool_]:
        """Boxes (nb,) with own sources: those that have a part in the upward pass."""
        return self.upward.sources[:, 0] < self.upward.sources[:, 1]

    @property
    def has_targets(self) -> NDArray[np.bool_]:
        """Boxes (nb,) with own targets: those that need local expansions."""
        return self.boxes.targets[:, 0] < self.boxes.targets[:, 1]

    # ---- an application ----------------------------------------------------------------------

    def scatter_weights(self, weights: NDArray) -> NDArray:
        """Collective among neighbours. Weights (n, ...) of the caller as (..., n_held).

        The place of a weight is that of its source in `x_sources`, ghosts included.
        """
        weights = np.asarray(weights)
        shape = weights.shape[1:]
        rows, order = self._source_route.arrive(
            np.ascontiguousarray(weights).reshape(len(weights), math.prod(shape))
        )
        columns = np.empty((rows.shape[1], self.x_sources.shape[1]), dtype=rows.dtype)
        if self._ghost_sources is None:
            kernels.take_transposed(rows, order, columns)
        else:
            values = np.empty(columns.shape[::-1], dtype=rows.dtype)
            np.take(rows, order, axis=0, out=values[: len(order)])
            self._ghost_sources.forward(values)
            self._lay_down(values, columns)
        return columns.reshape(*shape, columns.shape[1])

    def complete_multipoles(self, multipoles: NDArray) -> None:
        """Collective among neighbours. Make parts of multipoles (nb, ...) whole, in place.

        Wanted are multipoles of own sources in every box of `upward`, zero elsewhere. Afterwards
        all that the lists name are those of all sources in the box; others may stay parts.
        """
        if self._ghost_multipoles is not None:
            self._ghost_multipoles.complete(multipoles)

    def gather(self, values: NDArray) -> NDArray:
        """Collective among neighbours. Values (..., m_own) at own targets as (m, ...).

        In the order of the caller's targets.
        """
        values = np.asarray(values)
        shape = values.shape[:-1]
        columns = np.ascontiguousarray(values).reshape(math.prod(shape), values.shape[-1])
        rows = self._target_route.to_caller(columns)
        return rows.reshape(len(rows), *shape)

    # ---- building ----------------------------------------------------------------------------

    def _migrate(self, point_sets: list[NDArray]) -> list[tuple[Route, NDArray, NDArray]]:
        """Collective. Route, positions and keys of this rank's points, of each set."""
        keys = [morton.encode(points, self.origin, self.edge) for points in point_sets]
        owners: list[NDArray | None] = [None] * len(keys)
        if self.parallel.size > 1:
            first = [self.parallel.exclusive_sum(len(k)) for k in keys]
            splitters = find_splitters(self.parallel, list(zip(keys, first, strict=True)))
            owners = [splitters.owner(*part) for part in zip(keys, first, strict=True)]
        return [
            Route.build(self.parallel, *part) for part in zip(point_sets, keys, owners, strict=True)
        ]

    def _join(
        self, x_sources: NDArray, source_keys: NDArray, target_keys: NDArray, rule: Splitting
    ) -> int:
        """Collective. Build the local tree and fetch the essential part of the others'.

        Returns the number of boxes that this rank shares with others.
        """
        parallel = self.parallel
        ends = essential.Ends.exchange(parallel, source_keys, target_keys)
        boxes, owner = essential.build_part(source_keys, target_keys, rule, ends)
        boxes, owner = essential.exchange_boxes(parallel, boxes, owner, self.direct_below)
        lists = essential.lists_without_points(boxes, self.admissibility, self.direct_below)
        multipoles, sources = essential.listed(boxes, lists)
        boxes = essential.with_ranges(boxes, source_keys, target_keys)
        others = ~_holding(boxes)
        others[0] = False
        boxes, kept = essential.without(boxes, others & ~multipoles & ~sources)
        owner, multipoles, sources = owner[kept], multipoles[kept], sources[kept]
        code = essential.location_code(boxes.level, boxes.key)
        asked_multipoles, asked_sources = essential.ask(
            parallel, code, owner, multipoles, sources, ends
        )
        self._ghost_multipoles = essential.GhostMultipoles(
            parallel, code, owner, multipoles, asked_multipoles, ends
        )
        self._fetch_sources(boxes, x_sources, asked_sources)
        held_keys = morton.encode(self.x_sources.T, self.origin, self.edge)
        self.boxes = essential.with_ranges(boxes, held_keys, target_keys)
        own = np.clip(self.boxes.sources, self.own_sources.start, self.own_sources.stop)
        own = own.astype(np.int32)
        self.upward = replace(
            self.boxes, sources=own, source_count=(own[:, 1] - own[:, 0]).astype(np.int64)
        )
        shared = np.isin(code, ends.shared) & (self.has_sources | self.has_targets)
        return int(np.count_nonzero(shared))

    def _fetch_sources(
        self, boxes: Boxes, x_sources: NDArray, asked: dict[int, NDArray[np.int64]]
    ) -> None:
        """Collective. Send own sources of the leaves (rows) asked for, and set `x_sources`.

        boxes: ranges are of own sources.
        """
        count = len(x_sources)
        # Rising, so that what arrives from a rank is in the order of (key, index).
        send = {r: np.sort(essential.rows_of(boxes.sources[rows])) for r, rows in asked.items()}
        halo = Halo.build(self.parallel, count, send)
        values = np.empty((count + halo.ghosts, 3))
        values[:count] = x_sources
        halo.forward(values)
        sender = np.full((len(values), 1), self.parallel.rank, dtype=np.int32)
        halo.forward(sender)
        below = int(np.count_nonzero(sender[count:] < self.parallel.rank))
        self.own_sources = slice(below, below + count)
        self.x_sources = np.empty((3, len(values)))
        self._lay_down(values, self.x_sources)
        self._ghost_sources = halo

    def _lay_down(self, values: NDArray, columns: NDArray) -> None:
        """Rows (n_held, c), own before ghosts, as columns (c, n_held) in the order of the curve."""
        below, above = self.own_sources.start, self.own_sources.stop
        count = above - below
        columns[:, below:above] = values[:count].T
        columns[:, :below] = values[count:above].T
        columns[:, above:] = values[above:].T

    def _report(self, shared: int) -> DistributionReport:
        held = self.x_sources.shape[1]
        own = self.own_sources.stop - self.own_sources.start
        ghost_boxes = int(np.count_nonzero(~_holding(self.upward))) if self._ghost_sources else 0
        table = sum(
            column.nbytes for column in vars(self.boxes).values() if isinstance(column, np.ndarray)
        )
        return DistributionReport(
            sources=own,
            targets=self.x_targets.shape[1],
            ghost_sources=held - own,
            boxes=len(self.boxes),
            ghost_boxes=ghost_boxes,
            shared_boxes=shared,
            ghost_multipoles=len(self._ghost_multipoles.fetched) if self._ghost_multipoles else 0,
            ghost_bytes=24 * (held - own) + table * ghost_boxes // len(self.boxes),
        )


def _holding(boxes: Boxes) -> NDArray[np.bool_]:
    """Boxes (nb,) with points in their ranges."""
    return np.any(boxes.sources[:, :1] < boxes.sources[:, 1:], axis=1) | np.any(
        boxes.targets[:, :1] < boxes.targets[:, 1:], axis=1
    )


def _checked(parallel: Parallel, point_sets: list[ArrayLike]) -> list[NDArray[np.float64]]:
    """Collective. The points as arrays (n, 3); ValueError on all ranks if one has another shape."""
    error, arrays = None, []
    for points in point_sets:
        try:
            array = np.ascontiguousarray(points, dtype=np.float64)
            if array.size == 0:
                array = array.reshape(0, 3)
            if array.ndim != 2 or array.shape[1] != 3:
                raise ValueError(f"points must be (n, 3), got {array.shape}")
            arrays.append(array)
        except (TypeError, ValueError) as fault:
            error = ValueError(str(fault))
    parallel.raise_together(error)
    return arrays


def _root_cube(parallel: Parallel, point_sets: list[NDArray]) -> tuple[NDArray[np.float64], float]:
    """Collective. The cube (origin, edge) about all points of all ranks: `tree.root_cube`.

    ValueError on all ranks if a point is not finite.
    """
    outermost = np.full(6, -np.inf)
    for points in point_sets:
        low, high = tree.corners(points)
        outermost = np.maximum(outermost, np.concatenate((-low, high)))
    outermost[np.isnan(outermost)] = np.inf  # MPI leaves the maximum with a NaN open
    outermost = parallel.max(outermost)
    if np.all(outermost == -np.inf):
        return tree.root_cube()
    return tree.cube_about(-outermost[:3], outermost[3:])
