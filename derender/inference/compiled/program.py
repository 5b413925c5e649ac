"""From a scene's target, a mixture and its tuning to the flat arrays of `layout.py`."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from derender.inference.compiled import poses, steps
from derender.inference.compiled.contacts import touch_anew
from derender.inference.compiled.layout import (
    CONTACT,
    HELD,
    INVERSE_AT,
    LIKELIHOOD,
    POSE_AT,
    ROOT,
    ROTATION,
    SCALE,
    SHAPE,
    SHAPES,
    Chain,
    Kernels,
    Model,
)
from derender.inference.compiled.relocate import relocate, turn
from derender.inference.compiled.standing import stand_all
from derender.inference.compiled.terms import table_of
from derender.inference.kernels import kernels
from derender.inference.kernels.base import Part, Tuning
from derender.inference.kernels.drift import directions_of, factor_of
from derender.inference.kernels.flip import flips_of
from derender.inference.kernels.relocate import mixture_of
from derender.inference.kernels.slide import marginal_factor
from derender.kernel_call import address_of
from derender.model.contacts import contacts
from derender.model.contacts.compiled import FEATURE_CODES, FRAME, SLOTS, invert, relative_pose
from derender.model.distributions.compiled import compiled
from derender.model.priors.root import FreeRoot, LookedAtRoot
from derender.model.scene import SceneGraph
from derender.model.shapes import shapes

PROBE = np.array([0.31, 0.57, 0.83])  # numbers at which a shape's extents are checked to be affine


class NotCompiled(Exception):
    """Something in the model has no compiled form: the readable kernels have to run."""


def model_of(target, address=address_of) -> Model:
    """Return the model's arrays of a SceneTarget. Raises NotCompiled, saying of what there is no compiled form.

    address : compiles a kernel for some arguments and returns where it lies.
    """
    graph, space = target.template, target.space
    try:
        terms = table_of(target.constraints, graph)
    except NotImplementedError as error:
        raise NotCompiled(f"the constraint {error}") from None
    codes, laws, twins = [], [], list[tuple[int, int]]()
    for unknown in space.unknowns:
        law = unknown.distribution
        if law.size == 4:
            codes.append(ROTATION)
            laws.append((0.0,) * 7)
            twins.append((0, 0))
        elif law.code is None:
            raise NotCompiled(f"the distribution of {unknown.address}")
        else:
            codes.append(law.code)
            laws.append((*law.row, unknown.period or 0.0, *target.folds.get(unknown.address, (0.0, 0.0))))
            density, draw = compiled(law.type)
            row = np.zeros(len(laws[-1]))
            twins.append((address(density, 0.0, row), address(draw, np.random.default_rng(), row)))
    count, index, size, frame = len(graph.vertices), np.int64(0), np.zeros(3), np.eye(4)
    names = {name: n for n, name in enumerate(graph.names)}
    solids = {name: n for n, name in enumerate(graph.solid_names)}
    vertices = np.zeros((8, count + 1), np.int64)
    extents = np.zeros((count, 4, 3))
    for n, vertex in enumerate(graph.vertices):
        contact = vertex.contact
        code = contacts[contact.type].compiled_code
        if code is None:
            raise NotCompiled(f"the contact type {contact.type}")
        faces = FEATURE_CODES[contact.parent_face], FEATURE_CODES[contact.child_face]
        solid = solids.get(vertex.name, -1)
        vertices[:6, n] = names.get(vertex.parent, count), code, _kind(vertex.shape), *faces, solid
        extents[n] = extents_of(vertex)
    vertices[:6, count] = count, root_code(target), FRAME, -1, -1, -1
    arguments = index, index, size, index, size, index, index
    vertices[POSE_AT] = address(relative_pose, *arguments, np.zeros(SLOTS), frame)
    vertices[INVERSE_AT] = address(invert, *arguments, frame, np.zeros(SLOTS))
    owners = [i for i, unknown in enumerate(space.unknowns) for _ in range(unknown.distribution.size)]
    places = [(*place_of(target, names, a), owner) for a, owner in zip(space.addresses, owners, strict=True)]
    return Model(
        unknowns=np.array([[*codes, 0], space.offsets, space.directions, *zip(*twins, (0, 0), strict=True)], np.int64),
        laws=np.array(laws, float).reshape(-1, 7),
        places=np.ascontiguousarray(np.array(places, np.int64).T),
        vertices=vertices,
        extents=extents,
        terms=terms,
    )


def _kind(shape: str) -> int:
    kind = shapes[shape].solid_kind
    return FRAME if kind is None else int(kind)


def extents_of(vertex) -> np.ndarray:
    """Return (4, 3): the extents at numbers 0, and what each of up to three numbers adds to them for each metre."""
    shape = shapes[vertex.shape]
    count = len(shape.parameters)
    if count > 3:
        raise NotCompiled(f"the shape {vertex.shape}, which has more than three numbers")

    def size(psi) -> np.ndarray:
        found = shape.size(np.asarray(psi, float), vertex.options)
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


def root_code(target) -> int:
    """Return how the root's numbers give its pose."""
    if not any(unknown.address.startswith("root.") for unknown in target.space.unknowns):
        return poses.FIXED_ROOT
    if isinstance(target.root_prior, FreeRoot):
        return poses.FREE_ROOT
    if isinstance(target.root_prior, LookedAtRoot):
        return poses.LOOKED_AT
    raise NotCompiled("this kind of root")


