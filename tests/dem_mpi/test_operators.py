"""D, M^-1 and N: matrix-free, assembled in PETSc and dense, contact by contact."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from petsc4py import PETSc

from dem_mpi.bodies import Bodies
from dem_mpi.contacts import ContactSet, Reference, find_neighbours
from dem_mpi.errors import DemError
from dem_mpi.integrator import symmetry_axes
from dem_mpi.narrow_phase import find_general_contacts
from dem_mpi.operators import Assembled, MatrixFree, world_inverse_inertia
from dem_mpi.parallel import Parallel
from dem_mpi.shapes import SPHERE

from contact_twins import (
    all_contacts,
    cloud,
    dense_delassus,
    dense_operator,
    detect,
    detection,
    distribute,
    gathered,
    measure,
    no_walls,
    room,
    tangents,
)

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])
both_frictions = pytest.mark.parametrize("frictional", [True, False], ids=["mu", "smooth"])

STEP = 1e-3
OPTIONS = detection(margin=0.3)  # so that many gaps are open
ROUNDING = 1e-13  # relative to the largest entry: sums of some 20 products of 1e-16 each


def pile(count: int = 60) -> Bodies:
    """Overlapping spheres of mass ratio up to 300 in a room that cuts some of them."""
    rng = np.random.default_rng(11)
    return cloud(rng.random((count, 3)), 0.25 * 5.0 ** -rng.random(count))


CLOUDS: dict[str, Callable[[], Bodies]] = {
    "pile": pile,
    "two": lambda: cloud([[0.3, 0.5, 0.5], [0.5, 0.6, 0.5]], 0.12),
    "no contacts": lambda: cloud([[0.3, 0.5, 0.5], [0.6, 0.5, 0.5]], 0.05),
    "none": lambda: cloud(np.zeros((0, 3)), 0.1),
}


class Case:
    """A cloud's contacts on all ranks, both operators, and one impulse known to every rank."""

    def __init__(self, parallel: Parallel, bodies: Bodies, frictional: bool, walls: bool = True):
        self.parallel, self.frictional, self.all_bodies = parallel, frictional, bodies
        self.walls = room(0.0, 1.0) if walls else no_walls()
        self.found = detect(parallel, bodies, OPTIONS, STEP, self.walls)
        self.contacts = self.found.contacts
        n = self.found.neighbours
        self.masses = (n.inverse_mass, n.inverse_inertia, n.halo)
        self.columns = 3 if frictional else 1
        self.matrix_free = MatrixFree(self.contacts, *self.masses, frictional)
        self.assembled = Assembled(self.contacts, *self.masses, frictional, parallel)
        self.table = all_contacts(parallel, self.contacts, n.gid)
        order = {(c["a"], c["other"]): i for i, c in enumerate(self.table)}
        names = zip(n.gid[self.contacts.a], self.contacts.other, strict=True)
        self.rows = np.array([order[name] for name in names], dtype=int)
        rng = np.random.default_rng(12)
        self.impulse = rng.normal(size=(len(self.table), self.columns))

    @property
    def mine(self) -> np.ndarray:
        """This rank's rows of the impulse."""
        return np.ascontiguousarray(self.impulse[self.rows])

    def apply(self, operator: MatrixFree | Assembled) -> np.ndarray:
        out = np.full((self.contacts.count, self.columns), np.nan)
        operator.apply(self.mine, out)
        return out


def close(a: np.ndarray, b: np.ndarray, scale: float) -> bool:
    """Whether max |a - b| <= 1e-13 scale."""
    return a.shape == b.shape and np.max(np.abs(a - b), initial=0.0) <= ROUNDING * scale


# ---- one product, three ways ---------------------------------------------------------------


