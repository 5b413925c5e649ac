"""Which known object each solid is and where: search, then what else each might be.

The search for solids of unknown sizes says where something stands.  There every object of the library is tried in every
way of lying; the best are placed one after the other while they gain more than their price, against what is placed
already; what then is still unexplained may be solids of unknown sizes.  For each object placed, all others and "none of
them" compete by their refined energies. Objects are drawn by their triangles, in the floor frame; each is the row of
what stands for it, a proxy, whose rotation and centre are its own.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import numpy as np

from derender.compilation.cache import njit
from derender.detection.search.greedy import Settings
from derender.detection.solids.image import SIZE, Image, drawn_alone, make_row, pose_in, put_in, rotation_of
from derender.detection.solids.interpenetration import highest, lowest, penetration
from derender.detection.solids.misfit import change_by, misfit_map
from derender.detection.solids.polish import FREE, resting_energy
from derender.detection.solids.state import FLOOR, Solid, State, held_out, in_the_way, run_polish
from derender.detection.solids.support import shadows_overlap, standing_on
from derender.render.raycast.convex import PREPARED, prepare_solid
from derender.render.raycast.depth import draw_mesh
from derender.sampling.metropolis import compiled_adapted_scale, compiled_log_threshold
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, MESH, SPHERE
from derender.structures.known.library import GAP, LEVEL, Known, Space, fitted, layouts_of, space_of

LEAST_TILT = np.radians(0.5)
SCALES = np.array([0.006, 0.006, 0.003, 0.006, 0.001, 0.001])
REACH = 0.02  # metres off its support at which an object still stands on it
TRIED = 4  # ways of lying that are refined, of all that are looked at
ENDS = 0.003  # share of the points that show a grid which may lie beyond its ends: noise
UNSURE = 0.025  # metres by which the ends of what is seen may be off a grid's
LEAST_OVER = 0.1  # metres that the camera is over a top, at least: from lower its far end is not seen
SHOWN = 4  # pixels that show a known object: of fewer, and of noise, nothing is learnt of where it is
SHRUNK = 0.9  # of the box that stands for a mesh where solids must not enter each other: most meshes are rounder


@dataclass(frozen=True)
class Placed:
    """One solid of the answer."""

    known: Known | None  # the object that it is, None for a solid of unknown sizes
    solid: Solid  # its proxy, over the floor: rotation and centre are the object's own
    anchor: int  # index of the solid of the first search that stood there


def state_of(placed: list[Placed]) -> State:
    """Return the State of what was placed, all of it over the floor."""
    return State.of([item.solid for item in placed])


@dataclass(eq=False)
class Placement:
    """Puts known objects into one image."""

    rng: np.random.Generator
    image: Image  # as it is searched
    whole: Image  # as it came, where that is larger
    state: State  # what the first search found
    settings: Settings
    library: tuple[Known, ...]
    others: bool  # whether solids that are none of them may be there

    def __post_init__(self) -> None:
        self.tilt = max(self.settings.tilt, LEAST_TILT)
        _, self.label, _, _ = held_out(self.image, self.state, -1)
        self.rivals: list[tuple[float, list[Placed], set[int]]] = []  # nats worse; instead of what at which anchors

    def view(self, placed: list[Placed], skip: int = -1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return depth, label and misfit of the scene without number `skip`."""
        depth, label, misfit, _ = held_out(self.image, State(), -1)  # the floor alone
        for k, (row, known) in enumerate((item.solid.row, item.known) for item in placed):
            if k != skip:
                alone = drawn_alone(self.image, row) if known is None else known_alone(self.image, known.meshes, row)
                put_in(*alone, k, depth, label)
        misfit_map(self.image, depth, misfit)
        return depth, label, misfit

    def starts(self, known: Known, anchor: int, bases: list[float]) -> Iterator[Solid]:
        """Yield the Solids from which an object may be refined where one was found."""
        found = self.state.rows[anchor]
        middles = [found[10:12]]
        seen = (self.label == anchor) & (self.image.depth > 0)
        if seen.sum() >= 4:
            points = self.image.origin + self.image.depth[seen][:, None] * self.image.direction[seen]
            away = np.median(points[:, :2], axis=0) - self.image.origin[:2]
            middles.append(np.median(points[:, :2], axis=0) + 0.3 * known.size.min() * away / np.linalg.norm(away))
        yaw = np.arctan2(found[4], found[1]) if abs(found[9]) > 0.9 else 0.0
        for way in known.resting():
            rotation = rotation_z(yaw)[:3, :3] @ way
            low = float((known.meshes.vertices @ rotation[2]).min())
            for middle in middles:
                for base in bases:
                    row = make_row(known.proxy, rotation, [*middle, base - low], known.size)
                    yield Solid(row, FREE, bottom=base)

    def refine(self, known: Known, solid: Solid, rows: np.ndarray, skip: int, view: Any, rounds: int,
               heat: float = 2.0, scales: np.ndarray = SCALES) -> tuple[float, Solid]:  # fmt: skip
        """Return (energy, Solid) of one object annealed against the rest of the scene, see `walk_known`.
        view : depth, label and misfit without it."""
        start = solid.row.copy()
        start[SIZE:] = known.size * (SHRUNK if known.body.shape.solid_kind == MESH else 1.0)
        row, energy = walk_known(
            self.rng, self.image, known.meshes, start, in_the_way(rows, self.settings), skip, view[0], view[2],
            solid.bottom, self.settings.slack, self.tilt, scales.copy(), rounds, heat,
        )  # fmt: skip
        row[SIZE:] = known.size
        return energy, solid._replace(row=row)

    def best_pose(
        self, known: Any, anchor: int, placed: list[Placed], view: Any, skip: int = -1
    ) -> tuple[float, Placed]:
        """Return (energy, Placed) of the best pose of an object at an anchor."""
        rows, found = state_of(placed).rows, self.state.rows[anchor]
        tops = {round(highest(row), 4): highest(row) for k, row in enumerate(rows) if k != skip
                and shadows_overlap(found, row) and highest(found) > highest(row)}  # fmt: skip
        bases = [0.0, *tops.values()]
        low = lowest(found)
        if low > 0.02:
            bases.append(low)
        looked, energy_of = [], itemgetter(0)  # of two as good, the first
        for start in self.starts(known, anchor, bases):
            change = change_by(self.image, *known_alone(self.image, known.meshes, start.row), view[0], view[2])
            looked.append((change, start))
        first = sorted(looked, key=energy_of)[:TRIED]
        refined = [self.refine(known, start, rows, skip, view, 70) for _, start in first]
        _, solid = min(refined, key=energy_of)
        energy, solid = self.refine(known, solid, rows, skip, view, 200, 1.5, SCALES / 3)
        return energy, Placed(known, solid, anchor)

    def place(self) -> list[Placed]:
        """Return what is there: known objects one after the other, then what is none of them."""
        counts = {item.name: item.count for item in self.library}
        placed = self.grids(counts)
        view, begun = self.view(placed), len(placed)
        options = {
            (anchor, known.name): (*self.best_pose(known, anchor, placed, view), begun)
            for anchor in sorted(set(range(len(self.state))) - {item.anchor for item in placed})
            for known in self.library if counts[known.name] > 0
        }  # fmt: skip
        while options and len(placed) < self.settings.max_objects:
            key = min(options, key=lambda k: options[k][0])
            energy, item, seen = options[key]
            if energy + self.settings.price > 0:
                break
            if seen < len(placed):  # others were placed since: what is it worth now?
                energy, item = self.best_pose(item.known, item.anchor, placed, self.view(placed))
                options[key] = (energy, item, len(placed))
                continue
            placed.append(item)
            counts[key[1]] -= 1
            options = {k: v for k, v in options.items() if k[0] != key[0] and counts[k[1]] > 0}
        if self.others:
            placed = self.add_unknown(placed)
        return self.settle(placed)

    def grids(self, counts: dict[str, int]) -> list[Placed]:
        """Return the known boxes of grids that explain as much as what the first search found in their places.
        counts : of how many of each object there may be more, changed in place."""
        placed: list[Placed] = []
        taken: set[int] = set()
        for group, space in self.spaces():
            if taken & set(group):
                continue
            rest = np.concatenate([np.delete(self.state.rows, [*taken, *group], axis=0), state_of(placed).rows])

            def misfit(rows, rest=rest):
                return held_out(self.whole, State(np.vstack([rest, rows])), -1)[3]

            found: list[tuple[float, list[Placed]]] = []
            for layout in (each for known in self.library for each in layouts_of(space, known)):
                if layout.counts.prod() <= counts[layout.known.name]:
                    least, cells = fitted(space, layout, misfit, self.whole.origin)
                    anchors = [group[k % len(group)] for k in range(len(cells))]
                    boxes = [Placed(layout.known, Solid(row, FREE, bottom=lowest(row)), anchor)
                             for row, anchor in zip(cells, anchors, strict=True)]  # fmt: skip
                    found.append((least + self.settings.price, boxes))
            if not found:
                continue
            as_found = self.as_found(group, rest)
            energy = misfit(state_of(as_found).rows)
            found.append((energy + sum(self.price_of_unknown(item.solid) for item in as_found), as_found))
            found.sort(key=lambda each: each[0])
            (best, boxes), known = found[0], found[0][1][0].known
            if known is not None:
                placed += boxes
                taken |= set(group)
                counts[known.name] -= len(boxes)
            self.rivals += [(energy - best, instead, set(group)) for energy, instead in found[1:]]
        return placed

    def as_found(self, group: list[int], rest: np.ndarray) -> list[Placed]:
        """Return solids of the first search polished by the image as it came, `rest` (N, ROW) around them."""
        items, count = [self.unknown(anchor) for anchor in group], len(rest)
        for k, item in enumerate(items):
            state = State(np.vstack([rest, state_of(items).rows]))
            solid, _ = run_polish(self.rng, self.whole, state, count + k, item.solid,
                                  held_out(self.whole, state, count + k), self.settings)  # fmt: skip
            items[k] = replace(item, solid=solid)
        return items

    def spaces(self) -> Iterator[tuple[list[int], Space]]:
        """Yield (solids of the first search, the Space that they fill), what is parallel and together first."""
        single = {}
        for k, row in enumerate(self.state.rows):
            space = space_of(row, self.state.bottoms[k])
            if space is not None:
                single[k] = space._replace(inexact=space.inexact + self.unsure(space))
        for first, space in single.items():
            group = sorted(self.together(first))
            shown = np.isin(self.label, group) & (self.image.depth > 0)
            if len(group) > 1 and shown.any():
                points = self.image.origin + self.image.depth[shown][:, None] * self.image.direction[shown]
                level = points[:, :2] @ rotation_z(space.yaw)[:2, :2]
                low, high = (np.quantile(np.column_stack([level, points[:, 2]]), q, axis=0) for q in (ENDS, 1.0 - ENDS))
                low[2] = space.bottom
                middle = rotation_z(space.yaw)[:2, :2] @ (0.5 * (low + high))[:2]
                whole = space._replace(middle=middle, size=high - low)
                yield group, whole._replace(inexact=UNSURE + self.unsure(whole))
        for first, space in single.items():
            yield [first], space

    def unsure(self, space: Space) -> np.ndarray:
        """Return the (3,) metres by which silhouettes put the ends of a Space wrong: half a pixel, and where its top is
        seen from low over it a row of pixels farther away."""
        way, away = self.image.direction, space.middle - self.image.origin[:2]
        far = float(np.linalg.norm(away))
        pixel = float(np.linalg.norm(way[0, 1] - way[0, 0])) * far
        over = max(float(self.image.origin[2] - space.bottom - space.size[2]), LEAST_OVER)
        return 0.5 * pixel + np.append(np.abs(rotation_z(space.yaw)[:2, :2].T @ away) * pixel / over, 0.0)

    def together(self, first: int) -> set[int]:
        """Return the solids of the first search that touch one, or touch what does, and so on: parts of one grid?"""
        rows, group, ahead = self.state.rows, {first}, [first]
        while ahead:
            k = ahead.pop()
            more = {j for j in range(len(rows)) if j not in group and penetration(rows[k], rows[j]) > -GAP}
            group |= more
            ahead += sorted(more)
        return group

    def add_unknown(self, placed: list[Placed]) -> list[Placed]:
        """Return the scene with those solids of the first search that it still needs."""
        left = sorted(set(range(len(self.state))) - {item.anchor for item in placed},
                      key=lambda anchor: lowest(self.state.rows[anchor]))  # fmt: skip
        for anchor in left:
            if len(placed) >= self.settings.max_objects:
                break
            depth, _, misfit = self.view(placed)
            item = self.unknown(anchor)
            solid, energy = self.polished(item.solid, placed, -1, (depth, None, misfit, 0.0))
            if energy + self.price_of_unknown(solid) < 0:
                placed = [*placed, replace(item, solid=solid)]
        return placed

    def as_large(self, item: Placed, row: np.ndarray) -> bool:
        """Whether a solid of unknown sizes, a row (ROW,), is a known object as far as a reduced image tells, whose
        blocks put silhouettes by up to half of one wrong, which costs a solid of given sizes tens of nats and one of
        free sizes nothing."""
        if item.known is None or item.known.shape == "mesh" or int(row[0]) != item.solid.kind:
            return False
        across = np.abs(rotation_of(row).T @ rotation_of(item.solid.row))
        if int(row[0]) == BOX and (across.max(axis=0) < LEVEL).any():  # they lie in different ways
            return False
        size = item.known.size[across.argmax(axis=1)] if int(row[0]) == BOX else item.known.size
        block = np.linalg.norm(self.image.direction[0, 1] - self.image.direction[0, 0])
        block *= np.linalg.norm(row[10:13] - self.image.origin)  # metres: half of one at either end
        return bool((np.abs(row[SIZE:] - size) <= block).all())

    def price_of_unknown(self, solid: Solid) -> float:
        """Return the price in nats of a solid of unknown sizes: `cube_bonus` is what two free sizes cost."""
        settings, kind = self.settings, solid.kind
        sizes = 1 if solid.cube or kind == SPHERE else 3 if kind == BOX else 2
        tilted = settings.free_price if solid.form == FREE and kind != SPHERE else 0.0
        stranger = settings.believed.loose.stranger
        known = np.log((1.0 - stranger) / stranger)  # nats, of the prior odds of being one of the library's objects
        return settings.price + 0.5 * sizes * settings.cube_bonus + tilted + known * settings.temper

    def unknown(self, anchor: int) -> Placed:
        """Return the solid of the first search as it was."""
        return Placed(None, self.state[anchor]._replace(parent=FLOOR), anchor)

    def polished(self, solid: Solid, placed: list[Placed], skip: int, view: Any) -> tuple[Solid, float]:
        """Return (it, energy) of a solid of unknown sizes polished against the rest."""
        return run_polish(self.rng, self.image, state_of(placed), skip, solid, view, self.settings)

    def carriers(self, placed: list[Placed]) -> list[tuple[int, float]]:
        """Return (what each stands on, how high that is)."""
        state = state_of(placed)
        return [standing_on(state, k, REACH) for k in range(len(placed))]

    def settle(self, placed: list[Placed]) -> list[Placed]:
        """Return the scene with every object held to what it stands on and refined against all others."""
        for sweep in range(2):
            carriers, label = self.carriers(placed), self.view(placed)[1]
            for k, item in enumerate(placed):
                if np.sum(label == k) < SHOWN:
                    continue
                solid, view = item.solid._replace(bottom=carriers[k][1]), self.view(placed, k)
                if item.known is None:
                    solid, _ = self.polished(solid, placed, k, (*view, 0.0))
                else:
                    _, solid = self.refine(item.known, solid, state_of(placed).rows, k, view, 200, 1.0 - sweep,
                                           SCALES / 6)  # fmt: skip
                placed[k] = replace(item, solid=solid)
        return placed

    def identities(self, placed: list[Placed], k: int) -> list[tuple[float, Placed]]:
        """Return (energy, Placed) of everything that number `k` might be instead, itself first."""
        view = self.view(placed, k)
        rows, anchor = state_of(placed).rows, placed[k].anchor
        own = placed[k]
        found = []
        if own.known is not None:
            energy, _ = self.refine(own.known, own.solid, rows, k, view, 1, 0.0)
            found.append((energy + self.settings.price, own))
        for known in self.library:
            if known is not own.known:
                energy, item = self.best_pose(known, anchor, placed, view, k)
                found.append((energy + self.settings.price, item))
        if self.others:
            item = self.unknown(anchor) if own.known is not None else own
            solid, energy = self.polished(item.solid, placed, k, (*view, 0.0))
            if self.settings.reduced:
                found = [(min(each, energy + self.settings.price) if self.as_large(other, solid.row) else each, other)
                         for each, other in found]  # fmt: skip
            energy += self.price_of_unknown(solid)
            found.insert(0 if own.known is None else len(found), (energy, replace(item, solid=solid)))
        return found


