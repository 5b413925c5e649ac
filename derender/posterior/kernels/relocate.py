"""Objects put down anew in the world, where warm-up saw them; their children stay where they are.

A place is drawn from a mixture of multivariate t distributions with equal weights, one about each place (angle, x, y)
that warm-up saw (`fitted`): it follows every mode, however narrow.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np

from derender.compilation.cache import njit
from derender.posterior.compiled.prior import wrap
from derender.posterior.kernels.base import PLACING, KernelType, kernels
from derender.posterior.space import Block, Space

DEGREES = 5  # of freedom of each component: heavier tails than an image's posterior
NEIGHBOURS = 16  # among the other places; a mode that holds as many has components of its own shape
LEAST = 1e-5  # radians and metres, a floor of the spread
UNSEEN = (0.2, 0.02)  # spread of angles and of lengths about the places where there are few


def shortest(steps: np.ndarray, periods: np.ndarray) -> np.ndarray:
    """Return (..., D) steps with those of angles taken the short way."""
    turns = periods > 0.0
    half = 0.5 * periods[turns]
    steps[..., turns] = (steps[..., turns] + half) % periods[turns] - half
    return steps


def fitted(centres: np.ndarray, periods: tuple[float, ...]) -> np.ndarray:
    """Return the mixture about (K, D) places; each component has the covariance of its nearest neighbours.

    Flat float64: centre, lower triangle of the Cholesky factor, that of its inverse, whose determinant; each number of
    all K at once. periods : of the angles, which live on circles; 0 of lengths.

    So each is as wide and as slanted as the posterior is there. Near is meant in units of the components' harmonic mean
    covariance, found with a first round in units of all places'.
    """
    return _fitted(np.ascontiguousarray(centres).tobytes(), periods)


@functools.lru_cache(128)
def _fitted(content: bytes, periods: tuple[float, ...]) -> np.ndarray:
    size, around = len(periods), np.array(periods)
    centres = np.frombuffer(content).reshape(-1, size)
    steps = shortest(centres[None] - centres[:, None], around)
    near = min(max(NEIGHBOURS, 2 * size), len(centres) - 1)
    if near <= size:
        covariances = np.tile(np.diag(np.square(np.where(around > 0.0, *UNSEEN))), (len(centres), 1, 1))
    else:
        floor = LEAST**2 * np.eye(size)
        all_steps = steps.reshape(-1, size)
        metric = all_steps.T @ all_steps / (2.0 * len(centres) ** 2) + floor
        for _ in range(2):
            white = np.linalg.inv(np.linalg.cholesky(metric)) @ all_steps.T
            distances = np.sum(white * white, axis=0).reshape(len(centres), -1)
            nearest = np.argpartition(distances, near, axis=1)[:, : near + 1]
            close = np.take_along_axis(steps, nearest[..., None], axis=1)
            covariances = close.transpose(0, 2, 1) @ close / near + floor
            metric = np.linalg.inv(np.linalg.inv(covariances).mean(axis=0))
    factors, below = np.linalg.cholesky(covariances), np.tril_indices(size)
    inverses = np.linalg.inv(factors)
    determinants = np.prod(np.diagonal(inverses, axis1=1, axis2=2), axis=1)
    rows = [centres, factors[:, *below], inverses[:, *below], determinants[:, None]]
    return np.concatenate(rows, axis=1).T.ravel()


@njit(cache=True, nogil=True)
def mixture_density(places, periods, place):
    """Return q(place) up to its constant; steps of more than half a period are never proposed.

    places : see `fitted`. periods : of the angles, 0 of lengths.

    Number by number over all components, and not component by component: so the processor takes several at once.
    """
    size = len(place)
    first = size + size * (size + 1) // 2  # of the inverses' rows
    count = len(places) // (2 * first - size + 1)
    steps, white, squared = np.empty((size, count)), np.empty(count), np.zeros(count)
    for i in range(size):
        step, centre = steps[i], places[i * count : (i + 1) * count]
        for k in range(count):
            step[k] = place[i] - centre[k]
        period = periods[i]
        if period > 0.0:
            for k in range(count):
                step[k] -= period * math.floor(step[k] / period + 0.5)
    at = first
    for i in range(size):
        white[:] = 0.0
        for j in range(i + 1):
            step, factor = steps[j], places[at * count : (at + 1) * count]
            for k in range(count):
                white[k] += factor[k] * step[k]
            at += 1
        for k in range(count):
            squared[k] += white[k] * white[k]
    for k in range(count):
        squared[k] = 1.0 + squared[k] / DEGREES
    power = white  # to the power of (DEGREES + size) / 2, which is whole
    power[:] = 1.0
    for _ in range((DEGREES + size) // 2):
        for k in range(count):
            power[k] *= squared[k]
    determinant, total = places[at * count :], 0.0
    for k in range(count):
        total += determinant[k] / power[k]
    return total


@njit(cache=True, nogil=True)
def seen_place(rng, places, periods, old, new):
    """Propose a place w' = (angle, x, y) on the floor below the object, from a mixture q over the places of an archive.

    The archive was filled in warm-up by all chains and is frozen; q (`fitted`) does not look at the present
    place. A tangent beyond half an angle's period is refused: that is a proposal to stay, and q elsewhere is what it
    was. In the world's coordinates what is seen of one object hardly depends on where the others are, as it does in
    those of its contact, which hang on the parent.

    The contact's numbers phi are another chart of w: per phi the proposal has the density q(w(phi)) |dw / dphi|, where
    the Jacobian is the touching area of (u, v) (Figure 2), or one for metres. The children's contacts are kept as in
    `slide`. With J = |dw / dphi|,
    log ratio = log posterior(new) - log posterior(old) + log q(w) - log q(w') + log J(old) - log J(new)
                + sum of log |d phi_c' / d phi_c|,
    of which the last three terms come from putting the object there (`reattach`); where one would lose its contact
    there is no density, and the step is refused (as is the way back from there).

    old, new : (D,) the object's places, (angle, x, y); `new` is written.
    """
    size = len(old)
    number = len(places) // (size + size * (size + 1) + 1)
    k = int(rng.random() * number)
    normal = np.empty(size)
    for i in range(size):
        normal[i] = rng.standard_normal()
    chi_squared = 0.0
    for _ in range(DEGREES):
        chi_squared += rng.standard_normal() ** 2
    stretch = math.sqrt(DEGREES / chi_squared)
    at = size
    for i in range(size):
        step = 0.0
        for j in range(i + 1):
            step += places[at * number + k] * normal[j]
            at += 1
        step *= stretch
        new[i] = places[i * number + k] + step
        if periods[i] > 0.0:
            if not abs(step) <= 0.5 * periods[i]:
                return math.nan
            new[i] = wrap(new[i], periods[i])
    return math.log(mixture_density(places, periods, old)) - math.log(mixture_density(places, periods, new))


@kernels.register("relocate")
class RelocateType(KernelType):
    """Put an object down anew where warm-up has seen it in the world, and leave what stands on it where it is."""

    keeps_children = True
    form = PLACING
    proposal = seen_place

    def applies(self, space: Space, block: Block) -> bool:
        return block.name in space.relocations

    def moves(self, space: Space, block: Block) -> Sequence[int]:
        return ()  # to where warm-up was, and nowhere without compiled steps
