"""Compiled loops of the octree: cutting boxes into octants and linking a table of boxes.

Keys are Morton keys of 21 lattice levels; a box of level L is named by the key of its first
lattice cell and holds the 8^(21-L) keys from there on.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi.morton import LEVELS

UNSORTED, UNALIGNED, ORPHAN = 1, 2, 3


@jit
def bounds_of_ranges(source_keys, target_keys, sources, targets):
    """First and last key (k, 2) among the points of each of k boxes, none of which is empty."""
    bounds = np.empty((len(sources), 2), np.int64)
    for b in range(len(sources)):
        first, last = np.int64(np.iinfo(np.int64).max), np.int64(-1)
        if sources[b, 0] < sources[b, 1]:
            first = source_keys[sources[b, 0]]
            last = source_keys[sources[b, 1] - 1]
        if targets[b, 0] < targets[b, 1]:
            first = min(first, target_keys[targets[b, 0]])
            last = max(last, target_keys[targets[b, 1] - 1])
        bounds[b, 0], bounds[b, 1] = first, last
    return bounds


@jit
def split_level(level, key, sources, targets, split, source_keys, target_keys):
    """Children that hold points, in the order of their keys: key, sources (k, 2), targets (k, 2).

    `level` is that of the boxes split, of which `split` marks some.
    """
    room = 8 * np.sum(split)
    child_key = np.empty(room, np.int64)
    child_sources = np.empty((room, 2), np.int32)
    child_targets = np.empty((room, 2), np.int32)
    stride = np.int64(1) << (3 * (LEVELS - 1 - level))
    used = 0
    for b in range(len(key)):
        if not split[b]:
            continue
        source, target = sources[b, 0], targets[b, 0]
        for octant in range(8):
            first = key[b] + octant * stride
            source_end, target_end = sources[b, 1], targets[b, 1]
            if octant < 7:  # the end of the last octant of the root would overflow
                source_end = _lower_bound(source_keys, source, source_end, first + stride)
                target_end = _lower_bound(target_keys, target, target_end, first + stride)
            if source < source_end or target < target_end:
                child_key[used] = first
                child_sources[used, 0], child_sources[used, 1] = source, source_end
                child_targets[used, 0], child_targets[used, 1] = target, target_end
                used += 1
            source, target = source_end, target_end
    return child_key[:used], child_sources[:used], child_targets[:used]


@jit
def _lower_bound(key, start, end, value):
    """The first place in [start, end) whose key is at least `value`, else `end`."""
    while start < end:
        middle = (start + end) // 2
        if key[middle] < value:
            start = middle + 1
        else:
            end = middle
    return start


@jit
def link(level, key, parent, children):
    """Fill parent (nb,) and children (nb, 8) of boxes sorted by (level, key).

    Returns (0, 0), or the kind of fault of the table and the box that has it.
    """
    above = 0  # the next candidate for a parent: both sequences are sorted, so it only moves on
    for b in range(len(key)):
        if key[b] & ((np.int64(1) << (3 * (LEVELS - level[b]))) - 1) != 0 and level[b] > 0:
            return UNALIGNED, b
        if b == 0:
            continue
        if level[b] < level[b - 1] or (level[b] == level[b - 1] and key[b] <= key[b - 1]):
            return UNSORTED, b
        shift = 3 * (LEVELS - level[b])
        wanted = (key[b] >> (shift + 3)) << (shift + 3)
        while above < b and (
            level[above] < level[b] - 1 or (level[above] == level[b] - 1 and key[above] < wanted)
        ):
            above += 1
        if above == b or level[above] != level[b] - 1 or key[above] != wanted:
            return ORPHAN, b
        parent[b] = above
        children[above, (key[b] >> shift) & 7] = b
    return 0, 0
