"""The observed image in the floor's axes, and solids drawn into it: compiled, rectangle by rectangle.

Detection and the draws of bare scenes work in the *floor frame*: z up, the floor at z = 0, the camera's centre at
`origin`.  A solid is one row of ROW numbers: kind, rotation (9, row-major, object to floor), centre (3), size (3).
A pixel's ray is origin + depth * direction with depth along the camera's z, so depths need no conversion.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.detection.pyramid import intrinsics
from derender.render.blur import blur_taps
from derender.scene.solids import BOX, CYLINDER, SPHERE

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

KIND, ROTATION, CENTRE, SIZE, ROW = 0, 1, 10, 13, 16
FAR = 1e9
NEAREST = 1e6  # 1 / metres: nothing is nearer
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
    projection: np.ndarray  # (3, 4) float64, floor frame to homogeneous pixel (i, j, 1) times depth
    taps: np.ndarray  # (R + 1,) float64, the blur's weights from the centre outwards (R = 0: a sharp image)


def make_image(
    depth: np.ndarray,
    sigma: float | np.ndarray,
    camera: "Camera | dict[str, float]",
    floor_pose: np.ndarray,
    blur: float = 0.0,
) -> Image:
    """Return the Image of an observation.

    depth : (H, W) float metres, NaN or 0 = no return.
    sigma : (H, W) float or float, standard deviation of the noise in metres.
    camera : anything with fx, fy, cx, cy as attributes or a dict of them.
    floor_pose : (4, 4) floor frame (z up) to camera.
    blur : standard deviation in pixels of the Gaussian blur of Eq. 6.
    """
    fx, fy, cx, cy = intrinsics(camera)
    height, width = depth.shape
    rotation, shift = floor_pose[:3, :3], floor_pose[:3, 3]
    column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    direction = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones_like(column)], axis=-1) @ rotation
    origin = -rotation.T @ shift
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(direction[..., 2] < -1e-9, -origin[2] / direction[..., 2], FAR)
    floor = np.where((floor > 0) & (floor < FAR), floor, FAR)
    good = np.isfinite(depth) & (depth > 0)
    weight = np.where(good, 0.5 / np.broadcast_to(sigma, depth.shape) ** 2, 0.0)
    projection = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]) @ np.column_stack([rotation, shift])
    filled = np.where(good, depth, 0.0)
    return Image(*(np.ascontiguousarray(a, dtype=np.float64)
                   for a in (filled, weight, direction, origin, floor, projection, taps_of(blur))))  # fmt: skip


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
def bounding_rectangle(row, projection, height, width):
    """Return (i0, i1, j0, j1): the pixels, ends excluded, that can see the solid; all if it reaches behind."""
    left, right, top, bottom = 1e30, -1e30, 1e30, -1e30
    for corner in range(8):
        x = row[13] * (0.5 if corner & 1 else -0.5)
        y = row[14] * (0.5 if corner & 2 else -0.5)
        z = row[15] * (0.5 if corner & 4 else -0.5)
        px = row[1] * x + row[2] * y + row[3] * z + row[10]
        py = row[4] * x + row[5] * y + row[6] * z + row[11]
        pz = row[7] * x + row[8] * y + row[9] * z + row[12]
        w = projection[2, 0] * px + projection[2, 1] * py + projection[2, 2] * pz + projection[2, 3]
        if w < 1e-3:
            return 0, width, 0, height
        u = (projection[0, 0] * px + projection[0, 1] * py + projection[0, 2] * pz + projection[0, 3]) / w
        v = (projection[1, 0] * px + projection[1, 1] * py + projection[1, 2] * pz + projection[1, 3]) / w
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    return pixels_within(left, right, top, bottom, height, width)


@njit(cache=True, nogil=True, borrows=True)
def pixels_within(left, right, top, bottom, height, width):
    """Return (i0, i1, j0, j1): the pixels, ends excluded, whose centres lie within bounds given in pixels."""
    i0 = int(min(max(np.ceil(left), 0), width))
    i1 = int(min(max(np.floor(right) + 1, i0), width))
    j0 = int(min(max(np.ceil(top), 0), height))
    j1 = int(min(max(np.floor(bottom) + 1, j0), height))
    return i0, i1, j0, j1


@njit(cache=True, nogil=True, inline="always", borrows=True)
def between(o, d, half, near, far):
    """Return the part of a ray's depths near..far in which its coordinate o + depth * d is within half; none: near >
    far."""
    if abs(d) < 1e-12:
        return (near, far) if abs(o) <= half else (FAR, 0.0)
    inverse = 1.0 / d
    a, b = (-half - o) * inverse, (half - o) * inverse
    return max(near, min(a, b)), min(far, max(a, b))


@njit(cache=True, nogil=True, inline="always", borrows=True)
def in_axes(row, x, y, z):
    """Return a vector given in floor axes in the axes of a row's solid."""
    return (row[1] * x + row[4] * y + row[7] * z,
            row[2] * x + row[5] * y + row[8] * z,
            row[3] * x + row[6] * y + row[9] * z)  # fmt: skip


