"""The friction cone: projection, residuals, tolerance, scales of the problem."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dem_mpi import _kernels_solver as kernels
from dem_mpi.cone import ConeProblem, Residuals, Tolerance, evaluate, median_of_positive
from dem_mpi.parallel import Parallel

from contact_twins import DenseDelassus, projected, residuals

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])
every_mu = pytest.mark.parametrize("mu", [0.0, 1e-3, 0.5, 2.0])

ROUNDING = 1e-14  # of a handful of operations, relative to the length of the row


def impulses(count: int = 2000) -> np.ndarray:
    """Rows of very different lengths inside, outside, below and on the axes of a cone."""
    rng = np.random.default_rng(21)
    rows = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-8, 8, (count, 1))
    rows[: count // 10, 1:] *= 1e-4
    special = [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, -1], [-0.0, 0, 0], [1, 1, 0]]
    return np.concatenate((rows, np.array(special, dtype=float)))


def project(gamma: np.ndarray, mu: np.ndarray) -> np.ndarray:
    result = np.ascontiguousarray(gamma, dtype=np.float64).copy()
    kernels.project.serial(result, mu)
    return result


def length(rows: np.ndarray) -> np.ndarray:
    return np.linalg.norm(rows, axis=1)


# ---- projection ----------------------------------------------------------------------------


@every_mu
def test_projection_lands_in_the_cone_and_leaves_its_points_alone(mu):
    gamma, friction = impulses(), np.full(len(impulses()), mu)
    once = project(gamma, friction)
    outside = length(once[:, 1:]) - mu * once[:, 0]
    assert np.all(outside <= ROUNDING * length(once))
    assert np.all(once[:, 0] >= 0.0)
    assert np.all(length(project(once, friction) - once) <= ROUNDING * length(once))
    inside = length(gamma[:, 1:]) < mu * gamma[:, 0] * (1.0 - ROUNDING)
    assert np.array_equal(once[inside], gamma[inside])
    if mu > 0.0:
        assert inside.any()


@every_mu
def test_projection_splits_a_row_into_orthogonal_parts_of_cone_and_polar_cone(mu):
    """J. J. Moreau: x = P(x) + r with r in {r : mu |r_t| <= -r_n} polar to the cone, P(x).r = 0."""
    gamma, friction = impulses(), np.full(len(impulses()), mu)
    image = project(gamma, friction)
    rest = gamma - image
    assert np.all(np.abs(np.sum(image * rest, axis=1)) <= ROUNDING * length(gamma) ** 2)
    # (p_t, p_n) with |p_t| <= mu p_n has p.r <= 0 for all p iff r_n + mu |r_t| <= 0.
    assert np.all(rest[:, 0] + mu * length(rest[:, 1:]) <= ROUNDING * length(gamma))


@every_mu
def test_projection_equals_its_twin(mu):
    gamma, friction = impulses(), np.full(len(impulses()), mu)
    difference = project(gamma, friction) - projected(gamma, friction)
    assert np.all(length(difference) <= ROUNDING * length(gamma))


def test_projection_uses_each_contact_s_own_friction():
    rng = np.random.default_rng(22)
    mu = rng.choice([0.0, 1e-3, 0.3, 2.0], 500)
    gamma = rng.normal(size=(500, 3))
    assert np.allclose(project(gamma, mu), projected(gamma, mu), rtol=0.0, atol=ROUNDING)


def test_projection_without_friction_is_the_positive_part():
    gamma = np.array([[-1.0], [0.0], [2.5], [-0.0]])
    assert project(gamma, np.zeros(4)).ravel().tolist() == [0.0, 0.0, 2.5, 0.0]


@every_mu
@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("normal", [1.0, -1.0])
def test_projection_keeps_not_a_number(mu, place, normal):
    gamma = np.array([[normal, 0.1, 0.2]])
    gamma[0, place] = np.nan
    assert np.isnan(project(gamma, np.array([mu]))).any()


def test_projection_without_friction_keeps_not_a_number():
    assert np.isnan(project(np.array([[np.nan]]), np.zeros(1)))[0, 0]


@every_mu
@pytest.mark.parametrize("ratio", [1.0, 0.3, 4.0])
def test_gradient_step_projects_orthogonally_in_the_scaled_variables(mu, ratio):
    """z = gamma / sqrt(s): y - s g(y) goes to the nearest point of the cone in |dz|."""
    rng = np.random.default_rng(23)
    m = 300
    gamma, old, g, g_old = rng.normal(size=(4, m, 3))
    s = np.repeat(rng.uniform(0.5, 2.0, (m, 1)), 3, axis=1)
    s[:, 1:] *= ratio
    friction, beta, step = np.full(m, mu), 0.4, 0.7
    new, d = np.empty((2, m, 3))
    square, move = kernels.gradient_step.serial(
        gamma, old, g, g_old, beta, step, s, friction, new, d, np.zeros((1, 2))
    )
    y = gamma + beta * (gamma - old)
    slope = g + beta * (g - g_old)
    root = np.sqrt(s)
    # |gamma_t| <= mu gamma_n is |z_t| <= mu sqrt(s_n / s_t) z_n.
    expected = root * projected((y - step * s * slope) / root, mu * root[:, 0] / root[:, 1])
    assert np.allclose(new, expected, rtol=0.0, atol=1e-13)
    assert np.allclose(d, new - y, rtol=0.0, atol=1e-15)
    assert square == pytest.approx(np.sum((new - y) ** 2 / s), rel=1e-13)
    assert move == pytest.approx(np.sum(slope * (new - gamma)), rel=1e-12)
    assert np.all(length(new[:, 1:]) - mu * new[:, 0] <= ROUNDING * length(new))


# ---- residuals -----------------------------------------------------------------------------


def random_problem(m: int, columns: int = 3, seed: int = 24) -> tuple[np.ndarray, ...]:
    """N (symmetric, semidefinite), b, mu with zeros among them, and an impulse in the cones."""
    rng = np.random.default_rng(seed)
    D = rng.normal(size=(columns * m, max(1, 2 * m)))
    b = rng.normal(size=(m, columns))
    mu = rng.choice([0.0, 1e-3, 0.3, 2.0], m) if columns == 3 else np.zeros(m)
    return D @ D.T / m, b, mu, project(rng.normal(size=(m, columns)), mu)


def share(parallel: Parallel, m: int) -> slice:
    """This rank's rows: uneven, none on some ranks where there are few."""
    edges = (m * (np.arange(parallel.size + 1) / parallel.size) ** 2).astype(int)
    return slice(edges[parallel.rank], edges[parallel.rank + 1])


