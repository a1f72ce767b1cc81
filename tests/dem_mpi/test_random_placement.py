"""Random sequential placement: free of overlap, evenly spread, the same on any number of ranks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial import cKDTree

from dem_mpi import shapes, sizes
from dem_mpi.counter_random import key_of, uniform
from dem_mpi.errors import InputError
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.random_placement import largest_fraction, place_at_random, volume_fraction
from dem_mpi.scenario import Scenario
from dem_mpi.scene_bodies import BodyGroup

from scenes import load, scene

BOX = {"min": [0, 0, 0], "max": [1, 0.8, 1.2]}
MIX = {"mix": {"small": 0.02, "large": 0.05, "large_share": 0.5}}


def random_group(count: int, radius: Any, gap: float = 0.0, **group: Any) -> dict[str, Any]:
    region = group.pop("region", BOX)
    return {
        "material": "m",
        "count": count,
        "radius": radius,
        "placement": {"random": {**region, "gap": gap}},
        **group,
    }


def crowd(seed: int = 1) -> Scenario:
    """A grid, a dense mix and rods in one region, and balls in a region that meets it."""
    grid = {"jittered_grid": {"min": [0, 0, 0], "max": [0.5, 0.4, 0.2], "jitter": 1}}
    groups = [
        random_group(1000, MIX, velocity_jitter=0.1),
        {"material": "m", "count": 20, "radius": 0.04, "placement": grid},
        random_group(60, 0.01, shape="spherocylinder", aspect_ratio=3, axis="random"),
        random_group(500, 0.02, 2e-3, region={"min": [0.5, 0, 0], "max": [1.5, 1, 1]}),
    ]
    return scene(bodies=groups, seed=seed)


def group_of(**group: Any) -> BodyGroup:
    return BodyGroup.model_validate(random_group(**group))


def gathered(parallel: Parallel, arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """Collective. All bodies on every rank, in the order of gid."""
    parts = parallel.broadcast(parallel.gather(arrays))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in arrays}
    order = np.argsort(joined["gid"])
    return {name: array[order] for name, array in joined.items()}


def reach_of(bodies: dict[str, NDArray]) -> NDArray:
    return shapes.bounding_radius(bodies["shape"], bodies["radius"], bodies["half_length"])


def least_gap(position: NDArray, reach: NDArray) -> float:
    """The smallest distance of two surfaces [m], by comparing every pair."""
    least = np.inf
    for start in range(0, len(position), 500):
        rows = slice(start, start + 500)
        gap = np.linalg.norm(position[rows, None] - position[None], axis=2)
        gap -= reach[rows, None] + reach[None]
        gap[np.arange(len(gap)), start + np.arange(len(gap))] = np.inf
        least = min(least, float(gap.min()))
    return least


def alone(seed: int, **group: Any) -> tuple[NDArray, NDArray]:
    """Positions and bounding radii of one group, in the order of its bodies."""
    bodies = place(Parallel.alone(), scene(bodies=[random_group(**group)], seed=seed))
    order = np.argsort(bodies["gid"])
    return bodies["position"][order], reach_of(bodies)[order]


# ---- ranks -----------------------------------------------------------------------------------


@pytest.mark.mpi(ranks=[1, 2, 3, 8])
def test_every_bit_is_the_same_on_any_number_of_ranks(parallel):
    bodies = gathered(parallel, place(parallel, crowd()))
    expected = gathered(Parallel.alone(), place(Parallel.alone(), crowd()))
    assert bodies["gid"].tolist() == list(range(1000 + 20 + 60 + 500))
    for name, array in bodies.items():
        assert array.tobytes() == expected[name].tobytes(), name


@pytest.mark.mpi(ranks=[3])
def test_the_work_is_divided_and_a_failure_is_told_to_all(parallel):
    found = len(place(parallel, crowd())["gid"])
    assert 0 < parallel.min(found) <= parallel.max(found) < 0.6 * parallel.sum(found)
    data = scene(bodies=[random_group(10, 0.1)]).model_dump(mode="json")
    data["bodies"][0]["count"] = 150  # as a restored scene may say, unchecked
    with pytest.raises(
        InputError, match=r"bodies\[0\].placement.random: \d+ bodies found no place"
    ):
        place(parallel, Scenario.model_validate(data))


# ---- places ----------------------------------------------------------------------------------


def test_nothing_overlaps_across_groups_and_nothing_reaches_out_of_its_region():
    bodies = gathered(Parallel.alone(), place(Parallel.alone(), crowd()))
    position, reach = bodies["position"], reach_of(bodies)
    assert least_gap(position, reach) >= -1e-15
    for rows, low, high in (
        (slice(0, 1000), BOX["min"], BOX["max"]),
        (slice(1020, 1080), BOX["min"], BOX["max"]),
        (slice(1080, 1580), [0.5, 0, 0], [1.5, 1, 1]),
    ):
        assert (position[rows] - reach[rows, None] >= np.array(low) - 1e-15).all()
        assert (position[rows] + reach[rows, None] <= np.array(high) + 1e-15).all()
    last = slice(1080, 1580)
    gap = np.linalg.norm(position[last, None] - position[None, :1080], axis=2)
    gap -= reach[last, None] + reach[None, :1080]
    assert gap.min() >= 2e-3 - 1e-15  # its own gap holds towards all that stood before


def test_bodies_keep_the_radius_that_belongs_to_their_number():
    bodies = gathered(Parallel.alone(), place(Parallel.alone(), crowd()))
    group = crowd().bodies[0]
    numbers = uniform(key_of(1, 0), np.arange(1000), blocks=2)[:, 3]
    assert (bodies["radius"][:1000] == sizes.radii(group, np.arange(1000), numbers)).all()


def test_seed_changes_the_places():
    first, _ = alone(1, count=50, radius=0.05)
    second, _ = alone(2, count=50, radius=0.05)
    assert (first != second).any(axis=1).all()


@pytest.mark.parametrize(("count", "gap"), [(40, 0.0), (400, 0.0), (400, 0.01)])
def test_the_gap_is_kept(count: int, gap: float):
    position, reach = alone(3, count=count, radius=0.03, gap=gap)
    assert least_gap(position, reach) >= gap - 1e-15


def test_density_is_even_and_a_dilute_placement_is_as_good_as_independent():
    """Chi-square over 64 boxes of the space of the centres, at 1 % by volume and at 20 %."""
    region = {"min": [0, 0, 0], "max": [1.04, 1.04, 1.04]}
    for count, low, high in ((336, 0.001, 0.999), (6700, 0.0, 0.999)):
        position, _ = alone(4, count=count, radius=0.02, region=region)
        boxes = np.histogramdd(position, bins=4, range=[(0.02, 1.02)] * 3)[0].ravel()
        chi_square = ((boxes - count / 64) ** 2 / (count / 64)).sum()
        # Bodies that exclude each other fluctuate less than independent ones, never more.
        assert stats.chi2.ppf(low, 63) <= chi_square <= stats.chi2.ppf(high, 63)


def test_pair_distances_at_low_density_are_those_of_hard_spheres():
    """g(r) = 1 + O(phi) beyond contact: pairs within 1 to 1.5 diameters, against their volume.

    At 2 % by volume random addition has g = 1 + 8 phi (1 - 3/4 x + x^3/16), x = r/d, to first
    order (as for hard spheres in equilibrium): 1 + 1.40 phi on average over this shell.
    """
    side, radius = 1.0, 0.01
    count = round(0.02 * side**3 / (4 / 3 * np.pi * radius**3))
    pairs = volume = 0.0
    for seed in range(4):
        position, _ = alone(
            seed, count=count, radius=radius, region={"min": [0] * 3, "max": [side] * 3}
        )
        inner = np.all(np.abs(position - side / 2) < side / 2 - 4 * radius, axis=1)
        tree, centre = cKDTree(position), position[inner]
        pairs += tree.query_ball_point(centre, 3 * radius, return_length=True).sum() - len(centre)
        volume += len(centre) * 4 / 3 * np.pi * ((3 * radius) ** 3 - (2 * radius) ** 3)
    density = count / (side - 2 * radius) ** 3
    # Standard deviation of the number of pairs, each counted from both ends.
    assert pairs / (volume * density) == pytest.approx(1 + 1.4 * 0.02, abs=4 * np.sqrt(2 / pairs))


@pytest.mark.parametrize(
    ("region", "radius"),
    [
        ([0.2, 0.2, 0.2], 0.05),
        ([0.3, 0.25, 0.4], 0.05),
        ([1, 1, 0.11], 0.05),
        ([0.11, 0.11, 1.2], 0.05),
        ([1, 0.8, 1.2], 0.05),
        ([0.5, 0.4, 0.6], MIX),
        ([0.5, 0.4, 0.6], {"uniform": [0.01, 0.05]}),
    ],
)
def test_what_is_called_possible_is(region: list[float], radius: Any):
    """At the very fraction up to which scenes pass the check, for three seeds."""
    box = {"min": [0, 0, 0], "max": region}
    one = group_of(count=1, radius=radius, region=box)
    count = int(largest_fraction(one) / volume_fraction(one))
    group = group_of(count=count, radius=radius, region=box)
    index = np.arange(count)
    for seed in range(3):
        reach = sizes.radii(group, index, np.random.default_rng(seed).random(count))
        nothing = np.zeros((0, 4))
        placed = place_at_random(Parallel.alone(), group, seed, 0, index, reach, nothing)
        assert sorted(placed.index) == index.tolist()


def test_size_ratio_of_twenty():
    radius = {"mix": {"small": 0.005, "large": 0.1, "large_share": 0.9}}
    position, reach = alone(1, count=3000, radius=radius)
    assert len(np.unique(reach)) == 2
    assert least_gap(position, reach) >= -1e-15


# ---- refusals --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ([random_group(1000, 0.05)], "bodies[0].count = 1000: takes 0.545 of the volume"),
        ([random_group(1000, 0.05)], "use jittered_grid"),
        ([random_group(400, 0.05, 0.02)], "gaps included"),
        ([random_group(300, 0.05), random_group(300, 0.05)], "beside 0.164 of earlier groups"),
        ([random_group(1, 0.5)], "too thin for bodies of diameter 1 m"),
        (
            [random_group(100, 0.03, shape="spheroid", aspect_ratio=3)],
            "bodies[0].count = 100: takes",
        ),
        ([random_group(5, 0.01, -1.0)], "gap = -1.0: must be >= 0 [m]"),
    ],
)
def test_what_cannot_be_reached_is_refused_before_any_work(groups: list, words: str):
    with pytest.raises(InputError) as refused:
        load(bodies=groups)
    assert words in str(refused.value)


def test_the_count_that_a_refusal_offers_is_accepted():
    with pytest.raises(InputError) as refused:
        load(bodies=[random_group(1000, 0.05)])
    count = int(str(refused.value).split("for ")[1].split(" bodies")[0])
    load(bodies=[random_group(count, 0.05)])
    with pytest.raises(InputError):
        load(bodies=[random_group(count + 1, 0.05)])


def test_a_radius_rounded_above_the_largest_loses_no_body():
    """low + (high - low) u may be rounded up past high."""
    group = group_of(count=50, radius=0.02)
    reach = np.full(50, 0.02)
    reach[::2] = np.nextafter(0.02, 1.0)
    nothing = np.zeros((0, 4))
    placed = place_at_random(Parallel.alone(), group, 1, 0, np.arange(50), reach, nothing)
    assert sorted(placed.index) == list(range(50))
