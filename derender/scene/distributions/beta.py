"""The beta distribution, on [0, 1] or stretched to another interval."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    a, b, lower, upper = row[0], row[1], row[2], row[3]
    t = (x - lower) / (upper - lower)
    if t <= 0.0 or t >= 1.0:  # the ends have no mass; a density there may be infinite
        return -math.inf
    constant = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) - math.log(upper - lower)
    return constant + (a - 1.0) * math.log(t) + (b - 1.0) * math.log1p(-t)


def draw(rng, row):
    first = rng.standard_gamma(row[0])
    second = rng.standard_gamma(row[1])
    return row[2] + (row[3] - row[2]) * first / (first + second)


@distributions.register("beta")
class Beta(DistributionType):
    """Beta with shapes a and b on (lower, upper), by default (0, 1)."""

    parameters = ("a", "b", "lower", "upper")
    defaults = (0.0, 1.0)
    dimensionless = ("a", "b")
    code = 8
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        a, b, lower, upper = parameters
        if min(a, b) < 0.01:
            return "a and b have to be at least 0.01"
        return None if lower < upper else f"lower {lower:g} is not below upper {upper:g}"

    def support(self, parameters):
        return parameters[2], parameters[3]

    def cdf(self, x, parameters):
        from scipy.special import betainc

        a, b, lower, upper = parameters
        return float(betainc(a, b, min(max((x - lower) / (upper - lower), 0.0), 1.0)))

    def quantile(self, probability, parameters):
        from scipy.special import betaincinv

        a, b, lower, upper = parameters
        return float(lower + (upper - lower) * betaincinv(a, b, probability))

    def mean(self, parameters):
        a, b, lower, upper = parameters
        return lower + (upper - lower) * a / (a + b)
