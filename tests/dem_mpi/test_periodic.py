"""Periodic domains: wrapping, images, contacts across faces, conservation, crystals.

Twins try all 27 images of every pair. In a periodic box linear momentum is conserved, angular
momentum is not: a contact across a face acts at two points a period apart.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dem_mpi import state as states
from dem_mpi.bodies import Bodies
from dem_mpi.contacts import PeriodTooShortError, find_neighbours
from dem_mpi.errors import InputError
from dem_mpi.operators import Assembled, MatrixFree
from dem_mpi.parallel import Halo, Parallel
from dem_mpi.periodic import ITSELF, PeriodicBox
from dem_mpi.simulation import Simulation, SolverFailureError, redistribute
from dem_mpi.trajectory import read_frame

from contact_twins import CONTACT, cloud, detect, detection, gathered, measure, table_of
from runs import simulate
from scenes import FLOOR, everybody, load, placed, scene, simulation_of, state_of

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])

STEP = 1e-3
SHIFTS = np.array(list(itertools.product((-1, 0, 1), repeat=3)))


def box_of(axes: str = "xyz", low: float = 0.0, high: float = 1.0) -> PeriodicBox:
    return PeriodicBox([low] * 3, [high] * 3, [axis in axes for axis in "xyz"])


def cube(high: float, axes: str = "xyz") -> dict:
    """The section `domain` of a scene."""
    return {"min": [0, 0, 0], "max": [high] * 3, "periodic": list(axes)}


# ---- the box -------------------------------------------------------------------------------


def test_wrapped_positions_lie_in_the_box_a_whole_number_of_periods_away():
    rng = np.random.default_rng(1)
    box = PeriodicBox([-0.37, 0.1, -5.0], [0.81, 0.4, 7.0], [True, True, False])
    position = rng.uniform(-20.0, 20.0, (1000, 3))
    wrapped = box.wrap(position)
    inside = (wrapped >= box.low) & (wrapped < box.high)
    assert inside[:, :2].all()
    assert np.array_equal(wrapped[:, 2], position[:, 2])
    turns = (position - wrapped)[:, :2] / box.period[:2]
    # Positions of 20 m are known to 4e-15 m, of periods of 0.3 m at least.
    assert np.max(np.abs(turns - np.round(turns))) < 1e-13


def test_wrapping_keeps_the_bits_of_what_is_inside_and_never_returns_the_upper_face():
    box = box_of("xyz", -0.3, 0.7)
    inside = np.random.default_rng(2).uniform(-0.3, 0.7, (100, 3))
    assert box.wrap(inside).tobytes() == inside.tobytes()
    edges = [-0.3, 0.7, np.nextafter(0.7, 1), np.nextafter(-0.3, -1), -0.3 - 1e-20, 1.7, -1.3]
    wrapped = box.wrap(np.repeat(edges, 3).reshape(-1, 3))
    assert np.all((wrapped >= -0.3) & (wrapped < 0.7))
    assert np.array_equal(box.wrap(wrapped), wrapped)


@pytest.mark.parametrize("axes", ["x", "yz", "xyz"])
def test_images_are_those_that_reach_into_the_box_in_a_fixed_order(axes):
    rng = np.random.default_rng(3)
    box = box_of(axes)
    position, reach = rng.random((200, 3)), rng.uniform(0.0, 0.4, 200)
    row, code = box.images(position, reach)
    found = set(zip(row.tolist(), code.tolist(), strict=True))
    expected = set()
    for number, shift in enumerate(SHIFTS):
        if number == ITSELF or np.any(shift[~box.periodic]):
            continue
        image = position + shift
        meets = (image - reach[:, None] <= 1.0) & (image + reach[:, None] >= 0.0)
        expected |= {(int(i), number) for i in np.flatnonzero(meets[:, box.periodic].all(axis=1))}
    assert found == expected
    assert len(found) == len(row) and list(zip(code, row, strict=True)) == sorted(
        zip(code, row, strict=True)
    )


# ---- contacts ------------------------------------------------------------------------------


def near_faces(count: int = 250, radius: float = 0.05) -> Bodies:
    """Bodies that crowd the faces, edges and corners of the unit box."""
    rng = np.random.default_rng(4)
    side = rng.random((count, 3)) ** 3
    position = np.where(rng.random((count, 3)) < 0.5, side, 1.0 - side)
    position = np.minimum(position, np.nextafter(1.0, 0.0))
    spin = rng.normal(size=(count, 3))
    return cloud(position, radius, rng.normal(size=(count, 3)), spin)


def sizes(count: int = 200) -> Bodies:
    rng = np.random.default_rng(5)
    return cloud(rng.random((count, 3)), 0.2 * 20.0 ** rng.uniform(-1, 0, count))


def on_faces() -> Bodies:
    """Touching bodies on a simple cubic lattice, one layer in the faces of the box."""
    steps = np.arange(4) / 4.0
    position = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return cloud(position, 0.125)


CLOUDS: dict[str, tuple[str, Callable[[], Bodies]]] = {
    "near faces, x": ("x", near_faces),
    "near faces, xz": ("xz", near_faces),
    "near faces, xyz": ("xyz", near_faces),
    "size ratio 20": ("xyz", sizes),
    "on the faces": ("xyz", on_faces),
    "of two diameters": ("xyz", lambda: cloud(np.random.default_rng(6).random((12, 3)), 0.24)),
    "of one distance": ("xy", lambda: cloud(np.random.default_rng(7).random((6, 3)), 0.47)),
    "one": ("xyz", lambda: cloud([[0.99, 0.5, 0.01]], 0.3)),
    "none": ("xyz", lambda: cloud(np.zeros((0, 3)), 0.1)),
}


def norm(d: np.ndarray) -> np.ndarray:
    return np.sqrt(d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2])


def twin(b: Bodies, box: PeriodicBox, options, step: float) -> np.ndarray:
    """Every pair with all images of the larger gid, in the order of the definition."""
    spin = norm(b.angular_velocity) * b.radius
    parts = [np.zeros(0, dtype=CONTACT)]
    shifts = np.unique(SHIFTS * box.periodic, axis=0) * box.period
    for i in range(len(b)):
        j = np.flatnonzero(b.gid > b.gid[i])
        image = b.position[j][:, None] + shifts
        d = image - b.position[i]
        distance = norm(d)
        phi = distance - (b.radius[i] + b.radius[j])[:, None]
        mu = options.friction[b.material[i], b.material[j]]
        speed = norm(b.velocity[i] - b.velocity[j])
        margin = np.maximum(
            options.margin * np.minimum(b.radius[i], b.radius[j]),
            step * (speed * (1.0 + mu) + spin[i] + spin[j]),
        )
        k, s = np.nonzero(phi <= margin[:, None])
        found = np.zeros(len(k), dtype=CONTACT)
        found["a"], found["other"] = b.gid[i], b.gid[j[k]]
        found["gap"], found["friction"] = phi[k, s], mu[k]
        found["normal"] = d[k, s] / distance[k, s][:, None]
        gap = phi[k, s]
        found["arm"] = np.stack((b.radius[i] + 0.5 * gap, b.radius[j[k]] + 0.5 * gap), axis=1)
        parts.append(found)
    return in_order(np.concatenate(parts))


def in_order(table: np.ndarray) -> np.ndarray:
    """Contacts by a, b and the image of b, which the direction to b tells."""
    separation = table["normal"] * table["arm"].sum(axis=1)[:, None]
    x, y, z = np.round(separation, 9).T
    return table[np.lexsort((z, y, x, table["other"], table["a"]))]


@ranks_1_2_3_8
@pytest.mark.parametrize("name", CLOUDS)
def test_contacts_across_faces_equal_brute_force_to_the_bit(parallel, name):
    axes, make = CLOUDS[name]
    box, bodies = box_of(axes), make()
    options = replace(detection(), box=box)
    found = detect(parallel, bodies, options, STEP)
    expected = twin(bodies, box, options, STEP)
    if len(bodies) > 1:
        plain = twin(bodies, box_of(""), options, STEP)
        assert len(expected) > len(plain), "no contact crosses a face"
    mine = table_of(found.contacts, found.neighbours.gid)
    # Of several images of one body the order is that of the directions, on any rank.
    by_row = np.argsort(mine["a"], kind="stable")
    assert mine[by_row].tobytes() == in_order(mine).tobytes()
    assert in_order(gathered(parallel, mine)).tobytes() == expected.tobytes()


@ranks_1_2_3_8
def test_listed_pairs_stay_complete_while_bodies_drift_past_the_faces(parallel):
    box, bodies = box_of("xyz"), near_faces()
    bodies.velocity, bodies.angular_velocity = np.zeros((2, len(bodies), 3))
    options = replace(detection(skin=0.03), box=box)
    found = detect(parallel, bodies, options, STEP)
    rng = np.random.default_rng(8)
    moves = rng.uniform(-1.0, 1.0, (len(bodies), 3)) * 0.015 / np.sqrt(3.0)
    row = {int(gid): k for k, gid in enumerate(bodies.gid)}
    bodies.position += moves
    owned = found.bodies
    owned.position += moves[[row[int(gid)] for gid in owned.gid]]
    contacts = measure(found.neighbours, owned, options, STEP)
    table = gathered(parallel, table_of(contacts, found.neighbours.gid))
    assert np.any((bodies.position < 0.0) | (bodies.position >= 1.0))
    assert in_order(table).tobytes() == twin(bodies, box, options, STEP).tobytes()


@ranks_1_2_3_8
def test_only_bodies_near_periodic_faces_become_ghosts_of_their_own_rank(parallel):
    bodies = near_faces()
    sent = parallel.bytes_sent
    plain = detect(parallel, bodies, detection(), STEP)
    sent, before = parallel.bytes_sent, parallel.bytes_sent - sent
    wrapped = detect(parallel, bodies, replace(detection(), box=box_of("xyz")), STEP)
    ghosts, bare = wrapped.neighbours.halo.ghosts, plain.neighbours.halo.ghosts
    total, bare = parallel.sum(np.array([ghosts, bare]))
    print(f"ghosts: {bare} without, {total} with periodic faces; {before} bytes before")
    assert plain.neighbours.shift is None
    assert total > bare
    if parallel.size == 1:
        assert bare == 0 and parallel.bytes_sent == sent, "a rank sends itself nothing"


@ranks_1_2_3_8
def test_a_period_shorter_than_bodies_interact_over_is_refused_on_all_ranks(parallel):
    bodies = cloud([[0.1, 0.5, 0.5], [0.6, 0.5, 0.5]], 0.24)
    box = PeriodicBox([0, 0, 0], [10, 0.49, 10], [True, True, True])
    bodies.position[:, 1] = 0.2
    options = replace(detection(skin=0.02), box=box)
    with pytest.raises(PeriodTooShortError, match=r"0\.49 m along y"):
        detect(parallel, bodies, options, STEP)


# ---- halo and operators --------------------------------------------------------------------


@ranks_1_2_3_8
def test_halo_sums_several_ghosts_of_one_body_in_the_order_sent(parallel):
    """Every rank sends rows 0..4 to all ranks, itself included, and rows 1..3 once more."""
    rows = np.array([0, 1, 2, 3, 4, 1, 2, 3])
    halo = Halo.build(parallel, 5, dict.fromkeys(range(parallel.size), rows))
    values = np.zeros((5 + halo.ghosts, 3))
    values[:5] = np.random.default_rng(parallel.rank).random((5, 3))
    halo.forward(values)
    everyone = parallel.allgather(values[:5])
    assert np.array_equal(values[5:], np.concatenate([part[rows] for part in everyone]))

    mine = values[:5].copy()
    values[5:] *= parallel.rank + 2
    halo.reverse_add(values)
    expected = mine.copy()
    for receiver, row in itertools.product(range(parallel.size), rows):
        expected[row] += mine[row] * (receiver + 2)
    assert np.array_equal(values[:5], expected)

    codes = {r: np.arange(8) + r for r in range(parallel.size)}
    told = halo.deliver(codes)
    assert np.array_equal(told, np.tile(np.arange(8) + parallel.rank, parallel.size))


@ranks_1_2_3_8
@pytest.mark.parametrize("frictional", [True, False], ids=["mu", "smooth"])
@pytest.mark.parametrize("name", ["near faces, xyz", "on the faces", "of two diameters"])
def test_assembled_operator_equals_matrix_free_across_faces(parallel, name, frictional):
    axes, make = CLOUDS[name]
    found = detect(parallel, make(), replace(detection(margin=0.1), box=box_of(axes)), STEP)
    n, contacts = found.neighbours, found.contacts
    masses = (n.inverse_mass, n.inverse_inertia, n.halo)
    free = MatrixFree(contacts, *masses, frictional)
    assembled = Assembled(contacts, *masses, frictional, parallel)
    rng = np.random.default_rng(9 + parallel.rank)
    impulse = rng.normal(size=(contacts.count, free.columns))
    one, other = np.empty_like(impulse), np.empty_like(impulse)
    free.apply(impulse, one)
    assembled.apply(impulse, other)
    assembled.destroy()
    # Sums of some 20 products of 1e-16 each.
    scale = parallel.max(float(np.max(np.abs(one), initial=0.0)))
    assert parallel.sum(contacts.count) > 0
    assert np.max(np.abs(one - other), initial=0.0) <= 1e-13 * scale


# ---- motion --------------------------------------------------------------------------------


def gas(side: int = 4, spacing: float = 0.11, seed: int = 10) -> tuple:
    """Position, radius, velocity and spin of a dense jittered lattice that fills a box."""
    rng = np.random.default_rng(seed)
    steps = (np.arange(side) + 0.5) * spacing
    position = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    position += rng.uniform(-0.01, 0.01, position.shape)
    shape = position.shape
    return position, 0.05, rng.normal(size=shape) + [0.7, 0.2, -0.4], rng.normal(size=shape) * 5.0


@pytest.mark.mpi(ranks=[1, 2, 3, 8], timeout=240)
def test_a_dense_frictional_gas_conserves_momentum_and_keeps_its_energy_balance(parallel):
    side, spacing = 4, 0.11
    scenario = scene(
        step=2e-3, mu=0.3, gravity=(0, 0, 0), domain=cube(side * spacing),
        contact={"tolerance": 1e-3, "complementarity": 1e-2},
    )  # fmt: skip
    simulation = simulation_of(scenario, *gas(side, spacing), parallel=parallel)
    first = everybody(parallel, simulation.state)
    energy = first.mass @ np.sum(first.velocity**2, axis=1)
    collisions = 0
    for _ in range(200):
        record = simulation.step()
        collisions += record.contacts
        assert record.converged
        # Both sides are sums of some 1000 terms of at most the gas's energy.
        assert abs(record.energy_change - record.energy_balance) <= 1e-12 * energy
        assert record.energy_change <= 1e-12 * energy + record.overlap
    last = everybody(parallel, simulation.state)
    before, after = first.mass @ first.velocity, last.mass @ last.velocity
    scale = first.mass @ np.linalg.norm(first.velocity, axis=1)
    assert collisions > 1000
    # 200 steps, in each of which a body adds up some ten impulses of rounding 1e-16.
    assert np.max(np.abs(after - before)) <= 200 * 10 * 1e-16 * scale
    assert np.array_equal(first.gid, last.gid)


def simple_cubic(side: int) -> tuple[np.ndarray, float]:
    steps = np.arange(side) * 0.1
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3), side * 0.1


def face_centred_cubic(side: int) -> tuple[np.ndarray, float]:
    edge = 0.1 * np.sqrt(2.0)
    basis = np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]]) / 2
    cells = np.array(list(itertools.product(range(side), repeat=3)))
    return ((cells[:, None] + basis) * edge).reshape(-1, 3), side * edge


CRYSTALS = {
    "simple cubic, 2": (lambda: simple_cubic(2), 3, "matrix_free"),
    "simple cubic, 2, assembled": (lambda: simple_cubic(2), 3, "assembled"),
    "simple cubic, 4": (lambda: simple_cubic(4), 3, "matrix_free"),
    "fcc, 2": (lambda: face_centred_cubic(2), 6, "matrix_free"),
}


@pytest.mark.mpi(ranks=[1, 3], timeout=240)
@pytest.mark.parametrize("name", CRYSTALS)
def test_a_crystal_of_touching_spheres_stays_whole_while_it_drifts_around_the_box(parallel, name):
    """1000 steps, five times around; each body keeps its 6 or 12 contacts through all faces."""
    make, contacts_each, operator = CRYSTALS[name]
    position, period = make()
    drift = np.array([1.0, -0.7, 0.4]) * period * 5.0
    scenario = scene(
        step=1e-3, mu=0.5, gravity=(0, 0, 0), domain=cube(period), contact={"operator": operator}
    )
    simulation = simulation_of(scenario, position, 0.05, drift, parallel=parallel)
    for _ in range(1000):
        record = simulation.step()
        assert record.contacts == contacts_each * len(position)
        assert record.bodies == len(position) and record.outside == 0
    last = everybody(parallel, simulation.state)
    moved = last.position - position - drift
    moved -= np.round(moved / period) * period
    # 1000 additions to positions of 0.3 m, known to 6e-17 m each.
    assert np.max(np.abs(moved)) < 1e-12
    assert np.max(np.abs(last.velocity - drift)) < 1e-12


@ranks_1_2_3_8
def test_bodies_that_cross_faces_many_times_keep_name_and_velocity(parallel):
    position = np.array([[0.1, 0.1, 0.1], [0.6, 0.6, 0.6], [0.1, 0.6, 0.6]])
    velocity = np.array([31.0, -17.0, 9.0])
    scenario = scene(step=1e-3, gravity=(0, 0, 0), domain={**cube(1.0), "on_leave": "remove"})
    simulation = simulation_of(scenario, position, 0.05, velocity, parallel=parallel)
    moved = 0
    for _ in range(250):
        record = simulation.step()
        moved += record.moved
        assert (record.bodies, record.outside) == (3, 0)
        inside = simulation.wrapped_position()
        assert np.all((inside >= 0.0) & (inside < 1.0))
    last = everybody(parallel, simulation.state)
    assert last.gid.tolist() == [0, 1, 2]
    assert np.all(last.velocity == velocity)
    # 250 additions and some 7 wraps of numbers up to 1.
    expected = (position + 0.25 * velocity) % 1.0
    assert np.allclose(last.position % 1.0, expected, rtol=0, atol=1e-12)
    assert parallel.size == 1 or moved > 5


@ranks_1_2_3_8
@pytest.mark.parametrize("mu", [0.0, 0.4])
def test_shifting_all_bodies_changes_no_velocity(parallel, mu):
    """Bodies start outside of the box where the shift takes them there."""
    period = 4 * 0.11
    scenario = scene(
        step=2e-3, mu=mu, gravity=(0, 0, 0), domain=cube(period),
        contact={
            "tolerance": 1e-9, "complementarity": 1e-10, "max_iterations": 20000, "margin": 0.3,
        },
    )  # fmt: skip
    position, *others = gas()
    results = []
    for shift in (0.0, period / 3.0, -2.5 * period):
        simulation = simulation_of(scenario, position + shift, *others, parallel=parallel)
        records = [simulation.step() for _ in range(3)]
        assert records[-1].iterations > 0
        everyone = everybody(parallel, simulation.state)
        results.append((records[-1].contacts, everyone.velocity, everyone.angular_velocity * 0.05))
    for contacts, *motion in results[1:]:
        assert contacts == results[0][0]
        # Three solves to 1e-9 m/s; velocities follow residuals with a factor of some tens.
        for one, other in zip(motion, results[0][1:], strict=True):
            assert np.max(np.abs(one - other)) < 1e-7


@pytest.mark.mpi(ranks=[1, 2, 3], timeout=240)
@pytest.mark.parametrize("shape", ["spherocylinder", "spheroid"])
def test_bodies_that_are_not_spheres_meet_across_faces_as_in_the_middle(parallel, shape):
    group = {
        "material": "m", "shape": shape, "aspect_ratio": 1.5, "axis": "random", "count": 27,
        "radius": 0.05, "velocity_jitter": 1.0, "angular_velocity": [3.0, 0, 2.0],
        "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [0.46] * 3}},
    }  # fmt: skip
    scenario = scene(
        step=2e-3, mu=0.3, gravity=(0, 0, 0), domain=cube(0.46), bodies=[group],
        contact={"tolerance": 1e-9, "complementarity": 1e-10, "max_iterations": 20000},
    )  # fmt: skip
    results = []
    for shift in (0.0, 0.46 / 3.0):
        state = placed(parallel, scenario)
        state.bodies.position += shift
        simulation = Simulation(parallel, scenario, state)
        first = everybody(parallel, state)
        contacts = sum(simulation.step().contacts for _ in range(25))
        last = everybody(parallel, simulation.state)
        scale = first.mass @ np.linalg.norm(first.velocity, axis=1)
        change = last.mass @ last.velocity - first.mass @ first.velocity
        # 25 steps, in each of which a body adds up some ten impulses of rounding 1e-16.
        assert np.max(np.abs(change)) <= 25 * 10 * 1e-16 * scale
        results.append((contacts, last.velocity))
    assert results[0][0] == results[1][0] > 20
    # 25 solves to 1e-9 m/s; velocities follow residuals with a factor of some tens.
    assert np.max(np.abs(results[0][1] - results[1][1])) < 1e-6


@ranks_1_2_3_8
def test_a_collision_across_a_corner_is_the_collision_in_the_middle(parallel):
    scenario = scene(
        step=1e-3,
        mu=0.3,
        gravity=(0, 0, 0),
        domain=cube(1.0),
        contact={"tolerance": 1e-10, "complementarity": 1e-10},
    )
    pair = np.array([[0.43, 0.45, 0.44], [0.57, 0.55, 0.56]])
    velocity = np.array([[1.0, 0.8, 0.9], [-1.0, -0.3, -0.7]])
    ends = []
    for shift in (0.0, 0.5):
        simulation = simulation_of(scenario, pair + shift, 0.1, velocity, parallel=parallel)
        for _ in range(100):
            simulation.step()
        ends.append(everybody(parallel, simulation.state))
    assert np.max(np.abs(ends[0].velocity - velocity)) > 0.1, "they did not collide"
    for name in ("velocity", "angular_velocity"):
        one, other = (getattr(end, name) for end in ends)
        # Each of 100 steps is solved to 1e-10 m/s; positions differ by rounding besides.
        assert np.max(np.abs(one - other)) < 1e-7


@pytest.mark.mpi(ranks=[1, 3])
def test_a_layer_slides_down_an_endless_smooth_incline(parallel):
    """The incline is level and gravity oblique: v = g_x t, however often the layer comes around."""
    scenario = scene(
        step=2e-3, gravity=(6.0, 0, -9.81), domain=cube(0.3, "xy"), walls=[FLOOR],
        contact={"tolerance": 1e-8, "complementarity": 1e-8},
    )  # fmt: skip
    position = simple_cubic(3)[0][2::3] * [1, 1, 0] + [0, 0, 0.05]
    simulation = simulation_of(scenario, position, 0.05, parallel=parallel)
    for _ in range(500):
        record = simulation.step()
        assert record.contacts == 9 + 18
    last = everybody(parallel, simulation.state)
    # Each of 500 steps is solved to 1e-8 m/s.
    assert np.max(np.abs(last.velocity - [6.0, 0.0, 0.0])) < 500 * 1e-8


# ---- going on ------------------------------------------------------------------------------


def bits(bodies: Bodies) -> bytes:
    return b"".join(array.tobytes() for array in bodies.arrays().values())


@pytest.mark.mpi(ranks=[1, 2, 3])
def test_a_periodic_run_resumes_bit_for_bit_and_goes_on_after_redistribution(parallel, shared_path):
    scenario = scene(
        step=2e-3, mu=0.3, gravity=(0, 0, 0), domain=cube(4 * 0.11), contact={"tolerance": 1e-3}
    )
    simulation = simulation_of(scenario, *gas(), parallel=parallel)
    for _ in range(25):
        simulation.step()
    path = states.save(parallel, simulation.state, shared_path, "run", {}, "0", keep=1, time=0.0)
    resumed = Simulation(parallel, scenario, states.restore(parallel, path)[0])
    spread = redistribute(parallel, states.restore(parallel, path)[0])
    elsewhere = Simulation(parallel, scenario, spread)
    for _ in range(10):
        records = [s.step() for s in (simulation, resumed, elsewhere)]
    ends = [everybody(parallel, s.state) for s in (simulation, resumed, elsewhere)]
    assert bits(ends[0]) == bits(ends[1])
    assert records[2].bodies == 64 and records[2].converged


@ranks_1_2_3_8
def test_bodies_too_fast_for_the_period_stop_the_run_with_the_remedy(parallel):
    scenario = scene(step=1e-2, gravity=(0, 0, 0), domain=cube(0.5))
    velocity = [[40.0, 0, 0], [-40.0, 0, 0]]
    simulation = simulation_of(
        scenario, [[0.1, 0.1, 0.1], [0.3, 0.3, 0.3]], 0.05, velocity, parallel=parallel
    )
    with pytest.raises(SolverFailureError, match=r"lower time\.step") as failure:
        simulation.step()
    assert failure.value.intact


def test_the_pair_list_of_a_scene_without_periodic_axes_has_no_images():
    parallel = Parallel.alone()
    scenario = scene(gravity=(0, 0, 0))
    state = state_of(parallel, scenario, [[0.0, 0, 0], [0.1, 0, 0]], 0.05)
    simulation = Simulation(parallel, scenario, state)
    simulation.step()
    options = simulation._detection
    neighbours = find_neighbours(parallel, state.partition, state.bodies, state.reference, options)
    assert options.box is None and neighbours.shift is None and neighbours.halo.ghosts == 0


# ---- scenes --------------------------------------------------------------------------------

BODIES = {
    "material": "m",
    "count": 8,
    "radius": 0.05,
    "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [0.3, 0.3, 0.3]}},
}
BOX = {"shape": "box", "material": "m", "min": [0, 0, 0], "max": [1, 1, 1]}
PLANE = {"shape": "plane", "material": "m", "point": [0, 0, 0]}
BEYOND = {"min": [0.5, -3, 0], "max": [1.2, 4, 0.3]}
TURN = {"rotation": {"centre": [0, 0, 0], "axis": [0, 0, 1], "rate": 1.0}}


def filled(placement: dict) -> dict:
    """A scene's bodies, placed so."""
    return {"bodies": [{**BODIES, "placement": placement}]}


