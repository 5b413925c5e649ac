"""A depth image made ready for the search: reduced, in the floor's axes, its noise known, its background told apart."""

import contextlib
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import LEVEL, Camera
from derender.camera.windows import greatest
from derender.detection.background import beyond_outline, main_part, quarter_turns, standing_bodies, walls_behind
from derender.detection.floor import (
    GRAZING,
    MOST_NOISE,
    NO_PLANE,
    ROOM,
    ROUGHEST,
    SAY_FLOOR,
    USUAL,
    Floor,
    NoFloor,
    bend_of,
    drawn,
    floor_beside,
    given_floor,
    neighbour_correlation,
    noise_map,
    pixel_noise,
    plane_through,
    scale_of,
    under_its_noise,
)
from derender.detection.floors import (
    SQUARE,
    WIDTHS,
    Candidate,
    find_backdrop,
    fitted,
    floors_of,
    near_at,
    near_plane,
    prior_of,
)
from derender.detection.patches import Patches, SeenSurface, find_patches, turned
from derender.detection.pyramid import blurred_jumps, estimate_blur, reduce, reduced_by, sampled, single_pixels, unmixed
from derender.detection.search.bodies import label_bodies
from derender.detection.solids.beliefs import bare_image
from derender.detection.solids.image import FAR, Image, make_image
from derender.detection.solids.misfit import AS_SEEN
from derender.results.fit import median, sensor_deviation
from derender.scene.priors.bare_image import Floors

# Where the residuals of neighbouring pixels on the floor are correlated beyond this, the frame is a real one: its
# solids differ from ideal ones by some millimetres too, and what neighbouring pixels say is not independent. (Of white
# noise .09 at most was measured, in 64 x 48 pixels and of a dithered image; of one that was enlarged .2 to .3 is left.)
CORRELATED = 0.2
MOST_SHARED = 0.98  # of the noise: of a bent floor neighbours would share all of it, and more
AWAY = 0.05  # metres, seen from USUAL, off what stands on it from which on a real sensor's floor is as it is seen
# Columns of an image of independent noise up to which all its pixels are drawn from where the search looks at half as
# many: where a jump lies within a pixel its blur tells, which no blur of the pixels of a smaller image explains.
MOST_DRAWN = 320
# Correlation of neighbours in such an image from which on single pixels of it are drawn from all the same: taken as
# independent they tell a fifth too much along each axis. (What was enlarged by two, or smoothed, passes for white noise
# in half as many pixels: of 12 scenes enlarged by interpolation four were told wrong at P .95.)
ALIKE = 0.1
# Pixels of a piece of background up to which it is made of outliers. Explained as it is the blur would mix it with
# those beside it, where it is not seen, and thin slabs explained them: of 20 images with 2 % of outliers three.
SPECKLE = 7
ONE_DEPTH = 0.01  # share of its depth by which what lies beyond the floor may vary and be a wall of one depth
HIDDEN_FLOOR = 0.3  # share of the pixels: where more show the floor, nothing fills the view
MARGIN = 0.01  # metres, seen from USUAL, beyond the outline of the visible floor that still count as over it
LOWEST = 0.004  # metres over the floor from which on something stands on it; less of it where it is nearer than USUAL
TOLD = 0.01  # the least probability at which another plane is told of
SURE_SHARE = 0.2  # of the pixels: the least that a plane holds that is one only when fitted closely
SAME = 0.5  # of a plane's pixels that are another's too, from which on it is the same floor


class Rival(NamedTuple):
    """A plane that may be the floor instead.

    plane : a, b, c, d of a x + b y + c z + d = 0, camera axes, (a, b, c) towards the camera.
    """

    plane: tuple[float, float, float, float]
    probability: float  # that it is the floor


