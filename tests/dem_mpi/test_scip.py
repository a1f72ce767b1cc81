"""The interior point method against closed forms, APGD, its own identities and other ranks."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from dense_newton import DenseNewton

from dem_mpi import _kernels_scip as kernels
from dem_mpi.cone import ConeProblem, Tolerance, median_of_positive
from dem_mpi.newton import NewtonFailureError, NewtonOptions, NewtonSystem
from dem_mpi.operators import MatrixFree
from dem_mpi.parallel import Parallel
from dem_mpi.solvers.apgd import Apgd, ApgdOptions
from dem_mpi.solvers.result import SolveReport
from dem_mpi.solvers.scip import Scip, ScipOptions

from contact_twins import DenseDelassus, cloud, detect, detection, gathered

ranks_1_2_3 = pytest.mark.mpi(ranks=[1, 2, 3])
STEP = 1e-3
EPS = np.finfo(float).eps
J = np.diag([1.0, -1.0, -1.0])

# ---- problems ------------------------------------------------------------------------------


def tight(value: float = 1e-10) -> Tolerance:
    return Tolerance(value, "scaled", value)


def dense_problem(N: np.ndarray, b: np.ndarray, mu: np.ndarray) -> ConeProblem:
    """A problem on one rank with v_ref = the largest |b|."""
    v_ref = float(np.max(np.linalg.norm(b, axis=1), initial=0.0))
    operator = DenseDelassus(N, b.shape[1])
    diag = float(np.median(operator.diagonal())) if len(b) else 1.0
    return ConeProblem(operator, b, mu, v_ref, v_ref / diag, Parallel.alone())


def random_problem(m: int, freedoms: int, seed: int, mu: np.ndarray | float = 0.3) -> ConeProblem:
    """N = D^T M^-1 D of rank at most `freedoms`; b = D^T v, so the problem is bounded below."""
    rng = np.random.default_rng(seed)
    D = rng.normal(size=(freedoms, 3 * m))
    mass = rng.uniform(0.5, 2.0, freedoms)
    b = (D.T @ rng.normal(size=freedoms)).reshape(m, 3)
    return dense_problem(D.T @ (D / mass[:, None]), b, np.broadcast_to(mu, m).astype(float))


def heap(
    parallel: Parallel, count: int = 150, mu: float | None = None, frictional: bool = True
) -> ConeProblem:
    """Collective. Spheres thrown together: b = D^T v + (max(phi/h, -v_rec), 0, 0).

    mu None keeps the table's friction, zeros included. Nothing confines the heap, so there is a
    solution: an expansion parts every pair along its normal.
    """
    rng = np.random.default_rng(31)
    radius = 0.16 * 3.0 ** -rng.random(count)
    velocity = rng.normal(size=(count, 3)) * 0.2 - [0.0, 0.0, 0.5]
    spin = rng.normal(size=(count, 3))
    bodies = cloud(rng.random((count, 3)), radius, velocity, spin)
    found = detect(parallel, bodies, detection(), STEP, None)
    c, n, owned = found.contacts, found.neighbours, found.bodies
    operator = MatrixFree(c, n.inverse_mass, n.inverse_inertia, n.halo, frictional)
    motion = np.hstack((owned.velocity, owned.angular_velocity))
    b = np.empty((c.count, operator.columns))
    operator.contact_velocity(n.extend(motion if frictional else owned.velocity), b)
    v_ref = parallel.max(float(np.max(np.linalg.norm(b, axis=1), initial=0.0)))
    b[:, 0] += np.maximum(c.gap / STEP, -0.2)
    friction = c.friction if mu is None else np.full(c.count, mu)
    scale = v_ref / median_of_positive(operator.diagonal(), parallel)
    return ConeProblem(operator, b, friction, v_ref, scale, parallel)


def solve(
    problem: ConeProblem,
    guess: np.ndarray | None = None,
    system=DenseNewton,
    **options,
) -> SolveReport:
    solver = Scip(ScipOptions(**{"tolerance": tight()} | options), system)
    report = solver.solve(problem, np.zeros_like(problem.b) if guess is None else guess)
    solver.destroy()
    return report


def in_cone(gamma: np.ndarray, mu: np.ndarray) -> bool:
    """Up to the rounding of a row's own length."""
    excess = np.linalg.norm(gamma[:, 1:], axis=1) - mu * gamma[:, 0]
    return bool(
        np.all(excess <= 4 * EPS * np.linalg.norm(gamma, axis=1)) and np.all(gamma[:, 0] >= 0.0)
    )


# ---- algebra of the cone -------------------------------------------------------------------


