"""Compiled walks over the octree. Rows belong to target boxes, entries are source boxes.

Boxes come in the order of their levels, so that a parent's rows are complete before its
children's are written behind them.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

MAX_COLLEAGUES = 27
MAX_FAR = 8 * MAX_COLLEAGUES
# A depth-first walk leaves at most 7 boxes waiting on each of 21 levels.
STACK_SIZE = 8 * 21


@jit
def mark_ancestors(parent, wanted):
    """Mark, in place, the ancestors of marked boxes."""
    for b in range(len(parent) - 1, 0, -1):
        if wanted[b]:
            wanted[parent[b]] = True


@jit
def same_level(parent, children, leaf, cell, source_count, wanted, smooth, counted, opened):
    """Pairs of boxes of one level: colleague_start, colleague, far_start, far, vector.

    Colleagues are the source boxes that touch the target box or are it; far ones are the other
    children of the parent's colleagues. With `smooth`, a touching pair with a leaf in it is far.
    With `counted`, far and vector are left empty; far_start is that of the pairs there would be.
    Sets `opened` of source boxes whose children were looked at.
    """
    n = len(parent)
    colleague_start, colleague = np.zeros(n + 1, np.int64), np.empty(1024, np.int32)
    far_start, far = np.zeros(n + 1, np.int64), np.empty(1024, np.int32)
    vector = np.empty(1024, np.int16)
    near_end, far_end = 0, 0
    if wanted[0] and source_count[0] > 0:
        if smooth and leaf[0]:
            if not counted:
                far[0], vector[0] = 0, _vector(0, 0, 0)
            far_end = 1
        else:
            colleague[0] = 0
            near_end = 1
    colleague_start[1], far_start[1] = near_end, far_end
    for b in range(1, n):
        if wanted[b]:
            colleague = _with_room(colleague, near_end, MAX_COLLEAGUES)
            if not counted:
                far = _with_room(far, far_end, MAX_FAR)
                vector = _with_room(vector, far_end, MAX_FAR)
            for i in range(colleague_start[parent[b]], colleague_start[parent[b] + 1]):
                s = colleague[i]
                if leaf[s]:
                    continue
                opened[s] = True
                x = cell[b, 0] - 2 * cell[s, 0]
                y = cell[b, 1] - 2 * cell[s, 1]
                z = cell[b, 2] - 2 * cell[s, 2]
                for octant in range(8):
                    c = children[s, octant]
                    if c < 0 or source_count[c] == 0:
                        continue
                    dx, dy, dz = x - (octant & 1), y - (octant >> 1 & 1), z - (octant >> 2)
                    touch = (abs(dx) <= 1) & (abs(dy) <= 1) & (abs(dz) <= 1)
                    if touch and not (smooth and (leaf[b] or leaf[c])):
                        colleague[near_end] = c
                        near_end += 1
                    else:
                        if not counted:
                            far[far_end], vector[far_end] = c, _vector(dx, dy, dz)
                        far_end += 1
        colleague_start[b + 1], far_start[b + 1] = near_end, far_end
    stored = 0 if counted else far_end
    return (
        colleague_start,
        colleague[:near_end].copy(),
        far_start,
        far[:stored].copy(),
        vector[:stored].copy(),
    )


@jit
def coarser(
    level, parent, leaf, cell, target_count, wanted, direct_below, colleague_start, colleague
):
    """Pairs of a target box and a larger source leaf: near_start, near, local_start, local.

    Near leaves touch the target box, or it has fewer targets than `direct_below`: the leaves
    under it sum them directly. The others come to its local expansion (X).
    """
    n = len(parent)
    near_start, near = np.zeros(n + 1, np.int64), np.empty(1024, np.int32)
    local_start, local = np.zeros(n + 1, np.int64), np.empty(1024, np.int32)
    near_end, local_end = 0, 0
    for b in range(1, n):
        near_start[b], local_start[b] = near_end, local_end
        if not wanted[b]:
            continue
        p = parent[b]
        inherited = near_start[p + 1] - near_start[p]
        candidates = inherited + colleague_start[p + 1] - colleague_start[p]
        near = _with_room(near, near_end, candidates)
        local = _with_room(local, local_end, candidates)
        for i in range(candidates):
            if i < inherited:
                s = near[near_start[p] + i]
            else:
                s = colleague[colleague_start[p] + i - inherited]
                if not leaf[s]:
                    continue
            if target_count[b] < direct_below or _touch(level, cell, b, s):
                near[near_end] = s
                near_end += 1
            else:
                local[local_end] = s
                local_end += 1
    near_start[n], local_start[n] = near_end, local_end
    return near_start, near[:near_end].copy(), local_start, local[:local_end].copy()


@jit
def leaf_rows(
    level, children, leaf, cell, source_count, wanted, direct_below, colleague_start, colleague,
    coarse_start, coarse, opened,
):  # fmt: skip
    """Pairs of a target leaf: near_start, near, target_start, target.

    Near (U) are the `coarse` leaves and, among the colleagues and all under them, the leaves that
    touch the target leaf. A box under a colleague that does not touch it comes by its multipole
    (W), or its leaves do directly where it has fewer sources than `direct_below`.
    """
    n = len(level)
    near_start, near = np.zeros(n + 1, np.int64), np.empty(1024, np.int32)
    target_start, target = np.zeros(n + 1, np.int64), np.empty(1024, np.int32)
    near_end, target_end = 0, 0
    stack = np.empty(STACK_SIZE, np.int32)
    for b in range(n):
        near_start[b], target_start[b] = near_end, target_end
        if not (wanted[b] and leaf[b]):
            continue
        near = _with_room(near, near_end, coarse_start[b + 1] - coarse_start[b])
        for i in range(coarse_start[b], coarse_start[b + 1]):
            near[near_end] = coarse[i]
            near_end += 1
        for i in range(colleague_start[b], colleague_start[b + 1]):
            s = colleague[i]
            if leaf[s]:
                near = _appended(near, near_end, s)
                near_end += 1
                continue
            stack[0], waiting = s, 1
            while waiting > 0:
                waiting -= 1
                s = stack[waiting]
                direct = source_count[s] < direct_below or _touch(level, cell, s, b)
                if not direct:
                    target = _appended(target, target_end, s)
                    target_end += 1
                elif leaf[s]:
                    near = _appended(near, near_end, s)
                    near_end += 1
                else:
                    opened[s] = True
                    waiting = _push_children(children, source_count, s, stack, waiting)
    near_start[n], target_start[n] = near_end, target_end
    return near_start, near[:near_end].copy(), target_start, target[:target_end].copy()


@jit
def _push_children(children, source_count, box, stack, waiting):
    """Put the children with sources on the stack, the first on top; the new number waiting."""
    for octant in range(7, -1, -1):
        c = children[box, octant]
        if c >= 0 and source_count[c] > 0:
            stack[waiting] = c
            waiting += 1
    return waiting


@jit
def missing_children(opened, children, source_count):
    """The first opened box whose children do not hold all of its sources, or -1."""
    for b in range(len(opened)):
        if opened[b]:
            held = 0
            for octant in range(8):
                if children[b, octant] >= 0:
                    held += source_count[children[b, octant]]
            if held != source_count[b]:
                return b
    return -1


@jit
def merged_ranges(row, start, entry, ranges):
    """Ranges of points of the entries of some rows, sorted, those that meet made one.

    Returns start (len(row) + 1,) and ranges (m, 2).
    """
    total = 0
    for b in row:
        total += start[b + 1] - start[b]
    merged_start = np.zeros(len(row) + 1, np.int64)
    merged = np.empty((total, 2), np.int32)
    end = 0
    for k in range(len(row)):
        entries = entry[start[row[k]] : start[row[k] + 1]]
        for i in np.argsort(ranges[entries, 0]):
            first, last = ranges[entries[i]]
            if end > merged_start[k] and merged[end - 1, 1] == first:
                merged[end - 1, 1] = last
            else:
                merged[end, 0], merged[end, 1] = first, last
                end += 1
        merged_start[k + 1] = end
    return merged_start, merged[:end].copy()


@jit
def _touch(level, cell, fine, coarse):
    """Whether a box touches, or lies in, one of the same or a coarser level."""
    shift = level[fine] - level[coarse]
    for axis in range(3):
        first = cell[coarse, axis] << shift
        last = first + (1 << shift) - 1
        if cell[fine, axis] < first - 1 or cell[fine, axis] > last + 1:
            return False
    return True


@jit
def _vector(x, y, z):
    """Number of the transfer vector, lattice coordinates of the target less the source's."""
    return ((x + 3) * 7 + y + 3) * 7 + z + 3


@jit
def _with_room(array, used, extra):
    """The array itself, or a longer copy, with room for `extra` more entries behind `used`."""
    if used + extra <= len(array):
        return array
    longer = np.empty(max(2 * len(array), used + extra), array.dtype)
    longer[:used] = array[:used]
    return longer


@jit
def _appended(array, used, value):
    """The array, or a longer copy, with the value behind its `used` entries."""
    array = _with_room(array, used, 1)
    array[used] = value
    return array
