"""What happens in a film, told from poses and contacts: lifted, placed, pushed, toppled, bounced, and so on."""

from typing import Any

import numpy as np

from derender.scene.solids import CYLINDER, SPHERE
from derender.tracking.contact import SLACK_AT_REST, gaps_of
from derender.tracking.thing import GONE, HIDDEN, LOST, MOVING, STILL
from derender.tracking.track import Track

# Turns of what was up since the thing last rested: it leans; it has toppled if it stays beyond that, or has been ...
LEANING, TOPPLED = np.radians(15.0), np.radians(45.0)
FAR_OVER = np.radians(80.0)  # ... so far before it comes back, as what goes on rolling does
RISING = 0.05  # m/s: what leaves its support faster upward was lifted, not dropped
# What comes down has landed where its speed rises by more than half of what free fall's does over the last seconds and
# frames in the air, else it was placed; where it is seen there too shortly, m/s that are too fast for a hand.
FREELY, BEFORE, SEEN, GENTLE = 0.5 * 9.81, 0.12, 4, 0.6
DOWNWARD, UPWARD = -0.15, 0.08  # m/s of the normal speed before and after a bounce


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

        still = np.array([row[k] == STILL for row in track.states])
        borne = np.array([row[k] is not None for row in parents])
        aloft = ~borne & np.isfinite(heights)
        turns = [t for t in range(1, len(heights) - 1) if aloft[t - 1 : t + 2].any() and _bounces(heights, speeds, t)]
        bounces = [t for t in turns if _meets(track, t, k, np.abs(np.diff(heights[t - 1 : t + 2])).max())]
        over = topples(track.poses[:, k], floors[:, :3, 2], int(track.kinds[k]), still, borne)
        left = ""  # how it left what it rested on before
        for t in range(len(track.times)):
            state = track.states[t][k]
            before = track.states[t - 1][k] if t else state
            if before != state:
                tell(t, _change(before, state))
            if state in (LOST, GONE) or not np.isfinite(heights[t]) or t == 0:
                continue
            old, new = parents[t - 1][k], parents[t][k]
            if old != new and before not in (LOST, GONE):
                words = [None, "floor", *track.names]
                chance = float(track.parent_probability[t, k, words.index(new)])
                if new is None:
                    later = np.nanmax(speeds[t : t + 3])
                    event = left = "lifted" if later > RISING else "fell"
                elif old is None:
                    falls = left == "fell" or _falls_freely(track.times, heights, aloft, bounces, t)
                    event, left = "landed" if falls else "placed", ""
                else:
                    event = "fell" if np.nanmin(speeds[max(t - 2, 1) : t + 1]) < DOWNWARD else "slid"
                tell(t, event, **{"from": old, "to": new, "probability": round(chance, 4)})
            if t in over:
                tell(t, "toppled")
            if t in bounces:
                tell(
                    t, "bounced", speed=[round(float(speeds[t]), 3), round(float(np.nanmax(speeds[t + 1 : t + 3])), 3)]
                )
    return sorted(events, key=lambda event: event["frame"])


def _change(before: str, state: str) -> str:
    """Return the word for a change of state."""
    if LOST in (before, state):
        return "lost" if state == LOST else "found"
    if state in (HIDDEN, GONE):
        return "hidden" if state == HIDDEN else "left"
    return {HIDDEN: "seen", GONE: "entered"}.get(before) or ("moves" if state == MOVING else "rests")


def topples(poses: np.ndarray, ups: np.ndarray, kind: int, still: np.ndarray, borne: np.ndarray) -> list[int]:
    """Return the frames in which a thing turns over an edge for good: once from one rest to the next.

    What turned in the air or in a hand has not toppled, nor what rocks and comes back.

    poses : (T, 4, 4), NaN where not there. ups : (T, 3) in the same axes. kind : of scene.solids. still, borne : (T,)
    bool, whether it rests, and whether something bears it.
    """
    found: list[int] = []
    inside = np.einsum("tji,tj->ti", poses[:, :3, :3], ups)  # what is up, in the thing's axes
    if kind == SPHERE:
        return found
    if kind == CYLINDER:  # rolling turns nothing over
        inside = np.stack([np.linalg.norm(inside[:, :2], axis=1), np.zeros(len(inside)), inside[:, 2]], axis=1)
    rested, leant, told = None, 0, False
    for t, up in enumerate(inside):
        if not np.isfinite(up).all():
            rested = None
            continue
        if still[t] or rested is None:
            rested, leant, told = up, t, False
        now = np.arccos(np.clip(up @ rested, -1.0, 1.0))
        if now < LEANING:
            leant = t + 1
        if told or not now > TOPPLED or not borne[max(leant - 1, 0) : leant + 1].any():
            continue
        turn = np.arccos(np.clip(inside[t:] @ rested, -1.0, 1.0))
        over = np.flatnonzero(~(turn > TOPPLED) | np.append(False, still[t + 1 :]))
        if len(over) == 0 or turn[over[0]] > TOPPLED or turn[: over[0]].max() > FAR_OVER:
            found.append(t)
            told = True
    return found


def _bounces(heights: np.ndarray, speeds: np.ndarray, t: int) -> bool:
    """Whether a thing is lowest at frame t and comes down before, and goes up after that."""
    lowest = heights[t] <= heights[t - 1] and heights[t] < heights[t + 1]
    return bool(lowest and np.nanmin(speeds[max(t - 1, 1) : t + 1]) < DOWNWARD and max(speeds[t + 1 : t + 3]) > UPWARD)


def _meets(track: Track, t: int, k: int, way: float) -> bool:
    """Whether thing k meets something below it within the metres that it goes up or down in a frame about frame t: a
    hand turns it back anywhere. Without a floor that may be whatever is not seen."""
    gaps = gaps_of(track.poses[t], track.sizes[t], track.kinds, track.floors()[t])
    return track.floor is None or bool(gaps[k].min() < way + SLACK_AT_REST)


def _falls_freely(times: np.ndarray, heights: np.ndarray, aloft: np.ndarray, bounces: list[int], t: int) -> bool:
    """Whether nothing held a thing that comes to stand at frame t: it bounced, or it came down ever faster."""
    begin = t
    while begin > 0 and aloft[begin - 1]:
        begin -= 1
    if any(begin <= other <= t for other in bounces):
        return True
    seen = np.arange(max(begin, min(t - SEEN, int(np.searchsorted(times, times[t] - BEFORE)))), t)
    if len(seen) < SEEN:
        fall = slice(max(begin - 1, 0), t + 1)
        return bool(np.min(np.diff(heights[fall]) / np.diff(times[fall])) < -GENTLE)
    return 2.0 * float(np.polyfit(times[seen] - times[t], heights[seen], 2)[0]) < -FREELY
