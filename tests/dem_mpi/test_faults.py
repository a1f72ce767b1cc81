"""What goes wrong in a run ends it with its message and code, and costs no more than it must."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from mpi4py import MPI

from dem_mpi import checkpoint
from dem_mpi.bodies import Bodies
from dem_mpi.errors import DataError, InputError, OutputError
from dem_mpi.estimate import checkpoint_bytes
from dem_mpi.h5files import OutputLock
from dem_mpi.output import describe, frame_bytes
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.runner import trajectory_fields
from dem_mpi.scenario import parse_scenario
from dem_mpi.seal import write_seal
from dem_mpi.simulation import Simulation, SolverFailureError, start

from launch import ROOT, kill_ranks, rank_environment, run_ranks, start_ranks
from runs import (
    LEAVING,
    PILE,
    checkpoints,
    damage,
    dataset_offsets,
    differences,
    last_step,
    messages,
    metrics,
    simulate,
)

RANKS = 2
FAULTY = ROOT / "tests" / "support" / "faulty_run.py"
PATIENCE = 10.0  # [s] in which all ranks end after one has failed


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "pile.yaml"
    path.write_text(PILE)
    return path


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory) -> Path:
    """The directory of the uninterrupted run of 40 steps, checkpoints after 7, 14, …, 35, 40."""
    directory = tmp_path_factory.mktemp("whole")
    done = run_ranks(RANKS, ["-m", "dem_mpi", "run", scene, "--out", directory])
    assert done.returncode == 0, done.stderr
    return directory


def resume(scene: Path, directory: Path, ranks: int = RANKS) -> subprocess.CompletedProcess[str]:
    return run_ranks(ranks, ["-m", "dem_mpi", "run", scene, "--out", directory, "--resume"])


def faulty(
    ranks: int, fault: dict, *arguments: str | Path, timeout: float = 120
) -> subprocess.CompletedProcess[str]:
    """Run with a fault. Once it has happened all ranks have `PATIENCE` to end, if it is fatal."""
    process = start_ranks(ranks, [FAULTY, json.dumps(fault), "run", *arguments])
    try:
        marker = Path(fault["marker"]) if "marker" in fault else None
        deadline = time.monotonic() + timeout
        while marker and not marker.exists() and process.poll() is None:
            assert time.monotonic() < deadline, "the fault never happened"
            time.sleep(0.01)
        out, err = process.communicate(timeout=PATIENCE if marker else timeout)
    finally:
        kill_ranks(process)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


# ---- kill -9 ----------------------------------------------------------------------------------


def ranks_of(process: subprocess.Popen[str]) -> list[int]:
    """The process ids of mpirun's ranks."""
    try:
        return [
            int(p)
            for p in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        ]
    except OSError:
        return []


def run_and_kill(scene: Path, directory: Path, random: np.random.Generator, step: int) -> None:
    """Start or resume, and kill a random rank a moment after a step is done; -1 is at any time."""
    arguments = ["-m", "dem_mpi", "run", scene, "--out", directory, "--resume"]
    process = start_ranks(RANKS, arguments)
    try:
        while step >= 0 and process.poll() is None and last_step(directory) < step:
            time.sleep(0.001)
        time.sleep(random.uniform(0.0, 0.05 if step >= 0 else 3.0))
        ranks = ranks_of(process)
        if ranks:
            os.kill(int(random.choice(ranks)), signal.SIGKILL)
        process.communicate(timeout=30)  # mpirun ends the others
    finally:
        kill_ranks(process)


def test_kill_9_at_random_moments_costs_no_bit(scene, whole, tmp_path):
    random = np.random.default_rng(20)
    for step in sorted(random.integers(1, 38, 5)):
        run_and_kill(scene, tmp_path, random, int(step))
    done = resume(scene, tmp_path)
    assert done.returncode == 0, done.stderr
    assert differences(whole, tmp_path) == []


@pytest.mark.long
@pytest.mark.parametrize("block", range(10))
def test_fifty_kills_at_any_time_cost_no_bit(scene, whole, tmp_path, block):
    random = np.random.default_rng(block)
    for _ in range(5):
        run_and_kill(scene, tmp_path, random, -1)
    done = resume(scene, tmp_path)
    assert done.returncode == 0, done.stderr
    assert differences(whole, tmp_path) == []


