"""The natural map, contact by contact: zero at solutions and nowhere else; Newton's method on it.

r - P_C(r - rho a), P_C the projection on the friction cones, vanishes where r in C, a in C* and
r.a = 0: for the cone complementarity problem with a = u = W r + q, for Coulomb's law with
a = u + mu |u_t| n (De Saxce). Dense matrices, for problems of a few hundred contacts.

Symbols: r impulse (m, 3) [N s]; u velocity (m, 3) [m/s]; rho [kg] weighs velocities as impulses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from contact_twins import projected

# Singular values of Newton's matrix below this part of the largest belong to self-stresses.
_RANK = 1e-12


def augmented(velocity: NDArray, mu: NDArray) -> NDArray:
    """u + mu |u_t| n."""
    result = velocity.copy()
    for i, (u, m) in enumerate(zip(velocity, mu, strict=True)):
        result[i, 0] += m * np.hypot(u[1], u[2])
    return result


def natural_residual(
    W: NDArray, q: NDArray, mu: NDArray, impulse: NDArray, scale: tuple[float, float]
) -> float:
    """The longest row of Coulomb's natural map over gamma_ref, with rho = gamma_ref / v_ref.

    scale : (v_ref [m/s], gamma_ref [N s])
    """
    v_ref, gamma_ref = scale
    velocity = (W @ impulse.ravel()).reshape(q.shape) + q
    rho = gamma_ref / v_ref
    rows = impulse - projected(impulse - rho * augmented(velocity, mu), mu)
    return float(np.linalg.norm(rows, axis=1).max(initial=0.0)) / gamma_ref


def refined(
    W: NDArray, q: NDArray, mu: NDArray, impulse: NDArray, steps: int = 4
) -> tuple[NDArray, float]:
    """Velocity (m, 3) and residual [m/s] of the best of some Newton steps on the cone problem.

    From an impulse that is nearly right the steps converge to round-off. Where the matrix is
    singular, N being so, the shortest step is taken. The residual is the largest entry of the
    natural map over rho.
    """
    rho = 3.0 / np.diag(W).reshape(-1, 3).sum(axis=1)
    best = (q, np.inf)
    for _ in range(steps):
        velocity = (W @ impulse.ravel()).reshape(q.shape) + q
        step = np.zeros_like(impulse)
        matrix = np.eye(q.size)
        rest = np.zeros_like(q)
        for i, (r, u) in enumerate(zip(impulse, velocity, strict=True)):
            rows = slice(3 * i, 3 * i + 3)
            point, slope = _projection(r - rho[i] * u, mu[i])
            rest[i] = r - point
            matrix[rows] += rho[i] * slope @ W[rows]
            matrix[rows, rows] -= slope
        residual = float(np.abs(rest / rho[:, None]).max())
        if residual < best[1]:
            best = (velocity, residual)
        step = linalg.lstsq(matrix, -rest.ravel(), cond=_RANK, lapack_driver="gelsy")[0]
        impulse = impulse + step.reshape(impulse.shape)
    return best


def _projection(z: NDArray, mu: float) -> tuple[NDArray, NDArray]:
    """P_C(z) of one contact and its derivative (3, 3)."""
    n, t = z[0], np.hypot(z[1], z[2])
    if t <= mu * n:
        return z.copy(), np.eye(3)
    if mu * t <= -n:
        return np.zeros(3), np.zeros((3, 3))
    along = z[1:] / t
    edge = np.array([1.0, *(mu * along)])  # the border of the cone nearest to z
    height = (n + mu * t) / (1.0 + mu * mu)
    slope = np.outer(edge, edge) / (1.0 + mu * mu)
    slope[1:, 1:] += mu * height / t * (np.eye(2) - np.outer(along, along))
    return height * edge, slope
