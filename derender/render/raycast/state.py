"""What one chain's engine holds: a NamedTuple of arrays that compiled code passes around. Many may live in a process.

Wherever the first axis is CURRENT / CANDIDATE, the current half is the accepted scene, and the candidate half equals it
outside the regions of a pending proposal.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.cache import interpreted, njit
from derender.render.blur import reach, write_taps
from derender.render.raycast.convex import PREPARED
from derender.render.raycast.depth import Meshes, camera_array, flat_meshes
from derender.render.raycast.lane_names import LANES
from derender.scene.solids import MESH, Solids

# numpy integers, not literals: numba would compile every function once for each literal
CURRENT, CANDIDATE = np.int64(0), np.int64(1)
# entries of `settings` (int64): the image, then what the pending proposal is
WIDTH, HEIGHT, RADIUS, MARGIN, LIKELIHOOD, PENDING, REGIONS, ACCEPTED, STALE = range(9)
# of `settings`: the addresses of kernels, see engine.py
PROPOSE, SETTLE, BOUND, DRAW, BLUR, RATE, RASTERISE = range(9, 16)
# of `settings`: whether the next proposal changes the likelihood's numbers, so that every pixel is scored; and where
# the addresses of the blurs that may be taken begin, in the order of how far they reach
WHOLE, BLURS = 16, 17
GAUSSIAN, ROBUST, CORRELATED = range(3)  # values of settings[LIKELIHOOD]
# entries of `parameters` (float64): camera, likelihood; those of the others follow, see their scores
FX, FY, CX, CY, SIGMA, BACKGROUND, OBSERVED = range(7)
LIKELIHOOD_PARAMETERS, PARAMETERS = 7, 15
# images: observed, then clean depth and score of the current and the candidate scene, then inverse depths of meshes,
# and under CORRELATED what its scores need
OBSERVED_IMAGE, DEPTH, SCORE, MESHES = np.int64(0), np.int64(1), np.int64(3), np.int64(5)
SHOWS, GOING_ON, ANEW = 2, 3, 4  # of CORRELATED, from the end: of both scenes, of the image alone, and scratch
NO_RETURN = np.float32(-1.0)  # in SHOWS


class EngineState(NamedTuple):
    """Attributes (H, W: image; N: solids; R: blur radius; P: a row of a padded image; axis of 2: current, candidate).

    parameters : (PARAMETERS,) float64: camera, blur's reach, the likelihood's numbers. OBSERVED is the number of pixels
        with a return. SIGMA may be written at any time: with the gaussian likelihood `log_likelihood_of` is right at
        once, with others after `rescore_state`.
    images : (5 + 2 M, H, P; under CORRELATED 9 + 2 M) float32; pixel i of a row is at column i + PAD. [OBSERVED_IMAGE]
        metres; NaN in the padding and for missing pixels (gaussian; under others they are 0, and below zero where they
        show what is no part of the scene, see `Robust`), [DEPTH + half] clean model depth, edges replicated, [SCORE +
        half] each pixel's squared residual (gaussian) or log density (others), of the candidate only while it is
        proposed, [MESHES + 2 slot + half] inverse depth of each mesh, without padding, filled in its rectangle only,
        [-GOING_ON] the density of each pixel that goes on as earlier ones do, see `Correlated`, [-SHOWS + half] the
        probability that each shows its surface, NO_RETURN where nothing returned, [-ANEW] scratch: the density of each
        pixel that tells anew.
    pose : (2, N, 4, 4), size : (2, N, 3), prepared : (2, N, PREPARED) float64.
    regions : (2, 2 N + 1, 4) int64: the proposal's regions, as drawn, and as scored (with the blur's margin).
    """

    settings: np.ndarray  # (BLURS + PAD,) int64, see WIDTH ... BLURS.
    parameters: np.ndarray
    total: np.ndarray  # (2,) float64, sums of the scores
    taps: np.ndarray  # (PAD,) float32, blur weights from the centre outwards, of which R + 1 count
    images: np.ndarray
    kind: np.ndarray  # (3, N) int64: kind and mesh as in Solids, and which of the M meshes' images is this one's
    pose: np.ndarray
    size: np.ndarray
    prepared: np.ndarray
    rectangle: np.ndarray  # (2, N, 4) int64
    lists: np.ndarray  # (2, N) int64: solids moved by the proposal; scratch
    regions: np.ndarray
    meshes: Meshes


def array_by_array(function: Callable[..., np.ndarray], *states: Any) -> Any:
    """Return a state whose arrays are what a function makes of those of some states, tuples in tuples alike."""
    made = [array_by_array(function, *parts) if isinstance(parts[0], tuple) else function(*parts)
            for parts in zip(*states, strict=True)]  # fmt: skip
    return type(states[0])(*made)


PAD = LANES  # columns of padding before pixel 0: more than any blur radius allowed here
MAXIMUM_RADIUS = PAD - 1


@njit(cache=True, nogil=True, borrows=True)
def take_blur(settings, taps, blur):
    """Write a blur of so many pixels: its weights, how far a pixel is blurred, and how far it tells on scores, a pixel
    farther where noise is shared.

    The robust score looks at its neighbours' clean depths. Raises ValueError : a blur that none of the engine's is for.
    """
    if not 0 <= reach(blur) <= MAXIMUM_RADIUS:
        raise ValueError("a blur has to reach less far than rows are padded")
    radius, kind = write_taps(blur, taps), settings[LIKELIHOOD]
    settings[RADIUS], settings[BLUR] = radius, settings[BLURS + radius]
    settings[MARGIN] = radius + 1 if kind == CORRELATED else max(radius, int(kind == ROBUST))


set_blur = interpreted(take_blur)


@njit(cache=True, nogil=True, borrows=True)
def write_observed(image, observed, gaussian):
    """Write an observed image (H, W) into an engine's (H, P), and return how many of its pixels returned."""
    returned = 0
    for row in range(len(image)):
        for column in range(image.shape[1]):
            image[row, column] = np.nan
        for column in range(observed.shape[1]):
            value = observed[row, column]
            if np.isfinite(value) and (value > 0.0 if gaussian else value != 0.0):
                image[row, PAD + column] = value
                returned += 1
            elif not gaussian:
                image[row, PAD + column] = 0.0
    return returned


