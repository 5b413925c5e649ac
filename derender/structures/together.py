"""Several depth images of one scene that stands still: their candidate structures, and one posterior of them all.

Each image is searched by itself, and what was found in it joined to what the others found over the first one's floor.
The joined states are candidates for the posterior under the product of the images' likelihoods (`Sensor.views`).
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.search.greedy import Settings, total_energy
from derender.detection.search.observation import Observation
from derender.detection.solids.graph import matched_names, names_of, structure_key
from derender.detection.solids.image import CENTRE, ROTATION, SIZE
from derender.detection.solids.interpenetration import highest, penetration
from derender.detection.solids.state import FLOOR, State
from derender.errors import DerenderError
from derender.render.blur import blur
from derender.render.likelihoods.pixelwise import noise_at
from derender.results.fit import TO_SIGMA, flat_noise, tolerance_of
from derender.results.posterior import StructurePosterior
from derender.scene.pose import inverse, rotation_z, twist_exp
from derender.scene.solids import BOX
from derender.structures.draws.chart import Chart
from derender.structures.draws.curvature import APART, weights
from derender.structures.draws.metropolis import engine_of, load
from derender.structures.draws.refined import Refined, height, refine, refined_at, view_of, with_sensor_refitted
from derender.structures.draws.sensor import Sensor
from derender.structures.graph_posterior import independent_parts
from derender.structures.options import Frame
from derender.structures.unions import on_supports

STILL = 0.1  # pixels by which what is seen may move between images that count as from one place
OUTLYING = 4.0  # robust standard deviations from the median of its images at which a pixel's depth is left out
RETURNS = 0.5  # share of the images in which a pixel has to have a depth
TOLERANCES = 2.0  # times what may be a depth's error (results/fit.py), beyond which two images differ at a pixel
SAME, DIFFERENT = 0.01, 0.1  # share of the pixels: with fewer it is one place, with more another scene


def averaged(
    depth: np.ndarray, camera: Camera, frames: Sequence[Frame], name: str = "the first image"
) -> tuple[np.ndarray, list[Frame]]:
    """Return (depth (H, W), Frames) with images from one place averaged, each about the first of its place: they tell
    no more than how noisy it is, and a sensor's bias stays in the mean.

    Raises DerenderError : images from one place do not show the same.
    """
    places = [[Frame(depth, camera, np.eye(4), name)]]
    for frame in frames:
        same = next((place for place in places if from_one_place(place[0], frame)), None)
        if same is None:
            places.append([frame])
            continue
        refuse_another_scene(same[0], frame)
        same.append(frame)
    first, *others = (mean_of(place) for place in places)
    return first.depth, others


def from_one_place(one: Frame, other: Frame) -> bool:
    """Return whether two images were taken by one camera from one place, to STILL pixels, as they say or else show."""
    camera = one.camera
    if one.depth.shape != other.depth.shape or abs(camera.fx - other.camera.fx) > 1e-6 * camera.fx:
        return False
    if one.into is None or other.into is None:
        return differing(one, other) < SAME
    apart = other.into @ np.linalg.inv(one.into)
    turn = np.linalg.norm(apart[:3, :3] - np.eye(3)) / np.sqrt(2.0)
    nearest = float(np.nanmin(np.where(one.depth > 0, one.depth, np.nan)))
    return bool(camera.fx * (turn + np.linalg.norm(apart[:3, 3]) / nearest) < STILL)


def differing(one: Frame, other: Frame) -> float:
    """Return the share of the pixels in which two images differ by more than noise and edges."""
    off = np.abs(other.depth - one.depth)
    both = np.isfinite(off)
    far = off > TOLERANCES * tolerance_of(one.depth, flat_noise(one.depth))
    return float(far[both].mean()) if both.any() else 1.0


def refuse_another_scene(one: Frame, other: Frame) -> None:
    """Raise a DerenderError where two images from one place differ by more than noise."""
    share = differing(one, other)
    if share > DIFFERENT:
        what = f"{share:.0%} of it differs from {one.name}, though the poses say that both are from one place"
        raise DerenderError(what, other.name, "--together is for one scene that stands still: check the poses")


def mean_of(frames: Sequence[Frame]) -> Frame:
    """Return the mean of images from one place, outliers left out; one image is itself."""
    if len(frames) == 1:
        return frames[0]
    depths = np.stack([np.where(frame.depth > 0, frame.depth, np.nan) for frame in frames])
    counted = np.isfinite(depths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of pixels that no image has
        middle = np.nanmedian(depths, axis=0)
        spread = TO_SIGMA * np.nanmedian(np.nanmedian(np.abs(depths - middle), axis=0))
        kept = np.where(np.abs(depths - middle) <= OUTLYING * spread, depths, np.nan)
        kept = np.where(np.isfinite(kept).any(axis=0), kept, middle)
        mean = np.nanmean(kept, axis=0)
    name = f"{frames[0].name} and {len(frames) - 1} more from there"
    return frames[0]._replace(name=name, depth=np.where(counted.mean(axis=0) >= RETURNS, mean, np.nan))


MOST_CANDIDATES = 3  # joined states that are brought to the mode
ENTERED = 0.2  # share of what is thinnest by which a solid of one view may enter another's and yet be another one
SAME_FLOOR, SAME_HEIGHT = np.radians(5.0), 0.03  # radians, metres between the floors of two views of one scene
ROUNDS = 2  # in which each solid is tried as another view has it


class Look(NamedTuple):
    """What was found in one image."""

    state: State  # State over the floor of this image
    seen: Observation  # its Observation
    into: np.ndarray = np.eye(4)  # (4, 4), the first camera's axes to this one's
    over: np.ndarray = np.eye(4)  # (4, 4), this floor's frame to the first one's: a turn and a shift along the floor
    found: bool = False  # whether that was found, not given
    refined: Refined | None = None  # the state's, where that is made already


def look_from(first: Look, state: State, seen: Observation, frame: Frame, settings: Settings) -> Look:
    """Return the Look at another image from where its camera is said, or found, to have stood.
    Raises DerenderError : the two images show different floors, or nothing stands in both."""
    if frame.into is None:
        over = found_over(first, state, seen, settings, frame.name)
        return Look(state, seen, seen.floor.pose @ inverse(over) @ inverse(first.seen.floor.pose), over, True)
    over = inverse(first.seen.floor.pose) @ inverse(frame.into) @ seen.floor.pose
    tilt, apart = float(np.arccos(np.clip(over[2, 2], -1.0, 1.0))), float(over[2, 3])
    if tilt > SAME_FLOOR or abs(apart) > SAME_HEIGHT:
        what = f"its floor is {np.degrees(tilt):.0f} degrees and {100 * apart:.0f} cm off the first image's"
        remedy = "poses are camera to world, in metres, of one scene: camera axes x right, y down, z forward"
        raise DerenderError(what, frame.name, remedy)
    level = rotation_z(float(np.arctan2(over[1, 0], over[0, 0])))
    level[:2, 3] = over[:2, 3]
    return Look(state, seen, frame.into, level)


def energy_of(looks: Sequence[Look], state: State, settings: Settings) -> float:
    """Return the search's energy of a State over the first floor, the sum over all images."""
    return sum(total_energy(look.seen.image, moved(state, inverse(look.over)), settings) for look in looks)


