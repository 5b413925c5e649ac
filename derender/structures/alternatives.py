"""Structures besides the best one, and how probable each is: integrals of prior times likelihood, from draws.

A change of one solid is weighed with the others held at the mode: the two integrals are over that solid's coordinates
alone (`weighing.evidence_over`). Structures that differ in more, as the search met them, are weighed by the integral
over everything. What a solid's coordinates cost (its sizes' and places' densities) is in the prior (`chart.log_prior`),
so the ratio of integrals holds the Occam factor, and no price has to be set.

What one by one leaves open is open together (`combinations`): where a can may as well be a box and a cube beside it
longer than it is wide, one more structure has both changes.
"""

import math
from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.search.greedy import cube_of, spaced
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.graph import matched_names, names_of, structure_key
from derender.detection.solids.image import make_row, rotation_of
from derender.detection.solids.interpenetration import highest, lowest
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.solids.support import final_parents, flat_top, shadows_overlap, with_bottom
from derender.sampling.evidence import Evidence
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.draws.chart import HELD, PARENT, levelled, make_chart, support_of
from derender.structures.draws.metropolis import engine_of, load
from derender.structures.draws.refined import (
    Refined,
    at_mode,
    climb,
    floor_pose_of,
    height,
    members_of,
    near_evidence,
    pixels_of,
    refined_at,
    refitted,
    with_sensor_refitted,
    without_unseen,
)
from derender.structures.weighing import (
    CLOSE,
    IMPROBABLE,
    NEAR_ERROR,
    Block,
    Weighed,
    discrete_part,
    evidence_over,
    of_block,
    with_own_sensor,
)

PRUNE_THRESHOLD = 25.0  # nats below the best mode from which on a change is not looked at any further
PROMISING = 60.0  # nats below it up to which the sensor's numbers, fitted to the best, are fitted anew to a change
WORTHWHILE = 1.0  # nats that this has to gain for the solids to be climbed again
LONGER = 1.4  # times as long as a cube is a box tried on one side
YAWS = tuple(np.radians([0.0, 30.0, 60.0]))  # in which a solid that was round is tried as a box
PROPPING = 200.0  # nats below the best at which what hangs in the air is not given a support: that costs some too
NARROWER, BEHIND = 0.7, 0.3  # times as wide as what it bears is a support, and how far behind its middle it may be
LEAST_TALL = 0.01  # metres: what is lower is no solid that was found lying
SQUARER = 0.87  # times as wide as a circle is a square of about the same outline
FROM_SEARCH = 3  # structures that the search met, at most
WITHIN = 30.0  # nats of the search's own energy within which they are looked at
FEW_PIXELS = 80  # in which a solid's shape may hardly show
LEANING = np.radians(40.0)  # off the vertical up to which what was found leaning is tried upright, and as two stacked
AGAIN = 2  # climbs of a changed solid that is not pruned
QUICK, MOST_PATIENT = 50, 4.0  # steps of each temperature for one changed solid, and times as many at most
# Structures, the likeliest if no change told anything of another, and solids, those most likely other than in the best:
# with twenty that are open there are more combinations than can be counted.
MOST_COMBINED = 6

Changes = tuple[tuple[int, Weighed], ...]  # which solid, and the structure in which it alone is other than in the best


def supports_within(state: State, i: int) -> list[int]:
    """Return the other supports on which solid `i` might stand: those under it, and the floor."""
    row = state.rows[i]
    found = [FLOOR]
    for j in range(len(state)):
        if j != i and flat_top(state.rows[j]) and shadows_overlap(row, state.rows[j]) and state.parents[j] != i:
            if highest(state.rows[j]) < highest(row) - 0.01:
                found.append(j)
    return [j for j in found if j != state.parents[i]]


