"""Where detected solids put the objects of a given scene: places at which walks under the scene's own density begin."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.posterior.ascent import cooled
from derender.posterior.compiled.backend import Backend
from derender.posterior.target import SceneTarget
from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution, within
from derender.scene.graph import ROOT, SceneGraph, Vertex, relative_pose
from derender.scene.pose import from_axes, inverse, upright_frame
from derender.scene.priors.objects import ROTATION
from derender.scene.shapes import Body, Shape
from derender.scene.shapes.kinds import ROTATIONS
from derender.scene.solids import BOX

# Of a structure; combinations of solids and objects that are followed for it; and ways to turn a solid, of its 24.
PLACES, BEAM, TURNS = 2, 48, 2
BELOW = 60.0  # nats below the likeliest at which a place is none to begin at: no walk comes back to where it was
# By which a solid's extents are multiplied, one after the other and all again, where that explains the image better.
FACTORS, ROUNDS = (0.5, 0.65, 0.8, 0.9, 0.96, 1.04, 1.1, 1.25, 1.5), 2
AGAIN = 2  # times that places are resized and cooled again: one ended 7,000 nats below where the next two did
SAME = 1e-3  # nats in which two ways to turn a solid differ that make no difference
UNSEEN = 1.0  # metres that an object counts as misplaced which is none of the solids: more than those of any that is
EDGE_ON = 1e-6  # cosine between a plane and a direction from which on it runs along it


def solids_seen(target: SceneTarget, seed: int) -> SceneGraph | None:
    """Return the scene that the search for solids of its objects' shapes finds in a target's image; None: nothing."""
    from derender.detection.search.greedy import SHAPES
    from derender.structures.infer import infer_structure
    from derender.structures.options import Options

    sought = [vertex for vertex in target.template.vertices if is_sought(target, vertex)]
    shapes = sorted({vertex.shape for vertex in sought})
    if not sought or any(shape not in SHAPES for shape in shapes):
        return None
    options = Options(method="map", seed=seed, shapes=shapes, floor=floor_of(target))
    try:
        found = infer_structure(target.images.observed, target.images.camera, options)
    except DerenderError:  # such as an image of few pixels: the other walks begin without
        return None
    if found.meta["interrupted"]:  # of what is inferred nothing is there yet
        raise KeyboardInterrupt
    return found.best_graph()


def is_sought(target: SceneTarget, vertex: Vertex) -> bool:
    """Return whether an object has extent and is not known in all its numbers."""
    own = f"{vertex.name}."
    return vertex.body.size() is not None and any(address.startswith(own) for address in target.space.addresses)


def floor_of(target: SceneTarget) -> np.ndarray | str | None:
    """Return the plane (4,) on which a target's objects stand, "none", or None where it is unknown."""
    planes = [vertex for vertex in target.template.vertices if vertex.shape == "plane"]
    if not planes:
        return "none"
    if any(address.startswith(("root.", f"{planes[0].name}.")) for address in target.space.addresses):
        return None
    pose = target.template.poses()[planes[0].name]
    return np.append(pose[:3, 2], -pose[:3, 2] @ pose[:3, 3])


class Solid(NamedTuple):
    """A solid that was seen."""

    body: Body
    pose: np.ndarray  # (4, 4), to camera

    def resized(self, axis: int, side: float, factor: float) -> "Solid":
        """Return the solid with one of its extents multiplied, the face on the other side of that axis where it is."""
        size = self.body.size()
        assert size is not None
        longer, pose = size.copy(), self.pose.copy()
        longer[axis] *= factor
        pose[:3, 3] += 0.5 * side * (longer[axis] - size[axis]) * pose[:3, axis]
        return Solid(self.body._replace(psi=self.body.shape.psi_from_size(longer, self.body.options)), pose)


class Placed(NamedTuple):
    """Some of a structure's objects, parents first, at solids that were seen."""

    vertices: tuple[Vertex, ...]
    poses: dict[str, np.ndarray]  # (4, 4), object to camera, by name; the root's too
    chosen: tuple[tuple[int, np.ndarray] | None, ...]  # of each the solid's number and turn (3, 3); None: it is drawn
    off: float  # metres by which they are not where those are


