"""Kernels of the fast sums against their formulas, written out in numpy."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import textwrap

import numba
import numpy as np
import pytest
from numba.extending import register_jitable

from stokes.fmm import kernels
from stokes.fmm.kernels import (
    KERNELS,
    SYMMETRIC,
    SYMMETRIC_THIRD,
    Kernel,
    constant,
    decay,
    inverse_distance,
    stokeslet,
    stokeslet_pressure,
    stresslet,
    stresslet_pressure,
    stresslet_weights,
    traction,
)

ROUNDING = 2e-14
"""Some ten operations of 1.1e-16 each, and sums of up to three terms that may cancel tenfold."""

DELTA = np.eye(3)


def _outer(r: np.ndarray, order: int) -> np.ndarray:
    result = np.ones(len(r))
    for _ in range(order):
        result = np.einsum("n...,ni->n...i", result, r)
    return result


def _over(tensor: np.ndarray, r: np.ndarray, power: int) -> np.ndarray:
    """tensor / |r|^power, point by point."""
    return tensor / np.linalg.norm(r, axis=1).reshape(-1, *[1] * (tensor.ndim - 1)) ** power


def _six(tensor: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
    """The two symmetric axes of a tensor taken together, in the order of SYMMETRIC."""
    moved = np.moveaxis(tensor, axes, (-2, -1))
    return np.moveaxis(
        moved[..., [i for i, _ in SYMMETRIC], [j for _, j in SYMMETRIC]], -1, axes[0]
    )


def _hessian(r: np.ndarray) -> np.ndarray:
    return 3 * _over(_outer(r, 2), r, 5) - _over(np.broadcast_to(DELTA, (len(r), 3, 3)), r, 3)


def _stokeslet(r: np.ndarray) -> np.ndarray:
    return _over(np.broadcast_to(DELTA, (len(r), 3, 3)), r, 1) + _over(_outer(r, 2), r, 3)


def _stokeslet_gradient(r: np.ndarray) -> np.ndarray:
    first = (
        -np.einsum("ij,nk->nikj", DELTA, r)
        + np.einsum("ik,nj->nikj", DELTA, r)
        + np.einsum("jk,ni->nikj", DELTA, r)
    )
    return (_over(first, r, 3) - 3 * _over(_outer(r, 3), r, 5)).reshape(-1, 9, 3)


def _softened(r: np.ndarray, order: int) -> np.ndarray:
    a = np.sqrt(np.sum(r**2, axis=1) + 1)
    if order == 1:
        return r / a[:, None]
    if order == 2:
        tensor = DELTA / a[:, None, None] - _outer(r, 2) / a[:, None, None] ** 3
        return _six(tensor, (1, 2))
    mixed = np.einsum("ij,nk->nijk", DELTA, r)
    mixed = mixed + mixed.transpose(0, 1, 3, 2) + mixed.transpose(0, 3, 2, 1)
    tensor = -mixed / a[:, None, None, None] ** 3 + 3 * _outer(r, 3) / a[:, None, None, None] ** 5
    return np.stack([tensor[:, i, j, k] for i, j, k in SYMMETRIC_THIRD], axis=1)


def _norm(r: np.ndarray) -> np.ndarray:
    return np.linalg.norm(r, axis=1)


FORMULAS = {
    "laplace": lambda r: 1 / _norm(r),
    "inverse_square": lambda r: 1 / _norm(r) ** 2,
    "inverse_fourth": lambda r: 1 / _norm(r) ** 4,
    "gaussian": lambda r: np.exp(-(_norm(r) ** 2)),
    "exponential": lambda r: np.exp(-_norm(r)),
    "matern52": lambda r: (
        (1 + np.sqrt(5) * _norm(r) + 5 / 3 * _norm(r) ** 2) * np.exp(-np.sqrt(5) * _norm(r))
    ),
    "laplace_gradient": lambda r: -_over(r, r, 3),
    "laplace_dipole": lambda r: _over(r, r, 3),
    "laplace_dipole_gradient": lambda r: -_hessian(r),
    "laplace_quadrupole": lambda r: _six(_hessian(r), (1, 2)),
    "laplace_hessian": lambda r: _six(_hessian(r), (1, 2)),
    "stokeslet": _stokeslet,
    "stokeslet_pressure": lambda r: 2 * _over(r, r, 3),
    "stokeslet_gradient": _stokeslet_gradient,
    "stresslet": lambda r: _six(6 * _over(_outer(r, 3), r, 5), (2, 3)),
    "stresslet_pressure": lambda r: _six(4 * _hessian(r), (1, 2)),
    "stokes_stress": lambda r: _six(-6 * _over(_outer(r, 3), r, 5), (1, 2)),
    "softened": lambda r: 1 / np.sqrt(_norm(r) ** 2 + 1),
    "softened_distance_gradient": lambda r: _softened(r, 1),
    "softened_distance_hessian": lambda r: _softened(r, 2),
    "softened_distance_third": lambda r: _softened(r, 3),
}

every_kernel = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS.keys())


def _points(n: int = 500, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 3))


def _signed_permutations() -> list[np.ndarray]:
    return [
        np.diag(signs) @ np.eye(3)[list(p)]
        for p in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]


def _close(a: np.ndarray, b: np.ndarray, tolerance: float = ROUNDING) -> None:
    """Equal up to `tolerance` of the largest entry at the same point."""
    assert a.shape == b.shape
    scale = np.abs(b).reshape(len(b), -1).max(axis=1).reshape(-1, *[1] * (b.ndim - 1))
    assert np.max(np.abs(a - b) / scale) < tolerance


def test_every_kernel_has_a_formula_here():
    assert FORMULAS.keys() == KERNELS.keys()


@every_kernel
def test_kernel_is_its_formula(kernel):
    r = _points()
    _close(kernel.matrix(r), FORMULAS[kernel.name](r).reshape(-1, kernel.n_out, kernel.n_in))


@every_kernel
def test_singular_kernel_vanishes_at_the_origin_and_others_have_their_value(kernel):
    value = kernel.matrix(np.zeros((1, 3)))
    expected = np.zeros_like(value)
    if kernel.name in ("gaussian", "exponential", "matern52", "softened"):
        expected[:] = 1.0
    if kernel.name == "softened_distance_hessian":
        expected[0, :3, 0] = 1.0
    np.testing.assert_allclose(value, expected, rtol=ROUNDING, atol=0)


@every_kernel
def test_equal_entries_share_a_number_and_different_ones_do_not(kernel):
    r = _points()
    matrix, unique = kernel.matrix(r), kernel.unique(r)
    assert unique.shape == (len(r), kernel.n_unique)
    _close(matrix, unique[:, np.array(kernel.entry)])
    for a, b in itertools.combinations(range(kernel.n_unique), 2):
        assert (
            np.abs(unique[:, a] - unique[:, b]).max() > 1e-3 * np.abs(matrix).max(axis=(1, 2)).min()
        )


def test_numbers_of_distinct_components():
    counts = {name: KERNELS[name].n_unique for name in ("stokeslet", "stresslet", "stokes_stress")}
    assert counts == {"stokeslet": 6, "stresslet": 10, "stokes_stress": 10}
    assert KERNELS["laplace_dipole_gradient"].n_unique == 6
    assert KERNELS["stokeslet_gradient"].n_unique == 16
    assert KERNELS["softened_distance_third"].n_unique == 10


@every_kernel
def test_parity_under_point_reflection(kernel):
    r = _points()
    assert kernel.parity != 0
    np.testing.assert_array_equal(kernel.matrix(-r), kernel.parity * kernel.matrix(r))


@every_kernel
def test_homogeneity(kernel):
    r = _points()
    if kernel.homogeneous:
        _close(kernel.matrix(0.3 * r), 0.3**kernel.degree * kernel.matrix(r))
    else:
        assert np.abs(kernel.matrix(2 * r) / kernel.matrix(r)).std() > 1e-3


@every_kernel
def test_components_permute_under_the_48_symmetries_of_the_cube(kernel):
    r = _points(50)
    for q in _signed_permutations():
        r_out, r_in = kernel.rotate(q)
        for permutation in (r_out, r_in):
            np.testing.assert_array_equal(np.abs(permutation).sum(axis=0), 1.0)
            np.testing.assert_array_equal(np.abs(permutation).sum(axis=1), 1.0)
        _close(kernel.matrix(r @ q.T), r_out @ kernel.matrix(r) @ r_in.T)


@every_kernel
def test_transposed_kernel_is_the_transpose_with_ends_exchanged(kernel):
    r = _points()
    if kernel.transpose is None:
        with pytest.raises(ValueError, match="no kernel is known"):
            kernel.transposed()
        return
    _close(kernel.transposed().matrix(-r), kernel.matrix(r).transpose(0, 2, 1))
    twice = kernel.transposed().transposed()
    np.testing.assert_array_equal(twice.matrix(r), kernel.matrix(r))


@every_kernel
def test_length_scales_the_argument(kernel):
    if kernel.homogeneous:
        return
    length, r = 0.4, _points()
    scaled = getattr(kernels, kernel.name)(length)
    power = {"softened": -1, "softened_distance_hessian": -1, "softened_distance_third": -2}
    expected = length ** power.get(kernel.name, 0) * kernel.matrix(r / length)
    _close(scaled.matrix(r), expected)


def _gradient(kernel: Kernel, r: np.ndarray, step: float) -> np.ndarray:
    """Central differences of the kernel, (k, n_out, n_in, 3); error of order step^2."""
    axes = [(kernel.matrix(r + step * e) - kernel.matrix(r - step * e)) / (2 * step) for e in DELTA]
    return np.stack(axes, axis=-1)


def _assert_second_order(approximations: dict[float, np.ndarray], exact: np.ndarray) -> None:
    """The error falls fourfold when the step is halved: the limit is the exact value."""
    errors = [np.abs(a - exact).max() for _, a in sorted(approximations.items())]
    orders = np.log2(np.array(errors[1:]) / np.array(errors[:-1]))
    assert np.all(np.abs(orders - 2) < 0.1), (errors, orders)


STEPS = (0.01, 0.02, 0.04)


def _away(n: int = 50) -> np.ndarray:
    r = _points(4 * n, seed=2)
    return r[_norm(r) > 1][:n]


@pytest.mark.parametrize("name", [k.name for k in KERNELS.values() if k.base is not None])
def test_derived_kernel_is_the_gradient_of_its_base(name):
    kernel, r = KERNELS[name], _away()
    sign = 1.0 if kernel.derivative == "target" else -1.0
    exact = kernel.matrix(r)
    differences = {}
    for step in STEPS:
        d = sign * _gradient(kernel.base, r, step)  # (k, base out, base in, axis)
        d = d.transpose(0, 1, 3, 2) if kernel.derivative == "target" else d
        differences[step] = d.reshape(exact.shape)
    _assert_second_order(differences, exact)


@pytest.mark.parametrize(
    ("name", "of", "components"),
    [
        ("laplace_hessian", "laplace_gradient", SYMMETRIC),
        ("softened_distance_hessian", "softened_distance_gradient", SYMMETRIC),
        ("softened_distance_third", "softened_distance_hessian", SYMMETRIC_THIRD),
    ],
)
def test_higher_derivatives_are_derivatives_of_the_lower(name, of, components):
    r, lower = _away(), KERNELS[of]
    differences = {}
    for step in STEPS:
        gradient = _gradient(lower, r, step)[:, :, 0]
        columns = [gradient[:, lower.outputs.index(tuple(i[:-1])), i[-1]] for i in components]
        differences[step] = np.stack(columns, axis=1)[:, :, None]
    _assert_second_order(differences, KERNELS[name].matrix(r))


@pytest.mark.parametrize("kernel", [stokeslet, stresslet], ids=lambda k: k.name)
def test_stokes_velocity_is_free_of_divergence(kernel):
    r = _away()
    divergences = {
        step: np.einsum("nijk,ik->nj", _gradient(kernel, r, step), DELTA) for step in STEPS
    }
    _assert_second_order(divergences, np.zeros((len(r), kernel.n_in)))


@pytest.mark.parametrize(
    ("velocity", "pressure"),
    [(stokeslet, stokeslet_pressure), (stresslet, stresslet_pressure)],
    ids=["single layer", "double layer"],
)
def test_momentum_balance_of_velocity_and_pressure(velocity, pressure):
    # laplacian(u) = grad(p) at unit viscosity, both by differences of second order
    r = _away()
    residuals = {}
    for step in STEPS:
        neighbours = [velocity.matrix(r + s * step * e) for e in DELTA for s in (-1, 1)]
        laplacian = (sum(neighbours) - 6 * velocity.matrix(r)) / step**2
        gradient = _gradient(pressure, r, step)[:, 0].transpose(0, 2, 1)
        residuals[step] = laplacian - gradient
    _assert_second_order(residuals, np.zeros((len(r), 3, velocity.n_in)))


def test_stress_is_that_of_the_velocity_and_pressure_of_a_force():
    # sigma = -p I + grad u + (grad u)^T, all exact kernels, for the three unit forces
    r = _points()
    gradient = KERNELS["stokeslet_gradient"].matrix(r).reshape(-1, 3, 3, 3)
    pressure = np.einsum("nj,ik->nikj", stokeslet_pressure.matrix(r)[:, 0], DELTA)
    sigma = -pressure + gradient + gradient.transpose(0, 2, 1, 3)
    _close(KERNELS["stokes_stress"].matrix(r), _six(sigma, (1, 2)))


def test_traction_is_stress_times_normal():
    tensor, normals = np.random.default_rng(4).standard_normal((20, 3, 3)), _points(20)
    tensor = tensor + tensor.transpose(0, 2, 1)
    _close(traction(_six(tensor, (1, 2)), normals), np.einsum("nij,nj->ni", tensor, normals))


def _sphere(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the unit sphere and weights that integrate polynomials of degree < 2 order."""
    z, w = np.polynomial.legendre.leggauss(order)
    phi = 2 * np.pi * np.arange(2 * order) / (2 * order)
    s = np.sqrt(1 - z**2)
    points = np.stack(
        [np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones_like(phi))], -1
    )
    return points.reshape(-1, 3), np.repeat(w * np.pi / order, 2 * order)


