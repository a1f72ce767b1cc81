#!/usr/bin/env python3
"""Measure the constants by which solver: auto foretells work, and print them beside those in use.

    scripts/bench/calibrate.py [--layers 16]

Processor seconds of one core on lattices of spheres that touch: a cube, and one without friction.
What is printed replaces the numbers of `dem_mpi.solvers.work.Costs` by hand; nothing reads a clock
in a run. On another machine all change by much the same factor, and so the decisions little.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from dem_mpi.bodies import Bodies
from dem_mpi.cone import ConeProblem
from dem_mpi.newton import NewtonOptions, NewtonSystem
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import parse_scenario
from dem_mpi.simulation import Simulation, start
from dem_mpi.solvers import work
from dem_mpi.solvers.apgd import Apgd, ApgdOptions

_SCENE = """
domain: {{min: [-1, -1, -1], max: [9, 9, 9]}}
materials: {{glass: {{density: 2500}}}}
friction: {{default: {mu}}}
bodies:
  - {{material: glass, count: {count}, radius: 0.01, placement: {{jittered_grid:
     {{min: [0, 0, 0], max: [{side}, {side}, {side}], spacing: 0.02005}}}}}}
walls:
  - {{shape: box, material: glass, min: [0, 0, 0], max: [{side}, {side}, 8], open: [z_max]}}
time: {{step: 1.0e-3, end: 1}}
contact: {{operator: {operator}}}
"""
_ITERATIONS = 100


def cube(layers: int, mu: float = 0.3, operator: str = "matrix_free") -> ConeProblem:
    """The first cone problem of a cube of so many layers of spheres."""
    alone, side = Parallel.alone(), layers * 0.02005 + 1e-9
    text = _SCENE.format(mu=mu, count=layers**3, side=side, operator=operator)
    scenario = parse_scenario(text, "calibrate").scenario
    bodies = Bodies.from_arrays(place(alone, scenario), np.array([2500.0]))
    return Simulation(alone, scenario, start(alone, bodies)).pose()[0]


def seconds(task: Callable[[], object], repeats: int = 3) -> float:
    """The least processor time [s] of a task, after a first call."""
    task()
    found = []
    for _ in range(repeats):
        begin = time.process_time()
        task()
        found.append(time.process_time() - begin)
    return min(found)


def product_seconds(problem: ConeProblem) -> float:
    """Of a product within an iteration of APGD."""
    apgd = Apgd(ApgdOptions(max_iterations=_ITERATIONS, fixed_iterations=True))
    products = apgd.solve(problem, np.zeros_like(problem.b)).products
    return seconds(lambda: apgd.solve(problem, np.zeros_like(problem.b))) / products


def factor_seconds(problem: ConeProblem) -> tuple[float, float, int]:
    """Of a factorisation in velocities and of a solve with it; entries of the factor."""
    system = NewtonSystem(
        problem.operator, problem.mu, problem.parallel, NewtonOptions(form="velocity")
    )
    scatter = np.random.default_rng(0).lognormal(size=problem.contacts)
    columns = problem.b.shape[1]
    R = (problem.operator.diagonal() * scatter[:, None])[:, :, None] * np.eye(columns)
    Q = np.linalg.inv(R)
    out = np.empty_like(problem.b)
    factor = seconds(lambda: system.factor(Q, R))
    solve = seconds(lambda: system.solve(problem.b, out))
    entries = system.factor_entries
    system.destroy()
    return factor, solve, entries


def main() -> None:
    """Print a table: measured, foretold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--layers", type=int, default=16, help="of the larger cube")
    layers = parser.parse_args().layers
    print(f"constants in use: {work.COSTS}")
    for label, settings in {
        "friction": {},
        "no friction": {"mu": 0.0},
        "assembled": {"operator": "assembled"},
    }.items():
        for side in (2, layers):
            problem = cube(side, **settings)
            size = work.size_of(problem, "velocity")
            found, told = product_seconds(problem), work.product_work(size)
            each = 1e9 * found / problem.contacts
            print(
                f"{label}, {side}^3: product {found:.2e} s ({each:.1f} ns a contact), "
                f"foretold {told:.2e}"
            )
    for mu in (0.3, 0.0):
        for side in (layers // 2, layers):
            problem = cube(side, mu)
            size = work.size_of(problem, "velocity")
            factor, solve, entries = factor_seconds(problem)
            print(
                f"mu = {mu}, {side}^3: factor {factor:.3f} s, solve {solve:.4f} s, "
                f"{entries:.3g} entries; foretold {work.factor_entries(size):.3g} entries, "
                f"{work.factor_operations(size):.3g} operations, a Newton iteration "
                f"{work.newton_work(size):.3f} s"
            )


if __name__ == "__main__":
    main()
