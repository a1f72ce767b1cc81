"""Initial bodies from a CSV or HDF5 file, a range of rows at a time.

CSV: one header line naming the columns x,y,z[,radius][,vx,vy,vz][,wx,wy,wz][,qw,qx,qy,qz] in any
order. HDF5: a group with the data sets position (n, 3)[, radius (n), velocity (n, 3),
angular_velocity (n, 3), orientation (n, 4)]. Orientations are quaternions, the scalar first. Of the
trajectory of a run it is the last frame. A file that is damaged or that points out of itself raises
DataError.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TextIO

import numpy as np

from dem_mpi.errors import DataError

if TYPE_CHECKING:
    import h5py

MAX_ROWS = 2**48
MAX_HEADER = 4096
# Deflate cannot compress better than about 1 : 1032; a larger claim is a forged shape.
MAX_COMPRESSION = 1100

COLUMNS = {
    "position": ("x", "y", "z"),
    "radius": ("radius",),
    "velocity": ("vx", "vy", "vz"),
    "angular_velocity": ("wx", "wy", "wz"),
    "orientation": ("qw", "qx", "qy", "qz"),
}
# The squared length of a quaternion that stands for a direction at all; it is then made 1.
_SHORTEST, _LONGEST = 1e-12, 1e12


class BodyFile:
    """A file of initial bodies: `rows` bodies with the given `quantities`.

    Opening checks the form; `read` checks the numbers of the rows it is asked for.
    """

    def __init__(self, path: Path, dataset: str | None = None) -> None:
        self.path = path
        self.dataset = dataset
        self.is_csv = path.suffix == ".csv"
        if not path.is_file():
            raise DataError(f"{path}: no such file")
        self.columns: list[str] = []
        self._first = 0  # row of the data sets
        if self.is_csv:
            self.columns, self.rows = _csv_form(path)
            self.quantities = tuple(q for q, names in COLUMNS.items() if names[0] in self.columns)
        else:
            self._first, self.rows, self.quantities = _hdf5_form(path, dataset)
        if self.rows > MAX_ROWS:
            raise DataError(f"{path}: claims {self.rows} bodies; more than {MAX_ROWS} is refused")

    def read(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """Bodies start <= row < stop: position (n, 3) [m] and what else the file has, float64.

        Orientations (n, 4) are of length 1. Raises DataError for rows that are no finite numbers,
        for radii that are not positive and for quaternions that are (nearly) zero.
        """
        arrays = self._csv_rows(start, stop) if self.is_csv else self._hdf5_rows(start, stop)
        for name, array in arrays.items():
            good, rule = _good(name, array)
            if not good.all():
                row = start + int(np.argmin(good))
                raise DataError(f"{self.path}: body {row} (from 0): {name} {rule}")
        if "orientation" in arrays:
            arrays["orientation"] /= np.linalg.norm(arrays["orientation"], axis=1, keepdims=True)
        return arrays

    def _csv_rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        with self.path.open(encoding="utf-8") as file:
            try:
                chosen = _csv_body_lines(file, start, stop)
                table = np.loadtxt(chosen, delimiter=",", comments=None, ndmin=2)
            except ValueError:
                table = np.empty((0, 0))
        if table.shape != (stop - start, len(self.columns)):
            self._refuse_first_bad_line(start, stop)
        order = {name: column for column, name in enumerate(self.columns)}
        arrays = {q: table[:, [order[name] for name in COLUMNS[q]]] for q in self.quantities}
        if "radius" in arrays:
            arrays["radius"] = arrays["radius"][:, 0]
        return arrays

    def _refuse_first_bad_line(self, start: int, stop: int) -> NoReturn:
        width = len(self.columns)
        with self.path.open(encoding="utf-8") as file:
            for row, line in enumerate(_csv_body_lines(file, start, stop), start=start):
                try:
                    bad = len([float(word) for word in line.split(",")]) != width
                except ValueError:
                    bad = True
                if bad:
                    raise DataError(
                        f"{self.path}: body {row} (from 0): {line.strip()[:60]!r} is not "
                        f"{width} numbers"
                    )
        raise DataError(f"{self.path}: holds fewer bodies than when it was opened")

    def _hdf5_rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        import h5py

        try:
            with h5py.File(self.path, "r") as file:
                group = file[self.dataset or "/"]
                rows = slice(self._first + start, self._first + stop)
                return {q: group[q][rows].astype(np.float64) for q in self.quantities}
        except (OSError, KeyError, RuntimeError) as error:
            raise DataError(f"{self.path}: cannot be read: {_short(error)}") from None


def _good(name: str, array: np.ndarray) -> tuple[np.ndarray, str]:
    """Which rows (n,) of a quantity can be used, and what the others break."""
    finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if name == "radius":
        return finite & (array > 0), "must be finite and > 0"
    if name == "orientation":
        with np.errstate(over="ignore", invalid="ignore"):
            square = np.sum(array**2, axis=1)
        return finite & (square > _SHORTEST) & (square < _LONGEST), "must be a quaternion, not 0"
    return finite, "must be finite"


def _csv_body_lines(file: TextIO, start: int, stop: int) -> Iterator[str]:
    """Lines of the bodies start <= row < stop; blank lines count for nothing."""
    lines = filter(str.strip, file)
    return itertools.islice(lines, 1 + start, 1 + stop)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _csv_form(path: Path) -> tuple[list[str], int]:
    """Column names and number of rows of a CSV file."""
    try:
        with path.open(encoding="utf-8") as file:
            header = ""
            while not header.strip():
                line = file.readline(MAX_HEADER)
                if not line:
                    raise DataError(f"{path}: empty; the first line names the columns x,y,z")
                header = line
            rows = sum(1 for _ in filter(str.strip, file))
    except UnicodeDecodeError:
        raise DataError(f"{path}: not UTF-8 text") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    columns = [name.strip() for name in header.lstrip("\ufeff").split(",")]
    known = [name for names in COLUMNS.values() for name in names]
    strange = [name for name in columns if name not in known]
    if strange or len(set(columns)) < len(columns):
        raise DataError(
            f"{path}:1: column {strange[0][:40] if strange else columns!r}: the header names each "
            f"column once, of {','.join(known)}"
        )
    for quantity, names in COLUMNS.items():
        missing = [name for name in names if name not in columns]
        if missing and (quantity == "position" or len(missing) < len(names)):
            raise DataError(f"{path}:1: column {missing[0]} is missing")
    return columns, rows


def _hdf5_form(path: Path, dataset: str | None) -> tuple[int, int, tuple[str, ...]]:
    """First row, number of rows and quantities of an HDF5 file.

    Refuses links, objects and forged shapes.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            group: h5py.Group = file
            for name in filter(None, (dataset or "").split("/")):
                group = _member(path, group, name, h5py.Group)
            quantities = tuple(q for q in COLUMNS if q in group)
            if "position" not in quantities:
                raise DataError(f"{path}: {group.name} has no data set 'position'")
            rows = {_rows(path, group, quantity) for quantity in quantities}
            trajectory = group.name == "/" and _is_trajectory(file)
            if len(rows) > 1 and not trajectory:
                raise DataError(f"{path}: {group.name}: the data sets differ in length")
    except (OSError, KeyError, RuntimeError) as error:
        raise DataError(f"{path}: no readable HDF5 file: {_short(error)}") from None
    first, count = _last_frame(path) if trajectory else (0, rows.pop())
    return first, count, quantities


