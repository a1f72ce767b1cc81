"""States of beds of spheres that solvers are measured on: runs of this program, made once.

A recipe is a scene; its run, on two ranks, stays under build/bench/piles in a directory named
after what it holds and a digest of the scene, so that other parameters are another directory. A
run that was interrupted goes on from its last checkpoint. A state is a checkpoint of a run, from
which `Simulation.pose` gives the cone problem of the next step.

pile-N    N spheres of radius 1 cm on 0.01 m^2 of base a thousand fall from a loose grid and come
          to rest some forty layers deep: landed (nine tenths of the contacts at rest), settled,
          and polished by steps of an interior point method at 1e-6 m/s.
shear-N   the settled pile on a floor that turns about its centre: sheared.
cloud-N   the box of S. De's Table 2.1 (PhD thesis, University of Michigan 2021), 0.5 m high and
          0.04 m^2 of base a thousand: falling (half way down), landed, settled (the run's end).
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path

from records import BUILD, mpirun

PILES = BUILD / "piles"
RANKS = 2
RADIUS = 0.01  # m
POLISH = 3  # steps
POLISH_TOLERANCE = 1e-6  # m/s
SHEAR_SPEED = 0.01  # m/s of the turning floor half way along a wall; sliding lifts by mu times that


@dataclass(frozen=True)
class Recipe:
    """How a bed is made. Lengths in m, times in s; `area` is the base of a thousand spheres.

    top      : height of the region that is filled at the start, and of the box
    spacing  : of the grid at the start; None fills the region
    rest     : kinetic speed [m/s] at which the run may end before `end`
    parent   : the bed whose settled state this one begins from
    """

    name: str
    spheres: int
    area: float
    top: float
    spacing: float | None
    step: float
    end: float
    tolerance: float
    complementarity: float
    interval: float
    jitter: float = 0.8
    rest: float = 1e-3
    parent: str | None = None

    @property
    def side(self) -> float:
        return math.sqrt(self.area * self.spheres / 1000)


def _pile(spheres: int) -> Recipe:
    # Large ones less exactly: an hour would become several.
    work, end = (0.01, 0.9) if spheres <= 2000 else (0.03, 0.8)
    return Recipe(f"pile-{spheres}", spheres, 0.01, 1.4, 0.0235, 1e-3, end, 1e-3, work, 0.02)


def _shear(spheres: int) -> Recipe:
    end = 0.1 if spheres <= 2000 else 0.04
    return Recipe(
        f"shear-{spheres}", spheres, 0.01, 1.4, None, 1e-3, end, 1e-3, 0.01, end / 2,
        parent=f"pile-{spheres}",
    )  # fmt: skip


def _cloud(spheres: int, end: float, tolerance: float) -> Recipe:
    return Recipe(
        f"cloud-{spheres}", spheres, 0.04, 0.5, None, 1e-3, end, tolerance, 0.01, 0.025
    )  # fmt: skip


RECIPES = {
    recipe.name: recipe
    for recipe in (
        *(_pile(n) for n in (500, 2000, 8000, 16000)),
        # A pile to be polished by an accurate solver: begun compact, in large steps.
        Recipe(
            "pile-100000", 100_000, 0.01, 1.0, 0.0212, 2.5e-3, 0.75, 1e-2, 0.05, 0.05,
            jitter=1.0, rest=0.02,
        ),
        *(_shear(n) for n in (2000, 16000)),
        _cloud(25_000, 0.7, 1e-3),
        _cloud(100_000, 0.4, 1e-2),
    )
}  # fmt: skip


def directory(recipe: Recipe) -> Path:
    """Where the run of a recipe stands, or will stand."""
    digest = hashlib.sha256(_scene(recipe).encode()).hexdigest()[:8]
    return PILES / f"{recipe.name}-{digest}"


def made(name: str) -> bool:
    """Whether the run of this name has ended."""
    return (directory(RECIPES[name]) / "done").exists()


def make(name: str) -> Path:
    """Run a recipe, or go on with it, or take the finished run; returns its directory."""
    recipe = RECIPES[name]
    place = directory(recipe)
    if made(name):
        return place
    if recipe.parent:
        make(recipe.parent)
    place.mkdir(parents=True, exist_ok=True)
    scene = place / "scene.yaml"
    scene.write_text(_scene(recipe))
    # A later version of the program may know more keys than the one that began the run.
    command = ["-m", "dem_mpi", "run", str(scene), "--out", str(place), "--resume"]
    mpirun(RANKS, [*command, *(["--force"] if _checkpoints(place) else [])])
    for state, checkpoint in _states(recipe, place).items():
        shutil.copy2(checkpoint, place / f"{state}.h5")
    (place / "done").touch()
    return place


def state(name: str) -> Path:
    """The checkpoint of a state named "recipe/state", its run made if need be."""
    recipe, _, which = name.partition("/")
    place = make(recipe)
    if which == "polished" and not (place / "polished.h5").exists():
        _polish(RECIPES[recipe], place)
    return place / f"{which}.h5"


def _polish(recipe: Recipe, place: Path) -> None:
    """Go on from the settled state with some accurate steps of the interior point method."""
    last = _step_of(_checkpoints(place)[-1])
    settings = (
        "contact.solver=scip",
        f"contact.tolerance={POLISH_TOLERANCE!r}",
        "time.stop_at_rest=null",
        f"time.end={(last + POLISH) * recipe.step!r}",
    )
    command = ["-m", "dem_mpi", "run", str(place / "scene.yaml"), "--out", str(place), "--resume"]
    for setting in settings:
        command += ["--set", setting]
    mpirun(RANKS, [*command, "--force"])
    shutil.copy2(_checkpoints(place)[-1], place / "polished.h5")


def _checkpoints(place: Path) -> list[Path]:
    return sorted(place.glob("run.checkpoint.*.h5"))


def _step_of(checkpoint: Path) -> int:
    return int(checkpoint.name.split(".")[2])


def _states(recipe: Recipe, place: Path) -> dict[str, Path]:
    """Choose the checkpoints that are states, by what the bed does at them."""
    lines = (place / "metrics.jsonl").read_text().splitlines()
    contacts = {row["step"]: row["contacts"] for row in map(json.loads, lines)}
    steps = {_step_of(path): path for path in _checkpoints(place)}
    last = max(steps)
    if recipe.parent:
        return {"sheared": steps[last]}
    many = 0.9 * contacts[max(contacts)]
    landed = min(s for s in steps if s == last or contacts.get(s, 0) > many)
    found = {"landed": steps[landed], "settled": steps[last]}
    if recipe.name.startswith("cloud"):
        falling = min(steps, key=lambda s: abs(s * recipe.step - 0.5 * landed * recipe.step))
        found["falling"] = steps[falling]
    return found


def _scene(recipe: Recipe) -> str:
    """The scene of a recipe."""
    side, top = recipe.side, recipe.top
    if recipe.parent:
        parent = directory(RECIPES[recipe.parent])
        bodies = f"placement: {{file: ../{parent.name}/run.h5}}"
        # A turning floor shears without squeezing the bed against a wall.
        centre, rate = f"[{side / 2!r}, {side / 2!r}, 0]", SHEAR_SPEED / (0.5 * side)
        walls = f"""\
  - {{shape: box, name: box, material: glass, min: [0, 0, 0], max: [{side!r}, {side!r}, {top}],
      open: [z_min]}}
  - {{shape: plane, name: floor, material: glass, point: [0, 0, 0], normal: [0, 0, 1],
      motion: {{rotation: {{centre: {centre}, axis: [0, 0, 1], rate: {rate!r}}}}}}}
