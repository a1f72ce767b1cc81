"""Interaction lists: each pair of a target and a source is counted once, in integers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from stokes.fmm import lists, tree
from stokes.fmm.symmetry import VECTORS

from clouds import all_equal, clustered, collinear, cube, prolate_spheroid, sphere, two_far_clusters

UNIFORM_LEVEL_VECTORS = 316


def planar(n, rng):
    return rng.random((n, 2)) @ [[1.0, 0.0, 0.3], [0.0, 1.0, -0.2]]


def duplicated(n, rng):
    return np.repeat(rng.random((n // 10, 3)), 10, axis=0)


CLOUDS = [
    cube,
    sphere,
    prolate_spheroid,
    clustered,
    two_far_clusters,
    collinear,
    planar,
    all_equal,
    duplicated,
]
SPLITTINGS = {
    "leaf 1": tree.Splitting(leaf_size=1),
    "leaf 7": tree.Splitting(leaf_size=7),
    "leaf 1000": tree.Splitting(leaf_size=1000),
    "depth 0": tree.Splitting(depth=0),
    "depth 2": tree.Splitting(depth=2),
    "depth 4": tree.Splitting(depth=4),
}


def octree(sources, targets, rule):
    origin, edge = tree.root_cube(sources, targets)
    return tree.build(
        tree.sort(sources, origin, edge)[0], tree.sort(targets, origin, edge)[0], rule
    )


def all_pairs(found):
    return [found.near, found.far, found.multipole_to_target, found.source_to_local]


def times_counted(boxes, found):
    """How often each (target, source) pair is counted, by laying every pair of boxes down."""
    count = np.zeros((boxes.target_count[0], boxes.source_count[0]), dtype=int)
    for pairs in all_pairs(found):
        for t, s in zip(pairs.target(), pairs.source, strict=True):
            count[slice(*boxes.targets[t]), slice(*boxes.sources[s])] += 1
    return count


def sources_counted_by_expansions(boxes, found):
    """The sum over sources of the kernel 1 at each target leaf, passed through the lists."""
    total = np.zeros(len(boxes), dtype=np.int64)
    for pairs in (found.far, found.source_to_local):
        np.add.at(total, pairs.target(), boxes.source_count[pairs.source])
    for level in range(1, boxes.levels):
        own = boxes.of_level(level)
        total[own] += total[boxes.parent[own]]
    for pairs in (found.near, found.multipole_to_target):
        np.add.at(total, pairs.target(), boxes.source_count[pairs.source])
    return total[boxes.leaf & (boxes.target_count > 0)]


@pytest.mark.parametrize("direct_below", [0, 5, 40, 10**9])
@pytest.mark.parametrize("rule", SPLITTINGS.values(), ids=SPLITTINGS)
@pytest.mark.parametrize("cloud", CLOUDS)
def test_every_pair_of_points_is_counted_once(cloud, rule, direct_below):
    points = cloud(250, np.random.default_rng(1))
    boxes = octree(points, points, rule)
    found = lists.interaction_lists(boxes, direct_below=direct_below)
    assert np.all(times_counted(boxes, found) == 1)


@pytest.mark.parametrize("rule", SPLITTINGS.values(), ids=SPLITTINGS)
@pytest.mark.parametrize("cloud", CLOUDS)
def test_every_pair_of_points_is_counted_once_with_smooth_admissibility(cloud, rule):
    points = cloud(250, np.random.default_rng(2))
    boxes = octree(points, points, rule)
    found = lists.interaction_lists(boxes, admissibility="smooth")
    assert np.all(times_counted(boxes, found) == 1)
    assert [len(pairs) > 0 for pairs in all_pairs(found)] == [False, True, False, False]


OTHER_TARGETS = {
    "disjoint": lambda x, rng: x + 3.0 * np.ptp(x) + 1.0,
    "touching": lambda x, rng: x + np.ptp(x, axis=0) * [1.0, 0.0, 0.0],
    "overlapping": lambda x, rng: x[: len(x) // 2] + 0.3 * np.ptp(x, axis=0) * rng.random(3),
    "denser": lambda x, rng: x.mean(axis=0) + 0.01 * (x - x.mean(axis=0)),
    "a single one": lambda x, rng: x[:1],
    "none": lambda x, rng: x[:0],
}


@pytest.mark.parametrize("admissibility", ["standard", "smooth"])
@pytest.mark.parametrize("direct_below", [0, 12])
@pytest.mark.parametrize("others", OTHER_TARGETS.values(), ids=OTHER_TARGETS)
@pytest.mark.parametrize("cloud", CLOUDS)
def test_sources_and_targets_may_differ(cloud, others, direct_below, admissibility):
    rng = np.random.default_rng(3)
    first = cloud(300, rng)
    second = others(first, rng)
    for sources, targets in ((first, second), (second, first)):
        boxes = octree(sources, targets, tree.Splitting(leaf_size=6))
        found = lists.interaction_lists(
            boxes, admissibility=admissibility, direct_below=direct_below
        )
        assert np.all(times_counted(boxes, found) == 1)


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_few_points(n):
    points = cube(n, np.random.default_rng(4))
    for rule in SPLITTINGS.values():
        for admissibility in ("standard", "smooth"):
            boxes = octree(points, points, rule)
            found = lists.interaction_lists(boxes, admissibility=admissibility)
            assert np.all(times_counted(boxes, found) == 1)


@pytest.mark.parametrize("cloud", CLOUDS)
def test_kernel_one_counts_the_sources(cloud):
    points = cloud(20_000, np.random.default_rng(5))
    boxes = octree(points, points[::3], tree.Splitting(leaf_size=20))
    for direct_below in (0, 100):
        found = lists.interaction_lists(boxes, direct_below=direct_below)
        assert np.all(sources_counted_by_expansions(boxes, found) == len(points))


def touch_table(boxes):
    """Whether the closed cubes of each two boxes meet."""
    size = 1 << (21 - boxes.level.astype(int))
    low = boxes.cells().astype(int) * size[:, None]
    high = low + size[:, None]
    return np.all((low[:, None] <= high[None]) & (low[None] <= high[:, None]), axis=2)


@pytest.mark.parametrize("cloud", [cube, sphere, clustered, two_far_clusters])
def test_lists_are_those_of_the_textbook(cloud):
    points = cloud(150, np.random.default_rng(6))
    boxes = octree(points, points, tree.Splitting(leaf_size=2))
    found = lists.interaction_lists(boxes)
    touch, leaf, level, parent = touch_table(boxes), boxes.leaf, boxes.level, boxes.parent
    near, far, multipole, local = (
        set(zip(p.target().tolist(), p.source.tolist(), strict=True)) for p in all_pairs(found)
    )
    same = level[:, None] == level[None]
    below_root = np.ones((len(boxes), len(boxes)), dtype=bool)
    below_root[0], below_root[:, 0] = False, False
    touch_parents = touch[parent][:, parent]
    smaller_source = level[:, None] < level[None]
    # a source box under a colleague: all of its ancestors from that level on touch the target
    source_parent_touches = touch[:, parent]

    def pairs(mask):
        return set(zip(*(index.tolist() for index in np.nonzero(mask)), strict=True))

    w = leaf[:, None] & smaller_source & ~touch & source_parent_touches
    assert near == pairs(leaf[:, None] & leaf[None] & touch)
    assert far == pairs(same & below_root & ~touch & touch_parents)
    assert multipole == pairs(w)
    assert local == pairs(w.T)


@pytest.mark.parametrize("cloud", CLOUDS)
def test_far_boxes_are_well_separated_and_their_vector_tells_where_they_are(cloud):
    points = cloud(400, np.random.default_rng(7))
    boxes = octree(points, points, tree.Splitting(leaf_size=4))
    for admissibility, least in (("standard", 2), ("smooth", 0)):
        far = lists.interaction_lists(boxes, admissibility=admissibility).far
        offset = boxes.cells()[far.target()] - boxes.cells()[far.source]
        assert np.all(boxes.level[far.target()] == boxes.level[far.source])
        assert np.all(np.abs(offset).max(axis=1, initial=0) <= 3)
        assert np.all(np.abs(offset).max(axis=1, initial=3) >= least)
        assert np.array_equal(far.vector, (offset + 3) @ [49, 7, 1])


def test_full_cube_has_all_transfer_vectors():
    side = (np.arange(8) + 0.5) / 8
    points = np.array(np.meshgrid(side, side, side)).reshape(3, -1).T
    boxes = tree.build(*[tree.sort(points, np.zeros(3), 1.0)[0]] * 2, tree.Splitting(depth=3))
    standard = lists.interaction_lists(boxes)
    smooth = lists.interaction_lists(boxes, admissibility="smooth")
    assert len(np.unique(standard.far.vector)) == UNIFORM_LEVEL_VECTORS
    assert len(np.unique(smooth.far.vector)) == VECTORS
    # 22^3 ordered pairs of 8 cells a side touch: 3 each inside, 2 at both ends
    assert len(standard.near) == 22**3
    assert len(smooth.far) - len(standard.far) == 22**3
    assert len(standard.multipole_to_target) == len(standard.source_to_local) == 0


def test_pairs_of_a_level_are_those_of_its_boxes():
    points = sphere(500, np.random.default_rng(8))
    boxes = octree(points, points, tree.Splitting(leaf_size=5))
    far = lists.interaction_lists(boxes).far
    target = far.target()
    for level in range(boxes.levels):
        start, source, vector = far.of_level(boxes, level)
        own = boxes.level[target] == level
        row = np.repeat(np.arange(len(start) - 1), np.diff(start)) + boxes.level_start[level]
        assert np.array_equal(row, target[own])
        assert np.array_equal(source, far.source[own])
        assert np.array_equal(vector, far.vector[own])


@pytest.mark.parametrize("cloud", CLOUDS)
def test_direct_sums_replace_boxes_of_few_points_only(cloud):
    points = cloud(2000, np.random.default_rng(9))
    boxes = octree(points, points, tree.Splitting(leaf_size=20))
    found = lists.interaction_lists(boxes, direct_below=15)
    assert np.all(boxes.source_count[found.multipole_to_target.source] >= 15)
    assert np.all(boxes.target_count[found.source_to_local.target()] >= 15)
    all_direct = lists.interaction_lists(boxes, direct_below=2001)
    assert len(all_direct.multipole_to_target) == len(all_direct.source_to_local) == 0
    assert np.array_equal(all_direct.far.source, found.far.source)


@pytest.mark.parametrize("cloud", CLOUDS)
def test_point_ranges_hold_the_points_of_the_pairs(cloud):
    points = cloud(300, np.random.default_rng(10))
    boxes = octree(points, points, tree.Splitting(leaf_size=5))
    near = lists.interaction_lists(boxes).near
    expected = np.zeros((300, 300), dtype=int)
    for t, s in zip(near.target(), near.source, strict=True):
        expected[slice(*boxes.targets[t]), slice(*boxes.sources[s])] += 1
    targets, start, sources = lists.point_ranges(boxes, near)
    count = np.zeros((300, 300), dtype=int)
    for k, rows in enumerate(targets):
        ranges = sources[start[k] : start[k + 1]]
        assert np.all(ranges[1:, 0] > ranges[:-1, 1])
        for first, last in ranges:
            count[slice(*rows), first:last] += 1
    assert np.array_equal(count, expected)


@pytest.mark.parametrize("cloud", [sphere, prolate_spheroid, planar])
def test_surface_has_pairs_in_proportion_to_its_boxes(cloud):
    """A fourfold number of points is one level more on a surface: pairs a box stay the same."""

    def size(n):
        points = cloud(n, np.random.default_rng(11))
        boxes = octree(points, points, tree.Splitting(leaf_size=10))
        found = lists.interaction_lists(boxes)
        return len(boxes), sum(len(pairs) for pairs in all_pairs(found))

    boxes, pairs = np.array([size(n) for n in (4_000, 16_000, 64_000)]).T
    # A plane has 9 colleagues and 36 - 9 far boxes for each box, of a full cube's 27 and 189;
    # curvature, W and X make up to twice that. A tenth is for where the surface meets the lattice.
    assert np.all(pairs < 2 * 36 * boxes)
    assert np.all(pairs[1:] / boxes[1:] < 1.1 * pairs[:-1] / boxes[:-1])


def local_essential_table(boxes, first, last, direct_below):
    """The part of a tree one of several owners of key ranges would hold, and its numbers.

    Own are the leaves with keys in [first, last). Held are the boxes whose parent's surroundings
    of 27 boxes meet them, and all under a box held that has fewer sources than `direct_below`;
    with points the leaves whose own surroundings meet them, and those of so few sources.
    """
    size = np.int64(1) << (21 - boxes.level.astype(np.int64))
    low = boxes.cells().astype(np.int64) * size[:, None]
    own = boxes.leaf & (boxes.key >= first) & (boxes.key < last)

    def surroundings_meet_own(b):
        around_low, around_high = low[b] - size[b], low[b] + 2 * size[b]
        mine = low[own]
        return np.any(
            np.all((mine < around_high) & (mine + size[own][:, None] > around_low), axis=1)
        )

    meets = np.array([surroundings_meet_own(b) for b in range(len(boxes))])
    few = boxes.source_count < direct_below
    held = (boxes.level == 0) | meets[boxes.parent]
    for b in range(1, len(boxes)):
        held[b] |= held[boxes.parent[b]] and few[boxes.parent[b]]
    kept = np.flatnonzero(held)
    mine, points = own[kept], (meets | few)[kept] & boxes.leaf[kept]
    sources = np.where(points[:, None], boxes.sources[kept], 0)
    targets = np.where(mine[:, None], boxes.targets[kept], 0)
    part = tree.table(
        boxes.level[kept],
        boxes.key[kept],
        boxes.leaf[kept],
        sources,
        targets,
        boxes.source_count[kept],
        boxes.target_count[kept],
    )
    return part, kept, own


@pytest.mark.parametrize("direct_below", [0, 10])
@pytest.mark.parametrize("cloud", [cube, sphere, clustered, two_far_clusters])
def test_part_of_a_tree_gives_the_rows_of_the_whole(cloud, direct_below):
    points = cloud(400, np.random.default_rng(12))
    boxes = octree(points, points, tree.Splitting(leaf_size=3))
    whole = lists.interaction_lists(boxes, direct_below=direct_below)
    cuts = np.append(boxes.key[boxes.leaf & (boxes.target_count > 0)], 2**63 - 1)
    cuts = np.sort(cuts)[[0, len(cuts) // 3, len(cuts) // 2, -1]]
    for first, last in pairwise(cuts):
        part, kept, own = local_essential_table(boxes, first, last, direct_below)
        found = lists.interaction_lists(part, direct_below=direct_below)
        wanted = own.copy()
        for b in range(len(boxes) - 1, 0, -1):
            wanted[boxes.parent[b]] |= wanted[b]
        for in_part, in_whole in zip(all_pairs(found), all_pairs(whole), strict=True):
            rows = np.stack((kept[in_part.target()], kept[in_part.source]), axis=1)
            mine = wanted[in_whole.target()]
            expected = np.stack((in_whole.target()[mine], in_whole.source[mine]), axis=1)
            assert np.array_equal(rows, expected)


def test_part_of_a_tree_that_lacks_boxes_or_points_is_refused():
    points = cube(200, np.random.default_rng(13))
    boxes = octree(points, points, tree.Splitting(leaf_size=3))

    def table(kept, sources):
        columns = (boxes.level, boxes.key, boxes.leaf, sources, boxes.targets)
        counts = (boxes.source_count, boxes.target_count)
        return tree.table(*(c[kept] for c in columns), *(c[kept] for c in counts))

    kept = np.arange(len(boxes)) < len(boxes) - 1
    with pytest.raises(ValueError, match="lacks children"):
        lists.interaction_lists(table(kept, boxes.sources))
    sources = boxes.sources.copy()
    sources[-1] = 0
    with pytest.raises(ValueError, match="lacks sources"):
        lists.interaction_lists(table(np.ones(len(boxes), dtype=bool), sources))


def test_lists_of_wanted_boxes_leave_out_the_others():
    points = cube(300, np.random.default_rng(14))
    boxes = octree(points, points, tree.Splitting(leaf_size=5))
    one = np.flatnonzero(boxes.leaf)[7]
    wanted = np.arange(len(boxes)) == one
    found = lists.interaction_lists(boxes, wanted=wanted)
    first, last = boxes.targets[one]
    assert np.all(times_counted(boxes, found)[first:last] == 1)
    assert np.count_nonzero(wanted) == 1
    rows = np.unique(np.concatenate([pairs.target() for pairs in all_pairs(found)]))
    for b in rows:
        assert boxes.targets[b, 0] <= first and boxes.targets[b, 1] >= last


def test_unknown_admissibility_is_refused():
    boxes = octree(np.zeros((1, 3)), np.zeros((1, 3)), tree.Splitting(depth=0))
    with pytest.raises(ValueError, match="admissibility"):
        lists.interaction_lists(boxes, admissibility="strong")
