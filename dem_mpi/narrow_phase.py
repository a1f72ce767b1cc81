"""Contacts of bodies of any axisymmetric shape, from the list of near pairs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_narrow as kernels
from dem_mpi.contacts import ContactSet, DetectionOptions, Neighbours
from dem_mpi.walls import Walls


def find_general_contacts(
    neighbours: Neighbours,
    position: NDArray,
    axis: NDArray,
    predicted: NDArray,
    angular_velocity: NDArray,
    walls: Walls,
    options: DetectionOptions,
    step: float,
) -> ContactSet:
    """Measure the listed pairs and all walls, and keep those within the margin.

    The counterpart of `contacts.find_contacts` for bodies that are not all spheres: gaps are
    compared with smallest sizes instead of radii, speeds of surfaces follow from bounding radii,
    and arms are vectors (m, 6). A pair, or a body and a wall, may touch twice.

    position, axis, predicted, angular_velocity : (n + g, 3), ghosts current.
    """
    n = neighbours
    assert n.form is not None, "a list made for spheres"
    row = np.zeros(n.halo.owned + 1, dtype=np.int64)
    motion = (position, axis, n.form, n.radius, predicted, angular_velocity)
    others = (
        n.material, options.friction, n.offset, n.neighbour, walls.rows(), walls.material, step,
        options.margin,
    )  # fmt: skip
    kernels.count_contacts.using(options.threads)(*motion, *others, row)
    np.cumsum(row, out=row)
    m = int(row[-1])
    contacts = (
        np.empty(m, dtype=np.int32),
        np.empty(m, dtype=np.int32),
        np.empty(m, dtype=np.int64),
        np.empty((m, 3)),
        np.empty(m),
        np.empty((m, 6)),
        np.empty(m),
    )
    coincident = np.zeros(n.halo.owned, dtype=np.int32)
    kernels.fill_contacts.using(options.threads)(
        *motion, n.gid, *others, row, *contacts, coincident
    )
    a, b, other, normal, gap, arm, friction = contacts
    return ContactSet(a, b, other, row, normal, gap, arm, friction, int(coincident.sum()))
