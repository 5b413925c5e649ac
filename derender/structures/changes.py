"""States in which one solid of the best is otherwise: of another shape or on another support, upright, as two, propped
up by what is hidden. How probable they are is told by alternatives.py."""

from itertools import product
from typing import Any

import numpy as np

from derender.detection.search.greedy import cube_of
from derender.detection.search.proposals import spaced
from derender.detection.solids.image import make_row, rotation_of
from derender.detection.solids.interpenetration import highest, lowest
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.solids.support import flat_top, shadows_overlap, shares_of_load, with_bottom
from derender.render.blur import blur
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.draws.chart import HELD, PARENT, levelled, support_of
from derender.structures.draws.refined import Refined, pixels_of
from derender.structures.draws.sensor import model_image

LEAST_APART = 1e-4  # metres between the sides of cubes that a box may be: what the sharpest image tells
LONGER = 1.4  # times as long as a cube is a box tried on one side
YAWS = tuple(np.radians([0.0, 30.0, 60.0]))  # in which a solid that was round is tried as a box
NARROWER, BEHIND = 0.7, 0.3  # times as wide as what it bears is a support, and how far behind its middle it may be
REACH = 0.01  # metres between solids that touch: where they do an image tells to millimetres
LEAST_TALL = 0.01  # metres: what is lower is no solid that was found lying
SQUARER = 0.87  # times as wide as a circle is a square of about the same outline
FEW_PIXELS = 80  # in which a solid's shape may hardly show
BADLY = 4.5  # standard deviations by which squares are more than noise makes them: one solid in 300,000
LEANING = np.radians(40.0)  # off the vertical up to which what was found leaning is tried upright, and as two stacked


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

    Where two of a box's extents are about as long as a cube's edge the third may be hidden. Of a cube each corner of
    the box is held in one state: where edges are sharp half a millimetre is farther than a walk comes.
    """
    state = best.state
    row, form = state.rows[i], state.forms[i]
    found = []
    if int(row[0]) == BOX and state.cubes[i]:
        found += [state.changed(i, row=each, cube=False) for each in (row, *longer(row, best.chart.floor))]
    elif int(row[0]) == BOX:
        ways = np.array(list(product((-1.0, 1.0), (-1.0, 1.0), (-1.0,) if form == UPRIGHT else (-1.0, 1.0))))
        corners = row[10:13] + ways * row[13:16] @ rotation_of(row).T
        # the middle one first: an extent that is told worst is off the others, too far for a walk along sharp edges
        for side in spaced([np.median(row[13:16]), *row[13:16], row[13:16].mean()], LEAST_APART):
            if np.median(np.abs(row[13:16] - side)) < 0.6 * side:
                found += [state.replaced(i, cube_of(state[i], side, corner)) for corner in corners]
    if int(row[0]) != SPHERE and form != FREE and not np.isnan(state.bottoms[i]) and not state.cubes[i]:
        for parent in supports_within(state, i):
            height = 0.0 if parent == FLOOR else highest(state.rows[parent])
            found.append(state.changed(i, row=with_bottom(row, height), parent=parent, bottom=height))
    return found


def longer(row: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Return the rows (2, ROW) of a box that is longer along one side, the face that the camera sees held: from the
    cube no walk comes there. floor : (4, 4) pose, floor frame to camera."""
    eye = -floor[:3, :3].T @ floor[:3, 3]
    rows = np.array([row, row])
    for axis, new in enumerate(rows):
        along, more = rotation_of(row)[:, axis], (LONGER - 1.0) * row[13 + axis]
        new[13 + axis] += more
        new[10:13] -= 0.5 * more * np.sign(along @ (eye - row[10:13])) * along
    return rows


def other_shapes(best: Refined, i: int, shapes: tuple[str, ...]) -> list[Any]:
    """Return the states in which a solid that shows in few pixels, or explains its own badly, has another of these
    shapes, as large as it is."""
    state = best.state
    if best.sensor.shows * pixels_of(best)[i] > FEW_PIXELS and not badly_explained(best, i):
        return []
    row, kind = state.rows[i], int(state.rows[i][0])
    size = row[13:16]
    # a box becomes a can about the axis across which it is most nearly square, a cube about the one that stands
    axis = min((2, 0, 1), key=lambda k: abs(size[k - 1] - size[k - 2])) if kind == BOX else 2
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
        new = make_row(other, rotation, row[10:13], extents)
        new[12] += lowest(row) - lowest(new)
        states.append(state.changed(i, row=new, form=form, cube=cube))
    return states + stood_up(state, i, shapes)


