"""Checkpoints: what is saved comes back bit for bit on any ranks, or the file is refused."""

from __future__ import annotations

import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest

from dem_mpi import checkpoint
from dem_mpi.errors import DataError, InputError, OutputError
from dem_mpi.h5files import checksum, open_checked, row_checksums
from dem_mpi.parallel import Parallel

from launch import run_ranks

on_ranks = pytest.mark.mpi(ranks=[1, 2, 3, 8])
either_way = pytest.mark.parametrize("through_root", [False, True], ids=["mpi-io", "root"])
RAGGED = {"impulses": ("bodies", "impulse_count")}
ATTRIBUTES = {"time": 0.1 + 0.2, "seed": 2**62, "scenario": '{"name": "µ"}', "flag": True}


def state(gid):
    """A group per kind of row, every value a function of the body it belongs to."""
    gid = np.asarray(gid, dtype=np.int64)
    count = gid % 4
    owner = np.repeat(gid, count)
    return {
        "bodies": {
            "gid": gid,
            "impulse_count": count,
            "position": np.sin(gid[:, None] + np.arange(3.0)),
            "material": (gid % 3).astype(np.int32),
        },
        "impulses": {"owner": owner, "impulse": np.cos(owner[:, None] * np.arange(1.0, 4.0))},
        "nothing": {"value": np.zeros((0, 2))},
    }


SHARED = {"origin": np.arange(3.0), "edge": np.float64(0.1), "none": np.zeros((0, 2))}


def rows_of(parallel, total):
    """Bodies of a rank, unevenly: rank 1 has none, the last most."""
    ends = np.linspace(0, 1, parallel.size + 1) ** 2 * total
    ends[2:3] = ends[1:2] if parallel.size > 2 else ends[2:3]
    a, b = ends.astype(int)[[parallel.rank, parallel.rank + 1]]
    return np.arange(a, b)


def save(parallel, directory, step=10, total=37, **options):
    mine = rows_of(parallel, total)
    options = {"ragged": RAGGED, **options}
    checkpoint.write(parallel, directory, "run", step, state(mine), SHARED, ATTRIBUTES, **options)
    return mine


def assert_equal_groups(actual, expected):
    assert actual.keys() == expected.keys()
    for group, columns in expected.items():
        assert actual[group].keys() == columns.keys()
        for name, array in columns.items():
            assert actual[group][name].dtype == array.dtype
            assert actual[group][name].tobytes() == array.tobytes(), f"{group}/{name}"


def contents(path):
    """Every data set of a file: name, shape, type, bytes."""
    found = {}
    with h5py.File(path, "r") as file:

        def visit(name, item):
            if isinstance(item, h5py.Dataset):
                found[name] = (item.shape, item.dtype.str, item[()].tobytes())

        file.visititems(visit)
    return found


# ---- what is saved comes back --------------------------------------------------------------


@on_ranks
@either_way
def test_same_ranks_get_their_own_rows_back_bit_for_bit(parallel, shared_path, through_root):
    mine = save(parallel, shared_path, through_root=through_root)
    found = checkpoint.find(parallel, shared_path, "run")
    assert found.step == 10 and not found.skipped
    loaded = checkpoint.read(parallel, found.path)
    assert (loaded.step, loaded.ranks) == (10, parallel.size)
    assert_equal_groups(loaded.groups, state(mine))
    assert loaded.attributes == ATTRIBUTES
    assert loaded.shared.keys() == SHARED.keys()
    for name, value in SHARED.items():
        assert np.array_equal(loaded.shared[name], value)


