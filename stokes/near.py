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

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from stokes import _kernels_near as kernels
from stokes._layer_kernels import LAYER_KERNELS
from stokes.curves import Curve, CurvePoints
from stokes.distance import distance
from stokes.fmm._threads import limited_threads
from stokes.fmm.kernels import Kernel
from stokes.fmm.near_field import NearField as PairSums
from stokes.geometry import Body, Resolution
from stokes.modal import modal_kernel
from stokes.modes import to_modes
from stokes.quadrature import gauss_legendre, interpolation_matrix
from stokes.sources import PanelSources, Refinement, Surfaces, UnitShape

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Quantity = Literal["velocity", "pressure", "stress"]

_FACTORS = (1, 2, 3, 4, 6, 8)
# Above it a block of modes is cheaper than the refined panel, after some ten applications.
_MOST_REFINED = 16
_EXACT = Refinement(0, 0)
# C of the errors C distance^(1 - order) e^{-N xi} of single and double layers: no less was found
# over random targets, densities and shapes.
_CONSTANTS = {"velocity": (0.5, 25.0), "pressure": (1.0, 50.0), "stress": (20.0, 400.0)}
# Numbers of kernel values held at once while blocks are made.
_CHUNK_VALUES = 4_000_000
# From this tolerance on blocks are kept in single precision, unless the kernel is hypersingular.
_SINGLE = 1e-6
# Derivatives of 1/r in each quantity's kernel: single layer, double layer.
_ORDER = {"velocity": (0, 1), "pressure": (1, 2), "stress": (1, 2)}
# Rows of a block that are odd in the azimuth.
_ODD = {
    "velocity": (False, True, False),
    "pressure": (False,),
    "stress": (False, True, False, False, True, False),
}
# On the surface, kernels stronger than 1/r are extrapolated from so many distances so far apart
# (lengths of the panel): cancellation loses eps/distance, extrapolation errs by its fifth power.
_EXTRAPOLATED, _STEP = 5, 1e-3


@dataclass(frozen=True)
class Layers:
    """Potential whose near part is wanted: a (single layer) + b (double layer) of each body.

    single, double : a and b, one number for all bodies or one for each (`stokes.sources`); None
                     leaves a layer out
    """

    single: ArrayLike | None = 1.0
    double: ArrayLike | None = None
    quantity: Quantity = "velocity"

    def __post_init__(self) -> None:
        if self.single is None and self.double is None:
            raise ValueError("Layers: a single or a double layer must be given")
        if self.quantity not in LAYER_KERNELS:
            raise ValueError(f"quantity {self.quantity!r}: must be one of {tuple(LAYER_KERNELS)}")

    @property
    def order(self) -> int:
        """Order of the strongest kernel: 0 for 1/r, 1 for 1/r^2, 2 for 1/r^3."""
        single, double = _ORDER[self.quantity]
        return single if self.double is None else double

    @property
    def kernels(self) -> tuple[Kernel | None, Kernel | None]:
        """The kernels of the sums over sources; None for a layer that is left out."""
        single, double = LAYER_KERNELS[self.quantity]
        return (
            None if self.single is None else single,
            None if self.double is None else double,
        )


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


def reach(shape: UnitShape, layers: Layers, tolerance: float) -> float:
    """Distance from a unit shape beyond which its plain rule meets the tolerance everywhere."""
    resolution = shape.resolution
    digits = _digits(layers, tolerance)[0]
    meridian = shape.meridian
    across = meridian.r.max() * math.expm1(digits / resolution.angles)
    ellipse = math.exp(digits / (2.0 * resolution.nodes))
    lengths = meridian.weights.reshape(resolution.panels, -1).sum(axis=1)
    along = 0.5 * lengths.max() * 0.5 * (ellipse - 1.0 / ellipse)
    return max(across, 1.3 * along)


def _digits(layers: Layers, tolerance: float) -> tuple[float, float]:
    """(log(C/tolerance), power of the distance) of the errors of plain rules."""
    single, double = _CONSTANTS[layers.quantity]
    constant = single if layers.double is None else double
    return math.log(constant / tolerance), 1.0 - layers.order


@dataclass
class _Close:
    """Close pairs of targets and bodies, and of those with panels.

    target, body : (k,) ; r, theta, z : (k,) targets in the body's unit frame, cylindrical
    pair, panel : (e,) ; by : (e, 2) refinement, (0, 0) for exact
    """

    target: Index
    body: Index
    r: Array
    theta: Array
    z: Array
    pair: Index = field(default_factory=lambda: np.empty(0, np.int64))
    panel: Index = field(default_factory=lambda: np.empty(0, np.int64))
    by: Index = field(default_factory=lambda: np.empty((0, 2), np.int64))


