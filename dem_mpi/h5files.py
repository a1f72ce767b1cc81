"""HDF5 files that all ranks write together and nobody has to trust.

`SharedFile` is one file on any number of ranks: MPI-IO where h5py is built with it, else block by
block through rank 0; the data sets come out the same. `open_checked` opens a file of unknown
origin and refuses what could reach outside it or claim absurd memory. `checksum` does not depend
on how rows are spread over ranks. `OutputLock` keeps a second run away from the same output.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import math
import os
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5d, h5f, h5fd, h5l, h5o, h5p, h5s, h5t
from numpy.typing import DTypeLike, NDArray

from dem_mpi.errors import DataError, DemError, InputError, OutputError
from dem_mpi.parallel import Parallel

# What h5py raises when HDF5 reports an error, by the class of the error.
HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError, OverflowError)

_MAX_OBJECTS = 10_000
_MAX_DEFLATE_RATIO = 1100  # deflate cannot shrink by more than 1032
_UNCHECKED_BYTES = 1 << 20
_BLOCK_WORDS = 1 << 14  # a block of checksum words stays in the first-level cache


# ---- errors that all ranks share -----------------------------------------------------------


def reason(error: BaseException) -> str:
    """What HDF5 or the system said, on one line."""
    text = str(error.strerror if isinstance(error, OSError) and error.strerror else error)
    first = next((line.strip() for line in text.splitlines() if line.strip()), "")
    inner = first[first.find("(") + 1 : first.rfind(")")]
    return inner if first.startswith("Unable to") and inner else first or type(error).__name__


@contextlib.contextmanager
def agree(
    parallel: Parallel, path: Path | str, action: str, kind: type[DemError] = OutputError
) -> Iterator[None]:
    """Collective. Run the block on every rank; if it fails on one, raise `kind` on all of them."""
    problem: Exception | None = None
    try:
        yield
    except DemError as error:
        problem = error
    except HDF5_ERRORS as error:
        problem = kind(f"{path}: cannot {action}: {reason(error)}")
    parallel.raise_together(problem)


def require_space(path: Path | str, needed: int) -> None:
    """Raise OutputError unless the file system of `path` has `needed` bytes [B] free."""
    place = Path(path).absolute()
    while not place.exists():
        place = place.parent
    status = os.statvfs(place)
    free = status.f_bavail * status.f_frsize
    if free < needed:
        raise OutputError(
            f"{path}: not enough disk space: {readable_size(needed)} needed, "
            f"{readable_size(free)} free"
        )


def readable_size(size: int) -> str:
    """A number of bytes for people: '3.2 MiB'."""
    value, unit = float(size), "B"
    for unit in ("B", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB"):  # noqa: B007
        if value < 1024:
            break
        value /= 1024
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"


# ---- checksums -----------------------------------------------------------------------------


def checksum(rows: NDArray, first_row: int = 0) -> int:
    """The sum modulo 2⁶⁴ of a hash of every word of `rows` and its place in the whole array.

    The sum over ranks of their rows' checksums is the checksum of all rows, however they are
    split; `first_row` is the place of rows[0]. A hash is one-to-one for a fixed place, so any
    single changed word is found for certain.
    """
    width = math.prod(rows.shape[1:])
    words = _words(rows)
    per_row = width * (rows.dtype.itemsize // words.dtype.itemsize)
    total = 0
    for start in range(0, words.size, _BLOCK_WORDS):
        block = words[start : start + _BLOCK_WORDS].astype(np.uint64)
        place = np.arange(block.size, dtype=np.uint64)
        place += np.uint64((first_row * per_row + start) % 2**64)
        total += int(_hash(block, place).sum(dtype=np.uint64))
    return total % 2**64


def row_checksums(rows: NDArray) -> NDArray:
    """The checksum of each row by itself: (T, k) of 8-byte numbers to (T,) uint64."""
    words = np.ascontiguousarray(rows).view(np.uint64)
    place = np.broadcast_to(np.arange(words.shape[1], dtype=np.uint64), words.shape)
    return _hash(words.copy(), place.copy()).sum(axis=1, dtype=np.uint64)


def _hash(words: NDArray, place: NDArray) -> NDArray:
    """Hash words in place; both arguments are overwritten."""
    place *= np.uint64(0x9E3779B97F4A7C15)
    words ^= place
    # The finaliser of MurmurHash3 (A. Appleby), a bijection of 64-bit words.
    words ^= words >> np.uint64(33)
    words *= np.uint64(0xFF51AFD7ED558CCD)
    words ^= words >> np.uint64(33)
    words *= np.uint64(0xC4CEB9FE1A85EC53)
    words ^= words >> np.uint64(33)
    return words


def _words(rows: NDArray) -> NDArray:
    flat = np.ascontiguousarray(rows).reshape(-1)
    size = flat.dtype.itemsize
    return flat.view(f"u{size}") if size in (1, 2, 4, 8) else flat.view(np.uint8)


def row_blocks(start: int, stop: int, row_bytes: int, block_bytes: int = 1 << 24) -> Iterator:
    """Cut rows [start, stop) into (first, last) pieces of about `block_bytes` [B]."""
    step = max(1, block_bytes // max(1, row_bytes))
    for first in range(start, stop, step):
        yield first, min(stop, first + step)


def dataset_checksum(dataset: h5py.Dataset, start: int, stop: int, first_row: int = 0) -> int:
    """The checksum of rows [start, stop) of a data set, read in blocks.

    `first_row` is the place of row `start` in the array that the checksum is of.
    """
    total = 0
    row_bytes = dataset.dtype.itemsize * math.prod(dataset.shape[1:])
    for first, last in row_blocks(start, stop, row_bytes):
        total += checksum(dataset[first:last], first_row + first - start)
    return total % 2**64


# ---- one file, all ranks -------------------------------------------------------------------


class SharedFile:
    """One HDF5 file open for writing on all ranks.

    With MPI-IO every rank holds the file; otherwise rank 0 alone does and `file` is None on the
    others. Changes of structure stand under `if shared.file is not None`, which is then the same
    code for both; rows go through `write_rows`. `by_all` tells which of the two it is.
    """

    def __init__(
        self,
        parallel: Parallel,
        path: Path | str,
        mode: str,
        *,
        libver: tuple[str, str],
        through_root: bool | None = None,
        expected_size: int = 0,
    ) -> None:
        """Collective. Open, or with mode "w" create; `expected_size` [B] of a new file is reserved.

        `through_root` forces or forbids writing through rank 0; None asks h5py. Raises OutputError
        on every rank if the file cannot be opened or the disk cannot hold it.
        """
        self.parallel = parallel
        self.path = Path(path)
        self.file: h5py.File | None = None
        alone = parallel.size == 1
        self.by_all = not alone and not (
            (not h5py.get_config().mpi) if through_root is None else through_root
        )
        # HDF5's own lock fails on some network file systems; `OutputLock` does its work. Without
        # the chunk cache an error belongs to the write that causes it, not to closing.
        options: dict[str, Any] = {"libver": libver, "locking": False, "rdcc_nbytes": 0}
        if self.by_all:
            options |= {"driver": "mpio", "comm": parallel.communicator}
        if expected_size:
            with agree(parallel, path, "reserve space"):
                if parallel.rank == 0:
                    _reserve_blocks(self.path, expected_size)
        with agree(parallel, path, "open for writing"):
            if self.by_all or parallel.rank == 0:
                self.file = h5py.File(self.path, mode, **options)
        self._transfer = h5p.create(h5p.DATASET_XFER)
        if self.by_all:
            self._transfer.set_dxpl_mpio(h5fd.MPIO_COLLECTIVE)
        if expected_size:  # again: creating the file has emptied it
            self.reserve(expected_size)

    def create_dataset(
        self,
        name: str,
        shape: tuple[int, ...],
        dtype: DTypeLike,
        *,
        chunk_rows: int = 0,
        compression: str = "none",
    ) -> h5py.Dataset:
        """Create a data set (on ranks that hold the file); `chunk_rows` makes it extensible.

        Its space in the file is taken at once, and again by each change of its extent, so that
        writing rows changes no metadata.
        """
        assert self.file is not None
        properties = h5p.create(h5p.DATASET_CREATE)
        properties.set_fill_time(h5d.FILL_TIME_NEVER)
        properties.set_obj_track_times(False)
        limit = shape
        if chunk_rows:
            properties.set_chunk((chunk_rows, *shape[1:]))
            limit = (h5s.UNLIMITED, *shape[1:])
        if compression == "gzip":
            properties.set_shuffle()
            properties.set_deflate(4)
        else:
            properties.set_alloc_time(h5d.ALLOC_TIME_EARLY)
        links = h5p.create(h5p.LINK_CREATE)
        links.set_create_intermediate_group(True)
        identifier = h5d.create(
            self.file.id,
            name.encode(),
            h5t.py_create(np.dtype(dtype), logical=True),
            h5s.create_simple(shape, limit),
            dcpl=properties,
            lcpl=links,
        )
        return h5py.Dataset(identifier)

    def write_rows(self, name: str, start: int, rows: NDArray) -> None:
        """Collective. Write the ranks' rows, in rank order, from global row `start` on.

        Ranks may have no rows. All ranks' rows share dtype and trailing shape. Raises OutputError
        on every rank if one of them cannot write.
        """
        rows = np.ascontiguousarray(rows)
        with agree(self.parallel, self.path, f"write '{name}'"):
            if self.by_all:
                self._write(name, start + self.parallel.exclusive_sum(rows.shape[0]), rows)
            else:
                self._write_through_root(name, start, rows)

    def _write(self, name: str, start: int, rows: NDArray) -> None:
        assert self.file is not None
        dataset = self.file[name].id
        space = dataset.get_space()
        if rows.size:
            memory = h5s.create_simple(rows.shape)
            space.select_hyperslab((start,) + (0,) * (rows.ndim - 1), rows.shape)
        else:
            # A collective write needs this rank too; h5py's own indexing would leave it out.
            rows = np.empty((1, *(max(1, k) for k in rows.shape[1:])), dtype=rows.dtype)
            memory = h5s.create_simple(rows.shape)
            memory.select_none()
            space.select_none()
        dataset.write(memory, space, rows, dxpl=self._transfer)

    def _write_through_root(self, name: str, start: int, rows: NDArray) -> None:
        problem: Exception | None = None
        for block in self.parallel.blocks_on_root(rows):
            # After an error the blocks are still received: their senders wait for that.
            if problem is None and block.size:
                try:
                    self._write(name, start, block)
                except HDF5_ERRORS as error:
                    problem = error
            start += block.shape[0]
        if problem is not None:
            raise problem

    def write_on_root(self, rows: Mapping[str, tuple[int, Any]]) -> None:
        """Collective. Rank 0 writes {name: (first row, rows)}, small things that all know."""
        with agree(self.parallel, self.path, "write"):
            if self.parallel.rank == 0:
                assert self.file is not None
                for name, (start, values) in rows.items():
                    values = np.asarray(values)
                    self.file[name][start : start + values.shape[0]] = values

    def flush(self) -> None:
        """Collective. Hand everything to the operating system."""
        with agree(self.parallel, self.path, "write"):
            if self.file is not None:
                h5f.flush(self.file.id)

    def reserve(self, more: int = 0) -> None:
        """Collective. Take the disk blocks of the whole file and of `more` bytes [B] behind it.

        HDF5 allocates space in a file without the file system knowing. Reserving it beforehand
        makes a full disk show as an error while nothing is half written; a rank that fails to
        flush HDF5's own structures through MPI-IO would leave the others waiting.
        """
        with agree(self.parallel, self.path, "reserve space"):
            if self.parallel.rank == 0:
                _reserve_blocks(self.path, self.path.stat().st_size + more)

    def sync(self) -> None:
        """Collective. Flush to the disk itself."""
        self.flush()
        with agree(self.parallel, self.path, "write"):
            if self.file is not None:
                fsync(self.path)

    def close(self) -> None:
        """Collective. Close and give back what was reserved; a second call does nothing."""
        file, self.file = self.file, None
        with agree(self.parallel, self.path, "close"):
            if file is not None:
                file.close()
        with agree(self.parallel, self.path, "close"):
            if file is not None and self.parallel.rank == 0:
                _give_back_blocks(self.path)

    def abandon(self) -> None:
        """Collective. Close after a reported error; what closing says now adds nothing."""
        with contextlib.suppress(OutputError):
            self.close()


def _reserve_blocks(path: Path, size: int) -> None:
    if not size:
        return
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
            raise
    finally:
        os.close(descriptor)


def _give_back_blocks(path: Path) -> None:
    """Cut a closed file where HDF5 says it ends: superblock versions 2 and 3, bytes 28 to 35."""
    with path.open("r+b") as file:
        head = file.read(36)
        version, offset_bytes = head[8:10]
        end = int.from_bytes(head[28:36], "little")
        if version in (2, 3) and offset_bytes == 8 and end < path.stat().st_size:
            file.truncate(end)


def fsync(path: Path) -> None:
    """Put a file's bytes, or a directory's entries, on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_attributes(target: Any, attributes: Mapping[str, Any]) -> None:
    """Store numbers and texts on a file, group or data set, the same ones on every rank.

    Texts get a fixed length: those of variable length lie in a heap without checksums, where one
    changed byte can crash HDF5 1.10.
    """
    for name, value in attributes.items():
        if name in target.attrs:
            # h5py would write one of a random name, another on each rank, and rename it; but
            # ranks that change a file together must make the same change.
            del target.attrs[name]
        if isinstance(value, str):
            text = value.encode()
            kind = h5py.string_dtype("utf-8", max(1, len(text)))
            target.attrs.create(name, np.array(text, dtype=kind))
        else:
            target.attrs[name] = value


