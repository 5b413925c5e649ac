"""Brute-force geometry for the tests of contacts: written from the solids' sizes alone, it shares no code with them."""

import math
from itertools import product

import numpy as np

from derender.scene.contacts import contacts
from derender.scene.separation import separation
from derender.scene.shapes import Body, shapes
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE

FLUSH = 1e-9  # metres; rounding of a few products of numbers below 1 is a million times less
ANGLES = np.linspace(0, 2 * math.pi, 721)


def random_body(rng, name, options=None):
    """Return a body of a registered shape with random parameters of household size."""
    shape = shapes[name]
    return Body(shape, rng.uniform(0.04, 0.12, len(shape.parameters)), options or {})


def all_choices(parents=None, children=None, types=None):
    """Return every (type, parent, child, parent_face, child_face) that the registries hold.

    Without meshes, which need a file, compounds, which need parts, things, whose faces are those of a box, and those
    whose faces are not those of their box (tests/scene/test_hollow_and_compound_shapes.py looks at them).
    """
    names = [name for name in shapes if name not in ("mesh", "thing", "compound", "open-box", "frustum")]
    return [
        (kind, parent, child, *pair)
        for kind in types or contacts
        for parent in parents or names
        for child in children or names
        for pair in contacts[kind].choices(shapes[parent], shapes[child])
    ]


def random_values(rng, parameters, slack=0.0):
    """Return a value for each parameter: inside its range, x and y within 0.3 m, slack up to `slack`."""
    values = {}
    for parameter in parameters:
        if parameter.slack:
            if slack:
                values[parameter.name] = rng.uniform(-slack, slack)
        elif math.isfinite(parameter.lower):
            values[parameter.name] = rng.uniform(parameter.lower, parameter.upper)
        else:
            values[parameter.name] = rng.uniform(-0.3, 0.3)
    return values


def face_axes(body, name):
    """Return a flat face's centre and outward normal in object axes, read off its name and the size."""
    axis, sign = "xyz".index(name[1]), 1.0 if name[0] == "+" else -1.0
    normal = sign * np.eye(3)[axis]
    size = body.size()
    return (np.zeros(3) if size is None else 0.5 * size * normal), normal


def surface_points(body):
    """Return points (M, 3) in object axes whose convex hull is the solid, or stands for it."""
    kind, size = body.shape.solid_kind, body.size()
    if kind == BOX:
        return np.array(list(product((-0.5, 0.5), repeat=3))) * size
    if kind == CYLINDER:
        ring = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1) * 0.5 * size[0]
        return np.concatenate([np.column_stack([ring, np.full(len(ring), z * size[2])]) for z in (-0.5, 0.5)])
    if kind == PLANE:
        return np.array([[x, y, 0.0] for x, y in product((-5.0, 5.0), repeat=2)])
    return np.asarray(body.shape.mesh(body.psi, body.options).vertices)


def lowest(body, pose, centre, normal):
    """Return the least height of the solid over the plane (centre, normal), exactly for round solids."""
    down = -(pose[:3, :3].T @ normal)
    height = normal @ (pose[:3, 3] - centre)
    kind, size = body.shape.solid_kind, body.size()
    if kind == SPHERE:
        return height - 0.5 * size[0]
    if kind == CYLINDER:
        return height - 0.5 * (math.hypot(down[0], down[1]) * size[0] + abs(down[2]) * size[2])
    return height - float(np.max(surface_points(body) @ down))


def touching_set(body, pose, centre, normal):
    """Return (points (M, 3) of the solid on the plane, radius around them): its touching outline in the world."""
    if body.shape.solid_kind == SPHERE:
        return pose[None, :3, 3] - 0.5 * body.size()[0] * normal, 0.0
    if body.shape.solid_kind == CYLINDER:
        axis, size = pose[:3, 2], body.size()
        if abs(abs(axis @ normal) - 1) < 1e-9:
            return pose[None, :3, 3] - 0.5 * size[2] * normal, 0.5 * size[0]
        ends = pose[:3, 3] + np.outer([-0.5 * size[2], 0.5 * size[2]], axis)
        down = -(normal - (normal @ axis) * axis)
        points = ends + 0.5 * size[0] * down / np.linalg.norm(down)
    else:
        points = surface_points(body) @ pose[:3, :3].T + pose[:3, 3]
    heights = (points - centre) @ normal
    return points[np.abs(heights) < FLUSH], 0.0


def outline_gap(first, second, normal):
    """Return the separation in metres of two convex outlines in the plane: positive apart, negative overlapping.

    The maximum over directions of the gap between their shadows: a fine fan of directions, and those square to every
    edge and along every pair of points, among which it is exact for polygons and discs.
    """
    (points, radius), (others, other_radius) = first, second
    across = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    basis = np.stack([across / np.linalg.norm(across), np.cross(normal, across / np.linalg.norm(across))])
    p, q = points @ basis.T, others @ basis.T
    fan = [np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)]
    for cloud in (p, q):
        edges = (cloud[:, None] - cloud[None]).reshape(-1, 2)
        fan.append(np.stack([-edges[:, 1], edges[:, 0]], axis=1))
    fan.append((q[:, None] - p[None]).reshape(-1, 2))
    directions = np.concatenate(fan)
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 1e-9] / length[length > 1e-9, None]
    gaps = (q @ directions.T).min(axis=0) - (p @ directions.T).max(axis=0)
    return float(gaps.max() - radius - other_radius)


def contact_faults(pose, parent, child, parent_face, flush_points=None):
    """Return what is wrong with a contact: "interpenetrates", "hovers", "misses", "not flush"; empty if nothing is."""
    centre, normal = face_axes(parent, parent_face)
    height = lowest(child, pose, centre, normal)
    if height < -FLUSH:
        return ["interpenetrates"]
    if height > FLUSH:
        return ["hovers"]
    touching = touching_set(child, pose, centre, normal)
    faults = []
    if flush_points is not None and len(touching[0]) != flush_points:
        faults.append("not flush")
    if parent.shape.bounded and child.shape.bounded:
        own = touching_set(parent, np.eye(4), centre, -normal)
        if outline_gap(own, touching, normal) > FLUSH:
            faults.append("misses")
    return faults


def overlaps(solids):
    """Return the (N, N) depths in metres by which solids interpenetrate; 0 on the diagonal."""
    count = range(len(solids.kind))
    return np.array([[max(0.0, -separation(solids, i, j)) if i != j else 0.0 for j in count] for i in count])
