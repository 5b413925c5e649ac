"""Draws of all free numbers of one structure under the image's likelihood: a compiled adaptive Metropolis walk.

Steps are q' = q + scale F z with z standard normal and F a fixed (D_p, R_p) matrix: one column for the steps in which
a depth image is informative (`chart.directions`), Cholesky factors of the covariance seen so far for one solid, for a
solid with all that it carries, for the floor, and for everything. All are symmetric, so the log acceptance ratio is

    log prior(q') - log prior(q) + temperature * (log likelihood(q') - log likelihood(q)).

Scales and factors are learnt in the warm-up and fixed afterwards.
"""

from typing import NamedTuple

import numpy as np

from derender.inference.structure.chart import FLOOR_WAYS, camera_poses, log_prior, place_rows
from derender.inference.structure.directions import directions
from derender.inference.structure.image import ROW
from derender.kernel_cache import njit
from derender.model.solids import PLANE, Solids
from derender.vision.raycast.engine import for_steps, new_engine, propose_in, propose_state, settle_in, settle_state
from derender.vision.raycast.state import CANDIDATE, CURRENT, DEPTH, GAUSSIAN, PAD, SCORE

FIRST, FACTOR, RANK = range(3)  # rows of Proposals.table
LATTICE = 1e-3  # metres of the first steps
# Some steps along one direction are up to exp(WIDEST) times as long: a hidden side is as wide as its prior.
WIDE_SHARE, WIDEST = 0.15, 4.0


class Proposals(NamedTuple):
    """Steps to choose from. M of them.

    Attributes
    ----------
    table : (3, M + 1) int64: begin of its coordinates, begin of its matrix, number of columns.
    members : flat int64, coordinates. factors : flat float64, matrices row by row.
    touched : (M, 1 + N) bool, whether the floor and each solid move in the camera.
    cumulative : (M,) float64, running sum of the weights.
    scale : (M,) float64; wanted : (M,) float64, the acceptance rate that the warm-up aims at.
    """

    table: np.ndarray
    members: np.ndarray
    factors: np.ndarray
    touched: np.ndarray
    cumulative: np.ndarray
    scale: np.ndarray
    wanted: np.ndarray


