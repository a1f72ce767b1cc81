"""How an array of steps, bodies and components becomes a tensor of many small dimensions, and back.

Bodies come in Morton order, so that the levels of their index are levels of an octree; steps and
bodies are split into such levels, coarsest first (S. De, PhD thesis, University of Michigan 2021,
sections 4.2 and 4.4.2; its eq. 4.18 holds in the form i = sum_{k<l} 2^{d-k} (i_k - 1) + i_l).

Symbols: T steps, n bodies, w components, d dimensions of the tensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi import morton

Axis = Literal["steps", "bodies", "components"]
AXES: tuple[Axis, Axis, Axis] = ("steps", "bodies", "components")
THESIS_ORDER: tuple[Axis, Axis, Axis] = ("bodies", "steps", "components")

Form = Literal["matrix", "natural", "tensorised"]

# Squaring loses half of the digits: below this the singular values themselves are needed.
_GRAM_FLOOR = 1e-6


def levels(length: int, largest: int = 5) -> tuple[int, ...]:
    """Factors of the smallest number >= `length` that has no prime factor above `largest`.

    Largest first; none for a length of 1. With 2, 3 and 5 the cover of a length above 100 is at
    most 11 % longer, above 10,000 at most 5 %; with 2 alone it may be twice as long.
    Raises ValueError for a length below 1 and for `largest` other than 2, 3 or 5.
    """
    if length < 1:
        raise ValueError(f"length {length}: must be at least 1")
    if largest not in (2, 3, 5):
        raise ValueError(f"largest factor {largest}: must be 2, 3 or 5")
    fives = range(_power_covering(length, 5) + 1) if largest >= 5 else (0,)
    threes = range(_power_covering(length, 3) + 1) if largest >= 3 else (0,)
    best = (1 << _power_covering(length, 2), 0, 0)
    for five in fives:
        for three in threes:
            odd = 5**five * 3**three
            cover = odd << _power_covering(-(-length // odd), 2)
            best = min(best, (cover, three, five))
    cover, three, five = best
    twos = (cover // (5**five * 3**three)).bit_length() - 1
    return (5,) * five + (3,) * three + (2,) * twos


def _power_covering(length: int, base: int) -> int:
    """The least k with base^k >= length."""
    k, power = 0, 1
    while power < length:
        k, power = k + 1, power * base
    return k


@dataclass(frozen=True)
class Tensorisation:
    """Which entry of a tensor is which entry of an array of shape (T, n, w).

    lengths  : (T, n, w)
    levels   : per axis of the array, the factors it is split into, coarsest first. Their product
               is at least the length; the entries beyond it repeat the last ones
    order    : the axes as they follow one another in the tensor
    joined   : whether the last two axes of `order` are one dimension

    Repeated entries add nothing to the error: that of `backward(Y)` against an array X is at most
    that of Y against `forward(X)`.
    """

    lengths: tuple[int, int, int]
    levels: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]
    order: tuple[Axis, Axis, Axis] = THESIS_ORDER
    joined: bool = False

    def __post_init__(self) -> None:
        if sorted(self.order) != sorted(AXES):
            raise ValueError(f"order {self.order}: must have each of {', '.join(AXES)} once")
        for axis, length, factors in zip(AXES, self.lengths, self.levels, strict=True):
            if length < 1:
                raise ValueError(f"{axis}: {length}, must be at least 1")
            if min(factors, default=1) < 1 or math.prod(factors) < length:
                raise ValueError(f"{axis}: levels {factors} do not cover {length}")

    @classmethod
    def of(
        cls,
        lengths: Sequence[int],
        form: Form = "tensorised",
        order: Sequence[Axis] = THESIS_ORDER,
        largest: int = 5,
    ) -> Tensorisation:
        """A usual one for arrays of shape (T, n, w) = `lengths`.

        matrix     : two dimensions, the first axis of `order` by the other two
        natural    : three dimensions, one for each axis
        tensorised : steps and bodies in levels (see `levels`), components in one dimension
        """
        steps, bodies, components = (int(length) for length in lengths)
        if form == "tensorised":
            split = (levels(steps, largest), levels(bodies, largest), (components,))
        elif form in ("natural", "matrix"):
            split = ((steps,), (bodies,), (components,))
        else:
            raise ValueError(f"form {form!r}: must be matrix, natural or tensorised")
        lengths = (steps, bodies, components)
        return cls(lengths, split, tuple(order), joined=form == "matrix")

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the tensor."""
        if self.joined:
            first, *others = self._covers_in_order()
            return (first, math.prod(others))
        return tuple(n for axis in self.order for n in self.levels[AXES.index(axis)]) or (1,)

    @property
    def ndim(self) -> int:
        """Number of dimensions of the tensor."""
        return len(self.shape)

    def dimensions(self, axis: Axis) -> slice:
        """Which dimensions of the tensor an axis of the array went to."""
        if self.joined:
            return slice(0, 1) if axis == self.order[0] else slice(1, 2)
        before = self.order[: self.order.index(axis)]
        first = sum(len(self.levels[AXES.index(other)]) for other in before)
        return slice(first, first + len(self.levels[AXES.index(axis)]))

    def forward(self, values: NDArray) -> NDArray:
        """The tensor of an array (T, n, w), contiguous; a view where nothing has to move."""
        if values.shape != self.lengths:
            raise ValueError(f"array of shape {values.shape}: must be {self.lengths}")
        tensor = np.transpose(values, self._axes())
        covers = self._covers_in_order()
        if tensor.shape != covers:
            beyond = [(0, n - m) for n, m in zip(covers, tensor.shape, strict=True)]
            tensor = np.pad(tensor, beyond, mode="edge")
        return np.ascontiguousarray(tensor).reshape(self.shape)

    def backward(self, tensor: NDArray) -> NDArray:
        """The array (T, n, w) of a tensor; what `forward` repeated is dropped."""
        if tensor.shape != self.shape:
            raise ValueError(f"tensor of shape {tensor.shape}: must be {self.shape}")
        array = tensor.reshape(self._covers_in_order())
        array = np.transpose(array, np.argsort(self._axes()))
        steps, bodies, components = self.lengths
        return np.ascontiguousarray(array[:steps, :bodies, :components])

    def digits(self, axis: Axis, index: ArrayLike) -> NDArray[np.int64]:
        """Indices (m, number of levels) in the levels of an axis, of entries (m,) along it."""
        number = AXES.index(axis)
        index = _checked(index, self.lengths[number], axis)
        factors = self.levels[number]
        if not factors:
            return np.empty((len(index), 0), np.int64)
        return np.stack(np.unravel_index(index, factors), axis=1).astype(np.int64, copy=False)

    def locate(self, step: ArrayLike, body: ArrayLike, component: ArrayLike) -> NDArray[np.int64]:
        """Indices (m, d) in the tensor of the entries (step, body, component), each (m,) or one.

        Raises ValueError for an entry outside of the array.
        """
        entry = np.broadcast_arrays(*(np.atleast_1d(part) for part in (step, body, component)))
        entry = [
            _checked(part, length, axis)
            for part, length, axis in zip(entry, self.lengths, AXES, strict=True)
        ]
        covers = self._covers_in_order()
        flat = np.ravel_multi_index([entry[axis] for axis in self._axes()], covers)
        return np.stack(np.unravel_index(flat, self.shape), axis=1).astype(np.int64, copy=False)

    def _axes(self) -> list[int]:
        return [AXES.index(axis) for axis in self.order]

    def _covers_in_order(self) -> tuple[int, ...]:
        return tuple(math.prod(self.levels[axis]) for axis in self._axes())


