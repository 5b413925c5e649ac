"""What solids may do to each other: the terms of the density that detection and draws share."""

from typing import NamedTuple

import numpy as np

from derender.detection.solids.sizes import NO_SIZES

OVERLAP = 3e-4  # metres by which solids may interpenetrate
CUBE_SHARE = 0.5  # of boxes


class Rules(NamedTuple):
    """What solids may do to each other.

    Attributes
    ----------
    slack : metres within which a solid that is not held stands on its support.
    overlap : metres by which solids may interpenetrate; inf: the term against interpenetration is off.
    floating : whether the term against floating is off: then any height is as likely.
    sizes : their densities, see solids/sizes.py; an empty table: those of TYPICAL and SPREAD.
    cubes : probability that a box is a cube.
    """

    slack: float
    overlap: float = OVERLAP
    floating: bool = False
    sizes: np.ndarray = NO_SIZES
    cubes: float = CUBE_SHARE