def test_kill_9_between_the_stages_of_a_checkpoint_costs_no_bit(scene, whole, tmp_path):
    """One run, killed in the middle of a checkpoint six times, on either rank."""
    temporary = "its writing was interrupted"
    # Rank 0 renames as soon as the file is verified: before that a kill of rank 1 holds it up.
    victims = {
        "created": 1, "data written": 0, "flushed": 1, "verified": 0,
        "renamed": 1, "old ones removed": 0,
    }  # fmt: skip
    newest = 0
    for stage, rank in victims.items():
        fault = {"do": "kill_at_stage", "stage": stage, "step": newest + 7, "rank": rank}
        done = faulty(RANKS, fault, scene, "--out", tmp_path, "--resume")
        assert done.returncode not in (0, 75)
        assert newest == 0 or f"resuming from run.checkpoint.{newest:09d}.h5" in done.stdout
        kept = sorted(p.name for p in tmp_path.glob("run.checkpoint.*"))
        # Up to the renaming the previous one is what there is; the user hears of the other.
        found = checkpoint.find(Parallel.alone(), tmp_path, "run")
        step = found.step if found else 0
        renamed = stage in ("renamed", "old ones removed")
        assert step == (newest + 7 if renamed else newest), kept
        if not renamed:
            assert any(name.endswith(".tmp") for name in kept)
            assert found is None or found.skipped[0].reason == temporary
        newest = step
    done = resume(scene, tmp_path)
    assert done.returncode == 0, done.stderr
    assert differences(whole, tmp_path) == []


def test_the_user_hears_which_checkpoint_was_skipped_and_why(scene, tmp_path):
    alone = Parallel.alone()
    simulate(alone, PILE, tmp_path, "time.end=0.04", steps=7)
    (tmp_path / "run.checkpoint.000000014.h5.tmp").write_bytes(b"cut short")
    said = simulate(alone, PILE, tmp_path, "time.end=0.04", resume=True)
    assert said[0] == "skipped run.checkpoint.000000014.h5.tmp: its writing was interrupted"
    assert said[1] == "resuming from run.checkpoint.000000007.h5, step 7"
    assert not list(tmp_path.glob("*.tmp"))


# ---- damaged checkpoints ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_checkpoints(tmp_path_factory) -> Path:
    """A stopped run on one rank, with checkpoints of step 7 and 10, and its whole in `whole`."""
    directory = tmp_path_factory.mktemp("stopped")
    alone = Parallel.alone()
    simulate(alone, PILE, directory / "whole", "time.end=0.04")
    simulate(alone, PILE, directory / "run", "time.end=0.04", steps=10)
    return directory


@pytest.fixture
def stopped(two_checkpoints, tmp_path) -> Path:
    shutil.copytree(two_checkpoints / "run", tmp_path / "run")
    return tmp_path / "run"


def cut_to(size: float):
    def cut(path: Path) -> None:
        os.truncate(path, int(size * path.stat().st_size))

    return cut


