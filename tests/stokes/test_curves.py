import numpy as np
import pytest
from scipy.integrate import quad

from stokes.curves import (
    fourier_curve,
    resolved_breaks,
    sphere,
    spherocylinder,
    spheroid,
    spline_curve,
)

ROUND_OFF = np.finfo(float).eps


def bean():
    """A body with a dent around its waist, off the origin."""
    return fourier_curve([1.0, 0.0, 0.3], [0.1, 1.2, 0.05])


def egg():
    angles = np.linspace(0, np.pi, 21)
    return spline_curve(np.sin(angles) * (1 + 0.2 * np.cos(angles)), 1.5 * np.cos(angles))


CURVES = {
    "sphere": sphere(),
    "prolate": spheroid(0.05, 1.0),
    "oblate": spheroid(1.0, 0.05),
    "rod": spherocylinder(0.2, 1.0),
    "short rod": spherocylinder(1.0, 0.5, 0.4),
    "bean": bean(),
    "egg": egg(),
}
every_curve = pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES.keys())


def parameters(curve, count=300):
    """Draw parameters of a curve, none within 1e-4 of a break."""
    s = np.random.default_rng(5).uniform(1e-3, 1 - 1e-3, count)
    knots = np.array(curve.breaks)
    return s[np.abs(s[:, None] - knots).min(axis=1) > 1e-4]


def length_scale(curve):
    points = curve.evaluate(np.linspace(0, 1, 101))
    return np.hypot(points.r, points.z).max()


@every_curve
def test_derivatives_are_those_of_the_curve(curve):
    s, h = parameters(curve), 2e-5
    points, right, left = curve.evaluate(s), curve.evaluate(s + h), curve.evaluate(s - h)
    for value, slope in (("r", "dr"), ("z", "dz"), ("dr", "d2r"), ("dz", "d2z")):
        centred = (getattr(right, value) - getattr(left, value)) / (2 * h)
        # h^2/6 f''' with features of size 1e-2 and more in s, and rounding eps/h.
        scale = np.abs(centred).max() + np.abs(getattr(points, value)).max()
        np.testing.assert_allclose(getattr(points, slope), centred, rtol=0, atol=1e-6 * scale)


@every_curve
def test_curve_meets_the_axis_at_right_angles_and_stays_off_it_between(curve):
    ends = curve.evaluate(np.array([0.0, 1.0]))
    size = length_scale(curve)
    assert np.abs(ends.r).max() < 10 * ROUND_OFF * size
    assert np.abs(ends.dz).max() < 1e-12 * np.abs(ends.dr).min()
    assert ends.normal_z[0] == pytest.approx(1, abs=1e-15)
    assert ends.normal_z[1] == pytest.approx(-1, abs=1e-15)
    assert curve.evaluate(parameters(curve)).r.min() > 0


@every_curve
@pytest.mark.parametrize("step", [1e-1, 1e-3, 1e-6, 1e-9])
def test_differences_of_close_points_keep_their_digits(curve, step):
    s = parameters(curve)
    t = np.clip(s + step * np.random.default_rng(6).choice([-1.0, 1.0], len(s)), 0, 1)
    middle = 0.5 * (s + t)
    whole = np.array(curve.differences(s, t))
    halves = np.array(curve.differences(s, middle)) + np.array(curve.differences(middle, t))
    # Differences of differences see no cancellation if each is right by itself. The parameters'
    # own rounding moves the middle, which both halves share.
    error = np.hypot(*(whole - halves)) / np.hypot(*whole)
    # Beyond `reach` plain subtraction loses size/distance.
    assert error.max() < 100 * ROUND_OFF * max(1, length_scale(curve) / np.hypot(*whole).min() * (
        step > curve.reach))  # fmt: skip
    points, others = curve.evaluate(s), curve.evaluate(t)
    plain = np.array([points.r - others.r, points.z - others.z])
    np.testing.assert_allclose(whole, plain, rtol=0, atol=20 * ROUND_OFF * length_scale(curve))


@every_curve
def test_normal_offsets_are_half_the_curvature_times_the_squared_distance(curve):
    s = parameters(curve)
    points = curve.evaluate(s)
    bend = points.meridional_curvature
    scale = np.abs(bend).max()
    errors = []
    # The next term is of third order: relative to kappa d^2/2 the error falls with the distance.
    for step in (1e-5, 1e-7, 1e-9):
        dr, dz = curve.differences(s, s + step)
        at_s, at_t = curve.normal_offsets(s, s + step)
        squared = 0.5 * (dr**2 + dz**2)
        errors.append(np.abs(at_s / squared - bend).max() / scale)
        assert (
            np.abs(at_t / squared + bend).max() / scale < 3 * errors[-1] + 1e-12
        )  # 2/3 against 1/3
    # A knot of a spline may lie between: the curvature there is continuous.
    assert errors[1] < 0.02 * errors[0] + 1e-12
    assert errors[2] < 0.02 * errors[1] + 1e-12


@every_curve
def test_normal_offsets_are_the_projected_differences(curve):
    rng = np.random.default_rng(7)
    s, t = rng.uniform(0, 1, (2, 400))
    dr, dz = curve.differences(s, t)
    here, there = curve.evaluate(s), curve.evaluate(t)
    at_s, at_t = curve.normal_offsets(s, t)
    size = length_scale(curve)
    for offsets, ends in ((at_s, here), (at_t, there)):
        plain = ends.normal_r * dr + ends.normal_z * dz
        np.testing.assert_allclose(offsets, plain, rtol=0, atol=50 * ROUND_OFF * size)


