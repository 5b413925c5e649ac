"""What one search and one weighing leave in doubt is weighed again, together with what the first came by."""

import time

import numpy as np
import pytest
from test_structure_weights import RULES, mode_of

import derender.structures.graph_posterior as room
import derender.structures.infer as infer
from derender.detection.search.greedy import Settings
from derender.document import LikelihoodPrior
from derender.structures.alternatives import unclimbed
from derender.structures.draws.refined import floor_pose_of, height
from derender.structures.draws.sensor import RATES
from derender.structures.options import Options
from derender.structures.weighing import CLOSE, Weighed
from worlds.made_scenes import drawn_scene

NOISE = 0.04  # metres, in which a cube of 6 cm may as well be a box
SMALL = 992049  # seed of a scene of two stacked cubes that show in 33 pixels, in noise of 6 mm
TALL = 980000  # seed of a scene where a cube on a box is first taken for one tall box, and the rest for outliers
SETTINGS = Settings(shapes=("box", "cube"))


def cube(noise=NOISE):
    """Return the Refined of a cube that shows so noisily that it may be a box, or clearly."""
    return mode_of(noise, (0.0, 0.0, (0.06, 0.06, 0.06), True))


def two_of(best):
    """Return what a State's `add` takes of a cube's twin."""
    row, form, is_cube, parent, bottom = best.state[0]
    return row.copy(), form, is_cube, parent, bottom


def weighings(monkeypatch, best, odds, again, until=None, agreed=True, pixels=100.0, spots=(), two=False):
    """Return what `weighed_structures` is asked for, as (state begun from, which of those met are cubes), where the
    first finds a cube and a box, or two cubes, of these odds."""
    calls = []
    box = best.state.add(*two_of(best)) if two else best.state.copy()
    box.cubes[0] = two
    names = [f"cube_{k + 1}" for k in range(len(box))]
    kept = [(best, 0.0, ["cube_1"], 0.0), (best._replace(state=box), odds, names, 0.1)]

    def weighed(rng, first, energy, pool, settings, made, met=()):
        calls.append((first.state, [tuple(state.cubes) for state in met]))
        return kept

    told = {"pixels": [pixels], "spots": list(spots)}
    monkeypatch.setattr(room, "weighed_structures", weighed)
    monkeypatch.setattr(room, "shown_and_left", lambda trial: told)
    settings = SETTINGS._replace(until=until)
    room.independent_parts(np.random.default_rng(0), best, 0.0, [], settings, 1, 2, False, again, agreed)
    return calls


def inferred(monkeypatch, scene, again, seed):
    """Return the Posterior of a scene, weighed again where in doubt, or never."""
    _, image, _, camera = drawn_scene(scene, "tabletop", (64, 48), 0.006)
    if not again:
        whole = room.independent_parts
        monkeypatch.setattr(room, "independent_parts", lambda *given: whole(*given[:8]))
    return infer.infer_structure(image, camera, Options(), np.random.default_rng(seed))


def of_one_solid(found):
    """Return the probability that one solid stands on the floor."""
    return sum(part.weight for part in found.parts if len(part.graph.solid_names) == 2)


def of_kind(best, is_cube, lower=0.0):
    """Return the cube's Refined as a cube or a box, its mode that much lower."""
    state = best.state.copy()
    state.cubes[0] = is_cube
    return best._replace(state=state, log_likelihood=best.log_likelihood - lower)


def test_odds_of_two_weighings_are_averaged_where_their_modes_are_as_high():
    best = cube()
    box, low = of_kind(best, False), of_kind(best, False, 2.0)
    now = [(best, 0.0, ["cube_1"], 0.0), (box, -1.0, ["cube_1"], 0.2)]
    (_, zero, _, none), (trial, odds, _, error) = room.of_both(now, [*now[:1], (box, -1.2, ["cube_1"], 0.2)])
    assert (zero, none) == (0.0, 0.0) and trial is box
    assert odds == pytest.approx(-1.1) and error == pytest.approx(0.2 / np.sqrt(2.0))
    # by a first one whose likeliest is the box, the cube is .6 against it: so the box is -.6 against the cube
    other_way = [(box, 0.0, ["cube_1"], 0.0), (best, 0.6, ["cube_1"], 0.1)]
    (_, odds, _, error) = room.of_both(now, other_way)[1]
    assert odds == pytest.approx(-0.6 - 0.4 * 0.2) and error > 0.1 / np.sqrt(1.25)  # more than both say: they differ
    assert room.of_both(now, [*now[:1], (low, -3.0, ["cube_1"], 0.1)]) == now  # whose mode was missed says nothing
    assert room.of_both(now, [(low, 0.0, ["cube_1"], 0.0)]) == now
    (leader, zero, _, _), *_ = room.of_both(now, [*now[:1], (box, 1.5, ["cube_1"], 0.05)])
    assert leader is box and zero == 0.0