def points(count: int, edge: float, seed: int) -> np.ndarray:
    """Points of the cone with (x_n - |x_t|)/x_n = edge, of sizes from 1e-3 to 1e3."""
    rng = np.random.default_rng(seed)
    angle, size = rng.uniform(0.0, 2.0 * np.pi, count), 10.0 ** rng.uniform(-3, 3, count)
    t = size * (1.0 - edge)
    return np.stack([size, t * np.cos(angle), t * np.sin(angle)], axis=1)


def scaled(x: np.ndarray, y: np.ndarray, mu: np.ndarray | None = None):
    """(eta, w, lambda, Q, R, root) of the kernels for points x, y (m, c)."""
    m, c = x.shape
    mu = np.ones(m) if mu is None else mu
    eta, w, lam = np.empty(m), np.empty((m, c)), np.empty((m, c))
    kernels.scaling.serial(x, y, mu, np.zeros((m, c)), eta, w, lam, np.zeros((9, 3)))
    Q, R, root = (np.zeros((m, c, c)) for _ in range(3))
    kernels.blocks.serial(eta, w, mu, Q, R, root)
    return eta, w, lam, Q, R, root


def times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("iab,ib->ia", A, x)


def product(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """x o y."""
    return np.column_stack(((x * y).sum(axis=1), x[:, :1] * y[:, 1:] + y[:, :1] * x[:, 1:]))


def size(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x, axis=1)


@pytest.mark.parametrize(("edge_x", "edge_y"), [(1.0, 1.0), (0.3, 1e-6), (1e-8, 1e-8), (1e-9, 0.5)])
def test_scaling_takes_impulse_to_velocity_and_both_to_one_point(edge_x, edge_y):
    """P x = y, W x = W^-1 y = lambda. A point at `edge` carries its det to eps/edge."""
    x, y = points(500, edge_x, 1), points(500, edge_y, 2)
    _, _, lam, Q, R, root = scaled(x, y)
    digits = 20 * EPS * (1.0 / edge_x + 1.0 / edge_y)
    largest = np.linalg.norm(R, axis=(1, 2)) * size(x)
    assert np.all(size(times(R, x) - y) <= digits * largest)
    assert np.all(size(times(Q, y) - x) <= digits * np.linalg.norm(Q, axis=(1, 2)) * size(y))
    W_inverse = root
    assert np.all(
        size(times(W_inverse, y) - lam) <= digits * np.linalg.norm(W_inverse, axis=(1, 2)) * size(y)
    )
    assert np.allclose((lam * lam).sum(axis=1), (x * y).sum(axis=1), rtol=digits, atol=0.0)


@pytest.mark.parametrize("edge", [1.0, 1e-2, 1e-5])
def test_blocks_are_inverse_and_the_square_of_their_root(edge):
    x, y = points(500, edge, 3), points(500, edge, 4)
    mu = 10.0 ** np.random.default_rng(5).uniform(-3, 0.3, 500)
    *_, Q, R, root = scaled(x, y, mu)
    size_of = np.linalg.norm(Q, axis=(1, 2)) * np.linalg.norm(R, axis=(1, 2))
    error = np.abs(Q @ R - np.eye(3)).max(axis=(1, 2))
    assert np.all(error <= 20 * EPS * size_of)
    assert np.allclose(root @ root.transpose(0, 2, 1), Q, rtol=0.0, atol=20 * EPS * np.abs(Q).max())


def test_root_keeps_what_its_square_loses():
    """The smallest eigenvalue of P^-1 is 1e-8 of x/y, the largest 1e8: its square has no digit."""
    x, y = points(200, 1e-8, 6), points(200, 1e-8, 7)
    _, w, _, _, _, root = scaled(x, y)
    across = w.copy()  # eigenvector of W^-1 for the smallest eigenvalue, up to 1e-8
    once = np.einsum("iba,ib->ia", root, across)
    expected = times(np.linalg.inv(root @ np.eye(3)), once)
    assert np.all(size(expected - across) <= 1e-6 * size(across))


def test_smooth_contacts_are_those_of_one_column_bit_by_bit():
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0.1, 10.0, (100, 1)), 10.0 ** rng.uniform(-9, 3, (100, 1))
    tangents = np.zeros((100, 2))
    one = scaled(x, y)
    three = scaled(np.hstack((x, tangents)), np.hstack((y, tangents)), np.zeros(100))
    assert np.array_equal(one[2][:, 0], three[2][:, 0])
    assert np.array_equal(one[3][:, 0, 0], three[3][:, 0, 0])
    assert np.array_equal(one[4][:, 0, 0], three[4][:, 0, 0])
    for block in three[3:]:
        assert not block[:, 1:, :].any()
        assert not block[:, :, 1:].any()
    assert np.allclose(one[4][:, 0, 0], (y / x)[:, 0], rtol=10 * EPS, atol=0.0)


