"""Kernels, by name; each leaves the posterior invariant, and any mixture of them does so too."""

from derender.posterior.kernels import relocate  # noqa: F401  (importing registers)
from derender.posterior.kernels.base import kernels, mixture

__all__ = ["kernels", "mixture"]
