"""derender simulate: let physics act on a scene, or on the draws of a posterior or a prior."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from derender import __version__
from derender.atomic import write_text
from derender.cli import options
from derender.cli.options import Talk
from derender.cli.reading import Found, drawn_scenes, read_scene, scene_paths
from derender.errors import DerenderError, Idle

if TYPE_CHECKING:
    from derender.physics.intervention import Intervention

ANIMATIONS = (".gif", ".webp", ".mp4", ".glb")
TABLES = (".csv", ".jsonl")
TABLE = "many scenes make a table"
MOST_DRAWS = 100_000


class Percent(click.ParamType):
    """A share such as 1% or 0.01."""

    name = "percent"

    def convert(self, value, param, ctx):
        try:
            share = float(value.rstrip("%")) / (100 if value.endswith("%") else 1)
        except (AttributeError, ValueError):
            share = 0.0
        if not 0 < share < 0.5:
            self.fail(f"{value!r} is no share such as 1%", param, ctx)
        return share


@click.command()
@click.argument("scenes", metavar="SCENE-or-DIR...", nargs=-1, required=True)
@click.option(
    "-n", "count", type=click.IntRange(1, 1_000_000), help="Of a prior: a row for each of so many scenes drawn from it."
)
@click.option("--duration", type=options.Finite(0, 3600, min_open=True), default=2.0, help="Seconds to run.")
@click.option(
    "--draws",
    type=click.IntRange(0, MOST_DRAWS),
    default=50,
    help="Draws of a posterior, a prior or the jitter to simulate for P(stable).",
)
@click.option(
    "--until",
    type=Percent(),
    metavar="PERCENT",
    help="Draw until P(stable) is known to this error, or no draw is left.",
)
@click.option(
    "--engine",
    type=click.Choice(["mujoco", "statics", "both"]),
    default="mujoco",
    help="Simulation, balance of forces at rest (no pushes), or both.",
)
@click.option("--margin", is_flag=True, help="Also the least horizontal acceleration, in g, that topples or slides it.")
@click.option("--forces", is_flag=True, help="Also contact forces that hold it, newtons, and where they act.")
@click.option("--push", multiple=True, metavar="NAME:+x:0.5N@0.1s", help="Push an object from the start; repeatable.")
@click.option("--remove", multiple=True, metavar="NAME", help="Take an object away; repeatable.")
@click.option("--add", multiple=True, metavar="NEW:box:10x5x5cm@NAME", help="Put an object on another; repeatable.")
@click.option("--tilt", metavar="10deg[:+x]", help="Lower the floor towards a direction of the root's axes.")
@click.option("--shake", metavar="2Hz:5mm[:+x]", help="Swing the floor to and fro by twice the length, all the while.")
@click.option(
    "--jitter",
    metavar="2mm,1deg",
    help="Displace and turn all at random in each draw: along contacts, none into another.",
)
@click.option("--settle", metavar="FILE.yaml", help="Write the scene as it came to rest, with its new contacts.")
@click.option("--animate", metavar="FILE.gif", help="Draw the most probable scene as it moves (.gif .webp .mp4 .glb).")
@options.output("The trajectory of the most probable scene (.npz); of many scenes the table (.csv .jsonl).")
@options.as_json
@options.jobs
@options.seed
@options.quiet
@options.tells_idle(
    Idle(("duration",), lambda given: given["engine"] == "statics", "statics judges a scene at rest"),
    Idle(("draws",), lambda given: given["until"], "--until says how many draws there are"),
    Idle(("forces",), lambda given: _makes_table(**given), TABLE),
    Idle(("as_json",), lambda given: given["output"] and _makes_table(**given), TABLE),
)
def command(
    scenes: tuple[str, ...],
    count: int | None,
    duration: float,
    draws: int,
    until: float | None,
    engine: str,
    margin: bool,
    forces: bool,
    settle: str | None,
    animate: str | None,
    output: str | None,
    as_json: bool,
    jobs: int,
    seed: int,
    talk: Talk,
    **texts: Any,
) -> int | None:
    """Simulate scene files, priors, or folders written by `derender infer`, and say whether they stand.

    A scene stands if no body moves by more than a tenth of its size or turns by more than 10 degrees at any time. It
    settles if something does but all comes to rest on what bore it before, the same side up (what still moves is waited
    for, and a floor is shaken no longer than --duration); else it falls. Contacts
    of the scene graph are kept: bodies that rest on each other with a gap or an overlap of millimetres start at rest.
    Solids that enter each other deeper than that fall, whichever engine is asked, and a line says which.
    Of a folder or a prior, the most probable scene (of a prior: the first drawn) is shown in the table, and draws tell
    P(stable) and each object's P(falls), with their Monte Carlo errors: where k of n draws stand it is (k + 1/2) /
    (n + 1), for n that agree do not make sure; of what the search may have missed no draw tells, so that half of that
    probability counts as stable, and is said. What is said of a folder stands on its page too, with its animation, if
    in the folder (`derender view`). Several scenes make a table; so do those that -n draws from a prior, which are
    those of `derender sample PRIOR -n N` with the same seed.

    Bodies have 500 kg per cubic metre, a friction of 0.8 and no elasticity, whatever their shape, unless the scene file
    says otherwise beside `shape`: mass (kg) or density, friction, elasticity (share of the speed that a bounce gives
    back), fixed: true, velocity and angular_velocity ([x, y, z] in the root's axes, per second), each of which may be a
    distribution; and gravity (m/s^2 down, or [x, y, z]) beside `root`. Friction of a pair is the geometric mean; where
    only one of them says it, that one's. Of two elasticities the greater counts.

    \b
    Examples:
        derender simulate scene.yaml --animate fall.gif --settle settled.yaml
        derender simulate results/ --draws 200 --json | jq .p_stable
        derender simulate results/ --animate results/fall.gif && derender view results/
        derender simulate results/ --engine both --margin --push red:+x:0.5N@0.1s --until 1%
        derender simulate stack -n 200 --jitter 2mm,1deg -o table.csv
        derender sample stack -n 20 -o many && derender simulate many -o table.csv
        derender sample stack -o - | derender simulate -
    """
    from derender.physics.intervention import intervention

    what = intervention(**texts)
    paths = scene_paths(scenes)
    many = _makes_table(scenes, output, count)
    _check_names(animate, settle, output, many)
    ask = {"duration": duration, "draws": draws, "until": until, "engine": engine, "jobs": jobs, "seed": seed}
    if many:
        return _table(paths, count, what, ask, margin, output, as_json, talk)
    source = read_scene(paths[0], seed)
    found, best = _one(source, what, ask, margin or as_json, forces, talk)
    if forces and not best.forces:
        talk.say("no forces hold this scene as it is")
    made = {"seed": seed, "version": __version__, "command": options.command_line()}
    if (output or animate or settle) and best.trajectory is None:
        raise DerenderError("statics moves nothing", "--engine statics", "use --engine mujoco or both")
    if output is not None:
        from derender.physics.verdict import save_trajectory

        save_trajectory(output, best.trajectory, **made)
        talk.say(f"wrote {output}")
    if settle is not None:
        from derender.document import write_document
        from derender.physics.verdict import settled_graph

        if not best.trajectory.resting:
            talk.warn(f"not all is at rest after {duration:g} s: it is written as it is then; give a longer --duration")
        settled = settled_graph(source.graph, best.trajectory, best.matter)
        write_document(settle, settled, source.camera, source.likelihood, made)
        talk.say(f"wrote {settle}")
    if animate is not None:
        _animate(animate, source, best, talk)
    made_here = animate is not None and Path(animate).resolve().parent == Path(paths[0]).resolve()
    animation = Path(str(animate)).name if made_here else None
    text = json.dumps({**found, "duration": duration, "animation": animation, **made})
    if Path(paths[0]).is_dir():
        _keep(Path(paths[0]), text, talk)
    if as_json:
        click.echo(text)
    else:
        for line in _lines(found):
            click.echo(line)
    return None


def _makes_table(scenes: Sequence[str], output: str | None, count: int | None = None, **others: Any) -> bool:
    tabled = output is not None and Path(output).suffix.lower() in TABLES
    return tabled or count is not None or len(scene_paths(scenes)) > 1


def _keep(folder: Path, text: str, talk: Talk) -> None:
    """Leave what was found in the result's folder, for its page; a folder that cannot be written costs only that."""
    from derender.report.result_folder import SIMULATION

    try:
        write_text(folder / SIMULATION, text + "\n")
    except DerenderError as error:
        talk.warn(f"the page will not tell of it: {error}")


def _one(source: Found, what, ask, margin: bool, forces: bool, talk: Talk):
    """Return the summary of a scene, and the outcome of the most probable one."""
    import numpy as np

    from derender.physics.outcome import assumed_of_draws, assumptions, outcomes, simulate_scene, summary_of

    once = {"engine": ask["engine"], "duration": ask["duration"], "what": what._replace(jitter=None)}
    best = simulate_scene(source.graph, margin=margin, forces=forces, early=False, **once)
    assumed = assumptions(best)
    runs, limit = [best], 1
    if ask["until"] and not (source.uncertain or what.jitter):
        talk.warn("--until says nothing here: a scene without jitter is the same in every draw")
    if (source.uncertain or what.jitter) and ask["draws"]:
        limit = MOST_DRAWS if ask["until"] else ask["draws"]
        graphs = source.draws(np.random.default_rng(ask["seed"]), limit)
        drawn = outcomes(graphs, what, ask["seed"], ask["engine"], ask["duration"], ask["jobs"], ask["until"])
        runs = [replace(run, trajectory=None) for run in talk.counted(drawn, limit, "simulating draw")]
        assumed += assumed_of_draws(runs, what)
    for sentence in assumed:
        talk.warn(sentence)
    found = summary_of(best, runs, assumed, source.missed)
    if len(runs) < limit and not (ask["until"] and found["p_stable_error"] <= ask["until"]):
        talk.warn(f"the posterior holds no more than {len(runs)} draws: infer with more --draws to know better")
    return found, best


def _table(
    paths: list[str],
    count: int | None,
    what: "Intervention",
    ask: dict[str, Any],
    margin: bool,
    output: str | None,
    as_json: bool,
    talk: Talk,
) -> int:
    """Simulate many scenes, print or write their table, and return 1 where one could not be."""
    from derender.physics.outcome import COLUMNS, row_of
    from derender.report.tables import text_table
    from derender.results.table import as_csv, as_lines

    rows, stopped = [], None
    sources: Iterable[tuple[str, Found | None]] = ((path, None) for path in paths)
    if count is not None:
        drawn = chain.from_iterable(drawn_scenes(path, count, ask["seed"]) for path in paths)
        sources = ((found.name, found) for found in drawn)
    try:
        for name, found in talk.counted(sources, len(paths) * (count or 1), "simulating scene"):
            try:
                found = found or read_scene(name, ask["seed"])
                rows.append(row_of(name, _one(found, what, ask, margin or as_json, False, Talk(-1, name))[0]))
            except DerenderError as error:
                talk.warn(f"{name}: {error}")
                rows.append(row_of(name, {"fault": str(error)}))
    except KeyboardInterrupt as interrupt:
        if not rows:  # a table that is there may tell more
            raise
        stopped = interrupt
    if output is not None:
        write_text(output, as_csv(rows, COLUMNS) if output.lower().endswith(".csv") else as_lines(rows))
        talk.say(f"wrote {output}")
    elif as_json:
        click.echo(as_lines(rows), nl=False)
    else:
        shown = ("scene", "verdict", "p_stable", "margin", "fallen")
        cells = [[_cell(row[key]) for key in shown] for row in rows]
        click.echo(text_table(cells, shown))
    if stopped is not None:
        talk.warn(f"the table has the first {len(rows)} of {len(paths) * (count or 1)} scenes")
        raise stopped
    return 1 if any(row["fault"] for row in rows) else 0


def _lines(found: Any) -> Iterator[Any]:
    """Yield the verdict and a table for the terminal."""
    import numpy as np

    from derender.physics.outcome import told_of_missed
    from derender.report.tables import number_or_dash, text_table

    others = {name: word for name, word in found["engines"].items() if word != found["verdict"]}
    # statics tells no time
    moved = (name + (f" after {time:.2f} s" if time else "") for name, time in found["first_moved"].items())
    yield found["verdict"] + (": " + ", ".join(moved) if found["fallen"] else "")
    for name, word in others.items():
        yield f"{name} says otherwise of the scene at rest: {word}"
    if found["margin"] is not None:
        yield f"margin {found['margin']:.3f} g"
    missed, drawn = told_of_missed(found), found["p_stable_error"] > 0.0
    if drawn or missed:
        stood, count = found["draws_stable"], found["draws"]
        how = f"{stood} of {count} draws stand, told as (k + 1/2) / (n + 1)"
        error = f" ± {found['p_stable_error']:.3f}: {how}" if drawn else ""
        yield f"P(stable) = {found['p_stable']:.3f}{error}" + (f"; {missed}" if missed else "")
        said = {word: f"{share:.3f}" for word, share in found["p_verdict"].items()}
        if drawn:
            said = {word: f"{share} ± {found['p_verdict_error'][word]:.3f}" for word, share in said.items()}
        yield "  ".join(f"P({word}) = {share}" for word, share in said.items())
    rows = [
        [name, number_or_dash(1000 * found["displacement"].get(name, np.nan), ".1f"),
         number_or_dash(np.degrees(found["rotation"].get(name, np.nan)), ".1f"),
         *([number_or_dash(share, ".3f"), number_or_dash(found["p_falls_error"][name], ".3f")] if drawn else [])]
        for name, share in found["p_falls"].items()
    ]  # fmt: skip
    if rows:
        header = ("object", "moved, mm", "turned, deg", *(["P(falls)", "±"] if drawn else []))
        yield text_table(rows, header)
    if found.get("forces"):
        rows = [
            [f["by"], f["body"], f"{np.linalg.norm(f['force']):.3f}", " ".join(f"{1e3 * x:.0f}" for x in f["point"])]
            for f in found["forces"]
        ]
        yield text_table(rows, ("pushes", "object", "force, N", "at, mm (camera)"))


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value or "")


