"""What tracking writes: track.npz, track.json, events.jsonl and report.html, and how track.npz is read again.

What happens in a film is told from poses and contacts: lifted, placed, pushed, toppled, bounced, and so on.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from derender import __version__
from derender.atomic import files_together
from derender.tracking.thing import GONE, HIDDEN, LOST, MOVING, STILL
from derender.tracking.track import Track

TOPPLED = np.radians(45.0)  # turn of what was up, since the thing last rested, from which on it has toppled
RISING = 0.05  # m/s: what leaves its support faster upward was lifted, not dropped
GENTLE = 0.6  # m/s: what comes down more slowly was placed; faster, it landed
DOWNWARD, UPWARD = -0.15, 0.08  # m/s of the normal speed before and after a bounce
NEAR = 0.02  # metres from what it bounces off


def events_of(track: Track) -> list[dict[str, Any]]:
    """Return the events of a track in the order of time.

    Each is {"frame", "time", "event", "object"}, and where it changes "from" and "to", what it rested and rests on, and
    "probability", of the new parent.
    """
    events: list[dict[str, Any]] = []
    parents, floors = track.parents(), track.floors()
    for k, name in enumerate(track.names):
        heights = np.array([(np.linalg.inv(f) @ p[k])[2, 3] for f, p in zip(floors, track.poses, strict=True)])
        speeds = np.full(len(heights), np.nan)
        if len(heights) > 1:
            speeds[1:] = np.diff(heights) / np.maximum(np.diff(track.times), 1e-9)

        def tell(t, event, k=k, name=name, **more):
            events.append({"frame": t, "time": float(track.times[t]), "event": event, "object": name, **more})

        rested = toppled = None
        for t in range(len(track.times)):
            state = track.states[t][k]
            before = track.states[t - 1][k] if t else state
            if before != state:
                tell(t, _change(before, state))
            if state in (LOST, GONE) or not np.isfinite(heights[t]):
                rested = None
                continue
            if state == STILL or rested is None:
                rested, toppled = track.poses[t, k], False
            if t == 0:
                continue
            old, new = parents[t - 1][k], parents[t][k]
            if old != new and before not in (LOST, GONE):
                words = [None, "floor", *track.names]
                chance = float(track.parent_probability[t, k, words.index(new)])
                coming = np.nanmin(speeds[max(t - 2, 1) : t + 1]) if t else 0.0
                if new is None:
                    later = np.nanmax(speeds[t : t + 3])
                    event = "lifted" if later > RISING else "fell"
                elif old is None:
                    event = "placed" if coming > -GENTLE else "landed"
                else:
                    event = "slid"
                tell(t, event, **{"from": old, "to": new, "probability": round(chance, 4)})
            if not toppled and track.types[k] != "sphere" and _up_turned(rested, track.poses[t, k], floors, t):
                tell(t, "toppled")
                toppled = True
            if _bounced(speeds, t) and np.isfinite(heights[t]):
                tell(
                    t, "bounced", speed=[round(float(speeds[t - 1]), 3), round(float(np.nanmax(speeds[t : t + 2])), 3)]
                )
    return sorted(events, key=lambda event: event["frame"])


def _change(before: str, state: str) -> str:
    """Return the word for a change of state."""
    if LOST in (before, state):
        return "lost" if state == LOST else "found"
    if state in (HIDDEN, GONE):
        return "hidden" if state == HIDDEN else "left"
    return {HIDDEN: "seen", GONE: "entered"}.get(before) or ("moves" if state == MOVING else "rests")


def _up_turned(rested: np.ndarray, pose: np.ndarray, floors: np.ndarray, t: int) -> bool:
    """Whether what pointed up when the thing rested now points elsewhere."""
    up = floors[t][:3, 2]
    then = rested[:3, :3].T @ up  # what was up, in the thing's axes
    return float(np.arccos(np.clip(up @ (pose[:3, :3] @ then), -1.0, 1.0))) > TOPPLED


def _bounced(speeds: np.ndarray, t: int) -> bool:
    """Whether the normal speed turns from down to up at frame t."""
    if t < 2 or t + 1 > len(speeds) or not np.isfinite(speeds[t - 1]):
        return False
    return bool(speeds[t - 1] < DOWNWARD and np.nanmax(speeds[t : t + 2]) > UPWARD and speeds[t] > speeds[t - 1])


FILES = ("track.npz", "track.json", "events.jsonl", "report.html")
DIGITS = 6  # after the point, of what track.json says


def track_json(track: Track) -> dict[str, Any]:
    """Return the track as track.json holds it: one pose and one parent a frame for each object, null where unknown.

    Beside the contract's keys stand `times`, `gravity`, `floor` and `views`, and of each object `states`, `deviations`
    (three standard deviations of its centre, metres), `parent_probability` and `lost`: the frames in which the tracker
    says that it does not know where the object is.
    """
    parents, words = track.parents(), ["none", "floor", *track.names]
    objects = []
    for k, name in enumerate(track.names):
        there = np.isfinite(track.poses[:, k, 0, 0])
        chances = track.parent_probability[:, k]
        objects.append(
            {
                "name": name,
                "type": track.types[k],
                "size": _rounded(track.sizes[-1, k]),
                "poses": [
                    _rounded(pose, 9) if seen else None for pose, seen in zip(track.poses[:, k], there, strict=True)
                ],
                "parents": [row[k] for row in parents],
                "states": [row[k] for row in track.states],
                "deviations": [
                    _rounded(np.sqrt(np.diag(c)[:3])) if seen else None
                    for c, seen in zip(track.covariances[:, k], there, strict=True)
                ],
                "parent_probability": [
                    {word: round(float(p), 4) for word, p in zip(words, row, strict=True) if p >= 5e-4}
                    if np.isfinite(row).all() else None
                    for row in chances
                ],
                "lost": [t for t, row in enumerate(track.states) if row[k] == LOST],
            }
        )  # fmt: skip
    return {
        "frame": "camera",
        "times": _rounded(track.times, 9),
        "gravity": _rounded(track.gravity),
        "floor": None if track.floor is None else _rounded(track.floor, 9),
        "views": _rounded(track.views, 9),
        "objects": objects,
        "parameters": {},
        "notes": track.notes,
    }


def _rounded(values: np.ndarray, digits: int = DIGITS) -> list[list[list[float] | float] | float]:
    return np.round(np.asarray(values, float), digits).tolist()


def write_track(folder: Path, track: Track, page: str, made: dict[str, Any]) -> None:
    """Write the four files into a folder, all or none.

    page : the report. made : seed and command, kept with the version.
    """
    made = {"version": __version__, **made}
    with files_together(folder, FILES) as temporary:
        np.savez_compressed(
            temporary / "track.npz",
            names=np.array(track.names, str), types=np.array(track.types, str), kinds=track.kinds,
            times=track.times, frames=np.array(track.frames, str), sizes=track.sizes, poses=track.poses,
            covariances=track.covariances, states=np.array(track.states, str).reshape(len(track.times), -1),
            parents=np.array([[parent or "" for parent in row] for row in track.parents()], str),
            parent_names=np.array(["", "floor", *track.names], str), parent_probability=track.parent_probability,
            views=track.views, floor=np.full((4, 4), np.nan) if track.floor is None else track.floor,
            gravity=track.gravity, rounds=track.rounds, pixels=track.pixels,
            header=np.array(json.dumps({**made, "notes": track.notes, "cut": track.cut})),
        )  # fmt: skip
        (temporary / "track.json").write_text(json.dumps({**track_json(track), **made}), encoding="utf-8")
        lines = "".join(json.dumps(event) + "\n" for event in events_of(track))
        (temporary / "events.jsonl").write_text(lines, encoding="utf-8")
        (temporary / "report.html").write_text(page, encoding="utf-8")
