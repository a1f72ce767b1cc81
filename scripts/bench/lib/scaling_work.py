"""What the ranks of scaling.py do: one task, done and told as numbers.

A task is a dictionary with the `kind` of work. Its scene is a file with overrides; the beds are
those of configs/weak_scaling.yaml, stacked as a dense jittered lattice instead of dropped.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpi4py import MPI

from dem_mpi.bodies import Bodies
from dem_mpi.metrics import PHASES, PhaseTimer, peak_memory, resident_memory
from dem_mpi.parallel import Halo, Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import Scenario, frictional, load_scenario
from dem_mpi.simulation import Simulation, SolverFailureError, start
from dem_mpi.state import State

# What is measured in each phase of a step on each rank. `waited` is the time in reductions and in
# the exchange of ghosts, packing included; `peak` the largest resident size.
COLUMNS = ("seconds", "waited", "bytes", "messages", "reductions", "peak")


class Meter(Parallel):
    """A group of ranks that counts its reductions and the time spent in communication."""

    def __init__(self, communicator: MPI.Comm | None = None) -> None:
        super().__init__(communicator)
        self.reductions = 0
        self.waited = 0.0

    @contextmanager
    def waiting(self) -> Iterator[None]:
        began = perf_counter()
        yield
        self.waited += perf_counter() - began

    def sum_in_place(self, array: NDArray) -> None:
        with self.waiting():
            super().sum_in_place(array)
        self.reductions += 1

    def max_in_place(self, array: NDArray) -> None:
        with self.waiting():
            super().max_in_place(array)
        self.reductions += 1

    def counters(self) -> NDArray:
        """Return what `COLUMNS` holds between seconds and peak."""
        return np.array([self.waited, self.bytes_sent, self.messages_sent, self.reductions], float)


def measure_halos() -> None:
    """Let every exchange of ghosts count as communication."""
    for name in ("forward", "reverse_add"):
        exchange = getattr(Halo, name)

        def timed(halo: Halo, values: NDArray, exchange: Callable = exchange) -> None:
            with halo.parallel.waiting():
                exchange(halo, values)

        setattr(Halo, name, timed)


class Probe(PhaseTimer):
    """A timer that also takes what `COLUMNS` names, by phase, of the current step."""

    def __init__(self, parallel: Meter) -> None:
        super().__init__()
        self.parallel = parallel
        self.table = np.zeros((len(PHASES), len(COLUMNS)))

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        row, before = self.table[PHASES.index(name)], self.parallel.counters()
        reset_peak()
        with super().phase(name):
            yield
        row[0] = self.step[PHASES.index(name)]
        row[1:5] += self.parallel.counters() - before
        row[5] = max(row[5], peak_memory())

    def take(self) -> NDArray:
        """Return the table (phases, columns) of the step, and begin anew."""
        self.finish_step()
        table, self.table = self.table, np.zeros_like(self.table)
        return table


def reset_peak() -> None:
    """Let the peak of resident memory begin anew, where Linux allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


# ---- tasks ---------------------------------------------------------------------------------


def steps(parallel: Meter, task: dict[str, Any]) -> dict[str, Any]:
    """Collective. Step a scene from its start; everything by step, rank and phase.

    `seconds` bounds the whole; with `anew` each step lists near pairs anew.
    """
    scenario = scene_of(task)
    base = resident_memory()
    reset_peak()
    began = perf_counter()
    state = begin(parallel, scenario)
    placed, placed_peak = perf_counter() - began, peak_memory()
    simulation = Simulation(parallel, scenario, state)
    probe = simulation.timer = Probe(parallel)
    rows, reason = [], ""
    for _ in range(min(task["steps"], scenario.steps)):
        if task.get("anew"):
            simulation.forget_neighbours()
        try:
            record = simulation.step()
        except SolverFailureError as error:
            reason = str(error)
            break
        neighbours = simulation._neighbours
        own = [len(state.bodies), 0 if neighbours is None else neighbours.halo.ghosts]
        row = {
            name: getattr(record, name)
            for name in ("bodies", "contacts", "iterations", "products", "converged", "r_d",
                         "imbalance", "moved", "rebuilt", "bytes_sent")
        }  # fmt: skip
        row["own"] = parallel.allgather(np.array(own)).tolist()
        row["ranks"] = parallel.allgather(probe.take()).tolist()
        rows.append(row)
        if parallel.any(perf_counter() - began > task.get("seconds", math.inf)):
            break
    memory = parallel.allgather(np.array([base, placed_peak])).tolist()
    simulation.destroy()
    return {
        "phases": PHASES,
        "columns": COLUMNS,
        "placed": parallel.max(placed),
        "memory": memory,
        "steps": rows,
        "failure": reason,
        "planned": scenario.steps,
        "step": scenario.time.step,
    }


