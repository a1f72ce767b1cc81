"""Close panels summed from refined nodes instead of their own, for targets not too close.

Nothing is stored but lists: refined densities are made anew by every application, some thousand
nodes at a time, and summed by the loops over pairs of the fast sums' near field.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stokes._scatter import Scatter
from stokes.fmm.near_field import NearField as PairSums
from stokes.layers import Layers
from stokes.near_panels import ClosePanels
from stokes.sources import PanelSources, Surfaces

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Nodes whose weights are held at once: they stay in the second-level cache.
_CHUNK_NODES = 50_000


class RefinedPanels:
    """Sums over refined panels, for pairs that have a refinement, less those over all as they are.

    nodes: of refined panels, which are made by each application
    """

    def __init__(
        self,
        surfaces: Surfaces,
        layers: Layers,
        targets: Array,
        close: ClosePanels,
        threads: int,
    ) -> None:
        """Targets (t, 3) in the world."""
        body, target = close.body[close.pair], close.target[close.pair]
        plain = np.ones_like(close.by)
        finer = ~close.exact
        self._parts = [
            *_parts(surfaces, targets, -1.0, body, close.panel, plain, target),
            *_parts(
                *(surfaces, targets, 1.0, body[finer], close.panel[finer]),
                *(close.by[finer], target[finer]),
            ),
        ]
        self._surfaces, self._layers = surfaces, layers
        self._sums = [
            None if kernel is None else PairSums(kernel, threads=threads)
            for kernel in layers.kernels
        ]
        self.nodes = sum(part.sources.count for part in self._parts if part.sign > 0.0)

    @property
    def bytes(self) -> int:
        """Of targets, lists, refined unit shapes and one part's weights."""
        held = sum(part.targets.nbytes + part.ranges.nbytes for part in self._parts)
        held += sum(shape.refined_bytes for shape in self._surfaces.shapes)
        return held + max((72 * part.sources.count for part in self._parts), default=0)

    def add(self, density: Array, out: Array) -> None:
        """Add to out (t, rows, m) for a density (n, 3, m)."""
        for part in self._parts:
            points = np.ascontiguousarray(part.sources.points.T)
            values = np.zeros((density.shape[2], out.shape[1], part.targets.shape[1]))
            weights = part.sources.weights(density, self._layers.single, self._layers.double)
            for sums, columns in zip(self._sums, weights, strict=True):
                if sums is not None:
                    columns = np.ascontiguousarray(columns.transpose(2, 1, 0))
                    sums.add(
                        *(part.targets, part.ranges, points, columns),
                        *(part.start, part.lists, values),
                    )
            part.scatter.add(part.sign * values.transpose(2, 1, 0), out)


@dataclass(frozen=True)
class _Part:
    """Some panels, each with a group of targets: what one call of the loops over pairs sums."""

    sign: float
    sources: PanelSources
    targets: Array
    ranges: Index
    start: Index
    lists: Index
    scatter: Scatter


def _parts(
    surfaces: Surfaces,
    targets: Array,
    sign: float,
    body: Index,
    panel: Index,
    by: Index,
    target: Index,
) -> list[_Part]:
    """Parts for pairs (e,) of a panel of a body, refined so, and a target."""
    if len(body) == 0:
        return []
    shape = surfaces.shape[body]
    # panels of one shape that are refined alike stand together
    keys = np.column_stack([shape, by, body, panel])
    groups, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    order = np.argsort(group, kind="stable")
    edges = np.searchsorted(group[order], np.arange(len(groups) + 1))
    size = np.array([s.panel_nodes for s in surfaces.shapes])[groups[:, 0]]
    chunk = np.cumsum(size * groups[:, 1] * groups[:, 2]) // _CHUNK_NODES
    cuts = [0, *(np.flatnonzero(np.diff(chunk)) + 1).tolist(), len(groups)]
    parts = []
    for first, last in itertools.pairwise(cuts):
        members = order[edges[first] : edges[last]]
        chosen = groups[first:last]
        sources = PanelSources(surfaces, chosen[:, 3], chosen[:, 4], chosen[:, 1:3])
        ranges = edges[first : last + 1] - edges[first]
        parts.append(
            _Part(
                sign,
                sources,
                np.ascontiguousarray(targets[target[members]].T),
                _ranges(ranges[:-1], ranges[1:]),
                np.arange(last - first + 1),
                _ranges(sources.begin, sources.end),
                Scatter(target[members]),
            )
        )
    return parts


def _ranges(begin: Index, end: Index) -> Index:
    return np.ascontiguousarray(np.stack([begin, end], axis=1), dtype=np.int64)
