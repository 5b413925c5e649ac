"""Write the lists of commands and of kernels into README.md, between their markers: python scripts/list_commands.py"""

import inspect
import sys
from pathlib import Path

import click

from derender.cli import COMMANDS, group
from derender.posterior.kernels import kernels
from derender.posterior.target import default_parts

README = Path(__file__).parent.parent / "README.md"
BEGIN = "<!-- {}: written by scripts/list_commands.py -->\n"
END = "<!-- end of {} -->\n"


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
    return " ".join([*short, "/".join([*long, *option.secondary_opts])])


def kernel_list() -> str:
    """Return the Markdown table of all kernels with their options and their share in the default mixture."""
    weights = {name: given["weight"] for entry in default_parts() for name, given in entry.items()}
    lines = ["| kernel | does | options | default weight |", "|---|---|---|---|"]
    for name in kernels:
        does = (inspect.getdoc(type(kernels[name])) or "").partition("\n\n")[0].replace("\n", " ")
        options = " ".join(f"`{key}: {value:g}`" for key, value in kernels[name].options.items())
        lines.append(f"| `{name}` | {does} | {options} | {weights.get(name, '')} |")
    return "\n".join(lines) + "\n"


def updated(text: str) -> str:
    """Return README's text with fresh lists."""
    for name, fresh in (("commands", command_list()), ("kernels", kernel_list())):
        begin, end = BEGIN.format(name), END.format(name)
        before, rest = text.split(begin)
        text = before + begin + "\n" + fresh + "\n" + end + rest.split(end)[1]
    return text


if __name__ == "__main__":
    fresh = updated(README.read_text())
    if "--check" in sys.argv:
        sys.exit(fresh != README.read_text())
    README.write_text(fresh)
