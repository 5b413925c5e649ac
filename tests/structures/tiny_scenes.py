"""A few solids on a floor seen by 16 x 12 noisy pixels: little enough to be integrated by brute force."""

import numpy as np
from scipy.stats import multivariate_t

from derender.camera.intrinsics import Camera
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.rules import Rules
from derender.detection.solids.state import FLOOR, State
from derender.render.likelihoods import likelihoods
from derender.scene.solids import BOX
from derender.structures.catalogue.entry import in_order, make_entry
from derender.structures.draws.chart import make_chart
from derender.structures.draws.metropolis import engine_of, load
from derender.structures.draws.refined import climb
from derender.structures.draws.sensor import Sensor, model_depth

CAMERA = Camera(fx=20.0, fy=20.0, cx=7.5, cy=5.5, width=16, height=12)
RULES = Rules(0.002, 3e-4, False)
TURN = np.radians(55.0)  # of the camera's view down from the horizon
# floor frame (z up) to camera: the floor 0.5 m along the view
FLOOR_POSE = np.array([
    [1.0, 0.0, 0.0, 0.0],
    [0.0, -np.sin(TURN), -np.cos(TURN), 0.0],
    [0.0, np.cos(TURN), -np.sin(TURN), 0.5],
    [0.0, 0.0, 0.0, 1.0],
])  # fmt: skip


def box(x, y, size, turn=0.3):
    """Return the row of an upright box on the floor."""
    c, s = np.cos(turn), np.sin(turn)
    return make_row(BOX, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), (x, y, size[2] / 2), size)


def state_of(*items):
    """Return the State of solids (row, cube) on the floor."""
    state = State()
    for row, cube in items:
        state = state.add(row, UPRIGHT, cube, FLOOR, 0.0)
    return state


def sensor_of(state, sigma, rng):
    """Return a Sensor with an image of a state."""
    chart, values = make_chart(state, FLOOR_POSE, RULES)
    clean = np.minimum(model_depth(chart, values, CAMERA), 10.0)
    likelihood = likelihoods["gaussian"]
    observed = clean + sigma * rng.standard_normal(clean.shape)
    return Sensor(CAMERA, observed, likelihood, likelihood.complete({"sigma": sigma, "background": 10.0}))


def entries_of(rng, sensor, states, names):
    """Return the catalogue's entries of some states."""
    entries = []
    for state, own in zip(states, names, strict=True):
        chart, values = make_chart(state, FLOOR_POSE, RULES)
        refined = climb(rng, state, chart, values, sensor, 200)
        chart, values = make_chart(refined.state, FLOOR_POSE, RULES)
        refined = refined._replace(chart=chart, values=values)
        refined, own = in_order(refined, own, own.index)
        entries.append(make_entry(rng, refined, own))
    return entries


def brute_force(rng, walker, number, draws=20_000, wider=1.6, freedom=4.0):
    """Return (log of the integral of prior times likelihood, its standard error) by importance sampling.

    From Student's t about the entry's mean: nothing that the chains use besides the place to look at.
    """
    entry, sensor = walker.entries[number], walker.sensor
    factor = wider * np.linalg.cholesky(entry.covariance)
    size = len(entry.mean)
    engine = engine_of(entry.chart, sensor)
    normal = rng.standard_normal((draws, size)) / np.sqrt(rng.chisquare(freedom, draws) / freedom)[:, None]
    law = multivariate_t(np.zeros(size), np.eye(size), df=freedom)
    proposal = law.logpdf(normal) - np.sum(np.log(np.diag(factor)))
    values = entry.mean + normal @ factor.T
    inside = [walker.region.holds(entry.chart, v) for v in values]
    logs = np.array([sum(load(engine, entry.chart, v)) if i else -np.inf for v, i in zip(values, inside, strict=True)])
    logs -= proposal
    top = logs.max()
    weights = np.exp(logs - top)
    return top + np.log(weights.mean()), weights.std() / weights.mean() / np.sqrt(draws)
