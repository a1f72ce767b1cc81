"""Tensor grids of Lagrange polynomials in the boxes of an octree, and the passes over them.

A kernel is replaced by its interpolant k(x, y) ≈ Σ_α S_α(x) Σ_β k(x_α, y_β) S_β(y), α and β
triples of nodes (P. Blanchard, PhD thesis, Université de Bordeaux 2017, section 1.2). Points give
moments to the grids of their leaves (P2M, eq. 1.17), children to their parents (M2M, 1.18),
parents back to their children (L2L, 1.20), leaves to their points (L2P, 1.21). A derivative of
the kernel is had by differentiating S instead (1.12).

Symbols: S_i Lagrange polynomial of node i; nodes the number ℓ of nodes per direction, one more
than the polynomials' degree; half half the edge of a box. Coordinates, moments and edges are in
any one unit of length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from dem_mpi._jit import ThreadedKernel
from stokes.fmm import _kernels_interpolation as kernels

if TYPE_CHECKING:
    from stokes.fmm.tree import Boxes


@dataclass(frozen=True)
class Grid:
    """Interpolation nodes on [-1, 1], the same in the three directions of a box.

    kind: "equispaced", nodes from end to end (B eq. 5.1): kernels of a difference give Toeplitz
        matrices, but the polynomials grow as 2^nodes and with them round-off; "chebyshev", the
        roots of the Chebyshev polynomial of degree `nodes` (B section 1.2): stable at any number.
    nodes: number per direction, at least one; polynomials of degree nodes - 1 are exact.
    extent: the nodes are those of `kind` times this factor.

    Raises ValueError for an unknown kind, no node or an extent that is not positive.
    """

    kind: Literal["equispaced", "chebyshev"]
    nodes: int
    extent: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in ("equispaced", "chebyshev"):
            raise ValueError(f"grid kind {self.kind!r}: must be 'equispaced' or 'chebyshev'")
        if self.nodes < 1:
            raise ValueError(f"grid of {self.nodes} nodes: must have at least 1")
        if not self.extent > 0.0:
            raise ValueError(f"grid extent {self.extent}: must be > 0")

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The nodes (nodes,), rising, symmetric about 0 to the bit."""
        i = np.arange(self.nodes)
        rank = 2 * i + 1 - self.nodes  # antisymmetric: so are the quotients and sines of it
        if self.kind == "chebyshev":
            unit = np.sin(0.5 * np.pi * rank / self.nodes)
        else:
            unit = rank / max(self.nodes - 1, 1)
        return self.extent * unit

    @cached_property
    def scale(self) -> NDArray[np.float64]:
        """Barycentric weights (nodes,), 1 / Π_{j≠i} (x_i - x_j)."""
        difference = self.points[:, None] - self.points
        np.fill_diagonal(difference, 1.0)
        return 1.0 / np.prod(difference, axis=1)

    @cached_property
    def lebesgue(self) -> float:
        """max over [-1, 1] of Σ_i |S_i(x)|: the factor by which round-off in moments may grow."""
        # The maximum lies between two nodes or at an end; ten samples a gap find it to 2 %.
        x = np.linspace(-1.0, 1.0, 20 * self.nodes + 1)
        return float(np.abs(self.evaluate(x)).sum(axis=1).max())

    @cached_property
    def noise_gain(self) -> float:
        """Growth of independent round-off in the nodes' kernel values, both boxes interpolated.

        Root mean square over targets and sources of |S(x)| |S(y)|, that is (mean of Σ_i S_i²)³.
        Times the rounding unit it is the floor under the error of a sum, relative to the kernel:
        below 1 on Chebyshev nodes; on equispaced ones 11 at 8 nodes, 3e2 at 10, 4e4 at 12, 1e7
        at 14, so that more nodes than about 13 in double and 7 in single make sums worse.
        """
        x, weight = np.polynomial.legendre.leggauss(self.nodes)  # exact: degree 2 (nodes - 1)
        return float(0.5 * weight @ (self.evaluate(x) ** 2).sum(axis=1)) ** 3

    def evaluate(self, x: ArrayLike) -> NDArray[np.float64]:
        """S_i(x_q) as (n, nodes) at x (n,): stable everywhere, exact zeros and 1 at the nodes."""
        t = np.ascontiguousarray(x, dtype=np.float64).ravel()
        s = np.empty((self.nodes, len(t)))
        kernels.lagrange(t, self.points, self.scale, s)
        return s.T

    def derivative(self, x: ArrayLike) -> NDArray[np.float64]:
        """S_i'(x_q) as (n, nodes) at x (n,)."""
        t = np.ascontiguousarray(x, dtype=np.float64).ravel()
        s, ds = np.empty((2, self.nodes, len(t)))
        kernels.lagrange_derivative(t, self.points, self.scale, s, ds)
        return ds.T

    def halves(self) -> NDArray[np.float64]:
        """[h, i, j] = S_i(node j of half h): (2, nodes, nodes), the lower half first.

        Contracted over j they carry a child's moments to its parent (M2M), over i a parent's
        local expansion to its child (L2L).
        """
        lower = self.evaluate(0.5 * (self.points - 1.0)).T
        upper = self.evaluate(0.5 * (self.points + 1.0)).T
        return np.ascontiguousarray([lower, upper])


