"""Equal cartons: a box that may be a grid of equal cartons, stacked so closely that hardly a gap between them shows.

A grid of n x m x k equal boxes fills the same space as one box but for its gaps. The two differ in three things only,
so that every box of a structure is asked afterwards whether it is a grid:

    the prior       of cartons in a grid, and of their common size against that of the one box
    the Jacobian    a length L in n equal parts has 1 / n of the density of one part
    the seams       what pixels beside them show: a ray that meets a gap of width g, at random within the pixel's step
                    along the face, is as much deeper as it takes to cross what is left of the gap

The gap is unknown, and another one along each axis. Where no seam can show, as between layers without a gap, the
probability spreads over all numbers of parts that the prior has.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.noise import spread_of
from derender.detection.solids.beliefs import Beliefs
from derender.detection.solids.graph import FLOOR_NAME, ON_A_FACE, TILTS, floating, periods_of, without
from derender.detection.solids.sizes import box_log_density
from derender.render.raycast.depth import render_depth
from derender.results.posterior import StructurePosterior
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.scene.pose import inverse
from derender.scene.priors.bare_image import Cartons
from derender.scene.solids import BOX
from derender.structures.draws.numbers import numbers_at

FEWEST = 4  # boxes of a grid: two or three are found as such
PRUNE_THRESHOLD = (
    -12.0
)  # nats of the likeliest grid before its seams are looked for: those of a household's boxes lie below
GAPS = np.linspace(0.0, 1.0, 9)  # shares of the widest gap that are summed over
OUTLIERS, RANGE = 0.01, 1.0  # share of pixels that may show anything, within so many metres
LEAST_SLOPE = 1e-3  # metres across a gap for each of depth, of rays along it
MISPLACED = 0.002  # metres by which a seam may be off where equal parts put it
RIM = 2  # pixels of a silhouette that may show what is behind
NO_NOISE, FITS = 3.0, 3  # standard deviations that are no noise of a face, and how often a face is fitted without them
SMALLEST_WEIGHT, MOST_KEPT = 0.01, 12  # of a grid that is kept, and of how many, the one box among them
DRAWS = 20  # of a grid, of each chain: each is placed carton by carton
EXTENTS = ("length", "width", "height")


class Shown(NamedTuple):
    """The K pixels that show a box.

    place : (K, 3) metres from the box's low corner, along its axes, of what they show.
    step : (K, 3) metres along each axis from a pixel's place to the next one's. slope : (K, 3) metres along each axis
        for each metre of depth, of their rays. normal : (K,) the axis across the face.
    deeper : (K,) metres by which they are deeper than the box. sigma : (K,) of their noise.
    """

    place: np.ndarray
    step: np.ndarray
    slope: np.ndarray
    normal: np.ndarray
    deeper: np.ndarray
    sigma: np.ndarray


def shown(
    depth: np.ndarray, sigma: np.ndarray, camera: Camera, pose: np.ndarray, size: np.ndarray, mask: np.ndarray
) -> Shown:
    """Return the Shown of a box.

    depth, sigma : (H, W) metres. mask : (H, W) bool, where the box is what is seen. pose : (4, 4), box to camera.
    """
    from scipy.ndimage import binary_erosion

    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ray = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(depth.shape)], axis=-1)
    inner = inverse(pose)
    way, origin = ray @ inner[:3, :3].T, inner[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        enter = np.min([(end - origin) / way for end in (-0.5 * size, 0.5 * size)], axis=0)
    normal = enter.argmax(axis=-1)
    hit = np.take_along_axis(enter, normal[..., None], axis=-1)[..., 0]
    # along a face the place moves by the ray's turn, its part across the face taken out by a change of depth
    across = np.take_along_axis(way, normal[..., None], axis=-1)
    step = np.zeros((*depth.shape, 3))
    for turn in (inner[:3, 0] / camera.fx, inner[:3, 1] / camera.fy):
        step += np.abs(hit[..., None] * (turn - way * turn[normal][..., None] / across))
    place = origin + hit[..., None] * way + 0.5 * size
    good = np.isfinite(depth) & binary_erosion(mask, iterations=RIM)
    deeper, noise = of_faces(place[good], normal[good], (depth - hit)[good], sigma[good])
    return Shown(place[good], step[good], np.abs(way[good]), normal[good], deeper, noise)


def of_faces(
    place: np.ndarray, normal: np.ndarray, deeper: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (deeper, sigma), (K,) metres, without what each face as a whole is off, and with the noise that it shows.

    The box's pose and extents are not exact: a plane for each face, by least squares without what is no noise.
    """
    deeper, sigma = deeper.copy(), sigma.copy()
    for axis in range(3):
        face = np.flatnonzero(normal == axis)
        terms = np.column_stack([np.ones(len(face)), np.delete(place[face], axis, axis=1)])
        left = deeper[face] - np.median(deeper[face]) if len(face) else deeper[face]
        for _ in range(FITS):
            noise = np.abs(left) < NO_NOISE * sigma[face]
            if noise.sum() < 3:
                break
            plane = np.linalg.lstsq(terms[noise], deeper[face][noise], rcond=None)[0]
            left = deeper[face] - terms @ plane
        deeper[face] = left
        if len(face):
            sigma[face] *= max(1.0, spread_of(left / sigma[face]))
    return deeper, sigma


