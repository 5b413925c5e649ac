"""How far an image is reduced; where returns end within a block it shows what the plane is at the block's pixel."""

from types import SimpleNamespace

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.estimate import WIDEST, settings_for
from derender.detection.pyramid import SLOPING, reduce, reduced_by
from derender.detection.search.greedy import Settings


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


def test_a_portrait_is_reduced_as_a_landscape_is_and_its_pixels_tell_as_much():
    """By its columns alone it was searched in twice the pixels: a carton was torn apart on a table seen so."""
    assert reduced_by(np.ones((640, 480)), WIDEST) == reduced_by(np.ones((480, 640)), WIDEST) == 4
    settings = Settings()
    shapes = ((120, 160), (240, 320), (320, 240))
    seen = [SimpleNamespace(correlation=0.8, camera=SimpleNamespace(shape=shape)) for shape in shapes]
    small, landscape, portrait = (settings_for(settings, each).temper for each in seen)
    assert small < landscape == portrait
