"""To the flat arrays of `prior.py`: from a scene's target Model and Chain, from a mixture of kernels its Kernels."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import address_of
from derender.posterior.compiled.evaluate import (
    BLURRING,
    ELSEWHERE,
    FIXED_ROOT,
    FREE_ROOT,
    LOOKED_AT,
    put_down,
    reattach,
    stand_all,
)
from derender.posterior.compiled.prior import (
    CONTACT,
    FOLD_PERIOD,
    HELD,
    INVERSE_AT,
    LIKELIHOOD,
    POSE_AT,
    ROOT,
    ROTATION,
    SHAPE,
    SHAPES,
    Chain,
    Kernels,
    Model,
    density_and_draw,
)
from derender.posterior.kernels import kernels
from derender.posterior.kernels.base import PLACING, Part, Tuning
from derender.posterior.kernels.relocate import fitted
from derender.posterior.space import Space
from derender.posterior.target import SceneTarget
from derender.render.likelihoods import likelihoods
from derender.render.raycast.state import SIGMA
from derender.scene.contacts import contacts
from derender.scene.contacts.compiled import FEATURE_CODES, FRAME, SLOTS, invert, relative_pose
from derender.scene.graph import SceneGraph, Vertex
from derender.scene.priors.terms import sum_of_terms, table_of
from derender.scene.priors.tree import FreeRoot, LookedAtRoot
from derender.scene.shapes import shapes
from derender.scene.shapes.base import box_feature
from derender.scene.solids import MESH

MOST_NUMBERS = 3  # of a shape that may be unknown: there is room for so many
PROBE = np.array([0.31, 0.57, 0.83])  # numbers at which a shape's extents are checked to be affine


class NotCompiled(Exception):
    """Something in the model has no compiled form: Python has to take the steps."""


Address = Callable[..., int]  # from a kernel and arguments of the types that it will get to the number that calls it


def model_of(target: SceneTarget) -> Model:
    """Return the model's arrays of a SceneTarget. Raises NotCompiled, saying of what there is no compiled form."""
    graph, space = target.template, target.space
    try:
        terms = table_of(target.constraints, graph, graph.names)
    except NotImplementedError as error:
        raise NotCompiled(f"the constraint {error}") from None
    for unknown in space.unknowns:
        if unknown.distribution.size == 1 and not unknown.distribution.compiled:
            raise NotCompiled(f"the distribution of {unknown.address}")
    unknowns, laws = laws_of(space, target.folds, address_of)
    vertices, extents = vertices_of(graph, root_code(target))
    names = {name: n for n, name in enumerate(graph.names)}
    owners = [i for i, unknown in enumerate(space.unknowns) for _ in range(unknown.distribution.size)]
    places = [(*place_of(target, names, a), owner) for a, owner in zip(space.addresses, owners, strict=True)]
    terms_at = address_of(sum_of_terms, terms, vertices[0], np.eye(4)[None], np.ones((1, 3))) if len(terms) else 0
    return Model(
        unknowns=unknowns,
        laws=laws,
        places=np.ascontiguousarray(np.array(places, np.int64).T),
        vertices=vertices,
        extents=extents,
        terms=terms,
        terms_at=terms_at,
    )


def vertices_of(graph: SceneGraph, root: int = FIXED_ROOT) -> tuple[np.ndarray, np.ndarray]:
    """Return Model.vertices and Model.extents of a graph. root : how the root's numbers give its pose."""
    count, index, size, frame = len(graph.vertices), np.int64(0), np.zeros(3), np.eye(4)
    names = {name: n for n, name in enumerate(graph.names)}
    solids = {name: n for n, name in enumerate(graph.solid_names)}
    vertices, extents = np.zeros((8, count + 1), np.int64), np.zeros((count, 4, 3))
    for n, vertex in enumerate(graph.vertices):
        contact = vertex.contact
        code = contacts[contact.type].compiled_code
        if code is None:
            raise NotCompiled(f"the contact type {contact.type}")
        faces = FEATURE_CODES[contact.parent_face], FEATURE_CODES[contact.child_face]
        kind, solid = shapes[vertex.shape].solid_kind, solids.get(vertex.name, -1)
        vertices[:6, n] = names.get(vertex.parent, count), code, FRAME if kind is None else kind, *faces, solid
        check_faces(graph, vertex)
        extents[n] = extents_of(vertex)
    vertices[:6, count] = count, root, FRAME, -1, -1, -1
    arguments = index, index, size, index, size, index, index
    vertices[POSE_AT] = address_of(relative_pose, *arguments, np.zeros(SLOTS), frame)
    vertices[INVERSE_AT] = address_of(invert, *arguments, frame, np.zeros(SLOTS))
    return vertices, extents


