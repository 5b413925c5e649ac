"""From a depth image to the one state that explains it best: observe, propose, search, tell things from background."""

import contextlib
from copy import deepcopy
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.compounds import compounds, open_boxes, with_borne
from derender.detection.floor import NoFloor
from derender.detection.freestanding import freestanding, returns_about
from derender.detection.leftovers import leftovers
from derender.detection.levels import floor_below
from derender.detection.patches import SeenSurface
from derender.detection.pyramid import reduced_by
from derender.detection.search.bodies import body_hypotheses, find_bodies
from derender.detection.search.greedy import Settings, settle, total_energy
from derender.detection.search.observation import CORRELATED, Observation, Support, observe, patches_of
from derender.detection.search.proposals import all_hypotheses, make_surface
from derender.detection.search.searches import Interrupted, first_search, search
from derender.detection.solids.state import State, held_out
from derender.detection.solids.support import final_parents
from derender.detection.things import BAD, likely_things, take_things, without_background
from derender.errors import DerenderError
from derender.results.fit import median, sensor_deviation

NOISES = 3.0  # standard deviations of the noise that a floor is at least uneven by
# Pixels of what stands on the floor that are enough of a sensor's images, and of those whose noise is independent.
ENOUGH, FEW = 2500, 500
# Pixels along the longer side of the image that is searched, and where few of its pixels show something.
WIDEST, MOST = 160, 320
# Nats by which a free-form thing must be better than solids that are not searched for to the end; where noise is
# independent: of 60 made scenes of solids one was better, by 26; of ten of household things seven, by 80 and more.
RELUCTANT, RELUCTANT_ALONE = 20.0, 60.0
AGAIN = 2  # searches more, at most, of an image of independent noise that solids do not explain
SPECKLED = 0.8  # share of the neighbours of pixels with a depth that have one too: of fewer no surfaces can be made
FILLED = 0.4  # share of the image from which on solids are so near that half the resolution tells as much


def point_estimate(
    rng: np.random.Generator,
    depth: np.ndarray,
    camera: Camera,
    settings: Settings | None = None,
    pool: list[tuple[State, float]] | None = None,
    plane: Any = None,
) -> tuple[State, Observation]:
    """Return the best explanation of a depth image (H, W) in metres, NaN = no return, and what was observed.

    A floor on which nothing stands may be the top of what does: that is another explanation, on the floor below.

    pool : takes the states that searches end with, with their energies. plane : the floor as it is given, see
    detection.floor.read_floor, or a Support; None: find it.
    """
    settings, pool = Settings() if settings is None else settings, [] if pool is None else pool
    state, seen = on_one_floor(rng, depth, camera, settings, pool, plane)
    if seen.things and settings.tries > 1 and closer_tells(seen, depth):
        pool.clear()
        state, seen = on_one_floor(rng, depth, camera, settings, pool, plane, least=MOST)
    below = floor_below(seen) if plane is None and not (len(state) or seen.things or seen.interrupted) else None
    if below is None:
        return state, seen
    others: list[tuple[State, float]] = []
    try:
        higher, other = on_one_floor(rng, depth, camera, settings, others, below, seen.correlation)
    except DerenderError:  # next to nothing shows of it
        return state, seen
    if len(higher) == 0 or explained(other, higher) <= explained(seen, state):
        return state, seen
    pool[:] = others
    return higher, other


def closer_tells(seen: Observation, depth: np.ndarray) -> bool:
    """Whether free-form things may be solids as they look in a reduced image of independent noise.

    A block across an edge errs by more than its noise. A free form explains that and a solid does not: a cube in 560
    blocks is 40 nats the worse for it.
    """
    return seen.correlation <= CORRELATED and not seen.interrupted and reduced_by(depth, MOST) < seen.factor


def explained(seen: Observation, state: State) -> float:
    """Return the share of an Observation's pixels that its floor and the solids on it explain."""
    misfit = held_out(seen.image, state, -1)[2]
    good = seen.image.weight > 0
    return float((good & ~seen.behind & (misfit < BAD)).sum() / max(good.sum(), 1))


