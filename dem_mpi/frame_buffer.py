"""Frames that wait until there are enough of them to be compressed together.

A *chunk* is a number of consecutive frames. A rank buffers the rows of its bodies; bodies migrate,
come in and are taken out meanwhile. When the chunk is full every body's rows come together on its
*home*, the rank that had it in the first frame of the chunk in which it is there.

Symbols: T frames of the chunk; n bodies; m rows of all frames; w components of a field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel


@dataclass(frozen=True)
class Track:
    """Bodies over the frames of a chunk.

    gid         : (n,) int64, ascending
    first, stop : (n,) int32, each body is there in frames [first, stop) of the chunk
    fields      : {name: (T, n) or (T, n, w)}, 0 where a body is not there
    """

    gid: NDArray[np.int64]
    first: NDArray[np.int32]
    stop: NDArray[np.int32]
    fields: dict[str, NDArray]


@dataclass(frozen=True)
class PendingFrames:
    """What is in a buffer when a checkpoint is written, so that nothing of it is lost.

    archived   : last step that the archive has whole, -1 for none
    step, time : (T,) of the frames that wait, time in s
    rows       : this rank's rows of all of them: frame (m,) int32, gid (m,) int64, and the fields
    """

    archived: int
    step: NDArray[np.int64]
    time: NDArray[np.float64]
    rows: dict[str, NDArray]


class FrameBuffer:
    """Rows of this rank's bodies in the frames of a chunk that is not full yet."""

    def __init__(self, fields: Sequence[str]) -> None:
        """Buffer these columns, and gid."""
        self.fields = tuple(fields)
        self.clear()

    def clear(self) -> None:
        """Forget the frames."""
        self.steps: list[int] = []
        self.times: list[float] = []
        self._gids: list[NDArray] = []
        self._columns: list[dict[str, NDArray]] = []

    def __len__(self) -> int:
        return len(self.steps)

    def add(self, step: int, time: float, columns: Mapping[str, NDArray]) -> None:
        """Copy the rows of a frame: {name: (k,) or (k, w)} with gid among them."""
        self.steps.append(step)
        self.times.append(time)
        self._gids.append(np.array(columns["gid"], dtype=np.int64))
        self._columns.append({name: np.array(columns[name]) for name in self.fields})

    def pending(self, archived: int) -> PendingFrames:
        """The rows as a checkpoint keeps them."""
        rows = self._rows() if len(self) else {}
        return PendingFrames(archived, np.array(self.steps, np.int64), np.array(self.times), rows)

    def refill(self, pending: PendingFrames) -> None:
        """Take up rows that a checkpoint kept, on the ranks that had them or on any others."""
        self.clear()
        self.steps, self.times = pending.step.tolist(), pending.time.tolist()
        for k in range(len(self)):
            frame = pending.rows["frame"]
            mine = frame == k
            self._gids.append(pending.rows["gid"][mine])
            self._columns.append({name: pending.rows[name][mine] for name in self.fields})

    def _rows(self) -> dict[str, NDArray]:
        count = [len(gid) for gid in self._gids]
        rows = {"frame": np.repeat(np.arange(len(self), dtype=np.int32), count)}
        rows["gid"] = np.concatenate(self._gids)
        for name in self.fields:
            rows[name] = np.concatenate([columns[name] for columns in self._columns])
        return rows

    def gather(self, parallel: Parallel) -> Track:
        """Collective. The rows of the bodies whose home this rank is."""
        whole = all(np.array_equal(gid, self._gids[0]) for gid in self._gids)
        if parallel.any(not whole):
            return tracks(len(self), send_home(parallel, len(self), self._rows()))
        gid = self._gids[0]
        order = np.argsort(gid, kind="stable")
        n, count = len(gid), len(self)
        return Track(
            gid[order],
            np.zeros(n, np.int32),
            np.full(n, count, np.int32),
            {name: np.stack([c[name][order] for c in self._columns]) for name in self.fields},
        )


