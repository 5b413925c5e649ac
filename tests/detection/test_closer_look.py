"""More pixels for the sizes of solids that fewer pixels have found, in images of real sensors."""

import numpy as np
import pytest
from scipy import ndimage

from derender.detection.search.greedy import Settings, sweep
from derender.detection.search.observation import (
    CORRELATED,
    closer_look,
    nearest_pixels,
    observe,
)
from derender.detection.solids.image import blank, draw, make_row, render_floor_scene
from derender.detection.solids.misfit import LIMIT, misfit_map
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.evaluation.made_scenes import camera_of
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import CYLINDER
from derender.structures.scored_posterior import part_of

HEIGHT, DISTANCE = 0.12, 0.7
PIXELS_ACROSS = 3.0  # standard deviation in pixels of what the sensor smooths its noise by


def photograph(rng, diameter, shift, noise, width=640):
    """Return depth (H, W), camera and the State of a cylinder on a table, under smooth noise of so many metres."""
    table = rotation_x(np.pi / 2 + np.radians(35.0))
    table[:3, 3] = [0.0, 0.05, DISTANCE]
    camera = camera_of(width, 3 * width // 4)
    size = np.array([diameter, diameter, HEIGHT])
    pose = table @ translation(shift, 0.0, 0.5 * HEIGHT)
    depth, _ = render_floor_scene(["cylinder"], pose[None], size[None], table, camera)
    smooth = ndimage.gaussian_filter(rng.normal(size=depth.shape), PIXELS_ACROSS)
    return depth + noise * smooth / smooth.std(), camera, table, size


def standing(seen, table, size, shift, height=HEIGHT):
    """Return the State of the cylinder in the axes of the observed floor."""
    pose = np.linalg.inv(seen.floor.pose) @ table @ translation(shift, 0.0, 0.5 * height)
    row = make_row(CYLINDER, pose[:3, :3], pose[:3, 3], size)
    return State().add(row, UPRIGHT, False, FLOOR, 0.0)


@pytest.mark.parametrize(("width", "factor"), [(640, 2), (480, 2), (800, 2), (320, 1)])
def test_a_closer_look_sees_the_same_scene(width, factor):
    """The true solid explains all pixels but those that a hair's breadth puts on the other side of an edge."""
    rng = np.random.default_rng(0)
    depth, camera, table, size = photograph(rng, 0.08, 0.0, 0.0, width)
    depth[: width // 10] = np.nan
    depth[-width // 20 :, :9] = np.nan
    seen = observe(depth, camera)
    closer = closer_look(seen, depth, camera)
    assert closer.times == seen.factor / factor > 1
    state = standing(seen, table, size, 0.0)
    # 2 mm, more than the plane through a block is off at a crease
    image = closer.image._replace(weight=np.where(closer.image.weight > 0, 0.5 / 0.002**2, 0.0))
    drawn, label, misfit = blank(image)
    draw(image, state.rows, -1, drawn, label)
    misfit_map(image, drawn, misfit)
    assert (image.weight > 0).sum() > 0.8 * misfit.size
    focal = closer.times * seen.camera["fx"]
    around = 2 * np.pi * 0.08 * focal / DISTANCE  # pixels along the outline, with room
    assert (misfit > 0.1 * LIMIT).sum() < 0.1 * around
    # Broken twin: half a pixel aside all the outline's pixels on two sides are wrong.
    aside = state.copy()
    aside.rows[0, 10] += 1.0 * DISTANCE / focal
    draw(image, aside.rows, -1, drawn, label)
    misfit_map(image, drawn, misfit)
    assert (misfit > 0.1 * LIMIT).sum() > 0.1 * around


def test_the_nearest_pixels_of_a_reduced_image():
    # reduced by 4 its pixels stand for 1, 5, 9; by 2 they stand for 0, 2, 4, 6, 8, 10
    assert nearest_pixels(6, 2, 3, 4).tolist() == [0, 0, 1, 1, 2, 2]
    assert nearest_pixels(4, 3, 4, 3).tolist() == [0, 1, 2, 3]


def test_sizes_are_nearer_the_truth():
    """Of twelve cylinders whose silhouettes fall anywhere between pixels; with pixels half as wide, half as far off."""
    rng = np.random.default_rng(1)
    off = []
    for _ in range(12):
        diameter, shift = rng.uniform(0.06, 0.09), rng.uniform(-0.02, 0.02)
        depth, camera, table, size = photograph(rng, diameter, shift, 0.001)
        seen = observe(depth, camera)
        assert seen.correlation > CORRELATED
        settings = Settings().for_correlation(seen.correlation)
        state = standing(seen, table, size, shift)
        state.rows[0, 13:15] += DISTANCE / seen.camera["fx"]
        state = sweep(rng, seen.image, state, settings, 400, heat=0.0)
        found = []
        for look in (None, closer_look(seen, depth, camera)):
            part = part_of(rng, seen, look, state, settings, ["cylinder_1"], 1.0, 1, 1)
            found.append(part.values[0, 0][part.addresses.index("cylinder_1.radius")] * 2 - diameter)
        off.append(found)
    coarse, fine = np.sqrt(np.mean(np.square(off), axis=0))
    assert fine < 0.5 * coarse
