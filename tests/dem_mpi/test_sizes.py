"""Radius distributions: that the bodies' radii follow them, and what is said about them holds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from dem_mpi import sizes
from dem_mpi.errors import InputError
from dem_mpi.placement import place_share
from dem_mpi.scenario import parse_scenario
from dem_mpi.scene_bodies import BodyGroup

COUNT = 20_000
DISTRIBUTIONS = {
    "uniform": {"uniform": [0.002, 0.01]},
    "lognormal": {"lognormal": {"median": 0.004, "sigma": 0.4, "min": 0.002, "max": 0.01}},
    "lognormal, upper tail": {
        "lognormal": {"median": 1e-6, "sigma": 0.3, "min": 0.002, "max": 0.01}
    },
    "lognormal, lower tail": {"lognormal": {"median": 10, "sigma": 0.3, "min": 0.002, "max": 0.01}},
    "by number": {"weighted": {"radii": [0.01, 0.002, 0.005], "weights": [1, 6, 3]}},
    "by volume": {
        "weighted": {"radii": [0.01, 0.002, 0.005], "weights": [5, 2, 3], "by": "volume"}
    },
    "mix by volume": {"mix": {"small": 0.005, "large": 0.01, "large_share": 0.6}},
    "mix by number": {"mix": {"small": 0.005, "large": 0.01, "large_share": 0.6, "by": "number"}},
    "list": [0.002, 0.006, 0.003],
    "one size": 0.007,
}


def scenario_text(radius: object, **group: object) -> str:
    """A scene of one group of bodies with these radii."""
    body = {
        "material": "m",
        "count": COUNT,
        "radius": radius,
        "placement": {"jittered_grid": {"min": [0, 0, 0], "max": [1, 1, 1]}},
        **group,
    }
    scene = {
        "domain": {"min": [0, 0, 0], "max": [1, 1, 1]},
        "materials": {"m": {"density": 1000.0}},
        "bodies": [body],
        "time": {"step": 1e-3, "end": 1.0},
    }
    return json.dumps(scene)


def group_of(radius: object, **group: object) -> BodyGroup:
    return parse_scenario(scenario_text(radius, **group), "scene.yaml").scenario.bodies[0]


def drawn(radius: object) -> NDArray:
    """The radii of a scene's bodies."""
    return place_share(parse_scenario(scenario_text(radius), "s").scenario, 0, 1)["radius"]


def exact_cumulative(name: str):
    """The cumulative distribution of the continuous ones, from scipy's own."""
    if name == "uniform":
        return stats.uniform(0.002, 0.008).cdf
    law = DISTRIBUTIONS[name]["lognormal"]
    whole = stats.lognorm(law["sigma"], scale=law["median"])
    if law["median"] > 1:  # both cuts far below: relative accuracy is in the logarithm
        low, high = whole.logcdf([law["min"], law["max"]])
        return lambda r: (
            (np.exp(whole.logcdf(r) - high) - np.exp(low - high)) / -np.expm1(low - high)
        )
    low, high = whole.logsf([law["min"], law["max"]])
    return lambda r: -np.expm1(whole.logsf(r) - low) / -np.expm1(high - low)


@pytest.mark.parametrize("name", [n for n in DISTRIBUTIONS if n[:3] in ("uni", "log")])
def test_radii_follow_their_continuous_distribution(name: str):
    """The numbers are fixed by the seed; 1e-3 is the chance that a right sample is refused."""
    assert stats.kstest(drawn(DISTRIBUTIONS[name]), exact_cumulative(name)).pvalue > 1e-3


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_bounds_and_moments_are_those_of_the_radii(name: str):
    group, radius = group_of(DISTRIBUTIONS[name]), drawn(DISTRIBUTIONS[name])
    low, high = sizes.smallest_radius(group), sizes.largest_radius(group)
    assert low <= radius.min() and radius.max() <= high
    if "tail" not in name:  # far out in a tail only the cut near the median is ever met
        assert radius.min() - low < 0.1 * (high - low) or low == high
        assert high - radius.max() < 0.1 * (high - low) or low == high
    for k, stated in ((1, sizes.mean_radius(group)), (3, sizes.mean_volume(group))):
        values = radius if k == 1 else 4 / 3 * np.pi * radius**3
        error = values.std() / np.sqrt(COUNT)
        assert abs(values.mean() - stated) <= 5 * error + 1e-12 * stated


@pytest.mark.parametrize(
    ("name", "shares"),
    [
        ("by number", {0.01: 0.1, 0.002: 0.6, 0.005: 0.3}),
        ("mix by number", {0.005: 0.4, 0.01: 0.6}),
        ("by volume", {0.01: 0.5, 0.002: 0.2, 0.005: 0.3}),
        ("mix by volume", {0.005: 0.4, 0.01: 0.6}),
    ],
)
def test_sizes_come_in_their_shares_by_number_or_by_volume(name: str, shares: dict):
    radius = drawn(DISTRIBUTIONS[name])
    weight = radius**3 if "volume" in name else np.ones(COUNT)
    for size, share in shares.items():
        found = weight[radius == size].sum() / weight.sum()
        # Standard deviation of the number of the rarer sizes, here at least 400 of them.
        assert found == pytest.approx(share, rel=5 / np.sqrt(np.count_nonzero(radius == size)))
    assert np.isin(radius, list(shares)).all()


