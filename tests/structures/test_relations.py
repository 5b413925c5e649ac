"""What a tree of exact contacts cannot say, under `infer --scene`: `on`, second supports, pairs that do not touch."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from small_scenes import OPENING, SceneWorld, read

from derender.document import read_document, read_prior_document
from derender.errors import DerenderError
from derender.posterior.sampler import Settings
from derender.render.raycast.depth import render_depth
from derender.scene.priors.terms import RestsOn, total_log_density
from derender.scene.separation import rest_residual, separation
from derender.structures.given import infer_scene, structures, targets
from derender.structures.options import Options

FEW = Settings(draws=250, warmup=150, chains=2)
# An image of so much noise that it says next to nothing: the posterior is the prior, which has its terms.
BLIND = "likelihood: {type: gaussian, sigma: 5, background: 1.5}\n"
APART = (
    OPENING
    + """  a:
    shape: {type: cube, side: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: {uniform: [-0.2, 0.0]}, y: 0}
  b:
    shape: {type: cube, side: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: {uniform: [0.0, 0.2]}, y: 0}
"""
    + BLIND
)
BRIDGE = (
    OPENING
    + """  left:
    shape: {type: box, length: 0.06, width: 0.1, height: {uniform: [0.05, 0.12]}}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: -0.1, y: 0}
  right:
    shape: {type: box, length: 0.06, width: 0.1, height: {uniform: [0.05, 0.12]}}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: 0.1, y: 0}
  deck:
    shape: {type: box, length: 0.3, width: 0.1, height: 0.03}
    parent: left
    supports: [right]
    contact: {type: face-to-face, theta: 0, u: 0.8, v: 0.5}
"""
    + BLIND
)


def infer(text, seed=3):
    """Return the posterior's likeliest part given an image of a draw, and the draw."""
    world = SceneWorld(text)
    rng = np.random.default_rng(seed)
    truth = world.sample(rng)
    image = world.target(rng, truth).images.observed
    return infer_scene(world.document, image, world.document.camera, FEW, Options(seed=seed)).posterior.best_part, truth


@pytest.mark.slow
def test_objects_that_do_not_touch_keep_their_distance():
    constraint = "constraints: [does-not-touch: {objects: [a, b], margin: 3 cm}]\n"
    gaps = {}
    for text in (APART, APART + constraint):
        part, _ = infer(text)
        columns = {address: part.values[..., k] for k, address in enumerate(part.addresses)}
        gaps[text] = columns["b.contact.x"] - columns["a.contact.x"] - 0.1
    assert (gaps[APART] < 0.03).mean() > 0.1  # nothing else would keep them apart
    assert gaps[APART + constraint].min() > 0.03
    # a pair of uniform places, less those too near
    thinned = gaps[APART + constraint][:, ::25].ravel()
    near = _triangle(0.03)
    assert stats.kstest(thinned, lambda x: (_triangle(x) - near) / (1 - near)).pvalue > 1e-3


def _triangle(gap):
    """Return the probability that b.x - a.x - 0.1 is less: x's are uniform on [-0.2, 0] and [0, 0.2]."""
    t = (np.asarray(gap) + 0.1) / 0.2
    return np.where(t < 1, 0.5 * np.clip(t, 0, 1) ** 2, 1 - 0.5 * (2 - np.clip(t, 1, 2)) ** 2)


@pytest.mark.slow
def test_a_second_support_ends_where_the_first_does():
    part, _ = infer(BRIDGE)
    free, _ = infer(BRIDGE.replace("    supports: [right]\n", ""))
    steps = [np.abs(p.values[..., p.addresses.index("left.height")] - p.values[..., p.addresses.index("right.height")])
             for p in (part, free)]  # fmt: skip
    assert np.quantile(steps[0], 0.9) < 0.003 and np.median(steps[1]) > 0.01  # a slack of 1 mm; without it centimetres
    wide, _ = infer(BRIDGE + "constraints: [rests-on: {objects: [deck, right], slack: 2 cm}]\n")
    step = np.ptp([wide.values[..., wide.addresses.index(f"{name}.height")] for name in ("left", "right")], axis=0)
    assert np.median(step) > 0.004
    assert part.graph.vertex("deck").supports == ("right",)