def badly_explained(best: Refined, i: int) -> bool:
    """Whether what solid `i` explains is off by more than noise: a search counts no pixel for more than an outlier."""
    sensor = best.sensor
    depth, label = model_image(best.chart, best.values, sensor.camera, sensor.into, sensor.values["background"])
    shown = (label == i + 1) & np.isfinite(sensor.returned)
    if sensor.worth < 1.0 or not shown.any():
        return False
    off = (blur(depth, sensor.values["blur"]) - sensor.returned)[shown] / sensor.values["sigma"]
    return float((np.mean(off**2) - 1.0) * np.sqrt(0.5 * off.size)) > BADLY


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
                standing = make_row(BOX, rotation_z(yaw)[:3, :3], centre, extents)
                states.append(state.changed(i, row=standing, form=UPRIGHT, cube=cube, bottom=bottom))
    return states


def uprighted(state: State, i: int) -> State | None:
    """Return the state in which a solid that leans a little (LEANING, else None) stands, with what stands on it: noise
    tilts what shows in few pixels, and no walk comes to a structure of fewer coordinates."""
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
    new = state.changed(i, row=upright, form=UPRIGHT, bottom=bottom)
    for k in carried_upright(new, i):
        new.bottoms[k] = highest(new.rows[i])
        new.rows[k, 12] += new.bottoms[k] - lowest(new.rows[k])
    return new


def carried_upright(state: State, i: int) -> list[int]:
    """Return the upright solids on solid `i`."""
    return [k for k in range(len(state)) if state.parents[k] == i and state.forms[k] == UPRIGHT]


def as_two(best: Refined, i: int, shapes: tuple[str, ...]) -> list[State]:
    """Return the states in which a box or a can that leans a little is two, boxes or cubes, half as high, on each
    other, and what stands on it on the upper one: seen in few pixels, a step between the two looks like a lean."""
    state, whole = best.state, uprighted(best.state, i)
    if whole is None or pixels_of(best)[i] > FEW_PIXELS:
        return []
    row, leaning, round_one = whole.rows[i], rotation_of(state.rows[i]), int(state.rows[i][0]) != BOX
    up = leaning[:, int(np.argmax(np.abs(leaning[2])))]
    bottom, half, aside = whole.bottoms[i], 0.5 * row[15], 0.25 * row[15] * up[:2] / up[2]
    wide = (SQUARER if round_one else 1.0) * row[13:15]
    kinds = [cube for cube in (False, True) if ("cube" if cube else "box") in shapes]
    whole.parents = [len(state) if parent == i else parent for parent in whole.parents]
    states = []
    for yaw, *cubes in product(YAWS if round_one else YAWS[:1], kinds, kinds):
        sizes = [[half] * 3 if cube else [*wide, half] for cube in cubes]
        turned = rotation_of(row) @ rotation_z(yaw)[:3, :3]
        lower, upper = (
            make_row(BOX, turned, [*(row[10:12] + side * aside), bottom + (1.0 + 0.5 * side) * half], size)
            for side, size in zip((-1.0, 1.0), sizes, strict=True)
        )
        states.append(whole.changed(i, row=lower, cube=cubes[0]).add(upper, UPRIGHT, cubes[1], i, bottom + half))
    return states


def still_bears(best: Refined, state: State, i: int) -> bool:
    """Whether all that stands on solid `i` in the best is level with its top in a state too: it would hang
    otherwise."""
    flags = best.chart.flags
    carried = np.flatnonzero((flags[:, PARENT] == i) & (flags[:, HELD] == 1))
    return all(support_of(state, k, i) == i for k in carried.tolist())


def propped_up(best: Refined, i: int, shapes: tuple[str, ...]) -> list[State]:
    """Return the states in which a solid that stands on nothing has a box or a cube under it, hidden by it or by
    others."""
    state, row = best.state, best.state.rows[i]
    if state.forms[i] != UPRIGHT or not np.isnan(state.bottoms[i]) or state.parents[i] != FLOOR:
        return []
    return on_hidden(best, i, row, state.cubes[i], shapes)


