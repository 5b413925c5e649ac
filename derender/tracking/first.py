"""What is there in the first frame, as things to be followed: from the posterior of that image."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.scene.pose import inverse
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.tracking.thing import TIES, Thing

if TYPE_CHECKING:
    from derender.scene.graph import SceneGraph

DRAWS = 60  # of the posterior, for the spread of sizes and poses
LEAST_SPREAD = (3e-4, 3e-3, 3e-4)  # metres, radians, metres: of centre, turn and extents of what is known best
SAME_TURN = 0.35  # radians: draws turned by more are the same solid named by other axes
KINDS = {"box": BOX, "cube": BOX, "sphere": SPHERE, "cylinder": CYLINDER}


class Start(NamedTuple):
    """The beginning of a film.

    sigma, growth, blur : the sensor's noise, sd = sigma + growth z^2, metres, and its blur in pixels.
    searched : whether the poses' covariances are only room for a search, so that the frame itself tells their spread.
    """

    things: list[Thing]  # the solids that stand, lie or fly
    floor: np.ndarray | None  # (4, 4) floor frame (z up) to camera, or None
    down: np.ndarray  # (3,) unit direction of gravity in camera axes, so far as the scene tells
    sigma: float
    growth: float
    blur: float
    temper: float  # pixels that tell as much as one independent one
    searched: bool = False

    def copy(self) -> "Start":
        """Return a copy whose things are its own."""
        return self._replace(things=[thing.copy() for thing in self.things])


def start_from(posterior: Any, rng: np.random.Generator) -> Start:
    """Return what a posterior of the first frame says is there."""
    graph = posterior.best_graph()
    poses = graph.poses()
    planes = [vertex.name for vertex in graph.vertices if vertex.shape == "plane"]
    draws = [g for g in posterior.graphs(rng, DRAWS) if g.names == graph.names]
    things = [thing_of(graph, draws, vertex.name) for vertex in graph.vertices if vertex.shape in TIES]
    told = dict(posterior.meta.get("likelihood", {}))
    correlation = float(posterior.meta.get("correlation", 0.0) or 0.0)
    correlation = min(max(correlation, 0.0), 0.75)
    return Start(
        things,
        poses[planes[0]] if planes else None,
        graph.down(),
        float(told.get("sigma", 0.002)),
        float(told.get("sigma_growth", 0.0)),
        float(told.get("blur", 0.0)),
        ((1 + correlation) / (1 - correlation)) ** 2 if correlation > 0.1 else 1.0,
    )


def thing_of(graph: "SceneGraph", draws: Any, name: str) -> Thing:
    """Return one solid of a scene as a thing, its spread that of the draws of the scene."""
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
    spread = np.repeat(LEAST_SPREAD, [3, 3, len(ties)])
    covariance = np.diag(spread**2)
    if len(rows) > 2 * len(spread):
        covariance = covariance + np.cov(np.array(rows).T)
    else:
        covariance = covariance * 100.0  # too few draws tell of it: ten times as uncertain
    return Thing(name, vertex.shape, KINDS[vertex.shape], size, pose.copy(), covariance)
