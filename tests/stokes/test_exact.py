"""The closed forms and series that other results are measured against, and one against another."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stokes import exact

DIGITS = 1e-12
"""Relative; the published values carry 13 or 14 digits."""

ROUNDING = 1e-13
"""Relative; sums and products of some hundred terms of 1.1e-16."""

DIFFERENCE = 1e-7
"""Central differences: h^2 = 1e-8 times third derivatives of order 10, in h = 1e-4."""


def _derivative(field, x: np.ndarray, h: float = 1e-4) -> np.ndarray:
    """d field_... / dx_j, the derivative's index last."""
    steps = h * np.eye(3)
    return np.stack([(field(x + s) - field(x - s)) / (2.0 * h) for s in steps], axis=-1)


def _sphere_rule(order: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and areas (n,) on the unit sphere, exact to degree 2 order - 1."""
    z, w = np.polynomial.legendre.leggauss(order)
    angle = 2.0 * math.pi * np.arange(2 * order) / (2 * order)
    ring = np.sqrt(1.0 - z**2)[:, None]
    points = np.stack(
        np.broadcast_arrays(ring * np.cos(angle), ring * np.sin(angle), z[:, None]), axis=-1
    )
    return points.reshape(-1, 3), np.repeat(w * math.pi / order, 2 * order)


def _ellipsoid_rule(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and areas on an ellipsoid: the sphere's, stretched."""
    unit, areas = _sphere_rule(40)
    stretched = unit / axes
    length = np.linalg.norm(stretched, axis=1)
    return unit * axes, stretched / length[:, None], areas * np.prod(axes) * length


# ---- ellipsoids ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("equatorial", "polar", "expected"),
    [
        (0.5, 1.0, (11.346876506623, 12.995817441783, 5.0684991847975, 9.4557304221856)),
        (1.0, 5.0, (33.642851863764, 44.691666674202, 88.728727726774, 583.14276563858)),
        (1.0, 0.5, (17.064602152727, 14.942182986904, 17.719089290026, 14.220501793939)),
    ],
)
def test_spheroid_has_the_known_resistances(equatorial, polar, expected):
    found = exact.spheroid_resistance(equatorial, polar)
    values = (
        found.translation_axial,
        found.translation_transverse,
        found.rotation_axial,
        found.rotation_transverse,
    )
    assert values == pytest.approx(expected, rel=DIGITS)


def test_sphere_is_a_spheroid_without_loss_of_digits():
    """Resistances are analytic in the aspect: 1 + 1e-9 changes them by 1e-9 times 1/5 to 9/5."""
    sphere = exact.spheroid_resistance(1.0, 1.0)
    assert sphere.translation_axial == pytest.approx(6.0 * math.pi, rel=2e-16)
    assert sphere.rotation_transverse == pytest.approx(8.0 * math.pi, rel=2e-16)
    # d ln F / d ln polar of a nearly spherical spheroid: 1/5 along, 2/5 across.
    near = exact.spheroid_resistance(1.0, 1.0 + 1e-9)
    assert near.translation_axial / (6.0 * math.pi) - 1.0 == pytest.approx(0.2e-9, abs=1e-15)
    assert near.translation_transverse / (6.0 * math.pi) - 1.0 == pytest.approx(0.4e-9, abs=1e-15)


@pytest.mark.parametrize("aspect", [0.05, 0.3, 3.0, 20.0])
def test_spheroid_agrees_with_its_formula_in_elementary_functions(aspect):
    """F = 16 pi / (chi + alpha c^2), chi and alpha in arc functions: S. Kim and S. Karrila."""
    if aspect > 1.0:
        e = math.sqrt(1.0 - aspect**-2)
        log = math.log((1.0 + e) / (1.0 - e))
        factor = 8.0 / 3.0 * e**3 / (-2.0 * e + (1.0 + e**2) * log)
        expected = 6.0 * math.pi * aspect * factor
    else:
        e = math.sqrt(1.0 - aspect**2)
        cot = math.atan(math.sqrt(1.0 - e**2) / e)
        factor = 4.0 / 3.0 * e**3 / ((2.0 * e**2 - 1.0) * (math.pi / 2 - cot) + e * aspect)
        expected = 6.0 * math.pi * factor
    # The elementary formula loses 1/e^3 or 1/(1 - e) roundings itself.
    found = exact.spheroid_resistance(1.0, aspect).translation_axial
    assert found == pytest.approx(expected, rel=1e-11)


