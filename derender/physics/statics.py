"""Whether a scene can be at rest, decided without simulation: is there a set of contact forces that holds it?

Rigid bodies stay at rest if forces within the friction cones of their contacts can balance their weights, and move if
none can. The decision is exact for rigid bodies up to the tolerances of `contact_points` and `balance`; it cannot tell
a scene that settles from one that falls, which is what the simulation is for.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from derender.physics.balance import BALANCED, MOST_MARGIN, equilibrium, greatest, least_push
from derender.physics.bodies import Body, Matter, clamped_masses, pair_frictions
from derender.scene.contact_points import across, all_contacts
from derender.scene.solids import KINDS

# Bodies without a contact in the graph touch where they are no further apart than this share of the smallest extent.
NEAR = 2e-3
# Contacts of the graph are open by no more than this share of the smallest extent, or metres (as in the simulation).
WIDEST_GAP, WIDEST_GAP_METRES = 0.2, 0.01
# Corners within this share of the smallest extent (metres at most: what inferred faces are off flush) bear on a face.
FLUSH, FLUSH_METRES = 0.1, 0.005
# Resistance to rolling, in units of the smallest extent: the half width of the patch on which a ball rests.
ROLLING = 0.01


class Contacts(NamedTuple):
    """Points at which bodies touch."""

    first: np.ndarray  # (P,) int64, indices of bodies
    second: np.ndarray
    point: np.ndarray  # (P, 3) float64, in the frame of the scene
    normal: np.ndarray  # (P, 3), unit, from the second body to the first
    gap: np.ndarray  # (P,) metres by which the two are apart; negative: overlap


class ContactForce(NamedTuple):
    """What one body bears of another."""

    body: str  # names; `by` pushes `body`
    by: str
    point: tuple[float, float, float]  # metres, the centre of pressure, in the frame of the scene
    force: tuple[float, float, float]  # newtons


def widest_gap(unit: float) -> float:
    """Return the metres by which a contact of the graph may be open; unit : the smallest extent, metres."""
    return max(WIDEST_GAP * unit, WIDEST_GAP_METRES)


class Entered(NamedTuple):
    """A pair of solids that enter each other."""

    first: str  # names
    second: str
    depth: float  # metres


def deep_overlaps(matter: Matter, contacts: Contacts) -> list[Entered]:
    """Return which pairs of solids enter each other by more than the slack of a contact: no rigid bodies can be so.

    Of a mesh only its hull, or those of its parts, are known: a cup in a bowl enters that. Such pairs are left out.
    """
    found: dict[tuple[str, str], Entered] = {}
    if contacts.gap.min(initial=0.0) >= -WIDEST_GAP_METRES:  # no slack is less
        return []
    for k in np.flatnonzero(contacts.gap < -widest_gap(matter.unit)):
        first, second = matter.bodies[contacts.first[k]], matter.bodies[contacts.second[k]]
        if "mesh" not in (first.kind, second.kind):
            found[first.name, second.name] = Entered(first.name, second.name, -float(contacts.gap[k]))
    return list(found.values())


def find_contacts(matter: Matter, near: float | None = None) -> Contacts:
    """Return where the bodies of a scene touch; pairs that the graph joins touch across gaps of millimetres too.

    near : metres of gap up to which the others touch; None: NEAR of the smallest extent.
    """
    pieces = [(owner, piece) for owner, body in enumerate(matter.bodies) for piece in body.pieces()]
    owner, bodies = np.array([owner for owner, _ in pieces], dtype=np.int64), [piece for _, piece in pieces]
    count = len(bodies)
    kind = np.array([KINDS[body.kind] for body in bodies], dtype=np.int64)
    pose = np.array([body.pose for body in bodies], dtype=float).reshape(count, 4, 4)
    size = np.array([body.size for body in bodies], dtype=float).reshape(count, 3)
    held = np.array([not body.moves for body in bodies], dtype=bool)
    for index, body in enumerate(bodies):
        if body.kind == "plane" and not plane_is_below(matter, body):
            pose[index, :3, 1:3] *= -1.0
    vertices, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    vertex_start, normal_start = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    for index, body in enumerate(bodies):
        points = faces = 0
        if body.vertices is not None:
            rotation, place = pose[index, :3, :3], pose[index, :3, 3]
            vertices.append(body.vertices @ rotation.T + place)
            normals.append(_face_normals(body.vertices.tobytes()) @ rotation.T)
            points, faces = len(vertices[-1]), len(normals[-1])
        vertex_start[index + 1], normal_start[index + 1] = vertex_start[index] + points, normal_start[index] + faces
    number = {body.name: index for index, body in enumerate(matter.bodies)}
    joined = np.zeros((len(number), len(number)), dtype=bool)
    for child, parent in matter.supports:
        joined[number[child], number[parent]] = joined[number[parent], number[child]] = True
    length = matter.unit
    flush = np.array([NEAR * length, min(FLUSH * length, FLUSH_METRES)])
    nearest = NEAR * length if near is None else near
    return Contacts(*all_contacts(
        kind, pose, size, np.concatenate(vertices), vertex_start, np.concatenate(normals), normal_start, owner, held,
        joined, nearest, widest_gap(length), flush, ROLLING * length,
    ))  # fmt: skip


class Equilibrium:
    """The forces of a scene's contacts, ready to be balanced.

    residual : (B, 6) what cannot be balanced of each moving body's force and moment, in units of its weight (and its
        weight times its size).
    entered : the pairs of solids that enter each other so deep that no rigid bodies can be so.
    stands : whether there are none of either.
    """

    def __init__(self, matter: Matter) -> None:
        self.matter, self.contacts = matter, find_contacts(matter)
        bodies = matter.bodies
        self.moving = [index for index, body in enumerate(bodies) if body.moves]
        place = np.full(len(bodies), -1, dtype=np.int64)
        place[self.moving] = np.arange(len(self.moving))
        centre = np.array([body.centre_of_mass() for body in bodies], dtype=float).reshape(-1, 3)
        extent = np.array([body.size for body in bodies]).reshape(-1, 3).max(axis=1, initial=1e-12)
        self.weight = clamped_masses(bodies)[self.moving] * matter.strength
        first, second, point, normal, _ = self.contacts
        rough = np.array([np.nan if body.friction is None else body.friction for body in bodies], dtype=float)
        self.parts = (
            place[first], place[second],
            (point - centre[first]) / extent[first, None], (point - centre[second]) / extent[second, None],
            normal, pair_frictions(rough[first], rough[second]), self.weight,
        )  # fmt: skip
        self.down = -matter.up
        self.load = np.zeros((len(self.moving), 6))
        self.load[:, :3] = -self.down
        self.residual, _ = equilibrium(self.parts, self.load)
        self.entered = deep_overlaps(matter, self.contacts)
        self.stands = not self.entered and greatest(self.residual) <= BALANCED

    def unbalanced(self) -> dict[str, float]:
        """Return by name what share of a body's weight nothing holds, greatest first; inf of what enters another."""
        missing = np.linalg.norm(self.residual, axis=1)
        names = [self.matter.bodies[k].name for k in self.moving]
        entered = {name for pair in self.entered for name in (pair.first, pair.second)}
        missing = np.where([name in entered for name in names], np.inf, missing)
        order = [k for k in np.argsort(-missing, kind="stable") if missing[k] > BALANCED]
        return {names[k]: float(missing[k]) for k in order}

    def margin(self) -> tuple[float, tuple[float, float, float] | None]:
        """Return the least horizontal acceleration that something cannot bear, in g, and its direction (3,)."""
        if not self.stands:
            return 0.0, None
        if not self.moving or not np.any(self.down):
            return MOST_MARGIN, None
        axes = np.array(across(self.down))
        least, way = MOST_MARGIN, axes[0]
        for island in self._islands():
            parts, load = self._parts_of(island), self.load[island]
            found, to = least_push(parts, load, equilibrium(parts, load)[1], axes, least)
            least, way = (found, to) if found < least else (least, way)
        return float(least), _triple(-way)

    def _islands(self) -> list[np.ndarray]:
        """Return the groups of moving bodies (their places in `weight`) that touch each other: they bear by themselves,
        and all together cost as many times more as the square of their number."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        pairs = np.stack(self.parts[:2])
        pairs = pairs[:, (pairs >= 0).all(axis=0)]
        count = len(self.weight)
        touch = coo_array((np.ones(pairs.shape[1]), pairs), (count, count))
        number, group = connected_components(touch, directed=False)
        return [np.flatnonzero(group == island) for island in range(number)]

    def _parts_of(self, island: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return `parts` of some bodies alone."""
        place = np.full(len(self.weight) + 1, -1)  # the last, which -1 means, does not move
        place[island] = np.arange(len(island))
        first, second = (place[part] for part in self.parts[:2])
        mine = (first >= 0) | (second >= 0)
        return first[mine], second[mine], *(part[mine] for part in self.parts[2:6]), self.weight[island]

    def forces(self) -> list[ContactForce]:
        """Return forces that hold the scene, one for each pair that touches; [] where nothing does.

        Where several sets of forces do, stiff bodies alone do not say which is there; one of few forces is returned.
        """
        if not self.stands:
            return []
        number, points, rays, _, values, *_ = equilibrium(self.parts, self.load)[1]
        total: dict[tuple[int, int], list[np.ndarray]] = {}
        for k in range(number[0]):
            p, force = points[k], rays[k] * values[k]
            pair = int(self.contacts.first[p]), int(self.contacts.second[p])
            total.setdefault(pair, []).append(np.concatenate([force, self.contacts.point[p] * np.linalg.norm(force)]))
        bodies = self.matter.bodies
        found = []
        for (a, b), each in sorted(total.items()):
            parts = np.array(each)
            point = parts[:, 3:].sum(axis=0) / np.linalg.norm(parts[:, :3], axis=1).sum()
            force = parts[:, :3].sum(axis=0)
            upper, lower = (a, b) if bodies[a].moves else (b, a)
            if not bodies[a].moves:
                force = -force
            found.append(ContactForce(bodies[upper].name, bodies[lower].name, _triple(point), _triple(force)))
        return found


def plane_is_below(matter: Matter, plane: Body) -> bool:
    """Return whether what rests on a plane (all bodies, where nothing says so) lies on the side that its +z shows."""
    children = {child for child, parent in matter.supports if parent == plane.name}
    others = [body for body in matter.bodies if body.kind != "plane"]
    seen = [body for body in others if body.name in children] or others
    above = sum(float(body.pose[:3, 3] @ plane.pose[:3, 2]) for body in seen)
    return above >= len(seen) * float(plane.pose[:3, 3] @ plane.pose[:3, 2])


@lru_cache(maxsize=256)
def _face_normals(points: bytes) -> np.ndarray:
    """Return the unit normals (F, 3) of the hull of vertices given as bytes, those of coplanar triangles once."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(np.frombuffer(points).reshape(-1, 3))
    return np.unique(np.round(hull.equations[:, :3], 6), axis=0)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
