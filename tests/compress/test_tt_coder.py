"""Trains with rounded, entropy-coded cores: their errors, their bytes, and parts of blocks."""

from __future__ import annotations

import hashlib
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compress import tt_tensorised
from compress._bytes import Bytes
from compress.bounds import Bound, Target, measure, norm
from compress.quantise import round_matrix, unround
from compress.step_search import Seeker, step_code, step_size
from compress.tt_coder import TENSORISED, Header, decode, encode, pays

FORMS = ("natural", "tensorised")
GRAVITY = np.array([0.0, 0.0, -9.81])


def low_rank(seed: int, shape: tuple[int, int, int], rank: int, noise: float) -> np.ndarray:
    """A sum of `rank` smooth motions with random shares for bodies, and white noise."""
    rng = np.random.default_rng(seed)
    steps, bodies, width = shape
    time = np.linspace(0.0, 1.0, steps)[:, None, None]
    values = noise * rng.standard_normal(shape)
    for k in range(rank):
        share = rng.standard_normal((bodies, width)) * 2.0**-k
        values += np.cos(math.pi * k * time + rng.uniform(0.0, 6.0)) * share
    return values


def free_fall(steps: int, bodies: int, hits: int = 0, seed: int = 0) -> np.ndarray:
    """Velocities of bodies that fall; some of them stop at a random step and stay near rest."""
    rng = np.random.default_rng(seed)
    time = 1e-3 * np.arange(1, steps + 1)[:, None, None]
    values = np.broadcast_to(GRAVITY * time, (steps, bodies, 3)).copy()
    for body, step in zip(
        rng.permutation(bodies)[:hits], rng.integers(0, steps, hits), strict=True
    ):
        values[step:, body] = 1e-3 * rng.standard_normal(3)
    return values


def used(values: np.ndarray, data: bytes, target: Target, order: np.ndarray | None = None) -> float:
    """The share of the target that the error of the decoded block takes."""
    errors = measure(values, decode(data, order))
    return max(errors.frobenius / target.frobenius, errors.maximum / target.maximum)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    steps=st.integers(1, 20),
    bodies=st.integers(1, 90),
    width=st.integers(1, 4),
    rank=st.integers(0, 4),
    noise=st.sampled_from([0.0, 1e-6, 1e-2, 1.0]),
    tolerance=st.sampled_from([0.3, 1e-1, 1e-2, 1e-3, 1e-6, 1e-10]),
    exponent=st.sampled_from([0, 0, -1000, 990]),
    form=st.sampled_from(FORMS),
    dtype=st.sampled_from([np.float64, np.float32]),
)
def test_error_keeps_to_the_relative_bound(
    seed, steps, bodies, width, rank, noise, tolerance, exponent, form, dtype
):
    values = low_rank(seed, (steps, bodies, width), rank, noise)
    values = np.ldexp(values, exponent if dtype == np.float64 else exponent // 12).astype(dtype)
    target = Bound("relative", tolerance).target(values)
    data = encode(values, target, form=form)
    decoded = decode(data)
    assert decoded.dtype == dtype
    assert target.met_by(measure(values, decoded))
    assert len(data) <= values.nbytes + 16


def test_one_body_is_a_train_over_time_alone():
    values = low_rank(0, (2, 1, 2), 0, 1e-6)
    target = Bound("relative", 0.3).target(values)
    assert target.met_by(measure(values, decode(encode(values, target, form="tensorised"))))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    bodies=st.integers(1, 200),
    tolerance=st.sampled_from([0.5, 1e-2, 1e-4]),
    form=st.sampled_from(FORMS),
)
def test_error_keeps_to_the_pointwise_bound(seed, bodies, tolerance, form):
    values = low_rank(seed, (12, bodies, 3), 3, 1e-2)
    target = Bound("pointwise", tolerance).target(values)
    errors = measure(values, decode(encode(values, target, form=form)))
    assert errors.maximum <= tolerance