def seam_gain(seen: Shown, axis: int, extent: float, parts: int, widest: float) -> np.ndarray:
    """Return (len(GAPS),) nats by which seams across an axis explain a Shown better than none, by the gap.

    extent : metres of the box along that axis. parts : into which it is cut. widest : metres of the widest gap.
    """
    from scipy.special import ndtr

    on = seen.normal != axis
    apart = np.abs((seen.place[on, axis] / (extent / parts) + 0.5) % 1.0 - 0.5) * extent / parts
    inner = np.abs(seen.place[on, axis] - 0.5 * extent) < 0.5 * extent * (1.0 - 1.0 / parts)
    reach = 0.5 * seen.step[on, axis] + MISPLACED
    near = (apart < reach) & inner
    r, sigma, slope, width = (x[near] for x in (seen.deeper[on], seen.sigma[on], seen.slope[on, axis], 2.0 * reach))
    # other seams cross these: as many pixels as elsewhere are deeper for no fault of this one
    deep = seen.deeper > NO_NOISE * seen.sigma
    mean = seen.deeper[deep].mean() if deep.any() else RANGE
    face = (1.0 - OUTLIERS) * np.exp(-0.5 * (r / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    rest = OUTLIERS / RANGE + deep.mean() * np.where(r > 0.0, np.exp(-np.maximum(r, 0.0) / mean) / mean, 0.0)
    gains = np.zeros(len(GAPS))
    for number, gap in enumerate(widest * GAPS[1:], start=1):
        most = np.minimum(gap / np.maximum(slope, LEAST_SLOPE), extent)
        hit = np.minimum(gap / width, 1.0)
        within = (1.0 - OUTLIERS) * (ndtr(r / sigma) - ndtr((r - most) / sigma)) / most
        gains[number] = np.log(((1.0 - hit) * face + hit * within + rest) / (face + rest)).sum()
    return gains


class Image(NamedTuple):
    """What is seen: depth (H, W) metres, NaN = no return; camera; sigma (H, W) metres of noise; how many of its pixels
    tell as much as one independent one; metres of the unit in which lengths are counted."""

    depth: np.ndarray
    camera: Camera
    sigma: np.ndarray
    temper: float
    unit: float


class Grid(NamedTuple):
    """A box in parts: parts (3,) of them along its axes; log odds against the one box; gap (3,) metres."""

    parts: tuple[int, ...]
    odds: float
    gap: np.ndarray


def with_grids(parts: Sequence[StructurePosterior], image: Image, beliefs: Beliefs) -> list[StructurePosterior]:
    """Return the structures and those in which some of their boxes are grids, weights still summing to what they did.

    Only boxes that stand upright on a floor with nothing on them are asked.
    """
    found = []
    for part in parts:
        graph, _ = part.best()
        divided = [part]
        for name in blocks_of(graph):
            grids = grids_of(graph, name, image, beliefs)
            divided = [piece for whole in divided for piece in divide(whole, name, grids)]
        found += divided
    return sorted(found, key=lambda part: -part.weight)


def blocks_of(graph: SceneGraph) -> list[str]:
    """Return the names of the boxes that may be grids."""
    return [
        vertex.name for vertex in graph.vertices
        if vertex.shape == "box" and vertex.parent == FLOOR_NAME and not graph.children(vertex.name)
        and vertex.contact.type == ON_A_FACE[0] and vertex.contact.child_face == "-z"
        and not any(vertex.name in other.supports for other in graph.vertices)
    ]  # fmt: skip


def grids_of(graph: SceneGraph, name: str, image: Image, beliefs: Beliefs) -> list[Grid]:
    """Return the Grids that a box may be; none where the prior makes all of them too improbable."""
    cartons, size = beliefs.loose.cartons, np.array(graph.body(name).size())
    before = prior_odds(size, cartons, beliefs, image.unit)
    if max(before.values()) < PRUNE_THRESHOLD:
        return []
    index = render_depth(graph.solids(), image.camera)[1]
    mask = index == list(graph.solid_names).index(name)
    seen = shown(image.depth, image.sigma, image.camera, graph.poses()[name], size, mask)
    widest = cartons.gap / image.unit
    gains = [[seam_gain(seen, axis, size[axis], number, widest) / image.temper if number > 1 else np.zeros(1)
              for number in range(1, cartons.most + 1)] for axis in range(3)]  # fmt: skip
    found = []
    for parts, odds in before.items():
        chosen = [gains[axis][number - 1] for axis, number in enumerate(parts)]
        odds += sum(float(np.logaddexp.reduce(gain)) - np.log(len(gain)) for gain in chosen)
        found.append(Grid(parts, odds, widest * GAPS[[int(gain.argmax()) for gain in chosen]]))
    return found


def prior_odds(size: np.ndarray, cartons: Cartons, beliefs: Beliefs, unit: float) -> dict[tuple[int, ...], float]:
    """Return the log odds of each grid against one box of this size (3,), which is as likely a carton as anything else.

    The keys are the numbers of cartons along its axes.
    """
    numbers = range(1, cartons.most + 1)
    # Of a carton's extent where one of the box's is cut into so many equal parts: (3, most).
    density = np.array([[cartons.extent.log_density(float(extent) / n * unit) + np.log(unit) for n in numbers]
                        for extent in size])  # fmt: skip
    one = np.logaddexp(density[:, 0].sum(), box_log_density(beliefs.sizes[BOX], size, True)) - np.log(2.0)
    grids = {parts: math.prod(parts) for parts in product(numbers, repeat=3) if math.prod(parts) >= FEWEST}
    shares = sum(1.0 / count for count in grids.values())
    base = float(np.log(cartons.probability / (1.0 - cartons.probability)) - np.log(shares) - one)
    # Twice a share of one over the count: that of the prior, and the Jacobian.
    return {parts: base + sum(float(density[axis, n - 1]) for axis, n in enumerate(parts)) - 2.0 * math.log(count)
            for parts, count in grids.items()}  # fmt: skip


def divide(part: StructurePosterior, name: str, grids: Sequence[Grid]) -> list[StructurePosterior]:
    """Return a structure with one of its boxes as it is and as each grid that is likely enough."""
    if not grids or part.graph.vertex(name).shape != "box":
        return [part]
    odds = np.array([0.0, *(grid.odds for grid in grids)])
    one, *others = np.exp(odds - np.logaddexp.reduce(odds))
    if one > 1.0 - SMALLEST_WEIGHT:
        return [part]
    one = one if one >= SMALLEST_WEIGHT else 0.0
    # Which grids are told is a choice among grids: those left out take nothing from the one box's share.
    kept = sorted(range(len(grids)), key=lambda k: -others[k])[: MOST_KEPT - 1]
    kept = [k for place, k in enumerate(kept) if place == 0 or others[k] >= SMALLEST_WEIGHT]
    among = (1.0 - one) / sum(others[k] for k in kept)
    made = [part.scaled(float(one))] if one else []
    for k in kept:
        leads = k == kept[0] and others[k] > one
        made.append(as_grid(part if leads else part.best_only(), name, grids[k]).scaled(float(among * others[k])))
    return made


def as_grid(part: StructurePosterior, name: str, grid: Grid) -> StructurePosterior:
    """Return a structure whose box is a grid, its draws those of the box."""
    best, _ = part.best()
    names = {place: f"{name}_{number + 1}" for number, place in enumerate(np.ndindex(*grid.parts))}
    graph = part.graph.remove(name)
    graph.poses()  # once: a graph that grows keeps what it knows
    for (i, j, k), own in sorted(names.items(), key=lambda item: item[0][2]):
        pose, size = carton(best, name, grid, (i, j, k))
        vertex = Vertex(own, "box", dict(zip(EXTENTS, map(float, size), strict=True)), ROOT, floating(pose))
        parent = FLOOR_NAME if k == 0 else names[i, j, k - 1]
        contact, _ = graph.add(vertex).nearest_contact(own, parent, ON_A_FACE[0], "+z", "-z")
        graph = graph.add(replace(vertex, parent=parent, contact=without(contact, "gap", *TILTS)))
    every = max(1, part.log_density.shape[1] // DRAWS)
    part = part.at((slice(None), slice(None, None, every)))
    others = [k for k, address in enumerate(part.addresses) if address.partition(".")[0] != name]
    own_addresses = [address for address in graph.numbers() if address.partition(".")[0] in names.values()]
    drawn = np.empty((*part.log_density.shape, len(own_addresses)))
    for place in np.ndindex(part.log_density.shape):
        box = part.graph_at(*place)
        places = {}
        for cell, own in names.items():
            pose, size = carton(box, name, grid, cell)
            places[own] = pose, dict(zip(EXTENTS, map(float, size), strict=True))
        numbers = numbers_at(replace(graph, root_pose=box.root_pose), box.root_pose, places)
        drawn[place] = [numbers[address] for address in own_addresses]
    addresses = (*(part.addresses[k] for k in others), *own_addresses)
    return replace(part, graph=graph, addresses=addresses, periods=periods_of(graph, addresses),
                   values=np.concatenate([part.values[..., others], drawn], axis=2))  # fmt: skip


def carton(graph: SceneGraph, name: str, grid: Grid, cell: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return (pose (4, 4) in the floor's axes, size (3,)) of one carton of a grid that fills a box."""
    whole, count = np.array(graph.body(name).size()), np.array(grid.parts)
    size = (whole - (count - 1) * grid.gap) / count
    pose = inverse(graph.root_pose) @ graph.poses()[name]
    pose[:3, 3] += pose[:3, :3] @ ((np.array(cell) - 0.5 * (count - 1)) * (size + grid.gap))
    return pose, size
