"""What a scene says of each pixel of the image it was inferred from: which object is seen there, and how far away."""

from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.cache import njit
from derender.render.raycast.depth import render_depth
from derender.scene.graph import SceneGraph

FLOOR, BACKGROUND, UNEXPLAINED = -1, -2, -3
NEAR, NEAR_SHARE = 0.01, 0.01  # metres, and share of the depth: what is seen so near the floor shows the floor
NOISES = 4.0  # standard deviations of the noise within which a pixel shows the floor
MOST_BENT = 0.05  # share of the depth: whatever the sensor, what is farther off its plane is no floor
WINDOW = 2  # pixels on either side over which the background's surface is smoothed
STEP = 0.02  # share of the depth: what differs more from the middle of the window lies on another surface


class Explanation(NamedTuple):
    """What the most probable scene says of each pixel, at the size of the image as it came.

    label : (H, W) int32, index into `names`; or FLOOR; BACKGROUND (walls, clutter, another table, the room behind);
        UNEXPLAINED: something is seen that is none of these.
    """

    label: np.ndarray
    depth: np.ndarray  # (H, W) float32 metres of the surface that explains the pixel; NaN where nothing does
    names: tuple[str, ...]  # names of the solids, without floors, in the order of the graph's vertices

    def share(self, seen: np.ndarray, within: float = 0.03) -> float:
        """Return which share of the valid pixels of `seen` (H, W) is explained to so many metres."""
        valid = np.isfinite(seen) & (seen > 0)
        with np.errstate(invalid="ignore"):
            near = np.abs(self.depth - seen) < within
        return float(near[valid].mean()) if valid.any() else 0.0


def explain(
    graph: SceneGraph,
    seen: np.ndarray,
    camera: Camera,
    noise: float = 0.0,
    background: np.ndarray | None = None,
    bent: np.ndarray | None = None,
    bend: np.ndarray | float = 0.0,
    coarse: int = 1,
    hides: bool = True,
) -> Explanation:
    """Return the Explanation of an image by a scene.

    graph : the scene, its root in the camera's axes. seen : (H, W) float metres, NaN or 0 = no return.
    camera : of this image. noise : standard deviation in metres of what is seen of the floor.
    background : (H, W) bool, pixels that show neither floor nor solid, or what hides one; each is explained by the
        mean of the surface about it (a plane is its own), so that single outliers are not.
    bent : (H, W) bool, pixels of the floor that the model takes as the sensor bends them: they show the floor
        where they are off its plane by no more than MOST_BENT of the depth. bend : (H, W) metres by which all is seen
        nearer than it is, as the floor tells.
    hides : whether background may lie before a solid: of an image without a sensor's dents what does is unexplained.
    coarse : pixels of this image by which the silhouettes of free-form things may be off, which were found in a
        reduced one: what goes on beyond them without a step, and nothing else explains, is theirs.
    """
    solids = graph.solids()
    depth, index = render_depth(solids, camera)
    numbers, names = [], []
    for name in graph.solid_names:
        plane = graph.vertex(name).shape == "plane"
        numbers.append(FLOOR if plane else len(names))
        names += [] if plane else [name]
    label = np.array([*numbers, UNEXPLAINED], np.int32)[index]  # -1, where nothing is hit, is the last
    depth = depth - bend
    valid = np.isfinite(seen) & (seen > 0)
    filled = np.where(valid, seen, 0.0)
    tolerance = np.maximum(np.maximum(NEAR, NEAR_SHARE * filled), NOISES * noise)
    if background is not None:
        behind = background & valid & ((label < 0) | (hides & (depth > filled + tolerance)))
        depth[behind] = smooth_surface(filled, behind)[behind]
        label[behind] = BACKGROUND
    with np.errstate(invalid="ignore"):
        off = np.abs(depth - filled)
    missed = (label == FLOOR) & valid & (off > tolerance)
    if bent is not None:
        floor = bent & missed & (off < MOST_BENT * filled)
        depth[floor] = smooth_surface(filled, floor)[floor]
        missed &= ~floor
    missed &= off * slants(graph, index, camera) > tolerance
    label[missed], depth[missed] = UNEXPLAINED, np.nan
    free = np.array([graph.vertex(name).shape == "thing" for name in names], bool)
    for _ in range(coarse if free.any() else 0):
        grow(label, depth, filled, free)
    return Explanation(label, depth.astype(np.float32), tuple(names))


def slants(graph: SceneGraph, index: np.ndarray, camera: Camera) -> np.ndarray:
    """Return (H, W) by how many metres a point is off the plane that is met there when it is one off in depth, 1 at
    most: what lies flat on a floor that is seen at a slant is far off it along the ray; 1 where no plane is met.

    index : (H, W) int, of the solid that is met, as `render_depth` has it.
    """
    found, rays = np.ones(index.shape), camera.rays()
    for place, name in enumerate(graph.solid_names):
        if graph.vertex(name).shape == "plane":
            on = index == place
            found[on] = np.minimum(np.abs(rays[on] @ graph.poses()[name][:3, 2]), 1.0)
    return found


def grow(label: np.ndarray, depth: np.ndarray, seen: np.ndarray, free: np.ndarray) -> None:
    """Let unexplained pixels join the free-form thing of a neighbour without a step between them, in place.

    free : (N,) bool, which objects are free-form.
    """
    labels, depths = np.pad(label, 1, constant_values=UNEXPLAINED), np.pad(seen, 1)
    joins = (label == UNEXPLAINED) & (seen > 0.0)
    for down, across in ((2, 1), (0, 1), (1, 2), (1, 0)):
        beside = np.s_[down : down + label.shape[0], across : across + label.shape[1]]
        owner = labels[beside]
        own = joins & (owner >= 0) & free[np.maximum(owner, 0)] & (np.abs(depths[beside] - seen) < STEP * seen)
        label[own], depth[own] = owner[own], seen[own]


@njit(cache=True, nogil=True)
def smooth_surface(depth, mask):
    """Return (H, W) the mean over a window of those pixels of the mask that lie on the same surface; 0 outside it."""
    height, width = depth.shape
    out = np.zeros((height, width))
    for j in range(height):
        for i in range(width):
            if not mask[j, i]:
                continue
            total, count = 0.0, 0
            for v in range(max(j - WINDOW, 0), min(j + WINDOW + 1, height)):
                for u in range(max(i - WINDOW, 0), min(i + WINDOW + 1, width)):
                    if mask[v, u] and abs(depth[v, u] - depth[j, i]) < STEP * depth[j, i]:
                        total += depth[v, u]
                        count += 1
            out[j, i] = total / count
    return out
