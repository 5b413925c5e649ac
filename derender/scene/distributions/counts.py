"""Distributions over whole numbers: a range of them, Poisson and geometric."""

import math

from derender.scene.distributions.base import DistributionType, distributions


@distributions.register("uniform-integer")
class UniformInteger(DistributionType):
    """lower, lower + 1, ..., upper."""

    parameters = ("lower", "upper")
    discrete = True

    @staticmethod
    def density(x, row):
        if x < row[0] or x > row[1] or x != math.floor(x):
            return -math.inf
        return -math.log(row[1] - row[0] + 1.0)

    @staticmethod
    def draw(rng, row):
        return int(row[0]) + int((row[1] - row[0] + 1.0) * rng.random())

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


@distributions.register("poisson")
class Poisson(DistributionType):
    """0, 1, 2, ... with a mean."""

    lowest = 0.0
    parameters = ("mean",)
    discrete = True

    @staticmethod
    def density(x, row):
        if x < 0 or x != math.floor(x):
            return -math.inf
        return x * math.log(row[0]) - row[0] - math.lgamma(x + 1.0)

    @staticmethod
    def draw(rng, row):
        return int(rng.poisson(row[0]))

    def fault(self, parameters):
        return None if 0 < parameters[0] <= 1e4 else f"mean {parameters[0]:g} is not in (0, 1e4]"

    def cdf(self, x, parameters):
        from scipy.special import pdtr

        return float(pdtr(math.floor(x), parameters[0])) if x >= 0 else 0.0

    def mean(self, parameters):
        return parameters[0]


@distributions.register("geometric")
class Geometric(DistributionType):
    """0, 1, 2, ...: after each one, another follows with probability `more`."""

    lowest = 0.0
    parameters = ("more",)
    discrete = True

    @staticmethod
    def density(x, row):
        if x < 0 or x != math.floor(x):
            return -math.inf
        return x * math.log(row[0]) + math.log1p(-row[0])

    @staticmethod
    def draw(rng, row):
        return int(rng.geometric(1.0 - row[0])) - 1

    def fault(self, parameters):
        return None if 0 < parameters[0] < 1 else f"more {parameters[0]:g} is not between 0 and 1"

    def cdf(self, x, parameters):
        return 1.0 - parameters[0] ** (math.floor(x) + 1.0) if x >= 0 else 0.0

    def mean(self, parameters):
        return parameters[0] / (1.0 - parameters[0])
