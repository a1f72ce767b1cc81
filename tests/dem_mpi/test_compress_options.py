"""What compression promises and refuses in words: bounds, sizes, what to expect."""

from __future__ import annotations

import numpy as np
import pytest

from compress.archive import ArchiveWriter, Block, Chunk, FieldSpec
from compress.bounds import Bound
from dem_mpi.compress_command import compress_file
from dem_mpi.compress_options import CompressOptions, parse_bounds
from dem_mpi.compression import ArchiveFacts
from dem_mpi.errors import InputError
from dem_mpi.signals import StopRequest

from runs import PILE, simulate


@pytest.mark.parametrize("value", [1.0, 3.0])
def test_a_relative_error_that_zeros_keep_to_is_refused(value):
    with pytest.raises(InputError, match=f"--tol {value:g}: must be < 1"):
        CompressOptions("run.h5", tolerance=value)
    for text in (f"velocity={value}", f"velocity=relative:{value}"):
        with pytest.raises(InputError, match=f"--field {text}: must be < 1"):
            parse_bounds([text])
    assert parse_bounds([f"velocity=pointwise:{value}"]) == {"velocity": ("pointwise", value)}


@pytest.mark.parametrize(("bodies", "words"), [(1, "times larger"), (40_000, "times smaller")])
def test_an_archive_larger_than_its_values_is_called_larger(tmp_path, bodies, words):
    path = tmp_path / "a.tt.h5"
    with ArchiveWriter(path, {"x": FieldSpec(Bound("exact"))}) as writer:
        block = Block(np.arange(bodies), {"x": np.zeros((2, bodies, 1))})
        writer.append(Chunk(np.arange(2), np.arange(2.0), (block,)))
    facts = ArchiveFacts.of(path)
    factor = max(facts.coded, facts.raw) / min(facts.coded, facts.raw)
    assert f"{factor:.3g} {words}" in facts.lines()[0]


def test_what_to_expect_counts_the_order_of_bodies_in_space(parallel, tmp_path, monkeypatch):
    """As the coders do, where positions are archived too."""
    simulate(parallel, PILE, tmp_path)
    known = []
    import compress.explain as module

    explain = module.explain
    monkeypatch.setattr(
        module, "explain", lambda *a, **k: known.append(k["positions"]) or explain(*a, **k)
    )
    for fields in (None, {"velocity": ("relative", 1e-2)}):
        options = CompressOptions(str(tmp_path / "run.h5"), bounds=fields, explain=True)
        said: list[str] = []
        compress_file(parallel, options, StopRequest(), said.append)
        assert any("velocity (relative 0.01)" in line for line in said)
    assert known == ["position", None]
