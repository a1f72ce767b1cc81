"""Archives: what comes back, how much is decoded for it, and what damage does."""

from __future__ import annotations

import errno
import gc
import os
import shutil
import signal
import subprocess
import sys
import tracemalloc
from dataclasses import replace

import h5py
import numpy as np
import pytest

from compress import archive_writer
from compress.archive import Archive, ArchiveWriter, Block, Chunk, FieldSpec, Settings
from compress.bounds import Bound, measure
from compress.compare import compare_archives, compare_with_chunks
from dem_mpi.errors import DataError, DemError, InputError, OutputError

from launch import ROOT
from moving_bodies import FIELDS, SETTINGS, chunk_of, falling_bodies

CHUNKS = 4


def write(path, chunks, fields=FIELDS, settings=SETTINGS, **options):
    with ArchiveWriter(path, fields, settings=settings, **options) as writer:
        for chunk in chunks:
            writer.append(chunk)
    return path


@pytest.fixture(scope="module")
def chunks():
    return [chunk_of(number) for number in range(CHUNKS)]


@pytest.fixture(scope="module")
def archive_path(tmp_path_factory, chunks):
    return write(tmp_path_factory.mktemp("archive") / "a.tta", chunks, provenance={"seed": 7})


def joined(chunks, name):
    """The field of chunks of one block, (T, n, w)."""
    return np.concatenate([chunk.blocks[0].fields[name] for chunk in chunks])


def test_restored_fields_keep_to_their_bounds_and_errors_are_those_measured(archive_path, chunks):
    with Archive(archive_path) as archive:
        restored = archive.read()
        for name, spec in FIELDS.items():
            errors = measure(joined(chunks, name), restored.fields[name])
            said = archive.errors(name)
            assert said.frobenius == pytest.approx(errors.frobenius, rel=1e-12)
            assert said.norm == pytest.approx(errors.norm, rel=1e-12)
            assert (said.maximum, said.least, said.most) == (
                errors.maximum,
                errors.least,
                errors.most,
            )
            assert said.count == errors.count
            if spec.bound.kind == "relative":
                assert all(
                    archive.errors(name, k).relative <= spec.bound.value for k in range(CHUNKS)
                )
            elif spec.bound.kind == "pointwise":
                assert said.maximum <= spec.bound.value
            else:
                assert said.maximum == 0.0
        assert compare_with_chunks(archive, chunks)["velocity"].maximum == pytest.approx(
            archive.errors("velocity").maximum
        )


def test_steps_times_bodies_and_provenance_are_kept(archive_path, chunks):
    with Archive(archive_path) as archive:
        assert archive.complete
        assert archive.provenance == {"seed": 7}
        assert archive.fields == FIELDS
        assert archive.settings == SETTINGS
        assert np.array_equal(archive.steps, np.concatenate([c.steps for c in chunks]))
        assert np.array_equal(archive.times, np.concatenate([c.times for c in chunks]))
        assert np.array_equal(archive.gid, chunks[0].blocks[0].gid)
        assert archive.read().present.all()


@pytest.mark.parametrize(
    ("steps", "bodies"),
    [
        (slice(0, 64), slice(0, 40)),
        (slice(5, 50, 7), slice(3, 9)),
        (slice(17, 18), np.array([1, 30, 39])),
        (slice(-5, None), None),
        (slice(40, 10, -3), slice(None, None, 5)),
        (slice(9, 9), slice(0, 3)),
        (slice(3, 30), slice(100, 200)),
    ],
)
def test_restored_slices_are_slices_of_restored(archive_path, steps, bodies):
    with Archive(archive_path) as archive:
        whole = archive.read()
        part = archive.read(steps=steps, bodies=bodies)
        kept = part.gid
        assert np.array_equal(part.steps, whole.steps[steps])
        if isinstance(bodies, slice):
            assert np.array_equal(
                kept,
                np.arange(200)[bodies][np.arange(200)[bodies] < 40][
                    : len(kept) if len(part.steps) else 0
                ],
            )
        for name in FIELDS:
            assert np.array_equal(part.fields[name], whole.fields[name][steps][:, kept])


