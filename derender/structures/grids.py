"""Equal cartons: a box that may be a grid of equal cartons, stacked so closely that hardly a gap between them shows.

A grid of n x m x k equal boxes fills the same space as one box but for its gaps, and differs from it in

    the prior       of cartons in a grid, and of their common size against that of the one box
    the Jacobian    a length L in n equal parts has 1 / n of the density of one part
    the seams       what pixels beside them show: a ray that meets a gap of width g, at random within the pixel's step
                    along the face, is as much deeper as it takes to cross what is left of the gap

Boxes that stand flush beside each other are asked as one. The gap is unknown, another one along each axis; of layers
only some leave a groove that shows. Where no seam can show all numbers of parts are as probable as the prior has them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import shrunk
from derender.detection.pyramid import spread_of
from derender.detection.solids.beliefs import Beliefs, box_log_density
from derender.detection.solids.graph import TILTS, without
from derender.render.raycast.depth import render_depth
from derender.results.posterior import StructurePosterior
from derender.scene.contacts.kinds import ON_A_FACE
from derender.scene.graph import Body, Contact, SceneGraph, nearest_contact, vertex_of
from derender.scene.pose import inverse, translation
from derender.scene.priors.bare_image import Cartons
from derender.scene.solids import BOX

FEWEST = 4  # boxes of a grid: two or three are found as such
# Nats of the likeliest grid before its seams are looked for: those of a household's boxes lie below.
LEAST_ODDS = -12.0
# Metres by which faces of flush boxes may be off, and a seam that was found, from where equal parts put it.
FLUSH = 0.01
AGAINST = 0.1  # share of boxes that somebody has set flush against another
GAPS = np.linspace(0.0, 1.0, 9)  # shares of the widest gap that are summed over
OUTLIERS, RANGE = 0.01, 1.0  # share of pixels that may show anything, within so many metres
LEAST_SLOPE = 1e-3  # metres across a gap for each of depth, of rays along it
MISPLACED = 0.002  # metres by which a seam may be off where equal parts put it
RIM = 2  # pixels of a silhouette that may show what is behind
NO_NOISE, FITS = 3.0, 3  # standard deviations that are no noise of a face, and how often a face is fitted without them
SMALLEST_WEIGHT, MOST_KEPT = 0.01, 12  # of a grid that is kept, and of how many, the one box among them
UP = 2  # the axis of an upright box across its layers


class Shown(NamedTuple):
    """The K pixels that show a box."""

    place: np.ndarray  # (K, 3) metres from the box's low corner, along its axes, of what they show
    step: np.ndarray  # (K, 3) metres along each axis from a pixel's place to the next one's
    slope: np.ndarray  # (K, 3) metres along each axis for each metre of depth, of their rays
    normal: np.ndarray  # (K,) the axis across the face
    deeper: np.ndarray  # (K,) metres by which they are deeper than the box
    sigma: np.ndarray  # (K,) of their noise


def shown(
    depth: np.ndarray, sigma: np.ndarray, camera: Camera, pose: np.ndarray, size: np.ndarray, mask: np.ndarray
) -> Shown:
    """Return the Shown of a box.
    depth, sigma : (H, W) metres. mask : (H, W) bool, where the box is what is seen. pose : (4, 4), box to camera."""
    good = np.isfinite(depth) & shrunk(mask, RIM)
    inner = inverse(pose)
    way, origin = camera.rays()[good] @ inner[:3, :3].T, inner[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        enter = np.min([(end - origin) / way for end in (-0.5 * size, 0.5 * size)], axis=0)
    normal = enter.argmax(axis=1)
    hit, across = (np.take_along_axis(each, normal[:, None], axis=1) for each in (enter, way))
    # along a face the place moves by the ray's turn, its part across the face taken out by a change of depth
    step = np.zeros(way.shape)
    for turn in (inner[:3, 0] / camera.fx, inner[:3, 1] / camera.fy):
        step += np.abs(hit * (turn - way * turn[normal][:, None] / across))
    place = origin + hit * way + 0.5 * size
    deeper, noise = of_faces(place, normal, depth[good] - hit[:, 0], sigma[good])
    return Shown(place, step, np.abs(way), normal, deeper, noise)


def of_faces(
    place: np.ndarray, normal: np.ndarray, deeper: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (deeper, sigma), (K,) metres, without what each face as a whole is off (a plane by least squares, the
    box's pose and extents are not exact), and with the noise that it shows."""
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
    extent : metres of the box along that axis. parts : into which it is cut. widest : metres of the widest gap."""
    from scipy.special import ndtr

    on = seen.normal != axis
    apart = np.abs((seen.place[on, axis] / (extent / parts) + 0.5) % 1.0 - 0.5) * extent / parts
    inner = np.abs(seen.place[on, axis] - 0.5 * extent) < 0.5 * extent * (1.0 - 1.0 / parts)
    reach = 0.5 * seen.step[on, axis] + MISPLACED
    near = (apart < reach) & inner
    r, sigma, slope, width = (x[near] for x in (seen.deeper[on], seen.sigma[on], seen.slope[on, axis], 2.0 * reach))
    # other seams cross these: as many pixels as elsewhere are deeper for no fault of this one
    deep = seen.deeper > NO_NOISE * seen.sigma
    mean, share = (seen.deeper[deep].mean(), deep.mean()) if deep.any() else (RANGE, 0.0)
    face = (1.0 - OUTLIERS) * np.exp(-0.5 * (r / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    rest = OUTLIERS / RANGE + share * np.where(r > 0.0, np.exp(-np.maximum(r, 0.0) / mean) / mean, 0.0)
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
    """A box in parts: parts (3,) of them along its axes; log odds against the one box; gap (3,) metres, the likeliest,
    and drawn : function of a generator and a number that returns so many (n, 3) as the image leaves them open."""

    parts: tuple[int, ...]
    odds: float
    gap: np.ndarray
    drawn: Callable[[np.random.Generator, int], np.ndarray]


def with_grids(
    rng: np.random.Generator, parts: Sequence[StructurePosterior], image: Image, beliefs: Beliefs
) -> list[StructurePosterior]:
    """Return the structures and those in which some of their boxes are grids, weights still summing to what they did.
    Asked are upright boxes with nothing on them, those side by side on one floor or box that are flush as one."""
    found = []
    for part in parts:
        graph, _ = part.best()
        bodies = bodies_of(graph, blocks_of(graph), beliefs.loose.cartons.gap / image.unit, FLUSH / image.unit)
        found += divide(rng, part, [(names, grids_of(graph, names, image, beliefs)) for names in bodies])
    return sorted(found, key=lambda part: -part.weight)


def bodies_of(graph: SceneGraph, groups: list[tuple[str, ...]], gap: float, flush: float) -> list[tuple[str, ...]]:
    """Return groups of names of boxes, joined where one beside another fills one box but for gaps.
    gap, flush : metres between neighbours and by which their faces may be off, at most."""
    for one, other in permutations(groups, 2):
        if graph.vertex(one[0]).parent != graph.vertex(other[0]).parent:
            continue
        (_, first), (_, second), (_, both) = (hull_of(graph, each) for each in (one, other, one + other))
        beyond = both - first  # the other's own extent along one level axis, and nothing along the two others
        axis = int(np.argmax(beyond))
        level = np.abs(np.delete(beyond, axis)).max() < flush and abs(both[2] - second[2]) < flush
        shared = abs(float(np.prod(both) - np.prod(first) - np.prod(second)))
        if axis < 2 and level and shared < (gap + flush) * float(np.prod(np.delete(both, axis))):
            return bodies_of(graph, [*(each for each in groups if each not in (one, other)), one + other], gap, flush)
    return groups


def hull_of(graph: SceneGraph, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return (pose (4, 4) to camera, size (3,)) of the box about some boxes, along the axes of the first."""
    pose, ends = graph.poses()[names[0]].copy(), ends_of(graph, names)
    low, high = ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)
    pose[:3, 3] += pose[:3, :3] @ (0.5 * (low + high))
    return pose, high - low