@njit(cache=True, nogil=True)
def walk(rng, engine, chart, values, prior, likelihood, proposals, temperature, gain, steps, thin, kept, densities):
    """Take `steps` Metropolis steps from `values` (D,), changed in place; keep every `thin`-th.

    Parameters
    ----------
    engine : EngineState of the floor (solid 0) and the N solids, at `values`.
    prior, likelihood : their logs there.
    temperature : exponent of the likelihood. gain : of the adaptation of proposals.scale; 0: none.
    kept : (steps // thin, D), densities : (steps // thin, 2) float64, log prior and log likelihood; written.

    Returns the number of accepted steps.
    """
    count, size = len(chart.flags), len(values)
    trial_rows = np.empty((count, ROW))
    poses, sizes = np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
    moved_poses, moved_sizes = np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
    indices = np.empty(count + 1, np.int64)
    trial, normal = values.copy(), np.empty(size)
    accepted, number = 0, len(proposals.scale)
    for taken in range(steps):
        threshold = rng.random() * proposals.cumulative[number - 1]
        p = 0  # plain loops here and below: numba takes three seconds for searchsorted and for assigning arrays
        while p < number - 1 and proposals.cumulative[p] < threshold:
            p += 1
        first, end = proposals.table[FIRST, p], proposals.table[FIRST, p + 1]
        start, rank = proposals.table[FACTOR, p], proposals.table[RANK, p]
        reach = proposals.scale[p]
        if rank == 1 and rng.random() < WIDE_SHARE:
            reach *= np.exp(WIDEST * rng.random())
        for r in range(rank):
            normal[r] = reach * rng.standard_normal()
        for i in range(size):
            trial[i] = values[i]
        for i in range(end - first):
            for r in range(rank):
                trial[proposals.members[first + i]] += proposals.factors[start + i * rank + r] * normal[r]
        place_rows(chart, trial, trial_rows)
        new_prior = log_prior(chart, trial_rows)
        taken_up = False
        threshold = np.log(1.0 - rng.random())
        if new_prior > -np.inf:
            camera_poses(chart, trial, trial_rows, poses, sizes)
            moved = np.int64(0)  # no literal: the engine would be compiled for it a second time
            for k in range(count + 1):
                if proposals.touched[p, k]:
                    indices[moved] = k
                    for i in range(4):
                        for j in range(4):
                            moved_poses[moved, i, j] = poses[k, i, j]
                    for i in range(3):
                        moved_sizes[moved, i] = sizes[k, i]
                    moved += 1
            new = propose_in(engine, moved, indices, moved_poses, moved_sizes)
            taken_up = threshold < new_prior - prior + temperature * (new - likelihood)
            settle_in(engine, CANDIDATE if taken_up else CURRENT)
            if taken_up:
                prior, likelihood = new_prior, new
                for i in range(size):
                    values[i] = trial[i]
                accepted += 1
        if gain > 0.0:
            proposals.scale[p] *= np.exp(gain * ((1.0 if taken_up else 0.0) - proposals.wanted[p]))
        if (taken + 1) % thin == 0:
            for i in range(size):
                kept[taken // thin, i] = values[i]
            densities[taken // thin, 0], densities[taken // thin, 1] = prior, likelihood
    return accepted


def load(engine, chart, values):
    """Bring an engine to a chart's coordinates; return log prior and log likelihood there."""
    count = len(chart.flags)
    rows, poses, sizes = np.empty((count, ROW)), np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
    place_rows(chart, values, rows)
    camera_poses(chart, values, rows, poses, sizes)
    likelihood = propose_state(engine, count + 1, np.arange(count + 1), poses, sizes)
    settle_state(engine, CANDIDATE)
    return float(log_prior(chart, rows)), float(likelihood)


def engine_of(chart, sensor):
    """Return an EngineState for a chart's solids under a sensor model (sensor.py), at the empty scene: a bare wall.

    So the first proposal fills it, and `load_state`, which costs as long to compile as all else, is not needed.
    """
    kinds = np.array([PLANE, *chart.flags[:, 0]], np.int32)
    count = len(kinds)
    solids = Solids(kinds, np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 3)), np.full(count, -1, np.int32), ())
    likelihood, observed, wall = sensor.likelihood, sensor.observed, sensor.values["background"]
    row = likelihood.row(sensor.values, likelihood.counted_pixels(observed))
    state = new_engine(sensor.camera, observed, solids, likelihood.code, row, sensor.values["blur"])
    if likelihood.code == GAUSSIAN:
        score = np.where(np.isfinite(observed), (observed - wall) ** 2, 0.0)
    else:
        score = likelihood.per_pixel(observed, np.full(observed.shape, wall), sensor.values)
    state.images[DEPTH:DEPTH + 2] = wall
    state.images[SCORE:SCORE + 2, :, PAD:PAD + observed.shape[1]] = score
    state.total[:] = state.images[SCORE].astype(float).sum()
    return for_steps(state)


def touched_by(chart, members, size):
    """Return (1 + N,) bool: which of the floor and the solids move when these coordinates do."""
    count = len(chart.flags)
    touched = np.zeros(count + 1, bool)
    members = set(int(m) for m in members)
    if any(m >= size - FLOOR_WAYS for m in members):
        touched[:] = True
        return touched
    for k in chart.order:
        parent = chart.flags[k, 2]
        carried = parent >= 0 and touched[parent + 1] and chart.flags[k, 3]
        touched[k + 1] = carried or bool(members & {int(s) for s in chart.slots[k]})
    return touched


def own_members(chart, k):
    """Return the sorted coordinates of a solid."""
    return sorted({int(s) for s in chart.slots[k] if s >= 0})


def blocks_of(chart, size):
    """Return lists of coordinates that move together: each solid, each with all that it carries, floor, everything."""
    count = len(chart.flags)
    own = [own_members(chart, k) for k in range(count)]
    blocks = list(own)
    for k in range(count):
        tree = {k}
        for j in chart.order:
            if int(chart.flags[j, 2]) in tree:
                tree.add(int(j))
        if len(tree) > 1:
            blocks.append(sorted(m for j in tree for m in own[j]))
    floor = list(range(size - FLOOR_WAYS, size))
    blocks.append(floor)
    if count > 1:
        blocks.append(list(range(size)))
    return blocks


class Step(NamedTuple):
    """One of the Proposals: members (D_p,) and matrix (D_p, R_p); touched, weight, scale and wanted as there."""

    members: np.ndarray
    matrix: np.ndarray
    touched: np.ndarray
    weight: float
    scale: float
    wanted: float


def single_steps(chart, size, only=None):
    """Return the Steps along one direction each, of LATTICE metres; only : coordinates that may move, None for all."""
    free = np.isin(np.arange(size), list(range(size) if only is None else only))
    ways = list({v.tobytes(): v for v in directions(chart, size) * free if np.any(v)}.values())
    steps = []
    for vector in ways:
        members = np.flatnonzero(vector)
        steps.append(Step(members, vector[members][:, None], touched_by(chart, members, size), 1.0 / len(ways), LATTICE,
                          0.4))  # fmt: skip
    return steps


