"""Priors: Eq. 4 by hand, masses that sum to one, frequencies that match, broken twins that do not."""

import itertools
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from derender.document import built_in_priors, document_from, document_text, read_prior_document
from derender.errors import DerenderError
from derender.report.scores import why_impossible
from derender.scene.codec.yaml_tree import parse_yaml
from derender.scene.distributions import Categorical, distributions
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_x, translation
from derender.scene.priors.grammar import Algorithm1Prior, GrammarPrior
from derender.scene.priors.objects import ContactPrior, ContactRule, ShapePrior
from derender.scene.priors.tree import FixedRoot, FreeRoot, LookedAtRoot, TreeObject, TreePrior

uniform = distributions["uniform"]
ROOT = FixedRoot(np.eye(4))
FLOATING = ContactRule("6dof", values={"x": uniform(-1, 1), "y": uniform(-1, 1), "z": uniform(0, 2)})
STANDING = ContactRule(
    "face-to-face", parent_face="top", child_face="-z", values={"x": uniform(-1, 1), "y": uniform(-1, 1)}
)


def prior_of(text):
    return document_from(parse_yaml("derender: 1\n" + text, "prior.yaml"), Path(".")).prior


def structure_log_probability(prior, graph):
    """log p of the discrete part: the density without that of the free numbers."""
    total = prior.log_density(graph)
    for address, distribution in prior.free_addresses(graph).items():
        total -= distribution.log_density(number(prior, graph, address))
    return total


def number(prior, graph, address):
    name, _, key = address.partition(".")
    if name == "root":
        return prior.root.values(graph.root_pose)[address]
    vertex = graph.vertex(name)
    if key == "contact.quat_wxyz":
        return tuple(vertex.contact.values[part] for part in ("qw", "qx", "qy", "qz"))
    return vertex.contact.values[key[8:]] if key.startswith("contact.") else vertex.parameters[key]


def chi_square(counts, probabilities, draws):
    """p-value of counts by structure against probabilities by structure; the rest is one cell."""
    cells = [(counts.get(key, 0), p * draws) for key, p in probabilities.items() if p * draws >= 5]
    observed, expected = (list(column) for column in zip(*cells, strict=True))
    rest = draws - sum(expected)
    if rest > 1:
        observed.append(draws - sum(observed))
        expected.append(rest)
    expected = np.array(expected) * sum(observed) / sum(expected)
    return stats.chisquare(observed, expected).pvalue


# ---- Algorithm 1 -----------------------------------------------------------------------------------------------------


def algorithm_1(first=1.3, second=0.8):
    sides = dict.fromkeys(("length", "width", "height"), uniform(0.1, 0.2))
    shapes = {"cube": ShapePrior("cube", {"side": uniform(0.1, 0.3)}), "box": ShapePrior("box", sides)}
    return Algorithm1Prior(ROOT, shapes, ContactPrior((FLOATING, ContactRule("face-to-face"))), first, second)


