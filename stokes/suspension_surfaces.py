"""Nodes of one rank's bodies, and the way between the frames of bodies and the world.

Arrays of nodes (n, 3) are in the order of the layout, except those called `given`: these are in
the order in which the bodies were given, body after body, each (n_s, n_theta) in C order. Frames
are the solver's, in which spheres have been turned, except those called `given`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stokes.geometry import Body, SurfaceGrid
from stokes.sources import UnitShape
from stokes.suspension_layout import Layout


class OwnSurfaces:
    """The surfaces of this rank's bodies.

    bodies : as solved for, in the order of the layout's rows; given: as given, in the same order
    scale (b,), centre (b, 3), rotation (b, 3, 3) local to world : of `bodies`
    """

    def __init__(
        self,
        layout: Layout,
        shapes: Sequence[UnitShape],
        bodies: Sequence[Body],
        given: Sequence[Body],
    ) -> None:
        """Shapes by number; bodies in the layout's order."""
        self.layout, self.bodies, self.given = layout, tuple(bodies), tuple(given)
        self.grids = {g.shape: SurfaceGrid(shapes[g.shape].meridian) for g in layout.groups}
        self.scale = np.array([body.scale for body in bodies])
        self.centre = np.array([body.centre for body in bodies]).reshape(-1, 3)
        self.rotation = np.array([body.rotation for body in bodies]).reshape(-1, 3, 3)

    @cached_property
    def points(self) -> NDArray:
        """Nodes (n, 3) in the world."""
        return self.per_body(self.scale)[:, None] * self.to_world(self.arms) + self.per_body(
            self.centre
        )

    @cached_property
    def arms(self) -> NDArray:
        """Nodes (n, 3) of the unit shapes, in their frames."""
        return self._repeated([(g, self.grids[g.shape].points) for g in self.layout.groups], (3,))

    @cached_property
    def normals(self) -> NDArray:
        """Outward unit normals (n, 3) in the bodies' frames."""
        return self._repeated([(g, self.grids[g.shape].normals) for g in self.layout.groups], (3,))

    @cached_property
    def weights(self) -> NDArray:
        """Weights (n,) of integrals over the surfaces in the world."""
        unit = self._repeated([(g, self.grids[g.shape].weights) for g in self.layout.groups], ())
        return self.per_body(self.scale) ** 2 * unit

    @cached_property
    def area(self) -> NDArray:
        """Areas (b,)."""
        return self.sum_over_bodies(self.weights)

    def per_body(self, values: NDArray) -> NDArray:
        """Values (b, ...) of bodies, repeated for their nodes (n, ...)."""
        return np.repeat(values, np.diff(self.layout.offsets), axis=0)

    def sum_over_bodies(self, values: NDArray) -> NDArray:
        """Sums (b, ...) over each body's nodes of values (n, ...)."""
        return np.add.reduceat(
            np.concatenate([values, np.zeros((1, *values.shape[1:]))]), self.layout.offsets
        )[: self.layout.bodies]

    def to_local(self, vectors: NDArray) -> NDArray:
        """Vectors (n, 3) at the nodes, from the world's frame to the bodies'."""
        return self._turned(vectors, self.rotation)

    def to_world(self, vectors: NDArray) -> NDArray:
        """Vectors (n, 3) at the nodes, from the bodies' frames to the world's."""
        return self._turned(vectors, np.swapaxes(self.rotation, 1, 2))

    @cached_property
    def given_order(self) -> NDArray:
        """Rows (n,) of the nodes in the order in which bodies were given: values[given_order]."""
        parts = [self.layout.range_of(row) for row in self.layout.rows.tolist()]
        return np.concatenate([np.empty(0, dtype=np.int64), *parts])

    def _turned(self, vectors: NDArray, rotation: NDArray) -> NDArray:
        turned = np.empty_like(vectors)
        for group in self.layout.groups:
            rows = vectors[group.nodes].reshape(group.count, -1, 3)
            turned[group.nodes] = (rows @ rotation[group.bodies]).reshape(-1, 3)
        return turned

    def _repeated(self, parts: Sequence, trailing: tuple[int, ...]) -> NDArray:
        values = np.empty((self.layout.nodes, *trailing))
        for group, unit in parts:
            group.view(values)[...] = unit
        return values
