"""Errors between what was and what is: arrays, archives and all that is read alike, by chunks.

Symbols: X the reference, Y what is compared with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compress.archive_reader import Archive, Restored
from compress.bounds import Errors, largest, measure, norm
from compress.coding import Chunk
from dem_mpi.errors import InputError


@dataclass(frozen=True)
class Difference(Errors):
    """Errors of the entries that are finite in both, or the same.

    unlike : entries that are NaN or infinite in one and something else in the other
    """

    unlike: int = 0

    def __add__(self, other: Errors) -> Difference:
        """Those of both blocks together."""
        unlike = self.unlike + (other.unlike if isinstance(other, Difference) else 0)
        return _with_unlike(super().__add__(other), unlike)

    @property
    def equal(self) -> bool:
        """Whether all entries are the same."""
        return self.maximum == 0.0 and not self.unlike


class Values(Protocol):
    """What can be compared: steps are numbers, ascending; chunk : how many are read at a time."""

    path: str
    names: Sequence[str]
    steps: NDArray
    chunk: int

    def read(self, steps: NDArray, names: Sequence[str]) -> Restored:
        """Fields of these steps, which it has."""
        ...


@dataclass(frozen=True)
class Comparison:
    """What two have in common, and how far it differs.

    steps : how many both have; alone : rows, of a body in such a step, that one only has;
    fields : by their names in the first and the second
    """

    steps: int
    alone: int
    fields: dict[tuple[str, str], Difference]


def compare_arrays(reference: NDArray, other: NDArray) -> Difference:
    """Errors of `other` against `reference`, arrays of one shape; InputError if they are not.

    NaN, and infinity of one sign, equals itself. Whole numbers are subtracted exactly.
    """
    if reference.shape != other.shape:
        raise InputError(f"shapes {reference.shape} and {other.shape} cannot be compared")
    if reference.dtype.kind in "biu" and other.dtype.kind in "biu":
        return _of_integers(reference, other)
    finite = np.isfinite(reference) & np.isfinite(other)
    if finite.all():
        return _with_unlike(measure(reference, other), 0)
    x, y = reference[~finite], other[~finite]
    same = int(((x == y) | (np.isnan(x) & np.isnan(y))).sum())
    found = measure(reference[finite], other[finite]) + Errors(count=same)
    return _with_unlike(found, len(x) - same)


def compare(
    reference: Values, other: Values, names: Iterable[tuple[str, str]] | None = None
) -> Comparison:
    """Compare fields, by their names in the one and the other, where both have step and body.

    Without names these are the fields that both have. Raises InputError where they have no
    field, step or body in common, or a field has another width.
    """
    pairs = [(n, n) for n in reference.names if n in other.names] if names is None else list(names)
    both = f"{reference.path} and {other.path} have no"
    if not pairs:
        raise InputError(
            f"{both} field in common: {', '.join(reference.names)} and {', '.join(other.names)}"
        )
    steps = np.intersect1d(reference.steps, other.steps)
    if not len(steps):
        raise InputError(f"{both} step in common")
    total = {pair: Difference() for pair in pairs}
    alone = common = 0
    for k in range(0, len(steps), reference.chunk):
        some = steps[k : k + reference.chunk]
        left = reference.read(some, [x for x, _ in pairs])
        right = other.read(some, [y for _, y in pairs])
        _, i, j = np.intersect1d(left.gid, right.gid, return_indices=True)
        there = left.present[:, i] & right.present[:, j]
        common += int(there.sum())
        alone += int(left.present.sum() + right.present.sum() - 2 * there.sum())
        for x, y in pairs:
            one, two = left.fields[x][:, i][there], right.fields[y][:, j][there]
            if one.shape != two.shape:
                raise InputError(f"{other.path}: {y} has another width than in {reference.path}")
            total[x, y] += compare_arrays(one, two)
    if alone and not common:
        raise InputError(f"{both} body in common in the {len(steps):,} steps of both")
    return Comparison(len(steps), alone, total)


def compare_archives(reference: Archive, other: Archive) -> dict[str, Difference]:
    """Errors of each field that both have, where both have step and body; see `compare`."""
    found = compare(ArchiveValues(reference), ArchiveValues(other))
    return {name: errors for (name, _), errors in found.fields.items()}


def compare_with_chunks(archive: Archive, chunks: Iterable[Chunk]) -> dict[str, Difference]:
    """Errors of an archive against the chunks it was made of, in their order."""
    total = {name: Difference() for name in archive.fields}
    for chunk, frames in zip(chunks, archive.chunks, strict=True):
        restored = archive.read(steps=frames)
        if not np.array_equal(restored.steps, chunk.steps):
            raise InputError(f"{archive.path}: other steps than those compared with")
        for block in chunk.blocks:
            columns = np.searchsorted(restored.gid, block.gid)
            there = restored.present[:, columns]
            for name in total:
                decoded = restored.fields[name][:, columns]
                total[name] += compare_arrays(block.fields[name][there], decoded[there])
    return total


class ArchiveValues:
    """An archive as `compare` reads it."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self.path = str(archive.path)
        self.names = list(archive.fields)
        self.steps = archive.steps
        self.chunk = max((c.stop - c.start for c in archive.chunks), default=1)

    def read(self, steps: NDArray, names: Sequence[str]) -> Restored:
        """Fields of these steps; those between them are not kept."""
        first, last = np.searchsorted(self.steps, steps[[0, -1]]).tolist()
        found = self._archive.read(names, slice(first, last + 1))
        keep = np.isin(found.steps, steps)
        values = {name: field[keep] for name, field in found.fields.items()}
        return Restored(
            found.steps[keep], found.times[keep], found.gid, found.present[keep], values
        )


def _of_integers(x: NDArray, y: NDArray) -> Difference:
    """Of whole numbers of any type. Halves of 32 bits and their differences are exact floats."""
    (x_high, x_low), (y_high, y_low) = _halves(x), _halves(y)
    differences = (x_high - y_high) * 2.0**32 + (x_low - y_low)
    scale = measure(x, x)
    return Difference(
        scale.count, norm(differences), scale.norm, largest(differences), scale.least, scale.most
    )


def _halves(values: NDArray) -> tuple[NDArray, NDArray]:
    """h and l, 0 <= l < 2^32, float64, of values h 2^32 + l."""
    wide = values.astype(np.uint64 if values.dtype == np.uint64 else np.int64)
    bits = wide.dtype.type(32)
    high = wide >> bits
    return high.astype(np.float64), (wide - (high << bits)).astype(np.float64)


def _with_unlike(errors: Errors, unlike: int) -> Difference:
    return Difference(*(getattr(errors, field.name) for field in fields(Errors)), unlike=unlike)
