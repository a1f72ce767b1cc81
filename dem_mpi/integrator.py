"""Semi-implicit Euler on the configuration: first velocities, then positions with them.

v_hat = v + h g;  v+ = v_hat + M^-1 D gamma;  x+ = x + h v+;  q+ = exp(h w+ / 2) q (S. De, thesis
2021, 2.9-2.10). A body in free fall is at z0 + v0 t + g t (t + h)/2 after t = k h, exactly.

Spheres have no gyroscopic term. Other axisymmetric bodies get the same kick at the orientation
that the step starts from, and then turn as free bodies do, in closed form: their angular momentum
and energy change by contacts alone, whatever h and the spin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_integrator as kernels
from dem_mpi.bodies import Bodies
from dem_mpi.parallel import Parallel


@dataclass(frozen=True)
class Motion:
    """Sums over all bodies: energies [J], largest speed [m/s], mass [kg], number.

    translational_energy leaves the spin out: a sphere that turns on the spot about a contact's
    normal meets no friction, and would turn for ever in a bed that is otherwise at rest.
    """

    kinetic_energy: float
    translational_energy: float
    largest_speed: float
    mass: float
    bodies: int

    @property
    def kinetic_speed(self) -> float:
        """Speed at which the total mass has the translational energy [m/s]."""
        if self.mass == 0.0:
            return 0.0
        return float(np.sqrt(2.0 * self.translational_energy / self.mass))


def predict(bodies: Bodies, gravity: NDArray, step: float) -> NDArray:
    """Return v_hat = v + h g, (n, 3): the velocity that contacts have yet to correct."""
    return bodies.velocity + step * gravity


def advance(
    bodies: Bodies,
    velocity: NDArray,
    angular_velocity: NDArray,
    step: float,
    rotating: bool,
    threads: int,
) -> None:
    """Give the bodies their new velocities and move them with these for one step, in place.

    The angular velocity of a body that is not a sphere changes on the way.
    """
    bodies.velocity[:] = velocity
    bodies.angular_velocity[:] = angular_velocity
    if bodies.shape.any():
        kernels.advance_axisymmetric.using(threads)(
            bodies.inertia,
            bodies.axial_inertia,
            bodies.position,
            bodies.orientation,
            bodies.velocity,
            bodies.angular_velocity,
            step,
        )
        return
    kernels.advance.using(threads)(
        bodies.position,
        bodies.orientation,
        bodies.velocity,
        bodies.angular_velocity,
        step,
        rotating,
    )


def kinetic_energy(bodies: Bodies, velocity: NDArray, angular_velocity: NDArray) -> float:
    """Return this rank's kinetic energy at the given velocities [J]."""
    b = bodies
    if b.shape.any():
        return float(
            kernels.axisymmetric_energy(
                b.mass, b.inertia, b.axial_inertia, b.orientation, velocity, angular_velocity
            )
        )
    return float(kernels.kinetic_energy(b.mass, b.inertia, velocity, angular_velocity))


def symmetry_axes(bodies: Bodies, threads: int = 1) -> NDArray:
    """Return the symmetry axis (n, 3) of each body in the world."""
    axis = np.empty((len(bodies), 3))
    kernels.symmetry_axes.using(threads)(bodies.orientation, axis)
    return axis


def measure(parallel: Parallel, bodies: Bodies) -> Motion:
    """Collective. Energies, largest speed, mass and number of all bodies."""
    energy = kinetic_energy(bodies, bodies.velocity, bodies.angular_velocity)
    translational = kernels.translational_energy(bodies.mass, bodies.velocity)
    sums = np.array([energy, translational, bodies.mass.sum(), float(len(bodies))])
    parallel.sum_in_place(sums)
    speed = np.array([kernels.largest_speed(bodies.velocity)])
    parallel.max_in_place(speed)
    return Motion(float(sums[0]), float(sums[1]), float(speed[0]), float(sums[2]), int(sums[3]))


def find_not_finite(bodies: Bodies) -> int:
    """Return the gid of a body whose position or velocity is not finite, or -1."""
    row = kernels.first_not_finite(bodies.position, bodies.velocity, bodies.angular_velocity)
    return int(bodies.gid[row]) if row >= 0 else -1
