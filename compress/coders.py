"""The coders an archive chooses among, by name.

    exact     every bit is kept
    constant  one row of numbers, the same for all bodies and steps

Symbols: T steps; n bodies; w components.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from compress import raw
from compress.bounds import Target

# In files a coder is its place in this list: only append to it.
CODERS = ("exact", "constant", "predictive", "guided", "tt", "qtt")
# The one that needs the decoded field that guides.
GUIDED = "guided"


def candidates(target: Target, guided: bool) -> tuple[str, ...]:
    """The coders worth a trial for a target; `guided`: there is a field to guide by."""
    if target.exact:
        return ("constant", "exact")
    return ("constant",)


def encode(name: str, values: NDArray, target: Target, guide: NDArray | None) -> bytes | None:
    """Values (T, n, w) in bytes, None where the coder has no use for them."""
    if name == "exact":
        return raw.encode(values)
    if name == "constant":
        return _encode_constant(values, target)
    raise ValueError(f"no coder {name!r}")


def decode(
    name: str,
    data: bytes,
    dtype: np.dtype,
    shape: tuple[int, int, int],
    guide: NDArray | None = None,
    steps: slice = slice(None),
    rows: NDArray | slice = slice(None),
) -> NDArray:
    """Steps and rows of the values (T, n, w) of `shape`, of a type.

    Raises ValueError for data that the coder did not write.
    """
    if name == "exact":
        return raw.decode(data, dtype, shape)[steps][:, rows]
    if name == "constant":
        row = np.frombuffer(data, dtype.newbyteorder("<")).astype(dtype)
        if row.shape != shape[2:]:
            raise ValueError("no data of the coder of constants")
        part = np.empty(shape[:2], np.bool_)[steps][:, rows].shape
        return np.ascontiguousarray(np.broadcast_to(row, (*part, *shape[2:])))
    raise ValueError(f"no coder {name!r}")


def _encode_constant(values: NDArray, target: Target) -> bytes | None:
    """The middle between extremes, or the mean where only the mean square error counts."""
    if not values.size:
        return values.dtype.type(0).tobytes() * values.shape[2]
    first = values[0, 0]
    if target.exact:
        same = values.tobytes() == np.broadcast_to(first, values.shape).tobytes()
        row = first if same else None
    elif math.isfinite(target.maximum):
        low, high = values.min(axis=(0, 1)), values.max(axis=(0, 1))
        row = 0.5 * low + 0.5 * high
    else:
        row = values.mean(axis=(0, 1), dtype=np.float64)
    if row is None:
        return None
    return np.asarray(row, values.dtype.newbyteorder("<")).tobytes()
