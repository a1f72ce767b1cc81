"""Transfers by matrices against the matrices themselves, evaluated here from the kernels.

Errors are measured as the module states them: in the Frobenius norm weighted by the quadrature
weights of the grid, relative to each operator.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from stokes.fmm import kernels
from stokes.fmm.chebyshev import CompressedTransfer, DenseTransfer, SymmetricTransfer
from stokes.fmm.interpolation import Grid
from stokes.fmm.symmetry import (
    cone_symmetry,
    node_permutation,
    signed_permutation,
    transfer_vectors,
    vector_index,
    vector_offset,
)

EDGES = [1.0, 0.5, 0.25, 0.125]
# what is left of the digits after products of factors whose entries are of order one
ROUNDING = 2e-14

KERNELS = {
    "laplace": kernels.laplace,
    "stokeslet": kernels.stokeslet,
    "laplace_gradient": kernels.laplace_gradient,  # odd, 1 in 3 out
    "laplace_dipole": kernels.laplace_dipole,  # odd, 3 in 1 out: the pressure of a Stokeslet
    "stresslet": kernels.stresslet,  # 6 in 3 out
    "gaussian": kernels.gaussian(0.7),
}


@dataclass(frozen=True)
class Drifting:
    """exp(x) / r: a kernel without the symmetries of the cube."""

    name: str = "drifting"
    n_in: int = 1
    n_out: int = 1
    degree: float | None = None
    length: float = 1.0

    def matrix(self, r):
        return (np.exp(r[:, 0]) / np.linalg.norm(r, axis=1))[:, None, None]

    def rotate(self, rotation):
        return np.eye(1), np.eye(1)


def node_points(grid, edge):
    x = np.array(list(itertools.product(grid.points, repeat=3)))
    return 0.5 * edge * x


def operator(kernel, grid, edge, v):
    """(n_out N, n_in N) kernel matrix between the nodes of two boxes, from the definition."""
    x = node_points(grid, edge)
    r = edge * vector_offset(v) + x[:, None] - x
    values = kernel.matrix(r.reshape(-1, 3)).reshape(len(x), len(x), kernel.n_out, kernel.n_in)
    return values.transpose(2, 0, 3, 1).reshape(kernel.n_out * len(x), -1)


def applied_operators(transfer, level, vectors):
    """(vectors, n_out N, n_in N) what `add` does to unit multipoles, one target box for each."""
    kernel, n = transfer.kernel, transfer.nodes
    width = kernel.n_in * n**3
    unit = np.eye(width, dtype=transfer.dtype).reshape(width, kernel.n_in, n, n, n)
    boxes = width * len(vectors)
    local = np.zeros((boxes, kernel.n_out, n, n, n), transfer.dtype)
    source = np.tile(np.arange(width), len(vectors))
    vector = np.repeat(vectors, width)
    transfer.add(level, unit, np.arange(boxes + 1), source, vector, np.arange(boxes), local)
    return local.reshape(len(vectors), width, -1).transpose(0, 2, 1)


def weights(grid, components):
    if grid.kind == "equispaced":
        return np.ones(components * grid.nodes**3)
    w = np.sin(np.pi * (np.arange(grid.nodes) + 0.5) / grid.nodes)
    return np.tile(np.sqrt(np.einsum("a,b,c->abc", w, w, w)).ravel(), components)


def relative_errors(transfer, grid, level, vectors):
    """(vectors,) weighted Frobenius norms of the errors, relative to the operators'."""
    kernel = transfer.kernel
    out, into = weights(grid, kernel.n_out)[:, None], weights(grid, kernel.n_in)
    errors = []
    for v, made in zip(vectors, applied_operators(transfer, level, vectors), strict=True):
        true = operator(kernel, grid, EDGES[level], v)
        errors.append(
            np.linalg.norm(out * (made - true) * into) / np.linalg.norm(out * true * into)
        )
    return np.array(errors)


def random_lists(kernel, nodes, seed=0, boxes=40, rows=12):
    """Multipoles and far pairs: `rows` target boxes with half of all vectors each."""
    rng = np.random.default_rng(seed)
    multipoles = rng.standard_normal((boxes, kernel.n_in, nodes, nodes, nodes))
    vector = np.concatenate([rng.permutation(transfer_vectors(False))[:158] for _ in range(rows)])
    source = rng.integers(0, boxes, len(vector))
    start = 158 * np.arange(rows + 1)
    targets = rng.permutation(boxes)[:rows]
    return multipoles, start, source, vector, targets


