"""A scene graph as a tree of lines for the terminal; the structures of a posterior in words."""

import math
import re
from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

from derender.results.posterior import Posterior
from derender.results.table import digits, probability_text
from derender.sampling.diagnostics import within_a_turn
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.scene.priors.objects import ROTATION

ALTERNATIVE = 0.005  # another parent or type is named from this probability on


def scene_lines(graph: SceneGraph, posterior: Any = None) -> list[str]:
    """Return the tree of a scene: sizes in centimetres, angles in degrees; with a posterior, the probabilities.

    The last line counts the continuous degrees of freedom of the contacts.
    """
    below: dict[str, list[Vertex]] = {}  # the last first
    for vertex in reversed(graph.vertices):
        below.setdefault(vertex.parent, []).append(vertex)
    x, y, z = graph.root_pose[:3, 3]
    lines = [f"root  frame   at ({x:.3f}, {y:.3f}, {z:.3f}) m before the camera"]
    # Without recursion, as stacks may be high.
    waiting = [(vertex, "", number == 0) for number, vertex in enumerate(below.get(ROOT, ()))]
    while waiting:
        vertex, indent, last = waiting.pop()
        parts = [f"{vertex.name}  {vertex.shape}{_size(vertex)}", _contact(graph, vertex)]
        if vertex.supports:
            parts.append("also on " + ", ".join(vertex.supports))
        if posterior is not None:
            parts.append(_probabilities(vertex, posterior))
        lines.append(indent + ("└─ " if last else "├─ ") + "   ".join(filter(None, parts)))
        deeper = indent + ("   " if last else "│  ")
        waiting += [(child, deeper, number == 0) for number, child in enumerate(below.get(vertex.name, ()))]
    for constraint in graph.constraints:
        lines.append(f"{constraint.first} {constraint.type.replace('-', ' ')} {constraint.second}")
    count = graph.degrees_of_freedom()
    lines.append(f"{count} continuous degrees of freedom, {len(graph.vertices)} objects")
    return lines


def _size(vertex: Vertex) -> str:
    if vertex.shape == "sphere":
        return f" radius {100 * vertex.parameters['radius']:.1f} cm"
    if vertex.shape == "cylinder":
        return f" radius {100 * vertex.parameters['radius']:.1f}, height {100 * vertex.parameters['height']:.1f} cm"
    size = vertex.body.size()
    return "" if size is None else " " + " x ".join(f"{100 * side:.1f}" for side in size) + " cm"


def _contact(graph: SceneGraph, vertex: Vertex) -> str:
    contact = vertex.contact
    values = contact.values
    if any(key in values for key in ROTATION):
        position = ", ".join(f"{values.get(key, 0.0):.3f}" for key in "xyz")
        turn = 2 * math.degrees(math.acos(min(1.0, abs(values.get("qw", 1.0)))))
        return f"{contact.type}, at ({position}) m, turned {turn:.1f} deg"
    faces = contact.parent_face, contact.child_face
    known = {p.name: p for p in graph.contact_parameters(vertex.name)}
    bears = bool(graph.children(vertex.name))
    numbers = [_number(name, value, known.get(name), bears) for name, value in values.items()]
    where = f" {faces[1]} on {faces[0]}" if faces != (None, None) else ""
    return ", ".join([f"{contact.type}{where}", *numbers])


def _number(name: str, value: float, parameter: Any, bears: bool) -> str:
    """Return a contact's number as people read it; an angle on the turn that tables have it on.

    Of what bears something it is that of its axes: a cube a quarter turn further looks the same, u and v on it do not.
    """
    if parameter is None or parameter.unit != "rad":
        return f"{name} {value:.3f} {parameter.unit if parameter else ''}".rstrip()
    if parameter.period:
        value = within_a_turn(value, 2 * math.pi if bears else parameter.period)
    return f"{name} {math.degrees(value):.1f} deg"


