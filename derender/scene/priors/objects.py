"""Priors on one object: of a number, p_s(psi) of its shape, p_{s,t}(c) over its contacts and p_c(phi) of each."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.scene.codec.yaml_tree import Node
from derender.scene.contacts import contacts
from derender.scene.distributions import Categorical, Distribution, distributions
from derender.scene.graph import Contact, Vertex
from derender.scene.shapes import shapes
from derender.scene.shapes.base import opposite

Value = float | Distribution

SAME = 1e-9  # a fixed number matches within this, so that a pose may pass through a matrix

SMALLEST, LARGEST = 1e-6, 1e6  # metres: below and above, squares and volumes lose all digits to rounding
NEVER = 1e-9  # a distribution may leave a range with this probability: a side of 10 cm plus or minus 5 mm

ROTATION = ("qw", "qx", "qy", "qz")  # four values of a contact that are one rotation
QUATERNION = "quat_wxyz"  # the key and address of the four together


def log_density(value: Value, x: float) -> float:
    """Return the log density of x: of a fixed number 0 where x is it, else -inf."""
    if type(value) is float:
        return 0.0 if abs(x - value) <= SAME else -math.inf
    return value.log_density(x)  # type: ignore[union-attr]


def draw(value: Value, rng: Any) -> float:
    """Return the number, or a draw where it is a distribution."""
    return value if type(value) is float else value.sample(rng)  # type: ignore[union-attr]


def check_range(value: Value, parameter: Parameter, place: Node | None = None, strict: bool = False) -> None:
    """Refuse a number, or a distribution that reaches, outside the range of a parameter (a periodic one has none).

    A `strict` range does not hold its ends.

    Raises DerenderError : at `place`.
    """
    if parameter.period is not None or parameter.name in ROTATION:
        return
    allowed = f"{parameter.name} lies in {_interval(parameter, strict)}"
    if isinstance(value, float):
        inside = parameter.lower < value < parameter.upper if strict else parameter.lower <= value <= parameter.upper
        if not inside:
            raise fault(place, f"{parameter.name} is {value:g}, out of range", allowed)
        smallest = SMALLEST if parameter.lower >= 0.0 else 0.0  # of a size; an offset may come as near to 0 as it likes
        if parameter.unit == "m" and not (value == 0.0 or smallest <= abs(value) <= LARGEST):
            remedy = f"lengths lie between {SMALLEST:g} and {LARGEST:g} m"
            raise fault(place, f"{parameter.name} is {value:g} m, beyond what can be computed with", remedy)
        return
    low, high = value.support
    slip = 1e-12 * max(1.0, abs(parameter.upper) if math.isfinite(parameter.upper) else 1.0)
    below = value.cdf(parameter.lower) if low < parameter.lower - slip else 0.0
    above = 1.0 - value.cdf(parameter.upper) if high > parameter.upper + slip else 0.0
    if below + above > NEVER:
        what = f"with probability {below + above:.2g} this distribution leaves the range"
        raise fault(place, what, f"{allowed}; cut it, as {{truncated-normal: [mean, sd, lower, upper]}} does")


def _interval(parameter: Parameter, strict: bool) -> str:
    """Return a parameter's range in words: "(0, inf)" where its ends do not belong to it."""
    left = "(" if strict or math.isinf(parameter.lower) else "["
    right = ")" if strict or math.isinf(parameter.upper) else "]"
    return f"{left}{parameter.lower:g}, {parameter.upper:g}{right}"


def default_value(parameter: Parameter) -> Value | None:
    """Return the uniform distribution over a parameter's range or period; None where that is unbounded."""
    lower, upper = parameter.lower, parameter.upper
    if parameter.period is not None:
        lower = lower if math.isfinite(lower) else 0.0
        upper = lower + parameter.period
    return distributions["uniform"](lower, upper) if math.isfinite(lower) and math.isfinite(upper) else None


def fault(place: Node | None, what: str, remedy: str | None = None) -> DerenderError:
    """Return a DerenderError at a place in a file, where there is one."""
    return place.fault(what, remedy) if place is not None else DerenderError(what, remedy=remedy)


