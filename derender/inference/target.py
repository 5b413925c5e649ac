"""The posterior of a scene of fixed structure given a depth image: what kernels walk on."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from derender.errors import DerenderError
from derender.inference.kernels.base import Part
from derender.inference.space import Block, Space, Unknown, wrap
from derender.model.contacts import contacts
from derender.model.distributions import Distribution
from derender.model.polygon import area_element
from derender.model.pose import inverse, rotation_z, translation
from derender.model.scene import SceneGraph
from derender.model.shapes import shapes

TURNED = np.diag([1.0, -1.0, -1.0, 1.0])  # from a face's frame to that of the face that meets it
MOST_ARCHIVES = 16  # of which the placements are remembered
NEAR = 1e-7  # metres or radians that rounding may leave of a contact's slack


class Images(Protocol):
    """What the target asks of the vision side: a likelihood bound to one observed image. values : its fixed numbers."""

    values: dict[str, float]

    def log_likelihood(self, graph: SceneGraph, parameters: Mapping[str, float]) -> float:
        """Return the log likelihood of a scene; `parameters` are the likelihood's unknowns by name."""


def scene_space(prior: Any, graph: SceneGraph, likelihood: Mapping[str, Distribution] | None = None) -> Space:
    """Return the unknowns of a graph under its prior, in blocks: the root, each edge's contact, each object's shape.

    Parameters
    ----------
    prior : has `free_addresses(graph)`.
    likelihood : priors of the likelihood's unknowns by name.

    Raises
    ------
    DerenderError : there is no unknown.
    """
    free = dict(prior.free_addresses(graph))
    free.update({f"likelihood.{name}": distribution for name, distribution in (likelihood or {}).items()})
    if not free:
        raise DerenderError("nothing is unknown: every number is fixed", remedy="give some number a distribution")
    unknowns = [Unknown(address, law, period_of(graph, address, law)) for address, law in free.items()]
    members: dict[str, list[int]] = {}
    for i, unknown in enumerate(unknowns):
        members.setdefault(block_name(unknown.address), []).append(i)
    space = Space(unknowns, [Block(name, tuple(indices)) for name, indices in members.items()])
    known = {unknown.address for unknown in unknowns}
    space.slides = tuple(name for name in members if _can_slide(graph, name, known))
    space.relocations = tuple(name for name in members if _can_relocate(graph, name, known))
    return space


def block_name(address: str) -> str:
    """Return the block of an address: "red.contact", "red.shape", "root", "likelihood"."""
    name, _, rest = address.partition(".")
    if name in ("root", "likelihood"):
        return name
    return f"{name}.contact" if rest.startswith("contact.") else f"{name}.shape"


def period_of(graph: SceneGraph, address: str, distribution: Distribution) -> float | None:
    """Return the period of an angle whose prior goes all the way round, else None: then it lives on an interval."""
    if distribution.size != 1 or distribution.discrete:
        return None
    name, _, rest = address.partition(".")
    if name == "root":
        period = math.tau if rest in ("azimuth", "roll") else None
    elif rest.startswith("contact."):
        vertex = graph.vertex(name)
        contact = vertex.contact
        parameters = contacts[contact.type].parameters(
            graph.body(vertex.parent).shape, shapes[vertex.shape], contact.parent_face, contact.child_face
        )
        period = next((p.period for p in parameters if p.name == rest.removeprefix("contact.")), None)
    else:
        period = None
    if period is None:
        return None
    low, high = distribution.support
    return period if abs(low) < 1e-9 and abs(high - period) < 1e-9 else None


