"""Blocks coded as integer paths: within their bound, close to it, small, the same everywhere."""

from __future__ import annotations

import hashlib
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compress import _kernels_predictive as kernels
from compress import predictive
from compress.bounds import Bound, Target, measure
from compress.effort import BEST, EFFORTS, FAST
from compress.predictive import decode, encode, encode_and_decode

GRAVITY = np.array([0.0, 0.0, -9.81e-3])  # m/s a step of 1 ms


def walk(seed: int, shape: tuple[int, int, int], activity: float = 0.3) -> np.ndarray:
    """Velocities (T, n, w) that jump now and then, as bodies in contact do."""
    rng = np.random.default_rng(seed)
    jumps = rng.laplace(0.0, 0.1, shape) * (rng.random(shape) < activity)
    jumps[0] = rng.standard_normal(shape[1:])
    return np.cumsum(jumps, axis=0)


def falling(steps: int = 32, bodies: int = 4096) -> np.ndarray:
    """Velocities of bodies in free flight from one start, with rounding errors."""
    start = np.array([0.0, 0.0, -0.3])
    exact = start + GRAVITY * np.arange(steps)[:, None, None]
    noise = np.random.default_rng(4).standard_normal((steps, bodies, 3))
    return exact * (1.0 + 1e-15 * noise)


@st.composite
def fields(draw) -> np.ndarray:
    """Blocks of any small shape, activity and magnitude."""
    shape = tuple(draw(st.integers(1, top)) for top in (9, 40, 4))
    values = walk(draw(st.integers(0, 10**6)), shape, draw(st.sampled_from([0.0, 0.1, 1.0])))
    if draw(st.booleans()):
        values[draw(st.integers(0, shape[0] - 1)), draw(st.integers(0, shape[1] - 1)), 0] = 1e6
    values *= 10.0 ** draw(st.sampled_from([-300, -12, 0, 5, 290]))
    if draw(st.booleans()):
        with np.errstate(over="ignore"):
            return values.astype(np.float32)
    return values


@settings(max_examples=60, deadline=None)
@given(
    fields(),
    st.sampled_from([1e-1, 1e-2, 1e-4, 1e-9]),
    st.sampled_from(["relative", "max"]),
    st.sampled_from([BEST, FAST]),
)
def test_measured_error_keeps_to_the_target(values, tau, kind, effort):
    # float32 cannot hold all of the magnitudes drawn.
    values = values[:, np.isfinite(values).all(axis=(0, 2))]
    if not values.any():
        return
    bound = tau * float(np.abs(values).max())
    target = Target(maximum=bound) if kind == "max" else Bound("relative", tau).target(values)
    if target.exact:
        return
    data, expected = encode_and_decode(values, target, effort=effort)
    decoded = decode(data)
    assert decoded.shape == values.shape
    assert decoded.dtype == values.dtype
    assert target.met_by(measure(values, decoded))
    assert decoded.tobytes() == expected.tobytes()


@pytest.mark.parametrize("tau", [0.3, 1e-1, 1e-2, 1e-3, 1e-6])
def test_noise_uses_what_error_is_allowed(tau):
    values = np.random.default_rng(0).standard_normal((16, 500, 3))
    target = Bound("relative", tau).target(values)
    errors = measure(values, decode(encode(values, target)))
    assert 0.95 * target.frobenius <= errors.frobenius <= target.frobenius
    quick = measure(values, decode(encode(values, target, effort=FAST)))
    assert FAST.enough * target.frobenius <= quick.frobenius <= target.frobenius


@pytest.mark.parametrize("tau", [1e-2, 1e-4])
def test_noise_costs_little_more_than_its_information(tau):
    # A path has to be given its first level, then differences: sqrt(2) times as wide.
    values = np.random.default_rng(0).standard_normal((8, 16384, 3))
    data = encode(values, Bound("relative", tau).target(values))
    gaussian = math.log2(1.0 / tau)  # bits a value at best: rate-distortion of a normal variable
    uniform = 0.5 * math.log2(2.0 * math.pi * math.e / 12.0)
    assert len(data) < (gaussian + uniform + 0.5) / 8.0 * values.size * 1.03