@every_curve
def test_scalars_and_arrays_of_parameters_give_the_same(curve):
    s, t = np.array([[0.3, 0.5], [0.7, 0.9]]), np.array([[0.3 + 1e-4, 0.2], [0.7, 0.9 - 1e-4]])
    for function in (curve.differences, curve.normal_offsets):
        whole = function(s, t)
        assert whole[0].shape == (2, 2)
        for index in np.ndindex(2, 2):
            one = function(s[index], t[index])
            np.testing.assert_allclose(one, [part[index] for part in whole], rtol=1e-12)
    np.testing.assert_allclose(curve.evaluate(0.3).z, curve.evaluate(s).z[0, 0], rtol=1e-14)


def test_curvatures_of_spheroids_are_those_of_the_ellipsoid():
    a, c = 0.3, 1.7
    points = spheroid(a, c).evaluate(np.linspace(0, 1, 41))
    # h = support function; k1 = h^3/(a^2 c^2), k2 = h/a^2
    h = 1 / np.sqrt((points.r / a**2) ** 2 + (points.z / c**2) ** 2)
    np.testing.assert_allclose(points.meridional_curvature, h**3 / (a * c) ** 2, rtol=1e-13)
    np.testing.assert_allclose(points.azimuthal_curvature, h / a**2, rtol=1e-13)


def test_rod_has_its_radius_and_length_and_lies_in_the_sharp_rod():
    radius, half_length = 0.4, 1.3
    curve = spherocylinder(radius, half_length)
    s = np.linspace(0, 1, 2001)
    points = curve.evaluate(s)
    assert points.r.max() == pytest.approx(radius, rel=1e-12)
    assert points.z[0] == pytest.approx(half_length + radius, rel=1e-12)
    np.testing.assert_allclose(points.speed, points.speed[0], rtol=1e-13)  # arc length
    beyond = np.maximum(np.abs(points.z) - half_length, 0)
    outside = np.hypot(points.r, beyond) - radius
    assert outside.max() < 1e-12
    assert outside.min() > -0.01 * radius  # at the default smoothing


def test_smoothed_rod_tends_to_the_sharp_rod_with_the_square_of_the_smoothing():
    radius, half_length = 1.0, 2.0
    sharp = np.pi * radius**2 * (2 * half_length + 4 / 3 * radius)

    def volume(smoothing):
        curve = spherocylinder(radius, half_length, smoothing)

        def ring(s):
            points = curve.evaluate(s)
            return float(-np.pi * points.r**2 * points.dz)

        return 2 * quad(ring, 0, 0.5, epsabs=1e-10, limit=200)[0]

    errors = np.array([sharp - volume(w) for w in (0.4, 0.2, 0.1)])
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 2, atol=0.1)


def test_spline_through_an_ellipse_is_of_sixth_order():
    def error(count):
        angles = np.linspace(0, np.pi, count)
        curve = spline_curve(0.7 * np.sin(angles), 1.3 * np.cos(angles))
        points = curve.evaluate(np.linspace(0, 1, 500))
        return np.abs(np.hypot(points.r / 0.7, points.z / 1.3) - 1).max()

    errors = np.array([error(n) for n in (17, 33, 65)])
    assert np.all(np.log2(errors[:-1] / errors[1:]) > 5.5)


@every_curve
def test_chebyshev_pieces_reproduce_the_curve(curve):
    edges, series = curve.polynomials
    s = parameters(curve)
    points = curve.evaluate(s)
    k = np.searchsorted(edges, s) - 1
    x = (2 * s - edges[k] - edges[k + 1]) / (edges[k + 1] - edges[k])
    value = [
        np.polynomial.chebyshev.chebval(x_i, series[k_i, 0].T)
        for x_i, k_i in zip(x, k, strict=True)
    ]
    np.testing.assert_allclose(
        value, np.column_stack([points.r, points.z]), rtol=0, atol=2e-14 * length_scale(curve)
    )


def test_panels_are_halved_towards_what_they_must_resolve():
    # |gamma'| of a prolate spheroid is singular at the distance a/(pi c) from the poles.
    curve = spheroid(0.05, 1.0)
    edges = resolved_breaks(curve, lambda points: points.speed[None], 16, 1e-10)
    lengths = np.diff(edges)
    assert lengths[0] == lengths[-1] < 0.05
    assert lengths.max() > 4 * lengths[0]
    assert edges[0] == 0 and edges[-1] == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: spheroid(1.0, -1.0), "must be > 0"),
        (lambda: spherocylinder(1.0, 0.0), "half_length"),
        (lambda: spherocylinder(1.0, 1.0, 0.6), "smoothing"),
        (lambda: fourier_curve([1.0], [0.0, -1.0]), "north pole"),
        (lambda: fourier_curve([0.2, 1.0], [0.0, 1.0]), "off the axis"),
        (lambda: fourier_curve([1.0, 0.0, 0.9], [0.0, 1.0, 0.0, 2.5]), "crosses itself"),
        (lambda: spline_curve([0, 1, 1, 0], [1, 0.5, -0.5, -1]), "n >= 6"),
        (lambda: spline_curve([0.1, 1, 1, 1, 1, 0], [3, 2, 1, 0, -1, -2]), "on the axis"),
    ],
)
def test_curves_that_bound_no_body_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_curves_compare_by_their_parameters():
    assert spheroid(1, 1) == sphere()
    assert hash(spherocylinder(1, 2)) == hash(spherocylinder(1.0, 2.0))
    assert spheroid(1, 2) != fourier_curve([1], [0, 2.1])
    assert len({sphere(), spheroid(1, 1), bean(), bean()}) == 2