def ends_of(graph: SceneGraph, names: Sequence[str]) -> np.ndarray:
    """Return (N, 2, 3) how far some boxes reach along the axes of the first, both ways from its middle."""
    places = inverse(graph.poses()[names[0]]) @ np.array([graph.poses()[name] for name in names])
    sizes = np.array([graph.body(name).size() for name in names])
    half = 0.5 * (np.abs(places[:, :3, :3]) @ sizes[..., None])[..., 0]
    return np.stack([places[:, :3, 3] - half, places[:, :3, 3] + half], axis=1)


def blocks_of(graph: SceneGraph) -> list[tuple[str, ...]]:
    """Return the name of each box that may be a grid, alone."""
    return [
        (vertex.name,) for vertex in graph.vertices
        if vertex.shape == "box" and not graph.children(vertex.name)
        and vertex.contact.type == ON_A_FACE[0] and vertex.contact.child_face == "-z"
        and vertex.contact.parent_face == "+z" and not vertex.supports
        and not any(vertex.name in other.supports for other in graph.vertices)
    ]  # fmt: skip


def grids_of(graph: SceneGraph, names: Sequence[str], image: Image, beliefs: Beliefs) -> list[Grid]:
    """Return the Grids that a box, or some that are flush, may be, with odds against the boxes as they were found,
    whose seams all of the grids have; none where all are too improbable before."""
    cartons, (pose, size) = beliefs.loose.cartons, hull_of(graph, names)
    before, cuts = odds_before(graph, names, cartons, beliefs, image.unit), cuts_of(graph, names)
    if max(before.values(), default=-np.inf) < LEAST_ODDS:
        return []
    _, which = render_depth(graph.solids(), image.camera)
    mask = np.isin(which, [list(graph.solid_names).index(name) for name in names])
    seen = shown(image.depth, image.sigma, image.camera, pose, size, mask)
    widest = cartons.gap / image.unit
    gains = [[seam_gain(seen, axis, size[axis], number, widest) / image.temper if number > 1 else np.zeros(1)
              for number in range(1, cartons.most + 1)] for axis in range(3)]  # fmt: skip
    mean = [[float(np.logaddexp.reduce(gain)) - math.log(len(gain)) for gain in own] for own in gains]
    mean[UP] = [float(np.logaddexp(math.log1p(-cartons.groove), math.log(cartons.groove) + each)) for each in mean[UP]]
    gains[UP] = [np.zeros(1)] * cartons.most  # layers rest on each other
    coarsest = {axis: min(parts[axis] for parts in before) for axis, _ in cuts}
    known = sum(mean[axis][number - 1] for axis, number in coarsest.items())
    found = []
    for parts, odds in before.items():
        odds += sum(mean[axis][number - 1] for axis, number in enumerate(parts)) - known
        own = [gains[axis][number - 1] for axis, number in enumerate(parts)]
        likeliest = widest * GAPS[[gain.argmax() for gain in own]]
        found.append(Grid(parts, odds, likeliest, partial(gaps_drawn, gains=own, widest=widest)))
    return found


