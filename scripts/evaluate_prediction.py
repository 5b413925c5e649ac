"""What will happen, measured: what `python scripts/evaluate.py prediction` and `tosses` print.

    python scripts/evaluate.py prediction -n 4 [--kinds slide,bounce] [--keep DIR]
    python scripts/evaluate.py tosses -n 20 [--keep DIR]

prediction: the first half of a made film's motion goes through `infer --track --dynamics`; where on the floor is each
thing that moves on at the film's end? Beside it one film of the engine with MuJoCo's default friction of 1 and no
restitution, from the same inferred state. tosses: real tosses of a cube (see the README of the real frames). Of some,
half a second of poses at 30 frames a second, with errors like those of tracking, tells friction and restitution; they
are pooled (`pool`), and other tosses are predicted from their release. What holds the truth is a region of
90 %.
"""

import json
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from arguments import names_in
from real_frames import real_folder
from sequences import FRAMES, KINDS, make_sequence, write_sequence

from derender.atomic import make_folder
from derender.dynamics.engine import Engine, Material, Scales
from derender.dynamics.inference import identify
from derender.dynamics.motion import motion_of
from derender.dynamics.parameters import Parameters, read_dynamics_prior
from derender.dynamics.result import come_to_rest, last_apart, predict
from derender.dynamics.shooting import Shooting
from derender.dynamics.states import moved, to_poses
from derender.errors import DerenderError
from derender.physics.bodies import Body, Matter
from derender.physics.mujoco_model import Diverged
from derender.structures.options import Options
from derender.tracking.materials import motion_of_track
from derender.tracking.run import track_to_folder

FILMS = ("slide", "slope", "bounce", "collide", "topple")
DRAWS = 60
MOVES = 0.005  # metres in the second half: what already rests tells nothing
FEWEST = 5  # frames that are seen of a film that comes to rest early: two speeds and what slows them
DEFAULT_FRICTION, DEFAULT_RESTITUTION = 1.0, 0.0  # of MuJoCo
EVERY, SECONDS, MOST = 5, 0.5, 90  # of 148 poses a second; watched; intervals until a toss must rest
POSE_ERROR = (0.0005, 0.005)  # metres and radians, of made tracked poses
HEAD = "| {} | {} | in the 90 % region | median error, mm | default physics, mm | ratio |\n" + "|---" * 6 + "|"
TEACHERS = 6  # tosses that tell the materials
# A variance than which no film tells a number better.
LEAST_VARIANCE = 1e-8


def in_region(draws, truth, share=0.9):
    """Return whether `truth` (D,) lies in the ellipsoid about draws (K, D) that holds a share of them."""
    centre = np.median(draws, axis=0)
    inverse = np.linalg.inv(np.cov(draws.T) + 1e-8 * np.eye(draws.shape[1]))
    off = np.vstack([truth, draws]) - centre
    far = np.einsum("ki,ij,kj->k", off, inverse, off)
    return bool(far[0] <= np.quantile(far[1:], share))


class Lesson(NamedTuple):
    """What a film tells: mean, variance (P,) of the coordinates of `Parameters` and the scales' logarithms."""

    mean: np.ndarray
    variance: np.ndarray


class Pooled(NamedTuple):
    """What films tell of another one: numbers (P,) as a lesson's, each of a t distribution."""

    mean: np.ndarray  # (P,)
    variance: np.ndarray  # (P,), the squares of their scales
    freedom: int  # its degrees of freedom


def lesson(found):
    """Return what a film was found to tell."""
    points, weights = np.hstack([found.draws.coordinates, found.draws.logarithms]), np.exp(found.draws.log_weights)
    mean = weights @ points
    return Lesson(mean, weights @ (points - mean) ** 2 + LEAST_VARIANCE)


def pool(lessons):
    """Return what at least two films tell of another one, whose numbers differ as theirs do.

    Source: random effects of DerSimonian and Laird 1986, each number on its own. How much a few films differ is poorly
    known: as Higgins, Thompson and Spiegelhalter 2009, the prediction is a t distribution. Its degrees of freedom, L -
    1 of L films, are exact where each film tells its number well.
    """
    means, variances = (np.array(part) for part in zip(*lessons, strict=True))
    weights = 1 / variances
    centre = np.sum(weights * means, axis=0) / np.sum(weights, axis=0)
    scatter = np.sum(weights * (means - centre) ** 2, axis=0)
    freedom = np.sum(weights, axis=0) - np.sum(weights**2, axis=0) / np.sum(weights, axis=0)
    spread = np.maximum((scatter - (len(means) - 1)) / freedom, 0.0)
    weights = 1 / (variances + spread)
    mean = np.sum(weights * means, axis=0) / np.sum(weights, axis=0)
    return Pooled(mean, 1 / np.sum(weights, axis=0) + spread, len(means) - 1)


