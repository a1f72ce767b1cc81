"""The one decorator of every compiled kernel, and kernels that exist with and without threads."""

from __future__ import annotations

import types
from collections.abc import Callable
from dataclasses import dataclass

import numba

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
