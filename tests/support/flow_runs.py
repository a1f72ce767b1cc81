"""Trajectories written without a simulation: bodies, a scene that tells of them, some frames."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dem_mpi import __version__
from dem_mpi.bodies import FIELDS
from dem_mpi.output import Field, Trajectory
from dem_mpi.parallel import Parallel
from dem_mpi.scene_bodies import SHAPES

DENSITIES = {"glass": 2500.0, "plastic": 1200.0}


def columns_of(
    position: ArrayLike,
    radius: ArrayLike,
    shape: ArrayLike = "sphere",
    half_length: ArrayLike = 0.0,
    orientation: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    velocity: ArrayLike = 0.0,
    angular_velocity: ArrayLike = 0.0,
    material: ArrayLike = 0,
    gid: ArrayLike | None = None,
) -> dict[str, np.ndarray]:
    """Every column of a frame; what is one value is that of all bodies."""
    position = np.asarray(position, dtype=np.float64).reshape(-1, 3)
    n = len(position)
    number = [SHAPES.index(name) for name in np.broadcast_to(shape, n)]
    values = {
        "position": position,
        "gid": np.arange(n) if gid is None else gid,
        "radius": radius,
        "shape": number,
        "half_length": half_length,
        "orientation": orientation,
        "velocity": velocity,
        "angular_velocity": angular_velocity,
        "material": material,
    }
    return {
        name: np.broadcast_to(value, (n, *FIELDS[name].row_shape)).astype(FIELDS[name].dtype)
        for name, value in values.items()
    }


def write_run(
    path: Path,
    frames: Sequence[Mapping[str, np.ndarray]] | Mapping[str, np.ndarray],
    leave_out: Sequence[str] = (),
    attributes: Mapping[str, Any] | None = None,
    **scene: Any,
) -> Path:
    """Write a sealed trajectory of these columns, frames 0.5 s apart; returns its path.

    The scene says what the columns do, and what `scene` adds to it.
    """
    frames = [frames] if isinstance(frames, Mapping) else frames
    names = [name for name in frames[0] if name not in leave_out]
    fields = [
        Field(
            name,
            np.dtype(FIELDS[name].dtype).str.lstrip("<=|"),
            *(FIELDS[name].row_shape or (1,)),
            FIELDS[name].unit,
        )
        for name in names
    ]
    kinds = {int(k) for columns in frames for k in columns["shape"]} & set(range(len(SHAPES)))
    told = {
        "name": "written",
        "gravity": [0.0, 0.0, -9.81],
        "materials": {name: {"density": value} for name, value in DENSITIES.items()},
        "bodies": [{"shape": SHAPES[k]} for k in sorted(kinds)],
        **scene,
    }
    whole = {"name": "written", "scene": json.dumps(told), "version": __version__, "seed": 0}
    whole |= attributes or {}
    trajectory = Trajectory.create(
        Parallel.alone(), path, fields, whole, bodies=len(frames[0]["gid"])
    )
    for k, columns in enumerate(frames):
        trajectory.write_frame(100 * k, 0.5 * k, columns)
    trajectory.seal()
    return path


def touching_pile(count: int = 3, radius: float = 0.1) -> dict[str, np.ndarray]:
    """Spheres in a row along x, each overlapping the next by a thousandth of a radius."""
    place = np.zeros((count, 3))
    place[:, 0] = 1.999 * radius * np.arange(count)
    return columns_of(place, radius, velocity=(0.0, 0.0, -0.01))