class NearField:
    """What sums over plain rules miss at given targets, as a linear map of the densities."""

    def __init__(
        self,
        bodies: Sequence[Body],
        resolutions: Sequence[Resolution],
        targets: ArrayLike,
        layers: Layers = Layers(),
        tolerance: float = 1e-6,
        owner: ArrayLike | None = None,
        threads: int = 1,
    ) -> None:
        """Find close pairs and make the blocks of those that need them. Not collective.

        bodies    : with the resolution of each: all that have targets within their `reach`
        targets   : (t, 3) in the world, outside all bodies but their owner, or on them
        tolerance : of each panel's potential in its unit frame, relative to the largest density
        owner     : (t,) body that a target is a node of, which is left out; -1 for none

        Raises ValueError for shapes that do not fit, or a tolerance outside (1e-14, 1).
        """
        points = np.ascontiguousarray(targets, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"targets of shape {points.shape}: must be (t, 3)")
        if not 1e-14 < tolerance < 1.0:
            raise ValueError(f"tolerance = {tolerance}: must be between 1e-14 and 1")
        self.surfaces = Surfaces(bodies, resolutions)
        self.layers, self.tolerance, self.threads = layers, tolerance, threads
        self._targets = points
        close = self._close_bodies(None if owner is None else np.asarray(owner, np.int64))
        self._choose(close)
        exact = (close.by[:, 0] == 0).nonzero()[0]
        self._plain = _Refined(self, close, np.arange(len(close.pair)))
        self._blocks = _Blocks(self, close, exact)
        self.report = NearReport(
            pairs=len(close.pair),
            refined=len(close.pair) - len(exact),
            exact=len(exact),
            sources=len(self._plain.sources.points),
            bytes=self._plain.bytes + self._blocks.bytes,
        )

    def apply(self, density: ArrayLike) -> Array:
        """Corrections (t, rows[, m]) in world components of the densities (n, 3[, m]).

        density : as `stokes.sources` has it, of all bodies of this near field. Rows are 3, for
        pressures 1, for stresses 6 in the order 00, 11, 22, 12, 02, 01.
        """
        values = self.surfaces.density(density)
        rows = len(_ODD[self.layers.quantity])
        out = np.zeros((len(self._targets), rows, values.shape[2]))
        self._plain.add(values, out)
        self._blocks.add(values, out)
        return out if np.ndim(density) == 3 else out[:, :, 0]

    def _close_bodies(self, owner: Index | None) -> _Close:
        """Targets within reach of bodies, by balls about their centres."""
        s = self.surfaces
        far = np.array([reach(h, self.layers, self.tolerance) for h in s.shapes])
        radius = np.array([h.curve.bounding_radius for h in s.shapes])
        if len(self._targets) == 0 or s.bodies == 0:
            found = [np.empty(0, np.int64)] * s.bodies
        else:
            balls = s.scale * (radius + far)[s.shape]
            found = cKDTree(self._targets).query_ball_point(s.centre, balls, return_sorted=True)
        body = np.repeat(np.arange(s.bodies), [len(f) for f in found])
        target = np.concatenate([np.asarray(f, np.int64) for f in found] or [body])
        if owner is not None:
            others = owner[target] != body
            body, target = body[others], target[others]
        offset = self._targets[target] - s.centre[body]
        local = np.einsum("kij,ki->kj", s.rotation[body], offset) / s.scale[body, None]
        x, y, z = local.T
        return _Close(target, body, np.hypot(x, y), np.arctan2(y, x), np.ascontiguousarray(z))

    def _choose(self, close: _Close) -> None:
        """Fill in the panels that miss the tolerance, and how each is summed instead."""
        s = self.surfaces
        tables = _Tables.of(s.shapes)
        shape = s.shape[close.body]
        panels = np.diff(tables.first_edge) - 1
        end = np.cumsum(panels[shape])
        start = end - panels[shape]
        need = np.empty((int(end[-1]) if len(end) else 0, 2))
        with limited_threads(self.threads):
            kernels.needed_refinement.using(self.threads)(
                *(close.r, close.z, shape, start, tables.node, tables.first_node),
                *(tables.edge, tables.first_edge, tables.nodes, tables.angles),
                *(_digits(self.layers, self.tolerance), need),
            )
        missed = np.flatnonzero(need.max(axis=1, initial=0.0) > 1.0)
        pair = np.repeat(np.arange(len(shape)), panels[shape])[missed]
        factors = np.array(_FACTORS)
        choice = np.searchsorted(factors, need[missed])
        by = np.append(factors, 10**6)[choice]
        by[by.prod(axis=1) > _MOST_REFINED] = _EXACT
        close.pair, close.panel, close.by = pair, missed - start[pair], by


