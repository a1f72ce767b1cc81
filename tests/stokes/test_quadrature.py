import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ellipe, ellipkm1, eval_legendre

from stokes.geometry import (
    Meridian,
    Resolution,
    fourier_curve,
    resolution_for,
    sphere,
    spherocylinder,
    spheroid,
)
from stokes.log_rule_table import generate
from stokes.quadrature import (
    gauss_legendre,
    interpolation_matrix,
    log_rule,
    self_rule,
)

ROUND_OFF = np.finfo(float).eps


def ring_integral(m, r, r_source, dr, dz):
    """int_-pi^pi |x - x'|^-(2 m + 1) dt between two rings, from complete elliptic integrals."""
    d2 = dr**2 + dz**2
    s2 = d2 + 4 * r * r_source
    rho = d2 + 2 * r * r_source
    lower = 4 * ellipkm1(d2 / s2) / np.sqrt(s2)
    if m == 0:
        return lower
    upper = 4 * ellipe(1 - d2 / s2) / (np.sqrt(s2) * d2)
    for k in range(1, m):
        lower, upper = upper, (2 * k * rho * upper - (k - 0.5) * lower) / ((k + 0.5) * d2 * s2)
    return upper


def replaced(plain, meridian, rule, values):
    """Rows of an operator: the plain rule's, with the panels of `rule` taken from it."""
    nodes = meridian.resolution.nodes
    matrix = plain.reshape(len(plain), -1, nodes).copy()
    rows = np.add.reduceat(values[:, None] * rule.interpolation, rule.starts[:-1], axis=0)
    matrix[rule.pairs[:, 0], rule.pairs[:, 1]] = rows
    return matrix.reshape(plain.shape)


def single_layer(meridian):
    """Axisymmetric part of int f/|x - x'| dS at the nodes, as a matrix."""
    rule = self_rule(meridian)
    r, z, n = meridian.r, meridian.z, meridian.size
    i, j = np.nonzero(~np.eye(n, dtype=bool))
    plain = np.zeros((n, n))
    plain[i, j] = ring_integral(0, r[i], r[j], r[i] - r[j], z[i] - z[j])
    plain *= meridian.weights * r
    source = rule.points[:, 0]
    values = ring_integral(0, r[rule.target], source, *rule.difference.T) * rule.weights * source
    return replaced(plain, meridian, rule, values)


def test_log_rule_is_exact_for_polynomials_with_and_without_a_logarithm():
    x, w = log_rule()
    k = np.arange(32)
    powers = x ** k[:, None]
    np.testing.assert_allclose(powers @ w, 1 / (k + 1), rtol=0, atol=4 * ROUND_OFF)
    np.testing.assert_allclose(
        (powers * np.log(x)) @ w, -1 / (k + 1.0) ** 2, rtol=0, atol=4 * ROUND_OFF
    )
    assert w.min() > 0 and x.min() > 0 and x.max() < 1


def test_log_rules_are_found_by_their_program():
    nodes, weights = generate(5)
    x, w = np.array(nodes, float), np.array(weights, float)
    k = np.arange(5)
    np.testing.assert_allclose(x ** k[:, None] @ w, 1 / (k + 1), rtol=1e-14)
    np.testing.assert_allclose((x ** k[:, None] * np.log(x)) @ w, -1 / (k + 1.0) ** 2, rtol=1e-14)


def test_stored_log_rule_integrates_what_a_kernel_with_a_distant_singularity_asks():
    x, w = log_rule()
    # 1/(x + a) with Bernstein parameter 3 on [0, 1]: the reach its use in self_rule relies on.
    a = 0.5 * (0.5 * (3 + 1 / 3) - 1)

    def f(t):
        return np.log(t) / (t + a) + 1 / (t + a) ** 2

    expected = quad(lambda t: np.log(t) / (t + a), 0, 1, epsabs=1e-14, epsrel=1e-13)[0]
    expected += 1 / a - 1 / (1 + a)
    assert np.sum(w * f(x)) == pytest.approx(expected, rel=1e-14)


def test_interpolation_reproduces_polynomials_and_nodes():
    nodes = 16
    x = np.concatenate([np.linspace(0, 1, 37), gauss_legendre(nodes)[0]])
    matrix = interpolation_matrix(nodes, x)
    points, _ = gauss_legendre(nodes)
    for degree in range(nodes):
        value = eval_legendre(degree, 2 * points - 1)
        np.testing.assert_allclose(
            matrix @ value, eval_legendre(degree, 2 * x - 1), rtol=0, atol=1e-13
        )
    np.testing.assert_array_equal(matrix[-nodes:], np.eye(nodes))


def test_single_layer_of_legendre_functions_on_the_sphere():
    # int P_l(z')/|x - x'| dS' = 4 pi/(2 l + 1) P_l(z) on the unit sphere.
    meridian = Meridian(sphere(), Resolution.uniform(8, 16, 0))
    operator = single_layer(meridian)
    for degree in (0, 1, 4, 9):
        density = eval_legendre(degree, meridian.z)
        error = operator @ density - 4 * np.pi / (2 * degree + 1) * density
        # Sums of some hundred terms as large as their sum.
        assert np.abs(error).max() < 1e-13