@pytest.mark.parametrize("frobenius", [math.inf, 3.0])
@pytest.mark.parametrize("order", [None, np.random.default_rng(20).permutation(200)])
def test_pointwise_targets_give_the_tensorised_form_asked_for(frobenius, order):
    values = low_rank(21, (12, 200, 3), 3, 1e-3)
    target = Target(frobenius, maximum=5e-2)
    data = encode(values, target, order=order, form="tensorised")
    assert Header.read(Bytes(data)).mode == TENSORISED
    assert target.met_by(measure(values, decode(data, order)))


def test_one_entry_that_stands_out_is_no_reason_to_keep_the_block_as_it_is():
    # The norm is below what independent errors of this size would have.
    values = low_rank(22, (12, 200, 3), 2, 0.0)
    values[5, 100, 1] = 1e3
    target = Target(maximum=900.0)
    data = encode(values, target, form="tensorised")
    assert pays(data)
    assert target.met_by(measure(values, decode(data)))


def test_nearly_all_of_the_target_is_used():
    # The search ends above 0.985 of the target; steps are 1e-3 of each other apart.
    values = low_rank(1, (32, 3000, 3), 5, 1e-2)
    for tolerance in (1e-1, 1e-2, 1e-3):
        target = Bound("relative", tolerance).target(values)
        assert 0.985 <= used(values, encode(values, target), target) <= 1.0


def test_both_conditions_of_a_target_hold():
    values = low_rank(2, (16, 400, 3), 4, 1e-2)
    for maximum in (1e-3, 1e-1):
        target = Target(1e-2 * norm(values), maximum)
        assert target.met_by(measure(values, decode(encode(values, target))))


def test_free_fall_costs_tens_of_bytes_whatever_the_number_of_bodies():
    for bodies in (1000, 16000):
        values = free_fall(32, bodies)
        for tolerance in (1e-1, 1e-3):
            target = Bound("relative", tolerance).target(values)
            assert len(encode(values, target)) <= 48
            assert len(encode(values, target, form="tensorised")) <= 400


def test_bodies_that_have_hit_the_floor_are_paid_for_alone():
    target = Bound("relative", 1e-2).target(free_fall(32, 4000))
    sizes = [len(encode(free_fall(32, 4000, hits), target)) for hits in (0, 40, 400)]
    assert sizes[0] < 48
    # A step at a random time and an address of log2(100) bits: some ten coefficients of ten bits.
    assert sizes[1] < 48 + 40 * 24
    assert sizes[2] < 48 + 400 * 24


def test_error_falls_with_the_bytes_at_six_decibels_a_bit():
    """Of full-rank data halving the error costs one bit a value, and no more than 5 % above it."""
    values = np.random.default_rng(4).standard_normal((8, 4000, 3))
    sizes = [
        len(encode(values, Bound("relative", tolerance).target(values)))
        for tolerance in (2.0**-6, 2.0**-7, 2.0**-8)
    ]
    for coarse, fine in pairwise(sizes):
        assert 0.95 <= 8 * (fine - coarse) / values.size <= 1.05


def test_white_noise_never_costs_more_than_it_is():
    values = np.random.default_rng(5).standard_normal((9, 50, 3))
    for form in FORMS:
        data = encode(values, Bound("relative", 1e-15).target(values), form=form)
        assert not pays(data)
        assert len(data) <= values.nbytes + 16
        assert np.array_equal(decode(data), values)


def test_tensorised_noise_is_kept_as_it_is_rather_than_expanded():
    values = np.random.default_rng(6).standard_normal((16, 256, 3))
    data = encode(values, Bound("relative", 1e-6).target(values), form="tensorised")
    assert len(data) <= values.nbytes + 16


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_parts_are_slices_of_the_whole_bit_for_bit(form, dtype):
    values = low_rank(7, (13, 301, 3), 4, 1e-3).astype(dtype)
    order = np.random.default_rng(8).permutation(301)
    data = encode(values, Bound("relative", 1e-2).target(values), order=order, form=form)
    assert pays(data)
    whole = decode(data, order)
    for steps, bodies in [
        (slice(3, 9), slice(100, 200)),
        (slice(None, None, 5), np.array([300, 0, 17, 17])),
        (np.array([12]), slice(300, 301)),
        (slice(4, 4), slice(None)),
        (None, slice(5, 5)),
    ]:
        part = decode(data, order, steps, bodies)
        expected = whole[slice(None) if steps is None else steps][:, bodies]
        assert part.shape == expected.shape
        assert part.tobytes() == np.ascontiguousarray(expected).tobytes()