class Observation(NamedTuple):
    """A depth image made ready for the search.

    correlation : of neighbouring pixels' residuals on the floor: near 0 for independent noise, .7 to .95 for real
        sensors.
    no_floor : whether no plane holds a tenth of the pixels, or that which does is rougher than any sensor makes it.
    bend : (H, W) metres that were added to the depths to make the floor a plane, see `bend_of`; None: none.
    things : the free-form ones among what stands there, each a `detection.things.Thing`; the image has their surface as
        it is seen.
    single : (H, W) metres, NaN = no return or left out: the pixels of the image as it came that what is found is drawn
        from: all, or those that the pixels of `image` stand for but those beside jumps of a blurred image.
    """

    image: Image  # Image in the floor frame, at working resolution
    floor: Floor
    points: np.ndarray  # (H, W, 3) float64 in the floor frame
    mask: np.ndarray  # (H, W) bool, pixels that solids must explain
    footprint: np.ndarray  # (H, W) metres across a pixel
    sigma: np.ndarray  # (H, W) metres of noise
    camera: Camera
    factor: int  # of reduction
    correlation: float
    background: float  # share of the pixels that show what is neither floor nor solid, and is taken as it is seen
    behind: np.ndarray  # (H, W) bool, those pixels; not those of the floor that are taken as they are seen
    single: np.ndarray
    single_camera: Camera
    beyond: np.ndarray  # (H, W) metres by which points lie beyond the outline of the visible floor, negative over it
    backdrop: bool  # whether that is a plane that would have been the floor, where there is to be none
    no_floor: bool = False
    bend: np.ndarray | None = None
    things: tuple = ()
    clutter: tuple = ()  # ((H, W) bool, probability): what is none of them, though it may be one
    cut_short: tuple = ()  # the same of what the image's border cuts: an arm, a piece of furniture, or an object
    interrupted: bool = False  # whether the search that looked at it was, so that what it found is the best so far
    agreed: bool = True  # whether two searches found the same
    wall: float | None = None  # metres to the one depth that lies behind everything, Eq. 6; None: none is seen
    rivals: tuple = ()  # planes that may be the floor instead, each a Rival, the likeliest first
    # (H, W) metres, and its camera: the image of independent noise as it came, where `single` is a part of its pixels
    whole: np.ndarray | None = None
    whole_camera: Camera | None = None

    @property
    def scale(self) -> float:
        """How large things are that are looked at from here, against those that are seen from USUAL; at most 1."""
        good = self.image.weight > 0
        return min(1.0, median(self.image.depth[good]) / USUAL) if good.any() else 1.0

    @property
    def other_floors(self) -> tuple[Rival, ...]:
        """The rivals, but for the room's floor below a table, which is there too."""
        a, b, c, d = plane_of(self.floor)
        return tuple(rival for rival in self.rivals
                     if np.dot(rival.plane[:3], [a, b, c]) < LEVEL or rival.plane[3] < d + ROOM)  # fmt: skip

    @property
    def surface(self) -> SeenSurface:
        """What the image shows, in the floor frame."""
        return SeenSurface.of(self.points, self.image.weight > 0, self.footprint, self.sigma, self.image.origin)

    @property
    def on_wall(self) -> np.ndarray:
        """(H, W) bool, the pixels that lie as deep as the wall does, and are to show no solid."""
        deep = self.image.depth > (1.0 - ONE_DEPTH) * (self.wall or np.inf)
        return deep & (self.image.weight > 0) & ~self.mask

    @property
    def floor_scale(self) -> float:
        """See `scale_of`: lengths by which background is told are as much shorter."""
        return scale_of(self.image.depth, self.floor)


class Support(NamedTuple):
    """A plane that is taken for the floor because another one, or others, are so already.

    normal, offset : of the plane at first sight, in camera axes: normal . p = offset.
    others : (H, W) bool, pixels of the image as it came that show the others or what stands on them; None: there are
        none, and it was the floor of the image in another resolution.
    """

    normal: np.ndarray
    offset: float
    others: np.ndarray | None

    @classmethod
    def over(cls, floor: Floor) -> "Support":
        """Return the Support that a Floor is for the same image in another resolution."""
        normal = floor.pose[:3, 2]
        return cls(normal, float(normal @ floor.pose[:3, 3]), None)


