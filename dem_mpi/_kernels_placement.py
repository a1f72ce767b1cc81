"""Compiled kernels of the placement: counter-based random numbers, and spheres in linked cells.

Random numbers are words of Philox 4x64-10 (J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw,
SC 2011), a function of a key and a counter alone: whoever needs a number makes it, in any order.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi._kernels_walls import may_touch, sphere_wall

_LOW_HALF, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)
_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_UNIT, _SHIFT = 2.0**-53, np.uint64(11)
_ROUNDS = 10
_TOUCHING = 1e-9  # of a radius: to reach into a wall by less is rounding


@jit
def _high_word(a, b):
    """The upper 64 bits of the 128-bit product of two 64-bit words."""
    a_low, a_high = a & _LOW_HALF, a >> _HALF
    b_low, b_high = b & _LOW_HALF, b >> _HALF
    middle = a_high * b_low + ((a_low * b_low) >> _HALF)
    carry = a_low * b_high + (middle & _LOW_HALF)
    return a_high * b_high + (middle >> _HALF) + (carry >> _HALF)


@jit
def philox(c0, c1, c2, c3, k0, k1):
    """The four words of counter (c0, c1, c2, c3) under key (k0, k1), all uint64."""
    for _ in range(_ROUNDS):
        high0, high1 = _high_word(_M0, c0), _high_word(_M1, c2)
        low0, low1 = _M0 * c0, _M1 * c2
        c0, c1, c2, c3 = high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0
        k0 += _W0
        k1 += _W1
    return c0, c1, c2, c3


@jit
def uniform_numbers(key, index, second, third, stream, blocks, out):
    """Fill out (n, 4 blocks) with uniform numbers in [0, 1).

    Row i comes from the counters (blocks index[i] + 1 + b, second, third, stream), b < blocks:
    with second = third = stream = 0 that is the sequence of numpy's Philox(key) from word
    4 blocks index[i] on, whose first counter is 1.
    """
    k0, k1 = np.uint64(key[0]), np.uint64(key[1])
    c1, c2, c3 = np.uint64(second), np.uint64(third), np.uint64(stream)
    for i in range(len(index)):
        for b in range(blocks):
            c0 = np.uint64(blocks) * np.uint64(index[i]) + np.uint64(b + 1)
            words = philox(c0, c1, c2, c3, k0, k1)
            for w in range(4):
                out[i, 4 * b + w] = np.float64(words[w] >> _SHIFT) * _UNIT


@jit
def link(cell, first, head, following):
    """Put the spheres first, first + 1, ... into the lists of their cells (n,)."""
    for i in range(len(cell)):
        following[first + i] = head[cell[i]]
        head[cell[i]] = first + i


@jit
def is_free(x, y, z, reach, gap, cell, stride_x, stride_y, head, following, spheres):
    """Whether no sphere in the cell or around it is closer than `gap` to the sphere at x, y, z."""
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                s = head[cell + dx * stride_x + dy * stride_y + dz]
                while s >= 0:
                    apart = reach + spheres[s, 3] + gap
                    a, b, c = x - spheres[s, 0], y - spheres[s, 1], z - spheres[s, 2]
                    if a * a + b * b + c * c < apart * apart:
                        return False
                    s = following[s]
    return True


@jit
def find_blocked(candidate, reach, cell, strides, head, following, spheres, blocked):
    """Mark in blocked (b, k) uint8 the candidates (b, k, 3) that overlap a sphere.

    reach (b,) is that of the b bodies, cell (b, k) where their k candidates lie.
    """
    for b in range(candidate.shape[0]):
        for k in range(candidate.shape[1]):
            x, y, z = candidate[b, k]
            blocked[b, k] = not is_free(
                x, y, z, reach[b], 0.0, cell[b, k], strides[0], strides[1], head, following,
                spheres,
            )  # fmt: skip


@jit
def block_at_walls(candidate, reach, face, blocked):
    """Mark in blocked (b, k) uint8 the candidates (b, k, 3) that reach into a wall.

    reach (b,) is that of the b bodies; face (w, 22) rows of `Walls.rows`.
    """
    for b in range(candidate.shape[0]):
        limit = -_TOUCHING * reach[b]
        for k in range(candidate.shape[1]):
            x, y, z = candidate[b, k]
            for f in range(face.shape[0]):
                if blocked[b, k]:
                    break
                if may_touch(face, f, x, y, z, reach[b], limit):
                    near, far = sphere_wall(face, f, x, y, z, reach[b])
                    blocked[b, k] = near[0] < limit or far[0] < limit


@jit
def accept_in_order(
    candidate, reach, queue, blocked, cell, strides, head, following, spheres, chosen
):
    """Choose for each body its first candidate that is not blocked and clear of those chosen.

    Within a queue (b,) a body that finds no place holds up those behind it. chosen (b,) becomes
    the number of the candidate, or -1. The lists of cells are empty before.
    """
    held = np.zeros(queue.max() + 1 if len(queue) else 0, np.bool_)
    count = 0
    for b in range(candidate.shape[0]):
        chosen[b] = -1
        if held[queue[b]]:
            continue
        for k in range(candidate.shape[1]):
            if blocked[b, k]:
                continue
            x, y, z = candidate[b, k]
            if is_free(
                x, y, z, reach[b], 0.0, cell[b, k], strides[0], strides[1], head, following,
                spheres,
            ):  # fmt: skip
                spheres[count, 0], spheres[count, 1], spheres[count, 2] = x, y, z
                spheres[count, 3] = reach[b]
                following[count] = head[cell[b, k]]
                head[cell[b, k]] = count
                count += 1
                chosen[b] = k
                break
        held[queue[b]] = chosen[b] < 0


@jit
def visit_cells(
    visitor, reach, coordinate, order, key, purpose, gap, attempts,
    low, cell, region_low, region_high, first, strides, used, head, following, spheres, count,
    placed,
):  # fmt: skip
    """Let visitors try random places in their cells, one after another in `order`.

    visitor (v, 3) is scratch for the place found, reach (v,) [m], coordinate (v, 3) of the cell in
    the whole grid. Attempt t of a cell has the counter (number of the cell, t); used (cells,)
    counts a cell's attempts. Places are inside the cell and keep `reach` from the faces of the
    region. Who finds one is linked as sphere `count` and following; placed (v,) is marked. Returns
    the new count.
    """
    k0, k1, zero = np.uint64(key[0]), np.uint64(key[1]), np.uint64(0)
    inner = np.empty(3)
    width = np.empty(3)
    for v in order:
        i, j, k = coordinate[v]
        c = (i - first[0] + 1) * strides[0] + (j - first[1] + 1) * strides[1] + k - first[2] + 1
        number = (np.uint64(i) << np.uint64(42)) | (np.uint64(j) << np.uint64(21)) | np.uint64(k)
        for axis in range(3):
            start = low[axis] + coordinate[v, axis] * cell[axis]
            inner[axis] = max(start, region_low[axis] + reach[v])
            width[axis] = max(min(start + cell[axis], region_high[axis] - reach[v]), inner[axis])
            width[axis] -= inner[axis]
        for _ in range(attempts):
            words = philox(number, np.uint64(used[c]), zero, np.uint64(purpose), k0, k1)
            used[c] += 1
            x = inner[0] + width[0] * np.float64(words[0] >> _SHIFT) * _UNIT
            y = inner[1] + width[1] * np.float64(words[1] >> _SHIFT) * _UNIT
            z = inner[2] + width[2] * np.float64(words[2] >> _SHIFT) * _UNIT
            if is_free(x, y, z, reach[v], gap, c, strides[0], strides[1], head, following, spheres):
                visitor[v, 0], visitor[v, 1], visitor[v, 2] = x, y, z
                spheres[count, 0], spheres[count, 1], spheres[count, 2] = x, y, z
                spheres[count, 3] = reach[v]
                following[count] = head[c]
                head[c] = count
                count += 1
                placed[v] = True
                break
    return count