def joined(looks: Sequence[Look], settings: Settings) -> list[tuple[State, float]]:
    """Return (State over the first floor, energy) of what the images show together, the best first, each once: each
    image's own state completed by the others', a solid that several have found as that one has it which explains all
    best."""
    states = [moved(look.state, look.over) for look in looks]
    names = names_of(states[0])
    found: dict[tuple, tuple[State, float]] = {}
    for state in states:
        state = completed(state, states)
        state, energy = as_others_have_it(state, states, looks, settings)
        key = structure_key(state, matched_names(state, states[0], names))
        if key not in found or energy < found[key][1]:
            found[key] = state, energy
    return sorted(found.values(), key=lambda pair: pair[1])[:MOST_CANDIDATES]


def completed(state: State, states: list[State]) -> State:
    """Return a State with the solids of others that lie elsewhere than all of its own, each on what bears it."""
    for other in states:
        for solid in other:
            thin = solid.row[SIZE:].min()
            if all(penetration(solid.row, own) < ENTERED * min(thin, own[SIZE:].min()) for own in state.rows):
                state = state.add(*solid._replace(parent=FLOOR))
    return on_supports(state)


def as_others_have_it(state: State, states: list[State], looks: Any, settings: Settings) -> tuple[State, float]:
    """Return (State, energy) with each solid as that state has it by which all images are explained best."""
    energy = energy_of(looks, state, settings)
    own = [str(k) for k in range(len(state))]
    others = [(other, matched_names(other, state, own)) for other in states]
    for _ in range(ROUNDS):
        before = energy
        for other, names in others:
            for j, name in enumerate(names):
                if name not in own:
                    continue
                trial = on_supports(state.swapped(own.index(name), other[j]))
                value = energy_of(looks, trial, settings)
                if value < energy:
                    state, energy = trial, value
        if energy == before:
            break
    return state, energy


