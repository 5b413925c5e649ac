"""The observed image in the floor's axes and how well solids explain it: compiled, rectangle by rectangle.

All of inference/structure but its jumps works in the *floor frame*: z up, the floor at z = 0, the camera's centre at
`origin`.  A solid is one row of ROW numbers: kind, rotation (9, row-major, object to floor), centre (3), size (3).
A pixel's ray is origin + depth * direction with depth along the camera's z, so depths need no conversion.

The misfit of a pixel is min(r^2 / (2 sigma^2), LIMIT): minus the logarithm of a mixture of sensor noise with a broad
outlier, up to a constant, without the exponentials (Bolles and Fischler's score as made continuous in MSAC).
"""

from typing import NamedTuple

import numpy as np

from derender.inference.bottom_up.pyramid import intrinsics
from derender.kernel_cache import njit
from derender.model.solids import BOX, CYLINDER, SPHERE
from derender.vision.blur import blur_taps

KIND, ROTATION, CENTRE, SIZE, ROW = 0, 1, 10, 13, 16
LIMIT = 8.0
FAR = 1e9
LEAST_TAP = 1e-3  # what the blur brings over from further away is left out of the search
AS_SEEN = 1e-8  # metres
WALL = 10.0  # metres: what lies beyond counts as this deep where the blur mixes it with what is nearer


class Image(NamedTuple):
    """What the compiled functions need to know of the observation.

    Attributes
    ----------
    depth : (H, W) float64 metres, 0 where nothing returned or the pixel is left out of account.
    weight : (H, W) float64, 1 / (2 sigma^2) of each pixel, 0 where left out.
    direction : (H, W, 3) float64, ray per metre of depth, floor axes.
    origin : (3,) float64, the camera's centre in the floor frame.
    floor : (H, W) float64, depth at which the ray meets the floor, FAR where it does not. Where it is the observed
        depth (to AS_SEEN) the background is taken as it is, blurred already.
    projection : (3, 4) float64, floor frame to homogeneous pixel (i, j, 1) times depth.
    taps : (R + 1,) float64, the blur's weights from the centre outwards (R = 0: a sharp image).
    """

    depth: np.ndarray
    weight: np.ndarray
    direction: np.ndarray
    origin: np.ndarray
    floor: np.ndarray
    projection: np.ndarray
    taps: np.ndarray


