"""Checkpoints: the whole state of a run in one file that is either valid or not there.

A file is written under a temporary name, put on the disk, read back against its checksums and
only then renamed; older ones are removed last. So a kill at any moment leaves the previous
checkpoint as it was.

Layout: `groups/<group>/<name>` the ranks' rows in rank order, `rows/<group>` (P,) how many each
rank had, `shared/<name>` what all ranks hold alike, `attributes` numbers and texts as JSON. Every
data set has the attribute `checksum` (see `h5files.checksum`); a seal behind the file, which is
looked at first, vouches for the rest (see `seal`).
A ragged group has some rows for each row of its parent, as many as a column of the parent says.

Symbols: P ranks; N rows of a group over all ranks; n the rows of one rank.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.errors import DataError, DemError
from dem_mpi.h5files import (
    HDF5_ERRORS,
    SharedFile,
    agree,
    checksum,
    dataset_checksum,
    fsync,
    open_checked,
    plain,
    read_attribute,
    read_attributes,
    reason,
    require_space,
    write_attributes,
)
from dem_mpi.parallel import Parallel
from dem_mpi.seal import check_seal, write_seal

FORMAT = "dem-mpi checkpoint"
FORMAT_VERSION = 1

# The lowest version whose structures all carry checksums of their own.
_LIBVER = ("v110", "v110")
_STRUCTURE_BYTES = 1 << 16  # room for the file's structures when asking for disk space

Groups = Mapping[str, Mapping[str, NDArray]]
Ragged = Mapping[str, tuple[str, str]]
NO_RAGGED: Ragged = {}


@dataclass(frozen=True)
class Skipped:
    """A file that could have been a checkpoint, and why it is not used."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Found:
    """The newest valid checkpoint and what was skipped on the way to it."""

    path: Path
    step: int
    skipped: tuple[Skipped, ...]


@dataclass(frozen=True)
class Checkpoint:
    """What one rank gets back: its rows of every group, what is shared, numbers and texts."""

    path: Path
    step: int
    ranks: int
    groups: dict[str, dict[str, NDArray]]
    shared: dict[str, NDArray]
    attributes: dict[str, Any]


def checkpoint_path(directory: Path | str, stem: str, step: int) -> Path:
    """Where the checkpoint of a step stands."""
    return Path(directory) / f"{stem}.checkpoint.{step:09d}.h5"


def _no_stage(name: str) -> None:
    """Called between the stages of a write; tests end the process here."""


# ---- writing -------------------------------------------------------------------------------


def write(
    parallel: Parallel,
    directory: Path | str,
    stem: str,
    step: int,
    groups: Groups,
    shared: Mapping[str, ArrayLike],
    attributes: Mapping[str, Any],
    *,
    ragged: Ragged = NO_RAGGED,
    keep: int = 2,
    through_root: bool | None = None,
    on_stage: Callable[[str], None] = _no_stage,
) -> Path:
    """Collective. Save a state and return its path; then keep only the `keep` newest.

    `groups` is {group: {name: (n, ...) array}}, this rank's rows; within a group all arrays have
    n rows, ranks may have none; names, dtypes and trailing shapes agree over ranks. `shared` is
    {name: array}, the same on every rank; of it and of `attributes`, numbers and texts, rank 0's
    are written. `ragged` is {group: (parent, column)}: `column` of group `parent` counts, row by
    row, the rows that belong to it in `group`. `on_stage` is called on every rank after each
    stage, with its name: "created", "data written", "flushed", "verified", "renamed",
    "old ones removed".

    Raises OutputError on every rank if the file cannot be written whole; the temporary file is
    removed then and older checkpoints are untouched.
    """
    path = checkpoint_path(directory, stem, step)
    temporary = path.with_name(path.name + ".tmp")
    groups = {g: {k: np.ascontiguousarray(a) for k, a in c.items()} for g, c in groups.items()}
    shared, attributes = parallel.broadcast(
        ({k: np.asarray(a) for k, a in shared.items()}, dict(attributes))
    )
    parallel.raise_together(_contradiction(groups, ragged))
    rows = {
        group: parallel.allgather(np.array([_row_count(columns)], dtype=np.int64))[:, 0]
        for group, columns in groups.items()
    }
    size = _expected_size(groups, rows, shared)
    with agree(parallel, path, "write"):
        if parallel.rank == 0:
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_temporaries(path.parent, stem)
            require_space(path, size)
    try:
        file = SharedFile(
            parallel,
            temporary,
            "w",
            libver=_LIBVER,
            through_root=through_root,
            expected_size=size,
        )
        try:
            sums = _create(file, step, groups, rows, shared, attributes, ragged)
            file.flush()
            on_stage("created")
            _write_rows(file, groups, rows, shared, attributes)
            on_stage("data written")
            file.sync()
        except BaseException:
            file.abandon()
            raise
        file.close()
        _seal(parallel, temporary)
        on_stage("flushed")
        _read_back(parallel, temporary, sums)
        on_stage("verified")
        _rename(parallel, temporary, path)
    except DemError:
        if parallel.rank == 0:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
        raise
    on_stage("renamed")
    remove_others(parallel, directory, stem, step, keep)
    on_stage("old ones removed")
    return path