def numbers_of(graph: SceneGraph) -> np.ndarray:
    """Return (N + 1, 13) the numbers of a graph's contacts and shapes as Chain.numbers has them, extents and root 0."""
    numbers = np.zeros((len(graph.vertices) + 1, SHAPES + 3))
    for n, vertex in enumerate(graph.vertices):
        phi = [vertex.contact.values.get(p.name, p.default or 0.0) for p in graph.contact_parameters(vertex.name)]
        psi = np.nan_to_num(vertex.psi[:MOST_NUMBERS])  # an unknown one may be missing from the template
        numbers[n, : len(phi)] = phi
        numbers[n, SHAPES : SHAPES + len(psi)] = psi
    return numbers


def laws_of(space: Space, folds: Mapping[str, tuple[float, float]], address: Address) -> tuple[np.ndarray, np.ndarray]:
    """Return Model.unknowns and Model.laws of a space. folds : centre and period of each theta, by its address."""
    codes, laws, calls = [], list[tuple[float, ...]](), list[tuple[int, int]]()
    for unknown in space.unknowns:
        law = unknown.distribution
        if law.size == 4:
            codes.append(ROTATION)
            laws.append((0.0,) * 7)
            calls.append((0, 0))
        else:
            codes.append(0)
            laws.append((*law.row, unknown.period or 0.0, *folds.get(unknown.address, (0.0, 0.0))))
            density, draw = density_and_draw(type(law))  # type: ignore[arg-type]  # a class is hashable
            row = np.zeros(len(laws[-1]))
            calls.append((address(density, 0.0, row), address(draw, np.random.default_rng(), row)))
    unknowns = [[*codes, 0], space.offsets, space.directions, *zip(*calls, (0, 0), strict=True)]
    return np.array(unknowns, np.int64), np.array(laws, float).reshape(-1, 7)


def extents_of(vertex: Vertex) -> np.ndarray:
    """Return (4, 3): the extents at numbers 0, and what each of the first three numbers adds to them for each metre."""
    shape, others = shapes[vertex.shape], vertex.psi[MOST_NUMBERS:]
    if not shape.bounded and shape.drawn(vertex.psi, vertex.options)[0] != shape.solid_kind:
        raise NotCompiled(f"a {vertex.shape} that ends")
    count = min(len(shape.parameters), MOST_NUMBERS)

    def size(psi) -> np.ndarray:
        found = shape.size(np.array([*psi, *others], float), vertex.options)
        return np.zeros(3) if found is None else np.asarray(found, float)

    extents = np.zeros((4, 3))
    ones = np.ones(count)
    for j in range(count):
        extents[j + 1] = size(ones + np.eye(count)[j]) - size(ones)
    extents[0] = size(ones) - extents[1:].sum(axis=0)
    probe = PROBE[:count]
    if not np.allclose(size(probe), extents[0] + probe @ extents[1 : count + 1], rtol=1e-12, atol=1e-15):
        raise NotCompiled(f"the shape {vertex.shape}, whose extents are no affine function of its numbers")
    return extents


def check_faces(graph: SceneGraph, vertex: Vertex) -> None:
    """Raise NotCompiled where a contact takes hold of a mesh by a face that is not that of its box."""
    contact, meeting = vertex.contact, (graph.body(vertex.parent), vertex.body)
    bounded = all(body.shape.bounded for body in meeting)
    for body, name in zip(meeting, (contact.parent_face, contact.child_face), strict=True):
        if body.shape.solid_kind != MESH or name is None:
            continue
        psi = np.nan_to_num(body.psi, nan=1.0)
        own, box = body.shape.face(name, psi, body.options), box_feature(name, body.shape.size(psi, body.options))
        if not np.allclose(own.frame, box.frame) or (bounded and not np.allclose(own.outline, box.outline)):
            raise NotCompiled(f"the face {name} of a {body.shape.name}, which is not that of its box")


