"""Reversible jumps over scene graphs; importing the package registers all moves."""

from derender.structures.jumps import object_moves  # noqa: F401 - registered by being imported
from derender.structures.jumps.base import Info, Move, State, evaluate, mixture, moves, step

__all__ = ["Info", "Move", "State", "evaluate", "mixture", "moves", "step"]