@pytest.mark.parametrize(("radius", "expected"), [(0.2, -1.0), (0.4, -1.0), (2.5, 0.0), (5.0, 0.0)])
def test_double_layer_of_constant_density_on_a_sphere_jumps(radius, expected):
    # The integrand's expansion falls like min(radius, 1/radius)^degree: 0.4^80 is below rounding.
    points, area = _sphere(40)
    target = radius * np.array([1.0, 2.0, -2.0]) / 3
    density = np.array([0.3, -1.0, 0.7])
    weights = stresslet_weights(np.broadcast_to(density, points.shape), points) * area[:, None]
    u = np.einsum("nij,nj->i", stresslet.matrix(target - points), weights) / (8 * np.pi)
    np.testing.assert_allclose(u, expected * density, rtol=0, atol=1e-12)


def test_traction_of_a_force_balances_it():
    # Total traction over a closed sphere around a unit force: -8 pi of the common prefactor.
    points, area = _sphere(20)
    force = np.array([1.0, -2.0, 0.5])
    stress = KERNELS["stokes_stress"].matrix(points - [0.1, 0.0, -0.2]) @ force
    np.testing.assert_allclose(area @ traction(stress, points), -8 * np.pi * force, rtol=1e-11)


# --- what kernels are written with -------------------------------------------------------------


