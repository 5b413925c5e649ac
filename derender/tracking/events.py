"""What happens in a film, told from poses and contacts: lifted, placed, pushed, toppled, bounced, and so on."""

from typing import Any

import numpy as np

from derender.tracking.thing import GONE, HIDDEN, LOST, MOVING, STILL

TOPPLED = np.radians(45.0)  # turn of what was up, since the thing last rested, from which on it has toppled
RISING = 0.05  # m/s: what leaves its support faster upward was lifted, not dropped
GENTLE = 0.6  # m/s: what comes down more slowly was placed; faster, it landed
DOWNWARD, UPWARD = -0.15, 0.08  # m/s of the normal speed before and after a bounce
NEAR = 0.02  # metres from what it bounces off

KINDS = ("lifted", "fell", "placed", "landed", "slid", "moves", "rests", "toppled", "bounced", "entered", "left",
         "hidden", "seen", "lost", "found")  # fmt: skip


def events_of(track) -> list[dict[str, Any]]:
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
            _states(tell, t, before, state)
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


def _states(tell, t, before, state) -> None:
    """Tell what a change of state means."""
    if t == 0 or before == state:
        return
    if state == LOST:
        tell(t, "lost")
    elif before == LOST:
        tell(t, "found")
    elif state == HIDDEN:
        tell(t, "hidden")
    elif before == HIDDEN:
        tell(t, "seen" if state != GONE else "left")
    elif state == GONE:
        tell(t, "left")
    elif before == GONE:
        tell(t, "entered")
    elif state == MOVING:
        tell(t, "moves")
    elif state == STILL:
        tell(t, "rests")


def _up_turned(rested, pose, floors, t) -> bool:
    """Whether what pointed up when the thing rested now points elsewhere."""
    up = floors[t][:3, 2]
    then = rested[:3, :3].T @ up  # what was up, in the thing's axes
    return float(np.arccos(np.clip(up @ (pose[:3, :3] @ then), -1.0, 1.0))) > TOPPLED


def _bounced(speeds, t) -> bool:
    """Whether the normal speed turns from down to up at frame t."""
    if t < 2 or t + 1 > len(speeds) or not np.isfinite(speeds[t - 1]):
        return False
    return bool(speeds[t - 1] < DOWNWARD and np.nanmax(speeds[t : t + 2]) > UPWARD and speeds[t] > speeds[t - 1])
