"""TT-SVD keeps to its tolerance, finds ranks that are there, and says what it did."""

import math
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from compress.bounds import measure, norm
from compress.decompose import DIRECTIONS, METHODS, plan, tt_svd
from compress.factors import GRAM_FLOOR, gram_factor, qr_factor
from compress.randomised import randomised_factor
from compress.tensor_train import TensorTrain
from compress.unfolding import BLOCK, Unfolding, survey


def expanded(train):
    """The tensor of a train in float64, whatever the dtype of its cores."""
    return TensorTrain(tuple(core.astype(np.float64) for core in train.cores)).full()


def error_of(found, values):
    return measure(values, expanded(found.train)).frobenius


def low_rank(generator, shape, rank):
    """A tensor of those ranks, as far as its shape lets them be; entries of about 1."""
    ranks = [1]
    for n in shape[:-1]:
        ranks.append(min(ranks[-1] * n, rank))
    ranks.append(1)
    for k in range(len(shape) - 1, 0, -1):
        ranks[k] = min(ranks[k], ranks[k + 1] * shape[k])
    cores = [
        generator.standard_normal((ranks[k], n, ranks[k + 1])) / math.sqrt(ranks[k + 1])
        for k, n in enumerate(shape)
    ]
    return TensorTrain(tuple(cores)).full(), tuple(ranks)


def noisy(generator, shape, rank, noise):
    """Of that rank and norm 1, with noise of that norm."""
    X, _ = low_rank(generator, shape, rank)
    E = generator.standard_normal(shape)
    return X / norm(X) + E * (noise / norm(E))


def with_singular_values(generator, s, rows, columns):
    U = np.linalg.qr(generator.standard_normal((rows, len(s))))[0]
    V = np.linalg.qr(generator.standard_normal((columns, len(s))))[0]
    return (U * s) @ V.T


# ---- S. De, Table 4.1 ----------------------------------------------------------------------


def kernel_tensor(depth, levels):
    """log(1 / (|x - y| + 1e-5)) on uniform nodes, rows and columns in interlaced binary levels."""
    x = np.linspace(0.0, 1.0, 2**depth)
    K = -np.log(np.abs(x[:, None] - x) + 1e-5)
    sides = [2] * (levels - 1) + [2 ** (depth - levels + 1)]
    order = [axis for k in range(levels) for axis in (k, levels + k)]
    return K, K.reshape(sides + sides).transpose(order).reshape([n * n for n in sides]), sides


def kernel_matrix(tensor, sides):
    levels = len(sides)
    order = [*range(0, 2 * levels, 2), *range(1, 2 * levels, 2)]
    side = math.prod(sides)
    return tensor.reshape([n for m in sides for n in (m, m)]).transpose(order).reshape(side, side)


def spectral_norm(A):
    last = len(A) - 1
    return math.sqrt(scipy.linalg.eigvalsh(A.T @ A, subset_by_index=(last, last))[0])


TABLE = {  # levels: {tolerance: (compression ratio, spectral error)}
    6: {1e-2: (191, 0.42), 1e-5: (117, 2.3e-3), 1e-8: (83, 2.4e-7), 1e-11: (69, 1.1e-9)},
    8: {1e-2: (1360, 1.5), 1e-5: (596, 1.1e-3), 1e-8: (357, 3.5e-7), 1e-11: (270, 1.1e-9)},
    10: {1e-2: (1550, 0.74), 1e-5: (654, 1.1e-3), 1e-8: (392, 3.5e-7), 1e-11: (296, 1.1e-9)},
}


@pytest.mark.parametrize("levels", TABLE)
def test_integral_kernel_compresses_as_in_table_4_1(levels):
    K, X, sides = kernel_tensor(10, levels)
    for tolerance, (ratio, error) in TABLE[levels].items():
        found = tt_svd(X, tolerance, method="qr", direction="left", carry=False)
        difference = K - kernel_matrix(found.train.full(), sides)
        # All digits of the reference values, three and two.
        assert K.size / found.train.parameters == pytest.approx(ratio, rel=5e-3, abs=0.5)
        assert spectral_norm(difference) == pytest.approx(error, rel=0.049)
        assert norm(difference) <= tolerance * norm(K)


