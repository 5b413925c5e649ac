"""A filter over the poses of things: one frame at a time, only what moves is moved.

In each frame the camera is found first where it may move (by the floor and by all that rests), then everything that
moved before from where it is expected, and last what rested, if a test of its own pixels says that it does so no more.
A fit begins at that of several predictions (constant velocity or acceleration, free fall, a bounce, a standstill) which
explains the image best; where its pixels are not explained from there, others are tried, and wherever the image shows
something that nothing explains.
"""

from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.render.raycast.normal_equations import cost
from derender.scene.pose import from_rotation_vector, inverse, moved, rotation_vector
from derender.scene.solids import BOX
from derender.tracking import fit as fitting
from derender.tracking.carrying import Hands
from derender.tracking.drawing import FEW, MORE_THAN_BEFORE, OFF, TOLERANCE, Drawing
from derender.tracking.hidden import Blob, blobs_of, last_seen, one_frame_later, shifts_to
from derender.tracking.path import BAND, CAMERA_CHANGES, CAMERA_SPEED, change_between
from derender.tracking.thing import GONE, HIDDEN, LOST, MOVING, STILL, Seen, Start, Thing

WAKE = 25.0  # nats that moving a resting thing must gain: the noise of both frames does so once in 100,000 tests
RAISED = 0.5  # share of a thing's pixels: so many a little nearer, a hand may have taken it; so many are then seen
WOKEN = (0.0010, 0.012)  # metres and radians from where it rested from which on it moves
QUIET = (0.0008, 0.010)  # metres and radians between frames below which a moving thing is quiet
QUIET_DEVIATIONS = 3.0  # of its pose, within which it may besides jitter from frame to frame
QUIET_FRAMES = 3  # on end: then it rests
ROOM = (0.012, 0.12)  # metres and radians by which a moving thing may be off its prediction, and ...
ROOM_SHARE = 0.6  # ... of its last motion besides
# Metres and radians by which what a hand holds may be off where the hand's motion brings it: so well that motion is
# known, and a hand turns by as much from frame to frame.
HELD = (0.004, 0.04)
BIAS = 0.1  # pixels by which outlines may be off in one direction, frame after frame: sensors lose pixels there
WRONG = 0.15  # share of its pixels, beyond the usual one, that are off: then the fit is not believed
GIVEN_UP = 3  # frames on end for which a wrong fit is held before the thing is lost
SEARCHED = 3  # starts of a search from which a fit begins, those of least cost
GIVEN_BACK = 0.5  # share of the speed that a proposed bounce gives back

# Nats by which a box must be better explained that is turned by a quarter from one frame to the next. One of nearly
# equal sides that did not turn gains up to 60 so beside others; one that was taken wrongly from the first on hundreds.
TURNED = 100.0
WAKES = 5.0  # nats against a resting thing's beginning to move: once in some hundred frames
QUARTERS = [from_rotation_vector(0.5 * np.pi * axis) for axis in np.eye(3)]  # by which a box resembles itself
X, Y, Z = QUARTERS
TURNS = [a @ b for a in (np.eye(4), X, X @ X, X.T, Z, Z.T) for b in (np.eye(4), Y, Y @ Y, Y.T)]  # all 24 of those


class Viewpoint(NamedTuple):
    """Where the camera may be.

    view : (4, 4), world to camera. spread : (6, 6) covariance of its motion since the frame before.
    nats : against it, of the image, that motion and the resting things that wake if it is so. woken : these things.
    price : the part of the nats that is not of the image.
    """

    view: np.ndarray
    spread: np.ndarray
    nats: float
    woken: list[int]
    price: float


