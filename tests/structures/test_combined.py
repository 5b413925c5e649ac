"""What each of several solids leaves open is open for all of them together."""

import numpy as np
from test_structure_weights import RULES, mode_of, whole_odds

from derender.detection.search.greedy import Settings
from derender.structures.alternatives import MOST_COMBINED, combinations, likeliest_of, odds_apart
from derender.structures.graph_posterior import DrawsOfOne, weighed_structures
from derender.structures.weighing import CLOSE, Weighed

NOISE = 0.04  # metres, in which a cube of 6 cm may as well be a box


def two_cubes():
    """Return the Refined of two cubes apart that show so noisily that either may be a box."""
    return mode_of(NOISE, (-0.08, 0.0, (0.06, 0.06, 0.06), True), (0.09, 0.03, (0.06, 0.06, 0.06), True))


def test_structures_with_two_changes_are_as_probable_as_both_make_them():
    best, settings = two_cubes(), Settings(shapes=("box", "cube"))
    made = DrawsOfOne(1, 40)
    found = weighed_structures(np.random.default_rng(1), best, 0.0, [], settings, made)
    odds = {tuple(trial.state.cubes): (log, error) for trial, log, _, error in found if len(trial.state) == 2}
    assert len(odds) == 4  # each is a cube or a box
    (both, error), (neither, _) = odds[False, False], odds[True, True]
    apart = both + neither - odds[True, False][0] - odds[False, True][0]  # 0: one tells nothing of the other
    assert abs(apart) < 3.0 * np.sqrt(sum(error**2 for _, error in odds.values())) + 0.5
    assert error < 1.0


def test_a_combination_is_weighed_as_the_whole_integrals_have_it():
    best = two_cubes()
    changes = [Weighed(best, -1.0, 0.1, ((k,), (k,))) for k in (0, 1)]
    for k, each in enumerate(changes):
        state = best.state.copy()
        state.cubes[k] = False
        changes[k] = each._replace(trial=best._replace(state=state))
    (found,) = combinations(np.random.default_rng(2), best, changes, RULES)
    assert found.trial.state.cubes == [False, False] and found.places == ((0, 1), (0, 1))
    assert abs(found.odds - whole_odds(found.trial, best)) < 1.0


def test_the_likeliest_combinations_of_changes_of_different_solids_are_tried():
    best = two_cubes()
    changes = [Weighed(best, odds, 0.1, ((k,), (k,))) for k in (0, 1, 2) for odds in (-1.0, -2.0, -4.5)]
    found = likeliest_of(changes)
    assert len(found) == MOST_COMBINED
    for chosen in found:
        assert len({k for k, _ in chosen}) == len(chosen) > 1
        assert odds_apart(chosen) > -CLOSE
    assert odds_apart(found[0]) == -2.0
    assert not likeliest_of([each for each in changes if each.places == ((0,), (0,))])


def test_many_solids_that_are_open_are_not_combined_in_every_way():
    """Forty solids of two changes each have 3**40 combinations: of the likeliest ones none is left out all the same."""
    best = two_cubes()
    changes = [Weighed(best, -0.1 * (k + 1), 0.1, ((k,), (k,))) for k in range(40) for _ in range(2)]
    found = likeliest_of(changes)
    assert len(found) == MOST_COMBINED
    assert {k for k, _ in found[0]} == {0, 1}
