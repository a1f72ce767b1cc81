"""Exact potentials of single panels at close targets, as blocks that act on a density's modes.

A block is made of the kernels' azimuthal modes at nodes graded along the panel towards the target,
down to distances of 1e-13: 9 x nodes x (modes + 1) numbers, of velocities. Applied, it costs as
much as reading them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes import _kernels_near as kernels
from stokes._scatter import Scatter
from stokes.curves import Curve, CurvePoints
from stokes.fmm._threads import limited_threads
from stokes.layers import Layers
from stokes.modal import modal_kernel
from stokes.modes import to_modes
from stokes.near_panels import ClosePanels, NodeTables
from stokes.quadrature import gauss_legendre, interpolation_matrix
from stokes.sources import Surfaces, UnitShape

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Numbers of kernel values held at once while blocks are made.
_CHUNK_VALUES = 4_000_000
# From this tolerance on blocks are kept in single precision, unless the kernel is hypersingular.
_SINGLE = 1e-6
# Rows of a block that are odd in the azimuth.
_ODD = {
    "velocity": (False, True, False),
    "pressure": (False,),
    "stress": (False, True, False, False, True, False),
}
# Targets less than this inside, by round-off of world coordinates, are on the surface.
_ON_SURFACE = 1e-11
# Points, a step apart, that a value on the surface is extrapolated from.
_EXTRAPOLATED = 5


class PanelBlocks:
    """Exact potentials of single panels as matrices that act on the modes of the density."""

    def __init__(
        self,
        surfaces: Surfaces,
        layers: Layers,
        close: ClosePanels,
        tolerance: float,
        threads: int,
    ) -> None:
        """Make the blocks of the pairs marked `exact`, to this tolerance."""
        self.surfaces, self.layers, self.threads = surfaces, layers, threads
        self.tolerance = tolerance
        entries = np.flatnonzero(close.exact)
        # entries of one panel of one body, whose modes are made once, stand together
        body, panel = close.body[close.pair[entries]], close.panel[entries]
        entries = entries[np.lexsort((panel, body, surfaces.shape[body]))]
        self.pair, self.panel = close.pair[entries], close.panel[entries]
        self.body, self.theta = close.body[self.pair], close.theta[self.pair]
        self.shape = surfaces.shape[self.body]
        self._scatter = Scatter(close.target[self.pair])
        self._allocate()
        for h in np.unique(self.shape).tolist():
            members = np.flatnonzero(self.shape == h)
            self._fill(self.surfaces.shapes[h], members, close)
        if tolerance >= _SINGLE and layers.order < 2:
            self.block = self.block.astype(np.float32)

    @property
    def bytes(self) -> int:
        """Of the blocks."""
        return self.block.nbytes

    def _allocate(self) -> None:
        shapes = self.surfaces.shapes
        modes = np.array([s.resolution.modes for s in shapes], dtype=np.int64)
        width = np.array([3 * s.resolution.nodes for s in shapes], dtype=np.int64)
        self.n_max, self.width = modes[self.shape], width[self.shape]
        rows = self.layers.rows
        end = np.cumsum((self.n_max + 1) * rows * self.width)
        self.begin = end - (self.n_max + 1) * rows * self.width
        self.block = np.zeros(int(end[-1]) if len(end) else 0)

    def _fill(self, shape: UnitShape, members: Index, close: ClosePanels) -> None:
        pair = self.pair[members]
        gaps, weights = self._gaps(close.gap[pair, None], close.step[pair, None])
        samples = _Samples.of(shape, self.panel[members], close.s[pair], gaps, weights)
        rule = _GradedRule.of(shape, samples, self._rule_tolerance(samples))
        modes, rows = shape.resolution.modes, self.layers.rows
        most = max(1, _CHUNK_VALUES // ((modes + 1) * rows * 3))
        for chunk in rule.chunks(most):
            geometry = chunk.geometry(shape.curve)
            member = members[samples.entry[chunk.sample]]
            for name, layer in (("single", self.layers.single), ("double", self.layers.double)):
                if layer is None:
                    continue
                kind = f"{self.layers.quantity}_{name}"
                modal = modal_kernel(kind, *geometry, n_max=modes, threads=self.threads)
                factor = self._factor(layer)[self.body[member]]
                kernels.add_to_blocks(
                    *(modal, chunk.weight * factor, chunk.rows, member, self.begin, self.block)
                )

    def _rule_tolerance(self, samples: _Samples) -> float:
        """Relative to parts of the panel's potential, which exceed it where these cancel."""
        gap = min(1.0, np.abs(samples.distance).min(initial=1.0))
        parts = (0.1, 1.0, 1.0 / gap)[self.layers.order]
        return 0.01 * self.tolerance / (parts * np.abs(samples.weight).max(initial=1.0))

    def _factor(self, layer: ArrayLike) -> Array:
        """Numbers (b,) that turn a layer of unit shapes to the quantity in the world."""
        values = np.broadcast_to(np.asarray(layer, float), self.surfaces.bodies)
        return values if self.layers.quantity == "velocity" else values / self.surfaces.scale

    def _gaps(self, gap: Array, step: Array) -> tuple[Array, Array]:
        """Distances from the surface to evaluate each entry at, and weights: (e, k) twice."""
        side = np.where(gap < -_ON_SURFACE, -1.0, 1.0)
        if self.layers.order == 0:
            # on the surface: the limit from outside, to the error that the tolerance leaves
            least = 1e-3 * self.tolerance
            return np.where(np.abs(gap) < least, side * least, gap), np.ones_like(gap)
        k = np.arange(_EXTRAPOLATED + 1)
        binomial = np.array([math.comb(_EXTRAPOLATED, i) for i in k])
        weights = np.where(k > 0, (-1.0) ** (k + 1) * binomial, 0.0)
        return gap + side * k * step, np.where(np.abs(gap) < step, weights, k == 0)

    def add(self, density: Array, out: Array) -> None:
        """Add to out (t, rows, m)."""
        if len(self.pair) == 0:
            return
        odd = np.array(_ODD[self.layers.quantity])
        values = np.zeros((len(self.pair), len(odd), density.shape[2]))
        coefficients, first = self._modes(density)
        with limited_threads(self.threads):
            kernels.apply_blocks.using(self.threads)(
                *(self.block, self.begin, self.n_max, self.width, self.theta, odd),
                *(coefficients, first, density.shape[2], values),
            )
        values = _to_world(values, self.theta, self.surfaces.rotation[self.body])
        self._scatter.add(values, out)

    def _modes(self, density: Array) -> tuple[Array, Index]:
        """Coefficients of the panels that have blocks, and where each entry's begin."""
        s, fields = self.surfaces, density.shape[2]
        parts, first, total = [], np.empty(len(self.pair), np.int64), 0
        for h in np.unique(self.shape).tolist():
            members = np.flatnonzero(self.shape == h)
            resolution, size = s.shapes[h].resolution, s.shapes[h].panel_nodes
            keys = np.column_stack([self.body[members], self.panel[members]])
            panels, which = np.unique(keys, axis=0, return_inverse=True)
            begin = s.start[panels[:, 0]] + panels[:, 1] * size
            nodal = density[begin[:, None] + np.arange(size)]
            q, angles = resolution.nodes, resolution.angles
            modes = to_modes(nodal.reshape(-1, angles, 3, fields))
            modes = modes.reshape(len(modes), 2 * fields, 3, len(panels), q)
            modes = np.ascontiguousarray(modes.transpose(3, 0, 1, 2, 4))
            parts.append(modes.ravel())
            first[members] = total + which.reshape(-1) * (modes.size // len(panels))
            total += modes.size
        return np.concatenate(parts), first


def _to_world(values: Array, theta: Array, rotation: Array) -> Array:
    """Rows (e, rows, m) in the frame of each target's azimuth, turned to the world's."""
    if values.shape[1] == 1:
        return values
    frame = np.zeros((len(theta), 3, 3))
    frame[:, 0, 0] = frame[:, 1, 1] = np.cos(theta)
    frame[:, 1, 0], frame[:, 0, 1] = np.sin(theta), -np.sin(theta)
    frame[:, 2, 2] = 1.0
    Q = rotation @ frame
    if values.shape[1] == 3:
        return np.einsum("eij,ejm->eim", Q, values)
    rr, rt, rz, tt, tz, zz = np.moveaxis(values, 1, 0)
    tensor = np.stack([np.stack(row) for row in ((rr, rt, rz), (rt, tt, tz), (rz, tz, zz))])
    turned = np.einsum("eij,jkem,elk->ilem", Q, tensor, Q, optimize=True)
    order = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
    return np.stack([turned[i, k] for i, k in order], axis=1)


@dataclass(frozen=True)
class _Samples:
    """Targets at which the panels of entries are evaluated: foot points and distances.

    entry : (k,) position of each among the entries; weight : (k,) its share in the entry's block
    s0 : complex parameters towards which the panel's nodes are graded
    """

    entry: Index
    weight: Array
    panel: Index
    s: Array
    distance: Array
    target: Array
    s0: NDArray[np.complex128]

    @classmethod
    def of(
        cls, shape: UnitShape, panel: Index, foot: Array, gaps: Array, weights: Array
    ) -> _Samples:
        """Of entries' panels (e,), parameters of their feet (e,), gaps and weights (e, k)."""
        entry, column = np.nonzero(weights)
        d, s = gaps[entry, column], foot[entry]
        p = shape.curve.evaluate(s)
        target = np.column_stack(
            [np.maximum(p.r + d * p.normal_r, 0.0), p.z + d * p.normal_z, p.normal_r, p.normal_z]
        )
        return cls(
            *(entry, weights[entry, column], panel[entry], s, d, target),
            _graded_towards(shape, target, panel[entry], s, d, p),
        )


def _graded_towards(
    shape: UnitShape, target: Array, panel: Index, s: Array, d: Array, foot: CurvePoints
) -> NDArray[np.complex128]:
    """Where the continued curve meets each target: from its foot, or from the panel's nodes.

    The foot tells it sharply however close the target; where the panel sees another root, as on
    the far side of a thin body, its own counts.
    """
    table = NodeTables.of([shape])
    q, edges = shape.resolution.nodes, np.array(shape.resolution.breaks)
    seen = np.empty(len(s), np.complex128)
    kernels.preimages(target[:, 0], target[:, 1], panel * q, q, table.node, seen)
    slope, bend = foot.dr + 1j * foot.dz, 0.5 * (foot.d2r + 1j * foot.d2z)
    offset = d * (foot.normal_r + 1j * foot.normal_z)
    root = np.sqrt(slope**2 + 4.0 * bend * offset)
    root = np.where((root * slope.conj()).real < 0.0, -root, root)
    near_foot = s + 2.0 * offset / (slope + root)
    agree = np.abs(seen - near_foot) < 0.2 * np.diff(edges)[panel]
    return np.where(agree, near_foot, seen)


@dataclass(frozen=True)
class _GradedRule:
    """Nodes of graded rules, of all samples one after the other.

    sample : (k,) of each node; s, weight : (k,) parameter and weight, r |gamma'| included;
    rows : (k, q) interpolation from the panel's nodes
    """

    samples: _Samples
    sample: Index
    s: Array
    weight: Array
    rows: Array

    @classmethod
    def of(cls, shape: UnitShape, samples: _Samples, tolerance: float) -> _GradedRule:
        edges, q = np.array(shape.resolution.breaks), shape.resolution.nodes
        begin, end = edges[samples.panel], edges[samples.panel + 1]
        count = np.empty(len(begin), np.int64)
        total = kernels.graded_pieces(samples.s0, begin, end, count, np.empty((0, 2)))
        pieces = np.empty((total, 2))
        kernels.graded_pieces(samples.s0, begin, end, count, pieces)
        # half of the panel's degree: on pieces shorter than the panel the density is smoother
        digits = -math.log(tolerance)
        x, w = gauss_legendre(math.ceil(0.5 * digits / math.log(kernels.ELLIPSE)) + q // 2)
        length = np.diff(pieces, axis=1)
        s = (pieces[:, :1] + length * x).ravel()
        sample = np.repeat(np.repeat(np.arange(len(begin)), count), len(x))
        p = shape.curve.evaluate(s)
        weight = (length * w).ravel() * p.r * p.speed * samples.weight[sample]
        local = (s - begin[sample]) / (end - begin)[sample]
        return cls(samples, sample, s, weight, interpolation_matrix(q, local))

    def chunks(self, most: int) -> Iterator[_GradedRule]:
        """Parts of at most so many nodes."""
        for k in range(0, len(self.s), most):
            part = slice(k, k + most)
            yield _GradedRule(
                self.samples, self.sample[part], self.s[part], self.weight[part], self.rows[part]
            )

    def geometry(self, curve: Curve) -> tuple[Array, Array, Array, Array]:
        """(target, source, difference, offsets) for `modal_kernel`.

        Targets are taken as foot + distance x normal: so they keep relative precision in the
        differences from nodes next to the foot, however close to the surface.
        """
        d, s = self.samples.distance[self.sample], self.samples.s[self.sample]
        target = self.samples.target[self.sample]
        p = curve.evaluate(self.s)
        source = np.column_stack([p.r, p.z, p.normal_r, p.normal_z])
        along = np.column_stack(curve.differences(s, self.s))
        offsets = np.column_stack(curve.normal_offsets(s, self.s))
        difference = along + d[:, None] * target[:, 2:]
        offsets[:, 0] += d
        offsets[:, 1] += d * np.sum(target[:, 2:] * source[:, 2:], axis=1)
        return target, source, difference, offsets