class Scene(NamedTuple):
    """A structure, and what its objects are put at."""

    target: SceneTarget
    laws: dict[str, Distribution]  # of its unknowns, by address
    root: np.ndarray  # (4, 4), root to camera
    drawn: SceneGraph  # a draw of its unknowns' own priors

    def begun(self) -> Placed:
        """Return no object placed."""
        return Placed((), {ROOT: self.root}, (), 0.0)

    def with_object(self, placed: Placed, solids: list[Solid], chosen: tuple[int, np.ndarray] | None) -> Placed:
        """Return some placed objects with the next one: at a solid in a turn, or as it is drawn."""
        vertex = self.target.template.vertices[len(placed.vertices)]
        parent = next(
            (each.body for each in placed.vertices if each.name == vertex.parent), self.target.template.body(ROOT)
        )
        pose = placed.poses[vertex.parent]
        if chosen is None:
            made, off = self.drawn.vertex(vertex.name), UNSEEN if is_sought(self.target, vertex) else 0.0
        else:
            made, off = at_solid(self.target, self.laws, vertex, parent, pose, solids[chosen[0]], chosen[1])
        own = pose @ relative_pose(made, parent)
        return Placed((*placed.vertices, made), {**placed.poses, vertex.name: own}, (*placed.chosen, chosen),
                      placed.off + off)  # fmt: skip

    def values(self, placed: Placed) -> np.ndarray:
        """Return the (P,) values of all objects placed."""
        target = self.target
        values = target.values(replace(target.template, root_pose=self.root, vertices=placed.vertices))
        for k, address in enumerate(target.space.addresses):
            if address.startswith("likelihood."):
                values[k] = target.images.values[address.removeprefix("likelihood.")]
        return values

    def height(self, placed: Placed, backend: Backend) -> float:
        """Return the log posterior density of all objects placed."""
        return sum(backend.evaluate(self.values(placed)))


def places_of(rng: np.random.Generator, target: SceneTarget, backend: Backend, seen: SceneGraph) -> np.ndarray:
    """Return (n, P) values of a target, likeliest first, that put its objects where solids were seen; PLACES at most.

    Each object is each solid of its shape in turn, or drawn from the prior, from the floor up; the combinations are
    followed that miss the solids by the least.
    """
    laws = {unknown.address: unknown.distribution for unknown in target.space.unknowns}
    scene = Scene(target, laws, root_of(target, laws, seen), target.graph(target.space.sample(rng)))
    solids = [
        Solid(vertex.body, seen.poses()[vertex.name]) for vertex in seen.vertices if vertex.body.size() is not None
    ]
    beam = [scene.begun()]
    for vertex in target.template.vertices:
        grown = [one for placed in beam for one in grow(scene, placed, vertex, solids)]
        beam = sorted(grown, key=lambda placed: placed.off)[:BEAM]

    places: list[np.ndarray] = []
    former = math.inf
    for found, placed in sorted(
        ((scene.height(placed, backend), placed) for placed in beam), key=lambda each: -each[0]
    ):
        if -math.inf < found < former - SAME and len(places) < PLACES:
            places.append(improved(rng, scene, placed, solids, backend))
            former = found
    heights = np.array([sum(backend.evaluate(values)) for values in places])
    order = [k for k in np.argsort(-heights) if heights[k] > heights.max() - BELOW]
    return np.array([places[k] for k in order]).reshape(len(order), len(target.space.addresses))


def improved(rng: np.random.Generator, scene: Scene, placed: Placed, solids: list[Solid],
             backend: Backend) -> np.ndarray:  # fmt: skip
    """Return the values (P,) of placed objects, resized and cooled in turn: each leads on from where the other ends."""
    values = cooled(rng, scene.target, scene.values(resized(scene, placed, solids, backend)))
    for _ in range(AGAIN):
        graph = scene.target.graph(values)
        scene = scene._replace(root=graph.root_pose, drawn=graph)
        own = [Solid(vertex.body, graph.poses()[vertex.name]) for vertex in graph.vertices]
        chosen = tuple(None if each is None else (number, np.eye(3)) for number, each in enumerate(placed.chosen))
        again = stages_of(scene, [scene.begun()], chosen, own)[-1]
        begin = values, scene.values(resized(scene, again, own, backend))  # to touch may be to overlap, by rounding
        values = cooled(rng, scene.target, max(begin, key=lambda each: sum(backend.evaluate(each))))
    return values


def resized(scene: Scene, placed: Placed, solids: list[Solid], backend: Backend) -> Placed:
    """Return placed objects, the solids at which they are longer or shorter on one side where that is likelier."""
    stages, highest = stages_of(scene, [scene.begun()], placed.chosen, solids), scene.height(placed, backend)
    objects = [(k, chosen[0]) for k, chosen in enumerate(placed.chosen) if chosen is not None]
    for _ in range(ROUNDS):
        before = highest
        for (first, number), axis, side in product(objects, range(3), (-1.0, 1.0)):
            own = solids
            for factor in FACTORS:
                trial = [*own[:number], own[number].resized(axis, side, factor), *own[number + 1 :]]
                again = stages_of(scene, stages[: first + 1], placed.chosen[first:], trial)
                found = scene.height(again[-1], backend)
                if found > highest:
                    stages, highest, solids = again, found, trial
        if highest == before:
            break
    return stages[-1]


