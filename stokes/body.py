"""One rigid body in Stokes flow: given its motion or the loads on it, all that follows.

    body = Body(spheroid(0.5, 1.0), quaternion=(0.9, 0.3, 0.1, 0.2))
    drag = solve_resistance(body, velocity=(1.0, 0.0, 0.0)).force
    drift = solve_mobility(body, force=(0.0, 0.0, -1.0), background=shear_flow(1.0)).velocity

On the surface the fluid moves with V + Omega cross (x - centre) + slip. The solution is the flow
`background` plus a disturbance that decays at infinity. Vectors are in the world's frame, moments
about the body's centre; loads of a solution are those that the fluid exerts on the body, while
`solve_mobility` takes the loads applied to it, which the fluid's balance: fluid + applied = 0.
The slip belongs to the body and is given in the body's frame.

Units are the caller's: velocity U, length L and viscosity v make forces v U L.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes.background import BackgroundFlow
from stokes.evaluate import evaluate
from stokes.formulation import Formulation, OperatorCache, ShapeSolver
from stokes.geometry import Body, Meridian, Resolution, SurfaceGrid
from stokes.layers import Quantity
from stokes.modes import azimuths
from stokes.quadrature import gauss_legendre
from stokes.resolution import resolution_for

Array = NDArray[np.float64]
Slip = ArrayLike | Callable[[Array], Array]

_REST = (0.0, 0.0, 0.0)
# Flux of the surface velocity, relative to its mean size, that still passes for round-off and
# for what a coarse grid makes of a flux of zero.
_FLUX = 1e-3


@dataclass(frozen=True)
class BodySolution:
    """Motion of a body, loads of the fluid on it and the densities that make the flow.

    velocity, angular_velocity, force, torque : (3,)
    stresslet : (3, 3) symmetric, trace zero: int of the symmetric, traceless part of
                x t - viscosity (u n + n u) over the surface, u and t of the disturbance
    density   : (n_s, n_theta, 3) of `solver`, local components
    """

    body: Body
    viscosity: float
    solver: ShapeSolver
    background: BackgroundFlow | None
    density: Array
    surface_velocity: Array  # of the disturbance, (n_s, n_theta, 3), local components
    velocity: Array
    angular_velocity: Array
    force: Array
    torque: Array
    stresslet: Array

    @property
    def points(self) -> Array:
        """Nodes (n_s, n_theta, 3) in the world."""
        return self.body.to_world(self.solver.grid.points)

    @property
    def normals(self) -> Array:
        """Outward unit normals (n_s, n_theta, 3)."""
        return self.body.vectors_to_world(self.solver.grid.normals)

    @property
    def weights(self) -> Array:
        """Weights of surface integrals over the nodes, (n_s, n_theta)."""
        return self.body.scale**2 * self.solver.grid.weights

    def layers(self) -> tuple[Array | None, Array | None]:
        """Densities rho and mu of u = S rho / viscosity + D mu, None for one that is zero.

        (n_s, n_theta, 3) in the world's frame; u is the disturbance.
        """
        local = self.solver.layers(self.density, self.body.scale, self.viscosity)
        rho, mu = (None if part is None else self.body.vectors_to_world(part) for part in local)
        return rho, mu

    def traction(self) -> Array:
        """sigma.n (n_s, n_theta, 3) of the whole flow on the body, force by area.

        Raises ValueError if fluid flows through the surface.
        """
        traction = self.body.vectors_to_world(self._disturbance_traction)
        if self.background is not None:
            stress = self.background.stress(self.points.reshape(-1, 3), self.viscosity)
            stress = stress.reshape(*traction.shape, 3)
            traction = traction + np.einsum("...ij,...j->...i", stress, self.normals)
        return traction

    def pressure(self) -> Array:
        """Pressure (n_s, n_theta) of the whole flow on the body, zero at infinity.

        As div u = 0 makes n.e.n = -div_s u: p = -n.t - 2 viscosity div_s u, the last term by
        differences of the surface velocity along the surface.
        """
        grid = self.solver.grid
        normal_stress = np.sum(self._disturbance_traction * grid.normals, axis=-1)
        expansion = _surface_divergence(grid, self.surface_velocity) / self.body.scale
        pressure = -normal_stress - 2.0 * self.viscosity * expansion
        if self.background is not None:
            far = self.background.pressure(self.points.reshape(-1, 3), self.viscosity)
            pressure = pressure + far.reshape(pressure.shape)
        return pressure

    def velocity_at(self, points: ArrayLike, tolerance: float = 1e-9) -> Array:
        """Velocity (m, 3) of the whole flow at points (m, 3) outside, NaN inside.

        tolerance : of the disturbance, see `stokes.evaluate`; on and near the surface the same
        """
        velocity = self._evaluated("velocity", points, tolerance)
        if self.background is not None:
            velocity += self.background.velocity(np.asarray(points, dtype=np.float64))
        return velocity

    def pressure_at(self, points: ArrayLike, tolerance: float = 1e-9) -> Array:
        """Pressure (m,) of the whole flow at points (m, 3), like `velocity_at`."""
        pressure = self._evaluated("pressure", points, tolerance)
        if self.background is not None:
            points = np.asarray(points, dtype=np.float64)
            pressure += self.background.pressure(points, self.viscosity)
        return pressure

    def _evaluated(self, quantity: Quantity, points: ArrayLike, tolerance: float) -> Array:
        layers = self.solver.layers(self.density, self.body.scale, self.viscosity)
        rho, mu = (None if part is None else part.reshape(-1, 3) for part in layers)
        return evaluate(
            [self.body],
            [self.solver.operators.resolution],
            points,
            rho,
            mu,
            quantity,
            self.viscosity,
            tolerance,
        )

    @cached_property
    def _disturbance_traction(self) -> Array:
        """(T - 1/2) rho of the single layer with this velocity on the surface, local components."""
        _refuse_flux(self.solver.grid, self.surface_velocity)
        operators = self.solver.operators
        rho = ShapeSolver(operators, Formulation.SINGLE).solve(self.surface_velocity)
        # With its identity and rank-one term taken off, the operator `traction` is T.
        inside = ShapeSolver(operators, Formulation.TRACTION)
        traction = inside.apply(rho) - inside.rigid_part(rho) - rho
        return self.viscosity / self.body.scale * traction


def solve_resistance(
    body: Body,
    velocity: ArrayLike = _REST,
    angular_velocity: ArrayLike = _REST,
    *,
    background: BackgroundFlow | None = None,
    slip: Slip | None = None,
    viscosity: float = 1.0,
    formulation: Formulation | str = Formulation.COMBINED,
    resolution: Resolution | None = None,
    tolerance: float = 1e-12,
    cache: OperatorCache | None = None,
) -> BodySolution:
    """The flow around a body that moves with `velocity` and `angular_velocity` (3,).

    slip       : (n_s, n_theta, 3) at the nodes of `resolution`, or a function of points (n, 3) of
                 the unit shape; components in the body's frame
    resolution : nodes on the surface; by default for a relative error `tolerance` of the loads
                 in flows that vary little over the body
    cache      : operators and factorisations to use and add to
    Raises ValueError for formulations that do not answer this, or a slip with a net flux.
    """
    formulation = Formulation(formulation)
    if formulation in (Formulation.INTERIOR, Formulation.TRACTION):
        raise ValueError(f"formulation {formulation}: no motion is given to the body")
    solver = _solver(body, formulation, resolution, tolerance, cache)
    field = _prescribed(body, solver.grid, background, slip)
    motion = np.concatenate(
        [
            body.vectors_to_local(velocity),
            body.scale * body.vectors_to_local(angular_velocity),
        ]
    )
    field = field + solver.rigid_motions @ motion
    if formulation is Formulation.SINGLE:
        _refuse_flux(solver.grid, field)
    density = solver.solve(field)
    return _solution(body, viscosity, solver, background, density, field, motion)


def solve_mobility(
    body: Body,
    force: ArrayLike = _REST,
    torque: ArrayLike = _REST,
    *,
    background: BackgroundFlow | None = None,
    slip: Slip | None = None,
    viscosity: float = 1.0,
    formulation: Formulation | str = Formulation.COMBINED,
    resolution: Resolution | None = None,
    tolerance: float = 1e-12,
    cache: OperatorCache | None = None,
) -> BodySolution:
    """The motion of a body under an applied force and torque (3,); arguments as `solve_resistance`.

    Without loads, slip or background nothing moves; a slip alone makes a swimmer. Raises
    ValueError for `interior`, for a slip with a net flux and for `traction` with a slip.
    """
    formulation = Formulation(formulation)
    solver = _solver(body, formulation, resolution, tolerance, cache)
    given = _prescribed(body, solver.grid, background, slip)
    unit = viscosity * body.scale
    loads = (
        body.vectors_to_local(force) / unit,
        body.vectors_to_local(torque) / (unit * body.scale),
    )
    if formulation is Formulation.TRACTION:
        if slip is not None:
            raise ValueError("formulation traction: the surface must move rigidly, without slip")
        inside = _background_traction(body, solver.grid, background, viscosity)
        density, *parts = solver.solve_mobility(-inside * body.scale / viscosity, *loads)
        motion = np.concatenate(parts) - solver.mean_motion(given)
    else:
        if formulation is Formulation.SINGLE:
            _refuse_flux(solver.grid, given)
        density, *parts = solver.solve_mobility(given, *loads)
        motion = np.concatenate(parts)
    field = given + solver.rigid_motions @ motion
    return _solution(body, viscosity, solver, background, density, field, motion)


def resistance_matrix(
    body: Body,
    viscosity: float = 1.0,
    *,
    formulation: Formulation | str = Formulation.COMBINED,
    resolution: Resolution | None = None,
    tolerance: float = 1e-12,
    cache: OperatorCache | None = None,
) -> Array:
    """(6, 6): force and torque to apply for a velocity and an angular velocity, world's frame.

    Symmetric and positive definite, to the accuracy of the solution (it is not symmetrised).
    Arguments as `solve_resistance`.
    """
    solver = _solver(body, Formulation(formulation), resolution, tolerance, cache)
    turn = np.kron(np.eye(2), body.rotation)
    lever = np.repeat([1.0, body.scale], 3)
    unit = lever[:, None] * solver.resistance * lever
    return viscosity * body.scale * (turn @ unit @ turn.T)


# ---- parts ---------------------------------------------------------------------------------


def _solver(
    body: Body,
    formulation: Formulation,
    resolution: Resolution | None,
    tolerance: float,
    cache: OperatorCache | None,
) -> ShapeSolver:
    if resolution is None:
        resolution = resolution_for(body.curve, tolerance)
    cache = OperatorCache() if cache is None else cache
    return cache.solver(body.curve, resolution, formulation)


def _prescribed(
    body: Body, grid: SurfaceGrid, background: BackgroundFlow | None, slip: Slip | None
) -> Array:
    """Slip minus background at the nodes, (n_s, n_theta, 3), local components."""
    field = np.zeros(grid.points.shape)
    if callable(slip):
        field += np.reshape(slip(grid.points.reshape(-1, 3)), field.shape)
    elif slip is not None:
        slip = np.asarray(slip, dtype=np.float64)
        if slip.shape != field.shape:
            raise ValueError(f"slip of shape {slip.shape}: the nodes want {field.shape}")
        field += slip
    if background is not None:
        flow = background.velocity(body.to_world(grid.points).reshape(-1, 3))
        field -= body.vectors_to_local(flow).reshape(field.shape)
    return field


def _background_traction(
    body: Body, grid: SurfaceGrid, background: BackgroundFlow | None, viscosity: float
) -> Array:
    """sigma.n of the flow without the body, (n_s, n_theta, 3), local components."""
    if background is None:
        return np.zeros(grid.points.shape)
    stress = background.stress(body.to_world(grid.points).reshape(-1, 3), viscosity)
    normals = body.vectors_to_world(grid.normals).reshape(-1, 3)
    traction = np.einsum("nij,nj->ni", stress, normals)
    return body.vectors_to_local(traction).reshape(grid.points.shape)


def _solution(
    body: Body,
    viscosity: float,
    solver: ShapeSolver,
    background: BackgroundFlow | None,
    density: Array,
    field: Array,
    motion: Array,
) -> BodySolution:
    single_layer, double_layer = solver.layers(density)
    loads = -viscosity * body.scale * solver.loads(single_layer)
    stresslet = viscosity * body.scale**2 * _stresslet(solver.grid, single_layer, double_layer)
    return BodySolution(
        body=body,
        viscosity=viscosity,
        solver=solver,
        background=background,
        density=density,
        surface_velocity=field,
        velocity=body.vectors_to_world(motion[:3]),
        angular_velocity=body.vectors_to_world(motion[3:]) / body.scale,
        force=body.vectors_to_world(loads[:3]),
        torque=body.scale * body.vectors_to_world(loads[3:]),
        stresslet=body.rotation @ stresslet @ body.rotation.T,
    )


def _stresslet(grid: SurfaceGrid, single_layer: Array, double_layer: Array | None) -> Array:
    """-int (x rho + mu n + n mu), symmetric and traceless part, unit shape and viscosity 1.

    The flow inside the body has no stresslet; rho and mu are the jumps of t (to -rho) and u.
    (G. K. Batchelor, J. Fluid Mech. 41, 1970.)
    """
    moment = np.einsum("ab,abi,abj->ij", grid.weights, grid.points, single_layer)
    if double_layer is not None:
        moment += 2.0 * np.einsum("ab,abi,abj->ij", grid.weights, double_layer, grid.normals)
    moment = 0.5 * (moment + moment.T)
    return np.trace(moment) / 3.0 * np.eye(3) - moment


def _refuse_flux(grid: SurfaceGrid, field: Array) -> None:
    """Raise ValueError if fluid of this surface velocity flows out of the body."""
    flux = np.sum(grid.weights * np.sum(field * grid.normals, axis=-1))
    size = np.sum(grid.weights * np.linalg.norm(field, axis=-1))
    if abs(flux) > _FLUX * size:
        raise ValueError(
            f"the surface velocity has a net flux, {flux / size:.1e} of its size: a single layer "
            "makes no such flow"
        )


def _surface_divergence(grid: SurfaceGrid, field: Array) -> Array:
    """div_s u = (d_l u).tau + (d_theta u).e_theta / r of local components, (n_s, n_theta)."""
    meridian, n_theta = grid.meridian, grid.shape[1]
    along = _differentiation(meridian) @ field.reshape(meridian.size, -1)
    along = along.reshape(field.shape) / meridian.speed[:, None, None]
    theta = azimuths(n_theta)
    cos, sin = np.cos(theta), np.sin(theta)
    tangent = (meridian.dr / meridian.speed, meridian.dz / meridian.speed)
    across = _azimuthal_derivative(field) / meridian.r[:, None, None]
    return (
        tangent[0][:, None] * (cos * along[:, :, 0] + sin * along[:, :, 1])
        + tangent[1][:, None] * along[:, :, 2]
        + cos * across[:, :, 1]
        - sin * across[:, :, 0]
    )


def _azimuthal_derivative(field: Array) -> Array:
    """d/dtheta of Cartesian components: derivative of the trigonometric interpolant."""
    coefficients = np.fft.rfft(field, axis=1)
    modes = np.arange(coefficients.shape[1])
    return np.fft.irfft(1j * modes[:, None] * coefficients, n=field.shape[1], axis=1)


def _differentiation(meridian: Meridian) -> Array:
    """d/ds of the panels' interpolating polynomials, (n_s, n_s)."""
    x, w = gauss_legendre(meridian.resolution.nodes)
    barycentric = (-1.0) ** np.arange(len(x)) * np.sqrt(x * (1.0 - x) * w)
    gaps = x[:, None] - x + np.eye(len(x))
    D = barycentric / barycentric[:, None] / gaps
    np.fill_diagonal(D, 0.0)
    np.fill_diagonal(D, -D.sum(axis=1))
    return np.kron(np.diag(1.0 / np.diff(meridian.resolution.breaks)), D)
