import numpy as np
import pytest

from stokes.fmm.low_rank import (
    LowRank,
    approximate,
    common_range,
    cross_approximation,
    recompressed,
    tail_rank,
)


def slices(matrix):
    return (lambda i: matrix[i]), (lambda j: matrix[:, j])


def cross(matrix, tolerance):
    return cross_approximation(*slices(matrix), matrix.shape, tolerance)


def random_low_rank(m, n, rank, seed=0):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((m, rank)) @ rng.standard_normal((rank, n))


def smooth_matrix(m, n):
    """1/|x - y| between two segments a gap apart: singular values fall exponentially."""
    return 1.0 / (1.5 + np.linspace(0, 1, m)[:, None] + np.linspace(0, 1, n))


@pytest.mark.parametrize(("m", "n"), [(60, 60), (90, 31), (17, 200)])
@pytest.mark.parametrize("rank", [1, 2, 7, 17])
def test_matrix_of_exact_rank_is_found_with_that_rank(m, n, rank):
    matrix = random_low_rank(m, n, rank)
    factors = approximate(*slices(matrix), matrix.shape, 1e-10)
    assert factors.rank == rank
    assert np.linalg.norm(factors.dense() - matrix) <= 1e-10 * np.linalg.norm(matrix)


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (1, 1), (5, 5)])
def test_full_rank_is_reached_and_exact(shape):
    matrix = np.random.default_rng(3).standard_normal(shape)
    factors = cross(matrix, 1e-15)
    assert factors.rank == min(shape)
    # elimination with partial pivots: rounding times the growth of a 5 x 5 matrix
    assert np.abs(factors.dense() - matrix).max() <= 1e-13


@pytest.mark.parametrize("shape", [(8, 8), (1, 5), (40, 3)])
def test_zero_matrix_has_rank_zero(shape):
    factors = approximate(*slices(np.zeros(shape)), shape, 1e-6)
    assert factors.rank == 0
    assert factors.dense().shape == shape
    assert not factors.dense().any()


def test_blocks_that_do_not_couple_are_all_found():
    # The first cross stays in its block: plain partial pivoting would stop when that is done.
    matrix = np.zeros((90, 90))
    for k in range(3):
        some = slice(30 * k, 30 * k + 30)
        matrix[some, some] = 10.0 ** (-k) * smooth_matrix(30, 30)
    factors = approximate(*slices(matrix), matrix.shape, 1e-8)
    assert np.linalg.norm(factors.dense() - matrix) <= 1e-8 * np.linalg.norm(matrix)


def test_matrix_whose_first_row_vanishes_is_found():
    matrix = smooth_matrix(50, 40)
    matrix[0] = 0.0
    factors = approximate(*slices(matrix), matrix.shape, 1e-8)
    assert np.linalg.norm(factors.dense() - matrix) <= 1e-8 * np.linalg.norm(matrix)


@pytest.mark.parametrize("factor", [1e-200, 1.0, 1e100])
def test_tolerance_is_relative_at_every_scale(factor):
    matrix = smooth_matrix(70, 50)
    scaled = factor * matrix
    factors = approximate(*slices(scaled), scaled.shape, 1e-7)
    reference = approximate(*slices(matrix), matrix.shape, 1e-7)
    assert factors.rank == reference.rank
    error = np.linalg.norm(factors.dense() / factor - matrix)
    assert error <= 1e-7 * np.linalg.norm(matrix)


@pytest.mark.parametrize("eps", [1e-3, 1e-6, 1e-9, 1e-12])
def test_error_and_rank_are_those_of_the_singular_values(eps):
    matrix = smooth_matrix(120, 80)
    factors = approximate(*slices(matrix), matrix.shape, eps)
    assert np.linalg.norm(factors.dense() - matrix) <= eps * np.linalg.norm(matrix)
    # at most one more than the best, as a tenth of the tolerance went to the crosses
    best = tail_rank(np.linalg.svd(matrix, compute_uv=False), eps)
    assert best <= factors.rank <= best + 1


def test_rank_grows_as_the_logarithm_of_the_tolerance():
    matrix = smooth_matrix(100, 100)
    ranks = [
        approximate(*slices(matrix), matrix.shape, eps).rank for eps in (1e-2, 1e-4, 1e-6, 1e-8)
    ]
    steps = np.diff(ranks)
    assert (steps >= 1).all()
    assert steps.max() - steps.min() <= 1


def test_recompression_finds_the_rank_of_redundant_factors():
    matrix = random_low_rank(40, 30, 4)
    redundant = LowRank(np.hstack([matrix, matrix]), np.vstack([np.eye(30), np.eye(30)]))
    factors = recompressed(redundant, 1e-10)
    assert factors.rank == 4
    assert np.linalg.norm(factors.dense() - 2 * matrix) <= 2e-10 * np.linalg.norm(matrix)


def test_truncation_drops_no_more_than_the_tolerance():
    sigma = np.array([1.0, 0.1, 0.01, 0.001])
    total = np.linalg.norm(sigma)
    for rank in range(4):
        tail = np.linalg.norm(sigma[rank:]) / total
        assert tail_rank(sigma, 1.001 * tail) == rank
        assert tail_rank(sigma, 0.999 * tail) == rank + 1
    assert tail_rank(np.zeros(3), 1e-3) == 0
    assert tail_rank(np.zeros(0), 1e-3) == 0


@pytest.mark.parametrize("eps", [1e-3, 1e-12])
def test_common_range_holds_all_blocks(eps):
    # 40 blocks: the triangle is folded several times; 1e-12 is out of reach of a Gram matrix
    blocks = [smooth_matrix(30, 30)[:, k % 25 : k % 25 + 5] * (1 + k) for k in range(40)]
    basis = common_range(blocks, eps)
    stacked = np.hstack(blocks)
    assert np.abs(basis.T @ basis - np.eye(basis.shape[1])).max() <= 1e-13
    rest = stacked - basis @ (basis.T @ stacked)
    assert np.linalg.norm(rest) <= 1.001 * eps * np.linalg.norm(stacked)
    assert basis.shape[1] == tail_rank(np.linalg.svd(stacked, compute_uv=False), eps)


def test_common_range_of_nothing_is_empty():
    assert common_range([np.zeros((5, 0))], 1e-3).shape == (5, 0)
    assert common_range([np.zeros((5, 3))], 1e-3).shape == (5, 0)
