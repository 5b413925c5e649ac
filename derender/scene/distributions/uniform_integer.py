"""The uniform distribution on a range of whole numbers."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    if x < row[0] or x > row[1] or x != math.floor(x):
        return -math.inf
    return -math.log(row[1] - row[0] + 1.0)


def draw(rng, row):
    return int(row[0]) + int((row[1] - row[0] + 1.0) * rng.random())


@distributions.register("uniform-integer")
class UniformInteger(DistributionType):
    """lower, lower + 1, ..., upper."""

    parameters = ("lower", "upper")
    discrete = True
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        lower, upper = parameters
        if lower != math.floor(lower) or upper != math.floor(upper):
            return "lower and upper have to be whole numbers"
        return None if lower <= upper <= lower + 1e6 else f"it is not true that {lower:g} <= upper <= lower + 1e6"

    def support(self, parameters):
        return parameters[0], parameters[1]

    def cdf(self, x, parameters):
        lower, upper = parameters
        return min(max((math.floor(x) - lower + 1.0) / (upper - lower + 1.0), 0.0), 1.0)

    def mean(self, parameters):
        return 0.5 * (parameters[0] + parameters[1])
