"""Verdicts in three words, interventions, probabilities, faulty scenes and settled ones."""

import threading

import numpy as np
import pytest
from test_simulate import FLOOR, GRAVITY, cube, matter

from derender.document import document_text, read_document
from derender.errors import DerenderError
from derender.physics.bodies import Body, matter_of_graph
from derender.physics.intervention import Intervention, Push, intervention, read_add, read_push, read_shake, read_tilt
from derender.physics.outcome import (
    assumed_of_draws,
    assumptions,
    chance_of,
    outcomes,
    probability,
    row_of,
    simulate_scene,
    summary_of,
    told_of_missed,
)
from derender.physics.simulate import judge, simulate
from derender.physics.verdict import settled_graph
from derender.scene.pose import rotation_x, translation

TEXT = """
derender: 1
root: {distance: 0.9, elevation: 35 deg}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red: {shape: {type: cube, side: 0.10}, parent: floor, friction: 0.4,
        contact: {type: face-to-face, x: 0.02, y: 0.0, theta: 20 deg}}
  green: {shape: {type: cube, side: 0.06}, parent: red, density: 300, friction: {uniform: [0.3, 0.6]},
          contact: {type: face-to-face, theta: 0, u: 0.65, v: 0.5}}
"""


@pytest.fixture
def graph(tmp_path):
    (tmp_path / "scene.yaml").write_text(TEXT)
    return read_document(tmp_path / "scene.yaml").graph


def leaning(gap):
    """Return a plate on two posts, of which one is shorter by `gap`."""
    posts = [
        Body(f"post_{k}", "box", np.array([0.02, 0.06, 0.06 - k * gap]), translation(0.1 * k, 0, 0.03 - k * gap / 2))
        for k in (0, 1)
    ]
    plate = Body("plate", "box", np.array([0.14, 0.06, 0.02]), translation(0.055, 0, 0.07))
    return matter(FLOOR, *posts, plate)


def test_three_verdicts():
    assert simulate_scene(leaning(0.0)).verdict == "stands"
    tilted = simulate_scene(leaning(0.012), engine="both")
    assert tilted.verdict == "settles" and tilted.fallen == ("plate",) and tilted.by_engine["statics"] == "falls"
    assert simulate_scene(matter(FLOOR, cube("a", 0, 0.05), cube("b", 0.06, 0.15))).verdict == "falls"
    pushed = simulate_scene(matter(FLOOR, cube("a", 0, 0.05)), push=["a:+x:8N@0.1s"])
    assert pushed.verdict == "settles" and not pushed.stable


def test_an_early_stop_names_the_same_verdict_and_the_same_bodies():
    """A plate loses its post and takes down what stood on it; what stands apart and what settles are told too."""
    plate = Body("plate", "box", np.array([0.3, 0.06, 0.02]), translation(0.1, 0, 0.11))
    falling = matter(FLOOR, cube("post", 0, 0.05), plate, cube("rider", 0.2, 0.15, 0.06), cube("apart", 0.6, 0.05))
    for scene, length in ((falling, 1.2), (leaning(0.012), 1.2), (matter(FLOOR, cube("a", 0, 0.05)), 0.2)):
        short, whole = (simulate_scene(scene, early=early) for early in (True, False))
        assert short.verdict == whole.verdict and set(short.fallen) == set(whole.fallen)
        assert short.trajectory.times[-1] < length < whole.trajectory.times[-1]
        assert whole.trajectory.times[-1] == pytest.approx(2.0, abs=0.01)
    assert simulate_scene(falling).fallen == ("rider", "plate") or simulate_scene(falling).fallen == ("plate", "rider")


def test_a_body_that_comes_back_has_moved_all_the_same():
    ball = Body("ball", "sphere", np.full(3, 0.1), translation(0, 0, 0.05), velocity=(0, 0, 1.0))
    trajectory = simulate(matter(FLOOR, ball), duration=1.5)
    assert np.linalg.norm(trajectory.poses[-1, 0, :3, 3] - trajectory.poses[0, 0, :3, 3]) < 0.005
    assert judge(trajectory).fallen == ("ball",) and judge(trajectory).displacement["ball"] > 0.04


