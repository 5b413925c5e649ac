"""Distributions over numbers, rotations and choices, by name.

>>> import numpy as np
>>> side = distributions["uniform"](0.05, 0.12)
>>> 0.05 <= side.sample(np.random.default_rng(0)) <= 0.12
True
>>> round(side.log_density(0.1), 6)
2.65926
"""

from derender.scene.distributions import continuous, discrete  # noqa: F401 - registered by being imported
from derender.scene.distributions.discrete import ROW, Categorical, Distribution, distributions, within

__all__ = ["ROW", "Categorical", "Distribution", "distributions", "within"]
