"""Compiled coder of a matrix of integers, row by row, each entry by what its row has shown so far.

The entries of a row (the coefficients of a body) are small or large together. Entry q of column k
is therefore coded by the magnitude to be expected of it: the mean magnitude m_k of its column
times how much larger than expected the row has been until now, on a scale of half octaves, and by
whether the two entries before it vanish. Every decision (zero? sign, length in bits, leading bits)
is a binary one with an adaptive probability, and goes to a range coder.

What a decoder has to repeat is arithmetic of integers, and one product and quotient of IEEE
numbers, so that every machine reads what another one wrote.

Symbols: q entry, v = |q|, p probability of a 1 [2^-16], m mean magnitude of a column, a magnitude
seen in this row and e magnitude expected there, both with a weight that fades from column to
column [2^-12].
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

P_BITS = 16
P_ONE = 1 << P_BITS
P_LEAST = 24  # no decision is ever surer than this [2^-16]
MEMORY = 120  # decisions over which a probability is taken
PRIOR = 4  # decisions for which the first guess of a probability counts
RATES = 2 * P_ONE // (2 * np.arange(MEMORY + 1) + 3)  # weights of the next decision [2^-16]
LONGER = 0.25  # the least first guess that a magnitude has one bit more
TOP = 1 << 48  # the coder's interval is at most so wide, and at least TOP >> 8
BYTE = 40  # bits below the coder's next byte

UNIT = 1 << 12  # magnitude 1, in fixed point
FADE = 2  # a and e forget 2^-FADE of themselves a column
START = UNIT // 4  # the mean magnitude of columns of which nothing is known
WINDOW = 6  # 2^WINDOW rows make the mean of a column
CLIP = 1 << 16  # magnitudes count for no more than this in the contexts

LEVELS = 48  # half octaves of the expected magnitude, from 2^-8 on
LENGTHS = 48  # bits of the largest magnitude
NEAR = 3  # contexts by the two entries before
LEADS = 4  # nodes of the tree of the two bits below the leading one

# Where each kind of decision begins in the one array of probabilities.
LENGTH = LEVELS * NEAR
LEAD = LENGTH + LEVELS * LENGTHS
SIGN = LEAD + LENGTHS * LEADS


@jit
def contexts(columns):
    """Probabilities and counts of decisions before any: (count,) int64 each."""
    p = np.full(SIGN + columns, P_ONE // 2, np.int64)
    seen = np.zeros(SIGN + columns, np.int64)
    magnitude = 1.0 / 256.0
    for c in range(LEVELS):
        # Of a geometric distribution of this mean.
        ratio = magnitude / (1.0 + magnitude)
        for near in range(NEAR):
            p[c * NEAR + near] = _within(ratio)
            seen[c * NEAR + near] = PRIOR
        for j in range(LENGTHS):
            # Tails are heavier than that.
            p[LENGTH + c * LENGTHS + j] = _within(max(ratio, LONGER))
            seen[LENGTH + c * LENGTHS + j] = PRIOR
            ratio *= ratio
        magnitude *= 1.4142135623730951
    return p, seen


@jit
def _within(ratio):
    """A probability in fixed point, never too sure."""
    return min(max(int(ratio * P_ONE), P_LEAST), P_ONE - P_LEAST)


@jit
def _level(m, a, e):
    """Half octaves of the magnitude to expect, from 0 to LEVELS - 1."""
    x = int(float(m) * float(a + START) / float(16 * (e + START)))
    if x < 2:
        return 0
    level = 1
    while x >= 4:
        x >>= 1
        level += 2
    return min(level + x - 2, LEVELS - 1)


@jit
def _adapt(p, seen, context, bit):
    """Let a probability follow a decision, the first few quickly."""
    count = seen[context]
    value = p[context] + (((bit << P_BITS) - p[context]) * RATES[count] >> P_BITS)
    p[context] = min(max(value, P_LEAST), P_ONE - P_LEAST)
    if count < MEMORY:
        seen[context] = count + 1


@jit
def _put(state, out, share, bit):
    """Code one decision whose 1 has this share of P_ONE. state = (low, width, bytes in out)."""
    low, width, length = state
    split = (width >> P_BITS) * share
    if bit:
        width = split
    else:
        low += split
        width -= split
        if low >= TOP:
            low -= TOP
            at = length - 1
            while out[at] == 255:
                out[at] = 0
                at -= 1
            out[at] += 1
    while width < TOP >> 8:
        out[length] = low >> BYTE
        length += 1
        low = (low & ((1 << BYTE) - 1)) << 8
        width <<= 8
    return low, width, length


@jit
def _get(state, data, share):
    """Decode one decision. state = (code less low, width, bytes read); beyond the end are zeros."""
    code, width, at = state
    split = (width >> P_BITS) * share
    bit = 1 if code < split else 0
    if bit:
        width = split
    else:
        code -= split
        width -= split
    while width < TOP >> 8:
        code = (code << 8) + (data[at] if at < data.size else 0)
        at += 1
        width <<= 8
    return bit, (code, width, at)


@jit
def _length(v):
    """The number of bits of v >= 1, less one."""
    length = 0
    while v >> (length + 1):
        length += 1
    return length


@jit
def _bits(p, costs, zero, length, v):
    """Bits that v takes in these contexts."""
    if v == 0:
        return costs[P_ONE - p[zero] >> 4]
    last = _length(v)
    bits = costs[p[zero] >> 4] + 1.0 + last
    for j in range(last):
        bits += costs[p[length + j] >> 4]
    return bits + costs[P_ONE - p[length + last] >> 4]


@jit
def _choose(size, price, p, costs, zero, length):
    """The magnitude for |x| = size, or the one below it: least (size - v)^2 + price * bits."""
    v = int(size + 0.5)
    # Beyond these no saving of bits makes up for the error.
    if price == 0.0 or v == 0 or v > 8 or size - v > (0.4 if v == 1 else -0.2):
        return v
    saved = _bits(p, costs, zero, length, v) - _bits(p, costs, zero, length, v - 1)
    return v - 1 if (size - v + 1.0) ** 2 < (size - v) ** 2 + price * saved else v


@jit
def encode_matrix(x, price, costs, out):
    """Round a matrix to integers, with regard to the bits they take, and code them.

    x : (n, r) float64, |x| < 2^47
    price : squared error that a bit may cost (0: round to the nearest)
    costs : (4097,) bits of a decision of probability i / 4096
    out : uint8, to be filled

    Returns q (n, r) int64, the number of bytes (-1 if they are more than `out` takes), and of the
    differences d = |x| - |q| their number, sum and sum of squares where |q| is 0, 1, more: (3, 3).
    """
    n, r = x.shape
    q = np.zeros((n, r), np.int64)
    moments = np.zeros((3, 3))
    p, seen = contexts(r)
    mean = np.full(r, START, np.int64)
    state = (0, TOP, 0)
    for i in range(n):
        if out.size < state[2] + 16 * r + 16:
            return q, -1, moments
        a, e = 0, 0
        one, two = 0, 0
        for k in range(r):
            m = mean[k]
            level = _level(m, a, e)
            zero = level * NEAR + min(2 * one + two, NEAR - 1)
            length = LENGTH + level * LENGTHS
            v = _choose(abs(x[i, k]), price, p, costs, zero, length)
            d = abs(x[i, k]) - v
            kind = moments[min(v, 2)]
            kind[0] += 1.0
            kind[1] += d
            kind[2] += d * d
            bit = 1 if v else 0
            state = _put(state, out, p[zero], bit)
            _adapt(p, seen, zero, bit)
            if v:
                negative = 1 if x[i, k] < 0.0 else 0
                q[i, k] = -v if negative else v
                state = _put(state, out, p[SIGN + k], negative)
                _adapt(p, seen, SIGN + k, negative)
                last = _length(v)
                for j in range(last + 1):
                    bit = 1 if j < last else 0
                    state = _put(state, out, p[length + j], bit)
                    _adapt(p, seen, length + j, bit)
                lead, node = LEAD + last * LEADS, 1
                for j in range(last - 1, -1, -1):
                    bit = (v >> j) & 1
                    if node < LEADS:
                        state = _put(state, out, p[lead + node], bit)
                        _adapt(p, seen, lead + node, bit)
                        node = 2 * node + bit
                    else:
                        state = _put(state, out, P_ONE // 2, bit)
            v = min(v, CLIP)
            a += v * UNIT - (a >> FADE)
            e += m - (e >> FADE)
            mean[k] = m + ((v * UNIT - m) >> WINDOW)
            two, one = one, 1 if v else 0
    return q, _finish(state, out), moments


@jit
def _finish(state, out):
    """Write the shortest end that lies within the interval; the number of bytes, zeros left off."""
    low, width, length = state
    for bits in range(BYTE + 8, -1, -1):
        value = ((low + (1 << bits) - 1) >> bits) << bits
        if value < low + width:
            break
    if value >= TOP:
        value -= TOP
        at = length - 1
        while out[at] == 255:
            out[at] = 0
            at -= 1
        out[at] += 1
    for shift in range(BYTE, -1, -8):
        out[length] = (value >> shift) & 255
        length += 1
    while length > 0 and out[length - 1] == 0:
        length -= 1
    return length


@jit
def decode_matrix(data, n, r):
    """The first n rows (n, r) int64 of a matrix coded by `encode_matrix`; 0 rows if damaged."""
    q = np.zeros((n, r), np.int64)
    p, seen = contexts(r)
    mean = np.full(r, START, np.int64)
    code = 0
    for i in range(6):
        code = (code << 8) + (data[i] if i < data.size else 0)
    state = (code, TOP, 6)
    for i in range(n):
        a, e = 0, 0
        one, two = 0, 0
        for k in range(r):
            m = mean[k]
            level = _level(m, a, e)
            zero = level * NEAR + min(2 * one + two, NEAR - 1)
            length = LENGTH + level * LENGTHS
            v, state = _get(state, data, p[zero])
            _adapt(p, seen, zero, v)
            if v:
                negative, state = _get(state, data, p[SIGN + k])
                _adapt(p, seen, SIGN + k, negative)
                last, bit = -1, 1
                while bit:
                    last += 1
                    if last == LENGTHS:
                        return q[:0]
                    bit, state = _get(state, data, p[length + last])
                    _adapt(p, seen, length + last, bit)
                lead, node = LEAD + last * LEADS, 1
                for _ in range(last):
                    if node < LEADS:
                        bit, state = _get(state, data, p[lead + node])
                        _adapt(p, seen, lead + node, bit)
                        node = 2 * node + bit
                    else:
                        bit, state = _get(state, data, P_ONE // 2)
                    v = 2 * v + bit
                q[i, k] = -v if negative else v
            v = min(v, CLIP)
            a += v * UNIT - (a >> FADE)
            e += m - (e >> FADE)
            mean[k] = m + ((v * UNIT - m) >> WINDOW)
            two, one = one, 1 if v else 0
    return q


@jit
def combine(q, shifts, core, offset):
    """Y[i, j] = offset[j] + sum over k of (q[i, k] +- shift) core[k, j], summed in the order of k.

    q : (n, r) int64; shifts : (2,) taken off magnitudes 1 and above 1; core : (r, c); offset : (c,)
    Every entry is summed by itself, so that any choice of rows and columns gives the same bits.
    """
    n, r = q.shape
    columns = offset.size
    y = np.empty((n, columns))
    for i in range(n):
        row = y[i]
        for j in range(columns):
            row[j] = offset[j]
        for k in range(r):
            if q[i, k] != 0:
                value = float(q[i, k])
                shift = shifts[0] if abs(q[i, k]) == 1 else shifts[1]
                value = value - shift if q[i, k] > 0 else value + shift
                for j in range(columns):
                    row[j] += value * core[k, j]
    return y
