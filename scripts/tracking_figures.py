"""Tracking measured on made films: what `python scripts/evaluate.py tracking` prints.

    python scripts/evaluate.py tracking                one film of each kind
    python scripts/evaluate.py tracking -n 6           six films of each kind
    python scripts/evaluate.py tracking --kinds place,topple --sensor realsense
    python scripts/evaluate.py tracking --fps 10 --size 320x240     fewer frames a second, larger ones
    python scripts/evaluate.py tracking --motion 0.1                the camera goes round the scene, metres a second

Of an object-frame, the thing is lost where track.json has no pose or one off by more than LOST. A contact change is a
frame in which the parent differs from that of the frame before; it is found where the same thing changes to the same
parent within three frames; beside it stands what the same rule finds in the true poses. Things that topple are those
of the true poses too. An identity is switched where a thing's name is nearest to another true object in a later frame
than at first, by more than both are wide. A full likelihood draws all solids anew, blurs and compares all pixels.
"""

import time

import numpy as np
from arguments import names_in
from sequences import FILMS, make_sequence

from derender.camera.intrinsics import Camera
from derender.render.raycast.normal_equations import cost
from derender.scene.solids import KINDS as SOLIDS
from derender.structures.options import Options
from derender.tracking.contact import parent_probabilities
from derender.tracking.events import events_of, topples
from derender.tracking.film import Film
from derender.tracking.passes import Passes
from derender.tracking.run import inferrer
from derender.tracking.thing import start_from
from derender.tracking.track import Recorder

LOST = 0.03  # metres
STIRRED = 1e-4  # metres from frame to frame: what moves by less rests
WITHIN = 3  # frames
LEVEL, QUANTILE = 0.9, 1.6449  # of pose intervals
GOALS = {
    "lost": "at most 1 %", "centre error, 95 %": "at most 10 mm", "identities switched": "0",
    "F1 of contacts, place": "at least .95", "F1 of contacts, topple": "at least .80", "coverage": ".85-.95",
}  # fmt: skip


def matched(track, truth):
    """Return the index of the tracked thing for each true object, nearest at the first frame, or None."""
    found, free = [], set(range(len(track.names)))
    for item in truth["objects"]:
        centre = np.array(item["poses"][0])[:3, 3]
        off = {
            k: np.linalg.norm(track.poses[0, k, :3, 3] - centre) for k in free if np.isfinite(track.poses[0, k]).all()
        }
        best = min(off, key=off.get) if off else None
        found.append(best)
        free.discard(best)
    return found


def changes(parents):
    """Return [(frame, new parent)] of a list of parents."""
    return [(t, parents[t]) for t in range(1, len(parents)) if parents[t] != parents[t - 1]]


def hits(mine, true):
    """Return how many changes of `mine` pair with one of `true` to the same parent within WITHIN frames."""
    free, count = list(true), 0
    for t, parent in mine:
        near = [c for c in free if c[1] == parent and abs(c[0] - t) <= WITHIN]
        if near:
            free.remove(min(near, key=lambda c: abs(c[0] - t)))
            count += 1
    return count


