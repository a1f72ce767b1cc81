"""D, M^-1 and N: matrix-free, assembled in PETSc and dense, contact by contact."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import pytest

from petsc4py import PETSc

from dem_mpi.bodies import Bodies
from dem_mpi.contacts import ContactSet
from dem_mpi.errors import DemError
from dem_mpi.operators import Assembled, MatrixFree
from dem_mpi.parallel import Parallel

from contact_twins import (
    all_contacts,
    cloud,
    dense_delassus,
    dense_operator,
    detect,
    detection,
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
