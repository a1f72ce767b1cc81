"""Forces that all bodies exert on each other, solved for at once in a preconditioner.

With motions given, the forces on the bodies are unknown, and a force is felt by all other bodies:
the flow of one decays like 1/r, and what N bodies feel together grows with N. The inverse of every
body alone, or of every close pair, knows nothing of that, and its iterations grow in number with
the suspension. (With forces given they do not: what is left then decays like 1/r^2.)

A residual velocity r moves a body, were it free, by U_i = R_i^-1 F_i, F_i the force of body i alone
with r on its surface. What remains of r makes no force. Between forces the flow is known well
enough from their places (J. Rotne, S. Prager, J. Chem. Phys. 50, 4831, 1969, for unequal spheres):

    M_ij = 1/(8 pi r) ((1 + s/(3 r^2)) 1 + (1 - s/r^2) e e^T),   s = a_i^2 + a_j^2,   M_ii = R_i^-1.

With N what of M the inner preconditioner knows already, its answer to r is changed by what every
body alone makes of the velocity N M^-1 U - U. (Not by what the inner preconditioner makes of it:
bodies in touch then seem to approach each other, where they are carried by one smooth flow.)

Symbols: B bodies of all ranks, b of this one; viscosity 1; a_i radius of the sphere with the drag.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from dem_mpi.parallel import Parallel
from stokes.formulation import ShapeSolver
from stokes.preconditioner import BodyPreconditioner, Preconditioner
from stokes.suspension_layout import Field
from stokes.suspension_surfaces import OwnSurfaces
from stokes.suspension_table import BodyTable

MOST_BODIES = 1000
"""Of a suspension for which a dense matrix of (3 B)^2 numbers on each rank is no burden."""


class CoarseForces:
    """A preconditioner for given motions, and around it the forces between all bodies.

    flexible, nbytes : as of every `Preconditioner`
    """

    def __init__(
        self,
        inner: Preconditioner,
        alone: BodyPreconditioner,
        known: NDArray,
        surfaces: OwnSurfaces,
        solvers: Mapping[int, ShapeSolver],
        table: BodyTable,
        parallel: Parallel,
    ) -> None:
        """Collective. The inner preconditioner may be that of bodies `alone` itself.

        known : pairs (k, 2) of numbers of a body here and another that `inner` knows of
        """
        self._inner, self._alone = inner, alone
        self._surfaces, self._solvers = surfaces, solvers
        self._parallel = parallel
        self._rows = table.own[surfaces.layout.order]
        self._count = table.count
        self._responses = {
            group.shape: solvers[group.shape].solve(solvers[group.shape].rigid_motions[..., :3])
            for group in surfaces.layout.groups
        }
        resistance = self._gathered(self._resistances())
        pairs = np.zeros((table.count, table.count), dtype=np.int64)
        pairs[known[:, 0], known[:, 1]] = 1
        pairs = parallel.max(np.maximum(pairs, pairs.T)).astype(bool)
        mobility = _mobility(table.centre, resistance)
        self._factors = lu_factor(_flat(mobility))
        mobility[~(pairs | np.eye(table.count, dtype=bool))] = 0.0
        self._known = _flat(mobility)[(3 * self._rows[:, None] + np.arange(3)).ravel()]
        self.flexible = inner.flexible
        self.nbytes = inner.nbytes + self._factors[0].nbytes + self._known.nbytes

    def apply(self, residual: Field) -> Field:
        """Collective. Approximate densities of residual velocities."""
        if residual.rigid is not None:
            raise ValueError("loads are given: forces between bodies are known")
        density = alone = self._alone.apply(residual).nodal
        if self._inner is not self._alone:
            density = self._inner.apply(residual).nodal
        given = self._motions(alone)
        forces = lu_solve(self._factors, self._gathered(given).ravel())
        wanted = (self._known @ forces).reshape(-1, 3)
        change = np.einsum("bji,bj->bi", self._surfaces.rotation, wanted - given)
        for group in self._surfaces.layout.groups:
            moved = self._responses[group.shape] @ change[group.bodies].T
            group.view(density)[...] += np.moveaxis(moved, -1, 0)
        return Field(density)

    def _motions(self, density: NDArray) -> NDArray:
        """Velocities (b, 3) in the world of bodies, each alone, with the loads of densities."""
        local = np.empty((self._surfaces.layout.bodies, 3))
        for group in self._surfaces.layout.groups:
            solver = self._solvers[group.shape]
            single_layer, _ = solver.layers(group.columns(density))
            motion = np.linalg.solve(solver.resistance, solver.loads(single_layer))
            local[group.bodies] = motion[:3].T
        return np.einsum("bij,bj->bi", self._surfaces.rotation, local)

    def _resistances(self) -> NDArray:
        """R (b, 3, 3) of this rank's bodies alone, free to turn, in the world's frame."""
        unit = np.empty((self._surfaces.layout.bodies, 3, 3))
        for group in self._surfaces.layout.groups:
            mobility = np.linalg.inv(self._solvers[group.shape].resistance)
            unit[group.bodies] = np.linalg.inv(mobility[:3, :3])
        turn = self._surfaces.rotation
        return self._surfaces.scale[:, None, None] * (turn @ unit @ np.swapaxes(turn, 1, 2))

    def _gathered(self, own: NDArray) -> NDArray:
        """Collective. Values (B, ...) of all bodies by number, of those (b, ...) of this rank's."""
        every = np.zeros((self._count, *own.shape[1:]))
        every[self._rows] = own
        self._parallel.sum_in_place(every)
        return every


def _mobility(centre: NDArray, resistance: NDArray) -> NDArray:
    """M (B, B, 3, 3) of the head of this module."""
    count = len(centre)
    r = centre[:, None] - centre
    distance = np.linalg.norm(r, axis=2)
    np.fill_diagonal(distance, 1.0)
    e = r / distance[:, :, None]
    radius = np.trace(resistance, axis1=1, axis2=2) / (18.0 * math.pi)
    s = (radius[:, None] ** 2 + radius**2) / distance**2
    mobility = (1.0 - s)[:, :, None, None] * (e[:, :, :, None] * e[:, :, None, :])
    mobility[:, :, range(3), range(3)] += (1.0 + s / 3.0)[:, :, None]
    mobility /= (8.0 * math.pi * distance)[:, :, None, None]
    mobility[range(count), range(count)] = np.linalg.inv(resistance)
    return mobility


def _flat(blocks: NDArray) -> NDArray:
    """Blocks (B, B, 3, 3) as one matrix (3 B, 3 B)."""
    size = 3 * len(blocks)
    return np.swapaxes(blocks, 1, 2).reshape(size, size)
