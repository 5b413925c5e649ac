"""`derender infer FRAMES --track`: options of the command to what follows a film."""

import sys
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import click

from derender.cli.options import Bar, Talk, command_line
from derender.errors import DerenderError


def follow(talk: Talk, images: Sequence[str], arguments: dict[str, Any]) -> int | None:
    """Follow the things of a film; arguments : those of `derender infer`, by name."""
    from derender.structures.options import Options
    from derender.tracking.run import track_to_folder

    prior = arguments["prior"]
    if prior and not arguments["dynamics"]:
        raise DerenderError("--track finds everything from the film", "--prior", "leave it out, or give --dynamics")
    known = {field.name for field in fields(Options)}
    wanted = Options(**{key: value for key, value in arguments.items() if key in known})
    watch = bool(arguments["watch"])
    bar = Bar(sys.stderr) if sys.stderr.isatty() and talk.level >= 0 and not watch else None
    try:
        outcome = track_to_folder(
            images, wanted, arguments["output"], arguments["camera"], arguments["depth_scale"], arguments["fps"],
            arguments["moving_camera"], watch, command_line(),
            progress=bar, say=talk.say, warn=talk.warn, tell=click.echo if watch else lambda line: None,
        )  # fmt: skip
    finally:
        if bar:
            bar.close()
    if not watch:
        click.echo(outcome.table())
    if arguments["dynamics"]:
        from derender.tracking.materials import materials_to_folder

        for line in materials_to_folder(outcome.track, outcome.folder, wanted.seed, command_line(), prior):
            click.echo(line)
    talk.say(f"wrote {outcome.folder}/")
    return None
