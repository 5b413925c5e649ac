"""The uniform distribution on an interval."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    return -math.log(row[1] - row[0]) if row[0] <= x <= row[1] else -math.inf


def draw(rng, row):
    return row[0] + (row[1] - row[0]) * rng.random()


@distributions.register("uniform")
class Uniform(DistributionType):
    """Uniform on [lower, upper]."""

    parameters = ("lower", "upper")
    code = 1
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        lower, upper = parameters
        return None if lower < upper else f"lower {lower:g} is not below upper {upper:g}"

    def support(self, parameters):
        return parameters[0], parameters[1]

    def cdf(self, x, parameters):
        lower, upper = parameters
        return min(max((x - lower) / (upper - lower), 0.0), 1.0)

    def quantile(self, probability, parameters):
        lower, upper = parameters
        return lower + (upper - lower) * probability

    def mean(self, parameters):
        return 0.5 * (parameters[0] + parameters[1])
