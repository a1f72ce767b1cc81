"""The verbs of compression as whole programs: what they make, and what they refuse in one line."""

from __future__ import annotations

import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest

from compress.archive import Archive, ArchiveWriter, Block, Chunk, FieldSpec
from compress.bounds import Bound
from dem_mpi import restore_command
from dem_mpi.compress_options import ALL, Selection
from dem_mpi.errors import InputError
from dem_mpi.output import read_frame
from dem_mpi.parallel import Parallel
from dem_mpi.restore_command import compare_files, restore_file, slice_file

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
    with h5py.File(path / "d.nc", "w") as file:
        file["g/x"] = np.zeros((4, 3))
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
        ("compress d.nc", 64, "name a data set in it, d.nc:/path; it has /g/x"),
        ("compare x.npy d.nc", 64, "name a data set in it, d.nc:/path; it has /g/x"),
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
        ("compare run.h5 x.npy", 64, "no field in common"),
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


# ---- archives that are not of a run from its first frame to its last -----------------------


def archived(path, bodies, *, name="v", complete=True, source="run.h5"):
    """An archive of a chunk of two steps for each number of bodies, gids from 0 on."""
    writer = ArchiveWriter(path, {name: FieldSpec(Bound("exact"))}, provenance={"source": source})
    for k, n in enumerate(bodies):
        steps = np.arange(2) + 2 * k
        v = 10.0 * steps[:, None, None] + np.arange(n)[:, None]
        writer.append(Chunk(steps, steps * 0.1, (Block(np.arange(n), {name: v}),)))
    if complete:
        writer.close()
    else:
        writer.abandon()
    return path


def restored(path, out, bodies=ALL, steps=ALL):
    """What restore writes of an archive, and what it says."""
    said = []
    restore_file(path, Selection(steps=steps, bodies=bodies), out, True, said.append)
    return np.load(out), said


@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_bodies_that_come_later_are_restored(tmp_path, ending):
    path = archived(tmp_path / "late.tt.h5", [0, 4, 8])
    for bodies, columns in ((ALL, 8), ((5, 7), 2)):
        found, _ = restored(path, tmp_path / f"late.{ending}", bodies)
        v = found if ending == "npy" else found["v"]
        assert v.shape == (6, columns)
        assert np.isnan(v[:2]).all()
        assert v[4].tolist() == [40.0 + k for k in range(*(bodies if bodies != ALL else (0, 8)))]
    with pytest.raises(InputError, match="none of these"):
        restored(path, tmp_path / f"late.{ending}", (5, 7), (0, 4))


@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_frames_without_bodies_are_restored(tmp_path, ending):
    path = archived(tmp_path / "empty.tt.h5", [0])
    found, _ = restored(path, tmp_path / f"empty.{ending}")
    assert (found if ending == "npy" else found["v"]).shape == (2, 0)


def test_a_trajectory_begins_before_its_bodies(tmp_path):
    writer = ArchiveWriter(tmp_path / "a.tt.h5", {"position": FieldSpec(Bound("exact"), width=3)})
    with writer:
        for k, n in enumerate((0, 3)):
            steps, x = np.arange(2) + 2 * k, np.full((2, n, 3), float(k))
            writer.append(Chunk(steps, steps * 0.1, (Block(np.arange(n), {"position": x}),)))
    out = tmp_path / "back.h5"
    restore_file(tmp_path / "a.tt.h5", Selection(), out, False, lambda text: None)
    assert [len(read_frame(out, k).columns["gid"]) for k in range(4)] == [0, 0, 3, 3]


def test_arrays_have_the_bodies_of_the_steps_asked_for(tmp_path):
    path = archived(tmp_path / "grow.tt.h5", [4, 8])
    array, _ = restored(path, tmp_path / "a.npy", steps=(0, 2))
    arrays, _ = restored(path, tmp_path / "a.npz", steps=(0, 2))
    assert np.array_equal(array, arrays["v"])
    assert array.shape == (2, 4)


@pytest.mark.parametrize("name", ["file", "step", "time", "gid", "present"])
def test_fields_may_be_called_like_members(tmp_path, name):
    path = archived(tmp_path / "a.tt.h5", [3], name=name)
    found, said = restored(path, tmp_path / "a.npz")
    member = name if name == "file" else f"field_{name}"
    assert found[member].tolist() == [[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]]
    assert found["step"].tolist() == [0, 1] and found["gid"].tolist() == [0, 1, 2]
    assert any(member in line for line in said[1:]) == (name != "file")