@dataclass(frozen=True)
class ShapePrior:
    """A shape type, what is fixed about it, and the distribution of its parameters.

    values : number or distribution by parameter name; one that is left out takes its default, which must exist.
    """

    type: str  # name of a registered shape
    values: Mapping[str, Value] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)  # what is no number: a mesh's file, mass, friction
    weight: float = 1.0  # relative probability among the shapes of an open-universe prior
    _table: tuple[tuple[str, Value], ...] = field(init=False, repr=False, compare=False)
    _identity: tuple = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        table = []
        known = {parameter.name for parameter in shapes[self.type].parameters}
        for name in self.values:
            if name not in known:
                raise fault(None, f"the shape {self.type} has no parameter {name!r}")
        for parameter in shapes[self.type].parameters:
            value = self.values.get(parameter.name, parameter.default)
            if value is None:
                value = default_value(parameter)
            if value is None:
                raise fault(None, f"the {parameter.name} of the {self.type} is missing")
            value = float(value) if isinstance(value, int | float) else value
            check_range(value, parameter, strict=True)
            table.append((parameter.name, value))
        object.__setattr__(self, "_table", tuple(table))
        object.__setattr__(self, "_identity", identity(self.options))

    def sample(self, rng: np.random.Generator) -> dict[str, float]:
        """Return a draw of psi by name."""
        return {name: draw(value, rng) for name, value in self._table}

    def matches(self, vertex: Vertex) -> bool:
        """Say whether a vertex is of this shape type and, for a mesh, of the same mesh."""
        return vertex.shape == self.type and identity(vertex.options) == self._identity

    def log_density(self, vertex: Vertex) -> float:
        """Return log p_s(psi) of a vertex that `matches`."""
        total = 0.0
        parameters = vertex.parameters
        for name, value in self._table:
            if name not in parameters:
                return -math.inf
            total += log_density(value, parameters[name])
        return total

    def free(self) -> dict[str, Distribution]:
        """Return the distributions among the values, by parameter name."""
        return {name: value for name, value in self._table if isinstance(value, Distribution)}


def draw_vertex(
    rng: np.random.Generator,
    name: str,
    prior: ShapePrior,
    contacts: "ContactPrior",
    parent: str,
    shape: str,
    top: str | None,
) -> Vertex:
    """Return a new object, its numbers and its contact drawn.

    contacts : the ContactPrior; shape, top : type and upper face of what it hangs on, see `tree.seat`.
    """
    parameters = prior.sample(rng)
    contact = contacts.sample(rng, shape, prior.type, top)
    return Vertex(name, prior.type, parameters, parent, contact, dict(prior.options))


def identity(options: Mapping[str, Any]) -> tuple:
    """Return what tells two meshes apart; masses and colours do not."""
    return (str(options["file"]), bool(options.get("hull", True))) if "file" in options else ()


TOP = "top"  # the face that looks up while the parent rests on the opposite one
ON = "on"  # any contact by which something rests on the parent's top
RESTING = ("face-to-face", "side-on-face", "point-on-face")  # what `on` leaves open


@dataclass(frozen=True)
class ContactRule:
    """One kind of contact that a prior allows.

    parent_face, child_face : None (all faces are as likely), the name of one, a `Categorical` over names; the parent's
        may be "top".
    values : by parameter name, a number or distribution (``quat_wxyz``: four numbers or uniform-rotation).
    fill : give parameters that `values` leaves out a uniform distribution over their range (True), or their default.
    """

    type: str  # a registered contact type
    weight: float = 1.0  # relative probability among the rules that fit a pair of shapes
    parent_face: Any = None
    child_face: Any = None
    values: Mapping[str, Any] = field(default_factory=dict)
    parents: tuple[str, ...] | None = None  # shape types to which the rule is limited
    children: tuple[str, ...] | None = None  # shape types to which the rule is limited
    fill: bool = True
    places: Mapping[str, Node] = field(default_factory=dict)  # where each value stands in its file

    def choices(self, parent: str, child: str, top: str | None) -> dict[tuple[Any, Any], float]:
        """Return the probability of each (parent face, child face) for two shape types; empty where none fits."""
        limits = ((self.parents, parent), (self.children, child))
        if any(types is not None and kind not in types for types, kind in limits):
            return {}
        weights = {}
        for parent_face, child_face in contacts[self.type].choices(shapes[parent], shapes[child]):
            weight = _face_weight(self.parent_face, parent_face, top) * _face_weight(self.child_face, child_face, None)
            if weight > 0:
                weights[parent_face, child_face] = weight
        total = math.fsum(weights.values())
        return {faces: weight / total for faces, weight in weights.items()}

    def table(
        self, parent: str, child: str, parent_face: str | None, child_face: str | None
    ) -> tuple[tuple[str, Any], ...]:
        """Return (name, number or distribution) of each parameter of this exact contact; ideal slack is left out."""
        rows: list[tuple[str, Any]] = []
        for parameter in contacts[self.type].parameters(shapes[parent], shapes[child], parent_face, child_face):
            place = self.places.get(parameter.name, self.places.get(""))
            if parameter.name in ROTATION:
                if parameter.name == ROTATION[0]:
                    usual = distributions["uniform-rotation"]() if self.fill else (1.0, 0.0, 0.0, 0.0)
                    rows.append((QUATERNION, self.values.get(QUATERNION, usual)))
                continue
            value = self.values.get(parameter.name)
            if value is None:
                if parameter.slack:
                    continue
                value = default_value(parameter) if self.fill else parameter.default
                if value is None:
                    raise fault(place, f"{parameter.name} of the contact is missing", f"add {parameter.name}: ...")
            value = float(value) if isinstance(value, int | float) else value
            check_range(value, parameter, place)
            rows.append((parameter.name, value))
        return tuple(rows)


