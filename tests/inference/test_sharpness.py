"""The blur that an image shows, and the search's misfit under it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from derender.inference.bottom_up.sharpness import estimate_blur
from derender.inference.structure.image import ROW, added_misfit, draw, make_image, make_row, misfit_map
from derender.model.solids import BOX, SPHERE
from derender.vision.blur import blur_radius

CAMERA = {"fx": 70.0, "fy": 70.0, "cx": 39.5, "cy": 29.5, "width": 80, "height": 60}
FLOOR = np.array([[1.0, 0, 0, 0], [0, -0.6, -0.8, 0.1], [0, 0.8, -0.6, 0.8], [0, 0, 0, 1]])


def step_image(rng, sigma, noise=0.001):
    """A step of 20 cm in a random direction through a random place, blurred, with noise: (64, 64)."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[:64, :64] - 31.5
    depth = np.where(np.cos(angle) * x + np.sin(angle) * y + rng.uniform(-1, 1) > 0, 1.0, 0.8)
    if sigma:
        depth = gaussian_filter(depth, sigma, mode="nearest", radius=blur_radius(sigma))
    return depth + rng.normal(0, noise, depth.shape)


@pytest.mark.parametrize("sigma", [0.0, 0.5, 0.6])
def test_blur_of_steps_is_told(sigma):
    rng = np.random.default_rng(5)
    # 16 directions, with no return between the images, so that no step is made where they meet
    images = [[np.pad(step_image(rng, sigma), 1, constant_values=np.nan) for _ in range(4)] for _ in range(4)]
    told = estimate_blur(np.block(images), 0.001)
    # one neighbouring entry of the table of leaks is 0.1 px away
    assert abs(told - sigma) < 0.1


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
        # sums of up to 4,800 terms of at most 8 in float64
        assert change == pytest.approx(after - before, abs=1e-9)
