"""Structures that say the same of the world: a cube on one of its faces is the cube on any other.

The face that an object rests on is one of its own, and a symmetry of the object may carry one face into another. Where
nothing stands on the object and the prior is the same for both names, the two structures have the same images with the
same densities: inference looks at one and gives it the prior probability of all.
"""

import math

import numpy as np

from derender.posterior.scene_space import period_of
from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph
from derender.scene.priors.tree import TreePrior
from derender.scene.shapes import Body

PREFERRED = "-z"


def representative(prior: TreePrior, graph: SceneGraph) -> SceneGraph:
    """Return the graph of the one structure that stands for all those that say the same."""
    for vertex in graph.vertices:
        face = vertex.contact.child_face
        if face is None or face not in vertex.body.shape.face_names or graph.children(vertex.name):
            continue
        laws = _laws(prior, graph, vertex.name)
        if laws is None:
            continue
        for other in sorted(_alike(vertex.body, face), key=lambda name: (name != PREFERRED, name)):
            if other == face:
                break
            contact = vertex.contact
            renamed = graph.replace(vertex.name, contact=type(contact)(contact.type, contact.parent_face, other,
                                                                       contact.values))  # fmt: skip
            if _laws(prior, renamed, vertex.name) == laws and prior.log_density(renamed) > -math.inf:
                graph = renamed
                break
    return graph


def _alike(body: Body, face: str) -> list[str]:
    """Return the faces into which the symmetries of a solid carry one of its faces."""
    normal = body.face(face).frame[:3, 2]
    turned = body.shape.symmetry(body.psi, body.options).rotations @ normal
    normals = {name: body.face(name).frame[:3, 2] for name in body.shape.face_names}
    return [name for name, n in normals.items() if (np.abs(turned - n).max(axis=1) < 1e-9).any()]


def _laws(prior: TreePrior, graph: SceneGraph, name: str) -> dict[str, tuple] | None:
    """Return the priors of an object's free numbers by address; None where its theta does not go all the way round."""
    found: dict[str, Distribution] = prior.free_addresses(graph)
    own = {address: law for address, law in found.items() if address.startswith(f"{name}.")}
    theta = f"{name}.contact.theta"
    if theta in graph.numbers() and (theta not in own or period_of(graph, theta, own[theta]) is None):
        return None
    return {address: (law.name, *law.parameters) for address, law in own.items()}