@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_an_array_of_one_dimension_comes_back_as_one(tmp_path, ending):
    path = archived(tmp_path / "line.tt.h5", [1, 1], source="line.npy")
    found, _ = restored(path, tmp_path / f"line.{ending}")
    v = found if ending == "npy" else found["v"]
    assert v.tolist() == [0.0, 10.0, 20.0, 30.0]
    found, _ = restored(
        archived(tmp_path / "run.tt.h5", [1, 1]), tmp_path / f"run.{ending}"
    )  # one body of a run
    assert (found if ending == "npy" else found["v"]).shape == (4, 1)


def test_an_interrupted_archive_is_told_to_be_so(tmp_path, capsys):
    restored(archived(tmp_path / "whole.tt.h5", [3]), tmp_path / "a.npy")
    assert capsys.readouterr().err == ""
    restored(archived(tmp_path / "part.tt.h5", [3], complete=False), tmp_path / "a.npy")
    assert "archive is not complete" in capsys.readouterr().err


# ---- slice ---------------------------------------------------------------------------------


def test_a_slice_does_not_replace_its_archive(tmp_path):
    path = archived(tmp_path / "a.tt.h5", [3])
    with pytest.raises(InputError, match="is the archive itself"):
        slice_file(path, Selection(), path, True, print)
    with Archive(path) as archive:
        assert archive.complete


def test_rows_too_many_to_print_are_counted_without_decoding(tmp_path, monkeypatch):
    opened = []

    class Kept(Archive):
        def __init__(self, path):
            super().__init__(path)
            opened.append(self)

    monkeypatch.setattr(restore_command, "Archive", Kept)
    path, said = archived(tmp_path / "a.tt.h5", [3000, 3000]), []
    with pytest.raises(InputError, match="12,000 rows are too many"):
        slice_file(path, Selection(), None, False, said.append)
    assert not said and opened[0].decoded_pieces == 0


def test_rows_are_written_chunk_by_chunk(tmp_path):
    path, out = archived(tmp_path / "a.tt.h5", [0, 2, 3]), tmp_path / "a.csv"
    slice_file(path, Selection(), out, False, lambda text: None)
    lines = [line.split(",") for line in out.read_text().splitlines()]
    assert lines[0] == ["step", "time", "gid", "v"]
    assert [(int(a), int(c), float(d)) for a, _, c, d in lines[1:]] == [
        (step, gid, 10.0 * step + gid) for step in range(2, 6) for gid in range(2 + (step > 3))
    ]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.tt.h5"]


# ---- compare -------------------------------------------------------------------------------


def compared(tmp_path, first, second, fields=None):
    """What compare says of two arrays."""
    np.save(tmp_path / "a.npy", first)
    np.save(tmp_path / "b.npy", second)
    return compare_files(tmp_path / "a.npy", tmp_path / "b.npy", Selection(fields=fields))[1]


def test_large_whole_numbers_are_compared_exactly(tmp_path):
    first = np.full((4, 3), 2**60)
    second = first.copy()
    assert "equal, 12 numbers" in compared(tmp_path, first, second)
    second[1, 2] += 1
    assert "at most 1.0000e+00; 12 numbers" in compared(tmp_path, first, second)


def test_nan_equals_nan_and_nothing_else(tmp_path):
    first = np.arange(12.0).reshape(4, 3)
    first[0] = np.nan
    assert "equal, 12 numbers" in compared(tmp_path, first, first)
    second = first.copy()
    second[2, 1] = np.nan
    line = compared(tmp_path, first, second)
    assert "11 numbers are equal; 1 are NaN or infinite in one only" in line
    second[3, 0] += 0.5
    line = compared(tmp_path, first, second)
    assert "at most 5.0000e-01; 11 numbers; 1 are NaN" in line


def test_fields_of_a_comparison_are_checked_also_of_arrays(tmp_path):
    values = np.zeros((4, 3))
    assert "equal" in compared(tmp_path, values, values, ("b",))
    with pytest.raises(InputError, match="--fields zz: no such field"):
        compared(tmp_path, values, values, ("zz",))


def test_what_has_nothing_in_common_is_not_compared(tmp_path):
    def written(name, first_step, first_gid):
        steps, gid = np.arange(2) + first_step, np.arange(3) + first_gid
        with ArchiveWriter(tmp_path / name, {"v": FieldSpec(Bound("exact"))}) as writer:
            writer.append(Chunk(steps, steps * 0.1, (Block(gid, {"v": np.zeros((2, 3, 1))}),)))
        return tmp_path / name

    a = written("a.tt.h5", 0, 0)
    with pytest.raises(InputError, match="no step in common"):
        compare_files(a, written("b.tt.h5", 2, 0), Selection())
    with pytest.raises(InputError, match="no body in common in the 2 steps of both"):
        compare_files(a, written("c.tt.h5", 0, 3), Selection())
    lines = compare_files(a, written("d.tt.h5", 1, 1), Selection())
    assert "v: equal, 2 numbers" in lines[1] and "2 rows are in one of them only" in lines[2]
