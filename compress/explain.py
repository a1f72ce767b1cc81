"""What to expect of compression, from a sample of the data, before any work.

Correlation in time is what makes a trajectory small: autocorrelation and its sum (S. De, PhD
thesis, University of Michigan 2021, eqs 4.33 and 4.34), ranks of the tensors, and what each coder
makes of chunks of the sample. The work depends on the size of the sample, not on that of the data.

Symbols: T steps, n bodies, w components, m length of a series.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compress import coders
from compress.bounds import Target, measure, norm
from compress.coding import FieldSpec, in_order_of_guides, increments
from compress.tensorize import (
    Form,
    Tensorisation,
    morton_order,
    train_parameters,
    unfolding_ranks,
)
from dem_mpi.errors import InputError

# read(name, first, stop): values (stop - first, n, w) of a field at these steps, the same bodies
# in the same order throughout.
Reader = Callable[[str, int, int], NDArray]

# Of a field in a chunk, for each coder, least and most bytes to expect of all bodies.
Sizes = Mapping[str, tuple[float, float]]

_LAGS = (1, 4, 16, 64)
_TOLERANCES = (1e-1, 1e-2, 1e-3)


@dataclass(frozen=True)
class Sampling:
    """How much is looked at.

    windows : stretches of steps, evenly spread; steps : of each, at least a chunk;
    bodies, runs : at most so many bodies, in so many runs of neighbours
    """

    windows: int = 4
    steps: int = 128
    bodies: int = 1024
    runs: int = 4

    def __post_init__(self) -> None:
        for name in ("windows", "steps", "bodies", "runs"):
            if getattr(self, name) < 1:
                raise ValueError(f"sample {name} {getattr(self, name)}: must be at least 1")


DEFAULT_SAMPLING = Sampling()


@dataclass(frozen=True)
class Correlation:
    """Correlation in time of the series of a sample, one for each body, component and window.

    mean : (m,) autocorrelation at each lag, averaged over series;
    iac : smallest, middle and largest of the sums [steps], None without series;
    cut : the share of series whose sum ended at a lag without positive autocorrelation, while
    the others go to the end of the window; constant : number of series left out as constant
    """

    mean: NDArray
    iac: tuple[float, float, float] | None
    cut: float
    constant: int


@dataclass(frozen=True)
class Ranks:
    """Largest rank, and entries over parameters (eq. 4.30), in a form at a relative tolerance."""

    tolerance: float
    form: Form
    largest: int
    ratio: float


@dataclass(frozen=True)
class Expected:
    """Ratio of raw bytes to coded ones: smallest, of all chunks together, and largest."""

    coder: str
    low: float
    whole: float
    high: float


@dataclass(frozen=True)
class FieldExplanation:
    """What a sample says of one field. `expected` has the best coders first; "any" is their pick.

    correlation and ranks are empty where values are no finite reals.
    """

    name: str
    spec: FieldSpec
    correlation: Correlation | None
    ranks: tuple[Ranks, ...]
    expected: tuple[Expected, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """As text."""
        unit = "" if self.spec.unit == "1" else f" {self.spec.unit}"
        bound = self.spec.bound
        allowed = bound.kind if bound.kind == "exact" else f"{bound.kind} {bound.value:g}"
        allowed += unit if bound.kind in ("rmse", "pointwise") else ""
        return (
            f"{self.name} ({allowed})",
            *(_correlation_lines(self.correlation) if self.correlation else ()),
            *_rank_lines(self.ranks),
            *_expected_lines(self.expected),
        )


@dataclass(frozen=True)
class Explanation:
    """What a sample says of all fields; `sample` says in words what was looked at."""

    sample: str
    fields: tuple[FieldExplanation, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """As text."""
        return (self.sample, *(line for field in self.fields for line in field.lines))


def explain(
    read: Reader,
    fields: Mapping[str, FieldSpec],
    times: NDArray,
    chunk: int = 32,
    positions: str | None = None,
    sampling: Sampling = DEFAULT_SAMPLING,
) -> Explanation:
    """Look at a sample of a trajectory and say what compression can be expected.

    times : (T,) [s] of the steps that `read` knows; chunk : steps that are coded together;
    positions : a name that `read` knows positions by, for the Morton order of bodies.
    Raises InputError where a value that only an exact bound keeps is not finite.
    """
    starts = _window_starts(len(times), chunk, sampling)
    length = min(max(sampling.steps, chunk), len(times))
    series: dict[str, list[NDArray]] = {name: [] for name in fields}
    places: list[NDArray] = []
    bodies = 0
    for first in starts:
        place = None
        for name in fields:
            values = read(name, first, first + length)
            if place is None:
                bodies = values.shape[1]
                where = read(positions, first, first + 1)[0] if positions is not None else None
                place = _sample_of_bodies(bodies, where, sampling)
                places.append(place)
            values = np.ascontiguousarray(values[:, place])
            _require_finite(name, fields[name], values, first, place)
            series[name].append(values)
    chunk = min(chunk, len(times))
    sizes: dict[str, list[Sizes]] = {name: [] for name in fields}
    for window, first in enumerate(starts):
        blocks = {name: series[name][window][:chunk] for name in fields}
        coded = _coded_sizes(blocks, fields, times[first : first + chunk], places[window], bodies)
        for name in fields:
            sizes[name].append(coded[name])
    known = tuple(
        _explain_field(name, fields[name], series[name], sizes[name], chunk, bodies)
        for name in fields
    )
    seen = min(bodies, sampling.bodies)
    sample = (
        f"sample: {len(starts)} windows of {length} steps, {seen:,} of {bodies:,} bodies; "
        f"ranks and ratios from the first {chunk} steps of each"
    )
    return Explanation(sample, known)


def autocorrelation(series: NDArray) -> NDArray:
    """AutoCorr(k) (m, ...) of series (m, ...) at the lags k = 0 ... m-1 (eq. 4.33).

    sum_i (x_i - mean) (x_{i+k} - mean) / sum_i (x_i - mean)^2; NaN where a series is constant but
    for rounding errors.
    """
    m = len(series)
    largest = np.abs(series).max(axis=0, initial=0.0)
    scaled = np.divide(series, largest, out=np.zeros(series.shape), where=largest > 0.0)
    centred = scaled - scaled.mean(axis=0)
    # Twice the length: the product of transforms is a sum over a circle.
    transform = np.fft.rfft(centred, 2 * m, axis=0)
    product = np.fft.irfft(transform.real**2 + transform.imag**2, 2 * m, axis=0)[:m]
    varies = np.sqrt(product[:1] / m) > 4.0 * np.finfo(series.dtype).eps
    return np.divide(product, product[:1], out=np.full(product.shape, np.nan), where=varies)


def integrated_autocorrelation(correlation: NDArray) -> tuple[NDArray, NDArray]:
    """IAC = 1 + 2 sum_k AutoCorr(k) (...) of AutoCorr (m, ...), and the lags summed (eq. 4.34).

    The estimates at all lags of a series of finite length sum to -1/2 whatever the series, so the
    sum has to end somewhere: here before the first lag k >= 1 where AutoCorr(k) <= 0, or with the
    last lag m - 1. A series that alternates counts as uncorrelated, 1.
    """
    positive = np.logical_and.accumulate(correlation[1:] > 0.0, axis=0)
    total = 1.0 + 2.0 * np.where(positive, correlation[1:], 0.0).sum(axis=0)
    return np.where(np.isnan(correlation[0]), np.nan, total), positive.sum(axis=0)


def correlate(windows: Sequence[NDArray]) -> Correlation:
    """Correlation in time of windows (m, n, w), each body and component a series of its own."""
    series = np.concatenate([values.reshape(len(values), -1) for values in windows], axis=1)
    found = autocorrelation(series)
    constant = np.isnan(found[0])
    found = found[:, ~constant]
    if not found.shape[1]:
        return Correlation(np.full(len(found), np.nan), None, 0.0, int(constant.sum()))
    sums, lags = integrated_autocorrelation(found)
    iac = float(sums.min()), float(np.median(sums)), float(sums.max())
    cut = float((lags < len(found) - 1).mean())
    return Correlation(found.mean(axis=1), iac, cut, int(constant.sum()))


def ranks(values: NDArray, tolerances: Sequence[float] = _TOLERANCES) -> tuple[Ranks, ...]:
    """Ranks of an array (T, n, w) as a natural and as a tensorised tensor, of unfoldings alone."""
    found = []
    for tolerance in tolerances:
        forms: tuple[Form, ...] = ("natural", "tensorised")
        for form in forms:
            split = Tensorisation.of(values.shape, form)
            cut = unfolding_ranks(split.forward(values), tolerance)
            parameters = train_parameters(split.shape, cut)
            ratio = values.size / parameters if parameters else np.inf
            found.append(Ranks(tolerance, form, max(cut, default=1), ratio))
    return tuple(found)


# ---- the sample ----------------------------------------------------------------------------


def _window_starts(steps: int, chunk: int, sampling: Sampling) -> list[int]:
    """First steps of the windows: evenly spread, each the first one of a chunk, none twice."""
    if steps < 1 or chunk < 1:
        raise ValueError(f"{steps} steps in chunks of {chunk}: both must be positive")
    last = max(steps - max(sampling.steps, chunk), 0)
    spread = np.linspace(0, last, sampling.windows).astype(np.int64) // chunk * chunk
    return [int(first) for first in np.unique(spread)]


def _sample_of_bodies(bodies: int, position: NDArray | None, sampling: Sampling) -> NDArray:
    """Which bodies are looked at, neighbours side by side."""
    order = np.arange(bodies) if position is None else morton_order(position)
    if bodies <= sampling.bodies:
        return order
    length = max(sampling.bodies // sampling.runs, 1)
    starts = np.linspace(0, bodies - length, min(sampling.runs, sampling.bodies)).astype(np.int64)
    return order[(starts[:, None] + np.arange(length)).ravel()]


def _require_finite(
    name: str, spec: FieldSpec, values: NDArray, first: int, place: NDArray
) -> None:
    if spec.bound.kind == "exact" or values.dtype.kind != "f" or np.isfinite(values).all():
        return
    step, body, component = (int(i) for i in np.argwhere(~np.isfinite(values))[0])
    raise InputError(
        f"{name}: {values[step, body, component]} at step {first + step}, row {int(place[body])}, "
        f"component {component}: only an exact bound keeps it"
    )


# ---- what coders make of it ----------------------------------------------------------------


def _coded_sizes(
    blocks: Mapping[str, NDArray],
    fields: Mapping[str, FieldSpec],
    times: NDArray,
    place: NDArray,
    bodies: int,
) -> dict[str, Sizes]:
    """Of each field of a chunk (T, n, w), whose bodies are those at `place` (n,) of all.

    Half of the sample is coded besides: a line through both tells what a chunk costs however many
    bodies it has. Most is the bytes of the sample times the number of bodies in it.
    """
    seen = len(place)
    whole = _block_sizes(blocks, fields, times, place)
    half: dict[str, dict[str, int]] = {}
    if bodies > seen > 1:
        few = {name: values[:, : seen // 2] for name, values in blocks.items()}
        half = _block_sizes(few, fields, times, place[: seen // 2])
    return {
        name: {
            coder: _extrapolated(size, half.get(name, {}).get(coder), seen, bodies)
            for coder, size in sizes.items()
        }
        for name, sizes in whole.items()
    }


def _extrapolated(size: int, half: int | None, seen: int, bodies: int) -> tuple[float, float]:
    """Least and most bytes of all bodies, from those of the bodies seen and of half of them."""
    most = size * bodies / max(seen, 1)
    if half is None:
        return most, most
    slope = max(size - half, 0) / (seen - seen // 2)
    return min(size + slope * (bodies - seen), most), most


def _block_sizes(
    blocks: Mapping[str, NDArray], fields: Mapping[str, FieldSpec], times: NDArray, place: NDArray
) -> dict[str, dict[str, int]]:
    """Bytes of each field by each coder that keeps to its bound.

    Archives keep bodies by number: so they are coded, the order in space being told besides.
    """
    by_number = np.argsort(place)
    in_space = np.argsort(by_number)
    known = (np.diff(place) < 0).any()
    order = (lambda: in_space) if known else None
    sizes: dict[str, dict[str, int]] = {}
    decoded: dict[str, NDArray] = {}
    for name in in_order_of_guides(fields):
        spec = fields[name]
        values = np.ascontiguousarray(blocks[name][:, by_number])
        exact = spec.bound.kind == "exact" or values.dtype.kind != "f"
        target = Target(0.0, 0.0) if exact else spec.bound.target(values)
        guide = None if spec.guide is None else increments(decoded[spec.guide], times)
        context = coders.Context(guide, order)
        sizes[name], decoded[name] = _try_coders(values, target, context)
    return sizes


def _try_coders(
    values: NDArray, target: Target, context: coders.Context
) -> tuple[dict[str, int], NDArray]:
    """Bytes by each coder that meets the target, and what the best of them decodes to."""
    sizes: dict[str, int] = {}
    best = values
    for coder in coders.candidates(target, context):
        data = coders.encode(coder, values, target, context)
        if data is None:
            continue
        decoded = coders.decode(coder, data, values.dtype, values.shape, context.guide)
        same = decoded.tobytes() == values.tobytes()
        if same or (not target.exact and target.met_by(measure(values, decoded))):
            if len(data) < min(sizes.values(), default=len(data) + 1):
                best = decoded
            sizes[coder] = len(data)
    if not sizes:
        sizes["exact"] = len(coders.encode("exact", values, target) or b"")
    return sizes, best


# ---- words ---------------------------------------------------------------------------------


def _explain_field(
    name: str,
    spec: FieldSpec,
    windows: Sequence[NDArray],
    sizes: Sequence[Sizes],
    chunk: int,
    bodies: int,
) -> FieldExplanation:
    raw = chunk * bodies * windows[0].shape[2] * windows[0].dtype.itemsize
    whole = _expected(raw, sizes)
    if windows[0].dtype.kind != "f" or not all(np.isfinite(values).all() for values in windows):
        return FieldExplanation(name, spec, None, (), whole)
    largest = max((values[:chunk] for values in windows), key=_highest_rank)
    return FieldExplanation(name, spec, correlate(windows), ranks(largest), whole)


def _highest_rank(values: NDArray) -> int:
    if norm(values) == 0.0:
        return 0
    return max(unfolding_ranks(Tensorisation.of(values.shape, "natural").forward(values), 1e-2))


def _expected(raw: int, sizes: Sequence[Sizes]) -> tuple[Expected, ...]:
    """Of the pick of coders in each chunk, and of each one that can code all chunks."""
    picks = [min(chunk.values()) for chunk in sizes]
    found = [_ratios("any", raw, picks)]
    for coder in sizes[0]:
        if all(coder in chunk for chunk in sizes):
            found.append(_ratios(coder, raw, [chunk[coder] for chunk in sizes]))
    return (found[0], *sorted(found[1:], key=lambda one: -one.whole))


def _ratios(coder: str, raw: int, sizes: Sequence[tuple[float, float]]) -> Expected:
    least, most = (np.maximum(part, 1.0) for part in zip(*sizes, strict=True))
    return Expected(coder, raw / max(most), raw * len(sizes) / sum(least), raw / min(least))


def _correlation_lines(known: Correlation) -> list[str]:
    if known.iac is None:
        return [f"  autocorrelation: all {known.constant:,} series are constant"]
    low, middle, high = known.iac
    lags = [k for k in _LAGS if k < len(known.mean)]
    values = ", ".join(f"{known.mean[k]:.2f}" for k in lags)
    constant = f"; {known.constant:,} constant series left out" if known.constant else ""
    return [
        f"  autocorrelation at lag {', '.join(map(str, lags))}: {values}",
        f"  IAC {middle:.3g} steps ({low:.3g} to {high:.3g}), summed up to the first lag that is "
        f"not positive ({known.cut:.0%} of the series), else over {len(known.mean) - 1} lags"
        + constant,
    ]


def _rank_lines(known: Sequence[Ranks]) -> list[str]:
    forms = dict.fromkeys(one.form for one in known)
    return [
        f"  largest rank (entries a parameter), {form}: "
        + ", ".join(
            f"{one.largest} ({one.ratio:.3g}) at {one.tolerance:.0e}"
            for one in known
            if one.form == form
        )
        for form in forms
    ]


def _expected_lines(known: Sequence[Expected]) -> list[str]:
    title = {"any": "expected ratio"}
    return [
        f"  {title.get(one.coder, '  by ' + one.coder)}: {one.whole:.3g} "
        f"({one.low:.3g} to {one.high:.3g} by chunk)"
        for one in known
    ]
