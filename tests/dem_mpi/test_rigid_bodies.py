"""Rods and spheroids in whole steps: on planes, in piles, across ranks, in checkpoints.

Symbols: r radius, l half length, m mass, I_t moment of inertia across the axis, h time step.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from dem_mpi import integrator, state
from dem_mpi._kernels_shapes import pair_contacts, wall_contacts
from dem_mpi.bodies import Bodies
from dem_mpi.contacts import DetectionOptions, Reference, find_neighbours
from dem_mpi.errors import DataError
from dem_mpi.narrow_phase import find_general_contacts
from dem_mpi.parallel import Parallel
from dem_mpi.shapes import SPHERE
from dem_mpi.simulation import Simulation

from contact_twins import distribute, gathered, room
from runs import checkpoints, differences, simulate
from scenes import FLOOR, everybody, observed_order, placed, scene

G = 9.81
R = 0.1
TIGHT = {"tolerance": 1e-11, "complementarity": 1e-12}
ranks_1_2_3 = pytest.mark.mpi(ranks=[1, 2, 3])


def one_body(
    shape: str,
    aspect: float,
    axis: list[float],
    step: float,
    mu: float,
    gravity: tuple[float, float, float] = (0.0, 0.0, -G),
) -> Simulation:
    """A body of radius R whose lowest point touches the floor, at rest."""
    group = {
        "shape": shape,
        "aspect_ratio": aspect,
        "material": "m",
        "count": 1,
        "radius": R,
        "axis": axis,
        "placement": {"jittered_grid": {"min": [-1, -1, 0], "max": [1, 1, 2]}},
    }
    scenario = scene(
        step=step, end=1e3 * step, mu=mu, gravity=gravity, bodies=[group], walls=[FLOOR],
        contact=TIGHT,
    )  # fmt: skip
    alone = Parallel.alone()
    simulation = Simulation(alone, scenario, placed(alone, scenario))
    bodies = simulation.state.bodies
    sine = integrator.symmetry_axes(bodies)[0, 2]
    length = bodies.half_length[0]
    if shape == "spheroid":
        bodies.position[0, 2] = np.hypot(R * np.sqrt(1.0 - sine * sine), length * sine)
    else:
        bodies.position[0, 2] = R + length * abs(sine)
    return simulation


def elevation(simulation: Simulation) -> float:
    """Angle [rad] of the symmetry axis above the floor."""
    return float(np.arcsin(integrator.symmetry_axes(simulation.state.bodies)[0, 2]))


# ---- one body on the floor -----------------------------------------------------------------


@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_a_rod_lying_on_the_floor_stays_put(mu: float) -> None:
    """Two contacts bear half of the weight each, for a thousand steps.

    Tolerance: the solve leaves up to 1e-11 m/s a step, which friction takes back or not.
    """
    h, steps = 1e-3, 1000
    simulation = one_body("spherocylinder", 4.0, [0.6, 0.8, 0.0], h, mu)
    first = simulation.state.bodies.take([0])
    for _ in range(steps):
        record = simulation.step()
        assert record.converged and record.contacts == 2
    bodies = simulation.state.bodies
    assert np.abs(bodies.position - first.position).max() <= steps * h * steps * 1e-11
    turned = integrator.symmetry_axes(bodies) - integrator.symmetry_axes(first)
    assert np.abs(turned).max() <= steps * h * steps * 1e-11 / R
    weight = -0.5 * bodies.mass[0] * G * h
    assert simulation.state.memory.impulse[:, 2] == pytest.approx([weight, weight], rel=1e-6)


def falling_rod(h: float, start: float, end: float) -> float:
    """Error of the time [s] at which a rod let go at elevation `start` has fallen to `end`."""
    axis = [np.cos(start), 0.0, np.sin(start)]
    simulation = one_body("spherocylinder", 5.0, axis, h, 0.0)
    bodies = simulation.state.bodies
    x, m, moment, length = (
        bodies.position[0, 0], bodies.mass[0], bodies.inertia[0], bodies.half_length[0],
    )  # fmt: skip

    def slowness(angle: float) -> float:
        # (I_t + m l^2 cos^2) theta'^2 / 2 = m g l (sin start - sin)
        inertia = moment + m * (length * np.cos(angle)) ** 2
        return np.sqrt(inertia / (2.0 * m * G * length * (np.sin(start) - np.sin(angle))))

    exact, _ = quad(slowness, end, start, epsabs=1e-10)
    angle = before = start
    step = 0
    while angle > end:
        before = angle
        simulation.step()
        angle = elevation(simulation)
        step += 1
    assert simulation.state.bodies.position[0, 0] == pytest.approx(x, abs=1e-12)
    return (step - 1 + (before - end) / (before - angle)) * h - exact


def test_a_rod_falls_on_a_smooth_floor_as_theory_has_it_at_first_order() -> None:
    """Its lower end slides away while the centre falls straight down.

    Elevation from 0.9 to 0.3, known by quadrature from the energy. Normal impulses alone turn it.
    """
    steps = (4e-3, 2e-3, 1e-3, 5e-4)
    errors = [falling_rod(h, 0.9, 0.3) for h in steps]
    assert observed_order(steps, errors) == pytest.approx(1.0, abs=0.1)
    assert abs(errors[-1]) <= 5e-4


def quarter_period(tilt: float, mass: float, moment: float, length: float) -> float:
    """Time [s] in which a prolate spheroid rolls from rest at elevation `tilt` to lying flat.

    Its centre is at height H = sqrt(R^2 cos^2 + l^2 sin^2) above the contact, and H' beside it:
    (I_t + m (H^2 + H'^2)) theta'^2 / 2 = m g (H(tilt) - H). With theta = tilt sin(u) the integrand
    is smooth.
    """

    def height(angle: float) -> tuple[float, float]:
        H = np.hypot(R * np.cos(angle), length * np.sin(angle))
        return H, (length**2 - R**2) * np.sin(angle) * np.cos(angle) / H

    def slowness(u: float) -> float:
        angle = tilt * np.sin(u)
        H, slope = height(angle)
        fall = height(tilt)[0] - H
        inertia = moment + mass * (H * H + slope * slope)
        return tilt * np.cos(u) * np.sqrt(inertia / (2.0 * mass * G * fall))

    return quad(slowness, 0.0, 0.5 * np.pi - 1e-7, epsabs=1e-9)[0]


def crossings(h: float, tilt: float, count: int) -> tuple[list[float], float]:
    """Times [s] at which a rocking spheroid lies flat, and its quarter period by quadrature."""
    simulation = one_body("spheroid", 2.0, [np.cos(tilt), 0.0, np.sin(tilt)], h, 0.8)
    bodies = simulation.state.bodies
    exact = quarter_period(tilt, bodies.mass[0], bodies.inertia[0], bodies.half_length[0])
    angle, step, found = tilt, 0, []
    while len(found) < count:
        before = angle
        record = simulation.step()
        assert record.converged and record.contacts == 1
        angle = elevation(simulation)
        if before * angle < 0.0:
            found.append((step + before / (before - angle)) * h)
        step += 1
    return found, exact


def test_a_rolling_spheroid_rocks_at_the_frequency_of_theory() -> None:
    """Small tilts: omega^2 = g (l^2/R - R) m / (I_t + m R^2), the radius of curvature being l^2/R.

    The time of the first pass is of first order in h, for the kick comes before the drift; half
    periods, which do not see where the step began, are of second order.
    """
    tilt, steps = 0.02, (8e-3, 4e-3, 2e-3)
    first, half = [], []
    for h in steps:
        times, exact = crossings(h, tilt, 2)
        first.append(times[0] - exact)
        half.append(times[1] - times[0] - 2.0 * exact)
    assert observed_order(steps, first) == pytest.approx(1.0, abs=0.1)
    assert observed_order(steps, half) == pytest.approx(2.0, abs=0.2)
    simulation = one_body("spheroid", 2.0, [1.0, 0.0, 0.0], 1e-3, 0.8)
    m, moment = simulation.state.bodies.mass[0], simulation.state.bodies.inertia[0]
    omega = np.sqrt(G * m * (4.0 * R - R) / (moment + m * R * R))
    # The period grows with the square of the tilt.
    assert exact == pytest.approx(0.5 * np.pi / omega, rel=5.0 * tilt**2)


def test_a_rod_on_a_slope_slides_down_when_friction_cannot_hold_it() -> None:
    """tan(alpha) above mu along the axis: a = g (sin alpha - mu cos alpha), after the take-off.

    Tolerance: the relaxed cone lets a sliding contact hover at h mu v (0.1 % of the speed).
    """
    alpha, mu, h = 0.5, 0.3, 1e-3
    gravity = (G * np.sin(alpha), 0.0, -G * np.cos(alpha))
    simulation = one_body("spherocylinder", 8.0, [1.0, 0.0, 0.0], h, mu, gravity)
    for _ in range(300):
        assert simulation.step().converged
    v = simulation.state.bodies.velocity[0]
    assert v[0] == pytest.approx(0.3 * G * (np.sin(alpha) - mu * np.cos(alpha)), rel=5e-3)
    assert abs(v[1]) <= 1e-9


# ---- many bodies ---------------------------------------------------------------------------

MIX = [
    {
        "shape": shape,
        **({} if shape == "sphere" else {"aspect_ratio": aspect}),
        "material": "m",
        "count": 9,
        "radius": radius,
        "axis": "random" if shape != "sphere" else [0, 0, 1],
        "angular_velocity": [3.0, -2.0, 5.0],
        "velocity_jitter": 0.5,
        "placement": {"jittered_grid": {"min": [0, 0, z], "max": [0.4, 0.4, z + 0.15]}},
    }
    for shape, aspect, radius, z in (
        ("spherocylinder", 3.0, 0.02, 0.0),
        ("spheroid", 2.5, 0.025, 0.15),
        ("spheroid", 0.4, 0.05, 0.3),
        ("sphere", 1.0, 0.04, 0.45),
    )
]
BOX = {"shape": "box", "name": "box", "material": "m", "min": [0, 0, 0], "max": [0.4, 0.4, 2]}


def total_momenta(bodies: Bodies) -> np.ndarray:
    """Momentum [kg m/s] and angular momentum [kg m^2/s] about the origin, (6,)."""
    b, d = bodies, integrator.symmetry_axes(bodies)
    p = b.mass[:, None] * b.velocity
    along = np.sum(d * b.angular_velocity, axis=1, keepdims=True) * d
    own = b.inertia[:, None] * (b.angular_velocity - along) + b.axial_inertia[:, None] * along
    return np.concatenate((p.sum(axis=0), (np.cross(b.position, p) + own).sum(axis=0)))


@ranks_1_2_3
@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_colliding_bodies_of_all_shapes_keep_both_momenta(parallel, mu: float) -> None:
    """Through whole steps: the drift keeps x x m v, for v x v = 0, and L of each body.

    Tolerance: 150 steps round sums of 36 momenta of up to 1 kg m/s. The energy a step takes is
    known twice, from the bodies and from the contacts; nothing is gained.
    """
    scenario = scene(
        step=2e-3, end=0.3, mu=mu, gravity=(0.0, 0.0, 0.0), bodies=MIX, contact={"tolerance": 1e-6}
    )
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    pull = simulation.state.bodies
    pull.velocity += 2.0 * (np.array([0.2, 0.2, 0.3]) - pull.position)
    before = total_momenta(everybody(parallel, simulation.state))
    energy, most = np.inf, 0
    for _ in range(scenario.steps):
        record = simulation.step()
        most = max(most, record.contacts)
        scale = record.kinetic_energy
        assert abs(record.energy_change - record.energy_balance) <= 1e-12 * scale
        # Overlap is pushed out: 36 bodies of 0.6 kg at 0.2 m/s at most, here far less.
        assert record.kinetic_energy <= energy + 1e-3 * scale
        energy = record.kinetic_energy
    assert most >= 15, "too few contacts to show anything"
    after = total_momenta(everybody(parallel, simulation.state))
    np.testing.assert_allclose(after, before, atol=1e-13 * scenario.steps)
    simulation.destroy()


@ranks_1_2_3
@pytest.mark.parametrize("operator", ["matrix_free", "assembled"])
def test_rods_fall_into_a_box_and_come_to_rest(parallel, operator: str) -> None:
    """Twenty rods: energy identity, no overlap that runs away, the weight on the floor at rest."""
    rods = {
        "shape": "spherocylinder",
        "aspect_ratio": 3.0,
        "material": "m",
        "count": 20,
        "radius": 0.02,
        "axis": "random",
        "velocity": [0.0, 0.0, -1.0],
        "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [0.4, 0.4, 0.8], "jitter": 0.5}},
    }
    walls = [{**BOX, "open": ["z_max"]}]
    contact = {"tolerance": 1e-5, "complementarity": 1e-5, "operator": operator}
    scenario = scene(step=4e-3, end=2.4, mu=0.5, bodies=[rods], walls=walls, contact=contact)
    simulation = Simulation(parallel, scenario, placed(parallel, scenario))
    largest = 0.0
    for _ in range(scenario.steps):
        record = simulation.step()
        assert record.converged
        largest = max(largest, record.kinetic_energy)
        assert abs(record.energy_change - record.energy_balance) <= 1e-12 * largest
        # A turn by w h = 0.3 in the step after an impact adds an overlap of l (w h)^2 / 2.
        assert record.overlap <= 0.1
    bodies = everybody(parallel, simulation.state)
    assert np.all((bodies.position > 0.0) & (bodies.position[:, 2:] < 0.4))
    assert record.kinetic_speed <= 5e-3
    memory = simulation.state.memory
    floor = memory.impulse[memory.other == -5]  # x_min, x_max, y_min, y_max, z_min
    pressed = -parallel.sum(float(floor[:, 2].sum()))
    assert pressed == pytest.approx(bodies.mass.sum() * G * 4e-3, rel=0.05)
    simulation.destroy()


@pytest.mark.mpi(ranks=[2, 3, 8])
def test_a_pile_moves_alike_on_any_number_of_ranks(parallel) -> None:
    """Against one rank; tolerance: 1e-16 from sums in another order, grown by collisions."""
    falling = [{**group, "velocity": [0.0, 0.0, -2.0]} for group in MIX]
    scenario = scene(
        step=2e-3, end=0.06, mu=0.3, bodies=falling, walls=[BOX],
        contact={"tolerance": 1e-9, "complementarity": 1e-9},
    )  # fmt: skip

    def run(ranks: Parallel) -> tuple[list[int], Bodies]:
        simulation = Simulation(ranks, scenario, placed(ranks, scenario))
        contacts = [simulation.step().contacts for _ in range(scenario.steps)]
        return contacts, everybody(ranks, simulation.state)

    counts, bodies = run(parallel)
    expected, one = parallel.broadcast(run(Parallel.alone()) if parallel.rank == 0 else None)
    assert counts == expected and max(counts) > 10
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        np.testing.assert_allclose(getattr(bodies, name), getattr(one, name), atol=1e-6)


# ---- detection -----------------------------------------------------------------------------

DETECTION = DetectionOptions(0.2, 0.01, np.array([[0.3, 0.5], [0.5, 0.0]]), general=True)
STEP = 1e-3


def heap(count: int) -> Bodies:
    """Rods, spheroids and spheres, size ratio 4, moving and spinning."""
    rng = np.random.default_rng(31)
    shape, radius = np.arange(count) % 3, 0.1 * 4.0 ** -rng.random(count)
    q = rng.normal(size=(count, 4))
    arrays = {
        "gid": 2**40 + rng.permutation(count),
        "material": rng.integers(0, 2, count),
        "shape": shape,
        "radius": radius,
        "half_length": np.where(shape == SPHERE, 0.0, rng.uniform(0.3, 3.0, count) * radius),
        "position": rng.random((count, 3)),
        "orientation": q / np.linalg.norm(q, axis=1, keepdims=True),
        "velocity": rng.normal(size=(count, 3)),
        "angular_velocity": 10.0 * rng.normal(size=(count, 3)),
    }
    return Bodies.from_arrays(arrays, np.array([1000.0, 2500.0]))


def contact_rows(parallel: Parallel, bodies: Bodies) -> np.ndarray:
    """Collective. All contacts, (a, other, normal, gap, arms, friction), sorted, on every rank."""
    partition, owned = distribute(parallel, bodies)
    reference = Reference.of(parallel, owned, owned.velocity, DETECTION, STEP)
    n = find_neighbours(parallel, partition, owned, reference, DETECTION)
    motion = (owned.position, integrator.symmetry_axes(owned), owned.velocity)
    rows = [n.extend(x) for x in (*motion, owned.angular_velocity)]
    c = find_general_contacts(n, *rows, room(0.0, 1.0), DETECTION, STEP)
    mine = np.column_stack((n.gid[c.a], c.other, c.normal, c.gap, c.arm, c.friction))
    every = gathered(parallel, mine)
    return every[np.lexsort(every[:, ::-1].T)]


def brute_force(bodies: Bodies) -> np.ndarray:
    """As `contact_rows`, every pair and every wall tried with the rule of contact."""
    b, walls = bodies, room(0.0, 1.0)
    d, out, rows = integrator.symmetry_axes(b), np.empty((2, 7)), []
    size, reach = b.smallest_size, b.bounding_radius
    rolling = np.linalg.norm(b.angular_velocity, axis=1) * reach

    def form(i: int) -> tuple:
        return int(b.shape[i]), b.position[i], d[i], b.radius[i], b.half_length[i]

    def limit(speed: float, mu: float, size: float, rolling: float) -> float:
        return max(DETECTION.margin * size, STEP * (np.linalg.norm(speed) * (1 + mu) + rolling))

    for i in range(len(b)):
        for k in range(len(walls.kind)):
            mu = DETECTION.friction[b.material[i], walls.material[k]]
            bound = limit(b.velocity[i] - walls.velocity[k], mu, size[i], rolling[i])
            found = wall_contacts(int(walls.kind[k]), walls.geometry[k], *form(i), bound, out)
            rows += [(b.gid[i], -k - 1, *out[t], 0.0, 0.0, 0.0, mu) for t in range(found)]
        for j in np.flatnonzero(b.gid > b.gid[i]):
            mu = DETECTION.friction[b.material[i], b.material[j]]
            near = (min(size[i], size[j]), rolling[i] + rolling[j])
            bound = limit(b.velocity[i] - b.velocity[j], mu, *near)
            found, _ = pair_contacts(*form(i), *form(j), bound, out)
            arm = out[:, 4:] - (b.position[j] - b.position[i])
            rows += [(b.gid[i], b.gid[j], *out[t], *arm[t], mu) for t in range(found)]
    every = np.array(rows)
    return every[np.lexsort(every[:, ::-1].T)]


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
def test_contacts_of_all_shapes_equal_brute_force_on_any_number_of_ranks(parallel) -> None:
    """To the bit between numbers of ranks; to rounding against speeds summed in another order."""
    bodies = heap(80)
    found = contact_rows(parallel, bodies)
    assert found.tobytes() == contact_rows(Parallel.alone(), bodies).tobytes()
    expected = brute_force(bodies)
    assert len(found) > 60 and np.any(np.diff(found[:, :2], axis=0).any(axis=1) == 0)
    assert np.array_equal(found[:, :2], expected[:, :2])
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-14)


# ---- checkpoints ---------------------------------------------------------------------------

RODS = """
name: rods
domain: {min: [-1, -1, -1], max: [1, 1, 2]}
materials: {glass: {density: 2500}}
friction: {default: 0.4}
bodies:
  - {shape: spherocylinder, aspect_ratio: 2.5, axis: random, material: glass, count: 12,
     radius: 0.03, velocity: [0.3, 0, -1],
     placement: {jittered_grid: {min: [0, 0, 0.0], max: [0.5, 0.4, 0.4], jitter: 0.5}}}
  - {shape: spheroid, aspect_ratio: 0.5, axis: random, material: glass, count: 8, radius: 0.05,
     placement: {jittered_grid: {min: [0, 0, 0.4], max: [0.5, 0.4, 0.6], jitter: 0.5}}}
walls:
  - {shape: box, name: box, material: glass, min: [0, 0, 0], max: [0.5, 0.4, 0.9]}
time: {step: 2e-3, end: 0.16}
contact: {tolerance: 1e-4, complementarity: 1e-3, max_iterations: 200, stop_factor: 1e9}
output: {interval: 1.6e-2, fields: [position, velocity, angular_velocity, orientation, radius]}
checkpoint: {interval: 2e-2}
"""


@pytest.mark.mpi(ranks=[1, 3])
def test_an_interrupted_run_of_rods_ends_as_the_one_that_went_through(parallel, shared_path):
    """To the bit, shapes, inertias and orientations included."""
    through, broken = shared_path / "through", shared_path / "broken"
    simulate(parallel, RODS, through)
    simulate(parallel, RODS, broken, steps=33)
    simulate(parallel, RODS, broken, resume=True)
    found = differences(through, broken) if parallel.rank == 0 else []
    assert parallel.broadcast(found) == []


def test_a_state_of_an_older_layout_is_refused_with_what_to_do(tmp_path, monkeypatch):
    alone = Parallel.alone()
    monkeypatch.setattr(state, "_LAYOUT", 1)
    simulate(alone, RODS, tmp_path, steps=3)
    monkeypatch.undo()
    with pytest.raises(DataError, match=r"layout 1, .*reads layout 2.*--force"):
        state.restore(alone, checkpoints(tmp_path)[-1])
