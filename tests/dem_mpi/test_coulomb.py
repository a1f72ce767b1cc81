"""Coulomb's law around a cone solver: closed forms, twins on arrays, hard and impossible cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dem_mpi.cone import ConeProblem, Tolerance
from dem_mpi.parallel import Parallel
from dem_mpi.solvers.apgd import Apgd, ApgdOptions
from dem_mpi.solvers.coulomb import Coulomb, CoulombOptions, law_residuals
from dem_mpi.solvers.result import SolveReport

from contact_twins import DenseDelassus, gathered, projected
from scenes import FLOOR, placed, scene, simulation_of, watch

EPS = np.finfo(float).eps
ranks_1_2_3 = pytest.mark.mpi(ranks=[1, 2, 3])

# ---- problems ------------------------------------------------------------------------------


def dense_problem(N: np.ndarray, b: np.ndarray, mu: np.ndarray) -> ConeProblem:
    """A problem on one rank with v_ref = the largest |b|."""
    operator = DenseDelassus(N, b.shape[1])
    v_ref = float(np.max(np.linalg.norm(b, axis=1)))
    gamma_ref = v_ref / float(np.median(operator.diagonal()))
    return ConeProblem(operator, b, mu, v_ref, gamma_ref, Parallel.alone())


def random_matrix(m: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """N = D^T M^-1 D of full rank, D (6 m, 3 m), and the generator for more."""
    rng = np.random.default_rng(seed)
    D = rng.normal(size=(6 * m, 3 * m))
    return D.T @ (D / rng.uniform(0.5, 2.0, 6 * m)[:, None]), D, rng


def random_problem(m: int, seed: int, mu: np.ndarray | float) -> ConeProblem:
    """b = D^T v: some contacts close and some open, stick or slide."""
    N, D, rng = random_matrix(m, seed)
    b = (D.T @ rng.normal(size=len(D))).reshape(m, 3)
    return dense_problem(N, b, np.broadcast_to(mu, m).astype(float))


def tight(value: float = 1e-9) -> Tolerance:
    return Tolerance(value, "scaled", value)


def cone_solver(tolerance: Tolerance | None = None) -> Apgd:
    return Apgd(ApgdOptions(tolerance or tight(), max_iterations=20_000))


def solve(
    problem: ConeProblem,
    guess: np.ndarray | None = None,
    tolerance: Tolerance | None = None,
    **options,
) -> SolveReport:
    guess = np.zeros_like(problem.b) if guess is None else guess.copy()
    law = Coulomb(cone_solver(), tolerance or tight(), CoulombOptions(**options))
    return law.solve(problem, guess)


# ---- twins ---------------------------------------------------------------------------------


def lifted(g: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """g + (mu |g_t|, 0, 0)."""
    return g + np.outer(mu * np.linalg.norm(g[:, 1:], axis=1), [1.0, 0.0, 0.0])


def natural_map(problem: ConeProblem, gamma: np.ndarray, law: str = "coulomb") -> float:
    """max |gamma - P_C(gamma - rho (g + s))| / rho [m/s], rho = 1/median(diag N)."""
    N = problem.operator.matrix
    rho = problem.impulse_scale / problem.velocity_scale
    g = (N @ gamma.ravel()).reshape(gamma.shape) + problem.b
    if law == "coulomb":
        g = lifted(g, problem.mu)
    return float(np.abs(gamma - projected(gamma - rho * g, problem.mu)).max() / rho)


def gauss_seidel(problem: ConeProblem, sweeps: int) -> np.ndarray:
    """Contact after contact, gamma_i <- P_C(gamma_i - rho_i (g_i + s_i)): another method."""
    N, gamma = problem.operator.matrix, np.zeros_like(problem.b)
    m = len(gamma)
    for _ in range(sweeps):
        for i in range(m):
            rows = slice(3 * i, 3 * i + 3)
            g = (N[rows] @ gamma.ravel() + problem.b[i])[None]
            rho = 1.0 / np.linalg.norm(N[rows, rows], 2)
            mu = problem.mu[i : i + 1]
            gamma[i] = projected(gamma[i : i + 1] - rho * lifted(g, mu), mu)[0]
    return gamma


# ---- one contact, closed form --------------------------------------------------------------

N_NORMAL, N_TANGENT = 2.0, 7.0  # a solid sphere on a wall: 1/m and 7/(2 m)


def one_contact(b: list[float], mu: float, **options) -> SolveReport:
    N = np.diag([N_NORMAL, N_TANGENT, N_TANGENT])
    problem = dense_problem(N, np.array([b]), np.array([mu]))
    return solve(problem, tolerance=tight(1e-11), **options)


@pytest.mark.parametrize("mu", [1e-3, 0.3, 2.0, 10.0])
def test_sliding_contact_does_not_open_and_drags_with_mu_times_its_load(mu):
    """gamma_n = -b_n/N_n and g_n = 0; |g_t| = |b_t| - mu N_t gamma_n along b_t."""
    load = 1.0 / N_NORMAL
    slip = mu * N_TANGENT * load + 2.0
    report = one_contact([-1.0, 0.6 * slip, 0.8 * slip], mu)
    assert report.converged
    scale = slip * (1 + mu)  # what the tolerance, in v_ref, leaves along either axis
    expected = load * np.array([1.0, -0.6 * mu, -0.8 * mu])
    np.testing.assert_allclose(report.impulse[0], expected, rtol=0, atol=1e-10 * scale)
    np.testing.assert_allclose(report.velocity[0], [0.0, 1.2, 1.6], rtol=0, atol=1e-9 * scale)


def test_contact_sticks_up_to_mu_times_its_load_and_slides_above():
    """The limit is |b_t|/N_t = mu |b_n|/N_n, on either side of which slip is known."""
    mu, load = 0.4, 1.0 / N_NORMAL
    limit = mu * load * N_TANGENT
    below = one_contact([-1.0, (1 - 1e-6) * limit, 0.0], mu)
    np.testing.assert_allclose(below.velocity, 0.0, atol=1e-9)
    above = one_contact([-1.0, (1 + 1e-6) * limit, 0.0], mu)
    np.testing.assert_allclose(above.velocity[0], [0.0, 1e-6 * limit, 0.0], atol=1e-9)


def test_contact_that_parts_more_slowly_than_it_slides_is_not_pushed():
    """0 < b_n < mu |b_t|: under Coulomb's law nothing happens, the relaxation pushes."""
    N = np.diag([N_NORMAL, N_TANGENT, N_TANGENT])
    problem = dense_problem(N, np.array([[0.1, 1.0, 0.0]]), np.array([0.5]))
    assert solve(problem).impulse.tobytes() == np.zeros((1, 3)).tobytes()
    assert cone_solver().solve(problem, np.zeros((1, 3))).impulse[0, 0] > 0.1 * 1.0 / N_NORMAL