@pytest.mark.parametrize("columns", [1, 3])
def test_start_is_central_and_keeps_the_difference_of_its_guess(columns):
    """x o y = target e and x - y/k = T gamma - T^-1 g/k, for guesses far inside and far outside."""
    rng = np.random.default_rng(9)
    m = 400
    gamma = rng.normal(size=(m, columns)) * 10.0 ** rng.uniform(-6, 6, (m, 1))
    g = rng.normal(size=(m, columns)) * 10.0 ** rng.uniform(-6, 6, (m, 1))
    mu, k = 10.0 ** rng.uniform(-2, 0.5, m), 10.0 ** rng.uniform(-2, 2, m)
    T = np.ones((m, columns))
    T[:, 1:] = 1.0 / mu[:, None]
    x, y = np.empty_like(g), np.empty_like(g)
    kernels.centred_start.serial(gamma, g, mu, k, 0.7, x, y)
    z = T * gamma - g / T / k[:, None]
    assert np.all(
        np.abs(x - y / k[:, None] - z) <= 1e-14 * (np.abs(x) + np.abs(z)).max(axis=1)[:, None]
    )
    # Products cancel where x and y are at opposite edges.
    found = product(x, y) - 0.7 * np.eye(3)[0, :columns]
    assert np.all(size(found) <= 1e-15 * 20 * np.maximum(size(x) * size(y), 0.7))
    for v in (x, y):
        assert np.all(v[:, 0] >= size(v[:, 1:]))


@pytest.mark.parametrize("edge", [1.0, 0.1, 1e-3])
def test_longest_step_ends_on_the_boundary_of_the_cone(edge):
    """At the step det is zero to the digits of its terms, at no smaller one."""
    lam, rng = points(400, edge, 10), np.random.default_rng(11)
    u = rng.normal(size=lam.shape) * lam[:, :1]
    limited = 0
    for a, d in zip(lam, u, strict=True):
        blocking = kernels._blocking(*a, kernels._determinant(*a), *d)
        steps = np.linspace(0.0, 1.0, 50) * (1.0 / blocking if blocking > 0.0 else 1e3)
        inside = a + steps[:-1, None] * d
        assert np.all(inside[:, 0] - size(inside[:, 1:]) >= -1e-13 * size(inside))
        if blocking > 0.0:
            end = a + d / blocking
            assert abs(end[0] - np.hypot(*end[1:])) <= 20 * EPS / edge * np.linalg.norm(end)
            limited += 1
    assert 0.2 * len(lam) < limited


def test_direction_along_the_cone_has_no_limit():
    assert kernels._blocking(1.0, 0.0, 0.0, 1.0, 2.0, 1.0, 1.0) <= 0.0
    assert kernels._blocking(1.0, 0.0, 0.0, 1.0, -0.5, 0.0, 0.0) == 0.5


def test_quotient_undoes_the_product():
    lam, a = points(300, 0.05, 12), np.random.default_rng(13).normal(size=(300, 3))
    z = np.array(
        [kernels._quotient(*x, kernels._determinant(*x), *r) for x, r in zip(lam, a, strict=True)]
    )
    assert np.allclose(product(lam, z), a, rtol=0.0, atol=1e-13)


def test_centrality_corrector_moves_outlying_products_into_the_band():
    """lambda o (what is added to c) is what the product at the trial step lacks."""
    rng = np.random.default_rng(14)
    lam = points(300, 0.3, 15) / 30.0
    u, v = 0.3 * rng.normal(size=lam.shape), 0.3 * rng.normal(size=lam.shape)
    c, step, low, high = np.zeros_like(lam), 0.7, 0.01, 1.0
    kernels.centrality.serial(lam, u, v, step, low, high, c)
    before = product(lam + step * u, lam + step * v)
    after = before + product(lam, c)
    least = after[:, 0] - size(after[:, 1:])
    most = after[:, 0] + size(after[:, 1:])
    moderate = before[:, 0] + size(before[:, 1:]) <= 2.0 * high
    assert np.all(least >= low * (1.0 - 1e-9))
    assert np.all(most[moderate] <= high * (1.0 + 1e-9))
    assert np.any(~moderate)
    central = (before[:, 0] - size(before[:, 1:]) >= low) & (
        before[:, 0] + size(before[:, 1:]) <= high
    )
    assert np.any(central)
    assert not c[central].any()


# ---- one contact, closed form --------------------------------------------------------------

