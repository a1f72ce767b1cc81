"""Boundary integral equations of one rigid body, factored once and solved mode by mode.

All equations are those of the unit shape in a fluid of viscosity 1; they take velocities to
densities. A body `scale` times as large in a fluid of viscosity v has the same density q; the
world's single layer density rho [force/area] and double layer density mu [velocity] are what
`ShapeSolver.layers` makes of q. The flow is u = S rho / v + D mu, the force of the fluid on the
body - int rho, its torque - int x cross rho (the double layer exerts none).

    single      S q = u                      first kind; rho = v q / scale
    combined    (1/2 + D + eta S / L) q = u  second kind; mu = q, rho = eta v q / (L scale)
    completed   (1/2 + D + eta S P / L) q = u     the same, rho = eta v P q / (L scale)
    interior    (-1/2 + D) q = u             second kind, the flow inside; mu = q
    traction    (1/2 + T + P) q = -t         second kind, for mobility: the traction inside is -t

P projects on rigid motions, L = sqrt(area / 4 pi) of the unit shape. `combined` and `completed`
add to D, whose flows exert no force, just what the six rigid motions (1/2 + D) q = 0 need, and are
uniquely solvable. S vanishes on q = n, the normals, and n spans the left null space of -1/2 + D:
both are made regular by adding n <n, q> (times a constant). The solution is then the one with
<n, q> = 0 wherever there is one, which is where no fluid flows through the surface: <n, u> = 0.
In `traction` the body is filled with fluid in which S q leaves no stress, hence moves as the body
does (E. Corona, L. Greengard, M. Rachh, S. Veerapaneni, J. Comput. Phys. 332, 2017).

Symbols: q density (n_s, n_theta, 3[, m]) of local Cartesian components, K rigid motions, B loads.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack

from stokes.geometry import Curve, Resolution
from stokes.operators import Layer, ModalOperators

Array = NDArray[np.float64]

DEFAULT_ETA = 1.5
"""Best conditioned on spheres, and next to it on other shapes; see `ShapeSolver`."""


class Formulation(StrEnum):
    """Which integral equation; see the head of this module."""

    SINGLE = "single"
    COMBINED = "combined"
    COMPLETED = "completed"
    INTERIOR = "interior"
    TRACTION = "traction"


_KINDS = {
    Formulation.SINGLE: (Layer.SINGLE,),
    Formulation.COMBINED: (Layer.SINGLE, Layer.DOUBLE),
    Formulation.COMPLETED: (Layer.SINGLE, Layer.DOUBLE),
    Formulation.INTERIOR: (Layer.DOUBLE,),
    Formulation.TRACTION: (Layer.TRACTION,),
}
_IDENTITY = {
    Formulation.SINGLE: 0.0,
    Formulation.COMBINED: 0.5,
    Formulation.COMPLETED: 0.5,
    Formulation.INTERIOR: -0.5,
    Formulation.TRACTION: 0.5,
}


class ShapeSolver:
    """One formulation on one unit shape at one resolution.

    Factorisations and plain-rule blocks are made when first asked for and kept. Every method takes
    any number of fields at once on a trailing axis.

    eta : weight of the single layer in `combined` and `completed`. At 1.5 `combined` is best
    conditioned on the sphere and within 5 % of best elsewhere. Condition numbers in the norm of L2
    on the surface, worst over the modes, of `single` with 64 equally spaced nodes on the meridian:

                              combined  completed  traction  interior  single
        sphere                   2.0        5.0        5.0      2.5      1200
        spheroid 0.5 : 1         3.2       14         13        7.3      1600
        spheroid 1 : 0.5         2.6       10         10        5.4      1500
        spheroid 1 : 5           6.4      120        130       47        2400
        rod, aspect 5            4.5      110        130       62
        spheroid 1 : 20         18      11000      15000      810        9700
        spheroid 20 : 1         33       9100       9100     1900       13000
        rod, aspect 20           7.1     9200      14000     1200

    Those of the second kind do not depend on the resolution, that of `single` is proportional to
    the number of nodes. On slender and flat bodies not only rigid motions but bending ones, too,
    nearly solve (1/2 + D) q = 0: a single layer all over the surface makes good what the six of
    `completed` cannot.
    """

    def __init__(
        self,
        operators: ModalOperators,
        formulation: Formulation | str = Formulation.COMBINED,
        eta: float = DEFAULT_ETA,
    ) -> None:
        """Raises ValueError without modes 0 and 1, which rigid motions have."""
        if operators.resolution.modes < 1:
            raise ValueError("a body of one azimuth has no rigid motions: at least one mode wanted")
        self.operators = operators
        self.formulation = Formulation(formulation)
        self.eta = float(eta)
        self.grid = operators.grid
        self.length = math.sqrt(self.grid.area / (4.0 * math.pi))
        self._corrections: dict[tuple[int, int], Array] = {}

    # ---- the operator ------------------------------------------------------------------------

    def apply(self, density: Array) -> Array:
        """A q on the nodes; density and result (n_s, n_theta, 3[, m])."""
        return self.operators.multiply(self.matrices, density)

    def solve(self, field: Array) -> Array:
        """A^-1 u; field and result (n_s, n_theta, 3[, m])."""
        coefficients = self.operators.to_rows(field)
        for (lu, pivots), rows in zip(self._factors, _blocks(coefficients), strict=True):
            # The rows are the columns of a Fortran array, which LAPACK overwrites in place.
            solution, info = lapack.dgetrs(lu, pivots, rows.T, trans=1, overwrite_b=1)
            if info != 0:
                raise ValueError(f"dgetrs: argument {-info} is illegal")
            if not np.shares_memory(solution, rows):
                rows[:] = solution.T
        return self.operators.from_rows(coefficients, np.shape(field)[3:])

    def smooth_self(self, density: Array, refinement: tuple[int, int] = (1, 1)) -> Array:
        """What a sum over surface nodes, own node left out, gives at the nodes: the plain rule.

        Of the layers alone, without identity and rank-one terms: what a fast summation over all
        sources adds up of this body itself, (n_s, n_theta, 3[, m]). The sources may be refined:
        so many times the azimuths and the Gauss nodes of panels, the density interpolated.
        """
        return self.operators.multiply(self._plain(refinement), density)

    def self_correction(self, density: Array, refinement: tuple[int, int] = (1, 1)) -> Array:
        """`apply` minus `smooth_self`, by one product with matrices that are kept."""
        refinement = tuple(refinement)
        if refinement not in self._corrections:
            self._corrections[refinement] = self.matrices - self._plain(refinement)
            # An iteration needs this and the factorisation, no longer the matrices themselves.
            del self.matrices
        return self.operators.multiply(self._corrections[refinement], density)

    @property
    def coefficients(self) -> tuple[float, float]:
        """(a, b) of the unit shape's flow a S f + b D q; f = q, but P q if `completed`."""
        if self.formulation is Formulation.INTERIOR:
            return 0.0, 1.0
        if self.formulation in (Formulation.SINGLE, Formulation.TRACTION):
            return 1.0, 0.0
        return self.eta / self.length, 1.0

    def layers(
        self, density: Array, scale: float = 1.0, viscosity: float = 1.0
    ) -> tuple[Array | None, Array | None]:
        """The world's densities (rho [force/area], mu [velocity]) of q, None for one that is zero.

        Local Cartesian components; u = S rho / viscosity + D mu.
        """
        a, b = self.coefficients
        rho = self.rigid_part(density) if self.formulation is Formulation.COMPLETED else density
        return a * viscosity / scale * rho if a else None, density if b else None

    # ---- rigid motions and loads -------------------------------------------------------------

    @cached_property
    def rigid_motions(self) -> Array:
        """K (n_s, n_theta, 3, 6): unit velocities along x, y, z and unit rotations about them."""
        return rigid_motions(self.grid.points)

    def loads(self, single_layer: Array) -> Array:
        """B rho = (int rho, int x cross rho), (6[, m]): what the body exerts on the fluid."""
        return np.tensordot(self._weighted_motions, single_layer, axes=((0, 1, 2), (0, 1, 2)))

    def mean_motion(self, field: Array) -> Array:
        """Velocity and rotation (6[, m]) next to a field in the mean square over the surface."""
        return np.linalg.solve(self._motion_gram, self.loads(field))

    def rigid_part(self, density: Array) -> Array:
        """P q, the field of q's mean motion."""
        return np.tensordot(self.rigid_motions, self.mean_motion(density), axes=1)

    @cached_property
    def resistance(self) -> Array:
        """(6, 6): force and torque to apply for unit velocities and rotations, viscosity 1.

        Raises ValueError in the formulations `interior` and `traction`.
        """
        return self._unit_motions[1]

    def solve_mobility(
        self, field: Array, force: ArrayLike = (0.0,) * 3, torque: ArrayLike = (0.0,) * 3
    ) -> tuple[Array, Array, Array]:
        """Density, velocity (3[, m]) and rotation (3[, m]) of a body under given loads.

        Solves A q - K V = field, B rho(q) = (force, torque), the loads applied to the body;
        `field` (n_s, n_theta, 3[, m]) is the slip minus the flow without the body. In the
        formulation `traction` it is minus the traction of the flow without the body, and V does
        not hold the mean of that flow. Loads (3[, m]) of the unit shape at viscosity 1. Raises
        ValueError in the formulation `interior`.
        """
        fields = np.shape(field)[3:]
        load = np.concatenate(
            [np.broadcast_to(_columns(a, fields), (3, *fields)) for a in (force, torque)]
        )
        if self.formulation is Formulation.TRACTION:
            return self._solve_traction(field, load)
        unit_densities, resistance = self._unit_motions
        density = self.solve(field)
        missing = load - self.loads(self.layers(density)[0])
        motion = np.linalg.solve(resistance, missing)
        density += np.tensordot(unit_densities, motion, axes=1)
        return density, motion[:3], motion[3:]

    def _solve_traction(self, field: Array, load: Array) -> tuple[Array, Array, Array]:
        carrier = np.tensordot(self.rigid_motions, np.linalg.solve(self._motion_gram, load), axes=1)
        inside = self.apply(carrier) - carrier  # P of a rigid motion is itself
        density = carrier + self.solve(field - inside)
        velocity = self.operators.apply(Layer.SINGLE, density)
        motion = self.mean_motion(velocity)
        return density, motion[:3], motion[3:]

    @cached_property
    def _unit_motions(self) -> tuple[Array, Array]:
        """Densities (n_s, n_theta, 3, 6) of the rigid motions K and the loads B of each, (6, 6)."""
        if self.formulation in (Formulation.INTERIOR, Formulation.TRACTION):
            raise ValueError(f"formulation {self.formulation}: no motion is given to the body")
        densities = self.solve(self.rigid_motions)
        return densities, self.loads(self.layers(densities)[0])

    @cached_property
    def _weighted_motions(self) -> Array:
        return self.grid.weights[:, :, None, None] * self.rigid_motions

    @cached_property
    def _motion_gram(self) -> Array:
        """<K, K>, (6, 6)."""
        return self.loads(self.rigid_motions)

    # ---- matrices ----------------------------------------------------------------------------

    @cached_property
    def matrices(self) -> Array:
        """The operator (modes + 1, parts, k, k), as `ModalOperators.matrices`."""
        kinds = _KINDS[self.formulation]
        matrices = self._compose({kind: self.operators.matrices(kind) for kind in kinds})
        self._add_identity_and_lift(matrices)
        return matrices

    @property
    def nbytes(self) -> int:
        """Bytes of matrices and factorisations held by this object."""
        held = list(self._corrections.values())
        held += [lu for lu, _ in self.__dict__.get("_factors", ())]
        if "matrices" in self.__dict__:
            held.append(self.matrices)
        return sum(array.nbytes for array in held)

    def condition_numbers(self) -> Array:
        """Condition of each mode in the norm of L2 on the surface, (modes + 1,)."""
        rows = self.matrices.shape[-1] // 3
        root = np.tile(np.sqrt(self._line_weights[:rows]), 3)
        values = np.linalg.svd(root[:, None] * self.matrices / root, compute_uv=False)
        return values.max(axis=(1, 2)) / values.min(axis=(1, 2))

    @cached_property
    def _factors(self) -> list[tuple[Array, NDArray]]:
        """LU of the transposes: to LAPACK, a matrix in C order is its transpose."""
        factors = []
        for k, matrix in enumerate(_blocks(self.matrices)):
            lu, pivots, info = lapack.dgetrf(matrix.T)
            if info != 0:
                n = k // self.operators.parts
                raise ValueError(f"formulation {self.formulation}: mode {n} is singular")
            factors.append((lu, pivots))
        return factors

    @cached_property
    def _line_weights(self) -> Array:
        """Weights of int . r dl, (n_s,)."""
        return self.operators.meridian.weights * self.operators.meridian.r

    def _plain(self, refinement: tuple[int, int]) -> Array:
        kinds = _KINDS[self.formulation]
        return self._compose({kind: self.operators.plain(kind, refinement) for kind in kinds})

    def _compose(self, layers: dict[Layer, Array]) -> Array:
        """The layers of this formulation, without identity and lift."""
        if self.formulation in (Formulation.SINGLE, Formulation.INTERIOR, Formulation.TRACTION):
            return layers[_KINDS[self.formulation][0]].copy()
        single = self.coefficients[0] * layers[Layer.SINGLE]
        if self.formulation is Formulation.COMBINED:
            return single + layers[Layer.DOUBLE]
        total = layers[Layer.DOUBLE].copy()
        for n, projection in enumerate(self._projections()):
            total[n] += single[n] @ projection
        return total

    def _add_identity_and_lift(self, matrices: Array) -> None:
        diagonal = np.arange(matrices.shape[-1])
        matrices[:, :, diagonal, diagonal] += _IDENTITY[self.formulation]
        if self.formulation in (Formulation.SINGLE, Formulation.INTERIOR):
            meridian = self.operators.meridian
            n = np.concatenate([meridian.normal_r, np.zeros(meridian.size), meridian.normal_z])
            weight = self.length if self.formulation is Formulation.SINGLE else 1.0
            weighted = n * np.tile(self._line_weights / self._line_weights.sum(), 3)
            matrices[0] += self.operators.fold(np.outer(weight * n, weighted))
        elif self.formulation is Formulation.TRACTION:
            for n, projection in enumerate(self._projections()):
                matrices[n] += projection

    def _projections(self) -> list[Array]:
        """P in modes 0 and 1, the only ones of rigid motions; shaped as a mode of `matrices`."""
        r, z = self.operators.meridian.r, self.operators.meridian.z
        zero, one = np.zeros_like(r), np.ones_like(r)
        # Real form: e_z and e_z cross x in mode 0; e_x and e_x cross x, to a factor, in mode 1.
        motions = [
            [(zero, zero, one), (zero, r, zero)],
            [(one, one, zero), (z, z, -r)],
        ]
        projections = []
        for pair in motions[: self.operators.resolution.modes + 1]:
            basis = np.stack([np.concatenate(motion) for motion in pair], axis=1)
            weighted = np.tile(self._line_weights, 3)[:, None] * basis
            full = basis @ np.linalg.solve(basis.T @ weighted, weighted.T)
            projections.append(self.operators.fold(full))
        return projections


