"""Scenes run with overrides, kept under build/bench, and what their output says."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from records import BUILD, ROOT, mpirun

from dem_mpi.scenario import load_scenario


@dataclass(frozen=True)
class Run:
    """The output of a finished run."""

    directory: Path

    def metrics(self, *keys: str) -> tuple[NDArray[np.float64], ...]:
        """One array (steps,) for each key of metrics.jsonl."""
        lines = (self.directory / "metrics.jsonl").read_text().splitlines()
        rows = [json.loads(line) for line in lines]
        return tuple(np.array([row[key] for row in rows], dtype=float) for key in keys)

    def reaction(self, wall: str) -> NDArray[np.float64]:
        """Mean force [N] and torque [N m] on a wall in each step, (steps, 6)."""
        lines = (self.directory / "metrics.jsonl").read_text().splitlines()
        return np.array([json.loads(line)["walls"][wall] for line in lines])

    def frames(self, *fields: str) -> list[tuple[float, dict[str, NDArray]]]:
        """Time [s] and the asked fields of each frame, rows by gid."""
        found = []
        with h5py.File(self.directory / "run.h5") as file:
            count = int(file["VTKHDF/Steps"].attrs["NSteps"])
            for k in range(count):
                first = file["frames/offset"][k]
                rows = slice(first, first + file["frames/count"][k])
                order = np.argsort(file["gid"][rows])
                frame = {name: file[name][rows][order] for name in fields}
                found.append((float(file["frames/time"][k]), frame))
        return found


def run(scene: str, overrides: dict[str, Any]) -> Run:
    """Run configs/<scene>.yaml on one rank, or go on with it, or take the finished run."""
    path = ROOT / "configs" / f"{scene}.yaml"
    settings = [f"{key}={json.dumps(value)}" for key, value in overrides.items()]
    effective = load_scenario(path, settings).scenario.model_dump_json()
    name = f"{scene}-{hashlib.sha256(effective.encode()).hexdigest()[:12]}"
    directory = BUILD / "granular" / name
    done = directory / "done"
    if not done.exists():
        directory.mkdir(parents=True, exist_ok=True)
        command = ["-m", "dem_mpi", "run", str(path), "--out", str(directory), "--resume"]
        for setting in settings:
            command += ["--set", setting]
        mpirun(1, command)
        done.write_text("\n".join(settings) + "\n")
    return Run(directory)
