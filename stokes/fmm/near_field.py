"""Sums over pairs of near groups: every target of a group with every source of its listed groups.

For each group of targets the sources of its list are copied, a tile at a time, into a contiguous
buffer that stays in the first-level cache; the loop over a tile vectorises and has no remainder,
because a tile is filled up with sources of weight zero. The same loop serves three lists of the
fast multipole method: points on points, multipoles (grid nodes as sources) on points, and points
on locals (grid nodes as targets).

Nothing is stored between applications: computing a pair takes 0.35 ns for 1/r and 0.6 ns for the
Stokeslet on one core of a Zen 5 with vectors of 512 bits, reading 1 or 9 stored entries 0.3 or
2.5 ns. `near_matrices` is for the kernels that take longer. Four right-hand sides share what is
computed of r.

Arithmetic: sums may be reordered and products contracted (`REORDERED`), which the vector units
need; NaN and infinity keep their meaning. The order depends on the groups only, never on threads.
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

_ROW = 4096  # bytes of a tile's row: six rows take half of a first-level cache
_VECTORS = 256  # bytes; a row is filled up to a multiple: four vectors


class NearField:
    """Adds the sums of one kernel over pairs of near groups."""

    def __init__(self, kernel: Kernel, single: bool = False, threads: int = 1) -> None:
        """Choose the loop compiled for this kernel; it is compiled, or loaded, on first use.

        single: pairs in single precision where the kernel can; coordinates are taken relative to
        the middle of the group's targets first, and the sums over tiles are in double.
        threads: target groups are spread over this many threads if more than 1.
        """
        self.kernel = kernel
        self.single = single and kernel.single
        self.threads = threads
        self.loop = self._compiled(four=False)

    def _compiled(self, four: bool) -> Callable:
        kernel, real = self.kernel, np.float32 if self.single else np.float64
        return _loop(
            *(kernel.apply, kernel.n_in, kernel.n_out, real),
            *(four, self.threads > 1, digest(kernel.apply)),
        )

    def add(
        self,
        targets: NDArray,
        target_range: NDArray,
        sources: NDArray,
        weights: NDArray,
        start: NDArray,
        source_range: NDArray,
        out: NDArray,
    ) -> None:
        """For each target group add to `out` the sums over the source groups of its list.

        targets (3, nt), sources (3, ns), weights (n_in, ns), out (n_out, nt), all float64 and
        C-contiguous; for r right-hand sides weights (r, n_in, ns), out (r, n_out, nt), taken four
        at a time so that what the kernel makes of r = x - y is computed once for the four.
        target_range (k, 2): [begin, end) of each group; its list is
        source_range[start[g]:start[g + 1]], rows [begin, end) of sources; start (k + 1,).
        Groups of targets must not overlap if there is more than one thread.
        """
        self._check(targets, sources, weights, out)
        lists = [np.ascontiguousarray(a, np.int64) for a in (target_range, start, source_range)]

        def run(loop: Callable, weights: NDArray, out: NDArray) -> None:
            scale, factor = 1.0 / self.kernel.length, self.kernel.factor
            loop(targets, sources, *lists, weights, scale, factor, out)

        with limited_threads(self.threads):
            if weights.ndim == 2:
                run(self.loop, weights, out)
            else:
                self._add_in_fours(run, weights, out)

    def _add_in_fours(self, run: Callable, weights: NDArray, out: NDArray) -> None:
        """The same for weights (r, n_in, ns); a last group of two or three is filled up."""
        sources, targets = weights.shape[2], out.shape[2]
        for k in range(0, len(weights), 4):
            taken = min(4, len(weights) - k)
            if taken == 1:
                run(self.loop, weights[k], out[k])
                continue
            four = np.zeros((4 * self.kernel.n_in, sources))
            np.concatenate(weights[k : k + taken], out=four[: taken * self.kernel.n_in])
            sums = np.zeros((4, self.kernel.n_out, targets))
            rows = sums.reshape(4 * self.kernel.n_out, targets)
            run(self._compiled(four=True), four, rows)
            out[k : k + taken] += sums[:taken]

    def _check(self, targets: NDArray, sources: NDArray, weights: NDArray, out: NDArray) -> None:
        kernel = self.kernel
        for name, array, shape in (
            ("targets", targets, (3, targets.shape[-1])),
            ("sources", sources, (3, sources.shape[-1])),
            ("weights", weights, (*weights.shape[:-2], kernel.n_in, sources.shape[-1])),
            ("out", out, (*weights.shape[:-2], kernel.n_out, targets.shape[-1])),
        ):
            if array.shape != shape:
                raise ValueError(f"near field: {name} has the shape {array.shape}, not {shape}")
            if array.dtype != np.float64 or not array.flags.c_contiguous:
                raise ValueError(f"near field: {name} must be float64 and C-contiguous")


@functools.cache
def _loop(
    apply: Callable, n_in: int, n_out: int, real: type, four: bool, threaded: bool, digest: str
) -> Callable:
    """Compile the loop for one kernel and precision.

    numba's disk cache keys a closure by the values it closes over: functions by their names,
    hence the digest of the kernel's source among them.
    """
    zero_in, zero_out = (real(0.0),) * n_in, (real(0.0),) * n_out
    rows, columns = 3 + n_in, _ROW // np.dtype(real).itemsize
    sum_tile = _sum_tile
    if four:
        rows, columns, sum_tile = 3 + 4 * n_in, columns // 2, _sum_tile_of_four

    @numba.njit(cache=True, nogil=True, error_model="numpy", parallel=threaded)
    def near_loop(targets, sources, target_range, start, source_range, weights, scale, factor, out):
        _ = digest
        for g in prange(len(target_range)):
            first, last = target_range[g, 0], target_range[g, 1]
            if first == last:
                continue
            centre = middle(targets, first, last)
            tile = np.empty((rows, columns), real)
            filled = 0
            for k in range(start[g], start[g + 1]):
                begin, end = source_range[k, 0], source_range[k, 1]
                while begin < end:
                    taken = min(end - begin, columns - filled)
                    _gather(sources, weights, begin, taken, centre, scale, tile, filled)
                    begin += taken
                    filled += taken
                    if filled == columns:
                        _fill_up(tile, filled)
                        sum_tile(
                            *(apply, zero_in, zero_out, targets, first, last, centre, scale),
                            *(tile, filled, factor, out),
                        )
                        filled = 0
            if filled > 0:
                _fill_up(tile, filled)
                sum_tile(
                    *(apply, zero_in, zero_out, targets, first, last, centre, scale),
                    *(tile, filled, factor, out),
                )

    return near_loop


@register_jitable
def _gather(sources, weights, begin, count, centre, scale, tile, filled):
    """Copy sources [begin, begin + count) to the columns of the tile from `filled` on."""
    for d in range(3):
        for j in range(count):
            tile[d, filled + j] = (sources[d, begin + j] - centre[d]) * scale
    for c in range(len(weights)):
        for j in range(count):
            tile[3 + c, filled + j] = weights[c, begin + j]


@register_jitable
def _fill_up(tile, filled):
    """Repeat the last source with weight zero up to a whole number of vectors."""
    for j in range(filled, _whole_vectors(tile, filled)):
        tile[:3, j] = tile[:3, filled - 1]
        tile[3:, j] = 0.0


@register_jitable
def _whole_vectors(tile, filled):
    vector = _VECTORS // tile.itemsize
    return -(-filled // vector) * vector


@register_jitable(fastmath=REORDERED)
def _sum_tile(
    apply, zero_in, zero_out, targets, first, last, centre, scale, tile, filled, factor, out
):
    """Add the sums over the first `filled` columns of the tile to targets [first, last)."""
    weights = tile[3:]
    real = tile.dtype.type
    for i in range(first, last):
        x = real((targets[0, i] - centre[0]) * scale)
        y = real((targets[1, i] - centre[1]) * scale)
        z = real((targets[2, i] - centre[2]) * scale)
        total = zero_out
        for j in range(_whole_vectors(tile, filled)):
            w = load_components(weights, j, zero_in)
            k = apply(x - tile[0, j], y - tile[1, j], z - tile[2, j], w)
            total = add_components(total, k)
        for o in range(len(total)):
            out[o, i] += factor * total[o]


@register_jitable(fastmath=REORDERED)
def _sum_tile_of_four(
    apply, zero_in, zero_out, targets, first, last, centre, scale, tile, filled, factor, out
):
    """As `_sum_tile` for four right-hand sides, whose rows stand below each other.

    apply is inlined four times with the same r; the compiler computes what they share once.
    """
    n_in, n_out = len(zero_in), len(zero_out)
    weights_a, weights_b = tile[3 : 3 + n_in], tile[3 + n_in : 3 + 2 * n_in]
    weights_c, weights_d = tile[3 + 2 * n_in : 3 + 3 * n_in], tile[3 + 3 * n_in :]
    real = tile.dtype.type
    for i in range(first, last):
        x = real((targets[0, i] - centre[0]) * scale)
        y = real((targets[1, i] - centre[1]) * scale)
        z = real((targets[2, i] - centre[2]) * scale)
        a = b = c = d = zero_out
        for j in range(_whole_vectors(tile, filled)):
            rx, ry, rz = x - tile[0, j], y - tile[1, j], z - tile[2, j]
            a = add_components(a, apply(rx, ry, rz, load_components(weights_a, j, zero_in)))
            b = add_components(b, apply(rx, ry, rz, load_components(weights_b, j, zero_in)))
            c = add_components(c, apply(rx, ry, rz, load_components(weights_c, j, zero_in)))
            d = add_components(d, apply(rx, ry, rz, load_components(weights_d, j, zero_in)))
        for o in range(n_out):
            out[o, i] += factor * a[o]
            out[n_out + o, i] += factor * b[o]
            out[2 * n_out + o, i] += factor * c[o]
            out[3 * n_out + o, i] += factor * d[o]
