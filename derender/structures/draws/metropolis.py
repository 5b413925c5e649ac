"""Draws of all free numbers of one structure under the image's likelihood: a compiled adaptive Metropolis walk.

Steps are q' = q + scale F z with z standard normal and F a fixed (D_p, R_p) matrix (`steps.py`). These are symmetric,
so the log acceptance ratio is

    log prior(q') - log prior(q) + temperature * (log likelihood(q') - log likelihood(q)).

Others are made from a normal that resembles the posterior (preconditioned Crank-Nicolson): where u = P (q - center) are
standard normal under it, given the coordinates that stay, u' = sqrt(1 - scale^2) u + scale z and q' = q + F (u' - u).
They leave that normal as it is, so the ratio has |u'|^2 / 2 - |u|^2 / 2 besides. Scales, factors and centers are learnt
in the warm-up and fixed afterwards.
"""

import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import address_of, njit
from derender.compilation.threads import in_threads
from derender.detection.solids.beliefs import log_prior_of
from derender.detection.solids.image import ROW
from derender.render.raycast.engine import (
    Views,
    change_blur,
    engine_of_view,
    make_views,
    propose_views,
    rescore_state,
    settle_views,
)
from derender.render.raycast.evaluator import engine_under
from derender.render.raycast.state import CANDIDATE, CURRENT, EngineState
from derender.sampling.diagnostics import far_apart
from derender.sampling.evidence import Evidence, evidence
from derender.sampling.metropolis import DENSITY, PRIOR, Steps, mean_scale, walk
from derender.scene.pose import copy_placed
from derender.scene.solids import PLANE, Solids
from derender.structures.draws.chart import (
    FLOOR_WAYS,
    Chart,
    camera_poses,
    log_prior,
    log_prior_about,
    place_rows,
    placed,
    rows_at,
)
from derender.structures.draws.curvature import Curvature
from derender.structures.draws.sensor import Sensor, blurs_about
from derender.structures.draws.steps import (
    FACTOR,
    FIRST,
    PULL,
    RANK,
    Proposals,
    adapted,
    block_steps,
    inverse_of,
    joined,
    make_proposals,
    single_steps,
    touched_by,
    unseen_steps,
)

# Some steps along one direction are up to exp(WIDEST) times as long: a hidden side is as wide as its prior.
WIDE_SHARE, WIDEST = 0.15, 4.0
# The warm-up: temperature and steps for each coordinate in each round, and steps in which only scales are learnt.
ROUNDS, LAST, APART = ((0.1, 10), (1.0, 20), (1.0, 40), (1.0, 60)), 20, 10
COLD = (1.0, 3.0, 10.0)  # what the likelihood is raised to on the way to a mode, at the end
SINGLES, NARROW = 0.3, 2e-4  # weight of the steps along one direction, and metres of the first ones
LONGER = 2  # times that draws may go on for as long again where the chains do not agree
MANY = 50  # coordinates from which on that may be done once more
TRUSTED = 3  # draws for each coordinate that the covariance at the beginning is worth
# Metres behind the camera where a solid is not seen; nats by which images that are the same differ, by rounding.
OUT_OF_SIGHT, SAME = 1e3, 1e-4
BLURRINGS = 20  # times in a chain that its views' blurs are drawn anew, where they are open
AT_ONCE = 200_000  # steps of a chain, some seconds, between which it can be interrupted, or ends as its time is over


class Target(NamedTuple):
    """What a walk of charts is on, and what it writes into. N solids, D coordinates.

    views : Views of the floor (solid 0) and the solids, at `now` (D + 2,): coordinates, log prior, log likelihood.
    rows, trial_rows : (N, ROW), of the solids as they are and as they are tried.
    poses, sizes, indices : (1 + N, 4, 4), (1 + N, 3), (1 + N,) int64, of those that move and of the floor.
    trial : (D + 2,), tried in place of `now`. normal : (D,), normal numbers.
    """

    views: Views
    chart: Chart
    proposals: Proposals
    now: np.ndarray
    rows: np.ndarray
    trial_rows: np.ndarray
    poses: np.ndarray
    sizes: np.ndarray
    indices: np.ndarray
    trial: np.ndarray
    normal: np.ndarray


