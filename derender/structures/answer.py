"""From structures with their draws to the posterior that is told: what each pixel shows, and what may be missed."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.search.observation import CORRELATED, Observation, of_whole_image
from derender.detection.solids.beliefs import sensor_beliefs
from derender.detection.solids.misfit import AS_SEEN
from derender.posterior.target import ObservedImage
from derender.results.check import LEAST_FITTING
from derender.results.fit import Explanation
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import ROOT, SceneGraph
from derender.scene.pose import inverse
from derender.scene.priors.bare_image import Missed
from derender.structures.case import Case
from derender.structures.options import Frame
from derender.structures.parts import MOST_STRUCTURES, likeliest

if TYPE_CHECKING:
    from derender.structures.together import Look

SURELY = 0.95  # probability from which on what hides a solid says nothing against it
SELDOM = 0.01  # the least of that that is believed: were all structures impossible, none would be told
RATHER = 0.5  # share of what an object shows in that it explains, below which a structure is doubted for it, too
LITTLE_FLOOR = 0.4  # share of what shows no solid: what stands on the rest may be told background


def answered(case: Case, looks: "list[Look]", parts: list[StructurePosterior], observations: list[Observation],
             extras: dict[str, Any], interrupted: bool) -> Posterior:  # fmt: skip
    """Return the Posterior of the structures: what explains each pixel, and how probably something was missed."""
    from derender.results.posterior import Posterior
    from derender.structures.free_forms import thing_name
    from derender.structures.unexplained import place_of

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
            "clutter": [(p, *place_of(mask)) for each in observations for mask, p in each.clutter],
            "cut_short": [(p, *place_of(mask)) for each in observations for mask, p in each.cut_short],
            "likelihood": likelihood_of(parts, observations, case)}  # fmt: skip
    posterior = Posterior(tuple(parts), seed=case.options.seed, meta=meta)
    graph = posterior.best_graph()
    if len(looks) > 1:
        into = np.array(posterior.best_part.extras["into"])
        meta["views"] = [view_data(graph, *each) for each in zip(into, looks[1:], case.frames, strict=True)]
    told = explanation_of(graph, observations, case.depth, case.camera)
    elsewhere = {name: share for name, share in told.borne_out(case.depth).items() if share < LEAST_FITTING}
    if seen.correlation > CORRELATED and not case.library:
        meta["existence"].update(chances(meta["existence"], graph, told, case))
    nothing = {thing_name(k): thing.clutter for k, thing in enumerate(things)}
    posterior = replace(posterior, parts=tuple(with_absences(parts, meta["existence"], elsewhere, nothing)))
    for name, share in elsewhere.items():
        known, error = meta["existence"].get(name, (1.0, 0.0))
        meta["existence"][name] = (share * known, error)
    if posterior.best_graph().names != graph.names:
        graph = posterior.best_graph()
        told = explanation_of(graph, observations, case.depth, case.camera)
    believed = case.beliefs.loose.missed
    if case.library:  # of whose answers no spots are counted
        extras = {**extras, "weighed": told.share(case.depth) >= believed.explained}
    missed = missed_by(observations, extras, believed, told.share(case.depth))
    meta.update(missed=missed, wrong_if_missed=believed.wrong, hanging=hanging(graph, case))
    return replace(
        posterior,
        parts=tuple(part.scaled(1.0 - missed, believed.error * missed) for part in posterior.parts),
        explanation=told,
    )


def chances(
    existence: dict[str, tuple[float, float]], graph: SceneGraph, told: Explanation, case: Case
) -> dict[str, tuple[float, float]]:
    """Return (probability, standard error) that objects are there which little shows, or which touch nothing.
    existence : the same of free-form things, by what they explain. told : what the scene says of each pixel."""
    believed, found = case.beliefs.loose.existence, {}
    for name, share in shown_shares(graph, told, case.depth, case.camera).items():
        if (there := believed.shown_by(share))[0] < SURELY:
            found[name] = there
    for name in hanging(graph, case):
        (known, error), share = {**existence, **found}.get(name, (1.0, 0.0)), believed.hangs
        found[name] = (share * known, float(np.hypot(share * error, known * share * (1.0 - share))))
    return found


def hanging(graph: SceneGraph, case: Case) -> list[str]:
    """Return the names of the objects that touch nothing, where there is a floor and nothing may float."""
    if case.settings.may_float or all(vertex.body.size() is not None for vertex in graph.vertices):
        return []
    return [vertex.name for vertex in graph.vertices if vertex.parent == ROOT and vertex.body.size() is not None]


def shown_shares(graph: SceneGraph, told: Explanation, depth: np.ndarray, camera: Camera) -> dict[str, float]:
    """Return for each solid but free-form things which share of the returns that it covers, but for those from other
    solids or from what stands on it, shows it. told : what the scene says of each pixel of a depth image (H, W)."""
    from derender.render.raycast.depth import render_depth

    solids, found = graph.solids(), {}
    borne: dict[str, set[str]] = {}
    valid = np.isfinite(depth) & (depth > 0)
    for vertex in reversed(graph.vertices):  # parents come first
        for on in (vertex.parent, *vertex.supports):
            borne.setdefault(on, set()).update({vertex.name}, borne.get(vertex.name, set()))
    free = {name for name in told.names if graph.vertex(name).shape == "thing"}
    for k, name in enumerate(graph.solid_names):
        if name not in told.names or name in free:
            continue
        before = set(told.names) - (free - borne.get(name, set())) - {name}
        alone = solids._replace(**{key: getattr(solids, key)[[k]] for key in ("kind", "pose", "size", "mesh")})
        hidden = np.isin(told.label, [told.names.index(each) for each in before])
        covered = valid & (render_depth(alone, camera)[1] >= 0) & ~hidden
        if covered.any():
            found[name] = float((told.label[covered] == told.names.index(name)).mean())
    return found


def with_absences(
    parts: list[StructurePosterior],
    existence: dict[str, tuple[float, float]],
    elsewhere: dict[str, float],
    nothing: dict[str, float],
) -> list[StructurePosterior]:
    """Return the structures with all of their objects, and those in which some of the likeliest one's are but clutter,
    so that none is likelier than each of its objects; not of others: without the object in which they differ they are
    the same.

    existence : by name, (probability that it is an object, whatever else is one; standard error of that).
    elsewhere : by name, which share of where an object should be seen it explains. A free-form thing is an object so
        much less probably; of a solid it is the probability, below RATHER, that it is not another one that is seen
        elsewhere.
    nothing : by name, the probability that there is no object; where not given, that it is not this one. What may be
        several is told nevertheless: nothing is told of how they part it, but leaving it out would be no likelier.
    """
    from derender.structures.free_forms import without_object

    found, likeliest_part = [], max(parts, key=lambda part: part.weight)
    for part in parts:
        held = {on for vertex in part.graph.vertices for on in (vertex.parent, *vertex.supports)}
        doubted = {name: of for name, of in existence.items() if name in part.graph.names and name not in held}
        free = {vertex.name: vertex.shape == "thing" for vertex in part.graph.vertices}
        chance = [known * (elsewhere.get(name, 1.0) if free[name] else 1.0) for name, (known, _) in doubted.items()]
        gone = [min(nothing.get(name, 1.0), 1.0 - known) for name, known in zip(doubted, chance, strict=True)]
        shares = [np.array([known, absent]) for known, absent in zip(chance, gone, strict=True)]
        solids = [share for name, share in elsewhere.items() if free.get(name) is False and share < RATHER]
        as_told = float(np.prod([max(share, SELDOM) for share in solids]))
        all_there = (0,) * len(doubted)
        choices = [chosen for chosen, _ in likeliest(shares)] if part is likeliest_part else [all_there]
        for chosen in choices:
            absent = [name for name, choice in zip(doubted, chosen, strict=True) if choice]
            own = part.best_only() if absent else part
            for name in absent:
                own = without_object(own, name)
            told = [share[choice] for share, choice in zip(shares, chosen, strict=True)]
            errors = [error / max(p, error) for p, (_, error) in zip(told, doubted.values(), strict=True) if error]
            share = as_told * float(np.prod(told))
            own = own.scaled(share, share * float(np.linalg.norm(errors)))
            found.append(replace(own, extras={**own.extras, "absent": absent}) if absent else own)
    return sorted(found, key=lambda part: -part.weight)[: max(MOST_STRUCTURES, len(parts))]


def missed_by(observations: list[Observation], extras: dict[str, dict[str, float | str] | list[float] | float],
              missed: Missed, explained: float) -> float:  # fmt: skip
    """Return the probability that the search has missed what is there: of the image as a whole, of each solid, or that
    another plane is the floor.

    observations : one for each plane on which something stands. extras : of the likeliest structure: the independent
        pixels of each solid, unexplained spots, whether it was weighed at all. explained : share of the pixels.
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
    observations : of the image, one for each plane on which something stands."""
    from derender.results.fit import explain

    behind, bent, bend = np.ones(depth.shape, bool), np.zeros(depth.shape, bool), np.zeros(depth.shape)
    for seen in observations:
        own = (np.abs(seen.image.floor - seen.image.depth) < AS_SEEN) & ~seen.behind
        for thing in seen.things:
            own &= ~thing.mask
        there = ~of_whole_image(seen.behind | seen.on_wall, seen, depth.shape)
        behind &= ~there
        bent |= of_whole_image(own, seen, depth.shape)
        if seen.bend is not None:
            bend = np.where(there, of_whole_image(seen.bend, seen, depth.shape), bend)
    noise, coarse = (max(values) for values in zip(*((s.floor.sigma, s.factor) for s in observations), strict=True))
    hides = any(seen.correlation > CORRELATED for seen in observations)
    return explain(graph, depth, camera, noise, behind, bent, bend, coarse, hides)


def likelihood_of(
    parts: list[StructurePosterior], observations: list[Observation], case: Case
) -> dict[str, float | str]:
    """Return the type and the numbers of the likelihood of the image as it came: that of the draws where they were made
    from every pixel; else one fitted to the whole image given the best scene."""
    from derender.structures.draws.sensor import too_far

    best = max(parts, key=lambda part: part.weight)
    if "likelihood" in best.extras and observations[0].factor == 1 and not too_far(case.depth).any():
        return best.extras["likelihood"]
    image = observed_under(best.best()[0], observations, case)
    return {"type": image.type, **image.values}


def observed_under(graph: SceneGraph, observations: list[Observation], case: Case) -> ObservedImage:
    """Return the image as it came under the likelihood that it suggests given a scene.
    To what it shows of the scene that is fitted, not to what is known to lie behind it, or far away."""
    from derender.posterior.target import ObservedImage
    from derender.structures.draws.sensor import image_likelihood, too_far

    sensor, depth = sensor_beliefs(case.beliefs, observations[0].correlation > CORRELATED), case.depth
    other = too_far(depth) | np.all([of_whole_image(each.behind, each, depth.shape) for each in observations], axis=0)
    seen = np.where(other, -depth, depth)
    return ObservedImage(
        case.camera, seen, *image_likelihood(case.camera, seen, graph.solids(), sensor, observations[0].wall)
    )