def block_steps(chart, covariance, only=None, shrink=5e-5):
    """Return the Steps of coordinates that move together as a covariance (D, D) says.

    shrink : metres added to every spread, so that few draws do not make a factor singular.
    """
    size = len(covariance)
    allowed = set(range(size)) if only is None else set(only)
    blocks = [b for b in ([m for m in block if m in allowed] for block in blocks_of(chart, size)) if b]
    # those that move the floor draw the whole image anew: fewer of them
    weights = [0.4 if max(block) >= size - FLOOR_WAYS else 1.0 for block in blocks]
    steps = []
    for block, share in zip(blocks, weights, strict=True):
        factor = np.linalg.cholesky(covariance[np.ix_(block, block)] + shrink**2 * np.eye(len(block)))
        steps.append(Step(np.array(block), factor, touched_by(chart, block, size), 2.0 * share / sum(weights),
                          1.5 / np.sqrt(len(block)), 0.25))  # fmt: skip
    return steps


def make_proposals(steps):
    """Return the Proposals that choose among Steps."""
    table = np.zeros((3, len(steps) + 1), np.int64)
    for p, step in enumerate(steps):
        table[FIRST, p + 1] = table[FIRST, p] + len(step.members)
        table[FACTOR, p + 1] = table[FACTOR, p] + step.matrix.size
        table[RANK, p] = step.matrix.shape[1]
    return Proposals(
        table=table,
        members=np.concatenate([step.members for step in steps]).astype(np.int64),
        factors=np.concatenate([np.ravel(step.matrix) for step in steps]),
        touched=np.array([step.touched for step in steps]),
        cumulative=np.cumsum([step.weight for step in steps]),
        scale=np.array([step.scale for step in steps]),
        wanted=np.array([step.wanted for step in steps]),
    )


class Draws(NamedTuple):
    """values : (n, D); densities : (n, 2), log prior and log likelihood; accepted : share of the steps."""

    values: np.ndarray
    densities: np.ndarray
    accepted: float


def run(rng, engine, chart, values, proposals, temperature, gain, count, thin):
    """Return the Draws of a walk of count * thin steps; `values` and, with a gain, the scales change in place."""
    kept, densities = np.empty((count, len(values))), np.empty((count, 2))
    prior, likelihood = load(engine, chart, values)
    accepted = walk(rng, engine, chart, values, prior, likelihood, proposals, float(temperature), float(gain),
                    count * thin, thin, kept, densities)  # fmt: skip
    return Draws(kept, densities, accepted / max(count * thin, 1))


def anneal(rng, engine, chart, values, proposals, steps, temperatures=(0.03, 0.1, 0.3, 1.0)):
    """Walk with the likelihood let in by and by; `values` and scales change in place. Returns the last Draws."""
    draws = None
    for temperature in temperatures:
        draws = run(rng, engine, chart, values, proposals, temperature, 0.1, max(steps // 10, 1), 10)
    return draws


def sample(rng, engine, chart, values, count, thin, only=None, warm=None):
    """Return Draws of one chain from `values`: warm-up with adaptation, then `count` draws `thin` steps apart.

    warm : steps in each of the three rounds of the warm-up; each round's covariance shapes the next one's steps.
    """
    values = values.copy()
    warm = max(count * thin // 4, 400) if warm is None else warm
    singles = single_steps(chart, len(values), only)
    proposals = make_proposals(singles)
    run(rng, engine, chart, values, proposals, 1.0, 0.15, max(warm // 10, 20), 10)
    scales = proposals.scale
    for _ in range(3):
        history = run(rng, engine, chart, values, proposals, 1.0, 0.08, max(warm // 10, 20), 10)
        recent = history.values[len(history.values) // 3 :]
        proposals = make_proposals([*singles, *block_steps(chart, np.cov(recent.T), only)])
        proposals.scale[: len(singles)] = scales
    run(rng, engine, chart, values, proposals, 1.0, 0.05, max(warm // 20, 10), 10)
    return run(rng, engine, chart, values, proposals, 1.0, 0.0, count, thin)


def log_evidence(draws, members):
    """Return the log of the integral of the density over coordinates `members`, from draws: the normal with their
    mean and covariance has E[log density] + entropy for it, exact where the posterior is normal."""
    values = draws.values[:, members]
    covariance = np.atleast_2d(np.cov(values.T)) + 1e-14 * np.eye(len(members))
    entropy = 0.5 * np.linalg.slogdet(2.0 * np.pi * np.e * covariance)[1]
    return float(np.mean(draws.densities.sum(axis=1)) + entropy)