@numba.njit
def _inverse_distances(r2, out):
    for i in range(len(r2)):
        out[i] = inverse_distance(r2[i])


@numba.njit
def _decays(t, out):
    for i in range(len(t)):
        out[i] = decay(t[i])


@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_inverse_distance_is_exact_to_two_units(real):
    powers = np.random.default_rng(0).uniform(-36, 36, 100_000)
    r2 = (10.0**powers).astype(real)
    out = np.empty_like(r2)
    _inverse_distances(r2, out)
    exact = 1 / np.sqrt(r2.astype(np.longdouble))
    assert np.abs(out / exact - 1).max() < 2 * np.finfo(real).eps
    special = np.array([0.0, np.nan], real)
    _inverse_distances(special, out)
    assert out[0] == 0.0
    assert inverse_distance(0.0) == 0.0


@pytest.mark.parametrize(("real", "largest"), [(np.float64, 30.0), (np.float32, 30.0)])
def test_decay_is_the_exponential(real, largest):
    t = np.linspace(0.0, largest, 100_001).astype(real)
    out = np.empty_like(t)
    _decays(t, out)
    exact = np.exp(-t.astype(np.longdouble))
    # Four units of rounding, and the rounding of n log(2), n = t / log(2): half a unit each.
    bound = np.finfo(real).eps * (2 + 0.5 * t)
    assert np.all(np.abs(out / exact - 1) < bound)
    _decays(np.array([1e4, np.inf], real), out)
    np.testing.assert_array_equal(out[:2], 0.0)
    assert decay(1.0) == pytest.approx(np.exp(-1.0))


