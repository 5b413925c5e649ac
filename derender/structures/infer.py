"""From a bare depth image to a posterior over scene graphs: observe, propose, search, sample."""

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from derender.detection.compounds import compounds
from derender.detection.existence import returns_about
from derender.detection.floor import read_floor, sensor_deviation
from derender.detection.freestanding import freestanding
from derender.detection.leftovers import leftovers
from derender.detection.pyramid import reduced_by
from derender.detection.search.bodies import APART, body_hypotheses, find_bodies
from derender.detection.search.greedy import Settings, settle, total_energy
from derender.detection.search.observation import CORRELATED, Observation, observe, of_whole_image, patches_of
from derender.detection.search.proposals import all_hypotheses
from derender.detection.search.searches import Interrupted, first_search, search
from derender.detection.search.surface import make_surface
from derender.detection.solids.beliefs import bare_image, beliefs_of
from derender.detection.solids.misfit import AS_SEEN
from derender.detection.solids.state import State
from derender.detection.solids.support import final_parents
from derender.detection.things import likely_things, take_things, without_background
from derender.detection.unit import in_metres, unit_of
from derender.errors import DerenderError
from derender.results.explanation import Explanation
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse
from derender.scene.priors.bare_image import BareImagePrior, Missed
from derender.structures.options import Frame, Options

if TYPE_CHECKING:
    from derender.results.posterior import StructurePosterior
    from derender.structures.together import Look

NOISES = 3.0  # standard deviations of the noise that a floor is at least uneven by
# Pixels of what stands on the floor that are enough of a sensor's images, and of those whose noise is independent; by
# how many times more columns than usual are looked at for them.
ENOUGH, FEW, FINEST = 2500, 500, 2.0
WIDEST = 160  # columns of the image that is searched
RELUCTANT = 20.0  # nats by which a free-form thing must be better than solids that are not searched for to the end
AGAIN = 2  # searches more, at most, of an image of independent noise that solids do not explain
SPECKLED = 0.8  # share of the neighbours of pixels with a depth that have one too: of fewer no surfaces can be made
EXPLAINED = 0.95  # share of the pixels that known objects explain at least, where nothing is taken to be missed
FILLED = 0.4  # share of the image from which on solids are so near that half the resolution tells as much


