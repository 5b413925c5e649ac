"""The prior of bare images is a file: what inference weighs by is the density of what `derender sample` draws."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr

from derender import data_path
from derender.detection.leftovers import Swap
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import BARE_IMAGE, Rules, bare_image, beliefs_of
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.things import Thing
from derender.document import read_document, read_prior_document
from derender.errors import DerenderError
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.priors.bare_image import Cartons, Loose, Missed, Shared, Things, tips
from derender.scene.solids import BOX
from derender.structures import free_forms
from derender.structures.draws.numbers import scene_log_prior

PRIOR = read_prior_document(BARE_IMAGE).prior
FACES = {"parent_face": "+z", "child_face": "-z"}


def scene(*solids):
    """Return a graph of (shape, parameters, parent, where) with no turns: areas of contact are then products."""
    drawn = PRIOR.sample(np.random.default_rng(0))
    pose, vertices = drawn.root_pose, [drawn.vertex("floor")]
    for number, (shape, parameters, parent, where) in enumerate(solids):
        values = {"theta": 0.0, **dict(zip("xy" if parent == "floor" else "uv", where, strict=True))}
        contact = Contact("face-to-face", values=values, **FACES)
        vertices.append(Vertex(f"solid_{number}", shape, parameters, parent, contact))
    return SceneGraph(root_pose=pose, vertices=tuple(vertices))


def box(*size):
    return dict(zip(("length", "width", "height"), size, strict=True))


SCENES = {
    "one box": scene(("box", box(0.1, 0.07, 0.05), "floor", (0.0, 0.0))),
    "box and cube": scene(
        ("box", box(0.1, 0.07, 0.05), "floor", (0.0, 0.0)), ("cube", {"side": 0.06}, "floor", (0.12, 0.1))
    ),
    "can and cube": scene(
        ("cylinder", {"radius": 0.03, "height": 0.1}, "floor", (0.0, 0.0)),
        ("cube", {"side": 0.04}, "floor", (0.1, 0.1)),
    ),
    "stack": scene(
        ("box", box(0.1, 0.09, 0.05), "floor", (0.0, 0.0)), ("cube", {"side": 0.05}, "solid_0", (0.5, 0.55))
    ),
    "three and one on top": scene(
        ("box", box(0.1, 0.09, 0.05), "floor", (-0.1, 0.0)), ("cube", {"side": 0.05}, "floor", (0.05, 0.1)),
        ("box", box(0.05, 0.04, 0.03), "floor", (0.1, -0.1)), ("box", box(0.06, 0.05, 0.03), "solid_0", (0.5, 0.5)),
    ),
}  # fmt: skip


def names_and_places(graph):
    """Return the log of what the file's density has to be multiplied by to be one of sets of solids in space.

    A box has two names (length and width exchanged), a can's extent is twice its radius, and a place (u, v) on a top is
    spread over where the two touch.
    """
    total = 0.0
    for vertex in graph.vertices[1:]:
        total += np.log({"box": 2.0, "cylinder": 0.5}.get(vertex.shape, 1.0))
        if vertex.parent != "floor":
            total -= np.log(np.sum([graph.body(n).size()[:2] for n in (vertex.name, vertex.parent)], axis=0).prod())
    return total


def test_structures_are_weighed_by_the_density_of_the_file():
    """One constant (of the root's pose, which an image gives) for scenes of different numbers of different solids."""
    off = [
        scene_log_prior(graph) - PRIOR.log_density(graph) - PRIOR.log_orderings(graph) - names_and_places(graph)
        for graph in SCENES.values()
    ]
    assert np.all(np.isfinite(off))
    assert np.ptp(off) < 0.03  # of the tables of sizes


def test_numbers_of_another_file_are_obeyed(tmp_path):
    """A copy with another rate, other sizes, rarer stacks: odds change as the file's density does."""
    text = Path(data_path("priors/bare-image.yaml")).read_text()
    for old, new in (
        ("floor: {poisson: 3.84}", "floor: {poisson: 1.2}"),
        ("side: {log-normal: [85 mm, 0.45]}", "side: {uniform: [3 cm, 8 cm]}"),
        ("box: {poisson: 0.4}", "box: {poisson: 0.05}"),
        ("tipping: 0.01", "tipping: 0.5"),
        ("friction: {log-normal: [0.35, 0.8]}", "friction: {uniform: [0.1, 0.2]}"),
        ("slack_seen: 2 mm", "slack_seen: 3 mm"),
        ("stranger: 0.05", "stranger: 0.2"),
        ("shared: {power: 1.5,", "shared: {power: 1.0,"),
        (
            "things: {patch: 30 mm, wide: 20 cm, number: 2.3, edge: 23, whole: 0.7, hidden: 0.2",
            "things: {patch: 4 cm, hidden: 0.3",
        ),
        ("explained: 0.95", "explained: 0.9"),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    (tmp_path / "mine.yaml").write_text(text)
    document = read_document(tmp_path / "mine.yaml")
    beliefs = beliefs_of(document.prior, document.likelihood)
    loose = beliefs.loose
    assert loose.friction.quantile(0.5) == pytest.approx(0.15)
    assert (loose.slack_seen, loose.stranger, loose.shared) == (0.003, 0.2, replace(Shared(), power=1.0))
    assert loose.things == Things(patch=0.04, hidden=0.3) and loose.missed == replace(Missed(), explained=0.9)
    assert loose.tipping == 0.5 and beliefs.sensor is document.likelihood
    rules = Rules(beliefs.loose.slack, beliefs=beliefs)
    off = [
        scene_log_prior(graph, rules) - document.prior.log_density(graph) - PRIOR.log_orderings(graph)
        - names_and_places(graph) for graph in SCENES.values()
    ]  # fmt: skip
    assert np.ptp(off) < 0.03  # the ends of a uniform density are soft
    changed = [scene_log_prior(graph, rules) - scene_log_prior(graph) for graph in SCENES.values()]
    assert np.ptp(changed) > 0.5


def test_what_may_tip_is_rarer_by_the_factor_of_the_file():
    base = scene(("cube", {"side": 0.05}, "floor", (0.0, 0.0)), ("cube", {"side": 0.05}, "solid_0", (0.5, 0.5)))
    off = base.with_numbers({"solid_1.contact.u": 0.9})
    assert tips(off, "solid_1") and not tips(base, "solid_1") and not tips(off, "solid_0")
    assert PRIOR.log_density(off) - PRIOR.log_density(base) == pytest.approx(np.log(bare_image().loose.tipping))
    names = names_and_places(off) - names_and_places(base)
    more = scene_log_prior(off) - scene_log_prior(base) - names
    assert more == pytest.approx(np.log(bare_image().loose.tipping))


def test_the_built_in_prior_draws_scenes_that_it_allows():
    rng = np.random.default_rng(1)
    graphs = [PRIOR.sample(rng) for _ in range(60)]
    assert all(np.isfinite(PRIOR.log_density(graph)) for graph in graphs)
    stacked = [vertex for graph in graphs for vertex in graph.vertices if vertex.parent not in ("root", "floor")]
    tipping = [vertex for graph in graphs for vertex in graph.vertices if tips(graph, vertex.name)]
    assert stacked and len(tipping) < 0.2 * len(stacked)  # three of four would, did nothing speak against it


SHORT = """derender: 1
camera: {{fx: 140, fy: 140, cx: 79.5, cy: 59.5, width: 160, height: 120}}
root: {{distance: 0.7, elevation: 30 deg}}
objects: {{floor: {{shape: plane, contact: {{type: 6dof}}}}}}
structure: {{type: bare-image, offspring: {{floor: {{poisson: 4}}}}, {more}}}
shapes: {{cube: {{side: {{uniform: [4 cm, 9 cm]}}}}}}
contacts: {{standing: {{type: face-to-face, parent_face: top, child_face: -z,
                      x: {{uniform: [-0.2, 0.2]}}, y: {{uniform: [-0.2, 0.2]}}}}}}
"""
WRONG = [("tipping: 2.0", "tipping"), ("seen_from: [1.5, 0.4]", "seen_from"), ("hangin: 0.1", "hangin"),
         ("slack_seen: banana", "structure.slack_seen: 'banana' is not a number"),
         ("stranger: 1.5", "structure.stranger: '1.5' is too large"), ("crowding: 0", "structure.crowding: '0' is too"),
         ("things: {hiden: 0.1}", "structure.things.hiden: this key is unknown here; did you mean 'hidden'?"),
         ("cartons: {extent: 20 cm}", "structure.cartons.extent: cartons of one size only")]  # fmt: skip


@pytest.mark.parametrize("line, fault", WRONG)
def test_faults_of_the_section_are_named(tmp_path, line, fault):
    text = Path(data_path("priors/bare-image.yaml")).read_text().splitlines()
    key = line.partition(":")[0]
    text = [f"  {line}" if row.strip().startswith(f"{key}:") or (key == "hangin" and "hanging:" in row) else row
            for row in text]  # fmt: skip
    (tmp_path / "wrong.yaml").write_text("\n".join(text))
    with pytest.raises(DerenderError) as error:
        read_document(tmp_path / "wrong.yaml")
    assert fault in str(error.value) and ", line " in str(error.value) and "\n" not in str(error.value)


def test_what_a_file_leaves_out_is_as_the_built_in_one_has_it(tmp_path):
    """Files of before a key came, and sections that give some of their keys, are read; the rest has its default."""
    (tmp_path / "short.yaml").write_text(SHORT.format(more="cartons: {most: 3}, second_support: {within: 5 cm}"))
    loose = read_document(tmp_path / "short.yaml").prior.loose
    assert loose.cartons.most == 3 and loose.cartons.probability == 0.02 and loose.within == 0.05
    assert replace(loose, cartons=Cartons(), within=Loose().within, unit=1.0) == replace(Loose(), unit=1.0)


def test_correlations_that_exclude_each_other_are_told(tmp_path):
    (tmp_path / "wrong.yaml").write_text(SHORT.format(more="shared: {least: 0.8, most: 0.5}"))
    with pytest.raises(DerenderError, match=r"line 5, structure.shared: the least correlation is not below the most"):
        read_document(tmp_path / "wrong.yaml")


def test_floors_of_cameras_that_are_all_at_one_height_are_told_as_a_fault(tmp_path):
    (tmp_path / "wrong.yaml").write_text(SHORT.format(more="floor: {height: 50 cm, spread: 0.5}"))
    with pytest.raises(DerenderError, match=r"line 5, structure.floor.spread: '0.5' is too"):
        read_document(tmp_path / "wrong.yaml")


def test_a_coarser_slack_is_a_wider_density():
    """The numbers about contacts reach the density too: a leaning solid that is off by a centimetre."""
    loose = replace(bare_image().loose, slack=0.01)
    graph = SCENES["stack"]
    wide = Rules(loose.slack, beliefs=bare_image()._replace(loose=loose))
    assert scene_log_prior(graph, wide) == pytest.approx(scene_log_prior(graph))  # what stands upright has no slack


def test_a_thing_reaches_as_much_farther_along_the_line_of_sight_as_the_file_says(monkeypatch):
    size = np.array([0.1, 0.1, 0.1])
    monkeypatch.setattr(free_forms, "surface_of", lambda *_: ("", size, np.array([0.0, 0.0, 0.05])))
    away = np.array([1.0, 0.0, 0.0])
    thing = Thing(np.ones((4, 4), bool), make_row(BOX, np.eye(3), [0.0, 0.0, 0.05], size), FLOOR, (0.9, 0.05), away)
    even = np.full((4, 4), 0.002)
    surface = SimpleNamespace(jump=even)
    seen = SimpleNamespace(things=(thing,), footprint=even, sigma=1e-6 * even, surface=surface, image=None)
    none = np.zeros((4, 500))
    part = StructurePosterior(scene(), (), np.zeros((4, 500, 0)), none, none)
    for believed in (Things(), Things(whole=0.4, hidden=0.3, silhouette=1.5)):
        (found,) = free_forms.with_things(np.random.default_rng(0), [part], seen, State(), believed)
        length, height = (found.values[..., found.addresses.index(f"thing_1.{name}")] for name in ("length", "height"))
        assert length[found.best_place] == 0.1  # the likeliest is what is seen
        reaches = length - 0.1 > 4.0 * 0.002 * believed.silhouette
        left = 2.0 * ndtr(-4.0 * 0.002 * believed.silhouette / (0.1 * believed.hidden))
        assert reaches.mean() == pytest.approx((1.0 - believed.whole) * left, abs=0.03)
        assert np.sqrt(np.mean((length - 0.1) ** 2)) == pytest.approx(
            np.hypot(0.1 * believed.hidden * np.sqrt(1.0 - believed.whole), 0.002 * believed.silhouette), rel=0.1
        )
        assert height.std() == pytest.approx(0.002 * believed.silhouette, rel=0.1)
    seen.things = (thing._replace(guessed=np.array([0.06, 0.0, 0.0])),)  # half as deep, or as deep again, is as likely
    (found,) = free_forms.with_things(np.random.default_rng(0), [part], seen, State(), Things())
    guess = found.values[..., found.addresses.index("thing_1.length")]
    assert np.median(guess) == pytest.approx(0.1, abs=0.003) and guess.min() > 0.03
    seen.things = (thing._replace(guessed=np.array([0.11, 0.0, 0.0])),)  # of a box that is deeper than the surface
    (found,) = free_forms.with_things(np.random.default_rng(0), [part], seen, State(), Things())
    assert (found.values > 0.0).all()


def test_what_a_thing_may_be_instead_has_its_share(monkeypatch):
    size, even = np.array([0.1, 0.1, 0.1]), np.full((4, 4), 0.002)
    monkeypatch.setattr(free_forms, "surface_of", lambda *_: ("", size, np.array([0.0, 0.0, 0.05])))
    row = make_row(BOX, np.eye(3), [0.0, 0.0, 0.05], size)
    thing = Thing(np.ones((4, 4), bool), row, FLOOR, (0.9, 0.05), np.zeros(3))
    surface = SimpleNamespace(jump=even)
    seen = SimpleNamespace(things=(thing,), footprint=even, sigma=1e-6 * even, surface=surface, image=None)
    none, rng, settings = np.zeros((2, 50)), np.random.default_rng(0), Settings()
    part = StructurePosterior(scene(), (), np.zeros((2, 50, 0)), none, none)
    parts = free_forms.with_things(rng, [part], seen, State(), Things())
    box = State().add(row, UPRIGHT, False, FLOOR, 0.0)
    for odds, count in ((-1.0, 2), (-20.0, 1)):
        monkeypatch.setattr(free_forms, "swaps", lambda *_, odds=odds: [Swap(0, odds, box)])
        found = Posterior(tuple(free_forms.with_rivals(rng, parts, seen, State(), settings)))
        assert len(found.parts) == count and sum(each.weight for each in found.parts) == pytest.approx(1.0)
        assert found.object_probability("thing_1") == pytest.approx(1.0)
    monkeypatch.setattr(free_forms, "swaps", lambda *_: [Swap(0, -1.0, box)])
    found = Posterior(tuple(free_forms.with_rivals(rng, parts, seen, State(), settings)))
    assert found.shape_probability("thing_1")["box"] == pytest.approx(1.0 / (1.0 + np.exp(1.0)))
    back = free_forms.with_rivals(rng, [found.parts[1]], seen, State(), settings)
    assert len(back) == 1  # it is that solid already
    upon = Vertex("upon", "cube", {"side": 0.03}, "thing_1",
                  Contact("face-to-face", "+z", "-z", {"u": 0.5, "v": 0.5, "theta": 0.0}))  # fmt: skip
    (first,) = parts
    held = replace(first, graph=first.graph.add(upon), addresses=(*first.addresses, "upon.side"), periods=(),
                   values=np.concatenate([first.values, np.full((2, 50, 1), 0.03)], axis=2))  # fmt: skip
    (same,) = free_forms.with_rivals(rng, [held], seen, State(), settings)
    assert same is held  # what stands on it would be gone with it, and its numbers left
