"""Films of the engine against tracked poses: multiple shooting, with errors of the engine integrated out.

The engine runs from the first frame, and each body anew from each of its cuts: the first frame after an impact.
Unknown are the states at the cuts, a constant offset of each body's tracked centre, and the material's coordinates.
There are two kinds of residuals: tracked poses against the film, and states at cuts against those at which the engine
arrives there (Bock and Plitt 1984). Both allow for errors of the engine, which the film carries on as errors of
velocity while a body moves; so what happens before an impact tells little of what comes long after it. With the film
linear in the states, these integrate out: that is the marginal likelihood of the material.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import cho_solve, solve_triangular

from derender.compilation.threads import run_together
from derender.dynamics.engine import LATE, LEVER, SLIDING_RESTITUTION, Engine, Material, Scales, velocity_errors
from derender.dynamics.impacts import BOUNCE, STRUCK, Impacts
from derender.dynamics.motion import HELD_TURN, HELD_WITHIN, Motion
from derender.dynamics.parameters import Parameters
from derender.dynamics.states import CHANGE, FREE, FREE_BALL, difference, flush, moved, ways_of
from derender.scene.friction import MEDIAN

# Difference steps are fixed: relative ones vanish where a number is near zero, and narrow ones measure how a contact's
# corners rattle: a slide's end jumps by half a degree. Metres, radians, m / s, rad / s; and of the material's
# coordinates.
STEPS = np.repeat([2e-3, 0.04, 0.06, 0.4], 3)
COORDINATE_STEP = 0.06
COARSER = 4.0  # times the engine's own steps
# Of the 12 numbers of a defect: those that tell of changes along a plane, as `ways_of` orders them, and the others.
ALONG, HELD = [0, 1, 3, 6, 7, 9], [2, 4, 5, 8, 10, 11]
# Tracked centres may be off by a constant: a size or a floor that is wrong by so many metres.
OFFSET = 0.002
# Velocity at a cut before anything is seen of it: m / s, rad / s.
FIRST_SPEED, FIRST_SPIN = 5.0, 30.0
# No image shows a ball's spin: its surface is as fast as its centre where it rolls, and of one that a hand lets go or
# throws hardly faster; m / s at least.
BALL_SURFACE = 0.1
# A state at a cut may differ by so much from where the engine arrives beyond the engine's errors of velocity: metres,
# radians; the first tracked frame after an impact is up to a frame later than the impact.
LEAST_POSITION, LEAST_ROTATION = 2e-4, 2e-3
# A tracked pose whose squared error, in its standard errors, is beyond this (1 in 1000 of six normal numbers) was lost
# for a frame: it counts as if it erred by just so much.
LOST = 22.5
# Slower than this a body rests, m / s (rad / s by its size), and an error of its velocity is not carried on.
RESTS = 0.02
# What slides tells friction by how it is slowed over so many frames on end: in fewer, when it begins or stops is as
# unknown.
SLID = 3
# Where nothing moved by more than this from one frame to the next, and nothing is faster, all stays as it is: metres
# and m / s (turns by the size). What begins to slide at a hundredth of gravity is faster after one frame.
STAYS, STAYS_SPEED = 1e-5, 1e-3


class Path(NamedTuple):
    """A film of the engine."""

    states: np.ndarray  # (T, N, 13); at the cuts they are unknowns, elsewhere the engine's
    arrived: np.ndarray  # (T, N, 13), where the engine arrives from the frame before
    offsets: np.ndarray  # (N, 3), tracked centre minus true centre, metres
    coordinates: np.ndarray  # (P,), of the material


class Doubts(NamedTuple):
    """What of a film is believed less, or in part: learnt at a mode."""

    poses: np.ndarray  # (T, N), by how much each tracked pose's precision counts
    blows: np.ndarray  # (B,), by how much less two bodies changed each other's velocity than they may have


class Errors(NamedTuple):
    """Covariances of the residuals about a path."""

    factors: list[np.ndarray]  # N lower Cholesky factors (6 F, 6 F) of each body's covariance over its F tracked frames
    defects: np.ndarray  # (T, N, 12), variances of `Shooting.defects`
    log_determinant: float  # half the log determinant of all


class Shooting(Impacts):
    """Residuals of one film and their derivatives."""

    def __init__(self, motion: Motion, parameters: Parameters, engine: Engine) -> None:
        super().__init__(motion)
        self.parameters, self.engine, self._idle = parameters, engine, [engine]
        states = self.filled
        self.planes = [self.plane_at(frame, k) for frame, k in self.cuts]
        # Bodies that lie on a floor throughout meet in blows alone. What those do is told by what follows: films of
        # blows are chaotic, and jump with each start.
        self.apart = self.count > 1 and all(plane is not None for plane in self.planes)
        if self.apart:
            engine.part()
        self.ways = []
        for (frame, k), plane in zip(self.cuts, self.planes, strict=True):
            ways = FREE_BALL if self.bodies[k].kind == "sphere" else FREE
            if plane is not None:
                ways = ways_of(plane, flush(self.bodies[k], plane, states[frame, k])[0])
            self.ways.append(ways)
        held = [plane is not None and frame > 0 for plane, (frame, _) in zip(self.planes, self.cuts, strict=True)]
        self.flush = {cut: ways for cut, ways, yes in zip(self.cuts, self.ways, held, strict=True) if yes}
        self.speeds = [self._first_speeds(states, frame, k) for frame, k in self.cuts]
        ends = np.cumsum([0, *(ways.shape[1] for ways in self.ways)])
        self.parts = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]

    def _first_speeds(self, states: np.ndarray, frame: int, k: int) -> tuple[float, float]:
        """Return standard deviations of body k's velocity and angular velocity at a cut before anything is seen of it,
        m / s and rad / s. What rests in the first frame may be as slow as tracking does not tell from that."""
        if frame == 0 and self.rested[k]:
            seconds = int(self.rested[k]) * self.motion.step
            return HELD_WITHIN / seconds, HELD_TURN / seconds
        if frame > 0 or self.bodies[k].kind != "sphere":
            return FIRST_SPEED, FIRST_SPIN
        speed = np.linalg.norm(self.first_speed(states, frame, k)[:3])
        return FIRST_SPEED, float(2 * np.hypot(speed, BALL_SURFACE) / self.sizes[k])

    def coarser(self) -> "Shooting":
        """Return the same with films at steps so long that they tell where to climb, in a third of the time."""
        motion = self.motion
        return Shooting(motion, self.parameters, Engine(motion.matter, motion.names, motion.step, COARSER))

    @property
    def size(self) -> int:
        """Number of unknowns besides the material's: changes at the cuts, and offsets."""
        return self.parts[-1].stop + 3 * self.count

    @property
    def struck(self) -> bool:
        """Whether the engine may meet an impact: tracking shows one, something is in the air, or may strike another."""
        return self.count > 1 and not self.apart or any(plane is None for plane in self.planes)

    def first_path(self, coordinates: np.ndarray) -> Path:
        """Return a path whose states at the cuts are tracked, with velocities of the frames that follow."""
        states = self.filled.copy()
        offsets = np.zeros((self.count, 3))
        up = -self.engine.gravity / max(float(np.linalg.norm(self.engine.gravity)), 1e-9)
        for (frame, k), plane in zip(self.cuts, self.planes, strict=True):
            states[frame, k, 7:] = self.first_speed(states, frame, k)
            if plane is not None:
                states[frame, k] = flush(self.bodies[k], plane, states[frame, k])[0]
                if frame == 0:
                    offsets[k] = self.tracked[0, k, :3] - states[0, k, :3]
                continue
            raised = self.engine.overlaps(states[frame])[k]
            states[frame, k, :3] += raised * up
            if frame == 0:
                offsets[k] = -raised * up
        return self.rolled(Path(states, states, offsets, np.asarray(coordinates, float)))

    def rolled(self, path: Path, first: int = 0) -> Path:
        """Return the path that the engine runs from the states at the cuts, anew from frame `first`."""
        material = self.parameters.material(path.coordinates)
        if not self.struck:  # restitution and masses would only change how contacts with the floor rattle
            material = Material(material.friction, SLIDING_RESTITUTION, self.engine.masses)
        states, arrived = path.states.copy(), path.arrived.copy()
        rests, engine = False, self._idle.pop() if self._idle else self.engine.twin()  # each thread has one
        engine.tell(material)
        try:
            for frame in range(first + 1, self.frames):
                if rests and not self.is_cut[frame - 1].any():
                    arrived[frame] = states[frame - 1]
                else:
                    arrived[frame] = engine.advance(states[frame - 1])
                    rests = self._stays(states[frame - 1], arrived[frame])
                after = np.where(self.is_cut[frame][:, None], path.states[frame], arrived[frame])
                same = first and np.array_equal(after, path.states[frame])
                states[frame] = after
                if same:  # from here on nothing differs
                    break
        finally:
            self._idle.append(engine)
        return path._replace(states=states, arrived=arrived)

    def _stays(self, before: np.ndarray, after: np.ndarray) -> bool:
        """Return whether all bodies rest, by their states (N, 13) in two frames."""
        change = difference(before, after)
        size = self.sizes[:, None]
        far = max(np.abs(change[:, :3]).max(), np.abs(size * change[:, 3:6]).max())
        fast = max(np.abs(after[:, 7:10]).max(), np.abs(size * after[:, 10:]).max())
        return bool(far < STAYS and fast < STAYS_SPEED)

    def impulses(self, path: Path) -> np.ndarray:
        """Return the contacts' changes of velocity (T - 1, N, 2) along a path."""
        friction = self.parameters.material(path.coordinates).friction
        return self.engine.impulses(path.states[:-1], path.arrived[1:], friction)

    def tells(self, path: Path) -> np.ndarray:
        """Return (P,) bool, which of the material's coordinates a film may tell. The others are held where they are:
        they would only change how contacts rattle, and of them the prior remains.

        Restitution and contact time are told by an impact that is fast, or one of two bodies that came from apart;
        the ratio of a body's mass to that of an earlier one by momentum that both exchanged.
        """
        met = self.partner < np.arange(self.count)
        hit = self.struck and bool(self.impulses(path)[..., 0].max(initial=0.0) > BOUNCE)
        bounces = not self.apart and (hit or bool(met.any()))
        return np.array([True, bounces, bounces, *met[1:]])

    def slides(self, path: Path) -> bool:
        """Return whether a body slides for long enough to tell friction.

        What sticks where it lands, or rolls, only says that it is great enough, and what it seems to tell is how
        corners rattle; so does what tumbles over its edge, which slips for a moment, and perhaps for another later.
        What slows a ball may be carpet, unless it rolls freely afterwards.
        """
        friction = self.parameters.material(path.coordinates).friction
        both = np.array(self.engine.slides(path.states[:-1], path.arrived[1:], friction))  # (2, T - 1, N)
        if both.shape[1] < SLID:
            return False
        slides, free = np.all(sliding_window_view(both, SLID, axis=1), axis=-1)
        moves = np.linalg.norm(path.states[1 : len(free) + 1, :, 7:10], axis=-1) > RESTS
        rolls_later = np.logical_or.accumulate((free & moves)[::-1])[::-1]
        balls = np.array([body.kind == "sphere" for body in self.bodies])
        return bool((slides & (rolls_later | ~balls)).any())

    def tracking_residuals(self, path: Path) -> np.ndarray:
        """Return tracked minus expected poses (T, N, 6), zero where unseen."""
        change = difference(path.states, self.tracked)[..., :6]
        change[..., :3] -= path.offsets
        return np.where(self.seen[..., None], change, 0.0)

    def defects(self, path: Path) -> np.ndarray:
        """Return the states minus where the engine arrives (T, N, 12); zero but at the cuts after the first frame.

        Of two bodies that struck each other the first one's velocity is that of both together, the second one's that
        to the first, as they were when it happened. Where a body is held to a plane, only what is along it counts:
        corners rattle, by which nothing is told.
        """
        later = self.is_cut & (np.arange(self.frames) > 0)[:, None]
        change = difference(path.arrived, path.states) * later[..., None]
        for frame, k, j, _ in self.blows:
            pair = [k, j]
            if self.apart:
                change[frame, pair, 6:9] += self._slowed(path, frame, pair)
            first, second = change[frame, pair, 6:9]
            shares = self._shares(k, j, path.coordinates)
            change[frame, pair, 6:9] = shares @ [first, second], second - first
        for cut, ways in self.flush.items():
            along = ways.T @ change[cut]
            change[cut] = 0.0
            change[cut][ALONG] = along
        return change

    def _slowed(self, path: Path, frame: int, pair: list[int]) -> np.ndarray:
        """Return (2, 3), m / s, by how much more friction slowed two bodies since a blow in the states of a path than
        where the engine arrives without it; how long ago it was, the way of the one that rested before says."""
        both = np.stack([path.states[frame, pair], path.arrived[frame, pair]])[..., 7:10]  # (2, 2, 3)
        speed = np.linalg.norm(both, axis=-1)
        rested = np.flatnonzero(speed[1] < RESTS)
        if len(rested) != 1:
            return np.zeros((2, 3))
        way = np.linalg.norm((path.states - path.arrived)[frame, pair[rested[0]], :3])
        friction, after = self.parameters.material(path.coordinates).friction, speed[0, rested[0]]
        lost = np.sqrt(after**2 + 2 * friction * np.linalg.norm(self.engine.gravity) * way) - after
        along = both / np.maximum(speed, max(lost, RESTS))[..., None]
        return lost * (along[0] - along[1])

    def derivatives(self, path: Path, sides: int = 2) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives of `tracking_residuals` (T, N, 6, Z) and `defects` (T, N, 12, Z), by fixed differences.

        The Z = size + P unknowns are the changes at the cuts in order, offsets, and coordinates.

        sides : 2, or 1 for half the work and less accuracy.
        """
        by_pose, by_defect = (
            np.zeros((self.frames, self.count, rows, self.size + self.parameters.size)) for rows in (6, CHANGE)
        )

        def slope(frame: int, ways: list[Path], width: float) -> tuple[np.ndarray, np.ndarray]:
            down, up = (way if way is path else self.rolled(way, frame) for way in ways)
            pose = difference(up.states[frame:], down.states[frame:])[..., :6] * self.seen[frame:, :, None]
            return pose / width, (self.defects(up)[frame:] - self.defects(down)[frame:]) / width

        columns = {}
        for (frame, k), part, directions in zip(self.cuts, self.parts, self.ways, strict=True):
            for column, direction in zip(range(part.start, part.stop), directions.T, strict=True):
                width = float(np.abs(direction) @ STEPS / np.abs(direction).sum())
                ways = [path] * (2 - sides)
                for sign in (-1, 1)[2 - sides :]:
                    states = path.states.copy()
                    states[frame, k] = moved(states[frame, k], sign * width * direction)
                    ways.append(path._replace(states=states))
                columns[column] = partial(slope, frame, ways, sides * width)
        for number in np.flatnonzero(self.tells(path)).tolist():
            step = np.zeros(self.parameters.size)
            step[number] = COORDINATE_STEP
            ways = [path._replace(coordinates=path.coordinates + way) for way in (-step, step)]
            columns[self.size + number] = partial(slope, 0, ways, 2 * COORDINATE_STEP)
        for column, (pose, defect) in zip(columns, run_together(*columns.values()), strict=True):
            by_pose[-len(pose) :, :, :, column], by_defect[-len(pose) :, :, :, column] = pose, defect
        for k in range(self.count):
            for axis in range(3):
                by_pose[:, k, axis, self.parts[-1].stop + 3 * k + axis] = -1.0 * self.seen[:, k]
        return by_pose, by_defect

    def errors(self, path: Path, scales: Scales, doubts: Doubts | None = None) -> Errors:
        """Return the residuals' covariances: those of tracking, and of the engine's velocities carried on."""
        step = self.engine.interval
        impulse = self.impulses(path)
        share = velocity_errors(impulse, scales)  # (T - 1, N)
        displaced = np.hypot(0.5 * step * share, LATE * impulse[..., 0])
        speed = np.hypot(
            np.linalg.norm(path.states[..., 7:10], axis=-1), np.linalg.norm(path.states[..., 10:], axis=-1) * self.sizes
        )
        factors, total = [], 0.0
        defects = np.ones((self.frames, self.count, CHANGE))
        for k in range(self.count):
            # carried[t, i]: velocity at frame t by an error in interval i; reached[t, i]: displacement.
            carried, reached = np.zeros((self.frames, self.frames - 1)), np.zeros((self.frames, self.frames - 1))
            for t in range(1, self.frames):
                begin = self.is_cut[t - 1, k]
                keep = 0.0 if begin else float(speed[t - 1, k] > RESTS)
                carried[t] = carried[t - 1] * keep
                reached[t] = (0.0 if begin else 1.0) * reached[t - 1] + step * carried[t]
                carried[t, t - 1] = share[t - 1, k]
                reached[t, t - 1] = displaced[t - 1, k]
            lever = LEVER / self.sizes[k]
            for frame in range(1, self.frames):
                if self.is_cut[frame, k]:
                    far, fast = float(reached[frame] @ reached[frame]), float(carried[frame] @ carried[frame])
                    own = [LEAST_POSITION**2 + far, LEAST_ROTATION**2 + lever**2 * far, fast, lever**2 * fast]
                    defects[frame, k] = np.repeat(own, 3)
                    reached[frame] = 0.0
            reached[self.is_cut[:, k]] = 0.0
            shown = np.flatnonzero(self.seen[:, k])
            model = reached[shown] @ reached[shown].T + np.diag(self.held[shown, k] * HELD_WITHIN**2)
            for frame, *pair, begins in self.blows:  # it may have begun before the frame that shows it
                model += np.diag((shown == frame - 1) * (begins and k in pair) * (STRUCK / 2) ** 2)
            covariance = np.zeros((len(shown), 6, len(shown), 6))
            for axis in range(6):
                covariance[:, axis, :, axis] = model * (1.0 if axis < 3 else lever**2)
            weight = self._weights(k, scales)
            if doubts is not None:
                weight = weight / np.sqrt(doubts.poses[shown, k])[:, None]
            each = np.arange(len(shown))
            covariance[each, :, each] += weight[:, :, None] * self.spread[shown, k] * weight[:, None]
            shared = self.motion.shared[shown, k].reshape(6 * len(shown), -1)
            factor = np.linalg.cholesky(covariance.reshape(6 * len(shown), -1) + shared @ shared.T)
            factors.append(factor)
            total += float(np.sum(np.log(np.diag(factor))))
        self._add_blows(defects, path, scales.impact, doubts.blows if doubts else np.ones(len(self.blows)))
        for cut in self.flush:
            defects[cut][HELD] = 1.0
        total += 0.5 * float(np.sum(np.log(defects)))
        return Errors(factors, defects, total)

    def _add_blows(self, defects: np.ndarray, path: Path, impact: float, less: np.ndarray) -> None:
        """Add to the variances (T, N, 12) of defects what is not known of blows between two bodies.

        Where on their faces, when and how elastically they hit each other changes their velocity to each other by as
        much as it was, and friction's while they stay together. The momentum of both is kept but for a share `impact`,
        and, where one would rest, for friction that acts on it until, or since, a moment that is not known: so it tells
        the ratio of their masses, however the engine bounces.
        """
        step = self.engine.interval
        # of usual things: by how little is pushed what hardly moves, its friction must not be told
        slowed = MEDIAN * float(np.linalg.norm(self.engine.gravity)) * step
        for (frame, k, j, _), part in zip(self.blows, less, strict=True):
            shares, arrived = self._shares(k, j, path.coordinates), path.arrived[frame, [k, j]]
            turning = 0.5 * self.sizes[[k, j]] * np.linalg.norm(arrived[:, 10:], axis=1)
            fast = part * float(np.linalg.norm([*(arrived[1] - arrived[0])[7:10], *turning, slowed]))
            rests = np.linalg.norm(arrived[:, 7:10], axis=1).min() < RESTS
            for body, share in zip((k, j), shares[::-1] * fast, strict=True):
                lever = LEVER / self.sizes[body]
                kept = np.hypot(impact * share, rests * slowed / np.sqrt(12))
                off = np.array([share * step / 2, share * lever * step / 2, kept, share * lever])
                defects[frame, body] += np.repeat(off**2, 3)
            own = defects[frame, [k, j], 6:9]
            defects[frame, k, 6:9], defects[frame, j, 6:9] = shares**2 @ own, own.sum(axis=0) + fast**2

    def _shares(self, k: int, j: int, coordinates: np.ndarray) -> np.ndarray:
        """Return (2,) the shares of two bodies in the mass of both."""
        masses = self.parameters.material(coordinates).masses[[k, j]]
        return masses / masses.sum()

    def _weights(self, k: int, scales: Scales) -> np.ndarray:
        """Return by what each error of body k's poses is multiplied (F, 6); how a sphere turns is not seen at all."""
        weights = np.tile(np.repeat([scales.tracking, scales.turning], 3), (int(self.seen[:, k].sum()), 1))
        if self.bodies[k].kind == "sphere":
            weights[:, 3:] = 1.0
        return weights

    def whitened(self, errors: Errors, pose: np.ndarray, defect: np.ndarray) -> np.ndarray:
        """Return residuals or their derivatives, (T, N, 6, Z) and (T, N, 12, Z), in standard errors, one row each."""
        rows = []
        for k, factor in enumerate(errors.factors):
            shown = pose[self.seen[:, k], k]
            rows.append(solve_triangular(factor, shown.reshape(len(factor), -1), lower=True, check_finite=False))
        later = [(frame, k) for frame, k in self.cuts if frame > 0]
        for frame, k in later:
            rows.append(defect[frame, k] / np.sqrt(errors.defects[frame, k])[:, None])
        return np.concatenate(rows)

    def prior_rows(self, path: Path) -> tuple[np.ndarray, np.ndarray]:
        """Return standard residuals (Z,) of the unknowns' own priors and their precision's roots (Z,); 0 for none."""
        roots = np.zeros(self.size + self.parameters.size)
        residual = np.zeros(self.size + self.parameters.size)
        for (frame, k), part, ways, speeds in zip(self.cuts, self.parts, self.ways, self.speeds, strict=True):
            velocity = 1 / np.repeat(speeds, 3)
            roots[part] = np.linalg.norm(velocity[:, None] * ways[6:], axis=0)
            residual[part] = roots[part] * (path.states[frame, k, 7:] @ ways[6:])
        offsets = slice(self.parts[-1].stop, self.size)
        roots[offsets] = 1 / OFFSET
        residual[offsets] = path.offsets.ravel() / OFFSET
        roots[self.size :] = 1 / self.parameters.spread()
        residual[self.size :] = (path.coordinates - self.parameters.middle()) * roots[self.size :]
        return residual, roots

    def residuals(self, path: Path, errors: Errors) -> np.ndarray:
        """Return all residuals of a path in standard errors, without those of priors."""
        return self.whitened(errors, self.tracking_residuals(path)[..., None], self.defects(path)[..., None])[:, 0]

    def stepped(self, path: Path, change: np.ndarray) -> Path:
        """Return the path after a change (Z,) of all unknowns."""
        states = path.states.copy()
        for (frame, k), part, ways in zip(self.cuts, self.parts, self.ways, strict=True):
            states[frame, k] = moved(states[frame, k], ways @ change[part])
        offsets = path.offsets + change[self.parts[-1].stop : self.size].reshape(-1, 3)
        coordinates = self.parameters.inside(path.coordinates + change[self.size :])
        return self.rolled(Path(states, path.arrived, offsets, coordinates))

    def doubts(
        self, path: Path, errors: Errors, scales: Scales, by_defect: np.ndarray, covariance: np.ndarray, less: Any
    ) -> Doubts:
        """Return what a path tells of poses, by what of a residual is tracking's, and of blows.

        Two bodies that are near each other may touch or not. By how much they change each other's velocity has a
        variance of its own for each interval, learnt by a step of expectation maximisation: the mean square of what it
        was, given all poses. Where these tell nothing it stays as it was.

        by_defect, covariance : derivatives about the path, and (Z, Z) covariance of all unknowns. less : (B,) as
            `Doubts.blows` in `errors`, or None.
        """
        less = np.ones(len(self.blows)) if less is None else less.copy()
        change = self.defects(path)
        for n, (frame, _, j, _) in enumerate(self.blows):
            way = by_defect[frame, j, 6:8]
            square = change[frame, j, 6:8] ** 2 + np.einsum("iz,zy,iy->i", way, covariance, way)
            less[n] = min(less[n] * np.sqrt(float(np.mean(square / errors.defects[frame, j, 6:8]))), 1.0)
        residual = self.tracking_residuals(path)
        weights = np.ones((self.frames, self.count))
        for k, factor in enumerate(errors.factors):
            shown = np.flatnonzero(self.seen[:, k])
            pulled = cho_solve((factor, True), residual[shown, k].ravel()).reshape(-1, 6)
            weight = self._weights(k, scales)
            error = weight * np.einsum("tij,tj->ti", self.spread[shown, k], weight * pulled)
            stated = weight[:, :, None] * self.spread[shown, k] * weight[:, None]
            square = np.einsum("ti,ti->t", error, np.linalg.solve(stated, error[..., None])[..., 0])
            weights[shown, k] = LOST / np.maximum(square, LOST)
        return Doubts(weights, less)
