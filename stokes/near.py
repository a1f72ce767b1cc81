"""Corrections of a fast sum over surface nodes at targets close to surfaces.

A sum over the nodes of all bodies takes each surface by its plain product rule, whose error decays
like e^{-N xi} about the axis and rho^{-2q} on a panel (`_kernels_near`): at most a few panels of
the closest bodies miss the tolerance at a target. Which, and how finely they would have to be
resolved to meet it, is known in closed form. For such pairs of target and panel the plain sum is
taken back, and the panel's potential added

- from refined panels, by the same sums over pairs, where a few times as many nodes will do: nothing
  is stored, and a pair of points costs less than a nanosecond;
- else exactly up to the tolerance, also on the surface itself (the limit from outside): azimuthal
  modes of the kernels at nodes graded towards the target make a block of
  9 x nodes of a panel x (modes + 1) numbers, which acts on the density's modes.

The density is what its nodal values say: a trigonometric polynomial in the azimuth, on each panel
a polynomial in s. Errors are relative to the largest density; modes and Legendre coefficients of
the density are assumed to have decayed to the tolerance at the resolution's ends.

Measured on one core of a Zen 5: 27 unit spheres on a cubic lattice, each of 5 panels x 10 nodes x
51 azimuths (69,000 nodes in all); a fast sum over them takes 0.31 s for S at 1e-6.

    gap   tolerance  layers   pairs  with blocks   MB of blocks   s to plan   s to apply
    0.1     1e-6     S       13,818          433              4         0.3         0.06
    0.1     1e-6     S, D    29,990          648              6         0.4         0.24
    0.1     1e-8     S       30,656        1,121             21         0.4         0.14
    0.1     1e-8     S, D    52,714        1,506             28         0.7         0.37
    0.01    1e-6     S       25,225        5,438             51         1.2         0.12
    0.01    1e-6     S, D    44,398        7,134             67         2.9         0.35
    0.01    1e-8     S, D    71,157        9,480            178         4.1         0.48

Dense blocks (3 x 3 x nodes of the panel, in double precision) would take 37 kB a pair: 0.5 GB in
the first line. Refining all sources of the fast sum instead, twice in both directions, would make
it four times as large, and still leave corrections to the closest targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes.geometry import Body, Resolution
from stokes.layers import Layers, Quantity
from stokes.near_blocks import PanelBlocks
from stokes.near_panels import ClosePanels, reach
from stokes.near_refined import RefinedPanels
from stokes.sources import Surfaces

__all__ = ["Layers", "NearField", "NearReport", "Quantity", "reach"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NearReport:
    """What a near field is made of, on this rank.

    pairs : close pairs (target, panel); refined, exact: how many are summed on refined panels, by
    blocks; sources: nodes on refined panels; bytes: of blocks and sources
    """

    pairs: int = 0
    refined: int = 0
    exact: int = 0
    sources: int = 0
    bytes: int = 0


class NearField:
    """What sums over plain rules miss at given targets, as a linear map of the densities."""

    def __init__(
        self,
        bodies: Sequence[Body],
        resolutions: Sequence[Resolution],
        targets: ArrayLike,
        layers: Layers,
        tolerance: float = 1e-6,
        owner: ArrayLike | None = None,
        threads: int = 1,
        applications: int = 20,
        block_memory: float = 2e9,
    ) -> None:
        """Find close pairs and make the blocks of those that need them. Not collective.

        bodies    : with the resolution of each: all that have targets within their `reach`
        targets   : (t, 3) in the world; on a surface the limit from outside is meant
        tolerance : of each panel's potential in its unit frame, relative to the largest density
        owner     : (t,) body that a target is a node of, which is left out; -1 for none
        applications : how many are expected, that blocks are to pay for
        block_memory : most bytes of blocks that others than the very closest pairs are given

        Raises ValueError for shapes that do not fit, or a tolerance outside (1e-14, 1).
        """
        points = np.ascontiguousarray(targets, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"targets of shape {points.shape}: must be (t, 3)")
        if not 1e-14 < tolerance < 1.0:
            raise ValueError(f"tolerance = {tolerance}: must be between 1e-14 and 1")
        self.surfaces, self._layers = Surfaces(bodies, resolutions), layers
        self._count = len(points)
        owner = None if owner is None else np.asarray(owner, np.int64)
        close = ClosePanels.find(
            *(self.surfaces, points, layers, tolerance, owner),
            *(threads, applications, block_memory),
        )
        self._refined = RefinedPanels(self.surfaces, layers, points, close, threads)
        self._blocks = PanelBlocks(self.surfaces, layers, close, tolerance, threads)
        exact = int(np.count_nonzero(close.exact))
        self.report = NearReport(
            pairs=len(close.pair),
            refined=len(close.pair) - exact,
            exact=exact,
            sources=self._refined.nodes,
            bytes=self._refined.bytes + self._blocks.bytes,
        )

    def apply(self, density: ArrayLike) -> Array:
        """Corrections (t, rows[, m]) in world components of the densities (n, 3[, m]).

        density : as `stokes.sources` has it, of all bodies of this near field. Rows are 3, for
        pressures 1, for stresses 6 in the order 00, 11, 22, 12, 02, 01.
        """
        values = self.surfaces.density(density)
        out = np.zeros((self._count, self._layers.rows, values.shape[2]))
        self._refined.add(values, out)
        self._blocks.add(values, out)
        return out if np.ndim(density) == 3 else out[:, :, 0]
