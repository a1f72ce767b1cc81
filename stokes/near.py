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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes._scatter import Scatter
from stokes.fmm.kernels import Kernel
from stokes.fmm.near_field import NearField as PairSums
from stokes.geometry import Body, Resolution
from stokes.layers import Layers, Quantity
from stokes.near_blocks import PanelBlocks
from stokes.near_panels import ClosePanels, reach
from stokes.sources import PanelSources, Surfaces

__all__ = ["Layers", "NearField", "NearReport", "Quantity", "reach"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
    ) -> None:
        """Find close pairs and make the blocks of those that need them. Not collective.

        bodies    : with the resolution of each: all that have targets within their `reach`
        targets   : (t, 3) in the world; on a surface the limit from outside is meant
        tolerance : of each panel's potential in its unit frame, relative to the largest density
        owner     : (t,) body that a target is a node of, which is left out; -1 for none

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
        close = ClosePanels.find(self.surfaces, points, layers, tolerance, owner, threads)
        self._refined = _RefinedPanels(self.surfaces, layers, points, close, threads)
        self._blocks = PanelBlocks(self.surfaces, layers, close, tolerance, threads)
        exact = int(np.count_nonzero(close.exact))
        self.report = NearReport(
            pairs=len(close.pair),
            refined=len(close.pair) - exact,
            exact=exact,
            sources=len(self._refined.sources.points),
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


class _RefinedPanels:
    """Sums over refined panels less those over the panels as they are, by close pair."""

    def __init__(
        self,
        surfaces: Surfaces,
        layers: Layers,
        targets: Array,
        close: ClosePanels,
        threads: int,
    ) -> None:
        self.layers, self.threads = layers, threads
        keys = np.column_stack([close.body[close.pair], close.panel, close.by])
        groups, group = np.unique(keys, axis=0, return_inverse=True)
        group = group.reshape(-1)
        order = np.argsort(group, kind="stable")
        target = close.target[close.pair[order]]
        self.targets = np.ascontiguousarray(targets[target].T)
        self._scatter = Scatter(target)
        self.ranges = _ranges(np.searchsorted(group[order], np.arange(len(groups) + 1)))
        plain, which = np.unique(groups[:, :2], axis=0, return_inverse=True)
        which = which.reshape(-1)
        finer = np.flatnonzero(groups[:, 2] > 0)
        every = np.concatenate([groups[finer], np.pad(plain, ((0, 0), (0, 2)), constant_values=1)])
        self.sources = PanelSources(surfaces, every[:, 0], every[:, 1], every[:, 2:])
        self._points = np.ascontiguousarray(self.sources.points.T)
        rows = np.stack([self.sources.begin, self.sources.end], axis=1)
        self._first_plain = int(self.sources.begin[len(finer)]) if len(groups) else 0
        # the list of each group: its refined panel, if any, then the panel as it is
        length = 1 + (groups[:, 2] > 0)
        self._start = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
        self._lists = np.empty((int(length.sum()), 2), np.int64)
        self._lists[self._start[1:] - 1] = rows[len(finer) + which]
        self._lists[self._start[finer]] = rows[: len(finer)]

    @property
    def bytes(self) -> int:
        """Of sources and targets."""
        return 2 * self._points.nbytes + self.targets.nbytes

    def add(self, density: Array, out: Array) -> None:
        """Add to out (t, rows, m)."""
        if self.targets.shape[1] == 0:
            return
        values = np.zeros((density.shape[2], out.shape[1], self.targets.shape[1]))
        weights = self.sources.weights(density, self.layers.single, self.layers.double)
        for kernel, columns in zip(self.layers.kernels, weights, strict=True):
            if kernel is not None:
                self._sum(kernel, columns, values)
        self._scatter.add(values.transpose(2, 1, 0), out)

    def _sum(self, kernel: Kernel, weights: Array, values: Array) -> None:
        weights[self._first_plain :] *= -1.0
        columns = np.ascontiguousarray(weights.transpose(2, 1, 0))
        sums = PairSums(kernel, threads=self.threads)
        sums.add(
            *(self.targets, self.ranges, self._points, columns),
            *(self._start, self._lists, values),
        )


def _ranges(edges: Index) -> Index:
    return np.ascontiguousarray(np.stack([edges[:-1], edges[1:]], axis=1), dtype=np.int64)
