"""Reading archives: only what is asked is decoded, and nothing in the file is trusted."""

from __future__ import annotations

import contextlib
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from compress import coders, raw
from compress.archive_format import (
    MAX_ENTRIES,
    ROW,
    BlockEntry,
    DamageError,
    FieldEntry,
    Piece,
    Record,
    open_archive,
)
from compress.bounds import Errors
from compress.coding import FieldSpec, Settings, increments, presence_mask
from dem_mpi.errors import DataError, InputError
from dem_mpi.h5files import HDF5_ERRORS, reason

# Tables of body numbers kept decoded.
_TABLES = 64


@dataclass(frozen=True)
class Restored:
    """Decoded frames: steps (T,), times (T,) [s], gid (m,) ascending, fields {name: (T, m, w)}.

    present : (T, m) bool; where it is False, values are NaN, or 0 for integers.
    """

    steps: NDArray
    times: NDArray
    gid: NDArray
    present: NDArray
    fields: Mapping[str, NDArray]


class Archive:
    """An archive open for reading; also one that is interrupted or still being written.

    fields : {name: FieldSpec}; settings; provenance; complete; steps (F,) and times (F,) [s] of
    all frames; chunks : the frames of each chunk; decoded_pieces : of fields, decoded so far.
    """

    def __init__(self, path: Path | str) -> None:
        """Open. Raises InputError if there is no such file, DataError if it is damaged."""
        self.path = Path(path)
        self._open = open_archive(path)
        header = self._open.header
        self._records = self._open.records
        self.fields: Mapping[str, FieldSpec] = header.fields
        self.settings: Settings = header.settings
        self.provenance: Mapping[str, Any] = header.provenance
        self.complete: bool = self._open.complete
        self.decoded_pieces = 0
        self.steps: NDArray = _joined([r.steps for r in self._records], np.int64)
        self.times: NDArray = _joined([r.times for r in self._records], np.float64)
        ends = np.cumsum([0, *(len(r.steps) for r in self._records)]).tolist()
        self.chunks: tuple[slice, ...] = tuple(map(slice, ends[:-1], ends[1:]))
        self._tables: dict[tuple[int, int], NDArray] = {}

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._open.file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def gid(self) -> NDArray:
        """(m,) numbers of all bodies that any chunk has, ascending."""
        return self._bodies(range(len(self._records)), None)

    def read(
        self,
        fields: Sequence[str] | None = None,
        steps: slice = slice(None),
        bodies: slice | NDArray | None = None,
    ) -> Restored:
        """Decode frames `steps` (a slice of `self.steps`) of bodies: all, a range of gid, or some.

        Only chunks and blocks that hold some of it are decoded. Raises InputError for a field
        that there is not, DataError where the archive is damaged.
        """
        names = self._names(fields)
        frames = range(*steps.indices(len(self.steps)))
        wanted = sorted(frames)
        touched = {
            number: inside
            for number, chunk in enumerate(self.chunks)
            if (inside := _inside(chunk, wanted)) is not None
        }
        gid = self._bodies(list(touched), bodies)
        out = {name: _missing(self.fields[name], len(wanted), len(gid)) for name in names}
        present = np.zeros((len(wanted), len(gid)), np.bool_)
        for number, (place, chosen) in touched.items():
            self._read_chunk(number, names, chosen, gid, place, present, out)
        order = slice(None) if frames.step > 0 else slice(None, None, -1)
        kept = np.array(frames, dtype=np.int64)
        return Restored(
            self.steps[kept],
            self.times[kept],
            gid,
            present[order],
            {name: values[order] for name, values in out.items()},
        )

    def iterate(
        self,
        fields: Sequence[str] | None = None,
        steps: slice = slice(None),
        bodies: slice | NDArray | None = None,
    ) -> Iterator[Restored]:
        """What `read` gives, chunk by chunk, with the memory of one; `steps` without a stride."""
        first, stop, stride = steps.indices(len(self.steps))
        if stride != 1:
            raise ValueError("steps: cannot be iterated with a stride")
        for chunk in self.chunks:
            low, high = max(first, chunk.start), min(stop, chunk.stop)
            if low < high:
                yield self.read(fields, slice(low, high), bodies)

    def array(self, name: str, steps: slice = slice(None)) -> NDArray:
        """Frames of an array that is no set of bodies, in its own shape (T, ...)."""
        values = self.read([name], steps).fields[name]
        return values.reshape(len(values), *self.fields[name].shape)

    def errors(self, name: str, chunk: int | None = None) -> Errors:
        """Errors of a field as measured when it was coded, of one chunk or of all together."""
        (name,) = self._names([name])
        return sum((entry.errors for entry in self._entries(name, chunk)), Errors())

    def bytes_by_coder(self, name: str | None = None, chunk: int | None = None) -> dict[str, int]:
        """Bytes [B] by coder, of one field or all, of one chunk or all."""
        names = self.fields if name is None else self._names([name])
        sizes: dict[str, int] = {}
        for field in names:
            for entry in self._entries(field, chunk):
                sizes[entry.coder] = sizes.get(entry.coder, 0) + entry.piece.length
        return sizes

    def chunk_bytes(self, chunk: int) -> int:
        """Bytes [B] that a chunk takes in the file, all counted."""
        record = self._records[chunk]
        return record.end - record.start + ROW.size

    def verify(self) -> None:
        """Compare all checksums; DataError for the first that does not agree."""
        for number, record in enumerate(self._records):
            for place, block in enumerate(record.blocks):
                self._table(number, place)
                if block.presence is not None:
                    self._bytes(block.presence, number, "presence")
                for name, entry in zip(self.fields, block.fields, strict=True):
                    self._bytes(entry.piece, number, f"field '{name}'")

    def _names(self, fields: Sequence[str] | None) -> list[str]:
        names = list(self.fields) if fields is None else list(fields)
        for name in names:
            if name not in self.fields:
                raise InputError(f"{self.path}: no field '{name}': it has {', '.join(self.fields)}")
        return names

    def _entries(self, name: str, chunk: int | None) -> Iterator[FieldEntry]:
        place = list(self.fields).index(name)
        for record in self._records if chunk is None else (self._records[chunk],):
            for block in record.blocks:
                yield block.fields[place]

    def _bodies(self, chunks: Sequence[int], wanted: slice | NDArray | None) -> NDArray:
        gid = np.zeros(0, np.int64)
        seen: set[tuple[int, int]] = set()
        for number in chunks:
            for place in range(len(self._records[number].blocks)):
                source = self._source(number, place)
                if source not in seen:
                    seen.add(source)
                    gid = np.union1d(gid, _chosen(self._table(number, place), wanted))
        return gid

    def _read_chunk(
        self,
        number: int,
        names: Sequence[str],
        frames: NDArray,
        gid: NDArray,
        place: slice,
        present: NDArray,
        out: Mapping[str, NDArray],
    ) -> None:
        """Put frames of a chunk into rows `place` of `present` and `out`, bodies in columns."""
        record = self._records[number]
        for b, block in enumerate(record.blocks):
            table = self._table(number, b)
            rows = np.flatnonzero(np.isin(table, gid, assume_unique=True))
            if not len(rows):
                continue
            columns = np.searchsorted(gid, table[rows])
            there = self._presence(number, block)[frames][:, rows]
            cells = np.ix_(np.arange(place.start, place.stop), columns)
            present[cells] |= there
            decoded = self._decode(number, record, block, names, frames, rows)
            for name, values in decoded.items():
                out[name][cells] = np.where(there[:, :, None], values, out[name][cells])

    def _presence(self, number: int, block: BlockEntry) -> NDArray:
        steps = len(self._records[number].steps)
        if block.presence is None:
            return np.ones((steps, block.bodies), np.bool_)
        data = self._bytes(block.presence, number, "presence")
        with self._trusting(number, "presence"):
            return presence_mask(raw.decode(data, "i4", (2, block.bodies)), steps)

    def _decode(
        self,
        number: int,
        record: Record,
        block: BlockEntry,
        names: Sequence[str],
        frames: NDArray,
        rows: NDArray,
    ) -> dict[str, NDArray]:
        """Frames and rows of fields of a block; fields that guide others are decoded once."""
        entries = dict(zip(self.fields, block.fields, strict=True))
        guided = [n for n in names if entries[n].coder == coders.GUIDED]
        whole: dict[str, NDArray] = {}
        for name in guided:
            guide = self.fields[name].guide
            if guide is None:
                raise DataError(f"{self.path}: damaged: chunk {number}: nothing guides '{name}'")
            if guide not in whole:
                whole[guide] = self._decode_field(number, record, block, guide, None)
        result = {}
        for name in names:
            if name in whole:
                result[name] = whole[name][frames][:, rows]
                continue
            guide = None
            if name in guided:
                guide = increments(whole[self.fields[name].guide or ""], record.times)
            steps = slice(int(frames[0]), int(frames[-1]) + 1)
            part = self._decode_field(number, record, block, name, guide, steps, rows)
            result[name] = part[frames - frames[0]]
        return result

    def _decode_field(
        self,
        number: int,
        record: Record,
        block: BlockEntry,
        name: str,
        guide: NDArray | None,
        steps: slice = slice(None),
        rows: NDArray | slice = slice(None),
    ) -> NDArray:
        spec = self.fields[name]
        entry = block.fields[list(self.fields).index(name)]
        if len(record.steps) * block.bodies * spec.width > MAX_ENTRIES:
            raise DataError(f"{self.path}: chunk {number}: field '{name}' is absurdly large")
        data = self._bytes(entry.piece, number, f"field '{name}'")
        shape = (len(record.steps), block.bodies, spec.width)
        self.decoded_pieces += 1
        with self._trusting(number, f"field '{name}' ({entry.coder})"):
            return coders.decode(entry.coder, data, np.dtype(spec.dtype), shape, guide, steps, rows)

    def _table(self, number: int, place: int) -> NDArray:
        """The body numbers of a block."""
        key = self._source(number, place)
        if key not in self._tables:
            with self._trusting(key[0], "numbers of bodies"):
                table = self._open.reader.numbers(self._records[key[0]].blocks[place])
            if len(self._tables) >= _TABLES:
                del self._tables[next(iter(self._tables))]
            self._tables[key] = table
        return self._tables[key]

    def _source(self, number: int, place: int) -> tuple[int, int]:
        """The chunk that has the body numbers of a block, and the place of the block in it."""
        gids = self._records[number].blocks[place].gids
        return (number if isinstance(gids, Piece) else gids), place

    def _bytes(self, piece: Piece, number: int, what: str) -> bytes:
        with self._trusting(number, what):
            return self._open.reader.bytes_of(piece)

    @contextlib.contextmanager
    def _trusting(self, number: int, what: str) -> Iterator[None]:
        """What goes wrong inside is damage of a part of the file."""
        try:
            yield
        except (DamageError, AssertionError, IndexError, ArithmeticError, MemoryError) as error:
            problem: Exception = error
        except HDF5_ERRORS as error:
            problem = error
        else:
            return
        raise DataError(f"{self.path}: damaged: chunk {number}, {what}: {reason(problem)}")


