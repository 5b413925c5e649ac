"""Changes of one solid and unions of two are weighed as the integral over everything weighs them.

The odds of a change come from integrals over the coordinates that it touches, the rest held at the mode. Here each is
held against the difference of the whole integrals of the two structures, which knows of no such shortcut.
"""

import functools
import math

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.document import read_prior_document
from derender.render.likelihoods import likelihoods
from derender.sampling.evidence import Evidence
from derender.scene.pose import rotation_x, rotation_z
from derender.scene.solids import BOX
from derender.structures import alternatives, weighing
from derender.structures.alternatives import QUICK, from_search, of_one_solid, weighed_whole
from derender.structures.draws import metropolis
from derender.structures.draws.chart import ROW, log_prior, make_chart, place_rows
from derender.structures.draws.metropolis import log_evidence, sample
from derender.structures.draws.refined import at_mode, near_evidence
from derender.structures.draws.sensor import Sensor, model_depth
from derender.structures.unions import as_one, merged
from derender.structures.weighing import NEAR_ERROR, evidence_over

RULES = Rules(0.0015)
VIEW = Camera(45.0, 45.0, 23.5, 17.5, 48, 36)
WITHIN = 3.0  # nats: both integrals are estimates; the volume of one solid's coordinates is 15 and more


def chart_of(*boxes):
    """Return (state, floor pose, chart, values) of upright boxes (x, y, size, is cube) on the floor."""
    pose = rotation_x(math.pi / 2 + 0.7)
    pose[2, 3] = 0.6
    turned, state = rotation_z(0.3)[:3, :3], State()
    for x, y, size, cube in boxes:
        place = turned @ [x, y, size[2] / 2]
        state = state.add(make_row(BOX, turned, place, np.array(size)), UPRIGHT, cube, FLOOR, 0.0)
    return state, pose, *make_chart(state, pose, RULES)


def mode_of(sigma, *boxes):
    """Return the Refined of boxes at the mode for a noisy image of themselves."""
    state, pose, chart, values = chart_of(*boxes)
    likelihood, rng = likelihoods["gaussian"], np.random.default_rng(4)
    numbers = likelihood.complete({"sigma": sigma})
    sensor = Sensor(VIEW, likelihood.sample(rng, model_depth(chart, values, VIEW), numbers), likelihood, numbers)
    return at_mode(rng, state, pose, sensor, RULES)


def whole_odds(trial, best):
    """Return the log odds by importance sampling over all coordinates."""
    logs = []
    for chart, values, sensor in ((each.chart, each.values, each.sensor) for each in (trial, best)):
        rng, members = np.random.default_rng(5), list(range(len(values)))
        (drawn,) = sample(rng, chart, sensor, values, 1, 600, 20, members)
        found = log_evidence(rng, chart, sensor, values, drawn.values, members)
        assert found.standard_error < 0.5
        logs.append(found.log + sensor.log_prior())
    return logs[0] - logs[1]


@functools.cache
def small_beside_large():
    """A cube that shows plainly and one that shows so little that it may not be there."""
    return mode_of(0.05, (-0.05, 0.0, (0.09, 0.09, 0.09), True), (0.08, 0.03, (0.04, 0.04, 0.04), True))


def test_a_solid_is_taken_away_by_the_integral_over_its_coordinates():
    best = small_beside_large()
    found = of_one_solid(np.random.default_rng(6), best, 1, RULES)
    both = [each for each in found if len(each.trial.state) == 1]
    assert sorted(each.places is None for each in both) == [False, True], "with the rest as it is, and with all free"
    for removed in both:
        assert abs(removed.odds - whole_odds(removed.trial, best)) < WITHIN


@pytest.mark.parametrize("first, kept", [(80.0, True), (5000.0, False)])
def test_a_change_whose_first_climb_ended_beside_its_mode_is_climbed_again(monkeypatch, first, kept):
    """One that ended 88 nats below the best was pruned, and 4 below it where others ended: the truth was among such."""
    best, below = small_beside_large(), [first, 3.0, 90.0]

    def climb(*given, **how):
        return best._replace(log_likelihood=best.log_likelihood - below.pop(0))

    monkeypatch.setattr(alternatives, "at_mode", climb)
    found = alternatives.tried(np.random.default_rng(8), best, best.state, [1], RULES)
    assert (found is not None) == kept and len(below) == (0 if kept else 2)  # what is hopeless costs one climb


def test_a_hot_walk_ends_where_it_is_hopeless_and_goes_on_where_it_comes_nearer(monkeypatch):
    """Both changes begin tens of thousands of nats below the best, where half of all climbs stayed."""
    best = mode_of(0.001, (-0.05, 0.0, (0.09,) * 3, True), (0.08, 0.03, (0.06,) * 3, True))
    least = best.log_prior + best.log_likelihood - alternatives.HOPELESS

    def moved(by):
        row = best.state.rows[1].copy()
        row[10] += by
        return best.state.changed(1, row=row)

    def climbed(by, least):
        rng = np.random.default_rng(8)
        return at_mode(rng, moved(by), best.chart.floor, best.sensor, RULES, QUICK, [1], least=least)

    near = alternatives.unclimbed(moved(0.012), best.chart.floor, best.sensor, RULES)
    assert near.log_prior + near.log_likelihood < least - 2.0 * alternatives.HOPELESS
    there = climbed(0.012, least)
    assert there.log_prior + there.log_likelihood > least
    assert np.array_equal(there.values, climbed(0.012, -np.inf).values)

    def never(*given):
        raise AssertionError("it went on")

    monkeypatch.setattr(metropolis, "Curvature", never)
    assert alternatives.tried(np.random.default_rng(8), best, moved(0.2), [1], RULES) is None