def flip_in_data(path: Path) -> None:
    for name, first, length in dataset_offsets(path):
        if name == "groups/bodies/velocity":
            damage(path, first + length // 2, bits=1)


def flip_in_structure(path: Path) -> None:
    """A bit of a leaf of the tree of links, over which HDF5 1.10.8 crashes."""
    damage(path, path.read_bytes().index(b"BTLF") + 40, bits=1)


def forge(change) -> Callable[[Path], None]:
    """A damage that is no accident: the file is changed and sealed again."""

    def do(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)
        write_seal(path)

    return do


def link_away(file: h5py.File) -> None:
    del file["groups/bodies/velocity"]
    file["groups/bodies/velocity"] = h5py.ExternalLink("/etc/hostname", "/velocity")


def claim_much(file: h5py.File) -> None:
    del file["groups/bodies/velocity"]
    file.create_dataset("groups/bodies/velocity", (1 << 40, 3), "f8", chunks=(1 << 10, 3))


def hold_objects(file: h5py.File) -> None:
    file.create_dataset("shared/note", data="text of any length")


DAMAGES = {
    "empty": (cut_to(0), "the file is empty"),
    "cut in half": (cut_to(0.5), "truncated|cannot be opened|damaged"),
    "cut by its end": (cut_to(0.99), "truncated|the seal at its end is missing"),
    "one bit flipped": (flip_in_data, "checksum of 'groups/bodies/velocity' does not match"),
    "one bit of structure": (flip_in_structure, "checksum of the file's structures does not match"),
    "external link": (forge(link_away), "link by name or to another file: refused"),
    "huge shape": (forge(claim_much), "claims shape .* refused"),
    "objects": (forge(hold_objects), "not plain numbers or texts: refused"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(two_checkpoints, stopped, kind):
    do, words = DAMAGES[kind]
    do(checkpoints(stopped)[-1])
    said = simulate(Parallel.alone(), PILE, stopped, "time.end=0.04", resume=True)
    assert re.match(rf"skipped run\.checkpoint\.000000010\.h5: .*({words})", said[0])
    assert said[1] == "resuming from run.checkpoint.000000007.h5, step 7"
    assert differences(two_checkpoints / "whole", stopped) == []


@pytest.mark.parametrize("kind", DAMAGES)
def test_without_a_valid_checkpoint_resuming_ends_with_65(stopped, kind):
    do, words = DAMAGES[kind]
    trajectory = (stopped / "run.h5").read_bytes()
    for path in checkpoints(stopped):
        do(path)
    with pytest.raises(DataError, match=words) as refused:
        simulate(Parallel.alone(), PILE, stopped, "time.end=0.04", resume=True)
    assert refused.value.exit_code == 65
    assert "run.checkpoint.000000007.h5" in str(refused.value)
    assert (stopped / "run.h5").read_bytes() == trajectory


def test_a_byte_flipped_anywhere_is_noticed(stopped):
    random = np.random.default_rng(6)
    newest = checkpoints(stopped)[-1]
    good = newest.read_bytes()
    for offset in random.integers(0, len(good), 100):
        newest.write_bytes(good)
        damage(newest, int(offset), bits=int(random.integers(1, 256)))
        found = checkpoint.find(Parallel.alone(), stopped, "run")
        assert found.step == 7 and found.skipped[0].reason


def test_resuming_from_nothing_valid_ends_three_ranks_with_65_and_one_line(scene, stopped):
    for path in checkpoints(stopped):
        path.write_bytes(b"")
    done = resume(scene, stopped, ranks=3)
    assert done.returncode == 65
    assert len(messages(done.stderr)) == 1 and "no valid checkpoint of 'run'" in done.stderr


def test_a_damaged_trajectory_is_kept_and_a_new_one_begun(stopped):
    os.truncate(stopped / "run.h5", 1000)
    said = simulate(Parallel.alone(), PILE, stopped, "time.end=0.04", resume=True)
    assert "kept as run.h5.damaged-1" in "\n".join(said)
    assert (stopped / "run.h5.damaged-1").stat().st_size == 1000
    found = describe(stopped / "run.h5")
    assert found.valid and found.steps == (12, 20)


# ---- full disk --------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A directory on a disk of 3 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(place)]
    if os.geteuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a disk of a given size takes root to mount")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def test_a_disk_too_small_for_the_run_is_noticed_before_it(small_disk):
    alone = Parallel.alone()
    with pytest.raises(OutputError, match=r"not enough disk space: .* needed, .* free") as refused:
        simulate(alone, PILE, small_disk / "run", "time.end=4", "output.interval=2e-3")
    assert refused.value.exit_code == 74
    assert not (small_disk / "run" / "run.h5").exists()


def test_a_disk_that_becomes_full_ends_with_74_and_a_resumable_state(scene, whole, small_disk):
    directory, filler = small_disk / "run", small_disk / "filler"
    fault = {"do": "fill", "path": str(filler), "rank": 0, "step": 10}
    done = faulty(RANKS, fault, scene, "--out", directory)
    assert done.returncode == 74, done.stderr
    assert len(messages(done.stderr)) == 1 and re.search("space", done.stderr)
    assert [path.name for path in checkpoints(directory)] == ["run.checkpoint.000000007.h5"]
    assert not list(directory.glob("*.tmp"))
    filler.unlink()
    done = resume(scene, directory)
    assert done.returncode == 0, done.stderr
    assert differences(whole, directory) == []


def test_a_limit_on_file_size_ends_with_74_and_a_resumable_state(scene, whole, tmp_path):
    fault = {"do": "limit", "bytes": 1 << 12, "rank": 0, "step": 10}
    done = faulty(RANKS, fault, scene, "--out", tmp_path)
    assert done.returncode == 74, done.stderr
    assert len(messages(done.stderr)) == 1 and "File too large" in done.stderr
    assert [path.name for path in checkpoints(tmp_path)] == ["run.checkpoint.000000007.h5"]
    assert not list(tmp_path.glob("*.tmp"))
    done = resume(scene, tmp_path)
    assert done.returncode == 0, done.stderr
    assert differences(whole, tmp_path) == []


# ---- signals ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "step"),
    [({"do": "signal", "rank": 1, "step": 10}, 10), ({"do": "signal_in_warm_up", "rank": 0}, 1)],
    ids=["within a step", "while kernels are compiled"],
)
def test_usr1_saves_after_the_step_it_comes_in(scene, whole, tmp_path, fault, step):
    done = faulty(RANKS, fault, scene, "--out", tmp_path)
    assert done.returncode == 75, done.stderr
    assert len(messages(done.stderr)) == 1
    assert f"stopped by SIGUSR1 after step {step}" in done.stderr and "--resume" in done.stderr
    assert checkpoints(tmp_path)[-1].name == f"run.checkpoint.{step:09d}.h5"
    done = resume(scene, tmp_path)
    assert done.returncode == 0, done.stderr
    assert differences(whole, tmp_path) == []


def test_usr1_to_mpirun_reaches_the_ranks(scene, tmp_path):
    arguments = ["-m", "dem_mpi", "run", scene, "--out", tmp_path, "--set", "time.end=100"]
    process = start_ranks(RANKS, arguments)
    try:
        wait_for(lambda: last_step(tmp_path) > 2, process)
        process.send_signal(signal.SIGUSR1)
        _, err = process.communicate(timeout=60)
    finally:
        kill_ranks(process)
    assert process.returncode == 75
    assert f"stopped by SIGUSR1 after step {last_step(tmp_path)};" in err
    assert checkpoints(tmp_path)[-1].name == f"run.checkpoint.{last_step(tmp_path):09d}.h5"


def wait_for(condition, process: subprocess.Popen[str], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def start_script(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [str(ROOT / "scripts" / "run"), *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=rank_environment(),
        start_new_session=True,
    )


def descendants(pid: int) -> Iterator[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return
    for child in map(int, children):
        yield child
        yield from descendants(child)


def has_ranks(process: subprocess.Popen[str]) -> bool:
    """Whether a rank of it has begun to start Python."""
    for pid in descendants(process.pid):
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"dem_mpi" in words and b"-m" in words and b"python" in words[0].rpartition(b"/")[2]:
            return True
    return False


def test_term_and_int_to_the_run_script_save_and_resuming_completes(tmp_path):
    """TERM while it steps, INT while the ranks start, then to the end."""
    scene = tmp_path / "leaving.yaml"
    scene.write_text(LEAVING)
    out = tmp_path / "out"
    # A checkpoint every step makes the run last longer than the signals take.
    settings = ["time.end=0.8", "checkpoint.interval=4e-3"]
    arguments = [scene, "-n", "2", "--out", out, "--resume"]
    arguments += [word for setting in settings for word in ("--set", setting)]
    moments = {signal.SIGTERM: lambda: last_step(out) > 3, signal.SIGINT: None}
    for number, moment in moments.items():
        process = start_script(*arguments)
        try:
            wait_for(moment or (lambda p=process: has_ranks(p)), process)
            process.send_signal(number)
            _, err = process.communicate(timeout=120)
        finally:
            kill_ranks(process)
        assert process.returncode == 75, err
        step = last_step(out)
        assert f"stopped by SIGUSR1 after step {step};" in err
        assert checkpoints(out)[-1].name == f"run.checkpoint.{step:09d}.h5"
    done = subprocess.run(
        [str(ROOT / "scripts" / "run"), *map(str, arguments)],
        env=rank_environment(), capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = describe(out / "run.h5")
    assert found.valid and found.complete
    assert found.frames == 101 and found.steps == (0, 200)
    assert [line["step"] for line in metrics(out)] == list(range(1, 201))


# ---- one rank fails ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("do", "rank", "words"),
    [
        ("raise", 2, "internal error on rank 2 of 3: a fault made by a test"),
        ("refuse", 1, "rank 1 of 3: only this rank met: a fault made by a test"),
        ("kill", 1, ""),
    ],
)
def test_a_fault_on_one_rank_ends_all_of_them_with_its_message(scene, tmp_path, do, rank, words):
    fault = {"do": do, "rank": rank, "step": 8, "marker": str(tmp_path / "struck")}
    done = faulty(3, fault, scene, "--out", tmp_path / "out")
    assert (tmp_path / "struck").exists()
    assert words in done.stderr
    if do == "kill":
        assert done.returncode not in (0, 64, 65, 74, 75)
    else:
        assert done.returncode == 70
    # What was saved before is untouched.
    found = checkpoint.find(Parallel.alone(), tmp_path / "out", "run")
    assert found.step == 7 and not found.skipped


# ---- not a number, runaway overlap, solver failure --------------------------------------------


def test_a_velocity_that_is_not_a_number_stops_three_ranks_naming_body_and_step(scene, tmp_path):
    fault = {"do": "nan", "rank": 1, "step": 10}
    done = faulty(3, fault, scene, "--out", tmp_path)
    assert done.returncode == 70
    (message,) = messages(done.stderr)
    assert re.fullmatch(
        r"dem-mpi: error: step 10: position or velocity of body \d+ is not finite", message
    )
    assert "the newest checkpoint is run.checkpoint.000000007.h5" in done.stdout
    assert [path.name for path in checkpoints(tmp_path)] == ["run.checkpoint.000000007.h5"]


def finite_state_of(directory: Path) -> int:
    """The step of the newest checkpoint, all of whose numbers are finite."""
    alone = Parallel.alone()
    found = checkpoint.find(alone, directory, "run")
    bodies = checkpoint.read(alone, found.path).groups["bodies"]
    assert all(np.isfinite(array).all() for array in bodies.values())
    return found.step


def test_an_impulse_that_is_not_a_number_never_reaches_the_bodies(monkeypatch, tmp_path):
    from dem_mpi.solvers.apgd import Apgd

    original, calls = Apgd.solve, []

    def solve(self, *arguments):
        report = original(self, *arguments)
        calls.append(1)
        if len(calls) == 5:
            report.impulse[:1] = np.nan
        return report

    monkeypatch.setattr(Apgd, "solve", solve)
    with pytest.raises(
        SolverFailureError, match=r"step 5: the new velocity of body \d+ is not fin"
    ):
        simulate(Parallel.alone(), PILE, tmp_path)
    assert finite_state_of(tmp_path) == 4


@pytest.mark.parametrize("policy", ["stop", "shrink_step", "continue_and_flag"])
def test_a_solver_failure_names_contact_and_step_and_keeps_the_state_before(tmp_path, policy):
    """The state kept is that of a run which ended a step earlier, also after half steps."""
    contact = (
        f"contact.on_failure={policy}", "contact.max_iterations=8", "contact.tolerance=1e-8",
        "contact.stop_factor=1e4",
    )  # fmt: skip
    if policy == "continue_and_flag":
        contact = (*contact[:-1], "contact.stop_factor=1")
    alone = Parallel.alone()
    with pytest.raises(SolverFailureError) as failure:
        simulate(alone, PILE, tmp_path / "failed", *contact)
    assert failure.value.exit_code == 70
    text = str(failure.value)
    step = int(re.match(r"step (\d+): ", text)[1])
    assert re.search(r"worst at the contact of body \d+ with (body \d+|wall 'box\.\w+')", text)
    assert finite_state_of(tmp_path / "failed") == step - 1 > 0
    simulate(alone, PILE, tmp_path / "before", *contact, steps=step - 1)
    one = checkpoint.read(alone, checkpoints(tmp_path / "failed")[-1]).groups["bodies"]
    other = checkpoint.read(alone, checkpoints(tmp_path / "before")[-1]).groups["bodies"]
    order, reference = np.argsort(one["gid"]), np.argsort(other["gid"])
    for name in ("position", "velocity", "angular_velocity", "orientation"):
        assert np.array_equal(one[name][order], other[name][reference]), name


def test_a_runaway_overlap_stops_naming_bodies_and_step(tmp_path):
    """One iteration a step cannot hold a sphere that is shot into another."""
    scene = """
        domain: {min: [-9, -9, -9], max: [9, 9, 9]}
        gravity: [0, 0, 0]
        materials: {m: {density: 1000}}
        bodies:
          - {material: m, count: 3, radius: 0.1, velocity: [0, 0, -5],
             placement: {jittered_grid: {min: [0, 0, 0.0], max: [0.2, 0.2, 0.61]}}}
        walls: [{shape: plane, name: floor, material: m, point: [0, 0, 0], normal: [0, 0, 1]}]
        time: {step: 1e-2, end: 1}
        contact: {max_iterations: 1, warm_start: false, stop_factor: 1e12, recovery_speed: 1e-6}
        checkpoint: {interval: 1e-2}
        """
    with pytest.raises(SolverFailureError) as failure:
        simulate(Parallel.alone(), scene, tmp_path)
    text = str(failure.value)
    assert re.search(r"step \d+: an overlap of [\d.]+ radii, .* of body \d with (body|wall)", text)
    assert "bodies pass through each other" in text
    step = int(re.match(r"step (\d+)", text)[1])
    assert finite_state_of(tmp_path) == step - 1


# ---- a second writer --------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["force", "resume"])
def test_a_second_run_on_the_same_output_is_refused_and_harms_nothing(stopped, option):
    alone = Parallel.alone()
    before = {path.name: path.read_bytes() for path in stopped.iterdir()}
    lock = OutputLock(alone, stopped / "run.h5")
    try:
        with pytest.raises(OutputError, match=r"another run is writing it \(process \d+ on") as no:
            simulate(alone, PILE, stopped, "time.end=0.04", **{option: True})
        assert no.value.exit_code == 74
    finally:
        lock.release()
    assert {path.name: path.read_bytes() for path in stopped.iterdir()} == before


# ---- long and large runs ----------------------------------------------------------------------


@pytest.mark.parametrize("operator", ["matrix_free", "assembled"])
def test_memory_does_not_grow_with_the_steps(tmp_path, operator):
    """2 KiB a step, lists and patterns being made anew all the time, would be 1.6 MiB here."""
    small = (
        "bodies.0.count=6", "time.end=2", "output.interval=0.1", "checkpoint.interval=0.1",
        "contact.skin=0.05", "contact.max_iterations=10", f"contact.operator={operator}",
    )  # fmt: skip
    simulate(Parallel.alone(), PILE, tmp_path, *small)
    lines = [json.loads(text) for text in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert len(lines) == 1000 and sum(line["rebuilt"] for line in lines) > 300
    assert lines[-1]["memory"] - lines[199]["memory"] < 1.6 * 2**20


class Crowd(Parallel):
    """One rank that stands for 2^30 alike, as far as sums of counts go."""

    FACTOR = 1 << 30

    def _reduce(self, value, operation):
        result = super()._reduce(value, operation)
        return result * self.FACTOR if operation is MPI.SUM else result

    def sum_in_place(self, array):
        if array.dtype.kind == "i":
            array *= self.FACTOR


def test_counts_of_a_step_pass_32_bits():
    scenario = parse_scenario(PILE, "scene.yaml").scenario
    crowd = Crowd(MPI.COMM_SELF)
    arrays = place(Parallel.alone(), scenario)
    simulation = Simulation(
        crowd, scenario, start(Parallel.alone(), Bodies.from_arrays(arrays, [2500.0]))
    )
    for _ in range(3):
        record = simulation.step()
    contacts, remainder = divmod(record.contacts, Crowd.FACTOR)
    assert remainder == 0 and 10 < contacts < 1000 and record.contacts > 2**33
    assert isinstance(json.loads(json.dumps(record.contacts)), int)


def test_sizes_and_offsets_of_files_pass_32_bits(two_checkpoints):
    scenario = parse_scenario(PILE, "scene.yaml").scenario
    fields = trajectory_fields(scenario)
    assert frame_bytes(fields, 2**40) == 2**40 * frame_bytes(fields, 1)
    structure = checkpoint_bytes(0, 0)
    row = checkpoint_bytes(1, 4) - structure
    assert checkpoint_bytes(2**40, 4 * 2**40) == structure + 2**40 * row
    with h5py.File(two_checkpoints / "whole" / "run.h5") as file:
        for name in ("frames/offset", "frames/count", "frames/step", "gid",
                     "VTKHDF/Steps/PointOffsets", "VTKHDF/Vertices/Connectivity"):  # fmt: skip
            assert file[name].dtype == np.int64, name


def test_a_group_of_bodies_from_a_hostile_file_is_refused(tmp_path):
    """What reaches the user of `dem-mpi run`; the attacks themselves are tested with placement."""
    with h5py.File(tmp_path / "bodies.h5", "w") as file:
        file["position"] = h5py.ExternalLink("/etc/hostname", "/position")
    scene = re.sub(r"count: 60, ", "", PILE)
    scene = re.sub(r"\{jittered_grid: .*\}\},", "{file: bodies.h5},", scene)
    with pytest.raises((DataError, InputError)) as refused:
        parse_scenario(scene, tmp_path / "scene.yaml")
    assert refused.value.exit_code == 65
    assert "only data inside the file is read" in str(refused.value)
