"""A progress bar in one line of a terminal; where stderr is none, nothing."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any

PATIENCE = 2.0  # seconds that a person waits without asking what is going on


class Bar:
    """A bar that is drawn over and over in its line, and cleared in the end."""

    WIDTH = 30

    def __init__(self, stream) -> None:
        self.stream, self.shown = stream, ""

    def __call__(self, fraction: float, words: str) -> None:
        filled = round(self.WIDTH * min(max(fraction, 0.0), 1.0))
        line = f"{words} [{'#' * filled}{'.' * (self.WIDTH - filled)}] {100 * fraction:3.0f} %"
        if line != self.shown:
            self.stream.write("\r\x1b[K" + line)
            self.stream.flush()
            self.shown = line

    def close(self) -> None:
        if self.shown:
            self.stream.write("\r\x1b[K")
            self.stream.flush()


def counted(items: Iterable[Any], total: int, words: str, shown: bool) -> Iterator[Any]:
    """Yield the items; after two seconds a bar says how many of the total are done, if it is to be shown at all."""
    bar = Bar(sys.stderr) if shown and sys.stderr.isatty() else None
    started = time.monotonic()
    try:
        for done, item in enumerate(items, 1):
            yield item
            if bar and time.monotonic() - started > PATIENCE:
                bar(done / total, f"{words} {done} of {total}")
    finally:
        if bar:
            bar.close()
