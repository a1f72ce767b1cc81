"""Rounding matrices to integers for a least number of bytes, and what a decoder needs to undo it.

Symbols: x a matrix in units of the step, q the integers made of it, v = |q|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compress import _kernels_context as kernels

# Squared error, in squared steps, that a bit has to save. Where the step is small against the
# values, halving it costs one bit a value: d(step^2 / 12) / d(bits) = step^2 ln(2) / 6 = 0.116.
PRICE = 0.12

LARGEST = float(1 << 46)  # magnitudes that can be coded
SHIFT_PARTS = 512  # a shift is a number of these parts of a step
_COSTS = -np.log2((np.arange(4097) + 0.5) / 4097.0)


@dataclass(frozen=True)
class Rounded:
    """A matrix rounded to integers.

    q : (n, r) int64; data : its code; shifts : parts of a step that a magnitude of 1, and a larger
    one, is to be lessened by (of the values that round to one integer, small ones are more
    frequent); error : ||x - values||_F after that [steps].
    """

    q: NDArray
    data: bytes
    shifts: tuple[int, int]
    error: float


def round_matrix(x: NDArray, price: float = PRICE, limit: int = 1 << 62) -> Rounded | None:
    """Round x (n, r) float64 and code it; None where that would take more than `limit` bytes."""
    x = np.ascontiguousarray(x, dtype=np.float64)
    if float(np.abs(x).max(initial=0.0)) >= LARGEST:
        return None
    slack = 16 * x.shape[1] + 64
    size = min(x.size, limit) + slack
    while True:
        out = np.zeros(size, np.uint8)
        q, length, moments = kernels.encode_matrix(x, price, _COSTS, out)
        if length >= 0:
            break
        if size >= limit + slack:
            return None
        size = min(4 * size, limit + slack)
    shifts = tuple(_nearest_shift(moments[kind]) for kind in (1, 2))
    squares = moments[0, 2] + sum(
        squares + 2.0 * total * shift + count * shift * shift
        for (count, total, squares), shift in zip(moments[1:], shift_values(shifts), strict=True)
    )
    return Rounded(q, out[:length].tobytes(), shifts, float(max(squares, 0.0)) ** 0.5)


def unround(data: bytes, rows: int, columns: int) -> NDArray:
    """The first `rows` rows of the integers in Rounded.data, (rows, columns) int64.

    Raises ValueError where the bytes cannot be such a code.
    """
    q = kernels.decode_matrix(np.frombuffer(data, np.uint8), rows, columns)
    if len(q) != rows:
        raise ValueError("coded matrix: an entry is longer than any can be")
    return q


def shift_values(shifts: tuple[int, int]) -> NDArray:
    """Shifts in steps, (2,) float64."""
    return np.array(shifts, dtype=np.float64) / SHIFT_PARTS


def _nearest_shift(moments: NDArray) -> int:
    """The shift of least squares, limited to what a byte holds."""
    count, total, _ = moments
    return min(max(round(-SHIFT_PARTS * total / count), -128), 127) if count else 0
