"""What the best structure leaves unexplained is proposed as one solid more, and weighed."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_graph_posterior import camera, cube, floor_pose, observe, row

from derender.detection.background import cut_off
from derender.detection.search.greedy import Settings
from derender.detection.search.searches import Found, agree, search
from derender.detection.solids.beliefs import Rules, bare_image
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.scene.solids import BOX
from derender.structures.alternatives import QUICK, of_one_solid, unclimbed, weighed_whole
from derender.structures.answer import missed_by
from derender.structures.changes import raised
from derender.structures.draws.metropolis import SAME, engine_of, likelihood_without, load, log_evidence
from derender.structures.draws.refined import at_mode, members_of, pixels_of
from derender.structures.graph_posterior import shown_and_left
from derender.structures.infer import infer_structure
from derender.structures.unexplained import FAINT, additions, nearer_than_explained, spots, spots_left
from worlds.made_scenes import drawn_scene

RULES = Rules(0.0015)


def test_noise_alone_has_no_spots_and_a_few_nearer_pixels_have():
    rng = np.random.default_rng(0)
    assert sum(bool(spots(rng.standard_normal((48, 64)))) for _ in range(20)) <= 3
    nearer = rng.standard_normal((48, 64))
    nearer[10:13, 20:24] += 2.0  # none of these pixels stands out by itself
    nearer[30, 40] = np.nan
    (spot,) = spots(nearer)
    assert spot.strength > FAINT and np.argwhere(spot.shown).mean(axis=0).round().astype(int).tolist()[0] in (
        10,
        11,
        12,
    )
    mixed = rng.standard_normal((48, 64))
    mixed[20:22, 20:22] *= 4.0  # nearer and farther: what moved in front of something
    mixed[20, 20], mixed[21, 21] = 4.0, -4.0
    assert len(spots(mixed)) == 1


def test_what_flies_at_edges_is_explained_where_pixels_fly():
    clean = np.where(np.arange(40) < 20, 0.5, 0.8) * np.ones((30, 1))
    observed = np.where(np.abs(np.arange(40) - 19.5) < 1.0, 0.65, clean)
    numbers = {"sigma": 0.002, "blur": 0.0, "edge_step": 0.02}
    assert spots_left(clean, observed, numbers)
    assert not spots_left(clean, observed, {**numbers, "flying": 0.5})
    observed[10:13, 30:33] -= 0.1  # elsewhere nothing flies
    assert len(spots_left(clean, observed, {**numbers, "flying": 0.5})) == 1


def test_a_solid_that_shows_in_a_few_pixels_is_proposed_and_wins():
    rng = np.random.default_rng(1)
    both = cube(0.12).add(row(BOX, 0.2, 0.16, 0.05, 0.0, (0.04,) * 3), UPRIGHT, True, FLOOR, 0.0)
    sensor, _, _ = observe(rng, both, {"sigma": 0.006, "blur": 0.5}, camera(48, 36))
    best = at_mode(rng, cube(0.12), floor_pose(), sensor, RULES)
    found = weighed_whole(rng, best, additions(rng, best, Settings()), RULES, QUICK)
    assert max(each.odds for each in found) > 3.0
    likeliest = max(found, key=lambda each: each.odds)
    assert pixels_of(likeliest.trial)[1] < 12
    np.testing.assert_allclose(likeliest.trial.state.rows[1, 10:12], [0.16, 0.05], atol=0.03)
    whole = at_mode(rng, both, floor_pose(), sensor, RULES)
    clean = sensor.clean(whole.chart, whole.values)
    assert np.nanmax(np.abs(nearer_than_explained(clean, sensor.returned, whole.sensor.values))) < FAINT + 1.0
    assert additions(rng, whole, Settings()) == []
    assert additions(rng, best, Settings(max_objects=1)) == []
    assert additions(rng, best, Settings(reduced=True)) == []
    (place,) = shown_and_left(best)["spots"]  # the doubt about an answer without it says where it is
    np.testing.assert_allclose(place, [0.45, 0.6, 0.7, 0.85], atol=0.2)
    assert shown_and_left(whole)["spots"] == []


def test_a_box_whose_foot_hides_may_be_a_cube_on_what_nothing_shows():
    """It was told as a box of that height at P .995, whatever may be behind what hides it."""
    rng, eye = np.random.default_rng(3), -floor_pose()[:3, :3].T @ floor_pose()[:3, 3]
    before = 0.06 * eye[:2] / np.linalg.norm(eye[:2])
    tall = State().add(row(BOX, 0.0, 0.0, 0.0, 0.0, (0.06, 0.06, 0.11)), UPRIGHT, False, FLOOR, 0.0)
    both = tall.add(row(BOX, 0.0, *before, 0.0, (0.2, 0.03, 0.08)), UPRIGHT, False, FLOOR, 0.0)
    best = at_mode(rng, both, floor_pose(), observe(rng, both, {"sigma": 0.002}, camera(64, 48))[0], RULES)
    found = raised(best, 0, ("box", "cube"))
    assert {(each.cubes[0], each.cubes[2], each.parents[0]) for each in found} == {
        (one, other, 2) for one in (False, True) for other in (False, True)
    }
    weighed = [each for each in of_one_solid(rng, best, 0, RULES, ("box", "cube")) if len(each.trial.state) == 3]
    assert any(each.trial.state.cubes[0] and -8.0 < each.odds < 5.0 for each in weighed)
    alone = at_mode(rng, tall, floor_pose(), observe(rng, tall, {"sigma": 0.002}, camera(64, 48))[0], RULES)
    assert raised(alone, 0, ("box", "cube")) == []


def test_searches_go_on_while_something_hangs_in_the_air(monkeypatch):
    """Two searches that agree about a cube in the air have missed what bears it."""
    from derender.detection.search import searches

    made = []

    def one_search(rng, image, hypotheses, settings, early, state=None, shake=0.0):
        made.append(shake)
        state = cube()
        state.bottoms[0] = 0.0 if len(made) > 4 else np.nan
        return searches.Found(state, 10.0 - (len(made) > 4), image, [])  # the fifth has found it

    monkeypatch.setattr(searches, "one_search", one_search)
    monkeypatch.setattr(searches, "crossed", lambda rng, image, state, other, settings: state)
    state, _, agreed = search(np.random.default_rng(0), None, [], Settings(tries=2))
    assert len(made) == 6 and state.bottoms == [0.0] and agreed
    assert sum(shake > 0.0 for shake in made) == 3, (
        "of each pair one begins otherwise: else they agree in what they miss"
    )
    made.clear()
    search(np.random.default_rng(0), None, [], Settings(tries=2, may_float=True))
    assert len(made) == 2


def test_searches_agree_where_they_find_as_many_solids_as_well():
    on_top = cube().add(row(BOX, 0.2, 0.0, 0.0, 0.08, (0.04,) * 3), UPRIGHT, True, 0, 0.08)
    beside = cube().add(row(BOX, 0.2, 0.2, 0.0, 0.0, (0.04,) * 3), UPRIGHT, True, FLOOR, 0.0)
    one, *others = (Found(state, 10.0, None, []) for state in (cube(), on_top, beside))
    assert agree([one, one], Settings()) and not agree([one, one._replace(energy=99.0)], Settings())
    assert not any(agree([one, other], Settings()) for other in others) and not agree(others, Settings())
    assert agree(others, Settings(temper=4.0))  # of a real sensor's image it is enough that they are as good


def test_only_before_a_room_does_what_the_border_cuts_count_as_background():
    """A tower whose top the image does not show is a solid where no wall can be behind it."""
    mask = np.zeros((20, 30), bool)
    mask[:8, 10:15] = True
    points = np.zeros((20, 30, 3))
    points[..., 0] = 0.01 * np.arange(30)
    frame = 0, 19, 0, 29
    assert cut_off(points, mask, frame) and not cut_off(points, mask, frame, real=False)
    wide = np.zeros((20, 30), bool)
    wide[:3] = True
    assert cut_off(3.0 * points, wide, frame, real=False)


def test_no_answer_is_surer_than_the_search():
    """What a search may have missed is more where two disagree, something is left that no solid explains, solids show
    in few pixels, or a real sensor's image is not explained."""
    missed = bare_image().loose.missed

    def told(part=None, explained=1.0, **seen):
        part = {"spots": [], "pixels": [300.0]} if part is None else part
        half, none = np.arange(10) < 5, np.zeros(10, bool)
        seen = SimpleNamespace(**{"correlation": 0.0, "agreed": True, "no_floor": False, "other_floors": (),
                                  "behind": none, "floor": SimpleNamespace(inliers=half), **seen})  # fmt: skip
        return missed_by((seen,), part, missed, explained)

    assert told() == pytest.approx(missed.settled, abs=1e-6) and told(explained=0.9) == told()
    assert told({"spots": [[0.1, 0.2, 0.5, 0.6]], "pixels": [300.0]}) == pytest.approx(missed.open, abs=1e-6)
    assert told({"pixels": [300.0], "weighed": False}) == pytest.approx(missed.unweighed, abs=1e-6)  # by --method map
    assert told(agreed=False) == pytest.approx(missed.open, abs=1e-6)
    most = (
        np.arange(10) < 9
    )  # a table before a floor that was found farther away: that there is nothing was said at .995
    assert told(behind=most) == told(no_floor=True) and told(behind=np.arange(10) < 4) == told()
    assert told(no_floor=True) == pytest.approx(missed.no_floor, abs=1e-6) and missed.no_floor > missed.open
    one = missed.few * np.exp(-30.0 / missed.pixels)
    several = told({"spots": [], "pixels": [30.0, 300.0, 30.0]})
    assert several == pytest.approx(1.0 - (1.0 - missed.settled) * (1.0 - one) ** 2, abs=1e-6)
    assert told(correlation=0.9) == pytest.approx(missed.sensor, abs=1e-6)
    assert told(correlation=0.9, explained=1.0 - missed.unexplained) == pytest.approx(
        1.0 - (1.0 - missed.sensor) / np.e, abs=1e-6
    )


