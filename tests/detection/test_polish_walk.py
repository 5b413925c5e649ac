"""The compiled walk of one solid leaves its density as it is."""

import numpy as np
from scipy.stats import kstest

from derender.detection.solids.image import make_image, make_row
from derender.detection.solids.polish import SIZE_SPREAD, TYPICAL_SIZE, UPRIGHT, WALK_MOVES, walk
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import BOX

CAMERA = {"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}
FLOOR_POSE = translation(0.0, 0.05, 0.8) @ rotation_x(np.deg2rad(135))


def test_a_cube_of_which_nothing_is_seen_has_sizes_from_its_prior():
    """The density of a side s is exp(-z^2 / 2) with z = log(s / typical) / spread, so that log s has its mean moved."""
    image = make_image(np.zeros((24, 32)), 1.0, CAMERA, FLOOR_POSE)  # no pixel has a weight
    start = make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.05]), np.full(3, 0.1))
    rng, sides = np.random.default_rng(5), []
    scale, nothing = np.full(WALK_MOVES, 0.03), np.zeros((24, 32))
    scale[:12] = 1e-3  # the side changes by the steps at a corner alone
    row = start
    for _ in range(1500):
        row = walk(rng, image, row, UPRIGHT, True, row[None], 0, nothing, nothing, 0.0, np.zeros(0), 0.02, 0.0, scale,
                   150, 1.0, False)  # fmt: skip
        sides.append(row[13])
        assert row[13] == row[14] == row[15]
    z = np.log(np.array(sides[::3]) / TYPICAL_SIZE) / SIZE_SPREAD - SIZE_SPREAD
    assert kstest(z, "norm").pvalue > 1e-3
    assert kstest(z + SIZE_SPREAD, "norm").pvalue < 1e-6  # the broken twin: without the Jacobian of the logarithm
