"""The sum over all pairs against the kernels' matrices, on one and several ranks."""

from __future__ import annotations

import numpy as np
import pytest

from stokes.fmm.direct import direct_sum
from stokes.fmm.kernels import KERNELS, Kernel, laplace, stokeslet, stokeslet_pressure, stresslet

ROUNDING = 1e-14
"""Of sums of some hundred terms, relative to the norm of the values."""


def _reference(kernel: Kernel, y: np.ndarray, x: np.ndarray, w: np.ndarray) -> np.ndarray:
    r = (x[:, None] - y[None]).reshape(-1, 3)
    k = kernel.matrix(r).reshape(len(x), len(y), kernel.n_out, kernel.n_in)
    return np.einsum("tsoi,si...->to...", k, w)


def _scene(kernel: Kernel, n: int = 400, m: int = 300, rhs: tuple[int, ...] = ()):
    rng = np.random.default_rng(0)
    return rng.random((n, 3)), rng.random((m, 3)), rng.standard_normal((n, kernel.n_in, *rhs))


def _assert_close(a: np.ndarray, b: np.ndarray) -> None:
    assert a.shape == b.shape
    assert np.linalg.norm(a - b) <= ROUNDING * np.linalg.norm(b)


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS.keys())
def test_sum_over_all_pairs(kernel):
    y, x, w = _scene(kernel)
    _assert_close(direct_sum(kernel, y, x, w), _reference(kernel, y, x, w))


@pytest.mark.parametrize("kernel", [laplace, stokeslet], ids=lambda k: k.name)
def test_point_among_its_own_sources_leaves_itself_out(kernel):
    y, _, w = _scene(kernel, 60)
    values = direct_sum(kernel, y, None, w)
    for i in (0, 31, 59):
        others = np.arange(60) != i
        alone = direct_sum(kernel, y[others], y[i : i + 1], w[others])
        _assert_close(values[i : i + 1], alone)


def test_right_hand_sides_are_summed_one_by_one():
    y, x, w = _scene(stresslet, rhs=(3,))
    values = direct_sum(stresslet, y, x, w)
    assert values.shape == (300, 3, 3)
    for k in range(3):
        _assert_close(values[:, :, k], direct_sum(stresslet, y, x, w[:, :, k]))


def test_plain_vectors_for_scalar_kernels():
    y, x, w = _scene(laplace)
    column = direct_sum(laplace, y, x, w)
    np.testing.assert_array_equal(direct_sum(laplace, y, x, w[:, 0]), column[:, 0])
    y, x, w = _scene(stokeslet_pressure)
    assert direct_sum(stokeslet_pressure, y, x, w).shape == (300, 1)


def test_nothing_to_sum():
    none, some = np.zeros((0, 3)), np.ones((2, 3))
    assert direct_sum(stokeslet, none, none, none).shape == (0, 3)
    assert direct_sum(stokeslet, some, none, some).shape == (0, 3)
    np.testing.assert_array_equal(direct_sum(stokeslet, none, some, none), np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("sources", "weights", "message"),
    [
        (np.zeros((4, 2)), np.zeros(4), "sources of shape"),
        (np.zeros((4, 3)), np.zeros((4, 2)), "weights of shape"),
        (np.zeros((4, 3)), np.zeros(5), "weights of shape"),
    ],
)
def test_wrong_shapes_are_refused(sources, weights, message):
    with pytest.raises(ValueError, match=message):
        direct_sum(laplace, sources, None, weights)


@pytest.mark.parametrize("rhs", [(), (2,)])
@pytest.mark.mpi(ranks=[1, 2, 3])
def test_ranks_agree_with_one_rank(parallel, rhs):
    """Uneven shares; the last rank has no points where there are several."""
    y, x, w = _scene(stokeslet, rhs=rhs)
    shares = max(1, parallel.size - 1)
    mine = np.arange(400) % 7 % shares == parallel.rank
    here = np.arange(300) % 5 % shares == parallel.rank
    values = direct_sum(stokeslet, y[mine], x[here], w[mine], parallel)
    _assert_close(values, _reference(stokeslet, y, x[here], w))


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_wrong_input_on_one_rank_is_everyones_error(parallel):
    width = 2 if parallel.rank == parallel.size - 1 else 3
    with pytest.raises(ValueError, match="sources of shape"):
        direct_sum(laplace, np.zeros((4, width)), None, np.zeros(4), parallel)
