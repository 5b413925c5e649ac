"""Where a thing is that nothing shows: motions drawn from its last posterior, weighed by what each frame does not show.

Most of them are films of the physics engine, in which it falls, strikes what rests and slides on; of a hand's two, one
holds it where it was last seen, and one carries it straight on. Where lost things are, and new ones, shows what is seen
nearer to the camera than anything that is drawn (`blobs_of`).
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.posterior.sampler import next_temperature
from derender.scene.friction import MEDIAN, SPREAD
from derender.scene.pose import moved, rotation_vector
from derender.tracking.reaching import nearer, patches

if TYPE_CHECKING:
    from derender.tracking.tracker import Tracker

HANDS, FILMS = 2, 14  # motions of a hand, and of the engine
CARRIED = 0.2  # probability of a hand: most of what is in the air falls
COARSER = 8.0  # times the steps that tell of materials: a fall need not be exact
LONGEST = 0.6  # seconds: what falls from two metres rests or goes on as it did
ENTERED = 0.002  # metres: a hand carries nothing deeper into something than a tracked pose may be there by its errors
# Of so few motions none is where the thing is, and all are hundreds of nats below it: at least so many are believed.
BELIEVED = 3.0


class Hidden(NamedTuple):
    """What may have become of one thing since it was seen last, `age` frames ago."""

    paths: np.ndarray  # (K, T, 4, 4) poses to the world in the frames since then
    costs: np.ndarray  # (K,) nats so far
    seen: np.ndarray  # (6, 6) covariance of its pose when it was seen last, world axes
    age: int = 0

    @property
    def weights(self) -> np.ndarray:
        """(K,) probabilities, raised to the greatest power up to 1 at which BELIEVED motions count."""
        power = next_temperature(-self.costs, 0.0, BELIEVED / len(self.costs))
        weights = np.exp(power * (self.costs.min() - self.costs))
        return weights / weights.sum()

    @property
    def now(self) -> np.ndarray:
        """(K, 4, 4) poses in the present frame."""
        return self.paths[:, min(self.age, self.paths.shape[1] - 1)]

    @property
    def middle(self) -> int:
        """Number of the path that is nearest to all others on average."""
        centres = self.now[:, :3, 3]
        return int(np.argmin(np.linalg.norm(centres[:, None] - centres, axis=-1) @ self.weights))

    @property
    def pose(self) -> np.ndarray:
        """(4, 4), to the world, on the middle path."""
        return self.now[self.middle]

    @property
    def before(self) -> np.ndarray:
        """(4, 4), to the world, on the middle path one frame ago."""
        return self.paths[self.middle, min(max(self.age - 1, 0), self.paths.shape[1] - 1)]

    def covariance(self) -> np.ndarray:
        """Return (6, 6) of the centre and the turn about the middle path, world axes."""
        turns = [rotation_vector(pose[:3, :3] @ self.pose[:3, :3].T) for pose in self.now]
        off = np.hstack([self.now[:, :3, 3] - self.pose[:3, 3], turns])
        return self.seen + (self.weights * off.T) @ off


def last_seen(tracker: "Tracker", k: int) -> Hidden:
    """Return what may become of thing k, which was seen in the frame before; all other things stay where they are."""
    from derender.dynamics.engine import Engine, Material
    from derender.dynamics.states import from_poses, to_poses
    from derender.physics.bodies import KIND_NAMES, Body, Matter
    from derender.physics.mujoco_model import Diverged

    thing, rng = tracker.things[k], np.random.default_rng(k)  # a film is followed in the same way each time
    bodies = [] if tracker.floor is None else [Body("floor", "plane", np.zeros(3), tracker.floor)]
    for n, other in enumerate(tracker.things):
        if other.here or n == k:
            bodies.append(Body(other.name, KIND_NAMES[other.kind], other.size, other.pose, fixed=n != k))
    engine = Engine(Matter(tuple(bodies), tracker.gravity, ()), (thing.name,), tracker.step, COARSER)
    speed, count = np.concatenate([thing.velocity, thing.spin]), int(np.ceil(LONGEST / tracker.step)) + 1
    paths = np.tile(thing.pose, (HANDS + FILMS, count, 1, 1))
    paths[1] = carried(thing.pose, speed * tracker.step, count, bodies, thing.name)
    spread = thing.covariance[:6, :6]
    for n in range(HANDS, len(paths)):
        off, faster = rng.multivariate_normal(np.zeros(6), spread, 2) * (n > HANDS)
        faster *= np.sqrt(2.0) / tracker.step  # a speed is the difference of two poses
        engine.tell(Material(MEDIAN * np.exp(SPREAD * rng.standard_normal()), 0.0, engine.masses))
        paths[n, 0] = moved(thing.pose, off)
        state = from_poses(paths[n, :1])
        state[0, 7:10], state[0, 10:] = (speed + faster)[:3], paths[n, 0, :3, :3].T @ (speed + faster)[3:]
        state[:, :3] -= engine.overlaps(state)[:, None] * tracker.gravity / np.linalg.norm(tracker.gravity)
        try:
            for t in range(1, count):
                state = engine.advance(state)
                paths[n, t] = to_poses(state)[0]
        except Diverged:
            paths[n] = paths[1]
    costs = np.repeat([-np.log(CARRIED / HANDS), -np.log((1 - CARRIED) / FILMS)], [HANDS, FILMS])
    return Hidden(paths, costs, spread.copy())


def carried(pose: np.ndarray, step: np.ndarray, count: int, bodies: list, name: str) -> list[np.ndarray]:
    """Return the poses (4, 4) in so many frames of a body that is moved by `step` (6,) in each, and stops before it
    enters another one."""
    body = next(each for each in bodies if each.name == name)

    def gap(pose: np.ndarray) -> float:
        others = (other for other in bodies if other.name != name)
        return min((body._replace(pose=pose).gap(other) for other in others), default=np.inf)

    least, found = min(gap(pose), 0.0) - ENTERED, [pose]
    while len(found) < count and gap(ahead := moved(pose, step * len(found))) > least:
        found.append(ahead)
    return found + [found[-1]] * (count - len(found))


def one_frame_later(hidden: Hidden, tracker: "Tracker", k: int) -> Hidden:
    """Return what may be of thing k in the tracker's present frame, and draw the middle one."""
    later = hidden._replace(age=hidden.age + 1)
    costs = hidden.costs + [tracker.draw(k, pose) / tracker.start.temper for pose in later.now]
    later = later._replace(costs=costs)
    tracker.draw(k, later.pose)
    return later


