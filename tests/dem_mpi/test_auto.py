"""The choice between gradients and the interior point method: what it costs, and where it fails."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from dem_mpi.bodies import Bodies
from dem_mpi.cone import ConeProblem, Tolerance, evaluate
from dem_mpi.metrics import SolverCounts
from dem_mpi.newton import NewtonOptions
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import parse_scenario
from dem_mpi.simulation import Simulation, start
from dem_mpi.solvers import work
from dem_mpi.solvers.apgd import Apgd, ApgdOptions
from dem_mpi.solvers.auto import Auto, AutoOptions, Forecast, remaining_iterations
from dem_mpi.solvers.result import SolveReport
from dem_mpi.solvers.scip import Scip, ScipOptions

# ---- the forecast, on made-up merits -------------------------------------------------------


def cost(merit, price: float, products: float = 1.0) -> tuple[float, bool]:
    """What a solve costs in products, and whether gradients ended it: merit(k) is theirs.

    The other method costs `price`, and is called where the forecast gives gradients up.
    """
    forecast = Forecast(price, AutoOptions())
    for k in range(1, 10_000_000):
        if merit(k) <= 1.0:
            return k * products, True
        if not forecast(k, round(k * products), merit(k)):
            return k * products + price, False
    raise AssertionError("neither ended")


# Falls of the merit: exponential, and like a power, as accelerated gradients have them.
FALLS = {
    "exponential": lambda end: lambda k: math.exp(12.0 * (1.0 - k / end)),
    "square": lambda end: lambda k: (end / k) ** 2,
    "fourth power": lambda end: lambda k: (end / k) ** 4,
    # In waves of a factor 20, which accelerated gradients make, and then stairs.
    "waves": lambda end: lambda k: (end / k) ** 3 * math.exp(3.0 * math.sin(0.3 * k) ** 2),
    "stairs": lambda end: lambda k: 10.0 ** (-math.floor(12.0 * k / end - 12.0)),
}


@pytest.mark.parametrize("price", [500, 5000, 50_000])
@pytest.mark.parametrize("fall", FALLS)
def test_a_solve_costs_at_most_half_more_than_by_the_better_method(fall, price):
    """Whether gradients would take a hundredth of the other's price, as much, or 300 times it.

    A look is due every tenth. Where both cost about the same a wrong forecast more than doubles the
    cost at most: a price after the limit of one and a half.
    """
    for ratio in np.geomspace(0.01, 300.0, 41):
        spent, _ = cost(FALLS[fall](ratio * price), price)
        better = min(1.0, ratio) * price
        allowed = 1.6 if not 0.5 < ratio < 5.0 else 2.6
        assert spent <= allowed * better + 40, ratio


def test_gradients_end_what_they_are_about_to_end_and_leave_what_they_do_not():
    assert cost(FALLS["exponential"](2000), price=4000)[1]
    assert not cost(FALLS["exponential"](40_000), price=4000)[1]


def test_without_progress_the_change_comes_when_the_free_part_is_spent():
    spent, by_gradients = cost(lambda k: 5.0, price=1000)
    assert not by_gradients
    assert 1500 <= spent <= 1000 + 1.1 * 500


def test_whatever_the_forecasts_say_there_is_a_limit():
    """A merit that always promises to be there in a few iterations."""
    spent, by_gradients = cost(lambda k: 1.0 + 1e3 * 0.999**k, price=1000)
    assert not by_gradients
    assert spent <= (1.5 * 1.1 + 1.0) * 1000


def test_line_searches_count():
    """Two products an iteration: as if half as many iterations were allowed."""
    single, double = cost(lambda k: 5.0, 1000)[0], cost(lambda k: 5.0, 1000, products=2.0)[0]
    assert double == pytest.approx(single, rel=0.1)


@pytest.mark.parametrize("fall", ["exponential", "fourth power"])
def test_pure_falls_are_extended_to_where_they_end_within_a_factor_of_2_5(fall):
    merit = FALLS[fall](5000)
    lowest = [math.log(merit(k)) for k in range(1, 2501)]
    assert 1000 < remaining_iterations(lowest) < 6250


def test_a_merit_that_stands_is_never_there():
    assert remaining_iterations([1.0] * 50) == math.inf
    assert remaining_iterations([3.0]) == math.inf
    assert remaining_iterations([1.0, -0.1]) == 0.0


# ---- real problems -------------------------------------------------------------------------

# Bodies of one size in a box, falling (a cloud) or in a heap that rests on its floor.
SCENE = """
domain: {{min: [-1, -1, -1], max: [2, 2, 3]}}
materials: {{glass: {{density: 2500}}, heavy: {{density: {heavy}}}}}
friction: {{default: 0.5}}
bodies:
  - {{material: glass, count: {count}, radius: 0.05,
     placement: {{jittered_grid: {{min: [0, 0, 0], max: [{side}, {side}, {top}],
     spacing: {spacing}}}}}, velocity_jitter: {jitter}}}
  - {{material: heavy, count: 4, radius: 0.05,
     placement: {{jittered_grid: {{min: [0, 0, {top}], max: [{side}, {side}, 3.2],
     spacing: {spacing}}}}}}}
