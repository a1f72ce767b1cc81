"""Rods and spheroids poured into a box, configs/rods.yaml at its reduced size on two ranks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from launch import ROOT, run_ranks
from scene_header import read_header

SCENE = ROOT / "configs" / "rods.yaml"
H = 1e-3  # [s] time step
INTERVAL = 0.02  # [s] between frames
GRAVITY = np.array([0, 0, -9.81])
RADIUS, ASPECT, DENSITY = 0.006, 4, 700.0
WIDTH = 0.12  # [m] of the box
VOLUME = {
    "spherocylinder": np.pi * RADIUS**3 * (2 * (ASPECT - 1) + 4 / 3),
    "spheroid": 4 / 3 * np.pi * RADIUS**3 * ASPECT,
}


@dataclass(frozen=True)
class Bed:
    """The last two frames, (2, n, ...) in the order of gid, and the metrics."""

    shape: str
    position: NDArray
    velocity: NDArray
    orientation: NDArray
    half_length: NDArray
    force: NDArray  # (faces, 3) [N] on the walls, mean over the last interval
    metrics: list[dict]

    @property
    def axis(self) -> NDArray:
        """Symmetry axes of the last frame (n, 3): the body's z axis in the world."""
        w, x, y, z = self.orientation[1].T
        return np.stack(
            [2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], 1
        )

    @property
    def reach(self) -> NDArray:
        """How far each body extends from its centre along x, y, z in the last frame (n, 3) [m]."""
        along = self.half_length[1][:, None] * np.abs(self.axis)
        if self.shape == "spherocylinder":
            return along + RADIUS
        return np.sqrt(along**2 + RADIUS**2 * (1 - self.axis**2))


@pytest.fixture(scope="module", params=["spherocylinder", "spheroid"])
def bed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Bed:
    path = tmp_path_factory.mktemp(request.param)
    arguments = ["-m", "dem_mpi", "run", SCENE, "--out", path]
    for override in (*read_header(SCENE).reduced, f"bodies.0.shape={request.param}"):
        arguments += ["--set", override]
    done = run_ranks(2, arguments, timeout=300)
    assert done.returncode == 0, done.stderr
    return read(path, request.param)


def read(path: Path, shape: str) -> Bed:
    names = ("position", "velocity", "orientation", "half_length")
    with h5py.File(path / "run.h5") as file:
        frames = int(file["VTKHDF/Steps"].attrs["NSteps"])
        found: dict[str, list[NDArray]] = {name: [] for name in names}
        for k in (frames - 2, frames - 1):
            first, count = int(file["frames/offset"][k]), int(file["frames/count"][k])
            rows = slice(first, first + count)
            order = np.argsort(file["gid"][rows])
            for name in names:
                found[name].append(file[name][rows][order])
        force = file["walls/force"][frames - 1]
    lines = (path / "metrics.jsonl").read_text().splitlines()
    fields = {name: np.stack(values) for name, values in found.items()}
    return Bed(shape, **fields, force=force, metrics=[json.loads(s) for s in lines])


def test_bodies_lie_in_the_box_and_touch_its_floor(bed: Bed) -> None:
    """As orientation and half length in the file say: to the overlap that the metrics report."""
    slack = 2 * RADIUS * max(line["overlap"] for line in bed.metrics[-100:]) + 1e-12
    low = bed.position[1] - bed.reach
    high = bed.position[1] + bed.reach
    assert low.min() >= -slack
    assert high[:, :2].max() <= WIDTH + slack
    assert low[:, 2].min() <= 0.02 * RADIUS  # a contact's margin
    assert np.linalg.norm(bed.orientation, axis=2) == pytest.approx(1, rel=0, abs=1e-14)


def test_bodies_lie_down(bed: Bed) -> None:
    """Directions without order have a mean |cos| to the vertical of 1/2, with a scatter of
    1 / sqrt(12 n); a poured bed is five of these below."""
    count = bed.axis.shape[0]
    assert np.abs(bed.axis[:, 2]).mean() < 0.5 - 5 / np.sqrt(12 * count)


def test_bed_is_as_dense_as_random_packings_of_its_bodies(bed: Bed) -> None:
    """Mean over the height of a box 2.5 lengths wide: between a loose 0.42 and the 0.65 that
    rods and spheroids of this length reach far from walls."""
    solid = VOLUME[bed.shape] * len(bed.position[1]) / WIDTH**2
    assert 0.42 < solid / (2 * bed.position[1][:, 2].mean()) < 0.65


def test_bed_comes_to_rest(bed: Bed) -> None:
    """Single bodies may still rock; the mean speed is below that of a step of free fall, h g."""
    assert bed.metrics[-1]["kinetic_speed"] < H * 9.81
    assert all(line["converged"] for line in bed.metrics)


def test_walls_take_weight_and_momentum_of_the_bed(bed: Bed) -> None:
    """Over the last interval, in all three directions: to the round-off of the largest impulse."""
    mass = DENSITY * VOLUME[bed.shape]
    change = mass * (bed.velocity[1] - bed.velocity[0]).sum(axis=0)
    weight = mass * len(bed.position[1]) * GRAVITY
    given = INTERVAL * (weight - bed.force.sum(axis=0))
    assert change == pytest.approx(given, rel=0, abs=1e-12 * INTERVAL * np.abs(weight).max())


def test_energy_changes_by_what_the_contacts_do(bed: Bed) -> None:
    """In every step, of bodies whose inertia turns with them."""
    largest = max(line["kinetic_energy"] for line in bed.metrics)
    for line in bed.metrics:
        assert line["energy_change"] == pytest.approx(
            line["energy_balance"], rel=0, abs=1e-12 * largest
        )