N_NORMAL, N_TANGENT = 2.0, 7.0  # a solid sphere on a wall: 1/m and 7/(2 m)


def one_contact(b: list[float], mu: float) -> SolveReport:
    N = np.diag([N_NORMAL, N_TANGENT, N_TANGENT])
    return solve(dense_problem(N, np.array([b]), np.array([mu])), tolerance=tight(1e-12))


def test_sticking_contact_takes_both_velocities_away():
    report = one_contact([-1.0, 0.6, -0.8], mu=0.5)
    expected = [1.0 / N_NORMAL, -0.6 / N_TANGENT, 0.8 / N_TANGENT]
    assert np.hypot(*expected[1:]) < 0.5 * expected[0]
    assert np.allclose(report.impulse[0], expected, rtol=0.0, atol=1e-10)
    assert np.allclose(report.velocity, 0.0, atol=1e-10)
    assert report.converged
    assert report.reason == "converged"


@pytest.mark.parametrize("mu", [1e-6, 1e-3, 0.3, 2.0, 100.0])
def test_sliding_contact_stays_on_its_cone_and_lifts_by_mu_times_its_slip(mu):
    """gamma_n = (mu |b_t| - b_n)/(N_n + mu^2 N_t), against b_t, where that slides."""
    slip = 5.0 * max(1.0, mu)
    gamma_n = (1.0 + mu * slip) / (N_NORMAL + mu * mu * N_TANGENT)
    assert mu * gamma_n * N_TANGENT < slip
    report = one_contact([-1.0, 0.6 * slip, 0.8 * slip], mu)
    expected = gamma_n * np.array([1.0, -0.6 * mu, -0.8 * mu])
    assert np.allclose(report.impulse[0], expected, rtol=1e-6, atol=1e-12 * gamma_n)
    assert report.velocity[0, 0] == pytest.approx(mu * size(report.velocity[:, 1:])[0], rel=1e-6)
    assert report.iterations <= 20


def test_smooth_contact_has_a_normal_impulse_alone():
    report = one_contact([-1.0, 3.0, 4.0], mu=0.0)
    assert report.impulse[0, 0] == pytest.approx(1.0 / N_NORMAL, rel=1e-11)
    assert not report.impulse[0, 1:].any()
    assert np.array_equal(report.velocity[0, 1:], [3.0, 4.0])


def test_separating_contact_needs_no_iteration():
    report = one_contact([1.0, 0.3, 0.4], mu=0.5)
    assert report.converged
    assert report.iterations == report.factorisations == 0
    assert not report.impulse.any()


def test_contact_on_the_edge_of_opening_is_solved():
    """b_n = mu |b_t|: impulse and velocity margin are both zero, without strict complementarity."""
    report = one_contact([0.0, 1.0, 0.0], mu=0.3)
    assert report.converged
    grazing = one_contact([0.3, 1.0, 0.0], mu=0.3)
    assert grazing.converged
    assert np.all(np.abs(grazing.impulse) <= 1e-6)


# ---- many contacts -------------------------------------------------------------------------


def twin(problem: ConeProblem) -> SolveReport:
    """APGD to the last digits."""
    options = ApgdOptions(Tolerance(1e-12, "scaled", 1e-12), max_iterations=200_000)
    return Apgd(options).solve(problem, np.zeros_like(problem.b))


def mixed(m: int, seed: int) -> np.ndarray:
    """Friction over six orders of magnitude, and a third of the contacts smooth."""
    rng = np.random.default_rng(seed)
    return np.where(rng.random(m) < 1.0 / 3.0, 0.0, 10.0 ** rng.uniform(-6.0, 0.3, m))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("kind", ["regular", "singular", "mixed"])
def test_velocities_equal_those_of_gradients(kind, seed):
    """N gamma is unique: |v - v'|^2 in the kinetic norm is at most the sum of what both leave of

    complementarity in 40 contacts. At 1e-12 v_ref gamma_ref each that is 1e-5 v_ref; it is less.
    """
    mu = mixed(40, seed) if kind == "mixed" else 0.3
    problem = random_problem(40, 130 if kind == "regular" else 60, seed, mu)
    report, other = solve(problem, tolerance=tight(1e-12)), twin(problem)
    assert report.converged
    assert report.iterations <= 20
    assert in_cone(report.impulse, problem.mu)
    assert report.residuals.primal <= 4 * EPS * np.abs(report.impulse).max()
    assert np.abs(report.velocity - other.velocity).max() <= 1e-6 * problem.velocity_scale
    assert report.residuals.objective == pytest.approx(other.residuals.objective, rel=1e-9)


