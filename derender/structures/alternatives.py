"""Structures besides the best one, and how probable each is: integrals of prior times likelihood, from draws.

A change of one solid is weighed with the others held at the mode: the two integrals are over that solid's coordinates
alone (`weighing.evidence_over`). Structures that differ in more, as the search met them, are weighed by the integral
over everything. What a solid's coordinates cost (its sizes' and places' densities) is in the prior (`chart.log_prior`),
so the ratio of integrals holds the Occam factor, and no price has to be set.

What one by one leaves open is open together (`combinations`): where a can may as well be a box and a cube beside it
longer than it is wide, one more structure has both changes.
"""

from functools import partial
from itertools import product
from operator import itemgetter

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.graph import matched_names, names_of, structure_key
from derender.detection.solids.state import State
from derender.detection.solids.support import final_parents
from derender.scene.solids import BOX
from derender.structures.changes import (
    FEW_PIXELS,
    as_two,
    carried_upright,
    changes,
    other_shapes,
    propped_up,
    raised,
    reached_down,
    still_bears,
    uprighted,
)
from derender.structures.draws.chart import make_chart
from derender.structures.draws.metropolis import engine_of, load
from derender.structures.draws.refined import (
    Refined,
    at_mode,
    climb,
    floor_pose_of,
    height,
    members_of,
    pixels_of,
    refined_at,
    refitted,
    with_sensor_refitted,
    without_unseen,
)
from derender.structures.draws.sensor import Sensor
from derender.structures.weighing import CLOSE, IMPROBABLE, Block, Weighed, discrete_part, of_block, with_own_sensor

PRUNE_THRESHOLD = 25.0  # nats below the best mode from which on a change is not looked at any further
PROMISING = 60.0  # nats below it up to which the sensor's numbers, fitted to the best, are fitted anew to a change
WORTHWHILE = 1.0  # nats that this has to gain for the solids to be climbed again
PROPPING = 200.0  # nats below the best at which what hangs in the air is not given a support: that costs some too
FROM_SEARCH = 3  # structures that the search met, at most
WITHIN = 30.0  # nats of the search's own energy within which they are looked at
HOPELESS = 2000.0  # nats below it at which a hot walk ends: of 714 those that were so low ended 850 and more below
DOUBTFUL = 300.0  # nats below it up to which one climb does not show that a change is to be pruned
AGAIN = 2  # climbs more of what is that doubtful, and of a changed solid that is not pruned
SIZES = 2  # of a cube, from the likeliest on, and ways in which a box is longer, tried in a quick look
TURNS = 2  # of each solid: what a walk as another shape leads to may be what it was, higher
QUICK, MOST_PATIENT = 50, 4.0  # steps of each temperature for one changed solid, and times as many at most
# Structures, the likeliest if no change told anything of another, and solids, those most likely other than in the best:
# with twenty that are open there are more combinations than can be counted.
MOST_COMBINED = 6

Changes = tuple[tuple[int, Weighed], ...]  # which solid, and the structure in which it alone is other than in the best


def of_one_solid(
    rng: np.random.Generator, best: Refined, i: int, rules: Rules, shapes: tuple[str, ...] = ()
) -> list[Weighed]:
    """Return the Weighed of the changes of one solid that are not pruned.
    shapes : names of those that it may be instead, where that hardly shows."""
    steps = quick_steps(int(pixels_of(best)[i]))

    def likely(states: list[State]) -> list[Refined]:
        found = (tried(rng, best, state, [i], rules, steps) for state in states if still_bears(best, state, i))
        return [trial for trial in found if trial is not None]

    nearest = partial(nearest_of_each_size, best, i, rules)
    found = likely([*nearest(changes(best, i)), *other_shapes(best, i, shapes), *reached_down(best, i)])
    found += likely(nearest(as_boxes(best, likeliest_of_each(found), i)))
    propped = [] if rules.floating else propped_up(best, i, shapes)
    least = PROPPING if propped else PRUNE_THRESHOLD
    upright = uprighted(best.state, i)
    on_it = [] if upright is None else carried_upright(best.state, i)
    several = [tried(rng, best, state, [i, *on_it, *range(len(best.state), len(state))], rules, least=least)
               for state in [*propped, *raised(best, i, shapes), *([] if upright is None else [upright]),
                             *as_two(best, i, shapes)]]  # fmt: skip
    removed = unclimbed(best.state.without(i), floor_pose_of(best), best.sensor, rules)
    others: list[Weighed] = []
    if height(removed) > height(best) - PROMISING:
        # what stands about it may have given way to what is not there: then it goes back once that is gone
        others = weighed_whole(rng, best, [removed.state], rules, QUICK)
        removed = refitted(removed)
    own = Block(best, [i])
    if height(removed) > height(best) - PRUNE_THRESHOLD:
        others.append(of_block(rng, Block(removed, []), own))
    for trial in likeliest_of_each(found):
        again, places = climbed_again(rng, trial, [i], steps), with_those_on_it(best, trial, i)
        others.append(of_block(rng, Block(again, places), own if places == [i] else Block(best, places)))
    own = Block(best, [i, *on_it]) if on_it else own
    for trial in likeliest_of_each([trial for trial in several if trial is not None]):
        places = [i, *on_it, *range(len(best.state), len(trial.state))]
        others.append(of_block(rng, Block(climbed_again(rng, trial, places, steps), places), own))
    return others


