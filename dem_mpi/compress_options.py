"""What the command line asks of `dem-mpi compress`, `restore`, `slice` and `compare`, checked."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dem_mpi.errors import InputError

KINDS = ("relative", "rmse", "pointwise")
_LARGEST_CHUNK = 4096
Range = tuple[int | None, int | None]
ALL: Range = (None, None)


@dataclass(frozen=True)
class CompressOptions:
    """What to make an archive of, and how.

    source    : trajectory, or array: file.npy, file.h5:/data/set
    tolerance : relative error of fields that `bounds` gives none for
    bounds    : (kind, value) by field, None for the tolerance; empty: all fields of a trajectory,
                those that do not change in time exactly
    chunk     : frames that are compressed together; floor: see `scene_compress.Compress`
    explain   : say what to expect, and end
    """

    source: str
    out: Path | None = None
    tolerance: float = 1e-2
    bounds: Mapping[str, tuple[str, float] | None] | None = None
    chunk: int = 32
    floor: float = 0.0
    explain: bool = False
    resume: bool = False
    force: bool = False

    def __post_init__(self) -> None:
        """Check what one value alone, or two together, can violate. InputError names the flag."""
        if not (math.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise InputError(f"--tol {self.tolerance:g}: must be > 0 and finite, such as 1e-2")
        _refuse_no_values(f"--tol {self.tolerance:g}", "relative", self.tolerance)
        if not 1 <= self.chunk <= _LARGEST_CHUNK:
            raise InputError(f"--chunk {self.chunk}: must be between 1 and {_LARGEST_CHUNK}")
        if not (math.isfinite(self.floor) and 0.0 <= self.floor <= 1.0):
            raise InputError(f"--floor {self.floor:g}: must be between 0 and 1")
        if self.resume and self.force:
            raise InputError("--resume and --force: one goes on with the archive, one replaces it")

    @property
    def path(self) -> Path:
        """The file to write."""
        if self.out is not None:
            return self.out
        name, _, inner = self.source.partition(":")
        source = Path(name)
        return source.with_name(f"{source.stem}{inner.replace('/', '_')}.tt.h5")


@dataclass(frozen=True)
class Selection:
    """What to decode of an archive: fields, None for all; numbers of steps and of bodies."""

    fields: tuple[str, ...] | None = None
    steps: Range = ALL
    bodies: Range = ALL


def parse_bounds(texts: Sequence[str]) -> dict[str, tuple[str, float] | None] | None:
    """Bounds from texts such as "velocity", "velocity=1e-2", "position=pointwise:1e-4"."""
    bounds: dict[str, tuple[str, float] | None] = {}
    for text in texts:
        name, equals, bound = text.partition("=")
        if not name:
            raise InputError(f"--field {text}: must be NAME or NAME=BOUND")
        if name in bounds:
            raise InputError(f"--field {text}: {name} is given twice")
        bounds[name] = _bound(text, bound) if equals else None
    return bounds or None


def _bound(flag: str, text: str) -> tuple[str, float]:
    kind, colon, number = text.partition(":")
    if text == "exact":
        return "exact", 0.0
    if not colon:
        kind, number = "relative", text
    if kind not in KINDS:
        close = difflib.get_close_matches(kind, (*KINDS, "exact"), n=1)
        remedy = f"; did you mean {close[0]}?" if close else ""
        raise InputError(f"--field {flag}: must be a number, {', '.join(KINDS)}:NUMBER or exact"
                         f"{remedy}")  # fmt: skip
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"--field {flag}: the bound must be > 0 and finite, such as 1e-2")
    _refuse_no_values(f"--field {flag}", kind, value)
    return kind, value


def _refuse_no_values(flag: str, kind: str, value: float) -> None:
    if kind == "relative" and value >= 1.0:
        raise InputError(f"{flag}: must be < 1: zeros for all values err by no more")


def parse_selection(fields: str | None, steps: str | None, bodies: str | None) -> Selection:
    """What to decode, from the texts of --fields, --steps and --bodies."""
    names = None
    if fields is not None:
        names = tuple(dict.fromkeys(fields.replace(",", " ").split()))
        if not names:
            raise InputError("--fields '': must name at least one field")
    return Selection(names, _range("--steps", steps), _range("--bodies", bodies))


def _range(flag: str, text: str | None) -> Range:
    """(a, b) of "a:b", a to b - 1; either may be left out. "a" alone is a:a+1."""
    if text is None:
        return ALL
    first, colon, last = text.partition(":")
    if any(part and not part.isdecimal() for part in (first, last)) or not (first or colon):
        raise InputError(f"{flag} {text}: must be A:B, from A up to and without B, or one number")
    low = int(first) if first else None
    high = int(last) if last else None
    if not colon:
        high = (low or 0) + 1
    if low is not None and high is not None and low >= high:
        raise InputError(f"{flag} {text}: holds nothing; A must be below B")
    if max(low or 0, high or 0) >= 2**63:
        raise InputError(f"{flag} {text}: no number is that large")
    return low, high


def range_text(part: Range) -> str:
    """A range as it is written on the command line."""
    return f"{'' if part[0] is None else part[0]}:{'' if part[1] is None else part[1]}"


def choose(flag: str, wanted: Iterable[str], known: Iterable[str], path: Any) -> tuple[str, ...]:
    """The wanted names, or all; InputError for one that is not known, with the nearest."""
    known = tuple(known)
    for name in wanted:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            remedy = f"did you mean {close[0]}?" if close else f"it has {', '.join(known)}"
            raise InputError(f"{flag} {name}: no such field in {path}; {remedy}")
    return tuple(wanted)
