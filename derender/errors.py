"""Faults that a user can cause and mend: the one exception for them, and options that say nothing beside others."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, NamedTuple

LONGEST = 400  # characters of each part of an error's line: names and paths of a thousand say no more


class DerenderError(Exception):
    """A fault in what the user gave: printed as one line, exit status 1.

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
    return printable(text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}")


def printable(text: str, kept: str = "") -> str:
    """Return a text in which nothing steers a terminal, as names of files may; kept : characters that stay."""
    return "".join(c if c.isprintable() or c in kept else ascii(c)[1:-1] for c in text)


def is_unicode(name: str) -> bool:
    """Return whether a name can be written: those of files may be bytes that are no UTF-8."""
    return name.encode(errors="ignore").decode() == name


@contextmanager
def at_fault(where: object, always: bool = False) -> Iterator[None]:
    """Name `where` in every DerenderError of the block that does not say where: the file that a user gave.

    always : also in place of what one says.
    """
    try:
        yield
    except DerenderError as error:
        if error.where is not None and not always:
            raise
        raise DerenderError(error.what, where, error.remedy) from error


def optional(module: str, what: str, remedy: str, where: object = None) -> Any:
    """Return a module that need not be installed. Raises DerenderError : it is not, `what` needs it."""
    try:
        return import_module(module)
    except ImportError:
        raise DerenderError(what, where, remedy) from None


class Idle(NamedTuple):
    """Options that say nothing beside others: whoever gave one is told so, in place of being ignored in silence."""

    names: tuple[str, ...]  # of the parameters
    here: Callable[[Mapping[str, Any]], Any]  # given all arguments by name, whether it is so
    why: str  # what they are for


def idle_lines(rules: Sequence[Idle], given: Mapping[str, str], arguments: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each option given that says nothing. given : how it is spelt, by parameter."""
    for name, option in given.items():
        why = next((rule.why for rule in rules if name in rule.names and rule.here(arguments)), None)
        if why is not None:
            yield f"{option} says nothing here: {why}"