# ---- many contacts -------------------------------------------------------------------------


@pytest.mark.parametrize("mu", [1e-3, 0.3, 0.7, 1.5])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_problem_obeys_the_law_by_its_natural_map(mu, seed):
    """Solved to 1e-9 v_ref. A point within delta of complementary has a natural map of the order
    of delta and of the square root of the work, which the bound allows for."""
    problem = random_problem(15, seed, mu)
    report = solve(problem)
    assert report.converged
    assert report.outer > 1
    assert natural_map(problem, report.impulse) <= 1e-4 * problem.velocity_scale
    assert natural_map(problem, report.impulse, "ccp") > 1e-4 * problem.velocity_scale
    g = (problem.operator.matrix @ report.impulse.ravel()).reshape(-1, 3) + problem.b
    np.testing.assert_allclose(report.velocity, g, atol=1e-13 * problem.velocity_scale)
    sliding = np.linalg.norm(report.impulse[:, 1:], axis=1) > 0.1 * mu * report.impulse[:, 0]
    assert np.count_nonzero(sliding & (np.abs(g[:, 0]) < 1e-6)) >= 3


def test_residuals_are_those_of_the_law():
    """primal, dual = max(0, -g_n), complementarity and objective of any impulse, as defined."""
    rng = np.random.default_rng(5)
    problem = random_problem(10, 4, np.linspace(0.0, 1.0, 10))
    gamma = projected(rng.normal(size=(10, 3)), problem.mu)
    N, b, mu = problem.operator.matrix, problem.b, problem.mu
    g = (N @ gamma.ravel()).reshape(10, 3) + b
    found = law_residuals(problem, gamma, g)
    assert found.dual == pytest.approx(np.max(-g[:, 0]), rel=1e-13)
    work = np.sum(gamma * lifted(g, mu), axis=1)
    assert found.complementarity == pytest.approx(np.max(np.abs(work)), rel=1e-13)
    objective = 0.5 * gamma.ravel() @ N @ gamma.ravel() + b.ravel() @ gamma.ravel()
    assert found.objective == pytest.approx(objective, rel=1e-13)
    assert found.primal <= 4 * EPS * np.abs(gamma).max()