def test_a_size_of_weight_zero_never_comes_and_bounds_nothing():
    radius = {"weighted": {"radii": [1e-4, 0.002, 0.4], "weights": [0, 1, 0]}}
    group = group_of(radius)
    assert sizes.smallest_radius(group) == sizes.largest_radius(group) == 0.002
    numbers = np.array([0.0, 0.5, 1 - 2.0**-53])
    assert (sizes.radii(group, np.arange(3), numbers) == 0.002).all()


@pytest.mark.parametrize("name", ["lognormal", "lognormal, upper tail", "lognormal, lower tail"])
def test_extreme_random_numbers_give_the_cuts(name: str):
    group = group_of(DISTRIBUTIONS[name])
    radius = sizes.radii(group, np.arange(2), np.array([0.0, 1 - 2.0**-53]))
    assert 0.002 <= radius[0] < radius[1] <= 0.01
    # At the cut far from the median the density is small, and 2^-53 a finite step in radius.
    if name != "lognormal, lower tail":
        assert radius[0] == pytest.approx(0.002, rel=1e-12)
    if name != "lognormal, upper tail":
        assert radius[1] == pytest.approx(0.01, rel=1e-9)


def test_a_mean_volume_is_that_of_the_shape():
    r, volume = 0.005, 4 / 3 * np.pi * 0.005**3
    rod = group_of(r, shape="spherocylinder", aspect_ratio=3, count=1)
    disc = group_of(r, shape="spheroid", aspect_ratio=0.5, count=1)
    assert sizes.mean_volume(rod) == pytest.approx(volume + np.pi * r**2 * 4 * r, rel=1e-14)
    assert sizes.mean_volume(disc) == pytest.approx(0.5 * volume, rel=1e-14)
    assert sizes.largest_reach(rod) == pytest.approx(3 * r)
    assert sizes.largest_reach(disc) == r
    assert sizes.thinnest_half(disc) == r / 2
    for group in (rod, disc):
        expected = 4 / 3 * np.pi * (sizes.largest_reach(group) + 1e-3) ** 3
        assert sizes.mean_bounding_volume(group, gap=2e-3) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_radii_do_not_depend_on_the_number_of_ranks(name: str):
    scene = parse_scenario(scenario_text(DISTRIBUTIONS[name], count=1000), "s").scenario
    whole = place_share(scene, 0, 1)["radius"]
    parts = [place_share(scene, rank, 7)["radius"] for rank in range(7)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


@pytest.mark.parametrize(
    ("radius", "words"),
    [
        ({"unifrom": [1, 2]}, "Did you mean 'uniform'?"),
        ({"gauss": 1}, "known here: uniform, lognormal, weighted, mix"),
        ({"lognormal": {"median": 0.1, "sigma": 1, "min": 0.1, "max": 0.05}}, "min must be below"),
        (
            {"lognormal": {"mean": 0.1, "sigma": 1, "min": 0.1, "max": 0.5}},
            "Did you mean 'median'?",
        ),
        ({"lognormal": {"median": 0.1, "sigma": 9, "min": 0.1, "max": 0.5}}, "sigma = 9: must be"),
        ({"lognormal": {"median": 0.1, "sigma": 1, "min": 0.1}}, "lognormal.max: this key is req"),
        ({"mix": {"small": 2, "large": 1, "large_share": 0.5}}, "small must be below large"),
        ({"mix": {"small": 1, "large": 2, "large_share": 1.5}}, "large_share = 1.5: must be <= 1"),
        ({"weighted": {"radii": [1, 2], "weights": [1]}}, "as many entries"),
        ({"weighted": {"radii": [1], "weights": [0]}}, "above 0"),
        ({"weighted": {"radii": [-1], "weights": [1]}}, "radii[0] = -1: must be > 0 [m]"),
        ({"weighted": {"radii": [1], "weights": [1], "by": "mass"}}, "one of number, volume"),
        ({"uniform": [0.001, 0.002], "mix": {}}, "radius.mix = {}: unknown key"),
    ],
)
def test_a_wrong_distribution_is_refused_by_name_and_place(radius: dict, words: str):
    with pytest.raises(InputError) as caught:
        parse_scenario(scenario_text(radius), "scene.yaml")
    message = str(caught.value)
    assert words in message
    assert message.startswith("scene.yaml:1: bodies[0].radius")
    assert "<" not in message.replace("min must be below", "").replace("must be <", "")
