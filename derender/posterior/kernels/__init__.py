"""Kernels, by name; each leaves the posterior invariant, and any mixture of them does so too."""

from derender.posterior.kernels import relocate  # noqa: F401  (importing registers)
from derender.posterior.kernels.base import KernelType, Part, Target, Tuning, kernels, mixture

__all__ = ["KernelType", "Part", "Target", "Tuning", "kernels", "mixture"]
