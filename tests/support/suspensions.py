"""Small suspensions, and a flow around them that is known exactly."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stokes.exact import stokeslet_pressure, stokeslet_velocity
from stokes.geometry import Body, sphere, spherocylinder, spheroid


def quaternion(seed):
    """A random orientation, scalar first."""
    return tuple(Rotation.random(random_state=seed).as_quat()[[3, 0, 1, 2]].tolist())


def mixed_cluster():
    """Five bodies of four shapes and five sizes; the least gap is a fifth of the smaller size."""
    return [
        Body(spheroid(0.5, 1.0), 1.0, (0.0, 0.0, 0.0), quaternion(1)),
        Body(sphere(), 0.7, (2.0, 0.1, -0.2)),
        Body(spheroid(1.0, 0.5), 1.1, (0.1, 2.3, 0.3), quaternion(2)),
        Body(spherocylinder(0.5, 0.6), 0.8, (-0.2, 0.3, 2.2), quaternion(3)),
        Body(sphere(), 0.5, (1.9, 1.6, 0.6)),
    ]


def turned(bodies, rotation, shift=(0.0, 0.0, 0.0)):
    """The same bodies after a rotation of all of space (3, 3) and a shift."""
    moved = []
    for body in bodies:
        x, y, z, w = Rotation.from_matrix(rotation @ body.rotation).as_quat()
        centre = rotation @ np.array(body.centre) + shift
        moved.append(Body(body.curve, body.scale, tuple(centre), (w, x, y, z)))
    return moved


class ForcesAtCentres:
    """The flow of a random point force at the centre of each body, of a fluid of viscosity 1."""

    def __init__(self, bodies, seed=0):
        self.centres = np.array([body.centre for body in bodies])
        self.forces = np.random.default_rng(seed).standard_normal((len(bodies), 3))

    def velocity(self, points):
        return stokeslet_velocity(points, self.centres, self.forces)

    def pressure(self, points):
        return stokeslet_pressure(points, self.centres, self.forces)
