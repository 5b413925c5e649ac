"""Golden numbers for the transform of every face pair: a change of convention shows here, whatever else agrees.

The numbers were computed once from DESIGN section 4 without this package: face axes by cross products, rotations by
scipy's Rotation, the touching offsets by shapely as the hull of all sums of corners, cut by a line.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from derender.scene.contacts import contacts
from derender.scene.pose import from_quaternion
from derender.scene.shapes import Body, shapes

SIZES = {("box", 0): (0.2, 0.3, 0.4), ("box", 1): (0.1, 0.12, 0.14), ("plane", 0): (), ("plane", 1): ()}
VALUES = {"theta": math.radians(25), "u": 0.3, "v": 0.85, "x": 0.07, "y": -0.04}
ROWS = [
    line.split()
    for line in (Path(__file__).parent / "golden_face_pairs.txt").read_text().splitlines()
    if not line.startswith("#")
]


def test_every_pair_is_there():
    pairs = [tuple(row[:4]) for row in ROWS]
    for parent, child, count in (("box", "box", 36), ("plane", "box", 12), ("box", "plane", 12)):
        choices = contacts["face-to-face"].choices(shapes[parent], shapes[child])
        assert {(parent, child, *choice) for choice in choices} <= set(pairs) and len(choices) == count


@pytest.mark.parametrize("row", ROWS, ids=lambda row: " ".join(row[:4]))
def test_transform_of_a_face_pair(row):
    parent, child, parent_face, child_face, *numbers = row
    numbers = np.array(numbers, dtype=float)
    expected = from_quaternion(numbers[3:], numbers[:3])
    bodies = Body(shapes[parent], SIZES[parent, 0]), Body(shapes[child], SIZES[child, 1])
    pose = contacts["face-to-face"].relative_pose(VALUES, *bodies, parent_face, child_face)
    assert np.abs(pose - expected).max() < 1e-11  # the file has twelve decimals


@pytest.mark.parametrize(
    "face, axes",
    {
        "+x": "+y +z +x",
        "-x": "+y -z -x",
        "+y": "+z +x +y",
        "-y": "+z -x -y",
        "+z": "+x +y +z",
        "-z": "+x -y -z",
    }.items(),
)
def test_face_axes(face, axes):
    """DESIGN section 4, by hand: x of the frame on the next axis, y on the one after, flipped to stay right-handed."""
    frame = shapes["cube"].face(face, (0.2,)).frame
    for column, name in enumerate(axes.split()):
        expected = np.eye(3)["xyz".index(name[1])] * (1 if name[0] == "+" else -1)
        assert np.array_equal(frame[:3, column], expected)
    assert np.array_equal(frame[:3, 3], 0.1 * frame[:3, 2])
