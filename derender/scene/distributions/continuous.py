"""Distributions over real numbers, over those of an interval, over angles and over rotations.

The truncated normal's mass is computed on the side of the mean where both tails are small, by erfc, so that an interval
ten standard deviations out keeps its relative precision.
"""

import math
from statistics import NormalDist
from typing import Any

import numpy as np

from derender.scene.distributions.discrete import Distribution, bisected, distributions

HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@distributions.register("normal")
class Normal(Distribution):
    """Normal with a mean and a standard deviation."""

    names = ("mean", "sd")
    positive = ("sd",)
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        z = (x - row[0]) / row[1]
        return -0.5 * z * z - math.log(row[1]) - HALF_LOG_TWO_PI

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        return row[0] + row[1] * rng.standard_normal()

    def cdf(self, x: float) -> float:
        mean, sd = self.parameters
        return 0.5 * math.erfc((mean - x) / (sd * math.sqrt(2.0)))

    def quantile(self, probability: float) -> float:
        return NormalDist(*self.parameters).inv_cdf(probability)


@distributions.register("log-normal")
class LogNormal(Distribution):
    """Positive, with a median and the standard deviation of its natural logarithm."""

    lowest = 0.0
    names = ("median", "log_sd")
    positive = ("median",)
    dimensionless = ("log_sd",)
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        """Row: median, sd of the logarithm, log median."""
        if x <= 0.0:
            return -math.inf
        log_x = math.log(x)
        z = (log_x - row[2]) / row[1]
        return -0.5 * z * z - math.log(row[1]) - HALF_LOG_TWO_PI - log_x

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        return math.exp(row[2] + row[1] * rng.standard_normal())

    def fault(self) -> str | None:
        log_sd = self.parameters[1]
        return None if 0 < log_sd <= 20 else f"log_sd {log_sd:g} is not in (0, 20]"

    def _row(self) -> tuple[float, ...]:
        return self.parameters[0], self.parameters[1], math.log(self.parameters[0]), 0.0

    def cdf(self, x: float) -> float:
        if x <= 0.0:
            return 0.0
        return 0.5 * math.erfc((math.log(self.parameters[0]) - math.log(x)) / (self.parameters[1] * math.sqrt(2.0)))

    def quantile(self, probability: float) -> float:
        return math.exp(NormalDist(math.log(self.parameters[0]), self.parameters[1]).inv_cdf(probability))

    def mean(self) -> float:
        return self.parameters[0] * math.exp(0.5 * self.parameters[1] ** 2)


@distributions.register("exponential")
class Exponential(Distribution):
    """Positive, with a mean."""

    lowest = 0.0
    names = positive = ("mean",)
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        return -x / row[0] - math.log(row[0]) if x >= 0.0 else -math.inf

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        return row[0] * rng.standard_exponential()

    def cdf(self, x: float) -> float:
        return -math.expm1(-x / self.parameters[0]) if x > 0 else 0.0

    def quantile(self, probability: float) -> float:
        return -self.parameters[0] * math.log1p(-probability)


@distributions.register("gamma")
class Gamma(Distribution):
    """Positive, with a shape and a scale; the mean is their product."""

    lowest = 0.0
    names = positive = ("shape", "scale")
    dimensionless = ("shape",)
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        """Row: shape, scale, log of the normalising constant."""
        if x <= 0.0:
            return -math.inf
        return (row[0] - 1.0) * math.log(x) - x / row[1] - row[2]

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        return row[1] * rng.standard_gamma(row[0])

    def _row(self) -> tuple[float, ...]:
        shape, scale = self.parameters
        return shape, scale, math.lgamma(shape) + shape * math.log(scale), 0.0

    def cdf(self, x: float) -> float:
        from scipy.special import gammainc

        return float(gammainc(self.parameters[0], max(x, 0.0) / self.parameters[1]))

    def quantile(self, probability: float) -> float:
        from scipy.special import gammaincinv

        return float(gammaincinv(self.parameters[0], probability) * self.parameters[1])

    def mean(self) -> float:
        return self.parameters[0] * self.parameters[1]


ROOT_HALF = math.sqrt(0.5)


class Interval(Distribution):
    """Between its last two self.parameters. The quantile is found by bisection where a type has no formula for it."""

    def fault(self) -> str | None:
        lower, upper = self.parameters[-2:]
        return None if lower < upper else f"lower {lower:g} is not below upper {upper:g}"

    @property
    def support(self) -> tuple[float, float]:
        return self.parameters[-2], self.parameters[-1]

    def quantile(self, probability: float) -> float:
        return bisected(self.cdf, probability, *self.support)