def together(parallel: Meter, task: dict[str, Any]) -> list[dict[str, Any]]:
    """Collective. Every rank steps a scene of its own, all at the same time."""
    alone = Meter(MPI.COMM_SELF)
    parallel.barrier()
    found = parallel.gather(steps(alone, task))
    alone.free()
    return found or []


def detection(parallel: Meter, task: dict[str, Any]) -> list[dict[str, Any]]:
    """Collective. Seconds of a new pair list and its contacts, for each scene of the task."""
    found = []
    for scene in task["scenes"]:
        scenario = scene_of(scene)
        ratio = scene.get("size_ratio")
        state = begin(parallel, scenario) if ratio is None else two_sizes(parallel, scenario, ratio)
        simulation = Simulation(parallel, scenario, state)
        times = []
        # The first one finds the bodies in the order of placement, those after it in Morton order.
        for _ in range(1 + task["repeats"]):
            simulation.forget_neighbours()
            problem, _ = simulation.pose()
            times.append(dict(zip(PHASES, simulation.timer.step.tolist(), strict=True)))
            simulation.timer.finish_step()
        found.append(
            {
                "bodies": len(simulation.state.bodies),
                "largest": int(np.count_nonzero(state.bodies.radius > state.bodies.radius.min())),
                "contacts": problem.contacts,
                "pairs": simulation._neighbours.pairs,
                "seconds": times[1:],
            }
        )
        simulation.destroy()
        del simulation, problem, state
    return found


KINDS = {"steps": steps, "together": together, "detection": detection}


# ---- scenes --------------------------------------------------------------------------------


def scene_of(task: dict[str, Any]) -> Scenario:
    return load_scenario(task["scene"], task["overrides"]).scenario


def begin(parallel: Parallel, scenario: Scenario) -> State:
    """Collective. Place the bodies of a scene and divide them among the ranks."""
    density = [material.density for material in scenario.materials.values()]
    state = start(parallel, Bodies.from_arrays(place(parallel, scenario), density))
    state.rotating = parallel.any(bool(state.bodies.angular_velocity.any())) or frictional(scenario)
    return state


def two_sizes(parallel: Parallel, scenario: Scenario, ratio: float) -> State:
    """Collective. A bed with as many large spheres sunk into its top as lie there side by side.

    A large sphere takes the place of the small ones that it would overlap.
    """
    arrays = place(parallel, scenario)
    small = float(arrays["radius"][0])
    large = ratio * small
    box = scenario.walls[0]
    top = float(arrays["position"][:, 2].max())
    depth = 4.0 * small
    across = [max(1, int((box.max[k] - box.min[k]) / (2.02 * large))) for k in range(2)]
    if ratio > 1.0:
        x, y = (box.min[k] + (np.arange(n) + 0.5) * (box.max[k] - box.min[k]) / n
                for k, n in enumerate(across))  # fmt: skip
        centre = np.stack([*map(np.ravel, np.meshgrid(x, y)), np.zeros(len(x) * len(y))], axis=1)
        centre[:, 2] = top - depth + large
        apart, _ = cKDTree(centre).query(arrays["position"])
        stay = np.flatnonzero(apart > large + small)
        arrays = {name: array[stay] for name, array in arrays.items()}
        extra = {name: np.repeat(array[:1], len(centre), axis=0) for name, array in arrays.items()}
        extra |= {"position": centre, "radius": np.full(len(centre), large)}
        arrays = {name: np.concatenate([array, extra[name]]) for name, array in arrays.items()}
        arrays["gid"] = np.arange(len(arrays["gid"]))
    density = [material.density for material in scenario.materials.values()]
    return start(parallel, Bodies.from_arrays(arrays, density))
