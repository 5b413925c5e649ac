"""A depth image made ready for the search: reduced, in the floor's axes, its noise known, its background told apart."""

from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.background import joined_to_floor, standing_bodies, walls_behind
from derender.detection.floor import (
    MOST_NOISE,
    Floor,
    NoFloor,
    back_project,
    bend_of,
    find_backdrop,
    find_floor,
    floor_beside,
    given_floor,
    pixel_noise,
    plane_through,
    sensor_deviation,
)
from derender.detection.local_planes import local_planes
from derender.detection.noise import estimate_blur, noise_of
from derender.detection.outline import convex_outline, outline_planes
from derender.detection.patches import Patches, find_patches
from derender.detection.pyramid import reduce, sampled, single_pixels
from derender.detection.search.bodies import APART, label_bodies
from derender.detection.solids.beliefs import bare_image
from derender.detection.solids.image import FAR, Image, make_image

# Where the residuals of neighbouring pixels on the floor are correlated beyond this, the frame is a real one: its
# solids differ from ideal ones by some millimetres too, and what neighbouring pixels say is not independent.
CORRELATED = 0.3
MOST_SHARED = 0.98  # of the noise: of a bent floor neighbours would share all of it, and more
AWAY = 0.05  # metres from what stands on it from which on a real sensor's floor is as it is seen
GRAZING = 0.15  # sine of the angle at which rays meet the floor
HIDDEN_FLOOR = 0.3  # share of the pixels: where more show the floor, nothing fills the view
MAIN = 0.1  # of the floor's largest piece in pixels: smaller pieces of its plane lie there by chance
MARGIN = 0.01  # metres beyond the outline of the visible floor that still count as over it
# Noise of the worst sensors (stereo, Kinect v1): metres, and metres a square metre. A floor that is off its plane by
# more is no plane, or not the floor; but where neighbours scatter so, by ROUGHER times less, it is noise.
SENSOR_SIGMA, SENSOR_GROWTH, ROUGHER = 0.002, 0.004, 3.0
NO_FLOOR = 6.0  # standard deviations of consumer sensors by which a floor is off its plane at most
TOLERANCE = 0.008  # metres off a plane, as it is seen at first, that points on it may be
LEAST_SIGMA = 5e-4  # metres: no image is taken to be surer than that
USUAL = 0.8  # metres from which household things are looked at; from nearer, smaller ones


class Observation(NamedTuple):
    """A depth image made ready for the search.

    Attributes
    ----------
    image : Image in the floor frame, at working resolution.
    floor : Floor; points : (H, W, 3) float64 in the floor frame; mask : (H, W) bool, pixels that solids must explain.
    footprint : (H, W) metres across a pixel; sigma : (H, W) metres of noise; camera : dict; factor : of reduction.
    correlation : of neighbouring pixels' residuals on the floor: near 0 for independent noise, .7 to .95 for real
        sensors.
    background : share of the pixels that show what is neither floor nor solid, and is taken as it is seen.
    behind : (H, W) bool, those pixels; not those of the floor that are taken as they are seen.
    no_floor : whether no plane holds a tenth of the pixels, or that which does is rougher than any sensor makes it.
    bend : (H, W) metres that were added to the depths to make the floor a plane, see `bend_of`; None: none.
    beyond : (H, W) metres by which points lie beyond the outline of the visible floor, negative over it.
    things : the free-form ones among what stands there, each a `detection.things.Thing`; the image has their surface as
        it is seen.
    single : (H, W) metres, NaN = no return: the pixels of the image as it came that those of `image` stand for.
    backdrop : whether that is a plane that would have been the floor, where there is to be none.
    interrupted : whether the search that looked at it was, so that what it found is the best so far.
    agreed : whether two searches found the same.
    """

    image: Image
    floor: Floor
    points: np.ndarray
    mask: np.ndarray
    footprint: np.ndarray
    sigma: np.ndarray
    camera: dict
    factor: int
    correlation: float
    background: float
    behind: np.ndarray
    single: np.ndarray
    beyond: np.ndarray
    backdrop: bool
    no_floor: bool = False
    bend: np.ndarray | None = None
    things: tuple = ()
    interrupted: bool = False
    agreed: bool = True

    @property
    def scale(self) -> float:
        """How large things are that are looked at from here, against those that are seen from USUAL; at most 1."""
        good = self.image.weight > 0
        return min(1.0, float(np.median(self.image.depth[good])) / USUAL) if good.any() else 1.0


