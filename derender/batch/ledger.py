"""What is known of the frames of an output folder: lines that grow as frames are done, and tables made of them."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from derender.atomic import locked, make_folder, write_text
from derender.batch.frames import LEDGER, Frame
from derender.batch.index import index_page
from derender.batch.work import Done, Order, is_done, rows_in
from derender.errors import DerenderError
from derender.results.table import as_csv, as_lines, read_lines

RUN, TABLE, PAGE = "batch.json", "results.csv", "index.html"


class Ledger:
    """The tables of an output folder.

    results.jsonl grows by a frame's rows the moment that it is done; results.csv and index.html are made from it. A
    frame counts as done where its folder is whole, whatever the lines say: they are made again from it where they are
    missing, as after a killed run. Several processes may write into the same folder, each other frames.

    Attributes
    ----------
    folder : the output folder. rows : by frame.
    """

    def __init__(self, folder: str | Path, order: Order) -> None:
        self.folder = make_folder(folder)
        self._check(order)
        self.rows: dict[str, list[dict[str, Any]]] = {}
        self._read()

    def _check(self, order: Order) -> None:
        """Record what is asked of the frames; DerenderError where results of something else are there already."""
        asked = {"options": list(order.words), "seed": order.options.seed}
        path = self.folder / RUN
        if path.exists():
            try:
                former = json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                former = {}
            if former != asked:
                words = " ".join(former.get("options", [])) if isinstance(former, dict) else ""
                what = f"the results here were made with other options ({words or 'none'})"
                raise DerenderError(what, self.folder, "give the same ones, or another folder with -o")
        else:
            write_text(path, json.dumps(asked) + "\n")

    def _read(self) -> None:
        self.rows = {}
        for row in read_lines(self.folder / LEDGER):
            self.rows.setdefault(row["frame"], []).append(row)

    def missing(self, frames: Iterable[Frame]) -> list[Frame]:
        """Return the frames that have no result yet; of the others without lines, lines are written."""
        waiting = []
        for frame in frames:
            if not is_done(self.folder / frame.name):
                waiting.append(frame)
            elif self.rows.get(frame.name, [{"status": "failed"}])[0]["status"] != "done":
                self._append(frame.name, rows_in(self.folder / frame.name, frame.name))
        return waiting

    def record(self, done: Done) -> None:
        """Write a frame's lines."""
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
            names = sorted(self.rows)
            for name in names:  # of a frame that failed and was then done, the last word
                last = self.rows[name][-1]["status"]
                self.rows[name] = _last(self.rows[name], last)
            rows = [row for name in names for row in self.rows[name]]
            if ended:
                write_text(self.folder / LEDGER, as_lines(rows))
            write_text(self.folder / TABLE, as_csv(rows))
            write_text(self.folder / PAGE, index_page(self.folder, {name: self.rows[name] for name in names}))


def _last(rows: Sequence[dict[str, Any]], status: str) -> list[dict[str, Any]]:
    """Return the rows of a frame that count: of a failure one, of a result each object once, as it was told last."""
    if status == "failed":
        return [rows[-1]]
    found = {row["object"]: row for row in rows if row["status"] == "done"}
    if len(found) > 1:
        found.pop(None, None)
    return list(found.values())
