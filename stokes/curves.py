"""Generating curves of bodies of revolution, run from the north pole to the south pole.

A curve gamma(s) = (r(s), z(s)), s in [0, 1], has r = 0 at both ends, r > 0 between, z' = 0 at the
poles; turned about the z-axis it bounds a body of genus 0 with outward normal
nu = (-z', r')/|gamma'|. Curves know no unit of length: a body scales its curve.

Between close points s and t the differences gamma(s) - gamma(t) and the offsets
nu.(gamma(s) - gamma(t)), of second order in s - t, keep their relative precision: as
trigonometric identities where there are, else as Gauss integrals of gamma' and gamma''.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import root
from scipy.special import erf

Array = NDArray[np.float64]

_MEAN_NODES, _MEAN_WEIGHTS = (
    (1 + np.polynomial.legendre.leggauss(16)[0]) / 2,
    np.polynomial.legendre.leggauss(16)[1] / 2,
)

_MOST_HALVINGS = 24
_ROUND_OFF = 4e-15  # tails of a resolved series do not fall below this part of its greatest value


@dataclass(frozen=True)
class CurvePoints:
    """Points of a curve and derivatives by its parameter s; arrays of one shape."""

    r: Array
    z: Array
    dr: Array
    dz: Array
    d2r: Array
    d2z: Array

    @property
    def speed(self) -> Array:
        """|gamma'|."""
        return np.hypot(self.dr, self.dz)

    @property
    def normal_r(self) -> Array:
        """Radial component of the outward normal."""
        return -self.dz / self.speed

    @property
    def normal_z(self) -> Array:
        """Axial component of the outward normal."""
        return self.dr / self.speed

    @property
    def meridional_curvature(self) -> Array:
        """Curvature along the meridian, positive where the body is convex."""
        return (self.dz * self.d2r - self.dr * self.d2z) / self.speed**3

    @property
    def azimuthal_curvature(self) -> Array:
        """The other principal curvature nu_r / r; at a pole its limit, the meridional one."""
        inside = self.r > 0
        radius = np.where(inside, self.r, 1.0)
        return np.where(inside, self.normal_r / radius, self.meridional_curvature)


