"""What chains say of a posterior, and how many draws would do; probabilities said no finer than their error."""

from types import SimpleNamespace

import numpy as np
import pytest

from derender.report.tables import parameter_rows
from derender.results.table import probability_text
from derender.results.trust import (
    FITS,
    Doubt,
    chain_doubts,
    doubtful,
    enough_draws,
    judgement,
    limits,
    trusted,
    verdict,
)


def chains(correlation, draws, rng, count=2):
    """Return (count, draws, 1) of stationary first-order chains."""
    values = np.empty((count, draws, 1))
    values[:, 0] = rng.standard_normal((count, 1))
    for k in range(1, draws):
        values[:, k] = correlation * values[:, k - 1] + np.sqrt(1 - correlation**2) * rng.standard_normal((count, 1))
    return values


@pytest.mark.slow
@pytest.mark.parametrize("correlation, draws", [(0.97, 100), (0.9, 300)])
def test_so_many_draws_as_are_said_would_do(correlation, draws):
    """Of chains that are run as long as was said most hold the limits, with not twenty times as many as needed."""
    rng, good, said = np.random.default_rng(0), 0, []
    for _ in range(20):
        rows = parameter_rows(["a.x"], chains(correlation, draws, rng))
        said.append(enough_draws(rows))
        longer = parameter_rows(["a.x"], chains(correlation, said[-1], rng))
        good += not doubtful(longer[0])
    assert good >= 14
    enough = 100 * (1 + correlation) / (1 - correlation) / 2  # draws of each of two chains worth 100 together
    assert np.median(said) < 20 * enough


def test_good_chains_need_no_more_than_they_have_and_a_margin():
    rows = parameter_rows(["a.x"], np.random.default_rng(1).standard_normal((2, 200, 1)))
    assert not doubtful(rows[0]) and enough_draws(rows) == 500
    assert limits(999) != limits(1000)


def seen_by_a_sensor(faces):
    """Return what stands for a posterior of a box of 12 by 16 by 0 cm, 10 cm from its middle to its corners."""
    body = SimpleNamespace(size=lambda: np.array([0.12, 0.16, 0.0]))
    graph = SimpleNamespace(names=("box_1",), body=lambda name: body, vertices=())
    part = SimpleNamespace(values=np.zeros((2, 100, 1)), extras={}, graph=graph)
    return SimpleNamespace(meta={"faces": faces}, best_part=part, object_probability=lambda name: 0.97)


def test_a_field_of_view_that_was_guessed_is_told_with_the_answer():
    posterior = seen_by_a_sensor(0.0)
    assert not chain_doubts(posterior, [])
    posterior.meta["camera_guessed"] = True
    (doubt,) = chain_doubts(posterior, [])
    assert "no camera was given" in doubt.words and not doubt.serious and not doubt.about


@pytest.mark.parametrize(
    "count, known, clutter, expected",
    [(3, 0.7, (), True), (1, 0.55, (), True), (1, 0.65, (), False), (40, 0.96, (), False),
     (1, 0.97, (0.2, 0.2), True), (1, 0.97, (0.3,), False)],
)  # fmt: skip
def test_an_answer_is_doubted_in_which_much_is_expected_to_be_wrong(count, known, clutter, expected):
    """A desk of ten objects, each likelier there than not, was trusted: two of them were none; and so was a floor on
    which holes had cut a sack in two, either part of it clutter rather than an object."""
    posterior = seen_by_a_sensor(0.0)
    posterior.meta["clutter"] = [(probability, 0.0, 0.1, 0.0, 0.1) for probability in clutter]
    posterior.meta["cut_short"] = [(0.48, 0.0, 0.1, 0.0, 0.1)]  # another object or none: what is told is right
    vertices = [SimpleNamespace(name=f"box_{k}", body=posterior.best_part.graph.body("")) for k in range(count)]
    posterior.best_part.graph.vertices = vertices
    posterior.best_part.values, posterior.object_probability = np.zeros((1, 1, 0)), lambda name: known
    doubts = chain_doubts(posterior, [])
    assert [doubt.serious for doubt in doubts] == [True] * expected
    assert not any("0.0" in doubt.words for doubt in doubts)  # nothing is told of none


