"""A permutation as places among the numbers that it has not used yet, and back.

A tree of partial sums (P. M. Fenwick, Softw. Pract. Exper. 24, 1994) counts the unused numbers
below any one, and finds the one with so many below it, in about log2 n steps.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit


@jit
def displacements(sequence, from_last):
    """Places (n,) int64 of the numbers of a permutation (n,) of 0 ... n-1.

    place_i = #{unused x < sequence_i} - start_i, where start_i is 0, or, `from_last`, the number
    of unused x < sequence_{i-1}: 0 then means the next unused number behind the last one.
    """
    n = len(sequence)
    tree = _all_unused(n)
    place = np.empty(n, np.int64)
    start = 0
    for i in range(n):
        below = _unused_below(tree, sequence[i])
        place[i] = below - start
        _use(tree, sequence[i])
        if from_last:
            start = below
    return place


@jit
def from_displacements(place, from_last):
    """The permutation (n,) int64 of such places; its length is 0 where there is none."""
    n = len(place)
    tree = _all_unused(n)
    sequence = np.empty(n, np.int64)
    start = 0
    for i in range(n):
        below = start + place[i]
        if place[i] <= -n or place[i] >= n or below < 0 or below >= n - i:
            return sequence[:0]
        sequence[i] = _unused_with(tree, below)
        _use(tree, sequence[i])
        if from_last:
            start = below
    return sequence


@jit
def _all_unused(n):
    """Entry k counts the unused numbers from k - (lowest bit of k) to k - 1."""
    tree = np.empty(n + 1, np.int64)
    for k in range(n + 1):
        tree[k] = k & -k
    return tree


@jit
def _unused_below(tree, number):
    count = 0
    k = number
    while k > 0:
        count += tree[k]
        k -= k & -k
    return count


@jit
def _use(tree, number):
    k = number + 1
    while k < len(tree):
        tree[k] -= 1
        k += k & -k


@jit
def _unused_with(tree, below):
    """The unused number that has so many unused ones below it."""
    bit = 1
    while 2 * bit < len(tree):
        bit *= 2
    k = 0
    while bit > 0:
        if k + bit < len(tree) and tree[k + bit] <= below:
            k += bit
            below -= tree[k]
        bit //= 2
    return k
