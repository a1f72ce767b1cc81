"""Compiled loops of the contact solve: D, M^-1, D^T without a matrix, projection, residuals.

Plain arrays in and out. A row of `gamma` or `g` is (normal, tangent 1, tangent 2) in the contact's
frame, or (normal,) alone in a scene without friction. Sums run over chunks of fixed length, so the
number of threads changes no bit.

Symbols: m contacts; a, b local rows of the bodies (b < 0 is a wall); n normal from a to b; p world
impulse on b; u velocity change M^-1 D gamma; gamma impulse; g = N gamma + b velocity; y
extrapolated impulse; d = gamma_new - y; s squared scaling of a contact's rows; mu friction.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange

CHUNK = 2048


@jit
def _frame(nx, ny, nz):
    """Return the two tangents of a unit normal, a pure function of it (Duff et al., JCGT 2017).

    n, t1, t2 is right-handed.
    """
    sign = np.copysign(1.0, nz)
    q = -1.0 / (sign + nz)
    k = nx * ny * q
    return (
        1.0 + sign * nx * nx * q,
        sign * k,
        -sign * nx,
        k,
        sign + ny * ny * q,
        -ny,
    )


@jit_threads
def tangents(normal, t1, t2):
    """Write both tangents (m, 3) of each normal (m, 3)."""
    for i in prange(normal.shape[0]):
        f = _frame(normal[i, 0], normal[i, 1], normal[i, 2])
        t1[i, 0], t1[i, 1], t1[i, 2] = f[0], f[1], f[2]
        t2[i, 0], t2[i, 1], t2[i, 2] = f[3], f[4], f[5]


@jit_threads
def to_world(normal, gamma, p):
    """p = n gamma_n + t1 gamma_1 + t2 gamma_2 for each contact (one column: p = n gamma_n)."""
    rows = gamma.shape[1]
    for i in prange(normal.shape[0]):
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        gn = gamma[i, 0]
        p[i, 0], p[i, 1], p[i, 2] = nx * gn, ny * gn, nz * gn
        if rows == 3:
            f = _frame(nx, ny, nz)
            g1, g2 = gamma[i, 1], gamma[i, 2]
            p[i, 0] += f[0] * g1 + f[3] * g2
            p[i, 1] += f[1] * g1 + f[4] * g2
            p[i, 2] += f[2] * g1 + f[5] * g2


@jit_threads
def to_contact(normal, p, gamma):
    """Components of world impulses p (m, 3) in the contact frames: the inverse of `to_world`."""
    rows = gamma.shape[1]
    for i in prange(normal.shape[0]):
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        px, py, pz = p[i, 0], p[i, 1], p[i, 2]
        gamma[i, 0] = nx * px + ny * py + nz * pz
        if rows == 3:
            f = _frame(nx, ny, nz)
            gamma[i, 1] = f[0] * px + f[1] * py + f[2] * pz
            gamma[i, 2] = f[3] * px + f[4] * py + f[5] * pz


@jit
def incidence(b, bodies, start, contact):
    """List the contacts in which each body is the second one, in contact order.

    start : (bodies + 1,) int64 zeros on entry; contact : (contacts with b >= 0,) int32.
    """
    for i in range(b.shape[0]):
        if b[i] >= 0:
            start[b[i] + 1] += 1
    for k in range(bodies):
        start[k + 1] += start[k]
    fill = start[:-1].copy()
    for i in range(b.shape[0]):
        if b[i] >= 0:
            contact[fill[b[i]]] = i
            fill[b[i]] += 1


@jit_threads
def impulses_to_bodies(
    normal, arm, p, row, owned, start, contact, inverse_mass, inverse_inertia, u
):
    """u = M^-1 D gamma: add up the world impulses p on each body, force and torque.

    Both arms lie along n, so the torques are -arm_a n x p on a and -arm_b n x p on b.
    row : (owned + 1,) contacts with the body first; start, contact : those with it second.
    u : (bodies, 6), or (bodies, 3) in a scene without friction.
    """
    rotating = u.shape[1] == 6
    for k in prange(u.shape[0]):
        fx = fy = fz = tx = ty = tz = 0.0
        if k < owned:
            for i in range(row[k], row[k + 1]):
                px, py, pz = p[i, 0], p[i, 1], p[i, 2]
                fx -= px
                fy -= py
                fz -= pz
                if rotating:
                    nx, ny, nz, length = normal[i, 0], normal[i, 1], normal[i, 2], arm[i, 0]
                    tx -= length * (ny * pz - nz * py)
                    ty -= length * (nz * px - nx * pz)
                    tz -= length * (nx * py - ny * px)
        for q in range(start[k], start[k + 1]):
            i = contact[q]
            px, py, pz = p[i, 0], p[i, 1], p[i, 2]
            fx += px
            fy += py
            fz += pz
            if rotating:
                nx, ny, nz, length = normal[i, 0], normal[i, 1], normal[i, 2], arm[i, 1]
                tx -= length * (ny * pz - nz * py)
                ty -= length * (nz * px - nx * pz)
                tz -= length * (nx * py - ny * px)
        u[k, 0] = fx * inverse_mass[k]
        u[k, 1] = fy * inverse_mass[k]
        u[k, 2] = fz * inverse_mass[k]
        if rotating:
            u[k, 3] = tx * inverse_inertia[k]
            u[k, 4] = ty * inverse_inertia[k]
            u[k, 5] = tz * inverse_inertia[k]


@jit_threads
def bodies_to_contacts(normal, arm, a, b, u, g):
    """g = D^T u: relative velocity of the two bodies at the contact point, in its frame.

    (v_b - v_a) - (arm_a w_a + arm_b w_b) x n; positive normal part means separation.
    """
    rows = g.shape[1]
    rotating = u.shape[1] == 6
    for i in prange(normal.shape[0]):
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        k = a[i]
        vx, vy, vz = -u[k, 0], -u[k, 1], -u[k, 2]
        j = b[i]
        if j >= 0:
            vx += u[j, 0]
            vy += u[j, 1]
            vz += u[j, 2]
        g[i, 0] = nx * vx + ny * vy + nz * vz
        if rows == 3:
            if rotating:
                length = arm[i, 0]
                wx, wy, wz = length * u[k, 3], length * u[k, 4], length * u[k, 5]
                if j >= 0:
                    length = arm[i, 1]
                    wx += length * u[j, 3]
                    wy += length * u[j, 4]
                    wz += length * u[j, 5]
                vx -= wy * nz - wz * ny
                vy -= wz * nx - wx * nz
                vz -= wx * ny - wy * nx
            f = _frame(nx, ny, nz)
            g[i, 1] = f[0] * vx + f[1] * vy + f[2] * vz
            g[i, 2] = f[3] * vx + f[4] * vy + f[5] * vz


@jit_threads
def diagonal(arm, a, b, inverse_mass, inverse_inertia, diag):
    """diag(D^T M^-1 D): 1/m_a + 1/m_b, and with the arms' squares over the inertias in tangents."""
    for i in prange(arm.shape[0]):
        k, j = a[i], b[i]
        normal_part = inverse_mass[k]
        tangent_part = inverse_mass[k] + arm[i, 0] * arm[i, 0] * inverse_inertia[k]
        if j >= 0:
            normal_part += inverse_mass[j]
            tangent_part += inverse_mass[j] + arm[i, 1] * arm[i, 1] * inverse_inertia[j]
        diag[i, 0] = normal_part
        for t in range(1, diag.shape[1]):
            diag[i, t] = tangent_part


