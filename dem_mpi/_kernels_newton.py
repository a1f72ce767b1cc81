"""Compiled loops of the Newton matrix K = M + D Q D^T: its block pattern and its values.

A block row is a body this rank owns, 6 x 6 or 3 x 3 a block; the blocks of a row are those of the
body itself and of every body it touches, in the order of their global numbers. Every rank fills
its own rows: it knows all contacts of its bodies, also those that another rank owns. Each row
sums over its contacts in their order, so no two threads write one block and no sum depends on
their number.

Symbols: m contacts, own ones and then those of other ranks; body (m, 2) global numbers of a and b,
-1 for a wall; k a row, `first` + k its global number; an incidence is a contact seen from one of
its bodies, 2 i + side; Q (m, c c) blocks by rows; J (c, dof) rows of D^T of one side.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange
from dem_mpi._kernels_solver import _frame


@jit
def incidences(body, first, owned, start, incident):
    """List the incidences of each owned body, in the order of contacts.

    start : (owned + 1,) int64 zeros on entry; incident : as many as `count_incidences` says.
    """
    for i in range(body.shape[0]):
        for side in range(2):
            k = body[i, side] - first
            if 0 <= k < owned:
                start[k + 1] += 1
    for k in range(owned):
        start[k + 1] += start[k]
    fill = start[:-1].copy()
    for i in range(body.shape[0]):
        for side in range(2):
            k = body[i, side] - first
            if 0 <= k < owned:
                incident[fill[k]] = 2 * i + side
                fill[k] += 1


@jit
def count_incidences(body, first, owned):
    """Return how many contact sides are owned bodies."""
    count = 0
    for i in range(body.shape[0]):
        for side in range(2):
            if 0 <= body[i, side] - first < owned:
                count += 1
    return count


@jit
def block_columns(body, first, start, incident, row, column):
    """Write the global block columns of each row, sorted, each once; return their number.

    row : (owned + 1,) int64; column : (incidences + owned,) int64, of which the front is used.
    """
    at = 0
    row[0] = 0
    for k in range(row.shape[0] - 1):
        column[at] = first + k
        found = 1
        for q in range(start[k], start[k + 1]):
            other = body[incident[q] // 2, 1 - incident[q] % 2]
            if other < 0:
                continue
            # Insertion keeps the row sorted; a body has a dozen neighbours.
            place = found
            while place > 0 and column[at + place - 1] > other:
                place -= 1
            if place > 0 and column[at + place - 1] == other:
                continue
            for j in range(found, place, -1):
                column[at + j] = column[at + j - 1]
            column[at + place] = other
            found += 1
        at += found
        row[k + 1] = at
    return at


@jit
def block_slots(body, first, start, incident, row, column, own, slot):
    """Where in its row each incidence's other body stands (-1: wall), and the body itself.

    own : (owned,) int32; slot : (incidences,) int32.
    """
    for k in range(own.shape[0]):
        own[k] = np.searchsorted(column[row[k] : row[k + 1]], first + k)
        for q in range(start[k], start[k + 1]):
            other = body[incident[q] // 2, 1 - incident[q] % 2]
            slot[q] = -1
            if other >= 0:
                slot[q] = np.searchsorted(column[row[k] : row[k + 1]], other)


@jit
def scalar_pattern(row, column, dof, indptr, indices):
    """CSR of single rows and columns from that of dof x dof blocks."""
    at = 0
    indptr[0] = 0
    for k in range(row.shape[0] - 1):
        for r in range(dof):
            for j in range(row[k], row[k + 1]):
                for c in range(dof):
                    indices[at] = column[j] * dof + c
                    at += 1
            indptr[k * dof + r + 1] = at


@jit
def _side(normal, arm, i, side, J):
    """J = the rows of D^T of contact i for one of its bodies: sign t, and its torque.

    The torque of a unit impulse along the normal is zero for spheres, exactly: a rounded zero
    would be multiplied by the largest entry of Q.
    """
    nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
    f = _frame(nx, ny, nz)
    general = arm.shape[1] == 6
    sign = -1.0 if side == 0 else 1.0
    for t in range(J.shape[0]):
        x = nx if t == 0 else f[3 * (t - 1)]
        y = ny if t == 0 else f[3 * (t - 1) + 1]
        z = nz if t == 0 else f[3 * (t - 1) + 2]
        J[t, 0], J[t, 1], J[t, 2] = sign * x, sign * y, sign * z
        if J.shape[1] == 3:
            continue
        if general:
            ax, ay, az = arm[i, 3 * side], arm[i, 3 * side + 1], arm[i, 3 * side + 2]
        elif t > 0:
            # Both arms lie along the normal, that of b against it.
            length = -sign * arm[i, side]
            ax, ay, az = length * nx, length * ny, length * nz
        else:
            ax = ay = az = 0.0
        J[t, 3] = sign * (ay * z - az * y)
        J[t, 4] = sign * (az * x - ax * z)
        J[t, 5] = sign * (ax * y - ay * x)


@jit
def _add_mass(inverse_mass, inverse_inertia, k, block):
    """Add the mass matrix of body k: 1/m, and the inverse of its inverse inertia."""
    for c in range(3):
        block[c, c] += 1.0 / inverse_mass[k]
    if block.shape[0] == 3:
        return
    J = inverse_inertia
    if J.shape[1] == 1:
        for c in range(3, 6):
            block[c, c] += 1.0 / J[k, 0]
        return
    xx = J[k, 3] * J[k, 5] - J[k, 4] * J[k, 4]
    xy = J[k, 2] * J[k, 4] - J[k, 1] * J[k, 5]
    xz = J[k, 1] * J[k, 4] - J[k, 2] * J[k, 3]
    scale = 1.0 / (J[k, 0] * xx + J[k, 1] * xy + J[k, 2] * xz)
    yy = J[k, 0] * J[k, 5] - J[k, 2] * J[k, 2]
    yz = J[k, 1] * J[k, 2] - J[k, 0] * J[k, 4]
    zz = J[k, 0] * J[k, 3] - J[k, 1] * J[k, 1]
    block[3, 3] += scale * xx
    block[4, 4] += scale * yy
    block[5, 5] += scale * zz
    block[3, 4] += scale * xy
    block[4, 3] += scale * xy
    block[3, 5] += scale * xz
    block[5, 3] += scale * xz
    block[4, 5] += scale * yz
    block[5, 4] += scale * yz


@jit_threads
def velocity_matrix(
    normal, arm, Q, start, incident, slot, own, row, inverse_mass, inverse_inertia, dof, values
):
    """Values of K = M + D Q D^T in the order of `scalar_pattern`.

    inverse_inertia : (n, 1) or (n, 6), xx, xy, xz, yy, yz, zz in the world frame.
    """
    c = 1 if Q.shape[1] == 1 else 3
    for k in prange(own.shape[0]):
        wide = dof * (row[k + 1] - row[k])
        base = row[k] * dof * dof
        for e in range(base, base + dof * wide):
            values[e] = 0.0
        mine, theirs, QJ = np.empty((c, dof)), np.empty((c, dof)), np.empty((c, dof))
        diagonal = np.zeros((dof, dof))
        _add_mass(inverse_mass, inverse_inertia, k, diagonal)
        for q in range(start[k], start[k + 1]):
            i, side = incident[q] // 2, incident[q] % 2
            _side(normal, arm, i, side, mine)
            _weigh(Q, i, mine, QJ)
            for r in range(dof):
                for s in range(dof):
                    total = mine[0, r] * QJ[0, s]
                    for t in range(1, c):
                        total += mine[t, r] * QJ[t, s]
                    diagonal[r, s] += total
            if slot[q] < 0:
                continue
            _side(normal, arm, i, 1 - side, theirs)
            _weigh(Q, i, theirs, QJ)
            corner = base + dof * slot[q]
            for r in range(dof):
                for s in range(dof):
                    total = mine[0, r] * QJ[0, s]
                    for t in range(1, c):
                        total += mine[t, r] * QJ[t, s]
                    values[corner + r * wide + s] += total
        corner = base + dof * own[k]
        for r in range(dof):
            for s in range(dof):
                # Added, not written: a body may touch its own image.
                values[corner + r * wide + s] += diagonal[r, s]


@jit
def _weigh(Q, i, J, out):
    """out = Q_i J."""
    c = J.shape[0]
    for t in range(c):
        for s in range(J.shape[1]):
            total = 0.0
            for p in range(c):
                total += Q[i, c * t + p] * J[p, s]
            out[t, s] = total


@jit_threads
def block_product(A, x, out):
    """out_i = A_i x_i for blocks A (m, c, c)."""
    c = x.shape[1]
    for i in prange(x.shape[0]):
        if c == 1:
            out[i, 0] = A[i, 0, 0] * x[i, 0]
        else:
            x0, x1, x2 = x[i, 0], x[i, 1], x[i, 2]
            for t in range(3):
                out[i, t] = A[i, t, 0] * x0 + A[i, t, 1] * x1 + A[i, t, 2] * x2


@jit_threads
def root_product(root, x, out):
    """out_i = L_i (L_i^T x_i) for blocks L (m, c, c); may be done in place.

    By L L^T, formed, rounding would add to every component the error of the largest.
    """
    c = x.shape[1]
    for i in prange(x.shape[0]):
        if c == 1:
            out[i, 0] = root[i, 0, 0] * (root[i, 0, 0] * x[i, 0])
        else:
            x0, x1, x2 = x[i, 0], x[i, 1], x[i, 2]
            y0 = root[i, 0, 0] * x0 + root[i, 1, 0] * x1 + root[i, 2, 0] * x2
            y1 = root[i, 0, 1] * x0 + root[i, 1, 1] * x1 + root[i, 2, 1] * x2
            y2 = root[i, 0, 2] * x0 + root[i, 1, 2] * x1 + root[i, 2, 2] * x2
            for t in range(3):
                out[i, t] = root[i, t, 0] * y0 + root[i, t, 1] * y1 + root[i, t, 2] * y2
