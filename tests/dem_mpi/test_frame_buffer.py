"""Frames that wait to be compressed come together body by body, wherever their rows have been."""

from __future__ import annotations

import numpy as np
import pytest

from dem_mpi.frame_buffer import FrameBuffer, tracks

FRAMES, BODIES = 7, 40


def history(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Owner (T, n), -1 where a body is not there, of bodies that wander, come in and are taken
    out; their gids (n,); their velocities (T, n, 3)."""
    random = np.random.default_rng(seed)
    owner = random.integers(0, 1000, (FRAMES, BODIES))
    owner[:, :10] = owner[0, :10]  # these stay where they are
    first = np.where(np.arange(BODIES) < 30, 0, random.integers(0, FRAMES, BODIES))
    stop = np.where(np.arange(BODIES) % 7, FRAMES, np.maximum(first, 1) + 1)
    frame = np.arange(FRAMES)[:, None]
    owner[(frame < first) | (frame >= stop)] = -1
    gid = np.sort(random.choice(10**6, BODIES, replace=False))
    return owner, gid, random.standard_normal((FRAMES, BODIES, 3))


def fill(buffer: FrameBuffer, parallel, owner, gid, velocity, frames=range(FRAMES)) -> None:
    for k in frames:
        mine = np.flatnonzero((owner[k] >= 0) & (owner[k] % parallel.size == parallel.rank))
        mine = np.random.default_rng(k).permutation(mine)
        buffer.add(10 * k, 0.1 * k, {"gid": gid[mine], "velocity": velocity[k, mine], "x": gid})


def assert_complete(parallel, track, owner, gid, velocity) -> None:
    """Every body is with one rank, its home, with all its rows."""
    there = owner >= 0
    parts = parallel.gather((track.gid, track.first, track.stop, track.fields["velocity"]))
    home = np.array([owner[np.argmax(there[:, b]), b] for b in range(BODIES)]) % parallel.size
    assert np.array_equal(track.gid, gid[home == parallel.rank])
    if parts is None:
        return
    for gids, first, stop, values in parts:
        for b, number in enumerate(gids):
            column = int(np.searchsorted(gid, number))
            frames = np.flatnonzero(there[:, column])
            assert (first[b], stop[b]) == (frames[0], frames[-1] + 1)
            assert np.array_equal(values[frames, b], velocity[frames, column])


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
@pytest.mark.parametrize("seed", range(3))
def test_every_body_comes_together_on_the_rank_that_had_it_first(parallel, seed):
    owner, gid, velocity = history(seed)
    buffer = FrameBuffer(["velocity"])
    fill(buffer, parallel, owner, gid, velocity)
    assert_complete(parallel, buffer.gather(parallel), owner, gid, velocity)
    assert buffer.steps == [10 * k for k in range(FRAMES)]


@pytest.mark.mpi(ranks=[2])
def test_bodies_that_stay_are_not_sent(parallel):
    owner, gid, velocity = history(0)
    owner[:] = np.arange(BODIES)
    buffer = FrameBuffer(["velocity"])
    fill(buffer, parallel, owner, gid, velocity)
    sent = parallel.bytes_sent
    track = buffer.gather(parallel)
    assert parallel.bytes_sent == sent
    assert_complete(parallel, track, owner, gid, velocity)


@pytest.mark.mpi(ranks=[3])
def test_what_waits_survives_on_other_ranks(parallel):
    """Rows kept by a checkpoint may come back on any rank: here all of them one further on."""
    owner, gid, velocity = history(1)
    before = FrameBuffer(["velocity"])
    fill(before, parallel, owner, gid, velocity, range(4))
    pending = before.pending(-1)
    elsewhere = parallel.gather(pending.rows)
    elsewhere = parallel.broadcast(elsewhere)[(parallel.rank - 1) % parallel.size]
    after = FrameBuffer(["velocity"])
    after.refill(type(pending)(-1, pending.step, pending.time, elsewhere))
    fill(after, parallel, owner, gid, velocity, range(4, FRAMES))
    assert after.steps == [10 * k for k in range(FRAMES)]
    moved = owner.copy()
    moved[:4] = np.where(owner[:4] < 0, -1, owner[:4] % parallel.size + 1)
    assert_complete(parallel, after.gather(parallel), moved, gid, velocity)


def test_a_body_without_a_row_in_a_frame_counts_as_absent_there():
    rows = {
        "frame": np.array([0, 1, 1], np.int32),
        "gid": np.array([5, 9, 5]),
        "x": np.array([1.0, 2.0, 3.0]),
    }
    track = tracks(3, rows)
    assert track.gid.tolist() == [5, 9]
    assert track.first.tolist() == [0, 1]
    assert track.stop.tolist() == [2, 2]
    assert track.fields["x"].tolist() == [[1.0, 0.0], [3.0, 2.0], [0.0, 0.0]]
