"""Pieces of a surface that stand free: most of their outline is an edge beyond which something farther is seen.

So a person tells a thing from what is around it where no floor is known: on a shelf's board that is seen edge-on, in a
bin, before a wall. A piece of a wall or of a floor has no such outline, and what is behind something else has the
other side of its edges.

Whether a free-form thing is an object is told by that, and by how much of the image it explains.
"""

from typing import TYPE_CHECKING

import numpy as np

from derender.camera.windows import total
from derender.compilation.cache import njit
from derender.detection.outline import ends_of
from derender.detection.patches import SeenSurface
from derender.detection.search.bodies import SLANTED, TIGHT
from derender.detection.segments import joined, outline_area, segments
from derender.detection.solids.image import FAR, Image
from derender.detection.solids.state import State, held_out
from derender.scene.priors.bare_image import Things

if TYPE_CHECKING:
    from derender.detection.search.greedy import Settings
    from derender.detection.search.observation import Observation


REACH = 6  # pixels within which what lies beyond an outline is looked for: what a silhouette leaves without returns
JOINED, FARTHER, NEARER, NOTHING, BORDER = range(5)  # what lies beyond a pixel of the outline
# Of an outline: the least beyond which something farther is seen, which is more than is joined to others (to what a
# piece stands on foremost), hidden by something nearer, or cut by the image's border; and what may be cut.
FREE, CUT = 0.4, 0.1
FEWEST = 40  # pixels of a piece
LARGEST, SMALLEST = 0.6, 0.02  # metres of a piece's longest and second extent
ENDS = 0.02  # share of a piece's points beyond the ends of its extents: flying pixels
THING = 47.0  # nats of one more piece: as in `things.py`


def freestanding(surface: SeenSurface, believed: Things) -> list[np.ndarray]:
    """Return [(H, W) bool] of the pieces of a surface that stand free, the largest first. believed : of surfaces."""
    label, count, edges = segments(surface, surface.good, surface.normals(surface.good))
    if count == 0:
        return []
    area = np.bincount(label[label >= 0], surface.footprint[label >= 0] ** 2, count)
    owner, _ = joined(surface, label, edges, THING, believed.edge / believed.patch, area, believed)
    piece = np.where(label >= 0, owner[label], -1)
    free = stand_free(outline_shares(surface, piece, count))
    pixels = np.bincount(piece[piece >= 0], minlength=count)
    found = []
    for k in np.argsort(-pixels, kind="stable"):
        if pixels[k] < FEWEST:
            break
        if not free[k]:
            continue
        own = surface.points[piece == k]
        axes = np.linalg.svd(own - own.mean(axis=0), full_matrices=False)[2].T  # along which it is longest, and so on
        low, high = ends_of(own @ axes, ENDS)
        extents = np.sort(high - low)
        if extents[2] < LARGEST and extents[1] > SMALLEST:
            found.append(piece == k)
    return found


def stand_free(shares: np.ndarray) -> np.ndarray:
    """Return (N,) bool whether pieces stand free whose outlines have such shares (N, 5), see `outline_shares`."""
    held = shares[:, JOINED] + shares[:, NEARER] + shares[:, BORDER]
    return (shares[:, FARTHER] >= np.maximum(FREE, held)) & (shares[:, BORDER] <= CUT)


def outline_shares(surface: SeenSurface, piece: np.ndarray, count: int) -> np.ndarray:
    """Return (N, 5) the shares of each piece's outline beyond which lies what: see JOINED and so on.

    piece : (H, W) int, -1 for none. count : of all pieces.
    """
    points, good, footprint, jump, origin = surface
    found = outlines(np.ascontiguousarray(piece), count, points, good, jump, footprint, origin)
    return found / np.maximum(found.sum(axis=1, keepdims=True), 1.0)