def make_image(depth, sigma, camera, floor_pose, blur=0.0):
    """Return the Image of an observation.

    Parameters
    ----------
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


def taps_of(blur):
    """Return the (R + 1,) weights of a blur of this standard deviation in pixels, without the negligible ones."""
    taps = blur_taps(blur)
    taps = taps[taps > LEAST_TAP]
    return taps / (taps[0] + 2.0 * taps[1:].sum())


def blank(image):
    """Return depth (H, W), label (H, W) and misfit (H, W) arrays to draw into."""
    shape = image.depth.shape
    return np.empty(shape), np.empty(shape, np.int32), np.empty(shape)


@njit(cache=True, nogil=True)
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
    i0 = int(min(max(np.ceil(left), 0), width))
    i1 = int(min(max(np.floor(right) + 1, i0), width))
    j0 = int(min(max(np.ceil(top), 0), height))
    j1 = int(min(max(np.floor(bottom) + 1, j0), height))
    return i0, i1, j0, j1


@njit(cache=True, nogil=True, inline="always")
def between(o, d, half, near, far):
    """Return the part of a ray's depths near..far in which its coordinate o + depth * d is within half; none: near >
    far."""
    if abs(d) < 1e-12:
        return (near, far) if abs(o) <= half else (FAR, 0.0)
    inverse = 1.0 / d
    a, b = (-half - o) * inverse, (half - o) * inverse
    return max(near, min(a, b)), min(far, max(a, b))


@njit(cache=True, nogil=True, inline="always")
def hit(kind, row, ox, oy, oz, dx, dy, dz):
    """Return the depth of a ray's first hit, or FAR. Origin (o) and direction (d) in the solid's axes."""
    if kind == BOX:
        near, far = between(ox, dx, 0.5 * row[13], 1e-6, FAR)
        near, far = between(oy, dy, 0.5 * row[14], near, far)
        near, far = between(oz, dz, 0.5 * row[15], near, far)
        return near if near <= far else FAR
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
    kind = int(row[KIND])
    i0, i1, j0, j1 = bounding_rectangle(row, image.projection, height, width)
    ex, ey, ez = image.origin[0] - row[10], image.origin[1] - row[11], image.origin[2] - row[12]
    ox = row[1] * ex + row[4] * ey + row[7] * ez
    oy = row[2] * ex + row[5] * ey + row[8] * ez
    oz = row[3] * ex + row[6] * ey + row[9] * ez
    for j in range(j0, j1):
        for i in range(i0, i1):
            ax, ay, az = image.direction[j, i, 0], image.direction[j, i, 1], image.direction[j, i, 2]
            t = hit(kind, row, ox, oy, oz,
                    row[1] * ax + row[4] * ay + row[7] * az,
                    row[2] * ax + row[5] * ay + row[8] * az,
                    row[3] * ax + row[6] * ay + row[9] * az)  # fmt: skip
            if t < depth[j, i]:
                depth[j, i] = t
                label[j, i] = index


@njit(cache=True, nogil=True)
def residual(seen, drawn, blurred):
    """Return what is seen less what is drawn; a background that was taken as it is seen is not blurred again."""
    return 0.0 if abs(seen - drawn) < AS_SEEN else seen - blurred


@njit(cache=True, nogil=True)
def misfit_map(image, depth, out):
    """Fill out (H, W) with each pixel's misfit against the model depth, blurred, and return the sum."""
    height, width = depth.shape
    blurred = depth
    if image.taps.size > 1:
        blurred = np.empty((height, width))
        blur_into(image.taps, np.minimum(depth, WALL), 0, width, 0, height, blurred)
    total = 0.0
    for j in range(height):
        for i in range(width):
            r = residual(image.depth[j, i], depth[j, i], blurred[j, i])
            m = min(r * r * image.weight[j, i], LIMIT)
            out[j, i] = m
            total += m
    return total


@njit(cache=True, nogil=True)
def blur_into(taps, depth, i0, i1, j0, j1, out):
    """Blur pixels i0..i1 of rows j0..j1 (ends excluded), the edges of `depth` replicated, into out (j1-j0, i1-i0)."""
    height, width = depth.shape
    radius = taps.size - 1
    top, bottom = max(j0 - radius, 0), min(j1 + radius, height)
    rows = np.empty((bottom - top, i1 - i0))
    for j in range(top, bottom):
        for i in range(i0, i1):
            value = taps[0] * depth[j, i]
            for k in range(1, radius + 1):
                value += taps[k] * (depth[j, max(i - k, 0)] + depth[j, min(i + k, width - 1)])
            rows[j - top, i - i0] = value
    for j in range(j0, j1):
        for i in range(i1 - i0):
            value = taps[0] * rows[j - top, i]
            for k in range(1, radius + 1):
                value += taps[k] * (rows[max(j - k, 0) - top, i] + rows[min(j + k, height - 1) - top, i])
            out[j - j0, i] = value


@njit(cache=True, nogil=True)
def added_misfit(image, row, depth, misfit):
    """Return how the misfit changes when the solid `row` is added to a scene with this depth and misfit map."""
    if image.taps.size > 1:
        return added_misfit_blurred(image, row, depth, misfit)
    height, width = image.depth.shape
    kind = int(row[KIND])
    i0, i1, j0, j1 = bounding_rectangle(row, image.projection, height, width)
    ex, ey, ez = image.origin[0] - row[10], image.origin[1] - row[11], image.origin[2] - row[12]
    ox = row[1] * ex + row[4] * ey + row[7] * ez
    oy = row[2] * ex + row[5] * ey + row[8] * ez
    oz = row[3] * ex + row[6] * ey + row[9] * ez
    total = 0.0
    for j in range(j0, j1):
        for i in range(i0, i1):
            weight = image.weight[j, i]
            if weight == 0.0:
                continue
            ax, ay, az = image.direction[j, i, 0], image.direction[j, i, 1], image.direction[j, i, 2]
            t = hit(kind, row, ox, oy, oz,
                    row[1] * ax + row[4] * ay + row[7] * az,
                    row[2] * ax + row[5] * ay + row[8] * az,
                    row[3] * ax + row[6] * ay + row[9] * az)  # fmt: skip
            if t < depth[j, i]:
                r = image.depth[j, i] - t
                total += min(r * r * weight, LIMIT) - misfit[j, i]
    return total


