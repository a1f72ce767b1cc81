"""APGD against closed forms, a plain twin, faults, and itself on other ranks and threads."""

from __future__ import annotations

import dataclasses
import hashlib
import os

import numpy as np
import pytest

from dem_mpi import _kernels_solver as kernels
from dem_mpi.cone import ConeProblem, Tolerance, median_of_positive
from dem_mpi.contacts import ContactSet
from dem_mpi.operators import MatrixFree
from dem_mpi.parallel import Parallel
from dem_mpi.solvers.apgd import Apgd, ApgdOptions
from dem_mpi.solvers.result import SolveReport

from contact_twins import (
    DenseDelassus,
    cloud,
    detect,
    detection,
    fixed_point,
    gathered,
    residuals,
    room,
)
from launch import ROOT, run_ranks

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])

STEP = 1e-3
CONE = 1e-14  # relative: a projected row is off by the rounding of its own length

# ---- problems ------------------------------------------------------------------------------


def dense_problem(
    N: np.ndarray, b: np.ndarray, mu: np.ndarray, parallel: Parallel | None = None
) -> ConeProblem:
    """A problem on one rank with v_ref = the largest |b|."""
    v_ref = float(np.max(np.linalg.norm(b, axis=1), initial=0.0))
    operator = DenseDelassus(N, b.shape[1])
    diag = float(np.median(operator.diagonal())) if len(b) else 1.0
    return ConeProblem(operator, b, mu, v_ref, v_ref / diag, parallel or Parallel.alone())


def random_problem(m: int, freedoms: int, seed: int, mu: np.ndarray | float = 0.3) -> ConeProblem:
    """N = D^T M^-1 D of rank at most `freedoms`; its cone problem is solvable and bounded.

    b = D^T v with v such that some contacts close and some open.
    """
    rng = np.random.default_rng(seed)
    D = rng.normal(size=(freedoms, 3 * m))
    mass = rng.uniform(0.5, 2.0, freedoms)
    b = (D.T @ rng.normal(size=freedoms)).reshape(m, 3)
    return dense_problem(D.T @ (D / mass[:, None]), b, np.broadcast_to(mu, m).astype(float))


def physical_problem(
    parallel: Parallel,
    count: int = 150,
    mu: float | None = None,
    ratio: float = 3.0,
    closed: bool = True,
) -> tuple[ConeProblem, ContactSet, np.ndarray]:
    """Collective. A shaken heap in a room: contacts, b = D^T v + (max(phi/h, -v_rec), 0, 0).

    Returns problem, contacts, gids of the local rows. mu None keeps the table's, zeros included.
    Without the room (closed = False) there is always a solution: an expansion of the heap parts
    every pair along its normal.
    """
    rng = np.random.default_rng(31)
    radius = 0.16 * ratio ** -rng.random(count)
    velocity = rng.normal(size=(count, 3)) * 0.2 - [0.0, 0.0, 0.5]
    spin = rng.normal(size=(count, 3))
    bodies = cloud(rng.random((count, 3)), radius, velocity, spin)
    found = detect(parallel, bodies, detection(), STEP, room(0.0, 1.0) if closed else None)
    c, n, owned = found.contacts, found.neighbours, found.bodies
    operator = MatrixFree(c, n.inverse_mass, n.inverse_inertia, n.halo, frictional=True)
    b = np.empty((c.count, 3))
    operator.contact_velocity(n.extend(np.hstack((owned.velocity, owned.angular_velocity))), b)
    v_ref = parallel.max(float(np.max(np.linalg.norm(b, axis=1), initial=0.0)))
    b[:, 0] += np.maximum(c.gap / STEP, -0.2)
    friction = c.friction if mu is None else np.full(c.count, mu)
    scale = v_ref / median_of_positive(operator.diagonal(), parallel)
    return ConeProblem(operator, b, friction, v_ref, scale, parallel), c, n.gid


