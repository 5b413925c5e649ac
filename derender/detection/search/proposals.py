"""Hypotheses: boxes from one to three orthogonal patches, spheres and cylinders from clusters of patches."""

from collections.abc import Iterator
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np

from derender.detection.outline import ends_of
from derender.detection.patches import Patches, components
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import Solid
from derender.scene.polygon import convex_outline
from derender.scene.solids import BOX, CYLINDER, SPHERE

ALONG, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
THINNEST = 0.008


class Surface(NamedTuple):
    """What hypotheses are made from: each patch's points, the patches, and the camera's place in the floor frame."""

    points: list[np.ndarray]
    normal: np.ndarray
    offset: np.ndarray
    pixels: np.ndarray
    centre: np.ndarray
    touching: np.ndarray
    origin: np.ndarray
    footprint: float
    sigma: float


def make_surface(points: np.ndarray, patches: Patches, origin: np.ndarray, footprint: float, sigma: float) -> Surface:
    """Collect the points (H, W, 3) of each patch."""
    flat = patches.label.ravel()
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(len(patches.pixels) + 1))
    coordinates = points.reshape(-1, 3)
    lists = [coordinates[order[starts[k] : starts[k + 1]]] for k in range(len(patches.pixels))]
    return Surface(lists, patches.normal, patches.offset, patches.pixels, patches.centre, patches.touching,
                   origin, footprint, sigma)  # fmt: skip


def convex(surface: Surface, a: int, b: int) -> bool:
    """Whether two patches meet in a convex edge (or none): each one's middle lies behind the other's plane."""
    slack = 3 * surface.sigma
    return (
        surface.normal[a] @ surface.centre[b] - surface.offset[a] < slack
        and surface.normal[b] @ surface.centre[a] - surface.offset[b] < slack
    )


def tangent(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that make a right-handed frame with the normal."""
    first = cross(UP if abs(normal[2]) < 0.9 else ALONG, normal)
    first /= np.linalg.norm(first)
    return first, cross(normal, first)


def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors (3,), without what numpy.cross does for arrays of them: 3 us, not 40."""
    (a, b, c), (x, y, z) = one.tolist(), other.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])


LEVEL = 0.16  # sine of nine degrees: patches as near the vertical or the horizontal are made exactly so
ORTHOGONAL = 0.2  # cosine of the least angle between patches that may be faces of one box
TOUCH = 2  # pixels in which patches of one solid are neighbours, at least
MOST_AXES = 3  # of a cylinder, tried for one cluster of patches
BEYOND = 0.01  # share of a patch's points beyond the ends of its extents: flying pixels


def snap(normal: np.ndarray) -> tuple[np.ndarray, str]:
    """Return a patch normal made exactly vertical or horizontal where it is within about nine degrees of it, and which.

    Returns (normal (3,), "top", "side" or "tilted").
    """
    if normal[2] > np.sqrt(1 - LEVEL**2):
        return UP, "top"
    if abs(normal[2]) < LEVEL:
        flat = np.array([normal[0], normal[1], 0.0])
        return flat / np.linalg.norm(flat), "side"
    return normal, "tilted"


def groups_of_faces(surface: Surface) -> Any:
    """Return the index tuples of one to three patches that can be faces of one box: touching, orthogonal, convex."""
    count = len(surface.pixels)
    pairs = {
        (a, b)
        for a, b in combinations(range(count), 2)
        if surface.touching[a, b] >= TOUCH
        and abs(surface.normal[a] @ surface.normal[b]) < ORTHOGONAL
        and convex(surface, a, b)
    }
    triples = [
        (a, b, c)
        for (a, b) in pairs
        for c in range(b + 1, count)
        if ((a, c) in pairs or (b, c) in pairs)
        and abs(surface.normal[a] @ surface.normal[c]) < ORTHOGONAL
        and abs(surface.normal[b] @ surface.normal[c]) < ORTHOGONAL
        and convex(surface, a, c)
        and convex(surface, b, c)
    ]
    wedges = [
        tuple(sorted((a, b, c)))
        for (a, b) in pairs
        for c in range(b)
        if c != a
        and (min(b, c), max(b, c)) in pairs
        and (a, c) not in pairs
        and abs(surface.normal[a] @ surface.normal[c]) < ORTHOGONAL
        and convex(surface, a, c)
    ]
    return sorted(set(triples) | set(wedges)), sorted(pairs), [(a,) for a in range(count)]


