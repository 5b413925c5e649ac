"""Contacts and shapes as charts of where a solid is and how big: what jumps between different numbers need.

A vertex's free numbers and what its contact and shape leave out (the *rest*) are together nine coordinates of a posed
box: three extents and a pose. The map is one to one where it is used, and its volume element is known:

    extents      box (l, w, h); cylinder: l = 2 r e^a, w = 2 r e^-a, h; one length s: s e_i (e^a, e^b, e^-(a+b)) with
                 the extents e_i at s = 1. In logarithms these maps are linear, with determinants 1, 2, 3:
                 d(l, w, h) = |det| l w h prod(1 / psi_i) d(psi, rest); a size that the prior fixes at c is c e^rest.
    6dof         d(pose) = d(x, y, z) dHaar, the stock measure.
    face to face Rz(theta) R(tilt): with a = |tilt|, the Hopf coordinates of the quaternion, (a / 2, theta / 2,
                 direction of the tilt + theta / 2), give Haar's measure sin(a) da dtheta d(direction) / (8 pi^2);
                 d(pose) = A(u, theta) sin(a) / a / (8 pi^2) d(theta, u, v, gap, tilt_x, tilt_y)
                 with A = `polygon.area_element` (1 where offsets are metres).
    side on face Rz(theta) Ry(tilt) Rx(-roll), Euler angles: A cos(tilt) / (8 pi^2).

The rest is drawn from `draw_rest` with the density `log_rest`: lengths and tilts from a narrow and a wide normal, so
that a contact that nearly holds is found and one that hardly does is not out of reach; what turns a round solid about
itself from the uniform distribution.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.compilation.cache import interpreted
from derender.scene import polygon
from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution
from derender.scene.pose import from_rotation_vector, rotation_angle
from derender.scene.priors.values import QUATERNION, ROTATION
from derender.scene.shapes import Body, Shape, shapes

if TYPE_CHECKING:
    from derender.scene.priors.objects import ShapePrior
    from derender.scene.vertex import Contact

area_element = interpreted(polygon.area_element)
HAAR = math.log(8.0 * math.pi**2)  # of the mass of dw over all rotation vectors w, near each rotation
STEEPEST = math.cos(math.radians(45.0))  # a face leaning more than this does not rest on what is below it
NARROW, WIDE = {"m": 0.002, "rad": 0.01, "": 0.01, "log": 0.05}, {"m": 0.02, "rad": 0.15, "": 0.1, "log": 0.4}
TILTED, LINE = ("face-to-face", "point-on-face"), ("side-on-face",)


class Rest(NamedTuple):
    """The numbers that a vertex lacks of nine. contact : by parameter name; shape : three minus the free sizes."""

    contact: dict[str, float]
    shape: tuple[float, ...]


def free_names(table: Any) -> tuple[str, ...]:
    """Return the names of a contact's numbers that have distributions; a rotation is `quat_wxyz`."""
    return tuple(name for name, value in table.items() if isinstance(value, Distribution))


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


# ---- extents ------------------------------------------------------------------------------------------------------


def _form(shape: Shape) -> tuple[np.ndarray, float]:
    """Return the (3, 3) matrix from logarithms (psi, rest) to log extents, and log |det|."""
    if len(shape.parameters) == 3:
        return np.eye(3), 0.0
    if shape.name == "cylinder":
        return np.array([[1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), math.log(2.0)
    return np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0], [1.0, -1.0, -1.0]]), math.log(3.0)


def scales_with_extents(shape: Shape) -> bool:
    """Return whether a shape's parameters are lengths that scale extents as `_form` says."""
    return shape.name in ("box", "cylinder") or len(shape.parameters) == 1


def _unit_size(shape: Shape, options: Any) -> np.ndarray:
    """Return the (3,) extents of the solid whose parameters are all one."""
    return np.asarray(shape.size(np.ones(len(shape.parameters)), options), dtype=float)


def extents_of(entry: "ShapePrior", psi: np.ndarray, rest: tuple[float, ...]) -> np.ndarray:
    """Return the (3,) extents. psi: (P,) in the shape's order; rest: for fixed sizes, then for what is missing."""
    shape = shapes[entry.type]
    fixed = fixed_sizes(entry)
    logs = np.log(psi)
    logs[fixed] += rest[: len(fixed)]
    matrix, _ = _form(shape)
    return _unit_size(shape, entry.options) * np.exp(matrix @ np.concatenate([logs, rest[len(fixed) :]]))


def extents_into(entry: Any, extents: np.ndarray) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return (psi (P,), rest): the inverse of `extents_of`."""
    shape = shapes[entry.type]
    matrix, _ = _form(shape)
    numbers = np.linalg.solve(matrix, np.log(extents / _unit_size(shape, entry.options)))
    logs, missing = numbers[: len(shape.parameters)], numbers[len(shape.parameters) :]
    psi, deviations = np.exp(logs), []
    for place in fixed_sizes(entry):
        constant = entry._table[place][1]
        deviations.append(float(logs[place]) - math.log(constant))
        psi[place] = constant
    return psi, (*deviations, *map(float, missing))


def fixed_sizes(entry: "ShapePrior") -> list[int]:
    """Return the places of the sizes that the prior fixes."""
    return [place for place, (_, value) in enumerate(entry._table) if isinstance(value, float)]


def log_extents_element(entry: "ShapePrior", psi: np.ndarray) -> float:
    """Return log d(l, w, h) / d(free psi, rest), but for the product l w h that every shape shares."""
    _, log_determinant = _form(shapes[entry.type])
    free = [place for place in range(len(psi)) if place not in fixed_sizes(entry)]
    return log_determinant - float(np.sum(np.log(psi[free])))


# ---- poses --------------------------------------------------------------------------------------------------------


def log_pose_element(kind: str, numbers: dict[str, float], parent: Body, child: Body, faces: Any) -> float:
    """Return log d(pose) / d(all numbers of a contact), the pose's measure being Lebesgue times Haar of mass one."""
    if kind == "6dof":
        return 0.0
    total = -HAAR
    if kind in TILTED:
        a = math.hypot(numbers["tilt_x"], numbers["tilt_y"])
        total += math.log(math.sin(a) / a) if a > 1e-9 else 0.0
    else:
        total += math.log(max(math.cos(numbers["tilt"]), 1e-300))
    on, by = parent.face(faces[0]), child.face(faces[1])
    if on.outline.bounded and by.outline.bounded:
        area = area_element(numbers["u"], numbers["theta"], *polygon.sides(on.outline, by.outline))
        total += math.log(area) if area > 0.0 else -math.inf
    return total


