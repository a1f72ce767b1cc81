"""Bounds, what they mean for a block, and errors as measured."""

from __future__ import annotations

import math

import numpy as np
import pytest

from compress.bounds import KINDS, Bound, Errors, Target, measure, norm


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(3).standard_normal((5, 7, 3))


def test_relative_bound_follows_the_norm_down_to_the_floor(values):
    bound = Bound("relative", 1e-2)
    assert bound.target(values).frobenius == 1e-2 * norm(values)
    tiny = 1e-9 * values
    assert bound.target(tiny, floor=2.0).frobenius == 1e-2 * 2.0 * math.sqrt(values.size)
    assert bound.target(values).maximum == math.inf


@pytest.mark.parametrize("bad", [1.79e308, math.inf, math.nan])
def test_relative_bound_of_no_finite_norm_is_refused(values, bad):
    values[:2] = bad
    with pytest.raises(ValueError, match="relative bound: the norm of the values is"):
        Bound("relative", 1e-2).target(values)


def test_absolute_bounds_do_not_follow_the_norm(values):
    for scale in (1.0, 1e-6):
        assert Bound("rmse", 0.5).target(scale * values).rmse(values.size) == 0.5
        assert Bound("pointwise", 0.5).target(scale * values) == Target(maximum=0.5)


def test_exact_bound_allows_nothing(values):
    target = Bound("exact").target(values)
    assert target.exact
    assert target.met_by(measure(values, values))
    assert not target.met_by(measure(values, np.nextafter(values, math.inf)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_bounds_that_bound_nothing_are_refused(kind, value):
    with pytest.raises(ValueError, match="bound"):
        Bound(kind, value)


def test_errors_of_parts_add_up_to_those_of_the_whole(values):
    noisy = values + 1e-3 * np.random.default_rng(4).standard_normal(values.shape)
    whole = measure(values, noisy)
    parts = measure(values[:2], noisy[:2]) + measure(values[2:], noisy[2:])
    assert parts.count == whole.count
    assert parts.maximum == whole.maximum
    assert (parts.least, parts.most) == (whole.least, whole.most)
    assert parts.frobenius == pytest.approx(whole.frobenius, rel=1e-14)
    assert parts.nrmse == pytest.approx(whole.nrmse, rel=1e-14)
    assert (Errors() + whole) == whole


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1.0, 1e160, 1e300])
def test_norm_neither_overflows_nor_underflows(scale):
    assert norm(np.full((3, 4), scale)) == pytest.approx(math.sqrt(12.0) * scale, rel=1e-15)


def test_norm_of_denormals_is_not_lost():
    assert norm(np.full(4, 5e-324)) == 1e-323
