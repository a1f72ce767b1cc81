"""What the ranks of stokes.py do: one measurement of flow around rigid bodies, in a process.

A task is a dictionary with `kind`, and beside it

    single     panels, modes: S. De's section 3.6.1 at one resolution
    solve      scene, data, formulation, tolerance, resolution, options: one suspension
    multiblob  scene, blobs, reference: the rival on the same bodies
    squirmers  edge, spacing, tolerance: S. De's section 3.6.3

`scene` is [name of a function of stokes_scenes, its arguments]. `data` are velocities at the
surfaces: "point_forces" of a flow that is known exactly, or "rigid", a motion of each body.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

import numpy as np
from lib import stokes_scenes as scenes
from lib.stokes_scenes import PointForces, Scene
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel

NODES = 10  # of a panel, S. De's
FAR_POINTS, NEAR_POINTS = 1000, 600
NEAR_DISTANCES = (1e-1, 1e-2, 1e-3)


def work(parallel: Parallel, task: dict[str, Any]) -> dict[str, Any]:
    """Collective. Do a task; rank 0 has all of the result."""
    return {
        "single": _single,
        "solve": _solve,
        "multiblob": _multiblob,
        "squirmers": _squirmers,
    }[task["kind"]](parallel, task)


class Clock:
    """Seconds of named pieces of work, between barriers, and of this rank's processor."""

    def __init__(self, parallel: Parallel) -> None:
        self._parallel = parallel
        self.seconds: dict[str, float] = {}
        self.processor = 0.0

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Collective. Add what the block takes to the seconds of `name`."""
        self._parallel.barrier()
        began, busy = perf_counter(), process_time()
        yield
        self._parallel.barrier()
        self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - began
        self.processor += process_time() - busy


def scene_of(task: dict[str, Any]) -> Scene:
    """The scene that a task names."""
    name, arguments = task["scene"]
    if name == "random_spheroids":
        arguments = arguments | {"directory": Path(arguments["directory"])}
    return getattr(scenes, name)(**arguments)


def _memory(parallel: Parallel) -> float:
    """Largest resident set so far of all ranks together [bytes]."""
    return parallel.sum(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0)


# ---- one body ------------------------------------------------------------------------------


def _single(parallel: Parallel, task: dict[str, Any]) -> dict[str, Any]:
    """Seconds of each stage and the error outside, with the single layer."""
    from stokes.evaluate import evaluate
    from stokes.fmm import FmmOptions
    from stokes.formulation import ShapeSolver
    from stokes.geometry import Resolution, SurfaceGrid
    from stokes.operators import ModalOperators

    scene = scenes.single()
    (body,) = scene.bodies()
    flow, points = scenes.forces_inside_single(scene), scenes.points_around_single(scene)
    exact = flow.velocity(points)

    def once(resolution: Resolution) -> tuple[dict[str, float], NDArray]:
        clock = Clock(parallel)
        with clock.of("kernels"):
            operators = ModalOperators(body.curve, resolution)
            operators.matrices("single")
        solver = ShapeSolver(operators, task["formulation"])
        grid: SurfaceGrid = solver.grid
        data = body.vectors_to_local(flow.velocity(body.to_world(grid.points.reshape(-1, 3))))
        with clock.of("factorisation"):  # at the first solve, whose share is taken off below
            solver.solve(data.reshape(grid.points.shape))
        with clock.of("solve"):
            density = solver.solve(data.reshape(grid.points.shape))
        first = clock.seconds["factorisation"]
        clock.seconds["factorisation"] = max(first - clock.seconds["solve"], 0.0)
        with clock.of("evaluation"):
            rho, mu = solver.layers(density, body.scale)
            found = evaluate([body], [resolution], points, _flat(rho), _flat(mu),
                             tolerance=1e-13, options=FmmOptions(backend="direct"))  # fmt: skip
        return clock.seconds, found

    once(Resolution.uniform(2, NODES, 4))  # compiles, or loads what is compiled
    resolution = Resolution.uniform(task["panels"], NODES, task["modes"])
    rounds = [once(resolution) for _ in range(task.get("runs", 1))]
    error = np.abs(rounds[-1][1] - exact)
    return {
        "nodes": resolution.surface_nodes,
        "seconds": {k: float(np.median([s[k] for s, _ in rounds])) for k in rounds[0][0]},
        "runs": len(rounds),
        "error_absolute": float(error.max()),
        "error_to_largest": float(error.max() / np.abs(exact).max()),
        "error_by_component": float((error / np.abs(exact)).max()),
        "memory": _memory(parallel),
    }


def _flat(density: NDArray | None) -> NDArray | None:
    return None if density is None else density.reshape(-1, 3)


# ---- a suspension --------------------------------------------------------------------------


def _solve(parallel: Parallel, task: dict[str, Any]) -> dict[str, Any]:
    """One suspension: seconds by phase, medians of `runs`; iterations, errors."""
    _warm_up(parallel, task)
    scene, runs = scene_of(task), task.get("runs", 1)
    fast = task | {"points": False}
    rounds = [_measured(parallel, scene, fast) for _ in range(runs - 1)]
    rounds.append(_measured(parallel, scene, task))
    medians = {
        kind: {k: median(r[kind][k] for r in rounds if k in r[kind]) for k in rounds[-1][kind]}
        for kind in ("seconds", "phases")
    }
    return rounds[-1] | medians | {"runs": runs}


def _warm_up(parallel: Parallel, task: dict[str, Any]) -> None:
    """Compile, or load what is compiled, by two bodies that nearly touch."""
    small = scenes.pair((0.6, 1.0), 0.15, "side")
    data = "point_forces" if task.get("data") == "point_forces" else "random"
    _measured(parallel, small, task | {"data": data, "resolution": None, "points": False})


def suspension_of(parallel: Parallel, scene: Scene, task: dict[str, Any]) -> Any:
    """Collective. The suspension that a task asks for, this rank with its share of the bodies."""
    from stokes.geometry import Resolution
    from stokes.suspension import Suspension, SuspensionOptions, distribute

    options = dict(task.get("options", {}))
    if task.get("resolution"):
        panels, modes = task["resolution"]
        options["resolution"] = Resolution.uniform(panels, NODES, modes)
    return Suspension(
        distribute(scene.bodies(), parallel),
        tolerance=task["tolerance"],
        formulation=task["formulation"],
        parallel=parallel,
        options=SuspensionOptions(**options),
    )


def _measured(parallel: Parallel, scene: Scene, task: dict[str, Any]) -> dict[str, Any]:
    clock = Clock(parallel)
    flow = scenes.forces_at_centres(scene)
    with clock.of("set-up"):
        suspension = suspension_of(parallel, scene, task)
    with clock.of("solve"):
        if task["data"] == "point_forces":
            solution = suspension.solve(boundary_velocity=flow.velocity)
        else:
            (velocity, spin), mine = motion_of(scene, task["data"]), rows_of(scene, suspension)
            solution = suspension.solve(velocity=velocity[mine], angular_velocity=spin[mine])
    found = described(parallel, scene, suspension, solution)
    loads = np.array(found["loads"])
    if task["data"] == "point_forces":
        found["error_of_forces"] = float(np.abs(loads[:, :3] + flow.forces).max())
        if task.get("points", True):
            found |= _errors_at_points(parallel, clock, scene, flow, solution)
    return found | {
        "seconds": clock.seconds,
        "processor_seconds": parallel.max(clock.processor),
        "memory": _memory(parallel),
    }


def motion_of(scene: Scene, data: str) -> tuple[NDArray, NDArray]:
    """Velocities and angular velocities (n, 3): random, or along z, alike or in turn opposed."""
    rest = np.zeros((scene.count, 3))
    if data == "random":
        rng = np.random.default_rng([scenes.SEED, 5])
        return rng.standard_normal((scene.count, 3)), rng.standard_normal((scene.count, 3))
    along = np.zeros((scene.count, 3))
    sign = np.where(np.arange(scene.count) % 2 == 0, 1.0, -1.0)
    along[:, 2] = 1.0 if data in ("same", "spin_same") else sign
    return (rest, along) if data.startswith("spin") else (along, rest)


def rows_of(scene: Scene, suspension: Any) -> NDArray:
    """Rows of this rank's bodies in the scene."""
    row = {body: k for k, body in enumerate(scene.bodies())}
    return np.array([row[body] for body in suspension.bodies], dtype=int)