def result(transfer, level, lists):
    multipoles, start, source, vector, targets = lists
    n = transfer.nodes
    local = np.zeros((len(multipoles), transfer.kernel.n_out, n, n, n), transfer.dtype)
    given = multipoles.astype(transfer.dtype)
    transfer.add(level, given, start, source, vector, targets, local)
    return local


# --- symmetries --------------------------------------------------------------------------------


def all_symmetries():
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((-1, 1), repeat=3):
            yield np.array(signs)[:, None] * np.eye(3, dtype=np.int64)[list(axes)]


def test_vectors_number_316_and_343_and_fall_into_16_and_20_orbits():
    for neighbours, count, stored in ((False, 316, 16), (True, 343, 20)):
        vectors = transfer_vectors(neighbours)
        assert len(vectors) == count
        assert np.array_equal(vector_index(vector_offset(vectors)), vectors)
        cone = {tuple(cone_symmetry(d) @ d) for d in vector_offset(vectors)}
        assert len(cone) == stored
        assert all(0 <= z <= y <= x for x, y, z in cone)


def test_node_permutation_turns_the_grid():
    grid = Grid("chebyshev", 4)
    points = node_points(grid, 2.0)
    for Q in all_symmetries():
        assert np.array_equal(points[node_permutation(Q, 4)], points @ Q.T)


@pytest.mark.parametrize("name", KERNELS)
def test_operators_follow_from_one_another_by_all_48_symmetries(name):
    kernel, grid, offset = KERNELS[name], Grid("chebyshev", 2), np.array([3, -2, 1])
    shape = (kernel.n_out, 8, kernel.n_in, 8)
    original = operator(kernel, grid, 1.0, vector_index(offset)).reshape(shape)
    for Q in all_symmetries():
        image = node_permutation(Q, 2)
        R_out, R_in = kernel.rotate(Q)
        turned = operator(kernel, grid, 1.0, vector_index(Q @ offset)).reshape(shape)
        back = np.einsum("ki,kalb,lj->iajb", R_out, turned[:, image][..., image], R_in)
        assert np.abs(back - original).max() <= ROUNDING * np.abs(original).max()


def test_rotation_that_mixes_components_is_refused():
    with pytest.raises(ValueError, match="permuted and negated"):
        signed_permutation(np.array([[0.6, 0.8], [-0.8, 0.6]]))


# --- operators ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["chebyshev", "equispaced"])
@pytest.mark.parametrize("name", KERNELS)
def test_dense_transfer_is_the_kernel_between_nodes(name, kind):
    kernel, grid = KERNELS[name], Grid(kind, 2)
    transfer = DenseTransfer(kernel, grid, EDGES)
    errors = relative_errors(transfer, grid, 3, transfer_vectors(False))
    assert errors.max() <= ROUNDING


