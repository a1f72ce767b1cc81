"""A hopper: its mass flow is steady, and grows with the width of the outlet."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from launch import ROOT, run_ranks
from scene_header import read_header

SCENE = ROOT / "configs" / "hopper.yaml"
OPENING = 0.25  # [s] when the shutter vanishes, in the reduced scene
TRANSIENT = 0.08  # [s] to start from rest and to fall to where bodies are taken out
NARROW = ("walls.0.start=[0,0,0.045]", "walls.1.end=[0,0,0.045]", "walls.1.radii=[0.02,0.05]")


@dataclass(frozen=True)
class Discharge:
    """Mass flow [kg/s] in both halves of a discharge and in all of it; bodies out, and misfit.

    misfit : largest distance of the removed mass from the straight line, in bodies
    """

    rate: float
    first: float
    second: float
    bodies: int
    misfit: float


def discharge(out: Path, overrides: tuple[str, ...], start: float) -> Discharge:
    """Run the hopper on two ranks; measure from `start` [s] to the end."""
    arguments = ["-m", "dem_mpi", "run", SCENE, "--out", out]
    for override in overrides:
        arguments += ["--set", override]
    done = run_ranks(2, arguments, timeout=900.0)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    time, mass, number = (
        np.array([line[key] for line in lines]) for key in ("time", "removed_mass", "removed")
    )
    assert not mass[time < start - TRANSIENT].any()  # the shutter held
    flowing = time > start
    time, mass, number = time[flowing], mass[flowing], number[flowing]
    line = np.polyfit(time, mass, 1)
    half = len(time) // 2
    return Discharge(
        rate=float(line[0]),
        first=float(np.polyfit(time[:half], mass[:half], 1)[0]),
        second=float(np.polyfit(time[half:], mass[half:], 1)[0]),
        bodies=int(number[-1] - number[0]),
        misfit=float(np.abs(mass - np.polyval(line, time)).max() / (mass[-1] / number[-1])),
    )


def test_a_hopper_discharges_steadily_and_a_wider_one_faster(tmp_path: Path) -> None:
    """Removed mass is a straight line in time within the scatter of a random count, twice its root
    and each half within three such of the other. Outlets of 4.5 and 6 mean diameters: by Beverloo's
    law with k = 1.4 their flows are as 3.1^2.5 to 4.6^2.5, 1 : 2.7; k from 1 to 2 gives 2.4 to
    3.6, and the counts scatter by a tenth."""
    reduced = read_header(SCENE).reduced
    narrow = discharge(tmp_path / "narrow", (*reduced, *NARROW), OPENING + TRANSIENT)
    wide = discharge(tmp_path / "wide", reduced, OPENING + TRANSIENT)
    for found in (narrow, wide):
        assert found.bodies > 40
        assert found.misfit < 2.0 * np.sqrt(found.bodies)
        assert abs(found.second - found.first) < 3.0 * found.rate * 2.0 / np.sqrt(found.bodies)
    assert 2.0 < wide.rate / narrow.rate < 4.0


@pytest.mark.long
def test_a_hopper_forgets_how_much_is_left(tmp_path: Path) -> None:
    """While a third of 4000 bodies run out of the shipped hopper, the flows of the two halves
    differ by less than 6 %, what two independent counts of 600 bodies would scatter by; a dense
    stream is more regular."""
    found = discharge(tmp_path, (), 0.4 + TRANSIENT)
    assert found.bodies > 1000
    assert abs(found.second - found.first) < 0.06 * found.rate
