"""Free-form things: bodies of pixels over the support that primitives do not explain become one thing each.

Whether some primitives or a free-form surface explain a body is a matter of description length. A surface that is
anyhow smooth needs a number for each patch beyond what its neighbours tell, and as many again for each patch's length
of an edge or a jump within it; what they cost the prior's file says (`Things`). A
primitive costs what the search asks for it, and its misfit. So a box that fits stays a box, whatever its size, and a
bowl is not eight of them.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from derender.camera.windows import greatest, least, total
from derender.compilation.cache import njit
from derender.detection.background import cut_short, frame_seen, is_background, quarter_turns
from derender.detection.freestanding import LEAST_EXISTENCE, existence_of
from derender.detection.outline import ends_of, foot_radius, sloping_foot, vertical_axis
from derender.detection.patches import components, separation, straightest, turned
from derender.detection.search.bodies import label_bodies
from derender.detection.search.greedy import Settings, total_energy
from derender.detection.search.observation import CORRELATED, HIDDEN_FLOOR, LOWEST, Observation
from derender.detection.search.proposals import smallest_rectangle
from derender.detection.segments import joined, segments
from derender.detection.solids.image import FAR, Image, make_row
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.misfit import AS_SEEN, LIMIT, WALL
from derender.detection.solids.state import FLOOR, State, held_out, subset
from derender.detection.solids.support import flat_top, share_over
from derender.results.fit import NOISES, STEP, means_about, median
from derender.scene.pose import rotation_z
from derender.scene.priors.bare_image import Things
from derender.scene.solids import BOX

CREASE = np.cos(np.radians(35.0))  # of the normals two pixels before and after an edge
BAD = 4.5  # misfit of a pixel that is not explained
NOISE, SOME = 0.5, 2  # misfit that noise leaves of a pixel; reach of a window over which it leaves about that
FEW_ABOUT = 6  # pixels of a window that go on in depth, that one with them, of which none tells what noise is there
STRAIGHTEST = 3.6 / 1.5  # by which what noise leaves along the straightest of four lines through a pixel is less
LEAST_WEIGHT = 1.0  # of a pixel, per square metre: noise of 0.7 m
FEWEST = 12  # pixels of a thing
INNER = 0.25  # share of its pixels that have it on all four sides: less is a seam along a silhouette
LARGEST = 0.6  # metres: what is larger is furniture or a wall
LEAST_HEIGHT = 0.012  # metres over its support
ENDS = 0.005  # share of the points beyond the ends of the bounding box: flying pixels
NEAR_TOP = 0.02  # metres between a thing's lowest point seen and the top of what it may stand on
THINNEST = 0.004  # metres of any extent
AROUND = 36  # points of a circle
BESIDE = 1.15  # of the radius of what is round: what lies farther from its axis is a handle, along which its box lies
# Of the root of its width times its height, how deep a thing is whose back is not seen, and what it shows of it then.
DEPTH, SHALLOW = 0.7, 0.35
# Standard deviations of the blur within which a silhouette shows what is behind; the share of a mask's pixels that are
# to lie farther from its edge, at least.
SMEARED, CLEAR = 2.0, 0.3
LOW = 2.0  # standard deviations over the floor from which on a pixel beside a thing is a part of it; alone: four
# Of a solid's silhouette, less what others of the scene hide, the least that shows it: what fits a few pixels and would
# be seen where something nearer is, or nothing returned, is there by chance. (Of 26 solids on labelled frames two, both
# wrong, showed in under .13 of it; all others in .60 or more.)
LEAST_SHOWN = 0.25
# Share of what the border cuts, and seems to be an arm or a wall for that, that is an object after all: of ten such
# pieces of labelled frames, cropped in many ways, four.
CUT_SHORT = 0.5
BENEATH = 0.5  # share of a thing's points over a solid's top from which on it stands there


class Thing(NamedTuple):
    """A free-form thing.

    away : (3,) along its box's axes, the level unit vector away from the camera, on which side what is hidden of it
        reaches farther than its box; zeros of what is round, for whose far side the axis tells.
    guessed : (3,) metres of its box that nothing shows, but that household things are as deep.
    """

    mask: np.ndarray  # (H, W) bool, the pixels that show it
    row: np.ndarray  # (ROW,) float64, its upright bounding box as a solid's row, down to what it stands on
    parent: int  # FLOOR, or the index of the solid that it stands on
    existence: tuple[float, float]  # (probability that it is one object, neither clutter nor several; its error)
    away: np.ndarray
    guessed: np.ndarray = np.zeros(3)
    clutter: float = 0.0  # probability that it is no object at all


class Cost(NamedTuple):
    """What free-form surfaces cost: maps (H, W) of square metres, of metres of edges, and of misfit that noise leaves;
    normals; what is believed of them."""

    area: np.ndarray
    crease: np.ndarray
    misfit: np.ndarray
    normal: np.ndarray
    believed: Things

    def numbers(self, mask: np.ndarray) -> float:
        """Return the nats that the numbers of the surface cost that a mask (H, W) shows."""
        area, crease = float(self.area[mask].sum()), float(self.crease[mask].sum())
        patch = self.believed.patch * self.believed.larger(area)
        return self.believed.number * (area / patch**2 + crease / patch)


def take_things(
    seen: Observation, state: State, settings: Settings, reluctance: float = 0.0
) -> tuple[State, list[np.ndarray]]:
    """Return (State of the solids that stay, [mask] of what is free-form) that explain the image best.

    A mask is (H, W) bool. What is free-form explains its pixels from then on: the image has them as they are seen, so
    that solids leave them alone.

    seen : Observation; its image is changed. state : State of the solids that the search found.
    reluctance : nats by which a free-form thing must be better than the solids that it takes the place of, or nothing.
    """
    image = seen.image
    as_seen = np.abs(image.floor - image.depth) < AS_SEEN
    seen = seen._replace(mask=seen.mask & ~as_seen)
    body, count = label_bodies(seen.points, seen.mask, seen.surface.jump)
    if count == 0:
        return state, []
    cost = cost_of(seen, settings.believed.loose.things)
    keep, clear = set(range(len(state))), without_edges(seen, state)
    for members in groups_of(image, state, body, count):
        keep = best_subset(clear, state, keep, members, cost, settings, reluctance)
    kept = subset(state, keep)
    things, _ = pieces_of(without_edges(seen, kept), kept, cost, settings, settings.temper * reluctance)
    for mask in things:
        image.floor[mask] = image.depth[mask] + 0.5 * AS_SEEN
    return kept, things


def without_edges(seen: Observation, state: State) -> Observation:
    """Return the Observation without the pixels that the edges of a state's solids mix, where noise is independent."""
    if seen.correlation > CORRELATED:
        return seen
    image = seen.image
    return seen._replace(image=image._replace(weight=np.where(at_edges(image, state), 0.0, image.weight)))


