"""What solids may do to each other: the terms of the density that detection and draws share."""

from typing import NamedTuple

from derender.detection.solids.beliefs import Beliefs


class Rules(NamedTuple):
    """What solids may do to each other.

    Attributes
    ----------
    slack : metres within which a solid that is not held stands on its support.
    overlap : metres by which solids may interpenetrate, inf: the term against interpenetration is off; None: as the
        prior says.
    faces : metres by which faces of solids lie off where they appear to, see draws/faces.py.
    floating : whether the term against floating is off: then any height is as likely.
    beliefs : what is believed of solids; None: what data/priors/bare-image.yaml says.
    """

    slack: float
    overlap: float | None = None
    floating: bool = False
    beliefs: Beliefs | None = None
    faces: float = 0.0
