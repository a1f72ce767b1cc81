"""The one decorator of every compiled kernel."""

from __future__ import annotations

import numba

prange = numba.prange


def jit(function=None, *, parallel: bool = False):
    """Compile with numba: cached on disk, without the GIL, IEEE arithmetic (no fast-math).

    Fast-math would let the compiler reorder sums and contract products, and a contact found on
    one rank could be missed on another.
    """
    decorate = numba.njit(cache=True, nogil=True, parallel=parallel, error_model="numpy")
    return decorate if function is None else decorate(function)
