"""What `dem-mpi check` foretells, against runs."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dem_mpi.errors import InputError
from dem_mpi.estimate import Estimate, checkpoint_bytes, estimate, refuse_what_does_not_fit
from dem_mpi.scenario import parse_scenario

from launch import ROOT, run_ranks

# A cubic packing whose neighbours are contacts from the first step on, three a body as in a settled
# bed. Unlike the scenes behind the estimate it is flat, has two materials, a driven box and all
# fields in its output.
DENSE = """
name: dense
domain: {{min: [-1, -1, -1], max: [3, 3, 2]}}
materials: {{glass: {{density: 2500}}, steel: {{density: 7800}}}}
friction: {{default: {mu}}}
bodies:
  - {{material: steel, count: {count}, radius: 0.01,
     placement: {{jittered_grid: {{min: [0, 0, 0], max: [{side}, {side}, 1], spacing: 0.02005}}}}}}
walls:
  - {{shape: box, material: glass, min: [0, 0, 0], max: [{side}, {side}, 1], open: [z_max],
     motion: {{oscillation: {{amplitude: [0.001, 0, 0], frequency: 1}}}}}}
time: {{step: 1.0e-3, end: 3.0e-3}}
contact: {{tolerance: 1, complementarity: 1, max_iterations: 10, stop_factor: 1.0e+12}}
output:
  interval: 1.0e-3
  fields: [position, velocity, angular_velocity, orientation, radius, gid, material]
checkpoint: {{interval: 1.0e-3}}
"""

BED = """
name: bed
domain: {{min: [-1, -1, -1], max: [2, 2, 2]}}
materials: {{glass: {{density: 2500}}}}
friction: {{default: 0.3}}
bodies:
  - {{material: glass, count: 200, radius: 0.02,
     placement: {{jittered_grid: {{min: [0, 0, 0], max: [0.25, 0.25, {height}], jitter: 0.5}}}}}}
walls:
  - {{shape: box, material: glass, min: [0, 0, 0], max: [0.25, 0.25, 1], open: [z_max]}}
