"""A posterior about the best state: draws of all numbers under each structure, and the weights of the structures.

Where neighbouring pixels are the image's own and their noise is independent, and hardly anything shows but solids and
floor, the likelihood is the engine's, with the blur and the noise that the image shows (`draws/refined.py`), and
structures are weighed by integrals (`alternatives.py`).

On other images, such as those of real sensors, the search's own score has to do (`scored_posterior.py`).
"""

from functools import partial

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.search.greedy import total_energy
from derender.detection.solids.graph import names_of
from derender.detection.solids.naming import matched_names, structure_key
from derender.structures.alternatives import (
    WHOLE_DRAWS,
    from_search,
    of_one_solid,
    whole_evidence,
)
from derender.structures.draws.metropolis import log_evidence
from derender.structures.draws.refined import (
    WARM,
    at_mode,
    chains_of,
    floor_pose_of,
    only_draw,
    refine,
    structure_posterior,
    with_sensor_refitted,
)
from derender.structures.scored_posterior import MOST_PARTS, NEGLIGIBLE, part_of, posterior_parts
from derender.structures.unions import merges, recuts

MOST_MERGES, MOST_CUTS = 4, 3
AHEAD = 4  # solids whose changes are weighed side by side: in vain for those after one that leads to a better structure
WORTH_DRAWING = 0.01  # weight of a structure that gets draws of its own, not its mode alone
INDEPENDENT = 0.1  # correlation of neighbouring pixels' residuals up to which they count as independent
# By how much an image may be reduced: pixels are then sure to a fraction of a millimetre, so that the few that take the
# other side of an edge would outweigh a whole solid; the search's score cuts them off.
MOST_REDUCED = 2
MOST_BACKGROUND = 0.1  # share of the pixels that show what the engine does not know: the room behind a table


def parts_of(rng, seen, state, pool, settings, chains=2, draws=100, only_best=False, closer=None):
    """Return the parts of the posterior about the search's best state.

    seen : Observation. pool : (state, energy) that the search came by. only_best : the mode of one structure alone.
    closer : Closer for a real sensor's draws, or None.
    """
    knowable = not seen.things and seen.background < MOST_BACKGROUND and seen.factor <= MOST_REDUCED
    if len(state) and seen.correlation < INDEPENDENT and knowable:
        return independent_parts(rng, seen, state, pool, settings, chains, draws, only_best)
    if only_best:
        return [part_of(rng, seen, closer, state, settings, names_of(state), 1.0, 1, 1)]
    return posterior_parts(rng, seen, closer, state, pool, settings, chains, draws)


def independent_parts(rng, seen, state, pool, settings, chains, draws, only_best):
    """Return the parts where pixels are independent: full chains for the likeliest, short ones for the others."""
    first = refine(rng, seen, state, settings.rules)
    if only_best:
        return [structure_posterior(first, names_of(first.state), 1.0, [only_draw(first)])]
    made: dict = {}

    def own_evidence(rng, refined):
        """Return its evidence from the draws that it will need anyway, should it stay the best."""
        made["of"], made["draws"] = refined, chains_of(rng, refined, chains, draws)
        return log_evidence(made["draws"], list(range(len(refined.values))))

    evidence = own_evidence if chains * draws >= WHOLE_DRAWS else whole_evidence
    energy = total_energy(seen.image, state, settings)
    kept = weighed_structures(rng, first, energy, pool, settings.rules, evidence, settings.shapes)
    kept = [each for each in kept if each[1] > -NEGLIGIBLE][:MOST_PARTS]
    weights = np.exp([odds - kept[0][1] for _, odds, _ in kept])
    weights /= weights.sum()
    parts = []
    for place, ((trial, _, own), weight) in enumerate(zip(kept, weights, strict=True)):
        if place == 0:
            drawn = made["draws"] if made.get("of") is trial else chains_of(rng, trial, chains, draws)
        elif weight > WORTH_DRAWING and len(trial.state):
            trial = at_mode(rng, trial.state, floor_pose_of(trial), trial.sensor, settings.rules, temperatures=WARM)
            drawn = chains_of(rng, trial, 1, max(draws // 5, 2))
        else:
            drawn = [only_draw(trial)]
        parts.append(structure_posterior(trial, own, float(weight), drawn))
    return parts


def weighed_structures(rng, first, energy, pool, rules, evidence=whole_evidence, shapes=()):
    """Return (Refined, log odds, names) of the structures that the search met and of those one step from the best.

    The likeliest comes first, with odds 0; a solid has the same name in all.

    first : Refined of the search's best state. energy : the search's of it. pool : (state, energy) that it came by.
    evidence : of the first, see `whole_evidence`. shapes : names of those that a solid may have instead of its own.
    """
    best, others = leading(first, from_search(rng, first, pool, energy, rules, evidence))
    for _ in range(MOST_MERGES):
        former = best
        best, others = leading(best, [*others, *merges(rng, best, rules)])
        if best is former:
            break
    for _ in range(MOST_CUTS):
        former = best
        best, others = leading(best, [*others, *recuts(rng, best, rules)])
        if best is former:
            break
    for _ in range(2):  # a second time where the first has led to a better one: the odds are to be against that
        former = best
        k = 0
        while k < len(best.state):  # it may lose one on the way
            ahead = range(k, min(k + AHEAD, len(best.state)))
            tasks = [partial(of_one_solid, best=best, i=i, rules=rules, shapes=shapes) for i in ahead]
            for weighed in in_threads(rng, tasks):
                k, against = k + 1, best
                best, others = leading(best, [*others, *weighed])
                if best is not against:  # what the next solids' changes were weighed against
                    break
        if best is former:
            break
    if best is not first:
        best = with_sensor_refitted(rng, best)
    names = names_of(best.state)
    found = {structure_key(best.state, names): (best, 0.0, names)}
    for trial, odds in others:
        own = matched_names(trial.state, best.state, names)
        key = structure_key(trial.state, own)
        if key not in found or odds > found[key][1]:
            found[key] = (trial, odds, own)
    return sorted(found.values(), key=lambda each: -each[1])


def leading(best, others):
    """Return the likeliest of the best and the (Refined, log odds) of others, and the rest with odds against it."""
    better, odds = max(others, key=lambda pair: pair[1], default=(None, 0.0))
    if odds <= 0.0:
        return best, others
    return better, [(t, o - odds) for t, o in [*others, (best, 0.0)] if t is not better]
