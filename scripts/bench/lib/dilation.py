"""What each law of friction does to sliding contacts: a sphere on a floor, and a sheared bed.

The cone complementarity problem ("ccp") lets a sliding contact open at mu |v_t|, Coulomb's law
("coulomb") does not. Every function returns a frozen record; all are collective.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dem_mpi.bodies import Bodies
from dem_mpi.cone import ConeProblem
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import Scenario, load_scenario, parse_scenario
from dem_mpi.simulation import Simulation, StepRecord, start
from dem_mpi.solvers.choice import SolverOptions, make_solver
from dem_mpi.state import State

Law = Literal["ccp", "coulomb"]
LAWS: tuple[Law, ...] = ("ccp", "coulomb")

GRAVITY = 9.81  # [m/s^2]
SHEAR_BOX = Path(__file__).resolve().parents[3] / "configs" / "shear_box.yaml"
_PRESSED = 0.45  # [s] when the plates have come as close as they get


@dataclass(frozen=True)
class SlidingRecord:
    """A sphere launched at gap 0 without spin, slides and then rolls.

    hop        : gap after the first step, while it slides [m]
    gap        : largest gap in the run [m]
    slowing    : loss of speed in the first step over mu g h; 1 by Coulomb's law
    speed_error: speed at the end less 5/7 of the first [m/s]
    products, outer : products with N and cone problems in all steps
    """

    law: Law
    step: float
    hop: float
    gap: float
    slowing: float
    speed_error: float
    products: int
    outer: int
    converged: bool


@dataclass(frozen=True)
class ShearRecord:
    """A bed of spheres between two plates a fixed distance apart that slide against each other.

    opening  : gap that bearing contacts have after a step, weighted by their impulse [m]
    sliding  : the same of those of them that slide faster than 1 % of a plate [m]
    load     : mean normal force on a plate [N]
    friction : mean drag on a plate over the load
    contacts, outer, products : means over the steps
    """

    law: Law
    step: float
    bodies: int
    steps: int
    opening: float
    sliding: float
    load: float
    friction: float
    contacts: float
    outer: float
    products: float
    unconverged: int


# ---- one sphere ----------------------------------------------------------------------------


def sliding_sphere(
    law: Law,
    step: float,
    mu: float = 0.3,
    speed: float = 1.0,
    radius: float = 0.1,
    time: float = 0.16,
    tolerance: float = 1e-10,
    solver: str = "apgd",
) -> SlidingRecord:
    """Launch a sphere on a floor from gap 0 on this rank alone; steps of length `step` [s]."""
    scenario = _floor(law, step, mu, time, tolerance, solver)
    sphere = {
        "gid": np.zeros(1, np.int64),
        "material": np.zeros(1, np.int32),
        "radius": np.array([radius]),
        "position": np.array([[0.0, 0.0, radius]]),
        "velocity": np.array([[speed, 0.0, 0.0]]),
        "angular_velocity": np.zeros((1, 3)),
    }
    simulation = _simulation(Parallel.alone(), scenario, sphere)
    gaps, speeds, records = [], [speed], []
    for _ in range(round(time / step)):
        records.append(simulation.step())
        bodies = simulation.state.bodies
        gaps.append(float(bodies.position[0, 2]) - radius)
        speeds.append(float(bodies.velocity[0, 0]))
    simulation.destroy()
    return SlidingRecord(
        law=law,
        step=step,
        hop=gaps[0],
        gap=max(gaps),
        slowing=(speeds[0] - speeds[1]) / (mu * GRAVITY * step),
        speed_error=speeds[-1] - 5.0 / 7.0 * speed,
        products=sum(r.products for r in records),
        outer=sum(r.outer for r in records),
        converged=all(r.converged for r in records),
    )


def _floor(
    law: Law, step: float, mu: float, time: float, tolerance: float, solver: str
) -> Scenario:
    scene = {
        "domain": {"min": [-100, -100, -1], "max": [100, 100, 100]},
        "gravity": [0, 0, -GRAVITY],
        "materials": {"m": {"density": 1000}},
        "friction": {"default": mu},
        "bodies": [
            {
                "material": "m",
                "count": 1,
                "radius": 0.1,
                "placement": {"jittered_grid": {"min": [-1, -1, 0], "max": [1, 1, 2]}},
            }
        ],
        "walls": [{"shape": "plane", "material": "m", "point": [0, 0, 0], "normal": [0, 0, 1]}],
        "time": {"step": step, "end": time},
        "contact": {
            "law": law, "solver": solver, "tolerance": tolerance, "complementarity": tolerance,
        },
    }  # fmt: skip
    return parse_scenario(json.dumps(scene), Path("floor.yaml")).scenario


# ---- a sheared bed -------------------------------------------------------------------------


def pressed_bed(
    parallel: Parallel,
    count: int = 475,
    length: float = 0.1,
    step: float = 1e-3,
    overrides: Sequence[str] = (),
) -> State:
    """Collective. Bodies of configs/shear_box.yaml when its plates have closed in, under ccp.

    length [m] along x goes with the count: 1,900 spheres in 0.2 m, at half the width below that.
    """
    scenario = _shear_box("ccp", step, count, length, overrides)
    simulation = _simulation(parallel, scenario, place(parallel, scenario))
    for _ in range(round(_PRESSED / step)):
        simulation.step()
    simulation.destroy()
    return simulation.state


def sheared_bed(
    parallel: Parallel,
    state: State,
    law: Law,
    step: float,
    count: int = 475,
    length: float = 0.1,
    time: float = 0.05,
    skip: float = 0.02,
    overrides: Sequence[str] = (),
) -> ShearRecord:
    """Collective. Go on from a `pressed_bed` of that count and length for skip + time [s].

    The state stays as it is. Measuring begins after `skip`, when the bed has got used to the law
    and the step.
    """
    scenario = _shear_box(law, step, count, length, overrides)
    own = copy.deepcopy(state)
    own.step = round(_PRESSED / step)
    simulation = Simulation(parallel, scenario, own)
    for _ in range(round(skip / step)):
        simulation.step()
    records: list[StepRecord] = []
    sums = np.zeros(4)
    steps = round(time / step)
    for _ in range(steps):
        records.append(simulation.step())
        if len(records) % max(1, steps // 5) == 0:
            sums += _openings(*simulation.pose(), SolverOptions.of(scenario.contact), step)
    simulation.destroy()
    force = np.array([[r.walls["lower"][:3], r.walls["upper"][:3]] for r in records]).mean(axis=0)
    load = 0.5 * (force[1, 2] - force[0, 2])
    drag = 0.5 * (force[0, 0] - force[1, 0])
    return ShearRecord(
        law=law,
        step=step,
        bodies=records[-1].bodies,
        steps=len(records),
        opening=sums[0] / sums[1],
        sliding=sums[2] / sums[3],
        load=float(load),
        friction=float(drag / load),
        contacts=float(np.mean([r.contacts for r in records])),
        outer=float(np.mean([r.outer for r in records])),
        products=float(np.mean([r.products for r in records])),
        unconverged=sum(not r.converged for r in records),
    )


def _openings(problem: ConeProblem, guess: NDArray, options: SolverOptions, step: float) -> NDArray:
    """Collective. Sums over contacts of gamma_n h g_n and gamma_n, and of the sliding ones (4,).

    The normal part of g holds phi/h: h g_n is the gap after the step.
    """
    solver = make_solver(options)
    report = solver.solve(problem, guess)
    solver.destroy()
    load, g = report.impulse[:, 0], report.velocity
    slides = np.linalg.norm(g[:, 1:], axis=1) > 0.01 * 0.2
    gap = step * g[:, 0] * load
    return problem.parallel.sum(
        np.array([gap.sum(), load.sum(), gap[slides].sum(), load[slides].sum()])
    )


def _shear_box(
    law: Law, step: float, count: int, length: float, overrides: Sequence[str]
) -> Scenario:
    width = 0.1 if length > 0.1 else 0.05
    settings = [
        f"bodies.0.count={count}",
        f"domain.max=[{length},{width},0.2]",
        f"bodies.0.placement.random.max=[{length},{width},0.176]",
        f"time.step={step}",
        f"contact.law={law}",
        *overrides,
    ]
    return load_scenario(SHEAR_BOX, settings).scenario


def _simulation(parallel: Parallel, scenario: Scenario, arrays: dict[str, Any]) -> Simulation:
    density = [material.density for material in scenario.materials.values()]
    state = start(parallel, Bodies.from_arrays(arrays, density))
    state.rotating = True
    return Simulation(parallel, scenario, state)
