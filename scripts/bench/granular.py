"""Scenes of granular flow against the laws that experiments have found.

    python scripts/bench/granular.py STUDY [--quick] [--json FILE] [--figure FILE]

hopper: mass flow against the width of the outlet. drum: angle of repose against friction and
speed, torque and power balance. column: run-out of a collapsing column against its aspect ratio.
On one core; finished runs stay under build/bench and are taken from there. FILE of --json keeps
the records of the other studies. docs/validation.md explains the figures.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from lib import granular_column, granular_drum, granular_hopper
from records import Record, arguments, save, write


class Study(NamedTuple):
    """`run(quick)`: records named granular.<study>.*, and what `draw(found, path)` needs."""

    run: Callable[[bool], tuple[list[Record], Any]]
    draw: Callable[[Any, Path], None]


STUDIES = {
    "hopper": Study(granular_hopper.study, granular_hopper.draw),
    "drum": Study(granular_drum.study, granular_drum.draw),
    "column": Study(granular_column.study, granular_column.draw),
}


def others(path: Path | None, study: str) -> list[Record]:
    """The records that a file holds of other studies."""
    if path is None or not path.exists():
        return []
    kept = [Record(**row) for row in json.loads(path.read_text())]
    return [record for record in kept if record.name.split(".")[1] != study]


def main() -> None:
    """Parse the options, run one study and write its records and figure."""
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("study", choices=STUDIES)
    options = parser.parse_args()
    study = STUDIES[options.study]
    records, found = study.run(options.quick)
    write(records)
    save([*others(options.json, options.study), *records], options.json)
    if options.figure:
        study.draw(found, options.figure)


if __name__ == "__main__":
    main()
