"""One continuous number of a shape or a contact: its name, unit and range."""

import math
from typing import NamedTuple


class Parameter(NamedTuple):
    """A continuous parameter of a registered type.

    Attributes
    ----------
    name : key in scene files and last part of its address (``theta``).
    unit : "m", "rad" or "" for a pure number.
    lower, upper : range of meaningful values; a file outside it is at fault.
    default : value where a file says nothing, or None where a file must say it.
    period : length after which the value repeats, or None.
    slack : True for a number that is fixed at its default in an ideal contact (the gap, the tilts, the
        angle of a disc): it counts as a degree of freedom only where a scene gives it.
    """

    name: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    default: float | None = None
    period: float | None = None
    slack: bool = False
