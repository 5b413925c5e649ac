"""Every kernel leaves the posterior where it is, and a broken twin of each does not."""

import functools
import math

import numpy as np
import pytest
from invariance import bound, verdict
from scipy.stats import multivariate_normal
from toy_worlds import WORLDS

from derender.errors import DerenderError
from derender.posterior import kernels as kernels_package
from derender.posterior.kernels import (
    base,
    choose,
    drift,
    flip,
    independence,
    jump,
    langevin,
    newton,
    relocate,
    resimulate,
    slide,
    slide_window,
    turn,
    window,
)
from derender.posterior.kernels.base import Info, State, Tuning, decide, evaluate, kernels, mixture
from derender.posterior.space import Block, turn_between, wrap
from derender.posterior.space import turn as turned

REPLICATES = 1500


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
    archive = np.array([space.sample(rng) for _ in range(40)])
    return Tuning(centre, covariance, {}, temperature, archive)


def maker(type_name, twin=None, **options):
    """Return target -> kernel, the first of the type's kernels that the space gives; or its broken twin."""

    def make(target):
        parts = [p for p in mixture(target.space, [{type_name: options}, {"resimulate": {}}]) if p.type == type_name]
        kind = kernels[type_name]
        kernel = kind.build(target, parts[0].block, tuning(target.space), parts[0].options)
        if twin:
            kernel.__class__ = twin
        return kernel

    return make


# ---- broken twins: each is the kernel with the one fault that people make ----


class ResimulatePriorTwice(resimulate.Resimulate):
    """Forgets that the proposal was the prior."""

    def __call__(self, rng, state):
        values = state.values.copy()
        for unknown in self.block.unknowns:
            self.target.space.resample(rng, values, unknown)
        return decide(rng, state, evaluate(self.target, values), 0.0, 1.0, self.name)


class DriftOneWay(drift.Drift):
    """Steps with a bias: the proposal is not symmetric."""

    def __call__(self, rng, state):
        normal = np.abs(rng.standard_normal(len(self.factor)))
        values = self.target.space.move(state.values, self.block, self.scale * (self.factor @ normal))
        return decide(rng, state, evaluate(self.target, values), 0.0, 1.0, self.name)


class IndependenceWithoutRatio(independence.Independence):
    """Takes the proposal for symmetric."""

    def log_proposal(self, tangent):
        return 0.0 if super().log_proposal(tangent) > -math.inf else -math.inf


class WindowFromItsEnd(window.Window):
    """The row always starts at the present state: from the chosen place another row would arise."""

    def __call__(self, rng, state):
        return super().__call__(Replayed(rng, 1 + len(self.directions), 0.0), state)


class Replayed:
    """A generator whose `number`-th uniform is `value`."""

    def __init__(self, rng, number, value):
        self.rng, self.left, self.value = rng, number, value

    def standard_normal(self, *size):
        return self.rng.standard_normal(*size)

    def random(self):
        drawn = self.rng.random()
        self.left -= 1
        return self.value if self.left == -1 else drawn


class JumpByAThird(jump.Jump):
    """A third of a period forward is not a third forward back."""

    def __call__(self, rng, state):
        angle = self.angles[0]
        period = self.target.space.unknowns[angle].period
        values = self.target.space.move(state.values, Block("", (angle,)), (period / 3,))
        return decide(rng, state, evaluate(self.target, values), 0.0, 1.0, self.name)


class FlipThatStretches(flip.Flip):
    """Exchanges and stretches by 1.1 and 1 / 1.2, without the Jacobian (and it is no involution)."""

    def __call__(self, rng, state):
        new, info = super().__call__(rng, state)
        if not info.accepted:
            return new, info
        _, length, width = self.flips[0]
        values = new.values.copy()
        values[length] *= 1.1
        values[width] /= 1.2
        stretched = evaluate(self.target, values)
        return (stretched if stretched.log_prior > -math.inf else new), info


class ChooseUnbalanced(choose.Choose):
    """Prefers the next value, and does not correct for it."""

    def __call__(self, rng, state):
        at = self.target.space.offsets[self.discrete[0]]
        values = state.values.copy()
        values[at] = (values[at] + (1 if rng.random() < 0.8 else 2)) % 3
        return decide(rng, state, evaluate(self.target, values), 0.0, 1.0, self.name)


class SlideWithoutJacobian(slide.Slide):
    """Drops the Jacobian of the children's contacts."""

    def __init__(self, *arguments):
        super().__init__(*arguments)

    def __call__(self, rng, state):
        genuine = self.target
        self.target = _WithoutJacobian(genuine)
        try:
            return super().__call__(rng, state)
        finally:
            self.target = genuine


class SlideWindowWithoutJacobian(slide_window.SlideWindow):
    """Drops the Jacobian of the children's contacts."""

    def place(self, state, tangent):
        new, _ = super().place(state, tangent)
        return new, 0.0


class PutWithoutArea:
    """Takes the density of a place for that of the contact's numbers."""

    def __call__(self, rng, state):
        genuine = self.target
        self.target = _WithoutArea(genuine)
        try:
            return super().__call__(rng, state)
        finally:
            self.target = genuine


