"""Solutions held against solvers of other people: Clarabel for the convex problem, Siconos for
Coulomb's law.

Impulses of the convex problem need not be unique, N gamma and with it all contact velocities are.
So velocities are compared, in v_ref, the largest |b_i|. Clarabel stops at 1e-10 ... 5e-8 v_ref from
the solution; a few Newton steps from there, dense and by definition, show where it lies.

The piles of tests/data/fclib were settled by scripts/make_fclib_piles.py. They are hyperstatic:
impulses are up to hundreds of times what the weight asks for, and methods of first order slow.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from dem_mpi.cone import ConeProblem, Tolerance
from dem_mpi.fclib import COLUMNS, FclibProblem, Share, read_problem
from dem_mpi.parallel import Parallel
from dem_mpi.scene_models import Scip
from dem_mpi.solve import cone_problem
from dem_mpi.solvers.choice import SolverOptions, make_solver
from dem_mpi.solvers.coulomb import law_residuals
from dem_mpi.solvers.result import SolveReport

from launch import ROOT
from natural_map import natural_residual, refined


def _rivals():
    path = ROOT / "scripts" / "bench" / "lib" / "rivals.py"
    spec = importlib.util.spec_from_file_location("rivals", path)
    module = sys.modules["rivals"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


rivals = _rivals()
FILES = ROOT / "tests" / "data" / "fclib"
CAPSULES, BOXES = "Capsules-i125-1213", "Box_Stacks-i0122-82-5"

VELOCITY = 1e-8  # v_ref: the agreement that is asked for
LINEAR = 1e-8  # relative residual of every Newton system, to the end
RIVAL = 1e-7  # v_ref: how near Clarabel comes to the solution by itself
CERTAINTY = 1e-9  # v_ref: how sure the solution is after the Newton steps


@dataclass
class Case:
    """A problem in the form of the solvers and as matrices."""

    problem: ConeProblem
    N: sparse.csr_matrix
    D: sparse.csr_matrix | None = None
    inverse_mass: sparse.csr_matrix | None = None

    @property
    def scale(self) -> tuple[float, float]:
        return self.problem.velocity_scale, self.problem.impulse_scale


def posed(stored: FclibProblem) -> Case:
    """The problem of a file, or of matrices made up here."""
    from dem_mpi.sparse_delassus import FactoredDelassus, MatrixDelassus

    parallel = Parallel.alone()
    if stored.form == "local":
        operator = MatrixDelassus(stored, parallel)
        N, D, inverse = stored.delassus, None, None
    else:
        operator = FactoredDelassus(stored, parallel)
        D = stored.jacobian.T.tocsr()
        inverse = sparse.csr_matrix(np.linalg.inv(stored.mass.toarray()))
        N = (D.T @ inverse @ D).tocsr()
    problem = cone_problem(operator, operator.offset, stored.mu, parallel)
    return Case(problem, N, D, inverse)


def as_stored(name: str) -> Case:
    """The problem of a file as it is, its W not quite symmetric in one."""
    return posed(read_problem(Parallel.alone(), FILES / f"{name}.hdf5"))


def of_file(name: str, mu: Callable[[int], NDArray] | None = None) -> Case:
    """A stored problem, a local one with the symmetric part of its W; `mu` gives others."""
    stored = read_problem(Parallel.alone(), FILES / f"{name}.hdf5")
    if stored.form == "local":
        stored = replace(stored, delassus=(0.5 * (stored.delassus + stored.delassus.T)).tocsr())
    if mu is not None:
        stored = replace(stored, mu=mu(len(stored.mu)))
    return posed(stored)


def mixed(count: int) -> NDArray:
    """Every coefficient from none to more than one, a fifth of the contacts each."""
    return np.random.default_rng(7).choice([0.0, 1e-3, 0.1, 0.5, 1.2], count)


def random_packing(bodies: int, contacts: int, seed: int) -> Case:
    """Bodies of masses over two decades, joined at random: D has nothing of a packing's geometry.

    b_n < 0 pushes on most contacts. With more contacts than bodies N is singular.
    """
    rng = np.random.default_rng(seed)
    alone = Parallel.alone()
    blocks = []
    for mass in 10.0 ** rng.uniform(-1, 1, bodies):
        B = rng.normal(size=(6, 6))
        blocks.append(mass * (B @ B.T / 6 + np.eye(6)))
    D = np.zeros((6 * bodies, COLUMNS * contacts))
    for k in range(contacts):
        for body in rng.choice(bodies, 2, replace=False):
            D[6 * body : 6 * body + 6, 3 * k : 3 * k + 3] = rng.normal(size=(6, 3))
    # b = D^T v + r with r in C*: v = 0 up to there satisfies all, so that there is a solution.
    offset = (D.T @ rng.normal(size=6 * bodies)).reshape(-1, COLUMNS)
    offset[:, 0] += np.abs(rng.normal(size=contacts))
    return posed(
        FclibProblem(
            path=Path("random packing"),
            form="global",
            dimension=COLUMNS,
            contacts=Share.of(contacts, alone),
            mu=mixed(contacts),
            offset=offset,
            mass=sparse.block_diag(blocks, format="csr"),
            jacobian=sparse.csr_matrix(D.T),
            force=np.zeros(6 * bodies),
            bodies=Share.of(6 * bodies, alone),
        )
    )


CASES: dict[str, Callable[[], Case]] = {
    "box stacks": lambda: of_file(BOXES),
    "capsules": lambda: of_file(CAPSULES),
    "capsules, mixed friction": lambda: of_file(CAPSULES, mixed),
    "random, regular": lambda: random_packing(30, 20, 1),
    "random, singular": lambda: random_packing(12, 60, 2),
    "pile of 60": lambda: of_file("pile-60"),
    "pile of 60, mixed friction": lambda: of_file("pile-60", mixed),
    "pile of 200, no friction": lambda: of_file("pile-200", np.zeros),
    "pile of 200": lambda: of_file("pile-200"),
}
# What projected gradients solve to 1e-8 within 20,000 iterations.
FIRST_ORDER = (
    "box stacks",
    "capsules, mixed friction",
    "random, regular",
    "random, singular",
)


def solved(case: Case, options: SolverOptions, dual: float, complementarity: float) -> SolveReport:
    """Solve from zero to limits in v_ref and in v_ref gamma_ref."""
    rule = Tolerance(dual, "scaled", complementarity)
    method = make_solver(replace(options, tolerance=rule, max_iterations=20_000))
    try:
        return method.solve(case.problem, np.zeros_like(case.problem.b))
    finally:
        method.destroy()


def apart(case: Case, one: NDArray, other: NDArray) -> float:
    """The largest difference of two contact velocities, in v_ref."""
    return float(np.abs(one - other).max()) / case.problem.velocity_scale


# ---- the convex problem, against Clarabel ----------------------------------------------------


@cache
def by_clarabel(name: str) -> tuple[NDArray, float]:
    """Contact velocities (m, 3) of a case's solution, and how far Clarabel itself is off [v_ref].

    From both of its formulations: in the impulses and, where there are factors, in the velocities
    of the bodies.
    """
    pytest.importorskip("clarabel")
    case = CASES[name]()
    b, mu, v_ref = case.problem.b, case.problem.mu, case.problem.velocity_scale
    found = [rivals.clarabel_solve_matrix(case.N, b, mu, 1e-13)]
    if case.D is not None:
        found.append(rivals.clarabel_solve(case.D, case.inverse_mass, b, mu, 1e-13))
    N = case.N.toarray()
    exact = []
    for solution in found:
        assert solution.converged, solution.status
        velocity, residual = refined(N, b, mu, solution.impulse)
        exact.append((residual / v_ref, velocity))
    residual, velocity = min(exact, key=lambda entry: entry[0])
    assert residual <= CERTAINTY
    assert all(apart(case, velocity, other) <= CERTAINTY for _, other in exact)
    off = max(apart(case, velocity, solution.velocity) for solution in found)
    assert off <= RIVAL
    return velocity, off


@pytest.mark.parametrize("name", FIRST_ORDER)
def test_projected_gradients_find_the_velocities_of_clarabel(name):
    case = CASES[name]()
    report = solved(case, SolverOptions("apgd"), 1e-11, 1e-11)
    assert report.converged, report.reason
    assert apart(case, report.velocity, by_clarabel(name)[0]) <= VELOCITY


@pytest.mark.parametrize("form", ["contact", "velocity"])
@pytest.mark.parametrize("name", CASES)
def test_the_interior_point_method_finds_the_velocities_of_clarabel(name, form):
    """The limit on gamma.g is below the round-off of impulses a hundred times those of the weight.

    So that on hyperstatic piles it need not say converged; it returns the best that it found. An
    interior point's velocities are off by the root of gamma.g: the last digits are those of Newton
    steps on the natural map, and of systems that a proximal term keeps from becoming singular.
    """
    case = CASES[name]()
    if form == "velocity" and case.D is None:
        pytest.skip("a local problem has no bodies")
    # The settled piles of 200 take 40 to 80, as rounding has it: a contact or another changes late.
    scip = Scip(form=form, max_iterations=150)
    report = solved(case, SolverOptions("scip", scip=scip), 1e-12, 1e-15)
    exact, _ = by_clarabel(name)
    assert apart(case, report.velocity, exact) <= VELOCITY, report.reason
    assert report.residuals.dual <= 1e-12 * case.problem.velocity_scale
    assert report.linear_residual <= LINEAR


# ---- a problem without a solution ------------------------------------------------------------


def test_jammed_pile_has_no_solution_and_solvers_say_so():
    """A self-stress that overlaps reward: no impulse has a residual below some positive t.

    The solvers return finite impulses of a residual near t, say that they failed, and why.
    """
    pytest.importorskip("clarabel")
    case = of_file("pile-200-jammed")
    problem, v_ref = case.problem, case.problem.velocity_scale
    t = rivals.smallest_dual(case.D, case.inverse_mass, problem.b, problem.mu)
    assert 1e-9 * v_ref < t < 1e-6 * v_ref
    for solver in ("apgd", "scip"):
        report = solved(case, SolverOptions(solver), 0.5 * t / v_ref, 1e-4)
        assert not report.converged and report.reason
        assert np.isfinite(report.impulse).all() and np.isfinite(report.velocity).all()
        # Clarabel knows t to some 1e-10 v_ref.
        assert t - 1e-9 * v_ref <= report.residuals.dual <= 1e-5 * v_ref


def test_piles_that_are_solved_have_a_solution():
    pytest.importorskip("clarabel")
    for name in ("pile-60", "pile-200"):
        case = of_file(name)
        b, mu = case.problem.b, case.problem.mu
        t = rivals.smallest_dual(case.D, case.inverse_mass, b, mu)
        assert t <= 1e-9 * case.problem.velocity_scale


# ---- Coulomb's law, against Siconos ----------------------------------------------------------


def siconos(case: Case, tolerance: float, guess: NDArray | None = None, sweeps: int = 10_000):
    """Siconos's nonsmooth Gauss-Seidel from zero or a guess, its own definition of error."""
    pytest.importorskip("siconos.numerics", reason="the Debian package python3-siconos is absent")
    problem = case.problem
    return rivals.siconos_nsgs(case.N, problem.b, problem.mu, tolerance, guess, sweeps)


