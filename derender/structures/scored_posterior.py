"""A posterior about the best state by the search's own tempered score, for images whose pixels are not independent.

Solids take turns in compiled Metropolis walks (`solids/polish.walk`). Structures compete by their polished energies:
the price of each number in `Settings` stands for the Occam factor that its integral would give.
"""

import time
from functools import partial
from typing import NamedTuple

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.search.greedy import sweep, total_energy, try_cube
from derender.detection.solids.graph import names_of, periods_of, pose_of, scene_graph
from derender.detection.solids.image import CENTRE, ROTATION, SIZE, rotation_of
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.naming import matched_names, structure_key
from derender.detection.solids.polish import TANGENT, WALK_MOVES, walk
from derender.detection.solids.state import FLOOR, State, carried_by, held_out, in_the_way, run_polish
from derender.detection.solids.support import with_bottom
from derender.results.posterior import StructurePosterior
from derender.sampling.diagnostics import unwrap
from derender.scene.pose import rotation_vector
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.alternatives import supports_within
from derender.structures.draws.agreement import agree
from derender.structures.draws.discrepancy import with_offsets
from derender.structures.draws.numbers import numbers_at, parameters_of

# Structures less probable than the best by more than this many nats are not reported.
NEGLIGIBLE = 8.0
MOST_PARTS = 12
# Steps of each solid between two draws, doubled for as long as the chains do not agree; how many of a chain that is
# worth without a budget, a few seconds; sweeps of warm-up.
STEPS, MOST_STEPS, WARMUP = 16, 60_000, 4
JOINT_SCALE, LEAST_VARIANCE = 2.38, 1e-9  # times standard deviations; of the largest variance: what is less is held
NO_JOINT_STEPS = np.empty((TANGENT, 0))
STEPPING = 0.002, 0.001  # metres of the first steps of two sweeps in a closer look


def refresh_bottom(state, index):
    """Return the height to which a solid is held, from where its support is now."""
    if np.isnan(state.bottoms[index]):
        return np.nan
    parent = state.parents[index]
    return 0.0 if parent == FLOOR else highest(state.rows[parent])


class Walker(NamedTuple):
    """Where a chain is and how it steps: a State; scales (N, WALK_MOVES) and factors of N joint steps, of `walk`."""

    state: State
    scales: np.ndarray
    factors: list[np.ndarray]


def walk_solid(rng, image, walker, index, settings, steps, adapt):
    """Walk one solid given the others, in place."""
    state = walker.state
    state.bottoms[index] = refresh_bottom(state, index)
    depth, _, misfit, _ = held_out(image, state, index)
    state.rows[index] = walk(
        rng, image, state.rows[index], state.forms[index], state.cubes[index], in_the_way(state.rows, settings), index,
        depth, misfit, state.bottoms[index], carried_by(state, index), settings.slack, settings.tilt,
        walker.scales[index], steps, settings.temper, adapt, walker.factors[index],
    )  # fmt: skip


def draw_rows(rng, image, walkers, settings, draws, steps):
    """Return rows (chains, draws, N, ROW) and energies (chains, draws) of chains from where `walkers` are.

    walkers : the Walker of each chain, changed in place so that it can go on: in the next call with joint steps as all
        chains of this one have scattered.
    """
    tasks = [partial(draw_chain, image=image, walker=walker, settings=settings, draws=draws, steps=steps)
             for walker in walkers]  # fmt: skip
    rows, energies = map(np.array, zip(*in_threads(rng, tasks), strict=True))
    for k in range(rows.shape[2]):
        factor = joint_factor(rows[:, :, k].reshape(-1, rows.shape[-1]))
        for walker in walkers:
            walker.factors[k] = factor
    return rows, energies