def test_flat_disc_has_the_resistances_of_a_disc():
    """16, 32/3 and twice 32/3 for a disc of radius 1, met to O(thickness)."""
    disc = exact.spheroid_resistance(1.0, 1e-9)
    assert disc.translation_axial == pytest.approx(16.0, rel=1e-8)
    assert disc.translation_transverse == pytest.approx(32.0 / 3.0, rel=1e-8)
    assert disc.rotation_axial == pytest.approx(32.0 / 3.0, rel=1e-8)
    assert disc.rotation_transverse == pytest.approx(32.0 / 3.0, rel=1e-8)


def test_resistances_do_not_depend_on_the_order_of_axes():
    axes = np.array([0.7, 1.1, 2.3])
    whole = exact.ellipsoid_resistance(axes, viscosity=2.5)
    turned = exact.ellipsoid_resistance(np.roll(axes, 1), viscosity=2.5)
    assert np.roll(whole.translation, 1) == pytest.approx(turned.translation, rel=ROUNDING)
    assert np.roll(whole.rotation, 1) == pytest.approx(turned.rotation, rel=ROUNDING)


def test_ellipsoid_traction_gives_force_and_no_torque():
    axes, velocity = np.array([0.8, 1.0, 1.3]), np.array([0.3, -1.0, 0.5])
    points, normals, areas = _ellipsoid_rule(axes)
    traction = exact.ellipsoid_traction(points, normals, axes, velocity, viscosity=2.0)
    force = areas @ traction
    expected = -exact.ellipsoid_resistance(axes, 2.0).translation * velocity
    # The rule on the stretched sphere is spectral; 40 rings leave 1e-13 at these axes.
    assert force == pytest.approx(expected, rel=1e-11)
    assert areas @ np.cross(points, traction) == pytest.approx(np.zeros(3), abs=1e-11)


def test_minus_the_traction_of_an_ellipsoid_drives_the_flow_of_its_motion():
    """Far away it is that of a point force; at 30 radii the next term is 1e-3 of it."""
    axes, velocity = np.array([0.8, 1.0, 1.3]), np.array([0.3, -1.0, 0.5])
    points, normals, areas = _ellipsoid_rule(axes)
    traction = exact.ellipsoid_traction(points, normals, axes, velocity)
    inside = np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0], [-0.3, 0.1, -0.5]])
    u = exact.stokeslet_velocity(inside, points, -areas[:, None] * traction)
    # A rigid motion inside, to the rule's error at half a radius from the surface.
    assert u == pytest.approx(np.broadcast_to(velocity, (3, 3)), abs=1e-7)


@pytest.mark.parametrize("axes", [(1.0, 1.0), (1.0, 1.0, 0.0), (1.0, 1.0, math.nan)])
def test_ellipsoid_without_three_positive_axes_is_refused(axes):
    with pytest.raises(ValueError, match="semi-axes"):
        exact.ellipsoid_resistance(axes)


# ---- slip ----------------------------------------------------------------------------------


def test_squirmer_moves_with_two_thirds_of_its_first_mode():
    points, areas = _sphere_rule()
    azimuthal = np.array([[0.0, 0.0, 1.0]]) - points[:, 2:] * points  # -sin(theta) e_theta
    slip = -(1.5 + 4.0 * points[:, 2:]) * azimuthal
    velocity = exact.slip_velocity(points, points, areas, slip)
    expected = np.array([0.0, 0.0, exact.squirmer_velocity(1.5)])
    assert velocity == pytest.approx(expected, abs=ROUNDING)


def test_slip_of_a_rigid_translation_is_undone():
    points, normals, areas = _ellipsoid_rule(np.array([0.5, 0.5, 1.0]))
    slip = np.broadcast_to([0.2, -0.4, 1.0], points.shape)
    assert exact.slip_velocity(points, normals, areas, slip) == pytest.approx(-slip[0], rel=1e-14)


# ---- spheroids in a linear flow ------------------------------------------------------------