def test_only_what_is_asked_for_is_decoded(archive_path):
    with Archive(archive_path) as archive:
        archive.read(["velocity"], slice(20, 30), slice(0, 5))
        assert archive.decoded_pieces == 1
        archive.read(["velocity", "contacts"], slice(30, 34), slice(0, 5))
        assert archive.decoded_pieces == 1 + 2 * 2
        archive.read(["velocity"], slice(0, 0))
        archive.read(["velocity"], slice(0, 5), slice(1000, 2000))
        assert archive.decoded_pieces == 5


def test_only_blocks_that_hold_the_bodies_are_decoded(tmp_path):
    path = write(tmp_path / "a.tta", [chunk_of(0, ranks=4)])
    with Archive(path) as archive:
        archive.read(["velocity"], bodies=np.array([1, 5, 9]))  # all on the second of four ranks
        assert archive.decoded_pieces == 1


def test_positions_are_guided_by_decoded_velocities(archive_path):
    with Archive(archive_path) as archive:
        assert "guided" in archive.bytes_by_coder("position")
        number = next(k for k in range(CHUNKS) if "guided" in archive.bytes_by_coder("position", k))
        frames = archive.chunks[number]
        alone = archive.read(["position"], frames).fields["position"]
        # The velocity of the chunk is decoded besides.
        assert archive.decoded_pieces == 2
        both = archive.read(["velocity", "position"], frames)
        assert archive.decoded_pieces == 4
        assert np.array_equal(both.fields["position"], alone)
    without = {**FIELDS, "position": replace(FIELDS["position"], guide=None)}
    other = write(archive_path.with_name("unguided.tta"), map(chunk_of, range(CHUNKS)), without)
    with Archive(archive_path) as guided, Archive(other) as unguided:
        sizes = [sum(a.bytes_by_coder("position").values()) for a in (guided, unguided)]
    # Keyframes, 3 x 40 numbers a chunk within 1 m to 10^-5 m, are in both.
    keyframes = CHUNKS * 3 * 40 * np.log2(1.0 / 2e-5) / 8
    assert sizes[0] - keyframes < 0.8 * (sizes[1] - keyframes)


@pytest.mark.parametrize("ranks", [2, 3, 8])
def test_blocks_of_ranks_hold_the_bounds_of_the_whole(tmp_path, chunks, ranks):
    path = write(tmp_path / "a.tta", [chunk_of(k, ranks=ranks) for k in range(CHUNKS)])
    with Archive(path) as archive:
        restored = archive.read()
        for k, frames in enumerate(archive.chunks):
            velocity = chunks[k].blocks[0].fields["velocity"]
            errors = measure(velocity, restored.fields["velocity"][frames])
            # Shares of blocks add up to the whole but for their rounding.
            assert errors.relative <= 1e-2 * (1.0 + 1e-14)
        assert np.array_equal(restored.gid, np.arange(40))
        assert np.array_equal(restored.fields["contacts"], joined(chunks, "contacts"))


def test_bodies_present_in_part_of_a_chunk_come_back_so(tmp_path):
    _, velocity, times = falling_bodies(bodies=6, steps=8)
    first = np.array([0, 3, 0, 7, 0, 2])
    stop = np.array([8, 8, 5, 8, 0, 4])
    there = (np.arange(8)[:, None] >= first) & (np.arange(8)[:, None] < stop)
    fields = {"velocity": FIELDS["velocity"], "count": FieldSpec(Bound("exact"), "i8")}
    values = np.where(there[:, :, None], velocity + 1.0, np.nan)
    count = np.arange(48).reshape(8, 6, 1)
    block = Block(np.array([2, 3, 5, 7, 11, 13]), {"velocity": values, "count": count}, first, stop)
    path = write(tmp_path / "a.tta", [Chunk(np.arange(8), times, (block,))], fields)
    with Archive(path) as archive:
        restored = archive.read()
        assert np.array_equal(restored.present, there)
        assert np.isnan(restored.fields["velocity"][~there]).all()
        assert np.array_equal(restored.fields["count"][there], count[there])
        errors = measure(values[there], restored.fields["velocity"][there])
        assert errors.relative <= 1e-2
        assert archive.errors("velocity").count == 3 * there.sum()
        part = archive.read(["count"], slice(2, 6), np.array([3, 13]))
        assert np.array_equal(part.present, there[2:6, [1, 5]])


