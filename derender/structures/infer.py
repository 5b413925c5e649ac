"""From a bare depth image to a posterior over scene graphs: search, weigh and draw, complete, say what is left open."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.estimate import point_estimate, settings_for
from derender.detection.fattening import fattened, thinned
from derender.detection.floor import read_floor
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import CORRELATED, Observation, of_whole_image
from derender.detection.solids.beliefs import Beliefs, beliefs_of, sensor_beliefs
from derender.detection.solids.misfit import AS_SEEN
from derender.detection.solids.state import State
from derender.detection.unit import in_metres, scale_drawn, unit_of
from derender.errors import DerenderError
from derender.results.check import LEAST_FITTING
from derender.results.fit import Explanation
from derender.scene.graph import ROOT, SceneGraph
from derender.scene.pose import inverse
from derender.scene.priors.bare_image import BareImagePrior, Missed
from derender.structures.options import Frame, Options

if TYPE_CHECKING:
    from derender.posterior.target import ObservedImage
    from derender.results.posterior import Posterior, StructurePosterior
    from derender.structures.grids import Image
    from derender.structures.together import Look

# Chains of each structure, and draws of each chain, where options say nothing: a quantile of as few as 200 draws is off
# by so much that 90 % intervals held 1 to 4 of 100 numbers less than those of 800.
CHAINS, DRAWS = 2, 200

Progress = Callable[[float, str], None]


class Case(NamedTuple):
    """An image to explain, and what is asked."""

    depth: np.ndarray  # (H, W) metres, NaN = no return
    camera: Camera  # its Camera
    frames: Sequence[Frame]  # further images of the same scene
    options: Options
    settings: Settings  # of the search, as asked
    library: Any  # of known objects, empty: none
    plane: Any  # the floor as it is given, see detection.floor.read_floor; None: find it
    fattened: bool  # whether its silhouettes were a pixel wider as it came, see `detection.fattening`

    @property
    def beliefs(self) -> Beliefs:
        """What is believed before the image is seen."""
        return self.settings.believed

    @property
    def many(self) -> tuple[int, int]:
        """How many chains there are of each structure, and draws of each chain."""
        return self.options.chains or CHAINS, self.options.draws or DRAWS

    @property
    def only_best(self) -> bool:
        """Whether the best scene is all that is asked for."""
        return self.options.method == "map"


def infer_structure(
    image: np.ndarray,
    camera: Camera | Mapping[str, float],
    options: Options | None = None,
    rng: np.random.Generator | None = None,
    progress: Progress | None = None,
) -> "Posterior":
    """Infer which solids are there and what rests on what.

    image : (H, W) float metres, NaN or 0 = no return.
    camera : Camera, or a mapping with fx, fy, cx, cy.
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
    case = case_of(image, camera, options)
    unit = unit_of_lengths(case)
    if unit != 1.0:
        floor = case.plane if case.plane is None or isinstance(case.plane, str) else case.plane / [1.0, 1.0, 1.0, unit]
        options = replace(options, floor=floor, unit=unit)
        return in_metres(infer_structure(case.depth / unit, camera, options, rng, progress), unit)
    pool: list[tuple[State, float]] = []
    looks = searched(rng, case, pool, say)
    parts, interrupted = weighed(rng, case, looks, pool)
    parts, observations, extras = completed(rng, case, looks, parts, interrupted)
    say(1.0, f"{len(looks[0].state)} solids")
    return answered(case, looks, parts, observations, extras, interrupted)


def case_of(image: np.ndarray, camera: Camera | Mapping[str, float], options: Options) -> Case:
    """Return the Case of an image; frames from where its own camera stood are averaged with it."""
    from derender.structures.known.library import chosen_library
    from derender.structures.together import averaged

    depth = np.where(np.isfinite(image) & (image > 0), image, np.nan)
    whole = whole_camera(camera, depth.shape)
    depth, frames = averaged(depth, whole, options.frames)
    wide = fattened(depth)
    depth = thinned(depth) if wide else depth
    frames = [frame._replace(depth=thinned(frame.depth)) if fattened(frame.depth) else frame for frame in frames]
    library = chosen_library(options.known) if options.known else ()
    return Case(depth, whole, frames, options, settings_of(options), library, read_floor(options.floor), wide)


def unit_of_lengths(case: Case) -> float:
    """Return the metres in which to count lengths: 1 where the unit is known, or others say how long things are."""
    options = case.options
    said = options.known or not isinstance(options.prior, BareImagePrior | None)
    if said or options.unit is not None or options.frames:
        return 1.0
    return unit_of(case.depth, case.beliefs.loose)


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


