"""Which bodies of pixels over the support stand on it, and which are background: walls, clutter, what is cut off.

A body stands on the support where it rises from the visible part of it. One that is long, or cut by the image's border
so that its top is not seen, or that floats, or lies beyond the support's outline, is a wall, a shelf, a person or the
room behind: explained as it is seen, and no solid. A wall is an upright plane that ends the floor, with nothing of the
image behind it.

Images are upright here: what is up lies towards their first row, as `quarter_turns` has it.

All lengths here are counted in metres as they would be were the floor seen from `USUAL` metres (`floor.scale_of`):
what is long on a desk is short in a hall.
"""

from collections.abc import Sequence

import numpy as np

from derender.camera.intrinsics import LEVEL
from derender.detection.freestanding import BORDER, FARTHER, LARGEST, NEARER, outline_shares, stand_free
from derender.detection.outline import ends_of
from derender.detection.patches import APART, SeenSurface, local_planes
from derender.detection.search.bodies import label_bodies
from derender.detection.segments import segments
from derender.scene.polygon import beyond_edges, convex_outline

LONG = 0.5  # metres: what is longer and cut by the image's border is no solid on a table
CUT = 0.35  # share of a body's width or height in pixels along which a border cuts it
# Share of a line that returns fill where what is seen begins, and share of the lines within which that is so after the
# first return: the borders of registered images are ragged.
FILLED, RAGGED = 0.5, 0.03
OUTSIDE = 0.5  # share of a body's pixels beyond the support's outline from which on it stands beyond
FLOATS = 0.1  # metres between what bears a body and its lowest point from which on it hangs over it
HANGS = 0.6  # share of a floating body's lower edge under which the support or what is behind it shows
BORNE = 0.1  # share of that edge under which what shows is high enough to bear it from which on it does not hang
FEWEST = 8  # pixels of a body that is told apart; smaller ones are as their pixels are
DIRECTIONS = 8  # in which a body's length along the support is taken
MARGIN = 0.01  # metres beyond the outline that still count as over it
WALL, EDGE, MOSTLY = 0.2, 0.03, 0.8  # metres: the least length of a wall, and how near the edge how much of it stands
PIECE = 60  # pixels of a piece of a longer body, at least
PARTED = 0.003  # of the image's pixels, what shows a piece of the floor at least that solids part
FOOT = 0.03  # metres over the support that what a body shows in a column may end and stand there
STANDS = 0.5  # share of its columns in which a body ends at its foot from which on it shows that it stands
DOWN = 0.75  # of its top's height over the support, how much a body shows at least that comes down to it
LARGE = 0.02  # share of the pixels with a depth: what shows in less, cut off by the border, is a detail
SIDES = 0.5  # level part of the unit sight line, from which on sides show at more than half of their height
FLAT, TOP, TOP_SHARE = 0.95, 0.03, 0.2  # cosine of a level top with up; metres below the top; share of the pixels
# Of fewer pixels, as of a top seen at a grazing angle, it is one where they reach so far, in metres, in each direction:
# no bin's wall or partition is so thick.
TOP_SEEN, THICK = 0.02, 0.15
ENDS = 0.02  # share of a body's points beyond its ends: flying pixels
FROM_ABOVE = 0.1  # level part of the floor's normal, in the image, below which no way in the image is up
GROWN, BESIDE, NEXT = 0.3, 0.03, 4  # of a solid's outline that joins the background, within so many metres and pixels


def quarter_turns(normal: np.ndarray) -> int:
    """Return by how many quarter turns, as of `numpy.rot90`, an image is upright whose floor has this normal (3,) in
    camera axes: phones are held in portrait, and what stands is told by what shows below it."""
    across, up = float(normal[0]), -float(normal[1])
    if np.hypot(across, up) < FROM_ABOVE:
        return 0
    if abs(across) > abs(up):
        return 1 if across > 0.0 else 3
    return 2 if up < 0.0 else 0


