"""The command line: one file per command, no logic. `derender --help` imports none of them."""

import atexit
import contextlib
import gc
import importlib
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import click

from derender import __version__
from derender.errors import DerenderError, is_unicode

# Objects made between two looks for garbage: Python's 700 cost a tenth of the start, and one look at 50,000 a hundredth
# of a second.
GARBAGE = 200_000

ENDING = ("SIGTERM", "SIGHUP")  # signals that end a command as Ctrl-C does; the latter is not on Windows

# Each command's module is derender.cli.NAME and holds it as `command`. The summaries stand here so that
# `derender --help` imports no command.
COMMANDS = {
    "sample": "Draw scenes from a prior, with their depth images.",
    "render": "Render scenes to depth images, or to a picture.",
    "infer": "Turn one depth image into a posterior over scene graphs.",
    "look": "Say which camera move would tell most.",
    "simulate": "Let physics act on a scene or posterior: is it stable?",
    "show": "Print a scene graph as a tree, or as JSON.",
    "score": "Print log prior, log likelihood and each object's share.",
    "eval": "Compare predicted scenes with the truth.",
    "report": "Write HTML and tables from one or more posteriors.",
    "view": "Open the page about a result in a browser.",
    "export": "Write a scene as GLB, OBJ, MJCF, URDF or BOP JSON.",
    "calibrate": "Learn a depth camera's noise from frames of a bare table.",
    "types": "List shapes, contacts, distributions and likelihoods.",
    "doctor": "Say which versions and renderers work here.",
}


class LazyGroup(click.Group):
    """A group that imports a command's module only when that command runs or shows its own help."""

    def list_commands(self, context: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        return importlib.import_module(f"derender.cli.{name}").command

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def resolve_command(self, context: click.Context, args: list[str]) -> Any:
        try:
            return super().resolve_command(context, args)
        except click.UsageError as error:
            from derender.registry import suggest

            raise click.UsageError(f"{error.message.rstrip('.')}: {suggest(args[0], COMMANDS)}", context) from None


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(__version__, prog_name="derender")
def group() -> None:
    """From one depth image to a scene graph: which solids there are, how big, where, and what rests on what.

    stdout carries data, stderr talks, `-` is stdin or stdout.

    \b
    Start here, in an empty folder:
        derender sample && derender infer sample_000.npz
        derender sample -o - | derender show -
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit.

    Exit status: 0 done, 1 the user's input is at fault, 2 usage, 3 done but not to be trusted,
    130 interrupted. A command returns None, or the status as an int.
    """
    gc.set_threshold(GARBAGE)
    # Our matrices are small and our threads our own: BLAS's would spin against them, and change sums by their number.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _mend_streams()
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            status = status_of(lambda: _run(arguments))
        _end_at_once()
    except KeyboardInterrupt:  # once more, or after all was done
        _end_at_once()
        status = 130
    if arguments is None and sys.gettrace() is None and sys.getprofile() is None:
        _leave(status)
    sys.exit(status)


def _mend_streams() -> None:
    """Open what whoever started us has closed (`<&-`, `>&-`, `2>&-`): as good as empty, or nowhere.

    Otherwise the first files that we open would take its place, and be written what was meant for a terminal. What
    stdout's encoding lacks, such as the lines of a tree in that of Western Windows, is a question mark there.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            setattr(sys, name, open(number, mode, closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def _end_as_ctrl_c() -> None:
    """Let SIGTERM and SIGHUP end this process as Ctrl-C does, the work saved; those it forks die of them as usual."""
    own = os.getpid()

    def handle(number: int, frame: Any) -> None:
        if os.getpid() == own:
            # A shell lets what it runs in the background ignore Ctrl-C.
            if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
                raise KeyboardInterrupt
            signal.raise_signal(signal.SIGINT)
        else:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

    if threading.current_thread() is not threading.main_thread():  # only there signals can be handled
        return
    for name in ENDING:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:  # nohup's stays ignored
            signal.signal(number, handle)


def _end_at_once() -> None:
    """Let signals that `_end_as_ctrl_c` handled end this process as usual: nothing is left to be saved."""
    if threading.current_thread() is threading.main_thread():
        for name in ENDING:
            if hasattr(signal, name) and callable(signal.getsignal(getattr(signal, name))):
                signal.signal(getattr(signal, name), signal.SIG_DFL)


def _run(arguments: Sequence[str] | None) -> int | None:
    _end_as_ctrl_c()
    for word in sys.argv if arguments is None else arguments:
        if not is_unicode(word):
            raise DerenderError("this name is not UTF-8", word, "rename it: results tell it in text")
    try:
        return group.main(args=arguments, prog_name="derender", standalone_mode=False)
    except SystemExit:  # so click says that whoever read our output has gone
        return 0


def status_of(work: Callable[[], Any]) -> int:
    """Do some work and return its exit status, as `main` has it; a fault of the user's is one line on stderr.

    work : returns None, or the status as an int.
    """
    try:
        result = work()
        if sys.stdout is not None:
            sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except DerenderError as error:
        return _complain(str(error))
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _complain("interrupted", 130)
    except MemoryError:
        return _complain("there is too little memory for it")
    except ImportError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # so modules in C end whose loading is interrupted
            return _complain("interrupted", 130)
        raise
    except BrokenPipeError:
        # Whoever read our output has gone; keep Python's own flush at exit quiet too.
        sys.stdout = None  # type: ignore[assignment]
        return 0
    except OSError as error:
        if error.errno is None or error.strerror is None:
            raise
        return _complain(str(DerenderError(error.strerror, error.filename or None)))


def _leave(status: int) -> None:
    """End the process at once: taking the interpreter and the compiled code apart takes a fifth of a second."""
    threading._shutdown()  # type: ignore[attr-defined]  # waits for threads, as Python itself does
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
    os._exit(status)


def _complain(line: str, status: int = 1) -> int:
    click.echo(f"derender: {line}", err=True)
    return status


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: Any = None, line: Any = None
) -> None:
    """Say in one line what is warned of: where in the code it was noticed is nothing to the user."""
    click.echo(f"warning: {' '.join(str(message).split())}", err=True)
