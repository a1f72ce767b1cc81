"""Kernels that measure errors, without temporary arrays of the size of a block."""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

PART = 512  # entries summed by themselves: sums stay short, which keeps their rounding errors small


@jit
def extremes(values, decoded):
    """Largest |x - y|, largest |x|, least and most x of arrays (N,) of finite x, N > 0."""
    difference = 0.0
    least = most = np.float64(values[0])
    for k in range(len(values)):
        x = np.float64(values[k])
        difference = max(difference, abs(x - np.float64(decoded[k])))
        least = min(least, x)
        most = max(most, x)
    return difference, max(-least, most), least, most


@jit
def squares(values, decoded, difference_scale, scale):
    """Sums of squares of (x - y) difference_scale and of x scale, of arrays (N,)."""
    differences = norms = 0.0
    for first in range(0, len(values), PART):
        error = norm = 0.0
        for k in range(first, min(first + PART, len(values))):
            x = np.float64(values[k])
            e = (x - np.float64(decoded[k])) * difference_scale
            error += e * e
            norm += (x * scale) * (x * scale)
        differences += error
        norms += norm
    return differences, norms


@jit
def largest(values):
    """The largest |x| of an array (N,), NaN if there is one."""
    found = 0.0
    for k in range(len(values)):
        size = abs(np.float64(values[k]))
        if not size <= found:
            if np.isnan(size):
                return size
            found = size
    return found


@jit
def sum_of_squares(values, scale):
    """That of x scale, of an array (N,)."""
    total = 0.0
    for first in range(0, len(values), PART):
        part = 0.0
        for k in range(first, min(first + PART, len(values))):
            x = np.float64(values[k]) * scale
            part += x * x
        total += part
    return total
