"""A floor that is off its plane by millimetres is made a plane again; what stands on it stays, and noise is no bend."""

import numpy as np
import pytest
from table_scenes import CAMERA, seen_on_the_table

from derender.detection.floor import bend_of
from derender.detection.floors import find_floor
from derender.scene.solids import BOX


def bent_by(metres):
    """Return an image of a box on a table that is bent by so much towards the camera in the middle."""
    image = seen_on_the_table([(BOX, 0.0, 0.0, (0.1, 0.08, 0.12), None)])
    x = np.linspace(-1.0, 1.0, CAMERA.width)
    return image - metres * (1.0 - x**2)


def test_a_bent_floor_becomes_a_plane():
    image = bent_by(0.006)
    floor = find_floor(image, CAMERA)
    after = find_floor(image + bend_of(image, floor, CAMERA), CAMERA)
    assert after.sigma < 0.65 * floor.sigma


@pytest.mark.parametrize("metres", [0.0, 0.0003])
def test_a_plane_stays_as_it_is(metres):
    image = bent_by(metres)
    assert not bend_of(image, find_floor(image, CAMERA), CAMERA).any()


def test_a_floor_that_rises_towards_its_walls_becomes_a_plane():
    image = seen_on_the_table([(BOX, 0.0, 0.0, (0.1, 0.08, 0.12), None)])
    image = image - 0.008 * np.linspace(-1.0, 1.0, CAMERA.width) ** 4
    floor = find_floor(image, CAMERA)
    after = find_floor(image + bend_of(image, floor, CAMERA), CAMERA)
    assert after.sigma < 0.55 * floor.sigma
