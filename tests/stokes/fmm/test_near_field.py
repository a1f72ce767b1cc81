"""Sums over near groups against the kernels' matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba.extending import register_jitable

from stokes.fmm.kernels import (
    KERNELS,
    Kernel,
    gaussian,
    inverse_distance,
    laplace,
    stokeslet,
    stresslet,
)
from stokes.fmm.near_field import NearField

ROUNDING = 1e-14
"""Of sums of some hundred terms, relative to the sum of their magnitudes."""

every_kernel = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS.keys())
LARGE = 1300  # more sources than a tile holds


class Scene:
    """Groups of points of uneven lengths (some empty) and random lists of them."""

    def __init__(self, seed: int = 0, n_sources: int = 300, n_targets: int = 120) -> None:
        rng = np.random.default_rng(seed)
        self.rng = rng
        self.x, self.y = rng.random((3, n_targets)), rng.random((3, n_sources))
        self.target_range = self._ranges(n_targets, 7)
        groups = self._ranges(n_sources, 11)
        lists = [rng.choice(len(groups), size, replace=False) for size in (3, 1, 0, 11, 5, 2, 4)]
        self.start = np.concatenate([[0], np.cumsum([len(k) for k in lists])])
        self.source_range = groups[np.concatenate(lists)]

    def _ranges(self, n: int, k: int) -> np.ndarray:
        cuts = np.sort(self.rng.integers(0, n, k - 1))
        cuts[2] = cuts[1]  # an empty group
        bounds = np.concatenate([[0], cuts, [n]])
        return np.stack([bounds[:-1], bounds[1:]], axis=1)

    def weights(self, kernel: Kernel) -> np.ndarray:
        return self.rng.standard_normal((kernel.n_in, self.y.shape[1]))

    def add(self, kernel: Kernel, w: np.ndarray, out: np.ndarray | None = None, **options):
        out = np.zeros((kernel.n_out, self.x.shape[1])) if out is None else out
        lists = (self.start, self.source_range)
        NearField(kernel, **options).add(self.x, self.target_range, self.y, w, *lists, out)
        return out

    def pairs(self) -> np.ndarray:
        """How often each pair (target, source) is counted."""
        count = np.zeros((self.x.shape[1], self.y.shape[1]), int)
        for g, (first, last) in enumerate(self.target_range):
            for begin, end in self.source_range[self.start[g] : self.start[g + 1]]:
                count[first:last, begin:end] += 1
        return count

    def reference(self, kernel: Kernel, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The sums, and the sums of the magnitudes of their terms."""
        r = self.x.T[:, None] - self.y.T[None]
        k = kernel.matrix(r.reshape(-1, 3)).reshape(*r.shape[:2], kernel.n_out, kernel.n_in)
        k = k * self.pairs()[:, :, None, None]
        return np.einsum("tsoi,is->ot", k, w), np.einsum("tsoi,is->ot", np.abs(k), np.abs(w))


@register_jitable
def _count(x, y, z, w):
    return (w[0],)


@register_jitable
def _own(x, y, z, w):
    r2 = x * x + y * y + z * z
    return (w[0] * inverse_distance(r2), w[0] * r2)


@every_kernel
def test_sums_over_lists_are_those_of_the_matrices(kernel):
    scene = Scene()
    w = scene.weights(kernel)
    exact, magnitude = scene.reference(kernel, w)
    assert np.all(np.abs(scene.add(kernel, w) - exact) <= ROUNDING * magnitude)


@pytest.mark.parametrize("n_sources", [300, LARGE, 4 * LARGE])
def test_constant_kernel_counts_the_listed_sources_exactly(n_sources):
    scene = Scene(3, n_sources)
    counted = scene.add(Kernel("count", _count, 1, 1), np.ones((1, n_sources)))
    np.testing.assert_array_equal(counted[0], scene.pairs().sum(axis=1))


