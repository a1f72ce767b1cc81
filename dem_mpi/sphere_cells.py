"""Spheres in linked lists of cells: whether a place is free is answered from 27 cells.

Cells are at least as wide as two spheres that touch are apart. A block of cells has one layer of
cells around it, whose spheres belong to neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi import _kernels_placement as kernels


@dataclass(frozen=True)
class CellGrid:
    """A box in equal cells. low : (3,) corner [m]; cell : (3,) edges [m]; shape : (3,) int64."""

    low: NDArray[np.float64]
    cell: NDArray[np.float64]
    shape: NDArray[np.int64]

    @classmethod
    def covering(cls, low: ArrayLike, high: ArrayLike, edge: float, most: float) -> CellGrid:
        """Divide the box low..high (3,) [m] into cells no narrower than `edge` [m].

        They are wider where there would be more than about `most` of them; a box thinner than
        `edge` has one layer.
        """
        low, extent = np.array(low, dtype=float), np.subtract(high, low).astype(float)
        # Room for the rounding of cell coordinates.
        edge = max(edge * (1.0 + 1e-9), math.cbrt(float(np.prod(extent)) / max(most, 1.0)))
        shape = np.maximum(1, np.floor(extent / edge)).astype(np.int64)
        return cls(low, extent / shape, shape)

    def coordinate(self, position: NDArray) -> NDArray[np.int64]:
        """Cell coordinates (..., 3) of `position` (..., 3) [m]; outside the box the nearest cell.

        Clipping brings no two spheres into cells further apart than they were.
        """
        inside = np.floor((position - self.low) / self.cell)
        return np.clip(inside, 0, self.shape - 1).astype(np.int64)


class LinkedSpheres:
    """Spheres in the cells of a block, one layer of cells around it included.

    head : first sphere of each cell or -1; following : the next one; spheres : rows x, y, z,
    reach [m], of which `count` are used.
    """

    def __init__(self, first: ArrayLike, shape: ArrayLike, capacity: int = 0) -> None:
        """Take the block of `shape` (3,) cells whose lowest cell is `first` (3,)."""
        self.first = np.array(first, dtype=np.int64)
        self.shape = np.array(shape, dtype=np.int64)
        _, ny, nz = (int(n) + 2 for n in self.shape)
        self.strides = (ny * nz, nz)
        self.head = np.full((int(self.shape[0]) + 2) * ny * nz, -1, dtype=np.int64)
        self.following = np.empty(capacity, dtype=np.int64)
        self.spheres = np.empty((capacity, 4))
        self.count = 0

    @classmethod
    def of(cls, grid: CellGrid, spheres: NDArray) -> LinkedSpheres:
        """Put `spheres` (n, 4) into all cells of a grid."""
        linked = cls(np.zeros(3), grid.shape, len(spheres))
        linked.add(grid.coordinate(spheres[:, :3]), spheres)
        return linked

    def cell(self, coordinate: NDArray) -> NDArray[np.int64]:
        """Numbers (...,) of the cells at `coordinate` (..., 3), which lie in the block or at it."""
        local = coordinate - self.first + 1
        return local[..., 0] * self.strides[0] + local[..., 1] * self.strides[1] + local[..., 2]

    def add(self, coordinate: NDArray, spheres: NDArray) -> None:
        """Append spheres (n, 4) that lie in the cells at `coordinate` (n, 3)."""
        self.reserve(len(spheres))
        self.spheres[self.count : self.count + len(spheres)] = spheres
        kernels.link(self.cell(coordinate), self.count, self.head, self.following)
        self.count += len(spheres)

    def reserve(self, more: int) -> None:
        """Make room for so many spheres more."""
        needed = self.count + more
        if needed > len(self.following):
            capacity = max(needed, 2 * len(self.following))
            following, spheres = np.empty(capacity, np.int64), np.empty((capacity, 4))
            following[: self.count] = self.following[: self.count]
            spheres[: self.count] = self.spheres[: self.count]
            self.following, self.spheres = following, spheres
