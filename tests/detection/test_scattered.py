"""Returns that lie scattered over an image, as after putting them into a larger one, are told as if side by side."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import derender
from derender.camera.intrinsics import Camera
from derender.detection.resampled import scattering_of, shares_noise

CAMERA = Camera(fx=280.0, fy=280.0, cx=159.5, cy=119.5, width=320, height=240)


def floor_and_block(camera=CAMERA):
    """Return the depth image of a floor that leans away and of a level thing before it."""
    inverse = np.broadcast_to(np.linspace(0.6, 1.6, camera.height)[:, None], (camera.height, camera.width))
    depth = 1.0 / inverse
    depth[80:150, 100:180] = 0.8
    return depth


def put_into(depth, ratio, noise=0.0):
    """Return an image of the same size in which every `ratio`-th pixel of each row and column returned, noise added."""
    rows, columns = (np.unique((np.arange(0, side - 1, ratio)).round().astype(int)) for side in depth.shape)
    found = np.full(depth.shape, np.nan)
    some = depth[rows[:, None], columns]
    found[rows[:, None], columns] = some + noise
    return found


@pytest.mark.parametrize("ratio", [1.15, 1.5, 2.0, 3.0])
def test_lattice_of_returns_is_taken_as_a_smaller_image_that_sees_the_same(ratio):
    exact = floor_and_block()
    found = scattering_of(put_into(exact, ratio))
    small, camera = found.reduced(exact), found.camera(CAMERA)
    assert 0.95 * ratio < found.ratio < ratio + 0.7
    assert small.shape == (camera.height, camera.width)
    thin = found.reduced(put_into(exact, ratio))
    assert np.isfinite(thin).mean() > 0.8
    rows = (
        np.arange(camera.height) - camera.cy
    ) / camera.fy * CAMERA.fy + CAMERA.cy  # the same rays in the large image
    floor = 1.0 / np.interp(rows, np.arange(CAMERA.height), np.linspace(0.6, 1.6, CAMERA.height))
    for image in (small, thin):
        there = np.isfinite(image).any(axis=1)
        off = np.nanmedian(np.abs(image / floor[:, None] - 1.0)[there], axis=1)[1:-1]
        assert off.max() < 0.002


def test_returns_left_by_chance_are_taken_as_they_are_but_where_neighbours_share_noise():
    rng, depth = np.random.default_rng(3), floor_and_block()
    alone = rng.random(depth.shape) < 0.3
    white = depth + 0.002 * rng.standard_normal(depth.shape)
    shared = gaussian_filter(rng.standard_normal(depth.shape), 2.0)
    shared = depth + 0.002 * shared / shared.std()
    assert scattering_of(np.where(alone, white, np.nan)) is None
    assert scattering_of(np.where(alone, shared, np.nan)) is not None
    assert shares_noise(shared)
    assert not shares_noise(white)


def test_what_hangs_together_is_no_lattice():
    rng, depth = np.random.default_rng(4), floor_and_block()
    holes = np.where(rng.random(depth.shape) < 0.15, np.nan, depth)
    rows = np.where((np.arange(240) % 4 == 0)[:, None], depth, np.nan)
    half = np.where(np.arange(320) < 160, depth, np.nan)
    for image in (depth, holes, rows, half, np.full(depth.shape, np.nan)):
        assert scattering_of(image) is None


def test_patches_of_returns_do_not_make_cells_wider_and_wider():
    """Of a shelf whose returns lay on a lattice in patches an image of 10 x 7 pixels was left, with no plane in it."""
    rng, lattice = np.random.default_rng(6), put_into(floor_and_block(), 1.5)
    patches = np.kron(rng.random((24, 32)) < 0.6, np.ones((10, 10), bool))
    found = scattering_of(np.where(patches, lattice, np.nan))
    assert found is None or found.ratio < 3.0


def test_depths_put_into_a_larger_image_are_not_told_as_nothing():
    image = derender.sample("tabletop", seed=5, camera=CAMERA).render(noise=True, seed=5)
    large = put_into(image.depth, 1.5)
    with pytest.warns(UserWarning, match="returns lie scattered"):
        told = derender.infer(large, camera=CAMERA, quick=True, seed=1)
    whole = derender.infer(image.depth, camera=CAMERA, quick=True, seed=1)
    assert sorted(o.type for o in told.objects) == sorted(o.type for o in whole.objects)
    assert told.explanation.label.shape == large.shape
