"""Rules for the regions of a scene: whether bodies fit where they start or come in."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from dem_mpi.placement import grid, grid_capacity
from dem_mpi.random_placement import fraction_beside, largest_fraction, volume_fraction
from dem_mpi.scene_base import Region
from dem_mpi.scene_bodies import BodyGroup, Insertion, RandomPlacement, removal_name
from dem_mpi.scene_models import Scenario
from dem_mpi.sizes import largest_reach
from dem_mpi.yaml_reader import KeyPath

Rule = tuple[KeyPath, str]


def room_violations(scenario: Scenario) -> Iterator[Rule]:
    """Groups that do not fit in their regions, and removal regions of one name."""
    for index, group in enumerate(scenario.bodies):
        if group.placement.jittered_grid is not None:
            yield from _grid_room(index, group)
        for key in ("random", "insertion"):
            region = getattr(group.placement, key)
            if region is not None:
                yield from _width(("bodies", index, "placement", key), region, group)
        if group.placement.random is not None:
            yield from _fraction(index, group, scenario.bodies[:index])
    names: dict[str, int] = {}
    for index, region in enumerate(scenario.removal):
        first = names.setdefault(removal_name(region, index), index)
        if first < index:
            yield ("removal", index, "name"), f"removal[{first}] has this name already"


def start_region(group: BodyGroup) -> tuple[str, RandomPlacement | Insertion] | None:
    """The region that a group fills as a whole, with its key; None for grids and files."""
    placement = group.placement
    if placement.random is not None:
        return "random", placement.random
    if placement.insertion is not None:
        return "insertion", placement.insertion
    return None


def _size(region: Region) -> str:
    return " x ".join(f"{b - a:.6g}" for a, b in zip(region.min, region.max, strict=True))


def _width(here: KeyPath, region: Region, group: BodyGroup) -> Iterator[Rule]:
    """Whether the largest body fits between the faces of a region."""
    diameter = 2 * largest_reach(group)
    thinnest = min(b - a for a, b in zip(region.min, region.max, strict=True))
    if thinnest < diameter * (1 - 1e-12):
        yield here, f"{_size(region)} m is too thin for bodies of diameter {diameter:g} m"


def _fraction(index: int, group: BodyGroup, before: Sequence[BodyGroup]) -> Iterator[Rule]:
    """Whether random places can be found for so many bodies."""
    fraction, largest = volume_fraction(group), largest_fraction(group)
    beside = fraction_beside(group, before)
    if fraction + beside > largest:
        assert group.count is not None
        fit = math.floor(group.count * max(0.0, largest - beside) / fraction)
        others = f" beside {beside:.3g} of earlier groups" if beside else ""
        yield (
            ("bodies", index, "count"),
            f"takes {fraction:.3g} of the volume of placement.random{others}, gaps included; "
            f"random places are found up to {largest:.3g} there, for {fit} bodies. Lower count, "
            f"enlarge the region or use jittered_grid",
        )


def _grid_room(index: int, group: BodyGroup) -> Iterator[Rule]:
    """Whether the bodies of a group fit in its grid."""
    region = group.placement.jittered_grid
    assert region is not None
    assert group.count is not None
    here: KeyPath = ("bodies", index, "placement", "jittered_grid")
    diameter = 2 * largest_reach(group)
    size = _size(region)
    if region.spacing is not None and region.spacing < diameter * (1 - 1e-12):
        yield (*here, "spacing"), f"must be at least the largest diameter, {diameter:g} m"
        return
    fit = grid_capacity(region, diameter)
    if fit == 0:
        yield here, f"{size} m is too thin for bodies of diameter {diameter:g} m"
        return
    spacing = ""
    if region.spacing is not None:
        spacing = f" with spacing {region.spacing:g} m"
        fit = grid(region, group.count, diameter / 2).capacity
    if fit < group.count:
        yield (
            ("bodies", index, "count"),
            f"bodies of diameter {diameter:g} m{spacing} do not all fit in the grid of {size} m; "
            f"{fit} do. Lower count or enlarge placement.jittered_grid",
        )
