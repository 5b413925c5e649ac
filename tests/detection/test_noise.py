"""The noise of depths from residuals; the blur that an image shows, and the search's misfit under it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from derender.camera.intrinsics import Camera
from derender.detection.pyramid import LEAST_SIGMA, estimate_blur, noise_of, spread_of
from derender.detection.search.searches import refocused
from derender.detection.solids.image import ROW, draw, make_image, make_row
from derender.detection.solids.misfit import added_misfit, misfit_map
from derender.render.blur import blur, blur_radius, blur_taps
from derender.scene.solids import BOX, SPHERE


def residuals(step, others=0.0, count=20_000):
    """Return noise of 1 mm, rounded to steps, some of it others of up to 2 m instead, and its own spread."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=count) * 0.001
    if step:
        noise = np.round(noise / step) * step
    return np.where(rng.random(count) < others, rng.uniform(0.0, 2.0, count), noise), noise.std()


@pytest.mark.parametrize("step", [0.0, 0.0005, 0.001, 0.0015, 0.002])
@pytest.mark.parametrize("others", [0.0, 0.1])
def test_spread_is_that_of_the_noise(step, others):
    found, true = residuals(step, others)
    assert spread_of(found) == pytest.approx(true, rel=0.06)  # its own error is .5 % of 20,000 normal numbers


@pytest.mark.parametrize("step", [0.0015, 0.002])
def test_median_does_not_tell_the_spread_of_rounded_noise(step):
    """The broken twin."""
    found, true = residuals(step)
    assert abs(1.4826 * np.median(np.abs(found)) / true - 1.0) > 0.3


def test_a_few_residuals_are_enough():
    assert spread_of(np.zeros(3)) == 0.0
    assert spread_of(np.array([0.3])) == pytest.approx(0.3, rel=0.02)


def test_growth_of_a_rounding_sensor_s_noise():
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.6, 1.4, 20_000)
    true = 0.0005 + 0.0012 * depth**2
    step = 0.002 * depth**2
    residual = np.round((depth + true * rng.normal(size=depth.size)) / step) * step - depth
    sigma, growth = noise_of(residual, depth)
    for near, far in ((0.65, 0.75), (1.2, 1.3)):
        there = (depth > near) & (depth < far)
        assert (sigma + growth * depth[there] ** 2).mean() == pytest.approx(residual[there].std(), rel=0.06)


def test_noise_that_grows_from_nothing_is_as_large_as_it_is_far_away():
    """With a tenth of a millimetre that does not grow at least, it was told a fifth too small there, and trust lost."""
    rng = np.random.default_rng(3)
    depth = 0.25 / rng.uniform(0.2, 1.0, 16_000)  # of a floor that goes on from .25 to 1.25 m
    sigma, growth = noise_of(0.001 * depth**2 * rng.normal(size=depth.size), depth)
    assert sigma + growth * 1.25**2 == pytest.approx(0.001 * 1.25**2, rel=0.06)


def test_a_clean_image_has_the_least_noise_at_every_depth():
    """It was a tenth of that, under which walks moved nothing: of 60 images without noise 6 were boxes for cubes, by
    the seed, at P .99."""
    depth = np.linspace(0.5, 3.0, 20_000)
    rounding = 1e-8 * np.random.default_rng(0).standard_normal(depth.shape)
    for residual in (rounding, 0.0 * rounding):
        assert noise_of(residual, depth) == (LEAST_SIGMA, 0.0)


def test_noise_over_a_wide_range_of_depths_is_as_likely_as_the_true_one():
    """Noise told by a near and a far half alone was 200 nats less likely, as it differs by much within either."""
    rng = np.random.default_rng(2)
    depth = 0.5 / rng.uniform(0.23, 1.0, 16_000)  # of a floor that goes on from .5 to 2.2 m
    true = 0.0007 + 0.0014 * depth**2
    residual = true * rng.normal(size=depth.size)
    residual[(depth > 1.0) & (depth < 1.1)] += 0.05  # what is not explained, all of it at one depth

    def log_density(spread):
        explained = np.abs(residual) < 0.03
        return float((-0.5 * (residual / spread) ** 2 - np.log(spread))[explained].sum())

    sigma, growth = noise_of(residual, depth)
    assert log_density(sigma + growth * depth**2) > log_density(true) - 10.0  # two numbers, a tenth of the depths lost


CAMERA = Camera(70.0, 70.0, 39.5, 29.5, 80, 60)
FLOOR = np.array([[1.0, 0, 0, 0], [0, -0.6, -0.8, 0.1], [0, 0.8, -0.6, 0.8], [0, 0, 0, 1]])


