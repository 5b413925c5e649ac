"""Writing plain data as the strict YAML that `yaml_tree` reads: every float comes back bit for bit."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from derender.scene.codec.yaml_nodes import reads_as_text, write_number

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
    start = " " * indent + _text(key) + ":"
    if levels > 0 and isinstance(value, Mapping) and value:
        lines.append(start)
        for inner, item in value.items():
            _emit(lines, indent + 2, inner, item, levels - 1)
    else:
        lines.append(f"{start} {_flow(value)}")


def _flow(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_text(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None:
        return "null"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return write_number(value if isinstance(value, int) else float(value))


def _text(value: Any) -> str:
    """Return a text plain where every reader takes it for text, else in double quotes."""
    value = str(value)
    if _PLAIN.fullmatch(value) and reads_as_text(value) and not value.startswith(("- ", "-- ", "---")) and value != "-":
        return value
    return json.dumps(value)  # JSON's escapes are YAML's
