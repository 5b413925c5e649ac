"""The supporting plane of a depth image, fitted robustly about a first guess of it (`floors.py`), or given.

A real sensor's depths are off by a slow bias (1 to 9 mm on planes before consumer sensors), and bins and carpets are no
planes: `bend_of` tells it. Without it a floor's noise seems to be that large, and what is lower is lost in it.

A floor may be given instead: a plane in camera axes, or none at all.
"""

from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import greatest
from derender.compilation.cache import njit
from derender.detection.patches import local_planes
from derender.detection.pyramid import estimate_blur, noise_of
from derender.errors import DerenderError
from derender.render.blur import blur_radius
from derender.results.fit import TO_SIGMA, median, scatter, sensor_deviation
from derender.scene.pose import upright_frame

USUAL = 0.8  # metres from which household things are looked at
BESIDE = 0.1  # metres, seen from USUAL, from its foot over which the floor beside a solid counts by half or more
# Metres below the main plane, however far away, from which on a plane is the room's floor below a table: what stands
# there is furniture.
ROOM = 0.45
ROUGHEST = 6.0  # standard deviations of consumer sensors by which a floor is off its plane at most
FEET = 100  # points of what stands on the floor, at most, to which distances are taken


NO_PLANE = "no plane holds a tenth of the pixels"
SAY_FLOOR = "say --floor none, give the plane with --floor, or crop the image"


class NoFloor(DerenderError):
    """No plane holds a tenth of the pixels."""


class Floor(NamedTuple):
    """A supporting plane.

    pose : (4, 4) float64, floor frame to camera: z up (towards the camera's side), origin under the image's middle.
    """

    pose: np.ndarray
    sigma: float  # standard deviation of the depth noise about the plane in metres, from the median absolute residual
    inliers: np.ndarray  # (H, W) bool, pixels on the plane


def scale_of(depth: np.ndarray, floor: Floor) -> float:
    """Return how far away the floor is seen in an image (H, W), against USUAL; at most 1.

    Lengths by which people tell things from walls shrink with it: from nearer they look at smaller ones. From farther
    off furniture is furniture; what is so far that it is not is counted in another unit, see `unit.py`.
    """
    on = depth[floor.inliers] if floor.inliers.any() else depth[np.isfinite(depth) & (depth > 0)]
    return min(1.0, median(on) / USUAL) if len(on) else 1.0


