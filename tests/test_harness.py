"""The harness that runs tests on several ranks: a failure there must not pass, hang or hide."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from launch import ROOT, rank_environment, run_ranks

SUITE = """
import os
import time

import pytest

from mpi4py import MPI

world = MPI.COMM_WORLD


@pytest.mark.mpi(ranks=[1, 2])
def test_runs_on_each_rank_count(rank_count):
    assert world.size == rank_count


@pytest.mark.mpi(ranks=[2])
def test_fails_on_one_rank_while_the_other_waits():
    assert world.rank != 1, "rank one objects"
    world.Barrier()


@pytest.mark.mpi(ranks=[2], timeout=4)
def test_hangs():
    if world.rank == 0:
        world.Recv(bytearray(1), source=1)
    else:
        time.sleep(60)


@pytest.mark.mpi(ranks=[2])
def test_dies():
    if world.rank == 1:
        os.kill(os.getpid(), 9)
    world.Barrier()


@pytest.mark.mpi(ranks=[2])
def test_skips_on_one_rank_only():
    if world.rank == 1:
        pytest.skip("here")


@pytest.mark.mpi(ranks=[2])
def test_skips():
    pytest.skip("everywhere")


@pytest.mark.mpi(ranks=[2])
@pytest.mark.parametrize("name", ["a", "b"])
def test_ranks_share_a_directory(shared_path, tmp_path, name):
    assert not any(shared_path.iterdir())
    world.Barrier()
    (shared_path / f"{name}{world.rank}").touch()
    (tmp_path / "own").touch(exist_ok=False)
    world.Barrier()
    assert sorted(p.name for p in shared_path.iterdir()) == [f"{name}0", f"{name}1"]


@pytest.mark.long
@pytest.mark.mpi(ranks=[2])
def test_takes_minutes():
    assert False


def test_serial(tmp_path, shared_path):
    assert world.size == 1
    assert shared_path == tmp_path
"""


def suite_run(folder: Path, text: str, *options: str) -> str:
    """Run pytest on a suite of its own with this suite's harness; return what it printed."""
    (folder / "test_suite.py").write_text(text)
    shutil.copy(ROOT / "tests" / "conftest.py", folder)
    support = ROOT / "tests" / "support"
    (folder / "pytest.ini").write_text(
        f"[pytest]\npythonpath = {support}\naddopts = --import-mode=importlib -rA\n"
        "markers =\n    mpi\n    long\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options, folder],
        capture_output=True,
        text=True,
        cwd=folder,
        env=rank_environment(),
        timeout=300,
        check=False,
    )
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    return suite_run(tmp_path_factory.mktemp("suite"), SUITE)


def outcome_of(printed: str, test: str) -> str:
    """PASSED, FAILED, ... of a test in pytest's closing list."""
    found = re.search(rf"^(\w+) \S*::{re.escape(test)}(?: |$)", printed, re.MULTILINE)
    assert found, printed
    return found[1]


def test_a_marked_test_runs_once_for_each_rank_count(outcome):
    assert outcome_of(outcome, "test_runs_on_each_rank_count[1ranks]") == "PASSED"
    assert outcome_of(outcome, "test_runs_on_each_rank_count[2ranks]") == "PASSED"
    assert outcome_of(outcome, "test_serial") == "PASSED"


def test_a_failure_on_one_rank_is_reported_with_its_traceback(outcome):
    assert outcome_of(outcome, "test_fails_on_one_rank_while_the_other_waits[2ranks]") == "FAILED"
    assert "rank one objects" in outcome
    assert "failed on rank 1 of 2" in outcome


def test_a_hang_ends_at_its_timeout_and_shows_every_rank(outcome):
    assert outcome_of(outcome, "test_hangs[2ranks]") == "FAILED"
    assert "hung for more than 4 s" in outcome
    assert re.search(r"line \d+ in test_hangs", outcome)


def test_a_rank_that_dies_fails_its_test(outcome):
    assert outcome_of(outcome, "test_dies[2ranks]") == "FAILED"


def test_ranks_that_disagree_fail(outcome):
    assert outcome_of(outcome, "test_skips_on_one_rank_only[2ranks]") == "FAILED"
    assert "rank 0 passed, rank 1 skipped" in outcome
    assert re.search(r"^SKIPPED .*everywhere", outcome, re.MULTILINE)


def test_tests_after_an_aborted_one_still_run(outcome):
    assert outcome_of(outcome, "test_ranks_share_a_directory[2ranks-a]") == "PASSED"
    assert outcome_of(outcome, "test_ranks_share_a_directory[2ranks-b]") == "PASSED"
    assert "4 failed, 5 passed, 1 skipped, 1 deselected" in outcome


def test_a_file_that_only_fails_under_mpirun_is_not_passed_over(tmp_path):
    text = (
        "import os\nimport pytest\n"
        "if 'OMPI_COMM_WORLD_SIZE' in os.environ or 'PMI_SIZE' in os.environ:\n"
        "    raise ImportError('only here')\n"
        "@pytest.mark.mpi(ranks=[2])\ndef test_one(): pass\n"
        "@pytest.mark.mpi(ranks=[2])\ndef test_two(): pass\n"
    )
    printed = suite_run(tmp_path, text)
    assert "2 failed" in printed
    assert "only here" in printed


def test_a_program_past_its_time_limit_is_ended(tmp_path):
    program = tmp_path / "sleeper.py"
    program.write_text("from mpi4py import MPI\nimport time\ntime.sleep(60)\n")
    done = run_ranks(2, [program], timeout=3)
    assert done.returncode == -1
    assert "ended after 3 s" in done.stderr


def test_exit_codes_of_programs_pass_through(tmp_path):
    program = tmp_path / "leaver.py"
    program.write_text("import sys\nfrom mpi4py import MPI\nsys.exit(64)\n")
    assert run_ranks(2, [program], timeout=60).returncode == 64
