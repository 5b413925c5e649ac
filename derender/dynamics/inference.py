"""The posterior over the material: modes from several starts, then importance sampling about them."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.special import logsumexp

from derender.compilation.threads import run_together
from derender.dynamics.engine import Engine, Scales
from derender.dynamics.motion import Motion
from derender.dynamics.parameters import ALWAYS, Parameters, Prior, read_dynamics_prior
from derender.dynamics.shooting import Doubts, Errors, Path, Shooting
from derender.physics.mujoco_model import Diverged
from derender.posterior.sampler import next_temperature, systematic
from derender.sampling.evidence import draw_t, log_t

# Where Levenberg-Marquardt may start: films of these frictions are held against the tracked poses, and it starts from
# the nearest few.
FRICTIONS, STARTS = (0.1, 0.2, 0.35, 0.6, 0.9), 3
# Where something may be struck: restitutions (with one alone, what is struck seems heavier or rougher), and contact
# times (seconds), tried with those that are near: of all four there are too many.
RESTITUTIONS, CONTACT_TIMES = (0.1, 0.35, 0.55, 0.75), (0.002, 0.006)
# Metres, and metres a second after an impact, to which those films can tell: far beyond it another start is no worse.
NEAR, NEAR_SPEED = 0.02, 0.2
# A start's first steps, after which the worse ones are given up, and the best one's further steps.
SHORT, LONG = 3, 8
# How far below the best, in nats, a start may lie and still be followed.
CLOSE = 10.0
# From the best mode films of other frictions are fitted, by steps in its logarithm, until one is CLOSE no more or so
# many steps from the best. A film that tells little of friction is linear in it for one such step.
RUNG, MOST_RUNGS = 0.15, 3
# Before the scales are learnt, engine and tracking are given much room: first velocities are poor.
FIRST = Scales(0.3, 0.05, 4.0, 4.0)
# The step in a scale's logarithm at which its density's curvature is measured.
CURVED = 0.2
# No step improves the cost by this many nats: done.
DONE = 0.05
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e-3, 1e6
# Importance sampling: the least and the most rounds, draws of each, how many equally weighted draws are enough, the
# share of draws from the prior (where the motion tells nothing), and the proposal's degrees of freedom and widening.
# Then the share of their number that weighted draws are made to be worth at least, and how many draws are kept.
ROUNDS, MOST_ROUNDS, DRAWS, ENOUGH, FROM_PRIOR, FREEDOM, WIDER = 2, 4, 80, 50.0, 0.15, 5.0, 1.2
FEWEST = 0.1
KEPT = 1000
# The power of the likelihood below which what it says of impacts is chaos: draws then lie ten nats apart by chance, and
# where a film fits by luck is where the numbers would be told.
CHAOTIC = 0.15

# Of a proposal: a t's centre (D,) and the Cholesky factor (D, D) of its scale.
Component = tuple[np.ndarray, np.ndarray]


class Mode(NamedTuple):
    """A local maximum."""

    path: Path  # states, offsets and coordinates there
    by_pose: np.ndarray  # derivatives about it, as `Shooting.derivatives` gives them
    by_defect: np.ndarray
    doubts: Doubts
    scales: Scales  # learnt there
    uncertain: np.ndarray  # (4,) standard errors of their logarithms
    log_marginal: float  # with all unknowns integrated out, linear about this mode
    covariance: np.ndarray  # (Z, Z) of all unknowns: changes at the cuts, offsets, coordinates
    first: np.ndarray  # (12 N, 12 N), covariance of the states in the first frame

    @property
    def follow(self) -> np.ndarray:
        """(Z - P, P), by how much the likeliest changes at the cuts and offsets change with the coordinates."""
        size = len(self.covariance) - len(self.path.coordinates)
        return self.covariance[:size, size:] @ np.linalg.inv(self.covariance[size:, size:])


class Draws(NamedTuple):
    """Weighted draws of coordinates and scales."""

    coordinates: np.ndarray  # (K, P)
    logarithms: np.ndarray  # (K, S), of the scales
    log_weights: np.ndarray  # (K,), normalised
    power: float = 1.0  # to which the likelihood was raised, for it is that rugged

    @property
    def effective(self) -> float:
        """How many equally weighted draws these are worth."""
        return float(np.exp(-logsumexp(2 * self.log_weights)))

    def resampled(self, rng: np.random.Generator, count: int = KEPT) -> tuple[np.ndarray, np.ndarray]:
        """Return coordinates (count, P) and scales' logarithms (count, S), by systematic resampling in random order."""
        at = rng.permutation(systematic(rng, np.exp(self.log_weights), count))
        return self.coordinates[at], self.logarithms[at]


