"""Meridians, surface grids and rigid bodies of revolution.

Local frame of a body: z along the axis of symmetry, the unit shape given by its generating curve.
A point x of that frame lies at centre + scale R x, R from the unit quaternion, scalar first; the
third column of R is the axis. Surface grids are nodes of the meridian by equal angles; arrays of
nodes have shape (n_s, n_theta, ...), n_theta = 2 modes + 1, theta_k = 2 pi k/n_theta.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes.curves import (
    Curve,
    CurvePoints,
    fourier_curve,
    sphere,
    spherocylinder,
    spheroid,
    spline_curve,
)
from stokes.distance import Gaps, close_pairs, distance, gaps, gaps_of_pairs
from stokes.resolution import Resolution, ResolutionLadder, resolution_for

__all__ = [
    "Body",
    "Curve",
    "CurvePoints",
    "Gaps",
    "Meridian",
    "Resolution",
    "ResolutionLadder",
    "SurfaceGrid",
    "close_pairs",
    "distance",
    "fourier_curve",
    "gaps",
    "gaps_of_pairs",
    "resolution_for",
    "sphere",
    "spherocylinder",
    "spheroid",
    "spline_curve",
]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Meridian:
    """Gauss-Legendre nodes on the panels of a generating curve; arrays (n_s,), n_s = size."""

    curve: Curve
    resolution: Resolution

    @property
    def size(self) -> int:
        """Number of nodes n_s."""
        return self.resolution.meridian_nodes

    @cached_property
    def s(self) -> Array:
        """Parameters of the nodes, rising."""
        return self.resolution.parameters

    @cached_property
    def points(self) -> CurvePoints:
        """Nodes with derivatives."""
        return self.curve.evaluate(self.s)

    @property
    def r(self) -> Array:
        """Distance from the axis."""
        return self.points.r

    @property
    def z(self) -> Array:
        """Coordinate along the axis."""
        return self.points.z

    @property
    def dr(self) -> Array:
        """r'(s)."""
        return self.points.dr

    @property
    def dz(self) -> Array:
        """z'(s)."""
        return self.points.dz

    @cached_property
    def speed(self) -> Array:
        """|gamma'(s)|."""
        return self.points.speed

    @cached_property
    def normal_r(self) -> Array:
        """Radial component of the outward normal."""
        return self.points.normal_r

    @cached_property
    def normal_z(self) -> Array:
        """Axial component of the outward normal."""
        return self.points.normal_z

    @cached_property
    def curvatures(self) -> Array:
        """Principal curvatures along and across the meridian, (n_s, 2); 1/R on a sphere."""
        points = self.points
        return np.stack([points.meridional_curvature, points.azimuthal_curvature], axis=-1)

    @cached_property
    def weights(self) -> Array:
        """Weights of integrals over the arc length: Gauss weights times |gamma'|."""
        edges = np.array(self.resolution.breaks)
        _, gauss = np.polynomial.legendre.leggauss(self.resolution.nodes)
        return (0.5 * np.diff(edges)[:, None] * gauss).ravel() * self.speed

    @cached_property
    def panel(self) -> NDArray[np.int64]:
        """Panel of each node."""
        return np.repeat(np.arange(self.resolution.panels), self.resolution.nodes)

    @cached_property
    def area(self) -> float:
        """Area of the surface of revolution."""
        return float(2 * np.pi * np.sum(self.weights * self.r))

    @cached_property
    def volume(self) -> float:
        """Volume inside, from the flux of x/3."""
        flux = self.r * self.normal_r + self.z * self.normal_z
        return float(2 * np.pi / 3 * np.sum(self.weights * self.r * flux))