def elsewhere(case: Case) -> NDArray:
    """Impulses inside the cones that are no solution, of the size of those that are."""
    pushes = np.abs(np.random.default_rng(0).normal(size=case.problem.b.shape))
    return case.problem.impulse_scale * pushes * np.array([3.0, 0.1, 0.1])


def coulomb_residual(case: Case, impulse: NDArray) -> float:
    problem = case.problem
    return natural_residual(case.N, problem.b, problem.mu, impulse, case.scale)


@pytest.mark.parametrize(
    ("name", "tolerance", "sweeps"),
    [(CAPSULES, 1e-4, 374), (CAPSULES, 1e-8, 2716), (BOXES, 1e-4, 14), (BOXES, 1e-8, 33)],
)
def test_siconos_runs_as_its_makers_meant(name, tolerance, sweeps):
    """The sweeps of version 4.4 on its own test problems: the rival is not called amiss."""
    solution = siconos(as_stored(name), tolerance)
    assert solution.converged
    assert solution.iterations == pytest.approx(sweeps, rel=0.02)


@pytest.mark.parametrize("solver", ["apgd", "scip"])
@pytest.mark.parametrize("name", [BOXES, CAPSULES])
def test_coulomb_s_law_is_solved_as_by_siconos(name, solver):
    case = as_stored(name)
    rival, other = siconos(case, 1e-8), siconos(case, 1e-8, elsewhere(case))
    ours = solved(case, SolverOptions(solver, "coulomb"), 1e-8, 1e-12)
    assert ours.converged, ours.reason
    # The natural map is at most the residuals' sum: dual + roots of complementarities, 1e-6.
    assert coulomb_residual(case, ours.impulse) <= 1e-6
    assert coulomb_residual(case, rival.impulse) <= 1e-7
    judged = law_residuals(case.problem, rival.impulse, rival.velocity)
    assert judged.dual <= 1e-7 * case.problem.velocity_scale
    # Unlike the relaxation the law may have several solutions: here both starts find one.
    assert apart(case, rival.velocity, other.velocity) <= 1e-7
    assert apart(case, ours.velocity, rival.velocity) <= 1e-7


def test_where_gauss_seidel_gives_up_ours_comes_nearer():
    """A settled pile: ten thousand sweeps leave 1e-4; no solver is known to reach 1e-8."""
    case = as_stored("pile-60")
    rival = siconos(case, 1e-8)
    assert not rival.converged
    ours = solved(case, SolverOptions("scip", "coulomb"), 1e-8, 1e-12)
    assert ours.converged or ours.reason
    assert coulomb_residual(case, ours.impulse) < 0.5 * coulomb_residual(case, rival.impulse)
