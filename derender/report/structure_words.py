"""The structures of a posterior in words: who rests on what."""

from derender.results.posterior import Posterior
from derender.scene.graph import SceneGraph, Vertex

SHOWN_WEIGHT = 5e-4  # less is 0.000 in three digits


def told_structures(posterior: Posterior) -> list[tuple[float, str]]:
    """Return (weight, words) of the structures that have any weight in three digits, the most probable first."""
    ordered = sorted(posterior.parts, key=lambda part: -part.weight)
    first = ordered[0].graph
    others = [part for part in ordered[1:] if part.weight >= SHOWN_WEIGHT]
    return [(ordered[0].weight, structure_words(first))] + [
        (part.weight, structure_words(part.graph, first)) for part in others
    ]


def structure_words(graph: SceneGraph, other: SceneGraph | None = None) -> str:
    """Return who rests on what, in words; other : a graph from which only what differs is told."""
    before = {} if other is None else {vertex.name: vertex for vertex in other.vertices}
    words = []
    for vertex in graph.vertices:
        if vertex.shape in ("plane", "frame"):
            continue
        told, old = _words(vertex), before.pop(vertex.name, None)
        if old is None or told != _words(old):
            words.append(told)
        elif _touch(vertex) != _touch(old):
            words.append(f"{told}, {_touch(vertex)}")
    if other is None:
        return ", ".join(words) or "nothing"
    words += [f"no {name}" for name, vertex in before.items() if vertex.shape not in ("plane", "frame")]
    return "the same, but " + ", ".join(words) if words else "the same"


def _words(vertex: Vertex) -> str:
    where = "floats" if vertex.parent == "root" else "on " + " and ".join((vertex.parent, *vertex.supports))
    return f"{vertex.name} ({vertex.shape}) {where}"


def _touch(vertex: Vertex) -> str:
    contact = vertex.contact
    return contact.type + (f" {contact.child_face} on {contact.parent_face}" if contact.child_face else "")