@pytest.mark.parametrize(
    ("sections", "rule"),
    [
        ({"domain": cube(0.105)}, "repeats every 0.105 m, but bodies interact over up to 0.111 m"),
        ({"walls": [{**BOX, "open": ["x_min"]}]}, "periodic along x: add x_max"),
        ({"walls": [{**PLANE, "normal": [0.1, 0, 1]}]}, "must not cut the periodic axis x"),
        ({"walls": [{**PLANE, "normal": [0, 0, 1], "motion": TURN}]}, "other than the periodic"),
        # Bodies at home in the box are met there only through their nearest images.
        (filled({"random": BEYOND}), "random.*: must lie within the domain"),
        (filled({"insertion": {**BEYOND, "rate": 1.0}}), "insertion: must lie within"),
    ],
    ids=["short period", "closed box", "oblique plane", "turning plane", "random", "inlet"],
)
def test_scenes_that_do_not_repeat_are_refused(sections, rule):
    with pytest.raises(InputError, match=rule):
        load(**{"domain": cube(1.0, "x"), "bodies": [BODIES], **sections})


@pytest.mark.parametrize(
    ("wall", "doubted"),
    [
        ({"shape": "rectangle", "corner": [0, 0, 0], "edges": [[1, 0, 0], [0, 1, 0]]}, True),
        ({"shape": "rectangle", "corner": [-0.2, 0, 0], "edges": [[1.4, 0, 0], [0, 1, 0]]}, False),
        ({"shape": "rectangle", "corner": [0.3, 0, 0], "edges": [[0.4, 0, 0], [0, 1, 0]]}, False),
        ({"shape": "cylinder", "start": [0, 0, 0], "end": [1, 0, 0], "radius": 0.5}, True),
        ({"shape": "cylinder", "start": [-1, 0, 0], "end": [2, 0, 0], "radius": 0.5}, False),
        ({"shape": "ring", "centre": [0.5, 0, 0], "normal": [0, 0, 1], "radii": [0, 0.46]}, True),
        ({"shape": "ring", "centre": [0.5, 0, 0], "normal": [1, 0, 0], "radii": [0, 0.9]}, False),
    ],
)
def test_finite_walls_that_end_near_a_periodic_face_are_doubted(wall, doubted):
    group = {**BODIES, "placement": {"jittered_grid": {"min": [0.1] * 3, "max": [0.4] * 3}}}
    sections = {"domain": cube(1.0, "x"), "gravity": (0, 0, 0), "bodies": [group]}
    loaded = load(walls=[{"material": "m", **wall}], **sections)
    assert any("walls do not repeat" in text for text in loaded.warnings) == doubted


STREAM = """
domain: {min: [0, 0, 0], max: [0.44, 0.44, 0.44], periodic: [x, y, z]}
gravity: [0, 0, 0]
materials: {glass: {density: 2500}}
friction: {default: 0.3}
bodies:
  - {material: glass, count: 64, radius: 0.05, velocity: [8, -5, 3], velocity_jitter: 1,
     placement: {jittered_grid: {min: [0, 0, 0], max: [0.44, 0.44, 0.44], jitter: 1}}}
time: {step: 2e-3, end: 0.1}
contact: {tolerance: 1e-3, complementarity: 1e-2}
output: {interval: 1e-2}
"""


@pytest.mark.mpi(ranks=[1, 3])
def test_written_positions_lie_in_the_box(parallel, shared_path):
    simulate(parallel, STREAM, shared_path)
    parallel.barrier()
    for frame in range(10):
        position = read_frame(shared_path / "run.h5", frame).columns["position"]
        assert position.shape == (64, 3)
        assert np.all((position >= 0.0) & (position < 0.44))
