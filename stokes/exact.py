"""Exact solutions of Stokes flow around rigid bodies: what numerical ones are measured against.

Forces and torques are those that the fluid exerts on the body; resistances are positive, so that
force = -resistance * velocity in a fluid at rest. `viscosity` is 1 unless given.

    ellipsoids           resistance, traction, velocity of a slip, rotation in a linear flow
    one sphere           flow around it; Faxén's laws for a point force nearby
    two spheres          along and about the line of their centres, any radii, any gap > 0
    points               flow and pressure of point forces, exact outside whatever encloses them

A result is within some ten roundings of the exact value unless its docstring says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import elliprd, elliprf

Array = NDArray[np.float64]
_Sums = Callable[[Array, Array, float, float], Array]


# ---- points --------------------------------------------------------------------------------


def stokeslet_velocity(
    points: ArrayLike, sources: ArrayLike, forces: ArrayLike, viscosity: float = 1.0
) -> Array:
    """u_i(x) = sum_k 1/(8 pi viscosity) (delta_ij / r + r_i r_j / r^3) f_j, r = x - y_k.

    points : (..., 3); sources, forces : (n, 3); returns (..., 3). C. Pozrikidis, Boundary Integral
    and Singularity Methods, 1992, eq. 2.2.10.
    """
    r, distance, forces = _separations(points, sources, forces)
    along = np.einsum("...ki,ki->...k", r, forces) / distance**3
    total = np.einsum("...k,ki->...i", 1.0 / distance, forces)
    return (total + np.einsum("...k,...ki->...i", along, r)) / (8.0 * math.pi * viscosity)


def stokeslet_pressure(points: ArrayLike, sources: ArrayLike, forces: ArrayLike) -> Array:
    """p(x) = sum_k r.f / (4 pi r^3), r = x - y_k, of any viscosity; returns (...)."""
    r, distance, forces = _separations(points, sources, forces)
    return np.einsum("...ki,ki,...k->...", r, forces, distance**-3.0) / (4.0 * math.pi)


def stokeslet_stress(points: ArrayLike, sources: ArrayLike, forces: ArrayLike) -> Array:
    """sigma_il(x) = -3/(4 pi) sum_k r_i r_l (r.f) / r^5, of any viscosity; returns (..., 3, 3)."""
    r, distance, forces = _separations(points, sources, forces)
    strength = np.einsum("...ki,ki,...k->...k", r, forces, distance**-5.0)
    return -3.0 / (4.0 * math.pi) * np.einsum("...k,...ki,...kl->...il", strength, r, r)


def _separations(
    points: ArrayLike, sources: ArrayLike, forces: ArrayLike
) -> tuple[Array, Array, Array]:
    """x - y (..., n, 3), their lengths (..., n) and the forces (n, 3)."""
    sources, forces = (np.atleast_2d(np.asarray(a, dtype=float)) for a in (sources, forces))
    r = np.asarray(points, dtype=float)[..., None, :] - sources
    return r, np.linalg.norm(r, axis=-1), forces


# ---- ellipsoids ----------------------------------------------------------------------------


@dataclass(frozen=True)
class EllipsoidResistance:
    """Principal resistances of an ellipsoid: translation [viscosity length], rotation [length^3].

    translation : (3,) force over velocity along each axis
    rotation    : (3,) torque over angular velocity about each axis
    """

    translation: Array
    rotation: Array


@dataclass(frozen=True)
class SpheroidResistance:
    """Resistances of a spheroid along its axis of symmetry and across it."""

    translation_axial: float
    translation_transverse: float
    rotation_axial: float
    rotation_transverse: float


def ellipsoid_resistance(semi_axes: ArrayLike, viscosity: float = 1.0) -> EllipsoidResistance:
    """R_i of the force and torque along the principal axes i, with j and k the other two.

        force  16 pi / (chi + alpha_i a_i^2)
        torque 16 pi (a_j^2 + a_k^2) / (3 (alpha_j a_j^2 + alpha_k a_k^2))

        chi = int dl / D,   alpha_i = int dl / ((a_i^2 + l) D),   l = 0 ... infinity,
        D^2 = (a_1^2 + l)(a_2^2 + l)(a_3^2 + l).

    A. Oberbeck 1876, D. Edwardes 1892; S. Kim and S. Karrila, Microhydrodynamics, 1991, sec. 3.3.
    chi = 2 R_F and alpha_i = 2/3 R_D are Carlson's integrals: the limits of spheroids and of the
    sphere are values like all others, where the formulas in logarithms lose all digits.
    """
    a = _positive_axes(semi_axes)
    chi, alpha = _ellipsoid_integrals(a)
    factor = 16.0 * math.pi * viscosity
    pairs = ((1, 2), (2, 0), (0, 1))
    weighted = alpha * a**2
    rotation = [(a[j] ** 2 + a[k] ** 2) / (3.0 * (weighted[j] + weighted[k])) for j, k in pairs]
    return EllipsoidResistance(factor / (chi + weighted), factor * np.array(rotation))


def spheroid_resistance(
    equatorial: float, polar: float, viscosity: float = 1.0
) -> SpheroidResistance:
    """Resistances of the spheroid r^2 / equatorial^2 + z^2 / polar^2 = 1; see the ellipsoid's."""
    whole = ellipsoid_resistance((equatorial, equatorial, polar), viscosity)
    return SpheroidResistance(
        translation_axial=float(whole.translation[2]),
        translation_transverse=float(whole.translation[0]),
        rotation_axial=float(whole.rotation[2]),
        rotation_transverse=float(whole.rotation[0]),
    )


