"""The posterior of a scene of fixed structure given a depth image: its unknowns in blocks, what kernels walk on."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.posterior.space import Block, Space, Unknown
from derender.render.likelihoods import likelihoods
from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph
from derender.scene.priors.tree import TreePrior
from derender.scene.shapes.base import EXTENTS, opposite
from derender.scene.shapes.kinds import FACE_NAMES

OF_IMAGE = "likelihood of the image"  # block of those of its numbers whose change reads the image anew


def scene_space(
    prior: Any, graph: SceneGraph, likelihood: Mapping[str, Distribution] | None = None, apart: Sequence[str] = ()
) -> Space:
    """Return the unknowns of a graph under its prior, in blocks: the root, each edge's contact, each object's shape.

    prior : has `free_addresses(graph)`.
    likelihood : priors of the likelihood's unknowns by name. apart : names of those that are a block of their own.

    Raises DerenderError : there is no unknown.
    """
    free = dict(prior.free_addresses(graph))
    free.update({f"likelihood.{name}": distribution for name, distribution in (likelihood or {}).items()})
    if not free:
        raise DerenderError("nothing is unknown: every number is fixed", remedy="give some number a distribution")
    unknowns = [Unknown(address, law, period_of(graph, address, law)) for address, law in free.items()]
    members: dict[str, list[int]] = {}
    for i, unknown in enumerate(unknowns):
        own = unknown.address.removeprefix("likelihood.") in apart
        members.setdefault(OF_IMAGE if own else block_name(unknown.address), []).append(i)
    space = Space(unknowns, [Block(name, tuple(indices)) for name, indices in members.items()])
    known = {unknown.address for unknown in unknowns}
    space.slides = tuple(name for name in members if _can_slide(graph, name, known))
    space.relocations = tuple(name for name in members if _can_relocate(graph, name, known))
    space.spans = {vertex.name: spans_of(vertex.contact.child_face) for vertex in graph.vertices
                   if vertex.body.shape.name == "box" and vertex.contact.child_face in FACE_NAMES}  # fmt: skip
    return space


def spans_of(face: str) -> tuple[str, str]:
    """Return the parameters of a box that are its extents along one of its faces."""
    along = "xyz".index(face[1])
    return EXTENTS[(along + 1) % 3], EXTENTS[(along + 2) % 3]


def block_name(address: str) -> str:
    """Return the block of an address: "red.contact", "red.shape", "root", "likelihood"."""
    name, _, rest = address.partition(".")
    if name in ("root", "likelihood"):
        return name
    return f"{name}.contact" if rest.startswith("contact.") else f"{name}.shape"


def period_of(graph: SceneGraph, address: str, distribution: Distribution) -> float | None:
    """Return the period of an angle whose prior goes all the way round, else None: then it lives on an interval."""
    period = math.tau if address in ("root.azimuth", "root.roll") else graph.period(address)
    if period is None or distribution.size != 1 or distribution.discrete:
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
        if contact.type != "face-to-face" or tilted or contact.faces[1] != opposite(face):
            return base, face
        base, face = below.parent, contact.faces[0]


def bases_of(graph: SceneGraph, relocations: Sequence[str], unknown: set[str]) -> dict[str, tuple[str, str]]:
    """Return the base of each object that may be put down anew, by its name."""
    names = [contact.removesuffix(".contact") for contact in relocations]
    return {name: base_of(graph, name, unknown) for name in names}


def theta_fold(graph: SceneGraph, unknown: Unknown) -> tuple[float, float]:
    """Return (centre, period) by which an unknown theta is folded: into its prior's support where it is an interval."""
    period = graph.period(unknown.address) or math.tau
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


class ObservedImage:
    """One depth image under one likelihood.

    camera : Camera. observed : (H, W) metres, NaN where nothing returned.
    type : registered likelihood. values : its fixed numbers by name.
    """

    def __init__(
        self, camera: Camera, observed: np.ndarray, type: str = "gaussian", values: Mapping[str, float] | None = None
    ) -> None:
        self.camera, self.observed, self.type = camera, np.ascontiguousarray(observed, np.float64), type
        self.values = dict(values or {})
        self._evaluators = threading.local()

    def evaluator(self) -> DepthEvaluator:
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
        self,
        prior: TreePrior,
        graph: SceneGraph,
        images: ObservedImage,
        likelihood: dict[str, Distribution] | None = None,
    ) -> None:
        self.prior, self.template, self.images = prior, graph, images
        self.likelihood = dict(likelihood or {})
        apart = likelihoods[images.type].of_image if self.likelihood else ()
        self.space = scene_space(prior, graph, self.likelihood, apart)
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
        self._root_free = any(unknown.address.startswith("root.") for unknown in self.space.unknowns)

    @property
    def sizes_open(self) -> bool:
        """Whether extents are unknown: populations of particles miss such a scene more often than not."""
        return any(address.partition(".")[0] not in ("root", "likelihood") and ".contact." not in address
                   for address in self.space.addresses)  # fmt: skip

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

    def of_likelihood(self, values: np.ndarray) -> dict[str, float]:
        """Return the likelihood's unknowns by name."""
        told = self.by_address(values)
        return {a.removeprefix("likelihood."): x for a, x in told.items() if a.startswith("likelihood.")}

    def log_likelihood(self, values: np.ndarray) -> float:
        """Return the log likelihood of values inside the prior's support."""
        return self.images.log_likelihood(self.graph(values), self.of_likelihood(values))


def default_parts() -> list[dict[str, Mapping[str, Any]]]:
    """Return the default mixture as data, as a prior file would write it.

    Local steps do the work; what is put down anew, and flips, leave a wrong basin; resimulation is the paper's.
    """
    return [
        {"relocate": {"weight": 0.55}},
        {"drift": {"weight": 0.2}},
        {"slide": {"weight": 0.2}},
        {"drift-all": {"weight": 0.1}},
        {"flip": {"weight": 0.02}},
        {"resimulate": {"weight": 0.02}},
    ]