def joint_factor(rows):
    """Return (TANGENT, D) a factor of the covariance of joint steps (`polish.joint_step`) of one solid from draws of it
    (n, ROW): theirs, scaled as is best in D dimensions (Roberts, Gelman and Gilks 1997)."""
    first = rotation_of(rows[0])
    turns = np.array([rotation_vector(first.T @ rotation_of(row)) for row in rows])
    tangents = np.column_stack([rows[:, CENTRE:SIZE], turns, rows[:, SIZE:]])
    variances, axes = np.linalg.eigh(np.cov(tangents, rowvar=False))
    free = variances > LEAST_VARIANCE * max(variances.max(), LEAST_VARIANCE)
    return np.ascontiguousarray(JOINT_SCALE / np.sqrt(max(free.sum(), 1)) * axes[:, free] * np.sqrt(variances[free]))


def draw_chain(rng, image, walker, settings, draws, steps):
    """Return rows (draws, N, ROW) and energies (draws,) of one chain."""
    now = walker.state
    rows, energies = np.empty((draws, *now.rows.shape)), np.empty(draws)
    for sweeps in range(WARMUP + draws):
        early = sweeps < WARMUP
        for index in rng.permutation(len(now)):
            walk_solid(rng, image, walker, index, settings, 2 * steps if early else steps, early)
        if not early:
            rows[sweeps - WARMUP] = now.rows
            energies[sweeps - WARMUP] = total_energy(image, now, settings)
    return rows, energies


def undo_spin(rows, start):
    """Turn cylinders (..., ROW) about their own axes to where they are turned least from a row, in place.

    Nothing shows how a cylinder is turned about its axis; the walk's small tilts add up to such turns, of which a
    contact's angle would say that the chains disagree.
    """
    turns = rows[..., ROTATION:CENTRE].reshape(*rows.shape[:-1], 3, 3)
    axis, first = turns[..., 2], rotation_of(start)[:, 0]
    first = first - (axis @ first)[..., None] * axis
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    turns = np.stack([first, np.cross(axis, first), axis], axis=-1)
    rows[..., ROTATION:CENTRE] = turns.reshape(*rows.shape[:-1], 9)


def values_of(graph, rows, names, floor_pose, addresses):
    """Return the graph's numbers at these addresses, (chains, draws, P), of rows (chains, draws, N, ROW)."""
    kinds = [graph.vertex(name).shape for name in names]
    values = np.empty((*rows.shape[:2], len(addresses)))
    for chain, draw in np.ndindex(rows.shape[:2]):
        places = {name: (pose_of(row), parameters_of(row, kind))
                  for name, kind, row in zip(names, kinds, rows[chain, draw], strict=True)}  # fmt: skip
        numbers = numbers_at(graph, floor_pose, places)
        values[chain, draw] = [numbers[a] for a in addresses]
    return values


def alternatives(rng, image, state, settings):
    """Yield (state, energy) of structures one step away: another support, a cube for a box and back, one solid less."""
    for i in range(len(state)):
        row, form = state.rows[i], state.forms[i]
        view = held_out(image, state, i)
        if int(row[0]) == BOX:
            new = state.copy()
            new.cubes[i] = not state.cubes[i]
            if new.cubes[i]:
                new.rows[i], _, _ = try_cube(rng, image, state, i, view, settings, 200)
            else:
                new.rows[i], _, _ = run_polish(rng, image, state, i, row, form, False, view, state.bottoms[i],
                                               settings, 200, 0.001)  # fmt: skip
            yield new, total_energy(image, new, settings)
        if int(row[0]) != SPHERE and not np.isnan(state.bottoms[i]) and not state.cubes[i]:
            for parent in supports_within(state, i):
                new = state.copy()
                height = 0.0 if parent == FLOOR else highest(state.rows[parent])
                new.parents[i], new.bottoms[i] = parent, height
                start = with_bottom(row, height)
                new.rows[i], _, _ = run_polish(rng, image, new, i, start, form, False, view, height, settings, 200)
                yield new, total_energy(image, new, settings)
        new = state.without(i)
        yield new, total_energy(image, new, settings)


def polished_closer(rng, closer, state, settings):
    """Return (state, settings) for a closer look: the state polished on more pixels, which tell as much as fewer."""
    settings = settings.for_pixels(closer.times**2)
    as_firm = settings._replace(slack=settings.slack / closer.times)  # the search does not temper contacts
    state = state.copy()
    for step in STEPPING:
        sweep(rng, closer.image, state, as_firm, 400, step, 0.0)
    return state, settings


