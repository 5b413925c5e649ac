"""Several depth images of one scene that stands still: their candidate structures, and one posterior of them all.

Each image is searched by itself. What was found in it is brought over the first one's floor, and joined to what the
others found: a solid that one view hides another shows. The joined states are candidates as those that a search meets:
brought to the mode, weighed and drawn from under the product of the images' likelihoods (`Sensor.views`).
"""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.search.greedy import Settings, total_energy
from derender.detection.search.observation import Observation
from derender.detection.solids.graph import matched_names, names_of, structure_key
from derender.detection.solids.image import SIZE
from derender.detection.solids.interpenetration import penetration
from derender.detection.solids.state import State
from derender.errors import DerenderError
from derender.render.blur import blur
from derender.results.fit import flat_noise, tolerance_of
from derender.results.posterior import StructurePosterior
from derender.scene.pose import inverse, rotation_z
from derender.structures.alignment import found_over, moved, with_poses_refined
from derender.structures.draws.refined import Refined, View, height, refine, view_of, with_sensor_refitted
from derender.structures.draws.sensor import Sensor, model_depth
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
    """Return (depth (H, W), Frames) with images from one place averaged, each about the first of its place.

    What a camera that stands still sees again tells no more than how noisy it is: errors that come again in each image,
    a sensor's bias, stay in the mean, and inference fits its noise to the mean's own residuals.

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
    """Return whether two images were taken by one camera from one place, to STILL pixels.

    Where nobody says where the camera stood, images that show the same everywhere were.
    """
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
        spread = 1.4826 * np.nanmedian(np.nanmedian(np.abs(depths - middle), axis=0))
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
    """What was found in one image.

    state : State over the floor of this image. seen : its Observation.
    into : (4, 4), the first camera's axes to this one's. found : whether that was found, not given.
    over : (4, 4), this floor's frame to the first one's: a turn and a shift along the floor.
    """

    state: State
    seen: Observation
    into: np.ndarray
    over: np.ndarray
    found: bool = False


def first_look(state: State, seen: Observation) -> Look:
    """Return the Look at the first image."""
    return Look(state, seen, np.eye(4), np.eye(4))


def look_from(first: Look, state: State, seen: Observation, frame: Frame, settings: Settings) -> Look:
    """Return the Look at another image from where its camera is said, or found, to have stood.

    Raises DerenderError : the two images show different floors, or nothing stands in both.
    """
    if frame.into is None:
        over = found_over(first, state, seen, settings, frame.name)
        return Look(state, seen, seen.floor.pose @ inverse(over) @ inverse(first.seen.floor.pose), over, True)
    over = inverse(first.seen.floor.pose) @ inverse(frame.into) @ seen.floor.pose
    tilt, apart = float(np.arccos(np.clip(over[2, 2], -1.0, 1.0))), float(over[2, 3])
    if tilt > SAME_FLOOR or abs(apart) > SAME_HEIGHT:
        what = f"its floor is {np.degrees(tilt):.0f} degrees and {100 * apart:.0f} cm off the first image's"
        remedy = "poses are camera to world, in metres, of one scene: camera axes x right, y down, z forward"
        raise DerenderError(what, frame.name, remedy)
    return Look(state, seen, frame.into, along_floor(over))


def along_floor(over: Any) -> Any:
    """Return the turn about z and the shift along the floor of a motion (4, 4) between two floors' frames."""
    level = rotation_z(float(np.arctan2(over[1, 0], over[0, 0])))
    level[:2, 3] = over[:2, 3]
    return level


def energy_of(looks: Sequence[Look], state: State, settings: Settings) -> float:
    """Return the search's energy of a State over the first floor, the sum over all images."""
    return sum(total_energy(look.seen.image, moved(state, inverse(look.over)), settings) for look in looks)


def joined(looks: Sequence[Look], settings: Settings) -> list[tuple[State, float]]:
    """Return (State over the first floor, energy) of what the images show together, the best first, each once.

    Each image's own state is completed by what the others found elsewhere; a solid that several have found is as that
    one has it by which all images are explained best.
    """
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
        for k, row in enumerate(other.rows):
            thin = row[SIZE:].min()
            if all(penetration(row, own) < ENTERED * min(thin, own[SIZE:].min()) for own in state.rows):
                state = state.add(row, other.forms[k], other.cubes[k], bottom=other.bottoms[k])
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
                k, trial = own.index(name), state.copy()
                trial.rows[k], trial.forms[k], trial.cubes[k] = other.rows[j], other.forms[j], other.cubes[j]
                trial.bottoms[k] = other.bottoms[j]
                trial = on_supports(trial)
                value = energy_of(looks, trial, settings)
                if value < energy:
                    state, energy = trial, value
        if energy == before:
            break
    return state, energy


def views_of(looks: Sequence[Look]) -> list[View]:
    """Return the Views by which all images are explained together."""
    return [view_of(look.seen)._replace(into=look.into) for look in looks]


def together_parts(
    rng: np.random.Generator, looks: Sequence[Look], settings: Settings, chains: int, draws: int, only_best: bool
) -> list[StructurePosterior]:
    """Return the parts of the posterior given all images, in the axes of the first camera."""
    views, floor = views_of(looks), looks[0].seen.floor.pose
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

    A sensor's slow bias, and what real solids are off their ideal shapes, come again in each image from about the same
    side. How much of it two images share is measured: the correlation r of their residuals at the same places of the
    scene's surface. Of V images each of which shares r with each other the mean is as sure as that of
    V / (1 + (V - 1) r) independent ones (the design effect of cluster samples: Kish, Survey Sampling, 1965). So image v
    counts with the exponent 1 / (1 + sum over the others of r): a hundred images that share all count as one.
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
    """Return (V, V) the correlation of the residuals of each two views of a Refined at the same places, 0 with itself.

    Those that chance alone may make are 0.
    """
    views = refined.sensor.views
    models = [model_depth(refined.chart, refined.values, view.camera, view.into) for view in views]
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
    noise = view.values["sigma"] + view.values.get("sigma_growth", 0.0) * smooth**2
    return np.clip((view.returned - smooth) / noise, -CLIPPED, CLIPPED)


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
