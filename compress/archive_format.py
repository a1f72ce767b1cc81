"""How an archive lies in its file.

An HDF5 file of three data sets, each in one piece, and attributes of its root:

    header   ()        text: fields, settings and provenance as JSON
    index    (N, 2)    unsigned 8-byte integers, a row a chunk: where its record ends in `data`;
                       bytes of the record's head << 32 | checksum
    data     (B,)      bytes: records, one behind the other
    attributes         format, format_version, header_checksum, complete (0 or 1)

A *record* is a chunk: a head in msgpack, and behind it the pieces that the head lists with their
coders, lengths, checksums and errors. The checksum of a row of the index (CRC-32) is over the head,
its place and its number, and those in the head are over a piece each, so that every byte in use
is covered by one; what HDF5 itself keeps has checksums in this version of its format.

    head     [steps, times, blocks]
    steps    [first, stride, T], or [T, piece] of int64 where they are not in equal steps
    times    nil: steps x settings.step_size; [t, h]: t + h k; piece of float64; bit by bit
    blocks   [gids, presence, fields] each
    gids     [n, length, checksum], int64; or the number of the chunk whose block in the same
             place has them
    presence nil: all bodies in all steps; or [entries, length, checksum]: first and stop, (2, n)
             int32, and how many pairs of step and body are there
    fields   [coder, length, checksum, errors] each; errors: Frobenius norm, norm of the values,
             maximum, least and most value, as five float64

While an archive grows its index and data are longer than what they hold, and rows without a chunk
are zero. Appending writes bytes into space that the file has already and changes nothing of HDF5's
own, so a process that is killed leaves a file that opens. A file that is full is copied to one
twice as large, which then takes its name; so is one that is complete, to one exactly as large as
what it holds.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import msgpack
import numpy as np
from h5py import h5d, h5f, h5p, h5s, h5t
from numpy.typing import NDArray

from compress import raw
from compress.bounds import Bound, Errors
from compress.coders import CODERS
from compress.coding import CodedBlock, CodedChunk, FieldSpec, Settings, check_fields
from dem_mpi.errors import DataError, DemError
from dem_mpi.h5files import (
    HDF5_ERRORS,
    open_checked,
    read_attribute,
    reason,
    write_attributes,
)

FORMAT = "tensor archive"
FORMAT_VERSION = 1
ROW = struct.Struct("<QQ")
_ERRORS = struct.Struct("<5d")
# A chunk larger than this is not believed.
_MAX_STEPS = 1 << 24
MAX_ENTRIES = 1 << 33


class DamageError(Exception):
    """What is wrong with an archive, without its name."""


# ---- header --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Header:
    """What holds for the whole archive."""

    fields: Mapping[str, FieldSpec]
    settings: Settings
    provenance: Mapping[str, Any]

    def text(self) -> bytes:
        """The header as JSON. Raises ValueError for a provenance that JSON does not hold."""
        fields = {name: asdict(spec) for name, spec in self.fields.items()}
        whole = {
            "fields": fields,
            "settings": asdict(self.settings),
            "provenance": dict(self.provenance),
        }
        return json.dumps(whole, allow_nan=False, indent=1).encode()

    @classmethod
    def from_text(cls, text: bytes) -> Header:
        """The header of an archive; DamageError if it is none."""
        try:
            whole = json.loads(text)
            fields = {
                str(name): FieldSpec(
                    **{**spec, "bound": Bound(**spec["bound"]), "shape": tuple(spec["shape"])}
                )
                for name, spec in whole["fields"].items()
            }
            check_fields(fields)
            settings = Settings(**whole["settings"])
            return cls(fields, settings, dict(whole["provenance"]))
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, DemError) as error:
            raise DamageError(f"'header' is none of an archive: {error}") from None


# ---- records -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """Bytes of `data` from `start` on, with their checksum."""

    start: int
    length: int
    checksum: int


@dataclass(frozen=True)
class FieldEntry:
    """A field of a block: its coder, its piece and its errors."""

    coder: str
    piece: Piece
    errors: Errors


@dataclass(frozen=True)
class BlockEntry:
    """A block: bodies, where their numbers are, their presence, and fields in order.

    gids : a piece, or the number of the chunk that has it; present : entries of a width of 1
    """

    bodies: int
    gids: Piece | int
    presence: Piece | None
    present: int
    fields: tuple[FieldEntry, ...]


@dataclass(frozen=True)
class Record:
    """A chunk as its head tells it: steps (T,), times (T,) [s], blocks; its bytes [start, end)."""

    steps: NDArray
    times: NDArray
    blocks: tuple[BlockEntry, ...]
    start: int
    end: int


def ascend(steps: NDArray, last: int | None) -> bool:
    """Whether there are steps, each behind the one before, the first behind `last` (None: any)."""
    return (
        len(steps) > 0
        and bool((steps[1:] > steps[:-1]).all())
        and (last is None or bool(steps[0] > last))
    )


class RecordWriter:
    """Puts chunks into records; knows which gids are in the file already."""

    def __init__(self, header: Header) -> None:
        self.header = header
        # Of each block of a chunk: the last gids written, and the chunk they are in.
        self._gids: dict[int, tuple[NDArray, int]] = {}

    def know(self, place: int, gid: NDArray, chunk: int) -> None:
        """Tell which numbers block `place` of `chunk` has brought into the file."""
        self._gids[place] = (gid, chunk)

    def record(self, chunk: CodedChunk, number: int, start: int) -> tuple[bytes, bytes]:
        """Chunk `number` as a record at `start` of `data`, and its row of the index.

        Nothing is remembered of it: that is for `remember`, when it is in the file.
        """
        pieces: list[bytes] = []
        steps = np.asarray(chunk.steps, np.int64)
        times = np.asarray(chunk.times, np.float64)
        head = msgpack.packb(
            [
                _steps_entry(steps, pieces),
                _times_entry(times, steps, self.header.settings, pieces),
                [self._block_entry(b, k, pieces) for k, b in enumerate(chunk.blocks)],
            ]
        )
        body = b"".join(pieces)
        end = start + len(head) + len(body)
        return head + body, index_row(head, number, start, end)

    def remember(self, chunk: CodedChunk, number: int) -> None:
        """Know what chunk `number` has brought into the file, now that it is there."""
        for place, block in enumerate(chunk.blocks):
            if self._source(place, block.gid) is None:
                self.know(place, np.asarray(block.gid, np.int64), number)

    def _source(self, place: int, gid: NDArray) -> int | None:
        """The chunk of the file whose block `place` has these numbers, None: they are new."""
        known, chunk = self._gids.get(place, (None, 0))
        return None if known is None or not np.array_equal(known, gid) else chunk

    def _block_entry(self, block: CodedBlock, place: int, pieces: list[bytes]) -> list:
        gids: Any = self._source(place, block.gid)
        if gids is None:
            gid = np.asarray(block.gid, np.int64)
            gids = [len(gid), *_listed(raw.encode(gid), pieces)]
        presence = None
        if block.ends is not None:
            present = int(np.maximum(block.ends[1] - block.ends[0], 0).sum())
            presence = [present, *_listed(raw.encode(block.ends), pieces)]
        fields = []
        for name in self.header.fields:
            part, e = block.fields[name], block.fields[name].errors
            errors = _ERRORS.pack(e.frobenius, e.norm, e.maximum, e.least, e.most)
            fields.append([CODERS.index(part.coder), *_listed(part.data, pieces), errors])
        return [gids, presence, fields]


def _listed(data: bytes, pieces: list[bytes]) -> tuple[int, int]:
    """Put a piece behind the others; its length and checksum for the head."""
    pieces.append(data)
    return len(data), zlib.crc32(data)


def _steps_entry(steps: NDArray, pieces: list[bytes]) -> list:
    stride = int(steps[1] - steps[0]) if len(steps) > 1 else 1
    if np.array_equal(steps, steps[0] + stride * np.arange(len(steps))):
        return [int(steps[0]), stride, len(steps)]
    return [len(steps), list(_listed(raw.encode(steps), pieces))]


def _times_entry(times: NDArray, steps: NDArray, settings: Settings, pieces: list[bytes]) -> Any:
    if _same(times, settings.step_size * np.asarray(steps, np.float64)):
        return None
    start, width = float(times[0]), float(times[-1] - times[0]) / max(len(times) - 1, 1)
    if _same(times, start + width * np.arange(len(times))):
        return [start, width]
    return list(_listed(raw.encode(times), pieces))


def _same(a: NDArray, b: NDArray) -> bool:
    return a.tobytes() == b.tobytes()


def index_row(head: bytes, number: int, start: int, end: int) -> bytes:
    """The row of the index for a record with this head."""
    checksum = zlib.crc32(ROW.pack(start, end) + ROW.pack(number, len(head)) + head)
    return ROW.pack(end, len(head) << 32 | checksum)


class RecordReader:
    """Reads the records of `data`, a data set of bytes; all that is wrong is DamageError."""

    def __init__(self, header: Header, data: h5py.Dataset) -> None:
        self.header = header
        self._data = data

    def bytes_of(self, piece: Piece) -> bytes:
        """A piece, its checksum compared."""
        data = self._data[piece.start : piece.start + piece.length].tobytes()
        if zlib.crc32(data) != piece.checksum:
            raise DamageError("its checksum does not agree")
        return data

    def numbers(self, block: BlockEntry) -> NDArray[np.int64]:
        """(n,) gid of a block that has them itself."""
        assert isinstance(block.gids, Piece)
        gid = raw.decode(self.bytes_of(block.gids), "i8", (block.bodies,))
        if (np.diff(gid) <= 0).any():
            raise DamageError("numbers of bodies are not ascending")
        return gid

    def record(self, row: NDArray, number: int, start: int, known: Sequence[Record]) -> Record:
        """Chunk `number`, whose record starts at `start`; `known` are those before."""
        end, length = int(row[0]), int(row[1]) >> 32
        if not start + length <= end <= len(self._data):
            raise DamageError(f"'index': row {number} points out of 'data'")
        head = self._data[start : start + length].tobytes()
        if index_row(head, number, start, end) != ROW.pack(*row.tolist()):
            raise DamageError(f"chunk {number}: the checksum of its head does not agree")
        try:
            return _Head(self, start + length, end).record(msgpack.unpackb(head), start, known)
        except (ValueError, TypeError, IndexError, OverflowError, msgpack.UnpackException) as error:
            raise DamageError(f"chunk {number}: its head is none: {error}") from None
        except DamageError as damage:
            raise DamageError(f"chunk {number}: {damage}") from None


class _Head:
    """Goes through the entries of a head, and the pieces behind it, in the same order."""

    def __init__(self, reader: RecordReader, start: int, end: int) -> None:
        self._reader = reader
        self._place = start
        self._end = end

    def record(self, head: Any, start: int, known: Sequence[Record]) -> Record:
        steps_entry, times_entry, block_entries = head
        steps = self._steps(steps_entry)
        times = self._times(times_entry, steps)
        blocks = tuple(
            self._block(entry, place, len(steps), known)
            for place, entry in enumerate(block_entries)
        )
        if not ascend(steps, known[-1].steps[-1] if known else None):
            raise DamageError("steps do not ascend")
        if self._place != self._end:
            raise ValueError("pieces do not fill it")
        return Record(steps, times, blocks, start, self._end)

    def _piece(self, length: Any, checksum: Any) -> Piece:
        piece = Piece(self._place, _whole(length, self._end - self._place), _whole(checksum))
        self._place += piece.length
        return piece

    def _array(self, entry: Any, dtype: str, count: int) -> NDArray:
        return raw.decode(self._reader.bytes_of(self._piece(*entry)), dtype, (count,))

    def _steps(self, entry: Any) -> NDArray:
        if len(entry) == 3:
            first, stride, count = (int(number) for number in entry)
            return first + stride * np.arange(_whole(count, _MAX_STEPS), dtype=np.int64)
        count, piece = entry
        return self._array(piece, "i8", _whole(count, _MAX_STEPS))

    def _times(self, entry: Any, steps: NDArray) -> NDArray:
        if entry is None:
            return self._reader.header.settings.step_size * steps.astype(np.float64)
        if isinstance(entry[0], float):
            start, width = entry
            return start + width * np.arange(len(steps))
        return self._array(entry, "f8", len(steps))

    def _block(self, entry: Any, place: int, steps: int, known: Sequence[Record]) -> BlockEntry:
        gids_entry, presence_entry, field_entries = entry
        gids: Piece | int
        if isinstance(gids_entry, int):
            gids = _whole(gids_entry, len(known) - 1)
            source = known[gids].blocks[place]
            if not isinstance(source.gids, Piece):
                raise ValueError("numbers of bodies are not where they should be")
            bodies = source.bodies
        else:
            bodies = _whole(gids_entry[0], MAX_ENTRIES // max(steps, 1))
            gids = self._piece(*gids_entry[1:])
        presence, present = None, steps * bodies
        if presence_entry is not None:
            present = _whole(presence_entry[0], steps * bodies)
            presence = self._piece(*presence_entry[1:])
        specs = list(self._reader.header.fields.values())
        if len(field_entries) != len(specs):
            raise ValueError(f"{len(field_entries)} fields")
        fields = tuple(
            self._field(part, present * spec.width)
            for part, spec in zip(field_entries, specs, strict=True)
        )
        return BlockEntry(bodies, gids, presence, present, fields)

    def _field(self, entry: Any, count: int) -> FieldEntry:
        coder, length, checksum, errors = entry
        name = CODERS[_whole(coder, len(CODERS) - 1)]
        piece = self._piece(length, checksum)
        return FieldEntry(name, piece, Errors(count, *_ERRORS.unpack(errors)))


def _whole(number: Any, most: int = 2**32 - 1) -> int:
    """A whole number in [0, most], ValueError for anything else."""
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number <= most:
        raise ValueError(f"{number!r} is no number from 0 to {most}")
    return number


# ---- files ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Places:
    """Where the bytes of `index` and of `data` begin in a file."""

    index: int
    data: int


def create(path: Path, header: Header, rows: int, size: int, *, complete: bool) -> Places:
    """Make an archive with space for so many rows of the index and bytes of data."""
    text = header.text()
    with _new_file(path) as file:
        attributes = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "header_checksum": zlib.crc32(text),
            "complete": int(complete),
        }
        write_attributes(file, attributes)
        kind = h5t.py_create(np.dtype(f"S{len(text)}"))
        _dataset(file, "header", kind, ()).write(h5s.ALL, h5s.ALL, np.array(text), kind)
        index = _dataset(file, "index", h5t.STD_U64LE, (rows, 2))
        data = _dataset(file, "data", h5t.STD_U8LE, (size,))
        return _places(index, data)


def _places(index: h5d.DatasetID, data: h5d.DatasetID) -> Places:
    return Places(index.get_offset() or 0, data.get_offset() or 0)


def _new_file(path: Path) -> h5py.File:
    """An empty HDF5 file without the time of its making: the same chunks make the same bytes."""
    creation = h5p.create(h5p.FILE_CREATE)
    creation.set_obj_track_times(False)
    access = h5p.create(h5p.FILE_ACCESS)
    access.set_libver_bounds(h5f.LIBVER_V18, h5f.LIBVER_V110)
    access.set_fclose_degree(h5f.CLOSE_STRONG)
    return h5py.File(h5f.create(os.fsencode(path), h5f.ACC_TRUNC, creation, access))


def _dataset(file: h5py.File, name: str, kind: h5t.TypeID, shape: tuple[int, ...]) -> h5d.DatasetID:
    """A data set in one piece whose space is taken at once, and not filled."""
    properties = h5p.create(h5p.DATASET_CREATE)
    properties.set_layout(h5d.CONTIGUOUS)
    properties.set_alloc_time(h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5d.FILL_TIME_NEVER)
    properties.set_obj_track_times(False)
    space = h5s.create_simple(shape) if shape else h5s.create(h5s.SCALAR)
    return h5d.create(file.id, name.encode(), kind, space, properties)


@dataclass(frozen=True)
class OpenFile:
    """An archive's file open for reading, and what its head says."""

    file: h5py.File
    header: Header
    complete: bool
    records: tuple[Record, ...]
    reader: RecordReader

    @property
    def places(self) -> Places:
        """Where its bytes begin."""
        return _places(self.file["index"].id, self.file["data"].id)