def ellipsoid_traction(
    points: ArrayLike,
    normals: ArrayLike,
    semi_axes: ArrayLike,
    velocity: ArrayLike,
    viscosity: float = 1.0,
) -> Array:
    """sigma.n = -(x.n) / (3 volume) R U on an ellipsoid that translates with velocity U.

    points, normals : (..., 3) on the surface, in the frame of the axes, from the centre; returns
    (..., 3). H. Brenner, Chem. Eng. Sci. 19, 703, 1964. Its negative is the density of the single
    layer, but for multiples of the normal.
    """  # fmt: skip
    a = _positive_axes(semi_axes)
    force = -ellipsoid_resistance(a, viscosity).translation * np.asarray(velocity, dtype=float)
    support = np.einsum("...i,...i->...", np.asarray(points), np.asarray(normals))
    return support[..., None] * force / (4.0 * math.pi * float(np.prod(a)))


def slip_velocity(
    points: ArrayLike, normals: ArrayLike, areas: ArrayLike, slip: ArrayLike
) -> Array:
    """U = - int (x.n) u_s dS / int (x.n) dS of a free ellipsoid whose surface slips by u_s.

    points, normals, slip : (n, 3), from the centre; areas : (n,) of a quadrature; returns (3,).
    The reciprocal theorem with the traction of `ellipsoid_traction` (H. Stone and A. Samuel, Phys.
    Rev. Lett. 77, 4102, 1996, for the sphere). As exact as the quadrature.
    """
    support = np.einsum("ni,ni,n->n", np.asarray(points), np.asarray(normals), np.asarray(areas))
    return -(support @ np.asarray(slip, dtype=float)) / support.sum()


def squirmer_velocity(first_mode: float) -> float:
    """U = 2 B_1 / 3, along theta = 0, of a free sphere with slip B_1 sin(theta) e_theta.

    Of any radius; higher modes of the slip do not move the sphere. M. Lighthill, Comm. Pure Appl.
    Math. 5, 109, 1952; J. Blake, J. Fluid Mech. 46, 199, 1971.
    """
    return 2.0 * first_mode / 3.0


def _positive_axes(semi_axes: ArrayLike) -> Array:
    a = np.asarray(semi_axes, dtype=float)
    if a.shape != (3,) or not (np.isfinite(a).all() and (a > 0.0).all()):
        raise ValueError(f"semi-axes {semi_axes}: must be three positive lengths")
    return a


def _ellipsoid_integrals(a: Array) -> tuple[float, Array]:
    """chi and alpha (3,) of `ellipsoid_resistance`."""
    x, y, z = a**2
    alpha = [elliprd(y, z, x), elliprd(z, x, y), elliprd(x, y, z)]
    return 2.0 * float(elliprf(x, y, z)), 2.0 / 3.0 * np.array(alpha)


# ---- spheroids in a linear flow ------------------------------------------------------------


