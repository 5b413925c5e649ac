"""Where jumps start: a default prior, and what the fast search has found written in a prior's own words."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from derender.inference.structure.jumps.proposal import Hypothesis, HypothesisProposal, _vertex
from derender.inference.structure.jumps.recast import renamed
from derender.inference.structure.jumps.vocabulary import Vocabulary
from derender.model.priors.grammar import GrammarPrior
from derender.model.priors.root import FixedRoot, FreeRoot, LookedAtRoot
from derender.model.scene import ROOT, Contact, SceneGraph, Vertex
from derender.model.shapes.cube import ROTATIONS
from derender.yaml_tree import parse_yaml

# Boxes, cubes, cylinders and balls on a floor and on each other, their sizes open over a decade and a half.
DEFAULT = """
derender: 1
objects: {floor: {shape: plane, contact: {type: 6dof}}}
structure:
  type: grammar
  offspring: {floor: {poisson: 3}, box: {categorical: {0: 0.75, 1: 0.2, 2: 0.05}},
              cube: {categorical: {0: 0.75, 1: 0.2, 2: 0.05}}, cylinder: {categorical: {0: 0.9, 1: 0.1}}}
shapes: {SHAPES}
contacts:
  standing: {type: face-to-face, parent_face: top, child_face: -z, weight: 3, x: {normal: [0, 0.3]},
             y: {normal: [0, 0.3]}}
  lying: {type: side-on-face, parent_face: top, x: {normal: [0, 0.3]}, y: {normal: [0, 0.3]}}
  rolling: {type: point-on-face, parent_face: top, x: {normal: [0, 0.3]}, y: {normal: [0, 0.3]}}
"""
SOLID = "constraints: [no-overlap: {depth: 2 mm, scale: 1 mm}]\n"
FLOATING = """  floating: {type: 6dof, quat_wxyz: uniform-rotation,
             position: [{normal: [0, 0.3]}, {normal: [0, 0.3]}, {uniform: [0, HIGH]}]}
"""
SIZES = {
    "box": "box: {weight: 2, length: LAW, width: LAW, height: LAW}",
    "cube": "cube: {weight: 2, side: LAW}",
    "cylinder": "cylinder: {radius: HALF, height: LAW}",
    "sphere": "sphere: {weight: 0.5, radius: HALF}",
}


def default_prior(
    floor_pose: np.ndarray, shapes: Sequence[str] = tuple(SIZES), may_overlap: bool = False, may_float: bool = False
) -> GrammarPrior:
    """Return a grammar on a floor at `floor_pose` (4, 4), root to camera, with sizes in scale with its distance.

    may_overlap : leave out the term against interpenetration. may_float : let objects hang in the air.
    """
    from pathlib import Path

    from derender.document import document_from

    distance = float(np.linalg.norm(floor_pose[:3, 3]))
    low, high = 0.012 * distance, 0.6 * distance
    law = f"{{log-uniform: [{low:.6f}, {high:.6f}]}}"
    half = f"{{log-uniform: [{0.5 * low:.6f}, {0.5 * high:.6f}]}}"
    text = ", ".join(SIZES[name].replace("LAW", law).replace("HALF", half) for name in SIZES if name in shapes)
    rules = DEFAULT.replace("SHAPES", text)
    if may_float:
        rules = rules.replace("offspring: {", "offspring: {root: {poisson: 0.3}, ")
        rules += FLOATING.replace("HIGH", f"{high:.6f}")
    if not may_overlap:
        rules += SOLID
    top, folder = parse_yaml(rules.encode(), "the default prior"), Path.cwd()
    prior = cast(GrammarPrior, document_from(top, folder).prior)
    return replace(prior, root=FixedRoot(floor_pose))


def root_pose_near(root, floor_pose: np.ndarray) -> np.ndarray:
    """Return the pose that a root's prior allows nearest to one at which the floor was seen (its z up)."""
    if isinstance(root, LookedAtRoot):
        up, place = floor_pose[:3, 2], floor_pose[:3, 3]
        elevation = math.asin(min(max(-up[2], -1.0), 1.0))
        seen = {"root.distance": float(up @ place / up[2]), "root.elevation": elevation, "root.azimuth": 0.0,
                "root.roll": math.atan2(up[0], -up[1])}  # fmt: skip
        values = {}
        for address, law in root.free_addresses().items():
            low, high = law.support
            values[address] = min(max(seen[address], low + 1e-9), high - 1e-9)
        return root.pose(values)
    return np.asarray(floor_pose, float) if isinstance(root, FreeRoot) else root.pose({})


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
    from derender.model.shapes import shapes

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
    from derender.model.priors.terms import total_log_density

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
    from derender.model.contacts import contacts
    from derender.model.pose import inverse

    return contacts["6dof"].invert(inverse(np.asarray(root_pose, float)) @ pose).phi


def _placed(words, graph, component, total_log_density):
    """Return the graph with a component's vertex, shrunk as far as it takes; None where nothing helps."""
    for share in (1.0, 0.99, 0.97, 0.94):
        values = {key: share * x if key.startswith("shape.") and key in component.spreads else x
                  for key, x in component.centres.items()}  # fmt: skip
        values = {key: _inside(x, component.spreads.get(key)) for key, x in values.items()}
        added = graph.add(_vertex(words, graph, component, values))
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
