"""The built-in distributions for compiled samplers: the very functions that the readable types use, each on its own.

They are called by address (`kernel_call.py`), so a model compiles those that occur in it. The same generator gives both
the same draws.
"""

import functools

from derender.compilation.cache import njit
from derender.scene.distributions.base import DistributionType


@functools.cache
def compiled(kind: DistributionType):
    """Return the kernels density(x, row) -> float64 and draw(rng, row) -> float64 of a type with a compiled twin."""
    return njit(cache=True, nogil=True)(kind.density), njit(cache=True, nogil=True)(kind.draw)
