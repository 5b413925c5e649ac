"""What a track tells of materials and velocities: `derender infer FRAMES --track --dynamics`."""

import json
from itertools import combinations
from pathlib import Path

import numpy as np

from derender.atomic import write_text
from derender.dynamics.inference import Identified, identify
from derender.dynamics.motion import Motion, motion_of
from derender.dynamics.parameters import Prior
from derender.dynamics.result import LEVEL, Answer, parameters_of, predict, write_draws
from derender.dynamics.shooting import RESTS
from derender.errors import DerenderError
from derender.physics.bodies import KIND_NAMES, Body, Matter
from derender.scene.pose import inverse
from derender.tracking.path import errors_of
from derender.tracking.result import with_materials
from derender.tracking.thing import GONE, HIDDEN, LOST
from derender.tracking.track import Track

# A thing is in a hand where, in the air, its acceleration is off gravity by more than this share of it, even in the
# tenth of the frames where it is least: what bounces falls freely between its impacts.
HELD, HELD_FRAMES, QUIETEST = 0.5, 3, 0.1
# Accelerations are told from places so many seconds apart: of those nearer, tracking's errors are as large as gravity.
APART = 1 / 30
# A thing is pushed by a hand where it rested for so many frames on a level floor (cosine to gravity) and then leaves
# its place by so many metres, while nothing that moves by itself is within as many of it beyond what both are wide.
RESTED_FRAMES, LEVEL_FLOOR, BEGUN, REACH = 2, 0.998, 0.004, 0.02
# Two things that are told to have entered each other by so many metres are not both where they are told: three times
# what tracking of half hidden things is off by.
ENTERED = 0.01
# Films of what comes next, and for how long they go on at most, seconds: a slide at 3 m/s ends sooner.
FILMS_AHEAD, SECONDS_AHEAD = 60, 2.0


def motion_of_track(track: Track) -> Motion:
    """Return the motion that a track shows, in the axes of the first camera.

    Poses of frames in which a thing is hidden, lost or gone, or cannot be, are left out, and things that a hand holds:
    it is no part of the model.
    """
    back = inverse(track.views)  # each camera to the first
    everywhere = back[:, None] @ track.poses
    handled = _handled(track, everywhere[..., :3, 3])
    names: list[str] = []
    chosen: list[int] = []
    bodies: list[Body] = []
    if track.floor is not None:
        bodies.append(Body("floor", "plane", np.zeros(3), np.asarray(track.floor, float)))
    for k, name in enumerate(track.names):
        if name in handled:
            continue
        names.append(name)
        chosen.append(k)
        size = np.asarray(track.sizes[-1, k], float)
        bodies.append(Body(name, KIND_NAMES[int(track.kinds[k])], size, np.eye(4)))
    if not names:
        raise DerenderError("nothing moves by itself", None, "leave out --dynamics")
    poses = everywhere[:, chosen]
    away = np.array([[row[k] in (HIDDEN, LOST, GONE) for k in chosen] for row in track.states])
    poses[away.reshape(len(track.times), -1)] = np.nan
    poses[_entered(bodies[-len(names) :], poses, track.pixels[:, chosen, 1])] = np.nan
    # Centres turn with the camera; a turn about the camera's axes becomes one about the body's own.
    turns = np.zeros((len(track.times), len(chosen), 6, 6))
    turns[..., :3, :3] = back[:, None, :3, :3]
    turns[..., 3:, 3:] = np.swapaxes(track.poses[:, chosen, :3, :3], -1, -2)
    covariances = turns @ track.covariances[:, chosen] @ np.swapaxes(turns, -1, -2)
    shared = None
    if track.view_factor.size:  # where the camera is elsewhere, things are so the other way: by its shift and its turn
        follow = np.tile(-np.eye(6), (len(track.times), len(chosen), 1, 1))
        follow[..., :3, 3:] = np.cross(np.eye(3), np.nan_to_num(track.poses[:, chosen][:, :, None, :3, 3]))
        shared = turns @ follow @ errors_of(track.view_factor)[:, None]
    matter = Matter(tuple(bodies), np.asarray(track.gravity, float), ())
    return motion_of(matter, tuple(names), track.times, poses, covariances, shared)


