"""Values of a kernel on lattices: at the differences of the nodes of two equispaced grids.

One compiled loop for each kernel, whose innermost runs along z in whole vectors: tables of
transfers evaluate a kernel at millions of places.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import DTypeLike, NDArray

from stokes.fmm._intrinsics import load_components
from stokes.fmm.kernels import Kernel, digest


def windows(kernel: Kernel, axes: NDArray, dtype: DTypeLike = np.float64) -> NDArray:
    """Return the kernel's distinct components on k lattices: (k, n_unique, n, n, n).

    axes : (k, 3, n) coordinates along x, y and z of each lattice, evaluated in double precision
    """
    k, _, n = axes.shape
    number = np.asarray(kernel.entry, dtype=np.int64)
    _, first = np.unique(number, return_index=True)
    place = np.full(number.size, -1)
    place[first] = np.arange(kernel.n_unique)
    values = np.empty((k, kernel.n_unique, n, n, n), dtype)
    evaluate = _evaluator(kernel.apply, kernel.n_in, kernel.n_out, digest(kernel.apply))
    scaled = np.ascontiguousarray(axes / kernel.length)
    evaluate(scaled, np.eye(kernel.n_in), place.reshape(number.shape), kernel.factor, values)
    return values


@functools.cache
def _evaluator(apply: Callable, n_in: int, n_out: int, digest: str) -> Callable:
    zero = (0.0,) * n_in

    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def evaluate(axes, identity, place, factor, values):
        _ = digest  # a cell of this closure: part of the key of the disk cache
        lattices, _, n = axes.shape
        row = np.empty((n_out, n))
        for k in range(lattices):
            for i in range(n):
                for j in range(n):
                    for column in range(n_in):
                        w = load_components(identity, column, zero)
                        x, y, z = axes[k, 0, i], axes[k, 1, j], axes[k, 2]
                        for m in range(n):
                            _store_components(row, m, apply(x, y, z[m], w))
                        for output in range(n_out):
                            unique = place[output, column]
                            if unique >= 0:
                                for m in range(n):
                                    values[k, unique, i, j, m] = factor * row[output, m]

    return evaluate


@intrinsic
def _store_components(typingctx: Any, rows: Any, column: Any, values: Any) -> Any:
    """rows[i, column] = values[i] for all components of a tuple; no bounds are checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(rows)(context, builder, arguments[0])
        stride = cgutils.unpack_tuple(builder, array.shape)[1]
        position = context.cast(builder, arguments[1], column, types.intp)
        parts = cgutils.unpack_tuple(builder, arguments[2])
        for part, kind in zip(parts, values.types, strict=True):
            number = context.cast(builder, part, kind, rows.dtype)
            builder.store(number, builder.gep(array.data, [position]))
            position = builder.add(position, stride)
        return context.get_dummy_value()

    return types.void(rows, column, values), generate