def _is_trajectory(file: h5py.File) -> bool:
    from dem_mpi.h5files import read_attribute
    from dem_mpi.trajectory import FORMAT

    try:
        return read_attribute(file, "format") == FORMAT
    except (KeyError, DataError):
        return False


def _last_frame(path: Path) -> tuple[int, int]:
    """First row and number of rows of a trajectory's last complete frame."""
    from dem_mpi.h5files import open_checked
    from dem_mpi.trajectory import read_index

    with open_checked(path) as file:
        index = read_index(path, file)
    if not len(index):
        raise DataError(f"{path}: holds no complete frame")
    return int(index.offset[-1]), int(index.count[-1])


def _member(path: Path, group: h5py.Group, name: str, kind: type) -> h5py.Group | h5py.Dataset:
    """A group's own member; soft and external links could read any file of the host."""
    import h5py

    link = group.get(name, getlink=True)
    if link is None:
        raise DataError(f"{path}: {group.name} has no member '{name}'")
    if not isinstance(link, h5py.HardLink):
        raise DataError(f"{path}: '{name}' is a link; only data inside the file is read")
    member = group[name]
    if not isinstance(member, kind):
        raise DataError(f"{path}: '{name}' is no {kind.__name__.lower()}")
    return member


def _rows(path: Path, group: h5py.Group, quantity: str) -> int:
    """Length of a data set whose form is as expected."""
    import h5py

    data = _member(path, group, quantity, h5py.Dataset)
    where = f"{path}: {data.name}"
    if data.external or data.is_virtual:
        raise DataError(f"{where} is stored in another file; only data inside the file is read")
    if data.dtype.kind not in "fiu":
        raise DataError(f"{where} has type {data.dtype}; numbers are expected")
    shape = data.shape
    width = len(COLUMNS[quantity])
    if shape is None or shape[1:] != ((width,) if width > 1 else ()) or len(shape) < 1:
        expected = f"(n, {width})" if width > 1 else "(n)"
        raise DataError(f"{where} has shape {shape}; expected {expected}")
    if data.size * data.dtype.itemsize > MAX_COMPRESSION * max(data.id.get_storage_size(), 1):
        raise DataError(f"{where} claims shape {shape}, but the file does not hold that much data")
    return shape[0]