def together_parts(
    rng: np.random.Generator, looks: Sequence[Look], settings: Settings, chains: int, draws: int, only_best: bool
) -> list[StructurePosterior]:
    """Return the parts of the posterior given all images, in the axes of the first camera."""
    views, floor = [view_of(look.seen)._replace(into=look.into) for look in looks], looks[0].seen.floor.pose
    candidates = joined(looks, settings)
    refined = [refine(rng, views, floor, state, settings.rules, settings.tries) for state, _ in candidates]
    first = with_poses_refined(rng, max(refined, key=height), [look.found for look in looks])
    first = with_shared_errors(rng, first)
    energy = min(energy for _, energy in candidates)
    pool = [(each.state, energy) for each in refined]
    return independent_parts(rng, first, energy, pool, settings, chains, draws, only_best)


SAME_SURFACE = 0.01  # share of the depth within which a point seen in one image is the one seen in another
FEWEST = 50  # places that both see, fewer of which tell nothing
SURE = 3.0  # standard deviations of a correlation, 1 / sqrt(places), below which it is none
CLIPPED = 3.0  # standard deviations at which residuals are cut off: edges and outliers would outweigh all others


def with_shared_errors(rng: np.random.Generator, refined: Refined) -> Refined:
    """Return the Refined whose views count for as much as they tell beside the others, at its mode again.

    A sensor's bias, and what solids are off their ideal shapes, come again in each image. Of V images whose residuals
    at the same places correlate by r the mean is as sure as that of V / (1 + (V - 1) r) independent ones (the design
    effect of cluster samples: Kish, Survey Sampling, 1965): each counts with the exponent 1 / (1 + sum over the others
    of r).
    """
    views = refined.sensor.views
    if len(views) == 1 or any(view.likelihood.name != "correlated" for view in views):
        return refined
    shares = 1.0 / (1.0 + shared(refined).sum(axis=1))
    if np.all(shares == 1.0):
        return refined
    worth_less = [view.changed(shared=1.0 - share * (1.0 - view.values["shared"]))
                  for view, share in zip(views, shares, strict=True)]  # fmt: skip
    sensor = worth_less[0]._replace(others=tuple(worth_less[1:]))
    return with_sensor_refitted(rng, refined._replace(sensor=sensor))


def shared(refined: Refined) -> np.ndarray:
    """Return (V, V) the correlation of the residuals of each two views of a Refined at the same places, 0 with itself,
    and where chance alone may make it."""
    views = refined.sensor.views
    models = [view.clean(refined.chart, refined.values) for view in views]
    residuals = [residual_of(view, model) for view, model in zip(views, models, strict=True)]
    found = np.zeros((len(views), len(views)))
    for a in range(len(views)):
        for b in range(a):
            found[a, b] = found[b, a] = correlation(
                views[a], views[b], models[a], models[b], residuals[a], residuals[b]
            )
    return found


def residual_of(view: Sensor, model: np.ndarray) -> np.ndarray:
    """Return (H, W) the residuals of a view in standard deviations of its noise, cut off, NaN where it says nothing."""
    smooth = blur(model, view.values["blur"])
    return np.clip((view.returned - smooth) / noise_at(smooth, view.values), -CLIPPED, CLIPPED)


def correlation(
    one: Sensor,
    other: Sensor,
    model: np.ndarray,
    other_model: np.ndarray,
    residual: np.ndarray,
    other_residual: np.ndarray,
) -> float:
    """Return the correlation of two views' residuals (H, W) at places that both see, given their models' depths."""
    camera, to = one.camera, other.camera
    rows, columns = np.nonzero(np.isfinite(residual))
    z = model[rows, columns]
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z, np.ones_like(z)])
    x, y, depth, _ = other.into @ np.linalg.inv(one.into) @ points
    ahead = depth > 0.0
    deep = np.where(ahead, depth, 1.0)
    u, v = np.rint(x / deep * to.fx + to.cx).astype(int), np.rint(y / deep * to.fy + to.cy).astype(int)
    inside = ahead & (u >= 0) & (u < to.width) & (v >= 0) & (v < to.height)
    rows, columns, u, v, depth = rows[inside], columns[inside], u[inside], v[inside], depth[inside]
    same = (np.abs(other_model[v, u] - depth) < SAME_SURFACE * depth) & np.isfinite(other_residual[v, u])
    if same.sum() < FEWEST:
        return 0.0
    here, there = residual[rows[same], columns[same]], other_residual[v[same], u[same]]
    norm = np.sqrt(np.mean(here**2) * np.mean(there**2))
    found = float(np.mean(here * there) / norm) if norm > 0.0 else 0.0
    return min(found, 1.0) if found > SURE / np.sqrt(same.sum()) else 0.0


