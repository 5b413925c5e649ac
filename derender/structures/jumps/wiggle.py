"""Continuous moves in between: one object's numbers shift a little, what it carries riding along or staying."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution
from derender.scene.graph import ROOT
from derender.scene.pose import inverse
from derender.scene.priors.values import QUATERNION
from derender.structures.jumps.base import Applied, Move, moves
from derender.structures.jumps.charts import LINE, TILTED, all_numbers, log_pose_element
from derender.structures.jumps.numbers import moved, read, unit_of, write
from derender.structures.jumps.vocabulary import log_uniform_choice

SHORTEST, LONGEST = 5e-5, 0.03  # metres of a step; drawn evenly in its logarithm
ARM = 0.05  # metres: a turn is a step's length over an arm of a typical object


class Shift(NamedTuple):
    """name : of the object or "root"; scale : metres; steps : by key, numbers or (3,) rotation vectors."""

    name: str
    scale: float
    steps: dict


@moves.register("wiggle")
class Wiggle(Move):
    """Shift some numbers of one object by normals of a random scale; all that stands on it rides along.

    Choices: the object; a scale, evenly in its logarithm; all its numbers or one of them; the steps. Back are the
    opposite steps of the same scale: normals are even and circles and rotations have no boundary, so the q cancel; a
    shift has Jacobian one, a turn keeps Haar's measure.
    """

    weight = 12.0
    even = True

    def objects(self, words, graph):
        """Return the names of what has free numbers, the root's pose among them."""
        names = [name for name in graph.names if words.free_numbers(graph, name)]
        return ([ROOT] if words.prior.root.free_addresses() else []) + names

    def laws(self, words, graph, name):
        """Return the prior of each number that may shift."""
        if name == ROOT:
            return {("root", key): law for key, law in words.prior.root.free_addresses().items()}
        return words.free_numbers(graph, name)

    def draw(self, rng, words, graph):
        names = self.objects(words, graph)
        if not names:
            return None
        return self.steps_of(rng, words, graph, names[int(rng.random() * len(names))])

    def steps_of(self, rng, words, graph, name) -> Shift:
        """Return steps for the numbers of one object."""
        scale = SHORTEST * (LONGEST / SHORTEST) ** rng.random()
        keys = list(self.laws(words, graph, name))
        if rng.random() < 0.5:
            keys = [keys[int(rng.random() * len(keys))]]
        steps = {}
        for key in keys:
            width = _width(graph, name, key, scale)
            turn = key[1].endswith(QUATERNION)
            steps[key] = width * rng.standard_normal(3) if turn else width * float(rng.standard_normal())
        return Shift(name, scale, steps)

    def log_choice(self, words, graph, choice):
        laws = self.laws(words, graph, choice.name)
        if choice.name not in self.objects(words, graph) or not set(choice.steps) <= set(laws):
            return -math.inf
        total = log_uniform_choice(len(self.objects(words, graph)))
        for key, step in choice.steps.items():
            width = _width(graph, choice.name, key, choice.scale)
            total -= float(np.sum(0.5 * (np.asarray(step) / width) ** 2 + math.log(width)))
        ways = 0.5 * (len(choice.steps) == len(laws)) + 0.5 * (len(choice.steps) == 1) / len(laws)
        return total + math.log(ways) if ways > 0.0 else -math.inf

    def apply(self, words, graph, choice):
        back = Shift(choice.name, choice.scale, {key: -step for key, step in choice.steps.items()})
        laws = self.laws(words, graph, choice.name)
        if choice.name == ROOT:
            values = dict(words.prior.root.values(graph.root_pose))
            for (_, address), step in choice.steps.items():
                values[address] = moved(values[address], step, laws["root", address])
            return Applied(replace(graph, root_pose=words.prior.root.pose(values)), back, 0.0)
        vertex = graph.vertex(choice.name)
        old = read(vertex, choice.steps)
        new = {key: moved(old[key], step, laws[key]) for key, step in choice.steps.items()}
        if any(key[0] == "shape" and not value > 1e-6 for key, value in new.items()):
            return None
        return self.place(words, graph, write(vertex, new), back)

    def place(self, words, graph, vertex, back):
        """Return the scene with the vertex in its new place."""
        vertices = tuple(vertex if other.name == vertex.name else other for other in graph.vertices)
        return Applied(replace(graph, vertices=vertices), back, 0.0)


def _width(graph, name, key, scale):
    """Return the standard deviation of a step of a number: metres, or the turn or share that moves a solid so far."""
    if name == ROOT:
        return scale if key[1] in ("root.x", "root.y", "root.z", "root.distance") else scale / (10.0 * ARM)
    return scale if unit_of(graph, graph.vertex(name), key) == "m" else scale / ARM


@moves.register("slide")
class Slide(Wiggle):
    """Shift one object in its contact while what stands on it stays where it is in the world.

    As `wiggle`, of the contact's numbers alone, of objects that carry something. Each child's numbers become those of
    the same pose on the moved face, for fixed steps a bijection:
    log J = sum over children of log d(pose)/d(numbers) before - the same after (see `charts`), the rest unchanged.
    """

    weight = 2.0

    def objects(self, words, graph):
        carried = {vertex.parent for vertex in graph.vertices if vertex.contact.type in TILTED + LINE}
        return [name for name in words.grown(graph) if name in carried and self.laws(words, graph, name)]

    def laws(self, words, graph, name):
        return {key: law for key, law in words.free_numbers(graph, name).items() if key[0] == "contact"}

    def place(self, words, graph, vertex, back):
        alone = replace(graph, vertices=tuple(vertex if o.name == vertex.name else o for o in graph.vertices))
        poses, total, changed = graph.poses(), 0.0, {}
        moved_pose = alone.poses()[vertex.name]
        for name in graph.children(vertex.name):
            child = graph.vertex(name)
            contact, body, parent = child.contact, child.body, vertex.body
            table, faces = words.table_of(graph, child), (contact.parent_face, contact.child_face)
            if table is None or contact.type not in TILTED + LINE:
                return None
            before = all_numbers(contact, parent.shape, body.shape)
            found = contacts[contact.type].invert(inverse(moved_pose) @ poses[name], parent, body, *faces)
            if found.outside > 1e-9 or found.angle > 1e-9:
                return None
            after = dict(found.values)
            values = dict(contact.values)
            for key, value in after.items():
                law = table.get(key)
                if isinstance(law, Distribution):
                    values[key] = moved(value, 0.0, law)
                    if key == "theta" and abs(math.remainder(values[key] - value, math.tau)) > 1e-9:
                        return None  # folding would turn the child's axes
                    after[key] = values[key]
                elif key not in ("theta", "roll") and abs(value - before[key]) > 1e-9:
                    return None  # the contact would no longer hold
                elif key in ("theta", "roll"):
                    after[key] = value
            total += log_pose_element(contact.type, before, parent, body, faces)
            total -= log_pose_element(contact.type, after, parent, body, faces)
            changed[name] = replace(child, contact=replace(contact, values=values))
        vertices = tuple(changed.get(other.name, other) for other in alone.vertices)
        return Applied(replace(alone, vertices=vertices), back, total)