@pytest.mark.parametrize("axes", range(len(tt_tensorised.ORDERS)))
def test_either_order_of_axes_keeps_the_bound_and_gives_parts_bit_for_bit(axes, monkeypatch):
    values = low_rank(23, (13, 301, 3), 4, 1e-3)
    order = np.random.default_rng(24).permutation(301)
    target = Bound("relative", 1e-2).target(values)
    monkeypatch.setattr(tt_tensorised, "choose_axes", lambda *_: axes)
    data = encode(values, target, order=order, form="tensorised")
    assert Header.read(Bytes(data)).mode == TENSORISED
    whole = decode(data, order)
    assert target.met_by(measure(values, whole))
    for steps, bodies in [(slice(3, 9), slice(100, 200)), (np.array([12, 0]), np.array([300, 0]))]:
        part = decode(data, order, steps, bodies)
        expected = whole[steps][:, bodies]
        assert part.tobytes() == np.ascontiguousarray(expected).tobytes()


def test_order_of_axes_is_the_one_of_fewer_bytes():
    repeated = np.tile(np.random.default_rng(25).standard_normal((32, 16, 3)), (1, 16, 1))
    chosen = set()
    for values in (repeated, free_fall(32, 300, hits=100, seed=26)):
        target = Bound("relative", 1e-1).target(values)
        sizes = [
            len(tt_tensorised.encode(values, None, target, axes))
            for axes in range(len(tt_tensorised.ORDERS))
        ]
        axes = tt_tensorised.choose_axes(values, None, target)
        assert sizes[axes] == min(sizes)
        chosen.add(axes)
    assert len(chosen) == 2


def test_sample_of_another_magnitude_than_the_block_decides_nothing():
    values = np.full((4, 5000, 3), 1e-300)
    values[1, 1000, 2] = 1e300
    target = Target(maximum=1e299)
    data = encode(values, target, form="tensorised")
    assert target.met_by(measure(values, decode(data)))


def test_trial_of_orders_codes_a_sample_of_bodies(monkeypatch):
    seen = []
    monkeypatch.setattr(
        tt_tensorised, "encode", lambda values, *_: seen.append(values.shape) or b"code"
    )
    tt_tensorised.choose_axes(np.ones((2, 5000, 3)), None, Target(1.0))
    assert set(seen) == {(2, tt_tensorised.TRIAL_BODIES, 3)}


def test_long_blocks_are_coded_in_sections_that_can_be_read_alone():
    values = low_rank(9, (700, 40, 3), 3, 1e-3)
    target = Bound("relative", 1e-2).target(values)
    data = encode(values, target)
    whole = decode(data)
    assert target.met_by(measure(values, whole))
    assert len(data) < values.nbytes / 20
    assert np.array_equal(decode(data, steps=slice(160, 420, 7)), whole[160:420:7])
    chosen = np.array([699, 0, 350])
    assert np.array_equal(decode(data, steps=chosen, bodies=slice(3, 5)), whole[chosen][:, 3:5])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "values",
    [
        np.zeros((32, 100, 3)),
        np.full((32, 100, 3), -7.5),
        np.full((1, 1, 1), 3.0),
        low_rank(10, (1, 200, 3), 2, 0.1),
        low_rank(11, (40, 1, 3), 2, 0.1),
        low_rank(12, (7, 16381, 1), 2, 1e-3),
        1e-300 * low_rank(13, (7, 30, 3), 2, 0.1),
        1e300 * low_rank(14, (7, 30, 3), 2, 0.1),
        np.full((5, 20, 2), 1e307),
        np.full((5, 20, 2), 5e-324),
        low_rank(15, (7, 30, 3), 2, 0.1) * np.logspace(-12, 12, 30)[:, None],
    ],
    ids=[
        *("zero", "constant", "one value", "one step", "one body", "prime numbers", "1e-300"),
        *("1e300", "1e307", "denormal", "24 decades"),
    ],
)
def test_hard_cases_keep_to_the_bound(values, form):
    for tolerance in (1e-1, 1e-4):
        target = Bound("relative", tolerance).target(values)
        if target.frobenius == 0.0:
            target = Target(frobenius=1e-2)
        data = encode(values, target, form=form)
        assert target.met_by(measure(values, decode(data)))
        assert len(data) <= values.nbytes + 16
        pointwise = Target(maximum=tolerance * float(np.abs(values).max()) or 1e-2)
        data = encode(values, pointwise, form=form)
        assert pointwise.met_by(measure(values, decode(data)))
        assert len(data) <= values.nbytes + 16


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("tolerance", [0.9, 1e-4])
def test_values_whose_norm_overflows_keep_to_the_pointwise_bound(form, tolerance):
    for profile in (np.ones(20), np.linspace(-1.0, 1.0, 20)):
        values = 1.7e308 * np.ones((5, 20, 2)) * profile[:, None]
        target = Target(maximum=tolerance * 1.7e308)
        assert target.met_by(measure(values, decode(encode(values, target, form=form))))