def target_of(walker: "Walker", proposals: Proposals) -> Target:
    """Return the Target of a walk from where a Walker is."""
    chart, now = walker.chart, np.append(walker.values, walker.densities)
    count, rows = len(chart.flags) + 1, rows_at(chart, walker.values)
    poses, sizes, indices = np.empty((count, 4, 4)), np.empty((count, 3)), np.empty(count, np.int64)
    return Target(walker.engine, chart, proposals, now, rows, rows.copy(), poses, sizes, indices, now.copy(),
                  np.empty(len(now) - 2))  # fmt: skip


@njit(cache=True, nogil=True, borrows=True)
def propose(rng, proposals, p, scale, values, normal, trial):
    """Write coordinates (D,) after step p; return the log of how much likelier they are under the normal that a step
    with a pull leaves as it is, 0 for others. normal : (>= R_p,), scratch."""
    first, end = proposals.table[FIRST, p], proposals.table[FIRST, p + 1]
    start, rank, pull = proposals.table[FACTOR, p], proposals.table[RANK, p], proposals.table[PULL, p]
    reach, drawn = scale, 0.0
    if pull < 0 and rank == 1 and rng.random() < WIDE_SHARE:
        reach *= np.exp(WIDEST * rng.random())
    for r in range(rank):
        normal[r] = reach * rng.standard_normal()
        if pull >= 0:
            here = 0.0
            for i in range(len(values)):
                here += proposals.pulls[pull + r, i] * (values[i] - proposals.center[i])
            normal[r] -= (1.0 - np.sqrt(1.0 - reach * reach)) * here
            drawn += 0.5 * (here * here - (here + normal[r]) ** 2)
    for i in range(len(values)):
        trial[i] = values[i]
    for i in range(end - first):
        for r in range(rank):
            trial[proposals.members[first + i]] += proposals.factors[start + i * rank + r] * normal[r]
    return drawn


@njit(cache=True, nogil=True, borrows=True)
def attempt(rng, target, p, scale, temperature):
    """Return the log ratio of step p on a Target (sampling/metropolis.py); `settle` it then."""
    views, chart, proposals, now, rows, trial_rows, poses, sizes, indices, trial, normal = target
    prior, likelihood, touched = now[PRIOR], now[DENSITY], proposals.touched[p]
    drawn = propose(rng, proposals, p, scale, now[:PRIOR], normal, trial)
    place_rows(chart, trial, trial_rows)
    new_prior = prior
    if prior == -np.inf:
        new_prior = log_prior(chart, trial_rows)
    elif proposals.members[proposals.table[FIRST, p]] < len(now) - 2 - FLOOR_WAYS:
        # over a floor that moves solids stay where they are
        new_prior += log_prior_about(chart, trial_rows, touched) - log_prior_about(chart, rows, touched)
    trial[PRIOR] = new_prior
    if new_prior == -np.inf:
        return -np.inf
    camera_poses(chart, trial[:PRIOR], trial_rows, poses, sizes)
    moved = take_moved(touched, poses, sizes, indices)
    new = propose_views(views, moved, indices, poses, sizes)
    trial[DENSITY] = new
    return new_prior - prior + temperature * (new - likelihood) - drawn


@njit(cache=True, nogil=True, borrows=True)
def settle(target, accepted):
    """Make what was tried of a Target what there is, or forget it."""
    if target.trial[PRIOR] == -np.inf:
        return
    settle_views(target.views, CANDIDATE if accepted else CURRENT)
    if accepted:
        for i in range(len(target.now)):
            target.now[i] = target.trial[i]
        for k in range(len(target.rows)):
            for i in range(ROW):
                target.rows[k, i] = target.trial_rows[k, i]


@njit(cache=True, nogil=True, borrows=True)
def take_moved(touched, poses, sizes, indices):
    """Bring the poses and sizes of what moves to the front, write which solids these are, and return how many."""
    moved = np.int64(0)  # no literal: the engine would be compiled for it a second time
    for k in range(len(touched)):
        if touched[k]:
            indices[moved] = k
            copy_placed(poses[k], sizes[k], poses[moved], sizes[moved])
            moved += 1
    return moved