@pytest.mark.parametrize(
    ("levels", "ratio", "error"), [(6, 59, 9.2e-12), (8, 180, 1e-11), (10, 190, 2.3e-11)]
)
def test_integral_kernel_compresses_as_in_table_4_1_down_to_rounding(levels, ratio, error):
    # Ranks there are those of rounding errors, which differ from one LAPACK to another.
    K, X, sides = kernel_tensor(10, levels)
    found = tt_svd(X, 1e-14, method="qr", direction="left", carry=False)
    assert K.size / found.train.parameters == pytest.approx(ratio, rel=0.25)
    difference = K - kernel_matrix(found.train.full(), sides)
    assert spectral_norm(difference) <= error
    assert norm(difference) <= 1e-14 * norm(K)
    assert norm(difference) <= found.error


# ---- the bound -----------------------------------------------------------------------------


@st.composite
def tensors(draw):
    """A tensor of any order to 24 and of many a spectrum, its dtype and the scale of its norm."""
    order = draw(st.integers(2, 24))
    shape, room = [], draw(st.integers(4, 4096))
    for _ in range(order):
        n = draw(st.integers(1, min(room, 9 if order > 6 else 40)))
        shape.append(n)
        room = max(room // n, 1)
    shape = draw(st.permutations(shape))
    generator = np.random.default_rng(draw(st.integers(0, 2**32)))
    X, _ = low_rank(generator, shape, draw(st.integers(1, 12)))
    noise = draw(st.sampled_from([0.0, 1e-9, 1e-4, 1e-1, 10.0]))
    X = X + noise * generator.standard_normal(shape)
    if draw(st.booleans()):  # entries of many magnitudes
        X = X * np.exp(3.0 * generator.standard_normal(shape))
    single = draw(st.booleans())
    exponent = draw(st.integers(-30, 30) if single else st.integers(-300, 300))
    X = X / max(norm(X), 1e-300)
    return (X * 10.0**exponent).astype(np.float32 if single else np.float64)


@settings(max_examples=500, deadline=None, derandomize=True)
@given(
    tensors(),
    st.floats(0.3, 12.5),
    st.sampled_from(METHODS),
    st.sampled_from(DIRECTIONS),
    st.booleans(),
)
def test_error_keeps_to_the_tolerance(X, digits, method, direction, carry):
    # In float32 not below 5 units of 6e-8 for each of 24 cores, as squares.
    tolerance = max(10.0**-digits, 1.5e-6 if X.dtype == np.float32 else 0.0)
    found = tt_svd(X, tolerance, method=method, direction=direction, carry=carry)
    errors = measure(X, expanded(found.train))
    # Measuring has rounding of its own, of the order of sqrt(24) units.
    assert errors.frobenius <= tolerance * errors.norm + 1e-15 * errors.norm
    assert errors.frobenius <= found.error + 1e-15 * errors.norm
    assert found.met
    assert found.train.shape == X.shape and found.train.dtype == X.dtype
    assert found.norm == pytest.approx(errors.norm, rel=1e-13)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-5, 3e-7, 1e-7, 1e-9, 1e-12])
def test_bound_is_near_the_error_that_there_is(method, tolerance):
    # Singular values over all magnitudes, so that at any tolerance something is cut off next to it.
    generator = np.random.default_rng(1)
    X = with_singular_values(generator, 10.0 ** -np.linspace(0, 14, 200), 200, 300)
    found = tt_svd(X.reshape(10, 20, 20, 15), tolerance, method=method)
    error = error_of(found, X.reshape(10, 20, 20, 15))
    assert error <= found.error <= tolerance * norm(X)
    # What is not error: rounding, the floor of a Gram matrix, half a share for the random range.
    assert found.error**2 <= error**2 + (tolerance * norm(X)) ** 2 / 2


def test_tolerance_below_rounding_gives_an_honest_bound():
    generator = np.random.default_rng(2)
    for shape in [(12, 13, 14), (3, 100, 100), (4, 4, 4, 4, 4, 4), (200, 30)]:
        X = generator.standard_normal(shape)
        found = tt_svd(X, 1e-17)
        # Expanded in long double: else the rounding of that, too, would be measured.
        Y = np.ones((1, 1), np.longdouble)
        for core in found.train.cores:
            Y = np.tensordot(Y, core.astype(np.longdouble), axes=1).reshape(-1, core.shape[2])
        error = float(np.sqrt(np.sum((Y.reshape(shape) - X) ** 2)))
        assert error <= found.error <= 1e-14 * norm(X)
        assert not found.met


