"""Newton's method on the natural map: its pairs, its slopes, and where it ends."""

from __future__ import annotations

import numpy as np
import pytest
from dense_newton import DenseNewton

from dem_mpi import _kernels_scip as kernels
from dem_mpi.cone import ConeProblem, Tolerance
from dem_mpi.parallel import Parallel
from dem_mpi.solvers.scip import Scip, ScipOptions
from dem_mpi.solvers.semismooth import NaturalMap

from contact_twins import DenseDelassus


def pairs(z: np.ndarray, mu: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    p, y = np.empty_like(z), np.empty_like(z)
    kernels.decompose.serial(z, np.zeros_like(z), mu, unit, p, y)
    return p, y


def points(m: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.normal(size=(m, 3)), rng.choice([0.0, 1e-3, 0.4, 2.0], m), rng.uniform(0.1, 10.0, m)


def test_pairs_lie_in_the_cones_and_do_no_work():
    z, mu, unit = points()
    p, y = pairs(z, mu, unit)
    size = np.linalg.norm(z, axis=1)
    slip, turn = np.linalg.norm(y[:, 1:], axis=1), np.linalg.norm(p[:, 1:], axis=1)
    assert np.all(turn - mu * p[:, 0] <= 1e-15 * size)
    assert np.all(mu * slip - y[:, 0] <= 1e-14 * unit * size)
    assert np.all(np.abs((p * y).sum(axis=1)) <= 1e-14 * unit * size**2)
    rest = p - y / unit[:, None] - z
    assert np.abs(np.where(mu[:, None] > 0.0, rest, rest * [1, 0, 0])).max() <= 1e-14


def test_slopes_are_the_derivative_of_the_pairs():
    """dy = -R dp for a small change of z, up to the bounds of R and the square of the change."""
    z, mu, unit = points()
    p, y = pairs(z, mu, unit)
    change = 1e-7 * np.random.default_rng(4).normal(size=z.shape)
    p2, y2 = pairs(z + change, mu, unit)
    Q, R, root = (np.empty((len(z), 3, 3)) for _ in range(3))
    low, high = 1e-9, 1e9
    kernels.slopes.serial(p, y, mu, unit, low, high, Q, R, root)
    # Q dy + dp = 0 where R is large, R dp + dy = 0 where it is small: both, weighed by (1 + R)^-1.
    d = unit[:, None, None] * np.eye(3)
    dp, dy = p2 - p, y2 - y
    rest = np.linalg.solve(d + R, (np.einsum("iab,ib->ia", R, dp) + dy)[..., None])[..., 0]
    stays = (np.abs(y).sum(axis=1) > 0) == (np.abs(y2).sum(axis=1) > 0)
    stays &= (np.abs(p).sum(axis=1) > 0) == (np.abs(p2).sum(axis=1) > 0)
    stays &= mu != 1e-3  # its cone is so thin that 1e-7 is not small
    assert stays.sum() > 200
    assert np.abs(rest[stays]).max() <= 1e-11
    assert np.allclose(np.einsum("iab,icb->iac", root, root), Q, rtol=1e-12, atol=1e-12 * Q.max())


@pytest.mark.parametrize("columns", [1, 3])
def test_softened_blocks_are_inverse_and_bounded(columns):
    rng = np.random.default_rng(5)
    root = rng.normal(size=(50, columns, columns)) * 10.0 ** rng.uniform(-3, 3, (50, 1, 1))
    Q = np.einsum("iab,icb->iac", root, root)
    R = np.linalg.inv(Q)
    soft = np.full(50, 1e-3)
    softer = R + 1e-3 * np.eye(columns)
    kernels.soften.serial(soft, np.ones(50), Q, R, root)
    assert np.array_equal(R, softer)
    assert np.linalg.eigvalsh(Q).max() <= 1e3 * (1 + 1e-12)
    assert np.allclose(Q, np.linalg.inv(softer), rtol=1e-6, atol=1e-9 * np.abs(Q).max())


def test_velocities_are_right_to_round_off_not_to_the_root_of_the_work():
    rng = np.random.default_rng(6)
    D = rng.normal(size=(120, 180))
    b = (D.T @ rng.normal(size=120)).reshape(60, 3)
    v_ref = float(np.linalg.norm(b, axis=1).max())
    operator = DenseDelassus(D.T @ D, 3)
    mass = 1.0 / float(np.median(operator.diagonal()))
    problem = ConeProblem(operator, b, np.full(60, 0.3), v_ref, v_ref * mass, Parallel.alone())
    solver = Scip(ScipOptions(Tolerance(1e-13, "scaled", 1e-14)), DenseNewton)
    report = solver.solve(problem, np.zeros_like(problem.b))
    assert report.converged
    newton = NaturalMap(problem, report.impulse)
    g = np.empty_like(problem.b)
    problem.operator.apply(newton.impulse, g)
    assert newton.mismatch(g + problem.b) <= 1e-12
