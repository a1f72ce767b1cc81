"""dem-mpi with one thing going wrong: python faulty_run.py FAULT DEM_MPI_ARGUMENTS...

FAULT is JSON: {"do": what, "rank": on which rank, "step": in which step, ...}. What there is to do:

raise, refuse    an exception of the program, an error for the user, on that rank alone
kill             the process ends without a word
signal           USR1 comes in the middle of the step
signal_in_warm_up  USR1 comes while kernels are compiled
nan              a velocity becomes not a number before the step
nan_impulse      the solver returns an impulse that is not a number
fill             the disk of the output becomes full (`path`: a file that takes what is left)
limit            files may not grow beyond `bytes`
kill_at_stage    the process ends after `stage` of the write of the checkpoint of that step
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import sys
from pathlib import Path

import numpy as np

from dem_mpi import __main__ as program
from dem_mpi import runner, warmup
from dem_mpi.errors import OutputError
from dem_mpi.simulation import Simulation
from dem_mpi.solvers.apgd import Apgd


def fill(path: Path) -> None:
    """Take every free byte of a disk."""
    with contextlib.suppress(OSError), path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 12))


def strike(fault: dict, simulation: Simulation) -> None:
    """What happens at the beginning of the step, on the rank it is meant for."""
    if "marker" in fault:
        Path(fault["marker"]).touch()
    match fault["do"]:
        case "raise":
            raise RuntimeError("a fault made by a test")
        case "refuse":
            raise OutputError("a fault made by a test")
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "signal":
            os.kill(os.getpid(), signal.SIGUSR1)
        case "nan":
            simulation.state.bodies.velocity[0, 1] = np.nan
        case "nan_impulse":
            spoil_the_solver()
        case "fill":
            fill(Path(fault["path"]))
        case "limit":
            resource.setrlimit(resource.RLIMIT_FSIZE, (fault["bytes"], resource.RLIM_INFINITY))


def spoil_the_solver() -> None:
    original = Apgd.solve

    def solve(self, *arguments):
        report = original(self, *arguments)
        report.impulse[:1] = np.nan
        return report

    Apgd.solve = solve


def install(fault: dict) -> None:
    """Let the fault happen in the run to come."""
    step, run, warm_up = Simulation.step, runner.run, warmup.warm_up
    state = {}

    def faulty_step(self):
        state["step"] = self.state.step + 1
        if state["step"] == fault.get("step") and self.parallel.rank == fault["rank"]:
            strike(fault, self)
        return step(self)

    def on_stage(name: str) -> None:
        if state.get("step", 0) >= fault["step"] and name == fault["stage"]:
            os.kill(os.getpid(), signal.SIGKILL)

    def faulty_run(parallel, *arguments):
        # The warm-up steps too, on ranks of its own; its steps are none of the run's.
        Simulation.step = faulty_step
        if fault["do"] == "kill_at_stage" and parallel.rank == fault["rank"]:
            run(parallel, *arguments, on_stage=on_stage)
        else:
            run(parallel, *arguments)

    def faulty_warm_up(parallel, *arguments):
        if fault["do"] == "signal_in_warm_up" and parallel.rank == fault["rank"]:
            os.kill(os.getpid(), signal.SIGUSR1)
        warm_up(parallel, *arguments)

    runner.run, warmup.warm_up = faulty_run, faulty_warm_up


if __name__ == "__main__":
    install(json.loads(sys.argv[1]))
    sys.argv = ["dem-mpi", *sys.argv[2:]]
    program.main()