ROOT_SLOTS = {
    poses.FREE_ROOT: ("x", "y", "z", "qw", "qx", "qy", "qz"),
    poses.LOOKED_AT: LookedAtRoot.KEYS,
    poses.FIXED_ROOT: (),
}


def place_of(target, names: dict[str, int], address: str) -> tuple[int, int, int]:
    """Return (table, vertex, slot) of a value."""
    name, _, rest = address.partition(".")
    if name == "likelihood":
        return (LIKELIHOOD if rest == "sigma" and target.images.type == "gaussian" else HELD), 0, 0
    if name == "root":
        return ROOT, 0, ROOT_SLOTS[root_code(target)].index(rest)
    vertex = target.template.vertex(name)
    if rest.startswith("contact."):
        return CONTACT, names[name], contact_slots(target.template, name).index(rest.removeprefix("contact."))
    return SHAPE, names[name], [p.name for p in shapes[vertex.shape].parameters].index(rest)


def contact_slots(graph: SceneGraph, name: str) -> list[str]:
    """Return the names of a contact's numbers in their compiled order."""
    vertex = graph.vertex(name)
    faces = vertex.contact.parent_face, vertex.contact.child_face
    parent = graph.body(vertex.parent).shape
    return [p.name for p in contacts[vertex.contact.type].parameters(parent, shapes[vertex.shape], *faces)]