@pytest.mark.parametrize("seed, size, sigma", [(998554, None, None), (998054, (64, 48), 0.006)])
def test_what_no_pixel_tells_of_is_no_object(seed, size, sigma):
    """With a solid in three pixels at the image's border, that tell 2 nats of it, the answer was sure and wrong: its
    integral went on over all the floor outside the image."""
    _, image, _, eye = drawn_scene(seed, "tabletop", size, sigma)
    posterior = infer_structure(image, eye, rng=np.random.default_rng([seed, 7]))
    assert len(posterior.best_graph().solid_names) == 2 and posterior.best_part.weight > 0.9  # the floor, and one solid


def test_an_integral_is_where_a_solid_shows():
    """A second cube in the view's corner: moved out of it, it would have an endless floor to be on."""
    rng = np.random.default_rng(3)
    both = cube(0.12).add(row(BOX, 0.2, 0.16, 0.05, 0.0, (0.04,) * 3), UPRIGHT, True, FLOOR, 0.0)
    sensor, chart, values = observe(rng, both, {"sigma": 0.006, "blur": 0.5}, camera(48, 36))
    alone = unclimbed(both.without(1), floor_pose(), sensor, RULES)
    assert likelihood_without(engine_of(chart, sensor), chart, values, 1) == pytest.approx(
        alone.log_likelihood, abs=1e-6
    )
    assert sum(load(engine_of(chart, sensor), chart, values)[1:]) > alone.log_likelihood + SAME
    members = members_of(chart, [1])
    draws = np.tile(values, (200, 1))
    draws[:, members] += rng.normal(size=(200, len(members))) * 0.3  # mostly where it does not show
    everywhere = log_evidence(np.random.default_rng(0), chart, sensor, values, draws, members)
    seen = log_evidence(np.random.default_rng(0), chart, sensor, values, draws, members, 1)
    assert everywhere.log > seen.log + 5.0  # 17 nats here, most of it where the image tells nothing of the cube
