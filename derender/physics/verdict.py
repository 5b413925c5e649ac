"""Trajectories, and the verdict on them in three words: it stands, it settles, it falls; and when that is known.

Also the scene graph of where things came to rest: every body on what bears it now.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.physics.bodies import Matter
from derender.physics.statics import Entered, deep_overlaps, find_contacts, widest_gap
from derender.scene.contacts.kinds import ON_A_FACE
from derender.scene.graph import (
    ROOT,
    STANDARD_GRAVITY,
    Contact,
    SceneGraph,
    Vertex,
    floating,
    nearest_contact,
    vertex_of,
)
from derender.scene.pose import inverse
from derender.scene.shapes.base import Body

# A body has moved when its centre is displaced by more than a tenth of its mean extent (the side of the cube of its
# volume), or it has turned by more than 10 degrees. Among 200 towers of ten blocks the greatest creep of one that
# stands is .02 of a mean extent and the least movement of one that does not is 1.0.
DISPLACEMENT_TOLERANCE = 0.1
ROTATION_TOLERANCE = np.deg2rad(10.0)


class Trajectory(NamedTuple):
    """Poses of bodies over time."""

    names: tuple[str, ...]  # of the bodies
    sizes: np.ndarray  # (N, 3) float64, full extents in metres
    times: np.ndarray  # (T,) float64, seconds, from 0
    poses: np.ndarray  # (T, N, 4, 4) float64, body to the frame of the scene
    resting: bool = False  # whether everything was at rest at the end

    def greatest_displacement(self) -> dict[str, float]:
        """Return how far from where it began each body's centre came at any time, metres."""
        return self._by_name(self._moved().max(axis=0))

    def greatest_rotation(self) -> dict[str, float]:
        """Return by what angle each body was turned at any time, radians."""
        return self._by_name(self._turned().max(axis=0))

    def first_moved(self) -> dict[str, float]:
        """Return when each body that left where it was had moved or turned by the tolerances, seconds, in order."""
        limits = DISPLACEMENT_TOLERANCE * np.cbrt(np.prod(self.sizes, axis=1))
        gone = (self._moved() > limits) | (self._turned() > ROTATION_TOLERANCE)
        when = {k: float(self.times[np.argmax(gone[:, k])]) for k in np.flatnonzero(gone.any(axis=0))}
        return {self.names[k]: when[k] for k in sorted(when, key=lambda k: when[k])}

    def _moved(self) -> np.ndarray:
        return np.linalg.norm(self.poses[:, :, :3, 3] - self.poses[0, :, :3, 3], axis=2)

    def _turned(self) -> np.ndarray:
        relative = np.swapaxes(self.poses[0, :, :3, :3], 1, 2) @ self.poses[:, :, :3, :3]
        sine = np.linalg.norm(relative - np.swapaxes(relative, 2, 3), axis=(2, 3)) / np.sqrt(8)
        return np.arctan2(sine, 0.5 * (np.trace(relative, axis1=2, axis2=3) - 1))

    def _by_name(self, values: np.ndarray) -> dict[str, float]:
        return {name: float(value) for name, value in zip(self.names, values, strict=True)}


def save_trajectory(path: str | Path, trajectory: Trajectory, **meta: object) -> None:
    """Write a trajectory as .npz: names, sizes, times, poses, and what else is given (seed, version, command)."""
    from derender.atomic import atomic_path

    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            names=np.array(trajectory.names, dtype=str),
            sizes=trajectory.sizes,
            times=trajectory.times,
            poses=trajectory.poses,
            **{key: np.array(value) for key, value in meta.items()},
        )


STANDS, SETTLES, FALLS = "stands", "settles", "falls"
# A body bears another if it pushes it up: its contact's normal is within 60 degrees of the vertical.
UPWARDS = 0.5
# A body whose upper side has leant over by more than this has toppled.
TOPPLED = np.cos(np.deg2rad(45.0))


