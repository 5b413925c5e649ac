"""derender simulate: let physics act on a scene, or on the draws of a posterior."""

import json
from pathlib import Path

import click

from derender import __version__
from derender.cli import options
from derender.cli.options import Talk
from derender.errors import DerenderError

ANIMATIONS = (".gif", ".webp")


@click.command()
@click.argument("scene", metavar="SCENE-or-DIR")
@click.option(
    "--duration", type=click.FloatRange(0, 3600, min_open=True), default=2.0, show_default=True, help="Seconds to run."
)
@click.option(
    "--draws",
    type=click.IntRange(0, 100_000),
    default=50,
    show_default=True,
    help="Draws of a posterior to simulate for P(stable); a scene file has one, itself.",
)
@click.option("--animate", metavar="FILE.gif", help="Draw the most probable scene as it moves (.gif or .webp).")
@options.output("Where to write the trajectories of the most probable scene, as .npz.", metavar="FILE.npz")
@options.as_json
@options.jobs
@options.seed
@options.quiet
def command(
    scene: str,
    duration: float,
    draws: int,
    animate: str | None,
    output: str | None,
    as_json: bool,
    jobs: int,
    seed: int,
    talk: Talk,
) -> None:
    """Simulate a scene file, or a folder written by `derender infer`, with MuJoCo and say whether it stands.

    Contacts of the scene graph are kept: bodies that rest on each other with a gap or an overlap of millimetres start
    at rest. A scene is stable if no body moves by more than a tenth of its size or turns by more than 10 degrees. Of a
    folder, the most probable scene is simulated and shown in the table, and draws of the posterior for P(stable) and
    for each object's P(falls).

    Bodies have 500 kg per cubic metre, a friction of 0.8 and no elasticity, unless the scene file says otherwise beside
    `shape`: mass: 0.4 (kg), friction: 0.5, elasticity: 0.6 (share of the speed that a bounce gives back).

    \b
    Examples:
        derender simulate scene.yaml --animate fall.gif
        derender simulate results/ --draws 200 --json | jq .p_stable
        derender sample stack -o - | derender simulate -
    """
    import numpy as np

    from derender.cli.reading import read_scene
    from derender.physics.bodies import matter_of_graph
    from derender.physics.simulate import judge, save_trajectory, simulate, verdicts

    _check_names(animate, output)
    found = read_scene(scene)
    trajectory = simulate(matter_of_graph(found.graph), duration)
    verdict = judge(trajectory)
    runs = [verdict]
    if found.posterior is not None and draws:
        drawn = found.posterior.graphs(np.random.default_rng(seed), draws)
        found_so = verdicts(map(matter_of_graph, drawn), duration, jobs)
        runs = list(talk.counted(found_so, draws, "simulating draw"))
    share = float(np.mean([run.stable for run in runs]))
    among = {name: [name in run.fallen for run in runs if name in run.displacement] for name in verdict.displacement}
    falls = {name: float(np.mean(fell)) if fell else None for name, fell in among.items()}
    made = {"seed": seed, "version": __version__, "command": options.command_line()}
    if output is not None:
        save_trajectory(output, trajectory, **made)
        talk.say(f"wrote {output}")
    if animate is not None:
        _animate(animate, found, trajectory, talk)
    if as_json:
        result = {
            "stable": verdict.stable,
            "p_stable": share,
            "p_falls": falls,
            "displacement": verdict.displacement,
            "rotation": verdict.rotation,
            "fallen": list(verdict.fallen),
            "duration": duration,
            "draws": len(runs),
            **made,
        }
        click.echo(json.dumps(result))
        return
    of_many = (share, falls, len(runs)) if found.posterior is not None and draws else None
    for line in _lines(verdict, of_many):
        click.echo(line)


def _lines(verdict, of_many):
    """Yield the verdict and a table for the terminal; of_many : P(stable), P(falls) by name and how many draws."""
    import numpy as np

    from derender.report.tables import number_or_dash, text_table

    yield "stable" if verdict.stable else "not stable: " + ", ".join(verdict.fallen) + " fell"
    if of_many:
        yield f"P(stable) = {of_many[0]:.2f} over {of_many[2]} draw{'s' if of_many[2] != 1 else ''} of the posterior"
    rows = [
        [name, f"{1000 * moved:.1f}", f"{np.rad2deg(verdict.rotation[name]):.1f}",
         *([number_or_dash(of_many[1][name], ".2f")] if of_many else [])]
        for name, moved in verdict.displacement.items()
    ]  # fmt: skip
    if rows:
        header = ("object", "moved, mm", "turned, deg", *(["P(falls)"] if of_many else []))
        yield text_table(rows, header)


def _check_names(animate: str | None, output: str | None) -> None:
    """Refuse names of files that could not be written, before anything is computed."""
    if animate is not None and Path(animate).suffix.lower() not in ANIMATIONS:
        raise DerenderError("not the name of an animation", animate, "choose from " + " ".join(ANIMATIONS))
    if output is not None and Path(output).suffix.lower() != ".npz":
        raise DerenderError("trajectories are written as .npz", output, "give a name that ends in .npz")


def _animate(path: str, found, trajectory, talk: Talk) -> None:
    from derender.camera.intrinsics import Camera
    from derender.report.animation import frames, write_animation

    camera = found.camera
    if camera is None:
        camera = Camera.from_field_of_view(320, 240)
        talk.say("the scene has no camera: 320 x 240 pixels and a field of view of 60 degrees")
    write_animation(path, frames(found.graph.solids(), found.graph.solid_names, trajectory, camera))
    talk.say(f"wrote {path}")
