"""Whether a scene explains an image as well as its likelihood lets expect: a posterior predictive check."""

import numpy as np

from derender.posterior.target import SceneTarget
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.render.raycast.evaluator import DepthEvaluator

DRAWN_IMAGES = 10  # of a scene, from which the spread of their log density is known to a quarter


def short_of_noise(rng: np.random.Generator, target: SceneTarget, values: np.ndarray) -> float:
    """Return by how many standard deviations the image is less likely under values (P,) than images drawn of them.

    Where either has no return neither counts: how much of an image returned says nothing of the scene.
    """
    kind, camera = likelihoods[target.images.type], target.images.camera
    numbers = kind.complete({**target.images.values, **target.of_likelihood(values)})
    clean, _ = render_depth(target.graph(values).solids(), camera, background=numbers["background"])

    def densities(image: np.ndarray) -> np.ndarray:
        """Return the log density (H, W) of each pixel, NaN without a return."""
        evaluator = DepthEvaluator.of_depth(image, clean, kind.name, numbers)
        evaluator.set_values({})
        return np.where(np.isfinite(image) & (image > 0.0), evaluator.per_pixel(), np.nan)

    own = densities(target.images.observed)
    short = [np.nansum(densities(kind.sample(rng, clean, numbers)) - own) for _ in range(DRAWN_IMAGES)]
    spread = np.std(short, ddof=1)
    return float(np.mean(short) / spread) if spread > 0.0 else 0.0  # none: no pixel has a return
