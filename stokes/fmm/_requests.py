"""What users hand in: brought to one form, and refused on all ranks before any other exchange."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.parallel import Parallel
from stokes.fmm.kernels import Kernel


@contextmanager
def raised_together(parallel: Parallel | None) -> Iterator[None]:
    """Collective. An error of the block on one rank is raised on all; None for this rank alone."""
    error = None
    try:
        yield
    except Exception as fault:
        if parallel is None:
            raise
        error = fault
    if parallel is not None:
        parallel.raise_together(error)


def checked_points(name: str, points: ArrayLike) -> NDArray[np.float64]:
    """Points as a contiguous array (n, 3). Raises ValueError for others, and for infinite ones."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} of shape {array.shape}: must be (n, 3)")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: coordinates must be finite")
    return array


def columns_of(
    kernel: Kernel, weights: ArrayLike, n: int, parallel: Parallel | None
) -> NDArray[np.float64]:
    """Collective. Weights (n,), (n, n_in) or (n, n_in, r) as (n, n_in, r).

    Raises ValueError, on all ranks, for other shapes and complex numbers on one of them, and where
    ranks have different numbers of right-hand sides.
    """
    with raised_together(parallel):
        columns = _as_columns(kernel, weights, n)
    if parallel is not None and parallel.size > 1:
        r = columns.shape[2]
        most, least = parallel.max(np.array([r, -r])) * np.array([1, -1])
        if most != least:
            raise ValueError(f"weights: {least} to {most} right-hand sides, not equal on all ranks")
    return columns


def _as_columns(kernel: Kernel, weights: ArrayLike, n: int) -> NDArray[np.float64]:
    if np.iscomplexobj(weights):
        raise ValueError("weights are complex: give real and imaginary part as right-hand sides")
    array = np.asarray(weights, dtype=np.float64)
    if array.shape == (n,) and kernel.n_in == 1:
        return array[:, None, None]
    if array.ndim in (2, 3) and array.shape[:2] == (n, kernel.n_in):
        return array if array.ndim == 3 else array[:, :, None]
    raise ValueError(
        f"weights of shape {array.shape}: kernel {kernel.name} over {n} sources "
        f"takes ({n}, {kernel.n_in}) or ({n}, {kernel.n_in}, r)"
    )


def as_given(kernel: Kernel, weights: ArrayLike, values: NDArray) -> NDArray:
    """Values (m, n_out, r) as (m, n_out, r), (m, n_out) or (m,), as the weights were given."""
    rank = np.ndim(weights)
    if rank == 3:
        return values
    return values[:, 0, 0] if rank == 1 and kernel.n_out == 1 else values[:, :, 0]