def test_what_falls_first_is_named_first():
    scene = matter(FLOOR, cube("late", 0, 0.05), cube("early", 0.5, 0.3))
    done = Intervention((Push("late", np.array([30.0, 0, 0]), 0.5, 0.2),))
    verdict = judge(simulate(scene, 1.5, disturbance=done))
    assert verdict.fallen == ("early", "late")
    assert verdict.first_moved["early"] < 0.15 and 0.5 < verdict.first_moved["late"] < 0.7


@pytest.mark.parametrize("side", [1e-4, 1e-6])
def test_tiny_bodies_get_the_verdict_of_great_ones(side):
    for shift, verdict in ((0.3, "stands"), (0.7, "falls")):
        tower = [cube("a", 0, side / 2, side), cube("b", shift * side, 1.5 * side, side)]
        assert simulate_scene(matter(FLOOR, *tower), duration=0.05).verdict == verdict


def test_a_feather_bears_a_box_and_what_is_assumed_is_said():
    low, high = cube("low", 0, 0.05, mass=1e-9), cube("high", 0, 0.15)
    outcome = simulate_scene(matter(FLOOR, low, high))
    assert outcome.stable and outcome.displacement["low"] < 1e-3
    assert "1e-09 kg" in assumptions(outcome)[0]
    assert "no floor" in assumptions(simulate_scene(matter(cube("a", 0, 0.05))))[0]
    assert assumptions(simulate_scene(matter(FLOOR, cube("a", 0, 0.05)))) == []


def test_a_cube_on_its_edge_stands_by_calculation_alone():
    on_edge = Body("a", "box", np.full(3, 0.1), translation(0, 0, 0.05 * np.sqrt(2)) @ rotation_x(np.pi / 4))
    outcome = simulate_scene(matter(FLOOR, on_edge))
    assert outcome.stable and "less than 0.001 g ends it" in assumptions(outcome)[0]


@pytest.mark.parametrize("engine", ["mujoco", "statics", "both"])
@pytest.mark.parametrize("wrong", [cube("a", 0, np.nan), cube("a", 0, 0.05, 0.0)])
def test_a_number_that_is_none_is_one_line_with_every_engine(engine, wrong):
    with pytest.raises(DerenderError, match="a: a number of this object is not finite or a size not positive"):
        simulate_scene(matter(FLOOR, wrong), engine=engine)


@pytest.mark.parametrize("shift", [0.01, 0.085])
def test_what_no_rigid_bodies_can_be_does_not_stand_whoever_is_asked(shift):
    """The engine lets solids that overlap rest as they are. A contact's slack, 20 mm of cubes of 100, may be there."""
    scene = matter(FLOOR, cube("a", 0, 0.05), cube("b", shift, 0.05), cube("c", 0.5, 0.05))
    possible = shift > 0.08
    outcome = simulate_scene(scene, engine="both", margin=True)
    assert set(outcome.by_engine.values()) == ({"stands"} if possible else {"falls"})
    assert outcome.stable == (simulate_scene(scene, engine="statics").verdict == "stands") == possible
    assert (outcome.margin > 0) == possible
    moved = set() if possible else {"a", "b"}
    assert set(outcome.fallen) == set(simulate_scene(scene, engine="statics").fallen) == moved
    assert (probability([scene] * 10, "stands", engine="statics").probability > 0.5) == possible
    said = assumptions(outcome)
    assert possible == (not said) and all("overlap by 90.0 mm" in sentence for sentence in said)
    row = row_of("deep", summary_of(outcome, [outcome], said))
    assert (row["stable"], row["assumed"]) == (possible, "; ".join(said))
    assert possible == (not (said := assumed_of_draws([outcome], Intervention()))) and (possible or "1 of 1" in said[0])


def test_what_lies_in_the_hull_of_a_bowl_may_stand():
    """Only a mesh's hull is known, and what is inside of that need not be inside of it."""
    corners = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.05, 0.05)])
    bowl = Body("bowl", "mesh", np.array([0.2, 0.2, 0.1]), translation(0, 0, 0.05), corners)
    scene = matter(FLOOR, bowl, cube("apple", 0, 0.06, 0.08), supports=[("bowl", "floor"), ("apple", "bowl")])
    outcome = simulate_scene(scene)
    assert outcome.stable and assumptions(outcome) == []