def on_one_floor(
    rng: np.random.Generator,
    depth: np.ndarray,
    camera: Camera,
    settings: Settings,
    pool: list[tuple[State, float]],
    plane: Any,
    correlation: float | None = None,
    least: int = 0,
) -> tuple[State, Observation]:
    """As `point_estimate`, over the floor that is given or found, in an image of at `least` so many columns.

    correlation : of its noise, where so little of that floor shows that it does not tell, for what stands there fills
        the view; None: it tells.
    """
    fills = correlation is not None
    floor = settings.believed.loose.floor
    seen = observe(depth, camera, WIDEST, plane, settings.may_float, fills, floor, settings.shared)
    if seen.no_floor and settings.free_forms:
        if returns_about(seen) < SPECKLED:
            coarser = observe(depth, camera, WIDEST // 2, plane, settings.may_float, believed=floor)
            seen = coarser if coarser.no_floor else seen
        return State(), with_freestanding(seen, settings)
    wanted = max(width_wanted(seen), least)
    if reduced_by(depth, wanted) != seen.factor:
        same = Support.over(seen.floor) if seen.rivals else plane  # the choice among floors is made once
        with contextlib.suppress(NoFloor):  # it is one in this resolution
            closer = observe(depth, camera, wanted, same, settings.may_float, fills, floor, settings.shared)
            if not closer.no_floor:  # whose few pixels may not tell what noise it has
                seen = closer._replace(rivals=seen.rivals, correlation=max(seen.correlation, closer.correlation))
    if correlation is not None:
        seen = seen._replace(correlation=correlation)
    settings = settings_for(settings, seen)
    patches = patches_of(seen)
    typical = median(seen.footprint[seen.mask]) if seen.mask.any() else 0.005
    noise = median(seen.sigma[seen.mask]) if seen.mask.any() else 0.001
    settings = settings._replace(uneven=max(settings.uneven, NOISES * noise))
    surface = make_surface(seen.points, patches, seen.image.origin, typical, noise)
    hypotheses = all_hypotheses(surface, settings.shapes)
    for body in find_bodies(seen.points, seen.mask, seen.footprint):
        hypotheses.extend(body_hypotheses(body, seen.image.origin, settings.shapes))
    masks: list[Any] = []
    clutter: list[Any] = []
    in_vain = False
    try:
        first, alone = State(), seen.correlation <= CORRELATED
        if settings.free_forms and not (alone and settings.tries == 1):  # a single search has them looked for after it
            own = deepcopy(rng) if alone else rng  # where it finds no thing the search goes on as if it had not been
            first = first_search(own, seen.image, hypotheses, settings)
            first, masks = take_things(seen, first, settings, RELUCTANT_ALONE if alone else RELUCTANT)
        if settings.free_forms and (masks or not alone):
            state, image, agreed = search(rng, seen.image, hypotheses, settings, pool, first)
        else:
            state, image, agreed, in_vain = searched_well(rng, seen, hypotheses, settings, pool)
        seen = seen._replace(image=image, agreed=agreed)
    except Interrupted as stopped:
        state, image = stopped.state, stopped.image
        seen = seen._replace(image=image, interrupted=True)
    if settings.free_forms:
        state, more = (state, []) if in_vain else take_things(seen, state, settings)
        masks += more
        if more and len(state):
            state = settle(rng, image, state, settings)
        seen, state, more, clutter = leftovers(rng, seen, state, settings)
        masks += more
        if seen.correlation > CORRELATED:
            seen, state, masks = without_background(seen, state, masks, settings)
            state.parents = final_parents(state)
        state, masks = open_boxes(seen, state, masks)
        if seen.correlation > CORRELATED:
            state, masks = compounds(seen, state, masks)
            seen, masks = with_borne(seen, masks)
    state.parents = final_parents(state)
    state = state.ordered()
    seen, things = likely_things(seen, state, masks + clutter, settings)
    return state, seen._replace(things=tuple(things))


def with_freestanding(seen: Observation, settings: Settings) -> Observation:
    """Return the Observation of an image without a floor with what stands free of its surroundings as its things."""
    good = seen.image.weight > 0
    deviation = sensor_deviation(seen.image.depth)
    surface = SeenSurface.of(seen.points, good, seen.footprint, deviation, seen.image.origin)  # type: ignore[arg-type]
    masks = freestanding(surface, settings.believed.loose.things)
    if masks:
        seen = seen._replace(behind=good & ~np.any(masks, axis=0))
    seen, things = likely_things(seen, State(), masks, settings)
    return seen._replace(things=tuple(things))


def searched_well(
    rng: np.random.Generator, seen: Observation, hypotheses: list[Any], settings: Settings, pool: list[Any]
) -> tuple[State, Any, bool, bool]:
    """As `search`, again while it leaves what only a free-form thing would explain, and noise has no such forms.

    Returns besides whether such things were looked for at last, in vain.
    """
    state, image, agreed = search(rng, seen.image, hypotheses, settings, pool)
    for _ in range(AGAIN if settings.temper == 1.0 and settings.free_forms and settings.tries > 1 else 0):
        kept = image._replace(floor=image.floor.copy())  # taking things changes the image
        left, things = take_things(seen._replace(image=kept), state, settings)
        if not things:
            return left, image, agreed, True
        pool.append((state, total_energy(image, state, settings)))
        other, focus, agreed = search(rng, seen.image, hypotheses, settings, pool)
        if total_energy(focus, other, settings) < total_energy(image, state, settings):
            state, image = other, focus
    return state, image, agreed, False


def settings_for(settings: Settings, seen: Observation) -> Settings:
    """Return the Settings for an Observation: a sensor's neighbouring pixels tell the less the more there are."""
    settings = settings.for_correlation(seen.correlation)
    columns = settings.believed.loose.shared.columns
    if seen.correlation > CORRELATED and (longer := max(seen.camera.shape)) > columns:
        settings = settings.for_pixels((longer / columns) ** 2)
    return settings


def width_wanted(seen: Observation) -> int:
    """Return how many columns an image should have in which what stands on the floor has as many pixels as it takes.

    Where it fills the image, half as many tell as much; where it is small, more columns tell what it is. A sensor's
    neighbouring pixels say little of their own, so that its images take more of them.
    """
    pixels = int(seen.mask.sum())
    if seen.mask.mean() > FILLED:
        return WIDEST // 2
    enough = ENOUGH if seen.correlation > CORRELATED else FEW
    return int(WIDEST * np.clip(np.sqrt(enough / max(pixels, 1)), 1.0, MOST / WIDEST))
