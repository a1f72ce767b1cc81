"""Stress, strain and tangent moduli of small packings that are strained step by step.

A stand-in for the data of S. De, PhD thesis, University of Michigan 2021, table 4.2, which are not
public: time series of representative volumes, here boxes of spheres under their own weight whose
side walls press and let go, each volume on a path of its own. Kept under build/bench/compress; the
series are made on one rank alone, in about 15 s of CPU time.

Symbols: T steps; v volumes; h step [s]; L velocity gradient [1/s]; x position, f contact force.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compress.bounds import measure
from compress.decompose import tt_svd
from dem_mpi.bodies import Bodies
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import Scenario, parse_scenario
from dem_mpi.simulation import Simulation, start

VARIABLES = ("strain", "stress", "strain_increment", "stress_increment", "tangent_moduli")
TOLERANCES = (1e-1, 1e-2, 1e-3)

SIDE, HEIGHT, RADIUS = 0.04, 0.12, 0.005  # of the box and of a sphere [m]
# xx, yy, zz, yz, xz, xy
_ROW, _COLUMN = np.array([0, 1, 2, 1, 0, 0]), np.array([0, 1, 2, 2, 2, 1])
# Inward normals of the walls, in the order of their ids -1, -2, ...
_NORMAL = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True)
class Packings:
    """What is simulated: volumes of so many spheres settle, then are strained for so many steps.

    window : steps that tangent moduli are fitted to; amplitude [m] : of a wall;
    frequency [Hz] : about that of its motion
    """

    volumes: int = 6
    spheres: int = 60
    settling: int = 120
    steps: int = 384
    step: float = 2e-3
    window: int = 32
    amplitude: float = 5e-4
    frequency: float = 1.0
    seed: int = 1


@dataclass(frozen=True)
class TableRow:
    """One variable at one relative tolerance: the columns of table 4.2."""

    variable: str
    tolerance: float
    largest_rank: int
    ratio: float
    nrmse: float
    relative_error: float
    size: int


def packing_series(
    directory: Path, packings: Packings = Packings(), again: bool = False
) -> dict[str, NDArray]:
    """Series (T, v, 6), and (T, v, 36) of tangent moduli, by variable; kept in `directory`.

    strain [1], stress [Pa] (pressure positive) and their increments from step to step; moduli [Pa].
    """
    facts = json.dumps(asdict(packings), sort_keys=True)
    path = directory / "packings.npz"
    if path.is_file() and not again:
        with np.load(path) as kept:
            if str(kept["facts"]) == facts:
                return {name: kept[name] for name in VARIABLES}
    pairs = [_strained_volume(packings, number) for number in range(packings.volumes)]
    increment = np.stack([strain for strain, _ in pairs], axis=1)
    stress = np.stack([stress for _, stress in pairs], axis=1)
    change = np.diff(stress, axis=0, prepend=stress[:1])
    series = {
        "strain": np.cumsum(increment, axis=0),
        "stress": stress,
        "strain_increment": increment,
        "stress_increment": change,
        "tangent_moduli": tangent_moduli(increment, change, packings.window),
    }
    directory.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.npz")
    np.savez(partial, facts=facts, **series)
    partial.replace(path)
    return series


def table(
    series: Mapping[str, NDArray], tolerances: tuple[float, ...] = TOLERANCES
) -> list[TableRow]:
    """Each variable as a tensor of its own: steps x volumes x components."""
    rows = []
    for name, values in series.items():
        for tolerance in tolerances:
            train = tt_svd(values, tolerance=tolerance).train
            errors = measure(values, train.full())
            rows.append(
                TableRow(
                    variable=name,
                    tolerance=tolerance,
                    largest_rank=max(train.ranks),
                    ratio=train.compression_ratio,
                    nrmse=errors.nrmse,
                    relative_error=errors.relative,
                    size=values.size,
                )
            )
    return rows


def tangent_moduli(strain: NDArray, stress: NDArray, window: int) -> NDArray:
    """C (T, v, 36) of least |d stress - C d strain|^2 over the `window` steps around each one.

    strain, stress : increments (T, v, 6). A ridge of 1e-3 of the mean square of the increments
    keeps directions that the path leaves out at 0.
    """
    steps, volumes, components = strain.shape
    moduli = np.empty((steps, volumes, components**2))
    ridge = 1e-3 * window * np.mean(strain**2) * np.eye(components)
    for t in range(steps):
        first = min(max(t - window // 2, 0), max(steps - window, 0))
        d_strain = strain[first : first + window].transpose(1, 0, 2)
        d_stress = stress[first : first + window].transpose(1, 0, 2)
        square = d_strain.transpose(0, 2, 1) @ d_strain + ridge
        product = d_strain.transpose(0, 2, 1) @ d_stress
        moduli[t] = np.linalg.solve(square, product).transpose(0, 2, 1).reshape(volumes, -1)
    return moduli


# ---- one volume ----------------------------------------------------------------------------


def _strained_volume(packings: Packings, number: int) -> tuple[NDArray, NDArray]:
    """Strain increments (T, 6) and stress (T, 6) [Pa] of one volume."""
    scenario = _scene(packings, number)
    density = [material.density for material in scenario.materials.values()]
    parallel = Parallel.alone()
    state = start(parallel, Bodies.from_arrays(place(parallel, scenario), density))
    state.rotating = True
    simulation = Simulation(parallel, scenario, state)
    for _ in range(packings.settling):
        simulation.step()
    strain, stress = np.empty((2, packings.steps, 6))
    for t in range(packings.steps):
        simulation.step()
        L = _velocity_gradient(simulation.state.bodies)
        strain[t] = 0.5 * packings.step * (L + L.T)[_ROW, _COLUMN]
        stress[t] = _stress(simulation, packings.step)[_ROW, _COLUMN]
    simulation.destroy()
    return strain, stress


def _scene(packings: Packings, number: int) -> Scenario:
    """A box without lid: walls across x press while those across y let go, and back."""
    rng = np.random.default_rng((packings.seed, number))
    start_time = packings.settling * packings.step
    times = start_time + packings.step * np.arange(0, packings.steps + 1, 8)
    since = times - start_time
    speed = np.zeros((2, len(times)))
    # Two tones; what closes along x opens along y, but for a part.
    for tone in (1.0, 2.3):
        frequency = packings.frequency * tone * rng.uniform(0.7, 1.3)
        phase = 2.0 * math.pi * rng.random() + np.array([0.0, math.pi]) + rng.uniform(-0.3, 0.3)
        reach = packings.amplitude / tone * rng.uniform(0.5, 1.0)
        clock = 2.0 * math.pi * frequency * since + phase[:, None]
        speed += 2.0 * math.pi * frequency * reach * np.sin(clock)
    # Walls begin to move gradually, not with a jerk.
    speed *= np.minimum(since / 0.1, 1.0)
    motions = [
        np.outer(side * speed[axis], np.eye(3)[axis]) for axis in (0, 1) for side in (1.0, -1.0)
    ]
    points = [[0, 0, 0], [SIDE, 0, 0], [0, 0, 0], [0, SIDE, 0], [0, 0, 0]]
    walls = [
        {"shape": "plane", "material": "glass", "point": point, "normal": normal.tolist()}
        for point, normal in zip(points, _NORMAL, strict=True)
    ]
    for wall, velocity in zip(walls, motions, strict=False):
        table = {"time": times.tolist(), "velocity": velocity.tolist()}
        wall["motion"] = {"table": table}
    scene = {
        "seed": packings.seed + number,
        "domain": {"min": [-SIDE, -SIDE, -SIDE], "max": [2 * SIDE, 2 * SIDE, 2 * HEIGHT]},
        "gravity": [0, 0, -9.81],
        "materials": {"glass": {"density": 2500}},
        "friction": {"default": 0.5},
        "bodies": [
            {
                "material": "glass",
                "count": packings.spheres,
                "radius": {"uniform": [0.9 * RADIUS, 1.1 * RADIUS]},
                "placement": {"random": {"min": [0, 0, 0], "max": [SIDE, SIDE, 2.5 * HEIGHT / 2]}},
            }
        ],
        "walls": walls,
        "time": {
            "step": packings.step, "end": packings.step * (packings.settling + packings.steps),
        },
        "contact": {"tolerance": 1e-3, "complementarity": 1e-2, "max_iterations": 20000},
    }  # fmt: skip
    return parse_scenario(json.dumps(scene), Path("packing.yaml")).scenario


def _velocity_gradient(bodies: Bodies) -> NDArray:
    """L (3, 3) of least sum |v - v0 - L (x - x0)|^2 over the bodies."""
    x = bodies.position - bodies.position.mean(axis=0)
    v = bodies.velocity - bodies.velocity.mean(axis=0)
    return np.linalg.solve(x.T @ x, x.T @ v).T


def _stress(simulation: Simulation, h: float) -> NDArray:
    """1/V sum over contacts of f times the vector between what touches (3, 3) [Pa], symmetric.

    V is the area between the walls times twice the height of the centre of mass.
    """
    bodies, memory = simulation.state.bodies, simulation.state.memory
    owner = np.repeat(np.arange(len(bodies)), np.diff(memory.offsets))
    row = np.empty(len(bodies), np.int64)
    row[bodies.gid] = np.arange(len(bodies))
    x, wall = bodies.position, memory.other < 0
    branch = np.empty((len(owner), 3))
    branch[~wall] = x[row[memory.other[~wall]]] - x[owner[~wall]]
    touched = _NORMAL[-1 - memory.other[wall]]
    branch[wall] = -bodies.radius[owner[wall], None] * touched
    sides = np.ptp(x[:, :2], axis=0) + 2.0 * RADIUS
    volume = sides[0] * sides[1] * 2.0 * x[:, 2].mean()
    moment = memory.impulse.T @ branch / (h * volume)
    return 0.5 * (moment + moment.T)
