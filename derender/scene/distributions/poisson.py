"""The Poisson distribution: how many, when nothing bounds the number."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    if x < 0 or x != math.floor(x):
        return -math.inf
    return x * math.log(row[0]) - row[0] - math.lgamma(x + 1.0)


def draw(rng, row):
    return int(rng.poisson(row[0]))


@distributions.register("poisson")
class Poisson(DistributionType):
    """0, 1, 2, ... with a mean."""

    parameters = ("mean",)
    discrete = True
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        return None if 0 < parameters[0] <= 1e4 else f"mean {parameters[0]:g} is not in (0, 1e4]"

    def support(self, parameters):
        return 0.0, math.inf

    def cdf(self, x, parameters):
        from scipy.special import pdtr

        return float(pdtr(math.floor(x), parameters[0])) if x >= 0 else 0.0

    def mean(self, parameters):
        return parameters[0]
