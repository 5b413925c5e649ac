"""Turn: an object turns to any angle where it stands in the world; its children stay where they are."""

import math

from derender.compilation.cache import njit
from derender.posterior.kernels.base import kernels
from derender.posterior.kernels.relocate import PlacingType

CLOSEST, FARTHEST = 0.1, 10.0  # shift's length in units of that between two places of the archive


@njit(cache=True, nogil=True)
def turned_place(rng, places, periods, old, new):
    """Propose a place w' = (angle, x, y) on the floor below the object: any angle, and offsets not far from its own.

    What is half hidden may be seen to fit at two angles, whose offsets are a little apart. The angle is uniform over
    its period; the shift is the difference of two random places of the archive, times a random factor. Neither looks at
    the present place, the angles' density is constant and a shift is as likely as its opposite (the two places change
    roles): q(w' | w) = q(w | w'). With J = |dw / dphi|, as in `relocate`,
    log ratio = log posterior(new) - log posterior(old) + log J(old) - log J(new) + sum of log |d phi_c' / d phi_c|.
    """
    size = len(old)
    number = len(places) // (size + size * (size + 1) + 1)
    first, second = int(rng.random() * number), int(rng.random() * number)
    factor = FARTHEST * math.exp(rng.random() * math.log(CLOSEST / FARTHEST))
    for i in range(size):
        if periods[i] > 0.0:
            new[i] = rng.random() * periods[i]
        else:
            new[i] = old[i] + factor * (places[i * number + first] - places[i * number + second])
    return 0.0


@kernels.register("turn")
class TurnType(PlacingType):
    """Turn an object to any angle about where it stands, and leave what stands on it where it is."""

    proposal = turned_place