def new_state(
    camera: Camera,
    observed: np.ndarray,
    solids: Solids,
    kind: int,
    parameters: np.ndarray,
    blur: float,
    beside: np.ndarray | None = None,
) -> EngineState:
    """Allocate the state of one chain for an image and for scenes with as many solids of the same kinds as `solids`.

    observed : (height, width) metres, NaN where nothing returned. kind : GAUSSIAN, ROBUST or CORRELATED, with its
        `parameters`.
    blur : sigma in pixels. beside : see `Likelihood.beside`. Kernels take what `engine.new_engine` makes of it.
    """
    height, width = camera.height, camera.width
    padded = PAD + -(-width // LANES) * LANES + 2 * LANES
    count = len(solids.kind)
    is_mesh = np.asarray(solids.kind) == MESH
    kinds = np.stack([solids.kind, solids.mesh, np.where(is_mesh, np.cumsum(is_mesh) - 1, -1)]).astype(np.int64)
    last = MESHES + 2 * int(is_mesh.sum())
    images = np.empty((last + (ANEW if kind == CORRELATED else 0), height, padded), np.float32)
    images[DEPTH:SCORE] = 1.0
    images[SCORE:MESHES] = 0.0  # the padding never scores
    images[MESHES:last] = 1.0
    images[last:] = NO_RETURN
    if beside is not None:
        images[-GOING_ON, :, PAD : PAD + width] = beside
    returned = write_observed(
        images[OBSERVED_IMAGE], np.ascontiguousarray(observed, np.float64), bool(kind == GAUSSIAN)
    )
    numbers = np.zeros(PARAMETERS)
    numbers[:4] = camera_array(camera)
    numbers[SIGMA : SIGMA + len(parameters)] = parameters
    numbers[OBSERVED] = returned
    settings, taps = np.zeros(BLURS + PAD, np.int64), np.zeros(PAD, np.float32)
    settings[WIDTH], settings[HEIGHT], settings[LIKELIHOOD] = width, height, kind
    set_blur(settings, taps, blur)
    return EngineState(
        settings=settings,
        parameters=numbers,
        total=np.zeros(2),
        taps=taps,
        images=images,
        kind=kinds,
        pose=np.zeros((2, count, 4, 4)),
        size=np.zeros((2, count, 3)),
        prepared=np.zeros((2, count, PREPARED)),
        rectangle=np.zeros((2, count, 4), np.int64),
        lists=np.zeros((2, count), np.int64),
        regions=np.zeros((2, 2 * count + 1, 4), np.int64),
        meshes=flat_meshes(solids.meshes),
    )
