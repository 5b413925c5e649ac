"""Where births come from: the prior, or hypotheses seen in the image, each with the density that it was drawn with."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution, distributions
from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex
from derender.scene.pose import from_quaternion, from_rotation_vector, inverse, quaternion, rotation_angle
from derender.scene.priors.objects import QUATERNION, ROTATION
from derender.scene.shapes import Body, shapes
from derender.structures.jumps.base import PriorProposal, Vocabulary

HAAR = math.log(8.0 * math.pi**2)  # of the mass of dw over all rotation vectors w, near each rotation
MOST_KNOWN = 10_000  # hypotheses on a parent in one place whose components are remembered
FAR = 20.0  # standard deviations from which on a normal is taken for nothing
ON_PRIOR = 0.2  # share of the births that come from the prior all the same: nothing it allows is out of reach


class Hypothesis(NamedTuple):
    """A solid that the image suggests.
    length, angle : standard deviations, metres and radians, of where it really is."""

    kind: str  # of the prior's shapes
    parameters: dict[str, float]  # psi by name
    pose: np.ndarray  # (4, 4) object to camera
    weight: float = 1.0  # relative probability
    length: float = 0.004
    angle: float = 0.05


class Component(NamedTuple):
    """One way in which a hypothesis can hang in the graph, with the centre and the spread of each number."""

    weight: float
    kind: str
    parent: str
    choice: tuple
    centres: dict
    spreads: dict


class HypothesisProposal(PriorProposal):
    """A mixture of the prior's proposal and of normals about hypotheses.

    The components are a function of the graph that lacks the new object: for each hypothesis, each bearer and each
    contact that the prior allows there, the numbers of the nearest such contact (`ContactType.invert`), weighed by
    the prior's probability of that contact times exp(-misfit / length / 5), the misfit being what the ideal contact
    leaves over in metres. A vertex's density is

        share_prior p_prior(v) + (1 - share_prior) sum_k w_k prod_i N(v_i; centre_ki, spread_ki),

    over the components with the vertex's own parent, kind and contact; the normals are cut to the prior's support and
    normalised there, on a period they are cut to half of it on either side; rotations turn by a normal vector.
    """

    def __init__(self, hypotheses: Sequence[Hypothesis], on_prior: float = ON_PRIOR) -> None:
        self.hypotheses = tuple(hypotheses)
        self.on_prior = on_prior
        self._last: tuple = (None, [])
        self._known: dict[tuple, list[Component]] = {}

    def components(self, words: Any, graph: SceneGraph) -> list[Component]:
        """Return the mixture's components, their weights summing to one; empty where no hypothesis hangs anywhere."""
        if self._last[0] is graph:
            return self._last[1]
        found, poses = [], graph.poses()
        for number, hypothesis in enumerate(self.hypotheses):
            for parent in words.bearers(graph):
                if words.kinds(graph, parent).log_density(hypothesis.kind) > -math.inf:
                    found += self._ways(words, graph, number, parent, poses[parent])
        total = math.fsum(component.weight for component in found)
        found = [c._replace(weight=c.weight / total) for c in found if c.weight > 1e-6 * total] if total > 0 else []
        total = math.fsum(component.weight for component in found)
        found = [component._replace(weight=component.weight / total) for component in found]
        self._last = (graph, found)
        return found

    def _ways(
        self, words: Vocabulary, graph: SceneGraph, number: int, parent: str, pose: np.ndarray
    ) -> list[Component]:
        """Return the components of one hypothesis on one parent, remembered until that moves."""
        sizes = () if parent == ROOT else tuple(graph.vertex(parent).parameters.values())
        key = number, parent, *words.seat(graph, parent), pose.tobytes(), sizes
        if key not in self._known:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            hypothesis = self.hypotheses[number]
            shape, options = words.shapes[hypothesis.kind].type, words.shapes[hypothesis.kind].options
            psi = np.array([hypothesis.parameters[p.name] for p in shapes[shape].parameters])
            body, relative = Body(shapes[shape], psi, options), inverse(pose) @ hypothesis.pose
            choices = words.contacts(graph, parent, hypothesis.kind)
            self._known[key] = [
                way._replace(weight=share * way.weight)
                for choice, share in (() if choices is None else choices.probabilities.items())
                for way in _component(words, graph, hypothesis, parent, body, relative, choice)
            ]
        return self._known[key]

    def sample(self, rng: np.random.Generator, words: Vocabulary, graph: SceneGraph) -> Vertex | None:
        """Return a new vertex; None where nothing can grow or a number fell outside its support by rounding."""
        components = self.components(words, graph)
        if not components or rng.random() < self.on_prior:
            return super().sample(rng, words, graph)
        threshold, chosen = rng.random(), components[-1]
        for component in components:
            threshold -= component.weight
            if threshold < 0.0:
                chosen = component
                break
        values = {}
        for name, centre in chosen.centres.items():
            spread = chosen.spreads.get(name)
            if spread is None:
                values[name] = centre
            elif name == QUATERNION:
                values[name] = tuple(quaternion(rotation_near(rng, from_quaternion(centre), spread)))
            else:
                values[name] = spread.draw(rng)
        return vertex_of(words, graph, chosen, values)

    def log_density(self, words: Vocabulary, graph: SceneGraph, vertex: Vertex) -> float:
        """Return the log density of drawing this vertex for a graph that lacks it."""
        components = self.components(words, graph)
        prior = super().log_density(words, graph, vertex)
        if not components:
            return prior
        kind = words.prior.kind_of(vertex)
        choice = (vertex.contact.type, vertex.contact.parent_face, vertex.contact.child_face)
        values = {**vertex.contact.values, **{f"shape.{key}": x for key, x in vertex.parameters.items()}}
        total = self.on_prior * math.exp(prior) if prior > -math.inf else 0.0
        for component in components:
            if (component.kind, component.parent, component.choice) == (kind, vertex.parent, choice):
                total += (1.0 - self.on_prior) * component.weight * math.exp(_log_normal(component, values))
        return math.log(total) if total > 0.0 else -math.inf


