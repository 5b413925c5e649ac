"""Whether the camera is the image's: right angles tell, those between the faces of solids and the floor.

A plane whose inverse depth is a (column - cx) + b (row - cy) + c has its normal along (a f, b f, c). Which pixels lie
on one plane therefore says nothing of f, cx and cy, but with wrong ones the angles between planes are not right. Seen
with a wrong focal length a box may be taken for several, or for a free-form thing: the planes in that are its faces.
"""

from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import of_five
from derender.results.fit import Fit, on_best_plane, scatter
from derender.results.trust import Doubt
from derender.scene.graph import SceneGraph

FLOOR = 0  # the label of what shows a plane
BOXES = ("box", "cube")
SAME_PLANE = 1e-4  # share of one depth, by which what shows a floor is off its plane
LEAST_PIXELS = 30  # of a face away from its edges, that tell its normal
MOST_PIXELS = 5_000  # and of how many it is told: more make it surer than SQUARE_WITHIN lets it count
ROUNDS, NO_NOISE = 4, 3.0  # of leaving out what is off the plane by more than so many deviations
SQUARE_WITHIN = np.radians(1.5)  # by which real faces, seen by a biased sensor, are off a right angle
MOST_OF_ONE = 9.0  # squared deviations that one pair of faces may speak with: some solids are not what they seem
SCALES = np.exp(np.linspace(-0.7, 0.7, 141))  # times the focal length that is given
SURELY = 12.0  # squared deviations by which another focal length must explain the angles better
# Times the focal length at which real boxes' angles are right ones. Sensors round edges, which turns faces to each
# other: it was 1.00 to 1.13 of 45 answers to images of nine cameras, .85 to .91 and 1.19 to 1.38 with 20 % wrong ones.
LEAST_FOCAL, MOST_FOCAL = 0.925, 1.2
OFF_MIDDLE = 0.05  # of the longer side: by more than that cx and cy lie off the image's middle where they may be wrong
# Faces of free-form things: planes through three of its pixels that are tried for each, the share of its pixels on one
# and on all of them, how many are looked for; metres by metre, and deviations of the noise, that a pixel is off one.
TRIES, OF_ONE, OF_ALL, MOST_FACES = 150, 0.1, 0.8, 4
NEAR, DEVIATIONS = 0.003, 3.0
UNBENT = 0.87  # share of a face's scatter that a bent surface leaves at least: of a strip of a can it leaves .5 to .85


class Face(NamedTuple):
    """A plane that the image shows: (a, b, c) as above in 1/m and pixels, and their covariance."""

    plane: np.ndarray
    covariance: np.ndarray

    def about(self, change: np.ndarray) -> "Face":
        """Return the Face whose (a, b, c) are a matrix (3, 3) times these."""
        return Face(change @ self.plane, change @ self.covariance @ change.T)