@njit(cache=True, nogil=True, inline="always", borrows=True)
def hit(kind, row, ox, oy, oz, dx, dy, dz):
    """Return the depth of a ray's first hit of a sphere or cylinder, or FAR. Origin (o), direction (d) in its axes."""
    if kind == SPHERE:
        radius = 0.5 * row[13]
        a = dx * dx + dy * dy + dz * dz
        b = ox * dx + oy * dy + oz * dz
        c = ox * ox + oy * oy + oz * oz - radius * radius
        root = b * b - a * c
        if root < 0:
            return FAR
        t = (-b - np.sqrt(root)) / a
        return t if t > 0 else FAR
    # cylinder about z
    radius, near, far = 0.5 * row[13], 1e-6, FAR
    a = dx * dx + dy * dy
    c = ox * ox + oy * oy - radius * radius
    if a < 1e-14:
        if c > 0:
            return FAR
    else:
        b = ox * dx + oy * dy
        root = b * b - a * c
        if root < 0:
            return FAR
        root = np.sqrt(root)
        near, far = max(near, (-b - root) / a), min(far, (-b + root) / a)
    near, far = between(oz, dz, 0.5 * row[15], near, far)
    return near if near <= far else FAR


@njit(cache=True, nogil=True, borrows=True)
def box_faces(image, row, i0, faces):
    """Write the inverse depths of a box's faces as affine functions of the pixel (i0 + n, j): a + b n + c j.

    faces : (9, 3) of a, b, c; the first three are what the box's inverse depth is the least of, the others what it has
    to be at least. NEAREST and 1 / FAR stand for faces that do not count.
    """
    for axis in range(3):
        ux, uy, uz = row[1 + axis], row[4 + axis], row[7 + axis]
        offset = ux * (image.origin[0] - row[10]) + uy * (image.origin[1] - row[11]) + uz * (image.origin[2] - row[12])
        here, along, down = image.direction[0, 0], image.direction[0, 1], image.direction[1, 0]
        a = ux * here[0] + uy * here[1] + uz * here[2]
        b = ux * (along[0] - here[0]) + uy * (along[1] - here[1]) + uz * (along[2] - here[2])
        c = ux * (down[0] - here[0]) + uy * (down[1] - here[1]) + uz * (down[2] - here[2])
        a += b * i0
        half = 0.5 * row[13 + axis]
        faces[axis, 0], faces[axis, 1], faces[axis, 2] = NEAREST, 0.0, 0.0
        for side in range(2):
            away = (half if side == 0 else -half) - offset
            front = (offset > half and side == 0) or (offset < -half and side == 1)
            if abs(away) < 1e-12:  # the camera is in the face's plane, on the side that `front` says
                away = 1e-12 if (side == 0) != front else -1e-12
            k = axis if front else 3 + 2 * axis + side
            faces[k, 0], faces[k, 1], faces[k, 2] = a / away, b / away, c / away
            if front:
                k = 3 + 2 * axis + side
                faces[k, 0], faces[k, 1], faces[k, 2] = 1.0 / FAR, 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")  # a check for zero in the loop would keep it from being vectorised
def box_depths(faces, j, out):
    """Write the depths of a box in a row of the image, FAR where it is not hit, into out (n,). faces : `box_faces`."""
    a0, a1, a2 = faces[0, 0] + faces[0, 2] * j, faces[1, 0] + faces[1, 2] * j, faces[2, 0] + faces[2, 2] * j
    a3, a4, a5 = faces[3, 0] + faces[3, 2] * j, faces[4, 0] + faces[4, 2] * j, faces[5, 0] + faces[5, 2] * j
    a6, a7, a8 = faces[6, 0] + faces[6, 2] * j, faces[7, 0] + faces[7, 2] * j, faces[8, 0] + faces[8, 2] * j
    b0, b1, b2, b3, b4, b5 = faces[0, 1], faces[1, 1], faces[2, 1], faces[3, 1], faces[4, 1], faces[5, 1]
    b6, b7, b8 = faces[6, 1], faces[7, 1], faces[8, 1]
    for n in range(out.size):
        x = float(n)
        upper = min(min(a0 + b0 * x, a1 + b1 * x), a2 + b2 * x)
        lower = max(max(max(a3 + b3 * x, a4 + b4 * x), max(a5 + b5 * x, a6 + b6 * x)), max(a7 + b7 * x, a8 + b8 * x))
        depth = 1.0 / upper
        out[n] = depth if upper >= lower else FAR


@njit(cache=True, nogil=True, borrows=True)
def depths_of(image, row, i0, j, faces, out):
    """Write the depths of a solid in pixels i0.. of a row of the image, FAR where it is not hit, into out (n,)."""
    kind = int(row[KIND])
    if kind == BOX:
        box_depths(faces, j, out)
        return
    ox, oy, oz = in_axes(row, image.origin[0] - row[10], image.origin[1] - row[11], image.origin[2] - row[12])
    for n in range(out.size):
        ray = image.direction[j, i0 + n]
        dx, dy, dz = in_axes(row, ray[0], ray[1], ray[2])
        out[n] = hit(kind, row, ox, oy, oz, dx, dy, dz)


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
            draw_one(image, rows[index], index, depth, label)


@njit(cache=True, nogil=True)
def draw_one(image, row, index, depth, label):
    """Draw one solid into depth and label, in place."""
    height, width = image.depth.shape
    i0, i1, j0, j1 = bounding_rectangle(row, image.projection, height, width)
    drawn, faces = np.empty(i1 - i0), np.empty((9, 3))
    if int(row[KIND]) == BOX:
        box_faces(image, row, i0, faces)
    for j in range(j0, j1):
        depths_of(image, row, i0, j, faces, drawn)
        for n in range(drawn.size):
            if drawn[n] < depth[j, i0 + n]:
                depth[j, i0 + n] = drawn[n]
                label[j, i0 + n] = index


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


KINDS = {"box": BOX, "cube": BOX, "sphere": SPHERE, "cylinder": CYLINDER}