def smallest_rectangle(points: np.ndarray) -> float:
    """Return the angle of the smallest rectangle about points (N, 2)."""
    outline = convex_outline(points)
    if outline is None:
        return 0.0
    edges = np.diff(np.vstack([outline, outline[:1]]), axis=0)
    angles = np.unique(np.round(np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2), 3))
    x = np.outer(np.cos(angles), points[:, 0]) + np.outer(np.sin(angles), points[:, 1])
    y = -np.outer(np.sin(angles), points[:, 0]) + np.outer(np.cos(angles), points[:, 1])
    return angles[np.argmin(np.ptp(x, axis=1) * np.ptp(y, axis=1))]


def leans(surface: Surface, k: int) -> bool:
    """Whether a patch is off the vertical or the horizontal by more than a degree and the accuracy of its normal."""
    snapped, _ = snap(surface.normal[k])
    points = surface.points[k]
    spread = np.sqrt(max(np.linalg.eigvalsh(np.cov(points.T))[1], 1e-12)) if len(points) > 3 else 1e-6
    accuracy = surface.sigma / (np.sqrt(len(points)) * spread)
    return snapped @ surface.normal[k] < np.cos(max(np.radians(1.0), 4.0 * accuracy))


def axes_of(surface: Surface, group: Any, leaning: list[bool]) -> Iterator[Any]:
    """Yield (rotation (3, 3), form) of boxes whose faces are these patches: upright, tilted, or one after the other.

    leaning : of each patch, see `leans`.
    """
    level = all(snap(surface.normal[k])[1] != "tilted" for k in group)
    if level:
        yield box_axes(surface, group, UPRIGHT)
    if not level or any(leaning[k] for k in group):
        yield box_axes(surface, group, FREE)


def box_axes(surface, group, form):
    """Return (rotation (3, 3), form) of the box of this form whose faces are these patches."""
    if form == UPRIGHT:
        snapped = [snap(surface.normal[k]) for k in group]
        weight, turn = 0.0, 0.0 + 0.0j
        for k, (normal, kind) in zip(group, snapped, strict=True):
            if kind == "side":
                angle = np.arctan2(normal[1], normal[0])
                turn += surface.pixels[k] * np.exp(4j * angle)
                weight += surface.pixels[k]
        if weight > 0:
            yaw = np.angle(turn) / 4
        else:
            yaw = smallest_rectangle(surface.points[group[0]][:, :2])
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), UPRIGHT
    order = sorted(group, key=lambda k: -surface.pixels[k])
    first = surface.normal[order[0]]
    if len(order) == 1:
        u, v = tangent(first)
        angle = smallest_rectangle(surface.points[order[0]] @ np.column_stack([u, v]))
        second = np.cos(angle) * u + np.sin(angle) * v
    else:
        second = surface.normal[order[1]] - (surface.normal[order[1]] @ first) * first
        second /= np.linalg.norm(second)
    third = cross(first, second)
    axes = [first, second, third]
    up = int(np.argmax([abs(a[2]) for a in axes]))  # name the axis nearest the vertical z
    z = axes[up] * np.sign(axes[up][2])
    x = axes[(up + 1) % 3]
    return np.column_stack([x, cross(z, x), z]), FREE


def boxes(surface: Surface, group: Any, leaning: list[bool]) -> Iterator[Any]:
    """Yield box hypotheses for one group of patches; where an extent cannot be seen, several guesses of it.

    A patch may run on over a second box flush with the first: where the faces disagree about an extent, the extent of
    each is tried as well as that of all of them.
    """
    for rotation, form in axes_of(surface, group, leaning):
        yield from boxes_along(surface, group, rotation, form)


def boxes_along(surface: Surface, group: Any, rotation: np.ndarray, form: int) -> Iterator[Any]:
    """Yield the same with these axes."""
    margin = 0.25 * surface.footprint
    ends = []  # (low (3,), high (3,)) of each face's points
    fixed_low, fixed_high = np.full(3, np.nan), np.full(3, np.nan)
    across = []
    for k in group:
        along = surface.points[k] @ rotation
        cosine = surface.normal[k] @ rotation
        axis = int(np.argmax(np.abs(cosine)))
        across.append(axis)
        plane = surface.centre[k] @ rotation[:, axis]
        if cosine[axis] > 0:
            fixed_high[axis] = plane
        else:
            fixed_low[axis] = plane
        ends.append(ends_of(along, BEYOND) + [[-margin], [margin]])
    intervals = []
    for axis in range(3):
        seen_by = [e for e, other in zip(ends, across, strict=True) if other != axis]
        if not seen_by:
            intervals.append(hidden_intervals(fixed_low[axis], fixed_high[axis], ends[0], axis, form))
            continue
        options = [(min(e[0][axis] for e in seen_by), max(e[1][axis] for e in seen_by))]
        options += [(e[0][axis], e[1][axis]) for e in seen_by]
        intervals.append(spaced(
            [with_planes(o, fixed_low[axis], fixed_high[axis], axis == 2 and form == UPRIGHT, surface)
             for o in options],
            1.5 * surface.footprint,
        ))  # fmt: skip
    for x, y, z in product(*intervals):
        low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
        size, middle = np.maximum(high - low, THINNEST), rotation @ ((low + high) / 2)
        yield Solid(make_row(BOX, rotation, middle, size), form)


