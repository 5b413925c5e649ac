"""Split and merge: one solid becomes two, the upper standing on the lower, or two become one as high as both."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from derender.scene.pose import inverse
from derender.scene.shapes.base import AXES, FACE_NAMES, box_face
from derender.scene.shapes.cube import ROTATIONS
from derender.structures.jumps.base import Applied, Move, moves
from derender.structures.jumps.charts import HAAR, Rest, draw_rest, draw_two_scales, log_rest, log_two_scales
from derender.structures.jumps.on_top import on_top, opposite, read_on_top, twist
from derender.structures.jumps.recast import (
    Cast,
    Slot,
    allowed,
    release,
    renamed,
    same_freedom,
    seize,
    slot_of,
    table_of,
)
from derender.structures.jumps.reparent import own_chart
from derender.structures.jumps.vocabulary import log_uniform_choice

PLACE_UNITS = ("m", "m", "m", "rad", "rad", "rad")  # of Split.place
ALIGNED = math.radians(45.0)  # two solids turned more than this against each other do not merge


class Split(NamedTuple):
    """name : what is split; lower, upper : kinds; fresh : name of the upper; rest : of the whole; share : of the height
    that the lower takes; logs (2,) : log ratios of the upper's two other sides; place : (x, y, gap, theta, tilt_x,
    tilt_y) of the upper on the lower, axes aligned; rotation : names of the upper's axes."""

    name: str
    lower: str
    upper: str
    fresh: str
    rest: Rest
    share: float
    logs: tuple[float, float]
    place: tuple[float, ...]
    rotation: int


class Merge(NamedTuple):
    """lower, upper : names; kind : of the whole; rests : of the two; rotation : that aligns the upper's axes."""

    lower: str
    upper: str
    kind: str
    rests: tuple[Rest, Rest]
    rotation: int


