"""The algebra of tensor trains, against arrays."""

from __future__ import annotations

import math
import pickle
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compress.tensor_train import (
    TensorTrain,
    add,
    concatenate,
    expand_dims,
    random,
    scaled,
    stack,
    zeros,
)

# Sums of up to some thousand products, whose rounding errors partly cancel.
UNITS = 200.0
CASES = settings(max_examples=60, deadline=None, derandomize=True)


def close(found: np.ndarray, expected: np.ndarray, size: float) -> bool:
    """Within rounding errors of numbers of that size."""
    assert found.shape == expected.shape
    eps = np.finfo(found.dtype).eps
    return float(np.abs(found - expected).max(initial=0.0)) <= UNITS * eps * size


def expanded(train: TensorTrain) -> np.ndarray:
    """The array by the plain product from the left."""
    values = train.cores[0]
    for core in train.cores[1:]:
        values = np.tensordot(values, core, axes=(values.ndim - 1, 0))
    return values.reshape(train.shape)


def magnitude(train: TensorTrain) -> float:
    """Largest sum of the magnitudes of the products that make an entry."""
    return float(expanded(TensorTrain(tuple(np.abs(c) for c in train.cores))).max(initial=0.0))


@st.composite
def pairs(draw) -> tuple[TensorTrain, TensorTrain, np.random.Generator]:
    """Two trains of one shape, of order 1 to 12, and what to draw further numbers from."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    d = draw(st.integers(1, 12))
    shape = [int(n) for n in generator.integers(1, 7 if d <= 4 else 3, d)]
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    trains = (
        random(shape, [int(r) for r in generator.integers(1, 5, d - 1)], generator, dtype)
        for _ in range(2)
    )
    return (*trains, generator)


@CASES
@given(pairs())
def test_sums_and_products_are_those_of_the_arrays(pair):
    a, b, _ = pair
    A, B = expanded(a), expanded(b)
    size = magnitude(a) + magnitude(b)
    assert close(a.full(), A, size)
    assert close((a + b).full(), A + B, size)
    assert close((a - b).full(), A - B, size)
    assert close((-a).full(), -A, size)
    assert close((a * 3 + 0.25 * b / 7).full(), 3 * A + 0.25 * B / 7, 3 * size)
    assert close((a * b).full(), A * B, magnitude(a) * magnitude(b))
    assert close(add([a, b, a]).full(), A + B + A, 2 * size)
    assert (0.0 * a).ranks == (1,) * (a.ndim + 1)


@CASES
@given(pairs())
def test_norm_and_dot_are_those_of_the_arrays(pair):
    a, b, _ = pair
    A, B = a.full().astype(np.float64), b.full().astype(np.float64)
    eps = UNITS * np.finfo(a.dtype).eps
    scale = np.linalg.norm(np.abs(A)) * np.linalg.norm(np.abs(B)) + magnitude(a) * magnitude(b)
    assert a.norm() == pytest.approx(np.linalg.norm(A), rel=eps, abs=eps * magnitude(a))
    assert a.dot(b) == pytest.approx(float(np.sum(A * B)), rel=eps, abs=eps * A.size * scale)


@CASES
@given(pairs())
def test_ranks_of_sums_add_and_those_of_products_multiply(pair):
    a, b, _ = pair
    inner = list(zip(a.ranks[1:-1], b.ranks[1:-1], strict=True))
    assert (a + b).ranks == (1, *(r + s for r, s in inner), 1)
    assert (a * b).ranks == (1, *(r * s for r, s in inner), 1)
    assert a.parameters == sum(core.size for core in a.cores)
    assert a.compression_ratio == a.size / a.parameters


@CASES
@given(pairs())
def test_concatenation_and_stacking_are_those_of_the_arrays(pair):
    a, b, generator = pair
    A, B = a.full(), b.full()
    axis = int(generator.integers(-a.ndim, a.ndim))
    size = 2 * (magnitude(a) + magnitude(b))
    parts, arrays = [a, b, a, b], [A, B, A, B]
    assert close(concatenate(parts, axis).full(), np.concatenate(arrays, axis), size)
    new = int(generator.integers(-a.ndim - 1, a.ndim + 1))
    assert close(stack([a, b, a], new).full(), np.stack([A, B, A], new), size)
    assert close(expand_dims(a, new).full(), np.expand_dims(A, new), size)


@CASES
@given(pairs())
def test_concatenation_equals_stacking(pair):
    """Parts joined along their first dimension are those stacked before it, indices merged."""
    a, b, _ = pair
    joined, stacked = concatenate([a, b], 0).full(), stack([a, b], 0).full()
    assert close(joined, stacked.reshape(joined.shape), magnitude(a) + magnitude(b))


def test_stacking_two_tensors_gives_the_cores_of_the_thesis():
    """S. De, algorithm 4.4: the new core picks one of the blocks (eq. 4.29)."""
    generator = np.random.default_rng(0)
    a, b = (random((3, 4), 2, generator) for _ in range(2))
    stacked = stack([a, b])
    assert stacked.ranks == (1, 4, 2, 1)
    assert np.array_equal(stacked.cores[-1][:, :, 0], np.eye(2))
    assert np.array_equal(stacked.cores[0], np.concatenate([a.cores[0], b.cores[0]], axis=2))


def test_concatenation_along_an_inner_dimension_keeps_block_diagonal_ranks():
    generator = np.random.default_rng(1)
    parts = [random((3, n, 5), [2, r], generator) for n, r in ((4, 3), (1, 1), (6, 2))]
    joined = concatenate(parts, 1)
    assert joined.shape == (3, 11, 5)
    assert joined.ranks == (1, 6, 6, 1)
    for part, start, stop in zip(parts, (0, 4, 5), (4, 5, 11), strict=True):
        assert close(joined[:, start:stop].full(), part.full(), magnitude(part))


@CASES
@given(pairs())
def test_entries_and_sub_tensors_are_those_of_the_array(pair):
    a, _, generator = pair
    A = a.full()
    size = magnitude(a)
    rows = np.stack([generator.integers(-n, n, 30) for n in a.shape], axis=1)
    assert close(a.entries(rows), A[tuple(rows.T)], size)
    assert close(np.array(a.entry(rows[0]), a.dtype), np.array(A[tuple(rows[0])]), size)
    picks, array = [], A
    for axis, n in reversed(list(enumerate(a.shape))):
        kind = int(generator.integers(0, 5))
        if kind == 0:
            pick = int(generator.integers(-n, n))
        elif kind == 1:
            pick = slice(None, None, -1)
        elif kind == 2:
            pick = slice(int(generator.integers(0, n + 1)), None, 2)
        elif kind == 3:
            pick = generator.integers(-n, n, 4)
        else:
            pick = generator.random(n) < 0.5
        picks.insert(0, pick)
        array = array[(slice(None),) * axis + (pick,)]
    found = a[tuple(picks)]
    if array.ndim == 0:
        assert isinstance(found, float)
        found, array = np.array(found, a.dtype), np.array(array)
    else:
        found = found.full()
    assert close(found, array, size)


def test_an_ellipsis_and_missing_indices_stand_for_whole_dimensions():
    a = random((2, 3, 4, 5), 2, np.random.default_rng(2))
    A = a.full()
    for key in (..., (..., 1), (1, ..., 2), 1, (slice(1), 2), (0, 1, 2, slice(None)), (1, ..., 0)):
        assert np.allclose(a[key].full(), A[key], rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "key",
    [2, -3, (0, 0, 0, 0), (..., ...), [0, 2], np.ones(3, bool), [0.5], np.zeros((2, 2), int)],
)
def test_indices_outside_or_of_another_kind_are_refused(key):
    with pytest.raises(IndexError):
        zeros((2, 3, 4))[key]


def test_entries_refuse_other_numbers_of_dimensions():
    with pytest.raises(ValueError, match="must be"):
        zeros((2, 3)).entries(np.zeros((4, 3), int))
    with pytest.raises(IndexError, match="outside dimension 1"):
        zeros((2, 3)).entry((0, 3))


def test_twenty_four_dimensions_are_handled_without_expanding_them():
    """2^24 entries: algebra against entries, one by one, and against a slice."""
    generator = np.random.default_rng(3)
    a, b = (random((2,) * 24, 4, generator) for _ in range(2))
    a, b = a / a.norm(), b / b.norm()
    assert a.norm() == pytest.approx(1.0, rel=1e-13)
    rows = generator.integers(0, 2, (500, 24))
    x, y = a.entries(rows), b.entries(rows)
    size = np.abs(x).max() + np.abs(y).max()
    assert close((a + 2 * b).entries(rows), x + 2 * y, size)
    assert close((a * b).entries(rows), x * y, size)
    assert (a + b).norm() ** 2 == pytest.approx(2 + 2 * a.dot(b), rel=1e-12)
    fixed = tuple(int(i) for i in rows[0, :16])
    block = a[fixed].full()
    rest = np.stack(np.unravel_index(np.arange(256), (2,) * 8), axis=1)
    assert close(block.ravel(), a.entries(np.hstack([np.tile(fixed, (256, 1)), rest])), size)


def test_a_sub_tensor_takes_the_memory_of_what_it_holds():
    """Of 2^30 entries, 16 steps of one body: kilobytes, not gigabytes."""
    train = random((1 << 14, 1 << 13, 8), 5, np.random.default_rng(4), np.float32)
    tracemalloc.start()
    try:
        values = train[77, 100:116].full()
        rows = train.entries(np.array([[5, 6, 7], [-1, -1, -1]]))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert values.shape == (16, 8) and rows.shape == (2,)
    # The cores have 0.8 MB; what is made are those of the sub-tensor.
    assert peak < 100_000


def test_full_starts_from_the_cheaper_end():
    """A long last dimension: from the left alone, 6 x 10^5 rows of rank 64 would be made."""
    train = random((40, 50, 60, 5), [2, 64, 4], np.random.default_rng(5))
    tracemalloc.start()
    try:
        values = train.full()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.5 * values.nbytes
    assert np.allclose(values, expanded(train), rtol=0, atol=1e-10)


# ---- size of numbers ---------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [-1000, -996, -700, 0, 700, 1000])
def test_scale_changes_no_digit(exponent):
    """Tensors of norms from 1e-300 to 1e300: a power of two goes through everything unchanged."""
    generator = np.random.default_rng(6)
    a, b = (random((3, 4, 5, 2), 3, generator) for _ in range(2))
    p, q = scaled(a, exponent), scaled(b, exponent)
    for big, one in (
        (p, a),
        (p + q, a + b),
        (p[1, ::2], a[1, ::2]),
        (stack([p, q]), stack([a, b])),
    ):
        assert np.array_equal(big.full(), np.ldexp(one.full(), exponent))
    assert p.norm() == math.ldexp(a.norm(), exponent)
    rows = np.array([[0, 1, 2, 1], [2, 3, 4, 0]])
    assert np.array_equal(p.entries(rows), np.ldexp(a.entries(rows), exponent))
    assert (p / 2.0**exponent).dot(q) == math.ldexp(a.dot(b), exponent)


def test_scale_may_lie_in_any_cores():
    """Cores of 1e200 and 1e-200 whose product is ordinary, and none of which leaves the range."""
    a = random((3, 4, 5), 2, np.random.default_rng(7))
    shifts = (1e200, 1e-290, 1e90)
    b = TensorTrain(tuple(core * s for core, s in zip(a.cores, shifts, strict=True)))
    assert np.allclose(b.full(), a.full(), rtol=1e-12, atol=0)
    assert b.norm() == pytest.approx(a.norm(), rel=1e-13)
    assert (b * 1e250 * 1e-250).norm() == pytest.approx(a.norm(), rel=1e-13)
    assert (b * b).norm() == pytest.approx((a * a).norm(), rel=1e-13)


def test_norm_of_a_small_difference_keeps_its_digits():
    """From Gram matrices alone it would be lost below 1e-8 of the tensors."""
    generator = np.random.default_rng(8)
    a, b = (random((5, 6, 7), 3, generator) for _ in range(2))
    a, b = a / a.norm(), b / b.norm()
    assert ((a + 1e-12 * b) - a).norm() == pytest.approx(1e-12, rel=1e-2)
    assert (a - a).norm() < 1e-14


def test_norm_beyond_float64_is_infinite():
    a = random((3, 3), 1, np.random.default_rng(9)) * 1e200
    assert (a * a).norm() == math.inf


# ---- edge cases --------------------------------------------------------------------------------


def test_empty_dimensions_and_zeros_are_defined():
    a = random((3, 4, 5), 2, np.random.default_rng(10))
    none = a[:, 0:0]
    assert none.shape == (3, 0, 5) and none.full().shape == (3, 0, 5)
    assert none.norm() == 0.0 and none.dot(none) == 0.0 and none.size == 0
    assert np.array_equal(concatenate([none, a], 1).full(), a.full())
    nothing = zeros((3, 4, 5), np.float32)
    assert nothing.dtype == np.float32 and nothing.norm() == 0.0 and not nothing.full().any()
    assert np.array_equal((a + nothing.astype(np.float64)).full(), a.full())


def test_precisions_mix_as_those_of_arrays():
    generator = np.random.default_rng(11)
    single, double = random((3, 4), 2, generator, np.float32), random((3, 4), 2, generator)
    assert (single + single).dtype == (single * 2).dtype == single[0].full().dtype == np.float32
    assert (single + double).dtype == (single * double).dtype == np.float64
    assert concatenate([single, double]).dtype == np.float64


def test_cores_are_the_trains_own():
    cores = [np.ones((1, 3, 2)), np.ones((2, 4, 1))]
    train = TensorTrain(tuple(cores))
    cores[0][:] = 7.0
    assert train.entry((0, 0)) == 2.0
    assert cores[0].flags.writeable
    copy = pickle.loads(pickle.dumps(train))
    for core in (*train.cores, *copy.cores, *(train + train).cores, *train[:, 1:].cores):
        assert core.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            core[0, 0, 0] = 1.0
    assert np.array_equal(copy.full(), train.full())
    values = train.full()
    values[:] = 0.0
    assert train.entry((0, 0)) == 2.0


@pytest.mark.parametrize(
    ("cores", "message"),
    [
        ([], "at least one core"),
        ([np.ones((1, 2))], "core 0 of shape .* three dimensions"),
        ([np.ones((1, 2, 3)), np.ones((2, 2, 1))], "core 1 .* first rank must be 3"),
        ([np.ones((2, 2, 1))], "core 0 .* first rank must be 1"),
        ([np.ones((1, 2, 3))], "core 0 .* last rank must be 1"),
        ([np.ones((1, 2, 1), np.float32), np.ones((1, 2, 1))], "core 1 of float64: .* float32"),
        ([np.ones((1, 2, 1), int)], "core 0 of int64"),
        ([np.ones((1, 2, 0)), np.ones((0, 2, 1))], "core 0 .* at least 1"),
        ([np.ones((1, 2, 1)), np.full((1, 2, 1), np.nan)], "core 1: .* not finite"),
    ],
)
def test_cores_that_do_not_fit_are_refused_by_name(cores, message):
    with pytest.raises(ValueError, match=message):
        TensorTrain(tuple(cores))


def test_shapes_that_do_not_fit_are_refused():
    a, b = zeros((2, 3)), zeros((2, 4))
    for join in (lambda: a + b, lambda: a * b, lambda: a.dot(b), lambda: concatenate([a, b], 0)):
        with pytest.raises(ValueError, match="must be"):
            join()
    with pytest.raises(ValueError, match="must be"):
        stack([a, b])
    with pytest.raises(ValueError, match="axis"):
        concatenate([a, a], 2)
    with pytest.raises(ValueError, match="no tensor train"):
        concatenate([])
