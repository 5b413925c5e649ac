"""How a hand moves is found, and what it holds is followed by it where hardly anything else shows the thing."""

import films
import numpy as np
import pytest
from films import CAMERA, FPS, at, errors, film, start

from derender.scene.pose import moved
from derender.tracking.carrying import Hand
from derender.tracking.passes import Passes

GRAVITY = -9.81 * films.view()[:3, 2]
SIZES = [[0.06, 0.07, 0.08], [0.08, 0.06, 0.05]]
COUNT = 16  # spheres of an arm that comes down from the left to a fist, all before the box that it holds


def held_film(seed, shifts, held):
    """Return (frames, poses) of a box beside another, and of an arm that is moved by shifts (T, 3), metres, and the box
    with it in the frames `held`."""
    row = np.arange(COUNT)
    along, thick = 0.04 * row, 0.06 + 0.012 * np.sin(2.0 * row)
    arm = [at(-f - 0.005, -0.055 - 0.1 * f, 0.07 + 0.25 * f) for f in along]
    lifted = np.array(shifts) - np.array(shifts)[min(held)]
    box = [
        at(0, 0, 0.04) if t < min(held) else at(*([0, 0, 0.04] + lifted[min(t, max(held))])) for t in range(len(shifts))
    ]
    paths = [[first, at(0.16, 0.05, 0.025), *(moved(s, [*shift, 0, 0, 0]) for s in arm)]
             for first, shift in zip(box, shifts, strict=True)]  # fmt: skip
    kinds = ["box", "box", *["sphere"] * COUNT]
    frames, poses = film(np.random.default_rng(seed), kinds, [*SIZES, *([d] * 3 for d in thick)], paths)
    return frames, poses[:, :2], start(["box", "box"], SIZES, poses[0, :2])


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.004, 0.0, 0.0), (0.0, 0.005, 0.004), (-0.018, 0.0, 0.012)])
def test_how_a_hand_moves_is_found_to_a_fraction_of_a_pixel(shift):
    """A pixel is 8 mm wide, so that the nearest of the points that are seen would say that nothing moved."""
    away = (-1.0, 0.0, 0.0)
    frames, _, _ = held_film(0, [away, (0, 0, 0), shift], [0])
    hand = np.abs(frames[1] - frames[0]) > 0.02
    centre = (films.view() @ at(0, 0, 0.04))[:3, 3]
    found = Hand(frames[1], hand, centre, CAMERA).shift(frames[2], np.zeros(3))
    assert np.linalg.norm(found - films.view()[:3, :3] @ shift) < 0.003
    assert Hand(frames[1], hand, centre + 1.0, CAMERA).shift(frames[2], np.zeros(3)) is None  # none is there


def test_where_nothing_returns_a_hand_is_no_likelier():
    """Points that left the image cost nothing, and a hand before the camera was said to go off by 20 cm a frame."""
    frames, _, _ = held_film(0, [(-1.0, 0.0, 0.0), (0, 0, 0), (0, 0, 0)], [0])
    hand = np.abs(frames[1] - frames[0]) > 0.02
    frames[2, :, :44] = 0.0
    seen, shift = Hand(frames[1], hand, (films.view() @ at(-0.1, 0, 0.04))[:3, 3], CAMERA), np.zeros(3)
    for _ in range(4):  # each begins with what was found in the frame before
        shift = seen.shift(frames[2], shift)
    assert np.linalg.norm(shift) < 0.005


@pytest.mark.parametrize("seed", [1, 2])
def test_what_a_hand_holds_and_hides_goes_with_it(seed):
    """Boxes of which a corner was seen went up the arm that hid them, and stayed there while it put them down."""
    times = np.arange(34)
    come = np.interp(times, [2, 8, 25, 31], [-0.5, 0.0, 0.0, -0.5])
    up, aside = np.interp(times, [9, 14, 19, 24], [0.0, 0.06, 0.06, 0.0]), np.interp(times, [12, 21], [0.0, -0.08])
    shifts = np.column_stack([come + aside, np.zeros(34), up])
    frames, poses, beginning = held_film(seed, shifts, range(9, 25))
    found = Passes(list(frames), CAMERA, GRAVITY, 1 / FPS, lambda _: beginning).best()
    track = found.track(times / FPS, [])
    assert errors(track, poses).max() < 0.007
