"""A floor that is given instead of found: a plane in camera axes, or none at all."""

import numpy as np

from derender.detection.floor import Floor, back_project, find_floor
from derender.errors import DerenderError

NEAR = 0.02  # metres off a given plane within which its own points are looked for
BACKDROP, SIDE = 0.3, 0.2  # least shares of the pixels, and of three of the image's sides, that a backdrop holds
MOST_NOISE = 0.02  # metres: where neighbouring pixels differ by more there is no surface
FAR_BELOW = 10.0  # metres under the lowest point at which the floor lies where there is none


def read_floor(text):
    """Return what `--floor` says: None for "auto", "none", or the plane (4,) a x + b y + c z + d = 0, a unit normal.

    Camera axes (x right, y down, z forward), metres. DerenderError for anything else.
    """
    if text is None or (isinstance(text, str) and text.strip().lower() == "auto"):
        return None
    if isinstance(text, str):
        if text.strip().lower() == "none":
            return "none"
        try:
            text = [float(part) for part in text.replace(",", " ").split()]
        except ValueError:
            text = []
    plane = np.asarray(text, float).ravel()
    if plane.shape != (4,) or not np.isfinite(plane).all() or np.linalg.norm(plane[:3]) < 1e-9:
        remedy = "give auto, none, or four numbers a,b,c,d of the plane a x + b y + c z + d = 0 in camera axes"
        raise DerenderError("this is no floor", "--floor", remedy)
    return plane / np.linalg.norm(plane[:3])


def given_floor(depth, camera, floor):
    """Return the Floor of a plane (4,) or of "none".

    Without a floor its frame has the camera's up for z and lies far below everything, so that nothing rests on it.
    A given plane is taken as it is; its noise is measured on the points within 2 cm of it.
    """
    points = back_project(depth, camera)
    good = np.isfinite(depth) & (depth > 0)
    if good.sum() < 50:
        raise DerenderError(f"the image has only {good.sum()} pixels with depth", remedy="at least 50 are needed")
    if isinstance(floor, str):
        lowest = float(points[good][:, 1].max()) + FAR_BELOW
        return Floor(frame_of(np.array([0.0, -1.0, 0.0]), -lowest, points[good].mean(axis=0)),
                     pixel_noise(depth), np.zeros(depth.shape, bool))  # fmt: skip
    normal, offset = floor[:3], -floor[3]
    if offset > 0:  # towards the camera's side
        normal, offset = -normal, -offset
    if abs(offset) < 1e-6:
        raise DerenderError("the floor passes through the camera", "--floor", "give another plane")
    slope = np.maximum(np.abs((points / points[..., 2:]) @ normal), 0.05)
    residual = (points @ normal - offset) / slope
    near = good & (np.abs(residual * slope) < NEAR)
    if near.sum() < 20:
        raise DerenderError("hardly any point of the image lies within 2 cm of the floor given", "--floor",
                            "camera axes: x right, y down, z forward, metres; or --floor auto")  # fmt: skip
    sigma = max(1.4826 * float(np.median(np.abs(residual[near]))), 3e-4)
    inliers = near & (np.abs(residual) < 4 * sigma)
    return Floor(frame_of(normal, offset, points[inliers].mean(axis=0)), sigma, inliers)


def find_backdrop(depth, camera):
    """Return the Floor of a plane before which everything is seen, a table or a wall, and (H, W) bool: what lies on it
    or beyond; or None. It reaches three sides of the image: a solid that does would fill it.
    """
    try:
        plane = find_floor(depth, camera)
    except DerenderError:
        return None
    seen = np.isfinite(depth) & (depth > 0)
    height = (back_project(depth, camera) - plane.pose[:3, 3]) @ plane.pose[:3, 2]
    beyond = seen & ((height < max(0.004, 4.0 * plane.sigma)) | plane.inliers)
    edges = (beyond[0], beyond[-1], beyond[:, 0], beyond[:, -1])
    reached = sum(edge.mean() > SIDE for edge in edges)
    return (plane, beyond) if reached >= 3 and plane.inliers.sum() > BACKDROP * seen.sum() else None


def frame_of(normal, offset, near):
    """Return the pose (4, 4) of the frame in the plane normal . p = offset, z along the normal, origin under `near`."""
    fx = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
    right = fx - (fx @ normal) * normal
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(normal, right), normal])
    pose[:3, 3] = near - (near @ normal - offset) * normal
    return pose


def pixel_noise(depth):
    """Return the standard deviation of independent noise, from second differences along the rows."""
    second = depth[:, :-2] - 2 * depth[:, 1:-1] + depth[:, 2:]
    second = second[np.isfinite(second)]
    if len(second) < 50:
        return 0.001
    return float(np.clip(1.4826 * np.median(np.abs(second)) / np.sqrt(6), 3e-4, MOST_NOISE))
