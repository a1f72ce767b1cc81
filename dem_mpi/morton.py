"""Morton keys: cells of an octree over a cube, numbered along a space-filling curve.

The cube is cut into 2^21 lattice cells along each axis. A key interleaves the three lattice
coordinates, x lowest: bit 3b + a of the key is bit b of axis a. A cell of octree level L (0 the
cube, 21 a lattice cell) holds a contiguous range of 8^(21-L) keys.
(G. M. Morton, IBM technical report, 1966.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi._jit import jit

LEVELS = 21
LATTICE_SIZE = 1 << LEVELS
MAX_KEY = (1 << 3 * LEVELS) - 1


def encode(position: NDArray, origin: ArrayLike, edge: float) -> NDArray[np.int64]:
    """Keys (n,) in [0, 2^63) of `position` (n, 3) [m] in the cube at `origin` (3,) of `edge` [m].

    A point outside the cube gets the key of the nearest cell of the cube.
    """
    points = np.ascontiguousarray(position, dtype=np.float64)
    corner = np.ascontiguousarray(origin, dtype=np.float64)
    return _encode(points, corner, LATTICE_SIZE / float(edge))


def decode(key: NDArray) -> NDArray[np.int64]:
    """Lattice coordinates (n, 3) in [0, 2^21) of keys (n,)."""
    return _decode(np.ascontiguousarray(key, dtype=np.int64))


@jit
def lattice_coordinate(x: float, origin: float, scale: float) -> int:
    """⌊(x - origin) scale⌋ brought into [0, 2^21). Never falls as x grows; 0 for a NaN."""
    cell = (x - origin) * scale
    if not cell > 0.0:
        return 0
    if cell >= LATTICE_SIZE:
        return LATTICE_SIZE - 1
    return int(cell)


@jit
def interleave(i: int, j: int, k: int) -> int:
    """The key of lattice cell (i, j, k), each in [0, 2^21)."""
    return _spread(i) | (_spread(j) << 1) | (_spread(k) << 2)


@jit
def _spread(x):
    """Move bit b of a 21-bit number to bit 3b."""
    x = (x | (x << 32)) & 0x001F00000000FFFF
    x = (x | (x << 16)) & 0x001F0000FF0000FF
    x = (x | (x << 8)) & 0x100F00F00F00F00F
    x = (x | (x << 4)) & 0x10C30C30C30C30C3
    return (x | (x << 2)) & 0x1249249249249249


@jit
def _gather(x):
    """Move bit 3b to bit b, the inverse of `_spread`."""
    x = x & 0x1249249249249249
    x = (x | (x >> 2)) & 0x10C30C30C30C30C3
    x = (x | (x >> 4)) & 0x100F00F00F00F00F
    x = (x | (x >> 8)) & 0x001F0000FF0000FF
    x = (x | (x >> 16)) & 0x001F00000000FFFF
    return (x | (x >> 32)) & 0x00000000001FFFFF


@jit
def _encode(position, origin, scale):
    key = np.empty(len(position), np.int64)
    for b in range(len(position)):
        i = lattice_coordinate(position[b, 0], origin[0], scale)
        j = lattice_coordinate(position[b, 1], origin[1], scale)
        k = lattice_coordinate(position[b, 2], origin[2], scale)
        key[b] = interleave(i, j, k)
    return key


@jit
def _decode(key):
    cell = np.empty((len(key), 3), np.int64)
    for b in range(len(key)):
        for axis in range(3):
            cell[b, axis] = _gather(key[b] >> axis)
    return cell
