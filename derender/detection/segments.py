"""Pieces of a free-form surface: cut at concave edges and jumps, and joined again where that is the shorter story.

Most objects meet the next one in a concave edge, few have one of their own (Stein et al., Object partitioning using
local convexity, CVPR 2014). So a surface is cut there, and two pieces are one thing where their common edge is so short
that it costs less than another thing.
"""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.patches import SeenSurface, separation
from derender.detection.search.bodies import TIGHT, label_bodies
from derender.scene.polygon import convex_outline
from derender.scene.priors.bare_image import Things

REACH = 2  # pixels on either side over which the normals are compared
CONCAVE = np.cos(np.radians(30.0))  # of the normals on both sides of an edge
NECK = 0.25  # of the side of the square as large as the smaller piece, that a common edge has at least
SPECK = 5  # pixels: smaller pieces join their neighbours
ROUNDS = 6  # in which pixels on edges join the nearest piece
ALONE = 0.08  # share of a thing's area from which on a piece of it may be an object of its own
RIM = 40  # pixels of a piece that may be the inside or the outside of another
# Of the narrower one's width as the camera sees it: how far apart they may be, with nothing between but the bottom or
# what returned nothing, how much higher one, and how much wider both together.
CLOSE, SAME_TOP, WIDER = 0.6, 0.2, 1.6
# The same of two sides that are level, as those of one rim are: a bowl tapers, and its near side shows less wide.
LEVEL, TAPERS = 0.05, 2.5
BEHIND = 0.7  # cosine between the way from the camera and that from one piece to the other
# Most times as deep as wide that both together may be as the camera sees them: two mugs, one behind the other, are
# twice as deep; and least of its width by which the middle of the farther one lies farther than its sides.
DEEPER, BENT = 1.4, 0.1
MOST_POINTS = 150  # of a piece, that distances are taken between


@njit(cache=True, nogil=True)
def concave_edges(points, mask, normal, jump):
    """Return (H, W) bool: pixels of the mask through which a concave edge passes. normal : (H, W, 3), 0 for none."""
    height, width = mask.shape
    found = np.zeros((height, width), np.bool_)
    for j in range(height):
        for i in range(width):
            for way in range(2):
                v, u = (0, REACH) if way == 0 else (REACH, 0)
                a, b, c, d = j - v, i - u, j + v, i + u
                if a < 0 or b < 0 or c >= height or d >= width or not (mask[j, i] and mask[a, b] and mask[c, d]):
                    continue
                one, other, cosine, opens = 0.0, 0.0, 0.0, 0.0
                for axis in range(3):
                    before, after = normal[a, b, axis], normal[c, d, axis]
                    one += before * before
                    other += after * after
                    cosine += before * after
                    opens += (after - before) * (points[c, d, axis] - points[a, b, axis])
                if one > 0.5 and other > 0.5 and cosine < CONCAVE and opens < 0.0:
                    found[j, i] |= separation(points, a, b, c, d) <= (2.0 * REACH * jump[j, i]) ** 2
    return found


@njit(cache=True, nogil=True)
def fill(points, mask, label, jump):
    """Let pixels of the mask without a label join that of a neighbour without a jump between, in place."""
    height, width = mask.shape
    for _ in range(ROUNDS):
        before = label.copy()
        for j in range(height):
            for i in range(width):
                if not mask[j, i] or before[j, i] >= 0:
                    continue
                least = jump[j, i] ** 2
                for way in range(4):
                    v = j + (1 if way == 0 else -1 if way == 1 else 0)
                    u = i + (1 if way == 2 else -1 if way == 3 else 0)
                    if v < 0 or v >= height or u < 0 or u >= width or before[v, u] < 0:
                        continue
                    apart = separation(points, j, i, v, u)
                    if apart < least:
                        least = apart
                        label[j, i] = before[v, u]


@njit(cache=True, nogil=True)
def common_edges(points, label, count, jump, footprint):
    """Return (N, N) metres along which two pieces are neighbours without a jump between them."""
    height, width = label.shape
    edges = np.zeros((count, count))
    for j in range(height):
        for i in range(width):
            a = label[j, i]
            if a < 0:
                continue
            for way in range(2):
                v, u = (j, i + 1) if way == 0 else (j + 1, i)
                if v >= height or u >= width or label[v, u] < 0 or label[v, u] == a:
                    continue
                if separation(points, j, i, v, u) < jump[j, i] ** 2:
                    b = label[v, u]
                    edges[a, b] += footprint[j, i]
                    edges[b, a] += footprint[j, i]
    return edges