"""
        rest = ""
    else:
        spacing = f", spacing: {recipe.spacing}" if recipe.spacing else ""
        region = f"min: [0, 0, 0], max: [{side!r}, {side!r}, {top}]"
        bodies = f"""\
count: {recipe.spheres}
    radius: {RADIUS}
    placement:
      jittered_grid: {{{region}, jitter: {recipe.jitter}{spacing}}}"""
        walls = f"  - {{shape: box, name: box, material: glass, {region}}}\n"
        rest = (
            f"  stop_at_rest: {{max_speed: {10 * recipe.rest}, kinetic_speed: {recipe.rest}, "
            "steps: 20}\n"
        )
    contact = (
        f"tolerance: {recipe.tolerance}, complementarity: {recipe.complementarity}, "
        "max_iterations: 2000, stop_factor: 1e6"
    )
    return f"""\
name: {recipe.name}
domain: {{min: [-0.1, -0.1, -0.1], max: [{side + 0.1!r}, {side + 0.1!r}, {top + 0.1!r}]}}
materials:
  glass: {{density: 2500}}
friction: {{default: 0.3}}
bodies:
  - material: glass
    {bodies}
walls:
{walls}\
time:
  step: {recipe.step}
  end: {recipe.end}
{rest}\
contact: {{{contact}}}
output: {{interval: {recipe.interval}}}
checkpoint: {{interval: {recipe.interval}, keep: 100000}}
"""