@jit
def _positive(x):
    """max(0, x), but NaN where x is: max() may drop it."""
    return 0.0 if x < 0.0 else x


@jit
def _larger(x, y):
    """The larger of two numbers; NaN if either is, which max() and a plain comparison drop."""
    return y if y > x or y != y else x


@jit
def _project(gn, g1, g2, mu):
    """Project on {|gamma_t| <= mu gamma_n}; NaN is kept."""
    t = np.sqrt(g1 * g1 + g2 * g2)
    if gn >= 0.0 and t <= mu * gn:
        return gn, g1, g2
    if mu * t <= -gn:
        return 0.0, 0.0, 0.0
    pn = (mu * t + gn) / (1.0 + mu * mu)
    scale = mu * pn / t
    return pn, scale * g1, scale * g2


@jit_threads
def project(gamma, mu):
    """Project each row on its cone, in place (one column: on the half-line gamma_n >= 0)."""
    for i in prange(gamma.shape[0]):
        if gamma.shape[1] == 1:
            gamma[i, 0] = _positive(gamma[i, 0])
        else:
            gamma[i, 0], gamma[i, 1], gamma[i, 2] = _project(
                gamma[i, 0], gamma[i, 1], gamma[i, 2], mu[i]
            )


@jit_threads
def gradient_step(gamma, gamma_old, g, g_old, beta, step, s, mu, gamma_new, d, partial):
    """One projected step from the extrapolated point; returns (|d|^2 in the metric, g(y).move).

    y = gamma + beta (gamma - gamma_old), g(y) likewise (N is linear),
    gamma_new = P_C(y - step s g(y)), d = gamma_new - y.
    s : (m, 1 or 2) squared scaling of the normal and the tangents; with s_t != s_n the projection
    is orthogonal in the scaled variables gamma/sqrt(s), in which the cone has friction
    mu sqrt(s_n/s_t).
    partial : (chunks, 2) scratch.
    """
    m, rows = gamma.shape
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        square = move = 0.0
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            yn = gamma[i, 0] + beta * (gamma[i, 0] - gamma_old[i, 0])
            gn = g[i, 0] + beta * (g[i, 0] - g_old[i, 0])
            sn = s[i, 0]
            zn = yn - step * sn * gn
            if rows == 1:
                zn = _positive(zn)
            else:
                st = s[i, 1]
                y1 = gamma[i, 1] + beta * (gamma[i, 1] - gamma_old[i, 1])
                y2 = gamma[i, 2] + beta * (gamma[i, 2] - gamma_old[i, 2])
                g1 = g[i, 1] + beta * (g[i, 1] - g_old[i, 1])
                g2 = g[i, 2] + beta * (g[i, 2] - g_old[i, 2])
                z1 = y1 - step * st * g1
                z2 = y2 - step * st * g2
                t = np.sqrt(z1 * z1 + z2 * z2)
                if zn < 0.0 or t > mu[i] * zn:
                    # In scaled variables: slope^2 = mu^2 s_n / s_t.
                    ratio = mu[i] * sn / st
                    if ratio * t <= -zn:
                        zn = z1 = z2 = 0.0
                    else:
                        zn = (ratio * t + zn) / (1.0 + mu[i] * ratio)
                        scale = mu[i] * zn / t
                        z1 *= scale
                        z2 *= scale
                d1, d2 = z1 - y1, z2 - y2
                gamma_new[i, 1] = z1
                gamma_new[i, 2] = z2
                d[i, 1] = d1
                d[i, 2] = d2
                square += (d1 * d1 + d2 * d2) / st
                move += g1 * (z1 - gamma[i, 1]) + g2 * (z2 - gamma[i, 2])
            dn = zn - yn
            gamma_new[i, 0] = zn
            d[i, 0] = dn
            square += dn * dn / sn
            move += gn * (zn - gamma[i, 0])
        partial[chunk, 0] = square
        partial[chunk, 1] = move
    square = move = 0.0
    for chunk in range(chunks):
        square += partial[chunk, 0]
        move += partial[chunk, 1]
    return square, move


