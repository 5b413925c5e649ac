"""derender show: a scene graph as a tree, or as JSON."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from derender.cli import options


@click.command()
@click.argument("scene", metavar="SCENE-or-DIR")
@options.as_json
def command(scene: str, as_json: bool) -> None:
    """Print a scene file, a prior file, or the posterior in a folder written by `derender infer`, as a tree.

    A posterior is shown by its most probable scene, each object with its probability and that of its parents. The last
    line counts the continuous degrees of freedom. --json prints objects with type, size, pose in the camera's frame,
    parent, contact and probabilities. `-` reads scenes from stdin, one or several YAML documents.

    \b
    Examples:
        derender show scene.yaml
        derender show results/ --json | python -m json.tool
        derender sample stack -o - | derender show -
        derender show tabletop
    """
    for lines in _shown(scene, as_json):
        click.echo(lines)


def _shown(scene: str, as_json: bool) -> Iterator[Any]:
    """Yield the text of each scene that the argument names."""
    path = Path(scene)
    if scene != "-" and path.is_dir():
        from derender.cli.reading import read_scene

        found = read_scene(scene)
        yield _of_graph(found.graph, found.posterior, as_json)
        return
    from derender.document import read_documents, read_prior_document

    for document in read_documents() if scene == "-" else [read_prior_document(scene)]:
        if as_json or document.is_scene:
            yield _of_graph(document.graph, None, as_json)
        else:
            from derender.report.tree_text import likelihood_lines, prior_lines

            yield "\n".join([*prior_lines(document.prior), *likelihood_lines(document.likelihood), *_where(scene)])


def _where(name: str) -> list[str]:
    """Return the line that says where a built-in prior's file is: whoever wants another one begins with a copy."""
    from derender import data_path
    from derender.document import built_in_priors

    return [f"from {data_path(f'priors/{name}.yaml')}"] if name in built_in_priors() else []


def _of_graph(graph: Any, posterior: Any, as_json: bool) -> str:
    if as_json:
        from derender.report.scene_json import scene_json

        return json.dumps(scene_json(graph, posterior))
    from derender.report.tree_text import scene_lines

    return "\n".join(scene_lines(graph, posterior))
