"""Which panels a sum over surface nodes misses at which targets, in closed form.

The plain product rule errs like C e^{-N xi} about the axis and C rho^{-2q} along a panel
(`_kernels_near` defines the symbols): both are known from the target's position alone, and with
them how many times as many azimuths and nodes would meet a tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stokes import _kernels_near as kernels
from stokes.distance import distance
from stokes.fmm._threads import limited_threads
from stokes.layers import Layers
from stokes.sources import Surfaces, UnitShape

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FACTORS = (1, 2, 3, 4, 6, 8)
# Most nodes of a refined panel, in those of the panel.
_MOST_REFINED = 64
# Nanoseconds, on one core of a Zen 5: to refine, by node; to sum, by pair of points; to make
# blocks, by mode and layer; to apply them, by number.
_REFINE, _PAIR, _MAKE, _APPLY = 60.0, 0.7, 1e4, 1.2
# C of the errors C distance^(1 - order) e^{-N xi} of single and double layers: no less was found
# over random targets, densities and shapes.
_CONSTANTS = {"velocity": (1.0, 30.0), "pressure": (1.0, 50.0), "stress": (30.0, 1000.0)}
# Kernels stronger than 1/r are extrapolated to targets this close to a surface, in lengths of the
# panel below: nearer, cancellation would lose eps/distance.
_STEP = 1e-3
# A shape's reach is sought at radii of the body times powers of a step.
_STEPS, _FARTHEST = 1.1, 40


def reach(shape: UnitShape, layers: Layers, tolerance: float) -> float:
    """Distance from a unit shape beyond which its plain rule meets the tolerance everywhere.

    Found on the normals at the nodes, from far away inwards.
    """
    foot = shape.curve.evaluate(np.concatenate([shape.resolution.breaks, shape.meridian.s]))
    distances = shape.curve.bounding_radius * _STEPS ** np.arange(_FARTHEST, -_FARTHEST, -1)
    r = np.maximum(foot.r + distances[:, None] * foot.normal_r, 0.0)
    z = foot.z + distances[:, None] * foot.normal_z
    tables, digits = NodeTables.of([shape]), _digits(layers, tolerance)
    needed, _ = _needed(tables, np.zeros(r.size, np.int64), r.ravel(), z.ravel(), digits, 1)
    missed = (needed.reshape(len(distances), -1) > 1.0).any(axis=1)
    first = int(np.argmax(missed)) if missed.any() else len(distances)
    return float(distances[max(first - 1, 0)]) * _STEPS


def _digits(layers: Layers, tolerance: float) -> tuple[float, float]:
    """(log(C/tolerance), power of the distance) of the errors of plain rules."""
    single, double = _CONSTANTS[layers.quantity]
    constant = single if layers.double is None else double
    return math.log(constant / tolerance), 1.0 - layers.order


@dataclass(frozen=True)
class ClosePanels:
    """Close pairs of targets and bodies, and the panels of these that miss the tolerance.

    target, body : (k,) ; r, theta, z : (k,) targets in the body's unit frame, cylindrical
    pair, panel  : (e,) panels that miss it, by pair of target and body
    by           : (e, 2) how many times as many azimuths, nodes meet it; (0, 0) if too many
    s, gap, step : (k,) of pairs that have such: parameter and signed distance of the nearest point
                   of the meridian, and the distance below which values are extrapolated
    """

    target: Index
    body: Index
    r: Array
    theta: Array
    z: Array
    pair: Index
    panel: Index
    by: Index
    s: Array
    gap: Array
    step: Array

    @property
    def exact(self) -> NDArray[np.bool_]:
        """(e,) whether refinement will not do."""
        return self.by[:, 0] == 0

    @classmethod
    def find(
        cls,
        surfaces: Surfaces,
        targets: Array,
        layers: Layers,
        tolerance: float,
        owner: Index | None,
        threads: int,
        applications: int,
        memory: float,
    ) -> ClosePanels:
        """Of targets (t, 3) in the world; owner (t,): the body to leave out for each.

        Refined panels that few targets share are made exact where that is cheaper over so many
        applications, unless blocks took more memory than that.
        """
        target, body, r, theta, z = _within_reach(surfaces, targets, layers, tolerance, owner)
        shape = surfaces.shape[body]
        tables, digits = NodeTables.of(surfaces.shapes), _digits(layers, tolerance)
        needed, start = _needed(tables, shape, r, z, digits, threads)
        missed = np.flatnonzero(needed.max(axis=1, initial=0.0) > 1.0)
        pair = np.searchsorted(start, missed, side="right") - 1
        by = np.append(_FACTORS, 10**6)[np.searchsorted(_FACTORS, needed[missed])]
        by[by.prod(axis=1) > _MOST_REFINED] = 0
        panel = missed - start[pair]
        by[_better_exact(surfaces, layers, body[pair], panel, by, applications, memory)] = 0
        s, gap, step = _feet(surfaces, shape, r, z, np.unique(pair[by[:, 0] == 0]))
        if layers.order > 0:
            # all panels or none: each has singularities at its edges, which their sum has not
            by[np.abs(gap[pair]) < step[pair]] = 0
        return cls(target, body, r, theta, z, pair, panel, by, s, gap, step)


def _within_reach(
    surfaces: Surfaces, targets: Array, layers: Layers, tolerance: float, owner: Index | None
) -> tuple[Index, Index, Array, Array, Array]:
    """Targets within reach of bodies, by balls about their centres: see `ClosePanels`."""
    s = surfaces
    if len(targets) == 0 or s.bodies == 0:
        found = [np.empty(0, np.int64)] * s.bodies
    else:
        far = np.array([reach(h, layers, tolerance) for h in s.shapes])
        radius = np.array([h.curve.bounding_radius for h in s.shapes])
        balls = s.scale * (radius + far)[s.shape]
        found = cKDTree(targets).query_ball_point(s.centre, balls, return_sorted=True)
    body = np.repeat(np.arange(s.bodies), [len(f) for f in found])
    target = np.concatenate([np.asarray(f, np.int64) for f in found] or [body])
    if owner is not None:
        others = owner[target] != body
        body, target = body[others], target[others]
    return target, body, *s.to_local(targets[target], body)


def _better_exact(
    surfaces: Surfaces,
    layers: Layers,
    body: Index,
    panel: Index,
    by: Index,
    applications: int,
    memory: float,
) -> NDArray[np.bool_]:
    """(e,) whether a block costs less than this pair's part of a refined panel."""
    shape = surfaces.shape[body]
    angles, nodes, modes = (
        np.array([getattr(s.resolution, name) for s in surfaces.shapes], dtype=np.int64)[shape]
        for name in ("angles", "nodes", "modes")
    )
    _, group, sharing = np.unique(
        np.column_stack([body, panel, by]), axis=0, return_inverse=True, return_counts=True
    )
    sharing = sharing[group.reshape(-1)]
    count = sum(kernel is not None for kernel in layers.kernels)
    refined = angles * nodes * by.prod(axis=1) * (_REFINE / sharing + _PAIR * count)
    numbers = 3 * layers.rows * nodes * (modes + 1)
    block = _APPLY * numbers + _MAKE * count * (modes + 1) / applications
    better = (by[:, 0] > 0) & (block < refined)
    held = 8.0 * numbers[better | (by[:, 0] == 0)].sum()
    return better if held <= memory else np.zeros_like(better)


