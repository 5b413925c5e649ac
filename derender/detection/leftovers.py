"""What may be otherwise: left over beyond doubt though no solid or thing pays its price, or a solid instead of a thing.

What is left over is clearly over the support, and neither a solid of the search nor a thing that pays its price.
That something is there is then beyond doubt, whatever it is: of what is far off the support the misfit, which counts a
pixel as an outlier at most, says too little where neighbouring pixels tell the same. So what is left costs LEFT_PRICE
only, be it a solid that fits or a free-form thing.

Rivals, a solid for a thing and a thing for a solid, are weighed as the search weighs them, by what they leave
unexplained and by what their numbers cost. What was found is never less likely than its rival: where it is by these
odds, the two are as likely as each other.
"""

from itertools import product
from typing import Any, NamedTuple

import numpy as np

from derender.camera.windows import shrunk
from derender.detection.compounds import goes_on, goes_on_from, joined
from derender.detection.freestanding import LEAST_EXISTENCE, existence_of, without_thing
from derender.detection.outline import ends_of
from derender.detection.search.bodies import body_hypotheses, box_about, bridged, label_bodies
from derender.detection.search.greedy import Settings, Task, complexity, greedy, sweep, total_energy, try_cubes
from derender.detection.search.moves import appear_on
from derender.detection.search.observation import Observation, patches_of
from derender.detection.search.proposals import all_hypotheses, make_surface, smallest_rectangle
from derender.detection.search.searches import Climb, explain_rest, merged
from derender.detection.segments import segments, two_sides
from derender.detection.solids.image import Image
from derender.detection.solids.interpenetration import highest, lowest
from derender.detection.solids.misfit import AS_SEEN, LIMIT
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import Solid, State, held_out, run_polish
from derender.detection.solids.support import assign_supports, share_over
from derender.detection.things import (
    BAD,
    BENEATH,
    ENDS,
    FEWEST,
    INNER,
    LARGEST,
    LEAST_HEIGHT,
    Cost,
    Thing,
    clear_of_edges,
    cost_of,
    made_thing,
    shows_below,
    standing,
)
from derender.results.fit import median
from derender.scene.pose import rotation_z

LEFT_PRICE = 10.0  # nats of a thing where something is there beyond doubt
LEFT_LEAST = 15.0  # nats of such a solid at least, unless
SAME = 0.75  # it shows where the thing does: share of the pixels of either that both have, at least
LEFT_PIXELS = 25  # that it has at least
# Of polishing a solid in its place; ways in which a box is turned at first; how many of all are looked at to the end.
ROUNDS, YAWS, FINISHED = 200, 6, 3
CUTS = (0.2, 0.35, 0.5, 0.65, 0.8)  # shares of the pixels on one side of the cuts through what may be two solids


def leftovers(
    rng: np.random.Generator, seen: Observation, state: State, settings: Settings
) -> tuple[Observation, State, list[Any], list[Any]]:
    """Return (Observation, State, [mask], [mask]) with what is clearly over the support and not explained yet: first
    objects, then what seems to be clutter.

    The image is changed as by `take_things`. What seems to be a seam along a silhouette stays as it is, with how
    probable it is an object after all.
    """
    image, before, found, clutter, seams = seen.image, len(state), [], [], []
    if settings.temper == 1.0 or not seen.mask.any():
        return seen, state, found, clutter
    depth, _, misfit, _ = held_out(image, state, -1)
    left = seen.mask & (misfit > BAD) & (image.depth < depth)
    cost = cost_of(seen, settings.believed.loose.things)
    piece, count = label_bodies(
        *bridged(seen.points, left, seen.surface.jump, seen.footprint, image.weight == 0, cost.believed.patch)
    )
    shows = seen.mask & ~left & (image.floor > depth)
    large = np.flatnonzero(np.bincount(piece[left], minlength=count) >= LEFT_PIXELS)
    for k in with_insides(seen, piece, left, large):
        misfit = held_out(image, state, -1)[2]
        whole, mask = piece == k, (piece == k) & left & (misfit > BAD)
        if mask.sum() < LEFT_PIXELS:  # solids that were found for others explain it
            continue
        low, high = ends_of(seen.points[mask], ENDS)
        if high[2] <= max(LEAST_HEIGHT * seen.scale, settings.uneven) or max(high[:2] - low[:2]) >= LARGEST:
            continue
        probability, _ = existence_of(seen, state, mask, settings, shows_below(seen, state, mask))
        exists = probability > LEAST_EXISTENCE
        if not exists:
            with_it, gained = with_solid(rng, seen, state, mask, settings)
            if gained > settings.temper * LEFT_LEAST and shows_alike(image, with_it, mask):  # as no clutter does
                state = with_it
                continue
        if not exists and (shrunk(whole, 1) & left).sum() < INNER * mask.sum():
            seams.append((mask, probability))
            continue
        part = None if exists else goes_on_from(seen, state, mask)
        if exists and goes_on(seen.surface, mask, shows, cost.normal):
            part = goes_on_from(seen, state, mask)
            if part is None or share_over(seen.points[mask], state.rows[part]) <= BENEATH:
                continue
        if part is not None:
            two = as_solids(rng, seen, state, part, mask, cost, settings)
            state, more = joined(seen, state, (part,), mask) if two is None else (two, [])
            found += more
            continue
        if exists:
            with_it, gained = with_solid(rng, seen, state, mask, settings)
            cheaper = gained - float(misfit[mask].sum()) + settings.temper * (LEFT_PRICE + cost.numbers(mask))
            if cheaper > 0.0 and (shows_alike(image, with_it, mask) or gained > settings.temper * LEFT_LEAST):
                state = with_it
                continue
        (found if exists else clutter).append(mask)
        image.floor[mask] = image.depth[mask] + 0.5 * AS_SEEN
    if len(state) > before:  # at the price that they were asked
        climb = Climb(rng, Task(image, settings._replace(price=settings.temper * LEFT_PRICE)), state)
        while any(map(climb.takes, merged(climb))):
            state = climb.state
    return seen._replace(clutter=tuple(seams)), state, found, clutter


