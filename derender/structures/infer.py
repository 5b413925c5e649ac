"""From a bare depth image to a posterior over scene graphs: search, weigh and draw, complete, say what is left open."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import least
from derender.detection.estimate import point_estimate, settings_for
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import CORRELATED, Observation, Support, of_whole_image, whole_image
from derender.detection.solids.state import State
from derender.detection.unit import in_metres, scale_drawn
from derender.errors import DerenderError
from derender.results.fit import FLOOR
from derender.results.posterior import Posterior, StructurePosterior
from derender.results.trust import misleads
from derender.sampling.diagnostics import summary, unwrap
from derender.structures.answer import answered, observed_under
from derender.structures.case import Case, case_of, unit_of_lengths
from derender.structures.draws.refined import FEW, Refined, refine, view_of
from derender.structures.options import Options

if TYPE_CHECKING:
    from derender.structures.grids import Image
    from derender.structures.together import Look

# Correlation that neighbours' noise is taken to have in an image that independent noise does not explain: as intrinsics
# are off by a few percent, or pixels were filled in. Solids were split and invented to explain that, until nothing but
# noise was left; as a sensor's, faces are off by millimetres. (Of 25 made images 2 were told right, and 24 so.)
AS_OF_A_SENSOR = 0.4
# Share of the pixels in which objects show, but for so many pixels along their edges, in which none may show any more.
MOST_LOST, EDGE = 0.05, 1
# Of the solids, floors too, how many are left at most where nothing but chains that disagree, or free-form things,
# speak for a sensor: of ten in a heap two that touch may be taken as one. Or there are fewer free-form things.
FEWER = 0.75

Progress = Callable[[float, str], None]


def infer_structure(
    image: np.ndarray,
    camera: Camera,
    options: Options | None = None,
    rng: np.random.Generator | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Infer which solids are there and what rests on what.

    image : (H, W) float metres, NaN or 0 = no return.
    options : Options; None: all as it comes.
    rng : of random numbers; None: made from the options' seed. progress : called with (fraction done, message).

    Returns a Posterior; on Ctrl-C, once something was found, that of the best scene so far, its meta "interrupted".
    """
    options, say = options or Options(), progress or (lambda done, message: None)
    rng = np.random.default_rng(options.seed) if rng is None else rng
    if options.method == "mcmc":
        from derender.structures.jumps.run import infer_by_jumps

        return infer_by_jumps(image, camera, options, None, rng, progress)
    say(0.0, "searching for solids")
    case = case_of(rng, image, camera, options)
    unit = unit_of_lengths(case)
    if unit != 1.0:
        floor = case.plane if case.plane is None or isinstance(case.plane, str) else case.plane / [1.0, 1.0, 1.0, unit]
        options = replace(options, floor=floor, unit=unit)
        return in_metres(infer_structure(case.depth / unit, camera, options, rng, progress), unit)
    found = found_in(rng, case, say)
    said = options.prior is not None or case.library or case.frames or found.meta["interrupted"]
    if said or found.meta["correlation"] > CORRELATED:
        return found
    if not (found.meta["spots"] or disagrees(found.best_part) or things_in(found)):
        return found
    say(0.0, "searching again, as for what a sensor shows")
    try:
        other = found_in(rng, case._replace(settings=case.settings._replace(shared=AS_OF_A_SENSOR)), say)
        stopped = other.meta["interrupted"]
    except KeyboardInterrupt:
        stopped = True
    except DerenderError:  # so seen there is no floor, or nothing else to tell
        return found
    if stopped:  # the first answer is whole
        return replace(found, meta={**found.meta, "interrupted": True})
    many, now = (len(each.best_graph().solid_names) for each in (found, other))
    fewer = now <= FEWER * many or (now <= many and things_in(other) < things_in(found))
    freer = things_in(other) > things_in(found)  # a free form explains anything
    same = lost(found, other) < MOST_LOST and not loses_one(found, other) and not freer
    return other if same and (found.meta["spots"] or fewer) else found