def test_a_divergence_is_one_line_and_never_a_verdict():
    mad = cube("a", 0, 0.05, velocity=(1e9, 1e9, 1e9), angular_velocity=(1e12, 0, 0))
    with pytest.raises(DerenderError, match="diverged"):
        simulate(matter(FLOOR, mad, cube("b", 0.05, 0.06)))


def test_friction_zero_slides_on_a_floor_that_says_nothing():
    down = 9.81 * np.array([np.sin(0.35), 0, -np.cos(0.35)])
    assert simulate_scene(matter(FLOOR, cube("a", 0, 0.05, friction=0.0), gravity=down), engine="both").by_engine == {
        "statics": "falls", "mujoco": "falls"}  # fmt: skip
    assert simulate_scene(matter(FLOOR, cube("a", 0, 0.05), gravity=down)).stable
    for share in (0.97, 1.03):
        slope = np.arctan(share * 0.5)
        down = 9.81 * np.array([np.sin(slope), 0, -np.cos(slope)])
        block = matter(FLOOR, cube("a", 0, 0.05, friction=0.5), gravity=down)
        words = simulate_scene(block, engine="both").by_engine.values()
        assert [word == "stands" for word in words] == [share < 1] * 2


def test_interventions_are_read_and_faults_are_one_line(graph):
    push = read_push("red:-y:500mN@20ms")
    assert (push.body, push.start, push.duration) == ("red", 0.0, 0.02) and list(push.force) == [0, -0.5, 0]
    assert read_tilt("10deg")[0] == pytest.approx(np.deg2rad(10)) and read_shake("2Hz:5mm:90deg").amplitude == 0.005
    assert read_add("new:cylinder:6x12cm@red:2cm,0")[2].tolist() == [0.06, 0.06, 0.12]
    assert read_add("new:cube:6cm@red:-2cm,-1cm")[4] == (-0.02, -0.01)  # places and directions have both signs
    assert read_push("red:-90deg:1N@1s").force == pytest.approx([0, -1, 0])
    assert read_push("red:+x:1e2N@1e-1s").force == pytest.approx([100, 0, 0])  # a YAML reader's strictness is for files
    with pytest.raises(DerenderError, match="how long it is pushed.*write red:[+]x:5N@0.1s"):
        read_push("red:+x:5N")
    for texts in ({"push": ["red:+x"]}, {"push": ["red:+q:1N@1s"]}, {"tilt": "100deg"}, {"shake": "2Hz"},
                  {"jitter": "2kg"}, {"add": ["a:cone:1cm@red"]}, {"push": ["red:+x:nanN@1s"]},
                  {"push": ["red:+x:-1N@1s"]}, {"jitter": "1e308"}, {"jitter": "2,1deg"},
                  {"jitter": "2mm,1"}):  # fmt: skip
        with pytest.raises(DerenderError):
            intervention(**texts)
    assert intervention(remove="red", push="red:+x:1N@1s").remove == ("red",)  # one alone is no list of letters
    with pytest.raises(TypeError, match="tlt"):
        intervention(tlt="10deg")
    for texts in ({"remove": ["blue"]}, {"push": ["blue:+x:1N@1s"]}, {"add": ["red:cube:5cm@floor"]},
                  {"remove": ["red"], "push": ["red:+x:1N@1s"]}):  # fmt: skip
        with pytest.raises(DerenderError, match="called"):
            simulate_scene(graph, **texts)
    with pytest.raises(DerenderError, match="'floor' does not move.*red green"):  # nothing happened, without a word
        simulate_scene(graph, push=["floor:+x:9N@1s"])
    for way in ("+q", "0,0,0"):
        with pytest.raises(DerenderError, match="is no direction"):
            read_push(f"red:{way}:1N@1s")


