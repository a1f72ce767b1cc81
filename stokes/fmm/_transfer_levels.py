"""What transfers on grids of every kind have in common: the levels that have far pairs."""

from __future__ import annotations

from collections.abc import Iterator

from numpy.typing import NDArray

from stokes.fmm.kernels import Kernel

# The coarsest level of a standard tree with two boxes apart enough (4 boxes per edge).
FIRST_FAR_LEVEL = 2


def is_smooth(admissibility: str) -> bool:
    """Whether boxes of the last level reach their neighbours too. ValueError if neither is said."""
    if admissibility not in ("standard", "smooth"):
        raise ValueError(f"admissibility = {admissibility!r}: must be standard or smooth")
    return admissibility == "smooth"


def levels_with_tables(
    kernel: Kernel, edges: NDArray, smooth: bool
) -> Iterator[tuple[int, float, bool]]:
    """(level, edge, whether neighbours are among the far pairs) of every table.

    edges (levels,): of a box at each level, root first. A homogeneous kernel has one table for
    all levels, as level 0, of boxes of edge 1.
    """
    last = len(edges) - 1
    first = min(FIRST_FAR_LEVEL, last) if smooth else FIRST_FAR_LEVEL
    if last < first:
        return
    if kernel.degree is not None:
        yield 0, 1.0, smooth
        return
    for level in range(first, last + 1):
        yield level, edges[level], smooth and level == last
