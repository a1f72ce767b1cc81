"""Near matrices kept between applications: every pair of near points is evaluated once.

The matrix of a group of targets with all sources of its list is cut into tiles of some hundred
sources, whose weights stay in the first-level cache while the tile's rows stream past; the tiles
stand one after another in memory, in the order in which they are read. An application reads 8
bytes (4 in single precision) for every entry and pair, once for up to eight right-hand sides.

That pays for kernels with an exponential: 0.3 ns a pair against 0.5 to 1 for computing it, 0.1
against 0.2 to 0.4 a pair and right-hand side where there are eight (one core of a Zen 5). 1/r gains
little, and a tensor of 9 entries takes four times as long to be read as to be computed.

Symbols: R right-hand sides taken together, 1, 4 or 8.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numba
import numpy as np
from numba import prange
from numba.extending import register_jitable
from numpy.typing import NDArray

from stokes.fmm._intrinsics import REORDERED, add_components, load_components, middle
from stokes.fmm._threads import limited_threads
from stokes.fmm.kernels import Kernel, digest

_COLUMNS = 256  # of a tile: eight rows of weights take a third of a first-level cache
_VECTOR = 64  # bytes; rows of a tile are filled up to a multiple with zeros
_TOGETHER = (1, 4, 8)


def stored_bytes(
    kernel: Kernel,
    single: bool,
    target_range: NDArray,
    start: NDArray,
    source_range: NDArray,
) -> int:
    """Bytes that the matrices of these groups take; arguments as of `NearMatrices`."""
    layout = _Layout(kernel, single)
    return layout.real.itemsize * int(layout.offsets(target_range, start, source_range)[-1])


class NearMatrices:
    """The matrices of one kernel between groups of near points, and sums with them."""

    def __init__(
        self,
        kernel: Kernel,
        targets: NDArray,
        target_range: NDArray,
        sources: NDArray,
        start: NDArray,
        source_range: NDArray,
        *,
        single: bool = False,
        threads: int = 1,
    ) -> None:
        """Evaluate and store; arguments as of `NearField` and its `add`.

        The sums are those of `NearField.add` but for the order of their terms.
        """
        self.kernel = kernel
        self.single = single and kernel.single
        self.threads = threads
        self._layout = _Layout(kernel, self.single)
        lists = (target_range, start, source_range)
        self._lists = [np.ascontiguousarray(a, np.int64) for a in lists]
        self._offset = self._layout.offsets(*self._lists)
        self._entries = np.empty(self._offset[-1], self._layout.real)
        fill = _fill_loop(
            *(kernel.apply, kernel.n_in, kernel.n_out, self._layout.real.type),
            *(self._layout.width, threads > 1, digest(kernel.apply)),
        )
        scale = 1.0 / kernel.length
        with limited_threads(threads):
            fill(targets, sources, *self._lists, scale, self._offset, self._entries)

    @property
    def nbytes(self) -> int:
        """Memory of the matrices."""
        return self._entries.nbytes

    def add(self, weights: NDArray, out: NDArray) -> None:
        """Add the sums for weights (r, n_in, ns) to out (r, n_out, nt), both float64."""
        most = _TOGETHER[-1]
        for k in range(0, len(weights), most):
            some = slice(k, k + most)
            together = next(R for R in _TOGETHER if len(weights[some]) <= R)
            loop = _product_loop(
                *(self.kernel.n_in, self.kernel.n_out, self._layout.real.type),
                *(self._layout.width, together, self.threads > 1),
            )
            factor = self.kernel.factor
            with limited_threads(self.threads):
                loop(self._entries, self._offset, *self._lists, weights[some], factor, out[some])


class _Layout:
    """Where the entries of a group stand.

    Tile after tile of `width` sources, the last one filled up to whole vectors; in a tile row
    after row, (output, target); in a row one input after the other.
    """

    def __init__(self, kernel: Kernel, single: bool) -> None:
        self.kernel = kernel
        self.real = np.dtype(np.float32 if single and kernel.single else np.float64)
        self.lanes = _VECTOR // self.real.itemsize
        self.width = max(1, _COLUMNS // kernel.n_in // self.lanes) * self.lanes

    def offsets(
        self, target_range: NDArray, start: NDArray, source_range: NDArray
    ) -> NDArray[np.int64]:
        """First entry (k + 1,) of each group, and the number of all."""
        before = np.append(0, np.cumsum(source_range[:, 1] - source_range[:, 0], dtype=np.int64))
        sources = before[start[1:]] - before[start[:-1]]
        columns = -(-sources // self.lanes) * self.lanes * self.kernel.n_in
        rows = (target_range[:, 1] - target_range[:, 0]).astype(np.int64) * self.kernel.n_out
        return np.append(0, np.cumsum(rows * columns))


@functools.cache
def _fill_loop(
    apply: Callable, n_in: int, n_out: int, real: type, width: int, threaded: bool, digest: str
) -> Callable:
    """Compile the loop that evaluates the matrices; its disk cache knows the digest."""
    zero_in = (real(0.0),) * n_in
    lanes = _VECTOR // np.dtype(real).itemsize

    @numba.njit(cache=True, nogil=True, error_model="numpy", parallel=threaded)
    def fill(targets, sources, target_range, start, source_range, scale, offset, entries):
        _ = digest
        points = sources.reshape((1, 3, sources.shape[1]))
        for g in prange(len(target_range)):
            first, last = target_range[g, 0], target_range[g, 1]
            if first == last:
                continue
            centre = middle(targets, first, last)
            unit = np.eye(n_in).astype(real)
            gathered, tile = np.empty((1, 3 * width)), np.empty((3, width))
            left = _listed(source_range, start[g], start[g + 1])
            k, skip, base = start[g], 0, offset[g]
            while left > 0:
                count = min(left, width)
                columns = -(-count // lanes) * lanes
                k, skip = _gather(points, source_range, k, skip, count, width, gathered)
                for d in range(3):
                    for j in range(count):
                        tile[d, j] = (gathered[0, d * width + j] - centre[d]) * scale
                size = n_out * (last - first) * n_in * columns
                block = entries[base : base + size].reshape((n_out, last - first, n_in, columns))
                _evaluate(
                    *(apply, zero_in, unit, targets, first, centre, scale, tile, count, block)
                )
                base += size
                left -= count

    return fill


@register_jitable
def _listed(source_range, k, last):
    """Number of sources in the ranges [k, last)."""
    count = 0
    for m in range(k, last):
        count += source_range[m, 1] - source_range[m, 0]
    return count


@register_jitable
def _gather(rows, source_range, k, skip, count, stride, tile):
    """Copy `count` columns of rows (R, c, n) to the rows of tile (R, >= c stride).

    The columns are those of the ranges from number k on, less the first `skip` of it; returns k
    and skip for the columns that follow.
    """
    filled = 0
    while filled < count:
        begin = source_range[k, 0] + skip
        taken = min(source_range[k, 1] - begin, count - filled)
        for a in range(rows.shape[0]):
            for c in range(rows.shape[1]):
                for j in range(taken):
                    tile[a, c * stride + filled + j] = rows[a, c, begin + j]
        filled += taken
        skip += taken
        if begin + taken == source_range[k, 1]:
            k, skip = k + 1, 0
    return k, skip


@register_jitable(fastmath=REORDERED)
def _evaluate(apply, zero_in, unit, targets, first, centre, scale, tile, count, block):
    """The entries (n_out, rows, n_in, columns) of targets from `first` on and `count` sources.

    Differences are taken in double: the closest pairs keep their digits in single precision too.
    """
    real = block.dtype.type
    n_out, rows, n_in = block.shape[:3]
    for t in range(rows):
        x = (targets[0, first + t] - centre[0]) * scale
        y = (targets[1, first + t] - centre[1]) * scale
        z = (targets[2, first + t] - centre[2]) * scale
        for i in range(n_in):
            w = load_components(unit, i, zero_in)
            for o in range(n_out):
                row = block[o, t, i]
                for j in range(count):
                    rx, ry, rz = real(x - tile[0, j]), real(y - tile[1, j]), real(z - tile[2, j])
                    row[j] = apply(rx, ry, rz, w)[o]
                row[count:] = real(0.0)


@functools.cache
def _product_loop(
    n_in: int, n_out: int, real: type, width: int, together: int, threaded: bool
) -> Callable:
    """Compile the loop that multiplies the matrices with up to `together` right-hand sides."""
    zero = (real(0.0),) * together
    scaled = {1: _scaled_one, 4: _scaled_four, 8: _scaled_eight}[together]
    lanes = _VECTOR // np.dtype(real).itemsize

    @numba.njit(cache=True, nogil=True, error_model="numpy", parallel=threaded)
    def multiply(entries, offset, target_range, start, source_range, weights, factor, out):
        for g in prange(len(target_range)):
            first, last = target_range[g, 0], target_range[g, 1]
            if first == last:
                continue
            tile = np.zeros((together, n_in * width), real)
            left = _listed(source_range, start[g], start[g + 1])
            k, skip, base = start[g], 0, offset[g]
            while left > 0:
                count = min(left, width)
                columns = -(-count // lanes) * lanes
                k, skip = _gather(weights, source_range, k, skip, count, columns, tile)
                for i in range(n_in):
                    tile[:, i * columns + count : (i + 1) * columns] = 0.0
                for o in range(n_out):
                    for t in range(first, last):
                        row = entries[base : base + n_in * columns]
                        total = _row_times_tile(scaled, zero, row, tile)
                        for c in range(len(out)):
                            out[c, o, t] += factor * total[c]
                        base += n_in * columns
                left -= count

    return multiply


@register_jitable(fastmath=REORDERED)
def _row_times_tile(scaled, zero, row, tile):
    """Products of one row of a matrix with each row of the tile."""
    total = zero
    for j in range(len(row)):
        total = add_components(total, scaled(load_components(tile, j, zero), row[j]))
    return total


@register_jitable(fastmath=REORDERED)
def _scaled_one(w, k):
    return (k * w[0],)


@register_jitable(fastmath=REORDERED)
def _scaled_four(w, k):
    return (k * w[0], k * w[1], k * w[2], k * w[3])


@register_jitable(fastmath=REORDERED)
def _scaled_eight(w, k):
    return (
        *(k * w[0], k * w[1], k * w[2], k * w[3]),
        *(k * w[4], k * w[5], k * w[6], k * w[7]),
    )