SAME_TOP, SAME_PLACE = 0.015, 0.04  # metres between tops, and between centres, of what may be one solid in two images
MOST_TRIED, MOST_IMPROVED = 12, 3  # motions whose energy is looked at, and improved
STEPS = tuple(0.02 * 0.5**k for k in range(9))  # metres, and 5 times as many radians, of the improvement
EXPLAINS = 0.5  # share of what an image's own solids explain of it that those of the other must explain as well
POSE_STEPS = 8  # of Gauss-Newton
FAR_OFF = 4.0  # standard deviations beyond which a residual is an outlier
WORTH_MOVING = 20.0  # nats by which a pose that was given must be bettered to be changed
POSE_ROUNDS = 2  # in which scene and poses are improved in turn


def found_over(first: "Look", state: State, seen: Observation, settings: Settings, name: str) -> np.ndarray:
    """Return (4, 4), an image's floor frame to the first one's, such that each shows what was found in the other.
    Raises DerenderError : nothing stands in both images; `name` is the image's."""

    def energy(over):
        there = total_energy(seen.image, moved(first.state, inverse(over)), settings)
        return there + total_energy(first.seen.image, moved(state, over), settings)

    tried = sorted(motions(first.state, state), key=lambda over: -matching(first.state, state, over))[:MOST_TRIED]
    ranked = sorted(((energy(over), k, over) for k, over in enumerate(tried)), key=lambda each: each[:2])
    found = [improved(energy, over, value) for value, _, over in ranked[:MOST_IMPROVED]]
    value, over = min(found, key=lambda each: each[0], default=(np.inf, np.eye(4)))
    own = total_energy(seen.image, state, settings) + total_energy(first.seen.image, first.state, settings)
    bare = total_energy(seen.image, State(), settings) + total_energy(first.seen.image, State(), settings)
    if not value < bare - EXPLAINS * (bare - own):
        what = "what stands in it cannot be brought onto what stands in the first image"
        raise DerenderError(what, name, "give frames of one scene that stands still, or the cameras' --poses")
    return over


def moved(state: State, over: np.ndarray) -> State:
    """Return a State moved along the floor: over (4, 4), a turn about z and a shift."""
    state = state.copy()
    turns = state.rows[:, ROTATION:CENTRE].reshape(-1, 3, 3)
    state.rows[:, ROTATION:CENTRE] = (over[:3, :3] @ turns).reshape(-1, 9)
    state.rows[:, CENTRE:SIZE] = state.rows[:, CENTRE:SIZE] @ over[:3, :3].T + over[:3, 3]
    return state


def motions(first: State, state: State) -> Iterator[np.ndarray]:
    """Yield motions (4, 4) along the floor that bring a solid of one state onto one of the first."""
    pairs = [(i, j) for i in range(len(first)) for j in range(len(state))
             if abs(highest(first.rows[i]) - highest(state.rows[j])) < SAME_TOP]  # fmt: skip
    for i, j in pairs:
        if int(first.rows[i][0]) == int(state.rows[j][0]) == BOX:
            turn = heading(first.rows[i]) - heading(state.rows[j])
            for quarter in range(4):
                yield onto(first.rows[i], state.rows[j], turn + 0.5 * np.pi * quarter)
        for k, m in pairs:
            if k > i and m != j:
                here, there = (rows[b][CENTRE : CENTRE + 2] - rows[a][CENTRE : CENTRE + 2]
                               for rows, a, b in ((first.rows, i, k), (state.rows, j, m)))  # fmt: skip
                if abs(np.hypot(*here) - np.hypot(*there)) < SAME_PLACE:
                    yield onto(
                        first.rows[i], state.rows[j], np.arctan2(here[1], here[0]) - np.arctan2(there[1], there[0])
                    )
        if len(first) == len(state) == 1:  # round solids alone may be turned as one likes
            yield onto(first.rows[i], state.rows[j], 0.0)