class _WithoutArea:
    def __init__(self, target):
        self.target = target

    def __getattr__(self, name):
        return getattr(self.target, name)

    def put(self, *arguments):
        values, _ = self.target.put(*arguments)
        return values, 0.0


class RelocateWithoutArea(PutWithoutArea, relocate.Relocate):
    """Takes the density of a place for that of the contact's numbers."""


class TurnWithoutArea(PutWithoutArea, turn.Turn):
    """Takes the density of a place for that of the contact's numbers."""


class RelocateWithoutRatio(relocate.Relocate):
    """Takes the proposal for symmetric."""

    def log_proposal(self, place):
        return 0.0


class _WithoutJacobian:
    def __init__(self, target):
        self.target = target

    def __getattr__(self, name):
        return getattr(self.target, name)

    def keep_children(self, *arguments):
        values, _ = self.target.keep_children(*arguments)
        return values, 0.0


class LangevinUncorrected(langevin.Langevin):
    """Takes the step along the gradient for symmetric."""

    def log_proposal(self, tangent, known):
        return 0.0


class NewtonWithoutDeterminant(newton.Newton):
    """Forgets that a normal density is the lower the wider it is: its width differs from place to place."""

    def log_proposal(self, tangent, known):
        return super().log_proposal(tangent, known) - float(np.sum(np.log(np.diag(known[1]))))


CASES = {
    "resimulate": ("angle", ResimulatePriorTwice),
    "drift": ("angle", DriftOneWay),
    "drift-all": ("angle", DriftOneWay),
    "independence": ("angle", IndependenceWithoutRatio),
    "window": ("angle", WindowFromItsEnd),
    "jump": ("angle", JumpByAThird),
    "flip": ("box", FlipThatStretches),
    "choose": ("box", ChooseUnbalanced),
    "slide": ("angle", SlideWithoutJacobian),
    "slide-window": ("angle", SlideWindowWithoutJacobian),
    "langevin": ("angle", LangevinUncorrected),
    "newton": ("angle", NewtonWithoutDeterminant),
    "relocate": ("angle", RelocateWithoutArea),
    "relocate-stack": ("angle", RelocateWithoutArea),
    "turn": ("angle", TurnWithoutArea),
}
OPTIONS = {"newton": {"scale": 1.4}, "langevin": {"scale": 0.6}, "slide": {"scale": 2.0}}
# More replicates where the fault is small: as many for the kernel itself, which could have that fault.
MORE = {"relocate": 3, "choose": 3, "langevin": 6, "newton": 4, "independence": 4, "slide": 2, "slide-window": 2}


def test_every_kernel_is_here():
    assert set(CASES) == set(kernels.names())


@pytest.mark.parametrize("name", CASES)
def test_kernel_is_invariant(name):
    make = maker(name, **OPTIONS.get(name, {}))
    result = verdict(WORLDS[CASES[name][0]](), make, MORE.get(name, 1) * REPLICATES, steps=4)
    assert result.moved > 0.02, "a kernel that never moves is invariant for nothing"
    assert result.worst < bound(len(result.z)), result


@pytest.mark.parametrize("name", CASES)
def test_broken_twin_is_caught(name):
    world, twin = CASES[name]
    make = maker(name, twin, **OPTIONS.get(name, {}))
    result = verdict(WORLDS[world](), make, MORE.get(name, 1) * REPLICATES, steps=4, until_caught=True)
    assert result.worst > bound(len(result.z)), f"{twin.__doc__} passed with {result.worst:.1f}"


class Accepting:
    """A generator whose uniforms accept every step that is possible."""

    def __init__(self, rng):
        self.standard_normal = rng.standard_normal

    def random(self):
        return math.nextafter(1.0, 0.0)


@pytest.mark.parametrize("name", ["langevin", "newton"])
def test_ratio_of_a_step_along_the_gradient(name):
    """The log ratio is that of the normal densities of both ways, written out anew. A tenth off hardly shows above."""
    world, checked = WORLDS["angle"](), 0
    rng = np.random.default_rng(12)
    for _ in range(200):
        values = world.space.sample(rng)
        target = world.target(rng, values)
        kernel, slope = maker(name, **OPTIONS[name])(target), target.derivative()

        def log_proposal(start, end, kernel=kernel, slope=slope):
            gradient, precision = slope.at(start, 1.0)
            spread = np.linalg.inv(precision) if name == "newton" else tuning(world.space).covariance
            tangent = world.space.difference(end, start, world.space.everything)
            mean = 0.5 * kernel.scale**2 * spread @ gradient
            return multivariate_normal.logpdf(tangent, mean, kernel.scale**2 * spread)

        old = evaluate(target, values)
        new, info = kernel(Accepting(rng), old)
        if info.accepted:
            expected = new.log_prior + new.log_likelihood - old.log_prior - old.log_likelihood
            expected += log_proposal(new.values, values) - log_proposal(values, new.values)
            assert info.log_ratio == pytest.approx(expected, rel=1e-9, abs=1e-9)
            checked += 1
    assert checked > 50


