"""The natural map of Coulomb's law, contact by contact: zero at solutions and nowhere else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_twins import projected


def augmented(velocity: NDArray, mu: NDArray) -> NDArray:
    """u + mu |u_t| n, (m, 3): what Coulomb's law puts into the dual cone (De Saxce)."""
    result = velocity.copy()
    for i, (u, m) in enumerate(zip(velocity, mu, strict=True)):
        result[i, 0] += m * np.hypot(u[1], u[2])
    return result


def natural_map(impulse: NDArray, velocity: NDArray, mu: NDArray, rho: float) -> NDArray:
    """r - P_C(r - rho (u + mu |u_t| n)), (m, 3) [N s]; rho [kg] > 0 weighs speeds as impulses."""
    return impulse - projected(impulse - rho * augmented(velocity, mu), mu)


def natural_residual(
    W: NDArray, q: NDArray, mu: NDArray, impulse: NDArray, scale: tuple[float, float]
) -> float:
    """The longest row of the natural map of u = W r + q over gamma_ref, rho = gamma_ref / v_ref.

    scale : (v_ref [m/s], gamma_ref [N s])
    """
    velocity = (W @ impulse.ravel()).reshape(q.shape) + q
    v_ref, gamma_ref = scale
    rows = natural_map(impulse, velocity, mu, gamma_ref / v_ref)
    return float(np.linalg.norm(rows, axis=1).max(initial=0.0)) / gamma_ref
