"""The views of a moving camera in all frames of a film together, as each image and how smooth its path is tell them.

One box at rest tells by centimetres and degrees where the camera is; the neighbouring frames, from which the camera
cannot have gone far, tell more. What error is left is nearly the same in many frames on end, and what moves seems to
be faster or slower by it: it is handed on as one Gaussian over all views.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_banded

from derender.scene.pose import from_rotation_vector, inverse, rotation_vector

# How fast a camera in a hand or on an arm moves at first, m / s and rad / s, and its accelerations, m / s^2 and
# rad / s^2: standard deviations. What only the floor holds goes on as it did, within them.
CAMERA_SPEED, CAMERA_CHANGES = (0.25, 0.5), (1.5, 3.0)
# Shares of these accelerations, from a camera on rails to one that is shaken; as likely as each other before a film. It
# may not tell small ones apart, so the mean of their squares is taken: the likeliest alone would be far too sure.
SHAKES = np.geomspace(0.02, 2.0, 9)
# Metres and radians within which the view of the frame that defines the world is known.
DEFINED = (3e-4, 3e-3)
BAND = 18  # rows of a banded precision: an acceleration ties the six numbers of three frames
STEPS = 3  # of Gauss and Newton


class Views(NamedTuple):
    """Views of all frames."""

    views: np.ndarray  # (T, 4, 4), world to camera
    factor: np.ndarray  # (BAND, 6 T), Cholesky factor of the precision of shifts and turns that follow them, lower band
    shake: float  # see SHAKES


def changed(view: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return a view (4, 4) followed by a shift and a turn (6,), camera axes."""
    after = from_rotation_vector(change[3:])
    after[:3, 3] = change[:3]
    return after @ view


def change_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the shift and the turn (6,) that lead from one view (4, 4) to another."""
    jump = second @ inverse(first)
    return np.concatenate([jump[:3, 3], rotation_vector(jump)])


def smooth_path(views: np.ndarray, told: np.ndarray, pulled: np.ndarray, anchor: int, step: float) -> Views:
    """Return the likeliest path by Gauss-Newton steps from `views` (T, 4, 4), T at least 2.

    told : (T, 6, 6) precision of a change of each view given its image. pulled : (T, 6), it times the change that the
    image asks for. anchor : the frame whose view is known, for it defines the world. step : seconds between frames.
    """
    found, off = Views(views, np.zeros((BAND, 0)), 1.0), np.zeros((len(views), 6))
    for _ in range(STEPS):
        found = _stepped(found.views, told, pulled - np.einsum("tij,tj->ti", told, off), off[anchor], anchor, step)
        off = np.array([change_between(*pair) for pair in zip(views, found.views, strict=True)])
    return found


def _stepped(
    views: np.ndarray, told: np.ndarray, pulled: np.ndarray, off: np.ndarray, anchor: int, step: float
) -> Views:
    """Return the likeliest path, linear about `views`; off : (6,) by which the known view
    is off where it is known to be."""
    count, first = len(views), min(anchor, len(views) - 2)
    motions = np.array([change_between(*pair) for pair in zip(views[:-1], views[1:], strict=True)])
    jumps = views[1:] @ inverse(views[:-1])
    earlier, later = np.zeros((2, count - 1, 6, 6))  # derivatives of a motion by the changes of both its views
    earlier[:, :3, :3] = earlier[:, 3:, 3:] = -jumps[:, :3, :3]
    later[:] = np.eye(6)
    later[:, :3, 3:] = np.cross(jumps[:, None, :3, 3], np.eye(3))
    # By how much motions differ from those before, one motion, and the known view: at most three frames each, of which
    # the first is given.
    rows = np.zeros((count, 3, 6, 6))
    rows[: count - 2, 0], rows[: count - 2, 2] = -earlier[:-1], later[1:]
    rows[: count - 2, 1] = earlier[1:] - later[:-1]
    rows[count - 2, :2], rows[count - 1, 0] = (earlier[first], later[first]), np.eye(6)
    frames = np.array([*range(count - 2), first, anchor])
    begun = np.concatenate([np.diff(motions, axis=0), motions[first : first + 1], off[None]])

    def solved(shake: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log evidence of a share of the accelerations, the changes of the views, and the factor."""
        spreads = [shake * step**2 * np.array(CAMERA_CHANGES)] * (count - 2)
        spread = np.repeat([*spreads, np.multiply(CAMERA_SPEED, step), DEFINED], 3, axis=1)  # (T, 6)
        weighted = rows / spread[:, None, :, None]
        blocks, vector = np.zeros((3, count + 2, 6, 6)), np.zeros((count + 2, 6))  # [d, t]: of frames t + d and t
        blocks[0, :count], vector[:count] = told, pulled
        for i in range(3):
            np.add.at(vector, frames + i, -np.einsum("tab,ta->tb", weighted[:, i], begun / spread))
            for j in range(i + 1):
                np.add.at(blocks[i - j], frames + j, np.einsum("tab,tac->tbc", weighted[:, i], weighted[:, j]))
        factor = cholesky_banded(band_of(blocks[:, :count]), lower=True)
        pull = vector[:count].ravel()
        change = cho_solve_banded((factor, True), pull)
        evidence = 0.5 * float(pull @ change - np.sum((begun / spread) ** 2))
        return evidence - float(np.sum(np.log(factor[0])) + np.sum(np.log(spread))), change.reshape(count, 6), factor

    evidence = np.array([solved(shake)[0] for shake in SHAKES])
    shake = float(np.sqrt(np.average(SHAKES**2, weights=np.exp(evidence - evidence.max()))))
    _, change, factor = solved(shake)
    return Views(np.array([changed(*pair) for pair in zip(views, change, strict=True)]), factor, shake)


def band_of(blocks: np.ndarray) -> np.ndarray:
    """Return the lower band (BAND, 6 T) of a symmetric matrix of blocks (3, T, 6, 6), [d, t] those of t + d and t."""
    band = np.zeros((BAND, blocks.shape[1], 6))
    for apart, row, column in np.ndindex(3, 6, 6):
        if 6 * apart + row >= column:
            band[6 * apart + row - column, :, column] += blocks[apart, :, row, column]
    return band.reshape(BAND, -1)


def errors_of(factor: np.ndarray) -> np.ndarray:
    """Return errors (T, 6, 6 T) of views whose precision has this Cholesky factor (BAND, 6 T): times standard normal
    numbers, shifts and turns that follow the views."""
    size = factor.shape[1]
    upper = np.zeros_like(factor)
    for apart in range(BAND):
        upper[BAND - 1 - apart, apart:] = factor[apart, : size - apart]
    return solve_banded((0, BAND - 1), upper, np.eye(size)).reshape(-1, 6, size)
