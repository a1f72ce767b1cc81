"""Problems in FCLIB's layout: read in every storage, solved on any ranks, written, and refused.

The two files of tests/data/fclib are Siconos' own. A slow twin reads them with h5py into dense
matrices, so that an impulse is judged without any of the code under test.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from dem_mpi.cone import Tolerance
from dem_mpi.errors import DataError, InputError, OutputError
from dem_mpi.fclib import COLUMNS, read_problem
from dem_mpi.fclib_output import write_result
from dem_mpi.parallel import Parallel
from dem_mpi.solve import LAWS, SolveOptions, parse_options, solve_file

from contact_twins import projected, residuals
from launch import ROOT, kill_ranks, rank_environment, run_ranks, start_ranks

DATA = ROOT / "tests" / "data" / "fclib"
CAPSULES = DATA / "Capsules-i125-1213.hdf5"
BOXES = DATA / "Box_Stacks-i0122-82-5.hdf5"
FILES = pytest.mark.parametrize("path", [CAPSULES, BOXES], ids=["capsules", "boxes"])
ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])

TIGHT = SolveOptions(tolerance=Tolerance(1e-10, "scaled", 1e-10))


def quiet(text: str) -> None:
    """Print nothing."""


# ---- a twin: dense matrices from the file ----------------------------------------------------


def dense(group: h5py.Group) -> NDArray:
    """A matrix as the files met so far store it: triplets with rows in i."""
    shape = (int(group["m"][0]), int(group["n"][0]))
    nz, x, i, p = int(group["nz"][0]), group["x"][:], group["i"][:], group["p"][:]
    if nz == -1:
        return sparse.csc_matrix((x, i, p), shape=shape).toarray()
    if nz == -2:
        return sparse.csr_matrix((x, i, p), shape=shape).toarray()
    return sparse.coo_matrix((x, (i, p)), shape=shape).toarray()


def dense_problem(path: Path) -> tuple[NDArray, NDArray, NDArray]:
    """W (3c, 3c), q (c, 3) and mu (c,) of a spatial problem of either kind."""
    with h5py.File(path) as file:
        if "fclib_local" in file:
            group = file["fclib_local"]
            W, q = dense(group["W"]), group["vectors/q"][:]
        else:
            group = file["fclib_global"]
            M, H = dense(group["M"]), dense(group["H"])
            W = H.T @ np.linalg.solve(M, H)
            q = H.T @ np.linalg.solve(M, group["vectors/f"][:]) + group["vectors/w"][:]
        return W, q.reshape(-1, COLUMNS), group["vectors/mu"][:]


def stored(path: Path, name: str) -> NDArray:
    with h5py.File(path) as file:
        return file[name][:]


# ---- handmade files --------------------------------------------------------------------------


def put_matrix(group: h5py.Group, A: NDArray, storage: str) -> None:
    """Write a matrix as csc, csr, triplets (rows in i) or swapped triplets (rows in p)."""
    kind = {"csc": sparse.csc_matrix, "csr": sparse.csr_matrix}.get(storage, sparse.coo_matrix)
    stored = kind(A)
    if storage in ("csc", "csr"):
        nz, i, p = (-1 if storage == "csc" else -2), stored.indices, stored.indptr
    else:
        nz, i, p = stored.nnz, stored.row, stored.col
        if storage == "swapped":
            i, p = p, i
    sizes = {"m": A.shape[0], "n": A.shape[1], "nz": nz, "nzmax": stored.nnz}
    for name, value in sizes.items():
        group[name] = np.array([value], dtype=np.int32)
    group["i"], group["p"] = i.astype(np.int32), p.astype(np.int32)
    group["x"] = stored.data


def put_local(path: Path, W, q, mu, storage: str = "csr", dimension: int = 3) -> Path:
    with h5py.File(path, "w") as file:
        file["fclib_local/spacedim"] = np.array([dimension], dtype=np.int32)
        put_matrix(file.create_group("fclib_local/W"), W, storage)
        file["fclib_local/vectors/q"], file["fclib_local/vectors/mu"] = np.ravel(q), mu
    return path


def put_global(path: Path, M, H, f, w, mu, storage: str = "csc", dimension: int = 3) -> Path:
    with h5py.File(path, "w") as file:
        file["fclib_global/spacedim"] = np.array([dimension], dtype=np.int32)
        put_matrix(file.create_group("fclib_global/M"), M, storage)
        put_matrix(file.create_group("fclib_global/H"), H, storage)
        vectors = {"f": f, "w": np.ravel(w), "mu": mu}
        for name, values in vectors.items():
            file[f"fclib_global/vectors/{name}"] = values
    return path


def on_root(parallel: Parallel, write, *arguments, **options) -> None:
    """Collective. Write a file on rank 0; the others wait for it."""
    if parallel.rank == 0:
        write(*arguments, **options)
    parallel.barrier()


class FourBlocks:
    """Four bodies on a floor, z up: one sticks, one slides, one leaves, one has no friction.

    Contact points lie below the centres at the distance `arm`: W is diagonal, a = 1/m along the
    normal and c = 1/m + arm^2/I along both tangents.
    """

    mass = np.array([2.0, 0.5, 1.0, 3.0])
    inertia = np.array([0.1, 0.02, 0.05, 0.3])
    arm = 0.2
    mu = np.array([0.5, 0.3, 0.5, 0.0])
    velocity = np.array([[0.3, 0.4, -2.0], [3.0, -4.0, -1.0], [1.0, 0.0, 0.7], [0.5, 0.5, -1.5]])

    @property
    def a(self) -> NDArray:
        return 1.0 / self.mass

    @property
    def c(self) -> NDArray:
        return 1.0 / self.mass + self.arm**2 / self.inertia

    def matrices(self) -> tuple[NDArray, NDArray, NDArray]:
        """M (24, 24), H (24, 12), f (24,): velocity components (v, omega) of each body."""
        M = np.diag(
            np.concatenate(
                [[m] * 3 + [j] * 3 for m, j in zip(self.mass, self.inertia, strict=True)]
            )
        )
        H, f = np.zeros((24, 12)), np.zeros(24)
        for k in range(4):
            body = H[6 * k : 6 * k + 6, 3 * k : 3 * k + 3]
            body[:3] = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]  # normal z, tangents x and y
            # Velocity of the point at (0, 0, -arm): v + omega x (0, 0, -arm).
            body[3:, 1], body[3:, 2] = [0, -self.arm, 0], [self.arm, 0, 0]
            f[6 * k : 6 * k + 3] = self.mass[k] * self.velocity[k]
        return M, H, f

    def impulse(self) -> NDArray:
        """The minimum of a n^2/2 + c t^2/2 + q.(n, t) in each cone, (4, 3), worked out by hand."""
        result = np.zeros((4, 3))
        q_n, q_t = self.velocity[:, 2], self.velocity[:, :2]
        speed = np.linalg.norm(q_t, axis=1)
        result[0] = [-q_n[0] / self.a[0], *(-q_t[0] / self.c[0])]  # sticks: W r = -q
        n = (self.mu[1] * speed[1] - q_n[1]) / (self.a[1] + self.c[1] * self.mu[1] ** 2)
        result[1] = [n, *(-self.mu[1] * n * q_t[1] / speed[1])]  # slides: |r_t| = mu n
        result[3, 0] = -q_n[3] / self.a[3]
        return result


def packing(contacts: int = 20, coupled: bool = False, seed: int = 5):
    """A random global problem of 8 rigid bodies: M, H, f, w, mu, with 6 by 6 blocks or full M."""
    rng = np.random.default_rng(seed)
    bodies = 8
    B = rng.normal(size=(6 * bodies, 6 * bodies)) * (0.3 if coupled else 1.0)
    if not coupled:
        B *= np.kron(np.eye(bodies), np.ones((6, 6)))
    M = B @ B.T + np.eye(6 * bodies)
    H = np.zeros((6 * bodies, 3 * contacts))
    for k in range(contacts):
        for body in rng.choice(bodies, 2, replace=False):
            H[6 * body : 6 * body + 6, 3 * k : 3 * k + 3] = rng.normal(size=(6, 3))
    mu = rng.choice([0.0, 0.3, 0.8], contacts)
    return M, H, rng.normal(size=6 * bodies), 0.1 * rng.normal(size=3 * contacts), mu


# ---- the two files of the collection ---------------------------------------------------------

# Objectives [J] to the digits that solves to 1e-6 and 1e-8 share.
OBJECTIVE = {CAPSULES: -0.97902891, BOXES: -2.3209182e-5}


@FILES
@ranks_1_2_3_8
def test_files_of_the_collection_are_solved_on_any_ranks(parallel, shared_path, path):
    lines: list[str] = []
    out = shared_path / "out.h5"
    options = SolveOptions(out=out)
    assert solve_file(parallel, path, options, lines.append) == 0
    text = "\n".join(lines)
    assert "converged: " in text and "NOT" not in text
    objective = float(re.search(r"^  objective +(\S+) J$", text, re.MULTILINE).group(1))
    assert objective == pytest.approx(OBJECTIVE[path], rel=2e-8)

    W, q, mu = dense_problem(path)
    r = stored(out, "solution/r").reshape(q.shape)
    found = residuals(0.5 * (W + W.T), q, mu, r)
    assert found["objective"] == pytest.approx(objective, rel=1e-10)
    g = (W @ r.ravel()).reshape(q.shape) + q
    tangential = np.linalg.norm(r[:, 1:], axis=1)
    v_ref = np.linalg.norm(q, axis=1).max()
    gamma_ref = v_ref / np.sort(np.diag(W))[(W.shape[0] - 1) // 2]
    # The tolerances of the solve, with room for the last digits of another order of sums.
    assert np.all(tangential - mu * r[:, 0] <= 1e-15 * gamma_ref)
    assert np.all(mu * np.linalg.norm(g[:, 1:], axis=1) - g[:, 0] <= 1.001e-6 * v_ref)
    assert np.all(np.abs((r * g).sum(axis=1)) <= 1.001e-6 * v_ref * gamma_ref)
    assert np.allclose(stored(out, "solution/u"), g.ravel(), rtol=0, atol=1e-12 * v_ref)


def test_velocities_of_the_bodies_are_written_with_a_global_problem(parallel, tmp_path):
    out = tmp_path / "out.h5"
    assert solve_file(parallel, BOXES, SolveOptions(out=out), quiet) == 0
    with h5py.File(out) as file:
        group = file["fclib_global"]
        M, H = dense(group["M"]), dense(group["H"])
        v, r = file["solution/v"][:], file["solution/r"][:]
        assert np.allclose(M @ v, H @ r + group["vectors/f"][:], rtol=0, atol=1e-17)


@FILES
def test_stored_impulses_of_zero_are_no_solution(parallel, path):
    lines: list[str] = []
    solve_file(parallel, path, SolveOptions(), lines.append)
    (line,) = [line for line in lines if line.startswith("stored solution")]
    assert line == "stored solution: r is zero, so there is none"
    assert "solution" not in read_problem(parallel, path).stored


# ---- problems with a known answer ------------------------------------------------------------


@pytest.mark.parametrize("form", ["local", "global"])
@ranks_1_2_3_8
def test_blocks_stick_slide_leave_and_glide_as_by_hand(parallel, shared_path, form):
    blocks = FourBlocks()
    M, H, f = blocks.matrices()
    path, out = shared_path / "blocks.h5", shared_path / "out.h5"
    if form == "local":
        inverse = np.linalg.inv(M)
        on_root(parallel, put_local, path, H.T @ inverse @ H, H.T @ inverse @ f, blocks.mu)
    else:
        on_root(parallel, put_global, path, M, H, f, np.zeros(12), blocks.mu)
    lines: list[str] = []
    assert solve_file(parallel, path, replace(TIGHT, out=out), lines.append) == 0
    r = stored(out, "solution/r").reshape(4, 3)
    # Diagonal W of condition 12: an impulse is as exact as the residual, 1e-10 of v_ref / W.
    assert np.allclose(r, blocks.impulse(), rtol=0, atol=1e-8)
    assert np.array_equal(r[2], [0, 0, 0]) and np.array_equal(r[3, 1:], [0, 0])


def test_tangents_of_different_mobility_keep_the_cone(parallel, tmp_path):
    """A rod slides across its axis more easily than along it: the step is scaled alike in both."""
    W = np.diag([1.0, 8.0, 0.5])
    q, mu = np.array([[-1.0, 0.5, 0.3]]), np.array([0.2])
    out = tmp_path / "out.h5"
    options = replace(TIGHT, out=out)
    assert solve_file(parallel, put_local(tmp_path / "rod.h5", W, q, mu), options, quiet) == 0
    r = stored(out, "solution/r").reshape(1, 3)
    # Projected gradients with one step length, a fixed point of which is the solution.
    twin = np.zeros((1, 3))
    for _ in range(2000):
        twin = projected(twin - 0.1 * (twin @ W + q), mu)
    assert np.linalg.norm(twin[0, 1:]) == pytest.approx(0.2 * twin[0, 0])  # it slides
    assert np.allclose(r, twin, rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", ["local", "global"])
@pytest.mark.mpi(ranks=[1, 3])
def test_plane_problems_are_spatial_ones_without_a_second_tangent(parallel, shared_path, form):
    rng = np.random.default_rng(9)
    M = np.diag(rng.uniform(0.5, 2.0, 9))  # three plane bodies
    H = rng.normal(size=(9, 8))
    f, w, mu = rng.normal(size=9), rng.normal(size=8), np.array([0.0, 0.3, 0.3, 0.6])
    inverse = np.linalg.inv(M)
    W, q = H.T @ inverse @ H, H.T @ inverse @ f + w
    path, out, spatial = (shared_path / name for name in ("plane.h5", "out.h5", "spatial.h5"))
    if form == "local":
        on_root(parallel, put_local, path, W, q, mu, dimension=2)
    else:
        on_root(parallel, put_global, path, M, H, f, w, mu, dimension=2)
    keep = np.array([3 * (k // 2) + k % 2 for k in range(8)])
    W3, q3 = np.zeros((12, 12)), np.zeros(12)
    W3[np.ix_(keep, keep)], q3[keep] = W, q
    W3[[2, 5, 8, 11], [2, 5, 8, 11]] = 1.0  # free to move, pushed by nothing
    on_root(parallel, put_local, spatial, W3, q3, mu)

    assert solve_file(parallel, path, replace(TIGHT, out=out), quiet) == 0
    r = stored(out, "solution/r")
    parallel.barrier()
    assert r.shape == (8,)
    options = replace(TIGHT, out=out, force=True)
    assert solve_file(parallel, spatial, options, quiet) == 0
    # W is singular: impulses may differ, contact velocities may not.
    r3 = stored(out, "solution/r")
    assert np.allclose(W @ r, (W3 @ r3)[keep], rtol=0, atol=1e-7)
    assert np.all(r3[2::3] == 0.0)


# ---- operators -------------------------------------------------------------------------------


@pytest.mark.parametrize("storage", ["csc", "csr", "triplet", "swapped"])
@pytest.mark.parametrize("kind", ["blocks", "coupled", "local"])
@ranks_1_2_3_8
def test_operator_equals_dense_matrices_in_every_storage(parallel, shared_path, storage, kind):
    from dem_mpi.sparse_delassus import FactoredDelassus, MatrixDelassus

    M, H, f, w, mu = packing(coupled=kind == "coupled")
    W = H.T @ np.linalg.solve(M, H)
    W = 0.5 * (W + W.T)
    q = H.T @ np.linalg.solve(M, f) + w
    path = shared_path / "problem.h5"
    if kind == "local":
        on_root(parallel, put_local, path, W, q, mu, storage)
    else:
        on_root(parallel, put_global, path, M, H, f, w, mu, storage)
    problem = read_problem(parallel, path)
    operator = (MatrixDelassus if kind == "local" else FactoredDelassus)(problem, parallel)
    mine = slice(problem.contacts.first, problem.contacts.last)
    impulse = np.random.default_rng(1).normal(size=(20, 3))
    out = np.empty((problem.contacts.count, 3))
    operator.apply(np.ascontiguousarray(impulse[mine]), out)
    # Sums of up to 48 products of numbers of order 10, with M of condition below 100.
    assert np.allclose(out, (W @ impulse.ravel()).reshape(20, 3)[mine], rtol=0, atol=1e-10)
    diagonal = np.diag(W).reshape(20, 3)[mine]
    assert np.allclose(operator.diagonal(), diagonal, rtol=1e-11, atol=0)
    assert np.allclose(operator.offset, q.reshape(20, 3)[mine], rtol=0, atol=1e-11)
    assert np.array_equal(problem.mu, mu[mine])
    operator.destroy()


def test_triplets_met_twice_add_up(parallel, tmp_path):
    path = put_local(tmp_path / "twice.h5", np.eye(3), [[-1.0, 0, 0]], [0.5], "triplet")
    with h5py.File(path, "r+") as file:
        for name in ("i", "p", "x"):
            values = file[f"fclib_local/W/{name}"][:]
            del file[f"fclib_local/W/{name}"]
            file[f"fclib_local/W/{name}"] = np.concatenate([values, values])
        file["fclib_local/W/nz"][...] = 6
    assert np.array_equal(read_problem(parallel, path).delassus.toarray(), 2 * np.eye(3))


# ---- both laws, by each method ---------------------------------------------------------------


def de_saxce(W: NDArray, q: NDArray, mu: NDArray, r: NDArray) -> tuple[NDArray, NDArray]:
    """u = W r + q and what Coulomb's law puts into the dual cone, u + mu |u_t| n."""
    u = (W @ r.ravel()).reshape(q.shape) + q
    lifted = u.copy()
    lifted[:, 0] += mu * np.linalg.norm(u[:, 1:], axis=1)
    return u, lifted