def test_what_the_likeliest_structure_leaves_out_is_expected_nevertheless():
    """Of a mug one side was told and the other, likelier clutter than an object by a hair, was not: it was trusted."""
    posterior = seen_by_a_sensor(0.0)
    posterior.best_part.extras["absent"] = ["thing_2"]
    posterior.object_probability = lambda name: 0.45 if name == "thing_2" else 0.97
    (doubt,) = chain_doubts(posterior, [])
    assert doubt.serious and doubt.words == "0.5 objects are expected in what else is seen"  # .45 of one
    posterior.object_probability = lambda name: 0.2 if name == "thing_2" else 0.97
    assert not chain_doubts(posterior, [])


def test_what_was_rather_missed_than_found_is_not_trusted():
    """Of cartons from which few pixels returned "nothing" was told at .07, and trusted."""
    posterior = seen_by_a_sensor(0.0)
    for missed in (0.93, 0.5):  # with .50 "nothing" was told at .50 of a box that filled the view
        posterior.meta["missed"] = missed
        (doubt,) = chain_doubts(posterior, [])
        assert doubt.serious and f"missed with a probability of {missed:.2f}" in doubt.words
    posterior.meta["missed"] = 0.4
    assert not chain_doubts(posterior, [])


@pytest.mark.parametrize(
    "count, likely, expected", [(1, 0.08, False), (0, 0.37, False), (0, 0.45, True), (1, 0.35, False), (5, 0.09, True)]
)
def test_another_floor_counts_by_how_much_would_be_wrong_with_it(count, likely, expected):
    """A mug on a table of P .92, the rest a floor or wall behind, was not trusted where clutter of P .35 was."""
    posterior = seen_by_a_sensor(0.0)
    posterior.object_probability = lambda name: 0.995
    posterior.meta["other_floors"] = [{"probability": likely, "plane": (0.0, 0.0, -1.0, 0.8)}]
    vertices = [SimpleNamespace(name=f"box_{k}", body=posterior.best_part.graph.body("")) for k in range(count)]
    posterior.best_part.graph.vertices = vertices
    (doubt,) = chain_doubts(posterior, [])
    assert doubt.words.startswith(f"another plane may be the floor, with a probability of {likely}")
    assert doubt.serious == expected and (doubt.about is None) == expected


@pytest.mark.parametrize(
    "address, spread", [("box_1.contact.theta", 0.01), ("box_1.width", 0.001), ("box_1.contact.qy", 0.005)]
)
def test_chains_that_disagree_about_less_than_faces_are_off_are_trusted(address, spread):
    values = np.random.default_rng(0).standard_normal((2, 100, 1)) + [[[-1.0]], [[1.0]]]
    rows = parameter_rows([address], 0.1 + spread * values / values.std())
    assert doubtful(rows[0])
    (note,) = chain_doubts(seen_by_a_sensor(0.003), rows)
    assert not note.serious and not note.about
    assert "leave 0.5 mm open" in note.words  # of 1 mm, by as good as three independent draws
    assert verdict((note,), rows) == [f"worth knowing: {note.words}", "nothing serious speaks against this scene"]
    assert verdict((), ()) == ["nothing speaks against this scene"]
    (doubt,) = chain_doubts(seen_by_a_sensor(0.0004), rows)  # faces are off by less than the chains
    assert doubt.about == {"box_1"} and not doubt.serious  # what there is, and where, they tell
    (doubt,) = chain_doubts(seen_by_a_sensor(0.0), rows)  # of an image that a model drew
    assert doubt.about == {"box_1"} and doubt.serious


@pytest.mark.parametrize("open_mm, serious", [(0.03, False), (0.3, True)])
def test_chains_that_leave_a_thousandth_of_a_size_open_are_trusted(open_mm, serious):
    """Two views of which all sizes were right were not to be trusted for .03 mm that the chains left open."""
    values = np.random.default_rng(0).standard_normal((2, 100, 1)) + [[[-1.0]], [[1.0]]]
    (row,) = parameter_rows(["box_1.width"], 0.1 + 2e-3 * open_mm * values / values.std())
    (doubt,) = chain_doubts(seen_by_a_sensor(0.0), [row])
    assert doubt.serious == serious and f"leave {open_mm:g} mm open" in doubt.words


