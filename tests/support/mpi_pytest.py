"""Run tests marked `mpi(ranks=[...])` under mpirun and report them as ordinary tests.

The pytest the user starts (`Dispatcher`) turns a marked test into one test per rank count. All
tests of one file and rank count run in one `mpirun`, whose ranks each run pytest on this file as a
program (`RankReporter`) and write what they see to a record of their own. A test passes if it
passes on every rank. The first failure on any rank aborts the whole run, because the other ranks
may be waiting in a collective call; the dispatcher then starts a new run for the tests left.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import re
import sys
import time
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from launch import ROOT, run_ranks

DEFAULT_RANKS = (1, 2, 3)
DEFAULT_TIMEOUT = 120.0  # [s] one test on all ranks
_START_TIMEOUT = 90.0  # [s] interpreter, imports, collection
_GRACE = 0.5  # [s] for the other ranks to record their own failure before the abort
_ABORTED = 1


def rank_counts(item: Any) -> tuple[int, ...]:
    """Rank counts of a test's `mpi` marker; empty for a serial test."""
    marker = item.get_closest_marker("mpi")
    if marker is None:
        return ()
    ranks = marker.args[0] if marker.args else marker.kwargs.get("ranks", DEFAULT_RANKS)
    return (ranks,) if isinstance(ranks, int) else tuple(ranks)


def _timeout(item: pytest.Item) -> float:
    """Seconds one test may take: `mpi(..., timeout=)`."""
    marker = item.get_closest_marker("mpi")
    return float(marker.kwargs.get("timeout", DEFAULT_TIMEOUT)) if marker else DEFAULT_TIMEOUT


def _parametrize(metafunc: pytest.Metafunc, ranks: Iterable[int]) -> None:
    """One test per rank count, named alike in the dispatcher and on the ranks."""
    metafunc.fixturenames.append("rank_count")
    ids = [f"{n}ranks" for n in ranks]
    metafunc.parametrize("rank_count", list(ranks), ids=ids)


@dataclass
class _Record:
    """What one rank wrote: reports by test, in order, and the tests it began."""

    began: list[str] = field(default_factory=list)
    ended: set[str] = field(default_factory=set)
    reports: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> _Record:
        record = cls()
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                entry = json.loads(line)
            except ValueError:  # the rank was killed while writing
                break
            match entry["what"]:
                case "begin":
                    record.began.append(entry["test"])
                case "end":
                    record.ended.add(entry["test"])
                case "report":
                    record.reports.setdefault(entry["test"], []).append(entry["data"])
        return record

    def outcome(self, test: str) -> str | None:
        """`failed`, `skipped` or `passed`; None while the test is unfinished."""
        outcomes = [report["outcome"] for report in self.reports.get(test, ())]
        if "failed" in outcomes:
            return "failed"
        if test not in self.ended:
            return None
        return "skipped" if "skipped" in outcomes else "passed"


class Dispatcher:
    """In the user's pytest: runs marked tests under mpirun, one run per file and rank count."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._reports: dict[str, list[pytest.TestReport]] = {}
        self._directory: Path | None = None
        self._runs = 0

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        ranks = rank_counts(metafunc.definition)
        if ranks:
            _parametrize(metafunc, ranks)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> Any:
        if not rank_counts(item):
            return None
        hook = item.ihook
        hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        if item.nodeid not in self._reports:
            self._run_group(item)
        for report in self._reports[item.nodeid]:
            hook.pytest_runtest_logreport(report=report)
        # Nothing is up for this item itself, but what its predecessor shares with it is.
        item.session._setupstate.teardown_exact(nextitem)
        hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def _run_group(self, first: pytest.Item) -> None:
        """Run every selected test with the file and rank count of `first`."""
        ranks = first.callspec.params["rank_count"]
        left = [
            item
            for item in first.session.items
            if item.path == first.path
            and rank_counts(item)
            and item.callspec.params["rank_count"] == ranks
        ]
        while left:
            left = self._run(left, ranks)

    def _run(self, items: list[pytest.Item], ranks: int) -> list[pytest.Item]:
        """One mpirun over `items`; returns those an abort left over."""
        folder = self._new_folder()
        job = {
            "file": str(items[0].path),
            "tests": [item.nodeid for item in items],
            "rootdir": str(self._config.rootpath),
            "tbstyle": self._config.option.tbstyle,
        }
        (folder / "job.json").write_text(json.dumps(job))
        limit = _START_TIMEOUT + sum(_timeout(item) for item in items)
        done = run_ranks(ranks, [Path(__file__), folder], timeout=limit)
        records = [_Record.read(folder / f"rank{rank}.jsonl") for rank in range(ranks)]
        output = _output(done, folder, records)

        for place, item in enumerate(items):
            outcomes = [record.outcome(item.nodeid) for record in records]
            if all(outcomes) and len(set(outcomes)) == 1 and outcomes[0] != "failed":
                self._reports[item.nodeid] = self._restore(records[0], item.nodeid)
                continue
            self._reports[item.nodeid] = [self._failure(item, records, outcomes, done, output)]
            began = any(item.nodeid in record.began for record in records)
            left = items[place + 1 :]
            if began:
                return left
            # No rank reached this test although none failed before it: the run itself is broken.
            for other in left:
                text = "not run: " + self._reports[item.nodeid][0].longreprtext
                self._reports[other.nodeid] = [_report(other, text)]
            return []
        return []

    def _new_folder(self) -> Path:
        if self._directory is None:
            factory = self._config._tmp_path_factory  # the only way to it outside a fixture
            self._directory = factory.mktemp("mpi")
        self._runs += 1
        folder = self._directory / f"run{self._runs}"
        folder.mkdir()
        return folder

    def _restore(self, record: _Record, test: str) -> list[pytest.TestReport]:
        hook = self._config.hook.pytest_report_from_serializable
        reports = [hook(config=self._config, data=data) for data in record.reports[test]]
        for report in reports:
            if isinstance(report.longrepr, list):  # JSON knows no tuple: (file, line, reason)
                report.longrepr = tuple(report.longrepr)
        return reports

    def _failure(
        self,
        item: pytest.Item,
        records: list[_Record],
        outcomes: list[str | None],
        done: Any,
        output: str,
    ) -> pytest.TestReport:
        """The lowest failing rank's report, or why there is none."""
        size = len(records)
        if "failed" in outcomes:
            rank = outcomes.index("failed")
            reports = self._restore(records[rank], item.nodeid)
            report = next(report for report in reports if report.failed)
            failed = [str(r) for r, outcome in enumerate(outcomes) if outcome == "failed"]
            head = f"failed on rank {', '.join(failed)} of {size}; rank {rank} says"
            report.sections.insert(0, ("mpirun", head))
            return report
        if None not in outcomes:
            text = "the ranks disagree: " + ", ".join(
                f"rank {rank} {outcome}" for rank, outcome in enumerate(outcomes)
            )
        else:
            silent = ", ".join(str(r) for r, outcome in enumerate(outcomes) if outcome is None)
            text = (
                f"no result from rank {silent} of {size} (exit code {done.returncode}): "
                f"it hung for more than {_timeout(item):g} s, crashed or left a collective call"
            )
        return _report(item, f"{text}\n{output}")


