"""The run that compress.py compresses, chunk by chunk, and the phases of it.

SEDIMENT is configs/sediment_archive.yaml, after S. De, PhD thesis, University of Michigan 2021,
section 4.4, solved to 1e-4 m/s: below that, velocities at rest are noise of the contact solver.
It is run once, on two ranks, and kept under build/bench/compress; `quick` is a quarter of it, on a
quarter of the floor.

Phases, by what a chunk ends with: f, the part of the bodies that have touched nothing yet (their
velocity is g t), and s, the root mean square speed over the largest one of the run.

    free fall  f = 1
    onset      1/2 <= f < 1
    impact     1/8 <= f < 1/2
    landed     f < 1/8 and s > 1/10
    settling   1/100 < s <= 1/10
    rest       s <= 1/100
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from records import BUILD, ROOT, mpirun

CACHE = BUILD / "compress"
SCENE = ROOT / "configs" / "sediment_archive.yaml"
FIELDS = ("velocity", "position", "angular_velocity")
PHASES = ("free fall", "onset", "impact", "landed", "settling", "rest")
TAUS = (1e-1, 1e-2, 1e-3)
STEPS = 32  # of a chunk
STEP = 1e-3  # s
GRAVITY = 9.81  # m/s^2
TOLERANCE = "contact.tolerance=1e-4"
QUARTER = (
    "bodies.0.count=4096",
    "bodies.0.placement.jittered_grid.min=[-0.5, -0.5, -0.5]",
    "bodies.0.placement.jittered_grid.max=[0.5, 0.5, 0.5]",
    "walls.0.min=[-0.5, -0.5, -0.5]",
    "walls.0.max=[0.5, 0.5, 0.5]",
)


@dataclass(frozen=True)
class Sediment:
    """A run of SEDIMENT: `chunks` of STEPS frames each, bodies in the order of their gids."""

    quick: bool = False

    @property
    def settings(self) -> tuple[str, ...]:
        """What differs from the scene file."""
        return (TOLERANCE, *(QUARTER if self.quick else ()))

    @property
    def bodies(self) -> int:
        return 4096 if self.quick else 16384

    @property
    def count(self) -> int:
        """Values of a field in a chunk."""
        return STEPS * self.bodies * 3

    @cached_property
    def chunks(self) -> tuple[int, ...]:
        """Those that are compressed: all 32, or every third, which leaves out no phase."""
        return tuple(range(0, 32, 3 if self.quick else 1))

    @cached_property
    def digest(self) -> str:
        """Names the run's directory: of the scene, without its comments, and of the settings."""
        lines = SCENE.read_text().splitlines()
        text = "\n".join([*(x for x in lines if not x.startswith("#")), *self.settings])
        return hashlib.sha256(text.encode()).hexdigest()[:8]

    @property
    def directory(self) -> Path:
        return CACHE / f"sediment-{self.bodies}-{self.digest}"

    @property
    def trajectory(self) -> Path:
        return self.directory / "run.h5"

    def make(self) -> None:
        """Simulate, or go on with it, unless it is there: 1 to 2 minutes on two ranks, 2.1 GB."""
        if (self.directory / "done").exists():
            return
        begun = any(self.directory.glob("run.checkpoint.*"))
        simulate(SCENE, self.directory, self.settings, resume=begun)
        (self.directory / "done").touch()

    def times(self, chunk: int) -> NDArray:
        """[s] of the frames of a chunk, (STEPS,); that at 0 s belongs to none."""
        return STEP * (STEPS * chunk + np.arange(1, STEPS + 1))

    def load(self, chunk: int, fields: tuple[str, ...]) -> dict[str, NDArray]:
        """The fields of a chunk, each (STEPS, bodies, 3) float64, by gid."""
        n = self.bodies
        found = {name: np.empty((STEPS, n, 3)) for name in fields}
        with h5py.File(self.trajectory) as file:
            frames, points = file["frames"], file["VTKHDF/PointData"]
            for k in range(STEPS):
                start = int(frames["offset"][STEPS * chunk + k + 1])
                rows = slice(start, start + n)
                order = np.argsort(points["gid"][rows])
                for name, values in found.items():
                    data = file["VTKHDF/Points"] if name == "position" else points[name]
                    values[k] = data[rows][order]
        return found

    def norms(self, field: str) -> tuple[float, ...]:
        """||X||_F of each of the 32 chunks of a field."""
        known = self.directory / f"norms-{field}.json"
        if not known.exists():
            norms = [float(np.linalg.norm(self.load(k, (field,))[field])) for k in range(32)]
            known.write_text(json.dumps(norms))
        return tuple(json.loads(known.read_text()))

    @cached_property
    def phases(self) -> tuple[str, ...]:
        """The phase of each of the 32 chunks."""
        known = self.directory / "phases.json"
        if not known.exists():
            known.write_text(json.dumps(self._phases()))
        return tuple(json.loads(known.read_text()))

    def _phases(self) -> list[str]:
        untouched, speed, largest = [], [], 0.0
        for chunk in range(32):
            v = self.load(chunk, ("velocity",))["velocity"]
            fall = np.array([0.0, 0.0, -GRAVITY * self.times(chunk)[-1]])
            off = np.abs(v[-1] - fall).max(axis=1)
            untouched.append(float((off <= 1e-6 * np.abs(fall[2])).mean()))
            rms = np.sqrt((v**2).sum(axis=2).mean(axis=1))
            speed.append(float(rms[-1]))
            largest = max(largest, float(rms.max()))
        return [phase(f, s / largest) for f, s in zip(untouched, speed, strict=True)]


def simulate(scene: Path, place: Path, settings: Iterable[str], resume: bool = False) -> None:
    """Run a scene on two ranks."""
    command = ["-m", "dem_mpi", "run", str(scene), "--out", str(place)]
    command += [word for setting in settings for word in ("--set", setting)]
    mpirun(2, command + ["--resume"] * resume)


def phase(untouched: float, speed: float) -> str:
    """The phase that a chunk is of, by the rule above."""
    if untouched == 1.0:
        return "free fall"
    if untouched >= 0.125:
        return "onset" if untouched >= 0.5 else "impact"
    if speed > 0.1:
        return "landed"
    return "settling" if speed > 0.01 else "rest"