@moves.register("split-merge")
class SplitMerge(Move):
    """With probability one half each: split one object that rests on a flat face across its height h, or merge two.

    Split: with its rest the object is a posed box (E, Z). The lower box keeps its foot and its sides and takes the
    share f of h; the upper has the sides times e^a, e^b and the height (1 - f) h, and stands at (x, y, gap) turned by
    Rz(theta) R(tilt) on the lower's top. What the whole carried stands on the upper, with the same numbers. Both are
    then seized by charts, and what those lack is the rests that a merge draws. On volumes of extents and poses

        log J = log(h E2_i E2_j) + log(sin|tilt| / |tilt| / (8 pi^2))
                + element(whole) + log prod E - element(lower) - log prod E1 - element(upper) - log prod E2.

    log q(split) = log 1/2 - log n - 2 log K + log q(rest) + log 6 f (1 - f) + logs and place from two normals each
    - log k, k the number of names that the upper's axes may take (1 where it carries something);
    log q(merge) = log 1/2 - log(mergeable pairs) - log K + log q(rests); that rotation is unique.
    """

    weight = 1.0

    def _splittable(self, words, graph):
        return [n for n in words.grown(graph) if graph.vertex(n).contact.child_face in FACE_NAMES
                and graph.vertex(n).contact.type == "face-to-face"]  # fmt: skip

    def _mergeable(self, words, graph):
        found = []
        for lower in self._splittable(words, graph):
            above = graph.children(lower)
            if len(above) == 1 and above[0] in words.grown(graph):
                contact = graph.vertex(above[0]).contact
                foot = graph.vertex(lower).contact.child_face
                faces = (contact.type, contact.parent_face, contact.child_face)
                if faces == ("face-to-face", opposite(foot), foot):
                    found.append((lower, above[0]))
        return found

    def draw(self, rng, words, graph):
        kinds = list(words.shapes)
        if rng.random() < 0.5:
            names = self._splittable(words, graph)
            if not names:
                return None
            name = names[int(rng.random() * len(names))]
            lower, upper = (kinds[int(rng.random() * len(kinds))] for _ in range(2))
            own = own_chart(words, graph, name)
            if own is None:
                return None
            rest = draw_rest(rng, *own)
            share = float(rng.beta(2.0, 2.0))
            logs = (draw_two_scales(rng, "log"), draw_two_scales(rng, "log"))
            place = tuple(draw_two_scales(rng, unit) for unit in PLACE_UNITS)
            choice = Split(name, lower, upper, words.fresh_name(graph, upper), rest, share, logs, place, 0)
            places = self._names_of_axes(words, graph, choice)
            return choice._replace(rotation=int(places[int(rng.random() * len(places))])) if len(places) else None
        pairs = self._mergeable(words, graph)
        if not pairs:
            return None
        lower, upper = pairs[int(rng.random() * len(pairs))]
        kind = kinds[int(rng.random() * len(kinds))]
        owns = [own_chart(words, graph, name) for name in (lower, upper)]
        if None in owns:
            return None
        rests = tuple(draw_rest(rng, *own) for own in owns)
        rotation = self._aligning(words, graph, lower, upper, rests)
        return None if rotation is None else Merge(lower, upper, kind, rests, rotation)

    def log_choice(self, words, graph, choice):
        count = len(words.shapes)
        if isinstance(choice, Split):
            names, own = self._splittable(words, graph), own_chart(words, graph, choice.name)
            places = self._names_of_axes(words, graph, choice)
            if choice.name not in names or own is None or choice.rotation not in places:
                return -math.inf
            total = math.log(0.5) - 2.0 * math.log(count) + log_uniform_choice(len(names)) + log_rest(choice.rest, *own)
            total += math.log(6.0 * choice.share * (1.0 - choice.share)) + log_uniform_choice(len(places))
            total += sum(log_two_scales(x, "log") for x in choice.logs)
            return total + sum(log_two_scales(x, unit) for x, unit in zip(choice.place, PLACE_UNITS, strict=True))
        pairs = self._mergeable(words, graph)
        owns = [own_chart(words, graph, name) for name in (choice.lower, choice.upper)]
        if (choice.lower, choice.upper) not in pairs or None in owns:
            return -math.inf
        if self._aligning(words, graph, choice.lower, choice.upper, choice.rests) != choice.rotation:
            return -math.inf
        rests = sum(log_rest(rest, *own) for rest, own in zip(choice.rests, owns, strict=True))
        return math.log(0.5) - math.log(count) + log_uniform_choice(len(pairs)) + rests

    def apply(self, words, graph, choice):
        return (self._split if isinstance(choice, Split) else self._merge)(words, graph, choice)

    # ---- split ----------------------------------------------------------------------------------------------------

    def _boxes(self, words, graph, choice) -> tuple[Cast, Cast, Cast, int]:
        """Return the posed boxes of whole, lower and upper (before its axes are named anew), and the upright axis."""
        vertex = graph.vertex(choice.name)
        whole = release(words, graph, vertex, choice.rest)
        foot = vertex.contact.child_face
        k = AXES.index(foot[1])
        i, j = (axis for axis in range(3) if axis != k)
        low, high = whole.extents.copy(), whole.extents.copy()
        low[k] *= choice.share
        high[k] *= 1.0 - choice.share
        high[[i, j]] *= np.exp(choice.logs)
        up = -whole.pose[:3, :3] @ box_face(foot, np.ones(3)).frame[:3, 2]
        below = whole.pose.copy()
        below[:3, 3] -= 0.5 * (whole.extents[k] - low[k]) * up
        above = below @ on_top(foot, low, high, choice.place)
        return whole, Cast(low, below, 0.0), Cast(high, above, 0.0), k

    def _upper_slot(self, graph, choice):
        foot = graph.vertex(choice.name).contact.child_face
        return Slot(choice.upper, choice.name, ("face-to-face", opposite(foot), foot))

    def _names_of_axes(self, words, graph, choice):
        """Return the indices of the rotations under which the upper box may stand on the lower."""
        whole, low, high, _ = self._boxes(words, graph, choice)
        bottom = self._with_lower(words, graph, choice, low)
        if bottom is None:
            return np.zeros(0, int)
        slot = self._upper_slot(graph, choice)
        table = table_of(words, bottom[0], slot)
        if table is None:
            return np.zeros(0, int)
        good = allowed(words, bottom[0], slot, table, high.pose, ROTATIONS)
        if graph.children(choice.name):
            good &= np.array([np.array_equal(r, np.eye(3)) for r in ROTATIONS])
        return np.flatnonzero(good)

    def _with_lower(self, words, graph, choice, low):
        """Return the graph in which the lower box stands in for the whole, its rest and element; None: it cannot."""
        slot = slot_of(words, graph, choice.name)._replace(kind=choice.lower)
        kinds = words.kinds(graph, slot.parent)
        table = table_of(words, graph, slot)
        if table is None or kinds is None or choice.lower not in kinds.probabilities:
            return None
        found = seize(words, graph, choice.name, slot, table, low)
        if found is None:
            return None
        vertex, rest, element = found
        vertices = tuple(vertex if other.name == vertex.name else other for other in graph.vertices)
        return replace(graph, vertices=vertices), rest, element

    def _split(self, words, graph, choice):
        if choice.fresh in graph.names or abs(choice.place[3]) > ALIGNED:
            return None
        whole, low, high, k = self._boxes(words, graph, choice)
        bottom = self._with_lower(words, graph, choice, low)
        if bottom is None:
            return None
        below, rest_low, element_low = bottom
        slot = self._upper_slot(graph, choice)
        table = table_of(words, below, slot)
        if table is None:
            return None
        rotation = ROTATIONS[choice.rotation]
        pose, extents = renamed(high.pose, high.extents, rotation)
        found = seize(words, below, choice.fresh, slot, table, Cast(extents, pose, 0.0))
        if found is None:
            return None
        upper, rest_high, element_high = found
        children = graph.children(choice.name)
        changed = {name: replace(graph.vertex(name), parent=choice.fresh) for name in children}
        new = below.add(upper).exchange(changed)
        if not same_freedom(words, graph, new, children):
            return None
        undo = int(np.argmin(np.abs(ROTATIONS - rotation.T).sum(axis=(1, 2))))
        kind = words.kind_of(graph.vertex(choice.name))
        back = Merge(choice.name, choice.fresh, kind, (rest_low, rest_high), undo)
        element = _core(whole, low, high, k, choice.place[4:]) + whole.log_element - element_low - element_high
        return Applied(new, back, element)

    # ---- merge ----------------------------------------------------------------------------------------------------

    def _aligning(self, words, graph, lower, upper, rests):
        """Return the index of the one rotation that names the upper's axes like the lower's; None if there is none."""
        carries = bool(graph.children(upper))
        low, high = (
            release(words, graph, graph.vertex(name), rest).pose[:3, :3]
            for name, rest in zip((lower, upper), rests, strict=True)
        )
        turned = low.T @ high @ ROTATIONS
        k = AXES.index(graph.vertex(lower).contact.child_face[1])
        good = np.array([twist(rotation, k) < ALIGNED and rotation[k, k] > math.cos(ALIGNED) for rotation in turned])
        places = np.flatnonzero(good)
        if len(places) != 1:
            return None
        if carries and not np.array_equal(ROTATIONS[places[0]], np.eye(3)):
            return None
        return int(places[0])

    def _merge(self, words, graph, choice):
        lower, upper = graph.vertex(choice.lower), graph.vertex(choice.upper)
        low = release(words, graph, lower, choice.rests[0])
        found_high = release(words, graph, upper, choice.rests[1])
        rotation = ROTATIONS[choice.rotation]
        pose, extents = renamed(found_high.pose, found_high.extents, rotation)
        foot = lower.contact.child_face
        k = AXES.index(foot[1])
        i, j = (axis for axis in range(3) if axis != k)
        height = low.extents[k] + extents[k]
        whole = low.extents.copy()
        whole[k] = height
        up = -low.pose[:3, :3] @ box_face(foot, np.ones(3)).frame[:3, 2]
        middle = low.pose.copy()
        middle[:3, 3] += 0.5 * (height - low.extents[k]) * up
        place = read_on_top(foot, low.extents, extents, inverse(low.pose) @ pose)
        logs = (math.log(extents[i] / low.extents[i]), math.log(extents[j] / low.extents[j]))
        slot = slot_of(words, graph, choice.lower)._replace(kind=choice.kind)
        table, kinds = table_of(words, graph, slot), words.kinds(graph, slot.parent)
        if table is None or kinds is None or choice.kind not in kinds.probabilities:
            return None
        found = seize(words, graph, choice.lower, slot, table, Cast(whole, middle, 0.0))
        if found is None:
            return None
        vertex, rest, element = found
        children = graph.children(choice.upper)
        changed = {name: replace(graph.vertex(name), parent=choice.lower) for name in children}
        changed[choice.lower] = vertex
        kept = tuple(changed.get(v.name, v) for v in graph.vertices if v.name != choice.upper)
        new = replace(graph, vertices=kept)
        if not same_freedom(words, graph, new, children):
            return None
        undo = int(np.argmin(np.abs(ROTATIONS - rotation.T).sum(axis=(1, 2))))
        back = Split(choice.lower, words.kind_of(lower), words.kind_of(upper), choice.upper, rest,
                     float(low.extents[k] / height), logs, place, undo)  # fmt: skip
        high = Cast(extents, pose, found_high.log_element)
        total = -_core(Cast(whole, middle, 0.0), low, high, k, place[4:])
        return Applied(new, back, total + low.log_element + high.log_element - element)


def _core(whole, low, high, k, tilt):
    """Return log d(E1, Z1, E2, Z2) / d(E, Z, f, a, b, place), extents by their products (elements leave them out)."""
    a = math.hypot(*tilt)
    i, j = (axis for axis in range(3) if axis != k)
    total = math.log(whole.extents[k] * high.extents[i] * high.extents[j]) - HAAR
    total += math.log(math.sin(a) / a) if a > 1e-9 else 0.0
    products = [float(np.sum(np.log(box.extents))) for box in (whole, low, high)]
    return total + products[0] - products[1] - products[2]
