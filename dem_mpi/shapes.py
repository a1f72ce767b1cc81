"""Geometry and mass properties of body shapes, vectorised over bodies.

Symbols: n bodies; lengths in m, masses in kg.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sphere_volume(radius: NDArray) -> NDArray:
    """V = 4/3 π r³ [m³] of spheres of `radius` (n,) [m]."""
    return 4.0 / 3.0 * np.pi * radius**3


def sphere_inertia(mass: NDArray, radius: NDArray) -> NDArray:
    """I = 2/5 m r² [kg m²] about any axis through the centre, of homogeneous spheres (n,)."""
    return 0.4 * mass * radius**2


def sphere_bounding_radius(radius: NDArray) -> NDArray:
    """The radius (n,) [m] about the body's position that contains it: for a sphere, its own."""
    return radius