@distributions.register("uniform")
class Uniform(Interval):
    """Uniform on [lower, upper]."""

    names = ("lower", "upper")
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        return -math.log(row[1] - row[0]) if row[0] <= x <= row[1] else -math.inf

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        return row[0] + (row[1] - row[0]) * rng.random()

    def cdf(self, x: float) -> float:
        lower, upper = self.parameters
        return min(max((x - lower) / (upper - lower), 0.0), 1.0)

    def quantile(self, probability: float) -> float:
        lower, upper = self.parameters
        return lower + (upper - lower) * probability

    def mean(self) -> float:
        return 0.5 * (self.parameters[0] + self.parameters[1])


@distributions.register("log-uniform")
class LogUniform(Interval):
    """Uniform in the logarithm on [lower, upper]."""

    names = ("lower", "upper")
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        """Row: lower, upper, log lower, log log(upper / lower)."""
        return -math.log(x) - row[3] if row[0] <= x <= row[1] else -math.inf

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        x = math.exp(row[2] + math.exp(row[3]) * rng.random())
        return min(max(x, row[0]), row[1])  # rounding must not leave the support

    def fault(self) -> str | None:
        if not self.parameters[0] > 0:
            return f"lower {self.parameters[0]:g} is not above 0"
        return super().fault()

    def _row(self) -> tuple[float, ...]:
        lower, upper = self.parameters
        return lower, upper, math.log(lower), math.log(math.log(upper / lower))

    def cdf(self, x: float) -> float:
        lower, upper = self.parameters
        return math.log(min(max(x, lower), upper) / lower) / math.log(upper / lower)

    def quantile(self, probability: float) -> float:
        lower, upper = self.parameters
        return lower * (upper / lower) ** probability

    def mean(self) -> float:
        lower, upper = self.parameters
        return (upper - lower) / math.log(upper / lower)


@distributions.register("beta")
class Beta(Interval):
    """Beta with shapes a and b on (lower, upper), by default (0, 1)."""

    names = ("a", "b", "lower", "upper")
    defaults = (0.0, 1.0)
    dimensionless = ("a", "b")
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        a, b, lower, upper = row[0], row[1], row[2], row[3]
        t = (x - lower) / (upper - lower)
        if t <= 0.0 or t >= 1.0:  # the ends have no mass; a density there may be infinite
            return -math.inf
        constant = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) - math.log(upper - lower)
        return constant + (a - 1.0) * math.log(t) + (b - 1.0) * math.log1p(-t)

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        first = rng.standard_gamma(row[0])
        second = rng.standard_gamma(row[1])
        return row[2] + (row[3] - row[2]) * first / (first + second)

    def fault(self) -> str | None:
        if min(self.parameters[:2]) < 0.01:
            return "a and b have to be at least 0.01"
        return super().fault()

    def cdf(self, x: float) -> float:
        from scipy.special import betainc

        a, b, lower, upper = self.parameters
        return float(betainc(a, b, min(max((x - lower) / (upper - lower), 0.0), 1.0)))

    def quantile(self, probability: float) -> float:
        from scipy.special import betaincinv

        a, b, lower, upper = self.parameters
        return float(lower + (upper - lower) * betaincinv(a, b, probability))

    def mean(self) -> float:
        a, b, lower, upper = self.parameters
        return lower + (upper - lower) * a / (a + b)


@distributions.register("truncated-normal")
class TruncatedNormal(Interval):
    """Normal with a mean and a standard deviation before it was cut to [lower, upper]."""

    names = ("mean", "sd", "lower", "upper")
    positive = ("sd",)
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        mean, sd = row[0], row[1]
        if x < row[2] or x > row[3]:
            return -math.inf
        a, b = (row[2] - mean) / sd, (row[3] - mean) / sd
        if a + b < 0.0:  # by symmetry, so that erfc sees positive arguments where it can
            a, b = -b, -a
        mass = 0.5 * (math.erfc(a * ROOT_HALF) - math.erfc(b * ROOT_HALF))
        z = (x - mean) / sd
        return -0.5 * z * z - math.log(sd) - HALF_LOG_TWO_PI - math.log(mass)

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        """Reject: from the normal where the interval keeps much of it, else from the uniform (both bounds finite)."""
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

    def fault(self) -> str | None:
        mean, sd, lower, upper = self.parameters
        if lower < upper and max(lower - mean, mean - upper) > 30.0 * sd:
            return "the interval is more than 30 standard deviations from the mean"
        return super().fault()

    def cdf(self, x: float) -> float:
        mean, sd, lower, upper = self.parameters
        a, b = (lower - mean) / sd, (upper - mean) / sd
        z = (min(max(x, lower), upper) - mean) / sd
        if a + b < 0.0:
            below = math.erfc(-z * ROOT_HALF) - math.erfc(-a * ROOT_HALF)
            return below / (math.erfc(-b * ROOT_HALF) - math.erfc(-a * ROOT_HALF))
        below = math.erfc(a * ROOT_HALF) - math.erfc(z * ROOT_HALF)
        return below / (math.erfc(a * ROOT_HALF) - math.erfc(b * ROOT_HALF))

    def mean(self) -> float:
        mean, sd, lower, upper = self.parameters
        row = self.row
        return mean + sd * sd * (math.exp(self.density(lower, row)) - math.exp(self.density(upper, row)))