@FILES
@pytest.mark.parametrize("method", ["apgd", "scip", "auto"])
@pytest.mark.mpi(ranks=[1, 2, 3])
def test_convex_problem_is_solved_alike_by_every_method(parallel, shared_path, path, method):
    out, lines = shared_path / "out.h5", []
    options = SolveOptions(Tolerance(1e-8, "scaled", 1e-8), solver=method, out=out)
    assert solve_file(parallel, path, options, lines.append) == 0
    with h5py.File(out) as file:
        attributes = dict(file["solution"].attrs)
    assert attributes["model"].decode() == LAWS["ccp"] and attributes["cone_problems"] == 1
    # Of both files' energy the last 1e-8 per contact may be missing.
    assert attributes["objective"] == pytest.approx(OBJECTIVE[path], rel=1e-6)
    text = "\n".join(lines)
    assert f"law: {LAWS['ccp']}; solver: {method}" in text and "thesis" in text
    if method == "scip":
        assert "Newton iterations" in text
        found = re.search(r"linear systems +(velocity|contact) form, (\d+) factor.*<= (\S+)", text)
        assert int(found.group(2)) > 0 and float(found.group(3)) <= 1e-8


@FILES
@pytest.mark.parametrize("method", ["apgd", "scip"])
@pytest.mark.mpi(ranks=[1, 2])
def test_coulomb_s_law_holds_for_the_very_matrices_of_the_file(parallel, shared_path, path, method):
    out, lines = shared_path / "out.h5", []
    options = SolveOptions(solver=method, law="coulomb", out=out)
    assert solve_file(parallel, path, options, lines.append) == 0
    text = "\n".join(lines)
    assert f"law: {LAWS['coulomb']}; solver: {method}" in text
    assert "cone problems" in text and "thesis" not in text
    with h5py.File(out) as file:
        assert file["solution"].attrs["model"].decode() == LAWS["coulomb"]
        assert file["solution"].attrs["cone_problems"] > 1
    W, q, mu = dense_problem(path)
    r = stored(out, "solution/r").reshape(q.shape)
    u, lifted = de_saxce(W, q, mu, r)
    v_ref = np.linalg.norm(q, axis=1).max()
    gamma_ref = v_ref / np.sort(np.diag(W))[(W.shape[0] - 1) // 2]
    assert np.all(np.linalg.norm(r[:, 1:], axis=1) - mu * r[:, 0] <= 1e-15 * gamma_ref)
    assert np.all(-u[:, 0] <= 1.001e-6 * v_ref)
    assert np.all(np.abs((r * lifted).sum(axis=1)) <= 1.001e-6 * v_ref * gamma_ref)
    assert np.allclose(stored(out, "solution/u"), u.ravel(), rtol=0, atol=1e-12 * v_ref)


def test_stored_impulses_are_judged_by_the_law_that_is_solved(parallel, tmp_path):
    """A solution of Coulomb's law is one under it, and none of the relaxation, where bodies slide.

    So FCLIB's solutions can be compared with ours under their own law.
    """
    first, lines = tmp_path / "coulomb.h5", []
    tight = SolveOptions(Tolerance(1e-8, "scaled", 1e-8), law="coulomb", out=first)
    assert solve_file(parallel, BOXES, tight, quiet) == 0
    said = {}
    for law in ("ccp", "coulomb"):
        lines.clear()
        assert solve_file(parallel, first, SolveOptions(law=law), lines.append) == 0
        text = "\n".join(lines).split("stored solution: ")[1]
        dual = float(re.search(r"dual (\S+) m/s", text).group(1))
        apart = float(re.search(r"velocities +differ by at most (\S+) m/s", text).group(1))
        said[law] = dual, apart
        assert ("ours is lower" in text) == (law == "ccp")
    v_ref = 3.342e-3
    assert said["coulomb"][0] <= 1.001e-8 * v_ref and said["coulomb"][1] <= 1e-5 * v_ref
    assert min(said["ccp"]) > 1e-4 * v_ref


# ---- guesses and output ----------------------------------------------------------------------


def test_solve_goes_on_from_what_an_unfinished_one_has_written(parallel, tmp_path):
    first, second = tmp_path / "first.h5", tmp_path / "second.h5"
    lines: list[str] = []
    short = SolveOptions(max_iterations=150, out=first)
    assert solve_file(parallel, CAPSULES, short, lines.append) == 70
    text = "\n".join(lines)
    assert "NOT CONVERGED: reached the iteration limit: 150 iterations" in text
    assert "  dual " in text and "objective" in text  # the result is printed all the same
    assert "'guesses/2'" in text
    # What did not converge is no solution: the one in the file stays, and it is zero.
    assert not stored(first, "solution/r").any() and stored(first, "guesses/2/r").any()
    assert stored(first, "guesses/number_of_guesses").tolist() == [2]

    lines.clear()
    options = SolveOptions(guess="2", out=second)
    assert solve_file(parallel, first, options, lines.append) == 0
    iterations = int(re.search(r"converged: (\d+) iterations", "\n".join(lines)).group(1))
    assert 0 < iterations < 207  # from zero it takes 207
    # Accepted at once as a start, but for the rounding of its projection on the cones.
    lines.clear()
    assert solve_file(parallel, second, SolveOptions(guess="solution"), lines.append) == 0
    text = "\n".join(lines)
    assert "start: the stored solution" in text and "converged: the start meets" in text
    assert re.search(r"stored solution: primal .*\n  objective .*\n  impulses +differ", text)
    compared = text.split("stored solution: ")[1]
    assert float(re.search(r"differ by at most (\S+) N s", compared).group(1)) < 1e-15


def test_a_stored_guess_is_compared_as_it_was_stored(parallel, tmp_path):
    """However the solve that starts from it goes on: the start has the residuals of its making."""
    out = tmp_path / "out.h5"
    loose = SolveOptions(Tolerance(1e-2, "scaled", 1e-2), out=out)
    assert solve_file(parallel, BOXES, loose, quiet) == 0
    said: list[list[str]] = [[], []]
    for lines, guess in zip(said, (None, "solution"), strict=True):
        assert solve_file(parallel, out, replace(TIGHT, guess=guess), lines.append) == 0
    first, second = (
        next(line for line in lines if line.startswith("stored solution")) for lines in said
    )
    assert first == second
    assert "differ by at most 0.000e+00" not in "\n".join(said[1])


@pytest.mark.mpi(ranks=[1, 3])
def test_written_file_holds_the_problem_unchanged(parallel, shared_path):
    out = shared_path / "out.h5"
    assert solve_file(parallel, CAPSULES, SolveOptions(out=out), quiet) == 0
    if parallel.rank == 0:
        assert [p.name for p in shared_path.iterdir()] == ["out.h5"]  # no lock, no part
        with h5py.File(CAPSULES) as before, h5py.File(out) as after:
            names: list[str] = []
            before.visit(names.append)
            for name in names:
                if isinstance(before[name], h5py.Dataset) and not name.startswith("solution"):
                    assert np.array_equal(before[name][()], after[name][()]), name
            assert after["solution"].attrs["converged"] == 1
            assert after["solution/r"].dtype == np.float64
            assert after["solution/r"].shape == after["solution/u"].shape == (858,)
    parallel.barrier()


def test_existing_output_is_kept_unless_forced(parallel, tmp_path):
    out = tmp_path / "out.h5"
    out.write_text("precious")
    with pytest.raises(InputError, match="exists; --force"):
        solve_file(parallel, BOXES, SolveOptions(out=out), quiet)
    assert out.read_text() == "precious"
    assert solve_file(parallel, BOXES, SolveOptions(out=out, force=True), quiet) == 0
    assert h5py.is_hdf5(out)


def test_problem_file_may_be_replaced_by_itself_with_the_solution(parallel, tmp_path):
    path = tmp_path / "boxes.h5"
    shutil.copy(BOXES, path)
    options = SolveOptions(out=path, force=True)
    assert solve_file(parallel, path, options, quiet) == 0
    assert np.array_equal(dense_problem(path)[0], dense_problem(BOXES)[0])
    assert stored(path, "solution/r").any()


@pytest.mark.parametrize("place", ["missing/out.h5", "."])
def test_output_without_a_place_is_refused_before_the_work(parallel, tmp_path, place):
    with pytest.raises(InputError, match="--out"):
        solve_file(parallel, tmp_path / "none.h5", SolveOptions(out=tmp_path / place), quiet)


def test_full_disk_leaves_the_old_file(parallel, tmp_path, monkeypatch):
    out = tmp_path / "out.h5"
    out.write_text("precious")
    problem = read_problem(parallel, BOXES)
    full = OutputError("no space left")

    def fail(*arguments):
        raise full

    monkeypatch.setattr("dem_mpi.fclib_output.SharedFile.write_rows", fail)
    r = np.zeros((problem.contacts.count, 3))
    with pytest.raises(OutputError, match="no space"):
        write_result(parallel, out, problem, {"r": r}, True, {})
    assert out.read_text() == "precious" and list(tmp_path.iterdir()) == [out]


# ---- refused ---------------------------------------------------------------------------------


def _set(name: str, value):
    def edit(file: h5py.File) -> None:
        del file[name]
        file[name] = value

    return edit


def _without(name: str):
    def edit(file: h5py.File) -> None:
        del file[name]

    return edit


def _entry(name: str, place: int, value):
    def edit(file: h5py.File) -> None:
        file[name][place] = value

    return edit


def _asymmetric(file: h5py.File) -> None:
    file["fclib_local/W/x"][1] += 0.1


def _indefinite(file: h5py.File) -> None:
    file["fclib_local/W/x"][0] = 1e-3  # W_00 far below its row


def _both(file: h5py.File) -> None:
    file.copy("fclib_local", "fclib_global")


def _constrained(file: h5py.File) -> None:
    file["fclib_local/V/n"] = np.array([3], dtype=np.int32)


_L = "fclib_local"
DAMAGES = {
    "no problem": (_without(_L), "neither a local nor a global"),
    "two problems": (_both, "both a local and a global"),
    "no W": (_without(f"{_L}/W"), "'fclib_local/W/m' is not one integer"),
    "no q": (_without(f"{_L}/vectors/q"), "'fclib_local/vectors/q' is missing"),
    "no entries": (_without(f"{_L}/W/x"), "'fclib_local/W/x' is missing"),
    "one dimension": (_set(f"{_L}/spacedim", [1]), "must be 2 or 3"),
    "plane with spatial rows": (_set(f"{_L}/spacedim", [2]), "vectors/mu' has shape"),
    "not square": (_set(f"{_L}/W/m", [857]), "857 by 858: it must be square"),
    "unknown storage": (_set(f"{_L}/W/nz", [-3]), "nz' = -3"),
    "too many triplets": (_set(f"{_L}/W/nz", [2**31 - 1]), "entries"),
    "short q": (_set(f"{_L}/vectors/q", np.zeros(857)), "shape (857,), expected (858,)"),
    "q is a table": (_set(f"{_L}/vectors/q", np.zeros((858, 1))), "shape (858, 1)"),
    "q is text": (_set(f"{_L}/vectors/q", np.array([b"x"] * 858)), "not numbers"),
    "fractional indices": (_set(f"{_L}/W/i", np.zeros(11772)), "not integers"),
    "NaN in q": (_entry(f"{_L}/vectors/q", 7, np.nan), "q'[7] = nan"),
    "infinite W": (_entry(f"{_L}/W/x", 3, np.inf), "x'[3] = inf"),
    "negative friction": (_entry(f"{_L}/vectors/mu", 0, -0.1), "must be >= 0"),
    "column outside": (_entry(f"{_L}/W/i", 5, 858), "index 858, outside 0 ... 857"),
    "negative column": (_entry(f"{_L}/W/i", 5, -1), "index -1"),
    "pointers descend": (_entry(f"{_L}/W/p", 5, 1), "does not ascend"),
    "pointers outside": (_entry(f"{_L}/W/p", 858, 2**31 - 1), "behind the last entry"),
    "asymmetric": (_asymmetric, "W is not symmetric"),
    "indefinite": (_indefinite, "W is not positive semi-definite"),
    "constraints": (_constrained, "equality constraints are not supported"),
    "short guess": (_set("guesses/1/r", np.ones(3)), "'guesses/1/r' has shape"),
    "NaN in a guess": (_entry("guesses/1/r", 0, np.nan), "guesses/1/r'[0] = nan"),
    "guesses without number": (_set("guesses/number_of_guesses", [-5]), "= -5: refused"),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.mpi(ranks=[1, 3])
def test_damaged_problems_are_refused_in_one_line_on_all_ranks(parallel, shared_path, damage):
    edit, words = DAMAGES[damage]
    path = shared_path / "bad.h5"

    def write() -> None:
        shutil.copy(CAPSULES, path)
        with h5py.File(path, "r+") as file:
            edit(file)

    on_root(parallel, write)
    with pytest.raises(DataError, match=re.escape(words)) as caught:
        solve_file(parallel, path, SolveOptions(), quiet)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("coupled", [False, True], ids=["blocks", "coupled"])
@pytest.mark.mpi(ranks=[1, 2])
def test_indefinite_mass_is_refused(parallel, shared_path, coupled):
    M, H, f, w, mu = packing(coupled=coupled)
    # Every 2 by 2 minor stays positive: only the factorisation notices.
    M[:3, :] = M[:, :3] = 0.0
    M[:3, :3] = np.eye(3) - 0.7 * (1 - np.eye(3))
    path = shared_path / "mass.h5"
    on_root(parallel, put_global, path, M, H, f, w, mu)
    with pytest.raises(DataError, match="M is not positive definite"):
        solve_file(parallel, path, SolveOptions(), quiet)


def test_contact_that_no_impulse_moves_is_refused(parallel, tmp_path):
    M, H, f, w, mu = packing()
    H[:, 3 * 7] = 0.0
    path = put_global(tmp_path / "stuck.h5", M, H, f, w, mu)
    with pytest.raises(DataError, match="contact 7: no impulse moves it"):
        solve_file(parallel, path, SolveOptions(), quiet)


def test_triplets_that_fit_neither_way_are_refused(parallel, tmp_path):
    M, H, f, w, mu = packing()
    path = put_global(tmp_path / "far.h5", M, H, f, w, mu, "triplet")
    with h5py.File(path, "r+") as file:
        file["fclib_global/H/i"][0] = file["fclib_global/H/p"][1] = 59
    with pytest.raises(DataError, match=r"48 by 60, but its triplets reach i = 59, p = 59"):
        solve_file(parallel, path, SolveOptions(), quiet)


@pytest.mark.parametrize("size", [0, 100, 5000, 150_000])
def test_truncated_files_are_refused(parallel, tmp_path, size):
    path = tmp_path / "cut.h5"
    path.write_bytes(CAPSULES.read_bytes()[:size])
    with pytest.raises(DataError, match=re.escape(str(path))):
        solve_file(parallel, path, SolveOptions(), quiet)


def test_flipped_bits_end_in_a_refusal_or_a_solve(parallel, tmp_path):
    """Also where all of the file is copied to the output: HDF5's own copy crashed on some."""
    rng = np.random.default_rng(3)
    good, path = BOXES.read_bytes(), tmp_path / "flipped.h5"
    options = SolveOptions(max_iterations=30, out=tmp_path / "out.h5", force=True)
    outcomes = []
    for flips in [1, 20] * 60:
        bad = bytearray(good)
        for place in rng.integers(0, 12_000, flips):  # where most of the structure lies
            bad[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        try:
            outcomes.append(solve_file(parallel, path, options, quiet))
        except DataError as error:
            outcomes.append(str(error))
    refused = [text for text in outcomes if isinstance(text, str)]
    assert len(refused) > 60 and not any("\n" in text for text in refused)
    assert {code for code in outcomes if isinstance(code, int)} <= {0, 70}


# ---- scales and edges ------------------------------------------------------------------------


def test_problem_without_any_velocity_is_solved_by_nothing(parallel, tmp_path):
    path = put_local(tmp_path / "rest.h5", np.eye(6), np.zeros(6), np.full(2, 0.5))
    out = tmp_path / "out.h5"
    for kind in ("scaled", "absolute", "thesis"):
        options = SolveOptions(Tolerance(1e-6, kind, 1e-6), out=out, force=True)
        assert solve_file(parallel, path, options, quiet) == 0
        assert not stored(out, "solution/r").any()


@pytest.mark.mpi(ranks=[1, 3])
def test_asymmetric_matrix_is_named_and_solved_as_stored(parallel, shared_path):
    """A gyroscopic term of 1e-3: the residuals of the very matrix in the file go to zero."""
    M, H, f, w, mu = packing()
    W = H.T @ np.linalg.solve(M, H)
    q = H.T @ np.linalg.solve(M, f) + w
    rng = np.random.default_rng(2)
    skew = rng.normal(size=W.shape) * (W != 0)
    scale = np.sqrt(np.outer(np.diag(W), np.diag(W)))
    W = W + 5e-4 * scale * np.clip(skew - skew.T, -1, 1)
    path, out = shared_path / "skew.h5", shared_path / "out.h5"
    on_root(parallel, put_local, path, W, q, mu)
    lines: list[str] = []
    options = SolveOptions(tolerance=Tolerance(1e-6, "scaled", 1e-6), out=out)
    assert solve_file(parallel, path, options, lines.append) == 0
    assert any("W is not symmetric" in line and "1.0e-03" in line for line in lines)
    r = stored(out, "solution/r")
    g = (W @ r + q).reshape(-1, 3)
    v_ref = np.linalg.norm(q.reshape(-1, 3), axis=1).max()
    assert np.all(mu * np.linalg.norm(g[:, 1:], axis=1) - g[:, 0] <= 1.001e-6 * v_ref)


# ---- the command line ------------------------------------------------------------------------


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "dem_mpi", "solve", *map(str, arguments)],
        env=rank_environment(), capture_output=True, text=True, timeout=120, check=False,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip


def test_help_names_every_flag():
    words = " ".join(command("--help").stdout.split())
    for flag in ("PROBLEM.h5", "--tolerance", "--tolerance-kind scaled|absolute|thesis",
                 "--complementarity", "--max-iterations", "--guess solution|NUMBER",
                 "--solver apgd|scip|auto", "--law ccp|coulomb", "--newton-iterations",
                 "--form auto|velocity|contact", "--linear mumps|cg",
                 "--out FILE.h5", "--force", "Exit codes: 0 done"):  # fmt: skip
        assert flag in words, flag


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--tolerance", "0"], "--tolerance 0: must be > 0"),
        (["--complementarity", "nan"], "--complementarity nan: must be > 0"),
        (["--tolerance-kind", "exact"], "must be one of scaled, absolute, thesis"),
        (["--guess", "0"], "must be 'solution' or the number of a guess"),
        (["--guess", "../1"], "must be 'solution' or the number of a guess"),
        (["--guess", "7"], "there is no 'guesses/7/r'"),
        (["--max-iterations", "-1"], "--max-iterations"),
        (["--solver", "nsgs"], "--solver nsgs: must be one of apgd, scip, auto"),
        (["--law", "tresca"], "--law tresca: must be one of ccp, coulomb"),
        (["--form", "both"], "--form both: must be one of auto, velocity, contact"),
        (["--linear", "lu"], "--linear lu: must be one of mumps, cg"),
        (["--newton-iterations", "0"], "--newton-iterations"),
    ],
)
def test_bad_flags_end_with_64_and_one_line(flags, words):
    done = command(CAPSULES, *flags)
    assert done.returncode == 64 and done.stdout == ""
    assert words in done.stderr and done.stderr.count("\n") == 1


