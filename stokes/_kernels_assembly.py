"""Compiled assembly of the modal matrices of a layer potential: Nyström's method, row by row."""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange
from stokes._kernels_modal import modal_modes, new_workspace


@jit_threads
def assemble(kind, nodes, weight, difference, offsets, panel_nodes, first, rule, out):
    """out[n, i + a T, j + b N]: mode n, from component b at node j to component a at node i.

    nodes       : (N, 4) r, z, nu_r, nu_z;  weight : (N,) line weight times r
    difference, offsets : (T, N, 2) of the first T nodes as targets and all, see `stokes.modal`
    first       : (T + 1,) first pair of each target in the rule
    rule        : pairs (m, 2), starts (m + 1,), weights times r (q,), interpolation
                  (q, panel_nodes), points (q, 4), difference (q, 2), offsets (q, 2)
    """
    pairs, starts, rule_weight, interpolation, points, rule_difference, rule_offsets = rule
    T, N = difference.shape[0], nodes.shape[0]
    n_max = out.shape[0] - 1
    for i in prange(T):
        workspace = new_workspace(n_max)
        block = np.empty((n_max + 1, 3, 3))
        row = np.zeros((n_max + 1, 3, 3, N))
        target = (nodes[i, 0], nodes[i, 2], nodes[i, 3])
        pair = first[i]
        for panel in range(N // panel_nodes):
            start = panel * panel_nodes
            if pair < first[i + 1] and pairs[pair, 1] == panel:
                for q in range(starts[pair], starts[pair + 1]):
                    _modes(
                        *(kind, target, points[q], rule_difference[q], rule_offsets[q]),
                        *(n_max, workspace, block),
                    )
                    _spread(rule_weight[q], block, interpolation[q], start, row)
                pair += 1
            else:
                for j in range(start, start + panel_nodes):
                    _modes(
                        *(kind, target, nodes[j], difference[i, j], offsets[i, j]),
                        *(n_max, workspace, block),
                    )
                    row[:, :, :, j] = weight[j] * block
        for n in range(n_max + 1):
            for a in range(3):
                for b in range(3):
                    out[n, i + a * T, b * N : (b + 1) * N] = row[n, a, b]


@jit
def _modes(kind, target, source, difference, offsets, n_max, workspace, block):
    modal_modes(
        kind,
        target,
        (source[0], source[2], source[3]),
        difference[0],
        difference[1],
        (offsets[0], offsets[1]),
        n_max,
        workspace,
        block,
    )


@jit
def _spread(weight, block, interpolation, start, row):
    """Add what a node of a rule takes from the panel's own nodes."""
    for n in range(block.shape[0]):
        for a in range(3):
            for b in range(3):
                value = weight * block[n, a, b]
                for j in range(interpolation.shape[0]):
                    row[n, a, b, start + j] += value * interpolation[j]
