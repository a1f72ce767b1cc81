"""Scene files: YAML text to a checked, frozen scenario, and its JSON schema.

`load_scenario` ends with one InputError that names file, line, key, value, rule and remedy, or
returns a scenario that needs no further checking.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dem_mpi.body_file import BodyFile
from dem_mpi.errors import InputError
from dem_mpi.scene_bodies import BodyGroup
from dem_mpi.scene_checks import doubts, violations
from dem_mpi.scene_errors import explain, message
from dem_mpi.scene_models import Scenario, friction_table, frictional
from dem_mpi.yaml_reader import override, parse, read_file, show

__all__ = [
    "LoadedScenario",
    "Scenario",
    "body_count",
    "difference",
    "effective",
    "friction_table",
    "frictional",
    "json_schema",
    "load_scenario",
    "parse_scenario",
    "restore_scenario",
]


@dataclass(frozen=True)
class LoadedScenario:
    """A scenario with where it came from.

    text is the file as read; effective is JSON-able and has every default filled in; warnings
    are one line each, about what is legal but physically doubtful.
    """

    scenario: Scenario
    path: Path
    text: str
    warnings: tuple[str, ...]
    effective: dict[str, Any]


def load_scenario(path: str | Path, overrides: Sequence[str] = ()) -> LoadedScenario:
    """Read and check a scene file; `overrides` are `key.path=value` assignments.

    Raises InputError with one message for whatever is wrong with the scene, DataError for a
    damaged file of bodies. Reads files, so on several ranks one calls it and broadcasts.
    """
    path = Path(path)
    return parse_scenario(read_file(path), path, overrides)


def parse_scenario(text: str, path: str | Path, overrides: Sequence[str] = ()) -> LoadedScenario:
    """As load_scenario, for text in hand; `path` names it and locates its files of bodies."""
    path = Path(path)
    document = parse(text, str(path))
    if overrides:
        document = override(document, overrides)
    try:
        scenario = Scenario.model_validate(document.data, context={"directory": path.parent})
    except ValidationError as error:
        raise explain(error, document, json_schema()) from None
    for violation in violations(scenario):
        raise InputError(message(document, violation.path, violation.rule))
    scenario = _with_counts(scenario)
    warnings = tuple(message(document, doubt.path, doubt.rule) for doubt in doubts(scenario))
    return LoadedScenario(scenario, path, text, warnings, effective(scenario))


def _with_counts(scenario: Scenario) -> Scenario:
    """The scenario with the number of bodies of every file filled in."""
    groups = tuple(
        group if group.count is not None else group.model_copy(update={"count": group_count(group)})
        for group in scenario.bodies
    )
    return scenario.model_copy(update={"bodies": groups})


def group_count(group: BodyGroup) -> int:
    """Number of bodies of one group; reads the length of its file where the scene gives none."""
    if group.count is not None:
        return group.count
    return BodyFile(group.placement.path, group.placement.dataset).rows


def body_count(scenario: Scenario) -> int:
    """Number of bodies at the start."""
    return sum(group_count(group) for group in scenario.bodies)


def effective(scenario: Scenario) -> dict[str, Any]:
    """The scenario as JSON-able data with every default and derived interval filled in."""
    data = scenario.model_dump(mode="json")
    data["output"]["interval"] = scenario.output_every * scenario.time.step
    data["checkpoint"]["interval"] = scenario.checkpoint_every * scenario.time.step
    if scenario.compress is None:
        del data["compress"]  # as in scenes of runs that knew of no archive
    else:
        given = data["compress"]["fields"]
        data["compress"]["fields"] = {name: _given(b) for name, b in given.items() if b is not None}
    return data


def _given(bound: Any) -> Any:
    """A bound of a field without the ways to state it that were not used."""
    if isinstance(bound, dict):
        return {kind: value for kind, value in bound.items() if value is not None}
    return bound


def restore_scenario(data: dict[str, Any], directory: str | Path = ".") -> Scenario:
    """The scenario that `effective` came from; files of bodies are relative to `directory`.

    Raises InputError if `data` is no scene.
    """
    try:
        return Scenario.model_validate(data, context={"directory": Path(directory)})
    except ValidationError as error:
        raise InputError(f"stored scene: {error.errors()[0]['msg']}") from None


def difference(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """What changed between two effective scenes, one line a key: `time.end: 1.0 -> 2.0`."""
    before, after = dict(_leaves(old)), dict(_leaves(new))
    lines = []
    for key in [*before, *(key for key in after if key not in before)]:
        if key not in after:
            lines.append(f"{key}: {show(before[key])} -> removed")
        elif key not in before:
            lines.append(f"{key}: added {show(after[key])}")
        elif before[key] != after[key]:
            lines.append(f"{key}: {show(before[key])} -> {show(after[key])}")
    return lines


def _leaves(data: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """(dotted key, value) of everything that is no section; vectors count as one value."""
    found: list[tuple[str, Any]] = []
    for key, value in data.items():
        path = f"{prefix}{key}"
        if isinstance(value, dict):
            found += _leaves(value, f"{path}.")
        elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
            for index, item in enumerate(value):
                found += _leaves(item, f"{path}[{index}].")
        else:
            found.append((path, value))
    return found


def json_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a scene file; `unit` is the unit of each numeric key."""
    schema = Scenario.model_json_schema()
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "dem-mpi scene",
        "description": "A scene of rigid bodies with frictional contact, in SI units",
    }