def root_code(target: SceneTarget) -> int:
    """Return how the root's numbers give its pose."""
    if not any(unknown.address.startswith("root.") for unknown in target.space.unknowns):
        return FIXED_ROOT
    if isinstance(target.root_prior, FreeRoot):
        return FREE_ROOT
    if isinstance(target.root_prior, LookedAtRoot):
        return LOOKED_AT
    raise NotCompiled("this kind of root")


HELD_NUMBERS = ("near", "far")  # of a likelihood, which have to fit together: `Likelihood.check`
ROOT_SLOTS = {FREE_ROOT: ("x", "y", "z", "qw", "qx", "qy", "qz"), LOOKED_AT: LookedAtRoot.KEYS, FIXED_ROOT: ()}


def place_of(target: Any, names: dict[str, int], address: str) -> tuple[int, int, int]:
    """Return (table, vertex, slot) of a value."""
    name, _, rest = address.partition(".")
    if name == "likelihood":
        places = {name: SIGMA + place for name, place in likelihoods[target.images.type].places.items()}
        slot = {"blur": BLURRING, **places}.get(rest)
        return (HELD, 0, 0) if slot is None or rest in HELD_NUMBERS else (LIKELIHOOD, 0, slot)
    if name == "root":
        return ROOT, 0, ROOT_SLOTS[root_code(target)].index(rest)
    vertex = target.template.vertex(name)
    if rest.startswith("contact."):
        slots = [parameter.name for parameter in target.template.contact_parameters(name)]
        return CONTACT, names[name], slots.index(rest.removeprefix("contact."))
    shape = shapes[vertex.shape]
    slot = [parameter.name for parameter in shape.parameters].index(rest)
    if rest in shape.form_parameters or slot >= MOST_NUMBERS:
        raise NotCompiled(f"the unknown {rest} of a {shape.name}, which changes more than its extents")
    return SHAPE, names[name], slot


def held(target: SceneTarget) -> dict[str, int]:
    """Return which likelihood numbers compiled steps cannot change, and where their values are."""
    names = dict.fromkeys(target.template.names, 0)
    return {
        address.removeprefix("likelihood."): offset
        for offset, address in enumerate(target.space.addresses)
        if place_of(target, names, address)[0] == HELD
    }


def chain_of(target: Any) -> Chain:
    """Return the arrays of a chain that stands at the template, not loaded yet."""
    graph = target.template
    count, solids = len(graph.vertices), len(graph.solid_names)
    size, directions = len(target.space.addresses), int(target.space.directions[-1])
    numbers = np.tile(numbers_of(graph), (2, 1, 1))
    if root_code(target) != FIXED_ROOT:
        coordinates = target.root_prior.numbers(graph.root_pose)
        for slot, key in enumerate(ROOT_SLOTS[root_code(target)]):
            numbers[:, count, slot] = coordinates[f"root.{key}"]
    pose = np.tile(np.eye(4), (2, count + 1, 1, 1))
    pose[:, count] = graph.root_pose
    return Chain(
        values=np.full((2, size + 2), -np.inf),
        numbers=numbers,
        pose=pose,
        marks=np.zeros((3, count + 1), np.int64),
        moved_pose=np.tile(np.eye(4), (solids, 1, 1)),
        moved_size=np.zeros((solids, 3)),
        tangents=np.zeros((2, max(directions, 3))),
        relative=np.eye(4),
        flags=np.zeros(1, np.int64),
    )


# Of each kernel that puts objects down, by its number: Kernels.members, and the mixture over places that were seen.
Places = Mapping[int, tuple[Sequence[int], np.ndarray]]


class Calls(NamedTuple):
    """What one kernel calls, by addresses in this process; 0: nothing."""

    propose: int = 0
    place: int = 0
    keep: int = 0
    vertex: int = -1  # whose children it keeps, or -1