def solve(problem: ConeProblem, guess: np.ndarray | None = None, **options) -> SolveReport:
    guess = np.zeros_like(problem.b) if guess is None else guess
    return Apgd(ApgdOptions(**options)).solve(problem, guess)


def tight(value: float = 1e-11) -> Tolerance:
    return Tolerance(value, "scaled", value)


def in_cone(gamma: np.ndarray, mu: np.ndarray) -> bool:
    excess = np.linalg.norm(gamma[:, 1:], axis=1) - mu * gamma[:, 0]
    limit = CONE * np.linalg.norm(gamma, axis=1)
    return bool(np.all(excess <= limit) and np.all(gamma[:, 0] >= 0.0))


# ---- one contact, closed form --------------------------------------------------------------

N_NORMAL, N_TANGENT = 2.0, 7.0  # a solid sphere on a wall: 1/m and 7/(2 m)


def one_contact(b: list[float], mu: float, **options) -> SolveReport:
    N = np.diag([N_NORMAL, N_TANGENT, N_TANGENT])
    return solve(dense_problem(N, np.array([b]), np.array([mu])), tolerance=tight(), **options)


def test_sticking_contact_takes_both_velocities_away():
    report = one_contact([-1.0, 0.6, -0.8], mu=0.5)
    expected = [1.0 / N_NORMAL, -0.6 / N_TANGENT, 0.8 / N_TANGENT]
    assert np.hypot(*expected[1:]) < 0.5 * expected[0]  # inside the cone
    assert np.allclose(report.impulse[0], expected, rtol=0.0, atol=1e-10)
    assert np.allclose(report.velocity, 0.0, atol=1e-10)
    assert report.converged
    assert report.reason == "converged"


@pytest.mark.parametrize("mu", [1e-3, 0.3])
def test_sliding_contact_stays_on_its_cone_and_lifts_by_mu_times_its_slip(mu):
    """gamma_t = -mu gamma_n b_t/|b_t| and g_n = mu |g_t|:

    N_n gamma_n + b_n = mu (|b_t| - mu N_t gamma_n), so gamma_n = (mu |b_t| - b_n)/(N_n + mu^2 N_t).
    """
    slip = 5.0
    gamma_n = (1.0 + mu * slip) / (N_NORMAL + mu * mu * N_TANGENT)
    report = one_contact([-1.0, 3.0, 4.0], mu)
    expected = [gamma_n, -mu * gamma_n * 0.6, -mu * gamma_n * 0.8]
    assert slip > mu * N_TANGENT * gamma_n  # it slides
    assert np.allclose(report.impulse[0], expected, rtol=0.0, atol=1e-10)
    g = report.velocity[0]
    assert g[0] == pytest.approx(mu * np.hypot(g[1], g[2]), abs=1e-10)
    assert report.converged


def test_separating_contact_gets_no_impulse_and_no_iteration():
    report = one_contact([1.0, 1.0, 0.0], mu=0.5)
    assert not report.impulse.any()
    assert report.iterations == 0
    assert report.converged
    assert np.array_equal(report.velocity, [[1.0, 1.0, 0.0]])


def test_contact_that_slides_faster_than_it_parts_is_not_open():
    """g_n > 0 but below mu |g_t|: the relaxed law asks for an impulse."""
    report = one_contact([0.1, 1.0, 0.0], mu=0.5)
    assert report.impulse[0, 0] == pytest.approx(0.4 / (N_NORMAL + 0.25 * N_TANGENT), abs=1e-10)


def test_smooth_contact_has_a_normal_impulse_alone():
    problem = dense_problem(np.array([[2.0]]), np.array([[-1.0]]), np.zeros(1))
    report = solve(problem, tolerance=tight())
    assert report.impulse[0, 0] == pytest.approx(0.5, abs=1e-10)
    rough = one_contact([-1.0, 1.0, 0.0], mu=0.0)
    assert rough.impulse[0, 0] == pytest.approx(0.5, abs=1e-10)
    assert not rough.impulse[0, 1:].any()