@pytest.mark.mpi(ranks=[3, 8])
@pytest.mark.parametrize("writers", [1, 2, 3])
def test_other_rank_count_gets_equal_parts_with_their_impulses(parallel, shared_path, writers):
    some = Parallel(parallel.communicator.Split(int(parallel.rank < writers), parallel.rank))
    if parallel.rank < writers:
        save(some, shared_path, total=37)
    parallel.barrier()
    loaded = checkpoint.read(parallel, checkpoint.find(parallel, shared_path, "run").path)
    assert loaded.ranks == writers
    if parallel.size == writers:
        expected = rows_of(parallel, 37)
    else:
        ends = [37 * r // parallel.size for r in (parallel.rank, parallel.rank + 1)]
        expected = np.arange(*ends)
    assert_equal_groups(loaded.groups, state(expected))


@pytest.mark.mpi(ranks=[2, 3])
def test_both_ways_of_writing_give_the_same_data_sets(parallel, shared_path):
    save(parallel, shared_path / "a", through_root=False)
    save(parallel, shared_path / "b", through_root=True)
    name = checkpoint.checkpoint_path("", "run", 10)
    assert contents(shared_path / "a" / name) == contents(shared_path / "b" / name)


@on_ranks
@either_way
def test_a_state_without_bodies_is_a_state(parallel, shared_path, through_root):
    save(parallel, shared_path, total=0, through_root=through_root)
    loaded = checkpoint.read(parallel, checkpoint.find(parallel, shared_path, "run").path)
    assert_equal_groups(loaded.groups, state([]))


@pytest.mark.mpi(ranks=[1, 3])
def test_columns_that_contradict_each_other_are_refused_on_all_ranks(parallel, shared_path):
    groups = state(rows_of(parallel, 12))
    if parallel.rank == parallel.size - 1:
        groups["bodies"]["impulse_count"] = groups["bodies"]["impulse_count"] + 1
    with pytest.raises(ValueError, match="'bodies/impulse_count' counts"):
        checkpoint.write(parallel, shared_path, "run", 1, groups, {}, {}, ragged=RAGGED)
    assert not list(shared_path.iterdir())


# ---- which are kept ------------------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2])
def test_the_newest_are_kept_and_those_of_an_abandoned_future_removed(parallel, shared_path):
    for step in (10, 20, 30, 100):
        save(parallel, shared_path, step)
    assert [p.name[-6:-3] for p in sorted(shared_path.iterdir())] == ["030", "100"]
    save(parallel, shared_path, 40, keep=3)
    assert [p.name[-6:-3] for p in sorted(shared_path.iterdir())] == ["030", "040"]
    parallel.barrier()
    checkpoint.remove_others(parallel, shared_path, "run", 0, keep=0)
    assert not list(shared_path.iterdir())
    assert checkpoint.find(parallel, shared_path, "run") is None


def test_other_stems_and_files_are_left_alone(parallel, tmp_path):
    others = [tmp_path / "run2.checkpoint.000000001.h5", tmp_path / "run.h5"]
    for path in others:
        path.touch()
    save(parallel, tmp_path, 10, keep=1)
    save(parallel, tmp_path, 20, keep=1)
    assert all(path.exists() for path in others)
    assert checkpoint.find(parallel, tmp_path, "run").step == 20
    assert checkpoint.find(parallel, tmp_path / "absent", "run") is None


# ---- kills ---------------------------------------------------------------------------------

KILLED_WRITER = """
import os, signal, sys
import numpy as np
from dem_mpi import checkpoint
from dem_mpi.parallel import Parallel

directory, fatal, victim = sys.argv[1], sys.argv[2], int(sys.argv[3])
parallel = Parallel()

def on_stage(name):
    if name == fatal and parallel.rank == victim:
        os.kill(os.getpid(), signal.SIGKILL)

for step in (10, 20):
    rows = {"bodies": {"value": np.full(1000, float(step))}}
    hook = on_stage if step == 20 else lambda name: None
    checkpoint.write(parallel, directory, "run", step, rows, {}, {}, keep=1, on_stage=hook)
"""

STAGES = ("created", "data written", "flushed", "verified", "renamed", "old ones removed")


@pytest.mark.parametrize("stage", STAGES)
def test_a_kill_between_the_stages_of_a_write_leaves_a_valid_checkpoint(parallel, tmp_path, stage):
    program = tmp_path / "writer.py"
    program.write_text(KILLED_WRITER)
    directory = tmp_path / "out"
    # The last stages are rank 0's: killing another rank would let it finish.
    victim = 0 if STAGES.index(stage) >= 3 else 1
    done = run_ranks(2, [program, directory, stage, str(victim)], timeout=60)
    assert done.returncode not in (0, -1)
    found = checkpoint.find(parallel, directory, "run")
    in_place = STAGES.index(stage) >= STAGES.index("renamed")
    assert found.step == (20 if in_place else 10)
    values = checkpoint.read(parallel, found.path).groups["bodies"]["value"]
    assert (values == found.step).all() and len(values) == 2000
    if not in_place:
        assert [s.reason for s in found.skipped] == ["its writing was interrupted"]
        rows = {"bodies": {"value": np.zeros(3)}}
        checkpoint.write(parallel, directory, "run", 30, rows, {}, {}, keep=1)
        assert len(list(directory.iterdir())) == 1


# ---- damage --------------------------------------------------------------------------------


@pytest.fixture
def two(parallel, tmp_path):
    """A directory with checkpoints of steps 10 and 20, and the path of the second."""
    save(parallel, tmp_path, 10)
    save(parallel, tmp_path, 20)
    return tmp_path, checkpoint.checkpoint_path(tmp_path, "run", 20)


def flip(path, place, bit=3):
    with path.open("r+b") as file:
        file.seek(place)
        byte = file.read(1)[0]
        file.seek(place)
        file.write(bytes([byte ^ 1 << bit]))


def test_a_flipped_byte_in_any_data_set_names_it_and_falls_back(parallel, two):
    directory, path = two
    places = {}
    with h5py.File(path, "r") as file:
        for name, (_, _, data) in contents(path).items():
            if data:
                places[name] = file[name].id.get_offset() + len(data) // 2
    assert len(places) >= 10
    for name, place in places.items():
        flip(path, place)
        found = checkpoint.find(parallel, directory, "run")
        assert found.step == 10
        assert [s.path for s in found.skipped] == [path]
        assert found.skipped[0].reason == f"checksum of '{name}' does not match"
        flip(path, place)
    assert checkpoint.find(parallel, directory, "run").step == 20


def test_a_flipped_byte_anywhere_is_found_or_harmless(parallel, two):
    directory, path = two
    expected = state(np.arange(37))
    whole = path.read_bytes()
    found_at = 0
    for place in np.random.default_rng(5).integers(0, len(whole), 120):
        flip(path, int(place))
        found = checkpoint.find(parallel, directory, "run")
        if found.step == 10:
            found_at += 1
        else:
            loaded = checkpoint.read(parallel, path)
            assert_equal_groups(loaded.groups, expected)
            assert (loaded.step, loaded.attributes) == (20, ATTRIBUTES)
        path.write_bytes(whole)
    assert found_at > 10


@pytest.mark.parametrize("kept", [0.0, 0.001, 0.3, 0.9, 0.9999])
def test_a_cut_file_is_skipped(parallel, two, kept):
    directory, path = two
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    found = checkpoint.find(parallel, directory, "run")
    assert found.step == 10 and found.skipped[0].path == path and found.skipped[0].reason


@on_ranks
def test_none_valid_is_an_error_that_names_every_fault(parallel, shared_path):
    save(parallel, shared_path, 10)
    save(parallel, shared_path, 20)
    if parallel.rank == 0:
        checkpoint.checkpoint_path(shared_path, "run", 10).write_bytes(b"")
        checkpoint.checkpoint_path(shared_path, "run", 20).write_text("not HDF5")
    parallel.barrier()
    with pytest.raises(DataError) as error:
        checkpoint.find(parallel, shared_path, "run")
    assert error.value.exit_code == 65
    assert "000000020.h5: not an HDF5 file" in str(error.value)
    assert "000000010.h5: the file is empty" in str(error.value)


def test_a_foreign_file_under_our_name_is_skipped(parallel, two):
    directory, path = two
    with h5py.File(path, "w") as file:
        file["groups/bodies/gid"] = np.arange(3)
    found = checkpoint.find(parallel, directory, "run")
    assert found.step == 10
    assert found.skipped[0].reason == "not a checkpoint of dem-mpi"


# ---- full disk -----------------------------------------------------------------------------

FILLING_WRITER = """
import resource, sys
import numpy as np
from dem_mpi import checkpoint, h5files
from dem_mpi.errors import OutputError
from dem_mpi.parallel import Parallel

directory, through_root, guard = sys.argv[1], sys.argv[2] == "root", sys.argv[3]
parallel = Parallel()
parallel.install_abort_hook()
if guard != "space":
    checkpoint.require_space = lambda path, needed: None
if guard == "read back":
    h5files._reserve_blocks = lambda path, size: None
    h5files.SharedFile.write_rows = lambda self, name, start, rows: None
rows = {"bodies": {"value": np.random.default_rng(parallel.rank).random((20_000, 3))}}
try:
    for step in range(1, 100):
        checkpoint.write(parallel, directory, "run", step, rows, {}, {}, keep=100,
                         through_root=through_root)
        if guard == "limit":
            resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
except OutputError as error:
    if parallel.rank == 0:
        print(step, error)
    sys.exit(error.exit_code)
"""


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 4 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a small file system needs root")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def fill(tmp_path, directory, ranks, way, guard):
    program = tmp_path / "writer.py"
    program.write_text(FILLING_WRITER)
    return run_ranks(ranks, [program, directory, way, guard], timeout=60)


@pytest.mark.parametrize("guard", ["space", "reservation"])
@pytest.mark.parametrize(("ranks", "way"), [(1, "mpi-io"), (2, "mpi-io"), (2, "root")])
def test_a_full_disk_ends_with_74_and_leaves_the_old_checkpoint(
    parallel, tmp_path, small_disk, ranks, way, guard
):
    done = fill(tmp_path, small_disk, ranks, way, guard)
    assert done.returncode == OutputError.exit_code, done.stderr
    step = int(done.stdout.split()[0])
    assert "space" in done.stdout
    assert step > 2
    found = checkpoint.find(parallel, small_disk, "run")
    assert found.step == step - 1 and not found.skipped
    assert not list(small_disk.glob("*.tmp"))


@pytest.mark.parametrize("way", ["mpi-io", "root"])
def test_a_file_size_limit_ends_with_74_and_leaves_the_old_checkpoint(parallel, tmp_path, way):
    done = fill(tmp_path, tmp_path / "out", 2, way, "limit")
    assert done.returncode == OutputError.exit_code, done.stderr
    assert "File too large" in done.stdout
    found = checkpoint.find(parallel, tmp_path / "out", "run")
    assert found.step == 1 and not found.skipped


def test_rows_that_silently_never_reached_the_disk_are_noticed(tmp_path):
    done = fill(tmp_path, tmp_path / "out", 2, "mpi-io", "read back")
    assert done.returncode == OutputError.exit_code, done.stderr
    assert "checksum of 'groups/bodies/value' does not match" in done.stdout
    assert not list((tmp_path / "out").iterdir())


# ---- hostile files -------------------------------------------------------------------------


def _external_link(file):
    file["x"] = h5py.ExternalLink("/etc/hostname", "/")


def _soft_link(file):
    file["x"] = h5py.SoftLink("/elsewhere")


def _external_storage(file):
    file.create_dataset("x", (4,), "u1", external=[("/etc/hostname", 0, 4)])


def _virtual(file):
    layout = h5py.VirtualLayout((4,), "u1")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (4,))
    file.create_virtual_dataset("x", layout)


