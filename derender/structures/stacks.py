"""Two solids, one on the other, in place of one solid or free-form thing, where the sensor's likelihood has it so.

Where neighbouring pixels share noise the search asks of each solid what small ones cannot pay, and tells a stack as one
solid or thing. Here all three are weighed as the posterior weighs them; one solid may lean, for two follow what leans
in steps by 30 to 80 nats better than an upright one. Two explain real things, which are no such solids exactly, by up
to 36 nats more still (made stacks by 21 to 450): a bottle or a book stays one, for the second has to gain what the
search asks of any solid, and both have to be off the image no farther than INEXACT says.
"""

from collections.abc import Iterable
from functools import partial
from itertools import product

import numpy as np

from derender.detection.compounds import FLUSH, an_l, neck
from derender.detection.freestanding import without_thing
from derender.detection.leftovers import LEFT_PIXELS, polished
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import CORRELATED, Observation
from derender.detection.solids.interpenetration import highest, lowest
from derender.detection.solids.misfit import AS_SEEN
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State, held_out
from derender.detection.solids.support import final_parents, with_bottom
from derender.detection.things import THINNEST, cost_of
from derender.results.fit import smooth_surface
from derender.scene.solids import BOX, SPHERE
from derender.structures.alternatives import QUICK, unclimbed
from derender.structures.draws.chart import make_chart
from derender.structures.draws.refined import (
    ANNEALING,
    Refined,
    at_mode,
    floor_pose_of,
    height,
    near_evidence,
    refine,
    view_of,
)

# Times as far as half of the floor's pixels are off it half of those of a solid are that may be two, at least; and of
# each of two, at most: what is no such solid exactly, a bottle or a book, is none of two either.
EXACT, INEXACT = 1.05, 2.0
# Of the stacks of each pair of kinds that are climbed, and of those that are climbed farther; times as far off as after
# that they may be before it: of those that ended as stacks all were less than 2.6 times.
TRIED, ROUGHLY = 2, 3.0
LOWEST = 0.02  # metres that each of two is high, at least
CUTS = (0.25, 0.4, 0.5, 0.6, 0.75)  # of the height of what shows at which it is cut in two


def with_stacks(
    rng: np.random.Generator, seen: Observation, state: State, settings: Settings
) -> tuple[Observation, State, Refined | None]:
    """Return (Observation, State) with stacks of two for those things and solids that these explain better, and
    the State's Refined where it was made: where there is something to look at, and it stays as it is."""
    if seen.correlation <= CORRELATED or seen.no_floor or seen.interrupted or not settings.free_forms:
        return seen, state, None
    bears = {thing.parent for thing in seen.things}  # things: solids that stand on it go up with its top
    looked_at = inexact(
        seen, state, [k for k, row in enumerate(state.rows) if int(row[0]) != SPHERE and k not in bears]
    )
    if not (seen.things or looked_at):
        return seen, state, None
    refined = refine(rng, [view_of(seen)], seen.floor.pose, state, settings.rules, settings.tries)
    if len(refined.state) != len(state):
        return seen, state, refined
    things, found = [], refined.state
    for thing in seen.things:
        there, bottom = seen._replace(image=without_thing(seen.image, thing.mask)), lowest(thing.row)
        one = found.add(thing.row, UPRIGHT, False, thing.parent, bottom)
        two = as_stack(rng, there, refined, one, len(found), thing.mask, settings)
        if two is None:
            things.append(thing)
        else:
            seen, found = there, two
    looked_at += inexact(seen, found, range(len(state), len(found)))
    for k, shown in looked_at:
        two = as_stack(rng, seen, refined, found, k, shown, settings)
        if two is not None:
            found = two
            looked_at += inexact(seen, found, (k, len(found) - 1))
    if len(found) == len(state):
        return seen, state, refined
    found.parents = final_parents(found)
    order = found.in_order()
    things = [each._replace(parent=order.index(each.parent) if each.parent in order else each.parent)
              for each in things]  # fmt: skip
    return seen._replace(things=tuple(things)), found.ordered(), None


def inexact(seen: Observation, state: State, solids: Iterable[int]) -> list[tuple[int, np.ndarray]]:
    """Return those of some solids that are not EXACT, each with the mask (H, W) of what stands where it shows."""
    label, bad = badness(seen, state)
    found = [(k, seen.mask & (label == k)) for k in solids if EXACT < bad[k] < np.inf]
    return [(k, mask) for k, mask in found if mask.sum() >= LEFT_PIXELS]


