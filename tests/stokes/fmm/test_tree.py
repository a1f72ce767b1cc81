"""The octree against a recursive twin; its table, its degenerate cases and its size on surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from dem_mpi import morton
from stokes.fmm import tree


def sphere(n, rng):
    x = rng.standard_normal((n, 3))
    return x / np.linalg.norm(x, axis=1)[:, None]


CLOUDS = {
    "cube": lambda n, rng: rng.random((n, 3)),
    "sphere": sphere,
    "prolate spheroid": lambda n, rng: sphere(n, rng) * [0.1, 0.1, 1.0],
    "clustered": lambda n, rng: rng.random((n, 3)) ** 8,
    "two far clusters": lambda n, rng: 1e-4 * rng.random((n, 3)) + (np.arange(n) % 2)[:, None],
    "collinear": lambda n, rng: rng.random((n, 1)) * [1.0, 2.0, -0.5],
    "planar": lambda n, rng: rng.random((n, 2)) @ [[1.0, 0.0, 0.3], [0.0, 1.0, -0.2]],
    "all equal": lambda n, rng: np.tile(rng.random(3), (n, 1)),
    "pairs closer than the lattice": lambda n, rng: (
        np.repeat(rng.random((n // 2, 3)), 2, axis=0) + 1e-12 * rng.random((n, 3))
    ),
}
any_cloud = pytest.mark.parametrize("cloud", CLOUDS.values(), ids=CLOUDS)


def sorted_keys(*point_sets):
    origin, edge = tree.root_cube(*point_sets)
    return [tree.sort(points, origin, edge)[0] for points in point_sets]


def twin_boxes(source_keys, target_keys, rule):
    """Boxes by recursion: (level, key) to (leaf, sources, targets)."""
    found = {}

    def visit(level, key, sources, targets):
        both = np.concatenate((source_keys[sources], target_keys[targets]))
        if rule.depth is not None:
            leaf = level == rule.depth or len(both) == 0
        else:
            fits = max(len(sources), len(targets)) <= rule.leaf_size
            leaf = fits or np.ptp(both) == 0 or level == rule.max_level
        found[level, key] = (leaf, sources.tolist(), targets.tolist())
        if leaf:
            return
        shift = 3 * (morton.LEVELS - 1 - level)
        for octant in range(8):
            inner = [
                points[keys[points] >> shift == (key >> shift) + octant]
                for keys, points in ((source_keys, sources), (target_keys, targets))
            ]
            if len(inner[0]) or len(inner[1]):
                visit(level + 1, key + (octant << shift), *inner)

    visit(0, 0, np.arange(len(source_keys)), np.arange(len(target_keys)))
    return found


@pytest.mark.parametrize(
    "rule",
    [
        tree.Splitting(leaf_size=1),
        tree.Splitting(leaf_size=6),
        tree.Splitting(leaf_size=1000),
        tree.Splitting(leaf_size=2, max_level=3),
        tree.Splitting(depth=0),
        tree.Splitting(depth=3),
    ],
    ids=str,
)
@any_cloud
def test_boxes_equal_those_of_the_recursive_twin(cloud, rule):
    rng = np.random.default_rng(1)
    sources, targets = sorted_keys(cloud(200, rng), cloud(90, rng))
    boxes = tree.build(sources, targets, rule)
    expected = twin_boxes(sources, targets, rule)
    assert list(zip(boxes.level, boxes.key, strict=True)) == sorted(expected)
    for b, (leaf, own_sources, own_targets) in enumerate(expected[k] for k in sorted(expected)):
        assert boxes.leaf[b] == leaf
        assert list(range(*boxes.sources[b])) == own_sources
        assert list(range(*boxes.targets[b])) == own_targets


@any_cloud
def test_parents_children_and_levels_fit_together(cloud):
    keys = sorted_keys(cloud(500, np.random.default_rng(2)))[0]
    boxes = tree.build(keys, keys[:0], tree.Splitting(leaf_size=3))
    cells = boxes.cells()
    assert boxes.parent[0] == -1 and boxes.level[0] == 0
    for level in range(boxes.levels):
        assert np.all(boxes.level[boxes.of_level(level)] == level)
    below = np.arange(1, len(boxes))
    parent = boxes.parent[below]
    assert np.array_equal(boxes.level[parent], boxes.level[below] - 1)
    assert np.array_equal(cells[parent], cells[below] >> 1)
    octant = (cells[below] & 1) @ [1, 2, 4]
    assert np.array_equal(boxes.children[parent, octant], below)
    assert np.count_nonzero(boxes.children >= 0) == len(below)
    assert np.array_equal(boxes.leaf, np.all(boxes.children < 0, axis=1))
    assert np.array_equal(boxes.source_count, np.diff(boxes.sources)[:, 0])
    assert np.all(boxes.source_count > 0) and np.all(boxes.target_count == 0)


@any_cloud
@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_points_lie_in_their_leaves(cloud, scale, shift):
    points = scale * (cloud(300, np.random.default_rng(3)) + shift)
    origin, edge = tree.root_cube(points)
    keys, order = tree.sort(points, origin, edge)
    boxes = tree.build(keys, keys, tree.Splitting(leaf_size=5))
    centres, edges = boxes.centres(origin, edge), boxes.edges(edge)[boxes.level]
    # Rounding of the coordinates: their size times 2^-52, a few times over.
    slack = 8 * np.finfo(float).eps * (np.abs(points).max() + edge)
    for b in np.flatnonzero(boxes.leaf):
        inside = points[order[slice(*boxes.sources[b])]]
        assert np.abs(inside - centres[b]).max() <= 0.5 * edges[b] + slack


def test_sort_keeps_the_order_of_points_of_one_cell():
    points = np.repeat(np.random.default_rng(4).random((50, 3)), 4, axis=0)
    points = points[np.random.default_rng(5).permutation(200)]
    keys, order = tree.sort(points, *tree.root_cube(points))
    assert np.all(np.diff(keys) >= 0)
    assert np.array_equal(np.sort(order), np.arange(200))
    assert np.all(np.diff(order)[np.diff(keys) == 0] > 0)


def test_root_cube_is_the_smallest_about_all_points():
    rng = np.random.default_rng(6)
    first, second = rng.random((40, 3)) * [1.0, 5.0, 2.0], rng.random((30, 3)) - 3.0
    origin, edge = tree.root_cube(first, np.empty((0, 3)), second)
    both = np.concatenate((first, second))
    assert edge == np.ptp(both, axis=0).max()
    assert np.allclose(origin + 0.5 * edge, 0.5 * (both.min(axis=0) + both.max(axis=0)), rtol=1e-15)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((4, 3), 7.0), np.zeros((1, 3))])
def test_root_cube_of_no_extent_has_edge_one(points):
    origin, edge = tree.root_cube(points)
    assert edge == 1.0
    assert np.all(np.abs(points - origin - 0.5) <= 1e-15)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_refused(value):
    points = np.zeros((3, 3))
    points[1, 2] = value
    with pytest.raises(ValueError, match="finite"):
        tree.root_cube(points)


def test_no_points_leave_the_root():
    none = np.empty(0, dtype=np.int64)
    for rule in (tree.Splitting(leaf_size=1), tree.Splitting(depth=5)):
        boxes = tree.build(none, none, rule)
        assert len(boxes) == boxes.levels == 1 and boxes.leaf[0] and boxes.depth == 0


def test_equal_points_stay_in_one_box():
    keys = sorted_keys(np.full((1000, 3), 0.3))[0]
    assert len(tree.build(keys, keys, tree.Splitting(leaf_size=1))) == 1


def test_two_close_points_are_parted_at_the_first_level_that_can():
    keys = np.array([0, 1 << 30])
    boxes = tree.build(keys, keys, tree.Splitting(leaf_size=1))
    assert boxes.depth == morton.LEVELS - 10
    assert len(boxes) == boxes.levels + 1


@pytest.mark.parametrize("kind", ["sphere", "prolate spheroid", "planar", "clustered"])
def test_boxes_grow_in_proportion_to_points(kind):
    """A leaf holds so many points wherever it is, and only boxes with points are stored."""
    # From where leaves are well smaller than the spheroid is thick.
    sizes = np.array([16_000, 64_000, 256_000])
    count = []
    for n in sizes:
        keys = sorted_keys(CLOUDS[kind](n, np.random.default_rng(7)))[0]
        count.append(len(tree.build(keys, keys, tree.Splitting(leaf_size=30))))
    exponent = np.diff(np.log(count)) / np.diff(np.log(sizes))
    # Exactly 1 in the limit: four times the points are one level more of a surface. What is left
    # of the coarse levels and of random counts about the leaf size gives some per cent.
    assert np.all(np.abs(exponent - 1.0) < 0.05)
    assert np.all(count < sizes / 5)


def test_decision_from_outside_is_asked_level_by_level_until_it_ends():
    keys = sorted_keys(np.random.default_rng(8).random((300, 3)))[0]
    rule, seen = tree.Splitting(leaf_size=10), []

    def decide(level, key, counts, bounds):
        seen.append(level)
        assert len(key) == len(counts) == len(bounds)
        assert np.all(counts[:, 0] == counts[:, 1])
        split = rule.splits(level, counts, bounds)
        return split if split.any() else None

    asked = tree.build(keys, keys, rule, decide)
    plain = tree.build(keys, keys, rule)
    assert seen == list(range(plain.levels))
    assert np.array_equal(asked.key, plain.key) and np.array_equal(asked.leaf, plain.leaf)


def test_decision_from_outside_may_go_on_where_no_box_is_left():
    """A rank without points takes part in the decisions of the others."""
    none, seen = np.empty(0, dtype=np.int64), []

    def decide(level, key, counts, bounds):
        seen.append(len(key))
        return np.ones(len(key), dtype=bool) if level < 4 else None

    boxes = tree.build(none, none, tree.Splitting(leaf_size=3), decide)
    assert seen == [1, 0, 0, 0, 0]
    assert len(boxes) == 1 and not boxes.leaf[0]


BROKEN_TABLES = {
    "root": ([1], [0]),
    "no boxes": ([], []),
    "sorted": ([0, 1, 1], [0, 1 << 60, 0]),
    "sorted (level, key)": ([0, 1, 1], [0, 0, 0]),
    "first of a box": ([0, 1], [0, 5]),
    "no parent": ([0, 1, 2], [0, 0, 1 << 60]),
    "no parent, level missing": ([0, 2], [0, 0]),
}


@pytest.mark.parametrize("name", BROKEN_TABLES)
def test_table_that_is_no_tree_is_refused(name):
    level, key = BROKEN_TABLES[name]
    ranges = np.zeros((len(key), 2))
    message = "root" if name == "no boxes" else name.split(" (")[0].split(",")[0]
    with pytest.raises(ValueError, match=message):
        tree.table(level, key, np.ones(len(key)), ranges, ranges)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"leaf_size": 3, "depth": 3},
        {"leaf_size": 0},
        {"depth": -1},
        {"depth": 21},
        {"depth": 3, "max_level": 2},
        {"leaf_size": 1, "max_level": 21},
    ],
    ids=str,
)
def test_splitting_refuses_what_it_cannot_do(arguments):
    with pytest.raises(ValueError):
        tree.Splitting(**arguments)
