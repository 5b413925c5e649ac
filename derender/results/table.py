"""How results are told: a row for each object of many frames, as CSV and JSON lines; pages; probabilities in words."""

import contextlib
import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.json_text import misfit, parse_json
from derender.scene.pose import quaternion
from derender.scene.shapes.base import EXTENTS

DIGITS = 6  # after the point: micrometres and microradians, a thousandth of what any sensor tells
# frame : its name; status : done or failed; object, type : of a solid, empty where the frame shows none; length, width,
# height : its full extents along its own x, y, z in metres, with the ends of their 90 % ranges; x, y, z : where its
# middle is in camera axes, metres; qw, qx, qy, qz : its rotation, object to camera; turn : of its x about the vertical
# against the camera's x, radians; rests_on : what it stands on; probability : that it is there; type_probability : that
# it is then of this type; object_trusted : whether it is to be trusted; trusted, doubts : whether the whole frame's
# result is, and why not.
COLUMNS = (
    "frame", "status", "object", "type", *(f"{side}{end}" for side in EXTENTS for end in ("", "_low", "_high")),
    "x", "y", "z", "qw", "qx", "qy", "qz", "turn", "rests_on", "probability", "type_probability",
    "object_trusted", "trusted", "doubts",
)  # fmt: skip

# What is read of a row, as `misfit` takes it.
ROW = {"frame": str, "status": str, "trusted": bool, "doubts": [str],
       **dict.fromkeys(("probability?", "type_probability?"), {float, None}),
       **dict.fromkeys(("object?", "type?", "rests_on?"), {str, None}),
       **{f"{side}{end}?": {float, None} for side in EXTENTS for end in ("", "_low", "_high")}}  # fmt: skip