def part(parallel: Parallel, N: np.ndarray, b: np.ndarray, mu: np.ndarray) -> ConeProblem:
    """This rank's rows of a problem whose product is never asked for."""
    rows = share(parallel, len(b))
    operator = DenseDelassus(N, b.shape[1])
    return ConeProblem(operator, b[rows], mu[rows], 1.0, 1.0, parallel)


@ranks_1_2_3_8
@pytest.mark.parametrize("columns", [3, 1], ids=["mu", "smooth"])
@pytest.mark.parametrize("m", [40, 1])
def test_residuals_equal_their_definitions_on_any_ranks(parallel, columns, m):
    N, b, mu, gamma = random_problem(m, columns)
    g = (N @ gamma.ravel()).reshape(b.shape) + b
    rows = share(parallel, m)
    found = dataclasses.asdict(evaluate(part(parallel, N, b, mu), gamma[rows], g[rows]))
    for name, expected in residuals(N, b, mu, gamma).items():
        # Sums of 40 terms of order 1 to 10.
        assert found[name] == pytest.approx(expected, rel=1e-12, abs=1e-13), name


def test_primal_residual_measures_leaving_the_cone_and_pulling():
    N, b, mu = np.eye(3), np.zeros((1, 3)), np.array([0.5])
    for gamma, expected in (
        ([2.0, 0.6, 0.8], 0.0),
        ([1.0, 0.6, 0.8], 0.5),
        ([-0.25, 0.0, 0.0], 0.25),
        ([0.0, 3.0, 4.0], 5.0),
    ):
        impulse = np.array([gamma])
        found = evaluate(part(Parallel.alone(), N, b, mu), impulse, impulse)
        assert found.primal == pytest.approx(expected, abs=1e-15)