def follow(frames, camera, seed, moving_camera):
    """Return (track, seconds of infer, of each frame and of a full likelihood, moving things a frame).

    Seconds are the CPU's: with other work beside it, a frame takes longer by the clock, and one likelihood does not.
    """
    seen = Camera(**{key: camera[key] for key in ("fx", "fy", "cx", "cy", "width", "height")})
    times = np.arange(len(frames)) / camera["fps"]
    film = Film([str(t) for t in range(len(frames))], list(frames.astype(float)), seen, False, times,
                np.array(camera["gravity"]), False)  # fmt: skip
    infer, rng = inferrer(Options(seed=seed), seen), np.random.default_rng(seed)
    start = time.process_time()
    posterior = infer(film.frames[0], False)
    first, spent, moving = time.process_time() - start, [], []
    recorder = Recorder(film.frames[0], seen, start_from(posterior, rng), film.gravity,
                        1 / camera["fps"], moving_camera)  # fmt: skip
    for frame in film.frames[1:]:
        start = time.process_time()
        recorder.advance(frame)
        spent.append(time.process_time() - start)
        moving.append(sum(state == "moving" for state in recorder.seen[-1].states))
    tracker, full = recorder.tracker, []
    for _ in range(20):
        tracker.misfit.canvas.drawn_window[:] = 0
        start = time.process_time()
        cost(tracker.misfit, tracker.poses, tracker.sizes)
        full.append(time.process_time() - start)
    known = {film.frames[0].tobytes(): posterior}  # inferred once

    def first_of(depth):
        return start_from(known.get(depth.tobytes()) or infer(depth, False), np.random.default_rng(seed))

    look = lambda depth: infer(depth, True)  # noqa: E731
    best = Passes(film.frames, seen, film.gravity, 1 / camera["fps"], first_of, look, moving_camera).best()
    return best.track(times, film.names), first, np.array(spent), float(np.median(full)), np.array(moving)


def by_true_poses(truth):
    """Return how many contact changes a film's true poses show, (said, true, of these found), and what topples in them:
    [(frame, name)]."""
    items, counts, toppled = truth["objects"], np.zeros(3, int), []
    poses = np.array([item["poses"] for item in items]).swapaxes(0, 1)
    frames, things = poses.shape[:2]
    sizes = np.tile([item["size"] for item in items], (frames, 1, 1))
    moved = np.linalg.norm(np.diff(poses[:, :, :3, 3], axis=0), axis=-1) > STIRRED
    chances = parent_probabilities(
        poses, np.tile(1e-8 * np.eye(6), (frames, things, 1, 1)), sizes, np.array([SOLIDS[i["type"]] for i in items]),
        np.array(truth["views"]), ~np.concatenate([moved, moved[-1:]]),
    )  # fmt: skip
    words = [None, "floor", *(item["name"] for item in items)]
    ups = np.array(truth["views"])[:, :3, 2]
    for k, (best, item) in enumerate(zip(chances.argmax(axis=2).T, items, strict=True)):
        mine, true = changes([words[n] for n in best]), changes(item["parents"])
        counts += [len(mine), len(true), hits(mine, true)]
        still, borne = np.arange(frames) == 0, np.array([parent is not None for parent in item["parents"]])
        toppled += [(t, item["name"]) for t in topples(poses[:, k], ups, SOLIDS[item["type"]], still, borne)]
    return counts, toppled


def compare(track, truth):
    """Return the figures of one film as a dict of counts and lists; `toppled` and `ideal`: (said, true, found)."""
    pairs, parents = matched(track, truth), track.parents()
    true_of = {track.names[k]: item["name"] for k, item in zip(pairs, truth["objects"], strict=True) if k is not None}
    true_of["floor"] = "floor"
    centres = np.array([np.array(item["poses"])[:, :3, 3] for item in truth["objects"]])
    row = {"frames": 0, "lost": 0, "switched": 0, "errors": [], "inside": [], "mine": 0, "true": 0, "hits": 0}
    for n, (k, item) in enumerate(zip(pairs, truth["objects"], strict=True)):
        frames = len(item["poses"])
        row["frames"] += frames
        if k is None:
            row["lost"] += frames
            continue
        error = np.full(frames, np.inf)
        off = track.poses[:, k, :3, 3] - centres[n][: len(track.times)]
        error[: len(off)] = np.where(np.isfinite(off).all(axis=1), np.linalg.norm(off, axis=1), np.inf)
        row["lost"] += int((error > LOST).sum())
        row["errors"] += error[error <= LOST].tolist()
        deviation = np.sqrt(np.diagonal(track.covariances[:, k, :3, :3], axis1=1, axis2=2))
        row["inside"] += (np.abs(off) <= QUANTILE * deviation)[np.isfinite(off).all(axis=1)].ravel().tolist()
        last = track.poses[-1, k, :3, 3]
        distances = np.linalg.norm(centres[:, -1] - last, axis=1)
        nearest = int(np.argmin(distances))
        row["switched"] += int(nearest != n and distances[n] > LOST and distances[nearest] < LOST)
        said = [true_of.get(r[k], r[k]) if r[k] is not None else None for r in parents]
        mine, true = changes(said), changes(item["parents"])
        row["mine"], row["true"], row["hits"] = (
            row["mine"] + len(mine),
            row["true"] + len(true),
            row["hits"] + hits(mine, true),
        )
    row["ideal"], over = by_true_poses(truth)
    told = [(e["frame"], true_of.get(e["object"])) for e in events_of(track) if e["event"] == "toppled"]
    row["toppled"] = [len(told), len(over), hits(told, over)]
    return row


