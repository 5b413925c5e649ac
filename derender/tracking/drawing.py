"""What is drawn of the things that are followed, how it compares with the present frame, and fits of one of them."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import greatest, least
from derender.render.blur import blur_taps
from derender.render.raycast.canvas import FACE_BITS
from derender.render.raycast.normal_equations import cost, new_misfit
from derender.scene.pose import inverse
from derender.scene.solids import PLANE
from derender.tracking import fit as fitting
from derender.tracking.reaching import OUTLINE, PRICE, PRICE_STILL, bare_noise, nearer, never_seen, reaching
from derender.tracking.thing import STILL, Start

BACKGROUND = 10.0  # metres, where nothing is drawn
LIMIT = 8.0  # nats: a pixel off by more than four standard deviations tells no more
LEAST_NOISE = 3e-4  # metres: no sensor is better
FEW = 20  # pixels: fewer tell nothing
ROUNDS, TOLERANCE = 8, 0.05  # sets of normal equations, and nats, of a fit
AFAR_ROUNDS = 6  # of one from afar, before
LOOSE = 0.025  # metres: noise while a thing is searched for; then outlines pull that are off by several pixels
MARGIN = 4  # pixels about a thing that its fit must explain too
USUAL = 0.4  # nats a pixel of a good fit, at least
EXCESS = (4.0, 0.03)  # standard deviations, and share, by which the cost may be above the usual one
USUAL_OFF = 0.003  # share of the pixels that are off in a good fit, at least
DEVIATION = 0.7  # nats: of one pixel's cost
OFF = 4.0  # standard deviations at which a pixel is off
MORE_THAN_BEFORE = 2.0  # times at once that the usual cost rises where no beginning led to a better one
LITTLE = 0.03  # metres: what a hand lifts at up to a metre a second comes no nearer than this in a frame
BESIDE, MOST_BESIDE = 6, 0.12  # pixels about a thing, and the share of its own that may be nearer there


class Drawing:
    """The floor and the things as they are drawn, and the frame that they are compared with.

    camera : Camera. start : thing.Start. things : what is followed. view : (4, 4), world to camera. planes : 1 or 0.
    kinds : (N,), poses : (N, 4, 4), sizes : (N, 3) of all solids, in camera axes; the floor first. counts : (N, 4).
    misfit : Misfit. clean : (H, W) metres, 0 where nothing returned; observed : the same, 0 where the backdrop is, too;
    spread : (H, W) metres. returned : (H, W) bool, where the first frame has a depth; beyond : where it has none from
    the border on. left_out : (H, W) metres, what it shows before what is drawn, inf elsewhere. hand : (H, W) bool, what
    reaches in from the border. backdrop : (H, W) depth of what lies behind and is no floor.
    rounds : sets of normal equations so far. usually_off : share of the pixels of the floor and of what rests.
    """

    def __init__(self, camera: Camera, start: Start, depth: np.ndarray, moving_camera: bool) -> None:
        self.camera, self.start, self.moving_camera = camera, start, moving_camera
        self.things, self.floor, self.view = list(start.things), start.floor, np.eye(4)
        self.backdrop: np.ndarray | None = None
        self.rounds, self.usually_off = 0, np.inf
        self.returned = np.isfinite(depth) & (depth > 0) & (not moving_camera)
        self.beyond = never_seen(depth) & (not moving_camera)
        self.allocate(depth)
        self.see(depth)
        cost(self.misfit, self.poses, self.sizes)
        self.left_out = np.where(
            self.returned & nearer(self, self.misfit.blurred, bare_noise(self)), self.observed, np.inf
        )

    def allocate(self, depth: np.ndarray) -> None:
        """Make arrays for the things there are, and draw them."""
        self.planes = 0 if self.floor is None else 1
        self.kinds = np.array([PLANE] * self.planes + [thing.kind for thing in self.things], np.int32)
        self.misfit = new_misfit(self.camera, depth, 1.0, self.kinds, 9, blur_taps(self.start.blur), BACKGROUND, LIMIT)
        self.poses = np.empty((len(self.kinds), 4, 4))
        self.sizes = np.zeros((len(self.kinds), 3))
        self.counts = np.zeros((len(self.kinds), 4))
        self.place()

    def place(self) -> None:
        """Put everything where the things and the view say."""
        if self.floor is not None:
            self.poses[0] = self.view @ self.floor
        for k, thing in enumerate(self.things):
            self.poses[self.planes + k] = self.view @ thing.pose
            self.sizes[self.planes + k] = thing.size
            if not thing.here:
                self.poses[self.planes + k, 2, 3] = -1.0  # behind the camera: not seen

    def see(self, depth: np.ndarray) -> None:
        """Compare what is drawn with another frame (H, W), metres, from now on."""
        clean = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)
        spread = np.empty(clean.shape)
        fitting.spread_of(clean, self.start.sigma, self.start.growth, LEAST_NOISE, spread)
        self.spread, self.clean, self.hand = spread, clean, np.zeros(clean.shape, bool)
        self.misfit.floor[:] = np.exp(-LIMIT)
        if self.backdrop is not None:
            same = (self.backdrop > 0) & (np.abs(clean - self.backdrop) < OFF * spread + 0.01)
            clean = np.where(same, 0.0, clean)
        self.observed = clean
        fitting.look(self.misfit, clean, spread)

    def take_hand(self, before: np.ndarray | None = None) -> None:
        """Find the hand in the present frame by what is drawn; its pixels tell less from now on.

        before : (H, W) bool, what has shown it in the frame before, too.
        """
        self.hand = reaching(self)
        if self.hand.any():
            self.misfit.floor[self.hand] = np.exp(-PRICE)
            if before is not None:
                self.misfit.floor[self.hand & before] = np.exp(-PRICE_STILL)
            fitting.look(self.misfit, self.observed, self.spread)

    def hand_inside(self) -> np.ndarray:
        """Return (H, W) bool: what shows a hand in the present frame as all is drawn now, but for its rim."""
        return least(reaching(self), 2 * OUTLINE) if self.hand.any() else self.hand

    @contextmanager
    def without_hand(self) -> Iterator[None]:
        """Compare what is drawn with the image but for the pixels that may show a hand."""
        if not self.hand.any():
            yield
            return
        fitting.look(self.misfit, np.where(self.hand, 0.0, self.observed), self.spread)
        try:
            yield
        finally:
            fitting.look(self.misfit, self.observed, self.spread)

    def owner(self) -> np.ndarray:
        """Return (H, W) the number of the solid that each pixel shows, -1 for none."""
        code = self.misfit.canvas.code
        return np.where(code < 0, -1, code >> FACE_BITS)

    def wrong_share(self, k: int) -> float:
        """Return the share of thing k's pixels that are off."""
        fitting.pixels_of(self.misfit, self.counts, OFF)
        seen = self.counts[self.planes + k]
        return float((seen[2] + seen[3]) / max(seen[1], 1.0))

    def take_as_usual(self, k: int, most: float | None = None) -> None:
        """Take how well thing k is explained now as how well it usually is; most : times by which that may rise."""
        thing = self.things[k]
        total, count, off = fitting.cost_about(self.misfit, self.planes + k, MARGIN)
        cost_now, off_now = max(total / max(count, 1.0), USUAL), max(off / max(count, 1.0), USUAL_OFF)
        if most is None:
            thing.usual_misfit, thing.usual_off, thing.usual_cost = self.wrong_share(k), off_now, cost_now
        else:
            thing.usual_off = max(thing.usual_off, min(off_now, most * thing.usual_off))
            thing.usual_cost = max(thing.usual_cost, min(cost_now, most * thing.usual_cost))

    def price(self, k: int) -> float:
        """Return the nats of the whole image and of thing k's growth."""
        return float(cost(self.misfit, self.poses, self.sizes)) / self.start.temper + self.growth(k)

    def excess(self, k: int) -> float:
        """Return by how many nats the cost about thing k is above its usual one."""
        total, count, _ = fitting.cost_about(self.misfit, self.planes + k, MARGIN)
        return float(total - self.things[k].usual_cost * count)

    def unexplained(self, k: int) -> bool:
        """Whether the cost about thing k, or the number of pixels there that are off, is above what it may be."""
        total, count, off = fitting.cost_about(self.misfit, self.planes + k, MARGIN)
        total += self.growth(k)
        usual, usually_off = self.things[k].usual_cost * count, self.things[k].usual_off * count
        dear = total > usual * (1 + EXCESS[1]) + EXCESS[0] * DEVIATION * np.sqrt(count)
        return bool(dear or off > usually_off + EXCESS[0] * np.sqrt(usually_off + 1.0))

    def growth(self, k: int) -> float:
        """Return the nats by which the size that thing k is drawn with is less probable than the one that is known."""
        thing = self.things[k]
        grown = (self.sizes[self.planes + k] - thing.size) @ thing.ties.T / thing.ties.sum(axis=1)
        return float(0.5 * grown @ np.linalg.solve(thing.covariance[6:, 6:], grown))

    def fit(
        self, k: int, expected: np.ndarray, information: np.ndarray, free: bool, rounds: int = ROUNDS
    ) -> tuple[float, np.ndarray]:
        """Fit thing k from where it is drawn; return (energy, curvature). free : whether its size may change."""
        thing, index = self.things[k], self.planes + k
        members = np.zeros(len(self.kinds), bool)
        members[index] = True
        ties = thing.ties if free else np.zeros((0, 3))
        count = 6 + len(ties)
        curvature = np.array(information[:count, :count])
        frame = self.poses[index].copy()
        energy, taken = fitting.fit(
            self.misfit, self.poses, self.sizes, members, frame, self.view @ expected, index, thing.size.copy(), ties,
            self.turned(information[:count, :count]), self.start.temper, rounds, TOLERANCE, curvature,
        )  # fmt: skip
        self.rounds += taken
        return energy, curvature

    def fit_view(self, resting: list[int], precision: np.ndarray) -> np.ndarray:
        """Fit the view to the floor and to things that rest, from where it is drawn, and draw all from there.

        precision : (6, 6), before the image, of a shift and a turn that follow the view. Returns that after it.
        """
        members = np.arange(len(self.kinds)) < self.planes
        members[self.planes + np.array(resting, int)] = True
        middle = np.eye(4)
        middle[:3, 3] = np.mean([self.things[k].pose[:3, 3] for k in resting], axis=0) if resting else [0.0, 0.0, 1.0]
        frame = self.view @ middle
        about = np.eye(6)  # a shift of the middle and a turn about it, as those of the camera's own place
        about[:3, 3:] = np.cross(np.eye(3), frame[:3, 3])
        information = about.T @ precision @ about
        curvature, begun = information.copy(), frame.copy()

        def fit() -> None:
            self.rounds += fitting.fit(
                self.misfit, self.poses, self.sizes, members, frame, begun, 0, np.zeros(3), np.zeros((0, 3)),
                information, self.start.temper, ROUNDS, TOLERANCE, curvature,
            )[1]  # fmt: skip

        fit()
        if self._off_more(members):  # outlines may be off by several pixels
            frame[:] = begun
            self.place()
            for loose in (True, False):
                self.loosen(loose)
                fit()
        self.view = frame @ inverse(middle)
        self.place()
        back = np.linalg.inv(about)
        return back.T @ curvature @ back

    def _take_off_as_usual(self) -> None:
        """Take the share of the pixels of the floor and of what rests that are off as the usual one, or near it."""
        rests = [True] * self.planes + [thing.state == STILL for thing in self.things]
        fitting.pixels_of(self.misfit, self.counts, OFF)
        share = float(self.counts[rests, 2:].sum() / max(self.counts[rests, 1].sum(), 1.0))
        self.usually_off = min(share, MORE_THAN_BEFORE * max(self.usually_off, USUAL_OFF))

    def _off_more(self, members: np.ndarray) -> bool:
        """Return whether more of the pixels of some solids (N,) are off than when the camera was found last."""
        fitting.pixels_of(self.misfit, self.counts, OFF)
        shown, off = self.counts[members, 1].sum(), self.counts[members, 2:].sum()
        usually = self.usually_off * shown
        return bool(off > usually + EXCESS[0] * np.sqrt(usually + 1.0))

    def turned(self, matrix: np.ndarray, back: bool = False) -> np.ndarray:
        """Return a (P, P) precision of world axes in camera axes, or the other way round."""
        if not self.moving_camera:
            return np.ascontiguousarray(matrix)
        turn = np.eye(len(matrix))
        turn[:3, :3] = turn[3:6, 3:6] = self.view[:3, :3].T if back else self.view[:3, :3]
        return np.ascontiguousarray(turn @ matrix @ turn.T)

    def draw(self, k: int, pose: np.ndarray) -> float:
        """Draw thing k at a pose in the world and return the whole cost."""
        self.poses[self.planes + k] = self.view @ pose
        self.sizes[self.planes + k] = self.things[k].size
        return float(cost(self.misfit, self.poses, self.sizes))

    def loosen(self, loose: bool) -> None:
        """Take the noise as large, or as it is."""
        fitting.look(self.misfit, self.observed, np.maximum(self.spread, LOOSE) if loose else self.spread)
        cost(self.misfit, self.poses, self.sizes)

    def fit_from_afar(self, k: int, start: np.ndarray, information: np.ndarray, free: bool = True) -> np.ndarray:
        """Fit thing k from where it is drawn, by its outline first; return the curvature."""
        self.loosen(True)
        self.fit(k, start, information, free=False, rounds=AFAR_ROUNDS)
        self.loosen(False)
        return self.fit(k, start, information, free=free)[1]

    def fit_beside_hand(self, k: int, start: np.ndarray, information: np.ndarray) -> np.ndarray:
        """Fit thing k from a pose in the world; return the curvature.

        By its outline first, but not at once where a hand is at it: it would take the hand's for its own.
        """
        self.draw(k, start)
        if self.touched(k):
            self.loosen(False)
            curvature = self.fit(k, start, information, free=True)[1]
            if not self.unexplained(k):
                return curvature
            self.draw(k, start)
        return self.fit_from_afar(k, start, information)

    def outside(self, k: int) -> bool:
        """Whether thing k is drawn outside the image."""
        centre = self.poses[self.planes + k, :3, 3]
        if centre[2] <= 0.0:
            return True
        column, row = self.camera.project(centre)
        return not (0 <= column < self.camera.width and 0 <= row < self.camera.height)

    def raised(self, k: int) -> float:
        """Return the share of thing k's pixels that show a hand, or the thing in it: nearer by less than LITTLE."""
        mine = self.owner() == self.planes + k
        by = (self.misfit.blurred - self.observed)[mine & self.hand & (self.observed > 0)]  # metres
        return float((by < LITTLE).sum() / max(int(mine.sum()), 1))

    def shown(self, k: int) -> float:
        """Return the share of thing k's pixels that no hand hides."""
        fitting.pixels_of(self.misfit, self.counts, OFF)
        return float(self.counts[self.planes + k, 1] / max(int((self.owner() == self.planes + k).sum()), 1))

    def touched(self, k: int) -> bool:
        """Whether what reaches in is at thing k: then its outline may be partly the hand's."""
        mine = self.owner() == self.planes + k
        return bool((greatest(mine, MARGIN) & self.hand).any())

    def left_behind(self, k: int) -> bool:
        """Whether many pixels beside thing k are nearer than anything drawn there."""
        rectangle = self.misfit.canvas.rectangle[self.planes + k]
        if rectangle[0] >= rectangle[1]:
            return True
        rows = slice(max(rectangle[2] - BESIDE, 0), rectangle[3] + BESIDE)
        columns = slice(max(rectangle[0] - BESIDE, 0), rectangle[1] + BESIDE)
        observed = self.observed[rows, columns]
        off = (observed > 0) & (self.misfit.blurred[rows, columns] - observed > 2 * OFF * self.spread[rows, columns])
        off &= ~self.hand[rows, columns]
        return int(off.sum()) > max(FEW, MOST_BESIDE * self.counts[self.planes + k, 1])
