"""Which plane is the floor: planes tried on a coarse grid of points, each with log odds, the likeliest fitted.

What speaks for a plane is its share of the pixels at the noise of consumer sensors, little that lies under it, the
camera's height over it, and that cameras are held upright. Others that come near the likeliest are rivals.

The same image has the same floor, and its mirror image the mirrored one: what is background follows from it, so that
two seeds with two floors would answer two questions.
"""

from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import LEVEL, Camera
from derender.compilation.cache import njit
from derender.detection.floor import (
    MOST_NOISE,
    NO_PLANE,
    ROUGHEST,
    SAY_FLOOR,
    Floor,
    NoFloor,
    neighbour_noise,
    plane_through,
)
from derender.detection.solids.beliefs import bare_image
from derender.errors import DerenderError
from derender.results.fit import sensor_deviation
from derender.scene.priors.bare_image import Floors

# Of the pixels: the least of a level plane to which others are no match, and of a floor before a wall that the camera
# faces; the least of any floor, unless there is none.
FLOOR_SHARE, SMALL_FLOOR = 0.1, 0.06
ROOM_FLOOR = 0.03  # of one square to that wall with nothing under it: a camera held level shows little of a room's
# Cosine between the normals of a wall and of the floor before it, at most; times as rough as others that may be.
ACROSS, ROUGH = 0.5, 2.0
NEAR_PLANE = 3.0  # standard deviations of consumer sensors, or of the noise that neighbours show, off a plane at most
# Sine of the angle between ray and plane: noise is along the ray, and across a plane that is met at a slant less; but
# no less than at this angle, as planes are not even.
SLANT = 0.3
WIDTHS = (1.0, 1.0 / NEAR_PLANE)  # of that, about which a plane is fitted: a wide one may take in what is beside it
FAR_UNDER = 2.0  # times as far under it a point cannot lie on what stands on a plane
SMALL = 0.02  # share of the pixels: less counts as so much
LEAST_FLOOR = 0.05  # of the pixels: a smaller plane is no rival
STEEP = 0.64  # sine of what faces downwards more steeply than a wall
CLOSE, RIVALS = 3.0, 2  # nats behind the likeliest floor within which another plane is weighed too; how many at most
DISTINCT = 0.7  # of a plane's points that lie off the likelier ones, from which on it is another plane
SQUARE = 0.1  # cosine between a top's normal and that of a side below it, at most
UPWARD = 0.5  # cosine between the image's upward direction and the normal of a floor before a wall, at least
FACING = 0.25  # sine of the angle between a plane's normal and the optical axis within which the camera faces it
SAMPLE = 1500  # points looked at, about
SIDES = (1, 2, 4, 8)  # rows and columns of these points that squares span whose corners planes are put through
TRIPLES, STREAM = 300, 2026  # planes tried through any three of these points, and the seed of these triples
BACKDROP, SIDE = 0.3, 0.2  # least shares of the pixels, and of three of the image's sides, that a backdrop holds


class Candidate(NamedTuple):
    """A plane that may be the floor.

    normal, offset : normal . p = offset, in camera axes, towards the camera.
    """

    normal: np.ndarray
    offset: float
    near: float  # metres off it that lie on it
    odds: float  # nats, what its share of the pixels says of it, and how it lies


def find_floor(depth: np.ndarray, camera: Camera, believed: Floors | None = None) -> Floor:
    """Return the Floor about the likeliest of the Candidates; takes and raises what `floors_of` does."""
    return fitted(depth, camera.points(depth), floors_of(depth, camera, None, believed)[0])


def fitted(depth: np.ndarray, points: np.ndarray, candidate: Candidate, share: float = 1.0) -> Floor:
    """Return the Floor about a Candidate; points : (H, W, 3) of the image (H, W).

    share : of what is near it, that is taken for its noise; less where so much would turn it to what is beside.
    """
    floor = plane_through(depth, points, candidate.normal, candidate.offset, share * candidate.near)
    if floor.pose[:3, 2] @ candidate.normal > LEVEL:
        return floor
    return plane_through(depth, points, candidate.normal, candidate.offset, WIDTHS[1] * candidate.near)


