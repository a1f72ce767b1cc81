"""Velocity, pressure and stress of a flow at arbitrary points, up to the surfaces of bodies.

    u = sum over bodies of S rho / viscosity + D mu

A fast sum takes all surfaces by their plain rules; what these miss at points close to a surface is
added by `stokes.near`. On a surface the values are the limits from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from dem_mpi.parallel import Parallel
from stokes.distance import distance
from stokes.fmm import Fmm, FmmOptions
from stokes.geometry import Body, Resolution
from stokes.layers import LAYER_KERNELS, Layers, Quantity
from stokes.near import NearField, reach
from stokes.sources import Refinement, Surfaces, UnitShape
from stokes.suspension_table import BodyTable

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Points of which blocks of the near field are held at once.
_CHUNK = 20_000
# Pairs of a node and a point on a rank that are summed sooner than a fast method is planned.
_FEW_PAIRS = 1e9
# Points this much inside a unit shape, and round-off of world coordinates, still count as on it.
_INSIDE = 1e-12
# Where a sum's term of the nearest node loses digits by round-off, values are extrapolated along
# the normal from so many points so far apart (parts of the panel), by singularity of the kernel.
_EXTRAPOLATION = {0: (5, 1e-3), 1: (5, 1e-3), 2: (8, 1e-2)}


def evaluate(
    bodies: Sequence[Body],
    resolutions: Sequence[Resolution],
    points: ArrayLike,
    single: ArrayLike | None = None,
    double: ArrayLike | None = None,
    quantity: Quantity = "velocity",
    viscosity: float = 1.0,
    tolerance: float = 1e-6,
    parallel: Parallel | None = None,
    options: FmmOptions | None = None,
) -> Array:
    """Collective over `parallel` (default: this process alone).

    bodies, resolutions : this rank's
    points    : (m, 3) this rank's, in the world
    single    : rho (n, 3) [force/area] at the nodes of this rank's bodies, body after body, each
                (n_s, n_theta) in C order, components in the body's frame; None on all ranks for
                a layer that is left out
    double    : mu (n, 3) [velocity], likewise
    tolerance : of each body's part, relative to its largest density, times scale/viscosity in
                velocities of the single layer, viscosity/scale in pressures of the double layer;
                and of the fast sum, in the 2-norm

    Returns (m, 3) velocities, (m,) pressures or (m, 6) stresses in the order 00, 11, 22, 12, 02,
    01; NaN at points inside bodies. Raises ValueError, on all ranks, for shapes that do not fit.
    """
    parallel = parallel or Parallel.alone()
    flow = _Flow.gather(bodies, resolutions, single, double, quantity, viscosity, parallel)
    positions = _checked(points, parallel)
    options = options or FmmOptions()
    return flow.at(positions, tolerance, options, parallel)


def _checked(points: ArrayLike, parallel: Parallel) -> Array:
    array, error = np.asarray(points, dtype=np.float64), None
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        error = ValueError(f"points of shape {array.shape}: must be (m, 3), and finite")
    parallel.raise_together(error)
    return np.ascontiguousarray(array)


@dataclass(frozen=True)
class _Flow:
    """Layers of bodies of all ranks, with the densities of this rank's.

    table, resolutions : of all bodies
    layers    : coefficients (B,) in the sense of `stokes.sources`
    densities : (single, double), (n, 3, 1) each, None for a layer that is left out
    """

    table: BodyTable
    resolutions: tuple[Resolution, ...]
    own: Surfaces
    layers: Layers
    densities: tuple[Array | None, Array | None]

    @classmethod
    def gather(
        cls,
        bodies: Sequence[Body],
        resolutions: Sequence[Resolution],
        single: ArrayLike | None,
        double: ArrayLike | None,
        quantity: Quantity,
        viscosity: float,
        parallel: Parallel,
    ) -> _Flow:
        """Collective. Check what is given and tell all ranks of the bodies."""
        error = own = None
        densities: tuple[Array | None, Array | None] = (None, None)
        try:
            own = Surfaces(bodies, resolutions)
            densities = tuple(None if d is None else own.density(d) for d in (single, double))
            if any(d is not None and d.shape[2] != 1 for d in densities):
                raise ValueError("densities must be (n, 3): one field")
            if not viscosity > 0.0:
                raise ValueError(f"viscosity = {viscosity}: must be > 0")
            Layers(*(None if d is None else 1.0 for d in densities), quantity)
        except ValueError as fault:
            error = fault
        parallel.raise_together(error)
        table = BodyTable.gather(bodies, parallel)
        parts = parallel.broadcast(parallel.gather(tuple(resolutions)))
        units = (table.scale / viscosity, 1.0)
        if quantity != "velocity":
            units = (table.scale, viscosity)
        kept = [None if d is None else u for d, u in zip(densities, units, strict=True)]
        return cls(
            table,
            tuple(resolution for part in parts for resolution in part),
            own,
            Layers(*kept, quantity),
            densities,
        )

    def at(self, points: Array, tolerance: float, options: FmmOptions, parallel: Parallel) -> Array:
        """Collective. Values at this rank's points."""
        close = _CloseBodies.of(self, self._within_reach(points, tolerance), parallel)
        inside = close.inside(points)
        samples = close.samples(np.flatnonzero(~inside), points, tolerance, self.layers)
        amplified = tolerance / max(1.0, np.abs(samples.weight).max(initial=0.0))
        values = self._plain_sums(samples.points, min(tolerance, 1e-2), options, parallel)
        for k in range(0, len(values), _CHUNK):
            part = slice(k, k + _CHUNK)
            values[part] += close.corrections(samples.points[part], amplified, options.threads)
        out = np.zeros((len(points), values.shape[1]))
        np.add.at(out, samples.point, samples.weight[:, None] * values)
        out[inside] = np.nan
        return out[:, 0] if self.layers.quantity == "pressure" else out

    def _within_reach(self, points: Array, tolerance: float) -> Index:
        """Numbers of bodies that have points within their reach."""
        table = self.table
        if len(points) == 0 or table.count == 0:
            return np.empty(0, np.int64)
        far: dict[UnitShape, float] = {}
        ball = np.empty(table.count)
        for k, resolution in enumerate(self.resolutions):
            shape = UnitShape(table.curves[table.curve[k]], resolution)
            if shape not in far:
                # a quantity's reach grows as its tolerance is amplified by an extrapolation
                far[shape] = reach(shape, self.layers, 1e-3 * tolerance)
            ball[k] = table.scale[k] * far[shape]
        ball += table.bounding_radius
        nearest = cKDTree(points).query(table.centre)[0]
        return np.flatnonzero(nearest < ball)

    def _plain_sums(
        self, points: Array, eps: float, options: FmmOptions, parallel: Parallel
    ) -> Array:
        """Collective. Sums over the plain rules of all bodies."""
        values = np.zeros((len(points), self.layers.rows))
        pairs = parallel.sum(self.own.nodes) * parallel.sum(len(points))
        if options.backend == "own" and pairs < _FEW_PAIRS * parallel.size:
            options = replace(options, backend="direct")
        sources = self.own.sources()
        kernels = LAYER_KERNELS[self.layers.quantity]
        maps = (sources.single_weights, sources.double_weights)
        coefficients = (self.layers.single, self.layers.double)
        for kernel, weights_of, layer, density in zip(
            kernels, maps, coefficients, self.densities, strict=True
        ):
            if density is None:
                continue
            own = np.broadcast_to(layer, self.table.count)[self.table.own]
            plan = Fmm(kernel, sources.points, points, eps, options, parallel)
            weights = weights_of(density, own)[:, :, 0]
            values += plan.apply(weights).reshape(values.shape)
        return values