class Support(NamedTuple):
    """A plane that is taken for the floor because another one, or others, are so already.

    Attributes
    ----------
    normal, offset : of the plane at first sight, in camera axes: normal . p = offset.
    others : (H, W) bool, pixels of the image as it came that show the others or what stands on them.
    """

    normal: np.ndarray
    offset: float
    others: np.ndarray


def observe(depth: np.ndarray, camera: Camera | dict[str, float], widest: int = 160,
            plane: np.ndarray | str | None = None, floating: bool = False,
            fills: bool = False) -> Observation:  # fmt: skip
    """Reduce the image, find the floor and the noise, and tell the background from what stands on the floor.

    plane : the floor as it is given, see `read_floor`, or a Support; None: find it.
    floating : whether solids may hang in the air. fills : whether what is over a given floor stands there, all of it.
    """
    rounding = rounding_of(depth)
    gravity = getattr(camera, "gravity", None)  # a mapping of four numbers knows none
    whole = depth
    depth, camera, factor = reduce(whole, camera, widest)
    if isinstance(plane, Support):
        others = single_pixels(plane.others, factor) > 0.0
        alone = np.where(others, np.nan, depth)
        floor = plane_through(alone, back_project(alone, camera), plane.normal, plane.offset, TOLERANCE)
        seen = on_its_floor(depth, camera, factor, floor, rounding, floating, others)
    elif plane is not None:
        floor = given_floor(depth, camera, plane)
        # With --floor none nothing rests on a plane that fills the image; what is on it or beyond is background.
        backdrop = find_backdrop(depth, camera) if isinstance(plane, str) else None
        seen = tell_apart(depth, camera, factor, floor, backdrop, rounding, floating, fills=fills)
    else:
        try:
            seen = on_its_floor(depth, camera, factor, find_floor(depth, camera, gravity=gravity), rounding, floating)
        except NoFloor:
            if pixel_noise(depth) >= MOST_NOISE:
                raise
            seen = without_floor(depth, camera, factor, rounding)
    return seen._replace(single=single_pixels(whole, factor))


def on_its_floor(depth: np.ndarray, camera: dict[str, float], factor: int, floor: Floor, rounding: float,
                 floating: bool, others: Any = None) -> Observation:  # fmt: skip
    """Return the Observation of a reduced image whose floor was found at first sight; a sensor's is straightened.

    others : (h, w) bool, pixels that are explained otherwise, and background here; None: none.

    Raises NoFloor where what was taken as the floor is rougher than any sensor makes it.
    """
    seen = tell_apart(depth, camera, factor, floor, None, rounding, floating, others)
    if seen.correlation <= CORRELATED:
        return seen
    bend = bend_of(depth, floor, camera)
    depth = depth + bend
    if bend.any():
        normal = floor.pose[:3, 2]
        points = back_project(depth, camera)
        floor = plane_through(depth, points, normal, normal @ floor.pose[:3, 3], floor.sigma)
    if seen.mask.any():
        floor = floor_beside(floor, depth, camera, seen.mask)
    if floor.sigma > NO_FLOOR * sensor_deviation(float(np.median(depth[floor.inliers]))):
        raise NoFloor("no plane is one that things could stand on")
    straight = tell_apart(depth, camera, factor, floor, None, rounding, floating, others)
    # The bend is taken from the floor alone: what stands there is off by as much as before, over as many pixels.
    return straight._replace(bend=bend, correlation=seen.correlation)


