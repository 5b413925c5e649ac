"""A posterior about the best state: draws of all numbers under each structure, and the weights of the structures.

The likelihood is the engine's, with the blur and the noise that the image shows (`draws/refined.py`); structures are
weighed by integrals (`alternatives.py`). Of a real sensor's image, whose neighbouring pixels err together, the
likelihood is `correlated`; and faces are off where they appear (`draws/faces.py`).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from derender.compilation.threads import THREADS, in_threads
from derender.detection.search.greedy import Settings, total_energy
from derender.detection.search.observation import Observation
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.graph import matched_names, names_of, scene_graph, structure_key
from derender.detection.solids.state import State
from derender.results.posterior import StructurePosterior
from derender.sampling.evidence import shares
from derender.structures.alternatives import (
    QUICK,
    climbed,
    climbed_higher,
    combinations,
    from_search,
    of_likeliest_shapes,
    of_one_solid,
    weighed_whole,
)
from derender.structures.bridges import by_bearer
from derender.structures.changes import tipping_of
from derender.structures.draws.metropolis import Draws
from derender.structures.draws.refined import (
    WARM,
    Refined,
    at_mode,
    chains_of,
    floor_pose_of,
    height,
    leaves_outliers,
    only_draw,
    pixels_of,
    refine,
    structure_posterior,
    view_of,
    with_sensor_refitted,
)
from derender.structures.unexplained import additions, hidden_expected, spots_left
from derender.structures.unions import merges, put_on, recuts
from derender.structures.weighing import CLOSE, HIGHER, NEAR_ERROR, Weighed, made_sure, surest, surest_of_each

ROUNDS = 4  # in which each solid is tried otherwise, and one more where something is unexplained, at most
MOST_MERGES, MOST_CUTS = 4, 3
AHEAD = THREADS  # solids whose changes are weighed side by side, in vain after one that leads to a better structure
WORTH_DRAWING = 0.05  # weight of a structure that gets draws of its own, not its mode alone
# Structures less probable than the best by more than this many nats are not reported; how many are, at most.
NEGLIGIBLE, MOST_PARTS = 8.0, 12
# The weight of the likeliest structure below which all are weighed again; nats below it within which one of more or
# fewer solids says that a search may have missed a better one (of 46 made scenes one has such; where a weighing told
# two cubes as one box at .99, in two scenes, it was at 5 and 7); independent pixels of a solid below which climbs end
# beside its mode; and nats below the likeliest at which a second weighing is still told of another.
LIKELY, RIVAL, FEW_TO_CLIMB, MET = 0.9, 10.0, 40, 4.0

Again = Callable[[], Refined | None]
Kept = tuple[Refined, float, list[str], float]  # of a structure its mode, log odds, names, and the error of the odds


def parts_of(
    rng: np.random.Generator,
    seen: Observation,
    state: State,
    pool: list[tuple[State, float]],
    settings: Settings,
    chains: int = 2,
    draws: int = 100,
    only_best: bool = False,
    refined: Refined | None = None,
    again: Again | None = None,
) -> list[StructurePosterior]:
    """Return the parts of the posterior about the search's best state.

    seen : Observation. pool : (state, energy) that the search came by. only_best : the mode of one structure alone.
    refined : the state's, where that is made already. again : see `independent_parts`.
    """
    if seen.no_floor:  # all is taken as it is seen: nothing for the engine to explain
        scores = np.zeros((1, 1) if only_best else (chains, draws))
        return [StructurePosterior(scene_graph(state, seen.floor.pose), (), scores[..., None][..., :0], scores, scores)]
    first = refined or refine(rng, [view_of(seen)], seen.floor.pose, state, settings.rules, settings.tries)
    energy = total_energy(seen.image, state, settings)
    settings = settings._replace(reduced=seen.factor > 1)
    return independent_parts(rng, first, energy, pool, settings, chains, draws, only_best, again, seen.agreed)


def independent_parts(rng, first, energy, pool, settings, chains, draws, only_best, again=None, agreed=True):
    """Return the parts: all chains for the likeliest, one for others that are likely; see `weighed_structures`.

    again : makes the Refined of another search, or None; None: structures are weighed once. Else they are weighed a
        second time where that leaves doubts. agreed : whether searches did about the first.
    """
    if only_best:
        return likeliest_shapes(rng, first, settings)
    made = DrawsOfOne(chains, draws, settings.until)
    kept = weighed_structures(rng, first, energy, pool, settings, made)
    if again is not None and (settings.until is None or time.monotonic() < settings.until):
        kept = weighed_again(rng, kept, settings, made, again, agreed)
    kept = [each for each in kept if each[1] > -NEGLIGIBLE]
    # What is not reported keeps its share: of the others' weights it takes what is its own.
    weights, errors, intervals = shares(rng, [each[1] for each in kept], [each[3] for each in kept])
    parts, extras = [], {}
    for place, (trial, _, own, _) in enumerate(kept[:MOST_PARTS]):
        if place == 0 and len(trial.state):
            drawn = made.of(rng, trial)
        elif place == 0:  # free-form things have numbers that are drawn for each of them
            drawn = [only_draw(trial, draws)] * chains
        elif weights[place] > WORTH_DRAWING and len(trial.state):
            trial = at_mode(rng, trial.state, floor_pose_of(trial), trial.sensor, settings.rules, temperatures=WARM)
            drawn = chains_of(rng, trial, 1, draws)
        else:
            drawn = [only_draw(trial)]
        states = [(trial.state, 1.0)]
        if weights[place] > WORTH_DRAWING:
            values = np.concatenate([each.values for each in drawn])
            states = by_bearer(rng, trial.state, trial.chart, values, settings.believed.loose.friction)
        low, high = (float(end) for end in intervals[place])
        for state, share in states:
            part = structure_posterior(rng, trial._replace(state=state), own, float(weights[place]), drawn)
            part = replace(part, weight_error=float(errors[place]), weight_interval=(low, high))
            parts.append(part.scaled(share))
        if place == 0:
            extras = {"hidden_expected": hidden_expected(rng, trial, settings.beliefs), **shown_and_left(trial)}
    parts.sort(key=lambda part: -part.weight)
    return [replace(parts[0], extras={**parts[0].extras, **extras}), *parts[1:]]


def likeliest_shapes(rng: np.random.Generator, first: Refined, settings: Settings) -> list[StructurePosterior]:
    """Return the parts of a quick look: the search's best state with its likeliest shapes, and others of one solid."""
    found = of_likeliest_shapes(rng, first, settings.rules, settings.shapes)
    found = sorted((pair for pair in found if pair[1] > -NEGLIGIBLE), key=lambda pair: -pair[1])
    best, parts = found[0][0], []
    odds = np.array([each for _, each in found])
    errors = np.where(np.arange(len(found)) == 0, 0.0, NEAR_ERROR)
    told = zip(found, *shares(rng, odds, errors), strict=True)
    for (trial, _), weight, error, (low, high) in told:
        part = structure_posterior(rng, trial, names_of(best.state), float(weight), [only_draw(trial)])
        parts.append(replace(part, weight_error=float(error), weight_interval=(float(low), float(high))))
    extras = {**parts[0].extras, **shown_and_left(best), "weighed": False}
    return [replace(parts[0], extras=extras), *parts[1:MOST_PARTS]]


