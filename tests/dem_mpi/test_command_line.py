"""The command line: help, exit codes, one message once, and what each verb prints."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import h5py
import pytest

from dem_mpi import __version__
from dem_mpi.parallel import Parallel

from launch import ROOT, kill_ranks, rank_environment, run_ranks, start_ranks
from runs import LEAVING, checkpoints, contents, messages, metrics, simulate

EXIT_CODES = ("0 done", "64 bad input", "65 bad data file", "70 internal error", "74 input/output",
              "75 stopped by a signal")  # fmt: skip


def dem_mpi(*arguments: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run the program as one process, without an MPI launcher."""
    return subprocess.run(
        [sys.executable, "-m", "dem_mpi", *map(str, arguments)],
        env=rank_environment(), cwd=cwd, capture_output=True, text=True, timeout=120, check=False,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "leaving.yaml"
    path.write_text(LEAVING)
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A finished run of five steps and three frames."""
    directory = tmp_path_factory.mktemp("finished")
    simulate(Parallel.alone(), LEAVING, directory, "time.end=0.02")
    return directory


# ---- help and usage ---------------------------------------------------------------------------

VERBS = {
    "": (
        "--version", "run", "check", "schema", "info", "solve", "flow", "compress", "restore",
        "slice", "compare", "warmup",
    ),
    "run": ("SCENE", "--resume", "--out DIR", "--set KEY.PATH=VALUE", "--force"),
    "check": ("SCENE", "--set KEY.PATH=VALUE", "--ranks"),
    "schema": (),
    "info": ("FILE.h5",),
    "solve": (
        "PROBLEM.h5", "--tolerance", "--tolerance-kind", "--complementarity", "--max-iterations",
        "--guess", "--out FILE.h5", "--force",
    ),
    "flow": (
        "RUN.h5", "--frame last|N|TIME", "--bodies", "--region", "--hydrodynamic-radius",
        "--viscosity", "--background", "--problem", "--gravity", "--fluid-density", "--tolerance",
        "--formulation", "--max-iterations", "--grid NX,NY,NZ", "--points", "--output FLOW.h5",
        "--force", "--render", "--slice", "--dry-run", "--threads",
    ),
    "compress": (
        "SOURCE", "--tol", "--field NAME[=BOUND]", "--chunk", "--floor", "--explain",
        "--output ARCHIVE", "--resume", "--force",
    ),
    "restore": ("ARCHIVE", "--fields", "--steps A:B", "--bodies A:B", "--output FILE", "--force"),
    "slice": ("ARCHIVE", "--fields", "--steps A:B", "--bodies A:B", "--output FILE.csv", "--force"),
    "compare": ("A", "B", "--fields"),
    "warmup": ("--threads",),
}  # fmt: skip


@pytest.mark.parametrize("verb", VERBS)
def test_help_names_every_flag_and_the_exit_codes(verb):
    done = dem_mpi(*verb.split(), "--help")
    assert done.returncode == 0 and done.stderr == ""
    words = " ".join(done.stdout.split())
    for expected in ("Usage: dem-mpi", *VERBS[verb], *EXIT_CODES):
        assert expected in words, expected
    assert "..." not in words.replace("COMMAND [ARGS]...", "")  # no sentence is cut short


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--bogus", "scene.yaml"], "No such option: --bogus"),
        (["bogus"], "No such command 'bogus'"),
        (["run"], "Missing argument 'SCENE'"),
        (["run", "a.yaml", "b.yaml"], "b.yaml"),
        (["run", "a.yaml", "--out"], "--out"),
        (["check", "a.yaml", "-n", "0"], "greater than or equal to 1"),
    ],
)
def test_a_wrong_command_line_ends_with_64_and_one_line(arguments, words):
    done = dem_mpi(*arguments)
    assert done.returncode == 64 and done.stdout == ""
    assert done.stderr.startswith("dem-mpi: error: ") and len(messages(done.stderr)) == 1
    assert words in done.stderr and "see dem-mpi --help" in done.stderr


def test_without_a_verb_the_help_is_shown_and_the_code_is_64():
    done = dem_mpi()
    assert done.returncode == 64 and done.stdout == ""
    assert done.stderr.startswith("Usage: dem-mpi")


def test_the_version_is_printed():
    done = dem_mpi("--version")
    assert (done.returncode, done.stdout) == (0, f"dem-mpi {__version__}\n")


@pytest.mark.parametrize("arguments", [["run", "--bogus"], ["run", "no_such_scene.yaml"]])
def test_three_ranks_say_what_is_wrong_once(arguments, tmp_path):
    done = run_ranks(3, ["-m", "dem_mpi", *arguments], cwd=tmp_path, env={"PYTHONPATH": str(ROOT)})
    assert done.returncode == 64
    assert len(messages(done.stderr)) == 1 and done.stderr.startswith("dem-mpi: error: ")
    assert done.stdout == ""


def test_three_ranks_print_help_once():
    done = run_ranks(3, ["-m", "dem_mpi", "run", "--help"])
    assert done.returncode == 0
    assert done.stdout.count("Usage: dem-mpi run") == 1


# ---- bad scenes -------------------------------------------------------------------------------

LETTERS = "abcdefghi"
BAD_SCENES = {
    "typo": (LEAVING.replace("density", "densty"), "densty"),
    "wrong type": (LEAVING.replace("count: 50", "count: fifty"), "fifty"),
    "duplicate key": (LEAVING + "time: {step: 1, end: 2}\n", "time"),
    "not a number": (LEAVING.replace("density: 2500", "density: .nan"), "nan"),
    "negative radius": (LEAVING.replace("0.028", "-0.028"), "-0.028"),
    "tag": (LEAVING + "seed: !!python/object/apply:os.getpid []\n", "tag"),
    "alias bomb": (
        "a: &a [1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(f"k{i}: &{b} [{f'*{a}, ' * 8}]\n" for i, (a, b) in enumerate(pairwise(LETTERS))),
        "alias",
    ),
    "deep nesting": ("a: " + "[" * 5000 + "]" * 5000, "deep"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD_SCENES)
def test_a_bad_scene_ends_with_64_before_any_work(tmp_path, kind):
    text, words = BAD_SCENES[kind]
    (tmp_path / "bad.yaml").write_text(text)
    done = dem_mpi("run", tmp_path / "bad.yaml", "--out", tmp_path / "out")
    assert done.returncode == 64, done.stderr
    assert "Traceback" not in done.stderr and "bad.yaml" in done.stderr
    assert words in done.stderr.lower()
    assert not (tmp_path / "out").exists()


def test_three_ranks_name_line_value_and_nearest_key_of_a_typo_once(tmp_path):
    (tmp_path / "bad.yaml").write_text(BAD_SCENES["typo"][0])
    arguments = ["-m", "dem_mpi", "run", tmp_path / "bad.yaml", "--out", tmp_path / "out"]
    done = run_ranks(3, arguments)
    assert done.returncode == 64
    assert done.stderr.count("dem-mpi: error:") == 1 and done.stderr.count("densty") == 1
    assert "density" in done.stderr and "bad.yaml:4" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_hostile_file_of_bodies_ends_three_ranks_with_65(tmp_path):
    with h5py.File(tmp_path / "bodies.h5", "w") as file:
        file["position"] = h5py.ExternalLink("/etc/hostname", "/position")
    text = "\n".join(
        "     placement: {file: bodies.h5}}" if "jittered_grid" in line else line
        for line in LEAVING.splitlines()
        if "velocity: [1.5" not in line
    )
    (tmp_path / "scene.yaml").write_text(text)
    done = run_ranks(3, ["-m", "dem_mpi", "run", tmp_path / "scene.yaml"], cwd=ROOT)
    assert done.returncode == 65, done.stderr
    assert len(messages(done.stderr)) == 1 and "bodies.h5: 'position' is a link" in done.stderr


# ---- run --------------------------------------------------------------------------------------


def test_run_without_a_launcher_writes_where_it_is_told_and_takes_overrides(scene, tmp_path):
    done = dem_mpi("run", scene, "--out", tmp_path / "out", "--set", "time.end=0.02",
                   "--set", "bodies.0.count=9", "--set", "output.path=nine.h5")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert contents(tmp_path / "out" / "nine.h5")["VTKHDF/NumberOfPoints"][1] == (4,)
    lines = metrics(tmp_path / "out")
    assert len(lines) == 5 and lines[0]["bodies"] == 9
    for words in ("step 5/5", "seconds by phase", "4 frames in", "peak memory"):
        assert words in done.stdout


def test_the_output_stands_under_runs_by_default(scene, tmp_path):
    environment = {**rank_environment(), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "dem_mpi", "run", scene, "--set", "time.end=0.004"],
        env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs" / "leaving" / "run.h5").exists()


def test_a_finished_run_is_not_overwritten_without_force(scene, finished):
    before = (finished / "run.h5").read_bytes()
    done = dem_mpi("run", scene, "--out", finished, "--set", "time.end=0.02")
    assert done.returncode == 64
    assert len(messages(done.stderr)) == 1
    assert "run.h5 exists" in done.stderr and "--force" in done.stderr and "--resume" in done.stderr
    assert (finished / "run.h5").read_bytes() == before


def test_a_changed_scene_is_refused_with_64(scene, finished):
    done = dem_mpi("run", scene, "--out", finished, "--resume", "--set", "time.end=0.024")
    assert done.returncode == 64
    assert "time.end: 0.02 -> 0.024" in done.stderr and "--force" in done.stderr


# ---- info and schema --------------------------------------------------------------------------


def test_info_tells_what_is_in_a_trajectory(finished):
    done = dem_mpi("info", finished / "run.h5")
    assert done.returncode == 0 and done.stderr == ""
    for words in ("trajectory", "valid", "scene leaving", "4 frames, complete", "steps 0 to 5",
                  "t = 0 to 0.02 s", "50 bodies", "position (f8, 3) [m]"):  # fmt: skip
        assert words in done.stdout, words


def test_info_tells_what_is_in_a_checkpoint(finished):
    done = dem_mpi("info", checkpoints(finished)[-1])
    assert done.returncode == 0
    for words in ("checkpoint", "valid", "step 5, t = 0.02 s", "saved by 1 ranks", "50 bodies"):
        assert words in done.stdout, words


def test_info_says_of_other_files_what_they_are_not(finished, tmp_path):
    (tmp_path / "text.h5").write_text("no HDF5")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["position"] = [1.0, 2.0]
    for name in ("run.h5", checkpoints(finished)[-1].name):
        whole = (finished / name).read_bytes()
        (tmp_path / f"cut.{name}").write_bytes(whole[: len(whole) // 2])
    for path in sorted(tmp_path.iterdir()):
        done = dem_mpi("info", path)
        assert done.returncode == 65, path
        assert "Traceback" not in done.stderr
        assert "not valid: " in done.stdout and path.name in done.stdout
    done = dem_mpi("info", tmp_path / "absent.h5")
    assert done.returncode == 64 and "no such file" in done.stderr


def test_info_can_look_at_a_run_that_is_going_on(scene, tmp_path):
    arguments = ["-m", "dem_mpi", "run", scene, "--out", tmp_path, "--set", "time.end=400"]
    process = start_ranks(1, arguments)
    try:
        deadline = time.monotonic() + 60
        while not (tmp_path / "metrics.jsonl").exists() or len(metrics_text(tmp_path)) < 5:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
        done = dem_mpi("info", tmp_path / "run.h5")
        assert process.poll() is None
    finally:
        kill_ranks(process)
    assert "being written by process" in done.stdout
    # It can meet the writer between two writes; it then says so, and never more than that.
    assert done.returncode in (0, 65) and "Traceback" not in done.stderr


def metrics_text(directory: Path) -> list[str]:
    return (directory / "metrics.jsonl").read_text().splitlines()


def test_schema_is_json_and_states_units():
    done = dem_mpi("schema")
    assert done.returncode == 0
    schema = json.loads(done.stdout)
    assert schema["$schema"].startswith("https://json-schema.org/")
    assert schema["$defs"]["Time"]["properties"]["step"]["unit"] == "s"


def test_check_runs_nothing(scene):
    done = dem_mpi("check", scene)
    assert done.returncode == 0, done.stderr
    assert "50" in done.stdout
    assert not (ROOT / "runs" / "leaving").exists()


def test_the_console_script_is_the_same_program():
    script = Path(sys.executable).with_name("dem-mpi")
    if not os.access(script, os.X_OK):
        pytest.skip("the package is not installed here")
    done = subprocess.run([script, "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"dem-mpi {__version__}\n")


def test_a_scene_with_assembled_matrices_runs_on_two_ranks_from_the_command_line(scene, tmp_path):
    """PETSc starts on all ranks together, although one rank compiles the kernels first."""
    arguments = ["-m", "dem_mpi", "run", scene, "--out", tmp_path, "--set", "time.end=0.02"]
    done = run_ranks(2, [*arguments, "--set", "contact.operator=assembled"], timeout=60)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run.h5").exists()