@dataclass(frozen=True)
class _Tables:
    """Nodes and edges of all shapes, one after the other, for compiled loops."""

    node: Array
    first_node: Index
    edge: Array
    first_edge: Index
    nodes: Index
    angles: Index

    @classmethod
    def of(cls, shapes: Sequence[UnitShape]) -> _Tables:
        rows, edges = [np.empty((0, 7))], [np.empty(0)]
        for shape in shapes:
            p = shape.meridian.points
            columns = (shape.meridian.s, p.r, p.z, p.dr, p.dz, p.d2r, p.d2z)
            rows.append(np.stack(columns, axis=1))
            edges.append(np.array(shape.resolution.breaks))
        return cls(
            np.concatenate(rows),
            np.cumsum([len(r) for r in rows]),
            np.concatenate(edges),
            np.cumsum([len(e) for e in edges]),
            np.array([s.resolution.nodes for s in shapes], dtype=np.int64),
            np.array([s.resolution.angles for s in shapes], dtype=np.int64),
        )


class _Refined:
    """Sums over refined panels less those over the panels as they are, pair by pair."""

    def __init__(self, near: NearField, close: _Close, entries: Index) -> None:
        self.layers, self.threads = near.layers, near.threads
        body, panel, by = close.body[close.pair[entries]], close.panel[entries], close.by[entries]
        keys = np.column_stack([body, panel, by])
        groups, group = np.unique(keys, axis=0, return_inverse=True)
        group = group.reshape(-1)
        order = np.argsort(group, kind="stable")
        self.targets = np.ascontiguousarray(
            near._targets[close.target[close.pair[entries[order]]]].T
        )
        self._scatter = _Scatter(close.target[close.pair[entries[order]]])
        self.ranges = _ranges(np.searchsorted(group[order], np.arange(len(groups) + 1)))
        plain, which = np.unique(groups[:, :2], axis=0, return_inverse=True)
        which = which.reshape(-1)
        finer = np.flatnonzero(groups[:, 2] > 0)
        every = np.concatenate([groups[finer], np.pad(plain, ((0, 0), (0, 2)), constant_values=1)])
        self.sources = PanelSources(
            near.surfaces, every[:, 0], every[:, 1], every[:, 2:].reshape(-1, 2)
        )
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
        single, double = self.layers.kernels
        if single is not None:
            self._sum(single, self.sources.single_weights(density, self.layers.single), values)
        if double is not None:
            self._sum(double, self.sources.double_weights(density, self.layers.double), values)
        self._scatter.add(np.moveaxis(values, 2, 0), (0, 2, 1), out)

    def _sum(self, kernel: Kernel, weights: Array, values: Array) -> None:
        weights[self._first_plain :] *= -1.0
        columns = np.ascontiguousarray(weights.transpose(2, 1, 0))
        sums = PairSums(kernel, threads=self.threads)
        sums.add(
            *(self.targets, self.ranges, self._points, columns),
            *(self._start, self._lists, values),
        )


class _Scatter:
    """Adds rows of entries to the targets they belong to, in a fixed order."""

    def __init__(self, target: Index) -> None:
        self._order = np.argsort(target, kind="stable")
        arranged = target[self._order]
        self._first = np.flatnonzero(np.diff(arranged, prepend=-1))
        self._target = arranged[self._first]

    def add(self, values: Array, axes: tuple[int, int, int], out: Array) -> None:
        if len(self._target):
            rows = values.transpose(axes)[self._order]
            out[self._target] += np.add.reduceat(rows, self._first, axis=0)


def _ranges(edges: Index) -> Index:
    return np.ascontiguousarray(np.stack([edges[:-1], edges[1:]], axis=1), dtype=np.int64)


