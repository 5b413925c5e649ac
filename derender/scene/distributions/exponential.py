"""The exponential distribution."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    return -x / row[0] - math.log(row[0]) if x >= 0.0 else -math.inf


def draw(rng, row):
    return row[0] * rng.standard_exponential()


@distributions.register("exponential")
class Exponential(DistributionType):
    """Positive, with a mean."""

    parameters = ("mean",)
    code = 6
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        return None if parameters[0] > 0 else f"mean {parameters[0]:g} is not positive"

    def support(self, parameters):
        return 0.0, math.inf

    def cdf(self, x, parameters):
        return -math.expm1(-x / parameters[0]) if x > 0 else 0.0

    def quantile(self, probability, parameters):
        return -parameters[0] * math.log1p(-probability)

    def mean(self, parameters):
        return parameters[0]
