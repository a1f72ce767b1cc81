"""Compiled loops of the near field: which panels are close, graded nodes, blocks of modes.

Symbols: r, z a target in the meridian plane of a unit shape; s the parameter of the meridian;
q nodes of a panel; N azimuths; xi = 2 asinh(|x - y| / (2 sqrt(r r'))) the rate e^{-N xi} of the
trapezoidal rule about the axis; rho the parameter of the Bernstein ellipse through the complex
parameter s0 at which the analytic curve meets the target: the rate rho^{-2q} of the Gauss rule.
"""

from __future__ import annotations

import cmath
import math

from dem_mpi._jit import jit, jit_threads, prange

# Pieces of a panel on which a graded rule puts its nodes have at least this Bernstein parameter
# with respect to the target: half the first piece, in heights of s0, and growth of the next ones.
ELLIPSE = 3.0
_FIRST = 2.0 / (ELLIPSE - 1.0 / ELLIPSE)
_GROWTH = 4.0  # (u + l/2)/(l/2) = (ELLIPSE + 1/ELLIPSE)/2 for the piece from u to u + l
# s0 comes from a quadratic expansion of the curve: its height is taken smaller than found.
_TRUST = 0.9


@jit
def nearest_node(r, z, node, first, q):
    """Row of the node nearest to the target among first .. first + q.

    node: rows s, r, z, r', z', r'', z''.
    """
    best, j = math.inf, first
    for k in range(first, first + q):
        d2 = (r - node[k, 1]) ** 2 + (z - node[k, 2]) ** 2
        if d2 < best:
            best, j = d2, k
    return j


@jit
def preimage(r, z, node, j):
    """s0 with gamma(s0) = r + i z of the curve continued to second order about node j."""
    e = complex(r - node[j, 1], z - node[j, 2])
    slope = complex(node[j, 3], node[j, 4])
    bend = 0.5 * complex(node[j, 5], node[j, 6])
    root = cmath.sqrt(slope * slope + 4.0 * bend * e)
    if (root * slope.conjugate()).real < 0.0:
        root = -root
    return node[j, 0] + 2.0 * e / (slope + root)


@jit
def _nearest_point(r, z, node, j, begin, end):
    """(distance, radius there) of the panel's point nearest to the target, on the tangent at j."""
    speed = math.hypot(node[j, 3], node[j, 4])
    dr, dz = r - node[j, 1], z - node[j, 2]
    along = (dr * node[j, 3] + dz * node[j, 4]) / speed
    across = (dz * node[j, 3] - dr * node[j, 4]) / speed
    foot = min(max(along, speed * (begin - node[j, 0])), speed * (end - node[j, 0]))
    return math.hypot(across, along - foot), max(node[j, 1] + foot * node[j, 3] / speed, 0.0)


@jit
def _least_xi(r, z, distance, radius, node, first, q):
    """Least xi over the panel: at its nodes and its nearest point, of this distance, radius."""
    least = distance * distance / (radius + 1e-300)
    for k in range(first, first + q):
        d2 = (r - node[k, 1]) ** 2 + (z - node[k, 2]) ** 2
        least = min(least, d2 / (node[k, 1] + 1e-300))
    return 2.0 * math.asinh(0.5 * math.sqrt(least / r)) if r > 0.0 else math.inf


@jit_threads
def needed_refinement(
    r, z, shape, out_start, node, first_node, edge, first_edge, nodes, angles, logs, out
):
    """How many times as many azimuths and nodes each panel needs for each target.

    r, z, shape : (k,) targets and number of the unit shape each is close to
    node (n, 7), edge : nodes and panel edges of all shapes, from first_node, first_edge on
    nodes, angles : q, N of each shape
    logs : (log(C/tol), power): e^{-N xi} and rho^{-2q} are to be below tol/C distance^-power
    out : (sum of panels, 2), rows from out_start[i] on of target i
    """
    log_tolerance, power = logs
    for i in prange(len(r)):
        h = shape[i]
        q, e = nodes[h], first_edge[h]
        for k in range(first_edge[h + 1] - e - 1):
            first = first_node[h] + k * q
            begin, end = edge[e + k], edge[e + k + 1]
            j = nearest_node(r[i], z[i], node, first, q)
            distance, radius = _nearest_point(r[i], z[i], node, j, begin, end)
            digits = max(log_tolerance + power * math.log(min(distance, 1.0) + 1e-300), 1.0)
            xi = _least_xi(r[i], z[i], distance, radius, node, first, q)
            t = (2.0 * preimage(r[i], z[i], node, j) - (begin + end)) / (end - begin)
            w = abs(t + cmath.sqrt(t * t - 1.0))
            rate = abs(math.log(w)) if w > 0.0 else math.inf
            row = out_start[i] + k
            out[row, 0] = digits / (angles[h] * xi) if xi > 0.0 else math.inf
            out[row, 1] = digits / (2.0 * q * rate) if rate > 0.0 else math.inf


