"""Where objects stand in the world: on the face below them, taken for a plane; see kernels.relocate."""

import numpy as np

from derender.compilation.cache import njit
from derender.compilation.call import call_for_two_numbers
from derender.posterior.compiled.evaluate import put_all
from derender.posterior.compiled.layout import (
    CHILD_FACE,
    CONTACT_CODE,
    FOLD_PERIOD,
    INVERSE_AT,
    KIND,
    NOW,
    SHAPES,
    SIZES,
)
from derender.posterior.compiled.poses import seen_from
from derender.posterior.compiled.prior import wrap
from derender.render.raycast.state import SIGMA
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
