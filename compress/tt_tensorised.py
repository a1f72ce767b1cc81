"""Blocks as trains of many small cores, rounded and coded: levels of bodies, levels of time.

X = A_1 ... A_d, cores orthogonal towards the pivot p, which carries the scale. An error of core
k < p, in the column that goes on to bond value b, counts for the norm sigma_b of what stands to the
right of it; in core k > p, for that to the left. Cores times their sigma are therefore rounded
with one step for all of them, in units of which the errors add up as those of independent numbers
do. The decoder has the sigmas in quarters of a power of two, since they only choose steps.

Either bodies come first or time does; a sample is coded both ways. Of 16,384 settling spheres (32
steps of velocities, relative error 0.1), rows as they were placed, layer by layer, time first takes
14 % fewer bytes, during the impact 32 % fewer; with rows in Morton order it takes more.

Symbols: n bodies in Morton order, T steps of time, w components, d dimensions, r ranks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compress import _kernels_train as kernels
from compress._bytes import Bytes, number, signed
from compress._kernels_basis import polynomials
from compress.bounds import Target, norm
from compress.decompose import tt_svd
from compress.entropy import decode_integers, encode_integers
from compress.quantise import PRICE, Rounded, round_matrix, shift_values, unround
from compress.step_search import MET, Seeker, step_size
from compress.tensorize import THESIS_ORDER, Axis, Tensorisation, sample_bodies

TRUNCATION = 0.6  # share of the error that truncation may take, the rest is rounding's
PASSES = 6
DROPPED = 0.6  # a column below so many steps would be rounded to nothing
QUARTERS = (1.0, 1.189207115002721, 1.4142135623730951, 1.681792830507429)
# In codes an order of the axes is its place in this list. Bodies are first or last.
ORDERS: tuple[tuple[Axis, Axis, Axis], ...] = (THESIS_ORDER, ("steps", "components", "bodies"))
TRIAL_BODIES, TRIAL_RUNS = 2048, 4  # that a trial of orders codes, and runs of neighbours
MOST_PARAMETERS = 2.0  # to the entries: a number of a core costs some bits, not 64


@dataclass(frozen=True)
class _Core:
    """A core as a matrix (rows, columns): the bond towards the pivot gives the columns."""

    rounded: Rounded
    exponents: NDArray  # of sigma over the step, in quarters, for each column


@dataclass(frozen=True)
class _Code:
    """A train rounded with one step; `error` of its cores together, by their weights [1]."""

    step: int
    pivot: int
    cores: list[_Core]
    error: float

    def pack(self, axes: int, exponent: int) -> bytes:
        data = bytes([axes]) + signed(exponent)
        data += self.step.to_bytes(2, "little") + number(self.pivot)
        for core in self.cores:
            data += number(core.rounded.q.shape[1])
        bonds = [core.exponents for k, core in enumerate(self.cores) if k != self.pivot]
        data += encode_integers(np.concatenate([np.diff(bond, prepend=0) for bond in bonds]))
        largest = max(self.cores, key=lambda core: core.rounded.q.size)
        data += bytes(shift % 256 for shift in largest.rounded.shifts)
        for core in self.cores:
            data += number(len(core.rounded.data)) + core.rounded.data
        return data


def choose_axes(values: NDArray, order: NDArray | None, target: Target) -> int:
    """Which of ORDERS takes the fewest bytes on a sample of bodies, sorted by `order`.

    The first where all are alike, as where zeros would do for the sample.
    """
    bodies = values if order is None else values[:, order]
    sample = sample_bodies(bodies, TRIAL_BODIES, TRIAL_RUNS)
    goal = Target(target.frobenius * math.sqrt(sample.size / values.size))
    if norm(sample) <= goal.frobenius:
        return 0

    def length(axes: int) -> float:
        code = encode(sample, None, goal, axes)
        return math.inf if code is None else len(code)

    return min(range(len(ORDERS)), key=length)


def encode(values: NDArray, order: NDArray | None, target: Target, axes: int = 0) -> bytes | None:
    """Code (T, n, w) finite values, bodies sorted by `order`; None if that does not pay.

    axes : which of ORDERS the dimensions follow

    The Frobenius error is met by the sum of the cores' errors, measured afterwards by the caller;
    a pointwise target has to be met by a smaller Frobenius error.
    """
    exponent = math.frexp(float(np.abs(values).max()))[1]
    X = np.ldexp(np.asarray(values, np.float64), -exponent)
    layout = Tensorisation.of(X.shape, order=ORDERS[axes])
    if layout.ndim < 2:
        return None
    tensor = layout.forward(X if order is None else X[:, order])
    goal = math.ldexp(target.frobenius, -exponent)
    found = tt_svd(tensor, absolute=TRUNCATION * goal)
    if found.train.parameters > MOST_PARAMETERS * X.size:
        return None
    # Padding repeats entries, so that the tensor's errors are a little more numerous.
    rest = math.sqrt(max(goal**2 - found.truncation**2, 0.0) * tensor.size / X.size)
    train = _Train(found.train.cores, found.pivot)
    code = train.search(rest)
    return None if code is None else code.pack(axes, exponent)


def decode(
    source: Bytes,
    shape: tuple[int, int, int],
    order: NDArray | None,
    steps: NDArray,
    bodies: NDArray,
) -> NDArray[np.float64]:
    """Values (T', n', w) of the steps and bodies with these indices, of a block (T, n, w)."""
    _, n, width = shape
    axes = source.take(1)[0]
    if axes >= len(ORDERS):
        raise ValueError(f"coded block: of no known order of axes ({axes})")
    layout = Tensorisation.of(shape, order=ORDERS[axes])
    exponent = source.signed(1100)
    cores = _read_cores(source, layout.shape)
    if order is not None:
        place = np.empty(n, np.int64)
        place[order] = np.arange(n)
        bodies = place[bodies]
    zero = np.zeros(len(bodies), np.int64)
    # Levels of bodies stand on one side of the train, time and components on the other.
    split = layout.dimensions("bodies")
    first = split.start == 0
    cut = split.stop if first else split.start
    entries = layout.locate(zero, bodies, zero)
    component = np.tile(np.arange(width), len(steps))
    step = np.repeat(steps, width)
    times = layout.locate(step, np.zeros_like(step), component)
    left, right = (entries, times) if first else (times, entries)
    mirrored = [np.ascontiguousarray(core.transpose(2, 1, 0)) for core in cores[cut:][::-1]]
    left = _expand(cores[:cut], left[:, :cut])
    right = _expand(mirrored, right[:, cut:][:, ::-1])
    rows, columns = (left, right) if first else (right, left)
    y = kernels.multiply(rows, np.ascontiguousarray(columns.T))
    y = y.reshape(len(bodies), len(steps), width).transpose(1, 0, 2)
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(np.ascontiguousarray(y), exponent)


def _expand(cores: list[NDArray], digits: NDArray) -> NDArray:
    """Products of the cores at these digits (m, number of cores): (m, r), common beginnings once.

    Raises ValueError where the cores' bonds do not fit.
    """
    rows, known = np.ones((1, 1)), np.zeros(len(digits), np.int64)
    for core, digit in zip(cores, np.ascontiguousarray(digits.T), strict=True):
        keys, known = np.unique(known * core.shape[1] + digit, return_inverse=True)
        known = known.reshape(-1)
        parent, last = np.divmod(keys, core.shape[1])
        rows = kernels.extend(rows, parent, last, core)
    return rows[known]


class _Train:
    """Cores in units of what their errors count for."""

    def __init__(self, cores: tuple[NDArray, ...], pivot: int) -> None:
        self.pivot = pivot
        self.cores = [np.asarray(core, np.float64) for core in cores]
        self.sigmas: list[NDArray | None] = [None] * len(cores)
        P = np.ones((1, 1))
        for k in range(len(cores) - 1, pivot, -1):
            P = np.einsum("anb,bc,dnc->ad", self.cores[k], P, self.cores[k], optimize=True)
        for k in range(pivot, 0, -1):
            P = np.einsum("anb,bc,dnc->ad", self.cores[k], P, self.cores[k], optimize=True)
            self.sigmas[k - 1] = np.sqrt(np.maximum(np.diag(P), 0.0))
        P = np.ones((1, 1))
        for k in range(pivot):
            P = np.einsum("anb,ac,cnd->bd", self.cores[k], P, self.cores[k], optimize=True)
        for k in range(pivot, len(cores) - 1):
            P = np.einsum("anb,ac,cnd->bd", self.cores[k], P, self.cores[k], optimize=True)
            self.sigmas[k + 1] = np.sqrt(np.maximum(np.diag(P), 0.0))

    def search(self, goal: float) -> _Code | None:
        """The code of the largest step tried whose error is below the goal."""
        entries = sum(core.size for core in self.cores)
        trial, best = Seeker(goal * math.sqrt(6.0 / entries)), None
        for _ in range(PASSES):
            code = self.code(trial.step)
            if code is None:
                break
            excess = code.error / goal
            if excess <= MET and (best is None or code.step > best.step):
                best = code
            if trial.learn(excess):
                break
        return best

    def code(self, step: int) -> _Code | None:
        """Round all cores with a step, dropping what is left of bonds that vanish."""
        size = step_size(step)
        coded: dict[int, _Core] = {}
        square = 0.0
        ends = {}
        for forward in (True, False):
            kept = np.arange(1)
            numbers = range(self.pivot) if forward else range(len(self.cores) - 1, self.pivot, -1)
            for k in numbers:
                core = self.cores[k] if forward else self.cores[k].transpose(2, 1, 0)
                exponents = np.rint(4.0 * np.log2(np.maximum(self.sigmas[k], 1e-30) / size))
                scale = _power(exponents)
                x = _transformed(core[kept], polynomials(core.shape[1]).T)
                x = x.reshape(-1, core.shape[2]) * scale
                stays = np.abs(x).max(axis=0) >= DROPPED
                stays[0] |= not stays.any()
                square += float(np.square(x[:, ~stays]).sum())
                kept = np.flatnonzero(stays)
                rounded = round_matrix(x[:, kept], PRICE)
                if rounded is None:
                    return None
                square += rounded.error**2
                coded[k] = _Core(rounded, exponents[kept].astype(np.int64))
            ends[forward] = kept
        pivot = self.cores[self.pivot][ends[True]][:, :, ends[False]]
        pivot = _transformed(pivot, polynomials(pivot.shape[1]).T)
        rounded = round_matrix(pivot.reshape(-1, pivot.shape[2]) / size, PRICE)
        if rounded is None:
            return None
        square += rounded.error**2
        coded[self.pivot] = _Core(rounded, np.zeros(0, np.int64))
        cores = [coded[k] for k in range(len(self.cores))]
        return _Code(step, self.pivot, cores, size * math.sqrt(square))


def _transformed(core: NDArray, matrix: NDArray) -> NDArray:
    """core (r, n, s) with sums over i of core[:, i] matrix[i, j] at [:, j], in the order of i.

    Cores change little from entry to entry where the field is smooth: as coefficients of
    polynomials (of two entries: their sum and difference) most are near zero.
    """
    out = np.zeros_like(core)
    for i, row in enumerate(matrix):
        out += core[:, i, None, :] * row[:, None]
    return out


def _power(exponents: NDArray) -> NDArray:
    """2^(exponents / 4), the same bits on every machine."""
    octave, quarter = np.divmod(exponents.astype(np.int64), 4)
    return np.ldexp(np.array(QUARTERS)[quarter], octave.astype(np.int32))


def _read_cores(source: Bytes, shape: tuple[int, ...]) -> list[NDArray]:
    """The cores (r, n, s) that `_Code.pack` wrote."""
    size = step_size(int.from_bytes(source.take(2), "little"))
    pivot = source.number(len(shape) - 1)
    columns = [source.number(1 << 20) for _ in shape]
    if columns[pivot] != (columns[pivot + 1] if pivot + 1 < len(shape) else 1):
        raise ValueError("coded block: ranks do not fit together")
    bonds = [columns[k] for k in range(len(shape)) if k != pivot]
    differences, used = decode_integers(source.peek(), limit=sum(bonds))
    source.take(used)
    if len(differences) != sum(bonds):
        raise ValueError("coded block: too few weights")
    shifts = shift_values(tuple(np.frombuffer(source.take(2), np.int8)))
    exponents = iter(np.split(differences, np.cumsum(bonds)[:-1]))
    cores = []
    for k, n in enumerate(shape):
        if k <= pivot:
            before = columns[k - 1] if k else 1
        else:
            before = columns[k + 1] if k + 1 < len(shape) else 1
        if before * n * columns[k] > 1 << 31:
            raise ValueError("coded block: a core is too large")
        data = source.take(source.number(1 << 40))
        q = unround(data, before * n, columns[k])
        v = np.abs(q)
        matrix = np.sign(q) * (v - np.where(v == 1, shifts[0], shifts[1]))
        if k == pivot:
            matrix = matrix * size
        else:
            power = np.cumsum(next(exponents))
            if np.abs(power).max(initial=0) > 4000:
                raise ValueError("coded block: a weight is out of range")
            matrix = matrix / _power(power)
        core = _transformed(matrix.reshape(before, n, columns[k]), polynomials(n))
        cores.append(np.ascontiguousarray(core if k <= pivot else core.transpose(2, 1, 0)))
    if source.rest():
        raise ValueError("coded block: is longer than its cores")
    return cores