def test_targets_at_panel_edges_and_poles():
    meridian = Meridian(sphere(), Resolution.uniform(8, 16, 0))
    s = np.array([0.0, 1e-9, 0.125, 0.5, 1.0])
    rule = self_rule(meridian, s)
    target = meridian.curve.evaluate(s)
    plain = np.zeros((len(s), meridian.size))
    for i in range(len(s)):
        dr, dz = meridian.curve.differences(s[i], meridian.s)
        plain[i] = ring_integral(0, target.r[i], meridian.r, dr, dz)
    plain *= meridian.weights * meridian.r
    source = rule.points[:, 0]
    values = ring_integral(0, target.r[rule.target], source, *rule.difference.T)
    operator = replaced(plain, meridian, rule, values * rule.weights * source)
    for degree in (0, 5):
        potential = operator @ eval_legendre(degree, meridian.z)
        expected = 4 * np.pi / (2 * degree + 1) * eval_legendre(degree, target.z)
        np.testing.assert_allclose(potential, expected, rtol=0, atol=1e-13)
    assert np.bincount(rule.target).max() < 600


def test_single_layer_converges_with_the_order_of_the_interpolated_density():
    degree, nodes = 24, 6

    def error(panels):
        meridian = Meridian(sphere(), Resolution.uniform(panels, nodes, 0))
        density = eval_legendre(degree, meridian.z)
        return np.abs(
            single_layer(meridian) @ density - 4 * np.pi / (2 * degree + 1) * density
        ).max()

    errors = np.array([error(n) for n in (8, 16, 32)])
    assert np.all(np.log2(errors[:-1] / errors[1:]) > nodes - 0.5)


@pytest.mark.parametrize("axes", [(0.5, 1.0), (1.0, 0.5), (0.05, 1.0), (1.0, 0.05)])
def test_equilibrium_charge_of_spheroids_gives_a_constant_potential(axes):
    a, c = axes
    curve = spheroid(a, c)
    resolution = resolution_for(curve, 1e-14)
    meridian = Meridian(curve, resolution)
    # The charge of an ellipsoid is as the distance h of its tangent planes from the centre:
    # int h/|x - x'| dS = 2 pi a^2 c int_0^inf dl/((a^2 + l) sqrt(c^2 + l)).
    charge = 1 / np.sqrt((meridian.r / a**2) ** 2 + (meridian.z / c**2) ** 2)
    if c > a:
        e = np.sqrt(1 - (a / c) ** 2)
        capacity = np.arctanh(e) / (c * e)
    else:
        e = np.sqrt(1 - (c / a) ** 2)
        capacity = np.arcsin(e) / (a * e)
    potential = single_layer(meridian) @ charge
    np.testing.assert_allclose(potential, 4 * np.pi * a * a * c * capacity, rtol=1e-13)


@pytest.mark.parametrize(
    "curve",
    [spheroid(0.05, 1.0), spherocylinder(0.1, 1.0), fourier_curve([1.0, 0.0, 0.3], [0.0, 1.2])],
    ids=["prolate", "rod", "bean"],
)
def test_self_rules_agree_with_adaptive_quadrature(curve):
    breaks = tuple(np.linspace(0, 1, 9))  # too coarse for the curve: only the kernel is tested
    meridian = Meridian(curve, Resolution(breaks, 16, 0))
    for s in (0.003, 0.125, 0.31, 0.99):
        rule = self_rule(meridian, [s])

        def integrand(t, s=s):
            if t == s:  # by rounding, where its weight vanishes
                return 0.0
            points, target = curve.evaluate(t), curve.evaluate(s)
            dr, dz = curve.differences(s, t)
            kernel = ring_integral(0, target.r, points.r, dr, dz)
            return float(kernel * points.r * points.speed)

        for pair in range(len(rule.pairs)):
            nodes = slice(rule.starts[pair], rule.starts[pair + 1])
            panel = rule.pairs[pair, 1]
            low, high = breaks[panel], breaks[panel + 1]
            points = rule.points[nodes]
            kernel = ring_integral(0, curve.evaluate(s).r, points[:, 0], *rule.difference[nodes].T)
            ours = np.sum(kernel * rule.weights[nodes] * points[:, 0])
            # t = s + b u^4 takes the logarithm's sharpness from quad.
            split = np.clip(s, low, high)
            expected = 0.0
            for end in (low, high):
                length = end - split
                if length != 0:
                    expected += abs(
                        quad(
                            lambda u, a=split, b=length: integrand(a + b * u**4) * 4 * b * u**3,
                            0,
                            1,
                            epsabs=1e-12,
                            epsrel=1e-12,
                            limit=200,
                        )[0]
                    )
            assert ours == pytest.approx(expected, rel=2e-12, abs=1e-13), (s, panel)