def _component(
    words: Any,
    graph: SceneGraph,
    hypothesis: Hypothesis,
    parent: str,
    body: Any,
    relative: np.ndarray,
    choice: tuple[str, ...],
) -> list[Component]:
    """Return the component of one hypothesis in one contact, if that is possible at all."""
    table = words.table(*words.seat(graph, parent), body.shape.name, choice)
    kind = contacts[choice[0]]
    found = kind.invert(relative, graph.body(parent), body, *choice[1:])
    reach = 0.5 * float(np.linalg.norm(body.size()))
    misfit = found.outside + reach * found.angle
    misfit += 0.0 if isinstance(table.get("gap"), Distribution) else abs(found.gap)
    misfit += reach * found.tilt if body.shape.name != "sphere" else 0.0
    if misfit > 0.05:
        return []
    centres: dict[str, Any] = {}
    spreads: dict[str, Any] = {}
    for name, value in words.shapes[hypothesis.kind]._table:
        centres[f"shape.{name}"] = value if isinstance(value, float) else hypothesis.parameters[name]
        if not isinstance(value, float):
            spreads[f"shape.{name}"] = About.of(centres[f"shape.{name}"], hypothesis.length, value.support)
    parameters = {p.name: p for p in kind.parameters(graph.body(parent).shape, body.shape, *choice[1:])}
    for name, value in table.items():
        if name == QUATERNION:
            centres[name] = tuple(found.phi[part] for part in ROTATION) if not isinstance(value, tuple) else value
            if not isinstance(value, tuple):
                spreads[name] = hypothesis.angle
            continue
        centres[name] = value if isinstance(value, float) else found.values[name]
        if not isinstance(value, float):
            period = parameters[name].period
            low, high = value.support
            if period is not None and math.isfinite(low) and abs(high - low - period) < 1e-9:
                centres[name] = low + (centres[name] - low) % period
            elif period is not None:
                centres[name] = low + (centres[name] - low) % math.tau if math.isfinite(low) else centres[name]
                period = None
            width = hypothesis.length if parameters[name].unit == "m" else hypothesis.angle
            width = hypothesis.length / (2.0 * reach) if parameters[name].unit == "" else width
            spreads[name] = About.of(centres[name], width, (low, high), period)
    weight = hypothesis.weight * math.exp(-misfit / (5.0 * hypothesis.length))
    return [Component(weight, hypothesis.kind, parent, choice, centres, spreads)]


