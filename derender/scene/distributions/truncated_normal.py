"""The normal distribution cut to an interval.

The mass between the bounds is computed on the side of the mean where both tails are small, by erfc, so that an interval
ten standard deviations out keeps its relative precision.
"""

import math

from derender.scene.distributions.base import DistributionType, bisected, distributions

HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
ROOT_HALF = math.sqrt(0.5)


def density(x, row):
    mean, sd = row[0], row[1]
    if x < row[2] or x > row[3]:
        return -math.inf
    a, b = (row[2] - mean) / sd, (row[3] - mean) / sd
    if a + b < 0.0:  # by symmetry, so that erfc sees positive arguments where it can
        a, b = -b, -a
    mass = 0.5 * (math.erfc(a * ROOT_HALF) - math.erfc(b * ROOT_HALF))
    z = (x - mean) / sd
    return -0.5 * z * z - math.log(sd) - HALF_LOG_TWO_PI - math.log(mass)


def draw(rng, row):
    """Reject: from the normal where the interval keeps much of it, from the uniform elsewhere (both bounds finite)."""
    mean, sd, lower, upper = row[0], row[1], row[2], row[3]
    if lower - 0.5 * sd <= mean <= upper + 0.5 * sd and upper - lower > 2.0 * sd:
        while True:
            x = mean + sd * rng.standard_normal()
            if lower <= x <= upper:
                return x
    mode = min(max(mean, lower), upper)
    offset = (mode - mean) / sd
    if abs(offset) * (upper - lower) / sd > 4.0:  # far in a tail: exponential proposals (Robert 1995)
        while True:
            step = rng.standard_exponential() / abs(offset)
            if step * sd <= upper - lower and rng.random() <= math.exp(-0.5 * step * step):
                return mode + sd * step if offset > 0 else mode - sd * step
    while True:
        x = lower + (upper - lower) * rng.random()
        z = (x - mean) / sd
        if rng.random() <= math.exp(0.5 * (offset * offset - z * z)):
            return x


@distributions.register("truncated-normal")
class TruncatedNormal(DistributionType):
    """Normal with a mean and a standard deviation before it was cut to [lower, upper]."""

    parameters = ("mean", "sd", "lower", "upper")
    code = 3
    density = staticmethod(density)
    draw = staticmethod(draw)

    def fault(self, parameters):
        mean, sd, lower, upper = parameters
        if sd <= 0:
            return f"sd {sd:g} is not positive"
        if lower >= upper:
            return f"lower {lower:g} is not below upper {upper:g}"
        if max(lower - mean, mean - upper) > 30.0 * sd:
            return "the interval is more than 30 standard deviations from the mean"
        return None

    def support(self, parameters):
        return parameters[2], parameters[3]

    def cdf(self, x, parameters):
        mean, sd, lower, upper = parameters
        a, b = (lower - mean) / sd, (upper - mean) / sd
        z = (min(max(x, lower), upper) - mean) / sd
        if a + b < 0.0:
            below = math.erfc(-z * ROOT_HALF) - math.erfc(-a * ROOT_HALF)
            return below / (math.erfc(-b * ROOT_HALF) - math.erfc(-a * ROOT_HALF))
        below = math.erfc(a * ROOT_HALF) - math.erfc(z * ROOT_HALF)
        return below / (math.erfc(a * ROOT_HALF) - math.erfc(b * ROOT_HALF))

    def quantile(self, probability, parameters):
        return bisected(lambda x: self.cdf(x, parameters), probability, parameters[2], parameters[3])

    def mean(self, parameters):
        mean, sd, lower, upper = parameters
        row = self.row(parameters)
        return mean + sd * sd * (math.exp(density(lower, row)) - math.exp(density(upper, row)))
