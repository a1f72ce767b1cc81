"""The sum by a tree: points to grids, grids to grids, grids to points, and the near field.

phi_i = sum_j k(x_i - y_j) w_j by interpolation of the kernel (P. Blanchard, PhD thesis, Université
de Bordeaux 2017, ch. 1):

    k(x, y) ~ sum_a S_a(x) sum_b k(x_a, y_b) S_b(y)

for points x, y in two boxes that do not touch, with nodes x_a, y_b of their grids. All of it in
internal coordinates: the unit of length is the root cube's edge for a homogeneous kernel, the
kernel's own length for others, so that neither a grid nor a table knows the size of the cloud.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel
from stokes.fmm._threads import limited_threads
from stokes.fmm.chebyshev import CompressedTransfer, SymmetricTransfer
from stokes.fmm.close_pairs import ClosePairs
from stokes.fmm.distribution import Distribution
from stokes.fmm.interpolation import Grid, Interpolator
from stokes.fmm.kernels import Kernel
from stokes.fmm.lists import point_ranges
from stokes.fmm.near_field import NearField
from stokes.fmm.near_matrices import NearMatrices, stored_bytes
from stokes.fmm.options import Near
from stokes.fmm.transfer import FourierTransfer
from stokes.fmm.tree import Splitting

# Right-hand sides that pass through the stages together: a multiple of the near field's four.
_TOGETHER = 8
# Powers of two that weights in single precision may reach: half of the range for what they meet.
_SAFE_EXPONENT = 63


@dataclass(frozen=True)
class Scheme:
    """Everything that decides the result of a sum: two plans of one scheme give the same bits.

    method       : "ufmm", "bbfmm" or "symmetric"; nodes : of a grid in one direction
    single       : far field and pairs of the near field (`single_pairs`) in single precision
    derivative   : "exact", or "interpolated": transfers with the kernel's base
    direct_below : points of a box below which neither its multipole nor its local is used by
                   leaves of other levels
    operator_eps : of the operators of low rank
    close        : pairs closer than this part of the extent of the target's leaf are in double
    near         : "cached", "recomputed", or "auto": cached if the matrices fit
    near_memory  : bytes of the near field's matrices that fit on a rank
    """

    method: str
    nodes: int
    splitting: Splitting
    single: bool = False
    derivative: str = "exact"
    admissibility: str = "standard"
    direct_below: int = 0
    operator_eps: float = 1e-9
    close: float = 0.0
    near: Near = "recomputed"
    near_memory: float = 2e9


def grid_of(method: str, nodes: int) -> Grid:
    """The grid of a method: equispaced nodes a little inside the box where they are few.

    Their largest error is near the ends, and spreads with a smaller grid until the polynomials
    grow too much outside of it; with many nodes that growth multiplies round-off, and a larger
    grid than the box curbs it. The factors are the best measured for 1/r and the Stokeslet:
    errors are up to 2 times smaller with few nodes, 1000 times with 15. So curbed, equispaced
    nodes reach 2e-10 for the Stokeslet with 15, 9e-12 with 18 nodes (1/r: 2e-11, 4e-13).
    """
    if method != "ufmm":
        return Grid("chebyshev", nodes)
    few = {2: 0.7, 3: 0.77, 4: 0.86, 5: 0.9, 6: 0.94, 7: 0.95, 8: 0.96, 9: 0.98}
    many = {10: 1.0, 11: 1.0, 12: 1.15, 13: 1.15, 14: 1.15, 15: 1.15, 16: 1.25, 17: 1.3, 18: 1.3}
    return Grid("equispaced", nodes, (few | many).get(nodes, 1.4))


def single_pairs(kernel: Kernel) -> bool:
    """Whether single precision is enough for near pairs where it is for the far field.

    Not for kernels more singular than 1/r: there the closest pairs, whose difference has the
    fewest digits, make most of the sum's norm, the more so the more points there are (errors of
    1e-4 for 1/r^3 between 6000 points on a thin spheroid).
    """
    return kernel.degree is None or kernel.degree >= -1.0


class TreeSum:
    """A kernel, a tree and lists over fixed points, and tables: sums for any weights."""

    def __init__(
        self,
        kernel: Kernel,
        sources: NDArray,
        targets: NDArray | None,
        scheme: Scheme,
        parallel: Parallel,
        threads: int = 1,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        """Collective. Distribute the points, build tree, lists and tables.

        sources (n, 3), targets (m, 3), None for the sources: this rank's, in any unit, finite.
        clock: seconds, for the stages' times.
        """
        self.kernel = kernel
        self.scheme = scheme
        self._threads = threads
        self._clock = clock
        self.plan_seconds: dict[str, float] = {}
        self.apply_seconds: dict[str, float] = {}
        with self._timed(self.plan_seconds, "tree"):
            self.points = Distribution(
                parallel,
                sources,
                targets,
                scheme.splitting,
                admissibility=scheme.admissibility,
                direct_below=scheme.direct_below,
            )
            self._set_unit()
        with self._timed(self.plan_seconds, "lists"):
            self.lists = self.points.lists
        with limited_threads(threads):
            with self._timed(self.plan_seconds, "tables"):
                self._set_tables(threads)
            with self._timed(self.plan_seconds, "near"):
                self._set_near(threads)

    @contextmanager
    def _timed(self, seconds: dict[str, float], name: str) -> Iterator[None]:
        """Add the seconds spent inside to those of the stage."""
        start = self._clock()
        try:
            yield
        finally:
            seconds[name] = seconds.get(name, 0.0) + self._clock() - start

    def _set_unit(self) -> None:
        """Bring the points to internal coordinates: the root cube has its corner at the origin."""
        kernel, points = self.kernel, self.points
        self.boxes = points.boxes
        self._root_edge = 1.0 if kernel.homogeneous else points.edge / kernel.length
        unit = points.edge / self._root_edge
        self._factor = kernel.factor * (unit / kernel.length) ** (kernel.degree or 0.0)
        self._x_sources = _inside(points.x_sources, points.origin, unit)
        self._x_targets = (
            self._x_sources
            if points.x_targets is points.x_sources
            else _inside(points.x_targets, points.origin, unit)
        )
        self._inner = dataclasses.replace(kernel, length=1.0, factor=1.0)
        interpolated = self.scheme.derivative == "interpolated"
        self._gradient = kernel.derivative if interpolated else None
        self._far = self._inner
        if interpolated:
            # f k(r/l) is the gradient of f' k'(r/l): so is k(r) of f'/(f l) k'(r)
            factor = kernel.base.factor / (kernel.factor * kernel.length)
            self._far = dataclasses.replace(kernel.base, length=1.0, factor=factor)

    def _set_tables(self, threads: int) -> None:
        scheme = self.scheme
        dtype = self._dtype = np.dtype(np.float32 if scheme.single else np.float64)
        self.grid = grid_of(scheme.method, scheme.nodes)
        self._interpolator = Interpolator(self.grid, dtype, threads)
        make = {
            "ufmm": FourierTransfer,
            "bbfmm": partial(CompressedTransfer, eps=scheme.operator_eps),
            "symmetric": partial(SymmetricTransfer, eps=scheme.operator_eps),
        }[scheme.method]
        self.transfer = make(
            self._far,
            self.grid,
            self.boxes.edges(self._root_edge),
            admissibility=scheme.admissibility,
            dtype=dtype,
            threads=threads,
        )
        self._far_pairs = self._prepared_pairs()

    def _prepared_pairs(self) -> list[Any]:
        """The far pairs of every level that has some, in the order that the transfer wants."""
        boxes, cells = self.boxes, self.boxes.cells()
        prepared = []
        for level in range(boxes.levels):
            start, source, vector = self.lists.far.of_level(boxes, level)
            targets = np.arange(boxes.level_start[level], boxes.level_start[level + 1])
            if len(source):
                prepared.append(self.transfer.prepare(level, start, source, vector, targets, cells))
        return prepared

    def _set_near(self, threads: int) -> None:
        """Loops and ranges of the three lists that sum over points or nodes one by one."""
        boxes, lists = self.boxes, self.lists
        at_targets = self._inner if self._gradient != "source" else self._far
        at_sources = self._inner if self._gradient != "target" else self._far
        single = self.scheme.single
        self._points_on_points = NearField(
            self._inner, single and single_pairs(self._inner), threads
        )
        self._grids_on_points = NearField(at_targets, single, threads)
        self._points_on_grids = NearField(at_sources, single, threads)
        self._near = point_ranges(boxes, lists.near)
        self.near_matrices = self._stored_near(threads)
        # the boxes whose nodes stand for points
        self._w_boxes = np.unique(lists.multipole_to_target.source)
        self._w_nodes = self._nodes_of(self._w_boxes)
        self._w_ranges = self._ranges_of_multipoles()
        self._x_boxes = lists.source_to_local.rows()
        self._x_nodes = self._nodes_of(self._x_boxes)
        self._x_ranges = point_ranges(boxes, lists.source_to_local)[1:]
        self._set_close(threads)

    def _set_close(self, threads: int) -> None:
        """The pairs too close for single precision, of points, and of points and nodes.

        Nodes as targets have none: the groups are grids of small boxes, sources next to them are
        as far as nodes are from each other.
        """
        find = partial(ClosePairs, distance=self.scheme.close, threads=threads)
        self._close_points = self._close_nodes = None
        x, y, near = self._x_targets, self._x_sources, self._points_on_points
        targets, start, sources = self._near
        if near.single and self.near_matrices is None:
            self._close_points = find(near.kernel, x, targets, y, start, sources)
        nodes, on_points = self._w_nodes, self._grids_on_points
        targets, start, sources = self._w_ranges
        if on_points.single and len(self._w_boxes):
            self._close_nodes = find(on_points.kernel, x, targets, nodes, start, sources)

    def _stored_near(self, threads: int) -> NearMatrices | None:
        """Collective. The matrices of the near field, where they are wanted and fit."""
        scheme = self.scheme
        if scheme.near == "recomputed":
            return None
        targets, start, sources = self._near
        needed = stored_bytes(self._inner, scheme.single, targets, start, sources)
        largest = self.points.parallel.max(needed)
        if largest > scheme.near_memory:
            if scheme.near == "auto":
                return None
            raise ValueError(
                f"near = 'cached': the near field's matrices take {largest:.3g} bytes on a rank, "
                f"more than near_memory = {scheme.near_memory:.3g}: raise it, take near = "
                "'recomputed', a smaller leaf_size, or more ranks"
            )
        return NearMatrices(
            self._inner,
            *(self._x_targets, targets, self._x_sources, start, sources),
            single=scheme.single,
            threads=threads,
        )

    def _nodes_of(self, number: NDArray) -> NDArray:
        """Grid nodes (3, k nodes^3) of k boxes, in internal coordinates."""
        centre = self.boxes.centres(root_edge=self._root_edge)[number]
        half = 0.5 * self.boxes.edges(self._root_edge)[self.boxes.level[number]]
        axes = np.meshgrid(*3 * [self.grid.points], indexing="ij")
        unit = np.stack([axis.ravel() for axis in axes])
        nodes = centre.T[:, :, None] + half[None, :, None] * unit[:, None, :]
        return np.ascontiguousarray(nodes.reshape(3, -1))

    def _ranges_of_multipoles(self) -> tuple[NDArray, NDArray, NDArray]:
        """W as ranges: targets (k, 2), start (k + 1,), nodes (m, 2) of boxes in `_w_boxes`."""
        pairs = self.lists.multipole_to_target
        rows = pairs.rows()
        start = np.append(pairs.start[rows], pairs.start[-1])
        place = np.searchsorted(self._w_boxes, pairs.source).astype(np.int32)
        return self.boxes.targets[rows], start, _ranges(place, self.grid.nodes**3)

    def pair_counts(self) -> dict[str, int]:
        """Pairs summed by list: points, boxes, or nodes and points."""
        boxes, lists, nodes = self.boxes, self.lists, self.grid.nodes**3
        targets, sources = (np.diff(r, axis=1)[:, 0] for r in (boxes.targets, boxes.sources))
        near, w, x = lists.near, lists.multipole_to_target, lists.source_to_local
        return {
            "near": int(np.dot(targets[near.target()].astype(np.int64), sources[near.source])),
            "far": len(lists.far),
            "multipole_to_target": nodes * int(np.sum(targets[w.target()], dtype=np.int64)),
            "source_to_local": nodes * int(np.sum(sources[x.source], dtype=np.int64)),
        }

    def memory(self) -> dict[str, int]:
        """Bytes by part."""
        moment = self._dtype.itemsize * self.grid.nodes**3
        return {
            "points": self._x_sources.nbytes + self._x_targets.nbytes,
            "boxes": _bytes_of(self.boxes),
            "lists": sum(
                _bytes_of(pairs)
                for pairs in (
                    self.lists.near,
                    self.lists.far,
                    self.lists.multipole_to_target,
                    self.lists.source_to_local,
                )
            ),
            "tables": int(self.transfer.bytes),
            "spectra": self.transfer.spectra_bytes,
            "near": 0 if self.near_matrices is None else self.near_matrices.nbytes,
            "expansions": moment * len(self.boxes) * (self._far.n_in + self._far.n_out),
        }

    def apply(self, weights: NDArray) -> NDArray:
        """Collective. Sums (m, n_out, r) of weights (n, n_in, r), in the caller's order."""
        exponent = self._weight_exponents(weights) if self.scheme.single else None
        if exponent is not None:
            return np.ldexp(self.apply(np.ldexp(weights, -exponent)), exponent)
        with limited_threads(self._threads):
            parts = [
                self._apply_some(weights[:, :, first : first + _TOGETHER])
                for first in range(0, max(weights.shape[2], 1), _TOGETHER)
            ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)

    def _weight_exponents(self, weights: NDArray) -> NDArray | None:
        """Collective. Exponents (r,) of the largest weights, None if single precision holds them.

        Weights near the ends of its range are summed in powers of two: nothing is rounded.
        """
        largest = np.abs(weights).max(axis=(0, 1), initial=0.0)
        largest = self.points.parallel.max(np.nan_to_num(largest, posinf=0.0))
        exponent = np.frexp(largest)[1]
        return exponent if np.abs(exponent).max(initial=0) > _SAFE_EXPONENT else None

    def _apply_some(self, weights: NDArray) -> NDArray:
        """Some right-hand sides (n, n_in, r): upward, transfers, downward, near field.

        All of them go through every stage together; moments are (nb, r components, nodes^3).
        """
        stage = partial(self._timed, self.apply_seconds)
        columns = weights.shape[2]
        with stage("distribute"):
            w = self.points.scatter_weights(weights.transpose(0, 2, 1))
        with stage("upward"):
            multipoles = self._upward(w)
        with stage("exchange"):
            self.points.complete_multipoles(multipoles)
        values = np.zeros((columns, self.kernel.n_out, self._x_targets.shape[1]))
        with stage("far"):
            local = self._transfers(multipoles, columns)
        with stage("source_to_local"):
            self._add_points_on_grids(w, local)
        with stage("downward"):
            self._downward(local, values)
        with stage("multipole_to_target"):
            self._add_grids_on_points(multipoles, values)
        with stage("near"):
            self._add_near(w, values)
        with stage("distribute"):
            return self.points.gather(self._factor * values).transpose(0, 2, 1)

    def _add_near(self, w: NDArray, values: NDArray) -> None:
        """U: sources of touching leaves to targets."""
        if self.near_matrices is not None:
            self.near_matrices.add(w, values)
            return
        targets, start, sources = self._near
        self._points_on_points.add(
            self._x_targets, targets, self._x_sources, w, start, sources, values
        )
        if self._close_points is not None:
            self._close_points.correct(w, values)

    def _upward(self, w: NDArray) -> NDArray:
        """P2M at this rank's leaves, M2M to the root: multipoles (nb, r n_in, nodes^3)."""
        columns = len(w)
        multipoles = self._interpolator.empty_moments(self.boxes, columns * self._far.n_in)
        self._interpolator.upward(
            self.points.upward,
            self._x_sources,
            w.reshape(columns * w.shape[1], w.shape[2]),
            multipoles,
            self._root_edge,
            own=self.points.has_sources,
            gradient=self._gradient == "source",
        )
        return multipoles

    def _transfers(self, multipoles: NDArray, columns: int) -> NDArray:
        """M2L on every level: locals (nb, r n_out, nodes^3)."""
        n_in, n_out = self._far.n_in, self._far.n_out
        local = self._interpolator.empty_moments(self.boxes, columns * n_out)
        for c in range(columns):
            own = local[:, c * n_out : (c + 1) * n_out]
            moments = np.ascontiguousarray(multipoles[:, c * n_in : (c + 1) * n_in])
            sums = own if columns == 1 else np.zeros_like(own, order="C")
            for pairs in self._far_pairs:
                self.transfer.apply(pairs, moments, sums)
            if columns > 1:
                own[:] = sums
        return local

    def _downward(self, local: NDArray, values: NDArray) -> None:
        """L2L to the leaves, L2P at this rank's targets."""
        self._interpolator.evaluate(
            self.boxes,
            self._x_targets,
            local,
            values.reshape(len(values) * values.shape[1], values.shape[2]),
            self._root_edge,
            own=self.points.has_targets,
            gradient=self._gradient == "target",
        )

    def _add_points_on_grids(self, w: NDArray, local: NDArray) -> None:
        """X: sources of larger leaves to the nodes of smaller boxes."""
        boxes, size = len(self._x_boxes), self.grid.nodes**3
        if boxes == 0:
            return
        start, sources = self._x_ranges
        targets = _ranges(np.arange(boxes), size)
        out = np.zeros((len(w), self._far.n_out, boxes * size))
        self._points_on_grids.add(self._x_nodes, targets, self._x_sources, w, start, sources, out)
        local[self._x_boxes] += out.reshape(local.shape[1], boxes, size).swapaxes(0, 1)

    def _add_grids_on_points(self, multipoles: NDArray, values: NDArray) -> None:
        """W: nodes of smaller boxes to the targets of larger leaves."""
        if len(self._w_boxes) == 0:
            return
        targets, start, sources = self._w_ranges
        shape = (len(values), self._far.n_in, self._w_nodes.shape[1])
        w = multipoles[self._w_boxes].swapaxes(0, 1).reshape(shape)
        w = np.ascontiguousarray(w, dtype=np.float64)
        self._grids_on_points.add(
            self._x_targets, targets, self._w_nodes, w, start, sources, values
        )
        if self._close_nodes is not None:
            self._close_nodes.correct(w, values)


def _inside(points: NDArray, origin: NDArray, unit: float) -> NDArray[np.float64]:
    """Points (3, n) from the root cube's lowest corner, in the given unit of length."""
    return np.ascontiguousarray((points - origin[:, None]) / unit)


def _ranges(place: NDArray, size: int) -> NDArray:
    """Ranges (k, 2) of `size` rows each, at the given places."""
    return np.stack((place, place + 1), axis=1).astype(np.int64) * size


def _bytes_of(table: Any) -> int:
    """Bytes of the arrays of a dataclass."""
    return sum(column.nbytes for column in vars(table).values() if isinstance(column, np.ndarray))
