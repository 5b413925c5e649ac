"""The log-uniform distribution: every factor of two is as likely as another."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    """Row: lower, upper, log lower, log log(upper / lower)."""
    return -math.log(x) - row[3] if row[0] <= x <= row[1] else -math.inf


def draw(rng, row):
    x = math.exp(row[2] + math.exp(row[3]) * rng.random())
    return min(max(x, row[0]), row[1])  # rounding must not leave the support


@distributions.register("log-uniform")
class LogUniform(DistributionType):
    """Uniform in the logarithm on [lower, upper]."""

    parameters = ("lower", "upper")
    code = 5
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        lower, upper = parameters
        if not lower > 0:
            return f"lower {lower:g} is not above 0"
        return None if lower < upper else f"lower {lower:g} is not below upper {upper:g}"

    def row(self, parameters):
        lower, upper = parameters
        return lower, upper, math.log(lower), math.log(math.log(upper / lower))

    def support(self, parameters):
        return parameters[0], parameters[1]

    def cdf(self, x, parameters):
        lower, upper = parameters
        return math.log(min(max(x, lower), upper) / lower) / math.log(upper / lower)

    def quantile(self, probability, parameters):
        lower, upper = parameters
        return lower * (upper / lower) ** probability

    def mean(self, parameters):
        lower, upper = parameters
        return (upper - lower) / math.log(upper / lower)
