"""One thing that is followed: what it is, where it is, how it moves, how sure that is; and what is said of all."""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from derender.tracking.hidden import Hidden

STILL, MOVING, HIDDEN, LOST, GONE = "still", "moving", "hidden", "lost", "gone"
TIES = {
    "box": np.eye(3),
    "cube": np.ones((1, 3)),
    "sphere": np.ones((1, 3)),
    "cylinder": np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}


@dataclass
class Thing:
    """A solid that is followed.

    covariance : (6 + G, 6 + G) of its centre and turn (world axes) and the numbers of its size along `ties`.
    velocity, spin, acceleration : (3,) metres and radians a second, metres a second squared, world axes.
    state : still, moving, hidden (nothing of it can be seen), lost (what is seen there is something else) or gone.
    usual_cost, usual_off : nats a pixel about it then, and the share of those pixels that are off.
    """

    name: str  # unique
    type: str  # of its shape
    kind: int  # code of scene.solids
    size: np.ndarray  # (3,) full extents, metres
    pose: np.ndarray  # (4, 4), to the world: the camera's axes of the first frame
    covariance: np.ndarray
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    spin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros(3))
    state: str = STILL
    quiet: int = 0  # frames on end in which it has hardly moved
    waiting: int = 0  # frames on end in which it was not seen
    hidden: Hidden | None = None  # where it may be while nothing shows it, or None
    usual_misfit: float = 0.05  # share of its pixels that are off while all is well
    usual_cost: float = 0.5
    usual_off: float = 0.01

    @property
    def ties(self) -> np.ndarray:
        """(G, 3), the extents that grow together."""
        return TIES[self.type]

    @property
    def here(self) -> bool:
        """Whether it is drawn: not lost and not gone."""
        return self.state not in (LOST, GONE)

    def copy(self, **changes: Any) -> "Thing":
        """Return a copy whose arrays are its own."""
        arrays = {
            name: getattr(self, name).copy()
            for name in ("size", "pose", "covariance", "velocity", "spin", "acceleration")
        }
        return replace(self, **{**arrays, **changes})


class Seen(NamedTuple):
    """What the filter says of one frame. cost, valid : nats of the whole frame, and its pixels with a return."""

    poses: np.ndarray  # (N, 4, 4) to camera, NaN where a thing is not there or lost; N things so far
    covariances: np.ndarray  # (N, 6, 6) of centre and turn, camera axes
    states: list[str]  # (N,) of str
    pixels: np.ndarray  # (N, 4), see fit.pixels_of
    view: np.ndarray  # (4, 4), world to camera
    rounds: int  # sets of normal equations
    blobs: list  # of what nothing explains
    cost: float
    valid: int
