"""What is drawn over pictures: outlines are borders, areas are masks, bars have the length that they say."""

import re

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.report.pictures import area_path, marks_svg, outline_path, scale_bar
from derender.results.trust import Region


def test_an_area_is_its_mask_and_an_outline_its_border():
    rng = np.random.default_rng(0)
    mask = rng.random((9, 12)) < 0.5
    painted = np.zeros(mask.shape, int)
    for x, y, length in re.findall(r"M(\d+) (\d+)h(\d+)v1", area_path(mask)):
        painted[int(y), int(x) : int(x) + int(length)] += 1
    np.testing.assert_array_equal(painted, mask.astype(int))
    padded = np.pad(mask, 1)
    border = (padded[1:] != padded[:-1]).sum() + (padded[:, 1:] != padded[:, :-1]).sum()
    assert sum(int(length) for length in re.findall(r"[hv](\d+)", outline_path(mask))) == border


@pytest.mark.parametrize("distance, words", [(0.3, "10 cm at 0.3 m"), (0.8, "20 cm at 0.8 m"), (12.0, "2 m at 12 m")])
def test_a_scale_bar_is_as_long_as_it_says(distance, words):
    camera = Camera.from_field_of_view(640, 480)
    bar = scale_bar(camera, distance)
    assert words in bar
    pixels = 2 * float(re.search(r"h([\d.]+)", bar)[1])  # an outline has 320 columns
    metres = float(words.split()[0]) / (100 if "cm at" in words else 1)
    assert pixels * distance / camera.fx == pytest.approx(metres, rel=0.01)


def test_names_are_escaped_and_regions_have_their_letter():
    mask = np.zeros((60, 80), bool)
    mask[10:20, 10:20] = True
    text = marks_svg(mask.shape, [("<b> & 1", mask), ("nowhere", np.zeros_like(mask))], [Region("A", mask, 0.02)])
    assert 'data-object="&lt;b&gt; &amp; 1"' in text and "nowhere" not in text and ">A</text>" in text
