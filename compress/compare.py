"""Errors between what was and what is: arrays, archives, chunk by chunk.

Symbols: X the reference, Y what is compared with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from compress.archive_reader import Archive, Restored
from compress.bounds import Errors, measure
from compress.coding import Chunk
from dem_mpi.errors import InputError


def compare_arrays(reference: NDArray, other: NDArray) -> Errors:
    """Errors of `other` against `reference`, arrays of one shape; InputError if they are not."""
    if reference.shape != other.shape:
        raise InputError(f"shapes {reference.shape} and {other.shape} cannot be compared")
    return measure(reference, other)


def compare_archives(reference: Archive, other: Archive) -> dict[str, Errors]:
    """Errors of each field that both have, in the frames that both have, chunk by chunk.

    Raises InputError where they have no field or no frame in common, or bodies differ.
    """
    names = _common(reference.fields, other.fields)
    total = {name: Errors() for name in names}
    common = False
    for part in reference.iterate(names):
        frames = np.searchsorted(other.steps, part.steps)
        frames = frames[(frames < len(other.steps))]
        if not len(frames):
            continue
        found = other.read(names, slice(int(frames[0]), int(frames[-1]) + 1))
        steps, here, there = np.intersect1d(part.steps, found.steps, return_indices=True)
        common |= bool(len(steps))
        for name, errors in _of_frames(part, here, found, there, names).items():
            total[name] += errors
    if not common:
        raise InputError(f"{reference.path} and {other.path} have no step in common")
    return total


def compare_with_chunks(archive: Archive, chunks: Iterable[Chunk]) -> dict[str, Errors]:
    """Errors of an archive against the chunks it was made of, in their order."""
    total = {name: Errors() for name in archive.fields}
    for chunk, frames in zip(chunks, archive.chunks, strict=True):
        restored = archive.read(steps=frames)
        if not np.array_equal(restored.steps, chunk.steps):
            raise InputError(f"{archive.path}: other steps than those compared with")
        for block in chunk.blocks:
            columns = np.searchsorted(restored.gid, block.gid)
            there = restored.present[:, columns]
            for name in total:
                decoded = restored.fields[name][:, columns]
                total[name] += measure(block.fields[name][there], decoded[there])
    return total


def _common(a: Mapping[str, object], b: Mapping[str, object]) -> list[str]:
    names = [name for name in a if name in b]
    if not names:
        raise InputError(f"no field in common: {', '.join(a)} and {', '.join(b)}")
    return names


def _of_frames(
    a: Restored, here: NDArray, b: Restored, there: NDArray, names: list[str]
) -> dict[str, Errors]:
    """Errors of frames `there` of b against frames `here` of a."""
    if not np.array_equal(a.gid, b.gid) or not np.array_equal(a.present[here], b.present[there]):
        raise InputError("other bodies are present in one than in the other")
    present = a.present[here]
    return {
        name: measure(a.fields[name][here][present], b.fields[name][there][present])
        for name in names
    }
