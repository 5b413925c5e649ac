"""What pairs of bodies do to each other where they touch, from what is said of each: friction, restitution, mass."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from derender.physics.bodies import Body
from derender.scene.friction import OF_BODIES

# Of the heaviest body's mass. A lighter one is taken for so heavy: it bears what stands on it all the same, and the
# engine's rounding does not throw it about.
LEAST_MASS = 1e-4
# The speed, in units of sqrt(s g), at which restitution is calibrated: of a fall from 4.5 times the smallest extent.
CALIBRATION_SPEED = 3.0
# Phases within a step at which a bounce may begin; the calibration is their mean.
PHASES = 8
# Of a bounce: one that has not left the surface after so many steps rests on it.
MOST_STEPS = 200
# Damping per step beyond which a contact would turn the speed round within one.
MOST_DAMPING_PER_STEP = 0.96

# Restitutions at which the damping of a contact is worked out.
BOUNCES = 64


def pair_frictions(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Coulomb coefficients (P,) of pairs that touch: the geometric mean of what the two (P,) say.

    NaN is a body of which nothing is said: it takes the other's, so that a slippery block slips on a floor of which
    nothing is known; OF_BODIES where nothing is said of either.
    """
    mean = np.sqrt(first * second)
    mean = np.where(np.isnan(first), second, np.where(np.isnan(second), first, mean))
    return np.where(np.isnan(mean), OF_BODIES, mean)


def clamped_masses(bodies: Sequence[Body]) -> np.ndarray:
    """Return the masses (N,) of bodies in kg, none below LEAST_MASS of the heaviest; 0 for what does not move."""
    masses = np.array([body.weight_in_kg() if body.moves else 0.0 for body in bodies], dtype=float)
    moves = np.array([body.moves for body in bodies], dtype=bool)
    return np.where(moves, np.maximum(masses, LEAST_MASS * masses.max(initial=0.0)), 0.0)


def restitution_of(damping: np.ndarray | float, frequency: float, step: float) -> np.ndarray:
    """Return which shares (...) of its speed contacts with damping ratios (...) give back, as the engine steps them.

    The contact is a damped spring that cannot pull, under gravity, stepped by semi-implicit Euler; in units of the
    smallest extent s and sqrt(s / g). Mean over the phases within a step at which the bounce begins.
    """
    damping = np.asarray(damping, float)[..., None]
    speed = np.full((*damping.shape[:-1], PHASES), -CALIBRATION_SPEED)
    depth = speed * step * (np.arange(PHASES) + 0.5) / PHASES  # where the first step in contact begins
    for _ in range(MOST_STEPS):
        touching = depth < 0.0
        if not touching.any():
            break
        force = np.maximum(-frequency * (frequency * depth + 2.0 * damping * speed), 0.0)
        speed = np.where(touching, speed + step * (force - 1.0), speed)
        depth = np.where(touching, depth + step * speed, depth)
    return np.mean(np.where(depth >= 0.0, np.maximum(speed, 0.0), 0.0), axis=-1) / CALIBRATION_SPEED


@lru_cache(maxsize=64)
def bounce_table(frequency: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return restitutions, rising, and the damping ratios that give them, (BOUNCES,) each; see `restitution_of`.

    Inference asks for another restitution at each rollout: between these, interpolation errs by less than .001.
    """
    highest = 0.5 * MOST_DAMPING_PER_STEP / (frequency * step)
    damping = highest * np.linspace(1.0, 0.0, BOUNCES) ** 2
    restitution = np.maximum.accumulate(restitution_of(damping, frequency, step))
    return restitution, damping


def bounce_damping(elasticity: float, frequency: float, step: float) -> float:
    """Return the damping ratio of a contact that gives back `elasticity` of the speed; see `restitution_of`."""
    restitution, damping = bounce_table(frequency, step)
    if elasticity <= restitution[0]:
        return float(damping[0])
    return float(np.interp(elasticity, restitution, damping))
