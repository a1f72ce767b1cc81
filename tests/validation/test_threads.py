"""The number of threads a rank is no part of the answer."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from dem_mpi._kernels_solver import CHUNK
from dem_mpi.parallel import Parallel
from dem_mpi.simulation import Simulation
from dem_mpi.warmup import set_threads

from scenes import placed, scene


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="numba was given one thread")
def test_two_threads_give_the_bits_of_one() -> None:
    """Twenty steps of a thousand touching spheres: every array of the bodies and impulses equal.

    Sums are taken in chunks; with more than one chunk two threads share them.
    """
    group = {
        "material": "m",
        "count": 1000,
        "radius": 0.01,
        "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [0.2, 0.2, 0.2]}},
        "velocity": [0, 0, -0.1],
        "velocity_jitter": 0.1,
    }
    walls = [{"shape": "box", "material": "m", "min": [0, 0, 0], "max": [0.2, 0.2, 0.4]}]
    contact = {"max_iterations": 20, "stop_factor": 1e9}
    ends, parallel = [], Parallel.alone()
    for threads in (1, 2):
        set_threads(threads)
        scenario = scene(
            step=2e-4, mu=0.3, bodies=[group], walls=walls, contact=contact, threads=threads
        )
        simulation = Simulation(parallel, scenario, placed(parallel, scenario))
        contacts = [simulation.step().contacts for _ in range(20)]
        ends.append({**simulation.state.bodies.arrays(), "i": simulation.state.memory.impulse})
    set_threads(1)
    assert min(contacts) > CHUNK
    for name, array in ends[0].items():
        np.testing.assert_array_equal(array, ends[1][name], err_msg=name)
