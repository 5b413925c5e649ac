"""How well a scene explains an image: log prior, log likelihood, and what each object contributes."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.document import Document, read_prior_document
from derender.errors import DerenderError
from derender.json_text import finite_or_none
from derender.render.raycast.depth import render_depth
from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.graph import SceneGraph
from derender.scene.priors.objects import QUATERNION
from derender.scene.priors.tree import Prior, TreePrior
from derender.scene.solids import PLANE

BACKGROUND = "(background)"


class Share(NamedTuple):
    """What one object contributes to the log likelihood."""

    name: str  # of the object; "(background)" for pixels in which the scene has none
    pixels: int  # in which it is seen
    log_likelihood: float  # the sum over these pixels; all shares sum to the whole
    gain: float  # log likelihood of the scene less that of the scene without this object alone; NaN for the background
    residual: float  # median of |observed - model| in metres over its pixels with a return, NaN where there are none


class PriorScore(NamedTuple):
    """What a prior says of a scene."""

    name: str  # of the prior: a file, a built-in one, or bare-image
    log_density: float  # -inf where the prior cannot make such a scene, NaN where it cannot be asked
    why: str = ""  # in a few words, where it is not finite; else empty


class Score(NamedTuple):
    """log_likelihood of a scene, the `Share` of each object, and what a prior says of it (or None)."""

    log_likelihood: float
    shares: tuple[Share, ...]
    prior: PriorScore | None = None

    def to_data(self) -> dict[str, Any]:
        """Return plain numbers for JSON; what is not finite becomes None."""

        prior = self.prior or PriorScore("", np.nan)
        return {
            "log_prior": finite_or_none(prior.log_density),
            "prior": prior.name,
            "why": prior.why,
            "log_likelihood": finite_or_none(self.log_likelihood),
            "objects": [
                {key: finite_or_none(value) for key, value in share._asdict().items()} for share in self.shares
            ],
        }


def score_prior(document: Document, given: str | None = None) -> PriorScore:
    """Score a scene file under a prior.

    given : a prior file, a built-in prior or "bare-image"; None: the prior that the scene file itself names (`made:`),
        and where it names none the default one.
    """
    from derender.structures.draws.numbers import BARE_IMAGE, scene_log_prior

    name = given or document.made_with or "tabletop"
    if name == BARE_IMAGE:
        try:
            density = scene_log_prior(document.graph)
        except DerenderError as error:
            return PriorScore(name, np.nan, str(error))
        return PriorScore(name, density, "" if density > -np.inf else "something does not touch what it rests on")
    try:
        prior = read_prior_document(name).prior
    except DerenderError as error:
        if given:
            raise
        return PriorScore(name, np.nan, f"{error.what}; give another with --prior")
    return PriorScore(name, float(prior.log_density(document.graph)), why_impossible(prior, document.graph) or "")


def score_scene(
    graph: SceneGraph,
    observed: np.ndarray,
    camera: Camera,
    likelihood: str = "gaussian",
    values: Mapping[str, float] | None = None,
) -> Score:
    """Score a scene against an image.

    graph : the scene. observed : (height, width) metres, NaN where nothing returned.
    likelihood, values : the type of likelihood and its numbers, see `render.likelihoods`.
    """
    solids = graph.solids()
    evaluator = DepthEvaluator(camera, observed, likelihood, values)
    total = evaluator.load(solids)
    per_pixel, model = evaluator.per_pixel(), evaluator.model_depth()
    _, label = render_depth(solids, camera)
    residual = np.where(np.isfinite(observed) & (observed > 0), np.abs(observed - model), np.nan)
    away = np.array([0.0, 0.0, -1e3])  # behind the camera an object does not show
    shares = []
    for k, name in [*enumerate(graph.solid_names), (-1, BACKGROUND)]:
        seen = label == k
        gain = np.nan
        if k >= 0:
            pose = solids.pose.copy()
            pose[k, :3, 3] = away
            if solids.kind[k] == PLANE:  # a plane is never behind the camera: move it out to the side, upright
                pose[k, :3, :3] = np.roll(np.eye(3), 1, axis=0)
                pose[k, :3, 3] = 1e9 * pose[k, :3, 2]
            gain = total - evaluator.load(solids._replace(pose=pose))
        off = residual[seen & np.isfinite(residual)]
        median = float(np.median(off)) if len(off) else np.nan
        shares.append(Share(name, int(seen.sum()), float(per_pixel[seen].sum()), float(gain), median))
    return Score(float(total), tuple(shares))


def why_impossible(prior: Prior, graph: SceneGraph) -> str | None:
    """Return in a few words what rules a scene out under a prior: the first cause found; None where nothing does."""
    if prior.log_density(graph) > -math.inf:
        return None
    return next(_causes(prior, graph), "its objects, or what rests on what, are none that this prior makes")


def _causes(prior: Any, graph: SceneGraph) -> Iterator[str]:
    always = getattr(prior, "tree", prior)
    names = always.by_name if isinstance(always, TreePrior) else {}
    for name in names:
        if name not in graph.names:
            yield f"it has no {name}, which this prior always has"
            return
    if isinstance(prior, TreePrior):
        for name in graph.names:
            if name not in names:
                yield f"it has {name}, which this prior has not"
                return
    if prior.root.log_density(graph.root_pose) == -math.inf:
        yield "the root does not stand before the camera where this prior puts it"
    for vertex in graph.vertices:
        kinds = [] if vertex.name in names else [entry.type for entry in prior.shapes.values()]
        if kinds and vertex.shape not in kinds:
            yield f"{vertex.name} is a {vertex.shape}, and this prior makes only {', '.join(sorted(set(kinds)))}"
        if vertex.supports and vertex.name not in names:
            yield f"{vertex.name} has a second support, and this prior makes none"
    for term in prior.constraints:
        if term.log_density(graph) == -math.inf:
            yield f"it breaks the constraint {term.name}"
    numbers = graph.numbers()
    for address, law in prior.free_addresses(graph).items():
        if address.startswith("root.") or address.endswith(QUATERNION) or address not in numbers:
            continue
        if law.log_density(numbers[address]) == -math.inf:
            low, high = law.support
            yield f"{address} is {numbers[address]:.4g}, outside of {low:.4g} to {high:.4g}"
