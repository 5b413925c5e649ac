"""Whether the camera's focal length is right, told by right angles: those between the faces of boxes and the floor.

On a plane the inverse depth is affine in the pixel's place, a (column - cx) + b (row - cy) + c, whatever the focal
length f is; the plane's normal is along (a f, b f, c). Seen with a wrong one, right angles are not right.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.results.fit import Fit
from derender.results.trust import Doubt

if TYPE_CHECKING:
    from derender.scene.graph import SceneGraph

FLOOR = 0  # the label of what shows a plane
BOXES = ("box", "cube")
LEAST_PIXELS = 30  # of a face away from its edges, that tell its normal
MOST_PIXELS = 5_000  # and of how many it is told: more make it surer than SQUARE_WITHIN lets it count
ROUNDS, NO_NOISE = 4, 3.0  # of leaving out what is off the plane by more than so many deviations
SQUARE_WITHIN = np.radians(1.5)  # by which real faces, seen by a biased sensor, are off a right angle
MOST_OF_ONE = 9.0  # squared deviations that one pair of faces may speak with: some solids are not what they seem
SCALES = np.exp(np.linspace(-0.7, 0.7, 141))  # times the focal length that is given
# Squared deviations by which another focal length must explain the angles better, and the share of those of one
# object's faces and the floor that it may leave: what is no box has angles that no focal length makes right.
SURELY, LEFT = 12.0, 0.25
WRONG_BY = 1.08  # times, from which on a focal length makes lengths wrong that matter


class Face(NamedTuple):
    """A plane that the image shows: whose label it has, (a, b, c) as above in 1/m and pixels, and their covariance."""

    label: int
    plane: np.ndarray
    covariance: np.ndarray


def wrong_focal_length(graph: "SceneGraph", fit: Fit, camera: Camera, observed: np.ndarray) -> list[Doubt]:
    """Return a doubt where another focal length makes far more of the angles right that should be.

    graph : the best scene. fit : of it to the depths `observed` (H, W) in metres that this camera saw.
    """
    return doubts_of(faces_of(graph, fit, camera, observed), camera)


def doubts_of(found: list[Face], camera: Camera) -> list[Doubt]:
    """Return the doubt that Faces raise about a camera, if any."""
    if len(found) < 2:
        return []
    focal = np.sqrt(camera.fx * camera.fy)
    stretch = np.array([camera.fx / focal, camera.fy / focal, 1.0])  # of pixels that are not square
    faces = [face._replace(plane=face.plane * stretch, covariance=face.covariance * np.outer(stretch, stretch))
             for face in found]  # fmt: skip
    all_pairs, own = misfit(faces, focal * SCALES)
    given, place = len(SCALES) // 2, int(np.argmin(all_pairs))
    best = float(SCALES[place])
    better = all_pairs[given] - all_pairs[place] > SURELY and own[place] < LEFT * own[given]
    if not better or max(best, 1.0 / best) < WRONG_BY:
        return []
    words = (
        f"the boxes' angles are right ones if the focal length is {best:.2f} times that of the camera, "
        f"{best * focal:.0f} pixels and not {focal:.0f}: check its intrinsics"
    )
    return [Doubt(words)]


def faces_of(graph: "SceneGraph", fit: Fit, camera: Camera, observed: np.ndarray) -> list[Face]:
    """Return the Faces of the floor and of boxes that the image (H, W) shows, told apart by the best scene."""
    named = {vertex.name: place for place, vertex in enumerate(graph.vertices, start=1) if vertex.shape in BOXES}
    poses = graph.poses()
    points = camera.points(fit.predicted)
    key = np.where(fit.explained & ~fit.background & (fit.label == FLOOR), 0, -1)
    for name, place in named.items():
        mask = fit.label == place
        local = (points[mask] - poses[name][:3, 3]) @ poses[name][:3, :3] / np.array(graph.vertex(name).body.size())
        axis = np.argmax(np.abs(local), axis=1)
        key[mask] = 6 * place + 2 * axis + (np.take_along_axis(local, axis[:, None], axis=1)[:, 0] > 0.0)
    inner = np.zeros(key.shape, bool)
    middle = key[1:-1, 1:-1]
    about = (key[:-2, 1:-1], key[2:, 1:-1], key[1:-1, :-2], key[1:-1, 2:])
    inner[1:-1, 1:-1] = np.all([middle == side for side in about], axis=0)
    inner &= np.isfinite(observed) & (key >= 0)
    rows, columns = np.nonzero(inner)
    numbers = key[rows, columns]
    if len(numbers) == 0:
        return []
    order = np.argsort(numbers, kind="stable")
    each, first = np.unique(numbers[order], return_index=True)
    found = []
    for number, of_face in zip(each, np.split(order, first[1:]), strict=True):
        some = of_face[:: -(-len(of_face) // MOST_PIXELS)]
        across, down = columns[some] - camera.cx, rows[some] - camera.cy
        found.append(fitted(int(number) // 6, across, down, observed[rows[some], columns[some]]))
    return [face for face in found if face is not None]


def fitted(label: int, across: np.ndarray, down: np.ndarray, depth: np.ndarray) -> Face | None:
    """Return the Face through the depths of most of the pixels (N,), so far from the centre; None: they are too few."""
    design, inverse = np.array([across, down, np.ones(len(down))], float), 1.0 / depth
    kept = np.ones(len(down), bool)
    for _ in range(ROUNDS):
        if kept.sum() < LEAST_PIXELS:
            return None
        some = design[:, kept]
        spread = some @ some.T
        if np.linalg.matrix_rank(spread) < 3:
            return None
        plane = np.linalg.solve(spread, some @ inverse[kept])
        off = np.abs(inverse - plane @ design)
        deviation = 1.4826 * float(np.median(off[kept])) + np.finfo(float).eps
        within = off < NO_NOISE * deviation
        if (within == kept).all():
            break
        kept = within
    return Face(label, plane, deviation**2 * np.linalg.inv(spread))


def misfit(faces: list[Face], focal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared deviations by which pairs of faces are not at right angles: of all, and of one object.

    focal : (S,) pixels; both results are (S,).

    Seen with a wrong focal length one box is taken for several, so that all pairs tell which is right. Boxes that are
    turned against each other are so with every one, and speak with no more than MOST_OF_ONE.
    """
    scale = np.column_stack([focal, focal, np.ones(len(focal))])[:, None]  # (S, 1, 3): below come faces, then axes
    normal = np.array([face.plane for face in faces]) * scale
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    normal /= length
    across = np.eye(3) - normal[..., :, None] * normal[..., None, :]
    covariance = np.array([face.covariance for face in faces]) * (scale[..., :, None] * scale[..., None, :])
    variance = np.einsum("sfij,sfji->sf", covariance, across) / (2.0 * length[..., 0] ** 2)
    label = np.array([face.label for face in faces])
    one, other = np.tril_indices(len(faces), -1)
    angle = np.arcsin(np.minimum(np.abs(np.sum(normal[:, one] * normal[:, other], axis=2)), 1.0))
    off = np.minimum(angle, 0.5 * np.pi - angle)
    square = np.minimum(off**2 / (variance[:, one] + variance[:, other] + 2.0 * SQUARE_WITHIN**2), MOST_OF_ONE)
    own = (label[one] == label[other]) | (label[other] == FLOOR)
    return square.sum(axis=1), square[:, own].sum(axis=1)
