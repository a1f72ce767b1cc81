"""Compiled loops of the interpolation: points to grids, grids to points, children to parents.

Letters: c component of a weight or value; i, j, k grid nodes along x, y, z; q a point of a chunk;
s, ds the Lagrange polynomials and their derivatives at a point; t coordinate in a box, [-1, 1].

Points go in chunks of `CHUNK`, padded with weight zero to a multiple of `LANES`, so that inner
loops run over whole vector registers; moments pass between levels `COLUMNS` side by side, for the
same reason. Polynomials are evaluated in double, products and moments are of the type of the
moments (double or single). Every moment belongs to one box and is summed in the order of its
points: the number of threads does not change a bit.
"""

from __future__ import annotations

import types
from collections.abc import Callable

import numba
import numpy as np

from dem_mpi._jit import ThreadedKernel, prange

LANES = 8
CHUNK = 32
LEAVES_PER_TASK = 16
COLUMNS = 16


def _fused(function: Callable, *, parallel: bool = False) -> Callable:
    """Compile with products and sums contracted to fused multiply-adds, IEEE otherwise."""
    options = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
    return numba.njit(parallel=parallel, **options)(function)


def _fused_threads(function: Callable) -> ThreadedKernel:
    """Compile as `_fused`, with and without threads in the `prange` loops."""
    # numba's disk cache tells functions apart by name, not by options: the copy needs its own.
    copy = types.FunctionType(function.__code__, function.__globals__, function.__name__)
    copy.__name__ = function.__name__ + "_threads"
    copy.__qualname__ = function.__qualname__ + "_threads"
    copy.__module__ = function.__module__
    return ThreadedKernel(_fused(function), _fused(copy, parallel=True))


@_fused
def lagrange(t, nodes, scale, s):
    """s[i, q] = S_i(t[q]) = scale[i] Π_{j≠i} (t[q] - nodes[j]), as prefix times suffix products.

    Products alone, no division: each S_i has small relative error wherever t lies, and vanishes
    exactly at the other nodes. t : (m,) float64; s : (nodes, m) float64.
    """
    last = len(nodes) - 1
    m = len(t)
    suffix = np.ones(m)
    s[0, :] = 1.0
    for i in range(last):
        for q in range(m):
            s[i + 1, q] = s[i, q] * (t[q] - nodes[i])
    for i in range(last, -1, -1):
        for q in range(m):
            s[i, q] *= suffix[q] * scale[i]
            suffix[q] *= t[q] - nodes[i]


@_fused
def lagrange_derivative(t, nodes, scale, s, ds):
    """As `lagrange`, with ds[i, q] = S_i'(t[q]) by the product rule on prefix and suffix."""
    last = len(nodes) - 1
    m = len(t)
    suffix = np.ones(m)
    d_suffix = np.zeros(m)
    s[0, :] = 1.0
    ds[0, :] = 0.0
    for i in range(last):
        for q in range(m):
            ds[i + 1, q] = ds[i, q] * (t[q] - nodes[i]) + s[i, q]
            s[i + 1, q] = s[i, q] * (t[q] - nodes[i])
    for i in range(last, -1, -1):
        for q in range(m):
            ds[i, q] = (ds[i, q] * suffix[q] + s[i, q] * d_suffix[q]) * scale[i]
            s[i, q] *= suffix[q] * scale[i]
            d_suffix[q] = d_suffix[q] * (t[q] - nodes[i]) + suffix[q]
            suffix[q] *= t[q] - nodes[i]


@_fused
def _local_coordinates(x, axis, first, count, centre, half, t):
    """t[q] = (x[axis, first + q] - centre) / half; the padding of t is put at the centre."""
    inverse = 1.0 / half
    for q in range(count):
        t[q] = (x[axis, first + q] - centre) * inverse
    t[count:] = 0.0


@_fused
def _outer_by_point(s_y, s_z, m, out):
    """out[q, j nodes + k] = s_y[j, q] s_z[k, q]."""
    nodes = len(s_y)
    for j in range(nodes):
        for k in range(nodes):
            for q in range(m):
                out[q, j * nodes + k] = s_y[j, q] * s_z[k, q]