def _needed(
    tables: NodeTables,
    shape: Index,
    r: Array,
    z: Array,
    digits: tuple[float, float],
    threads: int,
) -> tuple[Array, Index]:
    """Refinement (p, 2) needed on all panels for pairs (k,), and the first row of each pair."""
    panels = np.diff(tables.first_edge) - 1
    end = np.cumsum(panels[shape])
    start = end - panels[shape]
    needed = np.empty((int(end[-1]) if len(end) else 0, 2))
    with limited_threads(threads):
        kernels.needed_refinement.using(threads)(
            *(r, z, shape, start, tables.node, tables.first_node, tables.edge),
            *(tables.first_edge, tables.nodes, tables.angles, digits, needed),
        )
    return needed, start


def _feet(
    surfaces: Surfaces, shape: Index, r: Array, z: Array, pairs: Index
) -> tuple[Array, Array, Array]:
    """(s, gap, step) (k,) of some pairs, see `ClosePanels`; NaN of the others."""
    s, gap, step = np.full((3, len(shape)), np.nan)
    for h in np.unique(shape[pairs]).tolist():
        k = pairs[shape[pairs] == h]
        curve, edges = surfaces.shapes[h].curve, np.array(surfaces.shapes[h].resolution.breaks)
        s[k] = distance(curve, r[k], z[k])[1]
        foot = curve.evaluate(s[k])
        gap[k] = foot.normal_r * (r[k] - foot.r) + foot.normal_z * (z[k] - foot.z)
        panel = np.clip(np.searchsorted(edges, s[k]) - 1, 0, len(edges) - 2)
        step[k] = _STEP * np.diff(edges)[panel] * foot.speed
    return s, gap, step


@dataclass(frozen=True)
class NodeTables:
    """Nodes and edges of all shapes, one after the other, for compiled loops."""

    node: Array
    first_node: Index
    edge: Array
    first_edge: Index
    nodes: Index
    angles: Index

    @classmethod
    def of(cls, shapes: Sequence[UnitShape]) -> NodeTables:
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