def rows_of(frame: str, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a frame from its summary.json; a frame without a solid has one row without an object.

    Where only the best scene was asked for there are no ranges: one draw tells none.
    """
    scene = summary["scene"]
    told = {"trusted": bool(summary["trusted"]), "doubts": list(summary["doubts"])}
    rows = []
    for item in scene["objects"]:
        if item["size"] is None:
            continue
        pose = np.array(item["pose"])
        row = _row(frame, "done") | {"object": item["name"], "type": item["type"]} | told
        for side, extent, interval in zip(EXTENTS, item["size"], item.get("size_interval") or [()] * 3, strict=True):
            row[side] = extent
            if len(interval):
                row[f"{side}_low"], row[f"{side}_high"] = interval
        row |= dict(zip("xyz", map(float, pose[:3, 3]), strict=True))
        row |= dict(zip(("qw", "qx", "qy", "qz"), map(float, quaternion(pose[:3, :3])), strict=True))
        row["turn"] = turn_of(pose, scene["gravity"])
        row["rests_on"], row["probability"] = item["parent"], item.get("probability")
        row["type_probability"] = type_probability(item)
        row["object_trusted"] = item.get("trusted", told["trusted"])
        rows.append({k: round(v, DIGITS) if isinstance(v, float) else v for k, v in row.items()})
    return rows or [_row(frame, "done") | told]


def failed_row(frame: str, why: str) -> dict[str, Any]:
    """Return the row of a frame that could not be inferred."""
    return _row(frame, "failed") | {"trusted": False, "doubts": [why]}


def _row(frame: str, status: str) -> dict[str, Any]:
    return dict.fromkeys(COLUMNS) | {"frame": frame, "status": status}


def turn_of(pose: np.ndarray, gravity: Sequence[float]) -> float:
    """Return by how much an object's x axis, seen from above, is turned from the camera's x axis, radians in (-pi, pi].

    pose : (4, 4), object to camera. gravity : (3,) in camera axes. Where either axis is upright it is 0.
    """
    up = -np.asarray(gravity) / np.linalg.norm(gravity)
    right = np.array([1.0, 0.0, 0.0]) - up[0] * up
    along = pose[:3, 0] - (pose[:3, 0] @ up) * up
    if min(np.linalg.norm(right), np.linalg.norm(along)) < 1e-6:
        return 0.0
    return math.atan2(float(np.cross(right, along) @ up), float(right @ along))


def as_lines(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows as JSON lines."""
    return "".join(json.dumps(row) + "\n" for row in rows)


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a file of JSON lines; what a killed writer left half done, or is none, is left out."""
    if not path.exists():
        return
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(DerenderError):
            row = parse_json(line)
            if not misfit(row, ROW) and row["status"] in ("done", "failed"):
                yield dict.fromkeys(COLUMNS) | row


def as_csv(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] = COLUMNS) -> str:
    """Return rows as CSV with a header; lists are joined by semicolons, true and false are in small letters, numbers
    by name are "name=number" with spaces between."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return " ".join(f"{key}={number:.{DIGITS}g}" for key, number in value.items() if number is not None)
    return "; ".join(value) if isinstance(value, list | tuple) else value


def as_page(title: str, style: str, body: str, script: str) -> str:
    """Return an HTML page that needs no network, of a style sheet, the inside of its `main`, and a script."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body><main>{body}</main>"
        f"<script>{script}</script></body></html>\n"
    )


LOPSIDED = 0.5  # of half a range: a value that lies farther than that from the range's middle is told with both ends


def extents_text(size: Iterable[float], ranges: Iterable[Iterable[float]] | None = None) -> str:
    """Return extents, metres, in centimetres, with half of their ranges (low, high) where there are any: "9.3 ± 0.2";
    "9.3 (9.1 to 16.8)" where a range is not about the value, as of a side that is hidden."""
    words = []
    for value, (low, high) in zip(size, ((each, each) for each in size) if ranges is None else ranges, strict=True):
        half = 50.0 * (high - low)
        places = 1 if half == 0.0 or half >= 0.05 else 2
        error = f" ± {max(half, 0.01):.{places}f}" if half > 0.0 else ""
        if abs(100.0 * value - 50.0 * (low + high)) > LOPSIDED * half > 0.0 and half >= 0.01:
            error = f" ({100 * low:.{places}f} to {100 * high:.{places}f})"
        words.append(f"{100 * value:.{places}f}{error}")
    return " × ".join(words)


def type_probability(item: Mapping[str, Any]) -> float | None:
    """Return how probable the type is that an object is told to be of, given that it is there; None: nothing says."""
    shares = item.get("type_probability")
    return None if shares is None else float(shares.get(item["type"], 0.0))


def type_text(name: str, probability: float | None) -> str:
    """Return a type, with its probability where others are possible: "cube", "cube (p .35)"."""
    return name if probability is None or probability > SURE else f"{name} (p {digits(probability)})"


SURE = 0.99  # no probability is said to be surer than that: what a search has missed it cannot know
OPEN = 0.02  # width of an interval from which on it is said
COARSE = 0.1  # standard error from which on one digit has to do


def probability_text(probability: float, error: float = 0.0, interval: tuple[float, float] | None = None) -> str:
    """Return a probability in words: ".93 (.88-.96)", ".97 (.90 to >.99)", ">.99".

    error : its standard error. interval : in which it lies with 90 %; None: by the error.
    """
    low, high = (probability - 1.64 * error, probability + 1.64 * error) if interval is None else interval
    low, high = max(low, 0.0), min(high, 1.0)
    text = digits(probability, 1 if error >= COARSE else 2)
    ends = digits(low), digits(high)
    between = " to " if {"<", ">"} & set("".join(ends)) else "-"
    return f"{text} ({between.join(ends)})" if high - low >= OPEN else text


def digits(probability: float, count: int = 2) -> str:
    """Return a probability with so many digits behind the point, or that it is beyond those."""
    if probability > SURE:
        return f">{SURE:.2f}".replace("0.", ".")
    if probability < 1.0 - SURE:
        return f"<{1.0 - SURE:.2f}".replace("0.", ".")
    text = f"{probability:.{count}f}"
    return text.removeprefix("0") if text != "1.0" else f">{1.0 - 10.0**-count:.{count}f}".replace("0.", ".")
