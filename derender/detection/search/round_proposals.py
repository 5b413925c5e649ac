"""Hypotheses of spheres and cylinders from clusters of patches."""

from collections.abc import Iterator
from itertools import combinations
from typing import Any

import numpy as np

from derender.detection.outline import convex_outline, ends_of
from derender.detection.search.surface import THINNEST, UP, Hypothesis, Surface, convex, cross, tangent
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.scene.solids import CYLINDER, SPHERE

MOST_CORNERS = 16  # of an outline, three of which a circle goes through


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (centre, radius) of the least-squares sphere through points (N, 3)."""
    a = np.column_stack([2 * points, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(a, (points**2).sum(axis=1), rcond=None)
    return solution[:3], np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 1e-8))


def spheres(surface: Any, group: Any) -> Iterator[Any]:
    """Yield the sphere through a cluster of patches, if it has a sensible size."""
    points = np.concatenate([surface.points[k] for k in group])
    if len(points) < 12:
        return
    centre, radius = fit_sphere(points)
    residual = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
    if 0.008 < radius < 0.3 and np.median(residual) < 3 * surface.sigma + 0.02 * radius:
        if abs(centre[2] - radius) < 0.25 * radius:
            centre = np.array([centre[0], centre[1], radius])
        yield Hypothesis(make_row(SPHERE, np.eye(3), centre, np.full(3, 2 * radius)), FREE, False, tuple(group))


def cylinder_axes(surface: Surface, group: tuple[int, ...], most: Any = 3) -> list[np.ndarray]:
    """Return up to `most` directions for the axis of a cylinder whose side and caps are these patches.

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
        if len(axes) == most:
            break
    return axes


def cylinders(surface: Any, group: Any) -> Iterator[Any]:
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
                choices.append(fit_circle(flat))
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
            row = make_row(CYLINDER, rotation, middle, [2 * radius, 2 * radius, high - low])
            yield Hypothesis(row, form, False, tuple(group))


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


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (centre, radius) of the least-squares circle through points (N, 2)."""
    a = np.column_stack([2 * points, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(a, (points**2).sum(axis=1), rcond=None)
    return solution[:2], np.sqrt(max(solution[2] + solution[:2] @ solution[:2], 1e-8))


def clusters(surface, touch=2):
    """Return tuples of patches joined by convex edges: each with its neighbours, and the whole components."""
    count = len(surface.pixels)
    joined = np.zeros((count, count), bool)
    for a in range(count):
        for b in range(count):
            if a != b and surface.touching[a, b] >= touch and convex(surface, a, b):
                joined[a, b] = True
    found = set()
    remaining = set(range(count))
    while remaining:
        component, frontier = set(), {remaining.pop()}
        while frontier:
            component |= frontier
            frontier = {b for a in frontier for b in np.flatnonzero(joined[a])} - component
        remaining -= component
        found.add(tuple(sorted(int(k) for k in component)))
    for a in range(count):
        found.add((a, *[int(b) for b in np.flatnonzero(joined[a])]))
    return sorted({tuple(sorted(c)) for c in found})
