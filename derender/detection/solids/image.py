"""The observed image in the floor's axes, and solids drawn into it by the ray caster: compiled.

Detection and the draws of bare scenes work in the *floor frame*: z up, the floor at z = 0, the camera's centre at
`origin`.  A solid is one row of ROW numbers: kind, rotation (9, row-major, object to floor), centre (3), size (3).
A pixel's ray is origin + depth * direction with depth along the camera's z, so depths need no conversion.
"""

from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.cache import njit
from derender.render.blur import blur_taps
from derender.render.raycast.convex import PREPARED, inverse_depths, prepare_solid

KIND, ROTATION, CENTRE, SIZE, ROW = 0, 1, 10, 13, 16
FAR = 1e9
LEAST_TAP = 1e-3  # what the blur brings over from further away is left out of the search


class Image(NamedTuple):
    """What the compiled functions need to know of the observation.

    floor : (H, W) float64, depth at which the ray meets the floor, FAR where it does not. Where it is the observed
        depth (to `misfit.AS_SEEN`) the background is taken as it is, blurred already.
    """

    depth: np.ndarray  # (H, W) float64 metres, 0 where nothing returned or the pixel is left out of account
    weight: np.ndarray  # (H, W) float64, 1 / (2 sigma^2) of each pixel, 0 where left out
    direction: np.ndarray  # (H, W, 3) float64, ray per metre of depth, floor axes
    origin: np.ndarray  # (3,) float64, the camera's centre in the floor frame
    floor: np.ndarray
    camera: np.ndarray  # (4,) float64, fx, fy, cx, cy
    pose: np.ndarray  # (4, 4) float64, floor frame to camera
    taps: np.ndarray  # (R + 1,) float64, the blur's weights from the centre outwards (R = 0: a sharp image)


def make_image(
    depth: np.ndarray, sigma: float | np.ndarray, camera: Camera, floor_pose: np.ndarray, blur: float = 0.0
) -> Image:
    """Return the Image of an observation.

    depth : (H, W) float metres, NaN or 0 = no return.
    sigma : (H, W) float or float, standard deviation of the noise in metres.
    floor_pose : (4, 4) floor frame (z up) to camera.
    blur : standard deviation in pixels of the Gaussian blur of Eq. 6.
    """
    rotation, shift = floor_pose[:3, :3], floor_pose[:3, 3]
    direction = camera.rays() @ rotation
    origin = -rotation.T @ shift
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(direction[..., 2] < -1e-9, -origin[2] / direction[..., 2], FAR)
    floor = np.where((floor > 0) & (floor < FAR), floor, FAR)
    good = np.isfinite(depth) & (depth > 0)
    weight = np.where(good, 0.5 / np.broadcast_to(sigma, depth.shape) ** 2, 0.0)
    filled = np.where(good, depth, 0.0)
    arrays = (
        filled,
        weight,
        direction,
        origin,
        floor,
        [camera.fx, camera.fy, camera.cx, camera.cy],
        floor_pose,
        taps_of(blur),
    )
    return Image(*(np.ascontiguousarray(each, dtype=np.float64) for each in arrays))


def taps_of(blur: float) -> np.ndarray:
    """Return the (R + 1,) weights of a blur of this standard deviation in pixels, without the negligible ones."""
    taps = blur_taps(blur)
    taps = taps[taps > LEAST_TAP]
    return taps / (taps[0] + 2.0 * taps[1:].sum())


def blank(image: Image) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth (H, W), label (H, W) and misfit (H, W) arrays to draw into."""
    shape = image.depth.shape
    return np.empty(shape), np.empty(shape, np.int32), np.empty(shape)


@njit(cache=True, nogil=True, borrows=True)
def pose_in(frame, row, pose):
    """Write the pose (4, 4) of a row's solid, object to where a frame (4, 4) leads from the floor's axes."""
    for i in range(3):
        for j in range(3):
            pose[i, j] = frame[i, 0] * row[1 + j] + frame[i, 1] * row[4 + j] + frame[i, 2] * row[7 + j]
        pose[i, 3] = frame[i, 0] * row[10] + frame[i, 1] * row[11] + frame[i, 2] * row[12] + frame[i, 3]
        pose[3, i] = 0.0
    pose[3, 3] = 1.0


@njit(cache=True, nogil=True)
def prepared_row(image, row):
    """Return the bounds on inverse depth (PREPARED,) of a row's solid and the rectangle (4,), see `prepare_solid`."""
    pose, prepared, rectangle = np.empty((4, 4)), np.empty(PREPARED), np.empty(4, np.int64)
    prepare_row(image, row, pose, prepared, rectangle)
    return prepared, rectangle


@njit(cache=True, nogil=True, borrows=True)
def prepare_row(image, row, pose, prepared, rectangle):
    """As `prepared_row`, written into arrays; pose : (4, 4), of the solid in the camera."""
    height, width = image.depth.shape
    pose_in(image.pose, row, pose)
    prepare_solid(int(row[KIND]), pose, row[SIZE:ROW], image.camera, width, height, prepared, rectangle)


@njit(cache=True, nogil=True)
def drawn_alone(image, row):
    """Return the rectangle (4,) that a row's solid may show in, and its inverse depths there, 0 where it does not."""
    prepared, rectangle = prepared_row(image, row)
    left, right, top, bottom = rectangle
    drawn = np.empty((bottom - top, right - left))
    for j in range(top, bottom):
        inverse_depths(prepared, left, j, drawn[j - top])
    return rectangle, drawn


@njit(cache=True, nogil=True)
def put_in(rectangle, drawn, index, depth, label):
    """Put what was drawn alone into depth and label, in place, where it is nearer."""
    left, right, top, bottom = rectangle
    for j in range(top, bottom):
        for i in range(left, right):
            if drawn[j - top, i - left] * depth[j, i] > 1.0:
                depth[j, i] = 1.0 / drawn[j - top, i - left]
                label[j, i] = index


@njit(cache=True, nogil=True)
def draw(image, rows, skip, depth, label):
    """Draw the floor (label -1; -2 nothing) and all solids but number `skip` into depth and label, in place."""
    height, width = image.depth.shape
    for j in range(height):
        for i in range(width):
            depth[j, i] = image.floor[j, i]
            label[j, i] = -1 if image.floor[j, i] < FAR else -2
    for index in range(rows.shape[0]):
        if index != skip:
            rectangle, drawn = drawn_alone(image, rows[index])
            put_in(rectangle, drawn, index, depth, label)


def make_row(kind: int, rotation: Any, centre: Any, size: Any) -> np.ndarray:
    """Return a solid's row from its kind, rotation (3, 3), centre (3,) and size (3,)."""
    row = np.empty(ROW)
    row[KIND] = kind
    row[ROTATION:CENTRE] = np.asarray(rotation).ravel()
    row[CENTRE:SIZE] = centre
    row[SIZE:ROW] = size
    return row


def rotation_of(row: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3), object to floor, of a row."""
    return row[ROTATION:CENTRE].reshape(3, 3)
