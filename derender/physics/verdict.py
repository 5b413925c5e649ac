"""The verdict on a trajectory in three words: it stands, it settles, it falls."""

from typing import NamedTuple

import numpy as np

from derender.physics.bodies import Matter
from derender.physics.statics import WIDEST_GAP, WIDEST_GAP_METRES, find_contacts, unit_of_length
from derender.physics.trajectory import Trajectory

STANDS, SETTLES, FALLS = "stands", "settles", "falls"
# A body bears another if it pushes it up: its contact's normal is within 60 degrees of the vertical.
UPWARDS = 0.5
# A body whose upper side has leant over by more than this has toppled.
TOPPLED = np.cos(np.deg2rad(45.0))


class Verdict(NamedTuple):
    """Whether a scene stands.

    Attributes
    ----------
    stable : whether every body stayed where it was, at all times.
    fallen : names of those that did not, the first to move first.
    displacement : the greatest distance from where it began, metres by name.
    rotation : the greatest angle, radians by name.
    word : "stands"; "settles": something moved and came to rest as the same structure, every body on what bore it
        before and the same side up; or "falls".
    first_moved : when each of `fallen` left its place, seconds.
    """

    stable: bool
    fallen: tuple[str, ...]
    displacement: dict[str, float]
    rotation: dict[str, float]
    word: str = STANDS
    first_moved: dict[str, float] = {}  # noqa: RUF012 - never changed


def judge(trajectory: Trajectory, matter: Matter | None = None) -> Verdict:
    """Return whether the bodies stayed where they were, and how far each moved and turned.

    matter : the scene that was simulated; without it what has moved has fallen.
    """
    moved = trajectory.first_moved()
    word = STANDS
    if moved:
        same = matter is not None and trajectory.resting and _same_structure(trajectory, matter)
        word = SETTLES if same else FALLS
    return Verdict(
        not moved, tuple(moved), trajectory.greatest_displacement(), trajectory.greatest_rotation(), word, moved
    )


def bearers(matter: Matter) -> dict[str, set[str]]:
    """Return by name which bodies each moving body rests on, across gaps of millimetres too."""
    length = unit_of_length(matter)
    contacts = find_contacts(matter, near=max(WIDEST_GAP * length, WIDEST_GAP_METRES))
    up = -matter.gravity / (float(np.linalg.norm(matter.gravity)) or 1.0)
    found: dict[str, set[str]] = {body.name: set() for body in matter.bodies if body.moves}
    rise = contacts.normal @ up
    for first, second, lift in zip(contacts.first, contacts.second, rise, strict=True):
        upper, lower = (first, second) if lift > 0 else (second, first)
        name = matter.bodies[upper].name
        if abs(lift) > UPWARDS and name in found:
            found[name].add(matter.bodies[lower].name)
    return found


def at_rest(trajectory: Trajectory, matter: Matter) -> Matter:
    """Return the scene as it is at the end of a trajectory, without speed."""
    last = dict(zip(trajectory.names, trajectory.poses[-1], strict=True))
    still = (0.0, 0.0, 0.0)
    bodies = (body._replace(pose=last.get(body.name, body.pose)) for body in matter.bodies)
    return matter._replace(bodies=tuple(body._replace(velocity=still, angular_velocity=still) for body in bodies))


def _same_structure(trajectory: Trajectory, matter: Matter) -> bool:
    """Return whether every body ended on something that bore it at the start, the same side up."""
    up = -matter.gravity / (float(np.linalg.norm(matter.gravity)) or 1.0)
    kinds = {body.name: body.kind for body in matter.bodies}
    for k, name in enumerate(trajectory.names):
        first, last = (trajectory.poses[step, k, :3, :3].T @ up for step in (0, -1))
        if kinds[name] != "sphere" and first @ last < TOPPLED:
            return False
    before, after = bearers(matter), bearers(at_rest(trajectory, matter))
    return all(before[name] & after[name] for name in before)
