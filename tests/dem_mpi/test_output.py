"""The trajectory: the same file from any ranks, whole frames after a kill, damage by name."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import h5py
import numpy as np
import pytest

from mpi4py import MPI

from dem_mpi import checkpoint
from dem_mpi.errors import DataError, OutputError
from dem_mpi.h5files import OutputLock, lock_holder, require_space
from dem_mpi.output import Field, Series, Trajectory, describe, read_frame
from dem_mpi.parallel import Parallel

from launch import kill_ranks, run_ranks, start_ranks

on_ranks = pytest.mark.mpi(ranks=[1, 2, 3, 8])
either_way = pytest.mark.parametrize("through_root", [False, True], ids=["mpi-io", "root"])
FIELDS = (
    Field("velocity", "f8", 3, "m/s"),
    Field("radius", "f8", 1, "m"),
    Field("material", "i4", 1, "1"),
)
ATTRIBUTES = {"scene": json.dumps({"name": "µ-scene", "list": list(range(20_000))}), "seed": 4}
ATTRIBUTES["version"] = "1.2"


# Where programs that the tests start find this module and what it imports.
HELPERS = f"{Path(__file__).parent}:{Path(__file__).parents[1] / 'support'}"


def bodies_in(step):
    """Removal and insertion: none, few, and more than a chunk of 1024 rows."""
    return [7, 5, 0, 3000, 12][step % 5]


def frame(step, count=None):
    """The columns of a whole frame, a function of its step."""
    rng = np.random.default_rng(step)
    n = bodies_in(step) if count is None else count
    return {
        "position": rng.random((n, 3)),
        "velocity": rng.random((n, 3)),
        "radius": rng.random(n),
        "material": rng.integers(0, 3, n).astype(np.int32),
        "gid": rng.permutation(n),
    }


def rows_of(parallel, columns):
    """A rank's rows, unevenly: rank 1 has none."""
    n = len(columns["gid"])
    ends = [n * r // parallel.size for r in range(parallel.size + 1)]
    if parallel.size > 2:
        ends[2] = ends[1]
    a, b = ends[parallel.rank], ends[parallel.rank + 1]
    return {name: array[a:b] for name, array in columns.items()}


def create(parallel, path, **options):
    return Trajectory.create(parallel, path, FIELDS, ATTRIBUTES, bodies=7, **options)


def go_on(parallel, path, last_step, **options):
    return Trajectory.open_for_append(
        parallel, path, FIELDS, ATTRIBUTES, bodies=7, last_step=last_step, **options
    )


def write(trajectory, parallel, steps):
    for step in steps:
        trajectory.write_frame(step, 0.1 * step, rows_of(parallel, frame(step)))


def assert_frames(path, steps):
    description = describe(path)
    assert description.valid, description.reason
    assert description.frames == len(steps)
    for k, step in enumerate(steps):
        actual = read_frame(path, k)
        assert (actual.step, actual.time) == (step, 0.1 * step)
        expected = frame(step)
        assert actual.columns.keys() == expected.keys()
        for name, array in expected.items():
            assert np.array_equal(actual.columns[name], array), f"{name} of step {step}"


WALLS = (Series("walls/force", (2, 3), "N"), Series("walls/torque", (2, 3), "N m"))


def wall_reactions(step):
    """The rows of both series, a function of the step."""
    force = np.random.default_rng(1000 + step).normal(size=(2, 3))
    return {"walls/force": force, "walls/torque": -force}


@on_ranks
@pytest.mark.parametrize("compression", ["none", "gzip"])
def test_a_series_has_one_checked_row_a_frame_and_goes_on_after_an_interruption(
    parallel, shared_path, compression
):
    path = shared_path / "run.h5"
    options = {"series": WALLS, "compression": compression}
    trajectory = create(parallel, path, **options)
    for step in (0, 1, 2, 3):
        rows = rows_of(parallel, frame(step))
        trajectory.write_frame(step, 0.1 * step, rows, wall_reactions(step))
    trajectory.close()
    trajectory = go_on(parallel, path, last_step=2, **options)
    trajectory.write_frame(5, 0.5, rows_of(parallel, frame(5)), wall_reactions(5))
    trajectory.seal()
    parallel.barrier()
    assert_frames(path, [0, 1, 2, 5])
    with h5py.File(path, "r") as file:
        for name in ("walls/force", "walls/torque"):
            expected = [wall_reactions(step)[name] for step in (0, 1, 2, 5)]
            assert np.array_equal(file[name], expected)
        assert file["walls/torque"].attrs["unit"] == b"N m"


def test_a_changed_number_of_a_series_is_found_and_named(parallel, tmp_path):
    path = tmp_path / "run.h5"
    trajectory = create(parallel, path, series=WALLS)
    trajectory.write_frame(4, 0.4, frame(4), wall_reactions(4))
    trajectory.seal()
    with h5py.File(path, "r+") as file:
        file["walls/torque"][0, 1, 2] += 1e-9
    description = describe(path)
    assert not description.valid
    assert "'walls/torque' does not match in frame 0 (step 4)" in description.reason


def test_a_trajectory_with_other_series_is_kept_and_a_new_one_begun(parallel, tmp_path):
    path = tmp_path / "run.h5"
    create(parallel, path, series=WALLS).close()
    with go_on(parallel, path, last_step=0, series=WALLS[:1]) as trajectory:
        assert "walls/torque" in trajectory.message
    assert (tmp_path / "run.h5.damaged-1").exists()


def contents(path):
    """Every data set of a file: name, shape, type, bytes."""
    found = {}
    with h5py.File(path, "r") as file:

        def visit(name, item):
            if isinstance(item, h5py.Dataset):
                found[name] = (item.shape, item.dtype.str, item[()].tobytes())

        file.visititems(visit)
        places = [file[name].name for name in ("frames/time", "position", "gid", "velocity")]
    assert len(places) == 4
    return found


# ---- what is written -----------------------------------------------------------------------


@on_ranks
@either_way
@pytest.mark.parametrize("compression", ["none", "gzip"])
def test_frames_of_varying_size_come_back_from_any_ranks(
    parallel, shared_path, through_root, compression
):
    options = {"through_root": through_root, "compression": compression}
    trajectory = create(parallel, shared_path / "run.h5", **options)
    write(trajectory, parallel, range(20))
    trajectory.seal({"steps": 20})
    if parallel.rank == 0:
        assert_frames(shared_path / "run.h5", range(20))
        assert describe(shared_path / "run.h5").complete
        alone = Parallel(MPI.COMM_SELF)
        reference = create(alone, shared_path / "alone.h5", compression=compression)
        write(reference, alone, range(20))
        reference.seal({"steps": 20})
        assert contents(shared_path / "run.h5") == contents(shared_path / "alone.h5")


@on_ranks
@either_way
@pytest.mark.parametrize("compression", ["none", "gzip"])
def test_a_resumed_trajectory_equals_the_uninterrupted_one(
    parallel, shared_path, through_root, compression
):
    options = {"through_root": through_root, "compression": compression}
    for name in ("whole.h5", "resumed.h5"):
        trajectory = create(parallel, shared_path / name, **options)
        write(trajectory, parallel, range(18))
        if name == "resumed.h5":
            trajectory.close()
            trajectory = go_on(parallel, shared_path / name, last_step=11, **options)
            assert (trajectory.message, trajectory.frames, trajectory.last_step) == ("", 12, 11)
            write(trajectory, parallel, range(12, 18))
        trajectory.seal()
    # A sealed file goes on as well, compressed or not.
    trajectory = go_on(parallel, shared_path / "resumed.h5", last_step=16, **options)
    assert (trajectory.message, trajectory.frames) == ("", 17)
    write(trajectory, parallel, [17])
    trajectory.seal()
    if parallel.rank == 0:
        assert contents(shared_path / "whole.h5") == contents(shared_path / "resumed.h5")
    parallel.barrier()


@pytest.mark.mpi(ranks=[1, 3])
def test_columns_are_checked_before_anything_is_written(parallel, shared_path):
    with create(parallel, shared_path / "run.h5") as trajectory:
        write(trajectory, parallel, [5])
        with pytest.raises(ValueError, match="step 5 after that of step 5"):
            write(trajectory, parallel, [5])
        columns = rows_of(parallel, frame(8))
        if parallel.rank == parallel.size - 1:
            columns["radius"] = columns["radius"][:-1]
        with pytest.raises(ValueError, match="'radius' has another number of rows"):
            trajectory.write_frame(8, 0.8, columns)
        write(trajectory, parallel, [8])
    if parallel.rank == 0:
        assert_frames(shared_path / "run.h5", [5, 8])


def test_plain_h5py_users_find_everything_by_name(parallel, tmp_path):
    trajectory = create(parallel, tmp_path / "run.h5")
    write(trajectory, parallel, range(5))
    trajectory.seal()
    with h5py.File(tmp_path / "run.h5") as f:
        k = 3
        start, count = f["frames/offset"][k], f["frames/count"][k]
        assert np.array_equal(f["position"][start : start + count], frame(3)["position"])
        assert np.array_equal(f["frames/time"], 0.1 * np.arange(5))
        assert len(f["position"]) == sum(map(bodies_in, range(5)))
        assert f["velocity"].attrs["unit"] == b"m/s"
        assert f.attrs["scene"].decode() == ATTRIBUTES["scene"]
        for name in ("step", "count", "offset"):
            assert f["frames"][name].dtype == np.int64
    description = describe(tmp_path / "run.h5")
    assert (description.scene, description.version) == ("µ-scene", "1.2")
    assert description.bodies == (0, 3000)
    assert [f.name for f in description.fields][:2] == ["position", "gid"]


def test_a_frame_is_found_from_the_end_and_its_absence_told(parallel, tmp_path):
    trajectory = create(parallel, tmp_path / "run.h5")
    write(trajectory, parallel, range(4))
    trajectory.close()
    assert read_frame(tmp_path / "run.h5", -1, ["gid"]).step == 3
    with pytest.raises(IndexError):
        read_frame(tmp_path / "run.h5", 4)
    with pytest.raises(KeyError):
        read_frame(tmp_path / "run.h5", 0, ["colour"])


@pytest.mark.parametrize("sealed", [True, False], ids=["sealed", "interrupted"])
def test_the_layout_is_that_of_vtk_temporal_polydata(parallel, tmp_path, sealed):
    trajectory = create(parallel, tmp_path / "run.h5")
    write(trajectory, parallel, range(10))
    trajectory.seal() if sealed else trajectory.close()
    with h5py.File(tmp_path / "run.h5") as f:
        root, steps = f["VTKHDF"], f["VTKHDF/Steps"]
        assert root.attrs["Version"].tolist() == [2, 2]
        assert root.attrs["Type"] == b"PolyData" and root.attrs["Type"].dtype == "S8"
        assert steps.attrs["NSteps"] == 10
        for k in range(10):
            expected = frame(k)
            n = len(expected["gid"])
            assert steps["NumberOfParts"][k] == 1 and steps["PartOffsets"][k] == k
            assert root["NumberOfPoints"][k] == n
            start = steps["PointOffsets"][k]
            assert np.array_equal(root["Points"][start : start + n], expected["position"])
            for name in ("gid", "velocity", "radius", "material"):
                start = steps["PointDataOffsets"][name][k]
                assert np.array_equal(root["PointData"][name][start : start + n], expected[name])
            cells = root["Vertices/NumberOfCells"][k]
            place = steps["CellOffsets"][k][0] + steps["PartOffsets"][k]
            offsets = root["Vertices/Offsets"][place : place + cells + 1]
            assert offsets.tolist() == ([0, n] if n else [0])
            first = steps["ConnectivityIdOffsets"][k][0]
            ids = root["Vertices/Connectivity"][first : first + n]
            assert ids.tolist() == list(range(n))
            for name in ("Lines", "Strips", "Polygons"):
                assert root[name]["NumberOfCells"][k] == root[name]["Offsets"][k] == 0


# In a process of its own: VTK brings another HDF5 than h5py's, and one process cannot hold both.
VTK_READER = """
import sys
import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

expected = np.load(sys.argv[2])
reader = vtk.vtkHDFReader()
reader.SetFileName(sys.argv[1])
reader.UpdateInformation()
assert reader.GetNumberOfSteps() == 10
for k in range(10):
    reader.SetStep(k)
    reader.Update()
    found = reader.GetOutputDataObject(0)
    found = found.GetPartition(0) if found.IsA("vtkPartitionedDataSet") else found
    assert found.GetNumberOfPoints() == len(expected[f"gid{k}"])
    if found.GetNumberOfPoints():
        points = vtk_to_numpy(found.GetPoints().GetData())
        assert np.array_equal(points, expected[f"position{k}"])
        assert found.GetNumberOfVerts() == 1
        for name in ("gid", "velocity", "radius", "material"):
            values = vtk_to_numpy(found.GetPointData().GetArray(name))
            assert np.array_equal(values, expected[f"{name}{k}"]), name
"""


@pytest.mark.skipif(find_spec("vtk") is None, reason="VTK is an optional extra")
@pytest.mark.parametrize("sealed", [True, False], ids=["sealed", "interrupted"])
def test_vtk_reads_every_frame(parallel, tmp_path, sealed):
    trajectory = create(parallel, tmp_path / "run.h5")
    write(trajectory, parallel, range(10))
    trajectory.seal() if sealed else trajectory.close()
    expected = {f"{name}{k}": a for k in range(10) for name, a in frame(k).items()}
    np.savez(tmp_path / "expected.npz", **expected)
    command = [sys.executable, "-c", VTK_READER, tmp_path / "run.h5", tmp_path / "expected.npz"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


# ---- kills ---------------------------------------------------------------------------------

KILLED_WRITER = """
import os, signal, sys, threading
sys.path[:0] = sys.argv[1].split(':')
import test_output
from pathlib import Path
from dem_mpi.parallel import Parallel

folder, last, delay = Path(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
parallel = Parallel()
(folder / f"pid{parallel.rank}").write_text(str(os.getpid()))
trajectory = test_output.create(parallel, folder / "run.h5")
test_output.write(trajectory, parallel, range(last))
if delay >= 0:
    kill = lambda: os.kill(os.getpid(), signal.SIGKILL)
    threading.Timer(delay, kill).start()
trajectory.seal()
if delay >= 0:
    kill()
"""


def start_writer(tmp_path, ranks, last, delay=-1.0):
    program = tmp_path / "writer.py"
    program.write_text(KILLED_WRITER)
    return start_ranks(ranks, [program, HELPERS, tmp_path, str(last), str(delay)])


@pytest.mark.parametrize(("ranks", "victim"), [(1, 0), (2, 0), (2, 1), (3, 2)])
def test_a_kill_while_frames_are_written_leaves_whole_frames(parallel, tmp_path, ranks, victim):
    path = tmp_path / "run.h5"
    process = start_writer(tmp_path, ranks, last=100_000)
    try:
        limit = time.monotonic() + 60
        while time.monotonic() < limit:
            if path.exists() and path.stat().st_size > 500_000 and process.poll() is None:
                break
            time.sleep(0.01)
        time.sleep(np.random.default_rng().uniform(0.0, 0.3))
        pid = int((tmp_path / f"pid{victim}").read_text())
        os.kill(pid, signal.SIGKILL)
        process.wait(30)
    finally:
        kill_ranks(process)
    description = describe(path)
    assert description.valid, description.reason
    assert not description.complete
    assert description.writer == ""
    n = description.frames
    assert n > 0
    assert_frames(path, range(n))
    keep = n // 2
    trajectory = go_on(parallel, path, last_step=keep - 1)
    assert (trajectory.message, trajectory.frames) == ("", keep)
    write(trajectory, parallel, range(keep, n + 2))
    trajectory.seal()
    whole = create(parallel, tmp_path / "whole.h5")
    write(whole, parallel, range(n + 2))
    whole.seal()
    assert contents(path) == contents(tmp_path / "whole.h5")


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.005, 0.01])
def test_a_kill_while_sealing_loses_no_frame(parallel, tmp_path, delay):
    process = start_writer(tmp_path, 1, last=20, delay=delay)
    try:
        process.wait(60)
    finally:
        kill_ranks(process)
    assert process.returncode not in (0, None)
    assert_frames(tmp_path / "run.h5", range(20))
    trajectory = go_on(parallel, tmp_path / "run.h5", last_step=14)
    assert (trajectory.message, trajectory.frames) == ("", 15)
    trajectory.close()


