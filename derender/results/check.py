"""A posterior predictive check by region: what speaks against the scene that was found, in sentences that say where.

A likelihood compares explanations with each other; this compares the best of them with the image itself. Each check
returns doubts; `check_fit` asks them all. What kind of numbers the image holds, the largest plane tells: on a plane one
function of them is affine in the pixel's place, of depth z along the axis 1 / z, of distance r along the rays |ray| / r
with the ray's unit along the axis, of disparity the number itself. Whether the camera is right see `focal_length`.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from derender.camera.intrinsics import LEVEL, Camera
from derender.camera.windows import greatest, labelled, least, opened
from derender.render.likelihoods.pixelwise import noise_at
from derender.results.fit import Fit, Noise, on_best_plane, sensor_deviation
from derender.results.focal_length import FLOOR, faces_of, wrong_camera
from derender.results.trust import LETTERS, MAY_EXIST, Doubt, Region
from derender.scene.graph import SceneGraph
from derender.scene.polygon import beyond_edges, convex_outline

LOOKED_AT = 1000  # pixels, about, evenly spread
TRIES = 150  # planes through three pixels each, of each kind: one with half of the pixels is missed never
NEAR, DEVIATIONS = 0.006, 3.0  # share of the distance that a plane may be off, or so many deviations of the noise
CLEARLY, MORE = 1.2, 0.08  # times as many pixels on the plane of another kind, and by how much of all, at least
AT_ONE = 0.01  # share of the numbers that are a buffer's background, or cut off at 1 m
# Metres that 16 bits of millimetres hold, and that depth cameras see: what is seen between the two is inverted.
WHOLE_RANGE, MOST_REACH = 65.535, 15.0
REMEDIES = {
    "range": "distances along the rays (range), not depth along the axis: convert them by z = r / |ray|",
    "buffer": "in a depth buffer of OpenGL: convert them by z = far near / (far - (far - near) number)",
    "inverted": "of depths that were taken from 65535: convert them back by z = 65535 - number",
    "disparity": "disparities, not depths: convert them by z = focal length * baseline / disparity",
}


def wrong_kind(observed: np.ndarray, camera: Camera, noise: Noise) -> list[Doubt]:
    """Return a doubt where another kind of numbers has far more of the image (H, W) on one plane than depth has."""
    known = observed[np.isfinite(observed)]
    if known.max(initial=0.0) == 1.0 and np.mean(known == 1.0) > AT_ONE:
        return [Doubt("the numbers end in exactly 1 where nothing is near, as " + REMEDIES["buffer"])]
    middle = float(np.median(known)) if len(known) else 0.0
    if known.max(initial=0.0) <= WHOLE_RANGE and WHOLE_RANGE - MOST_REACH < middle:
        return [Doubt(f"the numbers lie about {middle:.3g} m away, as {REMEDIES['inverted']}")]
    shares = plane_shares(observed, camera, noise)
    best = max(shares, key=lambda kind: shares[kind])
    if best == "depth" or shares[best] < max(CLEARLY * shares["depth"], shares["depth"] + MORE):
        return []
    as_depth, as_other = round(100 * shares["depth"]), round(100 * shares[best])
    words = f"the numbers look like {REMEDIES[best]}"
    return [Doubt(f"{words} (so {as_other} % of them lie on one plane, {as_depth} % as they are)")]


def plane_shares(observed: np.ndarray, camera: Camera, noise: Noise) -> dict[str, float]:
    """Return which share of the pixels with a number lies on the largest plane, by what the numbers might be."""
    rows, columns = np.nonzero(np.isfinite(observed) & (observed > 0))
    if len(rows) < 100:
        return {"depth": 1.0}
    step = max(1, len(rows) // LOOKED_AT)
    rows, columns = rows[::step], columns[::step]
    values = observed[rows, columns]
    across, down = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    ray = np.sqrt(1.0 + across**2 + down**2)
    limit = np.maximum(NEAR, DEVIATIONS * noise.at(values) / values)
    rng = np.random.default_rng(0)  # which planes are tried says nothing of the answer
    triples = rng.integers(0, len(values), (TRIES, 3))
    design = np.column_stack([np.ones(len(values)), across, down])
    kinds = {"depth": 1.0 / values, "range": ray / values, "disparity": values}
    return {kind: _largest(design, numbers, limit, triples) for kind, numbers in kinds.items()}


def _largest(design: np.ndarray, numbers: np.ndarray, limit: np.ndarray, triples: np.ndarray) -> float:
    """Return the share of pixels within the limit, relative to the number, of the best affine function tried."""
    allowed = limit * np.abs(numbers)
    best = on_best_plane(design, numbers, allowed, triples, 1e-4)
    if best is None:
        return 0.0
    plane = np.linalg.lstsq(design[best], numbers[best])[0]  # through all of them it fits more
    return float(max(best.mean(), (np.abs(design @ plane - numbers) <= allowed).mean()))


# Unexplained regions.  What is nowhere as wide as a few pixels is a silhouette's fault.
THIN = 320  # columns of the image for each pixel that a thing may be thin and yet count
BESIDE = 160  # columns for each pixel by which what a region touches may be off it, two at least: silhouettes are
LEAST_SHARE = 0.001  # of the valid pixels that a region must have to be told
MOST_IN_ALL = 0.04  # share of the valid pixels that may be unexplained
MOST_IN_ONE = 0.01  # and of one region alone: a thing that was missed
MOSTLY = 0.5  # share of a region's pixels from which on they tell what it is
MOST_TOLD = 3  # regions
# What is taken as it is seen explains nothing.
SOME_BACKGROUND, MOST_OVER = 0.05, 0.04  # shares of the valid pixels: it counts; a region over the floor is too much
RIM = 0.03  # metres within the outline of the floor that is seen: there the walls of a bin stand
# A floor that is none: the least share of what shows no solid (of a bin with its walls .4, of a desk in a room .3).
LEAST_FLOOR = 0.2
# The same of one that lies as walls do: the sine of its normal's turn about the optical axis, as it is of a phone that
# is held in portrait; or looked at straight on (cosine) from so many metres or more: few cameras hang so high.
LEAST_AS_WALL, SIDEWAYS, FACED, OVERHEAD = 0.6, 0.6, 0.95, 1.5
# Solids that the image does not bear out.
# Share of a solid's pixels without return; times the share elsewhere; and the share from which on it is told, but where
# as few return elsewhere.
MOST_MISSING, MORE_MISSING, NEARLY_ALL = 0.5, 2.0, 0.9
LEAST_FITTING = 0.7  # share of a solid's pixels with a depth that it explains
MOST_OPEN = (
    0.08  # share of them that one region may show something else: an arch's opening, or something missed before it
)
FEW_PIXELS = 12  # of a solid say nothing of it as a whole
FILLING = 0.5  # share of the image that one solid may fill
CUT = 0.1  # share of a solid's outline that lies on the image's border, to be told
ALONE, SEEN, NO_THING = 0.97, 0.9, 1.0  # share of the depths on one plane, of the pixels with one; metres it is wide
ROUNDING = 1e-4  # share of one depth, by which numbers of single precision or of millimetres differ
NOISY = 4.0  # times the noise of flat patches, from which on a fitted noise hides something


def check_fit(
    graph: SceneGraph,
    fit: Fit,
    camera: Camera,
    observed: np.ndarray,
    likelihood: Mapping[str, Any],
    spots: Sequence[Sequence[float]] = (),
    given: bool = False,
    clutter: Sequence[Sequence[float]] = (),
) -> tuple[Doubt, ...]:
    """Return the doubts that an image raises about what was found in it, the serious ones first.

    graph : the best scene. fit : of it. camera : of the image.
    observed : (H, W) metres, NaN where nothing returned.
    likelihood : numbers of the likelihood that was fitted, by name.
    spots : where the scene explains less than noise leaves: first and last row and column, as shares of the image.
    given : whether a real sensor took it, going by its noise, and a person said with which focal length.
    clutter : of what is not told, for it is likelier clutter than an object, the probability that it is one, and
        where it is, as in `spots`.
    """
    valid = np.isfinite(observed)
    if not valid.any():
        return ()
    # Without a floor, as someone may ask for, what stands on it is cut into boxes whose angles tell nothing.
    floors = [vertex for vertex in graph.vertices if vertex.body.size() is None]
    doubts = [
        *beside(graph, fit, unexplained(fit, valid, observed)),
        *beside(graph, fit, off_by_more_than_noise(spots, fit, valid)),
        *may_be_objects(clutter, valid),
        *beside(graph, fit, background_over_floor(graph, fit, camera, observed)),
        *no_floor(graph, fit, valid),
        *not_level(graph, camera),
        *too_noisy(fit, observed, likelihood),
        *wrong_kind(observed, camera, fit.noise),
        *(wrong_camera(faces_of(graph, fit, camera, observed), camera, given) if floors else []),
        *unborne_solids(graph, fit, valid),
        *nothing_but_a_plane(graph, fit, camera, observed),
    ]
    return tuple(sorted(doubts, key=lambda doubt: not doubt.serious))


def beside(graph: SceneGraph, fit: Fit, doubts: list[Doubt]) -> list[Doubt]:
    """Return doubts about regions with the objects that these touch, in doubt where it is serious: what lies elsewhere
    may be missed, or clutter, and says nothing of these."""
    told = []
    for doubt in doubts:
        mask = np.any([region.mask for region in doubt.regions], axis=0) & doubt.serious
        touched = np.unique(fit.label[greatest(mask, max(2, mask.shape[1] // BESIDE))])
        told.append(doubt._replace(about={graph.names[k - 1] for k in touched if k > 0}))
    return told


def unexplained(fit: Fit, valid: np.ndarray, observed: np.ndarray) -> list[Doubt]:
    """Return a doubt about coherent regions that neither solids nor floor nor background explain.

    What lies behind the floor, as where a table's rim bends down, is no thing on it that was missed.
    """
    left = valid & ~fit.explained & ~fit.background
    found = coherent(left, valid)
    if not found:
        return []
    total = float(left.sum() / valid.sum())
    words = ", ".join(f"region {region.name} {region.where}" for region in found[:MOST_TOLD])
    more = f" and {len(found) - MOST_TOLD} more" if len(found) > MOST_TOLD else ""
    below = (fit.label == FLOOR) & (observed > fit.predicted)
    serious = total > MOST_IN_ALL or any(
        region.share > MOST_IN_ONE and below[region.mask].mean() < MOSTLY for region in found
    )
    return [Doubt(f"{percent(total)} of the image is not explained: {words}{more}", serious, found)]


def off_by_more_than_noise(spots: Sequence[Sequence[float]], fit: Fit, valid: np.ndarray) -> list[Doubt]:
    """Return a doubt about windows of pixels, but of background, that are off the scene by more than noise brings any.

    (Of 107 answers to images of white noise 15 had such: 13 of these were wrong, of the other 92 nine.)
    """
    regions = [region for region in windows(spots, valid) if fit.background[region.mask].mean() < MOSTLY]
    where = " and ".join(dict.fromkeys(region.where for region in regions))
    words = f"what is seen {where} is not where this scene has it, by more than its noise"
    return [Doubt(words, True, tuple(regions))] if regions else []


def may_be_objects(clutter: Sequence[Sequence[float]], valid: np.ndarray) -> list[Doubt]:
    """Return doubts about what is not told though it may as well be an object: worth knowing, unless `chain_doubts`
    expects too many."""
    likely = [(probability, place) for probability, *place in clutter if probability > MAY_EXIST]
    regions = windows([place for _, place in likely], valid)
    words = "what is seen {} is an object with a probability of {:.2f}, and is not told"
    return [Doubt(words.format(region.where, probability), False, (region,), about=())
            for (probability, _), region in zip(likely, regions, strict=False)]  # fmt: skip


def windows(places: Sequence[Sequence[float]], valid: np.ndarray) -> list[Region]:
    """Return the Regions between first and last rows and columns, as shares of the image; valid : (H, W) bool."""
    regions = []
    for letter, place in zip(LETTERS, places, strict=False):
        top, bottom, left, right = np.round(np.multiply(place, np.repeat(valid.shape, 2))).astype(int)
        mask = np.zeros(valid.shape, bool)
        mask[top:bottom, left:right] = True
        regions.append(Region(letter, mask, float(mask[valid].mean())))
    return regions


def coherent(mask: np.ndarray, valid: np.ndarray) -> tuple[Region, ...]:
    """Return the Regions of a mask (H, W), the largest first, without what is thin or small; valid : (H, W) bool."""
    label, count = labelled(opened(mask, max(1, round(mask.shape[1] / THIN))))
    sizes = np.bincount(label.ravel(), minlength=count + 1)[1:] / valid.sum()
    order = [k for k in np.argsort(-sizes, kind="stable") if sizes[k] >= LEAST_SHARE]
    return tuple(Region(name, label == k + 1, float(sizes[k])) for name, k in zip(cycle(LETTERS), order, strict=False))


def background_over_floor(graph: SceneGraph, fit: Fit, camera: Camera, observed: np.ndarray) -> list[Doubt]:
    """Return a doubt about coherent regions over the visible floor that are taken as background: what stands there is
    not told. What lies beyond it, the room behind a table, says nothing of what is on it; nor do furniture and walls
    that the image cuts off, where anything is told."""
    if not fit.background.any():
        return []
    valid, poses = np.isfinite(observed), graph.poses()
    points, over = camera.points(observed), np.zeros(observed.shape, bool)
    for pose in (poses[vertex.name] for vertex in graph.vertices if vertex.body.size() is None):
        shown = coherent(valid & fit.explained & (fit.label == 0), valid)
        above = fit.background & ((points - pose[:3, 3]) @ pose[:3, 2] > fit.tolerance)
        corners = convex_outline((points[shown[0].mask] - pose[:3, 3]) @ pose[:3, :2]) if shown else None
        if corners is not None:
            over[above] |= beyond_edges((points[above] - pose[:3, 3]) @ pose[:3, :2], corners) < -RIM
    regions = tuple(region for region in coherent(over, valid) if region.share > MOST_OVER)
    words = ", ".join(f"{percent(region.share)} of the image {region.where}" for region in regions)
    told = any(vertex.body.size() is not None for vertex in graph.vertices)
    serious = not told or not all(at_border(region.mask, valid) for region in regions)
    return [Doubt(f"what stands over the floor is taken as background: {words}", serious, regions)] if regions else []


def at_border(mask: np.ndarray, valid: np.ndarray) -> bool:
    """Return whether a region (H, W) reaches the border of what the image shows; valid : (H, W) bool."""
    wide = round(mask.shape[1] / THIN)  # what opening it took off
    for seen, own in ((valid.any(axis=k), np.flatnonzero(mask.any(axis=k))) for k in (0, 1)):
        first, last = np.flatnonzero(seen)[[0, -1]]
        if own[0] <= first + wide or own[-1] >= last - wide:
            return True
    return False


def no_floor(graph: SceneGraph, fit: Fit, valid: np.ndarray) -> list[Doubt]:
    """Return doubts about whether the floor is one: it explains little beside the background, or may be a wall."""
    poses, doubts = graph.poses(), []
    planes = [poses[vertex.name] for vertex in graph.vertices if vertex.body.size() is None]
    floor = float((valid & fit.explained & (fit.label == 0)).sum())
    share = floor / max(floor + float(fit.background.sum()), 1.0)
    if planes and fit.background.any() and share < LEAST_FLOOR:
        words = f"the floor explains {percent(floor / valid.sum())} of the image only, less than the background"
        doubts.append(Doubt(words))
    faced = [-p[2, 2] > FACED and abs(p[:3, 2] @ p[:3, 3]) > OVERHEAD for p in planes]
    sideways = any(abs(pose[0, 2]) > SIDEWAYS for pose in planes)
    little, may = share < LEAST_AS_WALL, "it may be a wall, see --up"
    if little and any(faced):
        doubts.append(Doubt(f"what was taken as the floor is looked at straight on from afar: {may}"))
    elif sideways:
        doubts.append(Doubt(f"what was taken as the floor faces sideways in the image: {may}", little))
    return doubts


def not_level(graph: SceneGraph, camera: Camera) -> list[Doubt]:
    """Return a doubt where no plane of the scene is level, going by the gravity that the camera has."""
    poses = graph.poses()
    normals = [poses[vertex.name][:3, 2] for vertex in graph.vertices if vertex.body.size() is None]
    if camera.gravity is None or not normals:
        return []
    upright = max(float(-normal @ np.asarray(camera.gravity)) for normal in normals)
    if upright > LEVEL:
        return []
    words = f"the floor leans by {math.degrees(math.acos(max(upright, -1.0))):.0f} degrees against the way up"
    return [Doubt(f"{words} that --up or the camera file says: one of them is wrong")]


def too_noisy(fit: Fit, observed: np.ndarray, likelihood: Mapping[str, Any]) -> list[Doubt]:
    """Return a doubt where the noise that was fitted is far above what flat patches of the image show.

    Where much is background it says nothing: it was fitted about solids and floor alone. Nor where so many pixels are
    missing that no patch is whole.
    """
    if not fit.noise.sigma or float(fit.background[np.isfinite(observed)].mean()) > SOME_BACKGROUND:
        return []
    middle = float(np.nanmedian(observed))
    fitted = float(noise_at(middle, {"sigma": 0.0, **likelihood}))
    usual = sensor_deviation(middle)
    if fitted <= NOISY * max(fit.noise.sigma, usual):
        return []
    told, shown = (f"{float(f'{1000 * sigma:.2g}'):g} mm" for sigma in (fitted, fit.noise.sigma))  # no "1e+02 mm"
    words = f"a noise of {told} was fitted where flat patches show {shown}"
    return [Doubt(f"{words}: it hides what is not explained")]


def unborne_solids(graph: SceneGraph, fit: Fit, valid: np.ndarray) -> list[Doubt]:
    """Return doubts about solids that are predicted where nothing returned, or something else is seen, that fill the
    image, or that its border cuts: of those that are predicted to show in FEW_PIXELS or more."""
    doubts = []
    elsewhere = float((~valid)[fit.label == 0].mean()) if (fit.label == 0).any() else 0.0
    for place, name in enumerate(graph.names, start=1):
        mask = fit.label == place
        if mask.sum() < FEW_PIXELS:
            continue
        region = Region(name, mask, mask.sum() / valid.sum())
        missing, filled = float((~valid)[mask].mean()), float(mask.mean())
        fitting = float(fit.explained[mask & valid].mean()) if missing < 1.0 else 1.0
        outline = int((mask & ~least(mask, 1)).sum())
        cut = int(mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum())
        share_cut = cut / max(outline + cut, 1)
        told = []
        most = max(NEARLY_ALL, 0.5 * (1.0 + elsewhere))  # half as many return as elsewhere
        if missing > max(MOST_MISSING, min(MORE_MISSING * elsewhere, most)):
            told.append((f"nothing returned from {percent(missing)} of {name}, {region.where}", True))
        elif fitting < LEAST_FITTING:
            words = f"{name} explains {percent(fitting)} of what is seen where it should be, {region.where}"
            told.append((words, True))
        elif openings := [each for each in coherent(mask & valid & ~fit.explained, mask) if each.share > MOST_OPEN]:
            words = f"{percent(openings[0].share)} of what is seen where {name} should be is something else"
            told.append((f"{words}, {region.where}", True))
        if filled > FILLING:
            told.append((f"{name} fills {percent(filled)} of the image, so that little shows what it stands on", True))
        elif share_cut > CUT:
            told.append((f"{name} is cut by the image's border: how big it is beyond is a guess", False))
        doubts += [Doubt(words, serious, (region,), (name,)) for words, serious in told]
    return doubts


def nothing_but_a_plane(graph: SceneGraph, fit: Fit, camera: Camera, observed: np.ndarray) -> list[Doubt]:
    """Return a doubt where one surface fills the view, no wider than a thing may be: a box's side would look so too; or
    where a floor with nothing on it is one depth, farther than cameras hang: a sensor that clips shows such."""
    valid = np.isfinite(observed)
    if any(vertex.body.size() is not None for vertex in graph.vertices):
        return []
    floor = observed[valid & fit.explained & ~fit.background & (fit.label == FLOOR)]
    deep = float(np.median(floor)) if len(floor) else 0.0
    if deep > OVERHEAD and float(np.median(np.abs(floor - deep))) <= max(fit.noise.sigma, ROUNDING * deep):
        words = f"the floor is one depth of {deep:.3g} m: a sensor that clips what is farther would show the same"
        return [Doubt(words)]
    wide = float(np.linalg.norm(np.ptp(camera.points(observed)[valid], axis=0)))
    if wide > NO_THING or float(fit.explained[valid].mean()) < ALONE or float(valid.mean()) < SEEN:
        return []
    return [Doubt(f"nothing is seen but one surface of {wide:.2g} m: a thing that fills the view would look the same")]


def percent(share: float) -> str:
    """Return a share in words: never 0 % of what there is."""
    return f"{100 * share:.0f} %" if share >= 0.01 else f"{100 * share:.1f} %"
