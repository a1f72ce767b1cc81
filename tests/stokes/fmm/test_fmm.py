"""The whole fast sum against direct sums, invariances of the sums, and physics of Stokes flow."""

from __future__ import annotations

import functools
import importlib.util

import numba
import numpy as np
import pytest
from numba.extending import register_jitable

from dem_mpi.parallel import Parallel
from stokes.fmm import KERNELS, Fmm, FmmOptions, Kernel, direct_sum
from stokes.fmm._threads import most_threads
from stokes.fmm.accuracy import DISTRIBUTIONS, cloud
from stokes.fmm.kernels import gaussian, stresslet_weights
from stokes.fmm.tree import Splitting
from stokes.fmm.tree_sum import Scheme, TreeSum

EPS = (1e-2, 1e-4, 1e-6, 1e-9)
POINTS, TARGETS = 3000, 1000
laplace, stokeslet, stresslet = (KERNELS[name] for name in ("laplace", "stokeslet", "stresslet"))


def relative_error(values, exact):
    return np.linalg.norm(values - exact) / np.linalg.norm(exact)


def weights_of(kernel, count, seed=7):
    """Weights (count, n_in, 2): the first of random sign, the second of one sign."""
    rng = np.random.default_rng(seed)
    shape = (count, kernel.n_in)
    return np.stack((rng.normal(size=shape), rng.random(shape)), axis=2)


@functools.cache
def reference(name, distribution):
    """Direct sums at the first TARGETS points of a cloud, both kinds of weights."""
    kernel, x = KERNELS[name], cloud(distribution, POINTS, 11)
    return direct_sum(kernel, x, x[:TARGETS], weights_of(kernel, POINTS))


# ---- accuracy ---------------------------------------------------------------------------------


@pytest.mark.parametrize("eps", EPS)
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("name", sorted(KERNELS))
def test_error_is_below_the_asked_one(name, distribution, eps):
    """Three levels at least; weights of random sign and of one sign, 1000 targets."""
    kernel, x = KERNELS[name], cloud(distribution, POINTS, 11)
    plan = Fmm(kernel, x, eps=eps, options=FmmOptions(leaf_size=25))
    assert plan.report.depth >= 3
    values, exact = plan.apply(weights_of(kernel, POINTS))[:TARGETS], reference(name, distribution)
    for sign in (0, 1):
        assert relative_error(values[:, :, sign], exact[:, :, sign]) <= eps


@pytest.mark.parametrize("method", ["ufmm", "bbfmm", "symmetric"])
@pytest.mark.parametrize("name", ["laplace", "stokeslet", "gaussian"])
def test_every_method_converges_with_the_nodes(name, method):
    """Errors fall by at least 2.5 a node: far boxes are 2 edges apart, B section 5.3."""
    kernel, x = KERNELS[name], cloud("cube", POINTS, 11)
    exact, w = reference(name, "cube"), weights_of(kernel, POINTS)
    nodes = (3, 5, 7)
    errors = []
    for order in nodes:
        options = FmmOptions(method=method, order=order - 1, leaf_size=25, precision="double")
        values = Fmm(kernel, x, options=options).apply(w)[:TARGETS]
        errors.append(relative_error(values, exact))
    rates = np.array(errors[:-1]) / errors[1:]
    assert np.all(rates > 2.5**2)


def test_adjacent_levels_meet_by_nodes_and_points():
    """W and X by nodes (nothing direct by fiat) are as accurate as the rest."""
    x = cloud("clustered", POINTS, 11)
    for name in ("laplace", "stokeslet", "laplace_gradient", "laplace_dipole"):
        kernel = KERNELS[name]
        for derivative in ("exact", "interpolated") if kernel.base else ("exact",):
            scheme = Scheme("ufmm", 7, Splitting(leaf_size=25), derivative=derivative)
            plan = TreeSum(kernel, x, None, scheme, Parallel.alone())
            counts = plan.pair_counts()
            assert min(counts.values()) > 0
            values = plan.apply(weights_of(kernel, POINTS))[:TARGETS]
            # the error of 7 nodes in the far field, measured: 2e-6 to 1e-5
            assert relative_error(values, reference(name, "clustered")) < 2e-5


