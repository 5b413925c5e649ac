"""One scene in several images: the sum of their log likelihoods, each image an engine of its own.

A scene is given in one camera's axes; `into` takes it to those of each view's camera. One image is the case of one
view, at the cost of its engine. From compiled code:

    propose_views(views, count, indices, poses, sizes)   -> log likelihood of all images with some solids moved
    settle_views(views, CANDIDATE) accepts it, (views, CURRENT) rejects it: before the next proposal
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.engine import for_steps, propose_in, settle_in
from derender.render.raycast.state import EngineState


class Views(NamedTuple):
    """Attributes (V: views, N: solids).

    engines : EngineState whose arrays have an axis of V in front, filled up to the size of the largest view's.
    """

    engines: EngineState
    into: np.ndarray  # (V, 4, 4) float64, axes of the scene to those of each camera
    elsewhere: np.ndarray  # (V,) bool, whether they differ
    moved: np.ndarray  # (N, 4, 4) float64, scratch: poses in the axes of one of them


def make_views(states: Sequence[EngineState], into: np.ndarray) -> Views:
    """Return the Views of engines, one a view, that hold the same solids; into : (V, 4, 4), see Views.

    Several engines are copied: `engine_of_view` returns those that the views work on.
    """
    engines = EngineState(*(_stacked(arrays) for arrays in zip(*states, strict=True)))
    into = np.ascontiguousarray(into, np.float64)
    elsewhere = np.any(into != np.eye(4), axis=(1, 2))
    views = Views(engines, into, elsewhere, np.zeros(states[0].pose.shape[1:]))
    for view in range(len(states)):
        for_steps(engine_of_view(views, view))
    return views


def engine_of_view(views: Views, view: int) -> EngineState:
    """Return the engine of one view, which shares its arrays with the Views."""
    return EngineState(*(array[view] for array in views.engines))


def _stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays of one type one behind the other, each at the beginning of its place, the rest 0."""
    if len(arrays) == 1:
        return np.ascontiguousarray(arrays[0])[None]
    largest = np.max([array.shape for array in arrays], axis=0)
    result = np.zeros((len(arrays), *largest), arrays[0].dtype)
    for place, array in zip(result, arrays, strict=True):
        place[tuple(slice(length) for length in array.shape)] = array
    return result


@njit(inline="always", borrows=True)
def _engine(engines, view):
    return EngineState(
        engines.settings[view], engines.parameters[view], engines.total[view], engines.taps[view],
        engines.images[view], engines.strip[view], engines.kind[view], engines.pose[view], engines.size[view],
        engines.prepared[view], engines.rectangle[view], engines.lists[view], engines.regions[view],
        engines.vertices[view], engines.triangles[view], engines.starts[view], engines.extents[view],
        engines.points[view],
    )  # fmt: skip


@njit(cache=True, nogil=True, borrows=True)
def propose_views(views, count, indices, poses, sizes):
    """Return the log likelihood of all images with some solids moved or resized; `settle_views` must follow.

    count : how many. indices : (>= count,) int64, no solid twice. poses : (>= count, 4, 4) in the scene's axes,
    sizes : (>= count, 3).
    """
    total, moved = 0.0, views.moved
    for view in range(len(views.into)):
        engine, into = _engine(views.engines, view), views.into[view]
        if not views.elsewhere[view]:
            total += propose_in(engine, count, indices, poses, sizes)
            continue
        for n in range(count):
            for i in range(4):
                for j in range(4):
                    moved[n, i, j] = 0.0
                    for k in range(4):
                        moved[n, i, j] += into[i, k] * poses[n, k, j]
        total += propose_in(engine, count, indices, moved, sizes)
    return total


@njit(cache=True, nogil=True, borrows=True)
def settle_views(views, source):
    """Accept (CANDIDATE) or reject (CURRENT) what was proposed, in all views."""
    for view in range(len(views.into)):
        settle_in(_engine(views.engines, view), source)
