"""Entropy coding of integers: any 64-bit values, in groups that each have their own distribution.

A value v of a group is coded as d = v - offset. The magnitude u = |d| falls into a bucket b: one
bucket a number below 32, sixteen a power of two above it, with the remaining low bits coded as
they are. The bucket (with the sign) is range coded by a table that starts as the distribution of
the group's family and scale and then follows the counts of what has been coded of the group.

Tables come from additions, products and quotients of binary64 alone (no library's exp or log), so
every machine reads what another one wrote.

Symbols: b bucket, d = v - offset, u = |d|, top = largest bucket of a group, s scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import constriction
import numpy as np
from numpy.typing import NDArray

models, queue = constriction.stream.model, constriction.stream.queue

DIRECT = 32  # magnitudes below this have a bucket of their own
PARTS = 16  # buckets a power of two above
PART_BITS = 4
DIRECT_BITS = 5
LAST_BUCKET = DIRECT + (64 - DIRECT_BITS) * PARTS - 1

LIMIT = 1 << 28  # most values that are decoded unless the caller expects more
FEW_GROUPS = 8  # up to so many groups, their parameters are written byte by byte

# Families of distributions of d, the scale s counted in quarters of a power of two.
CONSTANT, LAPLACE, GAUSS, UPWARDS = range(4)
SCALES_BELOW_ONE = 24
SCALES = SCALES_BELOW_ONE + 4 * 65
PRIOR_WEIGHT = 32.0  # how many values the family's distribution counts for
TAIL = 2.0**-14  # share of the table spread evenly, for outliers

_QUARTERS = (1.0, 1.189207115002721, 1.4142135623730951, 1.681792830507429)
# 2^-x on [0, 1): Taylor coefficients (-ln 2)^k / k!.
_HALF_POWERS = tuple((-0.6931471805599453) ** k / math.factorial(k) for k in range(18))


class Writer:
    """Bytes under construction: numbers of variable length, in front of range-coded symbols."""

    def __init__(self) -> None:
        self._head = bytearray()
        self.coder = queue.RangeEncoder()

    def number(self, value: int) -> None:
        """Append a natural number, seven bits a byte."""
        while value >= 0x80:
            self._head.append(value & 0x7F | 0x80)
            value >>= 7
        self._head.append(value)

    def signed(self, value: int) -> None:
        """Append an integer of any sign."""
        self.number(2 * value if value >= 0 else -2 * value - 1)

    def append(self, data: bytes) -> None:
        """Append bytes as they are."""
        self._head += data

    def symbols(self, values: NDArray, table: NDArray) -> None:
        """Range code `values` (n,) in [0, len(table)) with weights `table`."""
        if len(table) > 1 and len(values):
            self.coder.encode(
                values.astype(np.int32, copy=False), models.Categorical(table, perfect=False)
            )

    def bits(self, values: NDArray, width: int) -> None:
        """Range code `values` (n,) uint64 below 2^width, all equally likely."""
        for low in range(0, width, 16):
            part = min(16, width - low)
            digits = (values >> np.uint64(low)) & np.uint64((1 << part) - 1)
            self.coder.encode(digits.astype(np.int32), models.Uniform(1 << part))

    def finish(self) -> bytes:
        """All of it; the length of the range-coded part stands behind the numbers."""
        words = self.coder.get_compressed().astype("<u4")
        self.number(len(words))
        return bytes(self._head) + words.tobytes()


class Reader:
    """Reads what a Writer wrote. Raises ValueError where that cannot have been."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.used = 0
        self._coder: queue.RangeDecoder | None = None

    def number(self, limit: int = 1 << 64) -> int:
        """The next natural number, which must not exceed `limit`."""
        value = shift = 0
        while True:
            if self.used >= len(self._data) or shift > 63:
                raise ValueError("coded integers: end within a number")
            byte = self._data[self.used]
            self.used += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
            shift += 7
        if value > limit:
            raise ValueError(f"coded integers: {value} where at most {limit} is possible")
        return value

    def signed(self) -> int:
        """The next integer of any sign."""
        value = self.number((1 << 64) - 1)
        return value >> 1 if value % 2 == 0 else -(value >> 1) - 1

    def take(self, count: int) -> bytes:
        """The next bytes as they are."""
        if count > len(self._data) - self.used:
            raise ValueError("coded integers: end within a block")
        self.used += count
        return self._data[self.used - count : self.used]

    def rest(self) -> bytes:
        """All bytes not read yet."""
        return self._data[self.used :]

    def open(self) -> None:
        """Pass from the numbers to the range-coded symbols."""
        words = self.take(4 * self.number(len(self._data) // 4))
        self._coder = queue.RangeDecoder(np.frombuffer(words, "<u4").astype(np.uint32))

    def symbols(self, count: int, table: NDArray) -> NDArray:
        """The next `count` symbols, (count,) int32, coded with the weights `table`."""
        if len(table) < 2 or not count:
            return np.zeros(count, np.int32)
        return self._decode(models.Categorical(table, perfect=False), count)

    def bits(self, count: int, width: int) -> NDArray:
        """The next `count` numbers below 2^width, (count,) uint64."""
        values = np.zeros(count, np.uint64)
        for low in range(0, width, 16):
            digits = self._decode(models.Uniform(1 << min(16, width - low)), count)
            values |= digits.astype(np.uint64) << np.uint64(low)
        return values

    def _decode(self, model: models.Model, count: int) -> NDArray:
        try:
            return self._coder.decode(model, count)
        except AssertionError as error:  # the package's word for invalid data
            raise ValueError("coded integers: not a code of these symbols") from error


@dataclass(frozen=True)
class Law:
    """How the integers of a group are distributed: what the decoder has to know of them."""

    family: int
    scale: int = 0
    top: int = 0
    offset: int = 0

    @property
    def signed(self) -> bool:
        """Whether values below the offset occur."""
        return self.family in (LAPLACE, GAUSS)

    def check(self) -> Law:
        """Itself, if an encoder can have written it; ValueError otherwise."""
        if not (
            CONSTANT <= self.family <= UPWARDS
            and 0 <= self.scale < SCALES
            and 0 <= self.top <= LAST_BUCKET
            and -(1 << 63) <= self.offset < 1 << 63
        ):
            raise ValueError(f"coded integers: no such distribution: {self}")
        return self

    def table(self) -> NDArray:
        """Weights (buckets and signs,) of the symbols before any has been seen, of sum 1."""
        edges = bucket_edges(self.top + 2)
        s = scale_value(self.scale)
        if self.family == GAUSS:
            middle = (0.5 / s) * (edges[1:] + edges[:-1] - 1.0)
            weights = half_power(middle * middle) * np.diff(edges)
        else:
            below = half_power(edges / s)
            # Near the largest scale all of a bucket's numbers are equally likely.
            weights = below[:-1] * (1.0 - half_power(np.diff(edges) / s))
        if self.signed:
            weights = np.concatenate([weights[:1], np.repeat(0.5 * weights[1:], 2)])
            if self.family == LAPLACE:
                weights[0] *= 0.5  # 0 has one sign only
        weights *= 1.0 / max(_sum(weights), 1e-300)
        return (1.0 - TAIL) * weights + TAIL / len(weights)


def encode_integers(values: NDArray, groups: Sequence[int] | None = None) -> bytes:
    """Code integers so that `decode_integers` gives them back.

    values : (n,) of any integer type within int64
    groups : lengths of consecutive runs with a distribution of their own, of sum n; None: one
    """
    values = np.ascontiguousarray(values, dtype=np.int64)
    if values.ndim != 1:
        raise ValueError(f"integers of shape {values.shape}: must have one dimension")
    lengths = np.array([len(values)] if groups is None else groups, dtype=np.int64)
    if lengths.sum() != len(values) or lengths.min(initial=0) < 0:
        raise ValueError(f"groups hold {lengths.sum()} integers, not {len(values)}")
    parts = np.split(values, np.cumsum(lengths)[:-1]) if len(lengths) else []
    laws = [_fit(part) for part in parts]
    writer = Writer()
    writer.number(len(laws))
    if len(laws) <= FEW_GROUPS:
        for length, law in zip(lengths, laws, strict=True):
            writer.number(int(length))
            _write_law(writer, law)
    else:
        writer.append(_encode_laws(lengths, laws))
    for part, law in zip(parts, laws, strict=True):
        _encode_group(writer, part, law)
    return writer.finish()


def decode_integers(data: bytes, limit: int = LIMIT) -> tuple[NDArray, int]:
    """The integers (n,) int64 at the beginning of `data`, and how many bytes they took.

    Raises ValueError for damaged bytes and for more than `limit` integers.
    """
    reader = Reader(data)
    count = reader.number(limit)
    if count <= FEW_GROUPS:
        lengths, laws = [], []
        for _ in range(count):
            lengths.append(reader.number(limit - sum(lengths)))
            laws.append(_read_law(reader))
    else:
        lengths, laws = _decode_laws(reader, count, limit)
    reader.open()
    values = np.empty(sum(lengths), np.int64)
    start = 0
    for length, law in zip(lengths, laws, strict=True):
        values[start : start + length] = _decode_group(reader, length, law)
        start += length
    return values, reader.used


def half_power(x: NDArray) -> NDArray:
    """2^-x for x >= 0, the same bits on every machine (to about 1e-15)."""
    x = np.minimum(x, 1100.0)
    whole = np.floor(x)
    rest = x - whole
    power = np.full_like(x, _HALF_POWERS[-1])
    for coefficient in _HALF_POWERS[-2::-1]:
        power = power * rest + coefficient
    return np.ldexp(power, -whole.astype(np.int32))


def bucket_edges(count: int) -> NDArray:
    """The smallest magnitude of each of the first `count` buckets, (count,) float64, exact."""
    b = np.arange(count)
    octave, part = np.divmod(b - DIRECT, PARTS)
    above = np.ldexp((PARTS + part).astype(np.float64), octave + DIRECT_BITS - PART_BITS)
    return np.where(b < DIRECT, b.astype(np.float64), above)


def buckets(u: NDArray) -> tuple[NDArray, NDArray]:
    """Buckets of magnitudes u (n,) uint64, and the bit lengths of what they leave open."""
    exponent = np.frexp(u.astype(np.float64))[1].astype(np.int64) - 1
    # Rounding to float64 may have carried into the next power of two.
    exponent -= (u >> np.maximum(exponent, 0).astype(np.uint64)) == 0
    width = np.maximum(exponent - PART_BITS, 0)
    part = (u >> width.astype(np.uint64)).astype(np.int64) - PARTS
    b = np.where(u < DIRECT, u.astype(np.int64), DIRECT + (exponent - DIRECT_BITS) * PARTS + part)
    return b, np.where(u < DIRECT, 0, width)


def _smallest(b: NDArray) -> tuple[NDArray, NDArray]:
    """The smallest magnitude (uint64) of each bucket of b, and the bits it leaves open."""
    octave, part = np.divmod(b - DIRECT, PARTS)
    width = np.where(b < DIRECT, 0, octave + DIRECT_BITS - PART_BITS)
    low = np.where(b < DIRECT, b, PARTS + part).astype(np.uint64)
    return low << width.astype(np.uint64), width


def _sum(weights: NDArray) -> float:
    """The sum in the order of the entries (numpy's own order depends on the processor)."""
    return float(np.add.accumulate(weights)[-1])


def scale_value(scale: int) -> float:
    """s of a scale given in quarters of a power of two."""
    octave, quarter = divmod(scale - SCALES_BELOW_ONE, 4)
    return math.ldexp(_QUARTERS[quarter], octave)


def nearest_scale(s: float) -> int:
    """The scale nearest to s."""
    quarters = round(4.0 * math.log2(s)) if s > 0.0 else -SCALES_BELOW_ONE
    return min(max(quarters + SCALES_BELOW_ONE, 0), SCALES - 1)


def _fit(values: NDArray) -> Law:
    """The law that codes the values in the fewest bits, of a few that are likely to."""
    if not len(values):
        return Law(CONSTANT)
    least, most = int(values.min()), int(values.max())
    if least == most:
        return Law(CONSTANT, offset=least)
    middle = int(np.partition(values, len(values) // 2)[len(values) // 2])
    trials = [(LAPLACE, 0), (GAUSS, 0), (UPWARDS, least)]
    if abs(middle) > (most - least) // 64:
        trials += [(LAPLACE, middle), (GAUSS, middle)]
    best, fewest = None, math.inf
    for family, offset in trials:
        u, _ = _magnitudes(values, offset)
        b, width = buckets(u)
        top = int(b.max())
        size = u.astype(np.float64)
        if family == GAUSS:
            # 2^-(u/s)^2 has the variance s^2 / (2 ln 2).
            s = math.sqrt(2.0 * math.log(2.0) * max(float(np.mean(size * size)), 1e-3))
        else:
            # 2^-(u/s) summed over u >= 0 (UPWARDS) or over both signs has this mean.
            mean = max(float(np.mean(size)), 1e-3)
            s = math.log(2.0) / (
                math.log1p(1.0 / mean) if family == UPWARDS else math.asinh(1.0 / mean)
            )
        law = Law(family, nearest_scale(s), top, offset)
        weights = law.table()
        if law.signed:
            weights = np.concatenate([weights[:1], weights[1::2]])
        counts = np.bincount(b, minlength=top + 1)
        bits = float(width.sum()) - float(counts @ np.log2(weights))
        bits += 8.0 * (offset != 0) + 0.01 * (family != LAPLACE)
        if bits < fewest:
            best, fewest = law, bits
    return best


def _magnitudes(values: NDArray, offset: int) -> tuple[NDArray, NDArray]:
    """u and the signs (True below the offset) of values (n,) int64."""
    # Modulo 2^64 no difference overflows.
    d = values.view(np.uint64) - np.uint64(offset % (1 << 64))
    below = values < offset
    return np.where(below, np.uint64(0) - d, d), below


def _write_law(writer: Writer, law: Law) -> None:
    writer.number(law.family + 4 * (law.offset != 0))
    if law.offset:
        writer.signed(law.offset)
    if law.family != CONSTANT:
        writer.number(law.scale)
        writer.number(law.top)


def _read_law(reader: Reader) -> Law:
    kind = reader.number(7)
    offset = reader.signed() if kind >= 4 else 0
    if kind % 4 == CONSTANT:
        return Law(CONSTANT, offset=offset).check()
    return Law(kind % 4, reader.number(), reader.number(), offset).check()


def _encode_laws(lengths: NDArray, laws: Sequence[Law]) -> bytes:
    """Lengths and laws of many groups, as integers that are coded in their turn."""
    fields = np.array([[law.family, law.scale, law.top, law.offset] for law in laws]).T
    family, scale, top, offset = fields
    drawn = family != CONSTANT
    # The largest bucket is mostly a few octaves above the scale, that near the last group's.
    columns = [lengths, family, np.diff(scale[drawn], prepend=0), (top - 4 * scale)[drawn], offset]
    return encode_integers(np.concatenate(columns), [len(column) for column in columns])


def _decode_laws(reader: Reader, count: int, limit: int) -> tuple[list[int], list[Law]]:
    numbers, used = decode_integers(reader.rest(), limit=5 * count)
    reader.take(used)
    if len(numbers) < 3 * count:
        raise ValueError("coded integers: too few parameters of groups")
    lengths, family = numbers[:count], numbers[count : 2 * count]
    offset = numbers[-count:]
    drawn = family != CONSTANT
    if len(numbers) != 3 * count + 2 * drawn.sum():
        raise ValueError("coded integers: parameters of groups do not agree")
    scale, top = np.zeros(count, np.int64), np.zeros(count, np.int64)
    pairs = numbers[2 * count : -count].reshape(2, -1)
    scale[drawn] = np.cumsum(pairs[0])
    top[drawn] = pairs[1] + 4 * scale[drawn]
    if lengths.min() < 0 or lengths.max() > limit or lengths.sum() > limit:
        raise ValueError(f"coded integers: groups hold more than {limit}")
    rows = np.stack([family, scale, top, offset], axis=1).tolist()
    return lengths.tolist(), [Law(*row).check() for row in rows]


def _blocks(count: int) -> list[int]:
    """Ends of the runs in which a table stays as it is: each half as long as all before."""
    ends, end = [], 64
    while end < count:
        ends.append(end)
        end += max(end // 2, 64)
    return [*ends, count]


def _encode_group(writer: Writer, values: NDArray, law: Law) -> None:
    if law.family == CONSTANT:
        return
    u, below = _magnitudes(values, law.offset)
    b, width = buckets(u)
    symbols = np.where(b > 0, 2 * b - 1 + below, 0) if law.signed else b
    start, prior = 0, PRIOR_WEIGHT * law.table()
    counts = np.zeros(len(prior), np.int64)
    for end in _blocks(len(values)):
        run = symbols[start:end]
        writer.symbols(run, prior + counts)
        counts += np.bincount(run, minlength=len(counts))
        start = end
    for bits in range(1, int(width.max(initial=0)) + 1):
        chosen = width == bits
        if chosen.any():
            writer.bits(u[chosen], bits)


def _decode_group(reader: Reader, count: int, law: Law) -> NDArray:
    if law.family == CONSTANT:
        return np.full(count, law.offset, np.int64)
    symbols = np.empty(count, np.int64)
    start, prior = 0, PRIOR_WEIGHT * law.table()
    counts = np.zeros(len(prior), np.int64)
    for end in _blocks(count):
        run = reader.symbols(end - start, prior + counts)
        symbols[start:end] = run
        counts += np.bincount(run, minlength=len(counts))
        start = end
    b, below = symbols, np.zeros(count, bool)
    if law.signed:
        b, below = (symbols + 1) // 2, (symbols % 2 == 0) & (symbols > 0)
    u, width = _smallest(b)
    for bits in range(1, int(width.max(initial=0)) + 1):
        chosen = width == bits
        if chosen.any():
            u[chosen] |= reader.bits(int(np.count_nonzero(chosen)), bits)
    d = np.where(below, np.uint64(0) - u, u)
    return (d + np.uint64(law.offset % (1 << 64))).view(np.int64)