@ranks_1_2_3_8
@both_frictions
@pytest.mark.parametrize("name", CLOUDS)
def test_matrix_free_equals_assembled_equals_dense(parallel, name, frictional):
    case = Case(parallel, CLOUDS[name](), frictional)
    N = dense_delassus(case.table, case.all_bodies, frictional)
    expected = (N @ case.impulse.ravel()).reshape(case.impulse.shape)
    scale = np.max(np.abs(expected), initial=0.0)
    assert close(case.apply(case.matrix_free), case.apply(case.assembled), scale)
    assert close(case.apply(case.matrix_free), expected[case.rows], scale)
    diagonal = np.diag(N).reshape(expected.shape)[case.rows]
    assert close(case.matrix_free.diagonal(), diagonal, np.max(np.abs(N), initial=0.0))
    assert close(case.assembled.diagonal(), diagonal, np.max(np.abs(N), initial=0.0))
    case.assembled.destroy()


@ranks_1_2_3_8
@both_frictions
def test_body_and_contact_velocities_equal_dense_factors(parallel, frictional):
    case = Case(parallel, pile(), frictional)
    D, inverse = dense_operator(case.table, case.all_bodies, frictional)
    dof = 6 if frictional else 3
    expected = (inverse * (D @ case.impulse.ravel())).reshape(-1, dof)
    gid = case.found.neighbours.gid
    rows = np.searchsorted(np.sort(case.all_bodies.gid), gid)
    motion = np.random.default_rng(13).normal(size=expected.shape)
    relative = (D.T @ motion.ravel()).reshape(case.impulse.shape)[case.rows]
    for operator in (case.matrix_free, case.assembled):
        # Ghosts are current too.
        u = operator.body_velocity(case.mine)
        assert close(u, expected[rows], np.max(np.abs(expected)))
        out = np.full_like(relative, np.nan)
        operator.contact_velocity(motion[rows], out)
        assert close(out, relative, 1.0)
    case.assembled.destroy()


@pytest.mark.parametrize("frictional", [True, False], ids=["mu", "smooth"])
def test_delassus_is_symmetric_positive_semidefinite(parallel, frictional):
    case = Case(parallel, pile(60), frictional)
    m, columns = case.impulse.shape
    assert m * columns > 60 * (6 if frictional else 3), "more rows than freedoms: N is singular"
    N = np.empty((m * columns, m * columns))
    for k, unit in enumerate(np.eye(m * columns)):
        out = np.empty((m, columns))
        case.matrix_free.apply(unit.reshape(m, columns), out)
        N[:, k] = out.ravel()
    scale = np.max(np.abs(N))
    assert np.max(np.abs(N - N.T)) <= ROUNDING * scale
    # Eigenvalues of rounded entries are off by up to their number times 1e-16.
    assert np.linalg.eigvalsh(0.5 * (N + N.T))[0] >= -1e-13 * len(N) * scale
    case.assembled.destroy()


@ranks_1_2_3_8
@pytest.mark.parametrize("name", ["matrix_free", "assembled"])
def test_impulses_between_bodies_keep_linear_and_angular_momentum(parallel, name):
    """Overlapping and separated pairs: both arms end at one point, or L would change."""
    case = Case(parallel, pile(), frictional=True, walls=False)
    assert case.table["gap"].max() > 0.0 > case.table["gap"].min()
    owned = case.found.bodies
    u = getattr(case, name).body_velocity(case.mine)[: len(owned)]
    force, torque = owned.mass[:, None] * u[:, :3], owned.inertia[:, None] * u[:, 3:]
    sums = np.concatenate((force.sum(0), (torque + np.cross(owned.position, force)).sum(0)))
    total = parallel.sum(sums)
    # Round-off of sums of |gamma| = O(1), in kg m/s and, at arms of O(1) m, kg m^2/s.
    assert np.all(np.abs(total) <= 1e-12 * np.abs(case.impulse).max())
    case.assembled.destroy()


# ---- patterns ------------------------------------------------------------------------------