@pytest.mark.parametrize("seed", [3, 4])
def test_singular_problem_has_one_velocity_though_many_impulses(seed):
    problem = random_problem(60, 30, seed)
    first = solve(problem, tolerance=tight(1e-11))
    guess = 0.1 * np.abs(np.random.default_rng(seed).normal(size=problem.b.shape))
    second = solve(problem, guess, tolerance=tight(1e-11))
    assert first.converged and second.converged
    assert np.abs(first.impulse - second.impulse).max() > 1e-3 * np.abs(first.impulse).max()
    assert np.abs(first.velocity - second.velocity).max() <= 1e-6 * problem.velocity_scale


def test_smooth_problem_is_the_one_without_tangents():
    rough = random_problem(30, 70, 5, 0.0)
    normal = DenseDelassus(rough.operator.matrix[::3, ::3], 1)
    smooth = dataclasses.replace(rough, operator=normal, b=rough.b[:, :1].copy())
    one, three = solve(smooth), solve(rough)
    assert one.converged and three.converged
    assert one.iterations == three.iterations
    assert not three.impulse[:, 1:].any()
    assert np.allclose(one.impulse, three.impulse[:, :1], rtol=0.0, atol=1e-12)


def test_heavy_and_light_bodies_in_one_problem():
    """A column of spheres: a million times heavier at the top than at the bottom.

    Every contact carries the weight above, most of it that of the highest sphere.
    """
    count, weight = 12, 9.81e-3
    mass = 10.0 ** np.linspace(0.0, 6.0, count)
    D = np.zeros((count, 3 * count))
    for i in range(count):
        D[i, 3 * i] = 1.0
        if i:
            D[i - 1, 3 * i] = -1.0
    N = D.T @ (D / mass[:, None])
    N[np.arange(1, 3 * count, 3), np.arange(1, 3 * count, 3)] = 1.0
    N[np.arange(2, 3 * count, 3), np.arange(2, 3 * count, 3)] = 1.0
    b = np.zeros((count, 3))
    b[0, 0] = -weight
    problem = dense_problem(N, b, np.full(count, 0.5))
    # The impulses, of 1e4 N s, leave rounding of 3e-12 m/s in g: 4e-4 v_ref gamma_ref.
    report = solve(problem, tolerance=Tolerance(1e-8, "scaled", 1e-2))
    carried = np.cumsum(mass[::-1])[::-1] * weight
    assert report.converged
    assert report.iterations <= 30
    assert np.allclose(report.impulse[:, 0], carried, rtol=1e-6)


def turned(problem: ConeProblem, seed: int) -> tuple[ConeProblem, np.ndarray]:
    """The problem with every pair of tangents turned by an angle of its own, and the turns."""
    m = problem.contacts
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, m)
    turn = np.zeros((3 * m, 3 * m))
    for i, a in enumerate(angle):
        turn[3 * i, 3 * i] = 1.0
        turn[3 * i + 1 : 3 * i + 3, 3 * i + 1 : 3 * i + 3] = [
            [np.cos(a), -np.sin(a)],
            [np.sin(a), np.cos(a)],
        ]
    operator = DenseDelassus(turn @ problem.operator.matrix @ turn.T, 3)
    b = (turn @ problem.b.ravel()).reshape(m, 3)
    return dataclasses.replace(problem, operator=operator, b=b), turn


def test_frames_of_contacts_do_not_matter():
    problem = random_problem(30, 60, 6, mixed(30, 6))
    other, turn = turned(problem, 7)
    here, there = solve(problem), solve(other)
    assert here.iterations == there.iterations
    expected = (turn @ here.velocity.ravel()).reshape(-1, 3)
    assert np.allclose(there.velocity, expected, rtol=0.0, atol=1e-7 * problem.velocity_scale)


@pytest.mark.parametrize(("mass", "speed"), [(1e9, 1.0), (1.0, 1e-7), (3e-12, 5e6)])
def test_units_do_not_matter(mass, speed):
    problem = random_problem(30, 60, 8, mixed(30, 8))
    other = dataclasses.replace(
        problem,
        operator=DenseDelassus(problem.operator.matrix / mass, 3),
        b=problem.b * speed,
        velocity_scale=problem.velocity_scale * speed,
        impulse_scale=problem.impulse_scale * speed * mass,
    )
    here, there = solve(problem), solve(other)
    assert here.iterations == there.iterations
    assert np.allclose(
        there.velocity / speed, here.velocity, rtol=0.0, atol=1e-7 * problem.velocity_scale
    )