def with_insides(seen: Observation, piece: np.ndarray, left: np.ndarray, large: np.ndarray) -> list[int]:
    """Return the numbers of the large pieces, the inside of a bowl being of its outside's from now on.

    piece : (H, W) int, changed. left : (H, W) bool, the pixels that tell. large : the pieces' numbers.
    """
    kept: list[int] = []
    for k in large.tolist():
        own = seen.points[(piece == k) & left]
        other = next((n for n in kept if two_sides(seen.points[(piece == n) & left], own, seen.image.origin)), None)
        if other is None:
            kept.append(k)
        else:
            piece[piece == k] = other
    return kept


def shows_alike(image: Image, state: State, mask: np.ndarray) -> bool:
    """Whether the last solid of a state shows where a mask (H, W) does, see SAME; nothing does where there is none."""
    shown = held_out(image, state, -1)[1] == len(state) - 1
    return bool((shown & mask).sum() > SAME * (shown | mask).sum())


def with_solid(
    rng: np.random.Generator, seen: Observation, state: State, mask: np.ndarray, settings: Settings
) -> tuple[State, float]:
    """Return (State, gain) with the solid that explains these pixels best, where LEFT_PRICE is all that one costs."""
    image, bottom = seen.image, standing(seen, state, mask)[1]
    before, tries = total_energy(image, state, settings), polished(rng, seen, state, -1, mask, bottom, settings)
    best, least = state, np.inf
    for *_, solid in tries[:FINISHED]:
        only = {len(state)}
        new = assign_supports(image, state.add(*solid), settings, only)
        sweep(rng, image, new, settings, ROUNDS, only=only)
        new = try_cubes(rng, image, new, settings, only=only)
        if (energy := total_energy(image, new, settings)) < least:
            best, least = new, energy
    return best, before - least + settings.price - settings.temper * LEFT_PRICE


def as_solids(rng: np.random.Generator, seen: Observation, state: State, part: int, mask: np.ndarray, cost: Cost,
              settings: Settings) -> State | None:  # fmt: skip
    """Return the State with two solids for what one of it, `part`, and a mask (H, W) beside that show; None where both
    as one free-form thing explain the image better, or not clearly worse.

    A search may have found one solid about two that touch, where that leaves less unexplained than another one costs.
    """
    fewer = state.without(part)
    _, label, misfit, _ = held_out(seen.image, state, -1)
    whole = mask | ((label == part) & (seen.image.weight > 0) & (misfit < LIMIT))
    other = seen.mask & ~whole & (misfit > BAD)  # the two are not to reach for it
    image = seen.image._replace(weight=np.where(other, 0.0, seen.image.weight))
    low = settings._replace(price=settings.temper * LEFT_PRICE)
    climb = Climb(rng, Task(image, low, solids_within(seen, whole, cost, settings)), state)
    climb.takes((greedy(rng, image, climb.task.hypotheses, low, fewer), None))
    explain_rest(climb)
    for each in cut_in_two(climb, fewer, seen.points[whole], max(lowest(state.rows[part]), 0.0))[:FINISHED]:
        climb.takes((each, {len(fewer), len(fewer) + 1}))
    least = total_energy(image, fewer, settings) - gain_of_thing(seen, fewer, whole, cost, settings)
    two = [(total_energy(image, each, settings), k, each)
           for k, (each, _) in enumerate(climb.pool) if len(each) == len(state) + 1]  # fmt: skip
    energy, _, best = min(two, default=(np.inf, 0, None))
    return best if energy < least - settings.temper * LEFT_LEAST else None


