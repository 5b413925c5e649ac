"""Distributions on the whole line and on its positive half: normal, log-normal, exponential and gamma."""

import math
from statistics import NormalDist

from derender.scene.distributions.base import DistributionType, distributions

HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@distributions.register("normal")
class Normal(DistributionType):
    """Normal with a mean and a standard deviation."""

    parameters = ("mean", "sd")
    compiled = True

    @staticmethod
    def density(x, row):
        z = (x - row[0]) / row[1]
        return -0.5 * z * z - math.log(row[1]) - HALF_LOG_TWO_PI

    @staticmethod
    def draw(rng, row):
        return row[0] + row[1] * rng.standard_normal()

    def fault(self, parameters):
        return None if parameters[1] > 0 else f"sd {parameters[1]:g} is not positive"

    def cdf(self, x, parameters):
        mean, sd = parameters
        return 0.5 * math.erfc((mean - x) / (sd * math.sqrt(2.0)))

    def quantile(self, probability, parameters):
        return NormalDist(*parameters).inv_cdf(probability)

    def mean(self, parameters):
        return parameters[0]


@distributions.register("log-normal")
class LogNormal(DistributionType):
    """Positive, with a median and the standard deviation of its natural logarithm."""

    lowest = 0.0
    parameters = ("median", "log_sd")
    dimensionless = ("log_sd",)
    compiled = True

    @staticmethod
    def density(x, row):
        """Row: median, sd of the logarithm, log median."""
        if x <= 0.0:
            return -math.inf
        log_x = math.log(x)
        z = (log_x - row[2]) / row[1]
        return -0.5 * z * z - math.log(row[1]) - HALF_LOG_TWO_PI - log_x

    @staticmethod
    def draw(rng, row):
        return math.exp(row[2] + row[1] * rng.standard_normal())

    def fault(self, parameters):
        median, log_sd = parameters
        if median <= 0:
            return f"median {median:g} is not positive"
        return None if 0 < log_sd <= 20 else f"log_sd {log_sd:g} is not in (0, 20]"

    def row(self, parameters):
        return parameters[0], parameters[1], math.log(parameters[0]), 0.0

    def cdf(self, x, parameters):
        if x <= 0.0:
            return 0.0
        return 0.5 * math.erfc((math.log(parameters[0]) - math.log(x)) / (parameters[1] * math.sqrt(2.0)))

    def quantile(self, probability, parameters):
        return math.exp(NormalDist(math.log(parameters[0]), parameters[1]).inv_cdf(probability))

    def mean(self, parameters):
        return parameters[0] * math.exp(0.5 * parameters[1] ** 2)


@distributions.register("exponential")
class Exponential(DistributionType):
    """Positive, with a mean."""

    lowest = 0.0
    parameters = ("mean",)
    compiled = True

    @staticmethod
    def density(x, row):
        return -x / row[0] - math.log(row[0]) if x >= 0.0 else -math.inf

    @staticmethod
    def draw(rng, row):
        return row[0] * rng.standard_exponential()

    def fault(self, parameters):
        return None if parameters[0] > 0 else f"mean {parameters[0]:g} is not positive"

    def cdf(self, x, parameters):
        return -math.expm1(-x / parameters[0]) if x > 0 else 0.0

    def quantile(self, probability, parameters):
        return -parameters[0] * math.log1p(-probability)

    def mean(self, parameters):
        return parameters[0]


@distributions.register("gamma")
class Gamma(DistributionType):
    """Positive, with a shape and a scale; the mean is their product."""

    lowest = 0.0
    parameters = ("shape", "scale")
    dimensionless = ("shape",)
    compiled = True

    @staticmethod
    def density(x, row):
        """Row: shape, scale, log of the normalising constant."""
        if x <= 0.0:
            return -math.inf
        return (row[0] - 1.0) * math.log(x) - x / row[1] - row[2]

    @staticmethod
    def draw(rng, row):
        return row[1] * rng.standard_gamma(row[0])

    def fault(self, parameters):
        shape, scale = parameters
        return None if shape > 0 and scale > 0 else "shape and scale have to be positive"

    def row(self, parameters):
        shape, scale = parameters
        return shape, scale, math.lgamma(shape) + shape * math.log(scale), 0.0

    def cdf(self, x, parameters):
        from scipy.special import gammainc

        return float(gammainc(parameters[0], max(x, 0.0) / parameters[1]))

    def quantile(self, probability, parameters):
        from scipy.special import gammaincinv

        return float(gammaincinv(parameters[0], probability) * parameters[1])

    def mean(self, parameters):
        return parameters[0] * parameters[1]
