"""Compile every kernel before the work starts, by one rank first: two would race on the cache."""

from __future__ import annotations

from itertools import product

import numba
import numpy as np

from dem_mpi._jit import compile_clock
from dem_mpi.bodies import Bodies
from dem_mpi.errors import InputError
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import parse_scenario
from dem_mpi.scene_bodies import SHAPES
from dem_mpi.scene_models import Scenario, only_spheres
from dem_mpi.simulation import Simulation, start

# The kinds of scene that have kernels of their own, by the shape of the bodies that call them.
SPHERES, GENERAL = "sphere", "spherocylinder"
_ASPECT_RATIO = {SPHERES: "null", GENERAL: "2"}

# Every kernel of a run is called in two steps of this scene.
_SCENE = """
domain: {{min: [-1, -1, -1], max: [1, 1, 1]}}
materials: {{m: {{density: 1000}}}}
friction: {{default: 0.3}}
bodies:
  - {{shape: {shape}, aspect_ratio: {aspect_ratio}, material: m, count: 4, radius: 0.1,
      placement: {{jittered_grid: {{min: [-0.8, -0.8, 0], max: [0.4, 0.4, 0.4]}}}}}}
  - {{material: m, count: 1, radius: 0.1,
      placement: {{insertion: {{min: [0.5, 0.5, 0], max: [0.8, 0.8, 0.3], rate: 1}}}}}}
  - {{material: m, count: 1, radius: 0.1,
      placement: {{random: {{min: [-0.9, -0.9, 0], max: [-0.5, -0.5, 0.4]}}}}}}
walls:
  - {{shape: plane, material: m, point: [0, 0, 0], normal: [0, 0, 1],
      motion: {{velocity: [0, 0, 0.1]}}}}
time: {{step: 1e-3, end: 2e-3}}
threads: {threads}
contact: {{operator: {operator}, solver: {solver}, law: {law}, max_iterations: 3,
  tolerance: 1e-12, complementarity: 1e-15, stop_factor: 1e30, scip: {{form: {form}}}}}
"""
# What solver: auto may call, and form: auto.
_SOLVERS = {"apgd": ("apgd",), "scip": ("scip",), "auto": ("apgd", "scip")}
_FORMS = {"velocity": ("velocity",), "contact": ("contact",), "auto": ("velocity", "contact")}


def set_threads(threads: int) -> None:
    """Use so many threads a rank. Raises InputError if numba was started with fewer."""
    available = int(numba.config.NUMBA_NUM_THREADS)
    if threads > available:
        raise InputError(
            f"threads = {threads}: this process may use {available}; lower threads, or set "
            f"NUMBA_NUM_THREADS and let the launcher give each rank more cores"
        )
    numba.set_num_threads(threads)


def warm_up(
    parallel: Parallel,
    threads: int,
    operators: tuple[str, ...] = ("matrix_free",),
    kinds: tuple[str, ...] = (SPHERES,),
    solvers: tuple[str, ...] = ("apgd",),
    law: str = "ccp",
    form: str = "auto",
) -> int:
    """Collective. Compile what these operators and kinds of scene use on rank 0, then load it.

    kinds : SPHERES, GENERAL or both; a scene with any body that is not a sphere is GENERAL.
    solvers, law, form : as in the contact section of a scene; nothing else is compiled, and PETSc
    is not even imported where neither operators nor Newton's method, of an interior point or of
    Coulomb's law, need it.
    Returns how many variants of kernels this rank compiled, having found them in no cache.
    """
    called = [
        (solver, shape)
        for solver in sorted({each for asked in solvers for each in _SOLVERS[asked]})
        for shape in (_FORMS[form] if solver == "scip" else ("auto",))
    ]
    newton = law == "coulomb" or any(solver == "scip" for solver, _ in called)
    if newton or "assembled" in operators:
        # PETSc starts on all ranks together: one that came alone would wait for the others.
        import petsc4py.PETSc  # noqa: F401
    error = None
    with compile_clock() as compiled:
        for turn in (True, False):
            if (parallel.rank == 0) == turn:
                try:
                    for operator, kind, (solver, shape) in product(operators, kinds, called):
                        _exercise(threads, operator, kind, solver, law, shape)
                except Exception as caught:
                    error = caught
            parallel.raise_together(error)
    return compiled.count


def kind_of(scenario: Scenario) -> str:
    """The kind of a scene: SPHERES or GENERAL."""
    return SPHERES if only_spheres(scenario) else GENERAL


def _exercise(threads: int, operator: str, kind: str, solver: str, law: str, form: str) -> None:
    """Run two steps of a scene of four bodies on this rank alone."""
    alone = Parallel.alone()
    text = _SCENE.format(
        threads=threads,
        operator=operator,
        shape=kind,
        aspect_ratio=_ASPECT_RATIO[kind],
        solver=solver,
        law=law,
        form=form,
    )
    scenario = parse_scenario(text, "warm-up").scenario
    place(alone, scenario)  # random places have kernels of their own
    position = np.array([[0.0, 0, 0.1], [0.2, 0, 0.1], [0, 0.2, 0.1], [0.2, 0.2, 0.1]])
    arrays = {
        "gid": np.arange(4),
        "material": np.zeros(4, np.int32),
        "radius": np.full(4, 0.1),
        "shape": np.full(4, SHAPES.index(kind), np.int8),
        "half_length": np.full(4, 0.1 if kind == GENERAL else 0.0),
        "position": position,
    }
    state = start(alone, Bodies.from_arrays(arrays, np.array([1000.0])))
    simulation = Simulation(alone, scenario, state)
    simulation.step()
    simulation.step()
    simulation.destroy()
    alone.free()
