"""Other people's solvers of the same contact problems, called as their makers meant them.

Clarabel (interior point for convex cones) solves the cone complementarity problem, `law: ccp`;
Siconos solves Coulomb's law, `law: coulomb`, of FCLIB's statement. Both are serial and take
matrices: D (freedoms, c m) and M^-1, or W = N (c m, c m); b (m, c) [m/s], mu (m,).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

# "AlmostSolved": the tolerance asked for is below what its arithmetic reaches; the residuals say
# how far it came.
_CLARABEL_END = ("Solved", "AlmostSolved")
_BODY = 6


@dataclass(frozen=True)
class Solved:
    """What a solver returned.

    impulse  : (m, c) [N s]
    velocity : (m, c) [m/s], N impulse + b by a fresh product
    seconds  : of the solver's own call; `prepared` those of bringing the problem into its form
    error    : as the solver reports it, by its own definition
    """

    impulse: NDArray
    velocity: NDArray
    iterations: int
    seconds: float
    prepared: float
    error: float
    status: str
    converged: bool


# ---- Clarabel: the convex problem ----------------------------------------------------------


def clarabel_solve(
    D: sparse.spmatrix,
    inverse_mass: sparse.spmatrix,
    b: NDArray,
    mu: NDArray,
    tolerance: float = 1e-12,
) -> Solved:
    """Solve min |y|^2 / 2 over y with g = D^T L y + b in C*, M^-1 = L L^T; v - v_hat = L y.

    The dual of the problem in the impulses, which are the multipliers of the cones. Lengths of y
    are weighed by the masses, so that light and heavy bodies are alike; b is scaled to 1.
    `tolerance` holds for Clarabel's residuals and duality gap in these units.
    """
    started = perf_counter()
    columns = b.shape[1]
    scale = float(np.abs(b).max(initial=0.0)) or 1.0
    A = (D.T @ factor_of_blocks(inverse_mass)).tocsr()
    # s = (g_n, mu g_t) is in the second-order cone; rows of g_t of mu = 0 are free.
    weights, rows, sizes = _cone_rows(mu, columns, dual=True)
    # Masses of the order 1 too: a multiplier of 1 then changes g by 1.
    mass = float(np.median(np.asarray(A.multiply(A).sum(axis=1)).ravel()[::columns]) ** -0.5)
    P = sparse.identity(A.shape[1], format="csc")
    constraint = -(sparse.diags(weights) @ A)[rows] * mass
    bound = (weights * b.ravel() / scale)[rows]
    prepared = perf_counter() - started
    solution, seconds = _clarabel(P, np.zeros(A.shape[1]), constraint, bound, sizes, tolerance)
    multiplier = np.zeros(b.size)
    multiplier[rows] = solution.z
    impulse = (weights * multiplier).reshape(b.shape) * (scale * mass**2)
    velocity = (A @ (A.T @ impulse.ravel())).reshape(b.shape) + b
    return _of_clarabel(solution, impulse, velocity, seconds, prepared)


def clarabel_solve_matrix(
    N: sparse.spmatrix, b: NDArray, mu: NDArray, tolerance: float = 1e-12
) -> Solved:
    """Solve min gamma.N gamma / 2 + b.gamma over C where N, symmetric, has no known factors."""
    started = perf_counter()
    scale = float(np.abs(b).max(initial=0.0)) or 1.0
    unit = 1.0 / float(np.median(N.diagonal()))
    # s = (mu gamma_n, gamma_t) is in the second-order cone; where mu = 0, gamma_t is no unknown.
    weights, rows, sizes = _cone_rows(mu, b.shape[1], dual=False)
    P = sparse.triu(sparse.csc_matrix(N)[rows][:, rows] * unit, format="csc")
    constraint = -sparse.diags(weights[rows], format="csc")
    prepared = perf_counter() - started
    bound = np.zeros(len(rows))
    solution, seconds = _clarabel(P, b.ravel()[rows] / scale, constraint, bound, sizes, tolerance)
    impulse = np.zeros(b.size)
    impulse[rows] = np.array(solution.x) * (scale * unit)
    velocity = (N @ impulse).reshape(b.shape) + b
    return _of_clarabel(solution, impulse.reshape(b.shape), velocity, seconds, prepared)


def smallest_dual(
    D: sparse.spmatrix, inverse_mass: sparse.spmatrix, b: NDArray, mu: NDArray
) -> float:
    """Return the smallest t [m/s] with D^T v + b + t n in C* for some v: no impulse has less.

    Positive where the problem has no solution: a self-stress, gamma in C with D gamma = 0, that
    overlaps make cheap, b.gamma < 0. r_d = max(0, mu |g_t| - g_n) of any impulse is at least t.
    """
    columns = b.shape[1]
    scale = float(np.abs(b).max(initial=0.0)) or 1.0
    A = (D.T @ factor_of_blocks(inverse_mass)).tocsr()
    A = A / float(np.median(np.asarray(A.multiply(A).sum(axis=1)).ravel()[::columns]) ** 0.5)
    weights, rows, sizes = _cone_rows(mu, columns, dual=True)
    normal = np.zeros(b.shape)
    normal[:, 0] = 1.0
    opening = sparse.csr_matrix(-normal.ravel()[rows][:, None])
    constraint = sparse.hstack([-(sparse.diags(weights) @ A)[rows], opening])
    positive = sparse.csr_matrix(([-1.0], ([0], [A.shape[1]])), shape=(1, A.shape[1] + 1))
    q = np.zeros(A.shape[1] + 1)
    q[-1] = 1.0
    bound = np.append((weights * b.ravel() / scale)[rows], 0.0)
    solution, _ = _clarabel(
        sparse.csc_matrix((len(q), len(q))),
        q,
        sparse.vstack([constraint, positive]),
        bound,
        [*sizes, 1],
        1e-10,
    )
    if str(solution.status) not in _CLARABEL_END:
        raise ArithmeticError(f"Clarabel: {solution.status}")
    return max(0.0, float(solution.x[-1])) * scale


def factor_of_blocks(inverse_mass: sparse.spmatrix) -> sparse.csr_matrix:
    """Return L with M^-1 = L L^T, for a diagonal M^-1 or one of blocks of 6."""
    matrix = sparse.csr_matrix(inverse_mass)
    if sparse.triu(matrix, 1).nnz == 0:
        return sparse.diags(np.sqrt(matrix.diagonal()), format="csr")
    entries = matrix.tocoo()
    body, row = np.divmod(entries.row, _BODY)
    if (body != entries.col // _BODY).any():
        raise ValueError("M^-1 couples several bodies")
    blocks = np.zeros((matrix.shape[0] // _BODY, _BODY, _BODY))
    blocks[body, row, entries.col % _BODY] = entries.data
    return sparse.block_diag(np.linalg.cholesky(blocks), format="csr")


def _cone_rows(mu: NDArray, columns: int, dual: bool) -> tuple[NDArray, NDArray, list[int]]:
    """Weights (c m,) that turn each cone into a second-order cone, rows that take part, sizes.

    dual: (g_n, mu g_t), otherwise (mu gamma_n, gamma_t). A contact without friction has one row,
    not negative.
    """
    weights = np.ones((len(mu), columns))
    rubbing = mu > 0.0
    if dual:
        weights[:, 1:] = mu[:, None]
    else:
        weights[rubbing, 0] = mu[rubbing]
    taking_part = np.ones((len(mu), columns), dtype=bool)
    taking_part[~rubbing, 1:] = False
    return weights.ravel(), np.flatnonzero(taking_part), taking_part.sum(axis=1).tolist()


def _cones(sizes: Iterable[int]) -> list[Any]:
    import clarabel

    kinds = {1: clarabel.NonnegativeConeT, 3: clarabel.SecondOrderConeT}
    return [kinds[size](size) for size in sizes]


def _clarabel(
    P: sparse.csc_matrix,
    q: NDArray,
    A: sparse.spmatrix,
    bound: NDArray,
    sizes: list[int],
    tolerance: float,
) -> tuple[Any, float]:
    """min x.P x / 2 + q.x subject to A x + s = bound, s in the cones: solution, seconds."""
    import clarabel

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = 200
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        setattr(settings, name, tolerance)
    settings.tol_ktratio = min(settings.tol_ktratio, tolerance)
    # At its default of 1e-8 Clarabel stops at 1e-6 v_ref on hyperstatic packings, whose impulses
    # are not unique; below 1e-10 it fails on some.
    settings.static_regularization_constant = 1e-10
    settings.iterative_refinement_reltol = settings.iterative_refinement_abstol = 1e-15
    settings.iterative_refinement_max_iter = 20
    A = sparse.csc_matrix(A)
    solver = clarabel.DefaultSolver(P, q, A, bound, _cones(sizes), settings)
    started = perf_counter()
    solution = solver.solve()
    return solution, perf_counter() - started


def _of_clarabel(
    solution: Any, impulse: NDArray, velocity: NDArray, seconds: float, prepared: float
) -> Solved:
    status = str(solution.status)
    error = max(solution.r_prim, solution.r_dual)
    iterations = int(solution.iterations)
    converged = status in _CLARABEL_END
    return Solved(impulse, velocity, iterations, seconds, prepared, error, status, converged)


# ---- Siconos: Coulomb's law ----------------------------------------------------------------


def siconos_nsgs(
    W: sparse.spmatrix | NDArray,
    q: NDArray,
    mu: NDArray,
    tolerance: float,
    guess: NDArray | None = None,
    max_iterations: int = 100_000,
) -> Solved:
    """Solve u = W r + q with r in C, u + mu |u_t| n in C* by nonsmooth Gauss-Seidel.

    Rows are visited one contact at a time, W by blocks of 3, the local solver is Siconos's
    default. Its error is that of its natural map, relative to |q|. The Debian package
    python3-siconos; ImportError where it is absent.
    """
    import siconos.numerics as numerics

    started = perf_counter()
    blocks = numerics.SBM_from_csparse(3, _long_indices(W))[1]
    q_flat, friction = q.ravel().copy(), np.ascontiguousarray(mu, dtype=np.float64)
    problem = numerics.FrictionContactProblem(3, blocks, q_flat, friction)
    options = numerics.SolverOptions(numerics.SICONOS_FRICTION_3D_NSGS)
    options.dparam[numerics.SICONOS_DPARAM_TOL] = tolerance
    options.iparam[numerics.SICONOS_IPARAM_MAX_ITER] = max_iterations
    impulse = np.zeros(q.size) if guess is None else guess.ravel().copy()
    velocity = np.zeros(q.size)
    prepared = perf_counter() - started
    started = perf_counter()
    code = numerics.fc3d_nsgs(problem, impulse, velocity, options)
    seconds = perf_counter() - started
    impulse = impulse.reshape(q.shape)
    return Solved(
        impulse=impulse,
        velocity=(W @ impulse.ravel()).reshape(q.shape) + q,
        iterations=int(options.iparam[numerics.SICONOS_IPARAM_ITER_DONE]),
        seconds=seconds,
        prepared=prepared,
        error=float(options.dparam[numerics.SICONOS_DPARAM_RESIDU]),
        status=f"code {code}",
        converged=code == 0,
    )


def _long_indices(matrix: sparse.spmatrix | NDArray) -> sparse.csc_matrix:
    """Return a copy by columns with the 64-bit indices of Siconos."""
    A = sparse.csc_matrix(matrix)
    A.sort_indices()
    A.indices, A.indptr = A.indices.astype(np.int64), A.indptr.astype(np.int64)
    return A
