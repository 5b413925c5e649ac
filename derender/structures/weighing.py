"""The odds of two structures, each with its error: the one interface by which structures are weighed.

Two structures A and B that differ in the coordinates a and b of few solids and share all others, r, have the odds

    Z_B / Z_A = E[ Z_B(r) / Z_A(r) ],    r drawn from the posterior under A,

Z(r) being the integral over a (or b) alone with the rest held at r: an identity, not an approximation. A first look
takes r at the mode; where that leaves the odds open, r is drawn, and what the draws differ by is part of the error.
Structures that differ in more are weighed by the integral over everything. The sensor's numbers are refitted for each
structure that comes near; those whose odds are open are integrated over them too (`over_blur`).
"""

import functools
import math
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.search.moves import grown
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.image import rotation_of
from derender.detection.solids.interpenetration import penetration
from derender.detection.solids.state import State
from derender.sampling.evidence import Evidence
from derender.structures.changes import REACH, carried_upright
from derender.structures.draws.chart import make_chart, rows_at
from derender.structures.draws.metropolis import ROUNDS, engine_of, load, log_evidence, sample
from derender.structures.draws.refined import (
    Refined,
    at_its_blur,
    climb,
    floor_pose_of,
    height,
    log_weight,
    members_of,
    near_evidence,
    over_blur,
    refitted,
)

# Nats below the best at which `near_evidence` has to do: a box whose length hardly shows was found 9 nats likelier than
# that had it, 5 below the best. And the error that is taken for its own.
IMPROBABLE, NEAR_ERROR = 14.0, 2.0
# Draws about which an integral begins, and steps between them: of one solid, and for each of several. It is fitted to
# points of its own then, so that one round of warm-up from the mode does.
DRAWS, THIN, THIN_OF_EACH = 150, 2, 3
# Nats by which what a normal over everything misses differs between structures: .1 to .3 were found at 6 mm of noise,
# and 1.2 at 2 cm, where little of a solid shows.
MISSED = 0.5
CLOSE = 5.0  # nats of odds, either way and but for their error, at which more draws are made: weights of .007 to .993
APART, HIGHER = 2.0, 1.0  # standard errors, and nats of height, by which one mode of a structure is better than another
PLACES = 4, 8, 16  # of the rest, drawn for odds that are close, and added each time for those that are open then
OPEN = 0.03  # standard error of a weight from which on its odds are open: between two seeds it is .04, .1 one in sixty
NOTHING = 20.0  # nats below another at which a ratio is 0 beside it: a two-billionth
SETTLING = 30  # steps of each temperature for each solid that changes, where the rest is drawn


class Weighed(NamedTuple):
    """A structure and its odds against the best.
    places : indices of the solids whose coordinates are not shared with the best, here and there; None: all are."""

    trial: Any  # Refined
    odds: float  # log
    error: float = NEAR_ERROR  # standard error of the odds
    places: tuple[tuple[int, ...], tuple[int, ...]] | None = None


def evidence_over(
    rng: np.random.Generator, refined: Refined, solids: tuple[int, ...] | None = None
) -> tuple[Evidence, np.ndarray]:
    """Return the Evidence of the density over the coordinates of some solids, all others held, and draws (n, D) of it;
    None: over everything. n is 0 where there is nothing to draw.

    Over everything, and of solids that are apart, it is about that of a normal about the mode, with what each solid's
    own integral has more than that normal's: hidden sides are of single solids. What else a normal misses is about the
    same for structures of the same image (see MISSED), but for where two that touch meet.
    """
    chart, sensor, values = refined.chart, refined.sensor, refined.values
    meeting = combinations(refined.state.rows[list(solids or ())], 2)
    touching = any(penetration(grown(row, REACH), other) > 0.0 for row, other in meeting)
    if solids is None or len(solids) > 1 and not touching:
        log, draws, errors = near_evidence(refined, solids), values, [MISSED if solids is None else 0.0]
        for k in range(len(refined.state)) if solids is None else solids:
            found, own = evidence_over(rng, refined, (k,))
            log += found.log - near_evidence(refined, (k,))
            draws = draws + (own - values)  # which are of its own coordinates alone
            errors.append(found.standard_error)
        return Evidence(log, float(np.linalg.norm(errors))), draws
    members = members_of(chart, solids)
    if not members:
        return Evidence(sum(load(engine_of(chart, sensor), chart, values)), 0.0), np.empty((0, len(values)))
    steps = THIN if len(solids) == 1 else THIN_OF_EACH * len(solids)
    (drawn,) = sample(rng, chart, sensor, values, 1, DRAWS, steps, members, rounds=ROUNDS[-1:])
    bears = refined.state.parents
    shown = solids[0] if len(solids) == 1 and solids[0] not in bears else None  # what bears another need not show
    return log_evidence(rng, chart, sensor, values, drawn.values, members, shown), drawn.values