def kernels_of(target, parts: list[Part], tuning: Tuning, readable: frozenset[int],
               places: Mapping[int, np.ndarray], addresses: "Addresses") -> Kernels:  # fmt: skip
    """Return the mixture's arrays.

    readable : numbers of the kernels without a compiled form. places : see `places_seen`.
    """
    space, names = target.space, target.template.names
    table, numbers, members, factors = [], [], [], []
    weight = 0.0
    first = factor_first = 0
    for k, part in enumerate(parts):
        kind = kernels[part.type]
        code = steps.READABLE if k in readable else kind.code
        scale, count, reach, factor = 1.0, 0.0, 0.0, np.empty(0)
        moved: list[int] = list(part.block.unknowns)
        if kind.code == steps.DRIFT:
            fit = marginal_factor if kind.keeps_children else factor_of
            factor = fit(tuning.covariance, directions_of(space, part.block))
            scale = scale_of(space, part, tuning)
        elif kind.code in steps.PLACING:
            rows = objects_below(target, part.block.objects)
            moved = [*rows[0, 1:3], *rows[:, 0], *rows[:, 3]]
            factor = places[k]
        elif kind.code == steps.INDEPENDENCE:
            factor = part.options["inflation"] * np.linalg.cholesky(tuning.covariance)
        elif kind.code == steps.WINDOW:
            count, reach = float(int(part.options["count"])), part.options["reach"]
        elif kind.code == steps.FLIP:
            moved = [unknown for triple in flips_of(space) for unknown in triple]
        weight += part.weight
        keep = names.index(part.block.objects[0]) if kind.keeps_children else -1
        proposes = {steps.RELOCATE: addresses.relocate, steps.TURN: addresses.turn}.get(kind.code, addresses.propose)
        table.append((code, first, factor_first, keep, proposes, addresses.keep))
        numbers.append((weight, scale, count, reach))
        members += moved
        factors.append(np.ravel(factor))
        first += len(moved)
        factor_first += factor.size
    return Kernels(
        table=np.ascontiguousarray(np.array([*table, (0, first, factor_first, -1, 0, 0)], np.int64).T),
        numbers=np.array(numbers, float),
        members=np.array(members, np.int64),
        factors=np.concatenate(factors),
        spread=np.array(space.scales),
        mean=np.array(tuning.mean, float),
    )


class Addresses(NamedTuple):
    """Where the kernels of steps lie in this process; 0: not asked for."""

    propose: int = 0
    relocate: int = 0
    turn: int = 0
    keep: int = 0


def addresses_of(parts: list[Part], model: Model, chain: Chain) -> Addresses:
    """Compile what a mixture's steps call and return where it lies."""
    types = [kernels[part.type] for part in parts]
    rng, index, flat, members = np.random.default_rng(), np.int64(0), np.zeros(1), np.zeros(1, np.int64)
    relocate_at = turn_at = keep_at = 0
    placing = (rng, model.vertices, model.laws, chain.numbers, chain.pose, chain.relative, chain.moved_pose, members,
               index, index, members, flat)  # fmt: skip
    if any(kind.code == steps.RELOCATE for kind in types):
        relocate_at = address_of(relocate, *placing)
    if any(kind.code == steps.TURN for kind in types):
        turn_at = address_of(turn, *placing)
    if any(kind.keeps_children for kind in types):
        keep_at = address_of(touch_anew, model.vertices, model.extents, model.places, model.laws, chain.values,
                             chain.numbers, chain.pose, chain.marks, flat, chain.relative, index, members,
                             chain.moved_pose)  # fmt: skip
    propose_at = address_of(steps.propose, rng, model.unknowns, model.laws, chain.values, chain.tangents, members, flat,
                            index, 0.0, flat, flat)  # fmt: skip
    return Addresses(propose_at, relocate_at, turn_at, keep_at)


def objects_below(target, objects: Sequence[str]) -> np.ndarray:
    """Return (B, 4) int64, of each relocated object: its vertex, the vertex and face that it is put on, its theta."""
    names, addresses = target.template.names, [unknown.address for unknown in target.space.unknowns]
    rows = []
    for name in objects:
        base, face = target.bases[name]
        theta = addresses.index(f"{name}.contact.theta")
        rows.append((names.index(name), names.index(base), FEATURE_CODES[face], theta))
    return np.array(rows, np.int64)


def places_seen(target, parts: list[Part], model: Model, chain: Chain, archive: np.ndarray) -> dict[int, np.ndarray]:
    """Return the flat mixtures over the places that objects have in (K, P) values, by the numbers of their kernels.

    chain : any of the model's; it is left at the last values.
    """
    chosen = {k: part.block.objects for k, part in enumerate(parts) if kernels[part.type].code in steps.PLACING}
    if not chosen:
        return {}
    objects = sorted({name for names in chosen.values() for name in names})
    places = np.empty((len(objects), len(archive), 3))
    stand_all(model, chain, np.ascontiguousarray(archive, float), objects_below(target, objects).T.copy(), places)
    return {k: mixture_of(target, names, dict(zip(objects, places, strict=True))).flat() for k, names in chosen.items()}


