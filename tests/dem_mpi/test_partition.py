"""Splitters against a serial sort, migration bit for bit, ghosts against brute force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dem_mpi import morton
from dem_mpi.bodies import FIELDS, Bodies, ImpulseMemory
from dem_mpi.parallel import Halo, Parallel
from dem_mpi.partition import (
    Partition,
    balance,
    bounding_cube,
    ghost_targets,
    imbalance,
    migrate,
)

ranks_1_2_3_8 = pytest.mark.mpi(ranks=[1, 2, 3, 8])

# ---- clouds: all bodies, the same on every rank, gid = row ---------------------------------


def cloud_of(position: np.ndarray, radius: np.ndarray | float, seed: int = 0) -> Bodies:
    """Bodies at `position` whose other arrays are random numbers."""
    rng = np.random.default_rng(seed)
    count = len(position)
    arrays = {
        name: rng.normal(size=(count, *field.row_shape)) * 100 for name, field in FIELDS.items()
    }
    arrays |= {"position": position, "radius": np.full(count, 1.0) * radius}
    return Bodies(**{**arrays, "gid": np.arange(count)})


def random_cloud(count: int) -> Bodies:
    return cloud_of(np.random.default_rng(1).random((count, 3)), 0.03)


def clustered() -> Bodies:
    rng = np.random.default_rng(2)
    return cloud_of(rng.normal(size=(400, 3)) * 10.0 ** -rng.integers(0, 9, (400, 1)), 1e-3)


def size_ratio_100() -> Bodies:
    rng = np.random.default_rng(3)
    return cloud_of(rng.random((500, 3)), 0.2 * 10.0 ** rng.uniform(-2, 0, 500))


def lattice(axes: int) -> Bodies:
    """A line, plane or cube of bodies on the faces of octree cells, touching exactly."""
    side = {1: 257, 2: 17, 3: 9}[axes]
    steps = [np.arange(side) / (side - 1) if a < axes else np.zeros(1) for a in range(3)]
    position = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return cloud_of(position, 0.5 / (side - 1))


def far_from_origin() -> Bodies:
    return cloud_of(1e9 + np.random.default_rng(4).random((200, 3)), 0.05)


CLOUDS: dict[str, Callable[[], Bodies]] = {
    "random": lambda: random_cloud(600),
    "clustered": clustered,
    "size ratio 100": size_ratio_100,
    "line": lambda: lattice(1),
    "plane": lambda: lattice(2),
    "cube": lambda: lattice(3),
    "64 at one point": lambda: cloud_of(np.full((64, 3), 0.3), 0.01),
    "two heaps of 50": lambda: cloud_of(np.repeat([[0.0] * 3, [1.0] * 3], 50, axis=0), 0.6),
    "far from the origin": far_from_origin,
    "all in reach of all": lambda: cloud_of(np.random.default_rng(5).random((30, 3)), 2.0),
    "two": lambda: random_cloud(2),
    "one": lambda: random_cloud(1),
    "none": lambda: random_cloud(0),
}

every_cloud = pytest.mark.parametrize("name", CLOUDS)

# ---- initial distributions -----------------------------------------------------------------

DISTRIBUTIONS: dict[str, Callable[[int, int], np.ndarray]] = {
    "all on the first": lambda count, size: np.zeros(count, int),
    "all on the last": lambda count, size: np.full(count, size - 1),
    "in turn": lambda count, size: np.arange(count) % size,
    "random": lambda count, size: np.random.default_rng(9).integers(0, size, count),
}


def rows_of(parallel: Parallel, count: int, distribution: str) -> np.ndarray:
    """This rank's rows of a cloud, in an order that differs from rank to rank."""
    rank = DISTRIBUTIONS[distribution](count, parallel.size)
    return np.random.default_rng(parallel.rank).permutation(np.flatnonzero(rank == parallel.rank))


def memory_of(gid: np.ndarray) -> ImpulseMemory:
    """0 to 3 remembered contacts a body, functions of its gid alone."""
    count = gid % 4
    owner = np.repeat(gid, count)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    return ImpulseMemory(
        np.concatenate(([0], np.cumsum(count))),
        owner * 10 + place,
        np.sin(owner[:, None] + [1.0, 2.0, 3.0] + place[:, None]),
    )


