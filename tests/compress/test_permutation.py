"""Permutations coded against the ones before."""

from __future__ import annotations

import math

import numpy as np
import pytest

from compress._kernels_permutation import displacements, from_displacements
from compress.permutation import check, decode, encode
from compress.tensorize import morton_order

HEAD = 5  # checksum and kind


def random_order(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).permutation(n)


def raw_bytes(n: int) -> int:
    return math.ceil(n * math.ceil(math.log2(n)) / 8) if n > 1 else 0


def gas(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the unit cube and velocities of free particles."""
    rng = np.random.default_rng(seed)
    return rng.random((n, 3)), rng.standard_normal((n, 3))


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5, 64, 1000])
def test_any_permutation_comes_back(n):
    previous = random_order(n, seed=1)
    for order in (np.arange(n), np.arange(n)[::-1], random_order(n, seed=2), previous):
        np.testing.assert_array_equal(decode(encode(order), n), order)
        np.testing.assert_array_equal(decode(encode(order, previous), n, previous), order)


def test_an_unchanged_order_costs_five_bytes():
    order = random_order(16384)
    assert len(encode(order, order)) == HEAD


@pytest.mark.parametrize("n", [2, 3, 17, 1000, 16384])
@pytest.mark.parametrize("seed", range(3))
def test_a_random_permutation_costs_no_more_than_its_numbers(n, seed):
    coded = encode(random_order(n, seed), random_order(n, seed + 10))
    assert len(coded) <= HEAD + raw_bytes(n)


def test_morton_orders_of_slow_bodies_cost_in_proportion_to_the_motion():
    position, velocity = gas(4096)
    order = morton_order(position, (0, 0, 0), 1.0)
    sizes = []
    for moved in (1e-5, 1e-4, 1e-3, 1e-2):
        later = morton_order(position + moved * velocity, (0, 0, 0), 1.0)
        coded = encode(later, order)
        np.testing.assert_array_equal(decode(coded, len(order), order), later)
        sizes.append(len(coded))
    assert sizes == sorted(sizes)
    assert sizes[0] < raw_bytes(4096) / 30
    assert sizes[2] < raw_bytes(4096) / 2


def test_few_bodies_that_jump_far_cost_few_bytes():
    n, jumps = 4096, 10
    order = np.arange(n)
    jumping = np.random.default_rng(4).choice(n, jumps, replace=False)
    stay = np.delete(order, jumping)
    later = np.insert(stay, np.random.default_rng(5).integers(0, len(stay), jumps), jumping)
    # About log2 n bits for which and as many for where to, and something for the tables.
    assert len(encode(later, order)) <= HEAD + 8 * jumps + 40


def slow_displacements(sequence, from_last: bool) -> list[int]:
    unused = sorted(sequence)
    places, start = [], 0
    for number in sequence:
        below = unused.index(number)
        places.append(below - start)
        unused.remove(number)
        if from_last:
            start = below
    return places


@pytest.mark.parametrize("from_last", [False, True])
@pytest.mark.parametrize("n", [0, 1, 2, 7, 100])
def test_places_agree_with_counting_in_a_list(n, from_last):
    sequence = random_order(n, seed=n)
    places = displacements(sequence, from_last)
    assert places.tolist() == slow_displacements(sequence.tolist(), from_last)
    np.testing.assert_array_equal(from_displacements(places, from_last), sequence)


@pytest.mark.parametrize("place", [-1, 4, 2**62, -(2**63)])
def test_places_beyond_the_numbers_left_give_no_permutation(place):
    assert len(from_displacements(np.array([0, 0, place, 0]), False)) == 0


@pytest.mark.parametrize(
    "wrong",
    [[0, 0], [1, 2], [-1, 0], [0.0, 1.0], [[0, 1]], 3, [0, 2**63]],
    ids=["twice", "beyond", "negative", "real", "matrix", "number", "huge"],
)
def test_what_is_no_permutation_is_refused(wrong):
    with pytest.raises(ValueError, match="permutation"):
        check(np.array(wrong))
    with pytest.raises(ValueError, match="permutation"):
        encode(np.array(wrong))


def test_a_missing_number_is_named():
    with pytest.raises(ValueError, match="3 is missing"):
        check([0, 1, 2, 2])


def test_other_lengths_and_predecessors_are_refused():
    order, previous = random_order(50), random_order(50, seed=1)
    coded = encode(order, previous)
    with pytest.raises(ValueError, match="50 numbers"):
        encode(order, random_order(49))
    for n, before in ((50, order), (50, None), (49, previous[previous < 49]), (51, None)):
        with pytest.raises(ValueError, match="coded"):
            decode(coded, n, before)
    with pytest.raises(ValueError, match="checksum"):
        decode(encode(order, order), 50, previous)


@pytest.mark.parametrize("later", ["same", "near", "random"])
def test_every_damaged_byte_is_noticed(later):
    n = 40
    previous = random_order(n)
    order = {"same": previous, "near": np.roll(previous, 3), "random": random_order(n, 1)}[later]
    coded = encode(order, previous)
    for at in range(len(coded)):
        for flip in (1, 0x10, 0xFF):
            damaged = bytearray(coded)
            damaged[at] ^= flip
            decode_or_refuse(bytes(damaged), previous, order)
    for length in range(len(coded)):
        with pytest.raises(ValueError):
            decode(coded[:length], n, previous)
    with pytest.raises(ValueError):
        decode(coded + b"\0", n, previous)


def decode_or_refuse(data: bytes, previous: np.ndarray, order: np.ndarray) -> None:
    """Padding of the code may change without harm; nothing else may pass."""
    try:
        found = decode(data, len(order), previous)
    except ValueError:
        return
    np.testing.assert_array_equal(found, order)
