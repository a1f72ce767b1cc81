"""What a suspension is before any equation: gaps between bodies, and how finely each is resolved.

Symbols: B bodies of all ranks, b of this one. Relative gaps are over the smaller bounding radius of
both bodies.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel
from stokes.curves import Curve, Spheroid
from stokes.distance import distance, gaps_of_pairs
from stokes.fmm._requests import raised_together
from stokes.geometry import Body
from stokes.resolution import ResolutionLadder
from stokes.sources import UnitShape
from stokes.suspension_options import Level, SuspensionOptions
from stokes.suspension_table import BodyTable, quaternions_to

# Gap, over the sum of bounding radii, from which on a neighbour changes neither axes nor grids.
_REACH = 1.0
_ROUND_OFF = 1e-9  # of a gap
_CLOSE = 0.1  # gap of pairs whose near field takes memory


@dataclass(frozen=True)
class Scene:
    """Bodies as they are solved for: spheres turned, resolutions chosen.

    table     : of all bodies; shapes: distinct curves and resolutions, the same on all ranks
    shape     : (B,) number of each body's
    least_gap : of all ranks; inf without neighbours
    close_pairs : (k, 2) of a body of this rank and another at a relative gap below a tenth
    """

    table: BodyTable
    shapes: tuple[UnitShape, ...]
    shape: NDArray
    least_gap: float
    close_pairs: NDArray

    @classmethod
    def survey(
        cls,
        bodies: Sequence[Body],
        tolerance: float,
        options: SuspensionOptions,
        parallel: Parallel,
    ) -> Scene:
        """Collective. Measure gaps, turn spheres, choose resolutions to `tolerance`.

        Raises ValueError, on all ranks, for bodies that overlap or are closer than allowed.
        """
        table = BodyTable.gather(bodies, parallel)
        close = _ClosePairs.find(table)
        with raised_together(parallel):
            close.check(table, options.least_gap)
        if options.turn_spheres:
            table = table.turned(close.turned(table), parallel)
        with raised_together(parallel):
            mine = close.resolutions(table, tolerance, options)
        parts = parallel.broadcast(parallel.gather(mine))
        every = [shape for part in parts for shape in part]
        shapes = tuple(dict.fromkeys(every))
        number = {shape: k for k, shape in enumerate(shapes)}
        return cls(
            table=table,
            shapes=shapes,
            shape=np.array([number[shape] for shape in every], dtype=np.int64),
            least_gap=parallel.min(float(close.relative.min(initial=np.inf))),
            close_pairs=close.pair[close.relative < _CLOSE],
        )

    @property
    def nodes(self) -> NDArray:
        """Nodes (B,) of each body."""
        sizes = np.array([shape.nodes for shape in self.shapes], dtype=np.int64)
        return sizes[self.shape] if len(sizes) else np.empty(0, dtype=np.int64)

    @property
    def levels(self) -> tuple[Level, ...]:
        """Curves and resolutions, with the number of their bodies."""
        counts = Counter(self.shape.tolist())
        return tuple(
            Level(repr(shape.curve), shape.resolution, counts[k])
            for k, shape in enumerate(self.shapes)
        )


@dataclass(frozen=True)
class _ClosePairs:
    """Pairs (k, 2) of a body of this rank and another, in rising order, and where they are close.

    gap (k,), relative (k,), point (k, 3) on the first body's surface
    """

    pair: NDArray
    gap: NDArray
    relative: NDArray
    point: NDArray

    @classmethod
    def find(cls, table: BodyTable) -> _ClosePairs:
        """Pairs of this rank's bodies and all that are within reach of them."""
        radius = table.bounding_radius
        pair = table.pairs((1.0 + _REACH) * radius)
        numbers, local = np.unique(pair, return_inverse=True)
        bodies = [table.body(k) for k in numbers.tolist()]
        ordered = np.sort(local.reshape(-1, 2), axis=1)
        once, where = np.unique(ordered, axis=0, return_inverse=True)
        found = gaps_of_pairs(bodies, once)
        where = where.reshape(-1)
        second = (local.reshape(-1, 2)[:, 0] != ordered[:, 0]).astype(np.int64)
        gap = found.distance[where]
        return cls(pair, gap, gap / radius[pair].min(axis=1), found.points[where, second])

    def check(self, table: BodyTable, least: float) -> None:
        """ValueError that names the closest bodies, if they are closer than allowed."""
        # Places as numbers hold a gap to round-off only: one that equals the least is allowed.
        if not np.any(self.relative < (1.0 - _ROUND_OFF) * least):
            return
        worst = int(np.argmin(self.relative))
        i, j = np.sort(self.pair[worst]).tolist()
        what = "overlap" if self.gap[worst] < 0.0 else "are too close"
        raise ValueError(
            f"bodies {i} and {j}, at {_place(table, i)} and {_place(table, j)}, {what}: their gap "
            f"is {self.gap[worst]:.3g}, {self.relative[worst]:.2g} of the smaller one's radius, "
            f"and must be >= {least:g} of it"
        )

    def turned(self, table: BodyTable) -> NDArray:
        """Orientations (b, 4) of this rank's bodies: spheres' axes point to their nearest."""
        own = table.own
        quaternion = table.quaternion[own].copy()
        round_curve = np.array([_is_sphere(curve) for curve in table.curves], dtype=bool)
        # gaps equal up to round-off are told apart by places: numbers depend on the ranks
        x, y, z = table.centre[self.pair[:, 1]].T
        order = np.lexsort((z, y, x, np.round(self.relative, 9), self.pair[:, 0]))
        body, nearest = np.unique(self.pair[order, 0], return_index=True)
        nearest = order[nearest]
        turn = round_curve[table.curve[body]]
        body, nearest = body[turn], nearest[turn]
        axis = self.point[nearest] - table.centre[body]
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        quaternion[body - table.first[table.rank]] = quaternions_to(axis)
        return quaternion

    def resolutions(
        self, table: BodyTable, tolerance: float, options: SuspensionOptions
    ) -> list[UnitShape]:
        """Curve and resolution of each of this rank's bodies."""
        if options.resolution is not None:
            given = options.resolution
            return [UnitShape(table.curves[k], given) for k in table.curve[table.own].tolist()]
        shapes: dict[int, UnitShape] = {}
        s = self._parameters(table)
        first = np.searchsorted(self.pair[:, 0], table.own)
        last = np.searchsorted(self.pair[:, 0], table.own, side="right")
        for c in np.unique(table.curve[table.own]).tolist():
            ladder = ResolutionLadder(table.curves[c], tolerance)
            for k in np.flatnonzero(table.curve[table.own] == c).tolist():
                near = slice(int(first[k]), int(last[k]))
                gap = self.gap[near] / table.scale[table.own[k]]
                try:
                    shapes[k] = UnitShape(ladder.curve, ladder.resolution(gap, s[near]))
                except ValueError as fault:
                    raise ValueError(self._named(table, int(table.own[k]), near, fault)) from None
        return [shapes[k] for k in range(len(table.own))]

    def _named(self, table: BodyTable, body: int, near: slice, fault: ValueError) -> str:
        """What no resolution suits, with the bodies it is about."""
        closest = near.start + int(np.argmin(self.gap[near]))
        other = int(self.pair[closest, 1])
        return (
            f"bodies {body} and {other}, at {_place(table, body)} and {_place(table, other)}, at a "
            f"gap of {self.gap[closest]:.3g}: {fault}"
        )

    def _parameters(self, table: BodyTable) -> NDArray:
        """Where on the curve of each pair's first body the nearest point lies, (k,)."""
        s = np.empty(len(self.pair))
        body = self.pair[:, 0]
        for c, curve in enumerate(table.curves):
            rows = np.flatnonzero(table.curve[body] == c)
            if len(rows):
                local = table.to_local(body[rows], self.point[rows])
                _, s[rows] = distance(curve, np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        return s


def _is_sphere(curve: Curve) -> bool:
    return isinstance(curve, Spheroid) and curve.equatorial == curve.polar


def _place(table: BodyTable, number: int) -> str:
    return "({:.4g}, {:.4g}, {:.4g})".format(*table.centre[number])
