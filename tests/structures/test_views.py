"""Several images of one scene: their joint density, what it says of the scene, and what shared errors leave of it."""

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.solids.image import make_row
from derender.detection.solids.rules import Rules
from derender.detection.solids.state import FLOOR, State
from derender.render.likelihoods import likelihoods
from derender.scene.pose import inverse, rotation_x, rotation_z
from derender.scene.solids import BOX
from derender.structures.draws.chart import SIZE, make_chart
from derender.structures.draws.curvature import Curvature
from derender.structures.draws.metropolis import engine_of, evaluate, load
from derender.structures.draws.sensor import Sensor, model_depth

UPRIGHT = 0
BOTH = ("gaussian", "robust")


def floor_pose(azimuth, elevation=0.7, distance=0.7):
    """The floor frame's pose in front of a camera that looks down at its origin from a side."""
    pose = rotation_x(np.pi / 2 + elevation) @ rotation_z(azimuth)
    pose[:3, 3] = 0.0, 0.0, distance
    return pose


def tower():
    low = make_row(BOX, rotation_z(0.3)[:3, :3], np.array([0.0, 0.0, 0.04]), np.array([0.08, 0.12, 0.08]))
    high = make_row(BOX, rotation_z(0.6)[:3, :3], np.array([0.01, 0.0, 0.105]), np.array([0.06, 0.09, 0.05]))
    return State().add(low, UPRIGHT, False, FLOOR, 0.0).add(high, UPRIGHT, False, 0, 0.08)


def camera(width, height):
    return Camera(0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2, width, height)


def looks(rng, azimuths, names, sizes=((48, 36),), elevation=0.7, sigma=0.002, blur=0.5):
    """Return (chart, coordinates, Sensor) of a tower seen from some sides."""
    chart, values = make_chart(tower(), floor_pose(azimuths[0], elevation), Rules(0.0015))
    views = []
    for k, azimuth in enumerate(azimuths):
        view, into = camera(*sizes[k % len(sizes)]), floor_pose(azimuth, elevation) @ inverse(chart.floor)
        likelihood = likelihoods[names[k % len(names)]]
        numbers = likelihood.complete({"sigma": sigma, "blur": blur * k})
        observed = likelihood.sample(rng, model_depth(chart, values, view, into), numbers)
        views.append(Sensor(view, observed, likelihood, numbers, None, into if k else np.eye(4)))
    return chart, values, views[0]._replace(others=tuple(views[1:]))


@pytest.mark.parametrize("names", [BOTH, ("gaussian",)])
def test_the_density_of_several_images_is_the_product_of_theirs(names):
    rng = np.random.default_rng(1)
    chart, values, sensor = looks(rng, (0.0, 1.4, 3.0), names, ((48, 36), (64, 24)))
    together, single = engine_of(chart, sensor), [engine_of(chart, view) for view in sensor.views]
    points = values + 0.003 * rng.standard_normal((20, len(values)))
    found = np.empty((20, 2))
    load(together, chart, values)
    evaluate(together, chart, points, found)
    apart = np.array([[load(each, chart, point) for each in single] for point in points])
    np.testing.assert_array_equal(found[:, 0], apart[:, 0, 0])
    np.testing.assert_allclose(found[:, 1], apart[..., 1].sum(axis=1), rtol=1e-7)
    # a broken twin: cameras that all stand where the first does
    blind = engine_of(chart, sensor.each(lambda view: view._replace(into=np.eye(4))))
    assert load(blind, chart, values)[1] < load(together, chart, values)[1] - 1000.0


def test_each_view_is_that_of_its_own_likelihood_on_the_moved_scene():
    """One view from elsewhere is the density of a scene whose floor frame is moved into its camera."""
    chart, values, sensor = looks(np.random.default_rng(2), (0.0, 1.4), BOTH)
    (_, other) = sensor.views
    moved = chart._replace(floor=other.into @ chart.floor)
    here = other._replace(into=np.eye(4))
    found, expected = (load(engine_of(c, s), c, values)[1] for c, s in ((chart, other), (moved, here)))
    assert found == pytest.approx(expected, rel=1e-9)


def test_precisions_add_and_a_side_view_tells_what_the_first_hides():
    chart, values, sensor = looks(np.random.default_rng(3), (0.0, np.pi / 2), ("gaussian",), elevation=0.02)
    members = list(range(len(values)))

    def precision(sensor):
        engine = engine_of(chart, sensor)
        load(engine, chart, values)
        return Curvature(engine, chart, sensor, values).precision(members)

    both, (one, other) = precision(sensor), map(precision, sensor.views)
    prior = np.diag(precision(sensor._replace(observed=np.full_like(sensor.observed, np.nan), others=())))
    np.testing.assert_allclose(both + np.diag(prior), one + other, rtol=1e-4, atol=1e-3 * np.abs(both).max())
    spread = [np.sqrt(np.diag(np.linalg.inv(each))) for each in (one, both)]
    hidden = [size for size in chart.slots[:, SIZE:].ravel() if spread[0][size] > 0.002]
    assert hidden and all(spread[1][size] < 0.5 * spread[0][size] for size in hidden)


def test_an_effective_number_of_pixels_tempers_the_precision():
    chart, values, sensor = looks(np.random.default_rng(4), (0.0,), ("gaussian",))
    pixels = int(np.isfinite(sensor.observed).sum())
    found = []
    for worth in (np.inf, pixels / 100.0):
        tempered = sensor.changed(effective_pixels=worth)
        engine = engine_of(chart, tempered)
        load(engine, chart, values)
        found.append(Curvature(engine, chart, tempered, values).precision([0])[0, 0])
    assert found[1] < 0.02 * found[0]
