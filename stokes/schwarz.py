"""A preconditioner that knows what close bodies do to one another.

A density q of all bodies solves D_i q_i + sum over j of N_ij q_j = r_i, D_i the operator of body i
alone. With x = D^-1 r, which the one-body preconditioner gives, the close pairs c of bodies (i, j)
are kept of the sum, each as its exact two-body solution on polar grids about its line
(`stokes.pairs`). R_ic restricts a density of body i to the grid of pair c, L_ic is the way back:

    psi_c = P_c t_c,   t_ic = R_ic x_i - sum over c' != c of R_ic L_ic' psi_ic',   q = x - L psi.

The second equation is a Schwarz method over overlapping pairs, solved for all of them at once:
(1 + P T) psi = P R x with T = R L between pairs that share a body. It has a few hundred unknowns
for a body and is solved by some iterations, which cost no sum over surface nodes; so the
preconditioner changes a little from call to call, and the outer iteration must be flexible.

A restricted density is the body's surface field on the sphere of directions, sampled on rings about
the pair's line. Ranks hold the sides of their own bodies; the partner's side is exchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel
from stokes import _kernels_polar as kernels
from stokes.formulation import OperatorCache, ShapeSolver
from stokes.geometry import Meridian, Resolution
from stokes.krylov import gmres
from stokes.modes import to_modes
from stokes.pairs import PairFactory, PairOperator, PairOptions, Partner, PolarGrid, is_sphere
from stokes.preconditioner import Preconditioner
from stokes.suspension_layout import Field, Layout
from stokes.suspension_table import BodyTable

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ALIGNED = 1e-6  # sine of the angle between a line and an axis that are taken as one


@dataclass(frozen=True)
class NeighbourOptions:
    """Which pairs are inverted, and how well.

    reach            : gap, over the smaller body's size, below which two bodies are a pair
    pairs            : resolution of a pair
    inner_tolerance  : of the system of all pairs; inner_iterations: at most so many
    """

    reach: float = 0.5
    pairs: PairOptions = field(default_factory=PairOptions)
    inner_tolerance: float = 3e-2
    inner_iterations: int = 30


@dataclass(frozen=True)
class ClosePairs:
    """Pairs of bodies with a common axis that are nearer than a reach.

    numbers : (k, 2) of the bodies in the table, a < b, in rising order
    line    : (k, 3) unit vectors from a to b
    sign    : (k, 2) of each body's curve along the line (`Partner`)
    gap     : (k,) lengths of the world
    """

    numbers: Index
    line: Array
    sign: Index
    gap: Array

    @classmethod
    def of(cls, table: BodyTable, reach: float) -> ClosePairs:
        """Those with a body of this rank."""
        pairs = table.pairs(table.bounding_radius + 0.5 * reach * table.scale)
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
        between = table.centre[pairs[:, 1]] - table.centre[pairs[:, 0]]
        distance = np.linalg.norm(between, axis=1)
        line = between / distance[:, None]
        sphere = np.array([is_sphere(c) for c in table.curves], dtype=bool)[table.curve[pairs]]
        along = np.einsum("kbi,ki->kb", _axes(table.quaternion[pairs]), line)
        across = np.sqrt(np.maximum(0.0, 1.0 - along**2))
        # the pole of a sphere's grid is laid to its partner
        sign = np.where(sphere, (1, -1), np.where(along > 0.0, 1, -1))
        height = np.empty(pairs.shape)
        size = np.array([curve_size(c) for c in table.curves])[table.curve[pairs]]
        for side, ahead in ((0, True), (1, False)):
            for number, curve in enumerate(table.curves):
                for s in (-1, 1):
                    here = (table.curve[pairs[:, side]] == number) & (sign[:, side] == s)
                    height[here, side] = Partner(curve, s, ahead).height
        scale = table.scale[pairs]
        gap = distance - np.sum(height * scale, axis=1)
        kept = np.all(sphere | (across < _ALIGNED), axis=1)
        kept &= (gap > 0.0) & (gap < reach * np.min(size * scale, axis=1))
        return cls(pairs[kept], line[kept], sign[kept], gap[kept])


def curve_size(curve) -> float:
    """Radius of the sphere with the unit shape's area."""
    breaks = tuple(np.linspace(0.0, 1.0, 9).tolist())
    return float(np.sqrt(Meridian(curve, Resolution(breaks, 16, 0)).area / (4.0 * np.pi)))