def standing_bodies(
    surface: SeenSurface,
    above: np.ndarray,
    beyond: np.ndarray,
    held: np.ndarray,
    floating: bool = False,
    real: bool = True,
) -> np.ndarray:
    """Return (H, W) bool: pixels of `above` that stand on the support.

    surface : in the floor frame, lengths as above. above : (H, W) bool, pixels over the support's plane.
    beyond : (H, W) metres by which points lie beyond the outline of its visible part, negative over it.
    held : (H, W) bool, pixels of what surely stands on it, such as what fills the view.
    floating : whether solids may hang in the air. real : whether a room may be behind: of what has noise that no sensor
        has only what is long goes on beyond the border.
    """
    points = surface.points
    body, count = label_bodies(points, above, surface.jump)
    if count == 0 or not surface.good.any():
        return above & (beyond < MARGIN)
    frame, normal = frame_seen(surface.good), surface.normals(above)

    def stands(mask):
        """Return whether the pixels of a body or of a piece of one show what stands on the support."""
        if held[mask].mean() > OUTSIDE:
            return True
        return not (
            np.mean(beyond[mask] > MARGIN) > OUTSIDE
            or along_edge(points[mask], beyond[mask])
            or cut_short(surface, mask, normal, beyond, frame, real, WALL)
            or (not floating and floats(surface, mask))
        )

    standing = above & (beyond < MARGIN)
    pixels = np.bincount(body[above], minlength=count)
    for k in np.flatnonzero(pixels >= FEWEST):
        mask = body == k
        standing[mask] = stands(mask)
        if not standing[mask].any() and length(points[mask]) > LONG:  # something may stand against a wall
            piece, pieces, _ = segments(surface, mask, normal)
            shares = outline_shares(surface, piece, pieces)
            for number in np.flatnonzero(
                stand_free(shares) & (np.bincount(piece[piece >= 0], minlength=pieces) >= PIECE)
            ):
                part = piece == number
                reaches = comes_down(points[part]) or not sides_show(points[part] - surface.origin)
                if length(points[part]) < LARGEST and reaches and stands(part):
                    standing[part] = True
    return standing


def frame_seen(good: np.ndarray) -> tuple[int, ...]:
    """Return the first and last row and column of what the camera sees; good : (H, W) bool, pixels with a depth.

    Registered images have margins without returns; but where returns end in few pixels that is the top of a solid
    with nothing behind it, and the border is the image's own.
    """
    found = []
    for axis in (1, 0):
        share, last = good.mean(axis=axis), good.shape[1 - axis] - 1
        returns, filled = np.flatnonzero(share), np.flatnonzero(share > FILLED)
        most = RAGGED * len(share)
        begins = len(filled) and filled[0] - returns[0] <= most
        ends = len(filled) and returns[-1] - filled[-1] <= most
        found += [int(filled[0]) if begins else 0, int(filled[-1]) if ends else last]
    return tuple(found)


def along_edge(points: np.ndarray, beyond: np.ndarray) -> bool:
    """Return whether a body (K, 3) stands along the edge of the support, as the wall of a bin does.

    beyond : (K,) metres by which its points lie beyond the support's outline.
    """
    return bool(length(points) > WALL and np.mean(beyond > -EDGE) > MOSTLY)


def cut_off(points: np.ndarray, mask: np.ndarray, frame: Sequence[int], real: bool = True, least: float = WALL) -> bool:
    """Return whether a body is cut by the image's border so that it may go on as a wall does.

    frame : first and last row and column of what the camera sees. least : metres that a body is long of which one of
    the sides of the image may cut off the rest.
    """
    top, bottom, _, _ = frame
    rows, columns = np.nonzero(mask)
    wide = np.ptp(columns) + 1
    over = len(np.unique(columns[rows <= top + 1])) / wide
    under = len(np.unique(columns[rows >= bottom - 1])) / wide
    by_sides, long = beside(mask, frame), length(points[mask])
    if real and (over > CUT or (by_sides > CUT and long > least)):
        return True
    return bool(max(over, under, by_sides) > 0.0 and long > LONG)