def floors_of(depth: np.ndarray, camera: Camera, gravity: Any = None,
              believed: Floors | None = None) -> list[Candidate]:  # fmt: skip
    """Return the Candidates that come near the likeliest one, that first.

    gravity : (3,) the way things fall in the camera's frame, where it is known: then a level plane is the floor if
        enough lies on one.
    depth : (H, W) float metres, NaN = no return. believed : Floors of a prior; None: those of the built-in one.

    Raises DerenderError where fewer than 50 pixels have depth, NoFloor where no plane is likely one.
    """
    believed = bare_image().loose.floor if believed is None else believed
    points = camera.points(depth)
    count = int((np.isfinite(depth) & (depth > 0)).sum())
    if count < 50:
        what = f"the image has too few pixels with depth ({count}, at least 50 are needed)"
        raise DerenderError(what, remedy="check the export, or go nearer")
    grid = coarse_grid(points)
    sample = grid[np.isfinite(grid[..., 2])]
    normal, offset = planes_through(triples_of(grid, sample))
    if len(normal) == 0:
        raise DerenderError("all pixels with depth lie on one line", remedy="give a whole image")
    noise = neighbour_noise(depth)
    if noise > max(MOST_NOISE, ROUGHEST * float(sensor_deviation(float(np.median(sample[:, 2]))))):
        raise NoFloor(NO_PLANE, remedy=SAY_FLOOR)  # there are no surfaces
    near = near_at(sample[:, 2], noise)
    odds, share = odds_of_floors(sample, near, normal, offset, gravity, believed)
    best = int(np.argmax(odds))
    if odds[best] < np.log(believed.none):
        raise NoFloor(NO_PLANE, remedy=SAY_FLOOR)
    if gravity is None and np.hypot(*normal[best, :2]) < FACING:
        upright = (-normal[:, 1] > UPWARD) & (np.abs(normal @ normal[best]) < ACROSS)
        score, _ = scores(sample, near, normal, offset, believed.under)
        lowest = (score > ROOM_FLOOR) & (score == share) & (np.abs(normal @ normal[best]) < SQUARE)
        plain = lowest | (score > FLOOR_SHARE)
        rough, _ = scores(sample, ROUGH * near, normal, offset, believed.under, 1.0)
        for fits, times, kept in ((score, 1.0, plain), (rough, ROUGH, rough > FLOOR_SHARE)):
            before = kept & upright
            if before.any():
                best = int(np.argmax(np.where(before, fits, 0.0)))
                at = times * float(np.median(near[np.abs(sample @ normal[best] - offset[best]) < times * near]))
                return [Candidate(normal[best], float(offset[best]), at, float(odds[best]))]
    found: list[Candidate] = []
    free = np.ones(len(sample), bool)
    kept = np.flatnonzero(odds > odds[best] - CLOSE)
    while True:
        on, at = near_plane(sample, near, normal[best], float(offset[best]))
        found.append(Candidate(normal[best], float(offset[best]), at, float(odds[best])))
        free &= ~on
        if len(found) > RIVALS or not free.any():
            return found
        alone = on_and_under(np.ascontiguousarray(sample[free].T), near[free], normal[kept], offset[kept], SLANT)[:, 0]
        kept = kept[alone / len(sample) > np.maximum(DISTINCT * share[kept], LEAST_FLOOR)]
        if len(kept) == 0:
            return found
        best = int(kept[np.argmax(odds[kept])])


def near_at(depth: np.ndarray, noise: float) -> np.ndarray:
    """Return how many metres off a plane, at first sight, points at a depth in metres may be that lie on it.

    noise : metres, of neighbouring pixels.
    """
    return NEAR_PLANE * np.maximum(sensor_deviation(depth), noise)