def _face_weight(wanted: Any, face: Any, top: str | None) -> float:
    """Return the weight of a face under what a rule wants."""
    if wanted is None:
        return 1.0
    if isinstance(wanted, Categorical):
        return wanted.probabilities.get(face, 0.0)
    return 1.0 if face == (top if wanted == TOP else wanted) else 0.0


def top_face(shape: str, contact: str, child_face: Any) -> str | None:
    """Return the face of an object that looks up: opposite to the one on which it rests; None where none is flat.

    What floats under a frame counts as standing upright.
    """
    if contact == "face-to-face":
        return opposite(child_face)
    return "+z" if contact == "6dof" and "+z" in shapes[shape].face_names else None


class ContactPrior:
    """Rules, compiled for each pair of shape types on first use."""

    def __init__(self, rules: tuple[ContactRule, ...]) -> None:
        self.rules = rules
        self._compiled: dict[tuple, tuple[Categorical, dict] | None] = {}

    def choices(self, parent: str, child: str, top: str | None = None) -> tuple[Categorical, dict] | None:
        """Return p_{s,t}(c), and each c's parameter table; c = (type, parent face, child face). None: C is empty."""
        key = (parent, child, top)
        if key not in self._compiled:
            self._compiled[key] = self._compile(parent, child, top)
        return self._compiled[key]

    def _compile(self, parent: str, child: str, top: str | None) -> tuple[Categorical, dict] | None:
        weights: dict[tuple, float] = {}
        tables: dict[tuple, tuple] = {}
        for rule in self.rules:
            for (parent_face, child_face), probability in rule.choices(parent, child, top).items():
                choice = (rule.type, parent_face, child_face)
                if choice in weights:
                    raise fault(rule.places.get(""), f"two rules give the same contact {choice} of {child} on {parent}")
                weights[choice] = rule.weight * probability
                tables[choice] = rule.table(parent, child, parent_face, child_face)
        return (Categorical(weights), tables) if any(weights.values()) else None

    def fixed(self, parent: str, child: str, top: str | None = None) -> bool:
        """Say whether the contact and all its numbers are given."""
        found = self.choices(parent, child, top)
        if found is None or len(found[0].choices) != 1:
            return False
        return not any(isinstance(value, Distribution) for _, value in found[1][found[0].choices[0]])

    def sample(self, rng: np.random.Generator, parent: str, child: str, top: str | None = None) -> Contact:
        """Return a contact drawn for a child of shape type `child` on a parent of shape type `parent`."""
        found = self.choices(parent, child, top)
        if found is None:
            raise fault(None, f"no contact holds a {child} on a {parent}")
        choice = found[0].sample(rng)
        values: dict[str, float] = {}
        for name, value in found[1][choice]:
            if name == QUATERNION:
                values.update(zip(ROTATION, value if type(value) is tuple else value.sample(rng), strict=True))
            else:
                values[name] = draw(value, rng)
        kind, parent_face, child_face = choice
        return Contact(kind, parent_face, child_face, values)

    def log_density(self, contact: Contact, parent: str, child: str, top: str | None = None) -> float:
        """Return log p_{s,t}(c) + log p_c(phi)."""
        found = self.choices(parent, child, top)
        if found is None:
            return -math.inf
        choice = (contact.type, contact.parent_face, contact.child_face)
        total = found[0].log_density(choice)
        if total == -math.inf:
            return total
        values = contact.values
        count = 0
        for name, value in found[1][choice]:
            if name == QUATERNION:
                quat = tuple(values.get(part, math.nan) for part in ROTATION)
                count += 4
                total += _rotation_density(value, quat)
            else:
                count += name in values
                total += log_density(value, values.get(name, 0.0))
        if count != len(values):  # a number beyond the table must be ideal slack
            named = {name for name, _ in found[1][choice]}
            if any(x != 0.0 and name not in named and name not in ROTATION for name, x in values.items()):
                return -math.inf
        return total

    def free(self, contact: Contact, parent: str, child: str, top: str | None = None) -> dict[str, Distribution]:
        """Return the distribution of each free parameter of an exact contact, by name."""
        found = self.choices(parent, child, top)
        if found is None:
            return {}
        table = found[1].get((contact.type, contact.parent_face, contact.child_face), ())
        return {name: value for name, value in table if isinstance(value, Distribution)}


def _rotation_density(value: Any, quat: tuple[float, ...]) -> float:
    if isinstance(value, tuple):  # the two signs of a quaternion are one rotation
        same = abs(math.fsum(a * b for a, b in zip(value, quat, strict=True)))
        return 0.0 if same > 1.0 - SAME_ROTATION else -math.inf
    return value.log_density(quat)


SAME_ROTATION = 1e-12  # 1 - cos of half the angle: 3e-6 rad
