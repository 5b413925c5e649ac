"""derender look: which camera move would tell most about a scene that was inferred."""

import json
from pathlib import Path
from typing import Any

import click

from derender.cli import options
from derender.cli.options import Talk
from derender.errors import DerenderError

SHOWN = 5  # views in the table
LITTLE = 0.1  # nats: an image that tells no more is not worth taking, ranges get a tenth narrower


@click.command()
@click.argument("folder", metavar="DIR")
@click.option(
    "--about",
    type=click.Choice(["sizes", "structure", "stable"]),
    default="sizes",
    help="What another image is to tell: sizes, which structure it is, or whether the scene stands.",
)
@options.output("File of the poses, and beside it the picture. Default: DIR/poses.json.", "FILE")
@options.as_json
@options.seed
@options.quiet
def command(folder: str, about: str, output: str | None, as_json: bool, seed: int, talk: Talk) -> None:
    """Say from where another image would tell most about what `derender infer` left in DIR.

    Candidates are cameras on rings about the scene, as far from it as the first. The draws of the posterior are
    rendered from each; by how much their images tell their sizes, structures and stability apart is how much the image
    is expected to tell, in nats: one makes the range of one number 2.7 times narrower, less than 0.1 is next to
    nothing, and a size whose standard deviation is below 0.3 mm counts as known. Of one number a factor of four is
    enough: the best views leave no size hidden. The table shows them: the turn about the scene (seen from above,
    anticlockwise) and the elevation over the floor in degrees, how far the camera moves, and the 90 % range of the size
    that is known least, as it is and as it is expected to be. The poses of all cameras, the best candidate's last, go
    to a file that `derender infer --together --poses` takes, and a picture of what is seen from there beside it.

    \b
    Examples:
        derender look results/
        derender infer first.png second.png --together --poses results/poses.json -o both
    """
    import numpy as np

    from derender.camera.poses import write_poses
    from derender.cli.reading import read_scene
    from derender.physics.next_view import KNOWN, next_views
    from derender.report.pictures import write_view

    found = read_scene(folder)
    if found.posterior is None or found.camera is None:
        raise DerenderError("there is no posterior here", folder, "give a DIR made by derender infer")
    if found.posterior.best_part.log_density.size < 2:
        raise DerenderError("there is but one draw", folder, "infer without --quick and --method map")
    likelihood = found.posterior.best_part.extras.get("likelihood") or found.posterior.meta.get("likelihood", {})
    views = next_views(found.posterior, found.camera, likelihood, np.random.default_rng(seed), about)
    place = Path(output) if output else Path(folder) / "poses.json"
    others = [np.array(view["pose"]) for view in found.posterior.meta.get("views", ())]
    write_poses(place, [np.eye(4), *others, views[0].pose])
    picture = place.with_suffix(".png")
    write_view(picture, found.graph, found.camera, views[0].pose)
    if as_json:
        click.echo(json.dumps({"about": about, "views": [tree_of(view) for view in views]}))
    else:
        click.echo(table_of(views))
        talk.say(f"one nat makes one range 2.7 times narrower, < {LITTLE} is next to nothing: "
                 f"errors below {1e3 * KNOWN:.1g} mm count as none")  # fmt: skip
    most = {key: max(view.nats[key] for view in views) for key in views[0].nats}
    if most[about] < LITTLE:
        other = max(most, key=lambda key: most[key])
        hint = f"; --about {other} has some that do" if most[other] >= LITTLE else ""
        talk.say(f"no view tells more than {LITTLE} nats of what is asked, {about}: that is known{hint}")
    talk.say(f"wrote {place} and {picture}")


def tree_of(view: Any) -> dict:
    """Return a NextView as JSON has it, angles in degrees."""
    import numpy as np

    return {
        "turn": float(np.degrees(view.turn)), "elevation": float(np.degrees(view.elevation)), "moved": view.moved,
        "pose": view.pose.tolist(), "nats": view.nats, "spreads": {k: list(pair) for k, pair in view.spreads.items()},
    }  # fmt: skip


def table_of(views: Any) -> str:
    """Return the table of the views that tell most."""
    import numpy as np

    from derender.report.tables import text_table
    from derender.results.posterior import NINETY

    least = max(views[0].spreads, key=lambda name: views[0].spreads[name][0])
    rows = []
    for view in views[:SHOWN]:
        before, after = (2000.0 * NINETY * spread for spread in view.spreads[least])
        angles = (f"{np.degrees(angle):.0f}" for angle in (view.turn, view.elevation))
        told = (view.nats[key] for key in ("sizes", "structure", "stable"))
        nats = (f"{x:.1f}" if x >= LITTLE else f"< {LITTLE}" for x in told)
        rows.append([*angles, f"{view.moved:.2f}", *nats, f"{before:.1f} -> {after:.1f}"])
    head = ("turn, deg", "elevation, deg", "moved, m", "sizes, nats", "structure, nats", "stable, nats", f"{least}, mm")
    return text_table(rows, head)
