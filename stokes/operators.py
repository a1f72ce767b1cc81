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
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from stokes import _kernels_plain
from stokes._kernels_assembly import assemble
from stokes._kernels_plain import plain_modes
from stokes.fmm._threads import limited_threads
from stokes.geometry import Curve, Meridian, Resolution, SurfaceGrid
from stokes.modal import KINDS
from stokes.quadrature import gauss_legendre, interpolation_matrix, self_rule

Array = NDArray[np.float64]


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

    def plain(self, layer: Layer | str, sources: Resolution | None = None) -> Array:
        """The same of the plain product rule with the term x = x' left out, (modes + 1, ...).

        `sources` are nodes to which densities are first interpolated: the same panels with other
        Gauss nodes, an odd multiple of the azimuths. Raises ValueError for others.
        """
        layer, sources = Layer(layer), sources or self.resolution
        meridian = Meridian(self.curve, sources)
        cosine, sine = self._transform(sources)
        size, n_s = 3 * self.meridian.size, meridian.size
        plain = np.empty((self.resolution.modes + 1, size, 3 * n_s))
        with limited_threads(self.threads):
            plain_modes.using(self.threads)(
                _PLAIN[layer],
                _node_table(self.meridian),
                _node_table(meridian),
                meridian.weights * meridian.r,
                cosine,
                sine,
                plain,
            )
        if sources == self.resolution:
            return plain
        return plain @ np.kron(np.eye(3), self._panel_interpolation(sources.nodes))

    @property
    def nbytes(self) -> int:
        """Bytes of the matrices held."""
        return sum(matrices.nbytes for matrices in self._matrices.values())

    def release(self) -> None:
        """Forget the matrices; they are assembled again if asked for."""
        self._matrices.clear()

    def _assembled(self, layer: Layer) -> Array:
        meridian = self.meridian
        N = meridian.size
        rule = self_rule(meridian)
        s, t = np.meshgrid(meridian.s, meridian.s, indexing="ij")
        matrices = np.empty((self.resolution.modes + 1, 3 * N, 3 * N))
        with limited_threads(self.threads):
            assemble.using(self.threads)(
                KINDS[_KERNEL[layer]],
                _node_table(meridian),
                meridian.weights * meridian.r,
                np.stack(self.curve.differences(s, t), axis=-1),
                np.stack(self.curve.normal_offsets(s, t), axis=-1),
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
        return matrices

    def _transform(self, sources: Resolution) -> tuple[Array, Array]:
        """Tables of `plain_modes` for the azimuths of `sources`."""
        ratio, rest = divmod(sources.angles, self.resolution.angles)
        if sources.breaks != self.resolution.breaks or rest or ratio % 2 == 0:
            raise ValueError(
                f"sources {sources}: need the panels of {self.resolution} and an odd multiple "
                "of its azimuths"
            )
        step = 2.0 * math.pi / sources.angles
        t = step * np.arange(sources.modes + 1)
        angle = t[:, None] * np.arange(self.resolution.modes + 1)
        weight = np.where(t == 0.0, step, 2.0 * step)[:, None]
        return weight * np.cos(angle), weight * np.sin(angle)

    def _panel_interpolation(self, nodes: int) -> Array:
        """From the nodes of the meridian to `nodes` Gauss nodes of each panel."""
        points, _ = gauss_legendre(nodes)
        return np.kron(
            np.eye(self.resolution.panels), interpolation_matrix(self.resolution.nodes, points)
        )


def _node_table(meridian: Meridian) -> Array:
    """r, z, nu_r, nu_z of the nodes, (n_s, 4)."""
    return np.column_stack([meridian.r, meridian.z, meridian.normal_r, meridian.normal_z])
