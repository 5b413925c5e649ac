"""Where objects stand in the world, on the face below them taken for a plane; and putting them down on it anew."""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.compilation.call import call_for_nothing, call_for_number, call_for_two_numbers
from derender.posterior.compiled.evaluate import put_all
from derender.posterior.compiled.layout import (
    CHILD_FACE,
    CONTACT_CODE,
    FOLD_PERIOD,
    INVERSE_AT,
    KIND,
    NOW,
    POSE_AT,
    SHAPES,
    SIZES,
)
from derender.posterior.compiled.poses import seen_from
from derender.posterior.compiled.prior import wrap
from derender.render.raycast.state import SIGMA
from derender.scene.contacts.compiled import compose
from derender.scene.solids import PLANE

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