@pytest.mark.parametrize("mu", [0.1, 0.3, None], ids=["0.1", "0.3", "mixed"])
def test_contact_by_contact_iteration_finds_the_same_velocities(mu):
    """At moderate mu and N of full rank solutions are unique; both are solved far below 1e-6."""
    friction = np.tile([0.0, 0.1, 0.4], 4) if mu is None else mu
    problem = random_problem(12, 7, friction)
    twin = gauss_seidel(problem, 300)
    assert natural_map(problem, twin) <= 1e-9 * problem.velocity_scale
    report = solve(problem, tolerance=tight(1e-11))
    assert report.converged
    g = (problem.operator.matrix @ twin.ravel()).reshape(-1, 3) + problem.b
    np.testing.assert_allclose(report.velocity, g, rtol=0, atol=1e-6 * problem.velocity_scale)


def test_contacts_without_friction_among_others_carry_no_tangential_impulse():
    mu = np.tile([0.0, 0.5], 8)
    problem = random_problem(16, 9, mu)
    report = solve(problem)
    assert report.converged
    assert not report.impulse[mu == 0.0, 1:].any()
    slips = np.linalg.norm(report.velocity[:, 1:], axis=1) > 0.1
    loaded = report.impulse[:, 0] > 1e-3
    for kind in (mu == 0.0, mu > 0.0):
        assert np.count_nonzero(kind & slips & loaded) >= 2
    closed = report.velocity[slips & loaded, 0]
    np.testing.assert_allclose(closed, 0.0, atol=1e-5 * problem.velocity_scale)


def test_both_laws_agree_where_contacts_stick_or_part_fast():
    """A solution made first: impulses inside their cones with g = 0, or none with g_n > mu |g_t|.

    It solves both problems, so the outer iteration must end where the cone solver does.
    """
    m, mu = 16, 0.5
    N, _, rng = random_matrix(m, 11)
    gamma = np.column_stack((rng.uniform(1, 2, m), rng.uniform(-0.3, 0.3, (m, 2))))
    g = np.column_stack((rng.uniform(1, 2, m), rng.uniform(-1, 1, (m, 2))))
    gamma[::4], g[np.arange(m) % 4 > 0] = 0.0, 0.0
    problem = dense_problem(N, g - (N @ gamma.ravel()).reshape(m, 3), np.full(m, mu))
    for found in (solve(problem), cone_solver().solve(problem, np.zeros((m, 3)))):
        assert found.converged
        np.testing.assert_allclose(found.velocity, g, rtol=0, atol=1e-6 * problem.velocity_scale)


# ---- nothing to do -------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [1, 3])
def test_without_friction_the_bits_are_the_cone_solvers(columns):
    rng = np.random.default_rng(13)
    D = rng.normal(size=(60, 10 * columns))
    b = (D.T @ rng.normal(size=60)).reshape(10, columns)
    problem = dense_problem(D.T @ D, b, np.zeros(10))
    law, plain = solve(problem), cone_solver().solve(problem, np.zeros_like(b))
    assert law.impulse.tobytes() == plain.impulse.tobytes()
    assert law.velocity.tobytes() == plain.velocity.tobytes()
    assert (law.outer, law.iterations, law.products) == (1, plain.iterations, plain.products)
    assert law.residuals == plain.residuals