def observe(depth: np.ndarray, camera: Camera, widest: int = 160,
            plane: "np.ndarray | str | Support | None" = None, floating: bool = False,
            fills: bool = False, believed: Floors | None = None, shared: float = 0.0) -> Observation:  # fmt: skip
    """Reduce the image, find the floor and the noise, and tell the background from what stands on the floor.

    plane : the floor as it is given, see `read_floor`, or a Support; None: find it.
    floating : whether solids may hang in the air. fills : whether what is over a given floor stands there, all of it.
    believed : Floors of a prior; None: those of the built-in one. shared : the least that neighbours' noise correlates.
    """
    believed = bare_image().loose.floor if believed is None else believed
    whole, whole_camera = depth, camera
    factor = reduced_by(whole, widest)
    sigma = pixel_noise(whole)
    beside, blurred = blurred_jumps(whole, sigma) if factor > 1 else (np.zeros(whole.shape, bool), 0.0)
    depth, camera, factor = reduce(np.where(beside, np.nan, whole), camera, widest)
    if isinstance(plane, Support):
        others = None if plane.others is None else single_pixels(plane.others, factor) > 0.0
        alone = depth if others is None else np.where(others, np.nan, depth)
        seen_points = camera.points(alone)[np.isfinite(alone)]
        near = near_at(seen_points[:, 2], pixel_noise(depth))
        _, at = near_plane(seen_points, near, plane.normal, plane.offset)
        candidate = Candidate(plane.normal, plane.offset, at, 0.0)
        seen = over_candidate(depth, camera, factor, candidate, floating, others, shared)
        if seen is None:
            raise NoFloor(NO_PLANE, remedy=SAY_FLOOR)
    elif plane is not None:
        floor = given_floor(depth, camera, plane)
        # With --floor none nothing rests on a plane that fills the image; what is on it or beyond is background.
        backdrop = find_backdrop(depth, camera, believed) if isinstance(plane, str) else None
        seen = tell_apart(depth, camera, factor, floor, backdrop, floating, fills=fills, shared=shared)
    else:
        seen = likeliest(depth, camera, factor, floating, believed, shared)
    drawn_whole = seen.correlation <= CORRELATED and factor == 2 and reduced_by(whole, MOST_DRAWN) == 1
    if drawn_whole and not correlation_of_whole(seen, whole, whole_camera) > ALIKE:
        whole, _, _ = reduce(whole, whole_camera, whole.shape[1])
        return seen._replace(single=whole, single_camera=whole_camera)
    if seen.correlation > CORRELATED:  # what a real sensor shows at its edges is no mixture by a blur alone
        return seen._replace(single=single_pixels(np.where(beside, np.nan, whole), factor))
    single = single_pixels(unmixed(whole, beside, blurred, sigma), factor)
    return seen._replace(single=single, whole=whole if factor > 1 else None, whole_camera=whole_camera)


def likeliest(depth: np.ndarray, camera: Camera, factor: int, floating: bool, believed: Floors,
              shared: float = 0.0) -> Observation:  # fmt: skip
    """Return the Observation over the likeliest floor of a reduced image, the others as its rivals; or without a floor.

    Floors that come near the first are weighed by what they explain, see `odds_among`. Only what a sensor saw is
    weighed so; what is drawn shows the floor of its prior.
    """
    found: list[Observation] = []
    try:
        candidates = floors_of(depth, camera, camera.gravity, believed)
    except NoFloor:
        candidates = []
    for candidate in candidates:
        seen = over_candidate(depth, camera, factor, candidate, floating, shared=shared)
        if seen is None and not found:
            break  # the likeliest comes first: where it is none there is none
        if seen is None or any((seen.floor.inliers & other.floor.inliers).sum() > SAME * seen.floor.inliers.sum()
                               for other in found):  # fmt: skip
            continue
        found.append(seen)
        if seen.correlation <= CORRELATED:
            break
    if not found and pixel_noise(depth) >= MOST_NOISE:
        raise NoFloor(NO_PLANE, remedy=SAY_FLOOR)
    if not found:
        return without_floor(depth, camera, factor)
    odds = np.array([odds_among(seen, found, camera.gravity is not None, believed) for seen in found])
    probability = np.exp(odds - odds.max())
    probability /= probability.sum()
    order = np.argsort(-probability, kind="stable")
    rivals = tuple(Rival(plane_of(found[k].floor), float(probability[k])) for k in order[1:]
                   if probability[k] > TOLD)  # fmt: skip
    return found[order[0]]._replace(rivals=rivals)


