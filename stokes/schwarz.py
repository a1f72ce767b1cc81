"""A preconditioner that knows what close bodies do to one another.

A density q of all bodies solves D_i q_i + sum over j of N_ij q_j = r_i, D_i the operator of body i
alone. To the answer x = D^-1 r of every body alone, each close pair c of bodies (i, j) adds what
its exact two-body solution differs by (`stokes.pairs`): with R_ic, which restricts a density of
body i to the polar grid of pair c, and the way back L_ic,

    q = x - sum over c of L_c P_c R_c x,

an additive Schwarz method with pairs as subdomains, whose overlap, single bodies, is counted once.
A density of one body and what it makes on that body's partners is reproduced exactly but for what
it makes on third bodies. There it is a smooth flow, which the gaps between those answer as mildly
as they should. (To solve for all pairs together, leaving out other couplings, is no better but
worse: third bodies then see the flow of a body only where they touch it; the difference across
their gaps looks like approach, and lubrication multiplies it by radius over gap.)

A density is restricted as a field on the sphere of directions, sampled on rings about the pair's
line. Ranks hold the sides of their own bodies and exchange them with those of the partners.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dem_mpi.parallel import Parallel
from stokes import _kernels_polar as kernels
from stokes.formulation import OperatorCache, ShapeSolver
from stokes.modes import to_modes
from stokes.pairs import PairFactory, PairOperator, PairOptions, Partner, PolarGrid, is_sphere
from stokes.preconditioner import Preconditioner
from stokes.resolution import Resolution
from stokes.suspension_layout import Field, Layout
from stokes.suspension_table import BodyTable

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Index = NDArray[np.int64]

_ALIGNED = 1e-6  # sine of the angle between a line and an axis that are taken as one


@dataclass(frozen=True)
class NeighbourOptions:
    """Which pairs are inverted, and how finely.

    reach : gap, over the smaller body's scale, below which two bodies are a pair. In 40 spheres at
            a volume fraction of 0.2 moving together, pairs up to 0.5 take twice the iterations of
            pairs up to 0.12; moving each its own way, or under given forces, a few less
    pairs : resolution of a pair
    """

    reach: float = 0.2
    pairs: PairOptions = field(default_factory=PairOptions)


@dataclass(frozen=True)
class ClosePairs:
    """Pairs of bodies with a common axis that are nearer than a reach, one rank's bodies among.

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
        """Those nearer than reach times the smaller scale, with a body of this rank."""
        numbers = table.pairs(table.bounding_radius + 0.5 * reach * table.scale)
        numbers = np.unique(np.sort(numbers, axis=1), axis=0)
        between = table.centre[numbers[:, 1]] - table.centre[numbers[:, 0]]
        distance = np.linalg.norm(between, axis=1)
        line = between / distance[:, None]
        curve, scale = table.curve[numbers], table.scale[numbers]
        along = np.einsum("kbi,ki->kb", _rotations(table.quaternion[numbers])[..., 2], line)
        sphere = np.array([is_sphere(c) for c in table.curves], dtype=bool)[curve]
        # the pole of a sphere's polar grid is laid to its partner
        sign = np.where(sphere, (1, -1), np.where(along > 0.0, 1, -1))
        heights = np.array(
            [
                [[Partner(c, s, a).height for s in (-1, 1)] for a in (True, False)]
                for c in table.curves
            ]
        ).reshape(-1, 2, 2)
        height = heights[curve, (0, 1), (sign + 1) // 2]
        gap = distance - np.sum(height * scale, axis=1)
        kept = np.all(sphere | (1.0 - np.abs(along) < 0.5 * _ALIGNED**2), axis=1)
        kept &= (gap > 0.0) & (gap < reach * scale.min(axis=1, initial=np.inf))
        return cls(numbers[kept], line[kept], sign[kept], gap[kept])

    @property
    def count(self) -> int:
        """Number k of pairs."""
        return len(self.gap)

    @property
    def frames(self) -> Array:
        """Rotations (k, 3, 3) from the frames of the pairs, z along the line, to the world."""
        across = np.zeros_like(self.line)
        across[np.arange(self.count), np.argmin(np.abs(self.line), axis=1)] = 1.0
        x = np.cross(across, self.line)
        x /= np.linalg.norm(x, axis=1)[:, None]
        return np.stack([x, np.cross(self.line, x), self.line], axis=2)

    def operators(self, table: BodyTable, factory: PairFactory) -> list[PairOperator]:
        """The operator of each pair; equal pairs have the same one."""
        curve, scale = table.curve[self.numbers], table.scale[self.numbers]
        return [
            factory.pair(
                Partner(table.curves[curve[k, 0]], int(self.sign[k, 0]), True),
                Partner(table.curves[curve[k, 1]], int(self.sign[k, 1]), False),
                scale[k, 1] / scale[k, 0],
                self.gap[k] / scale[k, 0],
            )
            for k in range(self.count)
        ]


@dataclass(frozen=True)
class _Sides:
    """Sides of pairs that are this rank's bodies; S of them.

    row    : (S,) of the body in the layout
    pair   : (S, 2) pair, and which of its two bodies
    grid   : (S,) number of the polar grid in `grids`
    place  : (S, 2) first coefficient in the flat array of all pairs' coefficients, and past the end
    turn   : (S, 3, 3) from the frame of the pair to the body's
    """

    row: Index
    pair: Index
    grid: Index
    place: Index
    turn: Array
    grids: tuple[PolarGrid, ...]

    @cached_property
    def first(self) -> Index:
        """Where the coefficients of each begin (S,)."""
        return self.place[:, 0].copy()


class NeighbourSchwarz:
    """The one-body preconditioner and, on top of it, the close pairs of bodies.

    Pairs whose bodies share no axis (two spheroids side by side) are left to the iteration.
    """

    flexible = False

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

        one_body : the inverse of every body alone
        solvers  : of this rank's shapes, by number in the layout
        cache    : gives and keeps the operators of bodies on polar grids
        free     : whether motions are unknown (loads given) or given
        """
        self._one_body, self._layout, self._parallel = one_body, layout, parallel
        self._options = options or NeighbourOptions()
        close = ClosePairs.of(table, self._options.reach)
        self._some = parallel.any(close.count > 0)
        self.nbytes = 0
        if not self._some:
            return
        factory = PairFactory(formulation, cache, free, self._options.pairs)
        pairs = close.operators(table, factory)
        self.nbytes = factory.nbytes
        self._arrange(pairs)
        owner = table.owner(close.numbers)
        self._sides = self._own_sides(table, close, pairs, owner)
        self._plan_exchange(owner, table.rank)
        self._plan_restriction(solvers)
        self._plan_lift(solvers)

    @property
    def pairs(self) -> int:
        """Pairs with a body of this rank."""
        return len(self._place) if self._some else 0

    # ---- setup -------------------------------------------------------------------------------

    def _arrange(self, pairs: Sequence[PairOperator]) -> None:
        """Give every pair its place among the coefficients.

        Equal pairs stand next to each other, so that one product answers all of them.
        """
        distinct = {id(pair): pair for pair in pairs}
        number_of = {key: number for number, key in enumerate(distinct)}
        kind = np.array([number_of[id(pair)] for pair in pairs], dtype=np.int64)
        self._place = np.zeros((len(pairs), 3), dtype=np.int64)
        self._groups: list[tuple[PairOperator, slice, Index]] = []
        width = 3 * (self._options.pairs.modes + 1)
        end = 0
        for number, pair in enumerate(distinct.values()):
            members = np.flatnonzero(kind == number)
            bounds = width * np.cumsum([0, *(grid.size for grid in pair.grids)])
            first = end + bounds[2] * np.arange(len(members))
            self._place[members] = first[:, None] + bounds
            self._groups.append((pair, slice(end, end + bounds[2] * len(members)), members))
            end += int(bounds[2]) * len(members)
        self._length = end

    def _own_sides(
        self, table: BodyTable, close: ClosePairs, pairs: Sequence[PairOperator], owner: Index
    ) -> _Sides:
        pair = np.argwhere(owner == table.rank)
        grids: dict[PolarGrid, int] = {}
        grid = [grids.setdefault(pairs[k].grids[b], len(grids)) for k, b in pair.tolist()]
        mine = close.numbers[pair[:, 0], pair[:, 1]]
        to_world = _rotations(table.quaternion[mine])
        return _Sides(
            row=self._layout.rows[mine - table.first[table.rank]],
            pair=pair,
            grid=np.array(grid, dtype=np.int64),
            place=np.stack([self._place[pair[:, 0], pair[:, 1] + end] for end in (0, 1)], axis=1),
            turn=np.swapaxes(to_world, 1, 2) @ close.frames[pair[:, 0]],
            grids=tuple(grids),
        )

    def _plan_exchange(self, owner: Index, rank: int) -> None:
        """Which coefficients go to, and come from, the ranks of partners, in the order of pairs.

        Bodies are numbered rank after rank, so that the lower rank has the first body of a pair.
        """
        self._send: dict[int, Index] = {}
        self._receive: dict[int, Index] = {}
        for other in np.setdiff1d(owner, rank).tolist():
            shared = np.flatnonzero(np.any(owner == other, axis=1))
            mine = 0 if rank < other else 1
            for index, b in ((self._send, mine), (self._receive, 1 - mine)):
                ranges = [np.arange(*self._place[k, b : b + 2]) for k in shared.tolist()]
                index[other] = np.concatenate(ranges)

    def _plan_restriction(self, solvers: Mapping[int, ShapeSolver]) -> None:
        """Jobs of `resample` from bodies to sides, and of `analyse`."""
        sides, layout = self._sides, self._layout
        self._body_grids = _tables((s.operators.resolution, 1) for s in solvers.values())
        number = {shape: k for k, shape in enumerate(solvers)}
        grid = np.zeros(layout.bodies, dtype=np.int64)
        size = np.zeros(layout.bodies, dtype=np.int64)
        for group in layout.groups:
            grid[group.bodies] = number[group.shape]
            resolution = solvers[group.shape].operators.resolution
            size[group.bodies] = 3 * (resolution.modes + 1) * group.grid[0]
        self._body_start = _starts(size)
        rings = [grid.rings for grid in sides.grids]
        points = np.array([ring.sum() for ring in rings], dtype=np.int64)
        first_row = _starts(points[sides.grid])
        self._samples = int(first_row[-1])
        self._ring_directions = _stacked(grid.directions for grid in sides.grids)
        self._restriction = (
            (
                _starts(points)[sides.grid],
                points[sides.grid],
                first_row[:-1],
                np.arange(len(sides.row) + 1),
            ),
            (grid[sides.row], self._body_start[sides.row], sides.turn),
        )
        ring_start = _starts([len(rings[g]) for g in sides.grid])
        every_ring = np.concatenate([np.zeros(0, np.int64), *(rings[g] for g in sides.grid)])
        self._analysis = (first_row[:-1], ring_start, every_ring)

    def _plan_lift(self, solvers: Mapping[int, ShapeSolver]) -> None:
        """Jobs of `resample` from sides to bodies."""
        sides, layout = self._sides, self._layout
        self._side_grids = _tables((grid.resolution, grid.sign) for grid in sides.grids)
        clouds = [_node_directions(solver) for solver in solvers.values()]
        self._node_directions = _stacked(clouds)
        cloud_start = dict(zip(solvers, _starts([len(c) for c in clouds]).tolist(), strict=False))
        first = np.zeros(layout.bodies, dtype=np.int64)
        for group in layout.groups:
            first[group.bodies] = cloud_start[group.shape]
        order = np.argsort(sides.row, kind="stable")
        jobs = np.searchsorted(sides.row[order], np.arange(layout.bodies + 1))
        self._lift = (
            (first, np.diff(layout.offsets), layout.offsets[:-1], jobs),
            (
                sides.grid[order],
                sides.first[order],
                np.ascontiguousarray(np.swapaxes(sides.turn[order], 1, 2)),
            ),
        )

    # ---- application -------------------------------------------------------------------------

    def apply(self, residual: Field) -> Field:
        """Collective. Approximate unknowns of a residual."""
        alone = self._one_body.apply(residual)
        if not self._some:
            return alone
        t = self._restricted(alone.nodal)
        self._exchange(t)
        psi, motions = np.empty_like(t), np.zeros((self.pairs, 2, 6))
        for pair, place, members in self._groups:
            block = t[place].reshape(len(members), pair.size, -1, 3)
            psi[place] = pair.apply(block).ravel()
            if alone.rigid is not None:
                motions[members] = pair.motions(block)
        density = np.empty_like(alone.nodal)
        kernels.resample.serial(self._side_grids, *self._lift, psi, self._node_directions, density)
        np.subtract(alone.nodal, density, out=density)
        if alone.rigid is None:
            return Field(density)
        return Field(density, alone.rigid - self._motions_of_bodies(motions))

    def _restricted(self, nodal: Array) -> Complex:
        """R x: coefficients of a density on this rank's sides; the other places are zero."""
        modes = np.empty(self._body_start[-1], dtype=np.complex128)
        for group in self._layout.groups:
            rows = to_modes(group.columns(nodal))
            parts = rows.reshape(len(rows), group.count, 2, 3, -1)
            first, last = self._body_start[[group.bodies.start, group.bodies.stop]]
            # (mode, body, component, node) to (body, node, mode, component)
            modes[first:last] = np.moveaxis(
                parts[:, :, 0] + 1j * parts[:, :, 1], (1, 3, 0, 2), (0, 1, 2, 3)
            ).ravel()
        values = np.empty((self._samples, 3))
        kernels.resample.serial(
            self._body_grids, *self._restriction, modes, self._ring_directions, values
        )
        coefficients = np.zeros(self._length, dtype=np.complex128)
        kernels.analyse.serial(
            values,
            *self._analysis,
            self._options.pairs.modes,
            self._sides.first,
            coefficients,
        )
        return coefficients

    def _exchange(self, coefficients: Complex) -> None:
        """Collective. Fill in the sides of bodies of other ranks."""
        if self._parallel.size == 1:
            return
        arrived = self._parallel.exchange(
            {rank: coefficients[index].tobytes() for rank, index in self._send.items()}
        )
        for rank, message in arrived.items():
            coefficients[self._receive[rank]] = np.frombuffer(message, dtype=np.complex128)

    def _motions_of_bodies(self, motions: Array) -> Array:
        """Sums (b, 6), in the bodies' frames, of motions (k, 2, 6) in those of the pairs."""
        sides = self._sides
        mine = motions[sides.pair[:, 0], sides.pair[:, 1]].reshape(-1, 2, 3)
        total = np.zeros((self._layout.bodies, 6))
        np.add.at(total, sides.row, (mine @ np.swapaxes(sides.turn, 1, 2)).reshape(-1, 6))
        return total


def _rotations(quaternion: Array) -> Array:
    """Matrices (..., 3, 3), local to world, of unit quaternions (..., 4), scalar first."""
    flat = quaternion.reshape(-1, 4)[:, [1, 2, 3, 0]]
    if len(flat) == 0:
        return np.zeros((*quaternion.shape[:-1], 3, 3))
    return Rotation.from_quat(flat).as_matrix().reshape(*quaternion.shape[:-1], 3, 3)


def _starts(sizes: Sequence[int] | Index) -> Index:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def _stacked(clouds: Iterable[Array]) -> Array:
    return np.concatenate([np.zeros((0, 3)), *clouds])


def _tables(grids: Iterable[tuple[Resolution, int]]) -> tuple:
    """Tables of polar grids as `_kernels_polar.resample` takes them."""
    grids = list(grids)
    most_panels = max((resolution.panels for resolution, _ in grids), default=1)
    most_nodes = max((resolution.nodes for resolution, _ in grids), default=1)
    breaks = np.ones((len(grids), most_panels + 1))
    gauss, barycentric = np.zeros((2, len(grids), most_nodes))
    for g, (resolution, _) in enumerate(grids):
        q = resolution.nodes
        x, w = np.polynomial.legendre.leggauss(q)
        breaks[g, : resolution.panels + 1] = resolution.breaks
        gauss[g, :q] = x
        barycentric[g, :q] = (-1.0) ** np.arange(q) * np.sqrt((1.0 - x * x) * w)
    counts = np.array([(r.panels, r.nodes, r.modes) for r, _ in grids], dtype=np.int64)
    panels, nodes, modes = np.ascontiguousarray(counts.reshape(-1, 3).T)
    sign = np.array([sign for _, sign in grids], dtype=np.float64)
    return panels, nodes, modes, sign, breaks, gauss, barycentric


def _node_directions(solver: ShapeSolver) -> Array:
    """Directions (n, 3) that stand for a shape's nodes: polar angle pi s, azimuth theta."""
    polar, theta = np.pi * solver.operators.meridian.s[:, None], solver.grid.theta
    x, y = np.sin(polar) * np.cos(theta), np.sin(polar) * np.sin(theta)
    return np.stack([x, y, np.broadcast_to(np.cos(polar), x.shape)], axis=-1).reshape(-1, 3)