def distributed(parallel: Parallel, cloud: Bodies) -> tuple[Partition, Bodies]:
    """The cloud after balancing and migration with one unit of weight a body."""
    mine = cloud.take(rows_of(parallel, len(cloud), "random"))
    partition = balance(parallel, mine, np.ones(len(mine), int))
    return partition, migrate(parallel, partition, mine, memory_of(mine.gid))[0]


# ---- bounding cube -------------------------------------------------------------------------


@ranks_1_2_3_8
@every_cloud
def test_cube_contains_all_bodies_of_all_ranks(parallel, name):
    position = CLOUDS[name]().position
    mine = position[rows_of(parallel, len(position), "random")]
    for pad in (0.0, 0.5):
        origin, edge = bounding_cube(parallel, mine, pad)
        assert edge > 0.0 and np.isfinite(edge)
        if len(position):
            assert np.all(origin <= position.min(axis=0) - pad)
            assert np.all(origin + edge * (1 + 1e-15) >= position.max(axis=0) + pad)
        everywhere = parallel.allgather(np.array([*origin, edge]))
        assert np.all(everywhere == everywhere[0])


@ranks_1_2_3_8
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_position_that_is_not_finite_is_refused_on_all_ranks(parallel, value):
    position = np.ones((4, 3))
    if parallel.rank == parallel.size - 1:
        position[2, 1] = value
    with pytest.raises(ValueError, match="finite"):
        bounding_cube(parallel, position)


# ---- splitters -----------------------------------------------------------------------------


def serial_owners(parallel: Parallel, cloud: Bodies, weights: np.ndarray) -> np.ndarray:
    """The owner of each body by sorting them all: how many targets lie at or below the weight
    of the bodies before it, in Python's unbounded integers."""
    origin, edge = bounding_cube(parallel, cloud.position)
    order = np.lexsort((cloud.gid, morton.encode(cloud.position, origin, edge)))
    size, total = parallel.size, sum(map(int, weights))
    owner, before = np.empty(len(cloud), int), 0
    for body in order:
        owner[body] = sum(before * size >= total * s for s in range(1, size))
        before += int(weights[body])
    return owner