TWO_PI = 2.0 * math.pi


@distributions.register("von-mises")
class VonMises(Interval):
    """On [0, period] (a full turn unless given), with a mean direction and a concentration."""

    names = ("mean", "concentration", "period")
    positive = ("period",)
    defaults = (TWO_PI,)
    dimensionless = ("concentration",)
    compiled = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        """Row: mean, concentration, period, log of the normalising constant with exp(concentration) taken out."""
        if x < 0.0 or x > row[2]:
            return -math.inf
        return row[1] * (math.cos(TWO_PI * (x - row[0]) / row[2]) - 1.0) - row[3]

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> float:
        """Best and Fisher (1979): a wrapped Cauchy envelope."""
        concentration = row[1]
        if concentration < 1e-6:
            return row[2] * rng.random()
        t = 1.0 + math.sqrt(1.0 + 4.0 * concentration * concentration)
        if concentration > 1e5:  # the formula for s loses its digits; a wrapped normal is within 1e-6 of it
            angle = rng.standard_normal() / math.sqrt(concentration)
        else:
            r = (t - math.sqrt(2.0 * t)) / (2.0 * concentration)
            s = (1.0 + r * r) / (2.0 * r)
            while True:
                z = math.cos(math.pi * rng.random())
                f = (1.0 + s * z) / (s + z)
                c = concentration * (s - f)
                u = 1.0 - rng.random()
                if c * (2.0 - c) > u or math.log(c / u) + 1.0 >= c:
                    break
            angle = math.acos(min(max(f, -1.0), 1.0))
            if rng.random() < 0.5:
                angle = -angle
        x = (row[0] + angle * row[2] / TWO_PI) % row[2]
        return x

    def fault(self) -> str | None:
        concentration = self.parameters[1]
        return None if 0 <= concentration <= 1e8 else f"concentration {concentration:g} is not in [0, 1e8]"

    def _row(self) -> tuple[float, ...]:
        from scipy.special import i0e

        mean, concentration, period = self.parameters
        return mean, concentration, period, math.log(period) + math.log(float(i0e(concentration)))

    @property
    def support(self) -> tuple[float, float]:
        return 0.0, self.parameters[2]

    def cdf(self, x: float) -> float:
        """Sum the Fourier series of the density; its terms fall off as exp(-j^2 / (2 concentration))."""
        from scipy.special import ive

        mean, concentration, period = self.parameters
        x = min(max(x, 0.0), period)
        j = np.arange(1.0, 12.0 + 9.0 * math.sqrt(concentration))
        weights = ive(j, concentration) / ive(0.0, concentration) / (math.pi * j)
        begin, end = -TWO_PI * mean / period, TWO_PI * (x - mean) / period
        return float(x / period + weights @ (np.sin(j * end) - np.sin(j * begin)))

    def mean(self) -> float:
        return self.parameters[0] % self.parameters[2]


@distributions.register("uniform-rotation")
class UniformRotation(Distribution):
    """Every orientation is as likely as another."""

    size = 4

    @staticmethod
    def density(x, row):
        """Zero: the stock measure of rotations is Haar measure with total mass one.  Not a unit quaternion: -inf."""
        norm = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
        return 0.0 if abs(norm - 1.0) < 1e-6 else -math.inf

    @staticmethod
    def draw(rng, row):
        """Four normals on a line through the origin; the half with w >= 0 stands for both."""
        w, x, y, z = rng.standard_normal(), rng.standard_normal(), rng.standard_normal(), rng.standard_normal()
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if w < 0:
            norm = -norm
        return w / norm, x / norm, y / norm, z / norm

    @property
    def support(self) -> tuple[float, float]:
        return -1.0, 1.0
