"""Interpolation on equispaced and Chebyshev grids: polynomials, transposes, stability."""

import numpy as np
import pytest

from stokes.fmm import tree
from stokes.fmm.interpolation import Grid, Interpolator

KINDS = ["equispaced", "chebyshev"]
EPS = np.finfo(np.float64).eps


def some_tree(n=900, leaf_size=20, seed=0):
    """A clustered cloud of sources, another of targets, in one adaptive tree over [0, 1]^3."""
    rng = np.random.default_rng(seed)
    sources = rng.uniform(size=(n, 3)) ** 2
    targets = rng.uniform(size=(n // 2, 3))
    source_keys, order = tree.sort(sources, np.zeros(3), 1.0)
    target_keys, target_order = tree.sort(targets, np.zeros(3), 1.0)
    boxes = tree.build(source_keys, target_keys, tree.Splitting(leaf_size=leaf_size))
    x = np.ascontiguousarray(sources[order].T)
    y = np.ascontiguousarray(targets[target_order].T)
    return boxes, x, y


def node_positions(boxes, grid):
    """Positions of all boxes' grid nodes (boxes, nodes³, 3), x slowest."""
    unit = np.stack(np.meshgrid(*[grid.points] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    half = 0.5 * boxes.edges()[boxes.level]
    return boxes.centres()[:, None] + half[:, None, None] * unit


def lagrange_matrix(boxes, box, grid, x):
    """S_α(x_q) as (n, nodes³) of one box, written out: the readable twin of the loops."""
    half = 0.5 * boxes.edges()[boxes.level[box]]
    s = [grid.evaluate((x[a] - boxes.centres()[box, a]) / half) for a in range(3)]
    return np.einsum("qi,qj,qk->qijk", *s).reshape(x.shape[1], grid.nodes**3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [1, 2, 3, 5, 8, 13, 20])
def test_polynomials_are_one_at_their_node_and_zero_at_others(kind, nodes):
    grid = Grid(kind, nodes)
    s = grid.evaluate(grid.points)
    assert np.all(s[~np.eye(nodes, dtype=bool)] == 0.0)
    # a product of 2 nodes factors, each rounded once
    np.testing.assert_allclose(np.diag(s), 1.0, rtol=2 * nodes * EPS)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [1, 2, 5, 8, 13])
def test_sum_of_polynomials_is_one_and_of_derivatives_zero(kind, nodes):
    grid = Grid(kind, nodes)
    x = np.random.default_rng(1).uniform(-1, 1, 500)
    bound = 4 * nodes * EPS * grid.lebesgue
    assert np.abs(grid.evaluate(x).sum(axis=1) - 1).max() < bound
    # Markov: derivatives of polynomials of degree p are up to p² times larger
    assert np.abs(grid.derivative(x).sum(axis=1)).max() < bound * nodes**2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [1, 2, 3, 6, 9, 12])
def test_interpolant_and_its_derivative_are_exact_for_polynomials_of_its_degree(kind, nodes):
    grid = Grid(kind, nodes)
    rng = np.random.default_rng(nodes)
    polynomial = np.polynomial.Chebyshev(rng.normal(size=nodes))
    x = rng.uniform(-1, 1, 200)
    at_nodes = polynomial(grid.points)
    bound = 20 * nodes * EPS * grid.lebesgue * np.abs(polynomial.coef).sum()
    assert np.abs(grid.evaluate(x) @ at_nodes - polynomial(x)).max() < bound
    slope = polynomial.deriv()(x) if nodes > 1 else 0 * x
    assert np.abs(grid.derivative(x) @ at_nodes - slope).max() < bound * nodes**2


@pytest.mark.parametrize("kind", KINDS)
def test_derivative_is_that_of_the_polynomials_even_at_nodes(kind):
    grid = Grid(kind, 7)
    x = np.concatenate([grid.points, np.random.default_rng(3).uniform(-1, 1, 50)])
    h = 1e-20  # of a complex step, whose truncation is below round-off
    others = x[:, None, None] + 1j * h - grid.points
    factors = np.where(np.eye(7, dtype=bool), 1.0, others)
    expected = (grid.scale * np.prod(factors, axis=2)).imag / h
    np.testing.assert_allclose(
        grid.derivative(x), expected, atol=100 * EPS * np.abs(expected).max()
    )


@pytest.mark.parametrize(("kind", "rate"), [("equispaced", 0.4725), ("chebyshev", 1 / 3)])
def test_interpolation_converges_geometrically_for_an_analytic_function(kind, rate):
    # 1/(x - a) is analytic but for the pole at a = 5/3. Chebyshev: error falls as ρ^-nodes,
    # ρ = a + √(a² - 1) = 3. Equispaced: exp(-nodes (potential at the pole - at the ends)),
    # the potential of a uniform charge on [-1, 1], here a factor 0.4725 a node.
    x = np.linspace(-1, 1, 1001)
    pole = 5 / 3
    potential = ((pole + 1) * np.log(pole + 1) - (pole - 1) * np.log(pole - 1)) / 2
    predicted = np.exp(np.log(2) - potential) if kind == "equispaced" else 1 / 3
    assert predicted == pytest.approx(rate, rel=0.02)
    counts = np.array([6, 8, 10, 12, 14, 16])
    errors = []
    for nodes in counts:
        grid = Grid(kind, int(nodes))
        errors.append(np.abs(grid.evaluate(x) @ (1 / (grid.points - pole)) - 1 / (x - pole)).max())
    slope = np.polyfit(counts, np.log(errors), 1)[0]
    # algebraic factors of equispaced nodes change the slope of this range by under a tenth
    assert slope == pytest.approx(np.log(predicted), rel=0.12)


def test_round_off_grows_on_equispaced_nodes_and_not_on_chebyshev_nodes():
    # Perturbing values by one rounding, of random sign, perturbs the interpolant by at most the
    # Lebesgue constant times it: 2^n / (e n ln n) on n + 1 equispaced nodes, (2/π) ln n + 1 else.
    rng = np.random.default_rng(5)
    x = np.linspace(-1, 1, 2001)
    grown = {}
    for kind in KINDS:
        for nodes in (5, 10, 20, 30):
            grid = Grid(kind, nodes)
            noise = EPS * rng.choice([-1.0, 1.0], size=(nodes, 200))
            grown[kind, nodes] = np.abs(grid.evaluate(x) @ noise).max() / EPS
            assert grown[kind, nodes] <= grid.lebesgue * 1.02
    assert max(grown["chebyshev", nodes] for nodes in (5, 10, 20, 30)) < 4
    assert grown["equispaced", 5] < 3
    assert grown["equispaced", 20] > 1e3
    assert grown["equispaced", 30] > 1e6


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [4, 8, 12, 16])
def test_noise_gain_is_the_growth_of_random_errors_in_kernel_values(kind, nodes):
    # One of three directions, targets and sources: the cube root of the gain in space.
    grid = Grid(kind, nodes)
    rng = np.random.default_rng(13)
    noise = rng.normal(size=(100, nodes, nodes))
    s_x, s_y = (grid.evaluate(rng.uniform(-1, 1, 1000)) for _ in range(2))
    grown = np.sqrt(np.mean((s_x @ noise @ s_y.T) ** 2))
    # sampled over 1000 points each; near the ends of equispaced nodes lies most of the sum
    assert grown == pytest.approx(grid.noise_gain ** (1 / 3), rel=0.2)


def test_error_of_interpolated_kernel_ends_at_the_noise_gain_times_rounding():
    # Kernel 1/r of two boxes at distance 3, values rounded to single precision: the error falls
    # with the nodes to a floor, which rises on equispaced nodes and stays on Chebyshev nodes.
    rng = np.random.default_rng(14)
    x, y = rng.uniform(-1, 1, (2, 300))
    exact = 1 / (6 + x[:, None] - y)

    def error(kind, nodes):
        grid = Grid(kind, nodes)
        values = (1 / (6 + grid.points[:, None] - grid.points)).astype(np.float32)
        return np.abs(grid.evaluate(x) @ values.astype(float) @ grid.evaluate(y).T - exact).max()

    unit = np.finfo(np.float32).eps / 6
    assert error("equispaced", 8) < 1e-6
    assert error("chebyshev", 8) < 1e-6
    assert error("equispaced", 20) > 1e3 * unit
    assert error("chebyshev", 20) < 4 * unit


def test_lebesgue_constants_are_those_of_the_literature():
    # L. N. Trefethen and J. A. C. Weideman, J. Approx. Theory 65 (1991): Λ ~ 2^(n+1)/(e n ln n).
    n = 30
    expected = 2.0 ** (n + 1) / (np.e * n * (np.log(n) + np.euler_gamma))
    assert Grid("equispaced", n + 1).lebesgue == pytest.approx(expected, rel=0.2)
    # Chebyshev roots: (2/π)(ln(n + 1) + γ + ln(8/π)) + o(1)
    expected = 2 / np.pi * (np.log(31) + np.euler_gamma + np.log(8 / np.pi))
    assert Grid("chebyshev", 31).lebesgue == pytest.approx(expected, rel=0.01)


def test_runge_function_diverges_on_equispaced_and_converges_on_chebyshev_nodes():
    x = np.linspace(-1, 1, 1001)

    def runge(x):
        return 1 / (1 + 25 * x**2)

    def error(kind, nodes):
        grid = Grid(kind, nodes)
        return np.abs(grid.evaluate(x) @ runge(grid.points) - runge(x)).max()

    assert error("equispaced", 21) > 10 * error("equispaced", 11)
    assert error("chebyshev", 21) < 0.2 * error("chebyshev", 11)


@pytest.mark.parametrize("kind", KINDS)
def test_nodes_are_symmetric_and_scaled_by_the_extent(kind):
    for nodes in (1, 2, 7, 12):
        points = Grid(kind, nodes).points
        assert np.array_equal(points, -points[::-1])
        assert np.all(np.diff(points) > 0)
        np.testing.assert_allclose(Grid(kind, nodes, extent=0.9).points, 0.9 * points, rtol=EPS)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [(("uniform", 3), "kind"), (("chebyshev", 0), "nodes"), (("chebyshev", 3, -1.0), "extent")],
)
def test_impossible_grids_are_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        Grid(*arguments)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [1, 3, 4, 6, 9])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_leaf_moments_are_the_sums_of_polynomials(kind, nodes, dtype):
    boxes, x, _ = some_tree()
    grid = Grid(kind, nodes)
    weights = np.random.default_rng(2).normal(size=(3, x.shape[1]))
    passes = Interpolator(grid, dtype)
    multipoles = passes.empty_moments(boxes, 3)
    passes.p2m(boxes, x, weights, multipoles)
    for box in range(len(boxes)):
        first, end = boxes.sources[box]
        s = lagrange_matrix(boxes, box, grid, x[:, first:end])
        expected = weights[:, first:end] @ s if boxes.leaf[box] else np.zeros((3, nodes**3))
        # round-off of a sum of terms of this size
        size = np.abs(weights[:, first:end]) @ np.abs(s)
        bound = 40 * np.finfo(dtype).eps * size.max(initial=0.0) * boxes.leaf[box]
        assert np.abs(multipoles[box] - expected).max() <= bound


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [1, 2, 5, 6, 11])
def test_root_moments_from_children_equal_those_of_the_points(kind, nodes):
    # Exact, because S of the parent restricted to a child is a polynomial of the child's degree.
    boxes, x, _ = some_tree()
    grid = Grid(kind, nodes)
    weights = np.random.default_rng(2).normal(size=(2, x.shape[1]))
    passes = Interpolator(grid)
    multipoles = passes.empty_moments(boxes, 2)
    passes.upward(boxes, x, weights, multipoles)
    for box in [0, 1, int(boxes.level_start[2]), int(np.flatnonzero(~boxes.leaf)[-1])]:
        first, end = boxes.sources[box]
        s = lagrange_matrix(boxes, box, grid, x[:, first:end])
        expected = weights[:, first:end] @ s
        # every level multiplies round-off of the moments by at most Λ³
        bound = (
            10 * nodes * EPS * grid.lebesgue**3 * (np.abs(weights[:, first:end]) @ np.abs(s)).max()
        )
        assert np.abs(multipoles[box] - expected).max() < bound


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [2, 4, 7])
def test_moments_integrate_polynomials_exactly_on_every_level(kind, nodes):
    # Σ_α M_α f(x_α) = Σ_q w_q f(x_q) for polynomials f of the grid's degree; f = 1: the sum of
    # the weights is preserved.
    boxes, x, _ = some_tree()
    grid = Grid(kind, nodes)
    weights = np.random.default_rng(4).uniform(size=(1, x.shape[1]))
    passes = Interpolator(grid)
    multipoles = passes.empty_moments(boxes, 1)
    passes.upward(boxes, x, weights, multipoles)
    positions = node_positions(boxes, grid)
    degree = nodes - 1
    cumulative = np.zeros(x.shape[1] + 1)
    for f in (
        lambda p: np.ones(p.shape[:-1]),
        lambda p: p[..., 0] ** degree * p[..., 1] ** degree * (1 - p[..., 2]) ** degree,
    ):
        cumulative[1:] = np.cumsum(weights[0] * f(x.T))
        expected = cumulative[boxes.sources[:, 1]] - cumulative[boxes.sources[:, 0]]
        found = np.einsum("bn,bn->b", multipoles[:, 0], f(positions))
        scale = EPS * grid.lebesgue**3 * cumulative[-1]
        assert np.abs(found - expected).max() < 100 * nodes * scale


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [2, 3, 5, 8])
def test_polynomial_fields_pass_from_the_root_to_the_points_exactly(kind, nodes):
    boxes, _, y = some_tree()
    grid = Grid(kind, nodes)
    degree = nodes - 1
    passes = Interpolator(grid)
    locals_ = passes.empty_moments(boxes, 1)

    def f(x, y, z):
        return x**degree * (y - 0.3) ** degree + z

    locals_[0, 0] = f(*node_positions(boxes, grid)[0].T)
    root = locals_.copy()
    out = np.zeros((1, y.shape[1]))
    passes.evaluate(boxes, y, locals_, out)
    bound = 100 * nodes * EPS * grid.lebesgue**3
    assert np.abs(out[0] - f(*y)).max() < bound

    slope = np.zeros((3, y.shape[1]))
    passes.evaluate(boxes, y, root, slope, gradient=True)
    expected = np.array(
        [
            degree * y[0] ** (degree - 1) * (y[1] - 0.3) ** degree,
            y[0] ** degree * degree * (y[1] - 0.3) ** (degree - 1),
            np.ones(y.shape[1]),
        ]
    )
    # derivatives divide by the half edge of the leaves
    assert np.abs(slope - expected).max() < bound * nodes**2 * 2.0 ** (boxes.depth + 1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("nodes", [2, 5, 6])
def test_points_to_grids_and_grids_to_points_are_transposes(kind, dtype, gradient, nodes):
    _, x, _ = some_tree()
    both = tree.build(*[tree.sort(x.T, np.zeros(3), 1.0)[0]] * 2, tree.Splitting(leaf_size=20))
    rng = np.random.default_rng(8)
    columns = 6 if gradient else 2
    weights = rng.normal(size=(columns, x.shape[1]))
    passes = Interpolator(Grid(kind, nodes), dtype)
    locals_ = rng.normal(size=(len(both), 2, nodes**3)).astype(dtype)
    multipoles = np.zeros_like(locals_)
    out = np.zeros_like(weights)
    passes.p2m(both, x, weights, multipoles, gradient=gradient)
    passes.l2p(both, x, locals_, out, gradient=gradient)
    left = np.vdot(locals_.astype(np.float64), multipoles)
    right = np.vdot(out, weights)
    size = np.linalg.norm(out) * np.linalg.norm(weights)
    assert abs(left - right) < 10 * np.finfo(dtype).eps * size


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("nodes", [1, 2, 4, 5, 6, 11])
def test_children_to_parents_and_parents_to_children_are_transposes(kind, dtype, nodes):
    boxes, _, _ = some_tree()
    rng = np.random.default_rng(9)
    passes = Interpolator(Grid(kind, nodes), dtype)
    level = 1
    fine, coarse = boxes.of_level(level + 1), boxes.of_level(level)
    u = rng.normal(size=(len(boxes), 3, nodes**3)).astype(dtype)
    v = rng.normal(size=u.shape).astype(dtype)
    u[coarse] = 0
    v[fine] = 0
    up, down = u.copy(), v.copy()
    passes.m2m(boxes, level, up)
    passes.l2l(boxes, level, down)
    left = np.vdot(up[coarse].astype(np.float64), v[coarse])
    right = np.vdot(u[fine].astype(np.float64), down[fine])
    size = np.linalg.norm(up[coarse]) * np.linalg.norm(v[coarse])
    assert abs(left - right) < 10 * np.finfo(dtype).eps * size
    # and nothing else is touched
    untouched = np.ones(len(boxes), bool)
    untouched[coarse] = False
    assert np.array_equal(up[untouched], u[untouched])


def test_source_derivatives_give_the_moments_of_a_dipole():
    # A dipole is the limit of two opposite charges: central differences of p2m, error O(h²).
    boxes, x, _ = some_tree(n=60, leaf_size=60)
    rng = np.random.default_rng(10)
    direction = rng.normal(size=(3, x.shape[1]))
    passes = Interpolator(Grid("chebyshev", 5))
    exact = passes.empty_moments(boxes, 1)
    passes.p2m(boxes, x, direction, exact, gradient=True)
    errors = []
    for h in (2e-3, 1e-3):
        plus, minus = passes.empty_moments(boxes, 1), passes.empty_moments(boxes, 1)
        ones = np.ones((1, x.shape[1]))
        passes.p2m(boxes, x + h * direction, ones, plus)
        passes.p2m(boxes, x - h * direction, ones, minus)
        errors.append(np.abs((plus - minus) / (2 * h) - exact).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)


@pytest.mark.parametrize("gradient", [False, True])
def test_threads_change_no_bit(gradient):
    boxes, x, y = some_tree(n=3000)
    rng = np.random.default_rng(11)
    weights = rng.normal(size=(3, x.shape[1]))
    results = []
    for threads in (1, 2):
        passes = Interpolator(Grid("equispaced", 4), threads=threads)
        moments = passes.empty_moments(boxes, 1 if gradient else 3)
        passes.upward(boxes, x, weights, moments, gradient=gradient)
        out = np.zeros((3 * moments.shape[1] if gradient else 3, y.shape[1]))
        passes.evaluate(boxes, y, moments, out, gradient=gradient)
        results.append((moments, out))
    assert np.array_equal(results[0][0], results[1][0])
    assert np.array_equal(results[0][1], results[1][1])


def test_frame_of_the_root_cube_only_shifts_and_scales():
    boxes, x, _ = some_tree()
    weights = np.ones((1, x.shape[1]))
    passes = Interpolator(Grid("chebyshev", 4))
    unit, moved = passes.empty_moments(boxes, 1), passes.empty_moments(boxes, 1)
    passes.upward(boxes, x, weights, unit)
    origin = np.array([4.0, -2.0, 1.0])
    passes.upward(boxes, 8.0 * x + origin[:, None], weights, moved, 8.0, origin=origin)
    # coordinates of size 12 lose up to 12/8 2^depth roundings relative to a leaf
    assert np.abs(unit - moved).max() < 100 * EPS * 2.0**boxes.depth * np.abs(unit).max()


def test_only_own_boxes_are_filled():
    boxes, x, _ = some_tree()
    weights = np.ones((1, x.shape[1]))
    passes = Interpolator(Grid("chebyshev", 3))
    own = np.random.default_rng(12).uniform(size=len(boxes)) < 0.5
    moments = passes.empty_moments(boxes, 1)
    passes.p2m(boxes, x, weights, moments, own=own)
    filled = np.abs(moments).max(axis=(1, 2)) > 0
    has_points = boxes.sources[:, 1] > boxes.sources[:, 0]
    assert np.array_equal(filled, own & boxes.leaf & has_points)


@pytest.mark.parametrize("sources", [0, 1, 7])
def test_trees_of_no_point_and_of_one_box_work(sources):
    points = np.full((sources, 3), 0.25)
    keys, _ = tree.sort(points, np.zeros(3), 1.0)
    boxes = tree.build(keys, keys, tree.Splitting(leaf_size=10))
    passes = Interpolator(Grid("equispaced", 3))
    moments = passes.empty_moments(boxes, 1)
    x = np.ascontiguousarray(points.T)
    passes.upward(boxes, x, np.ones((1, sources)), moments)
    assert moments[0].sum() == pytest.approx(sources, abs=1e-13)
    out = np.zeros((1, sources))
    passes.evaluate(boxes, x, np.ones_like(moments), out)
    np.testing.assert_allclose(out, 1.0, atol=1e-13)


def test_moments_of_the_wrong_type_or_layout_are_refused():
    boxes, x, _ = some_tree()
    passes = Interpolator(Grid("chebyshev", 3), np.float32)
    with pytest.raises(ValueError, match="float32"):
        passes.p2m(boxes, x, np.ones((1, x.shape[1])), np.zeros((len(boxes), 1, 27)))
    with pytest.raises(ValueError, match="contiguous"):
        passes.m2m(boxes, 0, np.zeros((len(boxes), 2, 27), np.float32)[:, ::2])
    with pytest.raises(ValueError, match="float64 or float32"):
        Interpolator(Grid("chebyshev", 3), np.int64)
