"""Modes of the plain product rule: what a sum over the surface nodes does to a density's modes.

With sources at equal azimuths the sum K(x, y) w over all nodes is circulant in the azimuth, so each
mode n of the density is multiplied by sum over l of K~(t_l) e^{-i n t_l}, t_l = 2 pi l / n_theta:
the discrete transform of the kernel in the frames of its points, aliases included. Terms with
x = y, where the kernel has no value, are left out, as a fast summation does.

Symbols: x - y has the components a (frame of x) and b (frame of y); nu the normals; t the
difference of azimuths; r, z, radius and height of x, r_, z_ of y; R11 ... R33 the real form.
"""

from __future__ import annotations

import math

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange

SINGLE, DOUBLE, TRACTION = 0, 1, 2


@jit_threads
def plain_modes(layer, target, source, weight, step, cosine, sine, out):
    """out[n, i + c n_t, j + d n_s] = (R_cd)_n between target i and source j, times weight[j].

    target, source : (n_t, 4), (n_s, 4) r, z, nu_r, nu_z;  weight : (n_s,) length r speed of j
    cosine, sine   : (n_theta // 2 + 1, modes + 1) cos(n t_l), sin(n t_l) times `step` = 2 pi /
                     n_theta, twice that where -t_l is another azimuth than t_l
    """
    n_t, n_s = target.shape[0], source.shape[0]
    n_modes = cosine.shape[1]
    for i in prange(n_t):
        block = np.empty(9)
        total = np.empty((9, n_modes))
        for j in range(n_s):
            total[:] = 0.0
            for k in range(cosine.shape[0]):
                if not _kernel(layer, target[i], source[j], k * step, block):
                    continue
                for e in range(9):
                    # Entries that couple the azimuthal component to others are odd in t.
                    odd = e == 1 or e == 3 or e == 5 or e == 7
                    table = sine if odd else cosine
                    value = weight[j] * block[e]
                    for n in range(n_modes):
                        total[e, n] += value * table[k, n]
            for e in range(9):
                sign = -1.0 if e == 3 or e == 5 else 1.0  # K21 = i R21, K23 = i R23; else -i R
                for n in range(n_modes):
                    out[n, i + (e // 3) * n_t, j + (e % 3) * n_s] = sign * total[e, n]


@jit
def _kernel(layer, x, y, t, block):
    """The kernel between x and y, t apart, in their frames, row by row; False where x = y."""
    dr, dz = x[0] - y[0], x[1] - y[1]
    c, s = math.cos(t), math.sin(t)
    half = 2.0 * math.sin(0.5 * t) ** 2  # 1 - cos t
    R2 = dr * dr + dz * dz + 2.0 * x[0] * y[0] * half
    if R2 == 0.0:
        return False
    a = (dr + y[0] * half, y[0] * s, dz)
    b = (dr - x[0] * half, x[0] * s, dz)
    R = math.sqrt(R2)
    if layer == SINGLE:
        factor = 1.0 / (8.0 * math.pi * R2 * R)
    elif layer == DOUBLE:
        factor = 3.0 / (4.0 * math.pi) * (y[2] * b[0] + y[3] * dz) / (R2 * R2 * R)
    else:
        factor = -3.0 / (4.0 * math.pi) * (x[2] * a[0] + x[3] * dz) / (R2 * R2 * R)
    for e in range(9):
        block[e] = factor * a[e // 3] * b[e % 3]
    if layer == SINGLE:
        delta = 1.0 / (8.0 * math.pi * R)
        block[0] += delta * c
        block[1] += delta * s
        block[3] -= delta * s
        block[4] += delta * c
        block[8] += delta
    return True
