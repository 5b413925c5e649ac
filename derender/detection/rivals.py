"""What a free-form thing may be instead, a solid, and a solid a free-form thing: each with its odds.

Both are weighed as the search weighs them, by what they leave unexplained and by what their numbers cost. What was
found is never less likely than its rival: where it is by these odds, the two are as likely as each other.
"""

from typing import NamedTuple

import numpy as np

from derender.detection.leftovers import LEFT_PRICE, with_solid
from derender.detection.search.bodies import APART
from derender.detection.search.greedy import Settings, complexity, total_energy
from derender.detection.search.observation import Observation
from derender.detection.solids.image import FAR, Image
from derender.detection.solids.misfit import LIMIT
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import State, held_out
from derender.detection.things import FEWEST, Cost, Thing, cost_of, made_thing
from derender.scene.solids import BOX

SURE = (1.0, 0.0)  # probability and error: whether something is there is not asked here


class Swap(NamedTuple):
    """What may be there instead of something that was found.

    Attributes
    ----------
    place : index of the Observation's thing, or of the State's solid, that it takes the place of.
    odds : nats against that, 0 at most. instead : State of which the last is the solid; or the Thing.
    """

    place: int
    odds: float
    instead: State | Thing


def swaps(rng: np.random.Generator, seen: Observation, state: State, settings: Settings) -> list[Swap]:
    """Return the Swaps of the things and of the solids on which nothing stands."""
    if seen.no_floor or not settings.free_forms:
        return []
    jump = np.ascontiguousarray(APART * seen.footprint + 3.0 * seen.sigma)
    cost = cost_of(seen, jump, settings.believed.loose.things)
    found = []
    for place, thing in enumerate(seen.things):
        there = seen._replace(image=without_thing(seen.image, thing))
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


def without_thing(image: Image, thing: Thing) -> Image:
    """Return an Image with the floor where a thing was taken as it is seen."""
    with np.errstate(divide="ignore"):
        floor = -image.origin[2] / image.direction[..., 2]
    floor = np.where((floor > 0.0) & (floor < FAR), floor, FAR)
    return image._replace(floor=np.where(thing.mask, floor, image.floor))


def gain_of_thing(seen: Observation, state: State, mask: np.ndarray, cost: Cost, settings: Settings) -> float:
    """Return the tempered nats by which a free-form thing explains the pixels of a mask (H, W) better than nothing."""
    misfit = held_out(seen.image, state, -1)[2]
    price = complexity(BOX, UPRIGHT, False, settings) + settings.temper * cost.numbers(mask)
    return float((misfit - cost.misfit)[mask].sum()) - price
