"""Writing archives: chunk after chunk, by one process, interrupted at any point."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray

from compress.archive_format import (
    ROW,
    DamageError,
    Header,
    OpenFile,
    Piece,
    Places,
    Record,
    RecordWriter,
    ascend,
    create,
    open_archive,
)
from compress.coding import (
    DEFAULT_SETTINGS,
    Chunk,
    CodedChunk,
    Encoder,
    FieldSpec,
    Memory,
    Scale,
    Settings,
    Winner,
    add_scales,
    check_fields,
)
from dem_mpi.errors import DataError, InputError, OutputError
from dem_mpi.h5files import HDF5_ERRORS, OutputLock, fsync, reason, require_space
from dem_mpi.parallel import Parallel

_FIRST_ROWS = 1 << 10
_FIRST_BYTES = 1 << 20
_COPY_BYTES = 1 << 24


class ArchiveWriter:
    """An archive that grows. Only one process writes: ranks send it their coded blocks.

    As a context manager it completes the archive at the end, and leaves it as if interrupted
    where an exception ends it.
    """

    _descriptor: int | None = None

    def __init__(
        self,
        path: Path | str,
        fields: Mapping[str, FieldSpec],
        *,
        settings: Settings = DEFAULT_SETTINGS,
        provenance: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> None:
        """Begin an archive; `provenance` are numbers and texts (JSON) kept with it.

        Raises OutputError if there is such a file (unless `force`), or it cannot be written.
        """
        check_fields(fields)
        header = Header(dict(fields), settings, dict(provenance or {}))
        try:
            header.text()
        except (TypeError, ValueError) as error:
            raise InputError(f"provenance: {error}") from None
        self._lock = OutputLock(Parallel.alone(), path)
        try:
            if Path(path).exists() and not force:
                raise OutputError(f"{path}: exists already")
            self._begin(Path(path), header, None, ())
        except BaseException:
            self.abandon()
            raise

    @classmethod
    def resume(cls, path: Path | str, last_step: int | None = None) -> ArchiveWriter:
        """Go on with an archive, interrupted or complete, behind its last whole chunk.

        Chunks with steps after `last_step` are dropped first. Raises InputError if there is no
        such file, DataError if it is damaged, OutputError if it cannot be written.
        """
        self = cls.__new__(cls)
        self._lock = OutputLock(Parallel.alone(), path)
        try:
            opened = open_archive(path)
            with opened.file:
                kept = takewhile(
                    lambda r: last_step is None or r.steps.max() <= last_step, opened.records
                )
                self._begin(Path(path), opened.header, opened, list(kept))
        except (DamageError, ValueError) as error:
            self.abandon()
            raise DataError(f"{path}: damaged: {error}") from None
        except BaseException:
            self.abandon()
            raise
        return self

    def _begin(
        self, path: Path, header: Header, source: OpenFile | None, kept: Sequence[Record]
    ) -> None:
        self.path = path
        self.header = header
        self._records = RecordWriter(header)
        self._count = 0
        self._end = 0
        self._last_step: int | None = None
        self._total: dict[str, Scale] = {name: Scale() for name in header.fields}
        self._winners: dict[int, dict[str, Winner]] = {}
        self._places = Places(0, 0)
        self._room = Places(0, 0)
        for number, record in enumerate(kept):
            assert source is not None
            self._replay(number, record, source)
        with self._writing():
            if source is not None:
                self._descriptor = os.open(path, os.O_RDONLY)
                self._places = source.places
            self._rebuild(complete=False)

    def _replay(self, number: int, record: Record, source: OpenFile) -> None:
        """Remember a chunk that is in the file already."""
        winners, scales = [], []
        names = list(self.header.fields)
        for place, block in enumerate(record.blocks):
            parts = dict(zip(names, block.fields, strict=True))
            winners.append(
                {n: Winner.of(p.coder, p.piece.length, p.errors) for n, p in parts.items()}
            )
            scales.append({n: Scale(p.errors.norm, p.errors.count) for n, p in parts.items()})
            if isinstance(block.gids, Piece):
                self._records.know(place, source.reader.numbers(block), number)
        self._remember(record.steps, record.end, winners, scales)

    def _remember(
        self,
        steps: NDArray,
        end: int,
        winners: Sequence[dict[str, Winner]],
        scales: Sequence[dict[str, Scale]],
    ) -> None:
        whole = add_scales(self.header.fields, scales)
        self._total = {name: self._total[name] + whole[name] for name in whole}
        self._winners.update(enumerate(winners))
        self._last_step = int(steps[-1])
        self._count += 1
        self._end = end

    @property
    def last_step(self) -> int | None:
        """The last step number in the archive, None while it is empty."""
        return self._last_step

    @property
    def size(self) -> int:
        """Bytes [B] that chunks take so far, their rows of the index included."""
        return self._end + self._count * ROW.size

    def memory(self, block: int = 0) -> Memory:
        """What the encoder of this block of each chunk has to start from."""
        return Memory(self._count, dict(self._total), self._winners.get(block, {}))

    def append(self, chunk: Chunk) -> CodedChunk:
        """Code all blocks of a chunk in this process, and append it.

        Raises InputError for values that the bound of their field does not allow and for steps
        that do not ascend from those in the archive, OutputError if it cannot be written.
        """
        encoders = [
            Encoder(self.header.fields, self.header.settings, self.memory(place))
            for place in range(len(chunk.blocks))
        ]
        scales = [e.scales(b) for e, b in zip(encoders, chunk.blocks, strict=True)]
        blocks = tuple(
            encoder.encode(block, chunk.times, scales, chunk.steps)
            for encoder, block in zip(encoders, chunk.blocks, strict=True)
        )
        coded = CodedChunk(chunk.steps, chunk.times, blocks)
        self.append_coded(coded)
        return coded

    def append_coded(self, chunk: CodedChunk) -> None:
        """Append a chunk that ranks have coded. When this returns a killed process loses none.

        Raises InputError for steps that do not ascend or are not behind those in the archive,
        OutputError if the archive cannot be written.
        """
        if not len(chunk.steps) or len(chunk.steps) != len(chunk.times):
            raise ValueError(f"{len(chunk.steps)} steps with {len(chunk.times)} times")
        if not ascend(chunk.steps, self._last_step):
            behind = "" if self._last_step is None else f" behind step {self._last_step}"
            first, last = int(chunk.steps[0]), int(chunk.steps[-1])
            raise InputError(f"{self.path}: steps {first} to {last} do not ascend{behind}")
        record, row = self._records.record(chunk, self._count, self._end)
        end = self._end + len(record)
        with self._writing():
            if self._count >= self._room.index or end > self._room.data:
                self._rebuild(complete=False, more=len(record))
            assert self._descriptor is not None
            _write_at(self._descriptor, record, self._places.data + self._end)
            # The row makes the chunk one of the archive: it comes when all of it is there.
            os.fdatasync(self._descriptor)
            _write_at(self._descriptor, row, self._places.index + self._count * ROW.size)
        self._records.remember(chunk, self._count)
        self._remember(
            chunk.steps,
            end,
            [block.winners for block in chunk.blocks],
            [block.scales for block in chunk.blocks],
        )

    def close(self) -> None:
        """Complete the archive: exactly as long as what it holds. A second call does nothing."""
        if self._descriptor is None:
            return
        try:
            with self._writing():
                self._rebuild(complete=True)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Leave the archive as it is: `resume` goes on with it."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)
        self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def _rebuild(self, *, complete: bool, more: int = 0) -> None:
        """Copy what there is to a file with space for as much again, or for no more if complete.

        The copy takes the archive's name when all of it is on the disk.
        """
        rows, size = self._count, self._end
        if not complete:
            rows = max(_FIRST_ROWS, 2 * rows)
            size = max(_FIRST_BYTES, 2 * (size + more))
        require_space(self.path, self._end + more + (1 << 16))
        temporary = self.path.with_name(f"{self.path.name}.part")
        try:
            places = create(temporary, self.header, rows, size, complete=complete)
            descriptor = os.open(temporary, os.O_RDWR)
            try:
                old = self._descriptor
                if self._count:
                    assert old is not None
                    length = self._count * ROW.size
                    _copy(old, self._places.index, descriptor, places.index, length)
                    _copy(old, self._places.data, descriptor, places.data, self._end)
                os.fsync(descriptor)
                temporary.replace(self.path)
                fsync(self.path.absolute().parent)
            except BaseException:
                os.close(descriptor)
                raise
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        if old is not None:
            os.close(old)
        self._descriptor, self._places, self._room = descriptor, places, Places(rows, size)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except HDF5_ERRORS as error:
            raise OutputError(f"{self.path}: cannot write: {reason(error)}") from None


def _write_at(descriptor: int, data: bytes, place: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(descriptor, view, place)
        view, place = view[written:], place + written


def _copy(source: int, start: int, target: int, place: int, length: int) -> None:
    for first in range(0, length, _COPY_BYTES):
        count = min(_COPY_BYTES, length - first)
        data = os.pread(source, count, start + first)
        if len(data) != count:
            raise OSError("the file has become shorter")
        _write_at(target, data, place + first)
