"""Streams of chunks: the tolerance of the whole however they come, memory, and resuming."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
import zlib

import numpy as np
import pytest

from compress.bounds import norm
from compress.decompose import tt_svd
from compress.rounding import round_train
from compress.stream import FORMS, Part, TensorTrainStream, join
from compress.tensor_train import concatenate, random, zeros
from dem_mpi.errors import DataError
from dem_mpi.parallel import Parallel

SCALES = {
    "growing": lambda k: 10.0**k,
    "falling": lambda k: 10.0**-k,
    "alternating": lambda k: 10.0 ** (6 * (k % 2)),
    "equal": lambda k: 1.0,
    "zero between": lambda k: float(k % 3 == 1),
    "all zero": lambda k: 0.0,
}


def wave(
    chunk: int, steps: int = 4, bodies: int = 24, noise: float = 1e-3, seed: int = 0
) -> np.ndarray:
    """A travelling wave, a singular layer, and noise: (steps, bodies, 3)."""
    t = (chunk * steps + np.arange(steps))[:, None, None] / 30.0
    u = np.linspace(0.0, 1.0, bodies)[None, :, None]
    smooth = np.sin(3.0 * t + 5.0 * u) * np.array([1.0, 0.3, 2.0]) + 1.0 / (0.1 + t % 1 + u)
    return smooth + noise * np.random.default_rng([seed, chunk]).standard_normal(smooth.shape)


def laid_out(stream: TensorTrainStream, values: np.ndarray, chunks: int) -> np.ndarray:
    """A full result with chunks along its first dimension, as they were appended."""
    if stream.form == "concatenate":
        return values
    levels = math.ceil(math.log2(chunks)) if chunks > 1 else 0
    return values.reshape(2**levels, *values.shape[levels:])[:chunks]


def assembled(stream: TensorTrainStream, chunks: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(chunks) if stream.form == "concatenate" else np.stack(chunks)


# ---- the tolerance -----------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-6])
@pytest.mark.parametrize("scale", SCALES)
def test_whole_meets_the_tolerance_however_norms_change(form, tolerance, scale):
    stream, chunks = TensorTrainStream(tolerance, 0, form), []
    for k in range(23):
        chunks.append(SCALES[scale](k) * wave(k, noise=tolerance))
        stream.append(chunks[-1])
        if k not in (0, 1, 2, 6, 7, 12, 22):
            continue
        whole, X = stream.whole(), assembled(stream, chunks)
        error = norm(X - laid_out(stream, whole.train.full(), k + 1))
        assert error <= tolerance * norm(X)
        assert error <= whole.error * (1 + 1e-9) <= tolerance * norm(X) * (1 + 2e-9)
        assert whole.norm == pytest.approx(norm(X), rel=2e-9)


@pytest.mark.parametrize("form", FORMS)
def test_hundreds_of_appends_do_not_drift_away(form):
    """Noise as large as the tolerance keeps every rounding busy."""
    tolerance = 1e-1
    stream, chunks, repeated = TensorTrainStream(tolerance, 0, form), [], None
    for k in range(300):
        chunks.append(wave(k, noise=1e-1, bodies=40))
        stream.append(chunks[-1])
        if form == "concatenate":
            new = tt_svd(chunks[-1], tolerance).train
            joined = new if repeated is None else concatenate([repeated, new])
            repeated = round_train(joined, tolerance).train
    X = assembled(stream, chunks)
    assert norm(X - laid_out(stream, stream.result().full(), 300)) <= tolerance * norm(X)
    if repeated is not None:
        # What it is for: truncated at the tolerance on each append, the whole is beyond it.
        assert norm(X - repeated.full()) > tolerance * norm(X)


@pytest.mark.parametrize("form", FORMS)
def test_equal_chunks_cost_one(form):
    """64 equal chunks have the ranks of one: only their number in time costs."""
    chunk = wave(3)
    stream = TensorTrainStream(1e-8, 0, form)
    for _ in range(64):
        stream.append(chunk)
    whole = stream.result()
    alone = tt_svd(chunk, 1e-8).train
    assert max(whole.ranks) <= max(alone.ranks)
    assert len(stream.parts) == 1
    error = norm(laid_out(stream, whole.full(), 64) - assembled(stream, [chunk] * 64))
    assert error <= 1e-8 * 8 * norm(chunk)


@pytest.mark.parametrize("form", FORMS)
def test_stream_equals_batch_within_the_tolerance(form):
    """Both are within tau of X: no more than 2 tau apart, and of similar size."""
    tolerance = 1e-3
    chunks = [wave(k, noise=1e-6) for k in range(32)]
    stream = TensorTrainStream(tolerance, 0, form)
    for chunk in chunks:
        stream.append(chunk)
    X = assembled(stream, chunks)
    shaped = X if form == "concatenate" else X.reshape((2,) * 5 + X.shape[1:])
    batch = tt_svd(shaped, tolerance).train
    whole = stream.result()
    assert norm(whole.full() - batch.full()) <= 2 * tolerance * norm(X)
    assert whole.parameters <= 2 * batch.parameters


def test_new_dimensions_continue_those_of_time_within_a_chunk():
    """Chunks (bodies, 2, 2): the dimensions of 8 chunks go before them, most significant first."""
    chunks = [wave(k, steps=4, bodies=8).transpose(1, 0, 2)[..., 0] for k in range(8)]
    stream = TensorTrainStream(1e-6, axis=1, form="stack")
    for chunk in chunks:
        stream.append(chunk.reshape(8, 2, 2))
    whole = stream.result()
    assert whole.shape == (8, 2, 2, 2, 2, 2)
    X = np.concatenate(chunks, axis=1)
    assert norm(whole.full().reshape(8, 32) - X) <= 1e-6 * norm(X)


def test_stacks_put_new_dimensions_where_they_are_asked_for():
    chunks = [wave(k, steps=2, bodies=5) for k in range(3)]
    for axis in range(4):
        stream = TensorTrainStream(1e-9, axis, "stack")
        for chunk in chunks:
            stream.append(chunk)
        values = stream.result().full()
        expected = np.zeros((4, *chunks[0].shape))
        expected[:3] = chunks
        expected = np.moveaxis(expected.reshape(2, 2, *chunks[0].shape), (0, 1), (axis, axis + 1))
        assert norm(values - expected) <= 1e-9 * norm(expected)


def test_lengths_may_differ_along_the_dimension_of_time():
    stream, chunks = TensorTrainStream(1e-4, axis=1), []
    for k, steps in enumerate((3, 1, 7, 0, 2, 5)):
        chunks.append(wave(k, steps=steps).transpose(1, 0, 2))
        stream.append(chunks[-1])
    X = np.concatenate(chunks, axis=1)
    assert norm(stream.result().full() - X) <= 1e-4 * norm(X)


@pytest.mark.parametrize("scale", [1e-290, 1e290])
def test_norms_at_the_ends_of_the_range_are_met(scale):
    stream, chunks = TensorTrainStream(1e-3), []
    for k in range(9):
        chunks.append(scale * wave(k))
        stream.append(chunks[-1])
    X = np.concatenate(chunks)
    assert norm(X - stream.result().full()) <= 1e-3 * norm(X)


def test_single_precision_is_kept_and_meets_the_tolerance():
    stream, chunks = TensorTrainStream(1e-4), []
    for k in range(40):
        chunks.append(wave(k, noise=1e-6).astype(np.float32))
        stream.append(chunks[-1])
    whole = stream.result()
    X = np.concatenate(chunks).astype(np.float64)
    assert whole.dtype == np.float32
    assert norm(X - whole.full()) <= 1e-4 * norm(X)
    assert whole.parameters < X.size / 3


@pytest.mark.parametrize("form", FORMS)
def test_trains_with_their_errors_stand_for_chunks(form):
    """Up to all of the tolerance may be spent before: then joining only may not add to it."""
    tolerance = 1e-2
    stream, chunks = TensorTrainStream(tolerance, 0, form), []
    for k in range(11):
        chunks.append(wave(k, noise=1e-2))
        spent = tt_svd(chunks[-1], tolerance * (0.999 if k % 2 else 0.3))
        stream.append(spent.train, spent.error, spent.norm if k % 3 else None)
    X = assembled(stream, chunks)
    assert norm(X - laid_out(stream, stream.result().full(), 11)) <= tolerance * norm(X)


# ---- memory and interruption -------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_memory_is_bounded_by_what_is_held_and_a_chunk(form):
    """512 chunks of 96 kB, 48 MB in all: never more than a few chunks besides the parts held."""
    stream = TensorTrainStream(1e-3, 0, form)
    shape = (4, 1000, 3)
    u, v = np.linspace(0, 1, 1000)[None, :, None], np.array([1.0, 0.5, 2.0])
    most_held = 0
    tracemalloc.start()
    try:
        for k in range(512):
            t = (4 * k + np.arange(4))[:, None, None] / 1000.0
            stream.append(np.sin(2.0 * t + u) * v + np.exp(-t) * u * u)
            most_held = max(most_held, 8 * stream.parameters)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    chunk = 8 * math.prod(shape)
    # Decomposing a chunk and its temporaries come to 5 of it; joining two parts and rounding
    # them to 8 times what they have.
    assert peak <= 6 * chunk + 8 * most_held
    assert peak < 512 * chunk / 20


@pytest.mark.parametrize("form", FORMS)
def test_a_stream_goes_on_bit_by_bit_after_an_interruption(form):
    straight = TensorTrainStream(1e-3, 0, form)
    resumed = TensorTrainStream(1e-3, 0, form)
    for k in range(21):
        straight.append(wave(k))
        resumed = TensorTrainStream.load(resumed.save())
        resumed.append(wave(k))
    assert resumed.save() == straight.save()
    assert (resumed.chunks, resumed.error, resumed.norm) == (21, straight.error, straight.norm)
    a, b = straight.result(), resumed.result()
    assert a.ranks == b.ranks
    assert all(np.array_equal(p, q) for p, q in zip(a.cores, b.cores, strict=True))
    assert TensorTrainStream.load(TensorTrainStream(0.5).save()).chunks == 0


def test_reading_a_result_does_not_disturb_the_stream():
    one, other = TensorTrainStream(1e-3), TensorTrainStream(1e-3)
    for k in range(9):
        one.append(wave(k))
        other.append(wave(k))
        other.result()
    assert one.save() == other.save()


def test_damaged_states_are_refused_in_one_line():
    stream = TensorTrainStream(1e-3)
    for k in range(3):
        stream.append(wave(k, bodies=4))
    data = stream.save()
    for at in range(0, len(data), 7):
        for broken in (data[:at], data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]):
            with pytest.raises(DataError) as caught:
                TensorTrainStream.load(broken)
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"format": 99},
        {"tolerance": 7.0},
        {"form": "heap"},
        {"chunks": 5},
        {"chunks": 10**400},
        {"parts": None},
        {"parts": [{}]},
    ],
)
def test_states_that_make_no_sense_are_refused(change):
    """With a right checksum too: what is described is checked, not believed."""
    assert "\n" not in refused(forged(lambda state: state | change))


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [2**40, 4, 3]},
        {"shape": [-4, 4, 3]},
        {"ranks": [1, 1, 1]},
        {"dtype": "object"},
        {"level": -3},
        {"level": 10**9},
        {"error": -1.0},
        {"error": math.inf},
        {"norm": math.nan},
        {"norm": 1e-6},
    ],
)
def test_parts_that_make_no_sense_are_refused(change):
    def with_change(state: dict) -> dict:
        return state | {"parts": [state["parts"][0] | change, *state["parts"][1:]]}

    assert "\n" not in refused(forged(with_change))


def forged(change) -> bytes:
    stream = TensorTrainStream(1e-3)
    for k in range(3):
        stream.append(wave(k, bodies=4))
    head = struct.Struct("<8sIQ")
    data = stream.save()
    magic, _, length = head.unpack_from(data)
    state = json.loads(data[head.size : head.size + length])
    text = json.dumps(change(state)).encode()
    body = text + data[head.size + length :]
    return head.pack(magic, zlib.crc32(body), len(text)) + body


def refused(data: bytes) -> str:
    with pytest.raises(DataError) as caught:
        TensorTrainStream.load(data)
    return str(caught.value)


# ---- refusals ----------------------------------------------------------------------------------


def test_chunks_that_do_not_fit_are_refused_and_leave_the_stream_alone():
    for form in FORMS:
        stream = TensorTrainStream(1e-3, 0, form)
        for k in range(3):
            stream.append(wave(k))
        before = stream.save()
        bad = wave(1)
        bad[1, 2, 0] = math.nan
        for chunk, message in (
            (wave(0, bodies=7), "does not fit"),
            (wave(0)[..., 0], "does not fit"),
            (wave(0).astype(np.float32), "float32"),
            (bad, "1, 2, 0"),
        ):
            with pytest.raises(ValueError, match=message):
                stream.append(chunk)
        with pytest.raises(ValueError, match="above"):
            stream.append(tt_svd(wave(0)).train, error=1.0)
        with pytest.raises(ValueError, match="error"):
            stream.append(zeros((4, 24, 3)), error=-1.0)
        assert stream.save() == before


def test_options_that_say_nothing_are_refused():
    for tolerance in (0.0, 1.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="tolerance"):
            TensorTrainStream(tolerance)
    with pytest.raises(ValueError, match="axis"):
        TensorTrainStream(1e-3, axis=-1)
    with pytest.raises(ValueError, match="form"):
        TensorTrainStream(1e-3, form="pile")
    with pytest.raises(ValueError, match="axis"):
        TensorTrainStream(1e-3, axis=3).append(wave(0))
    with pytest.raises(ValueError, match="no chunk"):
        TensorTrainStream(1e-3).result()


def test_joined_parts_keep_what_is_known_of_them():
    generator = np.random.default_rng(5)
    parts = [Part(random((4, 5), 2, generator), 3e-3, 3.0), Part(zeros((4, 5)), 4e-3, 4.0)]
    joined = join(parts, axis=1)
    assert (joined.train.shape, joined.error, joined.norm) == ((4, 10), 5e-3, 5.0)
    assert join(parts, 1, tolerance=1e-3).error == 5e-3
    assert join(parts, 1, tolerance=2e-3).error <= 1e-2


# ---- parts of several ranks --------------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
def test_shares_of_ranks_joined_equal_the_stream_of_all(parallel: Parallel):
    """Each rank compresses its bodies to tau / 2; joined on rank 0, the whole meets tau."""
    tolerance, bodies = 1e-3, 20
    first, last = (bodies * (parallel.rank + i) // parallel.size for i in (0, 1))
    share, alone, chunks = TensorTrainStream(tolerance / 2), TensorTrainStream(tolerance), []
    for k in range(9):
        chunks.append(wave(k, bodies=bodies))
        share.append(chunks[-1][:, first:last])
        alone.append(chunks[-1])
    parts = parallel.gather(share.whole())
    if parts is None:
        return
    whole = join(parts, axis=1, tolerance=tolerance)
    X = np.concatenate(chunks)
    assert norm(X - whole.train.full()) <= tolerance * norm(X)
    assert norm(alone.result().full() - whole.train.full()) <= 2 * tolerance * norm(X)
    assert whole.error <= tolerance * norm(X)
