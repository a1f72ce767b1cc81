"""Compiled loops of the distribution: plain arrays in and out, no messages.

Symbols: P ranks; n points, each with a Morton key and a global index; nb boxes of a local table.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi.morton import LEVELS, interleave


@jit
def _count_below(keys, indices, key, index):
    """How many pairs of the rising (keys, indices) are less than (key, index)."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key or (keys[middle] == key and indices[middle] < index):
            low = middle + 1
        else:
            high = middle
    return low


@jit
def counts_below(keys, indices, candidate_key, candidate_index):
    """How many of the rising pairs (keys, indices) (n,) are less than each candidate (c,)."""
    below = np.empty(len(candidate_key), np.int64)
    for c in range(len(candidate_key)):
        below[c] = _count_below(keys, indices, candidate_key[c], candidate_index[c])
    return below


@jit
def owners(splitter_key, splitter_index, keys, first_index):
    """The rank (n,) of each point of key (n,) and global index first_index, first_index + 1, ...

    Rank r owns the pairs from splitter r - 1 up to, not including, splitter r.
    """
    owner = np.empty(len(keys), np.int32)
    for b in range(len(keys)):
        # not above a pair = below the next pair, indices being integers
        owner[b] = _count_below(splitter_key, splitter_index, keys[b], first_index + b + 1)
    return owner


@jit
def take_transposed(rows, order, columns):
    """columns[:, i] = rows[order[i]]: rows (n, c) into columns (c, m), order (m,)."""
    for i in range(len(order)):
        row = order[i]
        for c in range(rows.shape[1]):
            columns[c, i] = rows[row, c]


@jit
def put_transposed(columns, order, rows):
    """rows[order[i]] = columns[:, i]: columns (c, m) into rows (n, c), order (m,)."""
    for i in range(len(order)):
        row = order[i]
        for c in range(rows.shape[1]):
            rows[row, c] = columns[c, i]


@jit
def needed_children(
    level, cell, parent, leaf, source_count, direct_below, region_low, region_high, own_region
):
    """The regions that need the children of each box, as CSR: start (nb + 1,), region (start[nb],).

    Region g needs them if it meets the 27 cells about the box, or if it needs the box itself and
    the box has at most `direct_below` sources (its leaves may be summed directly).

    level, parent, leaf, source_count (nb,), cell (nb, 3): a table of boxes, parents first
    region_low, region_high (G,): first and last key of the regions, both rising
    own_region: the region to leave out, -1 for none
    """
    start = np.zeros(len(level) + 1, np.int64)
    region = np.empty(max(16, len(level)), np.int32)
    marked = np.full(len(region_low), -1, np.int64)
    for b in range(len(level)):
        used = start[b]
        start[b + 1] = used
        if leaf[b]:
            continue
        if used + len(region_low) > len(region):
            longer = np.empty(2 * len(region) + len(region_low), np.int32)
            longer[:used] = region[:used]
            region = longer
        _mark_about(level[b], cell[b], region_low, region_high, marked, b)
        above = parent[b]
        if above >= 0 and source_count[b] <= direct_below:
            for k in range(start[above], start[above + 1]):
                marked[region[k]] = b
        first, end = 0, len(region_low)
        if above >= 0:
            first, end = _span(start, region, above)
        for g in range(first, end):
            if marked[g] == b and g != own_region:
                region[used] = g
                used += 1
        start[b + 1] = used
    return start, region[: start[len(level)]]


@jit
def _span(start, region, above):
    """The range of regions that those of a child of box `above` lie in: a part of its own."""
    if start[above] == start[above + 1]:
        return 0, 0
    return region[start[above]], region[start[above + 1] - 1] + 1


@jit
def _mark_about(level, cell, region_low, region_high, marked, mark):
    """Mark the regions that meet a cell of a level or one of its 26 neighbours."""
    size = np.int64(1) << level
    shift = 3 * (LEVELS - level)
    last = (np.int64(1) << shift) - 1 if level > 0 else np.int64(np.iinfo(np.int64).max)
    for i in range(max(cell[0] - 1, 0), min(cell[0] + 2, size)):
        for j in range(max(cell[1] - 1, 0), min(cell[1] + 2, size)):
            for k in range(max(cell[2] - 1, 0), min(cell[2] + 2, size)):
                low = interleave(i, j, k) << shift
                g = np.searchsorted(region_high, low)
                while g < len(region_low) and region_low[g] <= low + last:
                    marked[g] = mark
                    g += 1
