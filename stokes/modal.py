"""Azimuthal Fourier modes of the kernels of Stokes flow between points of meridian planes.

A density tau(theta') = sum_n tau_n e^{in theta'} on a circle makes the field sum_n K_n tau_n
e^{in theta}, components (radial, azimuthal, axial), K_n = int K(t) e^{-int} dt. Written is the
real form R_n: K_n = C R_n C^-1, C = diag(1, i, 1), that is, R_n acts on (tau_r, tau_theta / i,
tau_z). Viscosity is one.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit_threads, prange
from stokes import _kernels_modal as kernels
from stokes.fmm._threads import limited_threads

#: Kernels by name. Single layer S, double layer D (density mu, normal at the source): "velocity",
#: "pressure" (one row), "traction" (normal at the target), "stress" (six rows: rr, r theta, rz,
#: theta theta, theta z, zz).
KINDS = {
    "velocity_single": kernels.VELOCITY_SINGLE,
    "pressure_single": kernels.PRESSURE_SINGLE,
    "traction_single": kernels.TRACTION_SINGLE,
    "velocity_double": kernels.VELOCITY_DOUBLE,
    "pressure_double": kernels.PRESSURE_DOUBLE,
    "traction_double": kernels.TRACTION_DOUBLE,
    "stress_single": kernels.STRESS_SINGLE,
    "stress_double": kernels.STRESS_DOUBLE,
}

_CHUNK = 64


@jit_threads
def _pairs(kind, target, source, difference, offsets, n_max, out):
    n_pairs = target.shape[0]
    for chunk in prange((n_pairs + _CHUNK - 1) // _CHUNK):
        workspace = kernels.new_workspace(n_max)
        for k in range(chunk * _CHUNK, min(n_pairs, (chunk + 1) * _CHUNK)):
            kernels.modal_modes(
                kind,
                (target[k, 0], target[k, 2], target[k, 3]),
                (source[k, 0], source[k, 2], source[k, 3]),
                difference[k, 0],
                difference[k, 1],
                (offsets[k, 0], offsets[k, 1]),
                n_max,
                workspace,
                out[k],
            )


def modal_kernel(
    kind: str,
    target: np.ndarray,
    source: np.ndarray,
    difference: np.ndarray | None = None,
    offsets: np.ndarray | None = None,
    n_max: int = 0,
    threads: int = 1,
) -> np.ndarray:
    """Return modes 0..n_max of a kernel for pairs of points, real form: (n, n_max + 1, rows, 3).

    `kind` is a key of `KINDS`; rows are 3, of pressures 1, of stresses 6. `target` and `source`
    are (n, 4): r >= 0, z, and the unit normal's components along r and z. `difference` (n, 2),
    target minus source, must be given to full relative precision where the points are close;
    `offsets` (n, 2), nu.(x - x') and nu'.(x - x') in the meridian plane, too where both points lie
    on one smooth curve, as there they are of second order. Both are else taken from the
    coordinates. Raises ValueError where target and source coincide.
    """
    if kind not in KINDS:
        raise ValueError(f"kernel {kind!r} is none of {', '.join(KINDS)}")
    target = _rows(target, 4, "target")
    source = _rows(source, 4, "source", len(target))
    if n_max < 0:
        raise ValueError(f"mode {n_max} is negative")
    if difference is None:
        difference = target[:, :2] - source[:, :2]
    difference = _rows(difference, 2, "difference", len(target))
    if offsets is None:
        offsets = np.stack(
            [np.sum(side[:, 2:] * difference, axis=1) for side in (target, source)], axis=1
        )
    offsets = _rows(offsets, 2, "offsets", len(target))
    if np.any(target[:, 0] < 0.0) or np.any(source[:, 0] < 0.0):
        raise ValueError("radii must not be negative")
    if not np.all(np.sum(difference**2, axis=1) > 0.0):
        raise ValueError("target and source coincide")
    code = KINDS[kind]
    out = np.empty((len(target), n_max + 1, kernels.ROWS[code], 3))
    with limited_threads(threads):
        _pairs.using(threads)(code, target, source, difference, offsets, n_max, out)
    return out


def _rows(values: np.ndarray, width: int, name: str, count: int | None = None) -> np.ndarray:
    """Return `values` as floats of shape (count, width); ValueError for any other shape."""
    values = np.ascontiguousarray(values, dtype=float)
    if values.ndim != 2 or values.shape[1] != width or (count or len(values)) != len(values):
        wanted = "n" if count is None else count
        raise ValueError(f"{name} must be of shape ({wanted}, {width}), not {values.shape}")
    return values