def test_bodies_that_move_between_ranks_stay_one_row(tmp_path):
    a, b = chunk_of(0, ranks=2), chunk_of(1, ranks=2)
    swapped = Chunk(b.steps, b.times, b.blocks[::-1])
    with Archive(write(tmp_path / "a.tta", [a, swapped])) as archive:
        restored = archive.read(["contacts"])
    expected = np.concatenate([chunk_of(k).blocks[0].fields["contacts"] for k in (0, 1)])
    assert np.array_equal(restored.fields["contacts"], expected)


def test_bodies_of_more_chunks_than_tables_are_kept_decoded_for_are_all_there(tmp_path):
    fields = {"x": FieldSpec(Bound("exact"))}
    count = 200
    values = np.random.default_rng(2).random((count, 1, 3, 1))
    chunks = [
        Chunk(np.array([k]), np.array([1.0 * k]), (Block(3 * k + np.arange(3), {"x": values[k]}),))
        for k in range(count)
    ]
    with Archive(write(tmp_path / "a.tta", chunks, fields)) as archive:
        assert np.array_equal(archive.gid, np.arange(3 * count))
        restored = archive.read()
    assert np.array_equal(restored.gid, np.arange(3 * count))
    assert np.array_equal(restored.present, np.kron(np.eye(count), np.ones(3)) == 1.0)
    assert np.array_equal(restored.fields["x"][restored.present], values.reshape(-1, 1))


def test_chunks_that_hardly_change_cost_a_hundred_bytes(tmp_path):
    fields = {"velocity": FIELDS["velocity"]}
    still = np.full((32, 1000, 3), 0.25)
    parts = [
        Chunk(
            np.arange(32 * k, 32 * k + 32),
            SETTINGS.step_size * np.arange(32 * k, 32 * k + 32),
            (Block(np.arange(1000), {"velocity": still}),),
        )
        for k in range(5)
    ]
    path = write(tmp_path / "a.tta", parts, fields)
    with Archive(path) as archive:
        # Coded values are 24 bytes of it.
        assert all(archive.chunk_bytes(k) - 24 <= 90 for k in range(1, 5))
        # Whatever is not in a chunk is written once for the file.
        assert os.path.getsize(path) <= sum(map(archive.chunk_bytes, range(5))) + 4096


