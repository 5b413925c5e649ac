"""index.html: all frames of an output folder in one table with small pictures, to sort, to filter and to search."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from derender import __version__
from derender.batch.work import THUMBNAIL
from derender.results.table import SIDES

HERE = Path(__file__).parent
MOST_OBJECTS = 12  # of a frame, listed in its row
STATES = {"trusted": "trusted", "doubtful": "not to be trusted", "failed": "failed"}


def index_page(folder: Path, frames: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the page as text.

    folder : of all results, beside whose folders the page will lie. frames : rows of `table.COLUMNS` by frame.
    """
    states = {name: state_of(rows) for name, rows in frames.items()}
    count = {state: sum(found == state for found in states.values()) for state in STATES}
    filters = "".join(
        f'<label><input type="radio" name="state" value="{state}"{" checked" if not state else ""}> '
        f"{words} <b>{number}</b></label>"
        for state, words, number in [("", "all", len(frames)), *((s, w, count[s]) for s, w in STATES.items())]
    )
    heads = "".join(
        f'<th scope="col" aria-sort="none"><button type="button">{name}</button></th>'
        for name in ("frame", "result", "objects", "misgivings")
    )
    body = "".join(_row(folder, name, states[name], rows) for name, rows in frames.items())
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>derender: {len(frames)} frames</title><style>{(HERE / 'index.css').read_text()}</style></head><body>"
        f"<main><h1>{len(frames)} frame{'s' if len(frames) != 1 else ''}</h1>"
        f'<form><fieldset><legend>Show</legend>{filters}</fieldset><label class="search">Search '
        '<input type="search" name="words" placeholder="frame, object or type"></label></form>'
        '<p class="soft"><a href="results.csv">results.csv</a> · <a href="results.jsonl">results.jsonl</a> · '
        '<span role="status"></span></p>'
        '<div class="scroll" tabindex="0" role="region" aria-label="frames"><table><thead><tr>'
        f'<th scope="col">depth and best scene</th>{heads}</tr></thead><tbody>{body}</tbody></table></div>'
        f'<p class="soft">Sizes are length × width × height in centimetres, ± half of their 90 % ranges. '
        f"derender {__version__}</p></main>"
        f"<script>{(HERE / 'index.js').read_text()}</script></body></html>\n"
    )


def state_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return "trusted", "doubtful" or "failed"."""
    if rows[0]["status"] == "failed":
        return "failed"
    return "trusted" if rows[0]["trusted"] else "doubtful"


def _row(folder: Path, name: str, state: str, rows: Sequence[Mapping[str, Any]]) -> str:
    place, solids = quote(name), [row for row in rows if row["object"] is not None]
    picture = title = ""
    if state != "failed":
        picture = f'<img loading="lazy" src="{place}/{THUMBNAIL}" alt="depth and best scene of {escape(name)}">'
        page = "report.html" if (folder / name / "report.html").exists() else "summary.json"
        title = f'<a href="{place}/{page}">{escape(name)}</a>'
    listed = "".join(f"<li>{_object(row)}</li>" for row in solids[:MOST_OBJECTS])
    if len(solids) > MOST_OBJECTS:
        listed += f"<li>and {len(solids) - MOST_OBJECTS} more</li>"
    doubts = "<br>".join(escape(str(doubt)) for doubt in rows[0]["doubts"] or ())
    words = f"{name} " + " ".join(f"{row['object']} {row['type']}" for row in solids)
    order = list(STATES).index(state)
    return (
        f'<tr data-state="{state}" data-words="{escape(words.lower())}"><td>{picture}</td>'
        f'<th scope="row" data-key="{escape(name)}">{title or escape(name)}</th>'
        f'<td data-key="{order}"><span class="{state}">{STATES[state]}</span></td>'
        f'<td class="objects" data-key="{len(solids)}">{len(solids)}<ul>{listed}</ul></td>'
        f'<td class="doubts" data-key="{len(rows[0]["doubts"] or ())}">{doubts}</td></tr>'
    )


def _object(row: Mapping[str, Any]) -> str:
    sizes = " × ".join(_size(row, side) for side in SIDES)
    probability = f", p {row['probability']:.2f}" if row["probability"] is not None else ""
    return f"{escape(str(row['object']))}: {sizes}, on {escape(str(row['rests_on']))}{probability}"


def _size(row: Mapping[str, Any], side: str) -> str:
    low, high = row[f"{side}_low"], row[f"{side}_high"]
    spread = f"±{50 * (high - low):.1f}" if low is not None and high is not None else ""
    return f"{100 * row[side]:.1f}{spread}"