def _axes(quaternion: Array) -> Array:
    """Third columns of the rotations of unit quaternions (..., 4), scalar first."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def _rotations(quaternion: Array) -> Array:
    """Rotation matrices (k, 3, 3) of unit quaternions (k, 4)."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows).reshape(3, 3, -1), 2, 0)


def _frames(line: Array) -> Array:
    """Rotations (k, 3, 3) whose third columns are the unit vectors `line` (k, 3)."""
    k = np.arange(len(line))
    across = np.zeros_like(line)
    across[k, np.argmin(np.abs(line), axis=1)] = 1.0
    first = np.cross(across, line)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(line, first), line], axis=2)


class NeighbourSchwarz:
    """The one-body preconditioner and, on top of it, the close pairs of bodies.

    Pairs whose bodies share no axis (two spheroids side by side) are left to the iteration.
    `flexible`: whether the outer iteration must be.
    """

    def __init__(
        self,
        one_body: Preconditioner,
        layout: Layout,
        table: BodyTable,
        solvers: Mapping[int, ShapeSolver],
        formulation: str,
        cache: OperatorCache,
        parallel: Parallel,
        free: bool,
        options: NeighbourOptions | None = None,
    ) -> None:
        """Collective. Make the operators of the pairs of this rank's bodies.

        one_body : the inverse of every body alone; layout, solvers: as it has them
        cache    : gives and keeps the operators of bodies on polar grids
        free     : whether motions are unknown (loads given) or given
        """
        self._one_body, self._layout, self._parallel = one_body, layout, parallel
        self.options = options or NeighbourOptions()
        self._free = free
        close = ClosePairs.of(table, self.options.reach)
        self.pairs = len(close.gap)
        self._some = parallel.any(self.pairs > 0)
        self.flexible = False
        if not self._some:
            return
        pairs, frames = self._make_pairs(table, close, formulation, cache)
        self._modes = self.options.pairs.modes
        self._place(table, pairs, close.numbers, frames)
        self._tabulate(solvers)
        self.flexible = parallel.any(bool(self._linked))

    @property
    def nbytes(self) -> int:
        """Bytes of the pairs' operators."""
        if not self._some:
            return 0
        return self._pair_bytes

    # ---- setup -------------------------------------------------------------------------------

    def _make_pairs(
        self,
        table: BodyTable,
        close: ClosePairs,
        formulation: str,
        cache: OperatorCache,
    ) -> tuple[list[PairOperator], Array]:
        if not self.pairs:
            return [], np.empty((0, 3, 3))
        factory = PairFactory(formulation, cache, self._free, self.options.pairs)
        scale, curve = table.scale[close.numbers], table.curve[close.numbers]
        pairs = [
            factory.pair(
                Partner(table.curves[curve[k, 0]], int(close.sign[k, 0]), True),
                Partner(table.curves[curve[k, 1]], int(close.sign[k, 1]), False),
                scale[k, 1] / scale[k, 0],
                close.gap[k] / scale[k, 0],
            )
            for k in range(self.pairs)
        ]
        self._pair_bytes = factory.nbytes
        return pairs, _frames(close.line)

    def _place(
        self, table: BodyTable, pairs: list[PairOperator], numbers: Index, frames: Array
    ) -> None:
        """Give every side of every pair its place in the flat array of coefficients.

        Equal pairs stand next to each other, so that one product answers all of them.
        """
        width = 3 * (self._modes + 1)
        distinct = {id(pair): pair for pair in pairs}
        place = np.zeros(len(pairs), dtype=np.int64)
        self._groups: list[tuple[PairOperator, slice, Index]] = []
        end = 0
        for key, pair in distinct.items():
            members = np.array([k for k, p in enumerate(pairs) if id(p) == key], dtype=np.int64)
            size = pair.size * width
            place[members] = end + size * np.arange(len(members))
            self._groups.append((pair, slice(end, end + size * len(members)), members))
            end += size * len(members)
        self._length = end
        grids: dict[PolarGrid, int] = {}
        sides, ghosts = [], []
        row_of = np.empty(self._layout.bodies, dtype=np.int64)
        row_of[self._layout.order] = np.arange(self._layout.bodies)
        first = int(table.first[table.rank])
        rotation = _rotations(table.quaternion[table.own])
        owner = table.owner(numbers)
        for k, pair in enumerate(pairs):
            start = int(place[k])
            for b in (0, 1):
                grid = pair.grids[b]
                stop = start + grid.size * width
                if owner[k, b] == table.rank:
                    mine = int(numbers[k, b]) - first
                    number = grids.setdefault(grid, len(grids))
                    turn = rotation[mine].T @ frames[k]
                    partner = int(owner[k, 1 - b])
                    sides.append((int(row_of[mine]), number, start, stop, turn, k, b, partner))
                else:
                    ghosts.append((int(owner[k, b]), start, stop))
                start = stop
        self._grids = tuple(grids)
        self._row = np.array([s[0] for s in sides], dtype=np.int64)
        self._grid = np.array([s[1] for s in sides], dtype=np.int64)
        self._start = np.array([s[2] for s in sides], dtype=np.int64)
        self._turn = np.array([s[4] for s in sides]).reshape(-1, 3, 3)
        self._side = np.array([(s[5], s[6]) for s in sides], dtype=np.int64).reshape(-1, 2)
        self._own = _ranges([(s[2], s[3]) for s in sides])
        away = [r for r in range(self._parallel.size) if r != self._parallel.rank]
        self._send = {r: _ranges([(s[2], s[3]) for s in sides if s[7] == r]) for r in away}
        self._receive = {r: _ranges([(g[1], g[2]) for g in ghosts if g[0] == r]) for r in away}

    def _tabulate(self, solvers: Mapping[int, ShapeSolver]) -> None:
        """Tables of the resampling kernels: body to pair, pair to pair, pair to body."""
        layout = self._layout
        self._pair_tables = _tables([(g.resolution, g.sign) for g in self._grids])
        grid_of = {number: k for k, number in enumerate(solvers)}
        self._body_tables = _tables([(s.operators.resolution, 1) for s in solvers.values()])
        points = [len(g.directions) for g in self._grids]
        first = np.concatenate([[0], np.cumsum(points)]).astype(np.int64)
        self._ring_directions = np.concatenate(
            [np.zeros((0, 3)), *(g.directions for g in self._grids)]
        )
        counts = np.array(points, dtype=np.int64)[self._grid]
        rows = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self._samples = int(rows[-1])
        one_job = np.arange(len(self._row) + 1)
        sides = (first[self._grid], counts, rows[:-1])
        shape_of = np.zeros(layout.bodies, dtype=np.int64)
        self._body_start = np.zeros(layout.bodies + 1, dtype=np.int64)
        for group in layout.groups:
            resolution = solvers[group.shape].operators.resolution
            size = 3 * (resolution.modes + 1) * resolution.panels * resolution.nodes
            shape_of[group.bodies] = grid_of[group.shape]
            self._body_start[group.bodies.start + 1 : group.bodies.stop + 1] = size
        self._body_start = np.cumsum(self._body_start)
        self._restriction = (
            (*sides, one_job),
            (shape_of[self._row], self._body_start[self._row], self._turn),
        )
        # pair to pair: the other sides of the same body
        other = [
            [m for m in np.flatnonzero(self._row == row).tolist() if m != k]
            for k, row in enumerate(self._row.tolist())
        ]
        jobs = np.array([m for ms in other for m in ms], dtype=np.int64)
        target = np.repeat(np.arange(len(other)), [len(ms) for ms in other])
        self._linked = len(jobs)
        ends = np.concatenate([[0], np.cumsum([len(ms) for ms in other])]).astype(np.int64)
        turns = np.einsum("kji,kjl->kil", self._turn[jobs], self._turn[target])
        self._transfer = ((*sides, ends), (self._grid[jobs], self._start[jobs], turns))
        rings = [g.rings for g in self._grids]
        ring_start = np.concatenate([[0], np.cumsum([len(rings[g]) for g in self._grid])])
        self._analysis = (
            rows[:-1],
            ring_start.astype(np.int64),
            np.concatenate([np.zeros(0, np.int64), *(rings[g] for g in self._grid)]),
        )
        # pair to body: directions of a shape's nodes on the sphere (s, theta)
        clouds = [np.zeros((0, 3)), *(_node_directions(s) for s in solvers.values())]
        cloud_start = np.cumsum([len(c) for c in clouds]).astype(np.int64)
        self._node_directions = np.concatenate(clouds)
        order = np.argsort(self._row, kind="stable")
        ends = np.searchsorted(self._row[order], np.arange(layout.bodies + 1)).astype(np.int64)
        self._lift = (
            (cloud_start[shape_of], np.diff(layout.offsets), layout.offsets[:-1], ends),
            (self._grid[order], self._start[order], np.swapaxes(self._turn[order], 1, 2).copy()),
        )

    # ---- application -------------------------------------------------------------------------

    def apply(self, residual: Field) -> Field:
        """Collective. Approximate unknowns of a residual."""
        x = self._one_body.apply(residual)
        if not self._some:
            return x
        restricted = self._restrict(x.nodal)
        psi = self._reflect(self._exchanged(restricted))
        if self.flexible:
            psi = self._solve_linked(psi)
        correction = np.empty_like(x.nodal)
        kernels.resample.serial(
            self._pair_tables, *self._lift, psi, self._node_directions, correction
        )
        motion = x.rigid
        if motion is not None:
            if self.flexible:
                restricted = restricted - self._transferred(psi)
            motion = motion - self._motions(self._exchanged(restricted))
        return Field(x.nodal - correction, motion)

    def _restrict(self, nodal: Array) -> NDArray[np.complex128]:
        """R: coefficients of a density on this rank's sides, zero on others."""
        field = np.empty(self._body_start[-1], dtype=np.complex128)
        for group in self._layout.groups:
            rows = to_modes(group.columns(nodal))
            size = rows.shape[2] // 3
            parts = rows.reshape(len(rows), group.count, 2, 3, size)
            modes = np.moveaxis(parts[:, :, 0] + 1j * parts[:, :, 1], (1, 3, 0, 2), (0, 1, 2, 3))
            first, last = self._body_start[[group.bodies.start, group.bodies.stop]]
            field[first:last] = modes.ravel()
        return self._sampled(self._body_tables, self._restriction, field)

    def _transferred(self, psi: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """T psi: what the other pairs of a body leave on each of its sides."""
        return self._sampled(self._pair_tables, self._transfer, psi)

    def _sampled(self, tables, transfer, field) -> NDArray[np.complex128]:
        values = np.empty((self._samples, 3))
        kernels.resample.serial(tables, *transfer, field, self._ring_directions, values)
        coefficients = np.zeros(self._length, dtype=np.complex128)
        kernels.analyse.serial(values, *self._analysis, self._modes, self._start, coefficients)
        return coefficients

    def _exchanged(self, coefficients: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Collective. Fill in the sides of bodies of other ranks."""
        if self._parallel.size == 1:
            return coefficients
        arrived = self._parallel.exchange(
            {r: coefficients[index].tobytes() for r, index in self._send.items() if len(index)}
        )
        for source, message in arrived.items():
            coefficients[self._receive[source]] = np.frombuffer(message, dtype=np.complex128)
        return coefficients

    def _reflect(self, t: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """P t of every pair."""
        psi = np.empty_like(t)
        for pair, place, members in self._groups:
            block = t[place].reshape(len(members), pair.size, self._modes + 1, 3)
            psi[place] = pair.apply(block).ravel()
        return psi

    def _solve_linked(self, right: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Collective. psi of (1 + P T) psi = right, on this rank's sides."""

        def spread(values: Array) -> NDArray[np.complex128]:
            whole = np.zeros(self._length, dtype=np.complex128)
            whole[self._own] = np.ascontiguousarray(values).view(np.complex128)
            return whole

        def operator(values: Array) -> Array:
            psi = spread(values)
            psi += self._reflect(self._exchanged(self._transferred(psi)))
            return psi[self._own].view(np.float64)

        found = gmres(
            operator,
            lambda values: values,
            right[self._own].view(np.float64),
            self.options.inner_tolerance,
            self.options.inner_iterations,
            self.options.inner_iterations,
            False,
            self._parallel,
        )
        self.inner_iterations = found.iterations
        return spread(found.unknown)

    def _motions(self, t: NDArray[np.complex128]) -> Array:
        """Motions (b, 6) that the pairs take away from those of the bodies alone."""
        by_pair = np.zeros((self.pairs, 2, 6))
        for pair, place, members in self._groups:
            block = t[place].reshape(len(members), pair.size, self._modes + 1, 3)
            by_pair[members] = pair.motions(block)
        mine = by_pair[self._side[:, 0], self._side[:, 1]].reshape(-1, 2, 3)
        local = np.einsum("kij,kbj->kbi", self._turn, mine).reshape(-1, 6)
        total = np.zeros((self._layout.bodies, 6))
        np.add.at(total, self._row, local)
        return total


def _ranges(bounds: list[tuple[int, int]]) -> Index:
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(a, b) for a, b in bounds)])


