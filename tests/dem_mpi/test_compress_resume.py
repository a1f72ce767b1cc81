"""`dem-mpi compress --resume`: only the same values in the same way go on with an archive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from compress.archive import Archive
from dem_mpi.array_source import ArraySource
from dem_mpi.compress_command import TrajectorySource, compress_file
from dem_mpi.compress_options import CompressOptions
from dem_mpi.errors import InputError, StoppedError
from dem_mpi.signals import StopRequest

from runs import PILE, StopAfter, simulate

SCENE = PILE.replace("interval: 6e-3", "interval: 2e-3").replace("end: 0.08", "end: 0.04")


def part_of(parallel, source, out, **options) -> CompressOptions:
    """Compress a chunk of a source, as if stopped then; what goes on with it."""
    asked = CompressOptions(str(source), out, chunk=4, **options)
    with pytest.raises(StoppedError):
        compress_file(parallel, asked, StopAfter(2), lambda line: None)
    return replace(asked, resume=True)


def go_on(parallel, options: CompressOptions) -> None:
    compress_file(parallel, options, StopRequest(), lambda line: None)


@pytest.fixture
def array(tmp_path):
    """An array file of 20 steps, 30 bodies."""
    path = tmp_path / "x.npy"
    np.save(path, np.random.default_rng(0).standard_normal((20, 30, 3)))
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"floor": 0.5}, r"--floor 0\.5: .*begun with --floor 0; --force instead of --resume"),
        ({"chunk": 8}, r"--chunk 8: .*begun with --chunk 4; --force instead of --resume"),
    ],
)
def test_other_settings_are_refused(parallel, array, tmp_path, change, words):
    options = part_of(parallel, array, tmp_path / "x.tt.h5")
    before = options.path.read_bytes()
    with pytest.raises(InputError, match=words):
        go_on(parallel, replace(options, **change))
    assert options.path.read_bytes() == before
    go_on(parallel, options)
    with Archive(options.path) as archive:
        assert archive.complete and len(archive.steps) == 20


def test_another_source_is_refused(parallel, array, tmp_path):
    options = part_of(parallel, array, tmp_path / "x.tt.h5")
    other = tmp_path / "elsewhere" / "x.npy"
    other.parent.mkdir()
    np.save(other, np.load(array))
    asked = replace(options, source=str(other))
    with pytest.raises(InputError, match=r"--resume: .*another source .*elsewhere.*--force"):
        go_on(parallel, asked)
    changed = np.load(array)
    changed[-1] += 1.0
    np.save(array, changed)
    with pytest.raises(InputError, match=r"--resume: .*another source, or one that has changed"):
        go_on(parallel, options)


def test_the_archive_that_a_run_wrote_is_not_gone_on_with(parallel, tmp_path):
    """Both have the same name unless another is asked for."""
    section = "compress: {fields: {velocity: 1e-2}, chunk: 4}\n"
    simulate(parallel, SCENE + section, tmp_path, steps=10)
    bounds = {"velocity": ("relative", 1e-2)}
    asked = CompressOptions(str(tmp_path / "run.h5"), bounds=bounds, chunk=4, resume=True)
    assert asked.path == tmp_path / "run.tt.h5"
    with pytest.raises(InputError, match=r"--resume: .*another source"):
        go_on(parallel, asked)


def test_a_trajectory_of_another_seed_is_refused_and_one_that_grew_is_not(parallel, tmp_path):
    simulate(parallel, SCENE, tmp_path, steps=10)
    options = part_of(parallel, tmp_path / "run.h5", tmp_path / "a.tt.h5")
    simulate(parallel, SCENE, tmp_path, resume=True)
    go_on(parallel, options)
    with Archive(options.path) as archive:
        assert archive.steps.tolist() == list(range(21))
    options = part_of(parallel, tmp_path / "run.h5", tmp_path / "b.tt.h5")
    simulate(parallel, SCENE, tmp_path, "seed=5", force=True)
    with pytest.raises(InputError, match=r"--resume: .*another source, or one that has changed"):
        go_on(parallel, options)


@pytest.mark.parametrize("kind", ["array", "trajectory"])
def test_several_blocks_are_the_parts_of_what_is_read_once(
    parallel, array, tmp_path, kind, monkeypatch
):
    if kind == "trajectory":
        simulate(parallel, SCENE, tmp_path)
        source = TrajectorySource(CompressOptions(str(tmp_path / "run.h5")))
        place = source._file
    else:
        source = ArraySource(CompressOptions(str(array)))
        place = None
    calls = []
    if place is not None:
        read = place.read
        monkeypatch.setattr(place, "read", lambda *a, **k: calls.append(a) or read(*a, **k))
    with source:
        frames = range(2, 7)
        (whole,) = source.read_blocks(frames, source.blocks(1), [])
        calls.clear()
        parts = source.read_blocks(frames, source.blocks(3), list(frames))
    assert len(parts) == 3 and all(len(part.gid) for part in parts)
    assert len(calls) == (kind == "trajectory")
    assert np.array_equal(np.concatenate([part.gid for part in parts]), whole.gid)
    for name, values in whole.fields.items():
        joined = np.concatenate([part.fields[name] for part in parts], axis=1)
        assert np.array_equal(joined, values)
