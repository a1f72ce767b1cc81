"""The choice of coders, what it remembers, and the coder that loses nothing."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from compress import coders, raw
from compress.archive import ArchiveWriter
from compress.bounds import Bound, Target, measure, norm
from compress.coding import Block, Encoder, FieldSpec, Memory, Scale, Settings, Winner, held
from dem_mpi.errors import InputError

from moving_bodies import FIELDS, SETTINGS, chunk_of, falling_bodies

TIMES = np.arange(16) * 1e-3


def smooth(seed: int = 0, bodies: int = 300) -> np.ndarray:
    """A few modes in time, (16, n, 3), and a little noise."""
    rng = np.random.default_rng(seed)
    modes = np.stack([np.cos(k * np.linspace(0.0, 1.0, 16)) for k in range(3)], axis=1)
    values = np.einsum("tk,kiw->tiw", modes, rng.standard_normal((3, bodies, 3)))
    return values + 1e-4 * rng.standard_normal(values.shape)


def encoder_of(bound: Bound, dtype: str = "f8", **options) -> Encoder:
    return Encoder({"x": FieldSpec(bound, dtype, 3)}, Settings(**options))


def encode(encoder: Encoder, values: np.ndarray, scales=None):
    return encoder.encode(Block(np.arange(values.shape[1]), {"x": values}), TIMES, scales)


def decode(part, values):
    return coders.decode(part.coder, part.data, values.dtype, values.shape)


@given(
    arrays.arrays(
        st.sampled_from(["f4", "f8", "i8", "u2", "?", ">f8", "f2"]),
        st.tuples(st.integers(0, 5), st.integers(0, 4), st.integers(1, 3)),
    )
)
@settings(max_examples=100, deadline=None)
def test_exact_coder_keeps_every_bit(values):
    data = raw.encode(values)
    decoded = raw.decode(data, values.dtype.newbyteorder("="), values.shape)
    assert decoded.tobytes() == values.astype(values.dtype.newbyteorder("=")).tobytes()
    assert len(data) <= values.nbytes + 2


def test_exact_coder_finds_what_repeats_in_time():
    rng = np.random.default_rng(1)
    counts = np.repeat(rng.integers(0, 2**40, (1, 500, 1)), 32, axis=0)
    assert len(raw.encode(counts)) < 1.1 * counts[0].nbytes
    assert len(raw.encode(np.zeros((32, 4000, 3)))) < 1000


@pytest.mark.parametrize("cut", [0, 1, 5, -1])
def test_exact_coder_refuses_bytes_it_did_not_write(cut):
    data = raw.encode(np.arange(3000.0))
    with pytest.raises(ValueError):
        raw.decode(data[:cut], "f8", (3000,))
    with pytest.raises(ValueError):
        raw.decode(data, "f8", (2999,))


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize(
    "bound", [Bound("relative", 1e-2), Bound("rmse", 1e-2), Bound("pointwise", 1e-2)]
)
def test_errors_are_those_of_what_the_decoder_gives(bound, dtype):
    values = smooth().astype(dtype)
    part = encode(encoder_of(bound, dtype), values).fields["x"]
    decoded = decode(part, values)
    assert decoded.dtype == values.dtype
    assert part.errors == measure(values, decoded)
    assert bound.target(values).met_by(part.errors)
    assert len(part.data) < values.nbytes / 8


@pytest.mark.parametrize("name", ["tt", "predictive", "qtt"])
def test_coders_decode_slices_to_the_bits_of_the_whole(name):
    values = smooth(bodies=64)
    data = coders.encode(name, values, Target(frobenius=1e-2 * norm(values)))
    whole = coders.decode(name, data, values.dtype, values.shape)
    rows = np.array([3, 17, 60])
    part = coders.decode(name, data, values.dtype, values.shape, None, slice(4, 9), rows)
    assert np.array_equal(part, whole[4:9][:, rows])


def test_tensor_trains_win_where_bodies_move_in_few_modes_and_paths_where_they_rest():
    few_modes = smooth(bodies=2000)
    assert encode(encoder_of(Bound("relative", 1e-2)), few_modes).fields["x"].coder == "tt"
    rng = np.random.default_rng(2)
    resting = np.repeat(rng.standard_normal((1, 2000, 3)), 16, axis=0)
    kicks = rng.random((16, 2000, 1)) < 0.02
    resting = resting + np.cumsum(kicks * rng.standard_normal((16, 2000, 3)), axis=0)
    assert encode(encoder_of(Bound("relative", 1e-2)), resting).fields["x"].coder == "predictive"


def test_noise_to_all_digits_is_kept_as_it_is():
    noise = np.random.default_rng(3).standard_normal((16, 200, 3))
    part = encode(encoder_of(Bound("relative", 1e-17)), noise).fields["x"]
    assert part.coder == "exact"
    assert part.errors.maximum == 0.0
    assert len(part.data) <= noise.nbytes + 2


def test_integers_are_exact_whatever_the_bound():
    values = np.random.default_rng(4).integers(-5, 5, (16, 50, 3)).astype("i4")
    part = encode(encoder_of(Bound("relative", 0.5), "i4"), values).fields["x"]
    assert part.errors.maximum == 0.0


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e300])
def test_bounds_hold_at_any_scale(scale):
    values = smooth() * (scale / 10.0)
    part = encode(encoder_of(Bound("relative", 1e-2)), values).fields["x"]
    assert measure(values, decode(part, values)).relative <= 1e-2


def test_relative_bounds_are_refused_where_the_norm_overflows():
    values = np.where(smooth(bodies=8) < 0.0, -1.79e308, 1.79e308)
    with pytest.raises(InputError, match=r"^x: .* norm, .* overflows: --field x=exact"):
        encode(encoder_of(Bound("relative", 1e-2)), values)
    # The norm of a part is finite, that of the chunk is not: no block has a share of it.
    encoder = encoder_of(Bound("relative", 1e-2))
    scales = encoder.scales(Block(np.arange(1), {"x": values[:1, :1] / 2.0}))
    with pytest.raises(InputError, match=r"^x: .* norm, .* overflows"):
        encode(encoder_of(Bound("relative", 1e-2)), smooth(), 8 * [scales])


@pytest.mark.parametrize("norms", [np.nan, np.inf])
def test_only_the_block_at_fault_is_refused(norms):
    """It can tell the place; the others lose nothing until it does."""
    values = smooth(bodies=8)
    scales = [{"x": Scale(norm(values), values.size)}, {"x": Scale(norms, values.size)}]
    part = encode(encoder_of(Bound("relative", 1e-2)), values, scales).fields["x"]
    assert decode(part, values).tobytes() == values.tobytes()


@pytest.mark.parametrize("kind", ["rmse", "pointwise"])
def test_absolute_bounds_hold_where_the_norm_overflows(kind):
    values = 1e307 * smooth()
    part = encode(encoder_of(Bound(kind, 1e305)), values).fields["x"]
    errors = measure(values / 1e307, decode(part, values) / 1e307)
    assert len(part.data) < values.nbytes / 4
    assert (errors.rmse if kind == "rmse" else errors.maximum) <= 1e-2 * (1.0 + 1e-12)


def test_constants_take_as_many_bytes_as_one_row():
    values = np.full((16, 1000, 3), 9.81)
    assert len(encode(encoder_of(Bound("exact")), values).fields["x"].data) == 24
    near = values + 1e-3 * np.random.default_rng(5).random(values.shape)
    assert len(encode(encoder_of(Bound("pointwise", 1e-3)), near).fields["x"].data) == 24


def test_positions_that_are_not_finite_give_no_order():
    values = smooth(bodies=64)
    position = values.copy()
    position[0, 5, 1] = np.nan
    fields = {
        "position": FieldSpec(Bound("exact"), width=3),
        "velocity": FieldSpec(Bound("relative", 1e-2), width=3),
    }
    block = Block(np.arange(64), {"position": position, "velocity": values})
    coded = Encoder(fields).encode(block, TIMES)
    assert decode(coded.fields["position"], position).tobytes() == position.tobytes()
    assert measure(values, decode(coded.fields["velocity"], values)).relative <= 1e-2


def test_values_that_are_not_finite_are_at_a_step_in_which_the_body_is_there():
    values = smooth(bodies=8)
    values[:6, 4] = np.nan
    block = Block(np.arange(8), {"x": values}, first=np.where(np.arange(8) == 4, 5, 0))
    encoder = encoder_of(Bound("relative", 1e-2))
    with pytest.raises(InputError, match="nan at step 105, body 4, component 0"):
        encoder.encode(block, TIMES, steps=100 + np.arange(16))
    with pytest.raises(InputError, match="nan at step 5 of the chunk, body 4, component 0"):
        encoder.encode(block, TIMES)


def test_blocks_share_the_error_of_a_chunk_by_their_entries():
    loud, quiet = smooth(1), 1e-3 * smooth(2, bodies=100)
    blocks = [Block(np.arange(v.shape[1]), {"x": v}) for v in (loud, quiet)]
    scales = [encoder_of(Bound("relative", 1e-2)).scales(b) for b in blocks]
    assert scales[0]["x"] == Scale(norm(loud), loud.size)
    coded = [
        encode(encoder_of(Bound("relative", 1e-2)), v, scales).fields["x"] for v in (loud, quiet)
    ]
    total = coded[0].errors + coded[1].errors
    assert total.relative <= 1e-2 * (1.0 + 1e-14)
    # The quiet block is all below the error that its share allows.
    assert len(coded[1].data) <= 24
    alone = encode(encoder_of(Bound("relative", 1e-2)), quiet).fields["x"]
    assert len(alone.data) > 10 * len(coded[1].data)


def counted(monkeypatch) -> list[str]:
    """Names of coders as they are asked."""
    asked: list[str] = []
    encode_by = coders.encode_and_decode

    def encode_and_count(name, *arguments):
        asked.append(name)
        return encode_by(name, *arguments)

    monkeypatch.setattr(coders, "encode_and_decode", encode_and_count)
    return asked


def test_between_trials_only_the_last_winner_is_asked(monkeypatch):
    asked = counted(monkeypatch)
    encoder = encoder_of(Bound("relative", 1e-2), trial_every=3)
    numbers = []
    for k in range(7):
        asked.clear()
        encode(encoder, smooth(k))
        numbers.append(len(asked))
    assert [n > 1 for n in numbers] == [True, False, False, True, False, False, True]


def test_bytes_that_jump_call_for_another_trial(monkeypatch):
    asked = counted(monkeypatch)
    encoder = encoder_of(Bound("relative", 1e-2), trial_every=1000)
    encode(encoder, smooth(0))
    asked.clear()
    rough = smooth(1) + np.cumsum(np.random.default_rng(6).standard_normal((16, 300, 3)), axis=0)
    encode(encoder, rough)
    assert len(asked) > 1
    assert encoder.memory.winners["x"].coder == "predictive"


def test_memory_of_an_archive_is_that_of_its_encoder(tmp_path):
    encoder = Encoder(FIELDS, SETTINGS)
    with ArchiveWriter(tmp_path / "a.tta", FIELDS, settings=SETTINGS) as writer:
        for number in range(3):
            chunk = chunk_of(number)
            encoder.encode(chunk.blocks[0], chunk.times)
            writer.append(chunk)
            assert writer.memory() == encoder.memory
    resumed = ArchiveWriter.resume(tmp_path / "a.tta")
    assert resumed.memory() == encoder.memory
    resumed.abandon()


def test_memory_adds_scales_of_chunks():
    memory = Memory().after({"x": Winner("tt", 0.5)}, {"x": Scale(3.0, 9)})
    memory = memory.after({"x": Winner("exact", 8.0)}, {"x": Scale(4.0, 16)})
    assert memory.total["x"] == Scale(5.0, 25)
    assert memory.total["x"].rms == 1.0
    assert memory.winners["x"].coder == "exact"
    assert memory.chunks == 2


def test_absent_steps_hold_the_nearest_present_one():
    values = np.arange(12.0).reshape(4, 3, 1)
    ends = np.array([[0, 2, 1], [4, 4, 1]])
    filled = held(values, ends)[:, :, 0]
    assert filled[:, 0].tolist() == [0.0, 3.0, 6.0, 9.0]
    assert filled[:, 1].tolist() == [7.0, 7.0, 7.0, 10.0]
    assert filled[:, 2].tolist() == [0.0] * 4


@pytest.mark.parametrize(
    "change",
    [
        {"gid": np.array([1, 0, 2])},
        {"gid": np.array([0, 1, 1])},
        {"fields": {"x": np.zeros((16, 3, 2))}},
        {"fields": {"x": np.zeros((15, 3, 3))}},
        {"fields": {}},
        {"first": np.array([0, 0, 17])},
    ],
)
def test_blocks_that_contradict_themselves_are_refused(change):
    block = Block(np.arange(3), {"x": np.zeros((16, 3, 3))})
    with pytest.raises(ValueError):
        encoder_of(Bound("exact")).encode(replace(block, **change), TIMES)


@pytest.mark.parametrize("bound", [Bound("relative", 1e-2), Bound("pointwise", 1e-4)])
def test_fast_effort_keeps_bounds_for_a_few_more_bytes(bound):
    position, velocity, times = falling_bodies(bodies=2000)
    for values in (position, velocity):
        coded = {}
        for effort in ("best", "fast"):
            encoder = Encoder({"x": FieldSpec(bound, width=3)}, Settings(effort=effort))
            coded[effort] = encoder.encode(Block(np.arange(2000), {"x": values}), times).fields["x"]
            decoded = decode(coded[effort], values)
            assert coded[effort].errors == measure(values, decoded)
            assert bound.target(values).met_by(coded[effort].errors)
        assert len(coded["fast"].data) <= 1.15 * len(coded["best"].data) + 64


def test_errors_of_fast_effort_are_measured_without_decoding(monkeypatch):
    """On what the decoder gives all the same: the encoder knows that to the last bit."""
    encoder = encoder_of(Bound("relative", 1e-2), effort="fast", trial_every=1000)
    rough = np.cumsum(np.random.default_rng(6).standard_normal((16, 300, 3)), axis=0)
    encode(encoder, rough)
    assert encoder.memory.winners["x"].coder == "predictive"
    with monkeypatch.context() as patched:
        patched.setattr(coders, "decode", None)
        part = encode(encoder, rough[::-1].copy()).fields["x"]
    assert part.errors == measure(rough[::-1], decode(part, rough))


@pytest.mark.parametrize("every", [0, -1])
def test_trials_after_no_chunk_at_all_are_refused(every):
    with pytest.raises(ValueError, match=f"trial_every {every}: must be positive"):
        Settings(trial_every=every)


def test_unknown_effort_is_refused():
    with pytest.raises(ValueError, match="effort 'slow': must be one of best, fast"):
        Settings(effort="slow")


@pytest.mark.parametrize("effort", ["best", "fast"])
def test_resumed_archive_has_the_bytes_of_one_never_interrupted(tmp_path, effort):
    """What is carried from chunk to chunk is in the file, and depends on no clock."""
    quick = replace(SETTINGS, effort=effort, trial_every=2)
    paths = tmp_path / "whole.tta", tmp_path / "resumed.tta"
    for path, ends in zip(paths, [(4,), (1, 3, 4)], strict=True):
        writer = ArchiveWriter(path, FIELDS, settings=quick)
        for begin, end in itertools.pairwise((0, *ends)):
            for number in range(begin, end):
                writer.append(chunk_of(number))
            writer.abandon()
            writer = ArchiveWriter.resume(path)
        writer.close()
    assert paths[0].read_bytes() == paths[1].read_bytes()
