"""Nodes of a strict YAML tree: each knows its file, line and address, so that every fault is one helpful line.

Text becomes a number, a name or a truth value only when the caller asks for one, and only if every YAML 1.1 reader
would agree.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

from derender.errors import DerenderError, at_fault
from derender.registry import suggest

# What YAML 1.1 readers take for something else than text when it is not quoted.
_BOOLEAN = re.compile(r"yes|no|on|off|true|false", re.IGNORECASE)
_NOT_TEXT = re.compile(
    r"~|null|[-+]?\.(?:inf|nan)|[-+]?[0-9.][0-9_.:]*(?:e[-+][0-9]+)?|0x[0-9a-f_]+|<<|=", re.IGNORECASE
)
_VERSION = re.compile(r"[0-9]+(\.[0-9]+){2,}")  # text to them all: other writers of YAML leave its quotes out


@dataclass(eq=False)
class Node:
    """A place in a file."""

    kind = "value"
    file: str  # its name, for messages
    line: int  # from 1
    address: str  # dotted path from the top, such as "objects.red.side"

    @property
    def where(self) -> str:
        return f"{self.file}, line {self.line}" + (f", {self.address}" if self.address else "")

    def fault(self, what: str, remedy: str | None = None) -> DerenderError:
        """Return (to be raised) a DerenderError that names this place."""
        return DerenderError(what, where=self.where, remedy=remedy)

    def _expected(self, what: str) -> NoReturn:
        raise self.fault(f"here stands {self.kind}", f"write {what}")

    # What every node answers; the fitting subclass overrides.
    def number(self, unit: str = "", lower: float | None = None, upper: float | None = None) -> float:
        self._expected("a number")

    def integer(self, lower: int | None = None, upper: int | None = None) -> int:
        self._expected("a whole number")

    def text(self, choices: Iterable[str] | None = None) -> str:
        self._expected("a name")

    def boolean(self) -> bool:
        self._expected("true or false")

    def section(self) -> Section:
        self._expected("a section of keys with values")

    def sequence(self, length: int | None = None) -> list[Node]:
        self._expected("a list in [brackets]")

    def plain(self) -> Any:
        """Return plain Python data: dict, list, float, int, bool, str or None."""
        raise NotImplementedError


@dataclass(eq=False)
class Item(Node):
    """A single value."""

    raw: str  # the text as it stands in the file
    quoted: bool  # it stood in quotes: text, whatever it looks like

    @property
    def kind(self) -> str:  # type: ignore[override]
        if not self.raw and not self.quoted:
            return "nothing"
        return "text in quotes" if self.quoted else f"the value {shown(self.raw)}"

    @property
    def empty(self) -> bool:
        return not self.quoted and self.raw in ("", "~", "null", "Null", "NULL")

    def number(self, unit: str = "", lower: float | None = None, upper: float | None = None) -> float:
        """Return the number in the base unit; refuse one outside [lower, upper]."""
        if self.empty:
            self._expected("a number")
        with at_fault(self.where):
            value = parse_number(self.raw, unit)
        if self.quoted and not re.search(r"[a-z]\s*$", self.raw):
            raise self.fault(
                f"the number {shown(self.raw)} stands in quotes and so is text", f"write {self.raw.strip()}"
            )
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
            if self.raw not in choices or (not self.quoted and self.empty):
                what = f"{shown(self.raw)} is no choice here" if not self.empty else "a name is missing"
                raise self.fault(what, suggest(self.raw, choices))
            return self.raw
        if self.empty:
            self._expected("a name")
        if not self.quoted and not reads_as_text(self.raw):
            raise self.fault(
                f"{self.raw} is not text to a YAML reader", f"write '{self.raw}' in quotes or another name"
            )
        return self.raw

    def boolean(self) -> bool:
        """Return a truth value: only `true` and `false` say one."""
        if not self.quoted and self.raw in ("true", "false"):
            return self.raw == "true"
        right = {"on": "true", "yes": "true", "y": "true", "off": "false", "no": "false", "n": "false"}
        word = self.raw.lower()
        remedy = f"write {right.get(word, word)}" if word in (*right, "true", "false") else "write true or false"
        raise self.fault(f"{shown(self.raw)} is not a truth value", remedy)

    def plain(self) -> Any:
        if self.empty:
            return None
        if not self.quoted:
            if self.raw in ("true", "false"):
                return self.raw == "true"
            if re.fullmatch(r"[-+]?(0|[1-9][0-9]{0,15})", self.raw):
                return int(self.raw)
            if _VERSION.fullmatch(self.raw):
                return self.raw
            if (
                _NOT_TEXT.fullmatch(self.raw)
                or _BOOLEAN.fullmatch(self.raw)
                or re.fullmatch(r"[-+]?[0-9.]+e[0-9]+|[-+]?[0-9]+e[-+]?[0-9]+", self.raw, re.I)
            ):
                return self.number()
        return self.raw


@dataclass(eq=False)
class List(Node):
    """A sequence of nodes."""

    kind = "a list"
    nodes: list[Node]

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

    kind = "a section"
    nodes: dict[str, Node]
    lines: dict[str, int]  # of each key

    def section(self) -> Section:
        return self

    def __contains__(self, key: object) -> bool:
        return key in self.nodes

    def __iter__(self) -> Iterator[str]:
        return iter(self.nodes)

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
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0},
    "kg": {"kg": 1.0, "g": 0.001},
    "s": {"s": 1.0, "ms": 0.001},
    "px": {"px": 1.0},
    "N": {"N": 1.0, "mN": 0.001, "kN": 1000.0},
    "Hz": {"Hz": 1.0},
    "": {},
}

_DECIMAL = re.compile(r"[-+]?(?:0|[1-9][0-9]*|[0-9]+\.[0-9]*(?:[eE][-+][0-9]+)?|\.[0-9]+(?:[eE][-+][0-9]+)?)")
_LOOSE = re.compile(r"([-+]?)([0-9]*)(\.?)([0-9]*)(?:[eE]([-+]?)([0-9]+))?")
_WITH_UNIT = re.compile(r"(.*?)\s*([A-Za-z%°]+)")


def parse_number(text: str, unit: str = "", strict: bool = True) -> float:
    """Return the number that `text` says, in the base unit `unit` ("m", "rad", "kg", ... of UNITS, or "" for none).

    strict : whether every YAML reader must read the same; else 1e6 and 05 are numbers too, as on a command line.

    Raises DerenderError : if it is no finite number in such notation, or its unit does not fit.
    """
    factor = 1.0
    digits = text.strip()
    if not _DECIMAL.fullmatch(digits) and not _LOOSE.fullmatch(digits):
        match = _WITH_UNIT.fullmatch(digits)
        if match and _LOOSE.fullmatch(match[1]) and re.search(r"[0-9]", match[1]):
            digits, named = match[1], match[2]
            known = UNITS.get(unit, {})
            if named not in known:
                good = " or ".join(known) if known else "a number without a unit"
                raise DerenderError(f"{shown(text)} has a unit that does not fit here", remedy=f"write {good}")
            factor = known[named]
    loose = not strict and _LOOSE.fullmatch(digits) and re.match(r"[-+]?\.?[0-9]", digits)
    if not loose and not _DECIMAL.fullmatch(digits):
        raise _fault(digits, text)
    value = float(digits) * factor
    if not math.isfinite(value):
        raise DerenderError(f"{shown(text)} is too large", remedy="give a finite number")
    return value


def _fault(digits: str, text: str) -> DerenderError:
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
    return DerenderError(f"{shown(text)} is not a number", remedy="write one such as 0.05 or 20 deg")


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