def weighed(rng: np.random.Generator, case: Case, looks: "list[Look]",
            pool: list[tuple[State, float]]) -> "tuple[list[StructurePosterior], bool]":  # fmt: skip
    """Return the structures with their weights and draws, and whether someone interrupted this or the search."""
    from derender.structures.graph_posterior import parts_of
    from derender.structures.together import together_parts

    state, seen = looks[0].state, looks[0].seen
    settings = settings_for(case.settings, seen)

    def parts(only_best: bool) -> "list[StructurePosterior]":
        if case.library:
            from derender.structures.known.posterior import known_posterior

            others, fewest = not case.options.only_known, (1, 1) if only_best else case.many
            coarse = settings._replace(reduced=seen.factor > 1)
            whole = partial(observed_under, observations=[seen], case=case)
            return known_posterior(rng, seen.image, state, coarse, seen.floor.pose, whole, case.library, others,
                                   *fewest)  # fmt: skip
        if len(looks) > 1:
            return together_parts(rng, looks, settings, *case.many, only_best)
        return parts_of(rng, seen, state, pool, settings, *case.many, only_best, looks[0].refined)

    interrupted = any(look.seen.interrupted for look in looks)
    try:
        return parts(interrupted or case.only_best), interrupted
    except KeyboardInterrupt:
        return parts(True), True


def completed(
    rng: np.random.Generator, case: Case, looks: "list[Look]", parts: "list[StructurePosterior]", interrupted: bool
) -> "tuple[list[StructurePosterior], list[Observation], dict[str, Any]]":
    """Return the structures with free-form things, bridges and grids, and what stands on other planes.

    Returns also the Observations, one for each plane on which something stands, and what is said of all of them.
    """
    from derender.detection.solids.graph import without_floor
    from derender.structures.graph_posterior import parts_of
    from derender.structures.supports import further_supports, with_supports

    state, seen = looks[0].state, looks[0].seen
    settings = settings_for(case.settings, seen)
    extras: dict[str, Any] = dict(parts[0].extras)
    parts, observations = finished(rng, case, parts, state, seen, settings), [seen]
    alone = case.plane is None and len(looks) == 1 and not (interrupted or case.library)
    if settings.free_forms and alone:
        others, look = [], partial(point_estimate, rng, case.depth, case.camera, case.settings)
        for there, other in further_supports(seen, case.depth.shape, look):
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


def finished(rng: np.random.Generator, case: Case, parts: "list[StructurePosterior]", state: State, seen: Observation,
             settings: Settings) -> "list[StructurePosterior]":  # fmt: skip
    """Return the structures over one plane with the free-form things, bridges and grids that the search leaves out."""
    from derender.structures.bridges import with_bridges
    from derender.structures.free_forms import with_rivals, with_things
    from derender.structures.grids import with_grids

    parts = with_things(rng, with_bridges(parts, settings.rules), seen, state, case.beliefs.loose.things)
    if not settings.free_forms:
        return parts
    if not case.only_best:
        parts = with_rivals(rng, parts, seen, state, settings)
    return with_grids(parts, image_of(seen, case, settings.temper), case.beliefs)


def answered(case: Case, looks: "list[Look]", parts: "list[StructurePosterior]", observations: list[Observation],
             extras: dict[str, Any], interrupted: bool) -> "Posterior":  # fmt: skip
    """Return the Posterior of the structures: what explains each pixel, and how probably something was missed."""
    from derender.results.posterior import Posterior
    from derender.structures.free_forms import thing_name

    seen = looks[0].seen
    things = [thing for each in observations for thing in each.things]
    meta: dict[str, Any] = {"reduced_by": seen.factor, "fattened": case.fattened, "noise": seen.floor.sigma,
            "correlation": seen.correlation,
            "faces": case.beliefs.loose.faces if seen.correlation > CORRELATED else 0.0,
            "backdrop": seen.background if seen.backdrop else 0.0,
            "other_floors": [rival._asdict() for rival in seen.other_floors],
            "no_floor": seen.no_floor, "interrupted": interrupted,
            "existence": {thing_name(k): thing.existence for k, thing in enumerate(things)},
            "hidden_expected": extras.get("hidden_expected"), "spots": extras.get("spots", []),
            "likelihood": likelihood_of(parts, observations, case)}  # fmt: skip
    posterior = Posterior(tuple(parts), seed=case.options.seed, meta=meta)
    graph = posterior.best_graph()
    if len(looks) > 1:
        into = np.array(posterior.best_part.extras["into"])
        meta["views"] = [view_data(graph, *each) for each in zip(into, looks[1:], case.frames, strict=True)]
    told = explanation_of(graph, observations, case.depth, case.camera)
    for name, share in told.borne_out(case.depth).items():
        if share < LEAST_FITTING:  # what is seen elsewhere, or is none
            known, error = meta["existence"].get(name, (1.0, 0.0))
            meta["existence"][name] = (share * known, error)
    believed = case.beliefs.loose.missed
    if case.library:  # of whose answers no spots are counted
        extras = {**extras, "weighed": told.share(case.depth) >= believed.explained}
    missed = missed_by(observations, extras, believed, told.share(case.depth))
    hanging = [vertex.name for vertex in graph.vertices if vertex.parent == ROOT and vertex.body.size() is not None]
    stands = not case.settings.may_float and any(vertex.body.size() is None for vertex in graph.vertices)
    meta.update(missed=missed, wrong_if_missed=believed.wrong, hanging=hanging if stands else [])
    return replace(
        posterior, parts=tuple(part.scaled(1.0 - missed, believed.error * missed) for part in parts), explanation=told
    )


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
    if options.budget is not None:
        settings = settings._replace(until=time.monotonic() + options.budget)
    return settings._replace(
        may_overlap=settings.may_overlap or options.may_overlap, may_float=settings.may_float or options.may_float
    )