class Block:
    """Some solids of a structure with the others at their mode, or all and the floor (None): its integrals, each made
    once."""

    def __init__(self, refined: Refined, places: list[int] | None) -> None:
        self.refined, self.places = refined, None if places is None else tuple(places)
        self.apart = log_weight(refined.sensor)  # it is in no integral
        self._evidence: Any = None

    @functools.cached_property
    def near(self) -> float:
        """The log integral as `near_evidence` has it."""
        return near_evidence(self.refined, self.places) + self.apart

    def evidence(self, rng: np.random.Generator) -> Evidence:
        """Return the Evidence over the solids' coordinates."""
        if self._evidence is None:
            self._evidence, _ = evidence_over(rng, self.refined, self.places)
        return self._evidence


def of_block(rng: np.random.Generator, block: Block, own: Block) -> Weighed:
    """Return the Weighed of a structure that differs from the best in a few solids, the others at their mode.
    block : of those solids in it. own : of those of the best."""
    both = None if block.places is None or own.places is None else (block.places, own.places)
    near = Weighed(block.refined, block.near - own.near, NEAR_ERROR, both)
    if near.odds < -IMPROBABLE:
        return near
    found, held = block.evidence(rng), own.evidence(rng)
    error = math.hypot(found.standard_error, held.standard_error)
    if error > NEAR_ERROR:  # normals about both modes tell more
        return near
    return near._replace(odds=found.log + block.apart - held.log - own.apart, error=error)


def surest(alike: list[Weighed]) -> Weighed:
    """Return that of some Weighed of one structure, in the order in which they were weighed, which tells its odds.

    One that was integrated over before one that was only looked at, and of those the last one against the present best
    if any is, for others were weighed against a former. Unless another is likelier by more than the errors of both and
    its mode is higher, which then holds most of the integral: one as high is off, and the likelier of two is off most.
    """
    weighed = [each for each in alike if each.error != NEAR_ERROR] or list(alike)
    likeliest = max(weighed, key=lambda each: each.odds)
    last = [each for each in weighed if each.places is not None][-1:] or [likeliest]
    apart = APART * math.hypot(likeliest.error, last[0].error)
    better = height(likeliest.trial) > height(last[0].trial) + HIGHER
    return likeliest if better and likeliest.odds > last[0].odds + apart else last[0]


def surest_of_each(weighed: list[Weighed]) -> list[Weighed]:
    """Return the Weighed of each structure and of each number of shared solids that `surest` chooses."""
    alike: dict[tuple, list] = {}
    for each in weighed:
        alike.setdefault((discrete_part(each.trial.state), each.places), []).append(each)
    return [surest(some) for some in alike.values()]


def discrete_part(state: State) -> Any:
    """Return what tells states of the same solids in the same order apart but for their numbers."""
    return tuple(state.cubes), tuple(state.parents), tuple(state.rows[:, 0]), tuple(state.forms)


