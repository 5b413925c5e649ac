"""From the search's best state to draws under the likelihood that the image itself suggests: the sensor's noise, blur
and outliers are fitted (sensor.py), the state is brought to the mode by an annealed walk, and drawn from
(metropolis.py)."""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import grown
from derender.compilation.threads import THREADS, in_threads
from derender.detection.floor import floor_depth
from derender.detection.search.observation import CORRELATED, of_whole_image
from derender.detection.solids.beliefs import Rules, bare_image, log_prior_of, sensor_beliefs
from derender.detection.solids.graph import names_of, scene_graph
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.misfit import AS_SEEN
from derender.detection.solids.state import State
from derender.results.posterior import StructurePosterior
from derender.results.trust import doubtful
from derender.sampling.diagnostics import r_hat_and_ess, unwrap
from derender.sampling.evidence import Evidence, draw_t, fit, log_t
from derender.structures.draws.chart import Chart, make_chart, placed, rows_at
from derender.structures.draws.curvature import Curvature
from derender.structures.draws.faces import at_median_unseen, true_faces
from derender.structures.draws.metropolis import Draws, ascend, engine_of, evaluate, load, sample, under_blur
from derender.structures.draws.numbers import numbers_of_draws
from derender.structures.draws.sensor import (
    RATES,
    Sensor,
    blurs_about,
    final_sensor,
    first_sensor,
    held_by,
    model_image,
    same_sensor_refitted,
    too_far,
    whole_sensor,
    without_blur,
)
from derender.structures.draws.steps import own_members, touched_by

ANNEALING = 100  # steps of each temperature for each solid
TEMPERATURES, WARM = (0.03, 0.1, 0.3), (0.2,)  # of the likelihood at first: on the way to a mode, and near it
# Pixels of the steps by which a blur is changed with the solids, and steps of the climb after each, for each solid.
LONGEST_BLUR_STEP, LEAST_BLUR_STEP, FOLLOWED = 0.05, 0.01, 50
FARTHER, HIGHER = 0.25, 1.0  # pixels to another blur that is tried; nats by which it has to explain more
FEW = 20  # draws of a chain from which on they tell whether chains agree
STEPS, MOST_STEPS = 2, 125  # between two draws: for each coordinate, and at most
BLUR_POINTS = 60  # at which blurs are summed over
# Share of an image of independent noise that may show what is no part of the scene, and be explained as if it were.
MOST_BACKGROUND = 0.1
# By how many standard deviations of its noise a background, as it was seen, may be nearer; metres before the camera.
BEFORE, LEAST_DEPTH = 3.0, 0.01
FOOT = 2  # pixels about a free-form thing in which its foot, and what an edge mixes, may show
REACHED, BESIDE = 0.99, 6  # share of the pixels whose depth is within a sensor's reach; pixels beside what returned
UNEVEN = 3.0  # standard deviations of where a real face is, by which a floor is at least uneven
WIDER, FREEDOM = 1.3, 6.0  # times as wide as draws at one blur are those at any; degrees of freedom of t


class Refined(NamedTuple):
    """A state at its mode under a sensor model."""

    state: Any  # State with its rows there
    chart: Chart
    values: np.ndarray  # (D,) its coordinates
    sensor: Sensor
    log_prior: float  # there
    log_likelihood: float  # there


def at_mode(rng: np.random.Generator, state: State, floor_pose: np.ndarray, sensor: Sensor, rules: Rules,
            steps: int = ANNEALING, only: list[int] | None = None,
            temperatures: tuple[float, ...] = TEMPERATURES, least: float = -np.inf) -> Refined:  # fmt: skip
    """Return the Refined of a state, annealed under a sensor model.
    only : indices of the solids that may move, None for all. least : see `ascend`.
    """
    chart, values = make_chart(state, floor_pose, rules)
    if only is not None:
        steps *= len(only)
    return climb(rng, state, chart, values, sensor, steps, None if only is None else members_of(chart, only),
                 temperatures, least)  # fmt: skip


def climb(rng: np.random.Generator, state: State, chart: Chart, values: np.ndarray, sensor: Sensor, steps: int,
          members: list[int] | None = None, temperatures: tuple[float, ...] = TEMPERATURES,
          least: float = -np.inf) -> Refined:  # fmt: skip
    """Return the Refined after an annealed walk of these coordinates (None: all) from `values`, which is changed."""
    count = max(len(state) if members is None else 1, 1)
    found = ascend(rng, engine_of(chart, sensor), chart, sensor, values, members, temperatures, steps * count,
                   least)  # fmt: skip
    return refined_at(state, chart, found[0], sensor, *found[1:])


