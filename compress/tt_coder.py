"""Tensor trains with rounded, entropy-coded cores: a block of a field in few bytes.

`form="natural"` is a train of two cores, bodies and time with the components (`tt_natural`);
`form="tensorised"` one of many small ones, over the levels of bodies and of time
(`tt_tensorised`). Blocks that neither makes smaller are kept as they are, so that no code is longer
than the values by more than a few bytes.

Symbols: n bodies, T steps of time, w components.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compress import tt_natural, tt_tensorised
from compress._bytes import Bytes, number
from compress.bounds import Errors, Target, measure, norm
from compress.effort import BEST, Effort
from compress.step_search import CLOSE, SEEK

Form = Literal["natural", "tensorised"]
Wanted = slice | NDArray | None

RAW, NATURAL, TENSORISED, SECTIONS = range(4)
SINGLE = 16  # flag of float32
LIMIT = 1 << 31  # entries of a block

LAST_ROUNDING = 0.9  # share of the target that leaves room for rounding to float32
TRIALS = 4  # of the tensorised form
SECTION_COLUMNS = 512  # blocks of more T w are coded in sections of time


@dataclass(frozen=True)
class Header:
    """What stands before every kind of code: its mode, and the type and shape of the values."""

    mode: int
    dtype: np.dtype
    shape: tuple[int, int, int]

    def pack(self) -> bytes:
        """As bytes."""
        flag = SINGLE if self.dtype == np.float32 else 0
        return bytes([self.mode | flag]) + b"".join(number(length) for length in self.shape)

    @classmethod
    def read(cls, source: Bytes) -> Header:
        """The next one; ValueError if there is none."""
        first = source.take(1)[0]
        mode, dtype = first & ~SINGLE, np.dtype(np.float32 if first & SINGLE else np.float64)
        if mode > SECTIONS:
            raise ValueError(f"coded block: of no known kind ({mode})")
        steps, bodies, width = (source.number(LIMIT) for _ in range(3))
        if steps * bodies * width > LIMIT:
            raise ValueError(f"coded block: {steps} x {bodies} x {width} values are too many")
        return cls(mode, dtype, (steps, bodies, width))


def encode(
    values: NDArray,
    target: Target,
    *,
    order: NDArray | None = None,
    form: Form = "natural",
    effort: Effort = BEST,
) -> bytes:
    """Code a block so that what `decode` makes of it meets the target, as measured.

    values : (T, n, w) float32 or float64
    order : (n,) a permutation that puts neighbours in space side by side; only the tensorised
    form uses it, and `decode` needs the same one
    effort : how close to the target the natural form is to come

    Raises ValueError for values of another type or number of dimensions, and for NaN and infinity.
    """
    if form not in ("natural", "tensorised"):
        raise ValueError(f"form {form!r}: must be natural or tensorised")
    values = np.asarray(values)
    _check(values)
    raw = Header(RAW, values.dtype, values.shape).pack() + _little(values).tobytes()
    if target.exact or not values.size:
        return raw
    steps, _, width = values.shape
    if form == "tensorised" and not target.met_by(measure(values, np.zeros_like(values))):
        coded = _encode_tensorised(values, target, order)
    elif steps * width > SECTION_COLUMNS and steps > 1:
        coded = _encode_sections(values, target, effort)
    else:
        coded = _encode_natural(values, target, effort)
    return raw if coded is None or len(coded) >= len(raw) else coded


def decode(
    data: bytes,
    order: NDArray | None = None,
    steps: Wanted = None,
    bodies: Wanted = None,
) -> NDArray:
    """The values (T', n', w) of the steps and bodies asked for, all if None.

    Nothing else is expanded, and every value has the same bits whatever is asked for besides.
    Raises ValueError for bytes that no encoder wrote, IndexError for indices out of range.
    """
    source = Bytes(data)
    header = Header.read(source)
    T, n, width = header.shape
    chosen_steps, chosen_bodies = _indices(steps, T), _indices(bodies, n)
    if header.mode == RAW:
        size = T * n * width * header.dtype.itemsize
        values = np.frombuffer(source.take(size), header.dtype.newbyteorder("<"))
        if source.rest():
            raise ValueError("coded block: is longer than its values")
        values = values.reshape(header.shape).astype(header.dtype)
        return values[chosen_steps][:, chosen_bodies]
    if not T * n * width:
        raise ValueError("coded block: empty, yet coded")
    if header.mode == SECTIONS:
        return _decode_sections(source, header, chosen_steps, chosen_bodies)
    if header.mode == NATURAL:
        decoded = tt_natural.decode(source, header.shape, chosen_steps, chosen_bodies)
    else:
        decoded = tt_tensorised.decode(source, header.shape, order, chosen_steps, chosen_bodies)
    with np.errstate(over="ignore", under="ignore"):
        return decoded.astype(header.dtype)


def pays(data: bytes) -> bool:
    """Whether a block has become a tensor train, rather than being kept as it is."""
    return Header.read(Bytes(data)).mode != RAW


def _check(values: NDArray) -> None:
    if values.dtype not in (np.float32, np.float64):
        raise ValueError(f"values of type {values.dtype}: must be float32 or float64")
    if values.ndim != 3:
        raise ValueError(f"values of {values.ndim} dimensions: must be (steps, bodies, components)")
    if values.size and not math.isfinite(float(np.abs(values).max())):
        first = np.argwhere(~np.isfinite(values))[0]
        place = ", ".join(map(str, first))
        raise ValueError(f"values[{place}] = {values[tuple(first)]}: must be finite")


def _little(values: NDArray) -> NDArray:
    return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))


def _indices(wanted: Wanted, length: int) -> NDArray:
    """Indices (m,) int64 that a slice or an index array means."""
    every = np.arange(length)
    return every if wanted is None else every[wanted]


def _encode_natural(values: NDArray, target: Target, effort: Effort) -> bytes | None:
    """A train of two cores; None if that does not pay or cannot meet the target."""
    head = Header(NATURAL, values.dtype, values.shape).pack()
    for share in (1.0, LAST_ROUNDING):
        # The search sees the values as float64 scaled by a power of two.
        goal = Target(share * target.frobenius, share * target.maximum)
        code = tt_natural.encode(values, goal, effort)
        if code is None:
            return None
        if _is_plain(values) or target.met_by(measure(values, decode(head + code))):
            return head + code
    return None


def _encode_tensorised(values: NDArray, target: Target, order: NDArray | None) -> bytes | None:
    """A train of many cores; None likewise."""
    head = Header(TENSORISED, values.dtype, values.shape).pack()
    # Pointwise errors are spread about as those of independent numbers.
    frobenius = min(target.frobenius, 0.25 * target.maximum * math.sqrt(values.size))
    if frobenius >= norm(values):
        # A few entries stand out, which a train of zeros would lose.
        frobenius = 0.5 * norm(values)
    frobenius = min(frobenius, sys.float_info.max)
    axes = tt_tensorised.choose_axes(values, order, Target(frobenius))
    best = None
    for _ in range(TRIALS):
        code = tt_tensorised.encode(values, order, Target(frobenius), axes)
        if code is None or len(code) >= values.nbytes:
            break
        errors = measure(values, decode(head + code, order))
        excess = _excess(errors, target)
        if excess <= 1.0 and (best is None or len(code) < len(best)):
            best = code
        if CLOSE <= excess <= 1.0:
            break
        frobenius *= min(max(SEEK / max(excess, 1e-30), 0.2), 2.0)
        frobenius = min(frobenius, sys.float_info.max)
    return None if best is None else head + best


def _excess(errors: Errors, target: Target) -> float:
    """The largest share of what the target allows; errors may have overflowed."""
    pairs = ((errors.frobenius, target.frobenius), (errors.maximum, target.maximum))
    return max((error / allowed for error, allowed in pairs if allowed < math.inf), default=0.0)


def _is_plain(values: NDArray) -> bool:
    """Whether scaling by powers of two is exact and nothing is rounded to another type."""
    exponent = math.frexp(float(np.abs(values).max()))[1]
    return values.dtype == np.float64 and abs(exponent) < 900


def _encode_sections(values: NDArray, target: Target, effort: Effort) -> bytes | None:
    """Sections of time one after another, each with its share of the target."""
    steps, _, width = values.shape
    count = -(-steps * width // SECTION_COLUMNS)
    sections = [part for part in np.array_split(values, min(count, steps)) if len(part)]
    data = Header(SECTIONS, values.dtype, values.shape).pack() + number(len(sections))
    for part in sections:
        share = math.sqrt(len(part) / steps)
        code = encode(part, Target(target.frobenius * share, target.maximum), effort=effort)
        data += number(len(code)) + code
    return data


def _decode_sections(source: Bytes, header: Header, steps: NDArray, bodies: NDArray) -> NDArray:
    T, n, width = header.shape
    values = np.empty((len(steps), len(bodies), width), header.dtype)
    start = 0
    for _ in range(source.number(T)):
        code = source.take(source.number(LIMIT * 16))
        part = Header.read(Bytes(code))
        if part.mode == SECTIONS or part.shape[1:] != (n, width) or part.dtype != header.dtype:
            raise ValueError("coded block: sections do not fit together")
        inside = (steps >= start) & (steps < start + part.shape[0])
        if inside.any():
            values[inside] = decode(code, steps=steps[inside] - start, bodies=bodies)
        start += part.shape[0]
    if start != T or source.rest():
        raise ValueError("coded block: sections do not fit together")
    return values