def made_sure(rng, best, others, drawn, rules):
    """Return the Weighed of others, those whose odds are close weighed again with the rest drawn from the posterior, at
    more of its PLACES where odds are OPEN. What stands on a solid that changes is integrated over with it: of its
    places drawn with the one hardly any suits the other, and a cube was .999 for that though .88.

    drawn : function of rng that returns (n, D) draws of the best's coordinates.
    """
    others = list(others)
    close = [k for k, each in enumerate(others) if abs(each.odds) < CLOSE + each.error and each.places is not None]
    if not close:
        return others
    draws = drawn(rng)
    told = {k: np.empty((0, 2)) for k in close}
    wide = {k: with_those_above(best, others[k]) if best.sensor.worth >= 1.0 else others[k] for k in close}
    for many in PLACES:
        chosen = draws[np.linspace(0, len(draws) - 1, many + 2).round().astype(int)[1:-1]]
        blocks = list(dict.fromkeys(wide[k].places[1] for k in close))  # of the best, in which several may differ
        own = in_threads(rng, [partial(integrals, best=best, places=places, draws=chosen) for places in blocks])
        own = dict(zip(blocks, own, strict=True))
        tasks = [partial(odds_at, best=best, weighed=wide[k], values=values, own=held, rules=rules)
                 for k in close for values, held in zip(chosen, own[wide[k].places[1]], strict=True)]  # fmt: skip
        found = np.array(in_threads(rng, tasks)).reshape(len(close), len(chosen), 2)
        for k, each in zip(close, found, strict=True):
            told[k] = np.concatenate([told[k], each])
            mean = averaged(*told[k].T)
            if mean is None:
                continue
            apart = log_weight(others[k].trial.sensor, ("blur",)) - log_weight(best.sensor, ("blur",))
            others[k] = others[k]._replace(odds=mean["odds"] + apart, error=mean["error"])
        close = [k for k in close if error_of_weight(others[k]) > OPEN]
        if not close or best.sensor.worth < 1.0:
            break
    return others


def with_those_above(best: Refined, weighed: Weighed) -> Weighed:
    """Return a Weighed whose places have also what stands on them in both structures."""
    if weighed.places is None or weighed.places[0] != weighed.places[1]:
        return weighed
    places = weighed.places[0]
    above = tuple(k for i in places for k in carried_upright(weighed.trial.state, i)
                  if k in carried_upright(best.state, i) and k not in places)  # fmt: skip
    return weighed._replace(places=((*places, *above),) * 2)


def error_of_weight(weighed: Weighed) -> float:
    """Return the standard error of the weight that a structure has beside the best alone."""
    ratio = math.exp(-abs(weighed.odds))
    return weighed.error * ratio / (1.0 + ratio) ** 2


def integrals(rng: np.random.Generator, best: Refined, places: tuple[int, ...], draws: np.ndarray) -> list[Evidence]:
    """Return the Evidences over some solids of the best, and the blur, with all else at draws (n, D)."""
    return [over_all(rng, settled_at(rng, best, values, places), places) for values in draws]


def settled_at(rng: np.random.Generator, best: Refined, values: np.ndarray, places: tuple[int, ...]) -> Refined:
    """Return a Refined with all but some solids at a draw (D,), those climbed to their mode there from where they are
    likelier, as drawn or as in the Refined: a walk from a lesser mode would miss most of their integral."""
    if not places:
        return best._replace(values=values.copy())
    members, engine = members_of(best.chart, places), engine_of(best.chart, best.sensor)
    as_before = values.copy()
    as_before[members] = best.values[members]
    start = max((values.copy(), as_before), key=lambda each: sum(load(engine, best.chart, each)))
    return climb(rng, best.state, best.chart, start, best.sensor, SETTLING * len(places), members, ())


def over_all(rng: np.random.Generator, refined: Refined, places: tuple[int, ...]) -> Evidence:
    """Return the Evidence over the coordinates of some solids and the blur, with which what is held was drawn."""
    held, draws = evidence_over(rng, refined, places)
    more = over_blur(rng, refined, places, draws)
    return Evidence(held.log + more.log, math.hypot(held.standard_error, more.standard_error))