def test_an_integral_that_failed_gives_way_to_the_normal_about_the_mode(monkeypatch):
    """Draws of two modes can be a hundred nats off, with an error that says so: no structure leads by that."""
    best = small_beside_large()
    fewer, rng = best.state.without(1), np.random.default_rng(8)
    (fair,) = weighed_whole(rng, best, [fewer], RULES, QUICK)

    def failed(rng, refined, places):
        found, draws = evidence_over(rng, refined, places)
        wrong = 100.0 if places is None and len(refined.state) == 1 else 0.0
        return Evidence(found.log + wrong, 60.0), draws

    monkeypatch.setattr(weighing, "evidence_over", failed)
    (kept,) = weighed_whole(rng, best, [fewer], RULES, QUICK)
    assert abs(kept.odds - fair.odds) < 2.0 * NEAR_ERROR and kept.error == NEAR_ERROR


def test_an_integral_over_everything_has_what_a_normal_misses_of_each_solid():
    """Three integrals over all of both structures, of errors of .06, say -4.4 to -4.3; two normals alone say -6.0."""
    best = mode_of(0.01, (-0.08, 0.0, (0.06,) * 3, True), (0.09, 0.03, (0.06,) * 3, True))
    trial = at_mode(np.random.default_rng(3), best.state.changed(0, cube=False), best.chart.floor, best.sensor, RULES)
    found, own = (evidence_over(np.random.default_rng(1), each)[0] for each in (trial, best))
    assert found.log - own.log == pytest.approx(-4.35, abs=1.0)
    assert near_evidence(trial) - near_evidence(best) == pytest.approx(-6.0, abs=0.2)


def test_an_integral_that_is_sure_is_what_is_told(monkeypatch):
    """Not the normals about the modes, which are there before it."""
    best, shift = small_beside_large(), 20.0
    fewer = best.state.without(1)

    def surer(rng, refined, places):
        return Evidence(shift if len(refined.state) == 1 else 0.0, 0.1), None

    monkeypatch.setattr(weighing, "evidence_over", surer)
    (told,) = weighed_whole(np.random.default_rng(8), best, [fewer], RULES, QUICK)
    sensors = told.trial.sensor.log_prior() - best.sensor.log_prior()
    assert told.odds == pytest.approx(shift + sensors) and told.error == pytest.approx(math.hypot(0.1, 0.1))


def test_the_whole_has_of_each_solid_what_its_integral_has_more_than_a_normal():
    """Of a solid that shows so little a normal about the mode alone misses more than a nat."""
    best, seed = small_beside_large(), 9
    rng = np.random.default_rng(seed)
    more = sum(evidence_over(rng, best, (k,))[0].log - near_evidence(best, (k,)) for k in (0, 1))
    whole, _ = evidence_over(np.random.default_rng(seed), best)
    assert more > 1.0 and whole.log == pytest.approx(near_evidence(best) + more)


def test_two_boxes_are_one_by_the_integrals_over_both():
    best = mode_of(0.006, (-0.03, 0.0, (0.06, 0.06, 0.06), True), (0.03, 0.0, (0.06, 0.06, 0.06), True))
    union = merged(np.random.default_rng(7), best, as_one(best.state, 0, 1), 0, 1, RULES)
    assert len(union.trial.state) == 1
    assert abs(union.odds - whole_odds(union.trial, best)) < WITHIN


def prior_of(*boxes):
    """Return the log prior density of boxes."""
    state, _, chart, values = chart_of(*boxes)
    rows = np.empty((len(state), ROW))
    place_rows(chart, values, rows)
    return log_prior(chart, rows)


@pytest.mark.parametrize("cube", [True, False])
def test_one_solid_more_costs_what_the_prior_s_file_says(cube):
    """Solids to a square metre of floor, the share of its kind, standing upright, bearing nothing; its sizes; its turn,
    within a quarter for a box whose level edges may change names. To 0.01: sizes are read off a table."""
    prior = read_prior_document("bare-image").prior
    kind, size = ("cube", (0.07, 0.07, 0.07)) if cube else ("box", (0.05, 0.09, 0.07))
    law = prior.contacts.rules[0].values
    patch = np.prod([np.diff(law[axis].support)[0] for axis in ("x", "y")])
    shares = {name: shape.weight for name, shape in prior.shapes.items()}
    standing = prior.contacts.choices("plane", "box", "+z")[0].probabilities[("face-to-face", "+z", "-z")]
    bearing = prior.offspring[kind].log_density(0)
    expected = math.log(prior.offspring["floor"].mean() / patch * shares[kind] / sum(shares.values()) * standing)
    laws = prior.shapes[kind].free()
    expected += bearing + sum(laws[name].log_density(x) for name, x in zip(laws, size, strict=False))
    expected -= math.log(math.pi / 2.0)
    other = (-0.1, 0.0, (0.06, 0.06, 0.06), True)
    assert prior_of(other, (0.1, 0.0, size, cube)) - prior_of(other) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("temper, met", [(1.0, 0), (40.0, 1)])
def test_what_a_search_met_is_near_by_its_energy_in_nats(temper, met):
    """Where forty pixels count for one the search's energies are forty times as great, and 400 of them are ten nats."""
    best = mode_of(0.01, (-0.08, 0.0, (0.06, 0.06, 0.06), True))
    other = chart_of((-0.08, 0.0, (0.06, 0.06, 0.06), True), (0.09, 0.03, (0.05, 0.06, 0.03), False))[0]
    assert len(from_search(best, [(other, 1400.0)], 1000.0, temper)) == met
