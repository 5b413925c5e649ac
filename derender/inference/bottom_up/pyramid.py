"""Smaller images of the same scene: block medians of depth, with the camera that goes with them."""

import numpy as np

from derender.kernel_cache import njit

STEP = 0.04  # share of the depth: a greater step within a block is a jump, not a slanted surface


def intrinsics(camera):
    """Return fx, fy, cx, cy of a camera object or of a dict of them."""
    if isinstance(camera, dict):
        return camera["fx"], camera["fy"], camera["cx"], camera["cy"]
    return camera.fx, camera.fy, camera.cx, camera.cy


def reduced_camera(camera, factor, shape):
    """Return the dict of intrinsics of the image whose pixels are blocks of factor x factor pixels."""
    fx, fy, cx, cy = intrinsics(camera)
    shift = (factor - 1) / 2
    return {"fx": fx / factor, "fy": fy / factor, "cx": (cx - shift) / factor, "cy": (cy - shift) / factor,
            "width": shape[1] // factor, "height": shape[0] // factor}  # fmt: skip


@njit(cache=True, nogil=True)
def block_median(depth, factor, enough):
    """Return the median of each block's pixels with depth (> 0), 0 where fewer than `enough` have one.

    The median takes a side at a jump in depth: the mean would invent points in the air. Of an even number the middle
    two are averaged where they are near: taking one of them would tilt the floor.
    """
    height, width = depth.shape[0] // factor, depth.shape[1] // factor
    out = np.zeros((height, width))
    values = np.empty(factor * factor)
    for j in range(height):
        for i in range(width):
            n = 0
            for v in range(j * factor, (j + 1) * factor):
                for u in range(i * factor, (i + 1) * factor):
                    if depth[v, u] > 0:
                        values[n] = depth[v, u]
                        n += 1
            if n >= enough:
                values[:n].sort()
                if n % 2 == 1 or values[n // 2] - values[n // 2 - 1] > STEP * values[n // 2]:
                    out[j, i] = values[n // 2]
                else:
                    out[j, i] = 0.5 * (values[n // 2] + values[n // 2 - 1])
    return out


def reduce(depth, camera, widest):
    """Return (depth, camera dict, factor) of the image reduced by a whole factor to about `widest` pixels across.

    depth : (H, W) float metres, NaN or 0 = no return; in the answer NaN = no return.
    """
    factor = max(1, int(round(depth.shape[1] / widest)))
    filled = np.nan_to_num(np.ascontiguousarray(depth, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    if factor > 1:
        filled = block_median(filled, factor, max(2, factor * factor // 5))
    return np.where(filled > 0, filled, np.nan), reduced_camera(camera, factor, depth.shape), factor