def test_how_far_from_resting():
    document = read(BRIDGE.replace("{uniform: [0.05, 0.12]}", "0.08"))
    graph = document.graph

    def away(scene):
        solids, names = scene.solids(), scene.solid_names
        a, b = names.index("deck"), names.index("right")
        up = -scene.down()
        return rest_residual(int(solids.kind[a]), solids.pose[a], solids.size[a], int(solids.kind[b]), solids.pose[b],
                             solids.size[b], *up)  # fmt: skip

    assert away(graph) == pytest.approx(0.0, abs=1e-12)
    assert away(graph.with_numbers({"right.height": 0.075})) == pytest.approx(0.005 * np.sqrt(2), abs=1e-9)  # below it
    assert away(graph.with_numbers({"right.height": 0.085})) == pytest.approx(0.005, abs=1e-9)  # in it
    term = RestsOn("deck", "right", slack=0.002)
    assert term.log_density(graph.with_numbers({"right.height": 0.085})) == pytest.approx(-0.5 * 2.5**2, abs=1e-6)
    beside = graph.with_numbers({"right.contact.x": 0.5})
    solids, names = beside.solids(), beside.solid_names
    gap = separation(solids, names.index("deck"), names.index("right"))
    assert gap > 0.1 and away(beside) == pytest.approx(gap, abs=1e-6)  # as high, but elsewhere


@pytest.mark.parametrize("lying", [False, True])
def test_on_finds_the_contact(lying):
    """A can stands or lies, and on the box or beside it: all of that is open, and the image says."""
    scene = (
        OPENING
        + """  box:
    shape: {type: box, length: 0.2, width: 0.2, height: 0.05}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: -0.05, y: 0}
  can:
    shape: {type: cylinder, radius: 0.04, height: 0.14}
    parent: CONTACT
likelihood: {type: gaussian, sigma: 0.02, background: 1.5}
"""
    )
    true = ("box\n    contact: {type: side-on-face, u: 0.5, v: 0.5, theta: 0.3}" if lying
            else "floor\n    contact: {type: face-to-face, child_face: -z, x: 0.15, y: 0}")  # fmt: skip
    asked = "{categorical: {box: 1, floor: 1}}\n    contact: {type: on, x: {uniform: [-0.2, 0.2]}, "
    asked += "y: {uniform: [-0.2, 0.2]}}"
    document, truth = read(scene.replace("CONTACT", asked)), read(scene.replace("CONTACT", true)).graph
    clean, _ = render_depth(truth.solids(), document.camera, background=1.5)
    image = clean + np.random.default_rng(1).normal(scale=0.02, size=clean.shape)
    part = infer_scene(document, image, document.camera, FEW).posterior.best_part
    can = part.graph.vertex("can")
    assert part.weight > 0.95
    assert (can.parent, can.contact.type) == (("box", "side-on-face") if lying else ("floor", "face-to-face"))
    found, wanted = part.best()[0].poses()["can"], truth.poses()["can"]
    assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < 0.015


def test_structures_that_say_the_same_are_one():
    image = np.ones((18, 24))

    def structures(shape, theta=""):
        contact = f"{{type: on, x: {{normal: [0, 0.1]}}, y: {{normal: [0, 0.1]}}{theta}}}"
        document = read(OPENING + f"  thing: {{shape: {shape}, parent: floor, contact: {contact}}}\n" + BLIND)
        return targets(document, image, document.camera, 0)

    cube = structures("{type: cube, side: 0.1}")
    assert len(cube) == 1 and cube[0][0].template.vertex("thing").contact.child_face == "-z"
    assert cube[0][1] == pytest.approx(0.0, abs=1e-9)  # all six faces' prior together
    box = structures("{type: box, length: 0.1, width: 0.06, height: 0.03}")
    assert sorted(t.template.vertex("thing").contact.child_face for t, _ in box) == ["+x", "+y", "-z"]
    np.testing.assert_allclose([weight for _, weight in box], np.log(1 / 3), atol=1e-9)
    can = structures("{type: cylinder, radius: 0.05, height: 0.1}")
    assert len(can) == 2  # standing, on whichever end, and lying
    # half a turn of theta alone: which face is down says where the other half went, so all six differ
    half = structures("{type: cube, side: 0.1}", ", theta: {uniform: [0, 45 deg]}")
    assert len(half) == 6


