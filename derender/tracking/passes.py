"""Which passes over a film are made: forward, then all over again; and from another frame where that fails.

Things that stand flush or hide each other in the first frame may be told apart only later. Where a pass leaves frames
unexplained, another frame is inferred and followed both ways, and the pass that explains the film better is kept: by
the sum of its costs, under one noise for all.

Once the end is known the film is gone through again: each pose is fitted from those beside it, and one size for each
thing. A filter knows only what came before. It holds what has begun to move for a frame too long, takes the nearest of
several places that explain an image, and learns sizes late. Here what moves somewhere in a film is fitted to each frame
again, from its own place there and from its places in the frames beside it; the likeliest is kept. What rests has one
pose, the mean over its frames. Sizes are those that all frames tell together with what was known before the film.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from derender.camera.intrinsics import Camera
from derender.render.raycast.normal_equations import cost
from derender.scene.pose import inverse, moved
from derender.tracking.contact import gaps_of
from derender.tracking.drawing import DEVIATION, ROUNDS
from derender.tracking.film import shows
from derender.tracking.fit import RIGID
from derender.tracking.path import change_between, smooth_path
from derender.tracking.thing import GONE, HIDDEN, LOST, MOVING, STILL, Start
from derender.tracking.track import Recorder, Track
from derender.tracking.tracker import is_quiet, rotation_between

UNEXPLAINED = 5.0, 0.02  # standard deviations, and share, above the least cost of a frame: it is not explained
MOST_UNEXPLAINED = 1  # frames; noise and dropouts make so many
BETTER = 50.0  # nats by which another pass must be better in sum


@dataclass
class Passes:
    """Passes over a whole film."""

    frames: Any  # sequence of (H, W)
    camera: Camera
    gravity: np.ndarray | None  # (3,)
    step: float  # seconds
    begin: Callable[..., Start]  # (depth) -> what one frame shows
    look: Any = None  # (depth) -> Posterior, of the best scene only, for what comes in later; or None
    moving_camera: bool = False
    progress: Any = None  # called after each frame with the share done, or None

    def best(self) -> "Pass":
        """Return the best pass, beginning with one from the first frame."""
        full = self.full()
        found = self.go(full[0], self.begin(self.frames[full[0]]))
        if self.moving_camera and found.cut is None and len(full) > 1:
            return self.anchored(found)
        if self.moving_camera or found.explained() or found.cut is not None:
            return found
        for anchor in (full[-1], full[len(full) // 2]):
            start = self.begun(anchor, found.start)
            if not start.things:
                continue
            other = self.go(anchor, start)
            other.forward.floor_moved = found.forward.floor_moved = found.floor_moved() or other.floor_moved()
            if other.cut is None and other.cost() < found.cost() - BETTER:
                found = other
            if found.explained():
                break
        return found

    def begun(self, anchor: int, noise: Start) -> Start:
        """Return what frame `anchor` shows, under the noise of another start."""
        start = self.begin(self.frames[anchor])
        return start._replace(sigma=noise.sigma, growth=noise.growth, blur=noise.blur, temper=noise.temper)

    def full(self) -> list[int]:
        """Return the numbers of the frames that the sensor did not drop."""
        return [t for t, frame in enumerate(self.frames) if shows(frame)]

    def anchored(self, found: "Pass") -> "Pass":
        """Return the pass, or one backward from the last frame if the film is likelier so.

        What slides as a film begins often rests as it ends, and once nothing rests no later frame tells where the
        camera is; each motion costs the nats of what it might have been as well.
        """
        reverse, last = copy(self), self.full()[-1]
        if self.gravity is not None:
            reverse.gravity = found.forward.seen[last - found.anchor].view[:3, :3] @ self.gravity
        other = reverse.go(last, self.begun(last, found.start))
        same = other.cut is None and len(other.start.things) == len(found.start.things)
        return other if same and other.cost() < found.cost() else found

    def go(self, anchor: int, start: Start) -> "Pass":
        """Follow what is there in frame `anchor` to the end of the film and to its beginning, then go over it again."""
        both = []
        for frames in (self.frames[anchor:], self.frames[anchor::-1] if anchor else []):
            if not len(frames):
                continue
            recorder = Recorder(frames[0], self.camera, start.copy(), self.gravity, self.step,
                                self.moving_camera, self.look)  # fmt: skip
            for n, frame in enumerate(frames[1:]):
                if not recorder.advance(frame):
                    break
                if self.progress:
                    self.progress((n + 1) / len(self.frames), f"frame {n + 1}")
            both.append(recorder)
        found = Pass(anchor, start, both[0], both[1] if anchor else None)
        Smoother(found, self.frames).smooth()
        return found


class Pass:
    """One pass over a film: from a frame, forward and, where that is not the first one, backward.

    anchor : the frame. start : what is there. forward, backward : Recorder, Recorder or None.
    cut : the frame of a cut, or None.
    """

    def __init__(self, anchor: int, start: Start, forward: Recorder, backward: Any) -> None:
        self.anchor, self.start, self.forward, self.backward = anchor, start, forward, backward
        self.cut = next(
            (anchor + way * r.cut for way, r in ((1, forward), (-1, backward)) if r and r.cut is not None), None
        )

    def rows(self) -> list[tuple[int, Recorder, int]]:
        """Return the frames in the order of time: (number, the recorder that has seen it, as its which frame)."""
        before, after = self.backward, range(len(self.forward.seen))
        back = [] if before is None else [(self.anchor - n, before, n) for n in range(len(before.seen) - 1, 0, -1)]
        return back + [(self.anchor + n, self.forward, n) for n in after]

    def floor_moved(self) -> bool:
        """Whether it shows the floor elsewhere than where it begins."""
        return any(recorder is not None and recorder.floor_moved for recorder in (self.forward, self.backward))

    def costs(self) -> np.ndarray:
        """Return the cost of each frame in nats, and its pixels, (2, T)."""
        seen = [recorder.seen[n] for _, recorder, n in self.rows()]
        return np.array([[frame.cost for frame in seen], [frame.valid for frame in seen]])

    def cost(self) -> float:
        """Return the sum of the costs."""
        return float(self.costs()[0].sum())

    def explained(self) -> bool:
        """Whether nothing is lost and no frame costs much more than the cheapest one."""
        for recorder in (self.forward, self.backward):
            if recorder and any(LOST in frame.states for frame in recorder.seen):
                return False
        cost, pixels = self.costs()
        least = float(np.min(cost[pixels > 0] / pixels[pixels > 0]))  # a frame without depth costs nothing
        limit = least * (1 + UNEXPLAINED[1]) * pixels + UNEXPLAINED[0] * DEVIATION * np.sqrt(pixels)
        return int((cost > limit).sum()) <= MOST_UNEXPLAINED

    def track(self, times: np.ndarray, names: list[str]) -> Track:
        """Return the track of the film."""
        return self.forward.track(times, names, self.backward)


SWEEPS = 2  # over all frames, there and back; sizes are learnt between them
ROOM = np.repeat([0.010, 0.10], 3)  # metres and radians: how far a fit is from where it begins
GROWTH = 0.003  # metres that a size changes by in one frame's fit
# A thing stands where its foot is within so many metres of the floor or another thing, and so level (cosine). How high
# it is no outline tells then: a foot that sinks changes no image, one that rises shows a gap, which noise now and then
# fits, and over a film heights became .5 to .9 mm too small. They are held, within so many metres.
FOOT, LEVEL, HELD = 0.003, 0.998, 1e-5
# Metres and radians: what rests on both sides of frames without depth, and is no further off, rested in them.
RESTS = 0.001
# Frames from a motion within which what is taken to rest tells nothing of the camera: it begins and stops by less than
# one frame shows, and the camera would follow it.
DOUBTED = 3


class Fit(NamedTuple):
    """What one frame says of a thing."""

    pose: np.ndarray  # (4, 4), world
    curvature: np.ndarray  # (6, 6), its precision
    spread: np.ndarray  # (6, 6), its covariance beside that of its size, camera axes
    told: np.ndarray  # (G, G), precision of the numbers of its size
    grown: np.ndarray  # (G,), that times by how much they should grow


class Smoother:
    """Goes through a film again that a pass has followed, and changes what its recorders have seen.

    frames : (T, H, W) or more. Of things that came in while going backward nothing is changed or drawn.
    """

    def __init__(self, found: Pass, frames: Any) -> None:
        self.tracker, self.rows, self.frames, self.anchor = found.forward.tracker, found.rows(), frames, found.anchor
        known = found.start.things
        self.known = [*known, *(thing.copy() for thing in self.tracker.things[len(known) :])]
        shape = len(self.rows), len(self.known)
        self.poses, self.states = np.full((*shape, 4, 4), np.nan), np.full(shape, GONE, object)
        for t, (_, recorder, n) in enumerate(self.rows):
            seen = recorder.seen[n]
            for k in range(len(seen.states) if recorder is found.forward else len(known)):
                if seen.states[k] in (STILL, MOVING):
                    self.poses[t, k], self.states[t, k] = inverse(seen.view) @ seen.poses[k], seen.states[k]
        self.movers = np.flatnonzero((self.states == MOVING).any(axis=0)).tolist()
        self.mended = len(self.rows) > 1 and (bool(self.movers) or self.tracker.moving_camera)
        self.before = [self._as_followed(t) for t in range(len(self.rows))] if self.mended else []

    def smooth(self) -> None:
        """Do all sweeps, and write what they find into the recorder's frames."""
        if not self.mended:
            return
        for number in range(SWEEPS):
            if self.tracker.moving_camera:
                self._find_views()
            order = range(len(self.rows))
            fits: list[dict[int, Fit]] = [{} for _ in order]
            for t in order[:: 1 - 2 * (number % 2)]:
                self._place(t)
                for k in self.movers:
                    if self.states[t, k] != GONE:
                        fits[t][k] = self._fit(t, k, number < SWEEPS - 1)
                        self.poses[t, k] = fits[t][k].pose
            for k in self.movers:
                mine = [frame.get(k) for frame in fits]
                self._rest(k, mine)
                if number < SWEEPS - 1:
                    self._grow(k, mine)
                else:
                    self._spread(k, mine)
        self._bridge()
        for t, (_, recorder, n) in enumerate(self.rows):
            change, seen = self._place(t) - self.before[t], recorder.seen[n]
            for k in np.flatnonzero(self.states[t] != GONE).tolist():
                seen.poses[k], seen.states[k] = seen.view @ self.poses[t, k], self.states[t, k]
                recorder.sizes[n][k] = self.tracker.things[k].size
            recorder.seen[n] = seen._replace(cost=seen.cost + change)

    def _bridge(self) -> None:
        """Lead things through frames without depth from where they were before to where they are after, as fast as they
        are on both sides: what falls or slides does so, and an impact leads off by a share of its change of speed, or
        of the way that these speeds leave over."""
        full = [t for t, (frame, *_) in enumerate(self.rows) if np.any(self.frames[frame] > 0)]
        for first, last in zip(full[:-1], full[1:], strict=True):
            count, there = last - first, (self.states[[first, last]] != GONE).all(axis=0)
            for k in np.flatnonzero(there).tolist() if count > 1 else ():
                way = way_between(self.poses[first, k], self.poses[last, k])
                speeds = [way / count, way / count]
                for n, (a, b) in enumerate(((first - 1, first), (last, last + 1))):
                    if {a, b} <= set(full) and GONE not in self.states[[a, b], k]:
                        speeds[n] = way_between(self.poses[a, k], self.poses[b, k])
                rests = bool((self.states[[first, last], k] == STILL).all() and np.abs(way).max() < RESTS)
                offs = np.array([(speeds[1] - speeds[0]) * count / 8, (way - count * (speeds[0] + speeds[1]) / 2) / 2])
                for t in range(first + 1, last):
                    s = (t - first) / count
                    speed = (s**3 - 2 * s**2 + s) * speeds[0] + (s**3 - s**2) * speeds[1]
                    self.poses[t, k] = moved(self.poses[first, k], (3 * s**2 - 2 * s**3) * way + count * speed)
                    self.states[t, k] = STILL if rests else HIDDEN
                    if not rests:
                        seen, known = (self.rows[at][1].seen[self.rows[at][2]] for at in (t, first))
                        turned = (offs.reshape(4, 3) @ seen.view[:3, :3].T).reshape(2, 6)
                        seen.covariances[k] = known.covariances[k] + turned.T @ turned

    def _find_views(self) -> None:
        """Find where the camera was in all frames; what moves stays where it was seen from there."""
        before, told, pulled = np.diag(ROOM**-2), [], []
        near = binary_dilation(self.states == MOVING, np.ones((2 * DOUBTED + 1, 1)))
        rests = (self.states == STILL) & ~near
        for t, (_, recorder, n) in enumerate(self.rows):
            self._place(t)
            precision = self.tracker.fit_view(np.flatnonzero(rests[t]).tolist(), before)
            told.append(precision - before)
            pulled.append(precision @ change_between(recorder.seen[n].view, self.tracker.view))
        views = np.array([recorder.seen[n].view for _, recorder, n in self.rows])
        anchor = next(i for i, (frame, *_) in enumerate(self.rows) if frame == self.anchor)
        found = smooth_path(views, np.array(told), np.array(pulled), anchor, self.tracker.step)
        for t, (_, recorder, n) in enumerate(self.rows):
            moving = self.states[t] == MOVING
            self.poses[t, moving] = inverse(found.views[t]) @ views[t] @ self.poses[t, moving]
            recorder.seen[n] = recorder.seen[n]._replace(
                view=found.views[t], view_factor=found.factor[:, 6 * t : 6 * t + 6]
            )

    def _as_followed(self, t: int) -> float:
        """Return the cost of frame t with the sizes that its recorder took things to have then."""
        _, recorder, n = self.rows[t]
        known = [thing.size for thing in self.tracker.things]
        for thing, size in zip(self.tracker.things, recorder.sizes[n], strict=False):
            thing.size = size
        value = self._place(t)
        for thing, size in zip(self.tracker.things, known, strict=True):
            thing.size = size
        return value

    def _place(self, t: int) -> float:
        """Draw frame t as it is known, compare it with its image, and return the cost."""
        tracker, (frame, recorder, n) = self.tracker, self.rows[t]
        tracker.view = recorder.seen[n].view
        for thing, pose, state in zip(tracker.things, self.poses[t], self.states[t], strict=True):
            thing.state = state
            if state != GONE:
                thing.pose = pose.copy()
        tracker.place()
        tracker.see(self.frames[frame])
        cost(tracker.misfit, tracker.poses, tracker.sizes)
        tracker.take_hand()
        with tracker.without_hand():
            return float(cost(tracker.misfit, tracker.poses, tracker.sizes))

    def _fit(self, t: int, k: int, grows: bool) -> Fit:
        """Fit thing k to frame t, which is drawn, from its place there and from the likeliest of those beside it; leave
        it drawn where it is likelier."""
        tracker, thing, index = self.tracker, self.tracker.things[k], self.tracker.planes + k
        count = len(thing.ties)
        stands = self._stands(t, k)
        information = np.diag(np.concatenate([ROOM, np.where(stands, HELD, GROWTH)]) ** -2)
        beside = [s for s in (t - 1, t + 1) if 0 <= s < len(self.rows) and self.states[s, k] != GONE]
        others = [self.poses[s, k] for s in beside if MOVING in (self.states[s, k], self.states[t, k])]
        if len(others) == 2:
            others.append(moved(others[0], 0.5 * way_between(*others)))
        found = []
        for start in (self.poses[t, k], *sorted(others, key=lambda pose: tracker.draw(k, pose))[:1]):
            tracker.draw(k, start)
            with tracker.without_hand():
                _, curvature = tracker.fit(k, start, information, free=False)
            found.append((tracker.price(k), tracker.poses[index].copy(), curvature))
        _, pose, curvature = min(found, key=lambda each: each[0])
        told, grown = np.zeros((count, count)), np.zeros(count)
        thing.pose = inverse(tracker.view) @ pose
        tracker.draw(k, thing.pose)
        grows = grows and not tracker.touched(k)  # else its outline may be partly the hand's
        with tracker.without_hand():
            _, whole = tracker.fit(k, thing.pose, information, free=True, rounds=ROUNDS if grows else 1)
        image = whole - information
        total = np.array(image)
        total[:RIGID, :RIGID] += information[:RIGID, :RIGID]
        total[RIGID:, RIGID:] += np.linalg.inv(thing.covariance[RIGID:, RIGID:])
        spread = np.linalg.inv(total)[:RIGID, :RIGID]
        if grows:
            across = image[RIGID:, :RIGID]
            told = image[RIGID:, RIGID:] - across @ np.linalg.solve(whole[:RIGID, :RIGID], across.T)
            step = (tracker.sizes[index] - thing.size) @ thing.ties.T / thing.ties.sum(axis=1)
            grown = (told + information[RIGID:, RIGID:]) @ step  # what it was held back by is no news
            told[stands], told[:, stands], grown[stands] = 0.0, 0.0, 0.0
        tracker.draw(k, thing.pose)
        return Fit(thing.pose, tracker.turned(curvature, back=True), spread, told, grown)

    def _stands(self, t: int, k: int) -> np.ndarray:
        """Return which of the numbers of thing k's size (G,) are its height alone, where it stands in frame t."""
        tracker, thing, pose = self.tracker, self.tracker.things[k], self.poses[t, k]
        if tracker.floor is None:
            return np.zeros(len(thing.ties), bool)
        sizes = np.array([each.size for each in tracker.things])
        kinds = np.array([each.kind for each in tracker.things])
        level = np.abs(tracker.floor[:3, 2] @ pose[:3, :3]) > LEVEL
        stands = gaps_of(self.poses[t], sizes, kinds, tracker.floor)[k].min() < FOOT
        return stands & (thing.ties @ ~level == 0.0)

    def _rest(self, k: int, fits: list[Fit | None]) -> None:
        """Give thing k one pose wherever it rests; the first and last frames of a rest that are off it move."""
        still = np.concatenate([[False], self.states[:, k] == STILL, [False]])
        for first, end in np.flatnonzero(np.diff(still)).reshape(-1, 2):
            while end > first:
                some = [fit for fit in fits[first:end] if fit is not None]
                total, about = sum(fit.curvature for fit in some), some[0].pose
                ways = [way_between(about, fit.pose) for fit in some]
                way = np.linalg.solve(total, sum(f.curvature @ w for f, w in zip(some, ways, strict=True)))
                off = [(float(np.linalg.norm(ways[i][:3] - way[:3])), i) for i in (0, -1)]
                worst = max(off)[1]
                quiet = is_quiet(ways[worst] - way, np.linalg.inv(some[worst].curvature))
                if quiet or len(some) < 2:
                    self.poses[first:end, k] = moved(about, way)
                    break
                self.states[first if worst == 0 else end - 1, k] = MOVING
                first, end = first + (worst == 0), end - (worst == -1)

    def _spread(self, k: int, fits: list[Fit | None]) -> None:
        """Give thing k the covariance of each frame's fit, and where it rests that of the middle one: outlines that
        fall on the same pixels are off alike in all frames of a rest."""
        spreads = {t: fit.spread for t, fit in enumerate(fits) if fit is not None}
        wide = {t: float(np.linalg.slogdet(spread)[1]) for t, spread in spreads.items()}
        still = self.states[:, k] == STILL
        for rest in np.split(np.arange(len(still)), np.flatnonzero(~(still[1:] & still[:-1])) + 1):
            known = sorted((t for t in rest if t in spreads), key=wide.__getitem__)  # all of one rest, or one frame
            for t in known:
                _, recorder, n = self.rows[t]
                recorder.seen[n].covariances[k] = spreads[known[len(known) // 2]]

    def _grow(self, k: int, fits: list[Fit | None]) -> None:
        """Give thing k the size that all frames and what was known before tell together.

        Outlines are off alike in all frames, and by as much again by where each falls between pixels: one along a row
        seemed to tell a hundred times what others do, and kept a size that was 4 mm off. Frames in which the thing
        rests, so that outlines fall on the same pixels, tell as much as one.
        """
        thing, known = self.tracker.things[k], self.known[k]
        ties, off = thing.ties / thing.ties.sum(axis=1, keepdims=True), self.tracker.bias(thing) ** 2
        told, grown = np.zeros((len(ties), len(ties))), np.zeros(len(ties))
        rests = max(int((self.states[:, k] == STILL).sum()), 1)
        for fit, state in zip(fits, self.states[:, k], strict=True):
            if fit is not None:
                share = (1.0 / rests if state == STILL else 1.0) * discount(fit.told, off)
                told, grown = told + share @ fit.told, grown + share @ fit.grown
        alike = discount(told, off)
        before = np.linalg.inv(known.covariance[RIGID:, RIGID:])
        change = alike @ grown + before @ (ties @ (known.size - thing.size))
        total = alike @ told + before
        thing.size = thing.size + np.linalg.solve(total, change) @ thing.ties
        thing.covariance[RIGID:, RIGID:] = np.linalg.inv(0.5 * (total + total.T))


def way_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the shift of the centre and the turn (6,), world axes, that lead from one pose (4, 4) to another."""
    return np.concatenate([second[:3, 3] - first[:3, 3], rotation_between(first, second)])


def discount(told: np.ndarray, variance: float) -> np.ndarray:
    """Return by what (G, G) a precision (G, G) is to be multiplied where each number is off by a variance besides."""
    return np.linalg.inv(np.eye(len(told)) + variance * told)