class Tracker(Drawing):
    """Follows things through frames.

    camera : Camera. start : thing.Start. depth : (H, W) metres, the first frame. gravity : (3,) m/s^2, camera axes.
    step : seconds between frames. moving_camera : whether the camera may move.
    """

    def __init__(
        self,
        camera: Camera,
        start: Start,
        depth: np.ndarray,
        gravity: np.ndarray,
        step: float,
        moving_camera: bool = False,
    ) -> None:
        super().__init__(camera, start, depth, moving_camera)
        self.gravity, self.step = np.asarray(gravity, float), float(step)
        self.drift = np.eye(4)  # the camera's last motion, and its covariance: (6, 6) of a shift and a turn, its axes
        self.hands = Hands(self)
        self.woken: list[int] = []  # resting things that have begun to move, where the camera moves
        self.price_of_motion = 0.0  # of the camera then, in nats, see Viewpoint
        self.drift_spread = np.diag(np.repeat(CAMERA_SPEED, 3) * step) ** 2
        self._refine_first()
        explained = np.abs(self.misfit.observed - self.misfit.blurred) < OFF * self.spread
        owner = self.owner()
        if not moving_camera:
            self.backdrop = np.where(~explained & (owner < self.planes) & (self.misfit.observed > 0),
                                     self.misfit.observed, 0.0)  # fmt: skip
            self.see(depth)
        for k in range(len(self.things)):
            self.take_as_usual(k)
        self._take_off_as_usual()

    # ---- one thing ------------------------------------------------------------------------------------------------

    def _refine_first(self) -> None:
        """Move each thing to where the smooth image is explained best; its spread stays that of the posterior, which
        knows this frame already."""
        for k, thing in enumerate(self.things):
            self.fit(k, thing.pose, np.linalg.inv(thing.covariance), free=True)
            thing.pose, thing.size = self.poses[self.planes + k].copy(), self.sizes[self.planes + k].copy()

    def _take(self, k: int, curvature: np.ndarray) -> None:
        """Make what is drawn of thing k its pose, size and covariance."""
        thing, index = self.things[k], self.planes + k
        thing.pose = inverse(self.view) @ self.poses[index]
        covariance = np.linalg.inv(self.turned(curvature, back=True) + 1e-6 * np.eye(len(curvature)))
        if len(covariance) < len(thing.covariance) or self.touched(k) or self.unexplained(k):  # tells no size
            thing.covariance[:6, :6] = covariance[:6, :6]
            thing.covariance[:6, 6:] = thing.covariance[6:, :6] = 0.0
            return
        thing.covariance = covariance
        least = self.bias(thing) ** 2
        for p in range(6, len(covariance)):
            covariance[p, p] = max(covariance[p, p], least)
        thing.size = self.sizes[index].copy()

    def bias(self, thing: Thing) -> float:
        """Return the metres at a thing's depth that outlines may be off by in all frames alike."""
        return BIAS * max(float((self.view @ thing.pose)[2, 3]), 0.0) / self.camera.fx

    def _expected(self, thing: Thing) -> np.ndarray:
        """Return where constant velocity leads a thing, (4, 4), or where it may be while nothing shows it."""
        if thing.hidden is not None:
            return thing.hidden.pose
        return moved(thing.pose, np.concatenate([thing.velocity, thing.spin]) * self.step)

    def _predictions(self, thing: Thing) -> list[np.ndarray]:
        """Return poses (4, 4) where a moving thing may be, the likeliest first: at constant velocity, without its spin,
        at constant acceleration, in free fall, thrown back by an impact, and standing still.
        """
        straight, step = self._expected(thing), self.step
        down = self.gravity / np.linalg.norm(self.gravity)
        shifts = (
            thing.acceleration * step**2,
            self.gravity * step**2,
            -(1 + GIVEN_BACK) * (thing.velocity @ down) * down * step,
            -thing.velocity * step,
        )
        predictions = [straight, straight.copy()]
        predictions[1][:3, :3] = thing.pose[:3, :3]
        for shift in shifts:
            predictions.append(straight.copy())
            predictions[-1][:3, 3] += shift
        predictions[-1][:3, :3] = thing.pose[:3, :3]
        return predictions

    def _ranked(self, k: int, poses: list[np.ndarray]) -> list[np.ndarray]:
        """Return poses (4, 4) of thing k in the world by the cost of the image, the least first."""
        return sorted(poses, key=lambda pose: self.draw(k, pose))

    def _information(self, thing: Thing, held: bool = False) -> np.ndarray:
        """Return the precision (P, P) of a moving thing's pose before the image, and of its size.

        held : whether a hand's motion tells where it is.
        """
        information = np.zeros(thing.covariance.shape)
        moves = ROOM_SHARE * self.step * np.array([np.linalg.norm(thing.velocity), np.linalg.norm(thing.spin)])
        room, turn = HELD if held else ROOM + moves
        information[:6, :6] = np.diag([room**-2] * 3 + [turn**-2] * 3)
        information[6:, 6:] = np.linalg.inv(thing.covariance[6:, 6:])
        return information

    def _follow(self, k: int) -> None:
        """Find a moving thing in the present frame."""
        thing = self.things[k]
        before = thing.pose.copy()
        if thing.hidden is not None:
            thing.hidden = one_frame_later(thing.hidden, self, k)
        curvature = self._follow_hand(k)
        if curvature is None:
            curvature = self._follow_itself(k)
        is_wrong = self.wrong_share(k) > thing.usual_misfit + 2 * WRONG
        shown = self.counts[self.planes + k, 1]
        thing.waiting = thing.waiting + 1 if is_wrong and shown >= FEW else 0
        if thing.waiting >= GIVEN_UP:
            thing.state, thing.hidden = LOST, None
            self.place()
            cost(self.misfit, self.poses, self.sizes)
            return
        if shown < FEW or (is_wrong and thing.hidden is not None):
            thing.state = GONE if self.outside(k) else HIDDEN
            if thing.hidden is None:
                thing.hidden = one_frame_later(last_seen(self, k), self, k)
            thing.pose = thing.hidden.pose
            thing.covariance[:6, :6] = thing.hidden.covariance()
            self.draw(k, thing.pose)
            return
        if thing.hidden is not None:
            way = rotation_between(thing.hidden.pose, thing.hidden.before)
            before = moved(inverse(self.view) @ self.poses[self.planes + k],
                           np.concatenate([thing.hidden.before[:3, 3] - thing.hidden.pose[:3, 3], way]))  # fmt: skip
            thing.hidden = None
        self._take(k, curvature)
        self._moved(thing, before)

    def _follow_hand(self, k: int) -> np.ndarray | None:
        """Fit a moving thing to where a hand has brought it; return the curvature, or None where it is not there."""
        thing = self.things[k]
        there = self.hands.carried(k) if thing.state == MOVING else None
        if there is None:
            return None
        self.draw(k, there)
        _, curvature = self.fit(k, there, self._information(thing, held=True), free=True)
        return None if self.unexplained(k) else curvature

    def _follow_itself(self, k: int) -> np.ndarray:
        """Fit a moving thing to where its own motion leads it, or to where else it may be; return the curvature."""
        thing = self.things[k]
        expected, information = self._expected(thing), self._information(thing)
        self.draw(k, expected)
        if thing.state == MOVING and (self.touched(k) or self.unexplained(k)):
            expected = self._ranked(k, self._predictions(thing))[0]
            self.draw(k, expected)
        _, curvature = self.fit(k, expected, information, free=True)
        if self.unexplained(k) or self.left_behind(k):
            curvature = self._search(k, expected, information, curvature)
            if self.unexplained(k):
                self.take_as_usual(k, MORE_THAN_BEFORE)
        return curvature

    def _moved(self, thing: Thing, before: np.ndarray) -> None:
        """Take the thing's motion since the last frame as its velocity; let it rest when it is quiet."""
        shift = thing.pose[:3, 3] - before[:3, 3]
        turn = rotation_between(before, thing.pose)
        if thing.state in (LOST, GONE):
            shift, turn = shift / (1 + thing.waiting), turn / (1 + thing.waiting)
        thing.acceleration = (shift / self.step - thing.velocity) / self.step
        thing.velocity, thing.spin = shift / self.step, turn / self.step
        if thing.type == "sphere":
            thing.spin = np.zeros(3)
        thing.quiet = thing.quiet + 1 if is_quiet(np.concatenate([shift, turn]), thing.covariance) else 0
        thing.state = MOVING
        if thing.quiet >= QUIET_FRAMES:
            thing.state = STILL
            thing.velocity, thing.spin = np.zeros(3), np.zeros(3)

    def _search(self, k: int, expected: np.ndarray, information: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """Fit thing k from other beginnings; leave it drawn where the cost is least, and return its curvature there."""
        thing, index = self.things[k], self.planes + k
        wide = information.copy()
        wide[:6, :6] /= 9.0
        best = self.price(k)
        kept = self.poses[index].copy(), self.sizes[index].copy(), curvature
        owner, here = self.owner() == index, self.poses[index].copy()
        quarters = [inverse(self.view) @ here @ turn for turn in QUARTERS]
        starts = [inverse(self.view) @ here, expected, *self._predictions(thing)]
        starts += [inverse(self.view) @ pose for pose in shifts_to(self, blobs_of(self), owner, here)]
        self.loosen(True)
        ranked = [(start, TOLERANCE) for start in self._ranked(k, starts)[:SEARCHED]]
        for start, gain in [*ranked, *((start, TURNED) for start in quarters)]:
            value, found = self._tried(k, start, expected, wide)
            if value < best - gain:
                best, kept = value, found
                if not self.unexplained(k):
                    break
        self._put(k, kept)
        return kept[2]

    def _tried(self, k: int, start: np.ndarray, expected: np.ndarray, information: np.ndarray) -> tuple[float, tuple]:
        """Fit thing k from a pose in the world; return its price, and (pose, size, curvature) where it is drawn then.

        A box may roll by a quarter on its way to where it slid: it is as it is expected unless that is TURNED worse.
        """
        index, curvature = self.planes + k, self.fit_beside_hand(k, start, information)
        value, found = self.price(k), (self.poses[index].copy(), self.sizes[index].copy(), curvature)
        if self.things[k].kind != BOX:
            return value, found
        pose = inverse(self.view) @ found[0]
        turn = max(TURNS, key=lambda turn: float(np.trace(expected[:3, :3].T @ (pose @ turn)[:3, :3])))
        if np.trace(turn) < 4:
            self.draw(k, pose @ turn)
            curvature = self.fit_from_afar(k, pose @ turn, information)
            if self.price(k) < value + TURNED:
                return self.price(k), (self.poses[index].copy(), self.sizes[index].copy(), curvature)
            self._put(k, found)
        return value, found

    def _put(self, k: int, found: tuple) -> None:
        """Draw thing k with a pose (to camera) and a size that were found."""
        self.poses[self.planes + k], self.sizes[self.planes + k] = found[:2]
        cost(self.misfit, self.poses, self.sizes)

    def _gain(self, k: int) -> float:
        """Return by how many nats the image is better explained where thing k moves, to second order."""
        members = np.arange(len(self.kinds)) == self.planes + k
        self.rounds += 1
        return fitting.score_of(
            self.misfit, self.poses, self.sizes, members, self.poses[self.planes + k], self.start.temper,
            np.zeros((6, 6)),
        )  # fmt: skip

    def _wake(self, k: int) -> None:
        """Test whether a resting thing moves; if so, follow it."""
        taken, led = self.raised(k) > RAISED, self.hands.led(k, WAKES)
        if self._gain(k) < WAKE and not self.unexplained(k) and not taken and led is None:
            return
        thing, index = self.things[k], self.planes + k
        fitting.pixels_of(self.misfit, self.counts, OFF)
        if self.counts[index, 1] < FEW and not taken:
            return
        before, kept, rested = thing.pose.copy(), self.poses[index].copy(), self.price(k)
        if led is not None:
            self.draw(k, led)
            _, curvature = self.fit(k, led, self._information(thing, held=True), free=False)
        else:
            curvature = self._tried(k, thing.pose, thing.pose, self._information(thing))[1][2]
            if self.unexplained(k):
                curvature = self._search(k, thing.pose, self._information(thing), curvature)
        if self.unexplained(k):
            self.take_as_usual(k, MORE_THAN_BEFORE)
        now = inverse(self.view) @ self.poses[index]
        shift, turn = np.linalg.norm(now[:3, 3] - before[:3, 3]), np.linalg.norm(rotation_between(before, now))
        stays = (shift < WOKEN[0] and turn < WOKEN[1]) or self.price(k) > rested or (taken and self.shown(k) < RAISED)
        if stays or self.wrong_share(k) > thing.usual_misfit + 2 * WRONG:
            self._put(k, (kept, thing.size))
            return
        self._take(k, curvature)
        thing.quiet = 0
        self._moved(thing, before)

    # ---- one frame ------------------------------------------------------------------------------------------------

    def _find_camera(self) -> None:
        """Find where the camera is by the floor and by what rests: as its path is smooth and things seldom wake."""
        still = [k for k, thing in enumerate(self.things) if thing.state == STILL]
        best = self._camera_by(still)
        if best.woken:
            tried = [self._camera_by(some) for some in ([], *([k] for k in still))]
            best = min([best, *tried], key=lambda each: each.nats)
            calm = [k for k in still if k not in best.woken]
            best = min([best, self._camera_by(calm)], key=lambda each: each.nats)
        self.drift, self.drift_spread = best.view @ inverse(self.view), best.spread
        self.view, self.woken, self.price_of_motion = best.view, best.woken, best.price
        self.place()
        cost(self.misfit, self.poses, self.sizes)
        self._take_off_as_usual()

    def _camera_by(self, resting: list[int]) -> "Viewpoint":
        """Return where the camera is by the floor, its own last motion and these things, which rest."""
        kept, self.view = self.view, self.drift @ self.view
        self.place()
        expected = self.view
        changes = np.diag(np.repeat(CAMERA_CHANGES, 3) * self.step**2) ** 2
        precision = np.linalg.inv(self.drift_spread + changes)
        curvature = self.fit_view(resting, precision)
        off = change_between(expected, self.view)
        image, price, woken = self._freed()
        price += 0.5 * float(off @ precision @ off) + narrowed(precision, curvature)
        view, self.view = self.view, kept
        return Viewpoint(view, np.linalg.inv(curvature), image + price, woken, price)

    def _freed(self) -> tuple[float, float, list[int]]:
        """Fit what moves, then what rests where the image says that it does so no more; return the nats of the image,
        those of these motions, and which things have woken."""
        total, woken = 0.0, []
        for k in sorted(range(len(self.things)), key=lambda k: self.things[k].state == STILL):
            nats = float(cost(self.misfit, self.poses, self.sizes)) / self.start.temper
            thing, found = self.things[k], (self.poses[self.planes + k].copy(), self.sizes[self.planes + k].copy())
            rests = thing.state == STILL
            if thing.state != MOVING and not (rests and (self._gain(k) > WAKES or self.unexplained(k))):
                continue
            there, room = self._expected(thing), self._information(thing)
            self.draw(k, there)
            if rests:
                curvature = self.fit_from_afar(k, there, room, free=False)
            else:
                _, curvature = self.fit(k, there, room, free=False)
            if self.unexplained(k):
                curvature = self._search(k, there, room, curvature)
            price = WAKES * rests + narrowed(room[:6, :6], curvature[:6, :6])
            if rests and float(cost(self.misfit, self.poses, self.sizes)) / self.start.temper + price > nats:
                self._put(k, found)
                continue
            total += price
            if rests:
                woken.append(k)
        return float(cost(self.misfit, self.poses, self.sizes)) / self.start.temper, total, woken

    def advance(self, depth: np.ndarray) -> Seen:
        """Follow everything into the next frame (H, W), metres, 0 or NaN where nothing returned."""
        self.rounds, self.hand_before = 0, self.hand_inside()
        self.hands.keep()
        self.see(depth)
        self.hand_before = self.hand_before | self.hands.shifted()
        if self.moving_camera:
            self._find_camera()
        self._follow_all()
        blobs = blobs_of(self)
        self._find_again(blobs)
        return self.report(blobs)

    def _follow_all(self) -> None:
        """Find everything that moves, the nearest first, and what has begun to move."""
        moving = [k for k, thing in enumerate(self.things) if thing.state in (MOVING, HIDDEN) and thing.here]
        for k in moving:
            self.draw(k, self._expected(self.things[k]))
        self.take_hand(self.hand_before)
        for k in sorted(moving, key=lambda k: self.poses[self.planes + k, 2, 3]):
            self._follow(k)
        cost(self.misfit, self.poses, self.sizes)
        resting = [k for k, thing in enumerate(self.things) if thing.state == STILL]
        if self.moving_camera:  # which of them wake is known with where the camera is
            resting = [k for k in resting if k in self.woken]
        for k in sorted(resting, key=self.excess, reverse=True):  # what moved itself before what it uncovers
            self._wake(k)

    def _find_again(self, blobs: list[Blob]) -> None:
        """Look for lost and hidden things where nothing explains what is seen."""
        for k, thing in enumerate(self.things):
            if thing.state not in (LOST, GONE, HIDDEN) or not blobs:
                continue
            index = self.planes + k
            drawn = self.poses[index].copy()
            ways = [thing.pose] if thing.hidden is None else thing.hidden.now  # it has turned while nothing showed it
            starts = [each for way in ways for each in shifts_to(self, blobs, None, self.view @ way)]
            for start in self._ranked(k, [inverse(self.view) @ pose for pose in starts])[:SEARCHED]:
                before = thing.pose.copy()
                self.draw(k, start)
                loose = np.linalg.inv(thing.covariance)
                loose[:6] = loose[:, :6] = 0.0
                loose[:6, :6] = np.diag([0.05**-2] * 3 + [1.0] * 3)
                curvature = self.fit_from_afar(k, start, loose, free=False)
                if self.wrong_share(k) < thing.usual_misfit + WRONG and self.counts[index, 1] >= 2 * FEW:
                    self._take(k, curvature)
                    self._moved(thing, before)
                    thing.velocity, thing.spin, thing.waiting, thing.state = np.zeros(3), np.zeros(3), 0, MOVING
                    thing.hidden = None
                    break
            else:
                self.poses[index] = drawn
                cost(self.misfit, self.poses, self.sizes)

    def report(self, blobs: list[Blob]) -> Seen:
        """Return what is known of the present frame."""
        count = len(self.things)
        poses, covariances = np.full((count, 4, 4), np.nan), np.full((count, 6, 6), np.nan)
        for k, thing in enumerate(self.things):
            if thing.here:
                poses[k] = self.view @ thing.pose
                covariances[k] = self.turned(thing.covariance[:6, :6])
        fitting.pixels_of(self.misfit, self.counts, OFF)
        states = [thing.state for thing in self.things]
        with self.without_hand():
            total = float(cost(self.misfit, self.poses, self.sizes)) + self.price_of_motion * self.start.temper
        return Seen(
            poses, covariances, states, self.counts[self.planes :].copy(), self.view.copy(), np.zeros((BAND, 0)),
            self.rounds, blobs, total, int(np.count_nonzero((self.observed > 0) & ~self.hand)),
        )  # fmt: skip

    def add(self, thing: Thing, depth: np.ndarray) -> None:
        """Follow another thing from now on."""
        self.things.append(thing)
        self.allocate(depth)
        self.see(depth)
        cost(self.misfit, self.poses, self.sizes)
        self.take_hand()
        self.take_as_usual(len(self.things) - 1)


def rotation_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,), world axes, from one pose to another."""
    return rotation_vector(after[:3, :3] @ before[:3, :3].T)


def is_quiet(motion: np.ndarray, covariance: np.ndarray) -> bool:
    """Return whether a shift and a turn (6,) are no more than what rests jitters by; covariance : of its pose."""
    spread = QUIET_DEVIATIONS * np.sqrt(np.diag(covariance)[:6])
    shifted, turned = np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])
    return bool(shifted < max(QUIET[0], spread[:3].max()) and turned < max(QUIET[1], spread[3:].max()))


def narrowed(before: np.ndarray, after: np.ndarray) -> float:
    """Return the nats that a free motion costs: by how much its precision (6, 6) before the image grows with it."""
    return 0.5 * float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1])