@ranks_1_2_3_8
@both_frictions
def test_refill_keeps_the_pattern_and_takes_the_new_values(parallel, frictional):
    case = Case(parallel, pile(), frictional)
    matrix, handle = case.assembled.d_transposed, case.assembled.d_transposed.handle
    used = matrix.getInfo()["nz_used"]
    owned = case.found.bodies
    owned.position += 1e-6 * np.sin(owned.gid)[:, None] * [1.0, 2.0, -1.0]
    moved = measure(case.found.neighbours, owned, OPTIONS, STEP, case.walls)
    assert moved.same_graph(case.contacts)
    before = case.apply(case.assembled)
    assert case.assembled.refill(moved)
    assert case.assembled.d_transposed is matrix
    assert case.assembled.d_transposed.handle == handle
    assert matrix.getInfo()["nz_used"] == used
    after = case.apply(case.assembled)
    fresh = case.apply(MatrixFree(moved, *case.masses, frictional))
    scale = parallel.max(float(np.max(np.abs(fresh), initial=0.0)))
    assert close(after, fresh, scale)
    change = parallel.max(float(np.max(np.abs(after - before), initial=0.0)))
    assert change > 1e3 * ROUNDING * scale
    case.assembled.destroy()


@ranks_1_2_3_8
def test_refill_reports_a_graph_that_changed_on_one_rank_to_all(parallel):
    case = Case(parallel, pile(), frictional=True)
    # The last rank with contacts loses its last one.
    last = parallel.max(parallel.rank if case.contacts.count else 0)
    contacts = without_last(case.contacts) if parallel.rank == last else case.contacts
    before = case.apply(case.assembled)
    assert not case.assembled.refill(contacts)
    assert np.array_equal(case.apply(case.assembled), before)
    case.assembled.destroy()


def without_last(c: ContactSet) -> ContactSet:
    keep = c.count - 1
    return ContactSet(
        c.a[:keep], c.b[:keep], c.other[:keep], np.minimum(c.row, keep), c.normal[:keep],
        c.gap[:keep], c.arm[:keep], c.friction[:keep], c.coincident,
    )  # fmt: skip


@ranks_1_2_3_8
def test_scene_without_friction_has_a_fifth_of_the_entries(parallel):
    """3 columns a body and 1 row a contact against 6 and 3; 3 entries a body in the normal row.

    A pair has 2 x 3 entries instead of 2 x (3 + 6 + 6), a wall contact half of each.
    """
    rough, smooth = (Case(parallel, pile(), frictional) for frictional in (True, False))
    n, m = len(rough.all_bodies), len(rough.table)
    sides = 2 * m - np.count_nonzero(rough.table["other"] < 0)
    assert rough.assembled.d_transposed.getSize() == (3 * m, 6 * n)
    assert smooth.assembled.d_transposed.getSize() == (m, 3 * n)
    assert rough.assembled.inverse_mass.getSize() == (6 * n, 6 * n)
    assert smooth.assembled.inverse_mass.getSize() == (3 * n, 3 * n)
    total = PETSc.Mat.InfoType.GLOBAL_SUM
    entries = [case.assembled.d_transposed.getInfo(total)["nz_used"] for case in (rough, smooth)]
    assert entries == [15 * sides, 3 * sides]
    vectors = [case.matrix_free.body_velocity(case.mine).nbytes for case in (rough, smooth)]
    assert vectors[0] == 2 * vectors[1]
    for case in (rough, smooth):
        case.assembled.destroy()


def test_normal_rows_are_the_smooth_matrix(parallel):
    """What friction adds never changes the normal part: torque arms lie along the normal."""
    rough, smooth = (Case(parallel, pile(20), frictional) for frictional in (True, False))
    D, _ = dense_operator(rough.table, rough.all_bodies, True)
    normal = D.reshape(20, 6, -1, 3)[:, :3, :, 0].reshape(60, -1)
    assert close(normal, dense_operator(smooth.table, smooth.all_bodies, False)[0], 1.0)
    dense = smooth.assembled.d_transposed.convert("dense").getDenseArray()
    assert close(np.sort(dense.ravel()), np.sort(normal.ravel()), 1.0)
    for case in (rough, smooth):
        case.assembled.destroy()


