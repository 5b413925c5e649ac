"""The unknowns of a scene of fixed structure in blocks: how their angles fold, which objects can be moved whole."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from derender.errors import DerenderError
from derender.posterior.space import Block, Space, Unknown, wrap
from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph
from derender.scene.shapes import shapes


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
        if contact.type != "face-to-face" or tilted or not _opposite(contact.faces[1], face):
            return base, face
        base, face = below.parent, contact.faces[0]


def bases_of(graph: SceneGraph, relocations: Sequence[str], unknown: set[str]) -> dict[str, tuple[str, str]]:
    """Return the base of each object that may be put down anew, by its name."""
    names = [contact.removesuffix(".contact") for contact in relocations]
    return {name: base_of(graph, name, unknown) for name in names}


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


__all__ = ["bases_of", "block_name", "fold", "period_of", "scene_space", "theta_fold"]