def test_absolute_tolerance_is_in_the_unit_of_the_values():
    generator = np.random.default_rng(3)
    X = 1e200 * noisy(generator, (6, 7, 8, 9), 3, 0.1)
    found = tt_svd(X, absolute=2e199)
    assert 1e198 < error_of(found, X) <= found.error <= found.allowed == pytest.approx(2e199)


# ---- the methods ---------------------------------------------------------------------------


def plain_tt_svd(X, delta):
    """Algorithm 4.1 as it is written."""
    cores, rank, M = [], 1, X
    for n in X.shape[:-1]:
        U, s, V = np.linalg.svd(M.reshape(rank * n, -1), full_matrices=False)
        r = max(next(r for r in range(len(s) + 1) if norm(s[r:]) <= delta), 1)
        cores.append(U[:, :r].reshape(rank, n, r))
        rank, M = r, s[:r, None] * V[:r]
    return TensorTrain((*cores, M.reshape(rank, X.shape[-1], 1)))


@pytest.mark.parametrize("shape", [(4, 5, 6, 7), (2,) * 12, (3, 1, 8, 2, 5), (50, 60), (40, 3, 9)])
@pytest.mark.parametrize("method", METHODS)
def test_several_dimensions_at_once_give_the_train_of_one_at_a_time(shape, method):
    generator = np.random.default_rng(4)
    X = noisy(generator, shape, 4, 3e-2)
    X = X / norm(X)
    for tolerance in (0.2, 1e-2, 1e-4):
        twin = plain_tt_svd(X, tolerance / math.sqrt(len(shape) - 1))
        found = tt_svd(X, tolerance, method=method, direction="left", carry=False)
        assert found.train.ranks == twin.ranks
        if max(s.method == "randomised" for s in found.steps):
            continue
        # Both project on the same singular vectors.
        np.testing.assert_allclose(found.train.full(), twin.full(), atol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_methods_and_directions_agree_on_the_ranks(tolerance):
    generator = np.random.default_rng(5)
    X = noisy(generator, (8, 9, 30, 7, 6), 5, tolerance / 10)
    for method in METHODS:
        for direction in DIRECTIONS:
            found = tt_svd(X, tolerance, method=method, direction=direction)
            assert found.train.ranks == (1, 5, 5, 5, 5, 1)


def test_gram_matrices_are_not_used_below_their_floor():
    generator = np.random.default_rng(6)
    X = noisy(generator, (20, 30, 40), 3, 1e-12)
    for method in ("auto", "gram"):
        assert {s.method for s in tt_svd(X, 1e-9, method=method).steps} == {"qr"}
        assert {s.method for s in tt_svd(X, 1e-5, method=method).steps} == {"gram"}
    assert {s.method for s in tt_svd(X, 1e-5, method="qr").steps} == {"qr"}


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(24, 40_000), (300, 200), (64, 64)])
def test_factors_have_the_singular_values_of_the_matrix(side, dtype, shape):
    # More than two blocks in the first; fewer columns than rows in the second.
    assert 2 * BLOCK < 24 * 40_000
    generator = np.random.default_rng(7)
    s = 10.0 ** -np.linspace(0, 6, min(shape))
    values = with_singular_values(generator, s, *shape).astype(dtype)
    M = Unfolding(values if side == "left" else np.ascontiguousarray(values.T), side, 0.25)
    exact = np.linalg.svd(values.astype(np.float64) * 0.25, compute_uv=False)
    energy = float(np.sum(exact**2))
    from_qr = np.linalg.svd(qr_factor(M).L, compute_uv=False)
    np.testing.assert_allclose(from_qr, exact, atol=1e-14)
    gram = gram_factor(M)
    assert gram.missed <= 3.0 * GRAM_FLOOR * energy
    found = np.zeros_like(exact)
    found[: gram.L.shape[1]] = np.linalg.svd(gram.L, compute_uv=False)
    # Energies of the tails, which is what ranks are chosen by.
    tails = np.cumsum((exact**2)[::-1])[::-1]
    np.testing.assert_allclose(np.cumsum((found**2)[::-1])[::-1], tails, atol=gram.missed)
    rows = M.project(np.eye(shape[0])[:, :5])
    np.testing.assert_array_equal(rows if side == "left" else rows.T, M.read()[:5])