def with_planes(
    interval: tuple[float, float], low: float, high: float, upright: bool, surface: Surface
) -> tuple[float, float]:
    """Return the interval with its ends on the faces that are seen, and on the floor where it is near."""
    start, end = interval
    if not np.isnan(low):
        start = low
    if not np.isnan(high):
        end = high
    if upright and start < max(0.02, 2 * surface.footprint):
        start = 0.0
    return start, max(end, start + THINNEST)


def spaced(values: list[Any], least: float) -> list[Any]:
    """Return numbers, or intervals, without those that differ from an earlier one (at both ends) by `least` at most."""
    kept: list[Any] = []
    for value in values:
        if all(np.abs(np.subtract(value, other)).max() > least for other in kept):
            kept.append(value)
    return kept


def hidden_intervals(low: float, high: float, ends: np.ndarray, axis: int, form: int) -> list[tuple[float, float]]:
    """Return guesses for the extent behind a single face: as long as its sides, short, down to the floor."""
    guesses = [ends[1][k] - ends[0][k] for k in range(3) if k != axis] + [0.04, 0.08]
    if form == UPRIGHT and axis == 2 and not np.isnan(high):
        guesses.append(max(high, THINNEST))
    if np.isnan(high):
        return [(low, low + guess) for guess in guesses]
    return [(high - guess, high) for guess in guesses]


MOST_CORNERS = 16  # of an outline, three of which a circle goes through