@pytest.mark.parametrize("aspect", [0.2, 1.0, 4.0])
def test_spheroid_in_shear_turns_with_the_period_of_jeffery(aspect):
    """u = rate y e_x; the axis is back after a period, time steps to 1e-10."""
    rate = 0.7
    gradient = np.zeros((3, 3))
    gradient[0, 1] = rate
    start = np.array([0.48, 0.6, 0.64])

    def turn(_, p):
        return np.cross(exact.jeffery_angular_velocity(aspect, p, gradient), p)

    period = exact.jeffery_period(aspect, rate)
    path = solve_ivp(turn, (0.0, period), start, rtol=1e-12, atol=1e-13)
    assert path.y[:, -1] == pytest.approx(start, abs=1e-9)
    # and at half of it, opposite in the plane of the shear
    half = solve_ivp(turn, (0.0, period / 2.0), start, rtol=1e-12, atol=1e-13).y[:, -1]
    assert half == pytest.approx(start * [-1.0, -1.0, 1.0], abs=1e-9)


def test_sphere_turns_with_half_the_vorticity_and_a_needle_with_the_strain():
    gradient = np.array([[0.1, 0.7, -0.2], [0.3, -0.4, 0.9], [0.5, 0.0, 0.3]])
    axis = np.array([0.48, 0.6, 0.64])
    curl = np.array([0.0 - 0.9, -0.2 - 0.5, 0.3 - 0.7])
    omega = exact.jeffery_angular_velocity(1.0, axis, gradient)
    assert omega == pytest.approx(curl / 2.0, rel=1e-15)
    # A needle, p, moves with the flow: dp/dt = G p - p (p.G p).
    omega = exact.jeffery_angular_velocity(1e9, axis, gradient)
    carried = gradient @ axis - axis * (axis @ gradient @ axis)
    assert np.cross(omega, axis) == pytest.approx(carried, abs=1e-15)


# ---- point forces --------------------------------------------------------------------------

SOURCES = np.array([[0.1, 0.2, -0.3], [-0.4, 0.0, 0.2]])
FORCES = np.array([[1.0, -2.0, 0.5], [0.3, 0.7, -1.1]])
PLACE = np.array([0.9, -0.8, 0.7])


def test_flow_of_point_forces_obeys_the_stokes_equations():
    viscosity = 1.7

    def velocity(x):
        return exact.stokeslet_velocity(x, SOURCES, FORCES, viscosity)

    def pressure(x):
        return exact.stokeslet_pressure(x, SOURCES, FORCES)

    def stress(x):
        return exact.stokeslet_stress(x, SOURCES, FORCES)

    gradient = _derivative(velocity, PLACE)
    assert np.trace(gradient) == pytest.approx(0.0, abs=DIFFERENCE)
    newtonian = -pressure(PLACE) * np.eye(3) + viscosity * (gradient + gradient.T)
    assert stress(PLACE) == pytest.approx(newtonian, abs=DIFFERENCE)
    assert np.einsum("ijj->i", _derivative(stress, PLACE)) == pytest.approx(0.0, abs=DIFFERENCE)


def test_stress_of_point_forces_carries_them_through_a_surface():
    normals, areas = _sphere_rule(40)
    stress = exact.stokeslet_stress(1.5 * normals, SOURCES, FORCES)
    force = np.einsum("n,nij,nj->i", areas * 1.5**2, stress, normals)
    assert force == pytest.approx(-FORCES.sum(axis=0), rel=ROUNDING)


def test_points_may_have_any_shape():
    x = PLACE + np.zeros((4, 5, 1))
    u = exact.stokeslet_velocity(x, SOURCES, FORCES)
    assert u.shape == (4, 5, 3)
    assert u[2, 3] == pytest.approx(exact.stokeslet_velocity(PLACE, SOURCES, FORCES), rel=1e-15)


# ---- one sphere ----------------------------------------------------------------------------

VELOCITY, SPIN = np.array([0.3, -0.7, 1.1]), np.array([0.2, 0.9, -0.4])