def shown_and_left(trial: Refined) -> dict[str, list]:
    """Return {pixels: of each solid, how many independent ones show it; spots: places of those left that are no
    noise}."""
    sensor, shows = trial.sensor, trial.sensor.shows
    clean = sensor.clean(trial.chart, trial.values)
    left = [] if shows < 1.0 else spots_left(clean, sensor.returned, sensor.values)
    return {"pixels": [float(shows * count) for count in pixels_of(trial)], "spots": left}


def weighed_again(
    rng: np.random.Generator, kept: list[Kept], settings: Settings, made: "DrawsOfOne", again: Again, agreed: bool
) -> list[Kept]:
    """Return what `weighed_structures` keeps, weighed a second time where that leaves doubts.

    Other structures may be nearly as likely; or another search may find a likelier one, and the second begins with what
    it does: no two searches of the first agreed, pixels are left unexplained or taken for outliers, a structure of more
    or fewer solids is close, or of those that are open a solid shows in few pixels.
    """
    best, told = kept[0][0], shown_and_left(kept[0][0])
    close = any(odds > -RIVAL for trial, odds, *_ in kept if len(trial.state) != len(best.state))
    missed = not agreed or close or bool(told["spots"]) or leaves_outliers(best.sensor)
    if not missed and 1.0 / np.exp([odds for _, odds, *_ in kept]).sum() >= LIKELY:
        return kept
    few = min(told["pixels"], default=np.inf) < FEW_TO_CLIMB
    start = (again() if missed or few else None) or best
    met = [trial.state for trial, odds, *_ in kept if trial is not start and odds > -MET]
    return of_both(weighed_structures(rng, start, np.inf, [], settings, made, met), kept)