def image_of(seen: Observation, case: Case, temper: float) -> "Image":
    """Return the image as it came, as grids.py looks at it, with the noise that an Observation has of it."""
    from derender.structures.grids import Image

    temper = temper * seen.factor**2 if temper > 1.0 else 1.0
    sigma = of_whole_image(seen.sigma, seen, case.depth.shape)
    return Image(case.depth, case.camera, sigma, temper, case.options.unit or 1.0)


LITTLE_FLOOR = 0.4  # share of what shows no solid: what stands on the rest may be told background


def missed_by(observations: list[Observation], extras: dict[str, dict[str, float | str] | list[float] | float],
              missed: Missed, explained: float) -> float:  # fmt: skip
    """Return the probability that the search has missed what is there.

    That of the image as a whole, of each solid (what shows in few pixels may be something else, or two), and that
    another plane is the floor.

    observations : of the image, one for each plane on which something stands. extras : of the likeliest structure,
        which say in how many independent pixels each solid shows, which spots are unexplained, and whether it was
        weighed against others at all. missed : Missed, what the prior says. explained : share of the pixels.
    """
    seen = observations[0]
    settled = all(each.agreed for each in observations) and not extras.get("spots")
    floor, behind = seen.floor.inliers.mean(), seen.behind.mean()
    alone = len(observations) == 1  # what stands on other planes is told with them
    lost = seen.no_floor or (alone and floor < LITTLE_FLOOR * (floor + behind))
    whole = missed.settled if settled else missed.open
    if not extras.get("weighed", True):
        whole = missed.unweighed
    if lost:
        whole = missed.no_floor
    if seen.correlation > CORRELATED:
        whole = max(whole, 1.0 - (1.0 - missed.sensor) * np.exp(-(1.0 - explained) / missed.unexplained))
    found = 1.0 - missed.few * np.exp(-np.array(extras.get("pixels", [])) / missed.pixels)
    same = 1.0 - sum(rival.probability for rival in seen.other_floors)
    return float(1.0 - same * (1.0 - whole) * np.prod(found))


def view_data(
    graph: SceneGraph, into: np.ndarray, look: "Look", frame: Frame
) -> dict[str, list[list[float]] | float | str]:
    """Return what is kept of a further view: its name, pose (to the first camera), and the share that is explained."""
    there = replace(graph, root_pose=into @ graph.root_pose)
    told = explanation_of(there, [look.seen], frame.depth, frame.camera)
    return {"image": frame.name, "pose": inverse(into).tolist(), "explained": told.share(frame.depth)}


def explanation_of(
    graph: SceneGraph, observations: list[Observation], depth: np.ndarray, camera: Camera
) -> Explanation:
    """Return what a scene says of each pixel of the image as it came, an Explanation.

    observations : of the image, one for each plane on which something stands.
    """
    from derender.results.fit import explain

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
    hides = any(seen.correlation > CORRELATED for seen in observations)
    return explain(graph, depth, whole_camera(camera, depth.shape), noise, behind, bent, bend, coarse, hides)


def whole_camera(camera: Any, shape: tuple[int, int]) -> Camera:
    """Return the Camera that a mapping of fx, fy, cx, cy or a Camera is for an image of this shape."""

    if isinstance(camera, Camera):
        return camera
    return Camera(**{**camera, "width": shape[1], "height": shape[0]})


def likelihood_of(
    parts: "list[StructurePosterior]", observations: list[Observation], case: Case
) -> dict[str, float | str]:
    """Return the type and the numbers of the likelihood under which the image as it came is explained.

    That of the draws where they were made from every pixel; else one fitted to the whole image given the best scene.
    """
    from derender.structures.draws.sensor import too_far

    best = max(parts, key=lambda part: part.weight)
    if "likelihood" in best.extras and observations[0].factor == 1 and not too_far(case.depth).any():
        return best.extras["likelihood"]
    image = observed_under(best.best()[0], observations, case)
    return {"type": image.type, **image.values}


def observed_under(graph: SceneGraph, observations: list[Observation], case: Case) -> "ObservedImage":
    """Return the image as it came under the likelihood that it suggests given a scene.

    To what it shows of the scene that is fitted, not to what is known to lie behind it, or far away.
    """
    from derender.posterior.target import ObservedImage
    from derender.structures.draws.sensor import image_likelihood, too_far

    sensor, depth = sensor_beliefs(case.beliefs, observations[0].correlation > CORRELATED), case.depth
    other = too_far(depth) | np.all([of_whole_image(each.behind, each, depth.shape) for each in observations], axis=0)
    seen = np.where(other, -depth, depth)
    return ObservedImage(
        case.camera, seen, *image_likelihood(case.camera, seen, graph.solids(), sensor, observations[0].wall)
    )