def _probabilities(vertex: Vertex, posterior: Any) -> str:
    parents = posterior.parent_probability(vertex.name)
    likely = {name: share for name, share in parents.items() if share >= ALTERNATIVE or name == vertex.parent}
    shares = ", ".join(f"{name} {digits(share)}" for name, share in sorted(likely.items(), key=lambda item: -item[1]))
    others = posterior.support_probability(vertex.name)
    also = "".join(f", also {name} {digits(share)}" for name, share in others.items() if share >= ALTERNATIVE)
    there = probability_text(posterior.object_probability(vertex.name), posterior.object_probability_error(vertex.name))
    types = {name: share for name, share in posterior.shape_probability(vertex.name).items() if share >= ALTERNATIVE}
    kinds = "; " + ", ".join(f"{name} {digits(share)}" for name, share in types.items()) if len(types) > 1 else ""
    return f"p {there} (on {shares}{also}{kinds})"


SHOWN_WEIGHT = 0.005  # less is none in two digits
LEAST_LEFT = 0.01  # probability of all other structures that is worth a line
LEAST_HIDDEN = 0.01  # expected number of hidden things that is worth a line


class ToldStructure(NamedTuple):
    """A structure as people are told of it."""

    probability: float
    text: str  # the same as `probability_text` says it
    words: str  # what rests on what


def told_structures(posterior: Posterior) -> list[ToldStructure]:
    """Return the structures that have any weight in two digits, the most probable first, and what is left for others.

    The last, where that is worth a line, is the probability that it is none of those: a search may miss what is there.
    """
    ordered = sorted(posterior.parts, key=lambda part: -part.weight)
    shown = [ordered[0], *(part for part in ordered[1:] if part.weight >= SHOWN_WEIGHT)]
    words = [structure_words(part.graph, ordered[0].graph if k else None) for k, part in enumerate(shown)]
    said = [probability_text(part.weight, part.weight_error, part.weight_interval) for part in shown]
    told = [ToldStructure(part.weight, *each) for part, *each in zip(shown, said, words, strict=True)]
    left = 1.0 - sum(part.weight for part in shown)
    return told if left < LEAST_LEFT else [*told, ToldStructure(left, digits(left), "none of these")]


def hidden_words(posterior: Posterior) -> list[str]:
    """Return the line about things that nothing shows; none where that is unknown or too few to say."""
    expected = posterior.meta.get("hidden_expected")
    if expected is None or expected < LEAST_HIDDEN:
        return []
    return [f"things that nothing shows: {expected:.2f} expected behind what is seen".replace("0.", ".")]


LEAST_ALIKE = 4  # neighbours of which the same is said that are told together


def structure_words(graph: SceneGraph, other: SceneGraph | None = None) -> str:
    """Return who rests on what, in words; other : a graph from which only what differs is told."""
    before = {} if other is None else {vertex.name: vertex for vertex in other.vertices}
    told = []
    for vertex in graph.vertices:
        if vertex.shape in ("plane", "frame"):
            continue
        where, old = _where(vertex), before.pop(vertex.name, None)
        if old is None or where != _where(old):
            told.append((vertex.name, where))
        elif _touch(vertex) != _touch(old):
            told.append((vertex.name, f"{where}, {_touch(vertex)}"))
    words = _together(told, "{names} {what}")
    if other is None:
        return ", ".join(words) or "nothing"
    gone = [(name, "") for name, vertex in before.items() if vertex.shape not in ("plane", "frame")]
    words += _together(gone, "no {names} {what}")
    return "the same, but " + ", ".join(words) if words else "the same"


def _together(told: Sequence[tuple[str, str]], form: str) -> list[str]:
    """Return the words of pairs (name, what is said of it); of many neighbours alike the least and the greatest number.

    A pallet of 27 cartons filled seven lines of a terminal, and each of its alternatives as many.
    """
    words = []
    for what, group in groupby(told, key=itemgetter(1)):
        names = [name for name, _ in group]
        count = len(names)
        if count >= LEAST_ALIKE:
            names.sort(key=_by_numbers)
            names, what = [f"{names[0]} ... {names[-1]}"], what.replace("(", f"({count} x ", 1) or f"({count})"
        words += [form.format(names=name, what=what).rstrip() for name in names]
    return words


def _by_numbers(name: str) -> list[tuple[int, str]]:
    """Return what to sort names by so that box_2 comes before box_10."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]


def _where(vertex: Vertex) -> str:
    where = "floats" if vertex.parent == "root" else "on " + " and ".join((vertex.parent, *vertex.supports))
    return f"({vertex.shape}) {where}"


def _touch(vertex: Vertex) -> str:
    contact = vertex.contact
    return contact.type + (f" {contact.child_face} on {contact.parent_face}" if contact.child_face else "")
