"""Kernels of the predictive coder: choice of integer paths, contexts, symbols.

Symbols: x value, y = (x - prediction) / step, q integer level, r = q_t - q_{t-1} residual,
E activity (what the residuals coded so far let expect of |r|, in quarters), J cost.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from compress.entropy import DIRECT, PARTS
from dem_mpi._jit import jit

LEVELS = 31  # contexts: activities grow by 1.5 from one to the next
CAP = 1 << 20  # larger residuals count as this in activities
SPAN = 15  # residuals up to this have a price of their own; beyond, logarithmic
LARGE = 1e300


def _level_of_small(size: int = 4096) -> NDArray:
    """Contexts (size,) uint8 of the activities below `size`: 0, then 1 + floor(log_1.5 E)."""
    levels = np.zeros(size, np.uint8)
    edge, level = 1, 1
    while edge < size:
        levels[edge:] = level
        # Integers only, so that every machine has the same edges.
        edge, level = max(edge + 1, (3 * edge + 1) // 2), level + 1
    return levels


LEVEL_OF_SMALL = _level_of_small()


@jit
def level_of(activity):
    """The context of an activity (int64), 0 .. LEVELS - 1."""
    level = 0
    while activity >= 4096:
        # 1.5^12 = 129.7: seven binary digits are twelve contexts, near enough.
        activity >>= 7
        level += 12
    return min(level + LEVEL_OF_SMALL[activity], LEVELS - 1)


@jit
def _price(prices, level, r, last):
    """Bits of the residual r after `last`; prices : (LEVELS + 1, 2 SPAN + 1) of one component."""
    folded = -r if last < 0 else r
    if folded > SPAN:
        return prices[level, 2 * SPAN] + 2.0 * np.log2(folded / SPAN)
    if folded < -SPAN:
        return prices[level, 0] + 2.0 * np.log2(-folded / SPAN)
    return prices[level, folded + SPAN]


@jit
def _path(x, offset, step, weight, prices, others, maximum, r, back, base):
    """The integer path of one component of one body with the least cost, by Viterbi's algorithm.

    J = sum_t y_t^2-error + weight * bits. Each step keeps the two levels next to the value.
    x : (T,); offset : (T,) prediction with all residuals 0; others : (T,) int64 activity from
    other components; prices : (LEVELS + 1, 2 SPAN + 1) [bits], the last row for the first step;
    maximum [unit of x]. r : (T,) int64 out. back : (T, 2), base : (T,) int64 scratch.
    Returns J.
    """
    steps = len(x)
    inverse = 1.0 / step
    j0 = j1 = 0.0
    m0 = m1 = l0 = l1 = 0
    for t in range(steps):
        y = (x[t] - offset[t]) * inverse
        b = int(np.floor(y))
        base[t] = b
        e0 = y - b
        e1 = 1.0 - e0
        d0 = e0 * e0
        d1 = e1 * e1
        if e0 * step > maximum and e1 * step <= maximum:
            d0 = LARGE
        elif e1 * step > maximum and e0 * step <= maximum:
            d1 = LARGE
        if t == 0:
            j0 = d0 + weight * _price(prices, LEVELS, b, 0)
            j1 = d1 + weight * _price(prices, LEVELS, b + 1, 0)
            m0, m1 = min(abs(b), CAP), min(abs(b + 1), CAP)
            continue
        up = b - base[t - 1]
        v0 = level_of(8 * min(abs(l0), CAP) + m0 + others[t])
        v1 = level_of(8 * min(abs(l1), CAP) + m1 + others[t])
        a00 = j0 + weight * _price(prices, v0, up, l0)
        a10 = j1 + weight * _price(prices, v1, up - 1, l1)
        a01 = j0 + weight * _price(prices, v0, up + 1, l0)
        a11 = j1 + weight * _price(prices, v1, up, l1)
        if a00 <= a10:
            j, k0, r0 = a00, 0, up
        else:
            j, k0, r0 = a10, 1, up - 1
        if a11 <= a01:
            i, k1, r1 = a11, 1, up
        else:
            i, k1, r1 = a01, 0, up + 1
        back[t, 0] = k0
        back[t, 1] = k1
        before0, before1 = m0, m1
        m0 = (before1 if k0 else before0) // 2 + 4 * min(abs(r0), CAP)
        m1 = (before1 if k1 else before0) // 2 + 4 * min(abs(r1), CAP)
        l0, l1 = r0, r1
        j0 = j + d0
        j1 = i + d1
    k = 1 if j1 < j0 else 0
    for t in range(steps - 1, 0, -1):
        previous = back[t, k]
        r[t] = base[t] + k - base[t - 1] - previous
        k = previous
    r[0] = base[0] + k
    return min(j0, j1)


@jit
def flight_ends(x, drift, ends, share):
    """How many steps from the first on follow the drift, and what share of all steps does.

    x : (n, w, T); drift : (w,) a step; ends : (n,) int64 out, T where all do; share : (n,) out
    """
    bodies, width, steps = x.shape
    largest = 0.0
    for c in range(width):
        largest = max(largest, abs(drift[c]))
    for i in range(bodies):
        ends[i] = steps
        follow = 0
        for t in range(1, steps):
            far = False
            for c in range(width):
                far = far or abs(x[i, c, t] - x[i, c, t - 1] - drift[c]) > 0.5 * largest
            if far:
                ends[i] = min(ends[i], t)
            else:
                follow += 1
        share[i] = follow / max(steps - 1, 1)


@jit
def choose_paths(x, guide, start, drift, step, weight, prices, flags, maximum, ends, share, r):
    """Integer paths of all bodies, and how far each one follows the drift.

    x : (n, w, T); guide : (n, w, T) predictions on top of start, or (0, w, T) for none;
    start, drift : (w,); step, maximum [unit of x]; weight : cost [step^2] of a bit;
    prices : (w, LEVELS + 1, 2 SPAN + 1) bits; flags : (3,) bits for ends = 0, between, T;
    ends, share : (n,) of `flight_ends`; ends out: what is chosen of 0, this and T;
    r : (n, w, T) int64 out
    """
    bodies, width, steps = x.shape
    back = np.empty((steps, 2), np.int64)
    base = np.empty(steps, np.int64)
    offset = np.zeros(steps)
    others = np.zeros(steps, np.int64)
    trial = np.empty((width, steps), np.int64)
    # Components before the first one with a drift have the same path in every attempt.
    drifting = 0
    while drifting < width and drift[drifting] == 0.0:
        drifting += 1
    for i in range(bodies):
        best = np.inf
        found = 0
        common = 0.0
        begun = False
        for attempt in range(3):
            end = 0 if attempt == 0 else (steps if attempt == 1 else ends[i])
            if drifting == width:
                if attempt > 0:
                    continue
            elif (
                (attempt == 0 and ends[i] == steps)
                or (attempt == 1 and share[i] < 0.5)
                or (attempt == 2 and (end < 3 or end == steps))
            ):
                continue
            cost = weight * flags[0 if attempt == 0 else (2 if attempt == 1 else 1)]
            if begun:
                cost += common
            for c in range(drifting if begun else 0, width):
                for t in range(steps):
                    offset[t] = start[c] + drift[c] * min(t, max(end - 1, 0))
                    others[t] = 0
                if len(guide):
                    for t in range(steps):
                        offset[t] += guide[i, c, t]
                for d in range(c):
                    before = 0
                    for t in range(steps):
                        size = min(abs(trial[d, t]), CAP)
                        others[t] += 8 * size + before
                        before = 4 * size if t > 0 else 0
                price = _path(
                    x[i, c], offset, step, weight, prices[c], others, maximum, trial[c], back, base
                )
                cost += price
                if c < drifting:
                    common += price
            begun = True
            if cost < best:
                best = cost
                found = end
                r[i] = trial
        ends[i] = found


@jit
def count_residuals(r, counts):
    """Count residuals by context, for prices: counts (w, LEVELS + 1, 2 SPAN + 1) += 1."""
    bodies, width, steps = r.shape
    for i in range(bodies):
        for c in range(width):
            memory = 0
            for t in range(steps):
                level = LEVELS
                value = r[i, c, t]
                if t > 0:
                    last = r[i, c, t - 1] if t > 1 else 0
                    activity = memory + 8 * min(abs(last), CAP)
                    for d in range(width):
                        if d != c and t > 1:
                            activity += 4 * min(abs(r[i, d, t - 1]), CAP)
                        if d < c:
                            activity += 8 * min(abs(r[i, d, t]), CAP)
                    level = level_of(activity)
                    if last < 0:
                        value = -value
                    memory = memory // 2 + 4 * min(abs(value), CAP)
                else:
                    memory = min(abs(value), CAP)
                counts[c, level, min(max(value, -SPAN), SPAN) + SPAN] += 1.0


@jit
def levels_now(now, last, memory, component, first, out):
    """Contexts of one component at one step, for all bodies.

    now : (w, n) residuals of this step, known below `component`; last : (w, n) of the step
    before; memory : (w, n) fading sum of earlier ones; first : whether this is the first step;
    out : (n,) uint8
    """
    width, bodies = now.shape
    for i in range(bodies):
        activity = 0
        for d in range(component):
            activity += 8 * min(abs(now[d, i]), CAP)
        if first:
            # Contexts of their own, half as many.
            out[i] = LEVELS + level_of(activity) // 2
            continue
        activity += memory[component, i] + 8 * min(abs(last[component, i]), CAP)
        for d in range(width):
            if d != component:
                activity += 4 * min(abs(last[d, i]), CAP)
        out[i] = level_of(activity)


@jit
def remember(now, first, last, memory):
    """Pass on to the next step: memory fades by half, `last` becomes `now`; all (w, n) int64.

    What the first step adds to its prediction is no residual in time: a weak hint only.
    """
    width, bodies = now.shape
    for c in range(width):
        for i in range(bodies):
            size = min(abs(now[c, i]), CAP)
            memory[c, i] = size if first else memory[c, i] // 2 + 4 * size
            last[c, i] = 0 if first else now[c, i]


@jit
def fold(residual, last, symbols, widths):
    """Symbols of residuals, and how many low bits each leaves open.

    residual, last : (n,) int64; symbols : (n,) int32 out, 0, or 2 b - 1 and 2 b for bucket b with
    the sign of `last` and against it; widths : (n,) int64 out
    """
    for i in range(len(residual)):
        r = -residual[i] if last[i] < 0 else residual[i]
        u = abs(r)
        width = 0
        while (u >> width) >= DIRECT:
            width += 1
        b = u
        if width > 0:
            # 16 buckets a power of two: the five leading digits.
            b = DIRECT + (width - 1) * PARTS + ((u >> width) - PARTS)
        symbols[i] = 2 * b - (1 if r > 0 else 0)
        widths[i] = width


@jit
def unfold(symbols, low, last, residual):
    """The inverse of `fold`; low : (n,) int64 the bits left open, residual : (n,) int64 out."""
    for i in range(len(symbols)):
        b = (symbols[i] + 1) // 2
        u = b
        if b >= DIRECT:
            width = (b - DIRECT) // PARTS + 1
            u = ((PARTS + (b - DIRECT) % PARTS) << width) + low[i]
        r = u if symbols[i] % 2 == 1 else -u
        residual[i] = -r if last[i] < 0 else r


@jit
def centroid_sums(x, guide, start, drift, step, ends, r, sums):
    """Sums over all entries by class of residual and next residual: count, error, error^2.

    The class is that of `classes_of`; error = y - q, with the sign of the class [step].
    sums : (5, 3) out
    """
    bodies, width, steps = x.shape
    for i in range(bodies):
        for c in range(width):
            q = 0
            for t in range(steps):
                q += r[i, c, t]
                offset = start[c] + drift[c] * min(t, max(ends[i] - 1, 0))
                if len(guide):
                    offset += guide[i, c, t]
                error = (x[i, c, t] - offset) / step - q
                before = r[i, c, t] if t > 0 else 0
                after = r[i, c, t + 1] if t + 1 < steps else 0
                kind = class_of(before, after)
                k = abs(kind)
                if kind < 0:
                    error = -error
                sums[k, 0] += 1.0
                sums[k, 1] += error
                sums[k, 2] += error * error


@jit
def class_of(before, after):
    """Class of an entry by the signs of its residual and the next, negative where mirrored.

    0 : neither; 1 : none, then up; 2 : up, then none; 3 : up, then up; 4 : up, then down
    """
    if before == 0:
        return 0 if after == 0 else (1 if after > 0 else -1)
    sign = 1 if before > 0 else -1
    if after == 0:
        return 2 * sign
    return (3 if (after > 0) == (before > 0) else 4) * sign


@jit
def reconstruct(guide, start, drift, step, table, ends, r, steps, out):
    """Values from residuals: start + drift min(t, end - 1) + guide + step (q + shift).

    guide : (n, w, T) or (0, w, T); start, drift : (w,); table : (5,) shifts by class;
    ends : (n,); r : (T', w, n) int64, of one step more than asked for unless that is the last;
    out : (steps, n, w). Single operations in this order: the bits are part of the format.
    """
    known, width, bodies = r.shape
    q = np.zeros((width, bodies), np.int64)
    for t in range(steps):
        for i in range(bodies):
            flown = min(t, max(ends[i] - 1, 0))
            for c in range(width):
                q[c, i] += r[t, c, i]
                after = r[t + 1, c, i] if t + 1 < known else 0
                kind = class_of(r[t, c, i] if t > 0 else 0, after)
                level = q[c, i] + (table[kind] if kind >= 0 else -table[-kind])
                offset = start[c] + drift[c] * flown
                if len(guide):
                    offset += guide[i, c, t]
                out[t, i, c] = offset + step * level


@jit
def deviation(values, decoded, unit):
    """Sum of squares [unit^2], and largest, of the differences of two (T, n, w) arrays."""
    largest = 0.0
    squares = 0.0
    for t in range(values.shape[0]):
        # Sums by step stay short, which keeps rounding errors far below a bound.
        part = 0.0
        for i in range(values.shape[1]):
            for c in range(values.shape[2]):
                e = abs(np.float64(values[t, i, c]) - np.float64(decoded[t, i, c]))
                largest = max(largest, e)
                part += (e / unit) * (e / unit)
        squares += part
    return squares, largest
