"""What a run says about itself: seconds by phase, one line a step, progress, the closing table.

Nothing here changes a result: clocks are read, never decided by.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any, TextIO

import numpy as np
from rich.console import Console
from rich.table import Table

from dem_mpi.h5files import agree
from dem_mpi.parallel import Parallel

PHASES = (
    "partition", "neighbours", "contacts", "assemble", "solve", "advance", "record", "compress",
)  # fmt: skip
_ASKED_FOR = ("compress",)  # phases that most scenes have not


class PhaseTimer:
    """Seconds of this rank spent in each phase, of the current step and of the run."""

    def __init__(self) -> None:
        self.step = np.zeros(len(PHASES))
        self.total = np.zeros(len(PHASES))

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time of the body of the `with` to a phase."""
        started = perf_counter()
        try:
            yield
        finally:
            self.step[PHASES.index(name)] += perf_counter() - started

    def finish_step(self) -> None:
        """Move the step's seconds to the total."""
        self.total += self.step
        self.step[:] = 0.0


def on_terminal() -> bool:
    """Whether a person watches standard output.

    Open MPI gives every rank a pseudo-terminal of its own, whatever mpirun itself writes to: there
    the parent process's output decides.
    """
    if not sys.stdout.isatty():
        return False
    if "OMPI_COMM_WORLD_RANK" not in os.environ:
        return True
    try:
        return os.readlink(f"/proc/{os.getppid()}/fd/1").startswith(("/dev/pts/", "/dev/tty"))
    except OSError:
        return False


def peak_memory() -> int:
    """Return the largest resident memory this process has had [B]."""
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale


def resident_memory() -> int:
    """Return the resident memory of this process now [B]; its peak where that is not known."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return peak_memory()
    return pages * os.sysconf("SC_PAGE_SIZE")


class MetricsLog:
    """`metrics.jsonl`: one line a step, written by rank 0 and flushed."""

    def __init__(self, parallel: Parallel, path: Path, last_step: int) -> None:
        """Collective. Open for appending; drop lines after `last_step` (-1: all) of a crash."""
        self._parallel, self._path = parallel, path
        self._file: TextIO | None = None
        with agree(parallel, path, "write"):
            if parallel.rank == 0:
                kept = _lines_up_to(path, last_step) if path.exists() else []
                path.write_text("".join(kept))
                self._file = path.open("a")

    def write(self, record: dict[str, Any]) -> None:
        """Collective. Append rank 0's record. Raises OutputError on all ranks if it cannot."""
        with agree(self._parallel, self._path, "write"):
            if self._file is not None:
                self._file.write(json.dumps(record) + "\n")
                self._file.flush()

    def close(self) -> None:
        """Close the file. What is still unwritten after a full disk is one line at most."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()


def _lines_up_to(path: Path, last_step: int) -> list[str]:
    kept = []
    for line in path.read_text().splitlines(keepends=True):
        try:
            if json.loads(line)["step"] > last_step:
                break
        except (ValueError, KeyError, TypeError):
            break  # the line that the crash cut short
        kept.append(line)
    return kept


class Progress:
    """One live line on a terminal, a plain line now and then elsewhere; rank 0 only."""

    SECONDS_BETWEEN_PLAIN_LINES = 10.0

    def __init__(self, parallel: Parallel, first_step: int, steps: int, flagged: int) -> None:
        self._quiet = parallel.rank != 0
        self._live = on_terminal()
        self._first, self._steps = first_step, steps
        self._started = self._last = perf_counter()
        self._shown = False
        self._width = 0

    def show(self, record: dict[str, Any], end_time: float, flagged: int) -> None:
        """Report one finished step."""
        if self._quiet:
            return
        now = perf_counter()
        interval = 0.2 if self._live else self.SECONDS_BETWEEN_PLAIN_LINES
        done = record["step"] - self._first
        if self._shown and now - self._last < interval and record["step"] < self._steps:
            return
        self._shown, self._last = True, now
        pace = (now - self._started) / max(done, 1)
        left = pace * (self._steps - record["step"])
        text = (
            f"step {record['step']}/{self._steps}  t = {record['time']:.6g}/{end_time:.6g} s  "
            f"contacts {record['contacts']:,}  {_iterations(record)}  "
            f"r_d {record['r_d']:.1e} m/s  {pace:.3g} s/step  remaining {duration(left)}"
        )
        if flagged:
            text += f"  [{flagged} steps missed the tolerance]"
        if self._live:
            self._width = max(self._width, len(text))
            sys.stdout.write("\r" + text.ljust(self._width))
        else:
            sys.stdout.write(text + "\n")
        sys.stdout.flush()

    def finish(self) -> None:
        """Leave the live line."""
        if not self._quiet and self._live and self._shown:
            sys.stdout.write("\n")
            sys.stdout.flush()


def _iterations(record: dict[str, Any]) -> str:
    """What the solver did in a step, in words; factorisations only where there were any."""
    if not record["factorisations"]:
        return f"iterations {record['iterations']}"
    return (
        f"{record['solver']}: iterations {record['iterations']}, "
        f"factorisations {record['factorisations']}"
    )


class SolverCounts:
    """How often each method made a step's impulses, and what all steps together took."""

    def __init__(self) -> None:
        self._steps: dict[str, int] = {}
        self._iterations = self._factorisations = self._outer = 0

    def add(self, solver: str, iterations: int, factorisations: int, outer: int) -> None:
        """Count one step."""
        self._steps[solver] = self._steps.get(solver, 0) + 1
        self._iterations += iterations
        self._factorisations += factorisations
        self._outer += outer

    def facts(self) -> list[str]:
        """Lines for the closing table; none where gradients alone solved one problem a step."""
        steps = sum(self._steps.values())
        if not self._factorisations and self._outer <= steps:
            return []
        by = ", ".join(f"{name} in {count:,} steps" for name, count in sorted(self._steps.items()))
        gradients = self._iterations - self._factorisations
        parts = [f"solved by {by}", f"{gradients:,} gradient iterations"]
        if self._factorisations:
            parts.append(f"{self._factorisations:,} Newton iterations")
        if self._outer > steps:
            parts.append(f"{self._outer:,} cone problems")
        return ["; ".join(parts)]