def of_likeliest_shapes(
    rng: np.random.Generator, best: Refined, rules: Rules, shapes: tuple[str, ...]
) -> list[tuple[Refined, float]]:
    """Return (Refined, log odds) of the best with each solid a box or a cube, or a can, as normals about the modes have
    it (a search counts a box's two sides as their price), and then of those in which one solid has another shape."""
    others = []
    for i in range(len(best.state)):
        for _ in range(TURNS):
            alike = [state for state in changes(best, i) if state.parents[i] == best.state.parents[i]]
            states = [*nearest_of_each_size(best, i, rules, alike)[:SIZES], *other_shapes(best, i, shapes)]
            found = [tried(rng, best, state, [i], rules, again=0) for state in states if still_bears(best, state, i)]
            own, each = Block(best, [i]), likeliest_of_each([trial for trial in found if trial is not None])
            odds = [(Block(trial, [i]).near - own.near, trial) for trial in each]
            gain, likeliest = max(odds, key=itemgetter(0), default=(0.0, best))
            if gain <= 0.0:
                break
            odds = [(-gain, best), *((each - gain, trial) for each, trial in odds if trial is not likeliest)]
            best = likeliest
        others += [(i, gain, trial.state) for gain, trial in odds]
    floor = floor_pose_of(best)
    return [(best, 0.0), *((unclimbed(best.state.swapped(i, state[i]), floor, best.sensor, rules), gain)
                           for i, gain, state in others)]  # fmt: skip


def tried(rng: np.random.Generator, best: Refined, state: State, places: list[int], rules: Rules, steps: int = QUICK,
          least: float = PRUNE_THRESHOLD, again: int = AGAIN) -> Refined | None:  # fmt: skip
    """Return the Refined of a state whose solids at `places` are climbed, the others as in the best, under the sensor
    that it suggests itself where it is promising; None where it is `least` nats below the best, or a solid is not seen.

    One climb in thirteen ended up to 70 nats beside the mode, so that what is doubtful is climbed `again`, with what
    stands on it; not where neighbouring pixels share noise: a climb takes five times as long there.
    """
    climb = partial(at_mode, rng, state, floor_pose_of(best), best.sensor, rules, steps,
                    least=best.log_prior + best.log_likelihood - HOPELESS)  # fmt: skip
    trial = climb(places)
    if best.sensor.worth >= 1.0 and height(best) - DOUBTFUL < height(trial) < height(best) - least:
        above = [k for i in places for k in carried_upright(state, i) if k not in places]
        trial = max([trial, *(climb([*places, *above]) for _ in range(again))], key=height)
    if height(trial) > height(best) - max(PROMISING, least):
        trial = with_own_sensor(rng, trial, places, WORTHWHILE)
    return trial if height(trial) > height(best) - least and all_seen(trial) else None


def with_those_on_it(best: Refined, trial: Refined, i: int) -> list[int]:
    """Return solid `i` and those on it, where they were climbed with it and are no longer as in the best."""
    above = [k for k in carried_upright(trial.state, i) if k < len(best.state)]
    same = np.array_equal(trial.state.rows[above, 13:16], best.state.rows[above, 13:16])
    return [i] if same else [i, *above]