# ---- completeness -----------------------------------------------------------------------------


@register_jitable
def _one(x, y, z, w):
    return (w[0] + 0.0 * x,)


constant = Kernel("constant", _one, 1, 1, degree=0.0, parity=1, smooth=True)


@pytest.mark.parametrize("direct_below", [0, 10**9])
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_constant_kernel_counts_every_source_once(distribution, direct_below):
    """Interpolation of degree 1 is exact for constants: sums are integers after rounding."""
    sources, targets = cloud(distribution, 2000, 3), cloud(distribution, 1500, 4)
    w = np.random.default_rng(5).integers(1, 1000, size=(2000, 1, 1)).astype(float)
    scheme = Scheme("ufmm", 2, Splitting(leaf_size=10), direct_below=direct_below)
    plan = TreeSum(constant, sources, targets, scheme, Parallel.alone())
    assert np.array_equal(np.rint(plan.apply(w)), np.full((1500, 1, 1), w.sum()))


def test_smooth_kernel_without_a_near_field():
    kernel, x = KERNELS["gaussian"], cloud("cube", POINTS, 11)
    options = FmmOptions(admissibility="smooth", depth=2, order=9)
    plan = Fmm(kernel, x, options=options)
    assert plan.report.pairs["near"] == 0
    values = plan.apply(weights_of(kernel, POINTS))[:TARGETS]
    # 10 nodes over boxes of a quarter length of an entire function
    assert relative_error(values, reference("gaussian", "cube")) < 1e-8


# ---- algebra ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["laplace", "stokeslet", "stresslet", "laplace_gradient"])
def test_sum_is_linear_and_columns_are_alike(name):
    kernel, x = KERNELS[name], cloud("sphere", 2000, 1)
    plan = Fmm(kernel, x, eps=1e-6, options=FmmOptions(leaf_size=25))
    w = weights_of(kernel, 2000)
    both = plan.apply(w)
    first, second = plan.apply(w[:, :, 0]), plan.apply(w[:, :, 1])
    # round-off of sums of 2000 terms, here and below
    assert relative_error(both, np.stack((first, second), axis=2)) < 1e-13
    mixed = plan.apply(2.0 * w[:, :, 0] - 3.0 * w[:, :, 1])
    assert np.allclose(mixed, 2.0 * first - 3.0 * second, rtol=0, atol=1e-10 * np.abs(mixed).max())


@pytest.mark.parametrize("name", sorted(n for n, k in KERNELS.items() if k.transpose))
def test_transposed_kernel_gives_the_adjoint_sum(name):
    """<u, K v> = <K^T u, v>: interpolation with the same nodes on both sides is symmetric."""
    kernel, eps = KERNELS[name], 1e-6
    x, y = cloud("cube", 1000, 1), cloud("cube", 1200, 2)
    rng = np.random.default_rng(3)
    u, v = rng.normal(size=(1000, kernel.n_out)), rng.normal(size=(1200, kernel.n_in))
    options = FmmOptions(leaf_size=25)
    there = Fmm(kernel, y, x, eps, options).apply(v)
    back = Fmm(kernel.transposed(), x, y, eps, options).apply(u)
    size = np.linalg.norm(u) * np.linalg.norm(there)
    assert abs(np.vdot(u, there) - np.vdot(back, v)) < 2.0 * eps * size


@pytest.mark.parametrize("name", ["laplace", "stokeslet", "inverse_fourth"])
@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_scale_of_the_cloud_changes_values_by_the_degree(name, scale):
    kernel, x = KERNELS[name], cloud("cube", 1500, 1)
    w = weights_of(kernel, 1500)[:, :, 0]
    options = FmmOptions(leaf_size=25)
    one = Fmm(kernel, x, options=options).apply(w)
    other = Fmm(kernel, x * scale, options=options).apply(w)
    expected = one * scale**kernel.degree
    assert np.linalg.norm((other - expected) / scale**kernel.degree) < 1e-11 * np.linalg.norm(one)