@jit_threads
def curvature(g, g_old, beta, d, b, gamma_new, g_new, mu, weight, partial):
    """g_new = g(y) + N d; returns d.N d, and of gamma_new objective, r_d and weighted |gamma.g|.

    g_new : (m, columns) holds N d on entry; weight : (m,), of contacts in the last.
    r_d = max(0, mu |g_t| - g_n) [m/s]; objective = gamma.(g + b)/2.
    partial : (chunks, 4) scratch.
    """
    m, rows = g.shape
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        bend = objective = dual = weighted = 0.0
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            bend += d[i, 0] * g_new[i, 0]
            gn = g[i, 0] + beta * (g[i, 0] - g_old[i, 0]) + g_new[i, 0]
            g_new[i, 0] = gn
            zn = gamma_new[i, 0]
            work = zn * gn
            push = zn * b[i, 0]
            slip = 0.0
            if rows == 3:
                bend += d[i, 1] * g_new[i, 1] + d[i, 2] * g_new[i, 2]
                g1 = g[i, 1] + beta * (g[i, 1] - g_old[i, 1]) + g_new[i, 1]
                g2 = g[i, 2] + beta * (g[i, 2] - g_old[i, 2]) + g_new[i, 2]
                g_new[i, 1] = g1
                g_new[i, 2] = g2
                work += gamma_new[i, 1] * g1 + gamma_new[i, 2] * g2
                push += gamma_new[i, 1] * b[i, 1] + gamma_new[i, 2] * b[i, 2]
                slip = mu[i] * np.sqrt(g1 * g1 + g2 * g2)
            objective += 0.5 * (work + push)
            dual = _larger(dual, slip - gn)
            weighted = _larger(weighted, weight[i] * abs(work))
        partial[chunk, 0] = bend
        partial[chunk, 1] = objective
        partial[chunk, 2] = dual
        partial[chunk, 3] = weighted
    bend = objective = dual = weighted = 0.0
    for chunk in range(chunks):
        bend += partial[chunk, 0]
        objective += partial[chunk, 1]
        dual = _larger(dual, partial[chunk, 2])
        weighted = _larger(weighted, partial[chunk, 3])
    return bend, objective, dual, weighted


