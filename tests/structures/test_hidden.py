"""Solids that nothing shows: what is said to be out of sight changes no pixel, and the prior's are drawn as it says."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_graph_posterior import camera, floor_pose, row

from derender.detection.floor import floor_depth
from derender.detection.solids.beliefs import Rules, bare_image
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.scene.solids import BOX
from derender.structures.draws.chart import make_chart
from derender.structures.draws.sensor import Sensor, model_depth
from derender.structures.unexplained import drawn_extents, drawn_rows, hidden_expected, out_of_sight, rate_on_floor

VIEW = camera(96, 72)


def wide_box(height=0.2):
    return State().add(row(BOX, 0.0, 0.0, 0.05, 0.0, (0.4, 0.05, height)), UPRIGHT, False, FLOOR, 0.0)


def test_what_is_out_of_sight_changes_no_pixel_and_the_rest_does():
    rng, state = np.random.default_rng(0), wide_box()
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    depth = model_depth(chart, values, VIEW)
    places = np.column_stack([rng.uniform(-0.2, 0.2, 300), rng.uniform(-0.4, 0.4, 300), np.zeros(300)])
    drawn = drawn_rows(rng, places, bare_image())
    hidden = out_of_sight(drawn, floor_pose(), VIEW, depth)
    assert 5 < hidden.sum() < 200
    shown = []
    for each in drawn:
        both = state.add(each, UPRIGHT, False, FLOOR, 0.0)
        chart, values = make_chart(both, floor_pose(), Rules(0.0015))
        shown.append(bool((model_depth(chart, values, VIEW) < depth - 1e-9).any()))
    shown = np.array(shown)
    assert not (hidden & shown).any()
    # Points of a box stand for all of it, with a margin: of what changes no pixel some few do not count.
    inside = np.abs(places[:, 0]) < 0.1
    assert (hidden | shown)[inside].mean() > 0.9


def test_more_is_expected_behind_a_higher_box_and_nothing_where_all_is_seen():
    rng = np.random.default_rng(1)

    class Found:
        def __init__(self, state):
            self.state = state
            self.chart, self.values = make_chart(state, floor_pose(), Rules(0.0015))
            self.sensor = Sensor(VIEW, model_depth(self.chart, self.values, VIEW), None, {})

    low, high = (hidden_expected(rng, Found(wide_box(height))) for height in (0.06, 0.3))
    assert 0.0 <= low < 0.5 * high
    assert hidden_expected(rng, Found(State())) == 0.0


def test_nothing_is_expected_farther_away_than_floor_is_seen():
    chart, values = make_chart(wide_box(0.3), floor_pose(), Rules(0.0015))
    depth = model_depth(chart, values, VIEW)
    behind = floor_depth(floor_pose(), VIEW) > depth + 0.01
    in_front = depth < floor_depth(floor_pose(), VIEW)[behind].min()

    def expected(observed):
        found = SimpleNamespace(state=wide_box(0.3), chart=chart, values=values)
        found.sensor = Sensor(VIEW, observed, None, {})
        return hidden_expected(np.random.default_rng(1), found)

    assert expected(depth) > 0.0
    assert expected(np.where(in_front, depth, np.nan)) == 0.0


def test_what_a_floor_shows_corrects_how_many_solids_the_prior_expects_on_it():
    beliefs = bare_image()
    prior = rate_on_floor(beliefs, 0, 0.0)
    assert abs(prior - 24.0) < 1e-6  # a square metre, as data/priors/bare-image.yaml says
    assert rate_on_floor(beliefs, 4, 4.0 / prior) == pytest.approx(prior)  # as many as expected
    assert rate_on_floor(beliefs, 6, 1e4) == pytest.approx(7e-4, rel=1e-2)
    sure = beliefs._replace(loose=replace(beliefs.loose, crowding=1e6))  # the file's number, whatever is seen
    assert rate_on_floor(sure, 6, 4.0) == pytest.approx(prior, rel=1e-3)


def test_what_stands_on_another_solid_says_nothing_of_how_crowded_a_floor_is():
    """A small cube on a wide box hides next to nothing more of the floor."""
    lone, numbers = wide_box(), []
    tower = lone.add(row(BOX, 0.0, 0.0, 0.05, 0.2, (0.03,) * 3), UPRIGHT, True, 0, 0.2)
    for state in (lone, tower):
        chart, values = make_chart(state, floor_pose(), Rules(0.0015))
        sensor = Sensor(VIEW, model_depth(chart, values, VIEW), None, {})
        found = SimpleNamespace(state=state, chart=chart, values=values, sensor=sensor)
        numbers.append(hidden_expected(np.random.default_rng(1), found))
    assert numbers[1] == pytest.approx(
        numbers[0], rel=0.3
    )  # counted as one more on the floor it made half as many more


def test_extents_are_drawn_as_their_table_says():
    rng, beliefs = np.random.default_rng(2), bare_image()
    drawn = np.log(drawn_extents(rng, beliefs.sizes[BOX, 0], 20_000))
    # data/priors: log-normal about 8.5 cm with a log spread of .45; four standard errors of mean and spread.
    assert abs(drawn.mean() - np.log(0.085)) < 4 * 0.45 / np.sqrt(20_000) + 0.01
    assert abs(drawn.std() - 0.45) < 4 * 0.45 / np.sqrt(2 * 20_000) + 0.01