def test_translation_and_rotation_of_the_cloud():
    """An offset of 1e8 leaves 8 digits of the differences; a turn moves points between boxes."""
    kernel, x = stokeslet, np.round(cloud("cube", 2000, 1) * 2**20) / 2**20
    w = weights_of(kernel, 2000)[:, :, 0]
    options = FmmOptions(leaf_size=25)
    one = Fmm(kernel, x, eps=1e-6, options=options).apply(w)
    # multiples of 2^-20 plus 2^26 are exact: nothing may change but round-off
    moved = Fmm(kernel, x + 2.0**26, eps=1e-6, options=options).apply(w)
    assert relative_error(moved, one) < 1e-12
    far = Fmm(kernel, x + 1e8, eps=1e-6, options=options).apply(w)
    assert relative_error(far, one) < 1e-6
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turned = Fmm(kernel, x @ turn.T, eps=1e-6, options=options).apply(w @ turn.T)
    assert relative_error(turned @ turn, one) < 2e-6


# ---- degenerate clouds ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["laplace", "stokeslet", "gaussian"])
@pytest.mark.parametrize(
    "points",
    [
        np.array([[1.0, 2.0, 3.0]]),
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        np.tile([[0.3, -0.2, 7.0]], (100, 1)),
        np.outer(np.linspace(0.0, 1.0, 800), [1.0, 2.0, -1.0]),
        np.random.default_rng(1).random((800, 3)) * [1.0, 1.0, 0.0],
        np.repeat(np.random.default_rng(2).random((300, 3)), 3, axis=0),
    ],
    ids=["one", "two", "equal", "line", "plane", "duplicates"],
)
def test_degenerate_clouds(name, points):
    """A source leaves itself out, and its duplicates, if the kernel is singular."""
    kernel = KERNELS[name]
    w = weights_of(kernel, len(points))[:, :, 0]
    exact = direct_sum(kernel, points, None, w)
    for leaf_size in (None, 5):
        plan = Fmm(kernel, points, eps=1e-6, options=FmmOptions(leaf_size=leaf_size))
        assert np.linalg.norm(plan.apply(w) - exact) <= 1e-6 * np.linalg.norm(exact)


def test_no_points_give_no_values():
    empty, some = np.empty((0, 3)), cloud("cube", 10, 1)
    assert Fmm(laplace, empty).apply(np.empty(0)).shape == (0,)
    assert np.array_equal(Fmm(laplace, empty, some).apply(np.empty(0)), np.zeros(10))
    assert Fmm(stokeslet, some, empty).apply(np.ones((10, 3))).shape == (0, 3)


def lattice(side):
    """Points (side^3, 3): those of power-of-two sides lie on faces and corners of boxes."""
    axis = np.arange(side) / (side - 1 if side % 2 else side)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("side", [13, 12, 8, 9])
@pytest.mark.parametrize("eps", [1e-3, 1e-6])
def test_lattice_points_on_faces_of_boxes(side, eps):
    x = lattice(side)
    w = weights_of(stokeslet, len(x))
    values = Fmm(stokeslet, x, eps=eps, options=FmmOptions(leaf_size=12)).apply(w)
    exact = direct_sum(stokeslet, x, None, w)
    for sign in (0, 1):
        assert relative_error(values[:, :, sign], exact[:, :, sign]) <= eps


@pytest.mark.parametrize("eps", [1e-3, 1e-6])
@pytest.mark.parametrize("size", [1e-300, 1e-40, 1e40, 1e300])
def test_weights_of_any_size(eps, size):
    """Single precision ends at 1e38: weights beyond are scaled by powers of two."""
    x, w = cloud("cube", 1000, 1), weights_of(laplace, 1000)
    plan = Fmm(laplace, x, eps=eps, options=FmmOptions(leaf_size=25))
    values = plan.apply(size * w) / size
    assert np.isfinite(values).all()
    assert relative_error(values, plan.apply(w)) < 1e-3 * eps
    assert np.array_equal(plan.apply(0.0 * w), np.zeros((1000, 1, 2)))