def test_sums_are_added_to_what_is_there():
    scene = Scene()
    w = scene.weights(stokeslet)
    once = scene.add(stokeslet, w)
    np.testing.assert_array_equal(scene.add(stokeslet, w, out=once.copy()), 2 * once)


def test_length_and_factor_enter():
    scene, kernel = Scene(), replace(gaussian(0.3), factor=-2.0)
    w = scene.weights(kernel)
    exact, magnitude = scene.reference(kernel, w)
    assert np.all(np.abs(scene.add(kernel, w) - exact) <= ROUNDING * np.abs(magnitude))


@every_kernel
def test_source_on_the_target_adds_the_value_at_the_origin(kernel):
    """A point alone with itself: 0 for a singular kernel, no NaN."""
    point, group = np.array([[0.3], [-1.7], [0.9]]), np.array([[0, 1]])
    w = np.arange(1.0, kernel.n_in + 1)[:, None]
    out = np.zeros((kernel.n_out, 1))
    NearField(kernel).add(point, group, point, w, np.array([0, 1]), group, out)
    np.testing.assert_allclose(out, kernel.matrix(np.zeros(3))[0] @ w, rtol=1e-15, atol=0)


def test_coincident_points_do_not_feel_each_other():
    points = np.repeat(np.array([[0.1], [0.2], [0.3]]), 5, axis=1)
    points = np.ascontiguousarray(np.concatenate([points, points + 1.0], axis=1))
    group, out = np.array([[0, 10]]), np.zeros((1, 10))
    for single in (False, True):
        out[:] = 0.0
        near = NearField(laplace, single=single)
        near.add(points, group, points, np.ones((1, 10)), np.array([0, 1]), group, out)
        np.testing.assert_allclose(out, 5 / np.sqrt(3), rtol=1e-6 if single else 1e-14)


def test_weights_that_are_not_finite_are_not_swallowed():
    scene = Scene()
    w = scene.weights(stokeslet)
    w[1, 7] = np.nan
    hit = scene.pairs()[:, 7] > 0
    out = scene.add(stokeslet, w)
    np.testing.assert_array_equal(np.isnan(out).all(axis=0), hit)
    scene.y[0, 9] = np.nan
    out = scene.add(laplace, np.ones((1, scene.y.shape[1])))
    np.testing.assert_array_equal(np.isnan(out[0]), scene.pairs()[:, 9] > 0)


def _spread(scene: Scene) -> float:
    """Largest coordinate relative to the middle of a target group that single precision sees."""
    largest = 0.0
    for first, last in scene.target_range:
        if first < last:
            x = scene.x[:, first:last]
            centre = (x.min(axis=1) + x.max(axis=1)) / 2
            largest = max(largest, np.abs(scene.y.T - centre).max(), np.abs(x.T - centre).max())
    return largest


@every_kernel
def test_single_precision_errs_by_the_rounding_of_coordinates(kernel):
    """Each coordinate is rounded once to 2^-24 of its size L relative to its group's middle.

    A difference r then errs by at most 2 sqrt(3) 2^-24 L, the term k(r) by that times its
    gradient, here (|degree| + 2) |k| / |r|; the kernel's own arithmetic takes some 20 roundings.
    """
    scene = Scene(5)
    w = scene.weights(kernel)
    exact, _ = scene.reference(kernel, w)
    r = scene.x.T[:, None] - scene.y.T[None]
    distance = np.linalg.norm(r, axis=2)
    k = np.abs(kernel.matrix(r.reshape(-1, 3))).max(axis=(1, 2)).reshape(distance.shape)
    steepness = (abs(kernel.degree or 3.0) + 2.0) * 2 * np.sqrt(3) * _spread(scene) / distance
    error = scene.pairs() * 2.0**-24 * (20 + steepness) * k
    bound = error @ np.abs(w).sum(axis=0)
    single = scene.add(kernel, w, single=True)
    assert np.all(np.abs(single - exact) <= bound + 1e-300)
    assert np.abs(single - exact).max() > 1e-12 * np.abs(exact).max()  # it is single indeed