def best_climb(rng: np.random.Generator, state: State, chart: Chart, values: np.ndarray, sensor: Sensor,
               tries: int = THREADS) -> Refined:  # fmt: skip
    """As `climb`, the best of some walks: one alone may end beside the mode. A single one is not heated: it ends no
    higher."""
    task = partial(climb, state=state, chart=chart, sensor=sensor, steps=ANNEALING,
                   temperatures=TEMPERATURES if tries > 1 else ())  # fmt: skip
    ends = in_threads(rng, [partial(task, values=values.copy()) for _ in range(tries)])
    return max(ends, key=lambda each: each.log_prior + each.log_likelihood)


def refined_at(
    state: State, chart: Chart, values: np.ndarray, sensor: Sensor, log_prior: float, log_likelihood: float
) -> Refined:
    """Return the Refined whose state's rows are those of the coordinates."""
    state = state.copy()
    state.rows = rows_at(chart, values)
    return Refined(state, chart, values.copy(), sensor, float(log_prior), float(log_likelihood))


class View(NamedTuple):
    """An image to refine by, see Sensor."""

    camera: Camera
    observed: np.ndarray  # (H, W)
    into: np.ndarray = np.eye(4)
    shared: bool = False  # whether its neighbouring pixels share noise, so that it is a real sensor's
    wall: float | None = None  # see Observation
    whole: np.ndarray | None = None  # see Observation; below zero where it shows what is no part of the scene
    whole_camera: Any = None  # its Camera


def view_of(seen: Any) -> View:
    """Return the View of an Observation.
    Where the image shows background or a free-form thing, it tells that nothing stands before that (see `Robust`)."""
    camera = seen.single_camera
    observed, whole = seen.single, seen.whole  # what all pixels of a block say is bent where an edge runs through it
    there = partial(of_whole_image, seen=seen, shape=observed.shape)
    if seen.bend is not None:
        observed = observed + there(seen.bend)
    if seen.correlation > CORRELATED or seen.things or background_share(seen) > MOST_BACKGROUND:
        as_seen = (seen.image.weight > 0) & (np.abs(seen.image.floor - seen.image.depth) < AS_SEEN)
        as_seen &= ~seen.floor.inliers | seen.behind  # what lies on the floor's plane tells where that is
        if seen.correlation <= CORRELATED and seen.things:  # each pixel along a thing's foot tells much there
            as_seen |= (seen.image.weight > 0) & grown(np.any([thing.mask for thing in seen.things], axis=0), FOOT)
        floor = floor_depth(seen.floor.pose, camera)
        nearest = np.minimum(there(seen.image.depth), floor) - BEFORE * there(seen.sigma)
        observed = np.where(there(as_seen) & np.isfinite(observed), -np.maximum(nearest, LEAST_DEPTH), observed)
        observed = with_out_of_reach(observed, floor)
        whole = None if whole is None else np.where(of_whole_image(as_seen, seen, whole.shape), -whole, whole)
    return View(camera, observed, np.eye(4), seen.correlation > CORRELATED, seen.wall, whole, seen.whole_camera)


