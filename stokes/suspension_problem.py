"""What `Suspension.solve` is asked: motions, loads or surface velocities, as right-hand sides.

Symbols: b bodies and n nodes of this rank. On the surfaces the disturbance of the background u_0
is U + omega cross x + slip - u_0; where the motion is unknown, its terms stand on the left.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes.background import BackgroundFlow
from stokes.suspension_layout import Field
from stokes.suspension_surfaces import OwnSurfaces

Function = Callable[[NDArray], ArrayLike]
SurfaceData = ArrayLike | Function | Sequence[Function]
# Flux of the surface velocity, relative to its mean size, that still passes for round-off and
# for what a coarse grid makes of a flux of zero.
_FLUX = 1e-3


@dataclass(frozen=True)
class Request:
    """The arguments of `Suspension.solve`; None for what is not given."""

    velocity: ArrayLike | None = None
    angular_velocity: ArrayLike | None = None
    force: ArrayLike | None = None
    torque: ArrayLike | None = None
    slip: SurfaceData | None = None
    boundary_velocity: ArrayLike | Function | None = None

    @property
    def motion_given(self) -> bool:
        """Whether loads are asked for, not motions. ValueError for both or neither at once."""
        moved = self.velocity is not None or self.angular_velocity is not None
        loaded = self.force is not None or self.torque is not None
        if self.boundary_velocity is not None:
            if moved or loaded or self.slip is not None:
                raise ValueError("boundary_velocity is all that moves: give nothing beside it")
            return True
        if moved and loaded:
            raise ValueError("give velocity and angular_velocity, or force and torque, not both")
        return moved


@dataclass(frozen=True)
class Problem:
    """A right-hand side in the solver's frames and units, and the motions that are known.

    right_side : velocities (n, 3), loads (b, 6) or None where the motion is given
    motion     : (b, 6) as given; None if unknown
    """

    right_side: Field
    motion: NDArray | None


def pose(
    request: Request, surfaces: OwnSurfaces, background: BackgroundFlow | None, viscosity: float
) -> Problem:
    """The problem of a request on this rank. ValueError for data that do not fit or leak."""
    b = surfaces.layout.bodies
    velocity = np.zeros((surfaces.layout.nodes, 3))
    if request.boundary_velocity is not None:
        velocity += surfaces.to_local(_world_data(request.boundary_velocity, surfaces))
    if request.slip is not None:
        velocity += _slip(request.slip, surfaces)
    if background is not None:
        velocity -= surfaces.to_local(background.velocity(surfaces.points))
    if request.motion_given:
        motion = _local(
            surfaces,
            _vectors("velocity", request.velocity, surfaces),
            surfaces.scale[:, None]
            * _vectors("angular_velocity", request.angular_velocity, surfaces),
        )
        moved = surfaces.per_body(motion)
        velocity += moved[:, :3] + np.cross(moved[:, 3:], surfaces.arms)
        problem = Problem(Field(velocity), motion)
    else:
        unit = viscosity * surfaces.scale[:, None]
        force = _vectors("force", request.force, surfaces) / unit
        torque = _vectors("torque", request.torque, surfaces) / (unit * surfaces.scale[:, None])
        problem = Problem(Field(velocity, _local(surfaces, force, torque).reshape(b, 6)), None)
    _refuse_flux(surfaces, velocity)
    return problem


def _vectors(name: str, values: ArrayLike | None, surfaces: OwnSurfaces) -> NDArray:
    """One vector for each body, in the layout's order (b, 3); given as (b, 3) or one for all."""
    b = surfaces.layout.bodies
    array = np.zeros(3) if values is None else np.asarray(values, dtype=np.float64)
    if array.shape not in ((3,), (b, 3)) or not np.isfinite(array).all():
        raise ValueError(f"{name} of shape {array.shape}: must be ({b}, 3) or (3,), finite")
    return np.broadcast_to(array, (b, 3))[surfaces.layout.order]


def _local(surfaces: OwnSurfaces, first: NDArray, second: NDArray) -> NDArray:
    """Two vectors of each body side by side, turned to its frame: (b, 6)."""
    pair = np.stack([first, second], axis=1)
    return (pair @ surfaces.rotation).reshape(-1, 6)


def _world_data(data: ArrayLike | Function, surfaces: OwnSurfaces) -> NDArray:
    """Velocities (n, 3) in the world, of a function of points or of values at the nodes."""
    if callable(data):
        return _shaped("boundary_velocity", data(surfaces.points), surfaces)
    values = np.empty((surfaces.layout.nodes, 3))
    values[surfaces.given_order] = _shaped("boundary_velocity", data, surfaces)
    return values


def _slip(data: SurfaceData, surfaces: OwnSurfaces) -> NDArray:
    """Slip velocities (n, 3) in the solver's frames; given in the frames of the bodies as given."""
    functions = _functions(data, surfaces.layout.bodies)
    if functions is None:
        values = np.empty((surfaces.layout.nodes, 3))
        values[surfaces.given_order] = _shaped("slip", data, surfaces)
    else:
        parts = [np.empty((0, 3))]
        for row, given in enumerate(surfaces.given):
            function = functions[surfaces.layout.order[row]]
            points = surfaces.points[surfaces.layout.range_of(row)]
            parts.append(np.asarray(function(given.to_local(points)), dtype=np.float64))
        values = _shaped("slip", np.concatenate(parts), surfaces)
    turn = np.array([body.rotation for body in surfaces.given]).reshape(-1, 3, 3)
    world = np.einsum("nij,nj->ni", surfaces.per_body(turn), values)
    return surfaces.to_local(world)


def _functions(data: SurfaceData, bodies: int) -> Sequence[Function] | None:
    """One function for each body, or None for an array."""
    if callable(data):
        return [data] * bodies
    if isinstance(data, Sequence) and any(callable(part) for part in data):
        if len(data) != bodies:
            raise ValueError(f"slip: {len(data)} functions for {bodies} bodies")
        return data
    return None


def _shaped(name: str, values: ArrayLike, surfaces: OwnSurfaces) -> NDArray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (surfaces.layout.nodes, 3) or not np.isfinite(array).all():
        wanted = (surfaces.layout.nodes, 3)
        raise ValueError(f"{name} of shape {array.shape}: must be {wanted}, finite")
    return array


def _refuse_flux(surfaces: OwnSurfaces, velocity: NDArray) -> None:
    """ValueError, with the body, if fluid of this surface velocity flows out of it."""
    outward = np.einsum("ni,ni->n", velocity, surfaces.normals)
    flux = np.abs(surfaces.sum_over_bodies(surfaces.weights * outward))
    size = surfaces.sum_over_bodies(surfaces.weights * np.linalg.norm(velocity, axis=1))
    leaking = np.flatnonzero(flux > _FLUX * size)
    if len(leaking):
        k = leaking[0]
        raise ValueError(
            f"body {surfaces.layout.order[k]}: the surface velocity has a net flux, "
            f"{flux[k] / size[k]:.1e} of its size: rigid bodies keep their volume"
        )
