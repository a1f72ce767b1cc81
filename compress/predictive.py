"""Predictive coding: each body's values as a path of integers, most steps of which do not move.

With a step width D, the decoded value of body i, component c at step t is

    start_c + drift_c min(t, f_i - 1) + guide_itc + D (q_itc + shift)

q is an integer path, of which the residuals r_t = q_t - q_{t-1} are range coded. A body at rest or
in steady motion holds q; one in free flight holds it relative to the drift, the velocity that
gravity adds in a step, for its first f_i steps. A guide predicts from another field, as positions
from decoded velocities. The encoder chooses the path by least squared error plus price of the bits
(Viterbi's algorithm), and D such that the measured error is the one allowed.

The probability of a residual depends on the residuals coded before it: those of the body's last
steps and of its other components, summed with fading weights to an activity E. Each level of E has
a table of its own, which starts as a Laplace distribution and follows what is coded. `shift` is
the mean of what the integers miss before and after a path moves, four numbers a block.

Integers, and floating-point operations in a fixed order: all machines decode the same bits.

Symbols: T steps, n bodies, w components, D step width, r residual, E activity.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compress import _kernels_predictive as kernels
from compress.bounds import Target, largest
from compress.effort import BEST, Effort
from compress.entropy import (
    LAST_BUCKET,
    LIMIT,
    SCALES,
    Reader,
    Writer,
    bucket_edges,
    decode_integers,
    encode_integers,
    half_power,
    nearest_scale,
    scale_value,
)

RAW, DEFLATED, PATHS = range(3)
SINGLE = 4  # added to the first byte for float32
CONTEXTS = kernels.LEVELS + (kernels.LEVELS + 1) // 2
COMPONENTS = 6  # from this one on, components share their tables
PRIOR_WEIGHT = 12.0
SHIFT_UNIT = 1.0 / 128.0
TRIALS = 10
SETTLED = 4  # trials after which the error goes up and down with where levels lie, not with D
LARGEST_PATH = 2.0**45  # levels: their exact float64, with shifts, ends here


@dataclass(frozen=True)
class Layout:
    """What the decoder has to know besides the residuals.

    step : D [unit of the values]; start, drift : (w,) [the same]; shifts : (5,) [D] by class of
    residuals; ends : (n,) f_i, how many steps of each body follow the drift
    """

    shape: tuple[int, int, int]
    step: float
    start: NDArray
    drift: NDArray
    shifts: NDArray
    ends: NDArray


@dataclass(frozen=True)
class _Search:
    """How paths are chosen. price : (w, levels + 1, residuals) bits, flags : (3,) bits,
    weight : cost of a bit [D^2]; maximum : largest error of an entry.
    """

    prices: NDArray
    flags: NDArray
    weight: float
    maximum: float


def encode(
    values: NDArray,
    target: Target,
    *,
    guide: NDArray | None = None,
    start: NDArray | None = None,
    effort: Effort = BEST,
) -> bytes:
    """Code a block within the target.

    values : (T, n, w) float; guide : (T, n, w) predicted increments, that of step t leading to
    values[t] (the first has no use); start : (n, w) predicted values[0], as of the last step of
    the block before. The decoder needs the same bits of both.
    Raises ValueError for a target of zero and for values that are not finite.
    """
    return encode_and_decode(values, target, guide=guide, start=start, effort=effort)[0]


def encode_and_decode(
    values: NDArray,
    target: Target,
    *,
    guide: NDArray | None = None,
    start: NDArray | None = None,
    effort: Effort = BEST,
) -> tuple[bytes, NDArray]:
    """As `encode`, and what `decode` makes of the bytes, to the last bit, without decoding them."""
    values = np.asarray(values)
    if values.ndim != 3:
        raise ValueError(f"block of shape {values.shape}: must be (steps, bodies, components)")
    if values.dtype != np.float32:
        values = values.astype(np.float64, copy=False)
    if target.exact:
        raise ValueError("predictive coding loses digits: the target must allow an error")
    size = largest(values)
    if not math.isfinite(size):
        where = tuple(np.argwhere(~np.isfinite(values))[0].tolist())
        raise ValueError(f"value at (step, body, component) = {where} is not finite")
    if not values.size:
        return _encode_raw(values), values
    ahead = _predictions(values.shape, guide, start)
    coded = _encode_paths(values, size, ahead, target, effort)
    if coded is None or len(coded[0]) > 0.8 * values.nbytes:
        raw = _encode_raw(values)
        return (raw, values) if coded is None or len(raw) < len(coded[0]) else coded
    return coded


def decode(
    data: bytes,
    guide: NDArray | None = None,
    start: NDArray | None = None,
    steps: slice | None = None,
    limit: int = LIMIT,
) -> NDArray:
    """The values (T', n, w) of the steps asked for (all), float32 if those were coded.

    guide, start : as given to `encode`, the guide at least up to the last step asked for.
    Raises ValueError for damaged bytes, and for blocks of more than `limit` entries.
    """
    if not data:
        raise ValueError("predictive block: no bytes")
    kind, dtype = data[0] % SINGLE, np.float32 if data[0] & SINGLE else np.float64
    if data[0] >= 2 * SINGLE or kind > PATHS:
        raise ValueError(f"predictive block: no such kind: {data[0]}")
    if kind != PATHS:
        return _decode_raw(data, kind, dtype, limit)[steps or slice(None)]
    reader = Reader(data[1:])
    layout, top, scales = _read_layout(reader, limit)
    wanted = range(*(steps or slice(None)).indices(layout.shape[0]))
    if not wanted:
        return np.empty((0, *layout.shape[1:]), dtype)
    last = max(wanted[0], wanted[-1])
    residuals = _decode_residuals(reader, layout.shape, min(last + 2, layout.shape[0]), top, scales)
    ahead = _predictions((last + 1, *layout.shape[1:]), guide, start)
    decoded = _reconstruct(layout, residuals, ahead, last + 1)
    return decoded[list(wanted)].astype(dtype)


def _predictions(shape: tuple[int, int, int], guide: NDArray | None, start: NDArray | None):
    """What is known of the values beforehand, (T, n, w) float64, or (T, 0, w) where nothing is."""
    steps, bodies, width = shape
    if guide is None and start is None:
        return np.empty((steps, 0, width))
    ahead = np.empty((steps, bodies, width))
    ahead[0] = 0.0
    if guide is not None:
        if guide.ndim != 3 or guide.shape[1:] != shape[1:] or len(guide) < steps:
            raise ValueError(f"guide of shape {guide.shape} for a block of shape {shape}")
        ahead[1:] = guide[1:steps]
    else:
        ahead[1:] = 0.0
    if start is not None:
        if start.shape != shape[1:]:
            raise ValueError(f"start of shape {start.shape} for a block of shape {shape}")
        ahead[0] = start
    # One addition after the other along time: the same bits everywhere.
    for t in range(1, steps):
        ahead[t] += ahead[t - 1]
    return ahead


# ---- choice of step width and paths


def _encode_paths(
    values: NDArray, size: float, ahead: NDArray, target: Target, effort: Effort
) -> tuple[bytes, NDArray] | None:
    """The block as paths and what that decodes to, or None where they cannot meet the target.

    values : (T, n, w), of magnitudes up to `size`; ahead : (T, n, w), or (T, 0, w)
    """
    _, bodies, width = values.shape
    goal = target.rmse(values.size)
    cap = min(2.0 * target.maximum, 8.0 * size if size > 0.0 else math.inf)
    step = min(math.sqrt(12.0) * goal, cap if math.isfinite(cap) else 1.0)
    if not 1e-303 < step < 1e304 or size > LARGEST_PATH * step:
        return None
    stride = max(1, bodies // effort.sample)
    near = _Paths.of(values[:, ::stride], ahead[:, ::stride], effort)
    start, drift = np.zeros(width), np.zeros(width)
    if not ahead.size:
        start = np.median(values[0], axis=0).astype(np.float64)
        drift = _find_drift(near.values)
    search = _Search(_first_prices(width), np.array([1.0, 6.0, 1.0]), 0.15, target.maximum)
    trial = _calibrate(near, start, drift, step, search, goal, cap)
    if not np.any(trial.layout.ends):
        drift = np.zeros(width)
    return _meet(_Paths.of(values, ahead, effort), start, drift, trial, target, cap)


@dataclass(frozen=True)
class _Paths:
    """A block and what is known of it, as kernels want them.

    given : (T, n, w) float32 or float64; values : the same as float64; ahead : as `_predictions`;
    along : both as (n, w, T) for a search along the time of each body, None for a greedy one
    """

    given: NDArray
    values: NDArray
    ahead: NDArray
    along: tuple[NDArray, NDArray] | None
    effort: Effort

    @classmethod
    def of(cls, values: NDArray, ahead: NDArray, effort: Effort) -> _Paths:
        """That of a block, or of some bodies of it."""
        given, ahead = np.ascontiguousarray(values), np.ascontiguousarray(ahead)
        values = given.astype(np.float64, copy=False)
        along = None
        if effort.thorough:
            along = _body_by_body(values), _body_by_body(ahead)
        return cls(given, values, ahead, along, effort)


def _body_by_body(values: NDArray) -> NDArray:
    """(n, w, T) of (T, n, w)."""
    return np.ascontiguousarray(values.transpose(1, 2, 0))


@dataclass(frozen=True)
class _Trial:
    """Paths r (T, w, n) found with a layout, their root mean square error, how many residuals there
    are in each context, (w, levels + 1, residuals), and what led there.
    """

    layout: Layout
    residuals: NDArray
    rmse: float
    counts: NDArray
    search: _Search


def _try(
    block: _Paths,
    start: NDArray,
    drift: NDArray,
    step: float,
    search: _Search,
    *,
    count: bool = True,
) -> _Trial:
    """Choose the paths at one step width. start, drift : (w,); count: whether for new prices."""
    steps, bodies, width = block.values.shape
    step = _rounded_step(step)
    unit_start, unit_drift = _units(step, steps)
    start = np.rint(start / unit_start) * unit_start
    drift = np.rint(drift / unit_drift) * unit_drift
    # Where it does not leave the level, it is no drift.
    drift = np.where(np.abs(drift) * steps > 0.5 * step, drift, 0.0)
    ends, sums = np.zeros(bodies, np.int64), np.zeros((5, 3))
    counts = np.zeros((width if count else 0, kernels.LEVELS + 1, 2 * kernels.SPAN + 1))
    if block.along is None:
        if drift.any():
            kernels.flights(block.values, drift, ends)
        residuals = np.empty((steps, width, bodies), np.int64)
        kernels.greedy_paths(
            block.values, block.ahead, start, drift, step, search.weight, search.prices,
            search.maximum, ends, residuals, sums, counts,
        )  # fmt: skip
    else:
        x, ahead = block.along
        share = np.zeros(bodies)
        if drift.any():
            kernels.flight_ends(x, drift, ends, share)
        paths = np.empty(x.shape, np.int64)
        kernels.choose_paths(
            x, ahead, start, drift, step, search.weight, search.prices, search.flags,
            search.maximum, ends, share, paths,
        )  # fmt: skip
        kernels.centroid_sums(x, ahead, start, drift, step, ends, paths, sums)
        if count:
            kernels.count_residuals(paths, counts)
        residuals = np.ascontiguousarray(paths.transpose(2, 1, 0))
    means = sums[:, 1] / np.maximum(sums[:, 0], 1.0)
    shifts = np.zeros(5)
    if search.maximum == math.inf:
        shifts[1:] = np.clip(np.rint(means[1:] / SHIFT_UNIT), -127, 127) * SHIFT_UNIT
    squares = sums[:, 2] - 2.0 * shifts * sums[:, 1] + shifts**2 * sums[:, 0]
    rmse = math.sqrt(max(float(squares.sum()), 0.0) / residuals.size) * step
    layout = Layout((steps, bodies, width), step, start, drift, shifts, ends)
    return _Trial(layout, residuals, rmse, counts, search)


def _calibrate(
    block: _Paths,
    start: NDArray,
    drift: NDArray,
    step: float,
    search: _Search,
    goal: float,
    cap: float,
) -> _Trial:
    """Prices, weight and step width on a sample of the bodies."""
    if goal == math.inf:
        return _cheapest(block, start, drift, step, search)
    for attempt in range(SETTLED + 2):
        trial = _try(block, start, drift, step, search)
        search = _repriced(trial)
        ratio = goal / trial.rmse if trial.rmse > 0.0 else 2.0
        if attempt >= 3 and abs(ratio - 1.0) < 0.01:
            break
        step = min(step * min(max(ratio, 0.4), 2.0), cap)
    return replace(trial, search=search, layout=replace(trial.layout, step=step))


def _cheapest(
    block: _Paths, start: NDArray, drift: NDArray, step: float, search: _Search
) -> _Trial:
    """For a pointwise bound alone: the step width that takes the fewest bits on a sample.

    The widest leaves one level within reach of a value, narrower ones leave two to choose from.
    """
    found, fewest = None, math.inf
    for share in (1.0, 0.75, 0.5):
        # The error does not count as long as it keeps to the bound.
        chosen = replace(search, weight=100.0)
        for _ in range(3 if block.effort.thorough else 2):
            trial = _try(block, start, drift, share * step * (1.0 - 1e-9), chosen)
            chosen = replace(_repriced(trial), weight=100.0)
        bits = float(np.sum(trial.counts * chosen.prices))
        if bits < fewest:
            found, fewest = replace(trial, search=chosen), bits
    return found


def _meet(
    block: _Paths, start: NDArray, drift: NDArray, trial: _Trial, target: Target, cap: float
) -> tuple[bytes, NDArray] | None:
    """Paths of all bodies at the widest step whose measured error keeps to the target."""
    values, effort = block.given, block.effort
    best, step, lowest, highest = None, trial.layout.step, 0.0, math.inf
    if target.frobenius < math.inf:
        step *= effort.aim
    search = trial.search
    for attempt in range(TRIALS):
        if attempt >= SETTLED and best is not None:
            break
        trial = _try(block, start, drift, step, search, count=False)
        decoded = _reconstruct(trial.layout, trial.residuals, block.ahead, len(values))
        decoded = decoded.astype(values.dtype, copy=False)
        squares, maximum = kernels.deviation(values, decoded, trial.layout.step)
        frobenius = math.sqrt(squares) * trial.layout.step
        # What is measured elsewhere may be summed in another order.
        if frobenius <= (1.0 - 1e-12) * target.frobenius and maximum <= target.maximum:
            best, lowest = (trial, decoded), step
            if frobenius >= effort.enough * target.frobenius or target.frobenius == math.inf:
                break
        else:
            highest = step
        ratio = target.frobenius / frobenius if frobenius > 0.0 else 2.0
        if maximum > target.maximum:
            ratio = min(ratio, 0.9)
        step = min(step * min(max(effort.aim * ratio, 0.5), 2.0), cap)
        if not lowest < step < highest:
            step = 0.5 * (lowest + highest) if highest < math.inf else lowest
        # Widths have nine binary digits.
        if min(step, highest) <= lowest * (1.0 + 2.0**-8):
            break
    if best is None:
        return None
    trial, decoded = best
    return _write(values.dtype, trial.layout, trial.residuals), decoded


def _find_drift(x: NDArray) -> NDArray:
    """The increment per step (w,) that most values share, found component by component."""
    steps, bodies, width = x.shape
    if steps < 4:
        return np.zeros(width)
    moved = np.diff(x[:, :: max(1, bodies // 256)], axis=0)
    drift = np.empty(width)
    for c in range(width):
        increments = np.sort(moved[:, :, c].ravel())
        run = min(max(4, len(increments) // 20), len(increments))
        first = int(np.argmin(increments[run - 1 :] - increments[: len(increments) - run + 1]))
        drift[c] = increments[first + run // 2]
    return drift


def _first_prices(width: int) -> NDArray:
    """Bits (w, levels + 1, residuals) before anything is counted."""
    return _prices_of(np.zeros((width, kernels.LEVELS + 1, 2 * kernels.SPAN + 1)))


def _prices_of(counts: NDArray) -> NDArray:
    sizes = np.abs(np.arange(-kernels.SPAN, kernels.SPAN + 1))
    means = [*_prior_means(kernels.LEVELS), 3.0]
    prior = half_power(sizes / np.array([[_laplace_scale(mean)] for mean in means]))
    prior = prior / prior.sum(axis=1, keepdims=True) + 1e-5
    weights = counts + PRIOR_WEIGHT * prior
    return -np.log2(weights / weights.sum(axis=2, keepdims=True))


def _repriced(trial: _Trial) -> _Search:
    """The same search with prices, and the weight of a bit, as counted in a trial."""
    counts = trial.counts
    ends, steps = trial.layout.ends, trial.layout.shape[0]
    kinds = np.array(
        [np.sum(ends == 0), np.sum((ends > 0) & (ends < steps)), np.sum(ends == steps)]
    )
    flags = -np.log2((kinds + 1.0) / (len(ends) + 3.0))
    flags[1] += 0.8 * math.log2(steps)
    still = counts[:, :, kernels.SPAN].sum() / counts.sum()
    return replace(
        trial.search, prices=_prices_of(counts), flags=flags, weight=0.11 + WEIGHT_STILL * still**2
    )


WEIGHT_STILL = 0.15


# ---- layout


def _rounded_step(step: float) -> float:
    """The nearest width below with nine binary digits."""
    mantissa, exponent = math.frexp(step)
    return math.ldexp(math.floor(512.0 * mantissa), exponent - 9)


def _units(step: float, steps: int) -> tuple[float, float]:
    """In what multiples start and drift are kept: fine enough not to be noticed after T steps."""
    return math.ldexp(step, -4), math.ldexp(step, -6 - steps.bit_length())


def _write(dtype, layout: Layout, residuals: NDArray) -> bytes:
    """All bytes of a block. residuals : (T, w, n) int64."""
    steps, _, width = layout.shape
    writer = Writer()
    for size in layout.shape:
        writer.number(size)
    mantissa, exponent = math.frexp(layout.step)
    writer.signed(exponent)
    writer.number(int(512.0 * mantissa) - 256)
    for vector, unit in zip((layout.start, layout.drift), _units(layout.step, steps), strict=True):
        for entry in vector:
            writer.signed(round(float(entry) / unit))
    for shift in layout.shifts[1:]:
        writer.signed(round(float(shift) / SHIFT_UNIT))
    if not layout.ends.any():
        writer.number(0)
    else:
        writer.number(1)
        writer.append(encode_integers(layout.ends))
    symbols = np.empty(residuals.size, np.int32)
    widest = max(int(residuals.max()), -int(residuals.min()))
    kernels.fold(np.array([widest]), np.zeros(1, np.int64), symbols[:1], np.empty(1, np.int64))
    top = (int(symbols[0]) + 1) // 2
    writer.number(top)
    scale = nearest_scale(_laplace_scale(float(np.abs(residuals[0]).mean())))
    writer.number(scale)
    _encode_residuals(writer, residuals, _Tables(width, top, scale))
    return bytes([PATHS + SINGLE * (dtype == np.float32)]) + writer.finish()


def _read_layout(reader: Reader, limit: int) -> tuple[Layout, int, int]:
    """The layout, the largest bucket and the scale of the first step."""
    steps = reader.number(limit)
    bodies = reader.number(limit // max(steps, 1))
    width = reader.number(limit // max(steps * bodies, 1))
    if not steps * bodies * width:
        raise ValueError("predictive block: empty")
    exponent = reader.signed()
    if not -1020 < exponent < 1024:
        raise ValueError("predictive block: no such step width")
    step = math.ldexp(256 + reader.number(255), exponent - 9)
    vectors = []
    for unit in _units(step, steps):
        vectors.append(np.array([reader.signed() * unit for _ in range(width)]))
    shifts = np.array([0.0] + [_within(reader.signed(), 127) * SHIFT_UNIT for _ in range(4)])
    ends = np.zeros(bodies, np.int64)
    if reader.number(1):
        ends, used = decode_integers(reader.rest(), limit=bodies)
        reader.take(used)
        if len(ends) != bodies or ends.min() < 0 or ends.max() > steps:
            raise ValueError("predictive block: flights of other bodies or steps")
    top, scale = reader.number(LAST_BUCKET), reader.number(SCALES - 1)
    reader.open()
    return Layout((steps, bodies, width), step, *vectors, shifts, ends), top, scale


def _within(value: int, bound: int) -> int:
    if abs(value) > bound:
        raise ValueError(f"predictive block: {value} where at most {bound} is possible")
    return value


# ---- residuals


def _prior_means(count: int) -> list[float]:
    """What |r| is expected at each level of activity, before anything is counted."""
    # A body whose residuals all have the size m has an activity of about 32 m.
    return [0.01, *(1.5**level / 32.0 for level in range(count - 1))]


def _laplace_scale(mean: float) -> float:
    """s of a distribution 2^-|r|/s over all integers with this mean of |r|."""
    return math.log(2.0) / math.asinh(1.0 / max(mean, 1e-3))


class _Tables:
    """Weights of the symbols, by component and level, that follow what is coded."""

    def __init__(self, width: int, top: int, scale: int) -> None:
        edges = bucket_edges(top + 2)
        laws = [nearest_scale(_laplace_scale(mean)) for mean in _prior_means(kernels.LEVELS)]
        laws += [scale] * (CONTEXTS - kernels.LEVELS)
        self._prior = self._laws(edges, np.array([[scale_value(law)] for law in laws]))
        self._counts = np.zeros((min(width, COMPONENTS), *self._prior.shape))
        self._weights = self._prior + self._counts
        self._seen = [[0] * len(laws) for _ in self._counts]

    @staticmethod
    def _laws(edges: NDArray, s: NDArray) -> NDArray:
        """Weights (laws, symbols) of distributions with the scales s (laws, 1)."""
        below = half_power(edges / s)
        weights = 0.5 * (below[:, :-1] * (1.0 - half_power(np.diff(edges) / s)))
        weights = np.concatenate([weights[:, :1], np.repeat(weights[:, 1:], 2, axis=1)], axis=1)
        # In the order of the symbols, on which the last bit depends.
        total = np.add.accumulate(weights, axis=1)[:, -1:]
        return weights * (PRIOR_WEIGHT / np.maximum(total, 1e-300)) + 1e-3 / weights.shape[1]

    def run(self, component: int, level: int, most: int) -> tuple[int, NDArray]:
        """How many symbols, at most `most`, come next with one table, and the table."""
        component = min(component, COMPONENTS - 1)
        length = max(64, self._seen[component][level] // 2)
        return min(length, most), self._weights[component, level]

    def learn(self, component: int, level: int, symbols: NDArray) -> None:
        """Let the table follow a run of symbols (m,) int32."""
        component = min(component, COMPONENTS - 1)
        kernels.count_symbols(
            symbols,
            self._prior[level],
            self._counts[component, level],
            self._weights[component, level],
        )
        self._seen[component][level] += len(symbols)


def _groups(levels: NDArray):
    """Yield (level, indices) for each level that occurs, in order."""
    order = np.argsort(levels, kind="stable")
    ends = np.cumsum(np.bincount(levels, minlength=CONTEXTS))
    begin = 0
    for level, end in enumerate(ends.tolist()):
        if end > begin:
            yield level, order[begin:end]
        begin = end


def _encode_residuals(writer: Writer, residuals: NDArray, tables: _Tables) -> None:
    """Range code residuals (T, w, n) int64, one step and component after the other."""
    _, width, bodies = residuals.shape
    last, memory = np.zeros((2, width, bodies), np.int64)
    levels, counts = np.empty(bodies, np.uint8), np.empty(CONTEXTS, np.int64)
    symbols, widths = np.empty(bodies, np.int32), np.empty(bodies, np.int64)
    for t, now in enumerate(residuals):
        for c in range(width):
            kernels.levels_now(now, last, memory, c, t == 0, levels)
            widest = kernels.arrange(now, last, levels, c, symbols, widths, counts)
            first = 0
            for level, count in enumerate(counts.tolist()):
                if count:
                    chosen = symbols[first : first + count]
                    first += count
                    while len(chosen):
                        length, weights = tables.run(c, level, len(chosen))
                        writer.symbols(chosen[:length], weights)
                        tables.learn(c, level, chosen[:length])
                        chosen = chosen[length:]
            for bits in range(1, widest + 1):
                open_bits = kernels.low_bits(now[c], widths, bits)
                if len(open_bits):
                    writer.bits(open_bits, bits)
        kernels.remember(now, t == 0, last, memory)


def _decode_residuals(reader, shape, upto: int, top: int, scale: int) -> NDArray:
    """The first `upto` steps of the residuals, (upto, w, n) int64."""
    _, bodies, width = shape
    tables = _Tables(width, top, scale)
    residuals = np.zeros((upto, width, bodies), np.int64)
    last, memory = np.zeros((2, width, bodies), np.int64)
    levels = np.empty(bodies, np.uint8)
    symbols, low = np.empty(bodies, np.int32), np.zeros(bodies, np.int64)
    for t, now in enumerate(residuals):
        for c in range(width):
            kernels.levels_now(now, last, memory, c, t == 0, levels)
            for level, indices in _groups(levels):
                while len(indices):
                    length, weights = tables.run(c, level, len(indices))
                    chosen = reader.symbols(length, weights)
                    tables.learn(c, level, chosen)
                    symbols[indices[:length]] = chosen
                    indices = indices[length:]
            bucket = (symbols + 1) // 2
            if int(bucket.max()) >= kernels.DIRECT:
                widths = np.maximum((bucket - kernels.DIRECT) // kernels.PARTS + 1, 0)
                for bits in range(1, int(widths.max()) + 1):
                    where = np.flatnonzero(widths == bits)
                    if len(where):
                        low[where] = reader.bits(len(where), bits)
            kernels.unfold(symbols, low, last[c], now[c])
        kernels.remember(now, t == 0, last, memory)
    return residuals


def _reconstruct(layout: Layout, residuals: NDArray, ahead: NDArray, steps: int) -> NDArray:
    """The first `steps` values, (steps, n, w). residuals : (steps + 1 unless the end, w, n)."""
    out = np.empty((steps, *layout.shape[1:]))
    kernels.reconstruct(
        ahead, layout.start, layout.drift, layout.step, layout.shifts, layout.ends, residuals,
        steps, out,
    )  # fmt: skip
    return out


# ---- raw


def _encode_raw(values: NDArray) -> bytes:
    """Every bit of the values, deflated by byte planes where that makes them fewer."""
    planes = np.ascontiguousarray(values).view(np.uint8).reshape(-1, values.itemsize).T
    plain = planes.tobytes()
    deflated = zlib.compress(plain, 1)
    kind = DEFLATED if len(deflated) < len(plain) else RAW
    first = kind + SINGLE * (values.dtype == np.float32)
    return struct.pack("<B3Q", first, *values.shape) + (deflated if kind == DEFLATED else plain)


def _decode_raw(data: bytes, kind: int, dtype, limit: int) -> NDArray:
    head = struct.calcsize("<B3Q")
    if len(data) < head:
        raise ValueError("predictive block: ends within its shape")
    shape = struct.unpack("<3Q", data[1:head])
    count = math.prod(shape)
    size = count * np.dtype(dtype).itemsize
    if count > limit:
        raise ValueError(f"predictive block: {count} entries where at most {limit} are possible")
    plain = data[head:]
    if kind == DEFLATED:
        stream = zlib.decompressobj()
        try:
            plain = stream.decompress(plain, size + 1)
        except zlib.error as error:
            raise ValueError(f"predictive block: {error}") from error
        if not stream.eof:
            raise ValueError("predictive block: deflated values do not end")
    if len(plain) != size:
        raise ValueError(f"predictive block: {len(plain)} bytes for shape {shape}")
    planes = np.frombuffer(plain[:size], np.uint8).reshape(np.dtype(dtype).itemsize, -1)
    return np.ascontiguousarray(planes.T).view(dtype).reshape(shape)