def test_equation_4_by_hand():
    """One parent box, two children: every factor of Eq. 4 written out."""
    pose = {"x": 0.0, "y": 0.1, "z": 1.0, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
    on = {"theta": 0.2, "u": 0.5, "v": 0.25}
    graph = SceneGraph(
        root_pose=np.eye(4),
        vertices=(
            Vertex(
                "a", "box", {"length": 0.15, "width": 0.15, "height": 0.15}, "root", Contact("6dof", None, None, pose)
            ),
            Vertex("b", "cube", {"side": 0.2}, "a", Contact("face-to-face", "+z", "-z", on)),
            Vertex("c", "cube", {"side": 0.2}, "a", Contact("face-to-face", "-x", "+y", on)),
        ),
    )
    expected = (
        stats.poisson(1.3).pmf(1)
        * stats.poisson(0.8).pmf(2)
        * (1 / 2 * 10**3)  # 1/|S| p_s(psi): three sides uniform over 0.1 m
        * (1 / 2 * 5) ** 2
        * 1**-2  # parents
        * (1 / 36 * 2 / math.pi) ** 2  # 36 face pairs, theta over pi/2, u and v over 1
        * (1 / 2) ** 3  # x, y, z over 2 m; the rotation is Haar
    )
    assert algorithm_1().log_density(graph) == pytest.approx(math.log(expected), abs=1e-12)


def test_what_must_be_zero_is_zero():
    prior = algorithm_1()
    rng = np.random.default_rng(4)
    graph = next(g for g in iter(lambda: prior.sample(rng), None) if len(g.children("parent_1")) >= 2)
    assert math.isfinite(prior.log_density(graph))
    child = graph.children("parent_1")[0]
    deeper = graph.add(replace(graph.vertex(child), name="deeper", parent=child))
    touch, values = graph.vertex(child).contact, {"theta": 0.1, "u": 0.5, "v": 0.5}

    def touching(**changed):
        return graph.replace(child, contact=replace(touch, values={**values, **changed}))

    def floating(*vertices):
        return SceneGraph(np.eye(4), vertices)

    assert math.isfinite(prior.log_density(touching()))
    sphere = Vertex("s", "sphere", {"radius": 0.1}, "root", graph.vertex("parent_1").contact)
    wrong = {
        "too deep": deeper,
        "a shape that is not in S": graph.add(sphere),
        "a side outside p_s": graph.replace(child, shape="cube", parameters={"side": 0.5}),
        "u outside [0, 1]": touching(u=1.1),
        "a gap": touching(gap=0.001),
        "a bridge": graph.replace(child, supports=("parent_1",)),
        "another root pose": replace(graph, root_pose=translation(0, 0, 1e-3)),
        "a parent in contact with the root": graph.replace("parent_1", contact=Contact("face-to-face", "+z", "-z", {})),
        "no 6dof under the root": floating(Vertex("x", "cube", {"side": 0.2}, "root", touch)),
    }
    for what, other in wrong.items():
        assert prior.log_density(other) == -math.inf, what


def test_equation_4_sums_to_its_stated_mass():
    """Over all assignments of up to 14 children to up to 14 parents; what is beyond has mass 1e-9."""
    prior = algorithm_1()
    total = 0.0
    for first, second in itertools.product(range(15), range(15)):
        if first == 0 and second > 0:
            continue
        vertices = [vertex(f"p{i}", "root") for i in range(first)] + [vertex(f"c{j}", "p0") for j in range(second)]
        one = math.exp(structure_log_probability(prior, SceneGraph(np.eye(4), tuple(vertices))))
        shapes, contacts = 2 ** (first + second), 36**second  # every shape and contact has the same probability
        total += one * shapes * contacts * first**second
    assert total == pytest.approx(normaliser(prior), abs=1e-8)


def normaliser(prior):
    """Return Z, the mass of all graphs under Eq. 4."""
    return 1 - math.exp(-prior.mean_parents) * (1 - math.exp(-prior.mean_children))


def vertex(name, parent):
    if parent == "root":
        contact = Contact(
            "6dof", None, None, {"x": 0.0, "y": 0.0, "z": 1.0, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
        )
    else:
        contact = Contact("face-to-face", "+z", "-z", {"theta": 0.1, "u": 0.5, "v": 0.5})
    return Vertex(name, "cube", {"side": 0.2}, parent, contact)


def algorithm_1_frequencies(prior, draws=6000):
    """Count structures by (parents, sorted sizes of families) and give each its probability under `prior`."""
    rng = np.random.default_rng(12)
    counts, probabilities = Counter(), {}
    for _ in range(draws):
        graph = prior.sample(rng)
        parents = [v.name for v in graph.vertices if v.parent == "root"]
        key = tuple(sorted(len(graph.children(name)) for name in parents))
        counts[key] += 1
        if key not in probabilities:
            # all shapes, all contacts, and every way to assign labelled children to labelled parents
            children = sum(key)
            one = math.exp(structure_log_probability(prior, graph)) / normaliser(prior)
            assignments = math.factorial(children) / math.prod(map(math.factorial, key))
            assignments *= math.factorial(len(key)) / math.prod(math.factorial(n) for n in Counter(key).values())
            probabilities[key] = one * 2 ** len(graph.vertices) * 36**children * assignments
    return counts, probabilities, draws


def test_algorithm_1_frequencies_match_equation_4():
    assert chi_square(*algorithm_1_frequencies(algorithm_1())) > 1e-3


def test_algorithm_1_without_the_parent_factor_is_seen():
    class Broken(Algorithm1Prior):
        def log_density(self, graph):  # the factor 1/|V_1| for each child is gone
            first = len(graph.children("root"))
            return super().log_density(graph) + (len(graph.vertices) - first) * math.log(max(first, 1))

    right = algorithm_1()
    broken = Broken(right.root, right.shapes, right.contacts, right.mean_parents, right.mean_children)
    assert chi_square(*algorithm_1_frequencies(broken)) < 1e-6


# ---- the grammar -----------------------------------------------------------------------------------------------------


def grammar(**offspring):
    floor = TreeObject("floor", ShapePrior("plane"), ContactPrior((ContactRule("6dof", fill=False),)))
    shapes = {
        "cube": ShapePrior("cube", {"side": uniform(0.1, 0.3)}, weight=2.0),
        "sphere": ShapePrior("sphere", {"radius": uniform(0.1, 0.2)}),
        "cylinder": ShapePrior("cylinder", {"radius": 0.1, "height": 0.2}),
    }
    at = {"x": uniform(-1, 1), "y": uniform(-1, 1)}
    rolling, lying = (ContactRule(kind, parent_face="top", values=at) for kind in ("point-on-face", "side-on-face"))
    counts = {
        "floor": Categorical({0: 0.3, 1: 0.5, 2: 0.2}),
        "cube": distributions["geometric"](0.3),
        "cylinder": Categorical({0: 0.6, 1: 0.4}),
    }
    return GrammarPrior(ROOT, (floor,), shapes, ContactPrior((STANDING, rolling, lying)), {**counts, **offspring})


def canonical(graph, name="floor"):
    """The ordered tree of shapes and contacts below an object."""
    below = []
    for child in graph.children(name):
        v = graph.vertex(child)
        below.append((v.shape, v.contact.type, v.contact.parent_face, v.contact.child_face, canonical(graph, child)))
    return tuple(below)


def grammar_frequencies(prior, draws=6000):
    rng = np.random.default_rng(3)
    counts, probabilities = Counter(), {}
    for _ in range(draws):
        graph = prior.sample(rng)
        key = canonical(graph)
        counts[key] += 1
        if key not in probabilities:
            probabilities[key] = math.exp(structure_log_probability(prior, graph))
    return counts, probabilities, draws


def test_grammar_frequencies_match_their_probabilities():
    counts, probabilities, draws = grammar_frequencies(grammar())
    assert len(counts) > 50 and sum(probabilities.values()) < 1 + 1e-12
    assert sum(probabilities.values()) > 0.95  # the structures seen hold nearly all the mass
    assert chi_square(counts, probabilities, draws) > 1e-3


@pytest.mark.slow
def test_a_grammar_that_forgets_who_bears_nothing_is_seen():
    class Broken(GrammarPrior):
        def log_density(self, graph):  # the zeros of the leaves are left out
            leaves = sum(not graph.children(v.name) for v in graph.vertices if v.shape == "cube")
            return super().log_density(graph) - leaves * math.log(0.7)

    right = grammar()
    broken = Broken(right.root, right.base, right.shapes, right.contacts, right.offspring)
    assert chi_square(*grammar_frequencies(broken)) < 1e-6


def test_grammar_masses_sum_to_one():
    """By the generating recursion: the mass of all trees of at most n generations tends to one, geometrically."""
    prior = grammar()

    def mass(kind, shape, top, generations):
        count = prior._bears(kind, shape, top)
        if count is None:
            return 1.0
        below = sum(
            p * q * mass(child, prior.shapes[child].type, top_of(child, choice), generations - 1)
            for child, p in prior.kinds(shape, top).probabilities.items()
            for choice, q in prior.contacts.choices(shape, prior.shapes[child].type, top)[0].probabilities.items()
        ) if generations else 0.0  # fmt: skip
        return sum(math.exp(count.log_density(k)) * below**k for k in range(40))

    from derender.scene.priors.objects import top_face

    def top_of(child, choice):
        return top_face(prior.shapes[child].type, choice[0], choice[2])

    missing = [1 - mass("floor", "plane", "+z", generations) for generations in (2, 4, 8)]
    assert missing[0] > missing[1] > missing[2] and missing[2] < 2 * prior.spectral_radius**8


@pytest.mark.parametrize("more,consistent", [(0.5, True), (0.8, False)])
def test_an_inconsistent_grammar_is_refused(more, consistent):
    """Cubes are half of what grows: with mean offspring 4 the process explodes."""
    law = distributions["geometric"](more)
    if consistent:
        assert grammar(cube=law).spectral_radius < 1
    else:
        with pytest.raises(DerenderError, match="not consistent"):
            grammar(cube=law)


def test_grammar_zeros():
    prior = grammar()
    rng = np.random.default_rng(0)
    graph = next(g for g in iter(lambda: prior.sample(rng), None) if "sphere_1" in g.names)
    on_sphere = graph.add(replace(graph.vertex("sphere_1"), name="other", parent="sphere_1"))
    assert prior.log_density(on_sphere) == -math.inf
    assert prior.log_density(graph.remove("floor")) == -math.inf
    assert prior.log_density(graph.replace("sphere_1", supports=("floor",))) == -math.inf


def test_names_never_change_a_density():
    for prior in (grammar(), algorithm_1()):
        graph = prior.sample(np.random.default_rng(8))
        renamed = graph.renamed({name: f"{name}_again" for name in graph.names if name != "floor"})
        assert prior.log_density(renamed) == prior.log_density(graph)


# ---- trees -----------------------------------------------------------------------------------------------------------

OPEN_TREE = """
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red: {shape: {type: cube, side: 0.1}, parent: floor, contact: {type: face-to-face, theta: 0, x: 0, y: 0}}
  can:
    shape: {type: cylinder, radius: 0.04, height: {uniform: [8 cm, 12 cm]}}
    parent: {categorical: {floor: 3, red: 1}}
    contact: {type: on, x: {normal: [0, 0.1]}, y: {normal: [0, 0.1]}}
  lid:
    shape: {type: cube, side: {truncated-normal: [0.05, 0.01, 0.02, 0.1]}}
    parent: red
    contact: {type: face-to-face, child_face: {categorical: {+x: 1, -z: 4}},
              theta: {von-mises: [0, 3, 90 deg]}, u: {beta: [2, 2]}, v: 0.5}
"""


def test_open_parents_faces_and_contacts():
    prior = prior_of(OPEN_TREE)
    rng = np.random.default_rng(1)
    counts, probabilities, draws = Counter(), {}, 4000
    for _ in range(draws):
        graph = prior.sample(rng)
        counts[graph.structure()] += 1
        probabilities.setdefault(graph.structure(), math.exp(structure_log_probability(prior, graph)))
    assert len(probabilities) == 2 * 3 * 2  # parents x (standing on either end, lying) x faces of the lid
    assert sum(probabilities.values()) == pytest.approx(1, abs=1e-12)
    assert chi_square(counts, probabilities, draws) > 1e-3


def test_density_integrates_to_one_by_quadrature():
    """Three free numbers of one structure, by Gauss-Legendre over their supports."""
    prior = prior_of("""
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red:
    shape: {type: cube, side: {truncated-normal: [0.1, 0.03, 0.02, 0.15]}}
    parent: floor
    contact: {type: face-to-face, theta: {von-mises: [20 deg, 2, 90 deg]}, x: {beta: [2, 3, -0.1, 0.2]}, y: 0}
""")
    graph = prior.sample(np.random.default_rng(0))
    nodes, weights = np.polynomial.legendre.leggauss(16)
    free = prior.free_addresses(graph)
    assert list(free) == ["red.side", "red.contact.theta", "red.contact.x"]
    grids = [(0.5 * (b - a) * (nodes + 1) + a, 0.5 * (b - a) * weights) for a, b in (d.support for d in free.values())]
    total = 0.0
    for points in itertools.product(*(list(zip(*grid, strict=True)) for grid in grids)):
        values = dict(zip(free, (float(x) for x, _ in points), strict=True))
        total += math.prod(w for _, w in points) * math.exp(prior.log_density(graph.with_numbers(values)))
    assert total == pytest.approx(1.0, abs=1e-6)


def test_slack_is_a_prior_on_the_residual():
    prior = prior_of("""
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red:
    shape: {type: cube, side: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: 0, y: 0,
              gap: {normal: [0, 2 mm]}, tilt_x: {normal: [0, 1 deg]}, tilt_y: {normal: [0, 1 deg]}}
""")
    graph = prior.sample(np.random.default_rng(0))
    assert set(prior.free_addresses(graph)) == {"red.contact.gap", "red.contact.tilt_x", "red.contact.tilt_y"}
    ideal = graph.replace("red", contact=Contact("face-to-face", "+z", "-z", {"theta": 0.0, "x": 0.0, "y": 0.0}))
    expected = stats.norm(0, 0.002).logpdf(0) + 2 * stats.norm(0, math.pi / 180).logpdf(0)
    assert prior.log_density(ideal) == pytest.approx(expected, abs=1e-12)


# ---- roots, terms, built-in priors ---------------------------------------------------------------------------------


def test_root_coordinates_come_back_from_the_pose():
    rng = np.random.default_rng(2)
    looked_at = LookedAtRoot(uniform(0.5, 1), uniform(-1.2, 1.2), uniform(0, 2 * math.pi), uniform(-0.5, 0.5))
    free = FreeRoot((uniform(-1, 1), 0.0, uniform(1, 2)), distributions["uniform-rotation"]())
    for root in (looked_at, free):
        for _ in range(50):
            pose = root.sample(rng)
            values = root.values(pose)
            np.testing.assert_allclose(root.pose(values), pose, atol=1e-14)
            product = sum(law.log_density(values[address]) for address, law in root.free_addresses().items())
            assert root.log_density(pose) == pytest.approx(product, abs=1e-12)
        assert root.log_density(translation(0.1, 0.2, 0.3) @ rotation_x(3.0)) == -math.inf


def test_the_camera_looks_down_at_the_origin():
    """From 30 degrees above: the root's z is up in the image, its y goes away, its origin is on the axis."""
    pose = LookedAtRoot(0.8, math.radians(30)).sample(None)
    np.testing.assert_allclose(pose[:3, 3], (0, 0, 0.8))
    np.testing.assert_allclose(pose[:3, 0], (1, 0, 0), atol=1e-15)
    np.testing.assert_allclose(pose[:3, 2], (0, -math.sqrt(0.75), -0.5), atol=1e-15)
    np.testing.assert_allclose(pose[:3, 1], (0, -0.5, math.sqrt(0.75)), atol=1e-15)


def test_no_overlap_and_does_not_touch():
    prior = prior_of("""
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  a: {shape: {type: cube, side: 0.1}, parent: floor, contact: {type: face-to-face, theta: 0, x: 0, y: 0}}
  b:
    shape: {type: cube, side: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: 0, x: {uniform: [0, 0.3]}, y: 0}
constraints: [no-overlap, {does-not-touch: {objects: [a, b], margin: 2 cm}}]
""")
    rng = np.random.default_rng(0)
    xs = [prior.sample(rng).vertex("b").contact.values["x"] for _ in range(300)]
    assert min(xs) > 0.12 and stats.kstest(xs, stats.uniform(0.12, 0.18).cdf).pvalue > 1e-3
    graph = prior.sample(rng)
    assert math.isfinite(prior.log_density(graph)) and graph.constraints[0].margin == 0.02
    for x in (0.05, 0.11):
        assert prior.log_density(graph.with_numbers({"b.contact.x": x})) == -math.inf


@pytest.mark.slow
def test_at_most_so_many_objects_keeps_the_proportions_of_the_rest():
    prior = read_prior_document("tabletop").prior
    rng = np.random.default_rng(0)
    sizes = Counter(len(prior.sample(rng).vertices) - 1 for _ in range(1000))
    free = replace(prior, constraints=prior.constraints[1:])
    unbounded = Counter(len(free.sample(rng).vertices) - 1 for _ in range(1000))
    assert max(sizes) == 4 < max(unbounded)
    table = [[counts[k] for k in range(1, 5)] for counts in (sizes, unbounded)]
    assert stats.chi2_contingency(table).pvalue > 1e-3
    five = next(graph for graph in iter(lambda: free.sample(rng), None) if len(graph.vertices) == 6)
    assert prior.log_density(five) == -math.inf < free.log_density(five)


def test_a_soft_term_is_sampled_exactly():
    """x uniform on [0, 0.2], overlap depth 0.1 - x below 0.1: its density there is a half normal."""
    prior = prior_of("""
objects:
  a: {shape: {type: cube, side: 0.1}, contact: {type: 6dof}}
  b: {shape: {type: cube, side: 0.1}, contact: {type: 6dof, x: {uniform: [0, 0.2]}}}
constraints: [no-overlap: {depth: 0.0, scale: 3 cm}]
""")
    rng = np.random.default_rng(0)
    xs = [prior.sample(rng).vertex("b").contact.values["x"] for _ in range(1500)]
    grid = np.linspace(0, 0.2, 2001)
    density = np.exp(-0.5 * (np.maximum(0.1 - grid, 0) / 0.03) ** 2)
    cdf = np.cumsum(density) / density.sum()
    assert stats.kstest(xs, lambda x: np.interp(x, grid, cdf)).pvalue > 1e-3


@pytest.mark.parametrize("name", built_in_priors())
def test_density_survives_the_file_bit_for_bit(name, tmp_path):
    document = read_prior_document(name)
    for seed in range(30):
        graph = document.prior.sample(np.random.default_rng(seed))
        text = document_text(graph, document.camera, document.likelihood, {"seed": seed})
        again = document_from(parse_yaml(text, "again.yaml"), tmp_path)
        order = [graph.names.index(name) for name in again.graph.names]  # one whose parent was open may come earlier
        same = replace(graph, vertices=tuple(graph.vertices[k] for k in order), constraints=again.graph.constraints)
        assert again.graph == same
        log_density = document.prior.log_density(graph)
        assert math.isfinite(log_density) and document.prior.log_density(again.graph) == log_density
        assert again.camera == document.camera and again.made["seed"] == seed


@pytest.mark.parametrize("name", built_in_priors())
def test_free_numbers_are_the_continuous_part(name):
    """The density with the free numbers changed differs by exactly their own densities."""
    prior = read_prior_document(name).prior
    if isinstance(prior, TreePrior | GrammarPrior | Algorithm1Prior):
        prior = replace(prior, constraints=())
    rng = np.random.default_rng(5)
    graph = prior.sample(rng)
    base = structure_log_probability(prior, graph)
    free = {k: d for k, d in prior.free_addresses(graph).items() if d.size == 1 and not k.startswith("root.")}
    moved = graph.with_numbers({address: law.sample(rng) for address, law in free.items()})
    assert structure_log_probability(prior, moved) == pytest.approx(base, abs=1e-9)


def test_figure_3_and_1_count_their_freedom():
    for name, count in {"stack": 15, "free": 24, "two-stacks": 15}.items():
        assert read_prior_document(name).prior.sample(np.random.default_rng(0)).degrees_of_freedom() == count


def test_why_a_prior_rules_a_scene_out():
    prior = read_prior_document("tabletop").prior
    graph = prior.sample(np.random.default_rng(1))
    assert why_impossible(prior, graph) is None
    box = next(v for v in graph.vertices if v.shape == "box")
    twin = replace(box, name="twin", supports=())
    size = replace(box, parameters={**box.parameters, "length": 0.3})
    can = replace(box, shape="cylinder", parameters={"radius": 0.03, "height": 0.1})

    def with_box(vertex):
        return replace(graph, vertices=tuple(vertex if v.name == box.name else v for v in graph.vertices))

    moved = np.array(graph.root_pose)
    moved[0, 3] += 0.1
    for scene, cause in [
        (with_box(size), f"{box.name}.length is 0.3, outside of 0.04 to 0.14"),
        (with_box(can), f"{box.name} is a cylinder, and this prior makes only box, cube"),
        (with_box(replace(box, supports=("floor",))), "a second support"),
        (graph.add(twin), "breaks the constraint no-overlap"),
        (replace(graph, root_pose=moved), "the root does not stand"),
        (graph.remove("floor"), "it has no floor"),
    ]:
        assert cause in why_impossible(prior, scene), cause
    fixed = read_prior_document("figure-4").prior
    more = fixed.sample(np.random.default_rng(0))
    more = more.add(replace(more.vertices[-1], name="extra"))
    assert why_impossible(fixed, more) == "it has extra, which this prior has not"
