"""derender infer: a depth image in, a posterior over scene graphs out; of many images a table of all; or a film."""

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from derender.cli import options
from derender.cli.options import Talk, command_line
from derender.errors import DerenderError, Idle, printable

if TYPE_CHECKING:
    from derender.batch.frames import Done
    from derender.camera.depth_file import Reading


def follow(talk: Talk, images: Sequence[str], arguments: dict[str, Any]) -> int | None:
    """Follow the things of a film; arguments : those of `derender infer`, by name."""
    from derender.dynamics.parameters import read_dynamics_prior
    from derender.structures.options import Options
    from derender.tracking.run import track_to_folder

    prior = arguments["prior"]
    if prior and not arguments["dynamics"]:
        raise DerenderError("--track finds everything from the film", "--prior", "leave it out, or give --dynamics")
    believed = read_dynamics_prior(prior) if prior else None  # its faults are told before the film is followed
    known = {field.name for field in fields(Options)} - {"prior"}  # which says nothing of the first frame's scene
    wanted = Options(**{key: value for key, value in arguments.items() if key in known})
    watch = bool(arguments["watch"])
    with talk.bar(not watch) as bar:
        outcome = track_to_folder(
            images, wanted, arguments["output"], arguments["camera"], arguments["depth_scale"], arguments["fps"],
            arguments["moving_camera"], watch, command_line(),
            progress=bar, say=talk.say, warn=talk.warn, tell=click.echo if watch else lambda line: None,
        )  # fmt: skip
    if not watch:
        click.echo(outcome.table())
    for doubt in outcome.track.doubts:
        talk.say(f"not to be trusted: {doubt}", always=True)
    if arguments["dynamics"]:
        from derender.tracking.materials import materials_to_folder

        for line in materials_to_folder(outcome.track, outcome.folder, wanted.seed, command_line(), believed):
            click.echo(line)
    talk.say(f"wrote {outcome.folder}/")
    return 3 if arguments["strict"] and not outcome.track.trusted else None


def _is_recording(image: str) -> bool:
    from derender.camera.ros_bag import is_bag

    return is_bag(image)


def _several(images: Iterable[str]) -> bool:
    from derender.batch.frames import is_many

    return is_many(list(images))


# Options that say how many frames are worked on, not what is asked of each: results do not record them.
OF_THE_RUN = frozenset(
    {"images", "output", "jobs", "watch", "scheduler", "page", "strict", "quiet", "verbose", "resume"}
)
# Options that are dropped where others stand; what depends on files is told by `workflow.check_request`.
OF_IMAGES = ("rotate", "confidence", "least_confidence", "up", "topic", "method", "quick", "gradient", "chains",
             "draws", "warmup", "budget", "assume_stable", "scheduler", "resume", "jobs", "page")  # fmt: skip
IDLE = (
    Idle(OF_IMAGES, lambda given: given["track"], "--track follows what the first frame of a film shows"),
    Idle(("least_confidence",), lambda given: not given["confidence"], "it is for --confidence"),
    Idle(("topic",), lambda given: not any(map(_is_recording, given["images"])), "it is for a recording (.bag, .mcap)"),
    Idle(("together", "poses"), lambda given: not _several(dict.fromkeys(given["images"])), "there is one image"),
    Idle(("resume",), lambda given: not given["together"] and _several(given["images"]),
         "the same command run again does what is missing"),
    Idle(("jobs",), lambda given: given["scheduler"], "the cluster of --scheduler has its own workers"),
)  # fmt: skip