def gaps_drawn(rng: np.random.Generator, count: int, gains: Sequence[np.ndarray], widest: float) -> np.ndarray:
    """Return (count, 3) metres of gaps as seams tell them.
    gains : of each axis as `seam_gain` has them; of one gap alone where it is none. widest : metres of the widest."""
    shares = [rng.choice(GAPS[: len(gain)], count, p=np.exp(gain - np.logaddexp.reduce(gain))) for gain in gains]
    between = (GAPS[1] - GAPS[0]) * rng.uniform(-0.5, 0.5, (count, 3)) * [len(gain) > 1 for gain in gains]
    return widest * np.abs(np.column_stack(shares) + between)


def counts_of_grids(cartons: Cartons) -> dict[tuple[int, ...], int]:
    """Return how many cartons each grid has, by their numbers along its axes."""
    every = product(range(1, cartons.most + 1), repeat=3)
    return {parts: math.prod(parts) for parts in every if math.prod(parts) >= FEWEST}


def prior_of_grids(cartons: Cartons) -> float:
    """Return the log odds of a grid against one box, but for a share of one over how many cartons it has."""
    shares = sum(1.0 / count for count in counts_of_grids(cartons).values())
    return math.log(cartons.probability / (1.0 - cartons.probability) / shares)


def cuts_of(graph: SceneGraph, names: Sequence[str]) -> list[tuple[int, float]]:
    """Return (axis of their hull, metres from its low end) of each level seam between boxes that are flush."""
    ends, (_, size) = ends_of(graph, names), hull_of(graph, names)
    ends, found = ends - ends[:, 0].min(axis=0), []
    for own in ends[1:]:
        inner = np.minimum(own, size - own)  # the face that lies deepest within the hull is the seam
        end, axis = np.unravel_index(int(np.argmax(inner[:, :2] / size[:2])), (2, 2))
        found.append((int(axis), float(own[end, axis])))
    return found


