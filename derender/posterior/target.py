"""The posterior of a scene of fixed structure given a depth image: its unknowns in blocks, what kernels walk on."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from derender.compilation.cache import interpreted
from derender.errors import DerenderError
from derender.posterior.space import Block, Space, Unknown, wrap
from derender.scene import polygon
from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse, rotation_z, translation

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.render.raycast.evaluator import DepthEvaluator
    from derender.scene.priors.tree import TreePrior


def scene_space(prior: Any, graph: SceneGraph, likelihood: Mapping[str, Distribution] | None = None) -> Space:
    """Return the unknowns of a graph under its prior, in blocks: the root, each edge's contact, each object's shape.

    prior : has `free_addresses(graph)`.
    likelihood : priors of the likelihood's unknowns by name.

    Raises DerenderError : there is no unknown.
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
    bases = bases_of(graph, space.relocations, known)
    below = {name: graph.vertex(name).parent for name in bases}
    space.below = {name: parent for name, parent in below.items() if bases.get(parent) == bases[name]}
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
        wanted = rest.removeprefix("contact.")
        period = next((p.period for p in graph.contact_parameters(name) if p.name == wanted), None)
    else:
        period = None
    if period is None:
        return None
    low, high = distribution.support
    return period if abs(low) < 1e-9 and abs(high - period) < 1e-9 else None


def base_of(graph: SceneGraph, name: str, unknown: set[str]) -> tuple[str, str]:
    """Return (vertex, face): the lowest face below an object that stays parallel to the one that it stands on."""
    vertex = graph.vertex(name)
    base, face = vertex.parent, vertex.contact.faces[0]
    while True:
        below = graph.vertex(base)
        contact = below.contact
        tilted = any(
            contact.values.get(key, 0.0) != 0.0 or f"{base}.contact.{key}" in unknown for key in ("tilt_x", "tilt_y")
        )
        opposite = ("-" if face[0] == "+" else "+") + face[1:]
        if contact.type != "face-to-face" or tilted or contact.faces[1] != opposite:
            return base, face
        base, face = below.parent, contact.faces[0]


def bases_of(graph: SceneGraph, relocations: Sequence[str], unknown: set[str]) -> dict[str, tuple[str, str]]:
    """Return the base of each object that may be put down anew, by its name."""
    names = [contact.removesuffix(".contact") for contact in relocations]
    return {name: base_of(graph, name, unknown) for name in names}


def fold(angle: float, centre: float, period: float) -> float:
    """Return the angle by whole periods into [centre - period / 2, centre + period / 2)."""
    return wrap(angle - centre + 0.5 * period, period) + centre - 0.5 * period


def theta_fold(graph: SceneGraph, unknown: Unknown) -> tuple[float, float]:
    """Return (centre, period) by which an unknown theta is folded: into its prior's support where it is an interval."""
    parameters = graph.contact_parameters(unknown.address.partition(".")[0])
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
        names = {p.name for p in graph.contact_parameters(name) if not p.slack}
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
    free = {p.name for p in graph.contact_parameters(name) if f"{block}.{p.name}" in unknown}
    placed = free in ({"theta", "u", "v"}, {"theta", "x", "y"})
    level = all(vertex.contact.values.get(key, 0.0) == 0.0 for key in ("tilt_x", "tilt_y"))
    return placed and level and (not graph.descendants(name) or _can_slide(graph, block, unknown))


area_element = interpreted(polygon.area_element)
TURNED = np.diag([1.0, -1.0, -1.0, 1.0])  # from a face's frame to that of the face that meets it
MOST_ARCHIVES = 16  # of which the placements are remembered
NEAR = 1e-7  # metres or radians that rounding may leave of a contact's slack


class Images(Protocol):
    """What the target asks of `render`: a likelihood bound to one observed image."""

    values: dict[str, float]  # its fixed numbers

    def log_likelihood(self, graph: SceneGraph, parameters: Mapping[str, float]) -> float:
        """Return the log likelihood of a scene; `parameters` are the likelihood's unknowns by name."""


