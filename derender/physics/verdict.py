"""The verdict on a trajectory in three words: it stands, it settles, it falls; and when it is known while it runs."""

from typing import NamedTuple

import numpy as np

from derender.physics.bodies import Matter
from derender.physics.statics import WIDEST_GAP, WIDEST_GAP_METRES, find_contacts, unit_of_length
from derender.physics.trajectory import Trajectory
from derender.scene.graph import STANDARD_GRAVITY

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


# At rest: no corner has moved by more than this share of the smallest extent during the time below. Places and not
# speeds are compared, because contacts chatter, a ball on a slope that holds it creeps by an eighth of this, and blocks
# that have settled on uneven ones by up to a half.
DRIFT = 8e-3
# That time in units of sqrt(L / g), L the greatest extent: at a thousandth of g, the least that tips a scene over, a
# body moves by .008 L in it.
CALM_TIME = 4.0
# A body that has turned its upper side away by more than 60 degrees does not turn it back.
TURNED_AWAY = 0.5
# A body that has sunk by this share of its greatest extent more than all that bore it is borne by none of them: a plate
# that leans on one of two posts by 45 degrees has sunk by .35.
SUNK = 0.5
# After a body is lost the simulation goes on for so many times the time of a fall from the scene's height, so that what
# it held or hits falls too.
AFTERMATH = 2.0


class Fate:
    """What decides the verdict on a scene while it is simulated.

    Parameters
    ----------
    matter : the scene at the start. length : metres, its smallest extent.
    """

    def __init__(self, matter: Matter, length: float) -> None:
        moving = [body for body in matter.bodies if body.moves]
        strength = float(np.linalg.norm(matter.gravity))
        self._up = -matter.gravity / (strength or 1.0)
        self._sizes = np.array([body.size for body in moving], dtype=float).reshape(-1, 3)
        self._start = np.array([body.pose for body in moving], dtype=float).reshape(-1, 4, 4)
        self._drift = DRIFT * length
        longest = self._sizes.max(initial=length)
        self._calm = CALM_TIME * np.sqrt(longest / (strength or STANDARD_GRAVITY))
        heights = self._start[:, :3, 3] @ self._up
        tall = np.ptp(heights) + longest if moving else longest
        self._aftermath = AFTERMATH * np.sqrt(2 * tall / (strength or STANDARD_GRAVITY))
        place = {body.name: k for k, body in enumerate(moving)}
        borne = bearers(matter)
        self._bearers = [[place.get(name, -1) for name in borne[body.name]] for body in moving]
        self._rolls = np.array([body.kind == "sphere" for body in moving], dtype=bool)
        self._lost_at = np.inf

    def at_rest(self, times: np.ndarray, poses: np.ndarray) -> bool:
        """Return whether nothing has moved lately. times : (T,) seconds; poses : (T, M, 4, 4) of what moves."""
        before = poses[max(int(np.searchsorted(times, times[-1] - self._calm, side="right")) - 1, 0)]
        moved = np.linalg.norm(poses[-1, :, :3, 3] - before[:, :3, 3], axis=1)
        turned = np.linalg.norm(poses[-1, :, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2)
        calm = np.all(moved + 0.5 * np.linalg.norm(self._sizes, axis=1) * turned < self._drift)
        return bool(calm and times[-1] >= self._calm)

    def sealed(self, time: float, poses: np.ndarray) -> bool:
        """Return whether a body has lost what bore it, some time ago. poses : (M, 4, 4) of what moves."""
        if self._lost_at == np.inf and self._loses(poses):
            self._lost_at = time
        return time >= self._lost_at + self._aftermath

    def _loses(self, poses: np.ndarray) -> bool:
        if not np.any(self._up):
            return False
        upright = np.einsum("i,kij,klj,l->k", self._up, self._start[:, :3, :3], poses[:, :3, :3], self._up)
        if np.any(upright[~self._rolls] < TURNED_AWAY):
            return True
        # a plane or a fixed body, index -1, does not sink
        sunk = np.append((self._start[:, :3, 3] - poses[:, :3, 3]) @ self._up, 0.0)
        most = [max((sunk[k] for k in by), default=0.0) for by in self._bearers]
        return bool(np.any(sunk[:-1] - most > SUNK * self._sizes.max(axis=1)))
