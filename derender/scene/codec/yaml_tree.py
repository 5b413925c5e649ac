"""Strict YAML: a file becomes a tree of nodes (`yaml_nodes`) that know their file, line and address; and back.

PyYAML parses; nothing is constructed.  Refused, each with its line: duplicate keys, tabs, tags, several documents,
aliases that blow up, deep nesting, huge files. What is written (`to_yaml`) reads back bit for bit.
"""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from derender.errors import DerenderError
from derender.scene.codec.yaml_nodes import Item, List, Node, Section, reads_as_text, shown, write_number

__all__ = ["Item", "List", "Node", "Section", "parse_yaml", "read_yaml"]

MOST_BYTES = 4_000_000
MOST_NODES = 100_000
MOST_DEPTH = 32


def read_yaml(path: str | Path) -> Section:
    """Read one strict YAML file; its top must be a section.

    Raises DerenderError : one line with file, line, address and remedy, for anything wrong with it.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except FileNotFoundError:
        raise DerenderError("there is no such file", path, "check the path") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise DerenderError(f"cannot be read: {getattr(error, 'strerror', None) or error}", where=path) from None
    return parse_yaml(data, str(path))


def parse_yaml(data: bytes | str, file: str = "YAML") -> Section:
    """Parse strict YAML text; see `read_yaml`.  `file` is its name in messages."""
    if isinstance(data, bytes):
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise DerenderError("this is text in UTF-16", file, "save the file as UTF-8")
        if b"\0" in data:
            remedy = "give a scene file; what a depth image shows is found by `derender infer`"
            raise DerenderError("this is no scene file: it holds no text", file, remedy)
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = data[: error.start].count(b"\n") + 1
            raise Node(file, line, "").fault("this is not text in UTF-8", "save the file as UTF-8") from None
    else:
        text = data
    if len(text) > MOST_BYTES:
        raise DerenderError(
            f"the file is larger than {MOST_BYTES // 1_000_000} MB", where=file, remedy="is it a scene?"
        )
    for number, content in enumerate(text.splitlines(), start=1):
        if "\t" in content and not content[: content.index("\t")].strip():
            raise Node(file, number, "").fault("a tab indents this line", "indent with spaces")
    loader = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader
    try:
        top = _Builder(file).build(yaml.parse(text, Loader=loader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = Node(file, mark.line + 1 if mark else 1, "")
        raise place.fault(
            f"this is not YAML: {error.problem or error.context}", "look at this line and the one above"
        ) from None
    except yaml.YAMLError as error:
        raise DerenderError(f"this is not YAML: {str(error).splitlines()[0]}", where=file) from None
    if not isinstance(top, Section):
        raise top.fault(f"here stands {top.kind}", "a file starts with keys, such as derender: 1")
    return top


class _Builder:
    """Turns parser events into nodes without recursion, so that no nesting can exhaust the stack."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.anchors: dict[str, list[Any]] = {}
        self.open: list[int] = []  # where in the record each collection that is not yet closed begins
        self.count = 0

    def build(self, events: Iterator[Any]) -> Node:
        recorded: list[Any] = []
        documents = 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise self._place(event).fault("a second document starts here", "one file is one document")
            elif isinstance(event, yaml.NodeEvent | yaml.CollectionEndEvent):
                self._tally(event)
                if isinstance(event, yaml.AliasEvent):
                    recorded.extend(self._expand(event))
                else:
                    recorded.append(event)
                    self._record_anchor(event, recorded)
        if not recorded:
            raise Node(self.file, 1, "").fault("the file is empty", "a scene starts with derender: 1")
        return self._assemble(recorded)

    def _place(self, event: Any, address: str = "") -> Node:
        return Node(self.file, event.start_mark.line + 1, address)

    def _tally(self, event: Any, number: int = 1) -> None:
        self.count += number
        if self.count > 2 * MOST_NODES:
            raise self._place(event).fault(f"more than {MOST_NODES} values", "aliases may have multiplied them")

    def _record_anchor(self, event: Any, recorded: list[Any]) -> None:
        """Remember what an anchor names once it is complete; an alias inside its own anchor finds nothing."""
        if isinstance(event, yaml.CollectionStartEvent):
            self.open.append(len(recorded) - 1)
            if len(self.open) > MOST_DEPTH:
                raise self._place(event).fault(f"nested more than {MOST_DEPTH} deep", "is it a scene?")
        elif isinstance(event, yaml.CollectionEndEvent):
            start = self.open.pop()
            if recorded[start].anchor:
                self.anchors[recorded[start].anchor] = recorded[start:]
        elif event.anchor:
            self.anchors[event.anchor] = [event]

    def _expand(self, event: Any) -> list[Any]:
        if event.anchor not in self.anchors:
            raise self._place(event).fault(f"the alias *{event.anchor} has no complete anchor above it", "write it out")
        events = self.anchors[event.anchor]
        self._tally(event, len(events))
        return events

    def _assemble(self, events: list[Any]) -> Node:
        """Build the tree from events without aliases."""
        stack: list[tuple[Node, Any]] = []  # open collections, each with its pending key
        for event in events:
            if isinstance(event, yaml.CollectionEndEvent):
                node, _ = stack.pop()
            else:
                if event.tag not in (None, "!") and not (isinstance(event, yaml.ScalarEvent) and event.implicit[1]):
                    raise self._place(event).fault(f"the tag {shown(event.tag)} is not read", "leave the tag out")
                parent, key = stack[-1] if stack else (None, None)
                if isinstance(parent, Section) and key is None:
                    self._take_key(stack, parent, event)
                    continue
                node = self._start(event, parent, key)
                if isinstance(event, yaml.CollectionStartEvent):
                    stack.append((node, None))
                    if len(stack) > MOST_DEPTH:
                        raise node.fault(f"nested more than {MOST_DEPTH} deep", "is it a scene?")
                    continue
            if not stack:
                return node
            parent, key = stack[-1]
            if isinstance(parent, Section):
                parent.nodes[key.value] = node
                stack[-1] = (parent, None)
            else:
                parent.nodes.append(node)  # type: ignore[attr-defined]
        raise AssertionError("the parser closes what it opens")

    def _start(self, event: Any, parent: Node | None, key: Any) -> Node:
        if isinstance(parent, Section):
            address = f"{parent.address}.{key.value}" if parent.address else key.value
        elif isinstance(parent, List):
            address = f"{parent.address}[{len(parent.nodes)}]"
        else:
            address = ""
        line = event.start_mark.line + 1
        if isinstance(event, yaml.ScalarEvent):
            return Item(self.file, line, address, event.value, bool(event.style))
        if isinstance(event, yaml.SequenceStartEvent):
            return List(self.file, line, address, [])
        return Section(self.file, line, address, {}, {})

    def _take_key(self, stack: list, parent: Section, event: Any) -> None:
        place = self._place(event, parent.address)
        if not isinstance(event, yaml.ScalarEvent):
            raise place.fault("a key has to be a name", "write name: value")
        key = event.value
        if not event.style and key == "<<":
            raise place.fault("merging with << is not read", "write the keys out")
        if not key or (not event.style and re.fullmatch(r"~|null", key, re.IGNORECASE)):
            raise place.fault("a key is empty", "write name: value")
        if key in parent.nodes:
            raise place.fault(
                f"the key {shown(key)} stands here for the second time, first on line {parent.lines[key]}", "keep one"
            )
        parent.lines[key] = place.line
        stack[-1] = (parent, event)