def read_attributes(source: Any) -> dict[str, Any]:
    """The attributes of an object as Python numbers, texts and lists."""
    return {name: read_attribute(source, name) for name in source.attrs}


def read_attribute(source: Any, name: str) -> Any:
    """An attribute as Python numbers or text; DataError for what `write_attributes` never writes.

    Raises KeyError if there is none of that name.
    """
    if name not in source.attrs:
        raise KeyError(f"attribute '{name}' of '{source.name}' is missing")
    kind = h5py.h5a.open(source.id, name.encode()).get_type()
    plain_text = kind.get_class() == h5t.STRING and not kind.is_variable_str()
    if not plain_text and kind.get_class() not in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM):
        raise DataError(
            f"{source.file.filename}: attribute '{name}' of '{source.name}' is neither a number "
            "nor a text of fixed length: refused"
        )
    return plain(source.attrs[name])


def attributes_checksum(attributes: Mapping[str, Any]) -> int:
    """A checksum of numbers and texts: HDF5 keeps texts where it does not check them."""
    text = json.dumps(attributes, sort_keys=True, default=plain)
    return checksum(np.frombuffer(text.encode("utf-8", "replace"), dtype=np.uint8))


def plain(value: Any) -> Any:
    """Python numbers and texts for what numpy and HDF5 make of them."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


# ---- files of unknown origin ---------------------------------------------------------------


def open_checked(path: Path | str) -> h5py.File:
    """Open a file for reading after looking at every object in it.

    Raises InputError (64) if there is none, DataError (65) if it is no HDF5 file, is cut off, or
    holds what is refused: links by name or to other files, data stored elsewhere, types that are
    not plain numbers or fixed texts, and shapes without the bytes to fill them.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if not path.is_file():
        raise DataError(f"{path}: not a file")
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the file is empty")
    try:
        if not h5py.is_hdf5(path):
            raise DataError(f"{path}: not an HDF5 file")
        file = h5py.File(path, "r", locking=False)
    except HDF5_ERRORS as error:
        raise DataError(f"{path}: cannot be opened as HDF5: {reason(error)}") from None
    try:
        _check_group(path, file, seen=set())
    except DataError:
        file.close()
        raise
    except (*HDF5_ERRORS, RecursionError) as error:
        file.close()
        raise DataError(f"{path}: damaged: {reason(error)}") from None
    return file


