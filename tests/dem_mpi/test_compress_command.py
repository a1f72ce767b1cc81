"""The verbs of compression as whole programs: what they make, and what they refuse in one line."""

from __future__ import annotations

import signal
import subprocess
import sys

import numpy as np
import pytest

from compress.archive import Archive
from dem_mpi.output import read_frame
from dem_mpi.parallel import Parallel

from launch import ROOT, run_ranks
from runs import PILE, messages, simulate

SCENE = PILE.replace("interval: 6e-3", "interval: 2e-3").replace("end: 0.08", "end: 0.04")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A directory with run.h5, its archive a.tt.h5, and an array x.npy."""
    path = tmp_path_factory.mktemp("verbs")
    simulate(Parallel(), SCENE, path)
    done = verb(path, "compress", "run.h5", "--output", "a.tt.h5", "--chunk", "8", "--tol", "1e-3")
    assert done.returncode == 0, done.stderr
    t = np.arange(50.0)[:, None, None]
    np.save(path / "x.npy", np.sin(0.1 * t + np.arange(40.0)[:, None] + np.arange(3.0)))
    return path


def verb(folder, *arguments: str, ranks: int = 1):
    command = ["-m", "dem_mpi", *arguments]
    if ranks > 1:
        return run_ranks(ranks, command, cwd=folder, env={"PYTHONPATH": str(ROOT)}, timeout=100)
    return subprocess.run(
        [sys.executable, *command], cwd=folder, capture_output=True, text=True, check=False
    )


def test_errors_are_told_as_they_are(folder):
    """What compress says, info tells, and compare measures anew."""
    info, compared = verb(folder, "info", "a.tt.h5"), verb(folder, "compare", "run.h5", "a.tt.h5")
    assert info.returncode == compared.returncode == 0
    assert "archive" in info.stdout and "complete" in info.stdout
    with Archive(folder / "a.tt.h5") as archive:
        errors = archive.errors("velocity")
        assert 0.0 < errors.relative <= 1e-3
    (line,) = [line for line in compared.stdout.splitlines() if "velocity:" in line
               and "angular" not in line]  # fmt: skip
    assert f"relative {errors.relative:.4e}" in line


@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_share_the_work_within_the_same_bound(folder, ranks):
    out = f"ranks{ranks}.tt.h5"
    arguments = ("compress", "run.h5", "--output", out, "--tol", "1e-3", "--chunk", "8")
    done = verb(folder, *arguments, ranks=ranks)
    assert done.returncode == 0, done.stderr
    with Archive(folder / out) as several, Archive(folder / "a.tt.h5") as one:
        assert several.errors("velocity").relative <= 1e-3
        a, b = several.read(["velocity"]), one.read(["velocity"])
    assert np.array_equal(a.gid, b.gid)
    scale = np.linalg.norm(b.fields["velocity"])
    assert np.linalg.norm(a.fields["velocity"] - b.fields["velocity"]) <= 2e-3 * scale


def test_a_restored_trajectory_is_one(folder):
    done = verb(folder, "restore", "a.tt.h5", "--output", "back.h5", "--force")
    assert done.returncode == 0, done.stderr
    info = verb(folder, "info", "back.h5")
    assert info.returncode == 0 and "trajectory" in info.stdout and "valid" in info.stdout
    assert "21 frames, complete" in info.stdout
    first, last = (read_frame(folder / name, -1) for name in ("run.h5", "back.h5"))
    assert (first.step, first.time) == (last.step, last.time)
    order = np.argsort(first.columns["gid"])
    assert np.array_equal(first.columns["radius"][order], last.columns["radius"])


def test_a_part_is_that_part_of_the_whole(folder):
    part = ("--fields", "velocity", "--steps", "5:12", "--bodies", "10:30")
    assert verb(folder, "restore", "a.tt.h5", *part, "--output", "p.npz").returncode == 0
    assert verb(
        folder, "restore", "a.tt.h5", "--fields", "velocity", "--output", "w.npy"
    ).returncode == 0  # fmt: skip
    found, whole = np.load(folder / "p.npz"), np.load(folder / "w.npy")
    assert found["step"].tolist() == list(range(5, 12))
    assert found["gid"].tolist() == list(range(10, 30))
    assert np.array_equal(found["velocity"], whole[5:12, 10:30])
    shown = verb(
        folder, "slice", "a.tt.h5", "--fields", "velocity", "--steps", "5", "--bodies", "10"
    )
    title, row = shown.stdout.splitlines()
    assert title.split() == ["step", "time", "gid", "velocity_x", "velocity_y", "velocity_z"]
    assert [float(x) for x in row.split()[3:]] == pytest.approx(whole[5, 10], rel=1e-8)


def test_an_array_comes_back_in_its_shape(folder):
    assert (
        verb(folder, "compress", "x.npy", "--field", "x=pointwise:1e-4", "--force").returncode == 0
    )
    assert verb(folder, "restore", "x.tt.h5", "--output", "y.npy", "--force").returncode == 0
    x, y = np.load(folder / "x.npy"), np.load(folder / "y.npy")
    assert x.shape == y.shape
    assert np.abs(x - y).max() <= 1e-4
    assert verb(folder, "compare", "x.npy", "x.tt.h5").returncode == 0


def test_a_signal_ends_behind_a_chunk_and_resume_goes_on(folder):
    np.save(folder / "long.npy", np.random.default_rng(0).standard_normal((400, 500, 3)))
    command = [sys.executable, "-m", "dem_mpi", "compress", "long.npy", "--chunk", "4"]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    for line in process.stdout:
        if b"remaining" in line:
            break
    process.send_signal(signal.SIGUSR1)
    _, stderr = process.communicate(timeout=100)
    assert process.returncode == 75, stderr
    assert b"--resume" in stderr
    with Archive(folder / "long.tt.h5") as archive:
        done = len(archive.steps)
        assert 0 < done < 400 and not archive.complete
    assert verb(folder, "compress", "long.npy", "--chunk", "4").returncode == 64
    assert verb(folder, "compress", "long.npy", "--chunk", "4", "--resume").returncode == 0
    with Archive(folder / "long.tt.h5") as archive:
        assert archive.complete
        assert archive.steps.tolist() == list(range(400))
        assert archive.errors("long").relative <= 1e-2


def test_what_to_expect_is_told_without_writing(folder):
    done = verb(folder, "compress", "run.h5", "--output", "never.tt.h5", "--explain")
    assert done.returncode == 0, done.stderr
    assert "velocity (relative 0.01)" in done.stdout
    assert not (folder / "never.tt.h5").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ("compress missing.h5", 64, "no such file"),
        ("compress a.tt.h5", 65, "not a trajectory"),
        ("compress run.h5 --tol -1", 64, "--tol -1: must be > 0"),
        ("compress run.h5 --tol nan", 64, "--tol nan: must be > 0"),
        ("compress run.h5 --chunk 0", 64, "--chunk 0: must be between"),
        ("compress run.h5 --floor 2", 64, "--floor 2: must be between"),
        ("compress run.h5 --field velocty", 64, "did you mean velocity?"),
        ("compress run.h5 --field velocity=pointwse:1", 64, "did you mean pointwise?"),
        ("compress run.h5 --field velocity=0", 64, "must be > 0"),
        ("compress run.h5 --field gid", 64, "gids are always kept"),
        ("compress run.h5 --output a.tt.h5", 64, "--resume goes on with it, --force replaces it"),
        ("compress run.h5 --output run.h5 --force", 64, "is the source itself"),
        ("compress run.h5 --output no/where.h5", 64, "there is no directory"),
        ("compress run.h5 --resume --force", 64, "one goes on with the archive"),
        ("compress x.npy --field velocity", 64, "no such field"),
        ("compress run.h5:/nothing", 64, "no data set"),
        ("restore a.tt.h5 --fields velocty", 64, "did you mean velocity?"),
        ("restore a.tt.h5 --steps 12:5", 64, "A must be below B"),
        ("restore a.tt.h5 --steps x", 64, "--steps x: must be A:B"),
        ("restore a.tt.h5 --steps 500:", 64, "none of these"),
        ("restore a.tt.h5 --bodies 500:600", 64, "none of these"),
        ("restore a.tt.h5 --output a.txt", 64, "must end in .h5, .npz, .npy"),
        ("restore a.tt.h5 --output a.npy", 64, "choose it with --fields"),
        ("restore a.tt.h5 --fields velocity --output v.h5", 64, "needs position"),
        ("restore run.h5", 65, "run.h5"),
        ("slice a.tt.h5 --output no/where.csv", 64, "there is no directory"),
        ("compare run.h5 x.npy", 64, "has no field"),
        ("compare run.h5 missing.npy", 64, "no such file"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(folder, arguments, code, words):
    done = verb(folder, *arguments.split())
    assert done.returncode == code, done.stderr
    (line,) = messages(done.stderr)
    assert line.startswith("dem-mpi: error: ") and words in line


@pytest.mark.parametrize("place", [0.1, 0.3, 0.5, 0.7, 0.9, "short"])
def test_a_damaged_archive_is_refused_in_one_line(folder, tmp_path, place):
    """Damage to bytes that HDF5 has left unused changes nothing, and may pass."""
    data = bytearray((folder / "a.tt.h5").read_bytes())
    if place == "short":
        data = data[: len(data) // 2]
    else:
        middle = int(place * len(data))
        data[middle : middle + 64] = bytes(byte ^ 0x5A for byte in data[middle : middle + 64])
    (tmp_path / "bad.tt.h5").write_bytes(data)
    info = verb(tmp_path, "info", "bad.tt.h5")
    done = verb(tmp_path, "restore", "bad.tt.h5", "--output", "x.h5")
    assert info.returncode == done.returncode
    if info.returncode == 0:
        assert place == 0.1
        compared = verb(tmp_path, "compare", str(folder / "a.tt.h5"), "x.h5").stdout
        assert compared.count(" equal") == len(compared.splitlines()) - 1
        return
    assert info.returncode == 65
    assert len(info.stdout.splitlines()) == 1 and "not valid: " in info.stdout
    (line,) = messages(done.stderr)
    assert "bad.tt.h5" in line
    assert not list(tmp_path.glob("x.h5*"))


@pytest.mark.parametrize("name", ["compress", "restore", "slice", "compare"])
def test_every_option_is_explained(name, folder):
    done = verb(folder, name, "--help")
    assert done.returncode == 0
    assert "Exit codes" in done.stdout
