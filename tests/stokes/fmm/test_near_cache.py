"""Stored near matrices against pairs computed anew; right-hand sides together and alone."""

from __future__ import annotations

import numpy as np
import pytest
from numba.extending import register_jitable

from dem_mpi.parallel import Parallel
from stokes.fmm import KERNELS, Fmm, FmmOptions, Kernel, direct_sum
from stokes.fmm.accuracy import cloud
from stokes.fmm.kernels import gaussian, laplace, matern52, stokeslet
from stokes.fmm.near_field import NearField
from stokes.fmm.near_matrices import NearMatrices, stored_bytes

ROUNDING = 1e-14
"""Of sums of some hundred terms in double, relative to the sum of their magnitudes."""
SINGLE = 100 * 2.0**-24
"""In single: at most 64 + 16 terms a lane of a tile one after the other, 20 roundings a term."""
POINTS = 3000

every_kernel = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS.keys())


class Scene:
    """Groups of points of uneven lengths, some empty, and lists of them, one longer than tiles."""

    def __init__(self, seed: int = 0, n_sources: int = 900, n_targets: int = 60) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.x, self.y = rng.random((3, n_targets)), rng.random((3, n_sources))
        self.y[:, :3] = self.x[:, :3]  # coincident points
        self.target_range = self._ranges(n_targets, 6)
        groups = self._ranges(n_sources, 12)
        lists = [rng.choice(len(groups), size, replace=False) for size in (3, 0, 12, 1, 5, 2)]
        self.start = np.concatenate([[0], np.cumsum([len(k) for k in lists])])
        self.source_range = groups[np.concatenate(lists)]

    def _ranges(self, n: int, k: int) -> np.ndarray:
        cuts = np.sort(self.rng.integers(0, n, k - 1))
        cuts[2] = cuts[1]
        bounds = np.concatenate([[0], cuts, [n]])
        return np.stack([bounds[:-1], bounds[1:]], axis=1)

    def weights(self, kernel: Kernel, columns: int) -> np.ndarray:
        return self.rng.standard_normal((columns, kernel.n_in, self.y.shape[1]))

    def out(self, kernel: Kernel, columns: int) -> np.ndarray:
        return np.zeros((columns, kernel.n_out, self.x.shape[1]))

    def recomputed(self, kernel: Kernel, w: np.ndarray, **options) -> np.ndarray:
        out, lists = self.out(kernel, len(w)), (self.start, self.source_range)
        NearField(kernel, **options).add(self.x, self.target_range, self.y, w, *lists, out)
        return out

    def matrices(self, kernel: Kernel, **options) -> NearMatrices:
        lists = (self.start, self.source_range)
        return NearMatrices(kernel, self.x, self.target_range, self.y, *lists, **options)

    def stored(self, kernel: Kernel, w: np.ndarray, **options) -> np.ndarray:
        out = self.out(kernel, len(w))
        self.matrices(kernel, **options).add(w, out)
        return out

    def magnitude(self, kernel: Kernel, w: np.ndarray) -> np.ndarray:
        """Sums of the magnitudes of the terms."""
        total = self.out(kernel, len(w))
        for g, (first, last) in enumerate(self.target_range):
            for begin, end in self.source_range[self.start[g] : self.start[g + 1]]:
                r = self.x.T[first:last, None] - self.y.T[None, begin:end]
                k = kernel.matrix(r.reshape(-1, 3)).reshape(*r.shape[:2], *np.shape(kernel.entry))
                total[:, :, first:last] += np.einsum(
                    "tsoi,cis->cot", np.abs(k), np.abs(w[:, :, begin:end])
                )
        return total


@every_kernel
def test_stored_matrices_give_the_sums_of_pairs(kernel):
    scene = Scene()
    w = scene.weights(kernel, 1)
    difference = np.abs(scene.stored(kernel, w) - scene.recomputed(kernel, w))
    assert np.all(difference <= ROUNDING * scene.magnitude(kernel, w))