# ---- against a plain twin ------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_solution_equals_that_of_plain_projected_gradients(seed):
    """N regular: the solution is unique."""
    mu = np.random.default_rng(seed).choice([0.0, 1e-3, 0.3, 2.0], 12)
    problem = random_problem(12, 80, seed, mu)
    report = solve(problem, tolerance=tight(), max_iterations=50_000)
    assert report.converged
    expected = fixed_point(problem.operator.matrix, problem.b, mu, 4000)
    scale = np.max(np.abs(expected))
    assert np.max(np.abs(report.impulse - expected)) <= 1e-7 * scale
    assert in_cone(report.impulse, mu)
    assert not report.impulse[mu == 0.0, 1:].any()


@pytest.mark.parametrize("seed", range(3))
def test_singular_problem_has_one_velocity_though_many_impulses(seed):
    """Hyperstatic: 60 contacts on 30 freedoms. M^-1 D gamma, so g, is unique; gamma is not."""
    problem = random_problem(60, 30, seed)
    assert np.linalg.matrix_rank(problem.operator.matrix) == 30
    options = {"tolerance": tight(1e-9), "max_iterations": 50_000}
    first = solve(problem, **options)
    guess = np.abs(np.random.default_rng(seed).normal(size=problem.b.shape))
    second = solve(problem, guess, **options)
    assert first.converged
    assert second.converged
    # Near an optimum the distance in g goes with the root of the residuals' 1e-9.
    assert np.max(np.abs(first.velocity - second.velocity)) <= 1e-4 * problem.velocity_scale
    assert first.residuals.objective == pytest.approx(second.residuals.objective, rel=1e-7)


def test_mass_ratio_of_a_million_is_solved():
    """A heavy sphere between light ones: the scaling by diag(N) makes it as easy as equal ones."""
    rng = np.random.default_rng(33)
    D = rng.normal(size=(60, 3 * 10))
    mass = np.where(np.arange(60) % 12 < 6, 1.0, 1e6)
    # Every contact joins a light and a heavy body, or two heavy ones.
    D[mass == 1.0, 15:] = 0.0
    b = (D.T @ rng.normal(size=60)).reshape(10, 3)
    mu = np.full(10, 0.4)
    problem = dense_problem(D.T @ (D / mass[:, None]), b, mu)
    report = solve(problem, tolerance=Tolerance(1e-6, "scaled", 1e-6), max_iterations=20_000)
    assert report.converged
    found = residuals(problem.operator.matrix, b, mu, report.impulse)
    assert found["dual"] <= 1e-6 * problem.velocity_scale
    assert in_cone(report.impulse, mu)


@pytest.mark.parametrize("mu", [0.0, 1e-3, 2.0, None], ids=["0", "0.001", "2", "mixed"])
def test_heap_meets_its_tolerance_by_a_fresh_dense_product(parallel, mu):
    problem, contacts, _ = physical_problem(parallel, 60, mu, closed=mu != 2.0)
    report = solve(problem, tolerance=Tolerance(1e-6, "scaled", 1e-5), max_iterations=20_000)
    assert report.converged
    assert contacts.count > 30
    N = matrix_of(problem)
    found = residuals(N, problem.b, problem.mu, report.impulse)
    for name, value in found.items():
        # The objective and g are sums of a few hundred terms.
        scale = 1.0 if name != "objective" else abs(value)
        assert getattr(report.residuals, name) == pytest.approx(value, abs=1e-12 * scale), name
    assert found["dual"] <= 1e-6 * problem.velocity_scale
    assert in_cone(report.impulse, problem.mu)


def test_wedged_heap_without_a_solution_gives_the_best_bounded_iterate(parallel):
    """At mu = 2 sliding in a closed room asks for more lift than it has: no v parts all contacts.

    The objective is unbounded below and the iterates grow for ever; the best of them does not.
    """
    problem, _, _ = physical_problem(parallel, 60, mu=2.0)
    report = solve(problem, tolerance=Tolerance(1e-6, "scaled", 1e-5), max_iterations=5000)
    assert not report.converged
    assert report.history[-1, 3] < 100.0 * report.residuals.objective < 0.0
    assert np.max(np.abs(report.impulse)) < 100.0 * problem.impulse_scale
    assert in_cone(report.impulse, problem.mu)


