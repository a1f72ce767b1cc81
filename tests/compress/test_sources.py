"""Arrays of any origin: chunks of steps, and archives of them."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from compress.archive import Archive, ArchiveWriter
from compress.bounds import Bound
from compress.compare import compare_arrays, compare_with_chunks
from compress.sources import open_array
from dem_mpi.errors import DataError, InputError

SHAPES = [(10,), (10, 7), (10, 7, 3), (10, 4, 5, 6), (10, 3, 20), (10, 2, 3, 2, 2)]


def saved(tmp_path, array, kind):
    """The array in a file of a kind, and its name as a source."""
    if kind == "npy":
        np.save(tmp_path / "field.npy", array)
        return str(tmp_path / "field.npy")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.create_dataset("group/field", data=array, chunks=True, compression="gzip")
    return f"{tmp_path / 'run.h5'}:/group/field"


@pytest.mark.parametrize("kind", ["npy", "h5"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", ["f4", "f8", ">f8", "i2"])
def test_arrays_of_any_order_come_back_in_their_shape(tmp_path, kind, shape, dtype):
    array = (100.0 * np.random.default_rng(1).standard_normal(shape)).astype(dtype)
    source = open_array(saved(tmp_path, array, kind))
    assert (source.steps, source.step_shape, source.name) == (10, shape[1:], "field")
    path = tmp_path / "a.tta"
    bound = Bound("relative", 1e-3)
    with ArchiveWriter(path, {source.name: source.field(bound)}) as writer:
        for chunk in source.chunks(4):
            writer.append(chunk)
    with Archive(path) as archive:
        restored = archive.array("field")
        assert restored.shape == shape
        assert restored.dtype == array.dtype.newbyteorder("=")
        assert compare_arrays(array, restored).relative <= (1e-3 if "f" in dtype else 0.0)
        assert np.array_equal(archive.array("field", slice(3, 6)), restored[3:6])
        assert compare_with_chunks(archive, source.chunks(4))["field"].relative <= 1e-3
    source.close()


@pytest.mark.parametrize("kind", ["npy", "h5"])
@pytest.mark.parametrize("axis", [1, 2, -1])
def test_time_along_any_axis(tmp_path, kind, axis):
    array = np.random.default_rng(2).standard_normal((6, 9, 4))
    source = open_array(saved(tmp_path, array, kind), axis)
    expected = np.moveaxis(array, axis, 0)
    assert source.steps == len(expected)
    found = np.concatenate([chunk.blocks[0].fields["field"] for chunk in source.chunks(3)])
    assert np.array_equal(found.reshape(expected.shape), expected)
    source.close()


def test_components_are_a_short_last_dimension(tmp_path):
    for shape, rows in [
        ((5,), (1, 1)),
        ((5, 7), (7, 1)),
        ((5, 7, 3), (7, 3)),
        ((5, 3, 40), (120, 1)),
    ]:
        assert open_array(saved(tmp_path, np.zeros(shape), "npy")).rows == rows


def test_chunks_go_on_from_any_step(tmp_path):
    source = open_array(saved(tmp_path, np.arange(10.0), "npy"))
    chunks = list(source.chunks(4, first=4))
    assert [chunk.steps.tolist() for chunk in chunks] == [[4, 5, 6, 7], [8, 9]]
    assert chunks[1].blocks[0].fields["field"].ravel().tolist() == [8.0, 9.0]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.npy", "no such file"),
        ("none.h5:/x", "no such file"),
        ("run.txt", "neither a .npy file nor"),
        ("run.h5", "run.h5:/path; it has /group/field"),
        ("run.h5:", "run.h5:/path; it has /group/field"),
        ("run.h5:/none", "no data set '/none'; it has /group/field"),
        ("run.h5:/group", "no data set '/group'; it has /group/field"),
        ("scalar.nc:/x", r"scalar.nc:/x: shape \(\) has no axis 0"),
        ("scalar.nc:/text", r"scalar.nc:/text: \|S1 is no plain number"),
        ("complex.npy", "no plain number"),
        ("scalar.npy", "no axis 0"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path, name, message):
    saved(tmp_path, np.zeros(3), "h5")
    with h5py.File(tmp_path / "scalar.nc", "w") as file:
        file["x"], file["text"] = 1.0, np.array([b"a", b"b"])
    np.save(tmp_path / "complex.npy", np.zeros(3, complex))
    np.save(tmp_path / "scalar.npy", np.float64(1.0))
    with pytest.raises(InputError, match=message):
        open_array(str(tmp_path / name))


def test_objects_and_broken_files_are_refused(tmp_path):
    np.save(tmp_path / "objects.npy", np.array([{}, None], dtype=object))
    np.save(tmp_path / "cut.npy", np.zeros(1000))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "cut.npy").read_bytes()[:2000])
    (tmp_path / "text.npy").write_text("nothing")
    np.savez(tmp_path / "many.npz", a=np.zeros(3))
    (tmp_path / "many.npz").rename(tmp_path / "many.npy")
    for name in ("objects", "cut", "text", "many"):
        with pytest.raises(DataError, match=name):
            open_array(str(tmp_path / f"{name}.npy"))


def test_arrays_of_different_shape_are_not_compared():
    with pytest.raises(InputError, match="cannot be compared"):
        compare_arrays(np.zeros((2, 3)), np.zeros((3, 2)))


@pytest.mark.parametrize(
    ("x", "y", "maximum"),
    [
        (np.array([2**60]), np.array([2**60 + 1]), 1.0),
        (np.array([-(2**63)]), np.array([2**63 - 1]), 2.0**64),
        (np.array([2**63], np.uint64), np.array([2**63 + 1], np.uint64), 1.0),
        (np.array([2**63], np.uint64), np.array([2**63 - 1]), 1.0),
        (np.array([2**64 - 1], np.uint64), np.array([-(2**63)]), 2.0**64 + 2.0**63),
        (np.array([-128], np.int8), np.array([127], np.int8), 255.0),
        (np.array([True, False]), np.array([True, True]), 1.0),
        (np.array([-1, 7]), np.array([-1, 7]), 0.0),
    ],
)
def test_whole_numbers_are_subtracted_exactly(x, y, maximum):
    found = compare_arrays(x, y)
    assert found.maximum == found.frobenius == maximum
    assert found.equal == (maximum == 0.0)


def test_numbers_that_are_not_finite_equal_themselves_only():
    x = np.array([np.nan, np.inf, -np.inf, 1.0, np.nan, np.inf])
    y = np.array([np.nan, np.inf, -np.inf, 1.5, 2.0, -np.inf])
    found = compare_arrays(x, y)
    assert (found.count, found.unlike, found.maximum) == (4, 2, 0.5)
    twice = found + found
    assert (twice.count, twice.unlike, twice.maximum) == (8, 4, 0.5)
    assert compare_arrays(x, x).equal and not found.equal