def _contradiction(groups: Groups, ragged: Ragged) -> ValueError | None:
    for group, columns in groups.items():
        lengths = {name: array.shape[0] for name, array in columns.items()}
        if len(set(lengths.values())) > 1:
            return ValueError(f"checkpoint group '{group}' has columns of unequal length {lengths}")
    for group, (parent, column) in ragged.items():
        expected, rows = int(groups[parent][column].sum()), _row_count(groups[group])
        if expected != rows:
            return ValueError(
                f"checkpoint group '{group}' has {rows} rows, '{parent}/{column}' counts {expected}"
            )
    return None


def _row_count(columns: Mapping[str, NDArray]) -> int:
    return next(iter(columns.values())).shape[0] if columns else 0


def _expected_size(groups: Groups, rows: Mapping[str, NDArray], shared: Mapping) -> int:
    size = _STRUCTURE_BYTES + sum(array.nbytes for array in shared.values())
    for group, columns in groups.items():
        row_bytes = sum(a.dtype.itemsize * int(np.prod(a.shape[1:])) for a in columns.values())
        size += int(rows[group].sum()) * row_bytes
    return size


def _create(
    file: SharedFile,
    step: int,
    groups: Groups,
    rows: Mapping[str, NDArray],
    shared: Mapping[str, NDArray],
    attributes: Mapping[str, Any],
    ragged: Ragged,
) -> dict[str, int]:
    """Collective. Lay the file out with its checksums; return them by data set."""
    parallel = file.parallel
    arrays: dict[str, NDArray] = {}
    shapes: dict[str, tuple[int, ...]] = {}
    local: list[int] = []
    for group, columns in groups.items():
        first_row = int(rows[group][: parallel.rank].sum())
        for name, array in columns.items():
            arrays[f"groups/{group}/{name}"] = array
            shapes[f"groups/{group}/{name}"] = (int(rows[group].sum()), *array.shape[1:])
            local.append(checksum(array, first_row))
    total = parallel.sum(np.array(local, dtype=np.uint64))
    sums = dict(zip(arrays, total.tolist(), strict=True))
    for name, array in _replicated(rows, shared, attributes).items():
        arrays[name] = array
        sums[name] = checksum(array)
        shapes[name] = array.shape
    with agree(parallel, file.path, "write"):
        if file.file is not None:
            write_attributes(
                file.file,
                {
                    "format": FORMAT,
                    "format_version": FORMAT_VERSION,
                    "step": step,
                    "ranks": parallel.size,
                    "datasets": len(arrays),
                },
            )
            file.file.create_group("shared")
            for group in groups:
                file.file.create_group(f"groups/{group}")
            for group, (parent, column) in ragged.items():
                write_attributes(file.file[f"groups/{group}"], {"parent": parent, "count": column})
            for name, array in arrays.items():
                dataset = file.create_dataset(name, shapes[name], array.dtype)
                dataset.attrs["checksum"] = np.uint64(sums[name])
            for name, array in shared.items():
                file.file[f"shared/{name}"].attrs["scalar"] = int(array.ndim == 0)
    return sums


def _replicated(
    rows: Mapping[str, NDArray], shared: Mapping[str, NDArray], attributes: Mapping[str, Any]
) -> dict[str, NDArray]:
    """The data sets that rank 0 writes."""
    text = json.dumps(attributes, default=plain).encode()
    return {
        **{f"rows/{group}": counts for group, counts in rows.items()},
        **{f"shared/{name}": np.atleast_1d(array) for name, array in shared.items()},
        "attributes": np.frombuffer(text, dtype=np.uint8),
    }


def _write_rows(
    file: SharedFile,
    groups: Groups,
    rows: Mapping[str, NDArray],
    shared: Mapping[str, NDArray],
    attributes: Mapping[str, Any],
) -> None:
    for group, columns in groups.items():
        if rows[group].any():
            for name, array in columns.items():
                if all(array.shape[1:]):
                    file.write_rows(f"groups/{group}/{name}", 0, array)
    replicated = _replicated(rows, shared, attributes)
    file.write_on_root({name: (0, array) for name, array in replicated.items() if array.size})


