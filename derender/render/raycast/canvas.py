"""What the antialiased renderer draws on: rows of inverse depth, codes of faces, and the pieces of divided pixels.

Triangle meshes on it are planes of inverse depth, edges as lines, and which triangles a pixel sees. A triangle that
faces the camera is one more flat face. Where the mesh is closed, its other triangles are hidden, and the outline is the
edges between the two kinds; edges between two that are seen matter as creases only.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.convex import PREPARED, prepare_solid
from derender.render.raycast.outline import LINE, LINES, add_line, draw_outline
from derender.scene.solids import MESH, PLANE, Solids

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

NEAR = 1e-4  # metres: a triangle that comes nearer to the camera's plane is left out
FLAT, CREASE, OUTLINE = range(3)  # a side between triangles that are seen and nearly in line, at an angle, or not so
SHARP = 0.95  # cosine of the angle between neighbours from which their crease is taken for none


class Facets(NamedTuple):
    """The triangles of all mesh solids of a scene, and of every pixel. T triangles, V vertices.

    Attributes
    ----------
    first : (N + 1,) int64, the first triangle of each solid; vertex : (N + 1,) int64, its first vertex.
    vertices : (V, 3) float64, object axes, as shares of the solid's extents.
    triangles : (T, 3) int64, vertices. neighbours : (T, 3) int64, the triangle across each side, -1 if there is none.
    winding : (N,) int64, 1 or -1 where a mesh is closed: by which winding triangles face outwards; else 0.
    points : (V, 3) float64, camera axes. plane : (T, 3) float64, inverse depth a + b i + c j.
    normal : (T, 3) float64. side : (T, 3) int64, what the side from each corner to the next is: FLAT, CREASE, OUTLINE.
    shown : (T,) bool. solid : (T,) int64.
    bounds : (T, 4) int64, columns and rows that it may touch, ends excluded.
    listed : (H, W, 2) int64, start and end of each mixed pixel's part of what `list_facets` returned last.
    """

    first: np.ndarray
    vertex: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    neighbours: np.ndarray
    winding: np.ndarray
    points: np.ndarray
    plane: np.ndarray
    normal: np.ndarray
    side: np.ndarray
    shown: np.ndarray
    solid: np.ndarray
    bounds: np.ndarray
    listed: np.ndarray


def _neighbours(triangles: np.ndarray) -> np.ndarray:
    """Return (T, 3) the triangle across the side from each corner to the next, -1 where there is none or several."""
    sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    number = {}
    for n, (start, end) in enumerate(sides.tolist()):
        number[start, end] = -1 if (start, end) in number else n // 3
    return np.array([number.get((end, start), -1) for start, end in sides.tolist()], np.int64).reshape(-1, 3)


def new_facets(camera: "Camera", count: int, solids: Solids | None = None) -> Facets:
    """Allocate Facets for a Camera and scenes with the meshes of these Solids; without meshes almost nothing."""
    first, vertex = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    winding = np.zeros(count, np.int64)
    vertices, triangles, neighbours, solid = [np.zeros((0, 3))], [np.zeros((0, 3), int)], [np.zeros((0, 3), int)], []
    for k in range(count):
        first[k + 1], vertex[k + 1] = first[k], vertex[k]
        if solids is None or solids.kind[k] != MESH:
            continue
        points, corners = (np.asarray(array) for array in solids.meshes[solids.mesh[k]])
        across = _neighbours(corners)
        a, b, c = (points[corners[:, n]] for n in range(3))
        winding[k] = int(np.sign(np.sum(a * np.cross(b, c)))) if np.all(across >= 0) else 0
        vertices.append(points / np.maximum(2.0 * np.abs(points).max(axis=0), 1e-12))
        triangles.append(corners + vertex[k])
        neighbours.append(np.where(across >= 0, across + first[k], -1))
        solid += [k] * len(corners)
        first[k + 1], vertex[k + 1] = first[k] + len(corners), vertex[k] + len(points)
    total = max(first[-1], 1)
    return Facets(
        first,
        vertex,
        np.concatenate(vertices),
        np.concatenate(triangles).astype(np.int64),
        np.concatenate(neighbours).astype(np.int64),
        winding,
        np.zeros((max(vertex[-1], 1), 3)),
        np.zeros((total, 3)),
        np.zeros((total, 3)),
        np.zeros((total, 3), np.int64),
        np.zeros(total, np.bool_),
        np.array([*solid, 0], np.int64),
        np.zeros((total, 4), np.int64),
        np.zeros((camera.height, camera.width, 2) if solid else (1, 1, 2), np.int64),
    )


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def pose_facets(facets, k, pose, size, camera, width, height, lines, base):
    """Place the triangles of mesh solid k: planes, bounds, and their sides' lines, the first of all at lines[base]."""
    points, triangles, plane, normal = facets.points, facets.triangles, facets.plane, facets.normal
    vertices, shown, bounds, winding = facets.vertices, facets.shown, facets.bounds, facets.winding[k]
    for v in range(facets.vertex[k], facets.vertex[k + 1]):
        x, y, z = vertices[v, 0] * size[0], vertices[v, 1] * size[1], vertices[v, 2] * size[2]
        for axis in range(3):
            points[v, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
    middle = np.zeros(3)
    for t in range(facets.first[k], facets.first[k + 1]):
        shown[t] = False
        p, q, r = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if min(points[p, 2], points[q, 2], points[r, 2]) < NEAR:
            continue
        ax, ay, az = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1], points[q, 2] - points[p, 2]
        bx, by, bz = points[r, 0] - points[p, 0], points[r, 1] - points[p, 1], points[r, 2] - points[p, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        offset = nx * points[p, 0] + ny * points[p, 1] + nz * points[p, 2]
        if abs(offset) < 1e-9 * length or offset * winding > 0.0:  # edge on, or seen from behind
            continue
        normal[t, 0], normal[t, 1], normal[t, 2] = nx / length, ny / length, nz / length
        plane[t, 1], plane[t, 2] = nx / (offset * camera[0]), ny / (offset * camera[1])
        plane[t, 0] = nz / offset - plane[t, 1] * camera[2] - plane[t, 2] * camera[3]
        left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
        for corner in range(3):
            v = triangles[t, corner]
            i = camera[0] * points[v, 0] / points[v, 2] + camera[2]
            j = camera[1] * points[v, 1] / points[v, 2] + camera[3]
            left, right, top, bottom = min(left, i), max(right, i), min(top, j), max(bottom, j)
        bounds[t, 0], bounds[t, 1] = int(max(np.ceil(left - 0.5), 0)), int(min(np.floor(right + 0.5) + 1, width))
        bounds[t, 2], bounds[t, 3] = int(max(np.ceil(top - 0.5), 0)), int(min(np.floor(bottom + 0.5) + 1, height))
        for axis in range(3):
            middle[axis] = (points[p, axis] + points[q, axis] + points[r, axis]) / 3.0
        good = True
        for side in range(3):
            start, end = points[triangles[t, side]], points[triangles[t, (side + 1) % 3]]
            line = base + 3 * t + side
            good = add_line(lines, line, start, end, middle, camera) > line and good
        shown[t] = good
    for t in range(facets.first[k], facets.first[k + 1]):
        if shown[t]:
            for side in range(3):
                facets.side[t, side] = _side(facets.neighbours[t, side], t, shown, normal, points[triangles[t, side]])


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _side(other, t, shown, normal, corner):
    """What the side between a triangle that is seen and another one is; they share a corner."""
    if other < 0 or not shown[other]:
        return OUTLINE
    cosine, here, there = 0.0, 0.0, 0.0
    for axis in range(3):
        cosine += normal[t, axis] * normal[other, axis]
        here += normal[t, axis] * corner[axis]
        there += normal[other, axis] * corner[axis]
    if here * there < 0.0:  # an open mesh, of which one is seen from inside: it folds here
        return OUTLINE
    return CREASE if cosine < SHARP else FLAT


FACE_BITS = 24
FACE_MASK = (1 << FACE_BITS) - 1
QUADRIC = FACE_MASK  # the "face" number of a curved surface; others count the front faces in the order of `prepared`
NOTHING = -1
PIECES: int = 512  # of one pixel at most
CORNERS: int = 24  # of one piece at most
ROOM = 6  # parts and borders to a pixel or triangle, on average, that there is room for
SPARE = 1 << 14  # and so many more


class Pieces(NamedTuple):
    """Scratch for one pixel cut into convex polygons, in pixels from its centre.

    Attributes
    ----------
    corner : (PIECES, CORNERS, 2) float64, corners in order. edge : (PIECES, CORNERS) int64, what the edge from this
        corner to the next is: -1, or twice the number of a line of an outline, one more on its outer side.
    corners, code : (PIECES,) int64. plane : (PIECES, 3) float64, inverse depth at the centre and its slopes, of flat
        ones. lines : (LINES, 3) float64, edges : (LINES, 2) int64, the lines that bound what is put in, and their edges
        inside and outside. across : (CORNERS,) float64, of a quadrature.
    """

    corner: np.ndarray
    edge: np.ndarray
    corners: np.ndarray
    code: np.ndarray
    plane: np.ndarray
    lines: np.ndarray
    edges: np.ndarray
    across: np.ndarray


class Canvas(NamedTuple):
    """Arrays of one antialiased rendering, made by `new_canvas` and written by `draw_antialiased`.

    Attributes
    ----------
    camera : (4,) float64 fx, fy, cx, cy.
    prepared : (N, PREPARED), rectangle : (N, 4) int64, of every solid; the rectangle one pixel wider than its centres'.
    lines : (N LINES + 3 T, LINE) float64, outlines, LINES of each solid, then the sides of all triangles;
        line_counts : (N, 2) int64, see `draw_outline`. facets : Facets, the T triangles of meshes.
    order : (N,) int64, the solids from near to far, planes last: what is hidden then cuts nothing.
    inverse : (H, W) float64, inverse depth at pixel centres. code : (H, W) int64, what is seen there:
        (solid << FACE_BITS) + face, or NOTHING. mixed : (H, W) uint8, not 0 where a pixel is divided: 1
        for an outline or crease, 2 for a neighbour of another label.
    depth : (H, W) float64, the antialiased image in metres.
    part_range, border_range : (H * W, 2) int64, first and end of each mixed pixel's parts and borders. used : (2,)
        int64, how many parts and borders are taken; those of pixels drawn again since are among them.
    drawn_pose : (N, 4, 4), drawn_size : (N, 3) float64, drawn_window : (4,) int64, of what was drawn last; an empty
        window if nothing was. dirty : (4,) int64, the pixels that the last drawing drew.
    part_code : (P,) int64, parts : (P, 3) float64, share of the pixel and the image point (column, row) that stands
        for it. What sees nothing is left out.
    border_code : (B, 2) int64, the edge (see Pieces) and the code of the piece that it bounds. borders : (B, 4)
        float64, column and row of its ends.
    pieces : Pieces.
    """

    camera: np.ndarray
    prepared: np.ndarray
    rectangle: np.ndarray
    lines: np.ndarray
    line_counts: np.ndarray
    facets: Facets
    order: np.ndarray
    inverse: np.ndarray
    code: np.ndarray
    mixed: np.ndarray
    depth: np.ndarray
    part_range: np.ndarray
    border_range: np.ndarray
    used: np.ndarray
    drawn_pose: np.ndarray
    drawn_size: np.ndarray
    drawn_window: np.ndarray
    dirty: np.ndarray
    part_code: np.ndarray
    parts: np.ndarray
    border_code: np.ndarray
    borders: np.ndarray
    pieces: Pieces


def new_canvas(camera: "Camera", solids: int, scene: Solids | None = None) -> Canvas:
    """Allocate a Canvas for a Camera and this many solids; where there are meshes, a scene with them must be given."""
    height, width = camera.height, camera.width
    pixels = height * width
    facets = new_facets(camera, solids, scene)
    room = ROOM * (pixels + int(facets.first[-1])) + SPARE
    pieces = Pieces(
        np.zeros((PIECES, CORNERS, 2)),
        np.zeros((PIECES, CORNERS), np.int64),
        np.zeros(PIECES, np.int64),
        np.zeros(PIECES, np.int64),
        np.zeros((PIECES, 3)),
        np.zeros((LINES, 3)),
        np.zeros((LINES, 2), np.int64),
        np.zeros(CORNERS),
    )
    return Canvas(
        np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
        np.zeros((solids, PREPARED)),
        np.zeros((solids, 4), np.int64),
        np.zeros((solids * LINES + 3 * int(facets.first[-1]), LINE)),
        np.zeros((solids, 2), np.int64),
        facets,
        np.arange(solids),
        np.zeros((height, width)),
        np.zeros((height, width), np.int64),
        np.zeros((height, width), np.uint8),
        np.zeros((height, width)),
        np.zeros((pixels, 2), np.int64),
        np.zeros((pixels, 2), np.int64),
        np.zeros(2, np.int64),
        np.zeros((solids, 4, 4)),
        np.zeros((solids, 3)),
        np.zeros(4, np.int64),
        np.zeros(4, np.int64),
        np.zeros(room, np.int64),
        np.zeros((room, 3)),
        np.zeros((room, 2), np.int64),
        np.zeros((room, 4)),
        pieces,
    )


@njit(cache=True, nogil=True)
def prepare(canvas, k, kinds, poses, sizes):
    """Prepare solid k: bounds, outline, and rectangle, a pixel wider: it may reach pixels whose centres it misses."""
    height, width = canvas.depth.shape
    rectangle = canvas.rectangle[k]
    prepare_solid(kinds[k], poses[k], sizes[k], canvas.camera, width, height, canvas.prepared[k], rectangle)
    if rectangle[0] < rectangle[1]:
        rectangle[0], rectangle[1] = max(rectangle[0] - 1, 0), min(rectangle[1] + 1, width)
        rectangle[2], rectangle[3] = max(rectangle[2] - 1, 0), min(rectangle[3] + 1, height)
    if kinds[k] == MESH:
        sides = kinds.shape[0] * LINES
        pose_facets(canvas.facets, k, poses[k], sizes[k], canvas.camera, width, height, canvas.lines, sides)
    elif rectangle[0] < rectangle[1]:
        lines = canvas.lines[k * LINES : (k + 1) * LINES]
        draw_outline(kinds[k], poses[k], sizes[k], canvas.camera, lines, canvas.line_counts[k])


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _farther(kinds, poses, first, second):
    """Does the first solid come after the second?"""
    return kinds[first] == PLANE or poses[first, 2, 3] > poses[second, 2, 3]


@njit(cache=True, nogil=True)
def sort_solids(canvas, kinds, poses):
    """Write the solids' order."""
    for k in range(kinds.shape[0]):
        n = k
        while n > 0 and kinds[k] != PLANE and _farther(kinds, poses, canvas.order[n - 1], k):
            canvas.order[n] = canvas.order[n - 1]
            n -= 1
        canvas.order[n] = k
