"""Rigid multiblobs: the method of regular beads that accurate boundary integrals are held against.

A body is a shell of n blobs, spheres of radius a at points of its surface, which move with it. The
forces lambda on the fluid at the blobs follow from

    sum_j M_ij lambda_j = U + Omega x (r_i - centre),   F = - sum lambda,   T = - sum r x lambda

with M of J. Rotne and S. Prager 1969 and H. Yamakawa 1970, for blobs of unequal radii (P. Zuk et
al., J. Fluid Mech. 741, R5, 2014): positive definite, also where blobs overlap.

As its users do (F. Balboa Usabiaga et al., Commun. Appl. Math. Comput. Sci. 11, 217, 2016), blobs
touch their neighbours, the shell is scaled such that the drag of a body alone is right on average,
and GMRES is preconditioned with the inverse of every body alone. Sums are fast multipole sums.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import LinearOperator, gmres
from scipy.spatial import cKDTree

from stokes.exact import ellipsoid_resistance
from stokes.fmm import KERNELS, Fmm, FmmOptions

_DIRECT = 3000
"""Fewer blobs than this are summed directly: it takes less time."""


@dataclass(frozen=True)
class Shell:
    """Blobs of one body in its own frame: points (n, 3) from the centre, all of one radius."""

    points: NDArray
    radius: float


@dataclass(frozen=True)
class MultiblobSolution:
    """Forces and torques (b, 3) by the fluid on the bodies; seconds of set-up and of GMRES."""

    forces: NDArray
    torques: NDArray
    iterations: int
    residual: float
    set_up: float
    solve: float


def shell(semi_axes: Sequence[float], count: int) -> Shell:
    """`count` blobs on a spheroid (equatorial, equatorial, polar), spread evenly by area.

    The blobs' diameter is the mean distance to the nearest neighbour; then all lengths are scaled
    by one factor, such that the mean translational resistance is that of the spheroid.
    """
    points = _spiral(float(semi_axes[0]), float(semi_axes[2]), count)
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    radius = 0.5 * float(nearest.mean())
    M = _mobility(points, np.full(count, radius))
    rigid = np.tile(np.eye(3), (count, 1))
    resistance = rigid.T @ np.linalg.solve(M, rigid)
    exact = ellipsoid_resistance(semi_axes).translation
    scale = float(exact.mean() / np.diag(resistance).mean())
    return Shell(scale * points, scale * radius)


def _spiral(equatorial: float, polar: float, count: int) -> NDArray:
    """Points (count, 3) of equal area each, turned by the golden angle from one to the next."""
    angle = np.linspace(0.0, math.pi, 4001)
    middle = 0.5 * (angle[1:] + angle[:-1])
    ring = equatorial * np.sin(middle)
    length = np.hypot(equatorial * np.cos(middle), polar * np.sin(middle))
    area = np.concatenate([[0.0], np.cumsum(ring * length)])
    share = (np.arange(count) + 0.5) / count * area[-1]
    theta = np.interp(share, area, angle)
    phi = math.pi * (3.0 - math.sqrt(5.0)) * np.arange(count)
    r = equatorial * np.sin(theta)
    return np.stack([r * np.cos(phi), r * np.sin(phi), polar * np.cos(theta)], axis=1)


class Multiblob:
    """A suspension of shells, viscosity 1."""

    def __init__(
        self,
        shells: Sequence[Shell],
        centres: NDArray,
        rotations: NDArray,
        tolerance: float = 1e-4,
    ) -> None:
        """Place shells at centres (b, 3), turned by rotations (b, 3, 3), and factorise each alone.

        tolerance : of the sums, relative, and of GMRES in the preconditioned residual
        """
        began = perf_counter()
        self._tolerance = tolerance
        self._rotations, self._centres = np.asarray(rotations), np.asarray(centres)
        sizes = [len(s.points) for s in shells]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        self._arms = np.concatenate(
            [s.points @ R.T for s, R in zip(shells, self._rotations, strict=True)]
        )
        self._positions = self._arms + np.repeat(self._centres, sizes, axis=0)
        self._radii = np.repeat([s.radius for s in shells], sizes)
        self._factors = _factors(shells)
        options = FmmOptions(backend="direct" if len(self._radii) < _DIRECT else "own")
        self._stokeslet, self._dipole = (
            Fmm(KERNELS[name], self._positions, eps=0.1 * tolerance, options=options)
            for name in ("stokeslet", "laplace_dipole_gradient")
        )
        self._overlaps = _overlaps(self._positions, self._radii)
        self._set_up = perf_counter() - began

    def apply(self, forces: NDArray) -> NDArray:
        """Velocities (n, 3) of the blobs by forces (n, 3) on the fluid.

        u_i = (G f + (a_i^2 + a_j^2)/3 D f) / 8 pi, with D f = f/r^3 - 3 r r.f / r^5.
        """
        squares = (self._radii**2)[:, None]
        dipoles = self._dipole.apply(np.stack([forces, squares * forces], axis=2))
        far = self._stokeslet.apply(forces) + (squares * dipoles[..., 0] + dipoles[..., 1]) / 3.0
        near = (self._overlaps @ forces.ravel()).reshape(-1, 3)
        return far / (8.0 * math.pi) + near + forces / (6.0 * math.pi * self._radii)[:, None]

    def solve(self, velocity: NDArray, angular_velocity: NDArray) -> MultiblobSolution:
        """Loads on bodies that move with velocity (b, 3) and angular velocity (b, 3)."""
        began = perf_counter()
        body = np.repeat(np.arange(len(self._centres)), np.diff(self._starts))
        motion = velocity[body] + np.cross(angular_velocity[body], self._arms)
        size = motion.size
        history: list[float] = []
        found, flag = gmres(
            LinearOperator((size, size), lambda f: self._precondition(self.apply(_rows(f)))),
            self._precondition(motion),
            **_gmres_tolerance(self._tolerance),
            restart=200,
            maxiter=1,
            callback=history.append,
            callback_type="pr_norm",
        )
        if flag:
            raise ArithmeticError(f"multiblob: {len(history)} iterations, residual {history[-1]:g}")
        lift = _rows(found)
        forces = -np.add.reduceat(lift, self._starts[:-1])
        torques = -np.add.reduceat(np.cross(self._arms, lift), self._starts[:-1])
        seconds = perf_counter() - began
        return MultiblobSolution(
            forces, torques, len(history), history[-1], self._set_up, seconds
        )  # fmt: skip

    def _precondition(self, velocities: NDArray) -> NDArray:
        """Forces of every body alone, flat; solved in the bodies' own frames."""
        out = np.empty_like(velocities)
        for k, (factor, R) in enumerate(zip(self._factors, self._rotations, strict=True)):
            rows = slice(self._starts[k], self._starts[k + 1])
            out[rows] = _rows(cho_solve(factor, (velocities[rows] @ R).ravel())) @ R.T
        return out.ravel()