def test_empty_blocks_stay_empty():
    for shape in ((0, 5, 3), (4, 0, 3), (4, 5, 0)):
        assert decode(encode(np.zeros(shape), Target(frobenius=1.0))).shape == shape


def test_exact_targets_keep_every_bit():
    values = low_rank(16, (3, 10, 3), 2, 0.1)
    values[0, 0, 0] = -0.0
    data = encode(values, Bound("exact").target(values))
    assert decode(data).tobytes() == values.tobytes()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_are_refused_with_their_place(bad):
    values = np.zeros((4, 5, 3))
    values[2, 3, 1] = bad
    with pytest.raises(ValueError, match=r"values\[2, 3, 1\]"):
        encode(values, Target(frobenius=1.0))


def test_other_types_and_forms_are_refused():
    with pytest.raises(ValueError, match="int64"):
        encode(np.zeros((2, 2, 2), np.int64), Target(1.0))
    with pytest.raises(ValueError, match="2 dimensions"):
        encode(np.zeros((2, 2)), Target(1.0))
    with pytest.raises(ValueError, match="form"):
        encode(np.zeros((2, 2, 2)), Target(1.0), form="matrix")


@pytest.mark.parametrize("form", FORMS)
def test_damaged_bytes_are_refused_or_harmless(form):
    """Never anything but ValueError or an array of a definite shape, and never a long wait.

    A flipped bit of an entropy code may well decode to something else; sums that tell are the
    business of files.
    """
    values = low_rank(17, (8, 60, 3), 3, 1e-4)
    data = encode(values, Bound("relative", 1e-2).target(values), form=form)
    assert pays(data)
    rng = np.random.default_rng(18)
    for trial in range(150):
        broken = bytearray(data)
        for at in rng.integers(0, len(data) if trial % 2 else min(len(data), 24), 2):
            broken[at] ^= 1 << rng.integers(0, 8)
        try:
            part = decode(bytes(broken), steps=slice(0, 2), bodies=slice(0, 2))
        except ValueError:
            continue
        assert part.ndim == 3


@pytest.mark.parametrize("form", FORMS)
def test_cut_heads_and_unknown_kinds_are_refused(form):
    values = low_rank(19, (8, 60, 3), 3, 1e-4)
    data = encode(values, Bound("relative", 1e-2).target(values), form=form)
    assert pays(data)
    for length in range(10):
        with pytest.raises(ValueError):
            decode(data[:length])
    with pytest.raises(ValueError):
        decode(b"\x0f" + data[1:])
    with pytest.raises(ValueError):
        decode(b"\x00" + data[1:])