def test_both_conditions_of_a_target_hold_together():
    values = walk(7, (16, 300, 3))
    target = Target(frobenius=1e-2 * float(np.linalg.norm(values)), maximum=0.02)
    for effort in EFFORTS.values():
        assert target.met_by(measure(values, decode(encode(values, target, effort=effort))))


@pytest.mark.parametrize("effort", EFFORTS.values(), ids=EFFORTS)
@pytest.mark.parametrize("tau", [1e-1, 1e-3, 1e-6])
def test_free_flight_costs_next_to_nothing(tau, effort):
    values = falling()
    data = encode(values, Bound("relative", tau).target(values), effort=effort)
    assert len(data) <= 64  # of 3,145,728
    assert len(decode(data)) == len(values)


def landing_bodies(steps: int = 32, bodies: int = 2000) -> np.ndarray:
    """Velocities of bodies of which a third falls until it stops at once."""
    landing = np.random.default_rng(3).integers(0, 3 * steps, bodies)
    t = np.arange(steps)[:, None]
    values = np.zeros((steps, bodies, 3))
    values[..., 2] = np.where(t < landing, -1.0 - 9.81e-3 * t, 0.0)
    return values


@pytest.mark.parametrize(("tau", "most"), [(1e-1, 1.3), (1e-2, 1.15), (1e-3, 1.15)])
@pytest.mark.parametrize("activity", [0.01, 0.1, 0.5])
def test_greedy_paths_take_few_more_bytes(tau, most, activity):
    """Where bodies rest, shake, and land: the 15 % that fast may cost, twice that at low rates."""
    fall, shake = landing_bodies(), walk(6, (32, 2000, 3), activity)
    for values in (fall, shake, fall + 0.1 * shake):
        target = Bound("relative", tau).target(values)
        data, decoded = encode_and_decode(values, target, effort=FAST)
        assert target.met_by(measure(values, decoded))
        # Paths that all bodies share fit the levels of one width by chance better than of another.
        assert len(data) <= most * len(encode(values, target)) + 256


def test_greedy_paths_hold_through_noise_and_follow_jumps():
    """Within a whole step of the value, and still where the value stays within half a step."""
    rng = np.random.default_rng(2)
    values = np.zeros((40, 200, 1))
    values[20:] = rng.integers(5, 50, (1, 200, 1))
    values += rng.uniform(-0.45, 0.45, values.shape)
    counts = np.zeros((0, kernels.LEVELS + 1, 2 * kernels.SPAN + 1))
    prices = np.broadcast_to(
        np.abs(np.arange(-kernels.SPAN, kernels.SPAN + 1)) * 4.0, (1, *counts.shape[1:])
    ).copy()
    residuals, sums = np.empty((40, 1, 200), np.int64), np.zeros((5, 3))
    kernels.greedy_paths(
        values, np.empty((40, 0, 1)), np.zeros(1), np.zeros(1), 1.0, 0.2, prices, math.inf,
        np.zeros(200, np.int64), residuals, sums, counts,
    )  # fmt: skip
    levels = np.cumsum(residuals, axis=0)[:, 0]
    error = values[:, :, 0] - levels
    assert np.abs(error).max() < 1.0
    moves = np.abs(residuals[1:, 0]) > 0
    assert moves[19].all()
    assert moves.sum() == moves[19].sum()
    # The sums of errors, signs aside, are those of the paths.
    assert sums[:, 0].sum() == values.size
    np.testing.assert_allclose(sums[:, 2].sum(), np.square(error).sum(), rtol=1e-12)


def test_bodies_land_one_after_the_other(monkeypatch):
    """A flight of a known length costs less than following its fall, or falling on after it."""
    bodies = 2000
    values = landing_bodies(bodies=bodies)
    target = Target(maximum=1e-3)
    data = encode(values, target)
    assert target.met_by(measure(values, decode(data)))
    # Which third lands when, 5 bits, and from which of about 1,000 levels; twice that in all.
    assert len(data) < 2.1 * 0.33 * (5 + 10) / 8 * bodies
    monkeypatch.setattr(predictive, "_find_drift", lambda x: np.zeros(x.shape[1]))
    assert len(data) < 0.3 * len(encode(values, target))


def test_rest_is_cheap_next_to_motion():
    still, moving = walk(1, (32, 500, 3), 0.01), walk(1, (32, 500, 3), 0.5)
    target = Target(frobenius=1e-2 * math.sqrt(still.size))
    first = len(encode(still[:1], Target(frobenius=1e-2 * math.sqrt(still[:1].size))))
    assert len(encode(still, target)) - first < 0.1 * (len(encode(moving, target)) - first)


