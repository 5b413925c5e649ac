"""The structures that a scene of named objects leaves open: combinations of parents and faces, found and weighed.

The face that an object rests on is one of its own, and a symmetry of the object may carry one face into another: a cube
on one of its faces is the cube on any other. Where nothing stands on the object and the prior is the same for both
names, the two structures have the same images with the same densities: inference looks at one, the representative,
and gives it the prior probability of all.
"""

import math
from collections import Counter
from functools import partial

import numpy as np

from derender.compilation.threads import in_threads
from derender.posterior.kernels import mixture
from derender.posterior.scene_space import period_of
from derender.posterior.settings import Settings
from derender.posterior.smc import tempered
from derender.posterior.target import default_parts
from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph
from derender.scene.priors.terms import bound_by
from derender.scene.priors.tree import TreePrior
from derender.scene.shapes import Body

STRUCTURE_DRAWS = 300  # of the prior at least, among which its structures are looked for
DRAWS_EACH, MOST_DRAWS = 20, 20_000  # of the prior for each that is found; and at most: equal ones count together
FIRST_DRAWS = 8  # after which a structure that was the only one is
RULED_OUT = 2_000  # scenes of a structure that break the terms, without one that does not
PREFERRED = "-z"  # face to rest on of a representative
PARTICLES, STEPS = 50, 60  # of the population by which a structure is weighed


def structures(prior: TreePrior, rng) -> list[SceneGraph]:
    """Return a scene of each structure that the prior can draw.

    Structures are looked for among scenes drawn without the terms, which may allow one scene in hundreds; a structure
    counts once the terms allow a scene of it, and is given up when they have ruled out RULED_OUT of them.
    """
    shown: dict[tuple, SceneGraph | None] = {}
    ruled_out: Counter[tuple] = Counter()
    drawn, wanted = 0, FIRST_DRAWS
    while drawn < wanted or any(shown[key] is None and ruled_out[key] < RULED_OUT for key in shown):
        if drawn == MOST_DRAWS:
            break
        graph = prior.sample_unconstrained(rng)
        drawn += 1
        key = graph.structure()
        if shown.get(key) is None:
            shown[key] = bound_by(prior.constraints, graph)
            ruled_out[key] += shown[key] is None
        if len(shown) > 1:
            wanted = min(max(STRUCTURE_DRAWS, DRAWS_EACH * len(shown)), MOST_DRAWS)
    return [graph for graph in shown.values() if graph is not None] or [prior.sample(rng)]


def structure_weights(found, settings: Settings, seed: int, tell) -> list[float]:
    """Return the posterior probability of each structure: its prior's times its evidence, estimated by tempering."""
    done = 0

    def weigh(rng, target, log_prior: float) -> float:
        nonlocal done
        entries = settings.kernels if settings.kernels is not None else default_parts()
        mixed = mixture(target.space, entries, settings.where)
        population = tempered(rng, target.space, target.backend(mixed), mixed, PARTICLES, STEPS, settings.particles)
        done += 1
        tell(done / len(found), "weighing structures")
        return log_prior + population.log_evidence

    tell(0.0, "weighing structures")
    tasks = [partial(weigh, target=target, log_prior=log_prior) for target, log_prior in found]
    logs = np.array(in_threads(np.random.default_rng([seed, 2]), tasks))
    weights = np.exp(logs - max(logs))
    return list(weights / weights.sum())


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