def beside(mask: np.ndarray, frame: Sequence[int]) -> float:
    """Return the share of the rows of a body's pixels, (H, W) bool, in which one side of the image cuts it.

    frame : see `cut_off`.
    """
    return max(by_either_side(mask, frame))


def by_either_side(mask: np.ndarray, frame: Sequence[int]) -> tuple[float, float]:
    """Return the shares of the rows of a body's pixels, (H, W) bool, in which the left and the right side cut it."""
    rows, columns = np.nonzero(mask)
    left, right = (len(np.unique(rows[cut])) for cut in (columns <= frame[2], columns >= frame[3]))
    high = np.ptp(rows) + 1
    return float(left / high), float(right / high)


def spans(mask: np.ndarray, frame: Sequence[int]) -> bool:
    """Return whether both sides of the image cut a body: what is wider than all that is seen of the floor is a bin's
    rim, a step or a wall, though it may show a level top."""
    return min(by_either_side(mask, frame)) > CUT


def shows_top(points: np.ndarray, normal: np.ndarray) -> bool:
    """Return whether a body (K, 3) shows a level top, as what is so near that it fills the view does and no wall.

    normal : (K, 3) of the surface at each point.
    """
    top = np.quantile(points[:, 2], 1.0 - 0.5 * TOP_SHARE) - TOP
    if np.mean((points[:, 2] > top) & (normal[:, 2] > FLAT)) > TOP_SHARE:
        return True
    level = points[(points[:, 2] > np.quantile(points[:, 2], 1.0 - 0.5 * TOP_SEEN) - TOP) & (normal[:, 2] > FLAT)]
    return len(level) > TOP_SEEN * len(points) and extents(level).min() > THICK


def shows_foot(surface: SeenSurface, mask: np.ndarray, beyond: np.ndarray, frame: Sequence[int]) -> bool:
    """Return whether a body shows that it stands well within the support: arms and walls do not.

    Its foot shows all along; or it is no detail of the image, hardly any of it is beyond the border or hidden, beside
    what shows something farther behind it, and it comes so far down that most of its height is seen.

    mask : (H, W) bool, its pixels. beyond : (H, W) metres, see `standing_bodies`. frame : see `cut_off`.
    """
    own = surface.points[mask]
    columns = np.flatnonzero(mask.any(axis=0))
    long = max(length(own), np.ptp(ends_of(own[:, 2:], ENDS))) > LONG
    # A wall ends the floor, or goes on beyond the sides of the image; what has floor all around does neither.
    if np.mean(beyond[mask] > -EDGE) > (OUTSIDE if long else MOSTLY) or (long and beside(mask, frame) > 0.0):
        return False
    rows = mask.shape[0] - 1 - np.argmax(mask[::-1, columns], axis=0)
    if np.mean(surface.points[rows, columns, 2] < FOOT) > STANDS:
        return True
    if long:
        return False
    outline = outline_shares(surface, np.where(mask, 0, -1).astype(np.int32), 1)[0]
    shows = outline[FARTHER] > outline[NEARER] + outline[BORDER]
    return bool(shows and comes_down(own) and mask.sum() > LARGE * surface.good.sum())


def comes_down(points: np.ndarray) -> bool:
    """Return whether what shows of a body (K, 3) reaches far enough down: its foot may be narrow, or hidden, but an
    arm hangs over the support, and so does what is on a wall."""
    low, top = ends_of(points[:, 2:], ENDS).ravel()
    return bool(top - low > DOWN * top)


def sides_show(sight: np.ndarray) -> bool:
    """Return whether what is looked at along sight lines (K, 3) would show its sides, did they go down to what is below
    it: of what lies in a bin one sees from above the tops alone, and that what bears them ends there tells nothing."""
    return bool(np.median(np.linalg.norm(sight[:, :2], axis=1) / np.linalg.norm(sight, axis=1)) > SIDES)