@dataclass(frozen=True)
class SurfaceGrid:
    """Nodes of a meridian at equal angles: the surface of the unit shape in its own frame."""

    meridian: Meridian

    @property
    def shape(self) -> tuple[int, int]:
        """(n_s, n_theta)."""
        return self.meridian.size, self.meridian.resolution.angles

    @cached_property
    def theta(self) -> Array:
        """Angles 2 pi k/n_theta about the axis."""
        return 2 * np.pi * np.arange(self.shape[1]) / self.shape[1]

    @cached_property
    def points(self) -> Array:
        """Nodes x, y, z: (n_s, n_theta, 3)."""
        return self._turn(self.meridian.r, self.meridian.z)

    @cached_property
    def normals(self) -> Array:
        """Outward unit normals: (n_s, n_theta, 3)."""
        return self._turn(self.meridian.normal_r, self.meridian.normal_z)

    @cached_property
    def weights(self) -> Array:
        """Weights of surface integrals: (n_s, n_theta)."""
        ring = 2 * np.pi / self.shape[1] * self.meridian.weights * self.meridian.r
        return np.repeat(ring[:, None], self.shape[1], axis=1)

    @property
    def area(self) -> float:
        """Area of the surface."""
        return self.meridian.area

    @property
    def volume(self) -> float:
        """Volume inside the surface."""
        return self.meridian.volume

    def to_cylindrical(self, vectors: Array) -> Array:
        """Turn Cartesian components (n_s, n_theta, 3, ...) to (radial, azimuthal, axial)."""
        return self._rotate(vectors, 1.0)

    def to_cartesian(self, vectors: Array) -> Array:
        """Turn components (radial, azimuthal, axial) to Cartesian ones, (n_s, n_theta, 3, ...)."""
        return self._rotate(vectors, -1.0)

    def _turn(self, radial: Array, axial: Array) -> Array:
        return np.stack(
            [
                radial[:, None] * np.cos(self.theta),
                radial[:, None] * np.sin(self.theta),
                np.repeat(axial[:, None], len(self.theta), axis=1),
            ],
            axis=-1,
        )

    def _rotate(self, vectors: Array, sense: float) -> Array:
        angles = self.theta.reshape(-1, *[1] * (vectors.ndim - 3))
        c, s = np.cos(angles), sense * np.sin(angles)
        x, y = vectors[:, :, 0], vectors[:, :, 1]
        return np.stack([c * x + s * y, c * y - s * x, vectors[:, :, 2]], axis=2)


@dataclass(frozen=True)
class Body:
    """A rigid body: x_world = centre + scale R x_local.

    centre : 3 lengths; quaternion : (w, x, y, z), scaled to length one. ValueError for a scale
    that is not positive or a zero quaternion.
    """

    curve: Curve
    scale: float = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        centre, quaternion = np.array(self.centre, float), np.array(self.quaternion, float)
        length = np.sqrt(quaternion @ quaternion) if quaternion.shape == (4,) else np.nan
        if centre.shape != (3,) or not np.isfinite(centre).all():
            raise ValueError(f"Body: centre {self.centre}: need three finite lengths")
        if not (self.scale > 0 and np.isfinite(self.scale)):
            raise ValueError(f"Body: scale {self.scale} must be > 0")
        if not (length > 0 and np.isfinite(length)):
            raise ValueError(f"Body: quaternion {self.quaternion}: need four numbers, not all zero")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "centre", tuple(centre.tolist()))
        object.__setattr__(self, "quaternion", tuple((quaternion / length).tolist()))

    @cached_property
    def rotation(self) -> Array:
        """R (3, 3): local to world components."""
        w, x, y, z = self.quaternion
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    @property
    def axis(self) -> Array:
        """Axis of symmetry, from south to north."""
        return self.rotation[:, 2]

    @property
    def bounding_radius(self) -> float:
        """Radius of a ball about the centre that holds the body."""
        return self.scale * self.curve.bounding_radius

    def to_world(self, points: ArrayLike) -> Array:
        """Return world positions of local points (..., 3) of the unit shape."""
        return np.asarray(self.centre) + self.scale * self.vectors_to_world(points)

    def to_local(self, points: ArrayLike) -> Array:
        """Return positions in the frame of the unit shape of world points (..., 3)."""
        return self.vectors_to_local(np.asarray(points, float) - self.centre) / self.scale

    def vectors_to_world(self, vectors: ArrayLike) -> Array:
        """Rotate vectors (..., 3) from the body's frame to the world's."""
        return np.asarray(vectors, float) @ self.rotation.T

    def vectors_to_local(self, vectors: ArrayLike) -> Array:
        """Rotate vectors (..., 3) from the world's frame to the body's."""
        return np.asarray(vectors, float) @ self.rotation
