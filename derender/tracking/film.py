"""A film: depth images of one camera in the order of time, with its frame rate and gravity.

A film is followed as if its frames came at even times: a gap, as of a dropped frame, would show everything twice as
fast. So what is missing is put in as a frame without depth, and so is what was written twice.
"""

import json
import re
from collections.abc import Callable, Sequence
from functools import partial
from glob import glob
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.camera.camera_file import camera_beside
from derender.camera.depth_file import DepthImage, decoded_file, image_of, read_depth
from derender.camera.image_files import MOST_BYTES, read_bytes
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError

SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".exr", ".npz")  # of frames in a folder
# Frames a second, assumed where nobody says, and the standard deviation of its logarithm: nine depth cameras in ten run
# at 11 to 80.
FPS, FPS_SPREAD = 30.0, 0.6
# Standard errors of which way is down along the floor, radians: where nobody says so, for the floor is taken for level,
# and most nearly are; and of an accelerometer, which is off by three times as much or more where it is mounted askew. A
# floor that leans by less than that may be level.
LEVEL_SPREAD, GRAVITY_SPREAD, NEARLY_LEVEL = 0.02, 0.01, 0.1
MOST_FPS = 100_000.0
GRAVITY = 9.81  # m/s^2; more than a hundred times as much is a mistake
FAR_APART, ONE_G = 5.0, 0.1  # seconds between frames, and m/s^2 off 1, that look like another unit
DARK = 0.5  # share of a film's usual pixels with depth below which a first frame is too dark to begin with
UNREADABLE = 0.25  # share of frames that may be unreadable: of a film that lacks more, too little is seen to follow
SAME_RATE = 0.01  # share by which two frame rates may differ and be said to be one
SAID = 5  # frames at most that a note names
WHOLE, MOST_CHANNELS = (".npz", ".npy"), 4  # files that may hold a whole film; an array of more is no colour image

# Numbers in names count frames where all their steps are within this of a multiple of the usual one.
NEARLY = 0.1
# Frames are put in where a film is then at most so many times as long: else its times are no film's.
LONGER = 2.0
# A frame that is the one before, bit by bit, was not taken anew where between other frames this share of the pixels
# changes: noise changes nearly all, a rendering without noise what moves.
CHANGES = 0.5
MISSING = "missing"  # what a frame is called that is put in


class Timing(NamedTuple):
    """What the camera file says of time and gravity, each None where it says nothing."""

    fps: float | None = None  # frames a second
    gravity: np.ndarray | None = None  # (3,) m/s^2 in camera axes
    times: np.ndarray | None = None  # (T,) seconds


class Film(NamedTuple):
    """Frames of one camera."""

    names: list[str]  # of the frames
    frames: Sequence[np.ndarray]  # (T, H, W) float64 metres, NaN where nothing returned, or a list of such images
    camera: Camera
    camera_is_guess: bool  # True where nobody gave one
    times: np.ndarray  # (T,) float64, seconds, increasing
    gravity: np.ndarray | None  # (3,) m/s^2, camera axes of the first frame, or None: as the scene's floor lies
    fps_is_guess: bool  # True where the frame rate was assumed
    notes: tuple[str, ...] = ()  # what was found amiss and made up for


def level_spread(floor: np.ndarray | None, gravity: np.ndarray, known: bool) -> float:
    """Return the standard error of gravity's inclination to the floor (4, 4), radians; known : whether somebody said
    which way is down. Where the floor agrees with that, both are right; where it nearly does, either may be."""
    if not known or floor is None:
        return GRAVITY_SPREAD if known else LEVEL_SPREAD
    along = float(np.linalg.norm(np.cross(floor[:3, 2], gravity)) / max(float(np.linalg.norm(gravity)), 1e-9))
    return along if along < NEARLY_LEVEL else GRAVITY_SPREAD


