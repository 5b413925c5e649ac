"""The contacts as compiled functions over numbers: forward kinematics and its inverse without Python.

Tested equal to the readable classes. A solid is its kind (`solids.PLANE` ...; FRAME) and its (3,) full extents, a
feature is a code of FEATURE_CODES (-1 for none), a contact type is its `compiled_code`, and phi is an array in the
order of `ContactType.parameters`: seven numbers for 6dof, six for every other. A type from elsewhere has no code.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.scene.polygon import offset_from_uv, uv_from_offset
from derender.scene.pose import quaternion_numbers, rotation_numbers
from derender.scene.shapes import shapes
from derender.scene.shapes.base import CORNER_NAMES, EDGE_NAMES, FACE_NAMES, box_feature, signs_of
from derender.scene.solids import CYLINDER, PLANE, SPHERE

FRAME = -1
SIX_DOF, FACE_TO_FACE, POINT_ON_FACE, SIDE_ON_FACE, EDGE_ON_FACE, CORNER_ON_FACE = range(6)
SLOTS = 7  # numbers of the longest phi

FEATURE_NAMES = (*FACE_NAMES, "side", "surface", *EDGE_NAMES, *CORNER_NAMES)
FEATURE_CODES: dict[str | None, int] = {None: -1, **{name: code for code, name in enumerate(FEATURE_NAMES)}}
SIDE, SURFACE, FIRST_EDGE, FIRST_CORNER = 6, 7, 8, 20


def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each feature's rotation (28, 3, 3), its place as signs (28, 3), its outline's two axes (28, 2) or -1."""
    rotations, signs = np.tile(np.eye(3), (28, 1, 1)), np.zeros((28, 3))
    axes = np.full((28, 2), -1, dtype=np.int64)
    for code, name in enumerate(FEATURE_NAMES):
        if name in ("side", "surface"):
            continue
        signs[code] = signs_of(name)
        feature = box_feature(name, np.array([1.0, 2.0, 3.0]))
        rotations[code] = feature.frame[:3, :3]
        for place, extent in enumerate(feature.outline[:2]):
            axes[code, place] = int(extent) - 1  # the extents 1, 2, 3 tell which axis lies along the outline
    rotations[SIDE] = shapes["cylinder"].face("side", (1.0, 1.0)).frame[:3, :3]
    return rotations, signs, axes


_ROTATIONS, SIGNS, _AXES = _tables()
_rotation_of = njit(cache=True, nogil=True)(rotation_numbers)
_quaternion_of = njit(cache=True, nogil=True)(quaternion_numbers)


@njit(cache=True, nogil=True)
def outline(kind, size, code):
    """Return (length, width, radius, lift) of a feature."""
    if kind == PLANE:
        return math.inf, math.inf, 0.0, 0.0
    if kind == SPHERE:
        return 0.0, 0.0, 0.0, 0.5 * size[0]
    if code == SIDE:
        return size[2], 0.0, 0.0, 0.5 * size[0]
    if kind == CYLINDER:
        return 0.0, 0.0, 0.5 * size[0], 0.0
    first, second = _AXES[code, 0], _AXES[code, 1]
    return (size[first] if first >= 0 else 0.0), (size[second] if second >= 0 else 0.0), 0.0, 0.0


@njit(cache=True, nogil=True)
def rotation_by(contact, child_face, theta, first, second):
    """Return the nine numbers, row by row, of Rz(theta) . turn, by the type's chart."""
    half = 0.5 * theta
    # Each chart as a quaternion: Rz(theta) = (cz, 0, 0, sz) times the turn's own.
    cz, sz = math.cos(half), math.sin(half)
    if contact == SIDE_ON_FACE or contact == EDGE_ON_FACE:
        cy, sy = math.cos(0.5 * first), math.sin(0.5 * first)
        cx, sx = math.cos(0.5 * second), -math.sin(0.5 * second)
        w, x, y, z = cy * cx, cy * sx, sy * cx, -sy * sx
    elif contact == CORNER_ON_FACE:
        beta = 0.5 * math.pi - SIGNS[child_face, 2] * second
        alpha = math.atan2(SIGNS[child_face, 1] * math.sin(first), SIGNS[child_face, 0] * math.cos(first))
        cy, sy = math.cos(0.5 * beta), math.sin(0.5 * beta)
        ca, sa = math.cos(0.5 * alpha), math.sin(0.5 * alpha)
        w, x, y, z = cy * ca, sy * sa, sy * ca, cy * sa
    else:
        angle = math.hypot(first, second)
        scale = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
        w, x, y, z = math.cos(0.5 * angle), scale * first, scale * second, 0.0
    return _rotation_of(cz * w - sz * z, cz * x - sz * y, cz * y + sz * x, cz * z + sz * w)


