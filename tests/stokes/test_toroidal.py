"""Toroidal sequences against decimal arithmetic, hypergeometric functions and quadrature."""

import numpy as np
import pytest
from scipy.integrate import quad

from stokes._toroidal import toroidal_table

from toroidal_twin import toroidal_twin

# chi - 1, from neighbours on a fine panel to points all but on the axis
DISTANCES = [1e-14, 1e-12, 1e-8, 1e-6, 1e-4, 5e-4, 1e-2, 0.1, 1.0, 3.0, 9.0, 100.0, 1e4]
# Values below this fraction of G^m_0 may be flushed to zero.
NEGLIGIBLE = 1e-240


def twin_table(d2, p, n_max, m_max):
    return np.array([[float(g) for g in row] for row in toroidal_twin(d2, p, n_max, m_max)])


def largest_error(values, reference):
    kept = reference > NEGLIGIBLE * reference[:, :1]
    assert np.all(np.abs(values[~kept]) <= NEGLIGIBLE * reference.max())
    return np.max(np.abs(values[kept] / reference[kept] - 1.0))


# By mpmath, 60 digits: 2 pi M^(-2m-1) (m+1/2)_n / n! beta^n 2F1(m+1/2, n+m+1/2; n+1; beta^2).
HYPERGEOMETRIC = [
    (0, 0, 1e-12, 1.0, 31.789904199286358216),
    (0, 7, 1e-08, 1.0, 14.759030851783716141),
    (1, 3, 1e-06, 0.5, 2828275.3874803489913),
    (2, 40, 0.001, 2.0, 795374.76106172038051),
    (3, 5, 0.02, 1.0, 125504.54756536947459),
    (0, 100, 0.1, 1.0, 9.2820900254067809063e-15),
    (1, 200, 0.5, 0.25, 5.0849035187680376818e-113),
    (2, 12, 4.0, 1.0, 1.9652173307194473703e-9),
    (3, 60, 18.0, 1.0, 1.6252276358358475589e-78),
    (0, 2, 20000.0, 1.0, 4.1641616663927346207e-11),
]


@pytest.mark.parametrize(("m", "n", "d2", "p", "expected"), HYPERGEOMETRIC)
def test_values_and_their_twin_are_hypergeometric_functions(m, n, d2, p, expected):
    assert float(toroidal_twin(d2, p, n, m)[m][n]) == pytest.approx(expected, rel=3e-16)
    assert toroidal_table([d2], [p], n, m)[0, m, n] == pytest.approx(expected, rel=5e-15)


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("n_max", [4, 33, 200])
def test_sequences_keep_their_digits_at_every_distance(distance, n_max):
    # p = 1: d2 / p has no rounding of its own; those of n steps add up at random
    d2 = 2.0 * distance
    values = toroidal_table([d2], [1.0], n_max, 3)[0]
    assert largest_error(values, twin_table(d2, 1.0, n_max, 3)) < 5e-15


@pytest.mark.parametrize("distance", DISTANCES)
def test_four_hundred_modes_are_as_good_as_their_condition_allows(distance):
    p = 1.3
    d2 = 2.0 * p * distance
    values = toroidal_table([d2], [p], 400, 3)[0]
    # one rounding of d2 / p is worth n (chi - 1) / sqrt(chi^2 - 1) <= 400 roundings of G_n
    assert largest_error(values, twin_table(d2, p, 400, 3)) < 400 * 2.2e-16


@pytest.mark.parametrize("n_max", [1, 2, 20, 100])
def test_both_directions_of_recurrence_agree_where_they_meet(n_max):
    # n_max xi = 1 is where the direction changes
    for factor in (0.999, 1.001):
        d2 = 4.0 * np.sinh(0.5 * factor / n_max) ** 2
        values = toroidal_table([d2], [1.0], n_max, 3)[0]
        # upward errors have grown by e^2 there
        assert largest_error(values, twin_table(d2, 1.0, n_max, 3)) < 2e-14


