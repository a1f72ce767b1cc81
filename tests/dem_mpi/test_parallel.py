"""Exchanges between ranks: reductions, sparse messages, blocks, errors, halos."""

from __future__ import annotations

import gc
import threading

import numpy as np
import pytest

from mpi4py import MPI

import dem_mpi.parallel
from dem_mpi.errors import DataError, InputError
from dem_mpi.parallel import Halo, Parallel

from launch import run_ranks

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])


@pytest.fixture
def small_chunks(monkeypatch):
    """Messages cut into pieces of 7 bytes, as messages above 1 GiB are cut."""
    monkeypatch.setattr(dem_mpi.parallel, "_CHUNK", 7)


# ---- reductions ----------------------------------------------------------------------------


@ranks_1_2_3_8
def test_reductions_of_numbers_and_arrays(parallel):
    ranks = np.arange(parallel.size)
    assert parallel.sum(parallel.rank) == ranks.sum()
    assert parallel.max(float(parallel.rank)) == parallel.size - 1.0
    assert parallel.min(parallel.rank + 3) == 3
    assert isinstance(parallel.sum(1), int) and isinstance(parallel.sum(1.0), float)
    array = np.array([[parallel.rank, -parallel.rank]], dtype=np.int32)
    assert parallel.max(array).tolist() == [[parallel.size - 1, 0]]
    assert array.tolist() == [[parallel.rank, -parallel.rank]]  # not overwritten
    assert parallel.allgather(array).tolist() == [[[r, -r]] for r in ranks]
    assert parallel.allgather(np.float64(parallel.rank)).tolist() == ranks.tolist()


@ranks_1_2_3_8
def test_flags_are_counted_and_combined(parallel):
    mine = parallel.rank == parallel.size - 1
    assert parallel.any(mine) is True
    assert parallel.any(False) is False
    assert parallel.sum(True) == parallel.size
    assert parallel.sum(np.array([True, mine])).tolist() == [parallel.size, 1]


@ranks_1_2_3_8
def test_counts_beyond_32_bits_stay_exact(parallel):
    count = 3_000_000_000
    assert parallel.sum(count) == parallel.size * count
    assert parallel.exclusive_sum(count + 1) == parallel.rank * (count + 1)
    narrow = np.full(2, 2**31 - 1, dtype=np.int32)
    assert parallel.sum(narrow).tolist() == [parallel.size * (2**31 - 1)] * 2
    assert parallel.sum(np.int32(2**31 - 1)) == parallel.size * (2**31 - 1)
    wide = np.array([count])
    parallel.sum_in_place(wide)
    assert wide[0] == parallel.size * count


@ranks_1_2_3_8
def test_in_place_reductions_match_the_others(parallel):
    values = np.random.default_rng(parallel.rank).normal(size=5)
    largest, total = values.copy(), values.copy()
    parallel.max_in_place(largest)
    parallel.sum_in_place(total)
    assert np.array_equal(largest, parallel.max(values))
    assert np.array_equal(total, parallel.sum(values))


@ranks_1_2_3_8
def test_objects_reach_all_ranks_and_the_root(parallel):
    last = parallel.size - 1
    assert parallel.broadcast({"from": parallel.rank}, root=last) == {"from": last}
    gathered = parallel.gather(str(parallel.rank), root=last)
    expected = [str(r) for r in range(parallel.size)]
    assert gathered == (expected if parallel.rank == last else None)


# ---- sparse messages -----------------------------------------------------------------------


def random_messages(size: int, seed: int, largest: int) -> list[dict[int, bytes]]:
    """What each rank sends: random receivers (also itself or none), lengths from 0 up."""
    rng = np.random.default_rng(seed)
    return [
        {
            int(r): rng.bytes(int(rng.integers(0, largest)) if rng.random() < 0.8 else 0)
            for r in rng.permutation(size)[: rng.integers(0, size + 1)]
        }
        for _ in range(size)
    ]


