"""What every benchmark shares: its options, its records, its environment, its figure's style."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "bench"
# A benchmark may have the name of the package that it measures: `import` is to find the package.
sys.path.insert(0, str(ROOT))


@dataclass
class Record:
    """One figure. `ratio` below 1 always means that this project wins."""

    name: str
    params: dict[str, Any]
    value: float
    unit: str
    rival: str | None = None
    rival_value: float | None = None
    ratio: float | None = None
    error: float | None = None
    runs: int = 1
    threads: int = 1
    ranks: int = 1
    commit: str = field(default_factory=lambda: commit())


def commit() -> str:
    """Return the short hash of the checked-out commit, with + if the tree differs from it."""
    try:
        call = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+", "--exclude=*"]
        return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def arguments(description: str) -> argparse.ArgumentParser:
    """Return the parser of the options that all benchmarks have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="reduced sizes, within 8 minutes")
    parser.add_argument("--json", type=Path, help="write the records to this file")
    parser.add_argument("--figure", type=Path, help="draw the figure into this file")
    return parser


def write(records: list[Record], path: Path | None = None) -> None:
    """Print the records, and write them as JSON if a path is given."""
    for r in records:
        versus = f"  {r.rival} {r.rival_value:.4g}  ratio {r.ratio:.3g}" if r.rival else ""
        print(f"{r.name}  {json.dumps(r.params)}  {r.value:.5g} {r.unit}{versus}", flush=True)
    save(records, path)


def save(records: list[Record], path: Path | None) -> None:
    """Write the records as JSON if a path is given."""
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps([asdict(r) for r in records], indent=1) + "\n")


def put(name: str, text: str, page: Path) -> None:
    """Replace what stands in a Markdown page between the markers of this name."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, _, rest = page.read_text().partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{page}: no '{begin}' with '{end}' behind it")
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}")


def mpirun(ranks: int, command: list[str], limit: float | None = None) -> None:
    """Run this interpreter with `command` on so many ranks, one thread each; raise if it fails.

    After `limit` seconds mpirun is told to end its ranks, and TimeoutExpired raised.
    """
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "NUMBA_THREADING_LAYER": os.environ.get("NUMBA_THREADING_LAYER", "omp"),
        "H5PY_ALWAYS_USE_MPI": "1",
        "OMPI_MCA_hwloc_base_binding_policy": "none",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
    }
    if ranks > (os.cpu_count() or 1):
        environment |= {"OMPI_MCA_mpi_yield_when_idle": "1"}
    if os.geteuid() == 0:
        environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    call = ["mpirun", "--quiet", "-n", str(ranks), sys.executable, *command]
    with subprocess.Popen(call, env=environment, cwd=ROOT) as process:
        try:
            code = process.wait(limit)
        except BaseException:
            process.terminate()
            raise
    if code:
        raise subprocess.CalledProcessError(code, call)
