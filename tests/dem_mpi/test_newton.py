"""The Newton system (N + R) x = s in velocities and in impulses, against dense matrices."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dem_mpi.bodies import Bodies
from dem_mpi.cone import Delassus
from dem_mpi.contacts import ContactSet, Reference, find_neighbours
from dem_mpi.fclib import read_problem
from dem_mpi.integrator import symmetry_axes
from dem_mpi.narrow_phase import find_general_contacts
from dem_mpi.newton import NewtonFailureError, NewtonOptions, NewtonSystem
from dem_mpi.operators import Assembled, MatrixFree, world_inverse_inertia
from dem_mpi.parallel import Halo, Parallel
from dem_mpi.periodic import PeriodicBox
from dem_mpi.shapes import SPHERE

from contact_twins import (
    all_contacts,
    cloud,
    dense_delassus,
    detect,
    detection,
    distribute,
    measure,
    no_walls,
    room,
)
from launch import ROOT

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])
both_frictions = pytest.mark.parametrize("frictional", [True, False], ids=["mu", "smooth"])
both_forms = pytest.mark.parametrize("form", ["velocity", "contact"])
every_solver = pytest.mark.parametrize(
    "options",
    [
        NewtonOptions(form="velocity"),
        NewtonOptions(form="contact"),
        NewtonOptions(linear="cg", preconditioner="block_jacobi"),
        NewtonOptions(linear="cg", preconditioner="icc"),
        NewtonOptions(linear="cg", preconditioner="low_rank"),
    ],
    ids=["velocity", "contact", "cg", "cg icc", "cg low rank"],
)

STEP = 1e-3
OPTIONS = detection(margin=0.3)
# Relative to the largest entry of the solution: matrices of condition 1e4 at most, 1e-16 each.
ROUNDING = 1e-11
SCENES = {
    "pile": lambda: cloud(np.random.default_rng(11).random((40, 3)), 0.15),
    "size ratio 10": lambda: cloud(
        np.random.default_rng(12).random((40, 3)),
        0.2 * 10.0 ** -np.random.default_rng(13).random(40),
    ),
    "two": lambda: cloud([[0.3, 0.5, 0.5], [0.5, 0.6, 0.5]], 0.12),
    "no contacts": lambda: cloud([[0.3, 0.5, 0.5], [0.6, 0.5, 0.5]], 0.05),
    "none": lambda: cloud(np.zeros((0, 3)), 0.1),
}


def spd_blocks(
    count: int, columns: int, decades: float, scale: float, seed: int = 1
) -> tuple[NDArray, NDArray]:
    """Q and R = Q^-1, (m, c, c), in random directions, eigenvalues 10^-decades .. 10^decades."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(count, columns, columns)))[0]
    eigenvalues = 10.0 ** rng.uniform(-decades, decades, (count, columns)) * scale
    Q = np.einsum("mij,mj,mkj->mik", axes, eigenvalues, axes)
    R = np.einsum("mij,mj,mkj->mik", axes, 1.0 / eigenvalues, axes)
    return Q, R


def without_friction(Q: NDArray, R: NDArray, rows: NDArray) -> None:
    """Reduce the blocks of contacts with mu = 0 to their normals."""
    for block in (Q, R):
        normal = block[rows, 0, 0].copy()
        block[rows] = 0.0
        block[rows, 0, 0] = normal
    Q[rows, 0, 0] = 1.0 / R[rows, 0, 0]


def block_diagonal(blocks: NDArray) -> NDArray:
    m, c, _ = blocks.shape
    dense = np.zeros((m * c, m * c))
    for i in range(m):
        dense[c * i : c * (i + 1), c * i : c * (i + 1)] = blocks[i]
    return dense


def columns_of(operator: Delassus, contacts: int, columns: int) -> NDArray:
    """N on one rank, from its products with unit impulses."""
    N = np.empty((contacts * columns, contacts * columns))
    for k, unit in enumerate(np.eye(contacts * columns)):
        out = np.empty((contacts, columns))
        operator.apply(unit.reshape(contacts, columns), out)
        N[:, k] = out.ravel()
    return N


