"""What a sample says of compression before any work."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from compress import explain as module
from compress.bounds import Bound, measure
from compress.coding import FieldSpec
from compress.decompose import tt_svd
from compress.explain import (
    Sampling,
    autocorrelation,
    correlate,
    explain,
    integrated_autocorrelation,
    ranks,
)
from dem_mpi.errors import InputError


def autoregressive(factor: float, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Stationary x_t = a x_{t-1} + noise along the first axis, of variance 1."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    noise[1:] *= math.sqrt(1.0 - factor**2)
    return lfilter([1.0], [1.0, -factor], noise, axis=0)


def reader(arrays: dict[str, np.ndarray]):
    return lambda name, first, stop: arrays[name][first:stop]


def test_autocorrelation_is_the_sum_of_its_definition():
    x = autoregressive(0.7, (37, 3))
    centred = x - x.mean(axis=0)
    expected = [
        (centred[: 37 - k] * centred[k:]).sum(axis=0) / (centred**2).sum(axis=0) for k in range(37)
    ]
    np.testing.assert_allclose(autocorrelation(x), expected, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-300, 1e-20, 1e300])
def test_autocorrelation_does_not_depend_on_scale(scale):
    x = autoregressive(0.7, (64, 2))
    np.testing.assert_allclose(autocorrelation(scale * x), autocorrelation(x), atol=1e-13)


def test_estimates_at_all_lags_sum_to_minus_a_half():
    found = autocorrelation(autoregressive(0.9, (200, 4)))
    np.testing.assert_allclose(found[1:].sum(axis=0), -0.5, atol=1e-12)


@pytest.mark.parametrize("factor", [0.0, 0.5, 0.9, 0.95])
def test_iac_of_an_autoregressive_series(factor):
    m, count = 1 << 15, 32
    sums, _ = integrated_autocorrelation(autocorrelation(autoregressive(factor, (m, count))))
    exact = (1.0 + factor) / (1.0 - factor)
    # The sum ends where noise of standard deviation sqrt(IAC / m) hides what is left: after about
    # log(sqrt(m / IAC)) / -log(a) lags, each with that noise, twice it in the sum of all.
    lags = 2.0 + (0.5 * math.log(m / exact) / -math.log(factor) if factor else 0.0)
    spread = 2.0 * math.sqrt(lags * exact / m) * exact**0.5
    assert abs(sums.mean() - exact) <= 3.0 * spread


def test_iac_ends_before_the_first_lag_that_is_not_positive():
    correlation = np.array([1.0, 0.5, 0.25, 0.0, 0.9])[:, None]
    assert integrated_autocorrelation(correlation) == (2.5, 2)
    alternating = autoregressive(-0.5, (1000, 1))
    assert integrated_autocorrelation(autocorrelation(alternating))[0] == 1.0
    positive = np.array([1.0, 0.5, 0.25])[:, None]
    assert integrated_autocorrelation(positive) == (2.5, 2)


def test_constant_series_are_left_out_even_with_rounding_errors():
    x = autoregressive(0.5, (64, 5, 3))
    x[:, 1] = 0.1
    ulps = np.random.default_rng(3).integers(-1, 2, (64, 3))
    x[:, 2] = 0.1 * (1.0 + np.finfo(float).eps * ulps)
    known = correlate([x])
    assert known.constant == 6
    assert known.mean[0] == 1.0
    assert correlate([x[:, 1:3]]).iac is None


def test_ranks_of_a_field_of_few_modes():
    steps, bodies = np.arange(32)[:, None, None], np.linspace(0.0, 1.0, 256)[None, :, None]
    field = bodies * np.cos(steps / 3.0) + bodies**2 * steps + np.zeros((1, 1, 3))
    largest = {one.form: one.largest for one in ranks(field, (1e-8,))}
    assert largest["natural"] == 2
    # On any side of a cut these functions are sums of 1, b, b^2 or of 1, t, cos t/3, sin t/3.
    assert largest["tensorised"] <= 4


def test_the_longer_the_correlation_the_higher_the_ratio():
    found = []
    for factor in (0.0, 0.5, 0.9, 0.99, 0.999):
        field = autoregressive(factor, (64, 200, 3))
        middle = correlate([field]).iac[1]
        natural = next(one.ratio for one in ranks(field, (1e-1,)) if one.form == "natural")
        found.append((middle, natural))
    iac, ratio = np.array(found).T
    assert (np.diff(iac) > 0.0).all()
    assert (np.diff(ratio) > 0.0).all()
    assert ratio[-1] > 10.0 * ratio[0]


def test_the_expected_ratio_follows_the_correlation():
    specs = {"a": FieldSpec(Bound("relative", 1e-2), width=1)}
    sampling = Sampling(windows=1, steps=64)
    found = []
    for factor in (0.0, 0.9, 0.99, 0.999):
        field = autoregressive(factor, (64, 300, 1))
        known = explain(reader({"a": field}), specs, np.arange(64.0), 64, None, sampling)
        found.append((known.fields[0].correlation.iac[1], known.fields[0].expected[0].whole))
    iac, ratio = np.array(found).T
    assert (np.diff(iac) > 0.0).all()
    assert (np.diff(ratio) > 0.0).all()


def strain_and_moduli() -> tuple[np.ndarray, np.ndarray]:
    """Time series (T, n, w) like those of S. De's triaxial test: of size 1e-1 and of size 1e7."""
    t = np.linspace(0.0, 1.0, 64)[:, None, None]
    place = np.random.default_rng(2).random((1, 32, 6))
    direction = np.array([-1.0, 0.4, 0.4, 0.1, 0.1, 0.1])
    strain = 0.1 * t * direction * (1.0 + 0.05 * place)
    moduli = 1e7 * (1.0 + place * np.exp(-(((t - 0.6 - 0.1 * place) / 0.05) ** 2)))
    return strain, moduli


