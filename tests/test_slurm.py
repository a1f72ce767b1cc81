"""The batch scripts: with a stand-in for SLURM, and (marked `slurm`) in a SLURM of one node."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from launch import ROOT, run_ranks
from runs import PILE, differences, last_step

SCRIPTS = ROOT / "scripts" / "slurm"
OURS = ("OMP", "OMPI_", "PMIX_", "NUMBA_", "OPENBLAS_", "H5PY_", "SLURM_", "PRTE_")


def user_environment(**variables: str) -> dict[str, str]:
    """The environment without what the scripts are to set themselves."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(OURS)}
    return {**kept, **variables}


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


def wait_for(condition: Callable[[], object], timeout: float, doing: str) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"waited {timeout:g} s in vain for {doing}"
        time.sleep(0.01)


# ---- a stand-in for SLURM and for scripts/run ------------------------------------------------

SIMULATION = """#!/usr/bin/env bash
here={stage}
stop() {{
    [[ -z ${{CHECKPOINT:-}} ]] || : >"$here/out/run.checkpoint.$CHECKPOINT.h5"
    exit 75
}}
trap stop USR1
printf '%s\\n' "$@" >"$here/arguments"
: >"$here/began"
[[ -z ${{CODE:-}} ]] || exit "$CODE"
while :; do sleep 0.1; done
"""

SCONTROL = """#!/usr/bin/env bash
if [[ $1 == show ]]; then
    echo "   Command={stage}/scripts/slurm/$SCRIPT scene.yaml --out {stage}/out"
else
    echo "$*" >>"{stage}/scontrol"
fi
"""


@pytest.fixture
def stage(tmp_path) -> Path:
    """A project with the real batch scripts; the batch system and the simulation are stand-ins."""
    for name in ("lib", "slurm"):
        shutil.copytree(ROOT / "scripts" / name, tmp_path / "scripts" / name)
    executable(tmp_path / "scripts" / "run", SIMULATION.format(stage=tmp_path))
    executable(tmp_path / ".venv" / "bin" / "python", "#!/bin/sh\n")
    executable(tmp_path / "bin" / "scontrol", SCONTROL.format(stage=tmp_path))
    (tmp_path / "spool").mkdir()
    (tmp_path / "out").mkdir()
    return tmp_path


