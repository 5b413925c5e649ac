"""What was seen of moving bodies: poses over time with their errors, and the bodies themselves."""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from derender.dynamics.states import CHANGE, difference, from_poses, moved, to_poses
from derender.errors import DerenderError
from derender.physics.bodies import Body, Matter

# A body has moved where its centre left the first pose by this many of its own standard errors and metres, or it turned
# by this many radians: tracking wanders by a few millimetres and a degree or two about a body at rest.
MOVED_ERRORS = 6.0
MOVED_METRES = 0.01
MOVED_RADIANS = 0.12
# What something that moves comes this near to, metres, may have been struck, however little it moved: it moves too, and
# where it stands is as uncertain as tracking says.
STRUCK_WITHIN = 0.005
# Of two poses that are nearer than this (metres, and entries of the rotation), the second is the first one held: what
# rests has one pose, from which it may have moved and turned by as much as tracking does not tell from its jitter.
REPEATED, HELD_WITHIN, HELD_TURN = 1e-9, 0.001, 0.012
# Frames may be taken earlier or later than at even times by so much of a step: clocks of sensors are. Where all are
# nearer, their poses are taken as they are: at a metre a second and 30 frames that is a third of a millimetre.
UNEVEN, EXACT = 0.3, 0.01
# Seconds from frame to frame: in longer ones all that slides or falls has come to rest.
LONGEST = 1.0


