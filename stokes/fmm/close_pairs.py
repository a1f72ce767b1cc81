"""Pairs too close for single precision: their difference is rounded away before it is taken.

Coordinates are rounded relative to the middle of a group of targets, to about 1e-8 of the group's
extent: what is left of the difference of two points 1e-6 of the extent apart has two digits, and
points closer than that may coincide. One such pair can outweigh the rest of the sum. They are
found once, when the plan is made, and every application replaces what the loop in single
precision adds for them by the same in double.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numba
import numpy as np
from numba import prange
from numba.extending import register_jitable
from numpy.typing import NDArray

from dem_mpi._jit import jit, jit_threads
from stokes.fmm._intrinsics import load_components, middle
from stokes.fmm.kernels import Kernel, digest

# Standard deviation of the rounded distance of two points, as a part of the group's extent, is
# 2^-26 sqrt(2/3): closer pairs than this over the error have less than half of the asked digits.
_ROUNDED = 2.0**-25
# Beyond this distance a pair is one of many: their independent errors average out.
_FARTHEST = 2.0**-5


def close_distance(eps: float) -> float:
    """Distance, as a part of a group's extent, below which a pair in single misses eps."""
    return min(_ROUNDED / eps, _FARTHEST)


class ClosePairs:
    """Corrections of the near field in single precision, for one kernel and fixed points."""

    def __init__(
        self,
        kernel: Kernel,
        targets: NDArray,
        target_range: NDArray,
        sources: NDArray,
        start: NDArray,
        source_range: NDArray,
        *,
        distance: float,
        threads: int = 1,
    ) -> None:
        """Find the pairs closer than `distance` times the extent of the target's group.

        Other arguments as of `NearField` and its `add`. Only sources in the box of a group's
        targets are compared with them: a 27th part of the pairs of an even cloud.
        """
        self.kernel = kernel
        self._points = (targets, sources)
        lists = [np.ascontiguousarray(a, np.int64) for a in (target_range, start, source_range)]
        find = _find.using(threads)
        none = np.empty((0, 2), np.int64)
        first = np.zeros(len(target_range) + 1, np.int64)
        find(targets, sources, *lists, distance, first, none, True)
        first = np.cumsum(first)
        pairs = np.empty((first[-1], 2), np.int64)
        find(targets, sources, *lists, distance, first, pairs, False)
        self._pairs = pairs
        self._centre = _centres(targets, lists[0], first)

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self._pairs)

    @property
    def nbytes(self) -> int:
        """Memory of the pairs."""
        return self._pairs.nbytes + self._centre.nbytes

    def correct(self, weights: NDArray, out: NDArray) -> None:
        """Add the difference of double and single for weights (r, n_in, ns) to out (r, n_out, nt).

        Without r for one right-hand side.
        """
        if len(self._pairs) == 0:
            return
        kernel = self.kernel
        loop = _correction(kernel.apply, kernel.n_in, kernel.n_out, digest(kernel.apply))
        columns = zip(weights, out, strict=True) if weights.ndim == 3 else [(weights, out)]
        for w, values in columns:
            scale = 1.0 / kernel.length
            loop(*self._points, self._pairs, self._centre, w, scale, kernel.factor, values)


@jit_threads
def _find(targets, sources, target_range, start, source_range, distance, first, pairs, counting):
    """Count the close pairs of group g in first[g + 1], or put them in pairs from first[g] on."""
    for g in prange(len(target_range)):
        begin, end = target_range[g, 0], target_range[g, 1]
        if begin == end or (not counting and first[g] == first[g + 1]):
            continue
        low, high, reach = _box(targets, begin, end, distance)
        found = 0
        for k in range(start[g], start[g + 1]):
            for j in range(source_range[k, 0], source_range[k, 1]):
                x, y, z = sources[0, j], sources[1, j], sources[2, j]
                if not (
                    (low[0] <= x <= high[0])
                    and (low[1] <= y <= high[1])
                    and (low[2] <= z <= high[2])
                ):
                    continue
                if counting:
                    found += _count(targets, begin, end, x, y, z, reach)
                    continue
                for i in range(begin, end):
                    if _is_close(targets[0, i] - x, targets[1, i] - y, targets[2, i] - z, reach):
                        pairs[first[g] + found, 0] = i
                        pairs[first[g] + found, 1] = j
                        found += 1
        if counting:
            first[g + 1] = found


@register_jitable
def _is_close(x, y, z, reach):
    """Whether a pair is closer than `reach` but does not coincide."""
    r2 = x * x + y * y + z * z
    return (r2 > 0.0) & (r2 < reach * reach)


@register_jitable
def _count(targets, begin, end, x, y, z, reach):
    """Number of targets [begin, end) close to a point."""
    found = 0
    for i in range(begin, end):
        found += _is_close(targets[0, i] - x, targets[1, i] - y, targets[2, i] - z, reach)
    return found


@register_jitable
def _box(targets, begin, end, distance):
    """Lowest and highest coordinates, widened by the reach, and the reach itself."""
    low = high = (targets[0, begin], targets[1, begin], targets[2, begin])
    for i in range(begin + 1, end):
        x, y, z = targets[0, i], targets[1, i], targets[2, i]
        low = (min(low[0], x), min(low[1], y), min(low[2], z))
        high = (max(high[0], x), max(high[1], y), max(high[2], z))
    reach = distance * max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    return (
        (low[0] - reach, low[1] - reach, low[2] - reach),
        (high[0] + reach, high[1] + reach, high[2] + reach),
        reach,
    )


@jit
def _centres(targets: NDArray, target_range: NDArray, first: NDArray) -> NDArray:
    """Middle of the group of every pair (n, 3), the same that the loop over pairs takes."""
    centre = np.empty((first[-1], 3))
    for g in range(len(target_range)):
        if first[g] < first[g + 1]:
            x, y, z = middle(targets, target_range[g, 0], target_range[g, 1])
            for p in range(first[g], first[g + 1]):
                centre[p, 0], centre[p, 1], centre[p, 2] = x, y, z
    return centre


@functools.cache
def _correction(apply: Callable, n_in: int, n_out: int, digest: str) -> Callable:
    """Compile the loop over close pairs for one kernel; its disk cache knows the digest."""
    single = np.float32
    zero, zero_single = (0.0,) * n_in, (single(0.0),) * n_in

    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def correct(targets, sources, pairs, centre, weights, scale, factor, out):
        _ = digest
        w, w_single = np.empty((n_in, 1)), np.empty((n_in, 1), single)
        for p in range(len(pairs)):
            i, j = pairs[p, 0], pairs[p, 1]
            for c in range(n_in):
                w[c, 0] = weights[c, j]
                w_single[c, 0] = weights[c, j]
            exact = apply(
                (targets[0, i] - sources[0, j]) * scale,
                (targets[1, i] - sources[1, j]) * scale,
                (targets[2, i] - sources[2, j]) * scale,
                load_components(w, 0, zero),
            )
            rounded = apply(
                _rounded(targets[0, i], sources[0, j], centre[p, 0], scale),
                _rounded(targets[1, i], sources[1, j], centre[p, 1], scale),
                _rounded(targets[2, i], sources[2, j], centre[p, 2], scale),
                load_components(w_single, 0, zero_single),
            )
            for o in range(n_out):
                out[o, i] += factor * (exact[o] - rounded[o])

    return correct


@register_jitable
def _rounded(x, y, centre, scale):
    """The difference as the loop in single precision takes it."""
    return np.float32((x - centre) * scale) - np.float32((y - centre) * scale)
