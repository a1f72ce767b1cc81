"""The coders an archive chooses among, by name.

    exact       every bit is kept
    constant    one row of numbers, the same for all bodies and steps
    predictive  each body's path, rounded, from its own past
    guided      the same, from the field whose integral over time it is
    tt          a tensor train of bodies and time
    qtt         a tensor train over the levels of bodies and of time, rows in any order

Symbols: T steps; n bodies; w components.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compress import permutation, predictive, raw, tt_coder
from compress.bounds import Target
from compress.effort import BEST, Effort

# In files a coder is its place in this list: only append to it.
CODERS = ("exact", "constant", "predictive", "guided", "tt", "qtt")
# The one that needs the decoded field that guides.
GUIDED = "guided"

_ORDER_BYTES = 4  # of the length of the order's code
ALL = slice(None)


@dataclass(frozen=True)
class Context:
    """What is known besides the values.

    guide : (T, n, w) increments from another field; order : () -> (n,) rows such that neighbours
    in space lie side by side, computed only when asked
    """

    guide: NDArray | None = None
    order: Callable[[], NDArray] | None = None


NOTHING = Context()


def candidates(
    target: Target, context: Context = NOTHING, effort: Effort = BEST
) -> tuple[str, ...]:
    """The coders worth a trial for a target, the cheaper ones first."""
    if target.exact:
        return ("constant", "exact")
    guided = () if context.guide is None else (GUIDED,)
    return ("constant", "tt", "predictive", *guided, *(("qtt",) if effort.thorough else ()))


def encode(
    name: str,
    values: NDArray,
    target: Target,
    context: Context = NOTHING,
    effort: Effort = BEST,
) -> bytes | None:
    """Values (T, n, w) in bytes, None where the coder has no use for them."""
    return encode_and_decode(name, values, target, context, effort)[0]


def encode_and_decode(
    name: str,
    values: NDArray,
    target: Target,
    context: Context = NOTHING,
    effort: Effort = BEST,
) -> tuple[bytes | None, NDArray | None]:
    """As `encode`, and what `decode` makes of it where the coder knows that without decoding."""
    if name in ("predictive", GUIDED):
        guide = context.guide if name == GUIDED else None
        data, decoded = predictive.encode_and_decode(values, target, guide=guide, effort=effort)
        paths = data[0] % predictive.SINGLE == predictive.PATHS
        return (data, decoded) if paths else (None, None)
    return _encode(name, values, target, context, effort), None


def _encode(
    name: str, values: NDArray, target: Target, context: Context, effort: Effort
) -> bytes | None:
    if name == "exact":
        return raw.encode(values)
    if name == "constant":
        return _encode_constant(values, target)
    if name == "tt":
        data = tt_coder.encode(values, target, effort=effort)
        return data if tt_coder.pays(data) else None
    if name == "qtt":
        return _encode_tensorised(values, target, context)
    raise ValueError(f"no coder {name!r}")


def decode(
    name: str,
    data: bytes,
    dtype: np.dtype,
    shape: tuple[int, int, int],
    guide: NDArray | None = None,
    steps: slice = ALL,
    rows: NDArray | slice = ALL,
) -> NDArray:
    """Steps and rows of the values (T, n, w) of `shape`, of a type.

    Raises ValueError for data that the coder did not write.
    """
    if name == "exact":
        return raw.decode(data, dtype, shape)[steps][:, rows]
    if name == "constant":
        return _decode_constant(data, dtype, shape, steps, rows)
    if name in ("predictive", GUIDED):
        if name == GUIDED and guide is None:
            raise ValueError("a guided field without its guide")
        used = guide if name == GUIDED else None
        decoded = predictive.decode(data, used, steps=steps, limit=math.prod(shape))[:, rows]
    elif name in ("tt", "qtt"):
        order, data = (None, data) if name == "tt" else _split_order(data, shape[1])
        if tt_coder.Header.read(tt_coder.Bytes(data)).shape != shape:
            raise ValueError(f"another shape than {shape}")
        decoded = tt_coder.decode(data, order, steps, rows)
    else:
        raise ValueError(f"no coder {name!r}")
    expected = (len(range(*steps.indices(shape[0]))), _count(rows, shape[1]), shape[2])
    if decoded.shape != expected or decoded.dtype != dtype:
        raise ValueError(f"{decoded.dtype} {decoded.shape} decoded, {dtype} {expected} expected")
    return decoded


def _count(rows: NDArray | slice, bodies: int) -> int:
    return len(range(*rows.indices(bodies))) if isinstance(rows, slice) else len(rows)


def _encode_constant(values: NDArray, target: Target) -> bytes | None:
    """The middle between extremes, or the mean where only the mean square error counts."""
    if not values.size:
        return values.dtype.type(0).tobytes() * values.shape[2]
    first = values[0, 0]
    if target.exact:
        same = values.tobytes() == np.broadcast_to(first, values.shape).tobytes()
        row = first if same else None
    elif math.isfinite(target.maximum):
        row = 0.5 * values.min(axis=(0, 1)) + 0.5 * values.max(axis=(0, 1))
    else:
        row = values.mean(axis=(0, 1), dtype=np.float64)
    if row is None:
        return None
    return np.asarray(row, values.dtype.newbyteorder("<")).tobytes()


def _decode_constant(
    data: bytes, dtype: np.dtype, shape: tuple[int, int, int], steps: slice, rows: NDArray | slice
) -> NDArray:
    row = np.frombuffer(data, dtype.newbyteorder("<")).astype(dtype)
    if row.shape != shape[2:]:
        raise ValueError("no data of the coder of constants")
    part = (len(range(*steps.indices(shape[0]))), _count(rows, shape[1]))
    return np.ascontiguousarray(np.broadcast_to(row, (*part, *shape[2:])))


def _encode_tensorised(values: NDArray, target: Target, context: Context) -> bytes | None:
    """With rows as they are, or in an order whose own code is then part of it."""
    data = tt_coder.encode(values, target, form="tensorised")
    best = bytes(_ORDER_BYTES) + data if tt_coder.pays(data) else None
    if context.order is None:
        return best
    order = context.order()
    code = permutation.encode(order)
    if best is not None and len(code) >= len(best):
        return best
    data = tt_coder.encode(values, target, order=order, form="tensorised")
    ordered = len(code).to_bytes(_ORDER_BYTES, "little") + code + data
    if not tt_coder.pays(data) or (best is not None and len(best) <= len(ordered)):
        return best
    return ordered


def _split_order(data: bytes, bodies: int) -> tuple[NDArray | None, bytes]:
    """The order of rows, None as they are; what the coder of tensor trains wrote."""
    length = int.from_bytes(data[:_ORDER_BYTES], "little")
    code, rest = data[_ORDER_BYTES : _ORDER_BYTES + length], data[_ORDER_BYTES + length :]
    return (permutation.decode(code, bodies) if length else None), rest
