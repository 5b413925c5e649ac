"""Explain the image by a set of solids: greedy addition of polished hypotheses, then sweeps of local moves."""

from typing import NamedTuple

import numpy as np

from derender.inference.structure.image import added_misfit
from derender.inference.structure.polish import FREE, SLACK, UPRIGHT, polish, size_energy
from derender.inference.structure.state import State, energy, held_out
from derender.inference.structure.support import assign_supports
from derender.model.solids import BOX, SPHERE


class Settings(NamedTuple):
    """What the search is allowed.

    Attributes
    ----------
    shapes : names of the shapes that may occur.
    max_objects : how many solids there may be.
    price : nats that a solid must gain to be believed.
    slack : metres within which contacts hold.
    cube_bonus : log prior odds of a cube against the box that nearly is one: P(cube) over P(box) times the prior
        density of two sizes within the accuracy of the image.
    free_price : nats that a tilted pose costs more than an upright one.
    repairs : rounds of taking out and explaining anew; clean : number of badly explained pixels that may stay.
    """

    shapes: tuple[str, ...] = ("box", "cube", "cylinder", "sphere")
    max_objects: int = 30
    price: float = 40.0
    slack: float = SLACK
    cube_bonus: float = 7.0
    free_price: float = 8.0
    repairs: int = 12
    clean: float = 4.0


def run_polish(rng, image, state, index, row, form, cube, view, bottom, settings, rounds, step=0.003, heat=2.0):
    """Polish one solid against the rest of the scene; return (row, energy, misfit change)."""
    depth, _, misfit, _ = view
    return polish(image, row, form, cube, state.rows, index, depth, misfit, bottom, settings.slack, rounds, step, heat,
                  int(rng.integers(2**31)))  # fmt: skip


def greedy(rng, image, hypotheses, settings, state=None, tried=5, shake=0.0):
    """Add the best polished hypothesis again and again while it gains more than its price.

    tried : how many of the most promising hypotheses are polished at each step.
    shake : each gain is multiplied by a uniform number in [1 - shake, 1] before the most promising are taken.
    """
    state = State() if state is None else state
    alive = list(hypotheses)
    while alive and len(state) < settings.max_objects:
        view = held_out(image, state, -1)
        gains = np.array([-added_misfit(image, h.row, view[0], view[2]) for h in alive])
        order = np.argsort(-gains * rng.uniform(1 - shake, 1, len(gains)))[:tried]
        best = None
        for k in order:
            h = alive[k]
            row, energy, change = run_polish(rng, image, state, -1, h.row, h.form, h.cube, view, np.nan, settings, 150)
            energy += complexity(int(row[0]), h.form, h.cube, settings)
            if best is None or energy < best[1]:
                best = (row, energy, h)
        row, energy, h = best
        if energy > 0:
            break
        row, _, _ = run_polish(rng, image, state, -1, row, h.form, h.cube, view, np.nan, settings, 300, 0.002)
        state = state.add(row, h.form, h.cube)
        alive = [a for a, gain in zip(alive, gains, strict=True) if gain > -200]
    return state


def sweep(rng, image, state, settings, rounds, step=0.002, heat=1.0):
    """Polish each solid in turn, what it stands on held to it; in place."""
    for i in rng.permutation(len(state)):
        view = held_out(image, state, i)
        state.rows[i], _, _ = run_polish(rng, image, state, i, state.rows[i], state.forms[i], state.cubes[i], view,
                                         state.bottoms[i], settings, rounds, step, heat)  # fmt: skip
    return state


def try_cubes(rng, image, state, settings, rounds=200):
    """Make a cube of each box where the image allows it; return a new state."""
    state = state.copy()
    for i in range(len(state)):
        row = state.rows[i]
        if int(row[0]) != BOX or state.cubes[i]:
            continue
        view = held_out(image, state, i)
        _, box_energy, _ = run_polish(rng, image, state, i, row, state.forms[i], False, view, state.bottoms[i], settings, 1)
        sides = row[13:16]
        best = None
        for side in {float(np.median(sides)), float(sides.mean()), float(sides[2])}:
            trial = cube_of(row, side, image.origin, state.forms[i])
            result = run_polish(rng, image, state, i, trial, state.forms[i], True, view, state.bottoms[i], settings, rounds)
            if best is None or result[1] < best[1]:
                best = result
        if best[1] < box_energy + settings.cube_bonus:
            state.rows[i], state.cubes[i] = best[0], True
    return state


