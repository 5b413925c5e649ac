"""The densities of every jump, told from the jumps themselves, by what they draw.

A test of invariance needs thousands of steps to see a factor of 1.3 where few steps are accepted. Here the choices that
a move draws for one scene are held against what `log_choice` says of them, constants and all.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from jump_worlds import generator, prior_of
from test_jumps import Twin

from derender.scene.graph import ROOT, Vertex
from derender.scene.pose import random_rotation, rotation_angle, rotation_z, translation
from derender.scene.priors.objects import ROTATION
from derender.structures.jumps.base import PriorProposal, Vocabulary, moves
from derender.structures.jumps.proposal import Hypothesis, HypothesisProposal, rotation_density, rotation_near

LEAST = 30  # choices of one kind that are looked at
SEVERE = 4.5  # standard errors that pass
COARSE = 0.02  # relative error of the integrals below


def leaves_of(choice, path=()):
    """Yield (path, leaf) of all that nests in a choice."""
    if isinstance(choice, Mapping):
        nested = choice.items()
    elif isinstance(choice, tuple):
        nested = enumerate(choice)
    elif is_dataclass(choice):
        nested = ((field.name, getattr(choice, field.name)) for field in fields(choice))
    else:
        yield path, choice
        return
    for key, part in nested:
        yield from leaves_of(part, (*path, key))


def with_leaf(choice, path, value):
    """Return the choice with another leaf."""
    if not path:
        return value
    here, rest = path[0], path[1:]
    if isinstance(choice, Mapping):
        return {**choice, here: with_leaf(choice[here], rest, value)}
    if isinstance(choice, tuple):
        items = [with_leaf(part, rest, value) if number == here else part for number, part in enumerate(choice)]
        return type(choice)(*items) if hasattr(choice, "_fields") else tuple(items)
    return replace(choice, **{here: with_leaf(getattr(choice, here), rest, value)})


def profile(move, words, graph, choice, path, values):
    """Return (grid, density relative to the choice's own) of one number of a choice, the others as they are."""
    own, reach = move.log_choice(words, graph, choice), values[-1] - values[0]

    def density(x):
        try:
            return math.exp(move.log_choice(words, graph, with_leaf(choice, path, float(x))) - own)
        except ValueError:  # such as a size below zero
            return 0.0

    grid = np.concatenate([np.quantile(values, np.linspace(0, 1, 31)), np.linspace(values[0], values[-1], 31),
                           np.linspace(values[0] - 0.5 * reach, values[-1] + 0.5 * reach, 31)])  # fmt: skip
    if path[-1] in ("theta", "roll") and reach > 6.0:  # any angle is as likely, and the same a turn further
        low = 0.0 if values[0] >= 0.0 else -math.pi
        grid = np.clip(grid, low, low + math.tau)
    grid = np.unique(grid)
    found = [density(x) for x in grid]
    for k in range(len(grid) - 1):  # to either side of where it ends
        if (found[k] > 0.0) != (found[k + 1] > 0.0):
            ends = [grid[k], grid[k + 1]]
            for _ in range(25):
                middle = 0.5 * (ends[0] + ends[1])
                ends[(density(middle) > 0.0) != (found[k] > 0.0)] = middle
            grid, found = np.append(grid, ends), [*found, *map(density, ends)]
    order = np.argsort(grid)
    return grid[order], np.array(found)[order]


def verdict(move, words, graph, count, seed=1):
    """Return how many standard errors a move's commonest choices are off their density: in where their numbers lie, in
    how often such are drawn, and in that were the density 1.3 times as great.

    For choices alike in all but their numbers, these are taken to be independent: the density of one number follows
    from the others' being held, its integral from there, and what is left of the density is the rest's probability.
    """
    rng, found = generator(seed), defaultdict(list)
    for _ in range(count):
        choice = move.draw(rng, words, graph)
        if choice is None:
            continue
        leaves = list(leaves_of(choice))
        numbers = {path: leaf for path, leaf in leaves if isinstance(leaf, float)}
        if not any(path[-1] in ROTATION for path in numbers):
            found[tuple((path, leaf) for path, leaf in leaves if path not in numbers)].append((choice, numbers))
    shares, rates = defaultdict(list), []
    for drawn in found.values():
        if len(drawn) < LEAST:
            continue
        choice, numbers = drawn[0]
        left = move.log_choice(words, graph, choice)
        for path in numbers:
            values = np.sort([each[path] for _, each in drawn])
            if values[-1] - values[0] < 1e-12:
                continue
            grid, density = profile(move, words, graph, choice, path, values)
            masses = 0.5 * (density[1:] + density[:-1]) * np.diff(grid)
            left += math.log(masses.sum())
            shares[path].extend(np.interp(values, grid, np.concatenate([[0.0], np.cumsum(masses)]) / masses.sum()))
        rates.append((len(drawn) / count, math.exp(left)))
    seen, said = np.array(rates).T
    assert seen.sum() > 0.1
    off, wrong = (
        max(np.abs(errors_off(seen, each, count)).max(), abs(errors_off(seen.sum(), each.sum(), count)))
        for each in (said, 1.3 * said)
    )
    return max(map(unevenness, shares.values()), default=0.0), off, wrong


def errors_off(seen, said, count):
    """Return by how many standard errors shares of `count` draws are off their probability, as that is integrated."""
    return (seen - said) / np.hypot(np.sqrt(seen * (1.0 - 0.9 * seen) / count), COARSE * seen)


def unevenness(shares):
    """Return how many standard errors the mean and the variance of shares are off those of the uniform distribution."""
    offset, root = np.array(shares) - 0.5, math.sqrt(len(shares))
    return root * max(abs(np.mean(offset)) * math.sqrt(12.0), abs(np.mean(offset**2) - 1.0 / 12.0) * math.sqrt(180.0))


def scene(words, seed, solids=2):
    """Return a draw from the prior with some solids, three as a pile; none floats or is a ball: their angles hang
    together."""
    rng = generator(seed)
    while True:
        graph = words.prior.sample(rng)
        grown = [graph.vertex(name) for name in words.grown(graph)]
        piled = solids < 3 or len({v.parent for v in grown}) == solids
        if len(grown) == solids and piled and all(v.shape != "sphere" and v.parent != ROOT for v in grown):
            return graph


# where, of how many solids, how many choices
CHOICES = {"birth-death": [("blocks", 2, 800)]}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "row"), [(name, row) for name, rows in CHOICES.items() for row in rows])
def test_choices_are_drawn_as_their_density_says(name, row):
    """And a constant factor would be seen."""
    world, solids, count = row
    words = Vocabulary(prior_of(world))
    uneven, apart, wrong = verdict(moves[name], words, scene(words, 3, solids), count)
    assert uneven < SEVERE
    assert apart < SEVERE < wrong