@njit(cache=True, nogil=True)
def added_misfit_blurred(image, row, depth, misfit):
    """The same for a blurred image: the solid changes the pixels that it covers and those within the blur's reach."""
    height, width = image.depth.shape
    radius = image.taps.size - 1
    kind = int(row[KIND])
    i0, i1, j0, j1 = bounding_rectangle(row, image.projection, height, width)
    if i0 >= i1 or j0 >= j1:
        return 0.0
    # the window: what the rectangle's neighbourhood is blurred from
    left, right = max(i0 - 2 * radius, 0), min(i1 + 2 * radius, width)
    top, bottom = max(j0 - 2 * radius, 0), min(j1 + 2 * radius, height)
    window = np.empty((bottom - top, right - left))
    ex, ey, ez = image.origin[0] - row[10], image.origin[1] - row[11], image.origin[2] - row[12]
    ox = row[1] * ex + row[4] * ey + row[7] * ez
    oy = row[2] * ex + row[5] * ey + row[8] * ez
    oz = row[3] * ex + row[6] * ey + row[9] * ez
    for j in range(top, bottom):
        for i in range(left, right):
            z = depth[j, i]
            if i0 <= i < i1 and j0 <= j < j1:
                ax, ay, az = image.direction[j, i, 0], image.direction[j, i, 1], image.direction[j, i, 2]
                z = min(z, hit(kind, row, ox, oy, oz,
                               row[1] * ax + row[4] * ay + row[7] * az,
                               row[2] * ax + row[5] * ay + row[8] * az,
                               row[3] * ax + row[6] * ay + row[9] * az))  # fmt: skip
            window[j - top, i - left] = min(z, WALL)
    # the pixels that may change
    i0, i1, j0, j1 = max(i0 - radius, 0), min(i1 + radius, width), max(j0 - radius, 0), min(j1 + radius, height)
    blurred = np.empty((j1 - j0, i1 - i0))
    blur_into(image.taps, window, i0 - left, i1 - left, j0 - top, j1 - top, blurred)
    total = 0.0
    for j in range(j0, j1):
        for i in range(i0, i1):
            weight = image.weight[j, i]
            if weight > 0.0:
                r = residual(image.depth[j, i], window[j - top, i - left], blurred[j - j0, i - i0])
                total += min(r * r * weight, LIMIT) - misfit[j, i]
    return total


def make_row(kind, rotation, centre, size):
    """Return a solid's row from its kind, rotation (3, 3), centre (3,) and size (3,)."""
    row = np.empty(ROW)
    row[KIND] = kind
    row[ROTATION:CENTRE] = np.asarray(rotation).ravel()
    row[CENTRE:SIZE] = centre
    row[SIZE:ROW] = size
    return row


def rotation_of(row):
    """Return the rotation (3, 3), object to floor, of a row."""
    return row[ROTATION:CENTRE].reshape(3, 3)


KINDS = {"box": BOX, "cube": BOX, "sphere": SPHERE, "cylinder": CYLINDER}


def render_floor_scene(kinds, poses, sizes, floor_pose, camera):
    """Return depth (H, W), NaN where nothing is hit, and label (H, W) of solids over a floor.

    poses : (N, 4, 4) object to camera; floor_pose : (4, 4) floor to camera; camera : dict of intrinsics.
    """
    blank = np.zeros((camera["height"], camera["width"]))
    image = make_image(blank, 1.0, camera, floor_pose)
    local = np.linalg.inv(floor_pose) @ poses
    rows = np.array(
        [make_row(KINDS[k], p[:3, :3], p[:3, 3], s) for k, p, s in zip(kinds, local, sizes, strict=True)]
    ).reshape(-1, ROW)
    depth, label = blank.copy(), np.zeros(blank.shape, np.int32)
    draw(image, rows, -1, depth, label)
    depth[depth >= FAR] = np.nan
    return depth, label
