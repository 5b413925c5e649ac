"""What happens in a film is what a person would say: once, at its moment, and not of what a hand does."""

from types import SimpleNamespace

import numpy as np
import pytest

from derender.scene.pose import from_rotation_vector
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.tracking.events import events_of, topples
from worlds.films import without_hops

UP = np.array([0.0, 0.0, 1.0])


def turned(degrees, axis=(1.0, 0.0, 0.0)):
    """Return poses (T, 4, 4) that are turned by so much about an axis."""
    return np.array([from_rotation_vector(np.radians(d) * np.array(axis)) for d in degrees])


OVER = [0, 5, 20, 40, 60, 85, 95, 90, 90, 90]


@pytest.mark.parametrize(
    "degrees, kind, borne, expected",
    [
        (OVER, BOX, True, [4]),
        ([0, 20, 50, 60, 40, 20, 0, 0, 0, 0], BOX, True, []),  # rocks
        ([0, 20, 50, 90, 140, 180, 220, 270, 320, 360], BOX, True, [2]),  # rolls on
        ([0, 20, 44, 46, 44, 47, 60, 90, 90, 90], BOX, True, [5]),
        (OVER, BOX, False, []),  # in a hand
        (OVER, SPHERE, True, []),
        (OVER, CYLINDER, True, [4]),
    ],
)
def test_a_thing_topples_once_where_it_turns_over_for_good(degrees, kind, borne, expected):
    still, everywhere = np.arange(10) == 0, np.full(10, borne)
    assert topples(turned(degrees), np.tile(UP, (10, 1)), kind, still, everywhere) == expected
    camera = turned(7.0 * np.arange(10), (0.0, 1.0, 0.0))  # that turns itself
    assert topples(camera @ turned(degrees), (camera @ [*UP, 0.0])[:, :3], kind, still, everywhere) == expected


def test_a_lying_cylinder_that_rolls_does_not_topple_and_rests_begin_anew():
    rolling = turned([90] * 10) @ turned(40 * np.arange(10), (0.0, 0.0, 1.0))
    nothing, always = np.arange(10) == 0, np.ones(10, bool)
    assert topples(rolling, np.tile(UP, (10, 1)), CYLINDER, nothing, always) == []
    twice = turned([0, 50, 90, 90, 90, 120, 140, 180, 180, 180])
    assert topples(twice, np.tile(UP, (10, 1)), BOX, np.isin(np.arange(10), [0, 3, 4]), always) == [1, 6]
    gone = turned(OVER)
    gone[5:] = np.nan
    assert topples(gone, np.tile(UP, (10, 1)), BOX, nothing, always) == []  # lost while it leant


def words_of(heights, parents, fps=30.0):
    """Return [(frame, event)] of a ball of 2 cm on a floor, apart from its states."""
    count = len(heights)
    poses, chances = np.tile(np.eye(4), (count, 1, 1, 1)), np.zeros((count, 1, 3))
    poses[:, 0, 2, 3] = heights
    chances[np.arange(count), 0, [0 if parent is None else 1 for parent in parents]] = 1.0
    track = SimpleNamespace(
        names=["ball"], kinds=np.array([SPHERE]), times=np.arange(count) / fps, poses=poses,
        sizes=np.full((count, 1, 3), 0.02), floor=np.eye(4),
        states=[["moving"]] * count, parents=lambda: [[parent] for parent in parents],
        floors=lambda: np.tile(np.eye(4), (count, 1, 1)), parent_probability=chances,
    )  # fmt: skip
    return [(event["frame"], event["event"]) for event in events_of(track)]


def test_a_bounce_is_told_once_and_what_falls_lands_however_slowly():
    heights = np.array([89, 86, 80, 71, 60, 46, 29, 10, 2, 12, 19, 24, 26, 25, 21, 15, 6, 1, 5, 7, 7, 3, 0, 0]) / 1e3
    told = words_of(0.01 + heights, [None] * 22 + ["floor"] * 2, 60.0)
    assert told == [(8, "bounced"), (17, "bounced"), (22, "landed")]
    dropped = [0.06, 0.06, 0.055, 0.043, 0.027, 0.01, 0.01, 0.01]
    assert (5, "landed") in words_of(dropped, ["floor", *[None] * 4, *["floor"] * 3])


def test_what_a_hand_brings_down_fast_is_placed():
    """From a hover over 12 cm in a quarter of a second: it was said to land, as at .65 m/s."""
    heights = np.array([116, 116, 114, 98, 71, 41, 15, 0, 0, 0]) / 1e3
    assert words_of(0.01 + heights, [None] * 7 + ["floor"] * 3, 24.0) == [(7, "placed")]


def test_what_a_hand_turns_back_in_the_air_does_not_bounce():
    """Carried up and down 10 cm above the floor it was said to bounce, and to land at last; nearer it may have."""
    heights = np.array([0, 60, 130, 150, 125, 100, 120, 150, 130, 90, 60, 40, 25, 12, 5, 0, 0, 0]) / 1e3
    parents = ["floor", *[None] * 14, *["floor"] * 3]
    assert words_of(0.01 + heights, parents) == [(1, "lifted"), (15, "placed")]
    heights[5] = 0.02
    assert (5, "bounced") in words_of(0.01 + heights, parents)


def test_what_hops_by_millimetres_still_rests_in_made_films_and_what_bounces_does_not():
    """A block that had fallen changed its parent eight times in nine frames, by hops of 1 to 3 mm."""
    step = 0.00025  # seconds
    steps = np.arange(round(0.4 / step)) * step
    touches = (steps < 0.1) | (np.abs(steps - 0.15) < 0.005) | (np.abs(steps - 0.3) < 0.005)  # hops of 45 and 140 ms
    kept = without_hops(touches[:, None, None], step)[:, 0, 0]
    assert np.array_equal(kept, (steps < 0.155 - step / 2) | (np.abs(steps - 0.3) < 0.005))