def _report(item: pytest.Item, text: str) -> pytest.TestReport:
    """A failed report for a test that could not report itself."""
    return pytest.TestReport(
        nodeid=item.nodeid,
        location=item.location,
        keywords={},
        outcome="failed",
        longrepr=text,
        when="call",
    )


def _output(done: Any, folder: Path, records: list[_Record], lines: int = 60) -> str:
    """The end of what mpirun printed and, where no test began, what each rank's pytest did."""
    parts = [("mpirun", done.stdout + done.stderr)]
    stacks = [folder / f"rank{rank}.stacks" for rank in range(len(records))]
    parts += [(path.name, path.read_text(errors="replace")) for path in stacks if path.exists()]
    if not any(record.began for record in records):
        logs = [folder / f"rank{rank}.log" for rank in range(len(records))]
        parts += [(log.stem, log.read_text(errors="replace")) for log in logs if log.exists()]
    shown = []
    for name, text in parts:
        own = [line for line in text.splitlines() if not re.search(r"/(_pytest|pluggy)/", line)]
        if any(own):
            shown.append("\n".join([f"--- {name} ---", *own[-lines:]]))
    return "\n".join(shown)


class RankReporter:
    """In pytest on one rank: runs the job's tests in order and records what happens."""

    def __init__(self, job: dict[str, Any], folder: Path, world: Any) -> None:
        self._tests = job["tests"]
        self._world = world
        self.folder = folder
        self._record = (folder / f"rank{world.rank}.jsonl").open("w")
        # A file of its own: on mpirun's one stream the lines of several ranks cut each other up.
        self._stacks = (folder / f"rank{world.rank}.stacks").open("w")
        self._failed = False

    def pytest_configure(self, config: pytest.Config) -> None:
        self._config = config

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        if self._world.size in rank_counts(metafunc.definition):
            _parametrize(metafunc, [self._world.size])
        elif rank_counts(metafunc.definition):
            _parametrize(metafunc, [])

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        found = {item.nodeid: item for item in items}
        missing = [test for test in self._tests if test not in found]
        if missing:
            raise pytest.UsageError(f"not found on rank {self._world.rank}: {missing}")
        items[:] = [found[test] for test in self._tests]

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        self._write(what="begin", test=item.nodeid)
        # A watchdog in C: it fires in a blocked MPI call too, and shows where every rank stands.
        faulthandler.dump_traceback_later(_timeout(item), exit=True, file=self._stacks)
        try:
            result = yield
            if self._failed:
                time.sleep(_GRACE)
                self._world.Abort(_ABORTED)
            self._world.Barrier()  # a message of this test cannot reach the next one
        finally:
            faulthandler.cancel_dump_traceback_later()
        self._write(what="end", test=item.nodeid)
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._write(what="report", test=report.nodeid, data=data)
        self._failed = self._failed or report.failed

    def _write(self, **entry: Any) -> None:
        self._record.write(json.dumps(entry, default=str) + "\n")
        self._record.flush()

    def shared_path(self, test: str) -> Path:
        """A directory of this test that all ranks see."""
        path = self.folder / "shared" / re.sub(r"\W+", "_", test)
        path.mkdir(parents=True, exist_ok=True)
        return path


def _main(folder: Path) -> int:
    """What each rank runs: `python mpi_pytest.py FOLDER`."""
    from mpi4py import MPI

    world = MPI.COMM_WORLD
    job = json.loads((folder / "job.json").read_text())
    log = os.open(folder / f"rank{world.rank}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    arguments = [
        job["file"],
        f"--rootdir={job['rootdir']}",
        f"--basetemp={folder / f'tmp{world.rank}'}",
        f"--tb={job['tbstyle']}",
        "-p",
        "no:cacheprovider",
        "--long",  # the dispatcher has chosen already
    ]
    code = pytest.main(arguments, plugins=[RankReporter(job, folder, world)])
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        with contextlib.suppress(Exception):
            sys.stdout.flush()
        world.Abort(_ABORTED)
    return 0


if __name__ == "__main__":
    # Import this file under its own name, so that conftest.py sees the same classes.
    os.chdir(ROOT)
    import mpi_pytest

    sys.exit(mpi_pytest._main(Path(sys.argv[1])))