@click.command()
@click.argument("images", metavar="IMAGE...", nargs=-1, required=True)
@click.option(
    "--scene",
    "--prior",
    "prior",
    metavar="FILE",
    help="Scene file with distributions, or a built-in prior: its objects are given, their numbers are inferred. "
    "Without it, everything is found from the image.",
)
@options.camera
@options.depth_scale
@click.option(
    "--rotate",
    type=click.Choice(["0", "90", "180", "270"]),
    default="0",
    help="Degrees by which to turn the image clockwise, its camera and gravity with it.",
)
@click.option("--confidence", metavar="FILE", help="Map of how sure the sensor is of each pixel, or a folder of maps.")
@click.option(
    "--least-confidence",
    metavar="N",
    type=options.Finite(),
    default=1.0,
    help="Pixels that are less sure count as missing.",
)
@click.option(
    "--up", metavar="X,Y,Z", help="Upwards in camera axes, or an axis such as -y; default: the camera file's."
)
@click.option("--topic", metavar="NAME", help="Of a ROS or RealSense bag: where its depth images are, if in several.")
@click.option(
    "--method",
    type=click.Choice(["auto", "mcmc", "map", "smc"]),
    default="auto",
    help="auto and mcmc: chains; smc, with --scene: particles; map: the single best scene. Without --scene auto weighs "
    "structures by integrals, mcmc by visiting them.",
)
@click.option("--quick", is_flag=True, help="The best scene only, searched for once: twice as fast as --method map.")
@click.option(
    "--gradient",
    type=click.Choice(["exact", "finite-difference"]),
    default="exact",
    help="Derivatives that --method map uses.",
)
@click.option("--shapes", metavar="NAMES", help="Without --scene: shapes to look for, such as box,cylinder.")
@click.option(
    "--max-objects", type=click.IntRange(1, 1000), help="Without --scene: at most so many, free-form things among them."
)
@click.option(
    "--floor",
    metavar="PLANE",
    help="Without --scene: auto (find it), none, or a,b,c,d of the plane ax + by + cz + d = 0 in camera axes.",
)
@click.option("--known", metavar="FILE", help="Without --scene: a library of known objects, by size or by mesh.")
@click.option("--only-known", is_flag=True, help="There is nothing but what --known lists.")
@click.option("--allow-interpenetration", "may_overlap", is_flag=True, help="Without --scene: solids may enter others.")
@click.option("--allow-floating", "may_float", is_flag=True, help="Without --scene: solids may hang in the air.")
@click.option("--assume-stable", is_flag=True, help="What is seen stands: rule out draws that statics says would fall.")
@click.option("--chains", type=click.IntRange(1, 1000), help="How many. Default 4, without --scene 2 of auto.")
@click.option(
    "--draws",
    type=click.IntRange(1, 10_000_000),
    help="Kept draws of each chain. Default 1000, up to 4000 where the chains disagree; without --scene 200, with "
    "--method mcmc 250.",
)
@click.option(
    "--warmup",
    type=click.IntRange(0, 10_000_000),
    help="Rounds in which a chain adapts. Default 200; without --scene 40, of mcmc alone.",
)
@click.option(
    "--budget",
    type=options.Duration(),
    metavar="TIME",
    help="Without --scene: draw on until the chains agree or so much time (30s, 2min) is spent on the image. Default: "
    "while it is worth it; then a seed gives the same on any machine.",
)
@click.option(
    "--together", is_flag=True, help="The images show one scene that stands still: one posterior given all of them."
)
@click.option(
    "--poses",
    metavar="FILE",
    help="With --together: where the cameras stood. Default: as the camera file says; else they are found.",
)
@click.option("--track", is_flag=True, help="The images are a film: follow the things through it.")
@click.option(
    "--fps",
    type=options.Finite(0, min_open=True),
    metavar="N",
    help="With --track: frames a second. Default: the camera file's, or 30.",
)
@click.option(
    "--dynamics", is_flag=True, help="With --track: friction, restitution, mass ratios and velocities, by simulation."
)
@click.option("--moving-camera", is_flag=True, help="With --track: the camera may move.")
@options.jobs
@click.option("--watch", is_flag=True, help="Go on with frames as they come into the folders, until Ctrl-C.")
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Of many images: infer on the Dask cluster of this scheduler (tcp://HOST:PORT or its scheduler file).",
)
@click.option(
    "--report/--no-report",
    "page",
    default=None,
    help="Write report.html. Default: of one image; of many `derender report DIR/FRAME` makes it when it is wanted.",
)
@click.option("--resume", is_flag=True, help="Go on where the same command was stopped.")
@options.seed
@options.output("Folder for the results. Default: the image's name with _inferred.", "DIR")
@options.strict
@options.verbosity
@options.tells_idle(*IDLE)
def command(talk: Talk, **arguments: Any) -> int | None:
    """Infer the scene graph behind each depth image IMAGE.

    IMAGE holds depth along the optical axis, not range: 16 bits a pixel (.png, .tiff) in millimetres unless
    --depth-scale or the camera says otherwise; metres in .npy, float .tiff and .exr; or an .npz that derender wrote.
    0, NaN, inf and 65535 mean no return. The camera is that of the depth image, in its pixels and without lens
    distortion; a file {"fx": 615, "fy": 615, "cx": 320, "cy": 240} is enough, and camera.json, or NAME_camera.json,
    beside NAME.png is taken by itself. Without one, 60 degrees of field of view are assumed. Which way is up is found
    from the floor, so leave the table around the things in the image.

    Writes DIR/scene.yaml (the most probable scene), DIR/posterior.npz (and posterior.nc where h5netcdf is installed),
    DIR/report.html, DIR/summary.json, DIR/observation.npz, DIR/labels.png (16 bits, k where the pixel shows the k-th
    object of `derender show DIR --json`) and DIR/explained.npy (the depth of the best scene, metres), and prints a
    table. Ctrl-C writes what there is. What does not speak for the result - chains that disagree, parts of the image
    that nothing explains, solids where nothing returned - is told at the end; --strict makes it exit status 3.

    Several images, folders or patterns are inferred --jobs at a time, each into a folder DIR/FRAME, without report.html
    and with thumbnail.png. DIR/index.html shows them all. DIR/results.csv and DIR/results.jsonl have a row for each
    object: frame, status (done or failed), object, type, length, width, height and the ends of their 90 % ranges
    (metres), x, y, z and qw, qx, qy, qz (object to camera), turn (radians, seen from above, against the camera's x
    axis), rests_on, probability (that it is there), type_probability (that it is then of this type), object_trusted,
    trusted, doubts; a frame without objects, or one that failed, has one row. A frame that fails does not stop the
    others; the exit status is then 1. The same command run again does what is missing.

    A recording of ROS, ROS 2 or the RealSense viewer (.bag, .mcap, .db3 or the folder; pip install 'derender[ros]') has
    many frames, with their camera; recording.bag@12 is one of them.

    With --track IMAGE is a film: a folder of frame_000.npy ..., a pattern, or an .npz or .npy (T, H, W). The camera
    file may say `fps` and `gravity` (m/s^2, camera axes). Writes DIR/track.npz, DIR/track.json, DIR/events.jsonl and
    DIR/report.html with a time line; a camera that seems to move without --moving-camera, and what else is in doubt, is
    told as of one image. With --dynamics also DIR/dynamics.npz, draws of friction, restitution, mass ratios
    and velocities (chain, draw), and in track.json, under `parameters`, those that the motion tells (of things that
    never meet each its own, such as friction.box_1), and under `ahead` where what still moves at the end will come to
    rest; --prior is then a YAML file whose section `dynamics` says what
    is believed before: friction, restitution, contact_time (s), mass_ratio and the relative errors impact_error and
    steady_error of the engine, tracking_error and turning_error, each a distribution such as {log-normal: [0.35, 0.8]};
    what it leaves out is as usual.

    With --together the images are views of one scene that stands still, from cameras whose poses --poses says: JSON,
    YAML or .npz with a 4 x 4 matrix for each image, camera to world, metres, camera axes x right, y down, z forward; in
    the order of the images, or by their names. A transforms.json of Nerfstudio and a scene_camera.json of BOP say it
    too; where nothing says it, the poses are found. The result is in the axes of the first camera. Errors that images
    share are measured, and do not count twice.

    \b
    Examples:
        derender sample && derender infer sample_000.npz
        derender infer frame.png --camera camera.json -o out && derender show out
        derender infer frame.png --camera camera.json --known groceries.yaml
        derender infer sample_000.npz --scene figure-4 --chains 4 --draws 2000
        derender infer frames/ --camera camera.json --quick -o results && cut -d, -f1-6 results/results.csv
        derender infer recordings/ --watch -o results
        derender infer front.png side.png --together --poses poses.json --camera camera.json -o both
        derender infer film/ --track --fps 30 -o out && cat out/events.jsonl
    """
    images, watch, scheduler = (arguments.pop(key) for key in ("images", "watch", "scheduler"))
    if arguments["output"] == "-":
        raise click.UsageError("-o is a folder: of many files none can go to stdout")
    if arguments["quick"]:
        if arguments["method"] not in ("auto", "map"):
            raise click.UsageError("--quick is --method map: leave one of them out")
        arguments["method"] = "map"
    if arguments["shapes"] is not None:
        arguments["shapes"] = [name.strip() for name in arguments["shapes"].split(",")]
    film = {key: arguments.pop(key) for key in ("track", "fps", "moving_camera", "dynamics")}
    for name, value in film.items():
        if value and not film["track"]:
            raise click.UsageError(f"--{name.replace('_', '-')} goes with --track")
    if film["track"]:
        if arguments.pop("together") or arguments.pop("poses"):
            raise click.UsageError("--track and --together are two things: a film, or a scene that stands still")
        return follow(talk, images, {**arguments, **film, "watch": watch})
    together, poses = arguments.pop("together"), arguments.pop("poses")
    if poses is not None and not together:
        raise click.UsageError("--poses goes with --together")
    if together:
        if watch or scheduler:
            raise click.UsageError("--together takes images that are there: leave out --watch and --scheduler")
        from derender.batch.frames import find_frames

        found = find_frames(images, arguments["output"] or "inferred", warn=talk.warn)
        first, *others = (frame.path for frame in found)
        return _one(talk, first, arguments, others, poses)
    if watch or scheduler or _several(images):
        return _many(talk, images, watch, scheduler, arguments)
    return _one(talk, images[0], arguments)