def tracks(frames: int, rows: Mapping[str, NDArray]) -> Track:
    """Sort rows (m,) of so many frames by body.

    Raises ValueError where a body has two rows in a frame, or none between its first and its last.
    """
    frame = rows["frame"]
    gid, body = np.unique(rows["gid"], return_inverse=True)
    first = np.full(len(gid), frames, np.int32)
    stop = np.zeros(len(gid), np.int32)
    np.minimum.at(first, body, frame)
    np.maximum.at(stop, body, frame + 1)
    rows_of = np.bincount(body, minlength=len(gid))
    there = np.zeros((frames, len(gid)), bool)
    there[frame, body] = True
    wrong = np.flatnonzero((rows_of != stop - first) | (there.sum(axis=0) != rows_of))
    if len(wrong):
        raise ValueError(f"body {gid[wrong[0]]} is there twice at a time, or not all the time")
    fields = {}
    for name, values in rows.items():
        if name not in ("frame", "gid"):
            fields[name] = np.zeros((frames, len(gid), *values.shape[1:]), values.dtype)
            fields[name][frame, body] = values
    return Track(gid, first, stop, fields)


def send_home(parallel: Parallel, frames: int, rows: dict[str, NDArray]) -> dict[str, NDArray]:
    """Collective. Give every row to the home of its body; returns the rows of this rank's.

    No rank knows all bodies: who is home is asked of rank gid mod P, to whom every rank tells the
    bodies that it does not have in all frames, with the first frame in which it has each.
    """
    if parallel.size == 1:
        return rows
    gid, body, count = np.unique(rows["gid"], return_inverse=True, return_counts=True)
    first = np.full(len(gid), frames, np.int64)
    np.minimum.at(first, body, rows["frame"])
    partly = np.flatnonzero(count < frames)
    home = np.full(len(gid), parallel.rank)
    home[partly] = _ask_for_homes(parallel, gid[partly], first[partly])

    kind = np.dtype([(name, v.dtype, v.shape[1:]) for name, v in rows.items()])
    target, messages = home[body], {}
    for rank in np.unique(target[target != parallel.rank]):
        mine = np.flatnonzero(target == rank)
        packed = np.empty(len(mine), kind)
        for name, values in rows.items():
            packed[name] = values[mine]
        messages[int(rank)] = packed.tobytes()
    arrived = [np.frombuffer(m, kind) for m in parallel.exchange(messages).values()]
    kept = target == parallel.rank
    return {
        name: np.concatenate([values[kept], *(part[name] for part in arrived)])
        for name, values in rows.items()
    }


def _ask_for_homes(parallel: Parallel, gid: NDArray, first: NDArray) -> NDArray:
    """Collective. The rank (k,) with the lowest first frame of each gid (k,), over all ranks."""
    clerk = gid % parallel.size
    asked = {int(rank): np.flatnonzero(clerk == rank) for rank in np.unique(clerk)}
    reports = parallel.exchange(
        {rank: np.stack([gid[k], first[k]]).tobytes() for rank, k in asked.items()}
    )
    tables = {rank: np.frombuffer(m, np.int64).reshape(2, -1) for rank, m in reports.items()}
    answers = {}
    if tables:
        known = np.concatenate(list(tables.values()), axis=1)
        teller = np.repeat(list(tables), [t.shape[1] for t in tables.values()])
        order = np.lexsort((teller, known[1], known[0]))
        name, place = np.unique(known[0][order], return_index=True)
        earliest = teller[order][place]
        answers = {
            rank: earliest[np.searchsorted(name, table[0])].astype(np.int64).tobytes()
            for rank, table in tables.items()
        }
    homes = np.full(len(gid), parallel.rank, np.int64)
    for rank, message in parallel.exchange(answers).items():
        homes[asked[rank]] = np.frombuffer(message, np.int64)
    return homes