def part_of(rng, seen, closer, state, settings, names, weight, chains, draws):
    """Return the StructurePosterior of one structure. closer : Closer under which it is drawn, or None."""
    image, floor_pose = seen.image, seen.floor.pose
    if closer is not None:
        image, (state, settings) = closer.image, polished_closer(rng, closer, state, settings)
    graph = scene_graph(state, floor_pose, names, settings.may_float)
    addresses = tuple(a for a in graph.numbers() if a.partition(".")[0] in names)
    periods = periods_of(graph, addresses)
    if len(state) == 0 or draws < 2:
        rows, energies = state.rows[None, None], np.array([[total_energy(image, state, settings)]])
        values = values_of(graph, rows, names, floor_pose, addresses)
    else:
        walkers = [Walker(state.copy(), np.full((len(state), WALK_MOVES), 1e-3), [NO_JOINT_STEPS] * len(state))
                   for _ in range(chains)]  # fmt: skip
        steps, spent = STEPS, 0
        while True:
            rows, energies = draw_rows(rng, image, walkers, settings, draws, steps)
            for k in range(len(state)):
                if int(state.rows[k][0]) == CYLINDER:
                    undo_spin(rows[:, :, k], state.rows[k])
            if settings.discrepancy > 0.0:
                for chain, draw in np.ndindex(energies.shape):
                    rows[chain, draw] = with_offsets(rng, rows[chain, draw], state, settings.discrepancy)
            rows[0, 0], energies[0, 0] = state.rows, total_energy(image, state, settings)
            values = values_of(graph, rows, names, floor_pose, addresses)
            if chains == 1 or agree(np.stack([*map(unwrap, np.moveaxis(values, -1, 0), periods)], axis=-1)):
                break
            spent, steps = spent + steps * draws * len(state), 2 * steps
            if settings.until is None and spent + steps * draws * len(state) > MOST_STEPS:
                break
            if settings.until is not None and time.monotonic() > settings.until:
                break
    return StructurePosterior(
        graph,
        addresses,
        values,
        np.zeros(energies.shape),
        -energies / settings.temper,
        weight,
        periods,
    )


def posterior_parts(rng, seen, closer, state, pool, settings, chains=2, draws=100):
    """Return the parts of the posterior: the best structure with full chains, the others with short ones.

    seen : Observation by which structures are weighed; closer : Closer under which their numbers are drawn, or None.
    pool : states that the search came by, with their energies.
    """
    image = seen.image
    names = names_of(state)
    best = total_energy(image, state, settings)
    found: dict[tuple, tuple[State, float]] = {structure_key(state, names): (state, best)}
    candidates = [*alternatives(rng, image, state, settings)]
    candidates += [(s, e) for s, e in pool if e < best + NEGLIGIBLE * settings.temper]
    for other, energy in candidates:
        if energy > best + NEGLIGIBLE * settings.temper:
            continue
        key = structure_key(other, matched_names(other, state, names))
        if key not in found or energy < found[key][1]:
            found[key] = (other, energy)
    kept = sorted(found.values(), key=lambda pair: pair[1])[:MOST_PARTS]
    polished = []
    for other, energy in kept:
        if other is not state:
            other = sweep(rng, image, other.copy(), settings, 200, 0.001, 0.0)
            energy = total_energy(image, other, settings)
        polished.append((other, energy))
    low = min(e for _, e in polished)
    weights = np.exp(-(np.array([e for _, e in polished]) - low) / settings.temper)
    weights /= weights.sum()
    parts = []
    for (other, _), weight in zip(polished, weights, strict=True):
        own = names if other is state else matched_names(other, state, names)
        leading = weight == weights.max()
        parts.append(part_of(rng, seen, closer, other, settings, own, float(weight),
                             chains if leading else 1, draws if leading else max(draws // 5, 2)))  # fmt: skip
    return parts
