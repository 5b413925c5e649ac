"""The supporting plane of a depth image: RANSAC on a coarse sample, then a robust least-squares refit."""

from typing import NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.inference.bottom_up.pyramid import intrinsics


class Floor(NamedTuple):
    """A supporting plane.

    Attributes
    ----------
    pose : (4, 4) float64, floor frame to camera: z up (towards the camera's side), origin under the image's middle.
    sigma : standard deviation of the depth noise about the plane in metres, from the median absolute residual.
    inliers : (H, W) bool, pixels on the plane.
    """

    pose: np.ndarray
    sigma: float
    inliers: np.ndarray


def back_project(depth, camera):
    """Return the points (H, W, 3) in camera axes of a depth image; NaN where there is no depth."""
    fx, fy, cx, cy = intrinsics(camera)
    height, width = depth.shape
    column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    return np.stack([(column - cx) / fx * depth, (row - cy) / fy * depth, depth], axis=-1)


def find_floor(rng, depth, camera, tolerance=0.008, rounds=300):
    """Find the plane that most pixels lie on.

    Parameters
    ----------
    depth : (H, W) float metres, NaN = no return.
    tolerance : metres; how near the plane a point counts during the search.

    Raises DerenderError where fewer than 50 pixels have depth or no plane holds a tenth of them.
    """
    points = back_project(depth, camera)
    good = np.flatnonzero(np.isfinite(depth.ravel()) & (depth.ravel() > 0))
    if len(good) < 50:
        what = f"the image has too few pixels with depth ({len(good)}, at least 50 are needed)"
        raise DerenderError(what, remedy="check the export, or go nearer")
    flat = points.reshape(-1, 3)
    sample = flat[good[rng.permutation(len(good))[:1500]]]
    triples = sample[rng.integers(len(sample), size=(rounds, 3))]
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1)
    if not np.any(length > 1e-8):
        raise DerenderError("all pixels with depth lie on one line", remedy="give a whole image")
    normal = normal[length > 1e-8] / length[length > 1e-8, None]
    offset = np.einsum("ij,ij->i", normal, triples[length > 1e-8, 0])
    distance = sample @ normal.T - offset  # (S, R); the camera is at -offset
    side = np.where(offset > 0, -1.0, 1.0)  # turn normals towards the camera
    distance, normal, offset = distance * side, normal * side[:, None], offset * side
    near = np.abs(distance) < tolerance * np.maximum(1.0, sample[:, 2] ** 2)[:, None]
    # Points far under a plane cannot lie on what stands on it: a table top with the room's floor behind it may have
    # some, the side of a box has many.
    under = distance < -3 * tolerance
    best = np.argmax(near.sum(axis=0) - 0.3 * under.sum(axis=0))
    plane_normal, plane_offset = normal[best], offset[best]
    scale = tolerance
    for _ in range(6):
        residual = flat[good] @ plane_normal - plane_offset
        inner = np.abs(residual) < max(3 * scale, 0.001)
        chosen = flat[good[inner]]
        if len(chosen) < max(20, 0.05 * len(good)):
            remedy = "say --floor none, give the plane with --floor, or crop the image"
            raise DerenderError("no plane holds a tenth of the pixels", remedy=remedy)
        weight = 1.0 / chosen[:, 2] ** 4  # the noise of disparity sensors grows with the squared depth
        centre = np.average(chosen, axis=0, weights=weight)
        _, _, axes = np.linalg.svd(((chosen - centre) * np.sqrt(weight)[:, None]), full_matrices=False)
        plane_normal = axes[2] * np.sign(-axes[2] @ centre)
        plane_offset = plane_normal @ centre
        scale = np.clip(1.4826 * np.median(np.abs(chosen @ plane_normal - plane_offset)), 2e-4, tolerance)
    ray = flat[good] / flat[good][:, 2:3]
    slope = np.abs(ray @ plane_normal)
    residual = (flat[good] @ plane_normal - plane_offset) / np.maximum(slope, 0.05)
    inner = np.abs(residual) < 4 * scale / np.maximum(slope, 0.05)
    sigma = float(1.4826 * np.median(np.abs(residual[inner])))
    inliers = np.zeros(depth.size, bool)
    inliers[good[inner]] = True
    origin = chosen.mean(axis=0)
    origin = origin - (origin @ plane_normal - plane_offset) * plane_normal
    right = np.array([1.0, 0, 0]) - plane_normal[0] * plane_normal
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(plane_normal, right), plane_normal])
    pose[:3, 3] = origin
    return Floor(pose, max(sigma, 3e-4), inliers.reshape(depth.shape))