@njit(cache=True, nogil=True)
def outlines(piece, count, points, good, jump, footprint, origin):
    """Return (N, 5) how many sides of the pixels of each piece's outline have what beyond them: see JOINED and so on.

    piece : (H, W) int, -1 for none.
    """
    height, width = piece.shape
    found = np.zeros((count, 5))
    for j in range(height):
        for i in range(width):
            k = piece[j, i]
            if k < 0:
                continue
            own = 0.0
            for axis in range(3):
                own += (points[j, i, axis] - origin[axis]) ** 2
            for way in range(4):
                down = 1 if way == 0 else -1 if way == 1 else 0
                across = 1 if way == 2 else -1 if way == 3 else 0
                what = NOTHING
                for step in range(1, REACH + 1):
                    v, u = j + step * down, i + step * across
                    if v < 0 or v >= height or u < 0 or u >= width:
                        what = BORDER
                        break
                    if piece[v, u] == k:
                        what = -1
                        break
                    if good[v, u]:
                        apart, other = 0.0, 0.0
                        for axis in range(3):
                            apart += (points[v, u, axis] - points[j, i, axis]) ** 2
                            other += (points[v, u, axis] - origin[axis]) ** 2
                        if apart < (TIGHT * jump[j, i] + SLANTED * step * footprint[j, i]) ** 2:
                            what = JOINED
                        else:
                            what = FARTHER if other > own else NEARER
                        break
                if what >= 0:
                    found[k, what] += 1.0
    return found


LEAST_EXISTENCE = 0.5  # probability that a thing of the best scene is an object
SHADOW = 0.5  # share of what returns nothing beside an outline that is in the shadow of a step there


def existence_of(
    seen: "Observation", state: State, mask: np.ndarray, settings: "Settings", below: np.ndarray
) -> tuple[float, float]:
    """Return (probability, standard error) that what a mask (H, W) shows is an object beside the solids of a state.

    It counts by what they and the floor leave unexplained of its pixels. What its own surface costs says nothing here:
    clutter of that form costs as much. Without a floor, what else may be there is not known: all is left open.

    below : (H, W) bool, pixels of the solid that it stands on.
    """
    existence = settings.believed.loose.existence
    left = held_out(without_thing(seen.image, mask), state, -1)[2]
    gain = existence.even if seen.no_floor else float(left[mask].sum()) / settings.temper
    return existence.of(gain, outstanding(seen, mask, below))


def without_thing(image: Image, mask: np.ndarray) -> Image:
    """Return an Image with the floor where a thing, which a mask (H, W) shows, was taken as it is seen."""
    with np.errstate(divide="ignore"):
        floor = -image.origin[2] / image.direction[..., 2]
    floor = np.where((floor > 0.0) & (floor < FAR), floor, FAR)
    return image._replace(floor=np.where(mask, floor, image.floor))


def outstanding(seen: "Observation", mask: np.ndarray, below: np.ndarray) -> float:
    """Return how much what a mask (H, W) shows stands out, 1 at most: the share of its outline's hull that it fills,
    times the share of its outline beyond which something farther is seen, or the floor or the solid (`below`, (H, W)
    bool) that it stands on.

    Clutter, such as leaves or the edge of a bin, is ragged or goes on behind what hides it, and a piece of something
    goes on there; where nothing returned beyond the outline it is a step's SHADOW or nothing tells what it is.
    """
    surface, piece = seen.surface, np.where(mask, 0, -1).astype(np.int32)
    around, floor = (outline_shares(surface._replace(good=beyond), piece, 1)[0]
                     for beyond in (surface.good, surface.good & (mask | ~seen.mask | below)))  # fmt: skip
    rows, columns = np.nonzero(mask)
    pixels = np.column_stack([rows, columns])
    corners = np.concatenate([pixels + [down, across] for down in (-0.5, 0.5) for across in (-0.5, 0.5)])
    filled = min(1.0, len(rows) / outline_area(corners) / returns_about(seen))
    return float((around[FARTHER] + min(floor[JOINED], around[JOINED]) + SHADOW * around[NOTHING]) * filled)


def returns_about(seen: "Observation") -> float:
    """Return the share of the eight neighbours of an Observation's pixels that have a depth as these do."""
    good = (seen.image.weight > 0).astype(float)
    about = total(good, 1) - good
    return float((about * good).sum() / max(8.0 * good.sum(), 1.0))
