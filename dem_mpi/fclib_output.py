"""Impulses written where FCLIB looks for them: a copy of the problem file with a solution in it.

FCLIB reads the sizes of a solution from the problem beside it, so that the file holds both. What
did not converge is no solution: it goes in as one more guess, from which a solve can start again.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi.errors import DataError, DemError, InputError
from dem_mpi.fclib import FclibProblem
from dem_mpi.h5files import (
    HDF5_ERRORS,
    OutputLock,
    SharedFile,
    agree,
    fsync,
    open_checked,
    reason,
    require_space,
    row_blocks,
    write_attributes,
)
from dem_mpi.parallel import Parallel

# The oldest layout that h5py writes: FCLIB's own readers may be built with an old HDF5.
_LIBVER = ("earliest", "v110")
_STRUCTURE_BYTES = 1 << 16
_COUNT = "guesses/number_of_guesses"


def refuse_existing(parallel: Parallel, out: Path, force: bool) -> None:
    """Collective. Raise InputError if `out` exists, unless it may be replaced, or has no place."""
    error = None
    if parallel.rank == 0:
        if out.is_dir():
            error = InputError(f"--out {out}: is a directory, name a file")
        elif not out.absolute().parent.is_dir():
            error = InputError(f"--out {out}: there is no directory {out.absolute().parent}")
        elif out.exists() and not force:
            error = InputError(f"--out {out}: exists; --force replaces it")
    parallel.raise_together(error)


def write_result(
    parallel: Parallel,
    out: Path,
    problem: FclibProblem,
    vectors: Mapping[str, NDArray],
    converged: bool,
    attributes: Mapping[str, Any],
) -> str:
    """Collective. Write `out` and put it in place when complete; returns the group of the vectors.

    vectors : {"r": (m, 3) impulses, "u": (m, 3) contact velocities, and in a global problem
    "v": (own,) velocities}, this rank's rows; attributes are stored beside them.
    Raises OutputError on all ranks if the file cannot be written; a file of that name is then as
    it was.
    """
    group = "solution" if converged else f"guesses/{problem.guesses + 1}"
    arrays = {
        name: array[:, : problem.dimension].ravel() if array.ndim == 2 else array
        for name, array in vectors.items()
    }
    lock = OutputLock(parallel, out)
    temporary = out.with_name(f"{out.name}.part")
    try:
        _write(parallel, temporary, problem, group, arrays, attributes)
        with agree(parallel, out, "rename"):
            if parallel.rank == 0:
                temporary.replace(out)
                fsync(out.absolute().parent)
    except DemError:
        if parallel.rank == 0:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
        raise
    finally:
        lock.release()
    return group


def _write(
    parallel: Parallel,
    path: Path,
    problem: FclibProblem,
    group: str,
    arrays: Mapping[str, NDArray],
    attributes: Mapping[str, Any],
) -> None:
    lengths = {name: parallel.sum(array.size) for name, array in arrays.items()}
    with agree(parallel, path, "write"):
        if parallel.rank == 0:
            added = 8 * sum(lengths.values()) + _STRUCTURE_BYTES
            require_space(path, problem.path.stat().st_size + added)
    # Through rank 0, which alone can copy the problem's own data sets.
    file = SharedFile(parallel, path, "w", libver=_LIBVER, through_root=True)
    try:
        with agree(parallel, path, "write"):
            if file.file is not None:
                _copy_problem(problem, file.file, group)
                for name, length in lengths.items():
                    file.create_dataset(f"{group}/{name}", (length,), np.float64)
                write_attributes(file.file[group], attributes)
        for name, array in arrays.items():
            file.write_rows(f"{group}/{name}", 0, array)
        file.sync()
    except BaseException:
        file.abandon()
        raise
    file.close()


def _copy_problem(problem: FclibProblem, target: h5py.File, group: str) -> None:
    """Copy all but the group to be written; attributes, which FCLIB does not read, are left out.

    Data sets are read and written: HDF5's own copy of objects crashes on some damaged files.
    """
    with open_checked(problem.path) as source:
        names: list[str] = []
        source.visit(names.append)
        for name in names:
            if f"{name}/".startswith(f"{group}/"):
                continue
            if isinstance(source[name], h5py.Dataset):
                _copy_dataset(source[name], target, name)
            else:
                target.require_group(name)
    if group.startswith("guesses/"):
        if _COUNT in target:
            del target[_COUNT]
        target[_COUNT] = np.array([problem.guesses + 1], dtype=np.int32)


def _copy_dataset(source: h5py.Dataset, target: h5py.File, name: str) -> None:
    copy = target.create_dataset(name, source.shape, source.dtype)
    if source.ndim == 0:
        copy[()] = _read(source, ())
        return
    row_bytes = source.dtype.itemsize * math.prod(source.shape[1:])
    for first, last in row_blocks(0, source.shape[0], row_bytes):
        copy[first:last] = _read(source, slice(first, last))


def _read(source: h5py.Dataset, place: Any) -> Any:
    try:
        return source[place]
    except HDF5_ERRORS as error:
        raise DataError(
            f"{source.file.filename}: '{source.name}' cannot be read: {reason(error)}"
        ) from None