def _tables(grids: Sequence[tuple[Resolution, int]]) -> tuple:
    """Tables of polar grids as `_kernels_polar.resample` takes them."""
    count = len(grids)
    most_panels = max((r.panels for r, _ in grids), default=1)
    most_nodes = max((r.nodes for r, _ in grids), default=1)
    breaks = np.ones((count, most_panels + 1))
    gauss, barycentric = np.zeros((2, count, most_nodes))
    for g, (resolution, _) in enumerate(grids):
        x, w = np.polynomial.legendre.leggauss(resolution.nodes)
        breaks[g, : resolution.panels + 1] = resolution.breaks
        gauss[g, : resolution.nodes] = x
        signs = (-1.0) ** np.arange(resolution.nodes)
        barycentric[g, : resolution.nodes] = signs * np.sqrt((1.0 - x * x) * w)
    integers = [
        [r.panels for r, _ in grids],
        [r.nodes for r, _ in grids],
        [r.modes for r, _ in grids],
    ]
    panels, nodes, modes = (np.array(values, dtype=np.int64) for values in integers)
    sign = np.array([s for _, s in grids], dtype=np.float64)
    return panels, nodes, modes, sign, breaks, gauss, barycentric


def _node_directions(solver: ShapeSolver) -> Array:
    """Directions (n, 3) that stand for a shape's nodes: polar angle pi s, azimuth theta."""
    polar, theta = np.pi * solver.operators.meridian.s, solver.grid.theta
    x = np.sin(polar)[:, None] * np.cos(theta)
    y = np.sin(polar)[:, None] * np.sin(theta)
    z = np.repeat(np.cos(polar)[:, None], len(theta), axis=1)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)