def identity_probabilities(found: list[tuple[float, Placed]], temper: float) -> np.ndarray:
    """Return the probabilities of identities from their energies."""
    energies = np.array([energy for energy, _ in found]) / temper
    weight = np.exp(-(energies - energies.min()))
    return weight / weight.sum()


STEPS = 6  # kinds of steps: along three axes, about three axes
SHORTEST, LONGEST = 5e-5, 0.03  # metres between which a step's standard deviation is adapted
ACCEPTANCE, GAIN = 0.25, 0.3  # wanted share of accepted steps; change of a log scale for one that is wrong by 1


@njit(cache=True, nogil=True)
def known_alone(image, meshes, row):
    """Return what `drawn_alone` does of a known object, the one of some Meshes, where a row has its proxy."""
    height, width = image.depth.shape
    pose, prepared, rectangle = np.empty((4, 4)), np.empty(PREPARED), np.empty(4, np.int64)
    pose_in(image.pose, row, pose)
    prepare_solid(MESH, pose, meshes.extents[0], image.camera, width, height, prepared, rectangle)
    left, right, top, bottom = rectangle
    buffer = np.zeros((bottom, right))
    draw_mesh(buffer, meshes, 0, meshes.extents[0], pose, image.camera, rectangle)
    return rectangle, buffer[top:, left:].copy()