def at_edges(image: Image, state: State) -> np.ndarray:
    """Return (H, W) bool: pixels that a state's solids do not explain, but that one beside them would, or some depth
    between those of two.

    A blur mixes both sides of an edge, and a reduced image has it up to a pixel beside its place. That says nothing of
    surfaces, but a free-form one goes through all of it: a right stack was 400 nats the worse, and two things.
    """
    depth, label, misfit, _ = held_out(image, state, -1)
    depth, noise = np.minimum(depth, WALL), noise_in(image)
    reach = max(image.taps.size - 1, 1)
    near, far = least(depth, reach), greatest(depth, reach)
    edge = (least(label, reach) < greatest(label, reach)) & (far - near > noise)
    return edge & (misfit > BAD) & (near - noise < image.depth) & (image.depth < far + noise)


def noise_in(image: Image) -> np.ndarray:
    """Return (H, W) metres: NOISES standard deviations of each pixel's noise."""
    return NOISES / np.sqrt(2.0 * np.maximum(image.weight, LEAST_WEIGHT))


def likely_things(
    seen: Observation, state: State, masks: list[np.ndarray], settings: Settings
) -> tuple[Observation, list[Thing]]:
    """Return (Observation, [Thing]) of what is likelier an object than not; the rest is background as it is seen.

    What may be several, how is not known, is told as one unless it is likelier clutter. Where somebody says how many
    objects there are at most the largest are told, as seen, and the rest is clutter.
    """
    behind, found, clutter = seen.behind.copy(), [], []
    taken = np.any([held_out(seen.image, state, -1)[1] >= 0, *masks], axis=0)
    for mask in masks:
        if seen.correlation > CORRELATED:
            low = low_parts(seen, mask, seen.behind | taken)
            mask, taken = mask | low, taken | low
            seen.image.floor[low] = seen.image.depth[low] + 0.5 * AS_SEEN
        existence = existence_of(seen, state, mask, settings, shows_below(seen, state, mask))
        one = existence
        if existence[0] >= LEAST_EXISTENCE:
            cost = cost_of(seen._replace(mask=mask), settings.believed.loose.things)
            one = settings.believed.loose.existence.joined(existence, nats_of_joins(seen, mask, cost, settings))
        if one[0] < 1.0 - existence[0]:
            behind |= mask
            clutter.append((mask, existence[0]))
            continue
        found.append(made_thing(seen, state, mask, one)._replace(clutter=1.0 - existence[0]))
    room = max(settings.max_objects - len(state), 0) if settings.counts_all else len(found)
    for thing in sorted(found, key=lambda each: -int(each.mask.sum()))[room:]:
        behind |= thing.mask
        clutter.append((thing.mask, thing.existence[0]))
        found = [each for each in found if each is not thing]
    return seen._replace(behind=behind, clutter=(*seen.clutter, *clutter)), found


