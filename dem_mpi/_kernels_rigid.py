"""Compiled loops of D, M^-1 and D^T for bodies of any shape: arms and inertias in the world frame.

The counterparts in `_kernels_solver` serve scenes of spheres, whose arms lie along the normal and
whose inertia is a number. Here a normal impulse turns a body too, so every body has its six
freedoms, with friction and without.

Symbols: m contacts; a, b local rows of the bodies (b < 0 is a wall); n normal from a to b; p world
impulse on b; arm (m, 6) from the centres of a and of b to the common contact point; J inverse
inertia (bodies, 6): xx, xy, xz, yy, yz, zz; d symmetry axis; u velocities (bodies, 6) = (v, w).
"""

from __future__ import annotations

from dem_mpi._jit import jit, jit_threads, prange
from dem_mpi._kernels_solver import _frame


@jit
def _turned(J, k, tx, ty, tz):
    """Return J t: the angular velocity that an angular impulse t gives to body k."""
    return (
        J[k, 0] * tx + J[k, 1] * ty + J[k, 2] * tz,
        J[k, 1] * tx + J[k, 3] * ty + J[k, 4] * tz,
        J[k, 2] * tx + J[k, 4] * ty + J[k, 5] * tz,
    )


@jit
def _lever(arm, i, first, x, y, z):
    """Return arm x (x, y, z) for the arm of contact i that stands at columns first:first + 3."""
    ax, ay, az = arm[i, first], arm[i, first + 1], arm[i, first + 2]
    return ay * z - az * y, az * x - ax * z, ax * y - ay * x


@jit_threads
def world_inverse_inertia(d, inverse_inertia, J):
    """J = 1/I_t (1 - d d') + 1/I_a d d' from (bodies, 2) = (1/I_t, 1/I_a)."""
    for k in prange(d.shape[0]):
        x, y, z = d[k, 0], d[k, 1], d[k, 2]
        across = inverse_inertia[k, 0]
        excess = inverse_inertia[k, 1] - across
        J[k, 0] = across + excess * x * x
        J[k, 1] = excess * x * y
        J[k, 2] = excess * x * z
        J[k, 3] = across + excess * y * y
        J[k, 4] = excess * y * z
        J[k, 5] = across + excess * z * z


@jit_threads
def impulses_to_bodies(normal, arm, p, row, owned, start, contact, inverse_mass, J, u):
    """u = M^-1 D gamma: add up the world impulses p on each body, force and torque.

    Called like its counterpart for spheres, which alone needs the normals.
    row : (owned + 1,) contacts with the body first; start, contact : those with it second.
    """
    for k in prange(u.shape[0]):
        fx = fy = fz = tx = ty = tz = 0.0
        if k < owned:
            for i in range(row[k], row[k + 1]):
                px, py, pz = p[i, 0], p[i, 1], p[i, 2]
                sx, sy, sz = _lever(arm, i, 0, px, py, pz)
                fx -= px
                fy -= py
                fz -= pz
                tx -= sx
                ty -= sy
                tz -= sz
        for q in range(start[k], start[k + 1]):
            i = contact[q]
            px, py, pz = p[i, 0], p[i, 1], p[i, 2]
            sx, sy, sz = _lever(arm, i, 3, px, py, pz)
            fx += px
            fy += py
            fz += pz
            tx += sx
            ty += sy
            tz += sz
        u[k, 0] = fx * inverse_mass[k]
        u[k, 1] = fy * inverse_mass[k]
        u[k, 2] = fz * inverse_mass[k]
        u[k, 3], u[k, 4], u[k, 5] = _turned(J, k, tx, ty, tz)


@jit_threads
def bodies_to_contacts(normal, arm, a, b, u, g):
    """g = D^T u: (v_b + w_b x arm_b) - (v_a + w_a x arm_a) in the frame of the contact."""
    for i in prange(normal.shape[0]):
        k, j = a[i], b[i]
        sx, sy, sz = _lever(arm, i, 0, u[k, 3], u[k, 4], u[k, 5])
        vx, vy, vz = sx - u[k, 0], sy - u[k, 1], sz - u[k, 2]
        if j >= 0:
            sx, sy, sz = _lever(arm, i, 3, u[j, 3], u[j, 4], u[j, 5])
            vx += u[j, 0] - sx
            vy += u[j, 1] - sy
            vz += u[j, 2] - sz
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        g[i, 0] = nx * vx + ny * vy + nz * vz
        if g.shape[1] == 3:
            f = _frame(nx, ny, nz)
            g[i, 1] = f[0] * vx + f[1] * vy + f[2] * vz
            g[i, 2] = f[3] * vx + f[4] * vy + f[5] * vz


@jit
def _directions(normal, i):
    """Return normal and both tangents of contact i as nine numbers."""
    nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
    f = _frame(nx, ny, nz)
    return nx, ny, nz, f[0], f[1], f[2], f[3], f[4], f[5]


@jit_threads
def diagonal(normal, arm, a, b, inverse_mass, J, diag):
    """diag(D^T M^-1 D): 1/m + (arm x t).J (arm x t) of both bodies for t = n, t1, t2."""
    for i in prange(arm.shape[0]):
        directions = _directions(normal, i)
        for t in range(diag.shape[1]):
            x, y, z = directions[3 * t], directions[3 * t + 1], directions[3 * t + 2]
            total = 0.0
            for side in range(2):
                k = a[i] if side == 0 else b[i]
                if k < 0:
                    continue
                sx, sy, sz = _lever(arm, i, 3 * side, x, y, z)
                wx, wy, wz = _turned(J, k, sx, sy, sz)
                total += inverse_mass[k] + (sx * wx + sy * wy + sz * wz)
            diag[i, t] = total


@jit
def assembled_rows(normal, arm, a, b, rows, columns, indptr, indices, values):
    """CSR rows of D^T, `rows` (1 or 3) for each contact: t and arm x t for either body.

    columns : (bodies,) first global column of each local body.
    """
    at = 0
    row = 0
    for i in range(normal.shape[0]):
        directions = _directions(normal, i)
        for t in range(rows):
            x, y, z = directions[3 * t], directions[3 * t + 1], directions[3 * t + 2]
            for side in range(2):
                k = a[i] if side == 0 else b[i]
                if k < 0:
                    continue
                sign = -1.0 if side == 0 else 1.0
                sx, sy, sz = _lever(arm, i, 3 * side, x, y, z)
                entries = (x, y, z, sx, sy, sz)
                for c in range(6):
                    indices[at + c] = columns[k] + c
                    values[at + c] = sign * entries[c]
                at += 6
            row += 1
            indptr[row] = at


@jit
def mass_rows(inverse_mass, J, indices, values):
    """Values and local columns (bodies, 12) of M^-1 by rows: 1/m three times, then J's rows."""
    for k in range(inverse_mass.shape[0]):
        for c in range(3):
            indices[k, c] = 6 * k + c
            values[k, c] = inverse_mass[k]
        for r in range(3):
            for c in range(3):
                low, high = min(r, c), max(r, c)
                indices[k, 3 + 3 * r + c] = 6 * k + 3 + c
                # Row-wise upper triangle: (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2).
                values[k, 3 + 3 * r + c] = J[k, 3 * low - low * (low - 1) // 2 + high - low]
