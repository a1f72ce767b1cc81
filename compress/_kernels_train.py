"""Compiled products of cores, each entry summed in one order: the same bits on every machine."""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit


@jit
def extend(rows, parent, digit, core):
    """Rows (m, s) of a longer part of a train: out[i] = rows[parent[i]] core[:, digit[i], :].

    rows : (p, r); parent, digit : (m,) int64; core : (r, n, s)
    """
    out = np.zeros((parent.size, core.shape[2]))
    for i in range(parent.size):
        for a in range(core.shape[0]):
            value = rows[parent[i], a]
            if value != 0.0:
                for b in range(core.shape[2]):
                    out[i, b] += value * core[a, digit[i], b]
    return out


@jit
def multiply(left, right):
    """left (m, r) right (r, c), summed in the order of r."""
    out = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            value = left[i, k]
            if value != 0.0:
                for j in range(right.shape[1]):
                    out[i, j] += value * right[k, j]
    return out