@njit(cache=True, nogil=True)
def relative_pose(contact, parent_kind, parent_size, child_kind, child_size, parent_face, child_face, phi, out):
    """Write the (4, 4) pose of the child in the parent's object axes into `out`: f_c of Eq. 1 without z_parent."""
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0
    if contact == SIX_DOF:
        norm = math.sqrt(phi[3] * phi[3] + phi[4] * phi[4] + phi[5] * phi[5] + phi[6] * phi[6])
        r = _rotation_of(phi[3] / norm, phi[4] / norm, phi[5] / norm, phi[6] / norm)
        out[0, 0], out[0, 1], out[0, 2], out[0, 3] = r[0], r[1], r[2], phi[0]
        out[1, 0], out[1, 1], out[1, 2], out[1, 3] = r[3], r[4], r[5], phi[1]
        out[2, 0], out[2, 1], out[2, 2], out[2, 3] = r[6], r[7], r[8], phi[2]
        return
    theta, x, y = phi[0], phi[1], phi[2]
    a, b, radius, _ = outline(parent_kind, parent_size, parent_face)
    c, d, child_radius, lift = outline(child_kind, child_size, child_face)
    if a < math.inf and c < math.inf:
        x, y = offset_from_uv(x, y, theta, a, b, c, d, radius + child_radius)
    height = phi[3] + lift
    q = rotation_by(contact, child_face, theta, phi[4], phi[5])
    # Rotation and shift of the child's face in the parent's object axes ...
    on, by = _ROTATIONS[parent_face], _ROTATIONS[child_face]
    for i in range(3):
        m0 = on[i, 0] * q[0] + on[i, 1] * q[3] + on[i, 2] * q[6]
        m1 = -(on[i, 0] * q[1] + on[i, 1] * q[4] + on[i, 2] * q[7])
        m2 = -(on[i, 0] * q[2] + on[i, 1] * q[5] + on[i, 2] * q[8])
        shift = on[i, 0] * x + on[i, 1] * y + on[i, 2] * height + 0.5 * SIGNS[parent_face, i] * parent_size[i]
        # ... and of the child itself: rotation times F_child^T, its origin taken back.
        for j in range(3):
            value = m0 * by[j, 0] + m1 * by[j, 1] + m2 * by[j, 2]
            out[i, j] = value
            shift -= value * 0.5 * SIGNS[child_face, j] * child_size[j]
        out[i, 3] = shift