def test_what_is_added_can_be_pushed_and_is_part_of_the_settled_scene(graph):
    for kind, size in (("box", "10x5x5cm"), ("sphere", "8cm"), ("cylinder", "6x12cm")):
        outcome = simulate_scene(graph, early=False, add=[f"new:{kind}:{size}@floor:30cm,0"], push=["new:+x:2N@0.1s"])
        assert outcome.displacement["new"] > 1e-3
        settled = settled_graph(graph, outcome.trajectory, outcome.matter)
        where = outcome.trajectory.poses[-1, outcome.trajectory.names.index("new")]
        np.testing.assert_allclose(settled.poses()["new"][:3, 3], where[:3, 3], atol=2e-4)
        assert settled.vertex("new").shape == kind and settled.vertex("new").parent == "floor"
        np.testing.assert_allclose(settled.body("new").size(), outcome.trajectory.sizes[-1])


def test_a_scene_that_settled_on_a_tilted_floor_is_written_with_it(graph):
    """It was written on a level one, where it stands whatever it did."""
    outcome = simulate_scene(graph, tilt="15deg:+y", early=False)
    settled = settled_graph(graph, outcome.trajectory, outcome.matter)
    margins = [simulate_scene(each, margin=True).margin for each in (settled, graph)]
    assert margins[0] == pytest.approx(simulate_scene(graph, tilt="15deg:+y", margin=True).margin, abs=2e-3)
    assert margins[0] < 0.7 * margins[1]
    level = simulate_scene(graph, early=False)
    assert settled_graph(graph, level.trajectory, level.matter).gravity == graph.gravity


def test_a_run_too_short_to_tell_says_so():
    """A block in the air stands for a hundredth of a second."""
    hangs = matter(FLOOR, cube("a", 0, 0.3))
    short = simulate_scene(hangs, duration=0.01, early=False)
    assert short.stable and any("not all is known to rest" in said for said in assumptions(short))
    stands = matter(FLOOR, cube("a", 0, 0.05))
    assert assumptions(simulate_scene(stands, early=False)) == []


def test_interventions_do_what_they_say(graph):
    assert simulate_scene(graph).stable
    assert simulate_scene(graph, remove=["red"]).fallen == ("green",)
    assert simulate_scene(graph, tilt="15deg").stable and not simulate_scene(graph, tilt="30deg").stable
    assert not simulate_scene(graph, tilt="30deg", engine="statics").stable
    for act in ({"push": "green:+x:9N@1s"}, {"shake": "2Hz:9cm"}):
        with pytest.raises(DerenderError, match="knows no pushes"):  # it stood, whatever the push
            simulate_scene(graph, engine="statics", **act)
    # a floor that swings harder than friction times g shakes a box off its place
    assert simulate_scene(graph, shake="2Hz:5mm").stable and not simulate_scene(graph, shake="3Hz:40mm").stable
    pushed = simulate_scene(graph, push=["red:+x:6N@0.2s"], early=False)
    moved = pushed.trajectory.poses[-1, 0, :3, 3] - pushed.trajectory.poses[0, 0, :3, 3]
    along = np.asarray(graph.root_pose)[:3, 0]
    assert moved @ along > 0.9 * np.linalg.norm(moved) > 0.01
    added = simulate_scene(graph, add=["new:box:10x5x5cm@green"])
    assert added.stable and added.matter.bodies[-1].name == "new" and ("new", "green") in added.matter.supports


def test_draws_that_lack_an_object_leave_out_what_is_done_to_it(graph):
    """Of a posterior in which it is there with .9, or a prior, the first draw without it ended everything."""
    alone = simulate_scene(graph, remove="green").matter
    acts = intervention(push="green:+x:9N@0.2s", add="new:cube:4cm@green")
    runs = list(outcomes([graph, alone, graph], acts))
    assert [run.verdict for run in runs] == ["falls", "stands", "falls"]
    said = assumed_of_draws(runs, acts)
    assert said == ["in 1 of 3 draws there is no green: nothing is done to it there"]
    assert probability([alone, graph], "stands", remove="green").draws == 2
    with pytest.raises(DerenderError, match="no object is called 'gren'; did you mean 'green'"):
        probability([graph, alone], "stands", remove="gren")


def test_a_floor_is_tilted_sideways_and_shaken_by_what_it_does_within_a_step(graph):
    with pytest.raises(DerenderError, match="not tilted up or down"):
        simulate_scene(graph, tilt="20deg:+z")  # stood, along a direction of rounding errors
    shake = read_shake("1000Hz:1mm")
    assert np.abs(shake.acceleration(0.0, 0.01)).max() < 1e-6 < np.abs(shake.acceleration(0.0, 2.5e-4)).max()
    assert np.abs(shake._replace(end=0.01).acceleration(0.01, 0.0101)).max() == 0.0