def climb(
    shooting: Shooting, path: Path, scales: Scales, steps: int, doubts: Doubts | None = None, held: bool = False
) -> Path:
    """Return a path nearer to the least squares: Levenberg-Marquardt, with the errors of each step's path.

    held : whether the material stays as it is.
    """
    damping = FIRST_DAMPING
    for _ in range(steps):
        errors = shooting.errors(path, scales, doubts)
        jacobian = shooting.whitened(errors, *shooting.derivatives(path, 1))
        residual = shooting.residuals(path, errors)
        own, roots = shooting.prior_rows(path)
        hessian = jacobian.T @ jacobian + np.diag(roots**2)
        gradient = jacobian.T @ residual + roots * own
        before = 0.5 * float(residual @ residual + own @ own)
        improved, untold = 0.0, np.flatnonzero(~shooting.tells(path) | held)
        while damping < MOST_DAMPING:
            change = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
            change[shooting.size + untold] = 0.0  # the prior alone would move it, and the film with it
            trial = shooting.stepped(path, change)
            found, prior = shooting.residuals(trial, errors), shooting.prior_rows(trial)[0]
            improved = before - 0.5 * float(found @ found + prior @ prior)
            if improved > 0:
                break
            damping = max(10 * damping, FIRST_DAMPING)
        if improved <= 0:
            break
        path = trial
        damping = max(damping / 10, LEAST_DAMPING)
        if improved < DONE:
            break
    return path


def log_marginal(
    shooting: Shooting, path: Path, derivatives: tuple, errors: Errors, held: bool
) -> tuple[float, np.ndarray]:
    """Return the log likelihood with the unknowns integrated out, linear about a path, and their precision.

    derivatives : of the residuals, about this path or one near by.
    held : whether the material's coordinates are held where they are; otherwise they are integrated out too.
    """
    jacobian = shooting.whitened(errors, *derivatives)
    residual = shooting.residuals(path, errors)
    own, roots = shooting.prior_rows(path)
    if held:
        jacobian, own, roots = jacobian[:, : shooting.size], own[: shooting.size], roots[: shooting.size]
    precision = jacobian.T @ jacobian + np.diag(roots**2)
    lower = np.linalg.cholesky(precision)
    gained = solve_triangular(lower, jacobian.T @ residual + roots * own, lower=True)
    cost = 0.5 * float(residual @ residual + own @ own - gained @ gained)
    return -cost - errors.log_determinant - float(np.sum(np.log(np.diag(lower)))), precision


def learn_scales(
    shooting: Shooting, path: Path, derivatives: tuple, scales: Scales, doubts: Doubts | None
) -> tuple[Scales, float, np.ndarray]:
    """Return the scales of highest marginal density about a path, it, and their logarithms' standard errors (4,)."""

    def density(logarithms: np.ndarray) -> float:
        errors = shooting.errors(path, Scales(*np.exp(logarithms)), doubts)
        return log_marginal(shooting, path, derivatives, errors, False)[0] + prior.log_density_of_scales(logarithms)

    prior = shooting.parameters.prior
    best = np.log(scales)
    value, step = density(best), np.full(len(scales), 0.7)  # a search along each in turn
    while step.max() > 0.1:
        for number in range(len(scales)):
            for sign in (1, -1):
                tried = best.copy()
                tried[number] += sign * step[number]
                found = density(tried)
                if found > value:
                    best, value = tried, found
                    break
            else:
                step[number] /= 2
    ways = CURVED * np.eye(len(scales))
    curvature = [(2 * value - density(best + way) - density(best - way)) / CURVED**2 for way in ways]
    return Scales(*np.exp(best)), value, np.maximum(curvature, prior.log_scales()[1] ** -2) ** -0.5


