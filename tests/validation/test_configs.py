"""Every shipped scene runs, at its reduced size, and gives the number its header expects."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from launch import ROOT, run_ranks
from scene_header import Expectation, read_header

SCENES = sorted((ROOT / "configs").glob("*.yaml"))
TIMEOUT = 300.0  # [s] a hang, not a slow machine


def last_frame(path: Path) -> dict[str, np.ndarray]:
    """Every array of the last frame of a trajectory, by name, and its points as `position`."""
    with h5py.File(path, "r") as file:
        steps = file["VTKHDF/Steps"]
        frames = int(steps.attrs["NSteps"])
        first = int(steps["PointOffsets"][frames - 1])
        count = int(file["VTKHDF/NumberOfPoints"][frames - 1])
        rows = slice(first, first + count)
        arrays = {name: data[rows] for name, data in file["VTKHDF/PointData"].items()}
        return {**arrays, "position": file["VTKHDF/Points"][rows]}


def measure(quantity: str, frame: dict[str, np.ndarray]) -> float:
    """A header's quantity; bodies of one shape and material: mass goes with radius cubed."""
    if quantity == "velocity_x_of_body_0":
        return float(frame["velocity"][frame["gid"] == 0, 0][0])
    weight = frame["radius"] ** 3
    if quantity == "radius_of_97_percent":
        distance = np.hypot(*frame["position"][:, :2].T)
        order = np.argsort(distance)
        held = np.cumsum(weight[order]) / weight.sum()
        return float(distance[order][np.searchsorted(held, 0.975)])
    column, axis = {
        "centre_of_mass_z": ("position", 2),
        "velocity_z_of_centre_of_mass": ("velocity", 2),
        "velocity_x_of_centre_of_mass": ("velocity", 0),
    }[quantity]
    return float(np.average(frame[column][:, axis], weights=weight))


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_shipped_scene_gives_the_number_that_theory_expects(path: Path, tmp_path: Path) -> None:
    """At its reduced size on two ranks; value and tolerance stand, with their origin, in the
    scene's header."""
    header = read_header(path)
    arguments = ["-m", "dem_mpi", "run", path, "--out", tmp_path]
    for override in header.reduced:
        arguments += ["--set", override]
    done = run_ranks(2, arguments, timeout=TIMEOUT)
    assert done.returncode == 0, done.stderr
    check(header.expect_reduced, tmp_path / "run.h5")


def check(expected: Expectation, path: Path) -> None:
    found = measure(expected.quantity, last_frame(path))
    assert found == pytest.approx(expected.value, rel=0, abs=expected.tolerance)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_shipped_scene_states_physics_run_time_and_result(path: Path) -> None:
    text = path.read_text()
    for heading in ("# Physics ", "# Run time ", "# Result ", "SI units"):
        assert heading in text, heading
