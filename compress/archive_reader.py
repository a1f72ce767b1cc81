"""Reading archives: only what is asked is decoded, and nothing in the file is trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from compress.bounds import Errors
from compress.coding import FieldSpec, Settings


@dataclass(frozen=True)
class Restored:
    """Decoded steps: step (T,), time (T,) [s], gid (m,) ascending, fields {name: (T, m, w)}.

    present : (T, m) bool; where it is False, values are NaN, or 0 for integers. For arrays that
    are no sets of bodies, `array(name)` has their own shape (T, ...).
    """

    steps: NDArray
    times: NDArray
    gid: NDArray
    present: NDArray
    fields: Mapping[str, NDArray]


class Archive:
    """An archive open for reading; also one that is interrupted or still being written.

    fields : {name: FieldSpec}; settings; provenance; complete; steps (F,) and times (F,) of all
    frames; gid : all bodies; decoded_pieces : pieces decoded so far.
    """

    fields: Mapping[str, FieldSpec]
    settings: Settings
    provenance: Mapping[str, Any]
    complete: bool
    steps: NDArray
    times: NDArray
    decoded_pieces: int

    def __init__(self, path: Path | str) -> None:
        """Open. Raises InputError if there is no such file, DataError if it is not to be trusted."""
        raise NotImplementedError

    @property
    def gid(self) -> NDArray:
        """(m,) numbers of all bodies that any chunk has, ascending."""
        raise NotImplementedError

    @property
    def chunks(self) -> Sequence[slice]:
        """The frames of each chunk."""
        raise NotImplementedError

    def read(
        self,
        fields: Sequence[str] | None = None,
        steps: slice = slice(None),  # noqa: B008
        bodies: slice | NDArray | None = None,
    ) -> Restored:
        """Decode frames `steps` (of `self.steps`) of bodies: a range of gid, or some (k,) of them.

        Only chunks and blocks that hold some of it are decoded.
        """
        raise NotImplementedError

    def errors(self, name: str, chunk: int | None = None) -> Errors:
        """Errors of a field as measured when it was coded, of one chunk or of all together."""
        raise NotImplementedError

    def bytes_by_coder(self, name: str | None = None, chunk: int | None = None) -> dict[str, int]:
        """Bytes in pieces by coder; "overhead" is what else the file holds."""
        raise NotImplementedError
