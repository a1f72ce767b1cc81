"""How finely a body is resolved: panels along its meridian, Fourier modes about its axis.

The shape itself asks for panels on which its normal and curvatures are polynomials. A neighbour at
gap g asks for more. Two surfaces of curvature k hold images of each other; the nearest one in the
neighbour lies at the distance D = g + (sqrt(q + q^2/4) - q/2)/k, q = k g, so that the density of
two spheres decays by degree like exp(-alpha l), alpha = acosh(1 + q/2) = log(1 + k D). The same
point bounds what panels and modes must resolve: panels are halved until it lies outside the
Bernstein ellipse on which their nodes reach the tolerance; modes fall like those of a ring source
through it, exp(-n xi), xi = 2 asinh(d/sqrt(4 r r')): few are needed where it is near the axis.

Bodies choose from a ladder of few levels, so that many bodies share few factored operators.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes.curves import Curve, CurvePoints, resolved_breaks

Array = NDArray[np.float64]

# Least gaps a level serves, as parts of the bounding radius: (at a pole, anywhere else).
_LADDER = ((1.0, 1.0), (0.1, 0.3), (0.1, 0.1), (1e-3, 0.5), (1e-3, 0.1), (1e-3, 0.01))
_LEAST_MODES = 4  # rigid motions and quadratic flows: 0 .. 2
_POLAR = 0.1  # contacts off the axis by up to this part of the image's distance count as polar
_SLACK = 0.99  # gaps this near to those of a level are served by it
# Part of the density that the nearest image carries. Two moving spheroids at a gap of a tenth
# then err, in the middle of the gap, by 2 to 10 tolerances; their forces by less than 0.1.
_SHARE = 0.1
_POLAR_SHARE = 10.0  # at a pole, where few panels buy it: pressures between approaching bodies


@dataclass(frozen=True)
class Resolution:
    """Panels and modes of a body.

    breaks : edges of the panels, rising from 0 to 1; nodes : Gauss-Legendre nodes of a panel;
    modes : highest Fourier mode, 2 modes + 1 angles. ValueError for anything else.
    """

    breaks: tuple[float, ...]
    nodes: int
    modes: int

    def __post_init__(self) -> None:
        edges = np.array(self.breaks, float)
        if edges.ndim != 1 or len(edges) < 2 or edges[0] != 0 or edges[-1] != 1:
            raise ValueError(f"Resolution: breaks {self.breaks} must run from 0 to 1")
        if not np.all(np.diff(edges) > 0):
            raise ValueError(f"Resolution: breaks {self.breaks} must rise")
        if self.nodes < 2 or self.modes < 0:
            raise ValueError(f"Resolution: nodes {self.nodes} >= 2, modes {self.modes} >= 0 wanted")
        object.__setattr__(self, "breaks", tuple(edges.tolist()))

    @classmethod
    def uniform(cls, panels: int, nodes: int, modes: int) -> Resolution:
        """Return equal panels."""
        return cls(tuple(np.linspace(0, 1, panels + 1).tolist()), nodes, modes)

    @property
    def panels(self) -> int:
        """Number of panels."""
        return len(self.breaks) - 1

    @property
    def meridian_nodes(self) -> int:
        """Number of nodes of the meridian."""
        return self.panels * self.nodes

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Parameters of the meridian's nodes, rising."""
        edges = np.array(self.breaks)
        nodes, _ = np.polynomial.legendre.leggauss(self.nodes)
        return (edges[:-1, None] + 0.5 * np.diff(edges)[:, None] * (1 + nodes)).ravel()

    @property
    def angles(self) -> int:
        """Number of equal angles about the axis."""
        return 2 * self.modes + 1

    @property
    def surface_nodes(self) -> int:
        """Number of nodes of the surface."""
        return self.meridian_nodes * self.angles