def test_empty_archives_and_blocks_are_archives(tmp_path):
    with Archive(write(tmp_path / "none.tta", [])) as archive:
        assert archive.complete
        assert archive.read().fields["velocity"].shape == (0, 0, 3)
    nobody = Block(np.zeros(0, int), {"velocity": np.zeros((2, 0, 3))})
    chunk = Chunk(np.arange(2), np.arange(2.0), (nobody,))
    with Archive(write(tmp_path / "a.tta", [chunk], {"velocity": FIELDS["velocity"]})) as archive:
        assert archive.read().fields["velocity"].shape == (2, 0, 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused_with_their_place(tmp_path, bad):
    chunk = chunk_of(2)  # steps 32 to 47
    chunk.blocks[0].fields["velocity"][3, 5, 1] = bad
    message = (
        rf"^velocity: {bad} at step 35, body 5, component 1: only an exact bound keeps it: "
        r"--field velocity=exact \(in a scene, velocity: exact\)$"
    )
    with (
        pytest.raises(InputError, match=message),
        ArchiveWriter(tmp_path / "a.tta", FIELDS) as writer,
    ):
        writer.append(chunk)


def test_values_that_are_not_finite_are_kept_exactly(tmp_path):
    values = np.array([np.nan, -0.0, np.inf, 5e-324]).reshape(2, 2, 1)
    chunk = Chunk(np.arange(2), np.arange(2.0), (Block(np.arange(2), {"x": values}),))
    path = write(tmp_path / "a.tta", [chunk], {"x": FieldSpec(Bound("exact"))})
    with Archive(path) as archive:
        assert archive.read().fields["x"].tobytes() == values.tobytes()


def test_floor_lets_small_chunks_have_larger_errors(tmp_path):
    loud, quiet = chunk_of(2), chunk_of(3)
    quiet.blocks[0].fields["velocity"][:] *= 1e-6
    fields = {"velocity": FIELDS["velocity"]}
    sizes = []
    for floor in (0.0, 1.0):
        path = write(
            tmp_path / f"{floor}.tta", [loud, quiet], fields, replace(SETTINGS, floor=floor)
        )
        with Archive(path) as archive:
            sizes.append(archive.chunk_bytes(1))
            rms = np.hypot(*(archive.errors("velocity", k).norm for k in (0, 1)))
            allowed = 1e-2 * (rms / np.sqrt(2.0) if floor else archive.errors("velocity", 1).norm)
            assert archive.errors("velocity", 1).frobenius <= allowed
    assert sizes[1] < 0.5 * sizes[0]


def test_archives_of_the_same_chunks_are_the_same_bytes(tmp_path, archive_path, chunks):
    again = write(tmp_path / "b.tta", chunks, provenance={"seed": 7})
    assert again.read_bytes() == archive_path.read_bytes()


# ---- interrupted ---------------------------------------------------------------------------


def test_a_copy_made_between_appends_reads_and_goes_on(tmp_path, archive_path, chunks):
    path = tmp_path / "a.tta"
    writer = ArchiveWriter(path, FIELDS, settings=SETTINGS, provenance={"seed": 7})
    for count in range(CHUNKS + 1):
        copy = tmp_path / f"copy{count}.tta"
        shutil.copy(path, copy)
        with Archive(copy) as archive:
            assert not archive.complete
            assert len(archive.chunks) == count
            archive.verify()
        with ArchiveWriter.resume(copy) as resumed:
            for chunk in chunks[count:]:
                resumed.append(chunk)
        assert copy.read_bytes() == archive_path.read_bytes()
        if count < CHUNKS:
            writer.append(chunks[count])
    writer.close()


@pytest.mark.parametrize("every", [1, 3])
def test_resuming_a_cut_archive_makes_the_same_bytes(tmp_path, chunks, every):
    settings = replace(SETTINGS, trial_every=every, floor=0.5)
    path = write(tmp_path / "a.tta", chunks, settings=settings)
    whole = path.read_bytes()
    for kept in range(CHUNKS):
        last = int(chunks[kept].steps[0]) + 3  # in the middle of a chunk, which is dropped
        with ArchiveWriter.resume(path, last_step=last) as writer:
            assert writer.last_step == (int(chunks[kept].steps[0]) - 1 if kept else None)
            for chunk in chunks[kept:]:
                writer.append(chunk)
        assert path.read_bytes() == whole


WRITE_UNTIL_KILLED = """
import itertools, sys
from dataclasses import replace
sys.path.insert(0, sys.argv[2])
from compress.archive import ArchiveWriter
from moving_bodies import FIELDS, SETTINGS, chunk_of
writer = ArchiveWriter(sys.argv[1], FIELDS, settings=SETTINGS, provenance={"seed": 7})
chunks = [chunk_of(number) for number in range(4)]
print("begin", flush=True)
for number in itertools.count():
    chunk = chunks[number % 4]
    writer.append(replace(chunk, steps=chunk.steps + 10**6 * (number // 4)))
"""


def test_a_killed_writer_leaves_whole_chunks(tmp_path, chunks):
    """Chunks come again, at later steps, so that the file also grows; kill -9 at five times."""
    for attempt in range(5):
        path = tmp_path / f"a{attempt}.tta"
        command = [sys.executable, "-c", WRITE_UNTIL_KILLED, path, ROOT / "tests/support"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
            assert process.stdout.readline() == b"begin\n"
            while process.poll() is None:
                with Archive(path) as archive:
                    if len(archive.chunks) > 2 * attempt:
                        break
            process.send_signal(signal.SIGKILL)
        with Archive(path) as archive:
            archive.verify()
            count = len(archive.chunks)
            assert count > 2 * attempt
            assert archive.read(["velocity"], archive.chunks[-1]).present.all()
        with ArchiveWriter.resume(path) as writer:
            chunk = chunks[count % 4]
            writer.append(replace(chunk, steps=chunk.steps + 10**6 * (count // 4)))
        with Archive(path) as archive:
            archive.verify()
            assert archive.complete
            assert len(archive.chunks) == count + 1


def test_files_grow_beyond_their_first_size(tmp_path):
    noise = np.random.default_rng(1).standard_normal((64, 500, 3))
    fields = {"x": FieldSpec(Bound("exact"), width=3)}
    path = tmp_path / "a.tta"
    with ArchiveWriter(path, fields) as writer:
        for k in range(4):  # 768 kB each, which no coder makes smaller by much
            steps = np.arange(64 * k, 64 * k + 64)
            writer.append(Chunk(steps, steps * 1.0, (Block(np.arange(500), {"x": noise + k}),)))
    with Archive(path) as archive:
        assert np.array_equal(
            archive.read().fields["x"], np.concatenate([noise + k for k in range(4)])
        )
    assert not list(tmp_path.glob("*.part"))


def test_memory_of_a_writer_does_not_grow_with_the_archive(tmp_path):
    still = np.full((4, 50, 1), 0.25)
    fields = {"x": FieldSpec(Bound("exact"))}
    held = []
    with ArchiveWriter(tmp_path / "a.tta", fields) as writer:
        tracemalloc.start()
        for k in range(600):
            steps = np.arange(4 * k, 4 * k + 4)
            writer.append(Chunk(steps, steps * 1.0, (Block(np.arange(50), {"x": still}),)))
            if k in (99, 599):
                gc.collect()
                held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    # Not even a number of 8 bytes more for each of 500 chunks.
    assert held[1] - held[0] < 4000


def test_a_chunk_appended_again_after_a_full_disk_is_read(
    tmp_path, archive_path, chunks, monkeypatch
):
    path = tmp_path / "a.tta"

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with ArchiveWriter(path, FIELDS, settings=SETTINGS, provenance={"seed": 7}) as writer:
        for chunk in chunks:
            with monkeypatch.context() as patched:
                patched.setattr(os, "pwrite", full)
                with pytest.raises(OutputError, match="No space left"):
                    writer.append(chunk)
            writer.append(chunk)
    assert path.read_bytes() == archive_path.read_bytes()


@pytest.mark.parametrize("steps", [[3, 4], [4, 4], [6, 5], [5, 5], [-2, -1]])
def test_steps_that_do_not_ascend_are_refused(tmp_path, steps):
    fields = {"x": FieldSpec(Bound("exact"))}

    def still(steps):
        block = Block(np.arange(2), {"x": np.zeros((len(steps), 2, 1))})
        return Chunk(np.array(steps, int), 1.0 * np.array(steps), (block,))

    path = tmp_path / "a.tta"
    with ArchiveWriter(path, fields) as writer:
        writer.append(still([3, 4]))
        with pytest.raises(InputError, match=r"a\.tta: steps .* do not ascend behind step 4"):
            writer.append(still(steps))
        writer.append(still([7, 9]))
    with Archive(path) as archive:
        assert archive.steps.tolist() == [3, 4, 7, 9]


@pytest.mark.parametrize(
    "numbers", [[[0, 1], [1, 2]], [[2, 3], [0, 1]], [[1, 0]], [[0, 1, 1]], [[2, 5, 4]]]
)
def test_archives_whose_steps_do_not_ascend_are_refused(tmp_path, monkeypatch, numbers):
    fields = {"x": FieldSpec(Bound("exact"))}
    path = tmp_path / "a.tta"
    monkeypatch.setattr(archive_writer, "ascend", lambda *_: True)
    writer = ArchiveWriter(path, fields)
    for steps in numbers:
        block = Block(np.arange(2), {"x": np.zeros((len(steps), 2, 1))})
        writer.append(Chunk(np.array(steps, int), 1.0 * np.array(steps), (block,)))
    writer.abandon()
    with pytest.raises(DataError, match=rf"a\.tta: damaged: chunk {len(numbers) - 1}: steps"):
        Archive(path)


def test_existing_files_and_second_writers_are_refused(tmp_path, chunks):
    path = write(tmp_path / "a.tta", chunks[:1])
    with pytest.raises(OutputError, match="exists already"):
        ArchiveWriter(path, FIELDS)
    writer = ArchiveWriter(path, FIELDS, force=True)
    with pytest.raises(OutputError, match="another run is writing it"):
        ArchiveWriter.resume(path)
    writer.abandon()


def test_an_exception_leaves_the_archive_as_if_interrupted(tmp_path, chunks):
    path = tmp_path / "a.tta"

    def write_and_fail():
        with ArchiveWriter(path, FIELDS) as writer:
            writer.append(chunks[0])
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_and_fail()
    with Archive(path) as archive:
        assert not archive.complete
        assert len(archive.chunks) == 1


# ---- damage --------------------------------------------------------------------------------


def read_all(path):
    with Archive(path) as archive:
        archive.verify()
        restored = archive.read()
        return [restored.steps, restored.times, restored.gid, restored.present] + [
            restored.fields[name] for name in archive.fields
        ]


def read_or_refuse(path):
    try:
        return read_all(path), ""
    except DataError as error:
        return None, str(error)


def test_a_flipped_byte_is_refused_or_changes_nothing(tmp_path, archive_path):
    """At 250 places drawn from the whole file, and at every place of what HDF5 keeps at its end."""
    good = archive_path.read_bytes()
    expected = read_all(archive_path)
    rng = np.random.default_rng(11)
    with h5py.File(archive_path) as file:
        used = [file[name].id.get_offset() for name in ("header", "index", "data")]
    places = set(rng.integers(0, len(good), 200).tolist()) | set(range(0, min(used), 41))
    refused = 0
    for place in sorted(places):
        bad = bytearray(good)
        bad[place] ^= int(rng.integers(1, 256))
        path = tmp_path / "bad.tta"
        path.write_bytes(bad)
        found, message = read_or_refuse(path)
        refused += found is None
        assert found is not None or (str(path) in message and "\n" not in message)
        for a, b in zip(expected, found or expected, strict=True):
            assert a.tobytes() == b.tobytes(), f"byte {place} changed values"
    # Header, index and data are used to the last byte.
    with h5py.File(archive_path) as file:
        sizes = [file[n].id.get_storage_size() for n in ("header", "index", "data")]
    inside = sum(
        any(start <= p < start + size for start, size in zip(used, sizes, strict=True))
        for p in places
    )
    assert refused >= inside > 100


def test_truncated_archives_are_refused(tmp_path, archive_path):
    good = archive_path.read_bytes()
    path = tmp_path / "bad.tta"
    for length in [0, 1, 100, len(good) // 2, len(good) - 1]:
        path.write_bytes(good[:length])
        with pytest.raises(DataError, match=r"bad\.tta"):
            Archive(path)


def change(path, name, value):
    with h5py.File(path, "r+") as file:
        del file[name]
        if value is not None:
            file[name] = value


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("index", None, "'index' is missing"),
        ("index", np.zeros((4, 3), "u8"), "3 columns"),
        ("index", np.zeros((4, 2), "u8"), "index|head"),
        ("index", np.full((4, 2), 2**63, "u8"), "points out of 'data'"),
        ("data", np.zeros(10, "u1"), "points out of 'data'"),
        ("data", np.zeros((4, 4)), "'data' is float64"),
        ("header", np.array(b"{}"), "checksum of 'header'"),
        ("header", h5py.SoftLink("/index"), "link"),
        ("data", h5py.ExternalLink("/etc/passwd", "/x"), "link"),
    ],
)
def test_foreign_parts_are_refused(tmp_path, archive_path, name, value, message):
    path = tmp_path / "bad.tta"
    shutil.copy(archive_path, path)
    change(path, name, value)
    with pytest.raises(DataError, match=message):
        Archive(path)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text").write_text("no archive")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    for name in ("text", "other.h5"):
        with pytest.raises(DataError, match=name):
            Archive(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        Archive(tmp_path / "none.tta")


def test_fields_that_there_are_not_are_refused(archive_path):
    with Archive(archive_path) as archive, pytest.raises(InputError, match="no field 'speed'"):
        archive.read(["speed"])


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"x": FieldSpec(Bound("exact"), dtype="c16")},
        {"x": FieldSpec(Bound("exact"), width=0)},
        {"x": FieldSpec(Bound("pointwise", 1.0), guide="y")},
        {"x": FieldSpec(Bound("pointwise", 1.0), dtype="f2")},
    ],
)
def test_fields_that_cannot_be_coded_are_refused(tmp_path, fields):
    with pytest.raises(DemError):
        ArchiveWriter(tmp_path / "a.tta", fields)
    assert not list(tmp_path.iterdir())


# ---- comparison ----------------------------------------------------------------------------


def test_an_archive_differs_from_a_finer_one_by_its_errors(tmp_path, chunks, archive_path):
    exact = {name: replace(spec, bound=Bound("exact"), guide=None) for name, spec in FIELDS.items()}
    reference = write(tmp_path / "exact.tta", chunks, exact, Settings())
    with Archive(reference) as a, Archive(archive_path) as b:
        errors = compare_archives(a, b)
        for name in FIELDS:
            assert errors[name].frobenius == pytest.approx(b.errors(name).frobenius, rel=1e-12)
