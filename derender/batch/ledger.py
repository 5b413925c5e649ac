"""What is known of the frames of an output folder: lines that grow as frames are done, tables and index.html."""

import contextlib
import json
import os
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from hashlib import sha256
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from derender import __version__
from derender.atomic import check_files, locked, make_folder, write_text
from derender.batch.frames import (
    LEDGER,
    RESULT,
    THUMBNAIL,
    Done,
    Frame,
    Order,
    is_done,
    is_outdated,
    rows_in,
    still_tells,
)
from derender.errors import DerenderError, printable
from derender.json_text import misfit, parse_json
from derender.results.table import EXTENTS, as_csv, as_lines, as_page, digits, extents_text, read_lines, type_text

RUN, TABLE, PAGE = "batch.json", "results.csv", "index.html"


class Ledger:
    """The tables of an output folder.

    results.jsonl grows by a frame's rows the moment that it is done; results.csv and index.html are made from it. A
    frame counts as done where its folder is whole, whatever the lines say: they are made again from it where they are
    missing, as after a killed run, and dropped where it was removed. Several processes may write into the same folder,
    each other frames.

    folder : the output folder. rows : by frame.
    """

    def __init__(self, folder: str | Path, order: Order) -> None:
        self.folder = make_folder(folder)
        check_files(self.folder, (RUN, LEDGER, TABLE, PAGE))
        self.order = order
        self._check(order)
        self.rows: dict[str, list[dict[str, Any]]] = {}
        self.recorded: set[str] = set()  # names of this run's frames
        self._read()

    def _check(self, order: Order) -> None:
        """Record what is asked of the frames; DerenderError where results of something else are there already."""
        named = [path for path in (order.prior, order.options.known) if isinstance(path, str | Path)]
        files = {str(path): sha256(Path(path).read_bytes()).hexdigest() for path in named if Path(path).is_file()}
        asked = {"options": list(order.words), "seed": order.options.seed}
        path = self.folder / RUN
        if not path.exists() or not any(is_done(found.parent) for found in self.folder.rglob(THUMBNAIL)):
            write_text(path, json.dumps(asked | {"files": files}) + "\n")  # of a run before this all may have failed
            return
        former: Any = {}
        with contextlib.suppress(DerenderError):
            former = parse_json(path.read_bytes())
        former = former if isinstance(former, dict) else {}
        if any(former.get(key) != asked[key] for key in asked):
            words = "" if misfit(former, {"options": [str]}) else " ".join(former["options"])
            what = f"the results here were made with other options ({words or 'none'})"
            raise DerenderError(what, self.folder, "give the same ones, or another folder with -o")
        if former.get("files", files) != files:  # one of an older version does not say
            what = f"{' or '.join(files)} has changed since the results here were made"
            raise DerenderError(what, self.folder, "give another folder with -o")

    def _read(self) -> None:
        self.rows = {}
        for row in read_lines(self.folder / LEDGER):
            self.rows.setdefault(row["frame"], []).append(row)

    def missing(self, frames: Iterable[Frame], warn: Callable[[str], None] = lambda line: None) -> list[Frame]:
        """Return the frames that have no result; of the others without lines, lines are written.

        A result of another image or camera than there are now is none any more; lines without a result are dropped, or
        they would be told beside those of the next one. warn : told of the former.
        """
        waiting, stale, untold = [], 0, False
        for frame in frames:
            folder = self.folder / frame.name
            if not is_done(folder):
                waiting.append(frame)
                untold |= frame.name in self.rows
                continue
            broken = is_outdated(folder, frame, self.order)
            try:
                if not broken and self.rows.get(frame.name, [{"status": "failed"}])[0]["status"] != "done":
                    self._append(frame.name, rows_in(folder, frame.name))
            except DerenderError:  # its summary
                broken = True
            if broken:
                self.recorded.discard(frame.name)
                (folder / THUMBNAIL).unlink(missing_ok=True)  # another process may have been here
                waiting.append(frame)
                stale += 1
        if stale:
            warn(f"{stale} of the results are broken, or of other images or cameras: they are made again")
        if stale or untold:
            self.write_tables(ended=True)
        return waiting

    def record(self, done: Done) -> None:
        """Write a frame's lines."""
        self.recorded.add(done.frame.name)
        self._append(done.frame.name, done.rows)

    def _append(self, name: str, rows: Sequence[dict[str, Any]]) -> None:
        path = self.folder / LEDGER
        with locked(self.folder), open(path, "ab+") as file:
            file.seek(0, os.SEEK_END)
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # a killed writer's half line
                    file.write(b"\n")
            file.write(as_lines(rows).encode())
        self.rows[name] = list(rows)

    def write_tables(self, ended: bool = False) -> None:
        """Write results.csv and index.html of all that is known; at the end also the lines anew, in the frames' order.

        So the files of a run that has ended do not depend on which frame was done first.
        """
        with locked(self.folder):
            self._read()
            last = {name: _last(self.rows[name]) for name in sorted(self.rows)}
            self.rows = {name: found for name, found in last.items()
                         if name in self.recorded or still_tells(self.folder, found[0])}  # fmt: skip
            rows = [row for found in self.rows.values() for row in found]
            if ended:
                write_text(self.folder / LEDGER, as_lines(rows))
            write_text(self.folder / TABLE, as_csv(rows))
            write_text(self.folder / PAGE, index_page(self.folder, self.rows))


