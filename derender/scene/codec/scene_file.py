"""The model's part of a scene file: root, objects, open structure; read into a prior.

A file whose numbers are all fixed is a prior with one scene. Open-universe priors are found by the name under
`structure: {type: ...}`; each reads its own keys. The keys of other rooms (camera, likelihood, inference) are left to
`derender.document`.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.errors import at_fault
from derender.registry import Registry, suggest
from derender.scene.codec.yaml_tree import List, Node, Section
from derender.scene.contacts import contacts
from derender.scene.distributions import Categorical
from derender.scene.graph import STANDARD_GRAVITY
from derender.scene.pose import from_quaternion
from derender.scene.priors.bare_image import BareImagePrior, MayTip, read_loose
from derender.scene.priors.grammar import Algorithm1Prior, GrammarPrior
from derender.scene.priors.objects import ON, QUATERNION, TOP, ContactPrior, ContactRule, ShapePrior
from derender.scene.priors.reading import (
    PHYSICAL,
    read_categorical,
    read_contact_values,
    read_count,
    read_face,
    read_physical,
    read_rotation,
    read_rules,
    read_shape,
    read_value,
)
from derender.scene.priors.terms import RestsOn, Term, read_terms
from derender.scene.priors.tree import ROOT, FixedRoot, FreeRoot, LookedAtRoot, Prior, RootPrior, TreeObject, TreePrior
from derender.scene.shapes import shapes

structures: Registry["Structure"] = Registry("structure", "derender.structures")


class Parts(NamedTuple):
    """What the other sections of a file give to an open-universe prior, see `GrammarPrior`."""

    root: RootPrior
    objects: tuple[TreeObject, ...]
    shapes: Mapping[str, ShapePrior]
    contacts: ContactPrior
    constraints: tuple[Term, ...]


class Structure:
    """A kind of open-universe prior."""

    name: str

    def read(self, section: Section, parts: Parts) -> Prior:
        """Return the prior of a file's `structure` section, with what its other sections gave."""
        raise NotImplementedError


@structures.register("algorithm-1")
class Algorithm1(Structure):
    """`{type: algorithm-1, mean_parents: 1.5, mean_children: 2}`: lambda_1 and lambda_2."""

    def read(self, section: Section, parts: Parts) -> Prior:
        section.allow("type", "mean_parents", "mean_children")
        if parts.objects:
            raise section.fault("Algorithm 1 starts from the bare root", "leave objects: out, or take type: grammar")
        for name, shape in parts.shapes.items():
            if shape.weight != 1.0:
                raise section.fault(f"the weight of {name} is not 1", "in Algorithm 1 each shape is as likely")
        parents, children = (section[key].number(lower=1e-9, upper=1000) for key in ("mean_parents", "mean_children"))
        return Algorithm1Prior(parts.root, parts.shapes, parts.contacts, parents, children, parts.constraints)


@structures.register("grammar")
class Grammar(Structure):
    """`{type: grammar, offspring: {floor: {poisson: 2}, box: {geometric: 0.2}}}`: how many grow on each."""

    def read(self, section: Section, parts: Parts) -> Prior:
        section.allow("type", "offspring")
        return GrammarPrior(*parts[:4], read_offspring(section), parts.constraints)


@structures.register("bare-image")
class BareImage(Structure):
    """`{type: bare-image, offspring: {...}, slack: 1.5 mm, tipping: 0.01}`: a grammar, and what is loose about it."""

    def read(self, section: Section, parts: Parts) -> Prior:
        loose = read_loose(section)
        terms = (*parts.constraints, MayTip(loose.tipping))
        return BareImagePrior(*parts[:4], read_offspring(section), terms, loose)


def read_offspring(section: Section) -> dict[str, Any]:
    """Return the distribution of how many objects grow on each."""
    return {name: read_count(node) for name, node in section["offspring"].section().items()}


KEYS = ("root", "gravity", "objects", "structure", "shapes", "contacts", "constraints")
MOST_OBJECTS = 2000
NAME = re.compile(r"[^\W_][\w -]{0,63}")  # of an object: a part of an address, safe to print
RESERVED = ("root", "likelihood", "camera")  # that addresses begin with besides objects