@pytest.mark.parametrize("name", ["resimulate", "drift", "window"])
def test_kernel_is_invariant_on_rotations(name):
    result = verdict(WORLDS["floating"](), maker(name), REPLICATES, steps=4)
    assert result.moved > 0.02
    assert result.worst < bound(len(result.z)), result


@pytest.mark.parametrize("name", ["relocate", "relocate-stack"])
def test_relocation_without_proposal_ratio_is_caught(name):
    result = verdict(WORLDS["angle"](), maker(name, RelocateWithoutRatio), REPLICATES, steps=4, until_caught=True)
    assert result.worst > bound(len(result.z)), result.worst


class WithoutHaar(independence.Independence):
    """Takes the density per volume of the rotation vector for the density per Haar measure."""

    def log_proposal(self, tangent):
        log_density = super().log_proposal(tangent)
        angle = float(np.linalg.norm(tangent[:3]))
        if log_density == -math.inf or angle < 1e-9:
            return log_density
        return log_density + 2 * math.log(math.sin(angle / 2) / (angle / 2))


@pytest.mark.parametrize("twin", [None, WithoutHaar])
def test_independence_knows_the_measure_of_rotations(twin):
    make = maker("independence", twin, inflation=2.0)
    result = verdict(WORLDS["floating"](), make, 4 * REPLICATES, steps=6, until_caught=bool(twin))
    assert result.moved > 0.02
    assert (result.worst > bound(len(result.z))) == bool(twin), result


@pytest.mark.parametrize("world", WORLDS)
def test_mixture_of_all_is_invariant(world):
    def make(target):
        parts = mixture(target.space, [{name: {}} for name in kernels.names() if name not in ("langevin", "newton")])
        built = [kernels[p.type].build(target, p.block, tuning(target.space), p.options) for p in parts]
        shares = np.cumsum([p.weight for p in parts])

        def kernel(rng, state):
            return built[int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))](rng, state)

        return kernel

    result = verdict(WORLDS[world](), make, REPLICATES, steps=6)
    assert result.worst < bound(len(result.z)), result


@pytest.mark.parametrize("name", sorted(set(CASES) - {"langevin", "newton"}))
def test_temperature_tempers(name):
    """At temperature 0 the prior is what a kernel keeps: started from the prior, moments stay the prior's."""
    world = WORLDS[CASES[name][0]]()
    rng = np.random.default_rng(4)
    target = world.target(rng, world.space.sample(rng))
    kind = kernels[name]
    block = next(b for b in (*world.space.blocks, world.space.everything) if kind.applies(world.space, b))
    if not kind.per_block:
        block = world.space.everything
    options = dict(kind.options)
    kernel = kind.build(target, block, tuning(world.space, 0.0), options)
    differences = []
    for _ in range(1200):
        values = world.space.sample(rng)
        state = evaluate(target, values)
        for _ in range(3):
            state, _ = kernel(rng, state)
        differences.append(np.concatenate([state.values - values, state.values**2 - values**2]))
    differences = np.array(differences)
    spread = np.std(differences, axis=0)
    z = np.mean(differences, axis=0)[spread > 0] / spread[spread > 0] * math.sqrt(len(differences))
    assert np.max(np.abs(z)) < bound(len(z))


@pytest.mark.parametrize("name", CASES)
def test_signature_and_honest_state(name):
    """kernel(rng, state) -> (State, Info), and the densities carried along are those of the values."""
    world = WORLDS[CASES[name][0]]()
    rng = np.random.default_rng(8)
    target = world.target(rng, world.space.sample(rng))
    kernel = maker(name)(target)
    state = evaluate(target, world.space.sample(rng))
    for _ in range(50):
        before = state.values.copy()
        former = state
        state, info = kernel(rng, state)
        assert isinstance(state, State) and isinstance(info, Info) and info.name.startswith(name)
        np.testing.assert_array_equal(former.values, before)  # a kernel never writes into the state that it got
        assert state.log_prior == world.space.log_prior(state.values)
        assert state.log_likelihood == target.log_likelihood(state.values)
        assert info.accepted or state is former or "window" in name


def test_every_kernel_says_why_it_is_right():
    for name in kernels.names():
        assert kernels[name].__doc__
    for module in (choose, drift, flip, independence, jump, langevin, newton, relocate, resimulate, slide,
                   slide_window, turn, window):  # fmt: skip
        body = next(c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__)
        assert "log ratio" in body.__doc__, module.__name__
    assert kernels_package.kernels is base.kernels


@pytest.mark.parametrize(
    "entries, what",
    [
        ([{"drfit": {}}], "did you mean 'drift'"),
        ([{"drift": {"stride": 1}}], "no option 'stride'"),
        ([{"drift": {"weight": "much"}}], "drift.weight is 'much'"),
        ([{"drift": {"weight": -1}}], "drift.weight is -1"),
        ([{"drift": {"weight": True}}], "drift.weight is True"),
        ([{"jump": {}}, {"slide": {}}], "no kernel moves b.contact.u"),
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