def open_archive(path: Path | str) -> OpenFile:
    """Open an archive and read all heads of records.

    Raises InputError if there is no such file, DataError if it is none, damaged or refused.
    """
    file = open_checked(path)
    try:
        return _opened(file)
    except DamageError as damage:
        file.close()
        raise DataError(f"{path}: {damage}") from None
    except HDF5_ERRORS as error:
        file.close()
        raise DataError(f"{path}: damaged: {reason(error)}") from None
    except BaseException:
        file.close()
        raise


def _opened(file: h5py.File) -> OpenFile:
    if "format" not in file.attrs or read_attribute(file, "format") != FORMAT:
        raise DamageError("not an archive of compressed fields")
    version = read_attribute(file, "format_version")
    if version != FORMAT_VERSION:
        raise DamageError(f"format {version}, this program reads {FORMAT_VERSION}")
    complete = read_attribute(file, "complete")
    if complete not in (0, 1):
        raise DamageError(f"damaged: attribute 'complete' is {complete}")
    text = _plain_dataset(file, "header", "S", 0)[()]
    if zlib.crc32(text) != read_attribute(file, "header_checksum"):
        raise DamageError("damaged: the checksum of 'header' does not agree")
    header = Header.from_text(text)
    index = _plain_dataset(file, "index", "u8", 2)
    data = _plain_dataset(file, "data", "u1", 1)
    if index.shape[1] != 2:
        raise DamageError(f"damaged: 'index' has {index.shape[1]} columns")
    reader = RecordReader(header, data)
    try:
        records = _records(reader, index[()], len(data), bool(complete))
    except DamageError as damage:
        raise DamageError(f"damaged: {damage}") from None
    return OpenFile(file, header, bool(complete), records, reader)


def _records(reader: RecordReader, rows: NDArray, size: int, complete: bool) -> tuple[Record, ...]:
    used = len(rows) if complete else int((rows != 0).any(axis=1).sum())
    if (rows[used:] != 0).any():
        raise DamageError("'index' has gaps")
    records: list[Record] = []
    start = 0
    for number, row in enumerate(rows[:used]):
        records.append(reader.record(row, number, start, records))
        start = records[-1].end
    if complete and start != size:
        raise DamageError(f"'data' has {size} bytes, chunks {start}")
    return tuple(records)


def _plain_dataset(file: h5py.File, name: str, kind: str, dimensions: int) -> h5py.Dataset:
    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise DamageError(f"damaged: '{name}' is missing")
    found = dataset.dtype.kind if kind == "S" else dataset.dtype.str[1:]
    if found != kind or dataset.ndim != dimensions:
        raise DamageError(f"damaged: '{name}' is {dataset.dtype} {dataset.shape}")
    return dataset
