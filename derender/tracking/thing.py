"""Things that are followed: what each is, where it is, how it moves, how sure that is; what is said of all; and what is
there in the first frame, from the posterior of that image."""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from derender.results.posterior import Posterior
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse, moved
from derender.scene.solids import KINDS
from derender.tracking.hidden import Hidden

STILL, MOVING, HIDDEN, LOST, GONE = "still", "moving", "hidden", "lost", "gone"
TIES = {
    "box": np.eye(3),
    "cube": np.ones((1, 3)),
    "sphere": np.ones((1, 3)),
    "cylinder": np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}
FOLLOWED = tuple(TIES)  # shapes; of free-form things no frame tells the far side
NOT_FOLLOWED = f"is not followed: only shapes {', '.join(FOLLOWED)} are"
DRAWS = 60  # of the posterior, for the spread of sizes and poses
LEAST_SPREAD = (1e-4, 1e-3, 1e-4)  # metres, radians, metres: of centre, turn and extents of what is known best
UNTOLD_SPREAD = (3e-3, 3e-2, 3e-3)  # the same where too few draws tell of it
SAME_TURN = 0.35  # radians: draws turned by more are the same solid named by other axes


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
    """What the filter says of one frame. cost, valid : nats of the whole frame (and, where the camera moves, of all
    that moves), and its pixels with a return."""

    poses: np.ndarray  # (N, 4, 4) to camera, NaN where a thing is not there or lost; N things so far
    covariances: np.ndarray  # (N, 6, 6) of centre and turn, camera axes
    states: list[str]  # (N,) of str
    pixels: np.ndarray  # (N, 4), see fit.pixels_of
    view: np.ndarray  # (4, 4), world to camera
    view_factor: np.ndarray  # (BAND, 6), see Track; (BAND, 0) where nothing is known
    rounds: int  # sets of normal equations
    blobs: list  # of what nothing explains
    cost: float
    valid: int


class Start(NamedTuple):
    """The beginning of a film.

    sigma, growth, blur : the sensor's noise, sd = sigma + growth z^2, metres, and its blur in pixels.
    """

    things: list[Thing]  # the solids that stand, lie or fly
    floor: np.ndarray | None  # (4, 4) floor frame (z up) to camera, or None
    down: np.ndarray  # (3,) unit direction of gravity in camera axes, so far as the scene tells
    sigma: float
    growth: float
    blur: float
    temper: float  # pixels that tell as much as one independent one
    doubts: tuple[str, ...] = ()  # what the frame says against it, as sentences

    def copy(self) -> "Start":
        """Return a copy whose things are its own."""
        return self._replace(things=[thing.copy() for thing in self.things])


def start_from(posterior: Posterior, rng: np.random.Generator) -> Start:
    """Return what a posterior of the first frame says is there."""
    graph = posterior.best_graph()
    poses = graph.poses()
    planes = [vertex.name for vertex in graph.vertices if vertex.shape == "plane"]
    draws = [g for g in posterior.graphs(rng, DRAWS) if g.names == graph.names]
    things = [thing_of(graph, draws, vertex.name) for vertex in graph.vertices if vertex.shape in FOLLOWED]
    told = dict(posterior.meta.get("likelihood", {}))
    correlation = min(max(float(posterior.meta.get("correlation") or 0.0), 0.0), 0.75)
    return Start(
        things,
        poses[planes[0]] if planes else None,
        graph.down(),
        float(told.get("sigma", 0.002)),
        float(told.get("sigma_growth", 0.0)),
        float(told.get("blur", 0.0)),
        ((1 + correlation) / (1 - correlation)) ** 2 if correlation > 0.1 else 1.0,
    )


def thing_of(graph: SceneGraph, draws: Any, name: str) -> Thing:
    """Return one solid of a scene as a thing: the mean of the draws of the scene and their spread.

    What an image hides, the likeliest scene may have anywhere in its range.
    """
    vertex = graph.vertex(name)
    pose, size, ties = graph.poses()[name], np.array(graph.body(name).size(), float), TIES[vertex.shape]
    rows = []
    for draw in draws:
        if draw.vertex(name).shape != vertex.shape:
            continue
        other = draw.poses()[name]
        turn = other @ inverse(pose)
        about = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        if np.trace(turn[:3, :3]) < 1 + 2 * np.cos(SAME_TURN):
            continue
        grown = (np.array(draw.body(name).size(), float) - size) @ ties.T / ties.sum(axis=1)
        rows.append([*(other[:3, 3] - pose[:3, 3]), *about, *grown])
    counts = [3, 3, len(ties)]
    covariance = np.diag(np.repeat(UNTOLD_SPREAD, counts) ** 2)
    if len(rows) > 2 * len(covariance):
        mean = np.mean(rows, axis=0)
        pose, size = moved(pose, mean[:6]), size + mean[6:] @ ties
        covariance = np.diag(np.repeat(LEAST_SPREAD, counts) ** 2) + np.cov(np.array(rows).T)
    return Thing(name, vertex.shape, KINDS[vertex.shape], size, pose.copy(), covariance)
