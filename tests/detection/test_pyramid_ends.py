"""Where returns end within a block, the reduced image shows what the plane is at the pixel that stands for it."""

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.pyramid import SLOPING, reduce


@pytest.mark.parametrize("begins", [40, 41, 42, 43])
@pytest.mark.parametrize("widest", [80, 40])
def test_a_far_floor_that_ends_amid_a_block_is_not_raised(begins, widest):
    camera = Camera.from_field_of_view(160, 120, 58.0)
    normal = np.array(
        [0.0, -np.cos(0.5), -np.sin(0.5)]
    )  # a floor 1.1 m below a camera that looks down by half a radian

    def floor(fx, fy, cx, cy, width, height):
        column, row = np.meshgrid(np.arange(width), np.arange(height))
        ray = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(row.shape)], axis=-1)
        return -1.1 / (ray @ normal)

    depth = floor(camera.fx, camera.fy, camera.cx, camera.cy, 160, 120)
    depth[:begins] = np.nan
    small, numbers, _ = reduce(depth, camera, widest)
    seen = np.isfinite(small)
    assert seen.any()
    assert np.allclose(small[seen], floor(**numbers)[seen], rtol=SLOPING)