class OperatorCache:
    """Operators and factorisations, one of each for a shape and a resolution, shared by its bodies.

    An object of the caller: dropping it frees everything. `nbytes` tells what it holds.
    """

    def __init__(self, threads: int = 1) -> None:
        """`threads` that assembly may use; any number gives the same bits."""
        self.threads = threads
        self._operators: dict[Hashable, ModalOperators] = {}
        self._solvers: dict[Hashable, ShapeSolver] = {}

    def operators(self, curve: Curve, resolution: Resolution) -> ModalOperators:
        """The layer potentials of this shape at this resolution."""
        key = (curve, resolution)
        if key not in self._operators:
            self._operators[key] = ModalOperators(curve, resolution, self.threads)
        return self._operators[key]

    def solver(
        self,
        curve: Curve,
        resolution: Resolution,
        formulation: Formulation | str = Formulation.COMBINED,
        eta: float = DEFAULT_ETA,
    ) -> ShapeSolver:
        """The solver of this shape at this resolution; `eta` as for `ShapeSolver`."""
        key = (curve, resolution, Formulation(formulation), float(eta))
        if key not in self._solvers:
            operators = self.operators(curve, resolution)
            self._solvers[key] = ShapeSolver(operators, formulation, eta)
        return self._solvers[key]

    @property
    def nbytes(self) -> int:
        """Bytes of all matrices and factorisations."""
        held = (*self._operators.values(), *self._solvers.values())
        return sum(part.nbytes for part in held)

    def release_operators(self) -> None:
        """Forget the layers' own matrices, which solvers already made no longer need."""
        for operators in self._operators.values():
            operators.release()


def _blocks(values: Array) -> Array:
    """Modes and parts on one axis."""
    return values.reshape(-1, *values.shape[2:])


def rigid_motions(points: Array) -> Array:
    """Velocities (..., 3, 6) at points (..., 3) of unit velocities and of unit rotations."""
    identity = np.broadcast_to(np.eye(3), (*points.shape, 3))
    rotations = np.cross(np.eye(3), points[..., None, :])  # (..., axis, 3)
    return np.concatenate([identity, np.swapaxes(rotations, -1, -2)], axis=-1)


def _columns(vector: ArrayLike, fields: tuple[int, ...]) -> Array:
    """A vector (3,) or (3, m) such that it broadcasts to (3, *fields)."""
    vector = np.asarray(vector, dtype=np.float64)
    return vector.reshape(*vector.shape, *[1] * (1 + len(fields) - vector.ndim))