def wrong_camera(faces: list[Face], camera: Camera, given: bool = False) -> list[Doubt]:
    """Return a doubt where with another focal length, or with the middle of the image for cx and cy, far more of the
    angles between Faces are right ones; worth knowing, of a camera that was given, where none is seen that tells."""
    if len(faces) < 2:
        words = "no box is seen that tells whether the camera's focal length is right, on which all lengths hang"
        return [Doubt(words, False)] if given else []
    focal = np.sqrt(camera.fx * camera.fy)
    square = np.diag([camera.fx / focal, camera.fy / focal, 1.0])  # of pixels that are not square
    off = misfit([face.about(square) for face in faces], focal * SCALES)
    best, as_given = float(SCALES[np.argmin(off)]), float(off[len(SCALES) // 2])
    middle = 0.5 * (camera.width - 1), 0.5 * (camera.height - 1)
    moved = np.eye(3)
    moved[2, :2] = middle[0] - camera.cx, middle[1] - camera.cy
    if np.abs(moved[2, :2]).max() > OFF_MIDDLE * max(camera.shape):
        there = float(misfit([face.about(square @ moved) for face in faces], np.array([focal]))[0])
        if as_given - there > SURELY and there <= off.min():
            words = f"the boxes' angles are right ones if cx, cy are the image's middle, {middle[0]:g}, {middle[1]:g}"
            return [Doubt(f"{words}, and not {camera.cx:g}, {camera.cy:g}: check its intrinsics")]
    if as_given - off.min() <= SURELY or LEAST_FOCAL < best < MOST_FOCAL:
        return []
    words = f"the boxes' angles are right ones if the focal length is {best:.2f} times that of the camera"
    return [Doubt(f"{words}, {best * focal:.0f} pixels and not {focal:.0f}: check its intrinsics")]


def faces_of(graph: SceneGraph, fit: Fit, camera: Camera, observed: np.ndarray) -> list[Face]:
    """Return the Faces of floors, of boxes and of free-form things that the image (H, W) shows, told apart by the best
    scene."""
    poses, points = graph.poses(), camera.points(fit.predicted)
    planar = fit.explained & ~fit.background & (fit.label == FLOOR)
    key, things = np.full(fit.label.shape, -1), []
    for place, vertex in enumerate(graph.vertices, start=1):
        pose, size = poses[vertex.name], vertex.body.size()
        mask = fit.label == place
        if size is None:  # beyond its horizon a wall shows, at the side another floor
            key[planar & (np.abs((points - pose[:3, 3]) @ pose[:3, 2]) < SAME_PLANE * fit.predicted)] = 6 * place
        elif vertex.shape in BOXES:
            local = (points[mask] - pose[:3, 3]) @ pose[:3, :3] / np.array(size)
            axis = np.argmax(np.abs(local), axis=1)
            key[mask] = 6 * place + 2 * axis + (np.take_along_axis(local, axis[:, None], axis=1)[:, 0] > 0.0)
        elif vertex.shape == "thing":
            things.append(mask & np.isfinite(observed))
    alike = of_five(np.minimum, key) == of_five(np.maximum, key)
    mask = alike & np.isfinite(observed) & (key >= 0)
    numbers = key[mask]
    across, down, depth = pixels_of(mask, camera, observed)
    found = [fitted(across[own], down[own], depth[own])
             for own in (thinned(np.flatnonzero(numbers == number)) for number in np.unique(numbers))]  # fmt: skip
    for mask in things:
        found += faces_in(*pixels_of(mask, camera, observed), fit)
    return [face for face in found if face is not None]


def pixels_of(mask: np.ndarray, camera: Camera, observed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return of the pixels of a mask (H, W) how far right of cx and below cy they are, and their depths, each (N,)."""
    rows, columns = np.nonzero(mask)
    return columns - camera.cx, rows - camera.cy, observed[mask]


def thinned(numbers: np.ndarray) -> np.ndarray:
    """Return every so many of some numbers (N,) that about MOST_PIXELS are left, at most."""
    return numbers[:: max(1, -(-len(numbers) // MOST_PIXELS))]


def faces_in(across: np.ndarray, down: np.ndarray, depth: np.ndarray, fit: Fit) -> list[Face | None]:
    """Return the Faces that make up what a free-form thing's pixels (N,) show; none where it is bent."""
    rng = np.random.default_rng(0)  # which planes are tried says nothing of the answer
    left, found = thinned(np.arange(len(depth))), []
    design, inverse = np.column_stack([across, down, np.ones(len(depth))]), 1.0 / depth
    allowed = np.maximum(NEAR, DEVIATIONS * fit.noise.at(depth) / depth) * inverse
    least = max(LEAST_PIXELS, OF_ONE * len(left))
    rest = OF_ALL * len(left)
    while len(left) >= least and len(found) < MOST_FACES:
        triples = rng.integers(0, len(left), (TRIES, 3))
        best = on_best_plane(design[left], inverse[left], allowed[left], triples, 1.0)  # square pixels, twice
        if best is None or best.sum() < least:
            break
        own, left = left[best], left[~best]
        rest -= len(own)
        if not bent(across[own], down[own], inverse[own]):
            found.append(fitted(across[own], down[own], depth[own]))
    return found if rest <= 0.0 else []


def bent(across: np.ndarray, down: np.ndarray, inverse: np.ndarray) -> bool:
    """Return whether a quadratic leaves far less of inverse depths (N,) than a plane does."""
    x, y = ((place - place.mean()) / (np.ptp(place) + 1.0) for place in (across, down))
    powers = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    flat, curved = (scatter(inverse - part @ np.linalg.lstsq(part, inverse)[0]) for part in (powers[:, :3], powers))
    return curved < UNBENT * flat


def fitted(across: np.ndarray, down: np.ndarray, depth: np.ndarray) -> Face | None:
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
        deviation = scatter(off[kept]) + np.finfo(float).eps
        within = off < NO_NOISE * deviation
        if (within == kept).all():
            break
        kept = within
    return Face(plane, deviation**2 * np.linalg.inv(spread))


def misfit(faces: list[Face], focal: np.ndarray) -> np.ndarray:
    """Return (S,) the squared deviations by which pairs of faces are not at right angles; focal : (S,) pixels.

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
    one, other = np.tril_indices(len(faces), -1)
    angle = np.arcsin(np.minimum(np.abs(np.sum(normal[:, one] * normal[:, other], axis=2)), 1.0))
    off = np.minimum(angle, 0.5 * np.pi - angle)
    square = off**2 / (variance[:, one] + variance[:, other] + 2.0 * SQUARE_WITHIN**2)
    return np.minimum(square, MOST_OF_ONE).sum(axis=1)