def test_tolerances_far_below_the_scale_of_velocities_are_met():
    """Bodies that fly apart at 1e4 m/s set v_ref; the others still come to 1e-8 m/s."""
    problem = random_problem(30, 100, 9)
    problem = dataclasses.replace(problem, velocity_scale=1e4 * problem.velocity_scale)
    report = solve(problem, tolerance=Tolerance(1e-8, "absolute", 1e-14))
    assert report.converged
    assert report.residuals.dual <= 1e-8


# ---- starts --------------------------------------------------------------------------------


def test_start_from_the_solution_costs_nothing_and_from_near_less():
    problem = random_problem(60, 120, 10)
    cold = solve(problem)
    assert solve(problem, cold.impulse.copy()).iterations == 0
    near = cold.impulse * (1.0 + 1e-4 * np.random.default_rng(10).normal(size=cold.impulse.shape))
    assert solve(problem, near).iterations < cold.iterations


def test_rows_of_the_guess_that_are_not_finite_start_from_zero():
    problem = random_problem(20, 60, 11)
    guess = np.zeros_like(problem.b)
    guess[3, 1], guess[5, 0] = np.nan, np.inf
    report, plain = solve(problem, guess), solve(problem)
    assert report.converged
    assert np.array_equal(report.impulse, plain.impulse)


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_guess_of_a_wrong_size_costs_some_iterations(factor):
    problem = random_problem(40, 100, 12)
    cold = solve(problem)
    wrong = solve(problem, cold.impulse * factor)
    assert wrong.converged
    assert wrong.iterations <= 60


# ---- faults --------------------------------------------------------------------------------


class Failing(DenseNewton):
    """Breaks at a factorisation: an error, or solutions that are not numbers."""

    def __init__(self, *arguments, at: int, how: str) -> None:
        super().__init__(*arguments)
        self.at, self.how, self.count = at, how, 0

    def factor(self, Q, R, root=None):
        self.count += 1
        if self.count == self.at and self.how == "error":
            raise NewtonFailureError("MUMPS wants more memory")
        super().factor(Q, R, root)

    def solve(self, s, out, tolerance=1e-10):
        done = super().solve(s, out, tolerance)
        if self.count >= self.at:
            out[0] = {"nan": np.nan, "infinite": np.inf, "nonsense": -out[0] * 1e3}.get(self.how)
        return done


@pytest.mark.parametrize("at", [1, 4])
@pytest.mark.parametrize("how", ["error", "nan", "infinite", "nonsense"])
def test_failing_linear_algebra_leaves_the_best_iterate_and_a_reason(how, at):
    problem = random_problem(30, 80, 13)
    report = solve(problem, system=functools.partial(Failing, at=at, how=how))
    assert not report.converged
    assert report.reason
    assert report.reason != "converged"
    assert ("MUMPS" in report.reason) == (how == "error")
    assert np.isfinite(report.impulse).all()
    assert in_cone(report.impulse, problem.mu)
    merits = np.maximum(
        report.history[:, 1] / problem.velocity_scale,
        report.history[:, 2] / (problem.velocity_scale * problem.impulse_scale),
    )
    kept = max(
        report.residuals.dual / problem.velocity_scale,
        report.residuals.weighted_work / (problem.velocity_scale * problem.impulse_scale),
    )
    assert kept == pytest.approx(np.nanmin(merits), rel=1e-9)


def test_problem_with_a_number_missing_ends_with_its_reason():
    problem = random_problem(10, 40, 14)
    problem.b[2, 1] = np.nan
    report = solve(problem)
    assert not report.converged
    assert "not a number" in report.reason
    assert np.isfinite(report.impulse).all()