def start_job(
    stage: Path, *options: str, script: str = "run.sbatch", **variables: str
) -> subprocess.Popen[str]:
    """Start a batch script as SLURM does: from a copy that stands elsewhere."""
    copy = stage / "spool" / "slurm_script"
    shutil.copy(SCRIPTS / script, copy)
    slurm = {"SLURM_JOB_ID": "7", "SLURM_JOB_NAME": "fall", "SLURM_NTASKS": "3", "SCRIPT": script}
    path = f"{stage}/bin:{os.environ['PATH']}"
    return subprocess.Popen(
        ["bash", copy, "scene.yaml", "--out", stage / "out", *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=stage,
        env=user_environment(**{**slurm, "PATH": path, **variables}),
    )


def end(job: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and messages of a job's script."""
    _, messages = job.communicate(timeout=30)
    return job.returncode, messages


def stop_job(stage: Path, number: int, **variables: str) -> tuple[int, str]:
    """Start a job, send its script a signal once the simulation runs, and see it end."""
    job = start_job(stage, **variables)
    wait_for((stage / "began").exists, 30, "the simulation")
    job.send_signal(number)
    return end(job)


def requeued(stage: Path) -> list[str]:
    calls = stage / "scontrol"
    return calls.read_text().splitlines() if calls.exists() else []


def arguments(stage: Path) -> list[str]:
    return (stage / "arguments").read_text().splitlines()


@pytest.mark.parametrize("code", [0, 64, 65, 70, 74])
def test_a_run_that_ends_by_itself_ends_the_job_with_its_code(stage, code):
    assert end(start_job(stage, CODE=str(code))) == (code, "")
    assert requeued(stage) == []
    assert arguments(stage) == ["-n", "3", "scene.yaml", "--out", f"{stage}/out"]


def test_the_warning_stops_and_requeues(stage):
    code, said = stop_job(stage, signal.SIGUSR1, CHECKPOINT="000000010")
    assert code == 75
    assert requeued(stage) == ["requeue 7"]
    assert "fall: requeueing job 7 (restart 1)" in said


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_cancelled_job_saves_and_is_not_requeued(stage, number):
    code, said = stop_job(stage, number, CHECKPOINT="000000010")
    assert code == 75
    assert requeued(stage) == []
    assert "submit it again with --resume" in said
    assert list((stage / "out").glob("*.h5"))


def test_a_restarted_job_that_got_further_is_requeued_again(stage):
    (stage / "out" / "run.checkpoint.000000010.h5").touch()
    variables = {"SLURM_RESTART_COUNT": "4", "CHECKPOINT": "000000020"}
    assert stop_job(stage, signal.SIGUSR1, **variables)[0] == 75
    assert requeued(stage) == ["requeue 7"]


def test_a_restarted_job_that_got_no_further_ends_and_says_so(stage):
    (stage / "out" / "run.checkpoint.000000010.h5").touch()
    code, said = stop_job(stage, signal.SIGUSR1, SLURM_RESTART_COUNT="4")
    assert code == 75
    assert requeued(stage) == []
    assert "no new checkpoint since the last requeue" in said


def test_a_requeue_that_is_refused_ends_the_job_with_the_remedy(stage):
    executable(
        stage / "bin" / "scontrol",
        "#!/bin/sh\n[ $1 = show ] && exec echo Command="
        + (f"{stage}/scripts/slurm/run.sbatch\nexit 1\n"),
    )
    code, said = stop_job(stage, signal.SIGUSR1, CHECKPOINT="000000010")
    assert code == 75
    assert "could not requeue" in said and "--resume" in said


@pytest.mark.parametrize(
    ("given", "passed"),
    [
        (["--force"], ["--resume", "scene.yaml"]),
        (["--resume", "--force"], ["scene.yaml", "--resume", "--force"]),
        (["--launcher", "srun"], ["--resume", "scene.yaml", "--launcher", "srun"]),
    ],
)
def test_a_restarted_job_resumes(stage, given, passed):
    assert end(start_job(stage, *given, CODE="0", SLURM_RESTART_COUNT="1"))[0] == 0
    assert arguments(stage) == ["-n", "3", *passed, "--out", f"{stage}/out"]


@pytest.mark.parametrize(
    ("given", "threads"), [([], ["--set", "threads=4"]), (["--set", "threads=2"], [])]
)
def test_cpus_per_task_become_threads_unless_told_otherwise(stage, given, threads):
    assert end(start_job(stage, *given, CODE="0", SLURM_CPUS_PER_TASK="4"))[0] == 0
    assert arguments(stage)[2:-2] == ["scene.yaml", *given, *threads]


def test_a_job_without_an_output_directory_is_refused(stage):
    job = start_job(stage, "--out=")
    assert end(job) == (
        64,
        "fall: error: --out DIR is missing: a requeued job resumes from what is in DIR\n",
    )


# ---- sweeps, the same way --------------------------------------------------------------------


def sweep(stage: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Start sweep.sbatch in a shell, where it lists its tasks."""
    command = [stage / "scripts/slurm/sweep.sbatch", "scene.yaml", "--out", stage / "out"]
    return subprocess.run(
        [*command, *options],
        capture_output=True,
        text=True,
        env=user_environment(),
        timeout=30,
        check=False,
    )


def test_each_combination_of_values_is_a_task(stage):
    done = sweep(stage, "--vary", "time.end=1,2", "--vary", "friction.default=0.1,0.2")
    assert [line.split() for line in done.stdout.splitlines()] == [
        ["0", "not", "begun", "time.end=1,friction.default=0.1"],
        ["1", "not", "begun", "time.end=1,friction.default=0.2"],
        ["2", "not", "begun", "time.end=2,friction.default=0.1"],
        ["3", "not", "begun", "time.end=2,friction.default=0.2"],
        ["0", "of", "4", "finished"],
        ["left", "to", "do:", "sbatch", "--array=0,1,2,3", "..."],
    ]


def test_each_line_of_a_file_is_a_task(stage):
    values = stage / "values"
    values.write_text("# box\n--set 'walls.0.max=[1, 2, 3]' --set=time.end=2\n\n--set $HOME=1")
    options = ("--values", str(values), "--vary=")
    assert "either --vary" in sweep(stage, *options).stderr
    slurm = {"SLURM_ARRAY_JOB_ID": "12", "SLURM_ARRAY_TASK_ID": "0", "CODE": "0"}
    assert end(start_job(stage, *options[:2], script="sweep.sbatch", **slurm))[0] == 0
    task = ["--set", "walls.0.max=[1, 2, 3]", "--set=time.end=2", "--out", f"{stage}/out/task-0"]
    assert arguments(stage) == ["-n", "3", "scene.yaml", "--resume", *task]
    assert (
        "   1  not begun                 task-1\n1 of 2 finished\n"
        in sweep(stage, *options[:2]).stdout
    )
    assert (stage / "out" / "summary.txt").read_text().endswith("\n1 of 2 finished\n")


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("--force", "not of the form"),
        ("time.end=2", "not of the form"),
        ("--set", "not of the form"),
        ("--set 'time.end=2", "a quote is not closed"),
        ("# nothing", "has no tasks"),
    ],
)
def test_a_file_of_values_that_makes_no_sense_is_refused(stage, line, reason):
    (stage / "values").write_text(line)
    done = sweep(stage, "--values", str(stage / "values"))
    assert (done.returncode, done.stderr.count("\n")) == (64, 1)
    assert reason in done.stderr


@pytest.mark.parametrize("vary", ["time.end", "=1,2", "a=[1,2]", "a=1,1"])
def test_a_product_that_makes_no_sense_is_refused(stage, vary):
    done = sweep(stage, "--vary", vary)
    assert (done.returncode, done.stderr.count("\n")) == (64, 1)


def test_only_its_own_task_of_an_array_is_requeued(stage):
    slurm = {"SLURM_ARRAY_JOB_ID": "12", "SLURM_ARRAY_TASK_ID": "1", "SLURM_JOB_ID": "12"}
    job = start_job(stage, "--vary=a=1,2", script="sweep.sbatch", **slurm)
    wait_for((stage / "began").exists, 30, "the simulation")
    job.send_signal(signal.SIGUSR1)
    assert end(job)[0] == 75
    assert requeued(stage) == ["requeue 12_1"]
    listed = sweep(stage, "--vary=a=1,2").stdout
    assert "   1  requeued                  a=2" in listed


def test_a_task_that_does_not_exist_fails(stage):
    slurm = {"SLURM_ARRAY_JOB_ID": "12", "SLURM_ARRAY_TASK_ID": "2"}
    code, said = end(start_job(stage, "--vary=a=1,2", script="sweep.sbatch", **slurm))
    assert code == 64
    assert "there is no task 2: the array is --array=0-1" in said


# ---- a rank that srun ends because another one has left with 75 --------------------------------

LATE_SIGNAL = """
import os, signal, sys
from dem_mpi.signals import StopRequest

class Last:  # deleted after Python has given up its signal handlers
    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.SIGTERM):
        kill(pid, number)

last = Last()
stop = StopRequest()
stop.install()
os.kill(os.getpid(), signal.SIGUSR1)
sys.exit(75 if stop.requested else 1)
"""


def test_a_rank_that_has_saved_keeps_its_exit_code_when_srun_sends_term():
    done = subprocess.run([sys.executable, "-c", LATE_SIGNAL], check=False, timeout=60)
    assert done.returncode == 75


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="needs shellcheck")
def test_shellcheck_finds_nothing():
    done = subprocess.run(
        ["shellcheck", *sorted(SCRIPTS.iterdir())],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == ""


# ---- in a SLURM of one node ------------------------------------------------------------------

RANKS = 2
LENGTH = ("--set", "time.end=1", "--set", "output.interval=0.1", "--set", "checkpoint.interval=0.3")
STEPS = 500
ENDED = {"COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL", "OUT_OF_MEMORY"}


class Slurm:
    """What a user does in a cluster, and what he looks at."""

    def __init__(self, folder: Path) -> None:
        self._environment = user_environment(SLURM_CONF=str(folder / "slurm.conf"))

    def call(self, *command: str | Path) -> str:
        done = subprocess.run(
            list(map(str, command)),
            capture_output=True,
            text=True,
            env=self._environment,
            cwd=ROOT,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def job(self, job: str) -> dict[str, str]:
        """What `scontrol show job` tells."""
        shown = self.call("scontrol", "--oneliner", "show", "job", job)
        return dict(re.findall(r"(\w+)=(\S*)", shown))

    def minutes(self, job: str) -> int:
        """Whole minutes that a job has run since its last start."""
        hours, minutes, _ = self.job(job)["RunTime"].split(":")
        return 60 * int(hours) + int(minutes)

    def limit_time(self, job: str, minutes: int) -> None:
        """Allow a job so many minutes from its last start on."""
        self.call("scontrol", "update", f"JobId={job}", f"TimeLimit={minutes}")

    def end_state(self, job: str, timeout: float = 180) -> tuple[str, str, int]:
        """State, exit code and number of restarts of a job that has ended, once it has."""
        wait_for(lambda: self.job(job)["JobState"] in ENDED, timeout, f"the end of job {job}")
        told = self.job(job)
        return told["JobState"], told["ExitCode"], int(told["Restarts"])


@pytest.fixture(scope="module")
def slurm() -> Iterator[Slurm]:
    absent = [
        name
        for name in ("munged", "slurmctld", "slurmd", "sbatch", "srun")
        if shutil.which(name) is None
    ]
    if absent:
        pytest.skip(f"no {', '.join(absent)} here: apt-get install slurm-wlm munge libpmix-dev")
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # sockets need a short path
    script = str(SCRIPTS / "one_node.sh")
    started = subprocess.run(
        [script, "start", folder], capture_output=True, text=True, timeout=120, check=False
    )
    try:
        if started.returncode:
            pytest.skip(f"SLURM does not start here: {started.stderr}")
        yield Slurm(folder)
    finally:
        subprocess.run([script, "stop", folder], timeout=120, check=False)
        shutil.rmtree(folder)


@pytest.fixture
def scene(tmp_path) -> Path:
    path = tmp_path / "pile.yaml"
    path.write_text(PILE)
    return path


def ranks_of(directory: Path) -> list[int]:
    """The processes of the program that writes to a directory."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if words[0].endswith("python") and "dem_mpi" in words and str(directory) in words:
            found.append(int(path.parent.name))
    return found


@contextmanager
def frozen(directory: Path, step: int) -> Iterator[None]:
    """Halt the ranks once they have done so many steps: what follows happens within the run."""
    wait_for(lambda: last_step(directory) >= step, 120, f"step {step} in {directory.name}")
    ranks = ranks_of(directory)
    for rank in ranks:
        os.kill(rank, signal.SIGSTOP)
    try:
        assert ranks
        assert last_step(directory) < STEPS
        yield
    finally:
        for rank in ranks:
            os.kill(rank, signal.SIGCONT)


@pytest.mark.slurm
@pytest.mark.parametrize("launcher", ["mpirun", "srun"])
def test_a_run_across_two_time_limits_equals_the_uninterrupted_one(
    slurm, scene, tmp_path, launcher
):
    directory, log = tmp_path / "limited", tmp_path / "log"
    job = slurm.call(
        "sbatch", "--parsable", "--ntasks", str(RANKS), "--output", log,
        "--time=60", "--signal=B:USR1@60",
        SCRIPTS / "run.sbatch", scene, "--out", directory, "--launcher", launcher, *LENGTH,
    ).strip()  # fmt: skip
    for limit, step in ((1, 50), (2, 150)):
        # The run stands still in the middle while SLURM, which looks every 30 s, finds its time up.
        with frozen(directory, step):
            slurm.limit_time(job, slurm.minutes(job) + 2)
            wait_for(lambda n=limit: log.read_text().count("warned") == n, 120, "the warning")
        slurm.limit_time(job, 60)
    assert slurm.end_state(job) == ("COMPLETED", "0:0", 2), log.read_text()
    assert log.read_text().count("resuming from run.checkpoint.") == 2

    whole = tmp_path / "whole"
    done = run_ranks(RANKS, ["-m", "dem_mpi", "run", scene, "--out", whole, *LENGTH])
    assert done.returncode == 0, done.stderr
    assert differences(whole, directory) == []


@pytest.mark.slurm
@pytest.mark.parametrize("launcher", ["mpirun", "srun"])
def test_a_bad_scene_fails_without_a_requeue(slurm, tmp_path, launcher):
    scene, log = tmp_path / "bad.yaml", tmp_path / "log"
    scene.write_text(PILE.replace("friction", "frictoin"))
    job = slurm.call(
        "sbatch", "--parsable", "--ntasks", str(RANKS), "--output", log,
        SCRIPTS / "run.sbatch", scene, "--out", tmp_path / "out", "--launcher", launcher,
    ).strip()  # fmt: skip
    assert slurm.end_state(job) == ("FAILED", "64:0", 0), log.read_text()
    assert "frictoin" in log.read_text()


@pytest.mark.slurm
def test_a_job_asked_to_end_saves_and_stays_ended(slurm, scene, tmp_path):
    directory, log = tmp_path / "ended", tmp_path / "log"
    job = slurm.call(
        "sbatch", "--parsable", "--ntasks", str(RANKS), "--output", log,
        SCRIPTS / "run.sbatch", scene, "--out", directory, *LENGTH,
    ).strip()  # fmt: skip
    with frozen(directory, 100):
        slurm.call("scancel", "--batch", "--signal=TERM", job)
        wait_for(lambda: "asked to end" in log.read_text(), 30, "the signal")
    assert slurm.end_state(job) == ("FAILED", "75:0", 0), log.read_text()
    assert "stopped as asked" in log.read_text()
    assert list(directory.glob("run.checkpoint.*.h5"))


@pytest.mark.slurm
def test_a_sweep_finishes_although_one_of_its_tasks_is_interrupted(slurm, scene, tmp_path):
    sweep = [SCRIPTS / "sweep.sbatch", scene, "--out", tmp_path / "sweep", *LENGTH]
    vary = ["--vary", "friction.default=0.2,0.3,0.4"]
    job = slurm.call(
        "sbatch", "--parsable", "--array=0-2", "--ntasks=1", "--output", tmp_path / "log.%a",
        *sweep, *vary,
    ).strip()  # fmt: skip
    log = tmp_path / "log.1"
    with frozen(tmp_path / "sweep" / "friction.default=0.3", 100):
        slurm.call("scancel", "--batch", "--signal=USR1", f"{job}_1")
        wait_for(lambda: "warned" in log.read_text(), 30, "the warning")
    ends = [slurm.end_state(f"{job}_{task}") for task in range(3)]
    assert ends == [("COMPLETED", "0:0", restarts) for restarts in (0, 1, 0)], log.read_text()
    listed = slurm.call(*sweep, *vary)
    assert [line.split() for line in listed.splitlines()] == [
        *([str(k), "finished", f"friction.default=0.{k + 2}"] for k in range(3)),
        ["3", "of", "3", "finished"],
    ]
    assert (tmp_path / "sweep" / "summary.txt").read_text() == listed
