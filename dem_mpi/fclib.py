"""Frictional contact problems in FCLIB's HDF5 layout, each rank reading its own share.

A file holds one problem, `fclib_local` or `fclib_global`, and may hold a `solution` and `guesses`
(V. Acary, M. Brémond, T. Koziara, F. Pérignon, INRIA technical report 444, 2014):

    local    W (3c, 3c), q (3c,), mu (c,)                   u = W r + q
    global   M (d, d), H (d, 3c), f (d,), w (3c,), mu (c,)  M v = H r + f,  u = H^T v + w

with c contacts, the normal first, and d velocity components; plane problems have 2 rows a contact.
A matrix is m, n, nz, p, i, x: compressed columns (nz = -1), compressed rows (nz = -2) or nz
triplets. Of triplets FCLIB's header says that p holds rows, its files hold them in i: the sizes
decide, and where both readings fit, the files' habit.

Plane contacts get a second tangent of zeros, so that everything behind this module is spatial.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from dem_mpi.errors import DataError, InputError
from dem_mpi.h5files import agree, open_checked, plain
from dem_mpi.parallel import Parallel

COLUMNS = 3
# Blocks of velocity components that ranks own never cut a rigid body (6 of them, 3 in the plane).
_BODY_COMPONENTS = 6
_MAX_GUESSES = 1_000_000
_COMPRESSED_COLUMNS, _COMPRESSED_ROWS = -1, -2
_ENTRY = np.dtype([("row", np.int64), ("column", np.int64), ("value", np.float64)])

Form = Literal["local", "global"]


@dataclass(frozen=True)
class Share:
    """Contiguous blocks of 0 ... total - 1, one a rank: bounds (P + 1,), mine [first, last)."""

    bounds: NDArray
    rank: int

    @classmethod
    def of(cls, total: int, parallel: Parallel, unit: int = 1) -> Share:
        """Split evenly in multiples of `unit`; the last rank takes what is left over."""
        units = total // unit
        bounds = [units * k // parallel.size * unit for k in range(parallel.size)]
        return cls(np.array([*bounds, total], dtype=np.int64), parallel.rank)

    @property
    def first(self) -> int:
        """The first index of this rank."""
        return int(self.bounds[self.rank])

    @property
    def last(self) -> int:
        """One behind the last index of this rank."""
        return int(self.bounds[self.rank + 1])

    @property
    def count(self) -> int:
        """How many indices this rank has."""
        return self.last - self.first

    @property
    def total(self) -> int:
        """How many indices all ranks have."""
        return int(self.bounds[-1])

    def scaled(self, factor: int) -> Share:
        """The same blocks where each index stands for `factor` rows."""
        return Share(self.bounds * factor, self.rank)


@dataclass(frozen=True)
class FclibProblem:
    """One rank's rows of a problem, in 3 columns a contact (normal, tangent 1, tangent 2).

    contacts : shares of the contacts; mu : (m,); info : title, description, ... of the file
    offset   : (m, 3) [m/s], q of a local problem, w of a global one
    delassus : (3m, 3c) [1/kg] rows of W, as stored; None in a global problem
    mass     : (own, d) [kg] rows of M, as stored; jacobian : (3m, d) rows of H^T;
    force    : (own,) [N s], f; bodies : shares of the d components; all None in a local problem
    stored   : {"solution" or number of the guess: (m, 3) [N s]} impulses that are not all zero
    empty    : names of stored impulses that are all zero, as FCLIB writes them where it has none
    guesses  : how many guesses the file has
    """

    path: Path
    form: Form
    dimension: int
    contacts: Share
    mu: NDArray
    offset: NDArray
    delassus: sparse.csr_matrix | None = None
    mass: sparse.csr_matrix | None = None
    jacobian: sparse.csr_matrix | None = None
    force: NDArray | None = None
    bodies: Share | None = None
    stored: Mapping[str, NDArray] = field(default_factory=dict)
    empty: tuple[str, ...] = ()
    guesses: int = 0
    info: Mapping[str, str] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Number of rows on all ranks, as the file counts them."""
        return self.contacts.total * self.dimension