def _objects(file):
    file["x"] = np.array(["a", "b"], dtype=h5py.string_dtype())


def _references(file):
    file.create_dataset("x", (1,), h5py.ref_dtype)


def _compound(file):
    file["x"] = np.zeros(2, dtype=[("a", "f8"), ("b", "i4")])


def _huge(file):
    file.create_dataset("x", (2**40, 3), "f8", chunks=(1024, 3))


def _huge_contiguous(file):
    file.create_dataset("x", (2**33,), "f8")


def _inside_a_group(file):
    file.create_group("a/b/c")["x"] = h5py.SoftLink("/elsewhere")


@pytest.mark.parametrize(
    "attack",
    [
        _external_link,
        _soft_link,
        _external_storage,
        _virtual,
        _objects,
        _references,
        _compound,
        _huge,
        _huge_contiguous,
        _inside_a_group,
    ],
)
def test_files_that_reach_out_or_claim_too_much_are_refused(tmp_path, attack):
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        attack(file)
    with pytest.raises(DataError, match=r"x\.h5: '.*x' .*refused") as error:
        open_checked(path)
    assert error.value.exit_code == 65


def test_honest_files_are_opened(tmp_path):
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file["a/values"] = np.arange(10)
        file["same"] = file["a/values"]
        file["a/loop"] = file["a"]
        file["text"] = np.bytes_("abc")
        file.create_dataset("zeros", data=np.zeros(10**6), compression="gzip", chunks=(10**5,))
    with open_checked(path) as file:
        assert file["same"][3] == 3