@dataclass(frozen=True)
class _Samples:
    """Points at which to evaluate, instead of some, several that they are extrapolated from.

    points (k, 3); point (k,): which value each belongs to, with which weight (k,)
    """

    points: Array
    point: Index
    weight: Array


@dataclass(frozen=True)
class _CloseBodies:
    """Bodies of any rank that are close to points of this one, with their densities."""

    bodies: tuple[Body, ...]
    resolutions: tuple[Resolution, ...]
    surfaces: Surfaces
    layers: Layers
    densities: tuple[Array | None, Array | None]

    @classmethod
    def of(cls, flow: _Flow, numbers: Index, parallel: Parallel) -> _CloseBodies:
        """Collective. Fetch the densities of these bodies, by rising number."""
        bodies = tuple(flow.table.body(k) for k in numbers.tolist())
        resolutions = tuple(flow.resolutions[k] for k in numbers.tolist())
        coefficients = [
            None if a is None else np.broadcast_to(a, flow.table.count)[numbers]
            for a in (flow.layers.single, flow.layers.double)
        ]
        return cls(
            bodies,
            resolutions,
            Surfaces(bodies, resolutions),
            Layers(*coefficients, flow.layers.quantity),
            _fetched(flow, numbers, parallel),
        )

    def inside(self, points: Array) -> NDArray[np.bool_]:
        """(m,) whether a point is inside a body."""
        found = np.zeros(len(points), bool)
        if len(self.bodies) == 0 or len(points) == 0:
            return found
        s = self.surfaces
        balls = [body.bounding_radius for body in self.bodies]
        members = cKDTree(points).query_ball_point(s.centre, balls)
        body = np.repeat(np.arange(s.bodies), [len(m) for m in members])
        point = np.concatenate([np.asarray(m, np.int64) for m in members])
        r, _, z = s.to_local(points[point], body)
        depth = np.empty(len(point))
        for h, shape in enumerate(s.shapes):
            k = np.flatnonzero(s.shape[body] == h)
            depth[k] = distance(shape.curve, r[k], z[k])[0]
        rounding = 1e-15 * np.abs(points[point]).max(axis=1, initial=0.0) / s.scale[body]
        found[point[depth < -(_INSIDE + 8.0 * rounding)]] = True
        return found

    def samples(self, wanted: Index, points: Array, tolerance: float, layers: Layers) -> _Samples:
        """Points `wanted`, or points above them where a node's term would lose digits."""
        plain = _Samples(points[wanted], wanted, np.ones(len(wanted)))
        if len(self.bodies) == 0 or len(wanted) == 0:
            return plain
        body, lost = self._rounded(plain.points, tolerance, layers.order)
        if not lost.any():
            return plain
        count, step = _EXTRAPOLATION[layers.order]
        lost = np.flatnonzero(lost)
        k = np.arange(1, count + 1)
        outward = self._outward(plain.points[lost], body[lost]) * step
        above = plain.points[lost][:, None] + k[:, None] * outward[:, None]
        # not where a neighbour is closer than that: there the point itself has to do
        free = ~self.inside(above.reshape(-1, 3)).reshape(-1, count).any(axis=1)
        lost, above = lost[free], above[free]
        weight = np.cumprod((count + 1 - k) / k) * (-1.0) ** (k + 1)
        kept = np.delete(np.arange(len(wanted)), lost)
        return _Samples(
            np.concatenate([plain.points[kept], above.reshape(-1, 3)]),
            np.concatenate([wanted[kept], np.repeat(wanted[lost], count)]),
            np.concatenate([np.ones(len(kept)), np.tile(weight, len(lost))]),
        )

    def _rounded(self, points: Array, tolerance: float, order: int) -> tuple[Index, Array]:
        """Body of the nearest node, and whether its term has a rounding error that matters."""
        s = self.surfaces
        area = {h: h.refined(Refinement()).weights.ravel() for h in s.shapes}
        areas = np.concatenate([area[s.shapes[h]] for h in s.shape.tolist()])
        nearest, node = cKDTree(s.sources().points).query(points)
        body = np.searchsorted(s.start, node, side="right") - 1
        gap = np.maximum(nearest / s.scale[body], 1e-15)
        error = np.finfo(float).eps * areas[node] / gap ** (order + 2)
        return body, error > 0.1 * tolerance

    def _outward(self, points: Array, body: Index) -> Array:
        """Normals at the feet of points next to bodies, as long as the foot's panel."""
        s = self.surfaces
        r, theta, z = s.to_local(points, body)
        normal = np.empty_like(points)
        for h, shape in enumerate(s.shapes):
            k = np.flatnonzero(s.shape[body] == h)
            foot_s = distance(shape.curve, r[k], z[k])[1]
            foot, edges = shape.curve.evaluate(foot_s), np.array(shape.resolution.breaks)
            panel = np.clip(np.searchsorted(edges, foot_s) - 1, 0, len(edges) - 2)
            length = np.diff(edges)[panel] * foot.speed
            normal[k, 0] = length * foot.normal_r * np.cos(theta[k])
            normal[k, 1] = length * foot.normal_r * np.sin(theta[k])
            normal[k, 2] = length * foot.normal_z
        return s.scale[body, None] * np.einsum("kij,kj->ki", s.rotation[body], normal)

    def corrections(self, points: Array, tolerance: float, threads: int) -> Array:
        """What the plain rules of these bodies miss, (m, rows)."""
        quantity = self.layers.quantity
        values = np.zeros((len(points), self.layers.rows))
        single, double = self.densities
        parts = []
        if single is not None:
            parts.append((Layers(self.layers.single, None, quantity), single))
        if double is not None:
            parts.append((Layers(None, self.layers.double, quantity), double))
        for layers, density in parts:
            near = NearField(
                *(self.bodies, self.resolutions, points, layers, tolerance),
                threads=threads,
                applications=1,
            )
            values += near.apply(density)[:, :, 0]
        return values


def _fetched(flow: _Flow, numbers: Index, parallel: Parallel) -> tuple[Array | None, Array | None]:
    """Collective. The densities of bodies of any rank, in their order, (k, 3, 1) each."""
    owner = flow.table.owner(numbers)
    rows = numbers - flow.table.first[owner]
    wanted = parallel.exchange({int(r): rows[owner == r].tobytes() for r in np.unique(owner)})
    given = [d for d in flow.densities if d is not None]
    start = flow.own.start
    replies = {}
    for rank, message in wanted.items():
        bodies = np.frombuffer(message, np.int64).tolist()
        replies[rank] = b"".join(
            d[start[b] : start[b + 1]].tobytes() for d in given for b in bodies
        )
    received = parallel.exchange(replies)
    parts = [np.frombuffer(m).reshape(len(given), -1, 3, 1) for _, m in sorted(received.items())]
    empty = np.empty((len(given), 0, 3, 1))
    columns = iter(np.concatenate([empty, *parts], axis=1))
    return tuple(None if d is None else next(columns) for d in flow.densities)