@jit
def residuals(gamma, g, b, mu, weight):
    """Return maxima and sums that every solver is judged by.

    (r_p [N s], r_d [m/s], r_c [J], the same weighted by contacts [J], objective [J],
    D's r_d (mu > 0), D's sum of gamma.g).
    """
    primal = dual = complementarity = weighted = objective = thesis_dual = thesis_sum = 0.0
    rows = gamma.shape[1]
    for i in range(gamma.shape[0]):
        zn, gn = gamma[i, 0], g[i, 0]
        work = zn * gn
        push = zn * b[i, 0]
        t = slip = 0.0
        if rows == 3:
            work += gamma[i, 1] * g[i, 1] + gamma[i, 2] * g[i, 2]
            push += gamma[i, 1] * b[i, 1] + gamma[i, 2] * b[i, 2]
            t = np.sqrt(gamma[i, 1] ** 2 + gamma[i, 2] ** 2)
            slip = np.sqrt(g[i, 1] ** 2 + g[i, 2] ** 2)
        primal = _larger(primal, _larger(t - mu[i] * zn, -zn))
        dual = _larger(dual, mu[i] * slip - gn)
        complementarity = _larger(complementarity, abs(work))
        weighted = _larger(weighted, weight[i] * abs(work))
        if mu[i] > 0.0:
            thesis_dual = _larger(thesis_dual, slip - gn / mu[i])
        thesis_sum += work
        objective += 0.5 * (work + push)
    return primal, dual, complementarity, weighted, objective, thesis_dual, thesis_sum


@jit
def histogram_of_bits(values, prefix, shift, counts):
    """Count the positive doubles whose bits above `shift + 8` equal `prefix`, by their next 8 bits.

    Positive doubles are ordered like their bits: eight rounds select a quantile exactly.
    """
    flat = values.reshape(-1)
    bits = flat.view(np.int64)
    for i in range(bits.shape[0]):
        if shift == 56 or (bits[i] >> (shift + 8)) == prefix:
            counts[(bits[i] >> shift) & 255] += 1


@jit
def assembled_rows(normal, arm, a, b, dof, columns, indptr, indices, values):
    """CSR rows of D^T: for contact i its normal row and, with friction, its two tangent rows.

    The normal row has no torque (both arms lie along n) and so only the translations.
    dof : 3 or 6 columns a body; columns : (bodies,) first global column of each local body.
    """
    tangential = dof == 6
    at = 0
    row = 0
    for i in range(normal.shape[0]):
        f = _frame(normal[i, 0], normal[i, 1], normal[i, 2])
        for t in range(3 if tangential else 1):
            dx = normal[i, 0] if t == 0 else f[3 * (t - 1)]
            dy = normal[i, 1] if t == 0 else f[3 * (t - 1) + 1]
            dz = normal[i, 2] if t == 0 else f[3 * (t - 1) + 2]
            for side in range(2):
                k = a[i] if side == 0 else b[i]
                if k < 0:
                    continue
                sign = -1.0 if side == 0 else 1.0
                length = arm[i, side]
                first = columns[k]
                indices[at], values[at] = first, sign * dx
                indices[at + 1], values[at + 1] = first + 1, sign * dy
                indices[at + 2], values[at + 2] = first + 2, sign * dz
                at += 3
                if t > 0:
                    # Torque of the unit impulse: -arm n x t on either body.
                    nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
                    indices[at], values[at] = first + 3, -length * (ny * dz - nz * dy)
                    indices[at + 1], values[at + 1] = first + 4, -length * (nz * dx - nx * dz)
                    indices[at + 2], values[at + 2] = first + 5, -length * (nx * dy - ny * dx)
                    at += 3
            row += 1
            indptr[row] = at