def of_both(kept: list[Kept], before: list[Kept]) -> list[Kept]:
    """Return what a second weighing keeps with the odds of both, each against the likeliest of the second, where both
    found modes as high; by the inverse variances, with the error of what they differ by where that is greater."""
    best, names = kept[0][0], kept[0][2]
    first = {structure_key(trial.state, matched_names(trial.state, best.state, names)): (trial, odds, error)
             for trial, odds, _, error in reversed(before)}  # fmt: skip
    nothing = (None, 0.0, 0.0)
    found = []
    held, against, spread = first.get(structure_key(best.state, names), nothing)
    for trial, odds, own, error in kept:
        other, own_odds, own_error = first.get(structure_key(trial.state, own), nothing)
        alike = [a is not None and abs(height(a) - height(b)) < HIGHER for a, b in ((held, best), (other, trial))]
        if trial is not best and all(alike):
            each = np.array([odds, own_odds - against])
            squares = np.square([error, np.hypot(own_error, spread)]) + np.finfo(float).tiny
            odds = float(np.average(each, weights=1.0 / squares))
            error = float(np.sqrt(max(1.0, np.ptp(each) ** 2 / squares.sum()) / (1.0 / squares).sum()))
        found.append((trial, odds, own, error))
    most = max(odds for _, odds, *_ in found)
    return sorted(((trial, odds - most, own, error) for trial, odds, own, error in found), key=lambda each: -each[1])


class DrawsOfOne:
    """Chains of one structure at a time, made when they are first asked for: the likeliest needs them anyway."""

    def __init__(self, chains: int, draws: int, until: float | None = None) -> None:
        self.chains, self.count, self.until = chains, draws, until
        self.made: tuple = ()

    def of(self, rng: np.random.Generator, refined: Refined) -> list[Draws]:
        """Return the list of Draws of a Refined, one for each chain."""
        if not self.made or self.made[0] is not refined:
            self.made = refined, chains_of(rng, refined, self.chains, self.count, self.until)
        return self.made[1]

    def coordinates(self, rng: np.random.Generator, refined: Refined) -> np.ndarray:
        """Return (n, D) those of all chains."""
        return np.concatenate([drawn.values for drawn in self.of(rng, refined)])


def weighed_structures(rng, first, energy, pool, settings, made=None, met=()):
    """Return (Refined, log odds, names, error) of the structures that the search met and of those near the best.

    The likeliest comes first, with odds 0 and no error: the others' are against it. A solid has the same name in all.

    first : Refined of the search's best state. energy : the search's of it. pool : (state, energy) that it came by.
    made : DrawsOfOne, by which odds that are close are made sure; None: they are left as they are.
    met : States of structures that another weighing came by.
    """
    rules, shapes = settings.rules, settings.shapes
    best, others = leading(*with_met(rng, first, met, rules))
    for found_by, most in ((merges, MOST_MERGES), (recuts, MOST_CUTS)):
        for _ in range(most):
            former = best
            best, others = leading(best, [*others, *found_by(rng, best, rules)])
            if best is former:
                break
    for number in range(ROUNDS):  # again where the last has led to a better one: the odds are to be against that
        higher = climbed_higher(rng, best)
        former, others = one_solid_each(rng, higher, lowered(others, best, higher), rules, shapes)
        near = [] if number else from_search(former, pool, energy, settings.temper)
        near += additions(rng, former, settings)  # with those of the search: the integral over the best is made once
        others += weighed_whole(rng, former, near, rules, QUICK)
        others += [*merges(rng, former, rules), *put_on(rng, former, rules)]
        best, others = leading(former, others)
        if made is not None and best is former:
            others = surest_of_each(others)
            others = [*others, *combinations(rng, best, others, rules)]
            found = made_sure(rng, best, others, partial(made.coordinates, refined=best), rules)
            best, others = leading(best, found)
        if best is former and not number:
            best, others = leading(best, [*others, *about_rival(rng, best, others, rules, shapes)])
        if best is former:
            break
        higher = with_sensor_refitted(rng, best)
        best, others = higher, lowered(others, best, higher)
    names = names_of(best.state)
    found = {structure_key(best.state, names): (best, 0.0, names, 0.0)}
    alike: dict[tuple, list] = {}
    for other in others:
        own = matched_names(other.trial.state, best.state, names)
        alike.setdefault(structure_key(other.trial.state, own), []).append((other, own))
    for key, pairs in alike.items():
        if key not in found:
            chosen = surest([other for other, _ in pairs])
            own = next(own for other, own in pairs if other is chosen)
            found[key] = (chosen.trial, chosen.odds, own, chosen.error)
    least = -NEGLIGIBLE - tipping_of(best)  # what is less likely stays negligible, whatever the best costs
    standing = [(trial, odds - (tipping_of(trial) if odds > least else 0.0), own, error)
                for trial, odds, own, error in found.values()]  # fmt: skip
    most = max(odds for _, odds, _, _ in standing)
    return sorted(((trial, odds - most, own, error) for trial, odds, own, error in standing), key=lambda each: -each[1])


