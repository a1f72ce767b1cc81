"""A rotating drum: what its mantle does to the bed, as energy, torque and power."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from launch import ROOT, run_ranks
from scene_header import read_header

SCENE = ROOT / "configs" / "drum.yaml"
RATE = 2.0  # [rad/s] of the mantle about y, in the scene
ROUND_OFF = 1e-12  # of the kinetic energy or the work: sums of some 10^4 terms, some of each sign


def run_drum(ranks: int, out: Path, **overrides: Any) -> list[dict[str, Any]]:
    """Run the scene at its reduced size; return its metrics, one record a step."""
    arguments = ["-m", "dem_mpi", "run", SCENE, "--out", out]
    for override in read_header(SCENE).reduced:
        arguments += ["--set", override]
    for key, value in overrides.items():
        arguments += ["--set", f"{key.replace('__', '.')}={value}"]
    done = run_ranks(ranks, arguments, timeout=600.0)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def column(steps: list[dict[str, Any]], key: str) -> NDArray[np.float64]:
    return np.array([step[key] for step in steps])


def reaction(steps: list[Mapping[str, Any]], wall: str) -> NDArray[np.float64]:
    """Mean force and torque on a wall in each step (steps, 6) [N, N m]."""
    return np.array([step["walls"][wall] for step in steps])


@pytest.mark.parametrize("ranks", [1, 2, 3, 8])
def test_the_mantle_works_as_its_torque_says_and_energy_is_accounted_for_in_every_step(
    ranks: int, tmp_path: Path
) -> None:
    """The bodies' kinetic energy changes by what the contacts took and the walls gave; what they
    gave is the mantle's torque times its angle. Both to round-off, from the first touch through
    the bed's fall on the turning mantle to its first tilt, at whatever tolerance the contacts are
    solved (a coarse one here, for speed); the polished plates do no work."""
    steps = run_drum(ranks, tmp_path, time__end=0.3, contact__tolerance=1e-2)
    change, balance = column(steps, "energy_change"), column(steps, "energy_balance")
    kinetic, work = column(steps, "kinetic_energy"), column(steps, "wall_work")
    h = steps[0]["time"]
    assert column(steps, "contacts")[-1] > 800
    assert work.max() > 1e-5  # [J] the mantle drags the bed: there is something to account for
    # A step's change is a difference of energies before and after it.
    np.testing.assert_array_less(np.abs(change - balance), ROUND_OFF * (kinetic + np.abs(change)))
    torque = reaction(steps, "mantle")[:, 4]
    largest = np.abs(work).max()
    np.testing.assert_allclose(work, -torque * RATE * h, rtol=ROUND_OFF, atol=ROUND_OFF * largest)
    # Contacts only take: what the walls do not give is never gained, but for the solve's error.
    assert np.all(balance - work < 1e-6 * kinetic.max())


def steady_state(steps: list[dict[str, Any]], path: Path, start: float) -> dict[str, float]:
    """Ratios of balances that are 1 in steady state, between `start` [s] and the end."""
    window = column(steps, "time") > start
    work = column(steps, "wall_work")[window].sum()
    lost = work - column(steps, "energy_balance")[window].sum()
    torque = reaction(steps, "mantle")[window, 4].mean()
    walls = ("mantle", "front", "back")
    push = sum(reaction(steps, wall)[window, 2].mean() for wall in walls)
    with h5py.File(path) as file:
        count = int(file["frames/count"][0])
        frames = file["frames/time"][:] > start
        position = file["position"][: count * len(frames)].reshape(len(frames), count, 3)
        radius = float(file["radius"][0])
    centre = position[frames].mean(axis=1)
    weight = 2500 * 4.0 / 3.0 * np.pi * radius**3 * 9.81 * count
    # A step kicks a body at rest by g h, which contacts take back: m (g h)^2 / 2 is not the walls'.
    kicks = 0.5 * weight * 9.81 * steps[0]["time"] ** 2 * window.sum()
    return {
        "torque": torque / (weight * centre[:, 0].mean()),
        "power": (lost - kicks) / work,
        "weight": -push / weight,
    }


@pytest.mark.long
def test_a_steady_drum_balances_torque_power_and_weight(tmp_path: Path) -> None:
    """Over two seconds of steady flow: the mantle's torque carries the bed's weight at its offset,
    its power is what the contacts dissipate, and the walls bear the weight. What the bed's angular
    momentum, energy and momentum may differ by between the ends of the look sets the tolerances:
    2 % of the torque's impulse, 2 mm of height or 20 of 900 mJ of work."""
    steps = run_drum(2, tmp_path, time__end=3)
    found = steady_state(steps, tmp_path / "run.h5", 1.0)
    assert found["torque"] == pytest.approx(1.0, abs=0.05)
    assert found["power"] == pytest.approx(1.0, abs=0.05)
    assert found["weight"] == pytest.approx(1.0, abs=0.01)
