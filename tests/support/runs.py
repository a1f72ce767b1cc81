"""Small scenes, runs inside a test, and comparison of what runs leave behind, bit for bit."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dem_mpi.errors import StoppedError
from dem_mpi.parallel import Parallel
from dem_mpi.runner import RunOptions, run
from dem_mpi.scenario import parse_scenario
from dem_mpi.signals import StopRequest

# Spheres of two sizes, pressed together by an oscillating box, with friction; loose enough a
# tolerance for few iterations, and a limit on them that some steps reach.
PILE = """
name: pile
domain: {min: [-1, -1, -1], max: [1, 1, 2]}
materials: {glass: {density: 2500}}
friction: {default: 0.4}
bodies:
  - {material: glass, count: 60, radius: {uniform: [0.03, 0.05]},
     placement: {jittered_grid: {min: [0, 0, 0.0], max: [0.5, 0.4, 0.45], jitter: 0.5}},
     velocity: [0.5, 0, -1], velocity_jitter: 0.5}
walls:
  - {shape: box, name: box, material: glass, min: [0, 0, 0], max: [0.5, 0.4, 0.6], open: [z_max],
     motion: {oscillation: {amplitude: [0.01, 0, 0], frequency: 5}}}
time: {step: 2e-3, end: 0.08}
contact: {tolerance: 1e-3, complementarity: 1e-2, max_iterations: 25, stop_factor: 1e9, skin: 1}
output:
  interval: 6e-3
  fields: [position, velocity, angular_velocity, orientation, radius, gid, material]
checkpoint: {interval: 1.4e-2}
"""

# Spheres without friction that slide off a plane and are removed at the border of the domain,
# the smallest of them (the last of the radii) too.
LEAVING = """
name: leaving
domain: {min: [-0.2, -0.2, -0.2], max: [0.45, 0.6, 1], on_leave: remove}
materials: {glass: {density: 2500}}
bodies:
  - {material: glass, count: 50, radius: [0.03, 0.028, 0.026, 0.024, 0.012],
     placement: {jittered_grid: {min: [0, 0, 0.0], max: [0.4, 0.4, 0.3], jitter: 0.5}},
     velocity: [1.5, 0, -1], velocity_jitter: 0.3}
walls:
  - {shape: plane, name: floor, material: glass, point: [0, 0, 0], normal: [0, 0, 1]}
time: {step: 4e-3, end: 0.16}
contact: {tolerance: 1e-3, complementarity: 1e-2, max_iterations: 200, skin: 3}
output: {interval: 8e-3}
checkpoint: {interval: 2e-2, keep: 3}
"""

# What a clock or the system says, which no two runs have in common.
_CLOCKS = ("seconds", "memory")


class StopAfter(StopRequest):
    """A stop that comes in each of the given steps of a run, one run after the other."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self._left = steps

    @property
    def requested(self) -> bool:
        self._left -= 1
        if self._left <= 0:
            self.name = "SIGUSR1"
        return self._left <= 0


def simulate(
    parallel: Parallel,
    scene: str,
    directory: Path,
    *overrides: str,
    resume: bool = False,
    force: bool = False,
    steps: int | None = None,
    on_stage: Any = None,
) -> list[str]:
    """Collective. Run a scene, `steps` steps of it or all; return what it tells the user."""
    said: list[str] = []
    options = RunOptions(directory, resume, force)
    hooks = {} if on_stage is None else {"on_stage": on_stage}
    loaded = parse_scenario(scene, "scene.yaml", overrides)
    stop = StopRequest() if steps is None else StopAfter(steps)
    try:
        run(parallel, loaded, options, stop, said.append, **hooks)
    except StoppedError as error:
        said.append(str(error))
    return said


def messages(stderr: str) -> list[str]:
    """The lines of standard error, without what the event loop of Open MPI says of closed pipes."""
    return [line for line in stderr.splitlines() if not line.startswith("[warn] Epoll")]


def contents(path: Path) -> dict[str, Any]:
    """Every attribute and every data set of a file, as bytes with type and shape."""
    found: dict[str, Any] = {}

    def add(name: str, item: Any) -> None:
        for key, value in item.attrs.items():
            found[f"{name}@{key}"] = np.asarray(value).tolist()
        if isinstance(item, h5py.Dataset):
            values = item[()]
            found[name] = (values.dtype.str, values.shape, values.tobytes())

    with h5py.File(path, "r", locking=False) as file:
        add("/", file)
        file.visititems(add)
    return found


def metrics(directory: Path) -> list[dict[str, Any]]:
    """The lines of metrics.jsonl without what a clock says."""
    lines = (directory / "metrics.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(s).items() if k not in _CLOCKS} for s in lines]


def last_step(directory: Path) -> int:
    """The last step that metrics.jsonl tells of, while a run may be writing it."""
    try:
        lines = (directory / "metrics.jsonl").read_text().splitlines()
        return json.loads(lines[-1])["step"] if lines else 0
    except (OSError, ValueError):
        return 0


def checkpoints(directory: Path) -> list[Path]:
    """The checkpoints in a directory, the newest last."""
    return sorted(directory.glob("run.checkpoint.*.h5"))


def differences(one: Path, other: Path) -> list[str]:
    """What two finished runs do not have in common: data sets, attributes, steps of metrics."""
    found = []
    for name in ("run.h5", checkpoints(one)[-1].name):
        a, b = contents(one / name), contents(other / name)
        keys = sorted(a.keys() | b.keys())
        found += [f"{name}: {key}" for key in keys if a.get(key) != b.get(key)]
    return found + _metric_differences(metrics(one), metrics(other))


def _metric_differences(one: list[dict[str, Any]], other: list[dict[str, Any]]) -> list[str]:
    found = [] if len(one) == len(other) else [f"metrics: {len(one)} and {len(other)} lines"]
    for a, b in zip(one, other, strict=False):
        # A list that stands is made again by resuming, outside a step; so nothing is sent in one.
        unequal = [key for key in a if key != "bytes_sent" and a[key] != b.get(key)]
        found += [f"metrics: {key} of step {a['step']}" for key in unequal]
    return found


def damage(path: Path, offset: int, bits: int = 0xFF) -> None:
    """Flip bits of one byte."""
    with path.open("r+b") as file:
        file.seek(offset)
        byte = file.read(1)[0]
        file.seek(offset)
        file.write(bytes([byte ^ bits]))


def dataset_offsets(path: Path) -> Iterable[tuple[str, int, int]]:
    """(name, first byte, bytes) of every data set that stands in one piece."""
    found: list[tuple[str, int, int]] = []

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.id.get_offset() is not None:
            found.append((name, item.id.get_offset(), item.id.get_storage_size()))

    with h5py.File(path, "r", locking=False) as file:
        file.visititems(add)
    return found