def raised(best: Refined, i: int, shapes: tuple[str, ...]) -> list[State]:
    """Return the states in which an upright box or can whose foot hides reaches less far down, a box as far as a cube
    would too, and stands on a box or a cube that nothing shows."""
    state, row = best.state, best.state.rows[i]
    lying = state.forms[i] != UPRIGHT or np.isnan(state.bottoms[i]) or int(row[0]) == SPHERE
    if lying or state.cubes[i] or state.parents[i] != FLOOR:
        return []
    least = highest(row) - lowest_shown(best, i)  # that it is high, or -inf: nothing shows
    if least <= 0.0:
        return []
    heights = [(0.5 * (least + row[15]), False)]
    if int(row[0]) == BOX and "cube" in shapes:
        heights.append((float(np.sqrt(row[13] * row[14])), True))
    states = []
    for tall, cube in heights:
        if least <= tall <= row[15] - LEAST_TALL:
            new = row.copy()
            new[12], new[15] = highest(row) - 0.5 * tall, tall
            new[13:15] = tall if cube else row[13:15]
            states += on_hidden(best, i, new, cube, shapes)
    return states


def lowest_shown(best: Refined, i: int) -> float:
    """Return how high over the floor the lowest point lies that an image shows of solid `i`."""
    low = np.inf
    for view in best.sensor.views:
        depth, label = model_image(best.chart, best.values, view.camera, view.into)
        shown = (label == i + 1) & (view.observed > 0.0)
        if shown.any():
            floor = view.into @ best.chart.floor
            low = min(low, float(((view.camera.points(depth)[shown] - floor[:3, 3]) @ floor[:3, 2]).min()))
    return low


def on_hidden(best: Refined, i: int, row: np.ndarray, cube: bool, shapes: tuple[str, ...]) -> list[State]:
    """Return the states in which solid `i`, as it is in a row, stands on a box or a cube as high as it is over the
    floor, below its middle or somewhat behind."""
    state, gap = best.state, lowest(row)
    if gap < LEAST_TALL:
        return []
    away = row[10:12] + (best.chart.floor[:3, :3].T @ best.chart.floor[:3, 3])[:2]  # from the camera
    behind = BEHIND * row[13:15].min() * away / max(float(np.linalg.norm(away)), 1e-9)
    turned = rotation_of(row) if int(row[0]) == BOX else np.eye(3)
    states = []
    for place in (row[10:12], row[10:12] + behind):
        for under_cube in (False, True):
            if ("cube" if under_cube else "box") in shapes:
                extents = [gap] * 3 if under_cube else [*(NARROWER * row[13:15]), gap]
                under = make_row(BOX, turned, [*place, 0.5 * gap], extents)
                with_it = state.add(under, UPRIGHT, under_cube, FLOOR, 0.0)
                states.append(with_it.changed(i, row=row, cube=cube, parent=len(state), bottom=gap))
    return states


def reached_down(best: Refined, i: int) -> list[State]:
    """Return the state in which a tilted box whose lower end may hide stands on the floor with it, as thick as it is;
    none where it does so already. What it rests on may hold what shows of it, too: the image and the forces tell."""
    state, row = best.state, best.state.rows[i]
    low, on_floor = lowest(row), state.parents[i] == FLOOR
    if int(row[0]) != BOX or state.forms[i] != FREE or (on_floor and low < REACH):
        return []
    up = rotation_of(row)[2]
    steep = np.where(np.arange(3) == np.argmin(row[13:16]), 0.0, np.abs(up))
    axis, new = int(np.argmax(steep)), row.copy()
    more = low / abs(up[axis])
    new[13 + axis] += more
    new[10:13] -= 0.5 * more * np.sign(up[axis]) * rotation_of(row)[:, axis]
    return [state.changed(i, row=new, cube=False, parent=FLOOR, bottom=np.nan)]


def is_held(state: State, i: int) -> bool:
    """Whether forces where solid `i` touches others can hold it, friction helping; the floor's where it is the parent:
    that both hold it is the structure on the floor."""
    rows = state.rows.copy()
    if state.parents[i] != FLOOR:
        rows[:, 12] += max(2.0 * REACH - lowest(rows[i]), 0.0)  # clear of the floor
    return bool(shares_of_load(rows, i, REACH))


def tipping_of(refined: Refined) -> float:
    """Return the nats that tilted solids cost which none of their contacts holds: they tip, as what stands may."""
    state = refined.state
    tilted = (k for k in range(len(state)) if state.forms[k] == FREE and int(state.rows[k][0]) != SPHERE)
    return refined.chart.tipping * sum(not is_held(state, k) for k in tilted)
