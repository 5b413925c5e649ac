"""Free-form things in a posterior: each part of it gets them as objects, with what is not known of their extents."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from derender.detection.leftovers import swaps
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import Observation
from derender.detection.solids.graph import FLOOR_NAME, best_contact, names_of, pose_of, scene_graph, without
from derender.detection.solids.image import CENTRE, SIZE, Image, rotation_of
from derender.detection.solids.state import FLOOR, State, subset
from derender.detection.things import THINNEST, Thing
from derender.results.posterior import NINETY, StructurePosterior
from derender.scene.graph import floating, vertex_of
from derender.scene.polygon import convex_outline
from derender.scene.priors.bare_image import Things
from derender.scene.shapes.mesh import encode_surface
from derender.structures.graph_posterior import MOST_PARTS, NEGLIGIBLE
from derender.structures.weighing import NEAR_ERROR

SLACK = ("gap", "tilt_x", "tilt_y")
MEDIAN = 0.6745  # of the absolute value of a standard normal
LEAST = 0.5  # of an extent that is seen: what noise leaves of it at least


def thing_name(number: int) -> str:
    """Return the name of an Observation's thing of this number."""
    return f"thing_{number + 1}"


def with_things(
    rng: np.random.Generator, parts: list[StructurePosterior], seen: Observation, state: State, believed: Things
) -> list[StructurePosterior]:
    """Return StructurePosteriors with free-form things among their objects.
    seen : Observation. state : State of the solids that the search found. believed : of their extents."""
    if not seen.things:
        return parts
    names = names_of(state)
    made = [Made.of(thing_name(k), thing, seen, believed) for k, thing in enumerate(seen.things)]
    return [_with_all(rng, part, names, made, believed.whole) for part in parts]


def with_rivals(
    rng: np.random.Generator, parts: list[StructurePosterior], seen: Observation, state: State, settings: Settings
) -> list[StructurePosterior]:
    """Return StructurePosteriors in which each thing may be a solid, and each solid on which nothing stands a thing, of
    its name and as a mode alone; the likeliest MOST_PARTS."""
    names = names_of(state)
    believed = settings.believed.loose.things
    for swap in swaps(rng, seen, state, settings):
        if swap.odds < -NEGLIGIBLE:
            continue
        free = isinstance(swap.instead, Thing)
        name = names[swap.place] if free else thing_name(swap.place)
        share, low, high = 1.0 / (1.0 + np.exp(-(swap.odds + NEAR_ERROR * np.array([0.0, -NINETY, NINETY]))))
        both = []
        for part in parts:
            stays = name not in part.graph.names or (part.graph.vertex(name).shape == "thing") == free
            if stays or part.graph.children(name):  # in some structures something stands on it
                both.append(part)
                continue
            left = without_object(part.best_only(), name)
            if isinstance(swap.instead, Thing):
                other = _with_all(rng, left, names, [Made.of(name, swap.instead, seen, believed)], believed.whole)
            else:
                other = with_solid(left, swap.instead, [*names, name])
            for each, ends in ((part, (1.0 - share, 1.0 - high, 1.0 - low)), (other, (share, low, high))):
                scaled = each.scaled(float(ends[0]))
                error = float(np.hypot(scaled.weight_error, part.weight * NEAR_ERROR * share * (1.0 - share)))
                least, most = part.weight_interval or (part.weight, part.weight)
                interval = float(least * ends[1]), float(most * ends[2])
                both.append(replace(scaled, weight_error=error, weight_interval=interval))
        parts = sorted(both, key=lambda part: -part.weight)[:MOST_PARTS]
    return parts


def without_object(part: StructurePosterior, name: str) -> StructurePosterior:
    """Return a StructurePosterior without an object on which nothing stands, and its numbers."""
    kept = [k for k, address in enumerate(part.addresses) if address.partition(".")[0] != name]
    return replace(part.only(kept), graph=part.graph.remove(name))


def with_solid(part: StructurePosterior, state: State, names: list[str]) -> StructurePosterior:
    """Return a StructurePosterior with the last solid of a State, of these names, as it is."""
    own = scene_graph(state, part.graph.root_pose, names).vertex(names[-1])
    if own.parent not in part.graph.names:
        own = scene_graph(subset(state, {len(state) - 1}), part.graph.root_pose, names[-1:]).vertex(names[-1])
    return replace(part, graph=part.graph.add(own))