def _seal(parallel: Parallel, path: Path) -> None:
    with agree(parallel, path, "write"):
        if parallel.rank == 0:
            write_seal(path)
    with agree(parallel, path, "write"):
        fsync(path)


def _read_back(parallel: Parallel, path: Path, sums: Mapping[str, int]) -> None:
    """Collective. Compare what stands in the file with what was meant to.

    A full disk can leave a file of the right size with zeros in it that opens without complaint.
    """
    problem = _find_damage(parallel, path)
    with agree(parallel, path, "write"):
        if problem:
            raise OSError(f"read back, it differs from what was written: {problem}")


def _rename(parallel: Parallel, temporary: Path, path: Path) -> None:
    with agree(parallel, path, "rename"):
        if parallel.rank == 0:
            temporary.replace(path)
            fsync(path.parent)
    parallel.barrier()


def remove_others(
    parallel: Parallel, directory: Path | str, stem: str, step: int, keep: int
) -> None:
    """Collective. Remove all checkpoints but the `keep` newest up to `step`.

    Later ones are of a future that this run no longer has: they were damaged and skipped, or
    stem from an earlier run. `keep=0` removes all, which is how a fresh start begins.
    """
    with agree(parallel, directory, "remove old checkpoints"):
        if parallel.rank == 0 and Path(directory).is_dir():
            candidates = _candidates(Path(directory), stem)
            steps = sorted(s for s in candidates if s <= step)
            kept = set(steps[-keep:]) if keep > 0 else set()
            for s in set(candidates) - kept:
                candidates[s].unlink(missing_ok=True)
            if not keep:
                _remove_temporaries(Path(directory), stem)
    parallel.barrier()


def _remove_temporaries(directory: Path, stem: str) -> None:
    for path in _temporaries(directory, stem):
        path.unlink(missing_ok=True)


# ---- finding -------------------------------------------------------------------------------


def find(parallel: Parallel, directory: Path | str, stem: str) -> Found | None:
    """Collective. The newest checkpoint whose every checksum holds; None if there is no file.

    Raises DataError (65) naming every file and its fault if there are some but none is valid.
    """
    directory = Path(directory)
    with agree(parallel, directory, "look for checkpoints"):
        listing = (
            (_candidates(directory, stem), _temporaries(directory, stem))
            if parallel.rank == 0 and directory.is_dir()
            else ({}, [])
        )
    candidates, temporaries = parallel.broadcast(listing)
    skipped = [Skipped(path, "its writing was interrupted") for path in temporaries]
    for step in sorted(candidates, reverse=True):
        path = candidates[step]
        problem = _find_damage(parallel, path)
        if not problem:
            return Found(path, step, tuple(skipped))
        skipped.append(Skipped(path, problem))
    if not candidates:
        return None
    faults = "; ".join(f"{s.path.name}: {s.reason}" for s in skipped)
    raise DataError(f"{directory}: no valid checkpoint of '{stem}': {faults}")


def _candidates(directory: Path, stem: str) -> dict[int, Path]:
    pattern = re.compile(re.escape(stem) + r"\.checkpoint\.(\d{9,})\.h5")
    return {
        int(match[1]): path
        for path in sorted(directory.iterdir())
        if (match := pattern.fullmatch(path.name))
    }


def _temporaries(directory: Path, stem: str) -> list[Path]:
    pattern = re.compile(re.escape(stem) + r"\.checkpoint\.\d{9,}\.h5\.tmp")
    return [path for path in sorted(directory.iterdir()) if pattern.fullmatch(path.name)]


def find_damage(path: Path | str) -> str:
    """What is wrong with a checkpoint, '' for nothing; one process reads all of it."""
    problem, sums = _partial_checksums(Path(path), rank=0, size=1)
    return problem or _mismatch(sums, [local for local, _ in sums.values()])


def _find_damage(parallel: Parallel, path: Path) -> str:
    """Collective. `find_damage`, each rank reading its share."""
    problem, sums = _partial_checksums(path, parallel.rank, parallel.size)
    try:
        parallel.raise_together(DataError(problem) if problem else None)
    except DataError as error:
        return str(error)
    local = np.array([local for local, _ in sums.values()], dtype=np.uint64)
    return _mismatch(sums, parallel.sum(local).tolist())


