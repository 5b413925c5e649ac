"""Objects put down in the world: which contacts leave them where they are or put them where they shall be, compiled."""

import math

import numpy as np

from derender.compilation.cache import call_for_nothing, call_for_number, call_for_two_numbers, njit
from derender.posterior.compiled.evaluate import fill, place, put_all, seen_from
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
    POSE_AT,
    SHAPES,
    SIZES,
    SLOT,
    TABLE,
    VERTEX,
)
from derender.posterior.compiled.prior import wrap
from derender.render.raycast.state import SIGMA
from derender.scene.contacts.compiled import compose, outline
from derender.scene.polygon import area_element
from derender.scene.solids import PLANE

NEAR = 1e-7  # slack that rounding may leave


@njit(cache=True, nogil=True)
def fold(angle, centre, period):
    """Return the angle by whole periods into [centre - period / 2, centre + period / 2)."""
    return wrap(angle - centre + 0.5 * period, period) + centre - 0.5 * period


@njit(cache=True, nogil=True)
def reattach(vertices, extents, places, laws, values, numbers, pose, marks, parameters, scratch, n, put, there):
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


UNBOUNDED = np.int64(PLANE)  # the face below is taken for a plane: offsets on it are metres


@njit(cache=True, nogil=True)
def stand(vertices, numbers, pose, relative, base, face, n, phi):
    """Write the contact that vertex n would have on the plane of a face of vertex `base`: angle, x, y, slack."""
    seen_from(pose[NOW, base], pose[NOW, n], relative)
    size, child_size = numbers[NOW, base, SIZES:SHAPES], numbers[NOW, n, SIZES:SHAPES]
    call_for_two_numbers(vertices[INVERSE_AT, n], vertices[CONTACT_CODE, n], UNBOUNDED, size, vertices[KIND, n],
                         child_size, face, vertices[CHILD_FACE, n], relative, phi)  # fmt: skip


@njit(cache=True, nogil=True)
def stand_all(model, chain, archive, objects, places):
    """Write (B, K, 3), the place of each object in each of (K, P) values.

    objects : (4, B) int64: the vertex, the vertex and the face below, and the unknown that is its theta.
    """
    phi, parameters = np.empty(7), np.empty(SIGMA + 1)
    for k in range(len(archive)):
        put_all(model, chain, parameters, archive[k])
        for b in range(objects.shape[1]):
            stand(model.vertices, chain.numbers, chain.pose, chain.relative, objects[1, b], objects[2, b],
                  objects[0, b], phi)  # fmt: skip
            places[b, k, 0] = wrap(phi[0], model.laws[objects[3, b], FOLD_PERIOD])
            places[b, k, 1], places[b, k, 2] = phi[1], phi[2]


@njit(cache=True, nogil=True)
def put_down(rng, vertices, laws, numbers, pose, relative, there, put, base, face, thetas, places, propose_at):
    """Write the poses `there` of the vertices `put`; return the proposal's log ratio, NaN where there is none.

    base, face : vertex and face below all of them. thetas : the unknowns that turn them. places : see
    PlaceMixture.flat. propose_at : address of the kernel's proposal, from old places to new ones.
    """
    count = len(put)
    old, new, periods, phi = np.empty(3 * count), np.empty(3 * count), np.zeros(3 * count), np.empty((count, 7))
    for c in range(count):
        stand(vertices, numbers, pose, relative, base, face, put[c], phi[c])
        periods[3 * c] = laws[thetas[c], FOLD_PERIOD]
        for i in range(3):
            old[3 * c + i] = phi[c, i]
    log_ratio = call_for_number(propose_at, rng, places, periods, old, new)
    if math.isnan(log_ratio):
        return math.nan
    below = numbers[NOW, base, SIZES:SHAPES]
    for c in range(count):
        n = put[c]
        for i in range(3):
            phi[c, i] = new[3 * c + i]
        call_for_nothing(vertices[POSE_AT, n], vertices[CONTACT_CODE, n], UNBOUNDED, below, vertices[KIND, n],
                         numbers[NOW, n, SIZES:SHAPES], face, vertices[CHILD_FACE, n], phi[c], relative)  # fmt: skip
        compose(pose[NOW, base], relative, there[c])
    return log_ratio
