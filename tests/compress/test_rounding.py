"""Rounding of tensor trains: errors within what was promised, ranks as low as they can be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compress.rounding import kept_rank, orthogonalize, round_train
from compress.tensor_train import TensorTrain, concatenate, random, scaled, stack, zeros

CASES = settings(max_examples=60, deadline=None, derandomize=True)
# Hypot and the sums of a test's own reference, in extended precision.
SLACK = 1.0 + 1e-12


def exact(train: TensorTrain, exponent: int = 0) -> np.ndarray:
    """2^exponent times the array, in extended precision: the reference for rounding errors."""
    cores = [core.astype(np.longdouble) for core in train.cores]
    values = np.ldexp(cores[0], exponent)
    for core in cores[1:]:
        values = np.tensordot(values, core, axes=(values.ndim - 1, 0))
    return values.reshape(train.shape)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.sum((a - b) ** 2)))


@st.composite
def decaying(draw, most: int = 12) -> tuple[TensorTrain, np.random.Generator]:
    """A train of order 1 to `most` whose parts fall in size by up to 12 orders."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    d = draw(st.integers(1, most))
    shape = [int(n) for n in generator.integers(1, 8 if d <= 4 else 3, d)]
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    train = random(shape, 2, generator, dtype)
    for step in range(1, 5):
        train = train + random(shape, 1, generator, dtype) * 10.0 ** (
            -3 * step * generator.random()
        )
    return train, generator


@CASES
@given(decaying(), st.floats(-12, 0), st.sampled_from([-990, -40, 0, 40, 990]))
def test_error_is_within_tolerance_and_within_what_is_stated(case, exponent, power):
    train, _ = case
    tolerance = 10.0**exponent
    if train.dtype == np.float32:
        power, tolerance = power // 30, max(tolerance, 1e-5)
    big = scaled(train, power)
    rounded = round_train(big, tolerance)
    X, Y = exact(train), exact(rounded.train, -power)
    norm = float(np.sqrt(np.sum(X**2)))
    assert rounded.norm == pytest.approx(math.ldexp(norm, power), rel=1e-12)
    assert distance(X, Y) <= tolerance * norm * SLACK
    assert distance(X, Y) <= math.ldexp(rounded.error, -power) * SLACK
    assert rounded.error <= tolerance * rounded.norm * SLACK
    assert rounded.train.dtype == train.dtype
    assert all(r <= s for r, s in zip(rounded.train.ranks, train.ranks, strict=True))


@CASES
@given(decaying())
def test_absolute_error_is_that_of_the_same_tolerance(case):
    train, _ = case
    relative = round_train(train, 1e-2)
    absolute = round_train(train, absolute=1e-2 * relative.norm)
    assert relative.train.ranks == absolute.train.ranks
    assert np.array_equal(relative.train.full(), absolute.train.full())


@CASES
@given(decaying())
def test_stated_error_covers_rounding_errors_of_cancellation(case):
    """(X + A) - A has rounding errors of the size of A, 10^6 times X, of which it must know."""
    train, generator = case
    other = random(train.shape, 2, generator, train.dtype) * 1e6
    sum_ = (train + other) - other
    rounded = round_train(sum_)
    assert distance(exact(sum_), exact(rounded.train)) <= rounded.error * SLACK


def test_sums_of_equal_trains_have_the_ranks_of_one():
    """2X has rank 2r before rounding, r after: exact ranks are found exactly."""
    generator = np.random.default_rng(0)
    for dtype in (np.float32, np.float64):
        x = random((6, 7, 8, 5), [4, 6, 3], generator, dtype)
        for multiple in (x + x, x + x - 0.5 * x, concatenate([x, x], 1)[:, :7] + x):
            assert round_train(multiple).train.ranks == x.ranks
        assert round_train(x * x - x * x + x * 1e-3).train.ranks == x.ranks
        nothing = round_train(x - x, absolute=1e-3)
        assert nothing.train.ranks == (1,) * 5


def test_ranks_are_those_of_the_unfoldings():
    """No rank is above the numerical rank of the unfolding at the share of a bond."""
    generator = np.random.default_rng(1)
    x = random((6, 7, 8, 5), 5, generator)
    for _ in range(3):
        x = x + 1e-4 * random((6, 7, 8, 5), 3, generator)
    rounded = round_train(x, 1e-2).train
    X = x.full()
    for k in range(1, 4):
        sigma = np.linalg.svd(X.reshape(int(np.prod(X.shape[:k])), -1), compute_uv=False)
        share = 1e-2 * np.linalg.norm(X) / math.sqrt(3)
        assert rounded.ranks[k] <= kept_rank(sigma, share)[0]


def test_what_a_bond_does_not_use_the_next_ones_have():
    """The last bond alone has small singular values: it may drop all that three bonds share."""
    generator = np.random.default_rng(2)
    d, n = 4, 8
    u = np.linalg.qr(generator.standard_normal((n, n)))[0]
    # Rank 1 but at the last bond, where singular values are 1 and 0.05 seven times.
    sigma = np.array([1.0, *[0.05] * (n - 1)])
    last_two = (u * sigma) @ np.linalg.qr(generator.standard_normal((n, n)))[0]
    ones = np.full((1, 2, 1), math.sqrt(0.5))
    x = TensorTrain((ones, ones, u.reshape(1, n, n), (u.T @ last_two).reshape(n, n, 1)))
    # Allowed: 0.05 sqrt(6.5), six of them; an equal share (6.5 / 3) would allow two.
    rounded = round_train(x, absolute=0.05 * math.sqrt(6.5))
    assert x.ndim == d
    assert rounded.train.ranks == (1, 1, 1, 2, 1)
    assert rounded.error == pytest.approx(0.05 * math.sqrt(6), rel=1e-10)