@pytest.mark.parametrize("size", [1e-150, 1e150])
def test_coordinates_to_the_ends_of_their_range(size):
    x, w = cloud("cube", 1000, 1), weights_of(laplace, 1000)
    values = Fmm(laplace, x * size, options=FmmOptions(leaf_size=25)).apply(w)
    assert relative_error(values * size, direct_sum(laplace, x, None, w)) <= 1e-6


def test_weights_that_are_no_numbers_show():
    x, w = cloud("cube", 1000, 1), np.ones((1000, 1, 2))
    w[3, 0, 1] = np.nan
    plan = Fmm(laplace, x, eps=1e-3, options=FmmOptions(leaf_size=25))
    values = plan.apply(w)
    neighbour = np.argsort(np.linalg.norm(x - x[3], axis=1))[1]
    assert np.isnan(values[neighbour, 0, 1])
    assert np.array_equal(plan.apply(np.ones(1000)), plan.apply(np.ones((1000, 1)))[:, 0])


def test_layout_and_precision_of_the_input_do_not_matter():
    """Strided, transposed, read-only arrays; numbers in single give what they are in double."""
    x = cloud("cube", 1000, 1).astype(np.float32)
    w = weights_of(stokeslet, 1000)[:, :, 0].astype(np.float32)
    options = FmmOptions(leaf_size=25)
    expected = Fmm(stokeslet, x.astype(float), options=options).apply(w.astype(float))
    assert np.array_equal(Fmm(stokeslet, x, options=options).apply(w), expected)
    strided, transposed = np.repeat(x, 2, axis=0)[::2], np.asfortranarray(w)
    for array in (strided, transposed):
        array.flags.writeable = False
    assert np.array_equal(Fmm(stokeslet, strided, options=options).apply(transposed), expected)


def test_plans_side_by_side_do_not_meet():
    x, y = cloud("cube", 1000, 1), cloud("sphere", 1000, 2)
    v, w = (weights_of(k, 1000)[:, :, 0] for k in (laplace, stokeslet))
    options = FmmOptions(leaf_size=25)
    first, second = Fmm(laplace, x, options=options), Fmm(stokeslet, y, options=options)
    once = first.apply(v), second.apply(w)
    again = first.apply(v), second.apply(w)
    assert np.array_equal(once[0], again[0])
    assert np.array_equal(once[1], again[1])
    assert np.array_equal(once[0], Fmm(laplace, x, options=options).apply(v))


def test_error_out_of_reach_is_told():
    """1e-15 is below the round-off of every grid."""
    x, w = cloud("cube", 1000, 1), weights_of(laplace, 1000)
    with pytest.warns(RuntimeWarning, match="out of reach"):
        plan = Fmm(laplace, x, eps=1e-15, options=FmmOptions(leaf_size=100))
    assert plan.report.expected_error > 1e-15
    assert "expected error" in plan.report.why
    assert relative_error(plan.apply(w), direct_sum(laplace, x, None, w)) < 1e-9


# ---- Stokes flow ------------------------------------------------------------------------------


def test_stokeslet_flow_is_free_of_divergence():
    """Central differences of the summed velocity: the trace vanishes against the gradient."""
    y = cloud("cube", 3000, 1)
    f = weights_of(stokeslet, 3000)[:, :, 0]
    x = 0.2 + 0.6 * cloud("cube", 50, 2)
    h = 1e-3
    steps = h * np.vstack((np.eye(3), -np.eye(3)))
    targets = (x[:, None, :] + steps).reshape(-1, 3)
    # differences divide the error by 2h; a cancellation of the near field's 1/h^2 is left
    plan = Fmm(stokeslet, y, targets, eps=1e-9, options=FmmOptions(leaf_size=60))
    u = plan.apply(f).reshape(50, 6, 3)
    gradient = (u[:, :3] - u[:, 3:]) / (2.0 * h)
    divergence = np.trace(gradient, axis1=1, axis2=2)
    assert np.linalg.norm(divergence) < 1e-2 * np.linalg.norm(gradient)