# ---- randomised ----------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-9])
def test_random_range_serves_long_dimensions_of_small_rank(tolerance):
    generator = np.random.default_rng(8)
    X = with_singular_values(generator, np.full(20, 1.0), 1500, 1600)
    X += generator.standard_normal(X.shape) * tolerance * math.sqrt(20 / X.size) / 4
    found = tt_svd(X, tolerance)
    assert [s.method for s in found.steps] == ["randomised"]
    assert found.train.ranks == (1, 20, 1)
    assert error_of(found, X) <= found.error <= tolerance * norm(X)


def test_random_range_that_is_not_small_is_given_up():
    generator = np.random.default_rng(9)
    X = generator.standard_normal((150, 160))
    assert randomised_factor(Unfolding(X, "left"), 1e-6, norm(X) ** 2, 150) is None
    found = tt_svd(X, 1e-3, method="randomised")
    assert found.met and not found.pays


def test_random_range_grows_until_the_error_is_met_whatever_the_seed():
    # Decays slowly, so that the first 32 columns never do.
    generator = np.random.default_rng(10)
    X = with_singular_values(generator, 1.0 / np.arange(1, 401), 400, 500)
    optimal = tt_svd(X, 0.15, method="qr").train.ranks[1]
    for seed in range(20):
        found = tt_svd(X, 0.15, method="randomised", seed=seed)
        assert found.steps[0].method == "randomised"
        assert error_of(found, X) <= found.error <= 0.15 * norm(X)
        assert optimal <= found.train.ranks[1] <= 2 * optimal


def test_random_range_of_fixed_rank_is_near_the_optimum():
    generator = np.random.default_rng(11)
    s = 0.8 ** np.arange(400)
    X = with_singular_values(generator, s, 400, 500)
    for rank in (5, 20):
        found = tt_svd(X, max_ranks=rank, method="randomised")
        assert found.steps[0].method == "randomised"
        best = norm(s[rank:])
        # With one power iteration and ten columns over: 1 + O((s_{r+10} / s_r)^3).
        assert best * (1 - 1e-9) <= error_of(found, X) <= 1.01 * best
        assert error_of(found, X) <= found.error * (1 + 1e-9)


def test_results_are_the_same_every_time():
    generator = np.random.default_rng(12)
    X = noisy(generator, (300, 4, 310), 6, 1e-3)
    for method in METHODS:
        first, second = (tt_svd(X, 1e-2, method=method) for _ in range(2))
        for a, b in zip(first.train.cores, second.train.cores, strict=True):
            np.testing.assert_array_equal(a, b)
        assert first.error == second.error


# ---- hard cases ----------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(30, 31, 32), (2,) * 14, (5, 1, 90, 1, 70), (400, 300)])
def test_exact_ranks_are_found_exactly(method, dtype, shape):
    generator = np.random.default_rng(13)
    for rank in (1, 2, 5):
        X, ranks = low_rank(generator, shape, rank)
        for direction in DIRECTIONS:
            for tolerance in (None, 1e-4, 1e-10 if dtype == np.float64 else 1e-5):
                found = tt_svd(X.astype(dtype), tolerance, method=method, direction=direction)
                assert found.train.ranks == ranks


@pytest.mark.parametrize("method", METHODS)
def test_clustered_singular_values_at_the_cut(method):
    # Any of them may go, and not one too many: the bound holds and the rank is the least.
    generator = np.random.default_rng(14)
    s = np.concatenate([np.full(10, 1.0), np.full(60, 1e-3) * (1 + 1e-12 * np.arange(60))])
    X = with_singular_values(generator, s, 90, 100)
    for gone in (1, 25, 60):
        allowed = 1e-3 * math.sqrt(gone + 0.5)
        found = tt_svd(X, absolute=allowed, method=method)
        assert error_of(found, X) <= found.error <= allowed
        if found.steps[0].method != "randomised":
            assert found.train.ranks[1] == 70 - gone


