"""Bodies that come in during a run and bodies that are taken out: when, where, and how counted."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dem_mpi.bodies import Bodies
from dem_mpi.errors import InputError
from dem_mpi.parallel import Parallel
from dem_mpi.scenario import Scenario
from dem_mpi.simulation import Simulation, SolverFailureError, StepRecord

from runs import differences, metrics, simulate
from scenes import everybody, load, make_fail, placed, scene, simulation_of

STEP = 2e-3
REGION = {"min": [0, 0, 0.5], "max": [0.3, 0.25, 0.8]}
BELOW = {"name": "below", "min": [-1, -1, -1], "max": [1, 1, 0.1]}


def inlet(count: int, rate: float, start: float = 0.0, **group: Any) -> dict[str, Any]:
    """A group that comes in through the region, all bodies at the same velocity."""
    insertion = {**group.pop("region", REGION), "rate": rate, "start": start}
    return {
        "material": "m",
        "count": count,
        "radius": 0.02,
        "velocity": [0, 0, -4],
        "placement": {"insertion": insertion},
        **group,
    }


def streams(**sections: Any) -> Scenario:
    """Two crowded inlets in one region, balls and rods that fall side by side into a removal.

    All move alike, so that no impulse ever acts and every bit is the same on any ranks.
    """
    groups = [
        inlet(60, 2000, radius={"uniform": [0.02, 0.04]}),
        inlet(50, 1500, 0.006, shape="spherocylinder", aspect_ratio=2, axis="random"),
    ]
    return scene(step=STEP, gravity=(0, 0, 0), bodies=groups, removal=[BELOW], seed=3, **sections)


def started(parallel: Parallel, scenario: Scenario) -> Simulation:
    return Simulation(parallel, scenario, placed(parallel, scenario))


def followed(parallel: Parallel, scenario: Scenario, steps: int) -> tuple[list, Bodies]:
    """Collective. What each step says of comings and goings with the gids present, and the end."""
    simulation = started(parallel, scenario)
    said = []
    for _ in range(steps):
        record = simulation.step()
        present = everybody(parallel, simulation.state).gid.tolist()
        said.append((record.waiting, record.removed, record.outside, present))
    return said, everybody(parallel, simulation.state)


def least_gap(bodies: Bodies) -> float:
    """The smallest distance of two bounding spheres [m]."""
    reach = bodies.bounding_radius
    gap = np.linalg.norm(bodies.position[:, None] - bodies.position[None], axis=2)
    gap -= reach[:, None] + reach[None]
    np.fill_diagonal(gap, np.inf)
    return float(gap.min(initial=np.inf))


# ---- coming in ------------------------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
def test_the_same_bodies_come_in_at_the_same_time_and_place_on_any_number_of_ranks(parallel):
    said, bodies = followed(parallel, streams(), 60)
    alone = Parallel.alone()
    expected, same = followed(alone, streams(), 60)
    assert said == expected
    for name, array in bodies.arrays().items():
        assert array.tobytes() == getattr(same, name).tobytes(), name
    waiting, removed, _, present = said[-1]
    assert max(step[0] for step in said) > 5  # crowded: the places were fought for
    assert 0 < removed < 110
    assert waiting + removed + len(present) == 110
    assert set(bodies.shape.tolist()) == {0, 1}


def test_no_body_comes_in_overlapping_another_or_reaching_out_of_its_region():
    simulation = started(Parallel.alone(), streams())
    before: set[int] = set()
    for _ in range(30):
        simulation.step()
        bodies = simulation.state.bodies
        assert least_gap(bodies) > -1e-15  # no impulse acts: as far apart as when they came
        new = ~np.isin(bodies.gid, list(before))
        place = bodies.position[new] - STEP * bodies.velocity[new]
        reach = bodies.bounding_radius[new, None]
        assert (place - reach >= np.array(REGION["min"]) - 1e-12).all()
        assert (place + reach <= np.array(REGION["max"]) + 1e-12).all()
        before |= set(bodies.gid.tolist())


def test_the_rate_is_kept_until_the_count_is_reached():
    """Body i is due at start + i / rate, in a step that begins then: 0.01, 0.0125, ... here."""
    scenario = scene(step=STEP, gravity=(0, 0, 0), bodies=[inlet(15, 400, 0.01)])
    simulation = started(Parallel.alone(), scenario)
    for step in range(40):
        record = simulation.step()
        due = sum(0.01 + i / 400 <= step * STEP + 1e-9 for i in range(15))
        assert (record.bodies, record.waiting) == (due, 0)
        assert sorted(simulation.state.bodies.gid) == list(range(due))
    assert simulation.expected == 0


def test_gids_are_reserved_for_a_group_whenever_it_comes():
    """The inlet's gids follow those of the first group and precede those of the third."""
    grid = {"jittered_grid": {"min": [0.5, 0, 0], "max": [0.9, 0.4, 0.4]}}
    balls = {"material": "m", "count": 4, "radius": 0.05, "placement": grid}
    other = {**balls, "placement": {"jittered_grid": {"min": [2, 0, 0], "max": [3, 1, 1]}}}
    scenario = scene(step=STEP, gravity=(0, 0, 0), bodies=[balls, inlet(3, 1e4), other])
    simulation = started(Parallel.alone(), scenario)
    assert sorted(simulation.state.bodies.gid) == [0, 1, 2, 3, 7, 8, 9, 10]
    simulation.step()
    assert sorted(simulation.state.bodies.gid) == [0, 1, 2, 3, 4, 7, 8, 9, 10]