def sphere_quadrature(polar, azimuthal):
    """Nodes (= normals) and weights on the unit sphere: Gauss in cos, trapezoid in azimuth."""
    c, w = np.polynomial.legendre.leggauss(polar)
    phi = 2.0 * np.pi * (np.arange(azimuthal) + 0.5) / azimuthal
    s = np.sqrt(1.0 - c**2)
    x = np.stack(
        (
            np.outer(s, np.cos(phi)),
            np.outer(s, np.sin(phi)),
            np.repeat(c[:, None], azimuthal, axis=1),
        ),
        axis=-1,
    )
    return x.reshape(-1, 3), np.repeat(w * 2.0 * np.pi / azimuthal, azimuthal)


def test_stresslet_of_constant_density_is_the_jump():
    """u = -q inside a closed surface, -q/2 on it, 0 outside: double layer with factor 1/(8 pi).

    r points from source to target, the normal n out of the body. On the surface the term of the
    node itself is left out: an error of the size of a cell over the radius, 1/60 here.
    """
    y, area = sphere_quadrature(60, 120)
    q = np.array([1.0, -2.0, 0.5])
    w = stresslet_weights(np.tile(q, (len(y), 1)), y) * area[:, None] / (8.0 * np.pi)
    direction = cloud("sphere", 100, 1)
    for targets, jump, tolerance in (
        (0.5 * direction, -1.0, 1e-6),
        (2.0 * direction, 0.0, 1e-6),
        (y, -0.5, 1.0 / 60.0),
    ):
        u = Fmm(stresslet, y, targets, eps=1e-6).apply(w)
        assert np.sqrt(np.mean((u - jump * q) ** 2)) < tolerance * np.linalg.norm(q)


# ---- plans ------------------------------------------------------------------------------------


@register_jitable
def _screened(x, y, z, w):
    r2 = x * x + y * y + z * z
    return (w[0] * np.exp(-np.sqrt(r2)) / np.sqrt(r2 + 1e-4),)


def test_error_of_a_kernel_of_ones_own_is_measured():
    kernel = Kernel("screened", _screened, 1, 1, parity=1, length=0.3)
    x = cloud("cube", 2000, 1)
    w = np.random.default_rng(1).normal(size=2000)
    for eps in (1e-3, 1e-5):
        plan = Fmm(kernel, x, eps=eps, options=FmmOptions(leaf_size=40))
        assert plan.estimate_error(w, plan.apply(w)).relative_l2 <= eps


def test_estimated_error_is_the_error():
    x = cloud("cube", 1200, 1)
    w = weights_of(laplace, 1200)[:, 0, 0]
    plan = Fmm(laplace, x, eps=1e-3, options=FmmOptions(leaf_size=25))
    values = plan.apply(w)
    exact = direct_sum(laplace, x, None, w)
    whole = plan.estimate_error(w, values, samples=5000)
    assert whole.samples == 1200
    assert whole.relative_l2 == pytest.approx(relative_error(values, exact), rel=1e-6)
    part = plan.estimate_error(w, values, samples=300)
    assert part.samples == 300
    assert part.relative_l2 == pytest.approx(whole.relative_l2, rel=0.5)


def test_report_tells_what_was_planned():
    x = cloud("sphere", 3000, 1)
    plan = Fmm(stokeslet, x, eps=1e-6, options=FmmOptions(leaf_size=30))
    report = plan.report
    assert (report.method, report.kernel, report.leaf_size) == ("ufmm", "stokeslet", 30)
    assert report.expected_error <= 1e-6
    assert report.boxes > 100
    assert report.pairs["near"] > 0
    assert report.pairs["far"] > 0
    assert sum(report.memory.values()) > 0
    assert report.memory["spectra"] == 0
    plan.apply(weights_of(stokeslet, len(x)))
    applied = plan.report
    assert applied.memory["spectra"] > 0
    assert {**applied.memory, "spectra": 0} == report.memory
    assert set(report.plan_seconds) == {"tree", "lists", "tables", "near"}
    assert report.compile_seconds >= 0.0