def cut_short(
    surface: SeenSurface,
    mask: np.ndarray,
    normal: np.ndarray,
    beyond: np.ndarray,
    frame: Sequence[int],
    real: bool = True,
    least: float = 0.0,
) -> bool:
    """Return whether a body, or what shows as one solid, is cut off by the image's border as a wall or a hand is, and
    shows neither its top nor that it stands; takes what `is_background` and `cut_off` do."""
    points = surface.points
    cut = cut_off(points, mask, frame, real, least)
    cut = cut and (spans(mask, frame) or not shows_top(points[mask], normal[mask]))
    return cut and not shows_foot(surface, mask, beyond, frame)


def is_background(
    surface: SeenSurface,
    mask: np.ndarray,
    normal: np.ndarray,
    behind: np.ndarray,
    beyond: np.ndarray,
    frame: Sequence[int],
) -> bool:
    """Return whether what shows as one solid is a piece of the background: cut short, grown together with what is
    background, on the very edge of the support, where a bin's wall begins, or along it, as a wall of which something
    hides a part.

    surface : see `standing_bodies`. mask : (H, W) bool, the pixels that show it. normal : (H, W, 3). behind : those of
    the background. beyond : (H, W) metres, see `standing_bodies`. frame : see `cut_off`.
    """
    points, cut = surface.points, cut_short(surface, mask, normal, beyond, frame)
    if cut or np.mean(beyond[mask] > -MARGIN) > MOSTLY or along_edge(points[mask], beyond[mask]):
        return True
    outline, joined = np.zeros(mask.shape, bool), np.zeros(mask.shape, bool)
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        outline |= mask & ~np.roll(mask, way, axis)
        for step in range(1, NEXT + 1):
            near = np.linalg.norm(np.roll(points, step * way, axis) - points, axis=2) < BESIDE
            joined |= mask & np.roll(behind, step * way, axis) & near
    return bool((joined & outline).sum() > GROWN * max(outline.sum(), 1))


def length(points: np.ndarray) -> float:
    """Return the greatest extent of points (K, 3) along the support, in metres."""
    return float(extents(points).max())


def extents(points: np.ndarray) -> np.ndarray:
    """Return the extents (D,) of points (K, 3) in several directions along the support, in metres."""
    angle = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    along = points[:, :2] @ np.array([np.cos(angle), np.sin(angle)])
    low, high = ends_of(along, ENDS)
    return high - low


def floats(surface: SeenSurface, mask: np.ndarray) -> bool:
    """Return whether a body hangs over the support with nothing under it.

    What shows below it and is nearly as high as its lowest point may bear it, with something hidden between; and seen
    from above it shows no sides, so that only what shows underneath it tells that there are none.
    """
    points = surface.points
    lowest = np.quantile(points[mask][:, 2], ENDS)
    if lowest < FLOATS:
        return False
    lower = mask[:-1] & ~mask[1:] & surface.good[1:]
    if not lower.any():
        return False
    apart = np.linalg.norm(points[1:] - points[:-1], axis=2)[lower]
    far = np.linalg.norm(points - surface.origin, axis=2)
    lies_deeper = (far[1:] > far[:-1])[lower]
    edge, below = points[:-1][lower], points[1:][lower]
    inwards = points[mask][:, :2].mean(axis=0) - edge[:, :2]
    inwards /= np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-9)
    underneath = ((below - edge)[:, :2] * inwards).sum(axis=1)
    nothing = np.minimum(apart, underneath) > surface.jump[:-1][lower]
    bears = below[:, 2] > lowest - FLOATS
    return float(np.mean(nothing & lies_deeper)) > HANGS and bears.mean() < BORNE


ANGLES = 90  # directions of a wall that are tried, over half a turn
WIDE = 0.5  # metres: a narrower upright face may be a solid's
WALL_SHARE = 0.2  # of what stands over the floor: the least that a wall holds
BEHIND = 0.02  # share of the pixels that may seem to lie behind a wall
MOST_POINTS = 3000
MOST_WALLS = 3