def heading(row: np.ndarray) -> float:
    """Return the angle in which a box's first level edge points."""
    turn = row[1:10].reshape(3, 3)
    axis = int(np.argmin(np.abs(turn[2])))
    return float(np.arctan2(turn[1, axis], turn[0, axis]))


def onto(row: np.ndarray, other: np.ndarray, turn: float) -> np.ndarray:
    """Return the motion (4, 4) along the floor with this turn that brings another solid's centre over one's."""
    over = rotation_z(turn)
    over[:2, 3] = row[CENTRE : CENTRE + 2] - over[:2, :2] @ other[CENTRE : CENTRE + 2]
    return over


def matching(first: State, state: State, over: np.ndarray) -> float:
    """Return how many solids a motion brings onto those of the first state, the nearer the better."""
    total = 0.0
    for row in moved(state, over).rows:
        near = [float(np.linalg.norm(row[CENTRE : CENTRE + 2] - other[CENTRE : CENTRE + 2])) for other in first.rows
                if abs(highest(row) - highest(other)) < SAME_TOP and row[0] == other[0]]  # fmt: skip
        total += max(1.0 - min(near, default=SAME_PLACE) / SAME_PLACE, 0.0)
    return total


def improved(energy: Callable[..., Any], over: np.ndarray, value: float) -> tuple[float, np.ndarray]:
    """Return (energy, motion) after steps along and about the floor that lower it."""
    for step in STEPS:
        going = True
        while going:
            going = False
            for x, y, turn in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
                trial = over.copy()
                trial[:2, 3] += step * x, step * y
                trial[:3, :3] = trial[:3, :3] @ rotation_z(5.0 * step * turn)[:3, :3]
                new = energy(trial)
                if new < value:
                    value, over, going = new, trial, True
    return value, over


def with_poses_refined(rng: np.random.Generator, refined: Refined, found: list[bool]) -> Refined:
    """Return the Refined with the further views' poses as the depths tell them, and the scene at its mode again.
    found : (V,) bool, which views' poses were found, not given: those given move only where that explains much more."""
    for _ in range(POSE_ROUNDS):
        first, *others = refined.sensor.views
        better = [view_moved(refined, view, 0.0 if free else WORTH_MOVING)
                  for view, free in zip(others, found[1:], strict=True)]  # fmt: skip
        if all(view is new for view, new in zip(others, better, strict=True)):
            break
        sensor = first._replace(others=tuple(better))
        _, log_likelihood = load(engine_of(refined.chart, sensor), refined.chart, refined.values)
        refined = refined_at(refined.state, refined.chart, refined.values, sensor, refined.log_prior, log_likelihood)
        refined = with_sensor_refitted(rng, refined)
    return refined


def view_moved(refined: Refined, view: Sensor, least: float) -> Sensor:
    """Return a view with its camera where its depths explain most, the scene held; itself where not `least` nats are
    gained."""
    chart, values = refined.chart, refined.values

    def density(view):
        return load(engine_of(chart, view), chart, values)[1]

    began = height = density(view)
    best = view
    for _ in range(POSE_STEPS):
        trial = best._replace(into=twist_exp(*pose_step(chart, values, best)) @ best.into)
        new = density(trial)
        if new <= height:
            break
        best, height = trial, new
    return best if height > began + least else view


def pose_step(chart: Chart, values: np.ndarray, view: Sensor) -> list[np.ndarray]:
    """Return (v, w) of a Gauss-Newton step of a view's camera, metres and radians in its axes."""
    camera, smooth = view.camera, view.values["blur"]
    base = view.clean(chart, values)
    shown = blur(base, smooth)
    residual = np.nan_to_num(view.returned - shown)
    weight = weights(view, shown)
    weight = np.where(residual**2 * weight < FAR_OFF**2, weight, 0.0)
    turn = APART / camera.fx
    steps = np.array([turn * float(np.median(base))] * 3 + [turn] * 3)
    images = []
    for k, step in enumerate(steps):
        ahead, behind = (
            blur(
                view._replace(into=twist_exp(*np.split(way * step * np.eye(6)[k], 2)) @ view.into).clean(chart, values),
                smooth,
            )
            for way in (1.0, -1.0)
        )
        images.append(((ahead - behind) / (2.0 * step)).ravel())
    jacobian = np.array(images)
    normal = (jacobian * weight.ravel()) @ jacobian.T
    slope = (jacobian * weight.ravel()) @ residual.ravel()
    return np.split(np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(6), slope), 2)
