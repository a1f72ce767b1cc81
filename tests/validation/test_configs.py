"""Every shipped scene runs, at its reduced size, and gives the number its header expects."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from launch import ROOT, run_ranks
from scene_header import Expectation, read_header

SCENES = sorted((ROOT / "configs").glob("*.yaml"))
TIMEOUT = 300.0  # [s] a hang, not a slow machine


def last_frame(path: Path, back: int = 0) -> dict[str, np.ndarray]:
    """Every array of a trajectory's last frame, or of one so many frames before it, by name."""
    with h5py.File(path, "r") as file:
        steps = file["VTKHDF/Steps"]
        frames = int(steps.attrs["NSteps"]) - back
        first = int(steps["PointOffsets"][frames - 1])
        count = int(file["VTKHDF/NumberOfPoints"][frames - 1])
        rows = slice(first, first + count)
        arrays = {name: data[rows] for name, data in file["VTKHDF/PointData"].items()}
        return {**arrays, "position": file["VTKHDF/Points"][rows]}


def measure(quantity: str, frame: dict[str, np.ndarray]) -> float:
    """A quantity of a frame; bodies of one shape and material: mass goes with radius cubed."""
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


def mass_flow(path: Path) -> float:
    """Mass removed in the last third of a run over that time [kg/s]."""
    lines = [json.loads(line) for line in (path.parent / "metrics.jsonl").read_text().splitlines()]
    end, start = lines[-1], lines[2 * len(lines) // 3]
    return (end["removed_mass"] - start["removed_mass"]) / (end["time"] - start["time"])


def torque_over_weight_offset(path: Path) -> float:
    """Torque on the mantle over weight times offset of the centre of mass, in the second half."""
    with h5py.File(path, "r") as file:
        scene = json.loads(file.attrs["scene"])
        frames = int(file["VTKHDF/Steps"].attrs["NSteps"])
        face = [wall["name"] for wall in scene["walls"]].index("mantle")
        torque = file["walls/torque"][frames - frames // 2 : frames, face, 1].mean()
    moments = []
    for back in range(frames // 2):
        frame = last_frame(path, back)
        moments.append(float(np.sum(frame["radius"] ** 3 * frame["position"][:, 0])))
    (density,) = {scene["materials"][group["material"]]["density"] for group in scene["bodies"]}
    scale = density * 4.0 / 3.0 * np.pi * np.linalg.norm(scene["gravity"])
    return float(torque / (scale * np.mean(moments)))


OF_RUNS = {"mass_flow": mass_flow, "torque_over_weight_offset": torque_over_weight_offset}


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
    if expected.quantity in OF_RUNS:
        found = OF_RUNS[expected.quantity](path)
    else:
        found = measure(expected.quantity, last_frame(path))
    assert found == pytest.approx(expected.value, rel=0, abs=expected.tolerance)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_shipped_scene_states_physics_run_time_and_result(path: Path) -> None:
    text = path.read_text()
    for heading in ("# Physics ", "# Run time ", "# Result ", "SI units"):
        assert heading in text, heading
