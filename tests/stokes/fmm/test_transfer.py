"""Transfers in Fourier space against the matrices of the same nodes.

Tolerances: 1e-13 of the largest local in double (rounding of sums of some 1e4 terms through
transforms of orthogonal columns), 1e-6 in single precision, unless said otherwise.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numba.extending import register_jitable

from stokes.fmm import transfer as module
from stokes.fmm.interpolation import Grid
from stokes.fmm.kernels import Kernel, gaussian, laplace, stokeslet
from stokes.fmm.transfer import FourierTransfer

EDGES = (0.6, 0.3, 0.15, 0.075)
TOLERANCE = {"float64": 1e-13, "float32": 1e-6}


def equispaced(nodes: int, extent: float = 1.0) -> Grid:
    return Grid("equispaced", nodes, extent)


@register_jitable
def _dipole(x, y, z, w):
    r2 = x * x + y * y + z * z + 0.01
    return ((x * w[0] + y * w[1] + z * w[2]) / (r2 * np.sqrt(r2)),)


@register_jitable
def _six_to_three(x, y, z, w):
    s = 1.0 / (x * x + 2.0 * y * y + z * z + 0.01)
    a = s * (w[0] * x + w[1] * y + w[2] * z)
    b = s * s * (w[3] * x * y + w[4] * y * z + w[5] * z * x)
    return a * x + b, a * y + s * w[3], b * z + s * w[4]


@register_jitable
def _lopsided(x, y, z, w):
    return (w[0] / (1.0 + (x - 0.1) ** 2 + y * y + z * z),)


dipole = Kernel("dipole", _dipole, 3, 1, parity=-1)
six_to_three = Kernel("six to three", _six_to_three, 6, 3)
lopsided = Kernel("lopsided", _lopsided, 1, 1)


@pytest.fixture(params=[False, True], ids=["pairs", "families"])
def families(request, monkeypatch):
    """Whether pairs are taken by families of siblings: then always, if dearer as well."""
    if request.param:
        monkeypatch.setattr(module, "_PAIR_COST", np.inf)
        monkeypatch.setattr(module, "_PAIR_COST_SCALAR", np.inf)
    return request.param


def cube_cells(edge: int) -> np.ndarray:
    """All boxes of a level with `edge` boxes per edge, siblings one after another."""
    cells = np.array(list(itertools.product(range(edge), repeat=3)))
    order = np.lexsort([*(cells & 1).T, *(cells >> 1).T])
    return cells[order]


def far_pairs(cells: np.ndarray, *, smooth: bool = False) -> tuple[np.ndarray, ...]:
    """start, source, vector of boxes whose parents touch, without those that touch themselves."""
    d = cells[:, None] - cells
    far = np.abs((cells[:, None] >> 1) - (cells >> 1)).max(axis=-1) <= 1
    if not smooth:
        far &= np.abs(d).max(axis=-1) > 1
    target, source = np.nonzero(far)
    vector = (d[target, source] + 3) @ np.array([49, 7, 1])
    return np.searchsorted(target, np.arange(len(cells) + 1)), source, vector


def dense(kernel, nodes, edge, pairs, multipoles, targets, extent=1.0) -> np.ndarray:
    """Locals of `targets` (numbers of rows) by the matrices of kernel values between the nodes."""
    start, source, vector = pairs
    x = 0.5 * edge * extent * np.linspace(-1.0, 1.0, nodes)
    points = np.array(list(itertools.product(x, repeat=3)))
    matrices, out = {}, np.zeros((len(targets), kernel.n_out, nodes**3))
    for row, t in enumerate(targets):
        for pair in range(start[t], start[t + 1]):
            s, v = source[pair], vector[pair]
            if v not in matrices:
                shift = edge * (np.array([v // 49, v // 7 % 7, v % 7]) - 3)
                r = shift + points[:, None] - points
                k = kernel.matrix(r.reshape(-1, 3)).reshape(
                    nodes**3, nodes**3, *np.shape(kernel.entry)
                )
                matrices[v] = k.transpose(2, 0, 3, 1).reshape(kernel.n_out * nodes**3, -1)
            out[row] += (matrices[v] @ multipoles[s].reshape(-1)).reshape(kernel.n_out, -1)
    return out


def transferred(
    kernel, nodes, level, pairs, multipoles, *, cells=None, dtype="float64", extent=1.0, **options
):
    """Locals of all boxes by the transfer under test."""
    grid = equispaced(nodes, extent=extent)
    transfer = FourierTransfer(kernel, grid, EDGES, dtype=dtype, **options)
    boxes = len(multipoles)
    local = np.zeros((boxes, kernel.n_out, nodes, nodes, nodes), dtype)
    expansions = multipoles.astype(dtype)
    prepared = transfer.prepare(level, *pairs, np.arange(boxes), cells)
    assert (prepared.families is not None) == (cells is not None)
    transfer.apply(prepared, expansions, local)
    return local.reshape(boxes, kernel.n_out, -1)


def random_multipoles(kernel, nodes, boxes, seed=1):
    shape = (boxes, kernel.n_in, nodes, nodes, nodes)
    return np.random.default_rng(seed).standard_normal(shape)


def error(value, exact):
    return np.abs(value - exact).max() / np.abs(exact).max()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("nodes", [2, 3, 4, 5])
@pytest.mark.parametrize("kernel", [laplace, stokeslet], ids=lambda k: k.name)
def test_locals_are_those_of_the_dense_matrices(kernel, nodes, dtype, families):
    cells = cube_cells(6)
    pairs, multipoles = far_pairs(cells), random_multipoles(kernel, nodes, len(cells))
    targets = [0, 1, 30, len(cells) - 1]
    exact = dense(kernel, nodes, EDGES[2], pairs, multipoles, targets)
    local = transferred(
        kernel, nodes, 2, pairs, multipoles, dtype=dtype, cells=cells if families else None
    )
    assert error(local[targets], exact) < TOLERANCE[dtype]


@pytest.mark.parametrize(
    "kernel", [dipole, six_to_three, lopsided, gaussian(0.1)], ids=lambda k: k.name
)
def test_odd_and_rectangular_and_unsymmetric_kernels(kernel, families):
    nodes, cells = 3, cube_cells(6)
    pairs, multipoles = far_pairs(cells), random_multipoles(kernel, nodes, len(cells))
    targets = [0, 77, 215]
    exact = dense(kernel, nodes, EDGES[3], pairs, multipoles, targets)
    local = transferred(kernel, nodes, 3, pairs, multipoles, cells=cells if families else None)
    assert error(local[targets], exact) < TOLERANCE["float64"]


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("kernel", [stokeslet, six_to_three, gaussian(0.1)], ids=lambda k: k.name)
def test_each_transfer_vector_alone(kernel, smooth):
    """One source, and a target for each of the 316 vectors (343 with neighbours and itself)."""
    nodes = 2
    offsets = np.array(list(itertools.product(range(-3, 4), repeat=3)))
    kept = np.ones(343, bool) if smooth else np.abs(offsets).max(axis=1) > 1
    vector = np.flatnonzero(kept)
    assert len(vector) == (343 if smooth else 316)
    pairs = np.arange(len(vector) + 1), np.zeros(len(vector), int), vector
    multipoles = random_multipoles(kernel, nodes, len(vector))
    exact = dense(kernel, nodes, EDGES[3], pairs, multipoles, range(len(vector)))
    admissibility = "smooth" if smooth else "standard"
    local = transferred(kernel, nodes, 3, pairs, multipoles, admissibility=admissibility)
    assert error(local, exact) < TOLERANCE["float64"]


def test_smooth_kernels_take_neighbours_and_the_box_itself(families):
    kernel, nodes, cells = gaussian(0.1), 4, cube_cells(6)
    pairs, multipoles = far_pairs(cells, smooth=True), random_multipoles(gaussian(0.1), 4, 216)
    assert np.diff(pairs[0]).max() == 216
    targets = [0, 100]
    exact = dense(kernel, nodes, EDGES[3], pairs, multipoles, targets)
    local = transferred(
        kernel,
        nodes,
        3,
        pairs,
        multipoles,
        cells=cells if families else None,
        admissibility="smooth",
    )
    assert error(local[targets], exact) < TOLERANCE["float64"]


def test_a_homogeneous_kernel_has_one_table_and_scales_with_the_edge():
    cells, nodes = cube_cells(4), 3
    pairs, multipoles = far_pairs(cells), random_multipoles(stokeslet, nodes, 64)
    coarse = transferred(stokeslet, nodes, 2, pairs, multipoles)
    fine = transferred(stokeslet, nodes, 3, pairs, multipoles)
    # The edge halves: the kernel of degree -1 doubles, to the last bit as the factor is 2.
    np.testing.assert_array_equal(fine, 2.0 * coarse)
    one = FourierTransfer(stokeslet, equispaced(nodes), EDGES[:3]).bytes
    assert FourierTransfer(stokeslet, equispaced(nodes), EDGES).bytes == one
    per_level = FourierTransfer(lopsided, equispaced(nodes), EDGES[:3]).bytes
    assert FourierTransfer(lopsided, equispaced(nodes), EDGES).bytes == 2 * per_level


def test_boxes_scattered_over_a_surface(families):
    """Families with a few children only, and parents with no neighbour in most directions."""
    cells = cube_cells(10)
    radius = np.linalg.norm(cells + 0.5 - 5.0, axis=1)
    cells = cells[np.abs(radius - 4.0) < 0.7]
    pairs, multipoles = far_pairs(cells), random_multipoles(stokeslet, 3, len(cells))
    targets = [0, 50, len(cells) - 1]
    exact = dense(stokeslet, 3, EDGES[3], pairs, multipoles, targets)
    local = transferred(stokeslet, 3, 3, pairs, multipoles, cells=cells if families else None)
    assert error(local[targets], exact) < TOLERANCE["float64"]


@pytest.mark.parametrize("nodes", [4, 8])
def test_frequencies_done_in_turns_do_not_change_locals(families, nodes):
    cells = cube_cells(4)
    pairs, multipoles = far_pairs(cells), random_multipoles(stokeslet, nodes, len(cells))
    exact = dense(stokeslet, nodes, EDGES[2], pairs, multipoles, [0])
    for memory in (1 << 16, 1 << 20, 1 << 23, 1 << 28):
        options = {"cells": cells if families else None, "memory": memory}
        local = transferred(stokeslet, nodes, 2, pairs, multipoles, **options)
        assert error(local[[0]], exact) < TOLERANCE["float64"]


def test_threads_give_the_same_bits(families):
    cells = cube_cells(6)
    pairs, multipoles = far_pairs(cells), random_multipoles(stokeslet, 4, len(cells))
    chosen = cells if families else None
    whole = transferred(stokeslet, 4, 3, pairs, multipoles, cells=chosen)
    threaded = transferred(stokeslet, 4, 3, pairs, multipoles, cells=chosen, threads=2)
    np.testing.assert_array_equal(threaded, whole)


def test_parts_of_the_targets_give_the_same(families):
    cells = cube_cells(6)
    start, source, vector = far_pairs(cells)
    multipoles = random_multipoles(laplace, 4, len(cells))
    chosen = cells if families else None
    transfer = FourierTransfer(laplace, equispaced(4), EDGES)
    whole, parts = (np.zeros((len(cells), 1, 4, 4, 4)) for _ in range(2))
    boxes = np.arange(len(cells))
    transfer.add(3, multipoles, start, source, vector, boxes, whole, chosen)
    for low, high in ((0, 16), (16, 17), (17, 17), (17, 216)):
        few = start[low : high + 1]
        transfer.add(3, multipoles, few, source, vector, boxes[low:high], parts, chosen)
    assert error(parts, whole) < TOLERANCE["float64"]


def test_families_are_taken_where_they_are_full():
    transfer = FourierTransfer(stokeslet, equispaced(3), EDGES)
    cells = cube_cells(8)
    full = transfer.prepare(3, *far_pairs(cells), np.arange(len(cells)), cells)
    assert full.families is not None
    lower = cells[cells.sum(axis=1) % 4 == 0]
    pairs = far_pairs(lower)
    sparse = transfer.prepare(3, *pairs, np.arange(len(lower)), lower)
    assert sparse.families is None


def test_pairs_that_are_not_all_between_two_families_are_taken_one_by_one():
    cells = cube_cells(6)
    start, source, vector = far_pairs(cells)
    kept = np.ones(len(source), bool)
    kept[start[20]] = False
    count = np.concatenate([[0], np.cumsum(kept)])
    pairs = count[start], source[kept], vector[kept]
    transfer = FourierTransfer(laplace, equispaced(3), EDGES)
    prepared = transfer.prepare(3, *pairs, np.arange(len(cells)), cells)
    assert prepared.families is None
    multipoles, local = random_multipoles(laplace, 3, 216), np.zeros((216, 1, 3, 3, 3))
    transfer.apply(prepared, multipoles, local)
    exact = dense(laplace, 3, EDGES[3], pairs, multipoles, [20])
    assert error(local[20].reshape(1, -1), exact[0]) < TOLERANCE["float64"]


def test_locals_are_added_to_and_prepared_pairs_can_be_used_again():
    cells = cube_cells(4)
    pairs, multipoles = far_pairs(cells), random_multipoles(laplace, 3, 64)
    transfer = FourierTransfer(laplace, equispaced(3), EDGES)
    prepared = transfer.prepare(2, *pairs, np.arange(64), cells)
    local = np.zeros((64, 1, 3, 3, 3))
    transfer.apply(prepared, multipoles, local)
    once = local.copy()
    transfer.apply(prepared, multipoles, local)
    np.testing.assert_allclose(local, 2.0 * once, rtol=1e-14)


@pytest.mark.parametrize("extent", [0.8, 1.1])
def test_grids_shorter_and_longer_than_the_box(extent):
    pairs, multipoles = far_pairs(cube_cells(4)), random_multipoles(laplace, 4, 64)
    exact = dense(laplace, 4, EDGES[2], pairs, multipoles, [0, 40], extent)
    local = transferred(laplace, 4, 2, pairs, multipoles, extent=extent)
    assert error(local[[0, 40]], exact) < TOLERANCE["float64"]


def test_nothing_to_transfer():
    transfer = FourierTransfer(stokeslet, equispaced(3), EDGES)
    none = np.empty(0, dtype=np.int64)
    for boxes in (0, 1):
        local = np.zeros((boxes, 3, 3, 3, 3))
        transfer.add(2, local, np.zeros(boxes + 1, int), none, none, np.arange(boxes), local)
        assert not local.any()
    assert FourierTransfer(stokeslet, equispaced(3), EDGES[:1]).bytes == 0


def test_one_pair():
    multipoles = random_multipoles(stokeslet, 3, 1)
    pairs = np.array([0, 1]), np.array([0]), np.array([6 * 49 + 3 * 7 + 3])
    exact = dense(stokeslet, 3, EDGES[2], pairs, multipoles, [0])
    assert error(transferred(stokeslet, 3, 2, pairs, multipoles), exact) < TOLERANCE["float64"]


@pytest.mark.parametrize(
    ("grid", "options", "message"),
    [
        (Grid("chebyshev", 4), {}, "equispaced"),
        (equispaced(1), {}, "nodes = 1"),
        (equispaced(4), {"admissibility": "weak"}, "admissibility"),
    ],
)
def test_senseless_requests_are_refused(grid, options, message):
    with pytest.raises(ValueError, match=message):
        FourierTransfer(laplace, grid, EDGES, **options)


def test_arrays_of_another_precision_are_refused():
    transfer = FourierTransfer(laplace, equispaced(2), EDGES, dtype=np.float32)
    pairs = np.array([0, 1]), np.array([0]), np.array([0])
    array = np.zeros((1, 1, 2, 2, 2))
    with pytest.raises(TypeError, match="float32"):
        transfer.add(2, array, *pairs, np.arange(1), array)
