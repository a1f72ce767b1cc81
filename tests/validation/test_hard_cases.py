"""The battery of hard cases, for every solver: nothing in it may be beyond one of them.

What each case asserts, and where its tolerances come from, stands with it in `hard_cases`. Besides,
every step of every case balances energy and momentum to round-off, leaves impulses in their cones
and reaches its tolerance, the interior point method in 60 Newton iterations at most.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from dem_mpi.parallel import Parallel

from hard_cases import CASES, SOLVERS, H, Trial, attempt, rest
from launch import ROOT

each_solver = pytest.mark.parametrize("solver", SOLVERS)

# Distributed problems: contacts across ranks, ranks with few or no bodies.
ACROSS_RANKS = (
    "mixed mu",
    "hyperstatic",
    "deep overlap",
    "coincident centres",
    "size ratio 100",
    "wedge that jams",
    "zero gravity",
)


@each_solver
@pytest.mark.parametrize("name", CASES)
def test_hard_case(name: str, solver: str) -> None:
    assert attempt(name, solver).complaints == []


@pytest.mark.mpi(ranks=[2])
@each_solver
@pytest.mark.parametrize("name", ACROSS_RANKS)
def test_hard_case_across_ranks(parallel: Parallel, name: str, solver: str) -> None:
    assert attempt(name, solver, parallel).complaints == []


@pytest.mark.long
@pytest.mark.parametrize(("solver", "steps"), [("apgd", 1_000_000), ("scip", 100_000)])
def test_ten_bodies_stay_at_rest(solver: str, steps: int) -> None:
    """The same bound on the state as for ten thousand steps.

    Leaves build/hard_cases/rest-<solver>.json, which scripts/bench/hard_cases.py tells of. In so
    many steps round-off may hold a first-order method above 1e-8 v_ref gamma_ref now and then (N is
    singular): it must say so, and the bound on the state holds for those steps as well.
    """
    trial = Trial(Parallel.alone(), solver)
    rest(trial, H, steps)
    outcome = {**trial.summary, "commit": commit()}
    path = ROOT / "build" / "hard_cases" / f"rest-{solver}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(outcome, indent=1) + "\n")
    assert [str(check) for check in trial.checks.values() if not check.passed] == []
    assert len(trial.effort.failures) <= 1e-5 * steps


def commit() -> str:
    """Short hash of the checked-out commit, with + if the tree differs from it."""
    call = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def test_page_has_the_table_of_the_records() -> None:
    """docs/hard_cases.md shows what docs/bench/hard_cases.json holds, and every case of today."""
    script = ROOT / "scripts" / "bench" / "hard_cases.py"
    call = [sys.executable, script, "--check"]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
