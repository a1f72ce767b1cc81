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
GLANCE = 6  # steps that a greedy path looks at, this one included


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
def flights(x, drift, ends):
    """How many steps of each body follow the drift, by what most of its steps do.

    All where most steps behind the first departure follow it again, none where departure is soon.
    x : (T, n, w); ends : (n,) int64 out
    """
    steps, bodies, width = x.shape
    largest = 0.0
    for c in range(width):
        largest = max(largest, abs(drift[c]))
    again = np.zeros(bodies, np.int64)
    ends[:] = steps
    for t in range(1, steps):
        for i in range(bodies):
            far = False
            for c in range(width):
                far = far or abs(x[t, i, c] - x[t - 1, i, c] - drift[c]) > 0.5 * largest
            if far:
                ends[i] = min(ends[i], t)
            elif ends[i] < steps:
                again[i] += 1
    for i in range(bodies):
        if 2 * again[i] > steps - ends[i]:
            ends[i] = steps
        elif ends[i] < 3:
            ends[i] = 0


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
def greedy_paths(x, guide, start, drift, step, weight, prices, maximum, ends, r, sums, counts):
    """Integer paths of all bodies, each level chosen with a glance at the next few steps alone.

    A path holds its level within half a step of the value, and goes to the nearest one from a
    whole step on. In between it moves where the squared error that this saves, until the value
    comes back, is worth the price of moving. As good as `choose_paths` to some per cent of the
    bits, in one pass along time, in which go the sums of `centroid_sums` and the counts of
    `count_residuals` too.

    x, guide : (T, n, w), guide (T, 0, w) for none; ends : (n,) steps that follow the drift;
    r : (T, w, n) int64 out; sums : (5, 3) out; counts : (w, LEVELS + 1, 2 SPAN + 1) out,
    (0, ...) for none
    """
    steps, bodies, width = x.shape
    inverse = 1.0 / step
    q = np.zeros((bodies, width), np.int64)
    memory = np.zeros((bodies, width), np.int64)
    error = np.zeros((bodies, width))
    by_signs = np.zeros((9, 3))
    for t in range(steps):
        for i in range(bodies):
            activity = 0
            if t > 1:
                for c in range(width):
                    activity += 4 * min(abs(r[t - 1, c, i]), CAP)
            for c in range(width):
                last = r[t - 1, c, i] if t > 1 else 0
                expected = activity + memory[i, c] + 4 * min(abs(last), CAP)
                off = (x[t, i, c] - _offset(guide, start, drift, ends, t, i, c)) * inverse - q[i, c]
                value = 0
                if t == 0 or abs(off) >= 1.0:
                    value = int(np.floor(off + 0.5))
                elif abs(off) > 0.5:
                    move = 1 if off > 0.0 else -1
                    level = level_of(expected)
                    gain = 2.0 * abs(off) - 1.0
                    price = _price(prices[c], level, move, last) - prices[c, level, SPAN]
                    if abs(off) * step > maximum:
                        price = 0.0
                    ahead = t + 1
                    while gain < weight * price and ahead < min(t + GLANCE, steps):
                        then = (
                            x[ahead, i, c] - _offset(guide, start, drift, ends, ahead, i, c)
                        ) * inverse - q[i, c]
                        if then * move <= 0.5:
                            break
                        gain += 2.0 * then * move - 1.0
                        ahead += 1
                    if gain >= weight * price:
                        value = move
                r[t, c, i] = value
                q[i, c] += value
                if t > 0:
                    # Signs of the residuals before and behind the entry whose error is known.
                    signs = 3 * ((last > 0) - (last < 0)) + (value > 0) - (value < 0) + 4
                    e = error[i, c]
                    by_signs[signs, 0] += 1.0
                    by_signs[signs, 1] += e
                    by_signs[signs, 2] += e * e
                error[i, c] = off - value
                size = min(abs(value), CAP)
                activity += 8 * size
                memory[i, c] = (memory[i, c] >> 1) + 4 * size if t > 0 else size
                if len(counts):
                    level = level_of(expected) if t > 0 else LEVELS
                    folded = -value if last < 0 else value
                    counts[c, level, min(max(folded, -SPAN), SPAN) + SPAN] += 1.0
    for i in range(bodies):
        for c in range(width):
            last = r[steps - 1, c, i] if steps > 1 else 0
            _add_share(sums, class_of(last, 0), error[i, c])
    for before in range(-1, 2):
        for after in range(-1, 2):
            kind = class_of(before, after)
            part = by_signs[3 * before + after + 4]
            sums[abs(kind), 0] += part[0]
            sums[abs(kind), 1] += part[1] if kind >= 0 else -part[1]
            sums[abs(kind), 2] += part[2]