def test_what_is_no_hdf5_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        open_checked(tmp_path / "absent.h5")
    with pytest.raises(DataError, match="not a file"):
        open_checked(tmp_path)


# ---- checksums -----------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["f8", "i8", "i4", "u1", "?", "c16", "S5"])
def test_the_checksum_of_all_rows_is_the_sum_over_any_split(dtype):
    rows = np.random.default_rng(1).integers(0, 2, (50_000, 3)).astype(dtype)
    whole = checksum(rows)
    for cuts in ([0, 50_000], [0, 0, 17, 40_000, 50_000]):
        parts = [checksum(rows[a:b], a) for a, b in pairwise(cuts)]
        assert sum(parts) % 2**64 == whole


def test_the_checksum_sees_one_bit_and_the_order_and_places_beyond_32_bits():
    rows = np.random.default_rng(2).random((1000, 3))
    whole = checksum(rows)
    changed = rows.copy()
    changed.view(np.uint64)[500, 1] ^= np.uint64(1)
    assert checksum(changed) != whole
    swapped = rows.copy()
    swapped[[3, 900]] = swapped[[900, 3]]
    assert checksum(swapped) != whole
    assert checksum(rows, 2**34) != whole
    assert checksum(-np.zeros(3)) != checksum(np.zeros(3))
    assert row_checksums(rows).tolist() == [checksum(row[None]) for row in rows]


def test_checkpoints_need_no_mpi_program_to_be_described(tmp_path, parallel):
    save(parallel, tmp_path)
    code = (
        "import sys; from dem_mpi.checkpoint import find_damage; print([find_damage(sys.argv[1])])"
    )
    path = checkpoint.checkpoint_path(tmp_path, "run", 10)
    done = subprocess.run(
        [sys.executable, "-c", code, path], capture_output=True, text=True, cwd=Path("/")
    )
    assert done.stdout == "['']\n", done.stderr