def off_a_seam(size: np.ndarray, parts: Sequence[int], cut: tuple[int, float]) -> float:
    """Return the metres from a cut, as `cuts_of` has it, to the nearest place between equal parts of a hull (3,)."""
    axis, at = cut
    part = size[axis] / parts[axis]
    return abs(at - part * min(max(round(at / part), 1), parts[axis] - 1)) if parts[axis] > 1 else math.inf


def odds_before(
    graph: SceneGraph, names: Sequence[str], cartons: Cartons, beliefs: Beliefs, unit: float
) -> dict[tuple[int, ...], float]:
    """Return the log odds of each grid against a box, or some that are flush, before the image is seen.

    Flush boxes are set against each other, and of extents that FLUSH leaves so much room; or they are equal for a
    reason, a grid themselves of so few. Of grids those remain that have their seams.
    """
    _, size = hull_of(graph, names)
    before = prior_odds(size, cartons, beliefs, unit)
    if len(names) == 1:
        return before
    cuts, boxes = cuts_of(graph, names), np.array([graph.body(name).size() for name in names])
    found = sum(one_box(each, cartons, beliefs, unit) for each in boxes)
    found += (len(names) - 1) * (3.0 * math.log(2.0 * FLUSH / unit) + math.log(AGAINST))
    if np.ptp(boxes, axis=0).max() < FLUSH / unit:
        few = prior_of_grids(cartons) - 2.0 * math.log(len(names))
        found = float(np.logaddexp(found, few + one_box(boxes.mean(axis=0), cartons, beliefs, unit)))
    against = found - one_box(size, cartons, beliefs, unit)
    return {parts: odds - against for parts, odds in before.items()
            if all(off_a_seam(size, parts, cut) < FLUSH / unit for cut in cuts)}  # fmt: skip


def one_box(size: np.ndarray, cartons: Cartons, beliefs: Beliefs, unit: float) -> float:
    """Return the log density of a box's extents (3,), which is as likely a carton as anything else."""
    carton = sum(cartons.extent.log_density(float(extent) * unit) + math.log(unit) for extent in size)
    carton += lying(size, cartons)
    return float(np.logaddexp(carton, box_log_density(beliefs.sizes[BOX], size, True)) - math.log(2.0))


def lying(size: np.ndarray, cartons: Cartons) -> float:
    """Return the log odds of how a carton of these extents (3,), the last its height, lies, against any way up."""
    return math.log(3.0 * cartons.flat if size[2] <= size[:2].min() else 1.5 * (1.0 - cartons.flat))


def prior_odds(size: np.ndarray, cartons: Cartons, beliefs: Beliefs, unit: float) -> dict[tuple[int, ...], float]:
    """Return the log odds of each grid, by the numbers of cartons along its axes, against one box of this size (3,)."""
    numbers = range(1, cartons.most + 1)
    # Of a carton's extent where one of the box's is cut into so many equal parts: (3, most).
    density = np.array([[cartons.extent.log_density(float(extent) / n * unit) + np.log(unit) for n in numbers]
                        for extent in size])  # fmt: skip
    one = one_box(size, cartons, beliefs, unit)
    base = prior_of_grids(cartons) - one
    # Twice a share of one over the count: that of the prior, and the Jacobian.
    return {parts: base + sum(float(density[axis, n - 1]) for axis, n in enumerate(parts)) - 2.0 * math.log(count)
            + lying(size / parts, cartons) for parts, count in counts_of_grids(cartons).items()}  # fmt: skip