def test_gids_stay_reserved_when_a_file_of_bodies_changes_during_the_run(tmp_path: Path):
    file = tmp_path / "two.csv"
    file.write_text("x,y,z\n0.6,0,0\n0.8,0,0\n")
    first = {"material": "m", "radius": 0.05, "placement": {"file": str(file)}}
    scenario = scene(step=STEP, gravity=(0, 0, 0), bodies=[first, inlet(2, 500)])
    simulation = started(Parallel.alone(), scenario)
    simulation.step()
    file.unlink()
    simulation.step()
    assert sorted(simulation.state.bodies.gid) == [0, 1, 2, 3]


def test_bodies_wait_while_the_region_is_blocked_and_come_in_when_it_is_free():
    """A ball as large as the region leaves it at 2 m/s along x; then all five come in."""
    group = inlet(5, 1000, velocity=[0, 0, 0])
    scenario = scene(step=STEP, gravity=(0, 0, 0), bodies=[group])
    simulation = simulation_of(scenario, [[0.15, 0.12, 0.65]], [0.24], [[2, 0, 0]])
    simulation.state.bodies.gid[:] = 5
    waiting = [simulation.step() for _ in range(10)]
    assert [r.waiting for r in waiting] == [1, 3, 5, 5, 5, 5, 5, 5, 5, 5]
    assert all(r.bodies == 1 for r in waiting)
    for _ in range(200):
        record = simulation.step()
        assert least_gap(simulation.state.bodies) > -1e-15
    assert (record.waiting, record.bodies) == (0, 6)


def test_what_came_in_before_a_refused_step_stays_and_comes_in_only_once():
    group = inlet(1, 1e4, velocity=[0, 0, -1])
    stop = {"on_failure": "stop"}
    scenario = scene(step=STEP, gravity=(0, 0, 0), bodies=[group], contact=stop)
    simulation = started(Parallel.alone(), scenario)
    make_fail(simulation, 1, dual=1.0)
    with pytest.raises(SolverFailureError):
        simulation.step()
    state = simulation.state
    assert (state.step, state.bodies.gid.tolist(), state.inserted.tolist()) == (0, [0], [1])
    before = state.bodies.position.copy()
    record = simulation.step()
    assert (record.step, record.bodies, simulation.expected) == (1, 1, 0)
    moved = state.bodies.position - before
    np.testing.assert_allclose(moved, [[0, 0, -STEP]], atol=1e-15)