def evaluate_tracking(count, first, sensor, kinds, verbose, motion, size, fps):
    """Make films, follow them, print the table; motion, size, fps : as of `make_sequence`."""
    rows, ratios, likelihoods = {}, [], []
    print(
        "| kind | films | lost | error 95 %, mm | switched | F1 of contacts | true poses | coverage 90 % | ms a frame |"
    )
    print("|---" * 9 + "|")
    for kind in names_in(kinds, FILMS, "kind of film"):
        all_rows, milliseconds = [], []
        for k in range(first, first + count):
            rng = np.random.default_rng([k, FILMS.index(kind)])
            frames, camera, truth = make_sequence(rng, kind, sensor, motion, size, fps)
            track, seconds, spent, full, moving = follow(frames, camera, k, motion > 0)
            all_rows.append(compare(track, truth))
            milliseconds += (1e3 * spent).tolist()
            one = moving == 1
            ratios += (seconds / spent).tolist()
            likelihoods += (spent[one] / full).tolist()
            if verbose:
                row = all_rows[-1]
                worst = 1e3 * max(row["errors"], default=0.0)
                found = f"changes {row['hits']} of {row['true']} ({row['mine']} said)"
                print(f"{kind} {k}: lost {row['lost']} of {row['frames']}, worst {worst:.1f} mm, {found}", flush=True)
        rows[kind] = all_rows
        print_row(kind, all_rows, milliseconds)
    print_row("all", [row for some in rows.values() for row in some], [])
    said, over, found = np.sum([row["toppled"] for some in rows.values() for row in some], axis=0)
    print(f"\nof {over} things that topple {found} are said to, within {WITHIN} frames, and {said - found} others")
    if likelihoods:
        print(f"a frame where one thing moves costs {np.median(likelihoods):.1f} full likelihoods (goal: at most 10)")
    print(f"infer of the first frame costs {np.median(ratios):.0f} times a frame (goal: at least 100), same run")
    print("goals: " + "; ".join(f"{name} {goal}" for name, goal in GOALS.items()))


def print_row(name, rows, milliseconds):
    """Print one row of the table."""
    total = {key: sum(row[key] for row in rows) for key in ("frames", "lost", "switched", "mine", "true", "hits")}
    errors = [1e3 * error for row in rows for error in row["errors"]]
    inside = [value for row in rows for value in row["inside"]]
    told = [(total["mine"], total["true"], total["hits"]), np.sum([row["ideal"] for row in rows], axis=0)]
    score, ideal = (2 * both / (said + true) if said + true else np.nan for said, true, both in told)
    print(
        f"| {name} | {len(rows)} | {total['lost'] / max(total['frames'], 1):.2%} | {np.percentile(errors, 95):.1f} | "
        f"{total['switched']} | {score:.2f} | {ideal:.2f} | {np.mean(inside):.2f} | "
        f"{f'{np.median(milliseconds):.0f}' if milliseconds else ''} |", flush=True,
    )  # fmt: skip
