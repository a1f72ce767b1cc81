"""Random numbers as a function of (seed, group, what for, which body, which attempt).

They are words of a counter-based generator, so any rank makes any body's numbers without drawing
the others', and nothing has to be stored or sent. The sequence is fixed for all versions of the
libraries.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi._kernels_placement import uniform_numbers

WORDS_PER_BLOCK = 4


class Purpose(IntEnum):
    """What numbers are for; different purposes never share a number."""

    PROPERTIES = 0
    AXIS = 1
    VISIT = 2
    ATTEMPT = 3
    INLET = 4


def key_of(seed: int, group: int) -> NDArray[np.uint64]:
    """The generator's key (2,) for one group of bodies."""
    return np.array([seed, group], dtype=np.uint64)


def uniform(
    key: NDArray,
    index: ArrayLike,
    purpose: Purpose = Purpose.PROPERTIES,
    second: int = 0,
    blocks: int = 1,
) -> NDArray[np.float64]:
    """Uniform numbers (n, 4 blocks) in [0, 1) of counters (`index` (n,), `second`)."""
    rows = np.ascontiguousarray(index, dtype=np.int64)
    numbers = np.empty((len(rows), WORDS_PER_BLOCK * blocks))
    uniform_numbers(key, rows, second, 0, int(purpose), blocks, numbers)
    return numbers
