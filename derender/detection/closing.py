"""A free-form thing as a closed surface: what is seen of it, and behind each ray the far side of its bounding box."""

import numpy as np

from derender.detection.outline import convex_outline
from derender.detection.solids.image import CENTRE, SIZE, rotation_of
from derender.scene.shapes.thing import encode_surface

MOST_VERTICES = 700  # of what is seen; a surface of more pixels is sampled
LEAST_FOOT = 0.005  # metres under what is seen that may be hidden
DEEP = 0.002  # metres that a thing is deep behind each point that is seen, at least


def closed_surface(image, mask, row, jump):
    """Return (vertices (V, 3) in metres, the box's axes; triangles (T, 3)) of a thing, closed; None where too few show.

    What is seen is joined where neighbours have no jump between them. Nothing is added before it on any ray, so drawing
    the thing gives what was seen.

    image : Image. mask : (H, W) bool. row : (ROW,) the bounding box, floor frame. jump : (H, W) metres between
    neighbouring points of one surface, at most.
    """
    step = max(1, int(np.ceil(np.sqrt(mask.sum() / MOST_VERTICES))))
    seen = np.zeros(mask.shape, bool)
    seen[::step, ::step] = mask[::step, ::step]
    number = np.full(mask.shape, -1)
    number[seen] = np.arange(seen.sum())
    turn, centre, half = rotation_of(row), row[CENTRE:SIZE], 0.5 * row[SIZE:]
    origin = (image.origin - centre) @ turn
    direction = image.direction[seen] @ turn
    near = image.depth[seen]
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = np.where(direction > 0.0, (half - origin) / direction, (-half - origin) / direction)
    far = np.maximum(np.nanmin(np.where(np.abs(direction) > 1e-9, ways, np.inf), axis=1), near + DEEP)
    front = origin + near[:, None] * direction
    back = origin + far[:, None] * direction
    triangles = front_triangles(front, number[::step, ::step], step * jump[seen])
    if len(triangles) < 2:
        return None
    count = len(front)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    open_edges = edges[~np.isin(edges @ [count, 1], edges[:, ::-1] @ [count, 1])]  # with a triangle on one side only
    a, b = open_edges.T
    sides = np.concatenate([np.column_stack([b, a, a + count]), np.column_stack([b, a + count, b + count])])
    faces = np.concatenate([triangles, triangles[:, ::-1] + count, sides])
    used, faces = np.unique(faces, return_inverse=True)
    vertices = np.clip(np.vstack([front, back]), -half, half)[used]
    foot, sides = hidden_foot(vertices, -half[2])
    return np.vstack([vertices, foot]), np.vstack([faces.reshape(-1, 3), sides + len(vertices)])


def hidden_foot(vertices, bottom):
    """Return (vertices (V, 3), triangles (T, 3)) of an upright prism from a height up to the lowest of the vertices.

    What stands before a thing may hide its foot; none where it shows.
    """
    low = float(vertices[:, 2].min())
    corners = convex_outline(np.ascontiguousarray(vertices[:, :2]))
    if low - bottom < LEAST_FOOT or corners is None:
        return np.empty((0, 3)), np.empty((0, 3), int)
    count = len(corners)
    k, after = np.arange(count), np.roll(np.arange(count), -1)
    lower, upper = (np.column_stack([corners, np.full(count, height)]) for height in (bottom, low))
    fan = np.column_stack([np.zeros(count - 2, int), k[1:-1], k[2:]])
    sides = [np.column_stack([k, after, k + count]), np.column_stack([after, after + count, k + count])]
    return np.vstack([lower, upper]), np.concatenate([fan[:, ::-1], fan + count, *sides])


def front_triangles(points, number, jump):
    """Return (T, 3) int: two triangles for each square of four neighbours without a jump, wound towards the camera.

    points (V, 3), jump (V,), and number (H, W): the vertex of each pixel, or -1.
    """
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    triples = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, c, b), (b, c, d))])
    triples = triples[(triples >= 0).all(axis=1)]
    ends = points[triples]
    longest = np.max(np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2), axis=1)
    return triples[longest < jump[triples].min(axis=1)]


def surface_of(image, mask, row, jump):
    """Return (text, size (3,), centre (3,) in the floor frame) of a thing's surface; the box itself where too few show.

    Takes what `closed_surface` does.
    """
    made = closed_surface(image, mask, row, jump)
    if made is None or not (np.ptp(made[0], axis=0) > 0).all():
        return "", row[SIZE:].copy(), row[CENTRE:SIZE].copy()
    text, size, centre = encode_surface(*made)
    return text, size, row[CENTRE:SIZE] + rotation_of(row) @ centre
