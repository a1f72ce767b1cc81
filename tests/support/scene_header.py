"""The machine-readable lines of a shipped scene's header.

    # expect: <quantity> = <value> +- <tolerance>          of the scene as it stands
    # reduced: <key.path=value> ...                        overrides for a run of seconds
    # expect_reduced: <quantity> = <value> +- <tolerance>  of that run

Quantities, of the last frame unless they say otherwise, in SI units:
    centre_of_mass_z              mass-weighted mean height [m]
    velocity_z_of_centre_of_mass  mass-weighted mean velocity along z [m/s]
    velocity_x_of_centre_of_mass  mass-weighted mean velocity along x [m/s]
    velocity_x_of_body_0          velocity along x of the body with gid 0 [m/s]
    radius_of_97_percent          distance from the z axis that 97.5 % of the mass keep within [m]
    mass_flow                     mass removed in the last third of the run over that time [kg/s]
    torque_over_weight_offset     torque along y on the wall "mantle" over weight times x of the
                                  centre of mass, means over the second half of the run
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

QUANTITIES = (
    "centre_of_mass_z",
    "velocity_z_of_centre_of_mass",
    "velocity_x_of_centre_of_mass",
    "velocity_x_of_body_0",
    "radius_of_97_percent",
    "mass_flow",
    "torque_over_weight_offset",
)


@dataclass(frozen=True)
class Expectation:
    """One number that a run must reproduce."""

    quantity: str
    value: float
    tolerance: float


@dataclass(frozen=True)
class SceneHeader:
    """What a shipped scene promises, and the overrides that make it small."""

    expect: Expectation
    reduced: tuple[str, ...]
    expect_reduced: Expectation


def read_header(path: Path) -> SceneHeader:
    """The header of a scene. Raises ValueError where a line is missing or malformed."""
    text = path.read_text(encoding="utf-8")
    return SceneHeader(
        _expectation(_line(text, "expect")),
        tuple(_line(text, "reduced").split()),
        _expectation(_line(text, "expect_reduced")),
    )


def _line(text: str, key: str) -> str:
    found = re.findall(rf"^# {key}: (.*)$", text, flags=re.MULTILINE)
    if len(found) != 1:
        raise ValueError(f"the header needs one '# {key}:' line, has {len(found)}")
    return found[0]


def _expectation(line: str) -> Expectation:
    match = re.fullmatch(r"(\w+) = (\S+) \+- (\S+)", line)
    if match is None or match[1] not in QUANTITIES:
        raise ValueError(f"not '<quantity> = <value> +- <tolerance>': {line}")
    return Expectation(match[1], float(match[2]), float(match[3]))
