"""Where the camera of a further image stood, found from the scene itself: floors and solids are the landmarks.

Two floors leave a turn and a shift along the floor open. A solid found in both images gives them: a box by its centre
and its turn, up to quarter turns; two solids by the line between their centres. Of all such motions those that bring
most solids onto each other are tried: each image's solids have to explain the other image (the search's own energy),
and that is improved over turn and shift. The full pose then follows from the depths: Gauss-Newton on the residuals of
the refined scene (`with_poses_refined`), as for poses that were given to less than the images tell.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from derender.detection.search.greedy import Settings, total_energy
from derender.detection.search.observation import Observation
from derender.detection.solids.image import CENTRE, ROTATION, SIZE
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.state import State
from derender.errors import DerenderError
from derender.render.blur import blur
from derender.scene.pose import inverse, rotation_z, twist_exp
from derender.scene.solids import BOX
from derender.structures.draws.chart import Chart
from derender.structures.draws.curvature import APART, weights
from derender.structures.draws.metropolis import engine_of, load
from derender.structures.draws.refined import Refined, refined_at, with_sensor_refitted
from derender.structures.draws.sensor import Sensor, model_depth

if TYPE_CHECKING:
    from derender.structures.together import Look

SAME_TOP, SAME_PLACE = 0.015, 0.04  # metres between tops, and between centres, of what may be one solid in two images
MOST_TRIED, MOST_IMPROVED = 12, 3  # motions whose energy is looked at, and improved
STEPS = tuple(0.02 * 0.5**k for k in range(9))  # metres, and 5 times as many radians, of the improvement
EXPLAINS = 0.5  # share of what an image's own solids explain of it that those of the other must explain as well
POSE_STEPS = 8  # of Gauss-Newton
FAR_OFF = 4.0  # standard deviations beyond which a residual is an outlier
WORTH_MOVING = 20.0  # nats by which a pose that was given must be bettered to be changed
ROUNDS = 2  # in which scene and poses are improved in turn


def found_over(first: "Look", state: State, seen: Observation, settings: Settings, name: str) -> np.ndarray:
    """Return (4, 4), an image's floor frame to the first one's, such that each shows what was found in the other.

    first : Look. state, seen : what was found in the image, its Observation. name : of it, for a fault.

    Raises DerenderError : nothing stands in both images.
    """

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

    found : (V,) bool, which views' poses were found, not given: those given move only where that explains much more.
    """
    for _ in range(ROUNDS):
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
    base = model_depth(chart, values, camera, view.into)
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
                model_depth(chart, values, camera, twist_exp(*np.split(way * step * np.eye(6)[k], 2)) @ view.into),
                smooth,
            )
            for way in (1.0, -1.0)
        )
        images.append(((ahead - behind) / (2.0 * step)).ravel())
    jacobian = np.array(images)
    normal = (jacobian * weight.ravel()) @ jacobian.T
    slope = (jacobian * weight.ravel()) @ residual.ravel()
    return np.split(np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(6), slope), 2)
