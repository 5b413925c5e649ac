"""From a bare depth image to solids on a floor: floor, patches, hypotheses, search."""

import numpy as np

from derender.inference.bottom_up.floor import back_project, find_floor
from derender.inference.bottom_up.patches import find_patches
from derender.inference.structure.image import intrinsics, make_image
from derender.inference.structure.proposals import all_hypotheses, make_surface
from derender.inference.structure.search import Settings, search
from derender.inference.structure.support import final_parents


def point_estimate(rng, depth, camera, settings=None):
    """Return (state, floor, image): the best explanation of a depth image (H, W) in metres, NaN = no return."""
    settings = Settings() if settings is None else settings
    floor = find_floor(rng, depth, camera)
    sigma = np.full(depth.shape, floor.sigma)
    image = make_image(depth, sigma, camera, floor.pose)
    points = back_project(depth, camera) - floor.pose[:3, 3]
    points = np.nan_to_num(points @ floor.pose[:3, :3])
    mask = np.isfinite(depth) & (points[..., 2] > max(0.004, 4 * floor.sigma))
    footprint = np.nan_to_num(depth) / intrinsics(camera)[0]
    patches = find_patches(points, mask, image.origin, sigma, footprint)
    typical = float(np.median(footprint[mask])) if mask.any() else 0.005
    surface = make_surface(points, patches, image.origin, typical, floor.sigma)
    state = search(rng, image, all_hypotheses(surface, settings.shapes), settings)
    state.parents = final_parents(state)
    return state, floor, image
