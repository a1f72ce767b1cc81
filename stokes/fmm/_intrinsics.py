"""What compiled loops over pairs are written with: tuples held in registers, bits of numbers."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, register_jitable

# Sums may be reordered and products contracted; NaN and infinity keep their meaning.
REORDERED = {"reassoc", "contract", "nsz", "arcp"}


@intrinsic
def load_components(typingctx: Any, rows: Any, column: Any, like: Any) -> Any:
    """rows[0, column], rows[1, column], ... of a C-contiguous array, a tuple of the type of like.

    No bounds are checked.
    """
    if not isinstance(like, types.UniTuple) or like.dtype != rows.dtype:
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(rows)(context, builder, arguments[0])
        stride = cgutils.unpack_tuple(builder, array.shape)[1]
        position = context.cast(builder, arguments[1], column, types.intp)
        loaded = []
        for _ in range(like.count):
            loaded.append(builder.load(builder.gep(array.data, [position])))
            position = builder.add(position, stride)
        return context.make_tuple(builder, like, loaded)

    return like(rows, column, like), generate


@intrinsic
def add_components(typingctx: Any, a: Any, b: Any) -> Any:
    """a + b of two tuples of the same length, component by component, in the type of a."""
    if len(a) != len(b):
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        left, right = (cgutils.unpack_tuple(builder, t) for t in arguments)
        sums = [
            builder.fadd(x, context.cast(builder, y, from_type, a.dtype))
            for x, y, from_type in zip(left, right, b.types, strict=True)
        ]
        return context.make_tuple(builder, a, sums)

    return a(a, b), generate


@intrinsic
def bits(typingctx: Any, number: Any) -> Any:
    """The bits of a floating-point number as an integer of the same width."""
    result = types.int32 if number == types.float32 else types.int64

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(result))

    return result(number), generate


@intrinsic
def from_bits(typingctx: Any, integer: Any) -> Any:
    """The floating-point number that has the bits of an int32 or int64."""
    result = types.float32 if integer == types.int32 else types.float64

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(result))

    return result(integer), generate


@register_jitable
def middle(points, first, last):
    """Middle (x, y, z) of the smallest box about points (3, n) [first, last)."""
    return (
        _middle(points[0], first, last),
        _middle(points[1], first, last),
        _middle(points[2], first, last),
    )


@register_jitable
def _middle(values, first, last):
    low = high = values[first]
    for i in range(first + 1, last):
        low, high = min(low, values[i]), max(high, values[i])
    return 0.5 * (low + high)