def test_flow_around_a_sphere_sticks_to_it_and_obeys_the_stokes_equations():
    radius, viscosity = 0.6, 1.7
    normals = _sphere_rule(6)[0]

    def velocity(x):
        return exact.sphere_velocity(x, radius, VELOCITY, SPIN)

    rigid = VELOCITY + np.cross(SPIN, radius * normals)
    assert velocity(radius * normals) == pytest.approx(rigid, abs=ROUNDING)

    def stress(x):
        gradient = _derivative(velocity, x, 1e-3)
        pressure = exact.sphere_pressure(x, radius, VELOCITY, viscosity)
        return -pressure * np.eye(3) + viscosity * (gradient + gradient.T)

    assert np.trace(_derivative(velocity, PLACE)) == pytest.approx(0.0, abs=DIFFERENCE)
    # Differences of differences, h = 1e-3: 1e-6 times fifth derivatives.
    assert np.einsum("ijj->i", _derivative(stress, PLACE, 1e-3)) == pytest.approx(0.0, abs=2e-5)


@pytest.mark.parametrize(
    ("force", "drag", "torque"),
    [
        ((0.0, 0.0, 1.0), (0.0, 0.0, 13.0 / 27.0), (0.0, 0.0, 0.0)),
        ((1.0, 0.0, 0.0), (7.0 / 27.0, 0.0, 0.0), (0.0, 1.0 / 9.0, 0.0)),
    ],
)
def test_point_force_at_three_radii_acts_on_a_fixed_sphere_as_faxen_says(force, drag, torque):
    """The torque is that of a force which passes the centre: about +y for one along x at +z."""
    loads = exact.point_force_near_sphere((0.0, 0.0, 3.0), force, 1.0)
    assert loads.force == pytest.approx(drag, rel=DIGITS)
    assert np.abs(loads.torque) == pytest.approx(torque, rel=DIGITS)
    assert np.sign(loads.torque[1]) * force[0] >= 0.0


def test_faxen_loads_are_those_of_the_unperturbed_flow_and_its_derivatives():
    """Means over spheres give the Laplacians: <u> over radius a = (1 + a^2/6 Lap) u exactly."""
    position, force, radius = np.array([0.5, -1.2, 1.4]), np.array([0.7, 0.2, -1.0]), 0.8
    loads = exact.point_force_near_sphere(position, force, radius)
    normals, areas = _sphere_rule(60)
    flow = exact.stokeslet_velocity(radius * normals, position, force)
    mean = areas @ flow / (4.0 * math.pi)
    assert loads.force == pytest.approx(6.0 * math.pi * radius * mean, rel=ROUNDING)
    spin = np.einsum("n,ni->i", areas, np.cross(normals, flow)) * 3.0 / (8.0 * math.pi * radius)
    assert loads.torque == pytest.approx(8.0 * math.pi * radius**3 * spin, rel=ROUNDING)
    # <n u + u n> / 2 = a/3 (1 + a^2/10 Lap) E
    outer = np.einsum("n,ni,nj->ij", areas, normals, flow) / (4.0 * math.pi)
    strain = 1.5 / radius * (outer + outer.T)
    assert loads.stresslet == pytest.approx(
        20.0 / 3.0 * math.pi * radius**3 * strain, rel=ROUNDING, abs=ROUNDING
    )


def test_point_force_inside_the_sphere_is_refused():
    with pytest.raises(ValueError, match="outside"):
        exact.point_force_near_sphere((0.1, 0.0, 0.0), (1.0, 0.0, 0.0), 1.0)


# ---- two spheres ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "same", "opposite"),
    [
        (4.0, 0.74225828506909, 1.596681999496),
        (3.0, 0.69830456025004, 2.0386546439229),
        (2.5, 0.67291551376517, 2.7724186795591),
    ],
)
def test_equal_spheres_along_their_line_have_the_known_drag(distance, same, opposite):
    assert exact.stimson_jeffery(distance - 2.0) == pytest.approx((same, opposite), rel=DIGITS)


@pytest.mark.parametrize("gap", [10.0, 1.0, 0.1, 1e-2, 1e-3, 1e-4])
def test_matrix_of_two_spheres_holds_the_series_of_equal_ones(gap):
    R = exact.two_spheres_axial(1.0, 1.0, gap) / (6.0 * math.pi)
    same, opposite = exact.stimson_jeffery(gap)
    assert R[0, 0] - R[0, 1] == pytest.approx(opposite, rel=ROUNDING)
    # The entries, of size 1/(4 gap), cancel.
    assert R[0, 0] + R[0, 1] == pytest.approx(same, rel=ROUNDING * (1.0 + 1.0 / gap))


