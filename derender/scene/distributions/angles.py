"""Distributions over directions: von Mises on a circle, and the uniform one over rotations."""

import math
from typing import Any

import numpy as np

from derender.scene.distributions.base import Distribution, bisected, distributions

TWO_PI = 2.0 * math.pi


@distributions.register("von-mises")
class VonMises(Distribution):
    """On [0, period] (a full turn unless given), with a mean direction and a concentration."""

    names = ("mean", "concentration", "period")
    defaults = (TWO_PI,)
    dimensionless = ("concentration",)
    compiled = True

    @staticmethod
    def density(x: Any, row: Any) -> Any:
        """Row: mean, concentration, period, log of the normalising constant with exp(concentration) taken out."""
        if x < 0.0 or x > row[2]:
            return -math.inf
        return row[1] * (math.cos(TWO_PI * (x - row[0]) / row[2]) - 1.0) - row[3]

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> Any:
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
        _, concentration, period = self.parameters
        if period <= 0:
            return f"period {period:g} is not positive"
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

    def quantile(self, probability: float) -> float:
        return bisected(self.cdf, probability, 0.0, self.parameters[2])

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
