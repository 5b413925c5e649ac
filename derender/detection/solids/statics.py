"""Who bears a solid's weight: forces at the points where it touches, in equilibrium with gravity.

Each contact point may push along its normal and, by friction, across it, up to FRICTION times as much: a pyramid of
four forces. Of all forces that hold the solid, the shortest vector is taken (non-negative least squares with a small
ridge), as a stiff but slightly soft contact would share the load.
"""

import numpy as np

from derender.detection.solids.image import rotation_of
from derender.detection.solids.interpenetration import clamp_direction, overlap_along, penetration
from derender.detection.solids.state import FLOOR
from derender.scene.solids import CYLINDER, SPHERE

FRICTION = 0.6  # wood, cardboard and plastics on each other: .3 to .8
MOST_POINTS = 24  # of each pair
ALONG, AROUND = 17, 48  # points along an edge of a box and around a rim of a cylinder
RIDGE = 1e-2
UNBALANCED = 0.2  # of the weight that no force holds: then the contacts that were seen do not explain why it rests


def edge_points(row):
    """Return (K, 3) points on the edges of a solid: where it can touch another one there is one of either's near."""
    if int(row[0]) == SPHERE:
        return np.empty((0, 3))
    half, steps = 0.5 * row[13:16], np.linspace(-1.0, 1.0, ALONG)
    if int(row[0]) == CYLINDER:
        angle = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
        rim = np.column_stack([half[0] * np.cos(angle), half[0] * np.sin(angle)])
        heights = np.concatenate([[1.0, -1.0], steps[1:-1:2]]) * half[2]
        local = np.array([[*place, height] for height in heights for place in rim])
    else:
        signs = np.array([[a, b] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
        local = np.concatenate([
            np.insert(np.repeat(signs, ALONG, axis=0), axis, np.tile(steps, 4), axis=1) * half for axis in range(3)
        ])  # fmt: skip
    return row[10:13] + local @ rotation_of(row).T


def surface_distance(row, points):
    """Return the distances (K,) of points to a solid's surface, negative inside."""
    half = 0.5 * row[13:16]
    local = np.abs((points - row[10:13]) @ rotation_of(row))
    if int(row[0]) == SPHERE:
        return np.linalg.norm(local, axis=1) - half[0]
    beyond = local - half
    if int(row[0]) == CYLINDER:
        beyond = np.column_stack([np.hypot(local[:, 0], local[:, 1]) - half[0], beyond[:, 2]])
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.where(beyond.max(axis=1) > 0, outside, beyond.max(axis=1))


def push_on(row, other):
    """Return the unit vector (3,) along which a solid that touches another is pushed by it: their shadows on it
    overlap least (the separating axis)."""
    first, second, between = rotation_of(row).T, rotation_of(other).T, row[10:13] - other[10:13]
    axes = [*first, *second, *(np.cross(a, b) for a in first for b in second), between]
    for solid, centre in ((row, other[10:13]), (other, row[10:13])):
        beyond = np.array(clamp_direction(solid, *centre))
        axes += [beyond, beyond - (beyond @ first[2]) * first[2], beyond - (beyond @ second[2]) * second[2]]
    axes = [axis / np.linalg.norm(axis) for axis in axes if np.linalg.norm(axis) > 1e-6]
    best = min(axes, key=lambda axis: overlap_along(row, other, *axis))
    return best if best @ between > 0 else -best


def touching_points(row, other, reach):
    """Return the points (K, 3) where a solid touches another (None: the floor)."""
    if other is None:
        own = edge_points(row) if int(row[0]) != SPHERE else row[None, 10:13] - [0.0, 0.0, 0.5 * row[13]]
        points = own[own[:, 2] < reach]
    elif penetration(row, other) < -reach:
        return np.empty((0, 3))
    elif SPHERE in (int(row[0]), int(other[0])):
        ball = row if int(row[0]) == SPHERE else other
        towards = push_on(row, other) * (-0.5 if ball is row else 0.5) * ball[13]
        points = ball[None, 10:13] + towards
    else:
        found = []
        for first, second in ((row, other), (other, row)):
            edges = edge_points(first)
            found.append(edges[np.abs(surface_distance(second, edges)) < reach])
        points = np.concatenate(found)
    if len(points) > MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, MOST_POINTS).round().astype(int)]
    return points


def shares_of_load(rows, k, reach, friction=FRICTION):
    """Return who bears how much of solid k's weight: {index or FLOOR: share}; empty where its contacts cannot hold it.

    Parameters
    ----------
    rows : (N, ROW) of all solids. reach : metres between surfaces that count as touching. friction : see the head.
    """
    from scipy.optimize import nnls

    row = rows[k]
    columns, carriers = [], []
    for other in (FLOOR, *(j for j in range(len(rows)) if j != k)):
        points = touching_points(row, None if other == FLOOR else rows[other], reach)
        if len(points) == 0:
            continue
        normal = np.array([0.0, 0.0, 1.0]) if other == FLOOR else push_on(row, rows[other])
        if normal[2] < -0.5:  # it is what stands on the solid
            continue
        across = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.7 else [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        other_way = np.cross(normal, across)
        force = np.tile(normal + friction * np.array([across, -across, other_way, -other_way]), (len(points), 1))
        turning = np.cross(np.repeat(points - row[10:13], 4, axis=0), force) / row[13:16].max()
        columns.append(np.hstack([force, turning]))
        carriers += [other] * len(force)
    if not columns:
        return {}
    matrix, weight = np.concatenate(columns).T, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    ridge = np.sqrt(RIDGE) * np.eye(matrix.shape[1])
    forces, _ = nnls(np.vstack([matrix, ridge]), np.concatenate([weight, np.zeros(len(ridge))]))
    # the ridge alone lets a share of the weight go
    held = matrix @ forces
    if np.linalg.norm(held / max(held[2], 1e-9) - weight) > UNBALANCED:
        return {}
    shares: dict[int, float] = {}
    for carrier, force, lift in zip(carriers, forces, matrix[2], strict=True):
        shares[carrier] = shares.get(carrier, 0.0) + float(force * lift / held[2])
    return shares
