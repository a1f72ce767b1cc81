"""TT-SVD: a tensor in the tensor-train format to a stated error.

Algorithm 4.1 of S. De (PhD thesis, University of Michigan 2021; I. V. Oseledets, SIAM J. Sci.
Comput. 33, 2011) with three liberties that keep its error bound. Each core comes from an orthogonal
projection of what the cores before have left, so that the squared errors add up whatever the order;
hence dimensions may be taken off either end. Several small dimensions are taken off at once: their
cores need of the whole tensor no more than a factor of the unfolding after the last of them, whence
one pass over the data instead of one a dimension. What error a bond leaves unused, the others have.

Symbols: X the tensor, n_1 x ... x n_d; Y the train; tau the relative tolerance; M (m, n) the
unfolding of what is left; U (m, r) its left singular vectors that are kept; M <- U'M.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compress.factors import (
    EPS,
    GRAM_FLOOR,
    Budget,
    Factor,
    gram_factor,
    gram_flops,
    qr_factor,
    qr_flops,
    split,
)
from compress.randomised import randomised_factor, randomised_flops
from compress.tensor_train import TensorTrain
from compress.unfolding import Side, Unfolding, survey

Method = Literal["auto", "gram", "qr", "randomised"]
Direction = Literal["auto", "left", "right"]
METHODS: tuple[Method, ...] = ("auto", "gram", "qr", "randomised")
DIRECTIONS: tuple[Direction, ...] = ("auto", "left", "right")

# A projection U'M is wrong by so many rounding units of ||M||, times k^(1/3) with k the shorter
# side of M: measured 9 ... 25 for k of 12 ... 400, whatever the spectrum, by either factorisation.
ROUNDING = 7.0
EXACT = 64.0  # multiples of the unit of the values within which a rank counts as exact

# Planning, by counted flops alone.
RANK = 32  # expected of a dimension before any is known
PASS = 64  # flops that reading and writing an entry once costs as much time as
LARGEST = 4096  # rows of an unfolding of several dimensions
QR_SLOWER = 2.0  # flops of a triangularisation take so much longer than those of a product

FLOPS: dict[str, Callable[[Unfolding, int], float]] = {
    "gram": lambda M, p: gram_flops(M.rows, M.columns),
    "qr": lambda M, p: qr_flops(M.rows, M.columns),
    "randomised": lambda M, p: randomised_flops(M.rows, M.columns, p),
}


@dataclass(frozen=True)
class Step:
    """Dimensions taken off at once.

    side : the end they were taken from; method : gram, qr or randomised; dimensions : how many;
    rows, columns : of the unfolding after the last of them; rank : what is left of the rows;
    flops : of the factor, counted
    """

    side: Side
    method: str
    dimensions: int
    rows: int
    columns: int
    rank: int
    flops: float


@dataclass(frozen=True)
class Decomposition:
    """A tensor train and how far it is from the tensor.

    train    : the dtype is that of the values (float64 but for float32)
    error    : ||X - Y||_F is at most this, rounding included but for that of expanding the cores
               [unit of the values]
    truncation : the part of it that comes from what was cut off
    norm     : ||X||_F
    allowed  : the error that was asked for; inf where only ranks were given
    pivot    : the core that is not orthonormal; those before it are from the left, those after it
               from the right
    steps    : in the order of the work
    """

    train: TensorTrain
    error: float
    truncation: float
    norm: float
    allowed: float
    pivot: int
    steps: tuple[Step, ...]

    @property
    def relative_error(self) -> float:
        """error / norm; 0 for a tensor of zeros."""
        return self.error / self.norm if self.norm > 0.0 else 0.0

    @property
    def met(self) -> bool:
        """Whether the error is what was asked for; a cap on ranks may prevent it."""
        return self.error <= self.allowed

    @property
    def pays(self) -> bool:
        """Whether the cores have fewer numbers than the tensor; those of white noise do not."""
        return self.train.parameters < math.prod(self.train.shape)

    @property
    def flops(self) -> float:
        """Counted, of the factors that the steps took."""
        return sum(step.flops for step in self.steps)


def tt_svd(
    values: ArrayLike,
    tolerance: float | None = None,
    max_ranks: int | Sequence[int] | None = None,
    absolute: float | None = None,
    method: Method = "auto",
    direction: Direction = "auto",
    seed: int = 0,
    carry: bool = True,
) -> Decomposition:
    """Decompose a tensor so that ||X - Y||_F <= tolerance ||X||_F, rounding included.

    values    : any shape but (), real and finite; float32 stays so, anything else becomes float64.
                Not copied if contiguous; the peak of memory besides is r/m of the tensor in
                float64 (the first rank over the rows of the first unfolding) twice over, and more
                only where an unfolding of a single long dimension is taller than wide.
    tolerance : relative; `absolute` instead is ||X - Y||_F [unit of the values]. With neither, and
                no max_ranks, ranks are exact: to EXACT rounding units of the values.
    max_ranks : a cap for all d - 1 inner ranks or one for each; the error that comes of it is
                reported, and not taken from what other bonds may lose.
    method    : "gram" squares the condition and is taken only where its floor of about 1e-7 lies
                well below the tolerance (else "qr" steps in); "qr" is good to rounding;
                "randomised" pays for long dimensions of small rank, and serves those alone;
                "auto" takes by counted flops.
    direction : "left" takes dimensions off the left end alone, as algorithm 4.1 does; "auto" off
                either, by cost.
    seed      : of the random matrices. The result depends on no clock and no number of threads.
    carry     : whether bonds have what others left of the error; not so in algorithm 4.1.

    Tolerances of some ten rounding units of the dtype cannot be guaranteed; `error`, an honest
    bound always, then says what came of it, and `met` that it is more than was asked for.

    Raises ValueError for values that are not finite, naming the first, and for bad options.
    """
    X = _checked(values)
    caps = _caps(max_ranks, X.shape)
    _check_options(tolerance, absolute, method, direction)
    seen = survey(X)
    if X.size == 0 or seen.largest == 0.0 or X.ndim == 1:
        return _trivial(X, seen.norm / seen.scale, tolerance, absolute)
    bonds = X.ndim - 1
    rounding = _rounding_expected(X.shape, X.dtype) * seen.norm
    if tolerance is None and absolute is None:
        cut = EXACT * float(np.finfo(X.dtype).eps) * seen.norm
        allowed = cut + rounding if max_ranks is None else math.inf
    else:
        allowed = min(
            absolute * seen.scale if tolerance is None else tolerance * seen.norm, seen.norm
        )
        cut = max(allowed - rounding, allowed / 2.0)
    budget = Budget(cut * cut, bonds, carry)
    sweep = _Sweep(X, seen.scale, seen.norm, caps, budget, method, direction, seed)
    while sweep.last > sweep.first:
        sweep.step()
    cores = sweep.finish()
    truncation = math.sqrt(sweep.lost)
    error = truncation + sweep.rounding() * seen.norm
    least = float(np.finfo(X.dtype).smallest_subnormal)  # what rounding the pivot may be down to
    return Decomposition(
        TensorTrain(tuple(cores)),
        error=error / seen.scale + (least / 2.0 * math.sqrt(cores[sweep.first].size)),
        truncation=truncation / seen.scale,
        norm=seen.norm / seen.scale,
        allowed=allowed / seen.scale,
        pivot=sweep.first,
        steps=tuple(sweep.steps),
    )


@dataclass(frozen=True)
class Peel:
    """A possible next step: so many dimensions off one end, and what it costs [flops]."""

    side: Side
    count: int
    rows: int
    columns: int
    cost: float


def plan(shape: Sequence[int], ranks: tuple[int, int], direction: Direction = "auto") -> Peel:
    """The cheapest next step for what is left: (ranks[0], *shape, ranks[1]).

    The cost of a step is taken over the part of the tensor it does away with, as if all to come
    were like it: c / (1 - r/m), with the rank on that side so far (RANK before there is any) as
    the one to expect.
    """
    size = ranks[0] * math.prod(shape) * ranks[1]
    sides: tuple[Side, ...] = ("left", "right") if direction == "auto" else (direction,)
    best: Peel | None = None
    for side in sides:
        near = ranks[0] if side == "left" else ranks[1]
        modes = shape if side == "left" else shape[::-1]
        expected, m = (near if near > 1 else RANK), near
        for count, n in enumerate(modes[:-1], 1):
            m *= n
            if count > 1 and (m > size // m or m > LARGEST):
                break
            peel = Peel(side, count, m, size // m, _cost(m, size // m, expected))
            if best is None or (peel.cost, -peel.rows) < (best.cost, -best.rows):
                best = peel
    assert best is not None
    return best


def _cost(m: int, n: int, expected: int) -> float:
    shorter, r = min(m, n), min(m, n, expected)
    if r >= m:
        return math.inf
    # A matrix with more rows than columns is turned by their eigenvectors, and then decomposed.
    tall = 8.0 * m * n * n if m > n else 0.0
    return ((shorter + PASS + 2.0 * r) * m * n + 10.0 * shorter**3 + tall) / (1.0 - r / m)


class _Sweep:
    """What is left of the tensor, and the cores that have been taken off its ends."""

    def __init__(
        self,
        X: NDArray,
        scale: float,
        norm: float,
        caps: Sequence[int],
        budget: Budget,
        method: Method,
        direction: Direction,
        seed: int,
    ) -> None:
        self.shape, self.dtype, self.caps = X.shape, X.dtype, caps
        self.values, self.scale, self.norm = X.reshape(-1), scale, norm
        self.budget, self.method, self.direction, self.seed = budget, method, direction, seed
        self.first, self.last = 0, X.ndim - 1
        self.rank = {"left": 1, "right": 1}
        self.left: list[NDArray] = []
        self.right: list[NDArray] = []
        self.applied = scale  # to be taken off again, if it ever was
        self.lost = 0.0
        self.projections = 0.0  # sum of k^(2/3)
        self.rounded = 0  # cores with digits to round
        self.steps: list[Step] = []

    def step(self) -> None:
        """Take the next dimensions off an end."""
        left = self.shape[self.first : self.last + 1]
        peel = plan(left, (self.rank["left"], self.rank["right"]), self.direction)
        layout = (peel.rows, peel.columns)
        M = Unfolding(
            self.values.reshape(layout if peel.side == "left" else layout[::-1]),
            peel.side,
            self.scale,
        )
        modes, caps = self._taken(peel)
        name, factor = self._factor(M, peel.count, caps[-1])
        flops = FLOPS[name](M, factor.L.shape[1])
        self.budget.lose(factor.missed)
        cores, U, lost = _split_side(
            factor.L, self.rank[peel.side], modes, caps, self.budget, peel.side
        )
        if U is None:  # nothing is lost, and nothing was missed
            self.budget.lose(-factor.missed)
        else:
            self.lost += factor.missed + lost
            self.values, self.scale = M.project(U).reshape(-1), 1.0
            self.projections += peel.count * min(peel.rows, peel.columns) ** (2.0 / 3.0)
            self.rounded += len(cores)
        if peel.side == "left":
            self.left += cores
            self.first += peel.count
            rank = cores[-1].shape[2]
        else:
            self.right += cores
            self.last -= peel.count
            rank = cores[-1].shape[0]
        self.rank[peel.side] = rank
        self.steps.append(Step(peel.side, name, peel.count, peel.rows, peel.columns, rank, flops))

    def _taken(self, peel: Peel) -> tuple[tuple[int, ...], list[int]]:
        """Lengths of the dimensions, and the caps of the bonds behind them, outer ones first."""
        if peel.side == "left":
            taken = slice(self.first, self.first + peel.count)
            return self.shape[taken], list(self.caps[taken])
        taken = slice(self.last - peel.count + 1, self.last + 1)
        bonds = slice(self.last - peel.count, self.last)
        return self.shape[taken][::-1], list(self.caps[bonds])[::-1]

    def _factor(self, M: Unfolding, count: int, cap: int) -> tuple[str, Factor]:
        share = self.budget.share()
        # Of the share, the floor of a Gram matrix may take up an eighth.
        coarse = share >= 8.0 * GRAM_FLOOR * self.norm**2
        m, n = M.rows, M.columns
        shorter = min(m, n)
        wanted = self.method
        # A random range is that of the last of the bonds. What it misses adds up in squares with
        # the errors of that bond, but not with those of bonds before it.
        if count > 1 and wanted in ("auto", "randomised"):
            wanted = "gram"
        if wanted == "auto":
            direct = gram_flops(m, n) if coarse else QR_SLOWER * qr_flops(m, n)
            sampled = randomised_flops(m, n, min(RANK, cap), coarse)
            # Half, since a rank above the expected one makes the attempt a loss.
            wanted = "randomised" if sampled < 0.5 * direct else "gram"
        if wanted == "randomised":
            found = randomised_factor(
                M,
                0.5 * share,
                self.norm**2 - self.lost,
                min(cap, shorter),
                self.seed + len(self.steps),
            )
            if found is not None:
                return "randomised", found
            wanted = "gram"
        if wanted == "gram" and coarse:
            return "gram", gram_factor(M)
        return "qr", qr_factor(M)

    def finish(self) -> list[NDArray]:
        """All cores, in order and in the dtype of the tensor, scaled back."""
        n = self.shape[self.first]
        pivot = self.values.reshape(self.rank["left"], n, self.rank["right"])
        # A scale that never was applied has not to be taken off.
        undo = 1.0 if self.scale != 1.0 else 1.0 / self.applied
        cores = [*self.left, pivot, *self.right[::-1]]
        return _scaled_back(cores, self.first, undo, self.dtype)

    def rounding(self) -> float:
        """The part of the norm that rounding may have changed."""
        if not self.projections:
            return 0.0
        return _rounding(self.projections, self.rounded + 1, self.dtype)


def _split_side(
    L: NDArray, rank: int, modes: Sequence[int], caps: Sequence[int], budget: Budget, side: Side
) -> tuple[list[NDArray], NDArray | None, float]:
    """`split` from either side: cores as they stand in the train, U as the rows of L stand."""
    if side == "left":
        return split(L, rank, modes, caps, budget)
    # Seen from the right the dimensions come in the opposite order: so turn the rows of L.
    order = tuple(range(len(modes), -1, -1))
    turned = L.reshape(*modes[::-1], rank, -1).transpose(*order, len(modes) + 1)
    cores, U, lost = split(turned.reshape(L.shape), rank, modes, caps, budget)
    if U is None:
        # The identity on the rows of L, which the cores have to number as L does.
        rows = np.arange(len(L)).reshape(rank, *modes).transpose(order).reshape(-1)
        cores[-1] = cores[-1][:, :, rows]
    else:
        U = U.reshape(rank, *modes, -1).transpose(*order, len(modes) + 1).reshape(U.shape)
    return [core.transpose(2, 1, 0) for core in cores], U, lost


def _scaled_back(cores: list[NDArray], pivot: int, factor: float, dtype: np.dtype) -> list[NDArray]:
    """The cores times a power of two in all: on the pivot if it can hold it, else on all alike."""
    largest = float(np.abs(cores[pivot]).max(initial=0.0))
    with np.errstate(over="ignore", under="ignore"):
        fits = largest * factor <= float(np.finfo(dtype).max)
    if fits:
        parts = [factor if k == pivot else 1.0 for k in range(len(cores))]
    else:
        exponent = math.frexp(factor)[1] - 1 + math.frexp(largest)[1]
        each = exponent // len(cores)
        parts = [math.ldexp(1.0, each)] * len(cores)
        own = math.frexp(factor)[1] - 1 - each * (len(cores) - 1)
        parts[pivot] = math.ldexp(1.0, own)
    return [
        (core if part == 1.0 else core * part).astype(dtype)
        for core, part in zip(cores, parts, strict=True)
    ]


def _rounding(projections: float, cores: int, dtype: np.dtype) -> float:
    """Relative change of the whole by rounding: projections, the sum of k^(2/3) of all; cores.

    Rounding a core, whose columns in the train are orthonormal but for the pivot's, changes the
    whole by at most a unit of the dtype. Errors are independent and add up as squares.
    """
    stored = float(np.finfo(dtype).eps) / 2.0 if dtype != np.float64 else 0.0
    return math.hypot(ROUNDING * EPS / 2.0 * math.sqrt(projections), stored * math.sqrt(cores))


def _rounding_expected(shape: tuple[int, ...], dtype: np.dtype) -> float:
    """`_rounding` at most, before any rank is known: each bond a projection of its own."""
    total, size, rows = 0.0, math.prod(shape), 1
    for n in shape[:-1]:
        rows *= n
        total += min(rows, size // rows) ** (2.0 / 3.0)
    return _rounding(total, len(shape), dtype)


def _checked(values: ArrayLike) -> NDArray:
    X = np.asarray(values)
    if X.dtype.kind not in "fiub":
        raise ValueError(f"values of dtype {X.dtype}: must be real numbers")
    if X.ndim == 0:
        raise ValueError("values of shape (): must have at least one dimension")
    return np.ascontiguousarray(X, dtype=np.float32 if X.dtype == np.float32 else np.float64)


def _caps(max_ranks: int | Sequence[int] | None, shape: tuple[int, ...]) -> list[int]:
    bonds = len(shape) - 1
    if max_ranks is None:
        return [math.prod(shape)] * bonds
    caps = [max_ranks] * bonds if np.ndim(max_ranks) == 0 else list(max_ranks)
    if len(caps) != bonds:
        raise ValueError(f"max_ranks has {len(caps)} ranks: must have {bonds}, one a bond")
    for cap in caps:
        if int(cap) != cap or cap < 1:
            raise ValueError(f"max_ranks {cap!r}: must be whole numbers of at least 1")
    return [int(cap) for cap in caps]


def _check_options(
    tolerance: float | None, absolute: float | None, method: str, direction: str
) -> None:
    if tolerance is not None and absolute is not None:
        raise ValueError("tolerance and absolute: only one of them")
    for name, value in (("tolerance", tolerance), ("absolute", absolute)):
        if value is not None and not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} {value!r}: must be finite and not negative")
    if method not in METHODS:
        raise ValueError(f"method {method!r}: must be one of {', '.join(METHODS)}")
    if direction not in DIRECTIONS:
        raise ValueError(f"direction {direction!r}: must be one of {', '.join(DIRECTIONS)}")


def _trivial(
    X: NDArray, norm: float, tolerance: float | None, absolute: float | None
) -> Decomposition:
    """Of tensors that need no decomposition: one dimension, no entries, or zeros alone."""
    if X.ndim == 1:
        cores = (X.reshape(1, -1, 1),)
    else:
        cores = tuple(np.zeros((1, n, 1), X.dtype) for n in X.shape)
    allowed = absolute if absolute is not None else (tolerance or 0.0) * norm
    return Decomposition(TensorTrain(cores), 0.0, 0.0, norm, allowed, 0, ())
