"""Every exchange between ranks, by name; the only module that calls mpi4py.

`Parallel` holds a communicator: reductions, broadcasts, sparse messages, agreement on errors.
`Halo` moves rows between the rank that owns a body and the ranks that hold a ghost of it.

Symbols: P ranks; n owned rows; g ghost rows, stored behind the owned ones in rank order.
"""

from __future__ import annotations

import itertools
import pickle
import sys
import time
import traceback
import weakref
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpi4py import MPI

_EXCHANGE_TAGS = (71, 72)
_HALO_TAG = 73
_BLOCK_TAG = 74
_CHUNK = 1 << 30  # bytes in one MPI call, whose counts are 32-bit


class Parallel:
    """A group of ranks. Methods marked collective must be called by all of them, in one order."""

    def __init__(self, communicator: MPI.Comm | None = None) -> None:
        """Collective. Take a duplicate of `communicator` (default: all ranks of the job).

        Messages of other code on the same ranks then cannot be mistaken for ours.
        """
        self.communicator = (MPI.COMM_WORLD if communicator is None else communicator).Dup()
        self.rank: int = self.communicator.Get_rank()
        self.size: int = self.communicator.Get_size()
        self.bytes_sent = 0
        self.messages_sent = 0
        self._round = 0

    def count_sent(self, size: int, messages: int = 1) -> None:
        """Add messages of `size` bytes together to what this rank has sent to other ranks.

        Reductions and broadcasts are left out: what they send is MPI's choice.
        """
        self.bytes_sent += size
        self.messages_sent += messages

    def free(self) -> None:
        """Collective. Give the communicator back to MPI; nothing else works after that."""
        self.communicator.Free()

    @classmethod
    def alone(cls) -> Parallel:
        """Return a group of this rank only, whose communicator ends with it.

        MPI has some 65,000 communicators, and a plan of sums or a solver may make a group each.
        """
        group = cls(MPI.COMM_SELF)
        weakref.finalize(group, _free_if_open, group.communicator)
        return group

    def ranks_of_machine(self) -> int:
        """Collective. The number of these ranks that share this rank's memory."""
        here = self.communicator.Split_type(MPI.COMM_TYPE_SHARED)
        try:
            return here.Get_size()
        finally:
            here.Free()

    # ---- reductions ------------------------------------------------------------------------
    # Integers and flags of any width are reduced in 64 bits, so that counts cannot overflow.

    def sum(self, value: Any) -> Any:
        """Collective. The sum over ranks of a number or an array."""
        return self._reduce(value, MPI.SUM)

    def max(self, value: Any) -> Any:
        """Collective. The elementwise maximum over ranks of a number or an array."""
        return self._reduce(value, MPI.MAX)

    def min(self, value: Any) -> Any:
        """Collective. The elementwise minimum over ranks of a number or an array."""
        return self._reduce(value, MPI.MIN)

    def any(self, flag: bool) -> bool:
        """Collective. Whether the flag is set on at least one rank."""
        return bool(self.max(int(flag)))

    def sum_in_place(self, array: NDArray) -> None:
        """Collective. Replace a contiguous array by its sum over ranks."""
        if self.size > 1:
            self.communicator.Allreduce(MPI.IN_PLACE, array, op=MPI.SUM)

    def max_in_place(self, array: NDArray) -> None:
        """Collective. Replace a contiguous array by its maximum over ranks."""
        if self.size > 1:
            self.communicator.Allreduce(MPI.IN_PLACE, array, op=MPI.MAX)

    def exclusive_sum(self, count: int) -> int:
        """Collective. The sum of `count` over the ranks below this one (64 bits)."""
        mine = np.array([count], dtype=np.int64)
        below = np.zeros(1, dtype=np.int64)
        self.communicator.Exscan(mine, below, op=MPI.SUM)
        return int(below[0]) if self.rank else 0

    def _reduce(self, value: Any, operation: MPI.Op) -> Any:
        result = np.array(value, order="C")
        if result.dtype.kind in "bi" or (result.dtype.kind == "u" and result.itemsize < 8):
            result = result.astype(np.int64)
        if self.size > 1:
            self.communicator.Allreduce(MPI.IN_PLACE, result, op=operation)
        return result if isinstance(value, np.ndarray) else result.item()

    # ---- values that all ranks need --------------------------------------------------------

    def broadcast(self, value: Any, root: int = 0) -> Any:
        """Collective. Rank `root`'s Python object on every rank."""
        return self.communicator.bcast(value, root=root)

    def allgather(self, array: NDArray) -> NDArray:
        """Collective. Equal-shaped arrays of all ranks stacked: (P, *shape)."""
        mine = np.asarray(array, order="C")
        result = np.empty((self.size, *mine.shape), dtype=mine.dtype)
        self.communicator.Allgather(mine, result)
        return result

    def gather(self, value: Any, root: int = 0) -> list[Any] | None:
        """Collective. Every rank's Python object on `root` in rank order, None elsewhere."""
        return self.communicator.gather(value, root=root)

    def barrier(self) -> None:
        """Collective. Wait until every rank is here."""
        self.communicator.Barrier()

    # ---- blocks through one rank -----------------------------------------------------------

    def blocks_on_root(self, array: NDArray) -> Iterator[NDArray]:
        """Collective. On rank 0 yield each rank's block in rank order; elsewhere send and stop.

        Every rank must iterate. Rank 0 never holds more than its own block and one other, so
        that a file can be written through it without the memory of the whole. All blocks share
        dtype and trailing shape. If rank 0 stops early (a full disk), the rest is received and
        dropped, so that the other ranks are not left waiting.
        """
        mine = np.ascontiguousarray(array)
        counts = self.communicator.gather(mine.shape[0], root=0)
        if counts is None:
            self._send_block(mine)
            return
        waiting = list(range(1, self.size))
        try:
            yield mine
            while waiting:
                source = waiting.pop(0)
                yield self._receive_block(source, (counts[source], *mine.shape[1:]), mine.dtype)
        finally:
            for source in waiting:
                self._receive_block(source, (counts[source], *mine.shape[1:]), mine.dtype)

    def _send_block(self, array: NDArray) -> None:
        for chunk in _chunks(_as_bytes(array)):
            self.communicator.Send(chunk, dest=0, tag=_BLOCK_TAG)
            self.count_sent(chunk.nbytes)

    def _receive_block(self, source: int, shape: tuple[int, ...], dtype: np.dtype) -> NDArray:
        block = np.empty(shape, dtype=dtype)
        for chunk in _chunks(_as_bytes(block)):
            self.communicator.Recv(chunk, source=source, tag=_BLOCK_TAG)
        return block

    # ---- sparse messages -------------------------------------------------------------------

    def exchange(self, messages: Mapping[int, bytes]) -> dict[int, bytes]:
        """Collective. Deliver each message to its rank; return those received, by source.

        The receivers are not known beforehand: synchronous sends, probing, and a barrier that a
        rank enters once its own messages have been matched (T. Hoefler, C. Siebert,
        A. Lumsdaine, PPoPP 2010). Cost grows with the neighbours, not with P.
        """
        others = {r: m for r, m in messages.items() if r != self.rank}
        arrived: dict[int, list[bytes]] = {}
        if self.rank in messages:
            arrived[self.rank] = [bytes(messages[self.rank])]
        if self.size > 1:
            self._exchange_with_others(others, arrived)
        return {source: b"".join(arrived[source]) for source in sorted(arrived)}

    def _exchange_with_others(
        self, messages: Mapping[int, bytes], arrived: dict[int, list[bytes]]
    ) -> None:
        # Alternating tags: a rank can be one round ahead of another, never two.
        tag = _EXCHANGE_TAGS[self._round % 2]
        self._round += 1
        # Chunks between two ranks arrive in the order in which they were sent.
        requests = [
            self.communicator.Issend(chunk, dest=destination, tag=tag)
            for destination, message in messages.items()
            for chunk in _chunks(memoryview(message)) or [b""]
        ]
        for message in messages.values():
            self.count_sent(len(message), max(1, -(-len(message) // _CHUNK)))
        status = MPI.Status()
        barrier = None
        while True:
            found = self.communicator.Improbe(source=MPI.ANY_SOURCE, tag=tag, status=status)
            if found is not None:
                buffer = bytearray(status.Get_count(MPI.BYTE))
                found.Recv([buffer, MPI.BYTE])
                arrived.setdefault(status.Get_source(), []).append(bytes(buffer))
            elif barrier is None:
                if MPI.Request.Testall(requests):
                    barrier = self.communicator.Ibarrier()
            elif barrier.Test():
                break

    # ---- errors ----------------------------------------------------------------------------

    def raise_together(self, error: Exception | None) -> None:
        """Collective. If any rank brings an error, raise the lowest rank's on all of them.

        That rank raises its own object, the others a copy of the same type and text; where the
        type cannot be copied, a RuntimeError that names it. The exit code goes along.
        """
        first = self.min(self.size if error is None else self.rank)
        if first == self.size:
            return
        mine = error if self.rank == first else None
        form = self.broadcast(None if mine is None else _portable_error(mine), root=first)
        if mine is None:
            mine = _error_from(form)
            mine.add_note(f"raised on rank {first} of {self.size}")
        raise mine

    def all_arrive(self, seconds: float) -> bool:
        """Collective, if it can be. Whether every rank calls this within so many seconds.

        After False the ranks no longer agree on their next exchange: only `abort` is left.
        """
        arrival = self.communicator.Ibarrier()
        deadline = time.monotonic() + seconds
        while not arrival.Test():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.001)
        return True

    def abort(self, exit_code: int) -> None:
        """End all ranks now with this exit code."""
        sys.stdout.flush()
        sys.stderr.flush()
        self.communicator.Abort(exit_code)

    def install_abort_hook(self, exit_code: int = 70) -> None:
        """Make an uncaught exception on one rank end all of them, with its message.

        Without it the other ranks wait for ever in their next collective call.
        """

        def hook(kind: type[BaseException], value: BaseException, trace: Any) -> None:
            where = f" on rank {self.rank} of {self.size}" if self.size > 1 else ""
            text = "".join(traceback.format_exception(kind, value, trace))
            sys.stderr.write(f"dem-mpi: internal error{where}: {value}\n{text}")
            self.abort(getattr(value, "exit_code", exit_code))

        sys.excepthook = hook


def _free_if_open(communicator: MPI.Comm) -> None:
    if communicator != MPI.COMM_NULL and not MPI.Is_finalized():
        communicator.Free()


def _as_bytes(array: NDArray) -> NDArray:
    return array.reshape(-1).view(np.uint8)


def _chunks(data: Any) -> list[Any]:
    """Consecutive views of a flat buffer of bytes, none longer than one MPI call can take."""
    return [data[start : start + _CHUNK] for start in range(0, len(data), _CHUNK)]


def _portable_error(error: Exception) -> bytes:
    """Pickle a call that makes `error` again on another rank, tried out here.

    Unpickling an exception calls its type with `args`, which fails where the constructor wants
    something else; and its attributes may not be picklable. Then the type is made without its
    constructor, and a local type becomes a RuntimeError that names it.
    """
    kind, text = type(error), str(error)
    exit_code = getattr(error, "exit_code", None)
    recipes = [
        (_same, error),
        (_error_without_constructor, kind, text, exit_code),
        (_error_without_constructor, RuntimeError, f"{kind.__name__}: {text}", exit_code),
    ]
    for recipe in recipes[:-1]:
        try:
            form = pickle.dumps(recipe)
            copy = _error_from(form)
        except Exception:
            continue
        if type(copy) is kind and str(copy) == text:
            return form
    return pickle.dumps(recipes[-1])


def _error_from(form: bytes) -> Exception:
    make, *arguments = pickle.loads(form)
    return make(*arguments)


def _same(error: Exception) -> Exception:
    return error


def _error_without_constructor(
    kind: type[Exception], text: str, exit_code: int | None
) -> Exception:
    error = kind.__new__(kind, text)
    if exit_code is not None:
        error.exit_code = exit_code
    return error


def _ascending_runs(index: NDArray) -> list[slice]:
    """The slices between which `index` does not ascend: none holds a row twice."""
    breaks = np.flatnonzero(np.diff(index) <= 0) + 1
    ends = [0, *breaks.tolist(), len(index)]
    return [slice(start, stop) for start, stop in itertools.pairwise(ends)]


class Halo:
    """Rows of owned bodies that ranks hold as ghosts, and the way back.

    Local arrays have owned + ghosts rows. Ghost rows are grouped by owner in rank order, within
    an owner in the order in which it sends them, so every sum over ghosts has one fixed order. A
    rank may hold several ghosts of one body, and ghosts of its own: periodic images.
    """

    def __init__(
        self,
        parallel: Parallel,
        owned: int,
        send_index: Mapping[int, NDArray],
        receive_count: Mapping[int, int],
    ) -> None:
        """Take the rows to send, by rank, and the number of ghosts to receive, by rank."""
        self.parallel = parallel
        self.owned = owned
        self._send = [(r, np.ascontiguousarray(send_index[r])) for r in sorted(send_index)]
        self._runs = [_ascending_runs(index) for _, index in self._send]
        self._receive: list[tuple[int, slice]] = []
        start = owned
        for source in sorted(receive_count):
            stop = start + receive_count[source]
            self._receive.append((source, slice(start, stop)))
            start = stop
        self.ghosts = start - owned
        self._buffers: dict[tuple, tuple[list[NDArray], list[NDArray]]] = {}

    @classmethod
    def build(cls, parallel: Parallel, owned: int, send_index: Mapping[int, NDArray]) -> Halo:
        """Collective. Tell every receiver how many rows it gets.

        `send_index[r]` consists of ascending runs; a row stands once in a run.
        """
        send = {r: np.asarray(i, dtype=np.int64) for r, i in send_index.items() if len(i)}
        counts = parallel.exchange({r: np.int64(len(index)).tobytes() for r, index in send.items()})
        receive = {r: int(np.frombuffer(m, dtype=np.int64)[0]) for r, m in counts.items()}
        return cls(parallel, owned, send, receive)

    def keep(self, needed: NDArray) -> Halo:
        """Collective. The halo of those ghosts alone that `needed` (g,) bool marks on receivers.

        Ghost rows keep their relative order: row k of the new halo is the k-th marked one.
        """
        marks = {
            source: needed[rows.start - self.owned : rows.stop - self.owned]
            for source, rows in self._receive
        }
        wanted = self.parallel.exchange(
            {r: np.ascontiguousarray(mark, dtype=np.uint8).tobytes() for r, mark in marks.items()}
        )
        send = {}
        for destination, index in self._send:
            mask = np.frombuffer(wanted[destination], dtype=np.uint8).astype(bool)
            if mask.any():
                send[destination] = index[mask]
        receive = {r: int(np.count_nonzero(mark)) for r, mark in marks.items() if mark.any()}
        return Halo(self.parallel, self.owned, send, receive)

    def deliver(self, values: Mapping[int, NDArray]) -> NDArray:
        """Collective. Give every ghost what its owner has for this one, as (g,) int8.

        `values[r]` has an entry for each row that goes to rank r: unlike `forward`, the ghosts of
        one body may get different values.
        """
        received = self.parallel.exchange(
            {r: np.ascontiguousarray(value, dtype=np.int8).tobytes() for r, value in values.items()}
        )
        form = b"".join(received[source] for source, _ in self._receive)
        return np.frombuffer(form, dtype=np.int8)

    def forward(self, values: NDArray) -> None:
        """Collective among neighbours. Overwrite ghost rows of (n + g, k) by their owners' rows."""
        if not self._send and not self._receive:
            return
        outgoing, _ = self._buffers_for(values)
        communicator = self.parallel.communicator
        requests = [
            communicator.Irecv(values[rows], source=source, tag=_HALO_TAG)
            for source, rows in self._receive
            if source != self.parallel.rank
        ]
        for (destination, index), buffer in zip(self._send, outgoing, strict=True):
            # Indices are valid by construction; "clip" spares the copy that "raise" makes.
            np.take(values, index, axis=0, out=buffer, mode="clip")
            if destination == self.parallel.rank:
                values[self._own_ghosts] = buffer
                continue
            requests.append(communicator.Isend(buffer, dest=destination, tag=_HALO_TAG))
            self.parallel.count_sent(buffer.nbytes)
        MPI.Request.Waitall(requests)

    def reverse_add(self, values: NDArray) -> None:
        """Collective among neighbours. Add ghost rows of (n + g, k) to their owners' rows.

        Contributions are added in rank order, those of one rank in the order of its ghosts, so
        that the sum is the same every time. Ghost rows are left as they are (stale).
        """
        if not self._send and not self._receive:
            return
        _, incoming = self._buffers_for(values)
        communicator = self.parallel.communicator
        requests = [
            communicator.Irecv(buffer, source=destination, tag=_HALO_TAG)
            for (destination, _), buffer in zip(self._send, incoming, strict=True)
            if destination != self.parallel.rank
        ]
        for source, rows in self._receive:
            if source == self.parallel.rank:
                continue
            requests.append(communicator.Isend(values[rows], dest=source, tag=_HALO_TAG))
            self.parallel.count_sent(values[rows].nbytes)
        MPI.Request.Waitall(requests)
        for (destination, index), runs, buffer in zip(
            self._send, self._runs, incoming, strict=True
        ):
            back = values[self._own_ghosts] if destination == self.parallel.rank else buffer
            for run in runs:
                values[index[run]] += back[run]

    @property
    def _own_ghosts(self) -> slice:
        """The ghost rows that are images of this rank's own bodies."""
        return next(rows for source, rows in self._receive if source == self.parallel.rank)

    def _buffers_for(self, values: NDArray) -> tuple[list[NDArray], list[NDArray]]:
        key = (values.shape[1:], values.dtype.str)
        if key not in self._buffers:
            shapes = [(len(index), *values.shape[1:]) for _, index in self._send]
            self._buffers[key] = (
                [np.empty(s, dtype=values.dtype) for s in shapes],
                [np.empty(s, dtype=values.dtype) for s in shapes],
            )
        return self._buffers[key]
