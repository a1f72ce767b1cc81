"""Start programs on several ranks from a test, with a time limit that ends every rank."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# One thread a rank: tests oversubscribe the machine already.
_SETTINGS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_THREADING_LAYER": "omp",
    "H5PY_ALWAYS_USE_MPI": "1",
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "OMPI_MCA_hwloc_base_binding_policy": "none",
    "OMPI_MCA_mpi_yield_when_idle": "1",
}

# What a running MPI program finds in its environment; a program started from one must not see it.
_INHERITED = ("OMPI_COMM_", "OMPI_MCA_ess", "OMPI_MCA_orte", "OMPI_MCA_pmix", "PMIX_", "PMI_")


def rank_environment(extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """Environment for `mpirun`: ours, free of an outer MPI run's, plus `extra`."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(_INHERITED)}
    clean.pop("PYTEST_ADDOPTS", None)
    return {**clean, **_SETTINGS, **(extra or {})}


@cache
def _mpirun() -> tuple[str, ...]:
    """`mpirun` with the flag that keeps Open MPI from adding a banner to a rank's own message."""
    path = shutil.which("mpirun")
    if path is None:
        raise FileNotFoundError("mpirun is not on the PATH: run scripts/bootstrap")
    version = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
    return (path, "--quiet") if "Open MPI" in version.stdout else (path,)


def start_ranks(
    ranks: int,
    arguments: Sequence[str | Path],
    *,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> subprocess.Popen[str]:
    """Start `python ARGUMENTS` on `ranks` ranks in a process group of its own and return at once.

    Standard output and error are text pipes. End it with `kill_ranks`.
    """
    command = [*_mpirun(), "-n", str(ranks), sys.executable, *map(str, arguments)]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=rank_environment(env),
        cwd=cwd or ROOT,
        start_new_session=True,
    )


def kill_ranks(process: subprocess.Popen[str]) -> None:
    """End `mpirun` and its ranks: TERM first, since ranks stand in process groups of their own."""
    for number, grace in ((signal.SIGTERM, 5), (signal.SIGKILL, 5)):
        if process.poll() is not None:
            return
        try:
            os.killpg(process.pid, number)
            process.wait(grace)
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def run_ranks(
    ranks: int,
    arguments: Sequence[str | Path],
    *,
    timeout: float = 120.0,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run `python ARGUMENTS` on `ranks` ranks; return its exit code and captured output.

    After `timeout` seconds every rank is ended and the return code is -1, with the reason as the
    last line of `stderr`. For instance `run_ranks(3, ["-m", "dem_mpi", "run", scene])`.
    """
    process = start_ranks(ranks, arguments, env=env, cwd=cwd)
    try:
        out, err = process.communicate(timeout=timeout)
        code = process.returncode
    except subprocess.TimeoutExpired:
        kill_ranks(process)
        out, err = process.communicate()
        code, err = -1, f"{err}\nended after {timeout:g} s\n"
    finally:
        kill_ranks(process)
    return subprocess.CompletedProcess(process.args, code, out, err)
