"""What the antialiased renderer draws on: rows of inverse depth, codes of faces, and the pieces of divided pixels."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.convex import PREPARED, prepare_solid
from derender.render.raycast.outline import LINE, LINES, draw_outline
from derender.scene.solids import PLANE

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

FACE_BITS = 24
FACE_MASK = (1 << FACE_BITS) - 1
QUADRIC = FACE_MASK  # the "face" number of a curved surface; others count the front faces in the order of `prepared`
NOTHING = -1
PIECES: int = 512  # of one pixel at most
CORNERS: int = 24  # of one piece at most
ROOM = 6  # parts and borders to a pixel, on average, that there is room for
SPARE = 1 << 14  # and so many more


class Pieces(NamedTuple):
    """Scratch for one pixel cut into convex polygons, in pixels from its centre.

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

    camera : (4,) float64 fx, fy, cx, cy.
    prepared : (N, PREPARED), rectangle : (N, 4) int64, of every solid; the rectangle one pixel wider than its centres'.
    lines : (N LINES, LINE) float64, outlines, LINES of each solid; line_counts : (N, 2) int64, see `draw_outline`.
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


def new_canvas(camera: "Camera", solids: int) -> Canvas:
    """Allocate a Canvas for a Camera and this many solids, none of them a mesh."""
    height, width = camera.height, camera.width
    pixels = height * width
    room = ROOM * pixels + SPARE
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
        np.zeros((solids * LINES, LINE)),
        np.zeros((solids, 2), np.int64),
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