def floor_beside(floor: Floor, depth: np.ndarray, camera: Camera, standing: np.ndarray) -> Floor:
    """Return the plane of the floor beside what stands on it: the floor fitted again, what is near counting more.

    A real sensor bends a plane by millimetres, and what lies behind a table may be nearly its plane: solids stand on
    the floor that is seen at their feet.

    floor : Floor, a first look. standing : (H, W) bool, pixels of what stands on it.
    """
    points = camera.points(depth)
    flat = (points.reshape(-1, 3) - floor.pose[:3, 3]) @ floor.pose[:3, :2]
    feet = flat[standing.ravel()]
    feet = feet[:: max(1, len(feet) // FEET)]
    if len(feet) == 0:
        return floor
    nearest = squares_to_nearest(np.ascontiguousarray(flat), feet)
    normal = floor.pose[:3, 2]
    weight = 1.0 / (1.0 + nearest / (BESIDE * scale_of(depth, floor)) ** 2)
    return plane_through(depth, points, normal, normal @ floor.pose[:3, 3], floor.sigma, weight)


@njit(cache=True, nogil=True)
def squares_to_nearest(points, others):
    """Return (N,) the squared distances of points (N, 2) to the nearest of others (M, 2); inf where a point is NaN."""
    found = np.full(len(points), np.inf)
    for k in range(len(points)):
        for other in others:
            found[k] = min(found[k], (points[k, 0] - other[0]) ** 2 + (points[k, 1] - other[1]) ** 2)
    return found


def plane_through(
    depth: np.ndarray,
    points: np.ndarray,
    normal: np.ndarray,
    offset: float,
    scale: float,
    weight: np.ndarray | None = None,
) -> Floor:
    """Return the Floor fitted robustly to the points near a plane.

    points : (H, W, 3) float64, camera axes. normal, offset : of a first plane, towards the camera.
    scale : metres, the first guess of the noise across it, and the most that is taken for noise.
    weight : (H W,) float64, how much each pixel counts; None: all alike.
    """
    good = np.flatnonzero(np.isfinite(depth.ravel()) & (depth.ravel() > 0))
    flat = points.reshape(-1, 3)[good]
    weight = np.ones(len(good)) if weight is None else weight[good]
    most, inner = scale, None
    for _ in range(6):
        before, inner = inner, np.abs(flat @ normal - offset) < max(3 * scale, 0.001)
        if before is not None and (inner == before).all():
            break
        chosen = flat[inner]
        if len(chosen) < max(20, 0.05 * len(good)):
            raise NoFloor(NO_PLANE, remedy=SAY_FLOOR)
        worth = weight[inner] / chosen[:, 2] ** 4  # the noise of disparity sensors grows with the squared depth
        centre = worth @ chosen / worth.sum()
        away = (chosen - centre) * np.sqrt(worth)[:, None]
        normal = np.linalg.eigh(away.T @ away)[1][:, 0]
        normal *= np.sign(-normal @ centre)
        offset = normal @ centre
        off = np.abs(chosen @ normal - offset)
        scale = np.clip(TO_SIGMA * weighted_median(off, weight[inner]), 2e-4, most)
    return floor_on(depth.shape, good, flat, normal, offset, scale, weight)


def floor_on(shape: tuple[int, int], good: np.ndarray, flat: np.ndarray, normal: np.ndarray, offset: float,
             scale: float, weight: np.ndarray) -> Floor:  # fmt: skip
    """Return the Floor on a plane normal . p = offset, the noise across it `scale` metres.

    good, flat, weight : (N,), (N, 3), (N,) the pixels with a depth by their place in the image, their points, and how
        much each counts. shape : (H, W).
    """
    slope = np.maximum(np.abs(flat @ normal) / flat[:, 2], 0.05)
    residual = (flat @ normal - offset) / slope
    inner = np.abs(residual) < 4 * scale / slope
    sigma = float(TO_SIGMA * weighted_median(np.abs(residual[inner]), weight[inner]))
    inliers = np.zeros(shape, bool)
    inliers.flat[good[inner]] = True
    return Floor(frame_of(normal, offset, flat[inner].mean(axis=0)), max(sigma, 3e-4), inliers)


# Rounds in which the pixels that are on the plane are told again, at most; standard deviations of a step to end with.
ROUNDS_OF_NOISE, LITTLE = 12, 0.1
# Squared pixels by which a blur is off what jumps tell: seen from above a floor does not tell it, and would trade its
# tilt for it.
USUAL_BLUR = 1.0
# Pixels under the horizon, and for each pixel of the blur, from which on a blur shows in a floor's depths as their
# second derivative does, to a tenth.
HORIZON, BLURRED_HORIZON = 5.0, 13.0
NO_FLOOR = 6.0  # standard deviations of the noise by which a pixel surely shows something else


def under_its_noise(floor: Floor, depth: np.ndarray, camera: Camera) -> Floor:
    """Return the Floor fitted to all of it, each pixel counting as its own noise lets it: of a floor that runs to its
    horizon the far pixels tell the tilt, which the near ones leave open by centimetres there. With fewer than FEWEST
    on it, it stays.

    The inverse depth w of a plane is affine in an image, and a blur of s pixels adds (s |grad w|)^2 / w^3 to its
    depths: both are fitted, by Gauss-Newton steps. Of independent noise; a real sensor's far depths are biased.
    """
    good = np.flatnonzero(np.isfinite(depth) & (depth > 0))
    rays, seen = camera.rays().reshape(-1, 3)[good], depth.ravel()[good]
    flat, told, on = rays * seen[:, None], floor, floor.inliers.ravel()[good]
    noise = noise_map(depth, floor, camera)
    blurred = estimate_blur(depth, noise)
    horizon = max(HORIZON, BLURRED_HORIZON * blurred)
    # w = numbers[:3] . ray; s^2
    numbers = np.append(floor.pose[:3, 2] / (floor.pose[:3, 3] @ floor.pose[:3, 2]), blurred**2)
    for _ in range(ROUNDS_OF_NOISE):
        steepness = np.hypot(numbers[0] / camera.fx, numbers[1] / camera.fy)  # of w, by a pixel
        w = np.maximum(rays @ numbers[:3], 1e-9)
        residual = seen - 1.0 / w - numbers[3] * steepness**2 / w**3
        sigma = noise.ravel()[good]
        before, on = on, (w > horizon * steepness) & (np.abs(residual) < WITHIN * sigma)
        if blurred > 0.0:  # what stands there leaks into the pixels about it by less than their noise, but into many
            other = np.zeros(depth.shape, bool)
            other.flat[good] = np.abs(residual) > NO_FLOOR * sigma
            on &= ~greatest(other, blur_radius(blurred)).flat[good]
        if on.sum() < FEWEST or (on == before).all():
            break
        change = np.column_stack([-rays[on] / w[on, None] ** 2, steepness**2 / w[on] ** 3]) / sigma[on, None]
        precision, pull = change.T @ change, change.T @ (residual[on] / sigma[on])
        precision[3, 3] += 1.0 / USUAL_BLUR**2
        pull[3] -= (numbers[3] - blurred**2) / USUAL_BLUR**2
        step = np.linalg.lstsq(precision, pull, rcond=None)[0]
        if numbers[3] + step[3] < 0.0:  # without a blur the plane is another one
            step[3] = -numbers[3]
            step[:3] = np.linalg.lstsq(precision[:3, :3], pull[:3] - precision[:3, 3] * step[3], rcond=None)[0]
        numbers += step
        length = float(np.linalg.norm(numbers[:3]))
        normal, offset = -numbers[:3] / length, -1.0 / length
        inliers = np.zeros(depth.shape, bool)
        inliers.flat[good[on]] = True
        told = Floor(frame_of(normal, offset, flat[on].mean(axis=0)), floor.sigma, inliers)
        if step @ precision @ step < LITTLE**2:
            break
        noise = noise_map(depth, told, camera)
    if told is floor:
        return floor
    scale = scatter(flat[told.inliers.ravel()[good]] @ normal - offset)
    return floor_on(depth.shape, good, flat, normal, offset, scale, np.ones(len(good)))


def weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    """Return the value at which half of the weight lies below; between two such values, their mean."""
    if (weight == weight[0]).all():
        return median(values)
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    middle = [np.searchsorted(total, 0.5 * total[-1], side) for side in ("left", "right")]
    return float(np.mean(values[order[middle]]))


ROUNDS, WITHIN = 6, 3.0  # of leaving out what is no floor, and beyond how many standard deviations that is
ORDERS = 2, 4  # of the polynomial: a sensor's bias and a carpet; a bin, whose floor rises towards all its walls
BETTER = 0.8  # of the scatter that is left about a surface worth taking, instead of about the one before it
FEWEST = 100  # pixels of the floor: fewer tell no bend
STEEPEST = 0.15  # sine of the angle between ray and floor below which the bend is taken along the ray no further
MOST = 3.0  # standard deviations of consumer sensors that a bend amounts to at most


def bend_of(depth: np.ndarray, floor: Floor, camera: Camera) -> np.ndarray:
    """Return (H, W) metres to add to a depth image so that its floor is a plane; zeros where it is one as it is.

    The floor's height over its plane is taken as a polynomial of rows and columns, fitted robustly to its inliers, of a
    higher order where that leaves clearly less, and no more anywhere than it is among them.

    depth : (H, W) float64 metres, NaN = no return. floor : Floor.
    """
    none = np.zeros(depth.shape)
    if floor.inliers.sum() < FEWEST:
        return none
    normal = floor.pose[:3, 2]
    seen = ((camera.points(depth) - floor.pose[:3, 3]) @ normal)[floor.inliers]
    row, column = (np.linspace(-1.0, 1.0, count) for count in depth.shape)
    bend, before = none, scatter(seen)
    for order in ORDERS:
        powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
        terms = np.stack([np.outer(row**j, column**i) for i, j in powers], axis=-1)
        numbers, after = robust_fit(terms[floor.inliers], seen)
        if after > BETTER * before:
            continue
        surface = terms @ numbers
        fitted = surface[floor.inliers][np.abs(surface[floor.inliers] - seen) <= WITHIN * after]
        bend, before = np.clip(surface, fitted.min(), fitted.max()), after
    most = MOST * sensor_deviation(median(depth[floor.inliers]))
    slope = -(camera.rays() @ normal)
    return np.clip(bend, -most, most) / np.maximum(slope, STEEPEST)


def robust_fit(terms: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (the numbers by which terms (N, K) explain most of what is seen (N,), metres that the rest scatters)."""
    kept = np.abs(seen) <= WITHIN * scatter(seen)
    for _ in range(ROUNDS):
        numbers = np.linalg.lstsq(terms[kept], seen[kept], rcond=None)[0]
        residual = seen - terms @ numbers
        after = scatter(residual)
        kept = np.abs(residual) <= WITHIN * after
    return numbers, after


NEAR = 0.02  # metres off a given plane within which its own points are looked for
MOST_NOISE = 0.02  # metres: where neighbouring pixels differ by more there is no surface
FAR_BELOW = 10.0  # metres under the lowest point at which the floor lies where there is none


def read_floor(text: Any) -> np.ndarray | str | None:
    """Return what `--floor` says: None for "auto", "none", or the plane (4,) a x + b y + c z + d = 0, a unit normal.

    Camera axes (x right, y down, z forward), metres. DerenderError for anything else.
    """
    if text is None or (isinstance(text, str) and text.strip().lower() == "auto"):
        return None
    if isinstance(text, str):
        if text.strip().lower() == "none":
            return "none"
        text = text.replace(",", " ").split()
    try:
        plane = np.asarray(text, float).ravel()
    except (TypeError, ValueError):  # rows of different lengths, or words
        plane = np.empty(0)
    if plane.shape != (4,) or not np.isfinite(plane).all() or np.linalg.norm(plane[:3]) < 1e-9:
        remedy = "give auto, none, or four numbers a,b,c,d of the plane a x + b y + c z + d = 0 in camera axes"
        raise DerenderError("this is no floor", "--floor", remedy)
    return plane / np.linalg.norm(plane[:3])


def given_floor(depth: np.ndarray, camera: Camera, floor: np.ndarray | str) -> Floor:
    """Return the Floor of a plane (4,) or of "none".

    Without a floor its frame has the camera's up for z and lies far below everything, so that nothing rests on it.
    A given plane is taken as it is; its noise is measured on the points within 2 cm of it.
    """
    points = camera.points(depth)
    good = np.isfinite(depth) & (depth > 0)
    if good.sum() < 50:
        raise DerenderError(f"the image has only {good.sum()} pixels with depth", remedy="at least 50 are needed")
    if isinstance(floor, str):
        lowest = float(points[good][:, 1].max()) + FAR_BELOW
        return Floor(frame_of(np.array([0.0, -1.0, 0.0]), -lowest, points[good].mean(axis=0)),
                     pixel_noise(depth), np.zeros(depth.shape, bool))  # fmt: skip
    normal, offset = floor[:3], -floor[3]
    if offset > 0:  # towards the camera's side
        normal, offset = -normal, -offset
    if abs(offset) < 1e-6:
        raise DerenderError("the floor passes through the camera", "--floor", "give another plane")
    slope = np.maximum(np.abs((points / points[..., 2:]) @ normal), 0.05)
    residual = (points @ normal - offset) / slope
    near = good & (np.abs(residual * slope) < NEAR)
    if near.sum() < 20:
        raise DerenderError("hardly any point of the image lies within 2 cm of the floor given", "--floor",
                            "camera axes: x right, y down, z forward, metres; or --floor auto")  # fmt: skip
    sigma = max(scatter(residual[near]), 3e-4)
    inliers = near & (np.abs(residual) < 4 * sigma)
    return Floor(frame_of(normal, offset, points[inliers].mean(axis=0)), sigma, inliers)


def frame_of(normal: np.ndarray, offset: float, near: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of the frame in the plane normal . p = offset, z along the normal, origin under `near`."""
    along = [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 0.0, 1.0]
    return upright_frame(normal, along, near - (near @ normal - offset) * normal)


def pixel_noise(depth: np.ndarray) -> float:
    """Return the standard deviation of independent noise in metres, within what surfaces may have."""
    return float(np.clip(neighbour_noise(depth), 3e-4, MOST_NOISE))


def neighbour_noise(depth: np.ndarray) -> float:
    """Return the standard deviation of independent noise in metres, from second differences along the rows."""
    second = depth[:, :-2] - 2 * depth[:, 1:-1] + depth[:, 2:]
    second = second[np.isfinite(second)]
    return scatter(second) / np.sqrt(6) if len(second) >= 50 else 0.001


GRAZING = 0.15  # sine of the angle at which rays meet the floor
# Noise of the worst sensors (stereo, Kinect v1): metres, and metres a square metre. A floor that is off its plane by
# more is no plane, or not the floor; but where neighbours scatter so, by ROUGHER times less, it is noise.
SENSOR_SIGMA, SENSOR_GROWTH, ROUGHER = 0.002, 0.004, 3.0
SUREST = 5e-4  # metres: no image is taken to be surer than that


def noise_map(depth: np.ndarray, floor: Floor, camera: Camera) -> np.ndarray:
    """Return the standard deviation of the noise (H, W), fitted on the floor.

    Only where the floor is not met at a grazing angle: there its own tilt shows, not the noise.
    """
    if not floor.inliers.any():
        return np.full(depth.shape, floor.sigma)
    points = camera.points(depth)[floor.inliers]
    normal = floor.pose[:3, 2]
    slope = np.abs((points / points[:, 2:3]) @ normal)
    steep = slope >= max(GRAZING, np.quantile(slope, 0.3))  # >=: a wall right before the camera has one angle
    if steep.sum() < 3:
        return np.full(depth.shape, floor.sigma)
    points, slope = points[steep], slope[steep]
    z = points[:, 2]
    sigma, growth = noise_of((points - floor.pose[:3, 3]) @ normal / slope, z)
    close = median(z)
    deep = np.clip(np.nan_to_num(depth, nan=close), 0.3 * close, 4.0 * close)
    noise = sigma + growth * deep**2
    most = SENSOR_SIGMA + SENSOR_GROWTH * deep**2
    if (noise > most).any():
        most = np.maximum(most, ROUGHER * local_noise(depth, camera))
    return np.maximum(np.minimum(noise, most), SUREST)


def local_noise(depth: np.ndarray, camera: Camera) -> float:
    """Return the standard deviation of the noise about the planes through each pixel's neighbours, metres, the median.

    Noise that neighbours share shows in it by a third or so; solids, walls and bent floors do not show.
    """
    good = np.isfinite(depth) & (depth > 0)
    points = np.ascontiguousarray(np.nan_to_num(camera.points(depth)))
    jump = np.ascontiguousarray(np.nan_to_num(0.02 * depth))
    normal, offset, error = local_planes(points, good, np.zeros(3), jump, 2)
    fitted = good & (error < 1e8)
    if not fitted.any():
        return 0.0
    slope = np.abs(np.einsum("ij,ij->i", normal[fitted], points[fitted])) / np.linalg.norm(points[fitted], axis=1)
    return float(np.median(np.sqrt(error[fitted]) / np.maximum(slope, GRAZING)))


def drawn(depth: np.ndarray, floor: Floor, camera: Camera) -> bool:
    """Return whether an image shows its floor to within the fit's own fault: no sensor does, a renderer without noise.

    Neighbouring pixels are then off by the same, which would pass for a real sensor's bends.
    """
    return share_within(depth, floor, camera, SUREST / 5) > 0.99


def floor_depth(floor: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the depth (H, W) of a floor alone, inf where it is not met."""
    along = camera.rays() @ floor[:3, 2]
    with np.errstate(divide="ignore"):
        depth = (floor[:3, 3] @ floor[:3, 2]) / along
    return np.where(depth > 0.0, depth, np.inf)


def share_within(depth: np.ndarray, floor: Floor, camera: Camera, metres: float | np.ndarray) -> float:
    """Return the share of the pixels of the floor's near half that are off it by so many metres, of each, at most."""
    if not floor.inliers.any():
        return 0.0
    plane = floor_depth(floor.pose, camera)
    near = floor.inliers & (plane <= median(plane[floor.inliers]))
    return float((np.abs(depth - plane) <= metres)[near].mean())


def neighbour_correlation(depth: np.ndarray, floor: Floor, camera: Camera) -> float:
    """Return the correlation of the floor's residuals between neighbours in a row, the near half of the floor only.

    Near is where the plane is, not what was measured: from straight above the noise itself would choose the pixels.
    """
    if not floor.inliers.any():
        return 0.0
    normal = floor.pose[:3, 2]
    height = (camera.points(depth) - floor.pose[:3, 3]) @ normal
    distance = floor_depth(floor.pose, camera)
    near = floor.inliers & (distance <= median(distance[floor.inliers]))
    limit = 3 * scatter(height[near]) + 1e-6
    height = np.where(near & (np.abs(height) < limit), height, np.nan)
    a, b = height[:, :-1], height[:, 1:]
    both = np.isfinite(a) & np.isfinite(b)
    spread = np.nanvar(height)
    return float(np.mean(a[both] * b[both]) / spread) if both.sum() > 100 and spread > 0 else 0.0