def test_tangential_row_turns_both_bodies_the_same_way(parallel):
    """A tangential impulse at a contact spins both spheres in one sense."""
    case = Case(parallel, CLOUDS["two"](), frictional=True, walls=False)
    n = case.contacts.normal[0]
    t1, _ = tangents(n)
    u = case.matrix_free.body_velocity(np.array([[0.0, 1.0, 0.0]]))
    a, b = case.contacts.a[0], case.contacts.b[0]
    for k, length in ((a, case.contacts.arm[0, 0]), (b, case.contacts.arm[0, 1])):
        expected = -length * np.cross(n, t1) * case.masses[1][k]
        assert np.allclose(u[k, 3:], expected, rtol=1e-14, atol=0.0)
    assert np.dot(u[a, :3], t1) < 0.0 < np.dot(u[b, :3], t1)
    case.assembled.destroy()


# ---- bodies that are not spheres -----------------------------------------------------------


def heap(count: int = 40) -> Bodies:
    """Rods, spheroids and spheres in all directions, overlapping and apart, of all sizes."""
    rng = np.random.default_rng(21)
    radius = 0.12 * 4.0 ** -rng.random(count)
    shape = np.arange(count) % 3
    stretch = rng.uniform(0.3, 3.0, count)
    directions = rng.normal(size=(count, 4))
    arrays = {
        "gid": 2**40 + rng.permutation(count),
        "material": rng.integers(0, 2, count),
        "shape": shape,
        "radius": radius,
        "half_length": np.where(shape == SPHERE, 0.0, stretch * radius),
        "position": rng.random((count, 3)),
        "orientation": directions / np.linalg.norm(directions, axis=1, keepdims=True),
        "velocity": np.zeros((count, 3)),
        "angular_velocity": np.zeros((count, 3)),
    }
    return Bodies.from_arrays(arrays, np.array([1000.0, 2500.0]))


class GeneralCase:
    """As `Case`, for a heap: every contact's rows of D stand in `table`, known to all ranks.

    A row of the table is (a, other, occurrence, normal, arm_a, arm_b): two bodies may touch twice.
    """

    def __init__(self, parallel: Parallel, bodies: Bodies, frictional: bool, walls: bool = True):
        self.frictional = frictional
        self.all_bodies = bodies.take(np.argsort(bodies.gid))
        self.columns = 3 if frictional else 1
        self.walls = room(0.0, 1.0) if walls else no_walls()
        options = replace(OPTIONS, general=True)
        partition, self.owned = distribute(parallel, bodies)
        reference = Reference.of(parallel, self.owned, self.owned.velocity, options, STEP)
        self.neighbours = n = find_neighbours(parallel, partition, self.owned, reference, options)
        rows = [n.extend(x) for x in (self.owned.position, symmetry_axes(self.owned))]
        still = np.zeros_like(rows[0])
        inertia = world_inverse_inertia(rows[1], n.inverse_inertia)
        self.masses = (n.inverse_mass, inertia, n.halo)
        self.contacts = c = find_general_contacts(n, *rows, still, still, self.walls, options, STEP)
        self.matrix_free = MatrixFree(c, *self.masses, frictional)
        self.assembled = Assembled(c, *self.masses, frictional, parallel)
        first = np.flatnonzero(np.diff(c.a, prepend=-1) | np.diff(c.other, prepend=-99))
        again = np.arange(c.count) - np.repeat(first, np.diff(np.append(first, c.count)))
        mine = np.column_stack((n.gid[c.a], c.other, again, c.normal, c.arm))
        every = gathered(parallel, mine)
        order = np.lexsort(every[:, 2::-1].T)
        self.table = every[order]
        place = {tuple(row): i for i, row in enumerate(self.table[:, :3])}
        self.rows = np.array([place[tuple(row)] for row in mine[:, :3]], dtype=int)
        self.impulse = np.random.default_rng(22).normal(size=(len(every), self.columns))

    @property
    def mine(self) -> np.ndarray:
        return np.ascontiguousarray(self.impulse[self.rows])

    def apply(self, operator: MatrixFree | Assembled) -> np.ndarray:
        out = np.full((self.contacts.count, self.columns), np.nan)
        operator.apply(self.mine, out)
        return out

    def dense(self) -> tuple[np.ndarray, np.ndarray]:
        """D (6 n, columns m) and M^-1 (6 n, 6 n), from rotation matrices and the table."""
        bodies = self.all_bodies
        D = np.zeros((6 * len(bodies), self.columns * len(self.table)))
        for i, row in enumerate(self.table):
            n = row[3:6]
            for c, t in enumerate((n, *tangents(n))[: self.columns]):
                for gid, sign, arm in ((row[0], -1.0, row[6:9]), (row[1], 1.0, row[9:12])):
                    if gid >= 0:
                        k = 6 * int(np.searchsorted(bodies.gid, int(gid)))
                        column = np.concatenate((t, np.cross(arm, t)))
                        D[k : k + 6, self.columns * i + c] = sign * column
        inverse = np.zeros((6 * len(bodies), 6 * len(bodies)))
        for k in range(len(bodies)):
            turn = Rotation.from_quat(np.roll(bodies.orientation[k], -1)).as_matrix()
            moments = [bodies.inertia[k], bodies.inertia[k], bodies.axial_inertia[k]]
            inverse[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] = np.eye(3) / bodies.mass[k]
            block = turn @ np.diag(1.0 / np.array(moments)) @ turn.T
            inverse[6 * k + 3 : 6 * k + 6, 6 * k + 3 : 6 * k + 6] = block
        return D, inverse