def _check_names(animate: str | None, settle: str | None, output: str | None, many: bool) -> None:
    """Refuse files that could not be written, before anything is computed."""
    if animate is not None and Path(animate).suffix.lower() not in ANIMATIONS:
        raise DerenderError("not the name of an animation", animate, "choose from " + " ".join(ANIMATIONS))
    if animate is not None and Path(animate).suffix.lower() == ".mp4":
        from derender.report.animation import film_writer

        film_writer(animate)
    if settle is not None and Path(settle).suffix.lower() not in (".yaml", ".yml"):
        raise DerenderError("a scene is written as .yaml", settle, "give a name that ends in .yaml")
    if many and (animate or settle):
        raise DerenderError(TABLE, animate or settle, "give one scene to draw or settle it")
    wanted = TABLES if many else (".npz",)
    if output is not None and Path(output).suffix.lower() not in wanted:
        what = TABLE if many else "trajectories are written as .npz"
        raise DerenderError(what, output, f"give a name that ends in {' or '.join(wanted)}")


def _animate(path: str, source: Found, best: Any, talk: Talk) -> None:
    from derender.camera.intrinsics import Camera
    from derender.report.animation import animate, stands_still

    camera = source.camera
    if camera is None and not path.lower().endswith(".glb"):
        camera = Camera.from_field_of_view(320, 240)
        talk.say("the scene has no camera: 320 x 240 pixels and a field of view of 60 degrees")
    animate(path, source.graph, best.trajectory, camera)
    talk.say(f"wrote {path}" + (": nothing moves in it" if stands_still(best.trajectory) else ""))