def duration(seconds: float) -> str:
    """A time for people: '3 min 20 s'."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {whole % 60:02d} s"


def closing_table(parallel: Parallel, timer: PhaseTimer, wall: float, facts: list[str]) -> None:
    """Collective. Print seconds by phase (min, mean, max over ranks), imbalance and peak memory."""
    seconds = parallel.allgather(np.append(timer.total, [wall, float(peak_memory())]))
    if parallel.rank:
        return
    table = Table(title=f"seconds by phase over {parallel.size} ranks", title_justify="left")
    for name in ("phase", "min", "mean", "max", "max/mean", "share"):
        table.add_column(name, justify="left" if name == "phase" else "right")
    spent = max(float(seconds[:, : len(PHASES)].sum(axis=1).mean()), 1e-12)
    for k, name in enumerate(PHASES):
        column = seconds[:, k]
        mean = float(column.mean())
        if name in _ASKED_FOR and not column.any():
            continue
        ratio = f"{column.max() / mean:.2f}" if mean > 0 else "-"
        table.add_row(
            name, f"{column.min():.2f}", f"{mean:.2f}", f"{column.max():.2f}", ratio,
            f"{100 * mean / spent:.0f} %",
        )  # fmt: skip
    console = Console(
        file=sys.stdout, highlight=False, force_terminal=on_terminal(), soft_wrap=True
    )
    console.print(table)
    memory = seconds[:, -1] / 2**20
    console.print(
        f"wall time {seconds[:, -2].max():.2f} s; peak memory per rank {memory.max():.0f} MiB"
        f" (largest), {memory.mean():.0f} MiB (mean)"
    )
    for fact in facts:
        console.print(fact)