def find_mode(
    shooting: Shooting, path: Path, scales: Scales, steps: int, doubts: Doubts | None = None, held: bool = False
) -> Mode:
    """Climb, then learn the scales, how much each tracked pose counts, and what pushed what; held : see `climb`."""
    path = climb(shooting, path, scales, steps, doubts, held)
    derivatives = shooting.derivatives(path)
    scales, value, uncertain = learn_scales(shooting, path, derivatives, scales, doubts)
    errors = shooting.errors(path, scales, doubts)
    precision = log_marginal(shooting, path, derivatives, errors, False)[1]
    covariance = np.linalg.inv(precision)
    ways = block_diag(*shooting.ways[: shooting.count])  # of the states in the first frame
    first = ways @ covariance[: ways.shape[1], : ways.shape[1]] @ ways.T
    less = None if doubts is None else doubts.blows
    learnt = shooting.doubts(path, errors, scales, derivatives[1], covariance, less)
    return Mode(path, *derivatives, learnt, scales, uncertain, value, covariance, first)


def first_coordinates(shooting: Shooting) -> list[np.ndarray]:
    """Return coordinates to start from: of several frictions those whose films lie nearest to the tracked centres, each
    with its nearest bounce where something may be struck. Masses begin as the prior says: momentum leads to theirs."""
    middle = shooting.parameters.middle()

    def nearest(starts: list[np.ndarray]) -> tuple[float, np.ndarray]:
        far = [distance_of(shooting, start) for start in starts]
        return min(far), starts[int(np.argmin(far))]

    bounces = (middle[1], *RESTITUTIONS) if shooting.struck else middle[1:2]
    tried = [nearest([np.array([math.log(each), bounce, *middle[2:]]) for bounce in bounces]) for each in FRICTIONS]
    found = sorted(tried, key=lambda pair: pair[0])[:STARTS]
    if shooting.struck:
        times = (middle[2], *np.log(CONTACT_TIMES))
        found = [nearest([np.array([*start[:2], time, *start[ALWAYS:]]) for time in times]) for _, start in found]
    return [start for _, start in found]


def distance_of(shooting: Shooting, coordinates: np.ndarray) -> float:
    """Return how far the film with these coordinates lies from the tracked centres."""
    path = shooting.first_path(coordinates)
    residual, jump = shooting.tracking_residuals(path)[..., :3], shooting.defects(path)[..., 6:9]
    far = np.sum(residual**2, axis=-1) / NEAR**2 + np.sum(jump**2, axis=-1) / NEAR_SPEED**2
    return float(np.sum(np.log1p(far)))


def find_modes(shooting: Shooting) -> tuple[list[Mode], list[Mode]]:
    """Return the best mode from several starts and those along friction from it, the best first; and those of other
    starts that are not far below it.

    Starts climb with the material as it is: while first velocities are poor, another friction would make up for them,
    and a box that stuck on its edge would be taken for one that slid. The best goes on with lost poses counted as what
    they are, which is another density: starts are compared without.
    """
    coarse = shooting.coarser()
    starts = (coarse.first_path(each) for each in first_coordinates(coarse))
    found = [find_mode(coarse, start, FIRST, SHORT, held=True) for start in starts]
    found.sort(key=lambda mode: -mode.log_marginal)
    best = find_mode(shooting, found[0].path, found[0].scales, LONG, found[0].doubts)
    others = [mode for mode in found[1:] if mode.log_marginal > found[0].log_marginal - CLOSE]
    return along_friction(shooting, best) if shooting.slides(best.path) else [best], others


def along_friction(shooting: Shooting, mode: Mode) -> list[Mode]:
    """Return this mode and those of other frictions that are no worse than CLOSE, the best first: each fitted, its
    friction held, from the one before.

    Contacts make films so rugged that no slope leads to a friction that is far off, but the films that fit best with
    each friction are smoothly better and worse.
    """

    def value(mode: Mode) -> float:
        errors = shooting.errors(mode.path, mode.scales, mode.doubts)
        held = log_marginal(shooting, mode.path, (mode.by_pose, mode.by_defect), errors, True)[0]
        prior = shooting.parameters.prior.log_density_of_scales(np.log(mode.scales))
        return held + prior + shooting.parameters.log_prior(mode.path.coordinates)

    found = [(value(mode), mode)]
    for sign in (-1.0, 1.0):
        worth, last = found[0]
        best, at = max(found, key=lambda pair: pair[0])
        beyond = round(sign * (mode.path.coordinates[0] - at.path.coordinates[0]) / RUNG)
        while beyond < MOST_RUNGS and worth > best - CLOSE:
            off = np.zeros(shooting.parameters.size)
            off[0] = sign * RUNG
            path = shooting.stepped(last.path, np.concatenate([last.follow @ off, off]))
            last = find_mode(shooting, path, last.scales, SHORT, mode.doubts, held=True)._replace(doubts=mode.doubts)
            worth = value(last)
            found.append((worth, last))
            best, beyond = (worth, 0) if worth > best else (best, beyond + 1)
    found.sort(key=lambda pair: -pair[0])
    return [mode for worth, mode in found if worth > found[0][0] - CLOSE]


