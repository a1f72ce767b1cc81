"""Two bodies of revolution about one line, solved exactly, mode by mode about that line.

What two bodies nearly in touch do to each other is smooth but for the region of contact, where it
varies over lengths of about the square root of gap times radius, and its modes about the line
through both centres fall off quickly. A *polar grid* holds such fields: rings about that line,
graded towards the contact, with the same few modes on every ring. Spheres have the line through
their centres as an axis; other bodies of revolution share a line if it is the axis of both.

With D the operator of one body, N_ab q_b the velocity that the density q_b makes on body a, the
densities with which a pair answers densities t = (t_a, t_b) of each body alone are

    psi = P t,   P = (1 + G)^-1 G,   G = [0 G_ab; G_ba 0],   G_ab = D_a^-1 N_ab,

so that t - psi solves the pair. All is in the *frame of the pair*: z along the line, from body a
to body b; lengths are those of the unit shapes.

Symbols: N nodes of a polar grid's meridian, M modes; matrices (M + 1, 3 N, 3 N), the real form of
`stokes.modes`, here with rows ordered (node, component).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stokes.curves import Curve, Spheroid
from stokes.formulation import OperatorCache, ShapeSolver
from stokes.geometry import Meridian, Resolution
from stokes.modal import modal_kernel
from stokes.modes import from_modes, to_modes

Array = NDArray[np.float64]

# Panels as wide as so many local gaps: 6 Gauss nodes integrate kernels over the gap to 1 %. Wider
# ones cost iterations, narrower ones save none (chains of four spheres at a gap of 0.003).
_WIDEST_IN_GAPS = 4.0
# Lubrication multiplies errors by radius over gap: chains of eight at 0.001 take 17 iterations with
# 6 nodes, 11 with 8.
_SMALL_GAP, _MORE_NODES = 0.004, 2
_WIDEST_PANEL = 0.25  # of the parameter of the whole meridian
_LEAST_CURVATURE = 0.25  # flatter contacts would be resolved by hundreds of rings
# Angle between neighbouring points of a ring: peaks at other contacts of the body must be seen.
_SPACING = 0.2


@dataclass(frozen=True)
class PairOptions:
    """How finely pairs are resolved.

    modes  : azimuthal modes about the line of the pair, at least 1
    nodes  : Gauss-Legendre nodes of a panel; two more at gaps below 0.004
    """

    modes: int = 3
    nodes: int = 6


@dataclass(frozen=True)
class PolarGrid:
    """Rings of points on the sphere of directions; a body's surface is mapped to it by (s, theta).

    resolution : of the meridian; sign: +1 if s = 0 lies towards +z of the pair's frame, else -1
    """

    resolution: Resolution
    sign: int

    @property
    def modes(self) -> int:
        """Azimuthal modes M."""
        return self.resolution.modes

    @property
    def size(self) -> int:
        """Number of rings N."""
        return self.resolution.meridian_nodes

    @cached_property
    def s(self) -> Array:
        """Parameters of the rings."""
        return self.resolution.parameters

    @cached_property
    def rings(self) -> NDArray[np.int64]:
        """Equal angles on each ring (N,), odd: enough for the modes and for `_SPACING`."""
        wanted = 2.0 * math.pi / _SPACING * np.sin(math.pi * self.s)
        return np.maximum(2 * (wanted / 2.0).astype(np.int64) + 1, 2 * self.modes + 1)

    @cached_property
    def directions(self) -> Array:
        """Points of all rings, ring after ring, as unit vectors of the pair's frame."""
        polar = math.pi * np.repeat(self.s, self.rings)
        first = np.repeat(np.cumsum(self.rings) - self.rings, self.rings)
        k = np.arange(len(first)) - first
        phi = 2.0 * math.pi * k / np.repeat(self.rings, self.rings)
        radius = np.sin(polar)
        return np.stack(
            [radius * np.cos(phi), radius * np.sin(phi), self.sign * np.cos(polar)], axis=1
        )


