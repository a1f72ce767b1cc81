"""One readable message for what is wrong with a scene: place, key, value, rule, remedy."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable
from typing import Any

from pydantic import ValidationError

from dem_mpi.errors import InputError
from dem_mpi.yaml_reader import Document, KeyPath, describe, join, shorten, show

Schema = dict[str, Any]

_BOUNDS = {
    "greater_than": ("gt", "must be > {}"),
    "greater_than_equal": ("ge", "must be >= {}"),
    "less_than": ("lt", "must be < {}"),
    "less_than_equal": ("le", "must be <= {}"),
    "too_short": ("min_length", "must have at least {} item(s)"),
    "too_long": ("max_length", "must have at most {} item(s)"),
    "string_too_short": ("min_length", "must have at least {} character(s)"),
    "string_too_long": ("max_length", "must have at most {} characters"),
}
_LARGEST = 2.0**63  # whole numbers from here on are read as floats
_TOO_LARGE = "must be a whole number of at most 18 digits"
_UNION_MEMBERS = {
    "<number>", "<list>", "<uniform>", "<lognormal>", "<weighted>", "<mix>", "<bound>", "<exact>",
}  # fmt: skip
_TAG_STARTS = ("literal[", "tuple[", "[key]")
_KINDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
}


def message(document: Document, path: KeyPath, rule: str) -> str:
    """`file:line: key.path = value: rule`."""
    try:
        value = document.value(path)
    except LookupError:
        return f"{document.place(path)}: {join(path)}: {rule}"
    bulky = isinstance(value, (dict, list)) and len(show(value)) > 50
    if not path or bulky:
        return f"{document.place(path)}: {join(path) or 'scene'}: {rule}"
    return f"{document.place(path)}: {join(path)} = {show(value)}: {rule}"


def nearest(word: str, known: Iterable[str]) -> str:
    """A remedy for a misspelt word: the nearest known one, or the list of them."""
    known = list(itertools.islice(known, 200))
    close = difflib.get_close_matches(word[:64], known, n=1)
    close = close or difflib.get_close_matches(word[:64].lower(), known, n=1)
    if close:
        return f". Did you mean '{close[0]}'?"
    return f"; known here: {shorten(', '.join(known), 200)}" if known else ""


def explain(error: ValidationError, document: Document, schema: Schema) -> InputError:
    """The one error to tell: misspelt keys first, missing keys last, otherwise by position.

    A misspelt required key makes two findings; the misspelling is the one to name.
    """
    order = {"extra_forbidden": 0, "missing": 2}
    findings = error.errors(include_url=False, include_context=True)
    # A list none of whose items is right counts as too short as well.
    wrong = [finding["loc"] for finding in findings]
    first = min(
        (f for f in findings if not (f["type"] == "too_short" and _holds(f["loc"], wrong))),
        key=lambda finding: (_misses_a_word(finding), order.get(finding["type"], 1)),
    )
    path = _without_tags(first["loc"])
    if first["type"] == "missing" and isinstance(path[-1], int):
        path = path[:-1]
    if first["type"] == "union_tag_invalid":
        path = (*path, "shape")
    return InputError(message(document, path, _rule(first, path, document, schema)))


def _misses_a_word(finding: Any) -> bool:
    """Whether no text was written where a word may stand: then something else was meant."""
    return finding["type"] == "literal_error" and not isinstance(finding["input"], str)


def _holds(location: tuple, others: Iterable[tuple]) -> bool:
    """Whether something else stands inside what is at `location`."""
    depth = len(location)
    return any(len(other) > depth and other[:depth] == location for other in others)


def _without_tags(location: tuple[str | int, ...]) -> KeyPath:
    """Pydantic's location without the names of union members and the marks of dict keys."""
    if location[:1] == ("walls",) and len(location) > 2:
        location = location[:2] + location[3:]
    return tuple(key for key in location if not _is_tag(key))


def _is_tag(key: str | int) -> bool:
    """Whether a part of pydantic's location names a union's member, or the key of a mapping."""
    return isinstance(key, str) and (key in _UNION_MEMBERS or key.startswith(_TAG_STARTS))


def _rule(finding: Any, path: KeyPath, document: Document, schema: Schema) -> str:
    kind, context, value = finding["type"], finding.get("ctx", {}), finding["input"]
    if kind == "extra_forbidden":
        return "unknown key" + _suggest(path, document, schema)
    if kind == "missing":
        if isinstance(finding["loc"][-1], int):
            return f"must be a list of more than {finding['loc'][-1]} items"
        return f"this key is required{_unit(path, document, schema)}"
    if kind in _BOUNDS:
        key, text = _BOUNDS[kind]
        return text.format(f"{context[key]:g}") + _unit(path, document, schema)
    if kind == "int_type" and isinstance(value, float):
        if abs(value) >= _LARGEST:
            return _TOO_LARGE
        return "must be a whole number" + (f"; write {value:.0f}" if value.is_integer() else "")
    if kind in _KINDS:
        return f"must be {_KINDS[kind]}, not {describe(value)}" + _hint(kind, value)
    if kind == "finite_number":
        return "must be a finite number"
    if kind == "int_parsing_size":
        return _TOO_LARGE
    if kind == "int_from_float":
        return "must be a whole number"
    if kind == "literal_error":
        return _one_of(value, context["expected"].replace(" or ", ", "))
    if kind == "union_tag_invalid":
        return _one_of(value["shape"], context["expected_tags"])
    if kind == "union_tag_not_found":
        return "shape is required: plane or box"
    if kind == "string_pattern_mismatch":
        return _pattern_rule(path)
    if kind == "value_error":
        return str(context.get("error", finding["msg"]))
    return shorten(finding["msg"], 200)