class _Blocks:
    """Exact potentials of single panels as matrices that act on the modes of the density."""

    def __init__(self, near: NearField, close: _Close, entries: Index) -> None:
        self.surfaces, self.layers, self.threads = near.surfaces, near.layers, near.threads
        self.tolerance = near.tolerance
        # entries of one panel of one body, whose modes are made once, stand together
        body, panel = close.body[close.pair[entries]], close.panel[entries]
        shape = self.surfaces.shape[body]
        entries = entries[np.lexsort((panel, body, shape))]
        self.pair, self.panel = close.pair[entries], close.panel[entries]
        self.body, self.theta = close.body[self.pair], close.theta[self.pair]
        self.shape = self.surfaces.shape[self.body]
        self._scatter = _Scatter(close.target[self.pair])
        self._allocate()
        for h in np.unique(self.shape).tolist():
            members = np.flatnonzero(self.shape == h)
            self._fill(self.surfaces.shapes[h], members, close)
        if near.tolerance >= _SINGLE and near.layers.order < 2:
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
        rows = len(_ODD[self.layers.quantity])
        end = np.cumsum((self.n_max + 1) * rows * self.width)
        self.begin = end - (self.n_max + 1) * rows * self.width
        self.block = np.zeros(int(end[-1]) if len(end) else 0)

    def _fill(self, shape: UnitShape, members: Index, close: _Close) -> None:
        foot = Foot.of(shape, close.r[self.pair[members]], close.z[self.pair[members]])
        samples = _Samples.of(
            shape, foot, self.panel[members], self._distances(shape, foot, members)
        )
        rule = _GradedRule.of(shape, samples, self.tolerance)
        modes, rows = shape.resolution.modes, len(_ODD[self.layers.quantity])
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

    def _factor(self, layer: ArrayLike) -> Array:
        """Numbers (b,) that turn a layer of unit shapes to the quantity in the world."""
        values = np.broadcast_to(np.asarray(layer, float), self.surfaces.bodies)
        return values if self.layers.quantity == "velocity" else values / self.surfaces.scale

    def _distances(self, shape: UnitShape, foot: Foot, members: Index) -> tuple[Array, Array]:
        """Distances at which each entry is evaluated, and their weights: (e, k) twice."""
        gap = foot.distance[:, None]
        if self.layers.order == 0:
            # the limit from outside, to the error that the tolerance leaves
            least = 1e-3 * self.tolerance
            return np.where(np.abs(gap) < least, least, gap), np.ones_like(gap)
        edges = np.diff(shape.resolution.breaks)
        step = (_STEP * edges[self.panel[members]] * foot.speed)[:, None]
        k = np.arange(_EXTRAPOLATED + 1)
        binomial = np.array([math.comb(_EXTRAPOLATED, i) for i in k])
        weights = np.where(k > 0, (-1.0) ** (k + 1) * binomial, 0.0)
        return gap + k * step, np.where(gap < step, weights, k == 0)

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
        self._scatter.add(values, (0, 1, 2), out)

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
class Foot:
    """Nearest points of a meridian: s, signed distance (negative inside), |gamma'|; (k,) each."""

    s: Array
    distance: Array
    speed: Array

    @classmethod
    def of(cls, shape: UnitShape, r: Array, z: Array) -> Foot:
        """Of targets in the meridian plane, (k,) each."""
        _, s = distance(shape.curve, r, z)
        p = shape.curve.evaluate(s)
        return cls(s, p.normal_r * (r - p.r) + p.normal_z * (z - p.z), p.speed)


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
        cls, shape: UnitShape, foot: Foot, panel: Index, distances: tuple[Array, Array]
    ) -> _Samples:
        gap, weight = distances
        entry, column = np.nonzero(weight)
        d, s = gap[entry, column], foot.s[entry]
        p = shape.curve.evaluate(s)
        target = np.column_stack(
            [np.maximum(p.r + d * p.normal_r, 0.0), p.z + d * p.normal_z, p.normal_r, p.normal_z]
        )
        return cls(
            *(entry, weight[entry, column], panel[entry], s, d, target),
            _graded_towards(shape, target, panel[entry], s, d, p),
        )


def _graded_towards(
    shape: UnitShape, target: Array, panel: Index, s: Array, d: Array, foot: CurvePoints
) -> NDArray[np.complex128]:
    """Where the continued curve meets each target: from its foot, or from the panel's nodes.

    The foot tells it sharply however close the target; where the panel sees another root, as on
    the far side of a thin body, its own counts.
    """
    table = _Tables.of([shape])
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
        digits = math.log(10.0 / tolerance)
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