def matrix_of(problem: ConeProblem) -> np.ndarray:
    """N, column by column."""
    columns = []
    for unit in np.eye(problem.b.size):
        out = np.empty_like(problem.b)
        problem.operator.apply(unit.reshape(problem.b.shape), out)
        columns.append(out.ravel())
    return np.array(columns).T


# ---- the iteration -------------------------------------------------------------------------


def test_history_and_report_describe_the_run(parallel):
    problem, _, _ = physical_problem(parallel, 80)
    report = solve(problem, tolerance=Tolerance(1e-4, "scaled", 1e-3))
    assert report.history.shape == (report.iterations + 1, 4)
    assert np.array_equal(report.history[:, 0], np.arange(report.iterations + 1))
    first = residuals(matrix_of(problem), problem.b, problem.mu, np.zeros_like(problem.b))
    assert report.history[0, 1] == pytest.approx(first["dual"], rel=1e-12)
    assert report.history[0, 3] == 0.0
    assert report.history[-1, 1] == pytest.approx(report.residuals.dual, rel=1e-6)
    assert report.history[-1, 3] == pytest.approx(report.residuals.objective, rel=1e-9)
    assert report.residuals.objective < 0.0
    assert report.factorisations == 0
    assert report.lipschitz > 0.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.iterations = 0


@pytest.mark.parametrize("start", [1e-6, 1.0, 1e6])
def test_line_search_finds_a_step_from_any_start(start):
    """Largest eigenvalue of S N S is at most the matrix size: L ends within twice that."""
    problem = random_problem(20, 40, 3)
    solver = Apgd(ApgdOptions(tolerance=tight(1e-8), max_iterations=20_000))
    report = solver.solve(problem, np.zeros_like(problem.b), start)
    assert report.converged
    assert report.lipschitz < 2.0 * 60


@pytest.mark.parametrize("start", [0.0, -0.0, np.nan, np.inf, None])
def test_useless_step_constants_are_replaced(start):
    problem = random_problem(10, 40, 4)
    report = Apgd(ApgdOptions(tolerance=tight(1e-6))).solve(
        problem, np.zeros_like(problem.b), start
    )
    assert report.converged


