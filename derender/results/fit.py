"""What the best scene of a posterior says of each pixel of its image, an `Explanation`, and how well that fits.

Of a result folder `labels.png` holds which object each pixel shows and `explained.npy` how deep it lies;
`explained` in the summary is the share of the valid pixels of which that is true.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import greatest, least
from derender.compilation.cache import njit
from derender.render.blur import blur
from derender.render.raycast.depth import render_depth
from derender.scene.graph import SceneGraph

PATCHES_ABREAST, SMALLEST = 40, 6  # patches in a row of the image; pixels of a patch's side at least
FLAT = 0.25  # share of the patches that surely show one flat surface and nothing else
LEAST_PATCHES = 8  # fewer tell nothing


class Noise(NamedTuple):
    """Standard deviation sigma_0 + growth z^2 at a depth z, metres."""

    sigma: float  # at the median depth. sigma_0 : metres
    sigma_0: float
    growth: float  # 1/m

    def at(self, depth: np.ndarray) -> np.ndarray:
        """Return the standard deviation at depths in metres."""
        return self.sigma_0 + self.growth * np.square(depth)


def flat_noise(observed: np.ndarray) -> Noise:
    """Return the Noise that the flattest patches of an image (H, W) show; none where there are too few patches.

    A plane's inverse depth is affine in the pixel's place, so that residuals of a linear fit to it are noise alone.
    A near and a far half of the patches tell whether it grows.
    """
    side = max(SMALLEST, observed.shape[1] // PATCHES_ABREAST)
    rows, columns = observed.shape[0] // side, observed.shape[1] // side
    tiles = observed[: rows * side, : columns * side].reshape(rows, side, columns, side)
    patches = tiles.swapaxes(1, 2).reshape(rows * columns, side * side)
    patches = patches[np.isfinite(patches).all(axis=1)]
    if len(patches) < LEAST_PATCHES:
        return Noise(0.0, 0.0, 0.0)
    at = np.linspace(-1.0, 1.0, side)
    design = np.column_stack([np.ones(side * side), np.repeat(at, side), np.tile(at, side)])
    basis, _ = np.linalg.qr(design)
    inverse = 1.0 / patches
    residual = inverse - (inverse @ basis) @ basis.T
    middle = np.median(patches, axis=1)
    scatter = np.sqrt((residual**2).sum(axis=1) / (side * side - 3)) * middle**2
    near = middle <= np.median(middle)
    square = np.array([np.mean(middle[half] ** 2) for half in (near, ~near) if half.any()])
    spread = np.array([np.quantile(scatter[half], FLAT) for half in (near, ~near) if half.any()])
    growth = float((spread[-1] - spread[0]) / (square[-1] - square[0])) if square[-1] > square[0] else 0.0
    growth = float(np.clip(growth, 0.0, spread[0] / square[0]))  # from nothing at no distance, at most
    sigma_0 = float(spread[0] - growth * square[0])
    return Noise(float(sigma_0 + growth * np.median(middle) ** 2), sigma_0, growth)


# Three standard deviations of what depth cameras are off by at a depth z, from planes before consumer sensors (white
# noise, slow bias and edges together): 12 mm at 1 m, 32 mm at 2 m.  A depth within it is explained.
SENSOR_PER_DEPTH, SENSOR_PER_SQUARE = 0.008, 0.004  # metres by metre, by square metre
TO_SIGMA = 1.4826  # standard deviations of a normal in the median of its absolute value
DEVIATIONS = 4.0  # of the noise that the image's own flat patches show, where that is more
MOST_TOLERANCE = 0.05  # of the depth: whatever the noise, a depth that is farther off is not explained
AT_EDGES = 1  # pixels by which a silhouette may lie elsewhere, besides the blur
MOST_LABEL = 65535  # of 16 bits


class Fit(NamedTuple):
    """What the best scene says of an image (H, W).

    label : uint16; k where the pixel shows the k-th object of `derender show --json`, 0 where it shows a plane, what
        the model takes as background, or nothing.
    predicted : float64 metres, the depth of solids, floor and the likelihood's wall; NaN where there is none of them.
    explained : bool; a depth was observed and lies within the tolerance of what is predicted at the pixel or, at a
        silhouette, between what is predicted about it; of a floor how far off its plane it lies counts.
    """

    label: np.ndarray
    depth: np.ndarray  # float32 metres along the optical axis of what explains the pixel; NaN where nothing does
    predicted: np.ndarray
    tolerance: np.ndarray  # float64 metres; how far off a depth may be and yet be explained
    explained: np.ndarray
    background: np.ndarray  # bool; not that, but taken as the background as it was seen, which says nothing of it
    share: float  # of the pixels with a depth, those that are explained or background
    noise: Noise  # Noise that flat patches of the image show


def fit_of(
    graph: "SceneGraph",
    camera: Camera,
    observed: np.ndarray,
    likelihood: Mapping[str, Any],
    told: np.ndarray | None = None,
    uneven: float = 0.0,
) -> Fit:
    """Return how well a scene fits an image.

    observed : (H, W) float64, metres, NaN where nothing returned.
    likelihood : its numbers by name; of them `blur` (pixels) and `background` (metres, where nothing else is seen).
    told : (H, W) metres that inference says explain the pixels, as the sensor bends them, the background among them
        and what it hides (`Explanation.depth`), NaN where nothing does; None: what the scene predicts.
    uneven : metres, one standard deviation, by which inference found the floor to be off its plane.
    """
    clean, solid = render_depth(graph.solids(), camera)
    objects = {vertex.name: (place, vertex.body.size()) for place, vertex in enumerate(graph.vertices, start=1)}
    numbers = [objects[name] for name in graph.solid_names]
    table = np.array([*(0 if size is None else place for place, size in numbers), 0])  # -1, nothing, is the last
    label = np.where(table[solid] <= MOST_LABEL, table[solid], 0).astype(np.uint16)
    wall, pixels = likelihood.get("background"), float(likelihood.get("blur") or 0.0)
    if isinstance(wall, int | float) and np.isfinite(wall):
        clean = np.where(np.isfinite(clean), np.minimum(clean, wall), wall)
    noise = flat_noise(observed)
    tolerance = tolerance_of(observed, noise)
    low, high = neighbourhood(clean, AT_EDGES + int(np.ceil(pixels)))
    with np.errstate(invalid="ignore"):
        explained = (observed >= low - tolerance) & (observed <= high + tolerance)
        flat = np.minimum(np.maximum(tolerance, DEVIATIONS * uneven), MOST_TOLERANCE * observed)
        explained |= (label == 0) & (np.abs(observed - clean) * slants(graph, solid, camera) <= flat)
        if told is not None:
            near = np.abs(observed - told) <= tolerance
            nearer = clean - told  # than the solid is: by the sensor's bend, or something else hides it
            bent = near & (label > 0) & (np.abs(nearer) < MOST_TOLERANCE * observed)
            explained |= bent
            label[near & (nearer > MOST_TOLERANCE * observed)] = 0
        else:
            near = bent = np.zeros(observed.shape, bool)
    background = near & ~explained & (label == 0)
    valid = np.isfinite(observed)
    share = float((explained | background)[valid].mean()) if valid.any() else 0.0
    depth = blur(clean, pixels) if pixels and np.isfinite(clean).all() else clean
    depth = np.where((near & (label == 0)) | bent, observed if told is None else told, depth)
    return Fit(label, depth.astype(np.float32), clean, tolerance, explained, background, share, noise)


def sensor_deviation(depth: float | np.ndarray) -> float | np.ndarray:
    """Return the standard deviation in metres of what consumer depth cameras are off by at a depth, bias included."""
    return (SENSOR_PER_DEPTH * depth + SENSOR_PER_SQUARE * depth**2) / 3.0


def on_best_plane(
    design: np.ndarray, numbers: np.ndarray, allowed: np.ndarray, triples: np.ndarray, least: float
) -> np.ndarray | None:
    """Return (N,) bool, which numbers (N,) are on the affine function through three of them that most are on.

    design : (N, 3) what they are affine in, and ones. allowed : (N,) by which they may be off. triples : (T, 3) those
        that are tried. least : determinant of a triple's design that tells a function. None: none does.
    """
    usable = triples[np.abs(np.linalg.det(design[triples])) > least]
    if not len(usable):
        return None
    planes = np.linalg.solve(design[usable], numbers[usable][..., None])[..., 0]
    near = np.abs(planes @ design.T - numbers) <= allowed
    return near[np.argmax(near.sum(axis=1))]


def scatter(residual: np.ndarray) -> float:
    """Return the standard deviation of residuals about zero, from the median of their sizes."""
    return TO_SIGMA * median(np.abs(residual))


def median(values: np.ndarray) -> float:
    """Return the median of values (N,), finite and N > 0: as numpy's, at a seventh of its time for a whole image."""
    half = len(values) // 2
    ordered = np.partition(values, half)  # numpy is slow where it is asked for two places
    return float(ordered[half]) if len(values) % 2 else 0.5 * float(ordered[:half].max() + ordered[half])


