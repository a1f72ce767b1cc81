"""Kernels on lattices are what they are point by point."""

import dataclasses

import numpy as np
import pytest

from stokes.fmm.kernels import KERNELS
from stokes.fmm.windows import windows


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", ["laplace", "stokeslet", "laplace_gradient", "matern52"])
def test_lattices_hold_the_components_of_their_points(name, dtype):
    kernel = dataclasses.replace(KERNELS[name], length=0.7, factor=-1.5)
    axes = np.random.default_rng(5).uniform(-2.0, 2.0, (3, 3, 5))
    axes[1, :, 2] = 0.0  # one point at the origin
    values = windows(kernel, axes, dtype)
    assert values.shape == (3, kernel.n_unique, 5, 5, 5)
    assert values.dtype == dtype
    for lattice, (x, y, z) in zip(values, axes, strict=True):
        grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
        exact = kernel.unique(grid.reshape(-1, 3)).T.reshape(-1, 5, 5, 5)
        # the same operations, but for contractions and the last rounding
        np.testing.assert_allclose(lattice, exact, rtol=8 * np.finfo(dtype).eps, atol=1e-15)