@pytest.mark.slow
def test_a_sure_answer_of_few_pixels_gives_way_to_what_a_second_weighing_finds(monkeypatch):
    seed = [SMALL, 8]  # the one of four whose first weighing finds no other mode
    assert of_one_solid(inferred(monkeypatch, SMALL, True, seed)) < 0.5
    assert of_one_solid(inferred(monkeypatch, SMALL, False, seed)) > 0.9


def test_what_leaves_doubts_is_weighed_again_with_what_the_first_came_by(monkeypatch):
    best, other = cube(), cube(0.001)
    far, close = -room.NEGLIGIBLE, -1.0
    once = [(best.state, [])]
    assert weighings(monkeypatch, best, far, lambda: other) == once
    assert weighings(monkeypatch, best, close, None) == once  # nothing to search by
    assert weighings(monkeypatch, best, close, lambda: other) == [*once, (best.state, [(False,)])]
    few = {"pixels": room.FEW_TO_CLIMB - 1.0}
    assert weighings(monkeypatch, best, far, lambda: other, **few) == once  # it is as sure as can be
    assert weighings(monkeypatch, best, close, lambda: other, **few)[1:] == [(other.state, [(True,), (False,)])]
    for doubt in ({"agreed": False}, {"two": True}, {"spots": [(0, 0)]}):
        assert weighings(monkeypatch, best, far, lambda: other, **doubt) == [*once, (other.state, [(True,)])]
        assert weighings(monkeypatch, best, far, lambda: None, **doubt) == [*once, (best.state, [])]
        assert weighings(monkeypatch, best, far, lambda: other, until=time.monotonic() - 1.0, **doubt) == once


@pytest.mark.parametrize(("name", "fewest", "share"), [("outlier", RATES[0], 0.001), ("flying", 0.0, 0.1)])
def test_pixels_taken_for_outliers_leave_a_doubt_unless_their_share_is_known(monkeypatch, name, fewest, share):
    best, other = cube(), cube(0.001)
    once, twice = [(best.state, [])], [(best.state, []), (other.state, [(True,)])]
    for told, known, expected in ((share, {}, twice), (share, {name: share}, once), (fewest, {}, once)):
        sensor = best.sensor._replace(prior=LikelihoodPrior("robust", known))
        sensor = sensor._replace(values={**sensor.values, name: told})
        found = weighings(monkeypatch, best._replace(sensor=sensor), -room.NEGLIGIBLE, lambda: other)
        assert found == expected


@pytest.mark.slow
def test_a_sure_answer_that_leaves_outliers_gives_way_to_what_another_search_finds(monkeypatch):
    again, once = (inferred(monkeypatch, TALL, way, TALL).parts[0] for way in (True, False))
    assert once.weight > 0.99 and "cube_1" not in once.graph.solid_names
    assert again.weight < 0.99 and "cube_1" in again.graph.solid_names


def test_what_another_search_finds_is_brought_to_its_mode(monkeypatch):
    asked = []
    whole = room.parts_of
    monkeypatch.setattr(room, "parts_of", lambda *given: asked.append(given[-1]) or whole(*given[:-1]))
    _, image, _, camera = drawn_scene(992014, "tabletop", (64, 48), 0.006)
    infer.infer_structure(image, camera, Options(quick=True, method="map"), np.random.default_rng(0))
    found = asked[0]()
    assert len(found.state) and np.isfinite(height(found))


def test_structures_that_another_weighing_came_by_are_weighed_and_the_higher_mode_is_begun_from():
    best = cube()
    box, aside = best.state.copy(), best.state.copy()
    box.cubes[0] = False
    aside.rows[0, 10] += 0.004  # metres beside the mode
    low = unclimbed(aside, floor_pose_of(best), best.sensor, RULES)
    first, others = room.with_met(np.random.default_rng(0), low, [best.state, box], RULES)
    assert height(first) > height(low) + 1.0
    assert [tuple(each.trial.state.cubes) for each in others] == [(False,)]
    found = room.weighed_structures(np.random.default_rng(1), low, 0.0, [], SETTINGS, met=[box])
    assert {tuple(trial.state.cubes) for trial, *_ in found} >= {(True,), (False,)}


def test_what_is_near_a_close_rival_of_more_solids_is_weighed_too():
    best = mode_of(NOISE, (0.0, 0.0, (0.06, 0.06, 0.06), True), (0.13, 0.05, (0.02, 0.02, 0.02), True))
    alone = unclimbed(best.state.without(1), floor_pose_of(best), best.sensor, RULES)
    close, far = Weighed(best, -1.0, 0.1), Weighed(best, -CLOSE - 1.0, 0.1)
    found = room.about_rival(np.random.default_rng(0), alone, [close], RULES, ("box", "cube"))
    kinds = {tuple(each.trial.state.cubes) for each in found}
    assert {(True, True), (False, True), (True, False)} <= kinds
    assert not room.about_rival(np.random.default_rng(0), alone, [far], RULES, ("box", "cube"))
