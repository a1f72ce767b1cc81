"""Ranks of a tensor train brought down to what an error allows (D algorithm 4.2).

D: S. De, PhD thesis, University of Michigan 2021, chapter 4.

Symbols: X the train given, Y the rounded one, d dimensions, r_k ranks, u unit round-off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from compress.tensor_train import TensorTrain, normalized, scaled

_U = float(np.finfo(np.float64).eps) / 2.0
_U32 = float(np.finfo(np.float32).eps) / 2.0
# Rounding errors of one factorisation, in units of u sqrt(length of its sums).
_STEP = 4.0


@dataclass(frozen=True)
class Rounded:
    """A rounded train and what it cost.

    train : Y; error : a bound of ||X - Y||_F, rounding errors included; norm : ||X||_F. Both are
    infinite where they exceed float64.
    """

    train: TensorTrain
    error: float
    norm: float


def round_train(
    train: TensorTrain,
    tolerance: float | None = None,
    max_rank: int | Sequence[int] | None = None,
    absolute: float | None = None,
) -> Rounded:
    """The train of lower ranks within ||X - Y||_F <= tolerance ||X||_F, or <= absolute.

    Without either, what lies below rounding errors is dropped. `max_rank`, one for all or one for
    each of the d - 1 bonds, is kept whatever the error, which `error` then states.

    The d - 1 truncations are orthogonal projections one within the other, so that their errors
    add as squares; each may use an equal share of what is left of the square of the allowed
    error, which passes on what earlier ones did not use.

    Rounding errors are part of the bound: all is computed in float64, and what the sweeps and the
    conversion to float32 may add is taken off the allowed error beforehand (`_Sweep.noise`; u32
    ||X||_F for each core, whose columns are weighted by the singular values). An allowed error
    below them cannot be met: then only as much as they hide is dropped, and `error` says so.

    A train none of whose ranks falls is returned itself, with error 0. Rounding is so idempotent,
    bit by bit, wherever ranks or a gap in the singular values decide: only where singular values
    lie close below the tolerance can a second call, which may spend the tolerance anew, drop more.

    Raises ValueError for both errors at once, a negative one, or ranks below 1.
    """
    caps = _caps(max_rank, train.ndim)
    if tolerance is not None and absolute is not None:
        raise ValueError("tolerance and absolute: only one of them can be given")
    for name, value in (("tolerance", tolerance), ("absolute", absolute)):
        if value is not None and not value >= 0.0:
            raise ValueError(f"{name} = {value}: must be >= 0")

    sweep = _orthogonalized(train)
    if sweep.norm == 0.0:
        return Rounded(_zero_like(train), 0.0, 0.0)
    if absolute is not None:
        allowed = _ldexp(absolute, -sweep.exponent)
    else:
        allowed = (tolerance or 0.0) * sweep.norm
    fixed = sweep.noise
    if train.dtype == np.float32:
        fixed += train.ndim * _U32 * sweep.norm
    cores, dropped = _truncated(sweep.cores, max(allowed - fixed, fixed), caps)
    if any(core.shape[0] > core[0].size for core in cores):
        # A bond next to a short dimension that was cut less than the one behind it.
        cores, _ = _truncated(_right_orthogonal(cores), 0.0, caps)

    norm = _ldexp(sweep.norm, sweep.exponent)
    if all(new.shape == old.shape for new, old in zip(cores, train.cores, strict=True)):
        return Rounded(train, 0.0, norm)
    rounded = _in_dtype(cores, sweep.exponent, train.dtype)
    return Rounded(rounded, _ldexp(dropped + fixed, sweep.exponent), norm)


def orthogonalize(train: TensorTrain, centre: int = 0) -> TensorTrain:
    """The same tensor with all cores but `centre` orthogonal.

    Core k < centre, as a matrix r_{k-1} n_k x r_k, then has orthonormal columns; k > centre, as
    r_{k-1} x n_k r_k, orthonormal rows; ||X||_F is the norm of core `centre`. Ranks fall where
    they exceed the sides of these matrices, never by truncation. Computed in float64.
    """
    centre = range(train.ndim)[centre]
    sweep = _orthogonalized(train)
    if sweep.norm == 0.0:
        return _zero_like(train)
    cores = list(sweep.cores)
    for k in range(centre):
        rank, n, _ = cores[k].shape
        q, r = np.linalg.qr(cores[k].reshape(rank * n, -1))
        cores[k] = q.reshape(rank, n, -1)
        cores[k + 1] = np.tensordot(r, cores[k + 1], axes=(1, 0))
    cores[centre] = np.ldexp(cores[centre], sweep.exponent)
    return TensorTrain(tuple(cores)).astype(train.dtype)


def kept_rank(singular_values: NDArray, allowed: float) -> tuple[int, float]:
    """The least rank whose dropped singular values have a root sum of squares <= allowed.

    singular_values : falling. Returns the rank, at least 1, and what is dropped.
    """
    if singular_values.size == 0:
        return 1, 0.0
    tails = np.sqrt(np.cumsum(singular_values[::-1] ** 2)[::-1])
    rank = max(1, int(np.count_nonzero(tails > allowed)))
    return rank, float(tails[rank]) if rank < tails.size else 0.0


def svd(matrix: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """U, s, V^T of a matrix, by the slower method where the faster one does not converge."""
    try:
        return scipy.linalg.svd(matrix, full_matrices=False, check_finite=False)
    except np.linalg.LinAlgError:
        return scipy.linalg.svd(
            matrix, full_matrices=False, check_finite=False, lapack_driver="gesvd"
        )


@dataclass(frozen=True)
class _Sweep:
    """X / 2^exponent with cores 2 ... d of orthonormal rows, in float64.

    norm : ||X||_F / 2^exponent, in 1/2 ... 1 or 0.
    noise : what rounding errors of this sweep and of the next may amount to, over 2^exponent.

    A Householder factorisation changes each row m_j of its matrix by a few u ||m_j|| at most
    (N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2002, theorem 19.4), the factor
    being that of sums whose rounding errors are independent (N. J. Higham and T. Mary, SIAM J.
    Sci. Comput. 41, 2019), and row j meets column l_j of the product of the cores on its left:

        noise^2 = sum_k (4 u)^2 n_k r_k (sum_j ||l_j||^2 ||m_j||^2 + 3 ||X||^2),

    which holds for trains that are small differences of large ones too. ||l_j||^2 is the diagonal
    of the Gram matrix of the left cores. The second term is that of the truncations and of two
    sweeps that may follow, whose matrices have the norm of X.
    """

    cores: tuple[NDArray, ...]
    exponent: int
    norm: float
    noise: float


def _orthogonalized(train: TensorTrain) -> _Sweep:
    cores, exponents = zip(
        *(normalized(core.astype(np.float64, copy=False)) for core in train.cores), strict=True
    )
    columns = _column_norms(cores)
    cores, exponent = list(cores), sum(exponents)
    terms: list[tuple[float, int, int]] = []  # (root of the sum over j, its exponent, n_k r_k)
    shift = 0
    for k in range(train.ndim - 1, 0, -1):
        matrix = cores[k].reshape(cores[k].shape[0], -1)
        left, left_exponent = columns[k - 1]
        rows = np.linalg.norm(matrix, axis=1)
        terms.append((float(np.linalg.norm(left * rows)), left_exponent + shift, matrix.shape[1]))
        # D 4.2, line 5; r'_{k-1}, the smaller side of the matrix, is what the next core sees.
        q, r = _lq(matrix)
        cores[k] = q.reshape(q.shape[0], *cores[k].shape[1:])
        cores[k - 1], more = normalized(cores[k - 1] @ r)
        shift += more
    norm = float(np.linalg.norm(cores[0]))
    terms.append((norm, shift, cores[0].size))
    noise = math.hypot(
        *(
            _STEP
            * _U
            * math.sqrt(length)
            * math.hypot(_ldexp(value, e - shift), math.sqrt(3.0) * norm)
            for value, e, length in terms
        )
    )
    return _Sweep(tuple(cores), exponent + shift, norm, noise)


def _right_orthogonal(cores: Sequence[NDArray]) -> list[NDArray]:
    """The same tensor with orthonormal rows in all cores but the first."""
    cores = list(cores)
    for k in range(len(cores) - 1, 0, -1):
        q, r = _lq(cores[k].reshape(cores[k].shape[0], -1))
        cores[k] = q.reshape(q.shape[0], *cores[k].shape[1:])
        cores[k - 1] = cores[k - 1] @ r
    return cores


def _lq(matrix: NDArray) -> tuple[NDArray, NDArray]:
    """(Q, L) of matrix = L Q with orthonormal rows of Q; zeros of one row without columns."""
    if matrix.shape[1] == 0:
        return np.zeros((1, 0)), np.zeros((matrix.shape[0], 1))
    q, r = np.linalg.qr(matrix.T)
    return q.T, r.T


def _column_norms(cores: Sequence[NDArray]) -> list[tuple[NDArray, int]]:
    """For each core but the first, the norms of the columns of the product of those before it.

    As (m, e), norms m 2^e, from Gram matrices G_k = sum_i X_k(i)^T G_{k-1} X_k(i).
    """
    gram, exponent = np.ones((1, 1)), 0
    result = []
    for core in cores[:-1]:
        gram = np.tensordot(core, np.tensordot(gram, core, axes=(1, 0)), axes=((0, 1), (0, 1)))
        _, shift = normalized(gram)
        half = shift // 2
        exponent += half
        gram = np.ldexp(gram, -2 * half)
        result.append((np.sqrt(np.maximum(np.diagonal(gram), 0.0)), exponent))
    return result


def _truncated(
    cores: Sequence[NDArray], allowed: float, caps: Sequence[int | None]
) -> tuple[list[NDArray], float]:
    """The sweep of truncations from left to right (D 4.2, lines 12-20), and the error it makes."""
    cores = list(cores)
    left, dropped = allowed**2, 0.0
    for k, cap in enumerate(caps):
        rank, n, _ = cores[k].shape
        U, sigma, Vt = svd(cores[k].reshape(rank * n, -1))
        kept, lost = kept_rank(sigma, math.sqrt(left / (len(caps) - k)))
        if cap is not None and kept > cap:
            kept, lost = cap, float(np.linalg.norm(sigma[cap:]))
        cores[k] = U[:, :kept].reshape(rank, n, kept)
        # Lines 17 and 18, with r'_k for the first rank of the next core.
        cores[k + 1] = np.tensordot(sigma[:kept, None] * Vt[:kept], cores[k + 1], axes=(1, 0))
        left = max(left - lost**2, 0.0)
        dropped += lost**2
    return cores, math.sqrt(dropped)


def _in_dtype(cores: Sequence[NDArray], exponent: int, dtype: np.dtype) -> TensorTrain:
    """2^exponent times the train of these cores, in `dtype`."""
    narrow = TensorTrain(tuple(core.astype(dtype) for core in cores))
    return scaled(narrow, exponent)


def _zero_like(train: TensorTrain) -> TensorTrain:
    if all(rank == 1 for rank in train.ranks):
        return train
    return TensorTrain(tuple(np.zeros((1, n, 1), dtype=train.dtype) for n in train.shape))


def _caps(max_rank: int | Sequence[int] | None, d: int) -> list[int | None]:
    if max_rank is None or isinstance(max_rank, int | np.integer):
        caps = [max_rank] * (d - 1)
    else:
        caps = list(max_rank)
    if len(caps) != d - 1:
        raise ValueError(f"max_rank of {len(caps)} ranks: must be {d - 1}, one for each bond")
    if any(cap is not None and cap < 1 for cap in caps):
        raise ValueError(f"max_rank = {max_rank}: must be at least 1")
    return caps


def _ldexp(value: float, exponent: int) -> float:
    try:
        return math.ldexp(value, exponent)
    except OverflowError:
        return math.inf