@dataclass(frozen=True)
class Partner:
    """One body of a pair.

    sign  : +1 if its curve's north pole points along the pair's line, else -1
    ahead : whether the other body lies that way
    """

    curve: Curve
    sign: int
    ahead: bool

    @property
    def at_north(self) -> bool:
        """Whether the contact is at the north pole of the curve."""
        return (self.sign > 0) == self.ahead

    @property
    def height(self) -> float:
        """Distance of the pole at the contact from the centre."""
        ends = self.curve.evaluate(np.array([0.0, 1.0]))
        return float(ends.z[0] if self.at_north else -ends.z[1])

    @property
    def curvature(self) -> float:
        """Of the meridian at the contact."""
        ends = self.curve.evaluate(np.array([0.0, 1.0]))
        return float(ends.meridional_curvature[0 if self.at_north else 1])

    def grid(self, gap: float, curvature: float, options: PairOptions) -> PolarGrid:
        """Rings for a gap gap + curvature rho^2/2 at the distance rho from the line.

        Gap and curvature are rounded to powers of two, so that few grids serve all pairs.
        """
        curvature = max(curvature, _LEAST_CURVATURE)
        edges = self._graded(*(2.0 ** math.floor(math.log2(x)) for x in (gap, curvature)))
        if not self.at_north:
            edges = [1.0 - s for s in reversed(edges)]
        nodes = options.nodes + (_MORE_NODES if gap < _SMALL_GAP else 0)
        return PolarGrid(Resolution(tuple(edges), nodes, options.modes), self.sign)

    def _graded(self, gap: float, curvature: float) -> list[float]:
        """Edges from the contact to the far pole, each panel a few local gaps wide."""
        edges, rho = [0.0], 0.0
        while True:
            s = edges[-1]
            speed = float(self.curve.evaluate(s if self.at_north else 1.0 - s).speed)
            local = gap + 0.5 * curvature * rho * rho
            step = min(_WIDEST_IN_GAPS * local / speed, _WIDEST_PANEL)
            if s + 1.5 * step >= 1.0:
                return [*edges, 1.0]
            edges.append(s + step)
            rho += step * speed


def is_sphere(curve: Curve) -> bool:
    """Whether every line through the body's centre is an axis of it."""
    return isinstance(curve, Spheroid) and curve.equatorial == curve.polar and not curve.cosine[0]


@dataclass(frozen=True)
class Response:
    """D^-1 of one body on a polar grid, and the motion of a body that is free.

    density : (M + 1, 3 N, 3 N), from velocities
    motion  : (4, 3 N) or None: velocity along z and rotation about it, of mode 0, velocity along x
              and rotation about y, of the real part of mode 1
    """

    density: Array
    motion: Array | None


def respond(solver: ShapeSolver, sign: int, free: bool) -> Response:
    """The response of a body to velocities on its polar grid, in the frame of the pair.

    free : its motion is such that no force and no torque act on it; else it is held
    """
    n_modes, size = solver.operators.resolution.modes + 1, solver.grid.shape[0]
    flips = np.array([1.0, 1.0, sign])
    # One field for each (component, node), the same in all modes at once. In mode 0 the
    # azimuthal component is real where its real form is imaginary.
    columns = np.zeros((n_modes, 3 * size, 2, 3, size))
    k = np.arange(3 * size)
    component, node = k // size, k % size
    columns[1:, k, 0, component, node] = flips[component]
    columns[0, k, (component == 1).astype(int), component, node] = flips[component]
    field = from_modes(
        columns.reshape(n_modes, 6 * size, 3 * size), solver.grid.shape[1], (3 * size,)
    )
    motion = None
    if free:
        field, velocity, rotation = solver.solve_mobility(field)
        motion = np.stack([sign * velocity[2], rotation[2], velocity[0], sign * rotation[1]])
        motion = _by_node(motion.reshape(4, 3, size))
    else:
        field = solver.solve(field)
    modes = to_modes(field).reshape(n_modes, 3, size, 2, 3, size)
    density = modes[:, :, :, 0].copy()
    density[0, 1] = modes[0, 1, :, 1]
    density[0, :, :, 1] = modes[0, :, :, 1, 1]
    # (mode, component in, node in, component out, node out) to (mode, node, component; same in)
    matrices = np.einsum("mdjci->micjd", density * flips[:, None])
    return Response(np.ascontiguousarray(matrices).reshape(n_modes, 3 * size, 3 * size), motion)


