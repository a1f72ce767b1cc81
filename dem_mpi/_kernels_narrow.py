"""Compiled loops over listed pairs and walls of bodies of any shape: which touch, and where.

The counterpart of the loops in `_kernels_detection` for scenes with bodies that are not spheres.
Each pair and each wall may give two contacts; a pair's stand one after the other, in order along
the axis of a, so that impulses of the last step find theirs again.

Symbols: a, b the two bodies of a contact, gid(a) < gid(b), a owned; x position; d symmetry axis;
form (rows, 3) = (shape, radius, half length), see `shapes`; R bounding radius; v, w linear and
angular velocity; phi gap; h time step; c relative margin; face rows of `Walls.rows`.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange
from dem_mpi._kernels_shapes import pair_contacts, smallest_size, wall_contacts
from dem_mpi._kernels_walls import may_touch, norm
from dem_mpi.wall_kinds import CENTRE as _C
from dem_mpi.wall_kinds import GEOMETRY
from dem_mpi.wall_kinds import KIND as _KIND
from dem_mpi.wall_kinds import SPIN as _W
from dem_mpi.wall_kinds import VELOCITY as _V


@jit
def _size(form, i):
    return smallest_size(int(form[i, 0]), form[i, 1], form[i, 2])


@jit
def _pair(x, d, form, R, v, w, a, b, mu, h, c, out):
    """Write the contacts of two bodies; return (count, coincident).

    They count where phi <= max(c min(size), h (|v_a - v_b| (1 + mu) + |w_a| R_a + |w_b| R_b)).
    """
    speed = norm(v[a, 0] - v[b, 0], v[a, 1] - v[b, 1], v[a, 2] - v[b, 2])
    rolling = norm(w[a, 0], w[a, 1], w[a, 2]) * R[a] + norm(w[b, 0], w[b, 1], w[b, 2]) * R[b]
    limit = max(c * min(_size(form, a), _size(form, b)), h * (speed * (1.0 + mu) + rolling))
    distance = norm(x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2])
    if distance - (R[a] + R[b]) > limit:
        return 0, 0
    return pair_contacts(
        int(form[a, 0]), x[a], d[a], form[a, 1], form[a, 2],
        int(form[b, 0]), x[b], d[b], form[b, 1], form[b, 2], limit, out,
    )  # fmt: skip


@jit
def _wall(x, d, form, R, v, w, a, face, k, mu, h, c, out):
    """Write the contacts of a body and a wall face; return how many.

    They count where phi <= max(c size, h (s (1 + mu) + |w| R)); s = |v - V| + |W| (|x - C| + R)
    bounds the relative speed at every point that a wall turning at W about C can touch.
    """
    speed = norm(
        v[a, 0] - face[k, _V], v[a, 1] - face[k, _V + 1], v[a, 2] - face[k, _V + 2]
    ) + norm(face[k, _W], face[k, _W + 1], face[k, _W + 2]) * (
        norm(x[a, 0] - face[k, _C], x[a, 1] - face[k, _C + 1], x[a, 2] - face[k, _C + 2]) + R[a]
    )
    rolling = norm(w[a, 0], w[a, 1], w[a, 2]) * R[a]
    limit = max(c * _size(form, a), h * (speed * (1.0 + mu) + rolling))
    if not may_touch(face, k, x[a, 0], x[a, 1], x[a, 2], R[a], limit):
        return 0
    return wall_contacts(
        int(face[k, _KIND]), face[k, :GEOMETRY],
        int(form[a, 0]), x[a], d[a], form[a, 1], form[a, 2], limit, out,
    )  # fmt: skip


@jit_threads
def count_contacts(
    x, d, form, R, v, w, material, friction, offset, neighbour, face, wall_material, h, c, count
):
    """Count the contacts of each owned body: those with walls, then those with listed bodies.

    count : (n + 1,) int64; contacts of body a go to count[a + 1].
    """
    for a in prange(offset.shape[0] - 1):
        out = np.empty((2, 7))
        found = 0
        for k in range(face.shape[0]):
            mu = friction[material[a], wall_material[k]]
            found += _wall(x, d, form, R, v, w, a, face, k, mu, h, c, out)
        for p in range(offset[a], offset[a + 1]):
            b = neighbour[p]
            mu = friction[material[a], material[b]]
            found += _pair(x, d, form, R, v, w, a, b, mu, h, c, out)[0]
        count[a + 1] = found


@jit_threads
def fill_contacts(
    x, d, form, R, v, w, gid, material, friction, offset, neighbour, face, wall_material, h, c,
    row, ca, cb, other, n_out, gap, arm, mu_out, coincident,
):  # fmt: skip
    """Write the contacts counted by `count_contacts`; contacts of body a stand at row[a]:row[a+1].

    Walls come first, in ascending id; so contacts are ordered by (a, gid of b).

    ca, cb : (m,) int32 local rows (a wall k is -(k + 1)); other : (m,) int64 gid or wall id;
    n_out : (m, 3) from a to b; gap : (m,) [m]; arm : (m, 6) [m] from the centres of a and b to
    the middle of the gap, of walls zero; mu_out : (m,); coincident : (n,) int32 zeros on entry.
    """
    walls = face.shape[0]
    for a in prange(offset.shape[0] - 1):
        out = np.empty((2, 7))
        at = row[a]
        for q in range(walls):
            k = walls - 1 - q
            mu = friction[material[a], wall_material[k]]
            found = _wall(x, d, form, R, v, w, a, face, k, mu, h, c, out)
            for i in range(found):
                ca[at], cb[at], other[at] = a, -(k + 1), -(k + 1)
                n_out[at], gap[at], mu_out[at] = out[i, :3], out[i, 3], mu
                for t in range(3):
                    arm[at, t] = out[i, 4 + t]
                    arm[at, 3 + t] = 0.0
                at += 1
        for p in range(offset[a], offset[a + 1]):
            b = neighbour[p]
            mu = friction[material[a], material[b]]
            found, arbitrary = _pair(x, d, form, R, v, w, a, b, mu, h, c, out)
            coincident[a] += arbitrary
            for i in range(found):
                ca[at], cb[at], other[at] = a, b, gid[b]
                n_out[at], gap[at], mu_out[at] = out[i, :3], out[i, 3], mu
                for t in range(3):
                    arm[at, t] = out[i, 4 + t]
                    arm[at, 3 + t] = out[i, 4 + t] - (x[b, t] - x[a, t])
                at += 1