@dataclass(frozen=True)
class ResolutionLadder:
    """The resolutions from which bodies of one shape choose, coarse to fine.

    tolerance : relative error wanted of velocities; densities may err more next to neighbours.
    Level j serves neighbours at the gaps of `gaps[j]`, in parts of the bounding radius: at a
    pole, anywhere else.
    """

    curve: Curve
    tolerance: float
    gaps: tuple[tuple[float, float], ...] = _LADDER

    def __post_init__(self) -> None:
        if not 1e-14 <= self.tolerance < 1:
            raise ValueError(f"resolution: tolerance {self.tolerance} must lie in [1e-14, 1)")

    @cached_property
    def levels(self) -> tuple[Resolution, ...]:
        """One resolution for each pair of gaps."""
        return tuple(self._level(pole, side) for pole, side in self.gaps)

    def level(self, gaps: ArrayLike, s: ArrayLike) -> int:
        """Return the coarsest level for neighbours at gaps (m,), nearest at parameters s (m,).

        Gaps are in units of the curve. ValueError if a gap is too small for every level.
        """
        gaps, s = np.atleast_1d(np.asarray(gaps, float)), np.atleast_1d(np.asarray(s, float))
        points = self.curve.evaluate(s)
        radius = self.curve.bounding_radius
        polar = points.r <= _POLAR * _image_distance(points, np.maximum(gaps, 1e-12))[0]
        for j, (pole, side) in enumerate(self.gaps):
            if np.all(gaps >= np.where(polar, pole, side) * radius * _SLACK):
                return j
        k = int(np.argmin(gaps / np.where(polar, *np.min(self.gaps, axis=0))))
        raise ValueError(
            f"resolution: no level for the gap {gaps[k]:.3g} at s = {s[k]:.3g} of {self.curve}"
        )

    def resolution(self, gaps: ArrayLike, s: ArrayLike) -> Resolution:
        """Return the resolution of the coarsest level for these neighbours, as `level`."""
        return self.levels[self.level(gaps, s)]

    def _level(self, pole: float, side: float) -> Resolution:
        pole, side = pole * self.curve.bounding_radius, side * self.curve.bounding_radius
        nodes = panel_nodes(self.tolerance)
        least = max(1.0, (self.tolerance / _SHARE) ** (-1 / nodes))
        polar_least = max(1.0, (self.tolerance / _POLAR_SHARE) ** (-1 / nodes))
        ends = np.array([0.0, 1.0])
        images = ends + 1j * _image_parameter(self.curve.evaluate(ends), pole)
        edges = resolved_breaks(self.curve, _shape_functions, nodes, self.tolerance)
        pending, done = np.column_stack([edges[:-1], edges[1:]]), []
        while len(pending):
            middle, half = pending.mean(axis=1), 0.5 * np.diff(pending)[:, 0]
            points = self.curve.evaluate(middle[:, None] + half[:, None] * np.linspace(-1, 1, 9))
            # An image over the middle of a panel is the worst.
            eta = _image_parameter(points, side).min(axis=1) / half
            polar = _bernstein((images - middle[:, None]) / half[:, None]).min(axis=1)
            coarse = (eta + np.hypot(1, eta) < least) | (polar < polar_least)
            done.append(pending[~coarse])
            (a, b), m = pending[coarse].T, middle[coarse]
            pending = np.concatenate([np.column_stack([a, m]), np.column_stack([m, b])])
        edges = np.append(np.sort(np.concatenate(done)[:, 0]), 1.0)
        return Resolution(tuple(edges.tolist()), nodes, self._modes(edges, pole, side))

    def _modes(self, edges: Array, pole: float, side: float) -> int:
        """Return the modes that images over any ring, and slightly off the poles, need."""
        s = (edges[:-1, None] + np.diff(edges)[:, None] * np.linspace(0.05, 0.95, 10)).ravel()
        points = self.curve.evaluate(s)
        D = _image_distance(points, side)[1]
        rings = D**2 / (points.r * np.maximum(points.r + D * points.normal_r, _POLAR * D))
        ends = self.curve.evaluate(np.array([0.0, 1.0]))
        D = _image_distance(ends, pole)[1]
        off_axis = (points.r[:, None] - _POLAR * D) ** 2
        along = (points.z[:, None] - ends.z - D * ends.normal_z) ** 2
        poles = (off_axis + along) / (points.r[:, None] * _POLAR * D)
        xi = 2 * np.arcsinh(0.5 * np.sqrt(min(rings.min(), poles.min())))
        return max(_LEAST_MODES, int(np.ceil(np.log(_SHARE / self.tolerance) / xi)))


def panel_nodes(tolerance: float) -> int:
    """Return the nodes of a panel that suit a tolerance: 8 for 1e-4 to 16 for 1e-12."""
    return int(np.clip(np.ceil(-np.log10(tolerance)) + 4, 8, 16))


def _shape_functions(points: CurvePoints) -> Array:
    """What densities on the shape are made of."""
    speed = points.speed
    return np.stack(
        [
            points.r,
            points.z,
            speed,
            1 / speed,
            points.normal_r,
            points.normal_z,
            points.meridional_curvature,
            points.azimuthal_curvature,
        ]
    )


def _image_distance(points: CurvePoints, gap: ArrayLike) -> Array:
    """Distance D of the nearest image in an equal surface across a gap, (2, ...).

    As seen along the meridian and across it: the mean of that curvature of the body and of the
    sharper of the two, for which way the neighbour lies is not known.
    """
    own = np.stack([points.meridional_curvature, points.azimuthal_curvature])
    k = np.maximum(0.5 * (own + own.max(axis=0)), 1e-6 / gap)
    q = k * gap
    return gap + (np.sqrt(q + 0.25 * q * q) - 0.5 * q) / k


def _image_parameter(points: CurvePoints, gap: float) -> Array:
    """Distance of the image from the real parameters: at a radius of curvature 1/k, D is passed
    within the angle log(1 + k D) of the complexified circle.
    """
    k, D = points.meridional_curvature, _image_distance(points, gap)[0]
    angle = np.log1p(np.maximum(k * D, -0.5))
    arc = np.where(np.abs(k * D) > 1e-6, angle / np.where(k == 0, 1.0, k), D)
    return arc / points.speed


def _bernstein(zeta: NDArray[np.complex128]) -> Array:
    """rho of the Bernstein ellipse of [-1, 1] through zeta."""
    rho = np.abs(zeta + np.sqrt(zeta * zeta - 1))
    return np.maximum(rho, 1 / rho)


def resolution_for(
    curve: Curve, tolerance: float, neighbours: Sequence[tuple[float, float]] = ()
) -> Resolution:
    """Return the coarsest level of the ladder for neighbours (gap, s), gaps in the curve's unit.

    For many bodies of one shape keep a `ResolutionLadder` instead.
    """
    table = np.array(neighbours, float).reshape(-1, 2)
    return ResolutionLadder(curve, tolerance).resolution(table[:, 0], table[:, 1])
