"""Relations that a tree cannot say and that place nothing: pairs that do not touch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Constraint:
    """An undirected relation between two objects.

    Attributes
    ----------
    first, second : names of vertices; their order says nothing.
    type : "does-not-touch".
    margin : metres that must be left between their surfaces.
    """

    first: str
    second: str
    type: str = "does-not-touch"
    margin: float = 0.0

    def renamed(self, old: str, new: str) -> "Constraint":
        """Return the same relation after an object was renamed."""
        first, second = (new if name == old else name for name in (self.first, self.second))
        return Constraint(first, second, self.type, self.margin)
