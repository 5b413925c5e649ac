"""Explain the image by a set of solids: greedy addition of polished hypotheses, then sweeps of local moves."""

from typing import NamedTuple

import numpy as np

from derender.inference.structure.image import added_misfit
from derender.inference.structure.polish import FREE, SLACK, UPRIGHT, polish, size_energy
from derender.inference.structure.state import State, held_out
from derender.inference.structure.support import assign_supports
from derender.model.solids import BOX


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
    """

    shapes: tuple[str, ...] = ("box", "cube", "cylinder", "sphere")
    max_objects: int = 30
    price: float = 40.0
    slack: float = SLACK
    cube_bonus: float = 7.0


def run_polish(rng, image, state, index, row, form, cube, view, bottom, settings, rounds, step=0.003, heat=2.0):
    """Polish one solid against the rest of the scene; return (row, energy, misfit change)."""
    depth, _, misfit, _ = view
    return polish(image, row, form, cube, state.rows, index, depth, misfit, bottom, settings.slack, rounds, step, heat,
                  int(rng.integers(2**31)))  # fmt: skip


def greedy(rng, image, hypotheses, settings, state=None):
    """Add the best polished hypothesis again and again while it gains more than its price."""
    state = State() if state is None else state
    alive = list(hypotheses)
    polished = {}
    while alive and len(state) < settings.max_objects:
        view = held_out(image, state, -1)
        gains = np.array([-added_misfit(image, h.row, view[0], view[2]) for h in alive])
        order = np.argsort(-gains)[:5]
        best = None
        for k in order:
            h = alive[k]
            row, energy, change = run_polish(rng, image, state, -1, h.row, h.form, h.cube, view, np.nan, settings, 150)
            if best is None or energy < best[1]:
                best = (row, energy, change, h)
        row, energy, change, h = best
        if -energy < settings.price:
            break
        row, energy, change = run_polish(rng, image, state, -1, row, h.form, h.cube, view, np.nan, settings, 300, 0.002)
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
        gain = -added_misfit(image, state.rows[i], depth, misfit) - size_energy(state.rows[i], state.cubes[i])
        if gain < settings.price:
            state = state.without(i)
            i = 0
        else:
            i += 1
    return state


def search(rng, image, hypotheses, settings):
    """Return the best State found."""
    state = greedy(rng, image, hypotheses, settings)
    state = assign_supports(image, state, settings.slack)
    sweep(rng, image, state, settings, 200)
    state = prune(image, state, settings)
    state = try_cubes(rng, image, state, settings)
    state = assign_supports(image, state, settings.slack)
    sweep(rng, image, state, settings, 300, 0.001, 0.0)
    return prune(image, state, settings)


__all__ = ["FREE", "Settings", "search"]