@pytest.mark.parametrize("distance", [0.01, 0.5, 5.0])
def test_sequences_are_integrals(distance):
    d2, p = 2.0 * distance, 1.0
    values = toroidal_table([d2], [p], 9, 3)[0]
    for m in range(4):
        for n in (0, 1, 4, 9):

            def integrand(t, m=m, n=n):
                return np.cos(n * t) * (d2 + 4.0 * p * np.sin(0.5 * t) ** 2) ** (-m - 0.5)

            size = values[m, 0]  # the integrand's, of which the quadrature has its roundings
            expected = 2.0 * quad(integrand, 0.0, np.pi, epsabs=1e-14 * size, epsrel=0.0)[0]
            assert values[m, n] == pytest.approx(expected, abs=1e-13 * size)


def test_points_on_the_axis_leave_the_mean_alone():
    d2 = np.array([0.3, 7.0])
    values = toroidal_table(d2, np.zeros(2), 30, 3)
    for m in range(4):
        assert values[:, m, 0] == pytest.approx(2.0 * np.pi * d2 ** (-m - 0.5), rel=1e-15)
    assert np.all(values[:, :, 1:] == 0.0)


@pytest.mark.parametrize("p", [1e-3, 1e-10, 1e-100, 1e-250, 5e-324])
def test_modes_fall_off_towards_the_axis_by_their_leading_power(p):
    # G^m_n -> 2 pi (m+1/2)_n / n! p^n d^(-2m-1-2n) as p -> 0
    values = toroidal_table([1.0], [p], 3, 3)[0]
    for m in range(4):
        coefficient = 2.0 * np.pi
        for n in range(4):
            expected = coefficient * p**n
            if expected > NEGLIGIBLE:
                assert values[m, n] == pytest.approx(expected, rel=50.0 * p + 2e-15)
            coefficient *= (m + 0.5 + n) / (n + 1.0)


@pytest.mark.parametrize("distance", DISTANCES)
def test_sequences_are_positive_and_scale_with_length_to_the_last_bit(distance):
    d2, p = 2.0 * distance, 1.0
    squares = np.array([1.0, 4.0, 2.0**-10, 2.0**-80])  # next to a pole lengths may be tiny
    values = toroidal_table(d2 * squares, p * squares, 40, 3)
    assert np.all(values > 0.0)
    powers = 2.0 * np.arange(4)[:, None] + 1.0
    assert np.array_equal(values[1], values[0] * 2.0**-powers)
    assert np.array_equal(values[2], values[0] * 32.0**powers)
    assert np.array_equal(values[3], values[0] * 2.0 ** (40.0 * powers))


@pytest.mark.parametrize("distance", DISTANCES)
def test_asking_for_fewer_modes_and_orders_gives_the_same_values(distance):
    d2, p = 2.0 * distance, 1.0
    all_modes = toroidal_table([d2], [p], 120, 3)[0]
    for n_max, m_max in ((0, 0), (0, 3), (1, 1), (7, 2), (40, 3)):
        few = toroidal_table([d2], [p], n_max, m_max)[0]
        assert few == pytest.approx(all_modes[: m_max + 1, : n_max + 1], rel=1e-14, abs=0.0)


@pytest.mark.parametrize(
    ("d2", "p", "n_max", "m_max"),
    [
        ([0.0], [1.0], 3, 1),
        ([-1.0], [1.0], 3, 1),
        ([1.0], [-1.0], 3, 1),
        ([1.0, 2.0], [1.0], 3, 1),
        ([1.0], [1.0], -1, 1),
        ([1.0], [1.0], 3, 4),
        ([np.nan], [1.0], 3, 1),
    ],
)
def test_what_has_no_modes_is_refused(d2, p, n_max, m_max):
    with pytest.raises(ValueError):
        toroidal_table(d2, p, n_max, m_max)