def test_dual_residual_is_a_speed_of_overlap_even_without_friction():
    """max(0, mu |g_t| - g_n): for mu = 0 the approach speed; S. De's 2.36 leaves such out."""
    velocity = np.array([[-0.3, 4.0, 3.0]])
    problem = part(Parallel.alone(), np.eye(3), velocity, np.zeros(1))
    found = evaluate(problem, np.zeros((1, 3)), velocity)
    assert found.dual == 0.3
    assert found.thesis == 0.0
    rough = dataclasses.replace(problem, mu=np.array([0.1]))
    found = evaluate(rough, np.zeros((1, 3)), velocity)
    assert found.dual == pytest.approx(0.8, rel=1e-15)
    assert found.thesis == pytest.approx(8.0, rel=1e-15)


def test_complementarity_of_contacts_does_not_cancel():
    """Two contacts of opposite work: S. De's mean of a signed sum is blind to them."""
    gamma = np.array([[1.0, 0, 0], [1.0, 0, 0]])
    g = np.array([[0.5, 0, 0], [-0.5, 0, 0]])
    problem = part(Parallel.alone(), np.eye(6), g - gamma, np.ones(2))
    found = evaluate(problem, gamma, g)
    assert found.complementarity == 0.5
    assert found.thesis == 0.5  # the dual residual; the mean is 0


@ranks_1_2_3_8
@pytest.mark.parametrize("where", ["first", "last"])
def test_not_a_number_on_one_rank_is_seen_by_all(parallel, where):
    N, b, mu, gamma = random_problem(60)
    g = (N @ gamma.ravel()).reshape(b.shape) + b
    rows = share(parallel, 60)
    mine = g[rows].copy()
    holders = np.flatnonzero(parallel.allgather(np.array([len(mine)]))[:, 0])
    if parallel.rank == holders[0 if where == "first" else -1]:
        mine[0, 1] = np.nan
    found = evaluate(part(parallel, N, b, mu), gamma[rows], mine)
    assert not found.finite
    assert found.dual == np.inf
    everywhere = parallel.allgather(np.array([found.dual, found.complementarity]))
    assert np.array_equal(everywhere, np.broadcast_to(everywhere[0], everywhere.shape))
    for kind in ("absolute", "scaled", "thesis"):
        merit = Tolerance(kind=kind).merit(found, part(parallel, N, b, mu))
        assert not merit <= 1.0