def _rows(flat: NDArray) -> NDArray:
    return np.asarray(flat).reshape(-1, 3)


def _gmres_tolerance(tolerance: float) -> dict[str, float]:
    """SciPy has renamed its relative tolerance."""
    import inspect

    name = "rtol" if "rtol" in inspect.signature(gmres).parameters else "tol"
    return {name: tolerance, "atol": 0.0}


def _factors(shells: Sequence[Shell]) -> list[tuple[NDArray, bool]]:
    """Cholesky factors of the mobility of each shell, of equal shells once."""
    known: dict[int, tuple[NDArray, bool]] = {}
    for s in shells:
        if id(s) not in known:
            known[id(s)] = cho_factor(
                _mobility(s.points, np.full(len(s.points), s.radius)), lower=True
            )
    return [known[id(s)] for s in shells]


def _mobility(points: NDArray, radii: NDArray) -> NDArray:
    """The dense mobility (3 n, 3 n)."""
    n = len(points)
    i, j = (index.ravel() for index in np.indices((n, n)))
    apart = i != j
    blocks = np.empty((n * n, 3, 3))
    blocks[~apart] = np.eye(3) / (6.0 * math.pi * radii)[:, None, None]
    blocks[apart] = _pair(points[i[apart]] - points[j[apart]], radii[i[apart]], radii[j[apart]])
    return blocks.reshape(n, n, 3, 3).transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def _pair(r: NDArray, a: NDArray, b: NDArray) -> NDArray:
    """Mobility (k, 3, 3) of blobs of radii a and b at distances r (k, 3)."""
    distance = np.linalg.norm(r, axis=1)
    far = _far(r, a, b)
    close = distance < a + b
    if close.any():
        far[close] = _overlapping(r[close], a[close], b[close])
    return far


def _far(r: NDArray, a: NDArray, b: NDArray) -> NDArray:
    """(1 + (a^2 + b^2)/3 ... ) of the Stokeslet: exact where the blobs do not overlap."""
    distance = np.linalg.norm(r, axis=1)
    e = r / distance[:, None]
    s = (a**2 + b**2) / (3.0 * distance**2)
    identity = ((1.0 + s) / distance)[:, None, None] * np.eye(3)
    along = ((1.0 - 3.0 * s) / distance)[:, None, None] * np.einsum("ki,kj->kij", e, e)
    return (identity + along) / (8.0 * math.pi)


def _overlapping(r: NDArray, a: NDArray, b: NDArray) -> NDArray:
    """The same for |a - b| < r < a + b (P. Zuk et al., eq. 3.2)."""
    distance = np.linalg.norm(r, axis=1)
    e = r / distance[:, None]
    difference = (a - b) ** 2
    cube = 32.0 * distance**3
    first = (16.0 * distance**3 * (a + b) - (difference + 3.0 * distance**2) ** 2) / cube
    second = 3.0 * (difference - distance**2) ** 2 / cube
    blocks = first[:, None, None] * np.eye(3)
    blocks = blocks + second[:, None, None] * np.einsum("ki,kj->kij", e, e)
    return blocks / (6.0 * math.pi * a * b)[:, None, None]


def _overlaps(points: NDArray, radii: NDArray) -> sparse.csr_matrix:
    """What is to be added to the far form for overlapping pairs (3 n, 3 n)."""
    pairs = cKDTree(points).query_pairs(2.0 * float(radii.max()), output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    r = points[i] - points[j]
    close = np.linalg.norm(r, axis=1) < radii[i] + radii[j]
    i, j, r = i[close], j[close], r[close]
    blocks = _overlapping(r, radii[i], radii[j]) - _far(r, radii[i], radii[j])
    rows = np.broadcast_to(3 * i[:, None, None] + np.arange(3)[:, None], blocks.shape)
    columns = np.broadcast_to(3 * j[:, None, None] + np.arange(3), blocks.shape)
    entries = (blocks.ravel(), (rows.ravel(), columns.ravel()))
    return sparse.csr_matrix(entries, shape=(3 * len(points), 3 * len(points)))