class SceneTarget:
    """Posterior density over the unknowns of one structure.

    Parameters
    ----------
    prior : the document's prior.
    graph : a scene of the structure, whose other numbers are fixed.
    images : the likelihood bound to the observed image.
    likelihood : priors of the likelihood's unknowns by name.
    """

    def __init__(self, prior, graph: SceneGraph, images: Images, likelihood=None) -> None:
        self.prior, self.template, self.images = prior, graph, images
        self.likelihood = dict(likelihood or {})
        self.space = scene_space(prior, graph, self.likelihood)
        self.root_prior = getattr(prior, "root", None)
        self.constraints = tuple(getattr(prior, "constraints", ()))
        self._index = {address: i for i, address in enumerate(self.space.addresses)}
        self.folds = {
            unknown.address: theta_fold(graph, unknown)
            for unknown in self.space.unknowns
            if unknown.address.endswith(".contact.theta")
        }
        self.bases = {name: base_of(graph, name.removesuffix(".contact"), set(self.space.addresses))
                      for name in self.space.relocations}  # fmt: skip
        self.uncompiled = ""  # what had no compiled form when a backend was asked for
        self._placements: dict[bytes, dict[str, np.ndarray]] = {}
        self._root_free = any(unknown.address.startswith("root.") for unknown in self.space.unknowns)

    def backend(self, parts: list[Part], cycle: bool = False):
        """Return the compiled backend, or the readable one where the model or the mixture has no compiled form."""
        from derender.inference.compiled.backend import CompiledBackend
        from derender.inference.compiled.program import NotCompiled
        from derender.inference.sampler import ReadableBackend

        try:
            return CompiledBackend(self, parts, cycle)
        except NotCompiled as reason:
            self.uncompiled = str(reason)
            return ReadableBackend(self, parts, cycle)

    def derivative(self):
        """Return a new derivative of the log posterior, for one thread.

        Raises DerenderError where the scene has none.
        """
        from derender.inference.derivative import SceneDerivative

        return SceneDerivative(self)

    def by_address(self, values: Sequence[float] | np.ndarray) -> dict[str, float]:
        """Return the values by address."""
        return {address: float(value) for address, value in zip(self.space.addresses, values, strict=True)}

    def root_pose(self, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the (4, 4) pose of the root."""
        if not self._root_free:
            return self.template.root_pose
        coordinates: dict[str, Any] = {}
        for i, unknown in enumerate(self.space.unknowns):
            if unknown.address.startswith("root."):
                start = self.space.offsets[i]
                size = unknown.distribution.size
                value = tuple(float(v) for v in values[start : start + size]) if size > 1 else float(values[start])
                coordinates[unknown.address] = value
        return self.root_prior.pose(coordinates)

    def graph(self, values: Sequence[float] | np.ndarray) -> SceneGraph:
        """Return the scene of some values."""
        numbers = {
            address: value
            for address, value in self.by_address(values).items()
            if address.partition(".")[0] not in ("root", "likelihood")
        }
        graph = self.template.with_numbers(numbers)
        return replace(graph, root_pose=self.root_pose(values)) if self._root_free else graph

    def log_prior(self, values: np.ndarray) -> float:
        """Return the log prior: the unknowns' own, and the prior's constraints where it has any."""
        log_prior = self.space.log_prior(values)
        if self.constraints and log_prior > -math.inf:
            from derender.model.priors.terms import total_log_density

            log_prior += total_log_density(self.constraints, self.graph(values))
        return log_prior

    def log_likelihood(self, values: np.ndarray) -> float:
        """Return the log likelihood of values inside the prior's support."""
        parameters = {
            address.removeprefix("likelihood."): value
            for address, value in self.by_address(values).items()
            if address.startswith("likelihood.")
        }
        return self.images.log_likelihood(self.graph(values), parameters)

    def keep_children(self, values: np.ndarray, moved: np.ndarray, block: Block) -> tuple[np.ndarray, float] | None:
        """Return `moved` with contacts of the block's object's descendants such that all of them stay in the world.

        Also the log of the product of |d phi' / d phi| over them. In metres and radians they move rigidly, which has
        Jacobian 1; (u, v) instead of metres adds the ratio of the touching areas (Figure 2). An angle is folded into
        its period, which turns the child's axes by a symmetry of the child, so that its children get new contacts too.
        None where a child would leave its contact.
        """
        name = block.name.removesuffix(".contact")
        before, after = self.graph(values), self.graph(moved)
        old, new = before.poses(), after.poses()
        turned = {name}
        kept = moved.copy()
        log_jacobian = 0.0
        for child in before.descendants(name):
            vertex = before.vertex(child)
            if vertex.parent not in turned:
                continue
            contact, kind = vertex.contact, contacts[vertex.contact.type]
            on, by = before.body(vertex.parent), vertex.body
            relative = inverse(new[vertex.parent]) @ old[child]
            found = kind.invert(relative, on, by, contact.parent_face, contact.child_face)
            slack = [abs(value - contact.values.get(key, 0.0)) for key, value in found.slack.items()]
            if found.outside > 1e-9 or found.angle > NEAR or max(slack, default=0.0) > NEAR:
                return None
            phi = dict(found.phi)
            centre, period = self.folds[f"{child}.contact.theta"]
            phi["theta"] = fold(phi["theta"], centre, period)
            if abs(fold(found.phi["theta"] - phi["theta"], 0.0, math.tau)) > 1e-6:
                turned.add(child)
                numbers = {**contact.values, **phi}
                pose = kind.relative_pose(numbers, on, by, contact.parent_face, contact.child_face)
                new[child] = new[vertex.parent] @ pose
            for key, value in phi.items():
                kept[self._index[f"{child}.contact.{key}"]] = value
            if "u" in phi:
                outlines = on.face(contact.parent_face).outline, by.face(contact.child_face).outline
                log_jacobian += math.log(area_element(contact.values["u"], contact.values["theta"], *outlines))
                log_jacobian -= math.log(area_element(phi["u"], phi["theta"], *outlines))
        return kept, log_jacobian

    def placed_by(self, block: Block) -> list[int]:
        """Return the unknowns that say where an object stands on a face: theta and the two offsets."""
        offsets = ("theta", "u", "v") if f"{block.name}.u" in self._index else ("theta", "x", "y")
        return [self.space.offsets.tolist().index(self._index[f"{block.name}.{key}"]) for key in offsets]

    def placement_period(self, block: Block) -> float:
        """Return the period of a placement's angle."""
        return self.folds[f"{block.name}.theta"][1]

    def _frames(self, graph: SceneGraph, block: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (4, 4) to the camera: the face below everything, and the turned face that the object stands on."""
        name = block.removesuffix(".contact")
        base, face = self.bases[block]
        vertex, poses = graph.vertex(name), graph.poses()
        below = poses[base] @ graph.body(base).face(face).frame
        return below, poses[name] @ vertex.body.face(vertex.contact.child_face).frame @ TURNED

    def placement(self, values: np.ndarray, block: Block) -> tuple[np.ndarray, float]:
        """Return w = (angle, x, y) of an object on the lowest parallel face below it, and log |dw / d phi|."""
        graph = self.graph(values)
        vertex = graph.vertex(block.name.removesuffix(".contact"))
        numbers, log_area = vertex.contact.values, 0.0
        if f"{block.name}.u" in self._index:
            on, by = graph.body(vertex.parent), vertex.body
            outlines = on.face(vertex.contact.parent_face).outline, by.face(vertex.contact.child_face).outline
            log_area = math.log(area_element(numbers["u"], numbers["theta"], *outlines))
        return self._place(graph, block.name), log_area

    def _place(self, graph: SceneGraph, block: str) -> np.ndarray:
        below, own = self._frames(graph, block)
        relative = inverse(below) @ own
        angle = wrap(math.atan2(relative[1, 0], relative[0, 0]), self.folds[f"{block}.theta"][1])
        return np.array([angle, relative[0, 3], relative[1, 3]])

    def placements(self, block: Block, archive: np.ndarray) -> np.ndarray:
        """Return (K, 3), the placement of an object in each of (K, P) values."""
        content = archive.tobytes()
        if content not in self._placements:
            graphs = [self.graph(values) for values in archive]
            found = {name: np.array([self._place(graph, name) for graph in graphs]) for name in self.bases}
            if len(self._placements) >= MOST_ARCHIVES:
                self._placements.clear()
            self._placements[content] = found
            return found[block.name]
        return self._placements[content][block.name]

    def put(self, values: np.ndarray, block: Block, place: np.ndarray) -> np.ndarray | None:
        """Return the values with an object at another placement, at its height; None where it would lose contact."""
        graph = self.graph(values)
        below, own = self._frames(graph, block.name)
        relative = inverse(below) @ own
        vertex = graph.vertex(block.name.removesuffix(".contact"))
        contact, on, by = vertex.contact, graph.body(vertex.parent), vertex.body
        there = below @ translation(place[1], place[2], relative[2, 3]) @ rotation_z(place[0])
        pose = there @ TURNED @ inverse(by.face(contact.child_face).frame)
        seen = inverse(graph.poses()[vertex.parent]) @ pose
        found = contacts["face-to-face"].invert(seen, on, by, contact.parent_face, contact.child_face)
        if found.outside > 1e-9 or found.angle > NEAR:
            return None
        moved = values.copy()
        for unknown in self.placed_by(block):
            address = self.space.unknowns[unknown].address
            value = found.phi[address.rpartition(".")[2]]
            moved[self._index[address]] = fold(value, *self.folds[address]) if address.endswith("theta") else value
        return moved


def base_of(graph: SceneGraph, name: str, unknown: set[str]) -> tuple[str, str]:
    """Return (vertex, face): the lowest face below an object that stays parallel to the one that it stands on."""
    vertex = graph.vertex(name)
    base, face = vertex.parent, vertex.contact.parent_face
    while True:
        below = graph.vertex(base)
        contact = below.contact
        tilted = any(
            contact.values.get(key, 0.0) != 0.0 or f"{base}.contact.{key}" in unknown for key in ("tilt_x", "tilt_y")
        )
        if contact.type != "face-to-face" or tilted or not _opposite(contact.child_face, face):
            return base, face
        base, face = below.parent, contact.parent_face


def _opposite(face: str, other: str) -> bool:
    return face[1:] == other[1:] and face[0] != other[0]


def fold(angle: float, centre: float, period: float) -> float:
    """Return the angle by whole periods into [centre - period / 2, centre + period / 2)."""
    return wrap(angle - centre + 0.5 * period, period) + centre - 0.5 * period


def theta_fold(graph: SceneGraph, unknown: Unknown) -> tuple[float, float]:
    """Return (centre, period) by which an unknown theta is folded: into its prior's support where it is an interval."""
    name = unknown.address.partition(".")[0]
    vertex = graph.vertex(name)
    faces = vertex.contact.parent_face, vertex.contact.child_face
    kind = contacts[vertex.contact.type]
    parameters = kind.parameters(graph.body(vertex.parent).shape, vertex.body.shape, *faces)
    period = next(p.period for p in parameters if p.name == "theta") or math.tau
    low, high = unknown.distribution.support
    centre = 0.5 * (low + high) if math.isfinite(low) and math.isfinite(high) else 0.5 * period
    return centre, period


def _can_slide(graph: SceneGraph, block: str, unknown: set[str]) -> bool:
    """Return whether the block is the contact of an object whose descendants' free contact numbers are all unknown.

    Without a theta of its own (a disc's is slack) a descendant could not stay as its parent turns.
    """
    if not block.endswith(".contact"):
        return False
    below = graph.descendants(block.removesuffix(".contact"))
    for name in below:
        vertex = graph.vertex(name)
        contact = vertex.contact
        free = contacts[contact.type].free_parameters(
            graph.body(vertex.parent).shape, vertex.body.shape, contact.parent_face, contact.child_face
        )
        names = {p.name for p in free}
        if "theta" not in names or any(f"{name}.contact.{key}" not in unknown for key in names):
            return False
    return bool(below)


def _can_relocate(graph: SceneGraph, block: str, unknown: set[str]) -> bool:
    """Return whether the block is a contact of faces with three numbers, all unknown, that its children can bear."""
    if not block.endswith(".contact"):
        return False
    name = block.removesuffix(".contact")
    vertex = graph.vertex(name)
    if vertex.contact.type != "face-to-face" or vertex.parent == "root":
        return False
    parameters = contacts["face-to-face"].parameters(
        graph.body(vertex.parent).shape, vertex.body.shape, vertex.contact.parent_face, vertex.contact.child_face
    )
    free = {p.name for p in parameters if f"{block}.{p.name}" in unknown}
    placed = free in ({"theta", "u", "v"}, {"theta", "x", "y"})
    level = all(vertex.contact.values.get(key, 0.0) == 0.0 for key in ("tilt_x", "tilt_y"))
    return placed and level and (not graph.descendants(name) or _can_slide(graph, block, unknown))


def default_parts(space: Space) -> list[dict[str, Mapping[str, Any]]]:
    """Return the default mixture as data, as a prior file would write it.

    Local steps do the work; windows and jumps let a chain leave a wrong basin; resimulation is the paper's.
    """
    return [
        {"relocate": {"weight": 0.45}},
        {"drift": {"weight": 0.2}},
        {"slide": {"weight": 0.2}},
        {"drift-all": {"weight": 0.1}},
        {"window": {"weight": 0.02}},
        {"slide-window": {"weight": 0.03}},
        {"independence": {"weight": 0.01}},
        {"choose": {"weight": 0.02}},
        {"jump": {"weight": 0.01}},
        {"flip": {"weight": 0.01}},
        {"resimulate": {"weight": 0.02}},
    ]


__all__ = ["Images", "SceneTarget", "block_name", "default_parts", "period_of", "scene_space"]
