"""How many solids the prior expects where nothing would show them: behind and under what is seen."""

import numpy as np

from derender.detection.solids.beliefs import MOST, bare_image
from derender.detection.solids.image import make_row
from derender.detection.solids.interpenetration import penetration
from derender.detection.solids.sizes import CUBE, FIRST, HIGH, LOW, NODES
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.draws.sensor import model_depth

TRIES = 400  # solids of the prior that are put down behind what is seen
MARGIN = 0.01  # metres by which all of one has to lie behind what is seen in front of it
LEAST_AREA = 1e-4  # square metres of hidden floor that are worth a look


def hidden_expected(rng, refined, beliefs=None):
    """Return the expected number of solids on the floor that nothing would show, given a structure's scene.

    Solids of the prior are put on the parts of the floor that what stands in front hides from the camera; those count
    whose corners all lie behind it, in the image, and that enter nothing. Each such place has the prior's density.
    """
    beliefs = bare_image() if beliefs is None else beliefs
    camera, floor = refined.sensor.camera, refined.chart.floor
    depth = model_depth(refined.chart, refined.values, camera)
    bare = floor_depth(floor, camera)
    hidden = np.argwhere((depth < bare - MARGIN) & np.isfinite(bare))
    if len(hidden) == 0 or len(refined.state) == 0:
        return 0.0
    rows, columns = hidden.T
    z = bare[rows, columns]
    up = floor[:3, 2]
    ray = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(z))], axis=1)
    area = z**2 / (camera.fx * camera.fy) / np.maximum(np.abs(ray @ up), 1e-3)  # of floor in each pixel
    total = float(area.sum())
    if total < LEAST_AREA:
        return 0.0
    chosen = rng.choice(len(z), size=TRIES, p=area / total)
    places = (ray[chosen] * z[chosen, None] - floor[:3, 3]) @ floor[:3, :3]
    count = sum(unseen(rng, place, beliefs, refined, depth) for place in places)
    return rate_on_floor(beliefs, len(refined.state)) * total * count / TRIES


def rate_on_floor(beliefs, count):
    """Return the solids that the prior expects on one more square metre, so many being there."""
    count = min(count, MOST - 1)
    return float(np.exp(beliefs.on_floor[count + 1] - beliefs.on_floor[count]))


def floor_depth(floor, camera):
    """Return the depth (H, W) of a floor alone, inf where it is not met."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ray = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(columns.shape)], axis=-1)
    along = ray @ floor[:3, 2]
    with np.errstate(divide="ignore"):
        depth = (floor[:3, 3] @ floor[:3, 2]) / along
    return np.where(depth > 0.0, depth, np.inf)


def unseen(rng, place, beliefs, refined, depth):
    """Whether a solid drawn from the prior at a place (3,) on the floor shows nowhere and enters nothing."""
    kinds = np.exp(beliefs.kinds)
    kind = int(rng.choice(len(kinds), p=kinds / kinds.sum()))
    extents = np.array([drawn_extent(rng, beliefs.sizes[kind, axis]) for axis in range(3)])
    if kind in (CUBE, SPHERE):
        extents[:] = extents[0]
    elif kind == CYLINDER:
        extents[1] = extents[0]
    turned = rotation_z(rng.uniform(0.0, np.pi))[:3, :3]
    row = make_row(BOX if kind == CUBE else kind, turned, place + [0.0, 0.0, 0.5 * extents[2]], extents)
    if any(penetration(row, other) > 0.0 for other in refined.state.rows):
        return False
    signs = np.array([[a, b, c] for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0) for c in (-1.0, 0.0, 1.0)])
    points = (row[10:13] + 0.5 * signs * extents @ turned.T) @ refined.chart.floor[:3, :3].T + refined.chart.floor[
        :3, 3
    ]
    camera = refined.sensor.camera
    columns = np.rint(points[:, 0] / points[:, 2] * camera.fx + camera.cx).astype(int)
    rows = np.rint(points[:, 1] / points[:, 2] * camera.fy + camera.cy).astype(int)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height) & (points[:, 2] > 0.0)
    if not inside.all():
        return False  # what leaves the image is not hidden by what is seen
    return bool((depth[rows, columns] < points[:, 2] - 0.1 * MARGIN).all())


def drawn_extent(rng, row):
    """Return an extent drawn from a row of a table of sizes, to its grid."""
    grid = np.exp(np.linspace(row[LOW], row[HIGH], NODES))
    share = np.exp(row[FIRST:] - row[FIRST:].max()) * np.gradient(grid)
    return float(rng.choice(grid, p=share / share.sum()))