@pytest.mark.mpi(ranks=[1, 2])
def test_no_body_comes_in_where_a_wall_stands_at_that_time(parallel):
    """A plate sinks through the region at 5 m/s: bodies come in above and below, clear of it."""
    plate = {
        "shape": "rectangle",
        "material": "m",
        "corner": [-1, -1, 0.82],
        "edges": [[3, 0, 0], [0, 3, 0]],
        "motion": {"velocity": [0, 0, -5]},
    }
    group = inlet(60, 1000, velocity=[0, 0, 0])
    scenario = scene(step=STEP, gravity=(0, 0, 0), bodies=[group], walls=[plate])
    simulation = started(parallel, scenario)
    before: set[int] = set()
    sides = set()
    for step in range(30):
        height = 0.82 - 5 * step * STEP
        simulation._let_in(step * STEP)  # as a step does first
        bodies = everybody(parallel, simulation.state)
        new = bodies.position[~np.isin(bodies.gid, list(before)), 2] - height
        assert (np.abs(new) >= 0.02 - 1e-9).all()
        if 0.55 < height < 0.75:
            sides |= set(np.sign(new))
        before = set(bodies.gid.tolist())
        simulation.step()
    assert sides == {-1.0, 1.0}
    assert len(before) > 25


def test_an_inlet_as_wide_as_the_tube_around_it_still_lets_bodies_in():
    """Bodies that touch two walls at once are not held back by rounding."""
    group = inlet(1, 1000, region={"min": [0.1, 0.1, 0.5], "max": [0.14, 0.14, 0.8]})
    box = {"shape": "box", "material": "m", "min": [0.1, 0.1, 0], "max": [0.14, 0.14, 1]}
    scenario = scene(step=STEP, gravity=(0, 0, 0), bodies=[group], walls=[box])
    assert started(Parallel.alone(), scenario).step().bodies == 1