def scale_of(space, part: Part, tuning: Tuning) -> float:
    """Return the step scale of a drifting kernel."""
    return part.options["scale"] * tuning.scale.get(part.name, 1.0) * 2.4 / np.sqrt(space.size(part.block))


def rescaled(target, parts: list[Part], tuning: Tuning, program: Kernels) -> Kernels:
    """Return the arrays of a tuning that differs in its scales alone: a tenth of the time to make them anew."""
    changed = program.numbers.copy()
    for k, part in enumerate(parts):
        if kernels[part.type].code == steps.DRIFT:
            changed[k, SCALE] = scale_of(target.space, part, tuning)
    return program._replace(numbers=changed)


def held(target) -> dict[str, int]:
    """Return which likelihood numbers compiled steps cannot change, and where their values are."""
    names = dict.fromkeys(target.template.names, 0)
    return {
        address.removeprefix("likelihood."): offset
        for offset, address in enumerate(target.space.addresses)
        if place_of(target, names, address)[0] == HELD
    }


def readable_parts(target, parts: list[Part]) -> frozenset[int]:
    """Return the numbers of the kernels that have to take their steps as they stand.

    They have no compiled form, or move a number that compiled steps cannot change.
    """
    kept = set(held(target).values())
    moved = [{target.space.offsets[i] for i in kernels[part.type].moves(target.space, part.block)} for part in parts]
    return frozenset(k for k, part in enumerate(parts) if kernels[part.type].code is None or moved[k] & kept)


def chain_of(target, model: Model, window: int, cycle: bool) -> Chain:
    """Return the arrays of a chain that stands at the template, not loaded yet.

    Parameters
    ----------
    window : the most places that a kernel of the mixture weighs at once. cycle : kernels take turns.
    """
    graph = target.template
    count, solids = len(graph.vertices), len(graph.solid_names)
    size, directions = len(target.space.addresses), int(target.space.directions[-1])
    numbers = np.zeros((2, count + 1, SHAPES + 3))
    for n, vertex in enumerate(graph.vertices):
        contact = vertex.contact
        faces = contact.parent_face, contact.child_face
        parameters = contacts[contact.type].parameters(graph.body(vertex.parent).shape, shapes[vertex.shape], *faces)
        phi = [contact.values.get(p.name, p.default or 0.0) for p in parameters]
        psi = np.nan_to_num(vertex.psi)  # an unknown one may be missing from the template
        numbers[:, n, : len(phi)] = phi
        numbers[:, n, SHAPES : SHAPES + len(psi)] = psi
    if root_code(target) != poses.FIXED_ROOT:
        coordinates = dict(target.root_prior.values(graph.root_pose))
        for key, value in zip(("qw", "qx", "qy", "qz"), coordinates.pop("root.quat_wxyz", ()), strict=False):
            coordinates[f"root.{key}"] = value
        for slot, key in enumerate(ROOT_SLOTS[root_code(target)]):
            numbers[:, count, slot] = coordinates[f"root.{key}"]
    pose = np.tile(np.eye(4), (2, count + 1, 1, 1))
    pose[:, count] = graph.root_pose
    return Chain(
        values=np.full((2, size + 3), -np.inf),
        numbers=numbers,
        pose=pose,
        marks=np.zeros((3, count + 1), np.int64),
        moved_pose=np.tile(np.eye(4), (solids, 1, 1)),
        moved_size=np.zeros((solids, 3)),
        tangents=np.zeros((2, max(directions, 3))),
        row=np.zeros((max(window, 1), size + 3)),
        relative=np.eye(4),
        flags=np.array([0, 0, cycle], np.int64),
    )