def test_small_variables_are_lost_in_one_tensor_with_large_ones():
    # S. De, PhD thesis, University of Michigan 2021, fig. 4.2
    strain, moduli = strain_and_moduli()
    together = np.concatenate([strain, moduli], axis=2)
    mixed = tt_svd(together, tolerance=0.1).train.full()
    assert np.linalg.norm(mixed - together) <= 0.1 * np.linalg.norm(together)
    alone = measure(strain, tt_svd(strain, tolerance=0.1).train.full())
    assert alone.relative <= 0.1
    assert measure(strain, mixed[:, :, :6]).nrmse > 10.0 * alone.nrmse


def test_explanation_names_bound_sample_and_coders():
    field = autoregressive(0.9, (200, 50, 3))
    specs = {"speed": FieldSpec(Bound("relative", 1e-1), width=3, unit="m/s")}
    known = explain(reader({"speed": field}), specs, np.arange(200.0))
    text = "\n".join(known.lines)
    assert "50 of 50 bodies" in known.sample
    assert "speed (relative 0.1)" in text
    assert "IAC" in text
    assert "first lag that is not positive" in text
    best = known.fields[0].expected[0]
    assert best.coder == "any"
    assert best.low <= best.whole <= best.high
    assert all(best.whole >= other.whole * (1.0 - 1e-12) for other in known.fields[0].expected)


def test_expected_ratio_is_that_of_the_chunks_where_all_bodies_are_seen():
    field = autoregressive(0.9, (64, 40, 3))
    specs = {"speed": FieldSpec(Bound("exact"), width=3)}
    sampling = Sampling(windows=2, steps=32)
    known = explain(reader({"speed": field}), specs, np.arange(64.0), 32, None, sampling)
    sizes = [len(module.coders.raw.encode(field[k : k + 32])) for k in (0, 32)]
    best = known.fields[0].expected[0]
    assert best.whole == pytest.approx(2 * field[:32].nbytes / sum(sizes), rel=1e-12)
    assert best.low == pytest.approx(field[:32].nbytes / max(sizes), rel=1e-12)


def test_work_does_not_grow_with_the_data():
    read = []

    def endless(name: str, first: int, stop: int) -> np.ndarray:
        read.append(stop - first)
        return np.random.default_rng(first).standard_normal((stop - first, 3000, 1))

    specs = {"a": FieldSpec(Bound("relative", 0.1))}
    sampling = Sampling(windows=3, steps=40, bodies=64)
    known = explain(endless, specs, np.arange(10.0**6), 8, None, sampling)
    assert sum(read) == 3 * 40
    assert "64 of 3,000 bodies" in known.sample


def test_values_that_are_not_finite_need_an_exact_bound():
    field = np.ones((40, 9, 2))
    field[35, 4, 1] = math.nan
    arrays = reader({"a": field})
    with pytest.raises(InputError, match="a: nan at step 35, row 4, component 1"):
        explain(arrays, {"a": FieldSpec(Bound("rmse", 1.0), width=2)}, np.arange(40.0))
    known = explain(arrays, {"a": FieldSpec(Bound("exact"), width=2)}, np.arange(40.0))
    assert known.fields[0].correlation is None


@pytest.mark.parametrize("size", ["windows", "steps", "bodies", "runs"])
def test_samples_of_nothing_are_refused(size):
    with pytest.raises(ValueError, match=size):
        Sampling(**{size: 0})