_PLAIN = re.compile(r"[A-Za-z0-9_+/.-]([A-Za-z0-9_+/. -]*[A-Za-z0-9_+/.-])?")


def to_yaml(data: Mapping[str, Any], block_levels: Mapping[str, int] | None = None) -> str:
    """Return YAML text of a mapping.

    `block_levels` says for a key of the top how many levels below it get a line for each entry (0 when not named).
    """
    lines = []
    for key, value in data.items():
        _emit(lines, 0, key, value, (block_levels or {}).get(key, 0))
    return "\n".join(lines) + "\n"


def _emit(lines: list[str], indent: int, key: str, value: Any, levels: int) -> None:
    start = " " * indent + _quoted(key) + ":"
    if levels > 0 and isinstance(value, Mapping) and value:
        lines.append(start)
        for inner, item in value.items():
            _emit(lines, indent + 2, inner, item, levels - 1)
    else:
        lines.append(f"{start} {_flow(value)}")


def _flow(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_quoted(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None:
        return "null"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return write_number(value if isinstance(value, int) else float(value))


def _quoted(value: object) -> str:
    """Return a text plain where every reader takes it for text, else in double quotes."""
    value = str(value)
    if _PLAIN.fullmatch(value) and reads_as_text(value) and not value.startswith(("- ", "-- ", "---")) and value != "-":
        return value
    return json.dumps(value)  # JSON's escapes are YAML's
