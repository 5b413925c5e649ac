"""What rests on what in each frame: P(parent) over time, from the gaps between things and how sure those are.

For each thing a hidden Markov chain runs over {nothing, the floor, each other thing}. What stands on something has no
gap to it but for the error of both poses, and keeps it from frame to frame; what hangs in the air or in a hand may be
anywhere. Contact is with what lies below: where lowering the thing by a little would press it in.
"""

import numpy as np
from scipy.special import log_ndtr

from derender.physics.bodies import KIND_NAMES, Body

NOTHING, FLOOR = 0, 1  # columns before those of the things
SLACK = 0.0015  # metres by which a contact may be off besides the poses' errors: sizes, and the sensor's bias
SLACK_AT_REST = 0.004  # metres: what rests stands on something, however wrong its size is
ANYWHERE = 0.15  # metres over which the height of what hangs in the air is uniform
STEADY, UNSTEADY = 0.0012, 0.015  # metres a frame by which a gap changes in contact, and in the air
MOST_TOLD = 6.0  # nats that the change of a gap says at most
CHANGE = 0.04  # probability that what a thing rests on changes between two frames
LOWERED, PRESSED = 0.001, 0.3  # metres, and the share of them that must go into what bears it
NEAR = 0.1  # metres within which one thing may bear another
NO_SUPPORT = -40.0  # log density of standing on what is not below


def gaps_of(poses: np.ndarray, sizes: np.ndarray, kinds: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Return (N, 2 + N) metres between each thing and what may bear it: inf where it lies not below or is not there.

    poses : (N, 4, 4), NaN where not there. sizes : (N, 3). kinds : (N,). floor : (4, 4), z up.
    """
    gaps = np.full((len(poses), 2 + len(poses)), np.inf)
    ground = Body("floor", "plane", np.zeros(3), floor)
    here = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    there = {k: Body("", KIND_NAMES[int(kinds[k])], sizes[k], poses[k]) for k in here}
    for k, body in there.items():
        gaps[k, FLOOR] = body.gap(ground)
        lower = body.pose.copy()
        lower[:3, 3] -= LOWERED * floor[:3, 2]
        for j, other in there.items():
            gap = np.inf if j == k else body.gap(other)
            if gap < NEAR and gap - body._replace(pose=lower).gap(other) > PRESSED * LOWERED:
                gaps[k, 2 + j] = gap
    return gaps


def evidence(gaps: np.ndarray, spread: np.ndarray, resting: np.ndarray) -> np.ndarray:
    """Return (T, N, 2 + N) log densities of the gaps by what each thing rests on.

    gaps : (T, N, 2 + N) metres. spread : (T, N) standard deviation of each thing's height, metres.
    resting : (T, N) bool, what does not move.
    """
    told = np.full(gaps.shape, NO_SUPPORT)
    near = np.isfinite(gaps)
    slack = np.where(resting, SLACK_AT_REST, SLACK)
    sigma = np.sqrt(spread**2 + slack**2)[:, :, None]
    with np.errstate(invalid="ignore"):
        here = -0.5 * (gaps / sigma) ** 2 - np.log(sigma * np.sqrt(2 * np.pi)) + np.log(ANYWHERE)
        here = here - log_ndtr(gaps / sigma)  # in the air it is above: what goes into another is not there either
        change = np.abs(np.diff(gaps, axis=0))
    change = np.where(np.isfinite(change), change, np.inf)
    ends = np.full((1, *gaps.shape[1:]), np.inf)
    steady = np.minimum(np.concatenate([ends, change]), np.concatenate([change, ends]))
    steady = np.where(np.isfinite(steady), steady, STEADY if len(gaps) == 1 else UNSTEADY)
    in_contact, in_the_air = (np.hypot(change, spread)[:, :, None] for change in (STEADY, UNSTEADY))
    kept = 0.5 * (steady / in_the_air) ** 2 - 0.5 * (steady / in_contact) ** 2 + np.log(in_the_air / in_contact)
    here = here + np.clip(kept, -MOST_TOLD, MOST_TOLD)
    told[near] = np.maximum(here[near], NO_SUPPORT)
    told[:, :, NOTHING] = 0.0
    return told


def smoothed(told: np.ndarray) -> np.ndarray:
    """Return (T, M) probabilities of a chain's states given all of its log densities (T, M): forward and backward."""
    frames, states = told.shape
    likelihood = np.exp(told - told.max(axis=1, keepdims=True))
    step = np.full((states, states), CHANGE / max(states - 1, 1))
    np.fill_diagonal(step, 1.0 - CHANGE)
    forward, backward = np.empty((frames, states)), np.ones((frames, states))
    now = np.full(states, 1.0 / states)
    for t in range(frames):
        now = (now if t == 0 else now @ step) * likelihood[t]
        now = now / now.sum()
        forward[t] = now
    for t in range(frames - 2, -1, -1):
        later = step @ (likelihood[t + 1] * backward[t + 1])
        backward[t] = later / later.sum()
    both = forward * backward
    return both / both.sum(axis=1, keepdims=True)


def parent_probabilities(
    poses: np.ndarray,
    covariances: np.ndarray,
    sizes: np.ndarray,
    kinds: np.ndarray,
    floors: np.ndarray,
    resting: np.ndarray,
) -> np.ndarray:
    """Return P(parent) (T, N, 2 + N): nothing, the floor, each thing; NaN where a thing is not there.

    poses : (T, N, 4, 4) to camera, NaN where not there. covariances : (T, N, 6, 6). sizes : (T, N, 3). kinds : (N,).
    floors : (T, 4, 4) to camera, z up. resting : (T, N) bool, what does not move.
    """
    frames, count = poses.shape[:2]
    gaps, spread = np.full((frames, count, 2 + count), np.inf), np.full((frames, count), SLACK)
    for t in range(frames):
        up = floors[t, :3, 2]
        gaps[t] = gaps_of(poses[t], sizes[t], kinds, floors[t])
        for k in range(count):
            if np.isfinite(covariances[t, k]).all():
                spread[t, k] = np.sqrt(max(up @ covariances[t, k, :3, :3] @ up, 0.0))
    told = evidence(gaps, spread, np.asarray(resting))
    chances = np.full((frames, count, 2 + count), np.nan)
    there = np.isfinite(poses[:, :, 0, 0])
    for k in range(count):
        where = np.flatnonzero(there[:, k])
        if len(where):
            chances[where, k] = smoothed(told[where, k])
    return chances
