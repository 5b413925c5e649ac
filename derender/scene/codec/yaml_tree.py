"""Strict YAML: a file becomes a tree of nodes that know their file, line and address; and back.

PyYAML parses; nothing is constructed.  Refused, each with its line: duplicate keys, tabs, tags, several documents,
aliases that blow up, deep nesting, huge files. Text becomes a number, a name or a truth value only when the caller asks
for one, and only if every YAML 1.1 reader would agree. What is written (`to_yaml`) reads back bit for bit.
"""

from __future__ import annotations

import codecs
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import yaml

from derender.errors import DerenderError, at_fault
from derender.registry import suggest

MOST_BYTES, MOST_NODES, MOST_DEPTH = 4_000_000, 100_000, 32

# What YAML 1.1 readers take for something else than text when it is not quoted.
_BOOLEAN = re.compile(r"yes|no|on|off|true|false", re.IGNORECASE)
_NOT_TEXT = re.compile(
    r"~|null|[-+]?\.(?:inf|nan)|[-+]?[0-9.][0-9_.:]*(?:e[-+][0-9]+)?|0x[0-9a-f_]+|<<|=", re.IGNORECASE
)
_EXPONENT = re.compile(r"[-+]?[0-9.]+e[0-9]+|[-+]?[0-9]+e[-+]?[0-9]+", re.IGNORECASE)  # numbers to some of them
_VERSION = re.compile(r"[0-9]+(\.[0-9]+){2,}")  # text to them all: other writers of YAML leave its quotes out


@dataclass(eq=False)
class Node:
    """A place in a file, and the single value that stands there; a list and a section are none."""

    file: str  # its name, for messages
    line: int  # from 1
    address: str  # dotted path from the top, such as "objects.red.side"
    raw: str = ""  # the text as it stands in the file
    quoted: bool = False  # it stood in quotes: text, whatever it looks like

    @property
    def kind(self) -> str:
        return "text in quotes" if self.quoted else f"the value {shown(self.raw)}" if self.raw else "nothing"

    @property
    def where(self) -> str:
        return f"{self.file}, line {self.line}" + (f", {self.address}" if self.address else "")

    def fault(self, what: str, remedy: str | None = None) -> DerenderError:
        """Return (to be raised) a DerenderError that names this place."""
        return DerenderError(what, where=self.where, remedy=remedy)

    def _expected(self, what: str) -> NoReturn:
        raise self.fault(f"here stands {self.kind}", f"write {what}")

    def section(self) -> Section:
        """Return the keys with values that stand here."""
        self._expected("a section of keys with values")

    def sequence(self, length: int | None = None) -> list[Node]:
        """Return the nodes of the list that stands here; with `length` there must be as many."""
        self._expected("a list in [brackets]")

    @property
    def empty(self) -> bool:
        """Whether no single value stands here."""
        return not self.quoted and self.raw in ("", "~", "null", "Null", "NULL")

    def number(self, unit: str = "", lower: float | None = None, upper: float | None = None) -> float:
        """Return the number in the base unit; refuse one outside [lower, upper]."""
        if self.empty:
            self._expected("a number")
        with at_fault(self.where):
            value = parse_number(self.raw, unit)
        if self.quoted and not re.search(r"[a-z]\s*$", self.raw):
            what = f"the number {shown(self.raw)} stands in quotes and so is text"
            raise self.fault(what, f"write {self.raw.strip()}")
        self._check_range(value, lower, upper)
        return value

    def integer(self, lower: int | None = None, upper: int | None = None) -> int:
        """Return the whole number; refuse one outside [lower, upper]."""
        value = self.number()
        if value != int(value):
            raise self.fault(f"{shown(self.raw)} is not a whole number", f"write {round(value)}")
        self._check_range(value, lower, upper)
        return int(value)

    def _check_range(self, value: float, lower: float | None, upper: float | None) -> None:
        if lower is not None and value < lower:
            raise self.fault(f"{shown(self.raw)} is too small", f"give at least {lower:g}")
        if upper is not None and value > upper:
            raise self.fault(f"{shown(self.raw)} is too large", f"give at most {upper:g}")

    def text(self, choices: Iterable[str] | None = None) -> str:
        """Return the text; with `choices` it must be one of them."""
        if choices is not None:
            choices = list(choices)
            if self.raw in choices and not self.empty:
                return self.raw
            what = f"here stands {self.kind}" if self.empty else f"{shown(self.raw)} is no choice here"
            raise self.fault(what, suggest(self.raw, choices))
        if self.empty:
            self._expected("a name")
        if not self.quoted and not reads_as_text(self.raw):
            what = f"{self.raw} is not text to a YAML reader"
            raise self.fault(what, f"write '{self.raw}' in quotes or another name")
        return self.raw

    def boolean(self) -> bool:
        """Return a truth value: only `true` and `false` say one."""
        if self.empty:
            self._expected("true or false")
        if not self.quoted and self.raw in ("true", "false"):
            return self.raw == "true"
        right = {"on": "true", "yes": "true", "y": "true", "off": "false", "no": "false", "n": "false"}
        word = self.raw.lower()
        remedy = f"write {right.get(word, word)}" if word in (*right, "true", "false") else "write true or false"
        raise self.fault(f"{shown(self.raw)} is not a truth value", remedy)

    def plain(self) -> Any:
        """Return plain Python data: dict, list, float, int, bool, str or None."""
        if self.empty:
            return None
        if not self.quoted:
            if self.raw in ("true", "false"):
                return self.raw == "true"
            if re.fullmatch(r"[-+]?(0|[1-9][0-9]{0,15})", self.raw):
                return int(self.raw)
            if _VERSION.fullmatch(self.raw):
                return self.raw
            if not reads_as_text(self.raw) or _EXPONENT.fullmatch(self.raw):
                return self.number()
        return self.raw