def cube_of(row, side, origin, form):
    """Return the cube of this side with the corner nearest the camera (for an upright one, on its bottom) held."""
    new = row.copy()
    rotation = row[1:10].reshape(3, 3)
    towards = np.sign((origin - row[10:13]) @ rotation)
    if form == UPRIGHT:
        towards[2] = -1.0
    new[10:13] = row[10:13] + rotation @ (towards * (row[13:16] - side) / 2)
    new[13:16] = side
    return new


def prune(image, state, settings):
    """Remove solids whose removal costs less than their price; return a new state."""
    i = 0
    while i < len(state):
        depth, _, misfit, _ = held_out(image, state, i)
        kept = added_misfit(image, state.rows[i], depth, misfit) + size_energy(state.rows[i], state.cubes[i])
        if kept + complexity(int(state.rows[i][0]), state.forms[i], state.cubes[i], settings) > 0:
            state = state.without(i)
            i = 0
        else:
            i += 1
    return state


def settle(rng, image, state, settings, rounds=200):
    """Put every solid on its support, polish, make cubes, and prune; return a new state."""
    state = assign_supports(image, state, settings.slack)
    sweep(rng, image, state, settings, rounds)
    state = prune(image, state, settings)
    state = try_cubes(rng, image, state, settings)
    return assign_supports(image, state, settings.slack)


def search(rng, image, hypotheses, settings):
    """Return the best State found."""
    state = settle(rng, image, greedy(rng, image, hypotheses, settings), settings)
    state = repair(rng, image, state, hypotheses, settings)
    sweep(rng, image, state, settings, 300, 0.001, 0.0)
    return prune(image, state, settings)


def repair(rng, image, state, hypotheses, settings):
    """Take out solids about which the image is badly explained and explain their place anew; keep what is better.

    Ends after settings.repairs rounds, or when no misfit is left that noise would not leave.
    """
    best = total_energy(image, state, settings)
    for _ in range(settings.repairs):
        blame, pairs = badness(image, state)
        if blame.sum() < settings.clean:
            break
        weight = blame + 1e-3
        if len(state) == 0:
            new = state
        else:
            seed = int(rng.choice(len(state) + 1, p=np.append(weight[:-1], weight[-1] + 1e-3) / (weight.sum() + 1e-3)))
            out = {seed} if seed < len(state) else set()
            out |= {j for j in range(len(state)) if pairs[seed, j] > 0 and rng.random() < 0.5}
            new = state.copy()
            for k in sorted(out, reverse=True):
                new = new.without(k)
        new = greedy(rng, image, hypotheses, settings, new, tried=3, shake=0.7)
        new = settle(rng, image, new, settings, 120)
        value = total_energy(image, new, settings)
        if value < best:
            state, best = new, value
    return state


def badness(image, state, limit=4.5):
    """Return the number of badly explained pixels about each solid (last: about none), and how many each pair shares."""
    depth, label, misfit, _ = held_out(image, state, -1)
    bad = misfit > limit
    # lone pixels are noise or the rounding of a silhouette
    crowd = np.zeros(bad.shape, int)
    crowd[1:] += bad[:-1]
    crowd[:-1] += bad[1:]
    crowd[:, 1:] += bad[:, :-1]
    crowd[:, :-1] += bad[:, 1:]
    rows, columns = np.nonzero(bad & (crowd > 0))
    count = len(state)
    blame, pairs = np.zeros(count + 1), np.zeros((count + 1, count + 1))
    for j, i in zip(rows, columns, strict=True):
        near = np.unique(label[max(j - 2, 0) : j + 3, max(i - 2, 0) : i + 3])
        near = near[near >= 0]
        if len(near) == 0:
            near = np.array([count])
        blame[near] += 1.0 / len(near)
        pairs[np.ix_(near, near)] += 1
    np.fill_diagonal(pairs, 0)
    return blame, pairs


def complexity(kind, form, cube, settings):
    """Return the price in nats of a solid: more for each number that a simpler solid would not need."""
    price = settings.price
    if kind == BOX and not cube:
        price += settings.cube_bonus
    if kind != SPHERE and form == FREE:
        price += settings.free_price
    return price


def total_energy(image, state, settings):
    """Return minus the log posterior density of a state, up to a constant."""
    return energy(image, state, settings.slack, 0.0) + sum(
        complexity(int(state.rows[k][0]), state.forms[k], state.cubes[k], settings) for k in range(len(state))
    )
