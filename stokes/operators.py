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

Symbols: n_s nodes of the meridian, M modes; matrices (M + 1, 3 n_s, 3 n_s).
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
from stokes.quadrature import PanelRule, gauss_legendre, interpolation_matrix, self_rule

Array = NDArray[np.float64]

# Nodes closer than this, relative to the body, take their differences from the curve: those of
# their coordinates would lose two digits or more.
_CLOSE = 0.1


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

    meridian, grid : its nodes;  threads : that assembly may use (any number gives the same bits)
    """

    def __init__(self, curve: Curve, resolution: Resolution, threads: int = 1) -> None:
        self.curve = curve
        self.resolution = resolution
        self.threads = threads
        self.meridian = Meridian(curve, resolution)
        self.grid = SurfaceGrid(self.meridian)
        self._matrices: dict[Layer, Array] = {}

    def matrices(self, layer: Layer | str) -> Array:
        """The layer's matrices (modes + 1, 3 n_s, 3 n_s), read-only and kept."""
        layer = Layer(layer)
        if layer not in self._matrices:
            matrices = self._assembled(layer)
            matrices.setflags(write=False)
            self._matrices[layer] = matrices
        return self._matrices[layer]

    def plain(self, layer: Layer | str, refinement: tuple[int, int] = (1, 1)) -> Array:
        """The same of the plain product rule with the term x = x' left out, (modes + 1, ...).

        refinement : so many times the azimuths, so many times the Gauss nodes of each panel, to
        which densities are first interpolated
        """
        azimuth, nodes = refinement[0], refinement[1] * self.resolution.nodes
        fine = Meridian(self.curve, replace(self.resolution, nodes=nodes))
        cosine, sine = self._transform(azimuth * self.resolution.angles)
        size = 3 * self.meridian.size
        plain = np.empty((self.resolution.modes + 1, size, 3 * fine.size))
        with limited_threads(self.threads):
            plain_modes.using(self.threads)(
                _PLAIN[Layer(layer)],
                _node_table(self.meridian),
                _node_table(fine),
                fine.weights * fine.r,
                2.0 * math.pi / (azimuth * self.resolution.angles),
                cosine,
                sine,
                plain,
            )
        if refinement[1] == 1:
            return plain
        return plain @ np.kron(np.eye(3), self._panel_interpolation(nodes))

    @property
    def nbytes(self) -> int:
        """Bytes of the matrices held."""
        return sum(matrices.nbytes for matrices in self._matrices.values())

    def release(self) -> None:
        """Forget the matrices and what they are made of; they are made again if asked for."""
        self._matrices.clear()
        for name in ("_rule", "_separations"):
            self.__dict__.pop(name, None)

    def _assembled(self, layer: Layer) -> Array:
        N = self.meridian.size
        rule = self._rule
        matrices = np.empty((self.resolution.modes + 1, 3 * N, 3 * N))
        with limited_threads(self.threads):
            assemble.using(self.threads)(
                KINDS[_KERNEL[layer]],
                _node_table(self.meridian),
                self.meridian.weights * self.meridian.r,
                *self._separations,
                self.resolution.nodes,
                np.searchsorted(rule.pairs[:, 0], np.arange(N + 1)),
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
        return self_rule(self.meridian)

    @cached_property
    def _separations(self) -> tuple[Array, Array]:
        """Differences and normal offsets between nodes, (n_s, n_s, 2) each.

        Far apart, those of the coordinates have all the digits there are.
        """
        nodes, s = _node_table(self.meridian), self.meridian.s
        difference = nodes[:, None, :2] - nodes[None, :, :2]
        offsets = np.stack(
            [
                np.einsum("...k,...k", side, difference)
                for side in (nodes[:, None, 2:], nodes[None, :, 2:])
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
