"""Vector fields on a surface of revolution as azimuthal Fourier modes, in the real form.

A field f(s, theta) has components (radial, azimuthal, axial) in the frame of its own azimuth, and
each of them the modes f(s, theta) = sum over n of f_n(s) e^{i n theta}. An operator that rotations
about the axis leave alone takes mode n to mode n by a kernel C R C^-1, C = diag(1, i, 1), R real.
R therefore acts on the coefficients (f_r, f_theta / i, f_z), on real and imaginary parts alike.
Fields are real, so that modes n >= 0 suffice.

Coefficients of m fields are kept as real rows, the layout in which LAPACK solves for all of them
and a matrix product applies R: array (modes + 1, 2 m, 3 n_s), row 2 k (+ 1) of the second axis the
real (imaginary) part of field k, the last axis ordered (component, node).

Symbols: n_s nodes on the meridian, n_theta = 2 modes + 1 equal azimuths 2 pi k / n_theta, m fields.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Array = NDArray[np.float64]


def azimuths(n_theta: int) -> Array:
    """theta_k = 2 pi k / n_theta, (n_theta,)."""
    return 2.0 * math.pi / n_theta * np.arange(n_theta)


def to_modes(field: Array) -> Array:
    """Coefficients (modes + 1, 2 m, 3 n_s) of local Cartesian fields (n_s, n_theta, 3[, m]).

    n_theta must be odd: then n_theta values and the modes up to (n_theta - 1) / 2 determine each
    other, and `from_modes` undoes this to round-off.
    """
    field = np.asarray(field, dtype=np.float64)
    n_s, n_theta = field.shape[:2]
    if n_theta % 2 == 0:
        raise ValueError(f"{n_theta} azimuths: their number must be odd")
    x, y, z = np.moveaxis(field.reshape(n_s, n_theta, 3, -1), (2, 1), (0, 3))
    cos, sin = _frame(n_theta)
    components = np.stack((cos * x + sin * y, cos * y - sin * x, z))
    coefficients = scipy.fft.rfft(components, axis=-1, norm="forward", overwrite_x=True)
    coefficients[1] *= -1j
    modes = np.moveaxis(coefficients, (3, 2, 0), (0, 1, 2))
    rows = np.stack((modes.real, modes.imag), axis=2)
    return rows.reshape(n_theta // 2 + 1, -1, 3 * n_s)


def from_modes(coefficients: Array, n_theta: int, fields: tuple[int, ...] = ()) -> Array:
    """Local Cartesian fields (n_s, n_theta, 3) + fields of coefficients (modes + 1, 2 m, 3 n_s).

    n_theta may exceed 2 modes + 1: the fields are then the same trigonometric polynomials on a
    finer grid. `fields` is () for a single field or (m,).
    """
    n_modes, rows, length = coefficients.shape
    parts = coefficients.reshape(n_modes, rows // 2, 2, 3, length // 3)
    modes = np.empty((3, length // 3, rows // 2, n_modes), dtype=np.complex128)
    modes.real = np.moveaxis(parts[:, :, 0], (2, 3, 1, 0), (0, 1, 2, 3))
    modes.imag = np.moveaxis(parts[:, :, 1], (2, 3, 1, 0), (0, 1, 2, 3))
    modes[1] *= 1j
    radial, azimuthal, axial = scipy.fft.irfft(
        modes, n=n_theta, axis=-1, norm="forward", overwrite_x=True
    )
    cos, sin = _frame(n_theta)
    field = np.empty((length // 3, n_theta, 3, rows // 2))
    field[:, :, 0] = np.swapaxes(cos * radial - sin * azimuthal, 1, 2)
    field[:, :, 1] = np.swapaxes(sin * radial + cos * azimuthal, 1, 2)
    field[:, :, 2] = np.swapaxes(axial, 1, 2)
    return field.reshape(length // 3, n_theta, 3, *fields)


def _frame(n_theta: int) -> tuple[Array, Array]:
    theta = azimuths(n_theta)
    return np.cos(theta), np.sin(theta)