walls:
  - {{shape: box, material: glass, min: [0, 0, 0], max: [{side}, {side}, 3], open: [z_max]}}
time: {{step: 2.0e-3, end: 1}}
contact: {{tolerance: 1.0e-2, complementarity: 1.0e-2, max_iterations: 500, solver: auto,
  stop_factor: 1.0e9}}
"""
# Layers that touch from the first step on, under four bodies of another density.
COLUMN = {
    "count": 112,
    "side": 0.2001,
    "top": 2.80003,
    "spacing": 0.100001,
    "heavy": 5_000_000,
    "jitter": 0.05,
}
CUBE = {
    "count": 125,
    "side": 0.5001,
    "top": 0.50001,
    "spacing": 0.100001,
    "heavy": 2500,
    "jitter": 0.05,
}
CLOUD = {"count": 125, "side": 0.55, "top": 0.55, "spacing": 0.1035, "heavy": 2500, "jitter": 1.0}


def posed(parallel: Parallel, shape: dict, steps: int = 1) -> tuple[ConeProblem, np.ndarray]:
    """Collective. The cone problem of a step of a scene, and its warm start."""
    scenario = parse_scenario(SCENE.format(**shape), "scene.yaml").scenario
    density = np.array([m.density for m in scenario.materials.values()])
    bodies = Bodies.from_arrays(place(parallel, scenario), density)
    simulation = Simulation(parallel, scenario, start(parallel, bodies))
    for _ in range(steps):
        simulation.step()
    return simulation.pose()


def solvers(tolerance: Tolerance, limit: int = 100_000, **newton) -> tuple[Apgd, Scip]:
    options = ScipOptions(tolerance, newton=NewtonOptions(**newton))
    return Apgd(ApgdOptions(tolerance, limit)), Scip(options)


def tolerance_of(value: float) -> Tolerance:
    return Tolerance(value, "absolute", value)


def counted_work(report: SolveReport, problem: ConeProblem) -> float:
    """What the method of a report costs by its counts [s]."""
    size = work.size_of(problem)
    newton = report.factorisations * work.newton_work(size)
    return newton + report.products * work.product_work(size)


@pytest.mark.mpi(ranks=[1, 2])
@pytest.mark.parametrize("state", ["cloud", "column"])
def test_the_work_is_near_that_of_the_better_method_at_any_tolerance(parallel, state):
    """By counts: gradients' products, and factorisations; a column of 30 layers is where gradients
    are slow. Interior points that begin near the solution may make it less than either alone."""
    problem, guess = posed(parallel, {"cloud": CLOUD, "column": COLUMN}[state])
    assert parallel.sum(problem.contacts) > 0
    by, total = set(), 0.0
    for exponent in range(1, 8):
        tolerance = tolerance_of(10.0**-exponent)
        apgd, scip = solvers(tolerance)
        auto = Auto(apgd, scip)
        reports = [s.solve(problem, guess.copy(), None, tolerance) for s in (apgd, scip, auto)]
        gradients, interior, chosen = reports
        auto.destroy()
        assert chosen.converged
        by.add(chosen.solver)
        spent = counted_work(chosen, problem)
        options = [counted_work(r, problem) for r in (gradients, interior) if r.converged]
        # At worst gradients are left after half a price, an iteration before they would have ended.
        assert spent <= (0.5 + 1.0) / 0.5 * min(options)
        total += spent / min(options) / 7
    assert total <= 1.5
    assert by == {"apgd" if state == "cloud" else "scip"}


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_all_ranks_decide_alike_and_what_is_reported_adds_up(parallel):
    problem, guess = posed(parallel, COLUMN)
    tolerance = tolerance_of(1e-6)
    apgd, scip = solvers(tolerance)
    auto = Auto(apgd, scip)
    report = auto.solve(problem, guess)
    auto.destroy()
    assert report.converged
    assert report.solver == "scip"
    assert report.form in ("velocity", "contact")
    assert report.factor_entries > 0
    decided = parallel.allgather(np.array([report.iterations, report.factorisations]))
    assert (decided == decided[0]).all()
    # Rows of the history are numbered on, and end where the impulse was found.
    assert report.history[-1, 0] == report.iterations
    assert (np.diff(report.history[:, 0]) >= 0).all()
    assert 0 < report.factorisations < report.iterations
    assert report.products > report.iterations
    assert report.lipschitz > 0.0
    g = np.empty_like(report.impulse)
    problem.operator.apply(report.impulse, g)
    found = evaluate(problem, report.impulse, g + problem.b)
    assert tolerance.merit(found, problem) <= 1.0


def test_gradients_that_reach_their_limit_are_helped_out(parallel):
    problem, guess = posed(parallel, CUBE)
    tolerance = tolerance_of(1e-6)
    apgd, scip = solvers(tolerance, limit=5)
    assert not apgd.solve(problem, guess.copy()).converged
    auto = Auto(apgd, scip)
    report = auto.solve(problem, guess)
    auto.destroy()
    assert report.converged
    assert report.solver == "scip"
    assert report.iterations == 5 + report.factorisations


def test_factors_that_may_not_be_made_are_not_made(parallel):
    problem, guess = posed(parallel, COLUMN)
    apgd, scip = solvers(tolerance_of(1e-7), limit=400, memory=0.01)
    report = Auto(apgd, scip).solve(problem, guess)
    assert report.iterations == 400
    assert report.factorisations == 0
    assert not report.converged
    assert "contact.scip.memory allows" in report.reason


def test_no_contacts_and_values_that_are_no_numbers_end_with_gradients(parallel):
    problem, guess = posed(parallel, CLOUD, steps=0)
    nothing = replace(problem, b=np.zeros((0, 3)), mu=np.zeros(0), operator=_Nothing())
    auto = Auto(*solvers(tolerance_of(1e-4)))
    assert auto.solve(nothing, np.zeros((0, 3))).converged
    problem, guess = posed(parallel, CUBE)
    report = auto.solve(replace(problem, b=problem.b * np.nan), guess)
    assert not report.converged
    assert report.factorisations == 0
    assert np.isfinite(report.impulse).all()


class _Nothing:
    """N of no contact."""

    def apply(self, impulse: np.ndarray, out: np.ndarray) -> None:
        out[:] = 0.0

    def diagonal(self) -> np.ndarray:
        return np.zeros((0, 3))


@dataclass
class _Failing:
    """An interior point method that ends with an impulse of its own, not converged."""

    factor: float
    options: ScipOptions = field(default_factory=ScipOptions)

    def solve(self, problem, guess, lipschitz=None, tolerance=None) -> SolveReport:
        few = Apgd(ApgdOptions(tolerance, max_iterations=0))
        report = few.solve(problem, self.factor * guess)
        reason = "the steps became too small"
        return replace(report, solver="scip", iterations=7, factorisations=7, reason=reason)

    def destroy(self) -> None:
        pass


def test_where_interior_points_fail_gradients_go_on_with_what_they_have_left(parallel):
    problem, guess = posed(parallel, COLUMN)
    tolerance = tolerance_of(1e-6)
    apgd, _ = solvers(tolerance)
    impatient = AutoOptions(free=0.01, patience=0.0)
    report = Auto(apgd, _Failing(0.0), impatient).solve(problem, guess.copy())
    assert report.converged
    assert report.solver == "apgd"
    assert report.factorisations == 7
    limited, _ = solvers(tolerance, limit=60)
    report = Auto(limited, _Failing(0.0), impatient).solve(problem, guess.copy())
    assert not report.converged
    assert report.iterations == 60 + 7
    assert "the steps became too small" in report.reason
    # The better of both impulses: gradients' own, not the zeros of the other.
    alone = limited.solve(problem, guess.copy())
    found, best = (tolerance.merit(r.residuals, problem) for r in (report, alone))
    assert found <= 3.0 * best


# ---- sizes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "low", "high"),
    [("cloud", 0.3, 3.0), ("column", 0.3, 3.0), ("cube", 0.5, 2.0)],
)
def test_entries_of_a_factor_are_foretold(parallel, shape, low, high):
    problem, guess = posed(parallel, {"cloud": CLOUD, "column": COLUMN, "cube": CUBE}[shape])
    scip = solvers(tolerance_of(1e-12), form="velocity")[1]
    report = Scip(replace(scip.options, max_iterations=1)).solve(problem, guess)
    foretold = work.factor_entries(work.size_of(problem))
    assert low < foretold / report.factor_entries < high


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_the_shape_of_a_bed_does_not_depend_on_ranks_or_on_single_bodies_far_off(parallel):
    rng = np.random.default_rng(5)
    position = rng.random((4000, 3)) * [1.0, 1.0, 8.0]
    size = np.full(4000, 0.01)
    mine = np.arange(4000) % parallel.size == parallel.rank
    found = work.elongation_of(position[mine], size[mine], parallel)
    assert found == pytest.approx(8.0 / 8.0 ** (1.0 / 3.0), rel=0.03)
    position[0] = [30.0, 0.0, 0.0]
    assert work.elongation_of(position[mine], size[mine], parallel) == pytest.approx(found, rel=0.5)
    assert work.elongation_of(position[:0], size[:0], parallel) == 1.0


def test_work_grows_with_all_that_is_to_be_done():
    bed = work.Size(contacts=46_800, bodies=16_000, largest=46_800, columns=3, rows=6)
    cloud = replace(bed, contacts=5000, largest=5000)
    smooth = replace(bed, columns=1, rows=3)
    column = replace(bed, elongation=8.0)
    two = replace(bed, ranks=2, largest=23_400)
    entries = [work.factor_entries(size) for size in (cloud, smooth, column, bed)]
    assert entries[0] < 0.1 * entries[3]
    assert entries[1] == pytest.approx(entries[3] / 4)
    assert entries[2] < 0.5 * entries[3]
    # Measured: 60 million entries and 1.2e11 operations, a little elongated.
    measured = replace(bed, elongation=1.65)
    assert work.factor_entries(measured) == pytest.approx(6e7, rel=0.3)
    assert work.factor_operations(measured) == pytest.approx(1.2e11, rel=0.5)
    assert 0.5 < work.newton_work(two) / work.newton_work(bed) < 0.8
    assert 0.5 < work.product_work(two) / work.product_work(bed) < 0.6
    assert work.interior_point_work(bed, 8) > work.interior_point_work(bed, 2)


# ---- what a run says -----------------------------------------------------------------------


def test_the_closing_table_tells_how_often_which_method_solved_a_step():
    counts = SolverCounts()
    for _ in range(3):
        counts.add("apgd", iterations=100, factorisations=0, outer=1)
    assert counts.facts() == []  # nothing that the table of seconds would not tell
    counts.add("scip", iterations=1507, factorisations=7, outer=1)
    assert counts.facts() == [
        "solved by apgd in 3 steps, scip in 1 steps; 1,800 gradient iterations; 7 Newton iterations"
    ]
    coulomb = SolverCounts()
    coulomb.add("apgd", iterations=50, factorisations=0, outer=4)
    assert coulomb.facts() == ["solved by apgd in 1 steps; 50 gradient iterations; 4 cone problems"]
