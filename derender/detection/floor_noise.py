"""What the floor shows of a sensor: how large its noise is, what neighbours share of it, and whether there is one."""

import numpy as np

from derender.detection.floor import Floor, back_project
from derender.detection.local_planes import local_planes
from derender.detection.noise import noise_of

GRAZING = 0.15  # sine of the angle at which rays meet the floor
# Noise of the worst sensors (stereo, Kinect v1): metres, and metres a square metre. A floor that is off its plane by
# more is no plane, or not the floor; but where neighbours scatter so, by ROUGHER times less, it is noise.
SENSOR_SIGMA, SENSOR_GROWTH, ROUGHER = 0.002, 0.004, 3.0
LEAST_SIGMA = 5e-4  # metres: no image is taken to be surer than that


def noise_map(depth: np.ndarray, floor: Floor, camera: dict[str, float]) -> np.ndarray:
    """Return the standard deviation of the noise (H, W), fitted on the floor.

    Only where the floor is not met at a grazing angle: there its own tilt shows, not the noise.
    """
    if not floor.inliers.any():
        return np.full(depth.shape, floor.sigma)
    points = back_project(depth, camera)[floor.inliers]
    normal = floor.pose[:3, 2]
    slope = np.abs((points / points[:, 2:3]) @ normal)
    steep = slope >= max(GRAZING, np.quantile(slope, 0.3))  # >=: a wall right before the camera has one angle
    if steep.sum() < 3:
        return np.full(depth.shape, floor.sigma)
    points, slope = points[steep], slope[steep]
    z = points[:, 2]
    sigma, growth = noise_of((points - floor.pose[:3, 3]) @ normal / slope, z)
    close = np.median(z)
    deep = np.clip(np.nan_to_num(depth, nan=close), 0.3 * close, 4.0 * close)
    noise = sigma + growth * deep**2
    most = np.maximum(SENSOR_SIGMA + SENSOR_GROWTH * deep**2, ROUGHER * local_noise(depth, camera))
    return np.maximum(np.minimum(noise, most), LEAST_SIGMA)


def local_noise(depth: np.ndarray, camera: dict[str, float]) -> float:
    """Return the standard deviation of the noise about the planes through each pixel's neighbours, metres, the median.

    Noise that neighbours share shows in it by a third or so; solids, walls and bent floors do not show.
    """
    good = np.isfinite(depth) & (depth > 0)
    points = np.ascontiguousarray(np.nan_to_num(back_project(depth, camera)))
    jump = np.ascontiguousarray(np.nan_to_num(0.02 * depth))
    normal, offset, error = local_planes(points, good, np.zeros(3), jump, 2)
    fitted = good & (error < 1e8)
    if not fitted.any():
        return 0.0
    slope = np.abs(np.einsum("ij,ij->i", normal[fitted], points[fitted])) / np.linalg.norm(points[fitted], axis=1)
    return float(np.median(np.sqrt(error[fitted]) / np.maximum(slope, GRAZING)))


def rounding_of(depth: np.ndarray) -> float:
    """Return the metres to which a depth image (H, W) was rounded: the smallest step between some of its values."""
    seen = depth[depth > 0]
    steps = np.diff(np.sort(seen[:: max(1, len(seen) // 4000)]))
    return float(min(steps[steps > 1e-9], default=0.0))


def drawn(depth: np.ndarray, floor: Floor, camera: dict[str, float], rounding: float) -> bool:
    """Return whether an image shows its floor to within its own rounding: no sensor does, a renderer without noise.

    Neighbouring pixels are then off by the same, which would pass for a real sensor's bends.
    """
    if not floor.inliers.any():
        return False
    normal = floor.pose[:3, 2]
    plane = floor.pose[:3, 3] @ normal / (back_project(np.ones_like(depth), camera) @ normal)
    near = floor.inliers & (plane <= np.median(plane[floor.inliers]))
    met = np.abs(depth - plane)[near] <= max(0.6 * rounding, LEAST_SIGMA / 5)  # half a step, and the fit's own fault
    return bool(met.mean() > 0.99)


def neighbour_correlation(depth: np.ndarray, floor: Floor, camera: dict[str, float]) -> float:
    """Return the correlation of the floor's residuals between neighbours in a row, the near half of the floor only.

    Near is where the plane is, not what was measured: from straight above the noise itself would choose the pixels.
    """
    if not floor.inliers.any():
        return 0.0
    normal = floor.pose[:3, 2]
    height = (back_project(depth, camera) - floor.pose[:3, 3]) @ normal
    distance = floor.pose[:3, 3] @ normal / (back_project(np.ones_like(depth), camera) @ normal)
    near = floor.inliers & (distance <= np.median(distance[floor.inliers]))
    limit = 3 * 1.4826 * np.median(np.abs(height[near])) + 1e-6
    height = np.where(near & (np.abs(height) < limit), height, np.nan)
    a, b = height[:, :-1], height[:, 1:]
    both = np.isfinite(a) & np.isfinite(b)
    spread = np.nanvar(height)
    return float(np.mean(a[both] * b[both]) / spread) if both.sum() > 100 and spread > 0 else 0.0