def stages_of(scene: Scene, stages: list[Placed], chosen: tuple[tuple[int, np.ndarray] | None, ...],
              solids: list[Solid]) -> list[Placed]:  # fmt: skip
    """Return stages of placing, each with one object more than the one before, with those that follow as `chosen`."""
    stages = list(stages)
    for each in chosen:
        stages.append(scene.with_object(stages[-1], solids, each))
    return stages


def root_of(target: SceneTarget, laws: dict[str, Distribution], seen: SceneGraph) -> np.ndarray:
    """Return the (4, 4) pose of a target's root: its own, or that which puts the floor where it was seen."""
    free = {address: law for address, law in laws.items() if address.startswith("root.")}
    planes = [vertex for vertex in target.template.vertices if vertex.shape == "plane"]
    floors = [vertex for vertex in seen.vertices if vertex.body.size() is None]
    if not free or not planes or not floors or target.root_prior is None:
        return target.template.root_pose
    floor = seen.poses()[floors[0].name]
    if abs(floor[0, 2]) > 1.0 - EDGE_ON:  # the floor's normal is the image's x: no axis of it points to the right
        return target.template.root_pose
    own = inverse(target.template.root_pose) @ target.template.poses()[planes[0].name]
    # The root's axes: its plane's normal is the floor's, x points to the right of the image, and the optical axis
    # meets its origin.
    up = floor[:3, 2]
    pose = upright_frame(up)
    pose[:3, :3] = pose[:3, :3] @ own[:3, :3].T
    above = float(own[:3, 2] @ own[:3, 3])
    pose[2, 3] = (up @ floor[:3, 3] - above) / (up[2] if abs(up[2]) > EDGE_ON else -EDGE_ON)
    values = target.root_prior.values(pose)
    return target.root_prior.pose({a: within(law.support, values[a])[0] if law.size == 1 else values[a]
                                   for a, law in free.items()})  # fmt: skip


def grow(scene: Scene, placed: Placed, vertex: Vertex, solids: list[Solid]) -> Iterator[Placed]:
    """Yield what becomes of some placed objects with one more: as each of the solids, and as it is drawn."""
    yield scene.with_object(placed, solids, None)
    if not is_sought(scene.target, vertex):
        return
    used = {chosen[0] for chosen in placed.chosen if chosen is not None}
    for number, (body, _) in enumerate(solids):
        if number not in used and body.shape.solid_kind == vertex.body.shape.solid_kind:
            made = [scene.with_object(placed, solids, (number, turned)) for turned in turns(body.shape)]
            yield from sorted(made, key=lambda each: each.off)[:TURNS]


def turns(shape: Shape) -> np.ndarray:
    """Return the (K, 3, 3) rotations that carry a solid of a shape into one of the shape, with other extents maybe."""
    return ROTATIONS if shape.solid_kind == BOX else shape.symmetry.rotations


def at_solid(
    target: SceneTarget, laws: dict[str, Distribution], vertex: Vertex, parent: Body, pose: np.ndarray, solid: Solid,
    turned: np.ndarray,
) -> tuple[Vertex, float]:  # fmt: skip
    """Return an object on its parent, nearest to a solid as its prior allows, and the metres by which it is off that.
    parent, pose : the parent's body and its (4, 4) pose. turned : (3, 3) the object's axes in the solid's."""
    extents = solid.body.size()
    assert extents is not None
    size, turn = np.abs(turned).T @ extents, from_axes(turned.T)
    numbers = dict(vertex.parameters)
    wanted = vertex.body.shape.psi_from_size(size, vertex.options)
    for parameter, value in zip(vertex.body.shape.parameters, wanted, strict=True):
        law = laws.get(f"{vertex.name}.{parameter.name}")
        if law is not None:
            numbers[parameter.name] = within(law.support, float(value))[0]
    made = replace(vertex, parameters=numbers)
    off = float(np.linalg.norm(made.body.size() - size))
    contact, reach = vertex.contact, 0.5 * float(np.linalg.norm(size))
    found = contacts[contact.type].invert(inverse(pose) @ solid.pose @ turn, parent, made.body, contact.parent_face,
                                          contact.child_face)  # fmt: skip
    values, rotation = dict(contact.values), f"{vertex.name}.contact.quat_wxyz"
    off += found.outside + reach * found.angle
    for name, value in found.values.items():
        address = f"{vertex.name}.contact.{name}"
        scale = 1.0 if name in ("gap", "x", "y", "z") else reach  # what an angle or a share of a face is in metres
        law = laws.get(address)
        if name in ROTATION and rotation in laws:
            values[name] = value
        elif law is None:
            off += 0.0 if name not in found.slack else scale * abs(value - values.get(name, 0.0))
        elif law.size == 1:
            centre, period = target.folds.get(address, (0.0, math.inf))
            folded = value if math.isinf(period) else centre + (value - centre + period / 2) % period - period / 2
            values[name], beyond = within(law.support, folded)
            off += scale * beyond
    return replace(made, contact=replace(contact, values=values)), off