def scale_of(parallel: Parallel, operator: Delassus) -> float:
    """1 over the largest entry of diag N: the size of an impulse that makes a unit velocity."""
    largest = parallel.max(float(operator.diagonal().max(initial=0.0)))
    return 1.0 / largest if largest else 1.0


class Spheres:
    """A cloud's contacts on all ranks, and its dense N and blocks known to every rank."""

    def __init__(self, parallel: Parallel, bodies: Bodies, frictional: bool, mixed: bool = False):
        self.found = detect(parallel, bodies, OPTIONS, STEP, room(0.0, 1.0))
        n, self.contacts = self.found.neighbours, self.found.contacts
        self.masses = (n.inverse_mass, n.inverse_inertia, n.halo)
        self.columns = 3 if frictional else 1
        self.operator = MatrixFree(self.contacts, *self.masses, frictional)
        table = all_contacts(parallel, self.contacts, n.gid)
        place = {(c["a"], c["other"]): i for i, c in enumerate(table)}
        names = zip(n.gid[self.contacts.a], self.contacts.other, strict=True)
        self.rows = np.array([place[name] for name in names], dtype=int)
        self.N = dense_delassus(table, bodies, frictional)
        m = len(table)
        self.Q, self.R = spd_blocks(m, self.columns, 1.0, scale_of(parallel, self.operator))
        self.mu = np.full(m, 0.5)
        if mixed:
            self.mu[::3] = 0.0
            without_friction(self.Q, self.R, self.mu == 0.0)
        self.s = np.random.default_rng(3).normal(size=(m, self.columns))

    def expected(self) -> NDArray:
        """This rank's rows of the solution, (m, c)."""
        free = np.ones_like(self.s, dtype=bool)
        free[self.mu == 0.0, 1:] = False
        free = free.ravel()
        matrix = (self.N + block_diagonal(self.R))[np.ix_(free, free)]
        x = np.zeros(self.s.size)
        x[free] = np.linalg.solve(matrix, self.s.ravel()[free])
        return x.reshape(self.s.shape)[self.rows]

    def system(self, parallel: Parallel, options: NewtonOptions) -> NewtonSystem:
        return NewtonSystem(self.operator, self.mu[self.rows], parallel, options)

    def solve(self, system: NewtonSystem) -> tuple[NDArray, float]:
        system.factor(self.Q[self.rows], self.R[self.rows])
        out = np.full((len(self.rows), self.columns), np.nan)
        done = system.solve(self.s[self.rows], out)
        return out, done.residual


# ---- against dense matrices ----------------------------------------------------------------


@ranks_1_2_3_8
@both_frictions
@every_solver
@pytest.mark.parametrize("name", SCENES)
def test_solution_is_that_of_the_dense_system(parallel, name, frictional, options):
    case = Spheres(parallel, SCENES[name](), frictional)
    system = case.system(parallel, options)
    out, residual = case.solve(system)
    expected = case.expected()
    size = parallel.max(float(np.abs(expected).max(initial=0.0)))
    direct = options.linear == "mumps"
    # An iteration stops at 1e-10 of |s|; condition 1e2 and the norm of all rows make it 1e-7.
    limit = ROUNDING if direct else 1e-7
    assert parallel.max(float(np.abs(out - expected).max(initial=0.0))) <= limit * size
    assert residual <= (1e-13 if direct else 1e-10)
    factored = direct or options.preconditioner == "low_rank"
    assert (system.factor_entries > 0) == (factored and name not in ("no contacts", "none"))
    system.destroy()