def frame_files(sources: Sequence[str | Path]) -> list[Path]:
    """Return the files of the frames that folders, globs and names stand for, numbers in names in counting order."""
    found: list[Path] = []
    for source in sources:
        path = Path(source)
        if path.is_dir():
            inside = [p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
            named = [p for p in inside if p.stem.startswith("frame")]
            found += sorted(named or inside, key=_in_counting_order)
        elif path.exists() or not any(sign in str(source) for sign in "*?["):
            found.append(path)
        else:
            found += sorted(map(Path, glob(str(source))), key=_in_counting_order)
    return found


def _in_counting_order(path: Path) -> list[int | str]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def camera_of(sources: Sequence[str | Path], camera: str | None) -> str | Path | None:
    """Return the camera file: the one given, or camera.json beside the frames, or None."""
    return camera if camera is not None or not sources else camera_beside(sources[0])


def read_timing(path: str | Path | None) -> Timing:
    """Return what a camera file says of time and gravity; a file without such keys says nothing."""
    if path is None:
        return Timing()
    try:
        tree = json.loads(read_bytes(path, MOST_BYTES, "the camera", "give a camera file with --camera"))
    except ValueError:
        return Timing()  # YAML and what is no camera are the camera reader's business
    return timing_of(tree, path) if isinstance(tree, dict) else Timing()


def timing_of(tree: dict, where: object) -> Timing:
    """Return the fps, gravity and times of a camera's tree, checked."""
    fps = gravity = times = None
    if tree.get("fps") is not None:
        fps = checked_fps(tree["fps"], where)
    if tree.get("gravity") is not None:
        gravity = _numbers(tree["gravity"], "gravity", where)
        if gravity.shape != (3,) or not 0.01 < np.linalg.norm(gravity) < 100 * GRAVITY:
            raise DerenderError("gravity is not three numbers in m/s^2", where, "such as [0, 8.5, 4.9], in camera axes")
    for key in ("times", "timestamps"):
        if tree.get(key) is not None:
            times = checked_times(_numbers(tree[key], key, where), where)
    return Timing(fps, gravity, times)


def _numbers(value: list[float], name: str, where: Any) -> np.ndarray:
    try:
        numbers = np.asarray(value, float).ravel()
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all():
        raise DerenderError(f"{name} is not a list of numbers", where, "give finite numbers")
    return numbers


def checked_fps(value: float, where: Any) -> float:
    """Return frames a second as a number, or raise DerenderError."""
    try:
        fps = float(value)
    except (TypeError, ValueError):
        fps = float("nan")
    if not 0 < fps <= MOST_FPS:
        raise DerenderError(f"fps is {value}", where, "give frames a second, a number above 0")
    return fps


def checked_times(times: np.ndarray, where: Any) -> np.ndarray:
    """Return times (T,) that increase, or raise DerenderError."""
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if len(wrong):
        n = int(wrong[0])
        what = f"time runs backwards: frame {n + 1} is at {times[n + 1]:g} s, the one before at {times[n]:g} s"
        raise DerenderError(what, where, "put the frames in the order in which they were taken")
    return times


def read_film(sources, camera=None, depth_scale=None, fps=None) -> Film:
    """Read the frames of folders, globs, files, or of one .npz or .npy with depth (T, H, W).

    sources : paths. camera : a camera file; default camera.json beside the frames. depth_scale : millimetres a unit.
    fps : frames a second; goes before what the camera file says.

    Raises DerenderError : no frame, frames of several sizes, time that runs backwards, whatever is wrong with a frame.
    """
    files, notes = frame_files(sources), list[str]()
    where = ", ".join(map(str, sources)) or "the film"
    if not files:
        raise DerenderError(
            "the film is empty: there is no frame", where, "name files, or a folder of frame_000.npy ..."
        )
    camera = camera_of(sources, camera)
    timing = read_timing(camera)
    one = len(files) == 1 and files[0].suffix.lower() in WHOLE
    if one and (whole := _whole_film(files[0], camera, depth_scale)) is not None:
        seen, inside = whole
        names = [f"{files[0].stem}[{t}]" for t in range(len(seen))]
        timing = Timing(
            timing.fps or inside.fps,
            inside.gravity if timing.gravity is None else timing.gravity,
            inside.times if timing.times is None else timing.times,
        )
    else:
        names = [path.name for path in files]
        seen, notes = _each_of(files, camera, depth_scale)
    frames = [each.depth for each in seen]
    shown = np.array([np.sum(np.isfinite(frame) & (frame > 0)) for frame in frames])
    if not shown.any():
        raise DerenderError("no frame has a pixel with a depth", where, "give images that show something")
    dark = int(np.argmax(shown >= DARK * np.median(shown[shown > 0])))
    if timing.times is not None and len(timing.times) != len(frames):
        what = f"there are {len(frames)} frames and {len(timing.times)} times"
        raise DerenderError(what, camera or where, "give one time for each frame")
    rate = checked_fps(fps, "--fps") if fps is not None else timing.fps
    guessed = rate is None and timing.times is None
    times = timing.times if timing.times is not None and fps is None else counted(names) / (rate or FPS)
    notes += [*([dark_start(dark, names[dark])] if dark else []), *other_rate(fps, timing)]
    film = Film(names[dark:], frames[dark:], seen[0].camera, seen[0].camera_is_guess, times[dark:], timing.gravity,
                guessed)  # fmt: skip
    return _completed(film._replace(notes=(*notes, *_odd_units(film))))


def other_rate(fps: float | None, timing: Timing) -> list[str]:
    """Return what is said where a frame rate that is asked for is not the one that the frames say themselves."""
    said = 1.0 / float(np.median(np.diff(timing.times))) if timing.times is not None else timing.fps
    if fps is None or said is None or abs(said - fps) < SAME_RATE * fps:
        return []
    return [f"the camera says {said:.4g} frames a second; --fps {fps:g} goes before that, and speeds are as it says"]


def _each_of(files: list[Path], camera: Any, depth_scale: float | None) -> tuple[list[DepthImage], list[str]]:
    """Return the frames of as many files, and what is said of those that cannot be read.

    Raises DerenderError : the first cannot be read, or too many.
    """
    seen, faults = list[DepthImage](), dict[str, DerenderError]()
    for path in files:
        found, fault = read_frame(
            path, partial(read_depth, path, camera, depth_scale, may_be_empty=True), seen[0] if seen else None
        )
        seen.append(found)
        if fault is not None:
            faults[path.name] = fault
    if not faults:
        return seen, []
    first = next(iter(faults.values()))
    if len(faults) > UNREADABLE * len(files):
        what = f"{len(faults)} of {len(files)} frames cannot be read, this one because: {first.what}"
        raise DerenderError(what, first.where, first.remedy)
    return seen, [unreadable(_named(list(faults), range(len(faults))), first)]


def read_frame(
    path: Path, read: Callable[[], DepthImage], first: DepthImage | None
) -> tuple[DepthImage, DerenderError | None]:
    """Return a frame of the size of a film's first; where it cannot be read one in which nothing returned, and why.

    Raises DerenderError : there is no first.
    """
    try:
        found = read()
        if first is not None:
            check_size(found.depth, first.depth, path)
        return found, None
    except DerenderError as fault:
        if first is None:
            raise
        return first._replace(depth=np.full_like(first.depth, np.nan)), fault


def unreadable(names: str, fault: DerenderError) -> str:
    """Return what is said of frames that cannot be read."""
    return f"{names} cannot be read ({fault.what}): taken as without depth"


def shows(frame: np.ndarray) -> bool:
    """Return whether a frame (H, W) has a pixel with a depth."""
    return bool(np.any(np.isfinite(frame) & (frame > 0)))


def dark_start(count: int, name: str) -> str:
    """Return what is said of first frames with hardly a depth."""
    frames = f"the first {count} frames show" if count > 1 else "the first frame shows"
    return f"{frames} hardly a depth: beginning with {name}"


def _odd_units(film: Film) -> list[str]:
    """Return what times and gravity look as if they were not in seconds and m/s^2."""
    notes = []
    if len(film.times) > 1 and (step := float(np.median(np.diff(film.times)))) > FAR_APART:
        notes.append(f"frames are {step:.3g} s apart: times are in seconds, are these in another unit?")
    if film.gravity is not None and abs(np.linalg.norm(film.gravity) - 1) < ONE_G:
        notes.append("gravity is given as 1 m/s^2: taking it so; if it is in g, multiply it by 9.81")
    return notes


def _named(names: list[str], numbers: Any) -> str:
    """Return the first names of some frames."""
    more = ", ..." if len(numbers) > SAID else ""
    return ", ".join(names[t] for t in numbers[:SAID]) + more


def _completed(film: Film) -> Film:
    """Return a film with frames without depth where its frames were dropped, or written twice."""
    names, frames, times, notes = list(film.names), list(film.frames), film.times, list(film.notes)
    twice = repeated(frames)
    for t in twice:
        frames[t] = np.full_like(frames[t], np.nan)
    if twice:
        notes.append(f"{_named(names, twice)} repeat the frame before, bit by bit: taken as without depth")
    gaps = lacking(times)
    before = np.flatnonzero(gaps)
    if len(before):
        notes.append(f"{gaps.sum()} frames are missing, by times or names, before {_named(names, before)}")
    for t in before[::-1]:
        between = np.linspace(times[t - 1], times[t], gaps[t] + 2)[1:-1]
        times = np.insert(times, t, between)
        names[t:t] = [MISSING] * gaps[t]
        frames[t:t] = [np.full_like(frames[0], np.nan)] * gaps[t]
    return film._replace(names=names, frames=frames, times=times, notes=tuple(notes))


def check_size(frame: np.ndarray, first: np.ndarray, path: Path) -> None:
    """Raise DerenderError where a frame is not as large as the first one."""
    if frame.shape != first.shape:
        sizes = [f"{shape[1]} x {shape[0]}" for shape in (frame.shape, first.shape)]
        what = f"this frame is {sizes[0]} pixels, the first one {sizes[1]}"
        raise DerenderError(what, path, "the frames of a film are of one size")


def _whole_film(path: Path, camera: Any, depth_scale: float | None) -> tuple[list[DepthImage], Timing] | None:
    """Return the frames and times of an .npz or .npy with depth (T, H, W), or None where it holds one image."""
    whole = decoded_file(path)
    if whole.array.ndim < 3 or whole.array.ndim == 3 and whole.array.shape[2] <= MOST_CHANNELS:
        return None
    frames: list[DepthImage] = []
    for t, array in enumerate(whole.array):
        known = frames[0].camera if frames else camera
        frames.append(image_of(whole._replace(array=array), f"{path}[{t}]", known, depth_scale, may_be_empty=True))
    tree = whole.camera if isinstance(whole.camera, dict) else {}
    return frames, timing_of({**tree, **whole.timing}, path)


def counted(names: Sequence[str]) -> np.ndarray:
    """Return which frames (T,) names say that these are, in steps of the usual one; where they do not, one by one."""
    plain = np.arange(len(names), dtype=float)
    numbers = [re.findall(r"\d+\.\d+|\d+", name) for name in names]
    if len({len(row) for row in numbers}) > 1:
        return plain
    varying = [np.array(column, float) for column in zip(*numbers, strict=True) if len(set(column)) > 1]
    if len(varying) != 1 or (usual := float(np.median(np.diff(varying[0])))) <= 0:
        return plain
    steps = np.diff(varying[0]) / usual
    if steps.min() < 1 - NEARLY or np.abs(steps - np.round(steps)).max() > NEARLY:
        return plain
    return np.concatenate([[0.0], np.cumsum(np.round(steps))])


def repeated(frames: Sequence[np.ndarray]) -> list[int]:
    """Return the numbers of the frames that repeat the one before, where noise would have changed them."""
    pairs = zip(frames[:-1], frames[1:], strict=True)
    changed = [float(np.mean(np.nan_to_num(before) != np.nan_to_num(after))) for before, after in pairs]
    others = [share for share in changed if share > 0]
    if not others or np.median(others) < CHANGES:
        return []
    return [t + 1 for t, share in enumerate(changed) if share == 0 and np.any(frames[t + 1] > 0)]


def lacking(times: np.ndarray) -> np.ndarray:
    """Return how many frames (T,) are missing before each one, by their times (T,)."""
    steps = np.diff(times, prepend=times[0])
    usual = np.median(steps[1:]) if len(steps) > 1 else 1.0
    found = np.maximum(np.round(steps / usual).astype(int) - 1, 0)
    return found if found.sum() <= (LONGER - 1) * len(times) else np.zeros(len(times), int)
