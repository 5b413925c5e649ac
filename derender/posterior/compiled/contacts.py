"""Give objects the contacts that leave them where they are, or put them where they shall be, in the world, compiled."""

import math

from derender.compilation.cache import njit
from derender.compilation.call import call_for_two_numbers
from derender.posterior.compiled.evaluate import fill
from derender.posterior.compiled.layout import (
    CHILD_FACE,
    CONTACT,
    CONTACT_CODE,
    DIRTY,
    FOLD_CENTRE,
    FOLD_PERIOD,
    INVERSE_AT,
    KEPT,
    KIND,
    NEXT,
    NOW,
    OWNER,
    PARENT,
    PARENT_FACE,
    SHAPES,
    SIZES,
    SLOT,
    TABLE,
    VERTEX,
)
from derender.posterior.compiled.poses import place, seen_from
from derender.posterior.compiled.prior import wrap
from derender.scene.contacts.compiled import outline
from derender.scene.polygon import area_element

NEAR = 1e-7  # slack that rounding may leave


@njit(cache=True, nogil=True)
def fold(angle, centre, period):
    """Return the angle by whole periods into [centre - period / 2, centre + period / 2)."""
    return wrap(angle - centre + 0.5 * period, period) + centre - 0.5 * period


@njit(cache=True, nogil=True)
def touch_anew(vertices, extents, places, laws, values, numbers, pose, marks, parameters, scratch, n, put, there):
    """Write the proposed values of vertices from n on such that those `put` stand `there`, all others as they do now.

    put : vertices, rising, the first is n; there : (S, 4, 4), their poses. Where none are put, the proposed values of
    vertex n are there already and say where it stands.

    Returns the log of the product of |d phi' / d phi| at fixed motion in the world (see SceneTarget), NaN where one
    would leave its contact.
    """
    if len(put) == 0:
        fill(places, values, numbers, marks, parameters, False)
        place(vertices, extents, numbers, pose, scratch, n)
    log_jacobian, following = 0.0, 0
    for c in range(n + (len(put) == 0), vertices.shape[1] - 1):
        parent = vertices[PARENT, c]
        moves = following < len(put) and put[following] == c
        if not moves and not marks[DIRTY, parent]:  # its axes are as they were
            continue
        seen_from(pose[NEXT, parent], there[following] if moves else pose[NOW, c], scratch)
        following += moves
        own, phi = numbers[NOW, c], numbers[NEXT, c]
        on, by = vertices[PARENT_FACE, c], vertices[CHILD_FACE, c]
        size, child_size = numbers[NEXT, parent, SIZES:SHAPES], own[SIZES:SHAPES]
        marks[DIRTY if moves else KEPT, c] = 1
        outside, angle = call_for_two_numbers(vertices[INVERSE_AT, c], vertices[CONTACT_CODE, c],
                                              vertices[KIND, parent], size, vertices[KIND, c], child_size, on, by,
                                              scratch, phi)  # fmt: skip
        left = max(abs(phi[3] - own[3]), abs(phi[4] - own[4]), abs(phi[5] - own[5]))
        if outside > 1e-9 or angle > NEAR or left > NEAR:
            return math.nan
        phi[3], phi[4], phi[5] = own[3], own[4], own[5]
        for p in range(places.shape[1]):
            if places[VERTEX, p] == c and places[TABLE, p] == CONTACT:
                if places[SLOT, p] == 0:
                    owner = places[OWNER, p]
                    theta = fold(phi[0], laws[owner, FOLD_CENTRE], laws[owner, FOLD_PERIOD])
                    if not moves and abs(fold(phi[0] - theta, 0.0, 2.0 * math.pi)) > 1e-6:
                        marks[KEPT, c], marks[DIRTY, c] = 0, 1
                    phi[0] = theta
                values[NEXT, p] = phi[places[SLOT, p]]
        if marks[DIRTY, c]:
            place(vertices, extents, numbers, pose, scratch, c)
        a, b, radius, _ = outline(vertices[KIND, parent], size, on)
        d, e, child_radius, _ = outline(vertices[KIND, c], child_size, by)
        if a < math.inf and d < math.inf:
            radius += child_radius
            log_jacobian += math.log(area_element(own[1], own[0], a, b, d, e, radius))
            log_jacobian -= math.log(area_element(phi[1], phi[0], a, b, d, e, radius))
    return log_jacobian