@pytest.mark.parametrize("length, serious", [(0.2, False), (0.09, True)])
def test_a_size_that_chains_leave_open_by_a_tenth_of_itself_is_not_trusted(length, serious):
    """Of a box 19 cm deep 15 mm of 9 cm were left open, for its other end was missed, and it was trusted."""
    values = np.random.default_rng(0).standard_normal((2, 100, 1)) + [[[-1.0]], [[1.0]]]
    (row,) = parameter_rows(["box_1.length"], length + 0.027 * values / values.std())
    (doubt,) = chain_doubts(seen_by_a_sensor(0.003), [row])
    assert doubt.serious == serious and doubt.about == {"box_1"}


@pytest.mark.parametrize(("apart", "serious"), [(0.15, False), (2.0, True)])
def test_many_draws_are_not_asked_for_more_agreement_than_few(apart, serious):
    """README's own example, 16,000 draws with R-hat 1.018 that left no .01 mm open, was not to be trusted."""
    for address in ("box_1.width", "likelihood.sigma"):
        values = np.random.default_rng(0).standard_normal((4, 600, 1)) + apart * np.arange(4)[:, None, None]
        (row,) = parameter_rows([address], values)
        assert doubtful(row) and (row["r_hat"] < 1.1) != serious
        (doubt,) = chain_doubts(seen_by_a_sensor(0.0), [row])
        assert doubt.serious == serious and " would do" in doubt.words
        assert serious or (not doubt.about and doubt.about is not None)
        assert doubt.words.startswith(f"the chains {'disagree' if serious else 'agree'} about")
        assert "e+" not in doubt.words  # "1e+03 mm"


def test_not_more_is_asked_for_than_what_would_be_trusted():
    """22 effective draws of 400 asked for 14,000 of each chain, of which 2,500 end trusted."""
    values = chains(0.9, 200, np.random.default_rng(5))
    row = {**parameter_rows(["box_1.width"], values)[0], "r_hat": 1.075, "ess_bulk": 22.0}
    (doubt,) = chain_doubts(seen_by_a_sensor(0.0), [row])
    assert doubt.serious and "--draws 2300 would do" in doubt.words
    assert enough_draws([row]) == 3800  # for an R-hat of 1.01
    almost = {**row, "draws": np.zeros((2, 1000)), "r_hat": 1.0104, "ess_bulk": 700.0}
    (doubt,) = chain_doubts(seen_by_a_sensor(0.0), [almost])
    assert not doubt.serious and "R-hat 1.0104 (good up to 1.01)" in doubt.words  # no "R-hat 1.010" is above 1.01


def test_chains_that_disagree_about_an_object_say_nothing_of_others():
    values = np.random.default_rng(0).standard_normal((2, 100, 1)) + [[[-1.0]], [[1.0]]]
    for address, about in (("box_1.width", {"box_1"}), ("likelihood.sigma", None)):
        (doubt,) = chain_doubts(seen_by_a_sensor(0.0), parameter_rows([address], values))
        assert doubt.serious and doubt.about == about and " would do" in doubt.words
    row = {**parameter_rows(["box_1.width"], values)[0], "r_hat": np.nan, "ess_bulk": 13.0}
    (doubt,) = chain_doubts(seen_by_a_sensor(0.0), [row])
    assert doubt.words.startswith("the chains are too short for box_1.width: 13 effective draws, which leave")
    doubtful_thing = seen_by_a_sensor(0.0)
    doubtful_thing.best_part.values = np.zeros((1, 1, 0))
    for known, told in ((0.55, [False]), (0.7, [False]), (0.8, [])):
        doubtful_thing.meta["existence"] = {"box_1": (known, 0.1), "another": (0.6, 0.1)}
        found = chain_doubts(doubtful_thing, [])
        assert [doubt.serious for doubt in found] == told and all(doubt.about == ("box_1",) for doubt in found)