@ranks_1_2_3_8
@every_solver
def test_contacts_without_friction_get_no_tangential_impulse(parallel, options):
    """mu = 0 in every third contact: the solution is that of the system without these rows."""
    case = Spheres(parallel, SCENES["pile"](), True, mixed=True)
    system = case.system(parallel, options)
    out, _ = case.solve(system)
    expected = case.expected()
    size = parallel.max(float(np.abs(expected).max(initial=0.0)))
    limit = ROUNDING if options.linear == "mumps" else 1e-7
    assert parallel.max(float(np.abs(out - expected).max(initial=0.0))) <= limit * size
    assert not out[case.mu[case.rows] == 0.0, 1:].any(), "exactly zero"
    system.destroy()


def heap(count: int = 30) -> Bodies:
    """Rods, spheroids and spheres in all directions, overlapping and apart."""
    rng = np.random.default_rng(21)
    radius = 0.12 * 3.0 ** -rng.random(count)
    shape = np.arange(count) % 3
    directions = rng.normal(size=(count, 4))
    stretch = np.where(shape == SPHERE, 0.0, rng.uniform(0.3, 3.0, count))
    arrays = {
        "gid": 2**40 + rng.permutation(count),
        "material": rng.integers(0, 2, count),
        "shape": shape,
        "radius": radius,
        "half_length": stretch * radius,
        "position": rng.random((count, 3)),
        "orientation": directions / np.linalg.norm(directions, axis=1, keepdims=True),
        "velocity": np.zeros((count, 3)),
        "angular_velocity": np.zeros((count, 3)),
    }
    return Bodies.from_arrays(arrays, np.array([1000.0, 2500.0]))


def general_operator(
    parallel: Parallel, frictional: bool, box: PeriodicBox | None = None
) -> MatrixFree:
    options = replace(OPTIONS, general=True, box=box)
    partition, owned = distribute(parallel, heap())
    reference = Reference.of(parallel, owned, owned.velocity, options, STEP)
    n = find_neighbours(parallel, partition, owned, reference, options)
    position, axis = n.extend_position(owned.position), n.extend(symmetry_axes(owned))
    still = np.zeros_like(axis)
    walls = room(0.0, 1.0) if box is None else no_walls()
    inertia = world_inverse_inertia(axis, n.inverse_inertia)
    contacts = find_general_contacts(n, position, axis, still, still, walls, options, STEP)
    return MatrixFree(contacts, n.inverse_mass, inertia, n.halo, frictional)


def periodic_operator(parallel: Parallel, frictional: bool) -> MatrixFree:
    """Spheres so large that a pair touches through several faces."""
    box = PeriodicBox(np.zeros(3), np.ones(3), np.ones(3, dtype=bool))
    bodies = cloud(np.random.default_rng(6).random((14, 3)), 0.24)
    found = detect(parallel, bodies, replace(detection(margin=0.1), box=box), STEP)
    n = found.neighbours
    return MatrixFree(found.contacts, n.inverse_mass, n.inverse_inertia, n.halo, frictional)


OPERATORS = {
    "rods and spheroids": general_operator,
    "periodic spheres": periodic_operator,
    "periodic rods": lambda parallel, frictional: general_operator(
        parallel, frictional, PeriodicBox(np.zeros(3), np.ones(3), np.ones(3, dtype=bool))
    ),
}


@ranks_1_2_3_8
@both_frictions
@both_forms
@pytest.mark.parametrize("name", OPERATORS)
def test_factor_belongs_to_the_operator_whatever_the_bodies(parallel, name, frictional, form):
    """Without any refinement the matrix-free product finds nothing amiss but round-off."""
    operator = OPERATORS[name](parallel, frictional)
    m, c = operator.contacts.count, operator.columns
    assert parallel.sum(m) > 15
    Q, R = spd_blocks(m, c, 1.0, scale_of(parallel, operator), seed=5 + parallel.rank)
    mu = np.where(np.arange(m) % 4 == 0, 0.0, 0.5)
    if frictional:
        without_friction(Q, R, mu == 0.0)
    s = np.random.default_rng(8 + parallel.rank).normal(size=(m, c))
    system = NewtonSystem(operator, mu, parallel, NewtonOptions(form=form))
    system.factor(Q, R)
    out = np.empty_like(s)
    done = system.solve(s, out)
    assert done.residual <= 1e-13 and done.refinements == 0 and done.products == 1
    if parallel.size == 1:
        free = np.ones((m, c), dtype=bool)
        free[mu == 0.0, 1:] = False
        free = free.ravel()
        matrix = columns_of(operator, m, c) + block_diagonal(R)
        expected = np.linalg.solve(matrix[np.ix_(free, free)], s.ravel()[free])
        assert np.abs(out.ravel()[free] - expected).max() <= ROUNDING * np.abs(expected).max()
    system.destroy()