def test_problem_without_a_solution_ends_with_the_best_finite_iterate():
    """One body pressed together by two walls that approach each other."""
    N = np.zeros((6, 6))
    normal = np.array([1.0, -1.0])
    N[::3, ::3] = np.outer(normal, normal)
    N[[1, 2, 4, 5], [1, 2, 4, 5]] = 1.0
    b = np.array([[-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    report = solve(dense_problem(N, b, np.full(2, 0.5)))
    assert not report.converged
    assert np.isfinite(report.impulse).all()
    assert report.residuals.finite
    assert report.reason != "converged"


def test_iteration_limit_is_kept_and_named():
    report = solve(random_problem(30, 80, 15), max_iterations=3)
    assert not report.converged
    assert report.iterations == report.factorisations == 3
    assert report.reason == "reached the iteration limit"


# ---- the report ----------------------------------------------------------------------------


def test_report_describes_the_run():
    problem = random_problem(40, 100, 16)
    solver = Scip(ScipOptions(tight()), DenseNewton)
    report = solver.solve(problem, np.zeros_like(problem.b), lipschitz=3.5)
    assert report.solver == "scip"
    assert report.form == "contact"
    assert report.lipschitz == 3.5
    assert report.factorisations == report.iterations > 0
    assert report.factor_entries > 0
    assert report.history[:, 0].tolist() == list(range(report.iterations + 1))
    assert report.history[-1, 1] == report.residuals.dual
    assert report.history[-1, 3] == pytest.approx(report.residuals.objective, rel=1e-12)
    assert report.products == problem.operator.products - 3 * problem.contacts  # less the twin's
    assert set(report.seconds) == {"solve", "assemble", "factor", "substitute"}
    assert sum(report.seconds.values()) <= 2.0 * report.seconds["solve"]
    assert report.linear_residual <= 1e-8
    g = problem.operator.matrix @ report.impulse.ravel() + problem.b.ravel()
    assert np.allclose(report.velocity.ravel(), g, rtol=0.0, atol=1e-13)


def test_system_is_kept_while_it_takes_the_next_problem():
    made = []

    class Counting(DenseNewton):
        def __init__(self, *arguments) -> None:
            super().__init__(*arguments)
            made.append(self)
            self.gone = False

        def take(self, operator, mu):
            same = not hasattr(self, "size") or self.size == mu.size
            self.size = mu.size
            return same and super().take(operator, mu)

        def destroy(self):
            self.gone = True

    solver = Scip(ScipOptions(tight()), Counting)
    for seed, m in ((17, 20), (18, 20), (19, 25)):
        problem = random_problem(m, 60, seed)
        assert solver.solve(problem, np.zeros_like(problem.b)).converged
    assert [system.gone for system in made] == [True, False]
    solver.destroy()
    assert all(system.gone for system in made)
    solver.destroy()


def test_own_tolerance_of_a_solve_goes_before_that_of_the_options():
    problem = random_problem(30, 80, 20)
    solver = Scip(ScipOptions(tight(1e-2)), DenseNewton)
    loose = solver.solve(problem, np.zeros_like(problem.b))
    strict = solver.solve(problem, np.zeros_like(problem.b), tolerance=tight(1e-11))
    assert loose.converged and strict.converged
    assert loose.iterations < strict.iterations


def test_threads_change_no_bit():
    rng = np.random.default_rng(21)
    m = 3 * 2048 + 77
    x, y, mu, g = (
        points(m, 0.1, 22),
        points(m, 0.2, 23),
        rng.uniform(0, 1, m),
        rng.normal(size=(m, 3)),
    )
    found = []
    for kind in ("serial", "threaded"):
        eta, w, lam = np.empty(m), np.empty((m, 3)), np.empty((m, 3))
        sums = getattr(kernels.scaling, kind)(x, y, mu, g, eta, w, lam, np.zeros((4, 3)))
        c, s = np.zeros((m, 3)), np.empty((m, 3))
        getattr(kernels.second_order, kind)(lam, g, g, 0.1, c)
        getattr(kernels.right_side, kind)(g, eta, w, mu, c, s)
        u, v = np.empty((m, 3)), np.empty((m, 3))
        steps = getattr(kernels.direction, kind)(
            s, g, g, y, eta, w, lam, mu, u, v, np.zeros((4, 2))
        )
        gap = getattr(kernels.gap_at, kind)(lam, u, v, 0.3, 0.3, np.zeros(4))
        found.append(np.concatenate((sums, steps, [gap], s.ravel(), u.ravel(), v.ravel())))
    assert np.array_equal(*found)


# ---- on ranks, with the sparse systems -----------------------------------------------------


@ranks_1_2_3
@pytest.mark.parametrize("mu", [None, 0.0, 1e-3, 0.5, 2.0])
def test_heap_meets_its_tolerance_by_a_fresh_product(parallel, mu):
    problem = heap(parallel, mu=mu)
    report = solve(problem, system=NewtonSystem)
    assert report.converged, report.reason
    assert report.iterations <= 20
    velocity = np.empty_like(problem.b)
    problem.operator.apply(report.impulse, velocity)
    velocity += problem.b
    assert np.array_equal(velocity, report.velocity)
    assert in_cone(report.impulse, problem.mu)
    dual = problem.mu * size(velocity[:, 1:]) - velocity[:, 0]
    work = np.abs((report.impulse * velocity).sum(axis=1))
    assert np.all(dual <= 1e-10 * problem.velocity_scale)
    assert np.all(work <= 1e-10 * problem.velocity_scale * problem.impulse_scale)
    assert report.linear_residual <= 1e-8
    assert report.linear_iterations == 0  # factorised


@ranks_1_2_3
def test_iterations_of_conjugate_gradients_are_counted(parallel):
    newton = NewtonOptions(form="velocity", linear="cg")
    report = solve(heap(parallel), tolerance=tight(1e-5), system=NewtonSystem, newton=newton)
    assert report.converged, report.reason
    assert report.linear_iterations >= report.factorisations > 0


@ranks_1_2_3
def test_scene_without_friction_has_a_column(parallel):
    smooth = heap(parallel, frictional=False)
    report = solve(smooth, system=NewtonSystem)
    other = solve(heap(parallel, mu=0.0), system=NewtonSystem)
    assert report.converged
    assert report.impulse.shape[1] == 1
    assert report.iterations == other.iterations
    close = np.abs(report.velocity - other.velocity[:, :1]).max(initial=0.0)
    assert close <= 1e-8 * smooth.velocity_scale


@ranks_1_2_3
def test_both_forms_take_the_same_steps(parallel):
    """To 1e-10 of the step in its first five iterations, so the residuals agree to about that.

    The last iterates are 1e-10 v_ref gamma_ref from complementarity in each of 400 contacts, which
    bounds velocities by sqrt(8e-8) v_ref.
    """
    problem = heap(parallel)
    reports = [
        solve(problem, system=NewtonSystem, newton=NewtonOptions(form=form))
        for form in ("velocity", "contact")
    ]
    assert [r.form for r in reports] == ["velocity", "contact"]
    assert all(r.converged for r in reports)
    velocity, contact = (r.history[:6] for r in reports)
    assert np.allclose(velocity, contact, rtol=1e-8, atol=1e-12 * velocity.max())
    difference = np.abs(reports[0].velocity - reports[1].velocity).max(initial=0.0)
    assert difference <= 1e-5 * problem.velocity_scale


@ranks_1_2_3
def test_ranks_do_not_change_the_velocities(parallel):
    problem = heap(parallel)
    report = solve(problem, system=NewtonSystem, tolerance=tight(1e-11))
    alone = Parallel.alone()
    whole = heap(alone)
    expected = solve(whole, system=NewtonSystem, tolerance=tight(1e-11))
    # Rows are in another order: compare what does not depend on it.
    speeds = np.sort(gathered(parallel, report.velocity[:, 0]))
    assert np.allclose(
        speeds, np.sort(expected.velocity[:, 0]), rtol=0.0, atol=1e-5 * problem.velocity_scale
    )
    assert report.residuals.objective == pytest.approx(expected.residuals.objective, rel=1e-9)
    alone.free()


@ranks_1_2_3
@pytest.mark.parametrize("columns", [1, 3])
def test_no_contacts_anywhere_is_solved_at_once(parallel, columns):
    problem = ConeProblem(
        DenseDelassus(np.zeros((0, 0)), columns), np.zeros((0, columns)), np.zeros(0), 1.0, 1.0,
        parallel,
    )  # fmt: skip
    report = Scip().solve(problem, np.zeros((0, columns)))
    assert report.converged
    assert report.iterations == report.factorisations == 0
    assert report.impulse.shape == (0, columns)


@pytest.mark.mpi(ranks=[3])
def test_ranks_without_a_contact_take_part(parallel):
    """Two touching spheres: at least one of three ranks has nothing."""
    bodies = cloud(
        np.array([[0.4, 0.5, 0.5], [0.6, 0.5, 0.5]]), np.array([0.101, 0.101]),
        np.array([[1.0, 0.2, 0.0], [-1.0, 0.0, 0.0]]), np.zeros((2, 3)),
    )  # fmt: skip
    found = detect(parallel, bodies, detection(), STEP, None)
    c, n = found.contacts, found.neighbours
    operator = MatrixFree(c, n.inverse_mass, n.inverse_inertia, n.halo, frictional=True)
    owned = found.bodies
    b = np.empty((c.count, 3))
    operator.contact_velocity(n.extend(np.hstack((owned.velocity, owned.angular_velocity))), b)
    scale = 2.0 / median_of_positive(operator.diagonal(), parallel)
    problem = ConeProblem(operator, b, np.full(c.count, 0.5), 2.0, scale, parallel)
    report = solve(problem, system=NewtonSystem)
    assert parallel.sum(problem.contacts) == 1
    assert report.converged
    assert np.allclose(report.velocity, 0.0, atol=1e-9)


@ranks_1_2_3
def test_not_a_number_on_one_rank_ends_the_solve_on_all(parallel):
    problem = heap(parallel)
    if parallel.rank == 0:
        problem.b[0, 0] = np.nan
    report = solve(problem, system=NewtonSystem)
    assert not report.converged
    assert "not a number" in report.reason
    assert parallel.sum(report.iterations) == parallel.size * report.iterations
    assert np.isfinite(report.impulse).all()