def read_prior(top: Section, folder: Path) -> Prior:
    """Return the prior that a file describes; `folder` is where its relative paths start.

    Raises DerenderError : with file, line, address and remedy.
    """
    root = read_root(top.get("root"))
    objects = read_objects(top.get("objects"), folder)
    names = tuple(item.name for item in objects)
    open_structure = "structure" in top
    terms = read_terms(top["constraints"], names) if "constraints" in top else ()
    if not open_structure:
        for key in ("shapes", "contacts"):
            if key in top:
                raise top[key].fault(f"{key} belongs to a file with structure:", "add structure: {type: grammar, ...}")
        if "objects" not in top:
            raise top.fault("neither objects nor structure is given", "add objects: or structure:")
        return with_supports(TreePrior(root, objects, terms, read_gravity(top.get("gravity"))))
    if "gravity" in top:
        raise top["gravity"].fault("gravity belongs to a file with objects", "leave it out: 9.81 m/s^2 onto the floor")
    section = top["structure"].section()
    kind = section["type"].text(structures)
    kinds = {}
    for name, node in top["shapes"].section().items():
        check_name(name, node)
        entry = read_shape(node, folder, ("weight", *PHYSICAL), name)
        weight = node["weight"].number(lower=0.0, upper=1e6) if isinstance(node, Section) and "weight" in node else 1.0
        kinds[name] = replace(entry, options={**entry.options, **read_physical(node)}, weight=weight)
    rules = tuple(rule for name, node in top["contacts"].section().items() for rule in read_rules(node, name))
    with at_fault(section.where):
        return structures[kind].read(section, Parts(root, objects, kinds, ContactPrior(rules), terms))


def read_gravity(node: Node | None) -> tuple[float, float, float]:
    """Read the pull of gravity: m / s^2 along the root's -z, or a vector in the root's axes; in units of 9.81."""
    if node is None:
        return (0.0, 0.0, -1.0)
    if isinstance(node, List):
        x, y, z = (item.number(lower=-1e3, upper=1e3) / STANDARD_GRAVITY for item in node.sequence(3))
        return (x, y, z)
    return (0.0, 0.0, -node.number(lower=0.0, upper=1e3) / STANDARD_GRAVITY)


def with_supports(prior: TreePrior) -> TreePrior:
    """Return the prior with a term for each second support that no `rests-on` names; a scene is what it is."""
    named = {(term.child, term.support) for term in prior.constraints if isinstance(term, RestsOn)}
    pairs = [(item.name, other) for item in prior.objects for other in item.supports]
    wanted = tuple(RestsOn(*pair) for pair in pairs if pair not in named)
    return prior if not wanted or prior.fixed else replace(prior, constraints=(*prior.constraints, *wanted))


def check_name(name: str, node: Node) -> None:
    """Refuse a name that would not fit an address."""
    if not NAME.fullmatch(name) or name in RESERVED:
        raise node.fault(f"{name!r} cannot name an object", "use letters, digits, - and _, beginning with a letter")


def read_root(node: Node | None) -> RootPrior:
    """Read the root's pose: {position, quat_wxyz}, {distance, elevation, azimuth, roll} or {pose: 4 rows}."""
    if node is None:
        return FixedRoot(np.eye(4))
    section = node.section()
    if "pose" in section:
        return FixedRoot(_matrix(section.allow("pose")["pose"]))
    if "distance" in section or "elevation" in section:
        section.allow(*LookedAtRoot.KEYS)
        distance, elevation = read_value(section["distance"], "m"), read_value(section["elevation"], "rad")
        low = distance if isinstance(distance, float) else distance.support[0]
        if low < 0 or distance == 0:
            raise section["distance"].fault("the distance is not positive", "give a distance above 0, such as 0.8")
        span = (elevation, elevation) if isinstance(elevation, float) else elevation.support
        if not -math.pi / 2 <= span[0] <= span[1] <= math.pi / 2:
            what = "the elevation leaves [-90 deg, 90 deg]"
            raise section["elevation"].fault(what, "use uniform or truncated-normal")
        rest = [read_value(section[key], "rad") if key in section else 0.0 for key in ("azimuth", "roll")]
        return LookedAtRoot(distance, elevation, *rest)
    section.allow("position", QUATERNION, "pose", *LookedAtRoot.KEYS)
    places = section["position"].sequence(3) if "position" in section else ()
    position = tuple(read_value(item, "m") for item in places) or (0.0, 0.0, 0.0)
    rotation = read_rotation(section[QUATERNION]) if QUATERNION in section else (1.0, 0.0, 0.0, 0.0)
    if isinstance(rotation, tuple) and all(isinstance(x, float) for x in position):
        return FixedRoot(from_quaternion(rotation, position))
    return FreeRoot(position, rotation)  # type: ignore[arg-type]