def kernels_of(space: Space, parts: list[Part], tuning: Tuning, elsewhere: frozenset[int], places: Places,
               calls: Sequence[Calls]) -> Kernels:  # fmt: skip
    """Return the mixture's arrays.

    elsewhere : numbers of the kernels whose steps the sweep leaves to its caller. places : see `places_seen`.
    """
    table, members, factors = [], [], []
    first = factor_first = 0
    for k, (part, call) in enumerate(zip(parts, calls, strict=True)):
        kind = kernels[part.type]
        told, factor = places[k] if k in places else (kind.members(space, part.block), kind.factor(space, part, tuning))
        form = ELSEWHERE if k in elsewhere else kind.form
        table.append((form, first, factor_first, call.vertex, call.propose, call.keep, call.place))
        members += told
        factors.append(np.ravel(factor))
        first += len(told)
        factor_first += factor.size
    return Kernels(
        table=np.ascontiguousarray(np.array([*table, (0, first, factor_first, -1, 0, 0, 0)], np.int64).T),
        reach=np.array([kernels[part.type].reach(space, part) for part in parts]),
        members=np.array(members, np.int64),
        factors=np.concatenate(factors),
    )


def calls_of(target: SceneTarget, parts: list[Part], model: Model, chain: Chain) -> list[Calls]:
    """Compile what a mixture's steps call and return where it lies."""
    rng, index, flat, members = np.random.default_rng(), np.int64(0), np.zeros(1), np.zeros(1, np.int64)
    calls = []
    for part in parts:
        kind, place, keep, vertex = kernels[part.type], 0, 0, -1
        if kind.form == PLACING:
            propose = address_of(kind.proposal, rng, flat, flat, flat, flat)
            place = address_of(put_down, rng, model.vertices, model.laws, chain.numbers, chain.pose, chain.relative,
                               chain.moved_pose[0], members, flat, index)  # fmt: skip
        else:
            propose = address_of(kind.proposal, rng, model.unknowns, model.laws, chain.values, chain.tangents, members,
                                 flat, 0.0)  # fmt: skip
        if kind.keeps_children:
            vertex = target.template.names.index(part.block.object)
            keep = address_of(reattach, model.vertices, model.extents, model.places, model.laws, chain.values,
                              chain.numbers, chain.pose, chain.marks, chain.relative, index, True,
                              chain.moved_pose[0])  # fmt: skip
        calls.append(Calls(propose, place, keep, vertex))
    return calls


def object_below(target: SceneTarget, name: str) -> tuple[int, int, int, int]:
    """Return of a relocated object its vertex, the vertex and face that it is put on, and the unknown that turns it."""
    names, addresses = target.template.names, [unknown.address for unknown in target.space.unknowns]
    base, face = target.bases[name]
    return names.index(name), names.index(base), FEATURE_CODES[face], addresses.index(f"{name}.contact.theta")


def places_seen(target: SceneTarget, parts: list[Part], model: Model, chain: Chain, archive: np.ndarray) -> Places:
    """Return the Places of the kernels that put objects down, from (K, P) values.

    chain : any of the model's; it is left at the last values.
    """
    chosen = {k: object_below(target, part.block.object) for k, part in enumerate(parts)
              if kernels[part.type].form == PLACING}  # fmt: skip
    if not chosen:
        return {}
    places = np.empty((len(chosen), len(archive), 3))
    stand_all(model, chain, np.ascontiguousarray(archive, float), np.array(list(chosen.values())).T.copy(), places)
    return {k: (told, fitted(seen, (float(model.laws[told[3], FOLD_PERIOD]), 0.0, 0.0)))
            for (k, told), seen in zip(chosen.items(), places, strict=True)}  # fmt: skip


def taken_elsewhere(target: SceneTarget, parts: list[Part]) -> frozenset[int]:
    """Return the numbers of the kernels that move a number which compiled steps cannot change."""
    kept = set(held(target).values())
    moved = [{target.space.offsets[i] for i in part.block.unknowns} for part in parts]
    return frozenset(k for k in range(len(parts)) if moved[k] & kept)