def _checked(index: ArrayLike, length: int, axis: Axis) -> NDArray[np.int64]:
    index = np.atleast_1d(index).astype(np.int64, copy=False)
    if index.size and not (index.min() >= 0 and index.max() < length):
        raise ValueError(f"{axis}: {index.min()} to {index.max()}, must be within 0 and {length}")
    return index


def morton_order(
    position: NDArray, origin: ArrayLike | None = None, edge: float | None = None
) -> NDArray[np.int32]:
    """The bodies (n,) in the order of their Morton keys; equal keys by number.

    position : (n, 3) [m]; origin (3,), edge : of the cube that is cut into cells, by default the
    smallest one around the bodies. Raises ValueError where a position is not finite.
    """
    if not np.isfinite(position).all():
        body = int(np.argmin(np.isfinite(position).all(axis=1)))
        raise ValueError(f"position of body {body} is not finite")
    if not len(position):
        return np.empty(0, np.int32)
    corner = position.min(axis=0) if origin is None else np.asarray(origin, dtype=np.float64)
    if edge is None:
        edge = float((position.max(axis=0) - corner).max()) or 1.0
    key = morton.encode(position, corner, edge)
    return np.argsort(key, kind="stable").astype(np.int32)


def unfolding_ranks(tensor: NDArray, tolerance: float) -> tuple[int, ...]:
    """Upper bounds (d - 1,) of the ranks of a tensor train that meets a relative tolerance.

    Bound k is the number of singular values of the unfolding n_1...n_k x n_{k+1}...n_d without
    the smallest ones, which together make ||X|| tolerance / sqrt(d - 1). Truncation at one
    dimension only lowers the singular values at others, so that TT-SVD stays below.
    """
    cuts = tensor.ndim - 1
    largest = float(np.abs(tensor).max(initial=0.0))
    if largest == 0.0:
        return (0,) * cuts
    scaled = tensor * math.ldexp(1.0, -math.frexp(largest)[1] // 2)
    scaled = scaled * (1.0 / float(np.abs(scaled).max()))
    ranks = []
    rows = 1
    for n in tensor.shape[:-1]:
        rows *= n
        square = _singular_values_squared(scaled.reshape(rows, -1), tolerance)
        tails = np.cumsum(square)
        allowed = tails[-1] * tolerance**2 / cuts
        ranks.append(int(np.count_nonzero(tails > allowed)))
    return tuple(ranks)


def _singular_values_squared(matrix: NDArray, tolerance: float) -> NDArray:
    """Ascending, all that are not 0 by shape."""
    if tolerance < _GRAM_FLOOR:
        return np.linalg.svd(matrix, compute_uv=False)[::-1].astype(np.float64) ** 2
    matrix = matrix.astype(np.float64, copy=False)
    gram = matrix.T @ matrix if matrix.shape[0] > matrix.shape[1] else matrix @ matrix.T
    return np.maximum(np.linalg.eigvalsh(gram), 0.0)


def train_parameters(shape: Sequence[int], ranks: Sequence[int]) -> int:
    """sum_k r_{k-1} n_k r_k of a tensor train with d - 1 inner ranks."""
    whole = (1, *ranks, 1)
    return sum(r * n * s for r, n, s in zip(whole, shape, whole[1:], strict=False))


def sample_bodies(values: NDArray, count: int, runs: int) -> NDArray:
    """At most `count` bodies of (T, n, w), in evenly spread runs of neighbours."""
    bodies = values.shape[1]
    if bodies <= count:
        return values
    length = max(count // runs, 1)
    starts = np.linspace(0, bodies - length, runs).astype(np.int64)
    chosen = (starts[:, None] + np.arange(length)).ravel()
    return values[:, chosen]