@pytest.mark.parametrize(
    "steps", [slice(0, 1), slice(0, 7), slice(5, 12), slice(11, 12), slice(3, 3)]
)
@pytest.mark.parametrize("target", [Target(frobenius=3.0), Target(maximum=0.05)])
def test_decoded_steps_equal_steps_of_all_decoded(steps, target):
    values = walk(2, (12, 200, 3))
    data = encode(values, target)
    np.testing.assert_array_equal(decode(data, steps=steps), decode(data)[steps])


def test_guide_of_velocities_leaves_positions_little_to_say():
    h = 1e-3
    velocity = walk(3, (32, 400, 3))
    position = np.cumsum(h * velocity, axis=0) + np.random.default_rng(0).random((400, 3))
    decoded = decode(encode(velocity, Bound("relative", 1e-2).target(velocity)))
    target = Target(maximum=1e-4)
    guided, alone = encode(position, target, guide=h * decoded), encode(position, target)
    keyframe = len(encode(position[:1], target))
    assert len(guided) - keyframe < 0.2 * (len(alone) - keyframe)
    restored = decode(guided, guide=h * decoded)
    assert target.met_by(measure(position, restored))
    quick, expected = encode_and_decode(position, target, guide=h * decoded, effort=FAST)
    assert len(quick) <= 1.15 * len(guided)
    assert target.met_by(measure(position, expected))
    assert decode(quick, guide=h * decoded).tobytes() == expected.tobytes()
    part = decode(guided, guide=h * decoded, steps=slice(0, 9))
    np.testing.assert_array_equal(part, restored[:9])


def test_start_from_the_block_before_saves_the_first_step():
    values = walk(9, (64, 400, 3), 0.02)
    target = Bound("relative", 1e-2).target(values[32:])
    before = decode(encode(values[:32], target))[-1]
    chained, alone = encode(values[32:], target, start=before), encode(values[32:], target)
    assert len(chained) < 0.6 * len(alone)
    assert target.met_by(measure(values[32:], decode(chained, start=before)))


@pytest.mark.parametrize(
    "shape", [(1, 1, 1), (1, 50, 3), (50, 1, 3), (7, 5, 1), (4, 3, 9), (0, 4, 3)]
)
def test_shapes_at_the_edge_come_back(shape):
    values = walk(6, shape) if 0 not in shape else np.empty(shape)
    decoded = decode(encode(values, Target(maximum=1e-3)))
    assert decoded.shape == shape
    assert measure(values, decoded).maximum <= 1e-3


@pytest.mark.parametrize("value", [0.0, 3.7, -1e-300, 1e300])
def test_constant_block_takes_a_few_bytes(value):
    values = np.full((32, 1000, 3), value)
    target = Target(maximum=1e-3 * abs(value) if value else 1.0)
    data = encode(values, target)
    assert len(data) <= 64
    assert target.met_by(measure(values, decode(data)))


