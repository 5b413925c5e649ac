"""Where tracking shows impacts, and what the poses about them tell before any film of the engine.

A film of the engine begins anew after each impact: with which speed is told by parabolas through the tracked centres.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from derender.dynamics.engine import LEVER, STEADY
from derender.dynamics.motion import STRUCK_WITHIN, Motion
from derender.dynamics.states import difference, from_poses, moved, plane_under, to_poses

# A tracked velocity that changes by so many of its own standard errors, and by more than steady contacts change it,
# shows an impact.
JUMP = 4.0
# Frames that tell the velocity from which a start sets out.
FITTED = 4
# They show free flight where the squares of what it leaves of them sum to so many of tracking's variances: 1 in 100 of
# nine normal numbers.
FLIES = 21.7
# What rested has been struck where its centre is further off than this, metres: tracking wanders by half as much.
STRUCK = 0.004
# An impact that tells restitution changes a velocity by so much more than resting contacts do, m / s: less is a box
# that tilts onto its other edge.
BOUNCE = 0.3


class Blow(NamedTuple):
    """Two bodies that may have pushed each other between a frame and the one before."""

    frame: int
    first: int
    second: int
    begins: bool  # whether one of them rested until then


class Impacts:
    """Tracked poses of one film, cut at impacts.

    motion : the film, of `frames` frames and `count` bodies. seen : (T, N) bool, where a pose tells something.
    rested : (N,) int, for how many frames after the first one tracking holds a body's pose: it rests, or nearly so.
    held : (T, N) bool, where it holds one, the first frame of the film included.
    tracked : (T, N, 13), states at rest at the tracked poses. filled : interpolated where a body was not seen.
    spread : (T, N, 6, 6), covariances of the tracked poses. floors : (4, 4) poses of planes.
    is_cut : (T, N) bool, the first frame and the first one after each impact; cuts : their (frame, body).
    blows : the cuts at which two bodies may have pushed each other.
    partner : (N,) int, the first body with which each one is connected by blows of two that came from apart, or itself.
        Those tell masses. What touches from the start, as in a stack, is pushed and held all the time: how it rocks is
        the engine's chaos, and a film of other masses that begins a little differently fits as well.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion, self.gravity = motion, np.asarray(motion.matter.gravity, float)
        self.count, self.frames = len(motion.names), len(motion.times)
        self.seen, self.held = motion.fresh.copy(), motion.held.copy()
        self.rested = np.cumprod(self.held[1:], axis=0).sum(axis=0)
        self.held[0] = self.rested > 0
        self.bodies = [motion.body(name) for name in motion.names]
        self.sizes = np.array([float(np.mean(body.size)) for body in self.bodies])
        known = motion.seen[..., None, None]
        self.tracked = from_poses(np.where(known, motion.poses, np.eye(4)))
        self.spread = np.where(known, motion.covariances, np.eye(6))
        self.filled = self._filled()
        self.floors = [body.pose for body in motion.matter.bodies if body.kind == "plane"]
        self.is_cut = self._cuts()
        self.blows = self._blows()
        # One pose alone after an impact tells no speed, and no film without it should have to explain it.
        self.seen[-1] &= ~self.is_cut[-1] | self.is_cut[-2]
        self.is_cut[-1] = False
        self.partner = np.arange(self.count)
        for _, k, j, _ in self.blows:
            if self._gap(0, k, j) > STRUCK_WITHIN:
                both = self.partner[[k, j]]
                self.partner[np.isin(self.partner, both)] = both.min()
        self.cuts = [(int(frame), int(k)) for frame, k in np.argwhere(self.is_cut)]

    def _cuts(self) -> np.ndarray:
        """Return (T, N) bool: the first tracked frame after an impact, and the first frame of all."""
        step, gravity = self.motion.step, self.gravity
        states = self.filled
        change = np.diff(difference(states[:-1], states[1:])[..., :6], axis=0) / step  # (T - 2, N, 6)
        linear = np.linalg.norm(change[..., :3] - gravity * step, axis=-1)
        turning = np.linalg.norm(change[..., 3:], axis=-1)
        variance = np.diagonal(self.spread, axis1=2, axis2=3)
        error = np.sqrt(variance[:-2] + 4 * variance[1:-1] + variance[2:]) / step
        limit = STEADY * float(np.linalg.norm(gravity)) * step
        jumps = (linear > np.maximum(limit, JUMP * error[..., :3].max(axis=-1))) | (
            turning > np.maximum(LEVER * limit / self.sizes, JUMP * error[..., 3:].max(axis=-1))
        )
        seen = self.motion.seen
        jumps &= seen[:-2] & seen[1:-1] & seen[2:]
        result = np.zeros((self.frames, self.count), bool)
        # A kink shows in the second differences about the frames before and after it, or, near a frame, in that about
        # it alone: the frame after the last of these is after the kink in any case.
        result[2:] = jumps
        result[2:-1] &= ~jumps[1:]
        # What rested and is struck shows when: whatever else moves may be what struck it. If it is slow, its pose
        # is let go by tracking some frames before it is that far.
        gone = np.argmax(np.linalg.norm(states[..., :3] - states[0, :, :3], axis=-1) > STRUCK, axis=0)
        for begun in np.where(self.rested, np.minimum(gone, 1 + self.rested), gone) if self.count > 1 else ():
            if begun > 1:
                result[begun - 1 : begun + 3] = False
                result[begun] = True
        result[0] = True
        return result

    def _blows(self) -> list[Blow]:
        """Return where two bodies may have pushed each other; what lies on a floor is cut at each frame of that.

        After a blow they may stay together, or meet again, or rub along each other; and what is struck softly hardly
        moves, which shows no impact.
        """
        states, found = self.filled, list[Blow]()
        gone, goes_on = (np.linalg.norm(states[..., :3] - states[end, :, :3], axis=-1) > STRUCK for end in (0, -1))
        for frame in range(1, self.frames):
            last = frame == self.frames - 1
            met: set[int] = set()
            for k, j in combinations(range(self.count), 2):
                if met & {k, j} or not goes_on[frame - 1, [k, j]].any():
                    continue
                apart = np.diff(states[max(frame - FITTED, 0) : frame, [k, j], :3], axis=1)[:, 0]
                fast = float(np.linalg.norm(apart[-1] - apart[0])) / (max(len(apart) - 1, 1) * self.motion.step)
                gap = min(self._gap(frame - 1, k, j), self._gap(frame, k, j))
                struck = self.is_cut[frame, [k, j]].all() and gap < STRUCK_WITHIN + fast * self.motion.step
                lie = gap < STRUCK_WITHIN and all(self.plane_at(frame - last, body) is not None for body in (k, j))
                if last:
                    self.is_cut[frame, [k, j]] |= lie
                elif struck or lie:
                    found.append(Blow(frame, k, j, not gone[frame - 1, [k, j]].all()))
                    self.is_cut[frame, [k, j]] = True
                    met |= {k, j}
        return found

    def _gap(self, frame: int, k: int, j: int) -> float:
        """Return how far two bodies are apart in a frame, metres."""
        first, second = to_poses(self.filled[frame, [k, j]])
        return self.bodies[k]._replace(pose=first).gap(self.bodies[j]._replace(pose=second))

    def plane_at(self, frame: int, k: int) -> np.ndarray | None:
        """Return the floor (4, 4) on which body k lies at a cut, or None. What comes down on one may rock; what lay on
        it before a blow, too, is held to it."""
        return plane_under(self.bodies[k], self.floors, self.filled[max(frame - 1, 0) :, k])

    @property
    def rebounds(self) -> bool:
        """Whether tracking may show what an impact gives back: of a ball, or of what rises from one into the air.

        What stays where it lands rocks from corner to corner. How its films fit says how it will go on, but they fit by
        chance: of boxes that toppled .31 to .62, or 0 to .05, was told where .13 was true.
        """
        if any(body.kind == "sphere" for body in self.bodies):
            return True
        height = -self.filled[..., :3] @ self.gravity / max(float(np.linalg.norm(self.gravity)), 1e-9)
        fallen = np.maximum.accumulate(height) - height > STRUCK
        lowest = np.minimum.accumulate(np.where(fallen, height, np.inf))
        return any(self._flies(frame, k) for frame, k in np.argwhere(height > lowest + STRUCK))

    def _flies(self, frame: int, k: int) -> bool:
        """Return whether body k touches nothing in a frame."""
        body, names = self.bodies[k]._replace(pose=to_poses(self.filled[frame, k])), self.motion.names
        gaps = [body.gap(other) for other in self.motion.matter.bodies if other.name not in names]
        gaps += [self._gap(frame, k, j) for j in range(self.count) if j != k]
        return min(gaps, default=np.inf) > STRUCK_WITHIN

    def _filled(self) -> np.ndarray:
        """Return tracked states (T, N, 13) at rest, interpolated where a body was not seen."""
        times = self.motion.times
        states = self.tracked.copy()
        for k in range(self.count):
            known = np.flatnonzero(self.seen[:, k])
            for frame in np.flatnonzero(~self.seen[:, k]):
                after = np.searchsorted(known, frame)
                a, b = known[max(after - 1, 0)], known[min(after, len(known) - 1)]
                share = 0.0 if a == b else (times[frame] - times[a]) / (times[b] - times[a])
                states[frame, k] = moved(states[a, k], share * difference(states[a, k], states[b, k]))
        return states

    def first_speed(self, states: np.ndarray, frame: int, k: int) -> np.ndarray:
        """Return velocity and angular velocity (6,) of body k at a cut, from the frames that follow.

        What flies falls as gravity says, and two frames tell its speed: of the frames so many count as that explains.
        Where it explains too few, a parabola does: a mean over frames would tell a slide's first speed too low, and so
        its friction. The frame before the next cut may be after the impact already: it is left out where there are
        others.
        """
        later = np.flatnonzero(self.is_cut[frame + 1 :, k])
        count = min(FITTED, len(states) - frame)
        if len(later):
            count = min(count, max(int(later[0]), 2))
        if count < 2 or (frame == 0 and self.rested[k]):
            return np.zeros(6)
        time = self.motion.step * np.arange(count)
        way = difference(states[frame, k], states[frame : frame + count, k])[:, :6]
        fall = 0.5 * np.outer(time**2, np.concatenate([self.gravity, np.zeros(3)]))
        error = np.sqrt(np.diagonal(self.spread[frame : frame + count, k], axis1=1, axis2=2)[:, :3].mean())
        least = 2 if count == 2 or self._flies(frame, k) else 3
        for flown in range(count, least - 1, -1):  # the last of them may be after an impact that is no cut
            speed = time[:flown] @ (way - fall)[:flown] / (time[:flown] @ time[:flown])
            off = (way - fall - np.outer(time, speed))[:flown, :3]
            if flown == 2 or np.sum(off**2) < FLIES * error**2:
                return speed
        return np.linalg.lstsq(np.stack([time, time**2], axis=1), way, rcond=None)[0][0]
