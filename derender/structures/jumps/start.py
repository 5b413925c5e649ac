"""Where jumps start: what the fast search has found, written in a prior's own words."""

import math

import numpy as np

from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex
from derender.scene.priors.root import FreeRoot, LookedAtRoot, written
from derender.scene.shapes.box import ROTATIONS
from derender.structures.jumps.proposal import Hypothesis, HypothesisProposal, vertex_of
from derender.structures.jumps.reparametrise import renamed
from derender.structures.jumps.vocabulary import Vocabulary

FARTHEST = 8.0  # metres along the view within which a depth camera may meet the floor; see workflow.NEARBY


def root_pose_near(root, floor_pose: np.ndarray) -> np.ndarray:
    """Return the pose that a root's prior allows nearest to one at which the floor was seen (its z up)."""
    if isinstance(root, LookedAtRoot):
        seen = _looked_at(floor_pose)
        values = {}
        for address, law in root.free_addresses().items():
            low, high = law.support
            values[address] = min(max(seen[address], low + 1e-9), high - 1e-9)
        return root.pose(values)
    return np.asarray(floor_pose, float) if isinstance(root, FreeRoot) else root.pose({})


def root_seen(floor_pose: np.ndarray) -> np.ndarray:
    """Return the (4, 4) pose of a root on a floor: its origin where the camera looks, or the floor's own if above."""
    seen = _looked_at(floor_pose)
    if not 0.0 < seen["root.distance"] < FARTHEST:
        return written(floor_pose)
    return written(LookedAtRoot(*seen.values()).pose({}))


def _looked_at(floor_pose: np.ndarray) -> dict[str, float]:
    """Return distance, elevation, azimuth and roll, by address, at which a root would lie on a floor."""
    up, place = floor_pose[:3, 2], floor_pose[:3, 3]
    return {
        "root.distance": float(up @ place / up[2]) if abs(up[2]) > 1e-9 else math.inf,
        "root.elevation": math.asin(min(max(-up[2], -1.0), 1.0)),
        "root.azimuth": 0.0,
        "root.roll": math.atan2(up[0], -up[1]),
    }


def base_graph(words: Vocabulary, root_pose: np.ndarray, rng: np.random.Generator) -> SceneGraph:
    """Return the scene of the objects that are always there, those of open numbers as the prior draws them."""
    tree = getattr(words.prior, "tree", None)
    vertices = tuple(tree.sample_vertices(rng).values()) if tree is not None else ()
    return SceneGraph(root_pose=root_pose, vertices=vertices)


def hypotheses_of(words: Vocabulary, graph: SceneGraph, length: float = 0.003, angle: float = 0.03) -> list[Hypothesis]:
    """Return the solids of a scene as hypotheses in a prior's kinds, boxes with each naming of their upright axes."""
    up, poses, found = -graph.down(), graph.poses(), []
    for vertex in graph.vertices:
        size = vertex.body.size()
        if size is None:
            continue
        for kind, entry in words.shapes.items():
            if entry.type == vertex.shape or {entry.type, vertex.shape} == {"box", "cube"}:
                turns = ROTATIONS if "box" in (entry.type, vertex.shape) or entry.type == "cube" else np.eye(3)[None]
                likely = 1.0 if entry.type == vertex.shape else 0.2
                found += _named(kind, entry, poses[vertex.name], size, turns, up, likely, length, angle)
    return found


def _named(kind, entry, pose, size, turns, up, likely, length, angle) -> list[Hypothesis]:
    from derender.scene.shapes import shapes

    variants: list[Hypothesis] = []
    for turn in turns:
        new, extents = renamed(pose, size, turn)
        if len(turns) > 1 and new[:3, 2] @ up < math.cos(math.radians(45.0)):
            continue
        psi = shapes[entry.type].psi_from_size(extents, entry.options)
        parameters = {p.name: float(x) for p, x in zip(shapes[entry.type].parameters, psi, strict=True)}
        if all(abs(new[:3, :3] @ h.pose[:3, :3].T)[0, 0] < 0.999 or h.parameters != parameters for h in variants):
            variants.append(Hypothesis(kind, parameters, new, likely, length, angle))
    return [h._replace(weight=likely / len(variants)) for h in variants]


def start_graph(words: Vocabulary, base: SceneGraph, seen: SceneGraph) -> SceneGraph:
    """Return a scene that the prior allows, with the solids of another one, each in the contact that fits it best.

    A solid that no contact holds, or that enters others more than the prior's terms allow even when it is shrunk by a
    few per cent, is left out: jumps may bring it back.
    """
    from derender.scene.priors.terms import total_log_density

    graph = base
    for vertex in seen.vertices:
        if vertex.body.size() is None:
            continue
        alone = SceneGraph(seen.root_pose, (Vertex(vertex.name, vertex.shape, vertex.parameters, ROOT, Contact("6dof",
            values=_floating(seen.poses()[vertex.name], seen.root_pose)), vertex.options),), seen.gravity)  # fmt: skip
        options = []
        proposal = HypothesisProposal(hypotheses_of(words, alone, 0.002, 0.03))
        for component in proposal.components(words, graph):
            options.append((component.weight * (2.0 if component.parent == vertex.parent else 1.0), component))
        for _, component in sorted(options, key=lambda pair: -pair[0])[:6]:
            placed = _placed(words, graph, component, total_log_density)
            if placed is not None:
                graph = placed
                break
    return graph


def _floating(pose, root_pose):
    from derender.scene.contacts import contacts
    from derender.scene.pose import inverse

    return contacts["6dof"].invert(inverse(np.asarray(root_pose, float)) @ pose).phi


def _placed(words, graph, component, total_log_density):
    """Return the graph with a component's vertex, shrunk as far as it takes; None where nothing helps."""
    for share in (1.0, 0.99, 0.97, 0.94):
        values = {key: share * x if key.startswith("shape.") and key in component.spreads else x
                  for key, x in component.centres.items()}  # fmt: skip
        values = {key: _inside(x, component.spreads.get(key)) for key, x in values.items()}
        added = graph.add(vertex_of(words, graph, component, values))
        if total_log_density(words.prior.constraints, added) > -math.inf:
            return added
    return None


def _inside(x, spread):
    """Return a number moved inside its prior's support."""
    if not isinstance(spread, tuple):
        return x
    low, high = spread[1]
    margin = 1e-6 * (high - low) if math.isfinite(high - low) else 0.0
    return min(max(x, low + margin), high - margin)