def divide(
    rng: np.random.Generator, part: StructurePosterior, bodies: Sequence[tuple[Sequence[str], Sequence[Grid]]]
) -> list[StructurePosterior]:
    """Return a structure with its bodies, boxes or some that are flush, as found and as grids that are likely enough.
    bodies : (names, Grids that it may be) of each. Of what all may be together the MOST_KEPT likeliest are told."""
    told: list[tuple[float, tuple]] = [(1.0, ())]
    for names, grids in bodies:
        odds = np.array([0.0, *(grid.odds for grid in grids)])
        each = [
            *zip(np.exp(odds - np.logaddexp.reduce(odds)), [(), *(((names, grid),) for grid in grids)], strict=True)
        ]
        ways = [(float(share * own), way + more) for share, way in told for own, more in each]
        told = sorted(ways, key=lambda way: -way[0])[:MOST_KEPT]
    as_found = sum(share for share, way in told if not way)
    if as_found > 1.0 - SMALLEST_WEIGHT:
        return [part]
    as_found = as_found if as_found >= SMALLEST_WEIGHT else 0.0
    # Which grids are told is a choice among grids: those left out take nothing from the share of the boxes as found.
    kept = [(share, way) for share, way in told if way]
    kept = [each for place, each in enumerate(kept) if place == 0 or each[0] >= SMALLEST_WEIGHT]
    among = (1.0 - as_found) / sum(share for share, _ in kept)
    made = [part.scaled(as_found)] if as_found else []
    for place, (share, way) in enumerate(kept):
        piece = part if place == 0 and share > as_found else part.best_only()
        for names, grid in way:
            piece = as_grid(rng, piece, names, grid)
        made.append(piece.scaled(among * share))
    return made


def as_grid(rng: np.random.Generator, part: StructurePosterior, boxes: Sequence[str], grid: Grid) -> StructurePosterior:
    """Return a structure whose box, or some that are flush, are a grid, its draws those of their hull and of gaps, the
    likeliest in the best."""
    graph = with_cartons(part.graph, part.best()[0], boxes, grid.parts, grid.gap)
    rest = part.only([k for k, address in enumerate(part.addresses) if address.partition(".")[0] not in boxes])
    own_addresses = [address for address in graph.numbers() if address.partition(".")[0] not in part.graph.names]
    shape = part.log_density.shape
    gaps, drawn = grid.drawn(rng, math.prod(shape)).reshape(*shape, 3), np.empty((*shape, len(own_addresses)))
    gaps[part.best_place] = grid.gap
    for place in np.ndindex(shape):
        scene = part.graph_at(*place)
        numbers = with_cartons(scene, scene, boxes, grid.parts, gaps[place]).numbers()
        drawn[place] = [numbers[address] for address in own_addresses]
    return replace(rest, graph=graph, addresses=(*rest.addresses, *own_addresses), periods=(),
                   values=np.concatenate([rest.values, drawn], axis=2))  # fmt: skip


def with_cartons(
    graph: SceneGraph, scene: SceneGraph, boxes: Sequence[str], parts: tuple[int, ...], gap: np.ndarray
) -> SceneGraph:
    """Return a graph with a grid of cartons, lower layers first, in place of boxes whose hull in a scene it fills.

    They are named by their grid: in one of other parts none of them is an object. parts : along the hull's axes.
    gap : (3,) metres.
    """
    (pose, extents), count = hull_of(scene, boxes), np.array(parts)
    size = (extents - (count - 1) * gap) / count
    first, beneath = f"{boxes[0]}_{'x'.join(map(str, parts))}", graph.vertex(boxes[0]).parent
    names = {place: f"{first}_{number + 1}" for number, place in enumerate(np.ndindex(*parts))}
    made, on = vertex_of(first, "box", size, Contact(ON_A_FACE[0])), scene.body(beneath)

    def contact(relative: np.ndarray, parent: Body) -> Contact:
        found, _ = nearest_contact(relative, parent, made.body, ON_A_FACE[0], "+z", "-z")
        return without(found, "gap", *TILTS)

    pose = inverse(scene.poses()[beneath]) @ pose
    on_a_carton = contact(translation(0.0, 0.0, size[UP] + gap[UP]), made.body)  # of all that are not the lowest
    cartons = []
    for place, name in sorted(names.items(), key=lambda item: item[0][UP]):
        if place[UP]:
            below = names[(*place[:UP], place[UP] - 1)]
            cartons.append(replace(made, name=name, contact=on_a_carton, parent=below))
        else:
            there = pose @ translation(*((np.array(place) - 0.5 * (count - 1)) * (size + gap)))
            cartons.append(replace(made, name=name, contact=contact(there, on), parent=beneath))
    for name in boxes:
        graph = graph.remove(name)
    return graph.add(*cartons)