@dataclass(frozen=True)
class Verdict:
    """Whether a scene stands.

    verdict : "stands"; "settles": something moved and came to rest as the same structure, every body on what bore it
        before and the same side up; or "falls".
    """

    verdict: str
    first_moved: dict[str, float]  # when each body that did not stay left its place, seconds by name, the first first
    displacement: dict[str, float]  # the greatest distance from where it began, metres by name
    rotation: dict[str, float]  # the greatest angle, radians by name
    entered: tuple[Entered, ...]  # the pairs that enter each other so deep that no rigid bodies can be so

    @property
    def stable(self) -> bool:
        """Whether it stands."""
        return self.verdict == STANDS

    @property
    def fallen(self) -> tuple[str, ...]:
        """Names of the bodies that did not stay, the first to move first."""
        return tuple(self.first_moved)


def judge(trajectory: Trajectory, matter: Matter | None = None) -> Verdict:
    """Return whether the bodies stayed where they were, and how far each moved and turned.

    matter : the scene that was simulated; without it what has moved has fallen. What enters another so deep that no
        rigid bodies can be so has fallen from the start: that the engine lets it rest as it is tells nothing.
    """
    moved = trajectory.first_moved()
    word = STANDS
    entered = [] if matter is None else deep_overlaps(matter, find_contacts(matter))
    if entered:
        pairs = {name for pair in entered for name in (pair.first, pair.second)}
        moved = {name: 0.0 for name in trajectory.names if name in pairs} | moved
        word = FALLS
    elif moved:
        same = matter is not None and trajectory.resting and _same_structure(trajectory, matter)
        word = SETTLES if same else FALLS
    return Verdict(word, moved, trajectory.greatest_displacement(), trajectory.greatest_rotation(), tuple(entered))


def bearers(matter: Matter) -> dict[str, set[str]]:
    """Return by name which bodies each moving body rests on, across gaps of millimetres too."""
    contacts = find_contacts(matter, near=widest_gap(matter.unit))
    found: dict[str, set[str]] = {body.name: set() for body in matter.bodies if body.moves}
    rise = contacts.normal @ matter.up
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
    kinds = {body.name: body.kind for body in matter.bodies}
    for k, name in enumerate(trajectory.names):
        first, last = (trajectory.poses[step, k, :3, :3].T @ matter.up for step in (0, -1))
        if kinds[name] != "sphere" and first @ last < TOPPLED:
            return False
    before, after = bearers(matter), bearers(at_rest(trajectory, matter))
    return all(before[name] & after[name] for name in before)