def as_boxes(best: Refined, trials: list[Refined], i: int) -> list[State]:
    """Return the states in which solid `i`, a box or a cube in the trials and not in the best, is the other of the two:
    what began with a round solid's place and size may have ended beside its mode."""
    if int(best.state.rows[i][0]) == BOX:
        return []
    return [state for trial in trials for state in changes(trial, i) if state.parents[i] == trial.state.parents[i]]


def nearest_of_each_size(best: Refined, i: int, rules: Rules, states: list[State]) -> list[State]:
    """Return, of states in which solid `i` is as large and the structure the same, the one likeliest as it is."""
    alike: dict[tuple, list[State]] = {}
    for state in states:
        alike.setdefault((discrete_part(state), *state.rows[i][13:16]), []).append(state)
    floor, sensor = floor_pose_of(best), best.sensor

    def nearest(same: list[State]) -> State:
        charts = [make_chart(state, floor, rules) for state in same]
        engine = engine_of(charts[0][0], sensor)  # of solids of the same kinds
        return same[int(np.argmax([sum(load(engine, *each)) for each in charts]))]

    return [nearest(same) if len(same) > 1 else same[0] for same in alike.values()]


def quick_steps(pixels: int) -> int:
    """Return the steps of each temperature for a changed solid: the fewer pixels show it, the more ways it may lie."""
    return int(QUICK * np.clip(FEW_PIXELS / max(pixels, 1), 1.0, MOST_PATIENT))


def climbed_again(rng: np.random.Generator, trial: Refined, places: list[int], steps: int) -> Refined:
    """Return the highest of a Refined and of AGAIN hot climbs of some solids from there: one alone may end beside the
    mode, and what shows in few pixels may lie so or so. steps : of each temperature and solid."""
    members, steps = members_of(trial.chart, places), steps * len(places)
    climbs = [climb(rng, trial.state, trial.chart, trial.values.copy(), trial.sensor, steps, members)
              for _ in range(AGAIN)]  # fmt: skip
    return highest_seen(trial, climbs)


def highest_seen(trial: Refined, climbs: list[Refined]) -> Refined:
    """Return the highest of a Refined and of climbs from there that hide no solid: one that hides could be anywhere."""
    return max([trial, *(each for each in climbs if all_seen(each))], key=height)


def climbed_higher(rng: np.random.Generator, best: Refined) -> Refined:
    """Return the Refined once all its solids, and each that shows in few pixels alone, were climbed again from hot, as
    long as that helps: what others are weighed against is to be its mode. Not where neighbouring pixels share noise (it
    is slow)."""
    while best.sensor.worth >= 1.0:
        again = climb(rng, best.state, best.chart, best.values.copy(), best.sensor, QUICK)
        higher = highest_seen(best, [again])
        for i, many in enumerate(pixels_of(higher)):
            if many <= FEW_PIXELS:
                higher = climbed_again(rng, higher, [i], quick_steps(int(many)))
        if height(higher) < height(best) + WORTHWHILE:
            return higher
        best = with_sensor_refitted(rng, higher)
    return best


def likeliest_of_each(trials: list[Refined]) -> list[Refined]:
    """Return the highest of those trials with the same structure (cubes that hold different corners at the start)."""
    found: dict[tuple, Refined] = {}
    for trial in trials:
        key = discrete_part(trial.state)
        if key not in found or height(trial) > height(found[key]):
            found[key] = trial
    return list(found.values())


def all_seen(trial: Refined) -> bool:
    """Whether every solid of a Refined shows or carries something: one that does neither could be anywhere at all."""
    return len(without_unseen(trial.state, trial)) == len(trial.state)


def unclimbed(state: State, floor: np.ndarray, sensor: Sensor, rules: Rules) -> Refined:
    """Return the Refined of a state as it is. floor : (4, 4) pose, floor frame to camera."""
    chart, values = make_chart(state, floor, rules)
    return refined_at(state, chart, values, sensor, *load(engine_of(chart, sensor), chart, values))