def segments(surface: SeenSurface, mask: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
    """Return (label (H, W) int32, -1 for none; count; edges (N, N) metres) of the pieces of a masked surface.

    normal : (H, W, 3), zero where there is none.
    """
    points, jump = surface.points, surface.jump
    edge = concave_edges(points, mask, normal, jump)
    label, count = label_bodies(points, mask & ~edge, TIGHT * jump)
    pixels = np.bincount(label[label >= 0], minlength=count)
    alive = pixels > SPECK
    number = np.append(np.where(alive, np.cumsum(alive) - 1, -1), -1).astype(np.int32)
    label, count = np.ascontiguousarray(number[label]), int(alive.sum())
    fill(points, mask, label, jump)
    return label, count, common_edges(points, label, count, jump, surface.footprint)


def joined(
    surface: SeenSurface, label: np.ndarray, edges: np.ndarray, price: float, nats: float, area: np.ndarray,
    believed: Things,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return (N,) int: the thing that each piece belongs to, pieces joined while that costs less; and (N,) by how many
    nats less at least, for each thing, of those joins by which it has ALONE of its area or more: inf where none has. A
    cup's wall and its bottom, seen within its rim, meet in a concave edge and are one.

    label, edges : see `segments`. price : nats of one more thing. nats : of each metre of edge within a thing as large
        as usual.
    area : (N,) square metres of each piece. A handle or a cap is joined along much of its width: two pieces whose
        common edge is short beside the smaller one are two objects that touch. believed : of what is large.
    """
    count, points, origin = len(edges), surface.points, surface.origin
    owner = np.arange(count)
    common, edges, area = edges, edges.copy(), np.array(area, float)
    joins = []
    while count > 1:
        neck = NECK * np.sqrt(np.minimum(area[:, None], area))
        gains = np.where(edges > neck, price - nats * edges / believed.larger(area[:, None] + area), -np.inf)
        a, b = np.unravel_index(np.argmax(gains), gains.shape)
        if gains[a, b] <= 0.0:
            break
        joins.append((gains[a, b], min(area[a], area[b]), owner == a, owner == b))
        owner[owner == b] = a
        area[a] += area[b]
        edges[a] += edges[b]
        edges[:, a] += edges[:, b]
        edges[b], edges[:, b], edges[a, a] = 0.0, 0.0, 0.0
    clouds = {k: points[np.isin(label, np.flatnonzero(owner == k))] for k in np.unique(owner)}
    inside = np.zeros(count, bool)  # the farther of two sides
    for a in sorted(clouds):
        for b in sorted(clouds):
            if a < b and a in clouds and b in clouds and two_sides(clouds[a], clouds[b], origin):
                inside |= owner == (a, b)[farther(clouds[a], clouds[b], origin)]
                owner[owner == b] = a
                area[a] += area[b]
                clouds[a] = np.vstack([clouds[a], clouds.pop(b)])
    least = np.full(count, np.inf)
    for gain, smaller, *sides in joins:
        whole = owner[np.argmax(sides[0])]
        if smaller < ALONE * area[whole]:
            continue
        one, other = (points[np.isin(label, np.flatnonzero(side))] for side in sides)
        if two_sides(one, other, origin):
            inside |= sides[farther(one, other, origin)]
        elif common[np.ix_(*(side & ~inside for side in sides))].any():
            least[whole] = min(least[whole], gain)
    return owner, least


def farther(first: np.ndarray, second: np.ndarray, origin: np.ndarray) -> int:
    """Return which of two pieces (K, 3) is farther from a point, 0 or 1."""
    return int(np.argmax([np.linalg.norm(cloud.mean(axis=0) - origin) for cloud in (first, second)]))


def two_sides(first: np.ndarray, second: np.ndarray, origin: np.ndarray) -> bool:
    """Return whether two pieces (K, 3) are the two sides of one rim, and large enough to tell, see `one_rim`."""
    return min(len(first), len(second)) >= RIM and one_rim(first, second, origin)


def one_rim(first: np.ndarray, second: np.ndarray, origin: np.ndarray) -> bool:
    """Return whether two pieces (K, 3) are the outside and the inside of one thing: a mug's, with its rim unseen.

    They are close, one behind the other as the camera sees them, equally wide and high, about as wide together as they
    are deep, and the farther one is hollow.
    """
    middle, other = first[:, :2].mean(axis=0), second[:, :2].mean(axis=0)
    away, apart = 0.5 * (middle + other) - origin[:2], other - middle
    if abs(away @ apart) < BEHIND * np.linalg.norm(away) * np.linalg.norm(apart):
        return False
    sight = np.array([away, [-away[1], away[0]]]) / np.linalg.norm(away)
    nearer, farther = (first, second) if away @ apart > 0.0 else (second, first)
    wide = float(np.ptp(np.vstack([first, second])[:, :2] @ sight[1]))
    narrow = min(np.ptp(cloud[:, :2] @ sight[1]) for cloud in (first, second))
    deep = np.quantile(farther[:, :2] @ sight[0], 0.9) - np.quantile(nearer[:, :2] @ sight[0], 0.1)
    tops = [np.quantile(cloud[:, 2], 0.98) for cloud in (first, second)]
    uneven = abs(tops[0] - tops[1]) / narrow
    if deep > DEEPER * wide or uneven > SAME_TOP or wide > (WIDER if uneven > LEVEL else TAPERS) * narrow:
        return False
    a, b = (cloud[:: max(1, len(cloud) // MOST_POINTS)] for cloud in (first, second))
    square = np.sum(a**2, axis=1)[:, None] - 2.0 * a @ b.T + np.sum(b**2, axis=1)
    if square.min() > (CLOSE * narrow) ** 2:
        return False
    before = nearer[:, :2] @ sight[1]
    far, aside = sight @ farther[:, :2].T
    within = (before.min() < aside) & (aside < before.max())  # beyond it a handle shows
    if within.sum() < RIM:
        return False
    far, aside, half = far[within], aside[within], 0.5 * np.ptp(aside[within])
    bent = np.column_stack([np.ones_like(aside), aside, ((aside - aside.mean()) / half) ** 2, farther[within, 2]])
    return bool(-np.linalg.lstsq(bent, far, rcond=None)[0][2] > BENT * 2.0 * half)


def outline_area(points: np.ndarray) -> float:
    """Return the area of the outline of points (K, 3) seen from above, or of points (K, 2)."""
    corners = convex_outline(np.ascontiguousarray(points[:, :2]))
    if corners is None:
        return 0.0
    x, y = corners.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
