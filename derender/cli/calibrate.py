"""derender calibrate: a sensor's noise from frames of a bare table."""

import click

from derender.cli import options
from derender.cli.options import Talk
from derender.errors import DerenderError


@click.command()
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@options.output("YAML file of the sensor; - is stdout.", "FILE", default="-")
@options.camera
@options.depth_scale
@options.verbosity
def command(frames: tuple[str, ...], output: str, camera: str | None, depth_scale: float | None, talk: Talk) -> None:
    """Learn a depth camera's noise from FRAMES, files, folders or patterns, that show a bare table and little else.

    Writes its numbers as a prior, under `likelihood: {type: correlated}`: noise and how it grows with depth, how much
    of it each pixel has for itself, how far the rest reaches along rows and columns, how heavy its tails are.
    `derender sample` draws from the file noise that scatters as the frames' does, by the numbers under `drawn:`;
    data/sensors has four kinds of cameras. All frames must be of one camera; several, from different distances, tell
    how the noise grows.

    \b
    Examples:
        derender calibrate bare_1.png bare_2.png --camera camera.json -o mine.yaml
        derender sample mine.yaml -n 3
    """
    import numpy as np

    from derender.atomic import write_text
    from derender.batch.frames import find_frames
    from derender.camera.depth_file import read_depth
    from derender.detection.calibration import fit_sensor, residuals, sensor_text

    pairs, first = [], None
    names = [frame.path for frame in find_frames(frames, output, warn=talk.warn)]
    for name in talk.counted(names, len(names), "reading"):
        seen = read_depth(name, camera, depth_scale)
        if first is None:
            first = seen.camera
            if seen.camera_is_guess:
                talk.warn(f"--camera is not given: taking {first.field_of_view:.0f} degrees horizontal field of view")
        elif seen.camera.shape != first.shape:
            told = f"it is {seen.camera.width} x {seen.camera.height} pixels, {names[0]} {first.width} x {first.height}"
            raise DerenderError(told, name, "calibrate each camera by itself")
        depth = np.where(np.isfinite(seen.depth) & (seen.depth > 0), seen.depth, np.nan)
        pairs.append(residuals(depth, seen.camera, name))
    with talk.bar() as bar:
        fit = fit_sensor(pairs, lambda done: bar(done, "fitting") if bar else None)
    before, after = fit.correlation
    talk.say(f"{fit.pixels} pixels of table: neighbours correlate at {before:.2f}, whitened at {after:+.2f} at most; "
             f"99 % of whitened residuals are within {fit.beyond:.2f} times the normal's limit")  # fmt: skip
    assert first is not None
    text = sensor_text(fit, first, len(names))
    if output == "-":
        click.echo(text, nl=False)
    else:
        write_text(output, text)
        talk.say(f"wrote {output}")
