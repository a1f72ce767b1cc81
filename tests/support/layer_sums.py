"""Layer potentials away from their surface, summed term by term; and flows to compare them with."""

import math
from dataclasses import replace

import numpy as np

from stokes.background import BackgroundFlow
from stokes.exact import stokeslet_pressure, stokeslet_stress, stokeslet_velocity
from stokes.geometry import Meridian, SurfaceGrid
from stokes.modes import azimuths, from_modes, to_modes
from stokes.quadrature import gauss_legendre, interpolation_matrix


class PointForces(BackgroundFlow):
    """Flow of point forces (n, 3) at positions (n, 3), viscosity 1."""

    def __init__(self, positions, forces):
        self.positions, self.forces = np.atleast_2d(positions), np.atleast_2d(forces)

    def velocity(self, points):
        return stokeslet_velocity(points, self.positions, self.forces)

    def velocity_gradient(self, points):
        raise NotImplementedError

    def pressure(self, points, viscosity=1.0):
        return stokeslet_pressure(points, self.positions, self.forces)

    def stress(self, points, viscosity=1.0):
        return stokeslet_stress(points, self.positions, self.forces)

    @property
    def text(self):
        return "point forces"


def on_grid(grid: SurfaceGrid, flow: BackgroundFlow):
    """Velocity and traction (n_s, n_theta, 3) of a flow at the nodes, outward normal."""
    velocity = flow.velocity(grid.points.reshape(-1, 3)).reshape(grid.points.shape)
    stress = flow.stress(grid.points.reshape(-1, 3)).reshape(*grid.points.shape, 3)
    return velocity, np.einsum("...ij,...j->...i", stress, grid.normals)


def refined(operators, field, refinement):
    """A field's interpolant on (azimuths, nodes of a panel) times as many nodes, and these nodes.

    Returns values, points, normals (n, 3) and weights of area (n,).
    """
    azimuth, meridional = refinement
    resolution = operators.resolution
    q, angles = meridional * resolution.nodes, azimuth * resolution.angles
    fine = Meridian(operators.curve, replace(resolution, nodes=q))
    upward = interpolation_matrix(resolution.nodes, gauss_legendre(q)[0])
    coefficients = to_modes(field)
    modes, rows, _ = coefficients.shape
    panels = coefficients.reshape(modes, rows, 3 * resolution.panels, resolution.nodes)
    values = from_modes((panels @ upward.T).reshape(modes, rows, -1), angles)
    theta = azimuths(angles)
    points, normals = (
        np.stack(
            [
                radial[:, None] * np.cos(theta),
                radial[:, None] * np.sin(theta),
                np.repeat(axial[:, None], angles, axis=1),
            ],
            axis=-1,
        )
        for radial, axial in ((fine.r, fine.z), (fine.normal_r, fine.normal_z))
    )
    weights = np.repeat(2.0 * math.pi / angles * fine.weights * fine.r, angles)
    return values.reshape(-1, 3), points.reshape(-1, 3), normals.reshape(-1, 3), weights


def flow_of_layers(solver, density, targets, refinement=(3, 2)):
    """S rho + D mu at points (n, 3) off the unit surface, by the plain rule on refined nodes."""
    velocity = np.zeros(targets.shape)
    for layer, values in zip((_single, _double), solver.layers(density), strict=True):
        if values is None:
            continue
        fine, points, normals, weights = refined(solver.operators, values, refinement)
        for k, target in enumerate(targets):
            velocity[k] += layer(target - points, fine * weights[:, None], normals)
    return velocity


def _single(x, rho, normals):
    distance = np.linalg.norm(x, axis=1)
    along = np.sum(x * rho, axis=1)
    terms = rho / distance[:, None] + x * (along / distance**3)[:, None]
    return terms.sum(axis=0) / (8.0 * math.pi)


def _double(x, mu, normals):
    factor = np.sum(x * mu, axis=1) * np.sum(x * normals, axis=1)
    distance = np.linalg.norm(x, axis=1)
    return 3.0 / (4.0 * math.pi) * (x * (factor / distance**5)[:, None]).sum(axis=0)