def found_in(rng: np.random.Generator, case: Case, say: Progress) -> Posterior:
    """Return the Posterior of an image, its noise taken as it comes, or to be shared by neighbours as settings say."""
    pool: list[tuple[State, float]] = []
    looks = searched(rng, case, pool, say)
    parts, interrupted = weighed(rng, case, looks, pool, say)
    parts, observations, extras = completed(rng, case, looks, parts, interrupted)
    say(1.0, f"{len(looks[0].state)} solids")
    return answered(case, looks, parts, observations, extras, interrupted)


def disagrees(part: StructurePosterior) -> bool:
    """Whether chains of a structure say so different things of a number that they are not to be believed."""
    if part.values.shape[1] < FEW:
        return False
    told = [unwrap(draws, period) for draws, period in zip(np.moveaxis(part.values, -1, 0), part.periods, strict=True)]
    return any(misleads({**summary(draws), "draws": draws}) for draws in told)


def things_in(found: Posterior) -> int:
    """Return how many free-form things the likeliest scene has: each may be a solid that a wrong focal length bends."""
    graph = found.best_graph()
    return sum(graph.vertex(name).shape == "thing" for name in graph.solid_names)


def lost(found: Posterior, other: Posterior) -> float:
    """Return the share of the pixels of an image (H, W) that objects of one Posterior show and another leaves, or
    takes as background."""
    assert found.explanation is not None and other.explanation is not None, "both tell what each pixel shows"
    shown = found.explanation.label > FLOOR
    return float(least(shown & (other.explanation.label <= FLOOR), EDGE).sum() / max(shown.sum(), 1))


def loses_one(found: Posterior, other: Posterior) -> bool:
    """Whether half of the pixels of some object of one Posterior show none in another: that is no other reading of it.
    Pieces into which noise split a solid show that solid then."""
    assert found.explanation is not None and other.explanation is not None, "both tell what each pixel shows"
    label, gone = found.explanation.label, other.explanation.label <= FLOOR
    return any(gone[label == k].mean() > 0.5 for k in np.unique(label[label > FLOOR]))


def searched(rng: np.random.Generator, case: Case, pool: list[tuple[State, float]], say: Progress) -> "list[Look]":
    """Return what was found in the image and in each further one; pool : takes what other searches ended with."""
    from derender.structures.stacks import with_stacks
    from derender.structures.together import Look, look_from

    state, seen = point_estimate(rng, case.depth, case.camera, case.settings, pool=pool, plane=case.plane)
    settings = settings_for(case.settings, seen)
    refined = None
    try:
        seen, state, refined = with_stacks(rng, seen, state, settings)
    except KeyboardInterrupt:
        seen = seen._replace(interrupted=True)
    say(0.6, f"{len(state)} solids; sampling")
    looks = [Look(state, seen, refined=refined)]
    for frame in case.frames:
        say(0.6, f"searching {frame.name} for solids")
        found = point_estimate(rng, frame.depth, frame.camera, case.settings)
        looks.append(look_from(looks[0], *found, frame, settings))
    return looks


def searched_again(rng: np.random.Generator, case: Case, seen: Observation, say: Progress) -> "Refined | None":
    """Return what another search finds, at its mode under the image as it was observed; None: it stands on another
    floor. seen : the Observation of the first search, with what that took for free-form things."""
    say(0.7, "searching again: the first search left doubts")
    state, other = point_estimate(rng, case.depth, case.camera, case.settings, plane=case.plane)
    if other.interrupted:
        raise KeyboardInterrupt
    if other.no_floor or not np.allclose(other.floor.pose, seen.floor.pose):
        return None
    return refine(rng, [view_of(seen)], seen.floor.pose, state, case.settings.rules, case.settings.tries)


