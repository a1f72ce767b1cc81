"""Surfaces of many bodies as sources of fast sums, as they are and on refined panels.

A density has values at the nodes of each body, (n, 3) or (n, 3, m) for m fields, body after body,
each (n_s, n_theta) in C order, components in the body's own frame. Densities and potentials are
those of the *unit shape*: with x_local = R^T (x - centre)/scale, the velocity of a body's layers is
    u_local(x) = a (S f)(x_local) + b (D f)(x_local),
S and D with kernels 1/(8 pi) (1/r + r r/r^3) and 3/(4 pi) r r (r.nu)/r^5, integrated over the unit
shape, where a and b are numbers of each body. (A traction rho on the body's own surface makes the
velocity scale/viscosity S rho: f = scale/viscosity rho, a = 1.)

Refined panels hold the same density, as trigonometric polynomials in the azimuth and polynomials
in the meridian's parameter on each panel, at more azimuths and Gauss nodes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes.geometry import Body, Curve, Meridian, Resolution
from stokes.modes import from_modes, to_modes
from stokes.quadrature import gauss_legendre, interpolation_matrix

Array = NDArray[np.float64]

_STRESSLET = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))


class Refinement(NamedTuple):
    """How many times as many azimuths and nodes of a panel."""

    azimuth: int = 1
    meridian: int = 1


@dataclass(frozen=True)
class UnitShape:
    """A curve and its resolution: what bodies of one shape share, whatever their size."""

    curve: Curve
    resolution: Resolution

    @property
    def panel_nodes(self) -> int:
        """Nodes of one panel, all azimuths."""
        return self.resolution.nodes * self.resolution.angles

    @property
    def nodes(self) -> int:
        """Nodes of the surface."""
        return self.resolution.panels * self.panel_nodes

    @cached_property
    def meridian(self) -> Meridian:
        """Nodes of the meridian."""
        return Meridian(self.curve, self.resolution)

    def refined(self, by: Refinement) -> PanelNodes:
        """Nodes of the refined panels, of the plain product rule; made once."""
        if by not in self._refined:
            fine = replace(self.resolution, nodes=by.meridian * self.resolution.nodes)
            meridian = Meridian(self.curve, fine)
            self._refined[by] = PanelNodes.of(meridian, by.azimuth * self.resolution.angles)
        return self._refined[by]

    @property
    def refined_bytes(self) -> int:
        """Of the refined nodes that have been asked for."""
        return sum(nodes.points.nbytes * 7 // 3 for nodes in self._refined.values())

    @cached_property
    def _refined(self) -> dict[Refinement, PanelNodes]:
        return {}


@dataclass(frozen=True)
class PanelNodes:
    """Nodes of a unit shape by panel: points, normals (P, k, 3), weights of area (P, k)."""

    points: Array
    normals: Array
    weights: Array

    @classmethod
    def of(cls, meridian: Meridian, angles: int) -> PanelNodes:
        """Product of the meridian's nodes and so many equal angles from 0 on."""
        theta = 2.0 * math.pi / angles * np.arange(angles)
        panels = meridian.resolution.panels
        ring = 2.0 * math.pi / angles * meridian.weights * meridian.r
        return cls(
            _turned(meridian.r, meridian.z, theta).reshape(panels, -1, 3),
            _turned(meridian.normal_r, meridian.normal_z, theta).reshape(panels, -1, 3),
            np.repeat(ring, angles).reshape(panels, -1),
        )


def _turned(radial: Array, axial: Array, theta: Array) -> Array:
    x, y = radial[:, None] * np.cos(theta), radial[:, None] * np.sin(theta)
    return np.stack([x, y, np.broadcast_to(axial[:, None], x.shape)], axis=-1)


def refine(values: Array, by: Refinement, upward: Array) -> Array:
    """Panels' fields (g, nodes, n_theta, 3, m), local components, on refined nodes (g, k, 3, m).

    upward: (by.meridian nodes, nodes) interpolation along the meridian.
    """
    g, q, angles, _, m = values.shape
    if by == (1, 1):
        return values.reshape(g, q * angles, 3, m)
    coefficients = to_modes(values.reshape(g * q, angles, 3, m))
    modes, rows, _ = coefficients.shape
    finer = coefficients.reshape(modes, rows, 3 * g, q) @ upward.T
    fine = from_modes(finer.reshape(modes, rows, -1), by.azimuth * angles, (m,))
    return fine.reshape(g, -1, 3, m)