def vertex_of(words: Vocabulary, graph: SceneGraph, component: Component, values: dict[str, float]) -> Vertex:
    """Return a new object of a component with these numbers by name, those of its shape after `shape.`."""
    entry = words.shapes[component.kind]
    parameters = {name: values[f"shape.{name}"] for name, _ in entry._table}
    numbers = {key: x for key, x in values.items() if not key.startswith("shape.")}
    if QUATERNION in numbers:
        numbers.update(zip(ROTATION, map(float, numbers.pop(QUATERNION)), strict=True))
    contact = Contact(*component.choice, numbers)  # type: ignore[call-arg]
    name = words.fresh_name(graph.names, component.kind)
    return Vertex(name, entry.type, parameters, component.parent, contact, dict(entry.options))


class About(NamedTuple):
    """Where a number is drawn that a hypothesis suggests."""

    law: Distribution  # a normal about it, cut to the support, on a circle to half a turn on either side
    support: tuple[float, float]
    period: float | None  # of an angle, or None

    @classmethod
    def of(cls, centre: float, width: float, support: tuple[float, float], period: float | None = None) -> "About":
        """Return it for a centre and a standard deviation; even over the support where the centre is FAR outside."""
        low, high = support if period is None else (centre - 0.5 * period, centre + 0.5 * period)
        low, high = max(low, centre - FAR * width), min(high, centre + FAR * width)
        near = distributions["truncated-normal"](centre, width, low, high) if low < high else None
        return cls(distributions["uniform"](*support) if near is None else near, support, period)

    def draw(self, rng: np.random.Generator) -> float:
        """Return a number drawn."""
        x, low = self.law.sample(rng), self.support[0]
        return float(x if self.period is None else low + (x - low) % self.period)

    def log_density(self, x: float) -> float:
        """Return the log density of a number."""
        if not self.support[0] <= x <= self.support[1]:
            return -math.inf
        if self.period is not None:
            x -= self.period * round((x - self.law.parameters[0]) / self.period)
        return self.law.log_density(x)


def _log_normal(component: Component, values: dict[str, float]) -> float:
    """Return the log density of a vertex's numbers under one component."""
    total = 0.0
    for name, spread in component.spreads.items():
        if name == QUATERNION:
            turned = from_quaternion([values[part] for part in ROTATION])
            total += rotation_density(turned, from_quaternion(component.centres[name]), spread)
        else:
            total += spread.log_density(values[name])
    return total


def rotation_near(rng: np.random.Generator, centre: np.ndarray, angle: float) -> np.ndarray:
    """Return a (4, 4) rotation drawn about another: a rotation vector of three normals, shorter than pi."""
    while True:
        vector = angle * rng.standard_normal(3)
        if vector @ vector < math.pi**2:
            return centre @ from_rotation_vector(vector)


def rotation_density(turned: np.ndarray, centre: np.ndarray, angle: float) -> float:
    """Return the log density of `rotation_near` with respect to Haar's measure of mass one.

    dHaar = 2 (1 - cos a) / a^2 dw / (8 pi^2), a = |w|; the normal is cut at a = pi, where chi's cdf with three degrees
    of freedom has the normaliser.
    """
    a = rotation_angle(centre, turned)
    reach = math.pi / angle
    mass = math.erf(reach / math.sqrt(2.0)) - math.sqrt(2.0 / math.pi) * reach * math.exp(-0.5 * reach * reach)
    normal = -0.5 * (a / angle) ** 2 - 3.0 * math.log(angle * math.sqrt(2.0 * math.pi)) - math.log(mass)
    element = 2.0 * (1.0 - math.cos(a)) / (a * a) if a > 1e-4 else 1.0 - a * a / 12.0
    return normal + HAAR - math.log(element)
