"""Bodies of all ranks, as every rank knows them: some hundred bytes of each.

Bodies stay on the rank that brought them. They are numbered rank after rank, in the order in which
each rank has them.

Symbols: B bodies of all ranks, b of this one, P ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dem_mpi.morton import encode
from dem_mpi.parallel import Parallel
from stokes.geometry import Body, Curve


@dataclass(frozen=True)
class BodyTable:
    """Where all bodies are, and which are this rank's.

    curves     : distinct generating curves, in the same order on all ranks
    curve      : (B,) number of each body's
    scale (B,), centre (B, 3), quaternion (B, 4) : of `Body`
    first      : (P + 1,) number of each rank's first body
    rank       : of this process
    """

    curves: tuple[Curve, ...]
    curve: NDArray
    scale: NDArray
    centre: NDArray
    quaternion: NDArray
    first: NDArray
    rank: int

    @classmethod
    def gather(cls, bodies: Sequence[Body], parallel: Parallel) -> BodyTable:
        """Collective. The table of the bodies that the ranks bring."""
        distinct = tuple(dict.fromkeys(body.curve for body in bodies))
        number = {curve: k for k, curve in enumerate(distinct)}
        mine = (
            distinct,
            np.array([number[body.curve] for body in bodies], dtype=np.int64),
            np.array([(body.scale, *body.centre, *body.quaternion) for body in bodies]),
        )
        parts = parallel.broadcast(parallel.gather(mine))
        curves = tuple(dict.fromkeys(curve for part in parts for curve in part[0]))
        number = {curve: k for k, curve in enumerate(curves)}
        renumbered = [
            np.array([number[c] for c in part[0]], dtype=np.int64)[part[1]] for part in parts
        ]
        values = np.concatenate([part[2].reshape(-1, 8) for part in parts])
        counts = [len(part[1]) for part in parts]
        return cls(
            curves=curves,
            curve=np.concatenate(renumbered),
            scale=values[:, 0],
            centre=values[:, 1:4],
            quaternion=values[:, 4:],
            first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            rank=parallel.rank,
        )

    @property
    def count(self) -> int:
        """Number B of all bodies."""
        return len(self.curve)

    @property
    def own(self) -> NDArray:
        """Numbers (b,) of this rank's bodies."""
        return np.arange(self.first[self.rank], self.first[self.rank + 1])

    def owner(self, number: NDArray) -> NDArray:
        """Ranks that have the bodies of these numbers."""
        return np.searchsorted(self.first, number, side="right") - 1

    def body(self, number: int) -> Body:
        """The body of this number."""
        return Body(
            self.curves[self.curve[number]],
            float(self.scale[number]),
            tuple(self.centre[number].tolist()),
            tuple(self.quaternion[number].tolist()),
        )

    @property
    def bounding_radius(self) -> NDArray:
        """Radii (B,) of balls about the centres that hold the bodies."""
        radius = np.array([curve.bounding_radius for curve in self.curves])
        return radius[self.curve] * self.scale if self.count else np.empty(0)

    def pairs(self, radius: NDArray, other_radius: NDArray | None = None) -> NDArray:
        """Pairs (k, 2) of a body of this rank and another of any rank, in rising order.

        Those whose balls of `radius` (B,) about the first's and `other_radius` (default: the same)
        about the second's centre overlap.
        """
        mine = self.own
        if len(mine) == 0 or self.count < 2:
            return np.empty((0, 2), dtype=np.int64)
        other_radius = radius if other_radius is None else other_radius
        found = cKDTree(self.centre).query_ball_point(
            self.centre[mine], radius[mine] + other_radius.max(), return_sorted=True
        )
        other = np.concatenate([np.asarray(f, dtype=np.int64) for f in found])
        body = np.repeat(mine, [len(f) for f in found])
        distance = np.linalg.norm(self.centre[body] - self.centre[other], axis=1)
        near = (distance < radius[body] + other_radius[other]) & (body != other)
        return np.stack([body[near], other[near]], axis=1)

    def to_local(self, number: NDArray, points: NDArray) -> NDArray:
        """World points (k, 3) in the frames of the unit shapes of bodies (k,)."""
        turn = Rotation.from_quat(self.quaternion[number][:, [1, 2, 3, 0]])
        return turn.inv().apply(points - self.centre[number]) / self.scale[number, None]

    def turned(self, quaternion: NDArray, parallel: Parallel) -> BodyTable:
        """Collective. The table with other orientations (b, 4) of this rank's bodies."""
        parts = parallel.broadcast(parallel.gather(quaternion))
        return replace(self, quaternion=np.concatenate([q.reshape(-1, 4) for q in parts]))


def quaternions_to(axis: NDArray) -> NDArray:
    """Unit quaternions (k, 4), scalar first, that turn z to unit vectors (k, 3) the short way."""
    half = np.stack([1.0 + axis[:, 2], -axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    length = np.linalg.norm(half, axis=1)
    opposite = length < 1e-7
    half[opposite] = (0.0, 1.0, 0.0, 0.0)
    return half / np.where(opposite, 1.0, length)[:, None]


def distribute(bodies: Sequence[Body], parallel: Parallel | None = None) -> list[Body]:
    """The share of this rank of bodies that all ranks know: neighbours in space stay together.

    The bodies are ordered along a Morton curve through their centres and cut into shares of equal
    numbers; with fewer bodies than ranks some shares are empty.
    """
    parallel = parallel or Parallel.alone()
    count, rank, size = len(bodies), parallel.rank, parallel.size
    if count == 0:
        return []
    centre = np.array([body.centre for body in bodies])
    origin = centre.min(axis=0)
    edge = float(np.max(centre.max(axis=0) - origin)) or 1.0
    order = np.argsort(encode(centre, origin, edge), kind="stable")
    share = order[count * rank // size : count * (rank + 1) // size]
    return [bodies[k] for k in share.tolist()]