@both_frictions
@both_forms
def test_a_body_may_touch_its_own_image(parallel, frictional, form):
    """Contacts of a body with images of itself and of another one, three to a pair."""
    rng = np.random.default_rng(31)
    halo = Halo.build(parallel, 2, {0: np.array([0, 1])})
    a = np.array([0, 0, 0, 0, 1], dtype=np.int32)
    b = np.array([-1, 1, 2, 3, 3], dtype=np.int32)
    m, c = 5, 3 if frictional else 1
    normal = rng.normal(size=(m, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    gap, arm, friction = np.zeros(m), rng.uniform(0.5, 1.0, (m, 2)), np.full(m, 0.5)
    row, other = np.array([0, 4, 5]), np.arange(m)
    contacts = ContactSet(a, b, other, row, normal, gap, arm, friction, 0)
    mass = np.array([1.0, 2.0, 1.0, 2.0])
    operator = MatrixFree(contacts, mass, 3.0 * mass, halo, frictional)
    Q, R = spd_blocks(m, c, 1.0, 1.0)
    s, out = rng.normal(size=(m, c)), np.empty((m, c))
    system = NewtonSystem(operator, friction, parallel, NewtonOptions(form=form))
    system.factor(Q, R)
    system.solve(s, out)
    expected = np.linalg.solve(columns_of(operator, m, c) + block_diagonal(R), s.ravel())
    assert np.abs(out.ravel() - expected).max() <= ROUNDING * np.abs(expected).max()
    system.destroy()


@pytest.mark.mpi(ranks=[1, 2])
@both_forms
def test_assembled_and_matrix_free_operators_give_one_solution(parallel, form):
    case = Spheres(parallel, SCENES["pile"](), True)
    one, _ = case.solve(system := case.system(parallel, NewtonOptions(form=form)))
    system.destroy()
    case.operator = Assembled(case.contacts, *case.masses, True, parallel)
    other, _ = case.solve(system := case.system(parallel, NewtonOptions(form=form)))
    system.destroy()
    case.operator.destroy()
    assert np.abs(one - other).max(initial=0.0) <= ROUNDING * np.abs(case.expected()).max(initial=0)


FILES = pytest.mark.parametrize("name", ["Capsules-i125-1213", "Box_Stacks-i0122-82-5"])


@pytest.mark.mpi(ranks=[1, 2, 3])
@FILES
@pytest.mark.parametrize("form", ["auto", "velocity", "contact"])
def test_problems_that_come_as_matrices(parallel, name, form):
    """Also with an unsymmetric M, where the factors are L U, and with W alone."""
    from dem_mpi.sparse_delassus import FactoredDelassus, MatrixDelassus

    problem = read_problem(parallel, ROOT / "tests" / "data" / "fclib" / f"{name}.hdf5")
    kind = MatrixDelassus if problem.delassus is not None else FactoredDelassus
    operator = kind(problem, parallel)
    m = len(operator.diagonal())
    Q, R = spd_blocks(m, 3, 1.0, scale_of(parallel, operator), seed=5 + parallel.rank)
    options = NewtonOptions(form=form)
    if kind is MatrixDelassus and form == "velocity":
        with pytest.raises(NewtonFailureError, match="needs D and M"):
            NewtonSystem(operator, np.full(m, 0.5), parallel, options)
    else:
        system = NewtonSystem(operator, np.full(m, 0.5), parallel, options)
        system.factor(Q, R)
        s = np.random.default_rng(8 + parallel.rank).normal(size=(m, 3))
        out = np.empty_like(s)
        done = system.solve(s, out)
        assert done.residual <= 1e-12
        assert system.take(operator, np.full(m, 0.5))
        system.destroy()
    operator.destroy()


# ---- accuracy ------------------------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 3])
@pytest.mark.parametrize("decades", [3.0, 6.0, 9.0, 12.0])
def test_refinement_keeps_the_residual_however_badly_scaled_the_blocks(parallel, decades):
    """Q from 10^-d to 10^d of 1/N: D^T u and s agree in up to d digits, which x would lose."""
    case = Spheres(parallel, SCENES["pile"](), True)
    m = len(case.s)
    case.Q, case.R = spd_blocks(m, 3, decades, scale_of(parallel, case.operator))
    system = case.system(parallel, NewtonOptions(form="velocity"))
    out, residual = case.solve(system)
    assert residual <= 1e-10 and np.isfinite(out).all()
    system.destroy()


@both_forms
def test_frictionless_blocks_of_any_size_keep_full_accuracy(parallel, form):
    """Numbers have no directions to lose: both forms, and the dense solution."""
    case = Spheres(parallel, SCENES["pile"](), False)
    case.Q, case.R = spd_blocks(len(case.s), 1, 4.0, scale_of(parallel, case.operator))
    system = case.system(parallel, NewtonOptions(form=form))
    out, residual = case.solve(system)
    expected = case.expected()
    # N is singular here; what R adds leaves the condition 1e4 of the smallest part.
    assert residual <= 1e-10
    assert np.abs(out - expected).max() <= 1e-8 * np.abs(expected).max()
    system.destroy()


@pytest.mark.mpi(ranks=[1, 2])
def test_zero_right_hand_side_has_the_zero_solution(parallel):
    case = Spheres(parallel, SCENES["pile"](), True)
    case.s[:] = 0.0
    system = case.system(parallel, NewtonOptions())
    out, residual = case.solve(system)
    assert residual == 0.0 and not out.any()
    system.destroy()


# ---- patterns kept and left ----------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
@both_forms
def test_moved_bodies_keep_the_analysis_and_give_their_own_solution(parallel, form):
    case = Spheres(parallel, SCENES["pile"](), True)
    system = case.system(parallel, NewtonOptions(form=form))
    before, _ = case.solve(system)
    owned = case.found.bodies
    owned.position += 1e-5 * np.sin(owned.gid)[:, None] * [1.0, 2.0, -1.0]
    moved = measure(case.found.neighbours, owned, OPTIONS, STEP, room(0.0, 1.0))
    assert moved.same_graph(case.contacts)
    case.operator = MatrixFree(moved, *case.masses, True)
    assert system.take(case.operator, case.mu[case.rows])
    after, residual = case.solve(system)
    assert residual <= 1e-13
    assert parallel.max(float(np.abs(after - before).max(initial=0.0))) > 0.0
    assert system._form.solver.analyses == 1
    fresh = case.system(parallel, NewtonOptions(form=form))
    again, _ = case.solve(fresh)
    if parallel.size == 1:
        # On several ranks MUMPS adds up in the order in which messages come.
        assert again.tobytes() == after.tobytes()
    for item in (system, fresh):
        item.destroy()


@ranks_1_2_3_8
@both_forms
def test_a_contact_lost_on_one_rank_is_another_pattern_on_all(parallel, form):
    case = Spheres(parallel, SCENES["pile"](), True)
    system = case.system(parallel, NewtonOptions(form=form))
    last = parallel.max(parallel.rank if case.contacts.count else 0)
    c = case.contacts
    mu = case.mu[case.rows]
    if parallel.rank == last:
        keep = c.count - 1
        mu = mu[:keep]
        c = ContactSet(
            c.a[:keep], c.b[:keep], c.other[:keep], np.minimum(c.row, keep), c.normal[:keep],
            c.gap[:keep], c.arm[:keep], c.friction[:keep], c.coincident,
        )  # fmt: skip
    assert not system.take(MatrixFree(c, *case.masses, True), mu)
    out, residual = case.solve(system)
    assert residual <= 1e-13 and np.isfinite(out).all(), "the old one still stands"
    system.destroy()


@both_forms
def test_memory_stays_over_many_factorisations(parallel, form):
    case = Spheres(parallel, SCENES["pile"](), True)

    def resident() -> int:
        with open("/proc/self/statm") as statm:
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def make(count: int) -> None:
        for _ in range(count):
            system = case.system(parallel, NewtonOptions(form=form))
            for _ in range(3):
                case.solve(system)
            system.destroy()

    make(20)
    before = resident()
    make(60)
    # A leaked matrix has 36 entries of 12 bytes for each of 400 blocks: 60 of them are 10 MB.
    assert resident() - before <= 4_000_000


# ---- choice of the form, and errors --------------------------------------------------------


def test_few_contacts_are_unknowns_themselves_and_many_leave_it_to_the_bodies(parallel):
    chain = [[0.1 + 0.08 * i, 0.5, 0.5] for i in range(10)]
    few = Spheres(parallel, cloud(chain, 0.041), True)
    many = Spheres(parallel, cloud(np.random.default_rng(11).random((40, 3)), 0.2), True)
    for case, form in ((few, "contact"), (many, "velocity")):
        system = case.system(parallel, NewtonOptions())
        assert system.form == form
        system.destroy()


@pytest.mark.mpi(ranks=[1, 2])
@both_forms
def test_numbers_that_are_not_finite_are_refused_on_all_ranks(parallel, form):
    case = Spheres(parallel, SCENES["pile"](), True)
    system = case.system(parallel, NewtonOptions(form=form))
    Q, R = case.Q[case.rows], case.R[case.rows]
    if parallel.rank == parallel.size - 1:
        Q[0, 0, 0] = np.nan
    with pytest.raises(NewtonFailureError, match="not finite"):
        system.factor(Q, R)
    system.destroy()


def test_singular_matrix_is_an_error_that_says_so(parallel):
    """One contact along an axis, and R = -N: a pivot that is exactly zero, without rounding."""
    case = Spheres(parallel, cloud([[0.3, 0.5, 0.5], [0.5, 0.5, 0.5]], 0.12), False)
    case.R[:] = -case.N
    system = case.system(parallel, NewtonOptions(form="contact"))
    with pytest.raises(NewtonFailureError, match="singular"):
        case.solve(system)
    system.destroy()


def test_a_nearly_singular_matrix_shows_in_the_residual(parallel):
    """More contacts than freedoms and R = 0: no x solves it, and none is called a solution."""
    case = Spheres(parallel, SCENES["pile"](), True)
    case.R[:] = 0.0
    system = case.system(parallel, NewtonOptions(form="contact"))
    try:
        _, residual = case.solve(system)
    except NewtonFailureError:
        residual = np.inf
    assert residual > 1e-3
    system.destroy()


@pytest.mark.mpi(ranks=[1, 2])
@both_forms
def test_memory_limit_is_an_error_that_names_what_is_wanted_and_the_key(parallel, form):
    lattice = np.stack(np.meshgrid(*[np.arange(8) / 8.0] * 3, indexing="ij"), axis=-1)
    case = Spheres(parallel, cloud(lattice.reshape(-1, 3) + 0.06, 0.063), True)
    options = NewtonOptions(form=form, memory=1.0)
    with pytest.raises(NewtonFailureError, match=r"\d MB.*contact\.scip\.memory"):
        case.solve(case.system(parallel, options))


@pytest.mark.mpi(ranks=[1, 2])
def test_too_small_a_memory_limit_for_the_factor_alone(parallel):
    """Room for the analysis, not for the factor: MUMPS itself says so."""
    lattice = np.stack(np.meshgrid(*[np.arange(8) / 8.0] * 3, indexing="ij"), axis=-1)
    case = Spheres(parallel, cloud(lattice.reshape(-1, 3) + 0.06, 0.063), True)
    system = case.system(parallel, NewtonOptions(form="velocity", memory=3.0))
    with pytest.raises(NewtonFailureError) as raised:
        case.solve(system)
    text = str(raised.value)
    assert "factorisation" in text and "contact.scip.memory = 3 MB a rank is not enough" in text
    # No estimate that would contradict it is told beside the limit: only one beyond it.
    wanted = [int(number) for number in re.findall(r"raise it to (\d+) or more", text)]
    assert all(number > 3 for number in wanted)
    system.destroy()


@pytest.mark.mpi(ranks=[1, 2])
@both_forms
def test_too_little_workspace_is_made_more_once(parallel, form):
    """MUMPS is given less than it asks for; the second factorisation has enough."""
    lattice = np.stack(np.meshgrid(*[np.arange(8) / 8.0] * 3, indexing="ij"), axis=-1)
    case = Spheres(parallel, cloud(lattice.reshape(-1, 3) + 0.06, 0.063), True)
    system = case.system(parallel, NewtonOptions(form=form, workspace=-60))
    _, residual = case.solve(system)
    assert residual <= 1e-13 and system.retries == 1
    system.destroy()


@pytest.mark.parametrize(
    ("options", "words"),
    [(NewtonOptions(form="contact", linear="cg"), "form: velocity")],
)
def test_options_that_do_not_go_together(parallel, options, words):
    case = Spheres(parallel, SCENES["two"](), True)
    with pytest.raises(NewtonFailureError, match=words):
        case.system(parallel, options)


@pytest.mark.parametrize("ordering", ["auto", "amd", "pord"])
def test_ordering_asked_for_is_the_one_used(parallel, ordering):
    numbers = {"amd": 0, "pord": 4}
    case = Spheres(parallel, SCENES["pile"](), True)
    system = case.system(parallel, NewtonOptions(form="velocity", ordering=ordering))
    case.solve(system)
    used = system._form.solver._ksp.getPC().getFactorMatrix().getMumpsInfog(7)
    assert ordering == "auto" or used == numbers[ordering]
    system.destroy()


def _around_a_large_one(count: int) -> tuple[NDArray, list[float]]:
    """Small spheres spread over a large one, touching nothing else."""
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    around = np.sqrt(1.0 - height**2)
    direction = np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)
    position = np.concatenate([np.zeros((1, 3)), 0.31 * direction]) + 0.5
    return position, [0.3] + [0.011] * count


# Graphs in which all vertices are joined: in bodies, in contacts or in both.
COMPLETE = {
    "one contact": ([[0.3, 0.5, 0.5], [0.5, 0.5, 0.5]], 0.12),
    "three that touch": ([[0.4, 0.4, 0.5], [0.6, 0.4, 0.5], [0.5, 0.57, 0.5]], 0.105),
    "forty on a large one": _around_a_large_one(40),
}


@pytest.mark.mpi(ranks=[1, 2])
@pytest.mark.parametrize("ordering", ["auto", "pord", "metis"])
@pytest.mark.parametrize("name", COMPLETE)
@both_forms
def test_a_graph_that_cannot_be_separated_ends_no_process(parallel, name, form, ordering):
    """PORD calls exit() on a complete graph."""
    for frictional in (True, False):
        case = Spheres(parallel, cloud(*COMPLETE[name]), frictional)
        system = case.system(parallel, NewtonOptions(form=form, ordering=ordering))
        _, residual = case.solve(system)
        assert residual <= 1e-12
        system.destroy()


def test_petsc_is_not_loaded_before_the_first_system():
    code = "import sys, dem_mpi.newton; sys.exit('petsc4py.PETSc' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