def test_every_move_whose_choices_have_a_density_has_its_row():
    assert set(CHOICES) == {name for name in moves if not moves[name].even}


class Evenly(Twin):
    """Takes the place of a birth on another block, whose prior is beta(20, 20), for uniform."""

    def log_choice(self, words, graph, choice):
        u = choice.contact.values.get("u") if isinstance(choice, Vertex) else None
        return super().log_choice(words, graph, choice) - (19.0 * math.log(4.0 * u * (1.0 - u)) if u else 0.0)


def test_a_density_of_wrong_shape_is_seen():
    words = Vocabulary(prior_of("blocks"))
    assert verdict(Evenly(moves["birth-death"]), words, scene(words, 3, 2), 800)[0] > 1.2 * SEVERE


# ---- moves whose choices are as likely back as forth ----


def evenness(move, count=3000):
    """Return the standard errors of the mean step from zero."""
    words, steps, rng = Vocabulary(prior_of("rims")), [], generator(9)
    graphs = [scene(words, seed) for seed in range(20)]
    for number in range(count):
        graph = graphs[number % len(graphs)]
        choice = move.draw(rng, words, graph)
        steps += [] if choice is None else list(choice.tangent)
    signs = np.sign(steps)
    return abs(signs.mean()) * math.sqrt(len(signs))


