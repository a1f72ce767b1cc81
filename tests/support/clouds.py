"""Clouds of points that are easy, thin, clustered or degenerate, for trees and lists."""

from __future__ import annotations

import numpy as np


def cube(n, rng):
    return rng.random((n, 3))


def sphere(n, rng):
    x = rng.standard_normal((n, 3))
    return x / np.linalg.norm(x, axis=1)[:, None]


def prolate_spheroid(n, rng):
    return sphere(n, rng) * [0.1, 0.1, 1.0]


def clustered(n, rng):
    """Balls of radii 1, 0.1, ... 1e-5 about random centres."""
    radius = 10.0 ** -rng.integers(0, 6, n)
    centre = rng.random((6, 3))[rng.integers(0, 6, n)]
    return centre + radius[:, None] * (rng.random((n, 3)) - 0.5)


def two_far_clusters(n, rng):
    return 1e-4 * rng.random((n, 3)) + (np.arange(n) % 2)[:, None]


def collinear(n, rng):
    return rng.random((n, 1)) * [1.0, 2.0, -0.5]


def all_equal(n, rng):
    return np.tile(rng.random(3), (n, 1))