def jeffery_angular_velocity(aspect: float, axis: ArrayLike, gradient: ArrayLike) -> Array:
    """omega = curl(u)/2 + B p x (E p), B = (aspect^2 - 1) / (aspect^2 + 1), of a free spheroid.

    aspect   : polar over equatorial semi-axis
    axis     : (3,) unit vector p of symmetry
    gradient : (3, 3) du_i/dx_j of the flow u at the centre, E its symmetric part
    G. Jeffery, Proc. R. Soc. Lond. A 102, 161, 1922.
    """
    p, g = np.asarray(axis, dtype=float), np.asarray(gradient, dtype=float)
    vorticity = np.array([g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]])
    # Written so that a disc and a needle, aspect 0 and infinity, are values like others.
    bretherton = (aspect - 1.0 / aspect) / (aspect + 1.0 / aspect)
    return 0.5 * vorticity + bretherton * np.cross(p, 0.5 * (g + g.T) @ p)


def jeffery_period(aspect: float, rate: float) -> float:
    """T = 2 pi (aspect + 1/aspect) / rate, the time of one turn in a shear flow of that rate."""
    return 2.0 * math.pi * (aspect + 1.0 / aspect) / rate


# ---- one sphere ----------------------------------------------------------------------------


def sphere_velocity(
    points: ArrayLike, radius: float, velocity: ArrayLike, angular_velocity: ArrayLike
) -> Array:
    """Flow at points (..., 3), from the centre, around a sphere that moves in a fluid at rest.

        u = (3a/4r + a^3/4r^3) U + (3a/4r - 3a^3/4r^3) (U.e) e + a^3/r^3 Omega x x,   e = x/r.

    G. Stokes 1851; of any viscosity.
    """
    x = np.asarray(points, dtype=float)
    U, omega = np.asarray(velocity, dtype=float), np.asarray(angular_velocity, dtype=float)
    s = radius / np.linalg.norm(x, axis=-1, keepdims=True)
    e = x * (s / radius)
    along = 0.75 * (s - s**3) * (e @ U)[..., None] * e
    return (0.75 * s + 0.25 * s**3) * U + along + s**3 * np.cross(omega, x)


def sphere_pressure(
    points: ArrayLike, radius: float, velocity: ArrayLike, viscosity: float = 1.0
) -> Array:
    """p = 3/2 viscosity a (U.x) / r^3 around a translating sphere; (..., 3) gives (...)."""
    x = np.asarray(points, dtype=float)
    flow = x @ np.asarray(velocity, dtype=float)
    return 1.5 * viscosity * radius * flow / np.linalg.norm(x, axis=-1) ** 3


@dataclass(frozen=True)
class SphereLoads:
    """What a flow exerts on a sphere held still: force (3,), torque (3,), stresslet (3, 3)."""

    force: Array
    torque: Array
    stresslet: Array


def point_force_near_sphere(position: ArrayLike, force: ArrayLike, radius: float) -> SphereLoads:
    """Loads on a fixed sphere by a point force (3,) at a position (3,) from its centre, outside.

    H. Faxén's laws in the unperturbed flow u, its values taken at the centre (any viscosity):
        F = 6 pi a (1 + a^2/6 Lap) u,   T = 4 pi a^3 curl u,   S = 20/3 pi a^3 (1 + a^2/10 Lap) E.
    S. Kim and S. Karrila, Microhydrodynamics, 1991, sec. 3.2. The force acts on the fluid.
    """
    r, f = -np.asarray(position, dtype=float), np.asarray(force, dtype=float)
    distance = float(np.linalg.norm(r))
    if distance <= radius:
        raise ValueError(f"position {position}: must be outside the sphere of radius {radius}")
    e, t = r / distance, radius / distance
    along = float(e @ f)
    # 8 pi u = (f + e e.f) / r,  8 pi Lap u = (2 f - 6 e e.f) / r^3
    drag = 0.75 * t * (f + along * e + t**2 * (f / 3.0 - along * e))
    torque = radius * t**2 * np.cross(f, e)
    outer = np.outer(e, f) + np.outer(f, e)
    # 8 pi E = e.f (1 - 3 e e) / r^2,  8 pi Lap E = (6 (e f + f e) + 6 e.f (1 - 5 e e)) (-1) / r^4
    unit = np.eye(3)
    strain = along * (unit - 3.0 * np.outer(e, e))
    curvature = -6.0 * (outer + along * (unit - 5.0 * np.outer(e, e)))
    stresslet = 5.0 / 6.0 * radius * t**2 * (strain + t**2 / 10.0 * curvature)
    return SphereLoads(drag, torque, stresslet)