def _one(
    talk: Talk, image: str, arguments: dict[str, Any], frames: Sequence[str] = (), poses: str | None = None
) -> int | None:
    """Infer one image, or with further `frames` of the scene and their `poses` file all together; print its table."""
    from derender.structures.options import Options
    from derender.workflow import infer_to_folder

    prior, output, strict, page = (arguments.pop(key) for key in ("prior", "output", "strict", "page"))
    reading = _reading(arguments)
    wanted = Options(**arguments)
    with talk.bar() as bar:
        outcome = infer_to_folder(
            image, wanted, prior, output, reading, command_line(), page is not False,
            progress=bar, say=talk.say, warn=talk.warn, frames=frames, poses=poses,
        )  # fmt: skip
    for line, doubtful in outcome.lines():
        click.secho(line, fg="red" if doubtful else None)  # in colour on a terminal alone
    talk.detail(outcome.details())
    talk.say(f"wrote {outcome.folder}/")
    for line in outcome.verdict():
        talk.say(line, always=not outcome.trusted)
    if outcome.interrupted:
        return 130
    return 3 if strict and not outcome.trusted else None


def _many(
    talk: Talk, images: tuple[str, ...], watch: bool, scheduler: str | None, arguments: dict[str, Any]
) -> int | None:
    """Infer many images, say a line of each, and write the tables of all."""
    from derender.batch.frames import Order
    from derender.batch.run import Crew, Processes, duration, infer_frames
    from derender.structures.options import Options

    output, strict, jobs, page = (arguments.pop(key) for key in ("output", "strict", "jobs", "page"))
    prior, reading = arguments.pop("prior"), _reading(arguments)
    output = output or "inferred"
    order = Order(Options(**arguments, jobs=1), prior, reading, bool(page), _words())
    idle: set[str] = set()

    def tell(done) -> None:
        if bar:
            bar.close()
        for line in done.warnings:
            if not line.startswith("--"):
                talk.detail(f"{done.frame.name}: {line}")
            elif line not in idle:  # about an option, and so about all frames
                idle.add(line)
                talk.warn(line)
        if done.error:
            talk.say(f"derender: {done.frame.name}: {done.error}", always=True)
            talk.detail(done.trace)
        click.echo(_line_of(done))

    def crew(order: Order, output: str) -> Crew:
        if scheduler is None:
            return Processes(jobs, order, output)
        from derender.batch.run import Cluster

        return Cluster(scheduler, order, output)

    with talk.bar() as bar:
        tally = infer_frames(images, output, order, crew, watch, tell, bar or (lambda share, words: None), talk.warn)
    doubtful = f" ({tally.doubtful} not to be trusted)" if tally.doubtful else ""
    before = f", {tally.before} were done before" if tally.before else ""
    failed = f", {tally.failed} failed" if tally.failed else ""
    talk.say(f"{tally.done} frame{'s' * (tally.done != 1)} done{doubtful} in {duration(tally.seconds)}{failed}{before}")
    talk.say(f"wrote {output}/index.html, results.csv and results.jsonl")
    if tally.interrupted and not watch:
        talk.say("interrupted: the same command does the frames that are missing", always=True)
        return 130
    return 1 if tally.failed else 3 if strict and tally.doubtful else None


def _reading(arguments: dict[str, Any]) -> "Reading":
    """Take the options that say how images are read out of the arguments, and return them as one object."""
    from derender.camera.depth_file import Reading

    keys = ("camera", "depth_scale", "confidence", "least_confidence", "up", "topic")
    return Reading(rotate=int(arguments.pop("rotate")), **{key: arguments.pop(key) for key in keys})


def _line_of(done: "Done") -> str:
    """Return what stdout says of a frame: its name, how it went, its objects."""
    objects = [row["object"] for row in done.rows if row["object"]]
    trusted = "trusted" if done.rows[0]["trusted"] else "not to be trusted"
    return "\t".join([printable(done.frame.name), "failed" if done.error else trusted, *objects])


def _words() -> list[str]:
    """Return the options of this command that say what is asked of each frame, as they were typed."""
    context = click.get_current_context()
    words: list[str] = []
    for parameter in context.command.params:
        typed = context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
        if parameter.name in OF_THE_RUN or not typed:
            continue
        value = context.params[parameter.name]
        words += [parameter.opts[0]] if value is True else [parameter.opts[0], str(value)]
    return words
