"""Kernels, by name; each leaves the posterior invariant, and any mixture or cycle of them does so too."""

from derender.posterior.kernels import (  # noqa: F401  (importing registers)
    drift,
    flip,
    independence,
    jump,
    relocate,
    relocate_stack,
    resimulate,
    slide,
    slide_window,
    turn,
    window,
)
from derender.posterior.kernels.base import KernelType, Part, Target, Tuning, kernels, mixture

__all__ = ["KernelType", "Part", "Target", "Tuning", "kernels", "mixture"]
