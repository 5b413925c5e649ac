"""Reversible jumps over scene graphs, one file per move; importing the package registers them all."""

from derender.structures.jumps import (  # noqa: F401 - registered by being imported
    birth_death,
    change_shape,
    exchange_sizes,
    reparent,
    resimulate,
    wiggle,
)
from derender.structures.jumps.base import Info, Move, State, evaluate, mixture, moves, step

__all__ = ["Info", "Move", "State", "evaluate", "mixture", "moves", "step"]