def check_exchange(parallel: Parallel, sent: list[dict[int, bytes]]) -> None:
    received = parallel.exchange(sent[parallel.rank])
    expected = {r: m[parallel.rank] for r, m in enumerate(sent) if parallel.rank in m}
    assert received == expected
    assert list(received) == sorted(received)


@ranks_1_2_3_8
def test_messages_arrive_whole_over_many_rounds(parallel):
    for seed in range(150):
        check_exchange(parallel, random_messages(parallel.size, seed, largest=300))


@ranks_1_2_3_8
@pytest.mark.parametrize(
    "pattern",
    ["nobody sends", "to itself", "all to all", "one to all", "all to one", "ring"],
)
@pytest.mark.parametrize("length", [0, 1, 100_000])
def test_messages_of_every_pattern(parallel, pattern, length):
    size = parallel.size
    receivers = {
        "nobody sends": lambda r: [],
        "to itself": lambda r: [r],
        "all to all": lambda r: range(size),
        "one to all": lambda r: range(size) if r == size - 1 else [],
        "all to one": lambda r: [0],
        "ring": lambda r: [(r + 1) % size],
    }[pattern]
    check_exchange(
        parallel, [{to: bytes([r]) * length for to in receivers(r)} for r in range(size)]
    )


@ranks_1_2_3_8
def test_big_messages_arrive_whole(parallel):
    check_exchange(parallel, random_messages(parallel.size, seed=1, largest=4_000_000))


@ranks_1_2_3_8
def test_messages_longer_than_one_call_can_take(parallel, small_chunks):
    for seed in range(20):
        check_exchange(parallel, random_messages(parallel.size, seed, largest=100))


@ranks_1_2_3_8
def test_groups_of_the_same_ranks_do_not_take_each_others_messages(parallel):
    others = [Parallel(), Parallel(parallel.communicator)]
    for seed in range(30):
        for group in (parallel, *others):
            check_exchange(group, random_messages(parallel.size, seed, largest=50))
    for group in others:
        group.free()


def test_communicator_of_a_group_of_one_ends_with_it():
    group = Parallel.alone()
    communicator = group.communicator
    del group
    gc.collect()
    assert communicator == MPI.COMM_NULL
    Parallel.alone().free()


@ranks_1_2_3_8
def test_messages_to_other_ranks_are_counted_with_their_bytes(parallel):
    before = np.array([parallel.bytes_sent, parallel.messages_sent])
    parallel.exchange(dict.fromkeys(range(parallel.size), b"12345"))
    halo = Halo.build(parallel, 2, {r: np.array([1]) for r in range(parallel.size)})
    build = 8 * (parallel.size - 1)  # one number a receiver
    values = np.zeros((2 + parallel.size, 3))
    halo.forward(values)
    halo.reverse_add(values)
    sent = np.array([parallel.bytes_sent, parallel.messages_sent]) - before
    row = 3 * 8
    assert sent.tolist() == [(5 + 2 * row) * (parallel.size - 1) + build, 4 * (parallel.size - 1)]


# ---- blocks --------------------------------------------------------------------------------


def block_of(rank: int, dtype: type) -> np.ndarray:
    """Rank 1 and every fifth hold nothing."""
    rows = 0 if rank % 5 == 1 else 10 + rank
    return np.random.default_rng(rank).integers(0, 2, (rows, 3)).astype(dtype)


@ranks_1_2_3_8
@pytest.mark.parametrize("dtype", [np.float64, np.int32, np.bool_])
def test_blocks_come_to_the_root_in_rank_order(parallel, dtype, small_chunks):
    blocks = list(parallel.blocks_on_root(block_of(parallel.rank, dtype)))
    assert len(blocks) == (parallel.size if parallel.rank == 0 else 0)
    for rank, block in enumerate(blocks):
        assert block.dtype == dtype
        assert np.array_equal(block, block_of(rank, dtype))