# ---- two spheres ---------------------------------------------------------------------------
#
# Bispherical coordinates xi, eta: sphere 1 is xi = alpha > 0, sphere 2 is xi = -beta < 0, with
# a_1 sinh(alpha) = a_2 sinh(beta) = c. q = n - 1/2, m = n + 1/2, p = n + 3/2.


def stimson_jeffery(gap: float) -> tuple[float, float]:
    """lambda in F = 6 pi lambda of two unit spheres that move along the line of their centres.

    Both move with unit velocity, in the same direction (first) or in opposite ones (second):
        lambda = 4/3 sinh(alpha) sum_n n (n+1) / ((2n-1)(2n+3)) N_n / D_n,
        2 cosh(alpha) = 2 + gap
        same     N = 2 (1 - e^-x) + k,  D = 2 sinh x + (2n+1) sinh 2 alpha
        opposite N = 2 (1 + e^-x) + k,  D = 2 sinh x - (2n+1) sinh 2 alpha
        x = (2n+1) alpha,   k = (2n+1) sinh 2 alpha + (2n+1)^2 sinh^2 alpha.
    M. Stimson and G. Jeffery, Proc. R. Soc. Lond. A 111, 110, 1926, eq. 39, and A. Maude, Br. J.
    Appl. Phys. 12, 293, 1961; both with the leading exponentials of N cancelled by hand.
    """
    alpha = _parameters(1.0, 1.0, gap)[0]
    n = _orders(alpha)
    odd = 2.0 * n + 1.0
    x = odd * alpha
    common = odd * math.sinh(2.0 * alpha) + (odd * math.sinh(alpha)) ** 2
    factor = 4.0 / 3.0 * math.sinh(alpha) * n * (n + 1.0) / ((odd - 2.0) * (odd + 2.0))
    # Both fractions times e^-x, so that nothing overflows.
    decay = np.exp(-x)
    same = (2.0 * (1.0 - decay) + common) * decay
    same /= 1.0 - decay**2 + odd * math.sinh(2.0 * alpha) * decay
    opposite = (2.0 * (1.0 + decay) + common) * decay
    opposite /= 2.0 * x * _sinh_ratio_difference(x, 2.0 * alpha, scaled=True)
    return float(factor @ same), float(factor @ opposite)


def two_spheres_axial(radius_1: float, radius_2: float, gap: float) -> Array:
    """Resistance (2, 2) of two spheres that move along the line of their centres.

    force_i on sphere i = -viscosity R_ij velocity_j, all positive along the same direction. The
    stream function of M. Stimson and G. Jeffery, 1926, eqs 19-34, for velocities that may differ:
        psi = (cosh xi - mu)^(-3/2) sum_n U_n(xi) (P_(n-1)(mu) - P_(n+1)(mu)),
        U_n in the span of cosh, sinh of q xi and p xi, given with its derivative on both spheres.
    Relative error of the entries 1e-12 at gaps above 1e-4 of the smaller radius.
    """
    alpha, beta, c = _parameters(radius_1, radius_2, gap)
    n = _orders(min(alpha, beta))
    slow = (n + 1.5) * (alpha + beta) < _SLOW
    total = np.zeros((2, 2))
    for part, response in ((n[slow], _response_slow), (n[~slow], _response_fast)):
        if len(part):
            total += np.einsum("n,nij->ij", 2.0 * part + 1.0, response(part, alpha, beta))
    return 2.0 * math.sqrt(2.0) * math.pi * c * total