class Interpolator:
    """The passes of one grid over tables of boxes.

    Moments (multipoles) and local expansions are (boxes, components, nodes³) or (boxes,
    components, nodes, nodes, nodes), C-contiguous, of the type `dtype` (double or single);
    points x are (3, n), sorted so that every box's are a range. All passes add to what stands.
    Results do not depend on the number of threads.
    """

    def __init__(self, grid: Grid, dtype: DTypeLike = np.float64, threads: int = 1) -> None:
        self.grid = grid
        self.dtype = np.dtype(dtype)
        self.threads = threads
        if self.dtype not in (np.dtype(np.float64), np.dtype(np.float32)):
            raise ValueError(f"interpolator of {self.dtype}: must be float64 or float32")
        self._to_parent = grid.halves().astype(self.dtype)
        self._to_child = np.ascontiguousarray(self._to_parent.transpose(0, 2, 1))

    def empty_moments(self, boxes: Boxes, components: int) -> NDArray:
        """Zeros (boxes, components, nodes³) of the right type."""
        return np.zeros((len(boxes), components, self.grid.nodes**3), self.dtype)

    def upward(
        self,
        boxes: Boxes,
        x: NDArray,
        weights: NDArray,
        multipoles: NDArray,
        root_edge: float = 1.0,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        own: NDArray[np.bool_] | None = None,
        gradient: bool = False,
    ) -> None:
        """Moments of all boxes: `p2m` at the leaves, then `m2m` from the finest level to the root.

        Arguments as of `p2m`.
        """
        self.p2m(
            boxes, x, weights, multipoles, root_edge, origin=origin, own=own, gradient=gradient
        )
        for level in range(boxes.depth - 1, -1, -1):
            self.m2m(boxes, level, multipoles, own=own)

    def p2m(
        self,
        boxes: Boxes,
        x: NDArray,
        weights: NDArray,
        multipoles: NDArray,
        root_edge: float = 1.0,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        own: NDArray[np.bool_] | None = None,
        gradient: bool = False,
    ) -> None:
        """Moments of the leaves from their source points (B eq. 1.17).

        x : (3, n) in the root cube at `origin` of edge `root_edge`; weights : (n_in, n), or
        (3 n_in, n) with `gradient`, when the sum is Σ_a weights[3 c + a] ∂S/∂y_a (a kernel
        differentiated along its source); own : (boxes,), leaves to be filled (default all).
        """
        kernel = (kernels.p2m_gradient if gradient else kernels.p2m).using(self.threads)
        leaves = self._leaves(boxes, boxes.sources, (origin, root_edge), own)
        kernel(x, weights, *leaves, self._planes(multipoles))

    def l2p(
        self,
        boxes: Boxes,
        x: NDArray,
        locals_: NDArray,
        out: NDArray,
        root_edge: float = 1.0,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        own: NDArray[np.bool_] | None = None,
        gradient: bool = False,
    ) -> None:
        """Values at the target points from the local expansions of their leaves (B eq. 1.21).

        x : (3, n); out : (n_out, n) float64, or (3 n_out, n) with `gradient`, when
        out[3 c + a] is the derivative of component c along x_a.
        """
        kernel = (kernels.l2p_gradient if gradient else kernels.l2p).using(self.threads)
        leaves = self._leaves(boxes, boxes.targets, (origin, root_edge), own)
        kernel(x, self._planes(locals_), *leaves, out)

    def m2m(
        self,
        boxes: Boxes,
        level: int,
        multipoles: NDArray,
        *,
        own: NDArray[np.bool_] | None = None,
    ) -> None:
        """Add the moments of level + 1 to their parents, on `level` (B eq. 1.18)."""
        self._between(kernels.m2m, self._to_parent, boxes, level, multipoles, own)

    def l2l(
        self,
        boxes: Boxes,
        level: int,
        locals_: NDArray,
        *,
        own: NDArray[np.bool_] | None = None,
    ) -> None:
        """Add the local expansions of `level` to their children, on level + 1 (B eq. 1.20)."""
        self._between(kernels.l2l, self._to_child, boxes, level, locals_, own)

    def evaluate(
        self,
        boxes: Boxes,
        x: NDArray,
        locals_: NDArray,
        out: NDArray,
        root_edge: float = 1.0,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        own: NDArray[np.bool_] | None = None,
        gradient: bool = False,
    ) -> None:
        """Values from local expansions of all levels: `l2l` downwards, then `l2p` at the leaves.

        Arguments as of `l2p`; `locals_` is changed (children receive their parents').
        """
        for level in range(boxes.depth):
            self.l2l(boxes, level, locals_, own=own)
        self.l2p(boxes, x, locals_, out, root_edge, origin=origin, own=own, gradient=gradient)

    def _between(
        self,
        kernel: ThreadedKernel,
        matrices: NDArray,
        boxes: Boxes,
        level: int,
        moments: NDArray,
        own: NDArray[np.bool_] | None,
    ) -> None:
        """Add between the boxes of `level` and their children, by `matrices` (2, nodes, nodes)."""
        parents = self._parents(boxes, level, own)
        kernel.using(self.threads)(parents, boxes.children, matrices, self._flat(moments))

    def _leaves(self, boxes: Boxes, ranges: NDArray, frame: tuple, own: NDArray | None) -> tuple:
        """Arguments of the loops over leaves: those with points, ranges, geometry, polynomials."""
        filled = boxes.leaf & (ranges[:, 1] > ranges[:, 0])
        if own is not None:
            filled &= own
        origin, root_edge = frame
        centre = boxes.centres(origin, root_edge)
        half = 0.5 * boxes.edges(root_edge)[boxes.level]
        return np.flatnonzero(filled), ranges, centre, half, self.grid.points, self.grid.scale

    def _parents(self, boxes: Boxes, level: int, own: NDArray | None) -> NDArray[np.int64]:
        here = boxes.of_level(level)
        has_children = boxes.children[here].max(axis=1, initial=-1) >= 0
        if own is not None:
            has_children &= own[here]
        return here.start + np.flatnonzero(has_children)

    def _flat(self, moments: NDArray) -> NDArray:
        """View of moments as (boxes, components, nodes³); ValueError if it would be a copy."""
        if moments.dtype != self.dtype or not moments.flags.c_contiguous:
            raise ValueError(f"moments: must be C-contiguous {self.dtype}, got {moments.dtype}")
        return moments.reshape(*moments.shape[:2], self.grid.nodes**3)

    def _planes(self, moments: NDArray) -> NDArray:
        """View of moments as (boxes, components, nodes, nodes²), x apart from y and z."""
        nodes = self.grid.nodes
        return self._flat(moments).reshape(*moments.shape[:2], nodes, nodes**2)