def test_a_plan_shows_what_it_sums_and_how():
    x = cloud("cube", 50, 1)
    same = Fmm(laplace, x, eps=1e-3, options=FmmOptions(order=4))
    assert repr(same) == "<Fmm laplace, 50 points, eps=0.001, ufmm, 5 nodes>"
    apart = Fmm(laplace, x, x[:7], options=FmmOptions(backend="direct"))
    assert repr(apart) == "<Fmm laplace, 50 to 7 points, eps=1e-06, backend='direct'>"


def test_direct_backend_is_the_direct_sum():
    x = cloud("cube", 500, 1)
    w = weights_of(stokeslet, 500)
    plan = Fmm(stokeslet, x, options=FmmOptions(backend="direct"))
    assert np.array_equal(plan.apply(w), direct_sum(stokeslet, x, None, w))
    assert plan.report.method == "direct"


@pytest.mark.parametrize("name", ["laplace", "laplace_gradient", "stokeslet"])
def test_fmm3d_agrees_or_says_that_it_is_absent(name):
    kernel, x, options = KERNELS[name], cloud("cube", 2000, 1), FmmOptions(backend="fmm3d")
    if importlib.util.find_spec("fmm3dpy") is None:
        with pytest.raises(ModuleNotFoundError, match="pip install fmm3dpy"):
            Fmm(kernel, x, eps=1e-6, options=options)
        return
    w = weights_of(kernel, 2000)
    values = Fmm(kernel, x, eps=1e-6, options=options).apply(w)
    assert relative_error(values, direct_sum(kernel, x, None, w)) < 1e-5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"eps": 0.0}, "eps"),
        ({"eps": np.nan}, "eps"),
        ({"eps": "1e-3"}, "eps"),
        ({"sources": np.zeros((3, 2))}, "sources"),
        ({"sources": np.array([[0.0, np.inf, 0.0]])}, "finite"),
        ({"options": FmmOptions(derivative="interpolated")}, "derivative"),
        ({"options": FmmOptions(admissibility="smooth", depth=2)}, "smooth"),
        (
            {"kernel": gaussian(), "options": FmmOptions(admissibility="smooth", leaf_size=9)},
            "leaf_size",
        ),
    ],
)
def test_impossible_plans_are_refused(arguments, message):
    request = {"kernel": laplace, "sources": cloud("cube", 20, 1)} | arguments
    with pytest.raises(ValueError, match=message):
        Fmm(**request)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "fast"},
        {"order": 0},
        {"order": 4.5},
        {"leaf_size": 0},
        {"leaf_size": "9"},
        {"near_memory": "1e9"},
        {"depth": 2, "leaf_size": 9},
    ],
)
def test_senseless_options_are_refused(options):
    with pytest.raises(ValueError, match="|".join(options)):
        FmmOptions(**options)


@pytest.mark.parametrize("argument", ["kernel", "options", "parallel"])
def test_arguments_of_another_kind_are_refused(argument):
    request = {"kernel": laplace, "sources": cloud("cube", 20, 1)} | {argument: "laplace"}
    with pytest.raises(TypeError, match=argument):
        Fmm(**request)


@register_jitable
def _infinite_at_origin(x, y, z, w):
    return (w[0] / np.sqrt(x * x + y * y + z * z),)


def _not_compiled(x, y, z, w):
    return (w[0],)


@pytest.mark.parametrize(
    ("function", "message"),
    [(_infinite_at_origin, "not finite at r = 0"), (_not_compiled, "register_jitable")],
)
def test_kernels_that_break_the_rules_are_refused(function, message):
    with pytest.raises(ValueError, match=message):
        Fmm(Kernel("own", function, 1, 1), cloud("cube", 20, 1))