def all_numbers(contact: "Contact", parent: Shape, child: Shape) -> dict[str, float]:
    """Return every number of a contact by name, defaults filled in."""
    parameters = contacts[contact.type].parameters(parent, child, contact.parent_face, contact.child_face)
    return {p.name: float(contact.values.get(p.name, p.default or 0.0)) for p in parameters}


def chartable(kind: str, table: Any) -> bool:
    """Return whether jumps know the chart: edges and corners they leave alone, and a rotation that the prior fixes."""
    if kind == "6dof":
        return isinstance(table.get(QUATERNION), Distribution)
    return kind in TILTED or kind in LINE


# ---- the rest -----------------------------------------------------------------------------------------------------


class OwnChart(NamedTuple):
    """What tells which numbers a vertex lacks.

    kind : of its contact. parent, child : shapes. faces : that touch. table : the contact's numbers and distributions
    by name. entry : ShapePrior of the vertex.
    """

    kind: str
    parent: Shape
    child: Shape
    faces: tuple[str | None, str | None]
    table: Mapping[str, Distribution | float]
    entry: "ShapePrior"

    def missing(self) -> list[tuple[str, float, str, float | None]]:
        """Return (name, centre, unit, period where uniform) of the contact numbers that are not free."""
        found = []
        for parameter in contacts[self.kind].parameters(self.parent, self.child, *self.faces):
            value = self.table.get(parameter.name)
            if isinstance(value, Distribution) or (self.kind == "6dof" and parameter.name in ROTATION):
                continue
            centre = float(parameter.default or 0.0) if value is None else float(value)
            period = math.tau if parameter.slack and parameter.name in ("theta", "roll") else None
            found.append((parameter.name, centre, parameter.unit, period))
        return found

    def turns_freely(self) -> bool:
        """Return whether all three angles of a ball are missing: then its rotation is uniform."""
        return self.child.name == "sphere" and {"theta", "tilt_x", "tilt_y"} <= {name for name, *_ in self.missing()}

    def sizes_missing(self) -> int:
        """Return how many of three extents are not free."""
        return 3 - len(self.entry.free())


def draw_rest(rng: np.random.Generator, own: OwnChart) -> Rest:
    """Return the numbers that a vertex with this chart lacks, drawn at random."""
    numbers, ball = {}, own.turns_freely()
    for name, centre, unit, period in own.missing():
        if ball and name.startswith("tilt"):
            continue
        if period is not None:
            low = 0.0 if name == "theta" else -math.pi
            numbers[name] = low + period * rng.random()
        else:
            numbers[name] = centre + draw_two_scales(rng, unit)
    if ball:
        numbers["theta"] = math.tau * rng.random()
        lean, towards = math.acos(1.0 - 2.0 * rng.random()), math.tau * rng.random()
        numbers["tilt_x"], numbers["tilt_y"] = lean * math.cos(towards), lean * math.sin(towards)
    return Rest(numbers, tuple(draw_two_scales(rng, "log") for _ in range(own.sizes_missing())))


def log_rest(rest: Rest, own: OwnChart) -> float:
    """Return the log density of `draw_rest`."""
    missing, ball = own.missing(), own.turns_freely()
    if {name for name, *_ in missing} != set(rest.contact) or len(rest.shape) != own.sizes_missing():
        return -math.inf
    total = sum(log_two_scales(x, "log") for x in rest.shape)
    for name, centre, unit, period in missing:
        if ball and name in ("theta", "tilt_x", "tilt_y"):
            continue
        if period is not None:
            total -= math.log(period)
            continue
        offset = rest.contact[name] - centre
        total += log_two_scales(math.remainder(offset, math.tau) if name == "theta" else offset, unit)
    if ball:
        a = math.hypot(rest.contact["tilt_x"], rest.contact["tilt_y"])
        total += math.log(math.sin(a) / a) - HAAR if 1e-9 < a < math.pi else (-HAAR if a <= 1e-9 else -math.inf)
    return total


def draw_two_scales(rng: np.random.Generator, unit: str) -> float:
    """Return a normal draw about 0, its scale NARROW or WIDE with even odds."""
    scale = NARROW[unit] if rng.random() < 0.5 else WIDE[unit]
    return scale * float(rng.standard_normal())


def log_two_scales(x: float, unit: str) -> float:
    """Return the log density of `draw_two_scales`."""
    parts = [math.exp(-0.5 * (x / s) ** 2) / s for s in (NARROW[unit], WIDE[unit])]
    total = 0.5 * (parts[0] + parts[1]) / math.sqrt(2.0 * math.pi)
    return math.log(total) if total > 0.0 else -math.inf
