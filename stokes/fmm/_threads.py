"""How many threads compiled loops may take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba


def most_threads() -> int:
    """Threads that there are: the machine's, unless numba was told of fewer."""
    return numba.config.NUMBA_NUM_THREADS


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Loops inside the block take at most so many threads; afterwards as many as before.

    One thread needs no limit, as it takes the loops compiled without threads.
    """
    if threads == 1:
        yield
        return
    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, most_threads()))
    try:
        yield
    finally:
        numba.set_num_threads(before)