class Motion(NamedTuple):
    """Tracked bodies of one film.

    matter : bodies (the moving ones with whatever pose; planes and fixed ones where they are), gravity in m / s^2 in
        the frame of the poses, and which bodies are joined at the start.
    covariances : (T, N, 6, 6) float64 of the centre (metres, in the frame of the poses) and of a rotation vector
        (radians, in the body's axes: R_true = R exp(phi)).
    """

    matter: Matter
    names: tuple[str, ...]  # N names of the bodies that moved, each one in `matter`
    times: np.ndarray  # (T,) float64, seconds, evenly spaced and rising
    poses: np.ndarray  # (T, N, 4, 4) float64, body to the frame of `matter`; NaN where a body was not seen; of balls
    # the axes are those of the frame
    covariances: np.ndarray
    # (T, N, 6, K) by which all poses of all frames are off together, in the same numbers: times K standard normal ones
    shared: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(T, N) bool, where there is a pose."""
        return np.isfinite(self.poses).all(axis=(2, 3))

    @property
    def held(self) -> np.ndarray:
        """(T, N) bool, where a pose is the one of the frame before, held while the body rests."""
        result = np.zeros(self.poses.shape[:2], bool)
        result[1:] = np.abs(np.diff(np.nan_to_num(self.poses, nan=1e9), axis=0)).max(axis=(2, 3)) < REPEATED
        return result & self.seen

    @property
    def fresh(self) -> np.ndarray:
        """(T, N) bool, where a pose tells something: not between two others of one rest.

        Tracking holds a pose some frames after a body has come to rest. In all frames of a rest outlines fall on the
        same pixels, and its pose is wrong by the same: by how little it jitters there, it errs not while a body moves.
        """
        held = self.held
        between, states = held.copy(), from_poses(np.where(self.seen[..., None, None], self.poses, np.eye(4)))
        for k, frame in zip(*np.nonzero((held[1:] & ~held[:-1]).T), strict=True):  # the first frame of a held pose
            far = np.abs(difference(states[frame, k], states[:frame, k]))
            near = (far[:, :3] < HELD_WITHIN).all(axis=1) & (far[:, 3:6] < HELD_TURN).all(axis=1)
            moves = np.flatnonzero(~(near & self.seen[:frame, k]))
            between[(moves[-1] + 2 if len(moves) else 1) : frame + 1, k] = True
        between[:-1] &= between[1:]
        between[-1] = False
        return self.seen & ~between

    @property
    def step(self) -> float:
        """Seconds between two frames."""
        return float(self.times[1] - self.times[0])

    def body(self, name: str) -> Body:
        """Return a body by name."""
        return next(body for body in self.matter.bodies if body.name == name)

    def parts(self) -> list["Motion"]:
        """Return the motions of bodies that never come near each other, each by itself: they may be of other stuff."""
        count = len(self.names)
        group = np.arange(count)
        for k, j in combinations(range(count), 2):
            both = np.flatnonzero(self.seen[:, k] & self.seen[:, j])
            first, second = self.body(self.names[k]), self.body(self.names[j])
            pairs = ((first._replace(pose=self.poses[t, k]), second._replace(pose=self.poses[t, j])) for t in both)
            if group[k] != group[j] and any(one.gap(other) < STRUCK_WITHIN for one, other in pairs):
                group[group == group[j]] = group[k]
        return [self._of(np.flatnonzero(group == each)) for each in dict.fromkeys(group.tolist())]

    def _of(self, chosen: np.ndarray) -> "Motion":
        """Return the motion of some of the bodies, by their numbers, as if the others were not there."""
        names = tuple(self.names[k] for k in chosen)
        bodies = tuple(body for body in self.matter.bodies if body.name in names or body.name not in self.names)
        there = {body.name for body in bodies}
        matter = self.matter._replace(
            bodies=bodies, supports=tuple(pair for pair in self.matter.supports if set(pair) <= there)
        )
        arrays = (each[:, chosen] for each in (self.poses, self.covariances, self.shared))
        return Motion(matter, names, self.times, *arrays)


def motion_of(
    matter: Matter,
    names: tuple[str, ...],
    times: np.ndarray,
    poses: np.ndarray,
    covariances: np.ndarray,
    shared: np.ndarray | None = None,
) -> Motion:
    """Check tracked poses, and return those of the bodies that moved or may have been struck by one that did.

    All others stand fixed where they were first seen.

    matter, names, times, poses, covariances, shared : as in `Motion`, of all tracked bodies; shared None: nothing.

    Raises DerenderError : for fewer than three frames, times that do not rise evenly, or a covariance that is none.
    """
    times = np.asarray(times, float)
    if len(times) < 3:
        raise DerenderError(f"{len(times)} frames tell no motion", remedy="give at least three")
    count = np.arange(len(times))
    step, first = np.polyfit(count, times, 1)
    late = times - (first + step * count)
    if not (np.diff(times) > 0).all() or np.abs(late).max() > UNEVEN * step:
        raise DerenderError("the frames' times do not rise evenly", remedy="give frames at a steady rate, in order")
    if step > LONGEST:
        raise DerenderError(f"frames {step:.3g} s apart show no motion", remedy="times are in seconds")
    seen = np.isfinite(poses).all(axis=(2, 3))
    poses, spread = np.array(poses), np.where(seen[..., None, None], covariances, np.eye(6))
    if np.abs(late).max() > EXACT * step:
        even, falls = first + step * count, float(np.linalg.norm(matter.gravity))
        poses, spread = _at(even, times, poses, spread, seen, falls)
        times = even
    kinds = {body.name: body.kind for body in matter.bodies}
    for k in (k for k, name in enumerate(names) if kinds[name] == "sphere"):  # nothing shows how it is turned
        poses[:, k, :3, :3] = np.where(seen[:, k, None, None], np.eye(3), np.nan)
        spread[:, k, 3:] = spread[:, k, :, 3:] = 0.0
        spread[:, k, 3:, 3:] = np.eye(3)
    if not np.isfinite(spread).all() or np.linalg.eigvalsh(spread).min() <= 0:
        raise DerenderError("a pose's covariance is not positive definite", remedy="track anew")
    moving = [k for k in range(len(names)) if seen[:, k].sum() > 2 and _moved(poses[:, k], spread[:, k], seen[:, k])]
    moving = sorted({*moving, *_struck(matter, names, poses, seen, moving)})
    bodies = []
    for body in matter.bodies:
        index = names.index(body.name) if body.name in names else None
        if index is None:
            bodies.append(body)
        elif index in moving:
            bodies.append(body._replace(pose=poses[np.argmax(seen[:, index]), index]))
        elif seen[:, index].any():
            bodies.append(body._replace(pose=poses[np.argmax(seen[:, index]), index], fixed=True))
    kept = {body.name for body in bodies}
    supports = tuple(pair for pair in matter.supports if set(pair) <= kept)
    return Motion(
        matter._replace(bodies=tuple(bodies), supports=supports),
        tuple(names[k] for k in moving),
        times,
        poses[:, moving],
        spread[:, moving],
        np.zeros((len(times), len(moving), 6, 0)) if shared is None else np.nan_to_num(shared[:, moving]),
    )


def _at(
    even: np.ndarray, times: np.ndarray, poses: np.ndarray, covariances: np.ndarray, seen: np.ndarray, falls: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return poses and covariances of frames that were taken at `times` (T,) as of even times (T,).

    A parabola through a frame and the two about it tells them, or a line where one of these is not seen. It is off by
    as much as velocities change between them: all at once by an impact, or without a neighbour as gravity `falls`.
    """
    states = from_poses(np.where(seen[..., None, None], poses, np.eye(4)))
    gaps, shift = np.diff(times)[:, None, None], (even - times)[:, None, None]
    speeds = difference(states[:-1], states[1:])[..., :6] / gaps  # (T - 1, N, 6)
    known = np.pad(seen[:-1] & seen[1:], ((1, 1), (0, 0)))[..., None]
    speeds, gaps = (
        np.where(known, np.pad(speeds, ((1, 1), (0, 0), (0, 0))), 0.0),
        np.pad(gaps, ((1, 1), (0, 0), (0, 0)), mode="edge"),
    )
    before, after = np.where(known[:-1], speeds[:-1], speeds[1:]), np.where(known[1:], speeds[1:], speeds[:-1])
    rests = (np.abs(before * gaps[:-1]).max(axis=2) < REPEATED) | (np.abs(after * gaps[1:]).max(axis=2) < REPEATED)
    shift = np.where(rests[..., None], 0.0, shift)
    both = gaps[:-1] + gaps[1:]
    change = np.zeros((*states.shape[:2], CHANGE))
    change[..., :6] = shift * (before * gaps[1:] + after * gaps[:-1] + (after - before) * shift) / both
    off = shift * np.where(known[:-1] & known[1:], after - before, falls * both / 2) / 2
    moving = to_poses(moved(states, change))
    return np.where(seen[..., None, None], moving, poses), covariances + off[..., None] * off[..., None, :]