@njit(cache=True, nogil=True)
def evaluate(views, chart, batch, touched, densities):
    """Write the log prior and the log likelihood of coordinates (m, D) into densities (m, 2).
    touched : (1 + N,) bool, which of the floor and the solids are elsewhere than in `views`."""
    count = len(chart.flags)
    rows, indices = np.empty((count, ROW)), np.empty(count + 1, np.int64)
    poses, sizes = np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
    for n in range(len(batch)):
        place_rows(chart, batch[n], rows)
        densities[n, 0], densities[n, 1] = log_prior(chart, rows), 0.0
        if densities[n, 0] > -np.inf:
            camera_poses(chart, batch[n], rows, poses, sizes)
            moved = take_moved(touched, poses, sizes, indices)
            densities[n, 1] = propose_views(views, moved, indices, poses, sizes)
            settle_views(views, CURRENT)


def load(views: Views, chart: Chart, values: np.ndarray) -> tuple[float, float]:
    """Bring Views to a chart's coordinates; return log prior and log likelihood there."""
    rows, poses, sizes = placed(chart, values)
    likelihood = propose_views(views, len(poses), np.arange(len(poses)), poses, sizes)
    settle_views(views, CANDIDATE)
    return float(log_prior(chart, rows)), float(likelihood)


def likelihood_without(views: Views, chart: Chart, values: np.ndarray, k: int) -> float:
    """Return the log likelihood at a chart's coordinates were solid k not there; Views are left without it."""
    _, poses, sizes = placed(chart, values)
    poses[k + 1, :3, 3] = 0.0, 0.0, -OUT_OF_SIGHT
    likelihood = propose_views(views, len(poses), np.arange(len(poses)), poses, sizes)
    settle_views(views, CANDIDATE)
    return float(likelihood)


def engine_of(chart: Chart, sensor: Sensor) -> Views:
    """Return the Views of a chart's solids under a Sensor, none drawn yet: the floor counts as seen in all of the
    image, so that the first proposal draws every pixel, and `load_state`, which is dear to compile, is not needed."""
    kinds = np.array([PLANE, *chart.flags[:, 0]], np.int32)
    count = len(kinds)
    solids = Solids(kinds, np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 3)), np.full(count, -1, np.int32), ())
    states = []
    for view in sensor.views:
        state = engine_under(view.likelihood, view.values, view.camera, view.observed, solids, view.beside)
        state.rectangle[:, 0] = 0, view.camera.width, 0, view.camera.height
        states.append(state)
    return make_views(states, np.array([view.into for view in sensor.views]))


class Draws(NamedTuple):
    """values : (n, D); densities : (n, 2), log prior and log likelihood; accepted : share of the steps."""

    values: np.ndarray
    densities: np.ndarray
    accepted: float


class Walker(NamedTuple):
    """Where a walk is: Views of a Chart's solids, coordinates (D,), and (2,) log prior and log likelihood there.
    A walk changes all but the Chart in place."""

    engine: Views
    chart: Chart
    values: np.ndarray
    densities: np.ndarray


def walker_at(engine: Views, chart: Chart, values: np.ndarray) -> Walker:
    """Return the Walker at a chart's coordinates, to which Views are brought."""
    return Walker(engine, chart, values, np.array(load(engine, chart, values)))


def run(rng: np.random.Generator, walker: Walker, proposals: Proposals, temperature: float, gain: float, count: int,
        thin: int) -> Draws:  # fmt: skip
    """Return the Draws of a walk of count * thin steps; the Walker and, with a gain, the scales change in place."""
    target = target_of(walker, proposals)
    calls = np.array([address_of(attempt, rng, target, np.int64(0), 1.0, 1.0), address_of(settle, target, True)])
    most = np.where(proposals.table[PULL, :-1] >= 0, 1.0, np.inf)
    steps = Steps(proposals.cumulative, proposals.scale, proposals.wanted, most)
    kept, counts = np.empty((count, len(target.now))), np.zeros((len(most), 2), np.int64)
    walk(rng, calls, target, steps, target.now, float(temperature), float(gain), 0, thin, kept, counts)
    walker.values[:], walker.densities[:] = target.now[:PRIOR], target.now[PRIOR:]
    return Draws(kept[:, :PRIOR].copy(), kept[:, PRIOR:].copy(), float(counts[:, 1].sum()) / max(count * thin, 1))