def coarse_grid(points: np.ndarray) -> np.ndarray:
    """Return (h, w, 3) some SAMPLE points of an image (H, W, 3), NaN where there is no return: every so many rows and
    columns, as many left out at either end, so that an image's mirror image has the mirrored ones.
    """
    height, width = points.shape[:2]
    step = max(1, round(np.sqrt(np.isfinite(points[..., 2]).sum() / SAMPLE)))
    rows, columns = (np.arange((count - 1) % step // 2, count, step) for count in (height, width))
    return points[np.ix_(rows, columns)]


def triples_of(grid: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Return (N, 3, 3) triples of points to put planes through: corners of squares of the grid, which lie on one
    surface more often than others do, and some of any three, where holes leave no squares.
    """
    found = []
    for side in SIDES:
        corners = np.stack([grid[:-side, :-side], grid[:-side, side:], grid[side:, :-side], grid[side:, side:]], axis=2)
        corners = corners.reshape(-1, 4, 3)
        corners = corners[np.isfinite(corners).all(axis=(1, 2))]
        if len(corners):
            found += [corners[:, [0, 1, 2]], corners[:, [3, 2, 1]]]
    rng = np.random.default_rng(STREAM)
    found.append(sample[rng.integers(len(sample), size=(TRIPLES, 3))])
    return np.concatenate(found)


def planes_through(triples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (normals (N, 3) towards the camera, offsets (N,)) of the planes through triples of points (N', 3, 3)."""
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 1e-8] / length[length > 1e-8, None]
    offset = np.einsum("ij,ij->i", normal, triples[length > 1e-8, 0])
    side = np.where(offset > 0, -1.0, 1.0)  # the camera is at -offset
    return normal * side[:, None], offset * side


def near_plane(points: np.ndarray, near: np.ndarray, normal: np.ndarray, offset: float) -> tuple[np.ndarray, float]:
    """Return ((N,) bool, which points (N, 3) lie on a plane; how many metres off it these may be, the median).

    near : (N,) metres, see `near_at`.
    """
    across = near * np.clip(-offset / points[:, 2], SLANT, 1.0)
    on = np.abs(points @ normal - offset) < across
    return on, float(np.median(across[on] if on.any() else across))


def odds_of_floors(sample: np.ndarray, near: np.ndarray, normal: np.ndarray, offset: np.ndarray,
                   gravity: Any, believed: Floors) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return (log odds in nats, share of the sample on it), each (N,), of planes normal (N, 3) . p = offset (N,).

    Log odds are to be the floor of what a sample of the image shows. Points far under a plane cannot lie on what stands
    on it: a table top with the room's floor behind it may have some, the side of a box has many. Where gravity is known
    only level planes have odds, if there is one.

    sample : (S, 3) points. near : (S,) metres, see `near_at`.
    """
    score, share = scores(sample, near, normal, offset, believed.under)
    below = below_a_top(normal, score, share, (share - score) / believed.under)
    if (score > SMALL_FLOOR).any():
        score = np.where(score > SMALL_FLOOR, score, 0.0)
    level = np.zeros(len(normal), bool)
    if gravity is not None:
        level = (normal @ -np.asarray(gravity, float) > LEVEL) & (score > FLOOR_SHARE)
    odds = believed.share * np.log(np.maximum(score, SMALL)) + prior_of(normal, offset, bool(level.any()), believed)
    if not level.any():
        odds = np.where(below, odds + np.log(believed.upside_down / believed.ceiling), odds)
    return np.where(level, odds, -np.inf) if level.any() else odds, share


def prior_of(normal: np.ndarray, offset: np.ndarray, level: bool, believed: Floors) -> np.ndarray:
    """Return the log prior of floors normal (N, 3) . p = offset (N,) in camera axes, in nats.

    Of the camera's height over them, and unless they are known to be level of how they lie in the image: 0 at the
    likeliest height before a camera that is held upright.
    """
    height = np.maximum(-offset, 1e-6)
    odds = -0.5 * (np.log(height / believed.height) / np.log(believed.spread)) ** 2
    if level:
        return odds
    x, y = np.abs(normal[:, 0]), normal[:, 1]
    downwards = np.where(y > STEEP, believed.ceiling, believed.upside_down)
    turned = np.where(x > np.abs(y), believed.aside, np.where(y > 0.0, downwards, 1.0))
    return odds + np.log(np.where(np.hypot(x, y) < FACING, believed.faced, turned))


def below_a_top(normal: np.ndarray, score: np.ndarray, share: np.ndarray, under: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which planes face steeply downwards where another faces up, square to them and behind them.

    That is rather a box's side below its top than the floor of a camera held upside down: a wall stands before a floor.
    normal (N, 3), score, share and under (N,) : of planes, see `scores`, and the share far under them.
    """
    downwards = (normal[:, 1] > STEEP) & (np.abs(normal[:, 0]) <= normal[:, 1])
    tops = (score > FLOOR_SHARE) & (-normal[:, 1] > UPWARD)
    if not (downwards.any() and tops.any()):
        return np.zeros(len(normal), bool)
    top = int(np.argmax(np.where(tops, score, -np.inf)))
    behind = under > 0.5 * share[top]
    return downwards & behind & (np.abs(normal @ normal[top]) < SQUARE)


def scores(sample: np.ndarray, near: np.ndarray, normal: np.ndarray, offset: np.ndarray,
           part: float, slant: float = SLANT) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return (share of a sample of points on planes less a part of what is far under them, that share), each (N,)."""
    share, under = on_and_under(np.ascontiguousarray(sample.T), near, normal, offset, slant).T / len(sample)
    return share - part * under, share


@njit(cache=True, nogil=True, error_model="numpy")  # a check for zero would be a branch
def on_and_under(points, near, normal, offset, slant):
    """Return (N, 2) how many of the points (3, S) lie on each plane, and how many far under it.

    near : (S,) metres along a ray that meets it at a right angle. slant : see SLANT; 1: whatever the angle.
    """
    found = np.zeros((len(offset), 2))
    x, y, z = points[0], points[1], points[2]
    for k in range(len(offset)):
        a, b, c, d, on, under = normal[k, 0], normal[k, 1], normal[k, 2], offset[k], 0, 0
        for n in range(x.size):  # without a branch, so that it is vectorised
            distance = a * x[n] + b * y[n] + c * z[n] - d
            across = near[n] * min(1.0, max(slant, -d / z[n]))
            on += abs(distance) < across
            under += distance < -FAR_UNDER * across
        found[k, 0], found[k, 1] = on, under
    return found


def find_backdrop(depth: np.ndarray, camera: Any, believed: Floors | None = None) -> Any:
    """Return the Floor of a plane before which everything is seen, a table or a wall, and (H, W) bool: what lies on it
    or beyond; or None. It reaches three sides of the image: a solid that does would fill it.
    """
    try:
        plane = find_floor(depth, camera, believed=believed)
    except DerenderError:
        return None
    seen = np.isfinite(depth) & (depth > 0)
    height = (camera.points(depth) - plane.pose[:3, 3]) @ plane.pose[:3, 2]
    beyond = seen & ((height < max(0.004, 4.0 * plane.sigma)) | plane.inliers)
    edges = (beyond[0], beyond[-1], beyond[:, 0], beyond[:, -1])
    reached = sum(edge.mean() > SIDE for edge in edges)
    return (plane, beyond) if reached >= 3 and plane.inliers.sum() > BACKDROP * seen.sum() else None