# ---- damage --------------------------------------------------------------------------------


@pytest.fixture
def finished(parallel, tmp_path):
    trajectory = create(parallel, tmp_path / "run.h5")
    write(trajectory, parallel, range(10))
    trajectory.seal()
    return tmp_path / "run.h5"


DATASETS = [
    "position",
    "gid",
    "velocity",
    "radius",
    "material",
    "frames/step",
    "frames/time",
    "frames/count",
    "frames/checksum/radius",
    "frames/checksum/frame",
    "VTKHDF/Vertices/Connectivity",
    "VTKHDF/Vertices/Offsets",
    "VTKHDF/Steps/CellOffsets",
]


@pytest.mark.parametrize("name", DATASETS)
def test_a_changed_value_is_found_and_its_data_set_named(finished, name):
    with h5py.File(finished, "r+") as file:
        values = file[name][...]
        values.view(np.uint8).reshape(-1)[values.nbytes // 3] ^= 16
        file[name][...] = values
    description = describe(finished)
    assert (description.kind, description.valid, description.exit_code) == ("trajectory", False, 65)
    where = name.split("/")[-1] if "checksum" in name else name
    where = "frames" if name.startswith("frames/") and where != "radius" else where
    assert f"'{where}'" in description.reason or f"/{where}'" in description.reason


def test_a_changed_scene_text_is_found(finished):
    data = finished.read_bytes()
    place = data.rfind(b"19999]")
    assert place > 0
    finished.write_bytes(data[:place] + b"19998]" + data[place + 6 :])
    assert not describe(finished).valid


def test_a_flipped_byte_anywhere_is_told_or_harmless(finished):
    whole = finished.read_bytes()
    expected = contents(finished)
    found = 0
    for place in np.random.default_rng(3).integers(0, len(whole), 60):
        data = bytearray(whole)
        data[place] ^= 4
        finished.write_bytes(data)
        description = describe(finished)
        if description.valid:
            for name, value in contents(finished).items():
                assert value == expected[name], name
        else:
            found += 1
            assert description.exit_code == 65 and description.reason
    assert found > 0


@pytest.mark.parametrize("kept", [0.0, 0.0005, 0.5, 0.99])
def test_a_cut_file_is_told(finished, kept):
    whole = finished.read_bytes()
    finished.write_bytes(whole[: int(kept * len(whole))])
    description = describe(finished)
    assert not description.valid and description.reason


def test_other_files_are_told_apart(parallel, tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(3)
    description = describe(tmp_path / "other.h5")
    assert (description.kind, description.valid) == ("unknown", False)
    assert "neither a trajectory nor a checkpoint" in description.reason
    with pytest.raises(DataError, match="not a trajectory"):
        read_frame(tmp_path / "other.h5", 0)
    rows = {"bodies": {"gid": np.arange(5)}}
    attributes = {"time": 0.5, "version": "1.2", "scene": '{"name": "a"}'}
    path = checkpoint.write(parallel, tmp_path, "run", 7, rows, {}, attributes)
    description = describe(path)
    assert (description.kind, description.valid, description.scene) == ("checkpoint", True, "a")
    assert (description.bodies, description.steps, description.times) == (
        (5, 5),
        (7, 7),
        (0.5, 0.5),
    )


@on_ranks
def test_what_cannot_be_continued_is_kept_and_a_new_file_begun(parallel, shared_path):
    path = shared_path / "run.h5"
    for k in (1, 2):
        if parallel.rank == 0:
            path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(range(100)))
        parallel.barrier()
        trajectory = go_on(parallel, path, last_step=7)
        assert trajectory.frames == 0
        assert f"kept as run.h5.damaged-{k}" in trajectory.message
        write(trajectory, parallel, [8])
        trajectory.seal()
    other = Trajectory.open_for_append(
        parallel, path, FIELDS[:1], ATTRIBUTES, bodies=7, last_step=8
    )
    assert "holds fields" in other.message and "damaged-3" in other.message
    other.close()
    parallel.barrier()
    if parallel.rank == 0:
        path.unlink()
    parallel.barrier()
    missing = go_on(parallel, path, last_step=7)
    assert "is missing" in missing.message
    missing.close()


def test_a_damaged_last_frame_is_not_built_upon(parallel, finished):
    with h5py.File(finished, "r+") as file:
        file["radius"][-1] += 1.0
    trajectory = go_on(parallel, finished, last_step=9)
    assert "checksum of 'radius' does not match in frame 9" in trajectory.message
    trajectory.close()


# ---- two writers, full disk ----------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 3])
def test_a_second_writer_is_refused_on_all_ranks(parallel, shared_path):
    path = shared_path / "run.h5"
    with create(parallel, path) as trajectory:
        write(trajectory, parallel, [1])
        for attempt in (create, lambda *a: go_on(*a, last_step=1)):
            with pytest.raises(OutputError, match="another run is writing it \\(process") as error:
                attempt(parallel, path)
            assert error.value.exit_code == 74
        if parallel.rank == 0:
            assert "process" in describe(path).writer
            assert describe(path).valid
        parallel.barrier()
    parallel.barrier()
    assert not lock_holder(path)
    parallel.barrier()
    with go_on(parallel, path, last_step=1) as trajectory:
        assert trajectory.frames == 1


def test_a_lock_left_by_a_dead_process_holds_nobody_up(parallel, tmp_path):
    (tmp_path / "run.h5.lock").write_text("process 1 on elsewhere\n")
    lock = OutputLock(parallel, tmp_path / "run.h5")
    assert str(os.getpid()) in lock_holder(tmp_path / "run.h5")
    lock.release()
    assert not list(tmp_path.iterdir())


FILLING_WRITER = """
import resource, sys
sys.path[:0] = sys.argv[1].split(':')
import test_output
from pathlib import Path
from dem_mpi.errors import OutputError
from dem_mpi.parallel import Parallel

path, through_root = Path(sys.argv[2]), sys.argv[3] == "root"
parallel = Parallel()
parallel.install_abort_hook()
try:
    with test_output.create(parallel, path, through_root=through_root) as trajectory:
        resource.setrlimit(resource.RLIMIT_FSIZE, (8_000_000, resource.RLIM_INFINITY))
        test_output.write(trajectory, parallel, range(10_000))
except OutputError as error:
    if parallel.rank == 0:
        print(trajectory.frames, error)
    sys.exit(error.exit_code)
"""


@pytest.mark.parametrize(("ranks", "way"), [(1, "mpi-io"), (2, "mpi-io"), (2, "root")])
def test_a_file_that_may_not_grow_ends_with_74_and_keeps_its_frames(tmp_path, ranks, way):
    program = tmp_path / "writer.py"
    program.write_text(FILLING_WRITER)
    path = tmp_path / "run.h5"
    done = run_ranks(ranks, [program, HELPERS, path, way], timeout=60)
    assert done.returncode == OutputError.exit_code, done.stderr
    frames = int(done.stdout.split()[0])
    assert "cannot reserve space: File too large" in done.stdout
    assert frames > 3
    assert_frames(path, range(frames))


def test_space_is_asked_for_before_the_run(tmp_path):
    require_space(tmp_path / "not" / "there" / "run.h5", 1000)
    with pytest.raises(OutputError, match=r"not enough disk space: 1\.0 EiB needed") as error:
        require_space(tmp_path / "run.h5", 2**60)
    assert error.value.exit_code == 74
