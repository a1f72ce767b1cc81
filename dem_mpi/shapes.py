"""Size and mass properties of homogeneous axisymmetric bodies, vectorised over bodies.

The shapes are numbered by their place in `scene_bodies.SHAPES`. The symmetry axis is the z axis
of the body.

    SPHERE          of `radius`
    SPHEROCYLINDER  a cylinder of `radius` between two half spheres; `half_length` is half the
                    cylinder's length, from the centre to the centre of a cap
    SPHEROID        `radius` is the equatorial semi-axis, `half_length` the polar one

Symbols: n bodies; r radius, l half length; lengths in m, masses in kg.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem_mpi.scene_bodies import SHAPES

SPHERE = SHAPES.index("sphere")
SPHEROCYLINDER = SHAPES.index("spherocylinder")
SPHEROID = SHAPES.index("spheroid")


def sphere_volume(radius: NDArray) -> NDArray:
    """V = 4/3 π r³ [m³] of spheres of `radius` (n,) [m]."""
    return 4.0 / 3.0 * np.pi * radius**3


def volume(shape: NDArray, radius: NDArray, half_length: NDArray) -> NDArray:
    """V [m³] of bodies (n,): of a spherocylinder 4/3 π r³ + 2 π r² l, of a spheroid 4/3 π r² l."""
    result = sphere_volume(radius)
    rod, spheroid = shape == SPHEROCYLINDER, shape == SPHEROID
    result[rod] += 2.0 * np.pi * radius[rod] ** 2 * half_length[rod]
    result[spheroid] *= half_length[spheroid] / radius[spheroid]
    return result


def inertia(
    shape: NDArray, mass: NDArray, radius: NDArray, half_length: NDArray
) -> tuple[NDArray, NDArray]:
    """Return the moments of inertia (n,) [kg m²] across and along the symmetry axis.

    Sphere 2/5 m r². Spheroid m (r² + l²)/5 across, 2/5 m r² along. Spherocylinder, with masses
    m_c of the cylinder and m_s of both caps: m_c (r²/4 + l²/3) + m_s (2/5 r² + 3/4 r l + l²)
    across, m_c r²/2 + 2/5 m_s r² along; a half sphere's centroid is 3/8 r from its flat side.
    """
    transverse = 0.4 * mass * radius**2
    axial = transverse.copy()
    rod, spheroid = shape == SPHEROCYLINDER, shape == SPHEROID
    m, r, l = mass[spheroid], radius[spheroid], half_length[spheroid]  # noqa: E741
    transverse[spheroid] = 0.2 * m * (r**2 + l**2)
    m, r, l = mass[rod], radius[rod], half_length[rod]  # noqa: E741
    caps = m / (1.0 + 1.5 * l / r)  # V_caps / V = 4/3 π r³ / (4/3 π r³ + 2 π r² l)
    cylinder = m - caps
    transverse[rod] = cylinder * (r**2 / 4.0 + l**2 / 3.0) + caps * (
        0.4 * r**2 + 0.75 * r * l + l**2
    )
    axial[rod] = (0.5 * cylinder + 0.4 * caps) * r**2
    return transverse, axial


def bounding_radius(shape: NDArray, radius: NDArray, half_length: NDArray) -> NDArray:
    """The radius (n,) [m] of the sphere about the centre that contains the body.

    `radius` itself, not a copy, where all bodies are spheres.
    """
    if not shape.any():
        return radius
    result = radius + np.where(shape == SPHEROCYLINDER, half_length, 0.0)
    return np.where(shape == SPHEROID, np.maximum(radius, half_length), result)


def smallest_size(shape: NDArray, radius: NDArray, half_length: NDArray) -> NDArray:
    """The radius (n,) [m] of the largest sphere about the centre inside the body.

    `radius` itself, not a copy, where no body is a spheroid.
    """
    if not (shape == SPHEROID).any():
        return radius
    return np.where(shape == SPHEROID, np.minimum(radius, half_length), radius)