@_fused
def _outer_by_node(s_y, s_z, m, out):
    """out[j nodes + k, q] = s_y[j, q] s_z[k, q]."""
    nodes = len(s_y)
    for j in range(nodes):
        for k in range(nodes):
            row = out[j * nodes + k]
            for q in range(m):
                row[q] = s_y[j, q] * s_z[k, q]


@_fused
def _add_rows(a, rows, m, moments):
    """moments[i, r] += Σ_{q<m} a[i, q] rows[q, r], eight points at a time."""
    for first in range(0, m, 8):
        r0, r1, r2, r3 = rows[first], rows[first + 1], rows[first + 2], rows[first + 3]
        r4, r5, r6, r7 = rows[first + 4], rows[first + 5], rows[first + 6], rows[first + 7]
        for i in range(len(a)):
            a0, a1, a2, a3 = a[i, first], a[i, first + 1], a[i, first + 2], a[i, first + 3]
            a4, a5, a6, a7 = a[i, first + 4], a[i, first + 5], a[i, first + 6], a[i, first + 7]
            moment = moments[i]
            for r in range(len(moment)):
                front = (a0 * r0[r] + a1 * r1[r]) + (a2 * r2[r] + a3 * r3[r])
                back = (a4 * r4[r] + a5 * r5[r]) + (a6 * r6[r] + a7 * r7[r])
                moment[r] += front + back


@_fused
def _contract_rows(row, products, m, total):
    """total[q] = Σ_r row[r] products[r, q], four nodes at a time."""
    size = len(row)
    whole = size - size % 4
    total[:m] = 0
    for r in range(0, whole, 4):
        l0, l1, l2, l3 = row[r], row[r + 1], row[r + 2], row[r + 3]
        p0, p1, p2, p3 = products[r], products[r + 1], products[r + 2], products[r + 3]
        for q in range(m):
            total[q] += (l0 * p0[q] + l1 * p1[q]) + (l2 * p2[q] + l3 * p3[q])
    for r in range(whole, size):
        l0, p0 = row[r], products[r]
        for q in range(m):
            total[q] += l0 * p0[q]


