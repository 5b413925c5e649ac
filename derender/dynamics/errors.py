"""How wrong the engine and the tracking are: scales that are learnt with everything else.

Between two frames the engine errs by a share of the impulse that contacts give. An impact's impulse is the change of
velocity beyond what gravity and a contact that rests or slides on the floor explain: more along the floor's normal, or
beyond friction's cone about it, where Coulomb's law leaves nothing but another body. Its error is independent from one
impact to the next, so that after each one the film, not the engine, says where a body goes. What follows an impact is
chaotic (Zhou, Pinto, Gupta 2018: "More than a million ways to be pushed"); here that needs no special case.
"""

from typing import NamedTuple

import numpy as np

# An error that is always there: of the engine's steps, between two frames, m / s.
LEAST_SPEED = 5e-4
# An impact in the engine depends on when within a step it begins, by some hundredths of its speed from one end of the
# step to the other: the standard error, as a share of the change of velocity. And what follows is early or late by a
# share of the contact's time, as its force rises and falls in another way: seconds.
LEAST_IMPACT, LATE = 0.01, 0.001
# The engine slides as if friction were another by this share: boxes that rock as they slide go up to 3 % too far. It
# bounces as if restitution were off by so much: half of the worst that drops leave (scripts/evaluate.py physics).
# Neither averages out.
ENGINE_FRICTION, ENGINE_RESTITUTION = 0.02, 0.015
# A resting or sliding contact changes the velocity by at most so many times gravity's share: friction up to 1.1, or a
# box that rocks as it slides.
STEADY = 1.5
# An impulse at half a cube's side from its centre turns it by 3 / side; the mean over a face is 2 / side.
LEVER = 2.0


class Scales(NamedTuple):
    """Their logarithms are what is learnt; `Prior` says what is believed of them before.

    steady : error of resting and sliding contacts between two frames, as a share of gravity's change of velocity.
    tracking, turning : by how much the stated errors of centres and of turns are to be multiplied.
    """

    impact: float  # error of an impact, as a share of its change of velocity
    steady: float
    tracking: float
    turning: float


def velocity_errors(impulse: np.ndarray, scales: Scales) -> np.ndarray:
    """Return the standard errors (..., N), m / s, of the changes of velocity that contacts give (`Engine.impulses`)."""
    impact = np.hypot(scales.impact, LEAST_IMPACT) * impulse[..., 0]
    return np.hypot(np.hypot(impact, scales.steady * impulse[..., 1]), LEAST_SPEED)