def odds_among(seen: Observation, found: list[Observation], level: bool, believed: Floors) -> float:
    """Return the log odds in nats that the floor of one of the Observations `found` of an image is the floor.

    They explain what is on it and as much again at most that stands there; of what is on others parallel to it, which
    are further supports, or what it is itself a support of, and on others square to it, which are walls, or the floor
    before it, a part. level : whether they are known to be level.
    """
    normal, own = seen.floor.pose[:3, 2], seen.floor.inliers | seen.mask
    on, standing = seen.floor.inliers.sum(), seen.mask.sum()
    along = [(other.floor.inliers, abs(other.floor.pose[:3, 2] @ normal)) for other in found if other is not seen]
    told = [inliers for inliers, cosine in along if cosine > LEVEL or cosine < SQUARE]
    others = np.any(told, axis=0) & ~own if told else np.zeros_like(own)
    under = (seen.image.weight > 0) & (seen.points[..., 2] < -ROUGHEST * seen.sigma) & ~others
    explained = on + min(standing, on) + believed.parallel * others.sum() - believed.under * under.sum()
    prior = prior_of(normal[None], np.array([normal @ seen.floor.pose[:3, 3]]), level, believed)
    return float(prior[0] + believed.explained * np.log(max(explained, 1.0) / own.size))


def over_candidate(depth: np.ndarray, camera: Camera, factor: int, candidate: Candidate,
                   floating: bool, others: np.ndarray | None = None,
                   shared: float = 0.0) -> Observation | None:  # fmt: skip
    """Return the Observation of a reduced image over a Candidate, see `on_its_floor`; None where no plane fits."""
    alone = depth if others is None else np.where(others, np.nan, depth)
    points = camera.points(alone)
    for share in WIDTHS:
        with contextlib.suppress(NoFloor):
            floor = fitted(alone, points, candidate, share)
            if share < 1.0 and floor.inliers.mean() < SURE_SHARE:
                return None  # a hill is flat too where it is tried closely enough
            return on_its_floor(depth, camera, factor, floor, floating, others, shared)
    return None


def plane_of(floor: Floor) -> tuple[float, float, float, float]:
    """Return a, b, c, d of a Floor's plane a x + b y + c z + d = 0, in camera axes."""
    a, b, c = map(float, floor.pose[:3, 2])
    return a, b, c, -float(floor.pose[:3, 2] @ floor.pose[:3, 3])


def on_its_floor(depth: np.ndarray, camera: Camera, factor: int, floor: Floor,
                 floating: bool, others: np.ndarray | None = None, shared: float = 0.0) -> Observation:  # fmt: skip
    """Return the Observation of a reduced image whose floor was found at first sight; a sensor's is straightened.

    others : (h, w) bool, pixels that are explained otherwise, and background here; None: none.

    Raises NoFloor where what was taken as the floor is rougher than any sensor makes it.
    """
    if not max(shared_by_neighbours(depth, floor, camera), shared) > CORRELATED:
        floor = under_its_noise(floor, depth, camera)
    seen = tell_apart(depth, camera, factor, floor, None, floating, others, shared=shared)
    if seen.correlation <= CORRELATED:
        return seen
    bend = bend_of(depth, floor, camera)
    depth = depth + bend
    if bend.any():
        normal = floor.pose[:3, 2]
        points = camera.points(depth)
        floor = plane_through(depth, points, normal, normal @ floor.pose[:3, 3], floor.sigma)
    if seen.mask.any():
        floor = floor_beside(floor, depth, camera, seen.mask)
    if floor.sigma > ROUGHEST * sensor_deviation(median(depth[floor.inliers])):
        raise NoFloor("no plane is one that things could stand on")
    straight = tell_apart(depth, camera, factor, floor, None, floating, others, shared=shared)
    # The bend is taken from the floor alone: what stands there is off by as much as before, over as many pixels.
    return straight._replace(bend=bend, correlation=seen.correlation)


