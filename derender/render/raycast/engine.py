"""Log likelihoods of posed solids at a million pixels a millisecond, in full or only where something moved.

From compiled code (`state` is an EngineState; every function takes microseconds and allocates nothing; large callers
use propose_in and settle_in, which compile faster):

    load_state(state, poses, sizes)                           -> log likelihood of a scene, now the current one
    propose_state(state, count, indices, poses, sizes)        -> log likelihood with solids indices[:count] moved
    settle_state(state, CANDIDATE) accepts it, (state, CURRENT) rejects it: before the next proposal
    log_likelihood_of(state, state.total[CURRENT])             again, after parameters[SIGMA] was changed (gaussian)
    rescore_state(state)                                       the same after any parameter but the background changed

`poses` and `sizes` are given for the moved solids, in the order of `indices`. The work is proportional to the union of
the old and new rectangles of what moved plus the blur's margin. Each pixel's value is computed by the same instructions
in either way, so an incremental value equals the full one but for the order of float64 sums.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import Kernel, address_of, call_for_nothing, call_for_number, njit
from derender.render.raycast.depth import Meshes, bound_address, rasterise_address
from derender.render.raycast.lane_names import LANES, blur_along_row, blur_window, load, new_window, push, store
from derender.render.raycast.region import (
    DRAWN,
    SCORED,
    add_region,
    draw_region,
    score_correlated,
    score_gaussian,
    score_region,
    score_robust,
    whole_image,
)
from derender.render.raycast.state import (
    ACCEPTED,
    BLUR,
    BLURS,
    BOUND,
    CANDIDATE,
    CORRELATED,
    CURRENT,
    DEPTH,
    DRAW,
    GAUSSIAN,
    HEIGHT,
    LIKELIHOOD,
    MESHES,
    OBSERVED,
    PAD,
    PENDING,
    PROPOSE,
    RADIUS,
    RASTERISE,
    RATE,
    REGIONS,
    ROBUST,
    SCORE,
    SETTLE,
    SHOWS,
    SIGMA,
    STALE,
    WHOLE,
    WIDTH,
    EngineState,
    array_by_array,
    new_state,
    set_blur,
)
from derender.scene.pose import compose, copy_placed
from derender.scene.solids import MESH


@functools.cache
def blur_for(radius: int) -> Kernel:
    """Return the kernel for a blur that reaches so many pixels, its taps unrolled."""

    @njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
    def blur_strips(source, result, taps, left, right, top, bottom, height):
        for column in range(left, right, LANES):
            first = max(top - radius, 0)
            latest = blur_along_row(source, first, column, taps, radius)
            window = new_window(latest, radius)
            for row in range(first + 1, top + radius):
                if row < height:
                    latest = blur_along_row(source, row, column, taps, radius)
                window = push(window, latest)
            for row in range(top, bottom):
                if row + radius < height:
                    latest = blur_along_row(source, row + radius, column, taps, radius)
                window = push(window, latest)
                store(result, row, column, blur_window(window, taps))

    return blur_strips


SCORES = {GAUSSIAN: score_gaussian, ROBUST: score_robust, CORRELATED: score_correlated}
REFRESH = 4096  # accepted proposals between fresh sums of the scores: rounding cannot pile up


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _log_likelihood(settings, parameters, total):
    if settings[LIKELIHOOD] != GAUSSIAN:
        return total
    sigma, observed = parameters[SIGMA], parameters[OBSERVED]
    constant = math.log(sigma) + 0.5 * math.log(2.0 * math.pi)
    return -0.5 * total / (sigma * sigma) - observed * constant


@njit(cache=True, nogil=True, borrows=True)
def log_likelihood_of(state, total):
    """The log likelihood whose scores sum to `total` (Eq. 6)."""
    return _log_likelihood(state.settings, state.parameters, total)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _prepare(state, half, k):
    """Find the bounds and the rectangle of solid k; draw it if it is a mesh."""
    settings, parameters, rectangle = state.settings, state.parameters, state.rectangle[half, k]
    call_for_nothing(
        settings[BOUND],
        state.kind[0, k],
        state.pose[half, k],
        state.size[half, k],
        parameters,
        settings[WIDTH],
        settings[HEIGHT],
        state.prepared[half, k],
        rectangle,
    )
    if state.kind[0, k] == MESH and rectangle[0] < rectangle[1]:
        image = state.images[MESHES + 2 * state.kind[2, k] + half]
        for row in range(rectangle[2], rectangle[3]):
            for column in range(rectangle[0], rectangle[1]):
                image[row, column] = 0.0
        call_for_nothing(settings[RASTERISE], image, state.meshes, state.kind[1, k], state.size[half, k],
                         state.pose[half, k], parameters, rectangle)  # fmt: skip


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _rescore(settings, parameters, total, taps, images, region):
    whole_image(settings, region)
    total[CURRENT], _ = score_region(settings, parameters, taps, images, CURRENT, region)
    settings[STALE] = 1
    return _log_likelihood(settings, parameters, total[CURRENT])


@njit(cache=True, nogil=True, borrows=True)
def rescore_state(state):
    """Blur and score the current scene anew without drawing it; returns its log likelihood."""
    return _rescore(state.settings, state.parameters, state.total, state.taps, state.images, state.regions[SCORED, 0])


@njit(cache=True, nogil=True, borrows=True)
def load_state(state, poses, sizes):
    """Make a scene the current one and return its log likelihood: the full evaluation.

    poses : (N, 4, 4), sizes : (N, 3) float64, of all the solids in their order.
    """
    settings, region = state.settings, state.regions[DRAWN, 0]
    for k in range(state.kind.shape[1]):
        copy_placed(poses[k], sizes[k], state.pose[CURRENT, k], state.size[CURRENT, k])
        _prepare(state, CURRENT, k)
    settings[PENDING], settings[REGIONS] = 0, 0
    whole_image(settings, region)
    call_for_nothing(settings[DRAW], settings, state.parameters, state.images, state.kind, state.prepared,
                     state.rectangle, CURRENT, region)  # fmt: skip
    return _rescore(settings, state.parameters, state.total, state.taps, state.images, region)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _copy_pixels(images, source, target, left, right, top, bottom):
    """Copy columns left:right, rounded up to LANES, and rows top:bottom of one image to another.

    What is copied beyond is the same in both, is about to be, or is never read: rows end in 2 LANES of padding.
    """
    one, other = images[source], images[target]
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            store(other, row, column, load(one, row, column))


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _copy_solid(images, kind, pose, size, prepared, rectangle, source, k):
    """Copy what is known of solid k from one half to the other."""
    target = 1 - source
    copy_placed(pose[source, k], size[source, k], pose[target, k], size[target, k])
    for i in range(4):
        rectangle[target, k, i] = rectangle[source, k, i]
    for i in range(prepared.shape[2]):
        prepared[target, k, i] = prepared[source, k, i]
    if kind[0, k] == MESH:
        first, r = MESHES + 2 * kind[2, k], rectangle[source, k]
        _copy_pixels(images, first + source, first + target, r[0], r[1], r[2], r[3])


@njit(cache=True, nogil=True, borrows=True)
def propose_state(state, count, indices, poses, sizes):
    """Return the log likelihood with some solids moved or resized; `settle_state` must follow.

    Where settings[WHOLE] is set, every pixel is drawn and scored, and it is unset.

    count : how many. indices : (>= count,) int64, no solid twice. poses : (>= count, 4, 4), sizes : (>= count, 3).
    """
    settings, images, kind, total = state.settings, state.images, state.kind, state.total
    pose, size, prepared, rectangle, regions = state.pose, state.size, state.prepared, state.rectangle, state.regions
    if settings[STALE] != 0:  # after a full evaluation the candidate half has to catch up
        for k in range(kind.shape[1]):
            _copy_solid(images, kind, pose, size, prepared, rectangle, CURRENT, k)
        _copy_pixels(images, DEPTH + CURRENT, DEPTH + CANDIDATE, 0, images.shape[2], 0, images.shape[1])
        if settings[LIKELIHOOD] == CORRELATED:
            last = len(images) - SHOWS
            _copy_pixels(images, last + CURRENT, last + CANDIDATE, 0, images.shape[2], 0, images.shape[1])
        settings[STALE] = 0
    settings[PENDING], settings[REGIONS] = count, 0
    for n in range(count):
        k = indices[n]
        state.lists[0, n] = k
        copy_placed(poses[n], sizes[n], pose[CANDIDATE, k], size[CANDIDATE, k])
        _prepare(state, CANDIDATE, k)
        add_region(settings, regions, rectangle[CURRENT, k])
        add_region(settings, regions, rectangle[CANDIDATE, k])
    whole, change = settings[WHOLE] != 0, 0.0
    if whole:
        whole_image(settings, regions[DRAWN, 0])
        whole_image(settings, regions[SCORED, 0])
        settings[REGIONS], settings[WHOLE] = 1, 0
    for n in range(settings[REGIONS]):
        call_for_nothing(
            settings[DRAW], settings, state.parameters, images, kind, prepared, rectangle, CANDIDATE, regions[DRAWN, n]
        )
    for n in range(settings[REGIONS]):
        new, old = score_region(settings, state.parameters, state.taps, images, CANDIDATE, regions[SCORED, n])
        change += new - (0.0 if whole else old)
    total[CANDIDATE] = (0.0 if whole else total[CURRENT]) + change
    return _log_likelihood(settings, state.parameters, total[CANDIDATE])


@njit(cache=True, nogil=True, borrows=True)
def settle_state(state, source):
    """Copy what the proposal changed from one half to the other: CANDIDATE accepts it, CURRENT rejects it."""
    settings, images, regions, total = state.settings, state.images, state.regions, state.total
    for n in range(settings[PENDING]):
        _copy_solid(
            images, state.kind, state.pose, state.size, state.prepared, state.rectangle, source, state.lists[0, n]
        )
    width, target = settings[WIDTH], 1 - source
    for n in range(settings[REGIONS]):
        drawn, scored = regions[DRAWN, n], regions[SCORED, n]
        left = 0 if drawn[0] == 0 else drawn[0] + PAD  # with the replicated edges
        right = (drawn[1] if drawn[1] < width else width + LANES) + PAD
        _copy_pixels(images, DEPTH + source, DEPTH + target, left, right, drawn[2], drawn[3])
        left, right, top, bottom = scored[0] + PAD, scored[1] + PAD, scored[2], scored[3]
        if source == CANDIDATE:  # the next proposal writes its own scores before it reads them
            _copy_pixels(images, SCORE + CANDIDATE, SCORE + CURRENT, left, right, top, bottom)
        if settings[LIKELIHOOD] == CORRELATED:
            last = len(images) - SHOWS
            _copy_pixels(images, last + source, last + target, left, right, top, bottom)
    settings[PENDING], settings[REGIONS] = 0, 0
    if source == CANDIDATE:
        total[CURRENT] = total[CANDIDATE]
        settings[ACCEPTED] += 1
        if settings[ACCEPTED] % REFRESH == 0:
            fresh = 0.0
            for row in range(settings[HEIGHT]):
                for column in range(PAD, PAD + width):
                    fresh += images[SCORE + CURRENT, row, column]
            total[CURRENT] = fresh


def new_engine(*image: Any) -> EngineState:
    """Return `new_state(*image)`, the state of one chain, with the addresses of what its kernels call.

    So only what it needs is compiled: one blur, one likelihood, the rasteriser where there are meshes.
    """
    state = new_state(*image)
    settings, images, index = state.settings, state.images, CURRENT
    settings[BOUND], settings[RASTERISE] = bound_address(), rasterise_address(state.meshes, images[0])
    settings[DRAW] = address_of(
        draw_region,
        settings,
        state.parameters,
        images,
        state.kind,
        state.prepared,
        state.rectangle,
        index,
        state.regions[0, 0],
    )
    allow_blur(state, int(settings[RADIUS]))
    settings[RATE] = address_of(SCORES[int(settings[LIKELIHOOD])], state.parameters, images, *6 * [index])
    return state


def allow_blur(state: EngineState, radius: int) -> None:
    """Let a state take blurs that reach so many pixels, in this process, as its own may."""
    settings, image = state.settings, state.images[0]
    if not settings[BLURS + radius]:
        settings[BLURS + radius] = address_of(blur_for(radius), image, image, state.taps, *5 * [CURRENT])
    settings[BLUR] = settings[BLURS + settings[RADIUS]]


def change_blur(state: EngineState, blur: float) -> None:
    """Give a state another blur; score or load the scene again after it."""
    set_blur(state.settings, state.taps, blur)
    allow_blur(state, int(state.settings[RADIUS]))


def for_steps(state: EngineState) -> EngineState:
    """Let other kernels call a state's by `propose_in` and `settle_in`, in this process; return it."""
    if not state.settings[PROPOSE]:
        index = np.int64(0)
        state.settings[PROPOSE] = address_of(propose_state, state, index, state.lists[0], state.pose[0], state.size[0])
        state.settings[SETTLE] = address_of(settle_state, state, index)
    return state