@pytest.mark.parametrize(
    ("acts", "friction", "wide", "high", "verdict"),
    [
        ({"shake": "2Hz:62mm"}, 0.5, 0.1, 0.03, "settles"),  # by 2 mu g: it slips to and fro by 54 mm
        ({"shake": "8Hz:3.88mm"}, 1.2, 0.04, 0.08, "settles"),  # it rocks, in step with what is kept of its poses
        ({"shake": "3Hz:70mm"}, 1.2, 0.04, 0.08, "falls"),
        ({"push": "a:+x:0.4N@1s"}, 0.1, 0.1, 0.03, "settles"),  # it slides by metres, for longer than is asked
    ],
)
def test_what_is_shaken_or_pushed_is_judged_when_it_has_come_to_rest(acts, friction, wide, high, verdict):
    """It fell where it still moved at the end; or rested where it had rocked back to the same place by then."""
    box = Body("a", "box", np.array([wide, wide, high]), translation(0, 0, high / 2), friction=friction)
    outcome = simulate_scene(matter(FLOOR, box), **acts)
    assert outcome.verdict == verdict and not outcome.trajectory.resting


@pytest.mark.slow
def test_probabilities_have_errors_and_stop_when_known(graph):
    chance = probability([graph] * 400, "falls", until=0.08, tilt="21deg", seed=3, duration=1.0)
    assert 10 <= chance.draws < 60 and 0 < chance.probability < 1 and chance.error <= 0.08
    again = probability([graph] * 400, "falls", until=0.08, tilt="21deg", seed=3, duration=1.0)
    assert again == chance
    certain = probability([graph] * 12, lambda outcome: "green" in outcome.fallen, remove=["red"])
    assert certain.probability == pytest.approx(12.5 / 13) and certain.error > 0
    spread = [chance_of(draws).error for draws in (np.random.default_rng(0).random((200, 100)) < 0.3)]
    shares = (np.random.default_rng(0).random((200, 100)) < 0.3).mean(axis=1)
    assert np.mean(spread) == pytest.approx(np.std(shares), rel=0.15)


def test_draws_until_it_is_known_are_simulated_in_threads(graph, monkeypatch):
    together = threading.Barrier(2, timeout=20)  # of which one thread alone waits in vain
    found = simulate_scene(graph, engine="statics")

    def simulated(*_, **__):
        together.wait()
        return found

    monkeypatch.setattr("derender.physics.outcome.simulate_scene", simulated)
    runs = list(outcomes([graph] * 40, intervention(), jobs=2, until=0.2))
    assert len(runs) == 10


def test_nobody_and_no_time_are_told(graph):
    with pytest.raises(DerenderError, match="'gren' is no verdict and no object; did you mean 'green'"):
        probability([graph], "gren", engine="statics")
    with pytest.raises(DerenderError, match="'flies' is no verdict.*did you mean 'falls'"):
        probability([graph], "flies", engine="statics")
    for duration in (0.0, -1.0, float("nan")):
        with pytest.raises(DerenderError, match="duration is"):
            simulate_scene(graph, duration=duration)


def test_no_object_falls_more_likely_than_the_scene(graph):
    runs = [simulate_scene(graph, engine="statics") for _ in range(3)]
    found = summary_of(runs[0], runs, [])
    assert found["p_verdict"]["falls"] == pytest.approx(0.25 / 4)  # none fell
    assert set(found["p_falls"].values()) == {found["p_verdict"]["falls"]}


