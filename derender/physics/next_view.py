"""Which camera move would tell most: what one more image is expected to leave unknown, from a posterior's draws.

A number t of a draw (a size, whether it has some structure, whether it stands) and the draw's image y from a candidate
camera are taken as jointly normal, with the draws' own covariances (the analysis of an ensemble Kalman filter: Evensen,
Ocean Dynamics 53, 2003). With A (P, n) the images of n draws about their mean in deviations of the noise, and T (m, n)
the numbers about theirs, the covariance that is expected after the image is

    T (I + A'A / (n - 1))^-1 T' / (n - 1),

whatever is seen. What one number is expected to tell of another, in nats, is half the logarithm of its variance before
over that after. No derivative is needed, and no more than an n x n matrix.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.physics.bodies import matter_of_graph
from derender.physics.statics import Equilibrium
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.results.posterior import Posterior
from derender.scene.graph import SceneGraph
from derender.scene.pose import from_axes, inverse
from derender.scene.solids import Solids
from derender.structures.draws.curvature import weights
from derender.structures.draws.sensor import Sensor

ABOUT = ("sizes", "structure", "stable")
DRAWS = 120  # scenes drawn: several times the numbers that a few objects have
TURNS = 12  # candidate cameras on each ring
ELEVATIONS = tuple(np.radians([15.0, 35.0, 60.0]))  # of the rings, besides that of the camera itself
KNOWN = 3e-4  # metres of standard deviation below which a size is known well enough
# Nats of one number that count where views are compared: four times as sure is enough, and more of it does not make up
# for another that stays hidden.
ENOUGH = float(np.log(4.0))
SURE = 0.02  # standard deviation of a probability below which there is nothing to learn of it
LARGEST = 160  # columns of the images that candidates are rendered at


class NextView(NamedTuple):
    """A candidate camera and what its image is expected to tell."""

    pose: np.ndarray  # (4, 4), camera to the first camera's axes
    turn: float  # radians about the scene from the camera that was there, seen from above anticlockwise
    elevation: float  # radians above the floor
    moved: float  # metres between the cameras
    nats: dict[str, float]  # expected information by what it is about, see ABOUT
    spreads: dict[str, tuple[float, float]]  # standard deviation (before, after) of each size, metres, by address


def next_views(
    posterior: Posterior, camera: Camera, likelihood: Mapping[str, Any], rng: np.random.Generator, about: str = "sizes"
) -> list[NextView]:
    """Return the candidate cameras on rings about the scene, all looking at its middle, those that tell most first.

    camera : whose images are to come. likelihood : type and numbers of the noise of its images. about : one of ABOUT.

    Raises DerenderError : nothing stands in the scene.
    """
    best = posterior.best_graph()
    if not sizes_of(best):
        raise DerenderError("there is nothing that another look could tell more of", remedy="infer a scene with solids")
    graphs = posterior.graphs(rng, DRAWS)
    drawn = [graph.structure() for graph in graphs]
    targets = {
        "sizes": size_table(best, graphs),
        "structure": np.array([[float(each == part.graph.structure()) for each in drawn] for part in posterior.parts]),
        "stable": np.array([[float(Equilibrium(matter_of_graph(graph)).stands) for graph in graphs]]),
    }
    floors = {"sizes": KNOWN, "structure": SURE, "stable": SURE}
    most = {"sizes": np.inf, "structure": entropy(targets["structure"]), "stable": entropy(targets["stable"])}
    small = camera.downscaled(max(1.0, camera.width / LARGEST))
    scenes, found = [graph.solids() for graph in graphs], []
    for pose, turn, elevation, moved in candidates(best):
        images = images_from(scenes, pose, small, likelihood)
        left = dict(zip(targets, spreads_after(list(targets.values()), images), strict=True))
        nats = {name: min(information(*left[name], floors[name]), most[name]) for name in ABOUT}
        told = information(*left[about], floors[about], ENOUGH)
        spreads = {name: (float(a), float(b)) for name, a, b in zip(sizes_of(best), *left["sizes"], strict=True)}
        found.append((told, NextView(pose, turn, elevation, moved, nats, spreads)))
    return [view for _, view in sorted(found, key=lambda pair: (-pair[0], -pair[1].nats[about]))]


def sizes_of(graph: SceneGraph) -> dict[str, float]:
    """Return the extents of all objects by address."""
    return {
        f"{vertex.name}.{key}": float(value)
        for vertex in graph.vertices
        for key, value in vertex.parameters.items()
        if vertex.body.size() is not None and isinstance(value, int | float)
    }


def size_table(best: SceneGraph, graphs: Sequence[SceneGraph]) -> np.ndarray:
    """Return (m, n) the sizes of the best scene's objects in n scenes; the mean where a scene has no such number."""
    found = [sizes_of(graph) for graph in graphs]
    table = np.array([[sizes.get(name, np.nan) for sizes in found] for name in sizes_of(best)])
    means = [np.mean(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in table]
    return np.where(np.isfinite(table), table, np.array(means)[:, None])


def candidates(graph: SceneGraph) -> list[tuple[np.ndarray, float, float, float]]:
    """Return (pose, turn, elevation, metres moved) of cameras about a scene, as far from its middle as the first."""
    poses = graph.poses()
    middle = np.mean([poses[vertex.name][:3, 3] for vertex in graph.vertices if vertex.body.size() is not None], axis=0)
    planes = [vertex.name for vertex in graph.vertices if vertex.body.size() is None]
    up = poses[planes[0]][:3, 2] if planes else -graph.down()
    distance = float(np.linalg.norm(middle))
    toward = -middle / distance
    own = float(np.arcsin(np.clip(toward @ up, -1.0, 1.0)))
    ahead = toward - (toward @ up) * up
    ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1e-6 else np.cross(up, [0.0, 1.0, 0.0])
    aside = np.cross(up, ahead)
    found = []
    for elevation in sorted({*ELEVATIONS, max(own, ELEVATIONS[0])}):
        for turn in np.arange(TURNS) * 2.0 * np.pi / TURNS:
            flat = np.cos(turn) * ahead + np.sin(turn) * aside
            eye = middle + distance * (np.cos(elevation) * flat + np.sin(elevation) * up)
            forward = (middle - eye) / distance
            right = np.cross(forward, up)
            right /= np.linalg.norm(right)
            pose = from_axes((right, np.cross(forward, right), forward), eye)
            found.append((pose, float(turn), float(elevation), float(np.linalg.norm(eye))))
    return found


def images_from(
    scenes: Sequence[Solids], pose: np.ndarray, camera: Camera, likelihood: Mapping[str, Any]
) -> np.ndarray:
    """Return (n, P) what images of n scenes show where they differ: deviations of the noise, about the scenes' mean.

    pose : (4, 4) of the camera, to the scenes' axes. At depth steps the noise is as `curvature.py` has it.
    """
    kind = likelihoods[str(likelihood.get("type", "gaussian"))]
    known = {parameter.name for parameter in kind.parameters}
    numbers = kind.complete({key: value for key, value in likelihood.items() if key in known})
    wall, into = numbers["background"], inverse(pose)
    moved = [scene._replace(pose=into @ scene.pose) for scene in scenes]
    images = np.array([np.minimum(render_depth(scene, camera, background=wall)[0], wall) for scene in moved])
    middle = np.median(images, axis=0)
    precision = weights(Sensor(camera, middle, kind, numbers), middle)
    changed = (images.max(axis=0) > images.min(axis=0)) & (precision > 0.0)
    seen = images[:, changed]
    return (seen - seen.mean(axis=0)) * np.sqrt(precision[changed])


def spreads_after(tables: Sequence[np.ndarray], images: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the standard deviations (before, after), (m,) each, of tables (m, n) of n draws, given one more image.

    images : (n, P) those of the draws, in deviations of the noise, about their mean.
    """
    count = len(images) - 1
    told = np.linalg.inv(np.eye(len(images)) + images @ images.T / count)
    found = []
    for table in tables:
        apart = table - table.mean(axis=1, keepdims=True)
        before, after = np.sum(apart**2, axis=1) / count, np.sum((apart @ told) * apart, axis=1) / count
        found.append((np.sqrt(before), np.sqrt(np.maximum(after, 0.0))))
    return found


def entropy(table: np.ndarray) -> float:
    """Return how many nats there are to tell of a table (m, n) of what is so (1) or not (0) in n draws."""
    _, count = np.unique(table, axis=1, return_counts=True)
    share = count / count.sum()
    return float(np.sum(share * np.log(1.0 / share)))


def information(before: np.ndarray, after: np.ndarray, known: float, most: float = np.inf) -> float:
    """Return the nats by which numbers are expected to be surer; below the spread `known` there is nothing to learn.

    most : nats of each that count.
    """
    return float(np.sum(np.minimum(np.log(np.maximum(before, known) / np.maximum(after, known)), most)))