PAIRS = [(1.0, 1.0, 0.3), (1.0, 3.0, 0.01), (0.2, 1.0, 1e-3), (1.0, 100.0, 0.1), (2.0, 1.0, 5.0)]


@pytest.mark.parametrize("matrix", [exact.two_spheres_axial, exact.two_spheres_spinning])
@pytest.mark.parametrize("pair", PAIRS)
def test_resistance_of_two_spheres_is_symmetric_positive_and_knows_no_order(matrix, pair):
    radius_1, radius_2, gap = pair
    R = matrix(radius_1, radius_2, gap)
    assert R[0, 1] == pytest.approx(R[1, 0], rel=1e-12)
    assert np.linalg.eigvalsh(R).min() > 0.0
    assert matrix(radius_2, radius_1, gap)[::-1, ::-1] == pytest.approx(R, rel=1e-12)
    assert (
        matrix(3 * radius_1, 3 * radius_2, 3 * gap)
        == pytest.approx(R * (3 if matrix is exact.two_spheres_axial else 27), rel=1e-12)
    )  # fmt: skip


def test_distant_spheres_move_like_single_ones():
    """R_12 = -6 pi a_1 a_2 3/(2 d) + O(d^-2), the first reflection."""
    distance = 1e4
    R = exact.two_spheres_axial(1.0, 2.0, distance - 3.0)
    assert R[0, 0] == pytest.approx(6.0 * math.pi, rel=1e-7)
    assert R[1, 1] == pytest.approx(12.0 * math.pi, rel=1e-7)
    assert R[0, 1] == pytest.approx(-12.0 * math.pi * 1.5 / distance, rel=1e-7)
    T = exact.two_spheres_spinning(1.0, 2.0, distance - 3.0)
    assert np.diag(T) == pytest.approx([8.0 * math.pi, 64.0 * math.pi], rel=1e-11)


@pytest.mark.parametrize("ratio", [1.0, 0.25, 5.0])
def test_squeezed_film_resists_as_lubrication_theory_says(ratio):
    """R_11 / 6 pi a_1 = g_1/xi + g_2 ln(1/xi) + const + O(xi ln xi), xi = 2 gap / (a_1 + a_2).

    g_1 = 2 b^2 / (1+b)^3, g_2 = b (1 + 7b + b^2) / (5 (1+b)^3): D. Jeffrey and Y. Onishi, 1984.
    """
    b = ratio
    g_1, g_2 = 2.0 * b**2 / (1 + b) ** 3, b * (1 + 7 * b + b**2) / (5 * (1 + b) ** 3)

    def remainder(xi):
        R = exact.two_spheres_axial(1.0, b, xi * (1.0 + b) / 2.0)
        return R[0, 0] / (6.0 * math.pi) - g_1 / xi - g_2 * math.log(1.0 / xi)

    change = abs(remainder(1e-4) - remainder(1e-5))
    assert change < 10.0 * 1e-4 * math.log(1e4)


def test_touching_spheres_have_the_known_limits():
    """Drag 0.6451 together; torques 3/4 zeta(3), zeta(3): met to O(gap ln gap)."""
    gap, zeta = 1e-5, 1.2020569031595943
    assert exact.stimson_jeffery(gap)[0] == pytest.approx(0.645141, abs=2e-5)
    T = exact.two_spheres_spinning(1.0, 1.0, gap) / (8.0 * math.pi)
    assert T[0].sum() == pytest.approx(0.75 * zeta, abs=20 * gap)
    assert T[0, 0] - T[0, 1] == pytest.approx(zeta, abs=20 * gap)


def test_spinning_spheres_have_the_known_torque():
    T = exact.two_spheres_spinning(1.0, 1.0, 1.0) / (8.0 * math.pi)
    assert T[0].sum() == pytest.approx(0.9648138015612, rel=DIGITS)
    assert T[0, 0] - T[0, 1] == pytest.approx(1.0391045069174, rel=DIGITS)


@pytest.mark.parametrize("matrix", [exact.two_spheres_axial, exact.two_spheres_spinning])
@pytest.mark.parametrize("pair", [(1.0, 1.0, 0.0), (0.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
def test_spheres_that_touch_are_refused(matrix, pair):
    with pytest.raises(ValueError, match="must be positive"):
        matrix(*pair)