class ObservedImage:
    """One depth image under one likelihood.

    camera : Camera. observed : (H, W) metres, NaN where nothing returned.
    type : registered likelihood. values : its fixed numbers by name.
    """

    def __init__(
        self, camera: "Camera", observed: np.ndarray, type: str = "gaussian", values: Mapping[str, float] | None = None
    ) -> None:
        self.camera, self.observed, self.type = camera, np.ascontiguousarray(observed, np.float64), type
        self.values = dict(values or {})
        self._evaluators = threading.local()

    def evaluator(self) -> "DepthEvaluator":
        """Return a new DepthEvaluator: each chain, which may run in a thread of its own, has one."""
        from derender.render.raycast.evaluator import DepthEvaluator

        return DepthEvaluator(self.camera, self.observed, self.type, self.values)

    def log_likelihood(self, graph: SceneGraph, parameters: Mapping[str, float]) -> float:
        """Return the log likelihood of a scene; `parameters` are the likelihood's unknowns by name."""
        if not hasattr(self._evaluators, "own"):
            self._evaluators.own = self.evaluator()
        return self._evaluators.own.log_likelihood(graph.solids(), parameters)


class SceneTarget:
    """Posterior density over the unknowns of one structure.

    prior : the document's prior.
    graph : a scene of the structure, whose other numbers are fixed.
    images : the likelihood bound to the observed image.
    likelihood : priors of the likelihood's unknowns by name.
    """

    def __init__(
        self, prior: "TreePrior", graph: SceneGraph, images: Images, likelihood: dict[str, Distribution] | None = None
    ) -> None:
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
        self.bases = bases_of(graph, self.space.relocations, set(self.space.addresses))
        self.uncompiled = ""  # what had no compiled form when a backend was asked for, see `backend_of`
        self._placements: dict[bytes, dict[str, np.ndarray]] = {}
        self._root_free = any(unknown.address.startswith("root.") for unknown in self.space.unknowns)

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
        assert self.root_prior is not None, "a root with unknowns has a prior"
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

    def values(self, graph: SceneGraph) -> np.ndarray:
        """Return the (P,) values of a scene of this structure, 0 where a contact leaves one out; undoes `graph`."""
        numbers: dict[str, Any] = {}
        if self._root_free and self.root_prior is not None:
            numbers.update(self.root_prior.numbers(graph.root_pose))
        numbers.update(graph.numbers())
        return np.array([numbers.get(address, 0.0) for address in self.space.addresses])

    def log_prior(self, values: np.ndarray) -> float:
        """Return the log prior: the unknowns' own, and the prior's constraints where it has any."""
        log_prior = self.space.log_prior(values)
        if self.constraints and log_prior > -math.inf:
            from derender.scene.priors.terms import total_log_density

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

        Also the log of the product of |d phi' / d phi| over them; None where a child would leave its contact.
        """
        (name,), before = block.objects, self.graph(values)
        return self._reattached(before, moved, {name: self.graph(moved).poses()[name]}, name)

    def _reattached(
        self, before: SceneGraph, moved: np.ndarray, there: Mapping[str, np.ndarray], settled: str = ""
    ) -> tuple[np.ndarray, float] | None:
        """Return `moved` with contacts such that objects stand `there` (in the camera), all others as `before`.

        settled : one of them whose own contact in `moved` puts it there already.

        Also the log of the product of |d phi' / d phi| at fixed motion in the world. In metres and radians contacts
        move rigidly, which has Jacobian 1; (u, v) instead of metres adds the ratio of the touching areas (Figure 2).
        An angle is folded into its period, which turns the object's axes by a symmetry of it, so that its children get
        new contacts too. None where one would leave its contact.
        """
        poses = {**before.poses(), **there}
        turned = {settled}
        kept = moved.copy()
        log_jacobian = 0.0
        for vertex in before.vertices:
            name = vertex.name
            if name == settled or not (name in there or vertex.parent in turned):
                continue
            contact, kind = vertex.contact, contacts[vertex.contact.type]
            on, by = before.body(vertex.parent), vertex.body
            relative = inverse(poses[vertex.parent]) @ poses[name]
            found = kind.invert(relative, on, by, contact.parent_face, contact.child_face)
            slack = [abs(value - contact.values.get(key, 0.0)) for key, value in found.slack.items()]
            if found.outside > 1e-9 or found.angle > NEAR or max(slack, default=0.0) > NEAR:
                return None
            phi = dict(found.phi)
            phi["theta"] = fold(phi["theta"], *self.folds[f"{name}.contact.theta"])
            if name in there or abs(fold(found.phi["theta"] - phi["theta"], 0.0, math.tau)) > 1e-6:
                turned.add(name)
                numbers = {**contact.values, **phi}
                pose = kind.relative_pose(numbers, on, by, contact.parent_face, contact.child_face)
                poses[name] = poses[vertex.parent] @ pose
            for key, value in phi.items():
                kept[self._index[f"{name}.contact.{key}"]] = value
            if "u" in phi:
                sides = polygon.sides(on.face(contact.faces[0]).outline, by.face(contact.faces[1]).outline)
                log_jacobian += math.log(area_element(contact.values["u"], contact.values["theta"], *sides))
                log_jacobian -= math.log(area_element(phi["u"], phi["theta"], *sides))
        return kept, log_jacobian

    def placement_periods(self, name: str) -> tuple[float, ...]:
        """Return the periods of the numbers of an object's placement, 0 of lengths."""
        return self.folds[f"{name}.contact.theta"][1], 0.0, 0.0

    def _frames(self, graph: SceneGraph, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (4, 4) to the camera: the face below everything, and the turned face that the object stands on."""
        base, face = self.bases[name]
        vertex, poses = graph.vertex(name), graph.poses()
        below = poses[base] @ graph.body(base).face(face).frame
        return below, poses[name] @ vertex.body.face(vertex.contact.faces[1]).frame @ TURNED

    def placement(self, values: np.ndarray, name: str) -> np.ndarray:
        """Return w = (angle, x, y) of an object on the lowest parallel face below it."""
        return self._place(self.graph(values), name)

    def _place(self, graph: SceneGraph, name: str) -> np.ndarray:
        below, own = self._frames(graph, name)
        relative = inverse(below) @ own
        angle = wrap(math.atan2(relative[1, 0], relative[0, 0]), self.placement_periods(name)[0])
        return np.array([angle, relative[0, 3], relative[1, 3]])

    def placements(self, name: str, archive: np.ndarray) -> np.ndarray:
        """Return (K, 3), the placement of an object in each of (K, P) values."""
        content = archive.tobytes()
        if content not in self._placements:
            graphs = [self.graph(values) for values in archive]
            found = {one: np.array([self._place(graph, one) for graph in graphs]) for one in self.bases}
            if len(self._placements) >= MOST_ARCHIVES:
                self._placements.clear()
            self._placements[content] = found
            return found[name]
        return self._placements[content][name]

    def put(self, values: np.ndarray, places: Mapping[str, np.ndarray]) -> tuple[np.ndarray, float] | None:
        """Return the values with objects at other placements, at their heights, and all others where they are.

        Also the log of the product of |d phi' / d phi| at fixed w; None where one would lose its contact.
        """
        graph = self.graph(values)
        there = {}
        for name, place in places.items():
            below, own = self._frames(graph, name)
            height = (inverse(below) @ own)[2, 3]
            face = graph.vertex(name).body.face(graph.vertex(name).contact.faces[1])
            put = below @ translation(place[1], place[2], height) @ rotation_z(place[0])
            there[name] = put @ TURNED @ inverse(face.frame)
        return self._reattached(graph, values, there)


def default_parts() -> list[dict[str, Mapping[str, Any]]]:
    """Return the default mixture as data, as a prior file would write it.

    Local steps do the work; what is put down anew, and jumps, leave a wrong basin; resimulation is the paper's.
    """
    return [
        {"relocate": {"weight": 0.3}},
        {"relocate-stack": {"weight": 0.15}},
        {"turn": {"weight": 0.1}},
        {"drift": {"weight": 0.2}},
        {"slide": {"weight": 0.2}},
        {"drift-all": {"weight": 0.1}},
        {"jump": {"weight": 0.01}},
        {"flip": {"weight": 0.01}},
        {"resimulate": {"weight": 0.02}},
    ]