def averaged(logs: np.ndarray, errors: np.ndarray) -> dict[str, float] | None:
    """Return {odds, error} of the mean of ratios by their logarithms (n,) with errors (n,); what is NOTHING beside the
    greatest is 0; integrals that failed (under which the rest was drawn, or of great error) tell nothing. None: all
    did."""
    known = logs < np.inf  # a NaN is not: 0 / 0
    logs, errors = logs[known], errors[known]
    if not len(logs):
        return None
    good = errors <= NEAR_ERROR
    if 2 * good.sum() >= len(logs):
        good |= logs < logs[good].max() - NOTHING
        logs, errors = logs[good], errors[good]
    count, most = len(logs), logs.max()
    if most == -np.inf:
        return {"odds": -np.inf, "error": 0.0}
    possible, errors = logs[logs > most - NOTHING], errors[logs > most - NOTHING]
    odds = float(np.logaddexp.reduce(possible) - math.log(count))
    spread = float(np.var(possible, ddof=1)) if len(possible) > 1 else 0.0
    spread += count / len(possible) - 1.0  # of how often it is not 0
    return {"odds": odds, "error": math.sqrt((float(np.mean(np.square(errors))) + spread) / count)}


def odds_at(
    rng: np.random.Generator, best: Refined, weighed: Any, values: np.ndarray, own: Evidence, rules: Rules
) -> tuple[float, float]:
    """Return (log odds, error) of a structure against the best with what they share at a draw (D,) of the best.
    own : Evidence over the best's solids that differ and the blur, there."""
    trial, (places, own_places) = weighed.trial, weighed.places
    here = best._replace(values=values.copy())
    rows, state = rows_at(best.chart, values), trial.state.copy()
    shared = [k for k in range(len(best.state)) if k not in own_places]
    for k, row in zip([k for k in range(len(state)) if k not in places], shared, strict=True):
        state.rows[k] = rows[row]
    for k, own_place in zip(places, own_places, strict=False):
        state.rows[k] = carried(state.rows[k], best.state.rows[own_place], rows[own_place])
    chart, start = make_chart(state, floor_pose_of(here), rules)
    if places:
        found = climb(rng, state, chart, start, trial.sensor, SETTLING * len(places), members_of(chart, places), ())
    else:
        found = Refined(state, chart, start, trial.sensor, *load(engine_of(chart, trial.sensor), chart, start))
    if not np.isfinite(found.log_prior):  # here it is impossible: it does not touch what bears it
        return -np.inf, 0.0
    other = over_all(rng, found, places)
    return other.log - own.log, math.hypot(other.standard_error, own.standard_error)


def carried(row: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the row of a solid in another's place, moved, turned and grown as that was from one row to another: left
    where it was, what stands on it would lie millimetres off the image."""
    new = row.copy()
    new[1:10] = (rotation_of(after) @ rotation_of(before).T @ rotation_of(row)).ravel()
    new[10:13] += after[10:13] - before[10:13]
    if int(row[0]) == int(before[0]):
        new[13:16] = np.maximum(row[13:16] + after[13:16] - before[13:16], 0.5 * row[13:16])
    return new


def with_own_sensor(rng: np.random.Generator, trial: Refined, places: Any, least: float) -> Refined:
    """Return a Refined under the sensor that it suggests itself, where that explains more by at least `least` nats.
    Then the solids that changed are climbed again."""
    found = refitted(trial)
    if height(found) < height(trial) + least or not places:
        return found
    members = members_of(found.chart, places)
    moved = found.sensor.values["blur"] != trial.sensor.values["blur"]
    found = climb(rng, found.state, found.chart, found.values.copy(), found.sensor, SETTLING, members, ())
    return at_its_blur(rng, found, members) if moved else found
