"""Layer potentials on a surface of revolution: one real dense matrix for each Fourier mode.

    single    (S rho)(x) = int 1/(8 pi) (1/R + R R^T / R^3) rho dS'              velocity
    double    (D mu)(x)  = int 3/(4 pi) R (R.mu) (R.nu') / R^5 dS'               velocity
    traction  (T rho)(x) = -3/(4 pi) int R (R.rho) (R.nu) / R^5 dS'              traction of S rho

with R = x - x', on the surface itself (D and T as principal values), viscosity 1. From outside
(inside) the limits are S, D + 1/2 (D - 1/2) and T - 1/2 (T + 1/2). T is the transpose of D in the
inner product of the surface. S of a body `scale` times as large is `scale` S; D and T are the same.

The matrices act on coefficients as `stokes.modes` orders them. Sources on panels far from the
target's are taken at their nodes; the target's panel and those it nearly touches by rules for the
singular kernel, on which the density is interpolated (Nyström's method; S. De, PhD thesis,
University of Michigan 2021, section 3.3, with other rules).

Symbols: n_s nodes of the meridian, m fields.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stokes import _kernels_plain
from stokes._kernels_assembly import assemble
from stokes._kernels_plain import plain_modes
from stokes.fmm._threads import limited_threads
from stokes.geometry import Curve, Meridian, Resolution, SurfaceGrid
from stokes.modal import KINDS
from stokes.modes import from_modes, to_modes
from stokes.quadrature import PanelRule, gauss_legendre, interpolation_matrix, self_rule

Array = NDArray[np.float64]

# Nodes closer than this, relative to the body, take their differences from the curve: those of
# their coordinates would lose two digits or more.
_CLOSE = 0.1
# What nodes may differ from their mirror image by, relative to the body.
_ROUNDING = 1e-13
# Signs of (f_r, f_theta, f_z) in the mirror image of a field.
_MIRROR = np.array([1.0, 1.0, -1.0])[:, None]


class Layer(StrEnum):
    """The kinds of matrices."""

    SINGLE = "single"
    DOUBLE = "double"
    TRACTION = "traction"


_KERNEL = {
    Layer.SINGLE: "velocity_single",
    Layer.DOUBLE: "velocity_double",
    Layer.TRACTION: "traction_single",
}
_PLAIN = {
    Layer.SINGLE: _kernels_plain.SINGLE,
    Layer.DOUBLE: _kernels_plain.DOUBLE,
    Layer.TRACTION: _kernels_plain.TRACTION,
}


class ModalOperators:
    """S, D and T of one unit shape at one resolution; each is assembled when first asked for.

    A meridian that is its own mirror image, nodes and all, takes even fields to even ones and odd
    to odd: a matrix falls apart into `parts` = 2 of half the size, else `parts` = 1. Even is a
    field with f(r, -z) = (f_r, f_theta, -f_z)(r, z). Matrices then have only the rows of the
    northern half of the nodes, and half of the kernel's values is never computed.

    meridian, grid : its nodes;  threads : that assembly may use (any number gives the same bits)
    """

    def __init__(self, curve: Curve, resolution: Resolution, threads: int = 1) -> None:
        self.curve = curve
        self.resolution = resolution
        self.threads = threads
        self.meridian = Meridian(curve, resolution)
        self.grid = SurfaceGrid(self.meridian)
        self.parts = 2 if _is_mirrored(self.meridian) else 1
        self._matrices: dict[Layer, Array] = {}

    def matrices(self, layer: Layer | str) -> Array:
        """The layer's matrices (modes + 1, parts, 3 n_s / parts, 3 n_s / parts), kept."""
        layer = Layer(layer)
        if layer not in self._matrices:
            matrices = self.fold(self._assembled(layer))
            matrices.setflags(write=False)
            self._matrices[layer] = matrices
        return self._matrices[layer]

    def apply(self, layer: Layer | str, field: Array) -> Array:
        """The layer of a density (n_s, n_theta, 3[, m]) on the surface, its principal value."""
        return self.multiply(self.matrices(layer), field)

    def plain(self, layer: Layer | str, refinement: tuple[int, int] = (1, 1)) -> Array:
        """Matrices as those of `matrices`, of the plain product rule without the term x = x'.

        refinement : so many times the azimuths, so many times the Gauss nodes of each panel, to
        which densities are first interpolated
        """
        azimuth, nodes = refinement[0], refinement[1] * self.resolution.nodes
        fine = Meridian(self.curve, replace(self.resolution, nodes=nodes))
        cosine, sine = self._transform(azimuth * self.resolution.angles)
        plain = np.empty((self.resolution.modes + 1, 3 * self._rows, 3 * fine.size))
        with limited_threads(self.threads):
            plain_modes.using(self.threads)(
                _PLAIN[Layer(layer)],
                _node_table(self.meridian)[: self._rows],
                _node_table(fine),
                fine.weights * fine.r,
                2.0 * math.pi / (azimuth * self.resolution.angles),
                cosine,
                sine,
                plain,
            )
        if refinement[1] > 1:
            plain = plain @ np.kron(np.eye(3), self._panel_interpolation(nodes))
        return self.fold(plain)

    @property
    def nbytes(self) -> int:
        """Bytes of the matrices held."""
        return sum(matrices.nbytes for matrices in self._matrices.values())

    def release(self) -> None:
        """Forget the matrices and what they are made of; they are made again if asked for."""
        self._matrices.clear()
        for name in ("_rule", "_separations"):
            self.__dict__.pop(name, None)

    # ---- coefficients ------------------------------------------------------------------------

    def to_rows(self, field: Array) -> Array:
        """Coefficients (modes + 1, parts, 2 m, 3 n_s / parts) of fields (n_s, n_theta, 3[, m])."""
        rows = to_modes(field)
        modes, count, _ = rows.shape
        if self.parts == 1:
            return rows[:, None]
        north, south = self._halves(rows.reshape(modes, count, 3, -1))
        halves = np.stack([0.5 * (north + south), 0.5 * (north - south)], axis=1)
        return halves.reshape(modes, 2, count, -1)

    def from_rows(self, rows: Array, fields: tuple[int, ...] = ()) -> Array:
        """Fields (n_s, n_theta, 3) + fields of such coefficients; `fields` is () or (m,)."""
        modes, _, count, _ = rows.shape
        if self.parts == 2:
            even, odd = np.moveaxis(rows.reshape(modes, 2, count, 3, -1), 1, 0)
            south = (_MIRROR * (even - odd))[..., ::-1]
            rows = np.concatenate([even + odd, south], axis=-1)
        return from_modes(rows.reshape(modes, count, -1), self.grid.shape[1], fields)

    def multiply(self, matrices: Array, field: Array) -> Array:
        """Fields (n_s, n_theta, 3[, m]) that matrices, shaped as `matrices`' are, make of such."""
        rows = self.to_rows(field) @ np.swapaxes(matrices, -1, -2)
        return self.from_rows(rows, np.shape(field)[3:])

    def fold(self, matrices: Array) -> Array:
        """Parts (..., parts, k, k) of matrices (..., 3 n_s or only the northern rows, 3 n_s)."""
        if self.parts == 1:
            return matrices[..., None, :, :]
        size, n_s = 3 * self._rows, self.meridian.size
        if matrices.shape[-2] > size:
            rows = matrices.reshape(*matrices.shape[:-2], 3, n_s, 3 * n_s)[..., : self._rows, :]
            matrices = rows.reshape(*matrices.shape[:-2], size, 3 * n_s)
        north, south = self._halves(matrices.reshape(*matrices.shape[:-1], 3, n_s))
        parts = np.stack([north + south, north - south], axis=-4)
        return parts.reshape(*matrices.shape[:-2], 2, size, size)

    @property
    def _rows(self) -> int:
        """Nodes whose rows are kept: the northern ones or all."""
        return self.meridian.size // self.parts

    def _halves(self, values: Array) -> tuple[Array, Array]:
        """Values (..., 3, n_s) on the northern nodes and, mirrored onto them, the southern ones."""
        half = self._rows
        return values[..., :half], _MIRROR * values[..., : half - 1 : -1]

    # ---- assembly ----------------------------------------------------------------------------

    def _assembled(self, layer: Layer) -> Array:
        """Rows of the matrices, (modes + 1, 3 n_s / parts, 3 n_s)."""
        rule = self._rule
        matrices = np.empty((self.resolution.modes + 1, 3 * self._rows, 3 * self.meridian.size))
        with limited_threads(self.threads):
            assemble.using(self.threads)(
                KINDS[_KERNEL[layer]],
                _node_table(self.meridian),
                self.meridian.weights * self.meridian.r,
                *self._separations,
                self.resolution.nodes,
                np.searchsorted(rule.pairs[:, 0], np.arange(self._rows + 1)),
                (
                    rule.pairs,
                    rule.starts,
                    rule.weights * rule.points[:, 0],
                    rule.interpolation,
                    rule.points,
                    rule.difference,
                    rule.offsets,
                ),
                matrices,
            )
        if not np.isfinite(matrices).all():
            raise FloatingPointError(
                f"layer {layer} of {self.curve} with {self.resolution}: values that are not finite"
            )
        return matrices

    @cached_property
    def _rule(self) -> PanelRule:
        return self_rule(self.meridian, self.meridian.s[: self._rows])

    @cached_property
    def _separations(self) -> tuple[Array, Array]:
        """Differences and normal offsets between nodes, (n_s / parts, n_s, 2) each.

        Far apart, those of the coordinates have all the digits there are.
        """
        nodes, s = _node_table(self.meridian), self.meridian.s
        targets = nodes[: self._rows]
        difference = targets[:, None, :2] - nodes[:, :2]
        offsets = np.stack(
            [
                np.einsum("...k,...k", normals, difference)
                for normals in (targets[:, None, 2:], nodes[:, 2:])
            ],
            axis=-1,
        )
        distance = np.hypot(difference[..., 0], difference[..., 1])
        i, j = np.nonzero(distance < _CLOSE * self.curve.bounding_radius)
        difference[i, j] = np.column_stack(self.curve.differences(s[i], s[j]))
        offsets[i, j] = np.column_stack(self.curve.normal_offsets(s[i], s[j]))
        return difference, offsets

    def _transform(self, angles: int) -> tuple[Array, Array]:
        """Tables of `plain_modes` for so many azimuths."""
        step = 2.0 * math.pi / angles
        k = np.arange(angles // 2 + 1)
        phase = step * k[:, None] * np.arange(self.resolution.modes + 1)
        alone = (k == 0) | (2 * k == angles)  # else theta and -theta at once
        weight = step * np.where(alone, 1.0, 2.0)[:, None]
        return weight * np.cos(phase), weight * np.sin(phase)

    def _panel_interpolation(self, nodes: int) -> Array:
        """From the nodes of the meridian to `nodes` Gauss nodes of each panel."""
        points, _ = gauss_legendre(nodes)
        return np.kron(
            np.eye(self.resolution.panels), interpolation_matrix(self.resolution.nodes, points)
        )


def _node_table(meridian: Meridian) -> Array:
    """r, z, nu_r, nu_z of the nodes, (n_s, 4)."""
    return np.column_stack([meridian.r, meridian.z, meridian.normal_r, meridian.normal_z])


def _is_mirrored(meridian: Meridian) -> bool:
    """Whether the nodes are their own mirror image in z = 0, to round-off."""
    nodes = _node_table(meridian)
    image = nodes[::-1] * [1.0, -1.0, 1.0, -1.0]
    size = np.repeat([meridian.curve.bounding_radius, 1.0], 2)
    return meridian.size % 2 == 0 and bool(np.all(np.abs(nodes - image) < _ROUNDING * size))
