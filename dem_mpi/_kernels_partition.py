"""Compiled kernels of the partition: plain arrays in and out.

Symbols: P ranks; splitter s = (splitter_key[s], splitter_gid[s]), s < P - 1, in lexicographic
order; rank r owns every (key, gid) from splitter r - 1 up to, not including, splitter r.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi.morton import LEVELS, MAX_KEY, interleave, lattice_coordinate

MAX_GID = np.iinfo(np.int64).max
_CHILDREN = 8


@jit
def count_not_above(keys, gids, key, gid):
    """How many pairs of the ascending (keys, gids) are <= (key, gid)."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key or (keys[middle] == key and gids[middle] <= gid):
            low = middle + 1
        else:
            high = middle
    return low


@jit
def owners(splitter_key, splitter_gid, keys, gids):
    """The rank (n,) int32 that owns each (key, gid)."""
    owner = np.empty(len(keys), np.int32)
    for b in range(len(keys)):
        owner[b] = count_not_above(splitter_key, splitter_gid, keys[b], gids[b])
    return owner


@jit
def weights_below(keys, gids, weight_before, candidate_key, candidate_gid):
    """Weight of the bodies below each candidate (c,), candidates being (key, gid) pairs.

    keys, gids    : (n,) ascending pairs
    weight_before : (n + 1,) int64, weight of the first i bodies
    """
    below = np.empty(len(candidate_key), np.int64)
    for c in range(len(candidate_key)):
        # Below a pair = not above the pair just before it, gids being integers.
        rows = count_not_above(keys, gids, candidate_key[c], candidate_gid[c] - 1)
        below[c] = weight_before[rows]
    return below


@jit
def find_ghost_targets(
    position, reach, origin, scale, splitter_key, splitter_gid, occupied, rank, cursor, rows
):
    """Visit every rank r != `rank` whose region meets the box position ± reach of a body.

    `rank` = -1 visits all: periodic images go to the rank of their body, too.

    The first pass has empty `rows` and counts: cursor[r] (P,) int64 goes up by the bodies of r.
    The second has cursor[r] at the first free place of r in `rows` and writes body numbers
    there, ascending. `occupied` (P,) bool marks the ranks that own a non-empty interval.

    A region is the union of the lattice cells that its key interval touches. From the smallest
    octree cell around the box the octree is descended where a cell is cut by a splitter and by
    the surface of the box; both being thin, few cells are visited. Returns the number of bodies
    whose key is not in the interval of `rank` (of -1, all).
    """
    strays = 0
    marked = np.full(len(occupied), -1, np.int64)
    stack = np.empty(((LEVELS + 1) * _CHILDREN, 4), np.int64)
    low = np.empty(3, np.int64)
    high = np.empty(3, np.int64)
    for b in range(len(position)):
        key = _key(position, b, origin, scale)
        first, last = _owner_range(splitter_key, splitter_gid, key, key)
        if rank < first or rank > last:
            strays += 1
        _lattice_box(position, reach, b, origin, scale, low, high)
        _common_cell(low, high, stack[0])
        size = 1
        while size > 0:
            size -= 1
            level = stack[size, 0]
            i, j, k = stack[size, 1], stack[size, 2], stack[size, 3]
            first_key = interleave(i, j, k) << (3 * (LEVELS - level))
            last_key = first_key + (MAX_KEY >> (3 * level))
            first, last = _owner_range(splitter_key, splitter_gid, first_key, last_key)
            if first == last or _inside(level, i, j, k, low, high):
                for r in range(first, last + 1):
                    if r != rank and occupied[r] and marked[r] != b:
                        marked[r] = b
                        if len(rows) > 0:
                            rows[cursor[r]] = b
                        cursor[r] += 1
            else:
                size = _push_children(stack, size, level, i, j, k, low, high)
    return strays


@jit
def _key(position, b, origin, scale):
    return interleave(
        lattice_coordinate(position[b, 0], origin[0], scale),
        lattice_coordinate(position[b, 1], origin[1], scale),
        lattice_coordinate(position[b, 2], origin[2], scale),
    )


@jit
def _owner_range(splitter_key, splitter_gid, first_key, last_key):
    """The first and last rank that may own a body with a key in [first_key, last_key]."""
    first = count_not_above(splitter_key, splitter_gid, first_key, 0)
    last = count_not_above(splitter_key, splitter_gid, last_key, MAX_GID)
    return first, last


@jit
def _lattice_box(position, reach, b, origin, scale, low, high):
    """The lattice cells of the corners of position ± reach.

    Lattice coordinates never fall as positions grow, so a body inside the box has its cell
    between the two corners', bodies outside the cube included. One ulp more than the rounded
    corner covers the exact one.
    """
    for axis in range(3):
        x = position[b, axis]
        low[axis] = lattice_coordinate(np.nextafter(x - reach[b], -np.inf), origin[axis], scale)
        high[axis] = lattice_coordinate(np.nextafter(x + reach[b], np.inf), origin[axis], scale)


@jit
def _common_cell(low, high, cell):
    """Write (level, i, j, k) of the smallest octree cell that contains both lattice cells."""
    differing = (low[0] ^ high[0]) | (low[1] ^ high[1]) | (low[2] ^ high[2])
    shift = 0
    while differing >> shift:
        shift += 1
    cell[0] = LEVELS - shift
    for axis in range(3):
        cell[1 + axis] = low[axis] >> shift


@jit
def _inside(level, i, j, k, low, high):
    """Whether the lattice box low..high contains the whole octree cell."""
    shift = LEVELS - level
    for axis, c in enumerate((i, j, k)):
        if (c << shift) < low[axis] or ((c + 1) << shift) - 1 > high[axis]:
            return False
    return True


@jit
def _push_children(stack, size, level, i, j, k, low, high):
    """Put those children of a cell on the stack that meet the lattice box; the new size."""
    shift = LEVELS - level - 1
    for child in range(_CHILDREN):
        ci, cj, ck = 2 * i + (child & 1), 2 * j + (child >> 1 & 1), 2 * k + (child >> 2)
        if (
            low[0] >> shift <= ci <= high[0] >> shift
            and low[1] >> shift <= cj <= high[1] >> shift
            and low[2] >> shift <= ck <= high[2] >> shift
        ):
            stack[size, 0] = level + 1
            stack[size, 1] = ci
            stack[size, 2] = cj
            stack[size, 3] = ck
            size += 1
    return size
