"""Compression while a run goes on: every frame once, within its bound, on any ranks, whatever ends
the run."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from compress.archive import Archive
from dem_mpi.errors import InputError, OutputError
from dem_mpi.h5files import OutputLock
from dem_mpi.trajectory_chunks import TrajectoryChunks

from launch import ROOT, kill_ranks, start_ranks
from runs import LEAVING, PILE, checkpoints, last_step, simulate

SECTION = (
    "compress: {fields: {velocity: 1e-3, position: {pointwise: 1e-5}, radius: exact}, chunk: 5}\n"
)
PILED = PILE.replace("interval: 6e-3", "interval: 2e-3").replace("end: 0.08", "end: 0.04") + SECTION
# Bodies migrate, are taken out, and come in, all within chunks.
COMING_AND_GOING = (
    LEAVING.replace("output: {interval: 8e-3}", "output: {interval: 4e-3}").replace(
        "walls:",
        """  - {material: glass, count: 12, radius: 0.02,
     placement: {insertion: {min: [0, 0, 0.5], max: [0.4, 0.4, 0.8], rate: 200}}}
walls:""",
    )
    + SECTION
)


def assert_archive_is_the_run(directory: Path, complete: bool = True) -> None:
    """All frames of the trajectory are in the archive, once, and values within their bounds.

    The bounds are what the scene asks for; the last digits are those of adding up norms.
    """
    with Archive(directory / "run.tt.h5") as archive, TrajectoryChunks(directory / "run.h5") as run:
        assert archive.complete == complete
        assert archive.steps.tolist() == run.index.step.tolist()
        assert archive.times.tolist() == run.index.time.tolist()
        found = archive.read()
        track = run.read(range(len(run.index)), ["velocity", "position", "radius"], (0, 2**62))
        frame = np.arange(len(run.index))[:, None]
        assert np.array_equal(found.gid, track.gid)
        assert np.array_equal(found.present, (frame >= track.first) & (frame < track.stop))
        there = found.present
        difference = found.fields["position"][there] - track.fields["position"][there]
        assert np.abs(difference).max() <= 1e-5
        assert np.array_equal(found.fields["radius"][there][:, 0], track.fields["radius"][there])
        for chunk in archive.chunks:
            exact = track.fields["velocity"][chunk][there[chunk]]
            error = np.linalg.norm(found.fields["velocity"][chunk][there[chunk]] - exact)
            assert error <= 1e-3 * np.linalg.norm(exact) * (1 + 1e-12)


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
@pytest.mark.parametrize("scene", [PILED, COMING_AND_GOING], ids=["pile", "coming and going"])
def test_the_archive_of_a_run_is_the_run_within_its_bounds(parallel, shared_path, scene):
    simulate(parallel, scene, shared_path)
    if parallel.rank == 0:
        assert_archive_is_the_run(shared_path)
    parallel.barrier()


@pytest.mark.mpi(ranks=[1, 2])
def test_a_run_stopped_again_and_again_leaves_the_archive_of_the_uninterrupted_one(
    parallel, shared_path
):
    """Stops fall in all places of a chunk; what waited is in the checkpoint each time."""
    whole, parts = shared_path / "whole", shared_path / "parts"
    simulate(parallel, PILED, whole)
    said = simulate(parallel, PILED, parts, steps=3)
    while "stopped by SIGUSR1" in said[-1]:
        if parallel.rank == 0:
            assert_archive_is_the_run(parts, complete=False)
        parallel.barrier()
        said = simulate(parallel, PILED, parts, resume=True, steps=3)
    if parallel.rank == 0:
        assert_archive_is_the_run(parts)
        with Archive(whole / "run.tt.h5") as a, Archive(parts / "run.tt.h5") as b:
            assert a.chunks == b.chunks
            one, other = a.read(), b.read()
        for name in one.fields:
            assert np.array_equal(one.fields[name], other.fields[name], equal_nan=True)
    parallel.barrier()


@pytest.mark.mpi(ranks=[3])
def test_what_waits_goes_on_on_other_ranks(parallel, shared_path):
    two = type(parallel)(parallel.communicator.Split(int(parallel.rank >= 2), parallel.rank))
    if parallel.rank < 2:
        simulate(two, PILED, shared_path, steps=8)
    parallel.barrier()
    simulate(parallel, PILED, shared_path, resume=True)
    if parallel.rank == 0:
        assert_archive_is_the_run(shared_path)
    parallel.barrier()


def test_an_archive_that_is_missing_or_damaged_begins_anew_and_says_so(parallel, tmp_path):
    simulate(parallel, PILED, tmp_path, steps=8)
    archive = tmp_path / "run.tt.h5"
    data = bytearray(archive.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    archive.write_bytes(data[: len(data) // 3])
    said = simulate(parallel, PILED, tmp_path, resume=True)
    (line,) = [line for line in said if "run.tt.h5" in line]
    assert "kept as run.tt.h5.damaged-1" in line and "begins here in a new file" in line
    with Archive(archive) as opened:
        assert opened.steps.tolist() == list(range(opened.steps[0], 21))
        assert opened.steps[0] <= 8


@pytest.mark.parametrize("change", ["seed=5", "compress.floor=0.5", "time.step=1e-3"])
def test_an_archive_of_another_seed_or_other_settings_is_not_gone_on_with(
    parallel, tmp_path, change
):
    simulate(parallel, PILED, tmp_path, steps=8)
    said = simulate(parallel, PILED, tmp_path, change, resume=True, force=True)
    (line,) = [line for line in said if "run.tt.h5" in line]
    name = change.partition("=")[0].rpartition(".")[2]
    assert "was begun with" in line and name in line
    assert "kept as run.tt.h5.damaged-1" in line


def test_an_archive_that_another_process_writes_is_left_alone(parallel, tmp_path):
    simulate(parallel, PILED, tmp_path, steps=8)
    archive = tmp_path / "run.tt.h5"
    before = archive.read_bytes()
    lock = OutputLock(parallel, archive)
    with pytest.raises(OutputError, match="another run is writing it"):
        simulate(parallel, PILED, tmp_path, resume=True)
    lock.release()
    assert archive.read_bytes() == before
    assert not list(tmp_path.glob("*.damaged*"))
    simulate(parallel, PILED, tmp_path, resume=True)
    assert_archive_is_the_run(tmp_path)


def test_a_run_spends_little_time_on_its_archive(parallel, tmp_path):
    """The effort is kept in the archive: no run waits for the last per cents of size."""
    simulate(parallel, PILED, tmp_path)
    with Archive(tmp_path / "run.tt.h5") as archive:
        assert archive.settings.effort == "fast"


def test_fields_of_the_archive_need_not_be_in_the_trajectory(parallel, tmp_path):
    scene = PILED.replace("velocity: 1e-3", "velocity: 1e-3, angular_velocity: {rmse: 1e-2}")
    scene = scene.replace("fields: [position, velocity, angular_velocity, orientation, ",
                          "fields: [position, velocity, ")  # fmt: skip
    simulate(parallel, scene, tmp_path)
    with Archive(tmp_path / "run.tt.h5") as archive:
        assert archive.fields["angular_velocity"].unit == "rad/s"
        assert archive.errors("angular_velocity").rmse <= 1e-2


def test_an_archive_without_its_run_is_not_overwritten_unasked(parallel, tmp_path):
    (tmp_path / "run.tt.h5").write_bytes(b"precious")
    with pytest.raises(InputError, match=r"run\.tt\.h5 exists: .*--force replaces it"):
        simulate(parallel, PILED, tmp_path)
    assert (tmp_path / "run.tt.h5").read_bytes() == b"precious"
    simulate(parallel, PILED, tmp_path, force=True)
    assert_archive_is_the_run(tmp_path)


def test_a_killed_run_resumes_without_a_step_lost_or_doubled(tmp_path):
    """Killed at several moments, also in the middle of a chunk."""
    scene = tmp_path / "scene.yaml"
    scene.write_text(PILED.replace("end: 0.04", "end: 0.4"))
    out = tmp_path / "out"
    command = ["-m", "dem_mpi", "run", str(scene), "--out", str(out), "--resume"]
    for target in (25, 60):
        process = start_ranks(2, command, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)})
        deadline = time.monotonic() + 100
        while last_step(out) < target and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        kill_ranks(process)
        assert last_step(out) >= target
        with Archive(out / "run.tt.h5") as archive:
            assert archive.steps.tolist() == list(range(len(archive.steps)))
    assert checkpoints(out)
    shutil.copy(out / "run.tt.h5", tmp_path / "before.h5")
    done = subprocess.run(
        [sys.executable, *command, "--force", "--set", "time.end=0.2"],
        cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert_archive_is_the_run(out)


def test_a_run_without_an_archive_imports_nothing_of_it():
    code = (
        "import dem_mpi.runner, dem_mpi.__main__, sys;"
        "print([m for m in sys.modules if m.partition('.')[0] in ('compress', 'constriction')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