def described(parallel: Parallel, scene: Scene, suspension: Any, solution: Any) -> dict[str, Any]:
    """Collective. What is said of a solution whatever was asked."""
    loads = np.zeros((scene.count, 6))
    loads[rows_of(scene, suspension)] = np.concatenate([solution.forces, solution.torques], axis=1)
    parallel.sum_in_place(loads)
    phases = {k: parallel.max(float(v)) for k, v in sorted(solution.report.seconds.items())}
    return {
        "bodies": scene.count,
        "nodes": suspension.report.nodes,
        "applications": solution.report.applications,
        "gap": scene.gap,
        "volume_fraction": scene.volume_fraction,
        "iterations": solution.iterations,
        "converged": bool(solution.converged),
        "residual": float(solution.residuals[-1]),
        "phases": phases,
        "loads": loads.tolist(),
    }


def _errors_at_points(
    parallel: Parallel, clock: Clock, scene: Scene, flow: PointForces, solution: Any
) -> dict[str, Any]:
    """Collective. Largest errors in the box (with one) and at each distance from the surfaces."""
    sets: dict[str, NDArray] = {}
    if scene.box:
        sets["box"] = scenes.points_in_box(scene, FAR_POINTS)
    for distance in NEAR_DISTANCES:
        sets[f"{distance:g}"] = scenes.points_at_surfaces(scene, NEAR_POINTS, [distance])
    worst, largest = {}, 0.0
    for name, points in sets.items():
        share = slice(parallel.rank, None, parallel.size)
        with clock.of(f"evaluation {name}"):
            u = solution.velocity(points[share])
        exact = flow.velocity(points[share])
        worst[name] = parallel.max(float(np.abs(u - exact).max(initial=0.0)))
        largest = max(largest, parallel.max(float(np.abs(exact).max(initial=0.0))))
    relative = {name: error / largest for name, error in worst.items()}
    return {"error_absolute": worst, "error_to_largest": relative}