@jit
def preimages(r, z, first, q, node, out):
    """s0 (k,) complex of targets and panels given by their first node."""
    for i in range(len(r)):
        out[i] = preimage(r[i], z[i], node, nearest_node(r[i], z[i], node, first[i], q))


@jit
def graded_pieces(s0, begin, end, count, pieces):
    """Cut each [begin, end] into pieces graded towards s0; count (k,) of each, rows of pieces.

    With an empty array of pieces they are counted only.
    """
    total = 0
    for i in range(len(s0)):
        x, y = s0[i].real, _TRUST * abs(s0[i].imag)
        a, b = begin[i], end[i]
        u = max(_FIRST * y, 1e-15)
        before = total
        low, high = max(a, x - u), min(b, x + u)
        if high > low:
            if len(pieces) > 0:
                pieces[total, 0], pieces[total, 1] = low, high
            total += 1
        while x - u > a or x + u < b:
            v = _GROWTH * u
            low, high = max(a, x + u), min(b, x + v)
            if high > low:
                if len(pieces) > 0:
                    pieces[total, 0], pieces[total, 1] = low, high
                total += 1
            low, high = max(a, x - v), min(b, x - u)
            if high > low:
                if len(pieces) > 0:
                    pieces[total, 0], pieces[total, 1] = low, high
                total += 1
            u = v
        count[i] = total - before
    return total


@jit
def add_to_blocks(modal, weight, rows, sample, begin, block):
    """block[(n, i, c, j)] += weight modal[n, i, c] rows[j], over the nodes of every sample.

    modal : (k, n_max + 1, n_rows, 3) kernels at nodes; rows (k, q) interpolation from the panel
    sample : (k,) of each node, begin : first number in `block` of each sample's
    """
    n_modes, n_rows = modal.shape[1], modal.shape[2]
    q = rows.shape[1]
    for k in range(len(weight)):
        at = begin[sample[k]]
        for n in range(n_modes):
            for i in range(n_rows):
                for c in range(3):
                    value = weight[k] * modal[k, n, i, c]
                    for j in range(q):
                        block[at + j] += value * rows[k, j]
                    at += q


@jit_threads
def apply_blocks(block, begin, n_max, width, theta, odd, density, first, fields, out):
    """Fields at targets of blocks of modes: (e, rows, m), components in the target's frame.

    block : all blocks, (n, row, (c, j)) each from begin[e] on, n = 0..n_max[e], width 3 q
    odd   : (rows,) whether a row is odd in the azimuth: multiplied by i
    density : coefficients (n, 2 m, (c, j)) of every panel, from first[e] on
    """
    n_rows = len(odd)
    for e in prange(len(begin)):
        at, w = begin[e], width[e]
        for n in range(n_max[e] + 1):
            factor = 1.0 if n == 0 else 2.0
            cosine, sine = factor * math.cos(n * theta[e]), factor * math.sin(n * theta[e])
            for f in range(fields):
                real = first[e] + (n * 2 * fields + 2 * f) * w
                imag = real + w
                for i in range(n_rows):
                    row = at + i * w
                    a = b = 0.0
                    for k in range(w):
                        value = block[row + k]
                        a += value * density[real + k]
                        b += value * density[imag + k]
                    if odd[i]:
                        out[e, i, f] -= a * sine + b * cosine
                    else:
                        out[e, i, f] += a * cosine - b * sine
            at += n_rows * w
