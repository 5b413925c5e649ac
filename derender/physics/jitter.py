"""Perceptual noise: where bodies are, as somebody sees them who knows that solids do not enter each other."""

import numpy as np

from derender.physics.bodies import Body, Matter
from derender.physics.statics import deep_overlaps, find_contacts
from derender.scene.pose import moved

TRIES = 10  # of all bodies at once, before they are drawn one by one
SWEEPS, TRIES_EACH = 5, 30  # through the bodies, and draws of one of them before it stays where it is


def jittered(matter: Matter, spread: tuple[float, float], rng: np.random.Generator) -> Matter:
    """Return a scene whose moving bodies are displaced and turned by normal noise, given that none enters another.

    Those that enter each other deep (`deep_overlaps`) as they are given may go on doing so. Where all at once are
    drawn in vain they are drawn in turn, each given the others (Gibbs sampling), from where they were: a tower of ten
    meets the condition once in thousands of draws.

    spread : (metres, radians) of each axis.
    """
    deviations = np.repeat(spread, 3)
    allowed = pairs_entered(matter)

    def noisy(body: Body) -> Body:
        return body._replace(pose=moved(body.pose, deviations * rng.normal(size=6))) if body.moves else body

    def possible(bodies: list[Body]) -> bool:
        return pairs_entered(matter._replace(bodies=tuple(bodies))) <= allowed

    for _ in range(TRIES):
        drawn = [noisy(body) for body in matter.bodies]
        if possible(drawn):
            return matter._replace(bodies=tuple(drawn))
    bodies = list(matter.bodies)
    for _ in range(SWEEPS):
        for k, seen in enumerate(matter.bodies):
            for _ in range(TRIES_EACH if seen.moves else 0):
                drawn = [*bodies[:k], noisy(seen), *bodies[k + 1 :]]
                if possible(drawn):
                    bodies = drawn
                    break
    return matter._replace(bodies=tuple(bodies))


def pairs_entered(matter: Matter) -> set[tuple[str, str]]:
    """Return the names of the pairs of solids that enter each other deep."""
    return {(pair.first, pair.second) for pair in deep_overlaps(matter, find_contacts(matter))}