def _matrix(node: Node) -> np.ndarray:
    pose = np.array([[item.number() for item in row.sequence(4)] for row in node.sequence(4)])
    rotation = pose[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
    if not rigid or np.abs(pose[3] - (0, 0, 0, 1)).max() > 0:
        raise node.fault("the matrix is no rigid pose", "give [R, t; 0, 0, 0, 1] with a rotation R")
    return pose


def read_objects(node: Node | None, folder: Path) -> tuple[TreeObject, ...]:
    """Read the named objects, in the order of the file."""
    if node is None:
        return ()
    section = node.section()
    if len(section) > MOST_OBJECTS:
        raise section.fault(f"{len(section)} objects are too many", f"stay below {MOST_OBJECTS}")
    kinds: dict[str, str] = {ROOT: "frame"}
    for name, item in section.items():
        check_name(name, item)
        shape = item.section()["shape"]
        kinds[name] = (shape["type"] if isinstance(shape, Section) else shape).text(shapes)
    return tuple(_read_object(name, item.section(), kinds, folder) for name, item in section.items())


def _read_object(name: str, node: Section, kinds: dict[str, str], folder: Path) -> TreeObject:
    node.allow("shape", "parent", "contact", "supports", *PHYSICAL, "colour")
    shape = read_shape(node["shape"], folder)
    options = {**shape.options, **read_physical(node)}
    if "colour" in node:
        options["colour"] = tuple(part.number(lower=0.0, upper=1.0) for part in node["colour"].sequence(3))
    others = [other for other in kinds if other != name]
    parent: str | Categorical = ROOT
    if "parent" in node:
        item = node["parent"]
        if isinstance(item, Section):
            parent = read_categorical(item, others)
        elif item.text() == name:
            raise item.fault(f"{name} rests on itself", "name another object, or root")
        else:
            parent = item.text(others)
    parents = parent.choices if isinstance(parent, Categorical) else (parent,)
    if "contact" not in node and parents != (ROOT,):
        raise node.fault("the contact is missing", "add contact: {type: face-to-face, ...}")
    contact = _read_contact(node.get("contact"), [kinds[each] for each in parents], shape.type, node)
    supports = tuple(item.text(others) for item in node["supports"].sequence()) if "supports" in node else ()
    return TreeObject(name, replace(shape, options=options), contact, parent, supports, node)


def _read_contact(node: Node | None, parents: list[str], child: str, place: Section) -> ContactPrior:
    """Read an object's contact: exactly one pair of faces for each parent's shape, unless the file leaves it open."""
    if node is None:
        return ContactPrior((ContactRule("6dof", fill=False, places={"": place}),))
    if not isinstance(node, Section):
        kind = node.text([*contacts, ON])
        section = Section(node.file, node.line, node.address)
    else:
        section, kind = node, node["type"].text([*contacts, ON])
    if kind == ON:
        return ContactPrior(_on_rules(section, parents, child))
    values, places = read_contact_values(section, kind, ("type",))
    wanted = [read_face(section.get("parent_face")), read_face(section.get("child_face"))]
    rules = []
    for parent in dict.fromkeys(parents):
        pairs = contacts[kind].choices(shapes[parent], shapes[child])
        with at_fault(section.where):
            usual = contacts[kind].default_choice(shapes[parent], shapes[child])
        for face, key, index in ((wanted[0], "parent_face", 0), (wanted[1], "child_face", 1)):
            known = {str(pair[index]) for pair in pairs}
            for each in face.choices if isinstance(face, Categorical) else (face,):
                if each is not None and each not in known and not (key == "parent_face" and each == TOP):
                    shape = (parent, child)[index]
                    what = f"the {key} {each!r} of a {shape} has no {kind} contact"
                    raise section[key].fault(what, suggest(each, known))
        faces = [own if face is None else face for face, own in zip(wanted, usual, strict=True)]
        rule = ContactRule(kind, 1.0, faces[0], faces[1], values, (parent,), None, False, {**places, "": section})
        rules.append(rule)
    return ContactPrior(tuple(rules))


def _on_rules(section: Section, parents: list[str], child: str) -> tuple[ContactRule, ...]:
    """Read `on`: every exact contact by which the child can rest on the parent's top is as likely as another."""
    rules = []
    for rule in read_rules(section):
        pairs = [contacts[rule.type].choices(shapes[parent], shapes[child]) for parent in parents]
        counts = [sum(on == "+z" for on, _ in each) for each in pairs]
        rules.append(replace(rule, weight=float(max(1, *counts, 1))))
    return tuple(rules)
