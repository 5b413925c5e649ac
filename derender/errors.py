"""The one exception for faults that a user can cause and mend."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LONGEST = 400  # characters of each part of an error's line: names and paths of a thousand say no more


class DerenderError(Exception):
    """A fault in what the user gave: printed as one line, exit status 1.

    Parameters
    ----------
    what : what is wrong, as a sentence without a full stop.
    where : the file, line or address at fault.
    remedy : what would be right, or what to do.
    """

    def __init__(self, what: str, where: object = None, remedy: str | None = None) -> None:
        self.what = what
        self.where = where
        self.remedy = remedy
        super().__init__(what, where, remedy)

    def __reduce__(self) -> Any:
        return type(self), (self.what, self.where, self.remedy)

    def __str__(self) -> str:
        line = _shown(self.what)
        if self.where is not None:
            line = f"{_shown(self.where) or repr('')}: {line}"
        if self.remedy:
            line += f"; {_shown(self.remedy)}"
        return line


def _shown(part: object) -> str:
    """Return a part of an error as one piece of a line: cut where it is long, nothing in it that steers a terminal."""
    text = " ".join(str(part).split())
    text = text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


@contextmanager
def at_fault(where: object) -> Iterator[None]:
    """Name `where` in every DerenderError of the block that does not say where: the file that a user gave."""
    try:
        yield
    except DerenderError as error:
        if error.where is not None:
            raise
        raise DerenderError(error.what, where, error.remedy) from error