def test_special_values_pass_through():
    not_a_number = np.array([[np.nan, 0.0, 0.0]])
    for kernel in KERNELS.values():
        if kernel.name in ("gaussian", "exponential", "matern52", "softened"):
            assert np.isnan(kernel.matrix(not_a_number)).all()


# --- kernels of one's own ----------------------------------------------------------------------


@register_jitable
def _yukawa(x, y, z, w):
    r2 = x * x + y * y + z * z
    inverse = inverse_distance(r2)
    return (w[0] * inverse * decay(r2 * inverse),)


def test_kernel_of_ones_own():
    yukawa = Kernel("yukawa", _yukawa, 1, 1, parity=1, length=0.5, factor=3.0)
    r = _points()
    expected = 3 * np.exp(-2 * _norm(r)) / (2 * _norm(r))
    _close(yukawa.matrix(r), expected[:, None, None])
    assert (yukawa.n_unique, yukawa.inputs, yukawa.outputs) == (1, ((),), ((),))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"length": 0.0}, "length = 0.0: must be > 0"),
        ({"parity": 2}, "parity = 2"),
        ({"entry": ((0, 1),)}, "entry must have the shape"),
        ({"entry": ((1,),)}, "number the components from 0"),
        ({"inputs": ((), ())}, "as many tensor indices"),
    ],
)
def test_kernel_that_contradicts_itself_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Kernel("own", _yukawa, 1, 1, **changes)


