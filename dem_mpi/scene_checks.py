"""Rules that join sections of a scene, and doubts about scenes that are legal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from dem_mpi.scene_models import Scenario
from dem_mpi.yaml_reader import KeyPath


class Finding(NamedTuple):
    """What is wrong with, or doubtful about, the value at `path`."""

    path: KeyPath
    rule: str


def violations(scenario: Scenario) -> Iterator[Finding]:
    """Every broken rule; the first is the one to tell."""
    yield from ()


def doubts(scenario: Scenario) -> Iterator[Finding]:
    """What is legal but physically doubtful."""
    yield from ()
