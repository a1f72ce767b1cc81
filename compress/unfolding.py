"""A tensor seen as a matrix from one of its ends, read in blocks that fit a cache.

Symbols: M (m, n) the matrix: m rows, the dimensions taken off; n columns, those that remain.
U (m, r) orthonormal columns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Side = Literal["left", "right"]

BLOCK = 1 << 18  # entries of a block: 2 MiB of float64, a second-level cache
# Largest entries outside of these would lose their squares, or the sums of those.
SAFE = (2.0**-300, 2.0**300)


@dataclass(frozen=True)
class Unfolding:
    """M, without a copy of the tensor.

    values : C-contiguous, float32 or float64; (m, n) from the left, where the rows are the first
    dimensions of the tensor, and (n, m) from the right, where they are the last ones
    scale  : a power of two by which entries are multiplied as they are read
    """

    values: NDArray
    side: Side
    scale: float = 1.0

    @property
    def rows(self) -> int:
        return self.values.shape[0 if self.side == "left" else 1]

    @property
    def columns(self) -> int:
        return self.values.shape[1 if self.side == "left" else 0]

    @property
    def matrix(self) -> NDArray:
        """M (m, n), a view that is not scaled."""
        return self.values if self.side == "left" else self.values.T

    def read(self, columns: slice = slice(None)) -> NDArray:
        """Those columns of M, scaled, in float64: a view where nothing has to change."""
        part = self.matrix[:, columns]
        if self.scale != 1.0:
            return np.multiply(part, self.scale, dtype=np.float64)
        return part.astype(np.float64, copy=False)

    def blocks(self, least: int = 256) -> Iterator[tuple[slice, NDArray]]:
        """M in blocks of at least so many columns: which, and they."""
        width = max(BLOCK // max(self.rows, 1), least)
        for first in range(0, self.columns, width):
            columns = slice(first, min(first + width, self.columns))
            yield columns, self.read(columns)

    def project(self, U: NDArray) -> NDArray:
        """U'M, of the layout of `values`: (r, n) from the left, (n, r) from the right; float64."""
        r, n = U.shape[1], self.columns
        if self.side == "left":
            projected = np.empty((r, n))
            for columns, block in self.blocks():
                np.matmul(U.T, block, out=projected[:, columns])
            return projected
        projected = np.empty((n, r))
        for columns, block in self.blocks():
            np.matmul(block.T, U, out=projected[columns])
        return projected


@dataclass(frozen=True)
class Survey:
    """Of a tensor before anything is done to it.

    largest : of the absolute values; norm : ||X||_F times `scale`, the power of two by which the
    entries have to be multiplied for their squares to be safe (mostly 1)
    """

    largest: float
    norm: float
    scale: float


def survey(values: NDArray) -> Survey:
    """One pass over the values (C-contiguous); ValueError naming the first that is not finite."""
    flat = values.reshape(-1)
    largest, squares = 0.0, 0.0
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        for first in range(0, flat.size, BLOCK):
            block = flat[first : first + BLOCK]
            most = max(float(block.max()), -float(block.min()))
            if not math.isfinite(most):
                _refuse(block, first, values.shape)
            largest = max(largest, most)
            wide = block.astype(np.float64, copy=False)
            squares += float(wide @ wide)
    if largest == 0.0 or SAFE[0] < largest < SAFE[1]:
        return Survey(largest, math.sqrt(squares), 1.0)
    scale = math.ldexp(1.0, min(-math.frexp(largest)[1], 1000))
    squares = 0.0
    for first in range(0, flat.size, BLOCK):
        scaled = flat[first : first + BLOCK] * scale
        squares += float(scaled @ scaled)
    return Survey(largest, math.sqrt(squares), scale)


def _refuse(block: NDArray, first: int, shape: tuple[int, ...]) -> None:
    at = int(np.argmin(np.isfinite(block)))
    index = tuple(int(i) for i in np.unravel_index(first + at, shape))
    raise ValueError(f"values[{', '.join(map(str, index))}] is {block[at]}: must be finite")