def test_components_without_a_known_order_must_be_named():
    with pytest.raises(ValueError, match="4 components: name their tensor indices"):
        Kernel("own", _yukawa, 4, 1)


def test_constant_takes_the_precision_of_the_other():
    assert constant(3.0, np.float32(1.0)) == 3.0


PROGRAM = textwrap.dedent("""
    import numpy as np
    from own import kernel
    from stokes.fmm.near_field import NearField

    near = NearField(kernel)
    group, points = np.array([[0, 2]]), np.array([[0.0, 2.0], [0.0, 0.0], [0.0, 0.0]])
    out = np.zeros((1, 2))
    near.add(points, group, points, np.ones((1, 2)), np.array([0, 1]), group, out)
    print(out[0, 0], sum(near.loop.stats.cache_hits.values()))
""")

OWN = textwrap.dedent("""
    from numba.extending import register_jitable
    from stokes.fmm.kernels import Kernel, inverse_distance

    @register_jitable
    def apply(x, y, z, w):
        return (w[0] * {power} * inverse_distance(x * x + y * y + z * z),)

    kernel = Kernel("own", apply, 1, 1)
""")


def test_second_process_loads_the_loop_and_an_edited_kernel_is_compiled_anew(tmp_path):
    # The loops live in one cache: a file of this test's own name in it must not be met elsewhere.
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }

    def run(factor: str) -> list[float]:
        (tmp_path / "own.py").write_text(OWN.format(power=factor))
        done = subprocess.run(
            [sys.executable, "-B", "-c", PROGRAM],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return [float(word) for word in done.stdout.split()]

    assert run("2.0") == [1.0, 0]
    assert run("2.0") == [1.0, 1]
    assert run("6.0") == [3.0, 0]


@pytest.mark.parametrize(("function", "width"), [(stresslet_weights, 3), (traction, 6)])
def test_rows_of_other_shapes_are_refused_by_name(function, width):
    rows, normals = np.ones((4, width)), np.ones((4, 3))
    with pytest.raises(ValueError, match=rf"of shape \(4, 2\): must be \(n, {width}\)"):
        function(rows[:, :2], normals)
    with pytest.raises(ValueError, match=r"normals of shape \(3,\): must be \(n, 3\)"):
        function(rows, normals[0])
    with pytest.raises(ValueError, match="4 and 1 rows"):
        function(rows, normals[:1])


def test_the_kernels_of_the_package_cannot_be_replaced():
    with pytest.raises(TypeError):
        KERNELS["laplace"] = KERNELS["stokeslet"]