@pytest.mark.mpi(ranks=[1, 2])
def test_a_body_across_a_periodic_face_blocks_the_other_side(parallel):
    """The ball stands at x = 0.95 of a period of 1; its image at x = -0.05 fills the region."""
    group = inlet(2, 1000, velocity=[0, 0, 0], region={"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]})
    ball = {
        "material": "m",
        "count": 1,
        "radius": 0.25,
        "placement": {"jittered_grid": {"min": [0.7, -0.2, -0.2], "max": [1.2, 0.3, 0.3]}},
    }
    bounds = {"min": [0, -1, -1], "max": [1, 1, 1]}
    for periodic, bodies in (([], 3), (["x"], 1)):
        scenario = scene(
            step=STEP,
            gravity=(0, 0, 0),
            bodies=[ball, group],
            domain={**bounds, "periodic": periodic},
        )
        simulation = started(parallel, scenario)
        for _ in range(5):
            record = simulation.step()
        assert (record.bodies, record.waiting) == (bodies, 3 - bodies)


def test_spinning_bodies_turn_as_soon_as_they_are_in():
    """Without friction a scene turns nothing, unless a body that comes in says so."""
    spinning = inlet(2, 1000, angular_velocity=[0, 0, 10], velocity=[0, 0, 0])
    simulation = started(Parallel.alone(), scene(step=STEP, gravity=(0, 0, 0), bodies=[spinning]))
    assert not simulation.state.rotating
    for _ in range(10):
        simulation.step()
    w, _, _, z = simulation.state.bodies.orientation[simulation.state.bodies.gid.argmin()]
    assert 2 * np.arctan2(z, w) == pytest.approx(10 * 10 * STEP, rel=1e-12)


# ---- whole runs ------------------------------------------------------------------------------

INLET = """
name: inlet
domain: {min: [-1, -1, -1], max: [1, 1, 2], on_leave: remove}
materials: {glass: {density: 2500}}
friction: {default: 0.4}
bodies:
  - {material: glass, count: 40, radius: {uniform: [0.03, 0.05]}, velocity: [0, 0, -2],
     velocity_jitter: 0.5,
     placement: {insertion: {min: [0, 0, 0.3], max: [0.5, 0.4, 0.5], rate: 800, start: 0.003}}}
walls:
  - {shape: box, name: box, material: glass, min: [0, 0, 0], max: [0.5, 0.4, 0.8], open: [z_max]}
removal:
  - {name: corner, min: [0, 0, 0], max: [0.25, 0.25, 0.1]}
  - {min: [0.3, 0.2, 0], max: [0.5, 0.4, 0.15]}
time: {step: 2e-3, end: 0.12}
contact: {tolerance: 1e-3, complementarity: 1e-2, max_iterations: 25, stop_factor: 1e9, skin: 1}
output: {interval: 1e-2}
checkpoint: {interval: 1.4e-2}
"""


@pytest.mark.mpi(ranks=[1, 3])
def test_a_run_stopped_while_bodies_come_and_go_equals_the_uninterrupted_one(parallel, shared_path):
    whole, parts = shared_path / "whole", shared_path / "parts"
    stride = 6 if parallel.size == 1 else 17
    simulate(parallel, INLET, whole)
    said = simulate(parallel, INLET, parts, steps=stride)
    while "stopped by SIGUSR1" in said[-1]:
        said = simulate(parallel, INLET, parts, resume=True, steps=stride)
    parallel.barrier()
    if parallel.rank == 0:
        assert differences(whole, parts) == []
        lines = metrics(whole)
        assert any(line["waiting"] for line in lines)
        assert lines[0]["bodies"] == 0
        assert 0 < lines[-1]["removed"] < 40
    parallel.barrier()


@pytest.mark.parametrize("force", [False, True])
def test_a_resume_is_refused_where_gids_would_be_given_twice(tmp_path: Path, force: bool):
    """The inlet's gids begin behind the two of the file, which has three when the run goes on."""
    file = tmp_path / "some.csv"
    file.write_text("x,y,z\n-0.6,0,0.5\n-0.8,0,0.5\n")
    group = f"- {{material: glass, radius: 0.05, placement: {{file: {file}}}}}"
    text = INLET.replace("bodies:\n", f"bodies:\n  {group}\n")
    simulate(Parallel.alone(), text, tmp_path / "out", "time.end=0.02", steps=5)
    file.write_text(file.read_text() + "-0.4,0,0.5\n")
    with pytest.raises(InputError) as refused:
        simulate(
            Parallel.alone(), text, tmp_path / "out", "time.end=0.02", resume=True, force=force
        )
    assert f"bodies[0] has 3 bodies of {file}, and had 2" in str(refused.value)
    assert "run.checkpoint.000000005.h5" in str(refused.value)
    kept = ("time.end=0.02", "bodies.0.count=2")
    simulate(Parallel.alone(), text, tmp_path / "out", *kept, resume=True)
    assert metrics(tmp_path / "out")[-1]["step"] == 10


def test_an_inlet_may_be_added_to_a_run_behind_the_others(tmp_path: Path):
    end = "time.end=0.02"
    simulate(Parallel.alone(), INLET, tmp_path, end, steps=5)
    group = INLET.split("bodies:\n")[1].split("walls:")[0]
    longer = INLET.replace("count: 40", "count: 41")
    with pytest.raises(InputError, match=re.escape("bodies[0] has 41 bodies, and had 40")):
        simulate(Parallel.alone(), longer, tmp_path, end, resume=True, force=True)
    both = INLET.replace("walls:", group + "walls:")
    simulate(Parallel.alone(), both, tmp_path, end, resume=True, force=True)
    last = metrics(tmp_path)[-1]
    assert last["bodies"] + last["removed"] > 14  # one inlet alone has let in 14 by then


def test_the_report_says_who_came_who_waits_and_who_left_where(tmp_path: Path, capsys):
    simulate(Parallel.alone(), INLET, tmp_path)
    last, report = metrics(tmp_path)[-1], " ".join(capsys.readouterr().out.split())
    assert last["bodies"] + last["removed"] == 40
    assert "40 bodies were inserted" in report
    counts = {
        name: int(
            report.split(f"kg, were removed in '{name}'")[0].rsplit(" bodies, ", 1)[0].split()[-1]
        )
        for name in ("corner", "removal1")
    }
    assert sum(counts.values()) == last["removed"]
    assert min(counts.values()) > 0


def test_a_run_that_ends_before_all_are_in_says_how_many_are_missing(tmp_path: Path, capsys):
    simulate(Parallel.alone(), INLET, tmp_path, "time.end=0.02", "removal=[]")
    report = " ".join(capsys.readouterr().out.split())
    came = metrics(tmp_path)[-1]["bodies"]
    assert f"{came} bodies were inserted, {40 - came} have not come in yet" in report


def test_a_run_does_not_count_as_resting_while_bodies_are_to_come(tmp_path: Path):
    late = "bodies.0.placement.insertion.start=0.05"
    rest = "time.stop_at_rest={steps: 3, max_speed: 100, kinetic_speed: 100}"
    simulate(Parallel.alone(), INLET, tmp_path, late, rest, "bodies.0.count=2")
    lines = metrics(tmp_path)
    assert lines[-1]["bodies"] == 2
    assert lines[-1]["time"] < 0.1


# ---- taken out -------------------------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
def test_what_is_taken_out_is_counted_once_with_its_mass(parallel):
    """40 balls cross two overlapping regions and the border of the domain at 1 m/s along x."""
    domain = {"min": [-3, -3, -3], "max": [1, 1, 1], "on_leave": "remove"}
    regions = [
        {"name": "low", "min": [0.5, -1, -1], "max": [0.6, 1, 0.1]},
        {"name": "middle", "min": [0.5, -1, 0], "max": [0.6, 1, 0.2]},
    ]
    scenario = scene(step=0.02, gravity=(0, 0, 0), bodies=None, domain=domain, removal=regions)
    draw = np.random.default_rng(5)
    position = draw.uniform([-0.5, -0.5, -0.2], [0.2, 0.5, 0.5], (40, 3))
    radius = draw.uniform(1e-3, 2e-3, 40)
    simulation = simulation_of(scenario, position, radius, [1.0, 0, 0], parallel=parallel)
    mass = 1000 * 4 / 3 * np.pi * radius**3
    momentum = mass.sum()
    lines: list[StepRecord] = []
    for _ in range(100):
        lines.append(simulation.step())
        left = everybody(parallel, simulation.state)
        present = float(left.mass @ left.velocity[:, 0]) if len(left) else 0.0
        # All move at 1 m/s: momentum left plus mass taken is what there was.
        assert present + lines[-1].removed_mass == pytest.approx(momentum, rel=1e-12)
        assert len(left) + lines[-1].removed == 40
    assert lines[-1].removed == 40
    assert all(b.removed >= a.removed for a, b in pairwise(lines))
    low = position[:, 2] <= 0.1
    middle = ~low & (position[:, 2] <= 0.2)
    state = simulation.state
    assert state.taken.tolist() == [low.sum(), middle.sum()]
    np.testing.assert_allclose(state.taken_mass, [mass[low].sum(), mass[middle].sum()], rtol=1e-12)
    assert sum(line.outside for line in lines) == 40 - low.sum() - middle.sum()


def test_bodies_that_wrap_around_are_taken_out_where_they_reappear():
    domain = {"min": [0, 0, 0], "max": [1, 1, 1], "periodic": ["x"]}
    region = {"min": [0, 0, 0], "max": [0.2, 1, 1]}
    scenario = scene(step=0.01, gravity=(0, 0, 0), domain=domain, removal=[region])
    simulation = simulation_of(scenario, [[0.95, 0.5, 0.5]], 0.01, [1.0, 0, 0])
    steps = 0
    while simulation.step().bodies:
        steps += 1
    assert steps == 4  # at 0.99 after four; a full period on after the fifth


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"removal": [{**BELOW}, {**BELOW}]}, "removal[0] has this name already"),
        ({"bodies": [inlet(1, -1)]}, "bodies[0].placement.insertion.rate = -1: must be > 0 [1/s]"),
        ({"bodies": [inlet(1, 1.0, radius=0.2)]}, "too thin for bodies of diameter 0.4 m"),
        ({"bodies": [inlet(1, 1.0, -1.0)]}, "must be >= 0 [s]"),
        ({"bodies": [{**inlet(1, 1.0), "count": None}]}, "count is required"),
    ],
)
def test_what_cannot_be_is_refused_by_name(change: dict[str, Any], words: str):
    with pytest.raises(InputError) as refused:
        load(**change)
    assert words in str(refused.value)


def test_a_wall_through_the_region_of_an_inlet_is_doubted_or_refused():
    plate = {
        "shape": "rectangle",
        "material": "m",
        "corner": [-1, -1, 0.6],
        "edges": [[2, 0, 0], [0, 2, 0]],
    }
    assert any(
        "insertion" in warning for warning in load(bodies=[inlet(1, 1.0)], walls=[plate]).warnings
    )