SMALLEST = 25  # pixels: smaller patches are noise at edges
MOST = 3  # blobs that are looked at, the largest first


class Blob(NamedTuple):
    """Pixels that belong together and that nothing explains."""

    mask: np.ndarray  # (H, W) bool
    pixels: int  # how many
    centre: np.ndarray  # (3,) middle of the seen points, camera axes, metres


def blobs_of(tracker: "Tracker") -> list[Blob]:
    """Return what nothing explains in the tracker's present frame, the largest first; a hand is none of it."""
    observed = tracker.observed
    near = nearer(tracker, tracker.misfit.blurred, tracker.spread) & ~tracker.hand
    if int(near.sum()) < SMALLEST:
        return []
    marks, sizes = patches(near, near)
    found = []
    for number in np.argsort(-sizes[1:])[:MOST] + 1:
        if sizes[number] >= SMALLEST:
            mask = near & (marks == number)
            found.append(Blob(mask, int(sizes[number]), centre_of(mask, observed, tracker.camera)))
    return found


def centre_of(mask: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the middle (3,) of the points that some pixels show, robustly, camera axes."""
    points = camera.points(depth)[mask]
    return points[np.abs(points[:, 2] - np.median(points[:, 2])) < 0.15].mean(axis=0)


def shifts_to(tracker: "Tracker", blobs: list[Blob], own: np.ndarray | None, pose: np.ndarray) -> list[np.ndarray]:
    """Return poses (4, 4) of a thing, camera axes, that bring it to each blob.

    own : (H, W) bool, where it is drawn now, whose middle goes to the blob's; None: its centre goes somewhat behind.
    """
    found = []
    for blob in blobs:
        moved = pose.copy()
        if own is not None and own.any():
            moved[:3, 3] += blob.centre - centre_of(own, tracker.misfit.canvas.depth, tracker.camera)
        else:
            ray = blob.centre / np.linalg.norm(blob.centre)
            moved[:3, 3] = blob.centre + 0.03 * ray
        found.append(moved)
    return found