def test_exit_codes_of_files_and_solves(tmp_path):
    foreign = tmp_path / "foreign.h5"
    foreign.write_text("no HDF5")
    cases = [([CAPSULES], 0), ([CAPSULES, "--max-iterations", "3"], 70), ([foreign], 65),
             ([tmp_path / "none.h5"], 64)]  # fmt: skip
    for arguments, code in cases:
        done = command(*arguments)
        assert done.returncode == code, done.stderr
        assert done.stderr.count("\n") == (code in (64, 65))
        assert ("objective" in done.stdout) == (code in (0, 70))


def test_ranks_print_once_and_fail_together(tmp_path):
    good = run_ranks(3, ["-m", "dem_mpi", "solve", BOXES], timeout=60)
    assert good.returncode == 0 and good.stdout.count("objective") == 1
    bad = tmp_path / "bad.h5"
    bad.write_text("no HDF5")
    done = run_ranks(3, ["-m", "dem_mpi", "solve", bad], timeout=60)
    assert done.returncode == 65 and done.stderr.count("not an HDF5 file") == 1


def test_interrupt_ends_a_solve_at_once():
    arguments = ["-m", "dem_mpi", "solve", CAPSULES, "--tolerance", "1e-16", "--max-iterations",
                 "1000000000"]  # fmt: skip
    process = start_ranks(1, arguments)
    try:
        for line in process.stdout:
            if line.startswith("start:"):
                break
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) != 0
    finally:
        kill_ranks(process)