@pytest.mark.parametrize(
    "constraint, message",
    [
        ("rests-on", "write rests-on: [a, b]"),
        ("rests-on: [deck, deck]", "names deck twice"),
        ("rests-on: [deck, rihgt]", "did you mean 'right'"),
        ("rests-on: {objects: [deck, right], slack: -1}", "slack"),
    ],
)
def test_faults_of_a_second_support(constraint, message):
    with pytest.raises(DerenderError, match=message.replace("[", r"\[")):
        read(BRIDGE + f"constraints: [{constraint}]\n")


def test_a_scene_with_a_bridge_is_itself_whatever_its_gap(tmp_path):
    text = BRIDGE.replace("{uniform: [0.05, 0.12]}", "0.08", 1).replace("{uniform: [0.05, 0.12]}", "0.07")
    path = Path(tmp_path / "scene.yaml")
    path.write_text(text)
    assert read_document(path).graph.numbers()["right.height"] == 0.07  # as inferred: no prior is asked


EITHER = """  low:
    shape: {type: cube, side: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: 0, y: 0}
  beside:
    shape: {type: cube, side: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: 0.3, y: 0}
  high:
    shape: {type: cube, side: 0.1}
    parent: {categorical: {low: 1, floor: 1}}
    contact: {type: on, theta: 0, x: {uniform: [0.05, 0.3]}, y: 0}
"""


@pytest.mark.slow
def test_a_structure_counts_where_the_terms_allow_a_scene_of_it():
    """Terms allow one scene in sixty of the can on the deck, and none of what may not touch that on which it stands."""
    prior = read_prior_document("relations").prior
    found = structures(prior, np.random.default_rng(0))
    assert {graph.vertex("can").parent for graph in found} == {"deck", "floor"}
    assert all(total_log_density(prior.constraints, graph) > -np.inf for graph in found)
    assert all(len(graph.constraints) == 2 for graph in found)
    for terms, parents in (("", {"low", "floor"}), ("constraints: [{does-not-touch: [floor, high]}]\n", {"low"})):
        found = structures(read(OPENING + EITHER + BLIND + terms).prior, np.random.default_rng(0))
        assert {graph.vertex("high").parent for graph in found} == parents


@pytest.mark.slow
@pytest.mark.parametrize("term", ["no-overlap", "no-overlap: {scale: 0.03}"])
def test_structures_weigh_what_the_terms_leave_of_them(term):
    """On the floor half of the places are taken, softly or not; a blind image leaves the prior's own shares."""
    document = read(OPENING + EITHER + BLIND + f"constraints: [{term}]\n")
    rng = np.random.default_rng(3)
    drawn = [document.prior.sample(rng).vertex("high").parent for _ in range(1500)]
    share = np.mean([parent == "low" for parent in drawn])
    assert share > 0.55  # and 0.5 without the terms
    image = np.full(document.camera.shape, 1.5)
    posterior = infer_scene(document, image, document.camera, FEW).posterior
    weight = sum(part.weight for part in posterior.parts if part.graph.vertex("high").parent == "low")
    # Evidence by 200 draws of which 0.4 and more count is good to 0.09, the share of 1500 scenes to 0.012.
    error = np.hypot(share * (1 - share) * np.sqrt((1 - 0.4) / (0.4 * 200)), np.sqrt(share * (1 - share) / 1500))
    assert abs(weight - share) < 4 * error < abs(share - 0.466)  # 0.466 was the answer when terms were left out