def test_residuals_of_no_contacts_are_zero():
    problem = part(Parallel.alone(), np.zeros((0, 0)), np.zeros((0, 3)), np.zeros(0))
    found = evaluate(problem, np.zeros((0, 3)), np.zeros((0, 3)))
    assert found == Residuals(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert found.finite


# ---- tolerance -----------------------------------------------------------------------------


def test_tolerance_kinds_compare_with_their_own_scales():
    problem = ConeProblem(
        DenseDelassus(np.eye(3), 3), np.zeros((1, 3)), np.ones(1), 0.5, 0.2, Parallel.alone()
    )
    found = Residuals(
        0.0, dual=2e-3, complementarity=1e-9, weighted_work=3e-3, objective=-1.0, thesis=7e-3
    )
    work = 1e-2 * 0.5 * 0.2
    absolute = Tolerance(1e-3, "absolute", 1e-2)
    assert absolute.merit(found, problem) == pytest.approx(max(2e-3 / 1e-3, 3e-3 / work))
    scaled = Tolerance(1e-4, "scaled", 1.0)
    assert scaled.merit(found, problem) == pytest.approx(max(2e-3 / (1e-4 * 0.5), 3e-3 / 0.1))
    assert Tolerance(1e-2, "thesis").merit(found, problem) == pytest.approx(0.7)


def test_work_of_a_light_contact_counts_by_its_own_impulses():
    """Of three contacts with N_ii = 1, 2, 1e6 1/kg the last has a gamma_ref of its own."""
    N = np.diag([1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 1e6, 1e6, 1e6])
    alone = Parallel.alone()
    problem = ConeProblem(DenseDelassus(N, 3), np.zeros((3, 3)), np.ones(3), 4.0, 2.0, alone)
    assert problem.weight == pytest.approx([1.0, 1.0, 5e5])
    impulse, velocity = np.zeros((3, 3)), np.zeros((3, 3))
    impulse[:, 0], velocity[:, 0] = [1.0, 1.0, 1e-6], [0.1, 0.2, 3.0]
    found = evaluate(problem, impulse, velocity)
    assert (found.complementarity, found.weighted_work) == pytest.approx((0.2, 1.5))


def test_tolerance_without_a_velocity_scale_asks_for_the_dual_alone():
    problem = ConeProblem(
        DenseDelassus(np.eye(3), 3), np.zeros((1, 3)), np.ones(1), 0.0, 0.0, Parallel.alone()
    )
    found = Residuals(
        0.0, dual=5e-5, complementarity=1.0, weighted_work=1.0, objective=0.0, thesis=0.0
    )
    assert Tolerance(1e-4).merit(found, problem) == 0.5


# ---- median --------------------------------------------------------------------------------


@ranks_1_2_3_8
@pytest.mark.parametrize("count", [1, 2, 7, 100, 1001])
def test_median_is_the_exact_lower_one_on_any_ranks(parallel, count):
    rng = np.random.default_rng(count)
    values = 10.0 ** rng.uniform(-300, 300, count)
    values[: count // 3] = values[-1]
    mine = values[share(parallel, count)]
    expected = np.sort(values)[(count - 1) // 2]
    assert median_of_positive(mine, parallel) == expected
    # Rows of a diagonal are as good as a flat array.
    if count % 7 == 0:
        rows = mine if parallel.rank else values.reshape(-1, 7)
        alone = Parallel.alone()
        assert median_of_positive(rows if rows.ndim == 2 else values, alone) == expected


@ranks_1_2_3_8
def test_median_of_nothing_is_one(parallel):
    assert median_of_positive(np.zeros((0, 3)), parallel) == 1.0


# ---- energy --------------------------------------------------------------------------------


def test_kinetic_energy_gained_equals_the_work_of_the_impulses():
    """KE(v_hat + M^-1 D gamma) - KE(v_hat) = -gamma.N gamma/2 + gamma.g - sum gamma_n b_phi.

    It holds for any impulse, solved or not, with b = (b_phi, 0, 0) + D^T v_hat.
    """
    rng = np.random.default_rng(25)
    m, n = 40, 60
    D, mass = rng.normal(size=(n, 3 * m)), rng.uniform(0.1, 10.0, n)
    v, b_gap, gamma = rng.normal(size=n), rng.normal(size=m), rng.normal(size=(m, 3))
    N = D.T @ (D / mass[:, None])
    b = (D.T @ v).reshape(m, 3)
    b[:, 0] += b_gap
    g = (N @ gamma.ravel()).reshape(m, 3) + b
    after = v + (D @ gamma.ravel()) / mass
    gained = 0.5 * np.sum(mass * after**2) - 0.5 * np.sum(mass * v**2)
    problem = part(Parallel.alone(), N, b, np.full(m, 0.3))
    objective = evaluate(problem, gamma, g).objective
    work = np.sum(gamma * g)
    # work - objective = gamma.N gamma/2.
    bend = 2.0 * (work - objective)
    assert bend == pytest.approx(gamma.ravel() @ N @ gamma.ravel(), rel=1e-12)
    balance = -0.5 * bend + work - np.sum(gamma[:, 0] * b_gap)
    assert gained == pytest.approx(balance, rel=1e-12)
