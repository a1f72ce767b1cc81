"""A layer of spheres sheared by two plates, repeating along x and y: configs/shear_box.yaml.

One run of its reduced size on two ranks with every step written, looked at from several sides.
"""

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

SCENE = ROOT / "configs" / "shear_box.yaml"
H = 1e-3  # [s] time step
PERIOD = np.array([0.1, 0.05])  # [m] along x and y
LOWEST, HIGHEST = 0.04, 0.136  # [m] plates at the end of the pressing
PRESSED = 450  # steps after which the plates move along x only
SPEED = 0.2  # [m/s] of each plate


@dataclass(frozen=True)
class Shear:
    """Every step k of the run: fields (k, n, 3) in the order of gid, force on the plates."""

    mass: NDArray  # (n,) [kg]
    position: NDArray
    velocity: NDArray
    force: NDArray  # (k, 2, 3) [N]: lower, upper
    metrics: list[dict]


@pytest.fixture(scope="module")
def shear(tmp_path_factory: pytest.TempPathFactory) -> Shear:
    path = tmp_path_factory.mktemp("shear")
    arguments = ["-m", "dem_mpi", "run", SCENE, "--out", path]
    for override in (*read_header(SCENE).reduced, f"output.interval={H}"):
        arguments += ["--set", override]
    done = run_ranks(2, arguments, timeout=300)
    assert done.returncode == 0, done.stderr
    return read(path)


def read(path: Path) -> Shear:
    with h5py.File(path / "run.h5") as file:
        frames = int(file["VTKHDF/Steps"].attrs["NSteps"])
        fields = {name: file[name][:] for name in ("gid", "position", "velocity", "radius")}
        force = file["walls/force"][:frames]
        assert file.attrs["walls"] == b"lower upper"
    order = np.argsort(fields["gid"].reshape(frames, -1), axis=1)

    def by_gid(name: str) -> NDArray:
        rows = fields[name].reshape(frames, order.shape[1], -1)
        return np.take_along_axis(rows, order[:, :, None], axis=1)

    mass = 2500 * 4 / 3 * np.pi * by_gid("radius")[0, :, 0] ** 3
    metrics = [json.loads(s) for s in (path / "metrics.jsonl").read_text().splitlines()]
    return Shear(mass, by_gid("position"), by_gid("velocity"), force, metrics)


def test_momentum_changes_by_the_impulses_of_the_plates_and_nothing_else(shear: Shear) -> None:
    """In every step, to the round-off of a sum over the bodies: contacts among them, also across
    periodic faces, exchange momentum and make none."""
    momentum = np.einsum("i,kij->kj", shear.mass, shear.velocity)
    given = -H * shear.force[1:].sum(axis=1)
    scale = shear.mass.sum() * SPEED
    assert np.abs(momentum[0]).max() == 0
    assert np.abs(given).max() > 1e-6 * scale
    assert np.diff(momentum, axis=0) == pytest.approx(given, rel=0, abs=1e-13 * scale)


def test_work_of_plates_is_what_their_force_and_speed_say(shear: Shear) -> None:
    """wall_work = -h force . velocity of the plates, where they only slide: recovery from overlap
    is no motion of a wall. And the energy balance closes in every step."""
    kinetic = max(line["kinetic_energy"] for line in shear.metrics)
    for line in shear.metrics:
        assert line["energy_change"] == pytest.approx(
            line["energy_balance"], rel=0, abs=1e-10 * kinetic
        )
    sliding = shear.metrics[PRESSED:]
    assert len(sliding) >= 100
    for line in sliding:
        lower, upper = line["walls"]["lower"], line["walls"]["upper"]
        work = H * SPEED * (lower[0] - upper[0])
        assert line["wall_work"] == pytest.approx(work, rel=0, abs=1e-12 * kinetic)


def test_plates_bear_opposite_loads_that_resist_the_sliding(shear: Shear) -> None:
    """Means over the sliding: momentum of the layer wanders by less than 5 % of its mass times
    the speed of a plate, so that the sum of both forces, times the time, is below that."""
    lower, upper = shear.force[PRESSED:].mean(axis=0)
    duration = H * len(shear.force[PRESSED:])
    assert np.abs(lower + upper).max() * duration < 0.05 * shear.mass.sum() * SPEED
    assert lower[0] > 0 > upper[0]
    assert lower[2] < 0 < upper[2]
    # Coulomb: a smooth plate drags with mu = 0.5 of its load at most.
    for force in (lower, upper):
        assert np.hypot(force[0], force[1]) <= 0.5 * abs(force[2]) * (1 + 1e-6)


def test_velocity_profile_is_odd_about_the_middle(shear: Shear) -> None:
    """Four slices: outer ones follow their plates, and opposite ones have opposite velocities
    within a quarter of the difference, the scatter of a hundred bodies in each."""
    z = shear.position[PRESSED:, :, 2]
    velocity = shear.velocity[PRESSED:, :, 0]
    slices = np.clip(4 * (z - LOWEST) / (HIGHEST - LOWEST), 0, 3).astype(int)
    profile = [velocity[slices == k].mean() for k in range(4)]
    assert np.all(np.diff(profile) > 0)
    assert -SPEED < profile[0] < -0.1 * SPEED < 0.1 * SPEED < profile[3] < SPEED
    assert abs(profile[0] + profile[3]) < 0.25 * (profile[3] - profile[0])
    assert abs(profile[1] + profile[2]) < 0.25 * (profile[3] - profile[0])


def test_bodies_that_leave_come_in_on_the_other_side(shear: Shear) -> None:
    """Between frames every body moves by h v, less whole periods: to round-off of the position;
    and some do cross."""
    assert np.all(shear.position[:, :, :2] >= 0)
    assert np.all(shear.position[:, :, :2] < PERIOD)
    moved = np.diff(shear.position, axis=0) - H * shear.velocity[1:]
    periods = np.round(moved[:, :, :2] / PERIOD)
    assert np.count_nonzero(periods[:, :, 0]) > 1
    assert moved[:, :, :2] == pytest.approx(periods * PERIOD, rel=0, abs=1e-15)
    assert moved[:, :, 2] == pytest.approx(0, abs=1e-15)