@ranks_1_2_3_8
@both_frictions
def test_general_matrix_free_equals_assembled_equals_dense(parallel, frictional):
    """Normal impulses turn these bodies: six freedoms with friction and without."""
    case = GeneralCase(parallel, heap(), frictional)
    assert np.count_nonzero(case.table[:, 2]) > 0, "no pair touches twice"
    D, inverse = case.dense()
    N = D.T @ inverse @ D
    expected = (N @ case.impulse.ravel()).reshape(case.impulse.shape)
    scale = np.max(np.abs(N)) * np.sqrt(len(N))
    assert close(case.apply(case.matrix_free), case.apply(case.assembled), scale)
    assert close(case.apply(case.matrix_free), expected[case.rows], scale)
    diagonal = np.diag(N).reshape(expected.shape)[case.rows]
    for operator in (case.matrix_free, case.assembled):
        assert close(operator.diagonal(), diagonal, np.max(np.abs(N)))
    u = (inverse @ D @ case.impulse.ravel()).reshape(-1, 6)
    rows = np.searchsorted(case.all_bodies.gid, case.neighbours.gid)
    motion = np.random.default_rng(13).normal(size=u.shape)
    relative = (D.T @ motion.ravel()).reshape(case.impulse.shape)[case.rows]
    for operator in (case.matrix_free, case.assembled):
        assert close(operator.body_velocity(case.mine), u[rows], np.max(np.abs(u)))
        out = np.full_like(relative, np.nan)
        operator.contact_velocity(motion[rows], out)
        assert close(out, relative, 10.0)
    case.assembled.destroy()


@ranks_1_2_3_8
@pytest.mark.parametrize("name", ["matrix_free", "assembled"])
def test_impulses_between_general_bodies_keep_angular_momentum(parallel, name):
    """Both arms of a contact end in one point, whatever the shapes and the gap."""
    case = GeneralCase(parallel, heap(), frictional=True, walls=False)
    owned = case.owned
    u = getattr(case, name).body_velocity(case.mine)[: len(owned)]
    force, d = owned.mass[:, None] * u[:, :3], symmetry_axes(owned)
    spin = np.sum(d * u[:, 3:], axis=1, keepdims=True) * d
    torque = owned.inertia[:, None] * (u[:, 3:] - spin) + owned.axial_inertia[:, None] * spin
    sums = np.concatenate((force.sum(0), (torque + np.cross(owned.position, force)).sum(0)))
    assert np.all(np.abs(parallel.sum(sums)) <= 1e-12 * np.abs(case.impulse).max())
    case.assembled.destroy()