def _check_group(path: Path, group: h5py.Group, seen: set[int]) -> None:
    for name in group:
        if isinstance(name, bytes):  # what h5py gives where a name is no UTF-8
            raise DataError(f"{path}: damaged: a name in '{group.name}' is not text")
        place = f"{group.name.rstrip('/')}/{name}"
        link = group.id.links.get_info(name.encode())
        if link.type != h5l.TYPE_HARD:
            raise DataError(f"{path}: '{place}' is a link by name or to another file: refused")
        item = group[name]
        address = h5o.get_info(item.id).addr
        if address in seen:
            continue
        seen.add(address)
        if len(seen) > _MAX_OBJECTS:
            raise DataError(f"{path}: more than {_MAX_OBJECTS} objects: refused")
        if isinstance(item, h5py.Group):
            _check_group(path, item, seen)
        elif isinstance(item, h5py.Dataset):
            _check_dataset(path, item, place)
        else:
            raise DataError(f"{path}: '{place}' is neither a group nor a data set: refused")


def _check_dataset(path: Path, dataset: h5py.Dataset, place: str) -> None:
    properties = dataset.id.get_create_plist()
    layout = properties.get_layout()
    if properties.get_external_count():
        raise DataError(f"{path}: '{place}' has its data in another file: refused")
    if layout not in (h5d.COMPACT, h5d.CONTIGUOUS, h5d.CHUNKED):
        raise DataError(f"{path}: '{place}' is a view of other data sets: refused")
    if dataset.dtype.kind not in "biufS" or dataset.dtype.hasobject:
        raise DataError(
            f"{path}: '{place}' holds {dataset.dtype}, not plain numbers or texts: refused"
        )
    if dataset.shape is None:
        raise DataError(f"{path}: '{place}' has no extent: refused")
    claimed = math.prod(dataset.shape) * dataset.dtype.itemsize
    stored = min(dataset.id.get_storage_size(), path.stat().st_size)
    ratio = _MAX_DEFLATE_RATIO if properties.get_nfilters() else 1
    if layout != h5d.COMPACT and claimed > max(_UNCHECKED_BYTES, ratio * stored):
        raise DataError(
            f"{path}: '{place}' claims shape {dataset.shape} ({readable_size(claimed)}) but only "
            f"{readable_size(stored)} are stored: refused"
        )