def _struck(matter: Matter, names: tuple[str, ...], poses: np.ndarray, seen: np.ndarray, moving: list[int]) -> set[int]:
    """Return which bodies a moving one comes near, by their numbers in `names`."""
    bodies = {body.name: body for body in matter.bodies}
    found = set()
    for other in range(len(names)):
        if other in moving or not seen[:, other].any():
            continue
        stands = bodies[names[other]]._replace(pose=poses[np.argmax(seen[:, other]), other])
        frames = ((k, t) for k in moving for t in np.flatnonzero(seen[:, k]))
        if any(bodies[names[k]]._replace(pose=poses[t, k]).gap(stands) < STRUCK_WITHIN for k, t in frames):
            found.add(other)
    return found


def _moved(poses: np.ndarray, covariances: np.ndarray, seen: np.ndarray) -> bool:
    """Return whether a body left its first pose by more than errors explain."""
    states = from_poses(poses[seen])
    shift = np.linalg.norm(states[:, :3] - states[0, :3], axis=1)
    error = np.sqrt(np.trace(covariances[seen][:, :3, :3], axis1=1, axis2=2))
    turn = np.linalg.norm(difference(states[:1], states)[:, 3:6], axis=1)
    return bool(np.any(shift > np.maximum(MOVED_METRES, MOVED_ERRORS * error)) or np.any(turn > MOVED_RADIANS))