@CASES
@given(decaying())
def test_rounding_to_rounding_errors_is_idempotent(case):
    train, _ = case
    once = round_train(train)
    # Once above its own rounding errors: what is left of a direction at their level may go.
    again = round_train(once.train, absolute=0.0)
    if again.train is not once.train:
        assert again.error <= 3.0 * once.error
        assert round_train(again.train).train is again.train


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("tolerance", [1e-1, 1e-3])
def test_rounding_is_idempotent_bit_by_bit(dtype, tolerance):
    """Low rank and noise far below the tolerance: the second time nothing is left to drop."""
    generator = np.random.default_rng(3)
    for shape in ((9, 8, 7), (2,) * 12, (3, 1, 4, 1, 5)):
        x = random(shape, 2, generator, dtype)
        noisy = x + random(shape, 3, generator, dtype) * (1e-3 * tolerance * x.norm())
        once = round_train(noisy, tolerance).train
        twice = round_train(once, tolerance)
        assert once.parameters < noisy.parameters
        assert twice.train is once
        assert twice.error == 0.0


def test_capped_ranks_are_kept_and_their_error_is_stated():
    generator = np.random.default_rng(4)
    x = random((6, 7, 8, 5), 5, generator)
    for cap in (1, 2, 4, [1, 4, 2], [5, None, 3]):
        rounded = round_train(x, max_rank=cap)
        caps = [cap] * 3 if isinstance(cap, int) else cap
        ranks = rounded.train.ranks[1:-1]
        assert all(c is None or r <= c for r, c in zip(ranks, caps, strict=True))
        error = distance(exact(x), exact(rounded.train))
        assert error <= rounded.error
        # The truncations are orthogonal: the stated error is the error itself.
        assert error == pytest.approx(rounded.error, rel=1e-10)
        assert round_train(rounded.train, max_rank=cap).train is rounded.train
    both = round_train(x, tolerance=0.5, max_rank=4)
    assert max(both.train.ranks) <= 4


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_tolerance_below_rounding_errors_is_not_promised(dtype):
    x = random((6, 7, 8), 3, np.random.default_rng(5), dtype)
    rounded = round_train(x + x, 1e-18)
    eps = float(np.finfo(dtype).eps)
    assert rounded.train.ranks == x.ranks
    assert 1e-18 * rounded.norm < rounded.error < 1e3 * eps * rounded.norm


def test_orthogonal_cores_are_orthogonal():
    generator = np.random.default_rng(6)
    x = scaled(random((5, 4, 3, 6), [4, 9, 7], generator), 800)
    for centre in range(-1, 4):
        y = orthogonalize(x, centre)
        assert np.allclose(scaled(y, -800).full(), scaled(x, -800).full(), rtol=0, atol=1e-13)
        at = centre % 4
        for k, core in enumerate(y.cores):
            if k < at:
                q = core.reshape(-1, core.shape[2])
                assert np.allclose(q.T @ q, np.eye(core.shape[2]), rtol=0, atol=1e-14)
            if k > at:
                q = core.reshape(core.shape[0], -1)
                assert np.allclose(q @ q.T, np.eye(core.shape[0]), rtol=0, atol=1e-14)
        assert y.norm() == pytest.approx(x.norm(), rel=1e-13)


def test_twenty_four_dimensions_are_rounded():
    generator = np.random.default_rng(7)
    x = random((2,) * 24, 3, generator)
    y = random((2,) * 24, 3, generator)
    x, y = x / x.norm(), y / y.norm()
    rounded = round_train(x + 1e-6 * y, 1e-4)
    assert all(r <= 3 for r in rounded.train.ranks)
    difference = (rounded.train - x - 1e-6 * y).norm()
    assert difference <= rounded.error * (1 + 1e-9) <= 1e-4 * rounded.norm * (1 + 1e-9)
    assert all(r <= 4 for r in round_train(stack([x, 2 * x, x])).train.ranks)


def test_zeros_and_empty_tensors_have_rank_one():
    nothing = zeros((3, 4, 5))
    assert round_train(nothing).train is nothing
    for train in (nothing + nothing, (nothing + nothing)[:, :0]):
        rounded = round_train(train, 1e-3)
        assert rounded.train.ranks == (1, 1, 1, 1)
        assert rounded.train.shape == train.shape
        assert (rounded.error, rounded.norm) == (0.0, 0.0)
        assert orthogonalize(train).shape == train.shape


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 1e-3, "absolute": 1.0}, "only one"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"absolute": math.nan}, "absolute"),
        ({"max_rank": 0}, "at least 1"),
        ({"max_rank": [1]}, "must be 2"),
    ],
)
def test_options_that_say_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        round_train(zeros((2, 3, 4)), **options)


def test_kept_rank_counts_the_tail():
    sigma = np.array([3.0, 2.0, 2.0, 1.0])
    assert kept_rank(sigma, 0.0) == (4, 0.0)
    assert kept_rank(sigma, 1.0) == (3, 1.0)
    assert kept_rank(sigma, 2.9) == (2, pytest.approx(math.sqrt(5)))
    assert kept_rank(sigma, 99.0) == (1, pytest.approx(3.0))
