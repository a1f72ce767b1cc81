"""Compiled kernels of the placement: counter-based random numbers, and spheres in linked cells.

Random numbers are words of Philox 4x64-10 (J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw,
SC 2011), a function of a key and a counter alone: whoever needs a number makes it, in any order.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

_LOW_HALF, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)
_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_UNIT, _SHIFT = 2.0**-53, np.uint64(11)
_ROUNDS = 10


@jit
def _high_word(a, b):
    """The upper 64 bits of the 128-bit product of two 64-bit words."""
    a_low, a_high = a & _LOW_HALF, a >> _HALF
    b_low, b_high = b & _LOW_HALF, b >> _HALF
    middle = a_high * b_low + ((a_low * b_low) >> _HALF)
    carry = a_low * b_high + (middle & _LOW_HALF)
    return a_high * b_high + (middle >> _HALF) + (carry >> _HALF)


@jit
def philox(c0, c1, c2, c3, k0, k1):
    """The four words of counter (c0, c1, c2, c3) under key (k0, k1), all uint64."""
    for _ in range(_ROUNDS):
        high0, high1 = _high_word(_M0, c0), _high_word(_M1, c2)
        low0, low1 = _M0 * c0, _M1 * c2
        c0, c1, c2, c3 = high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0
        k0 += _W0
        k1 += _W1
    return c0, c1, c2, c3


@jit
def uniform_numbers(key, index, second, third, stream, blocks, out):
    """Fill out (n, 4 blocks) with uniform numbers in [0, 1).

    Row i comes from the counters (blocks index[i] + 1 + b, second, third, stream), b < blocks:
    with second = third = stream = 0 that is the sequence of numpy's Philox(key) from word
    4 blocks index[i] on, whose first counter is 1.
    """
    k0, k1 = np.uint64(key[0]), np.uint64(key[1])
    c1, c2, c3 = np.uint64(second), np.uint64(third), np.uint64(stream)
    for i in range(len(index)):
        for b in range(blocks):
            c0 = np.uint64(blocks) * np.uint64(index[i]) + np.uint64(b + 1)
            words = philox(c0, c1, c2, c3, k0, k1)
            for w in range(4):
                out[i, 4 * b + w] = np.float64(words[w] >> _SHIFT) * _UNIT