def predict_another(told, parameters, engine, sizes, states, rng, count, most):
    """Return draws (K, N, 13) of the states in which bodies come to rest from `states` (N, 13), K at most `count`.

    Each draw has a material and scales of its own, and the engine's errors of those scales after each interval: what
    an edge does at its first impact decides where the next one is, so that the spread grows with every impact. It is
    not learnt from ends that were seen: one of many films from drawn materials meets them by luck, and the scatter
    about it is too small (so, 90 % regions held .44 of real tosses).

    told : by other films (`pool`).
    sizes : (N,) mean side of each body, metres.
    most : intervals after `states`.
    """
    draws, size = [], parameters.size
    for _ in range(count):
        numbers = told.mean + np.sqrt(told.variance) * rng.standard_t(told.freedom, len(told.mean))
        material, scales = parameters.material(numbers[:size]), Scales(*np.exp(numbers[size:]))
        try:
            draws.append(come_to_rest(engine, sizes, states, material, most, scales, rng.standard_normal))
        except Diverged:
            continue
    return np.array(draws)


def default_of(engine):
    """Return the material of default physics."""
    return Material(DEFAULT_FRICTION, DEFAULT_RESTITUTION, engine.masses)


def predict_film(kind, seed, sensor):
    """Return a row for each thing that moves: whether the region holds, the error and that of default physics."""
    frames, camera, truth = make_sequence(np.random.default_rng([seed, KINDS.index(kind)]), kind, sensor)
    half, rows, rng = half_of(truth), [], np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as place:
        write_sequence(Path(place) / "film", frames[:half], camera, truth)
        track = track_to_folder([f"{place}/film"], Options(seed=seed), f"{place}/out").track
    try:
        motion = motion_of_track(track)
        if not motion.names:
            return []
        found = identify(motion, rng)
    except DerenderError:
        return []
    draws = predict(found, motion, rng, DRAWS, FRAMES - half)
    engine = Engine(motion.matter, motion.names, motion.step)
    sizes = np.array([float(np.mean(motion.body(name).size)) for name in motion.names])
    floor = np.array(truth["floor"])[:3, :2]  # its two axes
    states = found.modes[0].path.states
    last = last_apart(Shooting(motion, found.parameters, engine), states)
    engine = Engine(motion.matter, motion.names, motion.step)
    usual = come_to_rest(engine, sizes, states[last], default_of(engine), FRAMES - 1 - last)
    for k in range(len(motion.names)):
        here = motion.poses[np.argmax(motion.seen[:, k]), k, :3, 3]
        item = min(truth["objects"], key=lambda o: np.linalg.norm(np.array(o["poses"][0])[:3, 3] - here))
        end = np.array(item["poses"][-1])[:3, 3]
        travel = float(np.linalg.norm(end - np.array(item["poses"][half - 1])[:3, 3]))
        if travel > MOVES:
            rows.append(row_of(draws[:, k, :3] @ floor, end @ floor, usual[k, :3] @ floor))
    return rows