def with_met(
    rng: np.random.Generator, first: Refined, met: Sequence[State], rules: Rules
) -> tuple[Refined, list[Weighed]]:
    """Return the Refined to begin with, as high as any of its structure, and the Weighed of the other structures.
    met : States that another weighing of the image came by."""
    names, alike, others = names_of(first.state), [], []
    for state in met:
        same = structure_key(state, matched_names(state, first.state, names)) == structure_key(first.state, names)
        (alike if same else others).append(state)
    best = max([first, *climbed(rng, first, alike, rules, QUICK, np.inf)], key=height)
    return best, weighed_whole(rng, best, others, rules, QUICK)


def one_solid_each(
    rng: np.random.Generator, best: Any, others: list[Weighed], rules: Rules, shapes: tuple[str, ...]
) -> tuple[Refined, list[Weighed]]:
    """Return the likeliest and the others once each solid of it has been tried otherwise, all against the same best:
    where a change leads to a better one, all are tried again, ROUNDS times at most."""
    k, left, tries = 0, len(best.state), ROUNDS * len(best.state)
    while left > 0 and tries > 0:
        count = len(best.state)
        ahead = [(k + n) % count for n in range(min(AHEAD, left))]
        tasks = [partial(of_one_solid, best=best, i=i, rules=rules, shapes=shapes) for i in ahead]
        for weighed in in_threads(rng, tasks):
            k, left, tries, against = k + 1, left - 1, tries - 1, best
            best, others = leading(best, [*others, *weighed])
            if best is not against:  # what the next solids' changes were weighed against
                higher = with_sensor_refitted(rng, best)
                best, others, left = higher, lowered(others, best, higher), len(higher.state)
                break
    return best, others


def about_rival(
    rng: np.random.Generator, best: Refined, others: list[Weighed], rules: Rules, shapes: tuple[str, ...]
) -> list[Weighed]:
    """Return the Weighed of the likeliest structure of more or fewer solids and of those near it, where it is close to
    the best: what is no further from it may be likelier than both, and no change of one solid leads there."""
    counted = [each for each in others if len(each.trial.state) != len(best.state) and each.odds > -CLOSE]
    if not counted:
        return []
    rival = climbed_higher(rng, max(counted, key=lambda each: each.odds).trial)
    rival, near = one_solid_each(rng, rival, [], rules, shapes)
    found = weighed_whole(rng, best, [rival.state], rules, QUICK)
    return found + [each._replace(odds=each.odds + own.odds, error=float(np.hypot(each.error, own.error)), places=None)
                    for own in found for each in near]  # fmt: skip


def lowered(others: list[Weighed], best: Refined, higher: Refined) -> list[Weighed]:
    """Return the Weighed of others against what a climb of the best led to."""
    return [each._replace(odds=each.odds - (height(higher) - height(best))) for each in others]


def leading(best: Refined | str, others: list[Weighed]) -> tuple[Refined | str, list[Weighed]]:
    """Return the likeliest of the best and the Weighed of others, and the rest with odds against it, which share no
    coordinates with it any more, and have the error of both."""
    leader = max(others, key=lambda each: each.odds, default=None)
    if leader is None or leader.odds <= 0.0:
        return best, others
    rest = [each for each in others if each is not leader]
    rest = [each._replace(odds=each.odds - leader.odds, error=float(np.hypot(each.error, leader.error)), places=None)
            for each in rest]  # fmt: skip
    back = None if leader.places is None else leader.places[::-1]
    return leader.trial, [*rest, Weighed(best, -leader.odds, leader.error, back)]
