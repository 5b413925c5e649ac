"""Where objects are put down anew in the world, compiled; see kernels.relocate. `contacts` finds their contacts."""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.compilation.call import call_for_nothing
from derender.posterior.compiled.layout import CHILD_FACE, CONTACT_CODE, FOLD_PERIOD, KIND, NOW, POSE_AT, SHAPES, SIZES
from derender.posterior.compiled.prior import wrap
from derender.posterior.compiled.standing import UNBOUNDED, stand
from derender.posterior.kernels.place_mixture import DEGREES
from derender.posterior.kernels.turn import CLOSEST, FARTHEST
from derender.scene.contacts.compiled import compose

PLACE_ROWS = 3 + 3 * 4 + 1  # numbers of a component of one object's places, see PlaceMixture.flat


@njit(cache=True, nogil=True)
def mixture_density(places, size, periods, place):
    """Return q(place) up to its constant. places : see PlaceMixture.flat; periods : of the angles, every third number.

    Number by number over all components, and not component by component: so the processor takes several at once.
    """
    first = size + size * (size + 1) // 2  # of the inverses' rows
    count = len(places) // (2 * first - size + 1)
    steps, white, squared = np.empty((size, count)), np.empty(count), np.zeros(count)
    for i in range(size):
        step, centre = steps[i], places[i * count : (i + 1) * count]
        for k in range(count):
            step[k] = place[i] - centre[k]
        if i % 3 == 0:
            period = periods[i // 3]
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
    power = white  # to the power of (DEGREES + size) / 2
    power[:] = 1.0
    if (DEGREES + size) % 2:
        for k in range(count):
            power[k] = math.sqrt(squared[k])
    for _ in range((DEGREES + size) // 2):
        for k in range(count):
            power[k] *= squared[k]
    determinant, total = places[at * count :], 0.0
    for k in range(count):
        total += determinant[k] / power[k]
    return total


@njit(cache=True, nogil=True)
def relocate(rng, vertices, laws, numbers, pose, relative, there, put, base, face, thetas, places):
    """Write the poses `there` of the vertices `put`; return log q(old) / q(new), NaN where there is none.

    base, face : vertex and face below all of them. thetas : the unknowns that turn them.
    """
    count = len(put)
    size = 3 * count
    number = len(places) // (size + size * (size + 1) + 1)
    k = int(rng.random() * number)
    normal = np.empty(size)
    for i in range(size):
        normal[i] = rng.standard_normal()
    chi_squared = 0.0
    for _ in range(DEGREES):
        chi_squared += rng.standard_normal() ** 2
    stretch = math.sqrt(DEGREES / chi_squared)
    old, new, periods, phi = np.empty(size), np.empty(size), np.empty(count), np.empty(7)
    at = size
    for i in range(size):
        step = 0.0
        for j in range(i + 1):
            step += places[at * number + k] * normal[j]
            at += 1
        step *= stretch
        new[i] = places[i * number + k] + step
        if i % 3 == 0:
            period = laws[thetas[i // 3], FOLD_PERIOD]
            if not abs(step) <= 0.5 * period:
                return math.nan
            periods[i // 3], new[i] = period, wrap(new[i], period)
    for c in range(count):
        stand(vertices, numbers, pose, relative, base, face, put[c], phi)
        for i in range(3):
            old[3 * c + i], phi[i] = phi[i], new[3 * c + i]
        put_down(vertices, numbers, pose, relative, base, face, put[c], phi, there[c])
    log_ratio = math.log(mixture_density(places, size, periods, old))
    return log_ratio - math.log(mixture_density(places, size, periods, new))


@njit(cache=True, nogil=True)
def turn(rng, vertices, laws, numbers, pose, relative, there, put, base, face, thetas, places):
    """Write the pose `there` of the only vertex `put` at another angle and shifted a little; symmetric, return 0.

    The arguments are those of `relocate`.
    """
    phi, number = np.empty(7), len(places) // PLACE_ROWS
    first, second = int(rng.random() * number), int(rng.random() * number)
    factor = FARTHEST * math.exp(rng.random() * math.log(CLOSEST / FARTHEST))
    stand(vertices, numbers, pose, relative, base, face, put[0], phi)
    for i in range(1, 3):
        phi[i] += factor * (places[i * number + first] - places[i * number + second])
    phi[0] = rng.random() * laws[thetas[0], FOLD_PERIOD]
    put_down(vertices, numbers, pose, relative, base, face, put[0], phi, there[0])
    return 0.0


@njit(cache=True, nogil=True)
def put_down(vertices, numbers, pose, relative, base, face, n, phi, there):
    """Write the pose `there` that vertex n has with the contact `phi` on the plane of a face of vertex `base`."""
    below, child_size = numbers[NOW, base, SIZES:SHAPES], numbers[NOW, n, SIZES:SHAPES]
    call_for_nothing(vertices[POSE_AT, n], vertices[CONTACT_CODE, n], UNBOUNDED, below, vertices[KIND, n], child_size,
                     face, vertices[CHILD_FACE, n], phi, relative)  # fmt: skip
    compose(pose[NOW, base], relative, there)
