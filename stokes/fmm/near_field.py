"""Sums over pairs of near groups: every target of a group with every source of its listed groups.

For each group of targets the sources of its list are copied, a tile at a time, into a contiguous
buffer that stays in the first-level cache; the loop over a tile vectorises and has no remainder,
because a tile is filled up with sources of weight zero. The same loop serves three lists of the
fast multipole method: points on points, multipoles (grid nodes as sources) on points, and points
on locals (grid nodes as targets).

Arithmetic: sums may be reordered and products contracted (`_REORDERED`), which the vector units
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

from stokes.fmm._intrinsics import add_components, load_components
from stokes.fmm.kernels import Kernel, digest

_REORDERED = {"reassoc", "contract", "nsz", "arcp"}
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
        self.loop = _loop(
            kernel.apply,
            kernel.n_in,
            kernel.n_out,
            np.float32 if self.single else np.float64,
            threads > 1,
            digest(kernel.apply),
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
        C-contiguous. target_range (k, 2): [begin, end) of each group; its list is
        source_range[start[g]:start[g + 1]], rows [begin, end) of sources; start (k + 1,).
        Groups of targets must not overlap if there is more than one thread.
        """
        self._check(targets, sources, weights, out)
        if self.threads > 1:
            numba.set_num_threads(min(self.threads, numba.config.NUMBA_NUM_THREADS))
        self.loop(
            targets,
            np.ascontiguousarray(target_range, np.int64),
            sources,
            weights,
            np.ascontiguousarray(start, np.int64),
            np.ascontiguousarray(source_range, np.int64),
            1.0 / self.kernel.length,
            self.kernel.factor,
            out,
        )

    def _check(self, targets: NDArray, sources: NDArray, weights: NDArray, out: NDArray) -> None:
        kernel = self.kernel
        for name, array, shape in (
            ("targets", targets, (3, targets.shape[-1])),
            ("sources", sources, (3, sources.shape[-1])),
            ("weights", weights, (kernel.n_in, sources.shape[-1])),
            ("out", out, (kernel.n_out, targets.shape[-1])),
        ):
            if array.shape != shape:
                raise ValueError(f"near field: {name} has the shape {array.shape}, not {shape}")
            if array.dtype != np.float64 or not array.flags.c_contiguous:
                raise ValueError(f"near field: {name} must be float64 and C-contiguous")


@functools.cache
def _loop(
    apply: Callable, n_in: int, n_out: int, real: type, threaded: bool, digest: str
) -> Callable:
    """Compile the loop for one kernel and precision.

    numba's disk cache keys a closure by the values it closes over: functions by their names,
    hence the digest of the kernel's source among them.
    """
    zero_in, zero_out = (real(0.0),) * n_in, (real(0.0),) * n_out
    rows, columns = 3 + n_in, _ROW // np.dtype(real).itemsize

    @numba.njit(cache=True, nogil=True, error_model="numpy", parallel=threaded)
    def near_loop(targets, target_range, sources, weights, start, source_range, scale, factor, out):
        _ = digest
        for g in prange(len(target_range)):
            first, last = target_range[g, 0], target_range[g, 1]
            if first == last:
                continue
            centre = (
                _middle(targets[0], first, last),
                _middle(targets[1], first, last),
                _middle(targets[2], first, last),
            )
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
                        _sum_tile(
                            *(apply, zero_in, zero_out, targets, first, last, centre, scale),
                            *(tile, filled, factor, out),
                        )
                        filled = 0
            if filled > 0:
                _fill_up(tile, filled)
                _sum_tile(
                    *(apply, zero_in, zero_out, targets, first, last, centre, scale),
                    *(tile, filled, factor, out),
                )

    return near_loop


@register_jitable
def _middle(values, first, last):
    """Middle of the smallest and largest of values [first, last)."""
    low = high = values[first]
    for i in range(first + 1, last):
        low, high = min(low, values[i]), max(high, values[i])
    return 0.5 * (low + high)


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


@register_jitable(fastmath=_REORDERED)
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
