"""The gamma distribution."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    """Row: shape, scale, log of the normalising constant."""
    if x <= 0.0:
        return -math.inf
    return (row[0] - 1.0) * math.log(x) - x / row[1] - row[2]


def draw(rng, row):
    return row[1] * rng.standard_gamma(row[0])


@distributions.register("gamma")
class Gamma(DistributionType):
    """Positive, with a shape and a scale; the mean is their product."""

    parameters = ("shape", "scale")
    dimensionless = ("shape",)
    code = 7
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        shape, scale = parameters
        return None if shape > 0 and scale > 0 else "shape and scale have to be positive"

    def row(self, parameters):
        shape, scale = parameters
        return shape, scale, math.lgamma(shape) + shape * math.log(scale), 0.0

    def support(self, parameters):
        return 0.0, math.inf

    def cdf(self, x, parameters):
        from scipy.special import gammainc

        return float(gammainc(parameters[0], max(x, 0.0) / parameters[1]))

    def quantile(self, probability, parameters):
        from scipy.special import gammaincinv

        return float(gammaincinv(parameters[0], probability) * parameters[1])

    def mean(self, parameters):
        return parameters[0] * parameters[1]