def half_of(truth):
    """Return the frames of the first half of a film's motion: slides are over before half of the film."""
    centres = np.array([np.array(item["poses"])[:, :3, 3] for item in truth["objects"]])
    far = np.linalg.norm(centres - centres[:, -1:], axis=-1).max(axis=0)
    return max(-(-int(np.sum(far > MOVES / 5)) // 2), FEWEST)


def row_of(draws, end, usual):
    """Return how a prediction (K, D) did, and that of default physics (D,)."""
    error = float(np.linalg.norm(np.median(draws, axis=0) - end))
    return {"inside": in_region(draws, end), "error": error, "usual": float(np.linalg.norm(usual - end))}


def tosses():
    """Return the tosses: a list of states (T, 1, 13) at EVERY-th row, the seconds between two, and the cube."""
    data = np.load(real_folder() / "tosses" / "tosses.npz")
    films = []
    for a, b in zip(data["start"][:-1], data["start"][1:], strict=True):
        states = np.zeros((len(range(a, b, EVERY)), 1, 13))
        states[:, 0, :3], states[:, 0, 3:7] = data["position"][a:b:EVERY], data["quat_wxyz"][a:b:EVERY]
        states[:, 0, 7:10] = data["velocity"][a:b:EVERY]
        turns = to_poses(states)[:, 0, :3, :3]
        states[:, 0, 10:] = np.einsum("tji,tj->ti", turns, data["angular_velocity"][a:b:EVERY])
        films.append(states)
    body = Body("cube", "box", np.full(3, float(data["side"])), np.eye(4), mass=float(data["mass"]))
    floor = Body("floor", "plane", np.zeros(3), np.eye(4))
    return films, EVERY * float(data["dt"]), Matter((floor, body), np.array([0.0, 0.0, -9.81]), ())


def teach(states, step, matter, seed):
    """Return what the beginning of a toss tells, seen with errors like those of tracking."""
    rng = np.random.default_rng(seed)
    error = np.repeat(POSE_ERROR, 3)
    changes = np.zeros((len(states), 1, 12))
    changes[..., :6] = error * rng.standard_normal((len(states), 1, 6))
    covariances = np.tile(np.diag(error**2), (len(states), 1, 1, 1))
    poses = to_poses(moved(states, changes))
    motion = motion_of(matter, ("cube",), step * np.arange(len(states)), poses, covariances)
    return lesson(identify(motion, rng))


def kept(path, make):
    """Return what a file holds as JSON, or make and write it; path None: make it."""
    if path is not None and path.exists():
        return json.loads(path.read_text())
    made = make()
    if path is not None:
        path.write_text(json.dumps(made))
    return made


def evaluate_prediction(count, first, sensor, kinds, keep):
    """Print the table over kinds of films."""
    folder = make_folder(keep) if keep else None
    print(HEAD.format("kind", "things"))
    everything = []
    for kind in names_in(kinds, FILMS, "kind of film"):
        rows = []
        for seed in range(first, first + count):
            path = folder and folder / f"prediction_{kind}_{seed:03d}.json"
            rows += kept(path, lambda kind=kind, seed=seed: predict_film(kind, seed, sensor))
        everything += rows
        print_row(kind, rows)
    print_row("all", everything)
    print("goals: .85-.95 in the region; median error at most half of default physics")


def print_row(name, rows):
    """Print one row of the table."""
    if rows:
        inside, error, usual = (np.array([row[key] for row in rows]) for key in ("inside", "error", "usual"))
        middle, other = 1e3 * np.median(error), 1e3 * np.median(usual)
        ratio = f"{middle / max(other, 1e-6):.2f}"
        print(f"| {name} | {len(rows)} | {inside.mean():.2f} | {middle:.1f} | {other:.1f} | {ratio} |", flush=True)


def evaluate_tosses(count, first, keep):
    """Learn from TEACHERS tosses, predict `count` others, print the figures."""
    if real_folder() is None:
        print("no folder of real frames here")
        return
    folder = make_folder(keep) if keep else None
    films, step, matter = tosses()
    lessons, rows = [], []
    for k in range(TEACHERS):
        path, watched = folder and folder / f"toss_lesson_{k:03d}.json", films[k][: int(SECONDS / step) + 1]
        taught = lambda k=k, watched=watched: [part.tolist() for part in teach(watched, step, matter, k)]  # noqa: E731
        lessons.append(Lesson(*(np.array(part) for part in kept(path, taught))))
    engine, sizes, told = Engine(matter, ("cube",), step), matter.bodies[1].size[:1], pool(lessons)
    parameters = Parameters(("cube",), engine.masses, read_dynamics_prior())
    print(f"friction {np.exp(told.mean[0]):.3f}, restitution {told.mean[1]:.3f} (the source: .18, .13)")
    print(
        "errors: impact {:.3f}, steady {:.3f} as shares, centres {:.2f}, turns {:.2f} times".format(
            *np.exp(told.mean[parameters.size :])
        )
    )

    def predict_toss(k):
        start, rng = films[k][0], np.random.default_rng(k)
        draws = predict_another(told, parameters, engine, sizes, start, rng, DRAWS, MOST)[:, 0, :2]
        usual = come_to_rest(engine, sizes, start, default_of(engine), MOST)[0, :2]
        return row_of(draws, films[k][-1, 0, :2], usual)

    for k in range(TEACHERS + first, TEACHERS + first + count):
        rows.append(kept(folder and folder / f"toss_{k:03d}.json", lambda k=k: predict_toss(k)))
    print(HEAD.format("tosses", "held back"))
    print_row("cube", rows)