@pytest.mark.mpi(ranks=[1, 2, 3])
@both_frictions
def test_refill_takes_the_inertias_of_turned_bodies(parallel, frictional):
    case = GeneralCase(parallel, heap(), frictional)
    axis = symmetry_axes(case.owned)
    turned = axis + 0.01 * np.sin(case.owned.gid)[:, None] * [1.0, -2.0, 3.0]
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    n = case.neighbours
    inertia = world_inverse_inertia(n.extend(turned), n.inverse_inertia)
    before = case.apply(case.assembled)
    assert case.assembled.refill(case.contacts, inertia)
    fresh = MatrixFree(case.contacts, n.inverse_mass, inertia, n.halo, frictional)
    expected = case.apply(fresh)
    scale = parallel.max(float(np.max(np.abs(expected), initial=0.0)))
    assert close(case.apply(case.assembled), expected, scale)
    assert close(case.assembled.diagonal(), fresh.diagonal(), scale)
    change = parallel.max(float(np.max(np.abs(before - expected), initial=0.0)))
    assert change > 1e3 * ROUNDING * scale
    case.assembled.destroy()


# ---- lifetime and index width --------------------------------------------------------------


def resident_memory() -> int:
    """Bytes of this process in memory."""
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.mpi(ranks=[1, 2])
def test_a_thousand_operators_made_and_destroyed_leave_no_memory(parallel):
    case = Case(parallel, pile(80), frictional=True)
    case.assembled.destroy()
    memory = []
    for cycle in range(1100):
        operator = Assembled(case.contacts, *case.masses, True, parallel)
        operator.refill(case.contacts)
        operator.destroy()
        if cycle % 100 == 99:
            memory.append(resident_memory())
    entries = operator_bytes(case.contacts)
    # One matrix left over in each cycle would be this much.
    leak = 1000 * parallel.max(entries)
    assert leak > 8 << 20
    assert memory[-1] - memory[0] < leak // 4


def operator_bytes(contacts: ContactSet) -> int:
    """Values and 32-bit columns of D^T, walls taken for half a pair."""
    sides = 2 * contacts.count - int(np.count_nonzero(contacts.b < 0))
    return 15 * sides * 12


def test_destroy_leaves_no_petsc_object(parallel):
    case = Case(parallel, pile(20), frictional=True)
    operator = case.assembled
    objects = [v for v in vars(operator).values() if isinstance(v, PETSc.Object)]
    assert len(objects) == 6
    operator.destroy()
    assert all(item.handle == 0 for item in objects)


class ManyBodiesBelow(Parallel):
    """Pretends that the ranks below own 400 million bodies: 2.4 billion columns."""

    def exclusive_sum(self, count):
        return 400_000_000

    def sum(self, value):
        return 2_400_000_000 + value


def test_columns_beyond_the_index_type_are_refused_not_wrapped(parallel):
    case = Case(parallel, CLOUDS["two"](), frictional=True)
    case.assembled.destroy()
    if np.dtype(PETSc.IntType).itemsize == 8:
        pytest.skip("this PETSc has 64-bit indices")
    with pytest.raises(DemError, match="64-bit"):
        Assembled(case.contacts, *case.masses, True, ManyBodiesBelow())


@pytest.mark.mpi(ranks=[3])
def test_ranks_own_consecutive_rows_and_columns(parallel):
    case = Case(parallel, pile(), frictional=True)
    rows = gathered(parallel, np.array([case.assembled.d_transposed.getOwnershipRange()]))
    counts = gathered(parallel, np.array([case.contacts.count]))
    assert np.array_equal(rows[:, 1] - rows[:, 0], 3 * counts)
    columns = gathered(parallel, np.array([case.assembled.d_transposed.getOwnershipRangeColumn()]))
    owned = gathered(parallel, np.array([len(case.found.bodies)]))
    assert np.array_equal(columns[:, 1] - columns[:, 0], 6 * owned)
    case.assembled.destroy()