# ---- the rival -----------------------------------------------------------------------------


def _multiblob(parallel: Parallel, task: dict[str, Any]) -> dict[str, Any]:
    """Loads on the same bodies by shells of blobs; one rank."""
    from lib.multiblob import Multiblob, shell

    scene = scene_of(task)
    velocity, spin = motion_of(scene, task["data"])

    def once(count: int, blobs: int) -> tuple[Any, float]:
        began = perf_counter()
        shells = {
            tuple(axes): shell((axes[0], axes[0], axes[1]), blobs)
            for axes in scene.semi_axes[:count].tolist()
        }
        chosen = [shells[tuple(axes)] for axes in scene.semi_axes[:count].tolist()]
        rotations, centres = scene.rotations[:count], scene.centres[:count]
        solver = Multiblob(chosen, centres, rotations, task["tolerance"])
        found = solver.solve(velocity[:count], spin[:count])
        return found, perf_counter() - began

    once(2, 20)
    solution, whole = once(scene.count, task["blobs"])
    loads = np.concatenate([solution.forces, solution.torques], axis=1)
    return {
        "bodies": scene.count,
        "nodes": task["blobs"] * scene.count,
        "iterations": solution.iterations,
        "residual": solution.residual,
        "converged": True,
        "seconds": {"set-up": whole - solution.solve, "solve": solution.solve},
        "loads": loads.tolist(),
        "memory": _memory(parallel),
    }


# ---- active spheroids ----------------------------------------------------------------------


def pole_to_pole(equatorial: float, polar: float, speed: float, points: NDArray) -> NDArray:
    """Slip (k, 3) at points (k, 3) of a spheroid in its frame, along meridians to the north pole.

    speed r / equatorial: `speed` at the equator, zero at the poles.
    """
    x, y, z = points.T
    r2, slope = x**2 + y**2, -z / polar**2
    # r times the meridian's tangent, (-z/c^2 along r, r/a^2 along z) over its length.
    tangent = np.stack([slope * x, slope * y, r2 / equatorial**2], axis=1)
    length = np.sqrt(r2 / equatorial**4 + slope**2)
    return (speed / (equatorial * length))[:, None] * tangent


def _squirmers(parallel: Parallel, task: dict[str, Any]) -> dict[str, Any]:
    """Seconds of a solve with the spheroids held, and free; flow on a plane through them."""
    _warm_up(parallel, task)
    scene = scenes.grid_of_spheroids(task["edge"], task["spacing"])
    clock = Clock(parallel)
    with clock.of("set-up"):
        suspension = suspension_of(parallel, scene, task)
    slip = [partial(pole_to_pole, body.curve.equatorial, body.curve.polar, task["speed"])
            for body in suspension.bodies]  # fmt: skip
    with clock.of("held"):
        held = suspension.solve(velocity=(0.0, 0.0, 0.0), slip=slip)
    found = described(parallel, scene, suspension, held)
    with clock.of("free"):
        free = suspension.solve(slip=slip)
    plane = middle_plane(scene, task["pixels"])
    points = plane.points()
    share = slice(parallel.rank, None, parallel.size)
    with clock.of("evaluation"):
        mine = held.velocity(points[share])
    velocity = np.zeros((len(points), 3))
    velocity[share] = mine  # NaN inside bodies, also of the sum over the ranks
    parallel.sum_in_place(velocity)
    if parallel.rank == 0 and task.get("field"):
        np.save(task["field"], velocity)
    return found | {
        "iterations_free": free.iterations,
        "fastest": parallel.max(float(np.linalg.norm(free.velocities, axis=1).max())),
        "seconds": clock.seconds,
        "points": len(points),
        "memory": _memory(parallel),
    }


def middle_plane(scene: Scene, pixels: int) -> Any:
    """The plane through the middle layer of the grid, across y."""
    from stokes.render import Plane

    middle, low, high = 0.5 * scene.box, (0.0, 0.0), (scene.box, scene.box)
    return Plane(1, middle, low, high, (pixels, pixels))