def tolerance_of(observed: np.ndarray, noise: Noise) -> np.ndarray:
    """Return how far off each depth (H, W) may be and yet be explained, metres, NaN where there is none.

    noise : Noise that the image's flat patches show.
    """
    tolerance = np.maximum(3.0 * sensor_deviation(observed), DEVIATIONS * noise.at(observed))
    return np.minimum(tolerance, MOST_TOLERANCE * observed)


def neighbourhood(depth: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest depth (H, W) within `reach` rows and columns; NaN counts for nothing."""
    low, high = np.where(np.isfinite(depth), depth, np.inf), np.where(np.isfinite(depth), depth, -np.inf)
    return least(low, reach), greatest(high, reach)


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
        """Return which share of the valid pixels of `seen` (H, W) is explained to so many metres, or far away to
        NEAR_SHARE of the depth."""
        valid = np.isfinite(seen) & (seen > 0)
        with np.errstate(invalid="ignore"):
            near = np.abs(self.depth - seen) < np.maximum(within, NEAR_SHARE * seen)
        return float(near[valid].mean()) if valid.any() else 0.0

    def borne_out(self, seen: np.ndarray) -> dict[str, float]:
        """Return for each object which share of the valid pixels of `seen` (H, W) that are to show it do, at its
        silhouette also what lies between it and what is beside it, by Laplace's rule of succession: few pixels make
        nothing sure."""
        valid = np.isfinite(seen) & (seen > 0)
        tolerance, (low, high) = tolerance_of(seen, flat_noise(seen)), neighbourhood(self.depth, AT_EDGES)
        with np.errstate(invalid="ignore"):
            near = (seen >= low - tolerance) & (seen <= high + tolerance)
        shown = {name: valid & (self.label == place) for place, name in enumerate(self.names)}
        return {name: float((near[own].sum() + 1) / (own.sum() + 2)) for name, own in shown.items() if own.any()}


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


def smooth_surface(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return (H, W) the mean over a window of those pixels of the mask that lie on the same surface; 0 outside it."""
    return means_about(depth, mask, STEP * depth)[0]


@njit(cache=True, nogil=True)
def means_about(depth, mask, step):
    """Return (H, W) the mean over a window of those pixels of the mask that differ by less than `step` (H, W) metres
    from the one in its middle, and how many they are; 0 outside the mask."""
    height, width = depth.shape
    out, many = np.zeros((height, width)), np.zeros((height, width))
    for j in range(height):
        for i in range(width):
            if not mask[j, i]:
                continue
            total, count = 0.0, 0
            for v in range(max(j - WINDOW, 0), min(j + WINDOW + 1, height)):
                for u in range(max(i - WINDOW, 0), min(i + WINDOW + 1, width)):
                    if mask[v, u] and abs(depth[v, u] - depth[j, i]) < step[j, i]:
                        total += depth[v, u]
                        count += 1
            out[j, i], many[j, i] = total / count, count
    return out, many