@njit(cache=True, nogil=True)
def chart_of(contact, child_face, turned):
    """Return (theta, first, second) of the (3, 3) rotation Rz(theta) . turn, the two within their ranges.

    Of faces and points a turn is the rotation by the vector (tilt_x, tilt_y, 0), the swing-twist form of a rotation:
    every one has it, but for half turns it is unique; so a pose is always reproduced, and to one that is nearly flush
    belongs the theta that one would measure. Of lines it is Ry(tilt) . Rx(-second), of corners Ry . Rz: Euler angles,
    unique but where the line or the corner's axis stands upright.
    """
    if contact == SIDE_ON_FACE or contact == EDGE_ON_FACE:
        theta = math.atan2(turned[1, 0], turned[0, 0])
        first = math.atan2(-turned[2, 0], math.hypot(turned[0, 0], turned[1, 0]))
        second = -math.atan2(turned[2, 1], turned[2, 2])
        if contact == EDGE_ON_FACE:
            second = min(max(second, 0.0), 0.5 * math.pi)
    elif contact == CORNER_ON_FACE:
        sx, sy, sz = SIGNS[child_face, 0], SIGNS[child_face, 1], SIGNS[child_face, 2]
        beta = math.atan2(math.hypot(turned[0, 2], turned[1, 2]), turned[2, 2])
        alpha = math.atan2(turned[2, 1], -turned[2, 0])
        theta = math.atan2(turned[1, 2], turned[0, 2])
        first = min(max(math.atan2(sy * math.sin(alpha), sx * math.cos(alpha)), 0.0), 0.5 * math.pi)
        second = min(max(sz * (0.5 * math.pi - beta), 0.0), 0.5 * math.pi)
    else:
        qw, qx, qy, qz = _quaternion_of(turned)
        theta = 2.0 * math.atan2(qz, qw)
        # The tilt is what is left when the twist is taken off: a quaternion without z.
        cz, sz = math.cos(0.5 * theta), math.sin(0.5 * theta)
        w, x, y = cz * qw + sz * qz, cz * qx + sz * qy, cz * qy - sz * qx
        sine = math.hypot(x, y)
        scale = 2.0 * math.atan2(sine, w) / sine if sine > 0.0 else 2.0
        first, second = scale * x, scale * y
    theta = theta % (2.0 * math.pi)
    if 2.0 * math.pi - theta < 1e-12:
        theta = 0.0
    return theta, first, second


@njit(cache=True, nogil=True)
def invert(contact, parent_kind, parent_size, child_kind, child_size, parent_face, child_face, relative, phi):
    """Write phi of the contact nearest to the (4, 4) pose into `phi`; return (outside, angle): `ContactType.invert`."""
    if contact == SIX_DOF:
        phi[0], phi[1], phi[2] = relative[0, 3], relative[1, 3], relative[2, 3]
        phi[3], phi[4], phi[5], phi[6] = _quaternion_of(relative)
        return 0.0, 0.0
    on, by = _ROTATIONS[parent_face], _ROTATIONS[child_face]
    turned = np.empty((3, 3))  # F_parent^T . relative . F_child . FLIP
    place = np.empty(3)
    shift = np.empty(3)
    middle = np.empty((3, 3))
    for i in range(3):
        shift[i] = relative[i, 3] - 0.5 * SIGNS[parent_face, i] * parent_size[i]
        for j in range(3):
            shift[i] += relative[i, j] * 0.5 * SIGNS[child_face, j] * child_size[j]
            middle[i, j] = relative[i, 0] * by[0, j] + relative[i, 1] * by[1, j] + relative[i, 2] * by[2, j]
    for i in range(3):
        place[i] = on[0, i] * shift[0] + on[1, i] * shift[1] + on[2, i] * shift[2]
        for j in range(3):
            value = on[0, i] * middle[0, j] + on[1, i] * middle[1, j] + on[2, i] * middle[2, j]
            turned[i, j] = value if j == 0 else -value
    theta, first, second = chart_of(contact, child_face, turned)
    a, b, radius, _ = outline(parent_kind, parent_size, parent_face)
    c, d, child_radius, lift = outline(child_kind, child_size, child_face)
    x, y, outside = place[0], place[1], 0.0
    if a < math.inf and c < math.inf:
        x, y, outside = uv_from_offset(x, y, theta, a, b, c, d, radius + child_radius)
    phi[0], phi[1], phi[2], phi[3], phi[4], phi[5] = theta, x, y, place[2] - lift, first, second
    # The angle between what was asked for and what these numbers give, from the chord |R - R'| = 2 sqrt(2) sin(a / 2).
    q = rotation_by(contact, child_face, theta, first, second)
    square = 0.0
    for i in range(3):
        for j in range(3):
            square += (turned[i, j] - q[3 * i + j]) ** 2
    angle = 2.0 * math.asin(min(1.0, math.sqrt(square / 8.0)))
    return outside, angle if angle > 1e-12 else 0.0
