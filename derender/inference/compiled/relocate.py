"""Where objects are put down anew in the world, compiled; see kernels.relocate. Their contacts are `keep`'s to find."""

import math

import numpy as np

from derender.inference.compiled.layout import CHILD_FACE, CONTACT_CODE, FOLD_PERIOD, KIND, NOW, POSE_AT, SHAPES, SIZES
from derender.inference.compiled.prior import wrap
from derender.inference.compiled.standing import UNBOUNDED, stand
from derender.inference.kernels.place_mixture import DEGREES
from derender.kernel_cache import njit
from derender.kernel_call import call_for_nothing
from derender.model.contacts.compiled import compose


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
    below = numbers[NOW, base, SIZES:SHAPES]
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
        n = put[c]
        contact, by, child_size = vertices[CONTACT_CODE, n], vertices[CHILD_FACE, n], numbers[NOW, n, SIZES:SHAPES]
        stand(vertices, numbers, pose, relative, base, face, n, phi)
        for i in range(3):
            old[3 * c + i], phi[i] = phi[i], new[3 * c + i]
        call_for_nothing(vertices[POSE_AT, n], contact, UNBOUNDED, below, vertices[KIND, n], child_size, face, by, phi,
                         relative)  # fmt: skip
        compose(pose[NOW, base], relative, there[c])
    log_ratio = math.log(mixture_density(places, size, periods, old))
    return log_ratio - math.log(mixture_density(places, size, periods, new))