time: {{step: 2.0e-3, end: 0.6}}
contact: {{tolerance: 5.0e-3, complementarity: 0.1, max_iterations: 200, stop_factor: 1.0e+9}}
output: {{interval: 4.0e-2}}
"""


def estimate_of(text: str, ranks: int = 1) -> Estimate:
    return estimate(parse_scenario(text, "scene.yaml").scenario, ranks)


def run_scene(text: str, directory: Path, ranks: int) -> str:
    """Run a scene and return what it prints."""
    scene = directory / "scene.yaml"
    scene.write_text(text)
    done = run_ranks(ranks, ["-m", "dem_mpi", "run", scene, "--out", directory], timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("mu", [0.3, 0.0])
def test_memory_of_a_rank_is_foretold_within_30_percent(tmp_path, mu, ranks):
    # 57,600 bodies on a square base: on one rank they take half as much again as the program.
    text = DENSE.format(mu=mu, count=60 * 60 * 16, side=60 * 0.02005)
    foretold = estimate_of(text, ranks)
    alone = estimate_of(DENSE.format(mu=mu, count=1, side=0.1))
    assert foretold.memory > 1.15 * alone.memory
    printed = run_scene(text, tmp_path, ranks)
    peak = int(re.search(r"peak memory per rank (\d+) MiB", printed)[1]) * 2**20
    assert foretold.memory == pytest.approx(peak, rel=0.30)
    # The program itself is most of it; the part that grows with the scene must be right as well.
    assert foretold.memory - alone.memory == pytest.approx(peak - alone.memory, rel=0.35)


SCIP = "solver: scip, tolerance: 1.0e-9, complementarity: 1.0e-9, scip: {max_iterations: 1}"


@pytest.mark.parametrize("ranks", [1, 2])
def test_memory_with_factors_of_newton_matrices_is_foretold(tmp_path, ranks):
    """A cube of 4,096 bodies, whose factor takes as much again as the program.

    Entries of a factor are foretold within a factor 1.5, memory of the whole within a third.
    """
    side = 16 * 0.02005
    text = DENSE.format(mu=0.3, count=16**3, side=side).replace(
        "tolerance: 1, complementarity: 1", SCIP
    )
    foretold = estimate_of(text, ranks)
    assert foretold.factors > 1e8 / ranks
    printed = run_scene(text, tmp_path, ranks)
    peak = int(re.search(r"peak memory per rank (\d+) MiB", printed)[1]) * 2**20
    assert foretold.memory == pytest.approx(peak, rel=0.33)


def test_only_solvers_with_factors_take_memory_for_them():
    text = DENSE.format(mu=0.3, count=16**3, side=16 * 0.02005)
    scip = text.replace("tolerance: 1, complementarity: 1", SCIP)
    frictionless = scip.replace("default: 0.3", "default: 0")
    assert estimate_of(text).factors == 0
    assert estimate_of(scip.replace("max_iterations: 1}", "linear: cg}")).factors == 0
    # Three unknowns a body for six, squared, and a fifth more contacts.
    ratio = estimate_of(frictionless).factors / estimate_of(scip).factors
    assert 0.25 < ratio < 0.35
    assert "factors" in "\n".join(estimate_of(scip).lines())


def test_factors_that_cannot_fit_are_refused_before_anything_is_done():
    text = DENSE.format(mu=0.3, count=100 * 100 * 40, side=100 * 0.02005)
    scip = text.replace("tolerance: 1, complementarity: 1", SCIP)
    limited = scip.replace("max_iterations: 1}", "memory: 500}")
    half_terabyte = 2**39

    def refuse(text: str, share: int) -> None:
        refuse_what_does_not_fit(parse_scenario(text, "scene.yaml").scenario, 1, share)

    with pytest.raises(InputError, match=r"contact\.solver = scip would take .*this machine has"):
        refuse(scip, 2**35)
    with pytest.raises(InputError, match=r"contact\.scip\.memory = 500 MB: .* raise it"):
        refuse(limited, half_terabyte)
    refuse(scip, half_terabyte)
    refuse(scip.replace("solver: scip", "solver: auto"), 2**35)
    refuse(text, 2**35)


def check(scene: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dem_mpi", "check", scene, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)


def test_check_says_what_run_will_say_of_factors(tmp_path):
    """A limit that a run refuses is refused by check, in the same words; memory here warns."""
    scene = tmp_path / "scene.yaml"
    text = DENSE.format(mu=0.3, count=16**3, side=16 * 0.02005)
    scene.write_text(text.replace("tolerance: 1, complementarity: 1", SCIP))
    limit = ("--set", "contact.scip.memory=1")
    checked = check(scene, *limit)
    ran = run_ranks(1, ["-m", "dem_mpi", "run", scene, "--out", tmp_path / "out", *limit])
    assert checked.returncode == ran.returncode == 64
    assert "contact.scip.memory = 1 MB: factors of Newton matrices" in checked.stderr
    assert checked.stderr.strip() == ran.stderr.strip()
    assert "memory       about" in checked.stdout

    fits = check(scene)
    assert fits.returncode == 0 and "refuse" not in fits.stderr
    large = DENSE.format(mu=0.3, count=1_900_000, side=200 * 0.02005)
    scene.write_text(large.replace("tolerance: 1, complementarity: 1", SCIP))
    short = check(scene)
    assert short.returncode == 0
    assert re.search(r"warning: on this machine run would refuse: .*this machine has", short.stderr)


def test_a_generous_workspace_is_named_where_factors_do_not_fit():
    text = DENSE.format(mu=0.3, count=16**3, side=16 * 0.02005)
    text = text.replace("tolerance: 1, complementarity: 1", SCIP)
    wide = text.replace("max_iterations: 1}", "workspace: 1000, memory: 100}")
    usual = text.replace("max_iterations: 1}", "memory: 10}")

    def refusal(text: str) -> str:
        with pytest.raises(InputError) as refused:
            refuse_what_does_not_fit(parse_scenario(text, "scene.yaml").scenario, 1, 2**50)
        return str(refused.value)

    assert "lower contact.scip.workspace = 1000 %" in refusal(wide)
    assert "workspace" not in refusal(usual)


def test_contacts_and_files_of_a_settled_bed_are_foretold(tmp_path):
    text = BED.format(height=0.5)
    foretold = estimate_of(text)
    run_scene(text, tmp_path, 1)
    last = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    # Rules of thumb for a bed of seven layers; an unsettled cloud has a tenth of it.
    assert foretold.contacts == pytest.approx(last["contacts"], rel=0.2)
    assert foretold.steps == last["step"]
    trajectory = (tmp_path / "run.h5").stat().st_size
    assert foretold.trajectory == pytest.approx(trajectory, rel=0.1)
    stored = [path.stat().st_size for path in sorted(tmp_path.glob("run.checkpoint.*.h5"))]
    assert len(stored) == foretold.checkpoints
    assert checkpoint_bytes(200, last["contacts"]) == pytest.approx(stored[-1], rel=0.1)


def test_more_friction_means_fewer_contacts_and_a_wider_margin_more():
    text = BED.format(height=0.5)
    rough = text.replace("default: 0.3", "default: 1.0")
    wide = text.replace("tolerance: 5.0e-3", "margin: 0.1, tolerance: 5.0e-3")
    assert estimate_of(rough).contacts < estimate_of(text).contacts < estimate_of(wide).contacts


def test_bodies_alone_on_a_floor_have_one_contact_each():
    text = BED.format(height=0.04).replace("0.25, 0.25", "1.9, 1.9")
    spread = estimate_of(text)
    # A tenth of a layer: the floor and hardly any neighbour.
    assert spread.contacts == pytest.approx(200, rel=0.05)


def test_the_depth_of_a_bed_is_that_of_its_mean_body():
    """Large ones among a thousand add nothing to a bed 0.8 layers deep, where layers matter."""
    text = BED.format(height=0.5).replace("0.25, 0.25", "0.6, 0.6")
    few = "radius: {weighted: {radii: [0.02, 0.04], weights: [1, 1.0e-9]}}"
    one, deep = estimate_of(text).contacts, estimate_of(BED.format(height=0.5)).contacts
    assert one < 0.8 * deep
    assert estimate_of(text.replace("radius: 0.02", few)).contacts == one
    rods = text.replace("radius: 0.02", "shape: spherocylinder, aspect_ratio: 2, radius: 0.02")
    assert one < estimate_of(rods).contacts < deep


def test_bodies_without_gravity_or_floor_do_not_settle():
    text = BED.format(height=0.5)
    assert estimate_of(text).settled
    assert not estimate_of(text + "gravity: [0, 0, 0]\n").settled
    assert not estimate_of(text + "gravity: [0, 0, 9.81]\n").settled  # out through the open face


def test_memory_falls_with_the_ranks_to_that_of_the_program():
    text = DENSE.format(mu=0.3, count=60 * 60 * 16, side=60 * 0.02005)
    memory = [estimate_of(text, ranks).memory for ranks in (1, 2, 8, 64)]
    alone = estimate_of(DENSE.format(mu=0.3, count=1, side=0.1)).memory
    assert memory == sorted(memory, reverse=True)
    assert memory[-1] == pytest.approx(alone, rel=0.05)


def test_more_ranks_than_bodies_is_said():
    text = DENSE.format(mu=0.3, count=1, side=0.1)
    assert any("3 of 4 ranks" in line for line in estimate_of(text, 4).lines())


def test_check_starts_neither_mpi_nor_hdf5(tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(BED.format(height=0.5))
    program = f"""
import sys
from dem_mpi.__main__ import app
app(["check", {str(scene)!r}, "--ranks", "2"], standalone_mode=False)
print([name for name in ("mpi4py", "petsc4py", "h5py") if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=True
    )
    *said, loaded = done.stdout.splitlines()
    assert loaded == "[]"
    assert any(re.match(r"memory +about \d+ MiB a rank on 2 ranks", line) for line in said)
    assert {path.name for path in tmp_path.iterdir()} == {"scene.yaml"}