WEIGHTS: dict[str, Callable[[int], np.ndarray]] = {
    "equal": lambda count: np.ones(count, int),
    "random": lambda count: np.random.default_rng(6).integers(1, 30, count),
    "one heavy": lambda count: np.where(np.arange(count) == count // 2, 10**6, 1),
    "beyond 32 bits": lambda count: np.random.default_rng(7).integers(1, 2**50, count),
}


@ranks_1_2_3_8
@every_cloud
@pytest.mark.parametrize("weighting", WEIGHTS)
def test_splitters_equal_those_of_a_serial_sort(parallel, name, weighting):
    cloud = CLOUDS[name]()
    weights = WEIGHTS[weighting](len(cloud))
    expected = serial_owners(parallel, cloud, weights)
    partitions = []
    for distribution in DISTRIBUTIONS:
        rows = rows_of(parallel, len(cloud), distribution)
        partition = balance(parallel, cloud.take(rows), weights[rows])
        assert np.array_equal(partition.owner(cloud.position, cloud.gid), expected)
        partitions.append(
            np.concatenate(
                (
                    [*partition.origin, partition.edge],
                    partition.splitter_key,
                    partition.splitter_gid,
                )
            )
        )
    # The same on every rank and from every distribution.
    everywhere = parallel.allgather(np.stack(partitions)).reshape(-1, len(partitions[0]))
    assert np.all(everywhere == everywhere[0])


@ranks_1_2_3_8
@pytest.mark.parametrize("name", ["random", "clustered", "64 at one point"])
def test_every_rank_gets_its_share_to_within_one_body(parallel, name):
    cloud = CLOUDS[name]()
    weights = WEIGHTS["random"](len(cloud))
    rows = rows_of(parallel, len(cloud), "all on the first")
    partition = balance(parallel, cloud.take(rows), weights[rows])
    owner = partition.owner(cloud.position, cloud.gid)
    share = np.bincount(owner, weights, parallel.size)
    assert np.all(np.abs(share - weights.sum() / parallel.size) <= weights.max())


@ranks_1_2_3_8
def test_gids_and_weights_of_64_bits_are_divided_exactly(parallel):
    # 40 bodies at one point: the gid alone divides them; their weights add to 1.2e11.
    gid = 2**62 + 3_000_000_000 * np.arange(40)
    cloud = cloud_of(np.zeros((40, 3)), 1.0)
    cloud.gid = gid
    rows = rows_of(parallel, 40, "in turn")
    partition = balance(parallel, cloud.take(rows), np.full(len(rows), 3_000_000_000))
    expected = [
        sum(i * parallel.size >= 40 * s for s in range(1, parallel.size)) for i in range(40)
    ]
    assert partition.owner(cloud.position, gid).tolist() == expected


@pytest.mark.parametrize(
    "weights", [np.zeros(5, int), np.full(5, -1), np.ones(5), np.ones(4, int), np.ones((5, 1), int)]
)
def test_weights_that_are_not_positive_integers_are_refused(parallel, weights):
    with pytest.raises(ValueError, match="positive integer"):
        balance(parallel, random_cloud(5), weights)


def test_partition_cannot_be_changed(parallel):
    partition = balance(parallel, random_cloud(5), np.ones(5, int))
    with pytest.raises(ValueError, match="read-only"):
        partition.origin[0] = 1.0
    with pytest.raises(AttributeError):
        partition.edge = 2.0


# ---- migration -----------------------------------------------------------------------------


def check_migrated(
    parallel: Parallel, partition: Partition, cloud: Bodies, bodies: Bodies, memory: ImpulseMemory
) -> None:
    """Every body of `cloud` is on its owner, once, in order, with every bit as it was."""
    assert parallel.sum(len(bodies)) == len(cloud)
    assert np.all(partition.owner(bodies.position, bodies.gid) == parallel.rank)
    key = partition.key(bodies.position)
    pairs = list(zip(key.tolist(), bodies.gid.tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    for name, array in cloud.take(bodies.gid).arrays().items():
        assert getattr(bodies, name).tobytes() == array.tobytes(), name
    expected = memory_of(bodies.gid)
    for name in ("offsets", "other", "impulse"):
        assert getattr(memory, name).tobytes() == getattr(expected, name).tobytes(), name


@ranks_1_2_3_8
@every_cloud
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_migration_conserves_every_bit_of_every_body(parallel, name, distribution):
    cloud = CLOUDS[name]()
    if len(cloud):
        cloud.velocity[0] = [np.nan, -0.0, 5e-324]
    rows = rows_of(parallel, len(cloud), distribution)
    mine = cloud.take(rows)
    partition = balance(parallel, mine, np.ones(len(mine), int))
    bodies, memory, moved = migrate(parallel, partition, mine, memory_of(mine.gid))
    check_migrated(parallel, partition, cloud, bodies, memory)
    start = DISTRIBUTIONS[distribution](len(cloud), parallel.size)
    assert moved == np.sum(start != partition.owner(cloud.position, cloud.gid))

    # Nobody moves the second time.
    again = migrate(parallel, partition, bodies, memory)
    check_migrated(parallel, partition, cloud, *again[:2])
    assert again[2] == 0


@ranks_1_2_3_8
def test_bodies_that_cross_several_ranks_or_leave_the_cube_find_their_owner(parallel):
    cloud = CLOUDS["random"]()
    partition, bodies = distributed(parallel, cloud)
    memory = memory_of(bodies.gid)
    for step in range(3):
        displacement = np.random.default_rng(step).normal(size=(len(cloud), 3))
        cloud.position += displacement
        bodies.position += displacement[bodies.gid]
        bodies, memory, _ = migrate(parallel, partition, bodies, memory)
        check_migrated(parallel, partition, cloud, bodies, memory)


@ranks_1_2_3_8
def test_coincident_bodies_are_shared_out_evenly(parallel):
    _, bodies = distributed(parallel, CLOUDS["64 at one point"]())
    assert 64 // parallel.size <= len(bodies) <= -(-64 // parallel.size)


@ranks_1_2_3_8
def test_rows_after_migration_do_not_depend_on_where_bodies_came_from(parallel):
    cloud = CLOUDS["clustered"]()
    results = []
    for distribution in DISTRIBUTIONS:
        mine = cloud.take(rows_of(parallel, len(cloud), distribution))
        partition = balance(parallel, mine, np.ones(len(mine), int))
        results.append(migrate(parallel, partition, mine, memory_of(mine.gid))[0].gid.tolist())
    assert all(gids == results[0] for gids in results)


@pytest.mark.mpi(ranks=[2, 3, 8])
@pytest.mark.parametrize("fault", ["lost", "doubled"])
def test_lost_or_doubled_body_raises_on_all_ranks(parallel, fault, monkeypatch):
    cloud = random_cloud(100)
    mine = cloud.take(rows_of(parallel, 100, "all on the first"))
    partition = balance(parallel, mine, np.ones(len(mine), int))
    exchange = parallel.exchange

    def faulty_exchange(messages: dict[int, bytes]) -> dict[int, bytes]:
        received = exchange(messages)
        return {} if fault == "lost" else received | {r + 100: m for r, m in received.items()}

    monkeypatch.setattr(parallel, "exchange", faulty_exchange)
    with pytest.raises(RuntimeError, match="migration changed the number"):
        migrate(parallel, partition, mine, ImpulseMemory.empty(len(mine)))


@ranks_1_2_3_8
def test_imbalance_is_maximum_over_mean(parallel):
    assert imbalance(parallel, 5) == 1.0
    assert imbalance(parallel, 0) == 1.0
    assert imbalance(parallel, parallel.rank == 0) == parallel.size


# ---- ghosts --------------------------------------------------------------------------------


def ghost_gids(parallel: Parallel, partition: Partition, bodies: Bodies, reach: np.ndarray):
    """The gids that arrive as ghosts, in the order of the halo."""
    targets = ghost_targets(parallel, partition, bodies.position, reach)
    assert parallel.rank not in targets
    for rows in targets.values():
        assert rows.dtype == np.int32 and len(rows) and np.all(np.diff(rows) > 0)
    halo = Halo.build(parallel, len(bodies), targets)
    gid = np.concatenate((bodies.gid, np.full(halo.ghosts, -1)))
    halo.forward(gid)
    return gid[len(bodies) :]


def needed_ghosts(
    cloud: Bodies, owner: np.ndarray, rank: int, reach: np.ndarray, order: float
) -> set[int]:
    """Brute force: bodies of other ranks within their own reach of a body of `rank`."""
    separation = cloud.position[:, None] - cloud.position[owner == rank][None]
    near = np.linalg.norm(separation, ord=order, axis=2) <= reach[:, None]
    return set(np.flatnonzero(near.any(axis=1) & (owner != rank)).tolist())


@ranks_1_2_3_8
@every_cloud
@pytest.mark.parametrize("factor", [0.0, 1.0, 5.0])
def test_every_body_in_reach_of_another_rank_is_a_ghost_there(parallel, name, factor):
    cloud = CLOUDS[name]()
    partition, bodies = distributed(parallel, cloud)
    owner = partition.owner(cloud.position, cloud.gid)
    reach = factor * (cloud.radius + cloud.radius.max(initial=0.0))
    ghosts = ghost_gids(parallel, partition, bodies, reach[bodies.gid])
    assert len(set(ghosts.tolist())) == len(ghosts)
    assert np.all(owner[ghosts] != parallel.rank)
    assert np.all(np.diff(owner[ghosts]) >= 0)
    missing = needed_ghosts(cloud, owner, parallel.rank, reach, np.inf) - set(ghosts.tolist())
    assert not missing


@ranks_1_2_3_8
def test_ghosts_are_complete_for_bodies_outside_the_cube(parallel):
    cloud = CLOUDS["random"]()
    partition, bodies = distributed(parallel, cloud)
    displacement = np.random.default_rng(8).normal(size=(len(cloud), 3))
    cloud.position += displacement
    bodies.position += displacement[bodies.gid]
    bodies, _, _ = migrate(parallel, partition, bodies, memory_of(bodies.gid))
    owner = partition.owner(cloud.position, cloud.gid)
    reach = np.random.default_rng(9).uniform(0.0, 0.5, len(cloud))
    ghosts = ghost_gids(parallel, partition, bodies, reach[bodies.gid])
    assert needed_ghosts(cloud, owner, parallel.rank, reach, np.inf) <= set(ghosts.tolist())


@pytest.mark.mpi(ranks=[2, 3, 8])
def test_halo_pruned_to_real_neighbours_holds_exactly_those(parallel):
    cloud = CLOUDS["size ratio 100"]()
    partition, bodies = distributed(parallel, cloud)
    owner = partition.owner(cloud.position, cloud.gid)
    reach = cloud.radius + cloud.radius.max()
    targets = ghost_targets(parallel, partition, bodies.position, reach[bodies.gid])
    halo = Halo.build(parallel, len(bodies), targets)
    gid = np.concatenate((bodies.gid, np.full(halo.ghosts, -1)))
    halo.forward(gid)
    needed = needed_ghosts(cloud, owner, parallel.rank, reach, 2)
    pruned = halo.keep(np.isin(gid[len(bodies) :], sorted(needed)))
    gid = np.concatenate((bodies.gid, np.full(pruned.ghosts, -1)))
    pruned.forward(gid)
    assert sorted(gid[len(bodies) :].tolist()) == sorted(needed)


@pytest.mark.mpi(ranks=[2, 3, 8])
def test_few_more_ghosts_are_sent_than_needed(parallel):
    """Where many bodies lie in reach, those that reach a region also reach a body in it."""
    cloud = cloud_of(np.random.default_rng(10).random((4000, 3)), 0.03)
    partition, bodies = distributed(parallel, cloud)
    owner = partition.owner(cloud.position, cloud.gid)
    reach = np.full(len(cloud), 0.15)
    ghosts = ghost_gids(parallel, partition, bodies, reach[bodies.gid])
    needed = needed_ghosts(cloud, owner, parallel.rank, reach, np.inf)
    surplus = parallel.sum(len(ghosts)) / parallel.sum(len(needed))
    print(f"ghosts sent over ghosts needed: {surplus:.3f}")
    assert surplus < 1.2


@pytest.mark.mpi(ranks=[2, 3])
def test_body_on_the_wrong_rank_is_noticed(parallel):
    cloud = CLOUDS["random"]()
    partition, _ = distributed(parallel, cloud)
    with pytest.raises(RuntimeError, match="migrate first"):
        ghost_targets(parallel, partition, cloud.position, cloud.radius)


class OneOfMany(Parallel):
    """One rank played without the others, for what sends nothing."""

    def __init__(self, rank: int, size: int) -> None:
        self.rank, self.size = rank, size


@pytest.mark.parametrize("rank", [0, 255, 511])
def test_one_rank_of_512_finds_its_ghost_targets_alone(rank):
    rng = np.random.default_rng(11)
    position = rng.random((20_000, 3))
    gid = np.arange(len(position))
    key = morton.encode(position, np.zeros(3), 1.0)
    order = np.lexsort((gid, key))
    cut = order[np.arange(1, 512) * len(order) // 512]
    partition = Partition(np.zeros(3), 1.0, key[cut], gid[cut])
    owner = partition.owner(position, gid)
    mine = np.flatnonzero(owner == rank)
    reach = rng.uniform(0.0, 0.1, len(mine))
    targets = ghost_targets(OneOfMany(rank, 512), partition, position[mine], reach)
    near = np.abs(position[mine][:, None] - position[None]).max(axis=2) <= reach[:, None]
    for other in set(range(512)) - {rank}:
        needed = np.flatnonzero(near[:, owner == other].any(axis=1))
        assert set(needed.tolist()) <= set(targets.get(other, np.empty(0)).tolist())


@pytest.mark.parametrize("rank", [0, 3, 6])
def test_ghost_targets_are_the_ranks_whose_octree_cells_the_reach_meets(rank):
    """Splitters on the borders of the 512 cells of level 3: regions are known cell by cell."""
    cells, ranks = 512, 7
    rng = np.random.default_rng(12)
    first_cell = np.sort(rng.choice(np.arange(1, cells), ranks - 1, replace=False))
    keys_of_a_cell = (morton.MAX_KEY + 1) // cells
    partition = Partition(np.zeros(3), 1.0, first_cell * keys_of_a_cell, np.zeros(ranks - 1))
    low = (morton.decode(np.arange(cells) * keys_of_a_cell) >> (morton.LEVELS - 3)) / 8.0
    cell_owner = np.searchsorted(first_cell, np.arange(cells), side="right")

    position = rng.uniform(-0.2, 1.2, (4000, 3))
    position = position[partition.owner(position, np.arange(4000)) == rank]
    reach = 10.0 ** rng.uniform(-3, 0, len(position))
    # Cells at the faces of the cube stand for all that lies outside of it, too.
    high = np.where(low == 7 / 8, np.inf, low + 1 / 8)
    low = np.where(low == 0.0, -np.inf, low)
    box_low, box_high = position - reach[:, None], position + reach[:, None]
    meets = np.all((box_low[:, None] < high) & (box_high[:, None] >= low), axis=2)

    targets = ghost_targets(OneOfMany(rank, ranks), partition, position, reach)
    for other in set(range(ranks)) - {rank}:
        expected = np.flatnonzero(meets[:, cell_owner == other].any(axis=1))
        assert np.array_equal(targets.get(other, np.empty(0)), expected)