@pytest.mark.parametrize("method", METHODS)
def test_singular_value_exactly_at_the_tolerance(method):
    X = np.diag([5.0, 4.0, 3.0])
    # 3 itself leaves nothing for rounding; a little more does.
    assert error_of(tt_svd(X, absolute=3.0, method=method), X) <= 3.0
    assert tt_svd(X, absolute=3.0 * (1 + 1e-12), method="qr").train.ranks[1] == 2
    assert tt_svd(X, absolute=3.0 * (1 - 1e-12), method=method).train.ranks[1] == 3
    assert tt_svd(X, absolute=5.0 * (1 + 1e-12), method=method).train.ranks[1] == 1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_zeros_and_single_entries(method, dtype):
    zeros = tt_svd(np.zeros((3, 4, 5), dtype), 1e-3, method=method)
    assert zeros.train.ranks == (1, 1, 1, 1) and zeros.error == 0.0 and zeros.met
    assert zeros.relative_error == 0.0
    np.testing.assert_array_equal(zeros.train.full(), np.zeros((3, 4, 5)))
    lone = np.zeros((6, 7, 8), dtype)
    lone[2, 3, 4] = -7.5
    found = tt_svd(lone, 1e-6, method=method)
    assert found.train.ranks == (1, 1, 1, 1)
    np.testing.assert_allclose(found.train.full(), lone, atol=30 * np.finfo(dtype).eps)


def test_dimensions_of_length_one_none_and_a_single_dimension():
    X = np.arange(6.0).reshape(1, 2, 1, 3, 1)
    found = tt_svd(X, 1e-12)
    assert found.train.shape == X.shape and error_of(found, X) <= 1e-12 * norm(X)
    assert tt_svd(np.ones((1, 1, 1)), 1e-3).train.full().item() == pytest.approx(1.0, rel=1e-14)
    line = tt_svd(np.arange(5.0), 1e-1)
    np.testing.assert_array_equal(line.train.full(), np.arange(5.0))
    assert line.error == 0.0 and line.steps == ()
    empty = tt_svd(np.empty((3, 0, 2)), 1e-3)
    assert empty.train.shape == (3, 0, 2) and empty.error == 0.0


@pytest.mark.parametrize("exponent", [-300, -160, 160, 300])
def test_norms_at_the_ends_of_the_range(exponent):
    generator = np.random.default_rng(15)
    X = noisy(generator, (12, 14, 16), 4, 1e-5)
    plain, scaled = (tt_svd(Y, 1e-3, method="qr") for Y in (X, X * 10.0**exponent))
    assert scaled.train.ranks == plain.train.ranks == (1, 4, 4, 1)
    assert scaled.relative_error == pytest.approx(plain.relative_error, rel=1e-6)
    assert error_of(scaled, X * 10.0**exponent) <= 1e-3 * 10.0**exponent


def test_norm_that_the_dtype_cannot_hold_is_spread_over_the_cores():
    # Entries fit into float32, their norm does not.
    generator = np.random.default_rng(16)
    X = np.full((64, 64, 64), 2e38, np.float32)
    X *= 1 + 0.1 * generator.standard_normal((64, 1, 1)).astype(np.float32)
    found = tt_svd(X, 1e-5)
    assert found.train.ranks == (1, 1, 1, 1)
    assert all(np.isfinite(core).all() for core in found.train.cores)
    assert error_of(found, X) <= 1e-5 * norm(X)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_that_are_not_finite_are_refused_naming_the_first(bad, dtype):
    X = np.ones((700, 20, 30), dtype)  # in the second of two blocks
    X[650, 3, 4] = bad
    X[650, 3, 5] = np.nan
    with pytest.raises(ValueError, match=rf"values\[650, 3, 4\] is {bad}"):
        tt_svd(X, 1e-2)
    with pytest.raises(ValueError, match=r"values\[1\]"):
        tt_svd(np.array([1.0, bad]), 1e-2)


