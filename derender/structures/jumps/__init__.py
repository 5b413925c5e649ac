"""Reversible jumps over scene graphs; importing the package registers all moves."""

from derender.structures.jumps.base import Info, Move, State, evaluate, mixture, moves, step

__all__ = ["Info", "Move", "State", "evaluate", "mixture", "moves", "step"]