@ranks_1_2_3
@pytest.mark.parametrize("columns", [1, 3])
def test_no_contacts_anywhere_is_solved_at_once(parallel, columns):
    empty = np.zeros((0, columns))
    operator = DenseDelassus(np.zeros((0, 0)), columns)
    report = solve(ConeProblem(operator, empty, np.zeros(0), 1.0, 1.0, parallel))
    assert report.converged
    assert report.outer == 1
    assert report.impulse.shape == (0, columns)


def test_solution_as_a_guess_costs_one_cone_problem_and_no_iteration():
    problem = random_problem(15, 1, 0.3)
    report = solve(problem)
    again = solve(problem, report.impulse, tolerance=tight(1.1e-9))
    assert (again.outer, again.iterations) == (1, 0)
    scale = 4 * EPS * np.abs(report.impulse).max()  # of projecting it once more
    np.testing.assert_allclose(again.impulse, report.impulse, rtol=0, atol=scale)


# ---- counts and limits ---------------------------------------------------------------------


class Watching:
    """Passes cone problems on and keeps what was asked and answered."""

    def __init__(self, solver: Apgd) -> None:
        self.solver, self.tolerances, self.reports = solver, [], []

    def solve(self, problem, guess, lipschitz=None, tolerance=None):
        self.tolerances.append(tolerance)
        report = self.solver.solve(problem, guess, lipschitz, tolerance)
        self.reports.append(
            replace(report, refinements=1, linear_iterations=2, linear_residual=len(self.reports))
        )
        return self.reports[-1]

    def destroy(self) -> None:
        self.solver = None


def test_counts_are_sums_over_cone_problems_solved_from_coarse_to_fine():
    inner = Watching(cone_solver())
    problem = random_problem(15, 2, 0.5)
    law = Coulomb(inner, tight())
    report = law.solve(problem, np.zeros_like(problem.b))
    assert report.outer == len(inner.reports) == report.refinements > 2
    assert report.iterations == sum(r.iterations for r in inner.reports)
    assert report.products == sum(r.products for r in inner.reports) + 1
    assert report.linear_iterations == 2 * len(inner.reports)
    assert report.linear_residual == len(inner.reports) - 1
    assert report.seconds["solve"] == pytest.approx(
        sum(r.seconds["solve"] for r in inner.reports), rel=1e-12
    )
    assert report.history.shape == (report.outer, 4)
    assert report.history[-1, 0] == report.iterations
    assert report.history[-1, 1] == report.residuals.dual
    values = [tolerance.value for tolerance in inner.tolerances]
    assert values == sorted(values, reverse=True)
    assert values[0] > 100 * values[-1] >= 19e-9
    law.destroy()
    assert inner.solver is None


def test_limit_of_outer_iterations_leaves_the_best_iterate_and_says_so():
    problem = random_problem(15, 2, 1.5)
    report = solve(problem, max_outer=3)
    assert not report.converged
    assert report.reason == "reached the limit of 3 cone problems (max_outer)"
    assert 3 <= report.outer <= 13
    scale = problem.velocity_scale * np.array([1.0, problem.impulse_scale])
    merits = (report.history[:, 1:3] / scale).max(axis=1)
    found = np.array([report.residuals.dual, report.residuals.weighted_work]) / scale
    assert found.max() == merits.min()
    again = law_residuals(problem, report.impulse, report.velocity)
    assert again == report.residuals


def test_work_that_cone_problems_may_keep_follows_the_velocities_asked_for():
    """A loose complementarity (1e-2) beside a tight velocity (1e-6 v_ref): the bias contracts only
    if the cone problems' work is held to what such velocities mean."""
    problem = random_problem(15, 2, 0.5)
    inner = Watching(cone_solver())
    wanted = Tolerance(1e-6, "scaled", 1e-2)
    report = Coulomb(inner, wanted).solve(problem, np.zeros_like(problem.b))
    assert report.converged
    for tolerance in inner.tolerances:
        assert tolerance.relative_work <= 10.0 * tolerance.value


