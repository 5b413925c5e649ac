"""The log-normal distribution."""

import math
from statistics import NormalDist

from derender.scene.distributions.base import DistributionType, distributions

HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


def density(x, row):
    """Row: median, sd of the logarithm, log median."""
    if x <= 0.0:
        return -math.inf
    log_x = math.log(x)
    z = (log_x - row[2]) / row[1]
    return -0.5 * z * z - math.log(row[1]) - HALF_LOG_TWO_PI - log_x


def draw(rng, row):
    return math.exp(row[2] + row[1] * rng.standard_normal())


@distributions.register("log-normal")
class LogNormal(DistributionType):
    """Positive, with a median and the standard deviation of its natural logarithm."""

    parameters = ("median", "log_sd")
    dimensionless = ("log_sd",)
    code = 4
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        median, log_sd = parameters
        if median <= 0:
            return f"median {median:g} is not positive"
        return None if 0 < log_sd <= 20 else f"log_sd {log_sd:g} is not in (0, 20]"

    def row(self, parameters):
        return parameters[0], parameters[1], math.log(parameters[0]), 0.0

    def support(self, parameters):
        return 0.0, math.inf

    def cdf(self, x, parameters):
        if x <= 0.0:
            return 0.0
        return 0.5 * math.erfc((math.log(parameters[0]) - math.log(x)) / (parameters[1] * math.sqrt(2.0)))

    def quantile(self, probability, parameters):
        return math.exp(NormalDist(math.log(parameters[0]), parameters[1]).inv_cdf(probability))

    def mean(self, parameters):
        return parameters[0] * math.exp(0.5 * parameters[1] ** 2)
