"""Where the unknowns of one rank's bodies stand, and in which frames and units.

The system is solved for unit shapes in the bodies' own frames, so that bodies of one curve and
resolution, of any size and turned anyhow, share their operators, and viscosity drops out. With a
body's scale a, rotation R (columns: its axes in the world) and the viscosity mu,

    velocity        u_local = R^T u                                  [m/s]
    density         rho_local = (a / mu) R^T rho, rho a traction     [m/s]
    motion          (R^T U, a R^T omega)                             [m/s]
    load            (R^T F / (mu a), R^T T / (mu a^2))               [m/s]

Symbols: n nodes and b bodies of this rank; n_s nodes on a meridian, n_theta azimuths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Field(NamedTuple):
    """Values of one rank: unknowns (density, motion) or residuals (velocity, load).

    nodal : (n, 3), body after body in the layout's order, each (n_s, n_theta) in C order
    rigid : (b, 6), translation or force first; None where the motion of the bodies is given
    """

    nodal: NDArray
    rigid: NDArray | None = None


@dataclass(frozen=True)
class Group:
    """Bodies of one curve and resolution, which stand one after another.

    shape  : number of the curve and resolution in the suspension's list of shapes
    bodies : rows of these bodies, nodes : rows of their nodes
    grid   : (n_s, n_theta)
    """

    shape: int
    bodies: slice
    nodes: slice
    grid: tuple[int, int]

    @property
    def count(self) -> int:
        """Number of bodies."""
        return self.bodies.stop - self.bodies.start

    def view(self, nodal: NDArray) -> NDArray:
        """The group's rows of an array (n, k) as (count, n_s, n_theta, k), without copying."""
        return nodal[self.nodes].reshape(self.count, *self.grid, *nodal.shape[1:])

    def columns(self, nodal: NDArray) -> NDArray:
        """The group's rows of (n, k) as right-hand sides (n_s, n_theta, k, count)."""
        return np.moveaxis(self.view(nodal), 0, -1)

    def put(self, nodal: NDArray, columns: NDArray) -> None:
        """Write right-hand sides (n_s, n_theta, k, count) into the group's rows of (n, k)."""
        self.view(nodal)[...] = np.moveaxis(columns, -1, 0)


@dataclass(frozen=True)
class Layout:
    """Order of this rank's bodies, grouped by shape.

    order   : (b,) this rank's bodies as given, in the order of the rows
    offsets : (b + 1,) first node of each body, in the order of the rows
    """

    order: NDArray
    offsets: NDArray
    groups: tuple[Group, ...]

    @classmethod
    def of_shapes(cls, shape: Sequence[int], grids: Sequence[tuple[int, int]]) -> Layout:
        """Group bodies by shape (b,); `grids[k]` is (n_s, n_theta) of shape k."""
        number = np.asarray(shape, dtype=np.int64)
        order = np.argsort(number, kind="stable")
        sorted_number = number[order]
        sizes = np.array([grids[k][0] * grids[k][1] for k in sorted_number], dtype=np.int64)
        offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        groups = []
        for k in np.unique(sorted_number).tolist():
            first, last = np.searchsorted(sorted_number, [k, k + 1]).tolist()
            nodes = slice(int(offsets[first]), int(offsets[last]))
            groups.append(Group(k, slice(first, last), nodes, tuple(grids[k])))
        return cls(order, offsets, tuple(groups))

    @property
    def bodies(self) -> int:
        """Number of bodies of this rank."""
        return len(self.order)

    @property
    def nodes(self) -> int:
        """Number of nodes of this rank."""
        return int(self.offsets[-1])

    @property
    def body_of_node(self) -> NDArray:
        """Row of the body that each node belongs to (n,)."""
        return np.repeat(np.arange(self.bodies), np.diff(self.offsets))

    @property
    def rows(self) -> NDArray:
        """Row (b,) of each body as given: the inverse of `order`."""
        rows = np.empty_like(self.order)
        rows[self.order] = np.arange(self.bodies)
        return rows

    def range_of(self, row: int) -> NDArray:
        """Nodes of the body in this row, one after another."""
        return np.arange(self.offsets[row], self.offsets[row + 1])


@dataclass(frozen=True)
class Packing:
    """Fields as the flat vectors of an iteration.

    velocity_weight : (n, 1), load_weight : (b, 6) that residuals are multiplied by: their Euclidean
                      norm is then the wanted one; unknowns stay as they are
    free            : whether fields have a rigid part
    """

    velocity_weight: NDArray
    load_weight: NDArray
    free: bool

    def residual_vector(self, residual: Field) -> NDArray:
        """Weighted velocities and loads, one after another."""
        parts = [self.velocity_weight * residual.nodal]
        if self.free:
            parts.append(self.load_weight * residual.rigid)
        return np.concatenate([part.ravel() for part in parts])

    def residual(self, vector: NDArray) -> Field:
        """The residual of a vector, weights taken off."""
        weighted = self.unknown(vector)
        nodal = weighted.nodal / self.velocity_weight
        return Field(nodal, weighted.rigid / self.load_weight if self.free else None)

    def unknown_vector(self, unknown: Field) -> NDArray:
        """Densities and motions, one after another."""
        parts = [unknown.nodal, unknown.rigid] if self.free else [unknown.nodal]
        return np.concatenate([part.ravel() for part in parts])

    def unknown(self, vector: NDArray) -> Field:
        """Views of the densities and motions in a vector."""
        end = 3 * len(self.velocity_weight)
        rigid = vector[end:].reshape(-1, 6) if self.free else None
        return Field(vector[:end].reshape(-1, 3), rigid)
