"""Contact sets against brute force, to the bit, on friendly and degenerate clouds."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import pytest

from dem_mpi import _kernels_detection as kernels
from dem_mpi import _kernels_solver as frames
from dem_mpi.bodies import Bodies, ImpulseMemory
from dem_mpi.contacts import recall_impulses, remember_impulses
from dem_mpi.parallel import Parallel
from dem_mpi.partition import Partition
from dem_mpi.walls import Walls

from contact_twins import (
    CONTACT,
    all_contacts,
    brute_force,
    cloud,
    detect,
    detection,
    distribute,
    gathered,
    measure,
    plane_walls,
    room,
    table_of,
)
from launch import ROOT, run_ranks

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])

STEP = 1e-3


def uniform(count: int = 400) -> Bodies:
    return cloud(np.random.default_rng(1).random((count, 3)), 0.06)


def size_ratio_100() -> Bodies:
    rng = np.random.default_rng(2)
    return cloud(rng.random((300, 3)), 0.2 * 10.0 ** rng.uniform(-2, 0, 300))


def clustered() -> Bodies:
    rng = np.random.default_rng(3)
    return cloud(rng.normal(size=(300, 3)) * 10.0 ** -rng.integers(0, 6, (300, 1)), 2e-3)


def lattice(axes: int) -> Bodies:
    """Touching bodies on a line or in a plane, on the boundaries of cells."""
    side = {1: 129, 2: 15}[axes]
    steps = [np.arange(side) / (side - 1) if a < axes else np.zeros(1) for a in range(3)]
    position = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return cloud(position, 0.5 / (side - 1))


def fast() -> Bodies:
    """Margins of up to several radii, from speed and from spin, about a common fast drift."""
    rng = np.random.default_rng(4)
    velocity = 1e4 + rng.normal(size=(200, 3)) * 30.0
    return cloud(rng.random((200, 3)), 0.01, velocity, rng.normal(size=(200, 3)) * 2000.0)


CLOUDS: dict[str, Callable[[], Bodies]] = {
    "uniform": uniform,
    "size ratio 100": size_ratio_100,
    "clustered": clustered,
    "collinear": lambda: lattice(1),
    "planar": lambda: lattice(2),
    "64 at one point": lambda: cloud(np.full((64, 3), 0.3), 0.01),
    "far from the origin": lambda: cloud(1e7 + np.random.default_rng(5).random((200, 3)), 0.08),
    "fast": fast,
    "three": lambda: cloud([[0.0, 0, 0], [0.1, 0, 0], [0.9, 0, 0]], 0.06),
    "one": lambda: cloud([[0.5, 0.5, 0.5]], 0.06),
    "none": lambda: cloud(np.zeros((0, 3)), 0.06),
}


def twin(parallel: Parallel, bodies: Bodies, walls: Walls) -> np.ndarray:
    """Collective. The table of brute force, computed by one rank."""
    first = parallel.rank == 0
    return parallel.broadcast(brute_force(bodies, detection(), STEP, walls) if first else None)


# ---- identical sets ------------------------------------------------------------------------


@ranks_1_2_3_8
@pytest.mark.parametrize("name", CLOUDS)
def test_contacts_equal_brute_force_to_the_bit(parallel, name):
    bodies, options, walls = CLOUDS[name](), detection(), room(0.0, 1.0)
    found = detect(parallel, bodies, options, STEP, walls)
    expected = twin(parallel, bodies, walls)
    if len(bodies) > 1:
        assert np.any(expected["other"] >= 0), "the cloud shows nothing"
    contacts = all_contacts(parallel, found.contacts, found.neighbours.gid)
    assert contacts.tobytes() == expected.tobytes()


@ranks_1_2_3_8
@pytest.mark.parametrize("name", ["uniform", "size ratio 100", "three", "none"])
def test_each_contact_belongs_to_the_owner_of_the_smaller_gid_in_order(parallel, name):
    found = detect(parallel, CLOUDS[name](), detection(), STEP, room(0.0, 1.0))
    c, owned, gid = found.contacts, found.bodies, found.neighbours.gid
    assert np.array_equal(gid[: len(owned)], owned.gid)
    assert np.all(c.a < len(owned))
    assert np.all((c.other < 0) | (gid[c.a] < c.other))
    assert np.array_equal(np.lexsort((c.other, c.a)), np.arange(c.count))
    assert np.array_equal(c.row, np.searchsorted(c.a, np.arange(len(owned) + 1)))
    # The local row of b is the body `other` names, or the wall.
    pair = c.b >= 0
    assert np.array_equal(gid[c.b[pair]], c.other[pair])
    assert np.array_equal(c.b[~pair], c.other[~pair])
    names = gathered(parallel, np.stack((gid[c.a], c.other), axis=1))
    assert len(np.unique(names, axis=0)) == len(names)


@ranks_1_2_3_8
def test_coincident_centres_touch_along_z_and_are_counted(parallel):
    bodies = CLOUDS["64 at one point"]()
    found = detect(parallel, bodies, detection())
    table = all_contacts(parallel, found.contacts, found.neighbours.gid)
    assert len(table) == 64 * 63 // 2 == parallel.sum(found.contacts.coincident)
    assert np.all(table["normal"] == [0.0, 0.0, 1.0])
    assert np.all(table["gap"] == -0.02)
    assert np.all(table["arm"] == 0.0)


@ranks_1_2_3_8
@pytest.mark.parametrize("holder", ["first", "last"])
def test_ranks_without_bodies_change_nothing(parallel, holder):
    bodies, options, walls = uniform(150), detection(), room(0.0, 1.0)
    key = np.iinfo(np.int64).max if holder == "first" else 0
    between = np.full(parallel.size - 1, key)
    partition = Partition(np.zeros(3), 1.0, between, np.zeros_like(between))
    found = detect(parallel, bodies, options, STEP, walls, partition)
    assert len(found.bodies) in (0, 150)
    contacts = all_contacts(parallel, found.contacts, found.neighbours.gid)
    assert contacts.tobytes() == twin(parallel, bodies, walls).tobytes()


@ranks_1_2_3_8
def test_bodies_outside_the_cube_of_the_keys_are_not_missed(parallel):
    partition, _ = distribute(parallel, uniform(200))
    rng = np.random.default_rng(6)
    bodies = cloud(rng.uniform(-2.0, 3.0, (600, 3)), 0.15)
    options, walls = detection(), room(-2.0, 3.0)
    found = detect(parallel, bodies, options, STEP, walls, partition)
    contacts = all_contacts(parallel, found.contacts, found.neighbours.gid)
    assert contacts.tobytes() == twin(parallel, bodies, walls).tobytes()


# ---- walls ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("position", "walls"),
    [
        ([0.5, 0.5, 0.5], []),
        ([0.1, 0.5, 0.5], [-1]),
        ([0.9, 0.5, 0.5], [-2]),
        ([0.1, 0.1, 0.5], [-3, -1]),
        ([0.9, 0.5, 0.1], [-5, -2]),
        ([0.1, 0.9, 0.9], [-6, -4, -1]),
    ],
    ids=["middle", "face", "opposite face", "edge", "other edge", "corner"],
)
def test_sphere_in_a_box_touches_one_plane_a_face(parallel, position, walls):
    found = detect(parallel, cloud([position], 0.1), detection(), STEP, room(0.0, 1.0))
    c = found.contacts
    assert c.other.tolist() == walls
    faces = room(0.0, 1.0)
    assert np.array_equal(c.normal, -faces.geometry[-c.other - 1, 3:6])
    assert np.allclose(c.gap, 0.0, atol=1e-16)  # positions and radius are rounded
    assert np.array_equal(c.arm[:, 0], 0.1 + 0.5 * c.gap)
    assert not c.arm[:, 1].any()


def test_tilted_plane_gap_is_the_distance_along_its_normal(parallel):
    normal = np.array([3.0, 0.0, 4.0]) / 5.0
    point = np.array([1.0, 2.0, 3.0])
    walls = plane_walls(point[None], normal[None], np.zeros((1, 3)), np.zeros(1, dtype=np.int32))
    centre = point + 0.101 * normal + 7.0 * np.array([-4.0, 0.0, 3.0]) / 5.0
    c = detect(parallel, cloud([centre], 0.1), detection(), STEP, walls).contacts
    assert c.count == 1
    # Coordinates of order 10: their rounding is 2e-15.
    assert c.gap[0] == pytest.approx(1e-3, abs=1e-14)
    assert np.array_equal(c.normal[0], -normal)


def test_driven_wall_widens_the_margin_by_its_speed(parallel):
    bodies = cloud([[0.5, 0.5, 0.115]], 0.1)
    walls = room(0.0, 1.0)
    assert detect(parallel, bodies, detection(), STEP, walls).contacts.count == 0
    walls.velocity[4] = (0.0, 0.0, 15.0)
    assert detect(parallel, bodies, detection(), STEP, walls).contacts.count == 1


# ---- list reuse ----------------------------------------------------------------------------


@ranks_1_2_3_8
@pytest.mark.parametrize("margin_share", [0.0, 0.6])
def test_list_under_the_skin_misses_nothing(parallel, margin_share):
    """Bodies move, and their margins grow, by just what the skin allows."""
    options, walls = detection(skin=0.02), room(0.0, 1.0)
    rng = np.random.default_rng(7)
    start = cloud(rng.random((400, 3)), 0.05, rng.normal(size=(400, 3)) * 3.0)
    found = detect(parallel, start, options, STEP, walls)

    direction = rng.normal(size=(400, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    moved = start.take(np.arange(400))
    moved.position += direction * (0.5 * options.skin * (1.0 - margin_share) * (1.0 - 1e-12))
    # |v| (1 + mu) h grows at most by |dv| (1 + mu) h.
    speed = 0.5 * options.skin * margin_share / (STEP * (1.0 + options.largest_friction))
    moved.velocity += direction[::-1] * (speed * (1.0 - 1e-12))

    rows = np.argsort(moved.gid)[found.bodies.gid - start.gid.min()]
    mine = moved.take(rows)
    drift = found.neighbours.reference.drift(mine, mine.velocity, options, STEP)
    assert parallel.max(drift) <= 0.5 * options.skin
    assert parallel.max(drift) > 0.4 * options.skin
    contacts = measure(found.neighbours, mine, options, STEP, walls)
    table = all_contacts(parallel, contacts, found.neighbours.gid)
    assert table.tobytes() == twin(parallel, moved, walls).tobytes()
    # It is a list of near pairs, not of all pairs.
    assert parallel.sum(found.neighbours.pairs) < 400 * 399 / 2 / 4


def test_drift_counts_displacement_and_growth_of_the_margin(parallel):
    options = detection()
    bodies = cloud([[0.0, 0, 0], [1.0, 0, 0]], 0.1, [1.0, 0.0, 0.0])
    found = detect(parallel, bodies, options)
    bodies = found.bodies
    assert found.neighbours.reference.drift(bodies, bodies.velocity, options, STEP) == 0.0
    bodies.position[1] += (0.003, 0.0, 0.004)
    drift = found.neighbours.reference.drift(bodies, bodies.velocity, options, STEP)
    assert drift == pytest.approx(0.005, rel=1e-12)
    faster = bodies.velocity + [[0.0, 2.0, 0.0], [0.0, 0.0, 0.0]]
    bodies.angular_velocity[1] = (0.0, 30.0, 0.0)
    drift = found.neighbours.reference.drift(bodies, faster, options, STEP)
    assert drift == pytest.approx(max(STEP * 2.0 * 1.5, 0.005 + STEP * 30.0 * 0.1), rel=1e-12)


# ---- warm start by contact -----------------------------------------------------------------


def test_impulses_come_back_in_the_new_frames_for_contacts_that_stand(parallel):
    options, walls = detection(), room(0.0, 1.0)
    rng = np.random.default_rng(8)
    before = detect(parallel, uniform(), options, STEP, walls)
    impulse = rng.normal(size=(before.contacts.count, 3))
    memory = remember_impulses(before.contacts, impulse, 1)
    t1, t2 = before.contacts.tangents
    world = impulse[:, :1] * before.contacts.normal + impulse[:, 1:2] * t1 + impulse[:, 2:] * t2
    assert np.allclose(memory.impulse, world, rtol=0.0, atol=1e-15 * 10)

    moved = before.bodies
    moved.position += rng.normal(size=moved.position.shape) * 1e-3
    after = measure(before.neighbours, moved, options, STEP, walls)
    recalled = recall_impulses(after, memory, 3, 0.5, 1)
    known = {
        (a, other): p
        for a, other, p in zip(before.contacts.a, before.contacts.other, world, strict=True)
    }
    t1, t2 = after.tangents
    back = recalled[:, :1] * after.normal + recalled[:, 1:2] * t1 + recalled[:, 2:] * t2
    expected = [
        0.5 * known.get((a, o), np.zeros(3)) for a, o in zip(after.a, after.other, strict=True)
    ]
    new = sum((a, o) not in known for a, o in zip(after.a, after.other, strict=True))
    assert 0 < new < after.count
    assert np.allclose(back, expected, rtol=0.0, atol=1e-14)


def test_nothing_is_recalled_from_an_empty_memory(parallel):
    found = detect(parallel, uniform(100), detection())
    memory = ImpulseMemory.empty(len(found.bodies))
    assert not recall_impulses(found.contacts, memory, 3, 1.0, 1).any()


# ---- frames --------------------------------------------------------------------------------


def test_tangents_are_orthonormal_right_handed_for_every_normal(parallel):
    rng = np.random.default_rng(9)
    axes = np.concatenate((np.eye(3), -np.eye(3)))
    near_pole = np.array([[1e-9, -1e-9, -1.0], [1e-9, 1e-200, 1.0], [-1e-5, 1e-5, -1.0]])
    n = np.concatenate((axes, near_pole, rng.normal(size=(500, 3))))
    n /= np.linalg.norm(n, axis=1)[:, None]
    t1, t2 = np.empty_like(n), np.empty_like(n)
    frames.tangents.serial(n, t1, t2)
    frame = np.stack((n, t1, t2), axis=1)
    assert np.allclose(frame @ frame.transpose(0, 2, 1), np.eye(3), rtol=0.0, atol=1e-15 * 4)
    assert np.allclose(np.cross(n, t1), t2, rtol=0.0, atol=1e-15 * 4)


# ---- cost, threads -------------------------------------------------------------------------


def distance_checks(monkeypatch: pytest.MonkeyPatch, bodies: Bodies) -> int:
    """Run the search as Python and count the pairs whose distance it measures."""
    checks = 0
    near = kernels._near

    def counted(*arguments):
        nonlocal checks
        checks += 1
        return near(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(kernels, "_near", counted)
        search = type(kernels.search_pairs)(*[kernels.search_pairs.serial.py_func] * 2)
        patch.setattr(kernels, "search_pairs", search)
        detect(Parallel.alone(), bodies, detection(skin=0.002))
    return checks


@pytest.mark.parametrize("ratio", [1.0, 30.0])
def test_distance_checks_grow_linearly_with_the_bodies(monkeypatch, ratio):
    """At one density 4 times the bodies need 4 times the checks, and 16 by all pairs.

    The smaller cloud has relatively more surface, where neighbours are missing: up to 6.
    """
    checks = []
    for count in (500, 2000):
        rng = np.random.default_rng(10)
        radius = 0.5 * ratio ** -rng.random(count)
        edge = (count * np.mean(radius**3) * 8.0) ** (1.0 / 3.0)
        checks.append(distance_checks(monkeypatch, cloud(edge * rng.random((count, 3)), radius)))
    assert checks[0] > 500  # they were counted
    assert checks[1] < 6.0 * checks[0]


def probe_threads() -> None:
    """In a process with two threads: print whether two give the bits of one."""
    import numba

    numba.set_num_threads(2)
    alone, walls = Parallel.alone(), room(0.0, 1.0)
    for name in ("uniform", "size ratio 100", "64 at one point", "fast"):
        tables = []
        for threads in (1, 2):
            found = detect(alone, CLOUDS[name](), detection(threads=threads), STEP, walls)
            tables.append(table_of(found.contacts, found.neighbours.gid).tobytes())
        print(name, tables[0] == tables[1], len(tables[0]) // CONTACT.itemsize, flush=True)


def test_two_threads_find_the_same_bits_as_one():
    folders = [ROOT / "tests" / "support", ROOT / "tests" / "dem_mpi"]
    script = f"import sys; sys.path[:0] = {list(map(str, folders))}\n"
    script += "import test_contacts; test_contacts.probe_threads()"
    done = run_ranks(1, ["-c", script], env={**os.environ, "NUMBA_NUM_THREADS": "2"})
    lines = done.stdout.splitlines()
    assert len(lines) == 4, done.stderr
    for line in lines:
        assert " True " in line, line
        assert int(line.split()[-1]) > 0, line
