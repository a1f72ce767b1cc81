"""Measured errors of the fast sum on small clouds: what nodes and precision give which error.

Everything is seeded and counted, nothing is timed: the same kernel gets the same numbers on every
machine and rank.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel
from stokes.fmm.direct import direct_sum
from stokes.fmm.kernels import Kernel
from stokes.fmm.tree import Splitting
from stokes.fmm.tree_sum import Scheme, TreeSum

DISTRIBUTIONS = ("cube", "sphere", "prolate", "clustered")
_SEED = 19870801
_POINTS = 1000
_TARGETS = 300


def cloud(distribution: str, count: int, seed: int) -> NDArray[np.float64]:
    """Points (count, 3) in a cube of edge 1, on a sphere, on a 10:1 spheroid, or in clusters.

    Clusters have sizes over three decades, so that trees over them are deep and uneven.
    """
    rng = np.random.default_rng(seed)
    if distribution == "cube":
        return rng.random((count, 3))
    if distribution == "clustered":
        centres = rng.random((8, 3))
        spread = 10.0 ** rng.uniform(-3.5, -0.5, size=(count, 1))
        return centres[rng.integers(8, size=count)] + spread * rng.normal(size=(count, 3))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    if distribution == "sphere":
        return direction
    if distribution == "prolate":
        return direction * np.array([0.1, 0.1, 1.0])
    raise ValueError(f"distribution {distribution!r}: must be one of {DISTRIBUTIONS}")


def sum_error(
    kernel: Kernel,
    scheme: Scheme,
    distribution: str = "cube",
    edge: float | None = None,
    points: int = _POINTS,
) -> float:
    """Relative 2-norm of the error on a sample, the larger of weights of random and of one sign.

    edge: size of the cloud in kernel lengths, if that matters.
    """
    x = cloud(distribution, points, _SEED)
    extent = float(np.max(np.ptp(x, axis=0)))
    x *= kernel.length * (edge or 1.0) / extent
    rng = np.random.default_rng(_SEED + 1)
    shape = (points, kernel.n_in)
    weights = np.stack((rng.normal(size=shape), rng.random(shape)), axis=2)
    values = TreeSum(kernel, x, None, scheme, Parallel.alone()).apply(weights)
    chosen = np.sort(rng.permutation(points)[:_TARGETS])
    exact = direct_sum(kernel, x, x[chosen], weights)
    size = np.linalg.norm(exact, axis=(0, 1))
    difference = np.linalg.norm(values[chosen] - exact, axis=(0, 1))
    return float(np.max(np.divide(difference, size, out=np.zeros(2), where=size > 0.0)))


def sample_scheme(method: str, nodes: int, derivative: str, single: bool) -> Scheme:
    """The scheme of a sample: three levels at least, operators of low rank beyond the grid."""
    return Scheme(
        method=method,
        nodes=nodes,
        splitting=Splitting(leaf_size=12),
        single=single,
        derivative=derivative,
        operator_eps=operator_eps(nodes),
    )


def operator_eps(nodes: int) -> float:
    """Error of low-rank operators well below that of interpolation by as many nodes."""
    return max(0.1 * 0.25**nodes, 1e-14)
