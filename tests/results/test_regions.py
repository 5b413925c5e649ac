"""Components against a flood fill, openings against plain loops, places in words."""

import numpy as np
import pytest

from derender.results.trust import components, opened, place_words


def flooded(mask):
    """Return the components of a mask by flooding them one by one."""
    label, count = np.zeros(mask.shape, int), 0
    for seed in zip(*np.nonzero(mask), strict=True):
        if label[seed]:
            continue
        count, stack = count + 1, [seed]
        while stack:
            at = stack.pop()
            if not (0 <= at[0] < mask.shape[0] and 0 <= at[1] < mask.shape[1]) or not mask[at] or label[at]:
                continue
            label[at] = count
            stack += [(at[0] + 1, at[1]), (at[0] - 1, at[1]), (at[0], at[1] + 1), (at[0], at[1] - 1)]
    return label, count


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9, 1.0])
def test_components_are_those_of_a_flood(share):
    rng = np.random.default_rng(int(10 * share))
    for shape in ((1, 7), (9, 1), (17, 23)):
        mask = rng.random(shape) < share
        label, count = components(mask)
        expected, number = flooded(mask)
        assert count == number and ((label > 0) == mask).all()
        pairs = set(zip(label[mask].tolist(), expected[mask].tolist(), strict=True))
        assert len(pairs) == count  # one name for one component, both ways


def test_a_spiral_is_one_component():
    mask = np.array([[1, 1, 1, 1, 1], [0, 0, 0, 0, 1], [1, 1, 1, 0, 1], [1, 0, 0, 0, 1], [1, 1, 1, 1, 1]], bool)
    assert components(mask)[1] == 1


def test_an_opening_keeps_what_is_wide_enough():
    mask = np.zeros((12, 14), bool)
    mask[2:5, 2:8] = True  # three pixels wide: stays
    mask[8, :] = True  # one pixel wide: goes
    mask[10:, 12:] = True  # two by two in the corner: goes, the image's border is no neighbour
    expected = np.zeros_like(mask)
    expected[2:5, 2:8] = True
    np.testing.assert_array_equal(opened(mask, 1), expected)
    np.testing.assert_array_equal(opened(mask, 0), mask)


@pytest.mark.parametrize(
    "rows, columns, words",
    [
        (slice(25, 35), slice(35, 45), "in the middle"),
        (slice(25, 35), slice(0, 9), "left of the middle"),
        (slice(0, 9), slice(35, 45), "above the middle"),
        (slice(50, 60), slice(70, 80), "below and right of the middle"),
    ],
)
def test_places_are_told_in_words(rows, columns, words):
    mask = np.zeros((60, 80), bool)
    mask[rows, columns] = True
    assert place_words(mask) == words
