"""Small scenes for tests: a scenario from keyword arguments, bodies from arrays, no files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.bodies import FIELDS, Bodies
from dem_mpi.cone import ConeProblem
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import LoadedScenario, Scenario, frictional, parse_scenario
from dem_mpi.simulation import Simulation, start
from dem_mpi.solvers.result import SolveReport
from dem_mpi.state import State

DENSITY = 1000.0  # [kg/m^3] of the material "m"
FLOOR = {
    "shape": "plane",
    "name": "floor",
    "material": "m",
    "point": [0, 0, 0],
    "normal": [0, 0, 1],
}


def load(
    *,
    step: float = 1e-3,
    end: float = 1.0,
    mu: float = 0.0,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    walls: Sequence[dict[str, Any]] = (),
    domain: dict[str, Any] | None = None,
    bodies: Sequence[dict[str, Any]] | None = None,
    contact: dict[str, Any] | None = None,
    **sections: Any,
) -> LoadedScenario:
    """A checked scene of one material "m"; `bodies` may be left out where arrays replace them."""
    nobody = {
        "material": "m",
        "count": 1,
        "radius": 1e-6,
        "placement": {"jittered_grid": {"min": [-1e-3, -1e-3, 1e-3], "max": [1e-3, 1e-3, 3e-3]}},
    }
    scene = {
        "domain": domain or {"min": [-1e3, -1e3, -1e3], "max": [1e3, 1e3, 1e3]},
        "gravity": list(gravity),
        "materials": {"m": {"density": DENSITY}},
        "friction": {"default": mu},
        "bodies": list(bodies) if bodies is not None else [nobody],
        "walls": list(walls),
        "time": {"step": step, "end": end},
        "contact": contact or {},
        **sections,
    }
    return parse_scenario(json.dumps(scene), Path("test.yaml"))


def scene(**keywords: Any) -> Scenario:
    """The scenario of `load`."""
    return load(**keywords).scenario


def state_of(
    parallel: Parallel,
    scenario: Scenario,
    position: ArrayLike,
    radius: ArrayLike,
    velocity: ArrayLike = 0.0,
    angular_velocity: ArrayLike = 0.0,
    density: float = DENSITY,
) -> State:
    """Collective. Bodies (n, 3) given alike on every rank, gid = row, divided among the ranks."""
    position = np.array(position, dtype=float).reshape(-1, 3)
    count = len(position)
    rows = np.arange(count) % parallel.size == parallel.rank
    arrays = {
        "gid": np.arange(count)[rows],
        "material": np.zeros(count, np.int32)[rows],
        "radius": np.broadcast_to(np.asarray(radius, dtype=float), (count,))[rows],
        "position": position[rows],
        "velocity": np.broadcast_to(np.asarray(velocity, dtype=float), (count, 3))[rows],
        "angular_velocity": np.broadcast_to(np.asarray(angular_velocity, dtype=float), (count, 3))[
            rows
        ],
    }
    return _started(parallel, scenario, Bodies.from_arrays(arrays, [density]))


def placed(parallel: Parallel, scenario: Scenario) -> State:
    """Collective. The bodies as the scene places them."""
    arrays = place(parallel, scenario)
    return _started(parallel, scenario, Bodies.from_arrays(arrays, [DENSITY]))


def _started(parallel: Parallel, scenario: Scenario, bodies: Bodies) -> State:
    state = start(parallel, bodies)
    spinning = parallel.any(bool(bodies.angular_velocity.any()))
    state.rotating = spinning or frictional(scenario)
    return state


def simulation_of(
    scenario: Scenario,
    position: ArrayLike,
    radius: ArrayLike,
    velocity: ArrayLike = 0.0,
    angular_velocity: ArrayLike = 0.0,
    density: float = DENSITY,
    parallel: Parallel | None = None,
) -> Simulation:
    """Collective. A simulation of given bodies, on this rank alone unless told otherwise."""
    parallel = parallel or Parallel.alone()
    state = state_of(parallel, scenario, position, radius, velocity, angular_velocity, density)
    return Simulation(parallel, scenario, state)


def everybody(parallel: Parallel, state: State) -> Bodies:
    """Collective. All bodies on every rank, in the order of gid."""
    mine = state.bodies.arrays()
    parts = parallel.broadcast(parallel.gather(mine))
    rows = {name: np.concatenate([part[name] for part in parts]) for name in FIELDS}
    order = np.argsort(rows["gid"])
    return Bodies(**{name: array[order] for name, array in rows.items()})


def touching(parallel: Parallel, state: State) -> NDArray[np.int64]:
    """Collective. (gid of a, gid or wall id of b) of every contact of the last step, sorted."""
    owner = np.repeat(state.bodies.gid, np.diff(state.memory.offsets))
    mine = np.stack([owner, state.memory.other], axis=1)
    pairs = np.concatenate(parallel.broadcast(parallel.gather(mine)))
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


class RecordingSolver:
    """Passes problems on to a solver and keeps the last one with its report."""

    def __init__(self, solver: Any) -> None:
        self._solver = solver
        self.problem: ConeProblem | None = None
        self.report: SolveReport | None = None

    def solve(self, problem: ConeProblem, guess: NDArray, lipschitz: float | None) -> SolveReport:
        """Solve and remember."""
        self.problem = problem
        self.report = self._solver.solve(problem, guess, lipschitz)
        return self.report


def watch(simulation: Simulation) -> RecordingSolver:
    """Put a recorder between a simulation and its solver; return it."""
    simulation._solver = RecordingSolver(simulation._solver)
    return simulation._solver


def observed_order(steps: Sequence[float], errors: Sequence[float]) -> float:
    """Least-squares slope of log(error) over log(step)."""
    return float(np.polyfit(np.log(steps), np.log(np.abs(errors)), 1)[0])


class StubbornSolver:
    """Calls the first `failures` of its solves failed, whatever they achieved."""

    def __init__(self, solver: Any, failures: int, dual: float | None = None) -> None:
        self._solver, self._left, self._dual = solver, failures, dual

    def solve(self, problem: ConeProblem, guess: NDArray, lipschitz: float | None) -> SolveReport:
        """Solve, and deny success; `dual` replaces the residual [m/s] where it is given."""
        report = self._solver.solve(problem, guess, lipschitz)
        if self._left <= 0:
            return report
        self._left -= 1
        residuals = report.residuals
        if self._dual is not None:
            residuals = replace(residuals, dual=self._dual)
        return replace(report, converged=False, reason="told to fail", residuals=residuals)


def make_fail(simulation: Simulation, failures: int, dual: float | None = None) -> None:
    """Let the next solves of a simulation fail."""
    simulation._solver = StubbornSolver(simulation._solver, failures, dual)
