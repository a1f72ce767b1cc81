"""Bodies that fall, hit a floor and come to rest: small data with the phases of a granular flow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from compress.archive import Block, Chunk, FieldSpec, Settings
from compress.bounds import Bound

STEP = 1e-3  # [s]


def falling_bodies(
    bodies: int = 40, steps: int = 64, seed: int = 7
) -> tuple[NDArray, NDArray, NDArray]:
    """position, velocity (T, n, 3) with x_t = x_{t-1} + h v_t, and times (T,) [s]."""
    rng = np.random.default_rng(seed)
    velocity = np.zeros((steps, bodies, 3))
    landing = rng.integers(steps // 4, steps // 2, bodies)
    for t in range(1, steps):
        free = t < landing
        velocity[t, free] = velocity[t - 1, free] + [0.0, 0.0, -9.81 * STEP]
        hit = t == landing
        velocity[t, hit] = rng.normal(0.0, 0.1, (int(hit.sum()), 3))
        velocity[t, t > landing] = 0.8 * velocity[t - 1, t > landing]
    position = np.cumsum(STEP * velocity, axis=0) + rng.uniform(0.0, 1.0, (bodies, 3))
    return position, velocity, STEP * np.arange(steps)


FIELDS = {
    "position": FieldSpec(Bound("pointwise", 1e-5), width=3, unit="m", guide="velocity"),
    "velocity": FieldSpec(Bound("relative", 1e-2), width=3, unit="m/s"),
    "contacts": FieldSpec(Bound("exact"), dtype="i4"),
}
SETTINGS = Settings(step_size=STEP)


def chunk_of(number: int, length: int = 16, ranks: int = 1, **of_bodies) -> Chunk:
    """Chunk `number` of falling bodies, split over ranks by every `ranks`-th body."""
    position, velocity, times = falling_bodies(**of_bodies)
    frames = slice(number * length, (number + 1) * length)
    contacts = (position[:, :, 2:] < 0.5).astype(np.int32)
    every = {"position": position, "velocity": velocity, "contacts": contacts}
    gid = np.arange(position.shape[1])
    blocks = tuple(
        Block(
            gid[r::ranks], {n: np.ascontiguousarray(v[frames, r::ranks]) for n, v in every.items()}
        )
        for r in range(ranks)
    )
    return Chunk(np.arange(len(times))[frames], times[frames], blocks)