def two_spheres_spinning(radius_1: float, radius_2: float, gap: float) -> Array:
    """Resistance (2, 2) of two spheres that rotate about the line of their centres.

        R_11 = 16 pi c^3 sum_n n (n+1) e^(m (beta - alpha)) / sinh(m (alpha + beta)),
        R_12 = -16 pi c^3 sum_n n (n+1) e^(-m (alpha + beta)) / sinh(m (alpha + beta)).
    torque_i = -viscosity R_ij angular_velocity_j. G. Jeffery, Proc. Lond. Math. Soc. 14, 327, 1915.
    """
    alpha, beta, c = _parameters(radius_1, radius_2, gap)
    n = _orders(min(alpha, beta))
    m = n + 0.5
    weight = 32.0 * math.pi * c**3 * n * (n + 1.0) / -np.expm1(-2.0 * m * (alpha + beta))
    cross = -float(weight @ np.exp(-2.0 * m * (alpha + beta)))
    own = [float(weight @ np.exp(-2.0 * m * angle)) for angle in (alpha, beta)]
    return np.array([[own[0], cross], [cross, own[1]]])


_SLOW = 4.0
"""Below this p (alpha + beta), U_n is nearly a cubic and takes the basis of such."""


def _parameters(radius_1: float, radius_2: float, gap: float) -> tuple[float, float, float]:
    """alpha, beta, c: 2 sinh^2(alpha/2) = gap (gap + 2 a_2) / (2 d a_1), d between the centres."""
    if not (radius_1 > 0.0 and radius_2 > 0.0 and gap > 0.0):
        raise ValueError(f"radii {radius_1}, {radius_2}, gap {gap}: must be positive")
    distance = radius_1 + radius_2 + gap

    def parameter(own: float, other: float) -> float:
        return 2.0 * math.asinh(math.sqrt(gap * (gap + 2.0 * other) / (4.0 * distance * own)))

    alpha, beta = parameter(radius_1, radius_2), parameter(radius_2, radius_1)
    return alpha, beta, radius_1 * math.sinh(alpha)


def _orders(slowest: float) -> Array:
    """n = 1, 2, ... until e^(-2 n slowest), times powers of n, is far below rounding."""
    return np.arange(1.0, math.ceil(25.0 / slowest) + 12.0)


def _boundary_values(n: Array, angle: float) -> tuple[Array, Array]:
    """g_n and -dg_n/dxi, times e^(q angle), of rho^2/2 (cosh xi - mu)^(3/2) / c^2 on a sphere.

    g  = k ((2n+3) e^(-q xi) - (2n-1) e^(-p xi)),   k = n (n+1) / (sqrt(2) (2n-1)(2n+1)(2n+3))
    g' = -k (2n-1)(2n+3) / 2 (e^(-q xi) - e^(-p xi))
    """
    odd = 2.0 * n + 1.0
    k = n * (n + 1.0) / (math.sqrt(2.0) * (odd - 2.0) * odd * (odd + 2.0))
    vanishing = -math.expm1(-2.0 * angle)
    return (
        k * (4.0 + (odd - 2.0) * vanishing),
        0.5 * k * (odd - 2.0) * (odd + 2.0) * vanishing,
    )


def _response_fast(n: Array, alpha: float, beta: float) -> Array:
    """A + B + C + D (sphere 1), A - B + C - D (sphere 2) by unit velocities: (n, 2, 2).

    Basis of functions that decay from either sphere:
        e^(q x), e^(q x) (e^(2 x) - 1)/2 with x = xi - alpha, and with x = -(xi + beta).
    """
    q, span = n - 0.5, alpha + beta
    far = np.exp(-q * span)
    bend = 0.5 * math.expm1(-2.0 * span)
    one, zero = np.ones_like(q), np.zeros_like(q)
    slope = math.exp(-2.0 * span)
    # Values and outward slopes on each sphere of the four functions.
    value, steep = far * bend, far * (q * bend + slope)
    matrix = np.array([
        [one, zero, far, value],
        [q, one, -q * far, -steep],
        [far, value, one, zero],
        [-q * far, -steep, q, one],
    ]).transpose(2, 0, 1)  # fmt: skip
    return _forces(n, matrix, alpha, beta, _sums_fast)


def _sums_fast(n: Array, coefficients: Array, alpha: float, beta: float) -> Array:
    """2 e^(-q angle) (first - second (1 - e^(-2 angle)) / 2) of each sphere: (n, 2, 2)."""
    sums = np.empty((len(n), 2, 2))
    for k, angle in enumerate((alpha, beta)):
        first, second = coefficients[:, 2 * k], coefficients[:, 2 * k + 1]
        decay = np.exp(-(n - 0.5) * angle)[:, None]
        sums[:, k] = 2.0 * decay * (first + 0.5 * math.expm1(-2.0 * angle) * second)
    return sums