def test_what_a_search_missed_may_stand_or_fall(graph):
    """Draws of structures that are wrong with probability .43 all stood, and P(stands) was .98."""
    chance, sure = (probability([graph] * 40, "stands", engine="statics", missed=missed) for missed in (0.4, 0.0))
    assert chance.probability == pytest.approx(0.6 * sure.probability + 0.2) and chance.error < sure.error
    runs = [simulate_scene(graph, engine="statics") for _ in range(3)]
    found = summary_of(runs[0], runs, [], missed=0.4)
    assert found["p_stable"] == pytest.approx(0.6 * 3.5 / 4 + 0.4 * 0.5)
    assert sum(found["p_verdict"].values()) == pytest.approx(1.0)
    assert found["p_verdict"]["falls"] == pytest.approx(0.6 * 0.25 / 4 + 0.4 * 0.25)
    assert found["missed"] == 0.4 and told_of_missed(found).startswith("half of the .40 that it is none of")
    assert not told_of_missed(summary_of(runs[0], runs, [])) and not told_of_missed({})
    alone = summary_of(runs[0], runs[:1], [], missed=0.4)  # a quick look's only scene stood for sure, and P was 1
    assert alone["p_stable"] == pytest.approx(0.8) and alone["missed"] == 0.4 and alone["p_stable_error"] == 0.0
    assert alone["p_verdict"] == pytest.approx({"stands": 0.8, "settles": 0.1, "falls": 0.1})
    assert summary_of(runs[0], runs[:1], [])["p_stable"] == 1.0  # of a scene that is given
    drawn = summary_of(runs[0], runs[1:2], [])  # one draw that stands makes nothing sure
    assert drawn["p_stable"] == 0.75 and drawn["p_verdict"] == {"stands": 0.75, "settles": 0.125, "falls": 0.125}
    assert drawn["p_verdict_error"]["falls"] == chance_of([False], 0.25).error > 0.0


def test_a_settled_scene_is_a_scene_that_stands(graph, tmp_path):
    for texts in ({"push": ["red:+x:4N@0.2s"]}, {"remove": ["red"]}):
        outcome = simulate_scene(graph, early=False, **texts)
        settled = settled_graph(graph, outcome.trajectory, outcome.matter)
        (tmp_path / "settled.yaml").write_text(document_text(settled))
        found = read_document(tmp_path / "settled.yaml").graph
        for k, name in enumerate(outcome.trajectory.names):
            np.testing.assert_allclose(found.poses()[name], outcome.trajectory.poses[-1, k], atol=2e-4)
            assert found.vertex(name).contact.type == "face-to-face"
        assert found.vertex("green").parent == ("floor" if "remove" in texts else "red")
        assert simulate_scene(found).stable


def test_yaml_says_matter_and_gravity(tmp_path):
    text = TEXT.replace("root:", "gravity: 1.62\nroot:").replace(
        "density: 300", "mass: 200 g, velocity: [0.5, 0, {uniform: [0, 1]}], fixed: false, elasticity: 0.3"
    )
    (tmp_path / "moon.yaml").write_text(text)
    graph = read_document(tmp_path / "moon.yaml").graph
    found = matter_of_graph(graph, np.random.default_rng(0))
    green = found.bodies[2]
    assert np.linalg.norm(found.gravity) == pytest.approx(1.62) and green.mass == 0.2 and green.elasticity == 0.3
    local = np.asarray(graph.root_pose)[:3, :3].T @ green.velocity
    assert local[0] == pytest.approx(0.5) and 0 < local[2] < 1 and 0.3 < green.friction < 0.6
    assert matter_of_graph(graph).bodies[2].friction == pytest.approx(0.45)
    (tmp_path / "again.yaml").write_text(document_text(graph))
    again = read_document(tmp_path / "again.yaml").graph
    assert again.vertex("green").options == graph.vertex("green").options
    np.testing.assert_allclose(again.gravity, graph.gravity)
    for wrong in ("mass: 0.1, density: 300", "friction: {normal: [0, 1]}", "velocity: 3", "elasticity: 1.0", "mass: 0"):
        (tmp_path / "wrong.yaml").write_text(TEXT.replace("density: 300", wrong).replace(
            "friction: {uniform: [0.3, 0.6]},", "" if "friction" in wrong else "friction: 0.3,"))  # fmt: skip
        with pytest.raises(DerenderError, match=r"wrong\.yaml"):
            read_document(tmp_path / "wrong.yaml")


def test_gravity_of_zero_and_upside_down():
    assert simulate_scene(matter(FLOOR, cube("a", 0, 0.3), gravity=0 * GRAVITY), engine="both").by_engine == {
        "statics": "stands", "mujoco": "stands"}  # fmt: skip
