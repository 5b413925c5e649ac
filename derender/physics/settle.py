"""The scene graph of where things came to rest: every body on what bears it now."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from derender.errors import DerenderError
from derender.physics.bodies import Matter
from derender.physics.verdict import Trajectory, at_rest, bearers
from derender.scene.graph import ROOT, Contact, Vertex, nearest_contact
from derender.scene.pose import inverse

if TYPE_CHECKING:
    from derender.scene.graph import SceneGraph
    from derender.scene.shapes.base import Body

TYPES = ("face-to-face", "side-on-face", "edge-on-face", "corner-on-face", "point-on-face")
# A contact is taken where it reproduces the pose to a millimetre and a fifth of a degree; slack takes up the rest.
OUTSIDE, ANGLE = 1e-3, np.deg2rad(0.2)
# Of several types that fit, a flatter one is taken unless it needs so much more slack (metres of gap and lean).
MORE_SLACK = 1e-3
# Slack below this (metres, radians) is the engine's own softness.
LEAST_SLACK = 1e-5
# Metres (or radians) below which a number of a contact is none.
ROUNDING = 1e-6


def settled_graph(graph: "SceneGraph", trajectory: Trajectory, matter: Matter) -> "SceneGraph":
    """Return the graph with the poses at the end of a trajectory, its contacts found anew, lower bodies first.

    A body keeps its parent where that still bears it, and otherwise hangs on the highest body that does, or on the
    root at the pose it has. Bodies that were removed or added are not, and as in the scene, respectively.
    """
    end = at_rest(trajectory, matter)
    poses = {**graph.poses(), **{body.name: body.pose for body in end.bodies}}
    on = bearers(end)
    there = {body.name for body in end.bodies}
    moving = {body.name for body in end.bodies if body.moves}
    still = [v for v in graph.vertices if v.name not in moving and (v.name in there or v.shape == "frame")]
    waiting = [v for v in graph.vertices if v.name in moving]
    waiting.sort(key=lambda vertex: float(poses[vertex.name][:3, 3] @ matter.up))
    placed = {vertex.name: vertex for vertex in still}
    for vertex in waiting:
        choices = [name for name in on[vertex.name] if name in placed]
        choices.sort(key=lambda name: (name != vertex.parent, -float(poses[name][:3, 3] @ matter.up)))
        new = replace(vertex, parent=ROOT, supports=(), contact=_floating(graph, poses[vertex.name]))
        for parent in choices:
            contact = _contact(inverse(poses[parent]) @ poses[vertex.name], placed[parent].body, vertex.body)
            if contact is not None:
                others = tuple(name for name in choices if name != parent)
                new = replace(vertex, parent=parent, supports=others, contact=contact)
                break
        placed[vertex.name] = new
    return replace(graph, vertices=tuple(_at_rest(vertex) for vertex in placed.values()), constraints=())


def _at_rest(vertex: Vertex) -> Vertex:
    """Return an object without speed, the rounding of its contact's numbers taken off: a file knows no 1e-15 m."""
    values = {key: 0.0 if abs(x) < ROUNDING else x for key, x in vertex.contact.values.items()}
    options = {key: value for key, value in vertex.options.items() if "velocity" not in key}
    return replace(vertex, options=options, contact=replace(vertex.contact, values=values))


def _contact(relative: np.ndarray, parent: "Body", child: "Body") -> Contact | None:
    """Return the flattest contact of two bodies that reproduces a relative pose, or None."""
    best: tuple[float, Contact] | None = None
    for kind in TYPES:
        try:
            contact, left = nearest_contact(relative, parent, child, kind)
        except DerenderError:
            continue
        if left.outside > OUTSIDE or left.angle > ANGLE:
            continue
        slack = sum(abs(value) for value in left.slack.values())
        if best is None or slack < best[0] - MORE_SLACK:
            values = {key: x for key, x in contact.values.items() if key not in left.slack or abs(x) > LEAST_SLACK}
            best = (slack, replace(contact, values=values))
    return None if best is None else best[1]


def _floating(graph: "SceneGraph", pose: np.ndarray) -> Contact:
    from derender.scene.graph import ROOT_BODY
    from derender.scene.shapes import Body, shapes

    relative = inverse(np.asarray(graph.root_pose, dtype=float)) @ pose
    return nearest_contact(relative, ROOT_BODY, Body(shapes["frame"]), "6dof")[0]
