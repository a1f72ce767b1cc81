"""Driven walls: where the planes are and how fast they move over a step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem_mpi.contacts import ContactSet, Walls
from dem_mpi.scenario import WallFaces


def displacement(faces: WallFaces, time: float) -> NDArray:
    """Return the shift (w, 3) [m] of each face: v t + A (sin(2 pi f t + phase) - sin(phase))."""
    swing = np.sin(2.0 * np.pi * faces.frequency * time + faces.phase) - np.sin(faces.phase)
    return faces.velocity * time + faces.amplitude * swing[:, None]


def walls_at(faces: WallFaces, time: float, step: float) -> Walls:
    """Return the faces as they stand at `time` [s], with their mean velocity over the step.

    The mean velocity, not the instant's, so that contact impulses and positions agree: after the
    step the wall is where its velocity has taken it.
    """
    now = displacement(faces, time)
    velocity = (displacement(faces, time + step) - now) / step
    return Walls(faces.point + now, faces.normal, velocity, faces.material)


def contact_velocity_of_walls(contacts: ContactSet, walls: Walls) -> NDArray | None:
    """Return the world velocity (m, 3) [m/s] of b where b is a wall; None if no wall moves."""
    if not walls.velocity.any():
        return None
    velocity = np.zeros((contacts.count, 3))
    rows = np.flatnonzero(contacts.b < 0)
    velocity[rows] = walls.velocity[-contacts.b[rows] - 1]
    return velocity
