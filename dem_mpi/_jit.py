"""The one decorator of every compiled kernel, and kernels that exist with and without threads."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

import numba
from numba.core import event

prange = numba.prange


def jit(function: Callable, *, parallel: bool = False) -> Callable:
    """Compile with numba: cached on disk, without the GIL, IEEE arithmetic (no fast-math).

    Fast-math would let the compiler reorder sums and contract products, and a contact found on
    one rank could be missed on another.
    """
    return numba.njit(cache=True, nogil=True, parallel=parallel, error_model="numpy")(function)


@dataclass(frozen=True)
class ThreadedKernel:
    """One Python source compiled twice: plain, and with its `prange` loops spread over threads.

    Sums inside such kernels are taken over chunks of fixed length and added up in order, so both
    give the same bits. A rank with one thread never pays for starting a team.
    """

    serial: Callable
    threaded: Callable

    def using(self, threads: int) -> Callable:
        """Return the variant for this number of threads a rank."""
        return self.threaded if threads > 1 else self.serial


def jit_threads(function: Callable) -> ThreadedKernel:
    """Compile a function whose `prange` loops may be spread over threads (decorator)."""
    # numba's disk cache tells functions apart by name, not by options: the copy needs its own.
    copy = types.FunctionType(function.__code__, function.__globals__, function.__name__)
    copy.__name__ = function.__name__ + "_threads"
    copy.__qualname__ = function.__qualname__ + "_threads"
    copy.__module__ = function.__module__
    return ThreadedKernel(jit(function), jit(copy, parallel=True))


class CompileClock(event.Listener):
    """Kernels compiled so far, not loaded from the disk cache, and the seconds that it took."""

    def __init__(self) -> None:
        self.count = 0
        self.seconds = 0.0
        self._depth = 0
        self._began = 0.0

    def on_start(self, found: event.Event) -> None:
        """Begin a compilation, maybe inside another one."""
        if self._depth == 0:
            self._began = perf_counter()
        self._depth += 1
        self.count += 1

    def on_end(self, found: event.Event) -> None:
        """End it."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += perf_counter() - self._began


@contextmanager
def compile_clock() -> Iterator[CompileClock]:
    """Count what this process compiles within the block."""
    clock = CompileClock()
    event.register("numba:compile", clock)
    try:
        yield clock
    finally:
        event.unregister("numba:compile", clock)
