"""What kind of numbers an image holds: depth along the axis, distance along the rays (range), or disparity.

On a plane one function of the numbers is affine in the pixel's place: of depth z it is 1 / z, of range r it is
|ray| / r with the ray's unit along the axis, of disparity the number itself. So the largest plane tells which it is.
"""

import numpy as np

from derender.camera.intrinsics import Camera
from derender.results.fit import Noise
from derender.results.trust import Doubt

LOOKED_AT = 4000  # pixels, at most, evenly spread
TRIES = 150  # planes through three pixels each, of each kind: one with half of the pixels is missed never
SIFTING = 4  # the best plane is chosen on every fourth of these pixels
NEAR, DEVIATIONS = 0.006, 3.0  # share of the distance that a plane may be off, or so many deviations of the noise
CLEARLY, MORE = 1.2, 0.08  # times as many pixels on the plane of another kind, and by how much of all, at least
REMEDIES = {
    "range": "distances along the rays (range), not depth along the axis: convert them by z = r / |ray|",
    "disparity": "disparities, not depths: convert them by z = focal length * baseline / disparity",
}


def wrong_kind(observed: np.ndarray, camera: Camera, noise: Noise) -> list[Doubt]:
    """Return a doubt where another kind of numbers has far more of the image (H, W) on one plane than depth has."""
    shares = plane_shares(observed, camera, noise)
    best = max(shares, key=lambda kind: shares[kind])
    if best == "depth" or shares[best] < max(CLEARLY * shares["depth"], shares["depth"] + MORE):
        return []
    as_depth, as_other = round(100 * shares["depth"]), round(100 * shares[best])
    words = (
        f"the numbers look like {REMEDIES[best]} (so {as_other} % of them lie on one plane, {as_depth} % as they are)"
    )
    return [Doubt(words)]


def plane_shares(observed: np.ndarray, camera: Camera, noise: Noise) -> dict[str, float]:
    """Return which share of the pixels with a number lies on the largest plane, by what the numbers might be."""
    rows, columns = np.nonzero(np.isfinite(observed) & (observed > 0))
    if len(rows) < 100:
        return {"depth": 1.0}
    step = max(1, len(rows) // LOOKED_AT)
    rows, columns = rows[::step], columns[::step]
    values = observed[rows, columns]
    across, down = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    ray = np.sqrt(1.0 + across**2 + down**2)
    limit = np.maximum(NEAR, DEVIATIONS * noise.at(values) / values)
    rng = np.random.default_rng(0)  # which planes are tried says nothing of the answer
    triples = rng.integers(0, len(values), (TRIES, 3))
    design = np.column_stack([np.ones(len(values)), across, down])
    kinds = {"depth": 1.0 / values, "range": ray / values, "disparity": values}
    return {kind: _largest(design, numbers, limit, triples) for kind, numbers in kinds.items()}


def _largest(design: np.ndarray, numbers: np.ndarray, limit: np.ndarray, triples: np.ndarray) -> float:
    """Return the share of pixels within the limit, relative to the number, of the best affine function tried."""
    matrices = design[triples]
    usable = np.abs(np.linalg.det(matrices)) > 1e-4
    planes = np.linalg.solve(matrices[usable], numbers[triples[usable]][..., None])[..., 0]
    if not len(planes):
        return 0.0
    allowed = limit * np.abs(numbers)
    some = slice(None, None, SIFTING)
    near = np.abs(planes @ design[some].T - numbers[some]) <= allowed[some]
    plane = planes[int(np.argmax(near.sum(axis=1)))]
    best = np.abs(design @ plane - numbers) <= allowed
    share = float(best.mean())
    for _ in range(3):  # through all of them it fits more
        if best.sum() < 3:
            break
        plane, *_ = np.linalg.lstsq(design[best], numbers[best], rcond=None)
        best = np.abs(design @ plane - numbers) <= allowed
        share = max(share, float(best.mean()))
    return share