@ranks_1_2_3_8
@pytest.mark.parametrize("stop_after", [1, 2])
def test_root_that_stops_early_leaves_nobody_waiting(parallel, stop_after):
    # 4 MB: beyond what MPI sends without a receiver.
    mine = np.full(500_000, float(parallel.rank))
    for _ in range(2):
        error = None
        try:
            for number, _block in enumerate(parallel.blocks_on_root(mine), start=1):
                if number == stop_after:
                    raise OSError("disk full")
        except OSError as caught:
            error = caught
        if parallel.size >= stop_after:
            with pytest.raises(OSError, match="disk full"):
                parallel.raise_together(error)
    assert parallel.sum(1) == parallel.size


# ---- errors --------------------------------------------------------------------------------


class TwoArgumentsError(InputError):
    """Its constructor's arguments are not its `args`: plain pickling fails to load it."""

    def __init__(self, key: str, rule: str) -> None:
        super().__init__(f"{key}: {rule}")


class WithLockError(DataError):
    """It holds what cannot be pickled."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.lock = threading.Lock()


def local_type_error() -> Exception:
    class LocalError(DataError):
        pass

    return LocalError("of a local type")


@ranks_1_2_3_8
def test_no_error_passes(parallel):
    parallel.raise_together(None)


@ranks_1_2_3_8
@pytest.mark.parametrize(
    "error",
    [
        ValueError("radius = -1: must be > 0"),
        KeyError("radius"),
        FileNotFoundError(2, "No such file or directory", "bodies.csv"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
        InputError("scene.yaml:3: unknown key"),
        TwoArgumentsError("radius", "must be > 0"),
        WithLockError("file is damaged"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_error_of_one_rank_keeps_its_type_text_and_exit_code_on_all(parallel, error):
    failing = parallel.size // 2
    with pytest.raises(type(error)) as caught:
        parallel.raise_together(error if parallel.rank == failing else None)
    assert type(caught.value) is type(error)
    assert str(caught.value) == str(error)
    assert getattr(caught.value, "exit_code", None) == getattr(error, "exit_code", None)
    assert (caught.value is error) == (parallel.rank == failing)


@ranks_1_2_3_8
def test_error_of_a_type_others_cannot_know_keeps_text_and_exit_code(parallel):
    with pytest.raises(Exception, match="of a local type") as caught:
        parallel.raise_together(local_type_error() if parallel.rank == 0 else None)
    assert caught.value.exit_code == DataError.exit_code
    if parallel.rank:
        assert "LocalError" in str(caught.value)


@ranks_1_2_3_8
def test_error_of_the_lowest_rank_is_raised(parallel):
    raising = [r for r in range(parallel.size) if r >= parallel.size // 2]
    with pytest.raises(ValueError) as caught:
        parallel.raise_together(
            ValueError(f"rank {parallel.rank}") if parallel.rank in raising else None
        )
    assert str(caught.value) == f"rank {raising[0]}"


FAILING_RANK = """
from dem_mpi.parallel import Parallel
from dem_mpi.errors import DataError
parallel = Parallel()
parallel.install_abort_hook()
if parallel.rank == parallel.size - 1:
    raise {error}
parallel.sum(1)
"""


@pytest.mark.parametrize(
    ("error", "code"), [("ValueError('broken here')", 70), ("DataError('broken here')", 65)]
)
def test_uncaught_error_on_one_rank_ends_all_with_its_message(error, code):
    done = run_ranks(3, ["-c", FAILING_RANK.format(error=error)], timeout=60)
    assert done.returncode == code
    assert "on rank 2 of 3: broken here" in done.stderr


# ---- halo ----------------------------------------------------------------------------------


class Reference:
    """A halo known to every rank: who sends which rows to whom, drawn from one seed."""

    def __init__(self, size: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.owned = [int(n) for n in rng.integers(0, 30, size)]
        self.owned[size // 2] = 0  # a rank without bodies
        self.send = [
            {
                to: np.flatnonzero(rng.random(self.owned[source]) < 0.4)
                for to in range(size)
                if to != source and rng.random() < 0.7
            }
            for source in range(size)
        ]

    def ghosts(self, rank: int) -> list[tuple[int, int]]:
        """(owner, row) of each ghost of `rank`, in the order promised."""
        return [
            (source, int(row))
            for source, messages in enumerate(self.send)
            for row in messages.get(rank, [])
        ]

    def keep(self, marks: list[np.ndarray]) -> None:
        """Drop the ghosts that a rank's marks leave out."""
        for rank, mark in enumerate(marks):
            kept = {pair for pair, wanted in zip(self.ghosts(rank), mark, strict=True) if wanted}
            for source, messages in enumerate(self.send):
                if rank in messages:
                    rows = [row for row in messages[rank] if (source, int(row)) in kept]
                    messages[rank] = np.array(rows, dtype=np.int64)

    def build(self, parallel: Parallel) -> Halo:
        return Halo.build(parallel, self.owned[parallel.rank], self.send[parallel.rank])