class Surfaces:
    """The surface nodes of bodies, which fast sums take as sources.

    shapes   : distinct unit shapes; shape (b,) the number of each body's
    start    : (b + 1,) first node of each body
    rotation : (b, 3, 3) local to world, centre (b, 3), scale (b,)
    """

    def __init__(self, bodies: Sequence[Body], resolutions: Sequence[Resolution]) -> None:
        """Bodies, and the resolution of each."""
        if len(bodies) != len(resolutions):
            raise ValueError(f"{len(bodies)} bodies, but {len(resolutions)} resolutions")
        number: dict[UnitShape, int] = {}
        shapes = [UnitShape(b.curve, r) for b, r in zip(bodies, resolutions, strict=True)]
        self.shape = np.array([number.setdefault(s, len(number)) for s in shapes], dtype=np.int64)
        self.shapes = tuple(number)
        self.rotation = np.array([b.rotation for b in bodies]).reshape(-1, 3, 3)
        self.centre = np.array([b.centre for b in bodies], dtype=float).reshape(-1, 3)
        self.scale = np.array([b.scale for b in bodies], dtype=float)
        sizes = np.array([s.nodes for s in self.shapes], dtype=np.int64)[self.shape]
        self.start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        return len(self.shape)

    @property
    def nodes(self) -> int:
        """Number of nodes n of all bodies."""
        return int(self.start[-1])

    def all_panels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Body and panel of all panels of all bodies, in the order of the nodes."""
        panels = np.array([s.resolution.panels for s in self.shapes], dtype=np.int64)[self.shape]
        body = np.repeat(np.arange(self.bodies), panels)
        first = np.concatenate([[0], np.cumsum(panels)])[:-1]
        return body, np.arange(len(body)) - np.repeat(first, panels)

    def to_local(self, points: Array, body: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Cylindrical r, theta, z (k,) of world points (k, 3) in the unit frames of bodies (k,)."""
        offset = points - self.centre[body]
        x, y, z = np.einsum("kij,ki->jk", self.rotation[body], offset) / self.scale[body]
        return np.hypot(x, y), np.arctan2(y, x), z

    def sources(self) -> PanelSources:
        """All nodes as sources of a fast sum."""
        return PanelSources(self, *self.all_panels())

    def density(self, values: ArrayLike) -> Array:
        """Check a density (n, 3[, m]) and return it as (n, 3, m)."""
        array = np.asarray(values, dtype=np.float64)
        if array.ndim not in (2, 3) or array.shape[:2] != (self.nodes, 3):
            raise ValueError(f"density of shape {array.shape}: must be ({self.nodes}, 3[, m])")
        return np.ascontiguousarray(array if array.ndim == 3 else array[:, :, None])


@dataclass(frozen=True)
class _Group:
    """Panels of one shape that are refined alike: their positions among the sources' panels."""

    shape: UnitShape
    by: Refinement
    members: NDArray[np.int64]
    nodes: PanelNodes
    upward: Array

    @classmethod
    def of(cls, shape: UnitShape, by: Refinement, members: NDArray[np.int64]) -> _Group:
        q = shape.resolution.nodes
        upward = interpolation_matrix(q, gauss_legendre(by.meridian * q)[0])
        return cls(shape, by, members, shape.refined(by), upward)