def _joined(parts: list[NDArray], dtype: type) -> NDArray:
    return np.concatenate(parts).astype(dtype) if parts else np.zeros(0, dtype)


def _inside(chunk: slice, wanted: Sequence[int]) -> tuple[slice, NDArray] | None:
    """Where frames of a chunk stand among those wanted, and which of its frames they are."""
    first, stop = bisect_left(wanted, chunk.start), bisect_left(wanted, chunk.stop)
    if first == stop:
        return None
    return slice(first, stop), np.asarray(wanted[first:stop], np.int64) - chunk.start


def _chosen(gid: NDArray, wanted: slice | NDArray | None) -> NDArray:
    """Those of `gid` that are wanted: all, a range of numbers, or some."""
    if wanted is None:
        return gid
    if not isinstance(wanted, slice):
        return gid[np.isin(gid, wanted)]
    kept = np.ones(len(gid), np.bool_)
    if wanted.start is not None:
        kept &= gid >= wanted.start
    if wanted.stop is not None:
        kept &= gid < wanted.stop
    if wanted.step not in (None, 1):
        kept &= (gid - (wanted.start or 0)) % wanted.step == 0
    return gid[kept]


def _missing(spec: FieldSpec, steps: int, bodies: int) -> NDArray:
    dtype = np.dtype(spec.dtype)
    return np.full((steps, bodies, spec.width), np.nan if dtype.kind == "f" else 0, dtype)
