"""Every reversible jump: there and back, invariance of the prior, broken twins that fail."""

import math

import numpy as np
import pytest
from invariance import bound
from jump_worlds import TEXTS, generator, prior_of

from derender.scene.priors.objects import ROTATION
from derender.structures.jumps import mixture
from derender.structures.jumps.base import Applied, Move, Target, Vocabulary, evaluate, log_proposal_ratio, moves, step


@pytest.fixture(scope="module", params=list(TEXTS))
def words(request):
    return Vocabulary(prior_of(request.param))


def draws(words, move, seed, wanted, tries=4000):
    """Yield (graph, choice, applied, log ratio) of moves that are possible."""
    rng, found = generator(seed), 0
    for _ in range(tries):
        graph = words.prior.sample(rng)
        choice = move.draw(rng, words, graph)
        if choice is None:
            continue
        applied, ratio = log_proposal_ratio(move, words, graph, choice)
        if applied is None:
            continue
        yield graph, choice, applied, ratio
        found += 1
        if found == wanted:
            return


def solids_by_name(graph):
    """Return {name: (kind, parent, contact, numbers ...)} with floats rounded, to compare scenes as sets."""
    return {
        vertex.name: (
            vertex.shape,
            vertex.parent,
            (vertex.contact.type, vertex.contact.parent_face, vertex.contact.child_face),
            dict(vertex.parameters),
            dict(vertex.contact.values),
        )
        for vertex in graph.vertices
    }


def close(first, second, tolerance=1e-7):
    """Assert that two nests of tuples, dicts, numbers and words agree; rotations up to sign, angles up to a turn."""
    if isinstance(first, dict):
        first, second = _signed(first), _signed(second)
        assert set(first) == set(second), (first, second)
        for key in first:
            if key == "theta" or (isinstance(key, tuple) and key[-1] == "theta"):
                # a difference of 1e-16 at the period's end turns 0 into the period: compare on the circle
                gap = abs(first[key] - second[key])
                gaps = [abs(gap - math.tau / order) for order in (1, 2, 4)]
                assert min(gap, *gaps) < tolerance
            else:
                close(first[key], second[key], tolerance)
    elif isinstance(first, tuple | list):
        assert len(first) == len(second), (first, second)
        for a, b in zip(first, second, strict=True):
            close(a, b, tolerance)
    elif isinstance(first, np.ndarray):
        assert np.allclose(first, second, atol=tolerance)
    elif isinstance(first, float):
        assert abs(first - second) < tolerance, (first, second)
    elif hasattr(first, "__dataclass_fields__"):
        close({k: getattr(first, k) for k in first.__dataclass_fields__},
              {k: getattr(second, k) for k in first.__dataclass_fields__}, tolerance)  # fmt: skip
    else:
        assert first == second, (first, second)


def _signed(values):
    if set(ROTATION) <= set(values):
        quat = np.array([values[part] for part in ROTATION])
        quat = quat * np.sign(quat[np.argmax(np.abs(quat))])
        return {**values, **dict(zip(ROTATION, map(float, quat), strict=True))}
    return values


@pytest.mark.parametrize("name", list(moves))
def test_there_and_back(words, name):
    """The way back restores the scene and the choices, and negates the log ratio (to 1e-6: two inversions of poses)."""
    for graph, choice, applied, ratio in draws(words, moves[name], 1, 25, tries=400):
        back, back_ratio = log_proposal_ratio(moves[name], words, applied.graph, applied.back)
        assert back is not None
        assert abs(ratio + back_ratio) < 1e-6
        close(solids_by_name(back.graph), solids_by_name(graph))
        assert np.allclose(back.graph.root_pose, graph.root_pose, atol=1e-9)
        close(back.back, choice)


# ---- invariance: a draw from the prior stays one ----

# Where each move has the most to do, and how many replicates show its twins. A prior draw is moved a few times by one
# move alone; the mean change of any function of the scene must be zero within its own standard error.
ROWS = {"birth-death": ("grammar", 600), "wiggle": ("slack", 900)}
STEPS = 3