# At rest: no corner of a body has moved by more than this share of the body's greatest extent L during the time below,
# in units of sqrt(L / g): at a thousandth of g, the least that tips a scene over, it moves by .008 L. Places and not
# speeds are compared, because contacts chatter, and what has come to rest on a lean creeps for ever, blocks of 75 x 25
# x 15 mm by up to .5 mm a second: by a quarter of this.
DRIFT, CALM_TIME = 8e-3, 4.0
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

    matter : the scene at the start. length : metres, its smallest extent.
    """

    def __init__(self, matter: Matter, length: float) -> None:
        moving = [body for body in matter.bodies if body.moves]
        self._up = matter.up
        self._sizes = np.array([body.size for body in moving], dtype=float).reshape(-1, 3)
        self._start = np.array([body.pose for body in moving], dtype=float).reshape(-1, 4, 4)
        longest = self._sizes.max(initial=length)
        self._calm = CALM_TIME * np.sqrt(self._sizes.max(axis=1) / matter.strength)
        heights = self._start[:, :3, 3] @ self._up
        tall = np.ptp(heights) + longest if moving else longest
        self._aftermath = AFTERMATH * np.sqrt(2 * tall / matter.strength)
        place = {body.name: k for k, body in enumerate(moving)}
        borne = bearers(matter)
        self._bearers = [[place.get(name, -1) for name in borne[body.name]] for body in moving]
        self._rolls = np.array([body.kind == "sphere" for body in moving], dtype=bool)
        self._lost_at = np.inf

    def at_rest(self, times: np.ndarray, poses: np.ndarray) -> bool:
        """Return whether nothing has moved lately. times : (T,) seconds; poses : (T, M, 4, 4) of what moves."""
        if np.any(times[-1] < self._calm):
            return False
        first = np.searchsorted(times, times[-1] - self._calm, side="right") - 1
        # at any time since, not at the first alone: what rocks on a shaken floor comes back to where it was
        since = np.arange(min(first, default=0), len(times) - 1)
        moved = np.linalg.norm(poses[-1, :, :3, 3] - poses[since, :, :3, 3], axis=-1)
        turned = np.linalg.norm(poses[-1, :, :3, :3] - poses[since, :, :3, :3], axis=(-1, -2)) / np.sqrt(2)
        calm = moved + 0.5 * np.linalg.norm(self._sizes, axis=1) * turned < DRIFT * self._sizes.max(axis=1)
        return bool(np.all(calm | (since[:, None] < first)))

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


# A contact is taken where it reproduces the pose to a millimetre and a fifth of a degree; slack takes up the rest.
OUTSIDE, ANGLE = 1e-3, np.deg2rad(0.2)
# Of several types that fit, a flatter one is taken unless it needs so much more slack (metres of gap and lean).
MORE_SLACK = 1e-3
# Slack below this (metres, radians) is the engine's own softness.
LEAST_SLACK = 1e-5
# Metres (or radians) below which a number of a contact is none.
ROUNDING = 1e-6


def settled_graph(graph: SceneGraph, trajectory: Trajectory, matter: Matter) -> SceneGraph:
    """Return the graph with the poses at the end of a trajectory, its contacts found anew, lower bodies first.

    A body keeps its parent where that still bears it, and otherwise hangs on the highest body that does, or on the
    root at the pose it has. Bodies that were removed are left out; those that were added are objects like others; and
    a floor that was tilted stays so.
    """
    end = at_rest(trajectory, matter)
    poses = {**graph.poses(), **{body.name: body.pose for body in end.bodies}}
    from_camera = inverse(np.asarray(graph.root_pose, dtype=float))
    on = bearers(end)
    there = {body.name for body in end.bodies}
    moving = {body.name for body in end.bodies if body.moves}
    still = [v for v in graph.vertices if v.name not in moving and (v.name in there or v.shape == "frame")]
    known = {vertex.name for vertex in graph.vertices}
    added = [vertex_of(body.name, body.kind, body.size) for body in end.bodies if body.name not in known]
    waiting = [v for v in (*graph.vertices, *added) if v.name in moving]
    waiting.sort(key=lambda vertex: float(poses[vertex.name][:3, 3] @ matter.up))
    placed = {vertex.name: vertex for vertex in still}
    for vertex in waiting:
        choices = [name for name in on[vertex.name] if name in placed]
        choices.sort(key=lambda name: (name != vertex.parent, -float(poses[name][:3, 3] @ matter.up)))
        new = replace(vertex, parent=ROOT, supports=(), contact=floating(from_camera @ poses[vertex.name]))
        for parent in choices:
            contact = _contact(inverse(poses[parent]) @ poses[vertex.name], placed[parent].body, vertex.body)
            if contact is not None:
                others = tuple(name for name in choices if name != parent)
                new = replace(vertex, parent=parent, supports=others, contact=contact)
                break
        placed[vertex.name] = new
    pull = from_camera[:3, :3] @ matter.gravity / STANDARD_GRAVITY
    tilted = not np.allclose(pull, graph.gravity, atol=ROUNDING)
    return replace(
        graph,
        vertices=tuple(_at_rest(vertex) for vertex in placed.values()),
        constraints=(),
        gravity=tuple(pull.tolist()) if tilted else graph.gravity,
    )


def _at_rest(vertex: Vertex) -> Vertex:
    """Return an object without speed, the rounding of its contact's numbers taken off: a file knows no 1e-15 m."""
    values = {key: 0.0 if abs(x) < ROUNDING else x for key, x in vertex.contact.values.items()}
    options = {key: value for key, value in vertex.options.items() if "velocity" not in key}
    return replace(vertex, options=options, contact=replace(vertex.contact, values=values))


def _contact(relative: np.ndarray, parent: Body, child: Body) -> Contact | None:
    """Return the flattest contact of two bodies that reproduces a relative pose, or None."""
    best: tuple[float, Contact] | None = None
    for kind in ON_A_FACE:
        try:
            contact, left = nearest_contact(relative, parent, child, kind)
        except DerenderError:
            continue
        if left.outside > OUTSIDE or left.angle > ANGLE:
            continue
        slack = sum(abs(value) for value in left.slack.values())
        if best is None or slack < best[0] - MORE_SLACK:
            values = {key: x for key, x in contact.values.items() if key not in left.slack or abs(x) > LEAST_SLACK}
            best = (slack, replace(contact, values=values))
    return None if best is None else best[1]
