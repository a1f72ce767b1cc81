"""Arrays of steps, bodies and components as tensors of many small dimensions."""

from __future__ import annotations

import math
from itertools import permutations, product

import numpy as np
import pytest

from compress.tensorize import (
    AXES,
    Tensorisation,
    levels,
    morton_order,
    train_parameters,
    unfolding_ranks,
)

FORMS = ("matrix", "natural", "tensorised")
ORDERS = tuple(permutations(AXES))


def random_field(lengths, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(lengths)


def test_levels_are_the_smallest_smooth_cover():
    for length in range(1, 700):
        smooth = next(m for m in range(length, 2 * length + 1) if largest_prime(m) <= 5)
        assert math.prod(levels(length)) == smooth
        assert math.prod(levels(length, 2)) == 1 << (length - 1).bit_length()


def largest_prime(number: int) -> int:
    found = 1
    for prime in range(2, number + 1):
        while number % prime == 0:
            number, found = number // prime, prime
    return found


def test_covers_waste_little():
    waste = {
        low: max(math.prod(levels(n)) / n for n in range(low, 4 * low)) for low in (100, 10**4)
    }
    assert waste[100] <= 1.11
    assert waste[10**4] <= 1.05


def test_powers_of_two_split_into_binary_levels():
    assert levels(16384) == (2,) * 14
    assert levels(1) == ()
    chunk = Tensorisation.of((32, 16384, 3))
    assert chunk.shape == (2,) * 19 + (3,)


@pytest.mark.parametrize("length", [0, -3])
def test_lengths_below_one_are_refused(length):
    with pytest.raises(ValueError, match="at least 1"):
        levels(length)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("order", ORDERS, ids="-".join)
@pytest.mark.parametrize("lengths", [(1, 1, 1), (4, 8, 3), (7, 13, 1), (1, 97, 3), (11, 1, 4)])
def test_backward_undoes_forward(form, order, lengths):
    field = random_field(lengths)
    split = Tensorisation.of(lengths, form, order)
    tensor = split.forward(field)
    assert tensor.shape == split.shape
    assert tensor.flags.c_contiguous
    np.testing.assert_array_equal(split.backward(tensor), field)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("order", ORDERS, ids="-".join)
def test_every_entry_is_where_locate_says(form, order):
    lengths = (5, 7, 3)
    field = random_field(lengths)
    split = Tensorisation.of(lengths, form, order)
    tensor = split.forward(field)
    entries = np.array(list(product(*map(range, lengths))))
    found = tensor[tuple(split.locate(*entries.T).T)]
    np.testing.assert_array_equal(found, field.ravel())


def test_index_is_the_row_major_one_of_its_levels():
    split = Tensorisation.of((1, 16, 1))
    for level in range(1, 5):
        # The first levels count blocks of 2^(4 - level) bodies, coarsest level first.
        digits = split.digits("bodies", np.arange(16))[:, :level]
        block = digits @ (2 ** np.arange(level - 1, -1, -1))
        np.testing.assert_array_equal(block, np.arange(16) // 2 ** (4 - level))


def test_digits_stand_in_the_dimensions_of_their_axis():
    split = Tensorisation.of((12, 30, 3), order=("components", "steps", "bodies"))
    step, body, component = 7, 29, 2
    index = split.locate(step, body, component)[0]
    for axis, entry in zip(AXES, (step, body, component), strict=True):
        np.testing.assert_array_equal(index[split.dimensions(axis)], split.digits(axis, entry)[0])


@pytest.mark.parametrize("entry", [(5, 0, 0), (0, 7, 0), (0, 0, 3), (-1, 0, 0)])
def test_entries_outside_are_refused(entry):
    with pytest.raises(ValueError, match="must be within"):
        Tensorisation.of((5, 7, 3)).locate(*entry)


def test_repeated_entries_add_no_error():
    field = random_field((7, 13, 3))
    split = Tensorisation.of(field.shape)
    tensor = split.forward(field)
    noise = random_field(tensor.shape, seed=1)
    error = split.backward(tensor + noise) - field
    assert np.linalg.norm(error) <= np.linalg.norm(noise)


def test_wrong_shapes_are_refused():
    split = Tensorisation.of((4, 8, 3))
    with pytest.raises(ValueError, match="must be"):
        split.forward(np.zeros((8, 4, 3)))
    with pytest.raises(ValueError, match="must be"):
        split.backward(np.zeros((4, 8, 3)))
    with pytest.raises(ValueError, match="do not cover"):
        Tensorisation((4, 9, 3), ((2, 2), (2, 2, 2), (3,)))


def test_morton_order_keeps_neighbours_together():
    corner = np.array(list(product((0.1, 0.6), repeat=3)))
    position = np.repeat(corner, 5, axis=0) + 0.01 * random_field((40, 3))
    shuffled = np.random.default_rng(2).permutation(40)
    order = morton_order(position[shuffled], origin=(0, 0, 0), edge=1.0)
    octant = (shuffled[order] // 5).reshape(8, 5)
    assert (octant == octant[:, :1]).all()
    # Of the corner list z runs fastest, of Morton keys x.
    np.testing.assert_array_equal(octant[:, 0], [0, 4, 2, 6, 1, 5, 3, 7])


def test_morton_order_defaults_to_the_cube_around_the_bodies():
    position = 3.0 + random_field((100, 3))
    cube = np.ptp(position, axis=0).max()
    expected = morton_order(position, position.min(axis=0), cube)
    np.testing.assert_array_equal(morton_order(position), expected)
    np.testing.assert_array_equal(morton_order(np.ones((4, 3))), np.arange(4))
    assert morton_order(np.empty((0, 3))).dtype == np.int32


def test_morton_order_names_a_body_without_position():
    position = random_field((9, 3))
    position[4, 1] = math.nan
    with pytest.raises(ValueError, match="body 4"):
        morton_order(position)


def canonical(rank: int, shape, seed: int = 0) -> np.ndarray:
    """A sum of `rank` products of random vectors: every unfolding has that rank."""
    rng = np.random.default_rng(seed)
    tensor = np.zeros(shape)
    for _ in range(rank):
        part = np.ones(())
        for n in shape:
            part = np.multiply.outer(part, rng.standard_normal(n))
        tensor += part
    return tensor


@pytest.mark.parametrize("tolerance", [1e-3, 1e-9])
@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e300])
def test_unfolding_ranks_of_a_sum_of_products(tolerance, scale):
    tensor = scale * canonical(3, (6, 5, 4, 7))
    assert unfolding_ranks(tensor, tolerance) == (3, 3, 3)


def test_unfolding_ranks_of_nothing_and_of_noise():
    assert unfolding_ranks(np.zeros((4, 4, 4)), 1e-2) == (0, 0)
    assert unfolding_ranks(random_field((4, 4, 4)), 1e-3) == (4, 4)


def test_parameters_of_a_train():
    # S. De, PhD thesis, University of Michigan 2021, eq. 4.30
    assert train_parameters((4, 5, 6), (2, 3)) == 1 * 4 * 2 + 2 * 5 * 3 + 3 * 6 * 1