class Made(NamedTuple):
    """A free-form thing of which all is known that a graph's vertex takes. hidden : (3,) metres, the standard deviation
    of a normal whose absolute value is how much farther than is seen it reaches, if it does."""

    name: str  # its own
    thing: Thing
    surface: str  # see `surface_of`
    size: np.ndarray  # see `surface_of`
    centre: np.ndarray  # see `surface_of`
    hidden: np.ndarray
    noise: float  # metres

    @classmethod
    def of(cls, name: str, thing: Thing, seen: Observation, believed: Things) -> "Made":
        """Return what a Thing of an Observation is made to."""
        guessed = thing.guessed / MEDIAN  # that is the median of all that is behind what is seen
        hidden = np.where(guessed > 0.0, guessed, believed.hidden * thing.row[SIZE:] * np.abs(thing.away))
        surface = surface_of(seen.image, thing.mask, thing.row, seen.surface.jump)
        noise = float(np.median(np.hypot(seen.sigma, believed.silhouette * seen.footprint)))
        return cls(name, thing, *surface, hidden, noise)


def _with_all(
    rng: np.random.Generator, part: StructurePosterior, names: list[str], made: list[Made], whole: float
) -> StructurePosterior:
    """Return a StructurePosterior with things. whole : probability that nothing of an extent is hidden."""
    graph, addresses, values = part.graph, list(part.addresses), [part.values]
    chains, draws, _ = part.values.shape
    for name, thing, surface, size, centre, hidden, noise in made:
        row = thing.row.copy()
        row[CENTRE:SIZE], row[SIZE:] = centre, size
        vertex = vertex_of(name, "thing", size, floating(pose_of(row)))
        vertex = replace(vertex, options={"surface": surface} if surface else {})
        parent = FLOOR_NAME if thing.parent == FLOOR else names[thing.parent]
        if parent not in graph.names:
            parent = FLOOR_NAME
        contact = best_contact(graph.add(vertex), name, parent, row, None, "+z", "-z")
        if contact is not None:
            vertex = replace(vertex, parent=parent, contact=without(contact, *SLACK))
        graph = graph.add(vertex)
        for (key, value), behind, guess in zip(vertex.parameters.items(), hidden, thing.guessed, strict=True):
            more, off = rng.standard_normal((2, chains, draws, 1))
            goes_on = (guess > 0.0) | (rng.random(more.shape) > whole)
            shown = max(value - guess, THINNEST)  # its surface may be shorter than the box that the guess is of
            drawn = np.maximum(shown + behind * np.abs(more) * goes_on + noise * off, LEAST * shown)
            drawn[part.best_place] = value
            addresses.append(f"{name}.{key}")
            values.append(drawn)
    return replace(part, graph=graph, addresses=tuple(addresses), values=np.concatenate(values, axis=2), periods=())


MOST_VERTICES = 700  # of what is seen; a surface of more pixels is sampled
LEAST_FOOT = 0.005  # metres under what is seen that may be hidden
DEEP = 0.002  # metres that a thing is deep behind each point that is seen, at least


