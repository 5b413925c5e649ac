"""The structures of a posterior in words: who rests on what."""

from derender.results.posterior import Posterior, StructurePosterior
from derender.results.probability_text import probability_text
from derender.scene.graph import SceneGraph, Vertex

SHOWN_WEIGHT = 0.005  # less is none in two digits
LEAST_HIDDEN = 0.01  # expected number of hidden things that is worth a line


def told_structures(posterior: Posterior) -> list[tuple[str, str]]:
    """Return (probability, words) of the structures that have any weight in two digits, the most probable first.

    The probability is said as `probability_text` does, and what no image tells, things behind others, comes last.
    """
    ordered = sorted(posterior.parts, key=lambda part: -part.weight)
    first = ordered[0].graph
    others = [part for part in ordered[1:] if part.weight >= SHOWN_WEIGHT]
    told = [(said(ordered[0]), structure_words(first))]
    told += [(said(part), structure_words(part.graph, first)) for part in others]
    return told


def said(part: StructurePosterior) -> str:
    """Return a structure's probability in words."""
    return probability_text(part.weight, part.weight_error, part.weight_interval)


def hidden_words(posterior: Posterior) -> list[str]:
    """Return the line about things that nothing shows; none where that is unknown or too few to say."""
    expected = posterior.meta.get("hidden_expected")
    if expected is None or expected < LEAST_HIDDEN:
        return []
    return [f"things that nothing shows: {expected:.2f} expected behind what is seen".replace("0.", ".")]


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
