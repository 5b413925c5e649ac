"""The geometric distribution: how many, when each further one needs another success."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    if x < 0 or x != math.floor(x):
        return -math.inf
    return x * math.log(row[0]) + math.log1p(-row[0])


def draw(rng, row):
    return int(rng.geometric(1.0 - row[0])) - 1


@distributions.register("geometric")
class Geometric(DistributionType):
    """0, 1, 2, ...: after each one, another follows with probability `more`."""

    parameters = ("more",)
    discrete = True
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        return None if 0 < parameters[0] < 1 else f"more {parameters[0]:g} is not between 0 and 1"

    def support(self, parameters):
        return 0.0, math.inf

    def cdf(self, x, parameters):
        return 1.0 - parameters[0] ** (math.floor(x) + 1.0) if x >= 0 else 0.0

    def mean(self, parameters):
        return parameters[0] / (1.0 - parameters[0])