@dataclass(eq=False)
class List(Node):
    """A sequence of nodes."""

    nodes: list[Node] = field(default_factory=list)
    kind = "a list"  # type: ignore[assignment]

    def sequence(self, length: int | None = None) -> list[Node]:
        """Return the nodes; with `length` there must be as many."""
        if length is not None and len(self.nodes) != length:
            raise self.fault(f"the list has {len(self.nodes)} entries", f"give {length}")
        return self.nodes

    def plain(self) -> list:
        return [node.plain() for node in self.nodes]


@dataclass(eq=False)
class Section(Node):
    """Keys with values, in the order of the file."""

    nodes: dict[str, Node] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)  # of each key
    kind = "a section"  # type: ignore[assignment]

    def section(self) -> Section:
        return self

    def __contains__(self, key: object) -> bool:
        return key in self.nodes

    def __len__(self) -> int:
        return len(self.nodes)

    def items(self) -> Iterable[tuple[str, Node]]:
        return self.nodes.items()

    def __getitem__(self, key: str) -> Node:
        """Return the node under a key, which must be there."""
        try:
            return self.nodes[key]
        except KeyError:
            raise self.fault(f"{key!r} is missing", f"add {key}: ...") from None

    def get(self, key: str) -> Node | None:
        return self.nodes.get(key)

    def allow(self, *keys: str) -> Section:
        """Refuse any other key, and return this section."""
        for key in self.nodes:
            if key not in keys:
                place = Node(self.file, self.lines[key], f"{self.address}.{key}" if self.address else key)
                raise place.fault("this key is unknown here", suggest(key, keys))
        return self

    def only(self) -> tuple[str, Node]:
        """Return the one key and its node, where there must be exactly one."""
        if len(self.nodes) != 1:
            raise self.fault(f"{len(self.nodes)} keys stand here", "give exactly one")
        return next(iter(self.nodes.items()))

    def plain(self) -> dict:
        return {key: node.plain() for key, node in self.nodes.items()}


def reads_as_text(raw: str) -> bool:
    """Say whether every YAML reader takes unquoted `raw` for text."""
    return bool(raw) and not (_BOOLEAN.fullmatch(raw) or _NOT_TEXT.fullmatch(raw))


