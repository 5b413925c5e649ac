"""What real depth cameras do to a clean depth image: noise that grows with depth, coarse disparity, lost pixels.

Used to make examples and evaluation sets; inference has its own likelihoods, which do not know these.
"""

from dataclasses import dataclass

import numpy as np

from derender.errors import DerenderError
from derender.registry import suggest


@dataclass(frozen=True)
class Sensor:
    """A model of a depth camera.

    noise_floor : standard deviation at `nearest`, metres.
    noise_growth : coefficient of the quadratic growth: sd = noise_floor + noise_growth (z - nearest)^2, 1 / metre.
    nearest, farthest : range in metres; outside nothing returns.
    baseline_focal : product of baseline in metres and focal length in the sensor's own pixels: disparity is
        baseline_focal / z, whatever the size of the image that it is resampled to.
    disparity_step : in the sensor's pixels.
    edge_loss, loss : share of the pixels lost at depth edges, and of all pixels.
    edge_step : an unexpected difference between neighbours above this share of the inverse depth is an edge.
    smoothing : standard deviation in pixels of the correlation of the noise; 0 is none.
    """

    noise_floor: float
    noise_growth: float
    nearest: float
    farthest: float
    baseline_focal: float
    disparity_step: float
    edge_loss: float
    loss: float
    edge_step: float = 0.02
    smoothing: float = 0.0

    def observe(self, rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
        """Return the (height, width) depth image that the sensor gives of a clean one; NaN where nothing returns."""
        clean = np.array(depth, dtype=float)
        with np.errstate(invalid="ignore"):
            clean[~((clean >= self.nearest) & (clean <= self.farthest))] = np.nan
        deviation = self.noise_floor + self.noise_growth * (clean - self.nearest) ** 2
        noisy = clean + deviation * self._unit_noise(rng, clean.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            disparity = np.round(self.baseline_focal / noisy / self.disparity_step) * self.disparity_step
            noisy = self.baseline_focal / disparity
        edge = depth_edges(depth, self.edge_step)
        lost = edge & (rng.random(clean.shape) < self.edge_loss)
        lost |= rng.random(clean.shape) < self.loss
        noisy[lost | ~(noisy > 0) | np.isinf(noisy)] = np.nan
        return noisy

    def _unit_noise(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        noise = rng.standard_normal(shape)
        if self.smoothing:
            from scipy.ndimage import gaussian_filter

            noise = gaussian_filter(noise, self.smoothing, mode="wrap")
            # The kernel's energy, so that the variance is one again at every pixel.
            impulse = np.zeros((33, 33))
            impulse[16, 16] = 1
            noise /= np.sqrt(np.sum(gaussian_filter(impulse, self.smoothing, mode="wrap") ** 2))
        return noise


SENSORS = {
    # Kinect v1, structured light: Nguyen, Izadi and Lovell 2012, Eq. 5 (axial noise 0.0012 + 0.0019 (z - 0.4)^2),
    # 580 pixels x 75 mm, disparity in eighths of a pixel (Khoshelham and Elberink 2012).
    "kinect": Sensor(0.0012, 0.0019, 0.4, 8.0, 580 * 0.075, 1 / 8, edge_loss=0.6, loss=0.01),
    # RealSense D400, active stereo: 0.08 pixel of subpixel error at 640 pixels x 50 mm gives 2.6 mm at 1 m; disparity
    # in 32nds of a pixel; matching over windows correlates the noise and eats more of the edges.
    "realsense": Sensor(0.0005, 0.0026, 0.2, 6.0, 640 * 0.05, 1 / 32, edge_loss=0.8, loss=0.02, smoothing=1.0),
}


def find_sensor(name: str) -> Sensor:
    """Return a sensor by name, or raise DerenderError with the names that there are."""
    if name not in SENSORS:
        raise DerenderError(f"no sensor is called {name!r}", remedy=suggest(name, SENSORS))
    return SENSORS[name]


def depth_edges(depth: np.ndarray, step: float) -> np.ndarray:
    """Return (height, width) bool: pixels beside a jump in depth, or beside one without a return.

    Between two neighbours there is a jump where their inverse depths differ by more than the share `step` from what
    either side's slope leads to expect: inverse depth is affine on a plane, so a slanted one has none.
    """
    depth = np.asarray(depth, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(np.isfinite(depth) & (depth > 0), 1 / depth, 0.0)
    jumps = _jumps(inverse, step)
    return (jumps | _jumps(inverse.T, step).T) & (inverse > 0)


def _jumps(inverse: np.ndarray, step: float) -> np.ndarray:
    """Return bool of the same shape: pixels beside a jump along the rows."""
    ahead = np.diff(inverse, axis=1)
    # At the border one side alone leads to expect anything; in an image of two columns nothing does.
    slopes = np.pad(ahead, ((0, 0), (1, 1)), constant_values=np.inf)
    unexpected = np.minimum(np.abs(ahead - slopes[:, :-2]), np.abs(ahead - slopes[:, 2:]))
    jump = np.isfinite(unexpected) & (unexpected > step * np.minimum(inverse[:, :-1], inverse[:, 1:]))
    beside = np.zeros(inverse.shape, dtype=bool)
    beside[:, :-1] |= jump
    beside[:, 1:] |= jump
    return beside
