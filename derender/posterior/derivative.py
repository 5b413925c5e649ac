"""The derivative of a scene's posterior on the antialiased image, for proposals that follow it."""

import math

import numpy as np

from derender.posterior.map import MapProblem
from derender.posterior.space import Space

STEP = 1e-4  # of differences of the log prior, as a share of its spread


def followed(space: Space) -> list[int]:
    """Return the unknowns that have an image derivative: continuous numbers of contacts and shapes."""
    return [
        i
        for i, unknown in enumerate(space.unknowns)
        if unknown.ways == 1 and unknown.address.partition(".")[0] not in ("root", "likelihood")
    ]


class SceneDerivative:
    """Gradient and Gauss-Newton precision of the log posterior of a SceneTarget, a function of the values alone.

    The likelihood is the normal one on the antialiased image (for other types with outliers forgiven from 8 nats on):
    not quite the one that chains are judged by, which is why a proposal that follows it needs its exact ratio. Nothing
    is known of rotations, of the root and of the likelihood's unknowns: their gradient is zero, their precision the
    prior's. One object per thread.

    Raises
    ------
    DerenderError : the scene has no compiled derivative.
    """

    def __init__(self, target) -> None:
        self.target, self.space = target, target.space
        self.unknowns = followed(self.space)
        space, images = target.space, target.images
        self.offsets = [int(space.offsets[i]) for i in self.unknowns]
        self.directions = [int(space.directions[i]) for i in self.unknowns]
        self.sigma = images.values.get("sigma", 0.005)
        self.sigma_at = space.addresses.index("likelihood.sigma") if "likelihood.sigma" in space.addresses else None
        self.problem = MapProblem(
            target.template, [space.unknowns[i].address for i in self.unknowns], images.camera, images.observed,
            sigma=self.sigma, blur=images.values.get("blur", 0.0), background=images.values.get("background", 10.0),
            limit=math.inf if images.type == "gaussian" else 8.0,
        )  # fmt: skip

    def at(self, values: np.ndarray, temperature: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradient (D,) and the precision (D, D), positive definite, with the likelihood tempered."""
        gradient = np.zeros(self.space.directions[-1])
        precision = np.diag(1.0 / np.square(self.space.scales))
        self.problem.placement.root[:] = self.target.root_pose(values)
        shape = self.problem.laplace(values[self.offsets])
        weight = temperature
        if self.sigma_at is not None:
            weight *= (self.sigma / values[self.sigma_at]) ** 2
        gradient[self.directions] += weight * shape.gradient
        precision[np.ix_(self.directions, self.directions)] += weight * shape.precision
        for i, offset, direction in zip(self.unknowns, self.offsets, self.directions, strict=True):
            law, step = self.space.unknowns[i].distribution, STEP * self.space.scales[direction]
            change = law.log_density(values[offset] + step) - law.log_density(values[offset] - step)
            if math.isfinite(change):
                gradient[direction] += change / (2.0 * step)
        return gradient, precision
