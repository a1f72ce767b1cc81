"""Loops of the Chebyshev transfers: expansions gathered and scattered through symmetries.

P pairs of boxes, m components, N nodes of a grid, s symmetries (see symmetry.Orbits).
"""

from __future__ import annotations

from dem_mpi._jit import jit


@jit
def gather_turned(expansions, box, symmetry, node, component, sign, out):
    """out[p, i, a] = sign[q, i] expansions[box[p], component[q, i], node[q, a]], q = symmetry[p].

    expansions : (boxes, m, N); box, symmetry : (P,); node : (s, N); component, sign : (s, m);
    out : (P, m, N), overwritten
    """
    for p in range(box.size):
        q = symmetry[p]
        for i in range(out.shape[1]):
            source = expansions[box[p], component[q, i]]
            factor = sign[q, i]
            for a in range(out.shape[2]):
                out[p, i, a] = factor * source[node[q, a]]


@jit
def scatter_turned(values, box, symmetry, node, component, sign, scale, expansions):
    """expansions[box[p], i, a] += scale sign[q, i] values[p, component[q, i], node[q, a]].

    Shapes as in `gather_turned`, with `values` (P, m, N) read; pairs are added in their order.
    """
    for p in range(box.size):
        q = symmetry[p]
        for i in range(values.shape[1]):
            target = expansions[box[p], i]
            source = values[p, component[q, i]]
            factor = scale * sign[q, i]
            for a in range(values.shape[2]):
                target[a] += factor * source[node[q, a]]


@jit
def gather_rows(expansions, box, out):
    """out[p] = expansions[box[p]]; expansions (boxes, k), out (P, k)."""
    for p in range(box.size):
        for a in range(out.shape[1]):
            out[p, a] = expansions[box[p], a]


@jit
def scatter_rows(values, box, scale, expansions):
    """expansions[box[p]] += scale values[p]; values (P, k), expansions (boxes, k)."""
    for p in range(box.size):
        for a in range(values.shape[1]):
            expansions[box[p], a] += scale * values[p, a]