def step_image(rng, sigma, noise=0.001):
    """A step of 20 cm in a random direction through a random place, blurred, with noise: (64, 64)."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[:64, :64] - 31.5
    depth = np.where(np.cos(angle) * x + np.sin(angle) * y + rng.uniform(-1, 1) > 0, 1.0, 0.8)
    if sigma:
        depth = gaussian_filter(depth, sigma, mode="nearest", radius=blur_radius(sigma))
    return depth + rng.normal(0, noise, depth.shape)


@pytest.mark.parametrize("sigma", [0.0, 0.5, 0.6, 1.0, 1.3, 1.6, 2.0, 3.0])
def test_blur_of_steps_is_told(sigma):
    rng = np.random.default_rng(5)
    # 16 directions, with no return between the images, so that no step is made where they meet
    images = [[np.pad(step_image(rng, sigma), 4, constant_values=np.nan) for _ in range(4)] for _ in range(4)]
    told = estimate_blur(np.block(images), 0.001)
    # one neighbouring entry of the table of leaks is 0.1 px away, of wide blurs a tenth
    assert abs(told - sigma) < 0.1 * max(sigma, 1.0)


def test_a_smooth_image_says_nothing():
    y, x = np.mgrid[:64, :64]
    assert estimate_blur(1 / (1 + 0.001 * x + 0.002 * y), 0.001) == 0.0


@pytest.mark.parametrize("blur", [0.0, 0.5, 1.0])
def test_added_misfit_is_the_difference_of_whole_images(blur):
    rng = np.random.default_rng(3)
    observed = rng.uniform(0.6, 1.2, (60, 80))
    observed[rng.random((60, 80)) < 0.1] = np.nan
    image = make_image(observed, 0.1, CAMERA, FLOOR, blur)
    for _ in range(20):
        rows = np.empty((2, ROW))
        for k, kind in enumerate((BOX, SPHERE)):
            rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            rotation[:, 0] *= np.sign(np.linalg.det(rotation))
            size = rng.uniform(0.05, 0.2, 3) if kind == BOX else np.full(3, 0.1)
            rows[k] = make_row(kind, rotation, rng.uniform([-0.6, -0.6, 0], [0.6, 0.6, 0.2]), size)
        depth, misfit, label = np.empty((60, 80)), np.empty((60, 80)), np.empty((60, 80), np.int32)
        draw(image, rows, 0, depth, label)
        before = misfit_map(image, depth, misfit)
        change = added_misfit(image, rows[0], depth, misfit)
        draw(image, rows, -1, depth, label)
        after = misfit_map(image, depth, np.empty((60, 80)))
        # sums of up to 4,800 terms of at most 8 in float64, or in float32 where each is a part in a million off
        assert change == pytest.approx(after - before, abs=1e-9 if blur else 1e-4)


def two_boxes(rng, sigma, started):
    """Return (Image taken for blurred by `started` pixels, rows) of two boxes seen blurred by `sigma`, noise 1 mm."""
    rows = np.array([make_row(BOX, np.eye(3), centre, np.full(3, 0.1)) for centre in ([-0.1, 0, 0.05], [0.1, 0, 0.05])])
    blank = make_image(np.zeros((60, 80)), 0.001, CAMERA, FLOOR)
    depth, label = np.empty((60, 80)), np.empty((60, 80), np.int32)
    draw(blank, rows, -1, depth, label)
    seen = blur(np.minimum(depth, 10.0), sigma) + rng.normal(0, 0.001, depth.shape)
    return make_image(seen, 0.001, CAMERA, FLOOR, started), rows


@pytest.mark.parametrize(("sigma", "started"), [(0.5, 0.0), (0.5, 0.6), (0.8, 0.3)])
def test_an_explained_image_tells_its_blur_exactly(sigma, started):
    image, rows = two_boxes(np.random.default_rng(7), sigma, started)
    image, gained = refocused(image, rows, price=40.0)
    # a hundredth of a pixel moves the 20 cm steps of the silhouettes by about a standard deviation of the noise
    assert image.taps[1] == pytest.approx(blur_taps(sigma)[1], abs=0.005)
    assert gained > 40.0


def test_a_sharp_image_stays_sharp():
    image, rows = two_boxes(np.random.default_rng(7), 0.0, 0.0)
    assert refocused(image, rows, price=40.0) == (image, 0.0)


def test_the_background_that_is_taken_as_seen_is_not_blurred_again():
    rng = np.random.default_rng(4)
    seen = rng.uniform(2.0, 9.0, (60, 80))
    image = make_image(seen, 0.001, CAMERA, FLOOR, 0.5)
    image.floor[:] = seen
    assert misfit_map(image, image.floor, np.empty(seen.shape)) == 0.0
    row = make_row(BOX, np.eye(3), [0, 0, 0.05], np.full(3, 0.1))
    depth, label, misfit = seen.copy(), np.empty(seen.shape, np.int32), np.zeros(seen.shape)
    change = added_misfit(image, row, depth, misfit)
    draw(image, row[None], -1, depth, label)
    assert change == pytest.approx(misfit_map(image, depth, misfit), abs=1e-6) and change > 0