def read_problem(parallel: Parallel, path: Path | str, guess: str | None = None) -> FclibProblem:
    """Collective. Read the problem of a file that nobody has to trust, each rank its share.

    The stored solution, the first guess and the one that `guess` names are read along. Raises, on
    all ranks, InputError where there is no such file or guess, and DataError where the file is
    damaged, holds no FCLIB problem, or one with equality constraints, which is not supported.
    """
    path = Path(path)
    with agree(parallel, path, "read", DataError), open_checked(path) as file:
        raw = _read_share(_Source(path, file), parallel, guess)
    matrices = {name: _oriented(parallel, matrix) for name, matrix in raw.matrices.items()}
    rows = raw.contacts.scaled(COLUMNS)
    if raw.form == "local":
        W = _spread(_spread(matrices["W"], "row", raw.dimension), "column", raw.dimension)
        parts: dict[str, Any] = {"delassus": _rows_of_rank(parallel, W, rows, rows.total)}
    else:
        H = _spread(matrices["H"], "column", raw.dimension)
        H_transposed = H.copy()
        H_transposed["row"], H_transposed["column"] = H["column"], H["row"]
        d = raw.bodies.total
        parts = {
            "jacobian": _rows_of_rank(parallel, H_transposed, rows, d),
            "mass": _rows_of_rank(parallel, matrices["M"], raw.bodies, d),
            "force": raw.force,
            "bodies": raw.bodies,
        }
    present = {
        name: parallel.any(bool(impulse.any())) for name, impulse in sorted(raw.stored.items())
    }
    return FclibProblem(
        path=path,
        form=raw.form,
        dimension=raw.dimension,
        contacts=raw.contacts,
        mu=raw.mu,
        offset=raw.offset,
        stored={name: raw.stored[name] for name, nonzero in present.items() if nonzero},
        empty=tuple(name for name, nonzero in present.items() if not nonzero),
        guesses=raw.guesses,
        info=raw.info,
        **parts,
    )


# ---- what one rank reads -------------------------------------------------------------------


@dataclass(frozen=True)
class _Entries:
    """A slice of a stored matrix: i and p of triplets, (row, column) of compressed storage."""

    label: str
    shape: tuple[int, int]
    row: NDArray
    column: NDArray
    value: NDArray
    triplets: bool


@dataclass(frozen=True)
class _Raw:
    form: Form
    dimension: int
    contacts: Share
    bodies: Share | None
    matrices: dict[str, _Entries]
    mu: NDArray
    offset: NDArray
    force: NDArray | None
    stored: dict[str, NDArray]
    guesses: int
    info: dict[str, str]


class _Source:
    """Checked access to the objects of an open file; raises DataError in words."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self.file = file

    def fail(self, text: str) -> DataError:
        return DataError(f"{self.path}: {text}")

    def dataset(self, name: str, kinds: str, length: int | None = None) -> h5py.Dataset:
        item = self.file.get(name)
        if not isinstance(item, h5py.Dataset):
            raise self.fail(f"'{name}' is missing: not a complete FCLIB problem")
        if item.dtype.kind not in kinds:
            raise self.fail(f"'{name}' holds {item.dtype}, not {_KINDS[kinds]}")
        if item.ndim != 1 or (length is not None and item.shape[0] != length):
            expected = "one row of numbers" if length is None else f"({length},)"
            raise self.fail(f"'{name}' has shape {item.shape}, expected {expected}")
        return item

    def integer(self, name: str) -> int:
        item = self.file.get(name)
        if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "iu" or item.size != 1:
            raise self.fail(f"'{name}' is not one integer: not a complete FCLIB problem")
        return int(np.asarray(item[()]).reshape(-1)[0])

    def numbers(self, name: str, total: int, share: Share) -> NDArray:
        """Read this rank's share of a vector of `total` finite numbers."""
        values = self.dataset(name, "fiu", total)[share.first : share.last].astype(np.float64)
        self.check_finite(name, values, share.first)
        return values

    def check_finite(self, name: str, values: NDArray, first: int) -> None:
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise self.fail(f"'{name}'[{first + int(bad[0])}] = {values[bad[0]]}: not a number")

    def contact_rows(self, name: str, contacts: Share, dimension: int) -> NDArray:
        """Read this rank's rows of a vector over contacts, (m, 3)."""
        rows = contacts.scaled(dimension)
        values = self.numbers(name, rows.total, rows).reshape(contacts.count, dimension)
        return np.pad(values, ((0, 0), (0, COLUMNS - dimension)))

    def indices(self, name: str, start: int, stop: int, limit: int) -> NDArray:
        """Indices in [0, limit) from a data set that must reach to `stop`."""
        item = self.dataset(name, "iu")
        if item.shape[0] < stop:
            raise self.fail(f"'{name}' has {item.shape[0]} entries, {stop} are needed")
        values = item[start:stop].astype(np.int64)
        if values.size and not (values.min() >= 0 and values.max() < limit):
            worst = values.min() if values.min() < 0 else values.max()
            raise self.fail(f"'{name}' has the index {worst}, outside 0 ... {limit - 1}")
        return values


