"""Every kernel leaves the posterior where it is, and a broken twin of each does not."""

import functools
import math
import sys

import numpy as np
import pytest
from invariance import bound, evaluate, steps_of, verdict
from toy_worlds import WORLDS

from derender.errors import DerenderError
from derender.posterior.compiled.backend import InterpretedBackend
from derender.posterior.compiled.prior import NEXT, NOW, OFFSET, PERIOD
from derender.posterior.kernels.base import Tuning, kernels, mixture
from derender.posterior.space import turn as turned
from derender.posterior.space import turn_between, wrap

REPLICATES = 1000


@functools.cache
def tuning(space, temperature=1.0):
    """Deliberately rough: invariance must not depend on a good tuning."""
    rng = np.random.default_rng(5)
    size = int(space.directions[-1])
    scales = 0.7 * space.scales
    mixing = np.eye(size) + 0.3 * rng.standard_normal((size, size))
    covariance = (mixing @ mixing.T) * np.outer(scales, scales)
    centre = np.median([space.sample(rng) for _ in range(25)], axis=0)
    for i, unknown in enumerate(space.unknowns):
        if unknown.distribution.size == 4:
            centre[space.offsets[i] : space.offsets[i] + 4] = (1.0, 0.0, 0.0, 0.0)
    archive = np.array([space.sample(rng) for _ in range(30)])
    return Tuning(centre, covariance, None, temperature, archive)


def maker(type_name, twin=None, temperature=1.0):
    """Return target -> kernel, the first of the type's kernels that the space gives; or its broken twin.

    twin : what it has in place of functions, by name.
    """
    made = []

    def make(target):
        if not made:
            every = mixture(target.space, [{type_name: {}}, {"resimulate": {}}])
            parts = [part for part in every if part.type == type_name][:1]
            made.append(InterpretedBackend(target, parts, **(twin or {})))
        made[0].target = target
        return steps_of(made[0], tuning(target.space, temperature))

    return make


# ---- broken twins: each is the kernel with the one fault that people make ----


def one_way(rng, factor, size, normal, tangent):
    """Steps with a bias: the proposal is not symmetric."""
    normal = np.abs(rng.standard_normal(size))
    tangent[:size] = np.reshape(factor, (size, size)) @ normal


def third_of_a_turn(unknowns, laws, values, i):
    """A third of a period forward is not a third forward back."""
    start, period = unknowns[OFFSET, i], laws[i, PERIOD]
    values[NEXT, start] = wrap(values[NOW, start] + period / 3, period)


CASES = {
    "resimulate": ("angle", {"log_prior": lambda *_: 0.0}),  # forgets that the proposal was the prior
    "drift": ("angle", {"shaped": one_way}),
    "drift-all": ("angle", {"shaped": one_way}),
    "flip": ("angle", {"half_turn": third_of_a_turn}),
}


def test_every_kernel_is_here():
    """Of those that know where objects are in the world `structures/test_contacts_anew.py` is."""
    assert set(CASES) == {name for name in kernels if not kernels[name].keeps_children}


@pytest.mark.parametrize("name", CASES)
def test_kernel_is_invariant(name):
    result = verdict(WORLDS[CASES[name][0]](), maker(name), REPLICATES, steps=4)
    assert result.moved > 0.02, "a kernel that never moves is invariant for nothing"
    assert result.worst < bound(len(result.z)), result


def test_a_flip_exchanges_the_sides_of_a_box():
    world = WORLDS["box"]()
    result = verdict(world, maker("flip"), REPLICATES, steps=4)
    assert result.moved > 0.02
    assert result.worst < bound(len(result.z)), result
    rng, values = np.random.default_rng(1), world.space.sample(np.random.default_rng(2))
    target = world.target(rng, values)
    state, length = evaluate(target, values), target.space.addresses.index("a.length")
    step = maker("flip", temperature=0.0)(target)
    assert {step(rng, state)[0].values[length] for _ in range(50)} == {values[length], values[length + 1]}


@pytest.mark.parametrize("name", CASES)
def test_broken_twin_is_caught(name):
    world, twin = CASES[name]
    result = verdict(WORLDS[world](), maker(name, twin), REPLICATES, steps=4, until_caught=True)
    assert result.worst > bound(len(result.z)), f"passed with {result.worst:.1f}"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["resimulate", "drift"])
