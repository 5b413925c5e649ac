"""Kernels, by name; each leaves the posterior invariant, and any mixture or cycle of them does so too."""

from derender.posterior.kernels import (  # noqa: F401  (importing registers)
    choose,
    drift,
    flip,
    independence,
    jump,
    langevin,
    newton,
    relocate,
    relocate_stack,
    resimulate,
    slide,
    slide_window,
    turn,
    window,
)
from derender.posterior.kernels.base import Info, Kernel, KernelType, Part, State, Target, Tuning, kernels, mixture

__all__ = ["Info", "Kernel", "KernelType", "Part", "State", "Target", "Tuning", "kernels", "mixture"]