def without_floor(depth: np.ndarray, camera: dict[str, float], factor: int, rounding: float) -> Observation:
    """Return the Observation of an image without a plane that could be the floor: all is background as it is seen."""
    seen = tell_apart(depth, camera, factor, given_floor(depth, camera, "none"), None, rounding)
    off = seen.image.weight > 0
    seen.image.floor[off] = seen.image.depth[off]
    return seen._replace(mask=np.zeros_like(off), behind=off, background=1.0, no_floor=True, correlation=1.0)


def tell_apart(depth: np.ndarray, camera: dict[str, float], factor: int, floor: Floor, backdrop: Any, rounding: float,
               floating: bool = False, others: Any = None, fills: bool = False) -> Observation:  # fmt: skip
    """Return the Observation of a reduced image: its noise, and its background apart from what stands on the floor.

    backdrop : what find_backdrop says, None for nothing. rounding : metres, see `rounding_of`.
    others : (h, w) bool, what another floor explains: background of this one; None: nothing. fills : see `observe`.
    """
    even, beyond = (floor, np.zeros(depth.shape, bool)) if backdrop is None else backdrop
    sigma = noise_map(depth, even, camera)
    correlation = 0.0 if drawn(depth, even, camera, rounding) else neighbour_correlation(depth, even, camera)
    own = np.sqrt(1.0 - np.clip(correlation, 0.0, MOST_SHARED))  # noise that neighbours share hides no leak
    blur = estimate_blur(depth, own * sigma)
    if correlation > CORRELATED:
        sigma = np.hypot(sigma, np.fmin(bare_image().loose.faces, sensor_deviation(depth)))
    image = make_image(depth, sigma, camera, floor.pose, blur)
    wall = raise_wall(image)
    points = back_project(depth, camera) - floor.pose[:3, 3]
    points = np.ascontiguousarray(np.nan_to_num(points @ floor.pose[:3, :3]))
    good = image.weight > 0
    footprint = np.nan_to_num(depth) / camera["fx"]
    beyond_edge = beyond_outline(points, main_part(points, floor.inliers, footprint, image.origin), good, image.origin)
    inside = good & (beyond_edge < MARGIN)
    above = good & (points[..., 2] > np.maximum(0.004, 4 * sigma))
    own = good if others is None else good & ~others
    if not fills:
        beyond |= walls_behind(points, own, above & own, sigma, image.origin) | (good & ~own)
    held = np.zeros(good.shape, bool)
    if others is None and floor.inliers.sum() < HIDDEN_FLOOR * good.sum():
        held = above if fills else joined_to_floor(points, above & ~beyond, inside, footprint, image.origin[2])
        inside |= held
    mask = above & inside & ~beyond
    if floor.inliers.any():
        mask = standing_bodies(
            points,
            above & ~beyond,
            beyond_edge,
            good,
            footprint,
            sigma,
            image.origin,
            held,
            floating,
            correlation > CORRELATED,
        )
    # What lies beyond the table's edge is background: explained as it is, so that a solid before it would be wrong.
    background = good & (((points[..., 2] < -5 * sigma) & (image.depth > image.floor)) | ~inside | above) & ~mask
    background = (background & ~wall) | beyond
    image.floor[background] = image.depth[background] + 1e-9

    # Near the horizon a hair's breadth of tilt moves the floor by centimetres: what is about as deep is the floor.
    slope = -image.direction[..., 2]
    grazing = good & (slope < GRAZING) & (np.abs(image.depth - image.floor) < 0.05 * image.depth)
    image.floor[grazing] = image.depth[grazing]
    if correlation > CORRELATED:  # the sensor bends the plane: a solid that smooths that out is none
        away = good & ~mask & ~near(mask, int(AWAY / np.median(footprint[good])) + 1)
        image.floor[away] = image.depth[away]
    share = float(background.sum() / max(good.sum(), 1))
    return Observation(image, floor, points, mask, footprint, sigma, camera, factor, correlation, share, background,
                       depth, beyond_edge, backdrop is not None)  # fmt: skip