def _entered(bodies: list[Body], poses: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return (T, N) bool, where something else has entered a body that shows less of itself, since they were apart.

    What is half hidden and struck seems to rest where it was. shown : (T, N), pixels.
    """
    found = np.zeros(shown.shape, bool)
    for k, j in combinations(range(len(bodies)), 2):
        both = np.flatnonzero(np.isfinite(poses[:, [k, j], 0, 0]).all(axis=1))
        gaps = [bodies[k]._replace(pose=poses[t, k]).gap(bodies[j]._replace(pose=poses[t, j])) for t in both]
        for t, gap in zip(both, gaps, strict=True):
            if gap < -ENTERED and gaps[0] > 0:
                found[t, k if shown[t, k] < shown[t, j] else j] = True
    return found


def _handled(track: Track, centres: np.ndarray) -> set[str]:
    """Return the names of the things that a hand holds for a while, or something unseen sets in motion, or that such a
    thing has struck. centres : (T, N, 3), first camera's axes."""
    step, gravity = float(np.diff(track.times).mean()), np.asarray(track.gravity, float)
    weight = np.linalg.norm(gravity)
    apart = max(round(APART / step), 1)
    bend = (centres[2 * apart :] - 2 * centres[apart:-apart] + centres[: -2 * apart]) / (apart * step) ** 2
    in_air = np.array([[parent is None for parent in row] for row in track.parents()])
    off = np.linalg.norm(bend - gravity, axis=-1)
    flies = np.array([in_air[t : t + 2 * apart + 1].all(axis=0) for t in range(len(off))], bool).reshape(off.shape)
    shift = np.linalg.norm(np.nan_to_num(centres - centres[0]), axis=-1)
    first = [int(np.argmax(far > BEGUN)) for far in shift.T]  # 0: never
    reach = 0.5 * np.linalg.norm(track.sizes[-1], axis=-1)
    level = track.floor is not None and -track.floor[:3, 2] @ gravity >= LEVEL_FLOOR * weight
    handled: set[str] = set()
    for k in sorted(range(len(first)), key=lambda k: first[k]):
        away = off[flies[:, k] & np.isfinite(off[:, k]), k]
        held = len(away) >= HELD_FRAMES and np.quantile(away, QUIETEST) > HELD * weight
        near = centres[first[k] - 1 : first[k] + 1]  # it was struck between these two frames
        gaps = np.linalg.norm(near - near[:, k : k + 1], axis=-1).min(axis=0, initial=np.inf) - reach - reach[k] - REACH
        earlier = [j for j in range(len(first)) if 0 < first[j] < first[k] and track.names[j] not in handled]
        if held or (level and first[k] > RESTED_FRAMES and not any(gaps[j] < 0 for j in earlier)):
            handled.add(track.names[k])
    return handled


def materials_to_folder(
    track: Track, folder: Path, seed: int | None, command: str, prior: Prior | None = None
) -> list[str]:
    """Write dynamics.npz, `parameters` and `ahead` of track.json; return lines for the terminal, also on the page.

    prior : what is believed of the materials before; None: the default of dynamics.parameters.

    Raises DerenderError : where nothing moved, or nothing can have.
    """
    if len(track.times) < 2:
        raise DerenderError("one frame shows no motion", folder, "give a film, or leave out --dynamics")
    motion = motion_of_track(track)
    if not motion.names:
        raise DerenderError("nothing moves by itself", folder, "leave out --dynamics")
    rng = np.random.default_rng(seed)
    answers: list[Answer] = []
    ahead: dict[str, dict[str, list]] = {}
    parts = motion.parts()
    for part in parts:
        found, of = identify(part, rng, prior), "+".join(part.names) if len(parts) > 1 else ""
        answers.append(Answer(found, rng, track.rate_spread, track.level_spread, of))
        ahead |= {} if answers[-1].unexplained else rests_ahead(found, part, rng)
    write_draws(folder / "dynamics.npz", answers, seed=seed, command=command)
    said = json.loads((folder / "track.json").read_text(encoding="utf-8"))
    track.doubts += [note for answer in answers for note in answer.notes()]
    said |= {"trusted": track.trusted, "doubts": track.doubts, "parameters": parameters_of(answers), "ahead": ahead}
    write_text(folder / "track.json", json.dumps(said))
    lines = [line for answer in answers for line in answer.lines()]
    for name, told in ahead.items():
        where = ", ".join(
            f"{m:.3f} ({a:.3f}-{b:.3f})" for m, (a, b) in zip(told["mean"], told["interval"], strict=True)
        )
        lines.append(f"{name} comes to rest at {where} m")
    page = folder / "report.html"
    if page.is_file():
        write_text(page, with_materials(page.read_text(encoding="utf-8"), lines))
    return lines


def rests_ahead(found: Identified, motion: Motion, rng: np.random.Generator) -> dict[str, dict[str, list]]:
    """Return where what still moves comes to rest: {name: its centre's `mean` (3,) and 90 % `interval` (3, 2)}.

    Metres in the axes of the first camera; {} where all rests. What rolls on or falls at the films' end is left out.
    """
    last = found.modes[0].path.states[-1]
    fast = np.flatnonzero(np.linalg.norm(last[:, 7:10], axis=1) > RESTS)
    if not len(fast):
        return {}
    ends = predict(found, motion, rng, FILMS_AHEAD, round(SECONDS_AHEAD / motion.step))
    rest = np.mean(np.linalg.norm(ends[..., 7:10], axis=-1) < RESTS, axis=0)
    return {
        motion.names[k]: {
            "mean": ends[:, k, :3].mean(axis=0).tolist(),
            "interval": np.quantile(ends[:, k, :3], [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0).T.tolist(),
        }
        for k in fast
        if rest[k] >= LEVEL
    }