@_fused_threads
def p2m(x, weights, leaves, ranges, centre, half, nodes, scale, moments):
    """moments[b, c, i, j, k] += Σ_q weights[c, q] S_i(x_q) S_j(y_q) S_k(z_q) (B eq. 1.17).

    x : (3, n) float64; weights : (n_in, n); leaves : boxes b to be filled; ranges : (boxes, 2)
    first and past-the-last point; centre : (boxes, 3); half : (boxes,) half edges; nodes, scale :
    (nodes,) of the grid; moments : (boxes, n_in, nodes², nodes) contiguous, any float type.
    """
    size = len(nodes)
    n_in = len(weights)
    tasks = -(-len(leaves) // LEAVES_PER_TASK)
    for task in prange(tasks):
        t = np.zeros(CHUNK)
        s = np.zeros((3, size, CHUNK))
        a = np.zeros((size, CHUNK), moments.dtype)
        rows = np.zeros((CHUNK, size * size), moments.dtype)
        for leaf in range(task * LEAVES_PER_TASK, min((task + 1) * LEAVES_PER_TASK, len(leaves))):
            b = leaves[leaf]
            for first in range(ranges[b, 0], ranges[b, 1], CHUNK):
                count = min(CHUNK, ranges[b, 1] - first)
                m = -(-count // LANES) * LANES
                for axis in range(3):
                    _local_coordinates(x, axis, first, count, centre[b, axis], half[b], t)
                    lagrange(t[:m], nodes, scale, s[axis, :, :m])
                _outer_by_point(s[1], s[2], m, rows)
                for c in range(n_in):
                    for i in range(size):
                        for q in range(count):
                            a[i, q] = weights[c, first + q] * s[0, i, q]
                        a[i, count:m] = 0
                    _add_rows(a, rows, m, moments[b, c])


@_fused_threads
def p2m_gradient(x, weights, leaves, ranges, centre, half, nodes, scale, moments):
    """As `p2m` with the polynomials differentiated along the source (B eq. 1.12).

    moments[b, c, α] += Σ_q Σ_a weights[3 c + a, q] ∂S_α/∂y_a(y_q); weights : (3 n_in, n).
    """
    size = len(nodes)
    n_in = len(weights) // 3
    tasks = -(-len(leaves) // LEAVES_PER_TASK)
    for task in prange(tasks):
        t = np.zeros(CHUNK)
        s = np.zeros((3, size, CHUNK))
        ds = np.zeros((3, size, CHUNK))
        a = np.zeros((size, CHUNK), moments.dtype)
        weighted = np.zeros((2, size, CHUNK))
        rows = np.zeros((CHUNK, size * size), moments.dtype)
        more = np.zeros((CHUNK, size * size), moments.dtype)
        for leaf in range(task * LEAVES_PER_TASK, min((task + 1) * LEAVES_PER_TASK, len(leaves))):
            b = leaves[leaf]
            inverse = 1.0 / half[b]
            for first in range(ranges[b, 0], ranges[b, 1], CHUNK):
                count = min(CHUNK, ranges[b, 1] - first)
                m = -(-count // LANES) * LANES
                for axis in range(3):
                    _local_coordinates(x, axis, first, count, centre[b, axis], half[b], t)
                    lagrange_derivative(t[:m], nodes, scale, s[axis, :, :m], ds[axis, :, :m])
                for c in range(n_in):
                    # w_x S_i' (S_j S_k): the first of three products of the gradient.
                    _outer_by_point(s[1], s[2], m, rows)
                    for i in range(size):
                        for q in range(count):
                            a[i, q] = weights[3 * c, first + q] * inverse * ds[0, i, q]
                        a[i, count:m] = 0
                    _add_rows(a, rows, m, moments[b, c])
                    # S_i (w_y S_j' S_k + w_z S_j S_k'): the others share their row.
                    for i in range(size):
                        for q in range(count):
                            weighted[0, i, q] = weights[3 * c + 1, first + q] * ds[1, i, q]
                            weighted[1, i, q] = weights[3 * c + 2, first + q] * s[1, i, q]
                            a[i, q] = inverse * s[0, i, q]
                        weighted[:, i, count:m] = 0.0
                        a[i, count:m] = 0
                    _outer_by_point(weighted[0], s[2], m, rows)
                    _outer_by_point(weighted[1], ds[2], m, more)
                    rows[:m] += more[:m]
                    _add_rows(a, rows, m, moments[b, c])


@_fused_threads
def l2p(x, locals_, leaves, ranges, centre, half, nodes, scale, out):
    """out[c, q] += Σ_ijk locals_[b, c, i, j, k] S_i(x_q) S_j(y_q) S_k(z_q) (B eq. 1.21).

    The transpose of `p2m`, with its shapes; out : (n_out, n) float64.
    """
    size = len(nodes)
    n_out = len(out)
    tasks = -(-len(leaves) // LEAVES_PER_TASK)
    for task in prange(tasks):
        t = np.zeros(CHUNK)
        s = np.zeros((3, size, CHUNK))
        products = np.zeros((size * size, CHUNK), locals_.dtype)
        total = np.zeros(CHUNK, locals_.dtype)
        value = np.zeros(CHUNK)
        for leaf in range(task * LEAVES_PER_TASK, min((task + 1) * LEAVES_PER_TASK, len(leaves))):
            b = leaves[leaf]
            for first in range(ranges[b, 0], ranges[b, 1], CHUNK):
                count = min(CHUNK, ranges[b, 1] - first)
                m = -(-count // LANES) * LANES
                for axis in range(3):
                    _local_coordinates(x, axis, first, count, centre[b, axis], half[b], t)
                    lagrange(t[:m], nodes, scale, s[axis, :, :m])
                _outer_by_node(s[1], s[2], m, products)
                for c in range(n_out):
                    value[:] = 0.0
                    for i in range(size):
                        _contract_rows(locals_[b, c, i], products, m, total)
                        for q in range(m):
                            value[q] += s[0, i, q] * total[q]
                    for q in range(count):
                        out[c, first + q] += value[q]


@_fused_threads
def l2p_gradient(x, locals_, leaves, ranges, centre, half, nodes, scale, out):
    """As `l2p` with the polynomials differentiated along the target: the transpose of
    `p2m_gradient`, out[3 c + a, q] += Σ_α locals_[b, c, α] ∂S_α/∂x_a(x_q); out : (3 n_out, n).
    """
    size = len(nodes)
    n_out = len(out) // 3
    tasks = -(-len(leaves) // LEAVES_PER_TASK)
    for task in prange(tasks):
        t = np.zeros(CHUNK)
        s = np.zeros((3, size, CHUNK))
        ds = np.zeros((3, size, CHUNK))
        products = np.zeros((3, size * size, CHUNK), locals_.dtype)
        total = np.zeros((3, CHUNK), locals_.dtype)
        value = np.zeros((3, CHUNK))
        for leaf in range(task * LEAVES_PER_TASK, min((task + 1) * LEAVES_PER_TASK, len(leaves))):
            b = leaves[leaf]
            inverse = 1.0 / half[b]
            for first in range(ranges[b, 0], ranges[b, 1], CHUNK):
                count = min(CHUNK, ranges[b, 1] - first)
                m = -(-count // LANES) * LANES
                for axis in range(3):
                    _local_coordinates(x, axis, first, count, centre[b, axis], half[b], t)
                    lagrange_derivative(t[:m], nodes, scale, s[axis, :, :m], ds[axis, :, :m])
                _outer_by_node(s[1], s[2], m, products[0])
                _outer_by_node(ds[1], s[2], m, products[1])
                _outer_by_node(s[1], ds[2], m, products[2])
                for c in range(n_out):
                    value[:] = 0.0
                    for i in range(size):
                        for a in range(3):
                            _contract_rows(locals_[b, c, i], products[a], m, total[a])
                        for q in range(m):
                            value[0, q] += ds[0, i, q] * total[0, q]
                            value[1, q] += s[0, i, q] * total[1, q]
                            value[2, q] += s[0, i, q] * total[2, q]
                    for a in range(3):
                        for q in range(count):
                            out[3 * c + a, first + q] += inverse * value[a, q]


@_fused
def _contract(matrix, inputs, out):
    """out[o, i, r] += Σ_j matrix[i, j] inputs[o, j, r], four inputs to a pass over r."""
    outer, size, inner = inputs.shape
    odd = size % 4
    for o in range(outer):
        for i in range(size):
            if odd == 1:
                m0 = matrix[i, 0]
                for r in range(inner):
                    out[o, i, r] += m0 * inputs[o, 0, r]
            elif odd == 2:
                m0, m1 = matrix[i, 0], matrix[i, 1]
                for r in range(inner):
                    out[o, i, r] += m0 * inputs[o, 0, r] + m1 * inputs[o, 1, r]
            elif odd == 3:
                m0, m1, m2 = matrix[i, 0], matrix[i, 1], matrix[i, 2]
                for r in range(inner):
                    front = m0 * inputs[o, 0, r] + m1 * inputs[o, 1, r]
                    out[o, i, r] += front + m2 * inputs[o, 2, r]
            for j in range(odd, size, 4):
                m0, m1, m2, m3 = matrix[i, j], matrix[i, j + 1], matrix[i, j + 2], matrix[i, j + 3]
                for r in range(inner):
                    front = m0 * inputs[o, j, r] + m1 * inputs[o, j + 1, r]
                    back = m2 * inputs[o, j + 2, r] + m3 * inputs[o, j + 3, r]
                    out[o, i, r] += front + back


@_fused
def _family(parents, children, first, n_components, family, components):
    """The boxes of a batch of columns (parent, component): parents in row 8, children above."""
    for lane in range(len(components)):
        column = first + lane
        if column < len(parents) * n_components:
            parent = parents[column // n_components]
            family[:8, lane] = children[parent]
            family[8, lane] = parent
            components[lane] = column % n_components
        else:
            family[:, lane] = -1
            components[lane] = 0


@_fused_threads
def m2m(parents, children, matrices, moments):
    """moments[parent] += Σ_children (A_x ⊗ A_y ⊗ A_z) moments[child] (B eq. 1.18).

    Siblings that share their halves along the remaining axes are summed as soon as one axis is
    contracted: 8 + 4 + 2 contractions instead of 24. Along x the rows of a box are long enough
    for vectors; for y and z, `COLUMNS` columns (parent, component) are put side by side.

    parents : boxes to be added to; children : (boxes, 8) by octant (bit a: half of axis a), -1
    absent; matrices : (2, nodes, nodes) of the moments' type, [h, i, j] = S_i(node j of half h);
    moments : (boxes, components, nodes³) contiguous.
    """
    size = matrices.shape[1]
    plane = size * size
    n_components = moments.shape[1]
    x_rows, y_rows, z_rows = (1, size, plane), (size, size, size * COLUMNS), (plane, size, COLUMNS)
    batches = -(-len(parents) * n_components // COLUMNS)
    for batch in prange(batches):
        family = np.empty((9, COLUMNS), np.int64)
        components = np.empty(COLUMNS, np.int64)
        column = np.empty(plane * size, moments.dtype)
        along_x = np.empty((plane * size, COLUMNS), moments.dtype)
        along_xy = np.empty((plane * size, COLUMNS), moments.dtype)
        total = np.zeros((plane * size, COLUMNS), moments.dtype)
        _family(parents, children, batch * COLUMNS, n_components, family, components)
        for z in range(2):
            along_xy[:] = 0
            for y in range(2):
                for lane in range(COLUMNS):
                    column[:] = 0
                    for x in range(2):
                        child = family[x + 2 * y + 4 * z, lane]
                        if child >= 0:
                            source = moments[child, components[lane]]
                            _contract(matrices[x], source.reshape(x_rows), column.reshape(x_rows))
                    for n in range(plane * size):
                        along_x[n, lane] = column[n]
                _contract(matrices[y], along_x.reshape(y_rows), along_xy.reshape(y_rows))
            _contract(matrices[z], along_xy.reshape(z_rows), total.reshape(z_rows))
        for lane in range(COLUMNS):
            if family[8, lane] >= 0:
                target = moments[family[8, lane], components[lane]]
                for n in range(plane * size):
                    target[n] += total[n, lane]


@_fused_threads
def l2l(parents, children, matrices, locals_):
    """locals_[child] += (A_xᵀ ⊗ A_yᵀ ⊗ A_zᵀ) locals_[parent] (B eq. 1.20): the transpose of `m2m`.

    Arguments as there, but for matrices : (2, nodes, nodes), [h, j, i] = S_i(node j of half h).
    """
    size = matrices.shape[1]
    plane = size * size
    n_components = locals_.shape[1]
    x_rows, y_rows, z_rows = (1, size, plane), (size, size, size * COLUMNS), (plane, size, COLUMNS)
    batches = -(-len(parents) * n_components // COLUMNS)
    for batch in prange(batches):
        family = np.empty((9, COLUMNS), np.int64)
        components = np.empty(COLUMNS, np.int64)
        column = np.empty(plane * size, locals_.dtype)
        source = np.zeros((plane * size, COLUMNS), locals_.dtype)
        along_z = np.empty((plane * size, COLUMNS), locals_.dtype)
        along_yz = np.empty((plane * size, COLUMNS), locals_.dtype)
        _family(parents, children, batch * COLUMNS, n_components, family, components)
        for lane in range(COLUMNS):
            if family[8, lane] >= 0:
                parent = locals_[family[8, lane], components[lane]]
                for n in range(plane * size):
                    source[n, lane] = parent[n]
        for z in range(2):
            along_z[:] = 0
            _contract(matrices[z], source.reshape(z_rows), along_z.reshape(z_rows))
            for y in range(2):
                along_yz[:] = 0
                _contract(matrices[y], along_z.reshape(y_rows), along_yz.reshape(y_rows))
                for lane in range(COLUMNS):
                    lower, upper = family[2 * y + 4 * z, lane], family[1 + 2 * y + 4 * z, lane]
                    if lower < 0 and upper < 0:
                        continue
                    for n in range(plane * size):
                        column[n] = along_yz[n, lane]
                    for x, child in enumerate((lower, upper)):
                        if child >= 0:
                            target = locals_[child, components[lane]]
                            _contract(matrices[x], column.reshape(x_rows), target.reshape(x_rows))
