"""The sensor models against the formulas they state."""

import numpy as np
import pytest

from derender.camera.sensor import SENSORS, depth_edges, find_sensor
from derender.errors import DerenderError


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("z", [0.6, 1.0, 2.0])
def test_noise_has_the_stated_deviation(name, z):
    sensor = find_sensor(name)
    seen = sensor.observe(np.random.default_rng(1), np.full((200, 200), z))
    step = z * z / sensor.baseline_focal * sensor.disparity_step
    # Rounding adds the variance of a uniform step (Sheppard) where the noise is not much smaller than the step.
    expected = np.hypot(sensor.noise_floor + sensor.noise_growth * (z - sensor.nearest) ** 2, step / np.sqrt(12))
    # 40,000 draws: 0.35 % standard error for white noise; correlated noise has 12 times fewer independent ones, and
    # a step larger than the deviation makes Sheppard's rule rough.
    assert np.nanstd(seen) == pytest.approx(expected, rel=0.05 if step < 2 * expected else 0.3)
    assert abs(np.nanmean(seen) - z) < step


@pytest.mark.parametrize("name", SENSORS)
def test_disparity_is_a_whole_number_of_steps(name):
    sensor = find_sensor(name)
    seen = sensor.observe(np.random.default_rng(2), np.random.default_rng(3).uniform(0.5, 3, (60, 80)))
    steps = sensor.baseline_focal / seen[np.isfinite(seen)] / sensor.disparity_step
    assert np.allclose(steps, np.round(steps), atol=1e-9)


@pytest.mark.parametrize("name", SENSORS)
def test_lost_pixels_have_the_stated_shares(name):
    sensor = find_sensor(name)
    depth = np.full((400, 400), 1.0)
    depth[:, 200:] = 1.5
    lost = np.isnan(sensor.observe(np.random.default_rng(4), depth))
    edge = depth_edges(depth, sensor.edge_step)
    assert edge.sum() == 800 and edge[:, 199:201].all()
    expected = 1 - (1 - sensor.edge_loss) * (1 - sensor.loss)
    # Binomial standard errors: sqrt(.25 / 800) = 1.8 % and sqrt(.02 / 160,000) = 0.04 %; four of them.
    assert lost[edge].mean() == pytest.approx(expected, abs=0.07)
    assert lost[~edge].mean() == pytest.approx(sensor.loss, abs=0.0015)


def test_what_has_no_return_stays_without():
    depth = np.full((20, 20), np.nan)
    depth[0, 0] = 100.0
    assert np.isnan(SENSORS["kinect"].observe(np.random.default_rng(5), depth)).all()


def test_an_unknown_sensor_is_named():
    with pytest.raises(DerenderError, match="did you mean 'kinect'"):
        find_sensor("kinekt")


def test_a_slanted_plane_has_no_edge_and_a_box_on_it_has_its_outline():
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    plane = 1 / (0.3 + 0.02 * rows + 0.003 * columns)  # 9 cm a pixel at the top: far steeper than any edge_step
    assert not depth_edges(plane, 0.02).any()
    assert not depth_edges(plane[:, :2], 0.02).any()  # two columns: one difference, and none to compare it with
    box = (abs(columns - 30) < 8) & (abs(rows - 24) < 6)
    depth = np.where(box, plane * 0.8, plane)
    edge = depth_edges(depth, 0.02)
    inner = (abs(columns - 30) < 7) & (abs(rows - 24) < 5)
    outer = (abs(columns - 30) < 9) & (abs(rows - 24) < 7)
    corners = (abs(columns - 30) == 8) & (abs(rows - 24) == 6)
    assert np.array_equal(edge, outer & ~inner & ~corners)