@njit(cache=True, nogil=True)
def lowest_vertex(meshes, row):
    """Return the height over the floor of an object's lowest vertex."""
    low = np.inf
    for vertex in meshes.vertices:
        low = min(low, row[7] * vertex[0] + row[8] * vertex[1] + row[9] * vertex[2])
    return row[12] + low


@njit(cache=True, nogil=True)
def rotate_about(row, axis, angle):
    """Turn an object about an axis of the floor frame through its centre, in place."""
    c, s = np.cos(angle), np.sin(angle)
    a, b = 1 + 3 * ((axis + 1) % 3), 1 + 3 * ((axis + 2) % 3)
    for column in range(3):
        x, y = row[a + column], row[b + column]
        row[a + column], row[b + column] = c * x - s * y, s * x + c * y


@njit(cache=True, nogil=True)
def walk_known(rng, image, meshes, start, others, skip, depth, misfit, base, slack, tilt, scale, rounds,
               heat):  # fmt: skip
    """Return (row, energy) of the best that one object meets on an annealed walk from `start` (ROW,), the rest held
    still.

    Steps: along the floor's x, y, z; turns about the vertical and about the floor's x and y through the centre.

    others : (N, ROW), what it must not enter but `skip`. depth, misfit : (H, W) of the scene without it. base : height
        that its lowest point is held to, NaN for none. tilt : standard deviation of the radians by which it leans.
    scale : (6,) metres, of each step (turns: times 8 rad/m), changed in place. heat : temperature at the start, falling
        to 0.
    """
    row, trial, best, least = start.copy(), start.copy(), start.copy(), np.inf
    energy = np.inf
    down = 7 + np.argmax(np.abs(row[7:10]))
    for k in range(-1, rounds):  # the first time it is where it begins
        move, step = 0, 0.0
        if k >= 0:
            move = int(STEPS * rng.random())
            step = scale[move] * rng.standard_normal()
        trial[:] = row
        if move < 3:
            trial[10 + move] += step
        else:
            rotate_about(trial, 2 if move == 3 else move - 4, 8.0 * step)
        rectangle, drawn = known_alone(image, meshes, trial)
        change, low = change_by(image, rectangle, drawn, depth, misfit), lowest_vertex(meshes, trial)
        lean = np.arccos(min(abs(trial[down]), 1.0))
        new = change + (resting_energy(trial, low, others, skip, base, slack) + 0.5 * (lean / tilt) ** 2)
        temperature = heat * (1.0 - k / rounds)
        accepted = k < 0 or compiled_log_threshold(rng) * temperature < energy - new
        if accepted:
            row[:] = trial
            energy = new
            if energy < least:
                best[:] = row
                least = energy
        if k >= 0:
            adapted = compiled_adapted_scale(scale[move], 1.0 if accepted else 0.0, ACCEPTANCE, GAIN)
            scale[move] = min(max(adapted, SHORTEST), LONGEST)
    return best, least