def test_kernel_is_invariant_on_rotations(name):
    result = verdict(WORLDS["floating"](), maker(name), REPLICATES, steps=4)
    assert result.moved > 0.02
    assert result.worst < bound(len(result.z)), result


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_mixture_of_all_is_invariant(world):
    made = []

    def make(target):
        if not made:
            made.append(InterpretedBackend(target, mixture(target.space, [{name: {}} for name in CASES])))
        made[0].target = target
        return steps_of(made[0], tuning(target.space))

    result = verdict(WORLDS[world](), make, REPLICATES, steps=6)
    assert result.worst < bound(len(result.z)), result


@pytest.mark.parametrize("name", CASES)
def test_temperature_tempers(name):
    """At temperature 0 the prior is what a kernel keeps: started from the prior, moments stay the prior's, and what the
    image says holds nothing up."""
    world = WORLDS[CASES[name][0]]()
    rng = np.random.default_rng(4)
    target = world.target(rng, world.space.sample(rng))
    kernel = maker(name, temperature=0.0)(target)
    differences, moved = [], 0
    for _ in range(800):
        values = world.space.sample(rng)
        state = evaluate(target, values)
        for _ in range(3):
            state, accepted = kernel(rng, state)
            moved += accepted
        differences.append(np.concatenate([state.values - values, state.values**2 - values**2]))
    differences = np.array(differences)
    spread = np.std(differences, axis=0)
    z = np.mean(differences, axis=0)[spread > 0] / spread[spread > 0] * math.sqrt(len(differences))
    assert np.max(np.abs(z)) < bound(len(z))
    assert moved / 2400 > 0.1


@pytest.mark.parametrize("name", CASES)
def test_densities_carried_along_are_those_of_the_values(name):
    world = WORLDS[CASES[name][0]]()
    rng = np.random.default_rng(8)
    target = world.target(rng, world.space.sample(rng))
    kernel = maker(name)(target)
    state = evaluate(target, world.space.sample(rng))
    for _ in range(50):
        former = state
        state, accepted = kernel(rng, state)
        assert state.log_prior == world.space.log_prior(state.values)
        assert state.log_likelihood == target.log_likelihood(state.values)
        assert accepted or np.array_equal(state.values, former.values)


def test_every_kernel_says_why_it_is_right():
    for name in kernels:
        kind = kernels[name]
        said = "".join(one.__doc__ or "" for one in (type(kind), kind.proposal, sys.modules[type(kind).__module__]))
        assert type(kind).__doc__ and "log ratio" in said, name


@pytest.mark.parametrize(
    "entries, what",
    [
        ([{"drfit": {}}], "did you mean 'drift'"),
        ([{"drift": {"stride": 1}}], "no option 'stride'"),
        ([{"drift": {"weight": "much"}}], "drift.weight is 'much'"),
        ([{"drift": {"weight": -1}}], "drift.weight is -1"),
        ([{"drift": {"weight": True}}], "drift.weight is True"),
        ([{"flip": {}}], "no kernel moves a.contact.theta"),
    ],
)
def test_faults_in_a_mixture_are_told(entries, what):
    with pytest.raises(DerenderError, match=what):
        mixture(WORLDS["angle"]().space, entries)


def test_weights_are_shared_by_size():
    parts = mixture(WORLDS["angle"]().space, [{"resimulate": {"weight": 1}}, {"drift-all": {"weight": 3}}])
    shares = [(p.name, p.weight) for p in parts]
    assert [name for name, _ in shares] == ["resimulate a.contact", "resimulate b.contact", "drift-all all"]
    np.testing.assert_allclose([weight for _, weight in shares], [1 / 6, 1 / 12, 3 / 4])


def test_turning_there_and_back():
    rng = np.random.default_rng(6)
    for _ in range(200):
        origin = turned((1.0, 0.0, 0.0, 0.0), rng.standard_normal(3))
        vector = rng.standard_normal(3)
        vector *= rng.uniform(0, math.pi * 0.999) / np.linalg.norm(vector)
        np.testing.assert_allclose(turn_between(origin, turned(origin, vector)), vector, atol=1e-9)


def test_wrap_stays_below_its_period():
    assert wrap(-1e-20, math.pi) == 0.0
    assert wrap(3 * math.pi, math.pi) == pytest.approx(0, abs=1e-15)
