"""Which passes over a film are made: forward, then all over again; and from another frame where that fails.

Things that stand flush or hide each other in the first frame may be told apart only later. Where a pass leaves frames
unexplained, another frame is inferred and followed both ways, and the pass that explains the film better is kept: by
the sum of its costs, under one noise for all.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from derender.tracking.drawing import DEVIATION
from derender.tracking.smoothing import Smoother
from derender.tracking.thing import LOST, Start
from derender.tracking.track import Recorder, Track

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

UNEXPLAINED = 5.0, 0.02  # standard deviations, and share, above the least cost of a frame: it is not explained
MOST_UNEXPLAINED = 1  # frames; noise and dropouts make so many
BETTER = 50.0  # nats by which another pass must be better in sum


@dataclass
class Passes:
    """Passes over a whole film."""

    frames: Any  # sequence of (H, W)
    camera: "Camera"
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
        return [t for t, frame in enumerate(self.frames) if np.any(np.isfinite(frame) & (frame > 0))]

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
        each = cost / np.maximum(pixels, 1.0)
        least = float(np.min(each))
        limit = least * (1 + UNEXPLAINED[1]) * pixels + UNEXPLAINED[0] * DEVIATION * np.sqrt(pixels)
        return int((cost > limit).sum()) <= MOST_UNEXPLAINED

    def track(self, times: np.ndarray, names: list[str]) -> Track:
        """Return the track of the film."""
        return self.forward.track(times, names, self.backward)
