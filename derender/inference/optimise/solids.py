"""Refine the places and sizes of several solids jointly, each held by what it stands on: the work horse of
structure moves.

No scene graph is needed: a solid is *upright* (it slides and turns on the horizontal face of its support, its underside
stays there, and it rises when its support grows) or *free* (six degrees of freedom), and may have fixed or free
extents.
"""

import math
from typing import NamedTuple

import numpy as np

from derender.inference.optimise.domain import Minimum
from derender.model.pose import twist_exp
from derender.model.solids import CYLINDER, PLANE, SPHERE, Solids
from derender.vision.gradient import SmoothLikelihood
from derender.vision.raycast.records import MOTION

HELD, UPRIGHT, FREE = range(3)
SMALLEST = 0.003  # metres: no extent shrinks below


class Refined(NamedTuple):
    """Attributes: solids; cost before and after (minus log likelihood up to the same constant); minimum of the last
    level;
    covariance (P, P) of the parameters, None where the equations are singular."""

    solids: Solids
    cost_before: float
    cost: float
    minimum: Minimum
    covariance: np.ndarray | None


def solid_motions(solids: Solids, form, sized, supports, up) -> np.ndarray:
    """Return (P, N, 9): how the solids move per unit of each parameter.

    form : (N,) HELD, UPRIGHT or FREE. sized : (N,) 0 extents fixed, 1 all extents equal (cube), 2 extents free.
    supports : (N,) index of the solid that each stands on, or -1. up : (3,) unit vector in camera axes.
    """
    count = len(solids.kind)
    up = np.asarray(up, float)
    across = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.7 else [0, 1.0, 0])
    across /= np.linalg.norm(across)
    rows = []
    for k in range(count):
        if form[k] == HELD or solids.kind[k] == PLANE:
            continue
        centre = solids.pose[k, :3, 3]
        turns = [up] if form[k] == UPRIGHT else list(np.eye(3))
        if solids.kind[k] == SPHERE or (
            form[k] == UPRIGHT and solids.kind[k] == CYLINDER and abs(solids.pose[k, :3, 2] @ up) > 0.999
        ):
            turns = []
        for shift in [across, np.cross(up, across)] if form[k] == UPRIGHT else np.eye(3):
            rows.append(np.zeros((count, MOTION)))
            rows[-1][k, :3] = shift
        for turn in turns:
            rows.append(np.zeros((count, MOTION)))
            rows[-1][k, 3:6] = turn
            rows[-1][k, :3] = -np.cross(turn, centre)
        if not sized[k]:
            continue
        if solids.kind[k] == SPHERE or sized[k] == 1:
            growths = [(1.0, 1.0, 1.0)]
        elif solids.kind[k] == CYLINDER:
            growths = [(1.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
        else:
            growths = list(np.eye(3))
        for growth in growths:
            rows.append(np.zeros((count, MOTION)))
            rows[-1][k, 6:] = growth
            if form[k] == UPRIGHT:
                height = _height_rate(solids.kind[k], solids.pose[k], growth, up)
                rows[-1][k, :3] = 0.5 * height * up
                for child in _carried(k, supports, form):
                    rows[-1][child, :3] = height * up
    return np.array(rows).reshape(len(rows), count, MOTION)


def _height_rate(kind, pose, growth, up) -> float:
    """How fast the vertical extent grows with the extents."""
    along = np.abs(up @ pose[:3, :3])
    if kind == SPHERE:
        return growth[0]
    if kind == CYLINDER:
        return math.sqrt(max(1.0 - along[2] ** 2, 0.0)) * growth[0] + along[2] * growth[2]
    return float(along @ np.asarray(growth))


def _carried(k, supports, form) -> list[int]:
    """The upright solids that stand on k, directly or not."""
    found, queue = [], [k]
    while queue:
        below = queue.pop()
        for child in range(len(supports)):
            if supports[child] == below and form[child] == UPRIGHT and child not in found and child != k:
                found.append(child)
                queue.append(child)
    return found


def move_solids(solids: Solids, motions: np.ndarray, step: np.ndarray) -> Solids:
    """Return the solids after a step (P,) along the motions (P, N, 9), each by the exponential of its summed twist."""
    total = np.tensordot(step, motions, axes=1)
    pose = solids.pose.copy()
    for k in np.flatnonzero(np.any(total[:, :6] != 0.0, axis=1)):
        pose[k] = twist_exp(total[k, :3], total[k, 3:6]) @ pose[k]
    return solids._replace(
        pose=pose, size=np.where(solids.size > 0, np.maximum(solids.size + total[:, 6:], SMALLEST), 0)
    )


def refine_solids(
    solids: Solids, camera, observed, *, form, sized, supports, up, sigma=0.005, blur_sigma=0.0, background=10.0,
    limit=8.0, levels=((1.5, 3.0), (0.5, 1.0)), iterations=8, tolerance=0.5, prior=None, likelihoods=None,
) -> Refined:  # fmt: skip
    """Improve poses and sizes of the solids jointly against one depth image.

    Parameters
    ----------
    solids, form, sized, supports, up : see `solid_motions`. observed : (H, W) metres, NaN or 0 missing.
    sigma : metres, number or (H, W). blur_sigma : of the likelihood. limit : nats at which a pixel is an outlier.
    levels : (extra blur in pixels, factor on sigma) of each pass, coarse to fine. iterations : tried steps per level.
    tolerance : nats. prior : None, or (mean, precision) of the logarithm of the extents.
    likelihoods : what `level_likelihoods` returned, to share between calls on one image (same kinds).
    """
    motions = solid_motions(solids, form, sized, supports, up)
    if likelihoods is None:
        likelihoods = level_likelihoods(
            camera, observed, solids.kind, len(motions), sigma, blur_sigma, background, limit, levels
        )
    cost_before = likelihoods[-1].cost(solids.pose, solids.size)
    start = solids
    for likelihood in likelihoods:
        solids, minimum = _descend(likelihood, solids, (form, sized, supports, up), iterations, tolerance, prior)
    cost = likelihoods[-1].cost(solids.pose, solids.size)
    if cost > cost_before:
        solids, cost = start, cost_before
    try:
        covariance = np.linalg.inv(minimum.hessian) if len(minimum.hessian) else None
    except np.linalg.LinAlgError:
        covariance = None
    return Refined(solids, cost_before, cost, minimum, covariance)


def level_likelihoods(
    camera,
    observed,
    kinds,
    parameters,
    sigma=0.005,
    blur_sigma=0.0,
    background=10.0,
    limit=8.0,
    levels=((1.5, 3.0), (0.5, 1.0)),
) -> list[SmoothLikelihood]:
    """Return the likelihoods of a coarse-to-fine schedule, to be reused for scenes with the same kinds of solids."""
    return [
        SmoothLikelihood(
            camera, observed, kinds, np.asarray(sigma, float) * factor, blur_sigma, background, extra, limit, parameters
        )
        for extra, factor in levels
    ]


def _size_prior(solids, prior, motions):
    """Cost, gradient and Hessian of independent normals on the logarithms of the extents of the solids that can
    grow."""
    mean, precision = prior
    grows = np.any(motions[:, :, 6:] != 0.0, axis=0) & (solids.size > 0)
    size = np.where(grows, solids.size, 1.0)
    away = np.where(grows, np.log(size) - mean, 0.0)
    rates = np.where(grows, motions[:, :, 6:] / size, 0.0).reshape(len(motions), -1)
    return 0.5 * precision * float((away**2).sum()), precision * rates @ away.ravel(), precision * rates @ rates.T


def _descend(likelihood, solids, ties, iterations, tolerance, prior):
    """Levenberg-Marquardt on motions, which are taken anew at every accepted state."""
    form, sized, supports, up = ties

    def equations(at):
        motions = solid_motions(at, form, sized, supports, up)
        value, gradient, hessian = likelihood.equations(at.pose, at.size, motions)
        if prior is not None:
            more = _size_prior(at, prior, motions)
            value, gradient, hessian = value + more[0], gradient + more[1], hessian + more[2]
        return motions, value, gradient, hessian

    motions, value, gradient, hessian = equations(solids)
    costs, damping, steps = [value], 1e-3, 0
    while steps < iterations and len(motions):
        diagonal = np.diag(hessian)
        floor = 1e-6 * diagonal.max() + 1e-12
        step = -np.linalg.solve(hessian + np.diag(damping * np.maximum(diagonal, floor) + floor), gradient)
        foreseen = -(gradient @ step + 0.5 * step @ hessian @ step)
        trial = move_solids(solids, motions, step)
        steps += 1
        trial_value = likelihood.cost(trial.pose, trial.size)
        if prior is not None:
            trial_value += _size_prior(trial, prior, motions)[0]
        if trial_value < value:
            gained = value - trial_value
            solids = trial
            costs.append(trial_value)
            damping = max(damping * (0.1 if gained > 0.5 * foreseen else 0.5), 1e-6)
            if gained < tolerance or steps == iterations:
                break
            motions, value, gradient, hessian = equations(solids)
        else:
            if foreseen < tolerance or damping > 1e5:
                break
            damping = max(damping * 8.0, 1e-2)
    return solids, Minimum(np.zeros(len(motions)), costs[-1], gradient, hessian, tuple(costs), steps)