def changes(best: Refined, i: int) -> list[State]:
    """Return the states in which solid `i` is a cube instead of a box or the reverse, or stands on something else.

    Where two of a box's extents are about as long as a cube's edge the third may be hidden.
    """
    state = best.state
    row, form = state.rows[i], state.forms[i]
    found = []
    if int(row[0]) == BOX and state.cubes[i]:
        found += [changed(state, i, each, cube=False) for each in (row, *longer(row, best.chart.floor))]
    elif int(row[0]) == BOX:
        origin = -best.chart.floor[:3, :3].T @ best.chart.floor[:3, 3]
        for side in spaced([*row[13:16], row[13:16].mean()], 0.002):
            if np.median(np.abs(row[13:16] - side)) < 0.6 * side:
                found.append(changed(state, i, cube_of(row, side, origin, form), cube=True))
    if int(row[0]) != SPHERE and form != FREE and not np.isnan(state.bottoms[i]) and not state.cubes[i]:
        for parent in supports_within(state, i):
            height = 0.0 if parent == FLOOR else highest(state.rows[parent])
            new = changed(state, i, with_bottom(row, height), state.cubes[i])
            new.parents[i], new.bottoms[i] = parent, height
            found.append(new)
    return found


def longer(row: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Return the rows (2, ROW) of a box that is longer along one of its sides, the face that the camera sees held.

    How far it goes on behind that face may be open: then the walk from a cube stops at what the cube's edges explain.
    floor : (4, 4) pose, floor frame to camera.
    """
    eye = -floor[:3, :3].T @ floor[:3, 3]
    rows = np.array([row, row])
    for axis, new in enumerate(rows):
        along, more = rotation_of(row)[:, axis], (LONGER - 1.0) * row[13 + axis]
        new[13 + axis] += more
        new[10:13] -= 0.5 * more * np.sign(along @ (eye - row[10:13])) * along
    return rows


def changed(state: State, i: int, row: np.ndarray, cube: bool) -> State:
    """Return a state with another solid `i`."""
    new = state.copy()
    new.rows[i], new.cubes[i] = row, cube
    return new


def other_shapes(best: Refined, i: int, shapes: tuple[str, ...]) -> list[Any]:
    """Return the states in which a solid that shows in few pixels has another of these shapes, as large as it is."""
    state = best.state
    if pixels_of(best)[i] > FEW_PIXELS:
        return []
    row, kind = state.rows[i], int(state.rows[i][0])
    size = row[13:16]
    # a box becomes a can about the axis across which it is most nearly square
    axis = int(np.argmin([abs(size[k - 1] - size[k - 2]) for k in range(3)])) if kind == BOX else 2
    order = [(axis + 1) % 3, (axis + 2) % 3, axis]
    turned = np.eye(3) if kind == SPHERE else rotation_of(row)[:, order]
    wide, mean = np.sqrt(size[order[0]] * size[order[1]]), np.prod(size) ** (1.0 / 3.0)
    form = UPRIGHT if kind == SPHERE else state.forms[i] if axis == 2 else FREE
    found = []  # kind, form, extents, turn about the axis, whether it is a cube
    if kind != BOX:
        for yaw in YAWS:  # nothing of a round solid tells which way a box would be turned
            if "box" in shapes:
                found.append((BOX, form, [SQUARER * wide, SQUARER * wide, size[axis]], yaw, False))
            if "cube" in shapes:
                sides = spaced([SQUARER * wide, size[axis]], 0.2 * wide)
                found += [(BOX, form, [side] * 3, yaw, True) for side in sides]
    if kind != CYLINDER and "cylinder" in shapes:
        found.append((CYLINDER, form, [wide, wide, size[axis]], 0.0, False))
    if kind != SPHERE and "sphere" in shapes and i not in state.parents:
        found.append((SPHERE, FREE, [mean] * 3, 0.0, False))
    states = []
    for other, form, extents, yaw, cube in found:
        rotation = turned @ rotation_z(yaw)[:3, :3]
        new = changed(state, i, make_row(other, rotation, row[10:13], extents), cube)
        new.rows[i, 12] += lowest(row) - lowest(new.rows[i])
        new.forms[i] = form
        states.append(new)
    return states + stood_up(state, i, shapes)


def stood_up(state: State, i: int, shapes: tuple[str, ...]) -> list[State]:
    """Return the states in which a solid that lies or leans is a box or a cube that stands, as high and as wide."""
    row, parent = state.rows[i], state.parents[i]
    if state.forms[i] != FREE or int(row[0]) == SPHERE:
        return []
    bottom = 0.0 if parent == FLOOR else highest(state.rows[parent])
    tall = highest(row) - bottom
    if tall < LEAST_TALL:
        return []
    wide = np.sqrt(np.prod(row[13:16]) / tall)
    states = []
    for yaw in YAWS:
        for cube in (False, True):
            if ("cube" if cube else "box") in shapes:
                extents = [tall] * 3 if cube else [wide, wide, tall]
                centre = [row[10], row[11], bottom + 0.5 * tall]
                new = changed(state, i, make_row(BOX, rotation_z(yaw)[:3, :3], centre, extents), cube)
                new.forms[i], new.bottoms[i] = UPRIGHT, bottom
                states.append(new)
    return states


def uprighted(state: State, i: int) -> State | None:
    """Return the state in which a solid that leans a little stands, and what stands on it is level with its top.

    Noise tilts what shows in few pixels, and of one that leans a walk never comes to one that stands: that has fewer
    coordinates. None: it stands, or leans by more than LEANING.
    """
    row, rotation = state.rows[i], rotation_of(state.rows[i])
    if state.forms[i] != FREE or int(row[0]) == SPHERE:
        return None
    axis = int(np.argmax(np.abs(rotation[2]))) if int(row[0]) == BOX else 2
    if abs(rotation[2, axis]) < np.cos(LEANING):
        return None
    order = [(axis + 1) % 3, (axis + 2) % 3, axis]
    bottom = 0.0 if state.parents[i] == FLOOR else highest(state.rows[state.parents[i]])
    centre = [row[10], row[11], bottom + 0.5 * row[13 + axis]]
    upright = make_row(int(row[0]), levelled(rotation[:, order]), centre, row[13:16][order])
    new = changed(state, i, upright, state.cubes[i])
    new.forms[i], new.bottoms[i] = UPRIGHT, bottom
    for k in carried_upright(new, i):
        new.bottoms[k] = highest(new.rows[i])
        new.rows[k, 12] += new.bottoms[k] - lowest(new.rows[k])
    return new


def carried_upright(state: State, i: int) -> list[int]:
    """Return the upright solids on solid `i`."""
    return [k for k in range(len(state)) if state.parents[k] == i and state.forms[k] == UPRIGHT]


def as_two(best: Refined, i: int, shapes: tuple[str, ...]) -> list[State]:
    """Return the states in which a box that leans a little is two that stand on each other, boxes or cubes, each below
    and above where half of it is: seen in few pixels, a step between the two looks like a lean."""
    state, whole = best.state, uprighted(best.state, i)
    if whole is None or int(state.rows[i][0]) != BOX or i in state.parents or pixels_of(best)[i] > FEW_PIXELS:
        return []
    row, leaning = whole.rows[i], rotation_of(state.rows[i])
    up = leaning[:, int(np.argmax(np.abs(leaning[2])))]
    bottom, half, aside = whole.bottoms[i], 0.5 * row[15], 0.25 * row[15] * up[:2] / up[2]
    states = []
    for cubes in product([cube for cube in (False, True) if ("cube" if cube else "box") in shapes], repeat=2):
        sizes = [[half] * 3 if cube else [*row[13:15], half] for cube in cubes]
        lower, upper = (
            make_row(BOX, rotation_of(row), [*(row[10:12] + side * aside), bottom + (1.0 + 0.5 * side) * half], size)
            for side, size in zip((-1.0, 1.0), sizes, strict=True)
        )
        new = changed(whole, i, lower, cubes[0]).add(upper, UPRIGHT, cubes[1], i, bottom + half)
        states.append(new)
    return states


def of_one_solid(
    rng: np.random.Generator, best: Refined, i: int, rules: Rules, shapes: tuple[str, ...] = ()
) -> list[Weighed]:
    """Return the Weighed of the changes of one solid that are not pruned.

    shapes : names of those that it may be instead, where that hardly shows.
    """
    floor, steps = floor_pose_of(best), quick_steps(int(pixels_of(best)[i]))

    def likely(states: list[State]) -> list[Refined]:
        found: list[Refined] = []
        for state in states:
            if not still_bears(best, state, i):
                continue
            trial = at_mode(rng, state, floor, best.sensor, rules, steps, [i])
            if height(trial) > height(best) - PROMISING:
                trial = with_own_sensor(rng, trial, [i], WORTHWHILE)
            if height(trial) > height(best) - PRUNE_THRESHOLD and all_seen(trial):
                found.append(trial)
        return found

    found = likely([*changes(best, i), *other_shapes(best, i, shapes)])
    found += likely(as_boxes(best, likeliest_of_each(found), i))
    propped = [] if rules.floating else propped_up(best, i, shapes)
    least = PROPPING if propped else PRUNE_THRESHOLD
    upright = uprighted(best.state, i)
    on_it = [] if upright is None else carried_upright(best.state, i)
    several = []
    for state in [*propped, *([] if upright is None else [upright]), *as_two(best, i, shapes)]:
        places = [i, *on_it, *range(len(best.state), len(state))]
        trial = at_mode(rng, state, floor, best.sensor, rules, QUICK, places)
        if height(trial) > height(best) - max(PROMISING, least):
            trial = with_own_sensor(rng, trial, places, WORTHWHILE)
        if height(trial) > height(best) - least and all_seen(trial):
            several.append(trial)
    removed = without(best, i, floor, rules)
    others: list[Weighed] = []
    if height(removed) > height(best) - PROMISING:
        # what stands about it may have given way to what is not there: then it goes back once that is gone
        others = weighed_whole(rng, best, [removed.state], rules, QUICK)
        removed = refitted(removed)
    candidates = [(climbed_again(rng, trial, i, steps), [i]) for trial in likeliest_of_each(found)]
    if height(removed) > height(best) - PRUNE_THRESHOLD:
        candidates.append((removed, []))
    own = Block(best, [i])
    others += [of_block(rng, trial, places, own) for trial, places in candidates]
    own = Block(best, [i, *on_it]) if on_it else own
    others += [of_block(rng, trial, [i, *on_it, *range(len(best.state), len(trial.state))], own)
               for trial in likeliest_of_each(several)]  # fmt: skip
    return others


def as_boxes(best: Refined, trials: list[Refined], i: int) -> list[State]:
    """Return the states in which solid `i`, a box or a cube in the trials and not in the best, is the other of the two.

    What began with a round solid's place and size may have ended beside its mode, and leads there from the other's.
    """
    if int(best.state.rows[i][0]) == BOX:
        return []
    return [state for trial in trials for state in changes(trial, i) if state.parents[i] == trial.state.parents[i]]


def quick_steps(pixels: int) -> int:
    """Return the steps of each temperature for a changed solid that shows in so many pixels.

    The fewer they are, the more ways it may lie that explain them about as well, and the less a step costs.
    """
    return int(QUICK * np.clip(FEW_PIXELS / max(pixels, 1), 1.0, MOST_PATIENT))


def climbed_again(rng: np.random.Generator, trial: Refined, i: int, steps: int) -> Refined:
    """Return the highest of a Refined and of AGAIN hot climbs of solid `i` from there: one alone may end beside the
    mode, and what shows in few pixels may lie so or so."""
    members = members_of(trial.chart, [i])
    climbs = [climb(rng, trial.state, trial.chart, trial.values.copy(), trial.sensor, steps, members)
              for _ in range(AGAIN)]  # fmt: skip
    return max([trial, *climbs], key=height)


def climbed_higher(rng: np.random.Generator, best: Refined) -> Refined:
    """Return the Refined once all its solids were climbed again from hot, and each that shows in few pixels alone, the
    sensor fitted anew, as long as that makes it likelier by WORTHWHILE.

    What others are weighed against is to be its mode as theirs are: one was 30 nats below. Not where neighbouring
    pixels share noise: a climb takes five times as long there.
    """
    while best.sensor.worth >= 1.0:
        again = climb(rng, best.state, best.chart, best.values.copy(), best.sensor, QUICK)
        higher = max(best, again, key=height)
        for i, many in enumerate(pixels_of(higher)):
            if many <= FEW_PIXELS:
                higher = climbed_again(rng, higher, i, quick_steps(int(many)))
        if height(higher) < height(best) + WORTHWHILE:
            return higher
        best = with_sensor_refitted(rng, higher)
    return best


def still_bears(best: Refined, state: State, i: int) -> bool:
    """Whether all that stands on solid `i` in the best is level with its top in a state too.

    What is not would hang where it was, beside something higher or over something lower, which is another structure.
    """
    flags = best.chart.flags
    carried = np.flatnonzero((flags[:, PARENT] == i) & (flags[:, HELD] == 1))
    return all(support_of(state, k, i) == i for k in carried.tolist())


def propped_up(best: Refined, i: int, shapes: tuple[str, ...]) -> list[State]:
    """Return the states in which a solid that stands on nothing has a box or a cube under it, hidden by it or by
    others: as high as it hangs, below its middle or somewhat behind."""
    state, row = best.state, best.state.rows[i]
    gap = lowest(row)
    if state.forms[i] != UPRIGHT or not np.isnan(state.bottoms[i]) or gap < LEAST_TALL or state.parents[i] != FLOOR:
        return []
    away = row[10:12] + (best.chart.floor[:3, :3].T @ best.chart.floor[:3, 3])[:2]  # from the camera
    behind = BEHIND * row[13:15].min() * away / max(float(np.linalg.norm(away)), 1e-9)
    states = []
    for place in (row[10:12], row[10:12] + behind):
        for cube in (False, True):
            if ("cube" if cube else "box") in shapes:
                extents = [gap] * 3 if cube else [*(NARROWER * row[13:15]), gap]
                under = make_row(
                    BOX, rotation_of(row) if int(row[0]) == BOX else np.eye(3), [*place, 0.5 * gap], extents
                )
                new = state.add(under, UPRIGHT, cube, FLOOR, 0.0)
                new.parents[i], new.bottoms[i] = len(state), gap
                states.append(new)
    return states


def likeliest_of_each(trials: list[Refined]) -> list[Refined]:
    """Return the highest of those trials with the same structure (cubes that hold different corners at the start)."""
    found: dict[tuple, Refined] = {}
    for trial in trials:
        key = discrete_part(trial.state)
        if key not in found or height(trial) > height(found[key]):
            found[key] = trial
    return list(found.values())


def all_seen(trial: Refined) -> bool:
    """Whether every solid of a Refined shows or carries something: one that does neither could be anywhere at all."""
    return len(without_unseen(trial.state, trial)) == len(trial.state)


def without(best: Refined, i: int, floor: np.ndarray, rules: Rules) -> Refined:
    """Return the Refined of the best state with solid `i` taken away, the rest as it is."""
    state = best.state.without(i)
    chart, values = make_chart(state, floor, rules)
    engine = engine_of(chart, best.sensor)
    return refined_at(state, chart, values, best.sensor, *load(engine, chart, values))


def one_step_away(best: Any, names: Any) -> Iterator[Any]:
    """Yield the keys of the structures that `of_one_solid` weighs, at a fifth of the cost of an integral over all."""
    for i in range(len(best.state)):
        yield from (structure_key(state, names) for state in changes(best, i))
        yield structure_key(best.state.without(i), [*names[:i], *names[i + 1 :]])


def from_search(
    rng: np.random.Generator, best: Refined, pool: list[tuple[State, float]], energy: float, rules: Rules, temper: float
) -> list[Any]:
    """Return the Weighed of structures that the search met, more than one step from the best.

    pool : (state, energy) of them. energy : the best one's. temper : by which energies are multiples of nats.
    """
    names = names_of(best.state)
    seen = {structure_key(best.state, names), *one_step_away(best, names)}
    near: list = []
    for state, value in sorted(pool, key=lambda pair: pair[1]):
        if value > energy + temper * WITHIN or len(near) >= FROM_SEARCH:
            break
        state = state.copy()
        state.parents = final_parents(state)
        key = structure_key(state, matched_names(state, best.state, names))
        if key not in seen:
            seen.add(key)
            near.append(state)
    return weighed_whole(rng, best, near, rules, QUICK)


def weighed_whole(
    rng: np.random.Generator, best: Refined, states: list[State], rules: Rules, steps: int
) -> list[Weighed]:
    """Return the Weighed of those states that are not pruned, by integrals over everything.

    steps : of each temperature for each solid.
    """
    trials = [with_own_sensor(rng, trial, range(len(trial.state)), WORTHWHILE)
              for trial in climbed(rng, best, states, rules, steps, PROMISING)]  # fmt: skip
    trials = [trial for trial in trials if height(trial) > height(best) - PRUNE_THRESHOLD and all_seen(trial)]
    if not trials:
        return []
    everyone = (best, *trials)
    near = [Evidence(near_evidence(each), NEAR_ERROR) for each in everyone]
    first = max(each.log for each in near)
    likely = [k for k in range(len(near)) if near[k].log > first - IMPROBABLE]
    tasks = [partial(evidence_over, refined=everyone[k]) for k in likely]
    whole = list(near)
    if len(likely) > 1:
        for k, found in zip(likely, in_threads(rng, tasks), strict=True):
            whole[k] = found
    weighed = []
    for k, trial in enumerate(trials, start=1):
        found, own = whole[k], whole[0]
        if max(found.standard_error, own.standard_error) > NEAR_ERROR:  # normals about both modes tell more
            found, own = near[k], near[0]
        odds = found.log - own.log + trial.sensor.log_prior() - best.sensor.log_prior()
        weighed.append(Weighed(trial, odds, math.hypot(found.standard_error, own.standard_error)))
    return weighed


def climbed(
    rng: np.random.Generator, best: Refined, states: list[State], rules: Rules, steps: int, within: float
) -> list[Refined]:
    """Return the Refined of those states whose modes are within so many nats of the best's."""
    floor = floor_pose_of(best)
    trials = in_threads(rng, [
        partial(at_mode, state=new, floor_pose=floor, sensor=best.sensor, rules=rules, steps=steps) for new in states
    ])  # fmt: skip
    return [trial for trial in trials if height(trial) > height(best) - within]


def combinations(rng: np.random.Generator, best: Refined, others: list[Weighed], rules: Rules) -> list[Weighed]:
    """Return the Weighed of structures that make several of the changes of single solids among the Weighed of others.

    Solids that touch or hide each other are not independent: each combination is climbed and weighed as a whole.
    """
    tasks = [partial(combined, best=best, changes=changes, rules=rules) for changes in likeliest_of(others)]
    return [found for found in in_threads(rng, tasks) if found is not None]


def likeliest_of(others: list[Weighed]) -> list[Changes]:
    """Return the combinations of two and more changes, each of another solid, whose odds would be at least -CLOSE."""
    single: dict[int, list[tuple[int, Weighed]]] = {}
    for each in others:
        if each.places is not None and len(each.places[0]) == 1 and each.places[0] == each.places[1]:
            if abs(each.odds) < CLOSE:
                (k,) = each.places[0]
                single.setdefault(k, []).append((k, each))
    open_most = sorted(single.values(), key=lambda changes: max(each.odds for _, each in changes), reverse=True)
    choices = product(*([None, *changes] for changes in open_most[:MOST_COMBINED]))
    found = [tuple(change for change in choice if change is not None) for choice in choices]
    found = [changes for changes in found if len(changes) > 1 and odds_apart(changes) > -CLOSE]
    return sorted(found, key=odds_apart, reverse=True)[:MOST_COMBINED]


def odds_apart(changes: Changes) -> float:
    """Return the log odds of changes that tell nothing of each other."""
    return sum(each.odds for _, each in changes)


def combined(rng: np.random.Generator, best: Refined, changes: Changes, rules: Rules) -> Weighed | None:
    """Return the Weighed of a structure with all these changes of single solids; None: it is far below the best."""
    state = best.state.copy()
    for k, each in changes:
        changed = each.trial.state
        state.rows[k], state.forms[k], state.cubes[k] = changed.rows[k], changed.forms[k], changed.cubes[k]
        state.parents[k], state.bottoms[k] = changed.parents[k], changed.bottoms[k]
    solids = sorted(k for k, _ in changes)
    trial = at_mode(rng, state, floor_pose_of(best), best.sensor, rules, QUICK, solids)
    trial = with_own_sensor(rng, trial, solids, WORTHWHILE)
    if height(trial) <= height(best) - PRUNE_THRESHOLD or not all_seen(trial):
        return None
    return of_block(rng, trial, solids, Block(best, solids))