def test_local_problem_has_no_velocity_form():
    done = command(CAPSULES, "--solver", "scip", "--form", "velocity")
    assert done.returncode == 64 and "a local problem has no M and H" in done.stderr


def test_conjugate_gradients_are_refused_where_there_are_no_velocities():
    done = command(CAPSULES, "--solver", "scip", "--linear", "cg")
    assert done.returncode == 64 and "--linear cg: a local problem has no M" in done.stderr
    done = command(CAPSULES, "--solver", "scip", "--linear", "cg", "--form", "contact")
    assert done.returncode == 64 and "not with --form contact" in done.stderr


def test_conjugate_gradients_are_refused_where_the_mass_matrix_is_not_symmetric(tmp_path):
    """As by an implicit gyroscopic term."""
    M, *rest = packing()
    M[0, 1] += 1e-3 * np.sqrt(M[0, 0] * M[1, 1])
    path = put_global(tmp_path / "turning.hdf5", M, *rest)
    done = command(path, "--solver", "scip", "--linear", "cg")
    assert done.returncode == 64 and "--linear cg: M is not symmetric" in done.stderr


def test_page_shows_what_the_program_prints():
    page = (ROOT / "docs" / "fclib.md").read_text()
    samples = re.findall(
        r"^(\S+\.hdf5) .*?^law: (.*?);.*?^  objective +(\S+) J$", page, re.DOTALL | re.M
    )
    shown = {(name, law): float(value) for name, law, value in samples}
    assert set(shown) == {
        (CAPSULES.name, LAWS["ccp"]),
        (BOXES.name, LAWS["ccp"]),
        (CAPSULES.name, LAWS["coulomb"]),
    }
    for path in (CAPSULES, BOXES):
        assert shown[path.name, LAWS["ccp"]] == pytest.approx(OBJECTIVE[path], rel=2e-8)
    # Not the least of anything: to the digits that a solve to 1e-6 has.
    assert shown[CAPSULES.name, LAWS["coulomb"]] == pytest.approx(-5.8122e-3, rel=1e-3)


def test_options_are_parsed_to_the_tolerance_and_the_solver_they_name():
    asked = SolveOptions(max_iterations=7, guess="solution", solver="scip", law="coulomb",
                         newton_iterations=9, form="velocity", linear="cg")  # fmt: skip
    options = parse_options(1e-3, "absolute", 1e-2, asked)
    assert options == replace(asked, tolerance=Tolerance(1e-3, "absolute", 1e-2))
    choice = options.choice
    assert (choice.solver, choice.law, choice.max_iterations) == ("scip", "coulomb", 7)
    assert (choice.scip.max_iterations, choice.scip.form, choice.scip.linear) == (
        9,
        "velocity",
        "cg",
    )
    assert choice.tolerance == options.tolerance