def features(words, graph, log_prior):
    """Return functions of a scene as a set: counts of objects, edges and siblings, sums of sizes, offsets, angles and
    slack."""
    found = dict.fromkeys(
        ("objects", "siblings", "cube", "box", "cylinder", "sphere", "edges", "floating", "first", "carried", "last",
         "square", "volume", "u", "v", "uu", "vv", "uv", "cosine", "sine", "x", "xx", "xy", "z", "turn", "gap", "tilt",
         "face", "side"),
        0.0)  # fmt: skip
    for name in words.grown(graph):
        vertex = graph.vertex(name)
        sizes, numbers = list(vertex.parameters.values()), vertex.contact.values
        found["objects"] += 1.0
        found["siblings"] += sum(other.parent == vertex.parent for other in graph.vertices) - 1.0
        found[vertex.shape] += 1.0
        found["edges"] += vertex.parent not in words.base and vertex.parent != "root"
        found["floating"] += vertex.parent == "root"
        found["first"] += sizes[0]
        found["carried"] += sizes[0] * (vertex.parent not in words.base and vertex.parent != "root")
        found["last"] += sizes[-1]
        found["square"] += sizes[-1] ** 2
        found["volume"] += sizes[0] * sizes[len(sizes) // 2] * sizes[-1]
        u, v, theta = (numbers.get(key, centre) for key, centre in (("u", 0.5), ("v", 0.5), ("theta", 0.0)))
        found["u"] += u
        found["v"] += v
        found["uu"] += (u - 0.5) ** 2
        found["vv"] += (v - 0.5) ** 2
        found["uv"] += (u - 0.5) * (v - 0.5)
        found["cosine"] += math.cos(2.0 * theta)
        found["sine"] += math.sin(4.0 * theta)
        x, y = numbers.get("x", 0.0), numbers.get("y", 0.0)
        found["x"] += x
        found["xx"] += x * x
        found["xy"] += x * y
        found["z"] += numbers.get("z", 0.0)
        found["turn"] += numbers.get("qw", 0.0) ** 2
        found["gap"] += abs(numbers.get("gap", 0.0))
        found["tilt"] += numbers.get("tilt_x", 0.0) ** 2
        found["face"] += (vertex.contact.child_face or "")[:1] == "-"
        found["side"] += vertex.contact.type == "side-on-face"
    return np.array([*found.values(), log_prior])


def verdict(words, move, replicates, seed=3, until_caught=False):
    """Return (largest |z| over the features, share of the steps that changed the scene, bound on |z|).

    until_caught : of a broken twin a quarter or half of the replicates may be proof enough.
    """
    target, differences, accepted = Target(words.prior), [], 0
    for child in np.random.SeedSequence(seed).spawn(replicates):
        if until_caught and len(differences) in (replicates // 4, replicates // 2):
            worst, limit = worst_of(differences)
            if worst > limit:
                return worst, accepted, limit
        rng = np.random.default_rng(child)
        state = evaluate(target, words.prior.sample(rng))
        before = features(words, state.graph, state.log_prior)
        for _ in range(STEPS):
            state, info = step(rng, target, words, move, state)
            accepted += info.accepted
        differences.append(features(words, state.graph, state.log_prior) - before)
    worst, limit = worst_of(differences)
    return worst, accepted / (STEPS * replicates), limit


def worst_of(differences):
    """Return the largest |z| of the means of differences, and the bound on it."""
    differences = np.array(differences)
    spread = differences.std(axis=0, ddof=1)
    alive = spread > 1e-9  # below, a feature changed by rounding only
    z = np.abs(differences.mean(axis=0)[alive]) / spread[alive] * math.sqrt(len(differences))
    return float(z.max()), bound(len(z))


def test_every_move_has_its_row():
    assert sorted(ROWS) == sorted(moves)
    assert {name for name, _ in TWINS} == set(moves)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_leaves_the_prior_as_it_is(name):
    world, replicates = ROWS[name]
    worst, accepted, limit = verdict(Vocabulary(prior_of(world)), moves[name], replicates)
    assert accepted > 0.01
    assert worst < limit


@pytest.mark.slow
def test_the_mixture_leaves_the_frequencies_of_structures():
    """A long chain over the prior visits structures as often as the prior draws them (to 4 standard errors)."""
    words = Vocabulary(prior_of("grammar"))
    rng, target = generator(8), Target(words.prior)
    state = evaluate(target, words.prior.sample(rng))
    steps, shares = [move for move, _ in mixture()], [share for _, share in mixture()]
    chain = []
    for number in rng.choice(len(steps), size=8_000, p=shares):
        state, _ = step(rng, target, words, steps[number], state)
        chain.append([len(words.grown(state.graph)), len(words.leaves(state.graph)),
                      sum(v.shape == "box" for v in state.graph.vertices)])  # fmt: skip
    independent = []
    for _ in range(3000):
        graph = words.prior.sample(rng)
        independent.append([len(words.grown(graph)), len(words.leaves(graph)),
                            sum(v.shape == "box" for v in graph.vertices)])  # fmt: skip
    chain, independent = np.array(chain, float), np.array(independent, float)
    for column in range(3):
        for function in (lambda x: x, lambda x: x == 0.0, lambda x: x >= 3.0):
            walked, drawn = function(chain[:, column]).astype(float), function(independent[:, column]).astype(float)
            batches = walked.reshape(40, -1).mean(axis=1)
            error = math.hypot(batches.std(ddof=1) / math.sqrt(40), drawn.std(ddof=1) / math.sqrt(len(drawn)))
            assert abs(walked.mean() - drawn.mean()) <= 4.0 * error


# ---- broken twins: each move with a fault that people make ----


class Twin(Move):
    """A move that does as another one but for its fault."""

    def __init__(self, original):
        self.original, self.name, self.even = original, original.name, original.even

    def draw(self, rng, words, graph):
        return self.original.draw(rng, words, graph)

    def log_choice(self, words, graph, choice):
        return self.original.log_choice(words, graph, choice)

    def apply(self, words, graph, choice):
        return self.original.apply(words, graph, choice)


class WithoutChoices(Twin):
    """Takes every choice for as likely forth as back."""

    def log_choice(self, words, graph, choice):
        return min(super().log_choice(words, graph, choice), 0.0) * 0.0


class WrongCount(Twin):
    """Counts all objects as if every one could die."""

    def log_choice(self, words, graph, choice):
        if not isinstance(choice, str):  # a birth
            return super().log_choice(words, graph, choice)
        return math.log(0.5 / len(words.grown(graph)))


class Growing(Twin):
    """Adds 4 % to a size on its way, which is no involution, with no word about it."""

    def apply(self, words, graph, choice):
        applied = super().apply(words, graph, choice)
        if applied is None or getattr(choice, "name", None) == "root":
            return applied
        name = choice.name
        vertex = applied.graph.vertex(name)
        if name in words.base:
            return applied
        grown = {key: 1.04 * x for key, x in vertex.parameters.items()}
        return Applied(applied.graph.replace(name, parameters=grown), applied.back)


TWINS = [("birth-death", WrongCount), ("birth-death", WithoutChoices), ("wiggle", Growing)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "twin"), TWINS)
def test_broken_twin_fails(name, twin):
    world, replicates = ROWS[name]
    worst, _, limit = verdict(Vocabulary(prior_of(world)), twin(moves[name]), replicates, until_caught=True)
    assert worst > limit
