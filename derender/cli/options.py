"""Options that commands share, each as a decorator, and `Talk`, the voice on stderr.

A command is written as

    @click.command()
    @options.seed
    @options.verbosity
    def command(seed: int, talk: Talk) -> int | None: ...

Paths are plain strings, not click.Path: a file that is missing is the user's input at fault (status 1), not usage (2).
"""

import contextlib
import functools
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from derender.compilation.threads import processors
from derender.errors import DerenderError, Idle, idle_lines, printable

# How `output` says that a folder is written; names that only a file has: whoever gives one expects a single file.
FOLDERS = ("DIR", "FOLDER")
OF_FILES = (".npz", ".npy", ".png", ".tif", ".tiff", ".exr", ".yaml", ".yml", ".json", ".csv", ".html")
PATIENCE = 2.0  # seconds that a person waits without asking what is going on


class Bar:
    """A bar that is drawn over and over in its line, and cleared in the end."""

    WIDTH = 30

    def __init__(self, stream: Any) -> None:
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


class Talk:
    """What a command says to a person, on stderr; stdout is for data.

    level : -1 quiet (warnings only), 0 normal, 1 verbose.
    about : what is told of where that is one of many, such as a file: warnings begin with it.
    """

    def __init__(self, level: int = 0, about: str = "") -> None:
        self.level, self.about = level, about

    def say(self, message: str, always: bool = False) -> None:
        """Say what a person who did not ask for silence should know; always: also one who did."""
        if always or self.level >= 0:
            self._echo(message)

    @contextlib.contextmanager
    def bar(self, shown: bool = True) -> Iterator[Bar | None]:
        """Yield a progress bar, which is cleared in the end; None where nobody would see it."""
        bar = Bar(sys.stderr) if shown and self.level >= 0 and sys.stderr.isatty() else None
        try:
            yield bar
        finally:
            if bar:
                bar.close()

    def counted(self, items: Iterable[Any], total: int, words: str) -> Iterator[Any]:
        """Yield the items; after two seconds a bar says how many of the total are done."""
        started = time.monotonic()
        with self.bar() as bar:
            for done, item in enumerate(items, 1):
                yield item
                if bar and time.monotonic() - started > PATIENCE:
                    bar(done / total, f"{words} {done} of {total}")

    def detail(self, message: str) -> None:
        """Say what a person who asked with -v wants to know."""
        if self.level >= 1:
            self._echo(message)

    def warn(self, message: str) -> None:
        """Say what must be seen even under -q."""
        self._echo(f"warning: {self.about}{': ' * bool(self.about)}{message}")

    def _echo(self, message: str) -> None:
        with contextlib.suppress(OSError):  # what cannot be told costs nothing of what is done
            click.echo(printable(message, "\n"), err=True)


def quiet(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add -q; the command gets `talk`, a `Talk`."""

    @click.option("-q", "--quiet", is_flag=True, help="Say nothing but warnings on stderr.")
    @functools.wraps(function)
    def wrapper(*arguments: Any, quiet: bool, verbose: bool = False, **keywords: Any) -> Any:
        return function(*arguments, talk=Talk(-1 if quiet else int(verbose)), **keywords)

    return wrapper


def verbosity(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add -v and -q, for commands that have details to tell; the command gets `talk`, a `Talk`."""
    return click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")(quiet(function))


def tells_idle(*rules: Idle) -> Callable[..., Any]:
    """Have a command, which takes `talk`, warn of options that were typed and say nothing."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def wrapper(talk: Talk, **arguments: Any) -> Any:
            context, typed = click.get_current_context(), {}
            for parameter in context.command.params:
                if context.get_parameter_source(str(parameter.name)) is ParameterSource.COMMANDLINE:
                    off = arguments.get(str(parameter.name)) is False and parameter.secondary_opts
                    typed[str(parameter.name)] = max(off or parameter.opts, key=len)
            for line in idle_lines(rules, typed, arguments):
                talk.warn(line)
            return function(talk=talk, **arguments)

        return wrapper

    return decorate


class Seed(click.IntRange):
    """A whole number from 0 up that 63 bits can hold."""

    name = "whole number"

    def _describe_range(self) -> str:
        return "0<=x<2^63"


class Finite(click.FloatRange):
    """A number in a range; NaN is in none, though no bound turns it away."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number."""
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{value} is no finite number", param, ctx)
        return found

    def _describe_range(self) -> str:
        return "" if self.min is None and self.max is None else super()._describe_range()


class Duration(click.ParamType):
    """A time such as 30s, 2min or 1.5h; a plain number counts seconds."""

    name = "time"

    def convert(self, value: Any, param: Any, ctx: Any) -> float | None:
        """Return seconds."""
        from derender.structures.options import seconds_of

        try:
            return seconds_of(value)
        except DerenderError as error:
            self.fail(f"{error.what}; {error.remedy}", param, ctx)


seed = click.option(
    "--seed",
    type=Seed(0, 2**63 - 1),
    default=0,
    metavar="N",
    help="Of the random numbers; a seed gives the same bytes, whatever --jobs is.",
)
as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON on stdout.")
jobs = click.option(
    "-j",
    "--jobs",
    type=click.IntRange(1, 1024),
    default=processors,
    show_default="processors here",
    help="Processes to use; the result does not depend on it.",
)
camera = click.option(
    "--camera",
    metavar="FILE",
    help="Camera file as BOP, ROS, OpenCV, Open3D, RealSense, COLMAP, ORB-SLAM or a device writes it, a 3 x 3 matrix, "
    "or a derender scene.",
)
depth_scale = click.option(
    "--depth-scale",
    type=Finite(0, min_open=True),
    metavar="MM",
    help="Millimetres for a unit of a 16-bit image, or of floats not in metres; overrides the camera's. Default 1.",
)
renderer = click.option(
    "--renderer",
    default="raycast",
    metavar="NAME",
    help="raycast (compiled, needs no OpenGL) or pyrender (OpenGL through OSMesa or EGL).",
)
noise = click.option("--noise/--no-noise", default=False, help="Draw from the likelihood (Eq. 6).")
strict = click.option("--strict", is_flag=True, help="Exit with status 3 where the result is not to be trusted.")


def output(help: str, metavar: str = "PATH", **more: Any) -> Callable[..., Any]:
    """Return the option -o, `output` in the command, which has a name or "-" in it. more : what click takes besides."""

    def named(context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
        if value == "":
            raise click.BadParameter("it is empty")
        if value and metavar in FOLDERS and Path(value).suffix.lower() in OF_FILES and not Path(value).is_dir():
            raise click.BadParameter(f"a folder is written, and {printable(value)} is the name of a file")
        return value

    return click.option("-o", "--output", metavar=metavar, help=help, callback=named, **more)


def command_line() -> str:
    """Return the command as it was typed, for the record in outputs."""
    return shlex.join(["derender", *sys.argv[1:]])
