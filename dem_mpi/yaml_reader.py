"""YAML text to plain Python data, with the line of every key, and refusal of anything unusual.

Numbers, booleans and null follow the YAML 1.2 core schema: `1e-3` is a number, `1:30`, `yes`
and `1_000` are text. The parser's events are read one by one, so limits on size, depth and
alias expansion stop a hostile file before it costs memory. No tag is honoured: nothing in a
file can name a Python object.
"""

from __future__ import annotations

import copy
import difflib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dem_mpi.errors import InputError

MAX_BYTES = 1_000_000
MAX_DEPTH = 32
MAX_NODES = 100_000
MAX_ALIASES = 100

KeyPath = tuple[str | int, ...]

# libyaml's parser is some ten times faster; the events are the same.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_NULLS = {"", "~", "null", "Null", "NULL"}
_BOOLEANS = {"true": True, "True": True, "TRUE": True} | {
    "false": False,
    "False": False,
    "FALSE": False,
}
_INTEGER = re.compile(r"[-+]?[0-9]{1,18}|0o[0-7]{1,20}|0x[0-9a-fA-F]{1,15}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NON_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


@dataclass(frozen=True)
class Document:
    """Data of a scene and where each key of it was written.

    `places` maps a key path to "file:line", or to "--set key=value" for an override.
    """

    data: dict[str, Any]
    places: dict[KeyPath, str]

    def place(self, path: KeyPath) -> str:
        """Where `path`, or the nearest section around it, was written."""
        while path not in self.places:
            path = path[:-1]
        return self.places[path]

    def value(self, path: KeyPath) -> Any:
        """The value at `path`. Raises LookupError where there is none."""
        node: Any = self.data
        for key in path:
            if not isinstance(node, (dict, list)):
                raise LookupError(path)
            node = node[key]
        return node


def read_file(path: str | Path) -> str:
    """Text of a scene file. Raises InputError: missing, too large, not UTF-8, empty."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file{_similar_file(path)}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError:
        raise InputError(f"{str(path)!r}: no file can have this name") from None
    if len(raw) > MAX_BYTES:
        raise InputError(f"{path}: larger than {MAX_BYTES} bytes; this is no scene file")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise InputError(f"{path}:{line}: not UTF-8 text; this is no scene file") from None
    return text


def _similar_file(path: Path) -> str:
    try:
        names = [entry.name for entry in path.parent.iterdir() if entry.suffix in (".yaml", ".yml")]
    except OSError:
        return ""
    close = difflib.get_close_matches(path.name, names, n=1)
    return f". Did you mean '{path.parent / close[0]}'?" if close else ""


def parse(text: str, source: str) -> Document:
    """Data and places of one YAML document that is a mapping. Raises InputError."""
    builder = _Builder(source)
    try:
        for event in yaml.parse(text, Loader=_Loader):
            builder.take(event)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise InputError(f"{source}:{line}: not valid YAML: {_one_line(error.problem)}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{source}: not valid YAML: {_one_line(error)}") from None
    if builder.documents == 0 or builder.root is None:
        raise InputError(f"{source}: empty; a scene needs domain, materials, bodies and time")
    if not isinstance(builder.root, dict):
        raise InputError(
            f"{source}:1: a scene is a mapping of keys to values, not {describe(builder.root)}"
        )
    return Document(builder.root, builder.places)


def _one_line(problem: object) -> str:
    return " ".join(str(problem).split())[:200]


@dataclass
class _Open:
    """A mapping or list that is being filled."""

    value: dict[str, Any] | list[Any]
    anchor: str | None
    first_node: int
    key: str | None = None
    height: int = 1


@dataclass(frozen=True)
class _Anchored:
    value: Any
    nodes: int
    height: int


class _Builder:
    """Builds data from parser events; the stack of open nodes is explicit, never recursive."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.root: Any = None
        self.documents = 0
        self.places: dict[KeyPath, str] = {(): f"{source}:1"}
        self._stack: list[_Open] = []
        self._path: list[str | int] = []
        self._anchors: dict[str, _Anchored | None] = {}
        self._nodes = 0
        self._aliases = 0
        self._line = 1

    def take(self, event: yaml.Event) -> None:
        """One parser event."""
        self._line = event.start_mark.line + 1
        if isinstance(event, yaml.DocumentStartEvent):
            self.documents += 1
            if self.documents > 1:
                self._fail("a second YAML document starts here; a scene file holds one")
        elif isinstance(event, yaml.AliasEvent):
            self._alias(event.anchor)
        elif isinstance(event, yaml.ScalarEvent):
            self._scalar(event)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._open(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._close()

    def _fail(self, rule: str) -> None:
        where = f"{join(tuple(self._path))}: " if self._path else ""
        raise InputError(f"{self.source}:{self._line}: {where}{rule}")

    def _count(self, nodes: int) -> None:
        self._nodes += nodes
        if self._nodes > MAX_NODES:
            self._fail(f"more than {MAX_NODES} values, aliases expanded; this is no scene file")

    def _refuse_tag(self, event: yaml.NodeEvent) -> None:
        if event.tag not in (None, "!"):
            self._fail(f"tag {event.tag!r} is not allowed; write the plain value")

    def _scalar(self, event: yaml.ScalarEvent) -> None:
        self._refuse_tag(event)
        parent = self._stack[-1] if self._stack else None
        if parent is not None and isinstance(parent.value, dict) and parent.key is None:
            self._start_key(parent, event)
            return
        value = _resolve(event.value) if event.implicit[0] else event.value
        self._count(1)
        if event.anchor:
            self._anchors[event.anchor] = _Anchored(value, 1, 0)
        self._store(value, 0)

    def _start_key(self, parent: _Open, event: yaml.ScalarEvent) -> None:
        if event.anchor:
            self._fail("a key cannot carry an anchor")
        key = event.value
        self._path.append(key)
        if key in parent.value:
            first = self.places[tuple(self._path)].rpartition(":")[2]
            self._fail(f"duplicate key; the first one is in line {first}")
        parent.key = key
        self.places[tuple(self._path)] = f"{self.source}:{self._line}"

    def _enter(self) -> None:
        """Check that a node may stand here, and note its place when it is a list's item."""
        if not self._stack:
            return
        parent = self._stack[-1]
        if isinstance(parent.value, dict):
            if parent.key is None:
                self._fail("a key must be plain text")
        else:
            self._path.append(len(parent.value))
            self.places[tuple(self._path)] = f"{self.source}:{self._line}"
            self._path.pop()

    def _open(self, event: yaml.CollectionStartEvent) -> None:
        self._refuse_tag(event)
        self._enter()
        self._count(1)
        if len(self._stack) >= MAX_DEPTH:
            self._fail(f"nested more than {MAX_DEPTH} levels deep")
        if self._stack and isinstance(self._stack[-1].value, list):
            self._path.append(len(self._stack[-1].value))
        if event.anchor:
            self._anchors[event.anchor] = None
        value: dict[str, Any] | list[Any] = {}
        if isinstance(event, yaml.SequenceStartEvent):
            value = []
        self._stack.append(_Open(value, event.anchor, self._nodes))

    def _close(self) -> None:
        done = self._stack.pop()
        if done.anchor:
            nodes = self._nodes - done.first_node + 1
            self._anchors[done.anchor] = _Anchored(done.value, nodes, done.height)
        if self._stack and isinstance(self._stack[-1].value, list):
            self._path.pop()
        self._store(done.value, done.height, entered=True)

    def _alias(self, name: str) -> None:
        self._enter()
        self._aliases += 1
        if self._aliases > MAX_ALIASES:
            self._fail(f"more than {MAX_ALIASES} aliases; write the values out")
        anchored = self._anchors.get(name)
        if anchored is None:
            self._fail(f"alias *{name} stands for nothing that is complete before it")
            return
        self._count(anchored.nodes)
        if len(self._stack) + anchored.height > MAX_DEPTH:
            self._fail(f"nested more than {MAX_DEPTH} levels deep")
        self._store(copy.deepcopy(anchored.value), anchored.height, entered=True)

    def _store(self, value: Any, height: int, entered: bool = False) -> None:
        """Put a finished value into its parent."""
        if not entered:
            self._enter()
        if not self._stack:
            self.root = value
            return
        parent = self._stack[-1]
        parent.height = max(parent.height, height + 1)
        if isinstance(parent.value, dict):
            parent.value[parent.key] = value
            parent.key = None
            self._path.pop()
        else:
            parent.value.append(value)


def _resolve(text: str) -> Any:
    """Value of a plain scalar under the YAML 1.2 core schema."""
    if text in _NULLS:
        return None
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if _INTEGER.fullmatch(text):
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _NON_FINITE.fullmatch(text):
        return float(text.replace(".", ""))
    return text


def override(document: Document, assignments: Sequence[str]) -> Document:
    """A document with `key.path=value` assignments applied in turn. Raises InputError.

    List items are named `bodies.0.count` or `bodies[0].count`; sections that are missing are
    made. Values are YAML, so `gravity=[0,0,0]` and `time.stop_at_rest=null` work.
    """
    data = copy.deepcopy(document.data)
    places = dict(document.places)
    for assignment in assignments:
        source = f"--set {shorten(assignment)}"
        text, equals, value_text = assignment.partition("=")
        if not equals:
            raise InputError(f"{source}: write --set key.path=value")
        path = _assign(data, split(text, source), _override_value(value_text, source), source)
        for old in [known for known in places if known[: len(path)] == path]:
            del places[old]
        for depth in range(1, len(path) + 1):
            if depth == len(path) or path[:depth] not in places:
                places[path[:depth]] = source
    return Document(data, places)


def _override_value(text: str, source: str) -> Any:
    try:
        data = parse(f"value: {text}", source).data
    except InputError as error:
        message = str(error).removeprefix(source)
        raise InputError(source + re.sub(r"^:\d+:(?: value:)?", ":", message)) from None
    if len(data) > 1:
        raise InputError(f"{source}: one value on one line is expected")
    return data["value"]


def split(text: str, source: str = "--set") -> list[str]:
    """Keys of a dotted path; `a[0].b` is the same as `a.0.b`."""
    keys = re.sub(r"\[(\d{1,9})\]", r".\1", text.strip()).split(".")
    if not all(keys) or any(set("[]{}, \t") & set(key) for key in keys) or len(keys) > MAX_DEPTH:
        raise InputError(f"{source}: '{shorten(text)}' is no key path such as bodies.0.count")
    return keys


def _assign(data: dict[str, Any], keys: list[str], value: Any, source: str) -> KeyPath:
    """Set one value and return its typed path."""
    node: Any = data
    path: KeyPath = ()
    for position, key in enumerate(keys):
        last = position == len(keys) - 1
        if isinstance(node, list):
            if not key.isdecimal() or int(key) >= len(node):
                raise InputError(
                    f"{source}: {join(path)} has {len(node)} items, numbered from 0; "
                    f"'{key}' is none of them"
                )
            step: str | int = int(key)
        elif isinstance(node, dict):
            step = key
            if not last and node.get(key) is None:
                node[key] = {}
        else:
            raise InputError(f"{source}: {join(path)} = {shorten(show(node))} has no keys")
        path = (*path, step)
        if last:
            node[step] = value
        node = node[step]
    return path


def join(path: KeyPath) -> str:
    """A key path as the user writes it: bodies[0].radius."""
    text = ""
    for key in path:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else str(key)
    return shorten(text, 200)


def show(value: Any) -> str:
    """A value as YAML would have it on one line, shortened."""
    if isinstance(value, float) and not isinstance(value, bool):
        return repr(value).replace("inf", ".inf").replace("nan", ".nan")
    try:
        return shorten(json.dumps(value, ensure_ascii=False))
    except (TypeError, ValueError):
        return shorten(repr(value))


def shorten(text: str, width: int = 60) -> str:
    """At most `width` printable characters of a text."""
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= width else text[: width - 3] + "..."


def describe(value: Any) -> str:
    """The kind of a value in the user's words."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "a switch (true or false)"
    if isinstance(value, (int, float)):
        return "a number"
    if isinstance(value, str):
        return "text"
    return "a list" if isinstance(value, list) else "a mapping"