def badness(seen: Observation, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return label (H, W), k where solid k shows, and (N,) how many times as far as half of the floor's pixels are off
    it half of each solid's are off that: 1 of what is exactly such a solid, inf where that is not told."""
    _, label, misfit, _ = held_out(seen.image, state, -1)
    label = np.where(seen.image.weight > 0.0, label, len(state))
    as_seen = np.abs(seen.image.floor - seen.image.depth) < AS_SEEN
    floor = misfit[~as_seen & seen.floor.inliers & (label == FLOOR)]
    shown = [misfit[label == k] for k in range(len(state))]
    tells = [len(floor) > 0 and len(each) >= LEFT_PIXELS for each in shown]
    found = [np.sqrt(np.median(each) / np.median(floor)) if told else np.inf
             for each, told in zip(shown, tells, strict=True)]  # fmt: skip
    return label, np.array(found)


def as_stack(rng: np.random.Generator, seen: Observation, refined: Refined, state: State, i: int,
             shown: np.ndarray, settings: Settings) -> State | None:  # fmt: skip
    """Return the State in which solid `i`, which shows in a mask (H, W), is two, both upright, the upper the last; None
    where it is likelier as one, or as a free-form surface."""
    view, rules, floor = view_of(seen), settings.rules, floor_pose_of(refined)
    sensor, both = refined.sensor._replace(observed=view.observed, beside=None).changed(), (i, len(state))

    def exact(state: State, most: float) -> bool:
        """Whether both are high enough, and off the image no farther."""
        high = state.rows[list(both), 15].min() > LOWEST * seen.scale
        return bool(high and badness(seen, state)[1][list(both)].max() < most)

    upright = state.changed(i, form=UPRIGHT, cube=False, bottom=lowest(state.rows[i]))
    rows = best_upright(rng, seen, upright, i, shown, upright.bottoms[i], settings)
    twos = stacks(rng, seen, shown, upright, i, rows, settings) if rows and len(state) < settings.max_objects else []

    def climbed(states: list[State], places: tuple[int, ...]) -> list[Refined]:
        """Return the Refined, climbed, of the TRIED of each form and pair of kinds that are likeliest before."""
        start: dict[tuple, list[Refined]] = {}
        for trial in sorted((unclimbed(each, floor, sensor, rules) for each in states), key=height, reverse=True):
            start.setdefault((trial.state.forms[i], *trial.state.rows[list(places), 0]), []).append(trial)
        return [at_mode(rng, each.state, floor, sensor, rules, QUICK, list(places))
                for alike in start.values() for each in alike[:TRIED]]  # fmt: skip

    def likeliest(found: list[Refined], places: tuple[int, ...]) -> tuple[Refined, float]:
        """Return the Refined that is likeliest once the TRIED best of some are climbed farther, and its evidence."""
        farther = partial(at_mode, rng, floor_pose=floor, sensor=sensor, rules=rules, steps=2 * ANNEALING,
                          only=list(places), temperatures=())  # fmt: skip
        best = max((farther(each.state) for each in sorted(found, key=height)[-TRIED:]), key=height)
        return best, near_evidence(best, places)

    likely_enough = climbed([each for each in twos if exact(each, ROUGHLY * INEXACT)], both)
    found = [each for each in likely_enough if exact(each.state, INEXACT)]
    if not found:
        return None
    two, likely = likeliest(found, both)
    lower, upper = two.state.rows[list(both)]
    rows += [with_bottom(row, lowest(lower), highest(upper)) for row in (lower, upper)]
    leaning = upright.changed(i, form=FREE, bottom=np.nan)
    ones = [state, *(each.changed(i, row=row) for each in (upright, leaning) for row in rows)]
    one, alone = likeliest(climbed(ones, (i,)), (i,))
    left = make_chart(state.without(i), floor, rules)
    free = np.where(shown, smooth_surface(seen.image.depth, shown), sensor.clean(*left))
    numbers = cost_of(seen, settings.believed.loose.things).numbers(shown) + 0.5 * sensor.worth * shown.sum()
    surface = alone - one.log_likelihood + sensor.likelihood.log_density(sensor.observed, free, sensor.values) - numbers
    asked = settings.price / settings.temper  # of a solid, in nats of the likelihood
    better = likely > max(alone, surface) + asked and not parts_of_one(two.state, i, FLUSH * seen.scale)
    return two.state if better else None


def parts_of_one(state: State, i: int, flush: float) -> bool:
    """Whether solid `i` and the last one, which stands on it, rather are one thing: a bottle and its neck, or an L."""
    lower, upper = state.rows[i], state.rows[-1]
    if int(lower[0]) != BOX or int(upper[0]) != BOX:
        return neck(state) == (len(state) - 1, i)
    return an_l(lower, upper, True, flush)


def stacks(rng: np.random.Generator, seen: Observation, shown: np.ndarray, state: State, i: int,
           whole: list[np.ndarray], settings: Settings) -> list[State]:  # fmt: skip
    """Return the States in which upright solid `i`, which shows in a mask (H, W), is two, cut at some height.
    whole : rows of solids that explain all of it: of the lower one little may show.
    """
    heights, bottom, states = seen.points[..., 2], lowest(state.rows[i]), []
    for cut in bottom + np.array(CUTS) * (float(np.quantile(heights[shown], 0.98)) - bottom):
        above, below = shown & (heights > cut), shown & (heights <= cut)
        if min(above.sum(), below.sum()) < LEFT_PIXELS:
            continue
        lowers = [with_bottom(row, bottom, cut) for row in whole]
        there = state.changed(i, row=lowers[0])
        uppers = best_upright(rng, seen, there, -1, above, cut, settings)
        lowers += best_upright(rng, taken_as_seen(seen, above), state, i, below, bottom, settings)
        for lower, upper in product(lowers, uppers):
            new, level = state.changed(i, row=lower), highest(lower)
            new.parents = [len(state) if parent == i else parent for parent in new.parents]
            upper = with_bottom(upper, level, max(highest(upper), level + THINNEST))
            states.append(new.add(upper, UPRIGHT, False, i, level))
    return states


def taken_as_seen(seen: Observation, mask: np.ndarray) -> Observation:
    """Return the Observation in which what a mask (H, W) shows is explained already."""
    floor = np.where(mask, seen.image.depth + 0.5 * AS_SEEN, seen.image.floor)
    return seen._replace(image=seen.image._replace(floor=floor))


def best_upright(rng: np.random.Generator, seen: Observation, state: State, i: int, shown: np.ndarray, bottom: float,
                 settings: Settings) -> list[np.ndarray]:  # fmt: skip
    """Return the row of the upright solid of each kind that explains a mask (H, W) best, the best first: see
    `polished`."""
    best: dict[int, np.ndarray] = {}
    upright = settings._replace(shapes=tuple(shape for shape in settings.shapes if shape != "sphere"))
    for *_, solid in polished(rng, seen, state, i, shown, bottom, upright):
        if solid.form == UPRIGHT:
            best.setdefault(solid.kind, solid.row)
    return list(best.values())
