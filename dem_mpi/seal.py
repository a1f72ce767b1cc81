"""A seal behind a finished HDF5 file: a checksum of its structures, looked at before HDF5 is.

HDF5 checks its structures too, but 1.10 may crash over what it then finds damaged (leaves of link
trees, heap blocks), and a program that has crashed cannot fall back to another file.

Layout, little-endian, behind the last byte of HDF5: k pairs (first, last + 1) of uint64, the bytes
of data sets, which have checksums of their own; then k, the length of the HDF5 file and the
checksum of all other bytes and of the pairs, uint64 each; then `MAGIC`.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi.errors import DataError
from dem_mpi.h5files import checksum

MAGIC = b"dem-mpi\x1a"
_WORDS = 3
_END = 8 * _WORDS + len(MAGIC)


def write_seal(path: Path) -> None:
    """Seal a closed HDF5 file. Raises OSError if the disk cannot hold it."""
    length = path.stat().st_size
    data = _data_bytes(path)
    tail = np.array([len(data), length, _checksum(path, data, length)], dtype="<u8")
    with path.open("ab") as file:
        file.write(data.tobytes() + tail.tobytes() + MAGIC)


def check_seal(path: Path) -> bool:
    """Whether a file has a seal. Raises DataError if the seal or what it seals is damaged."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - _END))
        end = file.read()
        if not end.endswith(MAGIC):
            return False
        pairs, length, stored = map(int, np.frombuffer(end[: 8 * _WORDS], dtype="<u8"))
        if length + 16 * pairs + _END != size:
            raise DataError(f"{path}: the seal at its end does not fit its size")
        file.seek(length)
        data = np.frombuffer(file.read(16 * pairs), dtype="<u8").reshape(-1, 2)
    edges = np.concatenate(([0], data.ravel(), [length]))
    if (edges[1:] < edges[:-1]).any() or _checksum(path, data, length) != stored:
        raise DataError(f"{path}: checksum of the file's structures does not match")
    return True


def _data_bytes(path: Path) -> NDArray:
    """(k, 2) the bytes of all data sets that stand in one piece, ascending."""
    found: list[tuple[int, int]] = []

    def add(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset) and item.id.get_offset() is not None:
            first = item.id.get_offset()
            found.append((first, first + item.id.get_storage_size()))

    with h5py.File(path, "r", locking=False) as file:
        file.visititems(add)
    return np.array(sorted(found), dtype="<u8").reshape(-1, 2)


def _checksum(path: Path, data: NDArray, length: int) -> int:
    """Of all bytes outside `data` (k, 2), each with its place, and of `data` itself."""
    total = checksum(data, first_row=length)
    gaps = np.concatenate(([0], data.ravel(), [length])).astype(np.int64).reshape(-1, 2)
    with path.open("rb") as file:
        for first, last in gaps.tolist():
            file.seek(first)
            total += checksum(np.frombuffer(file.read(last - first), dtype=np.uint8), first)
    return total % 2**64
