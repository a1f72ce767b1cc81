#!/usr/bin/env python
"""Write docs/scenes.md, the reference of scene files, from their JSON schema.

    .venv/bin/python scripts/make_scene_reference.py [--check]

With --check nothing is written; the exit code is 1 if the file is out of date.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

from dem_mpi.scenario import json_schema

PAGE = Path(__file__).resolve().parent.parent / "docs" / "scenes.md"

INTRODUCTION = """\
# Scene files

A scene is a YAML file in SI units; `configs/` holds examples, `dem-mpi check SCENE` says what is \
wrong with one and what it would take. Every key is below: a section in the file is a section \
here, `[]` stands for each entry of a list. A key without a default is required. Unknown keys, \
duplicate keys and quoted numbers are errors. On the command line, `--set time.end=2` or \
`--set bodies.0.count=500` overrides a key.

Editors complete and check scenes with the schema: `dem-mpi schema > scene.schema.json`, then \
`# yaml-language-server: $schema=scene.schema.json` in the scene's first line.

This page is made from the schema by `scripts/make_scene_reference.py`.
"""

Schema = dict[str, Any]

# Names a choice of sections in a heading, but is no part of the path to a key in it.
_CHOICE = re.compile(r"\[[a-z_]+\]$")


def main() -> int:
    text = page(json_schema())
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(text)
        return 0
    if PAGE.exists() and PAGE.read_text() == text:
        return 0
    print(f"{PAGE.name} is out of date: run scripts/make_scene_reference.py", file=sys.stderr)
    return 1


def page(schema: Schema) -> str:
    """Return the whole page: one table a section, in the order of the file."""
    parts = [INTRODUCTION]
    _add_section(parts, "The file", schema, schema, {})
    return "\n".join(parts)


def _add_section(
    parts: list[str], path: str, section: Schema, schema: Schema, done: dict[str, str]
) -> None:
    """Append the table of a section, then the sections it contains."""
    title = path if path == "The file" else f"`{path}`"
    parts.append(f"## {title}\n")
    if section.get("description") and path != "The file":
        parts.append(f"{_sentence(section['description'])}\n")
    parts.append("| key | value | unit | default | |\n|---|---|---|---|---|")
    required = section.get("required", [])
    inner: list[tuple[str, Schema]] = []
    for key, entry in section["properties"].items():
        sections = _sections_of(entry, schema)
        default = "" if key in required else _default(entry, bool(sections))
        value = "section" if sections and not _is_list(entry) else _value(entry, schema)
        parts.append(
            f"| `{key}` | {value} | {entry.get('unit', '')} | {default} | {_meaning(entry)} |"
        )
        inner += [(key + suffix, found) for suffix, found in sections]
    parts.append("")
    for key, found in inner:
        inside = key if path == "The file" else f"{_CHOICE.sub('', path)}.{key}"
        if found["title"] in done:
            parts.append(f"## `{inside}`\n\nThe keys of `{done[found['title']]}`.\n")
            continue
        done[found["title"]] = inside
        _add_section(parts, inside, found, schema, done)


def _sections_of(entry: Schema, schema: Schema) -> list[tuple[str, Schema]]:
    """Return the sections that a key may hold, with what to append to its name."""
    if "$ref" in entry:
        found = schema["$defs"][entry["$ref"].rsplit("/", 1)[1]]
        return [("", found)] if "properties" in found else _sections_of(found, schema)
    if isinstance(entry.get("additionalProperties"), dict):
        return [(".NAME", s) for _, s in _sections_of(entry["additionalProperties"], schema)]
    if "patternProperties" in entry:
        (value,) = entry["patternProperties"].values()
        return [(".NAME", s) for _, s in _sections_of(value, schema)]
    if isinstance(entry.get("items"), dict):
        found = _sections_of(entry["items"], schema)
        # Sections to choose from have a key that names the choice.
        return [("[]" if len(found) == 1 else f"[shape={_shape(s)}]", s) for _, s in found]
    choices = entry.get("anyOf") or entry.get("oneOf") or []
    found = [section for choice in choices for section in _sections_of(choice, schema)]
    if len(found) > 1 and all(suffix == "" and len(s["properties"]) == 1 for suffix, s in found):
        # Sections to choose from that hold one key each are named by it.
        return [(f"[{next(iter(s['properties']))}]", s) for _, s in found]
    return found


def _shape(section: Schema) -> str:
    return section["properties"]["shape"]["const"]


def _is_list(entry: Schema) -> bool:
    return entry.get("type") == "array" or bool(entry.get("anyOf") and "unit" in entry)


def _value(entry: Schema, schema: Schema) -> str:
    """Say what may stand behind a key."""
    if "$ref" in entry:
        found = schema["$defs"][entry["$ref"].rsplit("/", 1)[1]]
        return "section" if "properties" in found else _value(found, schema)
    if "const" in entry:
        return f"`{entry['const']}`"
    if "enum" in entry:
        return ", ".join(f"`{choice}`" for choice in entry["enum"])
    choices = entry.get("anyOf") or entry.get("oneOf")
    if choices:
        found = [_value(c, schema) for c in choices if c.get("type") != "null"]
        return " or ".join(dict.fromkeys(found))
    kind = entry.get("type")
    if kind == "array":
        if "prefixItems" in entry:
            first = entry["prefixItems"][0]
            return f"{len(entry['prefixItems'])} {_plural(first, _value(first, schema))}"
        return "list of " + _plural(entry["items"], _value(entry["items"], schema))
    if kind == "object":
        return "sections by name"
    word = {"integer": "whole number", "boolean": "`true`, `false`", "string": "text"}
    return f"{word.get(kind, 'number')}{_bounds(entry)}"


def _plural(entry: Schema, value: str = "") -> str:
    if entry.get("type") in ("number", "integer"):
        return f"numbers{_bounds(entry)}"
    if entry.get("type") == "string" and "enum" not in entry:
        return "texts"
    if "prefixItems" in entry:
        return f"lists of {value}"
    return "sections" if value in ("section", "") or " or " in value else value


def _bounds(entry: Schema) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    rules = [f"{sign} {_number(entry[rule])}" for rule, sign in signs.items() if rule in entry]
    return " " + ", ".join(rules) if rules else ""


def _number(value: float) -> str:
    return f"2^{value.bit_length() - 1}" if _is_large_power(value) else f"{value:g}"


def _is_large_power(value: float) -> bool:
    return isinstance(value, int) and value > 10**6 and value & (value - 1) == 0


def _default(entry: Schema, section: bool) -> str:
    value = entry.get("default")
    if section and ("default" not in entry or isinstance(value, dict)):
        return "its defaults"
    if value in (None, [], ""):
        return "none"
    return f"`{json.dumps(value)}`".replace('"', "")


def _meaning(entry: Schema) -> str:
    """Return the description without the unit, which has a column of its own."""
    text = entry.get("description", "").removesuffix(f" [{entry.get('unit', '')}]")
    return _sentence(text).replace("|", "\\|").replace("<", "&lt;")


def _sentence(text: str) -> str:
    return " ".join(text.split())


if __name__ == "__main__":
    sys.exit(main())