def from_search(best: Refined, pool: list[tuple[State, float]], energy: float, temper: float) -> list[State]:
    """Return the states of structures that the search met, more than one step from the best.
    pool : (state, energy) of them. energy : the best one's. temper : by which energies are multiples of nats."""
    names = names_of(best.state)
    solids = range(len(best.state))
    # what `of_one_solid` weighs is one step away, and at a fifth of the cost of integrals over all
    seen = {structure_key(best.state, names)}
    seen |= {structure_key(state, names) for i in solids for state in changes(best, i)}
    seen |= {structure_key(best.state.without(i), [*names[:i], *names[i + 1 :]]) for i in solids}
    near: list[State] = []
    for state, value in sorted(pool, key=lambda pair: pair[1]):
        if value > energy + temper * WITHIN or len(near) >= FROM_SEARCH:
            break
        state = state.copy()
        state.parents = final_parents(state)
        key = structure_key(state, matched_names(state, best.state, names))
        if key not in seen:
            seen.add(key)
            near.append(state)
    return near


def weighed_whole(
    rng: np.random.Generator, best: Refined, states: list[State], rules: Rules, steps: int
) -> list[Weighed]:
    """Return the Weighed of the states not pruned, by integrals over everything. steps : of each temperature and
    solid."""
    trials = [with_own_sensor(rng, trial, range(len(trial.state)), WORTHWHILE)
              for trial in climbed(rng, best, states, rules, steps, PROMISING)]  # fmt: skip
    trials = [trial for trial in trials if height(trial) > height(best) - PRUNE_THRESHOLD and all_seen(trial)]
    own, blocks = Block(best, None), [Block(trial, None) for trial in trials]
    if any(block.near > own.near - IMPROBABLE for block in blocks):
        own.evidence(rng)  # once, before others ask for it side by side
    return in_threads(rng, [partial(of_block, block=block, own=own) for block in blocks])


def climbed(
    rng: np.random.Generator, best: Refined, states: list[State], rules: Rules, steps: int, within: float
) -> list[Refined]:
    """Return the Refined of those states whose modes are within so many nats of the best's."""
    task = partial(at_mode, floor_pose=floor_pose_of(best), sensor=best.sensor, rules=rules, steps=steps,
                   least=best.log_prior + best.log_likelihood - HOPELESS)  # fmt: skip
    trials = in_threads(rng, [partial(task, state=new) for new in states])
    return [trial for trial in trials if height(trial) > height(best) - within]


def combinations(rng: np.random.Generator, best: Refined, others: list[Weighed], rules: Rules) -> list[Weighed]:
    """Return the Weighed of structures that make several of the changes of single solids among the Weighed of others,
    each climbed and weighed as a whole: solids that touch or hide each other are not independent."""
    tasks = [partial(combined, best=best, changes=changes, rules=rules) for changes in likeliest_of(others)]
    return [found for found in in_threads(rng, tasks) if found is not None]


def likeliest_of(others: list[Weighed]) -> list[Changes]:
    """Return the combinations of two and more changes, each of another solid, whose odds would be at least -CLOSE."""
    single: dict[int, list[tuple[int, Weighed]]] = {}
    for each in others:
        if each.places is not None and len(each.places[0]) == 1 and each.places[0] == each.places[1]:
            if abs(each.odds) < CLOSE:
                (k,) = each.places[0]
                single.setdefault(k, []).append((k, each))
    open_most = sorted(single.values(), key=lambda changes: max(each.odds for _, each in changes), reverse=True)
    choices = product(*([None, *changes] for changes in open_most[:MOST_COMBINED]))
    found = [tuple(change for change in choice if change is not None) for choice in choices]
    found = [changes for changes in found if len(changes) > 1 and odds_apart(changes) > -CLOSE]
    return sorted(found, key=odds_apart, reverse=True)[:MOST_COMBINED]


def odds_apart(changes: Changes) -> float:
    """Return the log odds of changes that tell nothing of each other."""
    return sum(each.odds for _, each in changes)


def combined(rng: np.random.Generator, best: Refined, changes: Changes, rules: Rules) -> Weighed | None:
    """Return the Weighed of a structure with all these changes of single solids; None: it is far below the best."""
    state = best.state
    for k, each in changes:
        state = state.replaced(k, each.trial.state[k])
    solids = sorted(k for k, _ in changes)
    trial = tried(rng, best, state, solids, rules)
    return None if trial is None else of_block(rng, Block(trial, solids), Block(best, solids))