def cut_in_two(climb: Climb, state: State, points: np.ndarray, bottom: float) -> list[State]:
    """Return the States with two solids more, beside or on each other, that show points (K, 3) on either side of a cut
    across an axis of their box, the likeliest first. bottom : the height in metres on which the lower one stands."""
    turned, tries = points @ rotation_z(smallest_rectangle(points[:, :2]))[:3, :3], []
    for axis, share in product(range(3), CUTS):
        low = turned[:, axis] < np.quantile(turned[:, axis], share)
        if min(low.sum(), (~low).sum()) < FEWEST:
            continue
        one, _ = appear_on(climb.rng, climb.task, state, points[low], bottom)
        upon = highest(one.rows[-1]) if axis == 2 else bottom
        two, _ = appear_on(climb.rng, climb.task, one, points[~low], upon)
        tries.append((total_energy(climb.task.image, two, climb.task.settings), len(tries), two))
    return [two for *_, two in sorted(tries)]


def solids_within(seen: Observation, mask: np.ndarray, cost: Cost, settings: Settings) -> list[Solid]:
    """Return the hypotheses of solids that the pixels of a mask (H, W), or those of a piece of it, suggest."""
    footprint, sigma = (median(each[mask]) for each in (seen.footprint, seen.sigma))
    patches = patches_of(seen._replace(mask=mask))
    found = all_hypotheses(make_surface(seen.points, patches, seen.image.origin, footprint, sigma), settings.shapes)
    label, count, _ = segments(seen.surface, mask, cost.normal)
    for piece in (mask, *(label == k for k in range(count))):
        found += body_hypotheses(seen.points[piece], seen.image.origin, settings.shapes)
    return found


def polished(rng: np.random.Generator, seen: Observation, state: State, i: int, mask: np.ndarray, bottom: float,
             settings: Settings) -> list[tuple[float, int, Solid]]:  # fmt: skip
    """Return sorted (energy, number, Solid) of solids on a height that explain the pixels of a mask (H, W).

    i : index of the solid that they take the place of; -1: none.
    """
    image, points = seen.image, seen.points[clear_of_edges(seen, mask)[0]]
    view, tries = held_out(image, state, i), []
    hypotheses = list(body_hypotheses(points, image.origin, settings.shapes, bottom))
    if "box" in settings.shapes:
        turns = np.pi / 2 * np.arange(YAWS) / YAWS
        hypotheses += [Solid(box_about(points, yaw, bottom), UPRIGHT) for yaw in turns]
    for each in hypotheses:
        solid, energy = run_polish(rng, image, state, i, each._replace(bottom=bottom), view, settings, ROUNDS)
        tries.append((energy + complexity(solid, settings), len(tries), solid))
    return sorted(tries)


SURE = (1.0, 0.0)  # probability and error: whether something is there is not asked here


class Swap(NamedTuple):
    """What may be there instead of something that was found."""

    place: int  # index of the Observation's thing, or of the State's solid, that it takes the place of
    odds: float  # nats against that, 0 at most
    instead: State | Thing  # State of which the last is the solid; or the Thing


def swaps(rng: np.random.Generator, seen: Observation, state: State, settings: Settings) -> list[Swap]:
    """Return the Swaps of the things and of the solids on which nothing stands."""
    if seen.no_floor or not settings.free_forms:
        return []
    cost = cost_of(seen, settings.believed.loose.things)
    found = []
    for place, thing in enumerate(seen.things):
        there = seen._replace(image=without_thing(seen.image, thing.mask))
        new, gain = with_solid(rng, there, state, thing.mask, settings)
        if len(new) > len(state):
            gain += settings.temper * LEFT_PRICE - settings.price
            odds = (gain - gain_of_thing(there, state, thing.mask, cost, settings)) / settings.temper
            found.append(Swap(place, min(odds, 0.0), new))
    _, label, misfit, _ = held_out(seen.image, state, -1)
    whole = total_energy(seen.image, state, settings)
    for place in set(range(len(state))) - set(state.parents):
        mask = (label == place) & (seen.image.weight > 0) & (misfit < LIMIT)
        if mask.sum() < FEWEST:
            continue
        left = state.without(place)
        gain = gain_of_thing(seen, left, mask, cost, settings)
        odds = (gain + whole - total_energy(seen.image, left, settings)) / settings.temper
        found.append(Swap(place, min(odds, 0.0), made_thing(seen, left, mask, SURE)))
    return found


def gain_of_thing(seen: Observation, state: State, mask: np.ndarray, cost: Cost, settings: Settings) -> float:
    """Return the tempered nats by which a free-form thing explains the pixels of a mask (H, W) better than nothing."""
    misfit = held_out(seen.image, state, -1)[2]
    price = settings.price_of_box + settings.temper * cost.numbers(mask)
    return float((misfit - cost.misfit)[mask].sum()) - price