class Drifting(Twin):
    """Steps up a little more often than down."""

    def draw(self, rng, words, graph):
        choice = super().draw(rng, words, graph)
        if choice is None or rng.random() < 0.8:
            return choice
        return choice._replace(tangent=np.abs(choice.tangent))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in moves if moves[name].even])
def test_even_moves_step_either_way_alike(name):
    assert evenness(moves[name]) < SEVERE
    assert evenness(Drifting(moves[name])) > SEVERE


def test_a_death_has_half_the_probability_whichever_leaf_it_takes():
    words, move, leaves = Vocabulary(prior_of("blocks")), moves["birth-death"], set()
    for seed in range(12):
        graph = scene(words, seed)
        deaths = [math.exp(move.log_choice(words, graph, name)) for name in words.leaves(graph)]
        assert math.fsum(deaths) == pytest.approx(0.5)
        leaves.add(len(deaths))
    assert len(leaves) > 1


# ---- births about hypotheses ----


def birthplace(on_prior):
    """Return (words, graph) of births about two hypotheses: a box, its angle near the end of its range, and a cube."""
    words = Vocabulary(prior_of("grammar"))
    graph = words.prior.sample(generator(4))
    while words.grown(graph):
        graph = graph.remove(words.leaves(graph)[0])
    poses = [graph.poses()["floor"] @ translation(x, 0.02, 0.03) @ rotation_z(theta)
             for x, theta in ((0.05, 3.12), (-0.05, 0.4))]  # fmt: skip
    guesses = [Hypothesis("box", {"length": 0.09, "width": 0.05, "height": 0.06}, poses[0], 1.0, 0.02, 0.3),
               Hypothesis("cube", {"side": 0.06}, poses[1], 0.3, 0.01, 0.1)]  # fmt: skip
    return Vocabulary(words.prior, HypothesisProposal(guesses, on_prior)), graph


def test_births_about_hypotheses_are_drawn_as_their_density_says():
    words, graph = birthplace(0.0)
    uneven, apart, _ = verdict(moves["birth-death"], words, graph, 1500)
    assert uneven < SEVERE
    assert apart < SEVERE


def test_without_hypotheses_births_are_those_of_the_prior():
    words, graph = birthplace(0.5)
    vertex = PriorProposal().sample(generator(8), words, graph)
    density = HypothesisProposal([], 0.5).log_density(words, graph, vertex)
    assert density == PriorProposal().log_density(words, graph, vertex)


def mass_of(part, words, graph, factor=1.0, count=2500):
    """Return (mean, standard error) of the density of a part of the mixture over its own, times a factor, of births:
    one."""
    rng, ratios = generator(6), []
    for _ in range(count):
        vertex = words.proposal.sample(rng, words, graph)
        ratio = part.log_density(words, graph, vertex) - words.proposal.log_density(words, graph, vertex)
        ratios.append(factor * math.exp(ratio))
    return np.mean(ratios), np.std(ratios) / math.sqrt(count)


@pytest.mark.parametrize("part", [PriorProposal(), birthplace(0.0)[0].proposal], ids=["prior", "hypotheses"])
def test_each_part_of_the_mixture_of_births_has_its_share(part):
    mean, error = mass_of(part, *birthplace(0.5))
    assert abs(mean - 1.0) < SEVERE * error
    mean, error = mass_of(part, *birthplace(0.5), factor=1.0 / 1.3)
    assert abs(mean - 1.0) > SEVERE * error


@pytest.mark.parametrize("angle", [0.2, 1.2])
def test_rotations_near_another_have_their_density(angle):
    """The mean of 1 / density over draws that turn by less than a is Haar's mass of those, (a - sin a) / pi."""
    rng, within = generator(7), 2.0 * min(angle, 1.0)
    centre, found = random_rotation(rng), []
    for _ in range(4000):
        turned = rotation_near(rng, centre, angle)
        near = rotation_angle(centre, turned) < within
        found.append(math.exp(-rotation_density(turned, centre, angle)) if near else 0.0)
    mass = (within - math.sin(within)) / math.pi
    assert abs(np.mean(found) - mass) < SEVERE * np.std(found) / math.sqrt(len(found))