def _partial_checksums(path: Path, rank: int, size: int) -> tuple[str, dict[str, tuple[int, int]]]:
    """A fault, and by data set the checksum of one rank's rows and the one stored for all."""
    sums: dict[str, tuple[int, int]] = {}
    try:
        sealed = path.is_file() and check_seal(path)
        with open_checked(path) as file:
            _check_header(path, file)
            if not sealed:
                raise DataError(f"{path}: the seal at its end is missing")
            for name in _datasets(file):
                dataset = file[name]
                rows = _share(rank, size, dataset.shape[0])
                stored = int(read_attribute(dataset, "checksum"))
                sums[name] = _checksum_of(path, dataset, *rows), stored
            if len(sums) != read_attribute(file, "datasets"):
                raise DataError(f"{path}: data sets are missing")
    except DemError as error:
        return str(error).removeprefix(f"{path}: "), {}
    except HDF5_ERRORS as error:
        return f"damaged: {reason(error)}", {}
    return "", sums


def _mismatch(sums: Mapping[str, tuple[int, int]], total: list[int]) -> str:
    for (name, (_, stored)), actual in zip(sums.items(), total, strict=True):
        if actual != stored:
            return f"checksum of '{name}' does not match"
    return ""


def _checksum_of(path: Path, dataset: h5py.Dataset, start: int, stop: int) -> int:
    try:
        return dataset_checksum(dataset, start, stop, first_row=start)
    except HDF5_ERRORS as error:
        raise DataError(f"{path}: '{dataset.name}' cannot be read: {reason(error)}") from None


def _check_header(path: Path, file: h5py.File) -> None:
    attributes = read_attributes(file)
    if attributes.get("format") != FORMAT:
        raise DataError(f"{path}: not a checkpoint of dem-mpi")
    version = attributes.get("format_version")
    if version != FORMAT_VERSION:
        raise DataError(f"{path}: checkpoint format {version}, this program reads {FORMAT_VERSION}")


def _datasets(file: h5py.File) -> Iterator[str]:
    found: list[str] = []
    file.visititems(lambda name, item: found.append(name) if _is_dataset(item) else None)
    yield from sorted(found)


def _is_dataset(item: Any) -> bool:
    return isinstance(item, h5py.Dataset)


def _share(rank: int, size: int, rows: int) -> tuple[int, int]:
    """A rank's equal part [start, stop) of all rows."""
    return rows * rank // size, rows * (rank + 1) // size


# ---- reading -------------------------------------------------------------------------------


def read(parallel: Parallel, path: Path | str) -> Checkpoint:
    """Collective. Load a checkpoint that `find` returned.

    On as many ranks as wrote it, each gets the rows it had; on another number each gets an equal
    contiguous part, and of ragged groups the rows that belong to its part of the parent.
    Raises DataError (65) on every rank if the file cannot be read or contradicts itself.
    """
    path = Path(path)
    with agree(parallel, path, "read", DataError):
        file = open_checked(path)
        _check_header(path, file)
    with contextlib.closing(file):
        with agree(parallel, path, "read", DataError):
            ranks = int(read_attribute(file, "ranks"))
            ragged = {
                name: (read_attribute(group, "parent"), read_attribute(group, "count"))
                for name, group in file["groups"].items()
                if "parent" in group.attrs
            }
            groups = {
                name: _read_rows(file, name, *_own_rows(parallel, file, name, ranks))
                for name in file["groups"]
                if name not in ragged
            }
        for name, (parent, column) in ragged.items():
            with agree(parallel, path, "read", DataError):
                mine = int(groups[parent][column].sum())
            start, total = parallel.exclusive_sum(mine), parallel.sum(mine)
            with agree(parallel, path, "read", DataError):
                rows = int(file[f"rows/{name}"][:].sum())
                if total != rows:
                    raise DataError(
                        f"{path}: '{parent}/{column}' counts {total} rows of '{name}', "
                        f"there are {rows}"
                    )
                groups[name] = _read_rows(file, name, start, start + mine)
        with agree(parallel, path, "read", DataError):
            shared = {
                name: dataset[:][0] if read_attribute(dataset, "scalar") else dataset[:]
                for name, dataset in file["shared"].items()
            }
            attributes = read_attributes_of(file)
            step = int(read_attribute(file, "step"))
    return Checkpoint(path, step, ranks, groups, shared, attributes)


def read_attributes_of(file: h5py.File) -> dict[str, Any]:
    """The numbers and texts of a checkpoint."""
    return json.loads(file["attributes"][:].tobytes())


def _own_rows(parallel: Parallel, file: h5py.File, group: str, ranks: int) -> tuple[int, int]:
    rows = file[f"rows/{group}"][:]
    if parallel.size == ranks:
        start = int(rows[: parallel.rank].sum())
        return start, start + int(rows[parallel.rank])
    return _share(parallel.rank, parallel.size, int(rows.sum()))


def _read_rows(file: h5py.File, group: str, start: int, stop: int) -> dict[str, NDArray]:
    return {name: dataset[start:stop] for name, dataset in file[f"groups/{group}"].items()}
