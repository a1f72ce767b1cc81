"""Approximate inverses of the operator of a suspension."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from stokes.formulation import ShapeSolver
from stokes.suspension_layout import Field, Layout


class Preconditioner(Protocol):
    """A map from residuals to unknowns, linear and the same at every call unless `flexible`.

    What a residual and an unknown are, and in which frames and units, `suspension_layout` says.

    flexible : whether it changes a little from call to call, as one that iterates itself does
    nbytes   : of what it holds beside the shapes' operators, on this rank
    """

    flexible: bool
    nbytes: int

    def apply(self, residual: Field) -> Field:
        """Collective. Approximate unknowns of a residual; `rigid` is None if it is given as None.

        residual : (velocity (n, 3), load (b, 6) or None), not to be changed
        returns  : (density (n, 3), motion (b, 6) or None)
        """


class BodyPreconditioner:
    """The exact inverse of every body alone in the fluid."""

    flexible = False
    nbytes = 0

    def __init__(self, layout: Layout, solvers: Mapping[int, ShapeSolver]) -> None:
        """Take the bodies of this rank and the solver of each of their shapes."""
        self._layout, self._solvers = layout, solvers

    def apply(self, residual: Field) -> Field:
        """Solve for every body alone; not collective, as no rank needs another one's bodies."""
        density = np.empty_like(residual.nodal)
        motion = None if residual.rigid is None else np.empty_like(residual.rigid)
        for group in self._layout.groups:
            solver = self._solvers[group.shape]
            velocity = group.columns(residual.nodal)
            if motion is None:
                group.put(density, solver.solve(velocity))
                continue
            load = residual.rigid[group.bodies].T
            solved, translation, rotation = solver.solve_mobility(velocity, load[:3], load[3:])
            group.put(density, solved)
            motion[group.bodies] = np.concatenate([translation, rotation]).T
        return Field(density, motion)
