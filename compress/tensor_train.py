"""Tensors in the tensor-train format, and their algebra without expanding them.

X(i_1, ..., i_d) = X_1(i_1) X_2(i_2) ... X_d(i_d), with X_k(i) a matrix r_{k-1} x r_k and
r_0 = r_d = 1 (I. V. Oseledets, SIAM J. Sci. Comput. 33, 2011; S. De, PhD thesis, University of
Michigan 2021, chapter 4, cited below as D).

Results of +, -, * and of joining have the ranks that the algebra gives them, which are in general
too large: `compress.rounding.round_train` brings them down.

Symbols: d dimensions; n_k length of dimension k; r_k ranks; G Gram matrix of the left cores.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

DTYPES = (np.dtype(np.float32), np.dtype(np.float64))
# Largest binary exponent of a factor, either way, before it is scaled: products of two such
# factors neither overflow nor lose digits, and ordinary data are never touched.
_EXPONENT_LIMIT = {np.dtype(np.float32): 24, np.dtype(np.float64): 200}
_ENTRIES_AT_ONCE = 1 << 20  # numbers in the matrices gathered for a block of entries


@dataclass(frozen=True, eq=False, repr=False)
class TensorTrain:
    """A tensor n_1 x ... x n_d in the tensor-train format.

    cores : d arrays (r_{k-1}, n_k, r_k), all float32 or all float64, r_0 = r_d = 1. They are kept
    C-contiguous and read-only (copied unless they are so already).

    Dimensions of length 0 are allowed; ranks are at least 1.

    Raises ValueError, naming the core, for cores that do not fit together or are not finite.
    """

    cores: tuple[NDArray, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "cores", tuple(_frozen(core) for core in self.cores))
        _check(self.cores)

    def __reduce__(self) -> tuple:
        return TensorTrain, (self.cores,)

    def __repr__(self) -> str:
        ranks = "-".join(str(rank) for rank in self.ranks)
        return f"TensorTrain(shape={self.shape}, ranks={ranks}, dtype={self.dtype})"

    # ---- what it is ------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_1, ..., n_d)."""
        return tuple(core.shape[1] for core in self.cores)

    @property
    def ranks(self) -> tuple[int, ...]:
        """(r_0, ..., r_d), ones at both ends."""
        return (1, *(core.shape[2] for core in self.cores))

    @property
    def dtype(self) -> np.dtype:
        """float32 or float64."""
        return self.cores[0].dtype

    @property
    def ndim(self) -> int:
        """d."""
        return len(self.cores)

    @property
    def size(self) -> int:
        """Number of entries of the tensor (an int without bound)."""
        return math.prod(self.shape)

    @property
    def parameters(self) -> int:
        """Numbers in the cores: the sum of r_{k-1} n_k r_k."""
        return sum(core.size for core in self.cores)

    @property
    def compression_ratio(self) -> float:
        """Entries by parameters (D 4.30)."""
        return self.size / self.parameters if self.parameters else 1.0

    def astype(self, dtype: DTypeLike) -> TensorTrain:
        """The same tensor in the other precision."""
        return self if self.dtype == dtype else _train(c.astype(dtype) for c in self.cores)

    # ---- algebra ---------------------------------------------------------------------------

    def norm(self) -> float:
        """||X||_F, by orthogonalisation: small differences of large tensors keep their digits.

        Infinity if it exceeds the range of float64.
        """
        return _from_scaled(*scaled_norm(self.cores))

    def dot(self, other: TensorTrain) -> float:
        """The sum of the products of entries.

        Raises ValueError for another shape.
        """
        _check_same_shape(self, other)
        product, exponent = np.ones((1, 1)), 0
        for a, b in zip(self.cores, other.cores, strict=True):
            # P_k = sum_i A_k(i)^T P_{k-1} B_k(i)
            a, a_exponent = normalized(a.astype(np.float64, copy=False))
            b, b_exponent = normalized(b.astype(np.float64, copy=False))
            left = np.tensordot(product, b, axes=(1, 0))
            product, p_exponent = normalized(np.tensordot(a, left, axes=((0, 1), (0, 1))))
            exponent += a_exponent + b_exponent + p_exponent
        return _from_scaled(float(product[0, 0]), exponent)

    def __add__(self, other: TensorTrain) -> TensorTrain:
        if not isinstance(other, TensorTrain):
            return NotImplemented
        return add((self, other))

    def __sub__(self, other: TensorTrain) -> TensorTrain:
        if not isinstance(other, TensorTrain):
            return NotImplemented
        return add((self, -other))

    def __neg__(self) -> TensorTrain:
        return _train((-self.cores[0], *self.cores[1:]))

    def __mul__(self, other: TensorTrain | float) -> TensorTrain:
        """Entry by entry with a tensor of the same shape (ranks multiply), or with a number."""
        if isinstance(other, TensorTrain):
            return _hadamard(self, other)
        if isinstance(other, Real):
            return _times(self, float(other))
        return NotImplemented

    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> TensorTrain:
        if not isinstance(divisor, Real):
            return NotImplemented
        factor, exponent = math.frexp(float(divisor))
        return _times(scaled(self, -exponent), 1.0 / factor)

    # ---- entries ---------------------------------------------------------------------------

    def entry(self, index: Sequence[int]) -> float:
        """X(i_1, ..., i_d); indices may count from the end. Raises IndexError outside."""
        return float(self.entries(np.asarray(index).reshape(1, -1))[0])

    def entries(self, indices: ArrayLike) -> NDArray:
        """The entries at `indices` (m, d): m values, at a cost of m d r^2.

        Raises IndexError for an index outside, ValueError for another number of columns.
        """
        indices = np.asarray(indices)
        if indices.ndim != 2 or indices.shape[1] != self.ndim:
            raise ValueError(f"indices {indices.shape}: must be (m, {self.ndim})")
        columns = [_checked(indices[:, k], n, k) for k, n in enumerate(self.shape)]
        values = np.empty(indices.shape[0], dtype=self.dtype)
        block = max(1, _ENTRIES_AT_ONCE // max(a * b for a, b in pairwise(self.ranks)))
        for start in range(0, values.size, block):
            rows = slice(start, start + block)
            product = np.ones((values[rows].size, 1, 1), dtype=self.dtype)
            exponent = 0
            for core, column in zip(self.cores, columns, strict=True):
                matrices, shift = _tamed(core.transpose(1, 0, 2)[column[rows]])
                product, more = _tamed(product @ matrices)
                exponent += shift + more
            values[rows] = np.ldexp(product[:, 0, 0], exponent)
        return values

    def __getitem__(self, key: object) -> TensorTrain | float:
        """A sub-tensor, or one entry where an integer is given for each dimension.

        Per dimension an integer (the dimension vanishes), a slice, or a 1-D array of integers or
        of flags; each acts on its own dimension alone, as with `numpy.ix_`. An ellipsis stands
        for whole dimensions, as do dimensions left out. Nothing is expanded.
        """
        chosen = _per_dimension(key, self.ndim)
        if all(isinstance(picked, int) for picked in chosen):
            return self.entry(chosen)
        cores: list[NDArray] = []
        pending: NDArray | None = None  # product of the matrices picked since the last kept core
        for k, (core, picked) in enumerate(zip(self.cores, chosen, strict=True)):
            if isinstance(picked, int):
                matrix = core[:, _checked(np.array([picked]), core.shape[1], k)[0]]
                pending = matrix if pending is None else pending @ matrix
                continue
            if not isinstance(picked, slice):
                picked = _checked(picked, core.shape[1], k)
            kept = core[:, picked]
            cores.append(kept if pending is None else np.tensordot(pending, kept, axes=(1, 0)))
            pending = None
        if pending is not None:
            cores[-1] = cores[-1] @ pending
        return _train(cores)

    def full(self) -> NDArray:
        """The array (n_1, ..., n_d) of all entries.

        The cores are multiplied from both ends towards the dimension for which that takes the
        fewest multiplications; sub-tensors, `train[...].full()`, expand what they hold only.
        """
        if self.ndim == 1:
            return self.cores[0].reshape(-1).copy()
        split = _cheapest_split(self.shape, self.ranks)
        left, left_exponent = _expand_left(self.cores[:split])
        right, right_exponent = _expand_right(self.cores[split:])
        values = (left @ right).reshape(self.shape)
        exponent = left_exponent + right_exponent
        return np.ldexp(values, exponent) if exponent else values


# ---- making ----------------------------------------------------------------------------------


def zeros(shape: Sequence[int], dtype: DTypeLike = np.float64) -> TensorTrain:
    """The zero tensor, all ranks 1."""
    return _train(np.zeros((1, n, 1), dtype=dtype) for n in shape)


def random(
    shape: Sequence[int],
    ranks: int | Sequence[int],
    generator: np.random.Generator,
    dtype: DTypeLike = np.float64,
) -> TensorTrain:
    """A tensor with normally distributed cores and entries of variance 1.

    ranks : of the d - 1 inner bonds, or one number for all.
    """
    inner = [ranks] * (len(shape) - 1) if isinstance(ranks, int) else list(ranks)
    bonds = [1, *inner, 1]
    return _train(
        (generator.standard_normal((left, n, right)) / math.sqrt(left)).astype(dtype)
        for (left, right), n in zip(pairwise(bonds), shape, strict=True)
    )


# ---- joining ---------------------------------------------------------------------------------


def add(trains: Sequence[TensorTrain]) -> TensorTrain:
    """The sum of tensors of one shape; ranks add up."""
    first = _first(trains)
    for train in trains[1:]:
        _check_same_shape(first, train)
    if first.ndim == 1:
        return _train([sum(train.cores[0] for train in trains)])
    last = first.ndim - 1
    return _train(
        _block_diagonal([t.cores[k] for t in trains], k == 0, k == last) for k in range(first.ndim)
    )


def concatenate(trains: Sequence[TensorTrain], axis: int = 0) -> TensorTrain:
    """Tensors joined along a dimension that they have (D algorithm 4.3, of any number of parts).

    Ranks add up, and no digit changes. Raises ValueError for parts that differ in another
    dimension.
    """
    first = _first(trains)
    axis = _axis(axis, first.ndim)
    for part, train in enumerate(trains):
        if _without(train.shape, axis) != _without(first.shape, axis):
            raise ValueError(
                f"part {part} of shape {train.shape}: must be {first.shape} but in dimension {axis}"
            )
    last = first.ndim - 1
    return _train(
        _block_diagonal([t.cores[k] for t in trains], k == 0, k == last, side_by_side=k == axis)
        for k in range(first.ndim)
    )


def stack(trains: Sequence[TensorTrain], axis: int = -1) -> TensorTrain:
    """Tensors of one shape joined along a new dimension (D algorithm 4.4, of any number of parts).

    The new dimension becomes number `axis` of the d + 1; ranks add up, and no digit changes.
    """
    return concatenate([expand_dims(train, axis) for train in trains], axis)


def expand_dims(train: TensorTrain, axis: int) -> TensorTrain:
    """The same entries with a dimension of length 1 inserted as number `axis`."""
    axis = _axis(axis, train.ndim + 1)
    rank = train.ranks[axis]
    identity = np.eye(rank, dtype=train.dtype).reshape(rank, 1, rank)
    return _train((*train.cores[:axis], identity, *train.cores[axis:]))


def _block_diagonal(
    blocks: Sequence[NDArray], first: bool, last: bool, side_by_side: bool = False
) -> NDArray:
    """The core of joined tensors: blocks along the diagonal of each matrix.

    They share their rows in the first core (D 4.23), their columns in the last (D 4.25), and lie
    behind each other, each with its own indices, in the dimension along which tensors are joined.
    """
    rows, columns = (
        [0 if first else b.shape[0] for b in blocks],
        [0 if last else b.shape[2] for b in blocks],
    )
    lengths = [b.shape[1] if side_by_side else 0 for b in blocks]
    row, column, start = (list(accumulate(sizes, initial=0)) for sizes in (rows, columns, lengths))
    shape = (row[-1] or 1, start[-1] if side_by_side else blocks[0].shape[1], column[-1] or 1)
    core = np.zeros(shape, dtype=np.result_type(*blocks))
    for block, r, i, c in zip(blocks, row, start, column, strict=False):
        core[r : r + block.shape[0], i : i + block.shape[1], c : c + block.shape[2]] = block
    return core


def _hadamard(a: TensorTrain, b: TensorTrain) -> TensorTrain:
    """Entry by entry: each matrix is the Kronecker product of two."""
    _check_same_shape(a, b)
    cores, exponent = [], 0
    for x, y in zip(a.cores, b.cores, strict=True):
        x, x_exponent = normalized(x)
        y, y_exponent = normalized(y)
        product = np.einsum("inj,knl->iknjl", x, y)
        ranks = x.shape[0] * y.shape[0], x.shape[2] * y.shape[2]
        cores.append(product.reshape(ranks[0], x.shape[1], ranks[1]))
        exponent += x_exponent + y_exponent
    return scaled(_train(cores), exponent)


def _times(train: TensorTrain, factor: float) -> TensorTrain:
    """`factor` goes into the core which it brings closest to 1, so that none leaves the range."""
    if factor == 0.0:
        return zeros(train.shape, train.dtype)
    mantissa, exponent = math.frexp(factor)
    exponents = [_exponent(core) for core in train.cores]
    chosen = min(range(train.ndim), key=lambda k: abs(exponents[k] + exponent))
    cores = list(train.cores)
    # In this order neither step leaves the range where the result does not.
    cores[chosen] = np.ldexp(cores[chosen] * train.dtype.type(mantissa), exponent)
    return _train(cores)


# ---- scale -----------------------------------------------------------------------------------
# Factors are kept near 1 by powers of two, which change no digit; exponents are summed apart.


def normalized(values: NDArray) -> tuple[NDArray, int]:
    """(Y, e) with values = 2^e Y and 1/2 <= max |Y| < 1; zeros have e = 0."""
    exponent = _exponent(values)
    return (np.ldexp(values, -exponent), exponent) if exponent else (values, 0)


def scaled(train: TensorTrain, exponent: int) -> TensorTrain:
    """2^exponent X, digit by digit.

    The power goes into the last core if that stays clear of the ends of the range, and is spread
    over all cores if not.
    """
    if exponent == 0:
        return train
    limit = np.finfo(train.dtype).maxexp - 8
    cores = list(train.cores)
    if abs(_exponent(cores[-1]) + exponent) <= limit:
        cores[-1] = np.ldexp(cores[-1], exponent)
        return _train(cores)
    total = exponent + sum(_exponent(core) for core in cores)
    shares = [total // len(cores) + (k < total % len(cores)) for k in range(len(cores))]
    return _train(
        np.ldexp(core, share - _exponent(core)) for core, share in zip(cores, shares, strict=True)
    )


def scaled_norm(cores: Sequence[NDArray]) -> tuple[float, int]:
    """(m, e) with ||X||_F = m 2^e: the norm of a train of any size."""
    right, exponent = np.ones((1, 1)), 0
    for core in reversed(cores):
        core, shift = normalized(core.astype(np.float64, copy=False))
        matrix, more = normalized((core @ right).reshape(core.shape[0], -1))
        exponent += shift + more
        right = _triangle(matrix)
    return float(np.linalg.norm(right)), exponent


def _triangle(matrix: NDArray) -> NDArray:
    """L (m, m') of matrix = L Q; a matrix without columns has one of zeros."""
    if matrix.shape[1] == 0:
        return np.zeros((matrix.shape[0], 1))
    return np.linalg.qr(matrix.T, mode="r").T


def _exponent(values: NDArray) -> int:
    largest = max(float(values.max(initial=0.0)), -float(values.min(initial=0.0)))
    return math.frexp(largest)[1]


def _from_scaled(mantissa: float, exponent: int) -> float:
    try:
        return math.ldexp(mantissa, exponent)
    except OverflowError:
        return math.copysign(math.inf, mantissa)


def _tamed(values: NDArray) -> tuple[NDArray, int]:
    """As `normalized`, but left alone unless the exponent is far from 0."""
    exponent = _exponent(values)
    if abs(exponent) <= _EXPONENT_LIMIT[values.dtype]:
        return values, 0
    return np.ldexp(values, -exponent), exponent


# ---- expansion -------------------------------------------------------------------------------


def _cheapest_split(shape: Sequence[int], ranks: Sequence[int]) -> int:
    """Number of cores to multiply from the left; the others are multiplied from the right."""
    d = len(shape)
    left = [0, 0]  # multiplications for the first k cores
    for k in range(1, d):
        left.append(left[-1] + math.prod(shape[: k + 1]) * ranks[k] * ranks[k + 1])
    right = [0, 0]  # and for the last k
    for k in range(1, d):
        right.append(right[-1] + math.prod(shape[d - k - 1 :]) * ranks[d - k] * ranks[d - k - 1])
    whole = math.prod(shape)
    return min(range(1, d), key=lambda k: left[k] + right[d - k] + whole * ranks[k])


def _expand_left(cores: Sequence[NDArray]) -> tuple[NDArray, int]:
    """Cores multiplied from the left: (n_1 ... n_k, r_k), over a power of two."""
    product, exponent = _tamed(cores[0].reshape(-1, cores[0].shape[2]))
    for core in cores[1:]:
        core, shift = _tamed(core)
        product, more = _tamed(
            (product @ core.reshape(core.shape[0], -1)).reshape(-1, core.shape[2])
        )
        exponent += shift + more
    return product, exponent


def _expand_right(cores: Sequence[NDArray]) -> tuple[NDArray, int]:
    """Cores multiplied from the right: (r_k, n_{k+1} ... n_d), over a power of two."""
    product, exponent = _tamed(cores[-1].reshape(cores[-1].shape[0], -1))
    for core in reversed(cores[:-1]):
        core, shift = _tamed(core)
        product, more = _tamed(
            (core.reshape(-1, core.shape[2]) @ product).reshape(core.shape[0], -1)
        )
        exponent += shift + more
    return product, exponent


# ---- checks ----------------------------------------------------------------------------------


def _train(cores: Iterable[NDArray]) -> TensorTrain:
    """A train of arrays that nobody else will write to, without a copy."""
    own = [np.ascontiguousarray(core) for core in cores]
    for core in own:
        core.setflags(write=False)
    return TensorTrain(tuple(own))


def _frozen(core: ArrayLike) -> NDArray:
    core = np.asarray(core)
    if core.flags.c_contiguous and not core.flags.writeable:
        return core
    core = np.array(core, order="C")
    core.setflags(write=False)
    return core


def _check(cores: Sequence[NDArray]) -> None:
    if not cores:
        raise ValueError("a tensor train needs at least one core")
    rank = 1
    for k, core in enumerate(cores):
        if core.ndim != 3:
            raise ValueError(f"core {k} of shape {core.shape}: must have three dimensions")
        if core.dtype not in DTYPES:
            raise ValueError(f"core {k} of {core.dtype}: must be float32 or float64")
        if core.dtype != cores[0].dtype:
            raise ValueError(f"core {k} of {core.dtype}: must be {cores[0].dtype} as core 0")
        if core.shape[0] != rank:
            raise ValueError(f"core {k} of shape {core.shape}: first rank must be {rank}")
        rank = core.shape[2]
        if rank < 1:
            raise ValueError(f"core {k} of shape {core.shape}: ranks must be at least 1")
        if not np.isfinite(core).all():
            raise ValueError(f"core {k}: holds numbers that are not finite")
    if rank != 1:
        raise ValueError(f"core {len(cores) - 1} of shape {cores[-1].shape}: last rank must be 1")


def _first(trains: Sequence[TensorTrain]) -> TensorTrain:
    if not trains:
        raise ValueError("no tensor train to join")
    return trains[0]


def _check_same_shape(a: TensorTrain, b: TensorTrain) -> None:
    if a.shape != b.shape:
        raise ValueError(f"tensors of shapes {a.shape} and {b.shape}: must be equal")


def _axis(axis: int, ndim: int) -> int:
    if not -ndim <= axis < ndim:
        raise ValueError(f"axis {axis}: must lie in {-ndim} ... {ndim - 1}")
    return axis % ndim


def _without(shape: tuple[int, ...], axis: int) -> tuple[int, ...] | None:
    """The lengths of the other dimensions; None if there is no such dimension."""
    return (len(shape), *shape[:axis], *shape[axis + 1 :])


def _per_dimension(key: object, ndim: int) -> list[int | slice | NDArray]:
    """What `key` picks of each dimension."""
    parts = list(key) if isinstance(key, tuple) else [key]
    dots = [k for k, part in enumerate(parts) if part is Ellipsis] or [len(parts)]
    given = sum(part is not Ellipsis for part in parts)
    if len(dots) > 1 or given > ndim:
        raise IndexError(f"{given} indices for a tensor of {ndim} dimensions")
    parts[dots[0] : dots[0] + 1] = [slice(None)] * (ndim - given)
    return [part if isinstance(part, slice) else _index(part) for part in parts]


def _index(part: object) -> int | NDArray:
    array = np.asarray(part)
    return operator.index(array.item()) if array.ndim == 0 else array


def _checked(index: NDArray, length: int, dimension: int) -> NDArray:
    """Indices (m,) of a dimension counted from its start; flags become indices."""
    if index.dtype == bool:
        if index.shape != (length,):
            raise IndexError(f"flags {index.shape} for dimension {dimension} of length {length}")
        return np.flatnonzero(index)
    if index.size == 0:
        return np.zeros(0, dtype=np.intp)
    if index.ndim != 1 or index.dtype.kind not in "iu":
        raise IndexError(f"index of dimension {dimension}: must be integers in one dimension")
    outside = (index < -length) | (index >= length)
    if outside.any():
        raise IndexError(
            f"index {index[outside][0]} is outside dimension {dimension} of length {length}"
        )
    return np.where(index < 0, index + length, index)
