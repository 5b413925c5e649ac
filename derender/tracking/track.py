"""A film followed from its first frame to its last: the answer of tracking, and how it comes about."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.floor import frame_of
from derender.tracking.contact import parent_probabilities
from derender.tracking.drawing import OFF
from derender.tracking.steadiness import doubts_of_camera, floor_moves
from derender.tracking.thing import FOLLOWED, MOVING, NOT_FOLLOWED, STILL, Seen, Start, thing_of
from derender.tracking.tracker import Tracker

CUT = 0.5  # share of the pixels that fit nothing from which on a frame is of another scene
NEW_PIXELS = 60  # of a blob that may be a new thing
NEW_FRAMES = 2  # on end that it must be there
LOOKS = 6  # times at most that a film is searched for new things: each is an inference
ENTERING = (0.02, 0.1, 0.02)  # metres, radians, metres: how unsure a thing is that has just come in
SHARE = 0.5  # of a new solid's pixels that nothing else explains
ALONE = "{0} is alone: whether it or the camera moves along the floor is not told by the film; add a thing that rests"
FREE_FORM = f"something that has come in {NOT_FOLLOWED}"
UP = 9.81  # m/s^2 along the floor's normal where nobody gave gravity


@dataclass
class Track:
    """What tracking found. T frames, N things."""

    names: list[str]  # (N,)
    types: list[str]  # (N,)
    kinds: np.ndarray  # (N,) of scene.solids
    times: np.ndarray  # (T,) seconds
    frames: list[str]  # names of the frames
    sizes: np.ndarray  # (T, N, 3) metres, as known at each frame
    poses: np.ndarray  # (T, N, 4, 4) to camera, NaN where not there or lost
    covariances: np.ndarray  # (T, N, 6, 6) of centre and turn, camera axes
    states: list[list[str]]  # T lists of N: still, moving, hidden, lost or gone
    parent_probability: np.ndarray  # (T, N, 2 + N): nothing, the floor, each thing
    views: np.ndarray  # (T, 4, 4) first camera to this one
    view_factor: np.ndarray  # (BAND, 6 T) as `path.Views` has it; (BAND, 0) where the camera rests
    floor: np.ndarray | None  # (4, 4) to the first camera, or None
    gravity: np.ndarray  # (3,) m/s^2, first camera's axes
    rounds: np.ndarray  # (T,) sets of normal equations
    pixels: np.ndarray  # (T, N, 4), see fit.pixels_of
    notes: list[str] = field(default_factory=list)  # what was assumed, as sentences
    doubts: list[str] = field(default_factory=list)  # what speaks against it, as sentences
    cut: int | None = None  # the first frame that is not tracked, or None
    rate_spread: float = 0.0  # standard deviation of the frame rate's logarithm: 0 where somebody gave it
    level_spread: float = 0.0  # standard error of gravity's inclination to the floor, radians

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.doubts

    def parents(self) -> list[list[str | None]]:
        """Return T lists of N: what each thing most probably rests on; None in the air, in a hand or not there."""
        words = [None, "floor", *self.names]
        rows = []
        for chances in self.parent_probability:
            rows.append([words[int(np.argmax(c))] if np.isfinite(c).all() else None for c in chances])
        return rows

    def floors(self) -> np.ndarray:
        """Return (T, 4, 4) the floor in each frame; without one, a frame whose z axis points against gravity."""
        return self.views @ (self.floor if self.floor is not None else upright(self.gravity))


def upright(gravity: np.ndarray) -> np.ndarray:
    """Return a frame (4, 4) whose z axis points against gravity, far below everything."""
    return frame_of(-gravity / np.linalg.norm(gravity), -1000.0, np.zeros(3))


def new_name(kind: str, taken: set[str]) -> str:
    """Return a name for a thing of a kind that no other has."""
    return next(name for n in range(1, len(taken) + 2) if (name := f"{kind}_{n}") not in taken)


class Recorder:
    """Follows frame after frame and keeps what was found, so that a growing film can be told of at any time.

    depth : (H, W) the first frame. camera : Camera. start : thing.Start, what is there. gravity : (3,) or None.
    step : seconds between frames. moving_camera : whether the camera may move. infer : (depth) -> Posterior, for what
    comes in later, or None.
    """

    def __init__(
        self,
        depth: np.ndarray,
        camera: Camera,
        start: Start,
        gravity: Any,
        step: float,
        moving_camera: bool = False,
        infer: Any = None,
    ) -> None:
        self.notes: list[str] = []
        self.doubts = [f"where the film begins, {doubt}" for doubt in start.doubts]
        self.gravity = UP * start.down if gravity is None else np.asarray(gravity, float)
        if start.floor is not None and self.gravity @ start.floor[:3, 2] > 0:
            self.gravity = -self.gravity
            self.notes.append("gravity as given points up from the floor, as an accelerometer reads: taking it down")
        if moving_camera and len(start.things) == 1:
            self.doubts.append(ALONE.format(start.things[0].name))
        self.tracker = Tracker(camera, start, depth, self.gravity, step, moving_camera)
        self.seen: list[Seen] = [self.tracker.report([])]
        self.sizes = [np.array([thing.size for thing in self.tracker.things]).reshape(-1, 3)]
        self.infer, self.looks, self.waiting = infer, 0, 0
        self.cut: int | None = None
        self.floor_moved = False  # whether a frame shows the floor elsewhere than the first one

    def advance(self, depth: np.ndarray) -> bool:
        """Take the next frame; False where it shows another scene: nothing is followed into it."""
        if self.cut is not None:
            return False
        seen = self.tracker.advance(depth)
        if self._is_cut():
            self.cut = len(self.seen)
            self.doubts.append(
                f"frame {self.cut} shows another scene, or the camera was moved: what comes from there on is not "
                "tracked; split the film there, or give --moving-camera"
            )
            return False
        self.floor_moved = self.floor_moved or (not self.tracker.moving_camera and floor_moves(self.tracker))
        if self._newcomers(depth, seen):
            seen = self.tracker.report(seen.blobs)
        self.seen.append(seen)
        self.sizes.append(np.array([thing.size for thing in self.tracker.things]).reshape(-1, 3))
        return True

    def _is_cut(self) -> bool:
        """Whether most of the frame is explained by nothing."""
        tracker = self.tracker
        there = tracker.observed > 0
        off = np.abs(tracker.observed - tracker.misfit.blurred) > OFF * tracker.spread + 0.01
        floor = there & (tracker.owner() >= 0)
        return int(floor.sum()) > 0 and float(off[floor].mean()) > CUT

    def _newcomers(self, depth: np.ndarray, seen: Seen) -> bool:
        """Look for things that have come in where nothing explains what is seen; whether there was one."""
        big = [blob for blob in seen.blobs if blob.pixels >= NEW_PIXELS]
        self.waiting = self.waiting + 1 if big else 0
        if self.infer is None or self.waiting < NEW_FRAMES or self.looks >= LOOKS:
            return False
        self.looks, self.waiting = self.looks + 1, 0
        graph = self.infer(depth).best_graph()
        from derender.render.raycast.depth import render_depth

        _, label = render_depth(graph.solids(), self.tracker.camera)
        free = np.any([blob.mask for blob in big], axis=0)
        found = False
        for number, name in enumerate(graph.solid_names):
            mine = label == number
            if graph.vertex(name).shape == "plane" or int(mine.sum()) < NEW_PIXELS:
                continue
            if float(free[mine].mean()) < SHARE:
                continue
            if graph.vertex(name).shape not in FOLLOWED:
                if FREE_FORM not in self.doubts:
                    self.doubts.append(FREE_FORM)
                continue
            thing = thing_of(graph, [], name)
            thing.name = new_name(thing.type, {other.name for other in self.tracker.things})
            spread = np.repeat(ENTERING, [3, 3, len(thing.ties)])
            thing.covariance = np.diag(spread**2)
            thing.pose = np.linalg.inv(self.tracker.view) @ thing.pose
            thing.state = MOVING
            self.tracker.add(thing, depth)
            found = True
        return found

    def track(
        self, times: np.ndarray | None = None, frames: list[str] | None = None, before: "Recorder | None" = None
    ) -> Track:
        """Return what was found so far; before : what was found going backward from the same first frame."""
        tracker, things = self.tracker, list(self.tracker.things)
        own = len(things)
        late = [] if before is None else before.tracker.things[len(tracker.start.things) :]
        taken = {thing.name for thing in things}
        for thing in late:
            things.append(thing.copy(name=new_name(thing.type, taken)))
            taken.add(things[-1].name)
        shared = len(tracker.start.things)
        rows = [(frame, size, list(range(own))) for frame, size in zip(self.seen, self.sizes, strict=True)]
        if before is not None:
            columns = [*range(shared), *range(own, own + len(late))]
            back = zip(before.seen[:0:-1], before.sizes[:0:-1], strict=True)
            rows = [(frame, size, columns) for frame, size in back] + rows
        count, length = len(things), len(rows)
        poses, covariances = np.full((length, count, 4, 4), np.nan), np.full((length, count, 6, 6), np.nan)
        extents = np.tile(np.array([thing.size for thing in things]).reshape(-1, 3), (length, 1, 1))
        pixels, states = np.zeros((length, count, 4)), [["gone"] * count for _ in rows]
        for t, (frame, size, columns) in enumerate(rows):
            mine = columns[: len(frame.states)]
            poses[t, mine], covariances[t, mine] = frame.poses, frame.covariances
            extents[t, mine], pixels[t, mine] = size, frame.pixels
            for column, state in zip(mine, frame.states, strict=True):
                states[t][column] = state
        kinds, first = np.array([thing.kind for thing in things]), rows[0][0].view  # whose axes are the world's
        track = Track(
            [thing.name for thing in things], [thing.type for thing in things], kinds,
            np.arange(length) * tracker.step if times is None else np.asarray(times)[:length],
            list(frames or [])[:length], extents, poses, covariances, states, np.zeros(0),
            np.array([row[0].view for row in rows]) @ np.linalg.inv(first),
            np.concatenate([row[0].view_factor for row in rows], axis=1),
            None if tracker.floor is None else first @ tracker.floor,
            first[:3, :3] @ self.gravity,
            np.array([row[0].rounds for row in rows]), pixels, list(self.notes), list(self.doubts),
            self.cut,
        )  # fmt: skip
        resting = np.array([[state == STILL for state in row] for row in states]).reshape(length, count)
        if not tracker.moving_camera:
            track.doubts += doubts_of_camera(track, self.floor_moved or (before is not None and before.floor_moved))
        track.parent_probability = parent_probabilities(poses, covariances, extents, kinds, track.floors(), resting)
        return track
