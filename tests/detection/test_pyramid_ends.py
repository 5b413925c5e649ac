"""Where returns end within a block, the reduced image shows what the plane is at the pixel that stands for it."""

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.pyramid import SLOPING, reduce


@pytest.mark.parametrize("begins", [40, 41, 42, 43])
@pytest.mark.parametrize("widest", [80, 40])
def test_a_far_floor_that_ends_amid_a_block_is_not_raised(begins, widest):
    camera = Camera.from_field_of_view(160, 120, 58.0)
    normal = [0.0, -np.cos(0.5), -np.sin(0.5)]  # of a floor 1.1 m below a camera that looks down by half a radian
    depth = -1.1 / (camera.rays() @ normal)
    depth[:begins] = np.nan
    small, reduced, _ = reduce(depth, camera, widest)
    seen = np.isfinite(small)
    assert seen.any()
    assert np.allclose(small[seen], (-1.1 / (reduced.rays() @ normal))[seen], rtol=SLOPING)
