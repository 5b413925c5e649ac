"""The pixels that draws are made from: those of the image as it came, whatever the search makes of its blocks."""

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.search.observation import observe
from derender.render.raycast.depth import render_depth
from derender.scene.solids import BOX, PLANE, Solids

WHOLE = Camera.from_field_of_view(320, 240)
TABLE = np.array([[1.0, 0, 0, 0], [0, -0.5, -0.8660254, 0.02], [0, 0.8660254, -0.5, 0.75], [0, 0, 0, 1]])


def test_single_pixels_are_what_the_reduced_camera_sees_and_smoothed_blocks_are_not():
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    pose[2, 3] = 0.06
    solids = Solids(np.array([PLANE, BOX], np.int32), np.array([TABLE, TABLE @ pose]),
                    np.array([np.zeros(3), [0.1, 0.12, 0.12]]), np.full(2, -1, np.int32))  # fmt: skip
    depth, _ = render_depth(solids, WHOLE)
    seen = observe(depth, WHOLE)
    assert seen.factor == 2
    exact, _ = render_depth(solids, Camera(**seen.camera))
    assert np.abs(seen.single - exact).max() < 1e-9
    assert np.abs(seen.image.depth - exact).max() > 0.001  # where an edge runs through a block


def test_single_pixels_without_a_return_stay_without():
    bare = Solids(np.array([PLANE], np.int32), TABLE[None], np.zeros((1, 3)), np.full(1, -1, np.int32))
    depth, _ = render_depth(bare, WHOLE)
    depth[100, 100] = np.nan
    depth[102, 102] = 0.0
    single = observe(depth, WHOLE).single
    assert np.isnan(single[50, 50]) and np.isnan(single[51, 51]) and np.isnan(single).sum() == 2
