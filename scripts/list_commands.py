"""Write the list of commands into README.md, between its markers: python scripts/list_commands.py"""

import argparse
import sys
from pathlib import Path

import click

from derender.cli import COMMANDS, group

README = Path(__file__).parent.parent / "README.md"
BEGIN = "<!-- commands: written by scripts/list_commands.py -->\n"
END = "<!-- end of commands -->\n"


def command_list() -> str:
    """Return the Markdown table of all commands with their arguments and options."""
    context = click.Context(group)
    lines = ["| command | does | options |", "|---|---|---|"]
    for name, summary in COMMANDS.items():
        command = group.get_command(context, name)
        assert command is not None
        arguments = [p.make_metavar(context) for p in command.params if isinstance(p, click.Argument)]
        options = [_option(p) for p in command.params if isinstance(p, click.Option)]
        usage = " ".join(["derender", name, *arguments]).replace("|", "\\|")
        lines.append(f"| `{usage}` | {summary} | {' '.join(f'`{option}`' for option in options)} |")
    return "\n".join(lines) + "\n"


def _option(option: click.Option) -> str:
    """Return the long name, after the short one where there is one, and the negative form after a slash."""
    short = [name for name in option.opts if not name.startswith("--")]
    long = [name for name in option.opts if name.startswith("--")]
    return " ".join(filter(None, [*short, "/".join([*long, *option.secondary_opts])]))


def updated(text: str) -> str:
    """Return README's text with a fresh list."""
    before, rest = text.split(BEGIN)
    return before + BEGIN + "\n" + command_list() + "\n" + END + rest.split(END)[1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="only say by the exit status whether the list is fresh")
    fresh = updated(README.read_text())
    if parser.parse_args().check:
        sys.exit(fresh != README.read_text())
    README.write_text(fresh)