def test_a_product_an_iteration_unless_the_line_search_rejects(parallel):
    problem, _, _ = physical_problem(parallel, 80)
    report = solve(problem, max_iterations=200, fixed_iterations=True)
    # 200 iterations, two fresh g every 50, one at either end, and rejected steps: L falls by 0.9
    # an iteration, so it doubles once in log 2 / log(1/0.9) = 6.6 of them, or a bit less.
    fresh = 2 * (200 // 50) + 2
    rejected = report.products - 200 - fresh
    assert 0 <= rejected <= 200 / 6.5 + 10


def test_momentum_restart_does_not_raise_the_objective_for_long():
    problem = random_problem(30, 25, 6)
    free = solve(problem, max_iterations=400, fixed_iterations=True, restart=False)
    restarted = solve(problem, max_iterations=400, fixed_iterations=True)
    assert restarted.residuals.objective <= free.residuals.objective + 1e-12 * abs(
        free.residuals.objective
    )
    best = np.minimum.accumulate(restarted.history[:, 3])
    excess = restarted.history[:, 3] - best
    assert np.max(excess[200:]) <= 1e-6 * abs(best[-1])


def test_warm_start_from_the_solution_costs_nothing_and_from_near_less(parallel):
    problem, _, _ = physical_problem(parallel, 80)
    options = {"tolerance": Tolerance(1e-5, "scaled", 1e-4), "max_iterations": 20_000}
    cold = solve(problem, **options)
    assert cold.converged
    assert solve(problem, cold.impulse, **options).iterations == 0
    # The next step's problem: everything a little faster.
    shifted = dataclasses.replace(problem, b=1.001 * problem.b)
    again, warm = solve(shifted, **options), solve(shifted, cold.impulse, **options)
    assert warm.converged
    assert warm.iterations < 0.7 * again.iterations


def test_guess_outside_the_cones_is_projected():
    problem = random_problem(10, 40, 7)
    guess = np.full_like(problem.b, -3.0)
    report = solve(problem, guess, max_iterations=0)
    assert not report.impulse.any()


def test_iteration_limit_returns_the_best_iterate_and_says_so():
    problem = random_problem(40, 30, 8)
    limits = (1, 2, 5, 20, 60)
    merit = []
    for limit in limits:
        report = solve(problem, tolerance=tight(), max_iterations=limit)
        assert not report.converged
        assert report.reason == "reached the iteration limit"
        assert report.iterations == limit
        assert in_cone(report.impulse, problem.mu)
        merit.append(tight().merit(report.residuals, problem))
        start, seen = report.history[0], report.history[:, 1:3]
        assert start[0] == 0
        scale = problem.velocity_scale * np.array([1.0, problem.impulse_scale])
        best = np.min(np.max(seen / scale, axis=1)) / 1e-11
        # A new best must beat the old by a tenth before it is stored.
        assert merit[-1] <= best / 0.9 * (1.0 + 1e-9)
    assert np.all(np.diff(merit) <= 0.2 * np.array(merit[:-1]))


def test_fixed_iterations_ignore_the_tolerance_and_return_the_last():
    problem = random_problem(10, 40, 9)
    report = solve(problem, max_iterations=30, fixed_iterations=True, tolerance=Tolerance(1e9))
    assert report.iterations == 30
    assert report.residuals.objective == pytest.approx(report.history[-1, 3], rel=1e-12)


def test_thesis_tolerance_stops_by_its_own_residual():
    problem = random_problem(20, 40, 10)
    report = solve(problem, tolerance=Tolerance(1e-6, "thesis"), max_iterations=20_000)
    assert report.converged
    assert report.residuals.thesis <= 1e-6


@pytest.mark.parametrize("restart", [True, False])
def test_thousands_of_iterations_do_not_drift(parallel, restart):
    """Extrapolation carries the error of a stale g on; both g must be renewed together.

    With one of them stale the converged iteration diverges exponentially, if nothing restarts it.
    """
    problem, _, _ = physical_problem(parallel, 40)
    report = solve(problem, max_iterations=6000, fixed_iterations=True, restart=restart)
    objective = report.history[:, 3]
    assert np.isfinite(report.history).all()
    final = report.residuals.objective
    tail = objective[3000:]
    # Sums of some hundred terms, of which the largest cancel: 1e-12 is round-off.
    assert np.max(np.abs(tail - final)) <= 1e-12 * abs(final)
    assert final <= objective.min() + 1e-12 * abs(final)
    assert report.residuals.dual <= 1e-9 * problem.velocity_scale
    assert report.history[3000:, 1].max() <= 1e-9 * problem.velocity_scale
    assert np.max(np.diff(tail)) <= 1e-12 * abs(final)
    assert in_cone(report.impulse, problem.mu)


def test_contacts_at_rest_in_the_solution_do_not_starve_the_step_constant():
    """At an exact solution every step is accepted: L must not fall until 1/L overflows."""
    problem = dense_problem(np.eye(3), np.array([[1.0, 0.0, 0.0]]), np.array([0.5]))
    report = solve(problem, max_iterations=10_000, fixed_iterations=True)
    assert not report.impulse.any()
    assert report.residuals.finite
    assert report.lipschitz > 1e-12


# ---- faults --------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [3, 1], ids=["mu", "smooth"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["b", "N", "guess"])
def test_not_a_number_ends_the_solve_with_its_reason(columns, value, where):
    rng = np.random.default_rng(11)
    D = rng.normal(size=(40, columns * 8))
    N, b, guess = D.T @ D, rng.normal(size=(8, columns)), np.ones((8, columns))
    {"b": b, "N": N, "guess": guess}[where][3, 0] = value
    problem = ConeProblem(DenseDelassus(N, columns), b, np.full(8, 0.3), 1.0, 1.0, Parallel.alone())
    with np.errstate(all="ignore"):
        report = solve(problem, guess, max_iterations=50)
    assert report.iterations <= 50
    if where == "guess":
        # A bad memory is no reason to fail: it starts from zero.
        assert np.isfinite(report.impulse).all()
        assert report.residuals.finite
    elif not (where == "b" and value == np.inf):  # an infinitely open contact is just open
        assert not report.converged
        assert report.reason != "converged"
    if where == "b":
        # The guess was finite, and so must be what comes back.
        assert np.isfinite(report.impulse).all()


class FailingDelassus(DenseDelassus):
    """Gives NaN from the twentieth product on."""

    def apply(self, impulse: np.ndarray, out: np.ndarray) -> None:
        super().apply(impulse, out)
        if self.products == 20:
            out[0, 0] = np.nan


def test_best_finite_iterate_survives_a_fault_in_the_middle():
    sound = random_problem(20, 30, 12)
    problem = dataclasses.replace(sound, operator=FailingDelassus(sound.operator.matrix, 3))
    report = solve(problem, tolerance=tight(), max_iterations=100)
    assert not report.converged
    assert report.reason == "not a number in the iteration"
    assert report.iterations < 20
    assert np.isfinite(report.impulse).all()
    assert report.residuals.finite
    assert report.residuals.objective < 0.0
    assert in_cone(report.impulse, problem.mu)


@ranks_1_2_3_8
def test_not_a_number_on_one_rank_ends_the_solve_on_all(parallel):
    problem, contacts, _ = physical_problem(parallel, 60)
    holders = np.flatnonzero(parallel.allgather(np.array([contacts.count]))[:, 0])
    if parallel.rank == holders[-1]:
        problem.b[0, 0] = np.nan
    report = solve(problem, max_iterations=100)
    assert not report.converged
    assert np.isfinite(report.impulse).all()
    assert np.ptp(parallel.allgather(np.array([report.iterations]))) == 0


# ---- ranks, threads, repetition ------------------------------------------------------------


@ranks_1_2_3_8
@pytest.mark.parametrize("columns", [3, 1])
def test_no_contacts_anywhere_is_solved_at_once(parallel, columns):
    empty = np.zeros((0, columns))
    operator = DenseDelassus(np.zeros((0, 0)), columns)
    problem = ConeProblem(operator, empty, np.zeros(0), 1.0, 1.0, parallel)
    report = solve(problem)
    assert report.converged
    assert report.iterations == 0
    assert report.impulse.shape == (0, columns)
    fixed = solve(problem, fixed_iterations=True, max_iterations=3)
    assert fixed.iterations == 3


@ranks_1_2_3_8
def test_fifty_iterations_agree_on_any_number_of_ranks(parallel):
    """|g_ranks - g_one rank| <= 1e-12 v_ref: only the order of the sums over bodies differs."""
    problem, contacts, gid = physical_problem(parallel)
    options = {"max_iterations": 50, "fixed_iterations": True, "restart": False}
    report = solve(problem, **options)
    again = solve(problem, **options)
    assert report.impulse.tobytes() == again.impulse.tobytes()
    assert report.velocity.tobytes() == again.velocity.tobytes()
    assert np.array_equal(report.history, again.history)

    alone = Parallel.alone()
    whole, all_of_them, names = physical_problem(alone)
    expected = solve(whole, **options)
    assert problem.velocity_scale == pytest.approx(whole.velocity_scale, rel=1e-14)
    velocity = by_name(parallel, contacts, gid, report.velocity)
    reference = by_name(alone, all_of_them, names, expected.velocity)
    assert velocity.shape == reference.shape
    assert np.array_equal(velocity[:, :2], reference[:, :2])
    assert np.max(np.abs(velocity - reference)) <= 1e-12 * whole.velocity_scale
    impulse = by_name(parallel, contacts, gid, report.impulse)
    reference = by_name(alone, all_of_them, names, expected.impulse)
    assert np.max(np.abs(impulse - reference)[:, 2:]) <= 1e-12 * whole.impulse_scale
    assert report.residuals.objective == pytest.approx(expected.residuals.objective, rel=1e-12)


def by_name(
    parallel: Parallel, contacts: ContactSet, gid: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Collective. All ranks' rows (m, 2 + k) behind the gids of their contacts, sorted by them."""
    names = np.stack((gid[contacts.a], contacts.other), axis=1).astype(float)
    table = gathered(parallel, np.hstack((names, rows)))
    return table[np.lexsort((table[:, 1], table[:, 0]))]


@ranks_1_2_3_8
def test_more_ranks_than_bodies_solve_what_one_rank_solves(parallel):
    problem, contacts, gid = physical_problem(parallel, 2)
    report = solve(problem, tolerance=tight(1e-8))
    assert report.converged
    alone = Parallel.alone()
    whole, all_of_them, names = physical_problem(alone, 2)
    expected = solve(whole, tolerance=tight(1e-8))
    assert all_of_them.count > 0
    velocity = by_name(parallel, contacts, gid, report.velocity)
    reference = by_name(alone, all_of_them, names, expected.velocity)
    assert np.max(np.abs(velocity - reference)) <= 1e-7 * whole.velocity_scale


class CountingParallel(Parallel):
    """Counts reductions."""

    reductions = 0

    def sum_in_place(self, array):
        self.reductions += 1
        super().sum_in_place(array)

    def max_in_place(self, array):
        self.reductions += 1
        super().max_in_place(array)

    def _reduce(self, value, operation):
        self.reductions += 1
        return super()._reduce(value, operation)


@pytest.mark.mpi(ranks=[1, 3])
def test_two_reductions_an_iteration(parallel):
    """One more for each step that the line search rejects, two where residuals are evaluated."""
    counting = CountingParallel()
    problem, _, _ = physical_problem(counting, 80)
    counting.reductions = 0
    report = solve(problem, max_iterations=99, fixed_iterations=True)
    rejected = report.products - 99 - 2 - 2
    evaluations = 1 + 1 + 1  # of the guess, at iteration 50, of the result
    assert rejected < 99 / 4
    assert counting.reductions == 2 * 99 + rejected + 2 * evaluations
    counting.free()


def digest(threads: int) -> str:
    """The bits of 60 iterations on several chunks of contacts."""
    problem, _, _ = physical_problem(Parallel.alone(), 1500, ratio=2.0)
    assert problem.contacts > 2 * kernels.CHUNK
    problem = dataclasses.replace(problem, threads=threads)
    operator = problem.operator
    masses = (operator._inverse_mass, operator._inverse_inertia, operator.halo)
    operator = MatrixFree(operator.contacts, *masses, True, threads)
    report = solve(
        dataclasses.replace(problem, operator=operator), max_iterations=60, fixed_iterations=True
    )
    return hashlib.sha256(report.impulse.tobytes() + report.velocity.tobytes()).hexdigest()


def test_two_threads_solve_to_the_same_bits_as_one():
    folders = [ROOT / "tests" / "support", ROOT / "tests" / "dem_mpi"]
    script = f"import sys; sys.path[:0] = {list(map(str, folders))}\n"
    script += "import numba; numba.set_num_threads(2)\n"
    script += "import test_apgd as t; print(t.digest(1)); print(t.digest(2)); print(t.digest(2))"
    done = run_ranks(1, ["-c", script], env={**os.environ, "NUMBA_NUM_THREADS": "2"})
    lines = done.stdout.split()
    assert len(lines) == 3, done.stderr
    assert lines[0] == lines[1] == lines[2]
