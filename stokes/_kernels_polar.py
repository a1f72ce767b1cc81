"""Compiled resampling of vector fields between polar grids on the sphere of directions.

A polar grid has rings at Gauss-Legendre nodes of panels in s, the angle from its pole over pi. A
field on it is held by coefficients c (nodes, modes + 1, 3), complex: with the components (radial,
azimuthal, axial) in the frame of the point's own azimuth phi,

    (f_r, f_phi / i, f_z) = c_0 + 2 Re-part of sum over n > 0 of c_n e^{i n phi}.

A grid whose sign is -1 has its pole in the direction -z of its frame, phi being measured alike.
"""

from __future__ import annotations

import math

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange


@jit
def _panel_weights(s, panels, nodes, breaks, gauss, barycentric, weights):
    """Fill the weights of the values at a panel's nodes for the value at s; return the panel."""
    panel = 0
    while panel < panels - 1 and s > breaks[panel + 1]:
        panel += 1
    x = 2.0 * (s - breaks[panel]) / (breaks[panel + 1] - breaks[panel]) - 1.0
    total = 0.0
    for q in range(nodes):
        distance = x - gauss[q]
        if distance == 0.0:
            weights[:nodes] = 0.0
            weights[q] = 1.0
            return panel
        weights[q] = barycentric[q] / distance
        total += weights[q]
    for q in range(nodes):
        weights[q] /= total
    return panel


@jit
def _value(sums, modes, cos, sin, vector):
    """Components along (x, y, z) of the field whose modes at the point are `sums`."""
    radial, azimuthal, axial = sums[0].real, -sums[1].imag, sums[2].real
    phase_re, phase_im = 1.0, 0.0
    for n in range(1, modes + 1):
        phase_re, phase_im = phase_re * cos - phase_im * sin, phase_re * sin + phase_im * cos
        r, p, z = sums[3 * n], sums[3 * n + 1], sums[3 * n + 2]
        radial += 2.0 * (r.real * phase_re - r.imag * phase_im)
        azimuthal -= 2.0 * (p.real * phase_im + p.imag * phase_re)
        axial += 2.0 * (z.real * phase_re - z.imag * phase_im)
    vector[0] = cos * radial - sin * azimuthal
    vector[1] = sin * radial + cos * azimuthal
    vector[2] = axial


@jit_threads
def resample(tables, targets, jobs, coefficients, directions, out):
    """Sum fields given on polar grids at directions.

    tables  : (panels (g,), nodes (g,), modes (g,), sign (g,), breaks (g, .), gauss (g, .),
              barycentric (g, .)) of the grids
    targets : (first direction (t,), number of directions (t,), first row of `out` (t,),
              first job (t + 1,))
    jobs    : (grid (j,), first coefficient (j,), turn (j, 3, 3): target's frame to grid's)
    coefficients : flat, complex; directions (., 3) in targets' frames; out (rows, 3), overwritten
    """
    panels, nodes, modes, sign, breaks, gauss, barycentric = tables
    first_direction, count, first_row, first_job = targets
    grid_of, start_of, turns = jobs
    for target in prange(len(count)):
        weights = np.empty(gauss.shape[1])
        vector = np.empty(3)
        rows = out[first_row[target] : first_row[target] + count[target]]
        rows[:] = 0.0
        for job in range(first_job[target], first_job[target + 1]):
            g, turn = grid_of[job], turns[job]
            width = 3 * (modes[g] + 1)
            sums = np.empty(width, dtype=np.complex128)
            for k in range(count[target]):
                d = directions[first_direction[target] + k]
                x = turn[0, 0] * d[0] + turn[0, 1] * d[1] + turn[0, 2] * d[2]
                y = turn[1, 0] * d[0] + turn[1, 1] * d[1] + turn[1, 2] * d[2]
                z = turn[2, 0] * d[0] + turn[2, 1] * d[1] + turn[2, 2] * d[2]
                radius = math.hypot(x, y)
                cos, sin = (x / radius, y / radius) if radius > 0.0 else (1.0, 0.0)
                s = math.atan2(radius, sign[g] * z) / math.pi
                panel = _panel_weights(
                    s, panels[g], nodes[g], breaks[g], gauss[g], barycentric[g], weights
                )
                first = start_of[job] + panel * nodes[g] * width
                sums[:] = 0.0
                for q in range(nodes[g]):
                    ring = coefficients[first + q * width : first + (q + 1) * width]
                    for i in range(width):
                        sums[i] += weights[q] * ring[i]
                _value(sums, modes[g], cos, sin, vector)
                for i in range(3):
                    rows[k, i] += (
                        turn[0, i] * vector[0] + turn[1, i] * vector[1] + turn[2, i] * vector[2]
                    )


@jit_threads
def analyse(values, first_value, first_ring, rings, modes, first_coefficient, coefficients):
    """Coefficients of fields from their values at equal angles on every ring of polar grids.

    values (rows, 3), Cartesian; side k has the rows from first_value[k] on, its rings hold
    rings[first_ring[k] : first_ring[k + 1]] angles each, and its coefficients are written from
    first_coefficient[k] on.
    """
    for side in prange(len(first_value)):
        row, place = first_value[side], first_coefficient[side]
        for ring in range(first_ring[side], first_ring[side + 1]):
            angles = rings[ring]
            block = coefficients[place : place + 3 * (modes + 1)]
            block[:] = 0.0
            for k in range(angles):
                phi = 2.0 * math.pi * k / angles
                cos, sin = math.cos(phi), math.sin(phi)
                x, y, z = values[row + k]
                radial, azimuthal = (cos * x + sin * y) / angles, (cos * y - sin * x) / angles
                phase_re, phase_im = 1.0, 0.0
                for n in range(modes + 1):
                    # -i times the azimuthal component: the real form of modes
                    phase = complex(phase_re, -phase_im)
                    block[3 * n] += radial * phase
                    block[3 * n + 1] += azimuthal * complex(-phase_im, -phase_re)
                    block[3 * n + 2] += z / angles * phase
                    phase_re, phase_im = (
                        phase_re * cos - phase_im * sin,
                        phase_re * sin + phase_im * cos,
                    )
            row += angles
            place += 3 * (modes + 1)
