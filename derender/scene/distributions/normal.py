"""The normal distribution."""

import math
from statistics import NormalDist

from derender.scene.distributions.base import DistributionType, distributions

HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


def density(x, row):
    z = (x - row[0]) / row[1]
    return -0.5 * z * z - math.log(row[1]) - HALF_LOG_TWO_PI


def draw(rng, row):
    return row[0] + row[1] * rng.standard_normal()


@distributions.register("normal")
class Normal(DistributionType):
    """Normal with a mean and a standard deviation."""

    parameters = ("mean", "sd")
    code = 2
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        return None if parameters[1] > 0 else f"sd {parameters[1]:g} is not positive"

    def support(self, parameters):
        return -math.inf, math.inf

    def cdf(self, x, parameters):
        mean, sd = parameters
        return 0.5 * math.erfc((mean - x) / (sd * math.sqrt(2.0)))

    def quantile(self, probability, parameters):
        return NormalDist(*parameters).inv_cdf(probability)

    def mean(self, parameters):
        return parameters[0]
