"""Change of shape type: a cube is a box is a cylinder, of the same extents, standing where it stood."""

from derender.structures.jumps.base import moves
from derender.structures.jumps.reparametrise import slot_of
from derender.structures.jumps.reparent import Reparametrise, slots_on


@moves.register("change-shape")
class ChangeShape(Reparametrise):
    """Make an object one of another kind, touching its parent in any way that the prior allows for that kind.

    What it carries keeps its numbers, in fractions of the new face, so its axes must keep their names; a leaf's need
    not. That nothing is carried is as true after as before.
    """

    weight = 2.0

    def slots(self, words, graph, name):
        own = slot_of(words, graph, name)
        kinds = words.kinds(graph, own.parent)
        others = [] if kinds is None else [kind for kind in kinds.choices if kind != own.kind]
        return [slot for kind in others for slot in slots_on(words, graph, own.parent, kind)]

    def keeps_axes(self, graph, name):
        return bool(graph.children(name))
