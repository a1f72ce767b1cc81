"""Morton keys against a bit-by-bit twin, and the octree they number."""

from __future__ import annotations

import numpy as np
import pytest

from dem_mpi import morton

ORIGIN, EDGE = np.array([-1.0, 2.0, 0.5]), 3.0


def twin_key(cell: tuple[int, int, int]) -> int:
    """The key by its definition: bit 3b + a is bit b of axis a."""
    return sum(
        (cell[axis] >> bit & 1) << (3 * bit + axis)
        for bit in range(morton.LEVELS)
        for axis in range(3)
    )


def centres(cell: np.ndarray) -> np.ndarray:
    return ORIGIN + (cell + 0.5) * (EDGE / morton.LATTICE_SIZE)


def random_cells(count: int, seed: int) -> np.ndarray:
    cells = np.random.default_rng(seed).integers(0, morton.LATTICE_SIZE, (count, 3))
    corners = np.array(np.meshgrid(*[[0, morton.LATTICE_SIZE - 1]] * 3)).reshape(3, -1).T
    return np.concatenate((cells, corners))


@pytest.mark.parametrize("seed", [1, 2])
def test_key_equals_bit_by_bit_twin(seed):
    cells = random_cells(500, seed)
    expected = [twin_key(tuple(map(int, cell))) for cell in cells]
    assert morton.encode(centres(cells), ORIGIN, EDGE).tolist() == expected


def test_decode_inverts_encode():
    cells = random_cells(1000, 3)
    assert np.array_equal(morton.decode(morton.encode(centres(cells), ORIGIN, EDGE)), cells)


def test_keys_fill_63_bits_and_stay_positive():
    ends = np.array([ORIGIN, ORIGIN + EDGE * (1 - 1e-9)])
    assert morton.encode(ends, ORIGIN, EDGE).tolist() == [0, 2**63 - 1]


@pytest.mark.parametrize("level", [1, 2, 7, 20])
def test_octree_cell_holds_one_range_of_keys(level):
    cells = random_cells(500, level)
    # Crowd them, so that cells of fine levels are shared.
    cells[250:500] = cells[:250] ^ np.random.default_rng(0).integers(0, 4, (250, 3))
    cell_number = morton.encode(centres(cells), ORIGIN, EDGE) >> 3 * (morton.LEVELS - level)
    parents, same_cell = np.unique(cells >> (morton.LEVELS - level), axis=0, return_inverse=True)
    _, same_number = np.unique(cell_number, return_inverse=True)
    same_cell, same_number = same_cell.ravel(), same_number.ravel()
    assert len(np.unique(same_number)) == len(parents)
    assert len(np.unique(np.stack((same_cell, same_number)), axis=1).T) == len(parents)


def test_point_outside_gets_key_of_nearest_cell():
    outside = np.random.default_rng(4).uniform(-20.0, 20.0, (500, 3))
    nearest = np.clip(outside, ORIGIN, ORIGIN + EDGE * (1 - 1e-12))
    keys = morton.encode(outside, ORIGIN, EDGE)
    assert np.array_equal(keys, morton.encode(nearest, ORIGIN, EDGE))


def test_infinite_coordinates_go_to_the_faces_and_nan_to_the_lower_one():
    points = np.array([[np.inf, -np.inf, np.nan]])
    assert morton.decode(morton.encode(points, ORIGIN, EDGE)).tolist() == [[2**21 - 1, 0, 0]]


def test_lattice_coordinate_never_falls_as_position_grows():
    # Around every lattice plane, where rounding could reverse neighbours.
    planes = ORIGIN[0] + np.arange(1000) * (EDGE / morton.LATTICE_SIZE)
    x = np.sort(np.concatenate([np.nextafter(planes, -9), planes, np.nextafter(planes, 9)]))
    points = np.column_stack((x, np.full_like(x, ORIGIN[1]), np.full_like(x, ORIGIN[2])))
    assert np.all(np.diff(morton.decode(morton.encode(points, ORIGIN, EDGE))[:, 0]) >= 0)


def test_no_points_have_no_keys():
    assert morton.encode(np.empty((0, 3)), ORIGIN, EDGE).shape == (0,)
    assert morton.decode(np.empty(0, np.int64)).shape == (0, 3)
