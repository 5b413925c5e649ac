"""derender score: how well a scene explains a depth image."""

import json
import math
from pathlib import Path
from typing import Any

import click

from derender.cli import options
from derender.cli.options import Talk
from derender.errors import DerenderError

# Nats that are told: where a floor is taken away nothing is seen, and how unlikely that is says nothing.
MOST_GAIN = 1e9


@click.command()
@click.argument("scene", metavar="SCENE-or-DIR")
@click.argument("image", required=False, metavar="[IMAGE]")
@options.camera
@options.depth_scale
@click.option(
    "--prior",
    metavar="PRIOR",
    help="Prior whose log density is printed: a file, a built-in one, or bare-image, which is what infer "
    "believes without --scene. Default: the one that the scene was made with, else tabletop.",
)
@options.as_json
@options.quiet
def command(
    scene: str, image: str | None, camera: Any, depth_scale: Any, prior: str | None, as_json: bool, talk: Talk
) -> None:
    """Print a scene's log prior, its log likelihood of a depth image, and each object's share of it.

    IMAGE may be left out for a DIR, which holds the image that it was inferred from. `pixels` are those in which an
    object is seen, `log likelihood` the sum over them (all rows sum to the whole), `gain` what the scene would lose
    without this object alone (>1e9 where nothing else would be seen there), `residual` the median distance between
    image and scene. The likelihood is the one in the scene file, which infer fits to the image, else a normal with a
    standard deviation of 5 mm. Where the log prior is -inf, the prior cannot make such a scene: the line says why.

    \b
    Examples:
        derender score scene_000.yaml scene_000.npz
        derender score results/
        derender score results/ frame.png --camera camera.json --json | python -m json.tool
    """
    from derender.camera.depth_file import Reading
    from derender.cli.reading import read_scene_document
    from derender.document import LikelihoodPrior
    from derender.report.scores import score_prior, score_scene

    document = read_scene_document(scene)
    if image is None:
        image = str(Path(scene) / "observation.npz")
        if not Path(image).exists():
            raise DerenderError("there is no image to score it against", scene, "write derender score SCENE IMAGE")
    found = Reading(camera, depth_scale).read(image, document.camera)
    if found.camera_is_guess:
        talk.warn("there is no camera with this image: taking a field of view of 60 degrees")
    likelihood = document.likelihood or LikelihoodPrior()
    name, values = likelihood.type, likelihood.means
    under = score_prior(document, prior)
    score = score_scene(document.graph, found.depth, found.camera, name, values)._replace(prior=under)
    if as_json:
        click.echo(json.dumps(score.to_data()))
        return
    why = f": {under.why}" if under.why else ""
    click.echo(f"log prior       {_number(under.log_density)}  ({under.name}{why})")
    click.echo(f"log likelihood  {_number(score.log_likelihood)}  ({name})")
    click.echo(_table(score.shares))


def _number(value: float) -> str:
    """Return nats as text: of the absurdly many that a normal likelihood can make, the first digits."""
    return "-inf" if value == -math.inf else f"{value:.2f}" if abs(value) < 1e7 else f"{value:.3g}"


def _table(shares: Any) -> str:
    from derender.report.tables import number_or_dash, text_table

    rows = []
    for share in shares:
        gain = _number(share.gain) if math.isfinite(share.gain) else "–"
        if share.gain > MOST_GAIN:
            gain = f">{MOST_GAIN:.0e}".replace("e+0", "e")
        residual = number_or_dash(share.residual * 1000.0, ".2f")
        rows.append([share.name, str(share.pixels), _number(share.log_likelihood), gain, residual])
    return text_table(rows, ["object", "pixels", "log likelihood", "gain", "residual mm"])