def test_outliers_do_not_spoil_the_rest():
    values = walk(4, (32, 500, 3), 0.05)
    target = Target(frobenius=1e-2 * math.sqrt(values.size))
    plain = len(encode(values, target))
    values[10, 7, 1] = 1e9
    values[20, 90, 2] = -1e8
    data = encode(values, target)
    # Each one goes there and back, 40 bits of magnitude each way, in wider tables.
    assert len(data) < 1.05 * plain + 200
    assert target.met_by(measure(values, decode(data)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_random_bits_expand_by_less_than_one_percent(dtype):
    values = np.random.default_rng(0).standard_normal((8, 300, 3)).astype(dtype)
    data = encode(values, Target(maximum=1e-30))
    assert len(data) <= 1.01 * values.nbytes
    np.testing.assert_array_equal(decode(data), values)


def test_what_cannot_be_coded_is_refused():
    values = walk(0, (4, 5, 3))
    with pytest.raises(ValueError, match="must allow an error"):
        encode(values, Target(0.0, 0.0))
    with pytest.raises(ValueError, match="must be"):
        encode(values[0], Target(maximum=1.0))
    with pytest.raises(ValueError, match="guide of shape"):
        encode(values, Target(maximum=1.0), guide=values[:, :2])
    values[2, 3, 1] = math.nan
    with pytest.raises(ValueError, match=r"\(2, 3, 1\) is not finite"):
        encode(values, Target(maximum=1.0))


@pytest.mark.parametrize("maximum", [1e-3, 1e-30])
def test_damaged_bytes_give_an_error_or_other_values(maximum):
    values = walk(5, (6, 40, 3))
    data = encode(values, Target(maximum=maximum))
    for end in range(0, len(data), 7):
        with pytest.raises(ValueError, match=r"block|coded"):
            decode(data[:end])
    rng = np.random.default_rng(1)
    for _ in range(300):
        damaged = bytearray(data)
        damaged[rng.integers(min(len(data), 40))] = rng.integers(256)
        try:
            decode(bytes(damaged), limit=20_000)
        except ValueError as error:
            assert "block" in str(error) or "coded" in str(error)  # noqa: PT017


def test_folded_residuals_unfold():
    size = np.concatenate([np.arange(3000), 2 ** np.arange(12, 50) - 1, 2 ** np.arange(12, 50)])
    residual = np.concatenate([size, -size])
    last = np.random.default_rng(0).integers(-2, 3, len(residual))
    symbols, widths = np.empty(len(residual), np.int32), np.empty(len(residual), np.int64)
    kernels.fold(residual, last, symbols, widths)
    low = np.abs(residual) & ((1 << widths) - 1)
    back = np.empty_like(residual)
    kernels.unfold(symbols, low, last, back)
    np.testing.assert_array_equal(back, residual)


def test_activities_of_one_context_differ_by_less_than_a_factor_of_two():
    levels = np.array([kernels.level_of(e) for e in range(1 << 14)])
    assert levels[0] == 0
    assert levels[1] == 1
    assert (np.diff(levels) >= 0).all()
    edges = np.flatnonzero(np.diff(levels)) + 1
    assert (edges[1:] <= 2 * edges[:-1]).all()


def test_chosen_paths_are_the_best_of_all_next_to_the_values():
    """Least J = squared error + weight sum |r|, against all 2^8 choices of floor and ceiling."""
    bodies, steps, step, weight = 30, 8, 0.1, 0.3
    x = np.ascontiguousarray(walk(8, (steps, bodies, 1)).transpose(1, 2, 0))
    sizes = np.abs(np.arange(-kernels.SPAN, kernels.SPAN + 1)).astype(float)
    # What lies beyond the span is priced logarithmically: start near zero.
    x -= x[:, :, :1] - 0.02
    prices = np.broadcast_to(sizes, (1, kernels.LEVELS + 1, len(sizes))).copy()
    r = np.empty(x.shape, np.int64)
    zero = np.zeros(1)
    kernels.choose_paths(
        x, np.empty((0, 1, steps)), zero, zero, step, weight, prices, np.zeros(3), math.inf,
        np.zeros(bodies, np.int64), np.zeros(bodies), r,
    )  # fmt: skip

    def cost(levels):
        residuals = np.diff(levels, axis=-1, prepend=0.0)
        return ((x[:, 0] / step - levels) ** 2 + weight * np.abs(residuals)).sum(axis=-1)

    choices = np.array(list(itertools.product((0, 1), repeat=steps)))
    least = cost(np.floor(x[:, 0] / step) + choices[:, None]).min(axis=0)
    # Sums of a few terms of order one.
    np.testing.assert_allclose(cost(np.cumsum(r[:, 0], axis=1)), least, rtol=1e-12)
    assert least.sum() < cost(np.rint(x[:, 0] / step)).sum()


def test_written_bytes_mean_the_same_values_for_ever():
    """A block as coded once: its values to the last bit, on every machine and in every version."""
    decoded = decode(bytes.fromhex(GOLDEN))
    assert decoded.shape == (6, 5, 2)
    assert hashlib.sha256(decoded.tobytes()).hexdigest() == GOLDEN_DIGEST


GOLDEN = (
    "0206050209eb01e003b7010000000000000032290936bbb6720d2e70dbc59e33c6f689a40dc1c7f454293e67"
    "d93ede5307f4cc354d67763249"
)
GOLDEN_DIGEST = "f910c48ba4e7865d2166e74da0e4ddcc48883c1952f1d492d6315bd33f3e430b"