def weighed(rng: np.random.Generator, case: Case, looks: "list[Look]", pool: list[tuple[State, float]],
            say: Progress) -> "tuple[list[StructurePosterior], bool]":  # fmt: skip
    """Return the structures with their weights and draws, and whether someone interrupted this or the search."""
    from derender.structures.graph_posterior import parts_of
    from derender.structures.together import together_parts

    state, seen = looks[0].state, looks[0].seen
    settings = settings_for(case.settings, seen)

    def parts(only_best: bool) -> list[StructurePosterior]:
        if case.library:
            from derender.structures.known.posterior import known_posterior

            others, fewest = not case.options.only_known, (1, 1) if only_best else case.many
            under = partial(observed_under, observations=[seen], case=case)
            as_it_came = whole_image(seen, case.depth, case.camera)
            coarse = settings._replace(reduced=seen.factor > 1)
            return known_posterior(rng, seen.image, as_it_came, state, coarse, seen.floor.pose, under, case.library,
                                   others, *fewest, not only_best and case.options.draws is None)  # fmt: skip
        if len(looks) > 1:
            return together_parts(rng, looks, settings, *case.many, only_best)
        again = partial(searched_again, rng, case, seen, say) if seen.correlation <= CORRELATED else None
        return parts_of(rng, seen, state, pool, settings, *case.many, only_best, looks[0].refined, again)

    interrupted = any(look.seen.interrupted for look in looks)
    try:
        return parts(interrupted or case.only_best), interrupted
    except KeyboardInterrupt:
        return parts(True), True


def completed(
    rng: np.random.Generator, case: Case, looks: "list[Look]", parts: list[StructurePosterior], interrupted: bool
) -> "tuple[list[StructurePosterior], list[Observation], dict[str, Any]]":
    """Return the structures with free-form things, bridges and grids, and what stands on other planes; the
    Observations, one for each plane on which something stands, and what is said of all of them."""
    from derender.detection.solids.graph import without_floor
    from derender.structures.graph_posterior import parts_of
    from derender.structures.supports import further_supports, with_supports

    state, seen = looks[0].state, looks[0].seen
    settings = settings_for(case.settings, seen)
    extras: dict[str, Any] = dict(parts[0].extras)
    parts, observations = finished(rng, case, parts, state, seen, settings), [seen]
    alone = case.plane is None and len(looks) == 1 and not (interrupted or case.library)
    if settings.free_forms and alone:
        others: list[Any] = []

        def look(plane: Support, left: int) -> tuple[State, Observation]:
            return point_estimate(rng, case.depth, case.camera, case.settings._replace(max_objects=left), plane=plane)

        for there, other in further_supports(seen, state, case.settings, case.depth.shape, look):
            own = settings_for(case.settings, other)
            more = parts_of(rng, other, there, [], own, *case.many, case.only_best)
            both = ((key, extras.get(key), more[0].extras.get(key)) for key in ("pixels", "spots", "hidden_expected"))
            extras.update((key, own + its) for key, own, its in both if own is not None and its is not None)
            others.append((finished(rng, case, more, there, other, settings), other))
            observations.append(other)
        parts = with_supports(parts, seen, others)
        if seen.correlation > CORRELATED:
            parts = [scale_drawn(rng, part, case.beliefs.loose.scale) for part in parts]
    if isinstance(case.plane, str) or (seen.no_floor and seen.things):  # an empty scene keeps its floor, far below
        parts = [without_floor(part) for part in parts]
    return parts, observations, extras


def finished(rng: np.random.Generator, case: Case, parts: list[StructurePosterior], state: State, seen: Observation,
             settings: Settings) -> list[StructurePosterior]:  # fmt: skip
    """Return the structures over one plane with the free-form things, bridges and grids that the search leaves out."""
    from derender.structures.bridges import with_bridges
    from derender.structures.free_forms import with_rivals, with_things
    from derender.structures.grids import with_grids

    parts = with_things(rng, with_bridges(parts, settings.rules), seen, state, case.beliefs.loose.things)
    if not settings.free_forms:
        return parts
    if not case.only_best:
        parts = with_rivals(rng, parts, seen, state, settings)
    return with_grids(rng, parts, image_of(seen, case, settings.temper), case.beliefs)


def image_of(seen: Observation, case: Case, temper: float) -> "Image":
    """Return the image as it came, as grids.py looks at it, with the noise that an Observation has of it."""
    from derender.structures.grids import Image

    temper = temper * seen.factor**2 if temper > 1.0 else 1.0
    sigma = of_whole_image(seen.sigma, seen, case.depth.shape)
    return Image(case.depth, case.camera, sigma, temper, case.options.unit or 1.0)