def owned_values(reference: Reference, rank: int, row_shape: tuple, dtype: type) -> np.ndarray:
    rng = np.random.default_rng([rank, len(row_shape)])
    return (rng.normal(size=(reference.owned[rank], *row_shape)) * 1e6).astype(dtype)


def check_halo(parallel: Parallel, reference: Reference, halo: Halo) -> None:
    ghosts = reference.ghosts(parallel.rank)
    owned = reference.owned[parallel.rank]
    assert (halo.owned, halo.ghosts) == (owned, len(ghosts))
    for row_shape, dtype in [((), np.int64), ((3,), np.float64), ((6,), np.float64)] * 2:
        everyone = [owned_values(reference, r, row_shape, dtype) for r in range(parallel.size)]
        mine = everyone[parallel.rank]
        local = np.concatenate((mine, np.zeros((len(ghosts), *row_shape), dtype)))
        halo.forward(local)
        expected = [mine[i] for i in range(owned)] + [everyone[s][row] for s, row in ghosts]
        assert np.array_equal(local, np.array(expected, dtype).reshape(local.shape))

        local[owned:] *= parallel.rank + 2
        before = local.copy()
        halo.reverse_add(local)
        total = mine.copy()
        for receiver in range(parallel.size):  # the promised order of the sum
            rows = reference.send[parallel.rank].get(receiver, [])
            for row in rows:
                total[row] += mine[row] * (receiver + 2)
        assert np.array_equal(local[:owned], total)
        assert np.array_equal(local[owned:], before[owned:])


@ranks_1_2_3_8
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_halo_moves_rows_forward_and_adds_them_back_as_in_series(parallel, seed):
    reference = Reference(parallel.size, seed)
    check_halo(parallel, reference, reference.build(parallel))


@ranks_1_2_3_8
@pytest.mark.parametrize("fraction", [0.0, 0.3, 1.0])
def test_pruned_halo_holds_the_marked_ghosts_alone(parallel, fraction):
    reference = Reference(parallel.size, seed=4)
    halo = reference.build(parallel)
    rng = np.random.default_rng(5)
    marks = [rng.random(len(reference.ghosts(r))) < fraction for r in range(parallel.size)]
    pruned = halo.keep(marks[parallel.rank])
    check_halo(parallel, reference, halo)
    reference.keep(marks)
    check_halo(parallel, reference, pruned)


@ranks_1_2_3_8
def test_halos_used_by_turns_do_not_mix(parallel):
    references = [Reference(parallel.size, seed) for seed in (6, 7)]
    halos = [reference.build(parallel) for reference in references]
    for _ in range(3):
        for reference, halo in zip(references, halos, strict=True):
            check_halo(parallel, reference, halo)


@ranks_1_2_3_8
def test_halo_without_ghosts_sends_nothing(parallel):
    halo = Halo.build(parallel, 3, {})
    before = parallel.bytes_sent
    values = np.arange(3.0)
    halo.forward(values)
    halo.reverse_add(values)
    assert values.tolist() == [0, 1, 2] and halo.ghosts == 0
    assert halo.keep(np.zeros(0, bool)).ghosts == 0
    assert parallel.bytes_sent == before