def ascend(rng: np.random.Generator, engine: Views, chart: Chart, sensor: Sensor, values: np.ndarray,
           only: list[int] | None, temperatures: tuple[float, ...], steps: int,
           least: float = -np.inf) -> tuple[np.ndarray, float, float]:  # fmt: skip
    """Return the best place (D,) found from `values`, which is changed, and its log prior and log likelihood.

    The likelihood is let in by and by, then weighs more and more, so that the walk comes to rest at the mode.

    only : coordinates that may move, None for all. temperatures : below 1, of the likelihood. steps : at each.
    least : log density that an end has to have: a walk that comes less than halfway there at a temperature ends.
    """
    members, missing = list(range(len(values)) if only is None else only), np.inf
    walker = walker_at(engine, chart, values)
    prior, likelihood = walker.densities.tolist()
    found = [(values.copy(), prior, likelihood)]
    singles, blocks, count = single_steps(chart, only), None, max(steps // APART, 1)
    for temperature in (*temperatures, *COLD):
        moves = singles
        if temperature >= 1.0:
            if blocks is None:
                spread = inverse_of(Curvature(engine, chart, sensor, values).precision(members))
                blocks = make_proposals(block_steps(chart, spread, only))
            moves = joined(singles, blocks._replace(factors=blocks.factors / np.sqrt(temperature)))
        moves, (draws,) = stretch(rng, [walker], moves, temperature, 0.1, count, APART)
        singles = adapted(singles, moves)
        if temperature < 1.0:
            before, missing = missing, least - float(draws.densities.sum(axis=1).max())
            if missing > max(0.5 * before, 0.0):
                break
        else:
            best = int(np.argmax(draws.densities.sum(axis=1)))
            found.append((draws.values[best], *map(float, draws.densities[best])))
            if best + 1 < count:
                values[:] = draws.values[best]
                walker.densities[:] = load(engine, chart, values)
    return max([*found, (values, *walker.densities.tolist())], key=lambda each: each[1] + each[2])


def sample(rng: np.random.Generator, chart: Chart, sensor: Sensor, values: np.ndarray, chains: int, count: int,
           thin: int, only: list[int] | None = None, open_blur: bool = False,
           until: float | None = None, rounds: tuple = (),
           agreed: Callable[[list[Draws]], bool] = lambda drawn: True) -> list[Draws]:  # fmt: skip
    """Return the Draws of chains from `values` (D,): a warm-up with adaptation, then `count` draws `thin` steps apart.

    The steps' covariance is that of a normal about `values` (`curvature.py`), and later of what all chains have met; at
    first several walk under a tempered likelihood. Draws about what the image does not hold are twice as far apart, and
    chains that do not agree go on for as long again, unless they are far from it.

    only : coordinates that may move, None for all. open_blur : whether each view's blur is drawn too; a draw's density
        is under its own then.
    until : time.monotonic() by which chains that do not agree have gone on, and many draws end; None: while it is worth
        it, and all are made.
    rounds : of the warm-up, other than ROUNDS. agreed : whether chains do, by their Draws.
    """
    members = list(range(len(values)) if only is None else only)
    walkers = [walker_at(engine_of(chart, sensor), chart, values.copy()) for _ in range(chains)]
    blurs = [blurs_about(view, view.clean(chart, values)) if open_blur else () for view in sensor.views]
    spread = inverse_of(Curvature(walkers[0].engine, chart, sensor, values).precision(members))
    factor = np.linalg.cholesky(spread)
    singles = single_steps(chart, only)
    singles = singles._replace(cumulative=SINGLES * singles.cumulative, scale=np.full_like(singles.scale, NARROW))
    if unseen := unseen_steps(chart, sensor, only):
        singles = joined(singles, make_proposals(unseen))
    met, center = np.empty((0, len(members))), values.copy()
    for temperature, length in rounds or ROUNDS[chains == 1 :]:
        steps = joined(singles, make_proposals(block_steps(chart, spread / temperature, only, center=center)))
        steps, drawn = stretch(rng, walkers, steps, temperature, 0.1, max(length * len(members) // APART, 4), APART)
        singles = adapted(singles, steps)
        if temperature == 1.0:
            met = np.concatenate([met, *(draws.values[:, members] for draws in drawn)])
            spread, center[members] = spread_of(met, factor), met.mean(axis=0)
    former: list[Draws] = []
    began = time.monotonic()
    for number in itertools.count():
        blocks = make_proposals(block_steps(chart, spread, only, center=center.copy()))
        steps = joined(singles, blocks)
        steps, _ = stretch(rng, walkers, steps, 1.0, 0.05, max(LAST * len(members) // APART, 4), APART)
        if not former:
            thin += int(thin * np.mean(blocks.table[PULL, :-1] < 0))
        drawn = final_draws(rng, walkers, steps, count, thin, sensor, blurs, until)
        if former:
            drawn, thin = [every_other(*both) for both in zip(former, drawn, strict=True)], 2 * thin
        if until is None:
            values_drawn = np.stack([each.values[:, members] for each in drawn])
            over = number == LONGER + (len(members) > MANY) or bool(former and far_apart(values_drawn))
        else:
            over = 2.0 * time.monotonic() - began > until  # going on takes as long as all that was drawn
        if over or agreed(drawn):
            break
        met = np.concatenate([draws.values[:, members] for draws in drawn])
        spread, center[members] = spread_of(met, factor), met.mean(axis=0)
        former, singles = drawn, adapted(singles, steps)
        walkers = [walker_at(walker.engine, chart, walker.values) for walker in walkers]  # under their own blur again
    return drawn


def final_draws(rng: np.random.Generator, walkers: list[Walker], steps: Proposals, count: int, thin: int,
                sensor: Sensor, blurs: Any, until: float | None) -> list[Draws]:  # fmt: skip
    """Return the Draws of Walkers, `thin` steps apart, their steps as they are.
    blurs : for each view those that are drawn, given the scene, now and then between the steps; none: its own holds.
    until : see `sample`."""
    pieces: list[list[Draws]] = []
    proposals = [steps] * len(walkers)
    ways = blurrings(walkers[0].engine, sensor, blurs)
    for length in lengths(count, thin, BLURRINGS if any(ways) else 1):
        if pieces and until is not None and time.monotonic() > until:
            break
        walkers = [with_blurs_drawn(rng, walker, ways) for walker in walkers]
        pieces.append(side_by_side(rng, walkers, proposals, 1.0, 0.0, length, thin))
    joined = [tuple(np.concatenate(arrays) for arrays in zip(*[each[:2] for each in chain], strict=True))
              for chain in zip(*pieces, strict=True)]  # fmt: skip
    accepted = np.mean([[each.accepted for each in piece] for piece in pieces], axis=0)
    return [Draws(values, densities, float(share))
            for (values, densities), share in zip(joined, accepted, strict=True)]  # fmt: skip


def lengths(count: int, thin: int, pieces: int) -> list[int]:
    """Return how many draws each of at least so many pieces of a chain of `count` has."""
    pieces = min(max(pieces, -(-count * thin // AT_ONCE)), count)
    return [len(piece) for piece in np.array_split(np.arange(count), pieces)]


class Blurring(NamedTuple):
    """One of the blurs that a view may have."""

    settings: np.ndarray  # as an EngineState has them: they name the kernel for so many taps
    taps: np.ndarray
    log_prior: float


def blurrings(views: Views, sensor: Sensor, blurs: Any) -> list[list[Blurring]]:
    """Return for each view the Blurrings with those of its `blurs` (V, n)."""
    found = []
    for number, (view, some) in enumerate(zip(sensor.views, blurs, strict=True)):
        engine = engine_of_view(views, number)
        found.append([Blurring(*_blurred(engine, each), log_prior_of(view.prior, {"blur": float(each)}))
                      for each in some])  # fmt: skip
    return found


def _blurred(engine: EngineState, blurred: float) -> tuple[np.ndarray, np.ndarray]:
    """Return settings and taps of an engine with another blur, which it shares with none."""
    other = engine._replace(settings=engine.settings.copy(), taps=engine.taps.copy())
    change_blur(other, blurred)
    return other.settings, other.taps


def with_blurs_drawn(rng: np.random.Generator, walker: Walker, ways: list[list[Blurring]]) -> Walker:
    """Return the Walker with each view's blur drawn from its Blurrings, given the scene that it holds and the prior."""
    if not any(ways):
        return walker
    states, likelihood = [], 0.0
    for number, some in enumerate(ways):
        engine = engine_of_view(walker.engine, number)
        trials = [engine._replace(settings=each.settings.copy(), taps=each.taps) for each in some]
        if some:
            logs = [rescore_state(trial) + each.log_prior for trial, each in zip(trials, some, strict=True)]
            engine = trials[rng.choice(len(some), p=np.exp(logs - np.logaddexp.reduce(logs)))]
        likelihood += rescore_state(engine)
        states.append(engine)
    return walker._replace(
        engine=make_views(states, walker.engine.into), densities=np.array([walker.densities[0], likelihood])
    )


def under_blur(views: Views, blurred: float) -> Views:
    """Return the Views of one image with another blur, which share all else with it, at the scene that they hold."""
    engine = engine_of_view(views, 0)
    settings, taps = _blurred(engine, blurred)
    engine = engine._replace(settings=settings, taps=taps)
    rescore_state(engine)
    return make_views([engine], views.into)


def every_other(first: Draws, second: Draws) -> Draws:
    """Return every other one of two Draws of a chain, one after the other."""
    values, densities = (np.concatenate(pair)[1::2] for pair in zip(first[:2], second[:2], strict=True))
    return Draws(values, densities, 0.5 * (first.accepted + second.accepted))


def spread_of(met: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Return the covariance (n, n) that places met (K, n) suggest to whoever believed in factor factor' before."""
    seen = np.linalg.solve(factor, (met - met.mean(axis=0)).T)
    share = len(met) / (len(met) + TRUSTED * len(factor))
    return factor @ (share * (seen @ seen.T / len(met)) + (1.0 - share) * np.eye(len(factor))) @ factor.T


def stretch(rng: np.random.Generator, walkers: list[Walker], steps: Proposals, temperature: float, gain: float,
            count: int, thin: int) -> tuple[Proposals, list[Draws]]:  # fmt: skip
    """Let Walkers take steps beside each other; return the steps as they came to be, and Draws.
    The scales are the geometric means of those to which each walker's adapted."""
    proposals = [steps._replace(scale=steps.scale.copy()) for _ in walkers]
    drawn = side_by_side(rng, walkers, proposals, temperature, gain, count, thin)
    return steps._replace(scale=mean_scale([own.scale for own in proposals])), drawn


def side_by_side(rng: np.random.Generator, walkers: list[Walker], proposals: list[Proposals], temperature: float,
                 gain: float, count: int, thin: int) -> list[Draws]:  # fmt: skip
    """Return the Draws of Walkers, each with its own proposals, which a gain changes."""
    return in_threads(rng, [
        partial(run, walker=walker, proposals=own, temperature=temperature, gain=gain, count=count, thin=thin)
        for walker, own in zip(walkers, proposals, strict=True)
    ])  # fmt: skip


def log_evidence(rng: np.random.Generator, chart: Chart, sensor: Sensor, values: np.ndarray, draws: np.ndarray,
                 members: list[int], shown: int | None = None) -> Evidence:  # fmt: skip
    """Return the Evidence of the density over coordinates `members`, from draws (n, D) of it: see sampling.evidence.

    values : (D,) where the other coordinates are held. shown : the solid whose coordinates the members are, which has
        to show: outside the image and behind others it may be anywhere, and the integral has no end.
    """
    engine, touched = engine_of(chart, sensor), touched_by(chart, members)
    without = np.nan if shown is None else likelihood_without(engine, chart, values, shown)
    load(engine, chart, values)

    def target(points):
        batch, found = np.tile(values, (len(points), 1)), np.empty((len(points), 2))
        batch[:, members] = points
        evaluate(engine, chart, batch, touched, found)
        return np.where(np.abs(found[:, 1] - without) < SAME, -np.inf, found.sum(axis=1))

    return evidence(rng, target, draws[:, members])