def target_of(shooting: Shooting, modes: Sequence[Mode]) -> Callable[[np.ndarray, np.ndarray], float]:
    """Return the log density of (coordinates, scales' logarithms), with the film linear in the states about the mode of
    the nearest friction.

    It is so about the states that are likeliest with these coordinates: with those of the mode itself a film of another
    friction would be late for a blow, which is not linear.
    """
    parameters = shooting.parameters
    frictions = np.array([mode.path.coordinates[0] for mode in modes])
    tells = shooting.tells(modes[0].path)

    def density(coordinates: np.ndarray, logarithms: np.ndarray) -> float:
        prior = parameters.log_prior(coordinates) + parameters.prior.log_density_of_scales(logarithms)
        outside = parameters.inside(coordinates) != coordinates
        if not np.isfinite(prior) or np.delete(outside, 1).any():
            return -np.inf
        mode = modes[int(np.argmin(np.abs(frictions - coordinates[0])))]
        off = np.where(tells, coordinates - mode.path.coordinates, 0.0)
        try:
            path = shooting.stepped(mode.path, np.concatenate([mode.follow @ off, off]))
        except Diverged:
            return -np.inf
        about = mode.path._replace(coordinates=mode.path.coordinates + off)
        errors = shooting.errors(about, Scales(*np.exp(logarithms)), mode.doubts)
        return log_marginal(shooting, path, (mode.by_pose, mode.by_defect), errors, True)[0] + prior

    return density


def sample(
    density: Callable[[np.ndarray, np.ndarray], float],
    parameters: Parameters,
    modes: Sequence[Mode],
    rng: np.random.Generator,
    draws: int = DRAWS,
    struck: bool = False,
) -> Draws:
    """Return weighted draws by adaptive importance sampling; struck : whether the film has impacts, see `_tempered`.

    Each round proposes from a mixture of t distributions and the prior; the first round's t are about the modes, later
    ones have the mean and covariance of the weighted draws so far. A draw's weight is the target's density over that of
    all rounds' proposals, mixed by their numbers of draws (Cornuet, Marin, Mira and Robert 2012).
    """
    size, spread = parameters.size, parameters.prior.log_scales()[1]
    floor = 1e-4 * np.diag(np.concatenate([parameters.spread(), spread]) ** 2)
    rounds: list[list[Component]] = []
    points, target, log_weights = np.empty((0, size + len(spread))), np.empty(0), np.empty(0)
    for number in range(MOST_ROUNDS):
        if number >= ROUNDS and Draws(points, points, log_weights - logsumexp(log_weights)).effective > ENOUGH:
            break
        if number:
            weights = np.exp(_flattened(log_weights)[0])  # one or two draws of all the weight tell no covariance
            centre = weights @ points
            away = points - centre
            fitted = (weights[:, None] * away).T @ away
            about = [(centre, fitted)]
        else:
            about = [
                (
                    np.concatenate([mode.path.coordinates, np.log(mode.scales)]),
                    block_diag(mode.covariance[-size:, -size:], np.diag(mode.uncertain**2)),
                )
                for mode in modes
            ]
        components = [(centre, WIDER * np.linalg.cholesky(spread + floor)) for centre, spread in about]
        rounds.append(components)
        fresh = np.array([_proposal(rng, components, parameters) for _ in range(draws)])
        points = np.vstack([points, fresh])
        found = run_together(*(partial(density, point[:size], point[size:]) for point in fresh))
        target = np.concatenate([target, found])
        log_weights = target - _mixture(points, rounds, parameters)
    flat, power = _flattened(log_weights)
    share = power**2 if struck else power
    return Draws(_tempered(points[:, :size], np.exp(flat), share, parameters), points[:, size:], flat, power)