def shared_by_neighbours(depth: np.ndarray, floor: Floor, camera: Camera) -> float:
    """Return the correlation of neighbouring pixels' noise, see `Observation`."""
    return 0.0 if drawn(depth, floor, camera) else neighbour_correlation(depth, floor, camera)


def correlation_of_whole(seen: Observation, depth: np.ndarray, camera: Camera) -> float:
    """Return the correlation of neighbouring pixels' noise in the image (H, W) as it came, of an Observation of it."""
    floor = seen.floor._replace(inliers=of_whole_image(seen.floor.inliers, seen, depth.shape))
    return shared_by_neighbours(depth, floor, camera)


def without_floor(depth: np.ndarray, camera: Camera, factor: int) -> Observation:
    """Return the Observation of an image without a plane that could be the floor: all is background as it is seen."""
    seen = tell_apart(depth, camera, factor, given_floor(depth, camera, "none"), None)
    off = seen.image.weight > 0
    seen.image.floor[off] = seen.image.depth[off]
    return seen._replace(mask=np.zeros_like(off), behind=off, background=1.0, no_floor=True, correlation=1.0)


def tell_apart(depth: np.ndarray, camera: Camera, factor: int, floor: Floor, backdrop: Any,
               floating: bool = False, others: Any = None, fills: bool = False,
               shared: float = 0.0) -> Observation:  # fmt: skip
    """Return the Observation of a reduced image: its noise, and its background apart from what stands on the floor.

    backdrop : what find_backdrop says, None for nothing.
    others : (h, w) bool, what another floor explains: background of this one; None: nothing. fills, shared : see
        `observe`.
    """
    even, beyond = (floor, np.zeros(depth.shape, bool)) if backdrop is None else backdrop
    sigma = noise_map(depth, even, camera)
    correlation = max(shared_by_neighbours(depth, even, camera), shared)
    own = np.sqrt(1.0 - np.clip(correlation, 0.0, MOST_SHARED))  # noise that neighbours share hides no leak
    blur = estimate_blur(depth, own * sigma)
    if correlation > CORRELATED:
        sigma = np.hypot(sigma, np.fmin(bare_image().loose.faces, sensor_deviation(depth)))
    image = make_image(depth, sigma, camera, floor.pose, blur)
    on_wall, wall = raise_wall(image)
    points = camera.points(depth) - floor.pose[:3, 3]
    points = np.ascontiguousarray(np.nan_to_num(points @ floor.pose[:3, :3]))
    good = image.weight > 0
    footprint = np.nan_to_num(depth) / camera.fx
    beyond_edge = beyond_outline(points, main_part(points, floor.inliers, footprint, image.origin), good, image.origin)
    scale = scale_of(depth, floor)
    inside = good & (beyond_edge < MARGIN * scale)
    above = good & (points[..., 2] > np.maximum(LOWEST * scale, 4 * sigma))
    own = good if others is None else good & ~others
    # From here to the mask lengths are counted in this scale.
    there, eye, wide, rough = (each / scale for each in (points, image.origin, footprint, sigma))
    if not fills:
        beyond |= walls_behind(there, own, above & own, rough, eye) | (good & ~own)
    held = above & (fills and others is None and floor.inliers.sum() < HIDDEN_FLOOR * good.sum())
    inside |= held
    mask = above & inside & ~beyond
    if floor.inliers.any():
        surface, real = SeenSurface.of(there, good, wide, rough, eye), correlation > CORRELATED
        turns = quarter_turns(floor.pose[:3, 2])
        over, edge, fast = (turned(each, turns) for each in (above & ~beyond, beyond_edge / scale, held))
        mask = turned(standing_bodies(surface.turned(turns), over, edge, fast, floating, real), -turns)
    # What lies beyond the table's edge is background: explained as it is, so that a solid before it would be wrong.
    background = good & (((points[..., 2] < -5 * sigma) & (image.depth > image.floor)) | ~inside | above) & ~mask
    background = (background & ~on_wall) | beyond
    if correlation <= CORRELATED:
        background &= ~small_pieces(points, background)
    image.floor[background] = image.depth[background] + 1e-9

    # Near the horizon a hair's breadth of tilt moves the floor by centimetres: what is about as deep is the floor.
    slope = -image.direction[..., 2]
    grazing = good & (slope < GRAZING) & (np.abs(image.depth - image.floor) < 0.05 * image.depth)
    image.floor[grazing] = image.depth[grazing]
    if correlation > CORRELATED:  # the sensor bends the plane: a solid that smooths that out is none
        away = good & ~mask & ~greatest(mask, int(AWAY * scale / median(footprint[good])) + 1)
        image.floor[away] = image.depth[away]
    share = float(background.sum() / max(good.sum(), 1))
    return Observation(image, floor, points, mask, footprint, sigma, camera, factor, correlation, share, background,
                       depth, camera, beyond_edge, backdrop is not None, wall=wall)  # fmt: skip