# ---- one writer at a time ------------------------------------------------------------------


class OutputLock:
    """The right to write an output, held by rank 0 of one run at a time.

    The kernel drops it when the process ends, however it ends, so a lock file that a killed run
    leaves behind holds nobody up.
    """

    def __init__(self, parallel: Parallel, path: Path | str) -> None:
        """Collective. Take the lock of output `path` or raise OutputError naming its holder."""
        self.path = Path(f"{path}.lock")
        self._descriptor: int | None = None
        with agree(parallel, path, "lock"):
            if parallel.rank == 0:
                self._descriptor = _take_lock(self.path, Path(path))

    def release(self) -> None:
        """Give the lock up and remove its file; a second call does nothing."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            self.path.unlink(missing_ok=True)
            os.close(descriptor)


def _take_lock(lock: Path, path: Path) -> int:
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 200).decode("utf-8", "replace").strip()
            os.close(descriptor)
            raise OutputError(
                f"{path}: another run is writing it ({holder or 'unknown process'})"
            ) from None
        except OSError:
            os.close(descriptor)
            raise
        # The last holder may have removed the file between our opening and locking it.
        if _is_same_file(descriptor, lock):
            break
        os.close(descriptor)
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
    return descriptor


def _is_same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def lock_holder(path: Path | str) -> str:
    """Who writes output `path` now: '' for nobody."""
    try:
        descriptor = os.open(f"{path}.lock", os.O_RDONLY)
    except OSError:
        return ""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return os.read(descriptor, 200).decode("utf-8", "replace").strip() or "another process"
    except OSError:
        return ""
    finally:
        os.close(descriptor)
    return ""
