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
from numpy.typing import NDArray

from stokes.fmm._intrinsics import add_components, load_components
from stokes.fmm.kernels import Kernel, digest

_REORDERED = {"reassoc", "contract", "nsz", "arcp"}
_TILE = 512  # sources of a tile: 6 rows of doubles take 24 KiB
_VECTOR = 32  # a tile's length is a multiple of it: 4 vectors of 8 doubles


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
        self._loop = _loop(
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
        self._loop(
            targets,
            target_range,
            sources,
            weights,
            start,
            source_range,
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
    gather, sum_tile = _gather(n_in, real), _sum_tile(apply, n_in, n_out, real, digest)

    @numba.njit(cache=True, nogil=True, error_model="numpy", parallel=threaded)
    def near_loop(targets, target_range, sources, weights, start, source_range, scale, factor, out):
        for g in prange(len(target_range)):
            first, last = target_range[g, 0], target_range[g, 1]
            if first == last:
                continue
            centre = np.empty(3)
            for d in range(3):
                centre[d] = 0.5 * (targets[d, first:last].min() + targets[d, first:last].max())
            tile = np.empty((3 + n_in, _TILE), real)
            filled = 0
            for k in range(start[g], start[g + 1]):
                begin, end = source_range[k, 0], source_range[k, 1]
                while begin < end:
                    taken = min(end - begin, _TILE - filled)
                    gather(sources, weights, begin, taken, centre, scale, tile, filled)
                    begin += taken
                    filled += taken
                    if filled == _TILE:
                        sum_tile(targets, first, last, centre, scale, tile, filled, factor, out)
                        filled = 0
            if filled > 0:
                sum_tile(targets, first, last, centre, scale, tile, filled, factor, out)

    return near_loop


@functools.cache
def _gather(n_in: int, real: type) -> Callable:
    @numba.njit(nogil=True, error_model="numpy", fastmath=_REORDERED)
    def gather(sources, weights, begin, count, centre, scale, tile, filled):
        """Copy sources [begin, begin + count) to the columns of the tile from `filled` on."""
        for d in range(3):
            for j in range(count):
                tile[d, filled + j] = real((sources[d, begin + j] - centre[d]) * scale)
        for c in range(n_in):
            for j in range(count):
                tile[3 + c, filled + j] = real(weights[c, begin + j])

    return gather


@functools.cache
def _sum_tile(apply: Callable, n_in: int, n_out: int, real: type, digest: str) -> Callable:
    @numba.njit(nogil=True, error_model="numpy", fastmath=_REORDERED)
    def sum_tile(targets, first, last, centre, scale, tile, filled, factor, out):
        """Add the sums over the first `filled` columns of the tile to targets [first, last)."""
        _ = digest
        count = -(-filled // _VECTOR) * _VECTOR
        for j in range(filled, count):
            for d in range(3):
                tile[d, j] = tile[d, filled - 1]
            for c in range(n_in):
                tile[3 + c, j] = real(0.0)
        weights = tile[3:]
        zero = load_components(np.zeros((n_out, 1), real), 0, n_out)
        for i in range(first, last):
            x = real((targets[0, i] - centre[0]) * scale)
            y = real((targets[1, i] - centre[1]) * scale)
            z = real((targets[2, i] - centre[2]) * scale)
            total = zero
            for j in range(count):
                r = (x - tile[0, j], y - tile[1, j], z - tile[2, j])
                w = load_components(weights, j, n_in)
                total = add_components(total, apply(r[0], r[1], r[2], w))
            for o in range(n_out):
                out[o, i] += factor * total[o]

    return sum_tile