@pytest.mark.parametrize("kernel", [laplace, matern52(0.3), stokeslet], ids=lambda k: k.name)
def test_stored_in_single_precision_within_its_rounding(kernel):
    """Of pairs whose coordinates are equal in single precision, too."""
    scene = Scene(1)
    scene.y[:, 3:6] = scene.x[:, 3:6] + 1e-9
    w = scene.weights(kernel, 1)
    stored = scene.stored(kernel, w, single=True)
    assert not np.array_equal(stored, scene.stored(kernel, w))
    difference = np.abs(stored - scene.recomputed(kernel, w))
    assert np.all(difference <= SINGLE * scene.magnitude(kernel, w))


@pytest.mark.parametrize("kernel", [gaussian(0.3), stokeslet], ids=lambda k: k.name)
def test_several_right_hand_sides_are_each_one_alone(kernel):
    scene = Scene(2)
    w = scene.weights(kernel, 9)
    matrices = scene.matrices(kernel)
    each = scene.out(kernel, 9)
    for c in range(9):
        matrices.add(w[c : c + 1], each[c : c + 1])
    bound = ROUNDING * scene.magnitude(kernel, w)
    for columns in (2, 4, 5, 8, 9):
        together = scene.out(kernel, columns)
        matrices.add(w[:columns], together)
        assert np.all(np.abs(together - each[:columns]) <= bound[:columns])


def test_sums_are_added_to_what_is_there():
    scene = Scene()
    matrices, w = scene.matrices(stokeslet), scene.weights(stokeslet, 2)
    once = scene.out(stokeslet, 2)
    matrices.add(w, once)
    twice = once.copy()
    matrices.add(w, twice)
    assert np.all(np.abs(twice - 2 * once) <= ROUNDING * scene.magnitude(stokeslet, w))


def test_infinite_weights_stay_infinite():
    """Entries that fill a tile up multiply nothing: no 0 times infinity."""
    scene = Scene(3)
    w = np.ones((2, 1, scene.y.shape[1]))
    w[:, 0, scene.source_range[0, 1] - 1] = np.inf
    stored, recomputed = (f(gaussian(), w) for f in (scene.stored, scene.recomputed))
    assert np.isinf(stored).any()
    np.testing.assert_array_equal(np.isinf(stored), np.isinf(recomputed))
    assert not np.isnan(stored).any()