def nearest_pixels(count: int, factor: int, among: int, others: int) -> np.ndarray:
    """Return (count,) int: of `among` pixels of an image reduced by `others` those nearest to one's by `factor`."""
    place = np.arange(count) * factor + sampled(factor)
    return np.clip(np.rint((place - sampled(others)) / others), 0, among - 1).astype(int)


def of_whole_image(mask: np.ndarray, seen: Observation, shape: tuple[int, int]) -> np.ndarray:
    """Return what is known of each pixel of an Observation's image, (h, w), of the image (H, W) as it came."""
    rows, columns = (nearest_pixels(after, 1, before, seen.factor)
                     for after, before in zip(shape, mask.shape, strict=True))  # fmt: skip
    return mask[rows[:, None], columns]


def near(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return (H, W) bool: pixels with one of the mask in the square of `reach` pixels about them."""
    sums = np.pad(mask.astype(np.int64), ((reach + 1, reach), (reach + 1, reach))).cumsum(axis=0).cumsum(axis=1)
    side = 2 * reach + 1
    return sums[side:, side:] + sums[:-side, :-side] > sums[:-side, side:] + sums[side:, :-side]


def raise_wall(image: Image) -> np.ndarray:
    """Where what lies beyond the floor is one depth (the wall of Eq. 6), put it behind the floor, in place.

    Returns (H, W) bool: the pixels of the wall.
    """
    sky = (image.floor >= FAR) & (image.weight > 0)
    none = np.zeros(sky.shape, bool)
    if sky.sum() < 50:
        return none
    seen = image.depth[sky]
    wall = float(np.median(seen))
    nearer = image.depth[(image.weight > 0) & ~sky]
    # a tall solid before the horizon is of one depth too, but not behind nearly all else
    if np.median(np.abs(seen - wall)) > 0.01 * wall or (len(nearer) and wall < np.quantile(nearer, 0.9)):
        return none
    beyond = image.floor > wall
    image.floor[beyond] = wall
    return beyond


def noise_map(depth: np.ndarray, floor: Floor, camera: dict[str, float]) -> np.ndarray:
    """Return the standard deviation of the noise (H, W), fitted on the floor.

    Only where the floor is not met at a grazing angle: there its own tilt shows, not the noise.
    """
    if not floor.inliers.any():
        return np.full(depth.shape, floor.sigma)
    points = back_project(depth, camera)[floor.inliers]
    normal = floor.pose[:3, 2]
    slope = np.abs((points / points[:, 2:3]) @ normal)
    steep = slope >= max(GRAZING, np.quantile(slope, 0.3))  # >=: a wall right before the camera has one angle
    if steep.sum() < 3:
        return np.full(depth.shape, floor.sigma)
    points, slope = points[steep], slope[steep]
    z = points[:, 2]
    sigma, growth = noise_of((points - floor.pose[:3, 3]) @ normal / slope, z)
    close = np.median(z)
    deep = np.clip(np.nan_to_num(depth, nan=close), 0.3 * close, 4.0 * close)
    noise = sigma + growth * deep**2
    most = np.maximum(SENSOR_SIGMA + SENSOR_GROWTH * deep**2, ROUGHER * local_noise(depth, camera))
    return np.maximum(np.minimum(noise, most), LEAST_SIGMA)


def local_noise(depth: np.ndarray, camera: dict[str, float]) -> float:
    """Return the standard deviation of the noise about the planes through each pixel's neighbours, metres, the median.

    Noise that neighbours share shows in it by a third or so; solids, walls and bent floors do not show.
    """
    good = np.isfinite(depth) & (depth > 0)
    points = np.ascontiguousarray(np.nan_to_num(back_project(depth, camera)))
    jump = np.ascontiguousarray(np.nan_to_num(0.02 * depth))
    normal, offset, error = local_planes(points, good, np.zeros(3), jump, 2)
    fitted = good & (error < 1e8)
    if not fitted.any():
        return 0.0
    slope = np.abs(np.einsum("ij,ij->i", normal[fitted], points[fitted])) / np.linalg.norm(points[fitted], axis=1)
    return float(np.median(np.sqrt(error[fitted]) / np.maximum(slope, GRAZING)))


def rounding_of(depth: np.ndarray) -> float:
    """Return the metres to which a depth image (H, W) was rounded: the smallest step between some of its values."""
    seen = depth[depth > 0]
    steps = np.diff(np.sort(seen[:: max(1, len(seen) // 4000)]))
    return float(min(steps[steps > 1e-9], default=0.0))


def drawn(depth: np.ndarray, floor: Floor, camera: dict[str, float], rounding: float) -> bool:
    """Return whether an image shows its floor to within its own rounding: no sensor does, a renderer without noise.

    Neighbouring pixels are then off by the same, which would pass for a real sensor's bends.
    """
    if not floor.inliers.any():
        return False
    normal = floor.pose[:3, 2]
    plane = floor.pose[:3, 3] @ normal / (back_project(np.ones_like(depth), camera) @ normal)
    near = floor.inliers & (plane <= np.median(plane[floor.inliers]))
    met = np.abs(depth - plane)[near] <= max(0.6 * rounding, LEAST_SIGMA / 5)  # half a step, and the fit's own fault
    return bool(met.mean() > 0.99)


def neighbour_correlation(depth: np.ndarray, floor: Floor, camera: dict[str, float]) -> float:
    """Return the correlation of the floor's residuals between neighbours in a row, the near half of the floor only.

    Near is where the plane is, not what was measured: from straight above the noise itself would choose the pixels.
    """
    if not floor.inliers.any():
        return 0.0
    normal = floor.pose[:3, 2]
    height = (back_project(depth, camera) - floor.pose[:3, 3]) @ normal
    distance = floor.pose[:3, 3] @ normal / (back_project(np.ones_like(depth), camera) @ normal)
    near = floor.inliers & (distance <= np.median(distance[floor.inliers]))
    limit = 3 * 1.4826 * np.median(np.abs(height[near])) + 1e-6
    height = np.where(near & (np.abs(height) < limit), height, np.nan)
    a, b = height[:, :-1], height[:, 1:]
    both = np.isfinite(a) & np.isfinite(b)
    spread = np.nanvar(height)
    return float(np.mean(a[both] * b[both]) / spread) if both.sum() > 100 and spread > 0 else 0.0


def main_part(points: np.ndarray, inliers: np.ndarray, footprint: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: the pixels on the floor's plane without those apart from it that lie there by chance."""
    slope = np.abs(points[..., 2] - origin[2]) / np.linalg.norm(points - origin, axis=-1)  # of the rays to the floor
    part, count = label_bodies(points, inliers, np.ascontiguousarray(APART * footprint / np.maximum(slope, 1e-3)))
    pixels = np.bincount(part[part >= 0], minlength=max(count, 1))
    return inliers & (pixels[part] > MAIN * pixels.max())


def beyond_outline(points: np.ndarray, inliers: np.ndarray, good: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return (H, W) metres by which points lie beyond the hull of the floor's visible part and the camera's foot.

    Negative over the hull, and -inf everywhere where there is none.

    origin : (3,) the camera's centre: what stands before the visible floor is no background.
    """
    flat = points[inliers][:, :2]
    outline = convex_outline(np.vstack([flat[:: max(1, len(flat) // 3000)], origin[:2]]))
    if outline is None:
        return np.full(good.shape, -np.inf)
    planes = outline_planes(outline)
    beyond = np.full(good.shape, -np.inf)
    beyond[good] = (points[good][:, :2] @ planes[:, :2].T + planes[:, 2]).max(axis=1)
    return beyond


def patches_of(seen: Observation) -> Patches:
    """Return the planar patches of what stands on the floor."""
    return find_patches(seen.points, seen.mask, seen.image.origin, seen.sigma, seen.footprint)