def test_integers_slices_and_column_major_arrays():
    generator = np.random.default_rng(17)
    X = generator.integers(-9, 9, (8, 9, 10))
    for values in (X, X.astype(np.int16)[:, ::2], np.asfortranarray(X), X.astype(np.float32).T):
        kept = values.copy()
        found = tt_svd(values, 1e-5)
        np.testing.assert_array_equal(values, kept)
        assert error_of(found, values) <= 1e-5 * norm(values)
        single = values.dtype == np.float32
        assert found.train.dtype == (np.float32 if single else np.float64)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": -1e-3}, "tolerance"),
        ({"tolerance": math.nan}, "tolerance"),
        ({"absolute": math.inf}, "absolute"),
        ({"tolerance": 1e-3, "absolute": 1.0}, "only one"),
        ({"method": "svd"}, "method"),
        ({"direction": "up"}, "direction"),
        ({"max_ranks": 0}, "max_ranks"),
        ({"max_ranks": [2, 2, 2]}, "3 ranks: must have 2"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        tt_svd(np.ones((2, 3, 4)), **options)


def test_values_that_are_no_tensor_of_numbers_are_refused():
    for values in (np.float64(3.0), np.ones((2, 2), complex), np.array(["a", "b"])):
        with pytest.raises(ValueError, match="values"):
            tt_svd(values, 1e-3)


# ---- ranks, budget, order of work ----------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_capped_ranks_report_their_error(method):
    generator = np.random.default_rng(18)
    X = noisy(generator, (9, 10, 11, 12), 8, 0.3)
    previous = math.inf
    for cap in (1, 2, 4, 8):
        found = tt_svd(X, max_ranks=cap, method=method)
        assert max(found.train.ranks) <= cap
        error = error_of(found, X)
        assert found.truncation == pytest.approx(error, rel=1e-6)
        assert error < previous
        # Each unfolding has its own optimum, and the train is within sqrt(d - 1) of the worst.
        best = max(
            norm(np.linalg.svd(X.reshape(math.prod(X.shape[:k]), -1), compute_uv=False)[cap:])
            for k in (1, 2, 3)
        )
        assert best <= error * (1 + 1e-9) <= math.sqrt(3) * best * 1.01
        previous = error
    assert tt_svd(X, max_ranks=[1, 5, 3], method=method).train.ranks == (1, 1, 5, 3, 1)


def test_cap_that_prevents_the_tolerance_is_told():
    generator = np.random.default_rng(19)
    X = noisy(generator, (9, 10, 11), 8, 0.1)
    assert tt_svd(X, 0.9, max_ranks=9).met
    capped = tt_svd(X, 1e-3, max_ranks=2)
    assert not capped.met and capped.error > capped.allowed
    assert capped.error == pytest.approx(error_of(capped, X), rel=1e-6)


def test_cap_of_one_bond_leaves_the_exact_ranks_of_the_others():
    generator = np.random.default_rng(26)
    X, _ = low_rank(generator, (6, 7, 20, 8, 9), 4)
    for method in METHODS:
        for direction in DIRECTIONS:
            for tolerance in (None, 1e-6):
                caps = [99, 2, 99, 99]
                found = tt_svd(X, tolerance, caps, method=method, direction=direction)
                assert found.train.ranks[2] == 2 and max(found.train.ranks) <= 4
                assert found.error == pytest.approx(error_of(found, X), rel=1e-6)


def test_error_that_bonds_leave_over_is_used_by_the_others():
    # The first bonds have exact ranks, so all of the error is left to the last ones.
    generator = np.random.default_rng(20)
    tail = with_singular_values(generator, 0.7 ** np.arange(40), 40, 64)
    X = np.multiply.outer(generator.standard_normal((4, 4, 4)), tail)
    plain = tt_svd(X, 1e-2, method="qr", direction="left", carry=False)
    carried = tt_svd(X, 1e-2, method="qr", direction="left")
    assert carried.train.parameters < plain.train.parameters
    assert plain.error < 0.55e-2 * norm(X) < 0.9e-2 * norm(X) < carried.error <= 1e-2 * norm(X)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_cores_are_orthonormal_but_for_the_pivot(direction):
    generator = np.random.default_rng(21)
    X = noisy(generator, (4, 6, 50, 3, 2, 9), 5, 1e-3)
    found = tt_svd(X, 1e-2, direction=direction)
    if direction != "auto":
        assert found.pivot == (5 if direction == "left" else 0)
    for k, core in enumerate(found.train.cores):
        r, n, s = core.shape
        if k < found.pivot:
            A = core.reshape(r * n, s)
            np.testing.assert_allclose(A.T @ A, np.eye(s), atol=1e-13)
        elif k > found.pivot:
            A = core.reshape(r, n * s)
            np.testing.assert_allclose(A @ A.T, np.eye(r), atol=1e-13)
        else:
            assert norm(core) == pytest.approx(norm(expanded(found.train)), rel=1e-12)


def test_from_the_right_is_from_the_left_of_the_tensor_turned_over():
    generator = np.random.default_rng(22)
    X = noisy(generator, (3, 8, 2, 7, 5), 4, 0.05)
    for tolerance in (1e-1, 1e-2):
        right = tt_svd(X, tolerance, method="qr", direction="right")
        left = tt_svd(X.T, tolerance, method="qr", direction="left")
        assert right.train.ranks == left.train.ranks[::-1]
        np.testing.assert_allclose(right.train.full(), left.train.full().T, atol=1e-12)


def test_work_begins_at_the_cheaper_end():
    # Many bodies, few steps, three components: from the right a matrix of 96, not of 16384, rows.
    assert plan((16384, 32, 3), (1, 1)).side == "right"
    assert plan((3, 32, 16384), (1, 1)).side == "left"
    assert plan((16384, 32, 3), (1, 1), "left").rows == 16384
    first = plan((2,) * 24, (1, 1))
    assert first.count > 1 and 64 <= first.rows <= 256


@pytest.mark.parametrize("shape", [(2,) * 14, (20, 30, 40), (100, 110)])
def test_white_noise_does_not_pay_and_says_so(shape):
    generator = np.random.default_rng(23)
    assert not tt_svd(generator.standard_normal(shape), 1e-3).pays
    assert tt_svd(low_rank(generator, shape, 2)[0], 1e-3).pays


# ---- memory, convergence -------------------------------------------------------------------


@pytest.mark.parametrize("method", ["auto", "qr"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_memory_is_that_of_the_first_projection_and_of_blocks(method, dtype):
    generator = np.random.default_rng(24)
    X = noisy(generator, (2,) * 21, 8, 1e-4).astype(dtype)
    tt_svd(X[0], 1e-2, method=method)
    tracemalloc.start()
    found = tt_svd(X, 1e-2, method=method)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    first = found.steps[0]
    assert first.rank == 8 and first.rows >= 64
    # Blocks: what is read, appended and triangularised, with LAPACK's copies.
    assert peak <= 2 * 8 * first.rank * first.columns + 6 * 8 * BLOCK
    assert peak < X.size * 8


def test_error_falls_with_the_rank_as_the_singular_values_do():
    # min(x, y) on midpoints has eigenvalues near 1 / ((k - 1/2) pi)^2: errors of order r^(-3/2).
    x = (np.arange(512) + 0.5) / 512
    X = np.minimum(x[:, None], x) / 512
    ranks = np.array([4, 8, 16, 32])
    errors = np.array([tt_svd(X, max_ranks=int(r), method="qr").error for r in ranks])
    squares = 1.0 / ((np.arange(1, 5000) - 0.5) * math.pi) ** 4
    exact = [math.sqrt(squares[r:].sum()) for r in ranks]
    np.testing.assert_allclose(errors, exact, rtol=0.01)
    orders = -np.diff(np.log(errors)) / math.log(2.0)
    np.testing.assert_allclose(orders, 1.5, atol=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_smooth_functions_cost_the_logarithm_of_the_error(method):
    # 1 / (1 + x + y + z): errors fall by a factor a rank, so ranks grow as digits do.
    x = np.linspace(0.0, 1.0, 40)
    X = 1.0 / (1.0 + x[:, None, None] + x[:, None] + x)
    errors = [tt_svd(X, max_ranks=r, method=method).error / norm(X) for r in range(1, 6)]
    assert all(after < 0.1 * before for before, after in pairwise(errors))
    ranks = [max(tt_svd(X, 10.0**-k, method=method).train.ranks) for k in range(2, 13, 2)]
    steps = np.diff(ranks)
    assert steps.min() >= 1 and steps.max() <= 2


def test_binary_levels_of_a_smooth_function_need_constant_ranks():
    # cos has rank 2 in every level; a polynomial of degree p has p + 1.
    x = np.linspace(0.0, 1.0, 2**16)
    wave = tt_svd(np.cos(20.0 * x).reshape((2,) * 16), 1e-10)
    assert set(wave.train.ranks[1:-1]) == {2}
    cubic = tt_svd((x**3 - 2.0 * x).reshape((2,) * 16), 1e-12)
    assert max(cubic.train.ranks) == 4
    assert cubic.train.parameters < 2 * 16 * 4 * 4


def test_survey_is_of_one_pass_and_safe():
    generator = np.random.default_rng(25)
    X = generator.standard_normal((3, BLOCK))
    seen = survey(X)
    assert seen.scale == 1.0
    assert seen.norm == pytest.approx(norm(X), rel=1e-14)
    assert seen.largest == np.abs(X).max()
    tiny = survey(X * 1e-250)
    assert tiny.norm / tiny.scale == pytest.approx(norm(X * 1e-250), rel=1e-14)
    assert math.frexp(tiny.scale)[0] == 0.5
