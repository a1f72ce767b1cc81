"""A tree spread over ranks: its boxes, lists and sums are those of one rank, in integers."""

from __future__ import annotations

import numpy as np
import pytest

from stokes.fmm import lists, tree
from stokes.fmm.distribution import Distribution

from clouds import all_equal, clustered, collinear, cube, prolate_spheroid, sphere, two_far_clusters

RANKS = [1, 2, 3, 8]


def duplicated(n, rng):
    return np.repeat(rng.random((-(-n // 10), 3)), 10, axis=0)[:n]


CLOUDS = [
    cube,
    sphere,
    prolate_spheroid,
    clustered,
    two_far_clusters,
    collinear,
    all_equal,
    duplicated,
]


def evenly(n, parallel):
    """First and last of n points that a rank brings, neighbours on the curve being far apart."""
    return n * parallel.rank // parallel.size, n * (parallel.rank + 1) // parallel.size


def all_on_first(n, parallel):
    return (0, n) if parallel.rank == 0 else (n, n)


def all_on_last(n, parallel):
    return (0, n) if parallel.rank == parallel.size - 1 else (0, 0)


def codes(boxes):
    """Names of boxes that rise with the table, equal for equal boxes of two tables."""
    level = boxes.level.astype(np.int64)
    return (np.int64(1) << 3 * level) | (boxes.key >> 3 * (21 - level))


def whole_tree(sources, targets, rule):
    origin, edge = tree.root_cube(sources, targets)
    keys = [tree.sort(points, origin, edge)[0] for points in (sources, targets)]
    return tree.build(*keys, rule)


def distributed(parallel, sources, targets, rule, spread=(evenly, evenly), **options):
    own = [
        points[slice(*take(len(points), parallel))]
        for points, take in zip((sources, targets), spread, strict=True)
    ]
    return Distribution(parallel, *own, rule, **options), *own


def assert_part_of(part, whole):
    """The boxes of a rank are boxes of the whole tree, with its leaves and counts."""
    row = np.searchsorted(codes(whole), codes(part))
    assert np.array_equal(codes(whole)[row], codes(part))
    assert np.array_equal(whole.leaf[row], part.leaf)
    assert np.array_equal(whole.source_count[row], part.source_count)
    assert np.array_equal(whole.target_count[row], part.target_count)
    return row


def named(boxes, pairs, targets):
    """The pairs of `targets` (nb,) as (code of target, code of source), sorted."""
    code, target = codes(boxes), pairs.target()
    held = targets[target]
    return np.unique(np.stack((code[target], code[pairs.source]), axis=1)[held], axis=0)


def assert_same_lists(distribution, whole, row, **options):
    """A rank's targets hear of the same boxes, by the same way, as in the whole tree."""
    expected = lists.interaction_lists(whole, **options)
    mine = np.zeros(len(whole), dtype=bool)
    mine[row] = distribution.has_targets
    for name in vars(expected):
        found = named(
            distribution.boxes, getattr(distribution.lists, name), distribution.has_targets
        )
        assert np.array_equal(found, named(whole, getattr(expected, name), mine)), name


def sums_of_kernel_one(distribution, weights):
    """phi_i = sum_j w_j of integers (n,), modulo 2^64, through lists, ghosts and messages."""
    boxes, upward = distribution.boxes, distribution.upward
    weight = distribution.scatter_weights(weights)
    before = np.concatenate(([0], np.cumsum(weight)))
    multipole = np.where(
        upward.leaf, before[upward.sources[:, 1]] - before[upward.sources[:, 0]], 0
    )
    for b in range(len(boxes) - 1, 0, -1):
        multipole[boxes.parent[b]] += multipole[b]
    distribution.complete_multipoles(multipole)
    local = np.zeros(len(boxes), dtype=np.int64)
    found = distribution.lists
    in_box = before[boxes.sources[:, 1]] - before[boxes.sources[:, 0]]
    np.add.at(local, found.far.target(), multipole[found.far.source])
    np.add.at(local, found.source_to_local.target(), in_box[found.source_to_local.source])
    for b in range(1, len(boxes)):
        local[b] += local[boxes.parent[b]]
    np.add.at(
        local, found.multipole_to_target.target(), multipole[found.multipole_to_target.source]
    )
    np.add.at(local, found.near.target(), in_box[found.near.source])
    value = np.zeros(distribution.x_targets.shape[1], dtype=np.int64)
    for b in np.flatnonzero(boxes.leaf):
        value[slice(*boxes.targets[b])] = local[b]
    return distribution.gather(value)


def assert_counts_once(parallel, distribution, sources, seed):
    """Every target hears of every source once: random weights of 62 bits would tell otherwise."""
    rng = np.random.default_rng([seed, parallel.rank])
    weights = rng.integers(-(2**62), 2**62, len(sources))
    total = parallel.sum(int(weights.sum()) % 2**32) % 2**32
    ones = sums_of_kernel_one(distribution, np.ones(len(sources), dtype=np.int64))
    assert np.all(ones == parallel.sum(len(sources)))
    assert np.all(sums_of_kernel_one(distribution, weights) % 2**32 == total)


def assert_no_idle_ghosts(distribution):
    """What is not of this rank is named by a list, or above a box that is."""
    boxes, found = distribution.boxes, distribution.lists
    used = distribution.has_sources | distribution.has_targets
    used[0] = True
    named_leaf = np.zeros(len(boxes), dtype=bool)
    for name, pairs in vars(found).items():
        used[pairs.source] = True
        if name in ("near", "source_to_local"):
            named_leaf[pairs.source] = True
    for b in range(len(boxes) - 1, 0, -1):
        used[boxes.parent[b]] |= used[b]
    assert np.all(used)
    held = np.zeros(distribution.x_sources.shape[1], dtype=bool)
    held[distribution.own_sources] = True
    for b in np.flatnonzero(named_leaf):
        held[slice(*boxes.sources[b])] = True
    assert np.all(held)


def assert_tree_of_one_rank(parallel, sources, targets, rule, spread=(evenly, evenly), **options):
    distribution, own_sources, own_targets = distributed(
        parallel, sources, targets, rule, spread, **options
    )
    whole = whole_tree(sources, targets, rule)
    row = assert_part_of(distribution.boxes, whole)
    held = np.zeros(len(whole), dtype=np.int64)
    held[row[distribution.has_sources | distribution.has_targets]] = 1
    if len(sources) or len(targets):
        assert np.all(parallel.max(held) == 1)
    assert_same_lists(distribution, whole, row, **options)
    assert_no_idle_ghosts(distribution)
    assert distribution.x_sources.flags.c_contiguous and distribution.x_targets.flags.c_contiguous
    assert_counts_once(parallel, distribution, own_sources, 11)
    assert np.array_equal(distribution.gather(distribution.x_targets), own_targets)
    return distribution


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("direct_below", [0, 30])
@pytest.mark.parametrize("cloud", CLOUDS)
def test_tree_lists_and_counts_are_those_of_one_rank(parallel, cloud, direct_below):
    points = cloud(600, np.random.default_rng(1))
    rule = tree.Splitting(leaf_size=8)
    assert_tree_of_one_rank(parallel, points, points, rule, direct_below=direct_below)


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("admissibility", ["standard", "smooth"])
@pytest.mark.parametrize("depth", [0, 1, 3])
@pytest.mark.parametrize("cloud", [cube, sphere])
def test_uniform_tree_is_that_of_one_rank(parallel, cloud, depth, admissibility):
    rng = np.random.default_rng(2)
    rule = tree.Splitting(depth=depth)
    assert_tree_of_one_rank(
        parallel, cloud(400, rng), cloud(300, rng), rule, admissibility=admissibility
    )


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("direct_below", [0, 12, 10**9])
@pytest.mark.parametrize("spread", [(all_on_first, all_on_first), (all_on_first, all_on_last)])
def test_points_may_all_come_from_one_rank(parallel, spread, direct_below):
    rng = np.random.default_rng(3)
    assert_tree_of_one_rank(
        parallel,
        clustered(500, rng),
        sphere(300, rng),
        tree.Splitting(leaf_size=5),
        spread,
        direct_below=direct_below,
    )


OTHER_TARGETS = {
    "disjoint": lambda x, rng: x + 3.0,
    "overlapping": lambda x, rng: x[: len(x) // 2] + 0.3 * rng.random(3),
    "denser": lambda x, rng: x.mean(axis=0) + 0.01 * (x - x.mean(axis=0)),
    "a single one": lambda x, rng: x[:1],
    "none": lambda x, rng: x[:0],
}


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("others", OTHER_TARGETS.values(), ids=OTHER_TARGETS)
@pytest.mark.parametrize("cloud", [cube, clustered])
def test_sources_and_targets_may_be_on_different_ranks(parallel, cloud, others):
    rng = np.random.default_rng(4)
    first = cloud(300, rng)
    second = others(first, rng)
    for sources, targets in ((first, second), (second, first)):
        assert_tree_of_one_rank(
            parallel, sources, targets, tree.Splitting(leaf_size=6), direct_below=10
        )


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("n", [0, 1, 2, 5])
@pytest.mark.parametrize("cloud", [cube, all_equal])
def test_more_ranks_than_points(parallel, cloud, n):
    points = cloud(n, np.random.default_rng(5))
    for rule in (tree.Splitting(leaf_size=1), tree.Splitting(depth=2)):
        assert_tree_of_one_rank(parallel, points, points, rule)


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("cloud", [cube, clustered, all_equal])
def test_ranks_get_equally_many_points(parallel, cloud):
    rng = np.random.default_rng(6)
    sources, targets = cloud(501, rng), cloud(302, rng)
    distribution, *_ = distributed(parallel, sources, targets, tree.Splitting(leaf_size=7))
    report = distribution.report
    points = parallel.allgather(np.array(report.sources + report.targets))
    assert points.sum() == 803
    # A source and a target of one key and one index are not divided.
    assert np.all(np.abs(points - 803 / parallel.size) <= 2)


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("shape", [(), (3,), (3, 2)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_weights_arrive_with_their_sources(parallel, shape, dtype):
    rng = np.random.default_rng(7)
    sources, targets = cube(700, rng), sphere(200, rng)
    weights = rng.random((700, *shape)).astype(dtype)
    distribution, *_ = distributed(parallel, sources, targets, tree.Splitting(leaf_size=9))
    for factor in (1, 2):  # plans are used again
        held = distribution.scatter_weights(factor * weights[slice(*evenly(700, parallel))])
        assert held.dtype == dtype and held.shape == (*shape, distribution.x_sources.shape[1])
        place = {tuple(x): j for j, x in enumerate(sources)}
        index = [place[tuple(x)] for x in distribution.x_sources.T]
        assert np.array_equal(held, factor * np.moveaxis(weights, 0, -1)[..., index])


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_results_return_in_the_order_of_the_caller(parallel, shape):
    rng = np.random.default_rng(8)
    sources, targets = cube(100, rng), clustered(650, rng)
    distribution, _, own = distributed(
        parallel, sources, targets, tree.Splitting(leaf_size=9), (evenly, all_on_last)
    )
    factor = rng.random(shape)
    for axis in (0, 2):
        values = factor[..., None] * distribution.x_targets[axis]
        returned = distribution.gather(values)
        assert np.array_equal(returned, np.multiply.outer(own[:, axis], factor))


@pytest.mark.mpi(ranks=RANKS)
def test_multipoles_of_shared_boxes_are_sums_over_ranks(parallel):
    points = clustered(800, np.random.default_rng(9))
    distribution, *_ = distributed(parallel, points, points, tree.Splitting(leaf_size=10))
    whole = whole_tree(points, points, tree.Splitting(leaf_size=10))
    row = assert_part_of(distribution.boxes, whole)
    part = distribution.upward.source_count
    for trailing in ((), (3, 8), (1, 2, 2, 2)):
        scale = np.arange(1.0, 1.0 + np.prod(trailing, dtype=int)).reshape(trailing)
        multipoles = np.multiply.outer(part.astype(float), scale)
        distribution.complete_multipoles(multipoles)
        wanted = np.multiply.outer(whole.source_count[row].astype(float), scale)
        for pairs in (distribution.lists.far, distribution.lists.multipole_to_target):
            assert np.array_equal(multipoles[pairs.source], wanted[pairs.source])


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_targets_are_the_sources_unless_given(parallel):
    points = sphere(300, np.random.default_rng(10))
    own = points[slice(*evenly(300, parallel))]
    rule = tree.Splitting(leaf_size=10)
    once, twice = (
        Distribution(parallel, own, None, rule),
        Distribution(parallel, own, own + 0, rule),
    )
    assert np.array_equal(once.x_targets, twice.x_targets)
    assert np.array_equal(once.x_sources, twice.x_sources)
    assert np.array_equal(codes(once.boxes), codes(twice.boxes))


@pytest.mark.mpi(ranks=[1, 2])
def test_one_rank_sends_nothing(parallel):
    points = cube(200, np.random.default_rng(11))
    before = parallel.messages_sent
    distribution, own, _ = distributed(parallel, points, points, tree.Splitting(leaf_size=10))
    assert_counts_once(parallel, distribution, own, 12)
    assert (parallel.messages_sent > before) == (parallel.size > 1)


@pytest.mark.mpi(ranks=[1, 8])
def test_ghosts_are_a_layer_about_the_points_of_a_rank(parallel):
    """Each of 8 ranks has an octant, 8³ of 16³ leaves of 8 points, that touches others' on 3 sides.

    Ghost points are those of the 9³ - 8³ leaves that touch it. Ghost boxes are the children of
    the parents that touch one of its boxes: 10³ - 8³ of the finest, 6³ - 4³, 4³ - 2³ and 2³ - 1
    of the coarser levels; those of level 1 touch each other and are not far. All share the root.
    """
    axis = np.arange(32.0)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    distribution, *_ = distributed(parallel, points, points, tree.Splitting(depth=4))
    report = distribution.report
    if parallel.size == 1:
        assert report.sources == report.targets == 32**3
        assert report.ghost_sources == report.ghost_boxes == report.ghost_multipoles == 0
        assert report.shared_boxes == report.ghost_bytes == 0
    else:
        assert report.sources == report.targets == 16**3
        assert report.ghost_sources == 8 * (9**3 - 8**3)
        assert report.ghost_multipoles == 488 + 152 + 56
        assert report.ghost_boxes == 488 + 152 + 56 + 7
        assert report.boxes == 1 + 8 + 4**3 + 6**3 + 10**3
        assert report.shared_boxes == 1
        assert report.ghost_bytes > 24 * report.ghost_sources


@pytest.mark.mpi(ranks=[1, 3])
@pytest.mark.parametrize(
    "bad", [np.zeros((4, 2)), np.full((2, 3), np.nan), np.full((2, 3), np.inf)]
)
def test_bad_points_of_one_rank_are_refused_on_all(parallel, bad):
    points = bad if parallel.rank == parallel.size - 1 else np.zeros((3, 3))
    with pytest.raises(ValueError):
        Distribution(parallel, points, np.zeros((1, 3)), tree.Splitting(leaf_size=3))