@jit
def _offset(guide, start, drift, ends, t, i, c):
    """The value of an entry at level 0; guide : (T, n, w), or (T, 0, w) for none."""
    offset = start[c] + drift[c] * min(t, max(ends[i] - 1, 0))
    return offset + guide[t, i, c] if guide.shape[1] > 0 else offset


@jit
def _add_share(sums, kind, error):
    """Add an error of a class to the sums of `centroid_sums`."""
    k = abs(kind)
    if kind < 0:
        error = -error
    sums[k, 0] += 1.0
    sums[k, 1] += error
    sums[k, 2] += error * error


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
    activity = np.zeros(bodies, np.int64)
    # One row after the other: loops of this kind take several bodies at once.
    for d in range(component):
        row = now[d]
        for i in range(bodies):
            activity[i] += 8 * min(abs(row[i]), CAP)
    if first:
        for i in range(bodies):
            # Contexts of their own, half as many.
            out[i] = LEVELS + level_of(activity[i]) // 2
        return
    for d in range(width):
        row = last[d]
        weight = 8 if d == component else 4
        for i in range(bodies):
            activity[i] += weight * min(abs(row[i]), CAP)
    for i in range(bodies):
        out[i] = level_of(activity[i] + memory[component, i])


@jit
def arrange(now, last, levels, component, symbols, widths, counts):
    """Symbols and open bits as of `fold`, those of one context side by side, in order of bodies.

    now, last : (w, n) residuals; levels : (n,) uint8; symbols : (n,) int32 out;
    widths : (n,) int64 out, in the order of bodies; counts : (contexts,) int64 out
    Returns the largest width.
    """
    widest = 0
    counts[:] = 0
    for i in range(len(levels)):
        counts[levels[i]] += 1
    place = np.zeros(len(counts), np.int64)
    for k in range(1, len(counts)):
        place[k] = place[k - 1] + counts[k - 1]
    for i in range(len(levels)):
        symbol, widths[i] = _symbol(now[component, i], last[component, i])
        symbols[place[levels[i]]] = symbol
        place[levels[i]] += 1
        widest = max(widest, widths[i])
    return widest


@jit
def low_bits(residual, widths, width):
    """What residuals (n,) leave open, (m,) uint64, of those that leave `width` bits open."""
    found = np.empty(len(residual), np.uint64)
    count = 0
    for i in range(len(residual)):
        if widths[i] == width:
            found[count] = abs(residual[i]) & ((1 << width) - 1)
            count += 1
    return found[:count]


@jit
def count_symbols(symbols, prior, counts, weights):
    """Add symbols (m,) int32 to the counts of a table; weights = prior + counts, all (size,)."""
    for symbol in symbols:
        counts[symbol] += 1.0
    for k in range(len(counts)):
        weights[k] = prior[k] + counts[k]


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
        symbols[i], widths[i] = _symbol(residual[i], last[i])


@jit
def _symbol(residual, last):
    """The symbol of a residual, and how many low bits it leaves open."""
    r = -residual if last < 0 else residual
    u = abs(r)
    width = 0
    while (u >> width) >= DIRECT:
        width += 1
    b = u
    if width > 0:
        # 16 buckets a power of two: the five leading digits.
        b = DIRECT + (width - 1) * PARTS + ((u >> width) - PARTS)
    return 2 * b - (1 if r > 0 else 0), width


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
                _add_share(sums, class_of(before, after), error)


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

    guide : (T, n, w) or (T, 0, w); start, drift : (w,); table : (5,) shifts by class;
    ends : (n,); r : (T', w, n) int64, of one step more than asked for unless that is the last;
    out : (steps, n, w). Single operations in this order: the bits are part of the format.
    """
    known, width, bodies = r.shape
    q = np.zeros((width, bodies), np.int64)
    shift = np.empty(9)
    for before in range(-1, 2):
        for after in range(-1, 2):
            kind = class_of(before, after)
            shift[3 * before + after + 4] = table[kind] if kind >= 0 else -table[-kind]
    for t in range(steps):
        for i in range(bodies):
            for c in range(width):
                q[c, i] += r[t, c, i]
                before = r[t, c, i] if t > 0 else 0
                after = r[t + 1, c, i] if t + 1 < known else 0
                signs = 3 * ((before > 0) - (before < 0)) + (after > 0) - (after < 0) + 4
                offset = _offset(guide, start, drift, ends, t, i, c)
                out[t, i, c] = offset + step * (q[c, i] + shift[signs])


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