def closed_surface(
    image: Image, mask: np.ndarray, row: np.ndarray, jump: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return (vertices (V, 3) in metres, the box's axes; triangles (T, 3)) of a thing, closed; None where too few show.

    What is seen is joined where neighbours have no jump between them; nothing is added before it on any ray.

    mask : (H, W) bool. row : (ROW,) the bounding box, floor frame. jump : (H, W) metres between neighbours, at most.
    """
    near, place, triangles = visible_surface(image, mask, jump)
    turn, centre, half = rotation_of(row), row[CENTRE:SIZE], 0.5 * row[SIZE:]
    origin = (image.origin - centre) @ turn
    direction = direction_at(image, place) @ turn
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = np.where(direction > 0.0, (half - origin) / direction, (-half - origin) / direction)
    far = np.maximum(np.nanmin(np.where(np.abs(direction) > 1e-9, ways, np.inf), axis=1), near + DEEP)
    front = origin + near[:, None] * direction
    back = origin + far[:, None] * direction
    if len(triangles) < 2:
        return None
    count = len(front)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    open_edges = edges[~np.isin(edges @ [count, 1], edges[:, ::-1] @ [count, 1])]  # with a triangle on one side only
    a, b = open_edges.T
    sides = np.concatenate([np.column_stack([b, a, a + count]), np.column_stack([b, a + count, b + count])])
    faces = np.concatenate([triangles, triangles[:, ::-1] + count, sides])
    used, faces = np.unique(faces, return_inverse=True)
    vertices = np.clip(np.vstack([front, back]), -half, half)[used]
    foot, sides = hidden_foot(vertices, -half[2])
    return np.vstack([vertices, foot]), np.vstack([faces.reshape(-1, 3), sides + len(vertices)])


def hidden_foot(vertices: np.ndarray, bottom: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (vertices (V, 3), triangles (T, 3)) of an upright prism from a height `bottom` up to the lowest of the
    vertices, for what stands before a thing may hide its foot; none where it shows."""
    low = float(vertices[:, 2].min())
    corners = convex_outline(np.ascontiguousarray(vertices[:, :2]))
    if low - bottom < LEAST_FOOT or corners is None:
        return np.empty((0, 3)), np.empty((0, 3), int)
    count = len(corners)
    k, after = np.arange(count), np.roll(np.arange(count), -1)
    lower, upper = (np.column_stack([corners, np.full(count, height)]) for height in (bottom, low))
    fan = np.column_stack([np.zeros(count - 2, int), k[1:-1], k[2:]])
    sides = [np.column_stack([k, after, k + count]), np.column_stack([after, after + count, k + count])]
    return np.vstack([lower, upper]), np.concatenate([fan[:, ::-1], fan + count, *sides])


def visible_surface(image: Image, mask: np.ndarray, jump: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (depth (V,), place (V, 2) in rows and columns, triangles (T, 3)) of what is seen of a thing.

    Each pixel, or square of some where there are more than MOST_VERTICES, is a square of its own size. Neighbours
    without a jump share corners, whose depth is the mean of what the squares there say, along their slopes. Triangles
    are wound towards the camera.
    """
    step = max(1, int(np.ceil(np.sqrt(mask.sum() / MOST_VERTICES))))
    height, width = (-(-count // step) for count in mask.shape)

    def squares(values):
        padded = np.pad(values, [(0, n * step - k) for n, k in zip((height, width), values.shape, strict=True)])
        return padded.reshape(height, step, width, step).sum(axis=(1, 3))

    count = squares(mask)
    there = np.pad(count >= 0.5 * step**2, 1)
    many = np.maximum(count, 1)
    depth, limit = (np.pad(squares(np.where(mask, values, 0.0)) / many, 1) for values in (image.depth, step * jump))
    middle = np.moveaxis(np.indices(there.shape), 0, -1) * step - 0.5 * (step + 1)  # rows and columns, padding included
    points = depth[..., None] * direction_at(image, middle)
    slopes, links = np.zeros((2, *there.shape)), []
    for axis in (0, 1):
        after, before = (slice(1, None), slice(None, -1)) if axis == 0 else (np.s_[:, 1:], np.s_[:, :-1])
        apart = np.linalg.norm(points[after] - points[before], axis=-1)
        link = there[after] & there[before] & (apart < np.minimum(limit[after], limit[before]))
        rise, sides = np.where(link, depth[after] - depth[before], 0.0), np.zeros(there.shape)
        for way in (after, before):
            slopes[axis][way] += rise
            sides[way] += link
        slopes[axis] /= np.maximum(sides, 1.0)
        links.append(link)
    # about each corner four squares: above left, above right, below left, below right
    about = (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:])
    pairs = ((0, 1, links[1][:-1]), (2, 3, links[1][1:]), (0, 2, links[0][:, :-1]), (1, 3, links[0][:, 1:]))
    group = np.broadcast_to(np.arange(4)[:, None, None], (4, height + 1, width + 1)).copy()
    for _ in range(3):  # until the squares that are linked around a corner have one number
        for one, other, link in pairs:
            least = np.minimum(group[one], group[other])
            group[one], group[other] = (np.where(link, least, group[k]) for k in (one, other))
    corner = np.arange((height + 1) * (width + 1)).reshape(height + 1, width + 1)
    key = 4 * corner + group
    shown = np.stack([there[part] for part in about])
    ways = ((0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5))
    said = np.stack([depth[part] + down * slopes[0][part] + across * slopes[1][part]
                     for part, (down, across) in zip(about, ways, strict=True)])  # fmt: skip
    used, number = np.unique(key[shown], return_inverse=True)
    found = np.bincount(number, said[shown], len(used)) / np.bincount(number, minlength=len(used))
    place = np.column_stack(np.divmod(used // 4, width + 1)) * step - 0.5
    numbers = np.zeros(key.shape, int)
    numbers[shown] = number
    inner = there[1:-1, 1:-1]
    a, b, c, d = (each[inner] for each in (numbers[3][:-1, :-1], numbers[2][:-1, 1:], numbers[1][1:, :-1],
                                           numbers[0][1:, 1:]))  # fmt: skip
    return found, place, np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])])


def direction_at(image: Image, place: np.ndarray) -> np.ndarray:
    """Return the directions (..., 3) of an Image's rays at places (..., 2) in rows and columns, between pixels too."""
    first = image.direction[0, 0]
    ways = np.stack([image.direction[1, 0] - first, image.direction[0, 1] - first])
    return first + place @ ways


def surface_of(image: Image, mask: np.ndarray, row: np.ndarray, jump: np.ndarray) -> tuple[str, np.ndarray, np.ndarray]:
    """Return (text, size (3,), centre (3,) in the floor frame) of a `closed_surface`; the box itself where too few
    show."""
    made = closed_surface(image, mask, row, jump)
    if made is None or not (np.ptp(made[0], axis=0) > 0).all():
        return "", row[SIZE:].copy(), row[CENTRE:SIZE].copy()
    text, size, centre = encode_surface(*made)
    return text, size, row[CENTRE:SIZE] + rotation_of(row) @ centre
