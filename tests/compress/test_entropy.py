"""Integers come back from their code, which is hardly longer than their entropy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compress.entropy import (
    LAST_BUCKET,
    bucket_edges,
    buckets,
    decode_integers,
    encode_integers,
    half_power,
)

INT64 = np.iinfo(np.int64)


def sizes(probabilities: np.ndarray, count: int) -> float:
    """Bytes that `count` independent draws take at best."""
    p = probabilities[probabilities > 0.0]
    return -count * float(p @ np.log2(p)) / 8.0


def geometric(p: float) -> np.ndarray:
    k = np.arange(int(60.0 / p))
    return p * (1.0 - p) ** k


def laplace(scale: float) -> np.ndarray:
    k = np.arange(-int(60 * scale) - 2, int(60 * scale) + 3)
    weights = np.exp(-np.abs(k) / scale)
    return weights / weights.sum()


LAWS = {
    "geometric 0.5": geometric(0.5),
    "geometric 0.01": geometric(0.01),
    "laplace 0.2": laplace(0.2),
    "laplace 3": laplace(3.0),
    "laplace 1000": laplace(1000.0),
    "uniform 2": np.full(2, 1 / 2),
    "uniform 37": np.full(37, 1 / 37),
    "uniform 5000": np.full(5000, 1 / 5000),
}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("count", [300, 5_000, 100_000])
def test_code_is_within_two_percent_of_the_entropy(law, count):
    p = LAWS[law]
    values = np.random.default_rng(len(law) + count).choice(len(p), count, p=p / p.sum())
    if "laplace" in law:
        values -= len(p) // 2
    data = encode_integers(values)
    drawn = -float(np.log2(p[values + (len(p) // 2 if "laplace" in law else 0)]).sum()) / 8.0
    # Against the information of this very draw, which varies around the entropy.
    assert len(data) <= 1.02 * max(drawn, sizes(p, count)) + 64
    np.testing.assert_array_equal(decode_integers(data)[0], values)


@pytest.mark.parametrize("value", [0, 7, -12345, INT64.max, INT64.min])
@pytest.mark.parametrize("count", [1, 1000, 3_000_000])
def test_constant_stream_of_any_length_takes_a_few_bytes(value, count):
    data = encode_integers(np.full(count, value))
    # Besides the value itself, seven bits a byte.
    assert len(data) <= 7 + (abs(int(value)).bit_length() + 7) // 7
    values, used = decode_integers(data + b"more")
    assert used == len(data)
    assert len(values) == count
    assert (values == value).all()


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.lists(st.integers(INT64.min, INT64.max) | st.integers(-3, 3), max_size=80), max_size=14
    )
)
def test_any_integers_in_any_groups_come_back(groups):
    values = np.array([v for group in groups for v in group], dtype=np.int64)
    data = encode_integers(values, [len(group) for group in groups])
    decoded, used = decode_integers(data)
    assert used == len(data)
    np.testing.assert_array_equal(decoded, values)


def test_groups_follow_distributions_of_their_own():
    rng = np.random.default_rng(5)
    scales = 2.0 ** rng.integers(0, 14, 200)
    values = np.rint(rng.laplace(0.0, np.repeat(scales, 64))).astype(np.int64)
    apart, together = encode_integers(values, [64] * 200), encode_integers(values)
    # Entropy log2(2 e s) of a wide Laplace distribution; 1.5 bytes a group to say which it is.
    ideal = 64 * float(np.log2(2.0 * np.e * scales).sum()) / 8.0
    assert len(apart) < 1.03 * ideal + 1.5 * 200
    assert len(apart) < 0.9 * len(together)
    np.testing.assert_array_equal(decode_integers(apart)[0], values)


def test_rare_events_cost_their_information():
    values = np.zeros(1_000_000, np.int64)
    values[np.random.default_rng(1).choice(len(values), 100, replace=False)] = 7
    # 100 of a million: 100 log2(1e4 e) bits.
    assert len(encode_integers(values)) < 1.02 * 100 * np.log2(1e4 * np.e) / 8 + 64


def test_integer_types_and_offsets_do_not_matter():
    values = np.random.default_rng(2).integers(-100, 100, 500).astype(np.int16)
    np.testing.assert_array_equal(decode_integers(encode_integers(values))[0], values)
    far = values.astype(np.int64) + 10**15
    assert len(encode_integers(far)) < len(encode_integers(values)) + 12


@pytest.mark.parametrize(
    ("values", "groups"),
    [(np.zeros((2, 2), int), None), (np.zeros(3, int), [1, 1]), ([1], [2, -1])],
)
def test_what_is_no_list_of_groups_is_refused(values, groups):
    with pytest.raises(ValueError, match="integers"):
        encode_integers(values, groups)


@pytest.mark.parametrize("groups", [None, [50] * 20])
def test_damaged_bytes_give_an_error_or_other_integers(groups):
    rng = np.random.default_rng(8)
    values = np.rint(rng.laplace(0.0, 300.0, 1000)).astype(np.int64)
    data = encode_integers(values, groups)
    for end in range(len(data)):
        with pytest.raises(ValueError, match="coded integers"):
            decode_integers(data[:end])
    for _ in range(600):
        damaged = bytearray(data)
        damaged[rng.integers(min(len(data), 60))] = rng.integers(256)
        try:
            decode_integers(bytes(damaged), limit=10_000)
        except ValueError as error:
            assert "coded integers" in str(error)  # noqa: PT017


def test_more_integers_than_expected_are_not_made_room_for():
    data = encode_integers(np.zeros(100_000, np.int64))
    with pytest.raises(ValueError, match="at most 99999"):
        decode_integers(data, limit=99_999)


def test_buckets_cover_every_magnitude_once():
    edges = bucket_edges(LAST_BUCKET + 1)
    assert (np.diff(edges) >= 1).all()
    # The last number of a bucket and the first of the next, where float64 holds both exactly.
    exact = edges[(edges >= 1) & (edges < 2.0**53)].astype(np.uint64)
    np.testing.assert_array_equal(buckets(exact)[0], buckets(exact - np.uint64(1))[0] + 1)
    assert buckets(np.array([2**64 - 1], np.uint64))[0][0] == LAST_BUCKET
    assert buckets(np.array([2**63 - 1], np.uint64))[1][0] == 58


def test_powers_of_one_half_are_exact_to_rounding():
    x = np.linspace(0.0, 900.0, 40_001)
    # 18 Taylor coefficients leave (ln 2)^18 / 18! = 2e-19: the rounding of 17 products and sums.
    np.testing.assert_allclose(half_power(x), 2.0**-x, rtol=17 * 2.2e-16)
    np.testing.assert_array_equal(half_power(np.arange(5.0)), [1.0, 0.5, 0.25, 0.125, 0.0625])