class PanelSources:
    """Nodes of some panels of some bodies, each refined in its own way, as sources.

    count : n nodes; those of panel i stand in rows begin[i]:end[i]
    """

    def __init__(
        self,
        surfaces: Surfaces,
        body: NDArray[np.int64],
        panel: NDArray[np.int64],
        refinement: Sequence[Refinement] | None = None,
    ) -> None:
        """Panels by body and number, (g,) each, and how each is refined (default: not)."""
        self.surfaces = surfaces
        self.body, self.panel = body, panel
        by = np.ones((len(body), 2), np.int64) if refinement is None else np.array(refinement)
        self._groups: list[_Group] = []
        size = np.zeros(len(body), np.int64)
        for members in _alike(surfaces.shape[body], *by.reshape(-1, 2).T):
            shape = surfaces.shapes[surfaces.shape[body[members[0]]]]
            how = Refinement(*by[members[0]].tolist())
            group = _Group.of(shape, how, members)
            size[members] = group.nodes.weights.shape[1]
            self._groups.append(group)
        self.end = np.cumsum(size)
        self.begin = self.end - size
        self.count = int(size.sum())

    @property
    def points(self) -> Array:
        """Positions (n, 3) in the world."""
        points = np.empty((self.count, 3))
        for group in self._groups:
            points[self._rows(group.members)] = self._in_world(group)
        return points

    def single_weights(self, density: Array, coefficient: ArrayLike = 1.0) -> Array:
        """Weights (n, 3, m) of the kernel `stokeslet` for a (S f) of densities (N, 3, m).

        coefficient: a, one for all bodies or (b,). Sums of the other kernels of a point force with
        the same weights are its pressure and stress, for viscosity 1, per unit of length.
        """
        return self.weights(density, coefficient, None)[0]

    def double_weights(self, density: Array, coefficient: ArrayLike = 1.0) -> Array:
        """Weights (n, 6, m) of the kernel `stresslet` for b (D f); coefficient: b."""
        return self.weights(density, None, coefficient)[1]

    def weights(
        self, density: Array, single: ArrayLike | None, double: ArrayLike | None
    ) -> tuple[Array | None, Array | None]:
        """Both at once; None for a layer whose coefficient is None."""
        count, fields = self.count, density.shape[2]
        out = (
            None if single is None else np.empty((count, 3, fields)),
            None if double is None else np.empty((count, 6, fields)),
        )
        for group in self._groups:
            rows = self._rows(group.members)
            vectors = self._vectors(density, group)
            if single is not None:
                # lengths of the world in a kernel of degree -1 against those of the unit shape
                out[0][rows] = self._scaled(vectors, group, single, 1).reshape(-1, 3, fields)
            if double is not None:
                scaled = self._scaled(vectors, group, double, 2)
                out[1][rows] = _stresslets(scaled, self._normals(group)).reshape(-1, 6, fields)
        return out

    def _vectors(self, density: Array, group: _Group) -> Array:
        """Densities times weights of area over 8 pi, world components, (g, k, 3, m)."""
        fine = refine(self._gathered(density, group), group.by, group.upward)
        area = group.nodes.weights[self.panel[group.members]] / (8.0 * math.pi)
        return self.surfaces.rotation[self.body[group.members]][:, None] @ (
            fine * area[..., None, None]
        )

    def _scaled(self, vectors: Array, group: _Group, coefficient: ArrayLike, power: int) -> Array:
        s = self.surfaces
        factor = np.broadcast_to(coefficient, s.bodies) * s.scale**power
        return vectors * factor[self.body[group.members], None, None, None]

    def _normals(self, group: _Group) -> Array:
        normals = group.nodes.normals[self.panel[group.members]]
        return _turn(normals, self.surfaces.rotation[self.body[group.members]])

    def _gathered(self, density: Array, group: _Group) -> Array:
        """Nodal densities of panels (g, nodes, n_theta, 3, m)."""
        size, resolution = group.shape.panel_nodes, group.shape.resolution
        first = self.surfaces.start[self.body[group.members]] + self.panel[group.members] * size
        nodal = density[first[:, None] + np.arange(size)]
        return nodal.reshape(-1, resolution.nodes, resolution.angles, 3, density.shape[2])

    def _in_world(self, group: _Group) -> Array:
        s, body = self.surfaces, self.body[group.members]
        turned = _turn(group.nodes.points[self.panel[group.members]], s.rotation[body])
        moved = s.centre[body][:, None] + s.scale[body][:, None, None] * turned
        return moved.reshape(-1, 3)

    def _rows(self, members: NDArray[np.int64]) -> NDArray[np.int64]:
        size = self.end[members[0]] - self.begin[members[0]]
        return (self.begin[members][:, None] + np.arange(size)).ravel()


def _turn(vectors: Array, rotation: Array) -> Array:
    """Vectors (g, k, 3) turned by rotations (g, 3, 3)."""
    return vectors @ np.swapaxes(rotation, 1, 2)


def _alike(*keys: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Positions of equal tuples of keys, in rising order within each group."""
    if len(keys[0]) == 0:
        return []
    _, group = np.unique(np.stack(keys, axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _stresslets(vectors: Array, normals: Array) -> Array:
    """Symmetric products (g, k, 6, m) of vectors (g, k, 3, m) and normals (g, k, 3).

    Twice the mean of both orders off the diagonal: the weights of the kernel `stresslet`.
    """
    columns = []
    for i, j in _STRESSLET:
        product = vectors[:, :, i] * normals[:, :, j, None]
        if i != j:
            product = product + vectors[:, :, j] * normals[:, :, i, None]
        columns.append(product)
    return np.stack(columns, axis=2)
