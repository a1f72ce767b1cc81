"""What error a user allows, what that means for one block of data, and what error there is.

Symbols: X a block of values, Y what a coder makes of it, N their number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compress import _kernels_bounds as kernels

Kind = Literal["relative", "rmse", "pointwise", "exact"]
KINDS: tuple[Kind, ...] = ("relative", "rmse", "pointwise", "exact")


@dataclass(frozen=True)
class Bound:
    """The error that is allowed in a field.

    relative  : ||X - Y||_F <= value ||X||_F, of all blocks of a chunk together and so of all
                chunks; a block of small values may have more of its own norm [1]
    rmse      : ||X - Y||_F <= value sqrt(N) [unit of the field]
    pointwise : max |X - Y| <= value [unit of the field]
    exact     : every bit is kept; value is 0

    Raises ValueError for a value that is negative or not finite, and for 0 unless exact.
    """

    kind: Kind
    value: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"bound {self.kind!r}: must be one of {', '.join(KINDS)}")
        if self.kind == "exact":
            if self.value != 0.0:
                raise ValueError(f"exact bound {self.value!r}: takes no value")
        elif not (math.isfinite(self.value) and self.value > 0.0):
            raise ValueError(f"{self.kind} bound {self.value!r}: must be positive and finite")

    def target(self, values: NDArray, floor: float = 0.0) -> Target:
        """What a coder has to meet on these values.

        `floor` [unit of the field] is the root mean square below which a relative bound no longer
        shrinks with the values. Raises ValueError for a relative bound of values whose norm is not
        finite.
        """
        if self.kind == "exact":
            return Target(0.0, 0.0)
        if self.kind == "pointwise":
            return Target(maximum=self.value)
        count = math.sqrt(values.size)
        if self.kind == "rmse":
            return Target(frobenius=self.value * count)
        size = norm(values)
        if not math.isfinite(size):
            raise ValueError(f"relative bound: the norm of the values is {size}")
        return Target(frobenius=self.value * max(size, floor * count))


@dataclass(frozen=True)
class Target:
    """The error a coder may make on one block: both conditions hold.

    frobenius : largest ||X - Y||_F; maximum : largest |X - Y| of any entry. Both in the unit of
    the field; both 0 where every bit is to be kept.
    """

    frobenius: float = math.inf
    maximum: float = math.inf

    @property
    def exact(self) -> bool:
        """Whether nothing may be lost."""
        return self.frobenius == 0.0 or self.maximum == 0.0

    def rmse(self, count: int) -> float:
        """The root mean square error that so many values may have, by the Frobenius norm alone."""
        return self.frobenius / math.sqrt(max(count, 1))

    def met_by(self, errors: Errors) -> bool:
        """Whether measured errors keep to it."""
        return errors.frobenius <= self.frobenius and errors.maximum <= self.maximum


@dataclass(frozen=True)
class Errors:
    """Errors as measured, of one block or of several together.

    count : entries; frobenius : ||X - Y||_F; norm : ||X||_F; maximum : max |X - Y|;
    least, most : of X
    """

    count: int = 0
    frobenius: float = 0.0
    norm: float = 0.0
    maximum: float = 0.0
    least: float = math.inf
    most: float = -math.inf

    @property
    def relative(self) -> float:
        """||X - Y||_F / ||X||_F (S. De, PhD thesis, University of Michigan 2021, eq. 4.13)."""
        if self.frobenius == 0.0:
            return 0.0
        return self.frobenius / self.norm if self.norm > 0.0 else math.inf

    @property
    def rmse(self) -> float:
        """Root mean square error, in the unit of the field."""
        return self.frobenius / math.sqrt(max(self.count, 1))

    @property
    def nrmse(self) -> float:
        """Root mean square error over the range of the values (ibid., eq. 4.32)."""
        if self.frobenius == 0.0:
            return 0.0
        return self.rmse / (self.most - self.least) if self.most > self.least else math.inf

    def __add__(self, other: Errors) -> Errors:
        """Those of both blocks together."""
        return Errors(
            self.count + other.count,
            math.hypot(self.frobenius, other.frobenius),
            math.hypot(self.norm, other.norm),
            max(self.maximum, other.maximum),
            min(self.least, other.least),
            max(self.most, other.most),
        )


def measure(values: NDArray, decoded: NDArray) -> Errors:
    """The errors of `decoded` against `values`, arrays of one shape without NaN or infinity."""
    if not values.size:
        return Errors()
    x, y = _flat(values), _flat(decoded)
    maximum, size, least, most = kernels.extremes(x, y)
    error_scale, scale = _scale(maximum), _scale(size)
    errors, squares = kernels.squares(x, y, error_scale, scale)
    return Errors(
        count=values.size,
        frobenius=math.sqrt(errors) / error_scale,
        norm=math.sqrt(squares) / scale,
        maximum=maximum,
        least=least,
        most=most,
    )


def norm(values: NDArray) -> float:
    """||X||_F, without overflow or underflow of the squares."""
    size = largest(values)
    if size == 0.0 or not math.isfinite(size):
        return size
    scale = _scale(size)
    return math.sqrt(kernels.sum_of_squares(_flat(values), scale)) / scale


def largest(values: NDArray) -> float:
    """The largest magnitude of any entry, NaN if one is NaN, 0 of no entries."""
    return kernels.largest(_flat(values))


def _flat(values: NDArray) -> NDArray:
    """The entries in a row, float32 or float64."""
    plain = values.dtype in (np.float32, np.float64) and values.dtype.isnative
    return np.ascontiguousarray(values if plain else values.astype(np.float64)).ravel()


def _scale(size: float) -> float:
    """A power of two, which changes no digit, that brings this magnitude to about 1."""
    if size == 0.0 or not math.isfinite(size):
        return 1.0
    return math.ldexp(1.0, min(-math.frexp(size)[1], 1000))
