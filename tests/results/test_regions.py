"""Places in an image, in words."""

import numpy as np
import pytest

from derender.results.trust import Region


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
    assert Region("A", mask, 0.1).where == words