def small_pieces(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: the pixels of a mask that at most SPECKLE of it, side by side or cornerwise, join, however
    far apart their points (H, W, 3) are."""
    piece, count = label_bodies(points, mask, np.full(mask.shape, np.inf))
    return mask & (np.append(np.bincount(piece[mask], minlength=count), 0)[piece] <= SPECKLE)


def nearest_pixels(count: int, factor: int, among: int, others: int) -> np.ndarray:
    """Return (count,) int: of `among` pixels of an image reduced by `others` those nearest to one's by `factor`."""
    place = np.arange(count) * factor + sampled(factor)
    return np.clip(np.rint((place - sampled(others)) / others), 0, among - 1).astype(int)


def of_whole_image(mask: np.ndarray, seen: Observation, shape: tuple[int, int]) -> np.ndarray:
    """Return what is known of each pixel of an Observation's image, (h, w), of the image (H, W) as it came."""
    if shape == mask.shape:
        return mask
    rows, columns = (nearest_pixels(after, 1, before, seen.factor)
                     for after, before in zip(shape, mask.shape, strict=True))  # fmt: skip
    return mask[rows[:, None], columns]


def whole_image(seen: Observation, depth: np.ndarray, camera: Camera) -> Image:
    """Return the Image of all pixels of a depth image (H, W) as it came, taken as an Observation of it takes them.

    Pixels of a block weigh together what the one that stands for them weighs where it is searched.
    """
    if seen.factor == 1:
        return seen.image
    there = partial(of_whole_image, seen=seen, shape=depth.shape)
    weight, bend = there(seen.image.weight), 0.0 if seen.bend is None else there(seen.bend)
    sigma = seen.factor * np.sqrt(0.5 / np.where(weight > 0, weight, 1.0))
    image = make_image(np.where(weight > 0, depth + bend, np.nan), sigma, camera, seen.floor.pose)
    as_seen = there((np.abs(seen.image.floor - seen.image.depth) < AS_SEEN) & (seen.image.weight > 0))
    image.floor[as_seen] = image.depth[as_seen]
    return image


def raise_wall(image: Image) -> tuple[np.ndarray, float | None]:
    """Where what lies beyond the floor is one depth (the wall of Eq. 6), put it behind the floor, in place.

    Returns (H, W) bool, the pixels of the wall, and the metres to it, None where there is none.
    """
    sky = (image.floor >= FAR) & (image.weight > 0)
    none = np.zeros(sky.shape, bool)
    if sky.sum() < 50:
        return none, None
    seen = image.depth[sky]
    wall = float(np.median(seen))
    nearer = image.depth[(image.weight > 0) & ~sky]
    # a tall solid before the horizon is of one depth too, but not behind nearly all else
    if np.median(np.abs(seen - wall)) > ONE_DEPTH * wall or (len(nearer) and wall < np.quantile(nearer, 0.9)):
        return none, None
    beyond = image.floor > wall
    image.floor[beyond] = wall
    return beyond, wall


def patches_of(seen: Observation) -> Patches:
    """Return the planar patches of what stands on the floor."""
    return find_patches(seen.points, seen.mask, seen.image.origin, seen.sigma, seen.footprint)