def _response_slow(n: Array, alpha: float, beta: float) -> Array:
    """The same by functions that are 1, xi, xi^2, xi^3 times constants where all is small.

    cosh q xi,   sinh(q xi)/q,   cosh p xi - cosh q xi,   sinh(p xi)/p - sinh(q xi)/q
    """
    q, m, p = n - 0.5, n + 0.5, n + 1.5
    rows = []
    for xi, outward in ((alpha, 1.0), (-beta, -1.0)):
        cubic = xi * _sinh_ratio_difference(p * xi, q * xi)
        quadratic = 2.0 * np.sinh(m * xi) * math.sinh(xi)
        rows.append([np.cosh(q * xi), np.sinh(q * xi) / q, quadratic, cubic])
        # d/dxi (cosh p xi - cosh q xi) = p sinh p xi - q sinh q xi
        bend = 2.0 * np.sinh(p * xi) + q * 2.0 * np.cosh(m * xi) * math.sinh(xi)
        rows.append([outward * d for d in (q * np.sinh(q * xi), np.cosh(q * xi), bend, quadratic)])
    matrix = np.array(rows).transpose(2, 0, 1)
    return _forces(n, matrix, alpha, beta, _sums_slow)


def _sums_slow(n: Array, coefficients: Array, alpha: float, beta: float) -> Array:
    """A + C and B + D from the coefficients of `_response_slow`: (n, 2, 2)."""
    q, p = (n - 0.5)[:, None], (n + 1.5)[:, None]
    even = coefficients[:, 0]
    odd = coefficients[:, 1] / q - 2.0 * coefficients[:, 3] / (p * q)
    return np.stack((even + odd, even - odd), axis=1)


def _forces(n: Array, matrix: Array, alpha: float, beta: float, sums: _Sums) -> Array:
    """Solve for the four coefficients by unit velocities of each sphere, and add them up."""
    q = n - 0.5
    data = np.zeros((len(n), 4, 2))
    for k, angle in enumerate((alpha, beta)):
        value, slope = _boundary_values(n, angle)
        decay = np.exp(-q * angle)
        data[:, 2 * k, k], data[:, 2 * k + 1, k] = value * decay, -slope * decay
    # Slopes in units of the span, functions in units of their largest value: condition O(1).
    span = np.array([1.0, 1.0, 1.0, 1.0])
    span[1::2] = alpha + beta
    matrix, data = matrix * span[:, None], data * span[:, None]
    size = np.abs(matrix).max(axis=1)
    coefficients = np.linalg.solve(matrix / size[:, None, :], data) / size[:, :, None]
    return sums(n, coefficients, alpha, beta)


def _sinh_ratio_difference(x: Array, y: ArrayLike, scaled: bool = False) -> Array:
    """sinh(x)/x - sinh(y)/y for |x| > |y| without cancellation; scaled: times e^(-|x|)."""
    x, y = np.broadcast_arrays(np.abs(np.asarray(x, dtype=float)), np.abs(y))
    result = np.empty_like(x)
    small = x < 4.0
    X, Y = x[~small], y[~small]
    decay = np.exp(-X) if scaled else np.ones_like(X)
    grown = np.exp(X) * decay if not scaled else np.ones_like(X)
    result[~small] = 0.5 * (grown - np.exp(-X) * decay) / X - np.sinh(Y) / Y * decay
    x2, y2 = x[small] ** 2, y[small] ** 2
    # x^2k - y^2k = (x^2 - y^2) s_k,  s_(k+1) = x^2 s_k + y^2k: all terms are positive.
    geometric, power = np.ones_like(x2), y2.copy()
    total, factorial = np.zeros_like(x2), 6.0
    for k in range(1, 20):
        total += geometric / factorial
        geometric = x2 * geometric + power
        power = power * y2
        factorial *= (2.0 * k + 2.0) * (2.0 * k + 3.0)
    result[small] = (x2 - y2) * total * (np.exp(-x[small]) if scaled else 1.0)
    return result
