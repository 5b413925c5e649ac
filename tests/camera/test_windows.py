"""Windows about each pixel are as scipy has them, which takes a fifth of a second to import."""

import numpy as np
import pytest
from scipy import ndimage

from derender.camera.windows import greatest, grown, labelled, least, of_five, opened, shrunk, total


@pytest.mark.parametrize("seed", range(12))
def test_windows_are_as_scipy_has_them(seed):
    rng = np.random.default_rng(seed)
    shape, reach = tuple(rng.integers(2, 30, 2)), int(rng.integers(1, 9))
    image, mask, side = rng.random(shape), rng.random(shape) < rng.random(), 2 * reach + 1
    cross = ndimage.generate_binary_structure(2, 1)
    np.testing.assert_array_equal(greatest(mask, reach), ndimage.maximum_filter(mask, side, mode="constant"))
    np.testing.assert_array_equal(greatest(image, reach), ndimage.maximum_filter(image, side, mode="nearest"))
    np.testing.assert_array_equal(least(image, reach), ndimage.minimum_filter(image, side, mode="nearest"))
    np.testing.assert_array_equal(of_five(np.minimum, image), ndimage.minimum_filter(image, footprint=cross))
    np.testing.assert_array_equal(grown(mask, reach), ndimage.binary_dilation(mask, iterations=reach))
    np.testing.assert_array_equal(shrunk(mask, reach), ndimage.binary_erosion(mask, iterations=reach))
    np.testing.assert_array_equal(opened(mask, reach), ndimage.binary_opening(mask, np.ones((side, side))))
    np.testing.assert_allclose(total(image, reach), ndimage.convolve(image, np.ones((side, side)), mode="constant"))
    parts, count = labelled(mask)
    expected, many = ndimage.label(mask)
    np.testing.assert_array_equal(parts, expected)
    assert count == many