def test_body_squeezed_between_closing_walls_has_no_solution_and_the_report_says_so():
    """Two opposite normals on one body, both closing: no impulse stops both."""
    D = np.array([[1.0, 0, 0, -1.0, 0, 0], [0, 1.0, 0, 0, 1.0, 0], [0, 0, 1.0, 0, 0, -1.0]])
    b = np.array([[-1.0, 0.5, 0.0], [-1.0, 0.5, 0.0]])
    problem = dense_problem(D.T @ D, b, np.full(2, 0.5))
    law = Coulomb(Apgd(ApgdOptions(max_iterations=200)), Tolerance())
    report = law.solve(problem, np.zeros_like(b))
    assert not report.converged
    assert report.reason.endswith("reached the iteration limit")
    assert report.outer < 50
    assert np.isfinite(report.impulse).all()


def test_of_two_solutions_the_guess_decides():
    """N_nt = 1.5 couples a slip to the load: parting and sticking both obey the law (mu = 1).

    gamma = 0 with g = b, and gamma = -N^-1 b with g = 0.
    """
    N = np.array([[1.0, 1.5, 0.0], [1.5, 4.0, 0.0], [0.0, 0.0, 1.0]])
    b = np.array([[0.05, 1.0, 0.0]])
    problem = dense_problem(N, b, np.array([1.0]))
    sticking = -np.linalg.solve(N, b[0])[None]
    assert np.linalg.norm(sticking[0, 1:]) < sticking[0, 0]
    parted, stuck = solve(problem), solve(problem, sticking)
    assert parted.converged
    assert stuck.converged
    assert not parted.impulse.any()
    np.testing.assert_allclose(parted.velocity, b, rtol=0, atol=2 * EPS)
    np.testing.assert_allclose(stuck.velocity, 0.0, atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_guess_that_is_not_finite_starts_from_zero(bad):
    problem = random_problem(15, 1, 0.3)
    guess = np.zeros_like(problem.b)
    guess[3] = bad
    assert solve(problem, guess).impulse.tobytes() == solve(problem).impulse.tobytes()


def test_not_a_number_in_the_problem_ends_the_solve_with_a_finite_impulse():
    problem = random_problem(15, 1, 0.3)
    problem.b[4, 1] = np.nan
    report = solve(problem)
    assert not report.converged
    assert report.outer == 1
    assert np.isfinite(report.impulse).all()


def test_bits_repeat():
    problem = random_problem(30, 5, 0.8)
    assert solve(problem).impulse.tobytes() == solve(problem).impulse.tobytes()


# ---- in a simulation -----------------------------------------------------------------------

G, R = 9.81, 0.1
STRICT = {"law": "coulomb", "tolerance": 1e-10, "complementarity": 1e-10}


def groove(half_angle: float) -> list[dict]:
    """A V along y: two planes, each tilted from the vertical by the half angle."""
    c, s = np.cos(half_angle), np.sin(half_angle)
    sides = ((c, "left"), (-c, "right"))
    return [{**FLOOR, "name": name, "normal": [x, 0.0, s]} for x, name in sides]


def test_wedge_holds_what_friction_can_and_slows_a_sliding_sphere_by_mu_g_over_its_sine():
    """Each side bears m g/(2 sin a); sliding along the groove both drag with mu of that.

    Work within 1e-10 v0 gamma_ref at a load of m g h leaves velocities of 1e-10 v0^2/(g h) a step.
    """
    mu, a, v0, h, n = 0.3, np.radians(30.0), 1.0, 1e-3, 20
    scenario = scene(step=h, mu=mu, walls=groove(a), contact=STRICT)
    simulation = simulation_of(scenario, [0, 0, R / np.sin(a)], R, velocity=[0, v0, 0])
    for _ in range(n):
        assert simulation.step().converged
    speed, left = v0 - mu * G / np.sin(a) * n * h, 1e-10 * v0**2 / (G * h)
    np.testing.assert_allclose(
        simulation.state.bodies.velocity[0], [0.0, speed, 0.0], rtol=0, atol=n * left
    )
    height = simulation.state.bodies.position[0, 2]
    assert height == pytest.approx(R / np.sin(a), abs=n * h * left)


@pytest.mark.parametrize("mu", [0.2, 0.5, 2.0])
def test_sphere_thrown_into_a_wedge_jams_and_loses_energy(mu):
    """Its two contacts press on each other where mu > tan(20 deg): N is singular, impulses are not
    unique, and from the gap 0 a solution exists (all at rest). Twenty throws, one step each."""
    a, rng = np.radians(20.0), np.random.default_rng(17)
    scenario = scene(step=1e-3, mu=mu, walls=groove(a), contact=STRICT)
    sliding = 0
    for _ in range(20):
        throw = rng.normal(size=3) * [0.3, 8.0, 0.3] - [0, 0, 2]
        spin = rng.normal(size=3)
        start = [0.0, 0.0, R / np.sin(a)]
        simulation = simulation_of(scenario, start, R, velocity=throw, angular_velocity=spin)
        seen = watch(simulation)
        record = simulation.step()
        assert record.converged, record.reason
        assert record.contacts == 2
        assert record.energy_balance < 0
        assert record.energy_change == pytest.approx(record.energy_balance, rel=1e-10)
        g = seen.report.velocity
        assert np.all(g[:, 0] >= -1e-10)
        loaded = seen.report.impulse[:, 0] > 1e-3
        slips = loaded & (np.linalg.norm(g[:, 1:], axis=1) > 1e-3)
        np.testing.assert_allclose(g[slips, 0], 0.0, atol=1e-7)
        sliding += np.count_nonzero(slips)
    # At mu = 2 sticking obeys the law always, but is not the only solution.
    assert sliding > 0 or mu == 2.0


def heap(**contact) -> dict:
    group = {
        "material": "m",
        "count": 60,
        "radius": 0.05,
        "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [0.63, 0.63, 0.3], "jitter": 0.5}},
        "velocity": [1.0, 0.0, -1.0],
        "velocity_jitter": 1.0,
    }
    box = {
        "shape": "box", "name": "box", "material": "m",
        "min": [0, 0, 0], "max": [0.63, 0.63, 2], "open": ["z_max"],
    }  # fmt: skip
    return {"step": 2e-3, "mu": 0.4, "bodies": [group], "walls": [box], "contact": contact}


@ranks_1_2_3
def test_shaken_heap_obeys_the_law_on_any_number_of_ranks(parallel):
    """Twenty steps to 1e-5: converged, energy accounted for to round-off, decisions alike on all
    ranks, and the law's residuals by their definition within the tolerance."""
    from dem_mpi.simulation import Simulation

    scenario = scene(**heap(law="coulomb", tolerance=1e-5, complementarity=1e-5))
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    seen = watch(simulation)
    outer = 0
    for _ in range(20):
        record = simulation.step()
        assert record.converged, record.reason
        scale = max(record.kinetic_energy, abs(record.energy_change))
        assert record.energy_change == pytest.approx(record.energy_balance, abs=1e-11 * scale)
        outer = max(outer, record.outer)
    assert outer > 1
    agree = parallel.allgather(np.array([float(seen.report.outer), float(seen.report.iterations)]))
    assert not np.ptp(agree, axis=0).any()
    gamma, g, mu = seen.report.impulse, seen.report.velocity, seen.problem.mu
    work = np.abs(np.sum(gamma * lifted(g, mu), axis=1))
    limit = 1e-5 * seen.problem.velocity_scale * seen.problem.impulse_scale
    assert work.max(initial=0.0) <= limit
    assert np.max(-g[:, 0], initial=0.0) <= 1e-5
    sliding = (np.linalg.norm(g[:, 1:], axis=1) > 1e-3) & (gamma[:, 0] > 0)
    assert len(gathered(parallel, g[sliding])) > 10


def heap_problem(parallel: Parallel):
    """Collective. The cone problem of a step of the heap and its solution to 1e-5."""
    from dem_mpi.simulation import Simulation

    scenario = scene(**heap(law="coulomb", tolerance=1e-5, complementarity=1e-5))
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    seen = watch(simulation)
    for _ in range(8):
        assert simulation.step().converged
    return seen.problem, seen.report.impulse


@ranks_1_2_3
def test_newton_steps_take_the_law_from_a_coarse_solution_to_round_off(parallel):
    """From 1e-5 m/s to 1e-10 v_ref: Newton's method doubles digits where the fixed point's rate
    is that of its contraction. Residuals are held against the law's definition."""
    from dem_mpi.solvers.coulomb_newton import ProximalNewton

    problem, coarse = heap_problem(parallel)
    before = coarse.copy()
    wanted = tight(1e-10)
    newton = ProximalNewton()
    found = newton.improve(problem, coarse, wanted, 60)
    again = newton.improve(problem, coarse, wanted, 60)  # on the matrix that was kept
    newton.destroy()
    assert coarse.tobytes() == before.tobytes()
    assert found.impulse.tobytes() == again.impulse.tobytes()
    assert found.merit <= 1.0
    assert 1 <= found.factorisations <= 60
    gamma, g, mu = found.impulse, found.velocity, problem.mu
    push = np.linalg.norm(gamma[:, 1:], axis=1)
    assert np.all(push <= mu * gamma[:, 0] * (1 + 4 * EPS))
    work = np.abs(np.sum(gamma * lifted(g, mu), axis=1))
    assert work.max(initial=0.0) <= 1e-10 * problem.velocity_scale * problem.impulse_scale
    assert np.max(-g[:, 0], initial=0.0) <= 1e-10 * problem.velocity_scale
    sliding = (np.linalg.norm(g[:, 1:], axis=1) > 1e-3) & (gamma[:, 0] > 0)
    assert parallel.sum(np.count_nonzero(sliding)) > 5
    agree = parallel.allgather(np.array([found.merit, float(found.factorisations)]))
    assert not np.ptp(agree, axis=0).any()


@ranks_1_2_3
def test_newton_steps_end_at_their_budget_with_the_best_point(parallel):
    """One factorisation from zero is not enough; what it leaves is no worse than zero was."""
    from dem_mpi.solvers.coulomb_newton import ProximalNewton

    problem, coarse = heap_problem(parallel)
    nothing = np.zeros_like(coarse)
    start = law_residuals(problem, nothing, problem.b)
    newton, wanted = ProximalNewton(), tight(1e-10)
    found = newton.improve(problem, nothing, wanted, 1)
    newton.destroy()
    assert found.factorisations == 1
    assert 1.0 < found.merit <= wanted.merit(start, problem)
    assert np.isfinite(found.impulse).all()


@ranks_1_2_3
def test_newton_steps_end_a_solve_whose_cone_problems_ran_out(parallel):
    """Two cone problems do not take the law from 1e-5 m/s to 1e-10 v_ref, Newton's method does.
    Its linear systems are reported though the cone solver has none."""
    problem, coarse = heap_problem(parallel)
    law = Coulomb(cone_solver(), tight(1e-10), CoulombOptions(max_outer=2))
    report = law.solve(problem, coarse)
    law.destroy()
    assert report.converged, report.reason
    assert (report.outer, report.solver, report.form) == (2, "apgd", "contact")
    assert report.factorisations >= 1
    assert report.iterations == report.history[-1, 0] + report.factorisations
    assert report.factor_entries >= 9 * parallel.sum(problem.contacts)
    # Of direct solves in double precision: some 1e-13 at the conditions of these matrices.
    assert 0.0 < report.linear_residual <= 1e-8
    g = np.empty_like(report.impulse)
    problem.operator.apply(report.impulse, g)
    assert law_residuals(problem, report.impulse, g + problem.b) == report.residuals
