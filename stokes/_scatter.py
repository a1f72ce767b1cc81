"""Sums of rows by the target they belong to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Scatter:
    """Adds rows of entries to the targets they belong to, always in the order of the entries."""

    def __init__(self, target: NDArray[np.int64]) -> None:
        """target (e,): of each entry."""
        self._order = np.argsort(target, kind="stable")
        arranged = target[self._order]
        self._first = np.flatnonzero(np.diff(arranged, prepend=-1))
        self._target = arranged[self._first]

    def add(self, rows: NDArray, out: NDArray) -> None:
        """Add rows (e, ...) to out (targets, ...)."""
        if len(self._target):
            out[self._target] += np.add.reduceat(rows[self._order], self._first, axis=0)