def test_single_precision_does_not_depend_on_where_the_points_are():
    scene = Scene(6)
    w = scene.weights(stokeslet)
    before = scene.add(stokeslet, w, single=True)
    shift = np.array([[1024.0], [-512.0], [2048.0]])
    # what is left after the shift are the same numbers: multiples of 2^-30
    scene.x, scene.y = np.round(scene.x * 2**30) / 2**30, np.round(scene.y * 2**30) / 2**30
    before = scene.add(stokeslet, w, single=True)
    scene.x, scene.y = scene.x + shift, scene.y + shift
    np.testing.assert_array_equal(scene.add(stokeslet, w, single=True), before)


def test_kernel_without_single_precision_stays_in_double():
    kernel = replace(laplace, single=False)
    near = NearField(kernel, single=True)
    assert not near.single
    scene = Scene()
    w = scene.weights(kernel)
    np.testing.assert_array_equal(scene.add(kernel, w, single=True), scene.add(laplace, w))


@pytest.mark.parametrize("single", [False, True])
def test_threads_do_not_change_a_bit(single):
    scene = Scene(8, LARGE)
    w = scene.weights(stokeslet)
    one = scene.add(stokeslet, w, single=single)
    np.testing.assert_array_equal(scene.add(stokeslet, w, single=single, threads=2), one)


def test_transposed_sums():
    """<u, K v> = <K^T u, v> over one pair of groups."""
    rng = np.random.default_rng(9)
    x, y = rng.random((3, 40)), rng.random((3, 70))
    start = np.array([0, 1])
    for kernel in KERNELS.values():
        if kernel.transpose is None:
            continue
        u, v = rng.standard_normal((kernel.n_out, 40)), rng.standard_normal((kernel.n_in, 70))
        forward, backward = np.zeros_like(u), np.zeros_like(v)
        xs, ys = np.array([[0, 40]]), np.array([[0, 70]])
        NearField(kernel).add(x, xs, y, v, start, ys, forward)
        NearField(kernel.transposed()).add(y, ys, x, u, start, xs, backward)
        scale = np.linalg.norm(u) * np.linalg.norm(forward)
        assert abs(np.sum(u * forward) - np.sum(backward * v)) < ROUNDING * scale, kernel.name


@pytest.mark.parametrize("count", [1, 2, 4, 6, 9])
@pytest.mark.parametrize("single", [False, True])
def test_several_right_hand_sides_are_sums_of_each(count, single):
    scene = Scene(11, LARGE)
    w = scene.rng.standard_normal((count, 3, LARGE))
    out = np.ones((count, 3, scene.x.shape[1]))
    scene.add(stokeslet, w, out=out, single=single)
    _, magnitude = scene.reference(stokeslet, np.abs(w).max(axis=0))
    tolerance = 4 * np.finfo(np.float32).eps if single else ROUNDING
    for k in range(count):
        alone = 1 + scene.add(stokeslet, w[k], single=single)
        assert np.all(np.abs(out[k] - alone) <= tolerance * (1 + magnitude))


def test_kernel_of_ones_own_with_two_outputs():
    kernel = Kernel("own", _own, 1, 2, outputs=((), ()))
    scene = Scene(10)
    w = scene.weights(kernel)
    exact, magnitude = scene.reference(kernel, w)
    assert np.all(np.abs(scene.add(kernel, w) - exact) <= ROUNDING * magnitude)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"w": np.zeros((3, 300))}, r"weights has the shape \(3, 300\), not \(6, 300\)"),
        ({"w": np.zeros((6, 300), np.float32)}, "weights must be float64"),
        ({"out": np.zeros((120, 3)).T}, "out must be float64 and C-contiguous"),
    ],
)
def test_arrays_of_the_wrong_form_are_refused(changes, message):
    scene = Scene()
    with pytest.raises(ValueError, match=message):
        scene.add(stresslet, **{"w": np.zeros((6, 300)), **changes})
