"""The likelihood of antialiased depth images with its exact derivatives: what optimisers and gradient proposals ask."""

import math

import numpy as np

from derender.model.solids import Solids
from derender.vision.blur import blur, blur_taps
from derender.vision.raycast.antialias import draw_antialiased
from derender.vision.raycast.canvas import new_canvas
from derender.vision.raycast.normal_equations import BACKGROUND, cost, cost_gradient, new_misfit, normal_equations
from derender.vision.raycast.records import MOTION, new_records, spread
from derender.vision.raycast.sensitivity import record


def antialiased_depth(solids: Solids, camera, background: float = 10.0, blur_sigma: float = 0.0) -> np.ndarray:
    """Return the (height, width) mean depth over the area of each pixel, blurred by `blur_sigma` pixels."""
    canvas = new_canvas(camera, len(solids.kind), solids)
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
    canvas, records = new_canvas(camera, count, solids), new_records(camera, count)
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
    extra_blur : pixels by which model *and* observation are blurred further (coarse-to-fine).
    limit : cost at which a pixel counts as an outlier, in nats; infinite for the normal likelihood of Eq. 6.
    parameters : most parameters that `equations` will be asked for.
    edges : False leaves out the occlusion edges, which makes the derivative wrong: for comparison only.
    scene : Solids with the meshes, where there are any.
    """

    def __init__(
        self,
        camera,
        observed,
        kinds,
        sigma=0.005,
        blur_sigma=1.0,
        background=10.0,
        extra_blur=0.0,
        limit=math.inf,
        parameters=1,
        edges=True,
        scene=None,
    ) -> None:
        observed = np.asarray(observed, float)
        seen = np.isfinite(observed) & (observed > 0)
        if extra_blur > 0:
            share = blur(seen.astype(float), extra_blur)
            smooth = blur(np.where(seen, observed, 0.0), extra_blur)
            observed = np.where(seen, smooth / np.maximum(share, 1e-9), np.nan)
        self._sigma = np.broadcast_to(np.asarray(sigma, float), observed.shape)
        self._constant = -float(np.sum(np.log(self._sigma[seen]) + 0.5 * math.log(2 * math.pi)))
        taps = blur_taps(math.hypot(blur_sigma, extra_blur))
        self.misfit = new_misfit(camera, observed, sigma, kinds, max(parameters, 1), taps, background, limit, scene)
        self.edges = edges

    def cost(self, poses: np.ndarray, sizes: np.ndarray) -> float:
        """Return minus the log likelihood up to a constant. poses : (N, 4, 4), sizes : (N, 3) C-contiguous float64."""
        return cost(self.misfit, poses, sizes)

    def log_likelihood(self, solids: Solids) -> float:
        """Return Eq. 6's log density, missing pixels left out."""
        _, poses, sizes = _arrays(solids)
        return self._constant - cost(self.misfit, poses, sizes)

    def gradient(self, solids: Solids, active=None) -> tuple[float, np.ndarray]:
        """Return (log likelihood, its derivative (N, 9) by every solid's motion), in one pass.

        A motion is a twist (v, w) about the camera's centre, in metres and radians, and the growth of the three
        extents.
        A parameter that moves several solids rigidly collects the sum of their twists' rows (Eqs. 7-9).
        """
        _, poses, sizes = _arrays(solids)
        totals = np.zeros((len(poses), MOTION))
        active = np.ones(len(poses), bool) if active is None else np.asarray(active, bool)
        value = cost(self.misfit, poses, sizes)
        cost_gradient(self.misfit, poses, sizes, active, self.edges, totals)
        return self._constant - value, -totals

    def equations(self, poses, sizes, motions) -> tuple[float, np.ndarray, np.ndarray]:
        """Return (cost, gradient (P,), Gauss-Newton Hessian (P, P)) by parameters with these motions (P, N, 9)."""
        count = len(motions)
        gradient, hessian = np.zeros(count), np.zeros((count, count))
        value = cost(self.misfit, poses, sizes)
        normal_equations(self.misfit, poses, sizes, motions, self.edges, gradient, hessian)
        return value, gradient, hessian

    @property
    def background(self) -> float:
        """Depth in metres where nothing is hit."""
        return float(self.misfit.numbers[BACKGROUND])


def _arrays(solids: Solids):
    return (
        np.ascontiguousarray(solids.kind, np.int32),
        np.ascontiguousarray(solids.pose, np.float64),
        np.ascontiguousarray(solids.size, np.float64),
    )