def low_parts(seen: Observation, mask: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: what a thing's mask (H, W) goes on into that is too low to be told from the floor by itself.

    taken : (H, W) bool, pixels that show something, it among them.
    """
    low = (seen.image.weight > 0) & ~taken & ~seen.mask
    low &= seen.points[..., 2] > np.maximum(LOWEST * seen.floor_scale, LOW * seen.sigma)
    body, _ = label_bodies(seen.points, mask | low, seen.surface.jump)
    return low & (body >= 0) & np.isin(body, body[mask])


def cost_of(seen: Observation, believed: Things) -> Cost:
    """Return the Cost of free-form surfaces for every pixel of an Observation.

    Of independent noise any surface leaves all, over some pixels. A mean of n pixels, the one in the middle among them,
    leaves less of that one's noise by one part in n, and all of what lies off all others: to explain such pixels a
    solid of 1,800 was 300 nats the worse.
    """
    mask, normal = seen.mask, seen.surface.normals(seen.mask)
    area, crease = surface_lengths(seen.points, mask, normal, seen.surface.jump, seen.footprint)
    depth, weight = seen.image.depth, seen.image.weight
    alone = seen.correlation <= CORRELATED
    step = np.maximum(STEP * depth, noise_in(seen.image)) if alone else STEP * depth
    smooth, many = means_about(depth, mask, step)
    misfit = np.minimum((depth - smooth) ** 2 * weight, LIMIT)
    if alone:
        misfit *= many / np.maximum(many - 1.0, 1.0)
        misfit = np.minimum(misfit, STRAIGHTEST * straightest(depth, mask) * weight)
        misfit = np.where(many > FEW_ABOUT, np.minimum(misfit, LIMIT), LIMIT)
        about, pixels = (total(values, SOME) for values in (np.where(mask, misfit, 0.0), mask.astype(float)))
        misfit = np.maximum(about / np.maximum(pixels, 1.0), NOISE)
    return Cost(area, crease, misfit, normal, believed)


@njit(cache=True, nogil=True)
def surface_lengths(points, mask, normal, jump, footprint):
    """Return (H, W) the area of surface that a pixel shows, and the metres of edges and jumps that pass through it."""
    height, width = mask.shape
    area, crease = np.zeros((height, width)), np.zeros((height, width))
    for j in range(height):
        for i in range(width):
            if not mask[j, i]:
                continue
            f = footprint[j, i]
            area[j, i] = f * f
            for way in range(2):
                v, u = (j, i + 1) if way == 0 else (j + 1, i)
                if v >= height or u >= width or not mask[v, u]:
                    continue
                apart = separation(points, j, i, v, u)
                if apart > jump[j, i] ** 2:
                    crease[j, i] += f
                    continue
                area[j, i] = max(area[j, i], f * min(np.sqrt(apart), 4.0 * f))
                a, b = (j, i - 2) if way == 0 else (j - 2, i)
                c, d = (j, i + 2) if way == 0 else (j + 2, i)
                if a < 0 or b < 0 or c >= height or d >= width or not mask[a, b] or not mask[c, d]:
                    continue
                if separation(points, a, b, c, d) > (4.0 * jump[j, i]) ** 2:
                    continue
                cosine = 0.0
                for axis in range(3):
                    cosine += normal[a, b, axis] * normal[c, d, axis]
                if cosine < CREASE:
                    crease[j, i] += 0.25 * f  # an edge is seen by four pixels across it
    return area, crease


def groups_of(image: Image, state: State, body: np.ndarray, count: int) -> list[list[int]]:
    """Return lists of solids that show in the same bodies of pixels: whether they stay is decided together."""
    _, label, _, _ = held_out(image, state, -1)
    shares = np.zeros((len(state), count), int)
    both = (label >= 0) & (body >= 0)
    np.add.at(shares, (label[both], body[both]), 1)
    shows = shares > 0.1 * np.maximum(shares.sum(axis=1, keepdims=True), 1)
    return components((shows[:, None] & shows[None]).any(axis=2))


def best_subset(seen: Observation, state: State, keep: set[int], members: list[int], cost: Cost, settings: Settings,
                reluctance: float) -> set[int]:  # fmt: skip
    """Return which solids stay: `keep` without those of `members` that a free-form surface explains better."""

    def value(chosen):
        trial = subset(state, chosen)
        return total_energy(seen.image, trial, settings) - pieces_of(seen, trial, cost, settings)[1]

    best, least = keep, value(keep) - settings.temper * reluctance
    none = keep - set(members)
    if (energy := value(none)) < least:
        best, least = none, energy
    changed = len(members) > 1
    while changed:
        changed = False
        for k in members:
            trial = best ^ {k}
            if (energy := value(trial)) < least:
                best, least, changed = trial, energy, True
    return best


def pieces_of(
    seen: Observation, state: State, cost: Cost, settings: Settings, least: float = 0.0
) -> tuple[list[np.ndarray], float]:
    """Return ([mask] of free-form things that pay beside the solids of a state, the tempered nats that they gain).
    least : of these, each."""
    image = seen.image
    depth, _, misfit, _ = held_out(image, state, -1)
    left = seen.mask & (misfit > BAD) & (image.depth < depth)
    label, count, edges = segments(seen.surface, left, cost.normal)
    if count == 0:
        return [], 0.0
    price, nats = settings.price_of_box, nats_of_edges(seen, cost, settings)
    area = np.bincount(label[label >= 0], seen.footprint[label >= 0] ** 2, count)
    owner, _ = joined(seen.surface, label, edges, price, nats, area, cost.believed)
    thing = np.append(owner, -1)[label]  # of each pixel
    within = 0.5 * np.array([edges[np.ix_(owner == k, owner == k)].sum() for k in range(count)])
    inside = thing >= 0
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inside &= np.roll(thing, way, axis) == thing
    place = thing[thing >= 0]
    pixels = np.bincount(place, minlength=count)
    inner = np.bincount(thing[inside], minlength=count)
    won = np.bincount(place, (misfit - cost.misfit)[thing >= 0], count)
    numbers = np.array([cost.numbers(thing == k) if pixels[k] >= FEWEST else np.inf for k in range(count)])
    within /= [cost.believed.larger(area[owner == k].sum()) for k in range(count)]
    gain = won - price - settings.temper * numbers - nats * within
    found, total = [], 0.0
    for k in np.flatnonzero((pixels >= FEWEST) & (inner >= INNER * pixels) & (gain > least)):
        mask = thing == k
        points = seen.points[mask]
        low, high = ends_of(points, ENDS)
        if high[2] < max(LEAST_HEIGHT * seen.scale, settings.uneven) or max(high[:2] - low[:2]) > LARGEST:
            continue
        found.append(mask)
        total += float(gain[k])
    return found, total


def nats_of_edges(seen: Observation, cost: Cost, settings: Settings) -> float:
    """Return the tempered nats of a metre of edge within a usual thing; nearer things have smaller edges."""
    return settings.temper * cost.believed.edge / (cost.believed.patch * seen.scale)


def nats_of_joins(seen: Observation, mask: np.ndarray, cost: Cost, settings: Settings) -> float:
    """Return by how many nats at least what a mask (H, W) shows is likelier one thing than two that meet in a concave
    edge; inf where it has none that parts off much of it, or is one for other reasons, as a chair on its foot is."""
    label, count, edges = segments(seen.surface, mask, cost.normal)
    if count < 2:
        return np.inf
    area = np.bincount(label[label >= 0], seen.footprint[label >= 0] ** 2, count)
    price, nats = settings.price_of_box, nats_of_edges(seen, cost, settings)
    owner, least = joined(seen.surface, label, edges, price, nats, area, cost.believed)
    return float(least.min()) / settings.temper if len(np.unique(owner)) == 1 else np.inf


def without_background(
    seen: Observation, state: State, masks: list[Any], settings: Settings
) -> tuple[Observation, State, list[Any]]:
    """Return (Observation, State, masks) without the solids and the free-form things that are pieces of the background.

    What the image's border cuts may be an object nevertheless: how probably is in the Observation's `cut_short`.

    What stands there is told apart body by body (`background.py`) before solids are known; a hand that touches a carton
    or a wall's lower end are found as solids of their own only then. masks : [(H, W) bool] of free-form things.
    """
    image = seen.image
    good = image.weight > 0
    if not seen.mask.any():
        return seen, state, masks
    upright = partial(turned, times=quarter_turns(seen.floor.pose[:3, 2]))
    frame = frame_seen(upright(good))
    label, misfit = held_out(image, state, -1)[1:3]
    behind, gone = upright(seen.behind), np.zeros(good.shape, bool)
    normal, beyond = upright(seen.surface.normals(good)), upright(seen.beyond / seen.floor_scale)
    surface = seen.surface.in_units_of(seen.floor_scale).turned(upright.keywords["times"])
    fills = seen.floor.inliers.sum() < HIDDEN_FLOOR * good.sum()

    def goes(mask):
        few = mask.sum() < FEWEST
        return not fills and not few and is_background(surface, upright(mask), normal, behind, beyond, frame)

    keep, shown = set(), good & (misfit < LIMIT)
    things = np.any([gone, *masks], axis=0)
    left = seen.mask & ((label < 0) | (misfit >= LIMIT)) & ~things

    def whole(mask):
        """Return what a solid shows, with what goes on from there and nothing explains: a foot that it does not fit."""
        body, _ = label_bodies(seen.points, mask | left, seen.surface.jump)
        return np.isin(body, body[mask])

    cut = []
    for k in range(len(state)):
        mask = shown & (label == k)
        seen_there = silhouette(image, state, k) & ~things & ((label < 0) | (label == k))
        if mask.sum() < LEAST_SHOWN * seen_there.sum() or (goes(mask) and goes(whole(mask))):
            gone |= mask
            cut.append(mask)
        else:
            keep.add(k)
    left = []
    for mask in masks:
        if goes(mask):
            gone |= mask
            cut.append(mask)
        else:
            left.append(mask)
    kept = subset(state, keep)
    cut = [mask for mask in cut
           if mask.sum() >= FEWEST and cut_short(surface, upright(mask), normal, beyond, frame)]  # fmt: skip
    told = [existence_of(seen, kept, mask, settings, shows_below(seen, kept, mask))[0] for mask in cut]
    short = tuple((mask, CUT_SHORT * probability) for mask, probability in zip(cut, told, strict=True))
    image.floor[gone] = image.depth[gone]
    return seen._replace(behind=seen.behind | gone, cut_short=seen.cut_short + short), kept, left


def silhouette(image: Image, state: State, k: int) -> np.ndarray:
    """Return (H, W) bool: the pixels that would show solid k of a state were nothing before it."""
    return held_out(image._replace(floor=np.full(image.floor.shape, FAR)), subset(state, {k}), -1)[1] >= 0


def support_of(points: np.ndarray, state: State, unseen: float = NEAR_TOP) -> tuple[int, float]:
    """Return (FLOOR or the index of the solid that points (K, 3) stand on, its height).

    unseen : metres over that which they may begin at.
    """
    low = float(np.quantile(points[:, 2], ENDS))
    parent, bottom = FLOOR, 0.0
    for k, row in enumerate(state.rows):
        top = highest(row)
        if not flat_top(row) or abs(low - top) > unseen or top < bottom:
            continue
        if share_over(points, row) > BENEATH:
            parent, bottom = k, top
    return parent, bottom


def shows_below(seen: Observation, state: State, mask: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: the pixels that show the solid that what a mask (H, W) shows stands on; none of the floor."""
    parent, _ = standing(seen, state, mask)
    if parent == FLOOR:
        return np.zeros(mask.shape, bool)
    return held_out(seen.image, state, -1)[1] == parent


def standing(seen: Observation, state: State, mask: np.ndarray) -> tuple[int, float]:
    """Return (FLOOR or the index of the solid that what a mask (H, W) shows stands on, its height).

    What is hardly off that is explained by it, and no part of the mask.
    """
    clear, reach = clear_of_edges(seen, mask)
    hidden = reach * median(seen.footprint[mask]) + np.sqrt(2.0 * BAD) * median(seen.sigma[mask])
    return support_of(seen.points[clear], state, NEAR_TOP + float(hidden))


def clear_of_edges(seen: Observation, mask: np.ndarray) -> tuple[np.ndarray, int]:
    """Return (the pixels of a mask (H, W) that show nothing but its surface, how many pixels its edge lies beyond).

    A blurred image shows depths between a silhouette and what is behind. Of what is narrow enough is left.
    """
    taps = seen.image.taps
    blur = np.sqrt(2.0 * np.sum(taps * np.arange(taps.size) ** 2))
    clear, reach = mask, 0
    while reach < round(SMEARED * blur):
        inner = ~greatest(~clear, 1)
        if inner.sum() < max(CLEAR * mask.sum(), FEWEST):
            break
        clear, reach = inner, reach + 1
    return clear, reach


def made_thing(seen: Any, state: State, mask: np.ndarray, existence: Any) -> Thing:
    """Return the Thing that these pixels show, standing on a solid of the state or on the floor.

    Of what is a surface of revolution the far side is where the axis says; of all else it is where it was seen last,
    or, of what shows nothing but its front, as deep as household things are for their width and height.
    """
    clear, reach = clear_of_edges(seen, mask)
    points = seen.points[clear]
    parent, bottom = standing(seen, state, mask)
    rim = reach * median(seen.footprint[mask])  # where an edge ends some pixel shows it, at its middle
    normal = seen.surface.normals(mask)[clear]
    axis = vertical_axis(points, normal)
    outline, yaw = np.vstack([points[:, :2], sloping_foot(points, normal, bottom, NEAR_TOP)]), None
    if axis is not None:
        around = 2.0 * np.pi * np.arange(AROUND) / AROUND
        away = np.linalg.norm(points[:, :2] - axis[0], axis=1)
        radius = max(axis[1], foot_radius(points[away < BESIDE * axis[1]], axis[0], bottom), THINNEST)
        rim = 0.0  # how far it is to the axis all points tell, not those on the silhouette
        circle = axis[0] + radius * np.column_stack([np.cos(around), np.sin(around)])
        outline = np.vstack([np.repeat(circle, max(1, int(4.0 * ENDS * len(points))), axis=0), outline])
        handle = points[away > BESIDE * radius, :2] - axis[0]
        if len(handle) >= FEWEST:
            yaw = float(np.arctan2(*handle.mean(axis=0)[::-1]))
    upright = rotation_z(smallest_rectangle(outline) if yaw is None else yaw)[:3, :3]
    wide = ends_of(outline @ upright[:2, :2], ENDS) + [[-rim], [rim]]
    high = np.quantile(points[:, 2], ENDS), np.quantile(seen.points[mask, 2], 1.0 - ENDS)
    ends = np.column_stack([wide, high])
    if not seen.no_floor:
        ends[0, 2] = bottom
    away = (points.mean(axis=0) - seen.image.origin) @ upright
    size = ends[1] - ends[0]
    k = int(size[:2].argmin())
    usual, guessed = np.sqrt(max(size[1 - k] * size[2], 0.0)), np.zeros(3)
    if axis is None and size[k] < SHALLOW * usual:
        guessed[k] = DEPTH * usual - size[k]
        ends[int(away[k] > 0.0), k] += np.sign(away[k]) * guessed[k]
    size = np.maximum(ends[1] - ends[0], THINNEST)
    away = np.zeros(3) if axis is not None else np.append(away[:2] / max(float(np.hypot(*away[:2])), 1e-9), 0.0)
    return Thing(mask, make_row(BOX, upright, upright @ (ends[0] + 0.5 * size), size), parent, existence, away, guessed)