def test_unknown_orders_of_axes_are_refused():
    values = low_rank(19, (8, 60, 3), 3, 1e-4)
    data = encode(values, Bound("relative", 1e-2).target(values), form="tensorised")
    head = len(Header(TENSORISED, values.dtype, values.shape).pack())
    with pytest.raises(ValueError, match="order of axes"):
        decode(data[:head] + bytes([len(tt_tensorised.ORDERS)]) + data[head + 1 :])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    rows=st.integers(0, 60),
    columns=st.integers(0, 12),
    scale=st.sampled_from([0.0, 0.05, 0.7, 30.0, 1e6, 1e12]),
    price=st.sampled_from([0.0, 0.1]),
)
def test_rounded_matrices_come_back(seed, rows, columns, scale, price):
    rng = np.random.default_rng(seed)
    x = scale * rng.standard_normal((rows, columns)) * rng.exponential(1.0, (rows, 1))
    rounded = round_matrix(x, price)
    assert np.array_equal(unround(rounded.data, rows, columns), rounded.q)
    assert np.abs(np.abs(x) - np.abs(rounded.q)).max(initial=0.0) <= (0.5 if price == 0.0 else 1.4)


@pytest.mark.parametrize("deviation", [1.0, 8.0, 200.0])
def test_code_of_independent_numbers_is_near_their_entropy(deviation):
    """Within 4 %: two leading bits are modelled besides the length, the others are not."""
    x = deviation * np.random.default_rng(20).standard_normal((20000, 4))
    rounded = round_matrix(x, price=0.0)
    share = np.unique(rounded.q, return_counts=True)[1] / x.size
    entropy = -float(share @ np.log2(share)) * x.size / 8.0
    assert entropy <= len(rounded.data) + 8 <= 1.04 * entropy


def test_long_matrices_of_zeros_take_almost_nothing():
    assert len(round_matrix(np.zeros((16384, 2))).data) <= 4


def test_seeker_finds_the_step_of_a_power_law():
    for slope in (0.4, 1.0, 1.7):
        seeker = Seeker(2.0**-20)
        for _ in range(8):
            excess = (step_size(seeker.step) / 2.0**-9.3) ** slope
            if seeker.learn(excess):
                break
        assert 0.985 <= excess <= 1.0


def test_steps_are_the_largest_numbered_ones_below():
    for step in (1.0, 0.7, 3e-9, 2.0**-60, 5.0):
        code = step_code(step)
        assert step_size(code) <= step < step_size(code + 1)


@pytest.mark.parametrize(
    ("text", "digest"),
    [
        (
            "010609020852dc0420137b397190ac0f194249b68db3194a85d95653ada59809f8d12e759c55f413938021133f"
            "f6449da7027552dcbc9f1c983da54ef2d848f3",
            "ddea6c658ddbaece",
        ),
        (
            "02060902000882da040305030201010d0124190384c3a9f6b0764cf95eee1a491abd0d133f3ac186180e8d0ebe14"
            "8320201354fbfe28f84c878137d91d0558aefa769d70ee6aae84a0cdb5acf1d9d733a01b00011f9bd14b864ea7"
            "d617ad4fac7a22c28c59cd8ca0ebf2be9f600c00010bbee7614351c5cd826807133b0504204b80",
            "2063bd223136026a",
        ),
        (
            "02060902010271d6000303020403010c01242003519ffffdbd2a11d602068fab00120e00001b1814aa982986aa"
            "600b8a0f1200001339d760a62e8fa3db3960bd1a7dc0401800002c35b78c66c81dd680ba8bf0b669968dd5b213"
            "45b4402c1340a32790d8a91320b928a5e32e511b17e0c9e2fe07bf286788aa92bdbefc44b301a6a7ca28b342bc"
            "93e44410133b0dbe90fafd4a6993769cc18ebe80",
            "a2e2418ea51069ee",
        ),
    ],
    ids=(*FORMS, "tensorised, time first"),
)
def test_code_of_another_machine_gives_the_same_bits(text, digest):
    """Fields are predicted from decoded ones: what is decoded must not depend on the machine."""
    decoded = decode(bytes.fromhex(text)).astype("<f8")
    assert hashlib.sha256(decoded.tobytes()).hexdigest()[:16] == digest