def with_out_of_reach(observed: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Return an image (H, W) that shows besides that nothing stands before what the sensor cannot reach, where even the
    floor is farther than it sees: a solid would return. floor : (H, W) metres to the floor, inf where it is not met."""
    if not (observed > 0.0).any():
        return observed
    reach = float(np.quantile(np.abs(observed[np.isfinite(observed)]), REACHED))
    beside = grown((observed > 0.0) & (observed < floor), BESIDE)
    return np.where(np.isnan(observed) & (floor > reach) & beside, -reach, observed)


def background_share(seen: Any) -> float:
    """Return the share of the pixels that show background and are not too far."""
    good = seen.image.weight > 0
    far = too_far(np.where(good, seen.image.depth, np.nan))
    return float((seen.behind & good & ~far).sum() / max(good.sum(), 1))


def refine(rng: np.random.Generator, views: list[View], floor_pose: np.ndarray, state: State, rules: Rules,
           tries: int = THREADS) -> Refined:  # fmt: skip
    """Return the Refined of the search's best state, the sensor fitted on the way.
    floor_pose : (4, 4), floor frame to the first view's camera. tries : see greedy.Settings.
    """
    chart, values = make_chart(state, floor_pose, rules)
    beliefs = bare_image() if rules.beliefs is None else rules.beliefs
    first, *others = (
        first_sensor(
            view.camera, view.observed, chart, values, sensor_beliefs(beliefs, view.shared), view.into, view.wall
        )
        for view in views
    )
    sensor = first._replace(others=tuple(others))
    if not len(state) and all(view.shared for view in views):
        # each pixel says so little of where a floor is that the few just over it would draw it to them
        return refined_at(state, chart, values, sensor, *load(engine_of(chart, sensor), chart, values))
    best = best_climb(rng, state, chart, values, sensor, tries)
    refined = with_sensor_refitted(rng, sharpened(rng, best, views) if tries > 1 else best)
    kept = without_unseen(refined.state, refined)
    if len(kept) == len(refined.state):
        return refined
    chart, values = make_chart(kept, floor_pose_of(refined), rules)
    return with_sensor_refitted(rng, best_climb(rng, kept, chart, values, refined.sensor, tries))


def sharpened(rng: np.random.Generator, refined: Refined, views: list[View]) -> Refined:
    """Return the Refined with single pixels of whole images as they were without the blur. How much leaked into each
    from others a scene tells that explains the whole images to a pixel: so it is climbed under these first."""
    if all(view.whole is None for view in views):
        return refined
    state, chart, views_of = refined.state, refined.chart, refined.sensor.views

    def joint(found: Iterable[Sensor]) -> Sensor:
        first, *others = found
        return first._replace(others=tuple(others))

    def whole(sensor: Sensor, view: View, values: np.ndarray, *blurs: tuple[float, ...]) -> Sensor:
        """Return the Sensor of a whole image that explains it best given a scene; of another image its own."""
        if view.whole is None:
            return sensor
        return whole_sensor(sensor, view.whole_camera, view.whole, chart, values, *blurs)

    first = joint(whole(sensor, view, refined.values) for sensor, view in zip(views_of, views, strict=True))
    values = climb(rng, state, chart, refined.values.copy(), first, ANNEALING, None, ()).values
    found = []
    for sensor, view, former in zip(views_of, views, first.views, strict=True):
        closer = whole(sensor, view, values, (former.values["blur"],))
        found.append(sensor if view.whole is None else without_blur(sensor, closer, np.abs(view.whole), chart, values))
    sensor = joint(found)
    return refined_at(state, chart, values, sensor, *load(engine_of(chart, sensor), chart, values))


def without_unseen(state: State, refined: Refined) -> State:
    """Return the state less the solids that carry nothing and of which no used pixel sees anything (the search explains
    far pixels too), or that are no higher than a real floor is uneven."""
    pixels, uneven = pixels_of(refined), UNEVEN * refined.chart.faces
    for k in reversed(range(len(state))):
        if (not pixels[k] or highest(refined.state.rows[k]) < uneven) and k not in state.parents:
            state = state.without(k)
    return state


def pixels_of(refined: Refined) -> np.ndarray:
    """Return (N,) in how many used pixels of all views each solid of a Refined shows."""
    count = len(refined.state)
    pixels = np.zeros(count, np.int64)
    for view in refined.sensor.views:
        _, label = model_image(refined.chart, refined.values, view.camera, view.into)
        shown = label[(view.observed > 0.0) & (label > 0)]
        pixels += np.bincount(shown, minlength=count + 1)[1:]
    return pixels


def with_sensor_refitted(rng: np.random.Generator, refined: Refined) -> Refined:
    """Return the Refined at its mode under the sensor model that its present state suggests, or as it is where that is
    higher.

    Solids that were fitted under a wrong blur suggest just that, and outliers or flying pixels beside them: where there
    are more than the fewest, or outliers are not fitted and tell nothing, one that is FARTHER to either side is tried
    with the solids following it.
    """
    sensor = final_sensor(refined.sensor, refined.chart, refined.values)
    found = climb(rng, refined.state, refined.chart, refined.values.copy(), sensor, ANNEALING, None, ())
    fitted = sensor.values.keys() - held_by(sensor.prior).keys()
    suspect = "outlier" not in fitted or leaves_outliers(sensor)
    ways = [-FARTHER, FARTHER] if changes_blur(sensor) and suspect else []
    while ways:
        way = ways.pop()
        sensor = found.sensor.changed(flying=0.0).blurred(way)
        trial = refitted(climb(rng, found.state, found.chart, found.values.copy(), sensor, ANNEALING, None, ()))
        if height(trial) > height(found) + HIGHER:
            found, ways = trial, [way]
    return max(refined, at_its_blur(rng, found, None), key=height)


def leaves_outliers(sensor: Sensor) -> bool:
    """Return whether more outliers than the fewest, or flying pixels, had to be fitted to a Sensor beside its solids:
    the real one has them, or the solids are others. Shares that are known say nothing of the solids."""
    known, fewest = held_by(sensor.prior), {"outlier": RATES[0], "flying": 0.0}
    return any(sensor.values.get(name, 0.0) > rate for name, rate in fewest.items() if name not in known)


def changes_blur(sensor: Sensor) -> bool:
    """Return whether a Sensor's blur is sought together with its solids: that of one view of independent pixels."""
    return sensor.worth >= 1.0 and not sensor.others and "blur" not in held_by(sensor.prior)


def at_its_blur(rng: np.random.Generator, refined: Refined, members: list[int] | None) -> Refined:
    """Return the Refined climbed along the blur and these coordinates (None: all) together, where they give way to each
    other: to refit one with the other held ended 12 nats below both. Of one view whose pixels are independent."""
    step = LONGEST_BLUR_STEP if changes_blur(refined.sensor) else 0.0
    while step > LEAST_BLUR_STEP:
        wanted, held = refitted(refined).sensor, refined.sensor.values["blur"]
        way = np.sign(wanted.values["blur"] - held)
        if way == 0.0:
            break
        sensor = wanted.changed(blur=held).blurred(way * step)
        trial = climb(rng, refined.state, refined.chart, refined.values.copy(), sensor, FOLLOWED, members, ())
        if height(trial) > height(refined):
            refined = trial
        else:
            step *= 0.5
    return refined


def chains_of(
    rng: np.random.Generator, refined: Refined, chains: int, draws: int, until: float | None = None
) -> list[Draws]:
    """Return a list of Draws, the blur open, one for each chain; each starts where a hot walk of its own ends."""
    steps = min(STEPS * len(refined.values), MOST_STEPS)
    return sample(rng, refined.chart, refined.sensor, refined.values, chains, draws, steps, None, True, until,
                  agreed=partial(agreed, refined))  # fmt: skip


def agreed(refined: Refined, chains: list[Draws]) -> bool:
    """Whether chains of enough draws to tell agree about all numbers that are told of them, not about coordinates
    alone."""
    if len(chains) == 1 or len(chains[0].values) < FEW:
        return True
    told = structure_posterior(np.random.default_rng(0), refined, names_of(refined.state), 1.0, chains)
    for column, period in zip(np.moveaxis(told.values, -1, 0), told.periods, strict=True):
        r_hat, effective = r_hat_and_ess(unwrap(column, period))
        if doubtful({"r_hat": r_hat, "ess_bulk": effective, "draws": column}):
            return False
    return True


def floor_pose_of(refined: Refined) -> np.ndarray:
    """Return the (4, 4) pose, floor frame to camera, of a Refined."""
    return placed(refined.chart, refined.values)[1][0]


def structure_posterior(
    rng: np.random.Generator, refined: Refined, names: list[str], weight: float, chains: list[Draws]
) -> StructurePosterior:
    """Return the StructurePosterior of a Refined and its chains' draws.

    The Refined takes the place of the first draw where none is better: a climb may end beside the mode. Numbers are of
    the solids' faces where they are, not where they appear (`faces.py`); in the best draw no offset is drawn.
    """
    chart = refined.chart
    values = np.stack([chain.values for chain in chains])
    densities = np.stack([chain.densities for chain in chains])
    heights = densities.sum(axis=-1)
    best = divmod(int(heights.argmax()), heights.shape[1])
    if refined.log_prior + refined.log_likelihood > heights.max():
        best = 0, 0
        values[best] = refined.values
        densities[best] = refined.log_prior, refined.log_likelihood
    size = values.shape[-1]
    values[best] = at_median_unseen(refined, values[best], values.reshape(-1, size))
    likeliest, apparent = true_faces(None, chart, values[best][None]), values
    values = true_faces(rng, chart, values.reshape(-1, size)).reshape(values.shape)
    values[best] = likeliest[0]
    state = refined_at(
        refined.state, chart, true_faces(None, chart, refined.values[None])[0], refined.sensor, 0, 0
    ).state
    graph = scene_graph(state, floor_pose_of(refined), names, chart.floating)
    addresses, numbers, root = numbers_of_draws(chart, values.reshape(-1, size), graph, names)
    shape = values.shape[:2]
    _, shown, _ = numbers_of_draws(chart, apparent.reshape(-1, size), graph, names)
    return StructurePosterior(
        graph, addresses, numbers.reshape(*shape, -1), densities[..., 0], densities[..., 1], weight,
        root_pose=root.reshape(*shape, 4, 4),
        apparent=None if np.array_equal(shown, numbers) else shown.reshape(*shape, -1),
        extras={"accepted": [chain.accepted for chain in chains],
         "likelihood": refined.sensor.to_data(),
         **({"into": [view.into.tolist() for view in refined.sensor.others]} if refined.sensor.others else {})},
    )  # fmt: skip


def only_draw(refined: Refined, times: int = 1) -> Draws:
    """Return Draws that hold the mode alone, so many times."""
    densities = np.array([[refined.log_prior, refined.log_likelihood]])
    return Draws(np.repeat(refined.values[None], times, axis=0), np.repeat(densities, times, axis=0), 0.0)


def members_of(chart: Chart, solids: Any) -> list[int]:
    """Return the indices of the coordinates of some solids, in order."""
    return sorted({m for k in solids for m in own_members(chart, k)})


def refitted(refined: Refined) -> Refined:
    """Return the Refined with the sensor's numbers that explain it best, of the same likelihood, nothing moved."""
    sensor = same_sensor_refitted(refined.sensor, refined.chart, refined.values)
    _, log_likelihood = load(engine_of(refined.chart, sensor), refined.chart, refined.values)
    found = refined._replace(sensor=sensor, log_likelihood=log_likelihood)
    return found if height(found) > height(refined) else refined


def height(refined: Refined) -> float:
    """Return the log density of a Refined, its sensor's numbers counted: what modes are compared by."""
    return refined.log_prior + refined.log_likelihood + log_weight(refined.sensor)


def log_weight(sensor: Sensor, without: tuple[str, ...] = ()) -> float:
    """Return the log density of a Sensor's unknown numbers, less what pixels that show no part of the scene have where
    it does not hide them: nothing is known of such a surface, so it says nothing of the noise.

    without : names of numbers that do not count.
    """
    return sensor.log_prior(without) - sum(view.log_density_beyond for view in (sensor, *sensor.others))


def over_blur(rng: np.random.Generator, refined: Refined, solids: tuple[int, ...], draws: np.ndarray) -> Evidence:
    """Return the Evidence of the integral over the blur besides that over the coordinates of some solids, against that
    over these coordinates alone: what an integral under one blur misses.

    Solids give way to a blur, so both are integrated together: a sum over blurs at each point of a t distribution that
    is fitted to draws (n, D) of these coordinates under the one blur. Noise takes about the same from every structure.
    """
    chart, sensor, values = refined.chart, refined.sensor, refined.values
    members = members_of(chart, solids)
    points, proposed, touched = np.tile(values, (1, 1)), np.zeros(1), touched_by(chart, members)
    if members:
        mean, factor = fit(draws[:, members])
        points = np.tile(values, (BLUR_POINTS, 1))
        points[:, members] = draw_t(rng, mean, WIDER * factor, FREEDOM, BLUR_POINTS)
        proposed = log_t(points[:, members], mean, WIDER * factor, FREEDOM)

    def densities(views):
        """Return (n, 2) log prior and log likelihood of the points."""
        found = np.empty((len(points), 2))
        evaluate(views, chart, points, touched, found)
        return found

    held, more = -proposed, 0.0
    for view in sensor.views:  # given the scene each view's blur is its own
        views = engine_of(chart, view)
        load(views, chart, values)
        own = densities(views)
        held = held + own[:, 1]
        nodes = blurs_about(view, view.clean(chart, values))
        if len(nodes) == 1:  # it is known
            continue
        step = np.log(nodes[1] - nodes[0])
        each = [densities(under_blur(views, node))[:, 1] + log_prior_of(view.prior, {"blur": float(node)}) + step
                for node in nodes]  # fmt: skip
        more = more + np.logaddexp.reduce(each, axis=0) - own[:, 1]
    held = held + own[:, 0]
    totals = [np.logaddexp.reduce(logs) for logs in (held, held + more)]
    shares = np.exp(held - totals[0]), np.exp(held + more - totals[1])  # of each point in both
    return Evidence(float(totals[1] - totals[0]), float(np.linalg.norm(shares[1] - shares[0])))


def near_evidence(refined: Refined, solids: tuple[int, ...] | None = None) -> float:
    """Return about what the integral over these coordinates (None: all) is, at a tenth of its cost: that of a normal
    with the image's curvature at the mode, right to two nats where all sides are seen, to five or so where some are
    not."""
    chart = refined.chart
    height = refined.log_prior + refined.log_likelihood
    members = range(len(refined.values)) if solids is None else members_of(chart, solids)
    if not len(members):  # of no coordinates: where a solid is taken away
        return height
    engine = engine_of(chart, refined.sensor)
    load(engine, chart, refined.values)
    precision = Curvature(engine, chart, refined.sensor, refined.values).precision(list(members))
    return height - 0.5 * float(np.linalg.slogdet(precision / (2.0 * np.pi))[1])