def walls_behind(
    points: np.ndarray, good: np.ndarray, above: np.ndarray, sigma: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Return (H, W) bool: pixels on walls or behind them; a room's corner has two. Takes what `wall_behind` does."""
    found = np.zeros(good.shape, bool)
    for _ in range(MOST_WALLS):
        wall = wall_behind(points, good & ~found, above & ~found, sigma, origin)
        if not wall.any():
            break
        found |= wall
    return found


def wall_behind(
    points: np.ndarray, good: np.ndarray, above: np.ndarray, sigma: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Return (H, W) bool: pixels on a wall or behind it; none where there is no wall.

    points : (H, W, 3) float64, floor frame. good : (H, W) bool, pixels with a depth. above : those over the floor.
    sigma : (H, W) metres of noise. origin : (3,) the camera's centre, floor frame.
    """
    none = np.zeros(good.shape, bool)
    if above.sum() < 50:
        return none
    tolerance = max(0.01, 4.0 * float(np.median(sigma[above])))
    flat = points[above][:, :2] - origin[:2]
    flat = flat[:: max(1, len(flat) // MOST_POINTS)]
    everything = points[good][:, :2] - origin[:2]
    everything = everything[:: max(1, len(everything) // MOST_POINTS)]
    angle = np.arange(ANGLES) * 2.0 * np.pi / ANGLES
    away = np.column_stack([np.cos(angle), np.sin(angle)])  # from the camera through the wall
    for _ in range(2):  # a second time finely about the first answer
        distance, all_distance = away @ flat.T, away @ everything.T
        last = int((1.0 - BEHIND) * (all_distance.shape[1] - 1))
        far = np.partition(all_distance, last, axis=1)[:, last]  # where a wall would be, were it across this direction
        on = np.abs(distance - far[:, None]) < tolerance
        best = int(np.argmax(np.where(far > 0, on.mean(axis=1), 0.0)))
        angle = angle[best] + np.linspace(-1.0, 1.0, 21) * np.pi / ANGLES
        across = flat[on[best]] @ np.array([-away[best, 1], away[best, 0]])
        place, share, normal = far[best], on[best].mean(), away[best]
        away = np.column_stack([np.cos(angle), np.sin(angle)])
    if share < WALL_SHARE or np.ptp(np.quantile(across, (0.02, 0.98))) < WIDE:
        return none
    own = (flat @ normal)[np.abs(flat @ normal - place) < tolerance]
    return good & ((points[..., :2] - origin[:2]) @ normal > np.median(own) - tolerance)


def main_part(points: np.ndarray, inliers: np.ndarray, footprint: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: the pixels on the floor's plane without those that lie there by chance.

    A solid may part the floor in pieces; a piece of a wall or of clutter that the plane cuts is not level itself.
    """
    slope = np.abs(points[..., 2] - origin[2]) / np.linalg.norm(points - origin, axis=-1)  # of the rays to the floor
    jump = np.ascontiguousarray(APART * footprint / np.maximum(slope, 1e-3))
    part, count = label_bodies(points, inliers, jump)
    if count == 0:
        return inliers
    normal, own = local_planes(points, inliers, origin, jump, 2)[0], part[inliers]
    x, y, z = (np.bincount(own, values, count) for values in normal[inliers].T)
    pixels = np.bincount(own, minlength=count)
    level = (z > LEVEL * np.sqrt(x**2 + y**2 + z**2)) & (pixels >= PARTED * inliers.size)
    level[pixels.argmax()] = True
    return inliers & level[part]


def beyond_outline(points: np.ndarray, inliers: np.ndarray, good: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return (H, W) metres by which points lie beyond the hull of the floor's visible part and the camera's foot.

    Negative over the hull, and -inf everywhere where there is none.

    origin : (3,) the camera's centre: what stands before the visible floor is no background.
    """
    flat = points[inliers][:, :2]
    outline = convex_outline(np.vstack([flat[:: max(1, len(flat) // 3000)], origin[:2]]))
    if outline is None:
        return np.full(good.shape, -np.inf)
    beyond = np.full(good.shape, -np.inf)
    beyond[good] = beyond_edges(points[good][:, :2], outline)
    return beyond