def fit_round(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (centre, radius) of the least-squares circle through points (N, 2), or sphere through points (N, 3)."""
    a = np.column_stack([2 * points, np.ones(len(points))])
    (*centre, rest), *_ = np.linalg.lstsq(a, (points**2).sum(axis=1), rcond=None)
    middle = np.array(centre)
    return middle, np.sqrt(max(rest + middle @ middle, 1e-8))


def spheres(surface: Surface, group: Any) -> Iterator[Any]:
    """Yield the sphere through a cluster of patches, if it has a sensible size."""
    points = np.concatenate([surface.points[k] for k in group])
    if len(points) < 12:
        return
    centre, radius = fit_round(points)
    residual = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
    if 0.008 < radius < 0.3 and np.median(residual) < 3 * surface.sigma + 0.02 * radius:
        if abs(centre[2] - radius) < 0.25 * radius:
            centre = np.array([centre[0], centre[1], radius])
        yield Solid(make_row(SPHERE, np.eye(3), centre, np.full(3, 2 * radius)), FREE)


def cylinder_axes(surface: Surface, group: tuple[int, ...]) -> list[np.ndarray]:
    """Return up to MOST_AXES directions for the axis of a cylinder whose side and caps are these patches.

    A cap's normal is the axis; two strips of a side have it as their cross product.  A direction counts by the pixels
    of the patches that are across it or along it.
    """
    normals = surface.normal[list(group)]
    weight = surface.pixels[list(group)].astype(float)
    candidates = [UP, *normals]
    candidates += [cross(a, b) for a, b in combinations(normals, 2) if abs(a @ b) < 0.98]
    found = []
    for axis in candidates:
        axis = axis / np.linalg.norm(axis)
        if abs(axis[2]) > 0.97:
            axis = UP
        elif abs(axis[2]) < 0.15:
            axis = np.array([axis[0], axis[1], 0.0])
            axis /= np.linalg.norm(axis)
        cosine = np.abs(normals @ axis)
        score = weight @ ((cosine < 0.2) | (cosine > 0.97)) + 0.1 * weight @ (cosine < 0.1)
        found.append((score, axis))
    found.sort(key=lambda pair: -pair[0])
    axes = []
    for _, axis in found:
        if all(abs(axis @ other) < 0.98 for other in axes):
            axes.append(axis)
        if len(axes) == MOST_AXES:
            break
    return axes


def cylinders(surface: Surface, group: Any) -> Iterator[Any]:
    """Yield cylinders through a cluster of patches, upright, lying and tilted."""
    points = np.concatenate([surface.points[k] for k in group])
    if len(points) < 12:
        return
    normals = surface.normal[list(group)]
    for axis in cylinder_axes(surface, group):
        form = UPRIGHT if axis[2] == 1.0 else FREE
        u, v = tangent(axis)
        cosine = np.abs(normals @ axis)
        side = [k for k, c in zip(group, cosine, strict=True) if c < 0.4]
        cap = [k for k, c in zip(group, cosine, strict=True) if c > 0.9]
        choices = []
        if side:
            flat = np.concatenate([surface.points[k] for k in side]) @ np.column_stack([u, v])
            if len(flat) >= 8:
                choices.append(fit_round(flat))
                if form == FREE and axis[2] == 0.0:  # lying: its diameter is the height of its highest point
                    choices.append(lying_circle(flat, np.column_stack([u, v])))
        if cap:
            flat = np.concatenate([surface.points[k] for k in cap]) @ np.column_stack([u, v])
            choices.append((flat.mean(axis=0), np.sqrt(2 * flat.var(axis=0).mean()) + 0.25 * surface.footprint))
            choices.extend(rim_circle(flat, surface.footprint))
        heights = points @ axis
        low, high = ends_of(heights, 0.01) + 0.25 * surface.footprint * np.array([-1, 1])
        if form == UPRIGHT and (low < max(0.02, 2 * surface.footprint) or not side):
            low = 0.0
        for centre, radius in choices:
            if not 0.006 < radius < 0.25 or high - low < THINNEST:
                continue
            middle = centre[0] * u + centre[1] * v + 0.5 * (low + high) * axis
            rotation = np.column_stack([u, v, axis])
            yield Solid(make_row(CYLINDER, rotation, middle, [2 * radius, 2 * radius, high - low]), form)


def lying_circle(flat: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (centre, radius) of the circle on the floor that is as high as the points (N, 2) along `axes`."""
    up = UP @ axes
    radius = max(0.5 * np.quantile(flat @ up, 0.99), 0.004)
    across = np.array([-up[1], up[0]])
    return radius * up + np.median(flat @ across) * across, radius


def rim_circle(flat: np.ndarray, footprint: float) -> list[tuple[np.ndarray, float]]:
    """Return [(centre, radius)] of the circle on which most of the outline of points (N, 2) lies, or [].

    What hides a part of a disc cuts its outline along lines: the mean and the spread of what is left are not the
    disc's. The circle goes through three corners of the outline, leaves no corner outside, and of all such has the
    most others near it.
    """
    corners = convex_outline(flat)
    if corners is None or len(corners) < 5:
        return []
    corners = corners[np.unique(np.linspace(0, len(corners) - 1, MOST_CORNERS).round().astype(int))]
    a, b, c = (corners[list(k)] for k in zip(*combinations(range(len(corners)), 3), strict=True))
    first, second = b - a, c - a
    area = 2.0 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    one, other = (first**2).sum(axis=1), (second**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (second[:, 1] * one - first[:, 1] * other) / area
        y = (first[:, 0] * other - second[:, 0] * one) / area
        centre, radius = a + np.column_stack([x, y]), np.hypot(x, y)
        beyond = np.linalg.norm(corners[None] - centre[:, None], axis=2) - radius[:, None]
        near = np.exp(-0.5 * (beyond / (0.5 * footprint)) ** 2).sum(axis=1)
    near[~(beyond.max(axis=1) < footprint)] = 0.0
    best = int(np.argmax(near))
    return [(centre[best], radius[best] + 0.25 * footprint)] if near[best] > 0.0 else []


def clusters(surface):
    """Return tuples of patches joined by convex edges: each with its neighbours, and the whole components."""
    count = len(surface.pixels)
    joined = np.zeros((count, count), bool)
    for a in range(count):
        for b in range(count):
            if a != b and surface.touching[a, b] >= TOUCH and convex(surface, a, b):
                joined[a, b] = True
    own = [[a, *np.flatnonzero(joined[a]).tolist()] for a in range(count)]
    return sorted({tuple(sorted(c)) for c in (*components(joined), *own)})


def all_hypotheses(surface: Surface, shapes: tuple[str, ...]) -> list[Solid]:
    """Return every hypothesis that the patches suggest, for the shapes allowed (box, cube, cylinder, sphere)."""
    found = []
    if "box" in shapes or "cube" in shapes:
        triples, pairs, singles = groups_of_faces(surface)
        leaning = [leans(surface, k) for k in range(len(surface.pixels))]
        for group in triples + pairs + singles:
            found.extend(boxes(surface, group, leaning))
    if "cylinder" in shapes or "sphere" in shapes:
        for group in clusters(surface):
            if "sphere" in shapes:
                found.extend(spheres(surface, group))
            if "cylinder" in shapes:
                found.extend(cylinders(surface, group))
    return found