class Curve(ABC):
    """A generating curve: frozen, hashable, compared by its parameters."""

    @abstractmethod
    def evaluate(self, s: ArrayLike) -> CurvePoints:
        """Return the points at parameters s (any shape), with first and second derivatives."""

    def derivatives(self, s: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """Return r', z', r'', z'' at parameters s (any shape)."""
        points = self.evaluate(s)
        return points.dr, points.dz, points.d2r, points.d2z

    @property
    def breaks(self) -> tuple[float, ...]:
        """Parameters 0 .. 1 between which the curve is analytic."""
        return (0.0, 1.0)

    @property
    @abstractmethod
    def reach(self) -> float:
        """|s - t| below which 16 Gauss nodes integrate gamma'' to round-off."""

    @cached_property
    def bounding_radius(self) -> float:
        """Radius of a ball about the origin that holds the body; at most 0.1 % too large."""
        edges = np.array(self.breaks)
        s = edges[:-1, None] + np.diff(edges)[:, None] * np.linspace(0, 1, 257)
        points = self.evaluate(s)
        # Between samples |gamma|^2 exceeds theirs by no more than (k |gamma| - 1)(step/2)^2.
        squared = points.r**2 + points.z**2
        step = points.speed * np.diff(edges)[:, None] / 256
        bulge = np.maximum(points.meridional_curvature, 0) * np.sqrt(squared) * (0.5 * step) ** 2
        return float(np.sqrt((squared + bulge).max()))

    @cached_property
    def polynomials(self) -> tuple[Array, Array]:
        """Edges of panels, and the curve on them as Chebyshev series to round-off.

        Coefficients (panels, 3, 2, 16): gamma, gamma', gamma'' by s; r, z; degrees 0 .. 15 in the
        coordinate -1 .. 1 of a panel.
        """
        n = 16
        edges = resolved_breaks(self, lambda points: np.stack([points.r, points.z]), n, 1e-15)
        half = 0.5 * np.diff(edges)
        x = np.cos(np.pi * (np.arange(n) + 0.5) / n)
        points = self.evaluate(edges[:-1, None] + half[:, None] * (1 + x))
        to_series = 2 / n * np.cos(np.pi * np.outer(np.arange(n), np.arange(n) + 0.5) / n)
        to_series[0] /= 2
        values = np.array([[points.r, points.z], [points.dr, points.dz], [points.d2r, points.d2z]])
        return edges, np.ascontiguousarray(np.moveaxis(values @ to_series.T, 2, 0))

    def differences(self, s: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        """Return (r(s) - r(t), z(s) - z(t)) to relative precision, also as s -> t."""
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        here, there = self.evaluate(s), self.evaluate(t)
        dr, dz = np.asarray(here.r - there.r), np.asarray(here.z - there.z)
        close = np.abs(s - t) < self.reach
        if close.any():
            u, w = self._between(s[close], t[close])
            slope_r, slope_z, _, _ = self.derivatives(u)
            dr[close], dz[close] = np.sum(w * slope_r, axis=-1), np.sum(w * slope_z, axis=-1)
        return dr, dz

    def normal_offsets(self, s: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        """Return nu(s).(gamma(s) - gamma(t)) and nu(t).(gamma(s) - gamma(t)).

        Both are O((s - t)^2); they keep their relative precision as s -> t.
        """
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        here, there = self.evaluate(s), self.evaluate(t)
        dr, dz = here.r - there.r, here.z - there.z
        at_s = np.asarray(here.normal_r * dr + here.normal_z * dz)
        at_t = np.asarray(there.normal_r * dr + there.normal_z * dz)
        close = np.abs(s - t) < self.reach
        if close.any():
            # Taylor's remainder: gamma(s) - gamma(t) = gamma'(s) (s - t) - int_t^s (u - t) gamma''
            u, w = self._between(s[close], t[close])
            _, _, d2r, d2z = self.derivatives(u)
            for offsets, ends, lever in (
                (at_s, here, t[close][..., None] - u),
                (at_t, there, s[close][..., None] - u),
            ):
                n_r = np.asarray(ends.normal_r)[close][..., None]
                n_z = np.asarray(ends.normal_z)[close][..., None]
                bend = n_r * d2r + n_z * d2z
                offsets[close] = np.sum(w * lever * bend, axis=-1)
        return at_s, at_t

    def _between(self, s: Array, t: Array) -> tuple[Array, Array]:
        """Gauss nodes and weights of int_t^s, shapes (n, q); split at a break between them."""
        middle = 0.5 * (s + t)
        for knot in self.breaks[1:-1]:
            inside = (np.minimum(s, t) < knot) & (knot < np.maximum(s, t))
            middle = np.where(inside, knot, middle)
        first, second = (middle - t)[:, None], (s - middle)[:, None]
        nodes = [t[:, None] + first * _MEAN_NODES, middle[:, None] + second * _MEAN_NODES]
        weights = [first * _MEAN_WEIGHTS, second * _MEAN_WEIGHTS]
        return np.concatenate(nodes, axis=1), np.concatenate(weights, axis=1)


def resolved_breaks(
    curve: Curve,
    functions: Callable[[CurvePoints], Array],
    nodes: int,
    tolerance: float,
) -> Array:
    """Return edges of panels, halved until Gauss nodes resolve functions of the curve's points.

    functions : CurvePoints of shape (m,) to (k, m). On each panel the two last of the `nodes`
    Legendre coefficients must be below `tolerance` x the function's greatest value on the curve.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    # c_j = (2 j + 1)/2 sum w P_j f, for the two highest degrees
    vandermonde = np.polynomial.legendre.legvander(x, nodes - 1)[:, -2:]
    last = w[:, None] * vandermonde * (np.array([nodes - 2, nodes - 1]) + 0.5)
    pending = np.column_stack([curve.breaks[:-1], curve.breaks[1:]])
    done, largest = [], 0.0
    for _ in range(_MOST_HALVINGS):
        s = pending[:, :1] + 0.5 * np.diff(pending) * (1 + x)
        points = curve.evaluate(s.ravel())
        values = functions(points).reshape(-1, *s.shape)
        largest = np.maximum(largest, np.abs(values).max(axis=(1, 2)))
        tails = np.abs(values @ last).max(axis=2)
        coarse = np.any(tails > np.maximum(tolerance, _ROUND_OFF) * largest[:, None], axis=0)
        done.append(pending[~coarse])
        a, b = pending[coarse].T
        middle = 0.5 * (a + b)
        pending = np.concatenate([np.column_stack([a, middle]), np.column_stack([middle, b])])
        if len(pending) == 0:
            break
    else:
        raise ValueError(f"{curve}: not resolved by {_MOST_HALVINGS} halvings of its panels")
    return np.append(np.sort(np.concatenate(done)[:, 0]), 1.0)


def _mirror(s: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Distance of s from the nearer end, and where that is the far end.

    1 - s is exact there, so that r keeps its relative precision towards both poles.
    """
    s = np.asarray(s, float)
    south = s > 0.5
    return np.where(south, 1.0 - s, s), south


@dataclass(frozen=True)
class FourierCurve(Curve):
    """r = sum_k a_k sin(k pi s), k >= 1; z = sum_k b_k cos(k pi s), k >= 0.

    `sine` holds a_1, a_2, ...; `cosine` holds b_0, b_1, ...
    """

    sine: tuple[float, ...]
    cosine: tuple[float, ...]

    def evaluate(self, s: ArrayLike) -> CurvePoints:
        sigma, south = _mirror(s)
        sums = np.zeros((6, *sigma.shape))
        terms = max(len(self.sine) + 1, len(self.cosine))
        for k in range(terms):
            a = self.sine[k - 1] if 0 < k <= len(self.sine) else 0.0
            b = self.cosine[k] if k < len(self.cosine) else 0.0
            flip = np.where(south, (-1.0) ** k, 1.0)
            c = flip * np.cos(k * np.pi * sigma)
            d = flip * np.where(south, -1.0, 1.0) * np.sin(k * np.pi * sigma)
            w = k * np.pi
            sums += [a * d, b * c, a * w * c, -b * w * d, -a * w * w * d, -b * w * w * c]
        return CurvePoints(*sums)

    @property
    def reach(self) -> float:
        return 1.0 / max(len(self.sine) + 1, len(self.cosine))

    def differences(self, s: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        # sin x - sin y = 2 cos((x + y)/2) sin((x - y)/2), cos x - cos y = -2 sin() sin()
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        mean, half = 0.5 * np.pi * (s + t), 0.5 * np.pi * (s - t)
        dr, dz = np.zeros(s.shape), np.zeros(s.shape)
        for k, a in enumerate(self.sine, start=1):
            dr += 2 * a * np.cos(k * mean) * np.sin(k * half)
        for k, b in enumerate(self.cosine):
            dz -= 2 * b * np.sin(k * mean) * np.sin(k * half)
        return dr, dz


@dataclass(frozen=True)
class Spheroid(FourierCurve):
    """r = a sin(pi s), z = c cos(pi s)."""

    @property
    def equatorial(self) -> float:
        """Semi-axis a across the axis of symmetry."""
        return self.sine[0]

    @property
    def polar(self) -> float:
        """Semi-axis c along the axis of symmetry."""
        return self.cosine[1]

    @cached_property
    def bounding_radius(self) -> float:
        # points may round to a little beyond the longer semi-axis
        return max(self.equatorial, self.polar) * (1.0 + 4.0 * np.finfo(float).eps)

    def normal_offsets(self, s: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        # nu(s).(gamma(s) - gamma(t)) = 2 pi a c sin^2(pi (s - t)/2)/|gamma'(s)|
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        bend = 2 * np.pi * self.equatorial * self.polar * np.sin(0.5 * np.pi * (s - t)) ** 2
        return bend / self.evaluate(s).speed, -bend / self.evaluate(t).speed


@dataclass(frozen=True)
class Spherocylinder(Curve):
    """A cylinder with round caps whose curvature goes smoothly from the caps' to zero.

    Along the arc length l the curvature is kappa (erf((l + b)/w) - erf((l - b)/w))/2 about each
    pole, w = `smoothing` x `radius`. The arc b of a cap and the curvature kappa are such that the
    greatest radius is `radius` and the length along the axis 2 (`half_length` + `radius`).
    """

    radius: float
    half_length: float
    smoothing: float

    @cached_property
    def _shape(self) -> tuple[float, float]:
        """(b, half of the arc length): two equations for the half width and half length."""
        cap = 0.5 * np.pi * self.radius

        def misfit(unknowns: Array) -> Array:
            b, half = unknowns
            edges = np.linspace(0.0, half, self._pieces(half) + 1)
            nodes = edges[:-1, None] + np.diff(edges)[:, None] * _MEAN_NODES
            weights = np.diff(edges)[:, None] * _MEAN_WEIGHTS
            phi = self._turned(nodes, b, half)[0]
            width, length = np.sum(weights * np.cos(phi)), np.sum(weights * np.sin(phi))
            return np.array([width - self.radius, length - self.half_length - self.radius])

        found = root(misfit, [cap, cap + self.half_length], tol=1e-14)
        b, half = found.x
        if np.abs(misfit(found.x)).max() > 1e-12 * (self.radius + self.half_length) or b > half:
            raise ValueError(
                f"spherocylinder({self.radius}, {self.half_length}, smoothing={self.smoothing}): "
                "no curvature found that gives this radius and length"
            )
        return float(b), float(half)

    def _pieces(self, half: float) -> int:
        return int(np.ceil(2 * half / (self.smoothing * self.radius)))

    def _turned(self, arc: Array, b: float, half: float) -> tuple[Array, Array]:
        """Angle turned from the pole to `arc`, and the curvature there."""
        w = self.smoothing * self.radius

        def ramp(x: Array) -> Array:  # integral of erf(x/w)
            return x * erf(x / w) + w / np.sqrt(np.pi) * np.exp(-((x / w) ** 2))

        phi, curvature = np.zeros_like(arc), np.zeros_like(arc)
        kappa = 0.25 * np.pi / b
        for pole in (-2 * half, 0.0, 2 * half, 4 * half):
            x = arc - pole
            phi += kappa * (ramp(x + b) - ramp(x - b))
            phi -= kappa * (ramp(np.float64(b - pole)) - ramp(np.float64(-b - pole)))
            curvature += kappa * (erf((x + b) / w) - erf((x - b) / w))
        return phi, curvature

    @cached_property
    def _anchors(self) -> tuple[Array, Array, Array]:
        """Arc lengths from pole to equator a few to the smoothing width, with r and z there."""
        b, half = self._shape
        edges = np.linspace(0.0, half, self._pieces(half) + 1)
        nodes = edges[:-1, None] + np.diff(edges)[:, None] * _MEAN_NODES
        phi, _ = self._turned(nodes, b, half)
        step = half / (len(edges) - 1)
        r = np.concatenate([[0.0], np.cumsum(step * np.cos(phi) @ _MEAN_WEIGHTS)])
        drop = np.concatenate([[0.0], np.cumsum(step * np.sin(phi) @ _MEAN_WEIGHTS)])
        return edges, r, drop[-1] - drop

    def evaluate(self, s: ArrayLike) -> CurvePoints:
        sigma, south = _mirror(s)
        b, half = self._shape
        edges, anchor_r, anchor_z = self._anchors
        arc = 2 * half * sigma
        index = np.clip((arc / half * (len(edges) - 1)).astype(int), 0, len(edges) - 1)
        length = arc - edges[index]
        between, _ = self._turned(
            edges[index][..., None] + length[..., None] * _MEAN_NODES, b, half
        )
        r = anchor_r[index] + length * (np.cos(between) @ _MEAN_WEIGHTS)
        z = anchor_z[index] - length * (np.sin(between) @ _MEAN_WEIGHTS)
        z = np.where(south, -z, z)
        return CurvePoints(r, z, *self.derivatives(s))

    def derivatives(self, s: ArrayLike) -> tuple[Array, Array, Array, Array]:
        # Unlike r and z they need no integrals.
        sigma, south = _mirror(s)
        b, half = self._shape
        phi, curvature = self._turned(2 * half * sigma, b, half)
        sign, speed = np.where(south, -1.0, 1.0), 2 * half
        # gamma' = |gamma'| (cos phi, -sin phi); the southern half is the northern one mirrored.
        return (
            sign * speed * np.cos(phi),
            -speed * np.sin(phi),
            -(speed**2) * curvature * np.sin(phi),
            -sign * speed**2 * curvature * np.cos(phi),
        )

    @property
    def reach(self) -> float:
        return 0.5 * self.smoothing * self.radius / self._shape[1]


@dataclass(frozen=True)
class SplineCurve(Curve):
    """Quintic spline through given points of the meridian, from pole to pole."""

    points_r: tuple[float, ...]
    points_z: tuple[float, ...]

    @cached_property
    def _splines(self) -> tuple[list[BSpline], list[BSpline]]:
        """r and z with two derivatives each: periodic splines of the whole closed meridian."""
        r = np.concatenate([self.points_r, -np.array(self.points_r[-2::-1])])
        z = np.concatenate([self.points_z, self.points_z[-2::-1]])
        knots = np.array(self.breaks)
        knots = np.concatenate([knots, 2 - knots[-2::-1]])
        curves = [make_interp_spline(knots, values, k=5, bc_type="periodic") for values in (r, z)]
        return tuple([c, c.derivative(1), c.derivative(2)] for c in curves)

    @cached_property
    def breaks(self) -> tuple[float, ...]:
        """Parameters of the points: chord lengths over their sum."""
        chords = np.hypot(np.diff(self.points_r), np.diff(self.points_z))
        knots = np.concatenate([[0.0], np.cumsum(chords)]) / chords.sum()
        knots[-1] = 1.0
        return tuple(knots.tolist())

    def evaluate(self, s: ArrayLike) -> CurvePoints:
        s = np.asarray(s, float)
        r, z = ([spline(s) for spline in splines] for splines in self._splines)
        return CurvePoints(r[0], z[0], r[1], z[1], r[2], z[2])

    @cached_property
    def reach(self) -> float:
        return float(np.diff(self.breaks).min())


def sphere() -> Spheroid:
    """Return the unit sphere."""
    return spheroid(1.0, 1.0)


def spheroid(equatorial: float, polar: float) -> Spheroid:
    """Return the spheroid of these semi-axes, across and along its axis; both > 0."""
    if not (equatorial > 0 and polar > 0):
        raise ValueError(f"spheroid: semi-axes {equatorial}, {polar} must be > 0")
    return Spheroid((float(equatorial),), (0.0, float(polar)))


def spherocylinder(radius: float, half_length: float, smoothing: float = 0.2) -> Spherocylinder:
    """Return a rod: a cylinder of length 2 x `half_length` with caps of `radius`.

    `smoothing` is the width, in radii, over which the curvature of a cap goes to zero. Radius and
    total length are exact. All three > 0, smoothing at
    most 1/2: else ValueError.
    """
    if not (radius > 0 and half_length > 0 and 0 < smoothing <= 0.5):
        raise ValueError(
            f"spherocylinder: radius {radius} and half_length {half_length} must be > 0, "
            f"smoothing {smoothing} in (0, 0.5]"
        )
    curve = Spherocylinder(float(radius), float(half_length), float(smoothing))
    return _checked(curve)


def fourier_curve(sine: Sequence[float], cosine: Sequence[float]) -> FourierCurve:
    """Return r = sum a_k sin(k pi s), z = sum b_k cos(k pi s); a from k = 1, b from k = 0.

    ValueError if the curve bounds no body of genus 0.
    """
    return _checked(FourierCurve(tuple(map(float, sine)), tuple(map(float, cosine))))


def spline_curve(r: ArrayLike, z: ArrayLike) -> SplineCurve:
    """Return the quintic spline through points (r, z) from the north to the south pole.

    r : (n,), n >= 6, zero at both ends and positive between; z : (n,). The curve has four
    continuous derivatives. ValueError if it bounds no body of genus 0.
    """
    r, z = np.asarray(r, float), np.asarray(z, float)
    if r.ndim != 1 or r.shape != z.shape or len(r) < 6:
        raise ValueError(f"spline_curve: shapes {r.shape}, {z.shape}: need (n,) twice, n >= 6")
    if max(abs(r[0]), abs(r[-1])) > 1e-12 * np.abs(r).max():
        raise ValueError("spline_curve: the first and last point must lie on the axis")
    return _checked(SplineCurve((0.0, *r[1:-1].tolist(), 0.0), tuple(z.tolist())))


def _checked(curve: Curve) -> Curve:
    """Return the curve if it bounds a body of genus 0; ValueError says what is wrong."""
    edges = np.array(curve.breaks)
    samples = 8 + 512 // (len(edges) - 1)
    s = (edges[:-1, None] + np.diff(edges)[:, None] * np.arange(samples) / samples).ravel()[1:]
    points, ends = curve.evaluate(s), curve.evaluate(np.array([0.0, 1.0]))
    if not (ends.z[0] > ends.z[1]):
        raise ValueError("curve must run from the north pole (greater z) to the south pole")
    if not (np.all(points.r > 0) and ends.dr[0] > 0 > ends.dr[1]):
        raise ValueError("curve must stay off the axis between its poles")
    if np.abs(ends.dz).max() > 1e-9 * np.abs(ends.dr).min():
        raise ValueError("curve must meet the axis at right angles")
    if points.speed.min() < 1e-9 * points.speed.max():
        raise ValueError("curve has a cusp: |gamma'| vanishes")
    if _crosses_itself(points.r, points.z):
        raise ValueError("curve crosses itself")
    return curve


def _crosses_itself(r: Array, z: Array) -> bool:
    """Return whether two segments of the polygon through the points cross; row by row."""
    p, q = np.column_stack([r[:-1], z[:-1]]), np.column_stack([r[1:], z[1:]])

    def side(a: Array, b: Array, c: Array) -> Array:
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
            c[..., 0] - a[..., 0]
        )

    for i in range(len(p) - 2):
        a, b, c, d = p[i], q[i], p[i + 2 :], q[i + 2 :]
        if np.any((side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)):
            return True
    return False
