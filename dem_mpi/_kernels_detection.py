"""Compiled loops of contact detection: hierarchical hashed grid, narrow phase, key matching.

Plain arrays in and out. Row order is local order: n owned bodies, then the ghosts.

Symbols: i, j, k bodies; a, b the two bodies of a contact, gid(a) < gid(b), a owned; x position;
r radius; e effective radius (half of what separates two bodies that must be listed); v, w linear
and angular velocity; phi gap; h time step; c relative margin.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange
from dem_mpi._kernels_walls import largest_margin, may_touch, touches
from dem_mpi._kernels_walls import norm as _norm

# Offsets of the half neighbourhood: the cell itself and 13 of its 26 neighbours.
_HALF = np.array(
    [
        (dx, dy, dz)
        for dz in (0, 1)
        for dy in (-1, 0, 1)
        for dx in (-1, 0, 1)
        if (dz, dy, dx) >= (0, 0, 0)
    ],
    dtype=np.int64,
)
_FULL = np.array(
    [(dx, dy, dz) for dz in (-1, 0, 1) for dy in (-1, 0, 1) for dx in (-1, 0, 1)], dtype=np.int64
)
_MASK = np.int64((1 << 19) - 1)
_FAR = 4.0e15  # beyond this a cell coordinate is no exact integer


@jit
def _cell(x, edge):
    """Return the integer cell of a coordinate; far outliers share one."""
    return np.int64(np.floor(min(max(x / edge, -_FAR), _FAR)))


@jit
def _cell_key(ix, iy, iz, level):
    """Pack a cell of a level into 63 bits (coordinates modulo 2^19, level below 64)."""
    return ((level & 63) << 57) | ((ix & _MASK) << 38) | ((iy & _MASK) << 19) | (iz & _MASK)


@jit
def _bucket(ix, iy, iz, level, mask):
    """Hash a cell so that neighbours along x share cache lines."""
    return (ix + iy * np.int64(1000003) + iz * np.int64(998244353) + level * np.int64(7919)) & mask


@jit
def assign_levels(e, e_min, level):
    """Put each body on the grid level whose cells, of edge 2 e_min 2^l, are at least 2 e wide.

    Returns the bit set of occupied levels.
    """
    occupied = np.int64(0)
    for i in range(e.shape[0]):
        depth = np.int64(0)
        size = e_min
        while size < e[i] and depth < 62:
            size *= 2.0
            depth += 1
        level[i] = depth
        occupied |= np.int64(1) << depth
    return occupied


@jit
def fill_table(x, level, edge0, start, entry, entry_key):
    """Counting sort of bodies into hash buckets: bodies of bucket q stand at start[q]:start[q+1].

    start : (buckets + 1,) int64, zeros on entry; entry : (N,) int32; entry_key : (N,) int64.
    """
    mask = np.int64(start.shape[0] - 2)
    count = x.shape[0]
    bucket = np.empty(count, np.int64)
    key = np.empty(count, np.int64)
    for i in range(count):
        edge = edge0 * 2.0 ** level[i]
        ix, iy, iz = _cell(x[i, 0], edge), _cell(x[i, 1], edge), _cell(x[i, 2], edge)
        key[i] = _cell_key(ix, iy, iz, level[i])
        bucket[i] = _bucket(ix, iy, iz, level[i], mask)
        start[bucket[i] + 1] += 1
    for q in range(start.shape[0] - 1):
        start[q + 1] += start[q]
    fill = start[:-1].copy()
    for i in range(count):
        s = fill[bucket[i]]
        fill[bucket[i]] = s + 1
        entry[s] = i
        entry_key[s] = key[i]


@jit
def _near(x, r, s, i, j, c, skin):
    """Whether bodies i and j can come into contact before the list is rebuilt."""
    dx = x[j, 0] - x[i, 0]
    dy = x[j, 1] - x[i, 1]
    dz = x[j, 2] - x[i, 2]
    reach = r[i] + r[j] + max(c * min(r[i], r[j]), s[i] + s[j]) + skin
    return dx * dx + dy * dy + dz * dz <= reach * reach


@jit_threads
def search_pairs(
    x, r, s, gid, level, occupied, edge0, start, entry, entry_key, n, c, skin, offset, low, high
):
    """List every near pair once: with `offset` all zero count them, else write them.

    Each body looks through half of the cells around it on its own level and through all 27 on
    every coarser occupied one, so that a pair of unequal bodies is found by the smaller.

    offset : (N + 1,) int64; counts of body i go to offset[i + 1] when `low` is empty;
    low, high : (pairs,) int32, the body with the smaller gid first. Pairs whose `low` is a ghost
    are listed where it is owned (or, a periodic image, where it is the body itself) and left out
    here; so are a body and its own image, which move as one.
    """
    mask = np.int64(start.shape[0] - 2)
    count_only = low.shape[0] == 0
    for i in prange(x.shape[0]):
        found = np.int64(0)
        at = offset[i]
        for depth in range(level[i], 63):
            if not (occupied >> depth) & 1:
                continue
            edge = edge0 * 2.0**depth
            ix, iy, iz = _cell(x[i, 0], edge), _cell(x[i, 1], edge), _cell(x[i, 2], edge)
            same = depth == level[i]
            stencil = _HALF if same else _FULL
            for q in range(stencil.shape[0]):
                jx, jy, jz = ix + stencil[q, 0], iy + stencil[q, 1], iz + stencil[q, 2]
                key = _cell_key(jx, jy, jz, depth)
                bucket = _bucket(jx, jy, jz, depth, mask)
                for t in range(start[bucket], start[bucket + 1]):
                    if entry_key[t] != key:
                        continue
                    j = np.int64(entry[t])
                    if (same and q == 0 and j <= i) or gid[i] == gid[j]:
                        continue
                    a, b = (i, j) if gid[i] < gid[j] else (j, i)
                    if a >= n or not _near(x, r, s, i, j, c, skin):
                        continue
                    if not count_only:
                        low[at + found] = a
                        high[at + found] = b
                    found += 1
        if count_only:
            offset[i + 1] = found


@jit
def _before(gid, image, i, j):
    """Whether body i comes before j in the order of (gid, image)."""
    return gid[i] < gid[j] or (gid[i] == gid[j] and image[i] < image[j])


@jit
def group_pairs(low, high, gid, image, n, offset, neighbour):
    """Group pairs by their first body, ascending in (gid, image) of the second.

    image  : (N,) int8 image code, which tells the periodic images of one body apart
    offset : (n + 1,) int64, zeros on entry; neighbour : (pairs,) int32.
    Counting sort by the first, insertion sort (or, of many, merge sort) by the second.
    """
    for p in range(low.shape[0]):
        offset[low[p] + 1] += 1
    for i in range(n):
        offset[i + 1] += offset[i]
    fill = offset[:-1].copy()
    for p in range(low.shape[0]):
        a = low[p]
        neighbour[fill[a]] = high[p]
        fill[a] += 1
    for i in range(n):
        row = neighbour[offset[i] : offset[i + 1]]
        if row.shape[0] > 32:
            row[:] = row[np.argsort(image[row], kind="mergesort")]
            row[:] = row[np.argsort(gid[row], kind="mergesort")]
            continue
        for p in range(1, row.shape[0]):
            value = row[p]
            q = p - 1
            while q >= 0 and _before(gid, image, value, row[q]):
                row[q + 1] = row[q]
                q -= 1
            row[q + 1] = value


@jit
def _pair_margin(v, w, r, a, b, mu, h, c):
    speed = _norm(v[a, 0] - v[b, 0], v[a, 1] - v[b, 1], v[a, 2] - v[b, 2])
    spin_a = _norm(w[a, 0], w[a, 1], w[a, 2]) * r[a]
    spin_b = _norm(w[b, 0], w[b, 1], w[b, 2]) * r[b]
    return max(c * min(r[a], r[b]), h * (speed * (1.0 + mu) + spin_a + spin_b))


@jit
def _distance(x, a, b):
    return _norm(x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2])


@jit_threads
def count_contacts(
    x, r, v, w, material, friction, offset, neighbour,
    face, wall_material, h, c, count,
):  # fmt: skip
    """Count the contacts of each owned body: those with walls, then those with listed bodies.

    A pair is a contact iff phi <= max(c min(r_a, r_b), h (|v_a - v_b| (1 + mu) + |w_a| r_a +
    |w_b| r_b)): wide enough that a sliding contact, which hovers at h mu |v_t|, does not flicker.
    With a wall a body may have two.

    count : (n + 1,) int64; contacts of body a go to count[a + 1].
    """
    for a in prange(offset.shape[0] - 1):
        found = 0
        rolling = _norm(w[a, 0], w[a, 1], w[a, 2]) * r[a]
        ax, ay, az, ra = x[a, 0], x[a, 1], x[a, 2], r[a]
        vx, vy, vz = v[a, 0], v[a, 1], v[a, 2]
        for k in range(face.shape[0]):
            mu = friction[material[a], wall_material[k]]
            limit = largest_margin(face, k, ax, ay, az, vx, vy, vz, ra, rolling, mu, h, c)
            if not may_touch(face, k, ax, ay, az, ra, limit):
                continue
            first, second, _, _ = touches(
                face, k, ax, ay, az, vx, vy, vz, ra, rolling, mu, h, c, limit
            )
            found += int(first) + int(second)
        for p in range(offset[a], offset[a + 1]):
            b = neighbour[p]
            mu = friction[material[a], material[b]]
            if _distance(x, a, b) - (r[a] + r[b]) <= _pair_margin(v, w, r, a, b, mu, h, c):
                found += 1
        count[a + 1] = found


@jit_threads
def fill_contacts(
    x, r, v, w, gid, material, friction, offset, neighbour,
    face, wall_material, h, c,
    row, ca, cb, other, n_out, gap, arm, mu_out, coincident,
):  # fmt: skip
    """Write the contacts counted by `count_contacts`; contacts of body a stand at row[a]:row[a+1].

    Walls come first, in ascending id; so contacts are ordered by (a, gid of b), and of two with
    one wall the nearer stands first.
    Both arms end in the middle of the gap (arm = r + phi/2), or a tangential
    impulse would leave the torque phi n x p. Coincident centres: n = e_z, counted.

    ca, cb : (m,) int32 local rows (a wall k is -(k + 1)); other : (m,) int64 gid or wall id;
    n_out : (m, 3) from a to b; gap : (m,) [m]; arm : (m, 2) [m]; mu_out : (m,).
    """
    walls = face.shape[0]
    for a in prange(offset.shape[0] - 1):
        at = row[a]
        rolling = _norm(w[a, 0], w[a, 1], w[a, 2]) * r[a]
        ax, ay, az, ra = x[a, 0], x[a, 1], x[a, 2], r[a]
        vx, vy, vz = v[a, 0], v[a, 1], v[a, 2]
        for q in range(walls):
            k = walls - 1 - q
            mu = friction[material[a], wall_material[k]]
            limit = largest_margin(face, k, ax, ay, az, vx, vy, vz, ra, rolling, mu, h, c)
            if not may_touch(face, k, ax, ay, az, ra, limit):
                continue
            first, second, near, far = touches(
                face, k, ax, ay, az, vx, vy, vz, ra, rolling, mu, h, c, limit
            )
            for _ in range(int(first) + int(second)):
                phi, n_out[at, 0], n_out[at, 1], n_out[at, 2] = near if first else far
                ca[at] = a
                cb[at] = -(k + 1)
                other[at] = -(k + 1)
                gap[at] = phi
                arm[at, 0] = r[a] + 0.5 * phi
                arm[at, 1] = 0.0
                mu_out[at] = mu
                at += 1
                first = False
        for p in range(offset[a], offset[a + 1]):
            b = neighbour[p]
            mu = friction[material[a], material[b]]
            distance = _distance(x, a, b)
            phi = distance - (r[a] + r[b])
            if phi <= _pair_margin(v, w, r, a, b, mu, h, c):
                ca[at] = a
                cb[at] = b
                other[at] = gid[b]
                if distance > 0.0:
                    n_out[at, 0] = (x[b, 0] - x[a, 0]) / distance
                    n_out[at, 1] = (x[b, 1] - x[a, 1]) / distance
                    n_out[at, 2] = (x[b, 2] - x[a, 2]) / distance
                else:
                    n_out[at, 0] = 0.0
                    n_out[at, 1] = 0.0
                    n_out[at, 2] = 1.0
                    coincident[a] += 1
                gap[at] = phi
                arm[at, 0] = r[a] + 0.5 * phi
                arm[at, 1] = r[b] + 0.5 * phi
                mu_out[at] = mu
                at += 1


@jit_threads
def match_impulses(row, other, old_row, old_other, old_impulse, impulse):
    """Carry world-frame impulses over to contacts that exist again; returns nothing, fills.

    Both lists are ordered by the other body's gid within each body: one merge a body. Two contacts
    with the same partner match in the order in which they stand.
    impulse : (m, 3) zeros on entry.
    """
    for a in prange(row.shape[0] - 1):
        p = old_row[a]
        for i in range(row[a], row[a + 1]):
            while p < old_row[a + 1] and old_other[p] < other[i]:
                p += 1
            if p < old_row[a + 1] and old_other[p] == other[i]:
                impulse[i, 0] = old_impulse[p, 0]
                impulse[i, 1] = old_impulse[p, 1]
                impulse[i, 2] = old_impulse[p, 2]
                p += 1


@jit
def largest_drift(x, x_ref, s, s_ref):
    """Return the largest |x - x_ref| + (s - s_ref)^+ over bodies, in metres."""
    largest = 0.0
    for i in range(x.shape[0]):
        moved = _norm(
            x[i, 0] - x_ref[i, 0],
            x[i, 1] - x_ref[i, 1],
            x[i, 2] - x_ref[i, 2],
        )
        largest = max(largest, moved + max(0.0, s[i] - s_ref[i]))
    return largest


@jit
def reach_speed(v, w, r, u, mu_max, h, s):
    """Bound the margin: margin(a, b) <= s_a + s_b with s = h (|v - u| (1 + mu_max) + |w| r)."""
    for i in range(v.shape[0]):
        speed = _norm(v[i, 0] - u[0], v[i, 1] - u[1], v[i, 2] - u[2])
        spin = _norm(w[i, 0], w[i, 1], w[i, 2]) * r[i]
        s[i] = h * (speed * (1.0 + mu_max) + spin)