def _flattened(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Return normalised log weights, raised to the greatest power up to 1 at which FEWEST of the draws are their worth,
    and that power.

    Where contacts make the density so rugged that a few draws carry all the weight, its peaks are the engine's chaos:
    films that happen to fit.
    """
    power = next_temperature(log_weights, 0.0, FEWEST)
    return power * log_weights - logsumexp(power * log_weights), power


def _tempered(points: np.ndarray, weights: np.ndarray, power: float, parameters: Parameters) -> np.ndarray:
    """Return weighted coordinates (K, P) moved to where they are draws under the likelihood raised to a power.

    Weights raised to it alone leave them as wide as what proposed them, which is as wide as one film allows. Each
    coordinate gets the mean and width of a normal posterior whose likelihood counts so much beside the whole prior.

    Of films with impacts that is the power's square: chaos of s nats moves a likelihood's peak by sqrt(2 s) deviations,
    beside what it hides of its width. By the power alone two of seven films of toppling boxes told restitutions of .19
    to .40 and .17 to .44 where .13 was true.
    """
    mean = weights @ points
    told, before = weights @ (points - mean) ** 2, parameters.spread() ** 2
    precision = power / told + (1 - power) / before
    middle = (power * mean / told + (1 - power) * parameters.middle() / before) / precision
    return np.array([parameters.inside(point) for point in middle + (points - mean) / np.sqrt(told * precision)])


def _proposal(rng: np.random.Generator, components: list[Component], parameters: Parameters) -> np.ndarray:
    """Return one point from a mixture of t distributions, or from the prior."""
    if rng.uniform() < FROM_PRIOR:
        scales = [error.sample(rng) for error in parameters.prior.errors]
        return np.concatenate([parameters.sample_prior(rng), np.log(scales)])
    return draw_t(rng, *components[rng.integers(len(components))], FREEDOM, 1)[0]


def _mixture(points: np.ndarray, rounds: list[list[Component]], parameters: Parameters) -> np.ndarray:
    """Return the log density (K,) of what all rounds proposed."""
    size = parameters.size
    shares = ((each, math.log(len(components) * len(rounds))) for components in rounds for each in components)
    student = logsumexp([log_t(points, *each, FREEDOM) - share for each, share in shares], axis=0)
    scales = parameters.prior.log_density_of_scales
    prior = np.array([parameters.log_prior(point[:size]) + scales(point[size:]) for point in points])
    return np.logaddexp(math.log1p(-FROM_PRIOR) + student, math.log(FROM_PRIOR) + prior)


class Identified(NamedTuple):
    """What the motion tells."""

    parameters: Parameters  # what the coordinates mean
    modes: list[Mode]  # along friction, the best first
    draws: Draws  # weighted, of coordinates and scales
    told: np.ndarray  # (P,) bool, which coordinates the film tells; of the others the draws are the prior's
    stated: np.ndarray  # (P,) bool, which of them may be stated: of what never rebounds no restitution
    struck: bool  # whether something may be struck, so that not all lies on a floor throughout


def identify(motion: Motion, rng: np.random.Generator, prior: Prior | None = None, draws: int = DRAWS) -> Identified:
    """Return the posterior over friction, restitution and mass ratios, given tracked poses; prior None: the default."""
    engine = Engine(motion.matter, motion.names, motion.step)
    parameters = Parameters(motion.names, engine.masses, prior or read_dynamics_prior())
    shooting = Shooting(motion, parameters, engine)
    modes, others = find_modes(shooting)
    found = sample(target_of(shooting, modes), parameters, [*modes, *others], rng, draws, shooting.struck)
    told = shooting.tells(modes[0].path)
    told[0] = shooting.slides(modes[0].path)
    if shooting.struck and found.power < CHAOTIC:
        told[1:] = False
    untold = np.flatnonzero(~told)  # the density does not depend on these, or by chance: the prior remains
    away = np.array([parameters.sample_prior(rng) for _ in found.coordinates])[:, untold] - found.coordinates[:, untold]
    found.coordinates[:, untold] += away
    for number, shift in zip(untold, away.T, strict=True):  # of masses that are told to that of such a one
        if number >= ALWAYS:
            with_it = ALWAYS - 1 + np.flatnonzero(shooting.partner == number - ALWAYS + 1)[1:]
            found.coordinates[:, with_it] += shift[:, None]
    stated = told.copy()
    stated[1:ALWAYS] &= shooting.rebounds
    return Identified(parameters, modes, found, told, stated, shooting.struck)
