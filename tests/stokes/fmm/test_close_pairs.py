"""Pairs closer than single precision can tell are summed in double."""

from __future__ import annotations

import numpy as np
import pytest

from stokes.fmm import KERNELS, Fmm, FmmOptions, direct_sum
from stokes.fmm.accuracy import cloud
from stokes.fmm.close_pairs import ClosePairs, close_distance
from stokes.fmm.near_field import NearField


def groups_of(points, size):
    """Lists of the near field: groups of `size` points on a curve, each listing all of them."""
    bounds = np.append(np.arange(0, points, size), points)
    ranges = np.stack((bounds[:-1], bounds[1:]), axis=1)
    k = len(ranges)
    return ranges, np.arange(k + 1) * k, np.tile(ranges, (k, 1))


def twins(points, gaps, seed=3):
    """A copy of every point, at a distance from it given by its gap, in a random direction."""
    step = np.random.default_rng(seed).normal(size=points.shape)
    step /= np.linalg.norm(step, axis=1)[:, None]
    return points + np.reshape(gaps, (-1, 1)) * step


@pytest.mark.parametrize("size", [1, 7, 40])
def test_pairs_found_are_those_of_an_exhaustive_search(size):
    x = cloud("cube", 200, 1)
    x = np.vstack((x, twins(x[:60], np.geomspace(1e-6, 1e-1, 60)), x[:5]))
    columns = np.ascontiguousarray(x.T)
    ranges, start, sources = groups_of(len(x), size)
    pairs = ClosePairs(
        KERNELS["laplace"], columns, ranges, columns, start, sources, distance=2.0**-5
    )
    distance = np.linalg.norm(x[:, None] - x[None], axis=2)
    expected = 0
    for first, last in ranges:
        reach = 2.0**-5 * np.ptp(x[first:last], axis=0).max()
        expected += np.count_nonzero((distance[first:last] > 0.0) & (distance[first:last] < reach))
    assert len(pairs) == expected
    assert (expected > 0) == (size > 1)


@pytest.mark.parametrize("name", ["laplace", "stokeslet", "stokeslet_pressure"])
def test_corrected_sums_are_as_accurate_as_single_precision_between_distant_points(name):
    """Without correction the closest pairs lose all digits, and the sums with them."""
    kernel = KERNELS[name]
    x = cloud("cube", 400, 1)
    x = np.vstack((x, twins(x, np.geomspace(1e-10, 1e-3, 400))))
    columns, lists = np.ascontiguousarray(x.T), groups_of(800, 100)
    w = np.random.default_rng(2).normal(size=(2, kernel.n_in, 800))
    out, plain = np.zeros((2, kernel.n_out, 800)), np.zeros((2, kernel.n_out, 800))
    arguments = (columns, lists[0], columns)
    NearField(kernel, single=True).add(*arguments, w, *lists[1:], plain)
    out[:] = plain
    ClosePairs(kernel, *arguments, *lists[1:], distance=2.0**-5).correct(w, out)
    exact = direct_sum(kernel, x, None, w.transpose(2, 1, 0)).transpose(2, 1, 0)
    size = np.linalg.norm(exact)
    assert np.linalg.norm(plain - exact) > 0.1 * size
    # close pairs are exact, their single-precision part is taken back to its round-off, 1e-7
    assert np.linalg.norm(out - exact) < 1e-6 * size


@pytest.mark.parametrize("eps", [1e-3, 1e-5])
@pytest.mark.parametrize("near", ["recomputed", "cached"])
@pytest.mark.parametrize("name", ["laplace", "stokeslet", "laplace_gradient"])
def test_plans_in_single_precision_keep_their_error_with_twins(name, near, eps):
    """Twins at 1e-6 to 1e-9 of a leaf: a fifth of all points, and most of the sum's norm."""
    kernel, x = KERNELS[name], cloud("cube", 2500, 1)
    gaps = 0.2 * 10.0 ** np.random.default_rng(4).uniform(-9.0, -6.0, size=500)
    x = np.vstack((x, twins(x[:500], gaps)))
    w = np.random.default_rng(5).normal(size=(3000, kernel.n_in))
    options = FmmOptions(precision="single", near=near, leaf_size=60)
    plan = Fmm(kernel, x, eps=eps, options=options)
    assert plan.report.precision == "single"
    values, exact = plan.apply(w)[:1000], direct_sum(kernel, x, x[:1000], w)
    assert np.linalg.norm(values - exact) <= eps * np.linalg.norm(exact)


def test_a_lone_target_beside_a_cluster_of_sources():
    """Nodes of small boxes are close to points of a large leaf, as its extent goes."""
    kernel, rng = KERNELS["stokeslet"], np.random.default_rng(1)
    sources = np.vstack((1e-4 * rng.random((3000, 3)), rng.random((200, 3))))
    targets = np.vstack((cloud("cube", 300, 2), 1e-4 * np.array([[2.0, 2.5, 3.0]])))
    w = rng.random((3200, 3))
    options = FmmOptions(precision="single", leaf_size=400)
    plan = Fmm(kernel, sources, targets, eps=1e-5, options=options)
    values, exact = plan.apply(w), direct_sum(kernel, sources, targets, w)
    assert np.linalg.norm(values[-1] - exact[-1]) <= 1e-5 * np.linalg.norm(exact[-1])


def test_distance_follows_the_error():
    assert close_distance(1e-3) == pytest.approx(3e-5, rel=0.01)
    assert close_distance(1e-9) == close_distance(1e-12) == 2.0**-5