def point_estimate(rng, depth, camera, settings=None, widest=WIDEST, pool=None, plane=None):
    """Return (state, observation): the best explanation of a depth image (H, W) in metres, NaN = no return.

    plane : the floor as it is given, see detection.floor.read_floor; None: find it.
    """
    settings, pool = Settings() if settings is None else settings, [] if pool is None else pool
    seen = observe(depth, camera, widest, plane, settings.may_float)
    if seen.no_floor and settings.free_forms:
        if returns_about(seen) < SPECKLED:
            coarser = observe(depth, camera, widest // 2, plane, settings.may_float)
            seen = coarser if coarser.no_floor else seen
        return State(), with_freestanding(seen, settings)
    wanted = width_wanted(seen, widest)
    if reduced_by(depth, wanted) != seen.factor:
        closer = observe(depth, camera, wanted, plane, settings.may_float)
        seen = seen if closer.no_floor else closer
    settings = settings_for(settings, seen)
    patches = patches_of(seen)
    typical = float(np.median(seen.footprint[seen.mask])) if seen.mask.any() else 0.005
    noise = float(np.median(seen.sigma[seen.mask])) if seen.mask.any() else 0.001
    settings = settings._replace(uneven=max(settings.uneven, NOISES * noise))
    surface = make_surface(seen.points, patches, seen.image.origin, typical, noise)
    hypotheses = all_hypotheses(surface, settings.shapes)
    for body in find_bodies(seen.points, seen.mask, seen.footprint):
        hypotheses.extend(body_hypotheses(body, seen.image.origin, settings.shapes))
    masks: list = []
    try:
        if settings.free_forms and seen.correlation > CORRELATED:
            first = first_search(rng, seen.image, hypotheses, settings)
            first, masks = take_things(seen, first, settings, RELUCTANT)
            state, image, agreed = search(rng, seen.image, hypotheses, settings, pool, first)
        else:
            state, image, agreed = searched_well(rng, seen, hypotheses, settings, pool)
        seen = seen._replace(image=image, agreed=agreed)
    except Interrupted as stopped:
        state, image = stopped.state, stopped.image
        seen = seen._replace(image=image, interrupted=True)
    if settings.free_forms:
        state, more = take_things(seen, state, settings)
        masks += more
        if more and len(state):
            state = settle(rng, image, state, settings)
        state, more = leftovers(rng, seen, state, settings)
        masks += more
        if seen.correlation > CORRELATED:
            seen, state, masks = without_background(seen, state, masks)
            state.parents = final_parents(state)
            state, masks = compounds(seen, state, masks)
    state.parents = final_parents(state)
    state = state.ordered()
    seen, things = likely_things(seen, state, masks, settings)
    return state, seen._replace(things=tuple(things))


def with_freestanding(seen: Observation, settings: Settings) -> Observation:
    """Return the Observation of an image without a floor with what stands free of its surroundings as its things.

    What such a piece explains cannot be told without what else might be there: it counts as much as leaves it open.
    """
    good = seen.image.weight > 0
    jump = np.ascontiguousarray(APART * seen.footprint + 3.0 * sensor_deviation(seen.image.depth))
    masks = freestanding(seen.points, good, jump, seen.footprint, seen.image.origin)
    if masks:
        seen = seen._replace(behind=good & ~np.any(masks, axis=0))
    beliefs = bare_image() if settings.beliefs is None else settings.beliefs
    even = beliefs.loose.existence.even * settings.temper
    seen, things = likely_things(seen, State(), [(mask, even) for mask in masks], settings)
    return seen._replace(things=tuple(things))


def searched_well(
    rng: np.random.Generator, seen: Observation, hypotheses: list[Any], settings: Settings, pool: list[Any]
) -> tuple[State, Any, bool]:
    """As `search`, again while it leaves what only a free-form thing would explain, and noise has no such forms."""
    state, image, agreed = search(rng, seen.image, hypotheses, settings, pool)
    for _ in range(AGAIN if settings.temper == 1.0 and settings.free_forms and settings.tries > 1 else 0):
        kept = image._replace(floor=image.floor.copy())  # taking things changes the image
        if not take_things(seen._replace(image=kept), state, settings)[1]:
            break
        pool.append((state, total_energy(image, state, settings)))
        other, focus, agreed = search(rng, seen.image, hypotheses, settings, pool)
        if total_energy(focus, other, settings) < total_energy(image, state, settings):
            state, image = other, focus
    return state, image, agreed


def settings_for(settings: Settings, seen: Observation) -> Settings:
    """Return the Settings for an Observation: a sensor's neighbouring pixels tell the less the more there are."""
    settings = settings.for_correlation(seen.correlation)
    if seen.correlation > CORRELATED and seen.camera["width"] > WIDEST:
        settings = settings.for_pixels((seen.camera["width"] / WIDEST) ** 2)
    return settings


def width_wanted(seen: Observation, widest: int) -> int:
    """Return how many columns an image should have in which what stands on the floor has as many pixels as it takes.

    Where it fills the image, half as many tell as much; where it is small, more columns tell what it is. A sensor's
    neighbouring pixels say little of their own, so that its images take more of them.
    """
    pixels = int(seen.mask.sum())
    if seen.mask.mean() > FILLED:
        return widest // 2
    enough = ENOUGH if seen.correlation > CORRELATED else FEW
    return int(widest * np.clip(np.sqrt(enough / max(pixels, 1)), 1.0, FINEST))


def settings_of(options: Options) -> Settings:
    """Return the Settings that Options ask for; an open prior among them says what it allows.

    Of a prior the search takes which shapes there are, how many objects at most, whether they may interpenetrate (no
    term `no-overlap`) and float (a contact `6dof` and no term `no-floating`); weights and draws take its sizes. An
    option is stricter or looser still.
    """
    settings = Settings()
    prior = options.prior
    if prior is not None:
        kinds = {entry.type for entry in prior.shapes.values()}
        terms = {term.name: term for term in prior.constraints}
        if not kinds & set(settings.shapes):
            remedy = "the search knows " + ", ".join(settings.shapes)
            raise DerenderError("the prior has no shape that can be looked for", "shapes", remedy)
        settings = settings._replace(
            beliefs=beliefs_of(prior, options.likelihood),
            shapes=tuple(name for name in settings.shapes if name in kinds),
            may_overlap="no-overlap" not in terms,
            may_float="no-floating" not in terms and any(rule.type == "6dof" for rule in prior.contacts.rules),
        )
        if "at-most" in terms:
            settings = settings._replace(max_objects=terms["at-most"].count)
    if options.shapes:
        settings = settings._replace(shapes=tuple(options.shapes))
    if options.max_objects:
        settings = settings._replace(max_objects=options.max_objects)
    said = options.shapes or options.known or not isinstance(prior, BareImagePrior | None)
    if said or (isinstance(options.floor, str) and options.floor == "none"):
        settings = settings._replace(free_forms=False)  # what there may be is said, or nothing that it could stand on
    if options.quick:
        settings = settings._replace(tries=1)
    return settings._replace(
        may_overlap=settings.may_overlap or options.may_overlap, may_float=settings.may_float or options.may_float
    )


def infer_structure(image, camera, options=None, rng=None, progress=None):
    """Infer which solids are there and what rests on what.

    Parameters
    ----------
    image : (H, W) float metres, NaN or 0 = no return.
    camera : Camera, or a dict with fx, fy, cx, cy.
    options : Options; None: all as it comes.
    rng : numpy Generator; progress : called with (fraction done, message), or None.

    Returns a Posterior; on Ctrl-C, once something was found, that of the best scene so far, its meta "interrupted".
    """
    from derender.detection.solids.graph import without_floor
    from derender.results.posterior import Posterior
    from derender.structures.bridges import with_bridges
    from derender.structures.free_forms import thing_name, with_things
    from derender.structures.graph_posterior import parts_of
    from derender.structures.grids import with_grids
    from derender.structures.known.library import chosen_library
    from derender.structures.stills import averaged
    from derender.structures.supports import added, further_supports, with_supports
    from derender.structures.together import first_look, look_from, together_parts

    options = options or Options()
    rng = np.random.default_rng(options.seed) if rng is None else rng
    if options.method in ("mcmc", "smc"):
        from derender.structures.jumps.run import infer_by_jumps

        return infer_by_jumps(image, camera, options, None, rng, progress)
    settings = settings_of(options)
    if options.budget is not None:
        settings = settings._replace(until=time.monotonic() + options.budget)
    if progress:
        progress(0.0, "searching for solids")
    depth = np.where(np.isfinite(image) & (image > 0), image, np.nan)
    depth, frames = averaged(depth, whole_camera(camera, depth.shape), options.frames)
    plane = read_floor(options.floor)
    beliefs = bare_image() if settings.beliefs is None else settings.beliefs
    loose = beliefs.loose
    unit = 1.0 if options.unit is not None or options.frames else unit_of(depth, loose)
    open_unit = isinstance(options.prior, BareImagePrior | None)
    if unit != 1.0 and not options.known and open_unit:  # others say how long things are
        floor = plane if plane is None or isinstance(plane, str) else plane / [1.0, 1.0, 1.0, unit]
        options = replace(options, floor=floor, unit=unit)
        return in_metres(infer_structure(depth / unit, camera, options, rng, progress), unit)
    pool: list = []
    library = chosen_library(options.known) if options.known else ()
    state, seen = point_estimate(rng, depth, camera, settings, pool=pool, plane=plane)
    asked, settings = settings, settings_for(settings, seen)
    if progress:
        progress(0.6, f"{len(state)} solids; sampling")
    chains, draws = options.chains or 2, options.draws or 100
    looks = [first_look(state, seen)]
    for frame in frames:
        if progress:
            progress(0.6, f"searching {frame.name} for solids")
        looks.append(look_from(looks[0], *point_estimate(rng, frame.depth, frame.camera, asked), frame, settings))
    interrupted = any(look.seen.interrupted for look in looks)

    def parts_about(only_best):
        if library:
            from derender.structures.known.posterior import known_posterior

            many = (1, 1) if only_best else (chains, draws)
            others = not options.only_known
            return known_posterior(rng, seen.image, state, settings, seen.floor.pose, library, others, *many)
        if len(looks) > 1:
            return together_parts(rng, looks, settings, chains, draws, only_best)
        return parts_of(rng, seen, state, pool, settings, chains, draws, only_best)

    try:
        parts = parts_about(interrupted or options.method == "map")
    except KeyboardInterrupt:
        interrupted, parts = True, parts_about(True)
    extras = parts[0].extras

    def finished(parts, state, seen):
        parts = with_things(rng, with_bridges(parts, settings.slack, loose), seen, state)
        if not settings.free_forms:
            return parts
        return with_grids(parts, image_of(seen, depth, camera, settings.temper, options.unit or 1.0), beliefs)

    parts, observations = finished(parts, state, seen), [seen]
    if settings.free_forms and plane is None and len(looks) == 1 and not (interrupted or library):
        others = []
        for there, other in further_supports(seen, depth.shape, partial(point_estimate, rng, depth, camera, asked)):
            own = settings_for(asked, other)
            more = parts_of(rng, other, there, [], own, chains, draws, options.method == "map")
            extras = added(extras, more[0].extras)
            others.append((finished(more, there, other), other))
            observations.append(other)
        parts = with_supports(parts, seen, others)
    if isinstance(plane, str) or (seen.no_floor and seen.things):  # an empty scene keeps its floor, far below
        parts = [without_floor(part) for part in parts]
    if progress:
        progress(1.0, f"{len(state)} solids")
    meta = {"reduced_by": seen.factor, "noise": seen.floor.sigma, "correlation": seen.correlation,
            "backdrop": seen.background if seen.backdrop else 0.0,
            "no_floor": seen.no_floor, "interrupted": interrupted,
            "existence": {thing_name(k): thing.existence
                          for k, thing in enumerate(thing for each in observations for thing in each.things)},
            "hidden_expected": extras.get("hidden_expected"),
            "likelihood": likelihood_of(parts, observations, depth, camera, settings)}  # fmt: skip
    posterior = Posterior(tuple(parts), seed=options.seed, meta=meta)
    graph = posterior.best_graph()
    if len(looks) > 1:
        into = np.array(posterior.best_part.extras["into"])
        posterior.meta["views"] = [view_data(graph, *each) for each in zip(into, looks[1:], frames, strict=True)]
    told = explanation_of(graph, observations, depth, camera)
    if library:  # of whose answers no spots are counted
        extras = {**extras, "unexplained": int(told.share(depth) < EXPLAINED)}
    missed = missed_by(observations, extras, loose.missed, told.share(depth))
    posterior.meta.update(missed=missed, wrong_if_missed=loose.missed.wrong)
    parts = tuple(part.scaled(1.0 - missed) for part in posterior.parts)
    return replace(posterior, parts=parts, explanation=told)


def missed_by(observations: list[Observation], extras: dict[str, dict[str, float | str] | list[float] | float],
              missed: Missed, explained: float) -> float:  # fmt: skip
    """Return the probability that the search has missed what is there.

    That of the image as a whole, and of each solid: what shows in few pixels may be something else, or two.

    Parameters
    ----------
    observations : of the image, one for each plane on which something stands. extras : of the likeliest structure,
        which say in how many independent pixels each solid shows and how many spots are unexplained. missed : Missed,
        what the prior says. explained : share of the pixels.
    """
    seen = observations[0]
    settled = all(each.agreed for each in observations) and extras.get("unexplained", 0) == 0
    whole = missed.no_floor if seen.no_floor else missed.settled if settled else missed.open
    if seen.correlation > CORRELATED:
        whole = max(whole, 1.0 - (1.0 - missed.sensor) * np.exp(-(1.0 - explained) / missed.unexplained))
    found = 1.0 - missed.few * np.exp(-np.array(extras.get("pixels", [])) / missed.pixels)
    return float(1.0 - (1.0 - whole) * np.prod(found))


def view_data(
    graph: SceneGraph, into: np.ndarray, look: "Look", frame: Frame
) -> dict[str, list[list[float]] | float | str]:
    """Return what is kept of a further view: its name, pose (to the first camera), and the share that is explained."""
    there = replace(graph, root_pose=into @ graph.root_pose)
    told = explanation_of(there, [look.seen], frame.depth, frame.camera)
    return {"image": frame.name, "pose": inverse(into).tolist(), "explained": told.share(frame.depth)}


def explanation_of(graph: Any, observations: Any, depth: np.ndarray, camera: Any) -> Explanation:
    """Return what a scene says of each pixel of the image as it came, an Explanation.

    observations : of the image, one for each plane on which something stands.
    """
    from derender.results.explanation import explain

    behind, bent, bend = np.ones(depth.shape, bool), np.zeros(depth.shape, bool), np.zeros(depth.shape)
    for seen in observations:
        own = (np.abs(seen.image.floor - seen.image.depth) < AS_SEEN) & ~seen.behind
        for thing in seen.things:
            own &= ~thing.mask
        there = ~of_whole_image(seen.behind, seen, depth.shape)
        behind &= ~there
        bent |= of_whole_image(own, seen, depth.shape)
        if seen.bend is not None:
            bend = np.where(there, of_whole_image(seen.bend, seen, depth.shape), bend)
    noise, coarse = (max(values) for values in zip(*((s.floor.sigma, s.factor) for s in observations), strict=True))
    return explain(graph, depth, whole_camera(camera, depth.shape), noise, behind, bent, bend, coarse)


def image_of(seen: Observation, depth: np.ndarray, camera: Any, temper: float, unit: float) -> Any:
    """Return the image as it came, as grids.py looks at it, with the noise that an Observation has of it."""
    from derender.structures.grids import Image

    temper = temper * seen.factor**2 if temper > 1.0 else 1.0
    return Image(depth, whole_camera(camera, depth.shape), of_whole_image(seen.sigma, seen, depth.shape), temper, unit)


def whole_camera(camera: Any, shape: tuple[int, int]) -> Any:
    """Return the Camera that a mapping of fx, fy, cx, cy or a Camera is for an image of this shape."""
    from derender.camera.intrinsics import Camera

    if isinstance(camera, Camera):
        return camera
    return Camera(**{**camera, "width": shape[1], "height": shape[0]})


def likelihood_of(parts: "list[StructurePosterior]", observations: list[Observation], depth: np.ndarray, camera: Any,
                  settings: Settings) -> dict[str, float | str]:  # fmt: skip
    """Return the type and the numbers of the likelihood under which the image as it came is explained.

    That of the draws where they were made from every pixel; else one fitted to the whole image given the best scene:
    to what it shows of the scene, not to what is known to lie behind it, or far away.
    """
    from derender.structures.draws.sensor import image_likelihood, too_far

    best, seen = max(parts, key=lambda part: part.weight), observations[0]
    if "likelihood" in best.extras and seen.factor == 1 and not too_far(depth).any():
        return best.extras["likelihood"]
    camera = whole_camera(camera, depth.shape)
    worth = float((seen.image.weight > 0).sum()) / settings.temper if settings.temper > 1.0 else np.inf
    sensor = (bare_image() if settings.beliefs is None else settings.beliefs).sensor
    other = too_far(depth) | np.all([of_whole_image(each.behind, each, depth.shape) for each in observations], axis=0)
    name, numbers = image_likelihood(camera, np.where(other, -depth, depth), best.best()[0].solids(), worth, sensor)
    return {"type": name, **numbers}