def _last(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a frame that count: of a failure one, of a result each object once, as it was told last."""
    if rows[-1]["status"] == "failed":
        return [rows[-1]]
    found = {row["object"]: row for row in rows if row["status"] == "done"}
    if len(found) > 1:
        found.pop(None, None)
    return list(found.values())


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
    ranges = ", ± half of their 90 % ranges" if "±" in body else ""
    bare = next((name for name in frames if f'href="{quote(name)}/{RESULT}"' in body), None)
    shown = f"./{bare}" if bare and bare.startswith("-") else bare or ""  # which is no option then
    command = escape(printable(shlex.join(["derender", "view", shown])))
    made = f" A frame's own page is made, in this folder, by <code>{command}</code>." if bare else ""
    inside = (
        f"<h1>{len(frames)} frame{'s' if len(frames) != 1 else ''}</h1>"
        f'<form><fieldset><legend>Show</legend>{filters}</fieldset><label class="search">Search '
        '<input type="search" name="words" placeholder="frame, object or type"></label></form>'
        '<p class="soft"><a href="results.csv">results.csv</a> · <a href="results.jsonl">results.jsonl</a> · '
        '<span role="status"></span></p>'
        f'<p class="soft">Sizes are length × width × height in centimetres{ranges}.{made}</p>'
        '<div class="scroll" tabindex="0" role="region" aria-label="frames"><table><thead><tr>'
        f'<th scope="col">depth and best scene</th>{heads}</tr></thead><tbody>{body}</tbody></table></div>'
        f'<p class="soft">derender {__version__}</p>'
    )
    style, script = ((HERE / name).read_text() for name in ("index.css", "index.js"))
    return as_page(f"derender: {len(frames)} frames", style, inside, script)


def state_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return "trusted", "doubtful" or "failed"."""
    if rows[0]["status"] == "failed":
        return "failed"
    return "trusted" if rows[0]["trusted"] else "doubtful"


def _row(folder: Path, name: str, state: str, rows: Sequence[Mapping[str, Any]]) -> str:
    place, shown = quote(name), escape(printable(name))
    solids = [row for row in rows if row["object"] is not None]
    picture = title = ""
    if state != "failed":
        picture = f'<img loading="lazy" src="{place}/{THUMBNAIL}" alt="depth and best scene of {shown}">'
        page = "report.html" if (folder / name / "report.html").exists() else RESULT
        title = f'<a href="{place}/{page}">{shown}</a>'
    listed = "".join(f"<li>{_object(row)}</li>" for row in solids[:MOST_OBJECTS])
    count = "" if state == "failed" else str(len(solids))
    if len(solids) > MOST_OBJECTS:
        listed += f"<li>and {len(solids) - MOST_OBJECTS} more</li>"
    doubts = "<br>".join(escape(str(doubt)) for doubt in rows[0]["doubts"] or ())
    words = f"{printable(name)} " + " ".join(f"{row['object']} {row['type']}" for row in solids)
    order = list(STATES).index(state)
    return (
        f'<tr data-state="{state}" data-words="{escape(words.lower())}"><td>{picture}</td>'
        f'<th scope="row" data-key="{shown}">{title or shown}</th>'
        f'<td data-key="{order}"><span class="{state}">{STATES[state]}</span></td>'
        f'<td class="objects" data-key="{len(solids)}">{count}{f"<ul>{listed}</ul>" if listed else ""}</td>'
        f'<td class="doubts" data-key="{len(rows[0]["doubts"] or ())}">{doubts}</td></tr>'
    )


def _object(row: Mapping[str, Any]) -> str:
    ranges = [(row[f"{side}_low"], row[f"{side}_high"]) for side in EXTENTS]
    sizes = extents_text([row[side] for side in EXTENTS], None if None in ranges[0] else ranges)
    probability = f", p {escape(digits(row['probability']))}" if row["probability"] is not None else ""
    kind = type_text(str(row["type"]), row["type_probability"])
    doubted = f", {escape(kind)}" if kind != row["type"] else ""  # the name says it otherwise
    return f"{escape(str(row['object']))}{doubted}: {sizes}, on {escape(str(row['rests_on']))}{probability}"