@njit(inline="always", borrows=True)
def propose_in(state, count, indices, poses, sizes):
    """As `propose_state`, for kernels: the engine is not compiled into them."""
    if state.settings[PROPOSE] == 0:
        raise ValueError("this state has no addresses: see for_steps")
    return call_for_number(state.settings[PROPOSE], state, count, indices, poses, sizes)


@njit(inline="always", borrows=True)
def settle_in(state, source):
    """As `settle_state`, for kernels: the engine is not compiled into them."""
    if state.settings[SETTLE] == 0:
        raise ValueError("this state has no addresses: see for_steps")
    call_for_nothing(state.settings[SETTLE], state, source)


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
    engines = array_by_array(_stacked, *states)
    into = np.ascontiguousarray(into, np.float64)
    elsewhere = np.any(into != np.eye(4), axis=(1, 2))
    views = Views(engines, into, elsewhere, np.zeros(states[0].pose.shape[1:]))
    for view in range(len(states)):
        for_steps(engine_of_view(views, view))
    return views


def engine_of_view(views: Views, view: int) -> EngineState:
    """Return the engine of one view, which shares its arrays with the Views."""
    return array_by_array(lambda arrays: arrays[view], views.engines)


def _stacked(*arrays: np.ndarray) -> np.ndarray:
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
    meshes = engines.meshes
    return EngineState(
        engines.settings[view], engines.parameters[view], engines.total[view], engines.taps[view],
        engines.images[view], engines.kind[view], engines.pose[view], engines.size[view],
        engines.prepared[view], engines.rectangle[view], engines.lists[view], engines.regions[view],
        Meshes(meshes.vertices[view], meshes.triangles[view], meshes.starts[view], meshes.extents[view],
               meshes.points[view]),
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
            compose(into, poses[n], moved[n])
        total += propose_in(engine, count, indices, moved, sizes)
    return total


@njit(cache=True, nogil=True, borrows=True)
def settle_views(views, source):
    """Accept (CANDIDATE) or reject (CURRENT) what was proposed, in all views."""
    for view in range(len(views.into)):
        settle_in(_engine(views.engines, view), source)
