"""Plans follow from errors, counts and stored constants: never from a clock, a rank or an order."""

from __future__ import annotations

import numpy as np
import pytest
from numba.extending import register_jitable

from dem_mpi.parallel import Parallel
from stokes.fmm import KERNELS, Fmm, FmmOptions, Kernel, calibrate
from stokes.fmm.accuracy import cloud
from stokes.fmm.choice import MOST_NODES, SAFETY, Cost, Errors, choose, constants
from stokes.fmm.tree import Splitting, build, root_cube, sort

laplace, stokeslet = KERNELS["laplace"], KERNELS["stokeslet"]


def choice(kernel, x, eps, parallel=None, **options):
    return choose(kernel, x, x, eps, FmmOptions(**options), parallel or Parallel.alone())


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_table_has_every_kernel_and_falls_with_the_nodes(name):
    kernel = KERNELS[name]
    errors = Errors(kernel, "ufmm", "exact", 1.0)
    values = [errors(nodes) for nodes in range(3, 11)]
    assert np.all(np.diff(values) < 0.0)
    assert values[-1] < 1e-6
    assert name in constants()["nanoseconds"]["double"]["near"]


def test_smaller_errors_take_more_nodes_and_no_single_precision():
    x = cloud("cube", 2000, 1)
    plans = [choice(stokeslet, x, eps) for eps in (1e-2, 1e-4, 1e-6, 1e-9)]
    nodes = [plan.scheme.nodes for plan in plans]
    assert nodes == sorted(nodes)
    assert nodes[0] < nodes[-1]
    assert plans[0].scheme.single
    assert not plans[-1].scheme.single
    for plan, eps in zip(plans, (1e-2, 1e-4, 1e-6, 1e-9), strict=True):
        assert plan.expected_error <= SAFETY * eps


def test_options_have_the_last_word():
    x = cloud("cube", 2000, 1)
    plan = choice(stokeslet, x, 1e-3, order=8, leaf_size=33, precision="double")
    assert (plan.scheme.nodes, plan.scheme.splitting.leaf_size) == (9, 33)
    assert not plan.scheme.single
    assert choice(laplace, x, 1e-3, depth=2).scheme.splitting == Splitting(depth=2)
    assert choice(laplace, x, 1e-3, method="bbfmm", order=3).scheme.method == "bbfmm"


def test_error_out_of_reach_is_said():
    """No grid gives 15 digits: the plan is the most accurate one, and its report says so."""
    plan = choice(laplace, cloud("cube", 500, 1), 1e-15, method="ufmm")
    assert plan.expected_error > 1e-15
    assert "no grid" in plan.why
    assert plan.scheme.nodes <= MOST_NODES["ufmm"]


def test_derivative_is_interpolated_where_that_is_cheaper():
    """Three components exactly, or one and a node more, for the gradient of 1/r."""
    x = cloud("cube", 500, 1)
    kernel = KERNELS["laplace_gradient"]
    assert choice(kernel, x, 1e-6).scheme.derivative == "interpolated"
    assert choice(kernel, x, 1e-6, derivative="exact").scheme.derivative == "exact"


def test_leaf_is_near_the_cheapest():
    """Within 15 % of the best of all leaf sizes by the same model."""
    x = cloud("cube", 20000, 1)
    for eps in (1e-3, 1e-6):
        scheme = choice(stokeslet, x, eps).scheme
        cost = Cost(stokeslet, scheme.method, scheme.nodes, scheme.derivative, scheme.single)
        keys = sort(x, *root_cube(x))[0]

        def nanoseconds(leaf, cost=cost, keys=keys, scheme=scheme):
            boxes = build(keys, keys, Splitting(leaf_size=leaf))
            return sum(cost.of(boxes, scheme.direct_below, 1))

        best = min(nanoseconds(leaf) for leaf in (16, 32, 64, 128, 256, 512, 1024))
        assert nanoseconds(scheme.splitting.leaf_size) <= 1.15 * best


def test_plan_does_not_depend_on_the_order_of_the_points():
    x = cloud("sphere", 200_000, 1)
    one = choice(laplace, x, 1e-4)
    assert choice(laplace, np.random.default_rng(1).permutation(x), 1e-4) == one


def test_smooth_kernel_needs_no_near_field_in_boxes_of_its_length():
    """A wide Gaussian over many points: transfers between touching leaves; few points: not."""
    kernel = KERNELS["gaussian"]
    many = choice(kernel, cloud("cube", 60_000, 1), 1e-6)
    assert many.scheme.admissibility == "smooth"
    assert many.expected_error <= SAFETY * 1e-6
    assert choice(kernel, cloud("cube", 1000, 1), 1e-6).scheme.admissibility == "standard"
    assert choice(laplace, cloud("cube", 60_000, 1), 1e-6).scheme.admissibility == "standard"
    with pytest.raises(ValueError, match="no tree"):
        choice(kernel, 1e4 * cloud("cube", 1000, 1), 1e-6, admissibility="smooth")


@register_jitable
def _cubic(x, y, z, w):
    r2 = x * x + y * y + z * z
    return (w[0] * r2 * np.sqrt(r2),)


def test_unknown_kernel_is_measured_alike_each_time():
    kernel = Kernel("cubic", _cubic, 1, 1, degree=3.0, parity=1)
    x = cloud("cube", 800, 1)
    one, other = (choice(kernel, x, 1e-5) for _ in range(2))
    assert one == other
    w = np.random.default_rng(1).normal(size=800)
    plan = Fmm(kernel, x, eps=1e-5, options=FmmOptions(leaf_size=20))
    assert plan.estimate_error(w, plan.apply(w)).relative_l2 <= 1e-5


@pytest.mark.mpi(ranks=[1, 3])
def test_plan_does_not_depend_on_ranks(parallel):
    x = cloud("prolate", 150_000, 1)
    mine = np.array_split(x, parallel.size)[parallel.rank]
    assert choice(stokeslet, mine, 1e-4, parallel) == choice(stokeslet, x, 1e-4)


def test_calibration_refuses_constants_it_cannot_write_before_it_measures(monkeypatch, capsys):
    monkeypatch.setattr(calibrate.os, "access", lambda path, mode: False)
    monkeypatch.setattr("sys.argv", ["calibrate"])
    with pytest.raises(SystemExit):
        calibrate.main()
    assert "constants.json cannot be written" in capsys.readouterr().err
