"""What `derender infer FRAMES --track` does: read the film, infer its first frame, follow it, write the folder."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.atomic import ROOM, make_folder
from derender.camera.depth_file import DepthImage, read_depth
from derender.camera.intrinsics import Camera
from derender.detection.resampled import smaller_image_of
from derender.errors import DerenderError
from derender.structures.options import Options
from derender.tracking.events import events_of
from derender.tracking.film import (
    FPS,
    FPS_SPREAD,
    MISSING,
    Film,
    camera_of,
    checked_fps,
    counted,
    dark_start,
    frame_files,
    lacking,
    level_spread,
    other_rate,
    read_film,
    read_frame,
    read_timing,
    shows,
    unreadable,
)
from derender.tracking.passes import Passes
from derender.tracking.result import report_page, write_track
from derender.tracking.thing import FOLLOWED, GONE, NOT_FOLLOWED, Start, start_from
from derender.tracking.track import Recorder, Track

POLL = 0.2  # seconds between looks at a folder that grows
PATIENCE = 10.0  # seconds without a new frame after which a film that is watched has ended
STALLED = 2.0  # seconds for which a frame that cannot be read has not grown: nobody is writing it any more
LAG = 3  # frames that an event waits before it is told while the film goes on: later frames may take it back


class Outcome(NamedTuple):
    """What was written: the track, its folder, and its events."""

    track: Track
    folder: Path
    events: list[dict[str, Any]]

    def table(self) -> str:
        """Return a line for each thing."""
        lines = [] if self.track.names else ["no object is followed"]
        for k, name in enumerate(self.track.names):
            words: list[str] = []
            for row, states in zip(self.track.parents(), self.track.states, strict=True):
                word = "away" if states[k] == GONE else row[k] or "nothing"
                if not words or words[-1] != word:
                    words.append(word)
            lost = [t for t, row in enumerate(self.track.states) if row[k] == "lost"]
            told = ", then ".join(word if word == "away" else f"on {word}" for word in words)
            lines.append(f"{name:<14} {told}" + (f"; lost in {len(lost)} frames" if lost else ""))
        return "\n".join(lines)


def silent(line: str) -> None:
    """Say nothing."""


def track_to_folder(
    sources: Sequence[str],
    options: Options,
    output: str | None = None,
    camera: str | None = None,
    depth_scale: float | None = None,
    fps: float | None = None,
    moving_camera: bool = False,
    watch: bool = False,
    command: str = "derender infer --track",
    progress: Callable[[float, str], None] | None = None,
    say: Callable[[str], None] = silent,
    warn: Callable[[str], None] = silent,
    tell: Callable[[str], None] = silent,
) -> Outcome:
    """Follow the things of a film and write track.npz, track.json, events.jsonl and report.html.

    sources : folders, patterns, files, or one .npz or .npy with depth (T, H, W).
    options : of the first frame's inference. camera, depth_scale : as of one image.
    output : folder; None: the first source's name with _tracked.
    fps : frames a second. moving_camera : whether the camera may move.
    watch : go on with frames as they come into the folder, until none has come for ten seconds.
    tell : called with each event as a line of JSON, while watching as soon as it is known.

    Raises DerenderError : whatever is wrong with the frames, the camera or the folder.
    """
    started = time.monotonic()
    coming = watched(sources, camera, depth_scale, warn)
    film = first_of(coming, sources, camera, fps) if watch else read_film(sources, camera, depth_scale, fps)
    enlargement = smaller_image_of(film.frames[0])
    if enlargement is not None:
        film = film._replace(frames=[enlargement.reduced(frame) for frame in film.frames],
                             camera=enlargement.camera(film.camera))  # fmt: skip
        warn(enlargement.told())
    for note in film.notes:
        warn(note)
    if film.camera_is_guess:
        warn(f"no camera is given: taking {film.camera.field_of_view:.0f} degrees horizontal field of view")
    if film.fps_is_guess:
        warn(f"no frame rate is given: taking {FPS:g} frames a second; speeds are wrong if it is another: give --fps")
    if film.gravity is None:
        warn("no gravity is given: taking the floor for level; of a slope friction is wrong")
    told = 0
    if watch:
        frames, names, came = [film.frames[0]], list(film.names), list(film.names)
        infer = inferrer(options, film.camera)
        start = begun(infer(film.frames[0], False), film.camera, film.frames[0], np.random.default_rng(options.seed))
        recorder = Recorder(film.frames[0], film.camera, start, film.gravity, step_of(film), moving_camera,
                            lambda depth: infer(depth, True))  # fmt: skip
        for path, seen in coming:
            depth = seen.depth if enlargement is None else enlargement.reduced(seen.depth)
            came.append(path.name)
            missing = int(lacking(counted(came))[-1])
            if missing:
                warn(f"{missing} frames are missing, by names, before {path.name}")
            for name, each in [(MISSING, np.full_like(depth, np.nan))] * missing + [(path.name, depth)]:
                if recorder.advance(each):
                    frames.append(each)
                    names.append(name)
            if recorder.cut is not None:
                break
            told = tell_events(recorder.track(times_of(film, len(frames))), told, tell, LAG)
        track = recorder.track(times_of(film, len(frames)), names)
    else:
        track = track_film(film, options, moving_camera, progress)
        frames = list(film.frames[: len(track.times)])
    track.rate_spread = FPS_SPREAD if film.fps_is_guess else 0.0
    track.level_spread = level_spread(track.floor, track.gravity, film.gravity is not None)
    for note in track.notes:
        warn(note)
    events = events_of(track)
    tell_events(track, told, tell, 0)
    folder = make_folder(output or f"{Path(sources[0]).stem}_tracked", ROOM)
    title = f"Track of {Path(sources[0]).name}"
    page = report_page(track, frames, film.camera, events, title)
    write_track(folder, track, page, {"seed": options.seed, "command": command})
    say(f"{len(frames)} frame{'s' * (len(frames) != 1)} in {time.monotonic() - started:.1f} s")
    return Outcome(track, folder, events)


def track_film(film: Film, options: Options, moving_camera: bool = False, progress: Any = None) -> Track:
    """Infer the first frame of a film, and follow what is there through the others."""
    infer, rng = inferrer(options, film.camera, progress), np.random.default_rng(options.seed)
    passes = Passes(
        film.frames, film.camera, film.gravity, step_of(film),
        lambda depth: begun(infer(depth, False), film.camera, depth, rng), lambda depth: infer(depth, True),
        moving_camera, progress,
    )  # fmt: skip
    return passes.best().track(film.times, film.names)


def begun(posterior: Any, camera: Camera, depth: np.ndarray, rng: np.random.Generator) -> Start:
    """Return what a posterior says is in one frame (H, W), with the serious doubts that the image raises of it.

    Which way is down is asked elsewhere: of a slope the camera's gravity is right.
    """
    from derender.report.contents import report_of

    told = None if posterior.explanation is None else posterior.explanation.depth
    graph = posterior.best_graph()
    left = [name for name in graph.solid_names if graph.vertex(name).shape not in ("plane", *FOLLOWED)]
    seen = report_of(graph, replace(camera, gravity=None), depth, told=told, shown=False,
                     likelihood=posterior.meta.get("likelihood"))  # fmt: skip
    doubts = [each.words for each in seen.doubts if each.serious]
    doubts += [f"{name} {NOT_FOLLOWED}" for name in left]
    return start_from(posterior, rng)._replace(doubts=tuple(doubts))


def inferrer(options: Options, camera: Camera, progress: Any = None) -> Any:
    """Return a function (depth, quick) that infers one frame; quick: its best scene only."""
    from derender.structures.infer import infer_structure

    wanted = replace(options, may_float=True)  # a film may begin with something in the air

    def infer(depth, quick):
        asked = replace(wanted, method="map") if quick else wanted
        return infer_structure(depth, camera, asked, np.random.default_rng(options.seed), None if quick else progress)

    return infer


def step_of(film: Film) -> float:
    """Return the seconds between frames."""
    return float(np.median(np.diff(film.times))) if len(film.times) > 1 else 1.0 / FPS


def times_of(film: Film, count: int) -> np.ndarray:
    """Return the times (count,) of the first frames; of a film that grows they go on at its rate."""
    if count <= len(film.times):
        return film.times[:count]
    step = film.times[1] - film.times[0] if len(film.times) > 1 else 1.0 / FPS
    return film.times[0] + step * np.arange(count)


def tell_events(track: Track, told: int, tell: Any, lag: int) -> int:
    """Tell the events that are at least `lag` frames old and not among the first `told`; return how many are told."""
    sure = [event for event in events_of(track) if event["frame"] < len(track.times) - lag]
    for event in sure[told:]:
        tell(json.dumps(event))
    return max(told, len(sure))


def first_of(coming: Iterator[tuple[Path, DepthImage]], sources: Any, camera: Any, fps: Any) -> Film:
    """Wait for the first frame of a folder that grows, and return a film of it."""
    dark, begun = 0, None
    for each in coming:
        if shows(each[1].depth):
            begun = each
            break
        dark += 1
    if begun is None:
        what = "no frame has a pixel with a depth" if dark else "no frame came"
        raise DerenderError(what, ", ".join(map(str, sources)), "name the folder that frames come into")
    path, seen = begun
    timing = read_timing(camera_of(sources, camera))
    rate = checked_fps(fps, "--fps") if fps is not None else timing.fps
    times = (dark + np.arange(2)) / (rate or FPS)
    notes = (*([dark_start(dark, path.name)] if dark else []), *other_rate(fps, timing))
    return Film(
        [path.name], [seen.depth], seen.camera, seen.camera_is_guess, times, timing.gravity, rate is None, notes
    )


def watched(sources: Any, camera: Any, depth_scale: Any, warn: Any) -> Iterator[tuple[Path, DepthImage]]:
    """Yield the frames of a folder that grows as they come, until none has come for some time; one that cannot be read
    is told and is without depth, but for the first."""
    taken, last = set[Path](), time.monotonic()
    seen: DepthImage | None = None
    while time.monotonic() - last < PATIENCE:
        fresh = [path for path in frame_files(sources) if path not in taken]
        for path in fresh:
            seen, fault = read_frame(path, partial(patiently, path, camera_of(sources, camera), depth_scale), seen)
            if fault is not None:
                warn(unreadable(path.name, fault))
            yield path, seen
            taken.add(path)
            last = time.monotonic()
        if not fresh:
            time.sleep(POLL)


def patiently(path: Path, camera: Any, depth_scale: Any) -> DepthImage:
    """Read a frame that may still be being written: what fails is tried again until the file has stood still."""
    state, since = -1, time.monotonic()
    while True:
        try:
            return read_depth(path, camera, depth_scale, may_be_empty=True)
        except DerenderError:
            now = path.stat().st_size if path.exists() else -1
            if now != state:
                state, since = now, time.monotonic()
            elif time.monotonic() - since > STALLED:
                raise
        time.sleep(POLL)
