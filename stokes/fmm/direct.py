"""The sum over all pairs, O(n m): the reference of the fast methods, and best for few points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.parallel import Parallel
from stokes.fmm._requests import as_given, checked_points, columns_of, raised_together
from stokes.fmm.kernels import Kernel
from stokes.fmm.near_field import NearField

_GROUP = 256  # targets of a group


def direct_sum(
    kernel: Kernel,
    sources: ArrayLike,
    targets: ArrayLike | None,
    weights: ArrayLike,
    parallel: Parallel | None = None,
    threads: int = 1,
) -> NDArray:
    """phi_i = sum_j k(x_i - y_j) w_j over all sources, in double precision.

    Collective over `parallel` if one is given: every rank brings its own sources, weights and
    targets and gets the values at its own targets; one rank's sources are held at a time.

    sources (n, 3), targets (m, 3) or None for the sources themselves; weights (n, n_in),
    (n, n_in, r) for r right-hand sides, or (n,) if n_in = 1. Returns (m, n_out), (m, n_out, r),
    or (m,) if weights are (n,) and n_out = 1. A singular kernel counts 0 at coincident points.

    Raises ValueError, on all ranks, for other shapes and points that are not finite.
    """
    with raised_together(parallel):
        y = checked_points("sources", sources)
        x = y if targets is None else checked_points("targets", targets)
    w = columns_of(kernel, weights, len(y), parallel)
    out = np.zeros((w.shape[2], kernel.n_out, len(x)))
    near = NearField(kernel, threads=threads)
    groups = _groups(len(x))
    for block_y, block_w in _blocks(y, w, parallel):
        _add(near, np.ascontiguousarray(x.T), groups, block_y, block_w, out)
    return as_given(kernel, weights, np.ascontiguousarray(out.transpose(2, 1, 0)))


def _groups(m: int) -> NDArray:
    begin = np.arange(0, m, _GROUP, dtype=np.int64)
    return np.stack([begin, np.minimum(begin + _GROUP, m)], axis=1)


def _blocks(y: NDArray, w: NDArray, parallel: Parallel | None) -> Iterator[tuple[NDArray, NDArray]]:
    """Sources and weights of one rank after another, in rank order on all of them."""
    if parallel is None or parallel.size == 1:
        yield y, w
        return
    for rank in range(parallel.size):
        yield parallel.broadcast((y, w) if rank == parallel.rank else None, root=rank)


def _add(
    near: NearField, x: NDArray, groups: NDArray, y: NDArray, w: NDArray, out: NDArray
) -> None:
    start = np.arange(len(groups) + 1, dtype=np.int64)
    everything = np.tile(np.array([[0, len(y)]], dtype=np.int64), (len(groups), 1))
    weights = np.ascontiguousarray(w.transpose(2, 1, 0))
    near.add(x, groups, np.ascontiguousarray(y.T), weights, start, everything, out)