def test_threads_do_not_change_bits():
    scene = Scene(4)
    w = scene.weights(stokeslet, 3)
    one, two = (scene.stored(stokeslet, w, threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("kernel", [laplace, stokeslet], ids=lambda k: k.name)
def test_memory_is_one_number_an_entry(kernel, single):
    """But for rows filled up to whole vectors of 64 bytes."""
    scene = Scene()
    lists = (scene.target_range, scene.start, scene.source_range)
    needed = stored_bytes(kernel, single, *lists)
    assert scene.matrices(kernel, single=single).nbytes == needed
    sources = np.add.reduceat(np.append(np.diff(scene.source_range, axis=1), 0), scene.start[:-1])
    sources[np.diff(scene.start) == 0] = 0
    targets = np.diff(scene.target_range, axis=1)[:, 0]
    entries = kernel.n_in * kernel.n_out
    least = np.dot(targets, sources) * entries * (4 if single else 8)
    assert least <= needed <= least + targets.sum() * entries * 64


# ---- in the whole sum -------------------------------------------------------------------------


def clustered_plan(kernel: Kernel, **options) -> Fmm:
    given = {"leaf_size": 40, "order": 5, "precision": "double"} | options
    return Fmm(kernel, cloud("clustered", POINTS, 5), eps=1e-4, options=FmmOptions(**given))


def weights(kernel: Kernel, columns: int, count: int = POINTS) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(count, kernel.n_in, columns))


def distance(values: np.ndarray, others: np.ndarray) -> float:
    return float(np.linalg.norm(values - others) / np.linalg.norm(others))


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("kernel", [matern52(0.2), stokeslet], ids=lambda k: k.name)
def test_sum_with_stored_matrices_is_the_same_but_for_rounding(kernel, precision):
    stored, recomputed = (
        clustered_plan(kernel, near=near, precision=precision) for near in ("cached", "recomputed")
    )
    assert (stored.report.near, recomputed.report.near) == ("cached", "recomputed")
    w = weights(kernel, 3)
    bound = ROUNDING if precision == "double" else SINGLE
    assert distance(stored.apply(w), recomputed.apply(w)) <= bound
    assert stored.report.memory["near"] >= 4 * stored.report.pairs["near"]
    assert recomputed.report.memory["near"] == 0


@pytest.mark.parametrize("method", ["ufmm", "symmetric"])
@pytest.mark.parametrize(
    ("name", "derivative"),
    [
        ("laplace", "exact"),
        ("stokeslet", "exact"),
        ("laplace_dipole", "interpolated"),
        ("stokeslet_gradient", "interpolated"),
    ],
)
def test_right_hand_sides_together_give_those_alone(name, derivative, method):
    """Of all lists: nine pass as eight and one."""
    plan = clustered_plan(KERNELS[name], derivative=derivative, method=method, order=2)
    assert min(plan.report.pairs.values()) > 0
    w = weights(plan.kernel, 9)
    together = plan.apply(w)
    for c in range(9):
        assert distance(together[:, :, c], plan.apply(w[:, :, c])) <= ROUNDING


def test_no_right_hand_side_gives_none():
    assert clustered_plan(stokeslet).apply(weights(stokeslet, 0)).shape == (POINTS, 3, 0)


@register_jitable
def _own(x, y, z, w):
    return (w[0] * np.exp(-x * x - y * y - z * z),)


@pytest.mark.parametrize(
    ("kernel", "near"),
    [
        (matern52(0.2), "cached"),
        (laplace, "recomputed"),
        (stokeslet, "recomputed"),
        (Kernel("matern52", _own, 1, 1), "recomputed"),  # not the package's, whatever its name
    ],
)
def test_auto_stores_what_is_read_faster_than_computed(kernel, near):
    assert clustered_plan(kernel, order=3).report.near == near


def test_limit_of_memory():
    """Of as many bytes as the matrices have, less one: none for "auto", an error for "cached"."""
    kernel = matern52(0.2)
    needed = clustered_plan(kernel).report.memory["near"]
    assert clustered_plan(kernel, near="cached", near_memory=needed).report.near == "cached"
    assert clustered_plan(kernel, near_memory=needed - 1).report.near == "recomputed"
    with pytest.raises(ValueError, match=r"near_memory.*'recomputed'.*leaf_size"):
        clustered_plan(kernel, near="cached", near_memory=needed - 1)
    with pytest.raises(ValueError, match="near_memory = -1"):
        FmmOptions(near_memory=-1)


def part_of(parallel: Parallel, points: np.ndarray) -> slice:
    """An uneven part of the points for each rank."""
    bounds = (np.linspace(0.0, 1.0, parallel.size + 1) ** 2 * len(points)).astype(int)
    return slice(bounds[parallel.rank], bounds[parallel.rank + 1])


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_ranks_with_stored_matrices_agree_with_direct_sums(parallel):
    kernel, x = matern52(0.2), cloud("clustered", 1500, 5)
    mine = part_of(parallel, x)
    w = weights(kernel, 3, len(x))
    options = {"leaf_size": 40, "precision": "double"}
    plans = [
        Fmm(kernel, x[mine], eps=1e-6, options=FmmOptions(near=near, **options), parallel=parallel)
        for near in ("cached", "recomputed")
    ]
    stored, recomputed = (plan.apply(w[mine]) for plan in plans)
    exact = direct_sum(kernel, x, x[mine], w)
    scale = np.abs(exact).max()
    assert np.abs(stored - recomputed).max() <= ROUNDING * scale * np.sqrt(len(x))
    assert distance(stored, exact) <= 1e-5


@pytest.mark.mpi(ranks=[2, 3])
def test_limit_of_one_rank_is_that_of_all(parallel):
    """A limit that only some ranks exceed: an error on all, or no matrices on any."""
    kernel, x = matern52(0.2), cloud("clustered", 1500, 5)

    def plan(**options):
        given = FmmOptions(leaf_size=40, order=4, precision="double", **options)
        return Fmm(kernel, x[part_of(parallel, x)], options=given, parallel=parallel)

    needed = plan(near="cached").report.memory["near"]
    least, most = parallel.min(needed), parallel.max(needed)
    assert least < most
    with pytest.raises(ValueError, match="near_memory"):
        plan(near="cached", near_memory=least)
    assert plan(near_memory=least).report.near == "recomputed"
    assert plan(near_memory=most).report.near == "cached"
