"""derender show: a scene graph as a tree, or as JSON; a prior as its file has it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from derender.cli import options
from derender.errors import printable


@click.command()
@click.argument("scene", metavar="SCENE-or-DIR")
@options.as_json
def command(scene: str, as_json: bool) -> None:
    """Print a scene file, or the posterior in a folder that `derender infer` wrote, as a tree; a prior as its file is.

    A posterior is shown by its most probable scene, each object with its probability and that of its parents. The last
    line counts the continuous degrees of freedom. --json prints objects with type, size, pose in the camera's frame,
    parent, contact and probabilities. `-` reads scenes from stdin, one or several YAML documents.

    \b
    Examples:
        derender show scene.yaml
        derender show results/ --json | python -m json.tool
        derender sample stack -o - | derender show -
        derender show tabletop > mine.yaml
    """
    for lines in _shown(scene, as_json):
        click.echo(lines)


def _shown(scene: str, as_json: bool) -> Iterator[str]:
    """Yield the text of each scene or prior that the argument names."""
    if scene != "-" and Path(scene).is_dir():
        from derender.cli.reading import read_scene

        found = read_scene(scene)
        yield _of_graph(found.graph, found.posterior, as_json)
        return
    from derender.document import read_documents, read_prior_document

    if scene == "-":
        told = read_documents()
    else:
        document = read_prior_document(scene)
        told = [(document, Path(document.file).read_text(encoding="utf-8-sig"))]
    for document, text in told:
        yield _of_graph(document.graph, None, as_json) if as_json or document.is_scene else printable(text, "\n")


def _of_graph(graph: Any, posterior: Any, as_json: bool) -> str:
    if as_json:
        from derender.report.scene_json import scene_json

        return json.dumps(scene_json(graph, posterior))
    from derender.report.tree_text import scene_lines

    return "\n".join(scene_lines(graph, posterior))