@pytest.mark.parametrize("eps", [1e-3, 1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("name", KERNELS)
def test_symmetric_operator_of_each_vector_errs_by_less_than_eps(name, eps):
    kernel, grid = KERNELS[name], Grid("chebyshev", 4 if KERNELS[name].n_in == 1 else 3)
    transfer = SymmetricTransfer(kernel, grid, EDGES, eps)
    errors = relative_errors(transfer, grid, 3, transfer_vectors(False))
    assert errors.max() <= eps + ROUNDING


@pytest.mark.parametrize("eps", [1e-3, 1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("name", KERNELS)
def test_compressed_operators_err_by_less_than_eps_in_the_mean_square(name, eps):
    kernel, grid = KERNELS[name], Grid("chebyshev", 4 if KERNELS[name].n_in == 1 else 3)
    transfer = CompressedTransfer(kernel, grid, EDGES, eps)
    errors = relative_errors(transfer, grid, 3, transfer_vectors(False))
    # The nearest boxes err by more than the others, which the mean square shares out.
    assert np.sqrt(np.mean(errors**2)) <= eps + ROUNDING


@pytest.mark.parametrize("method", [CompressedTransfer, SymmetricTransfer])
def test_equispaced_grids_keep_the_tolerance_too(method):
    grid = Grid("equispaced", 4)
    transfer = method(kernels.laplace, grid, EDGES, 1e-5)
    errors = relative_errors(transfer, grid, 2, transfer_vectors(False))
    assert np.sqrt(np.mean(errors**2)) <= 1e-5


@pytest.mark.parametrize("method", [CompressedTransfer, SymmetricTransfer])
def test_boxes_that_touch_are_served_where_the_kernel_is_smooth(method):
    kernel, grid = kernels.gaussian(0.7), Grid("chebyshev", 4)
    transfer = method(kernel, grid, EDGES, 1e-6, admissibility="smooth")
    errors = relative_errors(transfer, grid, 3, transfer_vectors(True))
    assert np.sqrt(np.mean(errors**2)) <= 1e-6
    # coarser levels have no such pairs
    errors = relative_errors(transfer, grid, 2, transfer_vectors(False))
    assert np.sqrt(np.mean(errors**2)) <= 1e-6


def test_smooth_tree_of_one_box_has_its_operator():
    kernel, grid = kernels.gaussian(0.7), Grid("chebyshev", 3)
    transfer = SymmetricTransfer(kernel, grid, [1.0], 1e-8, admissibility="smooth")
    assert relative_errors(transfer, grid, 0, [vector_index(np.zeros(3, int))]).max() <= 1e-8


@pytest.mark.parametrize("method", [DenseTransfer, CompressedTransfer, SymmetricTransfer])
@pytest.mark.parametrize("kernel", [kernels.stokeslet, kernels.gaussian(0.3)])
def test_every_level_has_the_operators_of_its_edge(method, kernel):
    grid = Grid("chebyshev", 3)
    eps = () if method is DenseTransfer else (1e-6,)
    transfer = method(kernel, grid, EDGES, *eps)
    some = transfer_vectors(False)[::31]
    for level in (2, 3):
        assert relative_errors(transfer, grid, level, some).max() <= 4e-6


def test_homogeneous_kernel_keeps_one_level():
    grid, deep = Grid("chebyshev", 3), [2.0**-k for k in range(9)]
    flat = SymmetricTransfer(kernels.laplace, grid, EDGES, 1e-6)
    assert SymmetricTransfer(kernels.laplace, grid, deep, 1e-6).bytes == flat.bytes
    one = DenseTransfer(kernels.gaussian(0.7), grid, EDGES[:3]).bytes
    assert DenseTransfer(kernels.gaussian(0.7), grid, EDGES).bytes == 2 * one


def test_kernel_without_the_symmetries_is_refused_or_kept_whole():
    grid = Grid("chebyshev", 3)
    with pytest.raises(ValueError, match="drifting"):
        SymmetricTransfer(Drifting(), grid, EDGES, 1e-6)
    transfer = CompressedTransfer(Drifting(), grid, EDGES, 1e-6)
    errors = relative_errors(transfer, grid, 3, transfer_vectors(False))
    assert np.sqrt(np.mean(errors**2)) <= 1e-6


@pytest.mark.parametrize("method", [CompressedTransfer, SymmetricTransfer])
def test_kernel_that_vanishes_gives_nothing(method):
    # so narrow that all far values underflow
    kernel, grid = kernels.gaussian(1e-4), Grid("chebyshev", 3)
    transfer = method(kernel, grid, EDGES, 1e-6)
    assert not result(transfer, 3, random_lists(kernel, 3)).any()


@pytest.mark.parametrize("eps", [0.0, 1.0, -1e-3, float("nan")])
def test_senseless_tolerance_is_refused(eps):
    with pytest.raises(ValueError, match="eps"):
        SymmetricTransfer(kernels.laplace, Grid("chebyshev", 2), EDGES, eps)


# --- ranks and memory --------------------------------------------------------------------------


def test_rank_grows_at_most_as_the_cube_of_the_digits():
    grid, ranks = Grid("chebyshev", 7), []
    for eps in (1e-2, 1e-4, 1e-8):
        transfer = SymmetricTransfer(kernels.laplace, grid, EDGES, eps)
        ranks.append(max(transfer.ranks[0].values()))
    assert ranks[0] < ranks[1] < ranks[2] < grid.nodes**3
    # the rank is that of polynomials in three variables: twice the digits, twice their degree
    assert ranks[1] <= 8 * ranks[0]
    assert ranks[2] <= 8 * ranks[1]


def test_farther_boxes_have_lower_rank():
    transfer = SymmetricTransfer(kernels.laplace, Grid("chebyshev", 6), EDGES, 1e-5)
    ranks = transfer.ranks[0]
    assert len(ranks) == 16
    assert ranks[vector_index([3, 3, 3])] < ranks[vector_index([2, 0, 0])]


def test_rank_does_not_grow_with_the_grid_once_the_kernel_is_resolved():
    ranks = [
        max(SymmetricTransfer(kernels.laplace, Grid("chebyshev", n), EDGES, 1e-3).ranks[0].values())
        for n in (5, 6, 7)
    ]
    assert max(ranks) - min(ranks) <= 2


def test_symmetry_and_compression_save_memory():
    grid, eps = Grid("chebyshev", 5), 1e-4
    dense = DenseTransfer(kernels.laplace, grid, EDGES)
    compressed = CompressedTransfer(kernels.laplace, grid, EDGES, eps)
    symmetric = SymmetricTransfer(kernels.laplace, grid, EDGES, eps)
    assert dense.bytes == 316 * 125**2 * 8
    rank_u, rank_v = compressed.ranks[0]
    assert max(rank_u, rank_v) < 125 / 2
    assert compressed.bytes < (316 * rank_u * rank_v + 125 * (rank_u + rank_v)) * 8
    assert compressed.bytes < dense.bytes / 8
    # 16 of 316 operators, of factors that are smaller than the matrices
    assert symmetric.bytes == sum(2 * 125 * r * 8 for r in symmetric.ranks[0].values())
    assert symmetric.bytes < dense.bytes * 16 / 316 / 2


def test_operators_of_full_rank_are_kept_as_matrices():
    grid = Grid("chebyshev", 3)
    transfer = SymmetricTransfer(kernels.laplace, grid, EDGES, 1e-13)
    assert transfer.bytes == 16 * 27**2 * 8


# --- sums over lists ---------------------------------------------------------------------------


@pytest.mark.parametrize("eps", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("method", [CompressedTransfer, SymmetricTransfer])
def test_field_of_points_errs_by_eps(method, eps):
    """Random charges in the source boxes, values at random points of the target boxes.

    The norm of the operators' errors is the mean square over points of the boxes up to the
    quadrature's error, a factor below 2 at 5 nodes; the charges add independent errors.
    """
    rng = np.random.default_rng(5)
    kernel, grid, boxes, points = kernels.laplace, Grid("chebyshev", 5), 40, 30
    basis = np.array([_basis(grid, rng.uniform(-1, 1, (points, 3))) for _ in range(boxes)])
    charges = rng.standard_normal((boxes, points))
    multipoles = np.einsum("bpa,bp->ba", basis, charges).reshape(boxes, 1, 5, 5, 5)
    lists = (multipoles, *random_lists(kernel, 5, seed=6)[1:])
    true = result(DenseTransfer(kernel, grid, EDGES), 3, lists).reshape(boxes, -1)
    made = result(method(kernel, grid, EDGES, eps), 3, lists).reshape(boxes, -1)
    true, made = (np.einsum("bpa,ba->bp", basis, local) for local in (true, made))
    assert np.linalg.norm(made - true) <= 2.0 * eps * np.linalg.norm(true)


def _basis(grid, x):
    """(points, N) Lagrange polynomials of the grid at points x (points, 3)."""
    vandermonde = np.polynomial.chebyshev.chebvander(grid.points, grid.nodes - 1)
    values = [
        np.polynomial.chebyshev.chebvander(x[:, d], grid.nodes - 1) @ np.linalg.inv(vandermonde)
        for d in range(3)
    ]
    return np.einsum("pa,pb,pc->pabc", *values).reshape(len(x), -1)


def all_transfers(kernel, grid, **options):
    yield DenseTransfer(kernel, grid, EDGES, **options)
    yield CompressedTransfer(kernel, grid, EDGES, 1e-6, **options)
    yield SymmetricTransfer(kernel, grid, EDGES, 1e-6, **options)


def test_result_is_added_and_other_boxes_are_left_alone():
    kernel, grid = kernels.stokeslet, Grid("chebyshev", 3)
    lists = random_lists(kernel, 3)
    multipoles, start, source, vector, targets = lists
    for transfer in all_transfers(kernel, grid):
        once = result(transfer, 3, lists)
        local = np.ones_like(once)
        transfer.add(3, multipoles, start, source, vector, targets, local)
        assert np.allclose(local, 1.0 + once, rtol=1e-13)
        others = np.setdiff1d(np.arange(len(once)), targets)
        assert not once[others].any()


def test_part_of_a_list_gives_the_part_of_the_result():
    kernel, grid = kernels.stokeslet, Grid("chebyshev", 3)
    multipoles, start, source, vector, targets = lists = random_lists(kernel, 3)
    for transfer in all_transfers(kernel, grid):
        whole = result(transfer, 3, lists)
        part = result(transfer, 3, (multipoles, start[4:9], source, vector, targets[4:8]))
        assert np.allclose(part[targets[4:8]], whole[targets[4:8]], rtol=1e-11)


def test_empty_lists_do_nothing():
    kernel, grid = kernels.laplace, Grid("chebyshev", 3)
    none = np.zeros(0, dtype=np.int64)
    multipoles = np.ones((4, 1, 3, 3, 3))
    for transfer in all_transfers(kernel, grid):
        for start, targets in ((np.zeros(1, int), none), (np.zeros(4, int), np.arange(3))):
            lists = (multipoles, start, none, none, targets)
            assert not result(transfer, 3, lists).any()


def test_prepared_pairs_serve_any_weights():
    kernel, grid = kernels.stokeslet, Grid("chebyshev", 3)
    lists = random_lists(kernel, 3)
    for transfer in all_transfers(kernel, grid):
        pairs = transfer.prepare(3, *lists[1:])
        for factor in (1.0, -2.0):
            local = np.zeros((len(lists[0]), 3, 3, 3, 3))
            transfer.apply(pairs, factor * lists[0], local)
            assert np.allclose(local, factor * result(transfer, 3, lists), rtol=1e-13)


def test_threads_do_not_change_the_sums():
    kernel, grid = kernels.stokeslet, Grid("chebyshev", 3)
    lists = random_lists(kernel, 3)
    one, three = all_transfers(kernel, grid), all_transfers(kernel, grid, threads=3)
    for single, threaded in zip(one, three, strict=True):
        expected = result(single, 3, lists)
        # the order of sums is the same; matrix products of other heights may round otherwise
        error = np.abs(result(threaded, 3, lists) - expected).max()
        assert error <= 1e-13 * np.abs(expected).max()


def test_single_precision_keeps_six_digits():
    kernel, grid = kernels.stokeslet, Grid("chebyshev", 3)
    lists = random_lists(kernel, 3)
    expected = result(DenseTransfer(kernel, grid, EDGES), 3, lists)
    for transfer in all_transfers(kernel, grid, dtype=np.float32):
        made = result(transfer, 3, lists)
        assert made.dtype == np.float32
        # rounding of sums of 158 x 81 terms of random sign, plus eps = 1e-6
        assert np.linalg.norm(made - expected) <= 4e-6 * np.linalg.norm(expected)
        assert transfer.bytes < 0.6 * replace_bytes(transfer, kernel, grid)


def replace_bytes(transfer, kernel, grid):
    """Memory of the same transfer in double precision."""
    eps = () if isinstance(transfer, DenseTransfer) else (1e-6,)
    return type(transfer)(kernel, grid, EDGES, *eps).bytes


def test_lengths_and_factors_of_kernels_count():
    grid = Grid("chebyshev", 3)
    kernel = replace(kernels.gaussian(0.4), factor=3.0)
    transfer = SymmetricTransfer(kernel, grid, EDGES, 1e-8)
    assert relative_errors(transfer, grid, 3, transfer_vectors(False)[::17]).max() <= 1e-8


def test_unknown_admissibility_is_refused():
    with pytest.raises(ValueError, match="admissibility"):
        DenseTransfer(kernels.laplace, Grid("chebyshev", 2), EDGES, admissibility="loose")