def _by_node(rows: Array) -> Array:
    """Rows (k, component, node) with columns ordered (node, component)."""
    return np.ascontiguousarray(np.swapaxes(rows, 1, 2)).reshape(len(rows), -1)


@dataclass(frozen=True)
class PairOperator:
    """P of a pair, and the motions that go with it.

    grids      : polar grids of bodies a and b, N_a and N_b rings
    reflection : P (M + 1, 3 (N_a + N_b), 3 (N_a + N_b))
    motion     : (2, 4, 3 (N_a + N_b)) or None: of both bodies, rows as in `Response`, to be taken
                 away from those of the bodies alone; they act on t
    """

    grids: tuple[PolarGrid, PolarGrid]
    reflection: Array
    motion: Array | None

    @property
    def size(self) -> int:
        """Rings of both grids."""
        return self.grids[0].size + self.grids[1].size

    def apply(self, coefficients: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """P t of k pairs: (k, N_a + N_b, M + 1, 3)."""
        shape = coefficients.shape
        columns = np.ascontiguousarray(np.moveaxis(coefficients, (2, 1, 3), (0, 1, 2)))
        columns = columns.reshape(shape[2], -1, shape[0]).view(np.float64)
        answer = (self.reflection @ columns).view(np.complex128)
        answer = answer.reshape(shape[2], shape[1], 3, shape[0])
        return np.ascontiguousarray(np.moveaxis(answer, (0, 1, 2), (2, 1, 3)))

    def motions(self, coefficients: NDArray[np.complex128]) -> Array:
        """Velocities and rotations of k pairs in the frame of the pair, (k, 2, 6)."""
        k = len(coefficients)
        mode_0 = coefficients[:, :, 0].reshape(k, -1)
        mode_1 = coefficients[:, :, 1].reshape(k, -1)
        along, about = (mode_0 @ self.motion[:, row].T for row in (0, 1))
        across, tilt = (mode_1 @ self.motion[:, row].T for row in (2, 3))
        # a field of mode 1 with imaginary coefficients is one with real ones turned by -90 degrees
        return np.stack(
            [across.real, -across.imag, along.real, tilt.imag, tilt.real, about.imag], axis=-1
        )


class PairFactory:
    """Makes the operators of pairs; equal pairs share one, pairs of similar gaps one-body parts."""

    def __init__(
        self,
        formulation: str,
        cache: OperatorCache,
        free: bool,
        options: PairOptions | None = None,
    ) -> None:
        """formulation: the suspension's; free: see `respond`."""
        self._formulation, self._cache, self._free = formulation, cache, free
        self.options = options or PairOptions()
        self._responses: dict[tuple[Curve, PolarGrid], Response] = {}
        self._pairs: dict[tuple, PairOperator] = {}

    def pair(self, a: Partner, b: Partner, ratio: float, gap: float) -> PairOperator:
        """The operator of a pair; ratio of b's scale to a's, gap over a's scale.

        Both are rounded to seven digits, so that pairs that differ by rounding share an operator.
        """
        ratio, gap = float(f"{ratio:.6e}"), float(f"{gap:.6e}")
        key = (a, b, ratio, gap)
        if key not in self._pairs:
            self._pairs[key] = self._make(a, b, ratio, gap)
        return self._pairs[key]

    @property
    def nbytes(self) -> int:
        """Bytes of the operators of all pairs made."""
        return sum(pair.reflection.nbytes for pair in self._pairs.values())

    def _make(self, a: Partner, b: Partner, ratio: float, gap: float) -> PairOperator:
        grid_a = a.grid(gap, a.curvature + b.curvature / ratio, self.options)
        grid_b = b.grid(gap / ratio, b.curvature + a.curvature * ratio, self.options)
        distance = a.height + gap + ratio * b.height  # in a's unit of length
        side_a = _Side(a.curve, grid_a, 1.0, 0.0)
        side_b = _Side(b.curve, grid_b, ratio, distance)
        n_a, n_b = 3 * grid_a.size, 3 * grid_b.size
        response_a, response_b = self._response(a.curve, grid_a), self._response(b.curve, grid_b)
        to_a, to_b = self._coupling(side_a, side_b), self._coupling(side_b, side_a)
        G = np.zeros((self.options.modes + 1, n_a + n_b, n_a + n_b))
        G[:, :n_a, n_a:] = response_a.density @ to_a
        G[:, n_a:, :n_a] = response_b.density @ to_b
        reflection = np.linalg.solve(np.eye(n_a + n_b) + G, G)
        motion = None
        if self._free:
            rest = np.eye(n_a + n_b) - reflection[:2]  # t - psi, modes 0 and 1
            seen = (to_a[:2] @ rest[:, n_a:], to_b[:2] @ rest[:, :n_a])
            rows = zip((response_a.motion, response_b.motion), seen, strict=True)
            motion = np.stack([np.concatenate([r[:2] @ v[0], r[2:] @ v[1]]) for r, v in rows])
        return PairOperator((grid_a, grid_b), reflection, motion)

    def _response(self, curve: Curve, grid: PolarGrid) -> Response:
        key = (curve, grid)
        if key not in self._responses:
            solver = self._solver(curve, grid)
            self._responses[key] = respond(solver, grid.sign, self._free)
        return self._responses[key]

    def _solver(self, curve: Curve, grid: PolarGrid) -> ShapeSolver:
        return self._cache.solver(curve, grid.resolution, self._formulation)

    def _coupling(self, target: _Side, source: _Side) -> Array:
        """N: from densities of `source` to velocities on `target`, (M + 1, 3 N_t, 3 N_s)."""
        solver = self._solver(source.curve, source.grid)
        single, double = solver.coefficients
        x, y = target.points(source), source.points(source)
        n_t, n_s = len(x), len(y)
        pairs = np.repeat(x, n_s, axis=0), np.tile(y, (n_t, 1))
        total = np.zeros((n_t * n_s, self.options.modes + 1, 3, 3))
        for kind, factor in (("velocity_single", single), ("velocity_double", double)):
            if factor:
                total += factor * modal_kernel(kind, *pairs, n_max=self.options.modes)
        total = total.reshape(n_t, n_s, -1, 3, 3) * source.weights[:, None, None, None]
        matrices = np.ascontiguousarray(np.moveaxis(total, (2, 0, 3, 1, 4), (0, 1, 2, 3, 4)))
        return matrices.reshape(-1, 3 * n_t, 3 * n_s)


@dataclass(frozen=True)
class _Side:
    """One body of a pair on its polar grid, at `height` along the line, `scale` times its shape."""

    curve: Curve
    grid: PolarGrid
    scale: float
    height: float

    @cached_property
    def meridian(self) -> Meridian:
        return Meridian(self.curve, self.grid.resolution)

    @property
    def weights(self) -> Array:
        """Of integrals r dl over the unit shape."""
        return self.meridian.weights * self.meridian.r

    def points(self, origin: _Side) -> Array:
        """Nodes (N, 4) as `modal_kernel` takes them, in the unit shape's lengths of `origin`."""
        m, sign = self.meridian, self.grid.sign
        z = (self.scale * sign * m.z + self.height - origin.height) / origin.scale
        return np.stack([self.scale / origin.scale * m.r, z, m.normal_r, sign * m.normal_z], axis=1)