def test_weights_of_another_shape_are_refused():
    plan = Fmm(stokeslet, cloud("cube", 20, 1))
    with pytest.raises(ValueError, match="weights of shape"):
        plan.apply(np.ones((20, 2)))
    with pytest.raises(ValueError, match="complex"):
        plan.apply(np.ones((20, 3), dtype=complex))
    with pytest.raises(ValueError, match="values of shape"):
        plan.estimate_error(np.ones((20, 3)), np.ones((20, 2)))


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_wrong_input_on_one_rank_is_everyones_error(parallel):
    """No rank is left waiting; all can go on afterwards."""
    wrong = parallel.rank == parallel.size - 1
    x = cloud("cube", 20, parallel.rank)
    with pytest.raises(TypeError, match="kernel"):
        Fmm("laplace" if wrong else laplace, x, parallel=parallel)
    with pytest.raises(ValueError, match="eps"):
        Fmm(laplace, x, eps="1e-3" if wrong else 1e-3, parallel=parallel)
    plan = Fmm(laplace, x, eps=1e-3, parallel=parallel)
    with pytest.raises(ValueError, match="could not convert"):
        plan.apply(["a"] * 20 if wrong else np.ones(20))
    values = plan.apply(np.ones(20))
    with pytest.raises(ValueError, match="values of shape"):
        plan.estimate_error(np.ones(20), values[: 5 if wrong else 20])
    assert plan.estimate_error(np.ones(20), values).relative_l2 < 1e-3


@pytest.mark.mpi(ranks=[2, 3])
def test_different_requests_of_ranks_are_refused(parallel):
    last = parallel.rank == parallel.size - 1
    x = cloud("cube", 20, parallel.rank)
    for request in (
        {"kernel": KERNELS["inverse_square"] if last else laplace},
        {"eps": 1e-3 if last else 1e-6},
        {"options": FmmOptions(depth=2 if last else 1)},
    ):
        with pytest.raises(ValueError, match="not the same on all ranks"):
            Fmm(**({"kernel": laplace, "sources": x, "parallel": parallel} | request))
    threads = min(1 + parallel.rank % 2, most_threads())  # each rank's own affair
    options = FmmOptions(threads=threads)
    plan = Fmm(laplace, x, options=options, parallel=parallel)
    with pytest.raises(ValueError, match="right-hand sides"):
        plan.apply(np.ones((20, 1, 2 if last else 3)))


# ---- ranks ------------------------------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
def test_values_do_not_depend_on_the_number_of_ranks(parallel):
    """Against one rank, 1e-12: multipoles of boxes cut by ranks are summed in another order."""
    for name, distribution in (("laplace", "clustered"), ("stokeslet", "sphere")):
        kernel, x = KERNELS[name], cloud(distribution, 2500, 1)
        w = weights_of(kernel, 2500)
        mine = np.array_split(np.random.default_rng(1).permutation(2500), parallel.size)[
            parallel.rank
        ]
        plan = Fmm(kernel, x[mine], eps=1e-6, parallel=parallel)
        values = plan.apply(w[mine])
        alone = Fmm(kernel, x, eps=1e-6)
        assert plan.report.leaf_size == alone.report.leaf_size
        expected = alone.apply(w)[mine]
        assert np.abs(values - expected).max() <= 1e-12 * np.abs(expected).max()
        estimate = plan.estimate_error(w[mine], values, samples=400)
        assert estimate.samples == 400
        assert estimate.relative_l2 <= 1e-6


def test_more_threads_than_there_are_are_refused():
    FmmOptions(threads=most_threads())
    with pytest.raises(ValueError, match=f"there are {most_threads()}"):
        FmmOptions(threads=most_threads() + 1)


@pytest.mark.skipif(most_threads() < 2, reason="needs two threads")
@pytest.mark.parametrize("near", ["cached", "recomputed"])
def test_sums_leave_the_number_of_threads_as_it_was(near):
    x, before = cloud("cube", 500, 1), numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        plan = Fmm(laplace, x, eps=1e-2, options=FmmOptions(threads=2, near=near, leaf_size=30))
        plan.apply(weights_of(laplace, len(x)))
        direct_sum(laplace, x, None, weights_of(laplace, len(x)), threads=2)
        assert numba.get_num_threads() == 1
    finally:
        numba.set_num_threads(before)