_KINDS = {"iu": "integers", "fiu": "numbers"}


def _read_share(source: _Source, parallel: Parallel, guess: str | None) -> _Raw:
    form = _form(source)
    root = f"fclib_{form}"
    dimension = source.integer(f"{root}/spacedim")
    if dimension not in (2, 3):
        raise source.fail(f"'{root}/spacedim' = {dimension}: must be 2 or 3")
    _refuse_constraints(source, form)
    if form == "local":
        rows = _square(source, f"{root}/W")
        shapes = {"W": (rows, rows)}
        bodies = None
    else:
        components = _square(source, f"{root}/M")
        rows = source.integer(f"{root}/H/n")
        shapes = {"M": (components, components), "H": (components, rows)}
        bodies = Share.of(components, parallel, _BODY_COMPONENTS)
    if rows < 1 or rows % dimension:
        raise source.fail(f"{rows} rows are not {dimension} for each of one or more contacts")
    contacts = Share.of(rows // dimension, parallel)
    mu = source.numbers(f"{root}/vectors/mu", contacts.total, contacts)
    if (mu < 0.0).any():
        raise source.fail(f"'{root}/vectors/mu' has {mu.min()}: friction must be >= 0")
    vector = "q" if form == "local" else "w"
    stored, guesses = _stored_impulses(source, contacts, dimension, guess)
    return _Raw(
        form=form,
        dimension=dimension,
        contacts=contacts,
        bodies=bodies,
        matrices={
            name: _read_entries(source, parallel, f"{root}/{name}", shape)
            for name, shape in shapes.items()
        },
        mu=mu,
        offset=source.contact_rows(f"{root}/vectors/{vector}", contacts, dimension),
        force=None if bodies is None else source.numbers(f"{root}/vectors/f", bodies.total, bodies),
        stored=stored,
        guesses=guesses,
        info=_info(source, root),
    )


def _form(source: _Source) -> Form:
    found = [
        form
        for form in ("local", "global")
        if isinstance(source.file.get(f"fclib_{form}"), h5py.Group)
    ]
    if len(found) != 1:
        what = "both a local and a global" if found else "neither a local nor a global"
        raise source.fail(f"holds {what} FCLIB problem (fclib_local, fclib_global)")
    return found[0]


def _refuse_constraints(source: _Source, form: Form) -> None:
    for name in ("G",) if form == "global" else ("V", "R"):
        group = f"fclib_{form}/{name}"
        if group in source.file and source.integer(f"{group}/n") > 0:
            raise source.fail(f"'{group}': problems with equality constraints are not supported")


def _square(source: _Source, name: str) -> int:
    rows, columns = source.integer(f"{name}/m"), source.integer(f"{name}/n")
    if rows != columns or rows < 1:
        raise source.fail(f"'{name}' is {rows} by {columns}: it must be square")
    return rows


def _info(source: _Source, root: str) -> dict[str, str]:
    """Title, description and the like."""
    texts = {}
    for name in ("title", "description", "math_info"):
        item = source.file.get(f"{root}/info/{name}")
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "S" and item.shape == ():
            texts[name] = str(plain(item[()])).strip()
    return texts


def _stored_impulses(
    source: _Source, contacts: Share, dimension: int, guess: str | None
) -> tuple[dict[str, NDArray], int]:
    """The impulses r of the solution, the first guess and the one asked for; number of guesses."""
    count = 0
    if "guesses/number_of_guesses" in source.file:
        count = source.integer("guesses/number_of_guesses")
        if not 0 <= count < _MAX_GUESSES:
            raise source.fail(f"'guesses/number_of_guesses' = {count}: refused")
    places = {"solution": "solution/r", "1": "guesses/1/r"}
    if guess is not None and guess not in places:
        places[guess] = f"guesses/{guess}/r"
    stored = {
        name: source.contact_rows(place, contacts, dimension)
        for name, place in places.items()
        if place in source.file
    }
    if guess is not None and guess not in stored:
        raise InputError(f"{source.path}: --guess {guess}: there is no '{places[guess]}'")
    return stored, count


def _read_entries(
    source: _Source, parallel: Parallel, name: str, shape: tuple[int, int]
) -> _Entries:
    """Read this rank's slice of a matrix, in whichever of the three storages it is."""
    rows, columns = shape
    found = (source.integer(f"{name}/m"), source.integer(f"{name}/n"))
    if found != shape:
        raise source.fail(f"'{name}' is {found[0]} by {found[1]}, expected {rows} by {columns}")
    nz = source.integer(f"{name}/nz")
    if nz >= 0:
        share = Share.of(nz, parallel)
        start, stop = share.first, share.last
        limit = max(shape)
        row = source.indices(f"{name}/i", start, stop, limit)
        column = source.indices(f"{name}/p", start, stop, limit)
    elif nz in (_COMPRESSED_COLUMNS, _COMPRESSED_ROWS):
        by_columns = nz == _COMPRESSED_COLUMNS
        along, across = (columns, rows) if by_columns else (rows, columns)
        share = Share.of(along, parallel)
        lines, start, stop = _compressed_lines(source, f"{name}/p", share)
        other = source.indices(f"{name}/i", start, stop, across)
        row, column = (other, lines) if by_columns else (lines, other)
    else:
        raise source.fail(f"'{name}/nz' = {nz}: must be -1, -2 or the number of triplets")
    stored = source.dataset(f"{name}/x", "fiu")
    if stored.shape[0] < stop:
        raise source.fail(f"'{name}/x' has {stored.shape[0]} entries, {stop} are needed")
    value = stored[start:stop].astype(np.float64)
    source.check_finite(f"{name}/x", value, start)
    return _Entries(f"{source.path}: '{name}'", shape, row, column, value, triplets=nz >= 0)


def _compressed_lines(source: _Source, name: str, share: Share) -> tuple[NDArray, int, int]:
    """The row (or column) of each entry of this rank's lines, and where these entries stand."""
    pointers = source.dataset(name, "iu", share.total + 1)[share.first : share.last + 1]
    pointers = pointers.astype(np.int64)
    lengths = np.diff(pointers)
    if pointers[0] < 0 or (share.first == 0 and pointers[0] != 0) or (lengths < 0).any():
        raise source.fail(f"'{name}' does not ascend from 0")
    start, stop = int(pointers[0]), int(pointers[-1])
    # Before an array of that length is made: a pointer may claim any number.
    if stop > source.dataset(name[:-1] + "i", "iu").shape[0]:
        raise source.fail(f"'{name}' points behind the last entry")
    return np.repeat(np.arange(share.first, share.last), lengths), start, stop


# ---- from the stored slices to each rank's rows --------------------------------------------


def _oriented(parallel: Parallel, entries: _Entries) -> NDArray:
    """Collective. Entries (row, column, value), with the order of triplets found by the sizes."""
    row, column = entries.row, entries.column
    if entries.triplets:
        largest = parallel.max(
            np.array([row.max(initial=-1), column.max(initial=-1)], dtype=np.int64)
        )
        rows, columns = entries.shape
        if not (largest[0] < rows and largest[1] < columns):
            if not (largest[1] < rows and largest[0] < columns):
                raise DataError(
                    f"{entries.label} is {rows} by {columns}, but its triplets reach i = "
                    f"{largest[0]}, p = {largest[1]}"
                )
            row, column = column, row
    result = np.empty(row.size, dtype=_ENTRY)
    result["row"], result["column"], result["value"] = row, column, entries.value
    return result


def _spread(entries: NDArray, axis: str, dimension: int) -> NDArray:
    """Number contact rows (or columns) by 3 a contact instead of by `dimension`."""
    if dimension < COLUMNS:
        entries = entries.copy()
        contact, component = np.divmod(entries[axis], dimension)
        entries[axis] = contact * COLUMNS + component
    return entries


def _rows_of_rank(
    parallel: Parallel, entries: NDArray, rows: Share, columns: int
) -> sparse.csr_matrix:
    """Collective. Send every entry to the rank that owns its row; entries met twice add up."""
    return _as_csr(_to_owners(parallel, entries, rows), rows, columns)


def _to_owners(parallel: Parallel, entries: NDArray, rows: Share) -> NDArray:
    owner = np.searchsorted(rows.bounds, entries["row"], side="right") - 1
    entries = entries[np.argsort(owner, kind="stable")]
    cuts = np.searchsorted(np.sort(owner), np.arange(parallel.size + 1))
    messages = {
        rank: entries[cuts[rank] : cuts[rank + 1]].tobytes()
        for rank in range(parallel.size)
        if cuts[rank + 1] > cuts[rank]
    }
    arrived = parallel.exchange(messages)
    return np.concatenate(
        [np.empty(0, dtype=_ENTRY), *(np.frombuffer(m, dtype=_ENTRY) for m in arrived.values())]
    )


def _as_csr(entries: NDArray, rows: Share, columns: int) -> sparse.csr_matrix:
    place = (entries["row"] - rows.first, entries["column"])
    matrix = sparse.coo_matrix((entries["value"], place), shape=(rows.count, columns)).tocsr()
    matrix.sort_indices()
    return matrix
