"""The likelihood of antialiased depth images with its exact derivatives: what optimisers and gradient proposals ask."""

import math

import numpy as np

from derender.render.blur import blur, blur_taps
from derender.render.raycast.antialias import draw_antialiased
from derender.render.raycast.canvas import new_canvas
from derender.render.raycast.normal_equations import (
    MOTION,
    cost,
    new_misfit,
    new_records,
    normal_equations,
    record,
    spread,
)
from derender.scene.solids import Solids


def antialiased_depth(solids: Solids, camera, background: float = 10.0, blur_sigma: float = 0.0) -> np.ndarray:
    """Return the (height, width) mean depth over the area of each pixel, blurred by `blur_sigma` pixels."""
    canvas = new_canvas(camera, len(solids.kind))
    window = np.array([0, camera.width, 0, camera.height], np.int64)
    draw_antialiased(canvas, *_arrays(solids), float(background), window)  # type: ignore[call-arg]
    return blur(canvas.depth, blur_sigma)


def derivative_image(
    solids: Solids, camera, moving: int, motion, background: float = 10.0, blur_sigma: float = 0.0, edges: bool = True
) -> np.ndarray:
    """Return the derivative (height, width) of `antialiased_depth` by a motion (9,) of one solid.

    A motion is a twist (v, w) about the camera's centre and the growth of the three extents.
    edges : False leaves out the occlusion edges, which makes it wrong: for comparison only.
    """
    count, width, height = len(solids.kind), camera.width, camera.height
    canvas, records = new_canvas(camera, count), new_records(camera, count)
    window, motions = np.array([0, width, 0, height]), np.zeros((1, count, MOTION))
    images = np.zeros((1, width * height))
    kinds, poses, sizes = _arrays(solids)
    draw_antialiased(canvas, kinds, poses, sizes, float(background), window)
    active = np.arange(count) == moving
    record(canvas, records, kinds, poses, sizes, active, float(background), window, edges)
    motions[0, moving] = motion
    spread(records, motions, active[None], images)
    return blur(images[0].reshape(height, width), blur_sigma)


class SmoothLikelihood:
    """Log likelihood of scenes given one depth image, on the antialiased image, with derivatives by motions.

    Parameters
    ----------
    camera : Camera. observed : (height, width) metres, NaN or 0 where nothing returned.
    kinds : (N,) int32 of the scenes' solids.
    sigma : noise in metres, a number or (height, width). blur_sigma : pixels. background : metres.
    parameters : most parameters that `equations` will be asked for.
    """

    def __init__(self, camera, observed, kinds, sigma=0.005, blur_sigma=1.0, background=10.0, parameters=1) -> None:
        observed = np.asarray(observed, float)
        seen = np.isfinite(observed) & (observed > 0)
        spread = np.broadcast_to(np.asarray(sigma, float), observed.shape)
        self._constant = -float(np.sum(np.log(spread[seen]) + 0.5 * math.log(2 * math.pi)))
        self.misfit = new_misfit(camera, observed, sigma, kinds, parameters, blur_taps(blur_sigma), background)

    def log_likelihood(self, solids: Solids) -> float:
        """Return Eq. 6's log density, missing pixels left out."""
        _, poses, sizes = _arrays(solids)
        return self._constant - cost(self.misfit, poses, sizes)

    def equations(self, poses, sizes, motions) -> tuple[float, np.ndarray, np.ndarray]:
        """Return (cost, gradient (P,), Gauss-Newton Hessian (P, P)) by parameters with these motions (P, N, 9)."""
        count = len(motions)
        gradient, hessian = np.zeros(count), np.zeros((count, count))
        value = cost(self.misfit, poses, sizes)
        normal_equations(self.misfit, poses, sizes, motions, True, gradient, hessian)
        return value, gradient, hessian


def _arrays(solids: Solids):
    return (
        np.ascontiguousarray(solids.kind, np.int32),
        np.ascontiguousarray(solids.pose, np.float64),
        np.ascontiguousarray(solids.size, np.float64),
    )