def _one_of(value: Any, choices_text: str) -> str:
    choices = [choice.strip("' ") for choice in choices_text.split(",")]
    close = difflib.get_close_matches(str(value)[:64].lower(), choices, n=1)
    remedy = f". Did you mean '{close[0]}'?" if close else ""
    return f"must be {'one of ' * (len(choices) > 1)}{', '.join(choices)}{remedy}"


def _pattern_rule(path: KeyPath) -> str:
    if path[:1] == ("output",):
        return "must be a plain file name ending in .h5; --out names the directory"
    return "a name starts with a letter and has letters, digits, _ and - only"


def _hint(kind: str, value: Any) -> str:
    """Why something that looks like a number is none."""
    if kind not in ("float_type", "int_type") or not isinstance(value, str):
        return ""
    for text, advice in (
        (value, "without quotes"),
        (value.replace(",", "."), "with a decimal point"),
        (value.replace("_", ""), "without _"),
    ):
        try:
            number = float(text)
        except ValueError:
            continue
        return f"; write {number:g} {advice}"
    return ""


def _unit(path: KeyPath, document: Document, schema: Schema) -> str:
    """The unit of the key, or of the list that the path's last item stands in."""
    while path and isinstance(path[-1], int):
        path = path[:-1]
    if not path:
        return ""
    for node in _sections(path[:-1], document, schema):
        unit = node.get("properties", {}).get(path[-1], {}).get("unit")
        if unit and unit != "1":
            return f" [{unit}]"
    return ""


def _suggest(path: KeyPath, document: Document, schema: Schema) -> str:
    """The nearest valid key of this section, else the section where the key does belong."""
    word = str(path[-1])
    known = [
        key for node in _sections(path[:-1], document, schema) for key in node.get("properties", {})
    ]
    if not difflib.get_close_matches(word.lower(), known, n=1):
        homes = [
            name for name, node in schema["$defs"].items() if word in node.get("properties", {})
        ]
        if word in schema["properties"]:
            return f"; '{word}' is a key of the scene itself, not of {join(path[:-1])}"
        if homes:
            return f"; '{word}' is a key of {_home(homes[0])}"
    return nearest(word, known)


def _home(model: str) -> str:
    """Where a model stands in a scene."""
    return {
        "Material": "materials.<name>",
        "BodyGroup": "bodies[i]",
        "JitteredGrid": "bodies[i].placement.jittered_grid",
        "Placement": "bodies[i].placement",
        "RandomPlacement": "bodies[i].placement.random",
        "Insertion": "bodies[i].placement.insertion",
        "UniformRadius": "bodies[i].radius",
        "Lognormal": "bodies[i].radius.lognormal",
        "Weighted": "bodies[i].radius.weighted",
        "Mix": "bodies[i].radius.mix",
        "Removal": "removal[i]",
        "PlaneWall": "walls[i]",
        "BoxWall": "walls[i]",
        "Motion": "walls[i].motion",
        "Oscillation": "walls[i].motion.oscillation",
        "FrictionPair": "friction.pairs[i]",
        "Rest": "time.stop_at_rest",
        "CompressedFields": "compress.fields",
        "ErrorBound": "compress.fields.<field>",
    }.get(model, model.lower())


def _sections(path: KeyPath, document: Document, schema: Schema) -> list[Schema]:
    """The parts of the JSON schema that may describe the section at `path`."""
    nodes = _variants(schema, schema)
    for depth, key in enumerate(path, start=1):
        found: list[Schema] = []
        for node in nodes:
            if isinstance(key, int):
                child = node.get("items")
            else:
                # A mapping by name (materials) has one pattern that all its keys follow.
                named = next(iter(node.get("patternProperties", {}).values()), None)
                child = node.get("properties", {}).get(key, named)
            if isinstance(child, dict):
                found += _variants(child, schema)
        nodes = _of_shape(found, document, path[:depth])
    return nodes


def _variants(node: Schema, schema: Schema) -> list[Schema]:
    """A schema with references followed and alternatives spread out."""
    if "$ref" in node:
        return _variants(schema["$defs"][node["$ref"].rpartition("/")[2]], schema)
    alternatives = [alternative for key in ("oneOf", "anyOf") for alternative in node.get(key, [])]
    return [node] + [
        variant
        for alternative in alternatives
        if "required" not in alternative
        for variant in _variants(alternative, schema)
    ]


def _of_shape(nodes: list[Schema], document: Document, path: KeyPath) -> list[Schema]:
    """Only the variants whose fixed `shape` is the one written, where one is."""
    try:
        section = document.value(path)
    except LookupError:
        return nodes
    shape = section.get("shape") if isinstance(section, dict) else None
    fitting = [n for n in nodes if n.get("properties", {}).get("shape", {}).get("const") == shape]
    return fitting or nodes
