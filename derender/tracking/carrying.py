"""How a hand moves from one frame to the next: what it holds moves with it, however little of that is seen.

The points that showed it are shifted until the next image has them where they are, and its outline where it ends: the
mean over shifts, each weighed by how well it does. Turns are left to the fit of what is held: from frame to frame they
are small.
"""

from typing import TYPE_CHECKING

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import greatest, least
from derender.compilation.cache import njit
from derender.scene.pose import inverse
from derender.tracking.reaching import OUTLINE, reaching

if TYPE_CHECKING:
    from derender.tracking.tracker import Tracker

NEAR = 0.12  # metres from a thing: of a hand and arm so much moves with it
FEWEST = 30  # points that tell of a motion
MOST = 80  # points by which coarse shifts are compared
RIM, BEHIND = 3, 0.02  # pixels beside the hand within which something lies so many metres behind it: it ends there
NOISE = 0.004  # metres: standard deviation of a point, of noise and of what half a pixel makes on a slanted surface
MOST_TOLD = 4.5  # nats: a point off by more than three standard deviations tells no more
UNSEEN = 1.0  # nats of a point that nothing returns from: as one that is nearly right, or all would leave the image
ENTERED = 0.01  # metres: a point beside the hand shows it where the image is nearer, or so little behind it
# Metres: spacing of the shifts that are tried, each time three to both sides, and begun again from the best few.
COARSE, FINER, BEGUN = 0.008, (0.004, 0.002, 0.001), 3
ALIKE = 15.0  # points that count as one: neighbours are off alike
LED = 5  # frames on end over which a hand may have moved what seemed to rest
STEPS = np.stack(np.meshgrid(*[np.arange(-3.0, 4.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@njit(cache=True, nogil=True)
def costs_of(shifts, points, beside, depth, lens, costs):
    """Write the nats (S,) by which shifts (S, 3) of points of a hand (P, 3) and beside it (R, 3) are off a depth image.

    depth : (H, W) metres. lens : fx, fy, cx, cy.
    """
    for s in range(shifts.shape[0]):
        total = 0.0
        for side in range(2):
            some = points if side == 0 else beside
            for p in range(some.shape[0]):
                z, seen = some[p, 2] + shifts[s, 2], 0.0
                if z > 0.0:
                    column = int(np.rint((some[p, 0] + shifts[s, 0]) / z * lens[0] + lens[2]))
                    row = int(np.rint((some[p, 1] + shifts[s, 1]) / z * lens[1] + lens[3]))
                    if 0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]:
                        seen = depth[row, column]
                if seen <= 0.0:
                    total += UNSEEN
                elif side == 0:
                    total += min(0.5 * ((seen - z) / NOISE) ** 2, MOST_TOLD)
                elif seen < z + ENTERED:
                    total += MOST_TOLD
        costs[s] = total


class Hand:
    """Points (P, 3) of a hand near a thing in one frame, and points (R, 3) just beside its outline, metres.

    depth : (H, W) metres. hand : (H, W) bool, what shows it. centre : (3,) of the thing, camera axes.
    """

    def __init__(self, depth: np.ndarray, hand: np.ndarray, centre: np.ndarray, camera: Camera) -> None:
        self.camera, rays = camera, camera.rays()
        mine = hand & (depth > 0) & (np.linalg.norm(rays * depth[..., None] - centre, axis=-1) < NEAR)
        rows, columns = np.nonzero(mine)
        near, beside = depth[mine], []
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            dark = np.ones(len(near), bool)  # so far nothing returned beside it
            for far in range(1, RIM + 1):
                i, j = rows + far * down, columns + far * right
                dark &= (i >= 0) & (i < depth.shape[0]) & (j >= 0) & (j < depth.shape[1])
                i, j = np.where(dark, i, 0), np.where(dark, j, 0)
                behind = dark & ~hand[i, j] & (depth[i, j] > near + BEHIND)
                beside.append(rays[i[behind], j[behind]] * near[behind, None])
                dark &= depth[i, j] == 0
        self.points, self.beside = rays[mine] * near[:, None], np.concatenate(beside)

    def shift(self, depth: np.ndarray, guess: np.ndarray) -> np.ndarray | None:
        """Return by how much (3,) it has moved in the next image (H, W), near a guess; None where that is not told."""
        if len(self.points) < FEWEST:
            return None
        few = [some[:: max(len(some) // MOST, 1)] for some in (self.points, self.beside)]
        tried = guess + COARSE * STEPS
        begun = tried[np.argsort(self._costs(tried, depth, *few))[:BEGUN]]
        tried = (begun[:, None] + FINER[0] * STEPS).reshape(-1, 3)
        shift = tried[np.argmin(self._costs(tried, depth, self.points, self.beside))]
        for step in FINER[1:]:
            tried = shift + step * STEPS
            costs = self._costs(tried, depth, self.points, self.beside)
            weights = np.exp((costs.min() - costs) / ALIKE)
            shift = weights @ tried / weights.sum()
        return shift

    def _costs(self, shifts: np.ndarray, depth: np.ndarray, points: np.ndarray, beside: np.ndarray) -> np.ndarray:
        costs, lens = np.empty(len(shifts)), np.array([self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy])
        costs_of(shifts, np.ascontiguousarray(points), np.ascontiguousarray(beside), depth, lens, costs)
        return costs

    def moved(self, shift: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Return (H, W) bool: the pixels that show it after a shift (3,), and OUTLINE about them."""
        columns, rows = np.rint(self.camera.project(self.points + shift)).astype(int).T
        inside, shown = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1]), np.zeros(shape, bool)
        shown[rows[inside], columns[inside]] = True
        return least(greatest(shown, OUTLINE + 1), 1)  # a shift leaves gaps of one pixel


class Hands:
    """The hands at a tracker's things: how each has moved since the last frame, and so where what it holds is."""

    def __init__(self, tracker: "Tracker") -> None:
        self.tracker = tracker
        self.seen: dict[int, Hand] = {}  # in the last frame, at each thing that it touches
        self.shifts: dict[int, np.ndarray] = {}  # (3,) since then, camera axes
        self.there: dict[int, np.ndarray] = {}  # (4, 4), to camera, of the thing
        self.ways: dict[int, list[np.ndarray]] = {}  # (3,) of what rests if it was carried over the last frames, world

    def keep(self) -> None:
        """Keep what the present frame shows, before the next one is seen."""
        tracker, first = self.tracker, self.tracker.planes
        some = [k for k, thing in enumerate(tracker.things) if tracker.hand.any() and thing.here and tracker.touched(k)]
        shown = reaching(tracker, 0) if some else tracker.hand
        self.seen = {k: Hand(tracker.observed, shown, tracker.poses[first + k, :3, 3], tracker.camera) for k in some}
        self.there = {k: tracker.view @ tracker.things[k].pose for k in some}

    def shifted(self) -> np.ndarray:
        """Find how they have moved to the frame that is seen now; return (H, W) bool, where they are by that."""
        image, guesses = self.tracker.observed, self.shifts
        found = {k: hand.shift(image, guesses.get(k, np.zeros(3))) for k, hand in self.seen.items()}
        self.shifts = {k: shift for k, shift in found.items() if shift is not None}
        shown = np.zeros(image.shape, bool)
        for k, shift in self.shifts.items():
            self.there[k][:3, 3] += shift
            shown |= self.seen[k].moved(shift, image.shape)
        return shown

    def carried(self, k: int) -> np.ndarray | None:
        """Return where a hand has brought thing k since the last frame, (4, 4) to the world; None where none is."""
        return inverse(self.tracker.view) @ self.there[k] if k in self.shifts else None

    def led(self, k: int, nats: float) -> np.ndarray | None:
        """Return where a hand has brought a resting thing, (4, 4) to the world, if that is so many nats likelier.

        A thing that is lifted has hardly moved in the first frame, and what little of it a hand leaves to be seen may
        show that only in a later one.
        """
        tracker, pose, there = self.tracker, self.tracker.things[k].pose, self.carried(k)
        if there is None:
            self.ways.pop(k, None)
            return None
        self.ways[k] = [*self.ways.get(k, [])[1 - LED :], there[:3, 3] - pose[:3, 3]]
        rested, poses = tracker.price(k), []
        for way in np.cumsum(self.ways[k][::-1], axis=0):
            poses.append(pose.copy())
            poses[-1][:3, 3] += way
        best = min(poses, key=lambda each: tracker.draw(k, each))
        tracker.draw(k, best)
        gain = rested - tracker.price(k)
        tracker.draw(k, pose)
        return best if gain > nats else None
