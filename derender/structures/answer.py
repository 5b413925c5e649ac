"""What is said of the image as it came, beside the structures: what explains each pixel, and what may be missed."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import CORRELATED, Observation, of_whole_image
from derender.detection.solids.beliefs import bare_image
from derender.detection.solids.misfit import AS_SEEN
from derender.results.explanation import Explanation
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse
from derender.scene.priors.bare_image import Missed
from derender.structures.options import Frame

if TYPE_CHECKING:
    from derender.results.posterior import StructurePosterior
    from derender.structures.together import Look


def missed_by(observations: list[Observation], extras: dict[str, dict[str, float | str] | list[float] | float],
              missed: Missed, explained: float) -> float:  # fmt: skip
    """Return the probability that the search has missed what is there.

    That of the image as a whole, and of each solid: what shows in few pixels may be something else, or two.

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


def whole_camera(camera: Any, shape: tuple[int, int]) -> Any:
    """Return the Camera that a mapping of fx, fy, cx, cy or a Camera is for an image of this shape."""

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