def shown(text: str) -> str:
    """Quote a piece of input, shortened, in printable characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


# How many of the base unit one named unit is, by base unit.
UNITS: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001}, "rad": {"rad": 1.0, "deg": math.pi / 180.0},
    "kg": {"kg": 1.0, "g": 0.001}, "s": {"s": 1.0, "ms": 0.001}, "px": {"px": 1.0},
    "N": {"N": 1.0, "mN": 0.001, "kN": 1000.0}, "Hz": {"Hz": 1.0}, "": {},
}  # fmt: skip

_DECIMAL = re.compile(r"[-+]?(?:0|[1-9][0-9]*|[0-9]+\.[0-9]*(?:[eE][-+][0-9]+)?|\.[0-9]+(?:[eE][-+][0-9]+)?)")
_LOOSE = re.compile(r"([-+]?)([0-9]*)(\.?)([0-9]*)(?:[eE]([-+]?)([0-9]+))?")
_WITH_UNIT = re.compile(r"(.*?)\s*([A-Za-z%°]+)")


def parse_number(text: str, unit: str = "", strict: bool = True) -> float:
    """Return the number that `text` says, in the base unit `unit` ("m", "rad", "kg", ... of UNITS, or "" for none).

    strict : whether every YAML reader must read the same; else 1e6 and 05 are numbers too, as on a command line.

    Raises DerenderError : if it is no finite number in such notation, or its unit does not fit.
    """
    factor, digits = 1.0, text.strip()
    if not _DECIMAL.fullmatch(digits) and not _LOOSE.fullmatch(digits):
        match = _WITH_UNIT.fullmatch(digits)
        if match and _LOOSE.fullmatch(match[1]) and re.search(r"[0-9]", match[1]):
            digits, named = match[1], match[2]
            known = UNITS.get(unit, {})
            if named not in known:
                good = f"and {' or '.join(known)}, such as {digits} {[*known][-1]}" if known else "without a unit"
                raise DerenderError(f"{shown(text)} has a unit that does not fit here", remedy=f"write a number {good}")
            factor = known[named]
    loose = not strict and _LOOSE.fullmatch(digits) and re.match(r"[-+]?\.?[0-9]", digits)
    if not loose and not _DECIMAL.fullmatch(digits):
        raise _fault(digits, text, unit)
    value = float(digits) * factor
    if not math.isfinite(value):
        raise DerenderError(f"{shown(text)} is too large", remedy="give a finite number")
    return value


def _fault(digits: str, text: str, unit: str) -> DerenderError:
    """Say why `digits` is refused and what would be right."""
    match = _LOOSE.fullmatch(digits)
    if match and (match[2] or match[4]):
        sign, whole, _, fraction, exponent_sign, exponent = match.groups()
        if exponent is not None:
            right = f"{sign}{whole or '0'}.{fraction or '0'}e{exponent_sign or '+'}{exponent}"
            return DerenderError(f"{shown(digits)} is text to a YAML reader, not a number", remedy=f"write {right}")
        if whole.startswith("0") and not fraction:
            right = f"{sign}{whole.lstrip('0') or '0'}"
            return DerenderError(f"{shown(digits)} is octal to a YAML reader", remedy=f"write {right}")
    if digits.lower().lstrip("+-.") in ("inf", "nan", "infinity"):
        return DerenderError(f"{shown(text)} is not a finite number", remedy="give a finite number")
    if re.fullmatch(r"[-+]?(?:0[xX][0-9a-fA-F_]+|0[bB][01_]+|[0-9]+(?::[0-9.]+)+|[0-9][0-9_]*\.?[0-9_]*)", digits):
        return DerenderError(f"{shown(text)} is not in decimal notation", remedy="write plain digits, such as 1250.0")
    example = " ".join(["or 20", *[*UNITS.get(unit, {})][-1:]])
    return DerenderError(f"{shown(text)} is not a number", remedy=f"write one such as 0.05 {example}")


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
        raise DerenderError(f"the file is larger than {MOST_BYTES // 1_000_000} MB", file, "is it a scene?")
    for number, content in enumerate(text.splitlines(), start=1):
        if "\t" in content and not content[: content.index("\t")].strip():
            raise Node(file, number, "").fault("a tab indents this line", "indent with spaces")
    loader = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader
    try:
        top = _Builder(file).build(yaml.parse(text, Loader=loader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = f"this is not YAML: {error.problem or error.context}"
        place = Node(file, mark.line + 1 if mark else 1, "")
        raise place.fault(what, "look at this line and the one above") from None
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
            return Node(self.file, line, address, event.value, bool(event.style))
        if isinstance(event, yaml.SequenceStartEvent):
            return List(self.file, line, address)
        return Section(self.file, line, address)

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
            first = f"first on line {parent.lines[key]}"
            raise place.fault(f"the key {shown(key)} stands here for the second time, {first}", "keep one")
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


def write_number(value: float) -> str:
    """Return the shortest decimal text that every YAML reader turns back into exactly this float (or int).

    >>> write_number(1e-05), write_number(0.1), write_number(3)
    ('1.0e-05', '0.1', '3')
    """
    if isinstance(value, int):
        return repr(value)
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    if e and "." not in mantissa:
        return f"{mantissa}.0e{exponent}"
    return text
