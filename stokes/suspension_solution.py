"""What a suspension answers: loads, motions and the densities that make the flow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.parallel import Parallel
from stokes.background import BackgroundFlow
from stokes.evaluate import evaluate
from stokes.formulation import ShapeSolver
from stokes.geometry import Body, Resolution
from stokes.near import Quantity
from stokes.suspension_operator import sum_options
from stokes.suspension_options import SuspensionOptions, SuspensionReport
from stokes.suspension_surfaces import OwnSurfaces


@dataclass(frozen=True)
class DisturbedFlow:
    """The background flow and what the bodies make of it, up to their surfaces.

    bodies, resolutions : this rank's
    single, double : (n, 3) rho and mu at their nodes, in the bodies' frames, as `evaluate` has them
    """

    bodies: Sequence[Body]
    resolutions: Sequence[Resolution]
    single: NDArray
    double: NDArray | None
    background: BackgroundFlow | None
    viscosity: float
    tolerance: float
    options: SuspensionOptions
    parallel: Parallel

    def velocity(self, points: ArrayLike) -> NDArray:
        """Collective. Velocities (m, 3) at points (m, 3) of this rank; NaN inside bodies."""
        values = self._evaluated(points, "velocity")
        if self.background is not None:
            values += self.background.velocity(points)
        return values

    def pressure(self, points: ArrayLike) -> NDArray:
        """Collective. Pressures (m,) at points (m, 3) of this rank; NaN inside bodies."""
        values = self._evaluated(points, "pressure")
        if self.background is not None:
            values += self.background.pressure(points, self.viscosity)
        return values

    def _evaluated(self, points: ArrayLike, quantity: Quantity) -> NDArray:
        return evaluate(
            self.bodies,
            self.resolutions,
            points,
            self.single,
            self.double,
            quantity,
            self.viscosity,
            self.tolerance,
            self.parallel,
            sum_options(self.options, self.tolerance),
        )


@dataclass(frozen=True)
class SuspensionSolution:
    """Of this rank's b bodies, in the order in which they were given; vectors in the world.

    forces, torques : (b, 3) of the fluid on the bodies, torques about their centres
    stresslets      : (b, 3, 3) symmetric, trace zero: int of the symmetric, traceless part of
                      x t - viscosity (u n + n u) over the surface, u and t of the disturbance
    velocities, angular_velocities : (b, 3); None where surface velocities were given
    single_layer, double_layer : (n, 3) rho and mu at `Suspension.nodes` of the disturbance
                      u = S rho / viscosity + D mu; None for a layer that is not there. In the
                      formulation "single", for rigid motions, -rho is the traction of the fluid on
                      the body up to a constant pressure
    density         : (n, 3) the solver's unknown, in its order and frames
    iterations      : of GMRES
    residuals       : relative, in the mean square over the surfaces, before the first and after
                      every iteration
    converged       : whether the last is at most the residual's tolerance; reason: why it ended
    report          : of the suspension, after this solution
    flow            : velocity and pressure anywhere
    """

    forces: NDArray
    torques: NDArray
    stresslets: NDArray
    velocities: NDArray | None
    angular_velocities: NDArray | None
    single_layer: NDArray | None
    double_layer: NDArray | None
    density: NDArray
    iterations: int
    residuals: tuple[float, ...]
    converged: bool
    reason: str
    report: SuspensionReport
    flow: DisturbedFlow

    def velocity(self, points: ArrayLike) -> NDArray:
        """Collective. Velocities (m, 3) at points (m, 3) of this rank; NaN inside bodies."""
        return self.flow.velocity(points)

    def pressure(self, points: ArrayLike) -> NDArray:
        """Collective. Pressures (m,) at points (m, 3) of this rank; NaN inside bodies."""
        return self.flow.pressure(points)


@dataclass(frozen=True)
class SurfaceMoments:
    """Of bodies in the layout's order: forces, torques (b, 3), stresslets (b, 3, 3), the world's.

    single, double : (n, 3) rho and mu of the world, in the bodies' frames
    """

    forces: NDArray
    torques: NDArray
    stresslets: NDArray
    single: NDArray
    double: NDArray | None


def moments(
    density: NDArray,
    surfaces: OwnSurfaces,
    solvers: Mapping[int, ShapeSolver],
    viscosity: float,
    with_double: bool,
) -> SurfaceMoments:
    """Loads of the fluid on the bodies, and the layers, of a density (n, 3) of the solver.

    with_double : whether the formulation has a double layer, which a rank without bodies cannot see
    """
    single, double = _unit_layers(density, surfaces, solvers)
    double = double if with_double else None
    a = surfaces.scale
    weights = surfaces.weights / surfaces.per_body(a) ** 2
    force = -surfaces.sum_over_bodies(weights[:, None] * single)
    torque = -surfaces.sum_over_bodies(weights[:, None] * np.cross(surfaces.arms, single))
    dipole = surfaces.arms[:, :, None] * single[:, None, :]
    if double is not None:
        dipole += 2.0 * double[:, :, None] * surfaces.normals[:, None, :]
    stresslet = -_symmetric_traceless(surfaces.sum_over_bodies(weights[:, None, None] * dipole))
    turn = surfaces.rotation
    unit = viscosity * a[:, None]
    return SurfaceMoments(
        forces=unit * np.einsum("bij,bj->bi", turn, force),
        torques=unit * a[:, None] * np.einsum("bij,bj->bi", turn, torque),
        stresslets=(unit * a[:, None])[:, :, None] * (turn @ stresslet @ np.swapaxes(turn, 1, 2)),
        single=viscosity / surfaces.per_body(a)[:, None] * single,
        double=double,
    )


def _unit_layers(
    density: NDArray, surfaces: OwnSurfaces, solvers: Mapping[int, ShapeSolver]
) -> tuple[NDArray, NDArray]:
    """rho and mu (n, 3) of the unit shapes at viscosity 1, in the bodies' frames."""
    single, double = np.empty_like(density), np.zeros_like(density)
    for group in surfaces.layout.groups:
        columns = group.columns(density)
        rho, mu = solvers[group.shape].layers(columns)
        group.put(single, rho)
        if mu is not None:
            group.put(double, mu)
    return single, double


def _symmetric_traceless(tensors: NDArray) -> NDArray:
    symmetric = 0.5 * (tensors + np.swapaxes(tensors, 1, 2))
    trace = np.trace(symmetric, axis1=1, axis2=2)
    return symmetric - trace[:, None, None] / 3.0 * np.eye(3)


def in_given_order(values: NDArray, order: Sequence[int] | NDArray) -> NDArray:
    """Rows (b, ...) of the layout, put in the order in which bodies were given."""
    given = np.empty_like(values)
    given[np.asarray(order)] = values
    return given
