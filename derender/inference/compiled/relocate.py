"""Put an object down anew in the world, compiled; see kernels.relocate."""

import math

import numpy as np

from derender.inference.compiled.keep import NEAR, fold
from derender.inference.compiled.layout import (
    CHILD_FACE,
    CONTACT_CODE,
    FOLD_CENTRE,
    FOLD_PERIOD,
    KIND,
    NEXT,
    NOW,
    OFFSET,
    PARENT,
    PARENT_FACE,
    SHAPES,
    SIZES,
)
from derender.inference.compiled.poses import seen_from
from derender.inference.compiled.prior import wrap
from derender.inference.compiled.standing import UNBOUNDED, stand
from derender.inference.kernels.place_mixture import DEGREES
from derender.kernel_cache import njit
from derender.model.contacts.compiled import area_element, compose, invert, outline, relative_pose


@njit(cache=True, nogil=True)
def mixture_density(places, period, place):
    """Return q(place) up to its constant. places : of each component 16 numbers, see PlaceMixture.flat."""
    total = 0.0
    for k in range(0, len(places), 16):
        turn = place[0] - places[k]
        turn -= period * math.floor(turn / period + 0.5)
        x, y = place[1] - places[k + 1], place[2] - places[k + 2]
        a = places[k + 9] * turn
        b = places[k + 10] * turn + places[k + 11] * x
        c = places[k + 12] * turn + places[k + 13] * x + places[k + 14] * y
        power = 1.0 + (a * a + b * b + c * c) / DEGREES
        power *= power
        total += places[k + 15] / (power * power)  # the power of (DEGREES + 3) / 2
    return total


@njit(cache=True, nogil=True)
def relocate(rng, vertices, unknowns, laws, values, numbers, pose, relative, scratch, members, places, n):
    """Write the proposed contact of vertex n; return log q(old) J(old) / (q(new) J(new)), NaN where there is none."""
    base, face = members[3], members[4]
    parent, contact = vertices[PARENT, n], vertices[CONTACT_CODE, n]
    on, by = vertices[PARENT_FACE, n], vertices[CHILD_FACE, n]
    own = numbers[NOW, n]
    below, size, child_size = numbers[NOW, base, SIZES:SHAPES], numbers[NOW, parent, SIZES:SHAPES], own[SIZES:SHAPES]
    centre, period = laws[members[0], FOLD_CENTRE], laws[members[0], FOLD_PERIOD]

    k = 16 * int(rng.random() * (len(places) // 16))
    first, second, third = rng.standard_normal(), rng.standard_normal(), rng.standard_normal()
    chi_squared = 0.0
    for _ in range(DEGREES):
        chi_squared += rng.standard_normal() ** 2
    stretch = math.sqrt(DEGREES / chi_squared)
    turn = stretch * places[k + 3] * first
    if not abs(turn) <= 0.5 * period:
        return math.nan

    old, new, phi = np.empty(7), np.empty(7), np.empty(7)
    stand(vertices, numbers, pose, relative, base, face, n, old)
    for i in range(7):
        new[i] = old[i]
    new[0] = wrap(places[k] + turn, period)
    new[1] = places[k + 1] + stretch * (places[k + 4] * first + places[k + 5] * second)
    new[2] = places[k + 2] + stretch * (places[k + 6] * first + places[k + 7] * second + places[k + 8] * third)
    relative_pose(contact, UNBOUNDED, below, vertices[KIND, n], child_size, face, by, new, relative)
    compose(pose[NOW, base], relative, scratch)
    seen_from(pose[NOW, parent], scratch, relative)
    outside, angle = invert(contact, vertices[KIND, parent], size, vertices[KIND, n], child_size, on, by, relative, phi)
    if outside > 1e-9 or angle > NEAR:
        return math.nan
    phi[0] = fold(phi[0], centre, period)
    for i in range(3):
        values[NEXT, unknowns[OFFSET, members[i]]] = phi[i]
    log_ratio = math.log(mixture_density(places, period, old)) - math.log(mixture_density(places, period, new))
    a, b, radius, _ = outline(vertices[KIND, parent], size, on)
    c, d, child_radius, _ = outline(vertices[KIND, n], child_size, by)
    if a < math.inf and c < math.inf:
        radius += child_radius
        log_ratio += math.log(area_element(own[1], own[0], a, b, c, d, radius))
        log_ratio -= math.log(area_element(phi[1], phi[0], a, b, c, d, radius))
    return log_ratio