def test_one_chain_neither_agrees_nor_disagrees():
    """Of a chain of 1,000 draws it was said that there are no draws; of one worth too few, that the chains disagree."""
    rng = np.random.default_rng(2)
    (good,), (bad,) = (parameter_rows(["box_1.width"], chains(rho, 200, rng, count=1)) for rho in (0.0, 0.98))
    (line,) = verdict((), [good])
    assert "one chain has none to agree with" in line and "effective draws are at least 275 " in line
    assert "without draws" in verdict((), parameter_rows(["box_1.width"], np.zeros((1, 1, 1))))[0]
    posterior = seen_by_a_sensor(0.0)
    posterior.best_part.values = np.zeros((1, 200, 1))
    (doubt,) = chain_doubts(posterior, [{**bad, "ess_bulk": 1.2}])
    assert doubt.words.startswith("the chain is too short for box_1.width: 1 effective draw, ")


def test_what_touches_nothing_is_doubted():
    """A quick search had a box hang in the air, whose bearer another hid, and was trusted on its fit."""
    posterior = seen_by_a_sensor(0.0)
    posterior.best_part.values = np.zeros((1, 1, 0))
    posterior.meta["hanging"] = ["box_1"]
    (doubt,) = chain_doubts(posterior, [])
    assert doubt.serious and doubt.about == ("box_1",) and "touches nothing" in doubt.words


@pytest.mark.parametrize("short", [-2.0, 3.0, 101.0])
def test_an_image_that_noise_does_not_make_of_the_best_scene_is_doubted(short):
    """Of seven scenes of open structure two were told with P 1.000 that were others."""
    posterior = seen_by_a_sensor(0.0)
    posterior.best_part.values = np.zeros((1, 1, 0))
    posterior.meta["short_of_noise"] = short
    told = chain_doubts(posterior, [])
    assert [doubt.serious for doubt in told] == [True] * (short > FITS)
    assert all(f"{short:.0f} standard deviations" in doubt.words for doubt in told)


def test_of_an_image_without_a_floor_objects_are_trusted_by_themselves():
    """A tissue box before a shelf was right, and in doubt for what else the shelf might hold."""
    posterior = seen_by_a_sensor(0.0)
    posterior.best_part.values = np.zeros((1, 1, 0))
    posterior.meta["no_floor"] = True
    box = SimpleNamespace(name="box_1", body=posterior.best_part.graph.body(""), parent="root", supports=())
    posterior.best_part.graph.vertices = [box]
    judged = judgement(chain_doubts(posterior, []), posterior.best_part.graph)
    assert not judged["trusted"] and judged["in_doubt"] == [] and "no surface was found" in judged["doubts"][0]


def test_what_is_worth_knowing_comes_last_and_harms_nothing():
    rows = parameter_rows(["a.x"], np.random.default_rng(1).standard_normal((2, 200, 1)))
    doubts = (Doubt("A", False), Doubt("B"))
    assert verdict(doubts, rows) == ["not to be trusted: B", "worth knowing: A"]
    assert verdict(doubts[:1], rows)[0].startswith("the chains agree") and trusted(doubts[:1])
    assert not trusted(doubts)


@pytest.mark.parametrize(
    "probability, error, interval, text",
    [
        (0.93, 0.02, (0.88, 0.96), ".93 (.88-.96)"),
        (0.97, 0.02, (0.89, 0.999), ".97 (.89 to >.99)"),
        (0.93, 0.001, None, ".93"),
        (1.0, 0.0, None, ">.99"),
        (0.9912, 0.0, None, ">.99"),
        (0.0004, 0.0, None, "<.01"),
        (0.0, 0.02, (0.0, 0.06), "<.01 (<.01 to .06)"),
        (0.62, 0.15, (0.37, 0.83), ".6 (.37-.83)"),
        (0.97, 0.12, (0.7, 1.0), ">.9 (.70 to >.99)"),
        (0.5, 0.1, None, ".5 (.34-.66)"),
    ],
)
def test_probabilities_are_said_as_finely_as_they_are_known(probability, error, interval, text):
    assert probability_text(probability, error, interval) == text


def test_nothing_is_certain():
    assert not any("1.0" in probability_text(1.0 - 10.0**-k, error) for k in range(1, 9) for error in (0.0, 0.05, 0.2))
